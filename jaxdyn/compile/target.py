"""The one FFI target of the process: a table of kernels, and the handler through which XLA calls them (`handler.ll`)."""

import ctypes
import functools
import logging
import threading
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from jaxdyn.compile import ahead
from jaxdyn.compile.careful import Careful
from jaxdyn.compile.careful_text import CAREFUL, number_of
from jaxdyn.compile.code import calls_itself, kernel_ir, subprogram_ir, symbol_of, varying_first
from jaxdyn.compile.jax_adapter import Unsupported as Unsupported
from jaxdyn.compile.jax_adapter import ffi_version, register_handler
from jaxdyn.compile.objects import Code, features
from jaxdyn.compile.program import FLOATS, Program, kind_of

TARGET = "jaxdyn_kernel"
SLOTS = 1 << 16
# A chunk of a batch takes some 20 microseconds: 40 000 vector operations at 2 a nanosecond. That is long against the time to
# claim a chunk (0.1 us), and short against the wait for the last thread.
OPERATIONS_PER_CHUNK = 40_000
_MISSING = "jaxdyn: this program was compiled by another process, which had its kernel; trace it again here"
_FAILED = "jaxdyn: a kernel could not be compiled; the error was logged"
_MISFIT = "jaxdyn: a buffer of a kernel has another size than the kernel was written for"
# What a waiting thread tells each kind of processor: pause, and yield.
_RELAX = {"x86_64": "void @llvm.x86.sse2.pause()", "aarch64": "void @llvm.aarch64.hint(i32 1)"}


logger = logging.getLogger("jaxdyn")


class _Entry(ctypes.Structure):
    _fields_ = (
        ("hash", ctypes.c_uint64),
        ("kernel", ctypes.c_uint64),
        ("chunk", ctypes.c_int64),
        ("least", ctypes.c_int64),
        ("buffers", ctypes.c_int64),
        ("sizes", ctypes.c_uint64),
    )


# The handler finds a kernel by open addressing in this table, without a lock: an entry's hash is written last.
_table = (_Entry * SLOTS)()
_threads = ctypes.c_int64(1 << 30)
_failures = ctypes.c_int64(0)  # kernels that could not be compiled when they were called
_lock = threading.RLock()
# LLVM takes one program at a time, and two threads may call the same new kernel.
_making = threading.Lock()
_called: dict[str, Code] = {}  # subprograms, which other kernels call too
_kernels: dict[int, "_Kernel"] = {}  # by number, for as long as the process may call them
_handler: list[Code] = []


def set_threads(count: int | None) -> None:
    """Use at most `count` threads in a kernel; None for as many as XLA has."""
    _threads.value = 1 << 30 if count is None else count


@functools.cache
def register() -> None:
    """Compile the handler and tell XLA of it, once in a process. **Raises:** `Unsupported`."""
    version = ffi_version()
    architecture = _architecture()
    if architecture not in _RELAX:
        raise Unsupported(f"the processor is {architecture}, and kernels are written for {', '.join(_RELAX)}")
    text = resources.files("jaxdyn.compile").joinpath("handler.ll").read_text()
    messages = {"MISSING": _MISSING, "FAILED": _FAILED, "MISFIT": _MISFIT}
    fields = {
        "TABLE": ctypes.addressof(_table), "SLOT_MASK": SLOTS - 1, "LIMIT": ctypes.addressof(_threads),
        "FAILURES": ctypes.addressof(_failures), "PREPARE": ctypes.cast(_PREPARE, ctypes.c_void_p).value,
        "MAJOR": version[0], "MINOR": version[1],
        "RELAX": _RELAX[architecture], "RELAX_TYPE": _RELAX[architecture].replace("i32 1", "i32"),
        **messages, **{f"{name}_BYTES": len(message) + 1 for name, message in messages.items()},
    }  # fmt: skip
    for name, value in fields.items():
        text = text.replace("{" + name + "}", str(value))
    # Its addresses are those of this process: it is not kept on disk.
    code = Code(text, stored=False)
    register_handler(TARGET, code.address("handler"))
    code.publish("careful", CAREFUL)
    _handler.append(code)


@functools.cache
def is_available() -> bool:
    """Decide whether kernels can be called on this machine; if not, lowering one gives the warning."""
    try:
        register()
    except Unsupported:
        return False
    return True


def _architecture() -> str:
    import llvmlite.binding as llvm

    return llvm.get_process_triple().split("-")[0].replace("arm64", "aarch64")


@functools.cache
def vector_bytes() -> int:
    """Bytes of the processor's vector registers."""
    has = features()
    return 64 if "+avx512f" in has else 32 if "+avx," in has + "," else 16


def width_of(program, samples: int | None) -> int:
    """Samples that a kernel computes in one vector: one for a single sample, else as many as a register holds."""
    program = getattr(program, "turn", program)  # the width of a loop is that of its iterations
    # Samples of a `MatrixProgram` take different paths: a vector would go on until the last one has converged.
    if samples == 1 or not isinstance(program, Program):
        return 1
    # Twice as many samples in float32, but only where no float64 is passed: vectors of both would have different lengths.
    kinds = {kind_of(array.dtype) for array in (*program.inputs, *program.outputs)} & set(FLOATS)
    return vector_bytes() // (4 if kinds == {"f4"} else 8)


def kernel(program, width: int, uniform: Sequence[bool]) -> int:
    """The number by which the handler finds the kernel of a program, which is compiled when it is called for the first time."""
    uniform = tuple(uniform)
    key = ("kernel", width, uniform)
    with _lock:
        register()
        if key not in program.derived:
            number = number_of(program, width, uniform)
            if number not in _kernels:
                _kernels[number] = _Kernel(number, program, width, uniform)
            program.derived[key] = number
        return program.derived[key]


class _Kernel:
    """A kernel of the table; its program until there is code."""

    def __init__(self, number: int, program, width: int, uniform: tuple[bool, ...]):
        # Half-full at most: searches stay short, and one that fails ends at an empty slot.
        if len(_kernels) > SLOTS // 2:
            raise Unsupported(f"more than {SLOTS // 2} kernels in one process")
        self.program: Any = program
        self.width, self.uniform = width, uniform
        self.code: Code | None = None
        self.is_awaited = False  # whether a worker is to compile it (see `ahead`)
        order = varying_first(uniform)
        # The handler checks buffers against these; a negative size is one row for all samples.
        sizes = [-1 - program.inputs[i].size if uniform[i] else program.inputs[i].size for i in order]
        sizes += [array.size for array in program.outputs]
        self.sizes = (ctypes.c_int64 * len(sizes))(*sizes)
        slot = number % SLOTS
        while _table[slot].hash:
            slot = (slot + 1) % SLOTS
        self.entry = _table[slot]
        chunk = width * max(1, round(OPERATIONS_PER_CHUNK / max(1, program.turns * program.cost)))
        self.entry.kernel, self.entry.chunk, self.entry.least = 0, chunk, 2 * chunk
        self.entry.buffers, self.entry.sizes = len(sizes), ctypes.addressof(self.sizes)
        self.entry.hash = number  # last: from here on it is found

    def address(self) -> int:
        """Address of the code, which is compiled where there is none."""
        program = self.program
        if self.code is None and program is not None:
            # Before the lock is taken: another thread traces, and may call kernels that are new too.
            program = program.program() if isinstance(program, Careful) else program
            with _making:
                if self.code is None:
                    self._make(program)
        return self.entry.kernel

    def _make(self, program) -> None:
        width = self.width
        is_program = isinstance(program, Program)
        is_call = is_program and calls_itself(program, width)
        for called in (program.fast or program, *program.subprograms) if is_call else program.subprograms:
            _publish(called, width)
        text = kernel_ir(program, width, self.uniform) if is_program else program.ir(width, self.uniform)
        code = Code(text, name=program.name)
        self.entry.kernel = code.address("kernel")
        self.code, self.program = code, None  # a program of a large robot takes megabytes


def make_ahead(number: int) -> None:
    """Let another thread make the code of a kernel that is going to be called soon."""
    made = _kernels[number]
    if made.code is None and not made.is_awaited:
        made.is_awaited = True
        ahead.make_later(made.address)


def publish_ahead(program, width: int) -> None:
    """Let another thread make the subprograms of a loop, whichever of its operands all samples share."""
    key = ("ahead", width)
    if key not in program.derived:
        program.derived[key] = True

        def make() -> None:
            for called in program.subprograms:
                with _making:
                    _publish(called, width)

        ahead.make_later(make)


def _publish(called, width: int) -> None:
    """Compile a subprogram where that has not been done, or enter it in the table where it is made later."""
    if isinstance(called, Careful):
        kernel(called, 1, [False] * len(called.inputs))
        return
    symbol = symbol_of(called, width)
    if symbol not in _called:
        for inner in called.subprograms:
            _publish(inner, width)
        text = subprogram_ir(called, width) if isinstance(called, Program) else called.subprogram_ir()
        _called[symbol] = Code(text, name=called.name)
        _called[symbol].publish("called", symbol)


def _prepare(number: int) -> int:
    """Compile a kernel that is called for the first time; its address, or zero where that fails. The handler calls this."""
    try:
        return _kernels[number].address()
    except BaseException:  # an interruption too: no Python is above this call, to which it could be raised
        logger.exception("jaxdyn: a kernel could not be compiled")
        with _lock:
            _failures.value += 1
        return 0


_PREPARE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint64)(_prepare)


def call(program, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The results of a program for one sample, by its kernel and without XLA; `arrays` as its inputs."""
    # One thread and one sample: the handler, which shares a batch among XLA's threads, is not needed.
    number = kernel(program, 1, [False] * len(program.inputs))
    given = [np.ascontiguousarray(x, array.dtype) for x, array in zip(arrays, program.inputs, strict=True)]
    results = [np.empty(array.shape, array.dtype) for array in program.outputs]
    data = (ctypes.c_void_p * (len(given) + len(results)))(*(x.ctypes.data for x in (*given, *results)))
    address, failures = _kernels[number].address(), _failures.value
    _KERNEL(address)(data, 1, 0, 1)
    if _failures.value != failures:
        raise RuntimeError(_FAILED)
    return results


_KERNEL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
