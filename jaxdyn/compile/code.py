"""The text of kernels: from a program of numbers to LLVM's intermediate representation.

A kernel is `void kernel(ptr data, i64 n, i64 begin, i64 end)`: `data` points to the arguments, first those that have a row of
numbers per sample, then those that are uniform, one row for all samples, and then to the results; samples begin .. end - 1 of n
are computed, W at a time. Where fewer than W remain, the last sample fills the other elements of the vectors.

A subprogram is a function of the same name wherever its text is the same, so that it is compiled once for all kernels that call
it: `void called(ptr ..., ptr ...)` with the arrays of its inputs, then of its outputs, each entry for W samples. A row of one
sample is such an array: it is passed on without a copy.
"""

from collections.abc import Callable, Sequence
from itertools import accumulate

import numpy as np

from jaxdyn.compile import careful_text, memory
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.memory import allocation, bytes_of, on_heap
from jaxdyn.compile.program import COMPARISONS, FLOATS, Array, Constant, Program, kind_of

# A program of one sample with at least so many operations is compiled once for all kernels that contain it: the copies of a
# call's arguments are few against them.
MIN_SHARED_OPERATIONS = 2000
# Arrays of fewer entries are copied entry by entry.
MIN_ENTRIES_IN_LOOP = 32
ATTRIBUTES = (
    # LLVM's simplifications of calls of the C library, such as pow(x, 2) = x x, are made at some levels alone.
    'attributes #0 = { nounwind "no-builtins" }',
    "attributes #1 = { nounwind willreturn memory(none) }",
)


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
        self.merged = {program.operations[i].args[place] for i, place in self.fused.items()}

    def name(self, i: int) -> str:
        """Name of operation i; inputs are loaded where they are first read."""
        if self.names[i] is None:
            op, kind, args = self.program.operations[i]
            self.names[i] = self._load_part(args[0], args[1], kind) if op == "part" else self.load(*args, kind)
        return self.names[i]

    def _load_part(self, call: int, entry: Constant, kind: str) -> str:
        for first, pointer, array in self.in_memory[call]:
            if first <= entry.value < first + array.size:
                return self.e.load_at(pointer, entry.value - first, kind)
        raise AssertionError("a part beyond the results of a call")

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
                factors = [self.text(x, kind) for x in operations[args[place]].args]
                self.names[i] = self.e.add_product(op, kind, factors, self.text(args[1 - place], kind), place == 0)
            else:
                kinds = [operations[x].kind for x in args if type(x) is not Constant]
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
            pointer = self._input_pointer(entries, array)
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
            self.careful = max(self.careful, careful_text.write_call(self.e, called, flag, pointers))
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

    def _input_pointer(self, entries, array: Array) -> str | None:
        """The pointer to an input of this program, or to an output of a loop, that these entries are."""
        place = whole_input(self.program, entries, array)
        return self.pointer_to(entries, array) if place is None else self.array(place)

    def pointer_to(self, entries, array: Array) -> str | None:
        """The pointer to the output of a loop that these entries are, all of it in its order."""
        operations = self.program.operations
        if not entries or type(entries[0]) is Constant or operations[entries[0]].op != "part":
            return None
        call, (start,) = operations[entries[0]].args
        for first, pointer, made in self.in_memory.get(call, ()):
            if first == start and made.size == len(entries) and made.dtype == array.dtype:
                whole = [(call, Constant(first + k)) for k in range(made.size)]
                same = all(type(x) is not Constant and operations[x].op == "part" for x in entries)
                return pointer if same and whole == [operations[x].args for x in entries] else None
        return None

    def _copy_entries(self, entries, array: Array, at: int) -> str:
        """A pointer to memory with these entries."""
        kind, pointer = kind_of(array.dtype), self._place(at)
        if len(entries) >= MIN_ENTRIES_IN_LOOP and all(map(is_zero, entries)):
            memory.zero(self.e, pointer, len(entries) * array.dtype.itemsize * self.e.width)
            return pointer
        for k, x in enumerate(entries):
            value, place = self.text(x, kind), at + k * array.dtype.itemsize * self.e.width
            if self.passed.get(place) != value:
                self.e.store_at(pointer, k, kind, value)
                self.passed[place] = value
        return pointer

    def arrays_in_memory(self) -> list[int]:
        """Inputs of the program that are read as arrays."""
        return _inputs_of_loops(self.program)

    def _place(self, at: int) -> str:
        return self.e.emit(f"getelementptr i8, ptr %passed, i64 {at}")

    def allocations(self) -> list[str]:
        """Memory for what is passed."""
        passed = [allocation("%passed", self.bytes)] if self.bytes else []
        return [*passed, *careful_text.allocation(self.careful)]


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
    if any(type(x) is Constant or operations[x].op != "input" for x in entries) or not entries:
        return None
    place = operations[entries[0]].args[0]
    # Only a whole input in its order is passed on as it is; a slice of one would need another layout for W samples.
    whole = [(place, k) for k in range(program.inputs[place].size)]
    same = whole == [operations[x].args for x in entries] and program.inputs[place].dtype == array.dtype
    return place if same else None


def _inputs_of_loops(program: Program) -> list[int]:
    """Inputs of a program that are passed on whole to a loop."""
    found = set()
    for op, _, args in program.operations:
        if op == "call" and has_loop(called := program.subprograms[args[0].value]):
            first = 1
            for array in called.inputs:
                entries, first = args[first : first + array.size], first + array.size
                if len(entries) >= MIN_ENTRIES_IN_LOOP:
                    found.add(whole_input(program, entries, array))
    return sorted(found - {None})


def body_of(e: Emitter, program: Program, load: Callable, array: Callable, is_quick: bool = False) -> Body:
    """The operations of a program as code, or as data of a loop where they are too many.

    `is_quick`: whether code is wanted that compiles quickly.
    """
    from jaxdyn.compile.listing import Listing, has_table

    return (Listing if has_table(program, is_quick) else Body)(e, program, load, array)


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
                if type(x) is not Constant and operations[x].op == "mul" and uses[x] == 1:
                    found[i] = place
                    break
    return found


def write_call(e: Emitter, called: Program, pointers: Sequence[str]) -> None:
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
            memory.copy(e, pointer, f"%r{i}", array.size * array.dtype.itemsize * width)
            continue
        is_empty = has_zeros(row)
        if is_empty:
            memory.zero(e, f"%r{i}", array.size * array.dtype.itemsize * width)
        for k, x in enumerate(row):
            if not (is_empty and is_zero(x)):
                e.store_at(f"%r{i}", k, kind_of(array.dtype), body.text(x, kind_of(array.dtype)))
    names = [f"%a{i}" for i in range(len(called.inputs))] + [f"%r{i}" for i in range(len(called.outputs))]
    head = f"define void @called({', '.join(f'ptr noalias {name}' for name in names)}) #0 {{"
    allocations, free, declared = on_heap(body.allocations())
    lines = [head, *allocations, *e.lines, *free, "  ret void", "}"]
    return "\n".join([*lines, *declared, *e.declared.values(), *ATTRIBUTES])


def calls_itself(program: Program, width: int) -> bool:
    """Decide whether a kernel is a call of its program as a subprogram, whose code other kernels share."""
    fast = program.fast or program
    return width == 1 and fast.cost >= MIN_SHARED_OPERATIONS and not fast.subprograms


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
    entries = {x.args for x in fast.operations if x.op == "input"}
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

    body, valid, allocations = body_of(e, fast, load, array, is_quick), None, []
    for place in body.arrays_in_memory() if width > 1 else ():
        packed[place], given = f"%packed{place}", arrays[place]
        allocations.append(allocation(packed[place], bytes_of(given, width)))
        source = [f"%a{place}"] * width if uniform[place] else rows[place]
        memory.pack(e, source, packed[place], given.size, kind_of(given.dtype))
    # The kernel of one sample of a large program is a call: the same code serves as a subprogram of steps and rollouts.
    if calls_itself(program, width):
        pointers = [str(array(i)) for i in range(len(arrays))]
        if program.careful is not None:
            allocations.append("  %valid = alloca i8")
            pointers.append("%valid")
        write_call(e, fast, pointers)
        valid = None if program.careful is None else e.load_at("%valid", 0, "b1")
    else:
        body.compute()
        for i, (row, output) in enumerate(zip(fast.results, program.outputs, strict=False)):
            kind, pointer = kind_of(output.dtype), body.pointer_to(row, output)
            if pointer is not None and len(row) >= MIN_ENTRIES_IN_LOOP:
                memory.unpack(e, pointer, rows[count + i], len(row), kind)
            elif has_zeros(row):
                for at in rows[count + i]:
                    memory.zero(e, at, output.size * output.dtype.itemsize)
                for k, x in enumerate(row):
                    if not is_zero(x):
                        e.store(rows[count + i], k, kind, body.text(x, kind))
            else:
                e.store_array(rows[count + i], kind, [body.text(x, kind) for x in row])
        if program.careful is not None:
            valid = body.text(fast.results[-1][0], "b1")
    if valid is not None and program.careful is not None:
        flag = e.operation("not", "b1", [valid], "b1")
        same = [*uniform, *[False] * len(program.outputs)]
        places = [(f"%a{i}", 0 if same[i] else x.size * x.dtype.itemsize) for i, x in enumerate(arrays)]
        body.careful = max(body.careful, careful_text.write_call_of_rows(e, program.careful, flag, places))
    # Arguments that are not read are not in the code, but the handler checks their sizes, so that the hash covers them.
    sizes = " ".join(
        f"{'same' if i < count and uniform[i] else 'each'}:{x.size}x{x.dtype}" for i, x in enumerate(arrays)
    )
    return wrap_kernel(e, f"{count} {sizes}", uniform, len(program.outputs), [*body.allocations(), *allocations])


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
