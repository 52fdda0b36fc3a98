"""Memory of native code: arrays on the stack and on the heap, and the order of their entries for the W samples of a vector."""

import contextlib
import re
from collections.abc import Sequence

from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import FLOATS, Array, dtype_of

_ALIGNED = 64  # bytes
# Larger arrays of a function are on the heap.
MAX_STACK_BYTES = 1 << 16


def bytes_of(array: Array, width: int) -> int:
    """Bytes of an array for W samples, rounded up to whole cache lines: vector loads are aligned."""
    return -(-array.size * array.dtype.itemsize * width // _ALIGNED) * _ALIGNED


def allocation(name: str, size: int) -> str:
    """A line that allocates memory on the stack."""
    return f"  {name} = alloca [{size} x i8], align {_ALIGNED}"


_ALLOCATION = re.compile(r"  (%\w+) = alloca \[(\d+) x i8\].*")


def on_heap(allocations: Sequence[str]) -> tuple[list[str], list[str], list[str]]:
    """Lines that allocate memory, large arrays on the heap; those that free it; and declarations.

    The stacks of XLA's threads may be as small as half a megabyte.
    """
    lines, free = [], []
    for line in allocations:
        match = _ALLOCATION.fullmatch(line)
        if match is None or int(match[2]) <= MAX_STACK_BYTES:
            lines.append(line)
            continue
        name = match[1]
        # malloc aligns to 16 bytes: vectors are aligned by hand.
        lines += [
            f"  {name}.all = call ptr @malloc(i64 {int(match[2]) + _ALIGNED})",
            f"  {name}.int = ptrtoint ptr {name}.all to i64",
            f"  {name}.up = add i64 {name}.int, {_ALIGNED - 1}",
            f"  {name}.cut = and i64 {name}.up, {-_ALIGNED}",
            f"  {name} = inttoptr i64 {name}.cut to ptr",
        ]
        free.append(f"  call void @free(ptr {name}.all)")
    return lines, free, ["declare ptr @malloc(i64)", "declare void @free(ptr)"] if free else []


def zero(e: Emitter, pointer: str, size: int) -> None:
    """Fill memory with zeros."""
    e.declared["memset"] = "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)"
    e.lines.append(f"  call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {size}, i1 false)")


def copy(e: Emitter, source: str, target: str, size: int) -> None:
    """Copy memory."""
    e.declared["memcpy"] = "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)"
    e.lines.append(f"  call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {size}, i1 false)")


def pack(e: Emitter, rows: Sequence[str], array: str, size: int, kind: str) -> None:
    """Copy the rows of all samples to an array in memory whose entries follow each other, each with its W samples."""
    first = size // e.width * e.width if kind in FLOATS else 0
    with _tiles(e, first, rows, array, kind) as (at, inside):
        for k, value in enumerate(e.load_tile(at, 0, kind)):
            e.store_at(inside, k, kind, value)
    for k in range(first, size):
        e.store_at(array, k, kind, e.load(rows, k, kind))


def unpack(e: Emitter, array: str, rows: Sequence[str], size: int, kind: str) -> None:
    """The inverse of `pack`."""
    first = size // e.width * e.width if kind in FLOATS else 0
    with _tiles(e, first, rows, array, kind) as (at, inside):
        e.store_tile(at, 0, kind, [e.load_at(inside, k, kind) for k in range(e.width)])
    for k in range(first, size):
        e.store(rows, k, kind, e.load_at(array, k, kind))


@contextlib.contextmanager
def _tiles(e: Emitter, size: int, rows: Sequence[str], array: str, kind: str):
    """A loop over W entries at a time: pointers to them in the rows, and in the array."""
    e.count += 1
    before, loop, after = (f"{name}{e.count}" for name in ("untiled", "tile", "tiled"))
    e.lines += [f"  br label %{before}", f"{before}:", f"  br label %{loop if size else after}", f"{loop}:"]
    entry = e.emit(f"phi i64 [ 0, %{before} ], [ %{loop}.next, %{loop} ]")
    offset = e.emit(f"mul i64 {entry}, {dtype_of(kind).itemsize}")
    at = [e.emit(f"getelementptr i8, ptr {row}, i64 {offset}") for row in rows]
    offset = e.emit(f"mul i64 {offset}, {e.width}")
    yield at, e.emit(f"getelementptr i8, ptr {array}, i64 {offset}")
    e.lines += [
        f"  %{loop}.next = add i64 {entry}, {e.width}",
        f"  %{loop}.more = icmp ult i64 %{loop}.next, {size}",
        f"  br i1 %{loop}.more, label %{loop}, label %{after}",
        f"{after}:",
    ]
