"""Minimising a smooth loss of a flat vector with optax, one compiled step at a time."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

METHODS = ("lbfgs", "adam")


def minimise(
    loss: Callable, start, args, *, method, steps, learning_rate, tolerance, callback=None
) -> tuple[Array, np.ndarray, str]:
    """Minimise `loss(y, args)` over y (n,) from `start`.

    **Arguments:** `loss`, a function defined once (it is static: another function compiles again), its arrays in
    `args`;
    `method`: "lbfgs", "adam", or any optax.GradientTransformation; `steps`, the most steps; `learning_rate` of adam,
    decaying to zero along a cosine; `tolerance`: stop once the loss fell by less than this share of itself in 10 steps
    (lbfgs);
    `callback(step, loss, y)` is called before every step.

    **Returns:** the best y found, the loss before each step and at the end (steps + 1,), and "converged", "max_steps"
    or "not_finite" (the best y is then the one before).

    **Raises:** ValueError for an unknown method or numbers that are not positive.
    """
    if not (steps > 0 and learning_rate > 0 and tolerance >= 0):
        raise ValueError(f"steps={steps}, learning_rate={learning_rate}, tolerance={tolerance}; all must be positive")
    optimizer = _optimizer(method, int(steps), float(learning_rate)) if isinstance(method, str) else method
    # optax mixes python and numpy numbers with arrays, which strict promotion refuses.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        y = jnp.asarray(start)
        state = optimizer.init(y)
        history: list[float] = []
        best, lowest, result = y, np.inf, "max_steps"
        for step in range(steps + 1):
            following, next_state, value = _step(loss, optimizer, y, state, args)
            value = float(np.asarray(value))
            history.append(value)
            if not np.isfinite(value):
                result = "not_finite"
                break
            if value < lowest:
                best, lowest = y, value
            if callback is not None:
                callback(step, value, y)
            stalled = len(history) > 10 and history[-11] - value <= tolerance * abs(value)
            if value == 0 or (method == "lbfgs" and stalled):
                result = "converged"
                break
            y, state = following, next_state
    return best, np.array(history), result


@functools.lru_cache
def _optimizer(method: str, steps: int, learning_rate: float) -> optax.GradientTransformation:
    if method == "lbfgs":
        return optax.lbfgs(memory_size=30)
    if method == "adam":
        return optax.adam(optax.cosine_decay_schedule(learning_rate, steps))
    raise ValueError(f"method is {method!r}; take one of {METHODS} or an optax.GradientTransformation")


@eqx.filter_jit
def _step(loss, optimizer, y, state, args):
    def value_fn(y):
        return loss(y, args)

    # Line searches keep the last value and gradient in their state, and take the function itself.
    if optax.tree_utils.tree_get(state, "grad") is not None:
        value, gradient = optax.value_and_grad_from_state(value_fn)(y, state=state)
        update, state = optimizer.update(gradient, state, y, value=value, grad=gradient, value_fn=value_fn)
    else:
        value, gradient = jax.value_and_grad(value_fn)(y)
        update, state = optimizer.update(gradient, state, y)
    return jnp.asarray(optax.apply_updates(y, update)), state, value
