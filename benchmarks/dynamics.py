"""Time of dynamics and kinematics against Pinocchio (one and two threads), and against frax and MJX where they are installed.

    python -m benchmarks.dynamics [--robots panda g1] [--batches 1 256 4096] [--dtypes float64 float32] [--functions NAME ...]
                                  [--loop-batches 1 300 5000] [--calls 10] [--rounds 20] [--readme]

Per robot, function, batch and dtype: microseconds per evaluation, best and median of 20 interleaved rounds, and the ratio to
Pinocchio with two threads measured in the same loop. jaxdyn runs through plain `jax.vmap` and `jax.jit`, default XLA flags, the
model closed over ("known") or passed as an argument ("given"). Compile and trace times are printed apart.

A second table has forward dynamics of a given model, `jax.jit(jax.vmap(jd.forward_dynamics, (None, 0, 0, 0)))`, called
alone and as the body of a `lax.scan` of 10 calls, each with the velocities that the one before leaves. `--readme` writes six
rows into README.md and all into docs/benchmarks.md.
"""

import argparse
import os
import re
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

import jaxdyn as jd
from benchmarks import jax_peers, timing

ROBOTS = Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
FILES = {
    "panda": ("panda_description/urdf/panda.urdf", False, ("panda_finger_joint1", "panda_finger_joint2")),
    "g1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", True, ()),
}
THREADS = min(2, os.cpu_count() or 1)


def load(name):
    """The robot in jaxdyn and in Pinocchio."""
    file, floating, lock = FILES[name]
    source = pin.buildModelFromUrdf(str(ROBOTS / file), *([pin.JointModelFreeFlyer()] if floating else []))
    if lock:
        source = pin.buildReducedModel(source, [source.getJointId(joint) for joint in lock], pin.neutral(source))
    return jd.load_model(ROBOTS / file, floating_base=floating, lock=lock), source


def states(model, batch, dtype):
    """Random q, v, tau (batch, .) and q in Pinocchio's order."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (batch, model.nq))
    q_pin = q.copy()
    if model.topology.kinds[0] == "free":
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
        q_pin = q.copy()
        q_pin[:, 3:7] = q[:, [4, 5, 6, 3]]
    v, tau = rng.normal(size=(2, batch, model.nv))
    return tuple(jnp.asarray(x, dtype) for x in (q, v, tau)), q_pin


def ours(model, weights):
    """The functions under test, on one sample."""

    def gradient(model, q, v, tau):
        return jax.grad(lambda *x: jnp.vdot(weights, jd.forward_dynamics(model, *x)), (0, 1, 2))(q, v, tau)

    tip = model.body_names[-1]
    return {
        "forward dynamics": jd.forward_dynamics,
        "inverse dynamics": jd.inverse_dynamics,
        "mass matrix": lambda model, q, v, tau: jd.mass_matrix(model, q),
        "gradient of forward dynamics": gradient,
        "frame pose": lambda model, q, v, tau: jd.frame_pose(model, q, tip),
        "body Jacobian": lambda model, q, v, tau: jd.body_jacobian(model, q, tip),
        "centre of mass": lambda model, q, v, tau: jd.center_of_mass(model, q),
        "potential energy": lambda model, q, v, tau: jd.potential_energy(model, q),
    }


def peers(source, q, v, tau):
    """Pinocchio's calls over the batch, by function and number of threads."""
    batch = len(q)
    data, pool = source.createData(), pin.ModelPool(source, THREADS)
    q_, v_, tau_ = (np.asfortranarray(np.asarray(x, float).T) for x in (q, v, tau))
    out = np.zeros((source.nv, batch), order="F")

    def mass():
        for i in range(batch):
            pin.crba(source, data, q_[:, i])

    def derivatives():
        for i in range(batch):
            pin.computeABADerivatives(source, data, q_[:, i], v_[:, i], tau_[:, i])

    calls = {"forward dynamics": {}, "inverse dynamics": {}}
    for n in sorted({1, min(THREADS, batch)}):  # waking a second thread for one sample takes milliseconds
        calls["forward dynamics"][f"pin {n}"] = lambda n=n: pin.abaInParallel(n, pool, q_, v_, tau_, out)
        calls["inverse dynamics"][f"pin {n}"] = lambda n=n: pin.rneaInParallel(n, pool, q_, v_, tau_, out)
    last = source.njoints - 1

    def poses():
        for i in range(batch):
            pin.forwardKinematics(source, data, q_[:, i])

    def jacobians():
        for i in range(batch):
            pin.computeJointJacobian(source, data, q_[:, i], last)

    def centres():
        for i in range(batch):
            pin.centerOfMass(source, data, q_[:, i])

    def energies():
        for i in range(batch):
            pin.computePotentialEnergy(source, data, q_[:, i])

    calls["mass matrix"] = {"pin loop": mass}
    calls["gradient of forward dynamics"] = {"pin loop": derivatives}
    kinematics = {
        "frame pose": poses,
        "body Jacobian": jacobians,
        "centre of mass": centres,
        "potential energy": energies,
    }
    return calls | {name: {"pin loop": call} for name, call in kinematics.items()}


def compiled(function, *args):
    """(executable, trace seconds, compile seconds)."""
    start = time.perf_counter()
    lowered = jax.jit(function).lower(*args)
    middle = time.perf_counter()
    executable = lowered.compile()
    return executable, middle - start, time.perf_counter() - middle


def measure(name, batch, dtype, rounds, functions):
    """One row per function."""
    model, source = load(name)
    model = jax.tree.map(lambda x: x.astype(dtype), model)
    args, q_pin = states(model, batch, dtype)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=model.nv), dtype)
    theirs = peers(source, q_pin, args[1], args[2])
    rows = []
    for label, function in ours(model, weights).items():
        if functions and label not in functions:
            continue

        def known(q, v, tau, function=function):
            return jax.vmap(lambda *x: function(model, *x))(q, v, tau)

        def given(model, q, v, tau, function=function):
            return jax.vmap(lambda *x: function(model, *x))(q, v, tau)

        calls, times = dict(theirs[label]), {}
        for mode, traced, inputs in (("known", known, args), ("given", given, (model, *args))):
            if mode == "given" and label != "forward dynamics":
                continue
            executable, trace, build = compiled(traced, *inputs)
            times[mode] = {"trace_s": trace, "compile_s": build}
            calls[mode] = lambda run=executable, inputs=inputs: jax.block_until_ready(run(*inputs))
        if label == "forward dynamics":
            for peer, call in jax_peers.forward_dynamics(model).items():
                if peer == "MJX" and batch > 256:  # minutes a call
                    continue
                if jax_peers.checked(peer, call, model, *args):
                    executable, trace, build = compiled(jax.vmap(call), *args)
                    times[peer] = {"trace_s": trace, "compile_s": build}
                    calls[peer] = lambda run=executable: jax.block_until_ready(run(*args))
        # Who takes a second for one call is timed once, beside the loop: no mean over rounds changes that picture.
        slow = {peer: timing.once(calls.pop(peer)) for peer in list(calls) if timing.once(calls[peer]) > 1.0}
        result = timing.time_alternately(calls, rounds)
        result |= {peer: {"best": seconds, "median": seconds} for peer, seconds in slow.items()}
        for entry in result.values():
            entry.update({key + "_us": 1e6 * entry.pop(key) / batch for key in ("best", "median")})
        rows.append(
            {"robot": name, "function": label, "batch": batch, "dtype": np.dtype(dtype).name, "times": result} | times
        )
        print(line(rows[-1]), flush=True)
    return rows


def reference(row):
    """The peer that a row is compared with: Pinocchio with the most threads."""
    return max((key for key in row["times"] if key.startswith("pin")), key=lambda key: (key[-1].isdigit(), key))


def called_by(peer):
    """How Pinocchio is called: in threads of its own, or sample by sample from Python."""
    number = peer.removeprefix("pin ")
    return "Python's loop" if number == "loop" else f"{number} thread{'s' * (number != '1')}"


def line(row):
    """One row of the table."""
    base = row["times"][reference(row)]
    cells = [row["robot"], row["function"], str(row["batch"]), row["dtype"]]
    for mode in ("known", "given"):
        entry = row["times"].get(mode)
        ratios = entry and [entry[key] / base[key] for key in ("best_us", "median_us")]
        cells.append("" if entry is None else f"{entry['best_us']:.3g} ({entry['median_us']:.3g})")
        cells.append("" if entry is None else f"{ratios[0]:.2f} ({ratios[1]:.2f})")
    cells += [f"{base['best_us']:.3g} ({base['median_us']:.3g})", called_by(reference(row))]
    for peer in ("frax", "MJX"):
        entry = row["times"].get(peer)
        cells.append("" if entry is None else f"{entry['best_us']:.3g} ({entry['median_us']:.3g})")
    cells.append(f"{row['known']['trace_s']:.1f} + {row['known']['compile_s']:.1f}")
    return "| " + " | ".join(cells) + " |"


HEAD = (
    "| robot | function | batch | dtype | known model, us | ratio | model as argument, us | ratio | Pinocchio us | by | "
    "frax us | MJX us | trace + compile s |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)
KINEMATICS = ("frame pose", "body Jacobian", "centre of mass", "potential energy")


def against_inverse_dynamics(rows):
    """Lines of a table: kinematics relative to inverse dynamics of the same robot, batch and dtype."""
    best = {(r["robot"], r["batch"], r["dtype"], r["function"]): r["times"]["known"]["best_us"] for r in rows}
    lines = []
    for robot, batch, dtype in dict.fromkeys(key[:3] for key in best):
        base = best.get((robot, batch, dtype, "inverse dynamics"))
        computed = [best.get((robot, batch, dtype, name)) for name in KINEMATICS]
        if base is not None and any(computed):
            cells = ["" if x is None else f"{x / base:.2f}" for x in computed]
            lines.append(f"| {robot} | {batch} | {dtype} | {' | '.join(cells)} |")
    return lines


INVERSE_HEAD = f"| robot | batch | dtype | {' | '.join(KINEMATICS)} |\n|---|---|---|---|---|---|---|"


def in_loops(name, batch, calls, rounds):
    """Forward dynamics of a given model, alone and in a scan of calls, next to Pinocchio; a row."""
    model, source = load(name)
    (q, v, tau), q_pin = states(model, batch, jnp.float64)
    several = jax.vmap(jd.forward_dynamics, (None, 0, 0, 0))

    def repeated(model, q, v, tau):
        return jax.lax.scan(lambda v, _: (v + 1e-6 * several(model, q, v, tau), None), v, None, calls)[0]

    pool, out = pin.ModelPool(source, THREADS), np.zeros((source.nv, batch), order="F")
    threads = min(THREADS, batch)
    q_, v_, tau_ = (np.asfortranarray(np.asarray(x, float).T) for x in (q_pin, v, tau))
    alone, scanned = (jax.jit(f).lower(model, q, v, tau).compile() for f in (several, repeated))
    computed = timing.time_alternately(
        {
            "alone": lambda: jax.block_until_ready(alone(model, q, v, tau)),
            "in a scan": lambda: jax.block_until_ready(scanned(model, q, v, tau)),
            "pin": lambda: pin.abaInParallel(threads, pool, q_, v_, tau_, out),
        },
        rounds,
    )
    per = {"alone": batch, "in a scan": batch * calls, "pin": batch}
    times = {key: {kind: 1e6 * computed[key][kind] / per[key] for kind in ("best", "median")} for key in per}
    row = {"robot": name, "batch": batch, "calls": calls, "threads": threads, "us": times}
    print(loop_line(row), flush=True)
    return row


def loop_line(row):
    """One row of the table of loops."""
    cells = [row["robot"], str(row["batch"])]
    for key in ("alone", "in a scan"):
        here, peer = row["us"][key], row["us"]["pin"]
        cells += ["{best:.3g} ({median:.3g})".format(**here), f"{here['best'] / peer['best']:.2f}"]
    cells += ["{best:.3g} ({median:.3g})".format(**row["us"]["pin"]), f"{row['threads']} threads"]
    return "| " + " | ".join(cells) + " |"


LOOP_HEAD = "| robot | batch | alone us | ratio | in a scan us | ratio | Pinocchio us | with |\n|---|---|---|---|---|---|---|---|"


def rollout(name, batch, rounds, steps=100, dt=1e-3):
    """Steps per second of RK4 rollouts inside one jitted scan: does the speed survive a user's own loop?"""
    model, _ = load(name)
    (q, v, tau), _ = states(model, batch, jnp.float64)

    def rate(state, tau):
        q, v = state
        return v, jd.forward_dynamics(model, q, v, tau)

    def one(q, v, tau):
        def step(state, _):
            shift = lambda k, h: jax.tree.map(lambda x, y: x + h * y, state, k)  # noqa: E731
            k1 = rate(state, tau)
            k2 = rate(shift(k1, dt / 2), tau)
            k3 = rate(shift(k2, dt / 2), tau)
            k4 = rate(shift(k3, dt), tau)
            mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
            return shift(mean, dt), None

        return jax.lax.scan(step, (q, v), None, length=steps)[0]

    executable, trace, build = compiled(jax.vmap(one), q, v, tau)
    result = timing.time_alternately(
        {"rk4": lambda: jax.block_until_ready(executable(q, v, tau))}, rounds, minimum=0.0
    )["rk4"]
    row = {"robot": name, "batch": batch, "steps": steps, "trace_s": trace, "compile_s": build}
    row |= {
        "steps_per_s": batch * steps / result["best"],
        "us_per_evaluation": 1e6 * result["best"] / (4 * batch * steps),
    }
    print(
        f"RK4 rollout of {batch} {name}: {row['steps_per_s']:.3g} steps/s, {row['us_per_evaluation']:.3g} us per evaluation"
    )
    return row


def eager(name, batch):
    """One eager call of a batch against the compiled one (s), second call each."""
    model, _ = load(name)
    args, _ = states(model, batch, jnp.float64)
    call = jax.vmap(lambda *x: jd.forward_dynamics(model, *x))
    fast = jax.jit(call)
    result = {}
    for label, function in (("eager", call), ("jit", fast)):
        jax.block_until_ready(function(*args))
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        result[label] = time.perf_counter() - start
    print(f"{name}, batch {batch}: eager {result['eager']:.3g} s, jit {result['jit']:.3g} s")
    return {"robot": name, "batch": batch} | result


def main(argv=None):
    """Run the benchmark; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(FILES), choices=list(FILES))
    parser.add_argument("--batches", nargs="+", type=int, default=[1, 256, 4096])
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--functions", nargs="+", default=None)
    parser.add_argument("--loop-batches", nargs="*", type=int, default=[1, 300, 5000])
    parser.add_argument("--calls", type=int, default=10, help="evaluations in a scan")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--readme", action="store_true", help="write into README.md and docs/benchmarks.md")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    report = {"machine": timing.machine(), "rows": [], "loops": [], "rollouts": [], "eager": []}
    print(report["machine"])
    print(HEAD)
    for name in options.robots:
        for dtype in options.dtypes:
            for batch in options.batches:
                report["rows"] += measure(name, batch, jnp.dtype(dtype), options.rounds, options.functions)
                timing.write("benchmark_dynamics", report)
    inverse = against_inverse_dynamics(report["rows"])
    print("\n".join(["kinematics / inverse dynamics", INVERSE_HEAD, *inverse]))
    print(LOOP_HEAD)
    for name in options.robots:
        for batch in options.loop_batches:
            report["loops"].append(in_loops(name, batch, options.calls, options.rounds))
    if not options.functions:
        report["rollouts"].append(rollout("panda", 1024, options.rounds))
        report["eager"].append(eager("panda", 1024))
    print("written to", timing.write("benchmark_dynamics", report))
    if options.readme:
        write(report, options, inverse)


# Of the rows with float64, those that README.md has.
SHOWN = (
    ("panda", "forward dynamics", 4096), ("panda", "forward dynamics", 256), ("panda", "gradient of forward dynamics", 4096),
    ("panda", "frame pose", 4096), ("g1", "forward dynamics", 4096), ("g1", "gradient of forward dynamics", 4096),
)  # fmt: skip


def write(report, options, inverse):
    """Write six rows into README.md, and all of them into docs/benchmarks.md."""
    about = report["machine"]
    note = (
        f"Microseconds per evaluation, best (median) of {options.rounds} interleaved rounds; ratios to Pinocchio in the same "
        f"run; {about['processor']}, {about['cores']} cores, jax {about['versions']['jax']}, pin {about['versions']['pin']}. "
        "Made by `python -m benchmarks.dynamics --readme`"
    )
    rows = {(row["robot"], row["function"], row["batch"]): row for row in report["rows"] if row["dtype"] == "float64"}
    six = "\n".join([HEAD, *(line(rows[key]) for key in SHOWN if key in rows)])
    full = "\n".join([HEAD, *(line(row) for row in report["rows"])])
    relative = "\n".join(["Kinematics, time relative to inverse dynamics:", "", INVERSE_HEAD, *inverse])
    loops = "\n".join(
        [
            f"Forward dynamics of a given model, called alone and in a scan of {options.calls} calls; ratios to Pinocchio:",
            "",
            LOOP_HEAD,
            *(loop_line(row) for row in report["loops"]),
        ]
    )
    rollouts = "\n".join(
        f"An RK4 rollout of {row['batch']} {row['robot']} in a jitted scan made {row['steps_per_s']:.3g} steps per second, "
        f"{row['us_per_evaluation']:.3g} us per evaluation."
        for row in report["rollouts"]
    )
    root = Path(__file__).resolve().parent.parent
    more = " (all rows: [docs/benchmarks.md](docs/benchmarks.md))."
    for path, parts in (
        (root / "README.md", (note + more, six)),
        (root / "docs/benchmarks.md", (note + ".", full, relative, loops, rollouts)),
    ):
        text = re.sub(
            r"(<!-- benchmark:begin -->\n).*(<!-- benchmark:end -->)",
            lambda computed, parts=parts: computed[1] + "\n\n".join(x for x in parts if x) + "\n" + computed[2],
            path.read_text(),
            flags=re.DOTALL,
        )
        path.write_text(text)


if __name__ == "__main__":
    main()
