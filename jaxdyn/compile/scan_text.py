"""The text of scans (see `scan`): LLVM's intermediate representation of a loop around the program of an iteration.

Carries are in memory. An iteration reads the slot of its parent and writes its own; of a chain both are one slot. Slots are
used again once the last child has read them, so that a tree in depth-first order needs few. Inward, a slot holds the sum over
the children that have been computed, and is zero before the first of them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.compile.body import Body, symbol_of
from jaxdyn.compile.code import ATTRIBUTES
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.memory import allocation, bytes_of, zero
from jaxdyn.compile.program import Array, kind_of


def scan_ir(scan: Any, width: int) -> str:
    """The text of the function `called` of a scan."""
    text = _ScanText(scan, width, "called")
    return "\n".join([text.function(), *text.e.declared.values(), *ATTRIBUTES])


def scan_definition(scan: Any, symbol: str) -> dict[str, str]:
    """The function for one sample, and the loops that it calls, by names in a module's text. Programs are declared."""
    text = _ScanText(scan, 1, symbol)
    parts = {symbol: text.function().replace("define void", "define internal void", 1)}
    for called in scan.subprograms:
        if (name := symbol_of(called, 1)) in text.e.declared and hasattr(called, "definition"):
            text.e.declared |= called.definition(name)
    return text.e.declared | parts


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


class _ScanText:
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
            zero(e, "%slots", count * self.slot_bytes)
        first, last = self._ends()
        for j, (array, offset) in enumerate(zip(self.carries, self.offsets, strict=True)):
            kind = kind_of(array.dtype)
            at = (last if scan.inward else first) * self.slot_bytes + offset
            pointer = e.emit(f"getelementptr i8, ptr %slots, i64 {at}")
            values = [e.load_at(f"%a{len(self.consts) + j}", k, kind) for k in range(array.size)]
            self._store(pointer, array, values)
        carries, sums, _ = scan.split_outputs(scan.body.outputs)
        for j, array in enumerate(sums):
            zero(e, f"%r{len(carries) + j}", array.size * array.dtype.itemsize * self.width)

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
