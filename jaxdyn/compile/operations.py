"""Programs as operations of JAX, one for each number, on arrays over the batch: on devices without native code."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile.batch import cond, sweep
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.derive import inline
from jaxdyn.compile.llvm import COSINE, HALF_PI, MAX_ANGLE, SINE
from jaxdyn.compile.program import COMPARISONS, Constant, Program, dtype_of
from jaxdyn.compile.scan import Scan

# --- sines and cosines as polynomials, as in `llvm` ---
#
# XLA for GPUs computes the cosines of joints in kernels of their own, as it holds them too dear to be part of another one:
# nothing of that is left of a polynomial, and forward dynamics is one kernel and one that puts its columns together.


def sine(x):
    """sin x for floats of 32 or 64 bits."""
    r, quadrant = _reduce_angle(x)
    return _select_by_quadrant(x, *_pair(r), quadrant)


def cosine(x):
    """cos x for floats of 32 or 64 bits."""
    r, quadrant = _reduce_angle(x)
    return _select_by_quadrant(x, *_pair(r), quadrant + 1)


def _kind(x) -> str:
    return f"f{x.dtype.itemsize}"


def _reduce_angle(x):
    """x less whole quarters of a turn, within pi/4 of zero, and their number modulo 4 as an int32."""
    number = x.dtype.type
    quarters = lax.round(x * number(2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = functools.reduce(lambda r, part: r - quarters * number(part), HALF_PI[_kind(x)], x)
    quadrant = (quarters - number(4) * jnp.floor(quarters * number(0.25))).astype(jnp.int32)
    far_r, far_quadrant = _reduce_far_angle(x)
    is_far = jnp.abs(x) > number(MAX_ANGLE[_kind(x)])
    return jnp.where(is_far, far_r, r), jnp.where(is_far, far_quadrant, quadrant)


def _reduce_far_angle(x):
    """`_reduce_angle` for |x| beyond MAX_ANGLE, without branches.

    x is n 2^e with an integer n, so that its quarters are n c with c = 2^e 2/pi. Multiples of 4 do not count, so that a table
    has c modulo 4 for each e, in parts of so few bits that their products with each half of n are exact (Payne & Hanek 1983).
    """
    kind, number = _kind(x), x.dtype.type
    bits, half, first, table = _quarters_table(kind)
    mantissa, exponent = jnp.frexp(x)
    n, e = mantissa * number(2.0**bits), exponent - bits
    high = jnp.floor(n * number(2.0**-half))
    low = n - high * number(2.0**half)
    row = jnp.clip(e - first, 0, table.shape[0] - 1 - half)
    parts = [jnp.asarray(column) for column in table.T]
    total, quadrant, rest = number(0) * n, jnp.zeros(n.shape, jnp.int32), number(0) * n
    for factor, place in ((high, row + half), (low, row)):
        large, middle, small = (part[place] for part in parts)
        for product in (factor * large, factor * middle):
            whole = lax.round(product, lax.RoundingMethod.TO_NEAREST_EVEN)
            total = total + (product - whole)  # exact, and so is the sum
            quadrant = quadrant + (whole - number(4) * jnp.floor(whole * number(0.25))).astype(jnp.int32)
        rest = rest + factor * small
    whole = lax.round(total, lax.RoundingMethod.TO_NEAREST_EVEN)
    return ((total - whole) + rest) * number(np.pi / 2), quadrant + whole.astype(jnp.int32)


@functools.cache
def _quarters_table(kind: str):
    """Bits of a mantissa and of its lower half, the first exponent e, and rows (e, 3) of 2^e 2/pi modulo 4 in three parts."""
    bits, last = (53, 1024) if kind == "f8" else (24, 128)
    half, first = bits // 2, math.frexp(MAX_ANGLE[kind])[1] - bits - 1
    size = last + 3 * bits  # of 2/pi, in bits behind the point
    inverse = (2 << 2 * size) // pi_with_bits(size)
    rows = []
    for e in range(first, last - bits + half + 1):
        value = (inverse << max(e, 0)) >> max(-e, 0)
        value = (value + (2 << size)) % (4 << size) - (2 << size)  # between -2 and 2
        parts = []
        for grain in (half - 2, 2 * half - 2):  # rounded to so many bits behind the point
            unit = 1 << size - grain
            part = (value + unit // 2) // unit * unit
            parts.append(part)
            value -= part
        rows.append([math.ldexp(part >> max(size - 200, 0), -min(size, 200)) for part in (*parts, value)])
    return bits, half, first, np.asarray(rows, np.float64 if kind == "f8" else np.float32)


def pi_with_bits(bits: int) -> int:
    """Pi with so many bits behind the point, as an integer (Machin 1706)."""

    def arctangent_of_inverse(n):
        term = total = (1 << bits + 32) // n
        k, sign = 1, -1
        while term:
            term //= n * n
            k += 2
            total += sign * (term // k)
            sign = -sign
        return total

    return (16 * arctangent_of_inverse(5) - 4 * arctangent_of_inverse(239)) >> 32


def _pair(r):
    """sin r and cos r."""
    number, z = r.dtype.type, r * r

    def polynomial(coefficients):
        return functools.reduce(lambda value, c: value * z + number(c), coefficients[-2::-1], number(coefficients[-1]))

    rest = z * z * polynomial(COSINE[_kind(r)])
    return r + r * z * polynomial(SINE[_kind(r)]), rest + (number(1) - number(0.5) * z)


def _select_by_quadrant(x, sine, cosine, quadrant):
    value = jnp.where(quadrant & 1 == 0, sine, cosine)
    # What is not finite has no quadrant.
    return jnp.where(jnp.isfinite(x), jnp.where(quadrant & 2 == 0, value, -value), x - x)


# --- programs ---

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
            called = program.subprograms[operands[0].value]  # a loop
            arrays = as_operations(*_columns(called.inputs, operands[1:], values, lead), program=called)
            values.append([x for array in arrays for x in jnp.moveaxis(array, -1, 0)])
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

    def step(carry, row):
        carries, *made = scan.split_outputs(iteration(*consts, *carry, *row))
        return list(carries), made

    parents = range(-1, n - 1) if scan.parents is None else scan.parents
    end, (terms, results) = sweep(step, parents, start, [*given, *tables], inward=scan.inward)
    rows = [jnp.moveaxis(x, 0, -2).reshape(*lead, -1) for x in results]
    return [*end, *(jnp.sum(x, 0) for x in terms), *rows]


def _while(consts: list, start: list, iteration: Callable, condition: Callable) -> list:
    """A loop that ends with the last sample."""

    def step(carries):
        flag = condition(*consts, *carries)[0]
        return [jnp.where(flag, new, old) for new, old in zip(iteration(*consts, *carries), carries, strict=True)]

    return lax.while_loop(lambda carries: jnp.any(condition(*consts, *carries)[0]), step, start)
