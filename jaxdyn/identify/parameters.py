"""Fit of any numbers of any system or scene by the error of torques, balances or simulated motion."""

import dataclasses
import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.blocks import Inertias
from jaxdyn.identify.descent import Descent, Watch, checkpoint_at, descend, on_one_thread
from jaxdyn.identify.interior import TorqueProblem, block_chart, log_cholesky_coordinates
from jaxdyn.identify.logs import Log
from jaxdyn.identify.mechanisms import FitSystem
from jaxdyn.identify.methods import (
    DAMPING,
    RANK_TOLERANCE,
    SOLVERS,
    GaussNewton,
    GradientSteps,
    LeastSquaresSteps,
    LinearErrors,
    Unknowns,
    confirm_minimum,
    propose,
    with_prior,
)
from jaxdyn.identify.options import BALANCES, GAUSS_NEWTON, Execution, Objective, Solver, merge_options
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.problem import (
    NumbersAt,
    Problem,
    data_errors_at,
    errors_of,
    explain_not_finite,
    linearise,
    linearise_batch,
    loss_of,
    numbers_at,
    on_one_device,
    pose_problem,
    segment_starts,
)
from jaxdyn.identify.regression import Blocks, block_slices, least_squares_by_svd, triangle_of
from jaxdyn.identify.result import Fit
from jaxdyn.identify.uncertainty import block_groups, effective_sample_size, jackknife, student
from jaxdyn.model.arguments import Checked, Function, check_known
from jaxdyn.tasks import count_workers, map_tasks

# Excess of the loss of the interior point over the minimum, as a share of the prior's weight.
_EXCESS = 1e-9
# Of the starts: rough, as the best one is fitted to the end afterwards, so that only the order of the losses matters.
_STEPS, _TOLERANCE = 20, 1e-4
# About so many blocks are cut from all logs of a fit; each log has at least one.
_BLOCKS = 20


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
    check_known("fit_parameters", system=system, log=log)
    objective, solver, execution = merge_options(options, objective, solver, execution)
    tree = _tree(system, parameters, positive, free)
    problem, logs = pose_problem(tree, objective, log, execution.devices)
    unknowns = problem.start
    if solver.starts > 1:
        unknowns = _best_start(problem, unknowns, solver, execution)
    callback = execution.callback
    report = None if callback is None else lambda step, loss, at: callback(step, loss, tree.system(at.y))
    key = None
    if execution.checkpoint is not None:
        # The fingerprint is of the numbers, not of their devices: a fit may resume on others.
        numbers = (
            on_one_device(problem),
            unknowns,
            str(solver.method),
            solver.learning_rate,
            solver.tolerance,
            solver.seed,
        )
        key = checkpoint_at(execution.checkpoint, numbers, execution.every, execution.resume)
    watch = Watch(int(solver.steps), report, checkpoint=key, show=execution.progress, seconds=execution.seconds)
    nominal = numbers_at(tree, tree.start)
    end, minimum = _minimise(problem, logs, unknowns, nominal, solver, watch)
    at = numbers_at(tree, end.best.point.y) if minimum is None or minimum.numbers is None else minimum.numbers
    values, jacobian = (np.asarray(x, np.float64) for x in at[:2])
    deviation, factor = None, np.nan
    if minimum is not None:
        deviation, factor = minimum.deviations(jacobian)
    return Fit(
        system=tree.replace(at.leaves),
        nominal=system,
        names=tree.names,
        values=values,
        nominal_values=np.asarray(nominal.values, np.float64),
        deviation=deviation,
        factor=factor,
        history=end.history,
        result=end.result,
        method=f"{objective.error} fit by {solver.name}",
        cause=explain_not_finite(problem, watch.failed, logs) if end.result is RESULTS.nonfinite else None,
        motors=problem.objective.observed,
        as_measured=any(batch.smoothing is not None for batch in problem.batches),
    )


class Minimum(NamedTuple):
    """Errors of the data near a minimum (n,), `width` in a row, and the log (rows,) of each row; `prior` (k, p): its rows.

    `blocks`: errors + rows y, condensed, by blocks of whole segments where there are enough of these; None for errors that are
    not finite. `used`: errors that initial states have used up; `numbers` there, if known.
    """

    errors: np.ndarray
    width: int
    log: np.ndarray
    blocks: Blocks | None
    prior: np.ndarray
    used: int = 0
    numbers: NumbersAt | None = None

    @classmethod
    def of(cls, problem: Problem, logs: Sequence[Log], linear: LinearErrors) -> "Minimum":
        """Condense linear errors."""
        count = len(linear.errors) - linear.priors
        owners = np.array([log for log, _ in segment_starts(problem, logs)])
        # A balance has one row of errors for a segment, other errors one for each sample.
        is_balance = problem.objective.error in BALANCES
        of_segment = np.concatenate(
            [np.full(batch.t.shape[0], 1 if is_balance else batch.t.shape[1]) for batch in problem.batches]
        )
        log = np.repeat(owners, of_segment)
        errors, width, blocks = linear.errors[:count], count // len(log), None
        if linear.is_finite:
            # A unit is what a block cannot divide: a segment, or a row of one.
            whole = len(owners) >= _BLOCKS
            lengths = np.bincount(owners if whole else log)
            slices = block_slices(lengths[lengths > 0].tolist(), _BLOCKS)
            # The first unit, and then the first row, of each block, and the end.
            ends = np.cumsum([0, *(part.stop - part.start for _, part in slices)])
            ends = np.append(0, np.cumsum(of_segment))[ends] if whole else ends
            table = np.concatenate([linear.rows[:count], -errors[:, None]], axis=1)
            tables = [table[width * a : width * b] for a, b in itertools.pairwise(ends)]
            triangles = [[x if len(x) <= x.shape[1] else triangle_of(x)] for x in tables]
            p = linear.rows.shape[1]
            blocks = Blocks(triangles, (np.arange(p),), p, width * np.diff(ends), log[ends[:-1]])
        return cls(errors, width, log, blocks, linear.rows[count:] / linear.prior_weight**0.5, linear.start_rank)

    def deviations(self, jacobian: np.ndarray) -> tuple[np.ndarray, float]:
        """Standard deviations (m,) of numbers with the Jacobian (m, p) by y, and the factor of a 95 % interval.

        The larger of two: that of independent errors of equal size, and that of a jackknife over groups, which accounts for
        errors that are autocorrelated, correlated among coordinates, and larger at some samples. A few groups estimate a
        deviation badly, and a number that a single group determines has no scatter over groups; the other one is then a lower
        bound. Errors of the data have one size, which is estimated from them; errors of the prior have the size that it states.
        Infinite where neither data nor prior determine a number, NaN where errors are no more than the unknowns.

        Source: Bell & McCaffrey (2002), CR3; Angrist & Pischke (2009), "Mostly harmless econometrics", section 8.2, the maximum.
        """
        blocks, prior = self.blocks, self.prior
        if blocks is None:
            return np.full(len(jacobian), np.nan), np.nan
        # The order of samples within a log is needed here: the autocorrelation is one along time.
        table = self.errors.reshape(len(self.log), self.width)
        groups = block_groups(len(blocks), effective_sample_size([table[self.log == k] for k in np.unique(self.log)]))
        factor = student(max(len(groups) - 1, 1))
        whole, count = triangle_of(blocks.rows(np.ones(1))), blocks.count() - self.used
        data = whole[:, :-1]
        if len(prior) == 0:
            count -= least_squares_by_svd(data, np.zeros(len(data)), RANK_TOLERANCE).rank
        if count <= 0:
            return np.full(len(jacobian), np.nan), factor
        # The estimated variance of errors; for errors that are all zero the smallest number keeps the division defined.
        noise = (max(float(np.sum(whole[:, -1] ** 2)), 1e-300) / count) ** 0.5
        rows = np.concatenate([data / noise, prior])
        # Columns of unit length: ranks must not depend on units of the parameters.
        size = np.linalg.norm(rows, axis=0)
        size[size <= 1e-12 * size.max(initial=0.0)] = np.inf
        # The triangle has the singular values of all rows. The full Vt holds the null space where rows are fewer than columns.
        _, s, Vt = np.linalg.svd(triangle_of(rows / size), full_matrices=True)
        rank = int(np.sum(s > RANK_TOLERANCE * s.max(initial=0.0)))
        # No error depends on these coordinates: a number with a share in them is not determined.
        unseen = np.isinf(size)
        scaled = jacobian / np.where(unseen, 1.0, size)
        seen = np.where(unseen[None], 0.0, scaled)
        # A number with any share in the null space of data and prior is not determined.
        is_free = np.linalg.norm(seen @ Vt[rank:].T, axis=1) > 1e-6 * np.linalg.norm(seen, axis=1)
        is_free |= np.abs(scaled[:, unseen]).sum(axis=1) > 0
        # In whitened coordinates data and prior together have the curvature 1, the covariance for independent errors.
        whitening = Vt[:rank].T / s[:rank] / size[:, None]
        numbers, prior = seen @ (Vt[:rank].T / s[:rank]), prior @ whitening
        parts = [np.concatenate([blocks.triangles[k][0] for k in group]) / noise for group in groups]
        parts = [(part[:, :-1] @ whitening, -part[:, -1]) for part in parts]
        grams = np.stack([part.T @ part for part, _ in parts])
        root = jackknife(grams, np.stack([part.T @ error for part, error in parts]), prior.T @ prior).root
        # Errors of the prior have the size that it states: their part needs no estimate from scatter.
        variance = np.sum((numbers @ root) ** 2, axis=1) + np.sum((numbers @ prior.T) ** 2, axis=1)
        return np.where(is_free, np.inf, np.sqrt(np.maximum(variance, np.sum(numbers**2, axis=1)))), factor


def _minimise(
    problem: Problem, logs: Sequence[Log], unknowns: Unknowns, nominal: NumbersAt, solver: Solver, watch: Watch
) -> tuple[Descent, Minimum | None]:
    """End of a minimisation, and the errors near it; None where the method takes no Jacobian."""
    rounding = float(jnp.finfo(unknowns.y.dtype).eps)
    if solver.name == GAUSS_NEWTON:
        start, known, before, minimum = unknowns, None, np.zeros(0), None
        if solver.starts == 1:
            start, known, before, minimum = minimize_linear_torques(problem, logs, unknowns, nominal)
        end = descend(GaussNewton(partial(linearise, problem), solver.tolerance, rounding, known), start, watch)
        # Only steps that lower the loss are accepted: the last point is the best one.
        linear, history = end.last.state[0], np.concatenate([before, end.history])
        result = confirm_minimum(end.result, linear, solver.tolerance, rounding)
        if minimum is None or linear is not known:
            minimum = Minimum.of(problem, logs, linear)
        return Descent(end.last, end.last, history, result), minimum
    if solver.name in SOLVERS:
        end = descend(LeastSquaresSteps(errors_of, problem, solver.name, solver.tolerance), unknowns, watch)
        linear = linearise(problem, end.best.point)
        result = confirm_minimum(end.result, linear, solver.tolerance, rounding)
        return end._replace(result=result), Minimum.of(problem, logs, linear)
    steps = GradientSteps(
        loss_of,
        problem,
        method=solver.method,
        steps=watch.steps,
        learning_rate=solver.learning_rate,
        tolerance=solver.tolerance,
        floor=0.0,
    )
    return descend(steps, unknowns, watch), None


def minimize_linear_torques(
    problem: Problem, logs: Sequence[Log], unknowns: Unknowns, nominal: NumbersAt
) -> tuple[Unknowns, LinearErrors | None, np.ndarray, Minimum | None]:
    """Minimum of the error of torques that are linear in the numbers, by the steps of `fit_torques`, and the losses before it.

    With the linear errors there, None where no step can find one.

    The errors along straight lines in the numbers are those at the start and their Jacobian there times the change z, so that one
    Jacobian, condensed, is enough. Unknowns other than those of `block_chart` stay where they are. Where the torques are not
    linear after all, Gauss-Newton steps follow, from the start where it is better.
    """
    chart = block_chart(problem.tree.blocks) if problem.objective.error == "torque" else None
    if chart is None:
        return unknowns, None, np.zeros(0), None
    here = linearise(problem, unknowns, nominal)
    if not here.is_finite:
        return unknowns, here, np.zeros(0), None
    (weight,) = (float(block.weight) for block in problem.tree.blocks if isinstance(block, Inertias))
    first = Minimum.of(problem, logs, here)
    blocks: Any = first.blocks
    # The divergence replaces the residuals of the inertias' prior; those of other numbers are linear.
    count, places = len(first.errors), chart.places.reshape(-1)
    others = np.flatnonzero(~np.any(here.rows[count:, places] != 0, axis=1)) + count
    rows = np.concatenate([here.rows[others], -here.errors[others, None]], axis=1)
    rows = np.concatenate([blocks.rows(np.ones(1)), rows])
    prior = weight * problem.prior_weight
    # A deviation for which `TorqueProblem`, with half of the squares, has this loss.
    end = TorqueProblem.of(chart, triangle_of(rows), 0.5**0.5, prior).minimize(_EXCESS * prior)
    y, (origin, terms) = np.zeros(unknowns.y.size), end.last.point
    y[places] = log_cholesky_coordinates(origin, chart.count).reshape(-1)
    y[chart.term_places] = np.where(chart.positive, np.log(np.where(chart.positive, terms, 1.0)), terms)
    there, z = Unknowns(jnp.asarray(y, unknowns.y.dtype), None), chart.x(origin, terms)
    errors = np.asarray(data_errors_at(there, problem), np.float64)
    rounding = float(jnp.finfo(unknowns.y.dtype).eps)
    off = np.linalg.norm(first.errors + here.rows[:count] @ z - errors)
    if not off <= rounding ** (2 / 3) * (np.linalg.norm(first.errors) + np.linalg.norm(errors)):
        found = linearise(problem, there)
        return (there, found, end.history[:-1], None) if found.loss < here.loss else (unknowns, here, np.zeros(0), None)
    # The same triangles, by y near the minimum.
    T = chart.coordinate_jacobian(origin, terms)
    triangles = [[np.column_stack([R[:, :-1] @ T, R @ np.append(-z, 1.0)])] for (R,) in blocks.triangles]
    blocks = dataclasses.replace(blocks, triangles=triangles)
    rows = blocks.rows(np.ones(1))
    data = LinearErrors(float(errors @ errors), -rows[:, -1], rows[:, :-1])
    numbers = numbers_at(problem.tree, there.y)
    residual, by_y = (np.asarray(x, np.float64) for x in numbers[2:4])
    found = with_prior(data, residual, by_y, problem.prior_weight)
    return there, found, end.history[:-1], first._replace(blocks=blocks, errors=errors, prior=by_y, numbers=numbers)


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
