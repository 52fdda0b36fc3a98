"""Steps through contacts of a quadruped with twelve joints and four feet, or of a box, against `mujoco.rollout`.

    python -m benchmarks.contact_steps [quadruped] [--batch 4096] [--steps 50] [--rounds 5] [--dt 0.002] [--skip-mujoco]
    python -m benchmarks.contact_steps box --batch 64 --steps 250

Both read one MJCF file. The quadruped is a trunk on four legs of three joints, with spherical feet on a plane, friction 0.8, and
torques that hold the stance. The trunk starts with random velocities, so that feet stick, slide and lift. The box falls from
0.1 m with random velocities, tumbles and comes to rest; jaxdyn takes contacts of its four lowest corners.

Printed are steps a second of both on all cores, the processor time of a simulated second, the time of a gradient of a step over
that of the step, both as wall time and as processor time, which counts on a busy machine; and errors of the trunk's position
against steps of a sixteenth of the length, each program against itself, with those of jaxdyn at longer steps.
"""

import argparse
import os
import tempfile
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxdyn as jd
from benchmarks import timing
from jaxdyn.compile import wait_for_code

RADIUS, FRICTION, LEG = 0.02, 0.8, 0.2
STANCE = (0.0, 0.8, -1.6)
SIZE = np.array([0.2, 0.15, 0.1])  # of the box


def box_mjcf() -> str:
    """A box of 1 kg above a plane."""
    x, y, z = SIZE / 2
    return f"""<mujoco><option gravity="0 0 -9.81" cone="elliptic"/><default><geom friction="{FRICTION} 0.005 0.0001"/></default>
    <worldbody><geom name="floor" type="plane" size="5 5 1"/><body name="trunk" pos="0 0 0.15"><freejoint name="root"/>
      <geom type="box" size="{x} {y} {z}" mass="1"/></body></worldbody></mujoco>"""


def box_scene(path) -> jd.Scene:
    """The file's model with its four lowest corners on the ground."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jd.io.NotTakenWarning)  # the shape, which follows here
        model = jd.load(path).system
    return jd.Scene(model, forces=jd.contact.shape_contacts("trunk", jd.contact.Box(SIZE), friction=FRICTION, lowest=4))


def box_states(built, batch: int):
    """Level boxes with random velocities and no torques."""
    v = np.random.default_rng(0).normal(size=(batch, 6)) * np.array([0.5, 0.5, 0.5, 4, 4, 4])
    return np.tile([0, 0, 0.15, 1, 0, 0, 0.0], (batch, 1)), v, np.zeros((batch, 6))


def mjcf() -> str:
    """The quadruped: 12 kg, hips, thighs and shanks of 0.2 m."""
    legs = []
    for name, x, y in (("fl", 0.2, 0.15), ("fr", 0.2, -0.15), ("hl", -0.2, 0.15), ("hr", -0.2, -0.15)):
        legs.append(f"""
      <body name="hip_{name}" pos="{x} {y} 0"> <joint name="{name}1" axis="1 0 0"/>
        <inertial pos="0 0 0" mass="0.5" diaginertia="0.001 0.001 0.001"/>
        <body name="thigh_{name}" pos="0 0 0"> <joint name="{name}2" axis="0 1 0"/>
          <inertial pos="0 0 -0.08" mass="0.7" diaginertia="0.004 0.004 0.001"/>
          <body name="shank_{name}" pos="0 0 -{LEG}"> <joint name="{name}3" axis="0 1 0"/>
            <inertial pos="0 0 -0.1" mass="0.2" diaginertia="0.001 0.001 0.0002"/>
            <geom name="foot_{name}" type="sphere" size="{RADIUS}" pos="0 0 -{LEG}" mass="0"
              friction="{FRICTION} 0.005 0.0001" contype="1" conaffinity="0"/>
          </body></body></body>""")
    return f"""<mujoco><option gravity="0 0 -9.81" cone="elliptic"/><default><joint damping="0"/></default><worldbody>
    <geom name="floor" type="plane" size="5 5 1" contype="0" conaffinity="1" friction="{FRICTION} 0.005 0.0001"/>
    <body name="trunk" pos="0 0 0.3"> <freejoint name="root"/>
      <inertial pos="0 0 0" mass="6.4" diaginertia="0.05 0.12 0.14"/>{"".join(legs)}
    </body></worldbody></mujoco>"""


def scene(path) -> jd.Scene:
    """The file's model with its feet on the ground."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jd.io.NotTakenWarning)  # the shapes of the feet, which follow here
        model = jd.load(path).system
    feet = [
        jd.contact.ground_contact(f"shank_{name}", (0, 0, -LEG), FRICTION, radius=RADIUS, name=name)
        for name in ("fl", "fr", "hl", "hr")
    ]
    return jd.Scene(model, forces=feet)


def states(built, batch: int):
    """Stances with random velocities, and torques near those that hold the stance."""
    rng, model = np.random.default_rng(0), built.system
    q = np.array(jd.neutral(model))
    for name, part in zip(model.joint_names, model.topology.q_slices, strict=True):
        if name != "root":
            q[part] = STANCE[int(name[-1]) - 1]
    q[2] = 2 * LEG * np.cos(0.8) + RADIUS
    root = model.topology.v_slices[model.joint_names.index("root")]
    v = np.zeros((batch, model.nv))
    v[:, root] = rng.normal(size=(batch, 6)) * np.array([0.5, 0.5, 0.2, 0.5, 0.5, 0.5])
    # A quarter of the weight at each foot, by the principle of virtual work.
    weight = np.asarray(jd.gravity_force(model, q))
    rows = np.asarray(jd.constraint_jacobian(jd.Scene(model, [foot.contact for foot in built.forces]), q))
    tau = weight - weight[root][2] / 4 * rows[::3].sum(0)
    tau[root] = 0.0
    taus = tau + 0.5 * rng.normal(size=(batch, model.nv)) * (np.arange(model.nv) >= 6)
    return np.tile(q, (batch, 1)), v, taus


def ours(built, dt: float, steps: int):
    """Last states of a batch, compiled."""
    step = jd.stepper(built, dt)

    def run(q, v, tau):
        return jax.lax.scan(lambda s, _: (step(s, tau), None), (q, v), None, length=steps)[0]

    return jax.jit(jax.vmap(run))


def gradient(built, dt: float):
    """Gradients of a step by its state and torques, of a batch, and the step itself."""
    step = jd.stepper(built, dt, remat=False)

    def loss(q, v, tau):
        q, v = step((q, v), tau)
        return jnp.sum(v * v) + jnp.sum(q * q)

    return jax.jit(jax.vmap(jax.grad(loss, (0, 1, 2)))), jax.jit(jax.vmap(lambda q, v, tau: step((q, v), tau)))


def mujoco_rollout(path, dt: float, steps: int, batch):
    """Last positions of a batch by `mujoco.rollout` with a thread for each core, in the same units and order."""
    import mujoco
    from mujoco import rollout

    m = mujoco.MjModel.from_xml_path(str(path))
    m.opt.timestep = dt
    q, v, tau = batch
    data = [mujoco.MjData(m) for _ in range(os.cpu_count() or 1)]
    start = np.zeros((len(q), mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    # At the start the trunk is level: body-fixed velocities are those of the world.
    start[:, 1 : 1 + m.nq], start[:, 1 + m.nq : 1 + m.nq + m.nv] = q, v
    control = np.repeat(tau[:, None], steps, 1)
    kind = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)

    def call():
        with rollout.Rollout(nthread=len(data)) as runner:
            computed, _ = runner.rollout(m, data, start, control, control_spec=kind, nstep=steps)
        return computed[:, -1, 1 : 1 + m.nq]

    return call


def measure(call, rounds: int) -> tuple[float, float]:
    """Least wall time and processor time of a call, s."""
    call()
    wait_for_code()
    wall, cpu = [], []
    for _ in range(rounds):
        start, used = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - used)
    return min(wall), min(cpu)


def describe_cost(seconds: float, dt: float) -> str:
    """Processor time of a step and of a simulated second."""
    return f"{1e6 * seconds:.3g} us of a core a step, {1e3 * seconds / dt:.3g} ms a simulated second"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", choices=["quadruped", "box"], default="quadruped")
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--dt", type=float, default=0.002)
    parser.add_argument("--skip-mujoco", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(timing.machine())
    text, scene_of, states_of = (box_mjcf, box_scene, box_states) if given.robot == "box" else (mjcf, scene, states)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(text())
        built = scene_of(path)
        batch = states_of(built, given.batch)
        arrays = [jnp.asarray(x) for x in batch]
        count = given.batch * given.steps
        run = ours(built, given.dt, given.steps)
        finite = np.isfinite(np.asarray(run(*arrays)[0])).all(1)
        print(f"jaxdyn: {np.sum(~finite)} of {given.batch} runs without a solution")
        wall, cpu = measure(lambda: jax.block_until_ready(run(*arrays)), given.rounds)
        print(f"jaxdyn: {count / wall:.3g} steps/s, {describe_cost(cpu / count, given.dt)}")
        grad, one = gradient(built, given.dt)
        (w1, c1), (w2, c2) = (measure(lambda f=f: jax.block_until_ready(f(*arrays)), given.rounds) for f in (one, grad))
        print(f"gradient of a step over the step: {w2 / w1:.2f} (wall), {c2 / c1:.2f} (processor)")
        if not given.skip_mujoco:
            call = mujoco_rollout(path, given.dt, given.steps, batch)
            other, used = measure(call, given.rounds)
            print(f"mujoco: {count / other:.3g} steps/s, {describe_cost(used / count, given.dt)}")
            print(f"ratio: {other / wall:.2f} (wall), {used / cpu:.2f} (processor)")
        few = [x[:64] for x in batch]
        programs = [("jaxdyn", (1, 2, 4))] + [("mujoco", (1,))] * (not given.skip_mujoco)
        for name, factors in programs:

            def place(dt, steps, name=name):
                if name == "mujoco":
                    return mujoco_rollout(path, dt, steps, few)()[:, :3]
                return np.asarray(ours(built, dt, steps)(*map(jnp.asarray, few))[0])[:, :3]

            steps = given.steps // max(factors) * max(factors)
            exact = place(given.dt / 16, 16 * steps)
            for factor in factors:
                error = np.linalg.norm(place(factor * given.dt, steps // factor) - exact, axis=1)
                length, middle = 1e3 * factor * given.dt, np.median(error)
                print(f"{name}, steps of {length:g} ms: median error of the trunk's position {middle:.2g} m")


if __name__ == "__main__":
    main()
