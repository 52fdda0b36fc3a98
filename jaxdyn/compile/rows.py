"""Rows of one sample, such as the states at the save points of a motion: computed in one call of the kernel of one sample.

`lax.map` goes from row to row through everything that XLA puts around a kernel, which takes longer than the kernel itself;
`jax.vmap` alone would ask for a second kernel, over the lanes of a batch, which would have to be compiled.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile.mode import in_rows

AT_ONCE = 16  # rows, which bounds the memory for what kernels are given and give


def map_rows(function: Callable, rows):
    """function(row) for the rows (n, ...) of a pytree, n at least 1; as `lax.map`, in blocks that are computed at once."""

    @jax.jit  # which traces it before any transformation around this call adds an axis
    def at_once(rows):
        with in_rows():
            return jax.vmap(function)(rows)

    count = jax.tree.leaves(rows)[0].shape[0]
    if not isinstance(count, int):  # `jax.export` has sizes without a number
        return lax.map(function, rows)
    blocks = -(-count // AT_ONCE)
    if blocks == 1:
        return at_once(rows)
    size = -(-count // blocks)

    def divided(x):
        last = jnp.broadcast_to(x[-1:], (blocks * size - count, *x.shape[1:]))
        return jnp.concatenate([x, last]).reshape(blocks, size, *x.shape[1:])

    block = jax.tree.map(lambda x: jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype), rows)
    if not at_once.trace(block).jaxpr.eqns:  # nothing is computed: blocks would be copied only
        return at_once(rows)
    mapped = lax.map(at_once, jax.tree.map(divided, rows))
    return jax.tree.map(lambda x: x.reshape(blocks * size, *x.shape[2:])[:count], mapped)
