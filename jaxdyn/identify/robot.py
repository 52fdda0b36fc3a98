"""A robot from one log or several: terms, prior and smoothing chosen by cross-validation, joints weighted by their noise."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxdyn.identify.chart import Chart, check_bodies, make_chart
from jaxdyn.identify.feasible import check_prior, placed, signal_sizes
from jaxdyn.identify.friction import TERMS
from jaxdyn.identify.intervals import Intervals, intervals
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.one_fit import Data, Estimate, Setting, fit_condensed, gather
from jaxdyn.identify.regression import check_weights, regressor
from jaxdyn.identify.result import Fit
from jaxdyn.identify.selection import PRIORS, ROBUST, VELOCITIES, Choice, Search, folds, search
from jaxdyn.identify.threads import on_one_thread
from jaxdyn.identify.torque_terms import EXTRA, ExtraTorque, TorqueTerm, split_terms
from jaxdyn.model.tree import Model

_BLOCKS = 20
# Fits in which weights of the joints, and the torque that gears carry, are brought up to date.
_ROUNDS = 3
_V_S, _PRIOR = 0.01, 1.0


class RobotFit(eqx.Module):
    """Result of `fit_robot`.

    - `fit`: the `Fit`, on all logs: model, friction, extra torques, `torques(log)`, `error(log)`.
    - `weights` (nv,): of each torque, one over the root mean square of its residual, of mean one; ones where not fitted.
    - `choice`: the setting (v_s, extra terms of which joints, prior) and what was tried; no trials where all was given.
    - `intervals`: standard deviations of all parameters and of the base parameters, each from the data or from the prior.
    - `terms`: those of the fit, extra ones with the numbers of their torques, as `fit_robot` takes them.
    """

    fit: Fit
    weights: np.ndarray
    choice: Choice
    intervals: Intervals
    terms: tuple


@on_one_thread()
def fit_robot(
    model: Model,
    log: Log | Sequence[Log],
    terms: Any = "auto",
    *,
    v_s: float | str = "auto",
    prior: float | str = "auto",
    weights: Any = "auto",
    robust: float | str | None = "auto",
    inertia: str = "full",
    blocks: int = _BLOCKS,
    callback: Callable | None = None,
) -> RobotFit:
    """Physically feasible inertias, friction, rotor inertia and further torque terms, as a laboratory would fit them.

    The loss is that of `fit_torques`, with extra terms whose coefficients have a prior of the same weight: one unit of it is
    the coefficient that makes a tenth of the joint's torque. What is "auto" is chosen by cross-validation, over logs if there
    are three or more, else over parts of consecutive samples; then all logs are fitted together.

    **Arguments:**

    - `model`: nominal model, where the fit starts. `log`: one log or several with v and a; they may differ in sampling, and
      nothing is filtered, differenced or remembered from one to the next.
    - `terms`: names of `TERMS` and of `EXTRA`, and `TorqueTerm`s, or pairs of an extra term and the numbers of the torques that
      have it; or "auto": all of `TERMS`, and of `EXTRA` what helps, joint
      by joint. Springs and pre-sliding need joints with one coordinate each.
    - `v_s`: smoothing velocity of Coulomb friction (rad/s, m/s), or "auto".
    - `prior`: its weight, or "auto". `weights` (nv,): one over the noise of each torque, None for ones, or "auto": one over the
      root mean square of the residual, iterated.
    - `robust`: errors beyond this many standard deviations of their joint's count by their size instead of its square (Huber's
      loss): what no term explains and collisions then bend the fit less. None: all by their square; "auto": what foretells
      left-out parts best, in squares, of these two and of 3 and 1.345.
    - `inertia`: as in `fit_torques`.
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the intervals.
    - `callback(trial)` is called after each setting tried, with a `jaxdyn.identify.selection.Trial`.

    **Returns:** `RobotFit`.

    **Raises:** ValueError as `fit_torques`, and for unknown terms.

    Source: Stone (1974), cross-validation; Holland & Welsch (1977), iteratively reweighted least squares; and those of
    `fit_torques`.
    """
    check_bodies(model)
    logs = as_logs(log, model)
    is_auto = isinstance(terms, str) and terms == "auto"
    candidates = [term for term in EXTRA.values() if model.nq == model.nv or term.name not in ("spring", "dahl")]
    basic, extra, where = (TERMS, tuple(candidates), ()) if is_auto else split_terms(terms, model.nv)
    for name, value in (("v_s", v_s), ("prior", prior)):
        if isinstance(value, str) and value != "auto":
            raise ValueError(f'{name} is {value!r}; give a positive number or "auto"')
    if not isinstance(prior, str):
        check_prior(prior)
    if blocks < 2:
        raise ValueError(f"blocks is {blocks}; give at least 2")
    if robust not in (None, "auto") and (isinstance(robust, str) or not robust > 0):
        raise ValueError(f'robust is {robust!r}; give a positive number of standard deviations, None or "auto"')
    problem = _Problem(model, logs, basic, extra, inertia, blocks)
    fixed = None if isinstance(weights, str) and weights == "auto" else check_weights(weights, model.nv)
    setting = Setting(
        _V_S if isinstance(v_s, str) else float(v_s),
        where,
        _PRIOR if isinstance(prior, str) else float(prior),
        None if robust is None or isinstance(robust, str) else float(robust),
    )
    problem.refine(setting, fixed, rounds=2)
    trials, by = (), "given"
    if is_auto or any(isinstance(value, str) for value in (v_s, prior, robust)):
        parts, by = folds(problem.data(setting).blocks)
        trying = Search(problem.left_out, parts, problem.torque, callback)
        velocities = VELOCITIES if isinstance(v_s, str) else (setting.v_s,)
        priors = PRIORS if isinstance(prior, str) else (setting.prior,)
        names = [term.name for term in extra] if is_auto else []
        losses = ROBUST if isinstance(robust, str) else (setting.robust,)
        setting = search(trying, setting, names, model.nv, velocities=velocities, priors=priors, losses=losses)
        trials = tuple(trying.trials.values())
    estimate = problem.refine(setting, fixed, rounds=_ROUNDS)
    data = problem.data(setting)
    fit = problem.result(setting, estimate, data)
    spread = intervals(model, data, setting, estimate, problem.weights, basic, problem.curved(setting))
    used = dict(setting.extra)
    chosen = (*basic, *((term, used[term.name]) for term in extra if term.name in used))
    return RobotFit(fit, problem.weights, Choice(setting, trials, by), spread, chosen)


class _Problem:
    """Logs, and what is brought up to date between fits: weights of joints and of single torques, torques that gears carry."""

    def __init__(self, model: Model, logs: tuple[Log, ...], basic, extra: tuple[TorqueTerm, ...], inertia, blocks: int):
        self.model, self.logs, self.basic, self.extra = model, logs, basic, extra
        self.inertia, self.blocks = inertia, blocks
        self.sample_weights: dict[float, list[np.ndarray]] = {}
        self.sizes, self.weights = signal_sizes(logs), np.ones(model.nv)
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
        """Squared errors (nv,) on some blocks, of a fit to the others. No more digits than the choice needs.

        A robust loss takes the weights of single torques from the first setting that asks for it.
        """
        if setting.robust is not None and setting.robust not in self.sample_weights:
            self.reweigh(setting)
        blocks, key = self.data(setting).blocks, (setting.v_s, setting.robust, tuple(part.tolist()))
        rest = np.setdiff1d(np.arange(len(blocks)), part)
        if key not in self._rows:
            self._rows[key] = np.asarray(np.linalg.qr(blocks.rows(self.weights, rest), mode="r"))
        fit = self.fit(setting, rows=self._rows[key], count=blocks.count(rest), is_rough=True)
        return self.data(setting._replace(robust=None)).blocks.squares(fit.x, part).sum(axis=0)

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
        return regressor(self.model, log.q, log.v, log.a) @ bodies

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
