"""Text of native loops (see `kernels`): LLVM's intermediate representation around the programs of a turn and of a row.

entry   pointers
block   the next samples: constants and states are copied to local memory, rows and records to the results
turn    the program of an iteration: new states where a sample takes part; its records
rows    while a sample has a row to write: the program of a row
out     after the last sample of the block has ended: states are copied to the results
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import jax
import numpy as np

from jaxdyn.compile.body import Body, bytes_of, copy_bytes
from jaxdyn.compile.code import body_of, wrap_kernel
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import Array, kind_of


class LoopText:
    """The text of one loop, for samples of a width."""

    def __init__(self, loop: Any, width: int, uniform: Sequence[bool]):
        self.loop, self.width, self.e = loop, width, Emitter(width)
        self.arrays: list[Array] = [*loop.inputs, *loop.outputs]
        self.uniform = [*uniform, *[False] * len(loop.outputs)]
        # Memory is allocated in the entry block: an alloca within the loop over blocks would grow the stack each time.
        self.allocations: list[str] = []
        self.labels = 0
        # Places among the arrays: arguments of a turn, the last of them states; times; tables; then the carry without the state.
        self.end, self.first_state = loop.end, loop.end - loop.states
        self.times = self.end
        self.tables = self.end + (loop.given.times is not None)
        self.saved = self.tables + loop.reads
        self.results = len(loop.inputs)  # the states first
        self.saved_after = self.results + loop.states
        self.rows_after = self.saved_after + 1
        self.records_after = self.saved_after + 2 * (loop.row is not None)
        ends = np.cumsum([0, *(array.size for array in loop.turn.outputs)]).tolist()
        self.entries = [range(*ends) for ends in pairwise(ends)]  # of a turn's outputs, among all of its results

    def text(self, is_quick: bool) -> str:
        """All of it."""
        e, loop = self.e, self.loop
        self._set_up()
        self._begin("turn")
        self._set_table_rows()
        turn = body_of(e, loop.turn, self._load, self._array, is_quick)
        results = [name for row in turn.results() for name in row]
        # The state is stored before rows are written: their program reads the stages of this iteration, not the state.
        more = self._store_state(results)
        if loop.row is not None:
            self._rows(results)
        # The block iterates until its last sample has ended; the state of the others is kept by selects.
        e.lines.append(f"  br i1 {e.any(more)}, label %turn, label %out")
        e.lines.append("out:")
        for k in range(loop.states):
            kind = kind_of(loop.outputs[k].dtype)
            values = [e.load_at(self._slot(self.first_state + k), i, kind) for i in range(loop.outputs[k].size)]
            e.store_array(self.sample_rows[self.results + k], kind, values)
        if loop.row is not None:
            e.store(self.sample_rows[self.saved_after], 0, "i4", e.load_at("%saved", 0, "i4"))
        title = f"{loop.digest} {self.uniform}"
        allocations = [*turn.allocations(), *self.allocations]
        return wrap_kernel(e, title, self.uniform[: self.results], len(loop.outputs), allocations)

    # --- arguments ---

    def _slot(self, place: int) -> str:
        """Local memory for an argument of an iteration, for the W samples of the block."""
        return f"%slot{place}"

    def _is_direct(self, place: int) -> bool:
        """Decide whether an argument is read from the caller's memory: constants of one sample, and those that all share."""
        return place < self.first_state and (self.width == 1 or self.uniform[place])

    def _set_up(self) -> None:
        e = self.e
        places = [i for i, same in enumerate(self.uniform) if not same]
        self.sample_rows = e.rows(places, [self.arrays[i].size * self.arrays[i].dtype.itemsize for i in places])
        self.sample_rows |= {i: [f"%a{i}"] * self.width for i, same in enumerate(self.uniform) if same}
        read = {args[0] for op, _, args in self.loop.turn.operations if op == "input"}
        for place in range(self.end):
            if self._is_direct(place) or (place not in read and place < self.first_state):
                continue
            array = self.arrays[place]
            # At least a cache line: a slot of zero bytes would have the address of the next one.
            size = max(64, bytes_of(array, self.width))
            self.allocations.append(f"  {self._slot(place)} = alloca [{size} x i8], align 64")
            for entry in range(array.size):
                kind = kind_of(array.dtype)
                e.store_at(self._slot(place), entry, kind, self._from_row(place, entry, kind))
        has_rows = self.loop.row is not None
        if has_rows:
            self.allocations.append("  %saved = alloca [64 x i8], align 64")
            e.store_at("%saved", 0, "i4", self._from_row(self.saved, 0, "i4"))
        for place in range(self.saved + has_rows, self.results):
            after = self.sample_rows[self.saved_after + place - self.saved]
            size = self.arrays[place].size * self.arrays[place].dtype.itemsize
            for row, row_after in zip(self.sample_rows[place], after, strict=True):
                copy_bytes(e, row, row_after, size)

    def _from_row(self, place: int, entry: int, kind: str) -> str:
        if self.uniform[place]:
            return self.e.load_for_all(place, entry, kind)
        return self.e.load(self.sample_rows[place], entry, kind)

    def _set_table_rows(self) -> None:
        """Pointers to the rows of the tables that are read now."""
        e = self.e
        self.table_rows: list[list[str]] = []
        if not self.loop.reads:
            return
        places = self.first_state + self.loop.carry.state.places - self.loop.first_leaf
        for k in range(self.loop.reads):
            table = self.tables + k
            place, pointers = e.load_at(self._slot(places), k, "i4"), []
            count, *shape = self.arrays[table].shape
            size = math.prod(shape) * self.arrays[table].dtype.itemsize
            for element in range(self.width):
                at = e.emit(f"sext i32 {self._element(place, element, 'i4')} to i64")
                # As unsigned numbers what is below zero is large.
                is_inside = e.emit(f"icmp ult i64 {at}, {count}")
                at = e.emit(f"select i1 {is_inside}, i64 {at}, i64 0")
                offset = e.emit(f"mul i64 {at}, {size}")
                pointers.append(e.emit(f"getelementptr i8, ptr {self.sample_rows[table][element]}, i64 {offset}"))
            self.table_rows.append(pointers)

    def _load(self, place: int, entry: int, kind: str) -> str:
        if place >= self.end:
            return self.e.load(self.table_rows[place - self.end], entry, kind)
        if self._is_direct(place):
            return self._from_row(place, entry, kind)
        return self.e.load_at(self._slot(place), entry, kind)

    def _array(self, place: int) -> str | None:
        """Pointer to an argument in the layout of a subprogram's."""
        if place >= self.end:
            return self.table_rows[place - self.end][0] if self.width == 1 else None
        if self._is_direct(place):
            return self.sample_rows[place][0] if self.width == 1 else None
        return self._slot(place)

    # --- the results of a turn ---

    def _store_state(self, results: list[str]) -> str:
        """Store new states and records; flags of the samples that continue."""
        e, turn = self.e, self.loop.turn_places
        flag = e.type("b1")
        take = self._one(results, turn.active)
        more = self._both(take, self._one(results, turn.more))
        after = []
        for place, out in enumerate(jax.tree.leaves(turn.state), self.first_state):
            kind = kind_of(self.arrays[place].dtype)
            for k, i in enumerate(self.entries[out]):
                old = e.load_at(self._slot(place), k, kind)
                value = e.emit(f"select {flag} {take}, {e.type(kind)} {results[i]}, {e.type(kind)} {old}")
                after.append((self._slot(place), k, kind, value))
        for value in after:
            e.store_at(*value)
        self.take = take
        for stride in sorted(set(self.loop.task.strides)):
            self._record(results, self._one(results, turn.index), stride)
        return more

    def _record(self, results, index, stride: int) -> None:
        """Store a row of each record, once in as many iterations as its stride."""
        e, strides = self.e, self.loop.task.strides
        for element in range(self.width):
            turn = e.emit(f"zext i32 {self._element(index, element, 'i4')} to i64")
            is_one = self._element(self.take, element, "b1")
            place = turn
            if stride > 1:
                place = e.emit(f"udiv i64 {turn}, {stride}")
                rest = e.emit(f"urem i64 {turn}, {stride}")
                is_one = e.emit(f"and i1 {is_one}, {e.emit(f'icmp eq i64 {rest}, 0')}")
            with_row = []
            for r, out in enumerate(self.loop.turn_places.written):
                if strides[r] == stride:
                    with_row.append((self.records_after + r, [results[i] for i in self.entries[out]]))
            self._write_if(is_one, element, place, with_row)

    def _write_if(self, flag: str, element: int, place: str, rows: list) -> None:
        """Row number `place` of some results, for a sample whose flag is set."""
        e = self.e
        write, on = self._label("write"), self._label("on")
        e.lines += [f"  br i1 {flag}, label %{write}, label %{on}", f"{write}:"]
        for result, values in rows:
            kind, array = kind_of(self.arrays[result].dtype), self.arrays[result]
            offset = e.emit(f"mul i64 {place}, {len(values) * array.dtype.itemsize}")
            at = e.emit(f"getelementptr i8, ptr {self.sample_rows[result][element]}, i64 {offset}")
            for k, value in enumerate(values):
                e.store_one(at, k, kind, self._element(value, element, kind))
        e.lines += [f"  br label %{on}", f"{on}:"]

    def _rows(self, results: list[str]) -> None:
        """Rows of times that have been passed, one for each sample at a time, until none is left."""
        e, turn = self.e, self.loop.turn_places.rows
        count = self.arrays[self.rows_after].shape[0]
        kind, flag = kind_of(self.arrays[self.times].dtype), e.type("b1")
        until = self._one(results, turn.until)
        # A step may pass any number of save points: samples with the most of them decide how often this loop runs.
        self._begin("rows")
        saved = e.load_at("%saved", 0, "i4")
        places, times = [], []
        for element in range(self.width):
            given = e.emit(f"zext i32 {self._element(saved, element, 'i4')} to i64")
            is_less = e.emit(f"icmp ult i64 {given}, {count}")
            # A sample that has written all rows reads the last time again, which is a valid address, and writes nothing.
            places.append(e.emit(f"select i1 {is_less}, i64 {given}, i64 {count - 1}"))
            offset = e.emit(f"mul i64 {places[-1]}, {self.arrays[self.times].dtype.itemsize}")
            at = e.emit(f"getelementptr i8, ptr {self.sample_rows[self.times][element]}, i64 {offset}")
            times.append(e.load_one(at, 1, kind))
        time = self._vector(times, kind)
        some_left = e.emit(f"icmp ult {e.type('i4')} {saved}, {e.constant(count, 'i4')}")
        is_passed = e.emit(f"fcmp ole {e.type(kind)} {time}, {until}")
        kept = self._both(self.take, self._one(results, turn.kept))
        passed = self._both(kept, self._both(some_left, is_passed))
        e.lines.append(f"  br i1 {e.any(passed)}, label %row, label %all.passed")
        e.lines.append("row:")
        dense = [[results[i] for i in self.entries[out]] for out in jax.tree.leaves(turn.dense)]

        # The arguments are registers: none can be passed on as a pointer.
        def load(place, entry, kind):
            return time if place == 0 else dense[place - 1][entry]

        written = [name for row in Body(e, self.loop.row, load, lambda place: None).results() for name in row]
        for element in range(self.width):
            self._write_if(self._element(passed, element, "b1"), element, places[element], [(self.rows_after, written)])
        one = e.emit(f"zext {flag} {passed} to {e.type('i4')}")
        e.store_at("%saved", 0, "i4", e.emit(f"add {e.type('i4')} {saved}, {one}"))
        e.lines += ["  br label %rows", "all.passed:"]

    # --- lines ---

    def _begin(self, label: str) -> None:
        self.e.lines += [f"  br label %{label}", f"{label}:"]

    def _label(self, name: str) -> str:
        self.labels += 1
        return f"{name}{self.labels}"

    def _one(self, results, out: int) -> str:
        return results[self.entries[out][0]]

    def _both(self, a: str, b: str) -> str:
        return self.e.emit(f"and {self.e.type('b1')} {a}, {b}")

    def _element(self, value: str, element: int, kind: str) -> str:
        return value if self.width == 1 else self.e.emit(f"extractelement {self.e.type(kind)} {value}, i32 {element}")

    def _vector(self, values: list[str], kind: str) -> str:
        if self.width == 1:
            return values[0]
        of, total = self.e.type(kind), "poison"
        for element, value in enumerate(values):
            scalar = Emitter(1).type(kind)
            total = self.e.emit(f"insertelement {of} {total}, {scalar} {value}, i32 {element}")
        return total
