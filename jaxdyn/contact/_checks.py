"""Conversion and checks of arguments, with errors that name argument, value and fix."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import store_leaf


def as_float(value, what: str, shape: tuple | None = None, like=None) -> Float[Array, "..."]:
    """Convert `value` to a floating-point array, of the dtype of `like` if that is given.

    **Raises:** ValueError for another shape, None in it meaning any size, and for known numbers that are not finite.
    """
    # Known numbers are checked before they become part of a traced program.
    known = np.asarray(value) if is_concrete(value) else None
    # NumPy makes an object array of None and the like; the message of JAX would not name the argument.
    if known is not None and known.dtype == object:
        raise ValueError(f"{what} is {value!r}; give numbers")
    array = value if isinstance(value, jax.Array) else jnp.asarray(value) if known is None else known
    if like is None:
        like = jax.dtypes.canonicalize_dtype(array.dtype) if jnp.issubdtype(array.dtype, jnp.floating) else float
    array = jnp.asarray(array, like) if isinstance(array, jax.Array) else store_leaf(array, like)
    if shape is not None and (
        array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=True))
    ):
        shown = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{what} has shape {array.shape}, expected ({shown}); batch with jax.vmap")
    # Infinite entries are valid: an infinite h is no bound.
    if known is not None and np.isnan(known).any():
        raise ValueError(f"{what} is {known}, with entries that are not a number; give numbers")
    return array


def as_number(value, what: str, unit: str, *, zero: bool, like=None) -> Float[Array, ""]:
    """Convert `value` to one positive number, or zero where that is allowed.

    **Raises:** ValueError for known numbers below that or not finite.
    """
    array = as_float(value, what, (), like)
    if is_concrete(value):
        number = float(np.asarray(value))
        if not (number >= 0 if zero else number > 0) or number == float("inf"):
            sign = "zero or a positive number" if zero else "a positive number"
            raise ValueError(f"{what} is {number}; give {sign}{unit and f' ({unit})'}")
    return array
