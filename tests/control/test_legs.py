"""Robots with legs: the centre of mass, forces of feet and inverse dynamics without a motor at the base, against Pinocchio."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, load_both, quick, random_states

import jaxdyn as jd

# File, feet, and whether they are flat.
ROBOTS = {
    "solo12.urdf": (("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), False),
    "hyq_no_sensors.urdf": (("lf_foot", "rf_foot", "lh_foot", "rh_foot"), False),
    "go2.urdf": (("FL_foot", "FR_foot", "RL_foot", "RR_foot"), False),
    "talos_reduced.urdf": (("left_sole_link", "right_sole_link"), True),
    "g1_29dof_rev_1_0.urdf": (("left_ankle_roll_link", "right_ankle_roll_link"), True),
}
CASES = [pytest.param(file, marks=() if file == "solo12.urdf" else pytest.mark.slow) for file in ROBOTS]


def feet_of(file, mu=0.6):
    """The robot's feet: points with friction, or rectangles of 16 by 10 cm."""
    names, flat = ROBOTS[file]
    cone = jd.contact.friction_cone("hard-finger", mu=mu)
    if flat:
        cone = jd.contact.surface_cone(jd.contact.wrench_cone(0.08, 0.05, mu))
    return [jd.control.foot(name, cone) for name in names]


def crouched(model, file):
    """A configuration with bent legs, the base level."""
    q = np.array(jd.neutral(model))
    bent = {"HFE": 0.8, "KFE": -1.6, "thigh": 0.8, "calf": -1.6, "hip_pitch": -0.3, "knee": 0.6, "ankle_pitch": -0.3}
    bent |= {"leg_left_3": -0.4, "leg_left_4": 0.8, "leg_left_5": -0.4} | {"hfe": 0.6, "kfe": -1.2}
    bent |= {"leg_right_3": -0.4, "leg_right_4": 0.8, "leg_right_5": -0.4}
    top = model.topology
    for name, kind, part in zip(top.joint_names, top.kinds, top.q_slices, strict=True):
        if kind != "free":
            q[part] = next((angle for key, angle in bent.items() if key in name), 0.0)
    if file == "hyq_no_sensors.urdf":  # its hind legs bend the other way
        for name, part in zip(top.joint_names, top.q_slices, strict=True):
            q[part] *= -1.0 if "h_" in name and ("hfe" in name or "kfe" in name) else 1.0
    return jnp.asarray(q)


@pytest.fixture(scope="module")
def solo():
    model, source, bridge = load_both("solo12.urdf", True)
    return model, source, bridge, crouched(model, "solo12.urdf"), feet_of("solo12.urdf")


@pytest.mark.parametrize("file", CASES)
def test_centre_of_mass_agrees_with_pinocchio(file):
    """Jacobian, momentum and its matrix at 1e-9; N = -m J^T g."""
    model, source, bridge = load_both(file, True)
    q, v, *_ = random_states(model, 1, 3)
    at = quick(
        lambda q, v: (
            jd.com_jacobian(model, q),
            jd.dynamics.centroidal_momentum_matrix(model, q),
            jd.dynamics.centroidal_momentum(model, q, v),
            jd.gravity_force(model, q),
        )
    )
    J, matrix, momentum, gravity = at(q[0], v[0])
    data, there = source.createData(), bridge.q_to_pinocchio(q[0])
    assert_close(J, pin.jacobianCenterOfMass(source, data, there), 1e-9)
    want = pin.ccrba(source, data, there, np.asarray(v[0]))
    assert_close(matrix, want, 1e-9)
    assert_close(momentum, data.hg.np, 1e-9)
    mass = float(model.inertias[:, 0].sum())
    assert_close(gravity, -mass * np.asarray(J).T @ np.asarray(model.gravity), 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("file", CASES)
def test_inverse_dynamics_agrees_with_pinocchio(file):
    """Pinocchio's rnea under the feet's wrenches gives our torques, and none at the base; forces are in their cones."""
    model, source, bridge = load_both(file, True)
    feet, q = feet_of(file), crouched(model, file)
    rng = np.random.default_rng(0)
    v, a = (jnp.asarray(x) for x in 0.1 * rng.normal(size=(2, model.nv)))
    legged = quick(lambda q, v, a: jd.control.underactuated_inverse_dynamics(model, q, v, a, feet))(q, v, a)
    assert bool(legged.success)
    assert np.asarray(legged.margins).min() > -1e-6  # the tolerance of the quadratic program, forces of some 100 N
    there, data = bridge.q_to_pinocchio(q), source.createData()
    pin.framesForwardKinematics(source, data, there)
    wrenches = [pin.Force.Zero() for _ in range(source.njoints)]
    for one, force in zip(feet, legged.by_foot().values(), strict=True):
        frame = source.frames[source.getFrameId(one.frame, pin.FrameType.BODY)]
        placed = data.oMf[source.getFrameId(one.frame, pin.FrameType.BODY)]
        wrench = np.zeros(6)
        wrench[: force.shape[0]] = force
        if not one.is_flat:
            wrench[:3] = placed.rotation.T @ wrench[:3]
        wrenches[frame.parentJoint] += frame.placement.act(pin.Force(wrench))
    want = pin.rnea(source, data, there, np.asarray(v), np.asarray(a), wrenches)
    assert_close(legged.tau, want, 1e-9)
    assert not np.asarray(legged.tau)[:6].any()


@pytest.mark.long
def test_what_the_feet_cannot_carry_has_a_code(solo):
    """A wanted fall faster than free fall asks feet to pull; a limit on torques that is too low."""
    model, _, _, q, feet = solo
    at_rest, down = jnp.zeros(model.nv), jnp.zeros(model.nv).at[2].set(-15.0)
    solve = quick(
        lambda a, limit: jd.control.underactuated_inverse_dynamics(model, q, at_rest, a, feet, effort_limit=limit)
    )
    assert bool(solve(at_rest, 10.0).success)
    for a, limit in ((down, 10.0), (at_rest, 0.01)):
        solution = solve(a, limit)
        assert solution.result == jd.RESULTS.infeasible
    missing = quick(lambda a: jd.control.missing_wrench(model, q, at_rest, a, feet))
    # Feet cannot pull: what is left is what the base needs, but for torques that no normal force could change.
    mass = float(model.inertias[:, 0].sum())
    np.testing.assert_allclose(missing(down)[2], mass * (9.81 - 15.0), rtol=1e-5)
    # The weight is 24 N, and the regularisation 1e-6.
    np.testing.assert_allclose(missing(at_rest), 0.0, atol=1e-4)
    # A program that was not solved has no remainder: forces beyond the largest number.
    remainders, slopes = jax.vmap(jax.value_and_grad(lambda x: missing(down * x)[2]))(jnp.array([1.0, 1e308]))
    np.testing.assert_allclose(remainders[0], mass * (9.81 - 15.0), rtol=1e-5)
    np.testing.assert_allclose(slopes[0], -15.0 * mass, rtol=1e-5)
    assert np.isnan(remainders[1]) and np.isnan(slopes[1])
    limited = solve(at_rest, 0.9)
    assert bool(limited.success) and np.abs(limited.tau).max() < 0.9 + 1e-6
    flying = jd.control.underactuated_inverse_dynamics(model, q, at_rest, at_rest, [])
    assert flying.result == jd.RESULTS.infeasible


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_remainder_of_a_body_behind_its_feet(dtype):
    """Two points in front of the centre of mass leave a moment, and in float32 their internal force is no less determined."""
    builder = jd.ModelBuilder("body").add_body("body", joint="free", inertia=(5.0, (0, 0, 0), (0.1, 0.1, 0.1)))
    for name, side in (("left", 0.15), ("right", -0.15)):
        builder = builder.add_body(name, "body", "fixed", pose=(0.02, side, -0.6))
    feet = [jd.control.foot(name, jd.contact.friction_cone("hard-finger", mu=0.6)) for name in ("left", "right")]
    model, feet = jax.tree.map(lambda x: x.astype(dtype), (builder.build(), feet))
    at_rest = jnp.zeros(6, dtype)
    missing = quick(lambda q: jd.control.missing_wrench(model, q, at_rest, at_rest, feet))(jd.neutral(model))
    # All forces are within their cones, so that linear least squares give the remainder.
    rows = [np.hstack([np.eye(3), jd.so3.hat(jnp.array([0.02, side, -0.6])).T]) for side in (0.15, -0.15)]
    G, needed = np.vstack(rows).T, np.array([0, 0, 5 * 9.81, 0, 0, 0])
    want = needed - G @ np.linalg.lstsq(G, needed, rcond=None)[0]
    # The regularisation changes forces by a millionth, in float32 by a hundred thousandth.
    assert missing.dtype == dtype and np.abs(want).max() > 0.5
    np.testing.assert_allclose(missing, want, atol=1e-4 if dtype == jnp.float64 else 1e-3)


@pytest.mark.long
def test_forces_are_differentiable(solo):
    """Gradients in the acceleration and in friction against differences, forces on the boundary of their cones."""
    model, _, _, q, _ = solo
    names, at_rest = ROBOTS["solo12.urdf"][0], jnp.zeros(model.nv)
    push = jnp.zeros(model.nv).at[0].set(3.0)

    def torque(mu, scale):
        feet = [jd.control.foot(name, jd.contact.friction_cone("hard-finger", mu=mu)) for name in names]
        legged = jd.control.underactuated_inverse_dynamics(model, q, at_rest, scale * push, feet)
        return jnp.sum(legged.tau**2)

    value = quick(torque)
    slopes = quick(jax.grad(torque, argnums=(0, 1)))(0.35, 1.0)
    step = 1e-5
    for i, slope in enumerate(slopes):
        high, low = (value(0.35 + s * step * (i == 0), 1.0 + s * step * (i == 1)) for s in (1, -1))
        # Differences of numbers with the tolerance of the program, 1e-9, over 2e-5.
        np.testing.assert_allclose(slope, (high - low) / (2 * step), rtol=1e-3, atol=1e-4)


def _solve(model, q, feet, **options):
    at_rest = jnp.zeros(model.nv)
    return jd.control.underactuated_inverse_dynamics(model, q, at_rest, at_rest, feet, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, q, f: _solve(m, q, [jd.control.foot("no", f[0].cone)]), "'no'"),
        (lambda m, q, f: _solve(m, q, [f[0], f[0]]), "a frame twice"),
        (lambda m, q, f: _solve(m, q, ["FL_FOOT"]), "contacts is"),
        (lambda m, q, f: _solve(m, q, f, passive=(99,)), "passive is"),
        (lambda m, q, f: _solve(m, q, f, effort_limit=[1.0, 2.0]), "effort_limit"),
        (lambda m, q, f: _solve(m, q, f, force_weight=-1.0), "force_weight is"),
        (lambda m, q, f: jd.control.foot("FL_FOOT", 0.6), "cone is 0.6"),
        (lambda m, q, f: jd.control.foot("FL_FOOT", f[0].cone, ground=2 * np.eye(3)), "no rotation"),
        (lambda m, q, f: _solve(jd.robots.iiwa(), jnp.zeros(7), f), "'FL_FOOT' is not"),
    ],
)
def test_bad_input_is_refused(solo, call, message):
    model, _, _, q, feet = solo
    with pytest.raises(ValueError, match=message):
        call(model, q, feet)
