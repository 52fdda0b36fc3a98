"""Programs of numbers while they are written: what is known is folded away, and equal numbers are made once.

Sums and products with 0, 1 and -1 are not written, and signs are moved outwards, so that they meet and cancel. Four of these
rules change results: docs/algorithms.md lists them, and `python -m benchmarks.random_functions` compares all the rest with JAX.
Each has its comment "Listed" here. What no output needs is dropped when a graph is finished to a `Program`.
"""

import functools
import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxdyn.compile.program import (
    COMPARISONS,
    FUNCTIONS,
    FUNCTIONS_OF_TWO,
    Array,
    Constant,
    NotNumbers,
    Number,
    Operation,
    Program,
    TooLong,
    as_kind,
    dtype_of,
    kind_or_refuse,
    objects,
    with_type,
)

# Numbers that may be made for each operation that is allowed: those that no output needs are dropped at the end. Without a
# bound a function that explodes would fill the memory before the count of operations refuses it.
_MADE_FOR_ONE_KEPT = 3
_MIN_NORMAL = {"f8": 2.0**-1022, "f4": 2.0**-126}


class Graph:
    """A program while it is written. **Raises:** `TooLong` beyond `maximum` operations."""

    def __init__(self, maximum: int = 10**9):
        self.maximum, self.max_made = maximum, _MADE_FOR_ONE_KEPT * maximum
        self.numbers: list[Number] = []
        # For each operation and kind, numbers by their operands, by identity: equal numbers are made once.
        self.shared: dict[tuple[str, str], dict[tuple, Number]] = defaultdict(dict)
        self.subprograms: list[Program] = []
        self.numbers_of_subprograms: dict[str, int] = {}  # by their digests

    # --- making numbers ---

    def make(self, op: str, kind: str, *args) -> Number:
        """The number op(*args), made once."""
        key, made = args, self.shared[op, kind]
        if 0.0 in args:  # zeros of both signs compare equal, and are different numbers: 1 / -0.0 is not 1 / 0.0
            key = (*key, tuple(isinstance(x, (float, np.floating)) and x == 0 and _is_negative(x) for x in args))
        number = made.get(key)
        return self._new(op, kind, args, key, made) if number is None else number

    def _new(self, op: str, kind: str, args: tuple, key: tuple, made: dict) -> Number:
        if len(self.numbers) >= self.max_made:
            raise TooLong(f"more than {self.maximum} operations")
        number = made[key] = Number(self, op, kind, args)
        self.numbers.append(number)
        return number

    def _commuting(self, op: str, a: Number, b: Number) -> Number:
        """The sum or product of two numbers that are not known: one number for a + b and b + a."""
        made = self.shared[op, a.kind]
        key = a, b
        number = made.get((b, a)) or made.get(key)
        return self._new(op, a.kind, key, key, made) if number is None else number

    def inputs(self, place: int, array: Array) -> np.ndarray:
        """The entries of an argument. **Raises:** `NotNumbers` for a dtype that programs do not have."""
        kind = kind_or_refuse(array.dtype)
        entries = [self.make("input", kind, place, k) for k in range(array.size)]
        return objects(entries, array.shape)

    def call(self, program: Program, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The outputs of a subprogram. **Raises:** `NotNumbers` for a dtype that programs do not have."""
        return self._parts("call", program, [entry for x in inputs for entry in x.ravel().tolist()])

    def call_where(
        self, flag, program: Program, inputs: Sequence[np.ndarray], otherwise: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """The outputs of a subprogram where the flag is set, else `otherwise`; it is called if the flag is set at all."""
        if type(flag) is not Number:
            return self.call(program, inputs) if flag else list(otherwise)
        entries = [entry for x in (*inputs, *otherwise) for entry in x.ravel().tolist()]
        return self._parts("call_where", program, [flag, *entries])

    def _parts(self, op: str, program: Program, entries: list) -> list[np.ndarray]:
        # By contents, not by identity: which jaxprs JAX keeps would decide how often a function is a subprogram, and with it
        # whether a program that is traced again is the one on disk.
        number = self.numbers_of_subprograms.setdefault(program.digest, len(self.subprograms))
        if number == len(self.subprograms):
            self.subprograms.append(program)
        call = self.make(op, "call", number, *entries)
        outputs, at = [], 0
        for row, array in zip(program.results, program.outputs, strict=True):
            kind = kind_or_refuse(array.dtype)
            # A result that is known has no part, unless the call may not happen.
            parts = [
                x.value if type(x) is Constant and op == "call" else self.make("part", kind, call, at + k)
                for k, x in enumerate(row)
            ]
            outputs.append(objects(parts, array.shape))
            at += array.size
        return outputs

    def _inputs_of_branch(self, number: Number) -> tuple:
        """The flag of a "call_where" and the entries of its inputs."""
        return number.args[1 : 2 + sum(array.size for array in self.subprograms[number.args[0]].inputs)]

    def add(self, a, b):
        """a + b."""
        if type(a) is not Number:
            if type(b) is not Number:
                return a + b
            a, b = b, a  # a known operand is the second one, so that x + c and c + x are one number
        if type(b) is not Number:
            # Listed: -0.0 + 0.0 stays -0.0. Sums begin with a known zero everywhere.
            return a if b == 0 else self.make("add", a.kind, a, b)
        if b.op == "neg":
            return self.sub(a, b.args[0])
        if a.op == "neg":
            return self.sub(b, a.args[0])
        return self._commuting("add", a, b)

    def sub(self, a, b):
        """a - b."""
        if type(b) is not Number:
            if type(a) is not Number:
                return a - b
            return a if b == 0 else self.make("add", a.kind, a, -b)
        # Listed, here and below where a difference is turned round: the sign of a difference that is zero. Signs cost nothing
        # where they meet others; kept in place they are 3 % of forward dynamics.
        if type(a) is not Number:
            return self.neg(b) if a == 0 else self.make("sub", b.kind, a, b)
        if b.op == "neg":
            return self.add(a, b.args[0])
        if a is b:
            # Listed: inf - inf and the difference of what is not a number are 0. The products of first moments cancel so when
            # an inertia is turned, which is 4 % of forward dynamics.
            return as_kind(0, a.kind)
        if a.op == "neg":
            return self.neg(self.add(a.args[0], b))
        # y - x where x - y is there: one operation less, and the sign moves outwards.
        opposite = self.shared["sub", a.kind].get((b, a))
        if opposite is not None:
            return self.neg(opposite)
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
                return as_kind(
                    0, a.kind
                )  # Listed: 0 inf and 0 times what is not a number. The sparsity of mechanics is this.
            if b == 1:
                return a
            if b == -1:
                return self.neg(a)
            if a.op == "neg":
                return self.mul(a.args[0], -b)
            # (x c) d is not x (c d), whose product of known numbers may overflow where neither of the two products does.
            return self.make("mul", a.kind, a, b)
        if a.op == "neg":
            return self.neg(self.mul(a.args[0], b))
        if b.op == "neg":
            return self.neg(self.mul(a, b.args[0]))
        return self._commuting("mul", a, b)

    def div(self, a, b):
        """a / b, of floats."""
        if type(b) is not Number:
            if type(a) is not Number:
                return with_type(np.divide(a, b))  # of zero too, where Python's own division raises
            minimum = _MIN_NORMAL[a.kind]
            if math.frexp(b)[0] in (0.5, -0.5) and minimum <= abs(b) <= 1 / minimum:
                return self.mul(a, 1 / b)  # by a power of two, whose inverse is exact
            return self.make("div", a.kind, a, b)
        # A known zero is divided: 0 / b is not a number where b is zero. Left out it saves no operation of any robot.
        if b.op == "neg":
            return self.neg(self.div(a, b.args[0]))
        if type(a) is Number and a.op == "neg":
            return self.neg(self.div(a.args[0], b))
        return self.make("div", b.kind, a, b)

    def power(self, a, exponent: int, one=1.0):
        """a to an integer power; `one` is the number one of the type of a."""
        if exponent < 0:
            # Powers of the inverse, not the inverse of a power: the derivative of the latter is inf 0 at infinity.
            return self.power(self.div(one, a), -exponent, one)
        # Repeated squares, as XLA expands the power.
        result: Any = None
        while exponent:
            if exponent & 1:
                result = a if result is None else self.mul(result, a)
            exponent >>= 1
            if exponent:
                a = self.mul(a, a)
        return one if result is None else result

    def function(self, op: str, a):
        """One of `FUNCTIONS`."""
        if type(a) is not Number:
            return with_type(FUNCTIONS[op](a))
        # Odd and even functions of -x: the sign meets others outside, and sin(-x) and cos(-x) share the work of sin x and cos x.
        if a.op == "neg":
            if op in ("sin", "tan", "atan", "asin", "sinh", "tanh", "cbrt", "sign"):
                return self.neg(self.function(op, a.args[0]))
            if op in ("cos", "cosh", "abs"):
                return self.function(op, a.args[0])
        return self.make(op, a.kind, a)

    def function_of_two(self, op: str, a, b):
        """One of `FUNCTIONS_OF_TWO`."""
        if type(a) is not Number and type(b) is not Number:
            return with_type(FUNCTIONS_OF_TWO[op](a, b))
        # The larger of x and x is written: where x is not a number JAX's derivative of it is zero, and that of x is not.
        return self.make(op, a.kind if type(a) is Number else b.kind, a, b)

    def extreme(self, op: str, entries: Sequence):
        """The "reduce_max" or "reduce_min" of at least one entry.

        One operation, not a chain of maxima: where several entries are the largest JAX gives each the same share of the
        derivative, and a chain would give the last one half of it.
        """
        if len(entries) == 1:
            return entries[0]
        if not any(type(x) is Number for x in entries):
            pick = FUNCTIONS_OF_TWO[op.removeprefix("reduce_")]
            return with_type(functools.reduce(pick, entries))
        return self.make(op, next(x.kind for x in entries if type(x) is Number), *entries)

    def clamp(self, low, x, high):
        """x, or the bound that it is beyond; one operation, as JAX's derivative at a bound is not that of a maximum."""
        of = next((y for y in (low, x, high) if type(y) is Number), None)
        if of is None:
            return with_type(np.minimum(np.maximum(x, low), high))
        return self.make("clamp", of.kind, low, x, high)

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
        """True unless a is infinite or NaN."""
        return math.isfinite(a) if type(a) is not Number else self.make("is_finite", "b1", a)

    def select(self, which, if_false, if_true, kind: str):
        """`if_true` where `which` is, else `if_false`."""
        if type(which) is not Number:
            return if_true if which else if_false
        if if_false is if_true:
            return if_true
        if type(if_false) is not Number and type(if_true) is not Number and if_false == if_true:
            if _is_negative(if_false) == _is_negative(if_true):  # zeros with the same sign
                return if_true
        return self.make("select", kind, which, if_false, if_true)

    def convert(self, a, kind: str):
        """a as another kind of number."""
        if type(a) is not Number:
            return as_kind(a, kind)
        return a if a.kind == kind else self.make("convert", kind, a)

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
        if op in ("reduce_max", "reduce_min"):
            return self.extreme(op, args)
        return self.select(args[0], args[1], args[2], kind) if op == "select" else self.convert(args[0], kind)

    # --- finishing ---

    def finish(
        self, inputs: Sequence[Array], outputs: Sequence[Array], entries: Sequence[np.ndarray], **more
    ) -> Program:
        """The program of those numbers that the entries of the outputs need; the graph ends with it."""
        flat = [tuple(x.ravel().tolist()) for x in entries]
        # Marked from the outputs backwards, with a list instead of recursion: programs are tens of thousands deep.
        waiting = [x for row in flat for x in row if type(x) is Number]
        while waiting:
            number = waiting.pop()
            if type(number) is Number and number.place is None:
                number.place = -1  # needed
                if number.op == "part" and number.args[0].op == "call_where":
                    branch, part = number.args
                    waiting.append(branch.args[1 + len(self._inputs_of_branch(branch)) + part])
                if number.op != "input":
                    # Of what stands for the outputs of a branch, that alone which has a part is needed.
                    waiting.extend(self._inputs_of_branch(number) if number.op == "call_where" else number.args)
        live = [number for number in self.numbers if number.place is not None]
        operations: list[Operation] = []
        count = 0
        called: dict[int, int] = {}  # numbers of the subprograms that are still called, by those of the graph
        # In the order of creation, where operands precede their operation. Depth first from the outputs was tried: forward
        # dynamics of a Panda took 1.6 times as long.
        self.numbers = []
        # Numbers know their graph: with these references the collector of cycles would look for them in the whole process,
        # which was a tenth of a first call.
        self.shared.clear()
        new = tuple.__new__  # of named tuples, a third of the time that their own constructors take
        for number in live:
            op, kind, args = number.op, number.kind, number.args
            number.place = len(operations)
            if op != "input":
                if op in ("call", "call_where"):
                    args = (called.setdefault(args[0], len(called)), *args[1:])
                if op == "call_where":
                    args = tuple(x if type(x) is not Number or x.place is not None else 0 for x in args)
                if any([type(x) is Number and x.kind != kind for x in args]):
                    _check_kinds(number)
                args = tuple([x.place if type(x) is Number else new(Constant, (x,)) for x in args])
            operations.append((op, kind, args))
            count += op not in ("input", "part")  # these are memory
        if count > self.maximum:
            raise TooLong(f"more than {self.maximum} operations")
        results = [tuple([x.place if type(x) is Number else Constant(x) for x in row]) for row in flat]
        return Program(inputs, outputs, operations, results, [self.subprograms[i] for i in called], **more)


_BY_NAME: dict[str, Callable] = {
    "add": Graph.add, "sub": Graph.sub, "neg": Graph.neg, "mul": Graph.mul, "div": Graph.div, "and": Graph.both,
    "or": Graph.either, "not": Graph.invert, "is_finite": Graph.is_finite, "clamp": Graph.clamp,
}  # fmt: skip


def _check_kinds(number: Number) -> None:
    """Check the kinds of operands. **Raises:** `NotNumbers` where they differ, which LLVM would refuse with less grace."""
    op, kind, args = number.op, number.kind, number.args
    if op not in ("call", "call_where", "part", "convert", "is_finite"):
        kinds = {x.kind for x in (args[1:] if op == "select" else args) if type(x) is Number}
        if len(kinds) > 1 or (kinds and op not in COMPARISONS and kinds != {kind}):
            raise NotNumbers(f"{op} of {' and '.join(dtype_of(x).name for x in sorted(kinds | {kind}))}")


def _is_negative(x) -> bool:
    return math.copysign(1.0, x) < 0
