"""Motions with closed forms through `simulate`: free rigid bodies (Jacobi; Kane, Likins & Levinson), the pendulum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from scipy.spatial.transform import Rotation
from scipy.special import ellipj, ellipk, ellipkinc

import jaxdyn as jd

MOMENTS = np.array([1.0, 2.0, 3.0])
# Initial angular velocity, period and angular velocity at 20 s (reference problem 4.1, all four rows).
EULER_TOP = [
    ((1e-3, 1.0, 0.0), 57.4628488749627, (0.077207207736599, -0.99701557012592, -0.044571863047152)),
    ((0.3, 0.8, -0.5), 11.024269282773, (-0.51657677863999, 0.6805500949746, -0.55583317887956)),
    ((1.0, 0.2, 0.1), 10.8581611047473, (1.0190650695036, -0.038812164557891, 0.1510999844279)),
    ((0.2, 0.1, 1.0), 6.29903526898175, (0.0019375747348129, 0.22359840295527, 0.99331159162938)),
]
SYMMETRIC = np.array([0.04, 0.04, 0.02])
PENDULUM = [  # time, x, y of the bob (reference problem 1.1)
    (1.0, 0.986291751131875319, -0.165010853125541169),
    (5.0, -0.942305435043757335, -0.334754338414000581),
    (9.99, -0.316436469913032291, -0.948613704575776519),
    (10.0, -0.27508746257611686, -0.961419205099125064),
    (100.0, -0.181513351427031385, -0.983388480334057505),
]


def jacobi(moments, start, t):
    """Angular velocity (nt, 3) of a free body with I1 < I2 < I3, and its period, by Jacobi's elliptic functions."""
    i1, i2, i3 = moments
    energy, momentum = np.sum(moments * start**2), np.sum(moments**2 * start**2)
    above, below = energy * i3 - momentum, momentum - energy * i1
    a1, a3 = np.sqrt(above / (i1 * (i3 - i1))), np.sqrt(below / (i3 * (i3 - i1)))
    outer = momentum >= energy * i2  # the momentum circles the axis of the largest moment
    if outer:
        a2 = np.sqrt(above / (i2 * (i3 - i2)))
        rate, m = np.sqrt((i3 - i2) * below / (i1 * i2 * i3)), (i2 - i1) * above / ((i3 - i2) * below)
        sign = np.sign(start[2])
    else:
        a2 = np.sqrt(below / (i2 * (i2 - i1)))
        rate, m = np.sqrt((i2 - i1) * above / (i1 * i2 * i3)), (i3 - i2) * below / ((i2 - i1) * above)
        sign = np.sign(start[0])
    a, w = (a1, start[0]) if outer else (a3, start[2])
    phase = ellipkinc(np.arctan2(sign * start[1] / a2, w / a), m)
    sn, cn, dn, _ = ellipj(rate * t + phase, m)
    omega = (a1 * cn, sign * a2 * sn, sign * a3 * dn) if outer else (sign * a1 * dn, sign * a2 * sn, a3 * cn)
    return np.stack(omega, -1), 4 * ellipk(m) / rate


@pytest.fixture(scope="module")
def bodies():
    """The same body on a ball joint and flying, and an axisymmetric one that flies."""
    builder = jd.ModelBuilder("bodies")
    builder.add_body("ball", joint="spherical", joint_name="a", inertia=(1.0, (0, 0, 0), MOMENTS))
    builder.add_body("flyer", joint="free", joint_name="b", inertia=(1.3, (0, 0, 0), MOMENTS))
    builder.add_body("symmetric", joint="free", joint_name="c", inertia=(1.0, (0, 0, 0), SYMMETRIC))
    return builder.build()


@pytest.fixture(scope="module")
def motions(bodies):
    """All four rows in one program: the ball and the flyer start alike, the axisymmetric body turns with them."""
    ts = np.linspace(0.0, 20.0, 81)
    rng = np.random.default_rng(4)
    starts = np.array([row[0] for row in EULER_TOP])
    quaternions = rng.normal(size=(3, 4, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    q0 = np.concatenate([quaternions[0], np.tile([10.0, -3.0, 2.0], (4, 1)), quaternions[1]], 1)
    q0 = np.concatenate([q0, np.zeros((4, 3)), quaternions[2]], 1)
    v0 = np.concatenate([starts, np.tile([0.3, -0.2, 0.5], (4, 1)), starts, np.zeros((4, 3)), starts], 1)

    @jax.jit
    def run(q0, v0):
        return jax.vmap(lambda q, v: jd.simulate(bodies, q, v, ts, stepsize=within(1e-13), outputs=("energy",)))(q0, v0)

    solution = run(jnp.asarray(q0), jnp.asarray(v0))
    assert solution.success.all()
    return ts, q0, v0, solution


def rotations(quaternions):
    return Rotation.from_quat(np.roll(quaternions, -1, -1)).as_matrix()


@pytest.mark.parametrize("row", range(4))
def test_jacobi(motions, row):
    ts, _, _, solution = motions
    start, period, end = (np.asarray(x) for x in EULER_TOP[row])
    omega, computed = jacobi(MOMENTS, start, ts)
    np.testing.assert_allclose(computed, period, rtol=2e-11)  # K(m) of the first row, where 1 - m = 4e-6
    # The unstable row multiplies errors by about 1e3 on the way to its first turn.
    np.testing.assert_allclose(omega[-1], end, rtol=0, atol=1e-11)
    for name, place in (("ball", slice(0, 3)), ("flyer", slice(6, 9))):
        np.testing.assert_allclose(solution.v[row, :, place], omega, rtol=0, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(solution.v[row, -1, place], end, rtol=0, atol=1e-9, err_msg=name)


def test_angular_momentum_stays_in_space(motions):
    _, _, _, solution = motions
    for name, q, v in (("ball", slice(0, 4), slice(0, 3)), ("flyer", slice(7, 11), slice(6, 9))):
        momentum = rotations(solution.q[..., q]) @ (MOMENTS * np.asarray(solution.v[..., v]))[..., None]
        np.testing.assert_allclose(momentum, momentum[:, :1] + 0 * momentum, rtol=0, atol=1e-9, err_msg=name)


def test_axisymmetric_body(motions):
    """R(t) = R(0) exp(t hat(L / I)) exp(t hat((1 - J / I) wz ez)), rates turning about ez."""
    ts, q0, v0, solution = motions
    across, along = SYMMETRIC[0], SYMMETRIC[2]
    start = v0[:, 12:]
    spin = (across - along) / across * start[:, 2:]
    c, s = np.cos(spin * ts), np.sin(spin * ts)
    x, y = start[:, :1], start[:, 1:2]
    omega = np.stack([x * c + y * s, -x * s + y * c, start[:, 2:] + 0 * c], -1)
    np.testing.assert_allclose(solution.v[..., 12:], omega, rtol=0, atol=1e-10)
    precession = SYMMETRIC * start / across
    for lane in range(4):
        turn = Rotation.from_rotvec(ts[:, None] * precession[lane]).as_matrix()
        turn = turn @ Rotation.from_rotvec(ts[:, None] * spin[lane] * [0.0, 0.0, 1.0]).as_matrix()
        expected = rotations(q0[lane, 14:]) @ turn
        np.testing.assert_allclose(rotations(solution.q[lane, :, 14:]), expected, rtol=0, atol=1e-10)


def test_flight_and_conserved_energy(motions):
    """Centres fall freely in world axes, whatever the rotation; quaternions are of unit length at every save point."""
    ts, q0, v0, solution = motions
    velocity = (rotations(q0[:, 7:11]) @ v0[:, 3:6, None])[..., 0]
    fall = np.array([0.0, 0.0, -9.81]) * ts[:, None] ** 2 / 2
    path = q0[:, None, 4:7] + velocity[:, None] * ts[:, None] + fall
    np.testing.assert_allclose(solution.q[..., 4:7], path, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(solution.q[..., 11:14], fall + np.zeros((4, 1, 1)), rtol=1e-10, atol=1e-9)
    energy = np.asarray(solution.energy)
    # It is a small difference: after 2 km of fall each of its two parts is 25 kJ.
    np.testing.assert_allclose(energy, energy[:, :1] + 0 * energy, rtol=0, atol=1e-10 * 25e3)
    for place in (slice(0, 4), slice(7, 11), slice(14, 18)):
        np.testing.assert_allclose(np.linalg.norm(solution.q[..., place], axis=-1), 1, rtol=4e-16)


def test_pendulum():
    """Released level at x = -1: sin(th / 2) = k sn(K - w0 t | k^2), th from the downward vertical, k = sin(pi / 4)."""
    builder = jd.ModelBuilder("pendulum", gravity=(0.0, -9.81, 0.0))
    builder.add_body("bob", joint="revolute", axis=(0, 0, 1), inertia=(1.0, (0, -1.0, 0), (0, 0, 0)))
    model = builder.build()
    period = 2.3678419475762374493
    ts = np.array([0.0, period, *(row[0] for row in PENDULUM)])
    ts.sort()
    # x = -sin th of the reference turns the other way round than our angle about z.
    solution = jd.simulate(model, [-np.pi / 2], [0.0], ts, stepsize=within(1e-14), outputs=("energy",))
    angle, rate = np.asarray(solution.q[:, 0]), np.asarray(solution.v[:, 0])
    sn, cn, _, _ = ellipj(ellipk(0.5) - np.sqrt(9.81) * ts, 0.5)
    # Over 100 s, 40 swings, phase errors add up; to 10 s the bound is 1e-11.
    for bound, early in ((1e-11, ts <= 10), (1e-9, ts <= 100)):
        np.testing.assert_allclose(np.sin(angle / 2)[early], -np.sqrt(0.5) * sn[early], rtol=0, atol=bound)
        np.testing.assert_allclose(rate[early], 2 * np.sqrt(0.5 * 9.81) * cn[early], rtol=0, atol=10 * bound)
    rows = np.searchsorted(ts, [row[0] for row in PENDULUM])
    np.testing.assert_allclose(np.sin(angle[rows]), [row[1] for row in PENDULUM], rtol=0, atol=1e-9)
    np.testing.assert_allclose(-np.cos(angle[rows]), [row[2] for row in PENDULUM], rtol=0, atol=1e-9)
    back = np.searchsorted(ts, period)
    np.testing.assert_allclose(angle[back], -np.pi / 2, rtol=1e-12)
    np.testing.assert_allclose(solution.energy, 0.0, rtol=0, atol=1e-10)
