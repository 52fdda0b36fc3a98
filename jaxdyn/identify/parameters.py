"""Any numbers of any system or scene, fitted by the error of torques, balances or simulated motion."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxdyn.identify.checkpoint import checkpoint_at
from jaxdyn.identify.clusters import deviations, groups_of
from jaxdyn.identify.gauss_newton import Linear, Unknowns, gauss_newton, linear, with_prior
from jaxdyn.identify.jackknife import student
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.mechanisms import observed_columns
from jaxdyn.identify.minimise import METHODS, Optimizer, minimise
from jaxdyn.identify.objectives import ERRORS, SIMULATED, Objective
from jaxdyn.identify.parameter_tree import Parameters, picked
from jaxdyn.identify.problem import (
    Problem,
    cause_of,
    errors_of,
    gathered,
    loss_of,
    posed,
    prior_slopes,
    slopes_of,
    values_and_slopes,
)
from jaxdyn.identify.progress import Watch
from jaxdyn.identify.replay import HOLDS, INITIAL, check_replay, simulation_options
from jaxdyn.identify.result import ParameterFit
from jaxdyn.identify.sensors import FitSystem, with_sensors
from jaxdyn.identify.starts import best_start
from jaxdyn.identify.stepwise import SOLVERS, stepwise
from jaxdyn.model.arguments import Checked, FilePath, Function
from jaxdyn.simulation.controls import Control
from jaxdyn.tasks import DaskClient

_GAUSS_NEWTON = "gauss-newton"


def fit_parameters(
    system: FitSystem,
    log: Log | Sequence[Log],
    parameters: Parameters | None = None,
    *,
    positive: Function | None = None,
    free: Function | None = None,
    error: str = "trajectory",
    horizon: int | None = None,
    initial: str = "measured",
    hold: str = "linear",
    substeps: int | None = None,
    control: Control = None,
    observed: Sequence[Any] | None = None,
    noise: float = 0.01,
    method: Checked[str | Optimizer] = "gauss-newton",
    steps: int = 200,
    learning_rate: float = 0.1,
    tolerance: float = 1e-9,
    starts: int = 1,
    spread: float = 0.3,
    seed: int = 0,
    devices: Sequence[Any] | None = None,
    client: DaskClient | None = None,
    callback: Callable[[int, float, Any], Any] | None = None,
    progress: bool = False,
    seconds: float | None = None,
    checkpoint: FilePath | None = None,
    every: int | float = 30.0,
    resume: bool = True,
    **simulation: Any,
) -> ParameterFit:
    """Numbers of a model, a Lagrangian, a force, a sensor, ..., by what they make of one or several logs.

    Minimises the mean, over samples and coordinates, of the squared errors in units of their root mean square over the logs, plus
    noise^2/N times the squares of the priors' residuals, N the number of errors. What neither log nor prior determines
    stays about where it was, and its deviation is infinite.

    **Arguments:**

    - `system`: any system (a `Model`, a `LagrangianSystem`, ...), a `Scene`, whose forces count, a `jd.identify.Measured`
      scene, or a `jd.identify.Construction`; where the fit starts.
    - `log` with q, v, tau, and a for error="torque"; or several logs. Those that are simulated need one `horizon`.
    - `parameters`: what is free, and what is known of it (`jd.identify.Parameters` of the same system). For plain numbers instead
      `positive`, `free`: functions that pick leaves, or whole parts, of `system`:
      `lambda system: [system.parameters["mass"], system.parameters["length"]]`.
    - `error`: what is compared.
      "torque": M a + h less the scene's forces. Needs accelerations, and no simulation.
      "momentum", "energy": balances over pieces of `horizon` steps (20 by default), which need no accelerations.
      "trajectory": motions of pieces of `horizon` steps that are simulated with the measured torques (multiple shooting).
      "closed-loop": the same under the logged controller, `control(q, v, t)` or a `jd.Controller` whose references are in the
      log's time; its torques are compared too. Open-loop replay of a geared arm is ill-conditioned; this is not.
    - `initial`, `hold`, `substeps`, `simulation`: of the simulation, as in `fit_trajectory`; `adjoint` among them. A
      system's time is the log's.
    - `observed`: names (of a system without bodies, indices) of what was measured, when not all was; nothing else is compared.
      Fill the log with `jd.identify.completed`.
    - `noise`: what the errors come to in the end, as a share of the root mean square: the weight of data against priors.
    - `method`: "gauss-newton" for up to some hundred numbers: damped Gauss-Newton steps with exact Jacobians by forward mode,
      which eliminate free starts piece by piece, until the next one promises to lower the loss by less than `tolerance` of
      it. "levenberg-marquardt" and "dogleg" are optimistix' own, with the same Jacobians. For more numbers,
      those of a network say, "lbfgs", "adam" or an optax.GradientTransformation, by reverse mode. `learning_rate`: of adam, a
      share of each number (of one where it starts at zero); `tolerance` of "lbfgs" as in `fit_trajectory`.
      `steps`: the most steps.
    - `starts`: from how many points to begin: coordinates are spread by `spread` (of positive numbers by that
      share) around the given ones, all are improved side by side in one `jax.vmap`, and the best is fitted to the end. `seed`.
    - `client`: a `dask.distributed.Client`, whose workers share the starts.
    - `devices`: as in `fit_trajectory`, for pieces, or samples where error="torque" (whole logs of a `Measured` scene).
    - `callback(step, loss, system)` is called at every point with the system there; True stops the fit. `progress`: print step,
      loss and time left on standard error. `seconds`: the fit stops after so long.
    - `checkpoint`: a file that holds the fit's state, written every so many steps (`every` is an integer) or seconds (a float).
      A fit of the same problem goes on from it to the same numbers, bit for bit on one machine, however it ended;
      `resume=False` begins anew.

    **Returns:** `ParameterFit`. Its `result` is "stopped" when it was told to stop, "not_finite" when the errors where it came to
    are not finite; `cause` then says in which log, at which sample and by which parameters.

    **Raises:** ValueError when log and system do not fit together, for what cannot be picked, for arguments out of range, and for
    a checkpoint of another problem.

    Source: output error and equation error methods, Ljung (1999), section 7; Bock (1983), multiple shooting; Marquardt (1963),
    damping.

    ```python
    fit = jd.identify.fit_parameters(pendulum, log, positive=lambda system: system.parameters["length"])
    ```
    """
    check_replay(initial, hold)
    tree = _tree(system, parameters, positive, free)
    own = with_sensors(system).scene
    if error not in ERRORS:
        raise ValueError(f"error is {error!r}; take one of {ERRORS}")
    methods = (_GAUSS_NEWTON, *SOLVERS, *METHODS)
    if isinstance(method, str) and method not in methods:
        raise ValueError(f"method is {method!r}; take one of {methods} or an optax.GradientTransformation")
    if not noise > 0:
        raise ValueError(f"noise is {noise}; give a positive share, such as 0.01")
    if isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise ValueError(f"starts is {starts!r}; give from how many points to begin, at least 1")
    if (control is None) == (error == "closed-loop"):
        raise ValueError(
            f"control is {control!r} with error={error!r}; error='closed-loop' takes the logged controller, others none"
        )
    simulated = {"horizon": horizon if error == "torque" else None, "substeps": substeps, **simulation}
    simulated |= {"initial": None if initial == INITIAL[0] else initial, "hold": None if hold == HOLDS[0] else hold}
    given = [name for name, value in simulated.items() if value is not None]
    if given and error not in SIMULATED:
        raise ValueError(f"{', '.join(given)} with error='{error}', which simulates nothing; leave it out")
    if own.constraints and error in ("torque", "momentum"):
        raise ValueError(
            f"the scene has {len(own.constraints)} constraints, whose forces the torques do not tell; take "
            "error='trajectory' or 'energy'"
        )
    logs = as_logs(log, own.system, needs=("v", "a") if error == "torque" else ("v",))
    options = simulation_options(substeps, simulation) if error in SIMULATED else {}
    columns = None if observed is None else observed_columns(own.system, observed)
    objective = Objective(error, hold, options, control, columns)
    problem = posed(tree, objective, logs, horizon, noise, devices)
    start = None
    if initial == "free":
        start = jnp.zeros((problem.count, 2, own.nv), tree.dtype)
    unknowns = Unknowns(tree.start, start)
    if starts > 1:
        unknowns = best_start(problem, unknowns, starts, spread, seed, client)
    # The numbers, not the devices that they are on, say which problem it is.
    key = checkpoint_at(
        checkpoint, (gathered(problem), unknowns, str(method), learning_rate, tolerance, seed), every, resume
    )
    report = (
        None if callback is None else (lambda step, value, estimate: callback(step, value, tree.system(estimate.y)))
    )
    watch = Watch(int(steps), report, checkpoint=key, show=progress, seconds=seconds)
    estimate, end, history, result = _minimised(problem, unknowns, method, watch, learning_rate, tolerance)
    values, slopes = (np.asarray(x, np.float64) for x in values_and_slopes(tree, estimate.y))
    deviation, factor = None, np.nan
    if end is not None and not end.finite:
        deviation = np.full(len(slopes), np.nan)
    elif end is not None:
        groups = groups_of(problem, logs, end.errors[: len(end.errors) - end.priors])
        deviation, factor = deviations(end, slopes, groups), student(int(groups.max(initial=1)))
    return ParameterFit(
        system=tree.system(estimate.y),
        nominal=system,
        names=tree.names,
        values=values,
        nominal_values=np.asarray(values_and_slopes(tree, tree.start)[0], np.float64),
        deviation=deviation,
        factor=factor,
        history=history,
        result=result,
        method=f"{error} fit by {method if isinstance(method, str) else type(method).__name__}",
        cause=None
        if result != "not_finite"
        else cause_of(problem, estimate if watch.failed is None else watch.failed, logs),
    )


def _minimised(problem: Problem, unknowns: Unknowns, method, watch: Watch, learning_rate, tolerance):
    """Unknowns, the errors near them (None where no Jacobian was taken), history and result."""
    if isinstance(method, str) and method == _GAUSS_NEWTON:
        return gauss_newton(lambda estimate: linearised(problem, estimate), unknowns, tolerance=tolerance, watch=watch)
    z0, unflatten = ravel_pytree(unknowns)
    own = watch.callback
    if own is not None:
        watch.callback = lambda step, value, z: own(step, value, unflatten(z))
    if isinstance(method, str) and method in SOLVERS:
        z, history, result = stepwise(
            errors_of, z0, (problem, unknowns), method=method, tolerance=tolerance, watch=watch
        )
        estimate = unflatten(z)
        watch.failed = None if watch.failed is None else unflatten(watch.failed)
        return estimate, linearised(problem, estimate), history, result
    z, history, result = minimise(
        loss_of,
        z0,
        (problem, unknowns),
        method=method,
        learning_rate=learning_rate,
        tolerance=tolerance,
        # No curvature is known: everything may move as far as it ever may, by about one unit.
        scaling=lambda z: 1e6 * jnp.eye(z.size, dtype=z.dtype),
        watch=watch,
    )
    watch.failed = None if watch.failed is None else unflatten(watch.failed)
    return unflatten(z), None, history, result


def linearised(problem: Problem, estimate: Unknowns) -> Linear:
    """The errors near a point, those of the data and of the prior."""
    parts = slopes_of(problem, estimate)
    if estimate.start is None:
        errors = jnp.concatenate([errors.reshape(1, -1) for errors, _, _ in parts], axis=1)
        rows = jnp.concatenate([rows.reshape(1, -1, estimate.y.size) for _, rows, _ in parts], axis=1)
        data = linear(errors, rows, None)
    else:
        data = linear(*parts[0])
    return with_prior(data, *prior_slopes(problem.tree, estimate.y), problem.prior_weight)


def _tree(system, parameters, positive, free) -> Parameters:
    if parameters is None:
        tree = picked(system, positive, free)
    elif positive is not None or free is not None:
        raise ValueError("parameters and positive or free are both given; put all into parameters")
    elif not isinstance(parameters, Parameters):
        raise ValueError(f"parameters is a {type(parameters).__name__}; pass jd.identify.Parameters(system)...")
    elif parameters.given is not system:
        raise ValueError("parameters are of another system; build them with jd.identify.Parameters(system) of this one")
    else:
        tree = parameters
    if tree.size == 0:
        raise ValueError("nothing to fit; pick leaves, e.g. positive=lambda system: system.parameters['mass']")
    return tree


def parameter_error(
    system: FitSystem,
    log: Log | Sequence[Log],
    *,
    error: str = "trajectory",
    horizon: Checked[int | None] = None,
    control: Control = None,
    **options: Any,
) -> float:
    """The error that `fit_parameters` minimises, in per cent of the root mean square, without a fit.

    **Arguments:** as of `fit_parameters`. **Raises:** as there.
    """
    objective = Objective(
        error, options.pop("hold", "linear"), simulation_options(options.pop("substeps", None), options), control
    )
    own = with_sensors(system).scene
    tree = Parameters(system)
    logs = as_logs(log, own.system, needs=("v", "a") if error == "torque" else ("v",))
    problem = posed(tree, objective, logs, horizon, 1.0)
    z, _ = ravel_pytree(Unknowns(tree.start, None))
    errors = eqx.filter_jit(errors_of)(z, (problem, Unknowns(tree.start, None)))
    return 100 * float(jnp.sqrt(jnp.sum(errors**2)))
