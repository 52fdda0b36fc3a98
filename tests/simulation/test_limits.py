"""Position limits of joints in a motion: told, or the end of the run, at the time of the closed form."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from refusals import refusals

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
    with pytest.raises(RuntimeError, match=r"2 s.*'cart_joint'"):
        jd.simulate(cart, [0.0], [0.0], TS, control=push, events=[jd.events.JointLimit()])
    # As many times as before, so that it is the same program.
    free = jd.simulate(cart, [0.0], [0.0], 0.6 * np.asarray(TS), control=push, events=[jd.events.JointLimit()])
    assert bool(free.success) and int(free.stats["passed_limit"]) == -1


@pytest.mark.long
def test_a_motion_that_goes_on_tells(cart):
    with pytest.warns(jd.simulation.JointLimitWarning, match="1.5625.*2.5 s"):
        told = jd.simulate(cart, [0.0], [0.0], TS, control=push, events=[jd.events.JointLimit(stop=False)])
    assert bool(told.success) and int(told.stats["passed_limit"]) == 0
    np.testing.assert_allclose(told.q[:, 0], TS**2 / 4, atol=1e-9)
    earlier = np.asarray(TS) * 2 / 3
    within = jd.simulate(
        cart, [0.0], [0.0], earlier, control=push, events=[jd.events.JointLimit(stop=False)]
    )  # warnings are errors
    assert int(within.stats["passed_limit"]) == -1
    assert "passed_limit" not in jd.simulate(cart, [0.0], [0.0], TS[:5], control=push).stats


def run(system, **options):
    return jd.simulate(system, [0.0], [0.0], TS, **options)


MASS = jd.LagrangianSystem(lambda q, v: 0.5 * jnp.sum(v * v), 1)
test_what_does_not_fit_is_refused = refusals(
    (lambda cart: run(cart, limits="hard"), "limits is 'hard'"),
    (lambda cart: run(MASS, events=[jd.events.JointLimit()]), "no joint limits"),
    (lambda cart: run(cart, events=[jd.events.JointLimit(), jd.events.JointLimit(False)]), "has 2 of"),
    (lambda cart: run(cart, events=[jd.events.Terminal(lambda q, v, t: q)]), "return one number"),
    (lambda cart: run(cart, events=[jd.events.Terminal(lambda q, v, t: q[0] < 1)]), "returned a bool"),
    (lambda cart: run(cart, events=[jd.events.ContactLost()]), "no cones"),
    (lambda cart: jd.events.Terminal(lambda q: q), "Terminal: function"),
    given=("cart",),
)


class Below(eqx.Module):
    """The height of a body above a level, m."""

    level: jax.Array

    def __call__(self, q, v, t):
        return height(q) - self.level


def height(q):
    return q[2] if q.size == 7 else q[0]


def fall(level, *others, joint="prismatic", **options):
    """Motion of a ball from rest at 2 m to a level (m), or to the first of the other events."""
    builder = jd.ModelBuilder("ball")
    builder.add_body("ball", None, joint, jd.inertia.sphere(0.5, 0.1), **{"axis": (0, 0, 1)} if joint != "free" else {})
    model, q0 = builder.build(), jnp.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0] if joint == "free" else [2.0])
    terminal = [*(jd.events.Terminal(one) for one in others), jd.events.Terminal(Below(jnp.asarray(level)))]
    given = {"events": terminal, "stepsize": within(1e-10)} | options
    return jd.simulate(model, q0, jnp.zeros(model.nv), jnp.linspace(0.0, 1.0, 11), **given)


def test_a_terminal_event_ends_a_run_at_its_time():
    """Free fall to a level: t = sqrt(2 h / g), with its derivatives; the end of the fall counts as a success."""
    run = fall(0.5, joint="free")
    time = np.sqrt(2 * 1.5 / 9.81)
    np.testing.assert_allclose(run.stats["time_reached"], time, rtol=1e-12)
    assert bool(run.success) and run.result == jd.RESULTS.event_occurred
    assert np.isfinite(run.q[:6]).all() and np.isnan(run.q[6:]).all() and int(run.stats["terminal_event"]) == 0
    beyond = fall(-5.0)
    assert beyond.result == jd.RESULTS.successful and int(beyond.stats["terminal_event"]) == -1
    # A velocity of -2 m/s is reached before the level.
    assert int(fall(0.5, lambda q, v, t: v[0] + 2.0).stats["terminal_event"]) == 0
    assert int(fall(1.9, lambda q, v, t: v[0] + 2.0).stats["terminal_event"]) == 1


OTHER_STEPS = {"adaptive": {}, "fixed": {"stepsize": 0.01}, "stiff": {"solver": jd.solvers.Rodas5P()}}


def scaled(level, q, v, t):
    return 1e13 * (height(q) - level)


@pytest.mark.parametrize("how", [*OTHER_STEPS, pytest.param("implicit", marks=pytest.mark.slow)])
def test_terminal_events_have_units_of_their_own(how):
    """The rounding of an event in large units is more than the whole value of another; index, code and derivative are its own."""
    options = (OTHER_STEPS | {"implicit": {"solver": diffrax.Kvaerno5()}})[how]

    def end(level):
        events = lambda q, v, t: 0.01 - 0.001 * t, jax.tree_util.Partial(scaled, level)
        run = fall(-9.0, *events, throw=False, **options)
        return run.stats["time_reached"], run

    levels = jnp.linspace(0.1, 1.9, 64)
    (times, runs), slopes = jax.jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))(levels)
    expected = np.sqrt(2 * (2 - levels) / 9.81)
    ended = expected < 1
    assert (np.asarray(runs.result == jd.RESULTS.event_occurred) == ended).all()
    np.testing.assert_array_equal(runs.stats["terminal_event"], np.where(ended, 1, -1))
    np.testing.assert_allclose(times, np.where(ended, expected, 1.0), rtol=1e-9)
    np.testing.assert_allclose(slopes, np.where(ended, -1 / (9.81 * expected), 0.0), rtol=1e-8)


@pytest.mark.parametrize(("how", "function"), [("adaptive", jnp.sqrt), ("fixed", jnp.log), ("stiff", jnp.sqrt)])
def test_a_function_that_is_nan_past_its_zero_ends_the_run_there(how, function):
    zero = 1.0 if function is jnp.sqrt else 0.0  # of the function, by which its argument is shifted
    run = fall(-9.0, lambda q, v, t: function(q[0] - zero), **OTHER_STEPS[how])
    np.testing.assert_allclose(run.stats["time_reached"], np.sqrt(2 / 9.81), rtol=1e-9)


@pytest.mark.parametrize("how", OTHER_STEPS)
def test_a_terminal_event_must_be_above_zero_at_the_start(how):
    """At zero, the method and rounding would decide between the start and the first save point."""
    run = jax.jit(lambda level: fall(level, throw=False, **OTHER_STEPS[how]))
    for level in (2.0, 3.0, np.nan):
        with pytest.raises(ValueError, match="at the start"):
            fall(level, **OTHER_STEPS[how])
        assert run(level).result == jd.RESULTS.bad_event and not bool(run(level).success)


@pytest.mark.long
def test_the_time_of_a_terminal_event_has_derivatives():
    time = np.sqrt(2 * 1.5 / 9.81)
    reached = jax.jit(lambda level: fall(level).stats["time_reached"])
    directly = jax.jit(lambda level: fall(level, adjoint="forward").stats["time_reached"])
    slope, bend = -1 / (9.81 * time), -1 / (9.81**2 * time**3)
    np.testing.assert_allclose(jax.grad(reached)(0.5), slope, rtol=1e-10)
    np.testing.assert_allclose(jax.jacfwd(directly)(0.5), slope, rtol=1e-10)
    np.testing.assert_allclose(jax.hessian(reached)(0.5), bend, rtol=1e-10)
    levels = jnp.array([0.5, 1.0])
    np.testing.assert_allclose(jax.vmap(reached)(levels), np.sqrt(2 * (2 - levels) / 9.81), rtol=1e-12)
    with pytest.raises(ValueError, match="backsolve"):
        fall(0.5, adjoint="backsolve")


@pytest.mark.parametrize(
    ("former", "present", "text"),
    [
        ({"limits": "stop"}, {"events": [jd.events.JointLimit()]}, r"events=\[jd.events.JointLimit\(stop=True\)\]"),
        ({"rtol": 1e-4}, {"stepsize": jd.simulation.Steps(rtol=1e-4)}, r"stepsize=jd.simulation.Steps\(rtol="),
        (
            {"stepsize": 0.1, "max_steps": 3},
            {"stepsize": jd.simulation.Steps(0.1, max_steps=3)},
            r"Steps\(stepsize, max_steps=",
        ),
        ({"outputs": ("pose:cart",)}, {"outputs": (jd.simulation.Pose("cart"),)}, r"outputs=\(jd.simulation.Pose"),
    ],
)
def test_former_arguments_warn_with_the_new_form(cart, former, present, text):
    def run(**options):
        return jd.simulate(cart, [0.0], [0.0], TS, control=push, throw=False, **options)

    with pytest.warns(DeprecationWarning, match=text):
        end = run(**former)
    wanted = run(**present)
    np.testing.assert_array_equal(end.q, wanted.q)
    assert end.poses.keys() == wanted.poses.keys() and end.result == wanted.result
