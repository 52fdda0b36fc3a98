"""Dynamics in the workspace against numpy and Pinocchio, its identities, and what it does near a singular configuration."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import assert_close, quick, to_pinocchio
from refusals import refusals

import jaxdyn as jd
from jaxdyn import robots, scenes

ARM = scenes.sphere_arm().system
Q = jnp.array([0.3, 0.8, -1.5, 0.4, 0.9, -0.6])
V = jnp.array([0.7, -0.4, 0.9, 1.1, -0.8, 0.5])
TAU = jnp.array([3.0, -2.0, 1.5, 0.3, 0.2, -0.1])


@pytest.fixture(scope="module")
def at():
    """Workspace dynamics and what it is checked with, at one place and a little before and after on the motion."""
    step = 1e-4

    @quick
    def compute(q, v, tau):
        dynamics = jd.dynamics.workspace_dynamics(ARM, "tip", q, v)
        near = jnp.stack([jd.integrate(ARM, q, k * step * v) for k in (-2.0, -1.0, 1.0, 2.0)])
        masses = jax.vmap(lambda q: jd.dynamics.workspace_dynamics(ARM, "tip", q, v).mass_matrix)(near)
        rate = (masses[0] - 8 * masses[1] + 8 * masses[2] - masses[3]) / (12 * step)
        acceleration = jd.forward_dynamics(ARM, q, v, tau)
        twist_rate = dynamics.jacobian @ acceleration + jd.dynamics.jacobian_dot_v(ARM, q, v, "tip")
        return dynamics, rate, twist_rate, jd.coriolis_matrix(ARM, q, v)

    return compute(Q, V, TAU)


@pytest.fixture(scope="module")
def by_pinocchio():
    """M, C v, N, body Jacobian and its rate times v."""
    model, _ = to_pinocchio(ARM)
    data, q, v = model.createData(), np.asarray(Q), np.asarray(V)
    frame = model.getFrameId("tip")
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    N = pin.computeGeneralizedGravity(model, data, q).copy()
    Cv = pin.rnea(model, data, q, v, np.zeros(6)) - N
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL)
    pin.forwardKinematics(model, data, q, v, np.zeros(6))
    drift = pin.getFrameAcceleration(model, data, frame, pin.LOCAL).vector
    return M, Cv, N, J, drift


def test_square_jacobian_gives_the_printed_matrices(at, by_pinocchio):
    computed, _, _, C = at
    M, Cv, N, J, drift = by_pinocchio
    back = np.linalg.inv(J)
    M_x = back.T @ M @ back
    assert_close(computed.jacobian, J)
    assert_close(computed.mass_matrix, M_x)
    assert_close(computed.gravity_force, back.T @ N)
    assert_close(computed.inverse, back)
    assert_close(computed.coriolis_force, back.T @ Cv - M_x @ drift)
    assert_close(
        computed.coriolis_matrix, back.T @ (np.asarray(C) @ back - M @ back @ np.asarray(computed.jacobian_rate) @ back)
    )
    assert_close(computed.coriolis_matrix @ (J @ V), computed.coriolis_force)
    assert_close(computed.jacobian_rate @ V, drift)
    assert not bool(computed.damped) and 0 < float(computed.condition) < 1


def test_mass_rate_less_twice_coriolis_is_skew(at):
    computed, rate, _, _ = at
    skew = rate - 2 * computed.coriolis_matrix
    # Fourth-order differences with steps of 1e-4 s.
    np.testing.assert_allclose(skew, -skew.T, atol=1e-8 * float(jnp.abs(rate).max()))


def test_equation_of_motion_and_power(at):
    computed, _, twist_rate, _ = at
    force = computed.inverse.T @ TAU
    assert_close(computed.mass_matrix @ twist_rate + computed.coriolis_force + computed.gravity_force, force)
    twist = computed.jacobian @ V
    assert_close(force @ twist, TAU @ V)
    assert_close(twist @ computed.mass_matrix @ twist / 2, jd.kinetic_energy(ARM, Q, V))


def test_redundant_arm_moves_its_frame_with_the_least_energy():
    """Seven joints: Khatib's quantities by numpy, in world axes."""
    arm, rng = robots.iiwa(), np.random.default_rng(3)
    q, v, tau = jnp.asarray(rng.normal(size=(3, 7)))

    @quick
    def compute(q, v, tau):
        computed = jd.dynamics.workspace_dynamics(arm, "iiwa_link_7", q, v, axes="world")
        return computed, jd.mass_matrix(arm, q), jd.bias_force(arm, q, v), jd.forward_dynamics(arm, q, v, tau)

    computed, M, h, a = compute(q, v, tau)
    model, _ = to_pinocchio(arm)
    data, frame = model.createData(), model.getFrameId("iiwa_link_7")
    J = pin.computeFrameJacobian(model, data, np.asarray(q), frame, pin.LOCAL_WORLD_ALIGNED)
    pin.forwardKinematics(model, data, np.asarray(q), np.asarray(v), np.zeros(7))
    drift = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).vector
    assert_close(computed.jacobian, J)
    assert_close(computed.jacobian_rate @ v, drift)
    Lambda = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    assert_close(computed.mass_matrix, Lambda)
    assert_close(computed.jacobian @ computed.inverse, np.eye(6))
    # Least energy: to what does not move the frame the motion is orthogonal.
    null = np.linalg.svd(J)[2][6:]
    assert_close(null @ M @ computed.inverse, np.zeros((1, 6)))
    assert_close(computed.coriolis_force + computed.gravity_force, computed.inverse.T @ h - Lambda @ drift)
    assert_close(Lambda @ (J @ a + drift) + computed.coriolis_force + computed.gravity_force, computed.inverse.T @ tau)


def elbow(angle):
    """An arm of two unit bars in the x-y plane."""
    return jnp.stack([jnp.full_like(angle, 0.4), angle])


@pytest.mark.long
def test_near_a_singularity_it_is_damped_and_says_so():
    """Two bars that are nearly straight: M_x by hand away from it; there bounded, with a gradient that is finite."""
    arm = jd.ModelBuilder("two bars", gravity=None)
    bar = (1.0, (0.5, 0.0, 0.0), (0.0, 1 / 12, 1 / 12))
    arm.add_body("a", None, "revolute", bar).add_body("b", "a", "revolute", bar, pose=(1.0, 0.0, 0.0))
    arm = arm.add_frame("tip", "b", (1.0, 0.0, 0.0)).build()
    v = jnp.array([0.3, -0.7])

    def heavy(angle):
        computed = jd.dynamics.workspace_dynamics(arm, "tip", elbow(angle), v, axes="world", rows=(0, 1))
        return jnp.sum(computed.mass_matrix), computed

    angles = jnp.array([1.0, 0.1, 3e-4, 1e-4, 1e-9, 0.0])
    (sizes, computed), slopes = quick(jax.vmap(jax.value_and_grad(heavy, has_aux=True)))(angles)
    for i, angle in enumerate(np.asarray(angles[:2])):
        c1, s1, c12, s12 = np.cos(0.4), np.sin(0.4), np.cos(0.4 + angle), np.sin(0.4 + angle)
        J = np.array([[-s1 - s12, -s12], [c1 + c12, c12]])
        off = 1 / 3 + np.cos(angle) / 2
        M = np.array([[5 / 3 + np.cos(angle), off], [off, 1 / 3]])
        assert_close(computed.mass_matrix[i], np.linalg.inv(J).T @ M @ np.linalg.inv(J))
    assert computed.damped.tolist() == [False, False, True, True, True, True]
    assert float(computed.condition[-1]) < 1e-15
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((sizes, slopes, computed)))
    # Stretched, the force along the arm meets no motion, and of the damped masses the largest is 1/least or below that of S.
    assert np.linalg.eigvalsh(np.asarray(computed.mass_matrix[-1])).max() < 10 / 5e-7
    assert np.linalg.eigvalsh(np.asarray(computed.mass_matrix)).min() > 0
    # Across the edge where damping begins nothing jumps.
    edge = jnp.linspace(2e-4, 1.2e-3, 41)
    masses = quick(jax.vmap(lambda x: heavy(x)[0]))(edge)
    assert float(jnp.abs(jnp.diff(masses)).max()) < 0.1 * float(jnp.abs(masses).max())


@pytest.mark.slow
def test_batch_gradient_and_float32():
    def felt(model, q):
        return jnp.sum(jd.dynamics.workspace_dynamics(model, "tip", q, V, rows=(0, 1, 2)).mass_matrix)

    places = jnp.stack([Q, Q + 0.1])
    values, slopes = quick(jax.vmap(jax.value_and_grad(felt, argnums=1), (None, 0)))(ARM, places)
    step = 1e-6
    moved = Q[None] + step * jnp.concatenate([jnp.eye(6), -jnp.eye(6)])
    high, low = np.split(np.asarray(quick(jax.vmap(felt, (None, 0)))(ARM, moved)), 2)
    np.testing.assert_allclose(values[1], felt(ARM, places[1]), rtol=1e-12)
    np.testing.assert_allclose(slopes[0], (high - low) / (2 * step), atol=1e-6 * float(jnp.abs(slopes[0]).max()))
    single = jax.tree.map(lambda x: x.astype(jnp.float32), ARM)
    rough = jd.dynamics.workspace_dynamics(single, "tip", Q.astype(jnp.float32), V.astype(jnp.float32), rows=(0, 1, 2))
    assert rough.mass_matrix.dtype == jnp.float32
    np.testing.assert_allclose(jnp.sum(rough.mass_matrix), values[0], rtol=1e-4)


test_bad_input_is_refused = refusals(
    (lambda: jd.dynamics.workspace_dynamics(ARM, "hand", Q, V), "hand"),
    (lambda: jd.dynamics.workspace_dynamics(ARM, "tip", Q[:5], V), "q has shape"),
    (lambda: jd.dynamics.workspace_dynamics(ARM, "tip", Q, V, axes="tip"), "axes is 'tip'"),
    (lambda: jd.dynamics.workspace_dynamics(ARM, "tip", Q, V, rows=(0, 6)), "rows is"),
    (lambda: jd.dynamics.workspace_dynamics(robots.chain(2), "rod_1", Q[:2], V[:2]), "nv = 2"),
    (lambda: jd.dynamics.workspace_dynamics(ARM, "tip", Q, V, least=2.0), "least is 2.0"),
)
