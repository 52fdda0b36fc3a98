"""Position limits of joints in a motion: told, or the end of the run, at the time of the closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd


@pytest.fixture(scope="module")
def cart():
    """A cart that is pushed along a rail of 1 m by a constant force, q(t) = F t^2 / (2 m)."""
    builder = jd.ModelBuilder("cart on a rail", gravity=None)
    builder.add_body(
        "cart", joint="prismatic", axis=(1, 0, 0), inertia=jd.inertia.box(2.0, (0.1, 0.1, 0.1)), lower=-1.0, upper=1.0
    )
    return builder.build()


TS = jnp.linspace(0.0, 3.0, 7)


def push(q, v, t):
    return jnp.ones_like(v)


def test_a_motion_ends_where_a_joint_meets_its_limit(cart):
    """q = 1 at t = 2; rounding of the limit, 1.5e-8 of it, is let pass."""
    end = jd.simulate(cart, [0.0], [0.0], TS, control=push, events=[jd.events.JointLimit()], throw=False)
    assert end.result == jd.RESULTS.joint_limit_passed and not bool(end.success)
    np.testing.assert_allclose(end.stats["time_reached"], 2.0, rtol=2e-8)
    assert int(end.stats["passed_limit"]) == 0
    assert np.isfinite(end.q[:5]).all() and np.isnan(end.q[5:]).all()
    with pytest.raises(RuntimeError, match=r"at t = 2 s of 3 s. A joint passed .* the joint is 'cart_joint'"):
        jd.simulate(cart, [0.0], [0.0], TS, control=push, events=[jd.events.JointLimit()])
    # As many times as before, so that it is the same program.
    free = jd.simulate(cart, [0.0], [0.0], 0.6 * np.asarray(TS), control=push, events=[jd.events.JointLimit()])
    assert bool(free.success) and int(free.stats["passed_limit"]) == -1


@pytest.mark.slow
def test_lanes_end_at_their_own_times(cart):
    """From -v: down and back up again, or through the lower limit; q(t) = v t + t^2 / 4."""
    speeds = jnp.array([[0.0], [-0.9], [-1.2], [0.5]])
    run = jax.jit(
        jax.vmap(lambda v: jd.simulate(cart, jnp.zeros(1), v, TS, control=push, events=[jd.events.JointLimit()]))
    )
    computed = run(speeds)
    v = np.asarray(speeds)[:, 0]
    upper, lower = 2 * (-v + np.sqrt(v**2 + 1)), -2 * v[2] - 2 * np.sqrt(v[2] ** 2 - 1)
    times = np.where(np.arange(4) == 2, lower, upper)
    ends = times < 3.0
    assert ends.tolist() == (computed.result == jd.RESULTS.joint_limit_passed).tolist() == [True, False, True, True]
    np.testing.assert_allclose(computed.stats["time_reached"][ends], times[ends], rtol=1e-7)


@pytest.mark.long
def test_a_motion_that_goes_on_tells(cart):
    with pytest.warns(
        jd.simulation.JointLimitWarning, match=r"'cart_joint' is at 1.5625, its upper limit is 1, at t = 2.5 s"
    ):
        told = jd.simulate(cart, [0.0], [0.0], TS, control=push, events=[jd.events.JointLimit(stop=False)])
    assert bool(told.success) and int(told.stats["passed_limit"]) == 0
    np.testing.assert_allclose(told.q[:, 0], TS**2 / 4, atol=1e-9)
    earlier = np.asarray(TS) * 2 / 3
    within = jd.simulate(
        cart, [0.0], [0.0], earlier, control=push, events=[jd.events.JointLimit(stop=False)]
    )  # warnings are errors
    assert int(within.stats["passed_limit"]) == -1
    assert "passed_limit" not in jd.simulate(cart, [0.0], [0.0], TS[:5], control=push).stats


def test_refusals(cart):
    with pytest.raises(ValueError, match="limits is 'hard'"):
        jd.simulate(cart, [0.0], [0.0], TS, limits="hard")  # pyright: ignore[reportCallIssue]
    system = jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * v), 1)
    with pytest.raises(ValueError, match="a LagrangianSystem has no joint limits"):
        jd.simulate(system, [0.0], [0.0], TS, events=[jd.events.JointLimit()])
