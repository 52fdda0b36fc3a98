"""Errors of a fit and of its prior as functions of the unknowns, their Jacobians, and the cause where they are not finite.

Segments are independent, like the samples of a batch. Each device evaluates its own segments and their gradients; an iteration
of a fit exchanges one all-reduce of as many numbers as there are unknowns.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.identify.blocks import apply_blocks
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.mechanisms import Measured, build_scene, check_motors, observation_columns, with_sensors
from jaxdyn.identify.methods import LinearErrors, Unknowns, eliminate_starts, with_prior
from jaxdyn.identify.options import BALANCES, SIMULATED, Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.result import (
    Segments,
    check_spacing,
    cut_segments,
    inverse_torque,
    regressor_torque,
    simulation_options,
    with_even_steps,
)
from jaxdyn.identify.torque_terms import Friction, smoothing_by_filter
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import has_drives

AXIS = "segments"


def shard_blocks(pieces: Any, devices: Sequence[Any] | None) -> tuple[Any, Any]:
    """Shard segments (leading axis of arrays) over as many devices as divide their number, and make the mesh of these.

    The mesh is None for one device, or where `devices` is None; the segments then stay where they are.

    **Raises:** ValueError for no device.
    """
    if devices is None:
        return pieces, None
    if not len(devices):
        raise ValueError("devices is empty; give some of jax.devices(), or None for one")
    count = len(jax.tree.leaves(pieces)[0])
    # Shards have equal size; segments added to fill one up would count in the loss.
    maximum = max(n for n in range(1, len(devices) + 1) if count % n == 0)
    if maximum == 1:
        return pieces, None
    mesh = jax.make_mesh((maximum,), (AXIS,), devices=list(devices)[:maximum], axis_types=(jax.sharding.AxisType.Auto,))
    return jax.device_put(pieces, jax.NamedSharding(mesh, jax.P(AXIS))), mesh


def map_by_device(function: Callable, mesh: Any) -> Callable:
    """Map `function(shared, pieces)`, whose results have the axis of the segments, over the devices."""
    return function if mesh is None else _by_device(function, mesh, jax.P(AXIS))


def sum_over_devices(function: Callable, mesh: Any) -> Callable:
    """Sum over devices of `function(searched, known)`, which adds up over the segments of one device.

    `searched` and `known` are pairs of pytrees: shared by all devices, and with the axis of the segments. Derivatives are by
    `searched`, in reverse mode and of first order. Each device computes its own, and those by shared unknowns
    are in the same all-reduce as the sum itself.
    """
    if mesh is None:
        return function
    rows = jax.P(), jax.P(AXIS)

    def value(shared, pieces):
        return lax.psum(function((shared[0], pieces[0]), (shared[1], pieces[1])), AXIS)

    def both(shared, pieces):
        searched, known = (shared[0], pieces[0]), (shared[1], pieces[1])
        loss, gradients = jax.value_and_grad(function)(searched, known)
        loss, of_all = lax.psum((loss, gradients[0]), AXIS)
        return (loss, of_all), gradients[1]

    @eqx.filter_custom_vjp
    def total(searched, known):
        return _by_device(value, mesh, jax.P())(*zip(searched, known, strict=True))

    @total.def_fwd
    def _(perturbed, searched, known):
        (loss, of_all), of_pieces = _by_device(both, mesh, rows)(*zip(searched, known, strict=True))
        return loss, (of_all, of_pieces)

    @total.def_bwd
    def _(gradients, change, perturbed, searched, known):
        return jax.tree.map(lambda gradient: change * gradient, gradients)

    return total


def _by_device(function: Callable, mesh: Any, results: Any) -> Callable:
    """Wrap `function(shared, pieces)` in `jax.shard_map`."""

    def call(shared, pieces):
        # shard_map accepts arrays only; functions and settings pass through the closure.
        arrays, rest = eqx.partition((shared, pieces), eqx.is_array)
        each = jax.shard_map(
            lambda *arrays: function(*eqx.combine(arrays, rest)),
            mesh=mesh,
            in_specs=(jax.P(), jax.P(AXIS)),
            out_specs=results,
            # The check that values agree on all devices refuses loops of simulations, which start from constants.
            check_vma=False,
        )
        return each(*arrays)

    return call


class Problem(eqx.Module):
    """Problem of a fit: minimise the sum of squared errors of all segments / N, plus noise^2/N |residual of the prior|^2.

    `batches`: segments of equal length each; `meshes`: of the devices that share those of a batch, None for one device.
    """

    tree: Parameters
    objective: Objective
    batches: tuple[Segments, ...]
    scale: Array
    meshes: tuple[Any, ...] = eqx.field(static=True)

    @property
    def count(self) -> int:
        """Number of segments."""
        return sum(batch.t.shape[0] for batch in self.batches)

    @property
    def divisor(self) -> float:
        """N: samples times coordinates; of a balance, segments times coordinates."""
        width = 1 if self.objective.error == "energy" else self.batches[0].tau.shape[-1]
        if self.objective.observed is not None and self.objective.error != "energy":
            width = len(self.objective.observed)
        if self.objective.error in ("momentum", "energy"):
            return float(self.count * width)
        return float(sum(batch.t.size for batch in self.batches) * width)

    @property
    def prior_weight(self) -> float:
        """noise^2/N."""
        return self.objective.noise**2 / self.divisor

    @property
    def start(self) -> Unknowns:
        """Unknowns of the system as given, from the measured initial states."""
        if self.objective.initial != "free":
            return Unknowns(self.tree.start, None)
        return Unknowns(self.tree.start, jnp.zeros((self.count, 2, self.batches[0].tau.shape[-1]), self.tree.dtype))


def pose_problem(
    tree: Parameters, objective: Objective, log: Log | Sequence[Log], devices: Sequence[Any] | None = None
) -> tuple[Problem, tuple[Log, ...]]:
    """Problem of a parameter tree and logs, whose segments are sharded over devices, and the logs.

    **Raises:** ValueError for logs of another system, a horizon that does not fit, logs of unequal length where segments must
    have one length, and for constraints or drives with a state in an error that does not allow them.
    """
    system, scene = tree.given, build_scene(tree.given)
    if scene.constraints and (
        objective.error == "momentum" or (objective.error == "torque" and objective.observed is None)
    ):
        raise ValueError(
            f"the scene has {len(scene.constraints)} constraints, whose forces cannot be identified from torques; name "
            "the motors as observed= with error='torque', or take 'trajectory' or 'energy'"
        )
    logs, horizon = as_logs(log, scene.system, needs=objective.needs), objective.horizon
    if objective.observed is not None:
        # The torques of motors determine those of a mechanism only where there are as many as degrees of freedom.
        is_driven = scene.constraints and objective.error == "torque"
        find = (
            partial(check_motors, scene, np.asarray(logs[0].q)[0])
            if is_driven
            else partial(observation_columns, scene.system)
        )
        objective = dataclasses.replace(objective, observed=find(objective.observed))
    if has_drives(scene) and objective.error not in SIMULATED:
        raise ValueError(
            f"error is {objective.error!r}, and the scene has drives with a state (jd.forces.DriveDynamics), whose log holds "
            "commands; take error='trajectory'"
        )
    # The time of a Model starts at zero in every segment; that of other systems, which may depend on it, is the log's.
    bare = isinstance(system, Measured) and not (scene.forces or scene.constraints)
    restart = isinstance(scene.system if bare else system, Model) and objective.error != "closed-loop"
    cut = partial(cut_segments, dtype=tree.dtype, restart=restart)
    if objective.error == "torque":
        parts = [cut(log, None) for log in logs]
        has_friction = any(isinstance(force, Friction) for force in scene.forces)
        if has_friction and not scene.constraints and any(log.cutoff is not None for log in logs):
            changes = [np.asarray(smoothing_by_filter(scene, log)[None], tree.dtype) for log in logs]
            parts = [dataclasses.replace(part, smoothing=x) for part, x in zip(parts, changes, strict=True)]
        flat = jax.tree.map(lambda *x: np.concatenate(x, axis=1), *parts)
        if not isinstance(system, Measured):
            # Without a delay samples are independent: each is a segment.
            batches = [jax.tree.map(lambda x: x[0, :, None], flat)]
        elif len({len(log) for log in logs}) == 1:
            batches = [jax.tree.map(lambda *x: np.concatenate(x), *parts)]
        else:
            batches = parts
    else:
        if horizon is None and objective.error in BALANCES:
            horizon = min(20, *(len(log) - 1 for log in logs))
        flat = cut(logs, horizon)
        if objective.error in SIMULATED:
            options = with_even_steps(simulation_options(objective.substeps, objective.simulation), flat)
            check_spacing(options, devices)
            objective = dataclasses.replace(objective, substeps=None, simulation=options)
        batches = [flat]
    scale = _scale(objective, scene.system, flat)
    shared = [shard_blocks(jax.tree.map(jnp.asarray, batch), devices) for batch in batches]
    return Problem(tree, objective, tuple(x for x, _ in shared), scale, tuple(mesh for _, mesh in shared)), logs


@eqx.filter_jit
def _scale(objective: Objective, system, pieces):
    return objective.scale(system, pieces)


def on_one_device(problem: Problem) -> Problem:
    """Copy of a problem on one device."""
    batches = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), x.dtype), problem.batches)
    return dataclasses.replace(problem, batches=batches, meshes=(None,) * len(batches))


def segment_errors(problem: Problem, divisor: float, y, change, piece: Segments) -> Float[Array, "n k"]:
    """Errors of one segment, scaled so that the loss is the sum of the squares of all."""
    measured = with_sensors(problem.tree.system(y))
    # One regressor for all directions of the inertias: tenfold faster than a recursion for each.
    torque = regressor_torque if problem.tree.keeps_regressor else inverse_torque
    return problem.objective.errors(measured, piece, change, problem.scale, torque) / divisor**0.5


def _split_batches(problem: Problem) -> tuple[Problem, tuple[Segments, ...]]:
    """Split a problem into what all devices hold and the segments that are sharded."""
    return eqx.tree_at(lambda problem: problem.batches, problem, ()), problem.batches


def prior_errors(problem: Problem, y) -> Float[Array, " k"]:
    """Errors of the prior (k,), in the same scale."""
    return problem.prior_weight**0.5 * problem.tree.residual(y)


def data_errors(estimate: Unknowns, problem: Problem) -> Float[Array, " n"]:
    """Errors of the data at a point."""
    (rest, batches), divisor, parts = _split_batches(problem), problem.divisor, []

    def rows(shared, pieces):
        problem, y = shared
        return jax.vmap(partial(segment_errors, problem, divisor, y))(*pieces)

    for batch, mesh in zip(batches, problem.meshes, strict=True):
        parts.append(map_by_device(rows, mesh)((rest, estimate.y), (estimate.start, batch)).reshape(-1))
    return jnp.concatenate(parts)


def errors_of(estimate: Unknowns, problem: Problem) -> Float[Array, " n"]:
    """All errors at a point, those of the prior after those of the data."""
    return jnp.concatenate([data_errors(estimate, problem), prior_errors(problem, estimate.y).astype(estimate.y.dtype)])


def loss_of(estimate: Unknowns, problem: Problem) -> Float[Array, ""]:
    """Sum of the squares of all errors at a point, for reverse mode."""
    (rest, batches), divisor = _split_batches(problem), problem.divisor

    def squares(searched, known):
        (y, start), (problem, pieces) = searched, known
        errors = jax.vmap(partial(segment_errors, problem, divisor, y))(start, pieces)
        return jnp.sum(errors * errors)

    loss = jnp.sum(prior_errors(problem, estimate.y) ** 2).astype(estimate.y.dtype)
    for batch, mesh in zip(batches, problem.meshes, strict=True):
        loss = loss + sum_over_devices(squares, mesh)((estimate.y, estimate.start), (rest, batch))
    return loss


def forward(problem: Problem) -> Problem:
    """Copy of a problem whose simulations are differentiable in forward mode."""
    objective = problem.objective
    if objective.error not in SIMULATED:
        return problem
    objective = dataclasses.replace(objective, simulation=objective.simulation | {"adjoint": "forward"})
    return dataclasses.replace(problem, objective=objective)


def linearise(problem: Problem, estimate: Unknowns, numbers: "NumbersAt | None" = None) -> LinearErrors:
    """Linear errors near a point, those of the data followed by those of the prior; `numbers` at the point, if known."""
    parts = jacobians_at(problem, estimate)
    numbers = numbers_at(problem.tree, estimate.y) if numbers is None else numbers
    return _assemble(problem, estimate, parts, numbers[2:4])


def linearise_batch(problem: Problem, estimates: Sequence[Unknowns]) -> list[LinearErrors]:
    """Linear errors near several points, by one vectorised program."""
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *estimates)
    parts, *prior = jax.tree.map(np.asarray, _jacobians_of_batch(problem, stack))
    own = [jax.tree.map(lambda x, k=k: x[k], (parts, prior)) for k in range(len(estimates))]
    return [_assemble(problem, estimate, *one) for estimate, one in zip(estimates, own, strict=True)]


data_errors_at = eqx.filter_jit(data_errors)


def _assemble(problem: Problem, estimate: Unknowns, parts, prior) -> LinearErrors:
    # Once: functions of NumPy would compute with arrays of JAX.
    parts = jax.tree.map(np.asarray, parts)
    if len(parts) > 1:
        # Only simulated errors have free initial states, and their segments are one batch. Without these the boundaries of
        # segments do not matter: batches of any lengths become one list.
        errors = np.concatenate([errors.reshape(1, -1) for errors, _, _ in parts], axis=1)
        rows = np.concatenate([rows.reshape(1, -1, estimate.y.size) for _, rows, _ in parts], axis=1)
        parts = [(errors, rows, None)]
    data = eliminate_starts(*parts[0])
    residual, by_y = prior
    return with_prior(data, residual, by_y, problem.prior_weight)


def _jacobians(problem: Problem, estimate: Unknowns):
    """Errors and Jacobians of the data.

    For each batch errors (segments, n), their Jacobians by y (segments, n, p) and by each segment's own initial state
    (segments, n, 2 nv) or None.
    """
    (rest, batches), divisor = _split_batches(forward(problem)), problem.divisor

    def one(problem, y, change, piece):
        # Errors are returned as auxiliary output too: one simulation gives values and Jacobian.
        def twice(y, change):
            errors = segment_errors(problem, divisor, y, change, piece).reshape(-1)
            return errors, errors

        return jax.jacfwd(twice, 0 if change is None else (0, 1), has_aux=True)(y, change)

    def rows(shared, pieces):
        return jax.vmap(partial(one, *shared))(*pieces)

    parts = []
    for batch, mesh in zip(batches, problem.meshes, strict=True):
        by_unknowns, errors = map_by_device(rows, mesh)((rest, estimate.y), (estimate.start, batch))
        by_y, by_start = by_unknowns, None
        if estimate.start is not None:
            by_y, by_start = by_unknowns[0], by_unknowns[1].reshape(*errors.shape, -1)
        parts.append((errors, by_y, by_start))
    return parts


jacobians_at = eqx.filter_jit(_jacobians)


@eqx.filter_jit
def _jacobians_of_batch(problem: Problem, estimates: Unknowns):
    tree = problem.tree
    prior = jax.vmap(lambda y: (tree.residual(y), jax.jacfwd(tree.residual)(y)))(estimates.y)
    return jax.vmap(partial(_jacobians, problem))(estimates), *prior


class NumbersAt(NamedTuple):
    """Numbers (m,) of a tree at y, their Jacobian (m, p), residuals (k,) of the prior and their Jacobian, and leaves by place."""

    values: Array
    jacobian: Array
    residual: Array
    prior: Array
    leaves: dict[int, Array]


@eqx.filter_jit
def numbers_at(tree: Parameters, y) -> NumbersAt:
    """Numbers, prior, and leaves of the system at y: one program for all."""

    def both(y):
        leaves, values = apply_blocks(tree, y, "values")
        numbers = values, tree.residual(y)
        return numbers, (*numbers, leaves)

    (jacobian, prior), (values, residual, leaves) = jax.jacfwd(both, has_aux=True)(y)
    return NumbersAt(values, jacobian, residual, prior, leaves)


def explain_not_finite(problem: Problem, estimate: Unknowns, logs: Sequence[Log]) -> str | None:
    """Message on errors or Jacobians that are not finite: the log, the sample, the coordinate, and the parameters at fault.

    A parameter is named when the errors are finite with it at its start and all others as they are.
    """
    problem = on_one_device(problem)
    samples, before = segment_starts(problem, logs), 0
    jacobians = jacobians_at(problem, estimate)
    for batch, (_, by_y, _) in zip(problem.batches, jacobians, strict=True):
        errors = np.asarray(_errors_at(problem, batch, estimate.y, estimate.start))
        bad = ~np.isfinite(errors)
        if bad.any():
            piece, row, column = (int(i) for i in np.argwhere(bad)[0])
            log, first = samples[before + piece]
            culprits = _parameters_to_blame(problem, batch, estimate)
            remedy = f"; finite with {' or '.join(culprits)} where it started" if culprits else ""
            return f"errors of log {log + 1} are not finite from sample {first + row} on, error {column}{remedy}"
        bad = ~np.isfinite(np.asarray(by_y))
        if bad.any():
            piece, row, parameter = (int(i) for i in np.argwhere(bad)[0])
            log, first = samples[before + piece]
            return (
                f"errors of log {log + 1} have no finite derivatives from sample {first + row // errors.shape[-1]} on, by "
                f"{_parameter_name(problem.tree, parameter)}"
            )
        before += batch.t.shape[0]
    residual = np.asarray(problem.tree.residual(estimate.y))
    return None if np.isfinite(residual).all() else "the prior's residuals are not finite"


def segment_starts(problem: Problem, logs: Sequence[Log]) -> list[tuple[int, int]]:
    """Log and first sample of every segment."""
    # Segments of one sample are all samples; others share their end points.
    length = problem.batches[0].t.shape[1]
    whole = len(problem.batches) > 1 or (problem.objective.error == "torque" and length > 1)
    samples = []
    for k, log in enumerate(logs):
        size = len(log) if whole else max(length - 1, 1)
        count = 1 if whole else len(log) if length == 1 else (len(log) - 1) // size
        # Remaining samples at the end of a log are in no segment (`replay.segments`).
        samples += [(k, i * size) for i in range(count)]
    return samples


@eqx.filter_jit
def _errors_at(problem: Problem, batch: Segments, y, start):
    rest, _ = _split_batches(problem)
    return jax.vmap(partial(segment_errors, rest, problem.divisor, y))(start, batch)


def _parameters_to_blame(problem: Problem, batch: Segments, estimate: Unknowns) -> list[str]:
    names = []
    for i in range(estimate.y.size):
        # Zero is the start, where the number cannot be at fault.
        if float(estimate.y[i]) != 0:
            errors = _errors_at(problem, batch, estimate.y.at[i].set(0.0), estimate.start)
            if bool(jnp.isfinite(errors).all()):
                names.append(_parameter_name(problem.tree, i))
    return names


def _parameter_name(tree: Parameters, i: int) -> str:
    """Name of the number with the largest derivative by the coordinate y_i."""
    jacobian: Any = np.asarray(numbers_at(tree, tree.start).jacobian)[:, i]
    return tree.names[int(np.argmax(np.abs(jacobian)))]
