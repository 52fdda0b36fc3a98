"""Motions whose events accumulate come to rest: closed forms of bodies that bounce and rock, and random drops."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from mechanisms import slider
from test_events import TIGHT, G, box
from test_friction_scenes import bounce

import jaxdyn as jd
from benchmarks import drops


@pytest.mark.long
@pytest.mark.parametrize("e", [0.3, 0.6, 0.8])
def test_ball_bounces_to_rest_at_the_sum_of_the_geometric_series(e):
    """Touches are those of the series to 1e-9, parabolas between them, and the last is its limit; behind it the ball rests."""
    fall = np.sqrt(2 / G)
    motion = bounce(e, end=5.0)
    assert motion.success
    times = np.asarray(motion.events.time)[: int(motion.events.count)]
    powers = e ** np.arange(times.size - 1)
    np.testing.assert_allclose(times[:-1], fall * (1 + 2 * (np.cumsum(powers) - 1)), rtol=0, atol=1e-9)
    rest = fall * (1 + e) / (1 - e)
    ts, hits = np.asarray(motion.ts), np.searchsorted(times, motion.ts)
    up = (hits > 0) & (hits < times.size)
    since = ts[up] - times[hits[up] - 1]
    np.testing.assert_allclose(motion.q[up, 0], (G * fall * e ** hits[up] - G * since / 2) * since, atol=1e-8)
    assert set(motion.events.name[: times.size]) == {"floor: touch"}
    np.testing.assert_allclose(times[-1], rest, rtol=0, atol=1e-9)
    behind = np.asarray(motion.ts) > rest
    assert behind.any()
    np.testing.assert_array_equal(motion.v[behind], 0.0)
    np.testing.assert_allclose(motion.q[behind], 0.0, atol=1e-12)


@pytest.mark.slow
def test_block_rocks_to_rest_and_loses_what_housner_says():
    """The first impact multiplies the angular speed by 1 - 3/2 sin^2 of the angle of the diagonal; then it comes to rest."""
    angle, (half, high) = 0.15, (0.1, 0.3)
    lean = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    start = -lean @ np.array([-half, -high])
    ts = jnp.linspace(0.0, 6.0, 61)
    motion = jd.simulate(
        box(mu=2.0, size=(0.2, 0.6)),
        [*start, angle],
        jnp.zeros(3),
        ts,
        events=[jd.events.ModeSwitches(200)],
        outputs=("energy",),
        **TIGHT,
    )
    times = np.asarray(motion.events.time)[: int(motion.events.count)]
    assert motion.success
    np.testing.assert_allclose(motion.q[-1, 1:], [high, 0.0], atol=1e-9)
    np.testing.assert_array_equal(np.abs(motion.v[-1]) < 1e-12, True)
    energy, level = np.asarray(motion.energy), 2.0 * G * high
    first = np.asarray(ts) < times[0]
    second = (np.asarray(ts) > times[0]) & (np.asarray(ts) < times[times > times[0] + 1e-6][0])
    factor = 1 - 1.5 * half**2 / (half**2 + high**2)
    np.testing.assert_allclose(energy[first] - level, energy[0] - level, rtol=1e-9)
    np.testing.assert_allclose(
        energy[second] - level, factor**2 * (energy[0] - level), rtol=1e-8
    )  # of the dense output
    # Every impact, and the limit of their series: quarters of periods, by the energy of the block about its corner.
    moment, radius, tip = 4 / 3 * 2.0 * (half**2 + high**2), np.hypot(half, high), np.arctan(half / high)

    def lift(theta):
        """Height of the centre above that at rest over the radius, cos(tip - theta) - cos(tip) without cancellation."""
        return 2 * np.sin(theta / 2) * np.sin(tip - theta / 2)

    def quarter(peak):
        """Time from the greatest angle to the impact."""
        nodes, weights = np.polynomial.legendre.leggauss(80)
        s = np.sqrt(peak) * (nodes + 1) / 2  # theta = peak - s^2 takes the root of the energy out of the integral
        fall = 2 * np.sin(s**2 / 2) * np.sin(tip - peak + s**2 / 2)  # of lift, from the peak
        return np.sum(weights * np.sqrt(peak) / 2 * 2 * s / np.sqrt(2 * 2.0 * G * radius / moment * fall))

    peaks = [angle]
    while peaks[-1] > 1e-22:
        wanted = factor**2 * lift(peaks[-1])
        peaks.append(scipy.optimize.brentq(lambda x, wanted=wanted: lift(x) - wanted, 0, peaks[-1], xtol=1e-30))
    expected = np.cumsum([quarter(peaks[0]), *(2 * quarter(peak) for peak in peaks[1:])])
    impacts = times[np.diff(times, prepend=-1.0) > 0]  # contacts that change together have one time
    assert impacts.size > 10
    np.testing.assert_allclose(impacts[:-1], expected[: impacts.size - 1], atol=1e-9)
    np.testing.assert_allclose(impacts[-1], expected[-1], atol=1e-8)


@pytest.mark.slow
def test_impacts_of_four_corners_do_not_depend_on_their_order_and_gain_no_energy():
    """Random velocities of a box that lies on four corners, with friction and rebounds: each order gives the same velocity."""
    scene, rng = drops.box(4).scene, np.random.default_rng(3)
    count = 200
    v0 = jnp.asarray(rng.normal(size=(count, 6)))
    mu, e = jnp.asarray(rng.uniform(0.1, 1.0, count)), jnp.asarray(rng.uniform(0.0, 0.9, count))
    q0 = jnp.asarray([0.0, 0.0, drops.SIZE[2] / 2, 1.0, 0.0, 0.0, 0.0])

    def behind(v0, mu, e, order):
        whole: Any = scene(mu, e)
        whole = jd.Scene(whole.system, forces=[whole.forces[i] for i in order])
        motion = jd.simulate(whole, q0, v0, jnp.asarray([0.0, 1e-9]), throw=False)
        return motion.v[-1], motion.success

    runs = [
        jax.jit(jax.vmap(lambda *x, order=order: behind(*x, order)))(v0, mu, e)
        for order in ((0, 1, 2, 3), (2, 3, 1, 0))
    ]
    assert runs[0][1].all() and runs[1][1].all()
    moments = drops.MASS / 12 * (np.sum(drops.SIZE**2) - drops.SIZE**2)
    masses = np.r_[np.full(3, drops.MASS), moments]
    energy = [np.sum(masses * np.asarray(v) ** 2, 1) / 2 for v in (v0, runs[0][0])]
    assert (energy[1] <= energy[0] * (1 + 1e-9) + 1e-7).all()  # the gravity of the nanosecond: 1e-8 m/s
    # Where friction nearly stops a slip, the search for its direction converges slowly: 2e-5 m/s for one of the 200.
    np.testing.assert_allclose(runs[0][0], runs[1][0], atol=1e-4)
    assert np.sum(np.abs(runs[0][0] - runs[1][0]).max(1) > 1e-6) <= 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "seconds"), [("box", 100, 1.0), ("rod", 100, 1.0), ("hand", 64, 0.5), ("quadruped", 16, 1.0)]
)
def test_random_drops_come_to_their_end(name, count, seconds):
    """Without penetration, gain of energy, or accumulating events. More of each by `python -m benchmarks.drops`."""
    once, starts = drops.run(name, seconds)
    outcome = jax.device_get(jax.jit(jax.vmap(once))(*drops.samples(starts, count)))
    failures = drops.failures(outcome)
    assert not failures, failures


@pytest.mark.parametrize("gap", [-1e-10, -3e-10, -1e-8])
def test_contact_that_opens_below_its_zero_has_no_event_again_and_again(gap):
    """Pulled up from a gap below zero by rounding, in steps in which it does not get above: q0 + g t^2/2, without an event."""
    model = slider(axis=(0, 0, 1), gravity=(0.0, 0.0, G))
    scene = jd.Scene(model, forces=[jd.contact.ground_contact("box", friction=0.5)])
    motion = jd.simulate(
        scene, [gap], [0.0], [0.0, 1e-4], stepsize=1e-6, events=[jd.events.ModeSwitches(8)], throw=False
    )
    assert motion.success, motion.result
    assert motion.events.count == 0
    np.testing.assert_allclose(motion.q[-1], G * 1e-8 / 2, atol=2e-8 if gap == -1e-8 else 1e-9)


@pytest.mark.long
@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_block_on_many_points_slides_to_rest(count, caplog):
    """Events of many contacts are kernels, which compile in seconds: v = v0 - mu g t up to the rest, without a slip behind it."""
    builder = jd.ModelBuilder("block", gravity=(0.0, 0.0, -G))
    builder.add_body("block", None, "free", (1.0, (0, 0, 0), (0.1, 0.1, 0.1)))
    points = [(x, y, -0.1) for x in np.linspace(-0.3, 0.3, count) for y in (-0.2, 0.0, 0.2)]
    feet = [jd.contact.ground_contact("block", point, 0.5, name=f"p{i}") for i, point in enumerate(points)]
    start, ts = np.array([0, 0, 0.1, 1, 0, 0, 0.0]), np.linspace(0.0, 0.3, 7)
    with caplog.at_level("WARNING", "jaxdyn"):
        motion = jd.simulate(jd.Scene(builder.build(), forces=feet), start, np.array([1.0, 0, 0, 0, 0, 0]), ts)
    assert motion.success and not caplog.records
    np.testing.assert_allclose(motion.v[:, 0], np.maximum(1 - 0.5 * G * ts, 0), rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.q[-1], start + np.eye(7)[0] / G, rtol=0, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("start, dtype, tol", [((0.0, 1.0), "float32", 1e-5), ((1000.0, -3e-8), "float64", 1e-10)])
def test_derivatives_of_friction_while_a_body_bounces_to_rest_or_starts_in_the_ground(start, dtype, tol):
    """A body that slides all the time moves v T - mu (g T^2/2 - h), as its normal impulse is that of gravity, whatever bounces.

    Both are below the ground by rounding where they come to rest on it, the second as it is far from the origin. In float32
    derivatives have the tolerance of the run, ten rounding errors.
    """
    builder = jd.ModelBuilder("body", gravity=(0, 0, -G))
    builder.add_body("sledge", None, "prismatic", (0.0, (0, 0, 0), (0, 0, 0)), axis=(1, 0, 0))
    builder.add_body("body", "sledge", "prismatic", (2.0, (0, 0, 0), (0, 0, 0)), axis=(0, 0, 1))
    model = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, builder.build())

    def place(p):
        touch = jd.contact.ground_contact("body", friction=p[0], restitution=0.5)
        speed = jnp.stack([p[1], 0 * p[1]])
        ts = jnp.linspace(0, 2.0, 2, dtype=dtype)
        options: Any = TIGHT if dtype == "float64" else {}
        return jd.simulate(jd.Scene(model, forces=[touch]), jnp.asarray(start, dtype), speed, ts, **options).q[-1]

    derivative = jax.jit(jax.jacrev(place))(jnp.asarray([0.2, 12.0], dtype))
    assert derivative.dtype == dtype
    want = [-(2 * G - max(start[1], 0.0)), 2.0]
    np.testing.assert_allclose(derivative, [want, [0.0, 0.0]], rtol=tol, atol=tol)
