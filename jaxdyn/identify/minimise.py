"""Minimising a smooth loss of a flat vector with optax; the loss and its gradient are compiled once."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.identify.progress import Watch

if TYPE_CHECKING:
    import optax

    Optimizer = optax.GradientTransformation
else:
    Optimizer = Any  # optax is imported when a fit runs

METHODS = ("lbfgs", "adam")
# Weak Wolfe conditions: enough decrease, and a slope that has flattened enough for a positive curvature pair.
_DECREASE, _FLATTER = 1e-4, 0.9
# Steps of a round of L-BFGS, and the number of rounds of Adam.
_ROUND, _ADAM_ROUNDS = 20, 10


def minimise(
    loss: Callable, start, args, *, method, learning_rate, tolerance, scaling: Callable, watch: Watch
) -> tuple[Array, np.ndarray, str]:
    """Minimise `loss(y, args)` over y (n,) from `start`, in coordinates that follow the curvature.

    The optimiser sees z with y = center + S z. "lbfgs" and "adam" work in rounds: each starts with the S and the center of
    where the last one came to, because a metric that fits the start is a poor guide far from it.

    **Arguments:** `loss`, a function defined once (it is static: another one compiles again), its arrays in `args`;
    `scaling(y) -> (n, n)`, for a round that starts at y: S S^T is about the inverse of the Hessian there;
    `method`: "lbfgs", "adam", or an optax.GradientTransformation without a line search, which gets one round, since its
    state and schedule are its own; `learning_rate` of adam, decaying to zero along a cosine in
    every round; `tolerance`: lbfgs stops once a round has lowered the loss by less than this share of it;
    `watch` is told of every point, the start included, and says how many steps there are at most. From a checkpoint it goes
    on to the same numbers.

    **Returns:** the best y found; the loss at every point (steps + 1,); "converged", "max_steps", "stopped" or "not_finite" (the
    loss or its gradient was not finite where a step led; the best y is a point before).

    **Raises:** ValueError for an unknown method or numbers that are not positive.
    """
    steps = watch.steps
    if not (steps > 0 and learning_rate > 0 and tolerance >= 0):
        raise ValueError(f"steps={steps}, learning_rate={learning_rate}, tolerance={tolerance}; all must be positive")
    searching = isinstance(method, str) and method == "lbfgs"
    length = _ROUND if searching else -(-int(steps) // _ADAM_ROUNDS) if isinstance(method, str) else int(steps)
    optimizer = _optimizer(method, length, float(learning_rate)) if isinstance(method, str) else method
    # optax mixes python and numpy numbers with arrays, which strict promotion refuses.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        best, lowest, history, kept = jnp.asarray(start), np.inf, [], watch.load()
        while True:
            begin, before = 0, lowest
            if kept is None:
                path, value, gradient = _begin(loss, args, best, scaling(best))
                z = jnp.zeros_like(best)
                state = optimizer.init(z)
            else:
                best, lowest, before, begin, history, path, z, value, gradient, state = _restored(
                    kept, loss, args, optimizer, best
                )
                kept = None
            # A round begins where the last one ended: the point is in the history already.
            for step in range(begin, length + 1):
                if step > 0 or not history:
                    now = (best, lowest, before, step, history, path, z, value, gradient, state)
                    history.append(float(value))
                    goes_on = watch.goes_on(len(history) - 1, history[-1], path.point(z), lambda now=now: _kept(*now))
                    if not goes_on and np.isfinite(history[-1]):
                        best = path.point(z) if history[-1] < lowest else best
                        return best, np.array(history), "stopped"
                if not (np.isfinite(float(value)) and bool(jnp.isfinite(gradient).all())):
                    watch.failed = path.point(z)
                    return best, np.array(history), "not_finite"
                if float(value) < lowest:
                    best, lowest = path.point(z), float(value)
                if lowest == 0:
                    return best, np.array(history), "converged"
                if len(history) > steps:
                    return best, np.array(history), "max_steps"
                if step == length or (searching and step >= 10 and _slow(history, tolerance)):
                    break
                update, state = _update(optimizer, path.size * gradient, state, z)
                if searching:
                    decrease = _line_search(path.evaluate, z, value, gradient, update)
                    if decrease is None:  # no decrease that rounding lets one see
                        break
                    z, value, gradient = decrease
                else:
                    z = z + update
                    value, gradient = path.evaluate(z)
            if searching and before - lowest <= tolerance * lowest:
                return best, np.array(history), "converged"


def _kept(best, lowest, before, step, history, path, z, value, gradient, state) -> dict:
    """What a checkpoint holds: the point, which is not in the history yet when it is read again."""
    numbers = {"best": best, "lowest": np.float64(lowest), "before": np.float64(before), "step": np.int64(step)}
    numbers |= {"history": np.array(history[:-1]), "z": z, "value": value, "gradient": gradient}
    numbers |= {"center": path.center, "scaling": path.scaling, "size": path.size}
    leaves = [leaf for leaf in jax.tree.leaves(state) if eqx.is_array(leaf)]
    return numbers | {f"optimizer_{i:03d}": leaf for i, leaf in enumerate(leaves)}


def _restored(kept, loss, args, optimizer, like):
    """The arguments of `_kept` again."""
    arrays = {name: jnp.asarray(x) for name, x in kept.items()}
    path = _Path(loss, args, arrays["center"], arrays["scaling"], arrays["size"])
    leaves, structure = jax.tree.flatten(optimizer.init(jnp.zeros_like(like)))
    own = iter([arrays[name] for name in sorted(kept) if name.startswith("optimizer_")])
    state = jax.tree.unflatten(structure, [next(own) if eqx.is_array(leaf) else leaf for leaf in leaves])
    known = (float(kept["lowest"]), float(kept["before"]), int(kept["step"]), kept["history"].tolist())
    return arrays["best"], *known, path, arrays["z"], arrays["value"], arrays["gradient"], state


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


def _begin(loss: Callable, args, center, scaling):
    """A path from `center`, with the loss and its gradient there.

    A unit of z is the way that `scaling` foresees, but no column is longer than one unit of y: beyond that, where exponentials
    take over, what holds at the center says nothing. `size` makes the first gradient one unit long for the optimiser, however
    small the loss.
    """
    path = _Path(loss, args, center, scaling)
    value, gradient = path.evaluate(jnp.zeros_like(center))
    slope = jnp.sqrt(gradient @ gradient)
    slope = jnp.where((slope > 0) & jnp.isfinite(slope), slope, jnp.ones_like(slope))
    units = slope * jnp.minimum(1, 1 / (slope * jnp.linalg.norm(scaling, axis=0)))
    gradient = gradient * units
    length = jnp.sqrt(gradient @ gradient)
    good = (length > 0) & jnp.isfinite(length)
    size = 1 / jnp.where(good, length, jnp.ones_like(length))
    return path._replace(scaling=scaling * units[None, :], size=size), value, gradient


def _slow(history, tolerance) -> bool:
    return history[-11] - history[-1] <= tolerance * abs(history[-1])


def _line_search(evaluate: Callable, z, value, gradient, direction):
    """Point, loss and gradient along a direction, by bracketing the weak Wolfe conditions; None when there is none."""
    slope = float(gradient @ direction)
    if not slope < 0:  # rounding has spoilt the curvature pairs
        direction, slope = -gradient, -float(gradient @ gradient)
    low, high, length, decrease = 0.0, np.inf, 1.0, None
    for _ in range(40):
        point = z + length * direction
        trial, trial_gradient = evaluate(point)
        if not float(trial) <= float(value) + _DECREASE * length * slope:  # NaN too
            high = length
        else:
            decrease = (point, trial, trial_gradient) if float(trial) < float(value) else decrease
            if float(trial_gradient @ direction) >= _FLATTER * slope:
                break
            low = length
        length = 2 * length if high == np.inf else (low + high) / 2
    return decrease


@functools.lru_cache
def _optimizer(method: str, steps: int, learning_rate: float) -> Any:
    import optax  # here, so that importing jaxdyn does not import it

    if method == "lbfgs":
        return optax.lbfgs(memory_size=30, linesearch=None)
    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    raise ValueError(f"method is {method!r}; take one of {METHODS} or an optax.GradientTransformation")


@eqx.filter_jit
def _evaluate(loss, y, args):
    return jax.value_and_grad(loss)(y, args)


@eqx.filter_jit
def _update(optimizer, gradient, state, y):
    return optimizer.update(gradient, state, y)
