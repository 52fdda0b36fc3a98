"""Samples of a batch that a kernel cannot compute, where there is no native code: computed again, a few at a time.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples computes both branches for all of them. Here the marked
samples are gathered to small blocks first, and the branch is taken for as many blocks as there are.
"""

import math
from collections import defaultdict
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdyn.compile.jax_adapter import vary_alike

# Samples that are computed again together: they pay for the overhead of a loop of XLA, and the memory of their intermediates
# stays small.
SAMPLES_AT_ONCE = 32


def compute_where(flag, function: Callable, values, args: tuple):
    """function(*args) where the flag () is set, else `values`; in a batch a few of those samples at a time.

    The function depends on nothing traced but `args`. The result has no derivative.
    """
    return _one(function)(flag, values, args)


def _one(careful: Callable):
    # `custom_vmap` sees the batch before JAX makes a select of the branch.
    @custom_vmap
    def one(flag, values, args):
        return lax.cond(flag, lambda: _like(careful(*args), values), lambda: values)

    @one.def_vmap
    def _(size, batched, flag, values, args):
        leaves, structure = jax.tree.flatten(args)
        axes = [0 if varies else None for varies in jax.tree.leaves(batched[2])]
        flag, values = jax.tree.map(lambda x, varies: _rows(x, varies, size), (flag, values), tuple(batched[:2]))
        fixed = _many(lambda *leaves: careful(*jax.tree.unflatten(structure, leaves)), axes)(flag, values, leaves)
        return fixed, jax.tree.map(lambda _: True, fixed)

    def alike(*args):
        leaves, structure = jax.tree.flatten(args)
        return one(*jax.tree.unflatten(structure, vary_alike(leaves)))

    return alike


def _many(careful: Callable, axes: list):
    """The same for samples along the leading axis; `axes` says which of the arguments have it."""

    def some(flag, values, args):
        size = flag.shape[0]
        # `jax.export` has sizes without a number.
        count = min(SAMPLES_AT_ONCE, size) if isinstance(size, int) else SAMPLES_AT_ONCE
        # Flagged samples first, in their order, then places beyond the batch, which are read as the last sample and are not
        # written. A sort, as `jnp.nonzero` is compiled to thirty loops.
        total = jnp.sum(flag)
        order = jnp.argsort(jnp.logical_not(flag), stable=True)
        places = jnp.append(jnp.where(jnp.arange(size) < total, order, size), jnp.full(count, size, order.dtype))
        varying = [x for x, axis in zip(args, axes, strict=True) if axis is not None]
        rows = _pack(varying)

        def repair(i, packed):
            here = lax.dynamic_slice_in_dim(places, i * count, count)
            own = iter(_unpack([x.at[here].get(mode="clip") for x in rows], varying))
            taken = [x if axis is None else next(own) for x, axis in zip(args, axes, strict=True)]
            new = _pack(jax.tree.leaves(_like(jax.vmap(careful, axes)(*taken), values)))
            return [old.at[here].set(x, mode="drop") for old, x in zip(packed, new, strict=True)]

        leaves, structure = jax.tree.flatten(values)
        packed = lax.fori_loop(0, (total + count - 1) // count, repair, _pack(leaves))
        return jax.tree.unflatten(structure, _unpack(packed, leaves))

    @custom_vmap
    def many(flag, values, args):
        # A branch, as to look for places takes longer than the dynamics, and XLA takes out of a loop what does not change.
        return lax.cond(jnp.any(flag), some, lambda flag, values, args: values, flag, values, args)

    @many.def_vmap
    def _(size, batched, flag, values, args):
        flag, values = jax.tree.map(lambda x, varies: _rows(x, varies, size), (flag, values), tuple(batched[:2]))
        shape = flag.shape
        # Nested batches are one: places are counted through both, so that blocks are filled from all of them.
        flat, over = _along_one_axis(args, axes, batched[2], shape)
        flag, values = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (flag, values))
        values = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), _many(careful, over)(flag, values, flat))
        return values, jax.tree.map(lambda _: True, values)

    return many


def _pack(leaves: list) -> list:
    """The rows of arrays with one leading axis, side by side: an array for each dtype, so that one loop of XLA moves them."""
    groups: dict = {}
    for x in leaves:
        groups.setdefault(x.dtype, []).append(x.reshape(x.shape[0], math.prod(x.shape[1:])))
    return [jnp.concatenate(group, 1) for group in groups.values()]


def _unpack(packed: list, like: list) -> list:
    """The arrays in the shapes of others that were packed, but for the leading axis."""
    rows, ends = dict(zip(dict.fromkeys(x.dtype for x in like), packed, strict=True)), defaultdict(int)
    arrays = []
    for x in like:
        start, row = ends[x.dtype], rows[x.dtype]
        ends[x.dtype] += math.prod(x.shape[1:])
        arrays.append(row[:, start : ends[x.dtype]].reshape(row.shape[0], *x.shape[1:]))
    return arrays


def _like(new, values):
    """The same arrays with the dtypes of `values`, varying along the manual axes of meshes along which those do."""
    return jax.tree.map(lambda x, y: vary_alike([jnp.asarray(x, y.dtype), y])[0], new, values)


def _along_one_axis(args, axes, batched, shape):
    """Arguments of a batch of the given shape along one axis, and which of them have it; `axes`: which have the inner one."""
    flat, over = [], []
    for x, axis, varies in zip(args, axes, batched, strict=True):
        if axis == 0:
            x = _rows(x, varies, shape[0]).reshape(-1, *x.shape[1 + varies :])
        elif varies:
            x = jnp.repeat(x, shape[1], 0)
        flat.append(x)
        over.append(0 if axis == 0 or varies else None)
    return flat, over


def _rows(x, varies: bool, size):
    """With a leading axis of the batch, whose size may be a symbol of `jax.export`."""
    return x if varies else jnp.broadcast_to(x, (size, *x.shape))
