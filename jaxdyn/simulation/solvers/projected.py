"""Steps that end on a manifold: any diffrax method followed by a projection."""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxdyn.constraints.projection import enlarge
from jaxdyn.model.arguments import Number
from jaxdyn.simulation.solvers.wrapped import Wrapped

_EXPECTED = 10  # times the normal part of the estimated error a projection may move a step


class ProjectedInterpolation(diffrax.AbstractLocalInterpolation):
    """Dense output of the wrapped method, bent so that the step ends where the projection put it.

    The bend is as small as the local error, so the order of the dense output is kept and it stays continuous from one
    step to the next. Between the ends it is not projected: save points are, by who saves them.
    """

    t0: jax.Array
    t1: jax.Array
    inner: Any
    shift: Any

    def __init__(self, interpolation, *, t0, t1, dense_info, shift):
        self.t0 = t0
        self.t1 = t1
        self.inner = interpolation(t0=t0, t1=t1, **dense_info)
        self.shift = shift

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(lambda a, b: a - b, self.evaluate(t1), self.evaluate(t0))
        step = self.t1 - self.t0
        x = (t0 - self.t0) / jnp.where(step == 0, jnp.ones_like(step), step)
        bend = x * x * (3 - 2 * x)
        return jax.tree.map(lambda y, s: y + bend.astype(y.dtype) * s, self.inner.evaluate(t0), self.shift)


class ProjectedSolver(Wrapped):
    """A method whose every step is followed by a projection onto a manifold that holds the solution.

    The exact solution stays on the manifold, so the projection moves the result of a short step by no more than its local error,
    and the order of convergence is that of the wrapped method (Hairer, Lubich & Wanner 2006, section IV.4). The
    projection is part of the step: it acts on every result the step-size control sees, and on no other. What it removes
    is no error of the step, unless that is more than the method expects: where rounding decides to which of several
    branches of a manifold a point is put back, the result moves by much more than its estimated error.

    **Arguments:** `solver`, any diffrax method of an `ODETerm`. `project(t, y, error, args) -> (y, error, diffrax.RESULTS)`:
    the state put back, the error estimate (None if there is none) without its part normal to the manifold, and whether it
    succeeded; everything it depends on comes through `args`, so that gradients reach it. The state is a dictionary.
    `step_constants` names entries of it that are constant within a step and that `project` may change for the next one; the
    dense output of the step keeps the old ones. `branching`: whether the manifold may have branches that meet. If not, `project`
    leaves errors as they are.
    """

    project: Callable
    step_constants: tuple[str, ...] = eqx.field(static=True, default=())
    branching: bool = eqx.field(static=True, default=True)

    @property
    def term_compatible_contr_kwargs(self) -> PyTree:
        """As the wrapped method's."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Dense output of the wrapped method, ending at the projected point."""
        return functools.partial(ProjectedInterpolation, self.solver.interpolation_cls)

    def ended(
        self, t: Number, y: PyTree, error: PyTree, args: PyTree
    ) -> tuple[PyTree, PyTree, PyTree, diffrax.RESULTS]:
        """A step's result y projected, what that adds to it (zero in `step_constants`), its error, and a result."""
        projected, left, result = self.project(t, y, error, args)
        shift = jax.tree.map(lambda a, b: a - b, projected, y)
        shift = shift | {name: jnp.zeros_like(shift[name]) for name in self.step_constants}
        if error is not None:
            left = jax.tree.map(
                lambda left, error, shift: enlarge(left, _unexpected(shift, error - left)), left, error, shift
            )
        return projected, shift, left, result

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """State of the wrapped method."""
        return self.solver.init(terms, t0, t1, y0, args)

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
        """One step of the wrapped method, projected."""
        # A first-same-as-last method carries the vector field at the point before projection. It is evaluated anew.
        y1, error, dense_info, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=True
        )
        projected, shift, error, projection_result = self.ended(t1, y1, error, args)
        result = diffrax.RESULTS.where(diffrax.is_successful(result), projection_result, result)
        return projected, error, {"dense_info": dense_info, "shift": shift}, solver_state, result


def _unexpected(shift, removed):
    """How far a projection moved a result, if that is beyond what it removed of the error, else zero."""
    beyond = ~(jnp.max(jnp.abs(shift), initial=0.0) <= _EXPECTED * jnp.max(jnp.abs(removed), initial=0.0))  # or NaN
    return jnp.where(beyond, shift, jnp.zeros_like(shift))
