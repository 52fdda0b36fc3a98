"""Rank decisions, and pseudo-inverses of rows that may be dependent."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import (
    batch,
    gram_eigenvectors,
    kernel,
    mark_invalid,
    pseudo_inverse_by_pivots,
    pseudo_inverse_by_rotations,
)
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import as_static
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky, solve_lower

# Tolerances of constraints and of what is built on them, as powers of the rounding error eps of the dtype, with their values in
# float64. In float32 the same powers leave the same share of the digits.
RANK = 4 / 7  # 1.1e-9: above errors of projection, below the least singular values of mechanisms that move
REGULAR = (
    0.4  # 5.5e-7: least pivots, squares of singular values, of accurate factors; openings by which rows still hold
)
RESIDUAL = 0.5  # 1.5e-8: what equations leave of terms that cancel in them; Newton's steps behind which the next one is rounding
NEGLIGIBLE = 0.6  # 4e-10: entries and steps that count as zero, below `RANK`
CLOSED = 0.7  # 1.1e-11: residuals of closed loops of many bodies, far below the gaps of files, which are 1e-8 or more
REFINED = 0.75  # 1.8e-12: four digits above eps, which a step of refinement gains; above the rounding of a Gram matrix
CONVERGED, NEAR = 0.45, 0.3  # 9e-8, 2e-5: Newton's steps behind which it has converged, and from which it converges
# Operations up to which normal equations are written out, with several samples in a vector: those of 12 x 8 take a third of the
# time of loops, whose vectors are rows of one sample (`pseudo_inverse_by_pivots`). At 28 x 12 loops take 1.5 times as long in a
# batch, two thirds as long alone, and compile in 0.1 s, what is written out in 0.8 s; from 28 x 16 on they are as fast.
_MAX_OPERATIONS = 10_000
# Rows whose distance from the span of the others is below this part of their length may be redundant. Numbers written with four
# digits leave 1e-4.
_DOUBTFUL = 1e-3
# Factor between the least singular value that counts and the largest that does not, or between distances of rows from the span of
# the others, below which the numbers of a scene do not say what its rank is.
MIN_GAP = 100.0


def check_tolerance(rank_tol: float | None) -> float | None:
    """The rank tolerance as a float, or None for the default. **Raises:** ValueError outside (0, 1)."""
    if rank_tol is None:
        return None
    return as_static(rank_tol, "rank_tol", np.finfo(float).tiny, 1, "a number between 0 and 1, or None")


def tolerance(rank_tol: float | None, like) -> float:
    """The rank tolerance as given, or the default for the dtype."""
    return eps_of(like) ** RANK if (given := check_tolerance(rank_tol)) is None else given


def eps_of(like) -> float:
    """Rounding error of the dtype."""
    return float(jnp.finfo(like.dtype).eps)


def min_pivot(like, rank_tol: float | None) -> float:
    """Ratio of the pivots of A M^-1 A^T above which rounding cannot make the rows dependent, so that Cholesky is accurate."""
    # Pivots are squares of singular values, hence the square. The factor of 100 keeps the fast path away from the threshold
    # itself: samples near it are computed by the one method that applies the threshold.
    return max(eps_of(like) ** REGULAR, (100 * tolerance(rank_tol, like)) ** 2)


def min_refinable_pivot(like, rank_tol: float | None) -> float:
    """Ratio of the pivots above which each step of refinement gains digits, and rounding cannot make the rows dependent."""
    # A step multiplies the error by some 2^-52 over this ratio, the square of the condition number: by 1e-4.
    return max(eps_of(like) ** REFINED, (100 * tolerance(rank_tol, like)) ** 2)


def clear_pivot(like) -> float:
    """Pivot above which a row is independent beyond doubt."""
    return max(_DOUBTFUL, 10 * tolerance(None, like))


def regular_gram(Y: Float[Array, "n m"]) -> Float[Array, "m m"]:
    """Y^T Y with the largest entry of its diagonal in place of zeros there, which are of rows that were dropped.

    Solutions with right-hand sides that are zero there, such as (Y^T Y)^-1 Y^T, are those of the other rows.
    """
    gram = matmul(Y.T, Y)
    squares = jnp.diagonal(gram)
    largest = jnp.max(squares)
    # The largest entry, so that the filled pivots never are the least one in `quality_of`.
    fill = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    return gram + jnp.diag(jnp.where(squares == 0, fill, jnp.zeros_like(squares)))


def min_pivot_of(Y: Float[Array, "n m"]) -> Float[Array, ""]:
    """Least pivot of Y^T Y over its diagonal entry, zero columns left out: 1 for orthogonal columns, 0 for dependent ones."""
    gram = regular_gram(Y)
    return jnp.min(jnp.diagonal(cholesky(gram)) ** 2 / jnp.diagonal(gram))


def quality_of(factor):
    """Least over largest pivot, from a Cholesky factor."""
    pivots = jnp.diagonal(factor) ** 2
    return jnp.min(pivots) / jnp.max(pivots)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def pseudo_inverse(Y: Float[Array, "n m"], rank_tol: float, dependent: bool = False) -> Float[Array, "m n"]:
    """Moore-Penrose inverse of Y; singular values below `rank_tol` times the largest count as zero.

    Values: (Y^T Y)^-1 Y^T, or the transpose of that of Y^T, where that is as accurate; else by singular values. `dependent`:
    whether some columns may be combinations of others everywhere. Derivative: Golub & Pereyra (1973), eq. 4.12, valid where the
    rank is constant; no factorisation is differentiated.
    """
    if Y.shape[1] > Y.shape[0]:
        return pseudo_inverse(Y.T, rank_tol, True).T
    # Gram matrix, factor, two triangular solves and two products: 8 n m^2 sums and products for Y (n, m).
    is_short = 8 * Y.shape[0] * Y.shape[1] ** 2 <= _MAX_OPERATIONS
    by_loops = _by_rotations if is_short or dependent else _by_pivots
    by_kernel = kernel(_by_normal_equations, static=2, fallback=by_loops, derivative=False, alone=is_short)
    return by_kernel(rank_tol, dependent, None, Y)


class Columns(NamedTuple):
    """The columns of a matrix that are no combinations of those before them.

    - `kept` (m,): 1 for these columns, 0 for the others.
    - `factor` (m, m): Cholesky factor of the Gram matrix of the kept columns, made regular as by `regular_gram`.
    - `combinations` (m, m): C, such that column i of the others is the sum of C_ik times the kept columns k.
    - `is_clear` (): whether this holds to the tolerance.
    """

    kept: Float[Array, " m"]
    factor: Float[Array, "m m"]
    combinations: Float[Array, "m m"]
    is_clear: Bool[Array, ""]


def independent_columns(Y: Float[Array, "n m"], rank_tol: float) -> Columns:
    """Independent columns of Y, by a Cholesky factorisation of Y^T Y that leaves out columns without a pivot.

    Source: Higham, Analysis of the Cholesky decomposition of a semi-definite matrix, 1990; here without exchanges, as the order
    of a program is fixed. `is_clear` and `quality_of` the factor say where that is not accurate.
    """
    m, gram = Y.shape[1], matmul(Y.T, Y)
    squares = jnp.diagonal(gram)
    L, kept = jnp.zeros_like(gram), []
    for j in range(m):
        rest = gram[:, j] - matmul(L, L[j])
        # Between the rounding of the Gram matrix and what counts as independent: what is near it is not clear.
        is_kept = rest[j] > eps_of(Y) ** REFINED * squares[j]
        column = jnp.where(is_kept, rest / jnp.sqrt(jnp.where(is_kept, rest[j], jnp.ones_like(rest[j]))), 0.0)
        L = L.at[j:, j].set(column[j:])
        kept.append(is_kept)
    kept = jnp.stack(kept).astype(Y.dtype)
    largest = jnp.max(squares)
    fill = jnp.sqrt(jnp.where(largest > 0, largest, jnp.ones_like(largest)))
    factor = kept[:, None] * L + jnp.diag((1 - kept) * fill)
    C = solve_lower(factor, ((1 - kept)[:, None] * L).T, transposed=True).T
    others = Y * (1 - kept)[None] - matmul(Y * kept[None], C.T)
    is_clear = jnp.all(jnp.sum(others * others, 0) <= rank_tol**2 * largest)
    return Columns(kept, factor, C, is_clear)


def share(kept: Float[Array, " m"], C: Float[Array, "m m"], coefficients: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    """The least coefficients of all columns with the same sum as those of the kept ones: [1; C] (1 + C^T C)^-1 x.

    `kept` and `C` as `Columns.kept` and `Columns.combinations`; the coefficients (m, ...) of other columns are zero.
    """
    shared = solve_cholesky(cholesky(jnp.eye(C.shape[0], dtype=C.dtype) + matmul(C.T, C)), coefficients)
    return matmul(jnp.diag(kept) + C, shared)


def solve_with_damping(A: Float[Array, "m n"], right: Float[Array, " m"]) -> Float[Array, " n"]:
    """A small x with A x = right, by normal equations with little damping: for Newton's steps, which need no more digits.

    Rows may be zero. Where others depend on each other x is a compromise, not a NaN.
    """
    gram = regular_gram(A.T)
    damping = eps_of(A) ** REFINED * jnp.max(jnp.diagonal(gram))
    return matmul(A.T, solve_cholesky(cholesky(gram + damping * jnp.eye(A.shape[0], dtype=A.dtype)), right))


def _by_rotations(rank_tol, dependent, _, Y):
    return pseudo_inverse_by_rotations(Y, rank_tol)


def _by_pivots(rank_tol, dependent, _, Y):
    return pseudo_inverse_by_pivots(Y, rank_tol, min_pivot(Y, rank_tol))


def _solve_normal_equations(rank_tol, dependent: bool, Y):
    """The pseudo-inverse (Y^T Y)^-1 Y^T, and whether it is doubtful, by the pivots of Y^T Y.

    Of columns that may be `dependent` those that are independent, and the least coefficients of all; of others, whether they are.
    """
    if dependent:
        columns = independent_columns(Y, rank_tol)
        factor, is_doubtful = columns.factor, ~columns.is_clear
        inverse = share(columns.kept, columns.combinations, solve_cholesky(factor, (Y * columns.kept[None]).T))
    else:
        factor, is_doubtful = cholesky(regular_gram(Y)), jnp.asarray(False)
        inverse = solve_cholesky(factor, Y.T)
    # The normal equations square the condition number; one Newton-Schulz step restores the accuracy of an orthogonal method.
    inverse = 2 * inverse - matmul(matmul(inverse, Y), inverse)
    return inverse, is_doubtful | ~(quality_of(factor) > min_pivot(Y, rank_tol))


def _by_normal_equations(rank_tol, dependent: bool, _, Y):
    inverse, is_doubtful = _solve_normal_equations(rank_tol, dependent, Y)
    return mark_invalid(is_doubtful, inverse)


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(rank_tol, dependent, primals, tangents):
    (Y,), (dY,) = primals, tangents
    # dP = -P dY P + P P^T dY^T (1 - Y P) + (1 - P Y) dY^T P^T P. Differentiating the rotations or the SVD instead would divide
    # by differences of singular values, which coincide in symmetric mechanisms.
    P = pseudo_inverse(Y, rank_tol, dependent)
    across = dY.T - matmul(matmul(dY.T, Y), P)  # dY^T (1 - Y P)
    along = dY.T - matmul(P, matmul(Y, dY.T))  # (1 - P Y) dY^T
    dP = -matmul(matmul(P, dY), P)
    dP = dP + matmul(matmul(P, P.T), across) + matmul(along, matmul(P.T, P))
    return P, dP


class LeastSquares(NamedTuple):
    """Minimum-norm solutions w of Y^T w = r, and their coefficients in the columns of Y, by its pseudo-inverse."""

    Y: Array
    inverse: Array

    def shortest(self, right):
        """The shortest w with Y^T w = right."""
        return matmul(self.inverse.T, right)

    def multipliers(self, w):
        """The smallest x with Y x = w, for w that is a sum of columns."""
        return matmul(self.inverse, w)


def least_squares(Y: Float[Array, "n m"], rank_tol: float) -> LeastSquares:
    """Factor a matrix."""
    return LeastSquares(Y, pseudo_inverse(Y, rank_tol))


def rank_of(A: Float[Array, "n m"], inverse: Float[Array, "m n"]) -> Float[Array, ""]:
    """Rank of a matrix with a pseudo-inverse A^+: the trace of A^+ A, rounded to an integer."""
    # Each singular value above the tolerance contributes 1 up to rounding.
    return jnp.round(jnp.sum(inverse * A.T))


def has_clear_rank(
    A: Float[Array, "n m"], inverse: Float[Array, "m n"], rank_tol: float | None, is_exact: bool = False
) -> Bool[Array, ""]:
    """Decide whether the rank of rows A, with their pseudo-inverse, is clear; a constant.

    The least singular value that counts has to be `MIN_GAP` times the largest that does not. Rows that leave no motion have to
    be independent beyond doubt: a row that differs from a combination of others by the rounding of its numbers leaves none, too.
    Those of functions, not of bodies whose geometry may have been typed with few digits, are taken as they stand: `is_exact`.
    Kernels do not ask.
    """
    return kernel(_take_as_clear, static=2, fallback=_has_gap, alone=False)(rank_tol, is_exact, None, A, inverse)


def _take_as_clear(rank_tol, is_exact: bool, _, A, inverse):
    return jnp.asarray(True)


def _has_gap(rank_tol, is_exact: bool, _, A, inverse):
    (A, inverse), minimum = lax.stop_gradient((A, inverse)), tolerance(rank_tol, A)
    is_full = (rank_of(A, inverse) >= A.shape[1]) & (rank_tol is None and not is_exact and A.shape[0] >= A.shape[1])

    def compare():
        values = jnp.sqrt(gram_eigenvectors(A)[0])
        counts = values > minimum * values[0]
        kept = jnp.min(jnp.where(counts, values, jnp.inf))
        squares = jnp.sum(A * A, 1, keepdims=True)
        unit = A / jnp.sqrt(jnp.where(squares > 0, squares, jnp.ones_like(squares)))
        is_sure = jnp.sqrt(gram_eigenvectors(unit)[0][-1]) > clear_pivot(A)
        return (kept >= MIN_GAP * jnp.max(jnp.where(counts, 0.0, values))) & (~is_full | is_sure)

    # 1 / |A^+| is below the least singular value that counts. No other one is above the tolerance.
    sizes = MIN_GAP * minimum * jnp.sqrt(jnp.sum(A * A)) * jnp.sqrt(jnp.sum(inverse * inverse))
    # The second value is True where it counts, and varies along a mesh as the first one does.
    return batch.cond(is_full | ~(sizes <= 1), compare, lambda: sizes <= 1)


def condition_number(A: Float[Array, "n m"], inverse: Float[Array, "k l"]) -> Float[Array, ""]:
    """|A| |A^+| in Frobenius' norm, an upper bound of the condition number of A, or of a part of it, that needs no SVD."""
    return jnp.sqrt(jnp.sum(inverse * inverse) * jnp.sum(A * A))


def solve_square(A: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """A^-1 right for a regular A, by Jacobi rotations."""
    # Without LAPACK: its calls from several samples of a batch can deadlock in XLA's thread pool.
    return matmul(pseudo_inverse(A, eps_of(A), True), right)
