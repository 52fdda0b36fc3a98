"""Elimination: independent rows by Gram-Schmidt with pivots, as a kernel of loops, and solutions without exchange of rows."""

import contextlib
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile import mode
from jaxdyn.compile.kernels import kernel
from jaxdyn.compile.matrix_loops import LoopWriter, MatrixProgram

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    from jaxdyn.compile.matrix_loops import INT

from jax.scipy.linalg import solve_triangular

# Unknowns up to which an elimination is written out.
_MAX_WRITTEN_OUT = 24
# Rows of a matrix up to which its Cholesky factor is written out, with several samples in a vector: operations grow as the cube.
# Loops over its rows are as fast from 40 rows on, and compile in a tenth of the time.
_MAX_FACTORED = 32
# Rows whose distances differ by less than this part are equally far.
_ALIKE = 1e-3


class IndependentRows(MatrixProgram):
    """Rows (n, m), and beside each `first`, `minimum` and `maximum` -> three numbers a row.

    These are whether it is kept, its distance from the rows that are, and, of one that is kept, its pivot, else zero.
    """

    name = "independent_rows"

    def __init__(self, rows: int, columns: int, dtype):
        super().__init__(rows, columns + 3, (rows, 3), dtype)
        self.width = columns
        self.cost = 6 * min(rows, columns) * rows * columns + 1

    def write(self, w: LoopWriter, matrix, result) -> None:
        """One row after the other; the rest of each row is what the kept ones leave of it."""
        b, n, m, zero = w.b, self.rows, self.width, w.integer(0)
        rows, lengths, orders = w.rows(n, m), w.buffer(n), w.buffer(n)
        rest, stride, along = rows.memory, rows.stride, w.rows(1, m).memory
        count = w.variable(w.float, w.number(0))
        with w.loop(zero, w.integer(n)) as i:
            for k in range(3):
                b.store(w.number(0), w.at(result, (i, 3), (w.integer(k), 1)))
        w.copy_rows(matrix, m + 3, 1, rows)

        def enlarge(maximum, x):
            """Store the larger one; what is not a number stays, as in JAX."""
            with b.if_then(b.or_(b.fcmp_ordered(">", x, w.load(maximum)), b.fcmp_unordered("uno", x, x))):
                b.store(x, maximum)

        def measure():
            """Lengths of what is left of each row, and the largest."""
            maximum = w.variable(w.float, w.number(0))
            with w.loop(zero, w.integer(n)) as i:
                row = w.at(rest, (i, stride))
                # Rounding leaves a kept row a length of eps; it must not be chosen again.
                length = b.fmul(
                    w.root(w.multiply_rows(row, row, rows)), b.fsub(w.number(1), w.load(w.at(result, (i, 3))))
                )
                b.store(length, w.at(lengths, (i, 1)))
                enlarge(maximum, length)
            return w.load(maximum)

        with w.loop(zero, w.integer(min(n, m))) as _:
            largest = measure()
            size, index, is_found = w.variable(w.float, w.number(-1)), w.variable(INT, zero), w.variable(INT, zero)
            with w.loop(zero, w.integer(n)) as i:
                first, minimum = (w.load(w.at(matrix, (i, m + 3), (w.integer(m + k), 1))) for k in range(2))
                length = w.load(w.at(lengths, (i, 1)))
                is_first = b.and_(b.fcmp_ordered(">", first, w.number(0)), b.fcmp_ordered(">", length, minimum))
                length = b.select(is_first, b.fadd(length, largest), length)
                b.store(length, w.at(orders, (i, 1)))
                enlarge(size, length)
            bound = b.fmul(w.number(1 - _ALIKE), w.load(size))
            with w.loop(zero, w.integer(n)) as i:
                is_far = b.fcmp_ordered(">=", w.load(w.at(orders, (i, 1))), bound)
                with b.if_then(b.and_(is_far, b.icmp_signed("==", b.load(is_found, typ=INT), zero))):
                    b.store(w.integer(1), is_found)
                    b.store(i, index)
            row = b.load(index, typ=INT)
            minimum, maximum = (w.load(w.at(matrix, (row, m + 3), (w.integer(m + k), 1))) for k in (1, 2))
            pivot = w.load(w.at(lengths, (row, 1)))
            is_kept = b.and_(b.fcmp_ordered(">", pivot, minimum), b.fcmp_ordered("<", w.load(count), maximum))
            with b.if_then(is_kept):
                b.store(b.fadd(w.load(count), w.number(1)), count)
                b.store(w.number(1), w.at(result, (row, 3)))
                b.store(pivot, w.at(result, (row, 3), (w.integer(2), 1)))
                with w.loop(zero, w.integer(stride)) as k:
                    b.store(b.fdiv(w.load(w.at(rest, (row, stride), (k, 1))), pivot), w.at(along, (k, 1)))
                with w.loop(zero, w.integer(n)) as i:
                    other = w.at(rest, (i, stride))
                    w.subtract_row(other, along, w.multiply_rows(other, along, rows), rows)
        measure()
        with w.loop(zero, w.integer(n)) as i:
            b.store(w.load(w.at(lengths, (i, 1))), w.at(result, (i, 3), (w.integer(1), 1)))

    def compute(self, matrix):
        """The same by a loop of JAX."""
        one = self._compute_one
        for _ in matrix.shape[:-2]:
            one = jax.vmap(one)
        return one(matrix)

    def _compute_one(self, matrix):
        B, (first, leasts, mosts) = matrix[:, : self.width], matrix[:, self.width :].T

        def keep_next(_, state):
            rest, kept, pivots = state
            lengths = jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept)
            order = jnp.where((first > 0) & (lengths > leasts), lengths + jnp.max(lengths), lengths)
            # Rows of symmetric mechanisms are equally far but for rounding, which differs between programs: the first counts.
            row = jnp.argmax(order >= (1 - _ALIKE) * jnp.max(order))
            pivot = lengths[row]
            along = rest[row] / jnp.where(pivot > 0, pivot, jnp.ones_like(pivot))
            is_kept = (pivot > leasts[row]) & (jnp.sum(kept) < mosts[row])
            shares = jnp.matmul(rest, along, precision="highest")
            rest = jnp.where(is_kept, rest - shares[:, None] * along[None], rest)
            pivots = pivots.at[row].add(jnp.where(is_kept, pivot, jnp.zeros_like(pivot)))
            return rest, kept.at[row].add(is_kept.astype(B.dtype)), pivots

        none = jnp.zeros_like(first)
        rest, kept, pivots = lax.fori_loop(0, min(B.shape), keep_next, (B, none, none))
        return jnp.stack([kept, jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept), pivots], 1)


_independent_rows = functools.lru_cache(maxsize=256)(IndependentRows)


def eliminate_rows(B: jax.Array, first: jax.Array, minimum, maximum) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Independent rows of B (n, m) by elimination with pivots.

    The pivot of a row is its distance from the span of those that were kept before it. Rows with `first` (n,) = 1 come before
    all others, and of rows that are equally far the first one. A row is kept where its pivot is above `minimum`, and
    `maximum` rows at most.

    **Returns:** a mask (n,) of 1 and 0, the distances (n,) of the others from the span of these, and the pivots (n,) of these.
    None has a derivative.
    """
    numbers = [jnp.broadcast_to(jnp.asarray(x, B.dtype), first.shape) for x in (first, minimum, maximum)]
    chosen = _independent_rows(*B.shape, B.dtype)(jnp.concatenate([B, jnp.stack(numbers, 1)], 1))
    return chosen[:, 0], chosen[:, 1], chosen[:, 2]


def eliminate(matrix: jax.Array, right: jax.Array, minimum: float) -> tuple[jax.Array, jax.Array]:
    """Solution of matrix x = right (n, k) by elimination without exchange of rows, and the pivots (n,).

    A pivot whose size is at most `minimum` is replaced by it. Many unknowns are eliminated by a loop: the operations of what is
    written out grow with their third power.
    """
    n = len(matrix)
    if n > _MAX_WRITTEN_OUT:
        # Two carries: of a derivative the right side alone is linear.
        (_, right), pivots = lax.scan(functools.partial(_clear_column, minimum), (matrix, right), None, n)
        return right, pivots
    rows, pivots = [], []
    for _ in range(n):
        pivot = matrix[0, 0]
        pivots.append(pivot)
        inverse = 1 / jnp.where(jnp.abs(pivot) > minimum, pivot, minimum)
        rows.append((inverse, matrix[0, 1:], right[0]))
        share = matrix[1:, :1] * inverse
        matrix, right = matrix[1:, 1:] - share * matrix[:1, 1:], right[1:] - share * right[:1]
    solution = jnp.zeros((0, right.shape[1]), right.dtype)
    for inverse, row, value in reversed(rows):
        rest = value - jnp.matmul(row, solution, precision="highest") if row.shape[0] else value
        solution = jnp.concatenate([(rest * inverse)[None], solution])
    return solution, jnp.stack(pivots)


def solver_of(matrix: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """Function that maps right sides (n, k) to the solutions of a regular system, with derivatives of all orders.

    Elimination without exchange of rows, as for `eliminate`.
    """
    inverse = None
    if len(matrix) > _MAX_WRITTEN_OUT:
        # Products transpose well. A loop that eliminates would keep the matrix of each of its steps.
        unit = jnp.eye(len(matrix), dtype=matrix.dtype)
        inverse = lax.stop_gradient(eliminate(matrix, unit, float(jnp.finfo(matrix.dtype).eps))[0])
    return functools.partial(_solve_regular, inverse, matrix)


@jax.custom_jvp
def _solve_regular(inverse, matrix, right):
    if inverse is None:
        return eliminate(matrix, right, float(jnp.finfo(matrix.dtype).eps))[0]
    return jnp.matmul(inverse, right, precision="highest")


@_solve_regular.defjvp
def _solve_regular_jvp(primals, tangents):
    # The derivative of the operations would be that of each pivot, most of which cancels.
    solution = _solve_regular(*primals)
    rest = tangents[2] - jnp.matmul(tangents[1], solution, precision="highest")
    return solution, _solve_regular(*primals[:2], rest)


def _clear_column(minimum: float, state, _):
    """A step of Gauss and Jordan on the first row and column, which become the last ones; after n of them all are in place."""
    matrix, right = state
    pivot = matrix[0, 0]
    scale = jnp.where(jnp.abs(pivot) > minimum, pivot, minimum)
    row, value = matrix[:1, 1:] / scale, right[:1] / scale
    rest = jnp.concatenate([matrix[1:, 1:] - matrix[1:, :1] * row, row])
    # The first column is zero from here on, and is not read again.
    rest = jnp.concatenate([rest, jnp.zeros_like(matrix[:, :1])], 1)
    return (rest, jnp.concatenate([right[1:] - matrix[1:, :1] * value, value])), pivot


# --- Cholesky factors and triangular solutions ---
#
# Inside of a kernel they are written in their place, where the zeros of the matrix are known. By themselves they are kernels, and
# where the matrix is large, loops over rows of vectors.


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


def cholesky_factor(matrix: jax.Array) -> jax.Array:
    """The lower triangular L (n, n) with L L^T = matrix, of which the lower triangle is read; NaN where it is not definite."""
    if mode.is_expanding():
        return _factor(None, matrix)
    return kernel(_factor)(None, matrix) if len(matrix) <= _MAX_FACTORED else _factor_by_loops(matrix)


def _factor(_, matrix):
    # Without symmetrisation derivatives and operations are those of the lower triangle alone.
    return lax.linalg.cholesky(matrix, symmetrize_input=False)


@jax.custom_jvp
def _factor_by_loops(matrix):
    return _cholesky_factor(matrix.shape[0], matrix.dtype)(matrix)


@_factor_by_loops.defjvp
def _factor_by_loops_jvp(primals, tangents):
    # dL = L phi(L^-1 dA L^-T), with phi the lower triangle with half of its diagonal.
    L, change = _factor_by_loops(primals[0]), jnp.tril(tangents[0])
    change = change + jnp.tril(change, -1).T
    inner = triangular_solution(L, triangular_solution(L, change).T)
    half = jnp.tril(inner) - 0.5 * jnp.diag(jnp.diagonal(inner))
    return L, jnp.matmul(L, half, precision="highest")


def triangular_solution(factor: jax.Array, right: jax.Array, transposed: bool = False) -> jax.Array:
    """L^-1 right (n, ...), or L^-T right, for a lower triangular L (n, n)."""
    if mode.is_expanding():
        return _solve(transposed, None, factor, right)
    is_large = max(factor.size, right.size) > _MAX_FACTORED**2
    return (
        _solve_by_loops(factor, right, transposed)
        if is_large
        else kernel(_solve, static=1)(transposed, None, factor, right)
    )


def _solve(transposed: bool, _, factor, right):
    return solve_triangular(factor, right, lower=True, trans=int(transposed))


def _solve_by_loops(factor, right, transposed: bool):
    def solve(factor, right, transposed):
        columns = right.reshape(len(right), -1)
        program = _triangular_solution(*columns.shape, columns.dtype, transposed)
        return program(factor, columns).reshape(right.shape)

    def multiply(x):
        lower = jnp.tril(factor)
        return jnp.matmul(lower.T if transposed else lower, x, precision="highest")

    constant = lax.stop_gradient(factor)
    return lax.custom_linear_solve(
        multiply, right, lambda _, x: solve(constant, x, transposed), lambda _, x: solve(constant, x, not transposed)
    )
