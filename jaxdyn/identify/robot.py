"""A robot from one log or several: terms, prior and smoothing chosen by cross-validation, joints weighted by their noise."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.feasible import check_prior, signal_sizes
from jaxdyn.identify.friction import TERMS
from jaxdyn.identify.intervals import Intervals, intervals
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.one_fit import Data, Estimate, Setting, fit_condensed, gather
from jaxdyn.identify.regression import check_weights, regressor
from jaxdyn.identify.result import Fit
from jaxdyn.identify.selection import PRIORS, VELOCITIES, Choice, Search, folds, search
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


def fit_robot(
    model: Model,
    log: Log | Sequence[Log],
    terms: Any = "auto",
    *,
    v_s: float | str = "auto",
    prior: float | str = "auto",
    weights: Any = "auto",
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
    problem = _Problem(model, logs, basic, extra, inertia, blocks)
    fixed = None if isinstance(weights, str) and weights == "auto" else check_weights(weights, model.nv)
    setting = Setting(
        _V_S if isinstance(v_s, str) else float(v_s), where, _PRIOR if isinstance(prior, str) else float(prior)
    )
    problem.refine(setting, fixed, rounds=2 if extra or fixed is None else 1)
    trials, by = (), "given"
    if is_auto or isinstance(v_s, str) or isinstance(prior, str):
        parts, by = folds(problem.data(setting.v_s).blocks)
        trying = Search(problem.left_out, parts, problem.torque, callback)
        velocities = VELOCITIES if isinstance(v_s, str) else (setting.v_s,)
        priors = PRIORS if isinstance(prior, str) else (setting.prior,)
        names = [term.name for term in extra] if is_auto else []
        setting = search(trying, setting, names, model.nv, velocities=velocities, priors=priors)
        trials = tuple(trying.trials.values())
    estimate = problem.refine(setting, fixed, rounds=_ROUNDS if extra or fixed is None else 1)
    data = problem.data(setting.v_s)
    fit = problem.result(setting, estimate, data)
    spread = intervals(model, data, setting, estimate, problem.weights, basic)
    used = dict(setting.extra)
    chosen = (*basic, *((term, used[term.name]) for term in extra if term.name in used))
    return RobotFit(fit, problem.weights, Choice(setting, trials, by), spread, chosen)


class _Problem:
    """Logs, and what is brought up to date between fits: weights of the joints, and the torque that gears carry."""

    def __init__(self, model: Model, logs: tuple[Log, ...], basic, extra: tuple[TorqueTerm, ...], inertia, blocks: int):
        self.model, self.logs, self.basic, self.extra = model, logs, basic, extra
        self.inertia, self.blocks = inertia, blocks
        self.sizes, self.weights = signal_sizes(logs), np.ones(model.nv)
        self.loads = [np.zeros_like(np.asarray(log.tau, np.float64)) for log in logs]
        self.torque = float(sum(np.sum(np.asarray(log.tau, np.float64) ** 2) for log in logs))
        self._data: dict[float, Data] = {}
        self._rows: dict[tuple, np.ndarray] = {}

    def data(self, v_s: float) -> Data:
        """Condensed logs for one v_s."""
        if v_s not in self._data:
            self._data[v_s] = gather(self.model, self.logs, v_s, self.extra, self.loads, self.blocks)
        return self._data[v_s]

    def fit(self, setting: Setting, **options) -> Estimate:
        """One fit, of all blocks unless the options of `fit_condensed` say otherwise."""
        data = self.data(setting.v_s)
        return fit_condensed(
            self.model, data, setting, self.sizes, self.basic, self.weights, inertia=self.inertia, **options
        )

    def left_out(self, setting: Setting, part: np.ndarray) -> np.ndarray:
        """Squared errors (nv,) on some blocks, of a fit to the others. No more digits than the choice needs."""
        blocks, key = self.data(setting.v_s).blocks, (setting.v_s, tuple(part.tolist()))
        rest = np.setdiff1d(np.arange(len(blocks)), part)
        if key not in self._rows:
            self._rows[key] = np.asarray(np.linalg.qr(blocks.rows(self.weights, rest), mode="r"))
        fit = self.fit(setting, rows=self._rows[key], count=blocks.count(rest), is_rough=True)
        return blocks.squares(fit.x, part).sum(axis=0)

    def refine(self, setting: Setting, fixed: np.ndarray | None, rounds: int) -> Estimate:
        """Fit some times over; after each but the last, update weights and loads."""
        if fixed is not None:
            self.weights = fixed
        self._rows = {}
        for left in reversed(range(rounds)):
            estimate = self.fit(setting)
            if not left:
                return estimate
            if fixed is None:
                self.weights = self._new_weights(setting, estimate)
            if any(term.needs_load for term in self.extra):
                self.loads = [self._load(log, estimate.x) for log in self.logs]
                self._data = {}
        raise ValueError(f"rounds is {rounds}")

    def _new_weights(self, setting: Setting, estimate: Estimate) -> np.ndarray:
        blocks = self.data(setting.v_s).blocks
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
        model, friction = estimate.chart.fitted(self.model, estimate.point)
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
            history=estimate.history,
            result=estimate.result,
            method="torque fit by newton",
            terms=(*self.basic, *(term.name for term in terms)),
            sigma=estimate.sigma,
            extra=extra,
            as_measured=True,
        )
