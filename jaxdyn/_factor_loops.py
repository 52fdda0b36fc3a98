"""Factors of small dense matrices, and solutions with them, as loops over rows and columns.

For programs that may call no library (see `_one_call`). Each takes one matrix and gives what jax's primitive of that name gives,
in LAPACK's conventions, in O(n^3) operations on whole matrices: meant for tens of rows, not for thousands.
"""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def entry(x: Array, i: Any) -> Array:
    """x[i] for an i that is not negative, in the fewest operations."""
    if isinstance(i, int):
        return lax.index_in_dim(x, i, 0, False)
    start = (i, *[jnp.zeros((), i.dtype)] * (x.ndim - 1))
    return lax.dynamic_slice(x, start, (1, *x.shape[1:]), allow_negative_indices=False).reshape(x.shape[1:])


def _swapped(x: Array, i, j) -> Array:
    """x with the entries, or rows, i and j exchanged."""
    places = lax.broadcasted_iota(jnp.int32, x.shape, 0)
    return jnp.where(places == i, entry(x, j), jnp.where(places == j, entry(x, i), x))


def cholesky(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """L with L L^T = a, from the lower triangle of a; NaN where a is not positive definite."""
    rows = jnp.arange(a.shape[0], dtype=jnp.int32)

    def eliminate(j, state):
        rest, found = state  # L^T
        # By rows: of what is left, the lower triangle is that of a symmetric matrix.
        column = jnp.where(rows >= j, entry(rest, j), 0)
        column = column / jnp.sqrt(entry(column, j))
        return rest - column[:, None] * column[None], jnp.where((rows == j)[:, None], column[None], found)

    lower = jnp.tril(a)
    symmetric = lower + jnp.tril(a, -1).T
    found = lax.fori_loop(0, a.shape[0], eliminate, (symmetric, jnp.zeros_like(a)))[1]
    return jnp.where(jnp.all(jnp.diagonal(found) > 0), found.T, jnp.nan)


def triangular_solve(
    a: Float[Array, "n n"],
    b: Float[Array, "..."],
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
) -> Float[Array, "..."]:
    """x with op(a) x = b (b (n, m)), or with x op(a) = b (b (m, n)) unless `left_side`; op is the identity or the transpose."""
    if not left_side:
        how = {"left_side": True, "lower": lower, "transpose_a": not transpose_a, "unit_diagonal": unit_diagonal}
        return triangular_solve(a, b.T, **how).T
    n = a.shape[0]
    columns = a if transpose_a else a.T
    forwards = lower != transpose_a
    rows = jnp.arange(n, dtype=jnp.int32)

    def substitute(step, x):
        j = step if forwards else n - 1 - step
        row, column = entry(x, j), entry(columns, j)
        if not unit_diagonal:
            row = row / entry(column, j)
        left = rows > j if forwards else rows < j
        x = x - jnp.where(left, column, 0)[:, None] * row[None]
        return jnp.where((rows == j)[:, None], row[None], x)

    return lax.fori_loop(0, n, substitute, b)


def lu(a: Float[Array, "m n"]) -> tuple[Float[Array, "m n"], Int[Array, " k"], Int[Array, " m"]]:
    """L and U in one matrix, the row that each step took up, and the order of rows that makes: a[order] = L U."""
    m, n = a.shape
    rows, columns, k = jnp.arange(m, dtype=jnp.int32), jnp.arange(n, dtype=jnp.int32), min(m, n)

    def eliminate(j, state):
        a, pivots, order = state
        p = jnp.argmax(jnp.where(rows >= j, jnp.abs(entry(a.T, j)), -1)).astype(jnp.int32)
        a, order = _swapped(a, j, p), _swapped(order, j, p)
        column, row = entry(a.T, j), entry(a, j)
        pivot = entry(row, j)
        factors = jnp.where(rows > j, column / jnp.where(pivot == 0, 1, pivot), 0)
        a = a - factors[:, None] * jnp.where(columns > j, row, 0)[None]
        a = jnp.where((columns == j)[None] & (rows > j)[:, None], factors[:, None], a)
        return a, jnp.where(rows[:k] == j, p, pivots), order

    start = a, jnp.zeros(k, jnp.int32), rows
    return lax.fori_loop(0, k, eliminate, start)


def order_of(pivots: Int[Array, " k"], size: int) -> Int[Array, " m"]:
    """The order of rows that the exchanges (i, pivots[i]) make one after the other."""
    start = jnp.arange(size, dtype=jnp.int32)
    return lax.fori_loop(0, pivots.shape[0], lambda i, order: _swapped(order, i, entry(pivots, i)), start)


def qr(a: Float[Array, "m n"], *, full_matrices: bool, pivoting: bool):
    """Q, R, and with `pivoting` the order with a[:, order] = Q R, diagonal entries of R falling in size; by reflections."""
    m, n = a.shape
    rows, columns, k = jnp.arange(m, dtype=jnp.int32), jnp.arange(n, dtype=jnp.int32), min(m, n)

    def reflect(j, state):
        Q, R, order = state  # Q^T and R^T
        if pivoting:
            sizes = jnp.sum(jnp.where((rows >= j)[None], R * R, 0), 1)
            p = jnp.argmax(jnp.where(columns >= j, sizes, -1)).astype(jnp.int32)
            R, order = _swapped(R, j, p), _swapped(order, j, p)
        column = jnp.where(rows >= j, entry(R, j), 0)
        first, largest = entry(column, j), jnp.max(jnp.abs(column))
        length = largest * jnp.sqrt(jnp.sum((column / jnp.where(largest == 0, 1, largest)) ** 2))
        axis = column - jnp.where(rows == j, jnp.where(first < 0, length, -length), 0)
        size = jnp.max(jnp.abs(axis))
        axis = axis / jnp.where(size == 0, 1, size)
        # Nothing is reflected where nothing is below the diagonal.
        turns = jnp.max(jnp.where(rows == j, 0, jnp.abs(column))) > 0
        weighted = jnp.where(turns, 2 / jnp.where(turns, jnp.sum(axis * axis), 1), 0) * axis
        R = R - jnp.sum(R * axis[None], 1)[:, None] * weighted[None]
        Q = Q - weighted[:, None] * jnp.sum(axis[:, None] * Q, 0)[None]
        return Q, R, order

    start = jnp.eye(m, dtype=a.dtype), a.T, columns
    Q, R, order = lax.fori_loop(0, k, reflect, start)
    width = m if full_matrices else k
    found = Q[:width].T, jnp.triu(R.T[:width])
    return (*found, order) if pivoting else found
