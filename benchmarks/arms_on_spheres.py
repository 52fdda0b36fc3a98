"""A thousand arms that slide on spheres under force feedback, here with rigid contact, in C MuJoCo and MJX with their soft one.

    python -m benchmarks.arms_on_spheres [--arms 1000] [--seconds 5] [--gradient] [--mjx 8] [--growth 4 8 16 --growth-seconds 0.2]

The arm of six joints of `jd.scenes.sphere_arm`, its tip on a sphere, each with a goal of its own for the five contact
coordinates, pressed with 5 N. The law is `jd.control.HybridForce` with integral action, and knows a ball of 0.2 kg where the
plant has 0.3. Here: RK4 of 10 ms, one constraint. MuJoCo: the same bodies, two spheres with frictionless contact, steps of 2 ms;
it is fed the law's torques at every step, with the integral of the force that its contact gave. C MuJoCo runs in a thread for
each core (`mujoco.rollout`), between calls of the law for all arms at once, compiled. Printed: seconds of a second
call, and the force error after the first second, in which integral action takes most of the wrong mass away.

MJX computes few arms, as its time on a CPU grows with their number: `--growth` prints its seconds for a short motion of several
numbers of arms.
"""

import argparse
import os
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx, rollout

import jaxdyn as jd
from benchmarks import timing

FORCE, CENTER, RADIUS, TIP = 5.0, (0.5, 0.0, 0.0), 0.15, 0.03
MASSES = (1.0, 1.5, 1.0, 0.3, 0.3, 0.3)


def law_for(goal):
    """The law for one goal (5,), of the arm with the lighter ball."""
    scene = jd.scenes.sphere_arm()
    surfaces = jd.contact.Sphere(RADIUS, poles="y"), jd.contact.Sphere(TIP)
    task = jd.control.ContactCoordinates(scene.system, "tip", *surfaces, CENTER)
    return jd.control.HybridForce(scene, task, goal, 36.0, 12.0, force=jnp.asarray([FORCE]), ki=6.0)


def with_contact(model) -> mujoco.MjModel:
    """The chain of revolute joints in MuJoCo, a sphere at its tip and one in space."""
    spec = mujoco.MjSpec()
    spec.compiler.degree, spec.compiler.boundinertia = False, 1e-13
    spec.option.gravity, spec.option.timestep = np.asarray(model.gravity), 0.002
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "condim": 1}
    spec.worldbody.add_geom(pos=CENTER, size=[RADIUS, 0, 0], **sphere)
    body = spec.worldbody
    homes, numbers, screws = (np.asarray(x, float) for x in (model.home, model.inertias, model.screws))
    for home, (m, *first, xx, xy, yy, xz, yz, zz), screw in zip(homes, numbers, screws, strict=True):
        c = np.asarray(first) / m
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))
        moments, axes = np.linalg.eigh(about)
        axes[:, 0] *= np.linalg.det(axes)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, axes.ravel())
        turned = np.zeros(4)
        mujoco.mju_mat2Quat(turned, home[:3, :3].ravel())
        inertial = {
            "mass": m,
            "ipos": c,
            "iquat": quat,
            "inertia": np.maximum(moments, 1e-13),
            "explicitinertial": True,
        }
        body = body.add_body(pos=home[:3, 3], quat=turned, **inertial)
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=screw[3:])
    body.add_geom(pos=[0.1, 0.0, 0.0], size=[TIP, 0, 0], **sphere)
    body.add_site(name="tip", pos=[0.1, 0.0, 0.0], size=[1.2 * TIP, 0, 0], type=mujoco.mjtGeom.mjGEOM_SPHERE)
    for kind in (mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtSensor.mjSENS_FRAMEPOS):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="tip")
    return spec.compile()


def rigid(goals, span, gradient):
    """Seconds, force errors, and the largest gap."""
    plant = jd.scenes.sphere_arm(masses=MASSES)
    q, v = jd.scenes.sphere_arm.start(rolling=(0.0, 0.0))
    ts = jnp.linspace(0.0, span, 51)
    outputs = ("multipliers", "constraint_residual")

    def run(goal):
        motion = jd.simulate(plant, q, v, ts, control=law_for(goal), stepsize=0.01, outputs=outputs)
        return motion.multipliers[:, 0], motion.constraint_residual[:, 0], motion.success

    program = jax.jit(jax.vmap(run))
    jax.block_until_ready(program(goals))
    began = time.perf_counter()
    forces, gaps, fine = jax.block_until_ready(program(goals))
    seconds = time.perf_counter() - began
    print(f"  {int(fine.sum())} of {len(goals)} arms reached the end")
    if gradient:
        cost = jax.jit(jax.vmap(jax.grad(lambda goal: jnp.sum((run(goal)[0] - FORCE) ** 2))))
        jax.block_until_ready(cost(goals))
        again = time.perf_counter()
        jax.block_until_ready(cost(goals))
        print(f"  gradient in the goals: {time.perf_counter() - again:.2f} s")
    late = np.asarray(forces)[:, ts >= 1.0]
    return seconds, np.abs(late - FORCE), float(jnp.max(jnp.abs(gaps)))


def same_arm():
    """The plant, its start, and MuJoCo's model of it, which has its bias forces."""
    plant = jd.scenes.sphere_arm(masses=MASSES)
    q, v = jd.scenes.sphere_arm.start(rolling=(0.0, 0.0))
    source = with_contact(plant.system)
    data = mujoco.MjData(source)
    data.qpos[:], data.qvel[:] = np.asarray(q), 0.3
    mujoco.mj_forward(source, data)
    bias = np.asarray(jd.bias_force(plant.system, q, jnp.full(6, 0.3)))
    np.testing.assert_allclose(data.qfrc_bias, bias, atol=1e-8)
    return plant, q, v, source


def in_threads(goals, span):
    """The same of C MuJoCo, in a thread for each core."""
    _, q, v, source = same_arm()
    step, n = float(source.opt.timestep), len(goals)
    data = [mujoco.MjData(source) for _ in range(os.cpu_count() or 1)]
    law = jax.jit(jax.vmap(lambda goal, q, v, t, z: law_for(goal)(q, v, t, z), (0, 0, 0, None, 0)))
    kind = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
    states = np.tile(np.concatenate([[0.0], q, v]), (n, 1))
    z, forces, tips = np.zeros((n, 1)), [], []
    jax.block_until_ready(law(goals, states[:, 1:7], states[:, 7:], 0.0, z))
    began = time.perf_counter()
    with rollout.Rollout(nthread=len(data)) as runner:
        for k in range(round(span / step)):
            tau = np.asarray(law(goals, states[:, 1:7], states[:, 7:], k * step, z))
            after, sensed = runner.rollout(source, data, states, tau[:, None], control_spec=kind, nstep=1)
            states = after[:, -1]
            forces.append(sensed[:, -1, 0])
            tips.append(sensed[:, -1, 1:4])
            z = z + step * (forces[-1][:, None] - FORCE)
    seconds = time.perf_counter() - began
    late = np.asarray(forces)[round(1.0 / step) :]
    gaps = np.linalg.norm(np.asarray(tips) - CENTER, axis=-1) - RADIUS - TIP
    return seconds, np.abs(late - FORCE), float(np.max(np.abs(gaps)))


def soft(goals, span):
    """The same of MJX."""
    plant, q, v, source = same_arm()
    model, blank = mjx.put_model(source), mjx.make_data(source)
    step, count = float(source.opt.timestep), round(span / float(source.opt.timestep))

    def force_of(data):
        A = jd.constraint_jacobian(plant, data.qpos)[0]
        return A @ data.qfrc_constraint / (A @ A)

    def run(goal):
        law = law_for(goal)

        def advance(carry, t):
            data, z = carry
            data = mjx.step(model, data.replace(qfrc_applied=law(data.qpos, data.qvel, t, z)))
            lam = force_of(data)
            return (data, z + step * (lam - FORCE)), (lam, jd.frame_pose(plant.system, data.qpos, "tip")[:3, 3])

        start = blank.replace(qpos=q, qvel=v), jnp.zeros(1)
        forces, tips = jax.lax.scan(advance, start, step * jnp.arange(count))[1]
        gaps = jnp.linalg.norm(tips - jnp.asarray(CENTER), axis=1) - RADIUS - TIP
        return forces, gaps

    program = jax.jit(jax.vmap(run))
    jax.block_until_ready(program(goals))
    began = time.perf_counter()
    forces, gaps = jax.block_until_ready(program(goals))
    seconds = time.perf_counter() - began
    late = np.asarray(forces)[:, round(1.0 / step) :]
    return seconds, np.abs(late - FORCE), float(jnp.max(jnp.abs(gaps)))


def main(argv=None) -> None:
    """Measure, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=1000)
    parser.add_argument("--mjx", type=int, default=8, help="arms in MJX; 0 for none")
    parser.add_argument(
        "--growth", type=int, nargs="*", default=[], help="numbers of arms in MJX, to see how its time grows"
    )
    parser.add_argument("--growth-seconds", type=float, default=0.2, help="of motion, for --growth")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--gradient", action="store_true", help="time the gradient too")
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    start = jnp.asarray([0.2, -0.1, 0.15, 0.1, 0.3])  # of `jd.scenes.sphere_arm.start`
    most = max(options.arms, options.mjx, *options.growth, 1)
    goals, rows = start + jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (most, 5))), {}
    for name, count, computed in (
        ("jaxdyn", options.arms, lambda goals: rigid(goals, options.seconds, options.gradient)),
        ("C MuJoCo", options.arms, lambda goals: in_threads(goals, options.seconds)),
        ("MJX", options.mjx, lambda goals: soft(goals, options.seconds)),
    ):
        if not count:
            continue
        batch = goals[:count]
        seconds, error, gap = computed(batch)
        rows[name] = {
            "arms": len(batch),
            "seconds": seconds,
            "mean": float(error.mean()),
            "largest": float(error.max()),
        }
        print(
            f"{name}: {len(batch)} arms, {options.seconds:g} s of motion in {seconds:.2f} s "
            f"({1e3 * seconds / len(batch):.3g} ms an arm); force error {error.mean():.2g} N in the mean, {error.max():.2g} N at "
            f"most; gap up to {gap:.1g} m",
            flush=True,
        )
    for count in options.growth:
        seconds, *_ = soft(goals[:count], options.growth_seconds)
        print(f"MJX: {count} arms, {options.growth_seconds:g} s of motion in {seconds:.2f} s", flush=True)
        rows[f"MJX, {count} arms"] = {"arms": count, "seconds": seconds, "motion": options.growth_seconds}
    print("written to", timing.write("benchmark_arms_on_spheres", {"machine": timing.machine(), "rows": rows}))


if __name__ == "__main__":
    main()
