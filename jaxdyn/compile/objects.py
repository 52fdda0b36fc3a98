"""Machine code from LLVM IR, kept on disk: a second start of a script compiles no kernel again, nor writes its text.

An object file is found by the identity of the program that it computes, and by what its code depends on beside that: the sources
of this subpackage, which write the text, the versions of LLVM, and the processor's name and features.

A long text is compiled twice: at LLVM's lowest level, in a quarter of the time, and later once more (see `first_calls`). The bits
of results are those of the text at every level.
"""

import functools
import hashlib
import json
import logging
import re
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import llvmlite
import llvmlite.binding as llvm

from jaxdyn.compile import disk
from jaxdyn.compile.mode import options as wanted_options

logger = logging.getLogger("jaxdyn")
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
    parts = (identity, _environment(), str(_level()), str(LONG_LINES))
    return hashlib.sha256("\0".join(parts).encode()).hexdigest() + ".o"


@functools.cache
def _environment() -> str:
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


def find(identity: str) -> ObjectFile | None:
    """The machine code of a program from the folder, or None."""
    contents = disk.read(name_of_file(identity))
    if contents is None:
        return None
    head, _, rest = contents.partition(b"\n")
    calls, careful, size = json.loads(head)
    text = (lambda: zlib.decompress(rest[size:]).decode()) if len(rest) > size else None
    return ObjectFile(rest[:size], tuple(calls), tuple((number, tuple(row)) for number, row in careful), text)


def make(
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
    return Code((find(identity) or make(identity, lambda: text, ())).binary)


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
