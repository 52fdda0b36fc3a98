"""Logs of a robot, and what its fits update in turn: weights of joints and samples, and loads of gears."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdyn.identify.condensed_fit import (
    MAX_ROUNDS,
    Data,
    Estimate,
    Intervals,
    Setting,
    fit_blocks,
    gather,
    intervals,
    is_negligible,
)
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.interior import robot_chart
from jaxdyn.identify.logs import Log, idle_coordinates, log_rate, signal_sizes
from jaxdyn.identify.regression import free_columns, log_regressor, nominal_parameters, parameter_names, triangle_of
from jaxdyn.identify.result import Fit, residuals
from jaxdyn.identify.selection import find_shifts, include_shifts
from jaxdyn.identify.torque_terms import TERMS, ExtraTorque, Friction, TorqueTerm, candidates
from jaxdyn.identify.uncertainty import effective_sample_size, is_white, model_error_factors
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene
from jaxdyn.tasks import Engine, results

# Share of errors beyond three standard deviations from which on their tails are heavy: 0.3 % of normal ones are, and of those of
# two recorded robots 5 to 15 % at some joint. Between, unresolved reversals of simulated friction make up to 4 %.
_TAIL = 0.04
# Fits of a half of the logs by a robust loss, each with weights of samples from the one before.
_WEIGHINGS = 3


class RobotLogs:
    """Logs of a robot, with the weights of joints and of samples and the loads of gears, which are updated between fits.

    A fit of them at a setting poses a `TorqueProblem`.
    """

    def __init__(self, model: Model, logs: tuple[Log, ...], basic, extra: tuple[TorqueTerm, ...], inertia, blocks: int):
        self.model, self.logs, self.basic, self.extra = model, logs, basic, extra
        self.inertia, self.blocks = inertia, blocks
        self.sample_weights: dict[float, list[np.ndarray]] = {}
        self.sizes, self.weights = signal_sizes(logs), np.ones(model.nv)
        self.still = idle_coordinates(model, logs)
        self.loads = [np.zeros_like(np.asarray(log.tau, np.float64)) for log in logs]
        self.torque = float(sum(np.sum(np.asarray(log.tau, np.float64) ** 2) for log in logs))
        # Caches: `_data` depends on loads and sample weights, `_rows` on joint weights too.
        self._data: dict[tuple, Data] = {}
        self._rows: dict[tuple, np.ndarray] = {}
        self.chart = robot_chart(model, basic, inertia, self.sizes)

    def data(self, setting: Setting) -> Data:
        """Condensed logs for the v_s and the loss of a setting."""
        weights = None if setting.robust is None else self.sample_weights.get(setting.robust)
        # Terms and prior are not in the key: all candidate columns are condensed, and the prior enters in the fit.
        key = setting.v_s, None if weights is None else setting.robust
        if key not in self._data:
            self._data[key] = self._gather(setting, weights)
        return self._data[key]

    def _gather(self, setting: Setting, weights, extra=None, loads=None) -> Data:
        extra, loads = self.extra if extra is None else extra, self.loads if loads is None else loads
        return gather(self.model, self.logs, setting.v_s, extra, loads, self.blocks, weights)

    def fit(self, setting: Setting, **options) -> Estimate:
        """Fit all blocks, unless `options` of `fit_blocks` select some."""
        return fit_blocks(self.chart, self.data(setting), setting, self.sizes, self.weights, **options)

    def validation_squares(self, setting: Setting, part: np.ndarray) -> np.ndarray:
        """Squared errors (blocks, nv) on some blocks, of a rough fit to the others.

        A robust loss takes the weights of samples from the first setting that needs them.
        """
        self.weigh_samples(setting)
        blocks, key = self.data(setting).blocks, (setting.v_s, setting.robust, tuple(part.tolist()))
        rest = np.setdiff1d(np.arange(len(blocks)), part)
        if key not in self._rows:
            # One triangle for each fold, shared by all settings that differ in terms and prior alone.
            self._rows[key] = triangle_of(blocks.rows(self.weights, rest))
        estimate = self.fit(setting, rows=self._rows[key], count=blocks.count(rest), is_rough=True)
        # All losses are scored by plain squares; weighted ones would favour the loss that ignores most samples.
        return self.data(setting._replace(robust=None)).blocks.squares(estimate.x, part)

    def loss_squares(self, setting: Setting, settings: Sequence[Setting]) -> list[np.ndarray] | None:
        """Squared errors (blocks, nv) of either half of the logs, of fits of the other half, for losses of their own.

        None where the errors of a setting have no heavy tails, and a robust loss is of no use. Weights of samples follow from the
        fitted half alone: from a fit to all samples they would pull it towards the half that is left out.
        """
        if not self.has_outliers(setting):
            return None
        halves = np.array_split(np.arange(len(self.data(setting).blocks)), 2)
        return [np.concatenate([self._half_squares(one, *pair) for pair in (halves, halves[::-1])]) for one in settings]

    def _half_squares(self, setting: Setting, part: np.ndarray, rest: np.ndarray) -> np.ndarray:
        plain = setting._replace(robust=None)
        data = fitted = self.data(plain)
        for remaining in reversed(range(1 if setting.robust is None else _WEIGHINGS)):
            rows, count = fitted.blocks.rows(self.weights, rest), data.blocks.count(rest)
            options = {"rows": rows, "count": count, "is_rough": True}
            estimate = fit_blocks(self.chart, fitted, plain, self.sizes, self.weights, **options)
            if remaining and setting.robust is not None:
                weights = huber_weights(self._errors(plain, estimate), setting.robust)
                fitted = self._gather(setting, weights)
        return data.blocks.squares(estimate.x, part)

    def weigh_samples(self, setting: Setting) -> None:
        """Find the weights of samples for the loss of a setting, unless they are known."""
        # Two fits are enough to compare settings, which share these weights; the fit that counts refines its own.
        if setting.robust is not None and setting.robust not in self.sample_weights:
            for _ in range(2):
                self._weigh(setting, self.fit(setting))

    def refine(self, setting: Setting, fixed: np.ndarray | None, rounds: int = MAX_ROUNDS) -> Estimate:
        """Fit and update weights and loads in turn, until the fit has settled.

        **Returns:** `Estimate`, whose result is `max_steps_reached` where the last of `rounds` fits has not settled.
        """
        if fixed is not None:
            self.weights = fixed
        # Factorised folds depend on the weights.
        self._rows = {}
        if not (self.extra or fixed is None or setting.robust is not None):
            return self.fit(setting)
        before = None
        for remaining in reversed(range(rounds)):
            rows = self.data(setting).blocks.rows(self.weights)
            estimate = self.fit(setting, rows=rows)
            if before is not None and is_negligible(rows[:, :-1], estimate.x - before, estimate.sigma):
                return estimate
            # No update after the last fit: intervals need the weights and loads that the estimate was made with.
            if not remaining:
                return estimate.give_up()
            before = estimate.x
            if fixed is None:
                self.weights = self._new_weights(setting, estimate)
            # Loads are torques of the fitted bodies, so columns that depend on them change with the fit.
            if any(term.needs_load for term in self.extra):
                self.loads = [self._load(log, estimate.x) for log in self.logs]
                self._data = {}
            if setting.robust is not None:
                self._weigh(setting, estimate)
        raise ValueError(f"rounds is {rounds}; give at least 1")

    def has_outliers(self, setting: Setting) -> bool:
        """Decide whether the errors of a least-squares fit have heavier tails than normal ones at any torque.

        A robust loss is of use only then.
        """
        plain = setting._replace(robust=None)
        errors = self._errors(plain, self.fit(plain))
        # Two and a half periods of the cut-off at each end hold what the filter made of the end of a log.
        ends = [0 if log.cutoff is None else int(2.5 * log_rate(log) / log.cutoff) for log in self.logs]
        errors = [x[end : len(x) - end] if len(x) > 4 * end else x for x, end in zip(errors, ends, strict=True)]
        return bool(np.mean(np.abs(np.concatenate(errors)) > 3 * error_scale(errors), axis=0).max() > _TAIL)

    def torques_not_white(self, setting: Setting) -> tuple[int, ...]:
        """Indices of the torques whose errors are not white, of joints that move: where another term may explain something."""
        errors = self._errors(setting, self.fit(setting))
        return tuple(int(j) for j in np.flatnonzero(~is_white(self.logs, errors)) if j not in self.still)

    def curvature_data(self, setting: Setting) -> Data | None:
        """Logs without the samples beyond the threshold of a robust loss, where it has no curvature."""
        weights = None if setting.robust is None else self.sample_weights.get(setting.robust)
        if weights is None:
            return None
        # psi' of Huber's loss: one within the threshold, zero beyond.
        kept = [np.where(weight < 1, 0.0, 1.0) for weight in weights]
        return self._gather(setting, kept)

    def intervals(self, setting: Setting, estimate: Estimate, fit: Fit, *, with_omitted: bool = True) -> Intervals:
        """Standard deviations of an estimate, which is this fit; `with_omitted`: including fits with terms that it lacks."""
        data, curved = self.data(setting), self.curvature_data(setting)
        errors = residuals(fit, self.logs)
        size, widening = effective_sample_size(errors), model_error_factors(self.logs, errors)
        found = intervals(
            self.model, data, setting, estimate, self.weights, self.basic, size, widening, curved, self.still
        )
        if not with_omitted:
            return found
        # Columns of the terms that the fit lacks, after its own.
        known = {term.name for term in self.extra}
        others = [term for term in candidates(self.model) if term.name not in known]
        if others:
            loads = [self._load(log, estimate.x) for log in self.logs]
            weights = None if setting.robust is None else self.sample_weights.get(setting.robust)
            data = self._gather(setting, weights, (*self.extra, *others), loads)
        shifts = find_shifts(data, setting, estimate, self.weights, size, self.still)
        fitted = {*range(data.basic), *data.places(setting.extra).tolist()}
        columns = free_columns(self.model.nb, self.model.nv, self.basic)
        return include_shifts(found, shifts, np.array(sorted(fitted)), columns)

    def with_term(self, term: TorqueTerm) -> "RobotLogs":
        """Copy with the columns of one more term, after all others."""
        wide = RobotLogs(self.model, self.logs, self.basic, (*self.extra, term), self.inertia, self.blocks)
        # Those of the fit: intervals are of the estimate that exists, not of a new one.
        wide.weights, wide.loads, wide.sample_weights = self.weights, self.loads, self.sample_weights
        return wide

    def _weigh(self, setting: Setting, estimate: Estimate) -> None:
        threshold = setting.robust
        assert threshold is not None
        errors = self._errors(setting, estimate)
        self.sample_weights[threshold] = huber_weights(errors, threshold)
        self._data = {key: data for key, data in self._data.items() if key[1] != threshold}
        self._rows = {key: rows for key, rows in self._rows.items() if key[1] != threshold}

    def _errors(self, setting: Setting, estimate: Estimate) -> list[np.ndarray]:
        return residuals(self.result(setting, estimate), self.logs)

    def _new_weights(self, setting: Setting, estimate: Estimate) -> np.ndarray:
        blocks = self.data(setting).blocks
        rms = np.sqrt(blocks.squares(estimate.x).sum(axis=0) / blocks.samples.sum())
        # A torque that is fitted exactly, or constant, would get an infinite weight; it gets a large finite one.
        weights = 1 / np.sqrt(np.maximum(rms, 1e-3 * rms.max(initial=0) or 1.0))
        # Only ratios matter to the fit; sigma has the level.
        return weights / weights.mean()

    def _load(self, log: Log, x: np.ndarray) -> np.ndarray:
        bodies = x[: 10 * self.model.nb + 4 * self.model.nv].copy()
        bodies[10 * self.model.nb : -self.model.nv] = 0  # all but the bodies and the rotors
        return log_regressor(self.model, log) @ bodies

    def result(self, setting: Setting, estimate: Estimate) -> Fit:
        """Estimate as a `Fit`."""
        data = self.data(setting)
        used = dict(setting.extra)
        coefficients = estimate.x[data.basic :].reshape(-1, self.model.nv)
        edges = dict(zip(data.counts, np.cumsum((0, *data.counts.values()))[:-1], strict=True))
        terms = tuple(term for term in self.extra if term.name in used)
        counts = tuple(data.counts[term.name] for term in terms)
        rows = [coefficients[edges[term.name] :][:count] for term, count in zip(terms, counts, strict=True)]
        extra = ExtraTorque(terms, counts, np.concatenate(rows), setting.v_s) if terms else None
        values = estimate.x[: data.basic]
        return Fit(
            system=scene_with_parameters(self.model, values, self.basic, setting.v_s),
            nominal=self.model,
            names=parameter_names(self.model),
            values=values,
            nominal_values=nominal_parameters(self.model),
            history=estimate.history,
            result=estimate.result,
            method="torque fit by newton",
            terms=(*self.basic, *(term.name for term in terms)),
            sigma=estimate.sigma,
            extra=extra,
            as_measured=True,
        )


class _Folds(NamedTuple):
    """The fits of a cross-validation as tasks."""

    problem: RobotLogs

    @on_one_thread
    def squares(self, pair: tuple[Setting, np.ndarray]) -> np.ndarray:
        """Squared errors on some blocks of a fit to the others."""
        return self.problem.validation_squares(*pair)


def cross_validation(problem: RobotLogs, engine: Engine) -> Callable:
    """Function from pairs of a setting and left-out blocks to the squared errors of these, by an engine of tasks."""
    sent = None

    def squares(pairs: list[tuple[Setting, np.ndarray]]) -> Iterator[np.ndarray]:
        nonlocal sent
        # Weights of samples are those of the first setting with its loss: found here, so that they do not depend on the worker.
        for setting, _ in pairs:
            problem.weigh_samples(setting)
        # Workers hold a copy of the problem: it is sent again only when it has new weights of samples.
        if sent != (sent := tuple(problem.sample_weights)):
            engine.send(partial(_Folds, problem))
        return results(engine, "squares", pairs)

    return squares


def scene_with_parameters(model: Model, x: np.ndarray, terms, v_s: float) -> Scene:
    """Scene of a model with the parameters x (10 nb + 4 nv,), whose force is the friction law with its offset."""
    dtype, split = model.home.dtype, 10 * model.nb
    viscous, coulomb, offset, armature = jnp.asarray(x[split:].reshape(len(TERMS), model.nv), dtype)
    # A leaf that is absent and not fitted stays absent, so that no program compiles it.
    model = model.replace(
        inertias=jnp.asarray(x[:split].reshape(model.nb, 10), dtype),
        armature=None if model.armature is None and "armature" not in terms else armature,
        damping=None if model.damping is None and "viscous" not in terms else viscous,
        friction=None if model.friction is None and "coulomb" not in terms else coulomb,
    )
    return Scene(model, forces=(Friction(viscous, coulomb, offset, jnp.asarray(v_s, dtype)),))


def huber_weights(errors: Sequence[np.ndarray], threshold: float) -> list[np.ndarray]:
    """Weights (n, nv) of each log's torques whose squares make Huber's loss: sqrt(min(1, threshold scale / |error|))."""
    scale = error_scale(errors)
    # The scale is zero where most errors are exactly zero: no sample is then down-weighted.
    limit = threshold * np.where(scale > 0, scale, np.inf)
    return [np.sqrt(np.where(np.abs(x) > limit, limit / np.maximum(np.abs(x), 1e-300), 1.0)) for x in errors]


def error_scale(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Scale (nv,) of each torque's errors: 1.4826 times their median size, the standard deviation of normal ones."""
    # A standard deviation would grow with the outliers that it is to detect. 1 / 1.4826 is the normal distribution's quartile.
    return 1.4826 * np.median(np.abs(np.concatenate(errors)), axis=0)
