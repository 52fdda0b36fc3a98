"""Operations of a program as lines of LLVM's intermediate representation, subprograms among them.

A subprogram is a function of the same name wherever its text is the same, so that it is compiled once for all kernels that call
it: `void called(ptr ..., ptr ...)` with the arrays of its inputs, then of its outputs, each entry for W samples. A row of one
sample is such an array: it is passed on without a copy.
"""

import contextlib
import re
from collections.abc import Callable, Sequence
from itertools import accumulate

import numpy as np

from jaxdyn.compile import careful
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import COMPARISONS, FLOATS, Array, Constant, Program, dtype_of, kind_of

# Arrays of fewer entries are copied entry by entry.
MIN_ENTRIES_IN_LOOP = 32


class Body:
    """The operations of a program, as lines of an emitter.

    **Arguments:** `load(place, entry, kind)` reads an entry of an input; `array(place)` is the pointer to an input that has the
    layout of a subprogram's, or None.
    """

    def __init__(self, e: Emitter, program: Program, load: Callable, array: Callable):
        self.e, self.program, self.load, self.array = e, program, load, array
        self.names: list = [None] * len(program.operations)  # of inputs, those that have been read
        self.parts: dict[int, list[int]] = {}  # of each call, the entries of its outputs that are needed
        # A subprogram that is called again finds its arrays at the same place: entries that have not changed stay there.
        self.regions: dict[Program, int] = {}  # where in %in and %out the arrays of a subprogram begin
        self.bytes = self.careful = 0  # of what is passed to subprograms and to careful programs
        self.passed: dict[int, str] = {}  # what stands in %in, which subprograms do not change
        # Of calls of loops, the first entry, pointer and type of each output: they stay in memory, each call has its own.
        self.in_memory: dict[int, list[tuple[int, str, Array]]] = {}
        for op, _, args in program.operations:
            if op == "part":
                self.parts.setdefault(args[0], []).append(args[1].value)
        self.fused = _find_products(program)  # of sums, the place of the operand that is a product
        self.merged = {program.operations[i][2][place] for i, place in self.fused.items()}

    def name(self, i: int) -> str:
        """Name of operation i; inputs are loaded where they are first read."""
        if self.names[i] is None:
            op, kind, args = self.program.operations[i]
            if op != "part":
                self.names[i] = self.load(*args, kind)
            else:
                call, (entry,) = args
                first, pointer = next((k, p) for k, p, array in self.in_memory[call] if k <= entry < k + array.size)
                self.names[i] = self.e.load_at(pointer, entry - first, kind)
        return self.names[i]

    def text(self, x, kind: str) -> str:
        """An entry: a name or a constant."""
        return self.e.constant(x.value, kind) if type(x) is Constant else self.name(x)

    def results(self) -> list[list[str]]:
        """Names of the program's results."""
        self.compute()
        rows = zip(self.program.results, self.program.outputs, strict=True)
        return [[self.text(x, kind_of(array.dtype)) for x in row] for row, array in rows]

    def compute(self) -> None:
        """Write all operations."""
        operations = self.program.operations
        for i, (op, kind, args) in enumerate(operations):
            if op == "input" or i in self.merged:
                continue
            if op == "call":
                self.names[i] = self._call(i, *args)
            elif op == "call_where":
                self.names[i] = self._call_where(i, *args)
            elif op == "part":
                if args[0] not in self.in_memory:
                    self.names[i] = self.names[args[0]][args[1].value]
            elif i in self.fused:
                place = self.fused[i]
                factors = [self.text(x, kind) for x in operations[args[place]][2]]
                self.names[i] = self.e.add_product(op, kind, factors, self.text(args[1 - place], kind), place == 0)
            else:
                kinds = [operations[x][1] for x in args if type(x) is not Constant]
                given = kinds[-1] if kinds else kind
                known = given if op in COMPARISONS else kind
                self.names[i] = self.e.operation(op, kind, [self.text(x, known) for x in args], given)

    def _call_where(self, i: int, which, flag, *entries) -> dict[int, str]:
        """Call a subprogram if the flag of any sample is set; names of the entries of its outputs that are needed."""
        e, called = self.e, self.program.subprograms[which.value]
        first = sum(array.size for array in called.inputs)
        given, otherwise = entries[:first], entries[first:]
        kinds = [kind_of(array.dtype) for array in called.outputs for _ in range(array.size)]
        # All names before the branch: what is loaded within it is not known behind it.
        for x in given:
            if type(x) is not Constant:
                self.name(x)
        flag = self.text(flag, "b1")
        old = {k: self.text(otherwise[k], kinds[k]) for k in set(self.parts.get(i, ()))}
        before, rare, after = (f"{name}{len(e.lines)}" for name in ("usual", "rare", "joined"))
        e.lines += [f"  br label %{before}", f"{before}:"]
        e.lines += [f"  br i1 {e.any(flag)}, label %{rare}, label %{after}", f"{rare}:"]
        passed = dict(self.passed)
        new = self._call(i, which, *given, flag=flag)
        # What the branch has stored is not in memory where it is not taken.
        self.passed = {at: value for at, value in passed.items() if self.passed.get(at) == value}
        new = {k: e.emit(f"select {e.type('b1')} {flag}, {e.type(kinds[k])} {x}, {e.type(kinds[k])} {old[k]}")
               for k, x in new.items()}  # fmt: skip
        e.lines += [f"  br label %{after}", f"{after}:"]
        return {k: e.emit(f"phi {e.type(kinds[k])} [ {old[k]}, %{before} ], [ {x}, %{rare} ]") for k, x in new.items()}

    def _call(self, i: int, which, *given, flag: str = "") -> dict[int, str]:
        """Call a subprogram; names of the entries of its outputs that are needed."""
        called = self.program.subprograms[which.value]
        at, first, pointers = self.regions.get(called, self.bytes), 0, []
        if not has_loop(called):
            self.regions[called] = at
        for array in called.inputs:
            entries = given[first : first + array.size]
            # An input of this program, or an output of a loop, that these entries are is passed on.
            place = whole_input(self.program, entries, array)
            pointer = self.pointer_to(entries, array) if place is None else self.array(place)
            pointers.append(pointer or self._copy_entries(entries, array, at))
            # Of a loop, whose arrays are large and used by one call, what is passed on has no place of its own.
            at += 0 if has_loop(called) and pointer else bytes_of(array, self.e.width)
            first += array.size
        outputs = []
        for array in called.outputs:
            outputs.append((self._place(at), kind_of(array.dtype), array.size))
            at += bytes_of(array, self.e.width)
        self.bytes = max(self.bytes, at)
        pointers += [pointer for pointer, _, _ in outputs]
        if isinstance(called, Careful):
            self.careful = max(self.careful, careful.write_call(self.e, called, flag, pointers))
        else:
            write_call(self.e, called, pointers)
        if has_loop(called):
            ends = [0, *accumulate(array.size for array in called.outputs)]
            self.in_memory[i] = [(x, y[0], z) for x, y, z in zip(ends, outputs, called.outputs, strict=False)]
            return {}
        needed, results, first = set(self.parts.get(i, ())), {}, 0
        for pointer, kind, size in outputs:
            results |= {first + k: self.e.load_at(pointer, k, kind) for k in range(size) if first + k in needed}
            first += size
        return results

    def pointer_to(self, entries, array: Array) -> str | None:
        """The pointer to the output of a loop that these entries are, all of it in its order."""
        operations = self.program.operations
        if not entries or type(entries[0]) is Constant or operations[entries[0]][0] != "part":
            return None
        _, _, (call, (start,)) = operations[entries[0]]
        for first, pointer, made in self.in_memory.get(call, ()):
            if first == start and made.size == len(entries) and made.dtype == array.dtype:
                whole = [(call, Constant(first + k)) for k in range(made.size)]
                same = all(type(x) is not Constant and operations[x][0] == "part" for x in entries)
                return pointer if same and whole == [operations[x][2] for x in entries] else None
        return None

    def _copy_entries(self, entries, array: Array, at: int) -> str:
        """A pointer to memory with these entries."""
        kind, pointer = kind_of(array.dtype), self._place(at)
        if len(entries) >= MIN_ENTRIES_IN_LOOP and all(map(is_zero, entries)):
            fill_zeros(self.e, pointer, len(entries) * array.dtype.itemsize * self.e.width)
            return pointer
        for k, x in enumerate(entries):
            value, place = self.text(x, kind), at + k * array.dtype.itemsize * self.e.width
            if self.passed.get(place) != value:
                self.e.store_at(pointer, k, kind, value)
                self.passed[place] = value
        return pointer

    def arrays_in_memory(self) -> list[int]:
        """Inputs of the program that are passed on whole to a loop."""
        found = set()
        for op, _, args in self.program.operations:
            if op == "call" and has_loop(called := self.program.subprograms[args[0].value]):
                first = 1
                for array in called.inputs:
                    entries, first = args[first : first + array.size], first + array.size
                    if len(entries) >= MIN_ENTRIES_IN_LOOP:
                        found.add(whole_input(self.program, entries, array))
        return sorted(found - {None})

    def _place(self, at: int) -> str:
        return self.e.emit(f"getelementptr i8, ptr %passed, i64 {at}")

    def allocations(self) -> list[str]:
        """Memory for what is passed."""
        passed = [allocation("%passed", self.bytes)] if self.bytes else []
        return [*passed, *careful.allocation(self.careful)]


def is_zero(x) -> bool:
    """Decide whether an entry is a known zero, all of whose bits are zero."""
    return type(x) is Constant and x.value == 0 and not np.signbit(x.value)


def has_zeros(entries: Sequence) -> bool:
    """Decide whether entries are mostly known zeros: all are set to zero at once, and then the others."""
    return len(entries) >= MIN_ENTRIES_IN_LOOP and 8 * sum(map(is_zero, entries)) > 7 * len(entries)


def has_loop(called) -> bool:
    """Decide whether a subprogram is a loop, whose arrays stay in memory."""
    return getattr(called, "keeps_arrays", False)


def whole_input(program: Program, entries: Sequence, array: Array) -> int | None:
    """The place of the input of a program that these entries are, all of it in its order; or None."""
    operations = program.operations
    if any(type(x) is Constant or operations[x][0] != "input" for x in entries) or not entries:
        return None
    _, _, (place, _) = operations[entries[0]]
    # Only a whole input in its order is passed on as it is; a slice of one would need another layout for W samples.
    whole = [(place, k) for k in range(program.inputs[place].size)]
    same = whole == [operations[x][2] for x in entries] and program.inputs[place].dtype == array.dtype
    return place if same else None


def _find_products(program: Program) -> dict[int, int]:
    """Sums and differences one of whose operands is a product that nothing else needs, and the place of that operand.

    They are rounded once. The decision is made here, not by LLVM, whose choice depends on its level.
    """
    operations = program.operations
    uses = [0] * len(operations)
    for op, _, args in operations:
        for x in args if op != "input" else ():
            if type(x) is not Constant:
                uses[x] += 1
    for row in program.results:
        for x in row:
            if type(x) is not Constant:
                uses[x] += 1
    found = {}
    for i, (op, kind, args) in enumerate(operations):
        if op in ("add", "sub") and kind in FLOATS:
            for place in (1, 0):
                x = args[place]
                if type(x) is not Constant and operations[x][0] == "mul" and uses[x] == 1:
                    found[i] = place
                    break
    return found


def write_call(e: Emitter, called: Program, pointers: Sequence[str]) -> None:
    """Write a call of the subprogram of a program, with pointers to its inputs and outputs."""
    name, places = symbol_of(called, e.width), [f"ptr %{k}" for k in range(len(pointers))]
    # By its address in memory: code that is better takes its place while this code runs.
    e.declared[name] = "\n".join(
        [
            f"@{name}_at = external global ptr",
            f"define internal void @{name}({', '.join(places)}) #0 {{",
            f"  %called = load atomic ptr, ptr @{name}_at monotonic, align 8",
            f"  tail call void %called({', '.join(places)})",
            "  ret void",
            "}",
        ]
    )
    e.lines.append(f"  call void @{name}({', '.join(f'ptr {x}' for x in pointers)})")


def symbol_of(called: Program, width: int) -> str:
    """The name by which kernels call a subprogram: equal names have equal code."""
    return f"jaxdyn_{called.digest[:32]}_{width}"


# --- memory of native code: arrays on the stack and on the heap, and the order of their entries for the W samples of a vector ---


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


def fill_zeros(e: Emitter, pointer: str, size: int) -> None:
    """Fill memory with zeros."""
    e.declared["memset"] = "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)"
    e.lines.append(f"  call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {size}, i1 false)")


def copy_bytes(e: Emitter, source: str, target: str, size: int) -> None:
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
