"""Extreme masses, lengths, rates, angles and gravity: exact laws of scale, and closed forms in 60 digits."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick, random_states, random_tree

import jaxdyn as jd
from jaxdyn import inertia
from jaxdyn.dynamics import recursions, scans, world_frame

FORMS = {"matrices": world_frame.forward_dynamics, "recursion": recursions.aba, "loops": scans.forward_dynamics}


_programs = quick(lambda model, *states: [form(model, *states) for form in FORMS.values()])


def all_forms(model, *states):
    """Accelerations by each implementation; compiled once per mechanism, whatever its numbers."""
    return _programs(model, *(jnp.asarray(x) for x in states))


@pytest.fixture(scope="module")
def arm():
    """Six screw joints that are no special case, and a state."""
    model = random_tree(4, ("revolute", "prismatic", "revolute", "helical", "revolute", "revolute"))
    q, v, _, tau, _ = (x[0] for x in random_states(model, 1, 3))
    return model.replace(armature=None), q, v, tau


def scaled(model: jd.Model, length: float, mass: float, gravity: float) -> jd.Model:
    """The same mechanism in other units, or a larger or heavier twin."""
    prismatic = np.array([kind == "prismatic" for kind in model.topology.kinds])
    inertias = model.inertias * (mass * np.array([1.0] + 3 * [length] + 6 * [length**2]))[None]
    screws = model.screws.at[:, :3].multiply(np.where(prismatic, 1.0, length)[:, None])
    home = model.home.at[:, :3, 3].multiply(length)
    return model.replace(inertias=inertias, screws=screws, home=home, gravity=model.gravity * gravity)


@pytest.mark.parametrize("length", [1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("mass", [1e-8, 1e8])
def test_twins_of_another_size_move_alike(arm, length, mass):
    """Lengths, masses and gravity scaled so that time is not: angles accelerate as before, slides in proportion."""
    model, q, v, tau = arm
    slides = np.array([kind == "prismatic" for kind in model.topology.kinds])
    unit = np.where(slides, length, 1.0)
    force = np.where(slides, mass * length, mass * length**2)
    twin = scaled(model, length, mass, length)
    for a, b in zip(all_forms(model, q, v, tau), all_forms(twin, q * unit, v * unit, tau * force), strict=True):
        assert_close(b / unit, a, 1e-11)


@pytest.mark.parametrize("rate", [1e4, 1e-8])
def test_rates_enter_by_their_square(arm, rate):
    model, q, v, _ = arm
    free, none = model.replace(gravity=jnp.zeros(3)), jnp.zeros(model.nv)
    for a, b in zip(all_forms(free, q, v, none), all_forms(free, q, rate * v, none), strict=True):
        assert_close(b / rate**2, a, 1e-11)


def test_gravity_enters_linearly(arm):
    model, q, _, _ = arm
    none = jnp.zeros(model.nv)
    strong = model.replace(gravity=1e4 * model.gravity)
    for a, b in zip(all_forms(model, q, none, none), all_forms(strong, q, none, none), strict=True):
        assert_close(b / 1e4, a, 1e-11)
    for a in all_forms(model.replace(gravity=jnp.zeros(3)), q, none, none):
        assert (a == 0).all()


def test_a_million_turns_cost_the_digits_of_the_angle(arm):
    model, q, v, tau = arm
    turning = np.array([kind == "revolute" for kind in model.topology.kinds])
    far = q + 2 * np.pi * 1e6 * turning
    # An angle of 6e6 rad is rounded to 5e-10 rad, and a helical joint does not come back.
    for a, b in zip(all_forms(model, q, v, tau), all_forms(model, far, v, tau), strict=True):
        assert_close(b, a, 1e-7)


def two_links(ratio):
    """Two point masses 1 and `ratio` kg on rods of 1 m, q relative, and the exact acceleration at a state."""
    builder = jd.ModelBuilder("two links", gravity=(0.0, -9.81, 0.0))
    point = (1.0, 0.0, 0.0)
    builder.add_body("a", joint="revolute", axis=(0, 0, 1), inertia=inertia.point_mass(1.0, point))
    builder.add_body("b", "a", joint="revolute", axis=(0, 0, 1), pose=point, inertia=inertia.point_mass(ratio, point))
    q, v, tau = (0.4, 1.1), (0.7, -1.3), (0.5, 0.2 * ratio)
    with mpmath.workdps(60):
        q1, q2, v1, v2, t1, t2 = (mpmath.mpf(x) for x in (*q, *v, *tau))
        m, g = mpmath.mpf(ratio), mpmath.mpf(9.81)
        c, s = mpmath.cos(q2), mpmath.sin(q2)
        M = mpmath.matrix([[1 + m + m + 2 * m * c, m + m * c], [m + m * c, m]])
        tip = m * g * mpmath.cos(q1 + q2)
        h1 = -m * s * (2 * v1 * v2 + v2**2) + (1 + m) * g * mpmath.cos(q1) + tip
        a = mpmath.lu_solve(M, mpmath.matrix([t1 - h1, t2 - m * s * v1**2 * 1 - tip]))
        exact = np.array([float(x) for x in a])
    return builder.build(), (jnp.asarray(q), jnp.asarray(v), jnp.asarray(tau)), exact


@pytest.mark.parametrize("ratio", [1e-8, 1e-4, 1.0, 1e4, 1e8])
def test_a_heavy_or_nearly_massless_tip(ratio):
    model, state, exact = two_links(ratio)
    # A heavy tip on a light link: the light link's inertia is what is left of the heavy one's when it is eliminated, to
    # eps * ratio. What is lost is lost in the numbers of M, whatever the algorithm.
    tol = 1e-13 * max(ratio, 10.0)
    for a in all_forms(model, *state):
        assert_close(a, exact, tol)


@pytest.mark.parametrize("angle", [1e-2, 1e-4, 1e-6, 1e-8, 1e-12])
def test_rows_that_nearly_depend_on_each_other(angle):
    """A particle held by two lines at a small angle: at rest while they count as two, and said to be on one below that."""
    system = jd.ExplicitSystem(lambda q: jnp.eye(2), lambda q, v: jnp.zeros(2), 2)
    lines = jnp.asarray([[0.0, 1.0], [np.sin(angle), np.cos(angle)]])
    scene = jd.Scene(system, (jd.Holonomic(jax.tree_util.Partial(lambda lines, q, t: lines @ q, lines), name="lines"),))
    push = jnp.asarray([1.0, 2.0])
    dynamics = jd.constrained_dynamics(scene, jnp.zeros(2), jnp.zeros(2), push)
    assert dynamics.result == jd.RESULTS.successful
    if angle > 1e-8:
        assert int(dynamics.rank) == 2
        assert jnp.abs(dynamics.acceleration).max() < 1e-14 / angle  # the crossing is known to eps / angle
    if angle < 1e-9:
        assert int(dynamics.rank) == 1
        assert_close(dynamics.acceleration, [1.0, 0.0], 1e-11)
    assert jnp.isfinite(dynamics.multipliers).all()
