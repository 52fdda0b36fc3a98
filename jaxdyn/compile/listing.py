"""Large programs as data: a loop carries out their operations one after the other, from a table.

LLVM takes some 50 microseconds for an operation, and code that is run through once waits for memory as long as a table does. The
code of a listing is that of one operation of each kind, with the arithmetic of `body.Body`, so that results are the same bits.
Every number has a place in memory, which is used again when nothing needs the number any more. A row of the table has the number
of a piece of code, the place of the result, and those of the operands. Between calls of subprograms the table is run in one go.
"""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from jaxdyn.compile import careful
from jaxdyn.compile.body import Body, allocation, bytes_of, copy_bytes, fill_zeros, has_zeros, is_zero, write_call
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import COMPARISONS, Array, Constant, Program, dtype_of, kind_of

_COLUMNS = 5  # of the table: code, result, three operands
_ESCAPED = [f"\\{x:02X}" for x in range(256)]


class Listing(Body):
    """The operations of a program as rows of a table; stands in the place of a `Body`."""

    def __init__(self, e: Emitter, program: Program, load: Callable, array: Callable):
        super().__init__(e, program, load, array)
        self.memory = _Memory()
        self.rows: list[tuple[int, ...]] = []
        self.first = 0  # row that has not been run
        self.codes: dict[tuple, int] = {}  # numbers of pieces of code
        self.at: dict[int, int] = {}  # places of operations
        self.constants: dict[tuple, int] = {}
        self.parts_at: dict[tuple[int, int], int] = {}  # of calls, places of the entries of their outputs
        self.made: list[int] = []  # places of the outputs

    # --- what a `Body` has ---

    def name(self, i: int) -> str:
        """Load the number of an operation."""
        return self.e.load_at(self._pointer(self.at[i]), 0, self.program.operations[i][1])

    def pointer_to(self, entries, array: Array) -> str | None:
        """The pointer to an output of the program."""
        for row, place in zip(self.program.results, self.made, strict=True):
            if row is entries:
                return self._pointer(place)
        return None

    def arrays_in_memory(self) -> list[int]:
        """All inputs that are read."""
        return sorted({args[0] for op, _, args in self.program.operations if op == "input"})

    def allocations(self) -> list[str]:
        """Memory for all numbers."""
        lines = [allocation("%numbers", max(64, self.memory.size))]
        return [*lines, *careful.allocation(self.careful)]

    def compute(self) -> None:
        """Write the table and the lines that run it."""
        e, program, operations = self.e, self.program, self.program.operations
        self.last = self._last_uses()
        self._place_constants()
        self._place_inputs()
        self.made = [self.memory.take(bytes_of(x, e.width)) for x in program.outputs]
        dying: list[list[int]] = [[] for _ in operations]
        for i, last in enumerate(self.last):
            if last < len(operations):
                dying[last].append(i)
        self.size_of: dict[int, int] = {}  # of places that can be used again, by operation
        for i, (op, kind, args) in enumerate(operations):
            if op in ("call", "call_where"):
                self._call(i, op == "call_where", *args)
            elif op == "part":
                call, (entry,) = args
                if (call, entry) in self.parts_at:
                    self.at[i] = self.parts_at[call, entry]
            elif op != "input" and i not in self.merged:
                self._add(i, op, kind, args)
            for k in dying[i]:
                if k in self.size_of:
                    self.memory.free(self.at[k], self.size_of[k])
        self._make_outputs()
        self._run()
        self._declare()

    # --- places ---

    def _last_uses(self) -> list[int]:
        """For each operation the last one that reads it; their number for results. A call lives as long as its parts."""
        operations = self.program.operations
        last = list(range(len(operations)))
        for i, (op, _, args) in enumerate(operations):
            if op != "input" and i not in self.merged:
                # A product that is merged into a sum is carried out there.
                args = [*args, *operations[args[self.fused[i]]][2]] if i in self.fused else args
                for x in args:
                    if type(x) is not Constant:
                        last[x] = i
        for row in self.program.results:
            for x in row:
                if type(x) is not Constant:
                    last[x] = len(operations)
        for i, (op, _, args) in enumerate(operations):
            if op == "part":
                last[args[0]] = max(last[args[0]], last[i])
        return last

    def _place_constants(self) -> None:
        """Constants in front of all, copied from data of the code."""
        operations = self.program.operations
        for i, (op, kind, args) in enumerate(operations):
            if op in ("input", "call", "part"):
                continue
            for x, of in zip(args, self._kinds(i, op, kind, args), strict=True):
                if type(x) is Constant and of:
                    self._constant(x.value, of)
        for op, _, args in operations:
            if op == "call_where" or op == "call":
                called = self.program.subprograms[args[0].value]
                given = args[1:] if op == "call" else args[2:]
                arrays = called.inputs if op == "call" else (*called.inputs, *called.outputs)
                self._constants_of(given, arrays)
        self._constants_of(itertools.chain(*self.program.results), self.program.outputs)
        # Each for W samples, in the 8 W bytes of a number.
        data = b"".join((value * self.e.width).ljust(8 * self.e.width, b"\0") for _, value in self.constants)
        if data:
            e = self.e
            self.data = f"@constants{len(e.declared)}"
            e.declared[self.data] = _data(self.data, data)
            copy_bytes(e, self.data, self._pointer(0), len(data))

    def _constants_of(self, entries, arrays: Sequence[Array]) -> None:
        kinds = itertools.chain(*(itertools.repeat(kind_of(x.dtype), x.size) for x in arrays))
        for x, kind in zip(entries, kinds, strict=True):
            if type(x) is Constant:
                self._constant(x.value, kind)

    def _constant(self, value, kind: str) -> int:
        key = kind, np.asarray(value, dtype_of(kind)).tobytes()
        if key not in self.constants:
            self.constants[key] = self.memory.take(8 * self.e.width)
        return self.constants[key]

    def _place_inputs(self) -> None:
        """Inputs in the layout of a subprogram's."""
        e, entries = self.e, {}
        for i, (op, kind, args) in enumerate(self.program.operations):
            if op == "input":
                entries.setdefault(args[0], []).append((args[1], kind, i))
        for place, read in entries.items():
            array = self.program.inputs[place]
            size, pointer = bytes_of(array, e.width), self.array(place)
            first = self.memory.take(size)
            step = array.dtype.itemsize * e.width
            if pointer is not None:
                copy_bytes(e, pointer, self._pointer(first), array.size * step)
            for entry, kind, i in read:
                self.at[i] = first + entry * step
                if pointer is None:
                    e.store_at(self._pointer(self.at[i]), 0, kind, self.load(place, entry, kind))

    def _pointer(self, place: int) -> str:
        return self.e.emit(f"getelementptr i8, ptr %numbers, i64 {place}")

    def _operand(self, x, kind: str) -> int:
        return self._constant(x.value, kind) if type(x) is Constant else self.at[x]

    # --- rows of the table ---

    def _kinds(self, i: int, op: str, kind: str, args) -> list[str]:
        """Kinds of the operands, "" for those that are no numbers."""
        if op == "call_where":
            return ["", *(["b1"] if type(args[1]) is Constant else [""]), *[""] * (len(args) - 2)]
        known = [self.program.operations[x][1] for x in args if type(x) is not Constant]
        given = known[-1] if known else kind
        of_constants = given if op in COMPARISONS else kind
        return [of_constants if type(x) is Constant else self.program.operations[x][1] for x in args]

    def _add(self, i: int, op: str, kind: str, args) -> None:
        operands, size = list(args), 8 * self.e.width
        if i in self.fused:
            place = self.fused[i]
            product = self.program.operations[args[place]][2]
            code, operands = (f"fused {op}", kind, (kind,) * 3, place == 0), [*product, args[1 - place]]
            kinds = [kind] * 3
        else:
            kinds = self._kinds(i, op, kind, args)
            code = op, kind, tuple(kinds), False
        self.at[i] = self.memory.take(size)
        self.size_of[i] = size
        if op in ("reduce_max", "reduce_min"):  # a chain of two operands each
            code = op.removeprefix("reduce_"), kind, (kind, kind), False
            # The first two are one where all are equal.
            first, *others = dict.fromkeys(self._operand(x, kind) for x in operands)
            for x in others or [first]:
                self._row(code, self.at[i], [first, x])
                first = self.at[i]
            return
        self._row(code, self.at[i], [self._operand(x, of) for x, of in zip(operands, kinds, strict=True)])

    def _row(self, code: tuple, result: int, operands: list[int]) -> None:
        number = self.codes.setdefault(code, len(self.codes))
        self.rows.append((number, result, *operands, *[0] * (_COLUMNS - 2 - len(operands))))

    def _copy(self, kind: str, source: int, target: int) -> None:
        self._row(("copy", kind, (kind,), False), target, [source])

    # --- calls ---

    def _call(self, i: int, is_branch: bool, which: Constant, *entries) -> None:
        e, called = self.e, self.program.subprograms[which.value]
        flag, *entries = entries if is_branch else (None, *entries)
        pointers, at, regions = [], 0, []
        for array in called.inputs:
            place = self._whole(entries[at : at + array.size], array)
            if place is None:
                size = bytes_of(array, e.width)
                place = self.memory.take(size)
                regions.append((place, size))
                self._fill(place, entries[at : at + array.size], array)
            pointers.append(place)
            at += array.size
        needed = set(self.parts.get(i, ()))
        size = sum(bytes_of(x, e.width) for x in called.outputs)
        first, places, k = self.memory.take(size), [], 0
        target = first
        for array in called.outputs:
            pointers.append(target)
            step = array.dtype.itemsize * e.width
            places += [(target + j * step, kind_of(array.dtype)) for j in range(array.size)]
            target += bytes_of(array, e.width)
        self.parts_at |= {(i, k): places[k][0] for k in needed}
        if not is_branch:
            self.at[i], self.size_of[i] = first, size
            self._run()
            self._write_call(called, "true", pointers)
        else:
            # What stands for the outputs where the flag is not set, in places of its own.
            chosen = {k: (self.memory.take(8 * e.width), places[k][1]) for k in sorted(needed)}
            for k, (place, kind) in chosen.items():
                self._copy(kind, self._operand(entries[at + k], kind), place)
            self._run()
            text = self._text(flag)
            before, rare, after = (f"{name}{len(e.lines)}" for name in ("usual", "rare", "joined"))
            e.lines += [f"  br label %{before}", f"{before}:"]
            e.lines += [f"  br i1 {e.any(text)}, label %{rare}, label %{after}", f"{rare}:"]
            self._write_call(called, text, pointers)
            for k, (place, kind) in chosen.items():
                self._row(
                    ("select", kind, ("b1", kind, kind), False), place, [self._operand(flag, "b1"), place, places[k][0]]
                )
            self._run()
            e.lines += [f"  br label %{after}", f"{after}:"]
            self.parts_at |= {(i, k): place for k, (place, _) in chosen.items()}
            self.memory.free(first, size)
        for place, size in regions:
            self.memory.free(place, size)

    def _text(self, flag) -> str:
        return self.e.constant(flag.value, "b1") if type(flag) is Constant else self.name(flag)

    def _write_call(self, called, flag: str, places: Sequence[int]) -> None:
        pointers = [self._pointer(x) for x in places]
        if isinstance(called, Careful):
            self.careful = max(self.careful, careful.write_call(self.e, called, flag, pointers))
        else:
            write_call(self.e, called, pointers)

    def _whole(self, entries, array: Array) -> int | None:
        """The place of entries that follow each other in memory as an array's do."""
        if not entries or any(type(x) is Constant for x in entries):
            return None
        step, first = array.dtype.itemsize * self.e.width, self.at[entries[0]]
        kind, operations = kind_of(array.dtype), self.program.operations
        same = all(self.at[x] == first + k * step and operations[x][1] == kind for k, x in enumerate(entries))
        return first if same else None

    def _fill(self, place: int, entries, array: Array) -> None:
        """Copy entries to an array; zeros at once, where they are most of it."""
        kind, step, e = kind_of(array.dtype), array.dtype.itemsize * self.e.width, self.e
        is_empty = has_zeros(entries)
        if is_empty:
            self._run()
            fill_zeros(e, self._pointer(place), array.size * step)
        for k, x in enumerate(entries):
            if not (is_empty and is_zero(x)):
                self._copy(kind, self._operand(x, kind), place + k * step)

    def _make_outputs(self) -> None:
        """Copy results to where the caller reads them."""
        found: dict[int, int] = {}
        for row, place, array in zip(self.program.results, self.made, self.program.outputs, strict=True):
            self._fill(place, row, array)
            step = array.dtype.itemsize * self.e.width
            found |= {x: place + k * step for k, x in enumerate(row) if type(x) is not Constant}
        self.at = found

    # --- text ---

    def _run(self) -> None:
        """Run the rows that have been added."""
        if self.first < len(self.rows):
            self._row(("end", "", (), False), 0, [])
            self.e.lines.append(f"  call void @listing(ptr %numbers, i64 {4 * _COLUMNS * self.first})")
            self.first = len(self.rows)

    def _declare(self) -> None:
        """The function that runs the table, and the table."""
        inner, lines, sources = Emitter(self.e.width), [], ["[ %first, %entry ]"]
        for (op, kind, kinds, is_first), number in self.codes.items():
            inner.lines = []
            inner.lines.append(f"code{number}:")
            if op == "end":
                lines += [*inner.lines, "  ret void"]
                continue
            places = [inner.emit(f"getelementptr i32, ptr %row, i64 {k}") for k in range(1, 2 + len(kinds))]
            places = [inner.emit(f"sext i32 {inner.emit(f'load i32, ptr {x}')} to i64") for x in places]
            target, *given = [inner.emit(f"getelementptr i8, ptr %numbers, i64 {x}") for x in places]
            values = [inner.load_at(x, 0, of) for x, of in zip(given, kinds, strict=True)]
            if op == "copy":
                value = values[0]
            elif op.startswith("fused "):
                value = inner.add_product(op.removeprefix("fused "), kind, values[:2], values[2], is_first)
            else:
                value = inner.operation(op, kind, values, kinds[-1])
            inner.store_at(target, 0, kind, value)
            inner.lines += [f"  br label %end{number}", f"end{number}:"]
            inner.lines += [f"  %row{number} = getelementptr i8, ptr %row, i64 {4 * _COLUMNS}", "  br label %next"]
            sources.append(f"[ %row{number}, %end{number} ]")
            lines += inner.lines
        cases = " ".join(f"i32 {number}, label %code{number}" for number in self.codes.values())
        table = np.array(self.rows, np.int32)
        self.e.declared |= inner.declared
        self.e.declared["@listed"] = _data("@listed", table.tobytes())
        self.e.declared["@listing"] = "\n".join(
            [
                "define internal void @listing(ptr %numbers, i64 %begin) #0 {",
                "entry:",
                "  %first = getelementptr i8, ptr @listed, i64 %begin",
                "  br label %next",
                "next:",
                f"  %row = phi ptr {', '.join(sources)}",
                "  %code = load i32, ptr %row",
                f"  switch i32 %code, label %none [ {cases} ]",
                "none:",
                "  unreachable",
                *lines,
                "}",
            ]
        )


class _Memory:
    """Places in memory, those that are free again by their size."""

    def __init__(self):
        self.size, self.unused = 0, {}

    def take(self, size: int) -> int:
        """A place of so many bytes."""
        if self.unused.get(size):
            return self.unused[size].pop()
        place = self.size
        self.size += size
        return place

    def free(self, place: int, size: int) -> None:
        """Let a place be used again."""
        self.unused.setdefault(size, []).append(place)


def _data(name: str, data: bytes) -> str:
    return f'{name} = private constant [{len(data)} x i8] c"{"".join(map(_ESCAPED.__getitem__, data))}", align 64'
