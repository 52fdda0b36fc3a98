"""Sweeps over a tree, from the root to the leaves or back, as loops in native code (see `scan`) or of JAX."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, function_of, is_zero
from jaxdyn.compile.scan import is_chain
from jaxdyn.compile.scan_text import find_slots


def sweep(step: Callable, parents: Sequence[int], start, rows, *, inward: bool = False) -> tuple[Any, Any]:
    """Compute a quantity of each node of a tree from that of its parent, or from those of its children.

        outward    c_i, y_i = step(c_parent(i), x_i)               c_root = start
        inward     u_i, y_i = step(sum of u_j over children j, x_i)

    **Arguments:** `parents`: of each node, -1 for the root, in an order in which parents precede their children. `start`: pytree
    of the root's c; inward it is added to the sum of the last node (zeros, usually). `rows`: pytree of x (n, ...), floats alone.
    `step` reads arrays that it is given, and known ones.

    **Returns:** outward, c of the last node, and inward, the sum of the root; and y (n, ...).
    """
    if not mode.is_expanding():
        if is_chain(parents):
            return lax.scan(step, start, rows, reverse=inward)
        return _sweep_by_jax(step, parents, start, rows, inward)
    flat, structure = jax.tree.flatten((start, rows))
    count = len(jax.tree.leaves(start))
    one = jax.tree.unflatten(structure, [*flat[:count], *(x[0] for x in flat[count:])])
    call, out = jax.make_jaxpr(step, return_shape=True)(*one)
    end, results = out
    found = sweep_p.bind(*flat, call=call, parents=tuple(parents), carries=count, inward=inward)
    return jax.tree.unflatten(jax.tree.structure(end), found[:count]), jax.tree.unflatten(
        jax.tree.structure(results), found[count:]
    )


def _sweep_by_jax(step: Callable, parents: Sequence[int], start, rows, inward: bool) -> tuple[Any, Any]:
    """The same by a loop of JAX, with carries in tables."""
    count, slots = find_slots(parents)
    table = np.array(slots)
    own, parent = table[1:], table[np.array(parents) + 1]
    first, last = (slots[-1], slots[0]) if inward else (slots[0], slots[-1])
    memory = jax.tree.map(lambda x: jnp.zeros((count, *jnp.shape(x)), jnp.result_type(x)).at[first].set(x), start)

    def turn(memory, row):
        own, parent, x = row
        read, write = (own, parent) if inward else (parent, own)
        carry, result = step(jax.tree.map(lambda x: x[read], memory), x)
        if inward:
            return jax.tree.map(lambda x, y: x.at[own].set(0).at[write].add(y), memory, carry), result
        return jax.tree.map(lambda x, y: x.at[write].set(y), memory, carry), result

    memory, results = lax.scan(turn, memory, (jnp.asarray(own), jnp.asarray(parent), rows), reverse=inward)
    return jax.tree.map(lambda x: x[last], memory), results


def _types(*types, call, parents, carries, inward):
    outs = call.out_avals
    rows = [ShapedArray((len(parents), *x.shape), x.dtype) for x in outs[carries:]]
    return [*outs[:carries], *rows]


def _again(function: Callable, args, carries: int, parents, inward: bool) -> list:
    """The sweep of another step, of and to flat lists."""

    def step(carry, row):
        results = function(*carry, *row)
        return results[:carries], results[carries:]

    end, results = sweep(step, parents, list(args[:carries]), list(args[carries:]), inward=inward)
    return [*end, *results]


def _batch(args, axes, *, call, parents, carries, inward):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    # Of carries all have the axis, as those that start without it get it. Rows have it behind that of the nodes.
    full = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(args[:carries], axes, strict=False)
    ]
    places = [0] * carries
    for x, axis in zip(args[carries:], axes[carries:], strict=True):
        full.append(x if axis is None else jnp.moveaxis(x, axis, 1))
        places.append(None if axis is None else 0)
    results = _again(jax.vmap(function_of(call), places), full, carries, parents, inward)
    return results, [0] * carries + [1] * (len(results) - carries)


def _jvp(primals, tangents, *, call, parents, carries, inward):
    # Zeros are known ones, which the program drops.
    steps = [np.zeros(x.shape, x.dtype) if is_zero(d) else d for x, d in zip(primals, tangents, strict=True)]
    count = len(primals)

    def both(*leaves):
        carry, d_carry, row, d_row = _split(leaves, carries, count - carries)
        values, changes = jax.jvp(function_of(call), [*carry, *row], [*d_carry, *d_row])
        return _merge(values, changes, carries)

    given = [*primals[:carries], *steps[:carries], *primals[carries:], *steps[carries:]]
    results = _again(both, given, 2 * carries, parents, inward)
    ends, d_ends, rows, d_rows = _split(results, carries, (len(results) - 2 * carries) // 2)
    return [*ends, *rows], [*d_ends, *d_rows]


def _split(leaves, carries: int, rows: int) -> tuple:
    a, b = 2 * carries, 2 * carries + rows
    return leaves[:carries], leaves[carries:a], leaves[a:b], leaves[b:]


def _merge(values: list, changes: list, carries: int) -> list:
    return [*values[:carries], *changes[:carries], *values[carries:], *changes[carries:]]


# Bound while a program is traced, which has loops; elsewhere a sweep is a loop of JAX.
sweep_p = define_primitive("jaxdyn_sweep", _types, multiple_results=True, batch=_batch, jvp=_jvp)
