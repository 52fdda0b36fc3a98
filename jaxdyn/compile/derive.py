"""Derivatives of programs of numbers, which are programs of numbers again: forward, and the transpose of what is linear.

The change of every number is a sum of its partial derivatives times the changes of its operands; what does not move adds nothing.
Reverse mode is the transpose of that program in the changes, so that values which both need are there once.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxdyn.compile.graph import Graph, inline
from jaxdyn.compile.number import is_number, objects
from jaxdyn.compile.program import FLOATS, Constant, NotNumbers, Program


def tangent(program: Program, moving: Sequence[bool]) -> Program:
    """The change of the outputs that are floats, a program of all inputs and of the changes of those that move."""
    moving = tuple(moving)
    if moving not in program.derived:
        rule = program.derivative
        with np.errstate(all="ignore"):  # known numbers may overflow, as they do in XLA
            program.derived[moving] = _tangent(program, moving) if rule is None else rule(moving)
    return program.derived[moving]


def _tangent(program: Program, moving: tuple[bool, ...]) -> Program:
    # A subprogram has no derivative of its own: called ones are written out, so that the tangent shares their numbers.
    program, graph = inline(program), Graph()
    arrays = [*program.inputs, *(x for x, varies in zip(program.inputs, moving, strict=True) if varies)]
    entries = [graph.inputs(place, array) for place, array in enumerate(arrays)]
    primal, steps = entries[: len(moving)], iter(entries[len(moving) :])
    changes_in = [next(steps).ravel().tolist() if varies else None for varies in moving]
    values, _ = graph.replay(program, primal)
    changes: list = []
    for operation, value in zip(program.operations, values, strict=True):
        if operation.op == "input":
            place, entry = operation.args
            row = changes_in[place]
            changes.append(0.0 if row is None else row[entry])
            continue
        given = [(0.0 if type(x) is Constant else changes[x]) for x in operation.args]
        if operation.op == "call" and any(is_number(x) or x != 0 for x in given):
            raise NotNumbers("a pseudo-inverse without a rule for its derivative")
        operands = [x.value if type(x) is Constant else values[x] for x in operation.args]
        # Integers and bools do not change, nor do numbers whose operands do not: most of a tangent is left out here.
        varies = operation.kind in FLOATS and any(is_number(x) or x != 0 for x in given)
        changes.append(_change(graph, operation.op, operation.kind, value, operands, given) if varies else 0.0)
    rows, outputs = [], [array for array in program.outputs if array.dtype.kind == "f"]
    for row, array in zip(program.results, program.outputs, strict=True):
        if array.dtype.kind == "f":
            rows.append(objects([0.0 if type(x) is Constant else changes[x] for x in row], array.shape))
    return graph.finish(arrays, outputs, rows, name=f"change of {program.name}")


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
            # At a base of zero the power is zero or one whatever the exponent is; below zero it is no function of the exponent.
            is_zero = g.compare("eq", x[0], 0.0)
            logarithm = g.function("log", g.select(is_zero, x[0], 1.0, kind))
            total = g.add(total, g.mul(g.mul(value, logarithm), d[1]))
        return total
    if op == "atan2":
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
    """`_change` of operations that take one of their operands."""
    if op == "select":
        return g.select(x[0], d[1], d[2], kind)
    # Ties are decided as JAX decides them: a maximum of two gives each half, one of several gives all that are largest the same
    # share, and a number on a bound of its range does not move. Nothing moves a maximum that is not a number.
    if op in ("max", "min"):
        words = ("gt", "lt") if op == "max" else ("lt", "gt")
        first, second = (g.compare(word, x[0], x[1]) for word in words)
        chosen = g.select(first, g.select(second, 0.0, d[1], kind), d[0], kind)
        return g.select(g.compare("eq", x[0], x[1]), chosen, g.mul(0.5, g.add(d[0], d[1])), kind)
    if op in ("reduce_max", "reduce_min"):
        # JAX's rule too: the mean over all entries that equal the result. A chain of maxima would halve it at each tie.
        hits = [g.compare("eq", entry, value) for entry in x]
        total = functools.reduce(g.add, [g.select(hit, 0.0, step, kind) for hit, step in zip(hits, d, strict=True)])
        return g.div(total, functools.reduce(g.add, [g.convert(hit, kind) for hit in hits]))
    if op == "clamp":
        # Strict comparisons, as in JAX: on a bound neither the number nor the bound moves the result.
        low, inner, high = x
        is_below = g.both(g.compare("gt", low, inner), g.compare("lt", low, high))
        is_inside = g.both(g.compare("gt", inner, low), g.compare("lt", inner, high))
        flags = is_below, is_inside, g.compare("lt", high, inner)
        return functools.reduce(g.add, [g.select(flag, 0.0, step, kind) for flag, step in zip(flags, d, strict=True)])
    # "abs": at zero JAX takes the derivative of x.
    return g.select(g.compare("ge", x[0], 0.0), g.neg(d[0]), d[0], kind)


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


def transpose(program: Program, linear: Sequence[bool], given: Sequence[bool]) -> Program:
    """The transpose of a program that is linear in some of its inputs together.

    Of the other inputs, and of the cotangents of those outputs that are `given`, to the cotangents of the `linear` inputs.
    """
    key = ("transposed", tuple(linear), tuple(given))
    if key not in program.derived:
        with np.errstate(all="ignore"):
            program.derived[key] = _transpose(program, tuple(linear), tuple(given))
    return program.derived[key]


def _transpose(program: Program, linear: tuple[bool, ...], given: tuple[bool, ...]) -> Program:
    program, graph = inline(program), Graph()
    fixed = [array for array, varies in zip(program.inputs, linear, strict=True) if not varies]
    arrays = [*fixed, *(array for array, is_given in zip(program.outputs, given, strict=True) if is_given)]
    entries = [graph.inputs(place, array) for place, array in enumerate(arrays)]
    # Fixed inputs come first, then the cotangents, as JAX's transpose rule passes them.
    operands = iter(entries[: len(fixed)])
    # The values of what is linear are not needed, and not made: their places hold None.
    values = _values_of_constants(graph, program, [None if varies else next(operands) for varies in linear])
    # Cotangents of the operations, summed from their users: reverse order is safe, as operands precede their users.
    bar: list = [0.0] * len(program.operations)
    cotangents = iter(entries[len(fixed) :])
    for row, is_given in zip(program.results, given, strict=True):
        if is_given:
            for place, entry in zip(row, next(cotangents).ravel().tolist(), strict=True):
                if type(place) is not Constant:
                    bar[place] = graph.add(bar[place], entry)
    sums = [[0.0] * array.size if varies else None for array, varies in zip(program.inputs, linear, strict=True)]

    def give(place, cotangent):
        if type(place) is not Constant and values[place] is None:
            bar[place] = graph.add(bar[place], cotangent)

    for i in reversed(range(len(program.operations))):
        # A value that is there is no function of the linear inputs, and a zero cotangent passes on zeros.
        if values[i] is not None or not (is_number(bar[i]) or bar[i] != 0):
            continue
        op, kind, args = program.operations[i]
        if op == "input":
            row = sums[args[0]]
            assert row is not None
            row[args[1]] = bar[i]
        else:
            _transpose_operation(graph, op, kind, args, values, bar[i], give, program)
    rows = [
        (objects(row, array.shape), array)
        for row, array, varies in zip(sums, program.inputs, linear, strict=True)
        if varies and row is not None
    ]
    return graph.finish(arrays, [x[1] for x in rows], [x[0] for x in rows], name=f"transpose of {program.name}")


def _values_of_constants(graph: Graph, program: Program, inputs: list) -> list:
    flat = [None if x is None else x.ravel().tolist() for x in inputs]
    values: list = []
    for op, kind, args in program.operations:
        if op == "input":
            row = flat[args[0]]
            values.append(None if row is None else row[args[1]])
        elif any(type(x) is not Constant and values[x] is None for x in args):
            values.append(None)
        else:
            values.append(graph.apply(op, kind, [x.value if type(x) is Constant else values[x] for x in args]))
    return values


def _transpose_operation(g: Graph, op: str, kind: str, args, values, c, give, program: Program) -> None:
    """Hand the cotangent c of a linear operation to its operands."""

    def value(x):
        return x.value if type(x) is Constant else values[x]

    if op == "add":
        give(args[0], c)
        give(args[1], c)
    elif op == "sub":
        give(args[0], c)
        give(args[1], g.neg(c))
    elif op == "neg":
        give(args[0], g.neg(c))
    elif op == "mul":
        first, second = value(args[0]), value(args[1])
        assert first is not None or second is not None, "a product of two changes is not linear"
        if first is None:
            give(args[0], g.mul(c, second))
        else:
            give(args[1], g.mul(c, first))
    elif op == "div":
        give(args[0], g.mul(c, g.div(1.0, value(args[1]))))
    elif op == "select":
        give(args[1], g.select(value(args[0]), c, 0.0, kind))
        give(args[2], g.select(value(args[0]), 0.0, c, kind))
    elif op == "convert":
        give(args[0], g.convert(c, program.operations[args[0]].kind))
    else:
        raise AssertionError(f"{op} is not linear")
