"""What a user waits for: seconds of the import, of a first call and of a second one, each case in a fresh process.

    python -m benchmarks.first_calls [CASE ...] [--rounds 3] [--clock cpu]

Every case runs in two processes, one after the other. The first one has an empty folder of object files, the second one finds
those of the first; JAX's own cache of programs is off in both, and Python has compiled the modules before, as pip does. "build"
is the time to read or build the mechanism, and to bring it to a start. A call is timed to its end. Numbers are the best of the
rounds. Processor time ("cpu", of all threads) holds on a busy machine too.
"""

import argparse
import compileall
import importlib.util
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent.parent
STEPS = ("import", "build", "first call", "second call")
PANDA = "panda_description/urdf/panda.urdf", False, ("panda_finger_joint1", "panda_finger_joint2")
G1 = "g1_description/urdf/g1_29dof_rev_1_0.urdf", True, ()


def robot_file(file: str) -> Path:
    """Path of a file of the package example-robot-data."""
    found = importlib.util.find_spec("pinocchio")  # beside which the files lie; it is not imported
    if found is None or found.origin is None:
        raise SystemExit("pinocchio and example-robot-data are not installed")
    return Path(found.origin).parents[4] / "share/example-robot-data/robots" / file


def robot(file: str, floating: bool, lock: tuple[str, ...]):
    """A robot of the package example-robot-data, and a state q, v, tau."""
    import jax.numpy as jnp

    import jaxdyn as jd

    model = jd.load_model(robot_file(file), floating_base=floating, lock=lock)
    return model, jd.neutral(model), jnp.full(model.nv, 0.1), jnp.zeros(model.nv)


def accelerate(which) -> Callable:
    """Forward dynamics of a known robot."""
    import jax

    import jaxdyn as jd

    model, *state = robot(*which)
    run = jax.jit(lambda q, v, tau: jd.forward_dynamics(model, q, v, tau))
    return lambda: run(*state)


def gradient_of_g1() -> Callable:
    """Derivative of the sum of a G1's accelerations by q, v and tau."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    model, *state = robot(*G1)
    run = jax.jit(jax.grad(lambda *x: jnp.sum(jd.forward_dynamics(model, *x)), (0, 1, 2)))
    return lambda: run(*state)


def simulate_panda() -> Callable:
    """One second of the arm as it falls, adaptive steps."""
    import jax.numpy as jnp

    import jaxdyn as jd

    model, q, v, _ = robot(*PANDA)
    return lambda: jd.simulate(model, q, v, jnp.linspace(0.0, 1.0, 11)).q


def gradient_of_panda() -> Callable:
    """Derivative of where the arm is after 100 steps of RK4 by where it started."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    model, q, v, _ = robot(*PANDA)
    ts = jnp.asarray([0.0, 0.1])
    run = jax.jit(jax.grad(lambda q: jnp.sum(jd.simulate(model, q, v, ts, stepsize=1e-3).q[-1])))
    return lambda: run(q)


def simulate_four_bar() -> Callable:
    """One second of a loop of four bars."""
    import jax.numpy as jnp

    import jaxdyn as jd

    scene, (q, v) = jd.scenes.four_bar(), jd.scenes.four_bar.start()
    return lambda: jd.simulate(scene, q, v, jnp.linspace(0.0, 1.0, 11)).q


def gradient_of_four_bar() -> Callable:
    """Derivative of where a four-bar is after a second by the masses of its bars."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    (q, v), ts = jd.scenes.four_bar.start(), jnp.linspace(0.0, 1.0, 11)

    def end(masses):
        return jnp.sum(jd.simulate(jd.scenes.four_bar(masses=masses), q, v, ts).q[-1] ** 2)

    run = jax.jit(jax.grad(end))
    return lambda: run(jnp.array([1.0, 3.0, 2.5]))


def four_bar_by_hand() -> tuple[Callable, Any]:
    """The motion of the same four-bar by its masses, written without jaxdyn, and its masses: what a user would write.

    Lagrange's equations with multipliers, whose terms are derivatives by JAX, integrated by diffrax.
    """
    import diffrax
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    lengths, ground, ts = jnp.array([1.0, 3.0, 2.5]), jnp.array([3.5, 0.0]), jnp.linspace(0.0, 1.0, 11)

    def bars(q):
        """Starts, directions and angles of crank, coupler and rocker."""
        angles = jnp.array([q[0], q[0] + q[1], q[2]])
        directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], 1)
        return jnp.stack([jnp.zeros(2), lengths[0] * directions[0], ground]), directions, angles

    def centres(q):
        starts, directions, angles = bars(q)
        return starts + 0.5 * lengths[:, None] * directions, angles

    def closure(q):
        starts, directions, _ = bars(q)
        return starts[1] + lengths[1] * directions[1] - starts[2] - lengths[2] * directions[2]

    def lagrangian(q, v, masses):
        (places, _), (rates, turning) = jax.jvp(centres, (q,), (v,))
        kinetic = 0.5 * jnp.sum(masses * (jnp.sum(rates**2, 1) + lengths**2 / 12 * turning**2))
        return kinetic - 9.81 * jnp.sum(masses * places[:, 1])

    def rates(t, state, masses):
        q, v = state
        mass = jax.hessian(lagrangian, 1)(q, v, masses)
        _, change = jax.jvp(lambda q: jax.grad(lagrangian, 1)(q, v, masses), (q,), (v,))
        force = jax.grad(lagrangian)(q, v, masses) - change
        rows = jax.jacobian(closure)(q)
        _, bias = jax.jvp(lambda q: jax.jvp(closure, (q,), (v,))[1], (q,), (v,))
        matrix = jnp.block([[mass, rows.T], [rows, jnp.zeros((2, 2))]])
        return v, jnp.linalg.solve(matrix, jnp.concatenate([force, -bias]))[:3]

    def path(masses):
        steps, saved = diffrax.PIDController(rtol=1e-8, atol=1e-8), diffrax.SaveAt(ts=ts)
        args = diffrax.ODETerm(rates), diffrax.Dopri8(), 0.0, 1.0, None, jd.scenes.four_bar.start(), masses
        states: Any = diffrax.diffeqsolve(*args, saveat=saved, stepsize_controller=steps).ys
        return states[0]

    return path, jnp.array([1.0, 3.0, 2.5])


def simulate_by_hand() -> Callable:
    """`simulate_four_bar` by hand."""
    import jax

    path, masses = four_bar_by_hand()
    run = jax.jit(path)
    return lambda: run(masses)


def gradient_by_hand() -> Callable:
    """`gradient_of_four_bar` by hand."""
    import jax
    import jax.numpy as jnp

    path, masses = four_bar_by_hand()
    run = jax.jit(jax.grad(lambda masses: jnp.sum(path(masses)[-1] ** 2)))
    return lambda: run(masses)


def gradient_of_path() -> Callable:
    """Derivative of eight assembled positions of a four-bar by the lengths of its bars."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    q, v = jd.scenes.four_bar.start()

    def path(lengths):
        scene = jd.scenes.four_bar(lengths=lengths)
        cranks = jnp.linspace(0.3, 0.6, 8)
        return jnp.sum(jax.vmap(lambda crank: jd.assemble(scene, q.at[0].set(crank), v).q)(cranks) ** 2)

    run = jax.jit(jax.grad(path))
    return lambda: run(jnp.array([1.0, 3.0, 2.5, 3.5]))


def stewart():
    """A Stewart platform and a guess of a position: a plate on six legs with universal, prismatic and ball joints."""
    import jax.numpy as jnp
    import numpy as np

    import jaxdyn as jd

    def on_circle(radius, degrees):
        return (radius * math.cos(math.radians(degrees)), radius * math.sin(math.radians(degrees)), 0.0)

    builder, loops, legs = jd.ModelBuilder("stewart platform"), [], range(6)
    builder.add_body("plate", None, "free", (20.0, (0.0, 0.0, 0.0), (2.0, 2.0, 4.0)))
    for i in legs:
        middle, side = 120 * (i // 2), 2 * (i % 2) - 1
        anchor = on_circle(1.0, middle + 10 * side)
        builder.add_body(f"yoke{i}", None, "revolute", (0.1, (0.0, 0.0, 0.0), (1e-3,) * 3), axis=(1, 0, 0), pose=anchor)
        builder.add_body(f"sleeve{i}", f"yoke{i}", "revolute", (3.0, (0.0, 0.0, 0.3), (0.1, 0.1, 0.01)), axis=(0, 1, 0))
        builder.add_body(
            f"rod{i}", f"sleeve{i}", "prismatic", (1.0, (0.0, 0.0, -0.3), (0.05, 0.05, 0.005)), axis=(0, 0, 1)
        )
        corner = on_circle(0.6, middle + 50 * side)
        loops.append(jd.loop(f"rod{i}", None, "plate", corner, "spherical", name=f"ball{i}"))
    model = builder.build()
    q = np.array(jd.neutral(model))
    place = dict(zip(model.body_names, model.topology.q_slices, strict=True))
    q[place["plate"]][2] = 1.2
    for i in legs:
        q[place[f"rod{i}"]] = 1.3
    return jd.Scene(model, tuple(loops)), jnp.asarray(q)


def accelerate_stewart() -> Callable:
    """Accelerations under six loops, under jit, at a guess of a position."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    scene, q = stewart()
    run = jax.jit(lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration)
    return lambda: run(q, jnp.zeros(scene.nv))


def assemble_stewart() -> Callable:
    """From a guess onto six loops."""
    import jax.numpy as jnp

    import jaxdyn as jd

    scene, q = stewart()
    return lambda: jd.assemble(scene, q, jnp.zeros(scene.nv)).q


def simulate_stewart() -> Callable:
    """A tenth of a second of the platform as it falls; it is assembled before."""
    import jax.numpy as jnp

    import jaxdyn as jd

    scene, q = stewart()
    start = jd.assemble(scene, q, jnp.zeros(scene.nv))
    return lambda: jd.simulate(scene, start.q, start.v, jnp.linspace(0.0, 0.1, 3)).q


def assemble_delta() -> Callable:
    """A delta robot with six rods on balls, read from MJCF and assembled."""
    import jaxdyn as jd
    from benchmarks.linkages import delta

    def load_and_assemble():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "delta.xml"
            path.write_text(delta())
            scene = jd.load(path)
        return jd.assemble(scene, scene.starts["reference"].q).q

    return load_and_assemble


def gradient_of_legs() -> Callable:
    """Derivative of where 256 quadrupeds on four held feet are after 50 steps by a gain of their joints."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    model = jd.robots.quadruped()
    legs = jnp.tile(jnp.array([0.0, 0.8, -1.6]), 4)
    q = jd.neutral(model).at[7:].set(legs)
    feet = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
    loops = [jd.loop(foot, None, None, tuple(jd.frame_pose(model, q, foot)[:3, 3]), "spherical") for foot in feet]
    step = jd.stepper(jd.Scene(model, loops), dt=0.005)

    def place(gain, v):
        def advance(state, _):
            q, v = state
            return step(state, jnp.concatenate([jnp.zeros(6), gain * (legs - q[7:]) - 2.0 * v[6:]])), None

        return jnp.sum(jax.lax.scan(advance, (q, v), length=50)[0][0] ** 2)

    run = jax.jit(jax.grad(lambda gain, vs: jnp.mean(jax.vmap(lambda v: place(gain, v))(vs))))
    return lambda: run(60.0, jnp.zeros((256, model.nv)))


def jacobian_of_step() -> Callable:
    """Jacobian of one step of a four-bar by its state."""
    import jax

    import jaxdyn as jd

    step, (q, v) = jd.stepper(jd.scenes.four_bar(), dt=0.01), jd.scenes.four_bar.start()
    run = jax.jit(jax.jacrev(lambda q, v: step((q, v), 0.0 * v), (0, 1)))
    return lambda: run(q, v)


def plan_cart_pole() -> Callable:
    """A swing-up of a cart-pole by iterated LQR with limits of the force, 40 steps."""
    import jax
    import jax.numpy as jnp

    import jaxdyn as jd

    builder = jd.ModelBuilder("cart-pole")
    builder.add_body("cart", None, "prismatic", jd.inertia.box(1.0, (0.2, 0.2, 0.1)), axis=(1, 0, 0))
    builder.add_body("pole", "cart", "continuous", (0.2, (0, 0, -0.5), (0.01, 0.01, 0.0)), axis=(0, 1, 0))
    robot = builder.build()
    advance, motors = jd.stepper(robot, dt=0.04), robot.selection_matrix(["cart_joint"])

    def upright(x):
        return 20 * (1 + jnp.cos(x[0][1])) + x[0][0] ** 2 + 0.3 * x[1] @ x[1]

    run = jax.jit(
        lambda x, us: jd.control.ilqr(
            lambda x, u: advance(x, motors @ u),
            lambda x, u, k: 0.01 * u @ u + 0.1 * upright(x),
            upright, x, us, limits=(-15.0, 15.0), iterations=30,
        ).us
    )  # fmt: skip
    return lambda: run((jnp.zeros(2), jnp.zeros(2)), 0.1 * jnp.ones((40, 1)))


CASES: dict[str, tuple[str, Callable[[], Callable]]] = {
    "panda": ("forward dynamics of a Panda, under jit", lambda: accelerate(PANDA)),
    "g1": ("forward dynamics of a G1, under jit", lambda: accelerate(G1)),
    "g1_gradient": ("gradient of forward dynamics of a G1, under jit", gradient_of_g1),
    "panda_motion": ("simulate a Panda", simulate_panda),
    "panda_gradient": ("gradient through 100 fixed steps of a Panda", gradient_of_panda),
    "four_bar": ("simulate a four-bar", simulate_four_bar),
    "four_bar_gradient": ("gradient of its motion by its masses, under jit", gradient_of_four_bar),
    "by_hand": ("its equations by hand in diffrax, under jit", simulate_by_hand),
    "by_hand_gradient": ("gradient of these, under jit", gradient_by_hand),
    "path": ("gradient of a four-bar's path by its lengths, under jit", gradient_of_path),
    "stewart": ("accelerations of a Stewart platform, under jit", accelerate_stewart),
    "stewart_assembly": ("assemble a Stewart platform", assemble_stewart),
    "stewart_motion": ("simulate a Stewart platform", simulate_stewart),
    "delta": ("load a delta robot from MJCF and assemble it", assemble_delta),
    "legs_gradient": (
        "gradient through 50 steps of a quadruped on four held feet, batch 256, under jit",
        gradient_of_legs,
    ),
    "step_jacobian": ("Jacobian of one step of a four-bar, under jit", jacobian_of_step),
    "ilqr": ("swing-up of a cart-pole by iLQR, under jit", plan_cart_pole),
}


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def here(case: str, clock_name: str) -> dict[str, float]:
    """Seconds of each step, in this process."""
    now = CLOCKS[clock_name]
    clock = [now()]
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxdyn  # noqa: F401

    clock.append(now())
    call = CASES[case][1]()
    clock.append(now())
    for _ in range(2):
        jax.block_until_ready(call())
        clock.append(now())
    return {step: after - before for step, before, after in zip(STEPS, clock, clock[1:], strict=False)}


def elsewhere(case: str, cache: str, clock: str) -> dict[str, float]:
    """The same in a fresh process."""
    # As for a user: without JAX's cache, and with modules that Python has compiled before.
    dropped = "JAX_COMPILATION_CACHE", "PYTHONDONTWRITEBYTECODE"
    kept = {name: value for name, value in os.environ.items() if not name.startswith(dropped)}
    call = [sys.executable, "-m", "benchmarks.first_calls", "--here", case, "--clock", clock]
    done = subprocess.run(
        call, env=kept | {"XDG_CACHE_HOME": cache}, cwd=HERE, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{case} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main(argv=None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall")
    parser.add_argument("--here", choices=list(CASES), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.here:
        print(json.dumps(here(options.here, options.clock)))
        return
    from benchmarks import timing

    compileall.compile_dir(HERE / "jaxdyn", quiet=1)
    rows = []
    print(
        "| seconds | import | build | first call | second call | second process: first call |\n|---|---|---|---|---|---|"
    )
    for case in timing.chosen_names(options.cases, CASES):
        cold, warm = [], []
        for _ in range(options.rounds):
            with tempfile.TemporaryDirectory() as cache:
                cold.append(elsewhere(case, cache, options.clock))
                warm.append(elsewhere(case, cache, options.clock))
        first, again = ({step: min(x[step] for x in computed) for step in STEPS} for computed in (cold, warm))
        rows.append({"case": case, "first process": first, "second process": again})
        cells = [f"{first[step]:.3g}" for step in STEPS] + [f"{again['first call']:.3g}"]
        print(f"| {CASES[case][0]} | {' | '.join(cells)} |", flush=True)
    print("written to", timing.write("first_calls", {"machine": timing.machine(), "rows": rows}))


if __name__ == "__main__":
    main()
