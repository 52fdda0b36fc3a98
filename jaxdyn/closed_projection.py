"""Loops of a tree closed again, body by body, in single numbers: the projection of q and v for large batches.

With M and A M^-1 A^T factored as in `closed_recursion`, a step -M^-1 A^T (A M^-1 A^T)^-1 r costs two sweeps over the bodies.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn._articulated import factorize
from jaxdyn._links import canonical_bodies, place_joints, stack
from jaxdyn._scalar import cross, transpose
from jaxdyn.closed_recursion import (
    Walk,
    across,
    as_arrays,
    close,
    factored,
    pending_of,
    rows_of,
    solve,
)
from jaxdyn.model import Model


class Residuals:
    """Residuals of a tree's loops."""

    def __init__(self, model: Model, loops):
        self.model = model
        self.bodies, self.loops = canonical_bodies(model), close(model, loops)

    def apart(self, q: Array) -> Array:
        """phi(q), (nc,)."""
        walk = Walk(self.model, place_joints(self.model, self.bodies, q))
        found = []
        for loop in self.loops:
            seen = across(loop, walk)
            found += [seen.p[i] for i in loop.slides]
            if loop.turn is not None:
                found += loop.turn(as_arrays(seen.R, q.dtype))
        return stack([found], q)

    def slip(self, q: Array, v: Array) -> Array:
        """A v, (nc,)."""
        walk = Walk(self.model, place_joints(self.model, self.bodies, q), v)
        found = []
        for loop in self.loops:
            seen = across(loop, walk)
            found += [seen.slide[i] for i in loop.slides]
            if loop.turn is not None:
                R, turning = as_arrays((seen.R, seen.turning), q.dtype)
                rate = transpose([cross(turning, column) for column in transpose(R)])
                found += jax.jvp(loop.turn, (R,), (rate,))[1]
        return stack([found], q)


class Closing(Residuals):
    """Residuals of a tree's loops, and their rows at q, factored. `quality`: least pivot over the largest one."""

    def __init__(self, model: Model, loops, q):
        super().__init__(model, loops)
        moves = place_joints(model, self.bodies, q)
        walk = Walk(model, moves)
        rows = [(loop, *row) for loop in self.loops for row in rows_of(loop, walk, q.dtype)]
        pending = [pending_of(loop, pair) for loop, pair, _ in rows]
        self.factored = factored(model, moves, factorize(model, self.bodies, moves), pending)
        pivots = jnp.stack(self.factored.pivots)
        self.quality = jnp.min(pivots) / jnp.max(pivots)

    def step(self, residual: Array) -> Array:
        """B r (nv,): the least change of q or v, in the metric M, that removes a residual (nc,)."""
        still: Any = [0] * self.model.nv
        return solve(self.model, self.factored, still, None, list(jnp.unstack(residual)), residual)[0]
