"""Control flow and maps for functions that users batch: one decision for a whole batch, and rows without a batch kernel.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples becomes a select, so that both branches are computed
for every sample. A predicate that has gone through `any_sample` is one number for all samples, however many `vmap`s enclose it:
the branch stays a branch, and a loop runs until the last sample has ended. What is right for the samples that did not ask
for the branch is the caller's affair.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdyn.compile import mode
from jaxdyn.compile.code import find_slots
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, eval_jaxpr, function_of, is_zero, vary_alike
from jaxdyn.compile.known import is_concrete
from jaxdyn.compile.mode import has_branches, in_rows, is_careful, is_expanding, is_standalone
from jaxdyn.compile.rules import is_float, mark_invalid
from jaxdyn.compile.scan import is_chain

T = TypeVar("T")
# Rows that are computed together. It bounds the memory for operands and results of kernels.
AT_ONCE = 16
# Repetitions up to which code without JAX has them written out.
MAX_WRITTEN_OUT = 16


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
    if is_expanding() and is_careful() and not has_branches():
        # The careful program of a function with derivatives has no branches, and is the last that could compute the sample.
        return jax.tree.map(lambda x, y: jnp.where(flag, x, y), if_true(*operands), if_false(*operands))
    return lax.cond(any_sample(flag), if_true, if_false, *operands)


def while_loop(goes_on: Callable[[T], object], body: Callable[[T], T], carry: T) -> T:
    """`lax.while_loop` that runs until `goes_on(carry)` holds for no sample of the batch.

    `body` leaves a sample unchanged that has ended before.
    """
    return lax.while_loop(lambda carry: any_sample(goes_on(carry)), body, carry)


def repeat_while(
    goes_on: Callable[[T], Any], step: Callable[[T], T], state: T, maximum: int, *, marks: bool = False
) -> T:
    """Repeat state = step(state) while goes_on(state), `maximum` times at most; few samples need more than a certain first time.

    The first repetition is certain where `goes_on(state)` is True itself. For others a native loop, and a kernel without a
    derivative, branches where a block of samples needs it; there many repetitions are a loop. Other kernels have no branches:
    samples that need a repetition are marked as not valid, and computed again outside of the kernel. In code without JAX many
    repetitions are a loop; a few are written out, or with `marks` such samples are left to its second program.
    """
    if not is_expanding() or (is_standalone() and maximum > MAX_WRITTEN_OUT):
        leaves, structure = jax.tree.flatten(state)
        return _loop(goes_on, step, jax.tree.unflatten(structure, vary_alike([*map(jnp.asarray, leaves)])), maximum)
    if goes_on(state) is True:
        state, maximum = step(state), maximum - 1
    if not has_branches() and (marks or not is_standalone()) and not is_careful():
        return _mark(goes_on(state), state)
    if has_branches() and maximum > MAX_WRITTEN_OUT:
        return _loop(goes_on, step, state, maximum)
    for _ in range(maximum):
        flag = goes_on(state)
        if has_branches():
            state = lax.cond(flag, step, lambda state: state, state)
        else:
            state = jax.tree.map(lambda new, old, flag=flag: jnp.where(flag, new, old), step(state), state)
    return state


def rarely(flag, change: Callable[[T], T], state: T) -> T:
    """change(state) where the flag () is set, which few samples are.

    A kernel marks them as not valid. The program that computes them again, and what runs without a kernel, have the branch.
    """
    if is_expanding() and not is_careful():
        return _mark(flag, state)
    changed = cond(flag, lambda: change(state), lambda: state)
    return jax.tree.map(lambda new, old: jnp.where(flag, new, old), changed, state)


def _mark(flag, state: T) -> T:
    return jax.tree.map(lambda x: mark_invalid(flag, x) if is_float(x) else x, state)


def _loop(goes_on: Callable[[T], Any], step: Callable[[T], T], state: T, maximum: int) -> T:
    def again(carry):
        count, state = carry
        return count + 1, step(state)

    return lax.while_loop(lambda carry: goes_on(carry[1]) & (carry[0] < maximum), again, (0, state))[1]


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


# --- sweeps over a tree, from the root to the leaves or back, as loops in native code (see `scan`) or of JAX ---


def sweep(
    step: Callable, parents: Sequence[int], start, rows, *, inward: bool = False, by_arrays: Callable | None = None
) -> tuple[Any, Any]:
    """Compute a quantity of each node of a tree from that of its parent, or from those of its children.

        outward    c_i, y_i = step(c_parent(i), x_i)               c_root = start
        inward     u_i, y_i = step(sum of u_j over children j, x_i)

    **Arguments:** `parents`: of each node, -1 for the root, in an order in which parents precede their children. `start`: pytree
    of the root's c; inward it is added to the sum of the last node (zeros, usually). `rows`: pytree of x (n, ...), floats alone.
    `by_arrays()`: the same by operations on all rows at once, which outside of native code are faster than a loop.

    **Returns:** outward, c of the last node, and inward, the sum of the root; and y (n, ...).
    """
    if not mode.is_expanding():
        if by_arrays is not None:
            return by_arrays()
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
