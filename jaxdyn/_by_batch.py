"""`by_batch`: one of two ways to compute the same, chosen when the program is lowered, by how many samples there are then.

The size of a batch is known only after every enclosing `jax.vmap` has been applied. Other than by the question
`_dispatch.is_large_batch`, the way that is not taken is not even traced: for ways that take long to write down.
"""

import math
from collections.abc import Callable

import jax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import batching, mlir

_by_batch_p = Primitive("by_batch")
_by_batch_p.multiple_results = True


def by_batch(small: Callable, large: Callable, least: int, *args):
    """large(*args) for at least `least` samples on CPU, else small(*args).

    Both take and return pytrees of arrays, the same ones. Where `small` has effects, or depends on traced numbers other than its
    arguments, it is taken for any batch: it is then no function that can be traced later. It has no derivative: put it under one
    that is given.
    """
    leaves, structure = jax.tree.flatten(args)
    program, shape = jax.make_jaxpr(lambda *leaves: small(*jax.tree.unflatten(structure, leaves)), return_shape=True)(
        *leaves
    )
    if program.effects or any(isinstance(const, Tracer) for const in program.consts):
        return small(*args)

    def flat(*leaves):
        return jax.tree.leaves(large(*jax.tree.unflatten(structure, leaves)))

    found = _by_batch_p.bind(*leaves, small=program, large=flat, least=least, sizes=(), axes=())
    return jax.tree.unflatten(jax.tree.structure(shape), found)


def of_samples(function: Callable, axes) -> Callable:
    """The function under one `vmap` for each entry of `axes`, the innermost first."""
    for each in axes:
        function = jax.vmap(function, each)
    return function


def batched_axes(arrays, places) -> tuple[int, tuple]:
    """Of a batching rule's arrays and places: how many samples there are, and `in_axes` for them."""
    varies = [batching.not_mapped is not place for place in places]
    size = next(x.shape[place] for x, place, moves in zip(arrays, places, varies, strict=True) if moves)
    return size, tuple(place if moves else None for place, moves in zip(places, varies, strict=True))


def _as_small(*arrays, small: ClosedJaxpr, axes, **_):
    return of_samples(jaxpr_as_fun(small), axes)(*arrays)


def _on_cpu(ctx, *arrays, small, large, least, sizes, axes):
    function = jaxpr_as_fun(small) if math.prod(sizes) < least else large
    return mlir.lower_fun(of_samples(function, axes), multiple_results=True)(ctx, *arrays)


def _abstract(*avals, small, large, least, sizes, axes):
    return [ShapedArray((*sizes, *aval.shape), aval.dtype) for aval in small.out_avals]


def _batch(arrays, places, *, sizes, axes, **params):
    size, each = batched_axes(arrays, places)
    found = _by_batch_p.bind(*arrays, sizes=(size, *sizes), axes=(*axes, each), **params)
    return found, [0] * len(found)


_by_batch_p.def_impl(_as_small)
_by_batch_p.def_abstract_eval(_abstract)
mlir.register_lowering(_by_batch_p, mlir.lower_fun(_as_small, multiple_results=True))
mlir.register_lowering(_by_batch_p, _on_cpu, platform="cpu", cacheable=False)
batching.primitive_batchers[_by_batch_p] = _batch
