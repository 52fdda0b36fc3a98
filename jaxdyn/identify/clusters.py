"""Which errors of a fit of any numbers hang together, and the deviations that groups of them left out in turn give."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.identify.condensed import block_slices
from jaxdyn.identify.gauss_newton import Linear, determined
from jaxdyn.identify.jackknife import block_groups, jackknife
from jaxdyn.identify.logs import Log
from jaxdyn.identify.objectives import BALANCES
from jaxdyn.identify.problem import Problem, first_samples
from jaxdyn.identify.whiteness import stretches

# About so many blocks are cut of all logs; each log has one at least.
_BLOCKS = 20


def groups_of(problem: Problem, logs: Sequence[Log], errors: np.ndarray) -> np.ndarray:
    """For each of the data's errors (n,) the group that it is left out with: a stretch of a log, or logs where there are many.

    Blocks are of whole pieces where these are many enough, and groups of blocks as long as `block_groups` says.
    """
    owners = np.array([log for log, _ in first_samples(problem, logs)])
    sizes = [batch.t.shape[:2] for batch in problem.batches]
    total, units, series = sum(pieces * samples for pieces, samples in sizes), [], [[] for _ in logs]
    start = piece = 0
    for pieces, samples in sizes:
        count = len(errors) * pieces * samples // total // pieces
        rows = 1 if problem.objective.error in BALANCES else samples
        for own in errors[start : start + pieces * count].reshape(pieces, rows, -1):
            series[owners[piece]].append(own)
            units.append((owners[piece], rows, own.shape[1]))
            piece += 1
        start += pieces * count
    whole = len(units) >= _BLOCKS
    lengths = [sum(1 if whole else rows for owner, rows, _ in units if owner == k) for k in range(len(logs))]
    kept = [length for length in lengths if length]
    slices = block_slices(kept, _BLOCKS)
    block_of_unit = np.repeat(np.arange(len(slices)), [part.stop - part.start for _, part in slices])
    repeats = [rows * width if whole else width for _, rows, width in units for _ in range(1 if whole else rows)]
    worth = stretches([np.concatenate(part) for part in series if part])
    group_of_block = np.zeros(len(slices), int)
    for number, group in enumerate(block_groups(len(slices), worth)):
        group_of_block[group] = number
    return np.repeat(group_of_block[block_of_unit], repeats)


def deviations(end: Linear, slopes: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Standard deviations (m,) of numbers with the slopes (m, p) by y; infinite where neither data nor prior determine them.

    The larger of two: that of independent errors of one size, which is theirs, and that of a jackknife over the groups, which
    counts errors that last, that come together, and that are larger at some samples. Few groups know a deviation badly, and
    one that alone tells a number finds no scatter in it; the other is the floor then. Errors of the prior have the size it says.
    NaN when the errors are not finite, or no more than the unknowns.

    Source: Bell & McCaffrey (2002), CR3; Angrist & Pischke (2009), "Mostly harmless econometrics", section 8.2, the maximum.
    """
    told = determined(end, slopes)
    if told is None:
        return np.full(len(slopes), np.nan)
    independent = np.sum(told.numbers**2, axis=1)
    curvature = told.prior.T @ told.prior
    parts = [(told.data[groups == k], told.errors[groups == k]) for k in range(groups.max(initial=0) + 1)]
    grams = np.stack([part.T @ part for part, _ in parts])
    changes, _ = jackknife(grams, np.stack([part.T @ error for part, error in parts]), curvature)
    variance = np.sum((told.numbers @ changes) ** 2, axis=1) + np.sum((told.numbers @ told.prior.T) ** 2, axis=1)
    return np.where(told.idle, np.inf, np.sqrt(np.maximum(variance, independent)))
