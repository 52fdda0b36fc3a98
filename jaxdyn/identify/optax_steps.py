"""Gradient descent on a smooth loss of a flat vector by optax; the loss and its gradient are compiled once."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.identify.descent import Iterate, Method
from jaxdyn.identify.optimistix_steps import loose_promotion

if TYPE_CHECKING:
    import optax

    Optimizer = optax.GradientTransformation
else:
    Optimizer = Any  # optax is imported when a fit runs

METHODS = ("lbfgs", "adam")
# Weak Wolfe conditions: a sufficient decrease, and a derivative large enough for a curvature pair to be positive.
_DECREASE, _CURVATURE = 1e-4, 0.9
# Steps of a round of L-BFGS, and the number of rounds of Adam.
_ROUND, _ADAM_ROUNDS = 20, 10


class GradientSteps(Method):
    """Steps of optax on `loss(y, args)`, y (n,), in coordinates that follow the curvature.

    The optimiser sees z with y = center + S z. "lbfgs" and "adam" work in rounds: each starts at the best point so far with the S
    of that point, because a metric that fits the start is a poor guide far from it.

    **Arguments:** `loss`, a function defined once (it is static: another one compiles again), its arrays in `args`;
    `method`: "lbfgs", "adam", or an optax.GradientTransformation without a line search, which gets one round, since its
    state and schedule are its own; `steps`, the most steps; `learning_rate` of adam, decaying to zero along a cosine in every
    round; `tolerance`: lbfgs stops once a round has lowered the loss by less than this share of it; `scaling(y) -> (n, n)`, for a
    round that starts at y: S S^T is about the inverse of the Hessian there.

    **Raises:** ValueError for an unknown method or numbers that are not positive.
    """

    def __init__(
        self,
        loss: Callable,
        args,
        *,
        method: Any,
        steps: int,
        learning_rate: float,
        tolerance: float,
        scaling: Callable,
    ):
        if not (steps > 0 and learning_rate > 0 and tolerance >= 0):
            raise ValueError(
                f"steps={steps}, learning_rate={learning_rate}, tolerance={tolerance}; all must be positive"
            )
        self.loss, self.args, self.tolerance, self.scaling = loss, args, tolerance, scaling
        self.is_searching = isinstance(method, str) and method == "lbfgs"
        self.length = int(steps)
        if isinstance(method, str):
            self.length = _ROUND if self.is_searching else -(-int(steps) // _ADAM_ROUNDS)
            method = _optimizer(method, self.length, float(learning_rate))
        self.optimizer = method

    def init(self, start, kept):
        """Begin a round at the start, or restore one."""
        # optax mixes Python and NumPy numbers with arrays, which strict promotion refuses.
        with loose_promotion():
            state = self._begin(jnp.asarray(start), np.inf) if kept is None else self._restore(start, kept)
            return self._iterate(state)

    def step(self, iterate, history, best):
        """Make one step of the round, or of a new round where this one has ended."""
        state = iterate.state
        with loose_promotion():
            while True:
                is_slow = self.is_searching and state.step >= 10 and _is_slow(history, self.tolerance)
                if state.step < self.length and not is_slow:
                    following = self._advance(state)
                    if following is not None:
                        return self._iterate(following), None
                if self.is_searching and state.before - best.loss <= self.tolerance * best.loss:
                    return iterate, "converged"
                state = self._begin(best.point, best.loss)

    def arrays(self, iterate):
        """Arrays of the round and of the optimiser."""
        state = iterate.state
        arrays = {"before": np.float64(state.before), "step": np.int64(state.step), "z": state.z}
        arrays |= {"value": state.value, "gradient": state.gradient}
        arrays |= {name: getattr(state.path, name) for name in ("center", "scaling", "size")}
        leaves = [leaf for leaf in jax.tree.leaves(state.optimizer) if eqx.is_array(leaf)]
        return arrays | {f"optimizer_{i:03d}": leaf for i, leaf in enumerate(leaves)}

    def _restore(self, start, kept) -> "_Round":
        arrays = {name: jnp.asarray(x) for name, x in kept.items()}
        path = _Path(self.loss, self.args, arrays["center"], arrays["scaling"], arrays["size"])
        # A checkpoint holds arrays alone: structure and other leaves come from a fresh state.
        leaves, structure = jax.tree.flatten(self.optimizer.init(jnp.zeros_like(start)))
        # Three digits in the names make their alphabetical order that of the leaves.
        own = iter([arrays[name] for name in sorted(kept) if name.startswith("optimizer_")])
        optimizer = jax.tree.unflatten(structure, [next(own) if eqx.is_array(leaf) else leaf for leaf in leaves])
        before, step = float(kept["before"]), int(kept["step"])
        return _Round(path, arrays["z"], arrays["value"], arrays["gradient"], optimizer, step, before)

    def _begin(self, point, before: float) -> "_Round":
        path, value, gradient = _begin_path(self.loss, self.args, point, self.scaling(point))
        z = jnp.zeros_like(point)
        return _Round(path, z, value, gradient, self.optimizer.init(z), 0, before)

    def _advance(self, state: "_Round") -> "_Round | None":
        """The round one step later; None where no step lowers the loss by more than rounding."""
        path = state.path
        update, optimizer = _update(self.optimizer, path.size * state.gradient, state.optimizer, state.z)
        if self.is_searching:
            decrease = _line_search(path.evaluate, state.z, state.value, state.gradient, update)
            if decrease is None:
                return None
            z, value, gradient = decrease
        else:
            z = state.z + update
            value, gradient = path.evaluate(z)
        return _Round(path, z, value, gradient, optimizer, state.step + 1, state.before)

    @staticmethod
    def _iterate(state: "_Round") -> Iterate:
        loss = float(state.value)
        is_finite = bool(np.isfinite(loss)) and bool(jnp.isfinite(state.gradient).all())
        return Iterate(state.path.point(state.z), loss, state, is_finite)


class _Round(NamedTuple):
    """State of a round: its path, the point z with loss and gradient there, optax's state, steps made, and the loss before it."""

    path: "_Path"
    z: Array
    value: Array
    gradient: Array
    optimizer: Any
    step: int
    before: float


class _Path(NamedTuple):
    """The loss along y = center + S z."""

    loss: Callable
    args: Any
    center: Array
    scaling: Array
    size: Any = 1.0

    def point(self, z):
        return self.center + self.scaling @ z

    def evaluate(self, z):
        value, gradient = _evaluate(self.loss, self.point(z), self.args)
        return value, gradient @ self.scaling


def _begin_path(loss: Callable, args, center, scaling):
    """A path from `center`, with the loss and its gradient there.

    A unit of z is the step that `scaling` predicts, but no column is longer than one unit of y: beyond that, where exponentials
    dominate, the curvature at the center says nothing. `size` makes the first gradient one unit long for the optimiser, however
    small the loss.
    """
    path = _Path(loss, args, center, scaling)
    value, gradient = path.evaluate(jnp.zeros_like(center))
    steepness = jnp.sqrt(gradient @ gradient)
    steepness = jnp.where((steepness > 0) & jnp.isfinite(steepness), steepness, jnp.ones_like(steepness))
    units = steepness * jnp.minimum(1, 1 / (steepness * jnp.linalg.norm(scaling, axis=0)))
    gradient = gradient * units
    length = jnp.sqrt(gradient @ gradient)
    good = (length > 0) & jnp.isfinite(length)
    size = 1 / jnp.where(good, length, jnp.ones_like(length))
    return path._replace(scaling=scaling * units[None, :], size=size), value, gradient


def _is_slow(history, tolerance) -> bool:
    # Over ten steps: one short step is no sign of convergence.
    return history[-11] - history[-1] <= tolerance * abs(history[-1])


def _line_search(evaluate: Callable, z, value, gradient, direction):
    """Point, loss and gradient along a direction, by bracketing the weak Wolfe conditions; None when there is none."""
    derivative = float(gradient @ direction)
    if not derivative < 0:  # rounding has spoilt the curvature pairs
        direction, derivative = -gradient, -float(gradient @ gradient)
    low, high, length, decrease = 0.0, np.inf, 1.0, None
    # 40 halvings shorten the step to 1e-12: a decrease that needs less is rounding.
    for _ in range(40):
        point = z + length * direction
        trial, trial_gradient = evaluate(point)
        if not float(trial) <= float(value) + _DECREASE * length * derivative:  # NaN too
            high = length
        else:
            # Strictly lower: within rounding the first Wolfe condition also accepts points that gain nothing.
            decrease = (point, trial, trial_gradient) if float(trial) < float(value) else decrease
            if float(trial_gradient @ direction) >= _CURVATURE * derivative:
                break
            low = length
        length = 2 * length if high == np.inf else (low + high) / 2
    return decrease


# The same object for the same arguments: functions in an optimiser are static, and new ones would compile `_update` again.
@functools.lru_cache
def _optimizer(method: str, steps: int, learning_rate: float) -> Any:
    import optax  # here, so that importing jaxdyn does not import it

    if method == "lbfgs":
        return optax.lbfgs(memory_size=30, linesearch=None)
    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    raise ValueError(f"method is {method!r}; give one of {METHODS} or an optax.GradientTransformation")


@eqx.filter_jit
def _evaluate(loss, y, args):
    return jax.value_and_grad(loss)(y, args)


@eqx.filter_jit
def _update(optimizer, gradient, state, y):
    return optimizer.update(gradient, state, y)
