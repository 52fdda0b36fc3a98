"""Distances of a body from its nominal one as residuals whose squares add up to the distance, for least squares.

With P = U0 U U^T U0^T the pseudo-inertia of a body and P0 = U0 U0^T that of the nominal one, P0^-1 P has the eigenvalues of
U U^T, so that both distances are the same in every frame and unit:

    entropic           tr(P0^-1 P) - log det(P0^-1 P) - 4 = sum of U_ij^2 off the diagonal + sum of U_ii^2 - 2 log U_ii - 1
    affine-invariant   |log(P0^-1/2 P P0^-1/2)|_F^2       = |log(U U^T)|_F^2

Near the nominal body the first is half of the second.

Source: Lee, Wensing & Park (2020), Geometric robot dynamic identification: a convex programming approach.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import gram_eigenvectors

METRICS = ("entropic", "affine")
_UPPER = np.triu_indices(4, 1)


def barrier_residual(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """r with r^2 = exp(x) - x - 1 and the sign of x: smooth, x / sqrt(2) near zero, huge where exp(x) is huge or next to zero."""
    # exp(x) - x - 1 cancels near zero. At 0.1 the remainder of the series is 3e-13.
    small = jnp.abs(x) < 0.1
    # The unused branch must be finite too: NaN from 0/0 there would pass through `where` into the gradient.
    safe = jnp.where(small, jnp.ones_like(x), x)
    # (exp(x) - x - 1) / x^2 = 1/2 + x/6 + x^2/24 + ...
    series = 1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720 + x * (1 / 5040 + x / 40320)))))
    share = jnp.where(small, series, (jnp.expm1(safe) - safe) / safe**2)
    return x * jnp.sqrt(share)


def entropic_residual(U: Float[Array, "4 4"]) -> Float[Array, "10"]:
    """Ten numbers whose squares add up to the entropic divergence of U U^T from 1, U upper triangular."""
    return jnp.concatenate([barrier_residual(2 * jnp.log(jnp.diagonal(U))), U[_UPPER]])


def affine_residual(U: Float[Array, "4 4"]) -> Float[Array, "10"]:
    """Ten numbers whose squares add up to the squared affine-invariant distance of U U^T from 1."""
    logarithm = symmetric_log(U @ U.T)
    # Entries off the diagonal occur twice in the Frobenius norm.
    return jnp.concatenate([jnp.diagonal(logarithm), np.sqrt(2.0) * logarithm[_UPPER]])


@jax.custom_jvp
def symmetric_log(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Logarithm of a symmetric positive definite matrix; NaN for one that is not positive definite.

    Its derivative, of first order, is that of Daleckii and Krein, which stays finite at equal eigenvalues.
    """
    values, vectors = symmetric_eigenvectors(matrix)
    return (vectors * jnp.log(values)[None, :]) @ vectors.T


@symmetric_log.defjvp
def _symmetric_log_jvp(primals, tangents):
    values, vectors = symmetric_eigenvectors(primals[0])
    one, other = values[:, None], values[None, :]
    # (log a - log b) / (a - b) = atanh(x) / x * 2 / (a + b), x = (a - b) / (a + b).
    x = (one - other) / (one + other)
    # Equal eigenvalues make the quotient 0/0, with the limit 1 / a. At 0.01 the remainder of the series is below rounding.
    small = jnp.abs(x) < 1e-2
    safe = jnp.where(small, 0.5 * jnp.ones_like(x), x)
    series = 1 + x**2 * (1 / 3 + x**2 * (1 / 5 + x**2 * (1 / 7 + x**2 / 9)))
    quotients = jnp.where(small, series, jnp.arctanh(safe) / safe) * 2 / (one + other)
    change = (tangents[0] + tangents[0].T) / 2
    logarithm = (vectors * jnp.log(values)[None, :]) @ vectors.T
    return logarithm, vectors @ (quotients * (vectors.T @ change @ vectors)) @ vectors.T


def symmetric_eigenvectors(matrix: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues (n,) and eigenvectors, in columns, of a symmetric matrix that is meant to be positive definite."""
    vectors = gram_eigenvectors(matrix)[1]
    return jnp.sum(vectors * (matrix @ vectors), 0), vectors
