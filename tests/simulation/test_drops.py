"""Motions whose events accumulate come to rest: closed forms of bodies that bounce and rock, and random drops."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_events import TIGHT, G, box
from test_friction_scenes import bounce

import jaxdyn as jd
from benchmarks import drops


@pytest.mark.long
def test_ball_bounces_to_rest_at_the_sum_of_the_geometric_series():
    """Touches are those of the series to 1e-9, up to flights that are lower than the tolerance; behind them the ball rests."""
    e, fall = 0.6, np.sqrt(2 / G)
    motion = bounce(e, end=4.0)
    assert motion.success
    times = np.asarray(motion.events.time)[: int(motion.events.count)]
    powers = e ** np.arange(times.size)
    np.testing.assert_allclose(times, fall * (1 + 2 * (np.cumsum(powers) - 1)), rtol=0, atol=1e-9)
    rest = fall * (1 + e) / (1 - e)
    # The flight that is not followed any more: v^2/2g is 1e-9 of a metre at most.
    assert 0 < rest - times[-1] < 2 * np.sqrt(2 * 2e-9 / G) / (1 - e)
    behind = np.asarray(motion.ts) > rest
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
        box(mu=2.0, size=(0.2, 0.6)), [*start, angle], jnp.zeros(3), ts, max_events=200, outputs=("energy",), **TIGHT
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
    # To the first impact: the quarter of the period, by the energy of the block about its corner.
    moment, radius, tip = 4 / 3 * 2.0 * (half**2 + high**2), np.hypot(half, high), np.arctan(half / high)
    nodes, weights = np.polynomial.legendre.leggauss(80)
    s = np.sqrt(angle) * (nodes + 1) / 2  # theta = angle - s^2 takes the root of the energy out of the integral
    theta = angle - s**2
    speed = np.sqrt(2 * 2.0 * G * radius / moment * (np.cos(tip - angle) - np.cos(tip - theta)))
    np.testing.assert_allclose(times[0], np.sum(weights * np.sqrt(angle) / 2 * 2 * s / speed), atol=1e-9)


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
@pytest.mark.parametrize("name", ["box", "rod", "hand"])
def test_random_drops_come_to_their_end(name):
    """Without penetration, gain of energy, or accumulating events. More of each by `python -m benchmarks.drops`."""
    once, starts = drops.run(name, max_steps=8192)
    outcome = jax.device_get(jax.jit(jax.vmap(once))(*drops.samples(starts, 64)))
    failures = drops.failures(outcome)
    assert not failures, failures
