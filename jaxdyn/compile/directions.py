"""Jacobians as loops over columns: directional derivatives along several coordinates at once, in vector registers.

Written out number by number, the Jacobian of a humanoid has a quarter of a million operations: LLVM takes minutes for them, and
they are slower to fetch than to compute. Here the operations that depend on the point alone are computed once, as single
numbers. What is linear in the direction is written once for each argument of the function, over the lanes of a vector
register, and a loop takes the columns of that argument, as many as there are lanes, in each turn.
"""

from collections.abc import Callable, Sequence
from typing import Any

from jaxdyn.compile.body import Body
from jaxdyn.compile.derive import replay
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import Array, Constant, NotNumbers, Number, Program, dtype_of, kind_of, objects


class Directions:
    """The Jacobians of all float outputs of a program by all float inputs; stands in the place of a `Program`.

    - `point`: from the inputs to the numbers that the linear programs need, one array for each kind, and the flag.
    - `linear`: for each float input, from these arrays and a direction to the changes of all outputs.
    - `results`: for each entry of each Jacobian, a `Constant` zero where no direction reaches it.
    """

    is_called = False

    def __init__(self, program: Program, change: Program):
        graph, count = Graph(), len(program.inputs)
        primal = [graph.inputs(place, array) for place, array in enumerate(program.inputs)]
        self.varied = [array for array in program.inputs if array.dtype.kind == "f"]
        values = [array for array in program.outputs if array.dtype.kind == "f"]
        changes = []
        for place in range(len(self.varied)):
            # Directions along other arguments are known zeros, which the graph folds.
            steps = [
                graph.inputs(count + i, x) if i == place else objects([0.0] * x.size, x.shape)
                for i, x in enumerate(self.varied)
            ]
            changes.append([x.ravel().tolist() for x in replay(graph, change, [*primal, *steps])[1]])
        flag = replay(graph, program, primal)[1][-1]
        reach = _reach(graph, count)
        needed = _dependencies(reach, [x for rows in changes for row in rows for x in row])
        kept: dict[str, dict[Number, int]] = {}
        for number in needed:
            if not reach[number]:
                numbers = kept.setdefault(number.kind, {})
                numbers[number] = len(numbers)
        arrays = [Array((len(numbers),), dtype_of(kind)) for kind, numbers in kept.items()]
        entries = [objects(list(numbers), (len(numbers),)) for numbers in kept.values()]
        self.linear = [
            _linear_program(graph, needed, reach, kept, [*arrays, x], values, rows)
            for x, rows in zip(self.varied, changes, strict=True)
        ]
        self.point = graph.finish(program.inputs, [*arrays, program.outputs[-1]], [*entries, flag])
        self.inputs = program.inputs
        blocks = [Array((y.size, x.size), y.dtype) for y in values for x in self.varied]
        self.outputs = (*blocks, program.outputs[-1])
        pattern = [
            _entries(rows[i], x.size, reach)
            for i in range(len(values))
            for x, rows in zip(self.varied, changes, strict=True)
        ]
        self.results = (*pattern, self.point.results[-1])
        self.subprograms = self.point.subprograms
        self.name = program.name

    @property
    def cost(self) -> int:
        """Operations that are written, not how often they are carried out."""
        return self.point.cost + sum(x.cost for x in self.linear)

    def lines(self, e: Emitter, name: str, lanes: int, load: Callable, leave: Callable) -> tuple[list[str], str]:
        """Write the function `name`, from inputs that `load` reads to results %r0, %r1, ...; returns allocations and the flag.

        `lanes`: float64 numbers in a vector register. `leave(flag)`: lines between the numbers of the point and the loops.
        """
        body = Body(e, self.point, load, lambda place: None)
        *rows, (flag,) = body.results()
        allocated = body.allocations()
        for i, (row, array) in enumerate(zip(rows, self.point.outputs, strict=False)):
            allocated.append(f"  %point{i} = alloca [{max(1, array.size)} x {_MEMORY[kind_of(array.dtype)]}], align 64")
            for k, value in enumerate(row):
                e.store_one(f"%point{i}", k, kind_of(array.dtype), value)
        e.lines += leave(flag)
        for place in range(len(self.varied)):
            self._loop(e, name, place, lanes)
        return allocated, flag

    def _loop(self, e: Emitter, name: str, place: int, lanes: int) -> None:
        """Lines of the loop over the columns of one argument."""
        program, array = self.linear[place], self.varied[place]
        size, kind = array.size, kind_of(array.dtype)
        if not size:
            return
        width = _width(size, lanes * 8 // array.dtype.itemsize)
        table, middle = f"{name}_unit_{kind}_{size}", size
        # A one between zeros: read from different places it is the directions of the columns of a turn.
        ones = ", ".join(f"{_MEMORY[kind]} {float(i == middle)}" for i in range(2 * size + width))
        e.declared[table] = f"@{table} = internal constant [{2 * size + width} x {_MEMORY[kind]}] [{ones}], align 64"
        label, last = f"columns{place}", size - width
        e.lines += [f"  br label %before{place}", f"before{place}:", f"  br label %{label}", f"{label}:"]
        e.lines.append(f"  %column{place} = phi i64 [ 0, %before{place} ], [ %following{place}, %{label} ]")
        f = Emitter(width)
        f.count, f.stores = e.count, e.stores
        at = f.emit(f"mul i64 %column{place}, {array.dtype.itemsize}")
        unit = f.emit(f"getelementptr i8, ptr @{table}, i64 {at}")

        def load(source, entry, kind):
            if source == len(program.inputs) - 1:
                where = f.emit(f"getelementptr i8, ptr {unit}, i64 {(middle - entry) * array.dtype.itemsize}")
                return f.emit(f"load {f.type(kind)}, ptr {where}, align {array.dtype.itemsize}")
            value = f.load_one(f"%point{source}", entry, kind)
            return value if width == 1 else f.splat(value, kind)

        rows = Body(f, program, load, lambda place: None).results()
        for i, (row, output) in enumerate(zip(rows, program.outputs, strict=True)):
            item = output.dtype.itemsize
            step = f.emit(f"mul i64 %column{place}, {item}")
            base = f.emit(f"getelementptr i8, ptr %r{i * len(self.varied) + place}, i64 {step}")
            for k, value in enumerate(row):
                where = f.emit(f"getelementptr i8, ptr {base}, i64 {k * size * item}")
                f.emit_store(f"  store {f.type(kind_of(output.dtype))} {value}, ptr {where}, align {item}")
        e.lines += f.lines
        e.count, e.stores = f.count, f.stores
        e.declared |= f.declared
        # The last turn begins early where the columns are no multiple of the lanes, and computes some of them twice.
        ahead = e.emit(f"add i64 %column{place}, {width}")
        inside = e.emit(f"icmp slt i64 {ahead}, {last}")
        e.lines += [
            f"  %following{place} = select i1 {inside}, i64 {ahead}, i64 {last}",
            f"  %more{place} = icmp ne i64 %column{place}, {last}",
            f"  br i1 %more{place}, label %{label}, label %after{place}",
            f"after{place}:",
        ]


_MEMORY = {"f8": "double", "f4": "float", "b1": "i8", "i4": "i32", "i8": "i64"}


def _width(size: int, lanes: int) -> int:
    """The largest power of two that is neither more than the columns nor than the lanes."""
    width = 1
    while 2 * width <= min(size, lanes):
        width *= 2
    return width


def _reach(graph: Graph, count: int) -> dict[Number, int]:
    """For each number the entries of the direction that it depends on, as the bits of an integer."""
    reach: dict[Number, int] = {}
    for number in graph.numbers:  # operands come before what is computed from them
        if number.op == "input":
            reach[number] = 1 << number.args[1] if number.args[0] >= count else 0
            continue
        bits = 0
        for x in number.args:
            if type(x) is Number:
                bits |= reach[x]
        if bits and number.op in ("call", "part"):
            raise NotNumbers("a pseudo-inverse without a rule for its derivative")
        reach[number] = bits
    return reach


def _dependencies(reach: dict[Number, int], results: list) -> dict[Number, None]:
    """Numbers that the results need, as far as they depend on a direction, and the numbers of the point that those take."""
    needed: dict[Number, None] = {}
    waiting = [x for x in results if type(x) is Number]
    while waiting:
        number = waiting.pop()
        if number not in needed:
            needed[number] = None
            if reach[number] and number.op != "input":
                waiting.extend(x for x in number.args if type(x) is Number)
    return needed


def _linear_program(graph, needed, reach, kept, inputs, outputs: Sequence[Array], rows: list) -> Program:
    """The changes of all outputs for a direction along one argument, from the numbers of the point."""
    linear, kinds = Graph(), list(kept)
    made: dict[Number, Any] = {}

    def operand(x):
        if type(x) is not Number or reach[x]:
            return made[x] if type(x) is Number else x
        return linear.make("input", x.kind, kinds.index(x.kind), kept[x.kind][x])

    of_this = _dependencies(reach, [x for row in rows for x in row])
    for number in graph.numbers:
        if number in of_this and reach[number]:
            if number.op == "input":
                made[number] = linear.make("input", number.kind, len(kinds), number.args[1])
            else:
                made[number] = linear.make(number.op, number.kind, *map(operand, number.args))
    entries = [objects([operand(x) for x in row], (len(row),)) for row in rows]
    return linear.finish(inputs, [Array((y.size,), y.dtype) for y in outputs], entries)


def _entries(row: list, size: int, reach: dict[Number, int]) -> tuple:
    """For each entry of a Jacobian of `size` columns, a known zero, or a place holder."""
    bits = [reach[x] if type(x) is Number else 0 for x in row]
    return tuple(0 if b >> k & 1 else Constant(0.0) for b in bits for k in range(size))
