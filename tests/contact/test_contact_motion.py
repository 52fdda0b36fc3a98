"""Contacts during a motion: forces and margins as outputs, and the end of a run where one pulls or slips, in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import jaxdyn as jd

MASS, GRAVITY, MU = 2.0, 9.81, 0.5
TIMES = np.linspace(0.0, 1.0, 6)
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z of the contact along y of the plane
WORDS = ("contact_forces", "contact_margins")


def block(mu=MU):
    """A block in the x-y plane whose centre stands on a point of the table: it can turn, be pulled and be pushed."""
    builder = jd.ModelBuilder("block", gravity=(0.0, -GRAVITY, 0.0))
    builder.add_body("block", None, "planar", jd.inertia.box(MASS, (0.2, 0.1, 0.3)))
    touch = jd.grasp.contact(
        "hard-finger", None, UPRIGHT, object="block", finger_pose=UPRIGHT, in_plane=True, name="table"
    )
    return jd.Scene(builder.build(), [touch], cones=jd.contact.friction_cone("hard-finger", mu, in_plane=True))


def push(rates):
    """Forces along x and y that grow with time (N/s)."""
    return jax.tree_util.Partial(_push, jnp.asarray(rates))


def _push(rates, q, v, t):
    return jnp.concatenate([rates * t, jnp.zeros(1, t.dtype)])


STILL = (np.zeros(3), np.zeros(3))
SPIN = (np.zeros(3), np.array([0.0, 0.0, 0.7]))


def motion(mu, rates):
    return jd.simulate(block(mu), *STILL, TIMES, control=push(rates), stepsize=0.11, outputs=WORDS, throw=False)


PULLS, SLIPS, HOLDS, SLICK, BOTH = range(5)
FRICTION = np.array([MU, MU, MU, 0.1, 0.3])
RATES = np.array([[0.0, 30.0], [15.0, 0.0], [4.0, 5.0], [4.0, 0.0], [15.0, 15.0]])
ENDS = MASS * GRAVITY * np.array([1 / 30, MU / 15, np.inf, 0.1 / 4, 0.3 / (15 + 0.3 * 15)])


@pytest.fixture(scope="module")
def motions():
    """One batch: a block that is lifted, pushed, neither enough, pushed on a slippery table, and both."""
    return jax.jit(jax.vmap(motion))(FRICTION, RATES)


@pytest.mark.long
def test_a_contact_that_pulls_or_slips_ends_each_lane_at_its_time(motions):
    lost = np.isfinite(ENDS)
    np.testing.assert_array_equal(motions.success, ~lost)
    np.testing.assert_array_equal(motions.result == jd.RESULTS.contact_lost, lost)
    np.testing.assert_array_equal(motions.stats["lost_contact"], np.where(lost, 0, -1))
    # The margin is linear in time, so its zero is found but for the allowance for rounding, 1.5e-8 of a force that is 11 times
    # the margin mu f_n for the least mu.
    np.testing.assert_allclose(motions.stats["time_reached"], np.minimum(ENDS, 1.0), rtol=2e-7)
    before = ENDS[:, None] > TIMES
    np.testing.assert_array_equal(np.isfinite(motions.q).all(2), before)
    np.testing.assert_array_equal(np.isfinite(motions.contact_margins["table"]), before)


def test_forces_and_margins_are_those_of_newton(motions):
    normal = MASS * GRAVITY - RATES[:, 1:] * TIMES
    side = -RATES[:, :1] * TIMES
    reached = ENDS[:, None] > TIMES
    forces, margins = motions.contact_forces["table"], motions.contact_margins["table"]
    np.testing.assert_allclose(forces[reached], np.stack([side, normal], 2)[reached], atol=1e-12)
    wanted = FRICTION[:, None] * normal - np.abs(side)
    np.testing.assert_allclose(margins[reached], wanted[reached], atol=1e-12)


@pytest.mark.long
def test_a_run_that_may_go_on_reports_negative_margins():
    rates = RATES[SLIPS]
    options = {"control": push(rates), "stepsize": 0.11, "outputs": WORDS}
    solution = jd.simulate(block(), *STILL, TIMES, events=[jd.events.ContactLost(stop=False)], **options)
    assert solution.success and "lost_contact" not in solution.stats
    wanted = MU * MASS * GRAVITY - rates[0] * TIMES
    np.testing.assert_allclose(solution.contact_margins["table"], wanted, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"method": "reduced"}, {"method": "variational", "stepsize": 0.01}])
def test_every_method_finds_the_time(how):
    """Steps of all kinds, while the block turns under the force, which turns with it."""
    solution = jd.simulate(block(), *SPIN, TIMES, control=push([0.0, 30.0]), throw=False, **how)
    assert solution.result == jd.RESULTS.contact_lost
    weight = MASS * GRAVITY

    def margin(t):
        angle = 0.7 * t
        return MU * (weight * np.cos(angle) - 30.0 * t) - weight * np.sin(angle)

    # The allowance for rounding, and the tolerance of the variational step's equations.
    np.testing.assert_allclose(solution.stats["time_reached"], brentq(margin, 0.0, 1.0, xtol=1e-14), rtol=1e-7)


@pytest.mark.slow
def test_margins_are_differentiable():
    """d margin / d mu is the normal force, d margin / d rate that of the force."""
    rates = jnp.asarray(RATES[HOLDS])
    slopes = jax.jacrev(lambda mu, rates: motion(mu, rates).contact_margins["table"][3], (0, 1))(jnp.asarray(MU), rates)
    t = TIMES[3]
    np.testing.assert_allclose(slopes[0], MASS * GRAVITY - 5.0 * t, rtol=1e-10)
    np.testing.assert_allclose(slopes[1], [-t, -MU * t], rtol=1e-10)


@pytest.mark.slow
def test_an_error_names_the_contact_and_the_time():
    with pytest.raises(RuntimeError, match=r"0\.654 s.*'table'"):
        jd.simulate(block(), *STILL, TIMES, control=push(RATES[SLIPS]), stepsize=0.11)
    hand = jd.scenes.hand_with_bar
    with pytest.raises(RuntimeError, match="contact is 'tip1'"):
        jd.simulate(hand(), *hand.start(), np.array([0.0, 1e-3]), stepsize=1e-3)


def test_bad_input_is_refused():
    scene = block()
    for call, match in (
        (lambda: jd.simulate(scene, *STILL, TIMES, contacts="ignore"), "contacts is 'ignore'"),
        (lambda: jd.simulate(jd.Scene(scene.system, scene.constraints), *STILL, TIMES, outputs=WORDS), "has no cones"),
        (lambda: jd.simulate(jd.Scene(scene.system, scene.constraints, cones={"floor": 1}), *STILL, TIMES), "floor"),
        (lambda: jd.simulate(jd.Scene(scene.system, scene.constraints, cones=jd.contact.friction_cone("hard-finger", 0.2)),
                             *STILL, TIMES), "contact has 2"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=match):
            call()
