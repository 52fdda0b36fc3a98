"""Scenes with rolling and sliding contacts: closed forms of motions, stability thresholds, equations by hand."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linearisation import admissible, motion_jacobian
from motion_helpers import largest_residuals
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes, so3


def motion(scene, state, ts, stepsize):
    """Fixed steps of order 8, which leave nothing but rounding; the motion must have stayed on the constraints."""

    @quick
    def run(q, v):
        options = {"stepsize": stepsize, "solver": diffrax.Dopri8(), "outputs": ("constraint_residual",)}
        return jd.simulate(scene, q, v, jnp.asarray(ts), **options)

    computed = run(*state)
    assert bool(computed.success) and float(computed.constraint_residual.max()) <= 1e-12
    return computed


def solved(scene, state, tau):
    """Residuals and acceleration at a state."""
    compute = quick(lambda q, v, tau: (largest_residuals(scene, q, v), jd.constrained_dynamics(scene, q, v, tau)))
    error, computed = compute(*state, jnp.asarray(tau))
    assert float(error.max()) < 1e-14
    return computed


@pytest.mark.slow
def test_stability_of_the_upright_disk():
    """Rolling upright is stable if w^2 > g/(3 r), spinning about the diameter if w^2 > 4 g/(5 r) (problem 3.10).

    By hand, for A = m r^2/4 and C = m r^2/2: the lean obeys b'' = k b, k = (4/5)(g/r - 3 w^2) and (4/5) g/r - w^2, and
    both spins stay as they are: the characteristic polynomial is s^2 (s^2 - k).
    """
    mass, radius, gravity = 0.3048, 0.05, 9.81
    scene = scenes.rolling_coin(mass=mass, radius=radius, gravity=gravity)

    def state(x):
        lean, *rates = jnp.unstack(x)
        o, half = jnp.zeros_like(lean), 0.5 * lean
        place = [o, -radius * jnp.sin(lean), radius * jnp.cos(lean)]
        q = jnp.stack([*place, jnp.cos(half), jnp.sin(half), o, o])
        return q, admissible(scene, q, np.array([3, 4, 5]), jnp.stack(rates))

    def coordinates(q, v):
        """Lean of the axle and its rate, spin about the axle, turn about the diameter that is lowest, first order."""
        rotation = so3.quat_to_matrix(q[3:])
        rise, low = rotation[2, 1], jnp.asarray([rotation[2, 2], 0.0, -rotation[2, 0]])
        # In the disk, the diameter that is level and the one across it do not turn with the disk.
        upward = jnp.asarray([rotation[2, 0], 0.0, rotation[2, 2]])
        return jnp.stack([rise, jnp.sum(v[3:] * low), v[4], jnp.sum(v[3:] * upward)])

    rolling, spinning = np.sqrt(gravity / (3 * radius)), np.sqrt(4 * gravity / (5 * radius))
    factors = np.array([0.98, 1.0, 1.02])
    cases = [[0.0, 0.0, f * rolling, 0.0] for f in factors] + [[0.0, 0.0, 0.0, f * spinning] for f in factors]
    jacobian = np.asarray(quick(jax.vmap(motion_jacobian(scene, state, coordinates)))(jnp.asarray(cases)))
    level = gravity / radius
    want = np.concatenate([0.8 * level * (1 - factors**2), 0.8 * level * (1 - factors**2)])
    for J, k in zip(jacobian, want, strict=True):
        np.testing.assert_allclose(np.poly(J), [1.0, 0.0, -k, 0.0, 0.0], atol=1e-10 * level)


@pytest.mark.long
def test_suslov():
    """tanh and sech: the body goes over to a steady rotation about its second axis."""
    (one, two, three), product, start = (1.0, 1.5, 2.0), 0.4, (1.0, -0.5)
    scene = scenes.suslov(moments=(one, two, three), product=product)
    t = np.array([0.0, 1.0, 3.0, 10.0])
    computed = motion(scene, scenes.suslov.start(across=start[0], along=start[1]), t, 0.05)
    c = np.sqrt(start[1] ** 2 + one / two * start[0] ** 2)
    n = product * c / one
    u = n * t + np.arctanh(start[1] / c)
    want = np.stack([c * np.sqrt(two / one) / np.cosh(u), c * np.tanh(u), 0 * u], 1)
    np.testing.assert_allclose(computed.v, want, atol=1e-10)


@pytest.mark.long
def test_accelerations_of_balls_on_planes():
    """5/7 of the acceleration of a body that slides, with the contact forces."""
    slope, pull = 0.4, 9.81 * np.sin(0.4)
    state = scenes.ball_on_incline.start(velocity=(0.1, 0.5))
    solution = solved(scenes.ball_on_incline(slope=slope, mass=1.4), state, np.zeros(6))
    across = np.cross(state[1][3:], state[1][:3])
    assert_close(solution.acceleration[:3] + across, [5 / 7 * pull, 0.0, 0.0], 1e-12)
    assert_close(solution.multipliers, 1.4 * np.array([9.81 * np.cos(slope), -2 / 7 * pull, 0.0]), 1e-12)


def by_hand(mass_matrix, bias, rows, q, v, tau):
    """Accelerations of M a + h = tau + A^T lam, A a = -(dA/dt) v in coordinates; dA/dt by a complex step."""
    M, h, A = mass_matrix(q), bias(q, v), rows(q)
    rate = rows(q + 1e-30j * v).imag / 1e-30
    n, m = len(q), len(A)
    matrix = np.block([[M, -A.T], [A, np.zeros((m, m))]])
    return np.linalg.solve(matrix, np.concatenate([tau - h, -rate @ v]))[:n]


def in_coordinates(q, v, a):
    """Rates and accelerations of (x, y, heading, ...) from those of a planar joint and what it carries."""
    q, v, a = (np.array(x) for x in (q, v, a))
    c, s = np.cos(q[2]), np.sin(q[2])
    turn = np.array([[c, -s], [s, c]])
    a[:2] = turn @ (a[:2] + v[2] * np.array([-v[1], v[0]]))
    v[:2] = turn @ v[:2]
    return q, v, a


def placed(state, at):
    """The same motion started elsewhere on the plane."""
    q, v = state
    return q.at[:3].add(jnp.asarray(at)), v


def test_differential_drive():
    """Forward and yaw acceleration with motor torques, from the energy of two coordinates."""
    mass, moment, d, wheel, r, b = 8.0, 0.3, 0.05, 0.5, 0.1, 0.25
    left, right, speed, turn = 0.7, -0.2, 0.5, 0.4
    state = placed(scenes.differential_drive.start(speed=speed, yaw_rate=turn), (0.3, -0.2, 0.8))
    a = solved(scenes.differential_drive(), state, [0.0, 0.0, 0.0, left, right]).acceleration
    spin = 0.5 * wheel * r**2
    total = mass + 2 * wheel + 2 * spin / r**2
    about = moment + mass * d**2 + 2 * (0.5 * spin + wheel * b**2) + 2 * spin * b**2 / r**2
    forward = (mass * d * turn**2 + (left + right) / r) / total
    yaw = (-mass * d * speed * turn + (right - left) * b / r) / about
    assert_close(a, [forward, 0.0, yaw, (forward - b * yaw) / r, (forward + b * yaw) / r], 1e-12)


@pytest.mark.long
def test_car():
    """Accelerations against the rows of Murray & Sastry and a mass matrix by hand, with drive and steering torques."""
    mass, moment, d, fork, wheel, r, b, l = 60.0, 12.0, 0.5, 0.2, 2.0, 0.15, 0.4, 1.2
    spin = 0.5 * wheel * r**2

    def rows(q):
        c, s, cp, sp = np.cos(q[2]), np.sin(q[2]), np.cos(q[2] + q[5]), np.sin(q[2] + q[5])
        return np.array(
            [
                [s, -c, 0, 0, 0, 0, 0],
                [sp, -cp, -l * np.cos(q[5]), 0, 0, 0, 0],
                [c, s, -b, -r, 0, 0, 0],
                [c, s, b, 0, -r, 0, 0],
                [cp, sp, l * np.sin(q[5]), 0, 0, 0, -r],
            ]
        )

    total, first, swing = mass + 3 * wheel, mass * d + wheel * l, fork + 0.5 * spin
    about = moment + mass * d**2 + 2 * (0.5 * spin + wheel * b**2) + swing + wheel * l**2

    def mass_matrix(q):
        M = np.diag([total, total, about, spin, spin, swing, spin])
        M[0, 2] = M[2, 0] = -first * np.sin(q[2])
        M[1, 2] = M[2, 1] = first * np.cos(q[2])
        M[2, 5] = M[5, 2] = swing
        return M

    def bias(q, v):
        return -first * v[2] ** 2 * np.array([np.cos(q[2]), np.sin(q[2]), 0, 0, 0, 0, 0])

    q, v = placed(scenes.car.start(speed=2.0, steer=0.3, steer_rate=0.5), (0.3, -0.2, 0.8))
    tau = np.array([0.0, 0.0, 0.0, 1.5, 2.0, 0.4, -0.7])
    solution = in_coordinates(q, v, solved(scenes.car(), (q, v), tau).acceleration)
    assert_close(solution[2], by_hand(mass_matrix, bias, rows, *solution[:2], tau), 1e-11)
    assert_close(rows(solution[0]) @ solution[1] + 1.0, np.ones(5), 1e-13)
    assert abs(2.0 / v[2] - l / np.tan(0.3)) < 1e-12  # radius of the circle


def test_snakeboard():
    """Accelerations against the printed rows and a mass matrix by hand, with torques on rotor and trucks."""
    mass, moment, rotor, truck, l = 6.0, 0.1, 0.16, 0.02, 0.3

    def rows(q):
        front, back = q[2] + q[3], q[2] + q[4]
        return np.array(
            [
                [-np.sin(front), np.cos(front), l * np.cos(q[3]), 0, 0, 0],
                [-np.sin(back), np.cos(back), -l * np.cos(q[4]), 0, 0, 0],
            ]
        )

    M = np.diag([mass, mass, moment + rotor + 2 * truck, truck, truck, rotor])
    M[2, 3:] = M[3:, 2] = truck, truck, rotor
    start = scenes.snakeboard.start(speed=1.0, angles=(0.3, -0.2), rates=(0.4, -0.9), rotor_rate=2.0)
    q, v = placed(start, (0.3, -0.2, 0.8))
    tau = np.array([0.0, 0.0, 0.0, 0.3, -0.2, 1.1])
    solution = in_coordinates(q, v, solved(scenes.snakeboard(), (q, v), tau).acceleration)
    assert_close(solution[2], by_hand(lambda q: M, lambda q, v: np.zeros(6), rows, *solution[:2], tau), 1e-11)
    assert_close(rows(solution[0]) @ solution[1] + 1.0, np.ones(2), 1e-13)
