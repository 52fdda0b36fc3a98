"""Steps of explicit Runge-Kutta methods on one flat state, with a projection inside the step.

diffrax gathers the stages of a step in buffers, one for each part of the state, and takes products with rows of the tableau.
For states as small as those of mechanisms that costs more than the dynamics. Here the state is one vector, and each stage is
added, as soon as it is known, to the sums of all that need it.

XLA:CPU runs the operations of a loop one after the other if none of their arrays has more than `_SMALL` bytes. Otherwise it
hands them to a scheduler, which takes longer for each than small operations do. So sums, stages and tableau of a
small state are kept in pieces of that size.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn._anywhere import anywhere, redone
from jaxdyn._by_batch import by_batch
from jaxdyn._dispatch import LEAST_BATCH
from jaxdyn._implicit import along, implicit
from jaxdyn._one_kernel import kernel_of
from jaxdyn._tracing import split
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
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        return ravel_pytree(self.y0)[1](jnp.concatenate(self.inner.evaluate(t0, left=left)))


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
        interpolation = partial(_Interpolation, self.solver.interpolation_cls)
        return interpolation if self.project is None else partial(Bent, interpolation)

    def init(self, terms, t0, t1, y0, args):
        """The last stage of the step before, and whether there is one."""
        return jnp.zeros_like(ravel_pytree(y0)[0]), jnp.asarray(False)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step, projected where it ends."""
        plan, start, structure = _Plan(self, y0, args), *ravel_pytree(y0)
        kept, ready = solver_state
        state = t0, t1, start, kept, ready & ~jnp.asarray(made_jump)

        def values(terms, *state):
            unknown, known = split(terms)
            # The one number in a term is diffrax's direction of time, which is forward where there are no `args`.
            terms = known([1 if jnp.issubdtype(x.dtype, jnp.integer) else x for x in unknown])
            return by_batch(partial(in_turn, plan, terms), partial(at_once, plan, terms), LEAST_BATCH, *state)

        def tangent(terms, *rest):
            *state, steps = rest
            found, moved = along(partial(in_turn, plan), (terms, *state), steps)
            return found, jax.tree.map(_still, found) if moved is None else moved

        # What is traced elsewhere than in the state is not known when it comes to the choice by the batch.
        found: Any = in_turn(plan, terms, *state) if args is not None else implicit(terms, state, values, tangent)
        projected, shift, error, raw, k, result = found
        dense = {"y0": y0, "y1": structure(raw), "pieces": k}
        if self.project is not None:
            dense = {"dense_info": dense, "shift": structure(shift)}
        dt = jnp.asarray(t1 - t0, start.dtype)
        last = _row(k, -1) / jnp.where(dt == 0, jnp.ones_like(dt), dt)
        reusable = jnp.asarray(plan.tableau.fsal and (self.project is None or plan.lasts))
        return structure(projected), structure(error), dense, (last, reusable), result


class _Plan:
    """How a step is made: `sums` has rows of what is added for each stage, for the result and for the error."""

    def __init__(self, method: ExplicitSteps, y0, args):
        self.method, self.args = method, args
        self.structure = ravel_pytree(y0)[1]
        tableau: Any = method.solver.tableau  # of one term
        self.tableau, self.count = tableau, tableau.num_stages
        self.sums = np.zeros((self.count + 2, self.count))
        for i, row in enumerate(tableau.a_lower):
            self.sums[i + 1, : i + 1] = row
        self.sums[self.count], self.sums[self.count + 1] = tableau.b_sol, tableau.b_error
        self.times = np.concatenate([[0.0], tableau.c])
        # Whether the last stage comes after the projection, and whether the error is known before it.
        self.lasts = method.project is not None and passes_last_stage_on(tableau, method.jumping, method.branching)
        self.known = bool(tableau.b_error[-1] == 0)

    def rate(self, terms, t0, t1, y, c):
        """A stage: (t1 - t0) times the vector field."""
        t = jnp.where(c == 1, t1, t0 + c * (t1 - t0))
        return jnp.asarray(t1 - t0, y.dtype) * ravel_pytree(terms.vf(t, self.structure(y), self.args))[0]

    def first(self, terms, t0, t1, start, kept, ready):
        """The first stage, from the last one of the step before where that is `ready`."""
        # For the whole batch: a branch that differs between samples would be computed for all.
        ready = ~anywhere(~ready) if self.tableau.fsal else jnp.asarray(False)
        dt = jnp.asarray(t1 - t0, start.dtype)
        return lax.cond(ready, lambda y: dt * kept, lambda y: self.rate(terms, t0, t1, y, 0.0), start)

    def ended(self, t1, y, error):
        """y projected, what that adds, the error, and a result."""
        given = self.method.ended(t1, self.structure(y), self.structure(error), self.args)
        return *(ravel_pytree(x)[0] for x in given[:3]), given[3]


def in_turn(plan: _Plan, terms, t0, t1, start, kept, ready):
    """The result of a step, what a projection adds to it, its error, the result before, stages in pieces, and a code.

    One loop over the stages.
    """
    count, none = plan.count, jnp.zeros_like(start)
    ready = ~anywhere(~ready) if plan.tableau.fsal else jnp.asarray(False)
    dt = jnp.asarray(t1 - t0, start.dtype)
    times = jnp.asarray(plan.times, jnp.result_type(t0, t1))
    rows = jnp.arange(count), _pieces(jnp.asarray(plan.sums.T, start.dtype), count), times

    def stage(carry, row):
        total, *end = carry
        i, weights, c = row
        y = start + _row(total, i)
        if plan.lasts:
            error = _row(total, count + 1) if plan.known else none
            ended = partial(plan.ended, t1)
            end = lax.cond(i == count - 1, ended, lambda y, _: (y, *end[1:]), y, error)
            y = end[0]
        k = lax.cond(ready & (i == 0), lambda y: dt * kept, lambda y: plan.rate(terms, t0, t1, y, c), y)
        k, weights = _pieces(k, count + 2), jnp.concatenate(weights)
        total = tuple(part + weights[:, None] * k[None] for part, k in zip(total, k, strict=True))
        return (total, *end), k

    blank = tuple(jnp.zeros((count + 2, part.size), start.dtype) for part in _pieces(start, count + 2))
    first = blank, start, none, none, diffrax.RESULTS.successful
    (total, *found), k = lax.scan(stage, first, rows)
    return _finished(plan, t1, start + _row(total, count), _row(total, count + 1), found, k)


def _finished(plan: _Plan, t1, raw, error, end: Any, k):
    """What `in_turn` returns; `end` is where the projection left the step, if there is one before the last stage."""
    if plan.method.project is None:
        end = raw, jnp.zeros_like(raw), error, diffrax.RESULTS.successful
    elif not plan.lasts:
        end = plan.ended(t1, raw, error)
    projected, shift, left, result = end
    error = enlarged(error, left) if plan.lasts and not plan.known else left
    return projected, shift, error, raw, k, result


def at_once(plan: _Plan, terms, t0, t1, start, kept, ready):
    """The same with the stages in one kernel, if there is one; all of it, unless it ends on constraints, which takes loops."""
    args = t0, t1, start, plan.first(terms, t0, t1, start, kept, ready)

    def redo():
        return in_turn(plan, terms, t0, t1, start, kept, ready)

    whole, stages = partial(_whole, plan), partial(_stages, plan)
    kernel = None if plan.method.branching else kernel_of(whole, terms, *args, for_batches=True)
    if kernel is not None:
        found, served = kernel(partial(whole, terms), *args)
    else:
        kernel = kernel_of(stages, terms, *args, for_batches=True)
        if kernel is None:
            return redo()
        (k, raw, error), served = kernel(partial(stages, terms), *args)
        found = _after(plan, terms, t0, t1, k, raw, error)
    # Where numbers alone do not serve, as where rows are close to dependent, they are NaN.
    return redone(~served, redo, found)


def _stages(plan: _Plan, terms, t0, t1, start, first):
    """All stages but one after the projection, in pieces with a row for that one, the result and the error without it; and
    whether all of these are numbers."""
    k = [first]
    for i in range(1, plan.count - plan.lasts):
        k.append(plan.rate(terms, t0, t1, start + _sum(plan.sums[i], k), float(plan.times[i])))
    raw, error = start + _sum(plan.sums[plan.count], k), _sum(plan.sums[plan.count + 1], k)
    served = jnp.isfinite(sum(map(jnp.sum, k)))
    return (_pieces(jnp.stack([*k, *[jnp.zeros_like(start)] * plan.lasts]), plan.count + 2), raw, error), served


def _after(plan: _Plan, terms, t0, t1, k, raw, error):
    """The whole of a step from its `_stages`."""
    if not plan.lasts:
        return _finished(plan, t1, raw, error, (), k)
    end = plan.ended(t1, raw, error if plan.known else jnp.zeros_like(error))
    last = plan.rate(terms, t0, t1, end[0], 1.0)
    rows = jnp.split(last, np.cumsum([part.shape[-1] for part in k])[:-1])
    k = tuple(lax.dynamic_update_index_in_dim(part, row, plan.count - 1, 0) for part, row in zip(k, rows, strict=True))
    return _finished(plan, t1, raw, error + float(plan.sums[-1, -1]) * last, end, k)


def _whole(plan: _Plan, terms, t0, t1, start, first):
    """All of it, and whether it is numbers."""
    found, served = _stages(plan, terms, t0, t1, start, first)
    found = _after(plan, terms, t0, t1, *found)
    return found, served & jnp.isfinite(jnp.sum(found[0]))


def _still(x):
    """No change of an array."""
    return jnp.zeros_like(x) if jnp.issubdtype(x.dtype, jnp.floating) else np.zeros(x.shape, jax.dtypes.float0)


def _sum(weights, k):
    """Stages times their weights, of which many are zero."""
    terms = [float(weight) * stage for weight, stage in zip(weights, k, strict=False) if weight != 0]
    return functools.reduce(jnp.add, terms) if terms else jnp.zeros_like(k[0])


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
