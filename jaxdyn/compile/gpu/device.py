"""Kernels on CUDA devices: their table, the handler through which XLA calls them, and modules, loaded once on each device."""

import ctypes
import functools
import logging
import threading
from collections.abc import Sequence
from importlib import resources

from jaxdyn.compile.careful_text import number_of
from jaxdyn.compile.gpu.driver import DriverError, driver
from jaxdyn.compile.gpu.ptx import KERNEL, MAX_THREADS, is_interleaved, module_ir, ptx_of
from jaxdyn.compile.gpu.ptx import TooLarge as TooLarge
from jaxdyn.compile.jax_adapter import ffi_version, register_handler
from jaxdyn.compile.objects import Code, compile_text
from jaxdyn.compile.target import SLOTS, Entry, Row, fill_handler, free_entry

TARGET = "jaxdyn_cuda_kernel"
MAX_DEVICES = 64
# A block of more threads would leave registers of a multiprocessor unused, which has 65536.
MANY_REGISTERS = 128
MIN_WARPS = 4  # on each multiprocessor, which has as many schedulers
_DEVICE = f"jaxdyn: kernels know {MAX_DEVICES} devices of a process"

logger = logging.getLogger("jaxdyn")
_lock = threading.RLock()
# Of modules alone: who makes a kernel may wait for results of XLA's thread, which waits here.
_loading = threading.Lock()
_kernels: dict[int, "_Kernel"] = {}
_messages: dict[str, ctypes.Array] = {}  # which XLA copies, so that one of each text is kept


class _Kernel:
    def __init__(self, table, number: int, ptx: str, row: Row):
        self.ptx, self.name = ptx, row.name
        self.functions = (ctypes.c_uint64 * MAX_DEVICES)()
        self.sizes = (ctypes.c_int64 * len(row.sizes))(*row.sizes)
        self.entry = free_entry(table, number)
        self.entry.kernel, self.entry.chunk = ctypes.addressof(self.functions), MAX_THREADS
        self.entry.buffers, self.entry.sizes = len(row.sizes), ctypes.addressof(self.sizes)
        self.entry.hash = number  # last: from here on it is found

    def load(self, device: int, stream: int | None) -> None:
        """Load the module on a device."""
        function, registers, multiprocessors = driver().load(self.ptx, KERNEL, stream)
        self.entry.chunk = MAX_THREADS if registers <= MANY_REGISTERS else MAX_THREADS // 2
        # Small batches are spread over all multiprocessors.
        self.entry.least = 32 * MIN_WARPS * multiprocessors
        self.functions[device] = function


def kernel(program, uniform: Sequence[bool]) -> int:
    """The number by which the handler finds the kernel of a program. **Raises:** `Unsupported`, or `TooLarge`."""
    uniform = tuple(uniform)
    with _lock:
        table, number = register(), number_of(program, 1, uniform)
        if number not in _kernels:
            # Now, not when XLA calls it: Python may then wait for the device, and XLA's thread for Python.
            ptx = ptx_of(module_ir(program, uniform), driver().architecture)
            _kernels[number] = _Kernel(table, number, ptx, Row.of(program, 1, uniform))
        return number


def layouts(program, uniform: Sequence[bool], shapes: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """For each operand and result its axes from the one whose neighbours stand side by side in memory to the slowest one."""
    same = [*uniform, *[False] * len(program.outputs)]
    found = []
    for shape, array, is_same in zip(shapes, (*program.inputs, *program.outputs), same, strict=True):
        axes = range(len(shape))
        last = (*reversed(axes[:-1]), axes[-1]) if is_interleaved(array, is_same) else tuple(reversed(axes))
        found.append(last)
    return found


@functools.cache
def register() -> ctypes.Array:
    """Compile the handler and tell XLA of it: the table of kernels. **Raises:** `Unsupported`."""
    ffi_version(for_gpus=True)
    table = (Entry * SLOTS)()
    text = resources.files("jaxdyn.compile.gpu").joinpath("handler.ll").read_text()
    fields = {
        "LOAD": ctypes.cast(_LOAD, ctypes.c_void_p).value, "EXPLAIN": ctypes.cast(_EXPLAIN, ctypes.c_void_p).value,
        "LAUNCH": driver().launch, "DEVICES": MAX_DEVICES, "DEVICE": _DEVICE, "DEVICE_BYTES": len(_DEVICE) + 1,
    }  # fmt: skip
    for name, value in fields.items():
        text = text.replace("{" + name + "}", str(value))
    code = Code(compile_text(fill_handler("jaxdyn_cuda_table", table) + text))
    register_handler(TARGET, code.address("cuda_handler"), "CUDA")
    _codes.append(code)
    return table


_codes: list[Code] = []  # for as long as the process lives


def _keep(message: str) -> int:
    return ctypes.addressof(_messages.setdefault(message, ctypes.create_string_buffer(message.encode())))


def _load(number: int, device: int, stream: int | None) -> int:
    """Load a kernel that is called on a device for the first time; a message where that fails. The handler calls this."""
    try:
        with _loading:
            if not _kernels[number].functions[device]:
                _kernels[number].load(device, stream)
        return 0
    except DriverError as error:
        return _keep(str(error))
    except BaseException as error:  # no Python is above this call, to which it could be raised
        logger.exception("jaxdyn: a kernel could not be loaded")
        return _keep(f"jaxdyn: a kernel could not be loaded: {error}")


def _explain(code: int) -> int:
    return _keep(driver().explain("cuLaunchKernel", code))


_LOAD = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int64, ctypes.c_void_p)(_load)
_EXPLAIN = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(_explain)
