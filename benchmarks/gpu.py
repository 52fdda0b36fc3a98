"""Dynamics and rollouts on a GPU, by XLA's own code and by native kernels, with their roofline.

    python -m benchmarks.gpu [--batches 4096 65536] [--robots panda g1] [--steps 100] [--modes auto native]
    python -m benchmarks.gpu --count [--robots panda] [--modes native]

Times are those of the first device of `jax.devices()`: best of some calls, in float32, with the error against the CPU relative to
the largest number. The last lines decide: native kernels are to be the default on GPUs where they are right and faster in every
row, compile in five seconds and close loops. Forward dynamics of frax and MJX are rows too where these are installed. What
fails is printed, and the other rows follow.

The roofline is the larger of two times: operations over the operations a second that a long chain of multiply-adds reaches
here, and bytes over the bytes a second that adding two long arrays reaches, both measured in the same run. Operations are those
of the scalar programs, times the steps of a rollout; bytes are those of the arguments and the results. Adaptive motions have no
roofline, as their steps are not known beforehand, nor has a CPU. `benchmarks/gpu_model.py` has a model without a device.

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
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import NamedTuple

if "--count" in sys.argv:  # with the platform of the host alone the plugin looks for no driver
    os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import jax_peers

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
MAX_RESIDUAL = 1e-6  # of closed loops, m
LIBRARIES = ("cublas", "cusolver", "cudnn", "cufft")
MECHANISMS = ("four-bar", "quadruped")


def robot(name: str):
    """A robot in float32, by name or from a URDF file; "floating:" before the path gives it a floating base."""
    if name == "iiwa":
        return jd.robots.iiwa(dtype=jnp.float32)
    if name.endswith(".urdf"):
        path = name.removeprefix("floating:")
        return jd.load_model(path, floating_base=path != name, dtype=jnp.float32)
    from benchmarks.dynamics import load

    return load(name)[0]


def mechanism(name: str):
    """A mechanism with loops in float32 and a start q, v: "four-bar", or "quadruped", a free trunk on four feet that are held."""
    if name == "four-bar":
        q, v = jd.scenes.four_bar.start()
        return jd.scenes.four_bar(), np.asarray(q, np.float32), np.asarray(v, np.float32)
    model = jd.robots.quadruped(dtype=jnp.float32)
    q = jd.neutral(model).at[7:].set(jnp.tile(jnp.array([0.0, 0.8, -1.6]), 4))
    feet = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
    loops = [jd.loop(foot, None, None, tuple(jd.frame_pose(model, q, foot)[:3, 3]), "spherical") for foot in feet]
    scene = jd.Scene(model, loops)
    free = np.linalg.svd(np.asarray(jd.constraint_jacobian(scene, q)))[2][-1]  # the trunk moves, the feet do not
    return scene, np.asarray(q), 0.3 * free


def functions(name: str, steps: int) -> dict[str, tuple[Callable, tuple[int, ...]]]:
    """What is measured of a robot, or of a `mechanism`: functions of one sample, and the lengths of their arguments.

    The last result of a motion of a mechanism are the errors of its loops, m and rad, and of their rates.
    """
    if name in MECHANISMS:
        scene = mechanism(name)[0]
        end = 1.0 if name == "four-bar" else 5e-3 * steps

        def motion(q, v, **options):
            ts = np.linspace(0.0, end, 2, dtype=np.float32)
            solution = jd.simulate(scene, q, v, ts, throw=False, outputs=["constraint_residual"], **options)
            assert solution.constraint_residual is not None
            return solution.q[-1], solution.constraint_residual[-1]

        fixed = functools.partial(motion, stepsize=end / steps)
        computed = {
            "constrained dynamics": lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration,
            f"{steps} steps": fixed,
            "gradient of these": jax.grad(lambda q, v: jnp.sum(fixed(q, v)[0] ** 2), (0, 1)),
            "adaptive steps": motion,
        }
        return {label: (function, (scene.nq, scene.nv)) for label, function in computed.items()}
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
        "gradient of the rollout": (jax.grad(lambda q, v: jnp.sum(rollout(q, v) ** 2), (0, 1)), three[:2]),
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
    """States of a batch; those of a mechanism are assembled, at several speeds."""
    if name in MECHANISMS:
        _, q, v = mechanism(name)
        speeds = np.linspace(0.5, 2.0, batch, dtype=np.float32)[:, None]
        return [jnp.asarray(np.tile(q, (batch, 1))), jnp.asarray(speeds * v)]
    keys = jax.random.split(jax.random.key(0), len(sizes))
    return [0.3 * jax.random.normal(key, (batch, n), jnp.float32) for key, n in zip(keys, sizes, strict=True)]


def kernel_calls(function: Callable, args) -> Iterator[tuple]:
    """The kernels that a function calls: the program, the number of samples, and which operands these share."""
    jaxprs = [jax.make_jaxpr(function)(*args).jaxpr]
    while jaxprs:
        for eqn in jaxprs.pop().eqns:
            program = eqn.params.get("program")
            if program is not None:
                shapes = [getattr(x.aval, "shape", ()) for x in eqn.invars]
                samples = max((math.prod(x[:-1]) for x in shapes), default=1)
                yield program, samples, [len(x) == 1 and samples > 1 for x in shapes]
            jaxprs += [x.jaxpr for x in jax.tree.leaves(list(eqn.params.values())) if hasattr(x, "jaxpr")]


def operations_of(function: Callable, args, steps: int) -> float | None:
    """Operations of the kernels of a call, for all samples; None where there is no kernel."""
    calls = kernel_calls(function, args)
    return sum(n * program.cost * (steps if program.turns > 1 else 1) for program, n, _ in calls) or None


class Row(NamedTuple):
    """What was measured of a function in a mode."""

    seconds: float
    error: float
    compilation: float
    residual: float = 0.0  # of closed loops


def measure_one(function: Callable, args, reference, closes: bool = False) -> Row:
    """The time and the error of a call; `closes`: whether its last result are the errors of loops."""
    before = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    compilation = time.perf_counter() - before
    results, error = jax.tree.leaves(program(*args)), 0.0
    for computed, want in zip(results, reference, strict=True):
        # A motion of a few samples may end early in one precision: those that have no number in both do not count.
        difference = np.abs(np.asarray(computed) - want) / max(1.0, np.nanmax(np.abs(want)))
        both = np.isnan(np.asarray(computed)) & np.isnan(want)
        error = max(error, float(np.max(np.where(both, 0.0, np.where(np.isnan(difference), np.inf, difference)))))
    residual = float(np.abs(np.asarray(results[-1])[:, 0]).max()) if closes else 0.0
    return Row(seconds(program, *args), error, compilation, residual)


def on_gpu() -> bool:
    """Whether JAX computes on a GPU here."""
    return jax.devices()[0].platform == "gpu"


def measure(names, batches, steps: int, size: int, modes=("auto",)) -> None:
    """Print times with their roofline, and what they decide."""
    device, is_gpu = jax.devices()[0], on_gpu()
    print(f"device: {device.device_kind} ({device.platform}), float32, jax {jax.__version__}")
    if not is_gpu:
        print("no GPU here: the figures below are those of this CPU, without roofline")
        modes = ("auto",)
    else:
        operations, bandwidth = peaks(size)
        print(f"reached by a chain of multiply-adds: {operations:.3g} 1/s; by adding arrays: {bandwidth:.3g} B/s")
    head = "robot|function|batch|mode|us a call|samples/s|error|operations|bytes|roofline us|share|compile s|loops to".split(
        "|"
    )
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    against = []
    for name in names:
        for label, (one, sizes) in functions(name, steps).items():
            called = dict.fromkeys(modes, one)
            if is_gpu and label == "forward dynamics":
                called |= jax_peers.forward_dynamics(robot(name))
            for batch in batches:
                args, rows = arguments(name, sizes, batch), {}
                on_cpu = jax.device_put(args, jax.devices("cpu")[0])
                reference = [np.asarray(x) for x in jax.tree.leaves(jax.jit(jax.vmap(one))(*on_cpu))]
                rest = ["-"] * 3
                if is_gpu and not label.startswith("adaptive"):
                    flops = operations_of(jax.vmap(one), args, steps) or 0.0
                    moved = sum(x.nbytes for x in (*args, *reference))
                    least = max(flops / operations, moved / bandwidth)
                    rest = [f"{flops:.3g}", f"{moved:.3g}", f"{1e6 * least:.3g}"]
                for what, function in called.items():
                    try:
                        with jd.compilation(what if what in modes else "auto"):
                            rows[what] = measure_one(
                                jax.vmap(function), args, reference, name in MECHANISMS and "steps" in label
                            )
                    except Exception as error:  # the time on a device is short: the other rows are wanted too
                        print(f"{name}, {label}, batch {batch}, {what}: {type(error).__name__}: {str(error)[:500]}")
                        rows[what] = Row(math.inf, math.inf, math.inf)
                    took, *others = rows[what]
                    row = [
                        name,
                        label,
                        batch,
                        what,
                        f"{1e6 * took:.3g}",
                        f"{batch / took:.3g}",
                        f"{others[0]:.1e}",
                        *rest,
                    ]
                    row += [f"{least / took:.2f}" if rest[0] != "-" else "-", f"{others[1]:.1f}", f"{others[2]:.0e}"]
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
    if not native.error <= max(MAX_ERROR, 2 * usual.error if usual.error < math.inf else 0.0):
        found.append(f"{what}: error {native.error:.1e} against {usual.error:.1e}")
    if native.residual > MAX_RESIDUAL:
        found.append(f"{what}: loops are closed to {native.residual:.1e}")
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
        "--robots", nargs="+", default=["panda", "g1", *MECHANISMS], help="panda, g1, iiwa, a mechanism, a URDF file"
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
        from jaxdyn.compile import gpu as gpu_device

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
