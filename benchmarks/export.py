"""Exported functions called from C and from Python, against Pinocchio's C++ compiled for this processor.

    python -m benchmarks.export [--rounds 20] [--loop SECONDS] [--docs]

Forward dynamics and its Jacobian in (q, v, tau) of a Panda and of a G1 with a free base, microseconds a call: `aba` (the faster
of its two conventions) and `computeABADerivatives` are compiled with g++ -O3 -march=native from the headers in the wheel `pin`,
which takes three minutes once; Eigen's headers are those in the wheel `casadi`. All contestants take turns in one process; each
turn is a loop in C over 64 random states. `exported(q, v, tau)` and `pin.aba` are called from Python on one state. The tables end
with constrained dynamics of two closed-loop mechanisms, the seconds that an export takes, and a loop at 1 kHz for `--loop`
seconds.
`--docs` puts the tables into docs/deploy.md.
"""

import argparse
import ctypes
import hashlib
import subprocess
import sysconfig
import time
from pathlib import Path

import jax
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import timing
from benchmarks.dynamics import load, states
from benchmarks.extremes import replace_section
from benchmarks.first_calls import stewart

PEERS = Path(__file__).parent / "peers"
PAGE = Path(__file__).resolve().parent.parent / "docs/deploy.md"
SAMPLES = 64
# What each figure is to reach: a ratio to Pinocchio, or seconds.
REACH = {
    "Panda forward dynamics": 0.35, "Panda Jacobian": 0.5, "G1 forward dynamics": 0.35, "from Python": 0.6,
    "Panda": 3.0, "G1": 20.0,
}  # fmt: skip
NAMES = {"panda": "Panda", "g1": "G1"}


def addresses(*arrays: np.ndarray) -> list[ctypes.c_void_p]:
    """Pointers to arrays."""
    return [ctypes.c_void_p(x.ctypes.data) for x in arrays]


def pinocchio_library() -> ctypes.CDLL:
    """Pinocchio's algorithms with a clock around them, compiled where they have not been compiled before."""
    source = PEERS / "pinocchio.cpp"
    built = timing.OUT / f"pinocchio_{hashlib.sha256(source.read_bytes()).hexdigest()[:8]}.so"
    if not built.exists():
        timing.OUT.mkdir(exist_ok=True)
        prefix = Path(pin.__file__).parents[4]
        headers = [prefix / "include", Path(sysconfig.get_path("purelib")) / "casadi/include/eigen3"]
        # The limits of Boost are those that Pinocchio's own build files set for its variant of joints.
        flags = ["-std=c++17", "-O3", "-march=native", "-DNDEBUG", "-w", "-fPIC", "-shared"]
        flags += ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
        flags += [f"-isystem{x}" for x in headers] + [f"-L{prefix}/lib", f"-Wl,-rpath,{prefix}/lib"]
        subprocess.run(["g++", *flags, str(source), "-o", str(built), "-lboost_serialization"], check=True)
    library = ctypes.CDLL(str(built))
    library.load.restype = ctypes.c_void_p
    library.aba.restype = library.aba_derivatives.restype = ctypes.c_double
    return library


def export(function, q, v, tau, name: str, derivatives=()) -> tuple[jd.Exported, ctypes.CDLL, float]:
    """The exported function, a library of it with a clock around it, and the seconds of the export."""
    start = time.perf_counter()
    exported = jd.export(function, q, v, tau, name=name, derivatives=derivatives)
    folder = exported.save(timing.OUT / f"export_{name}")
    seconds = time.perf_counter() - start
    built = folder / f"{name}.so"
    command = [
        "cc",
        "-O2",
        "-shared",
        "-fPIC",
        str(PEERS / "exported.c"),
        str(folder / f"{name}.o"),
        "-o",
        str(built),
        "-lm",
    ]
    subprocess.run(command, check=True)
    library = ctypes.CDLL(str(built))
    library.time_function.restype = library.time_jacobian.restype = ctypes.c_double
    return exported, library, seconds


class Contest:
    """Contestants by name: each a function from a number of calls to the seconds of one."""

    def __init__(self):
        self.contestants = {}
        self.best = {}

    def add(self, name: str, call) -> None:
        """Another one, and what a call takes at first."""
        self.contestants[name] = call
        self.best[name] = call(1000)

    def run(self, rounds: int) -> None:
        """Rounds in which all take turns of some 20 ms."""
        repeats = {name: max(10, int(0.02 / seconds)) for name, seconds in self.best.items()}
        for _ in range(rounds):
            for name, call in self.contestants.items():
                self.best[name] = min(self.best[name], call(repeats[name]))


def compete_robot(contest: Contest, peer: ctypes.CDLL, robot: str) -> tuple[jd.Exported, ctypes.CDLL, float, float]:
    """Forward dynamics and Jacobian of a robot: exported, its library, seconds to export and the largest relative difference."""
    model, source = load(robot)
    (q, v, tau), q_pin = states(model, SAMPLES, np.float64)
    q, v, tau = map(np.asarray, (q, v, tau))
    q_pin = np.ascontiguousarray(q_pin)

    def function(q, v, tau):
        return jd.forward_dynamics(model, q, v, tau)

    exported, library, seconds = export(function, q[0], v[0], tau[0], f"{robot}_fd", ("jacobian",))
    archive = timing.OUT / f"{robot}.txt"
    source.saveToText(str(archive))
    handle = ctypes.c_void_p(peer.load(str(archive).encode()))
    nq, nv = ctypes.c_long(model.nq), ctypes.c_long(model.nv)
    ours, theirs = np.zeros(model.nv), np.zeros(model.nv)
    blocks = [np.zeros((model.nv, n)) for n in (model.nq, model.nv, model.nv)]
    by_v = np.zeros((model.nv, model.nv))
    samples = ctypes.c_long(SAMPLES)
    given, given_pin = addresses(q, v, tau), addresses(q_pin, v, tau)
    function_, jacobian_ = getattr(library, f"{robot}_fd"), getattr(library, f"{robot}_fd_jacobian")

    def long(calls):
        return ctypes.c_long(calls)

    name = NAMES[robot]
    contest.add(
        f"{name} forward dynamics",
        lambda n: library.time_function(function_, nq, nv, long(n), samples, *given, *addresses(ours)),
    )
    contest.add(
        f"{name} Jacobian",
        lambda n: library.time_jacobian(jacobian_, nq, nv, long(n), samples, *given, *addresses(*blocks)),
    )
    for world, convention in enumerate(("local", "world")):
        contest.add(
            f"{name} aba {convention}",
            lambda n, world=world: peer.aba(handle, long(n), samples, *given_pin, world, *addresses(theirs)),
        )
    contest.add(
        f"{name} computeABADerivatives",
        lambda n: peer.aba_derivatives(handle, long(n), samples, *given_pin, *addresses(by_v)),
    )
    for call in list(contest.contestants.values())[-5:]:
        call(SAMPLES)  # all end on the last sample
    apart = max(np.abs(ours - theirs).max() / np.abs(theirs).max(), np.abs(blocks[1] - by_v).max() / np.abs(by_v).max())
    if robot == "panda":
        data, one, one_pin = source.createData(), (q[0], v[0], tau[0]), (q_pin[0], v[0], tau[0])
        contest.add("from Python", lambda n: timed(lambda: exported(*one), n))
        aba = pin.aba  # pyright: ignore[reportAttributeAccessIssue]
        contest.add("pin.aba", lambda n: timed(lambda: aba(source, data, *one_pin), n))
    return exported, library, seconds, apart


def timed(call, count: int) -> float:
    """Seconds of one of `count` calls."""
    start = time.perf_counter()
    for _ in range(count):
        call()
    return (time.perf_counter() - start) / count


def compete_mechanism(contest: Contest, name: str, scene: jd.Scene, q, v) -> None:
    """Constrained dynamics of a closed loop, called from C on one state."""
    tau = np.zeros(scene.nv)

    def function(q, v, tau):
        return jd.constrained_dynamics(scene, q, v, tau).acceleration

    symbol = name.replace("-", "_").replace(" ", "_").lower()
    _, library, _ = export(function, q, v, tau, symbol)
    out, kept = np.zeros(scene.nv), (q, v, tau)
    call, sizes = getattr(library, symbol), (ctypes.c_long(scene.nq), ctypes.c_long(scene.nv))
    contest.add(
        name,
        lambda n: library.time_function(call, *sizes, ctypes.c_long(n), ctypes.c_long(1), *addresses(*kept, out)),
    )


def run_loop(exported: jd.Exported, library: ctypes.CDLL, seconds: float) -> str:
    """A line on a loop at 1 kHz: how late it wakes, and how long a call takes."""
    q, v, tau = exported.examples
    count, a = int(1000 * seconds), np.zeros(v.size)
    late, busy = np.zeros((2, count))
    sizes = ctypes.c_long(q.size), ctypes.c_long(v.size), ctypes.c_long(count), ctypes.c_long(1)
    is_real_time = library.run_loop(getattr(library, exported.name), *sizes, *addresses(q, v, tau, a, late, busy))
    kind = "SCHED_FIFO, memory locked" if is_real_time else "ordinary scheduling"

    def row(name, x):
        return (
            f"| {name} | " + " | ".join(f"{1e6 * y:.2f}" for y in (*np.percentile(x, (50, 99, 99.9)), x.max())) + " |\n"
        )

    return (
        f"A loop at 1 kHz, {count} periods, {kind}:\n\n| microseconds | median | 99 % | 99.9 % | worst |\n|---|---|---|---|---|\n"
        + row("late after the timer", late) + row("one call of a Panda's forward dynamics", busy)
    )  # fmt: skip


def main() -> None:
    """Measure all and print the tables."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--loop", type=float, default=10.0, help="seconds of the loop at 1 kHz (default: 10)")
    parser.add_argument("--docs", action="store_true", help="put the tables into docs/deploy.md")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    contest, peer = Contest(), pinocchio_library()
    robots = {robot: compete_robot(contest, peer, robot) for robot in NAMES}
    scene = jd.scenes.four_bar()
    compete_mechanism(contest, "four-bar", scene, *map(np.asarray, jd.scenes.four_bar.start()))
    scene, guess = stewart()
    closed = jd.assemble(scene, guess)
    compete_mechanism(contest, "Stewart platform", scene, np.asarray(closed.q), np.zeros(scene.nv))
    contest.run(options.rounds)
    best = contest.best
    lines = ["| microseconds a call | jaxdyn | Pinocchio | ratio | to reach |", "|---|---|---|---|---|"]
    rows = []
    for name in NAMES.values():
        aba = min(best[f"{name} aba local"], best[f"{name} aba world"])
        rows += [(f"{name} forward dynamics", aba), (f"{name} Jacobian", best[f"{name} computeABADerivatives"])]
    for name, theirs in (*rows, ("from Python", best["pin.aba"])):
        ours, reach = best[name], REACH.get(name)
        shown = "Panda forward dynamics from Python" if name == "from Python" else name
        lines.append(f"| {shown} | {1e6 * ours:.3g} | {1e6 * theirs:.3g} | {ours / theirs:.2f} | {reach or '-'} |")
    for name in ("four-bar", "Stewart platform"):
        lines.append(f"| {name}, constrained dynamics | {1e6 * best[name]:.3g} | - | - | - |")
    lines += ["", "| export with Jacobian | seconds | to reach |", "|---|---|---|"]
    lines += [f"| {NAMES[robot]} | {x[2]:.1f} | {REACH[NAMES[robot]]:g} |" for robot, x in robots.items()]
    loop = run_loop(*robots["panda"][:2], options.loop)
    machine, load_ = timing.machine(), max(x[3] for x in robots.values())
    head = f"{machine['processor']}; best of {options.rounds} interleaved rounds; largest relative difference {load_:.0e}.\n\n"
    text = head + "\n".join(lines) + "\n\n" + loop
    print(text)
    timing.write("export", {"machine": machine, "seconds": best, "export": {k: x[2] for k, x in robots.items()}})
    if options.docs:
        replace_section(PAGE, "export", text)


if __name__ == "__main__":
    main()
