"""A box on a table, held by the wrench cone of its base: the printed rows, the wrench in closed form, and when it lets go."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from pinocchio_bridge import quick
from scipy.optimize import brentq, linprog

import jaxdyn as jd
from jaxdyn import scenes

MASS, GRAVITY, HEIGHT = 1.0, 9.81, 0.025
STANDING = (0.2, 0.16, 0.24)
# A tall box tips over its edge, a flat one slips.
TALL, FLAT = (0.2, 0.16, 0.7), (0.2, 0.16, 0.1)
TABLE = (1.0, 0.6, 0.05)


def closed_form(size, tilt=0.02, table_mass=20.0):
    """thetadot^2, thetadd, and the wrench (fx, fz, ty) at the base, as functions of the angle (docstring of the scene)."""
    r = HEIGHT + size[2] / 2
    own = MASS * (size[0] ** 2 + size[2] ** 2) / 12
    moment = table_mass * (TABLE[0] ** 2 + TABLE[2] ** 2) / 12 + own + MASS * r**2

    def square(angle):
        # cos(tilt) - cos(angle), without cancellation at the start.
        fallen = 2 * np.sin((angle + tilt) / 2) * np.sin((angle - tilt) / 2)
        return 2 * MASS * GRAVITY * r * fallen / moment

    def acceleration(angle):
        return MASS * GRAVITY * r * np.sin(angle) / moment

    def wrench(angle):
        fx = MASS * (r * acceleration(angle) - GRAVITY * np.sin(angle))
        fz = MASS * (GRAVITY * np.cos(angle) - r * square(angle))
        # About the box's centre: I_own thetadd = ty + (torque of fx at the base, size[2]/2 below).
        return fx, fz, own * acceleration(angle) + size[2] / 2 * fx

    return square, acceleration, wrench


def end(size, mu, tilt=0.02):
    """The angle at which the box lets go, the time, and whether it slips."""
    square, _, wrench = closed_form(size, tilt)

    def slip(angle):
        return mu * wrench(angle)[1] + wrench(angle)[0]

    def tip(angle):
        return size[0] / 2 * wrench(angle)[1] + wrench(angle)[2]

    angles = [brentq(function, tilt, 1.2) for function in (slip, tip)]
    last = min(angles)
    # dt = dtheta / thetadot, from rest: theta = tilt + s^2 takes the root away.
    nodes, weights = np.polynomial.legendre.leggauss(60)
    half = np.sqrt(last - tilt) / 2
    s = half * (1 + nodes)
    time = half * np.sum(weights * 2 * s / np.sqrt(square(tilt + s * s)))
    return last, time, angles[0] < angles[1]


def at(angle, size):
    """State of the scene at an angle of the motion."""
    square, _, _ = closed_form(size)
    rate = float(np.sqrt(max(square(angle), 0.0)))
    return scenes.box_on_table.start(tilt=angle, rate=rate, height=HEIGHT, size=size)


@pytest.fixture(scope="module")
def solve():
    """Wrench at the base and acceleration of a batch of states, of one size of the box."""

    def one(size, q, v):
        scene = scenes.box_on_table(size=size)
        moved = jd.constrained_dynamics(scene, q, v)
        G = jd.grasp.grasp_map(scene, q)
        return moved.multipliers, moved.acceleration, G, jd.grasp.contact_forces(scene, moved.multipliers).margin

    def many(size, states):
        q, v = (jnp.stack(x) for x in zip(*states, strict=True))
        return quick(jax.vmap(lambda q, v: one(size, q, v)))(q, v)

    return many


def test_wrench_and_acceleration_in_closed_form(solve):
    """Along the motion: (fx, 0, fz, 0, ty, 0), the table's acceleration, and the margin, the least of 16 rows."""
    angles = np.linspace(0.02, 0.5, 5)
    _, acceleration, wrench = closed_form(STANDING)
    lam, moved, G, margin = solve(STANDING, [at(angle, STANDING) for angle in angles])
    fx, fz, ty = np.array([wrench(angle) for angle in angles]).T
    zero = np.zeros(5)
    np.testing.assert_allclose(lam, np.stack([fx, zero, fz, zero, ty, zero], 1), atol=1e-11)
    np.testing.assert_allclose(moved[:, 6], [acceleration(angle) for angle in angles], atol=1e-12)
    np.testing.assert_allclose(margin, np.minimum(0.4 * fz - abs(fx), fz - abs(ty) / 0.1), atol=1e-10)
    # The grasp map takes the wrench at the base to the centre, size[2]/2 above.
    for column, unit in zip(np.asarray(G[0]).T, np.eye(6), strict=True):
        np.testing.assert_allclose(column, [*unit[:3], *(unit[3:] + np.cross([0, 0, -0.12], unit[:3]))], atol=1e-14)


@pytest.mark.parametrize(("size", "mu", "slips"), [(FLAT, 0.4, True), (TALL, 0.9, False)])
def test_forces_at_the_corners_exist_until_the_box_lets_go(size, mu, slips):
    """The wrench just before the end is a sum of forces of four corners in their pyramids, and just after it is none."""
    angle, _, slipping = end(size, mu)
    assert slipping is slips
    corners = [(x * size[0] / 2, y * size[1] / 2, 0.0) for x in (1, -1) for y in (1, -1)]
    forces = [np.array([a * mu, b * mu, 1.0]) for a in (1, -1) for b in (1, -1)]
    generators = np.array([[*f, *np.cross(corner, f)] for corner in corners for f in forces]).T
    cone = scenes.box_on_table(size=size, mu=mu).cones
    for shift, inside in ((-1e-6, True), (1e-6, False)):
        fx, fz, ty = closed_form(size)[2](angle + shift)
        wanted = np.array([fx, 0, fz, 0, ty, 0])
        computed = linprog(np.zeros(16), A_eq=generators, b_eq=wanted, bounds=(0, None))
        assert (computed.status == 0) is inside
        assert (float(cone.margin(jnp.asarray(wanted))) > 0) is inside


@pytest.mark.slow
@pytest.mark.parametrize(("size", "mu"), [(FLAT, 0.4), (TALL, 0.9)])
def test_the_motion_ends_where_the_box_slips_or_tips(size, mu):
    """The time of the closed form, and the code."""
    _, time, _ = end(size, mu)
    scene, (q, v) = scenes.box_on_table(size=size, mu=mu), scenes.box_on_table.start(size=size)
    solution = jd.simulate(scene, q, v, jnp.linspace(0.0, 8.0, 6), stepsize=within(1e-10), throw=False)
    assert bool(solution.result == jd.RESULTS.contact_lost)
    np.testing.assert_allclose(solution.stats["time_reached"], time, atol=1e-6)
    assert int(solution.stats["lost_contact"]) == 0
