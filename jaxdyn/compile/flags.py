"""Samples that a kernel cannot compute: numbers that a function marks as not valid while it is traced.

A kernel has no branches. Where a fast formula fails for some samples, such as a Cholesky factor of rows that depend on each
other, the function says so by `mark_invalid(flag, x)`, which is NaN where the flag is set. The program reports which samples are
valid, and native code computes the others by the fallback (see `careful`). A program without marks reports nothing.
"""

import weakref

import jax
import jax.numpy as jnp

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, function_of, is_zero, zero_tangent


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


_marked: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # jaxprs that were looked through


def has_marks(jaxpr) -> bool:
    """Decide whether a jaxpr marks numbers as not valid, also within functions that it calls."""
    if jaxpr not in _marked:
        _marked[jaxpr] = any(map(_is_marking, jaxpr.eqns))
    return _marked[jaxpr]


def _is_marking(eqn) -> bool:
    if eqn.primitive.name == "jaxdyn_invalid" or getattr(eqn.params.get("program"), "careful", None) is not None:
        return True
    values = (x for value in eqn.params.values() for x in (value if isinstance(value, (tuple, list)) else (value,)))
    inner = (getattr(x, "jaxpr", x) for x in values)
    return any(hasattr(x, "eqns") and has_marks(x) for x in inner)


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


def _batch_guard(args, axes, *, call, again):
    results = jax.vmap(function_of(call), axes)(*args)
    return results, [0] * len(results)


def _jvp_guard(primals, tangents, *, call, again):
    places = [i for i, x in enumerate(tangents) if not is_zero(x)]

    def at_values(*values):
        point = list(primals)
        for i, value in zip(places, values, strict=True):
            point[i] = value
        return function_of(call)(*point)

    results, changes = jax.jvp(at_values, [primals[i] for i in places], [tangents[i] for i in places])
    return results, [d if is_float(x) else zero_tangent(x) for x, d in zip(results, changes, strict=True)]


# A function `call`, whose samples that are marked as not valid are computed by `again` (see `trace.Again`). Its derivatives and
# batches are those of the function, whose marks reach the program around it then. It is bound while a program is traced.
guarded_p = define_primitive(
    "jaxdyn_guarded",
    lambda *types, call, again: list(call.out_avals),
    multiple_results=True,
    batch=_batch_guard,
    jvp=_jvp_guard,
)
