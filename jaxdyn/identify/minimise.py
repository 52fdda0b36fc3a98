"""Minimising a smooth loss of a flat vector with optax; the loss and its gradient are compiled once."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

METHODS = ("lbfgs", "adam")
# Weak Wolfe conditions: enough decrease, and a slope that has flattened enough for a positive curvature pair.
_DECREASE, _FLATTER = 1e-4, 0.9


def minimise(
    loss: Callable, start, args, *, method, steps, learning_rate, tolerance, callback=None
) -> tuple[Array, np.ndarray, str]:
    """Minimise `loss(y, args)` over y (n,) from `start`.

    **Arguments:** `loss`, a function defined once (it is static: another one compiles again), its arrays in `args`;
    `method`: "lbfgs", "adam", or an optax.GradientTransformation without a line search; `steps`, the most steps;
    `learning_rate` of adam, decaying to zero along a cosine; `tolerance`: lbfgs stops once ten steps have lowered the
    loss by less than this share of it; `callback(step, loss, y)` is called at every point, the start included.

    **Returns:** the best y found; the loss at every point (steps + 1,); "converged", "max_steps" or "not_finite" (the
    loss was not finite where a step led; the best y is a point before).

    **Raises:** ValueError for an unknown method or numbers that are not positive.
    """
    if not (steps > 0 and learning_rate > 0 and tolerance >= 0):
        raise ValueError(f"steps={steps}, learning_rate={learning_rate}, tolerance={tolerance}; all must be positive")
    searching = isinstance(method, str) and method == "lbfgs"
    optimizer = _optimizer(method, int(steps), float(learning_rate)) if isinstance(method, str) else method
    # optax mixes python and numpy numbers with arrays, which strict promotion refuses.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        y = jnp.asarray(start)
        value, gradient = _evaluate(loss, y, args)
        state = optimizer.init(y)
        history = [float(value)]
        best, lowest, result = y, np.inf, "max_steps"
        for step in range(steps + 1):
            if not np.isfinite(history[-1]):
                result = "not_finite"
                break
            if history[-1] < lowest:
                best, lowest = y, history[-1]
            if callback is not None:
                callback(step, history[-1], y)
            slow = len(history) > 10 and history[-11] - history[-1] <= tolerance * abs(history[-1])
            if history[-1] == 0 or (searching and slow):
                result = "converged"
                break
            if step == steps:
                break
            update, state = _update(optimizer, gradient, state, y)
            if searching:
                found = _line_search(loss, args, y, value, gradient, update)
                if found is None:  # no decrease that rounding lets one see
                    result = "converged"
                    break
                y, value, gradient = found
            else:
                y = y + update
                value, gradient = _evaluate(loss, y, args)
            history.append(float(value))
    return best, np.array(history), result


def _line_search(loss, args, y, value, gradient, direction):
    """Point, loss and gradient along a direction, by bracketing the weak Wolfe conditions; None when there is none."""
    slope = float(gradient @ direction)
    if not slope < 0:  # rounding has spoilt the curvature pairs
        direction, slope = -gradient, -float(gradient @ gradient)
    low, high, length, found = 0.0, np.inf, 1.0, None
    for _ in range(40):
        point = y + length * direction
        trial, trial_gradient = _evaluate(loss, point, args)
        if not float(trial) <= float(value) + _DECREASE * length * slope:  # NaN too
            high = length
        else:
            found = (point, trial, trial_gradient) if float(trial) < float(value) else found
            if float(trial_gradient @ direction) >= _FLATTER * slope:
                break
            low = length
        length = 2 * length if high == np.inf else (low + high) / 2
    return found


@functools.lru_cache
def _optimizer(method: str, steps: int, learning_rate: float) -> optax.GradientTransformation:
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
