"""A robot from several logs: terms, prior and smoothing chosen by cross-validation, joints weighted by their noise."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.identify.condensed import Blocks, Condensed, condensed_rows
from jaxdyn.identify.feasible import make_problem, newton, signal_sizes
from jaxdyn.identify.regression import condense_model, noise_level
from jaxdyn.identify.torque_terms import ExtraTorque, TorqueTerm, term_columns


class Setting(NamedTuple):
    """What a fit is told, besides the logs: smoothing velocity, extra terms by name, weight of the priors."""

    v_s: float
    extra: tuple[str, ...]
    prior: float


class Estimate(NamedTuple):
    """x (10 nb + 4 nv + k nv,) of one fit, its noise and how it was found."""

    x: np.ndarray
    sigma: float
    chart: Any
    point: Any
    history: np.ndarray
    result: str


class Data(NamedTuple):
    """Condensed logs for one v_s, with columns of all extra terms that may be chosen."""

    blocks: Blocks
    basic: int
    counts: dict[str, int]
    units: np.ndarray  # (k, nv), coefficient of each extra column that makes a tenth of the torque

    def extra_places(self, names) -> np.ndarray:
        """Positions in x of the extra terms named."""
        nv, start, result = self.blocks.nv, self.basic, []
        for name, count in self.counts.items():
            if name in names:
                result.append(start + np.arange(count * nv))
            start += count * nv
        return np.concatenate([np.zeros(0, int), *result])


def gather(model, logs, v_s, extra: Sequence[TorqueTerm], loads, blocks: int) -> Data:
    columns = [[term(log, load, v_s) for term in extra] for log, load in zip(logs, loads, strict=True)]
    counts = {term.name: part.shape[2] for term, part in zip(extra, columns[0], strict=True)}
    joined = [
        np.concatenate([np.zeros((len(log), log.nv, 0)), *parts], axis=2)
        for log, parts in zip(logs, columns, strict=True)
    ]
    data = condense_model(model, logs, v_s=v_s, extra=joined, blocks=blocks)
    torque = np.sqrt(np.mean(np.concatenate([np.asarray(log.tau) for log in logs]) ** 2, axis=0))
    size = np.sqrt(np.mean(np.concatenate(joined) ** 2, axis=0)).T
    units = 0.1 * torque / np.where(size > 0, size, np.inf)
    return Data(data, 10 * model.nb + 4 * model.nv, counts, units)


def eliminate(rows, places, ridge):
    """rows [W, w] with columns at `places` eliminated: Condensed of the others, and a function from x to theirs."""
    p = rows.shape[1] - 1
    others = np.setdiff1d(np.arange(p), places)
    e = len(places)
    table = np.concatenate([rows[:, places], rows[:, others], rows[:, p:]], axis=1)
    table = np.concatenate([table, np.concatenate([np.diag(ridge), np.zeros((e, len(others) + 1))], axis=1)])
    R = np.linalg.qr(table, mode="r")

    def back(x):
        return np.linalg.solve(R[:e, :e], R[:e, -1] - R[:e, e:-1] @ x) if e else np.zeros(0)

    return R[e:, e:], back


def estimate(
    model,
    data: Data,
    setting: Setting,
    sizes,
    terms,
    weights,
    *,
    chosen=None,
    inertia="full",
    tolerance=1e-6,
    steps=200,
    callback=None,
):
    rows = data.blocks.rows(weights, chosen)
    p = data.blocks.size
    places = data.extra_places(setting.extra)
    dropped = np.setdiff1d(np.arange(data.basic, p), places)
    kept = np.setdiff1d(np.arange(p + 1), dropped)
    count = data.blocks.count(chosen)
    free = condensed_rows(rows[:, kept], count)
    sigma = noise_level(free)
    units = data.units.reshape(-1)[places - data.basic]
    inner = np.searchsorted(kept, places)
    R, back = eliminate(rows[:, kept], inner, np.sqrt(setting.prior) * sigma / units)
    condensed = condensed_rows(R, count)
    problem, point, sigma = make_problem(model, condensed, sizes, terms, setting.v_s, inertia, setting.prior, sigma)
    chart, point, history, result = newton(model, problem, point, steps, tolerance, callback)
    point = chart.settled(point)
    x = np.zeros(p)
    x[: data.basic] = np.asarray(chart.parameters(point), np.float64)
    x[places] = back(x[: data.basic])
    return Estimate(x, sigma, chart, point, history, result)
