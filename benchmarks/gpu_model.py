"""Times of native kernels on an H100 as a model of it has them: nothing is measured, and no GPU is needed.

    python -m benchmarks.gpu_model [--batches 4096 65536] [--robots panda four-bar quadruped g1] [--steps 100]

A launch takes 2.5 us. Beside it a kernel takes the largest of three times:

- of its instructions, one for each operation of its program (ptxas makes 8238 of the 8384 operations of a G1's dynamics): a
  scheduler issues one in a cycle, and one warp alone one in 1.7 cycles, the mean stall in the code of the same kernel;
- of its arguments and results;
- of its spills, by ptxas (the columns are empty without it), at the rate of the L2 cache where the stacks of all threads that
  run at a time fit into it, else at that of the memory.

Steps of adaptive motions are counted on this CPU. A warp takes as many as its longest sample: "lanes" is the share of the steps
that are no waiting, for samples in this order, then shuffled. All constants are below. What is left out: branches that some
samples take, other loads of the stack, the dispatch of JAX, and XLA's loops around the projections of a start and of saved rows.
Spills are those of the whole kernel, those of rare branches among them.
"""

import argparse
import functools
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

if __name__ == "__main__":
    os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import numpy as np

import jaxdyn as jd
from benchmarks import gpu
from jaxdyn.compile.gpu import ptx

# An H100 SXM: NVIDIA's data sheet, but for assumptions: a launch, the clock under load, and the rates of memory and L2 cache.
LAUNCH, CLOCK, MULTIPROCESSORS, SCHEDULERS, WARP = 2.5e-6, 1.7e9, 132, 4 * 132, 32
MEMORY, CACHE, CACHE_BYTES = 3.0e12, 5.5e12, 50e6
CYCLES_OF_A_WARP = 1.7
REGISTERS = 65536  # of a multiprocessor


@functools.cache
def assembled(program, uniform: tuple[bool, ...]) -> SimpleNamespace | None:
    """Registers, stack and spills (bytes) of a kernel; None without ptxas."""
    tool = shutil.which("ptxas")
    if tool is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.ptx"
        path.write_text(ptx.ptx_of(ptx.module_ir(program, uniform), 90))
        done = subprocess.run(
            [tool, "-v", "-arch=sm_90", str(path), "-o", str(path.with_suffix(".cubin"))],
            capture_output=True,
            text=True,
        )
    found = re.search(
        rf"properties for {ptx.KERNEL}\n\s+(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads\n"
        r".*Used (\d+) registers",
        done.stderr,
    )
    assert found is not None, done.stderr
    stack, stores, loads, registers = map(int, found.groups())
    return SimpleNamespace(registers=registers, stack=stack, spills=stores + loads)


def waiting(steps: np.ndarray) -> float:
    """The steps of all lanes, those that wait among them, over the steps of the samples."""
    return steps.reshape(-1, WARP).max(1).sum() * WARP / steps.sum()


def time_of(program, samples: int, turns: float, assembler) -> float:
    """Seconds of a kernel without its launch."""
    warps = -(-samples // WARP)
    issued = program.cost * turns * max(CYCLES_OF_A_WARP, warps / SCHEDULERS) / CLOCK
    moved = samples * sum(x.size * x.dtype.itemsize for x in (*program.inputs, *program.outputs)) / MEMORY
    spilled = 0.0
    if assembler is not None:
        at_once = min(samples, MULTIPROCESSORS * REGISTERS // assembler.registers)
        rate = CACHE if at_once * assembler.stack < CACHE_BYTES else MEMORY
        spilled = samples * turns * assembler.spills / rate
    return max(issued, moved, spilled)


def rows(name: str, batch: int, steps: int):
    """Modelled figures of all functions of a robot or a mechanism: label, us, registers, spills, note."""
    for label, (function, sizes) in gpu.functions(name, steps).items():
        args, note, factor = gpu.arguments(name, sizes, batch), "", steps
        if label.startswith("adaptive"):
            counted = counted_steps(name, args)
            shuffled = np.random.default_rng(0).permutation(counted)
            factor = counted.mean() * waiting(counted)
            note = f"{counted.mean():.1f} steps, lanes {1 / waiting(counted):.2f}, {1 / waiting(shuffled):.2f}"
        took, largest = 0.0, (0, None)
        for program, samples, uniform in gpu.kernel_calls(jax.vmap(function), args):
            of_kernel = assembled(program, tuple(uniform))
            took += LAUNCH + time_of(program, samples, factor if program.turns > 1 else 1, of_kernel)
            largest = max(largest, (program.cost, of_kernel), key=lambda x: x[0])
        yield label, took, largest[1], note


def counted_steps(name: str, args) -> np.ndarray:
    """Steps of each sample of an adaptive motion, by this CPU."""
    scene = gpu.mechanism(name)[0]
    ts = np.linspace(0.0, 1.0 if name == "four-bar" else 0.5, 2, dtype=np.float32)
    count = jax.jit(jax.vmap(lambda q, v: jd.simulate(scene, q, v, ts, throw=False).stats["num_steps"]))
    return np.asarray(count(*args))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, nargs="+", default=[4096, 65536])
    parser.add_argument("--robots", nargs="+", default=["panda", *gpu.MECHANISMS, "g1"])
    parser.add_argument("--steps", type=int, default=100, help="of a rollout")
    options = parser.parse_args()
    print("| robot | function | batch | modelled us | samples a second | registers | spills, bytes | |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.robots:
        for batch in options.batches:
            for label, took, of_kernel, note in rows(name, batch, options.steps):
                sizes = ["-", "-"] if of_kernel is None else [of_kernel.registers, of_kernel.spills]
                row = [name, label, batch, f"{1e6 * took:.3g}", f"{batch / took:.2g}", *sizes, note]
                print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
