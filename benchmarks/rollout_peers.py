"""Rollouts a second of jaxdyn, MJX, frax and C MuJoCo, on all cores, in turns.

    python -m benchmarks.rollout_peers [panda g1 disk hand windows] [--batch 1024] [--steps 100] [--rounds 5] [--mjx 2] [--mjx-g1]

A rollout is `steps` steps of RK4 of 1 ms, from random states, of which the last state is kept; constant torques for the robots.
Robots are read by all from one URDF, without joint limits, damping and friction; end states are compared first. C MuJoCo runs
in its own threads (`mujoco.rollout`), as many as there are cores. The forward dynamics of frax, which has no integrator, and of
MJX are stepped by the RK4 below, compiled with it; MJX computes `--mjx` rollouts, since its time for each grows with their
number on a CPU (16 of a Panda take 200 s). They read no floating base from a URDF
as we write it: the G1 stands on a fixed base here, with 29 joints; MJX compiles it for minutes: `--mjx-g1`. Rolling without
slip, a hand with rolling contacts and forty windows whose loops stay closed are in none of the three: those rows are ours alone.
"""

import argparse
import os
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import jax_peers, timing
from benchmarks.dynamics import FILES, ROBOTS
from jaxdyn.compile import wait_for_code

DT = 1e-3


def rk4(acceleration, q, v, tau, steps: int):
    """End of a rollout of a fixed base with joints of one coordinate each."""

    # The stages are a loop too: the accelerations are compiled once.
    stages = jnp.array([[0.0, 1.0], [0.5, 2.0], [0.5, 2.0], [1.0, 1.0]])

    def step(_, state):
        def stage(computed, at):
            rate, total = computed
            here = [x + DT * at[0] * slope for x, slope in zip(state, rate, strict=True)]
            rate = [here[1], acceleration(*here, tau)]
            return (rate, [x + at[1] * slope for x, slope in zip(total, rate, strict=True)]), None

        none = [jnp.zeros_like(x) for x in state]
        total = jax.lax.scan(stage, (none, none), stages)[0][1]
        return tuple(x + DT / 6 * slope for x, slope in zip(state, total, strict=True))

    return jax.lax.fori_loop(0, steps, step, (q, v))


def with_mujoco(model, q, v, tau, steps: int):
    """The same by `mujoco.rollout` with a thread for each core."""
    import tempfile
    from pathlib import Path

    import mujoco
    from mujoco import rollout

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.urdf"
        jd.save_urdf(model, path)
        source = mujoco.MjModel.from_xml_path(str(path))
    source.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    source.opt.integrator, source.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, DT
    source.dof_damping[:], source.dof_frictionloss[:] = 0.0, 0.0
    data = [mujoco.MjData(source) for _ in range(os.cpu_count() or 1)]
    blank = np.zeros(mujoco.mj_stateSize(source, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    states = np.tile(blank, (len(q), 1))
    states[:, 1 : 1 + model.nq], states[:, 1 + model.nq : 1 + model.nq + model.nv] = q, v
    control = np.repeat(np.asarray(tau)[:, None], steps, 1)
    kind = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)

    def call():
        with rollout.Rollout(nthread=len(data)) as runner:
            computed, _ = runner.rollout(source, data, states, control, control_spec=kind, nstep=steps)
        return computed[:, -1, 1 : 1 + model.nq]

    return call


def robot(name: str, batch: int, steps: int, of_mjx: int, mjx_g1: bool) -> dict:
    """Calls that return the last positions of a batch, by the library's name."""
    file, _, lock = FILES[name]
    model = jd.load_model(ROBOTS / file, lock=lock).replace(damping=None, friction=None)
    q, v, tau = (0.5 * x for x in np.random.default_rng(0).normal(size=(3, batch, model.nv)))
    ts = DT * np.array([0.0, steps])

    def ours(q, v, tau):
        law = jax.tree_util.Partial(_constant, tau)
        return jd.simulate(model, q, v, ts, control=law, stepsize=DT, throw=False).q[-1]

    calls = {"jaxdyn": _compiled(ours, q, v, tau)}
    for peer, acceleration in jax_peers.forward_dynamics(model).items():
        if peer == "MJX" and name == "g1" and not mjx_g1:
            continue
        some = [x[: batch if peer != "MJX" else of_mjx] for x in (q, v, tau)]
        calls[peer] = _compiled(lambda q, v, tau, f=acceleration: rk4(f, q, v, tau, steps)[0], *some)
    try:
        calls["C MuJoCo"] = with_mujoco(model, q, v, tau, steps)
    except ImportError:
        print("mujoco is not installed")
    return calls


def _constant(tau, q, v, t):
    return tau


def scene(name: str, batch: int, steps: int) -> dict:
    """Of scenes that only we can."""
    if name == "windows":
        built, (q, v) = jd.scenes.windows(count=40), jd.scenes.windows.start(count=40)
    else:
        named = {"disk": jd.scenes.rolling_disk, "hand": jd.scenes.hand_with_ball}[name]
        built, (q, v) = named(), named.start()
    # Nothing grips the ball: its contacts hold on both sides.
    free = {"events": [jd.events.ContactLost(stop=False)]} if name == "hand" else {}
    ts = DT * np.array([0.0, steps])
    speeds = np.linspace(0.5, 1.5, batch)[:, None]

    def ours(q, v):
        return jd.simulate(built, q, v, ts, stepsize=DT, throw=False, **free).q[-1]

    return {"jaxdyn": _compiled(ours, np.tile(q, (batch, 1)), speeds * np.asarray(v))}


def _compiled(function, *args):
    args = [jnp.asarray(x) for x in args]
    before = time.perf_counter()
    program = jax.jit(jax.vmap(function)).lower(*args).compile()
    print(f"  traced and compiled in {time.perf_counter() - before:.1f} s", flush=True)
    np.asarray(program(*args))
    wait_for_code()
    return lambda: np.asarray(program(*args))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ("panda", "g1", "disk", "hand", "windows")
    parser.add_argument("names", nargs="*", default=names)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--mjx", type=int, default=2, help="rollouts that MJX computes")
    parser.add_argument("--mjx-g1", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in timing.chosen_names(args.names, names):
        batch = args.batch if name != "windows" else max(1, args.batch // 16)
        print(name, flush=True)
        if name in FILES:
            calls = robot(name, batch, args.steps, args.mjx, args.mjx_g1)
        else:
            calls = scene(name, batch, args.steps)
        first = {}
        for peer, call in calls.items():
            before = time.perf_counter()
            first[peer] = call()
            if not np.isfinite(first[peer]).all():
                raise RuntimeError(f"{name}: {peer} gives rollouts that did not reach their end")
            difference = np.abs(first[peer] - first["jaxdyn"][: len(first[peer])]).max()
            print(
                f"  {peer}: {time.perf_counter() - before:.2g} s, last positions at most {difference:.1e} from ours",
                flush=True,
            )
        times = timing.time_alternately(calls, args.rounds, minimum=0.0)
        best = {peer: len(first[peer]) / row["best"] for peer, row in times.items()}
        rows.append(
            [name, batch, *(f"{best[p]:.3g}" if p in best else "-" for p in ("jaxdyn", "C MuJoCo", "MJX", "frax"))]
        )
    print(
        f"\nrollouts a second, {args.steps} steps of RK4, float64, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}"
    )
    print("| | batch | jaxdyn | C MuJoCo | MJX | frax |\n|---|---|---|---|---|---|")
    for row in rows:
        print("| " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    main()
