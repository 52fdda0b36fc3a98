"""Scalar programs and machine code on disk: a second process traces and expands no function, derives none, and compiles none.

A program is found by the hash of what made it: the function with all that it reaches, its known numbers, the shapes of its
arguments, the modes in force and the sources of the package. A derivative is found by the key of its program. Two files belong to
a program. The first, under that key, has all that is needed to call machine code which is on disk too. The second has the
operations, under their own hash, and is read when a derivative has to be made, or code that is missing.
"""

import contextlib
import functools
import hashlib
import json
import logging
import os
import pickle
import re
import sys
import zlib
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from jaxdyn.compile import disk, jax_adapter, mode
from jaxdyn.compile.disk import NoFingerprint, fingerprint
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.mode import options as wanted_options
from jaxdyn.compile.mode import phase
from jaxdyn.compile.program import Array, Operation, Program

with contextlib.suppress(ImportError):  # none for this platform
    import llvmlite
    import llvmlite.binding as llvm

logger = logging.getLogger("jaxdyn")
_PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "optax", "jaxtyping", "llvmlite")
_VARIABLES = ("XLA_FLAGS", "JAXDYN_COMPILATION", "JAXDYN_COMPILATION_OPTIONS")


@functools.cache
def environment() -> bytes:
    """Hash of the package's sources, and of the versions of what it calls."""
    versions = []
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions.append(f"{name} {metadata.version(name)}")
    if sys.modules.get("llvmlite.binding") is not None:
        versions.append(_environment_of_code())  # the processor
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


# --- machine code from LLVM IR ---
#
# An object file is found by the identity of the program that it computes, and by what its code depends on beside that: the
# sources of this subpackage, which write the text, the versions of LLVM, and the processor's name and features. A long text is
# compiled twice: at LLVM's lowest level, in a quarter of the time, and later once more (see `mode.optimise_later`). The bits of
# results are those of the text at every level.

ANNOUNCED_LINES = 100_000  # of LLVM's text, which compile in some five seconds
LONG_LINES = 6000  # of LLVM's text, beyond which a kernel is straight code of one program but for few lines
BLOCK_LINES = 500  # of a block at the lowest level: a kernel of 29 000 lines takes a fifth of the time
QUICK_LINES = 300  # of LLVM's text, which take 0.02 s
QUICK_BYTES = 1 << 22  # of memory on the stack, where at the lowest level almost every number has a place of its own


@functools.cache
def initialize() -> None:
    """Make LLVM ready for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


@functools.cache
def features() -> str:
    """Features of the processor, as LLVM writes them."""
    return llvm.get_host_cpu_features().flatten()


def target_machine(level: int | None = None):
    """LLVM's description of this processor; not shared, as each engine takes its own."""
    initialize()
    target, level = llvm.Target.from_triple(llvm.get_process_triple()), _level() if level is None else level
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=level, jit=True, reloc="pic"
    )


def _level() -> int:
    """Level at which LLVM turns its instructions into those of the processor."""
    # Level 2 adds a second scheduler, which takes half of the time in functions of tens of thousands of lines.
    return 0 if wanted_options() == "least" else 1


def name_of_file(identity: str) -> str:
    """Name of the file with the machine code of a program with this identity."""
    parts = (identity, _environment_of_code(), str(_level()), str(LONG_LINES))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest() + ".o"


@functools.cache
def _environment_of_code() -> str:
    version = ".".join(map(str, llvm.llvm_version_info))
    sources = disk.hash_of_sources(Path(__file__).parent).hex()
    processor = llvm.get_host_cpu_name(), features(), llvm.get_process_triple()
    return "\0".join((version, llvmlite.__version__, sources, *processor))


class ObjectFile(NamedTuple):
    """Machine code as bytes, the symbols of the subprograms that it calls, and the rows of careful programs, by their numbers.

    `text()`: of quick code, which is to be compiled once more. `is_kept`: whether the folder has the file; where the text is not
    that of the quick code, it is written after the first call.
    """

    binary: bytes
    calls: tuple[str, ...]
    careful: tuple[tuple[int, tuple], ...]
    text: Callable[[], str] | None = None
    is_kept: bool = True

    def improve(self, identity: str) -> "ObjectFile":
        """The optimised code, which takes the place of this one in the folder too."""
        assert self.text is not None
        made = self._replace(binary=compile_text(self.text()), text=None)
        _keep(identity, made)
        return made

    def keep(self, identity: str) -> None:
        """Put the file into the folder, if it is not there."""
        if not self.is_kept:
            _keep(identity, self)


def find_code(identity: str) -> ObjectFile | None:
    """The machine code of a program from the folder, or None."""
    contents = disk.read(name_of_file(identity))
    if contents is None:
        return None
    head, _, rest = contents.partition(b"\n")
    calls, careful, size = json.loads(head)
    text = (lambda: zlib.decompress(rest[size:]).decode()) if len(rest) > size else None
    return ObjectFile(rest[:size], tuple(calls), tuple((number, tuple(row)) for number, row in careful), text)


def make_code(
    identity: str,
    write: Callable[[], str],
    calls: Sequence[str],
    careful: Sequence = (),
    name: str = "",
    width: int = 0,
    write_quick: Callable[[], str] | None = None,
) -> ObjectFile:
    """Compile the text that `write()` gives, and keep the code in the folder.

    `width`: samples in a vector of code that may be quick; zero for code that is optimised at once. `write_quick()`: the text of
    the same function that compiles quickly (see `listing`); without it quick code is that of LLVM's lowest level.
    """
    if write_quick is not None:
        return ObjectFile(compile_text(write_quick()), tuple(calls), tuple(careful), write, is_kept=False)
    text = write()
    if (lines := text.count("\n")) > ANNOUNCED_LINES:
        message = "jaxdyn: compiling %s, %d lines; the next start of this script reads it from the cache"
        logger.warning(message, name or "a function", lines)
    is_quick = width > 0 and lines > QUICK_LINES and has_two_levels() and 8 * width * lines < QUICK_BYTES
    made = ObjectFile(compile_text(text, is_quick), tuple(calls), tuple(careful), (lambda: text) if is_quick else None)
    _keep(identity, made)
    return made


def has_two_levels() -> bool:
    """Decide whether code is made quickly at first."""
    return not wanted_options()


def _keep(identity: str, made: ObjectFile) -> None:
    head = json.dumps([list(made.calls), list(made.careful), len(made.binary)]).encode()
    text = zlib.compress(made.text().encode(), 1) if made.text else b""
    disk.write(name_of_file(identity), head + b"\n" + made.binary + text)


def code_of(text: str) -> "Code":
    """The machine code of a text, from the folder or compiled now."""
    identity = hashlib.sha256(text.encode()).hexdigest()
    return Code((find_code(identity) or make_code(identity, lambda: text, ())).binary)


class Code:
    """Machine code in memory, as long as it is held."""

    def __init__(self, binary: bytes):
        initialize()
        # The engine is given the object file alone: it would keep the text that it compiles for as long as it lives.
        self.engine = llvm.create_mcjit_compiler(_module("", machine := target_machine()), machine)
        self.engine.add_object_file(llvm.ObjectFileRef.from_data(binary))
        self.engine.finalize_object()

    def address(self, name: str) -> int:
        """Address of a function."""
        return self.engine.get_function_address(name)


def add_symbol(symbol: str, address: int) -> None:
    """Let code that is made from now on find an address by this name."""
    llvm.add_symbol(symbol, address)


def _module(text: str, machine):
    module = llvm.parse_assembly(text)
    module.triple = llvm.get_process_triple()
    module.data_layout = str(machine.target_data)
    return module


# The first element of a vector of equal ones.
_BROADCAST = re.compile(r"(  %\w+ = insertelement <\d+ x (\w+)> poison, \w+ )(%\w+)(, i32 0)")


_LABEL, _ORIGIN = re.compile(r"([\w.]+):"), re.compile(r", %([\w.]+) \]")


def _in_short_blocks(text: str) -> str:
    """The text with long blocks in parts: the time that LLVM's lowest level takes grows faster than their length."""
    whole, function, last = [], [], {}  # of each label, that of the last part of its block
    label, count = "", 0
    for line in text.split("\n"):
        function.append(line)
        count += 1
        if line.startswith("define"):
            label, count = "", 0
        elif found := _LABEL.match(line):
            label, count = found.group(1), 0
        elif count >= BLOCK_LINES and line.startswith("  %") and " phi " not in line and " alloca " not in line:
            last[label], count = f"short{len(function)}", 0
            function += [f"  br label %{last[label]}", f"{last[label]}:"]
        elif line == "}":
            rename = functools.partial(lambda names, origin: f", %{names.get(origin[1], origin[1])} ]", last)
            whole += [_ORIGIN.sub(rename, x) if " phi " in x else x for x in function]
            function, last = [], {}
    return "\n".join([*whole, *function])


def compile_text(text: str, is_quick: bool = False) -> bytes:
    """The object file of a text of LLVM."""
    if is_quick or wanted_options() == "least":
        # LLVM 22 at level 0 aborts where it merges loads with their broadcasts ("Node is not in map!").
        text = _in_short_blocks(_BROADCAST.sub(r"  \3.frozen = freeze \2 \3\n\1\3.frozen\4", text))
        machine = target_machine(0)
        return machine.emit_object(_module(text, machine))
    machine = target_machine()
    module = _module(text, machine)
    options = llvm.create_pipeline_tuning_options(speed_level=1)
    # The text is vectors already, in one block of thousands of lines: LLVM's vectorisers would only take time.
    options.loop_vectorization = options.slp_vectorization = options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine, options)
    passes = builder.getModulePassManager()
    if text.count("\n") > LONG_LINES:
        # Only this pass shortens straight code, by a few per cent. All of them take ten times as long, a third of the whole.
        passes = llvm.create_new_module_pass_manager()
        passes.add_instruction_combine_pass()
    passes.run(module, builder)
    return machine.emit_object(module)
