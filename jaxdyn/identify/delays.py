"""Delays between the signals of positions and of torques, fitted together with the robot's parameters.

A torque T recorded late by d is tau(t) = T(t - d), to first order T - d dT/dt: one column for each joint, with d its coefficient,
whose interval follows like any other. The logs are then shifted by d and fitted again, until the shifts vanish.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.condensed_fit import Estimate, Intervals, Setting
from jaxdyn.identify.logs import Log
from jaxdyn.identify.result import Fit
from jaxdyn.identify.robot_problem import RobotProblem
from jaxdyn.identify.selection import improving_torques, splits
from jaxdyn.identify.torque_terms import TorqueTerm
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.tree import Model

# Smallest shift (s) that counts, largest shift of one step, and most steps.
_SMALL, _STEP, _ROUNDS = 1e-6, 0.03, 12
# Share of a standard deviation that the last step may be.
_SETTLED = 0.1


class Delays(NamedTuple):
    """Delays of the torques of a robot's logs against its positions.

    - `seconds` (nv,): delays, negative where torques come early; zero where a delay lowers no error.
    - `std` (nv,): standard deviations by blocks of samples, as in `Intervals`; `factor`: a 95 % interval is plus and minus this
      many of them. A given delay has an infinite std.
    - `squares`: squared errors (folds, nv) of folds left out in turn, without the delays and with them; None for given ones.
    """

    seconds: np.ndarray
    std: np.ndarray
    factor: float
    squares: tuple[np.ndarray, np.ndarray] | None = None


def shift_torques(log: Log, delay: Numbers) -> Log:
    """Shift the torques of a log: they become those recorded `delay` later (s), a number or one for each torque (nv,).

    The torques are interpolated by cubic splines; samples whose torque lies beyond the ends of the log are dropped. Splines
    hardly change a log that was low-passed (`from_raw`): with 15 samples to a period of the cut-off the
    error there is 4e-4 of the amplitude.

    **Raises:** ValueError for delays of another shape, that are not finite, or longer than the log.
    """
    from scipy.interpolate import CubicSpline

    delay = np.asarray(delay, np.float64)
    if delay.shape not in ((), (log.nv,)) or not np.isfinite(delay).all():
        raise ValueError(f"delay is {delay.tolist()}; give a number of seconds, or one for each of {log.nv} torques")
    if not delay.any():
        return log
    delay = np.broadcast_to(delay, (log.nv,))
    t, tau = np.asarray(log.t, np.float64), np.asarray(log.tau, np.float64)
    # Beyond the ends of the log a cubic spline extrapolates, and grows without bound.
    kept = (t + delay.min() >= t[0]) & (t + delay.max() <= t[-1])
    if kept.sum() < 2:
        raise ValueError(f"delay is {delay.tolist()} s, and the log {t[-1] - t[0]:.4g} s long; nothing is left of it")
    (inside,) = np.nonzero(kept)
    # Time increases, so that the kept samples are consecutive.
    rows = slice(int(inside[0]), int(inside[-1]) + 1)
    shifted = [CubicSpline(t, column)(t[rows] + d) for column, d in zip(tau.T, delay, strict=True)]
    return dataclasses.replace(log[rows], tau=np.stack(shifted, axis=1))


def find_delays(
    model: Model,
    logs: Sequence[Log],
    setting: Setting,
    start: np.ndarray,
    *,
    basic,
    extra: Sequence[TorqueTerm],
    fixed: np.ndarray | None,
    inertia: str,
    blocks: int,
) -> Delays:
    """Fit the delays of all torques at a setting, from a first guess `start` (nv,); the other arguments as of `RobotProblem`.

    **Raises:** ValueError where the shifts do not converge, as for delays longer than the fastest reversals of the motion.
    """
    used = tuple(term for term in extra if term.name in dict(setting.extra))
    every = tuple(range(model.nv))
    free = setting._replace(extra=(*setting.extra, (_DELAY.name, every)))
    delay = np.array(start, np.float64)
    for _ in range(_ROUNDS):
        problem = RobotProblem(model, _shift_logs(logs, delay), basic, (*used, _DELAY), inertia, blocks)
        estimate = problem.refine(free, fixed, rounds=2)
        data = problem.data(free)
        # Coefficients are stored column after column, nv each; the delay's column comes after those of the other terms.
        column = sum(count for name, count in data.counts.items() if name != _DELAY.name)
        step = estimate.x[data.basic + column * model.nv :][: model.nv]
        if np.abs(step).max(initial=0) < _SMALL:
            break
        # The first-order model holds for shifts that are short against the motion's reversals: longer steps are cut.
        delay = delay + np.clip(step, -_STEP, _STEP)
    spread = problem.intervals(free, estimate, problem.result(free, estimate), with_omitted=False)
    std = spread.parameters.std[-model.nv :]
    # Changing weights of a robust loss may keep the steps from shrinking below a small share of the standard deviation.
    if np.any(np.abs(step) >= np.maximum(_SMALL, _SETTLED * std)):
        raise ValueError(
            f"delays do not converge; the last ones are {np.round(delay, 4).tolist()} s. Give them as numbers, or choose a "
            "lower cut-off"
        )
    # A delay must improve the prediction of left-out blocks. Its own column is made of the measured torque and would give it
    # away: shifted logs are compared instead.
    squares = []
    for shift in (np.zeros(model.nv), delay):
        problem = RobotProblem(model, _shift_logs(logs, shift), basic, used, inertia, blocks)
        # A new problem has weights of ones and no loads: folds of shifted logs are compared with weights of their own.
        problem.refine(setting, fixed, rounds=2)
        parts, _ = splits(problem.data(setting).blocks)
        squares.append(np.array([problem.validation_squares(setting, part).sum(axis=0) for part in parts]))
    kept = np.isin(every, improving_torques(squares[0], squares[1], least=0.0))
    return Delays(np.where(kept, delay, 0.0), std, spread.factor, (squares[0], squares[1]))


def with_delays(
    problem: RobotProblem, setting: Setting, estimate: Estimate, fit: Fit, delays: Delays
) -> tuple[Intervals, Delays]:
    """Intervals of a fit to shifted logs in which delays are unknowns like all others, and the delays with theirs.

    A delay's column is the time derivative of the predicted torque, without the noise of the measured one. Terms that are
    correlated with it, viscous friction above all, get wider intervals. Delays that lower no error are zero.
    """
    kept = tuple(int(joint) for joint in np.flatnonzero(delays.seconds))
    # Keyed by identity: the term is called with the problem's own logs, because it is smooth.
    derivatives = {
        id(log): -np.gradient(fit.torques(log), np.asarray(log.t, np.float64), axis=0) for log in problem.logs
    }
    term = TorqueTerm(_DELAY.name, lambda log, load, v_s: derivatives[id(log)], is_smooth=True)
    wide = problem.with_term(term)
    free = setting._replace(extra=(*setting.extra, (term.name, kept)))
    # The logs are shifted already: the delay's coefficient is zero, where the linearisation of T(t - d) is exact.
    spread = wide.intervals(free, estimate._replace(x=np.append(estimate.x, np.zeros(problem.model.nv))), fit)
    values, std = spread.parameters.values.copy(), delays.std.copy()
    values[len(values) - len(kept) :] = delays.seconds[list(kept)]
    std[list(kept)] = spread.parameters.std[len(values) - len(kept) :]
    return spread._replace(parameters=spread.parameters._replace(values=values)), delays._replace(std=std)


def _shift_logs(logs: Sequence[Log], delay: np.ndarray) -> tuple[Log, ...]:
    return tuple(shift_torques(log, delay) for log in logs)


def _negative_derivative(log: Log, load: np.ndarray, v_s: float) -> np.ndarray:
    return -np.gradient(np.asarray(log.tau, np.float64), np.asarray(log.t, np.float64), axis=0)


# The derivative of a low-passed torque has no power above the cut-off either: no refinement is needed.
_DELAY = TorqueTerm("delay", _negative_derivative, is_smooth=True)
