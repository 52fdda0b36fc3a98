"""What only some samples of a batch need: computed when one of them does, or for those alone.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples computes both branches. A predicate that has gone
through `anywhere` is one for all samples, however many `vmap`s enclose it, and the branch stays a branch. `mended` computes
samples that need it again and leaves the others alone. `flattened` makes one batch of several that are nested.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.custom_batching import custom_vmap
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from jaxdyn._materialize import at_least
from jaxdyn._scalar_program import is_written_out
from jaxdyn._ways import is_straight

AT_ONCE = 32  # samples that are computed again together

_anywhere_p = Primitive("anywhere")
_anywhere_p.def_impl(lambda flag: flag)
_anywhere_p.def_abstract_eval(lambda flag: ShapedArray((), flag.dtype))
mlir.register_lowering(_anywhere_p, lambda ctx, flag: [flag])


def _over_samples(arrays, axes):
    return _anywhere_p.bind(jnp.any(arrays[0], axis=axes[0])), batching.not_mapped


batching.primitive_batchers[_anywhere_p] = _over_samples


def anywhere(flag):
    """Whether a flag () is set for this sample or for any other one of the batch."""
    return _anywhere_p.bind(flag) if isinstance(flag, jax.core.Tracer) else flag


def redone(flag, again: Callable, found):
    """`found`, or again() where a flag () is set in any sample of the batch; without derivatives.

    A loop of at most one turn: a branch that gives `found` would copy it. As vectors, because XLA would copy matrices into the
    order of axes in which `again` finds them.
    """

    def flat(arrays):
        return jax.tree.map(lambda x: x.reshape(-1), arrays)

    start = anywhere(flag), flat(found)
    flattened = lax.while_loop(lambda state: state[0], lambda _: (jnp.asarray(False), flat(again())), start)[1]
    return jax.tree.map(lambda x, y: x.reshape(y.shape), flattened, found)


def mended(flag, careful: Callable, found: tuple, args: tuple, same: Callable | None = None, dense: Any = False):
    """`found` where the flag () is not set, else `careful(*args)`; in a batch only the samples that need it, a few at a time.

    **Arguments:**

    - `careful(*args)` -> what `found` is: a pair of pytrees, of which the first is differentiated. It depends on nothing traced
      but `args`.
    - `same(found[0], *args)` -> found[0], to be differentiated by the args; None for the derivatives of `careful`.
    - `dense` (), for all samples alike: whether derivatives are those of `careful` anyway.

    Derivatives are those of `same` if the flag is set in no sample of the batch, else those of `careful` for all of them: in a
    branch, as what a singular sample makes of the other way is no number, and would reach gradients even times zero.

    While a function is traced to become one of single numbers, which have no branches, or one that goes `straight` (see `_ways`),
    floats of samples with the flag are NaN.
    """
    if is_written_out() or is_straight():
        return jax.tree.map(
            lambda x: jnp.where(flag, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.floating) else x, found
        )

    @jax.custom_jvp
    def run(flag, dense, found, args):
        return _one(careful)(flag, found, args)

    @run.defjvp
    def _(primals, tangents):
        flag, dense, (smooth, _), args = primals
        _, _, (_, plain_step), args_step = tangents

        def by(function):
            return lambda: jax.jvp(function, args, args_step)[1]

        by_careful = by(lambda *args: careful(*args)[0])
        if same is None:
            step = by_careful()
        else:
            step = lax.cond(anywhere(flag) | dense, by_careful, by(partial(same, smooth)))
        return run(*primals), (step, plain_step)

    return run(flag, jnp.asarray(dense), lax.stop_gradient(found), args)


def _one(careful: Callable):
    @custom_vmap
    def one(flag, found, args):
        return lax.cond(flag, lambda: careful(*args), lambda: found)

    @one.def_vmap
    def _(size, batched, flag, found, args):
        leaves, structure = jax.tree.flatten(args)
        axes = [0 if varies else None for varies in jax.tree.leaves(batched[2])]
        flag, found = jax.tree.map(lambda x, varies: _rows(x, varies, size), (flag, found), tuple(batched[:2]))
        fixed = _many(lambda *leaves: careful(*jax.tree.unflatten(structure, leaves)), axes)(flag, found, leaves)
        return fixed, jax.tree.map(lambda _: True, fixed)

    return one


def _many(careful: Callable, axes: list):
    """The same for samples along the leading axis; `axes` says which of the arguments have it."""

    def some(flag, found, args):
        size = flag.shape[0]
        count = min(AT_ONCE, size)
        places = jnp.nonzero(flag, size=size + count, fill_value=size)[0]

        def mend(i, found):
            here = lax.dynamic_slice_in_dim(places, i * count, count)
            taken = [x if axis is None else x.at[here].get(mode="clip") for x, axis in zip(args, axes, strict=True)]
            # Values of a few samples are kept from being computed again; those of one are in a branch that is not taken.
            with at_least(count):
                new = jax.vmap(careful, axes)(*taken)
            return jax.tree.map(lambda old, new: old.at[here].set(new, mode="drop"), found, new)

        return lax.fori_loop(0, (jnp.sum(flag) + count - 1) // count, mend, found)

    @custom_vmap
    def many(flag, found, args):
        # A branch, as to look for places takes longer than the dynamics, and XLA takes out of a loop what does not change.
        return lax.cond(jnp.any(flag), some, lambda flag, found, args: found, flag, found, args)

    @many.def_vmap
    def _(size, batched, flag, found, args):
        flag, found = jax.tree.map(lambda x, varies: _rows(x, varies, size), (flag, found), tuple(batched[:2]))
        shape = flag.shape
        flat, over = _along_one_axis(args, axes, batched[2], shape)
        flag, found = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (flag, found))
        found = jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), _many(careful, over)(flag, found, flat))
        return found, jax.tree.map(lambda _: True, found)

    return many


def flattened(function: Callable):
    """The same function of pytrees, computed for the samples of all `vmap`s that enclose it along one axis.

    Numbers become vectors over the batch. Those of two nested `vmap`s become matrices, whose rows are loops of their own.
    Arguments are all that it depends on. It has no derivative: put it under one that is given.
    """

    @custom_vmap
    def one(*args):
        return function(*args)

    @one.def_vmap
    def _(size, batched, *args):
        leaves, structure = jax.tree.flatten(args)
        axes = [0 if varies else None for varies in jax.tree.leaves(batched)]
        found = _flat(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), axes, size)(leaves)
        return found, jax.tree.map(lambda _: True, found)

    return one


def _flat(function: Callable, axes: list, rows: int):
    @custom_vmap
    def many(args):
        return jax.vmap(function, axes)(*args)

    @many.def_vmap
    def _(size, batched, args):
        flat, over = _along_one_axis(args, axes, batched[0], (size, rows))
        found = _flat(function, over, size * rows)(flat)
        found = jax.tree.map(lambda x: x.reshape(size, rows, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return many


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


def _rows(x, varies: bool, size: int):
    """With a leading axis of the batch."""
    return x if varies else jnp.broadcast_to(x, (size, *x.shape))
