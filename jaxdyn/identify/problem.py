"""A fit as a function of its unknowns: errors of all pieces of the logs and of the prior, their slopes, and what made a NaN."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.identify.gauss_newton import Unknowns
from jaxdyn.identify.objectives import SIMULATED, Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.replay import Segments
from jaxdyn.identify.sensors import with_sensors


class Problem(eqx.Module):
    """What is minimised: the sum over all pieces of the squared errors / N, plus noise^2/N |residual of the prior|^2.

    `batches`: pieces of equal length each; `origins`: log and first sample of every piece.
    """

    tree: Parameters
    objective: Objective
    batches: tuple[Segments, ...]
    scale: Array
    origins: tuple[tuple[int, int], ...] = eqx.field(static=True)
    noise: float = eqx.field(static=True)

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


def piece_errors(problem: Problem, y, change, piece: Segments) -> Float[Array, "n k"]:
    """Errors of one piece, in shares of the whole: the loss is the sum of all their squares."""
    measured = with_sensors(problem.tree.system(y))
    return problem.objective.errors(measured, piece, change, problem.scale) / problem.divisor**0.5


def errors_of(z, args) -> Float[Array, " n"]:
    """All errors, those of the prior behind those of the data, at the flat unknowns."""
    problem, unknowns = args
    found = ravel_pytree(unknowns)[1](z)
    parts = []
    for batch in problem.batches:
        parts.append(jax.vmap(lambda change, one: piece_errors(problem, found.y, change, one))(found.start, batch))
    prior = problem.prior_weight**0.5 * problem.tree.residual(found.y)
    return jnp.concatenate([*(part.reshape(-1) for part in parts), prior.astype(z.dtype)])


def loss_of(z, args) -> Float[Array, ""]:
    """Sum of the squares of all errors at the flat unknowns."""
    errors = errors_of(z, args)
    return jnp.sum(errors * errors)


def forward(problem: Problem) -> Problem:
    """The problem with simulations that can be differentiated in forward mode."""
    objective = problem.objective
    if objective.error not in SIMULATED:
        return problem
    objective = dataclasses.replace(objective, options=objective.options | {"adjoint": "forward"})
    return dataclasses.replace(problem, objective=objective)


@eqx.filter_jit
def slopes_of(problem: Problem, batch: Segments, found: Unknowns):
    """Errors (pieces, n), their Jacobians by y (pieces, n, p) and by each piece's own start (pieces, n, 2 nv) or None."""
    problem = forward(problem)

    def one(change, piece):
        def twice(y, change):
            errors = piece_errors(problem, y, change, piece).reshape(-1)
            return errors, errors

        return jax.jacfwd(twice, 0 if change is None else (0, 1), has_aux=True)(found.y, change)

    slopes, errors = jax.vmap(one)(found.start, batch)
    if found.start is None:
        return errors, slopes, None
    return errors, slopes[0], slopes[1].reshape(*errors.shape, -1)


@eqx.filter_jit
def prior_slopes(tree: Parameters, y):
    """Residuals (k,) of the prior and their slopes (k, p)."""
    return tree.residual(y), jax.jacfwd(tree.residual)(y)


@eqx.filter_jit
def values_and_slopes(tree: Parameters, y):
    """The numbers (m,) and their slopes (m, p) by y."""
    return tree.values(y), jax.jacfwd(tree.values)(y)


def cause_of(problem: Problem, found: Unknowns) -> str | None:
    """Where errors or slopes are not finite, in words: the log, the sample, the coordinate, and the parameters that do it.

    A parameter is named when the errors are finite with it where it started, all others as they are.
    """
    before = 0
    for batch in problem.batches:
        errors = np.asarray(_errors_at(problem, batch, found.y, found.start))
        bad = ~np.isfinite(errors)
        if bad.any():
            piece, row, column = (int(i) for i in np.argwhere(bad)[0])
            log, first = problem.origins[before + piece]
            culprits = _culprits(problem, batch, found)
            moved = f"; finite with {' or '.join(culprits)} where it started" if culprits else ""
            return f"errors of log {log + 1} are not finite from sample {first + row} on, error {column}{moved}"
        _, slopes, _ = slopes_of(problem, batch, found)
        bad = ~np.isfinite(np.asarray(slopes))
        if bad.any():
            piece, row, parameter = (int(i) for i in np.argwhere(bad)[0])
            log, first = problem.origins[before + piece]
            width = errors.shape[-1]
            return (
                f"errors of log {log + 1} have no finite slopes from sample {first + row // width} on, by "
                f"{_name_of(problem.tree, parameter)}"
            )
        before += batch.t.shape[0]
    residual = np.asarray(problem.tree.residual(found.y))
    return None if np.isfinite(residual).all() else "the prior's residuals are not finite"


@eqx.filter_jit
def _errors_at(problem: Problem, batch: Segments, y, start):
    return jax.vmap(lambda change, one: piece_errors(problem, y, change, one))(start, batch)


def _culprits(problem: Problem, batch: Segments, found: Unknowns) -> list[str]:
    names = []
    for i in range(found.y.size):
        if float(found.y[i]) != 0:
            errors = _errors_at(problem, batch, found.y.at[i].set(0.0), found.start)
            if bool(jnp.isfinite(errors).all()):
                names.append(_name_of(problem.tree, i))
    return names


def _name_of(tree: Parameters, i: int) -> str:
    """Name of the number that the coordinate y_i changes most."""
    slopes: Any = np.asarray(values_and_slopes(tree, tree.start)[1])[:, i]
    return tree.names[int(np.argmax(np.abs(slopes)))]
