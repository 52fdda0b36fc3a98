"""Programs of numbers while they are written: what is known is folded away, and equal numbers are made once.

The `Number`s of a `Graph` and Python's floats, integers and booleans (known numbers) are the entries of numpy arrays of objects,
so that numpy's own functions move, sum and multiply them. Sums and products with 0, 1 and -1 are not written, and signs are
moved outwards, so that they meet and cancel. As everywhere in a compiler for real numbers, 0 x is 0 also where x is infinite
or not a number. What no output needs is dropped when a graph is finished to a `Program`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxdyn.compile.program import (
    COMPARISONS,
    FLOATS,
    FUNCTIONS,
    FUNCTIONS_OF_TWO,
    Array,
    Constant,
    Operation,
    Program,
    TooLong,
    dtype_of,
    kind_of,
)

_MADE_FOR_ONE_KEPT = 3  # numbers while a program is written, of which those that no output needs are dropped


class Number:
    """A number of a graph that is not known before the program runs."""

    __slots__ = ("args", "graph", "kind", "op")

    def __init__(self, graph: "Graph", op: str, kind: str, args: tuple):
        self.graph, self.op, self.kind, self.args = graph, op, kind, args

    def __add__(self, other):
        return self.graph.add(self, other)

    def __radd__(self, other):
        return self.graph.add(other, self)

    def __sub__(self, other):
        return self.graph.sub(self, other)

    def __rsub__(self, other):
        return self.graph.sub(other, self)

    def __mul__(self, other):
        return self.graph.mul(self, other)

    def __rmul__(self, other):
        return self.graph.mul(other, self)

    def __truediv__(self, other):
        return self.graph.div(self, other)

    def __rtruediv__(self, other):
        return self.graph.div(other, self)

    def __neg__(self):
        return self.graph.neg(self)


def is_number(x) -> bool:
    """Whether x is not known before the program runs."""
    return type(x) is Number


class Graph:
    """A program while it is written. **Raises:** `TooLong` beyond `most` operations."""

    def __init__(self, most: int = 10**9):
        self.most, self.most_made = most, _MADE_FOR_ONE_KEPT * most
        self.numbers: list[Number] = []
        self.shared: dict[tuple, Number] = {}
        self.subprograms: list[Program] = []

    # --- making numbers ---

    def make(self, op: str, kind: str, *args) -> Number:
        """The number op(*args), made once."""
        key = (op, kind, *args)
        if 0.0 in args:  # zeros of both signs are equal, and not the same
            key = (*key, tuple(type(x) is float and x == 0 and math.copysign(1.0, x) < 0 for x in args))
        number = self.shared.get(key)
        if number is None:
            if len(self.numbers) >= self.most_made:
                raise TooLong(f"more than {self.most} operations")
            number = self.shared[key] = Number(self, op, kind, args)
            self.numbers.append(number)
        return number

    def inputs(self, place: int, array: Array) -> np.ndarray:
        """The entries of an argument."""
        kind = kind_of(array.dtype)
        entries = [self.make("input", kind, place, k) for k in range(array.size)]
        return objects(entries, array.shape)

    def call(self, program: Program, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The outputs of a subprogram."""
        if program not in self.subprograms:
            self.subprograms.append(program)
        entries = [entry for x in inputs for entry in x.ravel().tolist()]
        call = self.make("call", "call", self.subprograms.index(program), *entries)
        outputs, at = [], 0
        for row, array in zip(program.results, program.outputs, strict=True):
            kind = kind_of(array.dtype)
            parts = [
                x.value if type(x) is Constant else self.make("part", kind, call, at + k) for k, x in enumerate(row)
            ]
            outputs.append(objects(parts, array.shape))
            at += array.size
        return outputs

    def add(self, a, b):
        """a + b."""
        if type(a) is not Number:
            if type(b) is not Number:
                return a + b
            a, b = b, a
        if type(b) is not Number:
            return a if b == 0 else self.make("add", a.kind, a, b)
        if b.op == "neg":
            return self.sub(a, b.args[0])
        if a.op == "neg":
            return self.sub(b, a.args[0])
        if ("add", a.kind, b, a) in self.shared:
            a, b = b, a
        return self.make("add", a.kind, a, b)

    def sub(self, a, b):
        """a - b."""
        if type(b) is not Number:
            if type(a) is not Number:
                return a - b
            return a if b == 0 else self.make("add", a.kind, a, -b)
        if type(a) is not Number:
            return self.neg(b) if a == 0 else self.make("sub", b.kind, a, b)
        if b.op == "neg":
            return self.add(a, b.args[0])
        if a is b:
            return 0.0 if a.kind in FLOATS else 0
        if a.op == "neg":
            return self.neg(self.add(a.args[0], b))
        if ("sub", a.kind, b, a) in self.shared:
            return self.neg(self.shared["sub", a.kind, b, a])
        return self.make("sub", a.kind, a, b)

    def neg(self, a):
        """-a."""
        if type(a) is not Number:
            return -a
        return a.args[0] if a.op == "neg" else self.make("neg", a.kind, a)

    def mul(self, a, b):
        """a b."""
        if type(a) is not Number:
            if type(b) is not Number:
                return a * b
            a, b = b, a
        if type(b) is not Number:
            if b == 0:
                return 0.0 if a.kind in FLOATS else 0
            if b == 1:
                return a
            if b == -1:
                return self.neg(a)
            if a.op == "neg":
                return self.mul(a.args[0], -b)
            if a.op == "mul" and type(a.args[1]) is not Number and a.kind in FLOATS:
                return self.mul(a.args[0], a.args[1] * b)
            return self.make("mul", a.kind, a, b)
        if a.op == "neg":
            return self.neg(self.mul(a.args[0], b))
        if b.op == "neg":
            return self.neg(self.mul(a, b.args[0]))
        if ("mul", a.kind, b, a) in self.shared:
            a, b = b, a
        return self.make("mul", a.kind, a, b)

    def div(self, a, b):
        """a / b, of floats."""
        if type(b) is not Number:
            with np.errstate(all="ignore"):
                inverse = float(np.float64(1.0) / np.float64(b))
                if type(a) is not Number:
                    return float(np.float64(a) / np.float64(b))
            if math.frexp(b)[0] in (0.5, -0.5):  # a power of two, whose inverse is exact
                return self.mul(a, inverse)
            return self.make("div", a.kind, a, b)
        if type(a) is not Number and a == 0:
            return 0.0
        if b.op == "neg":
            return self.neg(self.div(a, b.args[0]))
        if type(a) is Number and a.op == "neg":
            return self.neg(self.div(a.args[0], b))
        return self.make("div", b.kind, a, b)

    def power(self, a, exponent: int):
        """a to an integer power."""
        if exponent < 0:
            return self.div(1.0, self.power(a, -exponent))
        result: Any = 1.0
        while exponent:
            if exponent & 1:
                result = self.mul(result, a)
            exponent >>= 1
            if exponent:
                a = self.mul(a, a)
        return result

    def function(self, op: str, a):
        """One of `FUNCTIONS`."""
        if type(a) is not Number:
            with np.errstate(all="ignore"):
                return FUNCTIONS[op](a).item() if isinstance(a, int) else float(FUNCTIONS[op](a))
        if a.op == "neg":
            if op in ("sin", "tan", "atan", "asin", "sinh", "tanh", "cbrt", "sign"):
                return self.neg(self.function(op, a.args[0]))
            if op in ("cos", "cosh", "abs"):
                return self.function(op, a.args[0])
        return self.make(op, a.kind, a)

    def function_of_two(self, op: str, a, b):
        """One of `FUNCTIONS_OF_TWO`."""
        if type(a) is not Number and type(b) is not Number:
            with np.errstate(all="ignore"):
                return FUNCTIONS_OF_TWO[op](a, b).item()
        return a if a is b and op in ("max", "min") else self.make(op, a.kind if type(a) is Number else b.kind, a, b)

    def compare(self, op: str, a, b):
        """One of `COMPARISONS`."""
        if type(a) is not Number and type(b) is not Number:
            return bool(COMPARISONS[op](a, b))
        return self.make(op, "b1", a, b)

    def both(self, a, b):
        """Logical a and b, or bitwise of integers."""
        if a is True or a is b:
            return b
        if b is True:
            return a
        if a is False or b is False:
            return False
        if type(a) is not Number and type(b) is not Number:
            return a & b
        return self.make("and", a.kind if type(a) is Number else b.kind, a, b)

    def either(self, a, b):
        """Logical a or b, or bitwise of integers."""
        if a is False or a is b:
            return b
        if b is False:
            return a
        if a is True or b is True:
            return True
        if type(a) is not Number and type(b) is not Number:
            return a | b
        return self.make("or", a.kind if type(a) is Number else b.kind, a, b)

    def invert(self, a):
        """Logical not a."""
        if type(a) is not Number:
            return (not a) if isinstance(a, bool) else ~a
        return a.args[0] if a.op == "not" else self.make("not", a.kind, a)

    def is_finite(self, a):
        """Whether a is neither infinite nor not a number."""
        return math.isfinite(a) if type(a) is not Number else self.make("is_finite", "b1", a)

    def select(self, which, if_false, if_true, kind: str):
        """`if_true` where `which` is, else `if_false`."""
        if type(which) is not Number:
            return if_true if which else if_false
        if if_false is if_true or (
            type(if_false) is not Number and type(if_true) is not Number and if_false == if_true
        ):
            return if_true
        return self.make("select", kind, which, if_false, if_true)

    def convert(self, a, kind: str):
        """a as another kind of number."""
        if type(a) is not Number:
            return np.asarray(a).astype(dtype_of(kind)).item()
        return a if a.kind == kind else self.make("convert", kind, a)

    # --- finishing ---

    def finish(
        self, inputs: Sequence[Array], outputs: Sequence[Array], entries: Sequence[np.ndarray], **more
    ) -> Program:
        """The program of those numbers that the entries of the outputs need."""
        flat = [tuple(x.ravel().tolist()) for x in entries]
        live: set = set()
        waiting = [x for row in flat for x in row if type(x) is Number]
        while waiting:
            number = waiting.pop()
            if number not in live:
                live.add(number)
                if number.op != "input":
                    waiting.extend(x for x in number.args if type(x) is Number and x not in live)
        index: dict[Number, int] = {}
        operations = []
        for number in self.numbers:
            if number in live:
                index[number] = len(operations)
                args = number.args
                if number.op != "input":
                    args = tuple(index[x] if type(x) is Number else Constant(x) for x in args)
                operations.append(Operation(number.op, number.kind, args))
            if len(operations) > self.most:
                raise TooLong(f"more than {self.most} operations")
        results = [tuple(index[x] if type(x) is Number else Constant(x) for x in row) for row in flat]
        return Program(inputs, outputs, operations, results, self.subprograms, **more)

    def replay(self, program: Program, inputs: Sequence[np.ndarray]) -> tuple[list, list[np.ndarray]]:
        """The numbers of all operations of a program for the given entries of its inputs, and its outputs."""
        numbers: list = []
        flat = [x.ravel().tolist() for x in inputs]
        for operation in program.operations:
            if operation.op == "input":
                place, entry = operation.args
                numbers.append(flat[place][entry])
            elif operation.op == "call":
                which, *given = (x.value if type(x) is Constant else numbers[x] for x in operation.args)
                numbers.append(self._replayed_call(program.subprograms[which], given))
            elif operation.op == "part":
                call, entry = operation.args
                numbers.append(numbers[call][entry.value])
            else:
                args = [x.value if type(x) is Constant else numbers[x] for x in operation.args]
                numbers.append(self.apply(operation.op, operation.kind, args))
        outputs = [
            objects([x.value if type(x) is Constant else numbers[x] for x in row], array.shape)
            for row, array in zip(program.results, program.outputs, strict=True)
        ]
        return numbers, outputs

    def _replayed_call(self, program: Program, given: list) -> list:
        ends = np.cumsum([array.size for array in program.inputs])
        parts = [
            objects(given[end - array.size : end], array.shape) for end, array in zip(ends, program.inputs, strict=True)
        ]
        return [entry for x in self.replay(program, parts)[1] for entry in x.ravel().tolist()]

    def apply(self, op: str, kind: str, args: Sequence):
        """An operation by its name."""
        if op in _BY_NAME:
            return _BY_NAME[op](self, *args)
        if op in FUNCTIONS:
            return self.function(op, *args)
        if op in FUNCTIONS_OF_TWO:
            return self.function_of_two(op, *args)
        if op in COMPARISONS:
            return self.compare(op, *args)
        return self.select(args[0], args[1], args[2], kind) if op == "select" else self.convert(args[0], kind)


_BY_NAME: dict[str, Callable] = {
    "add": Graph.add, "sub": Graph.sub, "neg": Graph.neg, "mul": Graph.mul, "div": Graph.div, "and": Graph.both,
    "or": Graph.either, "not": Graph.invert, "is_finite": Graph.is_finite,
}  # fmt: skip


def inlined(program: Program) -> Program:
    """The same without subprograms."""
    if not program.subprograms:
        return program
    graph = Graph()
    _, outputs = graph.replay(program, [graph.inputs(i, array) for i, array in enumerate(program.inputs)])
    return graph.finish(program.inputs, program.outputs, outputs, name=program.name)


def objects(entries: Sequence, shape) -> np.ndarray:
    """An array of objects."""
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)


def as_objects(x) -> np.ndarray:
    """An array, known or not, as an array of objects."""
    if isinstance(x, np.ndarray) and x.dtype == object:
        return x
    if isinstance(x, Number):
        return objects([x], ())
    x = np.asarray(x)
    return objects(x.ravel().tolist(), x.shape)
