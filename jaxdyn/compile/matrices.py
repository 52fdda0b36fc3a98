"""Products, Cholesky factors and triangular solves of matrices whose entries are single numbers (see `graph`)."""

import numpy as np

from jaxdyn.compile.graph import Graph
from jaxdyn.compile.number import Number, objects


def product(graph: Graph, a: np.ndarray, b: np.ndarray, zero) -> list:
    """Entries of a_k b_k^T, one matrix after the other, for a (count, rows, n) and b (count, columns, n).

    `zero` is an empty sum.
    """
    entries, add, mul = [], graph.add, graph.mul
    for rows, columns in zip(a.tolist(), b.tolist(), strict=True):
        # Known zeros are most of it: they are looked for once.
        nonzero = [[(k, y) for k, y in enumerate(column) if type(y) is Number or y != 0] for column in columns]
        for row in rows:
            for column in nonzero:
                total = zero
                for k, y in column:
                    x = row[k]
                    if type(x) is Number or x != 0:
                        total = add(total, mul(x, y))
                entries.append(total)
    return entries


def cholesky(graph: Graph, matrix: np.ndarray) -> np.ndarray:
    """The lower factor L of a symmetric matrix L L^T; reads the lower triangle."""
    n = matrix.shape[0]
    lower = np.full((n, n), 0.0, object)
    # Reciprocals of the diagonal are kept: n divisions, not n^2/2, and `triangular_solve` finds the same numbers again.
    inverse = []
    for j in range(n):
        for i in range(j, n):
            entry = matrix[i, j]
            for k in range(j):
                entry = graph.sub(entry, graph.mul(lower[i, k], lower[j, k]))
            if i == j:
                lower[j, j] = graph.function("sqrt", entry)
                inverse.append(graph.div(1.0, lower[j, j]))
            else:
                lower[i, j] = graph.mul(entry, inverse[j])
    return lower


def triangular_solve(graph: Graph, a: np.ndarray, b: np.ndarray, lower: bool, unit: bool) -> np.ndarray:
    """x with a x = b, for a triangular matrix (n, n), whose diagonal is taken as ones if `unit`, and b (n, columns)."""
    n = a.shape[0]
    rows: list = [None] * n
    for i in range(n) if lower else reversed(range(n)):
        row = b[i].tolist()
        for k in range(i) if lower else range(i + 1, n):
            # Known zeros of a factor are the branches of a tree.
            if type(a[i, k]) is Number or a[i, k] != 0:
                row = [graph.sub(x, graph.mul(a[i, k], y)) for x, y in zip(row, rows[k], strict=True)]
        inverse = 1.0 if unit else graph.div(1.0, a[i, i])
        rows[i] = [graph.mul(x, inverse) for x in row]
    return objects([x for row in rows for x in row], b.shape)
