"""Samples of a batch that a kernel cannot compute: computed again, a few at a time, without touching the others.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples computes both branches for all of them. Here the marked
samples are gathered to small blocks first, and the branch is taken for as many blocks as there are.
"""

import functools
import math
from collections import defaultdict
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdyn.compile import ahead, mode
from jaxdyn.compile.batch import any_sample
from jaxdyn.compile.flags import mark_floats
from jaxdyn.compile.jax_adapter import vary_alike

# Samples that are computed again together: they pay for the overhead of a loop of XLA, and the memory of their intermediates
# stays small.
SAMPLES_AT_ONCE = 32


def rank_safe(function: Callable) -> Callable:
    """The function, traced for samples for which a kernel was not valid."""

    @functools.wraps(function)
    def call(*args):
        with mode.rank_safe(True):
            return function(*args)

    return call


def compute_where(flag, function: Callable, values, args: tuple):
    """function(*args), traced `rank_safe`, where the flag () is set, else `values`; in a batch a few of those samples at a time.

    The function depends on nothing traced but `args`. The result has no derivative.
    """
    return _one(rank_safe(function))(flag, values, args)


def repair(flag, careful: Callable, fast: Callable, values: tuple, args: tuple):
    """`values` where the flag () is not set, else `careful(*args)`; in a batch only the samples that need it, a few at a time.

    **Arguments:**

    - `careful(*args)` -> a pair of pytrees like `values`. The first one is differentiated. The function depends on nothing
      traced but `args`.
    - `fast(*args)` -> values[0], whose derivatives are right where the flag is not set.

    Derivatives are those of `fast` if the flag is set in no sample of the batch, else those of `careful` for all of them. They
    are a branch, not a select: the derivative of `fast` at a flagged sample is NaN, which reaches gradients even times zero.

    Inside of a kernel, which has no branches, floats of flagged samples are marked as not valid (see `flags`).
    """
    if mode.is_expanding():
        return mark_floats(flag, values)

    @jax.custom_jvp
    def run(flag, values, args):
        return _one(careful)(flag, values, args)

    @run.defjvp
    def _(primals, tangents):
        flag, _, args = primals
        _, (_, plain_step), args_step = tangents

        def by(function):
            return lambda: jax.jvp(function, args, args_step)[1]

        step = lax.cond(any_sample(flag), by(lambda *args: careful(*args)[0]), by(fast))
        return run(*primals), (step, plain_step)

    return run(flag, lax.stop_gradient(values), args)


def _one(careful: Callable):
    careful = _without_worker(careful)

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


def _without_worker(careful: Callable) -> Callable:
    """The function, whose kernels are compiled when they are called: hardly any sample needs them."""

    def call(*args):
        with ahead.worker(False):
            return careful(*args)

    return call


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
