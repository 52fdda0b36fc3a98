"""Torque terms that the logs support and a fit lacks, and intervals that include the fits with them.

A term left out moves the parameters that imitate it: half a per cent of the torque can hide ten standard deviations of viscous
friction. The scatter over blocks shows nothing of it, as the errors that remain look the same in each of them. For every term
of `EXTRA` at every joint the fit with it follows from the condensed logs by one Newton step. Where the 95 % interval of its
coefficient excludes zero, the intervals become those that hold both fits' intervals, also for the clearest terms of all joints
together. Only terms that differ from zero at a stricter level are named: with so many tests some exceed the first one by
chance. At the stricter level alone a term that is there and just fails the test leaves intervals that are too narrow (Bancroft
1944).

Source: Bancroft (1944), "On biases in estimation due to the use of preliminary tests of significance"; Leamer (1983), "Let's
take the con out of econometrics", bounds over specifications; Wooldridge (2010), section 4.3, omitted variables.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed_fit import FROM_PRIOR, Data, Estimate, Intervals, Setting, Spread, local_coordinates
from jaxdyn.identify.uncertainty import block_groups, invert, psd_root, student

# Two-sided level at which a term is named: it is asked for every term at every joint.
_LEVEL = 1e-2


class Shift(NamedTuple):
    """Effect of further terms: change of all parameters (p,), and a root (p, groups) of their covariance with them.

    The root has the scatter over groups, and the pull of the prior (n more columns). `terms`: names and indices of torques;
    `factor`: of a 95 % interval; `clearness`: largest coefficient over its standard deviation, of those that the logs determine;
    `least`: clearness from which on the terms are named.
    """

    terms: tuple[tuple[str, int], ...]
    change: np.ndarray
    root: np.ndarray
    factor: float
    clearness: float
    least: float


class _Extended(NamedTuple):
    """Fit with the columns of further terms, in coordinates of unit curvature.

    `jacobian` (p, n): of all parameters, the fit's own coordinates first; `prior` (n, n): a root of its curvature; `gradients`
    (groups, n) and `grams` (groups, n, n); `curvatures` (1 + groups, n, n): with all groups, and without each of them;
    `inverses`: of their own parts.
    """

    jacobian: np.ndarray
    prior: np.ndarray
    gradients: np.ndarray
    grams: np.ndarray
    curvatures: np.ndarray
    inverses: np.ndarray

    def extend(self, terms: tuple[tuple[str, int], ...], new: np.ndarray) -> Shift | None:
        """Shift by the coefficients `new`, None where independent errors alone explain them."""
        T, prior, g, G, curvatures, inverses = self
        own, groups = inverses.shape[1], len(G)
        kept, cross = np.append(np.arange(own), new), curvatures[:, :own, new]
        eliminated = inverses @ cross
        rest = curvatures[:, new][:, :, new] - np.swapaxes(cross, 1, 2) @ eliminated
        inverse = np.linalg.inv(rest + 1e-12 * np.eye(len(new)))
        # The fit is a minimum: of the gradient of data and prior the part of the new coefficients alone is left.
        step = -inverse[0] @ g[:, new].sum(axis=0)
        # Costs no jackknife, and errs on the side of the term.
        if not np.any(np.abs(step) > 1.5 * np.sqrt(np.maximum(np.diag(inverse[0]), 0))):
            return None
        step = np.append(-eliminated[0] @ step, step)
        right = (g[:, kept] + G[:, kept][:, :, kept] @ step)[..., None]
        known = inverses[1:] @ right[:, :own]
        last = inverse[1:] @ (right[:, own:] - np.swapaxes(cross[1:], 1, 2) @ known)
        replicates = np.concatenate([known - eliminated[1:] @ last, last], axis=1)[..., 0]
        scatter = (replicates - replicates.mean(axis=0)).T * np.sqrt((groups - 1) / groups)
        right = prior[np.ix_(kept, kept)]
        known = inverses[0] @ right[:own]
        last = inverse[0] @ (right[own:] - cross[0].T @ known)
        pulled = np.concatenate([known - eliminated[0] @ last, last])
        root = np.concatenate([scatter, pulled], axis=1)
        # The first link's weight and a spring at its joint are one torque: only the prior tells them apart, and the logs do not.
        sizes, by_prior = np.linalg.norm(root[own:], axis=1), np.linalg.norm(pulled[own:], axis=1)
        ratios = np.abs(step[own:]) / np.maximum(sizes, 1e-300)
        clearness = float(np.max(ratios, where=by_prior**2 <= FROM_PRIOR * sizes**2, initial=0.0))
        factor, least = student(groups - 1), student(groups - 1, _LEVEL)
        return Shift(terms, T[:, kept] @ step, T[:, kept] @ root, factor, clearness, least)


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
    groups = block_groups(len(grams), size)
    G, g = (np.stack([x[group].sum(axis=0) for group in groups]) for x in (grams, gradients))
    H = G.sum(axis=0) + prior
    # Unit diagonal: parameters differ by many orders of magnitude in size.
    unit = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    T, g, G, H = T * unit, g * unit, G * unit * unit[:, None], H * unit * unit[:, None]
    # As of `intervals`: at least weight 1 counts.
    root = unit[:, None] * psd_root(prior) * np.sqrt(max(setting.prior, 1.0))
    # With all groups, and without each of them. The fit's own parameters are eliminated once for all terms.
    curvatures = np.concatenate([H[None], H - G])
    inverses = np.stack([invert(one[:own, :own]) for one in curvatures])

    system = _Extended(T, root, g, G, curvatures, inverses)
    ends = own + np.cumsum([len(places) for _, places in tried])
    indices = {term: np.arange(end - len(places), end) for end, (term, places) in zip(ends, tried, strict=True)}
    every = [system.extend((term,), new) for term, new in indices.items()]
    shifts = [shift for shift in every if shift is not None and shift.clearness > shift.factor]
    named = [shift for shift in shifts if shift.clearness > shift.least]
    clearest = {shift.terms[0][1]: shift.terms[0] for shift in sorted(named, key=lambda shift: shift.clearness)}
    if len(clearest) > 1:
        # A second joint's term moves the first joint's parameters too.
        both = system.extend(tuple(clearest.values()), np.concatenate([indices[term] for term in clearest.values()]))
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
        omitted=tuple(dict.fromkeys(term for shift in shifts if shift.clearness > shift.least for term in shift.terms)),
    )


def _widen(spread: Spread, change: np.ndarray, root: np.ndarray, factor: float, own: float) -> Spread:
    reach = np.abs(change) + factor * np.linalg.norm(root, axis=1)
    # NaN, of terms held at zero, stays.
    std = np.maximum(spread.std, reach / own)
    share = spread.prior_share * (spread.std / np.where(std > 0, std, 1.0)) ** 2
    return spread._replace(std=std, prior_share=np.where(np.isfinite(share), share, spread.prior_share))
