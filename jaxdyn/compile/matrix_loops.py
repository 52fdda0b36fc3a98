"""Kernels of one small matrix as loops over its entries, where the operations depend on the numbers: rotations and pivots.

A `MatrixProgram` stands in the place of a `Program`. As no choice is made by LAPACK, a program with such kernels can be
exported, and large batches do not wait for each other's threads.
"""

import contextlib
import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.body import MAX_STACK_BYTES
from jaxdyn.compile.code import varying_first
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.program import Array, Loops

with contextlib.suppress(ImportError):  # no kernels without llvmlite
    import llvmlite.ir as ir

    INT, POINTER = ir.IntType(64), ir.PointerType()

_VECTOR_BYTES = 64  # of the longest vectors; processors with shorter ones take several at a time
# Vectors that are summed at a time, of long rows: as many as there are registers for.
_VECTORS_AT_ONCE = 6


class MatrixProgram(Loops):
    """The kernel of a matrix (rows, columns) -> one matrix of the shape `result`. Subclasses write it, and say its `cost`.

    `other`: the shape of a second matrix that it takes, or None.
    """

    name: str
    cost: int

    def __init__(
        self,
        rows: int,
        columns: int,
        result: tuple[int, int],
        dtype,
        tolerance: float = 0.0,
        other: tuple[int, int] | None = None,
    ):
        self.rows, self.columns, self.dtype, self.tolerance = rows, columns, np.dtype(dtype), tolerance
        shapes = [(rows, columns)] if other is None else [(rows, columns), other]
        self.inputs, self.outputs = tuple(Array(x, self.dtype) for x in shapes), (Array(result, self.dtype),)
        self.results = (tuple(range(self.outputs[0].size)),)
        self.derived: dict = {}

    @property
    def title(self) -> str:
        """Shape, dtype and tolerance, on which the code depends."""
        return f"{self.name} of {self.rows} x {self.columns} {self.dtype} at {self.tolerance!r}"

    @property
    def digest(self) -> str:
        """Identity of the code, as `Program.digest`."""
        # A hash, as programs that call it make its symbol from it.
        return hashlib.sha256(self.title.encode()).hexdigest()

    def compute(self, *matrices: jax.Array) -> jax.Array:
        """The result of matrices (..., rows, columns) by operations of JAX."""
        raise NotImplementedError

    def write(self, w: "LoopWriter", *matrices_and_result) -> None:
        """Write the operations on one sample; all are pointers to entries, by rows."""
        raise NotImplementedError

    def _write_kernel(self, uniform: Sequence[bool]) -> "LoopWriter":
        w = LoopWriter(self.dtype)
        data, _, begin, end = w.function.args
        # In the order in which the kernel takes them.
        order = [*varying_first(uniform), len(uniform)]
        pointers = {
            place: w.b.load(w.b.gep(data, [w.integer(i)], source_etype=POINTER), typ=POINTER)
            for i, place in enumerate(order)
        }
        strides = [0 if same else x.size for x, same in zip(self.inputs, uniform, strict=True)]
        with w.loop(begin, end) as sample:
            places = enumerate([*strides, self.outputs[0].size])
            self.write(w, *(w.at(pointers[i], (sample, stride)) for i, stride in places))
        w.end()
        return w

    def ir(self, width: int, uniform) -> str:
        """The text of the kernel (see `code.kernel_ir`)."""
        return f"; {self.title}\n{self._write_kernel(uniform).module}"

    def subprogram_ir(self, width: int) -> str:
        """The text of the function `called` (see `code.subprogram_ir`)."""
        parts = self.definition("called")
        return "\n".join(parts.values()).replace("define internal void @called(", "define void @called(")

    def definition(self, symbol: str) -> dict[str, str]:
        """`void symbol(ptr matrix, ..., ptr result)` of one sample, and what it declares, by names in a module's text."""
        loops, count = f"{symbol}_loops", len(self.inputs) + 1
        w = self._write_kernel([False] * (count - 1))
        text = str(w.function)
        # Without "no-builtins" LLVM turns the loop that writes zeros into a call of memset, which bare metal may lack.
        text = text.replace("define void", "define internal void", 1).replace('@"kernel"', f"@{loops}", 1)
        head, brace, rest = text.partition("{")
        names = [*(f"%a{i}" for i in range(count - 1)), "%r0"]
        lines = [f"define internal void @{symbol}({', '.join(f'ptr {x}' for x in names)}) nounwind {{"]
        lines.append(f"  %data = alloca [{count} x ptr]")
        for i, name in enumerate(names):
            lines += [f"  %at{i} = getelementptr ptr, ptr %data, i64 {i}", f"  store ptr {name}, ptr %at{i}"]
        lines += [f"  call void @{loops}(ptr %data, i64 1, i64 0, i64 1)", "  ret void", "}"]
        declared = {x.name: str(x).strip() for x in w.module.functions if x is not w.function}
        return {loops: f'{head} nounwind "no-builtins" {brace}{rest}', symbol: "\n".join(lines)} | declared

    def as_operations(self, *arrays):
        """The same by operations of JAX."""
        lead = max((x.shape[:-1] for x in arrays), key=len)
        result = self.compute(
            *(jnp.broadcast_to(x, (*lead, x.shape[-1])).reshape(*lead, *given.shape)
              for x, given in zip(arrays, self.inputs, strict=True))
        )  # fmt: skip
        return [result.reshape(*lead, -1)]

    def __call__(self, *matrices: jax.Array) -> jax.Array:
        """The result of one matrix of each kind, which has no derivative: put it under a rule that gives one."""
        # A kernel even for one matrix: LAPACK called in a batched program of XLA can wait for its own threads for ever.
        is_plain = mode.current() == "plain" or target is None
        flat = [x.reshape(-1) for x in matrices]
        result = self.as_operations(*flat) if is_plain else kernel_p.bind(*flat, program=self, rows=0)
        return result[0].reshape(self.outputs[0].shape)


class LoopWriter:
    """LLVM IR with loops, columns of numbers, and sums of rows by vectors."""

    def __init__(self, dtype):
        self.module = ir.Module("pseudo_inverse")
        kind = ir.FunctionType(ir.VoidType(), (POINTER, INT, INT, INT))
        self.function = ir.Function(self.module, kind, "kernel")
        self.entry = ir.IRBuilder(self.function.append_basic_block("entry"))
        self.b = ir.IRBuilder(self.function.append_basic_block("start"))
        self.float = ir.DoubleType() if dtype == np.float64 else ir.FloatType()
        self.dtype = np.dtype(dtype)
        self.width = _VECTOR_BYTES // self.dtype.itemsize
        self.vector = ir.VectorType(self.float, self.width)
        self.on_stack, self.on_heap = 0, []

    def end(self):
        """The end of the function."""
        free = self._declared("free", ir.VoidType(), POINTER) if self.on_heap else None
        for memory in self.on_heap:
            self.b.call(free, (memory,))
        self.b.ret_void()
        self.entry.branch(self.function.blocks[1])

    def _declared(self, name: str, result, *arguments):
        return self.module.globals.get(name) or ir.Function(self.module, ir.FunctionType(result, arguments), name)

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
        size = max(1, size)
        self.on_stack += size * self.dtype.itemsize
        if self.on_stack <= MAX_STACK_BYTES:
            return self.entry.alloca(self.float, size=self.integer(size))
        # The stacks of XLA's threads may be as small as half a megabyte.
        self.on_stack -= size * self.dtype.itemsize
        malloc = self._declared("malloc", POINTER, INT)
        self.on_heap.append(self.entry.call(malloc, (self.integer(size * self.dtype.itemsize),)))
        return self.on_heap[-1]

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
        return self.b.call(self._declared(name, self.float, self.float), (x,))

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

    def rows(self, count: int, length: int) -> "PaddedRows":
        """Memory for rows of whole vectors."""
        vectors = -(-length // self.width)
        chunks = -(-vectors // _VECTORS_AT_ONCE)
        at_once = -(-vectors // chunks)
        stride = chunks * at_once * self.width
        return PaddedRows(self.buffer(count * stride), count, length, stride, at_once)

    def copy_rows(self, source, of_row: int, of_entry: int, rows: "PaddedRows"):
        """Rows with the entries of a matrix, at i of_row + k of_entry from `source`, and zeros behind them."""
        with self.loop(self.integer(0), self.integer(rows.count)) as i:
            target = self.at(rows.memory, (i, rows.stride))
            with self.loop(self.integer(0), self.integer(rows.length)) as k:
                self.b.store(self.load(self.at(source, (i, of_row), (k, of_entry))), self.at(target, (k, 1)))
            with self.loop(self.integer(rows.length), self.integer(rows.stride)) as k:
                self.b.store(self.number(0), self.at(target, (k, 1)))

    def add_rows(self, target, rows: "PaddedRows", factors, of_factor, begin, end, start=None, scale=None, first=None):
        """target = scale (start + sum of factors[k of_factor] rows[k] for k from begin to end - 1).

        Factors of zero are passed over: large mechanisms have few others. Numbers that are not finite have to show in
        another way. `first`: index of an entry before which none is needed.
        """
        b, size = self.b, rows.at_once * self.width
        chunk = self.integer(0) if first is None else b.udiv(first, self.integer(size))
        if is_long := rows.stride > size:
            # The factors that are not zero are looked for once, not for each part of the rows.
            indices, count = self.entry.alloca(INT, size=self.integer(rows.count)), self.variable(INT, self.integer(0))
            with self.loop(begin, end) as k:
                factor, so_far = self.load(self.at(factors, (k, of_factor))), b.load(count, typ=INT)
                b.store(k, b.gep(indices, [so_far]))
                is_counted = b.zext(b.fcmp_unordered("!=", factor, self.number(0)), INT)
                b.store(b.add(so_far, is_counted), count)
            begin, end = self.integer(0), b.load(count, typ=INT)
        with self.loop(chunk, self.integer(rows.stride // size)) as chunk:
            offsets = [
                b.add(b.mul(chunk, self.integer(size)), self.integer(i * self.width)) for i in range(rows.at_once)
            ]
            places = [self.variable(self.vector) for _ in offsets]
            zero = ir.Constant(self.vector, [0.0] * self.width)
            for place, offset in zip(places, offsets, strict=True):
                b.store(zero if start is None else self._load_vector(start, offset), place)
            with self.loop(begin, end) as k:
                k = b.load(b.gep(indices, [k]), typ=INT) if is_long else k
                factor = self.load(self.at(factors, (k, of_factor)))
                with b.if_then(b.fcmp_unordered("!=", factor, self.number(0))):
                    each, row = self._splat(factor), self.at(rows.memory, (k, rows.stride))
                    for place, offset in zip(places, offsets, strict=True):
                        term = b.fmul(each, self._load_vector(row, offset))
                        b.store(b.fadd(b.load(place, typ=self.vector), term), place)
            for place, offset in zip(places, offsets, strict=True):
                total = b.load(place, typ=self.vector)
                total = total if scale is None else b.fmul(total, self._splat(scale))
                b.store(total, self._vector_at(target, offset), align=self.dtype.itemsize)

    def multiply_rows(self, x, y, rows: "PaddedRows"):
        """Sum of products of two rows in memory like that of `rows`."""
        b, place = self.b, self.variable(self.vector, ir.Constant(self.vector, [0.0] * self.width))
        with self.loop(self.integer(0), self.integer(rows.stride // self.width)) as i:
            offset = b.mul(i, self.integer(self.width))
            term = b.fmul(self._load_vector(x, offset), self._load_vector(y, offset))
            b.store(b.fadd(b.load(place, typ=self.vector), term), place)
        total, width = b.load(place, typ=self.vector), self.width
        while width > 1:
            width //= 2
            undefined = ir.Constant(ir.VectorType(self.float, 2 * width), ir.Undefined)
            low, high = (
                b.shuffle_vector(
                    total, undefined, ir.Constant(ir.VectorType(ir.IntType(32), width), [*range(at, at + width)])
                )
                for at in (0, width)
            )
            total = b.fadd(low, high)
        return b.extract_element(total, ir.Constant(ir.IntType(32), 0))

    def subtract_row(self, target, row, factor, rows: "PaddedRows"):
        """target -= factor row, of rows in memory like that of `rows`."""
        b, each = self.b, self._splat(factor)
        with self.loop(self.integer(0), self.integer(rows.stride // self.width)) as i:
            offset = b.mul(i, self.integer(self.width))
            change = b.fmul(each, self._load_vector(row, offset))
            b.store(
                b.fsub(self._load_vector(target, offset), change),
                self._vector_at(target, offset),
                align=self.dtype.itemsize,
            )

    def _vector_at(self, row, offset):
        return self.b.bitcast(self.b.gep(row, [offset], source_etype=self.float), self.vector.as_pointer())

    def _load_vector(self, row, offset):
        return self.b.load(self._vector_at(row, offset), typ=self.vector, align=self.dtype.itemsize)

    def _splat(self, x):
        one = self.b.insert_element(ir.Constant(self.vector, ir.Undefined), x, ir.Constant(ir.IntType(32), 0))
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.width), [0] * self.width)
        return self.b.shuffle_vector(one, ir.Constant(self.vector, ir.Undefined), mask)


class PaddedRows(NamedTuple):
    """Rows in memory, each of `length` numbers and some more, so that its vectors are `at_once` or a multiple of it."""

    memory: Any
    count: int
    length: int
    stride: int
    at_once: int
