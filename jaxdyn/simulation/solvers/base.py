"""Methods in diffrax's interface that wrap another one, methods whose steps end on a manifold, and step-size control.

Adaptive steps have a first length of their own; fixed steps detect when they are too long.
"""

import functools
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, PyTree

from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.projection import ROUNDING_FACTOR, enlarge
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
                lambda y, left, error, shift: enlarge(left, _excess_shift(y, shift, error - left)),
                y, tangent, error, shift,
            )  # fmt: skip
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


def _excess_shift(y, shift, removed):
    """Shift of y by a projection where it exceeds what was removed of the error, and rounding; else zero."""
    state, moved, expected = (jnp.max(jnp.abs(x), initial=0.0) for x in (y, shift, _EXPECTED * removed))
    rounding = ROUNDING_FACTOR * float(jnp.finfo(shift.dtype).eps) * state
    # Written with "not below", so that a shift of NaN counts as excess.
    beyond = ~(moved <= jnp.maximum(expected, rounding))
    return jnp.where(beyond, shift, jnp.zeros_like(shift))


# --- step-size control: adaptive steps with their first length, and fixed steps that detect when they are too long ---


# Largest sum of error estimates, as a fraction of the distance that positions, or velocities, have come from their start.
ALLOWED = 0.1
# Entries of a state that are no motion: constants of a step, and what nothing depends on.
_NO_MOTION = ("frame", "held", "work", "slip")
# Control of the step length by the last error alone (Hairer, Norsett & Wanner 1993, section II.4): the next step aims at an error
# of _SAFETY^order of the tolerance, and is at most _MAX_FACTOR times as long, at least _MIN_FACTOR times.
_SAFETY, _MIN_FACTOR, _MAX_FACTOR = 0.9, 0.2, 10.0


class NextStep(NamedTuple):
    """Decision about a step: whether it is kept, the length of the next one, whether that is the least, and whether it failed."""

    kept: Array
    length: Array
    is_shortest: Array
    failed: Array


def error_size(norm, y0, y1, error, rtol, atol):
    """Norm of the error of a step from y0 to y1, in units of the tolerance."""

    def scale(y0, y1, error):
        # A result of NaN is measured by the size of the start.
        y1 = jnp.where(jnp.isnan(y1).any(), y0, y1)
        return error / (atol + rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1)))

    return norm(jax.tree.map(scale, y0, y1, error))


def step_factor(size, order, kept):
    """Ratio of the next step length to the last one, for a scaled error `size` of the given order."""
    factor = _SAFETY * (1 / size) ** (1 / order)
    # An error of NaN is one of infinity: the step is refused and shortened as far as one refusal may shorten it.
    factor = jnp.where(jnp.isnan(factor), _MIN_FACTOR, factor)
    # A step that was kept is not followed by a shorter one, nor a refused one by a longer one.
    return jnp.clip(factor, jnp.where(kept, 1.0, _MIN_FACTOR), jnp.where(kept, _MAX_FACTOR, _SAFETY))


def next_step(size, order, length, is_shortest, minimum) -> NextStep:
    """Decide about a step of this length and scaled error; one of the least length (`is_shortest`) is kept whatever its error."""
    kept = (size < 1) | is_shortest
    factor = step_factor(size, order, kept)
    following = length * factor.astype(length.dtype)
    failed = following < minimum
    following = jnp.where(is_shortest & (factor == 1), minimum, following)
    return NextStep(kept, jnp.maximum(following, minimum), following <= minimum, failed)


class Adaptive(diffrax.AbstractAdaptiveStepSizeController):
    """The step control of the library's own loop for diffrax's loop.

    A first derivative that is NaN starts with the whole span: a step that is NaN would make every later one NaN, rejected and
    tried again until the last of `max_steps`. A finite one is halved and halved again until the least step ends the run.

    **Arguments:** tolerances, the norm of a scaled error, and the least step (s) at the end of the run. It is shorter at
    earlier times, whose neighbouring numbers are closer.
    """

    rtol: Any
    atol: Any
    norm: Callable
    minimum: Any

    def wrap(self, direction):
        """Control of a run in a direction: forwards."""
        return self

    def init(self, terms, t0, t1, y0: Any, dt0, args, func, error_order):
        """End of the first step, and whether it is the least one."""
        if dt0 is None:
            dt0 = first_step(terms, t0, t1, y0, args, error_order, self.rtol, self.atol, self.norm)
        first = jnp.where(jnp.isfinite(dt0), jnp.minimum(t0 + jnp.maximum(dt0, self.minimum), t1), t1)
        return first, jnp.asarray(False)

    def adapt_step_size(self, t0, t1, y0: Any, y1_candidate, args, y_error, error_order: Any, controller_state):
        """Accept or refuse a step, and choose the next one."""
        # Steps are constants to derivatives.
        given = jax.lax.stop_gradient((y0, y1_candidate, y_error, self.rtol, self.atol))
        size, length = error_size(self.norm, *given), jnp.asarray(t1 - t0)
        minimum = jnp.asarray(min_step(t0, jnp.asarray(self.minimum)), length.dtype)
        kept, length, is_shortest, failed = next_step(size, error_order, length, controller_state, minimum)
        start = jnp.where(kept, t1, t0)
        codes: Any = diffrax.RESULTS
        result = codes.where(failed, codes.dt_min_reached, codes.successful)
        return kept, start, start + length, False, is_shortest, result


def min_step(t0, at_end):
    """Least length of a step from t0, where `at_end` is that at the end of the run."""
    eps = float(jnp.finfo(jnp.result_type(t0)).eps)
    return jnp.clip(16 * eps * jnp.abs(t0), eps * at_end, at_end)


def first_step(terms, t0, t1, y0, args, order, rtol, atol, norm):
    """First step, (), s, of a method of this order.

    With sizes measured in tolerances, d0 = |y0|, d1 = |f0| and d2 = |f(t0 + h0, y0 + h0 f0) - f0| / h0 at a trial step h0 =
    0.01 d0/d1. The motion is then taken for one of rate w = d2/d1 and amplitude A = d1^2/d2, whose error A (w h)^order is to
    be 0.01; and h is at most 100 h0 and the span. Where d0 or the change d1 (t1 - t0) is below 1e-5, h0 is 1e-6 of the
    span.

    Source: Hairer, Norsett & Wanner 1993, section II.4, with h^(order) max(d1, d2) = 0.01 replaced by a rule that is the
    same in any unit of time.
    """
    t0, t1, y0, args = stop_gradient((t0, t1, y0, args))
    span = t1 - t0
    scale = jax.tree.map(lambda y: atol + rtol * jnp.abs(y), y0)

    def size(y):
        return norm(jax.tree.map(lambda y, s: y / s, y, scale))

    def derivative(carry, _):
        # Evaluated twice by one program: at y0, where f = 0 and h = 0, and at the trial step.
        f, h = carry
        y = jax.tree.map(lambda y, f: y + h * f, y0, f)
        f = terms.vf_prod(t0 + h, y, args, terms.contr(jnp.zeros_like(t0), jnp.ones_like(t0)))
        d0, d1 = size(y0), size(f)
        small = (d0 < 1e-5) | (d1 * span < 1e-5)
        trial = jnp.where(small, 1e-6 * span, 0.01 * d0 / jnp.where(small, jnp.ones_like(d1), d1))
        return (f, jnp.minimum(trial, span).astype(span.dtype)), (f, trial)

    _, (f, trial) = jax.lax.scan(derivative, (jax.tree.map(jnp.zeros_like, y0), jnp.zeros_like(span)), length=2)
    h0 = jnp.minimum(trial[0], span)
    d1 = size(jax.tree.map(lambda f: f[0], f))
    d2 = size(jax.tree.map(lambda f: f[1] - f[0], f)) / h0
    # Rest that ends at a later moment, and a straight line: rates bounded by the trial step and the span.
    d1 = jnp.maximum(d1, d2 * h0)
    tiny = jnp.finfo(d1.dtype).tiny
    rate = jnp.maximum(d2 / jnp.maximum(d1, tiny), 1e-3 / span)
    amplitude = jnp.maximum(d1 / rate, tiny)
    step = (0.01 / amplitude) ** (1 / order) / rate
    return jax.lax.stop_gradient(jnp.minimum(jnp.minimum(100 * h0, step), span))


class ErrorMonitoredSteps(diffrax.ConstantStepSize):
    """Fixed steps that end at min(t0 + k h, t1), with the sum of their error estimates, zero for a method without an estimate.

    A method of order p estimates its error in a step by some e of h^k. The estimates of embedded methods, k = p, overestimate it
    and are added directly. That of `RK4`, k = 3, overestimates it too much; but if all moves at one rate and the step is d,
    of h, e^2/d goes with h^5 as the error does: for y' = i y it is 3.3 times the error. The rounding of a step adds eps times
    the greatest distance of the state from its start.

    **Arguments:** `order`, p.
    """

    order: int | None = eqx.field(static=True)

    def init(self, terms, t0, t1, y0: Any, dt0: Any, args, func, error_order):
        """End of the first step; its number, the grid, the start, the sums of errors, and the greatest distances."""
        start, length = jax.lax.stop_gradient((y0, dt0))
        return t0 + length, (jnp.ones((), jnp.int32), (t0, length), start, *no_sums(y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order: Any, controller_state: Any):
        """Add the error of a step to the sum, and go to the next one."""
        number, (begin, length), start, errors, distances = controller_state
        if y_error is not None:
            order: Any = self.order
            errors, distances = add_error(order, error_order, start, y0, y1_candidate, y_error, errors, distances)
        number = number + 1
        # From the start of the run, as sums of lengths would carry their rounding on. diffrax ends the last step at the end.
        end, codes = begin + number.astype(length.dtype) * length, diffrax.RESULTS
        return True, t1, end, False, (number, (begin, length), start, errors, distances), codes.successful


def no_sums(y):
    """Error sum and distance of `add_error` before the first step."""
    rows = _rows(y)
    none = jnp.zeros(rows.shape[0], rows.dtype)
    return none, none


def add_error(order, error_order, start, y0, y1, error, errors, distances):
    """Sum of error estimates and largest distance from the start after one more step (see `ErrorMonitoredSteps`)."""
    start, before, after, error = (jax.lax.stop_gradient(_rows(y)) for y in (start, y0, y1, error))
    # One reduction: for a pendulum it is as dear as its dynamics.
    sizes = jnp.max(jnp.abs(jnp.stack([error, after - before, after - start])), -1)
    error, change, distance = sizes[0], sizes[1], sizes[2]
    if error_order < order:
        share = jnp.minimum(error / jnp.maximum(change, jnp.finfo(change.dtype).tiny), 1.0)
        power = (order + 1 - error_order) / (error_order - 1)
        error = error * (share if power == 1 else share**power)
    distances = jnp.maximum(distances, distance)
    rounding = jnp.where(change > 0, jnp.finfo(distance.dtype).eps * distances, jnp.zeros_like(distances))
    return errors + error + rounding, distances


def too_coarse(sums):
    """True where a motion by `ErrorMonitoredSteps` may be wrong by more than a tenth, (); `sums` as of `add_error`."""
    errors, distances = sums
    # Below the root of eps, of what rests, all is rounding.
    return (errors > ALLOWED * jnp.maximum(distances, jnp.sqrt(jnp.finfo(distances.dtype).eps))).any()


def _rows(y):
    """Entries of a state, a row for each name, filled up with zeros."""
    rows = [value.reshape(-1) for name, value in y.items() if name not in _NO_MOTION]
    longest = max(row.size for row in rows)
    return jnp.stack([jnp.pad(row, (0, longest - row.size)) if row.size < longest else row for row in rows])
