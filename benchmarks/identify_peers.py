"""Time to the same loss: `jd.identify.fit_parameters` and `mujoco.sysid`, same arm, log and free numbers, as a Markdown table.

    python -m benchmarks.identify_peers [CASE ...] [--limit 120] [--data ../shared/data]

The arm is a Franka Emika Panda and the log has its recorded motion; torques are those of bodies that differ by some 15 %, with
1 % of noise. Free are the ten numbers of the last bodies, without a prior, from the URDF's. Compared are torques at every sample
("torque"), or the motion of pieces of ten steps of RK4 with the torque held over each step ("motion"). Sums of squares are told
as shares of that where the fit starts, and the time is that of the first point within 1 % of the minimum: of torques of the lower
one of both, as the losses are the same to rounding; of motions of each one's own.

Each program runs in a process of its own. "cold" is its first fit there, compilation and all, with an empty folder of object
files; "warm" the second fit of the same numbers. sysid compiles nothing, so that its time is one number; it stops after `--limit`
seconds. Chains of bodies with torques from their own dynamics and 1 % of noise are fitted by ours alone.

The peer needs `pip install "mujoco[sysid]"`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
STEPS = 10  # of a piece
SPREAD = 0.15  # of the log-Cholesky coordinates of bodies about the model's: what is to be told
NEAR = 1.01
PRIOR = 1e-3


class Case(NamedTuple):
    """What is fitted: how it is judged, how many bodies are free, and how many samples the log has."""

    error: str
    free: int
    samples: int
    arm: str = "Franka"
    by: str = "fit_parameters"


CASES = {
    "torque-10": Case("torque", 1, 665),
    "torque-30": Case("torque", 3, 665),
    "torque-70": Case("torque", 7, 665),
    "convex-70-short": Case("torque", 7, 166, by="fit_torques"),
    "convex-70": Case("torque", 7, 665, by="fit_torques"),
    "convex-70-long": Case("torque", 7, 2660, by="fit_torques"),
    "motion-10": Case("motion", 1, 665),
    "motion-30": Case("motion", 3, 665),
    "motion-70": Case("motion", 7, 665),
    "chain-100": Case("torque", 10, 665, "chain of 10", "fit_torques"),
    "chain-150": Case("torque", 15, 665, "chain of 15", "fit_torques"),
    "chain-300": Case("torque", 30, 665, "chain of 30", "fit_torques"),
}


def problem(case: Case, data: Path):
    """Model, log and names of the free bodies."""
    from benchmarks.identify_franka import panda, samples
    from jaxdyn import identify

    if case.arm != "Franka":
        return *chain(case.free, case.free, case.samples), tuple(f"link{i}" for i in range(case.free))
    model, raw = panda(), samples(data)
    rate = (len(raw) - 1) / float(raw.t[-1] - raw.t[0])
    log = identify.from_raw(raw.t, raw.q, raw.tau)
    # Other lengths: the same motion sampled more finely, or a part of it.
    if case.samples > len(log):
        every = max(1, int(rate / (15 * 8.0)) * len(log) // case.samples)
        log = identify.from_raw(raw.t, raw.q, raw.tau, every=every)
    log = log[: case.samples]
    t = np.linspace(log.t[0], log.t[-1], len(log))  # even to the last bit
    tau = noisy(model, case.free, log.q, log.v, log.a)
    return model, identify.Log(t, log.q, log.v, log.a, tau), model.body_names[model.nb - case.free :]


def chain(count: int, free: int, samples: int):
    """A chain of joints in changing directions, and a log of its motion."""
    import jaxdyn as jd
    from jaxdyn import identify

    builder, parent, generator = jd.ModelBuilder("chain"), None, np.random.default_rng(0)
    for i in range(count):
        body = (1.0, (0.02, 0.01, -0.1), (0.01, 0.009, 0.004))
        pose = np.eye(4)
        pose[2, 3] = -0.2 if i else 0.0
        builder.add_body(f"link{i}", parent, inertia=body, axis=np.eye(3)[i % 3], pose=pose)
        parent = f"link{i}"
    model = builder.build()
    t = np.linspace(0, 0.02 * (samples - 1), samples)[:, None, None]
    w = 2 * np.pi * generator.uniform(0.05, 0.6, (4, count))
    size, phase = generator.uniform(0.1, 0.4, (4, count)), generator.uniform(0, 2 * np.pi, (4, count))
    waves = (np.sin(w * t + phase), w * np.cos(w * t + phase), -(w**2) * np.sin(w * t + phase))
    q, v, a = (np.sum(size * x, axis=1) for x in waves)
    return model, identify.Log(t[:, 0, 0], q, v, a, noisy(model, free, q, v, a))


def noisy(model, free: int, q, v, a) -> np.ndarray:
    """Torques of an arm whose last bodies differ from the model's, with noise of 1 % of each one's root mean square."""
    import jax
    import jax.numpy as jnp

    from jaxdyn import identify, inertia

    generator, inertias = np.random.default_rng(0), model.inertias
    change = jnp.where(
        jnp.arange(model.nb)[:, None] < model.nb - free, 0.0, SPREAD * generator.normal(size=(model.nb, 10))
    )
    moved = jax.vmap(lambda x, step: inertia.from_log_cholesky(inertia.to_log_cholesky(x) + step))(inertias, change)
    truth = model.replace(inertias=moved)
    tau = identify.regressor(truth, q, v, a) @ identify.nominal_parameters(truth)
    return tau + 0.01 * np.sqrt(np.mean(tau**2, axis=0)) * generator.normal(size=tau.shape)


def ours(case: Case, data: Path, limit: float) -> dict:
    """Paths (seconds, share of the first loss) of the first fit and of the second one."""
    from jaxdyn import identify
    from jaxdyn.constraints.codes import name_of
    from jaxdyn.identify.condensed_fit import Setting
    from jaxdyn.identify.robot_logs import RobotLogs
    from jaxdyn.simulation.solvers import RK4

    model, log, bodies = problem(case, data)
    objective = identify.Objective("torque")
    if case.error == "motion":
        objective = identify.Objective(horizon=STEPS, hold="previous", substeps=1, simulation={"solver": RK4()})
    paths, weights = [], 1 / np.sqrt(np.mean(np.asarray(log.tau) ** 2, axis=0))

    def squares(x) -> float:
        torques = identify.regressor(model, log.q, log.v, log.a) @ x
        return float(np.sum((weights * (torques - np.asarray(log.tau))) ** 2))

    for _ in range(2):
        path, begun = [], time.perf_counter()

        def watch(step, loss, *point, path=path, begun=begun):
            path.append((time.perf_counter() - begun, point if case.by == "fit_torques" else float(loss)))

        if case.by == "fit_torques":
            # All bodies at once, by the convex fit; its loss has a prior, which here weighs next to nothing.
            robot = RobotLogs(model, (log,), (), (), "full", 1)
            robot.weights = weights
            estimate = robot.fit(Setting(0.01, (), PRIOR), callback=watch)
            fit, end = robot.result(Setting(0.01, (), PRIOR), estimate), time.perf_counter() - begun
            path[:] = [
                (0.0, squares(identify.nominal_parameters(model))),
                *((seconds, squares(robot.chart.x(*point))) for seconds, point in path[1:]),
                (end, squares(estimate.x)),
            ]
        else:
            tree = identify.Parameters(model).inertias(bodies, metric=None)
            fit = identify.fit_parameters(model, log, tree, objective, execution=identify.Execution(callback=watch))
        paths.append([(seconds, loss / path[0][1]) for seconds, loss in path])
        ended = f"{name_of(fit.result)}, {len(path) - 1} steps, {time.perf_counter() - begun:.1f} s"
    return {"paths": paths, "ended": ended, "samples": len(log)}


def theirs(case: Case, data: Path, limit: float) -> dict:
    """The path of the one fit."""
    from benchmarks.peers import with_sysid

    model, log, bodies = problem(case, data)
    spec = with_sysid.specification(model, float(log.t[1] - log.t[0]))
    tau = np.asarray(log.tau)
    if case.error == "torque":
        residual = with_sysid.torque_residual(spec, log, np.sqrt(np.mean(tau**2, axis=0)))
    else:
        count = (len(log) - 1) // STEPS
        rows = STEPS * np.arange(count)[:, None] + np.arange(STEPS + 1)
        pieces = [np.asarray(x)[rows] for x in (log.t, log.q, log.v, log.tau)]
        way = pieces[1] - pieces[1][0, 0]
        scale = np.stack([np.sqrt(np.mean(x**2, axis=(0, 1))) for x in (way, pieces[2])])
        residual = with_sysid.motion_residual(spec, pieces, scale)
    path, ended = with_sysid.fitted(residual, with_sysid.parameters(spec, bodies), limit)
    return {"paths": [[(seconds, loss / path[0][1]) for seconds, loss in path]], "ended": ended}


def apart(program: str, name: str, options) -> dict | None:
    """One program on one case in a process of its own; None where it cannot run."""
    command = [sys.executable, "-m", "benchmarks.identify_peers", name, "--only", program]
    command += ["--limit", str(options.limit), "--data", str(options.data)]
    with tempfile.TemporaryDirectory() as cache:
        done = subprocess.run(
            command, env={**os.environ, "XDG_CACHE_HOME": cache}, cwd=ROOT, capture_output=True, text=True, check=False
        )
    if done.returncode:
        print(f"{program} on {name} failed: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def reached(path, target: float) -> float | None:
    """Seconds to the first point at or below a loss."""
    return next((seconds for seconds, loss in path if loss <= target), None)


def row(name: str, case: Case, options) -> str:
    """One row of the table."""
    mine = apart("ours", name, options)
    peer = apart("sysid", name, options) if case.arm == "Franka" else None
    if mine is None:
        return f"| {name} | failed |"
    least, lowest = (
        min((loss for path in (one or {"paths": []})["paths"] for _, loss in path), default=np.inf)
        for one in (mine, peer)
    )
    if case.error == "torque":
        least = min(least, lowest)
    cold, warm = (reached(path, NEAR * least) for path in mine["paths"])
    cells = [
        case.arm,
        case.error,
        10 * case.free,
        mine["samples"],
        case.by,
        f"{100 * least:.3g} %",
        *map(shown, (cold, warm)),
    ]
    if peer is None:
        cells += ["not run", "", ""]
    else:
        seconds = reached(peer["paths"][0], NEAR * (least if case.error == "torque" else lowest))
        seconds = None if case.error == "motion" and peer["ended"].startswith("not") else seconds
        words = shown(seconds) if seconds else f"{peer['ended']}, {100 * (lowest / least - 1):.3g} % above"
        total = seconds or (options.limit if peer["ended"].startswith("not") else None)
        mark = "" if seconds else "> "
        cells += [words, *(f"{mark}{total / own:.0f}" if total and own else "" for own in (cold, warm))]
    print(f"{name}: ours {mine['ended']}; sysid {'not run' if peer is None else peer['ended']}", file=sys.stderr)
    return "| " + " | ".join(map(str, cells)) + " |"


def shown(seconds: float | None) -> str:
    """Seconds in three digits."""
    return "not reached" if seconds is None else f"{seconds:.3g} s"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], metavar="CASE", help=f"some of {', '.join(CASES)}")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds that the peer may take for a fit")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--only", choices=("ours", "sysid"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        import jax

        jax.config.update("jax_enable_x64", True)
        (name,) = options.cases
        print(json.dumps({"ours": ours, "sysid": theirs}[options.only](CASES[name], options.data, options.limit)))
        return
    heads = ("arm", "error", "free", "samples", "ours", "loss / first", "ours cold", "ours warm", "sysid")
    print("| " + " | ".join((*heads, "sysid / cold", "sysid / warm")) + " |")
    print("|" + "---|" * (len(heads) + 2))
    for name in options.cases or CASES:
        print(row(name, CASES[name], options), flush=True)


if __name__ == "__main__":
    main()
