"""Loops of a tree closed again, body by body, in single numbers: the projection of q and v for large batches.

With M and A M^-1 A^T factored as in `closed_recursion`, a step -M^-1 A^T (A M^-1 A^T)^-1 r costs two sweeps over the bodies.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn._articulated import factorize
from jaxdyn._links import canonical_bodies, place_joints, stack
from jaxdyn._one_kernel import Kernel, kernel_of
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


class Kernels(NamedTuple):
    """What `Closing` offers, in one kernel each (see `_one_kernel`)."""

    quality: Kernel
    step: Kernel
    apart: Kernel
    slip: Kernel


def kernels(model: Model, loops, q: Array, v: Array, *, long: bool, often: bool = True) -> Kernels | None:
    """Those of a mechanism with q (nq,) and v (nv,) of these shapes and dtypes; None if one of them cannot be had.

    In single numbers or in vectors, all four alike; see `kernel_or_vectors` for `long`, and `Kernel` for `often`.
    """
    rows = jax.ShapeDtypeStruct((sum(loop.kind.count for loop in loops),), q.dtype)
    tree = model, loops
    for in_vectors in (long, not long):
        found = []
        for function, *args in ((_step, q, rows), (_quality, q), (_apart, q), (_slip, q, v)):
            kernel = kernel_of(function, tree, *args, in_vectors=in_vectors)
            if kernel is None:
                break
            found.append(kernel._replace(often=often))
        else:
            step, quality, apart, slip = found
            return Kernels(quality, step, apart, slip)
    return None


class ResidualsInKernels:
    """`Residuals` with each of its methods in one kernel."""

    def __init__(self, model: Model, loops, kernels: Kernels):
        self.tree, self.kernels = (model, loops), kernels

    def _call(self, kernel: Kernel, function, *args):
        return kernel(partial(function, self.tree), *args)

    def apart(self, q: Array) -> Array:
        return self._call(self.kernels.apart, _apart, q)

    def slip(self, q: Array, v: Array) -> Array:
        return self._call(self.kernels.slip, _slip, q, v)


class ClosingInKernels(ResidualsInKernels):
    """`Closing` with each of its methods in one kernel: functions of arrays alone, so each step factors M and the rows anew."""

    def __init__(self, model: Model, loops, q: Array, kernels: Kernels):
        super().__init__(model, loops, kernels)
        self.q, self.quality = q, self._call(kernels.quality, _quality, q)

    def step(self, residual: Array) -> Array:
        return self._call(self.kernels.step, _step, self.q, residual)


def _quality(tree, q):
    model, loops = tree
    return Closing(model, loops, q).quality


def _step(tree, q, residual):
    model, loops = tree
    return Closing(model, loops, q).step(residual)


def _apart(tree, q):
    return Residuals(*tree).apart(q)


def _slip(tree, q, v):
    return Residuals(*tree).slip(q, v)
