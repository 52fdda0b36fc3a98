"""Many starts at once: all are improved side by side, here or on workers, and the best goes on."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree

from jaxdyn.identify.gauss_newton import Unknowns
from jaxdyn.identify.problem import Problem, errors_of, forward
from jaxdyn.identify.stepwise import SOLVERS, solver_of
from jaxdyn.tasks import DaskClient, count_workers, map_tasks

_STEPS, _TOLERANCE = 20, 1e-4


def best_start(
    problem: Problem, unknowns: Unknowns, starts: int, spread: float, seed: int, client: DaskClient | None = None
) -> Unknowns:
    """The best of so many points after some steps of Levenberg and Marquardt from each, in one `jax.vmap` on each worker.

    The first start is the given one; the coordinates of the others are normal with deviation `spread`.

    **Raises:** ValueError for a spread that is not positive, and where no start has finite errors.
    """
    if not spread > 0:
        raise ValueError(f"spread is {spread}; give a positive number, the deviation of the starts' coordinates")
    y = unknowns.y
    far = spread * jax.random.normal(jax.random.key(seed), (starts, y.size), y.dtype)
    points = y[None] + far.at[0].set(0.0)
    blocks = np.array_split(np.asarray(points), min(starts, count_workers(client)))
    blocks = map_tasks(_Improvement(problem, unknowns), blocks, client)
    candidates, losses = jax.tree.map(lambda *parts: jnp.concatenate(parts), *blocks)
    losses = np.where(np.isfinite(np.asarray(losses)), np.asarray(losses), np.inf)
    if not np.isfinite(losses).any():
        raise ValueError(
            f"none of {starts} starts has finite errors; give a smaller spread (now {spread}), or a shorter horizon"
        )
    return jax.tree.map(lambda x: x[int(np.argmin(losses))], candidates)


class _Improvement(NamedTuple):
    """From points (n, p) to what they become and their losses (n,)."""

    problem: Problem
    unknowns: Unknowns

    def __call__(self, points: np.ndarray):
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return _improve(forward(self.problem), self.unknowns, jnp.asarray(points))


@eqx.filter_jit
def _improve(problem: Problem, unknowns: Unknowns, points):
    solver = solver_of(SOLVERS[0], _TOLERANCE)

    def one(y):
        z, unflatten = ravel_pytree(Unknowns(y, unknowns.start))
        args = (problem, unknowns)
        solution = optx.least_squares(errors_of, solver, z, args, options={"jac": "fwd"}, max_steps=_STEPS, throw=False)
        loss = jnp.sum(errors_of(solution.value, args) ** 2)
        return unflatten(solution.value), loss

    return jax.vmap(one)(points)
