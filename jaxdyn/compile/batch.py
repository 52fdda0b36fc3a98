"""Control flow and maps for functions that users batch: one decision for a whole batch, and rows without a batch kernel.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples becomes a select, so that both branches are computed
for every sample. A predicate that has gone through `any_sample` is one number for all samples, however many `vmap`s enclose it:
the branch stays a branch, and a loop runs until the last sample has ended. What is right for the samples that did not ask
for the branch is the caller's affair.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdyn.compile.flags import mark_floats
from jaxdyn.compile.jax_adapter import vary_alike
from jaxdyn.compile.known import is_concrete
from jaxdyn.compile.mode import has_branches, in_rows, is_careful, is_expanding, is_standalone

T = TypeVar("T")
# Rows that are computed together. It bounds the memory for operands and results of kernels.
AT_ONCE = 16
# Repetitions up to which code without JAX has them written out.
MOST_WRITTEN_OUT = 16


@custom_vmap
def _any_of_batch(flag):
    return flag


@_any_of_batch.def_vmap
def _(size, batched, flag):
    # The result has no batch axis. The next `vmap` outside calls this rule again.
    return _any_of_batch(jnp.any(flag)), False


def any_sample(flag) -> Any:
    """Reduce a flag () to one number for the batch: True where it is set for this sample or for any other one."""
    # A program is that of one sample.
    return flag if is_concrete(flag) or (is_expanding() and is_careful()) else _any_of_batch(flag)


def cond(flag, if_true: Callable, if_false: Callable, *operands) -> Any:
    """`lax.cond`, where the flag () is set for any sample of the batch."""
    return lax.cond(any_sample(flag), if_true, if_false, *operands)


def while_loop(goes_on: Callable[[T], object], body: Callable[[T], T], carry: T) -> T:
    """`lax.while_loop` that runs until `goes_on(carry)` holds for no sample of the batch.

    `body` leaves a sample unchanged that has ended before.
    """
    return lax.while_loop(lambda carry: any_sample(goes_on(carry)), body, carry)


def repeat_while(goes_on: Callable[[T], Any], step: Callable[[T], T], state: T, most: int, *, marks: bool = False) -> T:
    """Repeat state = step(state) while goes_on(state), `most` times at most; few samples need more than a certain first time.

    The first repetition is certain where `goes_on(state)` is True itself. For others a native loop, and a kernel without a
    derivative, branches where a block of samples needs it; there many repetitions are a loop. Other kernels have no branches:
    samples that need a repetition are marked as not valid, and computed again outside of the kernel. In code without JAX many
    repetitions are a loop; a few are written out, or with `marks` such samples are left to its second program.
    """
    if not is_expanding() or (is_standalone() and most > MOST_WRITTEN_OUT):
        leaves, structure = jax.tree.flatten(state)
        return _loop(goes_on, step, jax.tree.unflatten(structure, vary_alike([*map(jnp.asarray, leaves)])), most)
    if goes_on(state) is True:
        state, most = step(state), most - 1
    if not has_branches() and (marks or not is_standalone()) and not is_careful():
        return mark_floats(goes_on(state), state)
    if has_branches() and most > MOST_WRITTEN_OUT:
        return _loop(goes_on, step, state, most)
    for _ in range(most):
        flag = goes_on(state)
        if has_branches():
            state = lax.cond(flag, step, lambda state: state, state)
        else:
            state = jax.tree.map(lambda new, old, flag=flag: jnp.where(flag, new, old), step(state), state)
    return state


def _loop(goes_on: Callable[[T], Any], step: Callable[[T], T], state: T, most: int) -> T:
    def again(carry):
        count, state = carry
        return count + 1, step(state)

    return lax.while_loop(lambda carry: goes_on(carry[1]) & (carry[0] < most), again, (0, state))[1]


def each_row(function: Callable, *rows):
    """function(*row) for the rows (n, ...) of arrays: a loop inside of kernels, whose code is that of one row."""
    return lax.map(lambda row: function(*row), rows) if is_expanding() else jax.vmap(function)(*rows)


def map_rows(function: Callable, rows):
    """function(row) for the rows (n, ...) of a pytree of one sample, n at least 1, such as the states at save points.

    `lax.map` would go through everything that XLA puts around a kernel once a row, which takes longer than the kernel itself, and
    `jax.vmap` would ask for a batch kernel, which would have to be compiled. Here rows go through the kernel of one sample,
    `AT_ONCE` in one call.
    """

    @jax.jit  # which traces it before any transformation around this call adds an axis
    def at_once(rows):
        with in_rows(True):
            return jax.vmap(function)(rows)

    count = jax.tree.leaves(rows)[0].shape[0]
    if not isinstance(count, int):  # `jax.export` has sizes without a number
        return lax.map(function, rows)
    blocks = -(-count // AT_ONCE)
    if blocks == 1:
        return at_once(rows)
    size = -(-count // blocks)  # blocks of equal size: of 17 rows two of 9, not 16 and 1

    def into_blocks(x):
        last = jnp.broadcast_to(x[-1:], (blocks * size - count, *x.shape[1:]))
        return jnp.concatenate([x, last]).reshape(blocks, size, *x.shape[1:])

    block = jax.tree.map(lambda x: jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype), rows)
    if not at_once.trace(block).jaxpr.eqns:  # nothing is computed: blocks would be copied only
        return at_once(rows)
    mapped = lax.map(at_once, jax.tree.map(into_blocks, rows))
    return jax.tree.map(lambda x: x.reshape(blocks * size, *x.shape[2:])[:count], mapped)
