"""Scalar programs on disk: a second process neither traces nor expands a function, nor derives its derivatives.

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
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from jaxdyn.compile import disk, jax_adapter, mode
from jaxdyn.compile.disk import NoFingerprint, fingerprint
from jaxdyn.compile.first_calls import phase
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.program import Array, Operation, Program

_PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "jaxtyping", "llvmlite")
_VARIABLES = ("XLA_FLAGS", "JAXDYN_COMPILATION", "JAXDYN_COMPILATION_OPTIONS")


@functools.cache
def environment() -> bytes:
    """Hash of the package's sources, and of the versions of what it calls."""
    versions = []
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions.append(f"{name} {metadata.version(name)}")
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
        found = load(f"{self.digest}.operations")
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
        if key is None:
            return make()
        found = load(f"{key}.program")
        if found is not None:
            again, (descriptions, data) = functools.partial(in_modes, mode.remember(), make), found
            programs = [x.restore(lambda i=i: again()[0][i]) for i, x in enumerate(descriptions)]
        else:
            programs, data = make()
            if not all(x.is_kept for x in programs):
                return programs, data
            for one in programs:
                _save_operations(one)
            save(f"{key}.program", ([*map(Description.of, programs)], data))
        for i, one in enumerate(programs):
            one.key = f"{key}-{i}"
        return programs, data


def _save_operations(program: Any) -> None:
    """Keep the operations of a program and of all that it calls, but those of careful programs, which may not be made yet."""
    if isinstance(program, Program):
        save(f"{program.digest}.operations", (program.operations, program.results))
        for inner in program.subprograms:
            _save_operations(inner)


def in_modes(enter: Callable, make: Callable) -> Any:
    """make() in other modes, from a thread of XLA or a later call (see `mode.remember`)."""
    with enter():
        return make()


def make_within(program: Program, parts: tuple, make: Callable[[], Program]) -> Program:
    """A program that is made of another one's operations, from disk where it is there."""
    return load_or_make(key_within(program, *parts), lambda: ([make()], None))[0][0]


def key_within(program: Program, *parts: Any) -> str | None:
    """Key of what is derived from a program."""
    return None if program.key is None else hashlib.sha256(f"{program.key} {parts}".encode()).hexdigest()


def load(name: str) -> Any:
    """Read the object that `save` wrote under this name; None if there is none."""
    contents = disk.read(name)
    if contents is None:
        return None
    # A class that has moved, in a package that says the same version, makes a file as good as missing.
    with contextlib.suppress(Exception):
        return pickle.loads(contents)
    return None


def save(name: str, value: Any) -> None:
    """Keep an object that can be pickled."""
    try:
        contents = pickle.dumps(value, protocol=5)
    except Exception as reason:  # objects may raise anything when they are pickled
        disk.logger.debug("jaxdyn: %s is not kept on disk: %s", name, reason)
        return
    disk.write(name, contents)
