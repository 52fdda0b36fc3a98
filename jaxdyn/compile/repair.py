"""What only some samples of a batch need: computed when one of them does, or for those alone.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples computes both branches. A predicate that has gone
through `any_in_batch` is one for all samples, however many `vmap`s enclose it, and the branch stays a branch. `repair_flagged`
computes samples that need it again and leaves the others alone.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdyn.compile import ahead, mode
from jaxdyn.compile.flags import unless
from jaxdyn.compile.jax_adapter import vary_alike
from jaxdyn.compile.kernel import run
from jaxdyn.compile.known import is_concrete, partition_traced

SAMPLES_AT_ONCE = 32  # samples that are computed again together


@custom_vmap
def _any_of_batch(flag):
    return flag


@_any_of_batch.def_vmap
def _(size, batched, flag):
    return _any_of_batch(jnp.any(flag)), False


def any_in_batch(flag):
    """Whether a flag () is set for this sample or for any other one of the batch."""
    return flag if is_concrete(flag) else _any_of_batch(flag)


def rank_safe(function: Callable) -> Callable:
    """The function, traced for samples that need care."""

    @functools.wraps(function)
    def call(*args):
        with mode.rank_safe():
            return function(*args)

    return call


def recompute_unless(served, again: Callable, values, args: tuple):
    """`values`, or again(*args), traced `rank_safe`, where a sample is not served; in a batch a few of those at a time.

    `served` is True where every sample is, and `again` is not in the program then; else an array (). `again` depends on nothing
    traced but `args`. Without derivatives.
    """
    return values if served is True else _one(rank_safe(again))(jnp.logical_not(served), values, args)


def repair_flagged(flag, careful: Callable, fast: Callable, values: tuple, args: tuple):
    """`values` where the flag () is not set, else `careful(*args)`; in a batch only the samples that need it, a few at a time.

    **Arguments:**

    - `careful(*args)` -> what `values` is: a pair of pytrees, of which the first is differentiated. It depends on nothing traced
      but `args`.
    - `fast(*args)` -> found[0], whose derivatives serve where the flag is not set.

    Derivatives are those of `fast` if the flag is set in no sample of the batch, else those of `careful` for all of them: in a
    branch, as what a singular sample makes of the other way is no number, and would reach gradients even times zero.

    While a function is traced to become a program of single numbers, which has no branches, floats of flagged samples are NaN,
    and the program knows it (`jaxdyn.compile.run(..., served=True)`).
    """
    if mode.is_expanding():
        return jax.tree.map(lambda x: unless(flag, x) if jnp.issubdtype(x.dtype, jnp.floating) else x, values)

    @jax.custom_jvp
    def run(flag, values, args):
        return _one(careful)(flag, values, args)

    @run.defjvp
    def _(primals, tangents):
        flag, _, args = primals
        _, (_, plain_step), args_step = tangents

        def by(function):
            return lambda: jax.jvp(function, args, args_step)[1]

        step = lax.cond(any_in_batch(flag), by(lambda *args: careful(*args)[0]), by(fast))
        return run(*primals), (step, plain_step)

    return run(flag, lax.stop_gradient(values), args)


def run_repaired(function: Callable, tree, *args, static: tuple = ()):
    """function(*static, tree, *args) by a kernel; samples that it cannot serve by the function itself, traced `rank_safe`.

    **Arguments:** as of `run`. Only floats that the function returns are differentiated.
    """
    values, served = run(function, tree, *args, static=static, served=True)
    if served is True:
        return values
    traced, known = partition_traced(tree)

    def careful(traced, args):
        return rank_safe(function)(*static, known(traced), *args), ()

    def fast(traced, args):
        return run(function, known(traced), *args, static=static, served=True)[0]

    # Derivatives keep what a computation needs for them whether it runs or not; this one hardly ever does.
    careful = jax.checkpoint(careful, prevent_cse=False)
    return repair_flagged(jnp.logical_not(served), careful, fast, (values, ()), (traced, args))[0]


def _one(careful: Callable):
    careful = _hardly_called(careful)

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


def _hardly_called(careful: Callable) -> Callable:
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
        places = jnp.nonzero(flag, size=size + count, fill_value=size)[0]

        def repair(i, values):
            here = lax.dynamic_slice_in_dim(places, i * count, count)
            taken = [x if axis is None else x.at[here].get(mode="clip") for x, axis in zip(args, axes, strict=True)]
            new = _like(jax.vmap(careful, axes)(*taken), values)
            return jax.tree.map(lambda old, new: old.at[here].set(new, mode="drop"), values, new)

        return lax.fori_loop(0, (jnp.sum(flag) + count - 1) // count, repair, values)

    @custom_vmap
    def many(flag, values, args):
        # A branch, as to look for places takes longer than the dynamics, and XLA takes out of a loop what does not change.
        return lax.cond(jnp.any(flag), some, lambda flag, values, args: values, flag, values, args)

    @many.def_vmap
    def _(size, batched, flag, values, args):
        flag, values = jax.tree.map(lambda x, varies: _rows(x, varies, size), (flag, values), tuple(batched[:2]))
        shape = flag.shape
        flat, over = _along_one_axis(args, axes, batched[2], shape)
        flag, values = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (flag, values))
        values = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), _many(careful, over)(flag, values, flat))
        return values, jax.tree.map(lambda _: True, values)

    return many


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
