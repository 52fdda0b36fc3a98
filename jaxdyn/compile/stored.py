"""Scalar programs and executables on disk: a second process neither traces nor expands a function, nor derives its derivatives.

A program is found by the hash of what made it: the function with all that it reaches, its known numbers, the shapes of its
arguments, the modes in force and the sources of the package. A derivative is found by the key of its program. Two files belong to
a program. The first, under that key, has all that is needed to call machine code which is on disk too. The second has the
operations, under their own hash, and is read when a derivative has to be made, or code that is missing.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxdyn.compile import disk, jax_adapter, mode
from jaxdyn.compile.disk import NoFingerprint, fingerprint
from jaxdyn.compile.first_calls import phase
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.compile.known import is_concrete, is_tracing
from jaxdyn.compile.program import Array, Operation, Program

_PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "jaxtyping", "llvmlite")
_VARIABLES = ("XLA_FLAGS", "JAXDYN_COMPILATION", "JAXDYN_COMPILATION_OPTIONS")


@functools.cache
def environment() -> bytes:
    """Hash of the package's sources, and of the versions of what it calls."""
    versions = [disk.version_of(name) for name in _PACKAGES]
    with contextlib.suppress(ImportError):  # no llvmlite
        from jaxdyn.compile import objects

        versions.append(objects._environment())  # the processor
    return fingerprint(disk.hash_of_sources(Path(__file__).parents[1]), sys.version, tuple(versions))


def key_of(*parts: Any, configuration: Any = None) -> str | None:
    """Name under which what depends on these parts alone is kept; None where they cannot be hashed.

    `configuration`: JAX's options that count; all those in force by default.
    """
    if not jax_adapter.is_version_known():
        return None
    variables = tuple(os.environ.get(name) for name in _VARIABLES)
    configuration = jax_adapter.configuration() if configuration is None else configuration
    try:
        return fingerprint(environment(), variables, mode.state(), configuration, parts).hex()
    except (NoFingerprint, RecursionError) as reason:
        disk.logger.debug("jaxdyn: not kept on disk, as it depends on %s", reason)
        return None


class Description(NamedTuple):
    """A program without its operations."""

    inputs: tuple[Array, ...]
    outputs: tuple[Array, ...]
    name: str
    reports_validity: bool
    known: dict[str, Any]
    subprograms: tuple[Any, ...]

    @classmethod
    def of(cls, program: Program) -> "Description":
        """The description of a program."""
        known = {name: getattr(program, name) for name in ("digest", "cost", "read_places")}
        # Careful programs and those of matrices describe themselves.
        inner = tuple(cls.of(x) if isinstance(x, Program) else x.describe() for x in program.subprograms)
        return cls(program.inputs, program.outputs, program.name, program.reports_validity, known, inner)

    def restore(self, remake: Callable[[], Program]) -> "StoredProgram":
        """The program."""
        return StoredProgram(self, remake)


class StoredProgram(Program):
    """A program whose operations are read from disk when they are needed.

    `remake()` makes the program from the function, should its file be missing.
    """

    def __init__(self, description: Description, remake: Callable[[], Program]):
        inner = [x.restore(functools.partial(_subprogram_of, self, i)) for i, x in enumerate(description.subprograms)]
        self._remake, self.stored = remake, tuple(inner)
        self.start(description.inputs, description.outputs, inner, description.name)
        self.reports_validity = description.reports_validity
        # Properties that are computed from the operations elsewhere.
        self.__dict__ |= description.known

    @functools.cached_property
    def operations(self) -> list[Operation]:
        """Operations of the program."""
        return self._body[0]

    @functools.cached_property
    def results(self) -> tuple[tuple, ...]:
        """Entries of its outputs."""
        return self._body[1]

    @functools.cached_property
    def _body(self) -> tuple[list[Operation], tuple[tuple, ...]]:
        found = _load(f"{self.digest}.operations")
        if found is not None:
            return found
        return self.remade.operations, self.remade.results

    @functools.cached_property
    def remade(self) -> Program:
        """The program made again; its operations count where tracing has found another order than before."""
        made = self._remake()
        if made.digest != self.digest:
            if (made.inputs, made.outputs, made.read_places) != (self.inputs, self.outputs, self.read_places):
                raise error_of_retrace(self.name)
            self.subprograms = made.subprograms
        return made


def _subprogram_of(program: StoredProgram, i: int) -> Any:
    """Subprogram of a program that is made again, which may have its own in another order."""
    made = program.remade.subprograms
    found = [x for x in made if x.digest == program.stored[i].digest] or made[i : i + 1]
    if not found:
        raise error_of_retrace(program.name)
    return found[0]


def error_of_retrace(name: str) -> RuntimeError:
    """The error where a function gives another program than the one that is on disk under its key."""
    return RuntimeError(f"{name} has another program when it is traced again; remove {disk.cache_folder()}")


def load_or_make(key: str | None, make: Callable[[], tuple[Sequence[Program], Any]]) -> tuple[Sequence[Program], Any]:
    """make(), some programs and plain data about them, from disk where they are there.

    Derivatives and fallbacks of the programs are not kept: they are functions, which the caller sets.
    """
    with phase("expansion"):
        return make() if key is None else _load_or_make(key, make)


def _load_or_make(key: str, make: Callable) -> tuple[Sequence[Program], Any]:
    found = _load(f"{key}.program")
    if found is not None:
        again = functools.partial(_in_modes, mode.remember(), make)
        programs = [x.restore(functools.partial(_program_of, again, i)) for i, x in enumerate(found[0])]
        data = found[1]
    else:
        programs, data = make()
        if not all(x.is_kept for x in programs):
            return programs, data
        for one in programs:
            _save_operations(one)
        _save(f"{key}.program", ([*map(Description.of, programs)], data))
    for i, one in enumerate(programs):
        one.key = f"{key}-{i}"
    return programs, data


def _save_operations(program: Any) -> None:
    """Keep the operations of a program and of all that it calls, but those of careful programs, which may not be made yet."""
    if isinstance(program, Program):
        _save(f"{program.digest}.operations", (program.operations, program.results))
        for inner in program.subprograms:
            _save_operations(inner)


def _in_modes(enter: Callable, make: Callable) -> Any:
    with enter():
        return make()


def _program_of(make: Callable, i: int) -> Program:
    return make()[0][i]


def make_within(program: Program, parts: tuple, make: Callable[[], Program]) -> Program:
    """A program that is made of another one's operations, from disk where it is there."""
    return load_or_make(key_within(program, *parts), lambda: ([make()], None))[0][0]


def key_within(program: Program, *parts: Any) -> str | None:
    """Key of what is derived from a program."""
    return None if program.key is None else hashlib.sha256(f"{program.key} {parts}".encode()).hexdigest()


def _load(name: str) -> Any:
    contents = disk.read(name)
    if contents is None:
        return None
    # A class that has moved, in a package that says the same version, makes a file as good as missing.
    with contextlib.suppress(Exception):
        return pickle.loads(contents)
    return None


def _save(name: str, value: Any) -> None:
    try:
        contents = pickle.dumps(value, protocol=5)
    except Exception as reason:  # objects may raise anything when they are pickled
        disk.logger.debug("jaxdyn: %s is not kept on disk: %s", name, reason)
        return
    disk.write(name, contents)


# --- entry points as executables that are kept on disk: in a second process nothing of them is traced, lowered or compiled ---
#
# An executable belongs to a function, the structure and the types of its arguments, everything static in them, and JAX's options.
# In this process it is found by these, on disk by the hash of their contents (`stored.key_of`). Where they have none, as code of
# users, the function is traced in each process, and the executable is found by the text of its program.


# What a stored executable may call: kernels, which are restored with it, and functions that every jaxlib has. A call of
# anything else may hold an address of the process that made it.
_CALLS = re.compile(r"custom_call @(?:\"([^\"]*)\"|([\w.$]+))")
_SAFE = re.compile(
    r"jaxdyn_kernel|lapack_\w+|Sharding|annotate_device_placement|TopK|Qr|ProductOfElementaryHouseholderReflectors"
)
_NUMBERS = re.compile(r"program = (\d+) : i64")


class Static(NamedTuple):
    """An argument that is no array: a constant of the executable."""

    value: Any


class Executable(NamedTuple):
    """A compiled function of flat arrays, and how to make the results' tree of its flat results.

    `static`: in the place of each leaf of the results its value, or None where it is an array.
    """

    run: Callable
    static: tuple[Static | None, ...]
    structure: Any

    def __call__(self, arrays: Sequence) -> Any:
        results = iter(self.run(*arrays))
        leaves = [next(results) if x is None else x.value for x in self.static]
        return jax.tree.unflatten(self.structure, leaves)


def call_executable(function: Callable, args: tuple, kwargs: dict, options: Callable) -> Any:
    """function(*args, **kwargs) by its executable, for arrays on the default device; None where it has to be called otherwise.

    `options()`: XLA's options, which take time to find out.
    """
    if not jax_adapter.is_version_known():
        return None
    leaves, structure = jax.tree.flatten((args, kwargs))
    device, kinds, arrays = _default_sharding(), [], []
    for x in leaves:
        if isinstance(x, jax.Array):
            # Random keys have a dtype of their own.
            if isinstance(x, jax_adapter.Tracer) or x.sharding != device or not isinstance(x.dtype, np.dtype):
                return None
            kinds.append((x.shape, x.dtype, x.weak_type))
            arrays.append(x)
        elif isinstance(x, (np.ndarray, np.generic)):
            kinds.append((x.shape, jax.dtypes.canonicalize_dtype(x.dtype), False))
            arrays.append(x)
        else:
            # With its type: 1 and 1.0 and True are equal, and are other constants.
            kinds.append((type(x), Static(x), repr(x) if isinstance(x, float) else None))  # 0.0 and -0.0 are equal too
    context = jax_adapter.configuration(), mode.state()
    try:
        found = _executable(function, structure, tuple(kinds), options, context)
    except _Unhashable:
        return None
    return found(arrays)


class _Unhashable(Exception):
    pass


@functools.cache
def _default_sharding() -> Any:
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


def _executable(*key) -> Executable:
    try:
        hash(key)
    except TypeError:
        raise _Unhashable from None
    return _find(*key)


@functools.lru_cache(maxsize=1024)
def _find(function, structure, kinds, options, context) -> Executable:
    del context  # part of the key alone
    key = key_of("entry", function, structure, kinds)

    def trace() -> tuple[Any, list]:
        """The function, lowered, and its results' static leaves and structure."""
        results = []

        def flat(*arrays):
            given = iter(arrays)
            leaves = [x[1].value if isinstance(x[1], Static) else next(given) for x in kinds]
            found, out = jax.tree.flatten(_apply(function, structure, leaves))
            is_array = [isinstance(x, (jax.Array, np.ndarray, np.generic)) for x in found]
            results[:] = [tuple(None if y else Static(x) for x, y in zip(found, is_array, strict=True)), out]
            return [x for x, y in zip(found, is_array, strict=True) if y]

        flat.__name__ = getattr(function, "__name__", "flat")  # for profiles
        types = [jax.ShapeDtypeStruct(x[0], x[1], weak_type=x[2]) for x in kinds if not isinstance(x[1], Static)]
        jitted = jax.jit(flat, compiler_options=options(), keep_unused=True)
        return jitted.lower(*types), results

    recover = functools.partial(_in_modes, mode.remember(), trace)
    if key is not None and (found := _load_executable(key, recover)) is not None:
        return found
    with phase("tracing"):
        lowered, (static, out) = trace()
    text = lowered.as_text()
    is_kept = _may_be_kept(text, key is None)
    if key is None and is_kept and (key := key_of("text", text, options())) is not None:
        found = _load_executable(key, recover)
        if found is not None:
            return Executable(found.run, static, out)
    made = Executable(lowered.compile(), static, out)
    if key is not None and is_kept:
        _save_executable(key, text, made)
    return made


def _apply(function: Callable, structure: Any, leaves: list) -> Any:
    args, kwargs = jax.tree.unflatten(structure, leaves)
    return function(*args, **kwargs)


def _load_executable(key: str, recover: Callable) -> Executable | None:
    found = _load(f"{key}.executable")
    if found is None:
        return None
    from jaxdyn.compile import target

    # Whatever is wrong with a file, the function is compiled again.
    try:
        payload, rows, static, results = found
        for number, row in rows:
            target.restore(number, target.Row(*row), recover)
        return Executable(jax_adapter.load_executable(payload), static, jax.tree.structure(results))
    except Exception as reason:
        disk.logger.debug("jaxdyn: an executable on disk is made again: %s", reason)
        return None


def _may_be_kept(text: str, is_traced: bool) -> bool:
    """Decide whether a program calls nothing but what another process has too.

    `is_traced`: whether that process traces it first, so that it has the kernels which only one process knows by their numbers.
    """
    from jaxdyn.compile import target

    unsafe = {a or b for a, b in _CALLS.findall(text) if not _SAFE.fullmatch(a or b)}
    if not is_traced and not unsafe:
        rows = (target.row_of(int(x)) for x in set(_NUMBERS.findall(text)))
        unsafe |= {row.name for row in rows if not row.is_kept}
    if unsafe:
        disk.logger.debug("jaxdyn: a program is not kept on disk, as it calls %s", ", ".join(sorted(unsafe)))
    return not unsafe


def _save_executable(key: str, text: str, made: Executable) -> None:
    from jaxdyn.compile import target

    numbers = sorted({int(x) for x in _NUMBERS.findall(text)})
    rows = [(number, tuple(target.row_of(number))) for number in numbers]
    try:
        payload = jax_adapter.dump_executable(made.run)
        # An instance, not its structure: pickled ones do not know the marks of equinox for fields that are missing.
        results = jax.tree.unflatten(made.structure, [0] * len(made.static))
    except Exception as reason:
        disk.logger.debug("jaxdyn: an entry point is not kept on disk: %r", reason)
        return
    _save(f"{key}.executable", (payload, rows, made.static, results))


# --- entry points: functions that users call outside of any trace, compiled once per shape ---


def jit(function: Callable) -> Callable:
    """Compile a function, and keep what is compiled on disk: a second process traces it and compiles nothing.

    As `equinox.filter_jit`: arrays in the arguments are operands, everything else is a constant of the program. The program on
    disk is found by what tracing gives, all numbers within included: no change of the function, or of what it reads, gives
    another one's results. Under a transformation or another `jit`, and on devices other than CPUs, nothing is kept. Programs
    that call Python (`jax.pure_callback`) are not kept either.

    ```python
    @jd.jit
    def loss_gradient(model, q, v):
        return jax.grad(lambda v: jd.simulate(model, q, v, ts).q[-1].sum())(v)
    ```
    """
    return _compile(function, _usual_options)


def entry_point(function: Callable) -> Callable:
    """Compile a function that users call once per shape, its arrays being operands; a decorator.

    Within a trace it is the function as it stands: a nested `jit` would hide the values of known arrays.
    """
    return _compile(function, quick_options)


def _compile(function: Callable, options: Callable) -> Callable:
    usual = eqx.filter_jit(function)
    compiled = functools.cache(lambda: _jit(function, compiler_options=options()))

    @functools.wraps(function)
    def call(*args, **kwargs):
        if is_tracing():
            return function(*args, **kwargs)
        is_glue = _is_glue(jax.default_backend())
        if is_glue and _is_plain_call():
            found = call_executable(function, args, kwargs, options)
            if found is not None:
                return found
        # JAX refuses compiler options under a transformation such as `grad`, whose arguments are traced.
        if not (is_glue and is_concrete((args, kwargs))):
            return usual(*args, **kwargs)
        return compiled()(*args, **kwargs)

    return call


def _usual_options() -> None:
    """XLA's own options, for functions that are more than calls of kernels."""


def _is_plain_call() -> bool:
    """Decide whether JAX is to run what it has compiled, without checks within the call."""
    options = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks", "jax_default_device")
    return not any(getattr(jax.config, name) for name in options)


_jit: Any = eqx.filter_jit

# What XLA compiles is the glue between kernels. Its emitters of fusions, each a module of its own, take most of the time to
# compile it and bring nothing at run time: `python -m benchmarks.first_calls`, and again with
# JAXDYN_COMPILATION_OPTIONS=usual in the environment.
_QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_LEAST = _QUICK | {"xla_backend_optimization_level": 0}


@functools.cache
def quick_options() -> dict[str, Any] | None:
    """Options with which XLA compiles glue quickly.

    None where the environment asks for the usual ones.
    """
    if mode.wants_usual_options():
        return None
    return select_options(_LEAST if mode.wants_least_optimisation() else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"
