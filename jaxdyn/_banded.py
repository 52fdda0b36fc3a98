"""Symmetric band matrices in programs of single numbers: L D L^T without exchanges of rows, and solutions with it.

Written out, rows that follow one another would be one long sequence of operations. Here they are two operations on all numbers of
a matrix, which `in_vectors` makes loops over the rows, a few of them at a time. A matrix with m rows and b entries to the left of
the diagonal is m (b + 1) numbers: of each row b entries and the diagonal, zero where there are none; its factor has the
entries of L and the pivots in the same places.
"""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive

from jaxdyn._fold import fold
from jaxdyn._marked_call import in_call

_AT_A_TIME = 2  # rows of one sample: XLA's runtime sets up buffers for what is written (see `_one_kernel`)
_IN_BATCHES = 8

banded_factor_p = Primitive("banded_factor")
banded_solution_p = Primitive("banded_solution")


def banded_factor(rows: list[list]) -> list[list]:
    """Rows of the factor from those of a matrix, each b + 1 numbers."""
    width = len(rows[0])
    return _rows(banded_factor_p.bind(*(x for row in rows for x in row), width=width), width)


def banded_solution(factor: list[list], right: list) -> list:
    """x with L D L^T x = right, from the rows of a factor."""
    return banded_solution_p.bind(*(x for row in factor for x in row), *right, width=len(factor[0]))


def _as_numbers(count: int, avals) -> list[ShapedArray]:
    return [ShapedArray((), np.result_type(*(x.dtype for x in avals)))] * count


for _primitive in (banded_factor_p, banded_solution_p):
    _primitive.multiple_results = True
banded_factor_p.def_abstract_eval(lambda *avals, width: _as_numbers(len(avals), avals))
banded_solution_p.def_abstract_eval(lambda *avals, width: _as_numbers(len(avals) // (width + 1), avals))


def in_vectors(primitive: Primitive, numbers, width: int):
    """What a primitive gives for its numbers (n, ...), as an array (n, ...); for one sample in a call (see `_marked_call`)."""
    function = functools.partial(_on_rows, primitive, width=width)
    return function(numbers) if numbers.ndim > 1 else in_call(jax.make_jaxpr(function)(numbers))(numbers)[0]


def _on_rows(primitive: Primitive, numbers, width: int):
    lead = numbers.shape[1:]
    if primitive is banded_factor_p:
        return _factor(numbers.reshape(-1, width, *lead)).reshape(numbers.shape)
    rows = numbers.shape[0] // (width + 1)
    return _solution(numbers[: rows * width].reshape(rows, width, *lead), numbers[rows * width :])


def _factor(rows):
    """Rows of the factor (m, b + 1, ...)."""
    start = jnp.zeros((rows.shape[1] - 1, *rows.shape[1:]), rows.dtype).at[:, -1].set(1)
    return _over_rows(_factor_rows, start, rows, pad=jnp.zeros_like(rows[:1]).at[:, -1].set(1))


def _factor_rows(before: list[list], new: list[list]) -> list[list]:
    known, inverses = [*before], [_inverse(row[-1]) for row in before]
    for row in new:
        *entries, pivot = row
        back, scaled, lower = len(entries), [], []
        for j, entry in enumerate(entries):
            # The row of this column. Its entry for the column m of this row is j - m to the left of its diagonal.
            at = len(known) - back + j
            for m in range(j):
                entry = lax.sub(entry, lax.mul(known[at][back - j + m], scaled[m]))
            scaled.append(entry)
            lower.append(lax.mul(entry, inverses[at]))
        for x, y in zip(lower, scaled, strict=True):
            pivot = lax.sub(pivot, lax.mul(x, y))
        known.append([*lower, pivot])
        inverses.append(_inverse(pivot))
    return known[len(before) :]


def _inverse(x):
    return lax.div(np.ones((), x.dtype), x)


def _solution(factor, right):
    """x (m, ...)."""
    count, width = factor.shape[:2]
    found = _substituted(factor[:, :-1][:, ::-1], right) / factor[:, -1]
    wider = jnp.concatenate([factor, jnp.zeros((width - 1, *factor.shape[1:]), factor.dtype)])
    # Of column k the entries L[k + j, k].
    columns = [wider[j : j + count, width - 1 - j] for j in range(1, width)]
    return _substituted(jnp.stack(columns, 1)[::-1], found[::-1])[::-1] if columns else found


def _substituted(lower, right):
    """x with x_k = right_k - sum over j of lower[k, j] x_(k - 1 - j); lower (m, b, ...)."""
    rows = jnp.concatenate([lower, right[:, None]], 1)
    start = jnp.zeros((lower.shape[1], 1, *lower.shape[2:]), lower.dtype)
    return _over_rows(_substitute_rows, start, rows, pad=jnp.zeros_like(rows[:1]))[:, 0]


def _substitute_rows(before: list[list], new: list[list]) -> list[list]:
    known = [x for (x,) in before]
    for *coefficients, x in new:
        for j, coefficient in enumerate(coefficients):
            x = lax.sub(x, lax.mul(coefficient, known[-1 - j]))
        known.append(x)
    return [[x] for x in known[len(before) :]]


def _over_rows(step: Callable, start, rows, pad):
    """Rows that step(rows before, new rows) finds for `rows` (m, n, ...), a few in each turn of a loop; `start` comes before."""
    count, width, *lead = rows.shape
    some = _IN_BATCHES if lead else _AT_A_TIME
    turns = -(-count // some)
    missing = turns * some - count
    if missing:
        rows = jnp.concatenate([rows, jnp.broadcast_to(pad, (missing, *pad.shape[1:]))])
    program = _written(step, start.shape[:2], (some, width), rows.dtype)

    def turn(before, new):
        values = dict(zip(program.invars, (*before, *new), strict=True))
        sound, found = fold(program.eqns, program.invars, program.outvars, values, tuple(lead))
        found = jnp.where(sound, jnp.stack([found[x] for x in program.outvars]), np.asarray(np.nan, rows.dtype))
        return jnp.concatenate([before, found])[len(found) :], found

    new = rows.reshape(turns, some * width, *lead)
    _, found = lax.scan(turn, start.reshape(-1, *lead), new)
    return found.reshape(turns * some, -1, *lead)[:count]


@functools.lru_cache
def _written(step: Callable, before: tuple[int, int], new: tuple[int, int], dtype):
    first = math.prod(before)

    def flat(*numbers):
        rows = step(_rows(numbers[:first], before[1]), _rows(numbers[first:], new[1]))
        return [x for row in rows for x in row]

    return jax.make_jaxpr(flat)(*[jax.ShapeDtypeStruct((), dtype)] * (first + math.prod(new))).jaxpr


def _rows(numbers, width: int) -> list[list]:
    return [list(numbers[i : i + width]) for i in range(0, len(numbers), width)]
