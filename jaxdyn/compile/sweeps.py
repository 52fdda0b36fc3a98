"""Sweeps over a tree, from the root to the leaves or back, as loops in native code (see `scan`) or of JAX."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, eval_jaxpr, function_of, is_zero
from jaxdyn.compile.known import is_concrete
from jaxdyn.compile.scan_parts import is_chain
from jaxdyn.compile.scan_text import find_slots


def sweep(step: Callable, parents: Sequence[int], start, rows, *, inward: bool = False) -> tuple[Any, Any]:
    """Compute a quantity of each node of a tree from that of its parent, or from those of its children.

        outward    c_i, y_i = step(c_parent(i), x_i)               c_root = start
        inward     u_i, y_i = step(sum of u_j over children j, x_i)

    **Arguments:** `parents`: of each node, -1 for the root, in an order in which parents precede their children. `start`: pytree
    of the root's c; inward it is added to the sum of the last node (zeros, usually). `rows`: pytree of x (n, ...), floats alone.

    **Returns:** outward, c of the last node, and inward, the sum of the root; and y (n, ...).
    """
    if not mode.is_expanding():
        if is_chain(parents):
            return lax.scan(step, start, rows, reverse=inward)
        return _sweep_by_jax(step, parents, start, rows, inward)
    flat, structure = jax.tree.flatten((start, rows))
    count = len(jax.tree.leaves(start))
    one = jax.tree.unflatten(structure, [*flat[:count], *(x[0] for x in flat[count:])])
    traced, (end, results) = jax.make_jaxpr(step, return_shape=True)(*one)
    # What the step reads of functions around it becomes an operand.
    outside = [x for x in traced.consts if not is_concrete(x)]

    def of_operands(*leaves):
        given = iter(leaves[: len(outside)])
        consts = [x if is_concrete(x) else next(given) for x in traced.consts]
        return eval_jaxpr(traced.jaxpr, consts, *leaves[len(outside) :])

    call = jax.make_jaxpr(of_operands)(*outside, *jax.tree.leaves(one)) if outside else traced
    counts = len(outside), count
    found = sweep_p.bind(*outside, *flat, call=call, parents=tuple(parents), counts=counts, inward=inward)
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


def _types(*types, call, parents, counts, inward):
    outs = call.out_avals
    rows = [ShapedArray((len(parents), *x.shape), x.dtype) for x in outs[counts[1] :]]
    return [*outs[: counts[1]], *rows]


def _again(function: Callable, start, rows, parents, inward: bool) -> list:
    """The sweep of another step, function(*carries, *row) -> carries and rows."""

    def step(carry, row):
        results = function(*carry, *row)
        return results[: len(start)], results[len(start) :]

    end, results = sweep(step, parents, list(start), list(rows), inward=inward)
    return [*end, *results]


def _split(values, counts: tuple[int, int]) -> tuple:
    return values[: counts[0]], values[counts[0] : sum(counts)], values[sum(counts) :]


def _batch(args, axes, *, call, parents, counts, inward):
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    (consts, start, rows), (of_consts, of_start, of_rows) = _split(args, counts), _split(axes, counts)
    # Of carries all have the axis, as those that start without it get it. Rows have it behind that of the nodes.
    start = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(start, of_start, strict=True)
    ]
    rows = [x if axis is None else jnp.moveaxis(x, axis, 1) for x, axis in zip(rows, of_rows, strict=True)]
    places = [*of_consts, *[0] * len(start), *(None if axis is None else 0 for axis in of_rows)]

    def step(*leaves):
        return jax.vmap(function_of(call), places)(*consts, *leaves)

    results = _again(step, start, rows, parents, inward)
    return results, [0] * len(start) + [1] * (len(results) - len(start))


def _jvp(primals, tangents, *, call, parents, counts, inward):
    # Zeros are known ones, which the program drops.
    steps = [np.zeros(x.shape, x.dtype) if is_zero(d) else d for x, d in zip(primals, tangents, strict=True)]
    (consts, start, rows), (d_consts, d_start, d_rows) = _split(primals, counts), _split(steps, counts)
    c, n = counts[1], len(rows)

    def both(*leaves):
        carry, d_carry, row, d_row = leaves[:c], leaves[c : 2 * c], leaves[2 * c : 2 * c + n], leaves[2 * c + n :]
        at, along = [*consts, *carry, *row], [*d_consts, *d_carry, *d_row]
        values, changes = jax.jvp(function_of(call), at, along)
        return [*values[:c], *changes[:c], *values[c:], *changes[c:]]

    results = _again(both, [*start, *d_start], [*rows, *d_rows], parents, inward)
    ends, d_ends, rest = results[:c], results[c : 2 * c], results[2 * c :]
    half = len(rest) // 2
    return [*ends, *rest[:half]], [*d_ends, *rest[half:]]


# Bound while a program is traced, which has loops; elsewhere a sweep is a loop of JAX.
sweep_p = define_primitive("jaxdyn_sweep", _types, multiple_results=True, batch=_batch, jvp=_jvp)
