"""Draws docs/figures/control_NAME.png, one for each control law: errors against what its gains promise.

python -m benchmarks.control_figures [NAME ...]

Prints the rate that is fitted to the late error next to the promised one.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import optax

import jaxdyn as jd
from benchmarks.timing import chosen_names
from jaxdyn import scenes

KP, KD = 6.0, 5.0  # roots -2 and -3
FOLDER = Path(__file__).resolve().parent.parent / "docs" / "figures"


def decayed(ts, e, rate, kp=KP, kd=KD):
    """Closed form of edd + kd ed + kp e = 0 with two real roots, (nt, n)."""
    slow, fast = np.sort(np.roots([1.0, kd, kp]).real)[::-1]
    first = (np.asarray(rate) - fast * e) / (slow - fast)
    return np.exp(slow * ts)[:, None] * first + np.exp(fast * ts)[:, None] * (e - first)


def late_rate(ts, error):
    """Slope of log |e| over the last third, 1/s."""
    last = len(ts) // 3
    size = np.linalg.norm(error.reshape(len(ts), -1), axis=1)
    return np.polyfit(ts[-last:], np.log(size[-last:]), 1)[0]


def against(axes, ts, errors, promised, labels, title):
    """Sizes of errors, and dashed what is promised."""
    ts = np.asarray(ts)
    for i, label in enumerate(labels):
        axes.semilogy(ts, np.abs(errors[:, i]), color=f"C{i}", label=label)
        axes.semilogy(ts, np.abs(promised[:, i]), "k--", linewidth=1, label="by the gains" if not i else None)
    axes.set(xlabel="t (s)", title=title)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    print(f"  {title}: {late_rate(ts, errors):.4f} 1/s, promised {late_rate(ts, promised):.4f}")


def pair():
    """A figure with two drawings."""
    figure = matplotlib.figure.Figure(figsize=(9, 3.4), layout="constrained")
    return figure, *figure.subplots(1, 2)


def wave(t):
    return jnp.stack([jnp.sin(t), 0.5 * jnp.cos(2 * t)])


def circle(t):
    return jnp.stack([0.3 * jnp.sin(t), 0.4 * jnp.cos(t)])


def first_two(q):
    return q[:2]


def computed_torque():
    """A double pendulum follows a moving target."""
    model, (q, v) = scenes.double_pendulum(), scenes.double_pendulum.start()[:2]
    ts = jnp.linspace(0, 3, 151)
    law = jd.control.ComputedTorque(model, wave, KP, KD)
    motion = jd.simulate(model, q, v, ts, control=law, outputs=("torque",))
    errors = np.asarray(motion.q - jax.vmap(wave)(ts))
    rate = v - jax.jvp(wave, (0.0,), (1.0,))[1]
    figure, left, right = pair()
    against(left, ts, errors, decayed(np.asarray(ts), errors[0], rate), ("joint 1", "joint 2"), "|error| (rad)")
    right.plot(ts, motion.torque, label=["joint 1", "joint 2"])
    right.set(xlabel="t (s)", title="torque (N m)")
    right.legend(fontsize=8)
    return figure


def arm():
    """Three links in the x-z plane, and a start."""
    builder = jd.ModelBuilder("arm", gravity=(0.0, 0.0, -9.81))
    parent = None
    for i, pose in enumerate([None, (0.4, 0, 0), (0.4, 0, 0)]):
        bar = (1.0, (0.2, 0, 0), (1e-3, 0.014, 0.014))
        builder.add_body(f"{i + 1}", parent, "continuous", bar, axis=(0, -1, 0), pose=pose)
        parent = f"{i + 1}"
    model = builder.add_frame("tip", "3", (0.3, 0, 0)).build()
    return model, jnp.asarray([0.9, -1.2, 0.6])


def operational_space():
    """The tip of an arm follows a circle; what the tip does not need is damped."""
    model, q = arm()
    start = jd.frame_pose(model, q, "tip")[:3, 3]

    def target(t):
        return start + jnp.stack([0.1 * jnp.cos(2 * t) - 0.05, 0.0 * t, 0.1 * jnp.sin(2 * t)])

    ts = jnp.linspace(0, 3, 151)
    law = jd.control.OperationalSpace(model, "tip", target, KP, KD, task="position", damping=2.0)
    motion = jd.simulate(model, q, jnp.zeros(3), ts, control=law, outputs=(jd.simulation.Pose("tip"),))
    errors = np.asarray(motion.poses["tip"][:, :3, 3] - jax.vmap(target)(ts))[:, [0, 2]]
    rate = -jax.jvp(target, (0.0,), (1.0,))[1]
    figure, left, right = pair()
    promised = decayed(np.asarray(ts), errors[0], np.asarray(rate)[[0, 2]])
    against(left, ts, errors, promised, ("x", "z"), "|error of the tip| (m)")
    right.plot(motion.poses["tip"][:, 0, 3], motion.poses["tip"][:, 2, 3], label="tip")
    path = jax.vmap(target)(ts)
    right.plot(path[:, 0], path[:, 2], "k--", linewidth=1, label="target")
    right.set(xlabel="x (m)", ylabel="z (m)", title="path", aspect="equal")
    right.legend(fontsize=8)
    return figure


def cartesian_stiffness():
    """A tip held by a spring yields to a force by K e = F."""
    model, q = arm()
    place = jd.frame_pose(model, q, "tip")[:3, 3]
    stiffness, force = jnp.asarray([400.0, 400.0, 100.0]), jnp.asarray([8.0, 0.0, -5.0])
    law = jd.control.CartesianStiffness(model, "tip", place, stiffness, 40.0, task="position", joint_damping=0.5)
    ts = jnp.linspace(0, 4, 201)

    def push(q, v, t):
        return law(q, v, t) + jnp.where(t > 0.5, 1.0, 0.0) * (jd.frame_jacobian(model, q, "tip")[:3].T @ force)

    motion = jd.simulate(model, q, jnp.zeros(3), ts, control=push, stepsize=0.002, outputs=(jd.simulation.Pose("tip"),))
    moved = np.asarray(motion.poses["tip"][:, :3, 3] - place)[:, [0, 2]]
    want = np.asarray(force / stiffness)[[0, 2]]
    figure, left, right = pair()
    for i, label in enumerate("xz"):
        left.plot(ts, 1e3 * moved[:, i], label=label)
        left.axhline(1e3 * want[i], color="k", linestyle="--", linewidth=1, label="F/K" if not i else None)
        right.semilogy(ts[ts > 0.5], np.abs(moved[ts > 0.5, i] - want[i]) * 1e3, label=label)
    left.set(xlabel="t (s)", title="the tip yields (mm)")
    right.set(xlabel="t (s)", title="|difference to F/K| (mm)")
    left.legend(fontsize=8), right.legend(fontsize=8)
    print(f"  yields {moved[-1]} m, F/K {want} m")
    return figure


def hybrid_force():
    """A particle on a sphere: motion and force with the right mass, the force with a wrong one, with and without KI."""
    (q, v), ts = scenes.spherical_pendulum.start(theta=1.0, phi_rate=0.7), jnp.linspace(0, 3, 151)
    plant, wrong = scenes.spherical_pendulum(mass=1.3), scenes.spherical_pendulum(mass=1.6)
    figure, left, right = pair()
    law = jd.control.HybridForce(plant, first_two, circle, KP, KD, force=jnp.asarray([2.0]))
    motion = jd.simulate(plant, q, v, ts, control=law, outputs=("multipliers",))
    errors = np.asarray(motion.q[:, :2] - jax.vmap(circle)(ts))
    rate = v[:2] - jax.jvp(circle, (0.0,), (1.0,))[1]
    against(left, ts, errors, decayed(np.asarray(ts), errors[0], rate), "xy", "|error of position| (m)")
    print(f"  force error, right mass: {np.abs(motion.multipliers - 2).max():.2g} N")
    # At its lowest place, where a wrong mass moves nothing.
    low = jnp.asarray([0.0, 0.0, -1.0]), jnp.zeros(3)
    for ki in (None, 4.0):
        law = jd.control.HybridForce(wrong, first_two, jnp.zeros(2), KP, KD, force=jnp.asarray([2.0]), ki=ki)
        motion = jd.simulate(plant, *low, ts, control=law, outputs=("multipliers",))
        error = np.abs(np.asarray(motion.multipliers[:, 0]) - 2.0)
        right.semilogy(ts, error, label="without integral action" if ki is None else "KI = 4 1/s")
        print(f"  force error, mass 1.6 for 1.3 kg, KI {ki}: {error[0]:.4f} to {error[-1]:.2g} N")
    right.semilogy(ts, 0.3 * 9.81 * np.exp(-4 * ts), "k--", linewidth=1, label="by KI")
    print(f"  rate of the force error: {late_rate(np.asarray(ts), error):.4f} 1/s, promised -4")
    right.set(xlabel="t (s)", title="|error of force| with a wrong mass (N)")
    right.grid(alpha=0.3), right.legend(fontsize=8)
    return figure


def hybrid_rates():
    """Nonholonomic rows: the rates of a rolling disk, and the forces of its two rows."""
    scene, ts = scenes.rolling_disk(), jnp.linspace(0, 2, 101)
    kp, force = np.array([3.0, 5.0]), jnp.asarray([0.7, -0.4])

    def target(t):
        return jnp.stack([jnp.sin(t), 1.0 + 0.5 * t])

    law = jd.control.HybridForce(scene, lambda q, v: v[2:], target, kp, of="velocity", force=force)
    motion = jd.simulate(scene, *scenes.rolling_disk.start(), ts, control=law, outputs=("multipliers",))
    errors = np.asarray(motion.v[:, 2:] - jax.vmap(target)(ts))
    figure, left, right = pair()
    promised = errors[0] * np.exp(-np.outer(ts, kp))
    against(left, ts, errors, promised, ("steering", "rolling"), "|error of rates| (rad/s)")
    right.plot(motion.q[:, 0], motion.q[:, 1])
    right.set(xlabel="x (m)", ylabel="y (m)", title="place of the disk", aspect="equal")
    print(f"  force errors {np.abs(motion.multipliers - force).max():.2g} N")
    return figure


def contact_coordinates():
    """An arm whose tip slides on a sphere: five contact coordinates and the normal force."""
    scene, ts = scenes.sphere_arm(), jnp.linspace(0, 2, 41)
    q, v = scenes.sphere_arm.start(rolling=(0.0, 0.0))
    ball, tip = jd.contact.Sphere(0.15, poles="y"), jd.contact.Sphere(0.03)
    task = jd.control.ContactCoordinates(scene.system, "tip", ball, tip, (0.5, 0.0, 0.0))
    goal = task(q) + jnp.asarray([0.05, -0.04, 0.1, -0.05, 0.12])
    figure, left, right = pair()
    law = jd.control.HybridForce(scene, task, goal, KP, KD, force=jnp.asarray([5.0]), ki=4.0)
    motion = jd.simulate(scene, q, v, ts, control=law, stepsize=0.02, outputs=("multipliers",))
    errors = np.asarray(jax.vmap(lambda q: task(q) - goal)(motion.q))
    promised = decayed(np.asarray(ts), errors[0], np.zeros(5))
    names = ("u of the sphere", "v of the sphere", "u of the tip", "v of the tip", "psi")
    against(left, ts, errors, promised, names, "|error of contact coordinates| (rad)")
    right.plot(ts, motion.multipliers[:, 0], label="on the way")
    print(f"  force {float(motion.multipliers.min()):.9f} to {float(motion.multipliers.max()):.9f} N of 5")
    right.axhline(5.0, color="k", linestyle="--", linewidth=1, label="wanted")
    right.set(xlabel="t (s)", title="normal force (N)", ylim=(0, 6))
    right.legend(fontsize=8)
    return figure


def parallel_manipulator():
    """Three motors, two freedoms: the shortest torques, and one direction of internal force."""
    scene, ts = scenes.parallel_manipulator(), jnp.linspace(0, 3, 151)
    q, v = scenes.parallel_manipulator.start()

    def point(q):
        tip = jd.frame_pose(scene.system, q, "a2")
        return tip[:2, 3] + tip[:2, 0]

    def target(t):
        return jnp.stack([0.2 * jnp.cos(t), 0.15 * jnp.sin(t)])

    figure, left, right = pair()
    sizes = []
    for internal, label in ((None, "shortest torques"), ([1.0, -2.0, 0.5], "with an internal part")):
        law = jd.control.HybridForce(scene, point, target, KP, KD, actuated=(0, 2, 4), internal=internal)
        motion = jd.simulate(scene, q, v, ts, control=law, outputs=("torque",))
        torques = np.asarray(motion.torque)[:, [0, 2, 4]]
        right.plot(ts, np.linalg.norm(torques, axis=1), label=label)
        sizes.append(motion)
        if internal is None:
            errors = np.asarray(jax.vmap(point)(motion.q) - jax.vmap(target)(ts))
            rate = jax.jvp(point, (q,), (v,))[1] - jax.jvp(target, (0.0,), (1.0,))[1]
            promised = decayed(np.asarray(ts), errors[0], rate)
            against(left, ts, errors, promised, "xy", "|error of the point| (m)")
    difference = float(jnp.abs(sizes[0].q - sizes[1].q).max())
    print(f"  motions with and without the internal part differ by {difference:.2g} rad")
    right.set(xlabel="t (s)", title="size of the three torques (N m)")
    right.legend(fontsize=8)
    return figure


def gauge_invariant():
    """The composite error decays with kd alone; next to it the geometric law of matched gains."""
    scene, ts = scenes.spherical_pendulum(mass=1.3), jnp.linspace(0, 3, 151)
    q, v = scenes.spherical_pendulum.start(theta=1.0, phi_rate=0.7)
    p, k = 2.0, 3.0
    figure, left, right = pair()
    gauge = jd.control.GaugeInvariant(scene, first_two, circle, p, k, force=jnp.asarray([2.0]))
    hybrid = jd.control.HybridForce(scene, first_two, circle, p * k, p + k, force=jnp.asarray([2.0]))
    moved = jax.vmap(jax.jacfwd(circle))(ts)
    for law, label in ((gauge, "gauge-invariant"), (hybrid, "geometric, Kp = p k, Kd = p + k")):
        motion = jd.simulate(scene, q, v, ts, control=law)
        error = motion.q[:, :2] - jax.vmap(circle)(ts)
        slow = motion.v[:, :2] - moved + p * error
        up = -jnp.sum(motion.q[:, :2] * slow, 1) / motion.q[:, 2]
        size = np.sqrt(1.3 * (jnp.sum(slow**2, 1) + up**2))
        left.semilogy(ts, size, label=label)
        right.semilogy(ts, jnp.linalg.norm(error, axis=1), label=label)
        print(f"  |eps|, {label}: {late_rate(np.asarray(ts), size):.4f} 1/s, promised {-k}")
    left.semilogy(ts, size[0] * np.exp(-k * np.asarray(ts)), "k--", linewidth=1, label="exp(-kd t)")
    left.set(xlabel="t (s)", title="|eps|, sqrt(J)")
    right.set(xlabel="t (s)", title="|error of position| (m)")
    for axes in (left, right):
        axes.grid(alpha=0.3), axes.legend(fontsize=8)
    return figure


def grasp_force():
    """Two fingers move a bar and press it; heavier fingers than in the law, with and without integral action."""
    plant, (q, v) = scenes.hand_with_bar(), scenes.hand_with_bar.start(velocity=(0.0, 0.0, 0.0))
    ts, goal = jnp.linspace(0, 2.5, 51), q[4:] + jnp.asarray([0.02, 0.03, 0.1])
    figure, left, right = pair()
    law = jd.control.GraspForce(plant, goal, KP, KD, preload=10.0)
    motion = jd.simulate(plant, q, v, ts, control=law, stepsize=0.02, events=[jd.events.ContactLost(stop=False)])
    errors = np.asarray(jax.vmap(lambda q: law.error.position(plant.system, q, 0.0))(motion.q))
    promised = decayed(np.asarray(ts), errors[0], np.zeros(3))
    against(left, ts, errors, promised, ("x", "y", "angle"), "|error of the bar| (m, rad)")
    squeeze = 10.0 * jd.grasp.normal_forces(plant)
    for ki in (None, 4.0):
        law = jd.control.GraspForce(scenes.hand_with_bar(masses=(0.5, 0.4)), q[4:], 400.0, 40.0, preload=10.0, ki=ki)
        options = {"stepsize": 0.01, "events": [jd.events.ContactLost(stop=False)], "outputs": ("multipliers",)}
        motion = jd.simulate(plant, q, v, ts, control=law, **options)
        inside = jax.vmap(lambda q, lam: jd.grasp.internal_forces(plant, q, lam))(motion.q, motion.multipliers)
        error = np.abs(np.asarray(inside) - squeeze).max(1)
        right.semilogy(ts, error, label="without integral action" if ki is None else "KI = 4 1/s")
        print(f"  internal force error, KI {ki}: {error[0]:.3f} to {error[-1]:.2g} N")
    right.set(xlabel="t (s)", title="|error of the internal force|, wrong fingers (N)")
    right.grid(alpha=0.3), right.legend(fontsize=8)
    return figure


def biped():
    """A trunk in the x-z plane on two legs, bent, and its feet."""
    upright = np.eye(4)
    upright[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    builder = jd.ModelBuilder("biped", gravity=(0.0, 0.0, -9.81))
    builder.add_body("trunk", None, "planar", jd.inertia.box(6.0, (0.4, 0.15, 0.1)), pose=upright)
    bar = (0.5, (0.0, -0.1, 0.0), (2e-3, 1e-4, 2e-3))
    for name, x in (("front", 0.15), ("hind", -0.15)):
        builder.add_body(f"{name}_thigh", "trunk", "continuous", bar, pose=(x, 0.0, 0.0))
        builder.add_body(f"{name}_shank", f"{name}_thigh", "continuous", bar, pose=(0.0, -0.2, 0.0))
        builder.add_frame(f"{name}_foot", f"{name}_shank", (0.0, -0.2, 0.0))
    model, cone = builder.build(), jd.contact.friction_cone("hard-finger", mu=0.6)
    feet = [jd.control.foot(f"{name}_foot", cone) for name in ("front", "hind")]
    return model, jnp.asarray([0.0, 0.35, 0.0, 0.5, -1.0, -0.5, 1.0]), feet


def whole_body():
    """Two legs shift their weight: the centre of mass by its gains, forces of the feet inside their cones."""
    model, q, feet = biped()
    center, ts = jd.center_of_mass(model, q), jnp.linspace(0, 2.5, 51)
    goal = center + jnp.asarray([0.05, 0.0, -0.03])
    attitude = jd.frame_pose(model, q, "trunk")[:3, :3]
    law = jd.control.WholeBody(
        model,
        feet,
        goal,
        KP,
        KD,
        orientation=attitude,
        posture=q,
        forces=jd.control.GroundForces(preload=1.0, passive=(0, 1, 2)),
    )
    scene = jd.control.standing(model, q, feet)
    options = {
        "stepsize": 0.02,
        "events": [jd.events.ContactLost(stop=False)],
        "outputs": ("contact_margins", "contact_forces"),
    }
    motion = jd.simulate(scene, q, jnp.zeros(model.nv), ts, control=law, **options)
    errors = np.asarray(jax.vmap(lambda q: jd.center_of_mass(model, q))(motion.q) - goal)[:, [0, 2]]
    figure, left, right = pair()
    promised = decayed(np.asarray(ts), errors[0], np.zeros(2))
    against(left, ts, errors, promised, ("x", "z"), "|error of the centre of mass| (m)")
    for i, (name, margin) in enumerate(motion.contact_margins.items()):
        right.plot(ts, motion.contact_forces[name][:, 2], color=f"C{i}", label=f"{name}: normal force")
        right.plot(ts, margin, ":", color=f"C{i}", label=f"{name}: margin of its cone")
    least = min(float(margin.min()) for margin in motion.contact_margins.values())
    print(f"  least margin {least:.3f} N")
    right.axhline(0.0, color="k", linewidth=0.8)
    right.set(xlabel="t (s)", title="forces of the feet (N)", ylim=(-2, 72))
    right.legend(fontsize=7, loc="upper center", ncol=2)
    return figure


MASSES = 1.3 * np.random.default_rng(0).uniform(0.7, 1.3, 256)


def tuning_cost(log_gains, mass, end=1.0):
    """Of one particle on a sphere whose mass the law takes for 1.3 kg: errors of motion and of force, and torque."""
    kp, kd, ki = jnp.exp(log_gains)
    plant, model = scenes.spherical_pendulum(mass=mass), scenes.spherical_pendulum(mass=1.3)
    q, v = scenes.spherical_pendulum.start(theta=1.0, phi_rate=0.7)
    ts = jnp.linspace(0.0, end, 26)
    law = jd.control.HybridForce(model, first_two, circle, kp, kd, force=jnp.asarray([2.0]), ki=ki)
    outputs = ("multipliers", "torque")
    motion = jd.simulate(plant, q, v, ts, control=law, stepsize=0.02, outputs=outputs)
    errors = motion.q[:, :2] - jax.vmap(circle)(ts)
    force = motion.multipliers[:, 0] - 2.0
    return jnp.mean(jnp.sum(errors**2, 1) + 1e-3 * force**2 + 1e-4 * jnp.sum(motion.torque**2, 1))


def tuning():
    """Three gains tuned by gradient over 256 particles of other masses than the law's."""
    masses = jnp.asarray(MASSES)
    costs = jax.jit(jax.vmap(tuning_cost, (None, 0)))
    slope = jax.jit(jax.value_and_grad(lambda gains: jnp.mean(jax.vmap(tuning_cost, (None, 0))(gains, masses))))
    start = gains = jnp.log(jnp.asarray([4.0, 3.0, 1.0]))
    rule = optax.adam(0.2)
    state, history = rule.init(gains), []
    for _ in range(30):
        value, computed = slope(gains)
        history.append([float(value), *np.exp(gains)])
        step, state = rule.update(computed, state)
        gains = gains + step
    history = np.array(history)
    figure, left, right = pair()
    left.semilogy(history[:, 0], "k", label="mean cost")
    other = left.twinx()
    for i, name in enumerate(("kp (1/s2)", "kd (1/s)", "KI (1/s)")):
        other.semilogy(history[:, 1 + i], color=f"C{i}", label=name)
    left.set(xlabel="step", title="256 systems: mean cost and gains")
    left.legend(fontsize=8, loc="upper right"), other.legend(fontsize=8, loc="center right")
    for values, label in ((start, "before"), (gains, "after")):
        right.semilogy(MASSES, costs(values, masses), ".", label=label)
    right.axvline(1.3, color="k", linewidth=0.8, linestyle="--")
    right.set(xlabel="mass of the plant (kg)", title="cost of each; the law takes 1.3 kg")
    right.legend(fontsize=8)
    print(
        f"  cost {history[0, 0]:.4f} to {history[-1, 0]:.4f}, gains {np.exp(start).round(2)} to {np.exp(gains).round(2)}"
    )
    return figure


LAWS = {
    law.__name__: law
    for law in (
        computed_torque,
        operational_space,
        cartesian_stiffness,
        hybrid_force,
        hybrid_rates,
        contact_coordinates,
        parallel_manipulator,
        gauge_invariant,
        grasp_force,
        whole_body,
        tuning,
    )
}


def main(names) -> None:
    """Draw each."""
    for name in chosen_names(names, LAWS):
        print(f"{name}: {LAWS[name].__doc__}")
        path = FOLDER / f"control_{name}.png"
        LAWS[name]().savefig(path, dpi=80)
        print(f"  {path.relative_to(FOLDER.parent.parent)}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
