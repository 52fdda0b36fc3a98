"""What a program of numbers cannot compute, as it has no branches: numbers that are flagged while it is traced.

`unless(flag, x)` is NaN where the flag is set. A program remembers its flags, so that whoever runs it may ask whether a sample
was served (`run(..., served=True)`), and learns before anything is compiled where every sample is.
"""

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching

unless_p = Primitive("jaxdyn_unless")
unless_p.def_abstract_eval(lambda flag, x: ShapedArray(x.shape, x.dtype))


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
    return unless_p.bind(flag, x), step if type(step) is ad.Zero else unless_p.bind(flag, step)


def _transpose(cotangent, flag, x):
    return [None, cotangent if type(cotangent) is ad.Zero else unless_p.bind(flag, cotangent)]


batching.primitive_batchers[unless_p] = _batched
ad.primitive_transposes[unless_p] = _transpose
ad.primitive_jvps[unless_p] = _jvp
