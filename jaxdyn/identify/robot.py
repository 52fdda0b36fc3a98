"""Fit of a robot to one log or several, with cross-validated terms, prior and smoothing and weights by noise."""

from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import numpy as np

from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.condensed_fit import Intervals, Setting
from jaxdyn.identify.delays import Delays, find_delays, shift_torques, with_delays
from jaxdyn.identify.devices import on_one_thread
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.regression import check_weights
from jaxdyn.identify.result import Fit
from jaxdyn.identify.robot_problem import RobotProblem, cross_validation
from jaxdyn.identify.selection import PRIORS, ROBUST, VELOCITIES, Choice, Search, search, splits
from jaxdyn.identify.torque_terms import TERMS, RobotTerms, Terms, candidates, check_terms, split_terms
from jaxdyn.model.arguments import Checked, Numbers, deprecated
from jaxdyn.model.tree import Model
from jaxdyn.tasks import DaskClient, open_engine

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

    Source: Rucker & Wensing (2022), log-Cholesky coordinates; Lee, Wensing & Park (2020), "Geometric robot dynamic
    identification: a convex programming approach", divergence and convexity; Stone (1974), cross-validation; Holland & Welsch
    (1977), iteratively reweighted least squares.
    """
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
        logs = tuple(shift_torques(log, delays.seconds) for log in given)
    problem = RobotProblem(model, logs, basic, extra, inertia, blocks)
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
        logs = tuple(shift_torques(log, delays.seconds) for log in given)
        problem = RobotProblem(model, logs, basic, extra, inertia, blocks)
    estimate = problem.refine(setting, fixed)
    fit = problem.result(setting, estimate)
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
    check_bodies(model)
    logs, terms = as_logs(log, model), check_terms(terms, v_s)
    check_prior(prior)
    problem, setting = RobotProblem(model, logs, terms, (), inertia, 1), Setting(float(v_s), (), float(prior))
    return problem.result(setting, problem.refine(setting, check_weights(weights, model.nv)))


def check_prior(prior) -> None:
    """Check the weight of the prior. **Raises:** ValueError for a prior that is not positive."""
    if not prior > 0:
        raise ValueError(f"prior is {prior}; it must be positive: torques alone do not determine single bodies")
