"""Samples that a kernel cannot compute: numbers that a function marks as not valid while it is traced.

A kernel has no branches. Where a fast formula fails for some samples, such as a Cholesky factor of rows that depend on each
other, the function says so by `mark_invalid(flag, x)`, which is NaN where the flag is set. The program reports which samples are
valid, and `kernel` computes the others by the fallback. A program without marks reports nothing and compiles no fallback.
"""

import jax
import jax.numpy as jnp

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, is_zero


def mark_invalid(flag: jax.Array, x: jax.Array) -> jax.Array:
    """Mark a float array as not valid where the flag () is set; returns it with NaN there.

    Outside of kernels nothing is marked: x is returned as it is.
    """
    if not mode.is_expanding():
        return x
    return invalid_p.bind(jnp.broadcast_to(flag, x.shape), x)


def is_float(x) -> bool:
    """Decide whether an array is of floating-point numbers, which can be marked and differentiated."""
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def mark_floats(flag: jax.Array, tree):
    """`mark_invalid` the float arrays of a pytree; others stay as they are."""
    return jax.tree.map(lambda x: mark_invalid(flag, x) if is_float(x) else x, tree)


def _batch(args, axes):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    full = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(args, axes, strict=True)
    ]
    return invalid_p.bind(*full), 0


def _jvp(primals, tangents):
    # NaN in the tangent too: a derivative that was computed from the failed formula must not look like a number.
    flag, x = primals
    step = tangents[1]
    return invalid_p.bind(flag, x), step if is_zero(step) else invalid_p.bind(flag, step)


def _transpose(cotangent, flag, x):
    return [None, cotangent if is_zero(cotangent) else invalid_p.bind(flag, cotangent)]


# A primitive, not a `jnp.where` with NaN: an expansion collects the flags of all marks by its name. It has no lowering, as it is
# bound while a program is traced, and nowhere else.
invalid_p = define_primitive(
    "jaxdyn_invalid",
    lambda flag, x: ShapedArray(x.shape, x.dtype),
    batch=_batch,
    jvp=_jvp,
    transpose=_transpose,
)
