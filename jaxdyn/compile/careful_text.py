"""The text of calls of careful programs: `careful` of `handler.ll`, for those samples of a block whose flag is set."""

import hashlib
from collections.abc import Sequence

from jaxdyn.compile.careful import Careful
from jaxdyn.compile.llvm import Emitter

CAREFUL = "jaxdyn_careful"
_ALIGNED = 64  # bytes


def identity_of(program, width: int, uniform: Sequence[bool]) -> str:
    """Identity of the code of the kernel of a program."""
    return f"{program.digest} {width} {tuple(uniform)}"


def number_of(program, width: int, uniform: Sequence[bool]) -> int:
    """The number by which the handler finds the kernel of a program."""
    content = identity_of(program, width, uniform)
    # A hash, not a counter: a program in XLA's persistent cache finds its kernel in another process. 63 bits, as the attribute is
    # signed; odd, as zero marks an empty slot.
    return int.from_bytes(hashlib.sha256(content.encode()).digest()[:8], "little") >> 1 | 1


def write_call(e: Emitter, called: Careful, flag: str, pointers: Sequence[str]) -> int:
    """A call for W samples, whose arrays have the layout of a subprogram's; bytes of `%careful` that it takes."""
    sizes = [x.dtype.itemsize for x in (*called.inputs, *called.outputs)]
    fields = [(x, size * e.width, size) for x, size in zip(pointers, sizes, strict=True)]
    return _write(e, called, flag, fields, "-1")


def write_call_of_rows(e: Emitter, called: Careful, flag: str, rows: Sequence[tuple[str, int]]) -> int:
    """The same for the samples from `%base` on in rows, whose first pointers and strides are given."""
    rare, on = f"careful{len(e.lines)}", f"on{len(e.lines)}"
    e.lines += [f"  br i1 {e.any(flag)}, label %{rare}, label %{on}", f"{rare}:"]
    fields = []
    for (pointer, stride), array in zip(rows, (*called.inputs, *called.outputs), strict=True):
        offset = e.emit(f"mul i64 %base, {stride}")
        fields.append((e.emit(f"getelementptr i8, ptr {pointer}, i64 {offset}"), array.dtype.itemsize, stride))
    # Elements of a vector beyond the last sample are that sample once more.
    left = e.emit("sub i64 %n, %base")
    few = e.emit(f"icmp ult i64 {left}, {e.width}")
    within = e.emit(f"select i1 {few}, i64 {left}, i64 {e.width}")
    beyond = e.emit(f"sub i64 64, {within}")
    taken = _write(e, called, flag, fields, e.emit(f"lshr i64 -1, {beyond}"))
    e.lines += [f"  br label %{on}", f"{on}:"]
    return taken


def allocation(taken: int) -> list[str]:
    """Memory for the calls of a function."""
    return [f"  %careful = alloca [{taken} x i8], align {_ALIGNED}"] if taken else []


def _write(e: Emitter, called: Careful, flag: str, fields: Sequence[tuple[str, int, int]], within: str) -> int:
    """`fields`: pointer, bytes from entry to entry and from sample to sample; `within`: bits of the samples that exist."""
    # In %careful: the pointers of the fields, then those of the rows that the kernel is given, then these.
    pointers = _lines(8 * len(fields))
    place, layout = pointers, []
    for k, ((pointer, *steps), array) in enumerate(zip(fields, (*called.inputs, *called.outputs), strict=True)):
        at = e.emit(f"getelementptr ptr, ptr %careful, i64 {k}")
        e.lines.append(f"  store ptr {pointer}, ptr {at}")
        layout += [array.size, array.dtype.itemsize, *steps, place]
        place += _lines(array.size * array.dtype.itemsize)
    name = f"@layout{len(e.declared)}"
    e.declared[name] = f"{name} = private constant [{len(layout)} x i64] [{', '.join(f'i64 {x}' for x in layout)}]"
    bits = flag if e.width == 1 else e.emit(f"bitcast {e.type('b1')} {flag} to i{e.width}")
    bits = e.emit(f"zext i{e.width} {bits} to i64")
    mask, rows = e.emit(f"and i64 {bits}, {within}"), e.emit(f"getelementptr i8, ptr %careful, i64 {pointers}")
    numbers = number_of(called, 1, [False] * len(called.inputs)), e.width, mask, len(called.inputs), len(fields)
    e.declared[CAREFUL] = f"declare void @{CAREFUL}(i64, i64, i64, i64, i64, ptr, ptr, ptr)"
    given = ", ".join([*(f"i64 {x}" for x in numbers), "ptr %careful", f"ptr {name}", f"ptr {rows}"])
    e.lines.append(f"  call void @{CAREFUL}({given})")
    return pointers + place


def _lines(size: int) -> int:
    """A size rounded up to whole cache lines."""
    return -(-size // _ALIGNED) * _ALIGNED
