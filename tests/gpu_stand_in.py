"""Kernels for GPUs on the CPU: their text for the host, run thread by thread, and the programs that functions call."""

import ctypes
import math

import jax
import numpy as np

from jaxdyn.compile import objects, primitive
from jaxdyn.compile.code import varying_first
from jaxdyn.compile.gpu import text

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
        self.code = objects.Code(objects.compile_text(host_text(module)))
        self.address = self.code.address(text.KERNEL)
        self.sample = ctypes.c_int64.from_address(self.code.engine.get_global_value_address("jaxdyn_sample"))

    def run(self, pointers, samples: int, threads: int) -> None:
        """Run so many threads, one after the other."""
        call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(pointers), ctypes.c_int64)(self.address)
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
        return np.ascontiguousarray(flat.T if text.is_aside(array, same) else flat)

    given = [placed(x, array, same) for x, array, same in zip(args, program.inputs, uniform, strict=True)]
    results = [placed(np.zeros((samples, x.size), x.dtype), x, False) for x in program.outputs]
    kernel = HostKernel(text.module_ir(program, uniform))
    pointers = [given[i].ctypes.data for i in varying_first(uniform)] + [x.ctypes.data for x in results]
    kernel.run(pointers, samples, samples + 3)  # threads beyond the last sample do nothing
    return [
        (x.T if text.is_aside(array, False) else x).reshape(*lead, array.size)
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
