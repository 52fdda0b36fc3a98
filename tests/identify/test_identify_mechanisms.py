"""Mechanisms with loops, rolling and grasps, identified from logs of a few joints; a tossed cube from its flight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.mechanisms import on_constraints
from jaxdyn.identify.replay import Segments, simulate_segment

T = np.linspace(0.0, 1.0, 41)


def moved(scene, q0, v0, motors, size=2.0):
    """A motion under smooth torques of some motors, much finer than the fits', and these torques."""
    tau = np.zeros((len(T), scene.nv))
    for k, i in enumerate(motors):
        tau[:, i] = size * np.sin((3.0 + 1.3 * k) * T + 0.7 * k)
    control = jd.identify.SampledTorque(jnp.asarray(T), jnp.asarray(tau))
    motion = jd.simulate(scene, q0, v0, jnp.asarray(T), control=control, rtol=1e-10, atol=1e-10)
    return np.asarray(motion.q), np.asarray(motion.v), tau


@pytest.mark.slow
def test_a_four_bar_is_completed_from_its_crank():
    scene = jd.scenes.four_bar()
    q, v, tau = moved(scene, *jd.scenes.four_bar.start(), (0,), size=20.0)
    log = jd.identify.complete_log(scene, T, {"1": (q[:, 0], v[:, 0])}, tau, q[0] + np.array([0.0, 0.1, -0.1]))
    np.testing.assert_allclose(log.q, q, atol=1e-8)
    np.testing.assert_allclose(log.v, v, atol=1e-7)
    with pytest.raises(ValueError, match="cannot be assembled at sample 3"):
        closed = q[:, 0].copy()
        closed[3:] = np.nan
        jd.identify.complete_log(scene, T, {"1": (closed, v[:, 0])}, tau, q[0])
    with pytest.raises(ValueError, match="scene has no constraints"):
        jd.identify.complete_log(scene.system, T, {"1": (q[:, 0], v[:, 0])}, tau, q[0])


def computed(scene, log, parameters, observed):
    objective = jd.identify.Objective(horizon=20, substeps=2, observed=observed)
    return jd.identify.fit_parameters(scene, log, parameters, objective, jd.identify.Solver(tolerance=1e-8, steps=15))


@pytest.mark.long
def test_energy_tells_the_coupler_of_a_four_bar():
    """Its mass by the balance of energy, which constraints do not enter, from the crank alone."""
    q0, v0 = jd.scenes.four_bar.start()
    q, v, tau = moved(jd.scenes.four_bar(), q0, v0, (0,), size=20.0)
    wrong = jd.scenes.four_bar(masses=(1.0, 2.0, 2.5))
    log = jd.identify.complete_log(wrong, T, {"1": (q[:, 0], v[:, 0])}, tau, q[0])
    tree = jd.identify.Parameters(wrong).inertias(["coupler"], shape="mass", metric=None)
    fit = jd.identify.fit_parameters(wrong, log, tree, objective=jd.identify.Objective("energy", horizon=10))
    # The trapezoidal rule over 25 ms.
    np.testing.assert_allclose(fit.system.system.inertias[1, 0], 3.0, rtol=2e-2)


@pytest.mark.slow
def test_a_four_bar_by_its_crank_alone():
    q0, v0 = jd.scenes.four_bar.start()
    q, v, tau = moved(jd.scenes.four_bar(), q0, v0, (0,), size=20.0)
    wrong = jd.scenes.four_bar(masses=(1.0, 2.0, 2.5))
    log = jd.identify.complete_log(wrong, T, {"1": (q[:, 0], v[:, 0])}, tau, q[0])
    tree = jd.identify.Parameters(wrong).inertias(["coupler"], shape="mass", metric=None)
    fit = computed(wrong, log, tree, ["1"])
    np.testing.assert_allclose(fit.system.system.inertias[1, 0], 3.0, rtol=1e-5)
    assert fit.result == RESULTS.successful and np.isfinite(fit.deviation).all()


@pytest.mark.slow
def test_link_lengths_of_a_four_bar_by_two_encoders():
    """Coupler and rocker of a linkage whose crank and rocker are measured: each length is in a joint, a body and the loop."""
    q0, v0 = jd.scenes.four_bar.start()
    q, v, tau = moved(jd.scenes.four_bar(), q0, v0, (0,), size=20.0)
    links = jd.identify.Construction(
        lambda numbers: jd.scenes.four_bar(lengths=(1.0, *numbers["lengths"], 3.5)), {"lengths": jnp.array([2.9, 2.6])}
    )
    measured = {"1": (q[:, 0], v[:, 0]), "3": (q[:, 2], v[:, 2])}
    log = jd.identify.complete_log(links.scene, T, measured, tau, q[0])
    # What was measured is not moved onto the constraints of wrong lengths.
    np.testing.assert_array_equal(log.q[:, [0, 2]], q[:, [0, 2]])
    np.testing.assert_array_equal(log.v[:, [0, 2]], v[:, [0, 2]])
    tree = jd.identify.Parameters(links).positive(lambda links: links.numbers["lengths"])
    fit = computed(links, log, tree, ["1", "3"])
    np.testing.assert_allclose(fit.values, [3.0, 2.5], rtol=1e-5)
    assert fit.result == RESULTS.successful and (fit.deviation < 1e-3).all()


@pytest.mark.slow
def test_a_redundant_manipulator_by_its_base_joints():
    """Six motors, two freedoms; measured are the three joints at the bases, one more than the freedoms."""
    q0, v0 = jd.scenes.parallel_manipulator.start()
    q, v, tau = moved(jd.scenes.parallel_manipulator(), q0, v0, (0, 2, 4))
    wrong = jd.scenes.parallel_manipulator(mass=0.8)
    measured = {name: (q[:, i], v[:, i]) for name, i in (("a1", 0), ("b1", 2), ("c1", 4))}
    log = jd.identify.complete_log(wrong, T, measured, tau, q[0])
    np.testing.assert_allclose(log.q, q, atol=1e-6)
    tree = jd.identify.Parameters(wrong).inertias(shape="mass", metric=None)
    fit = computed(wrong, log, tree, ["a1", "b1", "c1"])
    # Which masses make the same motion the log leaves open; it is that of equal ones of 1 kg.
    before = jd.identify.parameter_error(wrong, log, objective=jd.identify.Objective(horizon=20, substeps=2))
    after = jd.identify.parameter_error(fit.system, log, objective=jd.identify.Objective(horizon=20, substeps=2))
    assert after < 1e-3 * before


@pytest.mark.slow
def test_a_rolling_disk_by_its_two_angles():
    """Heading and roll are measured; the place on the plane follows, and its error is not compared."""
    true = jd.scenes.rolling_disk()
    q, v, tau = moved(true, *jd.scenes.rolling_disk.start(), (2, 3), size=0.5)
    wrong = jd.scenes.rolling_disk(steer_inertia=0.2, roll_inertia=0.1)
    guess = q[0] * np.array([0.0, 0.0, 1.0, 1.0])
    log = jd.identify.complete_log(wrong, T, {2: (q[:, 2], v[:, 2]), 3: (q[:, 3], v[:, 3])}, tau, guess)
    parameters = jd.identify.Parameters(wrong).positive(
        lambda s: [s.system.parameters["steer"], s.system.parameters["roll"]]
    )
    fit = computed(wrong, log, parameters, [2, 3])
    np.testing.assert_allclose(fit.values, [0.125, 0.25], rtol=1e-6)


@pytest.mark.slow
def test_a_hand_by_its_fingers_alone():
    """The mass of a bar that two fingers hold, from their joints."""
    true = jd.scenes.hand_with_bar(mu=None, gravity=0.0)
    q0, v0 = jd.scenes.hand_with_bar.start(velocity=(0.0, 0.0, 0.0))
    q, v, tau = moved(true, q0, v0, (0, 1, 2, 3), size=0.05)
    wrong = jd.scenes.hand_with_bar(mu=None, gravity=0.0, mass=0.3)
    names = ("finger1_1_joint", "finger1_2_joint", "finger2_1_joint")
    log = jd.identify.complete_log(wrong, T, {name: (q[:, i], v[:, i]) for i, name in enumerate(names)}, tau, q[0])
    np.testing.assert_allclose(log.q, q, atol=1e-7)
    tree = jd.identify.Parameters(wrong).inertias(["bar"], shape="mass", metric=None)
    fit = computed(wrong, log, tree, names)
    np.testing.assert_allclose(fit.system.system.inertias[-1, 0], 0.5, rtol=1e-4)


@pytest.mark.slow
def test_a_toss_tells_gravity_and_ratios_of_inertia():
    """A simulated cube with measured poses; mass and size of the inertia are not told, ratios are."""
    from benchmarks.identify_cube import MASS, ratios

    t = np.arange(13) / 148.0
    builder = jd.ModelBuilder("box", gravity=(0.0, 0.0, -9.81))
    true = builder.add_body("cube", None, "free", jd.inertia.box(MASS, (0.12, 0.1, 0.08))).build()
    logs, rng = [], np.random.default_rng(0)
    run = jax.jit(jax.vmap(lambda q, v: jd.simulate(true, q, v, jnp.asarray(t), rtol=1e-10, atol=1e-12)))
    quaternions = rng.normal(size=(6, 4))
    q0 = np.concatenate([rng.normal(size=(6, 3)), quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)], 1)
    motion = run(jnp.asarray(q0), jnp.asarray(rng.normal(size=(6, 6)) * np.array([1.0] * 3 + [8.0] * 3)))
    for q, v in zip(np.asarray(motion.q), np.asarray(motion.v), strict=True):
        logs.append(jd.identify.Log(t, q, v, None, np.zeros((13, 6))))
    start = jd.ModelBuilder("box", gravity=(0.0, 0.0, -9.0))
    start = start.add_body("cube", None, "free", jd.inertia.box(MASS, (0.13, 0.09, 0.11))).build()
    tree = jd.identify.Parameters(start).inertias(metric="affine", weight=1e-6, total=MASS).free(lambda m: m.gravity)
    fit = jd.identify.fit_parameters(
        start,
        logs,
        tree,
        objective=jd.identify.Objective(substeps=2, noise=1e-4),
        solver=jd.identify.Solver(tolerance=1e-12, steps=30),
    )
    np.testing.assert_allclose(fit.system.gravity, [0, 0, -9.81], atol=1e-4)
    np.testing.assert_allclose(
        ratios(np.asarray(fit.system.inertias[0])), ratios(np.asarray(true.inertias[0])), rtol=1e-3
    )
    np.testing.assert_allclose(fit.system.inertias[0, 0], MASS, rtol=1e-12)


def slides(phi):
    """Two bodies of 1 kg on slides along x and y, with one constraint between them."""
    builder = jd.ModelBuilder("slides")
    for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
        builder.add_body(name, None, "prismatic", (1.0, (0, 0, 0), (0.1, 0.1, 0.1)), axis=axis, joint_name=name)
    return jd.Scene(builder.build(), [jd.Holonomic(phi)])


def on_circle(q, t):
    return (q @ q - 1.0)[None]


@pytest.mark.long
def test_measured_joints_that_contradict_the_rows_are_said(monkeypatch):
    """The nearest point of a circle is on the radius; searches that stop early, and velocities that no row admits, say so."""
    scene, q, v = slides(on_circle), jnp.array([0.8, 0.9]), jnp.array([0.3, -0.1])
    state = on_constraints(scene, q, v, jnp.zeros(()), (0, 1))
    n = q / jnp.linalg.norm(q)
    np.testing.assert_allclose(state.q, n, atol=1e-10)
    np.testing.assert_allclose(state.v, v - n * (n @ v), atol=1e-10)
    monkeypatch.setattr("jaxdyn.identify.mechanisms._ITERATIONS", 1)
    short = on_constraints(scene, q, v, jnp.zeros(()), (0, 1))
    assert bool(short.result == RESULTS.not_nearest)
    one = Segments(jnp.arange(2.0), jnp.stack([q, q]), jnp.stack([v, v]), jnp.zeros((2, 2)))
    motion, _ = jax.jit(lambda one: simulate_segment(scene, one, None, "linear", {}, observed=(0, 1)))(one)
    assert np.isnan(motion).all()
    monkeypatch.undo()
    fixed, zero = slides(lambda q, t: q[:1]), np.zeros(2)
    with pytest.raises(ValueError, match="do not determine the mechanism's state at sample 1"):
        jd.identify.complete_log(fixed, [0.0, 0.1], {"x": (zero, np.array([0.0, 1.0]))}, np.zeros((2, 2)), zero)
