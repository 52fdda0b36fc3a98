"""Steps that end on a manifold: any diffrax method followed by a projection."""

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from jaxdyn.solvers.wrapped import Wrapped


class _Interpolation(diffrax.AbstractLocalInterpolation):
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

    The exact solution stays on the manifold, so the projection moves a step's result by no more than its local error,
    and the order of convergence is that of the wrapped method (Hairer, Lubich & Wanner 2006, section IV.4). The
    projection is part of the step: it acts on every result the step-size control sees, and on no other. How far it moves
    the result is added to the error estimate. That is small beside it, except where rounding decides to which of
    several branches of a manifold a point is put back: there no step is short enough, and the run ends with a code.

    **Arguments:** `solver`, any diffrax method of an `ODETerm`. `project(t, y, args) -> (y, diffrax.RESULTS)`, which
    says whether it succeeded; everything it depends on comes through `args`, so that gradients reach it. `jumping` names
    entries of a state that is a dictionary: constants of a step that `project` may change for the next one, so that
    within the step the dense output keeps the old ones.
    """

    project: Callable
    jumping: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def term_compatible_contr_kwargs(self):
        """As the wrapped method's."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        """Dense output of the wrapped method, ending at the projected point."""
        return functools.partial(_Interpolation, self.solver.interpolation_cls)

    def shift(self, projected, y):
        """What the projection adds to a step's result, zero in entries that are `jumping`."""
        shift = jax.tree.map(lambda a, b: a - b, projected, y)
        return shift | {name: jnp.zeros_like(shift[name]) for name in self.jumping} if self.jumping else shift

    def init(self, terms, t0, t1, y0, args):
        """State of the wrapped method."""
        return self.solver.init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step of the wrapped method, projected."""
        # A first-same-as-last method carries the vector field at the point before projection. It is evaluated anew.
        y1, error, dense_info, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=True
        )
        projected, projection_result = self.project(t1, y1, args)
        shift = self.shift(projected, y1)
        error = None if error is None else enlarged(error, shift)
        result = diffrax.RESULTS.where(diffrax.is_successful(result), projection_result, result)
        return projected, error, {"dense_info": dense_info, "shift": shift}, solver_state, result


def enlarged(error, shift):
    """An error estimate with the sizes of what a projection added to the step."""
    return jax.tree.map(lambda e, s: e + jnp.where(e < 0, -jnp.abs(s), jnp.abs(s)), error, shift)
