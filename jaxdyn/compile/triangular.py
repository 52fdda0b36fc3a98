"""Cholesky factors and triangular solutions by loops over rows of vectors (see `normal_equations`), for matrices of any size."""

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular

from jaxdyn.compile.matrix_loops import LoopWriter, MatrixProgram


class CholeskyFactor(MatrixProgram):
    """A (n, n), of which the lower triangle is read -> its lower factor; not finite where it is not positive definite."""

    name = "cholesky_factor"

    def __init__(self, size: int, dtype):
        super().__init__(size, size, (size, size), dtype)
        self.cost = size**3 // 3 + 1

    def write(self, w: LoopWriter, matrix, result) -> None:
        """Rows of the upper factor, one after the other."""
        b, n, zero = w.b, self.rows, w.integer(0)
        A, R, factors = w.rows(n, n), w.rows(n, n), w.buffer(n)
        w.copy_rows(matrix, 1, n, A)
        with w.loop(zero, w.integer(n)) as i:
            with w.loop(zero, i) as k:
                b.store(b.fneg(w.load(w.at(R.memory, (k, R.stride), (i, 1)))), w.at(factors, (k, 1)))
                b.store(w.number(0), w.at(result, (k, n), (i, 1)))
            own, start = w.at(R.memory, (i, R.stride)), w.at(A.memory, (i, A.stride))
            w.add_rows(own, R, factors, 1, zero, i, start=start, first=i)
            inverse = b.fdiv(w.number(1), w.root(w.load(w.at(own, (i, 1)))))
            w.add_rows(own, R, factors, 1, zero, zero, start=own, scale=inverse, first=i)
            with w.loop(i, w.integer(n)) as k:
                b.store(w.load(w.at(own, (k, 1))), w.at(result, (k, n), (i, 1)))

    def compute(self, matrix):
        """The same by JAX's factor."""
        return lax.linalg.cholesky(matrix, symmetrize_input=False)


class TriangularSolution(MatrixProgram):
    """A lower triangular L (n, n) and B (n, k) -> L^-1 B, or L^-T B."""

    name = "triangular_solution"

    def __init__(self, size: int, columns: int, dtype, transposed: bool):
        super().__init__(size, size, (size, columns), dtype, other=(size, columns))
        self.transposed = transposed
        self.cost = size**2 * columns + 1

    @property
    def title(self) -> str:
        """Text that names all on which the code depends."""
        return f"{super().title}, {self.inputs[1].shape[1]} columns, {'transposed' if self.transposed else 'as it is'}"

    def write(self, w: LoopWriter, factor, right, result) -> None:
        """Rows of the solution, one after the other."""
        b, n, columns, zero, one = w.b, self.rows, self.inputs[1].shape[1], w.integer(0), w.integer(1)
        if columns == 1:
            return self._write_column(w, factor, right, result)
        B, X, factors = w.rows(n, columns), w.rows(n, columns), w.buffer(n)
        w.copy_rows(right, columns, 1, B)
        of_row, of_column = (1, n) if self.transposed else (n, 1)
        with w.loop(zero, w.integer(n)) as step:
            i = b.sub(w.integer(n - 1), step) if self.transposed else step
            begin, end = (b.add(i, one), w.integer(n)) if self.transposed else (zero, i)
            with w.loop(begin, end) as k:
                b.store(b.fneg(w.load(w.at(factor, (i, of_row), (k, of_column)))), w.at(factors, (k, 1)))
            inverse = b.fdiv(w.number(1), w.load(w.at(factor, (i, n + 1))))
            own, start = w.at(X.memory, (i, X.stride)), w.at(B.memory, (i, B.stride))
            w.add_rows(own, X, factors, 1, begin, end, start=start, scale=inverse)
            with w.loop(zero, w.integer(columns)) as k:
                b.store(w.load(w.at(own, (k, 1))), w.at(result, (i, columns), (k, 1)))

    def _write_column(self, w: LoopWriter, factor, right, result) -> None:
        """One column: its numbers one after the other, each then subtracted from those that it is in."""
        b, n, zero = w.b, self.rows, w.integer(0)
        with w.loop(zero, w.integer(n)) as i:
            b.store(w.load(w.at(right, (i, 1))), w.at(result, (i, 1)))
        with w.loop(zero, w.integer(n)) as step:
            i = b.sub(w.integer(n - 1), step) if self.transposed else step
            x = b.fdiv(w.load(w.at(result, (i, 1))), w.load(w.at(factor, (i, n + 1))))
            b.store(x, w.at(result, (i, 1)))
            begin, end = (zero, i) if self.transposed else (b.add(i, w.integer(1)), w.integer(n))
            with w.loop(begin, end) as k:
                entry = w.load(w.at(factor, (i, n), (k, 1)) if self.transposed else w.at(factor, (k, n), (i, 1)))
                at = w.at(result, (k, 1))
                b.store(b.fsub(w.load(at), b.fmul(entry, x)), at)

    def compute(self, factor, right):
        """The same by JAX's solution."""
        return solve_triangular(factor, right, lower=True, trans=int(self.transposed))


_cholesky_factor, _triangular_solution = (
    functools.lru_cache(maxsize=256)(kind) for kind in (CholeskyFactor, TriangularSolution)
)


@jax.custom_jvp
def cholesky_factor(matrix: jax.Array) -> jax.Array:
    """The lower triangular L (n, n) with L L^T = matrix, of which the lower triangle is read."""
    return _cholesky_factor(matrix.shape[0], matrix.dtype)(matrix)


@cholesky_factor.defjvp
def _cholesky_factor_jvp(primals, tangents):
    # dL = L phi(L^-1 dA L^-T), with phi the lower triangle with half of its diagonal.
    L, change = cholesky_factor(primals[0]), jnp.tril(tangents[0])
    change = change + jnp.tril(change, -1).T
    inner = triangular_solution(L, triangular_solution(L, change).T)
    half = jnp.tril(inner) - 0.5 * jnp.diag(jnp.diagonal(inner))
    return L, jnp.matmul(L, half, precision="highest")


def triangular_solution(factor: jax.Array, right: jax.Array, transposed: bool = False) -> jax.Array:
    """L^-1 right (n, k), or L^-T right, for a lower triangular L (n, n)."""

    def solve(factor, right, transposed):
        columns = right.reshape(len(right), -1)
        program = _triangular_solution(*columns.shape, columns.dtype, transposed)
        return program(factor, columns).reshape(right.shape)

    def multiply(x):
        lower = jnp.tril(factor)
        return jnp.matmul(lower.T if transposed else lower, x, precision="highest")

    constant = lax.stop_gradient(factor)
    return lax.custom_linear_solve(
        multiply,
        right,
        lambda _, x: solve(constant, x, transposed),
        lambda _, x: solve(constant, x, not transposed),
    )
