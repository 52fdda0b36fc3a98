"""Overconstrained scenes: rank, closed forms, motions in minimal coordinates, fixed steps, gradients and batches."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import largest_residuals, within
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from benchmarks.overconstrained import MECHANISMS, distance
from jaxdyn.constraints.selection import select_rows

# Name, rows, rank, freedom.
COUNTS = [
    ("bennett", 5, 2, 1),
    ("goldberg", 5, 3, 1),
    ("bricard", 5, 4, 1),
    ("sarrus", 5, 4, 1),
    ("tilted_four_bar", 5, 2, 1),
    ("three_legs", 10, 4, 3),
    ("six_legs", 25, 10, 3),
]
NAMES = [name for name, *_ in COUNTS]
LIKE = "goldberg", "tilted_four_bar", "three_legs"  # others
FEWER = [pytest.param(*row, marks=[pytest.mark.slow] * (row[0] in LIKE)) for row in COUNTS]


def chosen(*fast):
    """All mechanisms, of which only some are fast tests: each is compiled for some seconds."""

    def marks(name):
        return [] if name in fast else [pytest.mark.slow]

    return pytest.mark.parametrize("name", [pytest.param(name, marks=marks(name)) for name in NAMES])


@functools.cache
def mechanism(name):
    """The scene with its motion in minimal coordinates."""
    return MECHANISMS[name][1]()


def begin(one, scale=1.0):
    """q and v at the start, with another rate."""
    return one.start(np.asarray(one.x), scale * np.asarray(one.rate))


@pytest.mark.long
@pytest.mark.parametrize(("name", "rows", "rank", "freedom"), FEWER)
def test_rank_and_freedom(name, rows, rank, freedom):
    """Starts are on the constraints, with the freedom that the mechanism has and not the one that counting joints gives."""
    one = mechanism(name)
    q, v = begin(one)
    selection = select_rows(one.scene, np.asarray(q), 0.0)
    assert selection.kept.shape == (rows,) and selection.kept.sum() == rank
    assert jd.degrees_of_freedom(one.scene, q) == freedom == one.scene.nv - rank
    assert float(jnp.max(jnp.asarray(largest_residuals(one.scene, q, v)))) < 1e-14 * (1 + float(jnp.abs(v).max()))
    singular = np.linalg.svd(jd.constraint_jacobian(one.scene, q), compute_uv=False)
    assert (singular > 1e-9 * singular[0]).sum() == rank


@pytest.mark.long
@chosen("goldberg", "sarrus")
def test_energies_and_accelerations_in_minimal_coordinates(name):
    """Energies by the places of all bars, and accelerations by Lagrange's equations: dv/dt along the motion x(t)."""
    one = mechanism(name)
    q, v = begin(one)
    x, rate = np.asarray(one.x), np.asarray(one.rate)
    system = one.scene.system

    @quick
    def compute(q, v):
        computed = jd.constrained_dynamics(one.scene, q, v)
        return jd.kinetic_energy(system, q, v), jd.potential_energy(system, q), computed.acceleration, computed.result

    kinetic, potential, acceleration, result = compute(q, v)
    wanted = one.energies(jnp.asarray(x), jnp.asarray(rate))
    assert result == jd.RESULTS.successful
    np.testing.assert_allclose(kinetic, wanted[0], rtol=1e-12)
    # Heights count from another place in the scene where bars do not start at the hinges of the ground.
    moved = x + 0.05
    change = jd.potential_energy(system, jnp.asarray(one.start(moved, rate)[0])) - potential
    np.testing.assert_allclose(change, one.energies(jnp.asarray(moved), jnp.asarray(rate))[1] - wanted[1], atol=1e-11)
    rates = jnp.asarray(rate), one.acceleration()(x, rate)
    change = jax.jvp(lambda x, rate: one.start(x, rate)[1], (jnp.asarray(x), jnp.asarray(rate)), rates)[1]
    assert_close(acceleration, change, 1e-10)


def test_the_height_of_sarrus_linkage_by_hand():
    """The equation of the docstring, written out, against the acceleration of the scene at several heights."""
    lengths, (bar, platform) = np.array([0.9, 0.7]), (0.6, 1.7)
    scene = jd.scenes.sarrus(lengths=lengths, masses=(bar, platform), radius=0.4, turn=2.0)

    @quick
    @jax.vmap
    def compute(q, v):
        a = jd.constrained_dynamics(scene, q, v).acceleration
        height = lambda q: 2 * lengths[0] * jnp.sin(q[0])  # noqa: E731
        rate = lambda q, v: jax.jvp(height, (q,), (v,))[1]  # noqa: E731
        place = jd.frame_pose(scene.system, q, "platform")
        return height(q), rate(q, v), jax.jvp(rate, (q, v), (v, a))[1], place

    starts = [
        jd.scenes.sarrus.start(lengths=lengths, height=z, rate=w) for z, w in ((0.4, 1.0), (1.1, -0.7), (1.3, 0.2))
    ]
    heights, rates, accelerations, places = compute(*(jnp.stack(x) for x in zip(*starts, strict=True)))
    for z, w, a, place in zip(heights, rates, accelerations, places, strict=True):
        cosines = 1 - z**2 / (4 * lengths**2)
        moved = platform + bar * np.sum(1 / 2 + 1 / (6 * cosines))
        slope = bar * np.sum(z / (12 * lengths**2 * cosines**2))
        np.testing.assert_allclose(a, -(slope * w**2 / 2 + (platform + 2 * bar) * 9.81) / moved, rtol=1e-10)
        # It rises along the vertical and does not turn.
        np.testing.assert_allclose(place, [[1, 0, 0, 0.4], [0, 0, -1, 0], [0, 1, 0, z], [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.slow
def test_closures_of_goldberg_and_bricard():
    """Formulas of the literature hold along motions that know nothing of them."""
    times = np.linspace(0.0, 0.6, 4)
    q, v = jd.scenes.bricard.start(angle=0.5)
    q = np.asarray(jd.simulate(jd.scenes.bricard(), q, v, times, stepsize=within(1e-11)).q)
    np.testing.assert_allclose(q[:, [2, 4, 3]], q[:, [0, 0, 1]], atol=1e-10)
    c, s, (one, two) = np.cos(1.2), np.sin(1.2), q.T[:2]
    closure = c**2 + s**2 * (np.cos(one) + np.cos(two)) + (1 + c**2) * np.cos(one) * np.cos(two)
    np.testing.assert_allclose(closure - 2 * c * np.sin(one) * np.sin(two), 0, atol=1e-10)
    q, v = jd.scenes.goldberg.start(angle=0.9)
    q = np.asarray(jd.simulate(jd.scenes.goldberg(), q, v, times, stepsize=within(1e-11)).q)
    tangents = np.tan(q / 2)
    constant = np.stack([tangents[:, 0] * tangents[:, 1], tangents[:, 2] / tangents[:, 0]], 1)
    np.testing.assert_allclose(constant, np.broadcast_to(constant[0], constant.shape), rtol=1e-10)
    np.testing.assert_allclose(np.cos(q[:, 3] + q[:, 0] + q[:, 1]), -1, atol=1e-12)


@pytest.mark.long
@chosen("goldberg")
def test_motion_in_minimal_coordinates(name):
    """All coordinates at several times, closed loops and energy, with the steps of a mechanism whose rows are independent."""
    one, times = mechanism(name), np.linspace(0.0, mechanism(name).span, 4)
    q, v = begin(one)
    exact = one.states(one.minimal(times, 1e-13)[0])
    outputs = ("energy", "constraint_residual")
    motion = jd.simulate(one.scene, q, v, times, stepsize=within(1e-12), outputs=outputs)
    assert bool(motion.success) and float(motion.constraint_residual.max()) < 1e-12
    assert distance(motion.q, exact[0]) < 1e-10
    # Between steps velocities are interpolated.
    np.testing.assert_allclose(motion.v, exact[1], rtol=0, atol=1e-9 * (1 + np.abs(exact[1]).max()))
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=0, atol=1e-9 * (1 + np.abs(motion.energy[0])))
    steps = int(motion.stats["num_accepted_steps"])
    assert steps <= 1.5 * one.minimal(times, 1e-12)[1] + 1


@chosen()
def test_fixed_steps_converge_with_their_order(name):
    one = mechanism(name)
    q, v = begin(one)
    times = np.array([0.0, one.span])
    exact = one.states(one.minimal(times, 1e-13)[0])[0][-1]
    errors = []
    for count in (40, 80):
        motion = jd.simulate(one.scene, q, v, times, stepsize=one.span / count, solver=jd.solvers.RK4())
        errors.append(distance(motion.q[-1], exact))
    # Bennett's coarse steps come nearer to where the kept rows would lose rank than the fine ones, which have other rows by then.
    assert 3.8 < np.log2(errors[0] / errors[1]) < (5.0 if name == "bennett" else 4.2)
    fine = jd.simulate(one.scene, q, v, times, stepsize=one.span / 40, solver=diffrax.Dopri8())
    assert distance(fine.q[-1], exact) < 1e-11


@chosen()
def test_gradients(name):
    """By the size of the start's velocity and a mass: both modes against differences of fourth order, with traced starts."""
    one = mechanism(name)
    q, v = (jnp.asarray(x) for x in begin(one))
    weights = jnp.asarray(np.random.default_rng(1).uniform(0.5, 1.5, 2 * one.scene.nv))
    times = jnp.asarray([0.0, one.span / 2])

    def end(factors, adjoint="reverse"):
        inertias = one.scene.system.inertias
        heavier = jnp.concatenate([factors[1:2], jnp.ones((inertias.shape[0] - 1,))])
        scene = jd.Scene(one.scene.system.replace(inertias=inertias * heavier[:, None]), one.scene.constraints)
        motion = jd.simulate(scene, q, factors[0] * v, times, stepsize=within(1e-11), adjoint=adjoint)
        return weights @ jnp.concatenate([motion.q[-1], motion.v[-1]])

    step, ones = 1e-3, jnp.ones(2)
    moves = step * np.array([[-2, 0], [-1, 0], [1, 0], [2, 0], [0, -2], [0, -1], [0, 1], [0, 2]])
    values = np.asarray(jax.jit(jax.vmap(end))(1 + moves)).reshape(2, 4)
    differences = values @ np.array([1, -8, 8, -1]) / (12 * step)
    reverse = jax.jit(jax.grad(end))(ones)
    forward = jax.jit(jax.jacfwd(lambda factors: end(factors, "forward")))(ones)
    np.testing.assert_allclose(reverse, differences, rtol=1e-6, atol=1e-6 * np.abs(differences).max())
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-8 * np.abs(differences).max())


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-8])
def test_rows_that_lose_rank_on_the_way_are_exchanged(tolerance):
    """Four of five rows of Bricard's linkage lose rank where its even angles pass zero, at 0.82 s, but not all five."""
    scene, times = jd.scenes.bricard(), np.array([0.0, 1.0])
    q, v = jd.scenes.bricard.start(branch=-1)
    motion = jd.simulate(scene, q, v, times, stepsize=within(tolerance), outputs=("energy",), throw=False)
    assert bool(motion.success)
    assert int(motion.stats["num_steps"]) < 20 and np.ptp(motion.energy) < 1e3 * tolerance


@pytest.mark.slow
def test_gradients_go_through_a_flat_position():
    """Sarrus' linkage falls through its flat position: the energy at the end changes with the rate as that of the start."""
    scene, (q, v) = jd.scenes.sarrus(), jd.scenes.sarrus.start(rate=-1.0)

    def end(scale):
        steps = jd.simulation.Steps(rtol=1e-11, atol=1e-11)
        motion = jd.simulate(scene, q, scale * v, np.array([0.0, 1.0]), stepsize=steps, outputs=("energy",))
        return motion.energy[-1]

    start = jd.kinetic_energy(scene.system, q, v)
    np.testing.assert_allclose(jax.jit(jax.grad(end))(1.0), 2 * start, rtol=1e-5)  # the passage costs digits


def test_numbers_that_make_no_mechanism():
    for match, call in (
        ("length b must", lambda: jd.scenes.goldberg(lengths=(1.0, 1.0, 0.5))),
        ("no Bennett linkage", lambda: jd.scenes.goldberg.start(lengths=(1.0, 2.0, 0.5))),
        ("does not close", lambda: jd.scenes.bricard.start(angle=3.0)),
        (r"length 0\.8 reach", lambda: jd.scenes.sarrus.start(height=1.7)),
        ("do not close", lambda: jd.scenes.hinge_platform.start(point=(3.0, 0.0))),
    ):
        with pytest.raises(ValueError, match=match):
            call()
