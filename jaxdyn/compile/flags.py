"""What a program of numbers cannot compute, as it has no branches: numbers that are flagged while it is traced.

`unless(flag, x)` is NaN where the flag is set. A program remembers its flags, so that whoever runs it may ask whether a sample
was served (`run(..., served=True)`), and learns before anything is compiled where every sample is.
"""

import jax
import jax.numpy as jnp

from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, is_zero


def unless(flag: jax.Array, x: jax.Array) -> jax.Array:
    """x, a float array, or NaN where the flag () is set; only while a program of numbers is traced."""
    return unless_p.bind(jnp.broadcast_to(flag, x.shape), x)


def _batched(args, axes):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    moved = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(args, axes, strict=True)
    ]
    return unless_p.bind(*moved), 0


def _jvp(primals, tangents):
    flag, x = primals
    step = tangents[1]
    return unless_p.bind(flag, x), step if is_zero(step) else unless_p.bind(flag, step)


def _transpose(cotangent, flag, x):
    return [None, cotangent if is_zero(cotangent) else unless_p.bind(flag, cotangent)]


unless_p = define_primitive(
    "jaxdyn_unless",
    lambda flag, x: ShapedArray(x.shape, x.dtype),
    batch=_batched,
    jvp=_jvp,
    transpose=_transpose,
)
