"""Steps of explicit Runge-Kutta methods on one flat state, with a projection inside the step.

A step is one kernel (`jaxdyn.compile`) where all of it is a program of single numbers, the projection included. Where a
sample of a batch is not served by that, as at rows that are close to dependent, the step is taken again as a loop over the
stages; derivatives are those of that loop.
"""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree

from jaxdyn.compile import implicit, kernel, value_and_jvp
from jaxdyn.compile.batch import any_sample
from jaxdyn.constraints.projection import enlarge
from jaxdyn.model.arguments import Number
from jaxdyn.simulation.solvers.projected import ProjectedInterpolation, ProjectedSolver


class _Interpolation(diffrax.AbstractLocalInterpolation):
    """Dense output of a method whose stages are rows of one array."""

    t0: jax.Array
    t1: jax.Array
    inner: Any
    y0: Any

    def __init__(self, interpolation, *, t0, t1, y0, y1, stages):
        starts, ends = (ravel_pytree(y)[0] for y in (y0, y1))
        self.t0 = t0
        self.t1 = t1
        self.inner = interpolation(t0=t0, t1=t1, y0=starts, y1=ends, k=stages)
        self.y0 = y0

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        return ravel_pytree(self.y0)[1](self.inner.evaluate(t0, left=left))


class ExplicitSteps(ProjectedSolver):
    """The steps of an explicit Runge-Kutta method of diffrax, the same but for rounding.

    A projection acts before the last stage where that is the first one of the next step, which then need not be computed anew
    (it is in `ProjectedSolver`). It also acts on the error, which must not need the last stage then, unless the manifold has
    no branches. Entries that are `step_constants` change with the projection, and the stage with them.

    **Arguments:** as of `ProjectedSolver`; `project` None for none; `field(t, y, args)`, the vector field of the term.
    """

    solver: diffrax.AbstractERK
    project: Callable | None = None
    field: Callable = eqx.field(static=True, kw_only=True)

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Dense output of the wrapped method, ending at the projected point if there is one."""
        interpolation = partial(_Interpolation, self.solver.interpolation_cls)
        return interpolation if self.project is None else partial(ProjectedInterpolation, interpolation)

    def plan(self, y0: PyTree) -> "Plan":
        """How steps of states like this one are made."""
        leaves, tree = jax.tree.flatten(y0)
        shapes = tuple(x.shape for x in leaves)
        return Plan(type(self.solver), self.field, self.project, self.step_constants, self.branching, tree, shapes)

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """The last stage of the step before, and whether there is one."""
        return jnp.zeros_like(ravel_pytree(y0)[0]), jnp.asarray(False)

    def step(
        self,
        terms: PyTree,
        t0: Number,
        t1: Number,
        y0: PyTree,
        args: PyTree,
        solver_state: PyTree,
        made_jump: bool | Bool[Array, ""],
    ) -> tuple[PyTree, PyTree, dict[str, PyTree], PyTree, diffrax.RESULTS]:
        """One step, projected where it ends."""
        start, structure = ravel_pytree(y0)
        plan = self.plan(y0)
        kept, ready = solver_state
        state = t0, t1, start, kept, ready & ~jnp.asarray(made_jump)

        def tangent(args, *rest):
            *state, steps = rest
            results, changes = value_and_jvp(partial(_in_turn, plan), (args, *state), steps)
            return results, jax.tree.map(_no_change, results) if changes is None else changes

        results: Any = implicit(args, state, partial(_at_once, plan), tangent)
        projected, shift, error, raw, k, result = results
        dense = {"y0": y0, "y1": structure(raw), "stages": k}
        if self.project is not None:
            dense = {"dense_info": dense, "shift": structure(shift)}
        dt = jnp.asarray(t1 - t0, start.dtype)
        last = k[-1] / jnp.where(dt == 0, jnp.ones_like(dt), dt)
        return structure(projected), structure(error), dense, (last, jnp.asarray(plan.passes_rate_on)), result


class Plan(NamedTuple):
    """How a step is made. Equal plans share their programs. `quality(t, y, args)`: see `quality_of`."""

    solver: type
    field: Callable
    project: Callable | None
    step_constants: tuple[str, ...]
    branching: bool
    tree: Any
    shapes: tuple
    quality: Callable | None = None

    @property
    def tableau(self) -> Any:
        """Of the method."""
        return self.solver.tableau

    @property
    def count(self) -> int:
        """Number of stages."""
        return self.tableau.num_stages

    @property
    def sums(self) -> np.ndarray:
        """Rows of what is added for each stage, for the result and for the error."""
        sums = np.zeros((self.count + 2, self.count))
        for i, row in enumerate(self.tableau.a_lower):
            sums[i + 1, : i + 1] = row
        sums[self.count], sums[self.count + 1] = self.tableau.b_sol, self.tableau.b_error
        return sums

    @property
    def times(self) -> np.ndarray:
        """Of the stages, in steps."""
        return np.concatenate([[0.0], self.tableau.c])

    @property
    def sides(self) -> np.ndarray:
        """From where the stages take the limit in time: 1 from after, at the start, -1 from before, at the end, else 0.

        What jumps where steps end, as a torque held from sample to sample, is constant within them. The last stage is at the
        start of the next step where it is passed on.
        """
        sides = (self.times == 0).astype(float) - (self.times == 1)
        sides[-1] = 1.0 if self.tableau.fsal else sides[-1]
        return sides

    @property
    def projects_before_last(self) -> bool:
        """Whether the last stage comes after the projection."""
        return self.project is not None and passes_last_stage_on(self.tableau, self.step_constants, self.branching)

    @property
    def knows_error(self) -> bool:
        """Whether the error does not need the last stage."""
        return bool(self.tableau.b_error[-1] == 0)

    def structure(self, flat):
        """The state of a vector."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])[:-1]
        parts = [x.reshape(shape) for x, shape in zip(jnp.split(flat, ends), self.shapes, strict=True)]
        return jax.tree.unflatten(self.tree, parts)

    @property
    def passes_rate_on(self) -> bool:
        """Whether the last stage is the first one of the next step."""
        return self.tableau.fsal and (self.project is None or self.projects_before_last)

    def field_of(self, args, t, y):
        """The vector field on a flat state."""
        return ravel_pytree(self.field(t, self.structure(y), args))[0]

    def quality_of(self, args, t, y):
        """How far a flat state is from where the method fails, which a change of sign tells; one where it never does."""
        return jnp.ones((), y.dtype) if self.quality is None else self.quality(t, self.structure(y), args)

    def rate(self, args, t0, t1, y, c, side):
        """A stage: (t1 - t0) times the vector field, at one of the `times` and from one of the `sides`."""
        # By more than the rounding of ends of steps and of times of samples, which are seldom computed alike.
        away = 4 * jnp.finfo(jnp.result_type(t0, t1)).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        t = jnp.where(c == 1, t1, t0 + c * (t1 - t0)) + lax.stop_gradient(side * jnp.sign(t1 - t0) * away)
        return jnp.asarray(t1 - t0, y.dtype) * ravel_pytree(self.field(t, self.structure(y), args))[0]

    def ended(self, args, t1, y, error):
        """y projected, what that adds, the error, and a result."""
        project: Any = self.project
        method = ProjectedSolver(diffrax.Euler(), project, self.step_constants, self.branching)
        given = method.ended(t1, self.structure(y), self.structure(error), args)
        return *(ravel_pytree(x)[0] for x in given[:3]), given[3]


def _at_once(plan: Plan, args, t0, t1, start, kept, ready):
    """The result of a step, what a projection adds to it, its error, the result before, stages, and a code."""
    # For the whole batch: a branch that differs between samples would be computed for all.
    ready = ~any_sample(~ready) if plan.tableau.fsal else jnp.asarray(False)

    dt = jnp.asarray(t1 - t0, start.dtype)

    def anew(y):
        return kernel(_first, static=1)(plan, args, t0, t1, y)

    first = lax.cond(ready, lambda y: dt * kept, anew, start)
    # Projections report success, so that the code is no result of the kernel: batched, it would meet the unbatched one of the
    # rule in `step`, which JAX 0.10 cannot lower.
    return *_step_or_stages(plan, args, t0, t1, start, first, kept, ready), diffrax.RESULTS.successful


def _stages(plan: Plan, args, t0, t1, start, first, kept, ready):
    del first  # the loop over the stages computes it
    return _in_turn(plan, args, t0, t1, start, kept, ready)[:-1]


@kernel(static=1, fallback=_stages, derivative=False)
def _step_or_stages(plan: Plan, args, t0, t1, start, first, kept, ready):
    del kept, ready
    return _whole(plan, args, t0, t1, start, first)


class Step(NamedTuple):
    """A step: its result projected, what that added, its error, the result before, stages, and the rate that the next one
    takes."""

    projected: Array
    shift: Array
    error: Array
    raw: Array
    stages: Array
    rate: Array


def whole_step(plan: Plan, args, t0, t1, y, rate) -> Step:
    """A step from t0 to t1, written for a program of numbers.

    `rate` is the vector field at y where that is passed on from step to step.
    """
    dt = jnp.asarray(t1 - t0, y.dtype)
    first = dt * rate if plan.passes_rate_on else _first(plan, args, t0, t1, y)
    projected, shift, error, raw, stages = _whole(plan, args, t0, t1, y, first)
    return Step(projected, shift, error, raw, stages, _last_rate(plan, t0, t1, stages, rate))


def step_in_turn(plan: Plan, args, t0, t1, y, rate) -> Step:
    """The same as a loop over the stages, without derivatives."""
    step: Any = _in_turn(plan, args, t0, t1, y, rate, jnp.asarray(plan.passes_rate_on))
    projected, shift, error, raw, stages, _ = step
    return Step(projected, shift, error, raw, stages, _last_rate(plan, t0, t1, stages, rate))


def _last_rate(plan: Plan, t0, t1, stages, rate):
    dt = jnp.asarray(t1 - t0, stages.dtype)
    return jnp.where(dt == 0, rate, stages[-1] / jnp.where(dt == 0, jnp.ones_like(dt), dt))


def projected_output(plan: Plan, _, t, t0, t1, y, raw, stages, shift):
    """The state (n,) at a time t within a step, by the method's dense output bent to where the projection put its end."""
    inner: Any = plan.solver.interpolation_cls(
        t0=t0, t1=t1, y0=plan.structure(y), y1=plan.structure(raw), k=jax.vmap(plan.structure)(stages)
    )
    y_dense = ravel_pytree(inner.evaluate(t))[0]
    if plan.project is None:
        return y_dense
    x = jnp.asarray((t - t0) / jnp.where(t1 == t0, jnp.ones_like(t1), t1 - t0), y.dtype)
    return y_dense + x * x * (3 - 2 * x) * shift


def _first(plan: Plan, args, t0, t1, start):
    return plan.rate(args, t0, t1, start, 0.0, 1.0)


def _whole(plan: Plan, args, t0, t1, start, first):
    """A step but for its code, which is success."""
    k, none = [first], jnp.zeros_like(start)
    points = [(float(time), float(side)) for time, side in zip(plan.times, plan.sides, strict=True)]
    for i in range(1, plan.count - plan.projects_before_last):
        k.append(plan.rate(args, t0, t1, start + _sum(plan.sums[i], k), *points[i]))
    raw, error = start + _sum(plan.sums[plan.count], k), _sum(plan.sums[plan.count + 1], k)
    projected, shift = raw, none
    is_early = plan.projects_before_last and not plan.knows_error
    if plan.project is not None:
        projected, shift, left, _ = plan.ended(args, t1, raw, none if is_early else error)
    if plan.projects_before_last:
        k.append(plan.rate(args, t0, t1, projected, *points[-1]))
    if plan.project is not None:
        error = enlarge(error + float(plan.sums[-1, -1]) * k[-1], left) if is_early else left
    return projected, shift, error, raw, jnp.stack(k)


def _in_turn(plan: Plan, args, t0, t1, start, kept, ready):
    """The same as one loop over the stages."""
    count, none = plan.count, jnp.zeros_like(start)
    ready = ~any_sample(~ready) if plan.tableau.fsal else jnp.asarray(False)
    dt = jnp.asarray(t1 - t0, start.dtype)
    times, sides = (jnp.asarray(x, jnp.result_type(t0, t1)) for x in (plan.times, plan.sides))
    rows = jnp.arange(count), jnp.asarray(plan.sums.T, start.dtype), times, sides

    def stage(carry, row):
        total, *end = carry
        i, weights, *point = row
        y = start + total[i]
        if plan.projects_before_last:
            error = total[count + 1] if plan.knows_error else none
            ended = partial(plan.ended, args, t1)
            end = lax.cond(i == count - 1, ended, lambda y, _: (y, *end[1:]), y, error)
            y = end[0]
        k = lax.cond(ready & (i == 0), lambda y: dt * kept, lambda y: plan.rate(args, t0, t1, y, *point), y)
        return (total + weights[:, None] * k[None], *end), k

    blank = jnp.zeros((count + 2, start.size), start.dtype)
    first = blank, start, none, none, diffrax.RESULTS.successful
    (total, *end), k = lax.scan(stage, first, rows)
    raw, error = start + total[count], total[count + 1]
    if plan.project is None:
        return raw, none, error, raw, k, diffrax.RESULTS.successful
    if not plan.projects_before_last:
        end = plan.ended(args, t1, raw, error)
    projected, shift, left, result = end
    error = enlarge(error, left) if plan.projects_before_last and not plan.knows_error else left
    return projected, shift, error, raw, k, result


def _no_change(x):
    """The change of an array that does not move."""
    return jnp.zeros_like(x) if jnp.issubdtype(x.dtype, jnp.floating) else np.zeros(x.shape, jax.dtypes.float0)


def _sum(weights, k):
    """Stages times their weights, of which many are zero."""
    terms = [float(weight) * stage for weight, stage in zip(weights, k, strict=False) if weight != 0]
    return functools.reduce(jnp.add, terms) if terms else jnp.zeros_like(k[0])


def passes_last_stage_on(tableau, step_constants: tuple[str, ...], branching: bool) -> bool:
    """Whether the last stage of a projected step is the first one of the next: see `ExplicitSteps`."""
    return tableau.fsal and not step_constants and bool(tableau.b_error[-1] == 0 or not branching)
