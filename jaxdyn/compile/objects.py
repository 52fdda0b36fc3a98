"""Machine code from LLVM IR, kept on disk: a second start of a script compiles no kernel again, nor writes its text.

An object file is found by the identity of the program that it computes, and by what its code depends on beside that: the sources
of this subpackage, which write the text, the versions of LLVM, and the processor's name and features.
"""

import functools
import hashlib
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import llvmlite
import llvmlite.binding as llvm

from jaxdyn.compile import disk
from jaxdyn.compile.mode import wants_least_optimisation

logger = logging.getLogger("jaxdyn")
ANNOUNCED_LINES = 100_000  # of LLVM's text, which compile in some five seconds
LONG_LINES = 6000  # of LLVM's text, beyond which a kernel is straight code of one program but for few lines


@functools.cache
def initialize() -> None:
    """Make LLVM ready for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


@functools.cache
def features() -> str:
    """Features of the processor, as LLVM writes them."""
    return llvm.get_host_cpu_features().flatten()


def target_machine():
    """LLVM's description of this processor; not shared, as each engine takes its own."""
    initialize()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=_level(), jit=True, reloc="pic"
    )


def _level() -> int:
    """Level at which LLVM turns its instructions into those of the processor."""
    # Level 2 adds a second scheduler, which takes half of the time in functions of tens of thousands of lines.
    return 0 if wants_least_optimisation() else 1


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
    """Machine code as bytes, the symbols of the subprograms that it calls, and the rows of careful programs, by their numbers."""

    binary: bytes
    calls: tuple[str, ...]
    careful: tuple[tuple[int, tuple], ...]


def find(identity: str) -> ObjectFile | None:
    """The machine code of a program from the folder, or None."""
    contents = disk.read(name_of_file(identity))
    if contents is None:
        return None
    head, _, binary = contents.partition(b"\n")
    calls, careful = json.loads(head)
    return ObjectFile(binary, tuple(calls), tuple((number, tuple(row)) for number, row in careful))


def make(identity: str, text: str, calls: Sequence[str], careful: Sequence = (), name: str = "") -> ObjectFile:
    """Compile a text, and keep the code in the folder."""
    if (lines := text.count("\n")) > ANNOUNCED_LINES:
        message = "jaxdyn: compiling %s, %d lines; the next start of this script reads it from the cache"
        logger.warning(message, name or "a function", lines)
    binary = compile_text(text)
    disk.write(name_of_file(identity), json.dumps([list(calls), list(careful)]).encode() + b"\n" + binary)
    return ObjectFile(binary, tuple(calls), tuple(careful))


def find_careful(digest: str) -> str | None:
    """Identity of the code of the careful program with this digest, or None."""
    contents = disk.read(name_of_file(f"careful {digest}"))
    return None if contents is None else contents.decode()


def keep_careful(digest: str, identity: str) -> None:
    """Keep the identity of the code of a careful program."""
    disk.write(name_of_file(f"careful {digest}"), identity.encode())


def code_of(text: str) -> "Code":
    """The machine code of a text, from the folder or compiled now."""
    identity = hashlib.sha256(text.encode()).hexdigest()
    return Code((find(identity) or make(identity, text, ())).binary)


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

    def publish(self, name: str, symbol: str) -> None:
        """Let code that is made from now on call a function by this name."""
        llvm.add_symbol(symbol, self.address(name))


def _module(text: str, machine):
    module = llvm.parse_assembly(text)
    module.triple = llvm.get_process_triple()
    module.data_layout = str(machine.target_data)
    return module


def compile_text(text: str) -> bytes:
    """The object file of a text of LLVM."""
    machine = target_machine()
    module = _module(text, machine)
    if wants_least_optimisation():
        return machine.emit_object(module)
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
