"""Pseudo-inverses in machine code: one-sided Jacobi rotations, as loops over the columns of one sample's matrix.

Rotations J from the right make the columns of A J = U orthogonal; then A = U J^T has the pseudo-inverse J D U^T, with D one
over the squared lengths of the columns, which are the singular values, and zero for those below the tolerance. The relative
error of small singular values is that of rounding (Demmel & Veselic 1992), which bidiagonalisation does not give. As no
choice is made by LAPACK, a program with such kernels can be exported, and large batches do not wait for each other's
threads.

Source: Hestenes (1958); Golub & Van Loan, Matrix Computations, section 8.6.3.
"""

import contextlib
import functools
import hashlib

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.program import Array

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    import llvmlite.ir as ir

    INT, POINTER = ir.IntType(64), ir.PointerType()

# Sweeps converge quadratically: six to ten are enough. The bound ends those over numbers that are not finite, for which the
# test of convergence never holds.
MAX_SWEEPS = 60


class PseudoInverse:
    """The kernel of A (rows, columns) -> its pseudo-inverse; stands in the place of a `Program`."""

    derivative = fallback = None
    subprograms = ()
    turns = 1
    is_called = True

    def __init__(self, rows: int, columns: int, dtype, tolerance: float):
        self.rows, self.columns, self.dtype, self.tolerance = rows, columns, np.dtype(dtype), tolerance
        self.inputs = (Array((rows, columns), self.dtype),)
        self.outputs = (Array((columns, rows), self.dtype),)
        self.results = (tuple(range(rows * columns)),)
        self.derived: dict = {}
        self.name = "pseudo_inverse"

    @property
    def digest(self) -> str:
        """Identity of the code, as `Program.digest`."""
        # A hash, as programs that call it make its symbol from it.
        text = f"pseudo_inverse {self.rows} {self.columns} {self.dtype} {self.tolerance!r}"
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def cost(self) -> int:
        """Operations of some eight sweeps."""
        n, m = max(self.rows, self.columns), min(self.rows, self.columns)
        return 8 * m * m * (6 * n + 3 * m) // 2 + 1

    # A vector of samples would sweep until the last one of them has converged.
    def lanes(self, samples) -> int:
        """Samples need different numbers of sweeps: one after the other."""
        return 1

    def ir(self, width: int, uniform) -> str:
        """The text of the kernel (see `code.kernel_ir`)."""
        return _kernel_ir(self.rows, self.columns, self.dtype, self.tolerance)

    def definition(self, symbol: str) -> dict[str, str]:
        """`void symbol(ptr matrix, ptr inverse)` of one sample, and what it declares, by names in a module's text."""
        loops = f"{symbol}_loops"
        text = str(_write_kernel(self.rows, self.columns, self.dtype, self.tolerance).function)
        # Without "no-builtins" LLVM turns the loop that writes zeros into a call of memset, which bare metal may lack.
        text = text.replace("define void", "define internal void", 1).replace('@"kernel"', f"@{loops}", 1)
        head, brace, rest = text.partition("{")
        call = f"""define internal void @{symbol}(ptr %a0, ptr %r0) nounwind {{
  %data = alloca [2 x ptr]
  store ptr %a0, ptr %data
  %second = getelementptr ptr, ptr %data, i64 1
  store ptr %r0, ptr %second
  call void @{loops}(ptr %data, i64 1, i64 0, i64 1)
  ret void
}}"""
        suffix = "f64" if self.dtype == np.float64 else "f32"
        kind = "double" if self.dtype == np.float64 else "float"
        root = f"llvm.sqrt.{suffix}"
        return {
            loops: f'{head} nounwind "no-builtins" {brace}{rest}',
            symbol: call,
            root: f"declare {kind} @{root}({kind})",
        }

    def as_operations(self, array):
        """The same by JAX's singular value decomposition."""
        matrix = array.reshape(*array.shape[:-1], self.rows, self.columns)
        U, s, Vt = jnp.linalg.svd(matrix, full_matrices=False)
        # A double where: one over a dropped value would be infinite, and its product with zero NaN.
        drop = s <= self.tolerance * s[..., :1]
        inverse = jnp.where(drop, jnp.zeros_like(s), 1 / jnp.where(drop, jnp.ones_like(s), s))
        entries = jnp.matmul(
            jnp.swapaxes(Vt, -1, -2) * inverse[..., None, :], jnp.swapaxes(U, -1, -2), precision="highest"
        )
        return [entries.reshape(*array.shape[:-1], self.columns * self.rows)]


@functools.lru_cache(maxsize=256)
def pseudo_inverse_program(rows: int, columns: int, dtype, tolerance: float) -> PseudoInverse:
    """One for each shape, so that programs of JAX are found again."""
    return PseudoInverse(rows, columns, dtype, tolerance)


class _Writer:
    """LLVM IR with loops and columns of numbers."""

    def __init__(self, dtype):
        self.module = ir.Module("pseudo_inverse")
        kind = ir.FunctionType(ir.VoidType(), (POINTER, INT, INT, INT))
        self.function = ir.Function(self.module, kind, "kernel")
        self.entry = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.b = ir.IRBuilder(self.function.append_basic_block("start"))
        self.float = ir.DoubleType() if dtype == np.float64 else ir.FloatType()
        self.dtype = np.dtype(dtype)

    def number(self, value):
        return ir.Constant(self.float, value)

    def integer(self, value):
        return ir.Constant(INT, value)

    def variable(self, kind, value=None):
        place = self.entry.alloca(kind)
        if value is not None:
            self.b.store(value, place)
        return place

    def buffer(self, size: int):
        return self.entry.alloca(self.float, size=self.integer(max(1, size)))

    def at(self, pointer, *index_and_stride):
        """Address of entry sum of index times stride."""
        total = self.integer(0)
        for index, stride in index_and_stride:
            total = self.b.add(total, self.b.mul(index, self.integer(stride)))
        return self.b.gep(pointer, [total], source_etype=self.float)

    def load(self, place):
        return self.b.load(place, typ=self.float)

    @contextlib.contextmanager
    def loop(self, start, end):
        """For i from start to end - 1."""
        b, function = self.b, self.function
        head, body, out = (function.append_basic_block() for _ in range(3))
        before = b.block
        b.branch(head)
        b.position_at_end(head)
        i = b.phi(INT)
        i.add_incoming(start, before)
        b.cbranch(b.icmp_signed("<", i, end), body, out)
        b.position_at_end(body)
        yield i
        i.add_incoming(b.add(i, self.integer(1)), b.block)
        b.branch(head)
        b.position_at_end(out)

    def root(self, x):
        name = f"llvm.sqrt.{'f64' if self.dtype == np.float64 else 'f32'}"
        function = self.module.globals.get(name) or ir.Function(
            self.module, ir.FunctionType(self.float, (self.float,)), name
        )
        return self.b.call(function, (x,))

    def size(self, x):
        return self.b.select(self.b.fcmp_ordered("<", x, self.number(0)), self.b.fneg(x), x)

    def product(self, x, y, length: int):
        """Sum of products of two columns."""
        total = self.variable(self.float, self.number(0))
        with self.loop(self.integer(0), self.integer(length)) as k:
            term = self.b.fmul(self.load(self.at(x, (k, 1))), self.load(self.at(y, (k, 1))))
            self.b.store(self.b.fadd(self.load(total), term), total)
        return self.load(total)

    def rotate(self, x, y, c, s, length: int):
        """(x, y) <- (c x - s y, s x + c y)."""
        b = self.b
        with self.loop(self.integer(0), self.integer(length)) as k:
            at_x, at_y = self.at(x, (k, 1)), self.at(y, (k, 1))
            first, second = self.load(at_x), self.load(at_y)
            b.store(b.fsub(b.fmul(c, first), b.fmul(s, second)), at_x)
            b.store(b.fadd(b.fmul(s, first), b.fmul(c, second)), at_y)


def _kernel_ir(rows: int, columns: int, dtype, tolerance: float) -> str:
    shapes = f"; pseudo-inverse of {rows} x {columns} {dtype} at {tolerance!r}\n"
    return shapes + str(_write_kernel(rows, columns, dtype, tolerance).module)


def _write_kernel(rows: int, columns: int, dtype, tolerance: float) -> "_Writer":
    n, m = max(rows, columns), min(rows, columns)
    w = _Writer(dtype)
    data, _, begin, end = w.function.args
    U, J, zero = w.buffer(n * m), w.buffer(m * m), w.integer(0)
    given, result = (w.b.load(w.b.gep(data, [w.integer(i)], source_etype=POINTER), typ=POINTER) for i in range(2))
    with w.loop(begin, end) as sample:
        matrix = w.at(given, (sample, n * m))
        inverse = w.at(result, (sample, n * m))
        # The smaller side is made orthogonal: rotations of m vectors of length n >= m cost n m^2 a sweep.
        # Columns of the matrix, or its rows where there are fewer of them, one after the other.
        of_column, of_row = (1, columns) if rows >= columns else (columns, 1)
        with w.loop(zero, w.integer(m)) as p:
            with w.loop(zero, w.integer(n)) as k:
                w.b.store(w.load(w.at(matrix, (p, of_column), (k, of_row))), w.at(U, (p, n), (k, 1)))
            with w.loop(zero, w.integer(m)) as k:
                one = w.b.select(w.b.icmp_signed("==", p, k), w.number(1), w.number(0))
                w.b.store(one, w.at(J, (p, m), (k, 1)))
        _sweeps(w, U, J, n, m)
        _write_inverse(
            w, U, J, inverse, n, m, tolerance, of_column=n if rows >= columns else 1, of_row=1 if rows >= columns else m
        )
    w.b.ret_void()
    w.entry.branch(w.function.blocks[1])
    return w


def _sweeps(w: _Writer, U, J, n: int, m: int) -> None:
    """Rotate pairs of columns until all are orthogonal to rounding."""
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


def _write_inverse(w: _Writer, U, J, inverse, n: int, m: int, tolerance: float, of_column: int, of_row: int) -> None:
    """J D U^T, entry (i, k) at i of_column + k of_row."""
    b, zero = w.b, w.integer(0)
    sizes, largest = w.buffer(m), w.variable(w.float, w.number(0))
    with w.loop(zero, w.integer(m)) as p:
        x = w.at(U, (p, n))
        square = w.product(x, x, n)
        b.store(square, w.at(sizes, (p, 1)))
        so_far = w.load(largest)
        # Written so that NaN becomes the largest, and no column is dropped for a comparison with it.
        b.store(b.select(b.fcmp_ordered("<", square, so_far), so_far, square), largest)
    limit = b.fmul(w.number(tolerance * tolerance), w.load(largest))
    with w.loop(zero, w.integer(n * m)) as k:
        b.store(w.number(0), w.at(inverse, (k, 1)))
    with w.loop(zero, w.integer(m)) as p:
        square = w.load(w.at(sizes, (p, 1)))
        # What is not a number is not dropped, so that it is seen in the result.
        with b.if_then(b.not_(b.fcmp_ordered("<=", square, limit))):
            with w.loop(zero, w.integer(m)) as i:
                weight = b.fdiv(w.load(w.at(J, (p, m), (i, 1))), square)
                with w.loop(zero, w.integer(n)) as k:
                    at = w.at(inverse, (i, of_column), (k, of_row))
                    b.store(b.fadd(w.load(at), b.fmul(weight, w.load(w.at(U, (p, n), (k, 1))))), at)


def pseudo_inverse_by_rotations(matrix: jax.Array, tolerance: float) -> jax.Array:
    """The pseudo-inverse (m, n) of a matrix (n, m), singular values up to `tolerance` times the largest taken for zero.

    It has no derivative: put it under a rule that gives one.
    """
    program = pseudo_inverse_program(*matrix.shape, matrix.dtype, float(tolerance))
    # A kernel even for one matrix: LAPACK called in a batched program of XLA can wait for its own threads for ever.
    if mode.current() == "plain" or target is None:
        return program.as_operations(matrix.reshape(-1))[0].reshape(matrix.shape[::-1])
    return kernel_p.bind(matrix.reshape(-1), program=program, rows=0)[0].reshape(matrix.shape[::-1])
