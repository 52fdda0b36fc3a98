"""Programs as operations of JAX, one for each number, on arrays over the batch: on devices without native code."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile.batch import cond
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.inlining import inline
from jaxdyn.compile.program import COMPARISONS, Constant, Program, dtype_of
from jaxdyn.compile.scan import Scan
from jaxdyn.compile.scan_text import find_slots
from jaxdyn.compile.trigonometry import cosine, sine

_OPERATIONS: dict[str, Callable] = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg, "max": lax.max, "min": lax.min,
    "pow": lax.pow, "atan2": lax.atan2, "rem": lax.rem, "and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not,
    "is_finite": lax.is_finite, "select": lambda which, no, yes: lax.select(which, yes, no), "sqrt": lax.sqrt, "sin": sine,
    "cos": cosine, "tan": lax.tan, "asin": lax.asin, "acos": lax.acos, "atan": lax.atan, "sinh": lax.sinh, "cosh": lax.cosh,
    "tanh": lax.tanh, "exp": lax.exp, "exp2": lax.exp2, "expm1": lax.expm1, "log": lax.log, "log1p": lax.log1p, "abs": lax.abs,
    "floor": lax.floor, "ceil": lax.ceil, "sign": lax.sign, "cbrt": lax.cbrt, "stop_gradient": lax.stop_gradient,
    "round": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), "reduce_max": lambda *x: functools.reduce(lax.max, x),
    "reduce_min": lambda *x: functools.reduce(lax.min, x), "clamp": lambda low, x, high: lax.min(lax.max(x, low), high),
} | {name: getattr(lax, name) for name in COMPARISONS}  # fmt: skip


def as_operations(*args, program: Program, rows: int = 0):
    """Compute a program's results by operations of JAX, one for each number, on arrays over the batch."""
    if isinstance(program, Scan):
        return _scan(program, args, as_operations)
    if not isinstance(program, Program):  # a loop or a pseudo-inverse, which stand in the place of a program
        return program.as_operations(*args)
    lead = max((x.shape[:-1] for x in args), key=len, default=())
    program = inline(program)
    columns = [jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in args]
    values: list = []

    def constant(value, kind):
        return jnp.full(lead, value, dtype_of(kind))

    for op, kind, operands in program.operations:
        if op == "input":
            place, entry = operands
            values.append(columns[place][..., entry])
        elif op == "call_where":
            values.append(_call_careful(program, operands, values, lead))
        elif op == "call":
            values.append(_call_loop(program, operands, values, lead))
        elif op == "part":
            values.append(values[operands[0]][operands[1].value])
        elif op == "convert":
            values.append(lax.convert_element_type(values[operands[0]], dtype_of(kind)))
        else:
            # The kind of a comparison's result is bool: its constants have the kind of the other operand.
            kinds = [program.operations[x][1] for x in operands if type(x) is not Constant]
            constant_kind = kinds[-1] if op in COMPARISONS else kind
            operand_values = (constant(x.value, constant_kind) if type(x) is Constant else values[x] for x in operands)
            values.append(_OPERATIONS[op](*operand_values))
    results = []
    for row, array in zip(program.results, program.outputs, strict=True):
        entries = [jnp.full(lead, x.value, array.dtype) if type(x) is Constant else values[x] for x in row]
        # Without the barrier XLA fuses everything into the stack, and each of its entries becomes a branch in which all
        # operations that the entry needs are computed again: 17 to 100 times the arithmetic on a GPU.
        entries = lax.optimization_barrier(entries) if entries else entries
        results.append(jnp.stack(entries, -1) if entries else jnp.zeros((*lead, 0), array.dtype))
    return results


def _call_loop(program: Program, operands, values: list, lead: tuple) -> list:
    """Entries of the results of a loop."""
    called = program.subprograms[operands[0].value]
    arrays = _columns(called.inputs, operands[1:], values, lead)
    return [x for array in as_operations(*arrays, program=called) for x in jnp.moveaxis(array, -1, 0)]


def _columns(types: Sequence, operands, values: list, lead: tuple) -> list:
    entries, arrays = iter(operands), []
    for array in types:
        columns = (next(entries) for _ in range(array.size))
        columns = [jnp.full(lead, x.value, array.dtype) if type(x) is Constant else values[x] for x in columns]
        arrays.append(jnp.stack(columns, -1) if columns else jnp.zeros((*lead, 0), array.dtype))
    return arrays


def _call_careful(program: Program, operands, values: list, lead: tuple) -> list:
    """Entries of the results of a pair: those of the fast program, or where its flag is set those of the careful one.

    If the flag is set in no sample of the batch the careful program does not run.
    """
    careful, flag = program.subprograms[operands[0].value], operands[1]
    assert isinstance(careful, Careful)
    arrays = _columns((*careful.inputs, *careful.outputs), operands[2:], values, lead)
    count = len(careful.inputs)
    flag = jnp.full(lead, flag.value) if type(flag) is Constant else values[flag]

    def one(flag, otherwise, given):
        def again():
            return [jnp.where(flag, x, y) for x, y in zip(careful.by_jax(*given), otherwise, strict=True)]

        return cond(flag, again, lambda: list(otherwise))

    for _ in lead:
        one = jax.vmap(one)
    return [x for array in one(flag, arrays[count:], arrays[:count]) for x in jnp.moveaxis(array, -1, 0)]


def by_jax(*args, program, rows: int = 0):
    """Compute a program's results by JAX: by the function that was traced where that is there, else by its numbers.

    The function's arrays are a few hundred operations for XLA; the numbers, tens of thousands, take it minutes to compile.
    """
    return as_operations(*args, program=program) if program.fallback is None else over_batch(program.fallback, args)


def over_batch(one: Callable, arrays) -> Any:
    """one(*arrays) of one sample, for arrays with the axes of a batch or without them."""
    axes = [0 if x.ndim > 1 else None for x in arrays]
    for _ in max((x.shape[:-1] for x in arrays), key=len, default=()):
        one = jax.vmap(one, axes)
    return one(*arrays)


# --- loops ---


def _scan(scan: Any, arrays: Sequence, compute: Callable) -> list:
    """Flat outputs of a scan of flat inputs (..., size); `compute(*arrays, program=)` computes a program."""
    iteration = functools.partial(compute, program=scan.body)
    lead = max((x.shape[:-1] for x in arrays), key=len)
    counts, n = scan.counts, scan.length
    full = [jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in arrays]
    consts, start = full[: counts.consts], full[counts.consts : counts.consts + counts.carries]
    if scan.condition is not None:
        return _while(consts, start, iteration, functools.partial(compute, program=scan.condition))
    given = [jnp.moveaxis(x.reshape(*lead, n, -1), -2, 0) for x in full[counts.consts + counts.carries :]]
    tables = [
        jnp.broadcast_to(jnp.asarray(x).reshape(n, *[1] * len(lead), -1), (n, *lead, x[0].size)) for x in scan.tables
    ]
    count, slots = find_slots(range(-1, n - 1) if scan.parents is None else scan.parents)
    parents = [slots[i] for i in range(n)] if scan.parents is None else [slots[x + 1] for x in scan.parents]
    first, last = (slots[-1], slots[0]) if scan.inward else (slots[0], slots[-1])
    memory = [jnp.zeros((count, *x.shape), x.dtype).at[first].set(x) for x in start]
    sums = [jnp.zeros((*lead, x.size), x.dtype) for x in scan.split_outputs(scan.body.outputs)[1]]

    def step(carry, row):
        memory, sums = carry
        own, parent, rows, known = row
        read, write = (own, parent) if scan.inward else (parent, own)
        made = iteration(*consts, *(x[read] for x in memory), *rows, *known)
        carries, terms, results = scan.split_outputs(made)
        if scan.inward:
            memory = [x.at[own].set(0).at[write].add(y) for x, y in zip(memory, carries, strict=True)]
        else:
            memory = [x.at[write].set(y) for x, y in zip(memory, carries, strict=True)]
        return (memory, [x + y for x, y in zip(sums, terms, strict=True)]), results

    each = jnp.asarray(slots[1:]), jnp.asarray(parents), given, tables
    (memory, sums), results = lax.scan(step, (memory, sums), each, reverse=scan.inward)
    rows = [jnp.moveaxis(x, 0, -2).reshape(*lead, -1) for x in results]
    return [*(x[last] for x in memory), *sums, *rows]


def _while(consts: list, start: list, iteration: Callable, condition: Callable) -> list:
    """A loop that ends with the last sample."""

    def step(carries):
        flag = condition(*consts, *carries)[0]
        return [jnp.where(flag, new, old) for new, old in zip(iteration(*consts, *carries), carries, strict=True)]

    return lax.while_loop(lambda carries: jnp.any(condition(*consts, *carries)[0]), step, start)
