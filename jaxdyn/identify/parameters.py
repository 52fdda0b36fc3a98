"""Fit of any numbers of any system or scene by the error of torques, balances or simulated motion."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxdyn.identify.checkpoint import Watch, checkpoint_at
from jaxdyn.identify.descent import Method, descend
from jaxdyn.identify.gauss_newton import GaussNewton, Unknowns
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.mechanisms import observation_columns
from jaxdyn.identify.objectives import ERRORS, SIMULATED, Objective
from jaxdyn.identify.optax_steps import METHODS, GradientSteps, Optimizer
from jaxdyn.identify.optimistix_steps import SOLVERS, LeastSquaresSteps
from jaxdyn.identify.parameter_tree import Parameters, select_leaves
from jaxdyn.identify.parameter_uncertainty import error_groups, standard_deviations
from jaxdyn.identify.problem import (
    Problem,
    errors_of,
    explain_not_finite,
    linearise,
    loss_of,
    on_one_device,
    pose_problem,
    values_and_jacobian,
)
from jaxdyn.identify.replay import HOLDS, INITIAL, check_replay, simulation_options
from jaxdyn.identify.result import ParameterFit
from jaxdyn.identify.sensors import FitSystem, with_sensors
from jaxdyn.identify.starts import best_start
from jaxdyn.identify.uncertainty import student
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
    r"""Fit numbers of a model, a Lagrangian, a force, a sensor, ..., to one or several logs.

    Minimises the mean, over samples and coordinates, of the squared errors in units of their root mean square over the
    logs, plus $\mathrm{noise}^2/N$ times the squares of the priors' residuals, N the number of errors. Numbers that
    neither logs nor prior determine stay near their start, and their deviation is infinite.

    **Arguments:**

    - `system`: any system (a `Model`, a `LagrangianSystem`, ...), a `Scene`, with its forces, a `jd.identify.Measured`
      scene, or a `jd.identify.Construction`; the start of the fit.
    - `log` with q, v, tau, and a for error="torque"; or several logs. Simulated logs of unequal length need a
      `horizon`.
    - `parameters`: the free numbers and their priors (`jd.identify.Parameters` of the same system). For plain numbers instead
      `positive`, `free`: functions that select leaves, or whole parts, of `system`:
      `lambda system: [system.parameters["mass"], system.parameters["length"]]`.
    - `error`: the quantity to compare.
      "torque": M a + h less the scene's forces. Needs accelerations, and no simulation.
      "momentum", "energy": balances over segments of `horizon` steps (20 by default), which need no accelerations.
      "trajectory": motions of segments of `horizon` steps, simulated with the measured torques (multiple shooting).
      "closed-loop": the same under the logged controller, `control(q, v, t)` or a `jd.Controller` with references in the
      log's time; its torques are compared too. Unlike this, open-loop replay of a geared arm is ill-conditioned.
    - `initial`, `hold`, `substeps`, `simulation`: of the simulation, as in `fit_trajectory`; `adjoint` among them. A
      system's time is the log's.
    - `observed`: names (of a system without bodies, indices) of the measured coordinates, if not all were; only these are
      compared. Fill the log with `jd.identify.complete_log`.
    - `noise`: the expected final error as a share of the root mean square; it weights data against priors.
    - `method`: "gauss-newton" for up to some hundred numbers: damped Gauss-Newton steps with exact Jacobians by forward mode,
      which eliminate free initial states segment by segment, until the next one predicts a decrease of the loss by less than
      `tolerance` of it. "levenberg-marquardt" and "dogleg" are those of optimistix, with the same Jacobians. For more numbers,
      as of a network, "lbfgs", "adam" or an optax.GradientTransformation, by reverse mode. `learning_rate`: of adam, a
      share of each number (of one where it starts at zero); `tolerance` of "lbfgs" as in `fit_trajectory`.
      `steps`: the most steps.
    - `starts`: number of starting points: coordinates vary by `spread` (positive numbers by that share) around the given ones,
      all points are improved in one `jax.vmap`, and the best is fitted to the end. `seed`: of the points.
    - `client`: a `dask.distributed.Client`, whose workers share the starts.
    - `devices`: as in `fit_trajectory`, for segments, or samples where error="torque" (whole logs of a `Measured` scene).
    - `callback(step, loss, system)` is called at every point with the system there; True stops the fit. `progress`: print step,
      loss and time left on standard error. `seconds`: limit of the fit's duration.
    - `checkpoint`: a file with the fit's state, written after every `every` steps (an integer) or seconds (a float). A fit of
      the same problem resumes from it, even after kill -9, and ends in the same numbers, bit for bit on one machine;
      `resume=False` starts again.

    **Returns:** `ParameterFit`. Its `result` is "stopped" when the callback or the time limit stopped it, "not_finite" when
    errors are not finite; `cause` then names the log, the sample and the parameters.

    **Raises:** ValueError when log and system do not fit together, for leaves that cannot be selected, for arguments out of
    range, and for a checkpoint of another problem.

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
        raise ValueError(f"error is {error!r}; give one of {ERRORS}")
    methods = (_GAUSS_NEWTON, *SOLVERS, *METHODS)
    if isinstance(method, str) and method not in methods:
        raise ValueError(f"method is {method!r}; give one of {methods} or an optax.GradientTransformation")
    if not noise > 0:
        raise ValueError(f"noise is {noise}; give a positive share, such as 0.01")
    if isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise ValueError(f"starts is {starts!r}; give the number of starting points, at least 1")
    if (control is None) == (error == "closed-loop"):
        raise ValueError(
            f"control is {control!r} with error={error!r}; error='closed-loop' takes the logged controller, others none"
        )
    simulated = {"horizon": horizon if error == "torque" else None, "substeps": substeps, **simulation}
    simulated |= {"initial": None if initial == INITIAL[0] else initial, "hold": None if hold == HOLDS[0] else hold}
    given = [name for name, value in simulated.items() if value is not None]
    if given and error not in SIMULATED:
        raise ValueError(f"{', '.join(given)} with error='{error}', which simulates nothing; omit it")
    if own.constraints and error in ("torque", "momentum"):
        raise ValueError(
            f"the scene has {len(own.constraints)} constraints, whose forces cannot be identified from torques; take "
            "error='trajectory' or 'energy'"
        )
    logs = as_logs(log, own.system, needs=("v", "a") if error == "torque" else ("v",))
    options = simulation_options(substeps, simulation) if error in SIMULATED else {}
    columns = None if observed is None else observation_columns(own.system, observed)
    objective = Objective(error, hold, options, control, columns)
    problem = pose_problem(tree, objective, logs, horizon, noise, devices)
    start = None
    if initial == "free":
        start = jnp.zeros((problem.count, 2, own.nv), tree.dtype)
    unknowns = Unknowns(tree.start, start)
    if starts > 1:
        unknowns = best_start(problem, unknowns, starts, spread, seed, client)
    # The fingerprint is of the numbers, not of their devices: a fit may resume on others.
    key = checkpoint_at(
        checkpoint, (on_one_device(problem), unknowns, str(method), learning_rate, tolerance, seed), every, resume
    )
    report = (
        None if callback is None else (lambda step, value, estimate: callback(step, value, tree.system(estimate.y)))
    )
    watch = Watch(int(steps), report, checkpoint=key, show=progress, seconds=seconds)
    estimate, end, history, result = _run_method(problem, unknowns, method, watch, learning_rate, tolerance)
    values, jacobian = (np.asarray(x, np.float64) for x in values_and_jacobian(tree, estimate.y))
    deviation, factor = None, np.nan
    if end is not None and not end.is_finite:
        deviation = np.full(len(jacobian), np.nan)
    elif end is not None:
        groups = error_groups(problem, logs, end.errors[: len(end.errors) - end.priors])
        # Groups are numbered from zero: the largest number is the degrees of freedom, groups - 1.
        deviation, factor = standard_deviations(end, jacobian, groups), student(int(groups.max(initial=1)))
    return ParameterFit(
        system=tree.system(estimate.y),
        nominal=system,
        names=tree.names,
        values=values,
        nominal_values=np.asarray(values_and_jacobian(tree, tree.start)[0], np.float64),
        deviation=deviation,
        factor=factor,
        history=history,
        result=result,
        method=f"{error} fit by {method if isinstance(method, str) else type(method).__name__}",
        cause=None
        if result != "not_finite"
        else explain_not_finite(problem, estimate if watch.failed is None else watch.failed, logs),
    )


def _run_method(problem: Problem, unknowns: Unknowns, method, watch: Watch, learning_rate, tolerance):
    """Unknowns, the errors near them (None where no Jacobian was taken), history and result."""
    if isinstance(method, str) and method == _GAUSS_NEWTON:
        rounding = float(jnp.finfo(unknowns.y.dtype).eps)
        end = descend(GaussNewton(partial(linearise, problem), tolerance, rounding), unknowns, watch)
        # Only steps that lower the loss are accepted: the last point is the best one.
        return end.last.point, end.last.state[0], end.history, end.result
    # The other methods search a flat vector.
    z0, unflatten = ravel_pytree(unknowns)
    report = watch.callback
    if report is not None:
        watch.callback = lambda step, value, z: report(step, value, unflatten(z))
    if isinstance(method, str) and method in SOLVERS:
        steps: Method = LeastSquaresSteps(errors_of, (problem, unknowns), method, tolerance)
    else:
        steps = GradientSteps(
            loss_of,
            (problem, unknowns),
            method=method,
            steps=watch.steps,
            learning_rate=learning_rate,
            tolerance=tolerance,
            # No curvature is known: every unknown may move as far as it ever may, by about one unit.
            scaling=lambda z: 1e6 * jnp.eye(z.size, dtype=z.dtype),
        )
    end = descend(steps, z0, watch)
    watch.failed = None if watch.failed is None else unflatten(watch.failed)
    estimate = unflatten(end.best.point)
    has_jacobian = isinstance(steps, LeastSquaresSteps)
    return estimate, linearise(problem, estimate) if has_jacobian else None, end.history, end.result


def _tree(system, parameters, positive, free) -> Parameters:
    if parameters is None:
        tree = select_leaves(system, positive, free)
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
    """Error that `fit_parameters` minimises, in per cent of the root mean square, without a fit.

    **Arguments:** as of `fit_parameters`. **Raises:** as there.
    """
    objective = Objective(
        error, options.pop("hold", "linear"), simulation_options(options.pop("substeps", None), options), control
    )
    own = with_sensors(system).scene
    tree = Parameters(system)
    logs = as_logs(log, own.system, needs=("v", "a") if error == "torque" else ("v",))
    problem = pose_problem(tree, objective, logs, horizon, 1.0)
    z, _ = ravel_pytree(Unknowns(tree.start, None))
    errors = eqx.filter_jit(errors_of)(z, (problem, Unknowns(tree.start, None)))
    return 100 * float(jnp.sqrt(jnp.sum(errors**2)))
