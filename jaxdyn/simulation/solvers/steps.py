"""Steps of explicit Runge-Kutta methods and of `Rodas5P` on one flat state, with a projection inside the step.

A step is one kernel (`jaxdyn.compile`) where all of it is a scalar program, the projection included. What is not valid for a
sample in it, for example an acceleration at rows that are close to dependent, has a second program. Elsewhere, and for
derivatives, a step is a loop over its stages.
"""

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
from jaxtyping import Array, PyTree

from jaxdyn.compile import implicit, kernel, value_and_jvp
from jaxdyn.constraints.projection import enlarge
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number
from jaxdyn.simulation.solvers.base import DenseOutput, Flag, ProjectedInterpolation, ProjectedSolver, StepOutput


class _Interpolation(DenseOutput):
    """Dense output of a method whose stages are rows of one array."""

    inner: Any
    y0: Any

    def __init__(self, interpolation, *, t0, t1, y0, y1, stages):
        starts, ends = (ravel_pytree(y)[0] for y in (y0, y1))
        self.t0, self.t1 = t0, t1
        self.inner = interpolation(t0=t0, t1=t1, y0=starts, y1=ends, k=stages)
        self.y0 = y0

    def at(self, t):
        return ravel_pytree(self.y0)[1](self.inner.evaluate(t))


class LibrarySteps(ProjectedSolver):
    """The steps of an explicit Runge-Kutta method of diffrax, equal to diffrax's up to rounding, or of `Rodas5P`.

    In a first-same-as-last method the projection acts before the last stage, so that the next step can reuse it
    (`ProjectedSolver` computes it again). That is possible where the error estimate does not need the last stage, because the
    projection also acts on the error, or where the manifold has no branches; and without `step_constants`, which change with
    the projection and change the stage with them.

    **Arguments:** those of `ProjectedSolver`; `project`: None for none; `field(t, y, args)`, the vector field of the term.
    """

    solver: diffrax.AbstractAdaptiveSolver
    project: Callable | None = None
    field: Callable = eqx.field(static=True, kw_only=True)

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output of the wrapped method, ending at the projected point if there is a projection."""
        interpolation = partial(_Interpolation, self.solver.interpolation_cls)
        return interpolation if self.project is None else partial(ProjectedInterpolation, interpolation)

    def plan(self, y0: PyTree) -> "Plan":
        """Plan of the steps of states with the structure of y0."""
        leaves, tree = jax.tree.flatten(y0)
        shapes = tuple(x.shape for x in leaves)
        return Plan(type(self.solver), self.field, self.project, self.step_constants, self.branching, tree, shapes)

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """No state: steps in diffrax's loop compute their first stage anew."""
        return None

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step and project its end."""
        start, structure = ravel_pytree(y0)
        projected, shift, error, raw, k = differentiable_step(self.plan(y0), args, t0, t1, start)
        dense = {"y0": y0, "y1": structure(raw), "stages": k}
        if self.project is not None:
            dense = {"dense_info": dense, "shift": structure(shift)}
        return structure(projected), structure(error), dense, None, diffrax.RESULTS.successful


class Plan(NamedTuple):
    """Definition of a step; equal plans share their programs.

    `quality(t, y, args)` () changes its sign where the method fails; `guards(t, y, args)` -> values and levels of rounding (k,),
    of which one is negative where the motion or its mode ends; `rounding`, see `search_root`.
    """

    solver: type
    field: Callable
    project: Callable | None
    step_constants: tuple[str, ...]
    branching: bool
    tree: Any
    shapes: tuple
    quality: Callable | None = None
    guards: Callable | None = None
    rounding: float = 1.0

    @property
    def tableau(self) -> Any:
        """Butcher tableau of an explicit method, None of `Rodas5P`."""
        return getattr(self.solver, "tableau", None)

    @property
    def count(self) -> int:
        """Number of stages."""
        return self.tableau.num_stages

    @property
    def sums(self) -> np.ndarray:
        """Weights of the stages in the start of each stage, in the result and in the error, (count + 2, count)."""
        sums = np.zeros((self.count + 2, self.count))
        for i, row in enumerate(self.tableau.a_lower):
            sums[i + 1, : i + 1] = row
        sums[self.count], sums[self.count + 1] = self.tableau.b_sol, self.tableau.b_error
        return sums

    @property
    def times(self) -> np.ndarray:
        """Times of the stages as fractions of the step, (count,)."""
        return np.concatenate([[0.0], self.tableau.c])

    @property
    def sides(self) -> np.ndarray:
        """Sides of the limits in time at the stages: 1 from after, at the start, -1 from before, at the end, else 0.

        What jumps where steps end, as a torque held from sample to sample, is constant within them. The last stage of a
        first-same-as-last method belongs to the start of the next step.
        """
        sides = (self.times == 0).astype(float) - (self.times == 1)
        sides[-1] = 1.0 if self.tableau.fsal else sides[-1]
        return sides

    @property
    def projects_before_last(self) -> bool:
        """True if the last stage comes after the projection."""
        if self.tableau is None or self.project is None:
            return False
        return keeps_fsal(self.tableau, self.step_constants, self.branching)

    @property
    def knows_error(self) -> bool:
        """True if the error does not need the last stage."""
        return bool(self.tableau.b_error[-1] == 0)

    @property
    def is_fsal(self) -> bool:
        """True if the last stage is the first one of the next step (first same as last)."""
        if self.tableau is None:
            return False
        return self.tableau.fsal and (self.project is None or self.projects_before_last)

    def structure(self, flat):
        """State of a vector."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])[:-1]
        parts = [x.reshape(shape) for x, shape in zip(jnp.split(flat, ends), self.shapes, strict=True)]
        return jax.tree.unflatten(self.tree, parts)

    def field_of(self, args, t, y):
        """Vector field on a flat state."""
        return ravel_pytree(self.field(t, self.structure(y), args))[0]

    def first_rate(self, args, t, y):
        """Vector field where a first-same-as-last method begins; zero for other methods, which do not read it."""
        return self.field_of(args, t, y) if self.is_fsal else jnp.zeros_like(y)

    def quality_of(self, args, t, y):
        """Distance of a flat state from where the method fails, shown by a change of sign; one where it never does."""
        return jnp.ones((), y.dtype) if self.quality is None else self.quality(t, self.structure(y), args)

    def guards_of(self, args, t, y):
        """Guards of a flat state and their levels of rounding; none where the motion does not end."""
        none = jnp.zeros((0,), y.dtype)
        return (none, none) if self.guards is None else self.guards(t, self.structure(y), args)

    def stage(self, args, t0, t1, y, c, side):
        """Step length times the vector field, at one of the `times` and from one of the `sides`."""
        # By more than the rounding of ends of steps and of times of samples, which are seldom computed alike.
        away = 4 * jnp.finfo(jnp.result_type(t0, t1)).eps * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
        t = jnp.where(c == 1, t1, t0 + c * (t1 - t0)) + lax.stop_gradient(side * jnp.sign(t1 - t0) * away)
        return self.change(args, t0, t1, y, t)

    def change(self, args, t0, t1, y, t):
        """Step length times the vector field at a time within the step."""
        return jnp.asarray(t1 - t0, y.dtype) * self.field_of(args, t, y)

    def project_end(self, args, t1, y, error):
        """Flat start of the next step, for the end y of a step, with the end's shift by its projection, and its error."""
        project: Any = self.project
        method = ProjectedSolver(diffrax.Euler(), project, self.step_constants, self.branching)
        end = method.project_end(t1, self.structure(y), self.structure(error), args)
        return tuple(ravel_pytree(x)[0] for x in end)


class Step(NamedTuple):
    """Projected end of a step, its shift, its error, the end before the projection, stages, and the next step's first rate."""

    projected: Array
    shift: Array
    error: Array
    raw: Array
    stages: Array
    rate: Array


def take_step(plan: Plan, args, t0, t1, y, rate) -> Step:
    """Make a step from t0 to t1; `rate` is the vector field at y if the method is first-same-as-last."""
    dt = jnp.asarray(t1 - t0, y.dtype)
    projected, shift, error, raw, stages = _stages(plan, args, t0, t1, y, dt * rate if plan.is_fsal else None)
    if plan.is_fsal:
        # A step of no length leaves its state, and the rate with it.
        rate = jnp.where(dt == 0, rate, stages[-1] / jnp.where(dt == 0, jnp.ones_like(dt), dt))
    return Step(projected, shift, error, raw, stages, rate)


def differentiable_step(plan: Plan, args, t0, t1, y):
    """Projected end of a step, its shift, its error, the end before the projection, and stages, by a kernel with derivatives."""

    def tangent(args, *rest):
        *state, steps = rest
        results, changes = value_and_jvp(partial(_stages, plan), (args, *state), steps)
        return results, jax.tree.map(jnp.zeros_like, results) if changes is None else changes

    stages: Any = kernel(_stages, static=1, fallback=_stages, derivative=False)
    results: Any = implicit(args, (t0, t1, y), partial(stages, plan), tangent)
    return results


def dense_output(plan: Plan, _, t, t0, t1, y, raw, stages, shift):
    """State (n,) at a time t within a step, by the method's dense output bent to the projected end."""
    inner: Any = plan.solver.interpolation_cls(
        t0=t0, t1=t1, y0=plan.structure(y), y1=plan.structure(raw), k=jax.vmap(plan.structure)(stages)
    )
    y_dense = ravel_pytree(inner.evaluate(t))[0]
    if plan.project is None:
        return y_dense
    # Trajectories that have ended take steps of no length, by which nothing can be divided.
    x = jnp.asarray((t - t0) / jnp.where(t1 == t0, jnp.ones_like(t1), t1 - t0), y.dtype)
    return y_dense + x * x * (3 - 2 * x) * shift


def _stages(plan: Plan, args, t0, t1, start, first=None):
    """All of a step, as one loop over the stages, which a kernel writes out.

    `first`: the first stage, or None.
    """
    none = jnp.zeros_like(start)
    if plan.tableau is None:
        method: Any = plan.solver
        # At the times of the stages themselves: in stiff scenes a shift by their rounding is an error of the velocity.
        raw, error, k = method.advance(partial(plan.change, args, t0, t1), start, t0, t1)
        return _with_projected_end(plan, args, t1, raw, error, k)
    count = plan.count
    times, sides = (jnp.asarray(x, jnp.result_type(t0, t1)) for x in (plan.times, plan.sides))
    *starts, of_end, of_error = jnp.asarray(plan.sums, start.dtype)

    def compute(y, point):
        return plan.stage(args, t0, t1, y, *point)

    def stage(carry, row):
        # The stages so far, and zeros. Sums are made where they are used: a kernel would keep sums for all later stages.
        k, *end = carry
        i, weights, *point = row
        y = start + matmul(weights, k)
        if plan.projects_before_last:
            error = matmul(of_error, k) if plan.knows_error else none
            project = partial(plan.project_end, args, t1)
            end = lax.cond(i == count - 1, project, lambda y, _: (y, *end[1:]), y, error)
            y = end[0]
        new = compute(y, point) if first is None else lax.cond(i == 0, lambda *_: first, compute, y, point)
        return (k.at[i].set(new), *end), None

    begin = jnp.zeros((count, start.size), start.dtype), start, none, none
    (k, *end), _ = lax.scan(stage, begin, (jnp.arange(count), jnp.stack(starts), times, sides))
    raw, error = start + matmul(of_end, k), matmul(of_error, k)
    if not plan.projects_before_last:
        return _with_projected_end(plan, args, t1, raw, error, k)
    projected, shift, tangent = end
    return projected, shift, tangent if plan.knows_error else enlarge(error, tangent), raw, k


def _with_projected_end(plan: Plan, args, t1, raw, error, k):
    """Projected end of a step, its shift, its error, the end before the projection, and the stages."""
    if plan.project is None:
        return raw, jnp.zeros_like(raw), error, raw, k
    return *plan.project_end(args, t1, raw, error), raw, k


def keeps_fsal(tableau, step_constants: tuple[str, ...], branching: bool) -> bool:
    """True if a first-same-as-last method stays one when its steps are projected: see `LibrarySteps`."""
    return tableau.fsal and not step_constants and bool(tableau.b_error[-1] == 0 or not branching)
