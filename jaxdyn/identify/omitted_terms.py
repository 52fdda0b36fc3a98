"""Torque terms that the logs support and a fit lacks, and intervals that include the fits with them.

A term left out moves the parameters that imitate it: half a per cent of the torque can hide ten standard deviations of viscous
friction. The scatter over blocks shows nothing of it, as the errors that remain look the same in each of them. For every term of
`EXTRA` at every joint the fit with it follows from the condensed logs by one Newton step. Where its coefficient differs from zero
by Student's t, the intervals become those that hold both fits' intervals, also for the clearest terms of all joints together.

Source: Leamer (1983), "Let's take the con out of econometrics", bounds over specifications; Wooldridge (2010), section 4.3,
omitted variables.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed_fit import Data, Estimate, Intervals, Setting, Spread, local_coordinates
from jaxdyn.identify.uncertainty import jackknife, student

# Two-sided level of the test for a coefficient: it is asked for every term at every joint.
_LEVEL = 1e-2


class Shift(NamedTuple):
    """Effect of further terms: change of all parameters (p,), and a root (p, groups) of their covariance with them.

    `terms`: names and indices of torques; `factor`: of a 95 % interval; `clearness`: largest coefficient over the deviation at
    which the test counts it.
    """

    terms: tuple[tuple[str, int], ...]
    change: np.ndarray
    root: np.ndarray
    factor: float
    clearness: float


def find_shifts(
    data: Data, setting: Setting, estimate: Estimate, weights: np.ndarray, size: float, still: Sequence[int]
) -> list[Shift]:
    """Shifts by the terms of `data` that a setting lacks, where the logs support them; arguments as of `intervals`.

    `data` has the columns of the fit first, and then those of the terms to try.
    """
    blocks, used, variance = data.blocks, dict(setting.extra), estimate.sigma**2
    estimate = estimate._replace(x=np.append(estimate.x, np.zeros(blocks.size - len(estimate.x))))
    jacobian, curvature, _ = local_coordinates(data, setting, estimate)
    own = jacobian.shape[1]
    tried = [
        ((name, joint), places)
        for name in data.counts
        for joint in range(blocks.nv)
        if joint not in used.get(name, ()) and joint not in still
        if len(places := data.places(((name, (joint,)),)))
    ]
    places = np.concatenate([np.zeros(0, int), *(places for _, places in tried)])
    # Coefficients in their units, in which the prior has the curvature of its weight.
    columns = np.zeros((blocks.size, len(places)))
    columns[places, np.arange(len(places))] = data.units.reshape(-1)[places - data.basic]
    T = np.concatenate([jacobian, columns], axis=1)
    prior = np.diag(np.append(np.zeros(own), np.full(len(places), setting.prior)))
    prior[:own, :own] = curvature
    gradients = blocks.scores(estimate.x, weights) @ T / variance
    grams = np.einsum("pi,bpq,qj->bij", T, blocks.grams(weights), T, optimize=True) / variance

    def extend(terms: tuple[tuple[str, int], ...], new: np.ndarray) -> Shift | None:
        """Shift by the coefficients `new`, None where independent errors alone explain them."""
        kept = np.append(np.arange(own), new)
        H = (grams.sum(axis=0) + prior)[np.ix_(kept, kept)]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        inverse = np.linalg.pinv(H * scale * scale[:, None], rcond=1e-12, hermitian=True) * scale * scale[:, None]
        # The fit is a minimum: of the gradient of data and prior the part of the new coefficients alone is left.
        step = inverse @ np.append(np.zeros(own), -gradients[:, new].sum(axis=0))
        # Costs no jackknife, and errs on the side of the term.
        if not np.any(np.abs(step[own:]) > 2.5 * np.sqrt(np.diag(inverse)[own:])):
            return None
        parts = grams[:, kept][:, :, kept]
        spread = jackknife(parts, gradients[:, kept] + parts @ step, prior[np.ix_(kept, kept)], size)
        least = student(spread.root.shape[1] - 1, _LEVEL) * np.sqrt(np.sum(spread.root[own:] ** 2, axis=1))
        clearness = float(np.max(np.abs(step[own:]) / np.maximum(least, 1e-300)))
        return Shift(terms, T[:, kept] @ step, T[:, kept] @ spread.root, spread.factor, clearness)

    ends = own + np.cumsum([len(places) for _, places in tried])
    indices = {term: np.arange(end - len(places), end) for end, (term, places) in zip(ends, tried, strict=True)}
    every = [extend((term,), new) for term, new in indices.items()]
    shifts = [shift for shift in every if shift is not None and shift.clearness > 1]
    clearest = {shift.terms[0][1]: shift.terms[0] for shift in sorted(shifts, key=lambda shift: shift.clearness)}
    if len(clearest) > 1:
        # A second joint's term moves the first joint's parameters too.
        both = extend(tuple(clearest.values()), np.concatenate([indices[term] for term in clearest.values()]))
        shifts += [] if both is None else [both]
    return shifts


def include_shifts(found: Intervals, shifts: Sequence[Shift], rows: np.ndarray, columns: np.ndarray) -> Intervals:
    """Intervals that hold those of the fits with one more term each.

    `rows`: indices in x of the parameters of the intervals; `columns`: of those that the base parameters combine.
    """
    matrix, parameters, base = found.combinations.matrix, found.parameters, found.base
    for shift in shifts:
        parameters = _widen(parameters, shift.change[rows], shift.root[rows], shift.factor, found.factor)
        base = _widen(base, matrix @ shift.change[columns], matrix @ shift.root[columns], shift.factor, found.factor)
    # The shares of the variances grow, the correlations stay.
    grown = base.std / np.where(found.base.std > 0, found.base.std, 1.0)
    return found._replace(
        parameters=parameters,
        base=base,
        base_covariance=found.base_covariance * grown * grown[:, None],
        omitted=tuple(dict.fromkeys(term for shift in shifts for term in shift.terms)),
    )


def _widen(spread: Spread, change: np.ndarray, root: np.ndarray, factor: float, own: float) -> Spread:
    reach = np.abs(change) + factor * np.sqrt(np.sum(root**2, axis=1) + spread.prior_share * spread.std**2)
    # NaN, of terms held at zero, stays.
    std = np.maximum(spread.std, reach / own)
    share = spread.prior_share * (spread.std / np.where(std > 0, std, 1.0)) ** 2
    return spread._replace(std=std, prior_share=np.where(np.isfinite(share), share, spread.prior_share))
