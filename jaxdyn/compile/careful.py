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

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import derive, mode
from jaxdyn.compile.program import Array, Constant, Operation, Program, kind_of


class Careful:
    """A subprogram that is made when it is called for the first time.

    - `make()` -> its `Program`, traced as `mode.careful(which)`.
    - `by_jax(*flat)`: the same by operations of JAX, from flat arrays of one sample to flat arrays.
    """

    is_called = True
    derivative = fallback = None
    turns, cost, subprograms = 1, 0, ()

    def __init__(
        self, inputs, outputs, digest: str, name: str, make: Callable[[], Program], by_jax: Callable, which: str
    ):
        self.inputs: tuple[Array, ...] = tuple(inputs)
        self.outputs: tuple[Array, ...] = tuple(outputs)
        self.results = tuple(tuple(range(array.size)) for array in self.outputs)
        # Identity of the code, as `Program.digest`.
        self.digest, self.name, self.by_jax, self.which = digest, name, by_jax, which
        self.derived: dict = {}
        self._make, self._made, self._lock = make, None, threading.Lock()
        self._has_x64 = jax.dtypes.canonicalize_dtype(np.float64) == np.float64

    def program(self) -> Program:
        """The program. It is made in a thread of its own: the calling one may belong to XLA, or be in the midst of a trace."""
        with ThreadPoolExecutor(1, thread_name_prefix="jaxdyn careful") as other:
            return other.submit(self._program).result()

    def _program(self) -> Program:
        with self._lock:
            if self._made is None:
                with jax.enable_x64(self._has_x64), mode.careful(self.which):
                    self._made = self._make()
            return self._made

    def tangent(self, moving: Sequence[bool]) -> "Careful":
        """The program of the change of the outputs (see `derive.tangent`)."""
        moving = tuple(moving)
        if moving not in self.derived:
            inputs = [*self.inputs, *(x for x, varies in zip(self.inputs, moving, strict=True) if varies)]
            outputs = [array for array in self.outputs if array.dtype.kind == "f"]
            self.derived[moving] = Careful(
                inputs,
                outputs,
                _digest(self.digest, "tangent", moving),
                f"change of {self.name}",
                lambda: derive.tangent(self._program(), moving),
                functools.partial(_tangent_by_jax, self, moving),
                self.which,
            )
        return self.derived[moving]

    def transpose(self, linear: Sequence[bool], given: Sequence[bool], of_program: Callable) -> "Careful":
        """The program of cotangents of the `linear` inputs (see `derive.transpose`), by `of_program(program, linear, given)`."""
        linear, given = tuple(linear), tuple(given)
        key = ("transposed", linear, given)
        if key not in self.derived:
            inputs = [x for x, varies in zip(self.inputs, linear, strict=True) if not varies]
            inputs += [x for x, is_given in zip(self.outputs, given, strict=True) if is_given]
            self.derived[key] = Careful(
                inputs,
                [x for x, varies in zip(self.inputs, linear, strict=True) if varies],
                _digest(self.digest, *key),
                f"transpose of {self.name}",
                lambda: of_program(self._program(), linear, given),
                functools.partial(_transpose_by_jax, self, linear, given),
                self.which,
            )
        return self.derived[key]


def _digest(*parts) -> str:
    return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()


_taken: dict[str, int] = {}


def digest_beside(fast: Program, content: str, key) -> str:
    """Identity of the careful program beside a fast one; `content` and `key` are what it is made from, as text and hashable."""
    # By the fast program, not by its own text, which is not known yet: it has to be found by the same number in another process.
    digest = _digest("careful", fast.digest, content)
    while _taken.setdefault(digest, hash(key)) != hash(key):  # another fallback of the same name
        digest = _digest(digest)
    return digest


def guard(fast: Program, careful: Careful) -> Program:
    """The program whose samples that are not valid are computed by the careful one."""
    operations = list(fast.operations)
    place = {x.args: i for i, x in enumerate(operations) if x.op == "input"}

    def add(*operation) -> int:
        operations.append(Operation(*operation))
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
    for array in careful.outputs:
        kind = kind_of(array.dtype)
        results.append(tuple(add("part", kind, (call, Constant(at + k))) for k in range(array.size)))
        at += array.size
    subprograms = (*fast.subprograms, careful)
    program = Program(fast.inputs, careful.outputs, operations, results, subprograms, name=fast.name)
    program.fast, program.careful = fast, careful
    program.derivative = functools.partial(_guarded_tangent, program)
    if fast.fallback is not None:
        program.fallback = functools.partial(_without_flag, fast.fallback)
    return program


def _guarded_tangent(program: Program, moving) -> Program:
    assert program.fast is not None and program.careful is not None
    change = derive.tangent(program.fast, moving)
    return guard(change, program.careful.tangent(moving)) if change.reports_validity else change


def _without_flag(fallback: Callable, *flat) -> list:
    return fallback(*flat)[:-1]


def _tangent_by_jax(base: Careful, moving, *flat) -> list:
    count = len(base.inputs)
    places = [i for i, varies in enumerate(moving) if varies]

    def at_values(*values):
        point = list(flat[:count])
        for i, value in zip(places, values, strict=True):
            point[i] = value
        return [x for x, array in zip(base.by_jax(*point), base.outputs, strict=True) if array.dtype.kind == "f"]

    return jax.jvp(at_values, [flat[i] for i in places], list(flat[count:]))[1]


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
