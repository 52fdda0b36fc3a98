"""The gauge-invariant form against the projection form, its own identities, and changes of gauge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes


def turned(n, seed=0):
    """A random orthogonal matrix."""
    return jnp.asarray(np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0])


def coupled(q, v):
    """Four coordinates with a metric and a potential that couple them all."""
    mixing = jnp.asarray([[0.3, 0.2, -0.1, 0.4], [0.1, -0.5, 0.2, 0.3]])
    across = mixing[0] @ v + q[1] * v[0]
    return 0.5 * jnp.sum((2.0 + jnp.sin(q)) * v**2) + 0.5 * across**2 - jnp.cos(mixing[1] @ q)


def two_rows(q, t):
    return jnp.stack(
        [jnp.stack([q[3], 1.0 + 0 * t, jnp.sin(q[0]), q[1]]), jnp.stack([q[2] ** 2, 0 * t, q[3], 1.0 + 0 * t])]
    )


def slip(q, t):
    return jnp.stack([jnp.sin(t) * q[0], 0.2 + 0 * t])


@pytest.fixture(scope="module")
def state():
    rng = np.random.default_rng(3)
    q, v, tau = (jnp.asarray(rng.normal(size=4)) for _ in range(3))
    return q, v, tau


def admissible(v, A, b=0.0):
    """The nearest velocity with A v = b."""
    return v - np.linalg.pinv(A) @ (A @ v - b)


def test_it_equals_the_projection_form(state):
    """Same acceleration and multipliers, the two projections of EQUATIONS section 9, both decoupled equations."""
    q, v, tau = state
    scene = jd.Scene(jd.LagrangianSystem(coupled, 4), (jd.Pfaffian(two_rows),))
    v = admissible(v, two_rows(q, jnp.zeros(())))

    @quick
    def compute(q, v, tau):
        lines = (
            jd.reduction.gauge_invariant(scene, q, v, tau),
            jd.constrained_dynamics(scene, q, v, tau),
            jd.constraints.projections(scene, q),
        )
        return *lines, jd.mass_matrix(scene.system, q)

    x, want, (P_T, P_omega), M = compute(q, v, tau)
    assert bool(x.result == jd.RESULTS.successful)
    assert_close(x.acceleration, want.acceleration, 1e-12)
    assert_close(x.multipliers, want.multipliers, 1e-12)
    assert_close(x.W @ x.W.T, M, 1e-14)
    np.testing.assert_allclose(x.velocity @ x.velocity, v @ M @ v, rtol=1e-13)  # twice the kinetic energy
    np.testing.assert_allclose(x.Gamma + x.Gamma.T, 0, atol=1e-13)
    np.testing.assert_allclose(x.Lambda @ x.velocity, 0, atol=1e-13)
    V = np.concatenate([x.V1, x.V2], 1)
    assert_close(V.T @ V, np.eye(4), 1e-13)
    assert_close(x.Lambda @ V, np.concatenate([x.Lambda_r, np.zeros((2, 2))], 1), 1e-13)
    inverse = np.linalg.inv(x.W)
    assert_close(x.W @ x.V2 @ x.V2.T @ inverse, P_omega, 1e-12)
    assert_close(inverse.T @ x.V2 @ x.V2.T @ x.W.T, P_T, 1e-12)
    assert_close(x.reduced_acceleration, x.reduced_force - x.Gamma_r @ x.reduced_velocity, 1e-12)
    assert_close(x.Lambda_r.T @ x.multipliers, x.Gamma_o @ x.reduced_velocity - x.normal_force, 1e-12)


def test_rates_are_those_along_the_motion(state):
    """Differences in time along the accelerated motion: W^T v has the rate u + Lam^T lam - Gamma w, and T the power.

    V2 is carried in parallel: the rate of V2^T w is V2^T times that of w, less V2^T V1dot V1^T w.
    """
    q, v, tau = state
    scene = jd.Scene(jd.LagrangianSystem(coupled, 4), (jd.Pfaffian(two_rows, slip),))
    t = jnp.asarray(0.4)
    v = admissible(v, two_rows(q, t), slip(q, t))
    f = quick(lambda q, v, t: jd.reduction.gauge_invariant(scene, q, v, tau, t))
    x, want = f(q, v, t), quick(lambda q, v, t: jd.constrained_dynamics(scene, q, v, tau, t))(q, v, t)
    assert_close(x.acceleration, want.acceleration, 1e-12)
    assert_close(x.multipliers, want.multipliers, 1e-12)
    h = 1e-3
    ahead = [f(q + s * h * v, v + s * h * x.acceleration, t + s * h) for s in (-2, -1, 1, 2)]
    slope = lambda y: (8 * (y[2] - y[1]) - (y[3] - y[0])) / (12 * h)  # noqa: E731
    rate = slope([y.velocity for y in ahead])
    # Along the parabola: the third derivative of the motion enters by h^4 only.
    assert_close(rate, x.force + x.Lambda.T @ x.multipliers - x.Gamma @ x.velocity, 1e-9)
    # Bases at the four places, turned into each other: V2 V2^T V2_0 has no turn in itself to second order.
    carried = []
    for y in ahead:
        U, _, Vt = np.linalg.svd(np.asarray(y.V2).T @ np.asarray(x.V2))
        carried.append((np.asarray(y.V2) @ U @ Vt).T @ np.asarray(y.velocity))
    assert_close(x.reduced_acceleration, slope(carried), 1e-8)
    # Rate of Lam w = b in quasi velocities.
    assert_close(x.Lambda @ x.velocity, slip(q, t), 1e-12)
    assert_close(
        slope([y.Lambda @ y.velocity for y in ahead]), jnp.stack([jnp.cos(t) * q[0] + jnp.sin(t) * v[0], 0 * t]), 1e-9
    )


def test_the_motion_does_not_depend_on_the_gauge(state):
    """W -> W Q and V2 -> V2 R: accelerations and multipliers stay, w and w_r turn, Gamma and Gamma_r are conjugated."""
    q, v, tau = state
    scene = jd.Scene(jd.LagrangianSystem(coupled, 4), (jd.Pfaffian(two_rows),))
    v = admissible(v, two_rows(q, jnp.zeros(())))
    Q, R = turned(4, 1), turned(2, 2)
    solve = quick(lambda Q, R: jd.reduction.gauge_invariant(scene, q, v, tau, rotation=Q, motion_rotation=R))
    x, y, z = solve(jnp.eye(4), jnp.eye(2)), solve(Q, jnp.eye(2)), solve(jnp.eye(4), R)
    for other in (y, z):
        assert_close(other.acceleration, x.acceleration, 1e-12)
        assert_close(other.multipliers, x.multipliers, 1e-12)
    assert_close(y.velocity, Q.T @ x.velocity, 1e-13)
    assert_close(y.Gamma, Q.T @ x.Gamma @ Q, 1e-12)
    assert_close(y.Lambda, x.Lambda @ Q, 1e-12)
    assert_close(z.reduced_velocity, R.T @ x.reduced_velocity, 1e-13)
    assert_close(z.Gamma_r, R.T @ x.Gamma_r @ R, 1e-12)
    assert_close(z.reduced_acceleration, R.T @ x.reduced_acceleration, 1e-12)
    # A gauge that turns in time, R(t) = exp(S t): Gamma_r gains R^T Rdot, and the motion of w_r = R w_r' is the same.
    S = np.array([[0.0, 0.7], [-0.7, 0.0]])
    turning = R.T @ x.Gamma_r @ R + R.T @ S @ R
    rate = R.T @ x.reduced_force - turning @ (R.T @ x.reduced_velocity)
    back = S @ x.reduced_velocity + R @ rate
    assert_close(back, x.reduced_acceleration, 1e-12)


def test_a_gauge_is_orthogonal(state):
    """The equations hold for orthogonal rotations alone: another matrix is refused, or gets a code where it is traced."""
    q, v, tau = state
    scene = jd.Scene(jd.LagrangianSystem(coupled, 4), (jd.Pfaffian(two_rows),))
    free = lambda turn, motion: jd.reduction.gauge_invariant(  # noqa: E731
        scene, q, v, tau, rotation=turn, motion_rotation=motion, dof=2
    )
    for name, turn, motion in (("rotation", jnp.ones((4, 4)), None), ("motion_rotation", None, 2 * jnp.eye(2))):
        with pytest.raises(ValueError, match=f"^{name} is .* not orthogonal"):
            free(turn, motion)
    traced = quick(jax.vmap(lambda turn, motion: free(turn, motion).result == jd.RESULTS.singular_basis))
    good, small = turned(4), turned(2)
    wrong = traced(jnp.stack([good, 1.1 * good, good]), jnp.stack([small, small, small.at[0].mul(2.0)]))
    assert wrong.tolist() == [False, True, True]
    # Two rows leave two velocities, not four.
    assert bool(jd.reduction.gauge_invariant(scene, q, v, tau, dof=4).result == jd.RESULTS.singular_basis)


@pytest.mark.slow
def test_bodies_with_dependent_rows():
    """A pendulum with its rod listed three times; the sleigh, a body whose velocity is not dq/dt. Eager calls."""
    scene, (q, v) = scenes.spherical_pendulum(), scenes.spherical_pendulum.start()
    scene = jd.Scene(scene.system, scene.constraints * 3)
    computed, want = (
        jd.reduction.gauge_invariant(scene, q, v),
        quick(lambda q, v: jd.constrained_dynamics(scene, q, v))(q, v),
    )
    assert computed.V2.shape == (3, 2) and bool(computed.result == jd.RESULTS.successful)
    assert_close(computed.acceleration, want.acceleration, 1e-10)
    assert_close(computed.multipliers, want.multipliers, 1e-10)
    wrong = quick(lambda q, v: jd.reduction.gauge_invariant(scene, q, v, dof=1).result == jd.RESULTS.singular_basis)
    assert bool(wrong(q, v))
    with pytest.raises(ValueError, match=r"3 constraint rows leave no degree of freedom of nv = 3: .* give dof"):
        jax.jit(lambda q, v: jd.reduction.gauge_invariant(scene, q, v))(q, v)
    with pytest.raises(ValueError, match=r"rotation has shape \(2, 2\), expected \(3, 3\)"):
        jd.reduction.gauge_invariant(scene, q, v, rotation=jnp.eye(2), dof=1)
    sleigh, (q, v) = scenes.chaplygin_sleigh(), scenes.chaplygin_sleigh.start()
    computed = jd.reduction.gauge_invariant(sleigh, q, v)
    a, m, moment = 0.3, 1.0, 0.5
    want = [a * v[2] ** 2, 0.0, -m * a * v[0] * v[2] / (moment + m * a**2)]
    assert_close(computed.acceleration, want, 1e-12)
    assert_close(computed.Lambda @ computed.W.T, jd.constraint_jacobian(sleigh, q), 1e-13)


@pytest.mark.long
def test_derivatives_and_float32(state):
    """The acceleration's Jacobian equals that of the projection form, also at rest; float32 keeps its type."""
    q, _, tau = state
    scene = jd.Scene(jd.LagrangianSystem(coupled, 4), (jd.Pfaffian(two_rows),))
    one = lambda x: jd.reduction.gauge_invariant(scene, x[:4], x[4:], tau).acceleration  # noqa: E731
    other = lambda x: jd.constrained_dynamics(scene, x[:4], x[4:], tau).acceleration  # noqa: E731
    slopes = quick(lambda x: (jax.jacrev(one)(x), jax.jacfwd(other)(x)))(jnp.concatenate([q, 0 * q]))
    assert_close(*slopes, 1e-10)
    disk, (q, v) = scenes.rolling_disk(), scenes.rolling_disk.start(heading=0.3)
    low = jax.tree.map(lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x, (disk, q, v))
    computed = quick(jd.reduction.gauge_invariant)(*low)
    assert computed.acceleration.dtype == computed.Gamma_r.dtype == jnp.float32
    exact = quick(lambda q, v: jd.constrained_dynamics(disk, q, v).acceleration)(q, v)
    np.testing.assert_allclose(computed.acceleration, exact, atol=1e-5)


@pytest.mark.parametrize("name", ("planar_arm", "spatial_arm"))
def test_connection_of_li_and_wu_moves_a_free_arm(name):
    """wdot + Gamma w = u with the accelerations of forward dynamics; v^T Gamma v = 0, and Gamma is not skew (E25)."""
    system = getattr(jd.scenes, name)()
    system = getattr(system, "system", system)
    key = jax.random.split(jax.random.key(0), 3)
    q, v, tau = (jax.random.normal(k, (system.nv,)) for k in key)
    Gamma = jd.reduction.quasi_connection(system, q, v)
    W, Wdot = jax.jvp(lambda q: jnp.linalg.cholesky(jd.mass_matrix(system, q)), (q,), (v,))
    w, rate = W.T @ v, W.T @ jd.forward_dynamics(system, q, v, tau) + Wdot.T @ v
    u = jnp.linalg.solve(W, tau - jd.gravity_force(system, q))
    np.testing.assert_allclose(rate + Gamma @ w, u, atol=1e-10 * np.abs(u).max())
    assert abs(w @ Gamma @ w) < 1e-10 * np.abs(Gamma).max() and np.abs(Gamma + Gamma.T).max() > 1e-2


def test_connection_asks_for_rates_of_coordinates():
    with pytest.raises(ValueError, match="not the rates of its coordinates"):
        jd.reduction.quasi_connection(jd.scenes.free_box(), jnp.zeros(7), jnp.zeros(6))


@pytest.mark.parametrize("name", ("four_bar", "rolling_coin"))
def test_kane_equation_is_the_motion(name):
    """Its right-hand side is the rate of q and, by W and V2, the acceleration of constrained dynamics."""
    scene, (q, v) = getattr(jd.scenes, name)(), getattr(jd.scenes, name).start()
    tau = jax.random.normal(jax.random.key(1), (scene.nv,))
    found, kane = jd.reduction.gauge_invariant(scene, q, v, tau), jd.reduction.kane_equation(scene, q, v, tau)
    rate = kane.matrix @ kane.reduced_velocity + kane.force
    assert kane.matrix.shape == (scene.nq + len(kane.reduced_velocity), len(kane.reduced_velocity))
    np.testing.assert_allclose(rate[: scene.nq], jd.configuration_rate(scene.system, q, v), atol=1e-10)
    a = jd.constrained_dynamics(scene, q, v, tau).acceleration
    W, Wdot = jax.jvp(
        lambda q: jnp.linalg.cholesky(jd.mass_matrix(scene.system, q)),
        (q,),
        (jd.configuration_rate(scene.system, q, v),),
    )
    wanted = found.V2.T @ (W.T @ a + Wdot.T @ v)
    np.testing.assert_allclose(rate[scene.nq :], wanted, atol=1e-10 * max(1.0, float(jnp.abs(wanted).max())))
