"""Native kernels on CUDA devices: their table, the handler through which XLA calls them, and modules, loaded once on each device.

A module is the text of the CPU's kernel as PTX, one thread a sample (`ptx`, `functions`).
"""

import ctypes
import ctypes.util
import functools
import logging
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import resources

from jaxdyn.compile.careful import number_of
from jaxdyn.compile.gpu.ptx import (
    ARCHITECTURES,
    KERNEL,
    MAX_THREADS,
    MIN_DRIVER,
    architecture_for,
    is_interleaved,
    module_ir,
    ptx_of,
)
from jaxdyn.compile.gpu.ptx import TooLarge as TooLarge
from jaxdyn.compile.jax_adapter import Unsupported, ffi_version, register_handler
from jaxdyn.compile.stored import Code, compile_text
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
        self.entry.minimum = 32 * MIN_WARPS * multiprocessors
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


# --- cUDA's driver, which comes with the graphics driver: found and called at run time, so that no toolkit is needed ---


_HANDLE, _INT = ctypes.c_void_p, ctypes.c_int
_OUT = ctypes.POINTER(_HANDLE)
_OUT_INT = ctypes.POINTER(_INT)
# Arguments of the functions that are called, as cuda.h names them; each returns a code.
_FUNCTIONS = {
    "cuInit": (ctypes.c_uint,),
    "cuDriverGetVersion": (_OUT_INT,),
    "cuDeviceGetCount": (_OUT_INT,),
    "cuDeviceGet": (_OUT_INT, _INT),
    "cuDeviceGetAttribute": (_OUT_INT, _INT, _INT),
    "cuStreamGetCtx": (_HANDLE, _OUT),
    "cuCtxPushCurrent_v2": (_HANDLE,),
    "cuCtxPopCurrent_v2": (_OUT,),
    "cuCtxGetDevice": (_OUT_INT,),
    "cuModuleLoadDataEx": (_OUT, ctypes.c_char_p, ctypes.c_uint, _HANDLE, _HANDLE),
    "cuModuleGetFunction": (_OUT, _HANDLE, ctypes.c_char_p),
    "cuFuncGetAttribute": (_OUT_INT, _INT, _HANDLE),
    "cuLaunchKernel": (_HANDLE, *[ctypes.c_uint] * 7, _HANDLE, _HANDLE, _HANDLE),
    "cuGetErrorName": (_INT, ctypes.POINTER(ctypes.c_char_p)),
}
_MULTIPROCESSORS, _MAJOR, _MINOR = 16, 75, 76  # CU_DEVICE_ATTRIBUTE_...
_REGISTERS = 4  # CU_FUNC_ATTRIBUTE_NUM_REGS
_ERROR_LOG, _ERROR_LOG_BYTES = 5, 6  # CU_JIT_ERROR_LOG_BUFFER and its size


class DriverError(Exception):
    """A function of the driver that has failed, and CUDA's name of the error."""


def open_library() -> ctypes.CDLL:
    """The driver's library. **Raises:** `Unsupported` where there is none."""
    names = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so.1", "libcuda.so")
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise Unsupported(f"CUDA's driver is not installed ({names[0]})")


class Driver:
    """The driver's functions, which raise `DriverError`. **Raises:** `Unsupported` for a driver that is too old."""

    def __init__(self, library: ctypes.CDLL):
        self._library = library
        for name, arguments in _FUNCTIONS.items():
            function = getattr(library, name, None)
            if function is None:
                raise Unsupported(f"CUDA's driver has no function {name}")
            function.argtypes, function.restype = arguments, _INT
        self.call("cuInit", 0)
        version = self._ask("cuDriverGetVersion")
        if version < MIN_DRIVER:
            raise Unsupported(
                f"CUDA's driver is of version {_write_version(version)}, and kernels need {_write_version(MIN_DRIVER)} or newer"
            )
        capabilities = []
        for device in (self._ask("cuDeviceGet", i) for i in range(self._ask("cuDeviceGetCount"))):
            major, minor = (self._ask("cuDeviceGetAttribute", which, device) for which in (_MAJOR, _MINOR))
            capabilities.append(10 * major + minor)
        if not capabilities:
            raise Unsupported("CUDA's driver sees no device")
        # One text for all devices: PTX of an older architecture runs on a newer one.
        architecture = architecture_for(min(capabilities))
        if architecture is None:
            raise Unsupported(
                f"a GPU has compute capability {min(capabilities) / 10}, and kernels need {ARCHITECTURES[0] / 10} or more"
            )
        self.architecture = architecture
        self.launch = ctypes.cast(library.cuLaunchKernel, _HANDLE).value

    def call(self, name: str, *args) -> None:
        """Call a function. **Raises:** `DriverError`."""
        code = getattr(self._library, name)(*args)
        if code:
            raise DriverError(self.explain(name, code))

    def explain(self, name: str, code: int) -> str:
        """Text of the error of a function."""
        text = ctypes.c_char_p()
        known = self._library.cuGetErrorName(code, ctypes.byref(text)) == 0 and text.value
        return f"jaxdyn: {name} of CUDA's driver failed with {text.value.decode() if known and text.value else code}"

    def _ask(self, name: str, *args) -> int:
        result = _INT()
        self.call(name, ctypes.byref(result), *args)
        return result.value

    @contextmanager
    def _context_of(self, stream: int | None) -> Iterator[None]:
        context = _HANDLE()
        self.call("cuStreamGetCtx", stream, ctypes.byref(context))
        self.call("cuCtxPushCurrent_v2", context)
        try:
            yield
        finally:
            self.call("cuCtxPopCurrent_v2", ctypes.byref(context))

    def load(self, ptx: str, name: str, stream: int | None) -> tuple[int, int, int]:
        """Load a module on the device of a stream: the handle of its function, its registers, the device's multiprocessors."""
        log = ctypes.create_string_buffer(4096)
        options = (_INT * 2)(_ERROR_LOG, _ERROR_LOG_BYTES)
        values = (_HANDLE * 2)(ctypes.addressof(log), len(log))
        module, function = _HANDLE(), _HANDLE()
        with self._context_of(stream):
            try:
                self.call("cuModuleLoadDataEx", ctypes.byref(module), ptx.encode(), 2, options, values)
            except DriverError as error:
                said = log.value.decode(errors="replace").strip()
                raise DriverError(f"{error}{': ' if said else ''}{said}") from None
            self.call("cuModuleGetFunction", ctypes.byref(function), module, name.encode())
            registers = self._ask("cuFuncGetAttribute", _REGISTERS, function)
            multiprocessors = self._ask("cuDeviceGetAttribute", _MULTIPROCESSORS, self._ask("cuCtxGetDevice"))
        assert function.value is not None
        return function.value, registers, multiprocessors


def _write_version(version: int) -> str:
    return f"{version // 1000}.{version % 1000 // 10}"


@functools.cache
def driver() -> Driver:
    """The driver of this process. **Raises:** `Unsupported`."""
    try:
        return Driver(open_library())
    except DriverError as error:
        raise Unsupported(str(error).removeprefix("jaxdyn: ")) from None
