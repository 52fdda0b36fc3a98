"""Independent rows of a matrix by Gram-Schmidt with pivots, as a kernel: which row comes next depends on the numbers."""

import contextlib
import functools

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile.matrix_loops import LoopWriter, MatrixProgram

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    from jaxdyn.compile.matrix_loops import INT


class IndependentRows(MatrixProgram):
    """Rows (n, m), and beside each `first`, `least` and `most` -> whether it is kept, and its distance from those that are."""

    name = "independent_rows"

    def __init__(self, rows: int, columns: int, dtype):
        super().__init__(rows, columns + 3, (rows, 2), dtype)
        self.width = columns
        self.cost = 6 * min(rows, columns) * rows * columns + 1

    def write(self, w: LoopWriter, matrix, result) -> None:
        """One row after the other; the rest of each row is what the kept ones leave of it."""
        b, n, m, zero = w.b, self.rows, self.width, w.integer(0)
        rest, along, lengths = w.buffer(n * m), w.buffer(m), w.buffer(n)
        count = w.variable(w.float, w.number(0))
        with w.loop(zero, w.integer(n)) as i:
            b.store(w.number(0), w.at(result, (i, 2)))
            with w.loop(zero, w.integer(m)) as k:
                b.store(w.load(w.at(matrix, (i, m + 3), (k, 1))), w.at(rest, (i, m), (k, 1)))

        def measure():
            """Lengths of what is left of each row, and the largest."""
            most = w.variable(w.float, w.number(0))
            with w.loop(zero, w.integer(n)) as i:
                row = w.at(rest, (i, m))
                # Rounding leaves a kept row a length of eps; it must not be chosen again.
                length = b.fmul(w.root(w.product(row, row, m)), b.fsub(w.number(1), w.load(w.at(result, (i, 2)))))
                b.store(length, w.at(lengths, (i, 1)))
                with b.if_then(b.fcmp_ordered(">", length, w.load(most))):
                    b.store(length, most)
            return w.load(most)

        with w.loop(zero, w.integer(min(n, m))) as _:
            largest = measure()
            size, index = w.variable(w.float, w.number(-1)), w.variable(INT, zero)
            with w.loop(zero, w.integer(n)) as i:
                first, least = (w.load(w.at(matrix, (i, m + 3), (w.integer(m + k), 1))) for k in range(2))
                length = w.load(w.at(lengths, (i, 1)))
                is_first = b.and_(b.fcmp_ordered(">", first, w.number(0)), b.fcmp_ordered(">", length, least))
                length = b.select(is_first, b.fadd(length, largest), length)
                with b.if_then(b.fcmp_ordered(">", length, w.load(size))):
                    b.store(length, size)
                    b.store(i, index)
            row = b.load(index, typ=INT)
            least, most = (w.load(w.at(matrix, (row, m + 3), (w.integer(m + k), 1))) for k in (1, 2))
            pivot = w.load(w.at(lengths, (row, 1)))
            is_kept = b.and_(b.fcmp_ordered(">", pivot, least), b.fcmp_ordered("<", w.load(count), most))
            with b.if_then(is_kept):
                b.store(b.fadd(w.load(count), w.number(1)), count)
                b.store(w.number(1), w.at(result, (row, 2)))
                with w.loop(zero, w.integer(m)) as k:
                    b.store(b.fdiv(w.load(w.at(rest, (row, m), (k, 1))), pivot), w.at(along, (k, 1)))
                with w.loop(zero, w.integer(n)) as i:
                    other = w.at(rest, (i, m))
                    share = w.product(other, along, m)
                    with w.loop(zero, w.integer(m)) as k:
                        at = w.at(other, (k, 1))
                        b.store(b.fsub(w.load(at), b.fmul(share, w.load(w.at(along, (k, 1))))), at)
        measure()
        with w.loop(zero, w.integer(n)) as i:
            b.store(w.load(w.at(lengths, (i, 1))), w.at(result, (i, 2), (w.integer(1), 1)))

    def compute(self, matrix):
        """The same by a loop of JAX."""
        one = self._compute_one
        for _ in matrix.shape[:-2]:
            one = jax.vmap(one)
        return one(matrix)

    def _compute_one(self, matrix):
        B, (first, leasts, mosts) = matrix[:, : self.width], matrix[:, self.width :].T

        def keep_next(_, state):
            rest, kept = state
            lengths = jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept)
            row = jnp.argmax(jnp.where((first > 0) & (lengths > leasts), lengths + jnp.max(lengths), lengths))
            pivot = lengths[row]
            along = rest[row] / jnp.where(pivot > 0, pivot, jnp.ones_like(pivot))
            is_kept = (pivot > leasts[row]) & (jnp.sum(kept) < mosts[row])
            shares = jnp.matmul(rest, along, precision="highest")
            rest = jnp.where(is_kept, rest - shares[:, None] * along[None], rest)
            return rest, kept.at[row].add(is_kept.astype(B.dtype))

        rest, kept = lax.fori_loop(0, min(B.shape), keep_next, (B, jnp.zeros_like(first)))
        return jnp.stack([kept, jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept)], 1)


_independent_rows = functools.lru_cache(maxsize=256)(IndependentRows)


def independent_rows(B: jax.Array, first: jax.Array, least, most) -> tuple[jax.Array, jax.Array]:
    """Independent rows of B (n, m): a mask (n,) of 1 and 0, and the distances (n,) of the others from the span of these.

    The pivot of a row is its distance from the span of those that were kept before it. Rows with `first` (n,) = 1 come before all
    others; a row is kept where its pivot is above `least`, and `most` rows at most. Without derivatives.
    """
    numbers = [jnp.broadcast_to(jnp.asarray(x, B.dtype), first.shape) for x in (first, least, most)]
    chosen = _independent_rows(*B.shape, B.dtype)(jnp.concatenate([B, jnp.stack(numbers, 1)], 1))
    return chosen[:, 0], chosen[:, 1]
