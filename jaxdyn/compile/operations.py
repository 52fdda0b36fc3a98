"""Programs of numbers as operations of JAX: for devices without native kernels, and for derivatives without a program."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile.graph import inline
from jaxdyn.compile.program import COMPARISONS, Constant, Program, dtype_of
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
        elif op == "convert":
            values.append(lax.convert_element_type(values[operands[0]], dtype_of(kind)))
        else:
            # The kind of a comparison's result is bool: its constants have the kind of the other operand.
            kinds = [program.operations[x].kind for x in operands if type(x) is not Constant]
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
