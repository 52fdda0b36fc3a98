"""Factors of small positive definite matrices and solutions with them, written out in single numbers.

Under `jax.vmap` XLA calls LAPACK once for each sample; what is written out becomes vectors over the batch instead. For single
samples it saves the call.
"""

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float

from jaxdyn._materialize import materialize
from jaxdyn._scalar_program import is_written_out

MOST = 6  # operations grow with the third power, and XLA repeats part of them in every consumer
MOST_WRITTEN = 24  # in a program of single numbers, where nothing is repeated


def _most() -> int:
    return MOST_WRITTEN if is_written_out() else MOST


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """matrix^-1 right by Cholesky's factorisation; NaN where the matrix is not positive definite."""
    n = matrix.shape[0]
    if n > _most():
        return cho_solve((jnp.linalg.cholesky(matrix), True), right)
    lower, scale = _factored(matrix)
    return jnp.stack(_backward(lower, scale, _forward(lower, scale, list(right))))


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower triangular L with L L^T = matrix; not `definite` where the matrix is not."""
    n = matrix.shape[0]
    if not 0 < n <= _most():
        return jnp.linalg.cholesky(matrix)
    lower, scale = _factored(matrix)
    zero = jnp.zeros((), matrix.dtype)
    rows = [[*row[:i], 1 / scale[i], *[zero] * (n - 1 - i)] for i, row in enumerate(lower)]
    return materialize(jnp.stack([jnp.stack(row) for row in rows]))[0]


def definite(matrix: Float[Array, "n n"], factor: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether the Cholesky factor is that of a positive definite matrix, with more than rounding left in every pivot.

    A pivot L_ii^2 is what M_ii is after others are taken from it, with an error of eps M_ii: of a quotient by 16 of them
    hardly a digit is right.
    """
    least = 16 * float(jnp.finfo(matrix.dtype).eps)
    return jnp.all(jnp.diagonal(factor) ** 2 > least * jnp.diagonal(matrix)) & jnp.isfinite(factor).all()


def solve_lower(
    factor: Float[Array, "n n"], right: Float[Array, "n *k"], *, transposed: bool = False
) -> Float[Array, "n *k"]:
    """L^-1 right, or L^-T right."""
    n = factor.shape[0]
    if not 0 < n <= _most():
        return solve_triangular(factor, right, lower=True, trans=int(transposed))
    sweep = _backward if transposed else _forward
    return materialize(jnp.stack(sweep(factor, [1 / factor[i, i] for i in range(n)], list(right))))[0]


def solve_factored(factor: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """(L L^T)^-1 right."""
    if not 0 < factor.shape[0] <= _most():
        return cho_solve((factor, True), right)
    return solve_lower(factor, solve_lower(factor, right), transposed=True)


def _factored(matrix):
    """L without its diagonal, by rows, and the reciprocals of that."""
    n = matrix.shape[0]
    lower: list[list] = [[] for _ in range(n)]
    scale = []
    for j in range(n):
        for i in range(j, n):
            entry = matrix[i, j]
            for k in range(j):
                entry = entry - lower[i][k] * lower[j][k]
            if i == j:
                scale.append(1 / jnp.sqrt(entry))
                lower[j].append(None)
            else:
                lower[i].append(entry * scale[j])
    return lower, scale


def _forward(lower, scale, right: list) -> list:
    x: list = []
    for i, value in enumerate(right):
        for k in range(i):
            value = value - lower[i][k] * x[k]
        x.append(value * scale[i])
    return x


def _backward(lower, scale, right: list) -> list:
    x = list(right)
    for i in reversed(range(len(x))):
        value = x[i]
        for k in range(i + 1, len(x)):
            value = value - lower[k][i] * x[k]
        x[i] = value * scale[i]
    return x
