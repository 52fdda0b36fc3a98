"""Fit of a robot to one log or several, with cross-validated terms, prior and smoothing and weights by noise."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.condensed_fit import Setting
from jaxdyn.identify.delays import Delays, find_delays, shift_torques, with_delays
from jaxdyn.identify.feasible import check_prior
from jaxdyn.identify.intervals import Intervals
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.regression import check_weights
from jaxdyn.identify.result import Fit
from jaxdyn.identify.robot_problem import RobotProblem
from jaxdyn.identify.selection import PRIORS, ROBUST, VELOCITIES, Choice, Search, folds, search
from jaxdyn.identify.threads import on_one_thread
from jaxdyn.identify.torque_terms import EXTRA, TERMS, RobotTerms, split_terms
from jaxdyn.model.arguments import Checked, Numbers, warn
from jaxdyn.model.tree import Model
from jaxdyn.tasks import DaskClient, Engine, open_engine, results

# At least two blocks form a jackknife group: about ten groups at most, nine degrees of freedom for Student's t.
_BLOCKS = 20
# Fits after which the weights of joints and the loads of gears are updated.
_ROUNDS = 3
_V_S, _PRIOR = 0.01, 1.0


class RobotFit(eqx.Module):
    """Result of `fit_robot`.

    - `fit`: the `Fit`, on all logs: model, friction, extra torques, `torques(log)`, `error(log)`.
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

    def align(self, log: Log) -> Log:
        """Shift the torques of a log of this robot by the delays, as for the fit, before `fit.torques` and `fit.error`."""
        return log if self.delays is None else shift_torques(log, self.delays.seconds)

    def aligned(self, log: Log) -> Log:
        """Deprecated name of `align`."""
        warn("RobotFit.aligned is deprecated; call align", DeprecationWarning)
        return self.align(log)


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
    """Fit feasible inertias, friction, rotor inertia and further torque terms, with everything not given chosen from the logs.

    The loss is that of `fit_torques`, with extra terms whose coefficients have a prior of the same weight: one unit of it is
    the coefficient that makes a tenth of the joint's torque. Arguments that are "auto" are chosen by cross-validation, over
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
    - `inertia`: as in `fit_torques`.
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the intervals.
    - `client`: a `dask.distributed.Client`, whose workers share the fits of the cross-validation; the result is the same.
    - `callback(trial)` is called after each setting tried, with a `jaxdyn.identify.selection.Trial`.

    **Returns:** `RobotFit`.

    **Raises:** ValueError as `fit_torques`, and for unknown terms.

    Source: Stone (1974), cross-validation; Holland & Welsch (1977), iteratively reweighted least squares; and those of
    `fit_torques`.
    """
    check_bodies(model)
    logs = as_logs(log, model)
    is_auto = isinstance(terms, str) and terms == "auto"
    # These two need one angle for each torque (`torque_terms._angles`).
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
    fixed = None if isinstance(weights, str) and weights == "auto" else check_weights(weights, model.nv)
    setting = Setting(
        _V_S if isinstance(v_s, str) else float(v_s),
        where,
        _PRIOR if isinstance(prior, str) else float(prior),
        None if robust is None or isinstance(robust, str) else float(robust),
    )
    finding = {"inertia": inertia, "blocks": blocks}
    is_found = isinstance(delay, str)
    if is_found and delay != "auto":
        raise ValueError(f'delay is {delay!r}; give seconds, one number or one for each torque, or "auto"')
    delays, given = None, logs
    if is_found:
        delays = find_delays(model, given, setting, basic, extra, fixed, np.zeros(model.nv), **finding)
    elif np.shape(delay) not in ((), (model.nv,)):
        raise ValueError(f"delay is {delay}; give a number of seconds, or one for each of {model.nv} torques")
    elif np.any(np.asarray(delay) != 0):
        delays = Delays(np.broadcast_to(np.asarray(delay, np.float64), (model.nv,)), np.full(model.nv, np.inf), np.inf)
    if delays is not None:
        logs = tuple(shift_torques(log, delays.seconds) for log in given)
    problem = RobotProblem(model, logs, basic, extra, inertia, blocks)
    # One set of joint weights and loads for the whole search: settings are compared on the same scale.
    problem.refine(setting, fixed, rounds=2)
    trials, by = (), "given"
    if is_auto or any(isinstance(value, str) for value in (v_s, prior, robust)):
        parts, by = folds(problem.data(setting).blocks)
        velocities = VELOCITIES if isinstance(v_s, str) else (setting.v_s,)
        priors = PRIORS if isinstance(prior, str) else (setting.prior,)
        names = [term.name for term in extra] if is_auto else []
        losses = ROBUST if isinstance(robust, str) else (setting.robust,)
        with open_engine(client) as engine:
            trying = Search(_cross_validation(problem, engine), parts, problem.torque, callback)
            setting = search(
                trying,
                setting,
                names,
                problem.torques_not_white,
                problem.has_outliers,
                velocities=velocities,
                priors=priors,
                losses=losses,
            )
        trials = tuple(trying.trials.values())
    if is_found and delays is not None:  # at the setting chosen
        delays = find_delays(model, given, setting, basic, extra, fixed, delays.seconds, **finding)
        logs = tuple(shift_torques(log, delays.seconds) for log in given)
        problem = RobotProblem(model, logs, basic, extra, inertia, blocks)
    estimate = problem.refine(setting, fixed, rounds=_ROUNDS)
    data = problem.data(setting)
    fit = problem.result(setting, estimate, data)
    if is_found and delays is not None and delays.seconds.any():
        spread, delays = with_delays(problem, setting, estimate, fit, delays)
    else:
        spread = problem.intervals(setting, estimate, fit)
    used = dict(setting.extra)
    chosen = (*basic, *((term, used[term.name]) for term in extra if term.name in used))
    return RobotFit(fit, problem.weights, Choice(setting, trials, by), spread, chosen, delays)


class _Folds(NamedTuple):
    """The fits of a cross-validation as tasks."""

    problem: RobotProblem

    @on_one_thread
    def squares(self, pair: tuple[Setting, np.ndarray]) -> np.ndarray:
        """Squared errors on some blocks of a fit to the others."""
        return self.problem.validation_squares(*pair)


def _cross_validation(problem: RobotProblem, engine: Engine) -> Callable:
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
