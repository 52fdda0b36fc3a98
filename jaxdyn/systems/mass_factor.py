"""Factors of small positive definite matrices, and solutions with them.

A tree's mass matrix has a zero for every pair of coordinates of different branches. Factored from the last coordinate to
the first, M = U U^T with U upper triangular, it keeps them all (Featherstone 2008, section 6.5), so that programs of single
numbers (`jaxdyn.compile`) leave them out. `MassFactor` holds U as the Cholesky factor of the matrix in reversed order.

Outside of such programs, too, they are kernels, by loops where the matrix is large: LAPACK under XLA takes a thread for each
call, and two calls of a large batch at once can wait for each other for ever (jaxlib 0.10 to 0.12 on CPU).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import cholesky_factor, entry_point, triangular_solution


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower triangular L with L L^T = matrix, of which the lower triangle is read; NaN where it is not positive definite."""
    return cholesky_factor(matrix) if matrix.size else matrix  # of a model without moving bodies


def is_definite(matrix: Float[Array, "n n"], factor: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Decide whether a Cholesky factor has every pivot above rounding, as for a positive definite matrix.

    A pivot L_ii^2 is M_ii less a sum of products, with a rounding error of eps M_ii: below 16 of these errors a quotient by the
    pivot has hardly a correct digit.
    """
    return _has_pivots(factor, jnp.diagonal(matrix))


def _has_pivots(factor, diagonal):
    minimum = 16 * float(jnp.finfo(factor.dtype).eps)
    pivots = jnp.diagonal(factor)
    return jnp.all(pivots * pivots > minimum * diagonal)


def solve_lower(
    factor: Float[Array, "n n"], right: Float[Array, "n *k"], *, transposed: bool = False
) -> Float[Array, "n *k"]:
    """L^-1 right, or L^-T right."""
    return triangular_solution(factor, right, transposed) if factor.size else right


def solve_cholesky(factor: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve with a Cholesky factor: (L L^T)^-1 right."""
    return solve_lower(factor, solve_lower(factor, right), transposed=True)


@entry_point
def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """Solve matrix^-1 right by Cholesky factorisation; NaN where the matrix is not positive definite."""
    return solve_cholesky(cholesky(matrix), right)


class MassFactor(NamedTuple):
    """Factor of the mass matrix M = U U^T, the metric in which accelerations and constraint forces are compared.

    `whiten` maps forces f to U^-1 f, whose sum of squares is f . M^-1 f, and `unwhiten` these to accelerations:
    M^-1 f = unwhiten(whiten(f)). The whitened vectors have their entries in reversed order.
    """

    reversed: Float[Array, "n n"]
    diagonal: Float[Array, " n"]

    def whiten(self, forces: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """Whitened forces U^-1 f."""
        return solve_lower(self.reversed, forces[::-1])

    def unwhiten(self, whitened: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """Accelerations U^-T w of whitened forces w."""
        return solve_lower(self.reversed, whitened, transposed=True)[::-1]

    def solve(self, forces: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """Accelerations M^-1 f."""
        return self.unwhiten(self.whiten(forces))

    def is_definite(self) -> Bool[Array, ""]:
        """Decide whether M is positive definite with every pivot above rounding."""
        return _has_pivots(self.reversed, self.diagonal)


def mass_factor(mass: Float[Array, "n n"]) -> MassFactor:
    """Factor of a mass matrix, from its upper triangle."""
    # Reversed order puts the leaves of the tree first, whose elimination fills in nothing between branches.
    backwards = mass[::-1, ::-1]
    return MassFactor(cholesky(backwards), jnp.diagonal(backwards))
