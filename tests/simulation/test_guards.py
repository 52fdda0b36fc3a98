"""Motions that a guard ends: the time of the end, and its derivatives, in closed form."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import slider
from motion_helpers import within
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.simulation.solvers.guards import Point, Search, search_root

TS = np.linspace(0.0, 3.0, 7)
STOPS = [jd.events.JointLimit()]
ROUNDING = np.finfo(float).eps ** 0.5  # that conditions let pass, of the size of a limit or a force
TIGHT: dict[str, Any] = {"stepsize": within(1e-12)}
WEIGHT = 2.0 * 9.81
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # z of the contact along y of the plane


def block():
    builder = jd.ModelBuilder("block", gravity=(0.0, -9.81, 0.0))
    builder.add_body("block", None, "planar", jd.inertia.box(2.0, (0.2, 0.1, 0.3)))
    touch = jd.grasp.contact(
        "hard-finger", None, UPRIGHT, object="block", finger_pose=UPRIGHT, in_plane=True, name="table"
    )
    return jd.Scene(builder.build(), [touch], cones=jd.contact.friction_cone("hard-finger", 0.5, in_plane=True))


class Spring(jd.Controller):
    """A spring that is lost where the cart comes to 0.3 m."""

    stiffness: jax.Array

    def __call__(self, q, v, t, state=None, multipliers=None):
        return -self.stiffness * q

    def allowance(self, q, v, t):
        return q[0] - 0.3


def push_block(rate, q, v, t):
    return jnp.stack([rate * t, jnp.zeros_like(t), jnp.zeros_like(t)])


def push_cart(q, v, t):
    return jnp.ones_like(v)


RAIL, FREE, BLOCK = slider(2.0, lower=-1.0, upper=1.0), slider(2.0), block()


def limit(v, **options):
    """q(t) = v t + t^2/4 from the middle of the rail to its end."""
    return jd.simulate(RAIL, jnp.zeros(1), v[None], TS, control=push_cart, events=STOPS, throw=False, **options)


def cone(rate, **options):
    """A block that is pushed by a force that grows with time, until it slips."""
    control = jax.tree_util.Partial(push_block, rate)
    return jd.simulate(BLOCK, jnp.zeros(3), jnp.zeros(3), TS, control=control, throw=False, **options)


def spring(stiffness, **options):
    """q(t) = cos(w t) with w^2 = k/m."""
    return jd.simulate(FREE, jnp.ones(1), jnp.zeros(1), TS, control=Spring(stiffness), throw=False, **options)


class Case(NamedTuple):
    """A motion of one number, with three of them, the time of its end, and its first derivative."""

    move: Any
    numbers: np.ndarray
    time: Any
    derivative: Any
    code: str


def limit_time(v):
    return 2 * (-v + np.sqrt(v * v + 1 + ROUNDING))


def spring_time(k):
    return np.arccos(0.3) / np.sqrt(k / 2)


CASES = {
    "limit": Case(
        limit,
        np.array([0.0, 0.5, -0.4]),
        limit_time,
        lambda v: -limit_time(v) / (v + limit_time(v) / 2),
        "joint_limit_passed",
    ),
    "cone": Case(
        cone,
        np.array([15.0, 4.0, 30.0]),
        lambda r: WEIGHT * (0.5 + ROUNDING) / (r * (1 - ROUNDING)),
        lambda r: -WEIGHT * (0.5 + ROUNDING) / (r * r * (1 - ROUNDING)),
        "contact_lost",
    ),
    "controller": Case(
        spring, np.array([3.0, 2.0, 7.0]), spring_time, lambda k: -spring_time(k) / (2 * k), "control_singular"
    ),
}
EXPLICIT = {
    "Dopri8": TIGHT,
    "Tsit5": TIGHT | {"solver": diffrax.Tsit5()},
    # Steps of RK4 are exact for the motions of cart and block; those of the spring end within 1e-10 by their length.
    "RK4": {"stepsize": 2e-3},
}


def end_of(move, **options):
    def time(x):
        solution = move(x, **options)
        return solution.stats["time_reached"], solution

    return time


@pytest.mark.long
@pytest.mark.parametrize(
    ("how", "name"),
    [
        pytest.param(how, name, marks=() if how == "Dopri8" or (how, name) == ("RK4", "limit") else pytest.mark.slow)
        for how in EXPLICIT
        for name in CASES
    ],
)
def test_a_motion_ends_at_the_root(name, how):
    """Three trajectories, the rows before the end and none behind it, and the derivative of the time by reverse mode."""
    case = CASES[name]
    gradient = jax.value_and_grad(end_of(case.move, **EXPLICIT[how]), has_aux=True)
    (times, solution), derivatives = jax.jit(jax.vmap(gradient))(jnp.asarray(case.numbers))
    assert np.asarray(solution.result == getattr(jd.RESULTS, case.code)).all()
    expected = case.time(case.numbers)
    np.testing.assert_allclose(times, expected, rtol=1e-10)
    np.testing.assert_allclose(derivatives, case.derivative(case.numbers), rtol=1e-9 if how == "RK4" else 1e-10)
    np.testing.assert_array_equal(np.isfinite(solution.q).all(2), expected[:, None] >= TS)


@pytest.mark.long
@pytest.mark.parametrize("name", [pytest.param("cone", marks=pytest.mark.slow), "limit", "controller"])
def test_a_single_motion_has_both_modes(name):
    case = CASES[name]
    x = jnp.asarray(case.numbers[0])
    solution = case.move(x, **TIGHT)
    assert solution.result == getattr(jd.RESULTS, case.code)
    np.testing.assert_allclose(solution.stats["time_reached"], case.time(case.numbers[0]), rtol=1e-10)
    forward = quick(jax.jacfwd(end_of(case.move, adjoint="forward", **TIGHT), has_aux=True))
    np.testing.assert_allclose(forward(x)[0], case.derivative(case.numbers[0]), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_implicit_steps_find_the_same_time(name):
    """In the loop of diffrax, by its dense output of third order."""
    case = CASES[name]
    options: dict[str, Any] = {"solver": diffrax.Kvaerno5(), "stepsize": within(1e-9)}
    gradient = jax.value_and_grad(end_of(case.move, **options), has_aux=True)
    (times, solution), derivatives = jax.jit(jax.vmap(gradient))(jnp.asarray(case.numbers))
    assert np.asarray(solution.result == getattr(jd.RESULTS, case.code)).all()
    np.testing.assert_allclose(times, case.time(case.numbers), rtol=1e-6)
    np.testing.assert_allclose(derivatives, case.derivative(case.numbers), rtol=1e-6)
    forward = quick(jax.jacfwd(end_of(case.move, adjoint="forward", **options), has_aux=True))
    np.testing.assert_allclose(forward(case.numbers[0])[0], case.derivative(case.numbers[0]), rtol=1e-6)


@pytest.mark.slow
def test_a_basis_and_limits_in_one_run_have_derivatives():
    """The end of a four-bar in minimal velocities by implicit steps, and in all of them by explicit ones."""
    scene = jd.scenes.four_bar()
    q, v = jd.scenes.four_bar.start()
    limits = eqx.tree_at(
        lambda s: (s.system.lower, s.system.upper), scene, (jnp.asarray(q) - 0.05, jnp.asarray(q) + 0.05)
    )

    def time(rate, **options):
        run = jd.simulate(limits, q, rate * v, jnp.linspace(0.0, 1.0, 5), events=STOPS, throw=False, **options)
        return run.stats["time_reached"]

    implicit: dict[str, Any] = {"method": "reduced", "solver": diffrax.Kvaerno5(), "stepsize": within(1e-9)}
    computed, expected = (jax.value_and_grad(time)(1.0, **options) for options in (implicit, TIGHT))
    np.testing.assert_allclose(computed, expected, rtol=1e-5)


def test_rows_before_the_end_have_derivatives():
    """q = v t + t^2/4 has the derivative t at the save points before the end; those behind it are NaN."""

    def rows(v):
        q = limit(v, **TIGHT).q[:, 0]
        return jnp.where(jnp.isfinite(q), q, 0.0)

    computed = jax.jit(jax.jacrev(rows))(jnp.asarray(0.5))
    np.testing.assert_allclose(computed, np.where(limit_time(0.5) >= TS, TS, 0.0), atol=1e-11)


@pytest.mark.parametrize("name", CASES)
def test_the_continuous_adjoint_is_refused(name):
    """Its backward equations know no event; it saw violations at save points alone, whose time is not that of the event."""
    with pytest.raises(ValueError, match="back through events"):
        CASES[name].move(jnp.asarray(1.0), adjoint="backsolve")


def test_a_start_behind_the_guard_is_the_end():
    beyond = jd.simulate(RAIL, [1.5], [0.0], TS, control=push_cart, events=STOPS, throw=False)
    assert beyond.result == jd.RESULTS.joint_limit_passed and float(beyond.stats["time_reached"]) == 0.0
    assert np.isfinite(beyond.q[0]).all() and np.isnan(beyond.q[1:]).all()


@pytest.mark.long
def test_the_same_without_kernels():
    with jd.compilation("plain"):
        solution = limit(jnp.asarray(0.5), **TIGHT)
    np.testing.assert_allclose(solution.stats["time_reached"], limit_time(0.5), rtol=1e-10)


def there_and_back(depth, **options):
    """q = v t - t^2/4, whose top is above the end of the rail by `depth`, in steps that are not told of it."""
    top = 1.0 + depth
    v = np.sqrt(top)
    ts = np.linspace(0.0, 4 * v, options.pop("saves", 2))
    back = lambda q, v, t: -jnp.ones_like(v)  # noqa: E731
    run = jd.simulate(RAIL, jnp.zeros(1), jnp.asarray([v]), ts, control=back, events=STOPS, throw=False, **options)
    return run, 2 * (v - np.sqrt(v * v - 1 - ROUNDING))


def test_a_guard_that_is_violated_within_a_step_ends_the_motion():
    """The top is at 2 v, and above one for 0.13 s; the second step has its middle there."""
    solution, time = there_and_back(1e-3, saves=3, stepsize=4 * np.sqrt(1.001) / 3)
    assert solution.result == jd.RESULTS.joint_limit_passed
    np.testing.assert_allclose(solution.stats["time_reached"], time, rtol=1e-10)


LONG = {
    "explicit": {},
    "fixed": {"stepsize": 5.0},
    "Rodas5P": {"solver": jd.solvers.Rodas5P()},
    "fixed Rodas5P": {"solver": jd.solvers.Rodas5P(), "stepsize": 5.0},
    "forward": {"adjoint": "forward"},
}


@pytest.mark.slow
@pytest.mark.parametrize("saves", [2, 12])
@pytest.mark.parametrize("how", LONG)
def test_a_passage_within_one_step_ends_the_motion_at_its_time(how, saves):
    """A parabola is exact in one step of every method; the passage lasts a twentieth of it, with save points in it or not."""
    solution, time = there_and_back(2e-3, saves=saves, **LONG[how])
    assert solution.result == jd.RESULTS.joint_limit_passed
    np.testing.assert_allclose(solution.stats["time_reached"], time, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Kvaerno5(), diffrax.KenCarp4(), jd.solvers.LieGroup(diffrax.Tsit5())])
def test_other_methods_find_the_passage_too(solver):
    """Their dense output of third order gives the time to 1e-6."""
    solution, time = there_and_back(2e-3, saves=12, solver=solver, stepsize=1.5)
    assert solution.result == jd.RESULTS.joint_limit_passed
    np.testing.assert_allclose(solution.stats["time_reached"], time, rtol=1e-6)


@pytest.mark.slow
def test_short_passages_of_an_oscillation_are_found():
    """q = 1.001 sin(w t): a passage of 1e-3 of the amplitude, whose time no step knows, for 20 frequencies in plain mode too."""
    frequencies = jnp.linspace(0.9, 2.1, 20)

    def time(w):
        law = jax.tree_util.Partial(lambda w, q, v, t: -2.0 * w * w * q, w)
        run = jd.simulate(RAIL, jnp.zeros(1), 1.001 * w[None], TS, control=law, events=STOPS, throw=False)
        return run.stats["time_reached"], run.result == jd.RESULTS.joint_limit_passed

    wanted = np.arcsin((1 + ROUNDING) / 1.001) / np.asarray(frequencies)
    for mode in ("auto", "plain"):
        with jd.compilation(mode):
            times, found = jax.jit(jax.vmap(time))(frequencies)
        assert np.asarray(found).all()
        # The passage is slow, 0.045 w: an error of the motion of 1e-8 is one of 1e-6 of the time.
        np.testing.assert_allclose(times, wanted, rtol=2e-6)


@pytest.mark.long
def test_passages_within_one_step_switch_pieces_and_hit_contacts():
    """The parabola above, into a spring behind the end of the rail and against a wall there, for a twentieth of a step."""
    depth = 2e-3
    v, u = np.sqrt(1 + depth), np.sqrt(depth)
    into, end = 2 * (v - u), 4 * v
    back = lambda q, v, t: -jnp.ones_like(v)  # noqa: E731
    # In the spring x'' = -(1 + k x)/2 from x = 0 with the velocity u; it comes back with -u.
    k = 50.0
    w = np.sqrt(k / 2)
    inside = 2 * np.arctan2(u / w, 1 / k) / w
    wall = jd.contact.gap_contact(lambda q, t: 1.0 - q[0], restitution=0.5, name="wall")
    cases = ((jd.forces.JointStops(k), u, inside), (wall, 0.5 * u, 0.0))
    for force, speed, waits in cases:
        scene = jd.Scene(RAIL, forces=[force])
        motion = jd.simulate(scene, [0.0], [v], np.array([0.0, end]), control=back, **TIGHT)
        left = end - into - waits
        np.testing.assert_allclose(motion.q[-1, 0], 1 - speed * left - left**2 / 4, atol=1e-9)
    np.testing.assert_allclose(motion.events.time[0], into, rtol=1e-10)


def limit_of(p, **options):
    """q(t) = v t + F t^2/4 of both numbers, and the end of the save points."""
    law = jax.tree_util.Partial(lambda force, q, v, t: force[None], p[1])
    ts = jnp.linspace(0.0, p[2], 4)
    run = jd.simulate(RAIL, jnp.zeros(1), p[:1], ts, control=law, events=STOPS, throw=False, **options)
    return run.stats["time_reached"]


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["reverse", "forward"])
def test_the_time_has_second_derivatives(adjoint):
    """Mixed ones too; of a run that does not end there the time is that of the last save point."""
    options: dict[str, Any] = TIGHT | {"adjoint": adjoint}
    outer, inner = jax.jacfwd, jax.jacfwd if adjoint == "forward" else jax.grad

    def both(p):
        return inner(lambda p: limit_of(p, **options))(p), outer(inner(lambda p: limit_of(p, **options)))(p)

    gradients, hessians = jax.jit(jax.vmap(both))(jnp.asarray([[0.3, 1.0, 3.0], [0.3, 1.2, 1.0]]))
    closed = lambda p: 2 * (-p[0] + jnp.sqrt(p[0] ** 2 + p[1] * (1 + ROUNDING))) / p[1]  # noqa: E731
    at = jnp.asarray([0.3, 1.0, 3.0])
    np.testing.assert_allclose(gradients[0], jax.grad(closed)(at), atol=1e-9)
    np.testing.assert_allclose(hessians[0], jax.hessian(closed)(at), atol=1e-8)
    np.testing.assert_allclose(gradients[1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(hessians[1], 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cone", "controller"])
def test_other_times_have_second_derivatives(name):
    """T = c/r of the cone, and c/k^(1/2) of the spring."""
    case = CASES[name]
    x = case.numbers[0]
    second = jax.jit(jax.jacfwd(jax.grad(lambda x: case.move(x, **TIGHT).stats["time_reached"])))(jnp.asarray(x))
    np.testing.assert_allclose(second, case.time(x) / x**2 * (2 if name == "cone" else 0.75), rtol=1e-9)


@pytest.mark.parametrize("fraction", [0.31, 0.53, 0.7, 0.83])
def test_a_zero_of_the_dense_output_between_two_numbers_of_the_time_is_passed(fraction):
    """A guard that is negative at a fraction of a step by its dense output alone: the search ends, and the step is kept."""
    one, none, t0 = np.ones(1), np.zeros(1), np.array(0.4)
    length = np.array(5e-6)
    search = jax.tree.map(np.asarray, Search.begin(jnp.ones(1), jnp.zeros(1, bool), jnp.asarray(length)))
    attempt = jax.jit(search_root)
    for _ in range(100):
        within = [Point(np.array(fraction), -one, none)]
        search, kept, located, length = attempt(search, t0, t0 + length, (one, none), within, True, np.array(1.0))
        if kept:
            break
    # Not at an event, and at the fraction up to the rounding of the time.
    assert located and not search.hit.any() and not search.locating
    assert abs(float(search.bracket.low) - fraction * 5e-6) < 2e-16
