"""Kernels of one small matrix as loops over its entries, where the operations depend on the numbers: rotations and pivots.

A `MatrixProgram` stands in the place of a `Program`. As no choice is made by LAPACK, a program with such kernels can be
exported, and large batches do not wait for each other's threads.
"""

import contextlib
import hashlib

import jax
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.program import Array

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    import llvmlite.ir as ir

    INT, POINTER = ir.IntType(64), ir.PointerType()


class MatrixProgram:
    """The kernel of a matrix (rows, columns) -> one matrix of the shape `result`. Subclasses write it, and say its `cost`."""

    derivative = fallback = None
    subprograms = ()
    turns = 1
    is_called = is_kept = True
    name: str
    cost: int

    def __init__(self, rows: int, columns: int, result: tuple[int, int], dtype, tolerance: float = 0.0):
        self.rows, self.columns, self.dtype, self.tolerance = rows, columns, np.dtype(dtype), tolerance
        self.inputs, self.outputs = (Array((rows, columns), self.dtype),), (Array(result, self.dtype),)
        self.results = (tuple(range(self.outputs[0].size)),)
        self.derived: dict = {}

    def __getstate__(self):
        return vars(self) | {"derived": {}}

    def describe(self) -> "MatrixProgram":
        """Itself, as what is kept of it on disk (see `stored`)."""
        return self

    def restore(self, remake) -> "MatrixProgram":
        """The program of what is kept."""
        return self

    @property
    def title(self) -> str:
        """Shape, dtype and tolerance, on which the code depends."""
        return f"{self.name} of {self.rows} x {self.columns} {self.dtype} at {self.tolerance!r}"

    @property
    def digest(self) -> str:
        """Identity of the code, as `Program.digest`."""
        # A hash, as programs that call it make its symbol from it.
        return hashlib.sha256(self.title.encode()).hexdigest()

    def compute(self, matrix: jax.Array) -> jax.Array:
        """The result of a matrix (..., rows, columns) by operations of JAX."""
        raise NotImplementedError

    def write(self, w: "LoopWriter", matrix, result) -> None:
        """Write the operations on one sample; `matrix` and `result` are pointers to its entries, by rows."""
        raise NotImplementedError

    def _write_kernel(self) -> "LoopWriter":
        w = LoopWriter(self.dtype)
        data, _, begin, end = w.function.args
        given, result = (w.b.load(w.b.gep(data, [w.integer(i)], source_etype=POINTER), typ=POINTER) for i in range(2))
        with w.loop(begin, end) as sample:
            self.write(w, w.at(given, (sample, self.inputs[0].size)), w.at(result, (sample, self.outputs[0].size)))
        w.b.ret_void()
        w.entry.branch(w.function.blocks[1])
        return w

    def ir(self, width: int, uniform) -> str:
        """The text of the kernel (see `code.kernel_ir`)."""
        return f"; {self.title}\n{self._write_kernel().module}"

    def subprogram_ir(self, width: int) -> str:
        """The text of the function `called` (see `code.subprogram_ir`)."""
        parts = self.definition("called")
        return "\n".join(parts.values()).replace("define internal void @called(", "define void @called(")

    def definition(self, symbol: str) -> dict[str, str]:
        """`void symbol(ptr matrix, ptr result)` of one sample, and what it declares, by names in a module's text."""
        loops = f"{symbol}_loops"
        text = str(self._write_kernel().function)
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
        """The same by operations of JAX."""
        result = self.compute(array.reshape(*array.shape[:-1], self.rows, self.columns))
        return [result.reshape(*array.shape[:-1], -1)]

    def __call__(self, matrix: jax.Array) -> jax.Array:
        """The result of one matrix (rows, columns), which has no derivative: put it under a rule that gives one."""
        # A kernel even for one matrix: LAPACK called in a batched program of XLA can wait for its own threads for ever.
        is_plain = mode.current() == "plain" or target is None
        flat = matrix.reshape(-1)
        result = self.as_operations(flat) if is_plain else kernel_p.bind(flat, program=self, rows=0)
        return result[0].reshape(self.outputs[0].shape)


class LoopWriter:
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
