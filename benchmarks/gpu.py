"""Dynamics and rollouts on a GPU, by XLA's own code and by native kernels, with their roofline.

    python -m benchmarks.gpu [--batches 4096 65536] [--robots panda g1] [--steps 100] [--modes auto native]
    python -m benchmarks.gpu --count [--robots panda] [--modes native]

Times are those of the first device of `jax.devices()`: best of some calls, in float32, with the error against the CPU relative to
the largest number. The last lines decide: native kernels are to be the default on GPUs where they are right and faster in every
row. The roofline is the larger of two times: operations over the operations a second that a long chain of multiply-adds reaches
on this device, and bytes over the bytes a second that adding two long arrays reaches, both measured here. Operations are those
of the scalar programs, times the steps of a rollout; bytes are those of the arguments and the results. Adaptive motions have no
roofline, as their steps are not known beforehand, nor has a CPU.

`--count` compiles for an H100 without one, where the CUDA plugin is installed (`pip install jax-cuda12-plugin
jax-cuda12-pjrt nvidia-cuda-nvcc-cu12`, of jax's version), and counts what a call launches: kernels, calls of libraries
(cuSOLVER, cuBLAS), callbacks of the host.
"""

import argparse
import functools
import importlib.util
import math
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple

if "--count" in sys.argv:  # with the platform of the host alone the plugin looks for no driver
    os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd

# What XLA has to know of an H100 SXM to compile for it: NVIDIA's data sheet, and limits of compute capability 9.0.
H100 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152 shared_memory_per_core: 233472
  threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128 block_dim_limit_x: 2147483647 block_dim_limit_y: 65535
  block_dim_limit_z: 65535 memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
  device_memory_size: 84942979072 shared_memory_per_block_optin: 232448 cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 8 patch: 0 }
runtime_version { major: 12 minor: 9 patch: 0 }
"""
# Instructions of a compiled program that launch nothing.
FREE = {"parameter", "constant", "bitcast", "tuple", "get-tuple-element", "after-all", "partition-id", "replica-id"}
MAX_ERROR = 1e-5  # of the largest number, in float32
MAX_COMPILATION = 5.0  # s
LIBRARIES = ("cublas", "cusolver", "cudnn", "cufft")


def robot(name: str):
    """A robot in float32, by name or from a URDF file; "floating:" before the path gives it a floating base."""
    if name == "iiwa":
        return jd.robots.iiwa(dtype=jnp.float32)
    if name.endswith(".urdf"):
        path = name.removeprefix("floating:")
        return jd.load_urdf(path, floating_base=path != name, dtype=jnp.float32)
    from benchmarks.dynamics import load

    return load(name)[0]


def functions(name: str, steps: int) -> dict[str, tuple[Callable, tuple[int, ...]]]:
    """What is measured of a robot, or of "four-bar": functions of one sample, and the lengths of their arguments."""
    if name == "four-bar":
        scene = jd.scenes.four_bar()
        sizes = (scene.nq, scene.nv)
        ts = np.linspace(0.0, 1.0, 2, dtype=np.float32)

        def motion(q, v, **options):
            return jd.simulate(scene, q, v, ts, throw=False, **options).q[-1]

        return {
            "constrained dynamics": (lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration, sizes),
            f"{steps} steps over one second": (functools.partial(motion, stepsize=1.0 / steps), sizes),
            "adaptive steps over one second": (motion, sizes),
        }
    model = robot(name)
    ts = np.linspace(0.0, 1e-3 * steps, 2, dtype=np.float32)

    def rollout(q, v):
        return jd.simulate(model, q, v, ts, stepsize=1e-3, throw=False).q[-1]

    def gradient(q, v, tau):
        return jax.grad(lambda *x: jnp.sum(jd.forward_dynamics(model, *x)), (0, 1, 2))(q, v, tau)

    three = (model.nq, model.nv, model.nv)
    return {
        "forward dynamics": (lambda q, v, tau: jd.forward_dynamics(model, q, v, tau), three),
        "inverse dynamics": (lambda q, v, a: jd.inverse_dynamics(model, q, v, a), three),
        "gradient of forward dynamics": (gradient, three),
        f"RK4 rollout, {steps} steps": (rollout, three[:2]),
    }


# --- counted without a device ---


def why_not() -> str | None:
    """Why nothing can be compiled for a GPU here, or None."""
    missing = [name for name in ("jax_cuda12_plugin", "jax_plugins.xla_cuda12") if not _is_there(name)]
    return f"{', '.join(missing)} is not installed" if missing else None


def _is_there(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def compiled_text(function: Callable, *args) -> str:
    """The program of XLA for an H100 of a function of `jax.ShapeDtypeStruct`s. No device is needed."""
    from jax.experimental import topologies

    topology = topologies.get_topology_desc(platform="cuda", target_config=H100, topology="1x1x1")
    here = jax.NamedSharding(jax.sharding.Mesh(np.array(topology.devices), ("x",)), jax.P())
    return jax.jit(function, in_shardings=here).trace(*args).lower().compile().as_text() or ""


def launches(text: str) -> dict:
    """What a compiled program launches: kernels once, kernels of each turn of its loops, libraries, callbacks of the host."""
    computations: dict[str, list[tuple[str, str]]] = {}
    name = entry = ""
    for line in text.splitlines():
        head = re.match(r"(ENTRY )?%?([\w.\-]+) .*-> .*\{$", line)
        if head and not line.startswith(" "):
            name = head.group(2)
            computations[name] = []
            entry = name if head.group(1) else entry
            continue
        computed = re.match(r"\s+(?:ROOT )?%?[\w.\-]+ = (?:\(.*?\)|\S+) ([\w\-]+)\(", re.sub(r"/\*.*?\*/", "", line))
        if computed and name:
            computations[name].append((computed.group(1), line))

    def walk(name: str) -> Counter:
        count: Counter = Counter()
        for op, line in computations[name]:
            called = re.findall(
                r"(?:body|condition|to_apply|calls|branch_computations)=\{?((?:%[\w.\-]+(?:, )?)+)", line
            )
            inner = [x for group in called for x in re.findall(r"%([\w.\-]+)", group)]
            if op in ("while", "conditional", "call"):
                key = "each turn" if op == "while" else "once"
                for part in map(walk, inner):
                    count += Counter({key if k == "once" else k: n for k, n in part.items()})
            elif op not in FREE:
                target = re.search(r'custom_call_target="([^"]+)"', line)
                target = target.group(1).lower() if target else ""
                count["libraries"] += any(library in target for library in LIBRARIES)
                count["callbacks"] += "callback" in target
                count["once"] += 1
        return count

    computed = walk(entry)
    return {key: computed[key] for key in ("once", "each turn", "libraries", "callbacks")}


def count(names, batches, steps: int, wanted: str) -> None:
    """Print what calls launch, of functions whose name has `wanted` in it."""
    reason = why_not()
    if reason:
        print(f"nothing counted: {reason}")
        return
    print("| robot | function | batch | kernels once | kernels each turn of loops | libraries | callbacks | s |")
    print("|---|---|---|---|---|---|---|---|")
    for name in names:
        for label, (function, sizes) in functions(name, steps).items():
            for batch in batches if wanted in label else ():
                args = [jax.ShapeDtypeStruct((batch, n), jnp.float32) for n in sizes]
                before = time.perf_counter()
                computed = launches(compiled_text(jax.vmap(function), *args))
                row = [name, label, batch, *computed.values(), f"{time.perf_counter() - before:.0f}"]
                print("| " + " | ".join(map(str, row)) + " |", flush=True)


# --- measured on a device ---


def seconds(call: Callable, *args, rounds: int = 10) -> float:
    """The best of some calls."""
    jax.block_until_ready(call(*args))
    times = []
    for _ in range(rounds):
        before = time.perf_counter()
        jax.block_until_ready(call(*args))
        times.append(time.perf_counter() - before)
    return min(times)


def peaks(size: int) -> tuple[float, float]:
    """Operations and bytes a second that this device reaches, on arrays of `size` numbers."""
    x = jnp.ones(size, jnp.float32)
    chain = jax.jit(lambda x: jax.lax.fori_loop(0, 64, lambda _, y: y * x + x, x))
    unrolled = jax.jit(lambda x: jax.lax.fori_loop(0, 4, lambda _, y: _chained(y, x), x))
    operations = max(2 * 64 * size / seconds(chain, x), 2 * 4 * 64 * size / seconds(unrolled, x))
    return operations, 3 * 4 * size / seconds(jax.jit(jnp.add), x, 2 * x)


def _chained(y, x):
    for _ in range(64):
        y = y * x + x
    return y


def arguments(name: str, sizes, batch: int) -> list[jax.Array]:
    """States of a batch; those of a four-bar are assembled, at several speeds."""
    if name == "four-bar":
        q, v = (np.asarray(x, np.float32) for x in jd.scenes.four_bar.start())
        return [
            jnp.asarray(np.tile(q, (batch, 1))),
            jnp.asarray(np.linspace(0.5, 2.0, batch, dtype=np.float32)[:, None] * v),
        ]
    keys = jax.random.split(jax.random.key(0), len(sizes))
    return [0.3 * jax.random.normal(key, (batch, n), jnp.float32) for key, n in zip(keys, sizes, strict=True)]


def operations_of(function: Callable, args, steps: int) -> float | None:
    """Operations of the kernels of a call, for all samples; None where the number of steps is not known."""
    total = 0.0
    jaxprs = [jax.make_jaxpr(function)(*args).jaxpr]
    while jaxprs:
        for eqn in jaxprs.pop().eqns:
            program = eqn.params.get("program")
            if program is not None:
                samples = max((math.prod(getattr(x.aval, "shape", ())[:-1]) for x in eqn.invars), default=1)
                total += samples * program.cost * (steps if program.turns > 1 else 1)
            jaxprs += [x.jaxpr for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "jaxpr")]
    return total or None


class Row(NamedTuple):
    """What was measured of a function in a mode."""

    seconds: float
    error: float
    compilation: float


def measure_one(function: Callable, args, reference) -> Row:
    """The time and the error of a call."""
    before = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    compilation = time.perf_counter() - before
    error = 0.0
    for computed, want in zip(jax.tree.leaves(program(*args)), reference, strict=True):
        # A motion of a few samples may end early in one precision: those that have no number in both do not count.
        difference = np.abs(np.asarray(computed) - want) / max(1.0, np.nanmax(np.abs(want)))
        both = np.isnan(np.asarray(computed)) & np.isnan(want)
        error = max(error, float(np.max(np.where(both, 0.0, np.where(np.isnan(difference), np.inf, difference)))))
    return Row(seconds(program, *args), error, compilation)


def measure(names, batches, steps: int, size: int, modes=("auto",)) -> None:
    """Print times with their roofline, and what they decide."""
    device = jax.devices()[0]
    is_gpu = device.platform == "gpu"
    print(f"device: {device.device_kind} ({device.platform}), float32, jax {jax.__version__}")
    if not is_gpu:
        print("no GPU here: the figures below are those of this CPU, without roofline")
        modes = ("auto",)
    else:
        operations, bandwidth = peaks(size)
        print(f"reached by a chain of multiply-adds: {operations:.3g} 1/s; by adding arrays: {bandwidth:.3g} B/s")
    head = "robot|function|batch|mode|us a call|samples/s|error|operations|bytes|roofline us|share|compile s".split("|")
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    against = []
    for name in names:
        for label, (one, sizes) in functions(name, steps).items():
            for batch in batches:
                args, function = arguments(name, sizes, batch), jax.vmap(one)
                on_cpu = jax.device_put(args, jax.devices("cpu")[0])
                reference = [np.asarray(x) for x in jax.tree.leaves(jax.jit(function)(*on_cpu))]
                rows = {}
                for mode in modes:
                    with jd.compilation(mode):
                        rows[mode] = measure_one(function, args, reference)
                    took, rest = rows[mode].seconds, ["-"] * 4
                    if is_gpu and not label.startswith("adaptive"):
                        flops = operations_of(function, args, steps) or 0.0
                        moved = sum(x.nbytes for x in (*args, *reference))
                        least = max(flops / operations, moved / bandwidth)
                        rest = [f"{flops:.3g}", f"{moved:.3g}", f"{1e6 * least:.3g}", f"{least / took:.2f}"]
                    row = [
                        name,
                        label,
                        batch,
                        mode,
                        f"{1e6 * took:.3g}",
                        f"{batch / took:.3g}",
                        f"{rows[mode].error:.1e}",
                    ]
                    row += [*rest, f"{rows[mode].compilation:.1f}"]
                    print("| " + " | ".join(map(str, row)) + " |", flush=True)
                against += reasons_against(f"{name}, {label}, batch {batch}", rows)
    if is_gpu and {"auto", "native"} <= set(modes):
        print("\n".join(["native kernels are not to be the default on this GPU:", *against] if against else [
            "native kernels are right and faster in every row: make them the default on GPUs"]))  # fmt: skip


def reasons_against(what: str, rows: dict[str, Row]) -> list[str]:
    """Reasons not to take native kernels: errors that XLA's own code has not, times, compilation."""
    if not {"auto", "native"} <= rows.keys():
        return []
    usual, native = rows["auto"], rows["native"]
    found = []
    if not native.error <= max(MAX_ERROR, 2 * usual.error):
        found.append(f"{what}: error {native.error:.1e} against {usual.error:.1e}")
    if native.seconds > usual.seconds:
        found.append(f"{what}: {1e6 * native.seconds:.3g} us against {1e6 * usual.seconds:.3g}")
    if native.compilation > max(MAX_COMPILATION, usual.compilation):
        found.append(f"{what}: {native.compilation:.1f} s of compilation against {usual.compilation:.1f}")
    return found


def main() -> None:
    """Print the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, nargs="+", default=[4096, 65536])
    parser.add_argument(
        "--robots", nargs="+", default=["panda", "g1", "four-bar"], help="panda, g1, iiwa, four-bar, a URDF file"
    )
    parser.add_argument("--steps", type=int, default=100, help="of a rollout")
    parser.add_argument(
        "--size", type=int, default=2**26, help="numbers in an array that measures what a device reaches"
    )
    parser.add_argument("--count", action="store_true", help="count launches by compiling for an H100, without one")
    parser.add_argument("--modes", nargs="+", default=["auto", "native"], choices=["auto", "native", "plain"])
    parser.add_argument("--only", default="", help="with --count: part of the names of functions")
    args = parser.parse_args()
    if args.count:
        from jaxdyn.compile.gpu import device as gpu_device

        # What native kernels ask the driver for before anything is launched: the architecture, that of an H100.
        gpu_device.driver = lambda: SimpleNamespace(architecture=90, launch=0)
        for mode in args.modes:
            with jd.compilation(mode):
                print(f"mode {mode}")
                count(args.robots, args.batches, args.steps, args.only)
    else:
        measure(args.robots, args.batches, args.steps, args.size, args.modes)


if __name__ == "__main__":
    main()
