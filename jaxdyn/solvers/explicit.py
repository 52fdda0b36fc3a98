"""Steps of explicit Runge-Kutta methods on one flat state, with a projection inside the step.

diffrax gathers the stages of a step in buffers, one for each part of the state, and takes products with rows of the tableau.
For states as small as those of mechanisms that costs more than the dynamics. Here the state is one vector, and each stage is
added, as soon as it is known, to the sums of all that need it.

XLA:CPU runs the operations of a loop one after the other if none of their arrays has more than `_SMALL` bytes. Otherwise it
hands them to a scheduler, which takes longer for each than small operations do: 130 ns for 22. So sums, stages and tableau of a
small state are kept in pieces of that size.
"""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn._anywhere import anywhere
from jaxdyn.projection import enlarged
from jaxdyn.solvers.projected import Bent, ProjectedSolver

_SMALL = 512  # bytes
_MOST_PIECES = 8


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """Dense output of a method whose stages, rows of arrays, are given in pieces."""

    t0: jax.Array
    t1: jax.Array
    inner: Any
    y0: Any

    def __init__(self, interpolation, *, t0, t1, y0, y1, pieces):
        starts, ends = (_pieces(ravel_pytree(y)[0], pieces[0].shape[0] + 2) for y in (y0, y1))
        self.t0 = t0
        self.t1 = t1
        self.inner = interpolation(t0=t0, t1=t1, y0=starts, y1=ends, k=pieces)
        self.y0 = y0

    def evaluate(self, t0, t1=None, left=True):
        return ravel_pytree(self.y0)[1](jnp.concatenate(self.inner.evaluate(t0, t1, left)))


class ExplicitSteps(ProjectedSolver):
    """The steps of an explicit Runge-Kutta method of diffrax, the same but for rounding.

    A projection acts before the last stage where that is the first one of the next step, which then need not be computed anew
    (it is in `ProjectedSolver`). It also acts on the error, which must not need the last stage then, unless the manifold has
    no branches. Entries that are `jumping` change with the projection, and the stage with them.

    **Arguments:** as of `ProjectedSolver`; `project` None for none.
    """

    solver: diffrax.AbstractERK
    project: Callable | None = None

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        """Dense output of the wrapped method, ending at the projected point if there is one."""
        interpolation = functools.partial(_Interpolation, self.solver.interpolation_cls)
        return interpolation if self.project is None else functools.partial(Bent, interpolation)

    def init(self, terms, t0, t1, y0, args):
        """The last stage of the step before, and whether there is one."""
        return jnp.zeros_like(ravel_pytree(y0)[0]), jnp.asarray(False)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step, projected where it ends."""
        tableau: Any = self.solver.tableau  # of one term
        count, start, structure = tableau.num_stages, *ravel_pytree(y0)
        dt = jnp.asarray(t1 - t0, start.dtype)
        # Rows: what is added for each stage, for the result, and for the error.
        sums = np.zeros((count + 2, count))
        for i, row in enumerate(tableau.a_lower):
            sums[i + 1, : i + 1] = row
        sums[count], sums[count + 1] = tableau.b_sol, tableau.b_error
        known = tableau.b_error[-1] == 0
        lasts = self.project is not None and passes_last_stage_on(tableau, self.jumping, self.branching)
        times = jnp.asarray(np.concatenate([[0.0], tableau.c]), jnp.result_type(t0, t1))
        # For the whole batch: a branch that differs between samples would be computed for all.
        kept, ready = solver_state
        ready = ~anywhere(~ready | made_jump) if tableau.fsal else jnp.asarray(False)

        rows = jnp.arange(count), _pieces(jnp.asarray(sums.T, start.dtype), count), times

        def ended(y, error):
            projected, shift, error, result = self.ended(t1, structure(y), structure(error), args)
            return *(ravel_pytree(x)[0] for x in (projected, shift, error)), result

        def rate(y, c):
            t = jnp.where(c == 1, t1, t0 + c * (t1 - t0))
            return dt * ravel_pytree(terms.vf(t, structure(y), args))[0]

        def stage(carry, row):
            total, *end = carry
            i, weights, c = row
            y = start + _row(total, i)
            if lasts:
                error = _row(total, count + 1) if known else none
                end = lax.cond(i == count - 1, ended, lambda y, _: (y, *end[1:]), y, error)
                y = end[0]
            k = lax.cond(ready & (i == 0), lambda y: dt * kept, lambda y: rate(y, c), y)
            k, weights = _pieces(k, count + 2), jnp.concatenate(weights)
            total = tuple(part + weights[:, None] * k[None] for part, k in zip(total, k, strict=True))
            return (total, *end), k

        none = jnp.zeros_like(start)
        blank = tuple(jnp.zeros((count + 2, part.size), start.dtype) for part in _pieces(start, count + 2))
        first = blank, start, none, none, diffrax.RESULTS.successful
        (total, *found), k = lax.scan(stage, first, rows)
        end: Any = found
        raw, error = start + _row(total, count), _row(total, count + 1)
        if self.project is None:
            end = raw, none, error, diffrax.RESULTS.successful
        elif not lasts:
            end = ended(raw, error)
        projected, shift, left, result = end
        error = enlarged(error, left) if lasts and not known else left
        y1, error = structure(projected), structure(error)
        dense = {"y0": y0, "y1": structure(raw), "pieces": k}
        if self.project is not None:
            dense = {"dense_info": dense, "shift": structure(shift)}
        reusable = jnp.asarray(tableau.fsal and (self.project is None or lasts))
        last = _row(k, -1) / jnp.where(dt == 0, jnp.ones_like(dt), dt)
        return y1, error, dense, (last, reusable), result


def _pieces(x, rows: int) -> tuple:
    """An array cut along its last axis so that as many rows of each piece are small, if that takes few pieces."""
    count = -(-rows * x.shape[-1] * x.dtype.itemsize // _SMALL)
    return tuple(jnp.array_split(x, count, -1)) if 1 < count <= _MOST_PIECES else (x,)


def _row(pieces: tuple, i):
    """Row i of an array in pieces."""
    return jnp.concatenate([piece[i] for piece in pieces])


def passes_last_stage_on(tableau, jumping: tuple[str, ...], branching: bool) -> bool:
    """Whether the last stage of a projected step is the first one of the next: see `ExplicitSteps`."""
    return tableau.fsal and not jumping and bool(tableau.b_error[-1] == 0 or not branching)
