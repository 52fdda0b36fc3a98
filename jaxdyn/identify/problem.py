"""A fit as a function of its unknowns: errors of all pieces of the logs and of the prior, their slopes, and what made a NaN."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.identify.divided import mapped, shared_out, summed
from jaxdyn.identify.gauss_newton import Unknowns
from jaxdyn.identify.logs import Log
from jaxdyn.identify.objectives import BALANCES, SIMULATED, Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.replay import Segments, check_spacing, segments, spaced
from jaxdyn.identify.sensors import Measured, with_sensors
from jaxdyn.model.tree import Model


class Problem(eqx.Module):
    """What is minimised: the sum over all pieces of the squared errors / N, plus noise^2/N |residual of the prior|^2.

    `batches`: pieces of equal length each; `meshes`: of the devices that share those of a batch, None for one device.
    """

    tree: Parameters
    objective: Objective
    batches: tuple[Segments, ...]
    scale: Array
    noise: float = eqx.field(static=True)
    meshes: tuple[Any, ...] = eqx.field(static=True)

    @property
    def count(self) -> int:
        """Number of pieces."""
        return sum(batch.t.shape[0] for batch in self.batches)

    @property
    def divisor(self) -> float:
        """N: samples times coordinates; of a balance, pieces times coordinates."""
        width = 1 if self.objective.error == "energy" else self.batches[0].tau.shape[-1]
        if self.objective.observed is not None and self.objective.error != "energy":
            width = len(self.objective.observed)
        if self.objective.error in ("momentum", "energy"):
            return float(self.count * width)
        return float(sum(batch.t.size for batch in self.batches) * width)

    @property
    def prior_weight(self) -> float:
        """noise^2/N."""
        return self.noise**2 / self.divisor


def posed(
    tree: Parameters,
    objective: Objective,
    logs: Sequence[Log],
    horizon: int | None,
    noise: float,
    devices: Sequence[Any] | None = None,
) -> Problem:
    """The fit of a tree of parameters to logs, whose pieces devices share.

    **Raises:** ValueError for a horizon that does not fit, and for logs of unequal length where pieces must have one length.
    """
    system, scene = tree.given, with_sensors(tree.given).scene
    # The clock of a Model starts at zero in every piece; that of anything else is the log's.
    bare = isinstance(system, Measured) and not (scene.forces or scene.constraints)
    restart = isinstance(scene.system if bare else system, Model) and objective.error != "closed-loop"
    cut = partial(segments, dtype=tree.dtype, restart=restart)
    if objective.error == "torque":
        parts = [cut(log, None) for log in logs]
        flat = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *parts)
        if not isinstance(system, Measured):
            # Without a delay samples do not know of each other: each is a piece.
            batches = [jax.tree.map(lambda x: x[0, :, None], flat)]
        elif len({len(log) for log in logs}) == 1:
            batches = [cut(logs, None)]
        else:
            batches = parts
    else:
        if horizon is None and objective.error in BALANCES:
            horizon = min(20, *(len(log) - 1 for log in logs))
        flat = cut(logs, horizon)
        options = spaced(objective.options, flat)
        if objective.error in SIMULATED:
            check_spacing(options, devices)
        objective = dataclasses.replace(objective, options=options)
        batches = [flat]
    scale = _scale(objective, scene.system, flat)
    shared = [shared_out(batch, devices) for batch in batches]
    return Problem(tree, objective, tuple(x for x, _ in shared), scale, noise, tuple(mesh for _, mesh in shared))


@eqx.filter_jit
def _scale(objective: Objective, system, pieces):
    return objective.scale(system, pieces)


def gathered(problem: Problem) -> Problem:
    """The problem on one device."""
    batches = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), x.dtype), problem.batches)
    return dataclasses.replace(problem, batches=batches, meshes=(None,) * len(batches))


def piece_errors(problem: Problem, divisor: float, y, change, piece: Segments) -> Float[Array, "n k"]:
    """Errors of one piece, in shares of the whole: the loss is the sum of all their squares."""
    measured = with_sensors(problem.tree.system(y))
    return problem.objective.errors(measured, piece, change, problem.scale) / divisor**0.5


def _apart(problem: Problem) -> tuple[Problem, tuple[Segments, ...]]:
    """What all devices know, and the pieces that are shared among them."""
    return eqx.tree_at(lambda problem: problem.batches, problem, ()), problem.batches


def prior_errors(problem: Problem, y) -> Float[Array, " k"]:
    """Errors of the prior (k,), in the same shares."""
    return problem.prior_weight**0.5 * problem.tree.residual(y)


def errors_of(z, args) -> Float[Array, " n"]:
    """All errors, those of the prior behind those of the data, at the flat unknowns."""
    problem, unknowns = args
    estimate = ravel_pytree(unknowns)[1](z)
    (rest, batches), divisor, parts = _apart(problem), problem.divisor, []

    def rows(shared, pieces):
        problem, y = shared
        return jax.vmap(partial(piece_errors, problem, divisor, y))(*pieces)

    for batch, mesh in zip(batches, problem.meshes, strict=True):
        parts.append(mapped(rows, mesh)((rest, estimate.y), (estimate.start, batch)).reshape(-1))
    return jnp.concatenate([*parts, prior_errors(problem, estimate.y).astype(z.dtype)])


def loss_of(z, args) -> Float[Array, ""]:
    """Sum of the squares of all errors at the flat unknowns, for reverse mode."""
    problem, unknowns = args
    estimate = ravel_pytree(unknowns)[1](z)
    (rest, batches), divisor = _apart(problem), problem.divisor

    def squares(searched, known):
        (y, start), (problem, pieces) = searched, known
        errors = jax.vmap(partial(piece_errors, problem, divisor, y))(start, pieces)
        return jnp.sum(errors * errors)

    loss = jnp.sum(prior_errors(problem, estimate.y) ** 2).astype(z.dtype)
    for batch, mesh in zip(batches, problem.meshes, strict=True):
        loss = loss + summed(squares, mesh)((estimate.y, estimate.start), (rest, batch))
    return loss


def forward(problem: Problem) -> Problem:
    """The problem with simulations that can be differentiated in forward mode."""
    objective = problem.objective
    if objective.error not in SIMULATED:
        return problem
    objective = dataclasses.replace(objective, options=objective.options | {"adjoint": "forward"})
    return dataclasses.replace(problem, objective=objective)


@eqx.filter_jit
def slopes_of(problem: Problem, estimate: Unknowns):
    """For each batch errors (pieces, n), their Jacobians by y (pieces, n, p) and by each piece's own start (pieces, n, 2 nv)
    or None."""
    (rest, batches), divisor = _apart(forward(problem)), problem.divisor

    def one(problem, y, change, piece):
        def twice(y, change):
            errors = piece_errors(problem, divisor, y, change, piece).reshape(-1)
            return errors, errors

        return jax.jacfwd(twice, 0 if change is None else (0, 1), has_aux=True)(y, change)

    def rows(shared, pieces):
        return jax.vmap(partial(one, *shared))(*pieces)

    parts = []
    for batch, mesh in zip(batches, problem.meshes, strict=True):
        slopes, errors = mapped(rows, mesh)((rest, estimate.y), (estimate.start, batch))
        by_y, by_start = (slopes, None) if estimate.start is None else (slopes[0], slopes[1].reshape(*errors.shape, -1))
        parts.append((errors, by_y, by_start))
    return parts


@eqx.filter_jit
def prior_slopes(tree: Parameters, y):
    """Residuals (k,) of the prior and their slopes (k, p)."""
    return tree.residual(y), jax.jacfwd(tree.residual)(y)


@eqx.filter_jit
def values_and_slopes(tree: Parameters, y):
    """The numbers (m,) and their slopes (m, p) by y."""
    return tree.values(y), jax.jacfwd(tree.values)(y)


def cause_of(problem: Problem, estimate: Unknowns, logs: Sequence[Log]) -> str | None:
    """Where errors or slopes are not finite, in words: the log, the sample, the coordinate, and the parameters that do it.

    A parameter is named when the errors are finite with it where it started, all others as they are.
    """
    problem = gathered(problem)
    samples, before = first_samples(problem, logs), 0
    slopes = slopes_of(problem, estimate)
    for batch, (_, by_y, _) in zip(problem.batches, slopes, strict=True):
        errors = np.asarray(_errors_at(problem, batch, estimate.y, estimate.start))
        bad = ~np.isfinite(errors)
        if bad.any():
            piece, row, column = (int(i) for i in np.argwhere(bad)[0])
            log, first = samples[before + piece]
            culprits = _culprits(problem, batch, estimate)
            moved = f"; finite with {' or '.join(culprits)} where it started" if culprits else ""
            return f"errors of log {log + 1} are not finite from sample {first + row} on, error {column}{moved}"
        bad = ~np.isfinite(np.asarray(by_y))
        if bad.any():
            piece, row, parameter = (int(i) for i in np.argwhere(bad)[0])
            log, first = samples[before + piece]
            return (
                f"errors of log {log + 1} have no finite slopes from sample {first + row // errors.shape[-1]} on, by "
                f"{_name_of(problem.tree, parameter)}"
            )
        before += batch.t.shape[0]
    residual = np.asarray(problem.tree.residual(estimate.y))
    return None if np.isfinite(residual).all() else "the prior's residuals are not finite"


def first_samples(problem: Problem, logs: Sequence[Log]) -> list[tuple[int, int]]:
    """Log and first sample of every piece."""
    # Pieces of one sample are all samples; others share their ends.
    length = problem.batches[0].t.shape[1]
    whole = len(problem.batches) > 1 or (problem.objective.error == "torque" and length > 1)
    samples = []
    for k, log in enumerate(logs):
        size = len(log) if whole else max(length - 1, 1)
        count = 1 if whole else len(log) if length == 1 else (len(log) - 1) // size
        samples += [(k, i * size) for i in range(count)]
    return samples


@eqx.filter_jit
def _errors_at(problem: Problem, batch: Segments, y, start):
    rest, _ = _apart(problem)
    return jax.vmap(partial(piece_errors, rest, problem.divisor, y))(start, batch)


def _culprits(problem: Problem, batch: Segments, estimate: Unknowns) -> list[str]:
    names = []
    for i in range(estimate.y.size):
        if float(estimate.y[i]) != 0:
            errors = _errors_at(problem, batch, estimate.y.at[i].set(0.0), estimate.start)
            if bool(jnp.isfinite(errors).all()):
                names.append(_name_of(problem.tree, i))
    return names


def _name_of(tree: Parameters, i: int) -> str:
    """Name of the number that the coordinate y_i changes most."""
    slopes: Any = np.asarray(values_and_slopes(tree, tree.start)[1])[:, i]
    return tree.names[int(np.argmax(np.abs(slopes)))]
