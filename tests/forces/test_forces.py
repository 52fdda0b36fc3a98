"""Scene forces against closed forms of the motions they cause, and against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from pinocchio_bridge import quick, random_states
from refusals import refusals

import jaxdyn as jd

MASS = {"coast": 2.0, "drive": 1.5, "dry": 0.8, "pull": 3.0, "ring": 1.2, "shake": 0.7}
BALL = 0.35  # principal moment of the ball


@pytest.fixture(scope="module")
def sliders():
    """Independent sliders without gravity, one for each force, and a ball on a spherical joint."""
    builder = jd.ModelBuilder("sliders", gravity=None)
    for name, mass in MASS.items():
        builder.add_body(name, joint="prismatic", joint_name=name, axis=(1, 0, 0), inertia=(mass, (0, 0, 0), (0, 0, 0)))
    builder.add_body("turn", joint="spherical", joint_name="turn", inertia=(1.0, (0, 0, 0), (BALL, BALL, BALL)))
    return builder.build()


@pytest.fixture(scope="module")
def arm():
    """A branched model with every kind of joint, damping and friction."""
    builder = jd.ModelBuilder("arm")
    moments = (0.02, 0.03, 0.04)
    builder.add_body("base", joint="free", inertia=(2.0, (0.1, 0.0, 0.2), moments), damping=0.1)
    builder.add_body("hip", "base", "spherical", inertia=(1.0, (0, 0.1, 0), moments), pose=(0.1, 0.2, 0.3))
    builder.add_body("knee", "hip", "revolute", axis=(0, 1, 0), inertia=(0.5, (0, 0, -0.2), moments), pose=(0, 0, -0.4))
    builder.add_body("slide", "base", "planar", inertia=(0.7, (0.1, 0, 0), moments), friction=(0.3, 0.4, 0.5))
    builder.add_frame("foot", "knee", ((0.1, 0.0, -0.3), (0.2, 0.3, 0.4)))
    return builder.build()


@quick
def evaluate(force, model, q, v):
    return force(model, q, v, 0.0)


APPLIED = quick(lambda scene, q, v: scene.applied_force(q, v))
DIFFERENCE = quick(jd.difference)


def push(system, q, v, t):
    return jnp.zeros_like(v).at[system.joint_names.index("shake")].set(0.9 * jnp.cos(2.3 * t))


def oscillation(x0, v0, k, c, m, t):
    """Damped oscillator m x'' + c x' + k x = 0 by its complex roots."""
    r1, r2 = np.roots([m, c, k]).astype(complex)
    a, b = np.linalg.solve([[1, 1], [r1, r2]], [x0, v0])
    return (a * np.exp(r1 * t) + b * np.exp(r2 * t)).real, (a * r1 * np.exp(r1 * t) + b * r2 * np.exp(r2 * t)).real


@pytest.mark.long
def test_motions_against_closed_forms(sliders):
    ts = np.linspace(0.0, 3.0, 16)
    scene = jd.Scene(
        sliders,
        forces=(
            jd.forces.JointDamping(0.6, joints=("coast",)),
            jd.forces.Drive(4.0, 1.1, target=0.5, target_velocity=0.2, joints="drive"),
            jd.forces.CoulombFriction(0.5, v_s=0.3, joints=["dry"]),
            jd.forces.ExternalWrench("pull", (1.7, 0.4, -2.0, 0.1, 0.2, 0.3), axes="body"),
            jd.forces.JointSpring(5.0, rest=0.1, joints=("ring",)),
            jd.forces.JointDamping(0.4, joints=("ring",)),
            jd.forces.JointSpring([3.0], rest=[0.0], joints=("shake",)),
            push,
            jd.forces.JointSpring(0.8, joints=("turn",)),
        ),
    )
    axis = np.array([0.6, 0.0, 0.8])
    start = np.array([0.3, -0.2, 0.1, 0.0, 0.4, 0.2])
    speed = np.array([1.0, 0.5, 0.9, -0.3, 0.7, -0.1])
    q0 = np.concatenate([start, [np.cos(0.5)], np.sin(0.5) * axis])
    v0 = np.concatenate([speed, 0.3 * axis])
    # Dense output is an order of magnitude less accurate than the steps, hence the tight tolerances.
    solution = jd.simulate(scene, q0, v0, ts, stepsize=within(1e-14))
    names = list(sliders.joint_names)
    assert names == [*MASS, "turn"]
    expected = {}
    decay = np.exp(-0.6 / 2.0 * ts)
    expected["coast"] = 0.3 + 1.0 * 2.0 / 0.6 * (1 - decay), decay
    # The drive holds where kp (target - x) + kd target_velocity vanishes.
    x, v = oscillation(-0.2 - 0.555, 0.5, 4.0, 1.1, MASS["drive"], ts)
    expected["drive"] = x + 0.555, v
    expected["dry"] = None, 0.3 * np.arcsinh(np.sinh(0.9 / 0.3) * np.exp(-0.5 / (0.8 * 0.3) * ts))
    expected["pull"] = -0.3 * ts + 1.7 / 3.0 * ts**2 / 2, -0.3 + 1.7 / 3.0 * ts
    x, v = oscillation(0.3, 0.7, 5.0, 0.4, MASS["ring"], ts)
    expected["ring"] = x + 0.1, v
    gain, w = 0.9 / (3.0 - 0.7 * 2.3**2), 2.3  # steady response to the push
    x, v = oscillation(0.2 - gain, -0.1, 3.0, 0.0, MASS["shake"], ts)
    expected["shake"] = x + gain * np.cos(w * ts), v - gain * w * np.sin(w * ts)
    for name, (x, v) in expected.items():
        i = names.index(name)
        if x is not None:
            np.testing.assert_allclose(solution.q[:, i], x, rtol=0, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(solution.v[:, i], v, rtol=0, atol=1e-10, err_msg=name)
    # About a fixed axis the ball is an oscillator in the angle.
    angle, rate = oscillation(1.0, 0.3, 0.8, 0.0, BALL, ts)
    np.testing.assert_allclose(solution.v[:, -3:], rate[:, None] * axis, rtol=0, atol=1e-10)
    quaternion = np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], 1)
    np.testing.assert_allclose(solution.q[:, -4:], quaternion, rtol=0, atol=1e-10)


def sample(model, seed=0):
    """A random state, with unit quaternions."""
    q, v, *_ = random_states(model, 1, seed)
    return q[0], v[0]


def test_defaults_of_the_model(arm):
    q, v = sample(arm)
    damping = np.concatenate([np.full(6, 0.1), np.zeros(7)])
    friction = np.concatenate([np.zeros(10), [0.3, 0.4, 0.5]])
    assert arm.joint_names == ("base_joint", "hip_joint", "knee_joint", "slide_joint")
    np.testing.assert_allclose(evaluate(jd.forces.JointDamping(), arm, q, v), -damping * v, rtol=1e-15)
    expected = -friction * np.tanh(v / 0.2)
    np.testing.assert_allclose(evaluate(jd.forces.CoulombFriction(v_s=0.2), arm, q, v), expected, rtol=1e-14)
    total = jd.Scene(arm, forces=(jd.forces.JointDamping(), jd.forces.CoulombFriction(v_s=0.2))).applied_force(q, v)
    np.testing.assert_allclose(total, expected - damping * v, rtol=1e-14)
    assert jd.Scene(arm).applied_force(q, v) is None


@pytest.mark.parametrize("convert", [list, np.array, jnp.array])
def test_integers_are_numbers(sliders, convert):
    """A state of integers gives the forces of the same state of floats: fractions of coefficients are kept."""
    forces = [
        jd.forces.JointDamping(0.7, "coast"),
        jd.forces.JointSpring(2.5, 0.25, "drive"),
        jd.forces.EffortLimits(0.5),
    ]
    scene = jd.Scene(sliders, forces=forces)
    q, v = convert([1, 2, 0, 0, 0, 0, 1, 0, 0, 0]), convert([3, 1, 0, 0, 0, 0, 0, 0, 0])
    expected = [-0.7 * 3, -2.5 * (2 - 0.25)]
    np.testing.assert_allclose(scene.applied_force(q, v, 1)[:2], expected, rtol=1e-15)
    np.testing.assert_allclose(scene.clip_effort(v), np.clip(v, -0.5, 0.5), rtol=1e-15)
    np.testing.assert_allclose(scene.drive_torque(q, v, 1, v)[0], np.clip(v, -0.5, 0.5), rtol=1e-15)
    with pytest.raises(ValueError, match="v has shape"):
        scene.applied_force(q, v[:2])


def test_joints_are_taken_in_the_order_named(arm):
    q, v = sample(arm)
    coefficient = np.arange(1.0, 5.0)
    force = evaluate(jd.forces.JointDamping(coefficient, joints=("slide_joint", "knee_joint")), arm, q, v)
    expected = np.zeros(13)
    expected[10:], expected[9] = -coefficient[:3] * v[10:], -coefficient[3] * v[9]
    np.testing.assert_allclose(force, expected, rtol=1e-15)
    spring = jd.forces.JointSpring(coefficient, rest=[0.1, 0.2, 0.3, 0.4], joints=("knee_joint", "hip_joint"))
    with pytest.raises(ValueError, match="rest has shape"):
        evaluate(spring, arm, q, v)


@pytest.mark.long
def test_spring_and_drive_move_along_the_manifold(arm):
    """A unit-gain spring is the library's difference, and minus the gradient of its energy where it is conservative."""
    q, v = sample(arm, 3)
    rest, _ = sample(arm, 7)
    np.testing.assert_allclose(
        evaluate(jd.forces.JointSpring(2.0, rest), arm, q, v), -2 * np.asarray(DIFFERENCE(arm, rest, q)), rtol=1e-14
    )
    # A drive pulls along the twist from q to the target; the spring's twist from its rest is the opposite one.
    drive = evaluate(jd.forces.Drive(2.0, 0.3, rest, target_velocity=0.7), arm, q, v)
    along = np.asarray(DIFFERENCE(arm, q, rest))
    np.testing.assert_allclose(drive, 2 * along + 0.3 * (0.7 - np.asarray(v)), rtol=0, atol=1e-13)
    place = slice(6, 10)  # the spherical and the revolute joint

    def energy(step):
        return 0.5 * 2.0 * jnp.sum(jd.difference(arm, rest, jd.integrate(arm, q, step))[place] ** 2)

    gradient = quick(jax.grad(energy))(jnp.zeros(13))[place]
    spring = evaluate(jd.forces.JointSpring(2.0, rest[7:12], joints=("hip_joint", "knee_joint")), arm, q, v)
    np.testing.assert_allclose(spring[place], -gradient, rtol=1e-12, atol=1e-13)
    assert not np.any(spring[:6]) and not np.any(spring[10:])
    assert not np.any(evaluate(jd.forces.JointSpring(2.0), arm, jd.neutral(arm), v))


def test_effort_limit(arm):
    q, v = sample(arm, 3)
    target, _ = sample(arm, 7)
    free = evaluate(jd.forces.Drive(50.0, 1.0, target), arm, q, v)
    limits = np.where(np.arange(13) % 2, 4.0, np.inf)
    held = evaluate(jd.forces.Drive(50.0, 1.0, target, effort_limit=limits), arm, q, v)
    np.testing.assert_allclose(held[::2], free[::2], rtol=1e-15)
    np.testing.assert_allclose(held[1::2], 4 * np.tanh(free[1::2] / 4), rtol=1e-14)
    # Far below the limit tanh is the identity but for a third of the squared ratio to it.
    small, same = (evaluate(jd.forces.Drive(0.05, 0.0, target, effort_limit=x), arm, q, v) for x in (4.0, np.inf))
    np.testing.assert_allclose(small, same, rtol=1e-2)
    total = quick(jax.grad(lambda limit: jnp.sum(jd.forces.Drive(50.0, 1.0, target, 0.0, limit)(arm, q, v, 0.0))))
    gradient = total(jnp.asarray(limits))
    assert np.isfinite(gradient).all() and np.all(gradient[1::2] != 0)


@pytest.mark.parametrize("axes", ["world", "body"])
def test_external_wrench(arm, axes):
    """Against the wrench carried to the body by hand, and against virtual work by finite differences."""
    q, v = sample(arm, 5)
    wrench = np.array([1.0, -2.0, 3.0, 0.4, 0.5, -0.6])
    value = evaluate(jd.forces.ExternalWrench("foot", wrench, axes), arm, q, v)
    steps = 1e-5 * np.concatenate([np.zeros((1, 13)), np.eye(13), -np.eye(13)])
    poses = quick(jax.vmap(lambda step: jd.frame_pose(arm, jd.integrate(arm, q, step), "foot")))(jnp.asarray(steps))
    pose = np.asarray(poses[0])
    rotation = pose[:3, :3]
    force, torque = (wrench[:3], wrench[3:]) if axes == "world" else (rotation @ wrench[:3], rotation @ wrench[3:])
    knee = np.asarray(quick(jd.forward_kinematics)(arm, q))[arm.body_names.index("knee")]
    torque_knee = torque + np.cross(pose[:3, 3] - knee[:3, 3], force)
    external = np.zeros((4, 6))
    external[arm.body_names.index("knee")] = [*(knee[:3, :3].T @ force), *(knee[:3, :3].T @ torque_knee)]
    np.testing.assert_allclose(
        value, quick(jd.dynamics.generalized_force)(arm, q, jnp.asarray(external)), rtol=0, atol=1e-13
    )
    rate = (np.asarray(poses[1:14]) - np.asarray(poses[14:])) / 2e-5
    spin = rate[:, :3, :3] @ rotation.T
    omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1)
    # Central differences of step 1e-5 are good to 1e-10 of a second derivative of order one.
    np.testing.assert_allclose(value, rate[:, :3, 3] @ force + omega @ torque, rtol=0, atol=1e-8)


def all_forces(arm, coefficient):
    rest = jd.neutral(arm)
    return jd.Scene(
        arm,
        forces=(
            jd.forces.JointDamping(coefficient),
            jd.forces.CoulombFriction(coefficient, v_s=0.5),
            jd.forces.JointSpring(coefficient),
            jd.forces.Drive(coefficient, coefficient, rest, coefficient, effort_limit=9.0),
            jd.forces.ExternalWrench("foot", jnp.full(6, 1.0) * coefficient),
        ),
    )


@pytest.mark.long
def test_derivatives():
    """Reverse mode and forward over reverse against central differences at a general point; finite at rest."""
    builder = jd.ModelBuilder("leg")
    moments = (0.02, 0.03, 0.04)
    builder.add_body("hip", joint="spherical", inertia=(1.0, (0, 0.1, 0), moments))
    builder.add_body("knee", "hip", "revolute", axis=(0, 1, 0), inertia=(0.5, (0, 0, -0.2), moments), pose=(0, 0, -0.4))
    builder.add_frame("foot", "knee", ((0.1, 0.0, -0.3), (0.2, 0.3, 0.4)))
    leg = builder.build()

    def total(z, q):
        force = all_forces(leg, z[0]).applied_force(jd.integrate(leg, q, z[1:5]), z[5:])
        return jnp.sum(force * jnp.arange(1.0, 5.0))

    @quick
    @jax.vmap
    def derivatives(z, q):
        return total(z, q), jax.grad(total)(z, q), jax.hessian(total)(z, q)

    q, v = sample(leg, 11)
    point, step = np.concatenate([[0.7], np.zeros(4), v]), 1e-5
    rest = np.concatenate([[0.7], np.zeros(8)])
    points = np.concatenate([point + step * np.eye(9), point - step * np.eye(9), [point, rest]])
    places = np.concatenate([np.tile(q, (19, 1)), [jd.neutral(leg)]])
    value, gradient, hessian = (np.asarray(x) for x in derivatives(jnp.asarray(points), jnp.asarray(places)))
    # Central differences of step 1e-5: truncation 1e-10 of the third derivative, rounding 1e-11 of the value.
    slope = (value[:9] - value[9:18]) / (2 * step)
    np.testing.assert_allclose(gradient[18], slope, rtol=1e-7, atol=1e-7)
    curvature = (gradient[:9] - gradient[9:18]) / (2 * step)
    np.testing.assert_allclose(hessian[18], curvature, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(hessian[18], hessian[18].T, rtol=1e-11, atol=1e-11)
    assert np.isfinite(gradient[19]).all() and np.isfinite(hessian[19]).all() and np.any(hessian[19])


@pytest.mark.long
def test_scenes_are_arguments_and_batches(arm):
    """A scene of library forces is an array pytree for jit, and vmap reaches its leaves."""
    q, v = sample(arm, 11)
    coefficients = np.array([0.0, 0.3, 2.0])
    scenes = jax.vmap(lambda c: all_forces(arm, c))(jnp.asarray(coefficients))
    axes = jax.tree.map(lambda x, y: 0 if x.ndim > y.ndim else None, scenes, all_forces(arm, 0.0))
    batch = quick(jax.vmap(lambda scene: scene.applied_force(q, v), (axes,)))(scenes)
    one_by_one = [APPLIED(all_forces(arm, c), q, v) for c in coefficients]
    np.testing.assert_allclose(batch, one_by_one, rtol=1e-13)


@pytest.mark.long
def test_float32(arm):
    single = jax.tree.map(lambda x: x.astype(jnp.float32), arm)
    q, v = sample(arm, 11)
    scene = all_forces(single, 0.7)
    value = APPLIED(scene, q.astype(jnp.float32), v.astype(jnp.float32))
    assert value.dtype == jnp.float32
    reference = np.asarray(APPLIED(all_forces(arm, 0.7), q, v))
    np.testing.assert_allclose(value, reference, rtol=0, atol=2e-5 * np.abs(reference).max())


def test_leaves_are_not_weakly_typed():
    """A coefficient given as a Python number must not compile anew when an array takes its place."""
    leaves = jax.tree.leaves(
        (
            jd.forces.JointDamping(1),
            jd.forces.CoulombFriction(0.5),
            jd.forces.Drive(1, 2, 3, 4, 5),
            jd.forces.ExternalWrench("a", [0] * 6),
        )
    )
    assert len(leaves) == 9 and all(x.dtype == jnp.float64 and not x.weak_type for x in leaves)


def applied(model, force):
    return jd.Scene(model, forces=(force,)).applied_force(*sample(model))


test_what_does_not_fit_is_refused = refusals(
    (lambda m, _: jd.Scene(3), "system is a"),
    (lambda m, _: jd.Scene(m, forces=jd.forces.JointDamping(1.0)), "forces is a"),
    (lambda m, _: jd.Scene(m, forces=(3.0,)), r"forces\[0\] is 3.0"),
    (lambda m, _: jd.Scene(m, constraints="loop"), "constraints is a"),
    (lambda m, _: jd.forces.CoulombFriction(1.0, v_s=0.0), "v_s is 0.0"),
    (lambda m, _: jd.forces.Drive(1.0, 1.0, 0.0, effort_limit=-1.0), "effort_limit is -1.0"),
    (lambda m, _: jd.forces.ExternalWrench("foot", [1.0]), "wrench has shape"),
    (lambda m, _: jd.forces.ExternalWrench("foot", [1.0] * 6, "tool"), "axes is 'tool'"),
    (lambda m, _: applied(m, jd.forces.JointDamping(1.0, joints=("elbow",))), r"\['elbow'\] are not"),
    (lambda m, _: applied(m, jd.forces.JointDamping([1.0, 2.0])), "coefficient has shape"),
    (lambda m, _: applied(m, jd.forces.JointSpring(1.0, rest=0.0)), "rest is a"),
    (lambda m, _: applied(m, jd.forces.Drive(1.0, 1.0, [0.0, 0.0], joints=("knee_joint",))), "target has shape"),
    (lambda m, _: applied(m, jd.forces.Drive(1.0, [1.0, 1.0], 0.0, joints=("knee_joint",))), "kd has shape"),
    (lambda m, _: applied(m, jd.forces.ExternalWrench("fot", [0.0] * 6)), "you mean foot"),
    (lambda m, _: applied(m, lambda system, q, v, t: q), r"forces\[0\] returned shape"),
    (lambda _, bare: applied(bare, jd.forces.JointDamping()), "JointDamping: no value"),
    (lambda _, bare: applied(bare, jd.forces.CoulombFriction()), "CoulombFriction: no value"),
    given=("arm", "sliders"),
)
