"""`one_call`: a program of many small operations as one piece of machine code.

XLA:CPU runs a program by calling one compiled function for each of its operations, or groups of operations, and for small
arrays these calls cost far more than the arithmetic. But for loops over very few numbers it has another way: the whole loop
is compiled as one function, in which loops, branches and operations are plain code. Here a whole simulation becomes one such
function (see `_marked_call`).

It may contain only some operations. `_call_writer` writes programs in these; what cannot be written, or is so long that LLVM
would take minutes, stays as it is.

The primitive batches, and is differentiated as what it stands for. On other platforms than CPU it is that.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from jaxdyn._by_batch import batched_axes, of_samples
from jaxdyn._call_writer import NotWritten, has_kernels, is_short, written
from jaxdyn._marked_call import in_call

IN_CALLS = True  # False leaves ordinary programs, to compare with
MOST_SAMPLES = 32  # more run as fast on two cores in other ways

_one_call_p = Primitive("one_call")
_one_call_p.multiple_results = True


def one_call(function: Callable, *args, quick: Callable | None = None, careful: Callable | None = None):
    """function(*args), pytrees of arrays, in one call for up to `MOST_SAMPLES` samples on CPU, if it can be written so.

    With `quick` two other ways to the same are taken instead:

    - quick(*args) -> (what the function gives, whether it may be believed), in one call; it goes by kernels (see `_one_kernel`),
      which do not serve everywhere;
    - careful(*args), which serves everywhere and goes without kernels: an ordinary program, computed for all samples where one
      of them may not be believed.

    Where an error check at the outermost level of what is called so fails, numbers are NaN, instead of what it raises.
    """
    leaves, structure = jax.tree.flatten(args)

    def flat(function):
        return lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves)))

    first = quick or function
    program, shape = jax.make_jaxpr(lambda *args: first(*args), return_shape=True)(*args)
    held = [i for i, const in enumerate(program.consts) if isinstance(const, Tracer)]
    if program.effects or not is_short(program.jaxpr) or (quick and (held or not has_kernels(program.jaxpr))):
        return function(*args)
    ways, shapes = (jaxpr_as_fun(program), None, None), program.out_avals
    if quick is not None:
        ways, shapes, shape = (flat(function), jaxpr_as_fun(program), flat(careful)), shapes[:-1], shape[0]
    elif held:
        # Traced numbers that the function holds are arguments too.
        leaves, ways = [*(program.consts[i] for i in held), *leaves], (_with_arguments(program, held), None, None)
    found = _one_call_p.bind(*leaves, ways=ways, shapes=tuple(shapes), sizes=(), axes=())
    return jax.tree.unflatten(jax.tree.structure(shape), found)


def _with_arguments(program: ClosedJaxpr, held: list[int]) -> Callable:
    """The program with the constants `held` as its first arguments."""
    known = [None if i in held else const for i, const in enumerate(program.consts)]

    def function(*values):
        consts = list(known)
        for i, value in zip(held, values, strict=False):
            consts[i] = value
        return jaxpr_as_fun(ClosedJaxpr(program.jaxpr, consts))(*values[len(held) :])

    return function


def _as_it_is(*arrays, ways, axes, **_):
    return of_samples(ways[0], axes)(*arrays)


def _on_cpu(ctx, *arrays, ways, sizes, axes, **_):
    function = partial(_as_it_is, ways=ways, axes=axes)
    real = all(jnp.issubdtype(aval.dtype, np.number) or aval.dtype == bool for aval in ctx.avals_in)
    if IN_CALLS and real and 0 < math.prod(sizes) <= MOST_SAMPLES:
        try:
            function = _in_calls(*[way and of_samples(way, axes) for way in ways], avals=ctx.avals_in)
        except NotWritten:
            pass
    return mlir.lower_fun(function, multiple_results=True)(ctx, *arrays)


def _in_calls(function: Callable, quick: Callable | None, careful: Callable | None, avals) -> Callable:
    """The function by a marked call. **Raises:** NotWritten."""
    shortly = in_call(_written(quick or function, avals))
    if careful is None:
        return shortly
    surely = jaxpr_as_fun(_written(careful, avals, by_libraries=True))

    def either(*arrays):
        *found, believed = shortly(*arrays)
        return lax.cond(believed.all(), lambda *_: found, surely, *arrays)

    return either


def _written(function: Callable, avals, by_libraries: bool = False) -> ClosedJaxpr:
    """The function as `written`; its floats are NaN where an error check fails."""

    def body(*arrays):
        found, failed = written(jax.make_jaxpr(function)(*arrays), arrays, by_libraries)
        if failed is None:
            return found
        return [jnp.where(failed, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.inexact) else x for x in found]

    return jax.make_jaxpr(body)(*avals)


# --- the primitive ---------------------------------------------------------------------------------


def _abstract(*avals, shapes, sizes, **_):
    return [ShapedArray((*sizes, *aval.shape), aval.dtype) for aval in shapes]


def _batch(arrays, places, *, sizes, axes, **params):
    size, each = batched_axes(arrays, places)
    found = _one_call_p.bind(*arrays, sizes=(size, *sizes), axes=(*axes, each), **params)
    return found, [0] * len(found)


def _jvp(primals, tangents, **params):
    moving = [i for i, tangent in enumerate(tangents) if type(tangent) is not ad.Zero]

    def moved(*values):
        here = list(primals)
        for i, value in zip(moving, values, strict=True):
            here[i] = value
        return _as_it_is(*here, **params)

    found, steps = jax.jvp(moved, [primals[i] for i in moving], [tangents[i] for i in moving])
    zeros = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in found]
    return found, [zero if step.dtype == jax.dtypes.float0 else step for step, zero in zip(steps, zeros, strict=True)]


@lru_cache(maxsize=64)
def _program(**params):
    return jax.jit(partial(_one_call_p.bind, **params))


_one_call_p.def_impl(lambda *arrays, **params: _program(**params)(*arrays))
_one_call_p.def_abstract_eval(_abstract)
mlir.register_lowering(_one_call_p, mlir.lower_fun(_as_it_is, multiple_results=True))
mlir.register_lowering(_one_call_p, _on_cpu, platform="cpu", cacheable=False)
batching.primitive_batchers[_one_call_p] = _batch
ad.primitive_jvps[_one_call_p] = _jvp
