"""The text of a function over a batch: several samples at once, in the lanes of vector registers."""

from typing import Any

from jaxdyn.compile.code import Body
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import kind_of
from jaxdyn.compile.standalone import DEGENERATE, Text
from jaxdyn.export.arguments import fields_of


def batch_ir(exported: Any, width: int) -> Text:
    """The text of `i32 name_batch(i64 n, ptr a0, ..., ptr r0, ...)` over the samples 0 .. n - 1.

    Arrays have one row for each sample; a structure is the same for all. The status is 0, or `DEGENERATE` where a sample is
    degenerate; the results of such samples are NaN.
    """
    e, program, fields = Emitter(width), exported.program, fields_of(exported.arguments)
    count = len(exported.arguments)
    shared = [x.is_structure for x in exported.arguments]
    outputs = program.outputs[:-1]
    # Results follow the arguments in the numbering of pointers.
    sizes = {i: x.bytes for i, x in enumerate(exported.arguments) if not shared[i]}
    sizes |= {count + i: x.size * x.dtype.itemsize for i, x in enumerate(outputs)}
    rows = e.rows(list(sizes), list(sizes.values()))

    def load(place, entry, kind):
        field = fields[place]
        if not shared[field.argument]:
            return e.load(rows[field.argument], entry, kind)
        # One load and a copy to all lanes.
        value = Emitter(1)
        value.count = e.count
        at = value.emit(f"getelementptr i8, ptr %a{field.argument}, i64 {field.offset}")
        name = value.load_one(at, entry, kind)
        e.lines += value.lines
        e.count = value.count
        if width == 1:
            return name
        of, scalar = e.type(kind), value.type(kind)
        first = e.emit(f"insertelement {of} poison, {scalar} {name}, i32 0")
        return e.emit(f"shufflevector {of} {first}, {of} poison, <{width} x i32> zeroinitializer")

    body = Body(e, program, load, lambda place: None)
    *results, flag = body.results()
    for i, (row, array) in enumerate(zip(results, outputs, strict=True)):
        e.store_array(rows[count + i], kind_of(array.dtype), row)
    regular = flag[0]
    if width > 1:
        name = f"llvm.vector.reduce.and.v{width}i1"
        e.declared[name] = f"declare i1 @{name}({e.type('b1')})"
        regular = e.emit(f"call i1 @{name}({e.type('b1')} {regular})")
    code = e.emit(f"select i1 {regular}, i32 0, i32 {DEGENERATE}")
    after = e.emit(f"or i32 %status, {code}")
    pointers = [f"ptr %a{i}" for i in range(count + len(outputs))]
    text = "\n".join(
        [
            f"define i32 @{exported.name}_batch(i64 %n, {', '.join(pointers)}) #0 {{",
            "entry:",
            "  %last = sub i64 %n, 1",
            "  %some = icmp sgt i64 %n, 0",
            "  br i1 %some, label %block, label %none",
            "block:",
            "  %base = phi i64 [ 0, %entry ], [ %next, %following ]",
            f"  %status = phi i32 [ 0, %entry ], [ {after}, %following ]",
            *e.lines,
            "  br label %following",
            "following:",
            f"  %next = add i64 %base, {width}",
            "  %more = icmp slt i64 %next, %n",
            "  br i1 %more, label %block, label %done",
            "none:",
            "  ret i32 0",
            "done:",
            f"  ret i32 {after}",
            "}",
        ]
    )
    return Text(text, e.declared)
