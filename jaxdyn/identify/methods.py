"""Methods of minimisation by one protocol (`descent.Method`): Gauss-Newton here, those of optimistix and optax step by step.

Gauss-Newton steps minimise a sum of squared errors of log segments. The unknowns are y (p,) and, where initial states are free
too, one vector for each segment. The errors of a segment depend on y and on its own initial state alone. Initial states are
therefore eliminated segment by segment, and a step costs what it costs for y.

Source: Marquardt (1963), damping; Bock (1983), elimination of the initial states.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.descent import Iterate, Method, array_leaves, restore_leaves

# Damping of the first step, and its bounds, in shares of the largest curvature.
DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-12, 1e6
# Directions with less than this share of the largest effect count as not determined.
RANK_TOLERANCE = 1e-6


class Unknowns(eqx.Module):
    """Unknowns of a fit: y, and corrections of the initial states of the segments in units of their scale, or None."""

    y: Float[Array, " p"]
    start: Float[Array, "segments 2 nv"] | None


@dataclasses.dataclass(frozen=True)
class LinearErrors:
    """Errors near a point, at the best initial states: errors + rows dy, at dstart = -(offset + gain dy).

    `errors` (n,); `rows` (n, p); `offset` (segments, 2 nv) and `gain` (segments, 2 nv, p) where initial states are free.
    """

    loss: float
    errors: np.ndarray
    rows: np.ndarray
    offset: Any = None
    gain: Any = None
    start_decrease: float = 0.0  # decrease of the loss by the best initial states alone
    priors: int = 0  # number of the errors, the last ones, that are those of the prior
    prior_weight: float = 1.0
    start_rank: int = 0  # number of directions of the initial states that have an effect

    @property
    def is_finite(self) -> bool:
        """True where a step can be computed from here."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.rows).all())

    @functools.cached_property
    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations: half of the Hessian (p, p) and of the gradient (p,) of the loss."""
        return self.rows.T @ self.rows, self.rows.T @ self.errors

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Step dy (p,) and the decrease of the loss that it predicts; `damping` in shares of the largest curvature."""
        hessian, gradient = self.normal
        # The floor keeps a Hessian of zeros solvable; its step is zero, and the fit ends.
        size = damping * max(float(np.diag(hessian).max()), 1e-300)
        dy = -np.linalg.solve(hessian + size * np.eye(len(hessian)), gradient)
        # With H dy = -g - size dy the predicted decrease -2 g dy - dy H dy becomes dy (size dy - g), without cancellation.
        return dy, self.start_decrease + float(dy @ (size * dy - gradient))

    def update(self, estimate: Unknowns, dy: np.ndarray) -> Unknowns:
        """Unknowns after a step."""
        dtype, start = estimate.y.dtype, estimate.start
        if start is not None:
            change = jnp.asarray(self.offset + self.gain @ dy, dtype)
            start = start - change.reshape(start.shape)
        return Unknowns(estimate.y + jnp.asarray(dy, dtype), start)


def eliminate_starts(errors, by_y, by_start) -> LinearErrors:
    """Linear errors of (segments, n), with Jacobians by y (segments, n, p) and by initial states (segments, n, 2 nv), or None.

    The loss is infinite where squares of the Jacobians are: no step could be computed from there.
    """
    errors, by_y = np.asarray(errors, np.float64), np.asarray(by_y, np.float64)
    p, largest = by_y.shape[-1], max(float(np.abs(x).max(initial=0)) for x in (errors, by_y))
    # Squares of larger numbers overflow float64.
    if not largest < 1e150:
        return LinearErrors(np.inf, errors.reshape(-1), by_y.reshape(-1, p))
    loss = float(np.sum(errors**2))
    if by_start is None:
        return LinearErrors(loss, errors.reshape(-1), by_y.reshape(-1, p))
    # Initial states of mechanisms are projected onto the constraints: not all of their directions have an effect.
    U, s, Vt = np.linalg.svd(np.asarray(by_start, np.float64), full_matrices=False)
    has_effect = s > RANK_TOLERANCE * s.max(axis=1, keepdims=True, initial=0.0)
    basis, inverse = U * has_effect[:, None], np.swapaxes(Vt, 1, 2) / np.where(has_effect, s, np.inf)[:, None]
    # Columns of the basis are orthonormal or zero, so that projecting onto their complement needs no inverse.
    transpose = np.swapaxes(basis, 1, 2)
    shares, own = transpose @ by_y, transpose @ errors[..., None]
    rest, rows = errors - (basis @ own)[..., 0], by_y - basis @ shares
    offset, gain = (inverse @ own)[..., 0], inverse @ shares
    decrease = float(np.sum(own**2))
    return LinearErrors(
        loss, rest.reshape(-1), rows.reshape(-1, p), offset, gain, decrease, start_rank=int(has_effect.sum())
    )


def with_prior(data: LinearErrors, residual, rows, weight: float) -> LinearErrors:
    """Errors of the data followed by those of the prior, whose squares count `weight` times."""
    residual, rows = (weight**0.5 * np.asarray(x, np.float64) for x in (residual, rows))
    return dataclasses.replace(
        data,
        loss=data.loss + float(residual @ residual),
        errors=np.concatenate([data.errors, residual]),
        rows=np.concatenate([data.rows, rows]),
        priors=len(residual),
        prior_weight=weight,
    )


class GaussNewton(Method):
    """Gauss-Newton steps with Marquardt's damping, which grows tenfold with every trial that fails to lower the loss.

    **Arguments:** `linearise`, from unknowns to `LinearErrors`; `tolerance`: it has converged when the next step predicts a
    decrease of the loss by less than this share of it; `rounding` of the unknowns; `known`: linear errors of the start, if known.

    The state of an iterate is its linear errors and the damping.
    """

    def __init__(
        self,
        linearise: Callable[[Unknowns], LinearErrors],
        tolerance: float,
        rounding: float,
        known: LinearErrors | None = None,
    ):
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance}; it must not be negative")
        # A predicted decrease below rounding of the loss cannot be observed: every trial would count as failed.
        self.linearise, self.tolerance, self.known = linearise, max(tolerance, 1e3 * rounding), known
        # Errors are in units of their scale, so that their rounding appears squared in the loss.
        self.floor = (10 * rounding) ** 2

    def init(self, start, kept):
        """Linearise the start."""
        # The damping is the only state besides the point; the rest is evaluated again, to the same bits.
        if kept is not None:
            return self._iterate(start, self.linearise(start), float(kept["damping"]))
        return self._iterate(start, self.linearise(start) if self.known is None else self.known, DAMPING)

    def step(self, iterate, history, best):
        """Increase the damping until a step lowers the loss."""
        here, damping = iterate.state
        while True:
            trial = propose(here, damping, self.tolerance)
            if trial is None:
                return iterate, RESULTS.successful
            point = here.update(iterate.point, trial)
            there = self.linearise(point)
            # A trial that is not finite is one that failed, not an end: a shorter step may be finite.
            if there.is_finite and there.loss < here.loss:
                return self._iterate(point, there, max(damping / 10, _MIN_DAMPING)), None
            damping *= 10

    def arrays(self, iterate):
        """Damping."""
        return {"damping": np.float64(iterate.state[1])}

    @staticmethod
    def _iterate(point: Unknowns, here: LinearErrors, damping: float) -> Iterate:
        return Iterate(point, here.loss, (here, damping), here.is_finite)


def confirm_minimum(result: Any, linear: LinearErrors, tolerance: float, rounding: float) -> Any:
    """The result of a least-squares fit, or `no_descent` where it is `successful` at a point that is no minimum.

    Steps that fail until the damping has made them small, or until none lowers the loss any more, look like convergence.
    """
    if result is not RESULTS.successful or linear.loss <= (10 * rounding) ** 2:
        return result
    # Directions of less than this share of the largest curvature are not identifiable: their derivatives may be rounding.
    change, decrease = linear.step(_CLEAR)
    # Errors without noise are the rounding of their simulation, and so is the decrease. The unknowns, shares, are then exact.
    is_exact = np.abs(change).max(initial=0.0) <= rounding**0.7
    return result if is_exact or decrease <= 10 * max(tolerance, 1e3 * rounding) * linear.loss else RESULTS.no_descent


def propose(here: LinearErrors, damping: float, tolerance: float) -> np.ndarray | None:
    """Step dy (p,) at a damping; None where it predicts no decrease beyond `tolerance`, or the damping has no effect left."""
    dy, decrease = here.step(damping)
    return None if damping > _MAX_DAMPING or decrease <= tolerance * here.loss else dy


if TYPE_CHECKING:
    import optax

    Optimizer = optax.GradientTransformation
else:
    Optimizer = Any  # optax is imported when a fit runs

SOLVERS, METHODS = ("levenberg-marquardt", "dogleg"), ("lbfgs", "adam")
# Damping, in shares of the largest curvature, with which the decrease that a step promises is judged at the end of a fit.
_CLEAR = 1e-6
# Steps without a lower loss after which only rounding is left to remove.
_STALE = 10
# Random changes that a step tries.
_CHANGES = 16
_OPTIONS = {"jac": "fwd"}


@contextlib.contextmanager
def loose_promotion():
    """Context in which dtypes and ranks are promoted, as optimistix and optax expect."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


class LeastSquaresSteps(Method):
    """Levenberg-Marquardt or dogleg steps for the sum of squares of `errors(z, args)`; Jacobians by forward mode.

    It ends where a step changes unknowns and loss by less than `tolerance` of them. The state of an iterate is the solver's.
    """

    floor = 0.0

    def __init__(self, errors: Callable, args, name: str, tolerance: float):
        kind = optx.LevenbergMarquardt if name == SOLVERS[0] else optx.Dogleg
        # A tolerance below rounding of float64 may never be met.
        self.solver = kind(rtol=max(tolerance, 1e-14), atol=max(tolerance, 1e-14))
        self.errors, self.args = errors, args

    def init(self, start, kept):
        """Start the solver, or restore its state."""
        with loose_promotion():
            state = _init_solver(self.errors, self.solver, start, self.args)
            return self._iterate(start, state if kept is None else restore_leaves(kept, "solver", state))

    def step(self, iterate, history, best):
        """Make one step, which need not be accepted: the point then stays and the solver's state changes."""
        if len(history) > _STALE and min(history[-_STALE:]) >= min(history[:-_STALE]):
            return iterate, RESULTS.successful
        with loose_promotion():
            y, state, done, has_failed = _step_solver(self.errors, self.solver, iterate.point, self.args, iterate.state)
            following = self._iterate(y, state)
        if bool(has_failed):
            return following, RESULTS.nonfinite
        return following, RESULTS.successful if bool(done) else None

    def arrays(self, iterate):
        """Array leaves of the solver's state."""
        return array_leaves("solver", iterate.state)

    def _iterate(self, y, state) -> Iterate:
        loss = float(_sum_of_squares(self.errors, y, self.args))
        return Iterate(y, loss, state, bool(np.isfinite(loss)))


class GradientSteps(Method):
    """Steps of optax on `loss(y, args)`, y a pytree of arrays.

    The optimiser sees the loss over the length of its gradient at the start, so that the size of the first step is
    independent of the unit of the loss.

    **Arguments:** `loss`, a function defined once (it is static: another one compiles again), its arrays in `args`; `method`:
    "lbfgs" with a line search for the strong Wolfe conditions, "adam", whose `learning_rate` decays to zero along a cosine in
    `steps`, or an optax.GradientTransformation; `tolerance`: "lbfgs" ends once ten steps have lowered the loss by less than this
    share of it; `floor` of the loss: of squares zero.

    The state of an iterate is `_Descent`.
    """

    def __init__(
        self,
        loss: Callable,
        args,
        *,
        method: Any,
        steps: int = 0,
        learning_rate: float = 0.0,
        tolerance: float = 0.0,
        floor: float = -np.inf,
    ):
        self.loss, self.args, self.tolerance, self.floor = loss, args, tolerance, floor
        self.is_searching = isinstance(method, str) and method == "lbfgs"
        self.optimizer = (
            _make_optimizer(method, int(steps), float(learning_rate)) if isinstance(method, str) else method
        )

    def init(self, start, kept):
        """Evaluate the start, or restore the state of the optimiser."""
        # optax mixes Python and NumPy numbers with arrays, which strict promotion refuses.
        with loose_promotion():
            value, gradient = _evaluate(self.loss, start, self.args)
            state = _Descent(value, gradient, self.optimizer.init(start), _inverse_length(gradient))
            return self._iterate(start, state if kept is None else restore_leaves(kept, "optimizer", state))

    def step(self, iterate, history, best):
        """Make one step."""
        if self.is_searching and len(history) > _STALE:
            if history[-1 - _STALE] - history[-1] <= self.tolerance * abs(history[-1]):
                return iterate, RESULTS.successful if self._is_minimum(iterate, history) else RESULTS.no_descent
        with loose_promotion():
            y, state = _update(self.optimizer, self.loss, self.args, self.is_searching, iterate.point, iterate.state)
            if not self.is_searching:
                value, gradient = _evaluate(self.loss, y, self.args)
                state = state._replace(value=value, gradient=gradient)
            return self._iterate(y, state), None

    def _is_minimum(self, iterate, history: list[float]) -> bool:
        """Decide whether a step along the gradient would lower the loss by less than the tolerance (Cauchy's point)."""
        y, gradient = iterate.point, iterate.state.gradient
        eps = float(jnp.finfo(jnp.result_type(*jax.tree.leaves(y))).eps)
        square, size = (float(sum(jnp.sum(x**2) for x in jax.tree.leaves(tree))) for tree in (gradient, y))
        # A loss at rounding of the first one, and a gradient of zero.
        if abs(iterate.loss) <= 100 * eps * abs(history[0]) or square == 0:
            return True
        # The curvature along the gradient by a difference of gradients: a second derivative may not exist.
        step = eps**0.5 * max(1.0, size**0.5) / square**0.5
        with loose_promotion():
            _, beyond = _evaluate(self.loss, jax.tree.map(lambda x, g: x + step * g, y, gradient), self.args)
        pairs = zip(jax.tree.leaves(beyond), jax.tree.leaves(gradient), strict=True)
        curvature = float(sum(jnp.sum((new - old) * old) for new, old in pairs)) / step
        promised = square**2 / (2 * curvature) if curvature > 0 else np.inf
        return promised <= 10 * max(self.tolerance, 1e3 * eps) * abs(iterate.loss)

    def arrays(self, iterate):
        """Array leaves of the state."""
        return array_leaves("optimizer", iterate.state)

    @staticmethod
    def _iterate(y, state: "_Descent") -> Iterate:
        is_finite = all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves((state.value, state.gradient)))
        return Iterate(y, float(state.value), state, is_finite)


class RandomSteps(Method):
    """Steps to the best of sixteen random changes: for losses that are infinite beyond limits, where gradients do not help.

    Changes grow after a step that lowers the loss, and shrink after others: a one-plus-lambda evolution strategy with
    Rechenberg's rule. The state of an iterate is their size.

    **Arguments:** `losses`, from points, stacked leaf by leaf, to their losses (k,); `sizes`: pytree of the first deviations.
    """

    def __init__(self, losses: Callable, sizes: Any, seed: int):
        self.losses, self.sizes, self.seed = losses, sizes, seed

    def init(self, start, kept):
        """Evaluate the start."""
        return Iterate(start, float(self.losses(jax.tree.map(lambda x: x[None], start))[0]), 1.0)

    def step(self, iterate, history, best):
        """Make one step."""
        rng = np.random.default_rng((self.seed, len(history)))
        points = jax.tree.map(
            lambda x, size: (np.asarray(x) + iterate.state * size * rng.normal(size=(_CHANGES, *x.shape))).astype(
                x.dtype
            ),
            iterate.point,
            self.sizes,
        )
        losses = np.asarray(self.losses(points))
        k = int(np.argmin(losses))
        if losses[k] < iterate.loss:
            return Iterate(jax.tree.map(lambda x: x[k], points), float(losses[k]), 1.5 * iterate.state), None
        return iterate._replace(state=iterate.state / 1.3), None


class _Descent(NamedTuple):
    """Loss and gradient at a point, the state of the optimiser, and the factor of the loss for it."""

    value: Array
    gradient: Any
    optimizer: Any
    factor: Array


def _inverse_length(gradient):
    length = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(gradient)))
    good = (length > 0) & jnp.isfinite(length)
    return 1 / jnp.where(good, length, jnp.ones_like(length))


# The same object for the same arguments: functions in an optimiser are static, and new ones would compile `_update` again.
@functools.lru_cache
def _make_optimizer(method: str, steps: int, learning_rate: float) -> Any:
    import optax  # here, so that importing jaxdyn does not import it

    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    # 40 halvings shorten the step to 1e-12: a decrease that needs less is rounding.
    return optax.lbfgs(memory_size=30, linesearch=optax.scale_by_zoom_linesearch(40, initial_guess_strategy="one"))


@eqx.filter_jit
def _evaluate(loss, y, args):
    return jax.value_and_grad(loss)(y, args)


@eqx.filter_jit
def _update(optimizer, loss, args, is_searching: bool, y, state: _Descent):
    import optax

    factor = state.factor
    scaled, given = jax.tree.map(lambda x: factor * x, state.gradient), {}
    if is_searching:
        given = {"value": factor * state.value, "grad": scaled, "value_fn": lambda y: factor * loss(y, args)}
    change, own = optimizer.update(scaled, state.optimizer, y, **given)
    state = state._replace(optimizer=own)
    if is_searching:
        # The line search has evaluated the loss at its end.
        value, gradient = (optax.tree_utils.tree_get(own, name) for name in ("value", "grad"))
        state = state._replace(value=value / factor, gradient=jax.tree.map(lambda x: x / factor, gradient))
    return optax.apply_updates(y, change), state


@eqx.filter_jit
def _sum_of_squares(errors, y, args):
    return jnp.sum(errors(y, args) ** 2)


def _with_aux(errors):
    return lambda z, args: (errors(z, args), None)


@eqx.filter_jit
def _init_solver(errors, solver, y, args):
    shape = jax.eval_shape(lambda: errors(y, args))
    return solver.init(_with_aux(errors), y, args, _OPTIONS, shape, None, frozenset())


@eqx.filter_jit
def _step_solver(errors, solver, y, args, state):
    fn = _with_aux(errors)
    y, state, _ = solver.step(fn, y, args, _OPTIONS, state, frozenset())
    done, result = solver.terminate(fn, y, args, _OPTIONS, state, frozenset())
    return y, state, done, result != optx.RESULTS.successful
