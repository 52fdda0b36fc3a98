"""Programs of single numbers: operations in an order in which they can be computed, from arrays to arrays."""

import functools
import hashlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

FLOATS = ("f8", "f4")


class TooLong(Exception):
    """A program would have more operations than it may have."""


class NotNumbers(Exception):
    """A function that cannot be written as a program of single numbers, and why; `place`: the user's function at fault."""

    place = ""

    def __str__(self) -> str:
        return super().__str__() + (f", in {self.place}" if self.place else "")


class FlaggedIteration(NotNumbers):
    """A loop in native code whose iterations flag samples, of which nothing outside would know."""


# An operation of a finished program: its name, its kind, and its operands, indices of operations and `Constant`s. Plain tuples,
# which Python's collector of cycles forgets: with a class of their own it visited half a million of them again and again.
Operation = tuple[str, str, tuple]


class Constant(NamedTuple):
    """A known operand."""

    value: Any


class Array(NamedTuple):
    """An argument or a result of a program."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Number of entries."""
        return math.prod(self.shape)


class Program:
    """Operations on single numbers, from arrays to arrays.

    - `inputs`, `outputs`: their `Array`s. `results`: per output a tuple of entries, indices of operations or `Constant`s.
    - `operations`: "input" has the arguments (array, entry); "call" the number of a subprogram and the entries of its
      inputs, one after the other; "part" a call and the number of an entry of its outputs; "call_where" the number, a flag, the
      entries of the inputs, and entries that stand for the outputs where the flag is not set.
    - `subprograms`: what is called, written once however often it is.
    - `derivative`: None, or a function (which inputs move) -> the `Program` of the change of all outputs, of the inputs and the
      changes of those that move.
    - `fallback`: None, or the function that was traced, from flat arrays of one sample to flat arrays.
    - `reports_validity`: whether the last output says if the sample is valid (see `flags`).
    - `flags`: whether the last output says if the sample is not valid, in a subprogram.
    - `fast`, `careful`: None, or the two programs of a pair (see `careful`); `operations` are those of both.
    """

    # Repetitions of the operations in one call, by which the cost of a `kernels.Loop` is estimated.
    turns = 1
    is_called = False  # whether it has loops, so that other programs can only call it

    def __init__(
        self, inputs, outputs, operations, results, subprograms=(), derivative: Callable | None = None, name: str = ""
    ):
        self.start(inputs, outputs, subprograms, name, derivative)
        self.operations: list[Operation] = operations
        self.results: tuple[tuple, ...] = tuple(results)

    def start(self, inputs, outputs, subprograms, name: str, derivative: Callable | None = None) -> None:
        """Set all but the operations and the results."""
        self.inputs: tuple[Array, ...] = tuple(inputs)
        self.outputs: tuple[Array, ...] = tuple(outputs)
        self.subprograms: tuple[Program, ...] = tuple(subprograms)
        self.derivative = derivative
        self.name = name
        self.fallback: Callable | None = None
        self.reports_validity = False
        self.flags = False
        self.fast: Program | None = None
        self.careful: Any = None
        self.key: str | None = None  # under which it is kept on disk (see `stored`)
        # Derivatives, transposes and kernels of this program, which live as long as it does.
        self.derived: dict = {}

    def __reduce__(self):
        # What a file keeps of the body of a loop (see `scan`): neither derivatives nor what was derived.
        return Program, (self.inputs, self.outputs, self.operations, self.results, self.subprograms)

    def __repr__(self):
        return f"Program({self.name or 'unnamed'}, {self.cost} operations)"

    @functools.cached_property
    def cost(self) -> int:
        """Number of operations that are carried out, without inputs and changes of sign."""
        # Signs merge with sums and products of LLVM, and inputs are operands in memory.
        own = sum(_weight(x) for x in self.operations if x[0] not in ("input", "neg", "call", "call_where", "part"))
        return own + sum(self.subprograms[args[0].value].cost for op, _, args in self.operations if op == "call")

    @functools.cached_property
    def read_places(self) -> tuple[int, ...]:
        """Inputs that are read; all of them where none is, as a call without operands would have no batch."""
        read = {args[0] for op, _, args in self.operations if op == "input"}
        return tuple(sorted(read)) or tuple(range(len(self.inputs)))

    @property
    def is_kept(self) -> bool:
        """Decide whether another process may find what calls this program: its digest is by its contents alone."""
        return all(x.is_kept for x in self.subprograms)

    @functools.cached_property
    def digest(self) -> str:
        """Hash of everything that the code depends on: programs of equal digests have the same code."""
        lines = [f"{op} {kind} {args}" for op, kind, args in self.operations]
        lines += [str(x) for x in (*self.inputs, *self.outputs, *self.results)] + [x.digest for x in self.subprograms]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()

    def counts(self) -> dict[str, int]:
        """Number of operations of each kind."""
        counts_by_kind: dict[str, int] = {}
        for x in self.operations:
            counts_by_kind[x[0]] = counts_by_kind.get(x[0], 0) + _weight(x)
        return counts_by_kind


class Loops:
    """Code with loops, which stands where a `Program` does and which others only call; it is kept on disk as it is."""

    derivative = fallback = None
    turns = 1
    is_called = is_kept = True
    subprograms: Sequence = ()

    def __getstate__(self):
        return vars(self) | {"derived": {}}

    def describe(self) -> "Loops":
        """Itself, as what is kept of it on disk (see `stored`)."""
        return self

    def restore(self, remake) -> "Loops":
        """The same of what is kept."""
        return self


def derived(make: Callable) -> Callable:
    """Keep what a function derives from a program and hashable arguments, for as long as the program lives; a decorator."""

    @functools.wraps(make)
    def call(program, *args):
        key = (make.__name__, *args)
        if key not in program.derived:
            program.derived[key] = make(program, *args)
        return program.derived[key]

    return call


def _weight(operation: Operation) -> int:
    """Number of instructions of an operation: those of several operands are written as a chain."""
    op, _, args = operation
    return len(args) - 1 if op in ("reduce_max", "reduce_min", "clamp") else 1


COMPARISONS: dict[str, Callable] = {
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
}
FUNCTIONS: dict[str, Callable] = {  # of one number
    name: getattr(np, numpy_name)
    for name, numpy_name in {
        "sqrt": "sqrt", "sin": "sin", "cos": "cos", "tan": "tan", "asin": "arcsin", "acos": "arccos", "atan": "arctan",
        "sinh": "sinh", "cosh": "cosh", "tanh": "tanh", "exp": "exp", "exp2": "exp2", "expm1": "expm1", "log": "log",
        "log1p": "log1p", "abs": "abs", "floor": "floor", "ceil": "ceil", "round": "rint", "sign": "sign", "cbrt": "cbrt",
    }.items()
} | {"stop_gradient": lambda x: x}  # fmt: skip
FUNCTIONS_OF_TWO: dict[str, Callable] = {
    "pow": np.power,
    "atan2": np.arctan2,
    "rem": np.fmod,
    "max": np.maximum,
    "min": np.minimum,
}


_KINDS = {"float64": "f8", "float32": "f4", "bool": "b1", "int32": "i4", "int64": "i8"}
_DTYPES = {kind: np.dtype(name) for name, kind in _KINDS.items()}


def kind_of(dtype) -> str:
    """Two letters for a dtype. **Raises:** KeyError for those that programs do not have."""
    return _KINDS[np.dtype(dtype).name]


def kind_or_refuse(dtype) -> str:
    """`kind_of` a dtype. **Raises:** `NotNumbers` for those that programs do not have."""
    try:
        return kind_of(dtype)
    except KeyError:
        raise NotNumbers(f"numbers of {dtype}") from None


def dtype_of(kind: str) -> np.dtype:
    """The dtype of a kind."""
    return _DTYPES[kind]


def as_kind(value, kind: str):
    """A known number as one of a kind, converted as XLA does.

    Beyond the range of an integer a float becomes the nearest end of it, and what is not a number zero; a longer integer is cut.
    """
    # Python's own float and bool for the two most frequent kinds, which compute twice as fast as NumPy's scalars.
    if kind == "f8":
        return float(value)
    if kind == "b1":
        return bool(value)
    dtype = _DTYPES[kind]
    if kind in FLOATS or not isinstance(value, (float, np.floating)):
        return np.asarray(value).astype(dtype)[()]
    # XLA saturates, where C leaves the result undefined.
    ends = np.iinfo(dtype)
    if math.isnan(value):
        return dtype.type(0)
    return dtype.type(ends.max if value >= ends.max else ends.min if value <= ends.min else int(value))


# --- numbers of a program while it is written ---
#
# Both kinds, unknown `Number`s and known ones with their type, are entries of NumPy arrays of objects, so that NumPy's own
# functions move them, and `Graph` computes with them. Known numbers carry their type: a Python float is a float64 and a Python
# bool a bool, all others are scalars of NumPy. So known integers wrap, and known float32 numbers round, as they would in XLA.


class Number:
    """A number of a graph that is not known before the program runs."""

    # Tens of thousands are made for a robot: slots save a dictionary for each.
    __slots__ = ("args", "graph", "kind", "op", "place")

    def __init__(self, graph: Any, op: str, kind: str, args: tuple):
        self.graph, self.op, self.kind, self.args = graph, op, kind, args
        self.place: int | None = None  # in the finished program


def is_number(x) -> bool:
    """Decide whether x is unknown before the program runs."""
    return type(x) is Number


def with_type(x):
    """A known number that numpy has computed; float64 and bool are Python's own, which are twice as fast."""
    return x.item() if isinstance(x, (np.float64, np.bool_)) else x


def objects(entries: Sequence, shape) -> np.ndarray:
    """An array of objects."""
    # `np.array(entries, object)` would look for sequences among the entries.
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
    # Scalars of numpy keep their type; those that Python has too are made Python's.
    return objects(x.ravel().tolist() if x.dtype in _OF_PYTHON else list(x.ravel()), x.shape)


_OF_PYTHON = (np.dtype(np.float64), np.dtype(bool))


def split_by_counts(values: Sequence, counts: Sequence[int]) -> tuple:
    """Consecutive parts of these lengths."""
    at, parts = 0, []
    for count in counts:
        parts.append(tuple(values[at : at + count]))
        at += count
    return tuple(parts)
