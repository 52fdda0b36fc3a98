"""Feasible fit of condensed logs at a given setting, with exact elimination of extra torque terms.

The loss 1/2 |W x + E c - tau|^2 / sigma^2 + prior (D(x) + 1/2 sum (c / unit)^2) is quadratic in the coefficients c. The QR
factorisation of [E, W, tau] with the prior's rows under E leaves a triangle of x alone, whose loss is that of the best c for x.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.chart import Chart
from jaxdyn.identify.condensed import Blocks, condense_rows, pad_triangle
from jaxdyn.identify.feasible import torque_noise
from jaxdyn.identify.interior import LinearChart, Minimum, TorqueProblem, newton
from jaxdyn.identify.logs import Log, root_mean_square
from jaxdyn.identify.regression import condense_model, noise_level
from jaxdyn.identify.torque_terms import TorqueTerm, coulomb_through_filter, term_columns
from jaxdyn.model.tree import Model

# A unit of a coefficient makes this share of the joint's torque.
_UNIT = 0.1
# Tolerance on the loss of a fit, and of one that only compares settings.
_FINE, _ROUGH = 1e-6, 1e-2


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
    """Result of `fit_blocks`: all parameters x, the torque noise, and the minimum in the chart."""

    x: np.ndarray
    sigma: float
    chart: Chart
    minimum: Minimum


def gather(
    model: Model,
    logs: Sequence[Log],
    v_s: float,
    extra: Sequence[TorqueTerm],
    loads: Sequence[np.ndarray],
    blocks: int,
    weights: Sequence[np.ndarray] | None = None,
) -> Data:
    """Condense logs with the columns of extra terms; `loads` (n, nv) of each log is the torque of the rigid bodies.

    `weights` (n, nv) of each log: of single torques, ones by default.
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
    data = condense_model(model, logs, v_s=v_s, coulomb=coulomb, extra=columns, blocks=blocks, weights=weights)
    return Data(data, 10 * model.nb + 4 * model.nv, counts, units)


def fit_blocks(
    chart: Chart,
    start: np.ndarray,
    data: Data,
    setting: Setting,
    sizes,
    weights: np.ndarray,
    *,
    rows: np.ndarray | None = None,
    count: int | None = None,
    is_rough: bool = False,
    steps: int = 200,
) -> Estimate:
    """Fit all blocks, or those that `rows` and `count` of `Blocks` were given for; `is_rough` for a comparison of settings.

    `chart` and `start` (terms, nv) as of `make_chart`, `sizes` as of `signal_sizes`.
    """
    rows, size = data.blocks.rows(weights) if rows is None else rows, data.blocks.size
    count = data.blocks.count() if count is None else count
    places = data.places(setting.extra)
    kept = np.append(np.arange(data.basic), places)
    # Coefficients first, so that their elimination is the top of the triangle.
    free = condense_rows(rows[:, [*places, *range(data.basic), size]], count)
    spare = count - free.R.shape[1]
    # Dependent columns make this estimate a little too small, alike for all settings that are compared.
    sigma = np.sqrt(free.rest / spare) if is_rough and spare > 0 and free.rest > 0 else noise_level(free)
    rows = np.concatenate([free.R, free.d[:, None]], axis=1)
    # The residual of all columns is one more row, so that the eliminated triangle keeps the loss and not only its minimiser.
    rows = np.concatenate([rows, np.append(np.zeros(free.R.shape[1]), np.sqrt(free.rest))[None]])
    units = data.units.reshape(-1)[places - data.basic]
    # Rows are in N m here: the prior's rows, sqrt(prior) c / unit in deviations, are multiplied by sigma.
    R, coefficients = eliminate(rows, len(places), np.sqrt(setting.prior) * sigma / units)
    condensed = pad_triangle(R, count)
    # A noise-free log gives zero, which `torque_noise` replaces by a small share of the torque.
    sigma = torque_noise(condensed, sizes, sigma or None)
    problem = TorqueProblem(chart, condensed.R / sigma, condensed.d / sigma, condensed.rest / sigma**2, setting.prior)
    minimum = newton(problem, start, steps, _ROUGH if is_rough else _FINE)
    linear = LinearChart(chart)
    # Interior points never reach a bound. Exact zeros let `intervals` recognise the terms that are held there.
    minimum = minimum._replace(s=linear.clip_terms(minimum.s))
    x = np.zeros(size)
    basic = linear.at(minimum.origin, minimum.s)
    x[kept] = np.append(basic, coefficients(basic))
    return Estimate(x, sigma, chart, minimum)


def eliminate(rows: np.ndarray, count: int, ridge: np.ndarray) -> tuple[np.ndarray, Callable]:
    """Minimise |E c + W x - w|^2 + |ridge c|^2 over c for every x; `rows` are [E, W, w] with `count` columns of E.

    **Returns:** the rows [R, d] of the squared error that is left, |R x - d|^2, and the function from x to c.
    """
    prior = np.concatenate([np.diag(ridge), np.zeros((count, rows.shape[1] - count))], axis=1)
    R = np.asarray(np.linalg.qr(np.concatenate([rows, prior]), mode="r"))

    def coefficients(x: np.ndarray) -> np.ndarray:
        rest = R[:count, -1] - R[:count, count:-1] @ x
        return np.linalg.solve(R[:count, :count], rest) if count else np.zeros(0)

    # Rows below the coefficients' do not involve c: they are the error of the best c.
    return R[count:, count:], coefficients
