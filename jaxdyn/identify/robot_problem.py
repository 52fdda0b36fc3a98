"""The logs of a robot's fit, and what is brought up to date between fits."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.identify.chart import Chart, make_chart
from jaxdyn.identify.feasible import placed, signal_sizes
from jaxdyn.identify.intervals import Intervals, intervals
from jaxdyn.identify.log_checks import hardly_moving
from jaxdyn.identify.logs import Log
from jaxdyn.identify.one_fit import Data, Estimate, Setting, fit_condensed, gather
from jaxdyn.identify.regression import log_regressor
from jaxdyn.identify.result import Fit
from jaxdyn.identify.torque_terms import ExtraTorque, TorqueTerm
from jaxdyn.identify.whiteness import stretches
from jaxdyn.model.tree import Model


class RobotProblem:
    """Logs, and what is brought up to date between fits: weights of joints and of single torques, torques that gears carry."""

    def __init__(self, model: Model, logs: tuple[Log, ...], basic, extra: tuple[TorqueTerm, ...], inertia, blocks: int):
        self.model, self.logs, self.basic, self.extra = model, logs, basic, extra
        self.inertia, self.blocks = inertia, blocks
        self.sample_weights: dict[float, list[np.ndarray]] = {}
        self.sizes, self.weights = signal_sizes(logs), np.ones(model.nv)
        self.still = hardly_moving(model, logs)
        self.loads = [np.zeros_like(np.asarray(log.tau, np.float64)) for log in logs]
        self.torque = float(sum(np.sum(np.asarray(log.tau, np.float64) ** 2) for log in logs))
        self._data: dict[tuple, Data] = {}
        self._rows: dict[tuple, np.ndarray] = {}
        self._charts: dict[float, tuple[Chart, np.ndarray]] = {}

    def data(self, setting: Setting) -> Data:
        """Condensed logs for the v_s and the loss of a setting."""
        weights = None if setting.robust is None else self.sample_weights.get(setting.robust)
        key = setting.v_s, None if weights is None else setting.robust
        if key not in self._data:
            self._data[key] = gather(self.model, self.logs, setting.v_s, self.extra, self.loads, self.blocks, weights)
        return self._data[key]

    def fit(self, setting: Setting, **options) -> Estimate:
        """One fit, of all blocks unless the options of `fit_condensed` say otherwise."""
        v_s, data = setting.v_s, self.data(setting)
        if v_s not in self._charts:
            chart, point = make_chart(self.model, self.basic, v_s, self.inertia, *self.sizes)
            self._charts[v_s] = chart, np.asarray(point.s, np.float64)
        chart, start = self._charts[v_s]
        return fit_condensed(chart, start, data, setting, self.sizes, self.weights, **options)

    def left_out(self, setting: Setting, part: np.ndarray) -> np.ndarray:
        """Squared errors (blocks, nv) on some blocks, of a fit to the others. No more digits than the choice needs.

        A robust loss takes the weights of single torques from the first setting that asks for it.
        """
        if setting.robust is not None and setting.robust not in self.sample_weights:
            self.reweigh(setting)
        blocks, key = self.data(setting).blocks, (setting.v_s, setting.robust, tuple(part.tolist()))
        rest = np.setdiff1d(np.arange(len(blocks)), part)
        if key not in self._rows:
            self._rows[key] = np.asarray(np.linalg.qr(blocks.rows(self.weights, rest), mode="r"))
        estimate = self.fit(setting, rows=self._rows[key], count=blocks.count(rest), is_rough=True)
        return self.data(setting._replace(robust=None)).blocks.squares(estimate.x, part)

    def refine(self, setting: Setting, fixed: np.ndarray | None, rounds: int) -> Estimate:
        """Fit some times over; after each but the last, update weights and loads."""
        if fixed is not None:
            self.weights = fixed
        self._rows = {}
        is_iterated = bool(self.extra) or fixed is None or setting.robust is not None
        for left in reversed(range(rounds if is_iterated else 1)):
            estimate = self.fit(setting)
            if not left:
                return estimate
            if fixed is None:
                self.weights = self._new_weights(setting, estimate)
            if any(term.needs_load for term in self.extra):
                self.loads = [self._load(log, estimate.x) for log in self.logs]
                self._data = {}
            if setting.robust is not None:
                self._weigh(setting, estimate)
        raise ValueError(f"rounds is {rounds}")

    def reweigh(self, setting: Setting, rounds: int = 2) -> None:
        """Bring the weights of single torques up to date for a setting with a robust loss."""
        for _ in range(rounds):
            self._weigh(setting, self.fit(setting))

    def curved(self, setting: Setting) -> Data | None:
        """The logs without the torques beyond the threshold of a robust loss, where it has no curvature."""
        weights = None if setting.robust is None else self.sample_weights.get(setting.robust)
        if weights is None:
            return None
        kept = [np.where(weight < 1, 0.0, 1.0) for weight in weights]
        return gather(self.model, self.logs, setting.v_s, self.extra, self.loads, self.blocks, kept)

    def intervals(self, setting: Setting, estimate: Estimate, fit: Fit) -> Intervals:
        """Standard deviations of an estimate, which is this fit."""
        data, curved = self.data(setting), self.curved(setting)
        worth = stretches([fit.torques(log) - np.asarray(log.tau, np.float64) for log in self.logs])
        return intervals(self.model, data, setting, estimate, self.weights, self.basic, worth, curved, self.still)

    def with_term(self, term: TorqueTerm) -> "RobotProblem":
        """The same logs and weights with the columns of one more term, behind all others."""
        wide = RobotProblem(self.model, self.logs, self.basic, (*self.extra, term), self.inertia, self.blocks)
        wide.weights, wide.loads, wide.sample_weights = self.weights, self.loads, self.sample_weights
        return wide

    def _weigh(self, setting: Setting, estimate: Estimate) -> None:
        fit, threshold = self.result(setting, estimate, self.data(setting)), setting.robust
        assert threshold is not None
        errors = [fit.torques(log) - np.asarray(log.tau, np.float64) for log in self.logs]
        self.sample_weights[threshold] = huber_weights(errors, threshold)
        self._data = {key: data for key, data in self._data.items() if key[1] != threshold}
        self._rows = {key: rows for key, rows in self._rows.items() if key[1] != threshold}

    def _new_weights(self, setting: Setting, estimate: Estimate) -> np.ndarray:
        blocks = self.data(setting).blocks
        rms = np.sqrt(blocks.squares(estimate.x).sum(axis=0) / blocks.samples.sum())
        # A torque that is fitted exactly, or never moved, gets the largest weight of the others, not an infinite one.
        weights = 1 / np.maximum(rms, 1e-3 * rms.max(initial=0) or 1.0)
        return weights / weights.mean()

    def _load(self, log: Log, x: np.ndarray) -> np.ndarray:
        bodies = x[: 10 * self.model.nb + 4 * self.model.nv].copy()
        bodies[10 * self.model.nb : -self.model.nv] = 0  # all but the bodies and the rotors
        return log_regressor(self.model, log) @ bodies

    def result(self, setting: Setting, estimate: Estimate, data: Data) -> Fit:
        """The fit as others are given."""
        chart, point = placed(estimate.chart, estimate.minimum.origin, estimate.minimum.s)
        model, friction = chart.fitted(self.model, point)
        used = dict(setting.extra)
        coefficients = estimate.x[data.basic :].reshape(-1, self.model.nv)
        edges = dict(zip(data.counts, np.cumsum((0, *data.counts.values()))[:-1], strict=True))
        terms = tuple(term for term in self.extra if term.name in used)
        counts = tuple(data.counts[term.name] for term in terms)
        rows = [coefficients[edges[term.name] :][:count] for term, count in zip(terms, counts, strict=True)]
        extra = ExtraTorque(terms, counts, np.concatenate(rows), setting.v_s) if terms else None
        return Fit(
            model=model,
            friction=friction,
            nominal=self.model,
            history=estimate.minimum.history,
            result=estimate.minimum.result,
            method="torque fit by newton",
            terms=(*self.basic, *(term.name for term in terms)),
            sigma=estimate.sigma,
            extra=extra,
            as_measured=True,
        )


def huber_weights(errors: Sequence[np.ndarray], threshold: float) -> list[np.ndarray]:
    """Weights (n, nv) of each log's torques whose squares make Huber's loss: sqrt(min(1, threshold scale / |error|)).

    The scale of each torque is 1.4826 times the median size of its errors over all logs, which is the standard deviation of
    normal ones.
    """
    scale = 1.4826 * np.median(np.abs(np.concatenate(errors)), axis=0)
    limit = threshold * np.where(scale > 0, scale, np.inf)
    return [np.sqrt(np.where(np.abs(x) > limit, limit / np.maximum(np.abs(x), 1e-300), 1.0)) for x in errors]
