"""Feasible fit of condensed logs at a given setting, with exact elimination of extra torque terms, and its intervals.

The loss 1/2 |W x + E c - tau|^2 / sigma^2 + prior (D(x) + 1/2 sum (c / unit)^2) is quadratic in the coefficients c. The QR
factorisation of [E, W, tau] with the prior's rows under E leaves a triangle of x alone, whose loss is that of the best c for x.

Residuals of a filtered log are correlated and hold what no term of the model explains, so that independent errors of single
samples would promise far too much. Standard deviations are those of a delete-a-group jackknife over blocks of consecutive samples
(`uncertainty`). The prior's contribution is counted as if the nominal bodies were off by as much as a prior of weight 1 assumes.

An interval holds for the terms of its fit. Where two terms explain the same torque, as Dahl's friction and Coulomb's do between
reversals, the choice between them decides their values and no interval shows it: such numbers are marked as confounded.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.interior import LOG_CHOLESKY_BASIS, LinearChart, TorqueProblem
from jaxdyn.identify.logs import Log, root_mean_square
from jaxdyn.identify.regression import (
    BaseParameters,
    Blocks,
    base_parameters,
    condense_model,
    coordinate_names,
    free_columns,
    noise_level,
    parameter_names,
    triangle_of,
)
from jaxdyn.identify.torque_terms import TorqueTerm, coulomb_through_filter, term_columns
from jaxdyn.identify.uncertainty import depends_on, jackknife, null_space, psd_root
from jaxdyn.model.tree import Model

# A unit of a coefficient makes this share of the joint's torque.
_UNIT = 0.1
# Tolerance on the loss of a fit, and of one that only compares settings.
_FINE, _ROUGH = 1e-6, 1e-2
# Fits with weights or loads that follow from the fit before are repeated until one changes all parameters by less than this
# share of their standard deviations for independent errors; most of them.
_SETTLED, MAX_ROUNDS = 0.05, 30
# Least torque noise as a share of the torque, so that noise-free logs stay well posed.
_FINEST = 1e-6


class Setting(NamedTuple):
    """Setting of a fit.

    `v_s`, smoothing velocity; `extra`: extra terms, (name, indices of its torques); `prior`, weight of the
    divergence of the bodies and of the coefficients of extra terms; `robust`: threshold of Huber's loss, None for squares.
    """

    v_s: float
    extra: tuple[tuple[str, tuple[int, ...]], ...]
    prior: float
    robust: float | None = None


class Data(NamedTuple):
    """Condensed logs for one v_s, with the columns of all extra terms that may be chosen.

    `basic`: number of parameters before them; `counts`: columns of each of them; `units` (columns, nv): coefficient that makes
    a tenth of the joint's torque, zero where the column is zero.
    """

    blocks: Blocks
    basic: int
    counts: dict[str, int]
    units: np.ndarray

    def places(self, extra) -> np.ndarray:
        """Indices in x of the coefficients of extra terms, as `Setting.extra` names them."""
        wanted, start, result = dict(extra), 0, []
        for name, count in self.counts.items():
            for column in range(start, start + count):
                # Columns of zeros are left out: their unit is zero, and the prior divides by it.
                places = [joint for joint in wanted.get(name, ()) if self.units[column, joint] > 0]
                result += [self.basic + column * self.blocks.nv + joint for joint in places]
            start += count
        return np.array(result, int)


class Estimate(NamedTuple):
    """Result of `fit_blocks`: all parameters x, the torque noise, the chart, and the minimum in it.

    `origin` (bodies, 4, 4) and `terms` (n,) of the chart, losses, and the result.
    """

    x: np.ndarray
    sigma: float
    chart: LinearChart
    origin: np.ndarray
    terms: np.ndarray
    history: np.ndarray
    result: Any

    def give_up(self) -> "Estimate":
        """Copy whose result is `max_steps_reached`, unless it is another failure already."""
        return self._replace(result=RESULTS.max_steps_reached) if self.result is RESULTS.successful else self


def is_negligible(W: np.ndarray, change: np.ndarray, sigma: float) -> bool:
    """Decide whether a change (p,) of the parameters is small against their standard deviations, with errors W dx of size sigma.

    Any combination c x has the deviation sigma |W^-T c|, and |c dx| <= |W^-T c| |W dx|.
    """
    return bool(np.linalg.norm(W @ change) <= _SETTLED * sigma)


def gather(
    model: Model,
    logs: Sequence[Log],
    v_s: float,
    extra: Sequence[TorqueTerm],
    loads: Sequence[np.ndarray],
    blocks: int,
    weights: Sequence[np.ndarray] | None = None,
    carried: Sequence[np.ndarray] = (),
) -> Data:
    """Condense logs with the columns of extra terms; `loads` (n, nv) of each log is the torque of the rigid bodies.

    `weights` (n, nv) of each log: of single torques, ones by default; `carried` as of `condense_model`.
    """
    # Every candidate term is condensed once; a setting then selects columns, and needs no sample.
    parts = [[term_columns([term], log, load, v_s) for term in extra] for log, load in zip(logs, loads, strict=True)]
    coulomb = [coulomb_through_filter(log, v_s) for log in logs]
    counts = {term.name: part.shape[2] for term, part in zip(extra, parts[0], strict=True)}
    columns = [
        np.concatenate([np.zeros((len(log), log.nv, 0)), *part], axis=2) for log, part in zip(logs, parts, strict=True)
    ]
    torque = root_mean_square(np.concatenate([np.asarray(log.tau) for log in logs]))
    joined = np.concatenate(columns)
    size = root_mean_square(joined.reshape(len(joined), -1)).reshape(joined.shape[1:]).T
    # A torque that is always zero borrows the scale of the largest, so that its coefficients keep a finite unit.
    torque = np.where(torque > 0, torque, torque.max(initial=0) or 1.0)
    units = np.where(size > 0, _UNIT * torque / np.where(size > 0, size, 1), 0.0)
    data = condense_model(
        model, logs, v_s=v_s, coulomb=coulomb, extra=columns, carried=carried, blocks=blocks, weights=weights
    )
    return Data(data, 10 * model.nb + 4 * model.nv, counts, units)


def fit_blocks(
    chart: LinearChart,
    data: Data,
    setting: Setting,
    sizes,
    weights: np.ndarray,
    *,
    rows: np.ndarray | None = None,
    count: int | None = None,
    is_rough: bool = False,
    callback: Callable | None = None,
) -> Estimate:
    """Fit all blocks, or those that `rows` and `count` of `Blocks` were given for; `is_rough` for a comparison of settings.

    `sizes` as of `signal_sizes`, `callback` as of `TorqueProblem.minimize`.

    **Raises:** ValueError for logs with torques of zero alone, or with fewer of them than unknowns.
    """
    rows, size = data.blocks.rows(weights) if rows is None else rows, data.blocks.size
    count = data.blocks.count() if count is None else count
    places = data.places(setting.extra)
    kept = np.append(np.arange(data.basic), places)
    # Coefficients first, so that their elimination is the top of the triangle.
    free = triangle_of(rows[:, [*places, *range(data.basic), size]])
    spare = count - (free.shape[1] - 1)
    rest = float(free[-1, -1] ** 2) if len(free) == free.shape[1] else 0.0
    # Dependent columns make this estimate a little too small, alike for all settings that are compared.
    if is_rough and spare > 0 and rest > 0:
        sigma = np.sqrt(rest / spare)
    else:
        what = "the part of the log that settings are compared by" if is_rough else "the log"
        sigma = noise_level(free, count, what=what)
    units = data.units.reshape(-1)[places - data.basic]
    # Rows are in N m here: the prior's rows, sqrt(prior) c / unit in deviations, are multiplied by sigma.
    R, coefficients = eliminate(free, len(places), np.sqrt(setting.prior) * sigma / units)
    # Noise-free logs stay well posed by a small share of the torque.
    sigma = max(float(sigma), _FINEST * float(np.sqrt(np.mean(sizes[0] ** 2))))
    problem = TorqueProblem.of(chart, R, sigma, setting.prior)
    end = problem.minimize(_ROUGH if is_rough else _FINE, callback)
    origin, terms = end.last.point
    # Interior points never reach a bound. Exact zeros let `intervals` recognise the terms that are held there.
    terms = chart.clip_terms(terms)
    x = np.zeros(size)
    basic = chart.x(origin, terms)
    x[kept] = np.append(basic, coefficients(basic))
    return Estimate(x, sigma, chart, origin, terms, end.history, end.result)


def eliminate(rows: np.ndarray, count: int, ridge: np.ndarray) -> tuple[np.ndarray, Callable]:
    """Minimise |E c + W x - w|^2 + |ridge c|^2 over c for every x; `rows` are [E, W, w] with `count` columns of E.

    **Returns:** the rows [R, d] of the squared error that is left, |R x - d|^2, and the function from x to c.
    """
    prior = np.concatenate([np.diag(ridge), np.zeros((count, rows.shape[1] - count))], axis=1)
    R = triangle_of(np.concatenate([rows, prior]))

    def coefficients(x: np.ndarray) -> np.ndarray:
        rest = R[:count, -1] - R[:count, count:-1] @ x
        return np.linalg.solve(R[:count, :count], rest) if count else np.zeros(0)

    # Rows below the coefficients' do not involve c: they are the error of the best c.
    return R[count:, count:], coefficients


# Share of the variance above which the prior is the source of a number.
FROM_PRIOR = 0.5
# Share of the variance of a number, due to extra terms, above which it is confounded with these.
_FROM_EXTRA = 0.5
CONFOUNDED, STILL, UNDETERMINED = "confounded", "hardly moved", "undetermined"


class Spread(NamedTuple):
    """Numbers with uncertainty, all (n,): names, values, standard deviations, and the share of the variance from the prior.

    `marks` (n,): "confounded", "hardly moved" or "undetermined" where that makes a number's interval meaningless, else empty.
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
        - "bound": a term that the fit holds at zero, without a standard deviation (NaN);
        - "undetermined": neither data nor prior determine it, as the offset of a joint that moves in one direction (NaN too);
        - "confounded": most of its variance would vanish with the extra terms, or, for the coefficient of an extra term, most of
          the variance of another number with it;
        - "hardly moved": friction or rotor inertia of a joint that stood nearly still in all logs.
        """
        source = np.where(self.prior_share > FROM_PRIOR, "prior", "data")
        source = np.where(self.marks != "", self.marks, source)
        return np.where(np.isfinite(self.std) | (self.marks == UNDETERMINED), source, "bound").tolist()


class Intervals(NamedTuple):
    """Uncertainty of a feasible fit.

    - `parameters`: all of x in the order of `parameter_names`, then coefficients of extra terms. Terms that the fit holds at
      zero have no standard deviation (NaN).
    - `base`: the identifiable combinations of inertias and terms, and `combinations`, their definition.
    - `factor`: a 95 % interval is the value plus and minus this many standard deviations (Student's t, blocks - 1).
    - `widening` (nv,): factor of the scatter of each torque's errors, above 1 where these show that the model is wrong.
    - `omitted`: terms of `EXTRA`, with the index of a torque, that the logs support and the fit lacks. The intervals hold those
      of the fits with them.
    """

    parameters: Spread
    base: Spread
    combinations: BaseParameters
    base_covariance: np.ndarray
    factor: float
    widening: np.ndarray
    omitted: tuple[tuple[str, int], ...] = ()


def intervals(
    model: Model,
    data: Data,
    setting: Setting,
    estimate: Estimate,
    weights: np.ndarray,
    terms,
    size: float,
    widening: np.ndarray,
    curved: Data | None = None,
    still: Sequence[int] = (),
) -> Intervals:
    """Intervals of one fit of condensed logs.

    With D_b the data's curvature and g_b their gradient on block b, both over sigma^2, P the prior's curvature and H = sum
    D_b + P: leaving b out moves the fit by (H - D_b)^-1 g_b. Their covariance times (B - 1) is the data's share, and
    max(prior, 1) H^-1 P H^-1 the prior's. All in the coordinates of the chart, then carried over to x.

    `size`: effective sample size of the errors, which determines the length of the groups left out. `widening` (nv,): as of
    `Intervals`. `curved`: logs whose curvature counts, where the loss is not made of squares: Huber's has none beyond its
    threshold, though it has a gradient there. `still`: indices of the torques whose joints hardly moved.

    Source: Efron (1982), the jackknife; Cameron & Miller (2015), cluster-robust inference (CR3); Huber
    (1981), "Robust statistics", section 6.4, whose curvature is that of psi'; Kutner, Nachtsheim, Neter & Li (2005), "Applied
    linear statistical models", section 10.5, variance inflation.
    """
    jacobian, curvature, free = local_coordinates(data, setting, estimate)
    blocks, sigma = data.blocks, estimate.sigma
    # In the chart's coordinates, in which the prior's curvature is known and bounds are inactive or eliminated.
    # A score is quadratic in the weights: their roots make the scatter of a torque's errors larger by the factor itself.
    gradients = blocks.scores(estimate.x, weights * np.sqrt(widening)) @ jacobian / sigma**2
    grams_of_curvature = (data if curved is None else curved).blocks.grams(weights)
    grams = np.einsum("pi,bpq,qj->bij", jacobian, grams_of_curvature, jacobian, optimize=True) / sigma**2
    # Groups have no gradient along these directions either, so that the scatter would make their deviations zero.
    null = null_space(grams.sum(axis=0), curvature)
    # The prior is in every replicate: it is no observation that could be left out.
    changes, inverse, factor = jackknife(grams, gradients, curvature, size)
    # A prior weaker than 1 expresses no belief that the nominal bodies are better: at least weight 1 counts.
    changes, pulled = jacobian @ changes, jacobian @ inverse @ psd_root(curvature) * np.sqrt(max(setting.prior, 1.0))

    nb, nv = model.nb, model.nv
    names = list(parameter_names(model))
    for term, number in data.counts.items():
        for k in range(number):
            names += [f"{joint}.{term}{k + 1 if number > 1 else ''}" for joint in coordinate_names(model)]
    extra, places = data.places(setting.extra), np.arange(blocks.size)
    fitted = np.concatenate([free, np.zeros(blocks.size - len(free), bool)])
    fitted[extra] = True
    # Covariances of independent errors suffice for ratios of variances, and have less scatter than those of few groups.
    covariance = jacobian @ inverse @ jacobian.T
    # All terms, extra ones too, are vectors of nv numbers after the inertias.
    is_still = (places >= 10 * nb) & np.isin((places - 10 * nb) % nv, list(still))

    def describe(names, rows, known, is_still, is_confounded) -> Spread:
        """Spread of linear combinations `rows` (m, p) of the parameters."""
        is_lost = depends_on(rows @ jacobian, null) & ~is_still
        marks = np.select([is_lost, is_still, is_confounded], [UNDETERMINED, STILL, CONFOUNDED], "")
        from_data, from_prior = np.sum((rows @ changes) ** 2, axis=1), np.sum((rows @ pulled) ** 2, axis=1)
        total = from_data + from_prior
        # A number that no free coordinate changes keeps its nominal value, so that the prior is its source.
        share = np.where(total > 0, from_prior / np.where(total > 0, total, 1), 1.0)
        # NaN marks terms held at zero: at a bound there is no two-sided deviation.
        std = np.where(known & ~is_lost, np.sqrt(total), np.nan)
        return Spread(tuple(names), rows @ estimate.x, std, share, marks)

    # Torques determine combinations; single inertial numbers in them depend on the prior as well.
    base = base_parameters(model, terms)
    columns = free_columns(nb, nv, terms)
    combine = np.zeros((len(base), blocks.size))
    combine[:, columns] = base.matrix
    unit = np.eye(blocks.size)
    is_confounded = share_of_extra(unit, covariance, extra) > _FROM_EXTRA
    for place in extra:
        # The share of an extra coefficient in its own variance is 1: it counts by what it takes from the base parameters instead.
        is_confounded[place] = np.any(share_of_extra(combine, covariance, np.array([place])) > _FROM_EXTRA)
    shown = np.flatnonzero(fitted | (places < data.basic))
    marked = [x[shown] for x in (unit, fitted, is_still, is_confounded)]
    parameters = describe([names[i] for i in shown], *marked)
    fitted &= ~(depends_on(jacobian, null) & ~is_still)
    # By absolute values: parameters enter with both signs, and a sum over them can vanish where none is zero.
    enters = np.abs(base.matrix) > 1e-9 * np.abs(base.matrix).max(axis=1, keepdims=True)
    known = np.any(enters & fitted[columns], axis=1)
    is_confounded = share_of_extra(combine, covariance, extra) > _FROM_EXTRA
    combinations = describe(base.names, combine, known, is_still[columns[base.independent]], is_confounded)
    a, b = combine @ changes, combine @ pulled
    return Intervals(parameters, combinations, base, a @ a.T + b @ b.T, factor, widening)


def share_of_extra(rows: np.ndarray, covariance: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Shares (m,) of the variances of linear combinations `rows` (m, p) of the parameters that are due to extra terms.

    The share vanishes when the extra coefficients are held fixed: c E^-1 c^T / v for the variance v of a combination, its
    covariances c with the extra coefficients, and their covariance E. It is 1 - 1 / (variance inflation factor).
    """
    # Only the diagonal of rows covariance rows^T, without the (m, m) product.
    variance = np.einsum("ip,pq,iq->i", rows, covariance, rows)
    if not len(extra):
        return np.zeros(len(rows))
    # Coefficients of a term whose column is zero have no variance: the pseudo-inverse leaves them out.
    cross = rows @ covariance[:, extra]
    inverse = np.linalg.pinv(covariance[np.ix_(extra, extra)], hermitian=True)
    return np.einsum("ie,ef,if->i", cross, inverse, cross) / np.where(variance > 0, variance, np.inf)


def local_coordinates(data: Data, setting: Setting, estimate: Estimate):
    """Jacobian of x by the free coordinates, the prior's curvature in them, and a mask of the free basic parameters."""
    linear = estimate.chart
    derivatives = linear.jacobian(estimate.origin)
    count, size = len(estimate.origin), linear.count
    basis = LOG_CHOLESKY_BASIS[:size]
    # Hessian of the log-det divergence along straight lines in x, tr(S_k S_l) in the frame of the fitted body (`interior`).
    prior_curvature = setting.prior * np.kron(np.eye(count), np.einsum("kij,lji->kl", basis, basis))
    bodies = count * size
    is_free = np.ones(derivatives.shape[1], bool)
    # Terms at their bound stay there: the one-sided derivative is not that of a minimum.
    is_free[bodies:] = ~(linear.positive & (estimate.terms == 0))
    places = data.places(setting.extra)
    count = int(is_free.sum())
    jacobian = np.zeros((data.blocks.size, count + len(places)))
    jacobian[: data.basic, :count] = derivatives[:, is_free]
    jacobian[places, count + np.arange(len(places))] = 1.0
    curvature = np.zeros((jacobian.shape[1],) * 2)
    curvature[:bodies, :bodies] = prior_curvature
    # The coefficients' prior is prior / 2 (c / unit)^2, as in `condensed_fit`.
    units = data.units.reshape(-1)[places - data.basic]
    curvature[count + np.arange(len(places)), count + np.arange(len(places))] = setting.prior / units**2
    # A basic parameter is free where any coordinate changes it; massless bodies and terms at their bound have zero rows.
    return jacobian, curvature, np.any(jacobian[: data.basic] != 0, axis=1)
