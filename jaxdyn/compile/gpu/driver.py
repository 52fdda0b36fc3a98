"""CUDA's driver, which comes with the graphics driver: found and called at run time, so that no toolkit is needed."""

import ctypes
import ctypes.util
import functools
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from jaxdyn.compile.gpu.ptx import ARCHITECTURES, MIN_DRIVER, architecture_for
from jaxdyn.compile.jax_adapter import Unsupported

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
        capabilities = [self._capability(self._ask("cuDeviceGet", i)) for i in range(self._ask("cuDeviceGetCount"))]
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

    def _capability(self, device: int) -> int:
        major, minor = (self._ask("cuDeviceGetAttribute", which, device) for which in (_MAJOR, _MINOR))
        return 10 * major + minor

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
