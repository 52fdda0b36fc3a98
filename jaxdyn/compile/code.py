"""The text of kernels: from a program of numbers to LLVM's intermediate representation.

A kernel is `void kernel(ptr data, i64 n, i64 begin, i64 end)`: `data` points to the arguments, first those that have a row of
numbers per sample, then those that are uniform, one row for all samples, and then to the results; samples begin .. end - 1 of n
are computed, W at a time. Where fewer than W remain, the last sample fills the other elements of the vectors.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxdyn.compile import careful
from jaxdyn.compile.body import (
    MIN_ENTRIES_IN_LOOP,
    Body,
    allocation,
    bytes_of,
    copy_bytes,
    fill_zeros,
    has_loop,
    on_heap,
    pack,
    unpack,
)
from jaxdyn.compile.listing import Listing
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import FLOATS, Array, Program, kind_of

# Operations from which on a program is a listing, and those of one that calls loops: arithmetic on the arrays that loops take and
# return is written out entry by entry, and LLVM takes longer for operations on memory than for others.
MIN_LISTED_OPERATIONS, MIN_LISTED_BESIDE_LOOPS = 60_000, 40_000
# Those from which on it is one until LLVM has compiled it: at its lowest level that takes a fifth of a second.
MIN_QUICK_OPERATIONS = 5_000
ATTRIBUTES = (
    # LLVM's simplifications of calls of the C library, such as pow(x, 2) = x x, are made at some levels alone.
    'attributes #0 = { nounwind "no-builtins" }',
    "attributes #1 = { nounwind willreturn memory(none) }",
)


def has_table(program: Program, is_quick: bool = False) -> bool:
    """Decide whether the operations of a program are data of its code, or of that which runs until the other is there."""
    count = sum(op not in ("input", "part") for op, _, _ in program.operations)
    if is_quick:
        return count > MIN_QUICK_OPERATIONS
    return count > (MIN_LISTED_BESIDE_LOOPS if any(map(has_loop, program.subprograms)) else MIN_LISTED_OPERATIONS)


def body_of(e: Emitter, program: Program, load: Callable, array: Callable, is_quick: bool = False) -> Body:
    """The operations of a program as code, or as data of a loop where they are too many.

    `is_quick`: whether code is wanted that compiles quickly.
    """
    return (Listing if has_table(program, is_quick) else Body)(e, program, load, array)


def subprogram_ir(called: Program, width: int, is_quick: bool = False) -> str:
    """The text of a subprogram, the function `called`."""
    e = Emitter(width)
    body = body_of(
        e, called, lambda place, entry, kind: e.load_at(f"%a{place}", entry, kind), lambda place: f"%a{place}", is_quick
    )
    body.compute()
    for i, (row, array) in enumerate(zip(called.results, called.outputs, strict=True)):
        pointer = body.pointer_to(row, array)
        if pointer is not None and len(row) >= MIN_ENTRIES_IN_LOOP:
            copy_bytes(e, pointer, f"%r{i}", array.size * array.dtype.itemsize * width)
            continue
        for k, x in enumerate(row):
            e.store_at(f"%r{i}", k, kind_of(array.dtype), body.text(x, kind_of(array.dtype)))
    names = [f"%a{i}" for i in range(len(called.inputs))] + [f"%r{i}" for i in range(len(called.outputs))]
    head = f"define void @called({', '.join(f'ptr noalias {name}' for name in names)}) #0 {{"
    allocations, free, declared = on_heap(body.allocations())
    lines = [head, *allocations, *e.lines, *free, "  ret void", "}"]
    return "\n".join([*lines, *declared, *e.declared.values(), *ATTRIBUTES])


def varying_first(uniform: Sequence[bool]) -> list[int]:
    """The order in which a kernel takes the arguments of its program."""
    # XLA partitions a call as its first argument is partitioned: it is one of the batch.
    return sorted(range(len(uniform)), key=lambda i: uniform[i])


def kernel_ir(program: Program, width: int, uniform: Sequence[bool], is_quick: bool = False) -> str:
    """The text of a kernel; `uniform` says which arguments are the same for all samples. `is_quick` as of `body_of`."""
    e = Emitter(width)
    count, fast = len(program.inputs), program.fast or program
    arrays = [*program.inputs, *program.outputs]
    # The careful program of a pair reads rows of the caller's memory: nothing is loaded for it.
    entries = {args for op, _, args in fast.operations if op == "input"}
    read = {place for place, _ in entries}
    places = [i for i in range(len(arrays)) if i >= count or (i in read and not uniform[i])]
    rows = e.rows(places, [arrays[i].size * arrays[i].dtype.itemsize for i in places])
    tiles: dict[tuple[int, int], list[str]] = {}

    def load(place, entry, kind):
        if uniform[place]:
            return e.load_for_all(place, entry, kind)
        first = entry - entry % width
        # A tile is W vector loads and their transpose. It pays where at least half of its entries are read.
        wanted = [(place, k) in entries for k in range(first, first + width)]
        if width == 1 or kind not in FLOATS or first + width > arrays[place].size or 2 * sum(wanted) < width:
            return e.load(rows[place], entry, kind)
        if (place, first) not in tiles:
            tiles[place, first] = e.load_tile(rows[place], first, kind)
        return tiles[place, first][entry - first]

    packed: dict[int, str] = {}

    def array(place):
        """The row of one sample, or what has been packed."""
        if width > 1:
            return packed.get(place)
        return rows[place][0] if place in rows else f"%a{place}"

    allocations, body = [], body_of(e, fast, load, array, is_quick)
    for place in body.arrays_in_memory() if width > 1 else ():
        packed[place], given = f"%packed{place}", arrays[place]
        allocations.append(allocation(packed[place], bytes_of(given, width)))
        source = [f"%a{place}"] * width if uniform[place] else rows[place]
        pack(e, source, packed[place], given.size, kind_of(given.dtype))
    body.compute()
    for i, (row, output) in enumerate(zip(fast.results, program.outputs, strict=False)):
        kind, pointer = kind_of(output.dtype), body.pointer_to(row, output)
        if pointer is not None and len(row) >= MIN_ENTRIES_IN_LOOP:
            unpack(e, pointer, rows[count + i], len(row), kind)
        else:
            e.store_array(rows[count + i], kind, [body.text(x, kind) for x in row])
    if program.careful is not None:
        flag = e.operation("not", "b1", [body.text(fast.results[-1][0], "b1")], "b1")
        same = [*uniform, *[False] * len(program.outputs)]
        places = [(f"%a{i}", 0 if same[i] else x.size * x.dtype.itemsize) for i, x in enumerate(arrays)]
        body.careful = max(body.careful, careful.write_call_of_rows(e, program.careful, flag, places))
    # Arguments that are not read are not in the code, but the handler checks their sizes, so that the hash covers them.
    sizes = " ".join(
        f"{'same' if i < count and uniform[i] else 'each'}:{x.size}x{x.dtype}" for i, x in enumerate(arrays)
    )
    return wrap_kernel(e, f"{count} {sizes}", uniform, len(program.outputs), [*allocations, *body.allocations()])


def wrap_kernel(e: Emitter, title: str, uniform: Sequence[bool], outputs: int, allocations: Sequence[str]) -> str:
    """The text of a whole kernel around the lines that `e` holds for the W samples from %base on, which may have labels.

    `uniform` says which arguments are the same for all samples; so many `outputs` follow them. `title` is a comment on top, and
    part of what is hashed.
    """
    pointers = []
    for at, i in enumerate([*varying_first(uniform), *range(len(uniform), len(uniform) + outputs)]):
        pointers += [f"  %p{i} = getelementptr ptr, ptr %data, i64 {at}", f"  %a{i} = load ptr, ptr %p{i}"]
    lines, free, declared = on_heap(allocations)
    return "\n".join(
        [
            f"; {title}",
            "define void @kernel(ptr %data, i64 %n, i64 %begin, i64 %end) #0 {",
            "entry:",
            *lines,
            *pointers,
            "  %last = sub i64 %n, 1",
            "  %some = icmp ult i64 %begin, %end",
            "  br i1 %some, label %block, label %done",
            "block:",
            "  %base = phi i64 [ %begin, %entry ], [ %next, %following ]",
            *e.lines,
            "  br label %following",
            "following:",
            f"  %next = add i64 %base, {e.width}",
            "  %more = icmp ult i64 %next, %end",
            "  br i1 %more, label %block, label %done",
            "done:",
            *free,
            "  ret void",
            "}",
            *declared,
            *e.declared.values(),
            *ATTRIBUTES,
        ]
    )


# --- the text of scans (see `scan`): LLVM's intermediate representation of a loop around the program of an iteration ---
#
# Carries are in memory. An iteration reads the slot of its parent and writes its own; of a chain both are one slot. Slots are
# used again once the last child has read them, so that a tree in depth-first order needs few. Inward, a slot holds the sum over
# the children that have been computed, and is zero before the first of them.


def find_slots(parents: Sequence[int]) -> tuple[int, list[int]]:
    """Number of slots, and the slot of the root and then of each iteration: one is free after its last child."""
    last = {parent: i for i, parent in enumerate(parents)}
    free: list[int] = []
    slots, count = [0], 1
    for i, parent in enumerate(parents):
        if last[parent] == i:
            free.append(slots[parent + 1])
        if not free:
            free.append(count)
            count += 1
        slots.append(free.pop())
        if i not in last:
            free.append(slots[-1])
    return count, slots


class ScanText:
    """The text of the function `symbol` of a scan."""

    def __init__(self, scan: Any, width: int, symbol: str):
        self.scan, self.width, self.symbol, self.e = scan, width, symbol, Emitter(width)
        self.consts, self.carries, self.rows, self.tables = scan.split_inputs(scan.body.inputs)
        self.places = scan.split_inputs(range(len(scan.body.inputs)))
        offsets = np.cumsum([0, *(bytes_of(x, width) for x in self.carries)]).tolist()
        self.offsets, self.slot_bytes = offsets[:-1], max(64, offsets[-1])
        self.slots = None if scan.parents is None else find_slots(scan.parents)

    def function(self) -> str:
        """All of it."""
        scan, e = self.scan, self.e
        head, foot = "%step", "%row"
        count = 1 if self.slots is None else self.slots[0]
        allocations = [allocation("%slots", count * self.slot_bytes)]
        self._start(count)
        e.lines += ["  br label %start", "start:", "  br label %loop", "loop:"]
        e.lines.append(f"  {head} = phi i64 [ 0, %start ], [ %following, %latch ]")
        e.lines.append(
            f"  {foot} = sub i64 {scan.length - 1}, {head}" if scan.inward else f"  {foot} = add i64 {head}, 0"
        )
        own, parent = self._slot_pointers()
        read, write = (own, parent) if scan.inward else (parent, own)
        self.pointers = [f"%a{i}" for i in range(len(self.consts))]
        self.pointers += [e.emit(f"getelementptr i8, ptr {read}, i64 {x}") for x in self.offsets]
        first = len(self.consts) + len(self.carries)
        self.pointers += [self._row(f"%a{first + j}", x) for j, x in enumerate(self.rows)]
        self.pointers += [self._table_row(j, x) for j, x in enumerate(scan.tables)]
        if scan.condition is not None:
            self.until = Body(e, scan.condition, self._load, self._array)
            ((flag,),) = self.until.results()
            e.lines += [f"  br i1 {e.any(flag)}, label %turn, label %end", "turn:"]
        body = Body(e, scan.body, self._load, self._array)
        carries, sums, results = scan.split_outputs(body.results())
        types = scan.split_outputs(scan.body.outputs)
        first = len(types[0]) + len(types[1])
        for j, (row, array) in enumerate(zip(results, types[2], strict=True)):
            self._store(self._row(f"%r{first + j}", array), array, row)
        for j, (row, array) in enumerate(zip(sums, types[1], strict=True)):
            self._add(f"%r{len(types[0]) + j}", array, row)
        if scan.inward and self.slots is not None:
            for array, offset in zip(types[0], self.offsets, strict=True):
                self._store(e.emit(f"getelementptr i8, ptr {read}, i64 {offset}"), array, None)
        if scan.condition is not None and self.width > 1:
            carries = [self._select(flag, *x) for x in zip(carries, types[0], self.offsets, strict=True)]
        for row, array, offset in zip(carries, types[0], self.offsets, strict=True):
            put = self._add if scan.inward and self.slots is not None else self._store
            put(e.emit(f"getelementptr i8, ptr {write}, i64 {offset}"), array, row)
        e.lines += ["  br label %latch", "latch:", f"  %following = add i64 {head}, 1"]
        more = f"icmp ult i64 %following, {scan.length}" if scan.condition is None else "icmp eq i64 0, 0"
        e.lines += [f"  %more = {more}", "  br i1 %more, label %loop, label %end", "end:"]
        self._finish()
        names = [f"%a{i}" for i in range(len(scan.inputs))] + [f"%r{i}" for i in range(len(scan.outputs))]
        until = [] if scan.condition is None else self.until.allocations()
        assert not (until and body.allocations()), "loops in a condition and in the body"
        title = f"define void @{self.symbol}({', '.join(f'ptr noalias {name}' for name in names)}) #0 {{"
        return "\n".join([title, "entry:", *allocations, *body.allocations(), *until, *e.lines, "  ret void", "}"])

    def _select(self, flag: str, row: Sequence[str], array: Array, offset: int) -> list[str]:
        """New carries of the samples that take part in the iteration, old ones of those that have ended."""
        e, kind = self.e, kind_of(array.dtype)
        pointer = e.emit(f"getelementptr i8, ptr %slots, i64 {offset}")
        of = e.type(kind)
        old = [e.load_at(pointer, k, kind) for k in range(array.size)]
        return [e.emit(f"select {e.type('b1')} {flag}, {of} {x}, {of} {y}") for x, y in zip(row, old, strict=True)]

    # --- before and after the loop ---

    def _start(self, count: int) -> None:
        """Given carries in their slot, zeros in all others that are added to, and in sums."""
        e, scan = self.e, self.scan
        if scan.inward and count > 1:
            fill_zeros(e, "%slots", count * self.slot_bytes)
        first, last = self._ends()
        for j, (array, offset) in enumerate(zip(self.carries, self.offsets, strict=True)):
            kind = kind_of(array.dtype)
            at = (last if scan.inward else first) * self.slot_bytes + offset
            pointer = e.emit(f"getelementptr i8, ptr %slots, i64 {at}")
            values = [e.load_at(f"%a{len(self.consts) + j}", k, kind) for k in range(array.size)]
            self._store(pointer, array, values)
        carries, sums, _ = scan.split_outputs(scan.body.outputs)
        for j, array in enumerate(sums):
            fill_zeros(e, f"%r{len(carries) + j}", array.size * array.dtype.itemsize * self.width)

    def _finish(self) -> None:
        """Results are the carries of the last iteration, or inward those of the root."""
        e = self.e
        first, last = self._ends()
        for j, (array, offset) in enumerate(zip(self.carries, self.offsets, strict=True)):
            at = (first if self.scan.inward else last) * self.slot_bytes + offset
            pointer, kind = e.emit(f"getelementptr i8, ptr %slots, i64 {at}"), kind_of(array.dtype)
            self._store(f"%r{j}", array, [e.load_at(pointer, k, kind) for k in range(array.size)])

    def _ends(self) -> tuple[int, int]:
        """Slots of the root and of the last iteration."""
        return (0, 0) if self.slots is None else (self.slots[1][0], self.slots[1][-1])

    # --- memory ---

    def _slot_pointers(self) -> tuple[str, str]:
        """Pointers to the slots of the iteration and of its parent."""
        if self.slots is None:
            return "%slots", "%slots"
        slots, e = self.slots[1], self.e
        pointers = []
        for name, values in (("own", slots[1:]), ("parent", [slots[x + 1] for x in self.scan.parents])):
            offsets = np.asarray(values, np.int64) * self.slot_bytes
            symbol = self._data(name, offsets, "i64", [str(x) for x in offsets])
            at = e.emit(f"getelementptr i64, ptr {symbol}, i64 %row")
            at = e.emit(f"load i64, ptr {at}")
            pointers.append(e.emit(f"getelementptr i8, ptr %slots, i64 {at}"))
        return pointers[0], pointers[1]

    def _row(self, base: str, array: Array) -> str:
        size = array.size * array.dtype.itemsize * self.width
        offset = self.e.emit(f"mul i64 %row, {size}")
        return self.e.emit(f"getelementptr i8, ptr {base}, i64 {offset}")

    def _table_row(self, j: int, table: np.ndarray) -> str:
        kind, one = kind_of(table.dtype), Emitter(1)
        scalar = {"b1": "i8"}.get(kind, one.type(kind))
        values = [one.constant(x, "i4" if kind == "b1" else kind) for x in table.ravel().tolist()]
        symbol = self._data(f"table{j}", table, scalar, values)
        size = table[0].size * table.dtype.itemsize
        offset = self.e.emit(f"mul i64 %row, {size}")
        return self.e.emit(f"getelementptr i8, ptr {symbol}, i64 {offset}")

    def _data(self, name: str, array: np.ndarray, scalar: str, values: list[str]) -> str:
        symbol = f"{self.symbol}_{name}"
        entries = ", ".join(f"{scalar} {x}" for x in values)
        self.e.declared[symbol] = f"@{symbol} = private constant [{array.size} x {scalar}] [{entries}], align 64"
        return f"@{symbol}"

    def _load(self, place: int, entry: int, kind: str) -> str:
        if place in self.places[3]:
            value = self.e.load_one(self.pointers[place], entry, kind)
            return value if self.width == 1 else self.e.splat(value, kind)
        return self.e.load_at(self.pointers[place], entry, kind)

    def _array(self, place: int) -> str | None:
        return None if place in self.places[3] and self.width > 1 else self.pointers[place]

    def _store(self, pointer: str, array: Array, values: Sequence[str] | None) -> None:
        kind = kind_of(array.dtype)
        for k in range(array.size):
            self.e.store_at(pointer, k, kind, self.e.constant(0, kind) if values is None else values[k])

    def _add(self, pointer: str, array: Array, values: Sequence[str]) -> None:
        kind, zero = kind_of(array.dtype), self.e.constant(0, kind_of(array.dtype))
        for k, value in enumerate(values):
            if value != zero:
                old = self.e.load_at(pointer, k, kind)
                self.e.store_at(pointer, k, kind, self.e.operation("add", kind, (old, value), kind))
