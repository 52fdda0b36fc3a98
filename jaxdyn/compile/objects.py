"""Machine code from LLVM IR, kept on disk: a second start of a script compiles no kernel again.

An object file is found by the hash of the IR, of LLVM's version and level, and of the processor's name and features. Files
are written under another name and moved to their final one, so that two processes that build one at once do not disturb
each other. Each ends with a checksum, and one that is damaged is built anew. Where the folder cannot be written, code stays in
memory, with one warning.
"""

import contextlib
import functools
import hashlib
import logging
import os
import tempfile
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm

from jaxdyn.compile.mode import wants_least_optimisation

logger = logging.getLogger("jaxdyn")
MAX_CACHE_BYTES = 512 * 2**20
ANNOUNCED_LINES = 100_000  # of LLVM's text, which compile in some five seconds
LONG_LINES = 6000  # of LLVM's text, beyond which a kernel is straight code of one program but for few lines
_CHECKSUM_BYTES = 32


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


def key_of(text: str) -> bytes:
    """Hash of a kernel's IR and of everything else that its machine code depends on."""
    version = ".".join(map(str, llvm.llvm_version_info))
    parts = (
        text,
        version,
        llvmlite.__version__,
        llvm.get_host_cpu_name(),
        features(),
        llvm.get_process_triple(),
        str(_level()),
        str(LONG_LINES),
    )
    return hashlib.sha256("\0".join(parts).encode()).digest()


class Code:
    """Machine code in memory, as long as it is held."""

    def __init__(self, text: str, stored: bool = True, name: str = ""):
        initialize()
        self.key = key_of(text)
        binary = _read(self.key) if stored else None
        if binary is None:
            if (lines := text.count("\n")) > ANNOUNCED_LINES:
                message = "jaxdyn: compiling %s, %d lines; the next start of this script reads it from the cache"
                logger.warning(message, name or "a function", lines)
            binary = _compile(text)
            if stored:
                _write(self.key, binary)
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


def _compile(text: str) -> bytes:
    """The object file of a kernel."""
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


# --- files ---

_folder: Path | None = None
_is_off = False


def cache_folder() -> Path:
    """Folder of the object files: `jaxdyn/kernels` in the user's folder for caches."""
    if _folder is not None:
        return _folder
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Path(base) / "jaxdyn" / "kernels"


def set_cache_folder(folder) -> None:
    """Keep object files elsewhere; None for the default place."""
    global _folder, _is_off
    _folder, _is_off = None if folder is None else Path(folder), False


def _path(key: bytes) -> Path:
    return cache_folder() / f"{key.hex()}.o"


def _read(key: bytes) -> bytes | None:
    try:
        path = _path(key)
        binary = path.read_bytes()
    except (OSError, RuntimeError):  # a home that cannot be determined is a RuntimeError
        return None
    code, checksum = binary[:-_CHECKSUM_BYTES], binary[-_CHECKSUM_BYTES:]
    if hashlib.sha256(code).digest() != checksum:
        logger.warning("jaxdyn: %s is damaged and is built again", path)
        return None
    # The time of last use, by which the folder is pruned: file systems often do not note reads.
    with contextlib.suppress(OSError):
        os.utime(path)
    return code


def _write(key: bytes, code: bytes) -> None:
    global _is_off
    if _is_off:
        return
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(code + hashlib.sha256(code).digest())
            os.replace(name, _path(key))
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(name)
            raise
        _prune(folder)
    except (OSError, RuntimeError) as error:
        # A full disk or a read-only home must not stop a computation.
        _is_off = True
        logger.warning("jaxdyn: kernels are not kept on disk, and are compiled again at the next start: %s", error)


@functools.cache  # once in a process
def _prune(folder: Path) -> None:
    """Remove the files that were used longest ago where all of them are more than `MAX_CACHE_BYTES`."""
    files = []
    for path in folder.glob("*"):
        with contextlib.suppress(OSError):
            status = path.stat()
            files.append((status.st_mtime, status.st_size, path))
    excess = sum(size for _, size, _ in files) - MAX_CACHE_BYTES
    for _, size, path in sorted(files):
        if excess <= 0:
            return
        with contextlib.suppress(OSError):
            path.unlink()
        excess -= size
