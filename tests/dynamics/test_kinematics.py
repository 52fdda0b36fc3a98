"""Forward kinematics, Jacobians and their rates against Pinocchio, matrix exponentials, rates along the motion."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import (
    as_dtype,
    assert_close,
    make_model,
    quick,
    random_inertia,
    random_states,
    random_tree,
    to_pinocchio,
)
from scipy.linalg import expm

import jaxdyn as jd
from jaxdyn import se3

ALL_KINDS = ["free", "revolute", "spherical", "planar", "helical", "prismatic", "continuous", "revolute"]
CASES = {
    "every_kind": lambda: random_tree(1, ALL_KINDS),
    "forest": lambda: random_tree(2, ALL_KINDS, parents=[-1, 0, 0, 2, -1, 4, 5, 4]),
}


@functools.cache
def case(name):
    model = CASES[name]()
    source, bridge = to_pinocchio(model)
    frames = [model.frame_names[i] for i in (0, len(model.frame_names) // 2, -1)]
    q, v, _, _, _ = random_states(model, 5, 3)

    def values(model, q, v):
        out = {"bodies": jd.forward_kinematics(model, q)}
        for i, frame in enumerate(frames):
            out[f"pose{i}"] = jd.frame_pose(model, q, frame)
            out[f"body{i}"] = jd.body_jacobian(model, q, frame)
            out[f"spatial{i}"] = jd.dynamics.spatial_jacobian(model, q, frame)
            out[f"rate{i}"] = jd.dynamics.jacobian_dot_v(model, q, v, frame)
            out[f"aligned{i}"] = jd.frame_jacobian(model, q, frame)
            out[f"velocity{i}"] = jd.frame_velocity(model, q, v, frame)
            out[f"acceleration{i}"] = jd.dynamics.frame_acceleration(model, q, v, jnp.cos(v), frame)
        return out

    compiled = quick(jax.vmap(values, (None, 0, 0)))
    return source, model, bridge, frames, q, v, jax.tree.map(np.asarray, compiled(model, q, v))


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "every_kind")) for name in CASES]
)
def test_agrees_with_pinocchio(name):
    source, model, bridge, frames, q, v, ours = case(name)
    data = source.createData()
    for s, (qs, vs) in enumerate(zip(bridge.q_to_pinocchio(q), np.asarray(v), strict=True)):
        pin.forwardKinematics(source, data, qs, vs, np.zeros(model.nv))
        pin.computeJointJacobians(source, data, qs)
        pin.updateFramePlacements(source, data)
        bodies = [data.oMi[i + 1].homogeneous @ bridge.offsets[i] for i in range(model.nb)]
        assert_close(ours["bodies"][s], np.stack(bodies), label="bodies")
        for i, frame in enumerate(frames):
            index = source.getFrameId(frame) if source.existFrame(frame) else None
            if index is None:  # the bridge's own name of a body frame
                body = model.topology.frame_bodies[model.frame_names.index(frame)]
                index = source.addFrame(pin.Frame(frame, body + 1, 0, pin.SE3.Identity(), pin.FrameType.OP_FRAME))
                data = source.createData()
                pin.forwardKinematics(source, data, qs, vs, np.zeros(model.nv))
                pin.computeJointJacobians(source, data, qs)
                pin.updateFramePlacements(source, data)
            assert_close(ours[f"pose{i}"][s], data.oMf[index].homogeneous, label="pose")
            local = pin.getFrameJacobian(source, data, index, pin.ReferenceFrame.LOCAL)
            world = pin.getFrameJacobian(source, data, index, pin.ReferenceFrame.WORLD)
            assert_close(ours[f"body{i}"][s], local, label="body jacobian")
            assert_close(ours[f"spatial{i}"][s], world, label="spatial jacobian")
            rate = pin.getFrameAcceleration(source, data, index, pin.ReferenceFrame.LOCAL).vector
            assert_close(ours[f"rate{i}"][s], rate, label="rate")
            aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            there = pin.getFrameJacobian(source, data, index, aligned)
            assert_close(ours[f"aligned{i}"][s], there, label="jacobian in world axes")
            velocity = pin.getFrameVelocity(source, data, index, aligned).vector
            assert_close(ours[f"velocity{i}"][s], velocity, label="velocity")
            pin.forwardKinematics(source, data, qs, vs, np.cos(vs))
            acceleration = pin.getFrameClassicalAcceleration(source, data, index, aligned).vector
            assert_close(ours[f"acceleration{i}"][s], acceleration, label="acceleration")
            pin.forwardKinematics(source, data, qs, vs, np.zeros(model.nv))


def test_jacobians_are_derivatives_of_the_pose():
    # hat(J_b v) = T^-1 dT/dt, hat(J_s v) = dT/dt T^-1, and jacobian_dot_v is the derivative of J_b v at constant v.
    _, model, _, frames, q, v, ours = case("every_kind")
    frame = frames[-1]

    @quick
    @jax.vmap
    def along(q, v):
        flow = (jd.configuration_rate(model, q, v),)
        pose, rate = jax.jvp(lambda q: jd.frame_pose(model, q, frame), (q,), flow)
        _, jacobian_rate = jax.jvp(lambda q: jd.body_jacobian(model, q, frame), (q,), flow)
        inverse = se3.inverse(pose)
        return se3.vee(inverse @ rate), se3.vee(rate @ inverse), jacobian_rate @ v

    body, spatial, rate = along(q, v)
    assert_close(np.einsum("sij,sj->si", ours["body2"], v), body)
    assert_close(np.einsum("sij,sj->si", ours["spatial2"], v), spatial)
    assert_close(ours["rate2"], rate)
    adjoint = np.asarray(quick(jax.vmap(se3.Ad))(ours["pose2"]))
    assert_close(ours["spatial2"], adjoint @ ours["body2"])


@pytest.mark.long
def test_acceleration_is_the_rate_of_the_velocity():
    # The second derivative of the pose's origin along a motion q(t) with dq/dt = H v, dv/dt = a, and that of its rotation.
    _, model, _, frames, q, v, ours = case("every_kind")

    @quick
    @jax.vmap
    def along(q, v):
        step = jd.configuration_rate(model, q, v), jnp.cos(v)
        return jax.jvp(lambda q, v: jd.frame_velocity(model, q, v, frames[-1]), (q, v), step)

    velocity, rate = along(q, v)
    assert_close(velocity, np.einsum("sij,sj->si", ours["aligned2"], v))
    assert_close(ours["acceleration2"], rate)


def test_joints_name_the_frames_of_their_bodies():
    model = random_tree(1, ALL_KINDS)
    q = random_states(model, 5, 1)[0][0]
    for joint, body in zip(model.joint_names, model.body_names, strict=True):
        assert joint not in model.frame_names
        np.testing.assert_array_equal(jd.frame_pose(model, q, joint), jd.frame_pose(model, q, body))
    with pytest.raises(ValueError, match="axes is 'local'"):
        jd.frame_jacobian(model, q, None, axes="local")


def _hat(screw):
    x, y, z = screw[3:]
    return np.array([[0, -z, y, screw[0]], [z, 0, -x, screw[1]], [-y, x, 0, screw[2]], [0, 0, 0, 0]])


def test_product_of_exponentials():
    # A chain and a comb of any screw, every depth up to 33, against products of matrix exponentials.
    kinds = ["revolute", "helical", "prismatic"] * 11
    chain = random_tree(5, kinds, parents=list(range(-1, 32)))
    comb = random_tree(6, kinds)
    for model in (chain, comb):
        q = random_states(model, 1, 0)[0][0]
        poses = quick(jd.forward_kinematics)(model, q)
        want, (q, home, screws) = [], (np.asarray(x) for x in (q, model.home, model.screws))
        for i, parent in enumerate(model.topology.parents):
            above = np.eye(4) if parent < 0 else want[parent]
            want.append(above @ home[i] @ expm(_hat(screws[i]) * q[i]))
        assert_close(poses, np.stack(want))


def test_program_grows_with_the_logarithm_of_depth():
    def operations(n):
        model = random_tree(0, ["revolute"] * n, parents=list(range(-1, n - 1)))
        with jd.compilation("plain"):
            jaxpr = jax.make_jaxpr(jd.forward_kinematics)(model, jnp.zeros(n))
        return str(jaxpr).count("dot_general")

    assert operations(256) - operations(128) == operations(128) - operations(64) == 1


def test_neutral_is_home_and_derivatives_are_finite_there():
    model = random_tree(3, ["free", "planar", "helical"], parents=[-1, 0, 1])
    q = jnp.asarray(np.concatenate([[0, 0, 0, 1], np.zeros(7)]))
    want = []
    for i, parent in enumerate(model.topology.parents):
        want.append((np.eye(4) if parent < 0 else want[parent]) @ np.asarray(model.home[i]))
    assert_close(jd.forward_kinematics(model, q), np.stack(want))
    second = jax.hessian(lambda q: jnp.sum(jd.forward_kinematics(model, q)[-1]))
    hessian = quick(second)(q)
    assert np.isfinite(hessian).all() and np.abs(hessian).max() > 0


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_far_robot_is_as_exact_as_at_home(dtype):
    # Moving the robot by 1e4 m along the world axes changes no bit of what does not depend on the place.
    fixed = as_dtype(random_tree(4, ["revolute", "helical", "spherical", "prismatic"]), dtype)
    far_fixed = fixed.replace(home=fixed.home.at[0, :3, 3].add(jnp.asarray([1e4, -2e4, 1e4], dtype)))
    free = as_dtype(random_tree(4, ["free", "revolute", "revolute"]), dtype)
    for near, far, shift in ((fixed, far_fixed, 0.0), (free, free, 1e4)):
        q, v, _, _, _ = (x[0] for x in random_states(near, 1, 1))
        q_far = q.at[:3].add(jnp.asarray(shift, dtype)) if shift else q
        frame = near.frame_names[-1]

        @quick
        def values(model, q, v=v, frame=frame):
            rate = jd.dynamics.jacobian_dot_v(model, q, v, frame)
            return jd.body_jacobian(model, q, frame), rate, jd.dynamics.spatial_jacobian(model, q, frame)

        at_home, there = values(near, q), values(far, q_far)
        np.testing.assert_array_equal(at_home[0], there[0])
        np.testing.assert_array_equal(at_home[1], there[1])
        assert {x.dtype for x in there} == {jnp.dtype(dtype)}


def test_frames_of_the_world():
    model = random_tree(1, ["revolute", "revolute"])
    q = jnp.asarray([0.3, 0.4])
    np.testing.assert_array_equal(jd.frame_pose(model, q, None), np.eye(4))
    np.testing.assert_array_equal(jd.body_jacobian(model, q, None), np.zeros((6, 2)))
    np.testing.assert_array_equal(jd.dynamics.spatial_jacobian(model, q, None), np.zeros((6, 2)))
    np.testing.assert_array_equal(jd.dynamics.jacobian_dot_v(model, q, q, None), np.zeros(6))


def test_one_body_on_a_screw():
    # Closed form: a point at radius 1 about z, pitch 0.5.
    rng = np.random.default_rng(0)
    model = make_model([-1], [np.eye(4)], [[0, 0, 0.5, 0, 0, 1]], [random_inertia(rng)], kinds=["helical"])
    pose = jd.forward_kinematics(model, jnp.asarray([np.pi / 2]))[0]
    assert_close(pose, [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, np.pi / 4], [0, 0, 0, 1]], 1e-15)


def test_refusals():
    model = random_tree(1, ["revolute", "revolute"])
    with pytest.raises(ValueError, match="q has shape"):
        jd.forward_kinematics(model, jnp.zeros(3))
    with pytest.raises(ValueError, match="did you mean"):
        jd.frame_pose(model, jnp.zeros(2), "f11")
    for function in (jd.body_jacobian, jd.dynamics.spatial_jacobian):
        with pytest.raises(ValueError, match="'nothing' is not"):
            function(model, jnp.zeros(2), "nothing")
    with pytest.raises(ValueError, match="v has shape"):
        jd.dynamics.jacobian_dot_v(model, jnp.zeros(2), jnp.zeros(1), "f1")
