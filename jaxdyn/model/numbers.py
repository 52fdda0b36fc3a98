"""Conversion and checks of numbers that users give, with errors that name argument, value and fix."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import Number, as_array, store_leaf


def as_float(value: Any, what: str, shape: tuple | None = None, like=None) -> Float[Array, "..."]:
    """Convert `value` to a floating-point array, of the dtype `like` if that is given, else of its own or the default one.

    **Raises:** ValueError for no real numbers, another shape (None in it means any size), and known numbers that are NaN.
    """
    given = as_array(value, what)
    if like is None:
        # Integers become floating-point leaves: `jax.grad` refuses integers.
        like = jax.dtypes.canonicalize_dtype(given.dtype) if jnp.issubdtype(given.dtype, jnp.floating) else float
    array = jnp.asarray(given, like) if isinstance(given, jax.Array) else store_leaf(given, like)
    if shape is not None and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        shown = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{what} has shape {array.shape}, expected ({shown}); batch with jax.vmap")
    # Infinite entries are valid: an infinite h is no bound.
    if is_concrete(given) and np.isnan(np.asarray(given)).any():
        raise ValueError(f"{what} is {given}, with entries that are not a number; give numbers")
    return array


def as_number(value: object, what: str, unit: str = "", *, zero: bool = False, like=None) -> Float[Array, ""]:
    """Convert `value` to one positive number, or zero where that is allowed.

    **Raises:** ValueError for other shapes, and for known numbers below that or not finite.
    """
    array = as_float(value, what, (), like)
    if is_concrete(value):
        number = float(np.asarray(value))
        if not (number >= 0 if zero else number > 0) or number == float("inf"):
            sign = "zero or a positive number" if zero else "one positive number"
            raise ValueError(f"{what} is {number}; give {sign}{unit and f' ({unit})'}")
    return array


def as_static(value: Any, what: str, low: Number, high: Number, fix: str) -> float:
    """Check a number from `low` to below `high` on which a program depends, so that it cannot be traced.

    **Raises:** ValueError for anything else, with what to give: `fix`.
    """
    is_number = isinstance(value, (int, float, np.ndarray, np.generic, jax.Array)) and is_concrete(value)
    if not is_number or np.shape(value) != () or not low <= float(value) < high:
        raise ValueError(f"{what} is {value!r}; give {fix}, not traced")
    return float(value)


def check_seed(value: object, what: str = "seed") -> int:
    """Check the seed of random numbers. **Raises:** ValueError for anything but an integer of 32 bits that is not negative."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < 2**32:
        raise ValueError(f"{what} is {value!r}; give a whole number from 0 to 2^32 - 1")
    return int(value)


def check_count(value: object, what: str) -> int:
    """Check a number of steps, samples or bodies. **Raises:** ValueError for anything but a positive integer."""
    # True is an int to Python.
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{what} is {value!r}; give a positive integer")
    return int(value)
