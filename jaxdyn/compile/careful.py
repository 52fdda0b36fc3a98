"""Programs for the samples that another program marks as not valid: they are made when the first such sample appears.

A kernel with marks (`flags`) is two programs. The fast one says by its last output whether the sample is valid. The careful
one computes the samples that are not: it calls pseudo-inverses, which have loops, and is compiled for one sample. Hardly any run
needs it, so that nothing of it is traced before: native code asks for it by its number (`target`, `handler.ll`).
Derivatives of a pair are pairs.
"""

import functools
import hashlib
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from jaxdyn.compile import derive, mode
from jaxdyn.compile.llvm import Emitter
from jaxdyn.compile.program import Array, Constant, Operation, Program, derived, kind_of
from jaxdyn.compile.rules import change_along
from jaxdyn.compile.stored import error_of_retrace, key_within

T = TypeVar("T")


def run_apart(function: Callable[[], T]) -> T:
    """function() in a thread of its own: the calling one may belong to XLA, or be in the midst of a trace."""
    with ThreadPoolExecutor(1, thread_name_prefix="jaxdyn careful") as other:
        return other.submit(function).result()


class Careful:
    """A subprogram that is made when it is called for the first time.

    - `make()` -> its `Program`, traced as `mode.careful(which)`.
    - `by_jax(*flat)`: the same by operations of JAX, from flat arrays of one sample to flat arrays.
    """

    is_called = True
    derivative = fallback = None
    turns, cost, subprograms = 1, 0, ()

    def __init__(
        self,
        inputs,
        outputs,
        digest: str,
        name: str,
        make: Callable[[], Program],
        by_jax: Callable,
        which: str,
        is_kept: bool,
    ):
        self.inputs: tuple[Array, ...] = tuple(inputs)
        self.outputs: tuple[Array, ...] = tuple(outputs)
        self.results = tuple(tuple(range(array.size)) for array in self.outputs)
        # Identity among careful programs; that of the code is the digest of the program. `is_kept` as of `Program`.
        self.digest, self.is_kept = digest, is_kept
        self.name, self.by_jax, self.which = name, by_jax, which
        self.derived: dict = {}
        self._make, self._made, self._lock = make, None, threading.Lock()
        self._enter_modes = mode.remember()

    def program(self) -> Program:
        """The program."""
        return run_apart(self._program)

    def _program(self) -> Program:
        with self._lock:
            if self._made is None:
                with self._enter_modes(), mode.careful(self.which):
                    self._made = self._make()
            return self._made

    def describe(self) -> "Description":
        """Its description among the subprograms that are kept on disk (see `stored`)."""
        return Description(self.inputs, self.outputs, self.digest, self.name, self.which)

    @derived
    def tangent(self, moving: tuple[bool, ...]) -> "Careful":
        """The program of the change of the outputs (see `derive.tangent`)."""
        return Careful(
            [*self.inputs, *(x for x, varies in zip(self.inputs, moving, strict=True) if varies)],
            [array for array in self.outputs if array.dtype.kind == "f"],
            _digest(self.digest, "tangent", moving),
            f"change of {self.name}",
            lambda: derive.tangent(self._program(), moving),
            functools.partial(_tangent_by_jax, self, moving),
            self.which,
            self.is_kept,
        )

    @derived
    def transpose(self, linear: tuple[bool, ...], given: tuple[bool, ...], of_program: Callable) -> "Careful":
        """The program of cotangents of the `linear` inputs (see `derive.transpose`), by `of_program(program, linear, given)`."""
        fixed = [x for x, varies in zip(self.inputs, linear, strict=True) if not varies]
        return Careful(
            [*fixed, *(x for x, is_given in zip(self.outputs, given, strict=True) if is_given)],
            [x for x, varies in zip(self.inputs, linear, strict=True) if varies],
            _digest(self.digest, "transposed", linear, given),
            f"transpose of {self.name}",
            lambda: of_program(self._program(), linear, given),
            functools.partial(_transpose_by_jax, self, linear, given),
            self.which,
            self.is_kept,
        )


class Description(NamedTuple):
    """A careful program among the subprograms of one that is kept on disk."""

    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    digest: str
    name: str
    which: str

    def restore(self, remake: Callable[[], Careful]) -> Careful:
        """The careful program; `remake()` makes it from the function again, which hardly any process needs."""
        inputs, outputs, digest, name, which = self

        def again() -> Careful:
            made = remake()
            if not isinstance(made, Careful) or (made.inputs, made.outputs) != (inputs, outputs):
                raise error_of_retrace(name)
            return made

        def by_jax(*flat):
            return again().by_jax(*flat)

        return Careful(inputs, outputs, digest, name, lambda: again()._program(), by_jax, which, True)


def _digest(*parts) -> str:
    return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()


_taken: dict[str, Any] = {}


def digest_of(key: str | None, content: str, recipe: Any) -> tuple[str, bool]:
    """Identity of a careful program, and whether it is one for all processes.

    `key`: under which it is kept on disk; None where that is not possible. `content` and `recipe` are then what it is made from,
    as text and as an object that equals no other one.
    """
    # Not by its own text, which is not known yet. It has to be found by the same number in another process.
    if key is not None:
        return _digest("careful", key), True
    digest = _digest("careful of this process", content)
    while _taken.setdefault(digest, recipe) != recipe:
        digest = _digest(digest)
    return digest, False


class Pair(Program):
    """A program whose samples that are not valid are computed by the careful one.

    Its operations are made when they are read: a kernel is written from those of the fast program.
    """

    fast: Program
    careful: Careful

    def __init__(self, fast: Program, careful: Careful):
        self.start(fast.inputs, careful.outputs, (*fast.subprograms, careful), fast.name)
        self.fast, self.careful = fast, careful
        self.derivative = lambda moving: guard(derive.tangent(fast, moving), lambda: careful.tangent(moving))
        if (fallback := fast.fallback) is not None:
            self.fallback = lambda *flat: fallback(*flat)[:-1]  # without the flag
        self.key = key_within(fast, "pair", careful.digest) if careful.is_kept else None

    @functools.cached_property
    def digest(self) -> str:
        """Hash of the digests of both programs."""
        return _digest("pair", self.fast.digest, self.careful.digest)

    @property
    def cost(self) -> int:
        """Cost of the fast program."""
        return self.fast.cost

    @property
    def read_places(self) -> tuple[int, ...]:
        """All inputs: which of them the careful program reads is not known."""
        return tuple(range(len(self.inputs)))

    @property
    def operations(self) -> list[Operation]:
        """Operations of both programs."""
        return self._body[0]

    @property
    def results(self) -> tuple[tuple, ...]:
        """Entries of the outputs."""
        return self._body[1]

    @functools.cached_property
    def _body(self) -> tuple[list[Operation], tuple[tuple, ...]]:
        fast, operations = self.fast, list(self.fast.operations)
        place = {args: i for i, (op, _, args) in enumerate(operations) if op == "input"}

        def add(*operation) -> int:
            operations.append(operation)
            return len(operations) - 1

        def entry(array: int, k: int) -> int:
            if (array, k) not in place:
                place[array, k] = add("input", kind_of(fast.inputs[array].dtype), (array, k))
            return place[array, k]

        inputs = [entry(i, k) for i, array in enumerate(fast.inputs) for k in range(array.size)]
        *values, (valid,) = fast.results
        flag = Constant(not valid.value) if type(valid) is Constant else add("not", "b1", (valid,))
        number = Constant(len(fast.subprograms))
        call = add("call_where", "call", (number, flag, *inputs, *(x for row in values for x in row)))
        results, at = [], 0
        for array in self.careful.outputs:
            kind = kind_of(array.dtype)
            results.append(tuple(add("part", kind, (call, Constant(at + k))) for k in range(array.size)))
            at += array.size
        return operations, tuple(results)


def guard(fast: Program, careful: Callable[[], Careful]) -> Program:
    """The pair of a program and a careful one; the program itself where it does not report which samples are valid."""
    return Pair(fast, careful()) if fast.reports_validity else fast


def _tangent_by_jax(base: Careful, moving, *flat) -> list:
    count = len(base.inputs)
    changes = change_along(base.by_jax, flat[:count], moving, flat[count:])
    return [x for x, array in zip(changes, base.outputs, strict=True) if array.dtype.kind == "f"]


def _transpose_by_jax(base: Careful, linear, given, *flat) -> list:
    count = linear.count(False)

    def at_values(*values):
        fixed, moved = iter(flat[:count]), iter(values)
        return base.by_jax(*(next(moved if varies else fixed) for varies in linear))

    cotangents = iter(flat[count:])
    zeros = [jnp.zeros(x.size, x.dtype) for x, varies in zip(base.inputs, linear, strict=True) if varies]
    _, pull = jax.vjp(at_values, *zeros)
    of_outputs = [
        next(cotangents) if is_given else jnp.zeros(x.size, x.dtype)
        for x, is_given in zip(base.outputs, given, strict=True)
    ]
    return list(pull(of_outputs))


# --- the text of calls of careful programs: `careful` of `handler.ll`, for those samples of a block whose flag is set ---


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
