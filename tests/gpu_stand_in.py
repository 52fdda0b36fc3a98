"""Kernels for GPUs on the CPU: their text for the host, run thread by thread; a driver that does so; calls of kernels."""

import ctypes
import functools
import math
import threading
from types import SimpleNamespace

import jax
import numpy as np

from jaxdyn.compile import gpu as device
from jaxdyn.compile import primitive, stored
from jaxdyn.compile.code import varying_first
from jaxdyn.compile.gpu import ptx

HOST_SAMPLE = """@jaxdyn_sample = thread_local global i64 0
define internal i64 @sample() {
  %sample = load i64, ptr @jaxdyn_sample
  ret i64 %sample
}"""


def host_text(module: str) -> str:
    """The module for this processor: the number of a thread is in memory, not in a register."""
    return f"{module.replace('define ptx_kernel void', 'define void')}\n{HOST_SAMPLE.replace('thread_local ', '')}"


class HostKernel:
    """A kernel for GPUs as machine code of this processor."""

    def __init__(self, module: str):
        self.code = stored.Code(stored.compile_text(host_text(module)))
        self.address = self.code.address(ptx.KERNEL)
        self.arrays = module.partition(f"@{ptx.KERNEL}(")[2].partition(")")[0].count("ptr ")
        self.sample = ctypes.c_int64.from_address(self.code.engine.get_global_value_address("jaxdyn_sample"))
        self.lock = threading.Lock()  # the number of a thread of the GPU is one for all threads that launch

    def run(self, pointers, samples: int, threads: int) -> None:
        """Run so many threads, one after the other."""
        call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(pointers), ctypes.c_int64)(self.address)
        with self.lock:
            for thread in range(threads):
                self.sample.value = thread
                call(*pointers, samples)


def uniform_of(args) -> list[bool]:
    """Which operands of a call all samples share."""
    return [x.ndim == 1 and any(y.ndim > 1 for y in args) for x in args]


def run_threads(program, args) -> list[np.ndarray]:
    """The results (..., size) of a program for operands (..., size), by its kernel for GPUs."""
    args = [np.asarray(x) for x in args]
    uniform = uniform_of(args)
    lead = max((x.shape[:-1] for x in args), key=len)
    samples = math.prod(lead)

    def placed(x, array, same):
        flat = x.reshape(array.size) if same else x.reshape(samples, array.size)
        return np.ascontiguousarray(flat.T if ptx.is_interleaved(array, same) else flat)

    given = [placed(x, array, same) for x, array, same in zip(args, program.inputs, uniform, strict=True)]
    results = [placed(np.zeros((samples, x.size), x.dtype), x, False) for x in program.outputs]
    kernel = HostKernel(ptx.module_ir(program, uniform))
    pointers = [given[i].ctypes.data for i in varying_first(uniform)] + [x.ctypes.data for x in results]
    kernel.run(pointers, samples, samples + 3)  # threads beyond the last sample do nothing
    return [
        (x.T if ptx.is_interleaved(array, False) else x).reshape(*lead, array.size)
        for x, array in zip(results, program.outputs, strict=True)
    ]


def recorded_calls(function, *args) -> list[tuple]:
    """The calls of kernels, (program, operands, results), that a function makes."""
    calls, usual = [], primitive._jit_kernel

    def recorder(program, rows):
        def call(*operands):
            results = usual(program, rows)(*operands)
            calls.append((program, operands, results))
            return results

        return call

    primitive._jit_kernel = recorder
    try:
        with jax.disable_jit():
            function(*args)
    finally:
        primitive._jit_kernel = usual
    return calls


# --- a driver that is none ---

DEVICES, SUCCESS, OUT_OF_MEMORY, INVALID_PTX = 2, 0, 2, 218
_P, _I = ctypes.c_void_p, ctypes.c_int


class StandInDriver:
    """The driver's functions as far as kernels call them: modules are loaded for the host, launches recorded and carried out.

    `launches`: (function's handle, blocks, threads, stream). `fails`: the name of the function that returns an error.
    `refusal`: what the assembler says of a text that it does not take.
    Streams are numbers from 1001 on by device, and a hundred more for each other one of it; contexts from 2001 on.
    """

    def __init__(self, capability=(9, 0), version=12040, devices=DEVICES):
        self.capability, self.version, self.devices = capability, version, devices
        self.launches, self.loaded, self.contexts, self.kernels = [], [], [], {}
        self.fails, self.refusal, self.registers = None, None, 80
        for name, arguments in device._FUNCTIONS.items():
            function = functools.partial(self._run, name, getattr(self, f"_{name}"))
            setattr(self, name, ctypes.CFUNCTYPE(_I, *[_kind(x) for x in arguments])(function))

    def _run(self, name, function, *args):
        if self.fails == name:
            return OUT_OF_MEMORY
        result = function(*args)
        return SUCCESS if result is None else result

    def _cuInit(self, flags): ...

    def _cuDriverGetVersion(self, at):
        _I.from_address(at).value = self.version

    def _cuDeviceGetCount(self, at):
        _I.from_address(at).value = self.devices

    def _cuDeviceGet(self, at, device):
        _I.from_address(at).value = device

    def _cuDeviceGetAttribute(self, at, which, device):
        assert 0 <= device < self.devices
        _I.from_address(at).value = {75: self.capability[0], 76: self.capability[1], 16: 10}[which]

    def _cuStreamGetCtx(self, stream, at):
        _P.from_address(at).value = 2000 + (stream - 1000) % 100

    def _cuCtxPushCurrent_v2(self, context):
        self.contexts.append(context)

    def _cuCtxPopCurrent_v2(self, at):
        _P.from_address(at).value = self.contexts.pop()

    def _cuCtxGetDevice(self, at):
        _I.from_address(at).value = self.contexts[-1] - 2001

    def _cuModuleLoadDataEx(self, at, image, count, options, values):
        assert count == 2 and list((_I * 2).from_address(options)) == [5, 6]
        log, size = (_P * 2).from_address(values)
        if self.refusal is not None:
            ctypes.memmove(log, self.refusal, min(size, len(self.refusal)))
            return INVALID_PTX
        self.loaded.append(self.contexts[-1])
        handle = 10 + len(self.kernels)
        self.kernels[handle] = HostKernel(image.decode())
        _P.from_address(at).value = handle

    def _cuModuleGetFunction(self, at, module, name):
        assert name == ptx.KERNEL.encode()
        _P.from_address(at).value = module

    def _cuFuncGetAttribute(self, at, which, function):
        assert which == 4
        _I.from_address(at).value = self.registers

    def _cuLaunchKernel(self, function, x, y, z, threads, ty, tz, shared, stream, parameters, extra):
        assert (y, z, ty, tz, shared, extra) == (1, 1, 1, 1, 0, None)
        self.launches.append((function, x, threads, stream))
        kernel = self.kernels[function]
        addresses = list((_P * (kernel.arrays + 1)).from_address(parameters))
        samples = ctypes.c_int64.from_address(addresses.pop()).value
        kernel.run([_P.from_address(x).value for x in addresses], samples, x * threads)

    def _cuGetErrorName(self, code, at):
        _P.from_address(at).value = ctypes.cast(_NAME, _P).value


_NAME = ctypes.c_char_p(b"CUDA_ERROR_OUT_OF_MEMORY")


def _kind(argument):
    """Pointers to results are addresses here."""
    return argument if argument is ctypes.c_char_p or not hasattr(argument, "contents") else _P


# What XLA says when a handler asks: the stream of a device, 0 or more; the number of the device, or None for the CPU's own; and
# which of the two functions fails.
XLA = SimpleNamespace(stream=0, device=None, fails=None)
# Offsets of functions in XLA's table of them.
_ERROR, _STREAM, _DEVICE = 48, 80, 184
_FUNCTION = ctypes.CFUNCTYPE(_P, _P)
_of_cpu, _kept = {}, []


def _fail():
    """An error of XLA's."""
    message = ctypes.create_string_buffer(b"XLA has no answer")
    return _of_cpu[_ERROR](ctypes.addressof((ctypes.c_int64 * 4)(28, 0, ctypes.addressof(message), 13)))


@_FUNCTION
def _device_get(args):
    if XLA.fails == "device":
        return _fail()
    error = _of_cpu[_DEVICE](args)
    if XLA.device is not None:
        _I.from_address(args + 24).value = XLA.device
    return error


@_FUNCTION
def _stream_get(args):
    if XLA.fails == "stream":
        return _fail()
    asked = (ctypes.c_int64 * 4)(28, 0, _P.from_address(args + 16).value, 0)
    _of_cpu[_DEVICE](ctypes.addressof(asked))
    _P.from_address(args + 24).value = 1001 + (asked[3] & 0xFFFFFFFF) + 100 * XLA.stream
    return None


def on_cpu(address: int) -> int | None:
    """A handler for XLA's CPUs that calls one for GPUs, with a stream, which XLA has not on a CPU."""

    @_FUNCTION
    def handler(frame):
        if _P.from_address(frame + 8).value:  # XLA asks for the version
            return _FUNCTION(address)(frame)
        api, own_api = _copy(_P.from_address(frame + 16).value)
        for offset, function in ((_ERROR, None), (_STREAM, _stream_get), (_DEVICE, _device_get)):
            _of_cpu[offset] = _FUNCTION(_P.from_address(api + offset).value)
            if function is not None:
                _P.from_address(ctypes.addressof(own_api) + offset).value = ctypes.cast(function, _P).value
        _, own = _copy(frame)
        _P.from_address(ctypes.addressof(own) + 16).value = ctypes.addressof(own_api)
        return _FUNCTION(address)(ctypes.addressof(own))

    _kept.append(handler)
    return ctypes.cast(handler, _P).value


def _copy(address):
    """A structure's address, and a copy of the structure, which begins with its size."""
    return address, ctypes.create_string_buffer(ctypes.string_at(address, ctypes.c_int64.from_address(address).value))
