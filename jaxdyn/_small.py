"""Solutions with small positive definite matrices, written out in single numbers.

Under `jax.vmap` XLA calls LAPACK once for each sample; what is written out becomes vectors over the batch instead.
"""

import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

MOST = 6  # operations grow with the third power, and XLA repeats part of them in every consumer


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """matrix^-1 right by Cholesky's factorisation; NaN where the matrix is not positive definite."""
    n = matrix.shape[0]
    if n > MOST:
        return cho_solve((jnp.linalg.cholesky(matrix), True), right)
    # matrix = L L^T; `scale` holds the reciprocals of L's diagonal.
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
    x = []
    for i in range(n):
        value = right[i]
        for k in range(i):
            value = value - lower[i][k] * x[k]
        x.append(value * scale[i])
    for i in reversed(range(n)):
        value = x[i]
        for k in range(i + 1, n):
            value = value - lower[k][i] * x[k]
        x[i] = value * scale[i]
    return jnp.stack(x)
