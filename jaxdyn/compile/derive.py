"""Derivatives of scalar programs, which are scalar programs too: the tangent, and the transpose of a linear program.

In the tangent the change of a number is the sum of its partial derivatives times the changes of its operands. Operands that do
not change add no terms. Reverse mode transposes the tangent with respect to the changes: the values of the original program that
its partial derivatives need are operations of the same program, so that they are computed once.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxdyn.compile import stored
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import FLOATS, Array, Constant, NotNumbers, Program, derived, is_number, kind_of, objects


@derived
def tangent(program: Program, moving: tuple[bool, ...]) -> Program:
    """Tangent of a program, as a program: the change of the floating-point outputs.

    Its inputs are all inputs of `program`, followed by the changes of the inputs that are `moving`.
    """
    # Known numbers are folded by NumPy, which warns of overflows and NaN that XLA computes without a word.
    with np.errstate(all="ignore"):
        if program.derivative is not None:  # a rule, which keeps its program itself, as that may have a rule again
            return program.derivative(moving)
        return stored.make_within(program, ("tangent", moving), functools.partial(_tangent, program, moving))


def _tangent(program: Program, moving: tuple[bool, ...]) -> Program:
    # Called subprograms are inlined: the tangent then shares their values instead of calling a second program that repeats them.
    program, graph = inline(program), Graph()
    arrays = [*program.inputs, *(x for x, varies in zip(program.inputs, moving, strict=True) if varies)]
    entries = [graph.inputs(index, array) for index, array in enumerate(arrays)]
    primal, input_changes = entries[: len(moving)], iter(entries[len(moving) :])
    changes_in = [next(input_changes).ravel().tolist() if varies else None for varies in moving]
    # After inlining, only subprograms with loops are still called. A scan computes values and changes in one loop.
    values: list = [] if program.subprograms else replay(graph, program, primal)[0]
    changes: list = []  # of each operation: a Number, or 0.0 where it does not change
    for i, (op, kind, args) in enumerate(program.operations):
        if op == "input":
            index, entry = args
            row = changes_in[index]
            changes.append(0.0 if row is None else row[entry])
            if i == len(values):
                values.append(primal[index].reshape(-1)[entry])
            continue
        operands = [x.value if type(x) is Constant else values[x] for x in args]
        if op == "part":
            call, (values_of, entry) = changes[args[0]], operands
            values.append(values_of[entry])
            changes.append(0.0 if type(call) is float else call[entry])
            continue
        operand_changes = [(0.0 if type(x) is Constant else changes[x]) for x in args]
        any_change = any(is_number(x) or x != 0 for x in operand_changes)
        if op in ("call", "call_where") and any_change:
            called = program.subprograms[operands[0]]
            if op == "call_where" or not hasattr(called, "call_with_changes"):
                raise NotNumbers("a branch, or a pseudo-inverse without a rule for its derivative")
            value, change = called.call_with_changes(graph, operands[1:], operand_changes[1:])
            values.append(value)
            changes.append(change)
            continue
        if i == len(values):
            values.append(repeat(graph, program, op, kind, operands))
        value = values[i]
        # Integers and bools have no change. Numbers whose operands do not change have none either: this keeps tangents short.
        varies = kind in FLOATS and any_change
        changes.append(_change(graph, op, kind, value, operands, operand_changes) if varies else 0.0)
    rows, outputs = [], [array for array in program.outputs if array.dtype.kind == "f"]
    for row, array in zip(program.results, program.outputs, strict=True):
        if array.dtype.kind == "f":
            rows.append(objects([0.0 if type(x) is Constant else changes[x] for x in row], array.shape))
    return _finish(graph, program, arrays, outputs, rows, values, f"change of {program.name}")


def _finish(graph: Graph, program: Program, inputs, outputs, rows, values, name: str) -> Program:
    """The program of a derivative, which reports the validity of the values where `program` does."""
    if not program.reports_validity:
        return graph.finish(inputs, outputs, rows, name=name)
    ((valid,), array) = program.results[-1], program.outputs[-1]
    flag = objects([valid.value if type(valid) is Constant else values[valid]], ())
    made = graph.finish(inputs, [*outputs, array], [*rows, flag], name=name)
    made.reports_validity = True
    return made


def _change(g: Graph, op: str, kind: str, value, x: list, d: list):
    """The change of value = op(*x) for the changes d of its operands."""
    if op == "add":
        return g.add(*d)
    if op == "sub":
        return g.sub(*d)
    if op == "neg":
        return g.neg(*d)
    if op == "mul":
        return g.add(g.mul(d[0], x[1]), g.mul(x[0], d[1]))
    if op == "div":
        # (dx - y dz)/z with one reciprocal, which other quotients by z share: a division costs as much as ten products.
        inverse = g.div(1.0, x[1])
        return g.mul(g.sub(d[0], g.mul(value, d[1])), inverse)
    if op in _CHOICES:
        return _choice_change(g, op, kind, value, x, d)
    if op == "convert":
        return g.convert(d[0], kind)
    if op in _PARTIAL:
        return g.mul(_PARTIAL[op](g, value, *x), d[0])
    if op == "pow":
        by_base = g.mul(x[1], g.function_of_two("pow", x[0], g.sub(x[1], 1.0)))
        total = g.mul(by_base, d[0])
        if is_number(d[1]) or d[1] != 0:
            # d(x^y)/dy = x^y log(x). At x = 0 the power is 0 or 1 for all y >= 0, so the derivative is zero, by log(1) in the
            # place of log(0). For x < 0 the power exists at whole y only: the NaN of the logarithm is right.
            is_zero = g.compare("eq", x[0], 0.0)
            logarithm = g.function("log", g.select(is_zero, x[0], 1.0, kind))
            total = g.add(total, g.mul(g.mul(value, logarithm), d[1]))
        return total
    if op == "atan2":  # d atan2(y, x) = (x dy - y dx)/(x^2 + y^2), with x[0] = y and x[1] = x
        square = g.add(g.mul(x[0], x[0]), g.mul(x[1], x[1]))
        by_first = g.mul(g.div(x[1], square), d[0]) if is_number(d[0]) or d[0] != 0 else 0.0
        by_second = g.mul(g.div(x[0], square), d[1]) if is_number(d[1]) or d[1] != 0 else 0.0
        return g.sub(by_first, by_second)
    if op == "rem":
        # x - trunc(x/y) y, where the truncated quotient is constant almost everywhere.
        quotient = g.div(x[0], x[1])
        whole = g.select(
            g.compare("lt", quotient, 0.0), g.function("floor", quotient), g.function("ceil", quotient), kind
        )
        return g.sub(d[0], g.mul(whole, d[1]))
    return 0.0  # floor, ceil, round, sign, stop_gradient


_CHOICES = "select", "max", "min", "reduce_max", "reduce_min", "clamp", "abs"


def _choice_change(g: Graph, op: str, kind: str, value, x: list, d: list):
    """`_change` of operations that return one of their operands."""
    if op == "select":
        return g.select(x[0], d[1], d[2], kind)
    # Ties follow the rules of JAX, so that both give the same derivative: equal operands of a maximum of two get one half each,
    # and if the maximum is NaN, neither operand changes it.
    if op in ("max", "min"):
        comparisons = ("gt", "lt") if op == "max" else ("lt", "gt")
        first, second = (g.compare(comparison, x[0], x[1]) for comparison in comparisons)
        chosen = g.select(first, g.select(second, 0.0, d[1], kind), d[0], kind)
        return g.select(g.compare("eq", x[0], x[1]), chosen, g.mul(0.5, g.add(d[0], d[1])), kind)
    if op in ("reduce_max", "reduce_min"):
        # The mean over all entries that equal the result. A chain of maxima of two would give unequal weights at a tie of three.
        hits = [g.compare("eq", entry, value) for entry in x]
        total = functools.reduce(g.add, [g.select(hit, 0.0, step, kind) for hit, step in zip(hits, d, strict=True)])
        return g.div(total, functools.reduce(g.add, [g.convert(hit, kind) for hit in hits]))
    if op == "clamp":
        # Comparisons are strict, as in JAX: on a bound the result has the derivative zero by the number and by the bound.
        low, inner, high = x
        is_below = g.both(g.compare("gt", low, inner), g.compare("lt", low, high))
        is_inside = g.both(g.compare("gt", inner, low), g.compare("lt", inner, high))
        flags = is_below, is_inside, g.compare("lt", high, inner)
        return functools.reduce(g.add, [g.select(flag, 0.0, step, kind) for flag, step in zip(flags, d, strict=True)])
    # "abs": at zero JAX uses the derivative of +x.
    return g.select(g.compare("ge", x[0], 0.0), g.neg(d[0]), d[0], kind)


# Functions of one operand: dy/dx from y and x. Where y is enough, no second function has to be evaluated.
_PARTIAL: dict[str, Callable[..., Any]] = {
    "sqrt": lambda g, y, x: g.div(0.5, y),
    "sin": lambda g, y, x: g.function("cos", x),
    "cos": lambda g, y, x: g.neg(g.function("sin", x)),
    "tan": lambda g, y, x: g.add(1.0, g.mul(y, y)),
    "asin": lambda g, y, x: g.div(1.0, g.function("sqrt", g.sub(1.0, g.mul(x, x)))),
    "acos": lambda g, y, x: g.div(-1.0, g.function("sqrt", g.sub(1.0, g.mul(x, x)))),
    "atan": lambda g, y, x: g.div(1.0, g.add(1.0, g.mul(x, x))),
    "sinh": lambda g, y, x: g.function("cosh", x),
    "cosh": lambda g, y, x: g.function("sinh", x),
    "tanh": lambda g, y, x: g.sub(1.0, g.mul(y, y)),
    "exp": lambda g, y, x: y,
    "exp2": lambda g, y, x: g.mul(float(np.log(2.0)), y),
    "expm1": lambda g, y, x: g.add(y, 1.0),
    "log": lambda g, y, x: g.div(1.0, x),
    "log1p": lambda g, y, x: g.div(1.0, g.add(1.0, x)),
    "cbrt": lambda g, y, x: g.mul(1 / 3, g.power(y, -2)),  # not y / (3 x), which is not a number at zero
}


@derived
def transpose(program: Program, linear: tuple[bool, ...], given: tuple[bool, ...]) -> Program:
    """Transpose of a program that is jointly linear in its `linear` inputs.

    Its inputs are the other inputs, followed by the cotangents of the outputs that are `given` (those of the other outputs are
    zero). Its outputs are the cotangents of the `linear` inputs.
    """
    with np.errstate(all="ignore"):
        make = functools.partial(_transpose, program, linear, given)
        return stored.make_within(program, ("transposed", linear, given), make)


def _transpose(program: Program, linear: tuple[bool, ...], given: tuple[bool, ...]) -> Program:
    program, graph = inline(program), Graph()
    fixed = [array for array, varies in zip(program.inputs, linear, strict=True) if not varies]
    arrays = [*fixed, *(array for array, is_given in zip(program.outputs, given, strict=True) if is_given)]
    entries = [graph.inputs(index, array) for index, array in enumerate(arrays)]
    # Fixed inputs come first, then the cotangents, as JAX's transpose rule passes them.
    operands = iter(entries[: len(fixed)])
    # Values that depend on the linear inputs are not needed: a linear operation is transposed from its other operands alone.
    values, calls = _coefficient_values(graph, program, [None if varies else next(operands) for varies in linear])
    # Each cotangent is a sum over the operations that use the value. Operands precede their users, so that in reverse order the
    # sum is complete when it is needed.
    cotangent_of: list = [0.0] * len(program.operations)
    for i, call in calls.items():
        cotangent_of[i] = [0.0] * len(call.values)
    cotangents = iter(entries[len(fixed) :])
    for row, is_given in zip(program.results, given, strict=True):
        if is_given:
            for operation, entry in zip(row, next(cotangents).ravel().tolist(), strict=True):
                if type(operation) is not Constant:
                    cotangent_of[operation] = graph.add(cotangent_of[operation], entry)
    input_cotangents = [
        [0.0] * array.size if varies else None for array, varies in zip(program.inputs, linear, strict=True)
    ]

    def accumulate(operand, cotangent):
        if type(operand) is not Constant and values[operand] is None:
            cotangent_of[operand] = graph.add(cotangent_of[operand], cotangent)

    for i in reversed(range(len(program.operations))):
        op, kind, args = program.operations[i]
        if i in calls:
            if any(is_number(x) or x != 0 for x in cotangent_of[i]):
                for operand, cotangent in zip(args[1:], calls[i].cotangents(cotangent_of[i]), strict=True):
                    accumulate(operand, cotangent)
            continue
        # An operation with a value does not depend on the linear inputs, and one with a zero cotangent contributes nothing.
        if values[i] is not None or not (is_number(cotangent_of[i]) or cotangent_of[i] != 0):
            continue
        if op == "part":
            of_call = cotangent_of[args[0]]
            of_call[args[1].value] = graph.add(of_call[args[1].value], cotangent_of[i])
        elif op == "input":
            row = input_cotangents[args[0]]
            assert row is not None
            row[args[1]] = cotangent_of[i]
        else:
            _transpose_operation(graph, op, kind, args, values, cotangent_of[i], accumulate, program)
    rows = [
        (objects(row, array.shape), array)
        for row, array, varies in zip(input_cotangents, program.inputs, linear, strict=True)
        if varies and row is not None
    ]
    name = f"transpose of {program.name}"
    return _finish(graph, program, arrays, [x[1] for x in rows], [x[0] for x in rows], values, name)


def _coefficient_values(graph: Graph, program: Program, inputs: list) -> tuple[list, dict[int, Any]]:
    """Values of the operations that do not depend on an input given as None, None for the others; calls that depend."""
    flat = [None if x is None else x.ravel().tolist() for x in inputs]
    values: list = []
    calls: dict[int, Any] = {}
    for i, (op, kind, args) in enumerate(program.operations):
        if op == "input":
            row = flat[args[0]]
            values.append(None if row is None else row[args[1]])
        elif op == "part" and args[0] in calls:
            values.append(calls[args[0]].values[args[1].value])
        elif op == "call" and any(type(x) is not Constant and values[x] is None for x in args):
            given = [x.value if type(x) is Constant else values[x] for x in args[1:]]
            calls[i] = program.subprograms[args[0].value].transpose_at(graph, given)
            values.append(calls[i].values)
        elif any(type(x) is not Constant and values[x] is None for x in args):
            values.append(None)
        else:
            operands = [x.value if type(x) is Constant else values[x] for x in args]
            values.append(repeat(graph, program, op, kind, operands))
    return values, calls


def _transpose_operation(g: Graph, op: str, kind: str, args, values, c, accumulate, program: Program) -> None:
    """Add the contributions of the cotangent c of a linear operation to the cotangents of its operands."""

    def value(x):
        return x.value if type(x) is Constant else values[x]

    if op == "add":
        accumulate(args[0], c)
        accumulate(args[1], c)
    elif op == "sub":
        accumulate(args[0], c)
        accumulate(args[1], g.neg(c))
    elif op == "neg":
        accumulate(args[0], g.neg(c))
    elif op == "mul":
        first, second = value(args[0]), value(args[1])
        assert first is not None or second is not None, "a product of two changes is not linear"
        if first is None:
            accumulate(args[0], g.mul(c, second))
        else:
            accumulate(args[1], g.mul(c, first))
    elif op == "div":
        accumulate(args[0], g.mul(c, g.div(1.0, value(args[1]))))
    elif op == "select":
        accumulate(args[1], g.select(value(args[0]), c, 0.0, kind))
        accumulate(args[2], g.select(value(args[0]), 0.0, c, kind))
    elif op == "convert":
        accumulate(args[0], g.convert(c, program.operations[args[0]][1]))
    else:
        raise AssertionError(f"{op} is not linear")


# --- inputs that are read ---


@derived
def without_unread(program: Program) -> tuple[Program, tuple[int, ...]]:
    """The program with those of its inputs alone that it reads, and their places.

    A model that is an argument has leaves that a function does not need, such as the limits of its joints, and JAX takes a third
    of a microsecond for each leaf of a call.
    """
    return _with_inputs(program, program.read_places), program.read_places


def _with_inputs(program: Program, places: tuple[int, ...]) -> Program:
    """The program of some of its inputs. **Raises:** `NotNumbers` where it reads others."""
    if len(places) == len(program.inputs):
        return program
    index = {place: i for i, place in enumerate(places)}
    few = stored.make_within(program, ("inputs", places), lambda: _renumber_inputs(program, index))
    few.reports_validity, few.flags = program.reports_validity, program.flags
    if program.derivative is not None:
        few.derivative = functools.partial(_tangent_of_few, program, places)
    if program.fallback is not None:
        few.fallback = functools.partial(_fallback_of_few, program, index)
    return few


def _renumber_inputs(program: Program, index: dict[int, int]) -> Program:
    operations = []
    for operation in program.operations:
        op, kind, args = operation
        if op == "input":
            place, entry = args
            if place not in index:
                raise NotNumbers("a derivative of what the values do not depend on")
            operation = op, kind, (index[place], entry)
        operations.append(operation)
    inputs = [program.inputs[i] for i in index]
    return Program(inputs, program.outputs, operations, program.results, program.subprograms, name=program.name)


def _tangent_of_few(program: Program, places: tuple[int, ...], moving) -> Program:
    varying = {place for place, varies in zip(places, moving, strict=True) if varies}
    count = len(program.inputs)
    change = tangent(program, tuple([i in varying for i in range(count)]))
    return _with_inputs(change, (*places, *range(count, len(change.inputs))))


def _fallback_of_few(program: Program, index: dict[int, int], *flat):
    assert program.fallback is not None
    full = [
        flat[index[i]] if i in index else np.zeros(array.size, array.dtype) for i, array in enumerate(program.inputs)
    ]
    return program.fallback(*full)


# --- programs written out once more in the graph of another one, where equal numbers and known ones are folded again ---


def replay(
    graph: Graph, program: Program, inputs: Sequence[np.ndarray], branches: bool = True
) -> tuple[list, list[np.ndarray]]:
    """The numbers of all operations of a program for the given entries of its inputs, and its outputs.

    Without `branches` both results of a branch are computed for all samples, and selected.
    """
    numbers: list = []
    flat = [x.ravel().tolist() for x in inputs]
    for op, kind, args in program.operations:
        if op == "input":
            place, entry = args
            numbers.append(flat[place][entry])
        else:
            operands = [x.value if type(x) is Constant else numbers[x] for x in args]
            numbers.append(repeat(graph, program, op, kind, operands, branches))
    outputs = [
        objects([x.value if type(x) is Constant else numbers[x] for x in row], array.shape)
        for row, array in zip(program.results, program.outputs, strict=True)
    ]
    return numbers, outputs


def repeat(graph: Graph, program: Program, op: str, kind: str, args: list, branches: bool = True) -> Any:
    """The number of an operation of a program for these operands; of a call the list of all entries of its outputs."""
    if op in ("call", "call_where"):  # operands: the number of the subprogram, then entries one after the other
        which, *given = args
        write = _call if op == "call" else _call_where
        return [x for row in write(graph, program.subprograms[which], given, branches) for x in row.ravel().tolist()]
    if op == "part":
        call, entry = args
        return call[entry]
    return graph.apply(op, kind, args)


def _call(graph: Graph, program: Program, given: list, branches: bool) -> list[np.ndarray]:
    inputs = arrays_of(program.inputs, given)
    return graph.call(program, inputs) if program.is_called else replay(graph, program, inputs, branches)[1]


def _call_where(graph: Graph, program: Program, given: list, branches: bool) -> list[np.ndarray]:
    flag, *entries = given
    arrays, count = arrays_of((*program.inputs, *program.outputs), entries), len(program.inputs)
    inputs, otherwise = arrays[:count], arrays[count:]
    if branches or program.is_called:
        return graph.call_where(flag, program, inputs, otherwise)
    return [
        objects(
            [graph.select(flag, x, y, kind_of(array.dtype)) for x, y in zip(old.flat, new.flat, strict=True)],
            array.shape,
        )
        for old, new, array in zip(otherwise, replay(graph, program, inputs, branches)[1], program.outputs, strict=True)
    ]


def arrays_of(types: Sequence[Array], entries: list) -> list[np.ndarray]:
    """Arrays of entries that are given one after the other."""
    ends = np.cumsum([array.size for array in types]).tolist()
    return [objects(entries[end - array.size : end], array.shape) for end, array in zip(ends, types, strict=True)]


def inline(program: Program) -> Program:
    """The same without subprograms and branches, except subprograms that have loops."""
    if all(x.is_called for x in program.subprograms):
        return program
    graph = Graph()
    with np.errstate(all="ignore"):  # known numbers may overflow, as they do in XLA
        _, outputs = replay(graph, program, [graph.inputs(i, array) for i, array in enumerate(program.inputs)], False)
    written = graph.finish(program.inputs, program.outputs, outputs, name=program.name)
    written.reports_validity = program.reports_validity
    return written
