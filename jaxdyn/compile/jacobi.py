"""Pseudo-inverses and singular vectors by one-sided Jacobi rotations, inverses by elimination, as kernels of one matrix.

Rotations J from the right make the columns of A J = U orthogonal; then A = U J^T has the right singular vectors J and the
pseudo-inverse J D U^T, with D one over the squared lengths of the columns, which are the singular values, and zero for those
below the tolerance. The relative error of small singular values is that of rounding (Demmel & Veselic 1992), which
bidiagonalisation does not give.

Source: Hestenes (1958); Golub & Van Loan, Matrix Computations, sections 3.4 and 8.6.3.
"""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.matrix_loops import LoopWriter, MatrixProgram
from jaxdyn.compile.pivots import eliminate
from jaxdyn.compile.rules import mark_invalid

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    import llvmlite.ir as ir

    from jaxdyn.compile.matrix_loops import INT


# Sweeps converge quadratically: six to ten are enough. The bound ends those over numbers that are not finite, for which the
# test of convergence never holds.
MAX_SWEEPS = 60
# Share of a diagonal entry that elimination without exchange of rows has to leave as a pivot, and relative error of its inverse
# from which on samples are computed with exchanges.
_MIN_SHARE = 1e-4


def _cost(n: int, m: int) -> int:
    """Operations of some eight sweeps over m columns of n entries."""
    return 8 * m * m * (6 * n + 3 * m) // 2 + 1


class PseudoInverse(MatrixProgram):
    """A (rows, columns) -> its pseudo-inverse (columns, rows).

    By normal equations where the least of their pivots is above `minimum` times the largest; by rotations elsewhere, or for None.
    """

    name = "pseudo_inverse"

    def __init__(self, rows: int, columns: int, dtype, tolerance: float, minimum: float | None = None):
        super().__init__(rows, columns, (columns, rows), dtype, tolerance)
        self.minimum = minimum
        n, m = max(rows, columns), min(rows, columns)
        self.cost = _cost(n, m) if minimum is None else 8 * n * m * m + 1

    @property
    def title(self) -> str:
        """Text that names all on which the code depends."""
        return super().title if self.minimum is None else f"{super().title}, pivots above {self.minimum!r}"

    def write(self, w: LoopWriter, matrix, result) -> None:
        """Normal equations, then rotations where these are poor."""
        if self.minimum is None:
            return self._write_by_rotations(w, matrix, result)
        is_accurate = write_normal_equations(w, matrix, result, self.rows, self.columns, self.minimum)
        with w.b.if_then(w.b.not_(is_accurate)):
            self._write_by_rotations(w, matrix, result)

    def _write_by_rotations(self, w: LoopWriter, matrix, result) -> None:
        """Rotations, and J D U^T from them."""
        rows, columns = self.rows, self.columns
        # The smaller side is made orthogonal: rotations of m vectors of length n >= m cost n m^2 a sweep.
        n, m = max(rows, columns), min(rows, columns)
        # Columns of the matrix, or its rows where there are fewer of them, one after the other.
        U, J = _orthogonalise(w, matrix, n, m, *((1, columns) if rows >= columns else (columns, 1)))
        # Entry (i, k) of J D U^T is at i of_column + k of_row.
        of_column, of_row = (n, 1) if rows >= columns else (1, m)
        b, zero = w.b, w.integer(0)
        sizes, largest = w.buffer(m), w.variable(w.float, w.number(0))
        with w.loop(zero, w.integer(m)) as p:
            x = w.at(U, (p, n))
            square = w.product(x, x, n)
            b.store(square, w.at(sizes, (p, 1)))
            so_far = w.load(largest)
            # Written so that NaN becomes the largest, and no column is dropped for a comparison with it.
            b.store(b.select(b.fcmp_ordered("<", square, so_far), so_far, square), largest)
        limit = b.fmul(w.number(self.tolerance**2), w.load(largest))
        with w.loop(zero, w.integer(n * m)) as k:
            b.store(w.number(0), w.at(result, (k, 1)))
        with w.loop(zero, w.integer(m)) as p:
            square = w.load(w.at(sizes, (p, 1)))
            # What is not a number is not dropped, so that it is seen in the result.
            with b.if_then(b.not_(b.fcmp_ordered("<=", square, limit))):
                with w.loop(zero, w.integer(m)) as i:
                    weight = b.fdiv(w.load(w.at(J, (p, m), (i, 1))), square)
                    with w.loop(zero, w.integer(n)) as k:
                        at = w.at(result, (i, of_column), (k, of_row))
                        b.store(b.fadd(w.load(at), b.fmul(weight, w.load(w.at(U, (p, n), (k, 1))))), at)

    def compute(self, matrix):
        """The same by JAX's singular value decomposition."""
        U, s, Vt = jnp.linalg.svd(matrix, full_matrices=False)
        # A double where: one over a dropped value would be infinite, and its product with zero NaN.
        drop = s <= self.tolerance * s[..., :1]
        inverse = jnp.where(drop, jnp.zeros_like(s), 1 / jnp.where(drop, jnp.ones_like(s), s))
        right = jnp.swapaxes(Vt, -1, -2) * inverse[..., None, :]
        return jnp.matmul(right, jnp.swapaxes(U, -1, -2), precision="highest")


class RightVectors(MatrixProgram):
    """A (rows, columns) -> its right singular vectors (columns, columns), that of the largest singular value first."""

    name = "right_vectors"

    def __init__(self, rows: int, columns: int, dtype):
        super().__init__(rows, columns, (columns, columns), dtype)
        self.cost = _cost(rows, columns)

    def write(self, w: LoopWriter, matrix, result) -> None:
        """Rotations, and the columns of J in the order of the lengths of U's columns."""
        b, n, m = w.b, self.rows, self.columns
        U, J = _orthogonalise(w, matrix, n, m, 1, m)
        squares, total = w.buffer(m), w.variable(w.float, w.number(0))
        with w.loop(w.integer(0), w.integer(m)) as p:
            x = w.at(U, (p, n))
            square = w.product(x, x, n)
            b.store(square, w.at(squares, (p, 1)))
            b.store(b.fadd(w.load(total), square), total)
        # Rotations pass over numbers that are not finite: without this the vectors would be those of the identity.
        invalid = b.fsub(w.load(total), w.load(total))
        with w.loop(w.integer(0), w.integer(m)) as place:
            maximum, index = w.variable(w.float, w.number(-1)), w.variable(INT, w.integer(0))
            with w.loop(w.integer(0), w.integer(m)) as p:
                square = w.load(w.at(squares, (p, 1)))
                with b.if_then(b.fcmp_ordered(">", square, w.load(maximum))):
                    b.store(square, maximum)
                    b.store(p, index)
            p = b.load(index, typ=INT)
            b.store(w.number(-2), w.at(squares, (p, 1)))
            with w.loop(w.integer(0), w.integer(m)) as i:
                entry = b.fadd(w.load(w.at(J, (p, m), (i, 1))), invalid)
                b.store(entry, w.at(result, (i, m), (place, 1)))

    def compute(self, matrix):
        """The same by JAX's singular value decomposition."""
        return jnp.swapaxes(jnp.linalg.svd(matrix, full_matrices=True)[2], -1, -2)


class Inverse(MatrixProgram):
    """A (n, n) -> its inverse by elimination with exchanges of rows; not finite where it is singular."""

    name = "inverse"

    def __init__(self, size: int, dtype):
        super().__init__(size, size, (size, size), dtype)
        self.cost = 3 * size**3 + 1

    def write(self, w: LoopWriter, matrix, result) -> None:
        """Elimination on [A 1], whose right half becomes the inverse."""
        b, n, zero = w.b, self.rows, w.integer(0)
        rows = w.buffer(2 * n * n)
        with w.loop(zero, w.integer(n)) as i, w.loop(zero, w.integer(n)) as j:
            b.store(w.load(w.at(matrix, (i, n), (j, 1))), w.at(rows, (i, 2 * n), (j, 1)))
            one = b.select(b.icmp_signed("==", i, j), w.number(1), w.number(0))
            b.store(one, w.at(rows, (i, 2 * n), (b.add(j, w.integer(n)), 1)))
        with w.loop(zero, w.integer(n)) as k:
            size, index = w.variable(w.float, w.number(-1)), w.variable(INT, k)
            with w.loop(k, w.integer(n)) as i:
                entry = w.size(w.load(w.at(rows, (i, 2 * n), (k, 1))))
                with b.if_then(b.fcmp_ordered(">", entry, w.load(size))):
                    b.store(entry, size)
                    b.store(i, index)
            own, other = w.at(rows, (k, 2 * n)), w.at(rows, (b.load(index, typ=INT), 2 * n))
            scale = b.fdiv(w.number(1), w.load(w.at(other, (k, 1))))
            # Columns before k are those of the unit matrix already.
            with w.loop(k, w.integer(2 * n)) as j:
                pivot, moved = w.load(w.at(other, (j, 1))), w.load(w.at(own, (j, 1)))
                b.store(moved, w.at(other, (j, 1)))
                b.store(b.fmul(pivot, scale), w.at(own, (j, 1)))
            with w.loop(zero, w.integer(n)) as i, b.if_then(b.icmp_signed("!=", i, k)):
                row = w.at(rows, (i, 2 * n))
                factor = w.load(w.at(row, (k, 1)))
                with w.loop(k, w.integer(2 * n)) as j:
                    change = b.fmul(factor, w.load(w.at(own, (j, 1))))
                    b.store(b.fsub(w.load(w.at(row, (j, 1))), change), w.at(row, (j, 1)))
        with w.loop(zero, w.integer(n)) as i, w.loop(zero, w.integer(n)) as j:
            entry = w.load(w.at(rows, (i, 2 * n), (b.add(j, w.integer(n)), 1)))
            b.store(entry, w.at(result, (i, n), (j, 1)))

    def compute(self, matrix):
        """The same by JAX's inverse."""
        return jnp.linalg.inv(matrix)


# One program for each shape, so that programs of JAX are found again.
_pseudo_inverse, _right_vectors, _inverse = (
    functools.lru_cache(maxsize=256)(kind) for kind in (PseudoInverse, RightVectors, Inverse)
)


def pseudo_inverse_by_rotations(matrix: jax.Array, tolerance: float) -> jax.Array:
    """The pseudo-inverse (m, n) of a matrix (n, m), singular values up to `tolerance` times the largest taken for zero.

    It has no derivative: put it under a rule that gives one.
    """
    return _pseudo_inverse(*matrix.shape, matrix.dtype, float(tolerance))(matrix)


def pseudo_inverse_by_pivots(matrix: jax.Array, tolerance: float, minimum: float) -> jax.Array:
    """`pseudo_inverse_by_rotations` of a matrix (n, m) with n >= m, by normal equations where these are accurate.

    They are where their least pivot is above `minimum` times the largest. Columns of zeros have no pivot.
    """
    return _pseudo_inverse(*matrix.shape, matrix.dtype, float(tolerance), float(minimum))(matrix)


@jax.custom_jvp
def gram_eigenvectors(matrix: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eigenvalues (m,) of X^T X, the squared singular values of X (n, m), largest first, and its eigenvectors (m, m) in columns.

    Small eigenvalues have the digits that X^T X itself has lost. For a symmetric semidefinite X the eigenvectors are those of
    X, and the eigenvalues the squares. It has derivatives of all orders; vectors of equal values do not turn in their space.
    """
    vectors = _right_vectors(*matrix.shape, matrix.dtype)(matrix)
    return jnp.sum(jnp.matmul(matrix, vectors, precision="highest") ** 2, 0), vectors


@gram_eigenvectors.defjvp
def _gram_eigenvectors_jvp(primals, tangents):
    (X,), (dX,) = primals, tangents
    values, V = gram_eigenvectors(X)
    half = jnp.matmul(
        jnp.matmul(X, V, precision="highest").T, jnp.matmul(dX, V, precision="highest"), precision="highest"
    )
    change = half + half.T  # V^T d(X^T X) V
    # dV = V K with K_ij = change_ij / (values_j - values_i).
    gaps = values[None, :] - values[:, None]
    is_equal = jnp.abs(gaps) <= 16 * jnp.finfo(X.dtype).eps * jnp.max(values, initial=0.0)
    turn = jnp.where(is_equal, jnp.zeros_like(gaps), change) / jnp.where(is_equal, jnp.ones_like(gaps), gaps)
    return (values, V), (jnp.diagonal(change), jnp.matmul(V, turn, precision="highest"))


@jax.custom_jvp
def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse (n, n) of a regular matrix by elimination; numbers that are not finite where it is singular."""
    if 0 in matrix.shape:
        return matrix
    if mode.is_expanding() and not mode.is_careful():
        return _inverse_without_exchange(matrix)
    return _inverse(matrix.shape[0], matrix.dtype)(matrix)


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    X = inverse(primals[0])
    return X, -jnp.matmul(X, jnp.matmul(tangents[0], X, precision="highest"), precision="highest")


def _inverse_without_exchange(matrix):
    """The inverse; samples are invalid where a pivot is small beside its terms, or the inverse of a product is not its factor."""
    n, tiny = len(matrix), float(jnp.finfo(matrix.dtype).tiny)
    result, pivots = eliminate(matrix, jnp.eye(n, dtype=matrix.dtype), tiny)
    diagonal = jnp.diagonal(matrix)
    sizes = jnp.maximum(jnp.abs(diagonal), jnp.abs(diagonal - pivots))
    # Different entries, so that a symmetric mechanism hides nothing.
    factor = jnp.linspace(1.0, 2.0, n, dtype=matrix.dtype)
    off = jnp.matmul(result, jnp.matmul(matrix, factor, precision="highest"), precision="highest") - factor
    is_good = jnp.all(jnp.abs(pivots) > _MIN_SHARE * sizes) & jnp.all(jnp.abs(off) < _MIN_SHARE)
    return mark_invalid(~is_good, result)


def _orthogonalise(w: LoopWriter, matrix, n: int, m: int, of_vector: int, of_entry: int):
    """Buffers of U = A J, column after column, and J; vector p of A begins at p of_vector, with entries of_entry apart."""
    U, J, zero = w.buffer(n * m), w.buffer(m * m), w.integer(0)
    with w.loop(zero, w.integer(m)) as p:
        with w.loop(zero, w.integer(n)) as k:
            w.b.store(w.load(w.at(matrix, (p, of_vector), (k, of_entry))), w.at(U, (p, n), (k, 1)))
        with w.loop(zero, w.integer(m)) as k:
            one = w.b.select(w.b.icmp_signed("==", p, k), w.number(1), w.number(0))
            w.b.store(one, w.at(J, (p, m), (k, 1)))
    # Rotate pairs of columns until all are orthogonal to rounding.
    b, one = w.b, w.number(1)
    eps = float(np.finfo(w.dtype).eps)
    going = w.variable(ir.IntType(1), ir.Constant(ir.IntType(1), 1))
    with w.loop(w.integer(0), w.integer(MAX_SWEEPS)) as _, b.if_then(b.load(going, typ=ir.IntType(1))):
        b.store(ir.Constant(ir.IntType(1), 0), going)
        with w.loop(w.integer(0), w.integer(m - 1)) as p, w.loop(b.add(p, w.integer(1)), w.integer(m)) as q:
            x, y = w.at(U, (p, n)), w.at(U, (q, n))
            alpha, beta, gamma = w.product(x, x, n), w.product(y, y, n), w.product(x, y, n)
            limit = b.fmul(w.number(eps), w.root(b.fmul(alpha, beta)))
            # Relative to the lengths of both columns, not to the largest: that is what keeps small singular values exact.
            with b.if_then(b.fcmp_ordered(">", w.size(gamma), limit)):
                b.store(ir.Constant(ir.IntType(1), 1), going)
                # The smaller root of t^2 + 2 zeta t - 1: rotations by at most pi/4, with which sweeps converge.
                zeta = b.fdiv(b.fsub(beta, alpha), b.fmul(w.number(2), gamma))
                length = b.fadd(w.size(zeta), w.root(b.fadd(one, b.fmul(zeta, zeta))))
                sign = b.select(b.fcmp_ordered("<", zeta, w.number(0)), w.number(-1), one)
                t = b.fdiv(sign, length)
                c = b.fdiv(one, w.root(b.fadd(one, b.fmul(t, t))))
                s = b.fmul(c, t)
                w.rotate(x, y, c, s, n)
                w.rotate(w.at(J, (p, m)), w.at(J, (q, m)), c, s, m)
    return U, J


# --- pseudo-inverses (Y^T Y)^-1 Y^T of regular matrices by loops over rows of vectors, whose code does not grow with the matr---
#
# Entries that are zero are passed over while the loops run, so that sparse matrices, such as the rows of large mechanisms, cost
# what their other entries do.


def write_normal_equations(w: LoopWriter, matrix, result, n: int, m: int, minimum: float):
    """Write the inverse (m, n) of Y (n, m), and whether it is accurate: its least pivot above `minimum` times the largest.

    Gram matrix, Cholesky factor R^T R, two triangular solutions, and a step of Newton and Schulz, which restores the accuracy of
    an orthogonal method: normal equations square the condition number.
    """
    b, zero, one, rows, last = w.b, w.integer(0), w.number(1), w.integer(m), w.integer(m - 1)
    Y, Yt, G, R, X, Z = (w.rows(*shape) for shape in ((n, m), (m, n), (m, m), (m, m), (m, n), (m, n)))
    w.copy_rows(matrix, m, 1, Y)
    w.copy_rows(matrix, 1, m, Yt)
    largest = w.variable(w.float, w.number(0))
    with w.loop(zero, rows) as i:
        own = w.at(G.memory, (i, G.stride))
        w.add_rows(own, Y, w.at(Y.memory, (i, 1)), Y.stride, zero, w.integer(n))
        square, so_far = w.load(w.at(own, (i, 1))), w.load(largest)
        b.store(b.select(b.fcmp_ordered(">", square, so_far), square, so_far), largest)
    # Columns of zeros, which are of rows that were dropped, get the largest square, so that theirs is never the least pivot.
    fill = b.select(b.fcmp_ordered(">", w.load(largest), w.number(0)), w.load(largest), one)
    maximum, fewest = w.variable(w.float, w.number(0)), w.variable(w.float, fill)
    minus, inverses = w.buffer(m), w.buffer(m)
    with w.loop(zero, rows) as i:
        own = w.at(R.memory, (i, R.stride))
        with w.loop(zero, i) as k:
            b.store(b.fneg(w.load(w.at(R.memory, (k, R.stride), (i, 1)))), w.at(minus, (k, 1)))
        w.add_rows(own, R, minus, 1, zero, i, start=w.at(G.memory, (i, G.stride)), first=i)
        at = w.at(own, (i, 1))
        pivot, square = w.load(at), w.load(w.at(G.memory, (i, G.stride), (i, 1)))
        pivot = b.select(b.fcmp_ordered("==", square, w.number(0)), fill, pivot)
        # What is not a number replaces the least, and is in all later rows.
        b.store(b.select(b.fcmp_unordered("<", pivot, w.load(fewest)), pivot, w.load(fewest)), fewest)
        b.store(b.select(b.fcmp_ordered(">", pivot, w.load(maximum)), pivot, w.load(maximum)), maximum)
        inverse = b.fdiv(one, w.root(pivot))
        b.store(inverse, w.at(inverses, (i, 1)))
        w.add_rows(own, R, minus, 1, zero, zero, start=own, scale=inverse, first=i)
        # Forward: Z = R^-T Y^T.
        w.add_rows(
            w.at(Z.memory, (i, Z.stride)), Z, minus, 1, zero, i, start=w.at(Yt.memory, (i, Yt.stride)), scale=inverse
        )
    with w.loop(zero, rows) as back:
        i = b.sub(last, back)
        factors = w.at(R.memory, (i, R.stride))
        with w.loop(b.add(i, w.integer(1)), rows) as k:
            b.store(b.fneg(w.load(w.at(factors, (k, 1)))), w.at(minus, (k, 1)))
        inverse = w.load(w.at(inverses, (i, 1)))
        own, start = w.at(X.memory, (i, X.stride)), w.at(Z.memory, (i, Z.stride))
        w.add_rows(own, X, minus, 1, b.add(i, w.integer(1)), rows, start=start, scale=inverse)
    # X + E X with E = 1 - X Y, whose transpose has the entries of Y for factors: these may be sparse, the inverse hardly is. Of E
    # what is below rounding changes nothing.
    Xt, Et = w.rows(n, m), G
    w.copy_rows(X.memory, 1, X.stride, Xt)
    eps = w.number(float(np.finfo(w.dtype).eps))
    with w.loop(zero, rows) as j:
        own = w.at(Et.memory, (j, Et.stride))
        w.add_rows(own, Xt, w.at(Y.memory, (j, 1)), Y.stride, zero, w.integer(n))
        with w.loop(zero, rows) as i:
            at = w.at(own, (i, 1))
            error = b.fsub(b.select(b.icmp_signed("==", i, j), one, w.number(0)), w.load(at))
            is_rounding = b.fcmp_ordered("<=", w.size(error), eps)
            b.store(b.select(is_rounding, w.number(0), error), at)
    with w.loop(zero, rows) as i:
        improved = w.at(Z.memory, (i, Z.stride))
        w.add_rows(improved, X, w.at(Et.memory, (i, 1)), Et.stride, zero, rows, start=w.at(X.memory, (i, X.stride)))
        with w.loop(zero, w.integer(n)) as k:
            b.store(w.load(w.at(improved, (k, 1))), w.at(result, (i, n), (k, 1)))
    return b.fcmp_ordered(">", b.fdiv(w.load(fewest), w.load(maximum)), w.number(minimum))
