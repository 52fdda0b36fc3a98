"""The text of kernels: from a program of numbers to LLVM's intermediate representation.

A kernel is `void kernel(ptr data, i64 n, i64 begin, i64 end)`: `data` points to the arguments, first those that have a row of
numbers per sample, then those that are uniform, one row for all samples, and then to the results; samples begin .. end - 1 of n
are computed, W at a time. Where fewer than W remain, the last sample fills the other elements of the vectors.
"""

from collections.abc import Callable, Sequence

from jaxdyn.compile import careful_text, memory
from jaxdyn.compile.body import MIN_ENTRIES_IN_LOOP, Body, has_zeros, is_zero, write_call
from jaxdyn.compile.listing import Listing, has_table
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.memory import allocation, bytes_of, on_heap
from jaxdyn.compile.program import FLOATS, Program, kind_of

# A program of one sample with at least so many operations is compiled once for all kernels that contain it: the copies of a
# call's arguments are few against them.
MIN_SHARED_OPERATIONS = 2000
ATTRIBUTES = (
    # LLVM's simplifications of calls of the C library, such as pow(x, 2) = x x, are made at some levels alone.
    'attributes #0 = { nounwind "no-builtins" }',
    "attributes #1 = { nounwind willreturn memory(none) }",
)


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

    valid, allocations, taken = None, [], 0
    # The kernel of one sample of a large program is a call: the same code serves as a subprogram of steps and rollouts.
    if calls_itself(program, width):
        pointers = [str(array(i)) for i in range(len(arrays))]
        if program.careful is not None:
            allocations.append("  %valid = alloca i8")
            pointers.append("%valid")
        write_call(e, fast, pointers)
        valid = None if program.careful is None else e.load_at("%valid", 0, "b1")
    else:
        body = body_of(e, fast, load, array, is_quick)
        for place in body.arrays_in_memory() if width > 1 else ():
            packed[place], given = f"%packed{place}", arrays[place]
            allocations.append(allocation(packed[place], bytes_of(given, width)))
            source = [f"%a{place}"] * width if uniform[place] else rows[place]
            memory.pack(e, source, packed[place], given.size, kind_of(given.dtype))
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
        taken, body.careful = body.careful, 0
        allocations += body.allocations()
    if valid is not None and program.careful is not None:
        flag = e.operation("not", "b1", [valid], "b1")
        same = [*uniform, *[False] * len(program.outputs)]
        places = [(f"%a{i}", 0 if same[i] else x.size * x.dtype.itemsize) for i, x in enumerate(arrays)]
        taken = max(taken, careful_text.write_call_of_rows(e, program.careful, flag, places))
    # Arguments that are not read are not in the code, but the handler checks their sizes, so that the hash covers them.
    sizes = " ".join(
        f"{'same' if i < count and uniform[i] else 'each'}:{x.size}x{x.dtype}" for i, x in enumerate(arrays)
    )
    return wrap_kernel(
        e, f"{count} {sizes}", uniform, len(program.outputs), [*allocations, *careful_text.allocation(taken)]
    )


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
