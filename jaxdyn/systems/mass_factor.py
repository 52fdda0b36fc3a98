"""Factors of small positive definite matrices, and solutions with them.

A tree's mass matrix has a zero for every pair of coordinates of different branches. Factored from the last coordinate to
the first, M = U U^T with U upper triangular, it keeps them all (Featherstone 2008, section 6.5), so that programs of single
numbers (`jaxdyn.compile`) leave them out. `MassFactor` holds U as the Cholesky factor of the matrix in reversed order.

Outside of such programs, too, they are kernels: LAPACK under XLA takes a thread for each call, and two calls of a large batch at
once can wait for each other for ever (jaxlib 0.10 to 0.12 on CPU).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import compiled, run


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower triangular L with L L^T = matrix, of which the lower triangle is read; NaN where it is not positive definite."""
    return run(_cholesky, None, matrix)


def _cholesky(_, matrix):
    return lax.linalg.cholesky(matrix, symmetrize_input=False)


def definite(matrix: Float[Array, "n n"], factor: Float[Array, "n n"]) -> Bool[Array, ""]:
    """Whether the Cholesky factor is that of a positive definite matrix, with more than rounding left in every pivot.

    A pivot L_ii^2 is what M_ii is after others are taken from it, with an error of eps M_ii: of a quotient by 16 of them
    hardly a digit is right.
    """
    return _has_pivots(factor, jnp.diagonal(matrix))


def _has_pivots(factor, diagonal):
    least = 16 * float(jnp.finfo(factor.dtype).eps)
    pivots = jnp.diagonal(factor)
    return jnp.all(pivots * pivots > least * diagonal)


def solve_lower(
    factor: Float[Array, "n n"], right: Float[Array, "n *k"], *, transposed: bool = False
) -> Float[Array, "n *k"]:
    """L^-1 right, or L^-T right."""
    return run(_solve_lower, None, factor, right, static=(transposed,))


def _solve_lower(transposed: bool, _, factor, right):
    return solve_triangular(factor, right, lower=True, trans=int(transposed))


def solve_factored(factor: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """(L L^T)^-1 right."""
    return solve_lower(factor, solve_lower(factor, right), transposed=True)


@compiled
def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """matrix^-1 right by Cholesky's factorisation; NaN where the matrix is not positive definite."""
    return solve_factored(cholesky(matrix), right)


class MassFactor(NamedTuple):
    """M = U U^T, the metric in which accelerations and constraint forces are compared.

    `whiten` maps forces f to U^-1 f, whose sum of squares is f . M^-1 f, and `unwhiten` these to accelerations:
    M^-1 f = unwhiten(whiten(f)). Both take the entries of what is in between in reversed order.
    """

    reversed: Float[Array, "n n"]
    diagonal: Float[Array, " n"]

    def whiten(self, forces: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """U^-1 forces."""
        return solve_lower(self.reversed, forces[::-1])

    def unwhiten(self, whitened: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """U^-T whitened."""
        return solve_lower(self.reversed, whitened, transposed=True)[::-1]

    def solve(self, forces: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """M^-1 forces."""
        return self.unwhiten(self.whiten(forces))

    def momentum(self, velocities: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """U^T velocities, the inverse of `unwhiten`."""
        return self.reversed.T @ velocities[::-1]

    def definite(self) -> Bool[Array, ""]:
        """Whether M is positive definite, with more than rounding left in every pivot."""
        return _has_pivots(self.reversed, self.diagonal)


def mass_factor(mass: Float[Array, "n n"]) -> MassFactor:
    """The factor of a mass matrix, of which the upper triangle is read."""
    backwards = mass[::-1, ::-1]
    return MassFactor(cholesky(backwards), jnp.diagonal(backwards))
