"""Standard deviations of a fit from blocks of samples, and the source of each number: data, prior, or neither.

Residuals of a filtered log are correlated and hold what no term of the model explains, so that independent errors of single
samples would promise far too much. Here consecutive samples form blocks, each block is left out in turn, and the scatter of the
estimates is the uncertainty (delete-a-group jackknife). The prior's contribution is counted as if the nominal bodies were off by
as much as a prior of weight 1 assumes.

An interval holds for the terms of its fit. Where two terms explain the same torque, as Dahl's friction and Coulomb's do between
reversals, the choice between them decides their values and no interval shows it: such numbers are marked as confounded.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.interior import STRETCHES, Linear
from jaxdyn.identify.jackknife import block_groups, jackknife, student
from jaxdyn.identify.one_fit import Data, Estimate, Setting
from jaxdyn.identify.regression import BaseParameters, base_parameters, free_columns, parameter_names
from jaxdyn.model.tree import Model

# Share of the variance from which on a number is called one from the prior.
_FROM_PRIOR = 0.5
# Variance inflation factor from which on parameters count as confounded (Kutner et al. 2005 warn from 5 to 10 on).
_INFLATION = 5.0
CONFOUNDED, STILL = "confounded", "hardly moved"


class Spread(NamedTuple):
    """Numbers with uncertainty, all (n,): names, values, standard deviations, and the share of the variance from the prior.

    `marks` (n,): "confounded" or "hardly moved" where that makes a number's interval meaningless, else empty.
    """

    names: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    prior_share: np.ndarray
    marks: np.ndarray

    @property
    def sources(self) -> list[str]:
        """Source of each number.

        - "data" or "prior": the origin of most of its uncertainty, hence of its value;
        - "bound": a term that the fit holds at zero;
        - "confounded": its variance is five times what it were without the extra terms, or, of an extra term, without all others;
        - "hardly moved": friction or rotor inertia of a joint that stood nearly still in all logs.
        """
        source = np.where(self.prior_share > _FROM_PRIOR, "prior", "data")
        source = np.where(self.marks != "", self.marks, source)
        return np.where(np.isfinite(self.std), source, "bound").tolist()


class Intervals(NamedTuple):
    """Uncertainty of a feasible fit.

    - `parameters`: all of x in the order of `parameter_names`, then coefficients of extra terms. Terms that the fit holds at
      zero have no standard deviation (NaN).
    - `base`: the combinations of inertias and terms that torques tell apart, and `combinations`, which these are.
    - `factor`: a 95 % interval is the value plus and minus this many standard deviations (Student's t, blocks - 1).
    """

    parameters: Spread
    base: Spread
    combinations: BaseParameters
    base_covariance: np.ndarray
    factor: float


def intervals(
    model: Model,
    data: Data,
    setting: Setting,
    estimate: Estimate,
    weights: np.ndarray,
    terms,
    worth: float,
    curved: Data | None = None,
    still: Sequence[int] = (),
) -> Intervals:
    """`Intervals` of one fit of condensed logs.

    With D_b the data's curvature and g_b their slope on block b, both over sigma^2, P the prior's curvature and H = sum D_b + P:
    leaving b out moves the fit by (H - D_b)^-1 g_b. Their covariance times (B - 1) is the data's share, and
    max(prior, 1) H^-1 P H^-1 the prior's. All in the coordinates of the chart, then carried over to x.

    `worth`: how many independent errors the logs hold (`stretches`), which says how long what is left out must be. `curved`: logs
    whose curvature counts, where the loss is not made of squares: Huber's has none beyond its threshold, though it has a gradient
    there. `still`: indices of the torques whose joints hardly moved.

    Source: Efron (1982), the jackknife; Cameron & Miller (2015), cluster-robust inference (CR3); Huber
    (1981), "Robust statistics", section 6.4, whose curvature is that of psi'; Kutner, Nachtsheim, Neter & Li (2005), "Applied
    linear statistical models", section 10.5, variance inflation.
    """
    jacobian, curvature, free = _local(data, setting, estimate)
    blocks, sigma = data.blocks, estimate.sigma
    slopes = blocks.scores(estimate.x, weights) @ jacobian / sigma**2
    grams_of_curvature = (data if curved is None else curved).blocks.grams(weights)
    grams = np.einsum("pi,bpq,qj->bij", jacobian, grams_of_curvature, jacobian, optimize=True) / sigma**2
    groups = block_groups(len(blocks), worth)
    slopes, grams = (np.stack([x[group].sum(axis=0) for group in groups]) for x in (slopes, grams))
    changes, inverse = jackknife(grams, slopes, curvature)
    count = len(groups)
    changes, pulled = jacobian @ changes, jacobian @ inverse @ _root(curvature) * np.sqrt(max(setting.prior, 1.0))

    nb, nv = model.nb, model.nv
    names = list(parameter_names(model))
    for term, size in data.counts.items():
        for k in range(size):
            names += [f"{joint}.{term}{k + 1 if size > 1 else ''}" for joint in _joints(model)]
    fitted = np.concatenate([free, np.zeros(blocks.size - len(free), bool)])
    fitted[data.places(setting.extra)] = True
    shown = np.flatnonzero(fitted | (np.arange(blocks.size) < data.basic))
    extra = data.places(setting.extra)
    covariance = jacobian @ inverse @ jacobian.T
    is_still = (np.arange(blocks.size) >= 10 * nb) & np.isin((np.arange(blocks.size) - 10 * nb) % nv, list(still))

    base = base_parameters(model, terms)
    columns = free_columns(nb, nv, terms)
    combine = np.zeros((len(base), blocks.size))
    combine[:, columns] = base.matrix
    is_confounded = inflation_by_extra(np.eye(blocks.size), covariance, extra) > _INFLATION
    is_confounded[extra] = inflation_of_extra(combine, covariance, extra) > _INFLATION
    marks = np.where(is_still, STILL, np.where(is_confounded, CONFOUNDED, ""))
    parameters = _spread(
        [names[i] for i in shown], estimate.x[shown], changes[shown], pulled[shown], fitted[shown], marks[shown]
    )

    # Parameters enter with both signs, so that a sum over them can vanish where none is zero.
    enters = np.abs(base.matrix) > 1e-9 * np.abs(base.matrix).max(axis=1, keepdims=True)
    known = np.any(enters & fitted[columns], axis=1)
    a, b = base.matrix @ changes[columns], base.matrix @ pulled[columns]
    is_confounded = inflation_by_extra(combine, covariance, extra) > _INFLATION
    marks = np.where(is_still[columns[base.independent]], STILL, np.where(is_confounded, CONFOUNDED, ""))
    spread = _spread(base.names, base.values(estimate.x[columns]), a, b, known, marks)
    return Intervals(parameters, spread, base, a @ a.T + b @ b.T, student(count - 1))


def inflation_by_extra(rows: np.ndarray, covariance: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Factors (m,) by which extra terms inflate the variances of linear combinations `rows` (m, p) of the parameters.

    The variance with the extra coefficients free, over that with these held: the Schur complement of their covariance.
    """
    variance = np.einsum("ip,pq,iq->i", rows, covariance, rows)
    if not len(extra):
        return np.ones(len(rows))
    cross = rows @ covariance[:, extra]
    inverse = np.linalg.pinv(covariance[np.ix_(extra, extra)], hermitian=True)
    held = variance - np.einsum("ie,ef,if->i", cross, inverse, cross)
    return variance / np.maximum(held, 1e-12 * np.maximum(variance, 1e-300))


def inflation_of_extra(combine: np.ndarray, covariance: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Variance inflation factors of extra coefficients beside base parameters `combine` @ x and one another."""
    if not len(extra):
        return np.ones(0)
    # Combinations at their bound have no variance and inflate nothing.
    rows = np.concatenate([combine, np.eye(covariance.shape[0])[extra]])
    joint = rows @ covariance @ rows.T
    size = np.sqrt(np.maximum(np.diag(joint), 0))
    seen = size > 0
    correlation = joint[np.ix_(seen, seen)] / size[seen][:, None] / size[seen]
    factors = np.ones(len(rows))
    factors[seen] = np.diag(np.linalg.pinv(correlation, hermitian=True))
    return factors[len(combine) :]


def _spread(names, values, changes, pulled, fitted, marks) -> Spread:
    from_data, from_prior = np.sum(changes**2, axis=1), np.sum(pulled**2, axis=1)
    total = from_data + from_prior
    share = np.where(total > 0, from_prior / np.where(total > 0, total, 1), 1.0)
    return Spread(tuple(names), np.asarray(values), np.where(fitted, np.sqrt(total), np.nan), share, marks)


def _local(data: Data, setting: Setting, estimate: Estimate):
    """Slopes of x by the free coordinates, the prior's curvature in them, and which basic parameters are free at all."""
    linear, minimum = Linear(estimate.chart), estimate.minimum
    slopes = linear.slopes_at(minimum.origin, minimum.s)
    count, size = len(minimum.origin), linear.count
    basis = STRETCHES[:size]
    prior_curvature = setting.prior * np.kron(np.eye(count), np.einsum("kij,lji->kl", basis, basis))
    bodies = count * size
    is_free = np.ones(slopes.shape[1], bool)
    # What is at its bound stays there.
    is_free[bodies:] = ~(linear.positive & (minimum.s.reshape(-1) == 0))
    places = data.places(setting.extra)
    count = int(is_free.sum())
    jacobian = np.zeros((data.blocks.size, count + len(places)))
    jacobian[: data.basic, :count] = slopes[:, is_free]
    jacobian[places, count + np.arange(len(places))] = 1.0
    curvature = np.zeros((jacobian.shape[1],) * 2)
    curvature[:bodies, :bodies] = prior_curvature
    units = data.units.reshape(-1)[places - data.basic]
    curvature[count + np.arange(len(places)), count + np.arange(len(places))] = setting.prior / units**2
    return jacobian, curvature, np.any(jacobian[: data.basic] != 0, axis=1)


def _root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0))


def _joints(model: Model) -> list[str]:
    start = 10 * model.nb
    return [name.rpartition(".")[0] for name in parameter_names(model)[start : start + model.nv]]
