"""Whether rows are independent, and pseudo-inverses of those that may not be."""

from functools import partial

import jax
import jax.core
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxdyn._anywhere import anywhere
from jaxdyn._small import cholesky, solve_factored
from jaxdyn.so3 import _product


def checked_tolerance(rank_tol: float | None) -> float | None:
    """The rank tolerance as a float, or None for the default. **Raises:** ValueError outside (0, 1)."""
    if rank_tol is None:
        return None
    if isinstance(rank_tol, jax.core.Tracer) or not 0 < float(rank_tol) < 1:
        raise ValueError(f"rank_tol is {rank_tol}; give a number between 0 and 1 that is not traced, or None")
    return float(rank_tol)


def tolerance(rank_tol: float | None, like: Array) -> float:
    """The rank tolerance as given, or the default for the dtype."""
    return eps_of(like) ** (4 / 7) if rank_tol is None else float(rank_tol)


def eps_of(like) -> float:
    """Rounding error of the dtype."""
    return float(jnp.finfo(like.dtype).eps)


def least_pivot(like, rank_tol: float | None) -> float:
    """Ratio of the pivots of A M^-1 A^T above which the rows are independent whatever the rounding, and Cholesky serves."""
    return max(eps_of(like) ** 0.4, (100 * tolerance(rank_tol, like)) ** 2)


def quality_of(factor):
    """Least over largest pivot, from a Cholesky factor."""
    pivots = jnp.diagonal(factor) ** 2
    return jnp.min(pivots) / jnp.max(pivots)


def normal_factor(Y, rank_tol):
    """Cholesky factor of Y^T Y, and whether the columns of Y are so independent that it may stand for the pseudo-inverse."""
    factor = cholesky(_product(Y.T, Y))
    return factor, quality_of(factor) > least_pivot(Y, rank_tol)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def pseudo_inverse(Y: Float[Array, "n m"], rank_tol: float, dependent: bool = False) -> Float[Array, "m n"]:
    """Moore-Penrose inverse of Y, singular values below `rank_tol` times the largest taken for zero.

    Values: (Y^T Y)^-1 Y^T where that is as good; else on CPU a complete orthogonal decomposition (pivoted QR, then QR
    of the triangle's transpose), elsewhere an SVD, of all samples if one in a batch needs it; at once where the columns are
    known to be `dependent`. Derivative: the formula of Golub & Pereyra (1973), eq. 4.12, right wherever the rank is
    constant; no factorisation is differentiated.
    """
    if dependent or Y.shape[1] > Y.shape[0]:
        return _by_factors(Y, rank_tol)
    factor, independent = normal_factor(Y, rank_tol)
    return lax.cond(anywhere(~independent), lambda: _by_factors(Y, rank_tol), lambda: _by_normal_equations(Y, factor))


def _by_normal_equations(Y, factor):
    inverse = solve_factored(factor, Y.T)
    # One step of Newton and Schulz takes the squared condition number out of the error.
    return 2 * inverse - _product(_product(inverse, Y), inverse)


def _by_factors(Y, rank_tol):
    return lax.platform_dependent(
        Y, cpu=partial(_by_orthogonal, rank_tol=rank_tol), default=partial(_by_svd, rank_tol=rank_tol)
    )


def _by_orthogonal(Y, rank_tol):
    # The triangles are taken as products with Q and Z, and not from the factorisations, so that these run one after the
    # other: two large LAPACK calls at once can wait for each other's share of XLA's thread pool for ever.
    Q, _, order = lax.linalg.qr(Y, pivoting=True, full_matrices=False)
    R = jnp.triu(_product(Q.T, Y[:, order]))
    pivots = jnp.abs(jnp.diagonal(R))
    keep = pivots > rank_tol * pivots[0]
    # Y[:, order] = Q R with the rows of R below the rank dropped; R^T = Z T makes what is left square and triangular.
    left = jnp.where(keep[:, None], R, jnp.zeros_like(R)).T
    Z, _ = lax.linalg.qr(left, full_matrices=False)
    T = jnp.triu(_product(Z.T, left))
    T = T + jnp.diag(jnp.where(keep, jnp.zeros_like(pivots), jnp.ones_like(pivots)))
    kept = jnp.where(keep[:, None], Q.T, jnp.zeros_like(Q.T))
    inverse = _product(Z, solve_triangular(T, kept, trans=1))
    return jnp.zeros_like(inverse).at[order].set(inverse)


def _by_svd(Y, rank_tol):
    U, s, Vt = jnp.linalg.svd(Y, full_matrices=False)
    keep = s > rank_tol * s[0]
    inverse = jnp.where(keep, 1.0 / jnp.where(keep, s, jnp.ones_like(s)), jnp.zeros_like(s))
    return _product(Vt.T * inverse[None], U.T)


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(rank_tol, dependent, primals, tangents):
    (Y,), (dY,) = primals, tangents
    P = pseudo_inverse(Y, rank_tol, dependent)
    across = dY.T - _product(_product(dY.T, Y), P)  # dY^T (1 - Y P)
    along = dY.T - _product(P, _product(Y, dY.T))  # (1 - P Y) dY^T
    dP = -_product(_product(P, dY), P)
    dP = dP + _product(_product(P, P.T), across) + _product(along, _product(P.T, P))
    return P, dP
