"""Gains of control laws: a number, one number per row of an error, or a matrix; leaves, checked where they are concrete."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import as_array, is_concrete
from jaxdyn.model.numbers import as_float


def gain(value: Any, name: str) -> Array:
    """Convert a gain to an array leaf: (), (n,) for a diagonal matrix, or (n, n).

    **Raises:** ValueError, for concrete numbers, for a gain that is not positive definite: its symmetric part has
    an eigenvalue that is zero, negative or not finite.
    """
    array = as_array(value, name)
    if array.ndim > 2 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise ValueError(
            f"{name} has shape {array.shape}; give a number, (n,) for a diagonal matrix, or a matrix (n, n)"
        )
    if is_concrete(array):
        # Only the symmetric part enters e . K e, so it alone decides definiteness.
        known = np.asarray(array, float)
        # `initial` admits a gain for no rows, which has no least entry.
        least = np.linalg.eigvalsh((known + known.T) / 2).min() if _is_matrix(known) else known.min(initial=np.inf)
        if not (np.isfinite(known).all() and least > 0):
            raise ValueError(f"{name} is {known.tolist()}, which is not positive definite; give positive gains")
    # Integer gains become floating-point leaves: `jax.grad` refuses integers.
    return as_float(array, name)


def times(gain: Array, error: Float[Array, " n"], name: str) -> Float[Array, " n"]:
    """Product K e for a gain of any shape. **Raises:** ValueError for one of another size."""
    if gain.ndim and gain.shape[0] != error.shape[0]:
        raise ValueError(
            f"{name} has shape {gain.shape} for an error of {error.shape[0]} rows; give a number, {error.shape} or "
            f"{error.shape * 2}"
        )
    # A float64 gain would promote the law of a float32 state.
    gain = gain.astype(error.dtype)
    return matmul(gain, error) if gain.ndim == 2 else gain * error


def as_matrix(gain: Array, like: Float[Array, " n"], name: str) -> Float[Array, "n n"]:
    """Matrix (n, n) of a gain."""
    # Column by column through `times`, so that numbers, diagonals and matrices follow one rule.
    unit = jnp.eye(like.shape[0], dtype=like.dtype)
    return jnp.stack([times(gain, column, name) for column in unit], 1)


def _is_matrix(known: np.ndarray) -> bool:
    return known.ndim == 2
