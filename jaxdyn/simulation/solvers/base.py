"""Methods in diffrax's interface that wrap another one, with dense output, and those whose steps end on a manifold."""

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from jaxdyn.constraints.projection import enlarge
from jaxdyn.model.arguments import Number

Flag: TypeAlias = bool | Bool[Array, ""]
# A step's end, its error estimate or None, the data of its dense output, the method's state, and a code.
StepOutput: TypeAlias = tuple[PyTree, PyTree, dict[str, PyTree], PyTree, diffrax.RESULTS]


class DenseOutput(diffrax.AbstractLocalInterpolation):
    """Dense output within a step from t0 to t1."""

    t0: jax.Array
    t1: jax.Array

    @abstractmethod
    def at(self, t) -> PyTree:
        """State at a time t of the step."""

    def fraction(self, t) -> Any:
        """Fraction of the step at t, ()."""
        # A batch element that has ended takes steps of no length.
        step = self.t1 - self.t0
        return (t - self.t0) / jnp.where(step == 0, jnp.ones_like(step), step)

    def evaluate(self, t0, t1=None, left=True):
        """State at t0, or with t1 the difference of the states at t1 and t0."""
        return self.at(t0) if t1 is None else jax.tree.map(lambda a, b: a - b, self.at(t1), self.at(t0))


class StageInterpolation(DenseOutput):
    """Dense output from the ends y0, y1 of a step and its stages k, pytrees of arrays."""

    y0: object
    y1: object
    k: object


class Wrapped(diffrax.AbstractWrappedSolver):
    """A diffrax method made of another one, `solver`, with the same order and root finder."""

    solver: diffrax.AbstractSolver

    # Forwarded settings may be placeholders while equinox takes a tree apart: `PyTree`.

    @property
    def term_structure(self) -> PyTree:
        """Structure of the terms of the wrapped method."""
        return self.solver.term_structure

    # diffrax sets these on the method that it is given; they belong to the wrapped one.
    @property
    def root_finder(self) -> PyTree:
        """Root finder of an implicit wrapped method."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self) -> PyTree:
        """Iteration limit of an implicit wrapped method."""
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def scan_kind(self) -> PyTree:
        """Kind of loop over the stages of a wrapped Runge-Kutta method."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms: PyTree) -> int | None:
        """Order of convergence of the wrapped method."""
        return self.solver.order(terms)

    def error_order(self, terms: PyTree) -> ArrayLike | None:
        """Order of the error estimate of the wrapped method."""
        return self.solver.error_order(terms)

    def init(self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree) -> PyTree:
        """State of the wrapped method before the first step."""
        return self.solver.init(terms, t0, t1, y0, args)

    def func(self, terms: PyTree, t0: Number, y0: PyTree, args: PyTree) -> PyTree:
        """Vector field at one point."""
        return self.solver.func(terms, t0, y0, args)


_EXPECTED = 10  # how far a projection may move a step, in units of the normal part of the estimated error


class ProjectedInterpolation(DenseOutput):
    """Dense output of the wrapped method, bent so that the step ends at the projected point.

    The bend is as small as the local error, so the order of the dense output is kept and it stays continuous from one
    step to the next. Between the ends it is not on the manifold: code that saves a state there projects it.
    """

    inner: Any
    shift: Any

    def __init__(self, interpolation, *, t0, t1, dense_info, shift):
        self.t0, self.t1 = t0, t1
        self.inner = interpolation(t0=t0, t1=t1, **dense_info)
        self.shift = shift

    def at(self, t):
        x = self.fraction(t)
        # Flat at both ends, so that the rates of change there are those of the wrapped method.
        bend = x * x * (3 - 2 * x)
        return jax.tree.map(lambda y, s: y + bend.astype(y.dtype) * s, self.inner.evaluate(t), self.shift)


class ProjectedSolver(Wrapped):
    """A method whose every step is followed by a projection onto a manifold that holds the solution.

    The exact solution stays on the manifold, so the projection moves the result of a short step by no more than its local error,
    and the order of convergence is that of the wrapped method (Hairer, Lubich & Wanner 2006, section IV.4). The projection is
    part of the step, so the step-size control sees projected results only. The part of the error estimate that the projection
    removes is not counted, unless the projection moves the result by more than the method expects: where rounding decides to
    which of several branches of a manifold a point is projected, the result moves by much more than its estimated error.

    **Arguments:** `solver`, any diffrax method of an `ODETerm`. `project(t, y, error, args) -> (end, following, error)`: the
    projected end of this step, the state from which the next one starts, and the error estimate (None if there is none)
    without its part normal to the manifold; everything it depends on comes through `args`, so that gradients reach it.
    `step_constants` names entries of the state, a dictionary, that are constant within a step and may differ in `following`.
    `branching`: True if the manifold may have branches that meet. If not, `project` does not change errors.
    """

    project: Callable
    step_constants: tuple[str, ...] = eqx.field(static=True, default=())
    branching: bool = eqx.field(static=True, default=True)

    @property
    def term_compatible_contr_kwargs(self) -> PyTree:
        """Arguments of the terms of the wrapped method."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output of the wrapped method, ending at the projected point."""
        return functools.partial(ProjectedInterpolation, self.solver.interpolation_cls)

    def project_end(self, t: Number, y: PyTree, error: PyTree, args: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        """Project the end y of a step: the state of the next step, the shift of this one's end, and its error."""
        projected, following, tangent = self.project(t, y, error, args)
        shift = jax.tree.map(lambda a, b: a - b, projected, y)
        if error is not None:
            tangent = jax.tree.map(
                lambda left, error, shift: enlarge(left, _excess_shift(shift, error - left)), tangent, error, shift
            )
        return following, shift, tangent

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step of the wrapped method and project its end."""
        # A first-same-as-last method carries the vector field at the point before projection. It is evaluated anew.
        y1, error, dense_info, solver_state, result = self.solver.step(
            terms, t0, t1, y0, args, solver_state, made_jump=True
        )
        projected, shift, error = self.project_end(t1, y1, error, args)
        return projected, error, {"dense_info": dense_info, "shift": shift}, solver_state, result


def _excess_shift(shift, removed):
    """Shift of a projection where it exceeds what was removed of the error, else zero."""
    # Written with "not below", so that a shift of NaN counts as excess.
    beyond = ~(jnp.max(jnp.abs(shift), initial=0.0) <= _EXPECTED * jnp.max(jnp.abs(removed), initial=0.0))
    return jnp.where(beyond, shift, jnp.zeros_like(shift))
