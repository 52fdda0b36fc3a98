"""Fit of any numbers of any system or scene by the error of torques, balances or simulated motion."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.blocks import Inertias
from jaxdyn.identify.condensed import condense_rows
from jaxdyn.identify.condensed_fit import minimize_torque_error
from jaxdyn.identify.descent import Descent, Watch, checkpoint_at, descend
from jaxdyn.identify.devices import on_one_thread
from jaxdyn.identify.interior import TorqueProblem, block_chart, log_cholesky_coordinates
from jaxdyn.identify.logs import Log
from jaxdyn.identify.methods import (
    DAMPING,
    SOLVERS,
    GaussNewton,
    GradientSteps,
    LeastSquaresSteps,
    LinearErrors,
    Unknowns,
    confirm_minimum,
    propose,
)
from jaxdyn.identify.options import GAUSS_NEWTON, Execution, Objective, Solver, merge_options
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.problem import (
    Problem,
    errors_of,
    explain_not_finite,
    linearise,
    linearise_batch,
    loss_of,
    on_one_device,
    pose_problem,
    values_and_jacobian,
)
from jaxdyn.identify.result import Fit
from jaxdyn.identify.sensors import FitSystem
from jaxdyn.identify.uncertainty import error_groups, standard_deviations, student
from jaxdyn.model.arguments import Checked, Function
from jaxdyn.tasks import count_workers, map_tasks

# Of the interior point: most steps, and the excess of its loss over the minimum as a share of the prior's weight.
_CONVEX_STEPS, _EXCESS = 200, 1e-9
# Of the starts: rough, as the best one is fitted to the end afterwards, so that only the order of the losses matters.
_STEPS, _TOLERANCE = 20, 1e-4


@on_one_thread
def fit_parameters(
    system: FitSystem,
    log: Log | Sequence[Log],
    parameters: Checked[Parameters | None] = None,
    objective: Objective = Objective(),  # noqa: B008
    solver: Solver = Solver(),  # noqa: B008
    execution: Execution = Execution(),  # noqa: B008
    *,
    positive: Function | None = None,
    free: Function | None = None,
    **options: Any,
) -> Fit:
    """Fit numbers of a model, a Lagrangian, a force, a sensor, ..., to one or several logs.

    Numbers that neither logs nor prior determine stay near their start, and their deviation is infinite.

    **Arguments:**

    - `system`: any system (a `Model`, a `LagrangianSystem`, ...), a `Scene`, with its forces, a `jd.identify.Measured`
      scene, or a `jd.identify.Construction`; the start of the fit.
    - `log` with q, v, tau, and a for error="torque"; or several logs.
    - `parameters`: the free numbers and their priors (`jd.identify.Parameters` of the same system). For plain numbers instead
      two functions.
    - `positive`, `free`: functions that select leaves, or whole parts, of `system`:
      `lambda system: [system.parameters["mass"], system.parameters["length"]]`.
    - `objective`: what is minimised, a `jd.identify.Objective`. The time of a `Model` starts at zero in every segment, that of
      another system is the log's.
    - `solver`: by which method, a `jd.identify.Solver`. `execution`: where, how long, and with which
      reports, a `jd.identify.Execution`.
    - `options`: deprecated, options of these three by their own names.

    **Returns:** `Fit`. Its `result` is `stopped` when the callback or the time limit stopped it, `nonfinite` when errors
    are not finite; `cause` then names the log, the sample and the parameters.

    **Raises:** ValueError when log and system do not fit together, for leaves that cannot be selected, where no start has finite
    errors, and for a checkpoint of another problem.

    ```python
    fit = jd.identify.fit_parameters(pendulum, log, positive=lambda system: system.parameters["length"])
    ```
    """
    objective, solver, execution = merge_options(options, objective, solver, execution)
    tree = _tree(system, parameters, positive, free)
    problem, logs = pose_problem(tree, objective, log, execution.devices)
    unknowns = problem.start
    if solver.starts > 1:
        unknowns = _best_start(problem, unknowns, solver, execution)
    # The fingerprint is of the numbers, not of their devices: a fit may resume on others.
    numbers = on_one_device(problem), unknowns, str(solver.method), solver.learning_rate, solver.tolerance, solver.seed
    callback = execution.callback
    report = None if callback is None else lambda step, loss, at: callback(step, loss, tree.system(at.y))
    key = checkpoint_at(execution.checkpoint, numbers, execution.every, execution.resume)
    watch = Watch(int(solver.steps), report, checkpoint=key, show=execution.progress, seconds=execution.seconds)
    end, linear = _minimise(problem, unknowns, solver, watch)
    y = end.best.point.y
    values, jacobian = (np.asarray(x, np.float64) for x in values_and_jacobian(tree, y))
    deviation, factor = None, np.nan
    if linear is not None and not linear.is_finite:
        deviation = np.full(len(jacobian), np.nan)
    elif linear is not None:
        groups = error_groups(problem, logs, linear.errors[: len(linear.errors) - linear.priors])
        # Groups are numbered from zero: the largest number is the degrees of freedom, groups - 1.
        deviation, factor = standard_deviations(linear, jacobian, groups), student(int(groups.max(initial=1)))
    return Fit(
        system=tree.system(y),
        nominal=system,
        names=tree.names,
        values=values,
        nominal_values=np.asarray(values_and_jacobian(tree, tree.start)[0], np.float64),
        deviation=deviation,
        factor=factor,
        history=end.history,
        result=end.result,
        method=f"{objective.error} fit by {solver.name}",
        cause=explain_not_finite(problem, watch.failed, logs) if end.result is RESULTS.nonfinite else None,
        motors=problem.objective.observed,
    )


def _minimise(
    problem: Problem, unknowns: Unknowns, solver: Solver, watch: Watch
) -> tuple[Descent, LinearErrors | None]:
    """End of a minimisation, and the errors near it; None where the method takes no Jacobian."""
    rounding = float(jnp.finfo(unknowns.y.dtype).eps)
    if solver.name == GAUSS_NEWTON:
        start, known, before = unknowns, None, np.zeros(0)
        if solver.starts == 1:
            start, known, before = minimize_linear_torques(problem, unknowns)
        end = descend(GaussNewton(partial(linearise, problem), solver.tolerance, rounding, known), start, watch)
        # Only steps that lower the loss are accepted: the last point is the best one.
        linear, history = end.last.state[0], np.concatenate([before, end.history])
        result = confirm_minimum(end.result, linear, solver.tolerance, rounding)
        return Descent(end.last, end.last, history, result), linear
    if solver.name in SOLVERS:
        end = descend(LeastSquaresSteps(errors_of, problem, solver.name, solver.tolerance), unknowns, watch)
        linear = linearise(problem, end.best.point)
        return end._replace(result=confirm_minimum(end.result, linear, solver.tolerance, rounding)), linear
    steps = GradientSteps(
        loss_of,
        problem,
        method=solver.method,
        steps=watch.steps,
        learning_rate=solver.learning_rate,
        tolerance=solver.tolerance,
    )
    return descend(steps, unknowns, watch), None


def minimize_linear_torques(problem: Problem, unknowns: Unknowns) -> tuple[Unknowns, LinearErrors | None, np.ndarray]:
    """Minimum of the error of torques that are linear in the numbers, by the steps of `fit_torques`, and the losses before it.

    With the linear errors there, None where the torques are no such function.

    The errors along straight lines in the numbers are those at the start and their Jacobian there times the change z. Unknowns
    other than those of `block_chart` stay where they are. Where the minimum is none, as the torques are not linear after all, so
    do these.
    """
    chart = block_chart(problem.tree.blocks) if problem.objective.error == "torque" else None
    if chart is None:
        return unknowns, None, np.zeros(0)
    here = linearise(problem, unknowns)
    if not here.is_finite:
        return unknowns, here, np.zeros(0)
    (weight,) = (float(block.weight) for block in problem.tree.blocks if isinstance(block, Inertias))
    # The divergence replaces the residuals of the inertias' prior; those of other numbers are linear.
    data = np.arange(len(here.errors)) < len(here.errors) - here.priors
    kept = data | ~np.any(here.rows[:, chart.places.reshape(-1)] != 0, axis=1)
    # Twice the loss: `TorqueProblem` has half of the squares.
    rows = 2**0.5 * np.concatenate([here.rows[kept], -here.errors[kept, None]], axis=1)
    condensed, prior = condense_rows(rows, int(data.sum())), weight * problem.prior_weight
    convex = TorqueProblem(chart, condensed.R, condensed.d, condensed.rest, prior)
    end = minimize_torque_error(convex, _CONVEX_STEPS, _EXCESS * prior)
    y, (origin, terms) = np.zeros(unknowns.y.size), end.last.point
    y[chart.places.reshape(-1)] = log_cholesky_coordinates(origin, chart.count).reshape(-1)
    y[chart.term_places] = np.where(chart.positive, np.log(np.where(chart.positive, terms, 1.0)), terms)
    there = Unknowns(jnp.asarray(y, unknowns.y.dtype), None)
    found = linearise(problem, there)
    return (there, found, end.history[:-1]) if found.loss < here.loss else (unknowns, here, np.zeros(0))


def _best_start(problem: Problem, unknowns: Unknowns, solver: Solver, execution: Execution) -> Unknowns:
    """Best of several points after some damped Gauss-Newton steps from each, evaluated in one `jax.vmap` on each worker.

    The first start is the given one; the coordinates of the others are normal with deviation `spread`.

    **Raises:** ValueError where no start has finite errors.
    """
    y = unknowns.y
    far = solver.spread * jax.random.normal(jax.random.key(solver.seed), (solver.starts, y.size), y.dtype)
    # With the given start among them, and steps that only lower losses, the choice is never worse than that start.
    points = y[None] + far.at[0].set(0.0)
    blocks = np.array_split(np.asarray(points), min(solver.starts, count_workers(execution.client)))
    results = map_tasks(_Improvement(problem, unknowns), blocks, execution.client)
    candidates = [estimate for estimates, _ in results for estimate in estimates]
    losses = np.concatenate([np.asarray(losses) for _, losses in results])
    # np.argmin would take a NaN for the smallest.
    losses = np.where(np.isfinite(losses), losses, np.inf)
    if not np.isfinite(losses).any():
        raise ValueError(
            f"none of {solver.starts} starts has finite errors; give a smaller spread (now {solver.spread}), or a shorter "
            "horizon"
        )
    return jax.tree.map(jnp.asarray, candidates[int(np.argmin(losses))])


class _Improvement(NamedTuple):
    """Map from points (n, p) to the improved unknowns of each and their losses."""

    problem: Problem
    unknowns: Unknowns

    def __call__(self, points: np.ndarray) -> tuple[list[Unknowns], list[float]]:
        # Normal equations are solved on the host: batches of LAPACK calls within XLA can wait for each other for ever.
        estimates = [Unknowns(jnp.asarray(y), self.unknowns.start) for y in points]
        here = linearise_batch(self.problem, estimates)
        damping = np.full(len(points), DAMPING)
        for _ in range(_STEPS):
            trials, proposed = list(estimates), []
            for k, errors in enumerate(here):
                dy = propose(errors, damping[k], _TOLERANCE) if errors.is_finite else None
                if dy is not None:
                    trials[k] = errors.update(estimates[k], dy)
                    proposed.append(k)
            if not proposed:
                break
            # All points are evaluated, so that one program of one size serves every step.
            there = linearise_batch(self.problem, trials)
            for k in proposed:
                if there[k].is_finite and there[k].loss < here[k].loss:
                    estimates[k], here[k] = trials[k], there[k]
                    damping[k] /= 10
                else:
                    damping[k] *= 10
        return estimates, [errors.loss for errors in here]


def _tree(system, parameters, positive, free) -> Parameters:
    if parameters is None:
        tree = Parameters(system)
        tree = tree if positive is None else tree.positive(positive)
        tree = tree if free is None else tree.free(free)
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
    objective: Objective = Objective(),  # noqa: B008
    **options: Any,
) -> float:
    """Error that `fit_parameters` minimises, in per cent of the root mean square, without a fit.

    **Arguments:** as of `fit_parameters`. **Raises:** as there.
    """
    (objective,) = merge_options(options, objective)
    problem, _ = pose_problem(Parameters(system), objective, log)
    errors = eqx.filter_jit(errors_of)(problem.start, problem)
    return 100 * float(jnp.sqrt(jnp.sum(errors**2)))
