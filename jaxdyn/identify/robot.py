"""Fit of a robot to one log or several, with cross-validated terms, prior and smoothing, weights by noise, and delays.

Delays between the signals of positions and of torques are fitted together with the robot's parameters. A torque T recorded late
by d is tau(t) = T(t - d), to first order T - d dT/dt: one column for each joint, with d its coefficient, whose interval follows
like any other. The logs are then shifted by d and fitted again, until the shifts vanish.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.condensed_fit import Estimate, Intervals, Setting
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.log_repair import LogWarning
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.raw_logs import differentiate, log_warnings
from jaxdyn.identify.regression import check_weights
from jaxdyn.identify.result import Fit, residuals
from jaxdyn.identify.robot_logs import RobotLogs, cross_validation
from jaxdyn.identify.selection import PRIORS, ROBUST, VELOCITIES, Choice, Search, improving_torques, search, splits
from jaxdyn.identify.torque_terms import TERMS, RobotTerms, Terms, TorqueTerm, candidates, check_terms, split_terms
from jaxdyn.model.arguments import Checked, Numbers, check_known, deprecated, warn
from jaxdyn.model.description import short, table
from jaxdyn.model.tree import Model
from jaxdyn.tasks import DaskClient, open_engine

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
    """Fit the delays of all torques at a setting, from a first guess `start` (nv,); the other arguments as of `RobotLogs`.

    **Raises:** ValueError where the shifts do not converge, as for delays longer than the fastest reversals of the motion.
    """
    used = tuple(term for term in extra if term.name in dict(setting.extra))
    every = tuple(range(model.nv))
    free = setting._replace(extra=(*setting.extra, (_DELAY.name, every)))
    delay = np.array(start, np.float64)
    for _ in range(_ROUNDS):
        problem = RobotLogs(model, _shift_logs(logs, delay), basic, (*used, _DELAY), inertia, blocks)
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
        problem = RobotLogs(model, _shift_logs(logs, shift), basic, used, inertia, blocks)
        # A new problem has weights of ones and no loads: folds of shifted logs are compared with weights of their own.
        problem.refine(setting, fixed, rounds=2)
        parts, _ = splits(problem.data(setting).blocks)
        squares.append(np.array([problem.validation_squares(setting, part).sum(axis=0) for part in parts]))
    kept = np.isin(every, improving_torques(squares[0], squares[1], minimum=0.0))
    return Delays(np.where(kept, delay, 0.0), std, spread.factor, (squares[0], squares[1]))


def with_delays(
    problem: RobotLogs, setting: Setting, estimate: Estimate, fit: Fit, delays: Delays
) -> tuple[Intervals, Delays]:
    """Intervals of a fit to shifted logs in which delays are unknowns like all others, and the delays with theirs.

    A delay's column is the time derivative of the predicted torque, without the noise of the measured one. Terms that are
    correlated with it, viscous friction above all, get wider intervals. Delays that lower no error are zero.
    """
    kept = tuple(int(joint) for joint in np.flatnonzero(delays.seconds))
    # Keyed by identity: the term is called with the problem's own logs, because it is smooth.
    derivatives = {id(log): -differentiate(np.asarray(log.t, np.float64), fit.torques(log)) for log in problem.logs}
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
    return -differentiate(np.asarray(log.t, np.float64), np.asarray(log.tau, np.float64))


# The derivative of a low-passed torque has no power above the cut-off either: no refinement is needed.
_DELAY = TorqueTerm("delay", _negative_derivative, is_smooth=True)


# At least two blocks form a jackknife group: about ten groups at most, nine degrees of freedom for Student's t.
_BLOCKS = 20
_V_S, _PRIOR = 0.01, 1.0


class RobotFit(eqx.Module):
    """Result of `fit_robot`.

    - `fit`: the `Fit`, on all logs: model, friction, extra torques, `torques(log)`, `error(log)`. Its `result` is
      `max_steps_reached` where the weights of joints and samples and the loads of gears, which depend on the fit, do not settle.
    - `weights` (nv,): of each torque, one over the root mean square of its residual, of mean one; ones where not fitted.
    - `choice`: the setting (v_s, extra terms by joint, prior, loss) and all trials; none where everything was given.
    - `intervals`: standard deviations and sources of all parameters and of the base parameters; fitted delays
      are among the unknowns, as `joint.delay`.
    - `terms`: those of the fit, extra ones with the indices of their torques, as arguments of `fit_robot`.
    - `delays`: of the torques against the positions, by which the logs were shifted; None where none was requested.
    """

    fit: Fit
    weights: np.ndarray
    choice: Choice
    intervals: Intervals
    terms: tuple
    delays: Delays | None = None

    def __str__(self) -> str:
        base, factor, setting = self.intervals.base, self.intervals.factor, self.choice.setting
        columns = zip(base.names, base.values, base.std, base.sources, strict=True)
        rows = [[name, short(float(x)), short(factor * float(std)), source] for name, x, std, source in columns]
        chosen = ", ".join(f"{name} {value}" for name, value in setting._asdict().items())
        return f"{str(self.fit).splitlines()[0]}\n{chosen}\n{table(['combination', 'fitted', '+- 95 %', 'from'], rows)}"

    def align(self, log: Log) -> Log:
        """Shift the torques of a log of this robot by the delays, as for the fit, before `fit.torques` and `fit.error`."""
        return log if self.delays is None else shift_torques(log, self.delays.seconds)

    aligned = deprecated("RobotFit.aligned", align)


@on_one_thread
def fit_robot(
    model: Model,
    log: Log | Sequence[Log],
    terms: RobotTerms = "auto",
    *,
    v_s: float | str = "auto",
    prior: float | str = "auto",
    weights: Checked[Numbers | str | None] = "auto",
    robust: float | str | None = "auto",
    delay: Numbers | str = 0.0,
    inertia: str = "full",
    blocks: int = _BLOCKS,
    client: DaskClient | None = None,
    callback: Callable | None = None,
) -> RobotFit:
    r"""Fit feasible inertias, friction, rotor inertia and further torque terms, with everything not given chosen from the logs.

    $$\min_x \frac{|\mathrm{weights} (W x - \tau)|^2}{2 \sigma^2} + \mathrm{prior} \sum_i D(P_i, P_{0i}), \quad
    D(P, P_0) = \operatorname{tr}(P_0^{-1} P) - \log\det(P_0^{-1} P) - 4$$

    W is the regressor, sigma the residual of the unconstrained least squares, and D the log-det (entropic) divergence of a body's
    pseudo-inertia from the nominal one. It determines the combinations that torques do not, is the same in every frame and unit,
    and grows without bound towards the boundary of the feasible set. x is searched in coordinates in which every point is a
    feasible body with dissipative friction (`Chart`), so no iterate can be infeasible. The logs are condensed once: a step costs
    the same for any log. Where `from_raw` low-passed a log, the columns of friction go through the same low-pass. Coefficients of
    extra terms have a prior of the same weight: one unit of it is the coefficient that makes a tenth of the joint's torque.

    Arguments that are "auto" are chosen by cross-validation, over
    logs if there are three or more, else over parts of consecutive samples; then all logs are fitted together.

    An extra term is taken at a joint only where the errors are not white and where it lowers those of left-out parts clearly; a
    robust loss only for errors with heavy tails, and it or another v_s only beyond the standard error of their improvement
    (`jaxdyn.identify.selection`).

    **Arguments:**

    - `model`: nominal model, where the fit starts. `log`: one log or several with v and a; they may differ in sampling, and
      no filter, difference or friction state reaches from one into the next.
    - `terms`: names of `TERMS` and of `EXTRA`, and `TorqueTerm`s, or pairs of an extra term and the indices of its
      torques; or "auto": all of `TERMS`, and those of `EXTRA` that improve the prediction, joint by joint. Springs and
      pre-sliding need joints with one coordinate each.
    - `v_s`: smoothing velocity of Coulomb friction (rad/s, m/s), or "auto".
    - `prior`: its weight, or "auto". `weights` (nv,): one over the noise of each torque, None for ones, or "auto": one over the
      root mean square of the residual, iterated.
    - `robust`: threshold of Huber's loss in standard deviations of a joint's error: larger errors count by their size instead
      of its square, so that collisions and unmodelled torques have less influence. None: squares; "auto": squares, unless 3
      or 1.345 clearly predicts left-out parts better.
    - `delay`: of the torques against the positions (s), a number, one for each torque (nv,), or "auto": fitted, and kept where
      it lowers the errors on left-out parts. Compare other logs by `RobotFit.align(log)` then.
    - `inertia`: "full", all ten numbers of each body; "mass", its density alone; "fixed".
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the intervals.
    - `client`: a `dask.distributed.Client`, whose workers share the fits of the cross-validation; the result is the same.
    - `callback(trial)` is called after each setting tried, with a `jaxdyn.identify.selection.Trial`.

    **Returns:** `RobotFit`.

    **Raises:** ValueError when logs and model do not fit together, for unknown terms, nominal bodies that are not feasible, and
    arguments out of range.

    **Warns:** `LogWarning` for logs that look wrong: angles in degrees, positions that do not follow the velocities, torques in
    other units, in front of the gears or of a saturated sensor, joints that hardly move, and errors that are most of the torque
    or due to a start at rest.

    Source: Rucker & Wensing (2022), log-Cholesky coordinates; Lee, Wensing & Park (2020), "Geometric robot dynamic
    identification: a convex programming approach", divergence and convexity; Stone (1974), cross-validation; Holland & Welsch
    (1977), iteratively reweighted least squares.
    """
    check_known("fit_robot", model=model, log=log)
    check_bodies(model)
    given = logs = as_logs(log, model)
    if blocks < 2:
        raise ValueError(f"blocks is {blocks}; give at least 2")
    basic, extra, setting = _start(model, terms, v_s, prior, robust)
    fixed = None if isinstance(weights, str) and weights == "auto" else check_weights(weights, model.nv)
    is_found = isinstance(delay, str) and delay == "auto"
    search_delays = partial(
        find_delays, model, given, basic=basic, extra=extra, fixed=fixed, inertia=inertia, blocks=blocks
    )
    delays = search_delays(setting, np.zeros(model.nv)) if is_found else _given_delays(delay, model.nv)
    if delays is not None:
        logs = _shift_logs(given, delays.seconds)
    problem = RobotLogs(model, logs, basic, extra, inertia, blocks)
    # One set of joint weights and loads for the whole search: settings are compared on the same scale.
    problem.refine(setting, fixed, rounds=2)
    trials, by = (), "given"
    if any(isinstance(value, str) and value == "auto" for value in (terms, v_s, prior, robust)):
        parts, by = splits(problem.data(setting).blocks)
        with open_engine(client) as engine:
            trying = Search(cross_validation(problem, engine), parts, problem.torque, callback)
            setting = search(
                trying,
                setting,
                [term.name for term in extra] if isinstance(terms, str) and terms == "auto" else [],
                problem.torques_not_white,
                problem.loss_squares,
                velocities=VELOCITIES if isinstance(v_s, str) else (setting.v_s,),
                priors=PRIORS if isinstance(prior, str) else (setting.prior,),
                losses=ROBUST if isinstance(robust, str) else (setting.robust,),
            )
        trials = tuple(trying.trials.values())
    if is_found and delays is not None:  # at the setting chosen
        delays = search_delays(setting, delays.seconds)
        logs = _shift_logs(given, delays.seconds)
        problem = RobotLogs(model, logs, basic, extra, inertia, blocks)
    estimate = problem.refine(setting, fixed)
    fit = problem.result(setting, estimate)
    for number, (one, errors) in enumerate(zip(logs, residuals(fit, logs), strict=True), 1):
        for line in log_warnings(model, one, errors):
            warn(f"log {number}: {line}", LogWarning)
    if is_found and delays is not None and delays.seconds.any():
        spread, delays = with_delays(problem, setting, estimate, fit, delays)
    else:
        spread = problem.intervals(setting, estimate, fit)
    used = dict(setting.extra)
    chosen = (*basic, *((term, used[term.name]) for term in extra if term.name in used))
    return RobotFit(fit, problem.weights, Choice(setting, trials, by), spread, chosen, delays)


def _start(model: Model, terms, v_s, prior, robust):
    """Basic terms, extra terms that are given or may be chosen, and the setting at the start of a search."""
    for name, value in (("v_s", v_s), ("prior", prior)):
        if isinstance(value, str) and value != "auto":
            raise ValueError(f'{name} is {value!r}; give a positive number or "auto"')
    if not isinstance(prior, str):
        check_prior(prior)
    if robust not in (None, "auto") and (isinstance(robust, str) or not robust > 0):
        raise ValueError(f'robust is {robust!r}; give a positive number of standard deviations, None or "auto"')
    is_auto = isinstance(terms, str) and terms == "auto"
    basic, extra, where = (TERMS, candidates(model), ()) if is_auto else split_terms(terms, model.nv)
    setting = Setting(
        _V_S if isinstance(v_s, str) else float(v_s),
        where,
        _PRIOR if isinstance(prior, str) else float(prior),
        None if robust is None or isinstance(robust, str) else float(robust),
    )
    return check_terms(basic, setting.v_s), extra, setting


def _given_delays(delay, nv: int) -> Delays | None:
    if isinstance(delay, str):
        raise ValueError(f'delay is {delay!r}; give seconds, one number or one for each torque, or "auto"')
    if np.shape(delay) not in ((), (nv,)):
        raise ValueError(f"delay is {delay}; give a number of seconds, or one for each of {nv} torques")
    if not np.any(np.asarray(delay) != 0):
        return None
    return Delays(np.broadcast_to(np.asarray(delay, np.float64), (nv,)), np.full(nv, np.inf), np.inf)


@on_one_thread
def fit_torques(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    prior: float = 1.0,
    weights: Numbers | None = None,
    inertia: str = "full",
) -> Fit:
    """Fit feasible inertias, friction and rotor inertia with everything given: `fit_robot` without choices and intervals.

    **Arguments:** as of `fit_robot`; the loss is that of squares. **Returns:** `Fit`. **Raises:** ValueError as there.

    ```python
    fit = jd.identify.fit_torques(model, log, ("viscous", "coulomb"), v_s=0.001)
    ```
    """
    check_known("fit_torques", model=model, log=log)
    check_bodies(model)
    logs, terms = as_logs(log, model), check_terms(terms, v_s)
    check_prior(prior)
    problem, setting = RobotLogs(model, logs, terms, (), inertia, 1), Setting(float(v_s), (), float(prior))
    return problem.result(setting, problem.refine(setting, check_weights(weights, model.nv)))


def check_prior(prior) -> None:
    """Check the weight of the prior. **Raises:** ValueError for a prior that is not positive and finite."""
    if not 0 < prior < np.inf:
        raise ValueError(f"prior is {prior}; it must be positive: torques alone do not determine single bodies")
