"""Scenes with closed loops against equations by hand, symmetries and closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import largest_residuals
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from benchmarks.report_cases import test_set
from jaxdyn import scenes


@pytest.fixture(scope="module")
def parallel():
    """The parallel manipulator at a moving state, and by hand what EQUATIONS section 8 says of it."""
    mass, length = 1.3, 0.9
    scene = scenes.parallel_manipulator(mass=mass, length=length)
    velocity = np.array([0.3, -0.2])
    q, v = scenes.parallel_manipulator.start(point=(0.1, 0.05), velocity=velocity, length=length, elbows=(1, -1, 1))

    @quick
    def solve(taus):
        dynamics = jax.vmap(lambda tau: jd.constrained_dynamics(scene, q, v, tau))(taus)
        return (
            dynamics,
            largest_residuals(scene, q, v),
            jd.constraint_jacobian(scene, q),
            jd.constraints.projections(scene, q).P_omega,
        )

    M, h, J, carried = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 2)), np.zeros(6)
    unit = mass * length**2
    for leg in range(3):
        rows = slice(2 * leg, 2 * leg + 2)
        (first, second), (one, two) = np.asarray(q[rows]), np.asarray(v[rows])
        bend = np.cos(second)
        M[rows, rows] = unit * np.array([[5 / 3 + bend, 1 / 3 + bend / 2], [1 / 3 + bend / 2, 1 / 3]])
        h[rows] = unit / 2 * np.sin(second) * np.array([-2 * one * two - two**2, one**2])
        at, rate = first + np.array([0.0, second]), one + np.array([0.0, two])
        ends, turning = np.exp(1j * at) * length, 1j * np.exp(1j * at) * length * rate
        place, moving = (1j * np.array([x.sum(), x[1]]) for x in (ends, turning))
        forward, change = (np.stack([x.real, x.imag]) for x in (place, moving))
        J[rows] = np.linalg.inv(forward)
        carried[rows] = -J[rows] @ change @ [one, two]  # d/dt(J) xdot
    return {"solve": solve, "M": M, "h": h, "J": J, "carried": carried, "v": v, "velocity": velocity}


@pytest.mark.long
def test_parallel_manipulator(parallel):
    """Two equations for the carried point, J^T (M (J xdd + Jdot xd) + h) = J^T tau, with torques on all joints."""
    M, h, J, carried = (parallel[name] for name in ("M", "h", "J", "carried"))
    taus = np.random.default_rng(0).normal(size=(6, 6))
    computed, error, A, _ = parallel["solve"](jnp.asarray(taus))
    assert float(error.max()) < 1e-14
    assert_close(parallel["v"], J @ parallel["velocity"], 1e-13)
    point = np.linalg.solve(J.T @ M @ J, J.T @ (taus - h - M @ carried).T)
    assert_close(computed.acceleration, (J @ point).T + carried, 1e-11)
    assert (np.asarray(computed.rank) == 4).all()
    np.testing.assert_allclose(A @ J, 0, atol=1e-13)
    assert_close(A.T @ computed.multipliers.T, (M @ computed.acceleration.T + h[:, None] - taus.T), 1e-11)


def test_actuation_of_the_parallel_manipulator(parallel):
    """Six motors or the three at the bases give any motion, and internal forces without motion (erratum E27)."""
    M, h, J, carried = (parallel[name] for name in ("M", "h", "J", "carried"))
    wanted = J @ np.array([0.7, -1.1]) + carried
    needed = J.T @ (M @ wanted + h)
    base = np.array([0, 2, 4])
    P_omega = np.asarray(parallel["solve"](jnp.zeros((6, 6)))[3])
    assert np.linalg.matrix_rank(P_omega[:, base], tol=1e-10) == 2
    all_joints, three = np.linalg.pinv(J.T) @ needed, np.zeros(6)
    three[base] = np.linalg.pinv(J.T[:, base]) @ needed
    inner, inner_three = np.linalg.svd(J.T)[2][2:], np.zeros(6)
    inner_three[base] = np.linalg.svd(J.T[:, base])[2][2]
    taus = np.stack([all_joints, all_joints + inner[0], all_joints + inner[3], three, three + inner_three, np.zeros(6)])
    computed, *_ = parallel["solve"](jnp.asarray(taus))
    assert_close(computed.acceleration[:5], np.tile(wanted, (5, 1)), 1e-11)
    lam = np.asarray(computed.multipliers)
    assert np.linalg.norm(lam[[1, 2]] - lam[0], axis=1).min() > 0.1
    assert np.linalg.norm(lam[4] - lam[3]) > 0.1
    # The least torques: the same motion costs more with three motors, and more with internal forces.
    cost = np.linalg.norm(taus, axis=1)
    assert cost[0] < cost[3] < cost[4] and cost[0] < cost[1]


def test_ring_of_bars():
    """A turning polygon carries a closed-form tension; in any motion the choice of the first bar makes no difference,
    and momentum and angular momentum stay."""
    count, mass, length, rate = 6, 1.2, 0.8, 1.7
    scene = scenes.closed_ring(count=count, mass=mass, length=length)
    solve = quick(
        jax.vmap(
            lambda q, v: (
                largest_residuals(scene, q, v),
                jd.constrained_dynamics(scene, q, v),
                jd.constraint_jacobian(scene, q),
            )
        )
    )
    polygon = scenes.closed_ring.start(count=count, length=length, rate=rate)
    # A centrally symmetric hexagon closes; the rates close if sum w_i (-sin, cos) = 0.
    rng = np.random.default_rng(0)
    angles = np.array([0.3, 1.2, 2.3])
    angles = np.concatenate([angles, angles + np.pi])
    across = np.stack([-np.sin(angles), np.cos(angles)])
    rates = np.concatenate([rng.normal(size=4), np.zeros(2)])
    rates[4:] = -np.linalg.solve(across[:, 4:], across[:, :4] @ rates[:4])
    place, speed = np.array([0.4, -0.3]), np.array([0.5, 0.2])
    states = [polygon]
    for first in (0, 1):
        turned, w = np.roll(angles, -first), np.roll(rates, -first)
        c, s = np.cos(turned[0]), np.sin(turned[0])
        q = jnp.asarray([*place, turned[0], *np.diff(turned)])
        states.append((q, jnp.asarray([*(np.array([[c, s], [-s, c]]) @ speed), w[0], *np.diff(w)])))
        place = place + length * np.array([c, s])
        speed = speed + length * w[0] * np.array([-s, c])
    error, computed, _ = solve(*(jnp.stack(x) for x in zip(*states, strict=True)))
    assert float(error.max()) < 1e-14
    a = np.asarray(computed.acceleration)

    at_rest = polygon[1][2] * np.array([-polygon[1][1], polygon[1][0], 0.0])
    np.testing.assert_allclose(
        a[0], [*(-at_rest[:2] - rate**2 * np.asarray(polygon[0][:2]))[:2], *np.zeros(6)], atol=1e-12
    )
    tension = mass * length / 4 / np.tan(np.pi / count) / np.sin(np.pi / count) * rate**2
    np.testing.assert_allclose(np.linalg.norm(computed.multipliers[0]), tension, rtol=1e-12)

    turning = np.cumsum(a[1:, 2:], 1)
    assert_close(np.roll(turning[1], 1), turning[0], 1e-11)
    # Accelerations of the bars' centres from the first joint on.
    q, v = states[1]
    c, s = np.cos(q[2]), np.sin(q[2])
    joint = np.array([[c, -s], [s, c]]) @ (a[1, :2] + np.asarray(v[2] * jnp.asarray([-v[1], v[0]])))
    along = length * np.stack([np.cos(angles), np.sin(angles)], 1)
    steps = turning[0][:, None] * length * across.T - rates[:, None] ** 2 * along
    joints = joint + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    np.testing.assert_allclose(joints[-1], joints[0], atol=1e-12)
    centers = joints[:-1] + steps / 2
    np.testing.assert_allclose(centers.sum(0), 0, atol=1e-12)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(along, 0)])[:-1] + along / 2
    moment = places[:, 0] * centers[:, 1] - places[:, 1] * centers[:, 0]
    np.testing.assert_allclose(moment.sum() + length**2 / 12 * turning[0].sum(), 0, atol=1e-12)


@pytest.mark.long
def test_andrews_from_its_bodies():
    """The tree of seven bodies and the printed M and f: equal accelerations and energies on the constraints."""
    printed, built = test_set.andrews(), test_set.andrews_bodies()
    order = np.array([0, 1, 2, 4, 3, 6, 5])
    q0, v0 = test_set.andrews.start()
    rough = [15.8107, -15.7563, 0.040822, -0.53473, 0.524410, 0.53473, 1.04808]

    @quick
    def compute(q, v):
        state = jd.assemble(printed, q, v)
        q, v = state.q, state.v
        x, w = q[order], v[order]
        rows = []
        for scene, place, rate in ((printed, q, v), (built, x, w)):
            energy = jd.kinetic_energy(scene.system, place, rate)
            a = jd.constrained_dynamics(scene, place, rate).acceleration
            rows.append((a, energy, largest_residuals(scene, place, rate)))
        return rows, jd.potential_energy(printed.system, q), built.forces[0].energy(built.system, x)

    rates = [1140.0, -1424.0, 11.0, 19.0, 0.6, -19.0, 0.3]
    for q, v in ((q0, v0), (jnp.asarray(rough), jnp.asarray(rates))):
        ((a, kinetic, _), (b, same, error)), stored, also = compute(q, v)
        assert float(error[0]) < 1e-15 and float(error[1]) < 1e-12  # m and m/s, of 0.1 m and 8 m/s
        assert_close(b, a[order], 1e-10)
        np.testing.assert_allclose(same, kinetic, rtol=1e-12)
        np.testing.assert_allclose(also, stored, rtol=1e-12)
    assert float(kinetic) > 0.1


@pytest.mark.slow
def test_a01_pendulum_for_2000_seconds():
    """IFToMM A01 as first stated: position after 100 and after 2000 s, 845 periods, to 1e-6."""
    scene, (q, v) = scenes.pendulum_in_plane(), scenes.pendulum_in_plane.start()
    ts = jnp.asarray([0.0, 100.0, 2000.0])

    @jax.jit
    def run():
        options = {"stepsize": 0.02, "solver": diffrax.Dopri8(), "outputs": ("energy", "constraint_residual")}
        return jd.simulate(scene, q, v, ts, stepsize=jd.simulation.Steps(max_steps=110_000), **options)

    computed = run()
    want = [[-1.0, 0.0], [-0.181513351427031385, -0.983388480334057505], [0.814603068589032152, -0.580018827836935462]]
    assert bool(computed.success) and float(computed.constraint_residual.max()) <= 1e-12
    np.testing.assert_allclose(computed.q, want, atol=1e-6)
    np.testing.assert_allclose(computed.energy, computed.energy[0], atol=1e-9)
