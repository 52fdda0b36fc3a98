"""Text of a function over a batch: several samples at once in vector registers."""

from typing import Any

from jaxdyn.compile.body import Body
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import kind_of
from jaxdyn.compile.standalone import DEGENERATE, NOT_FINITE, Text, all_finite
from jaxdyn.exports.arguments import fields_of


def batch_ir(exported: Any, width: int) -> Text:
    """Text of `i32 name_batch(i64 n, ptr a0, ..., ptr r0, ...)` over the samples 0 .. n - 1.

    Arrays have one row for each sample; a structure is the same for all. The status has the bits of all samples. Results of
    samples without a regular solution are NaN.
    """
    program = exported.value.program
    # Pseudo-inverses take another number of sweeps for each sample, so these are computed one at a time.
    e = Emitter(1 if program.subprograms else width)
    arguments, outputs = exported.arguments, program.outputs[:-1]
    # Results follow the arguments in the numbering of pointers.
    sizes = {i: x.bytes for i, x in enumerate(arguments) if not x.is_structure}
    sizes |= {len(arguments) + i: x.size * x.dtype.itemsize for i, x in enumerate(outputs)}
    # Where fewer samples are left than lanes, the last sample stands in the others too: no code for a remainder, and no reading
    # beyond the arrays. It is computed several times and stored as often.
    rows = e.rows(list(sizes), list(sizes.values()))
    if program.subprograms:
        status = _single_calls(e, exported, rows)
        e.lines += ["  br label %following"]
        incoming = [(status, "%block")]
    else:
        incoming = _vector_block(e, exported, rows)
    pointers = [f"ptr %a{i}" for i in range(len(arguments) + len(outputs))]
    text = "\n".join(
        [
            f"define i32 @{exported.name}_batch(i64 %n, {', '.join(pointers)}) #0 {{",
            "entry:",
            "  %last = sub i64 %n, 1",
            "  %some = icmp sgt i64 %n, 0",
            "  br i1 %some, label %block, label %none",
            "block:",
            "  %base = phi i64 [ 0, %entry ], [ %next, %following ]",
            "  %worst = phi i32 [ 0, %entry ], [ %after, %following ]",
            *e.lines,
            "following:",
            f"  %status = phi i32 {', '.join(f'[ {value}, {label} ]' for value, label in incoming)}",
            "  %after = or i32 %worst, %status",
            f"  %next = add i64 %base, {e.width}",
            "  %more = icmp slt i64 %next, %n",
            "  br i1 %more, label %block, label %done",
            "none:",
            "  ret i32 0",
            "done:",
            "  ret i32 %after",
            "}",
        ]
    )
    return Text(text, e.declared)


def _vector_block(e: Emitter, exported: Any, rows: dict[int, list[str]]) -> list[tuple[str, str]]:
    """Compute W samples at once, and again one at a time where the program flags one; returns statuses and their blocks."""
    routine, fields, width = exported.value, fields_of(exported.arguments), e.width

    def load(place, entry, kind):
        field = fields[place]
        if not exported.arguments[field.argument].is_structure:
            return e.load(rows[field.argument], entry, kind)
        # One load and a copy to all lanes.
        value = Emitter(1)
        # Registers have numbers: each emitter counts on from the other, or a name would be defined twice.
        value.count = e.count
        at = value.emit(f"getelementptr i8, ptr %a{field.argument}, i64 {field.offset}")
        name = value.load_one(at, entry, kind)
        e.lines += value.lines
        e.count = value.count
        return name if width == 1 else e.splat(name, kind)

    *results, (flag,) = Body(e, routine.program, load, lambda place: None).results()
    regular = _all_lanes(e, flag)
    incoming = []
    if routine.careful is not None:
        e.lines += [f"  br i1 {regular}, label %regular, label %careful", "careful:"]
        # Rare, so that the other samples of the block are simply computed again.
        incoming.append((_single_calls(e, exported, rows), "%careful"))
        e.lines += ["  br label %following", "regular:"]
    for i, (row, array) in enumerate(zip(results, routine.program.outputs, strict=False)):
        e.store_array(rows[len(exported.arguments) + i], kind_of(array.dtype), row)
    finite = _all_lanes(e, all_finite(e, results, routine.program.outputs))
    code = e.emit(f"select i1 {finite}, i32 0, i32 {NOT_FINITE}")
    code = e.emit(f"select i1 {regular}, i32 {code}, i32 {DEGENERATE}")
    # A label of its own: sines of large angles have branches, so that these lines may not be in %block any more.
    e.lines += ["  br label %stored", "stored:", "  br label %following"]
    return [*incoming, (code, "%stored")]


def _all_lanes(e: Emitter, flag: str) -> str:
    """Flag that is set where that of every sample is."""
    if e.width == 1:
        return flag
    name = f"llvm.vector.reduce.and.v{e.width}i1"
    e.declared[name] = f"declare i1 @{name}({e.type('b1')})"
    return e.emit(f"call i1 @{name}({e.type('b1')} {flag})")


def _single_calls(e: Emitter, exported: Any, rows: dict[int, list[str]]) -> str:
    """Call the function of one sample for each of the W samples; returns the bits of all statuses."""
    count = len(exported.arguments) + len(exported.value.program.outputs) - 1
    total = "0"
    for k in range(e.width):
        pointers = [f"ptr {rows[i][k]}" if i in rows else f"ptr %a{i}" for i in range(count)]
        status = e.emit(f"call i32 @{exported.name}({', '.join(pointers)})")
        # Bits are collected, so that one status reports every kind of failure among the samples.
        total = e.emit(f"or i32 {total}, {status}")
    return total
