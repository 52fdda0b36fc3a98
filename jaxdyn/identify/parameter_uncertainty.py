"""Standard deviations of the numbers of any fit, by jackknife groups of correlated errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed import block_slices
from jaxdyn.identify.gauss_newton import RANK_TOLERANCE, LinearErrors
from jaxdyn.identify.logs import Log
from jaxdyn.identify.objectives import BALANCES
from jaxdyn.identify.problem import Problem, segment_starts
from jaxdyn.identify.regression import least_squares_by_svd
from jaxdyn.identify.uncertainty import block_groups, effective_sample_size, jackknife

# About so many blocks are cut from all logs; each log has at least one.
_BLOCKS = 20


def error_groups(problem: Problem, logs: Sequence[Log], errors: np.ndarray) -> np.ndarray:
    """Jackknife group of each of the data's errors (n,): consecutive samples of a log, or whole logs where there are many.

    Blocks consist of whole segments where there are enough of these, and groups of as many blocks as `block_groups` says.
    """
    owners = np.array([log for log, _ in segment_starts(problem, logs)])
    sizes = [batch.t.shape[:2] for batch in problem.batches]
    # A unit is what a block cannot divide: a segment, or a sample of one.
    total, units, series = sum(segments * samples for segments, samples in sizes), [], [[] for _ in logs]
    start = segment = 0
    for segments, samples in sizes:
        count = len(errors) * segments * samples // total // segments
        # A balance has one row of errors for a segment, other errors one for each sample.
        rows = 1 if problem.objective.error in BALANCES else samples
        for own in errors[start : start + segments * count].reshape(segments, rows, -1):
            series[owners[segment]].append(own)
            units.append((owners[segment], rows, own.shape[1]))
            segment += 1
        start += segments * count
    whole = len(units) >= _BLOCKS
    lengths = [sum(1 if whole else rows for owner, rows, _ in units if owner == k) for k in range(len(logs))]
    kept = [length for length in lengths if length]
    slices = block_slices(kept, _BLOCKS)
    block_of_unit = np.repeat(np.arange(len(slices)), [part.stop - part.start for _, part in slices])
    repeats = [rows * width if whole else width for _, rows, width in units for _ in range(1 if whole else rows)]
    # The order of samples within a log is needed here: the autocorrelation is one along time.
    size = effective_sample_size([np.concatenate(part) for part in series if part])
    group_of_block = np.zeros(len(slices), int)
    for number, group in enumerate(block_groups(len(slices), size)):
        group_of_block[group] = number
    return np.repeat(group_of_block[block_of_unit], repeats)


def standard_deviations(end: LinearErrors, jacobian: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Standard deviations (m,) of numbers with the Jacobian (m, p) by y; infinite where neither data nor prior determine them.

    The larger of two: that of independent errors of equal size, and that of a jackknife over groups, which accounts for errors
    that are autocorrelated, correlated among coordinates, and larger at some samples. A few groups estimate a deviation
    badly, and a number that a single group determines has no scatter over groups; the other one is then a lower bound. Errors
    of the prior have the size that it states. NaN when the errors are not finite, or no more than the unknowns.

    Source: Bell & McCaffrey (2002), CR3; Angrist & Pischke (2009), "Mostly harmless econometrics", section 8.2, the maximum.
    """
    white = whiten_errors(end, jacobian)
    if white is None:
        return np.full(len(jacobian), np.nan)
    # In whitened coordinates the covariance for independent errors is the identity.
    independent = np.sum(white.numbers**2, axis=1)
    curvature = white.prior.T @ white.prior
    parts = [(white.data[groups == k], white.errors[groups == k]) for k in range(groups.max(initial=0) + 1)]
    grams = np.stack([part.T @ part for part, _ in parts])
    changes, _ = jackknife(grams, np.stack([part.T @ error for part, error in parts]), curvature)
    # Errors of the prior have the size that it states: their part needs no estimate from scatter.
    variance = np.sum((white.numbers @ changes) ** 2, axis=1) + np.sum((white.numbers @ white.prior.T) ** 2, axis=1)
    return np.where(white.is_free, np.inf, np.sqrt(np.maximum(variance, independent)))


class WhitenedErrors(NamedTuple):
    """Errors near a minimum in coordinates in which data and prior together have the curvature 1.

    `data` (n, r), `errors` (n,): rows and errors of the data over their deviation; `prior` (k, r): rows of the prior; `numbers`
    (m, r): derivatives of the fitted numbers; `is_free` (m,): which of these neither data nor prior determine.
    """

    data: np.ndarray
    errors: np.ndarray
    prior: np.ndarray
    numbers: np.ndarray
    is_free: np.ndarray


def whiten_errors(end: LinearErrors, jacobian: np.ndarray) -> WhitenedErrors | None:
    """Whitened errors, for numbers with the Jacobian (m, p) by y; None if not finite, or no more errors than unknowns.

    Errors of the data have one size, which is estimated from them; those of the prior have the size that it states.
    """
    if not end.is_finite:
        return None
    count = len(end.errors) - end.priors
    data = end.rows[:count]
    fit = least_squares_by_svd(data, end.errors[:count], RANK_TOLERANCE)
    # Initial states were eliminated; each of their directions has used up one error.
    spare = count - end.start_rank - (fit.rank if end.priors == 0 else 0)
    if spare <= 0:
        return None
    # The estimated variance of errors; for errors that are all zero the smallest number keeps the division defined.
    noise = (max(float(np.sum(end.errors[:count] ** 2)), 1e-300) / spare) ** 0.5
    # The prior's rows were weighted by an assumed noise: here by the estimated one.
    rows = np.concatenate([data / noise, end.rows[count:] / end.prior_weight**0.5])
    # Columns of unit length: ranks must not depend on units of the parameters.
    size = np.linalg.norm(rows, axis=0)
    size[size <= 1e-12 * size.max(initial=0.0)] = np.inf
    # The triangle has the singular values of all rows. The full Vt holds the null space, where there are fewer rows than columns.
    _, s, Vt = np.linalg.svd(np.linalg.qr(rows / size)[1], full_matrices=True)
    rank = int(np.sum(s > RANK_TOLERANCE * s.max(initial=0.0)))
    # No error depends on these coordinates: a number with a share in them is not determined.
    unseen = np.isinf(size)
    scaled = jacobian / np.where(unseen, 1.0, size)
    seen = np.where(unseen[None], 0.0, scaled)
    # A number with any share in the null space of data and prior is not determined.
    is_free = np.linalg.norm(seen @ Vt[rank:].T, axis=1) > 1e-6 * np.linalg.norm(seen, axis=1)
    is_free |= np.abs(scaled[:, unseen]).sum(axis=1) > 0
    whitening = Vt[:rank].T / s[:rank]
    rows = (rows / size) @ whitening
    return WhitenedErrors(rows[:count], end.errors[:count] / noise, rows[count:], seen @ whitening, is_free)
