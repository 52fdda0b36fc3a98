"""Mechanisms with loops, rolling and grasps, identified from logs of a few joints; a tossed cube from its flight."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.cli import main
from jaxdyn.identify.linear_fit import fit_mechanism
from jaxdyn.identify.mechanisms import on_constraints
from jaxdyn.identify.result import Segments, simulate_segment

T = np.linspace(0.0, 1.0, 41)


def moved(scene, q0, v0, motors, size=2.0):
    """A motion under smooth torques of some motors, much finer than the fits', and these torques."""
    tau = np.zeros((len(T), scene.nv))
    for k, i in enumerate(motors):
        tau[:, i] = size * np.sin((3.0 + 1.3 * k) * T + 0.7 * k)
    control = jd.identify.SampledTorque(jnp.asarray(T), jnp.asarray(tau))
    motion = jd.simulate(
        scene, q0, v0, jnp.asarray(T), control=control, stepsize=jd.simulation.Steps(rtol=1e-10, atol=1e-10)
    )
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
    assert fit.result == jd.RESULTS.successful and np.isfinite(fit.deviation).all()


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
    assert fit.result == jd.RESULTS.successful and (fit.deviation < 1e-3).all()


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
    run = jax.jit(
        jax.vmap(
            lambda q, v: jd.simulate(true, q, v, jnp.asarray(t), stepsize=jd.simulation.Steps(rtol=1e-10, atol=1e-12))
        )
    )
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
    assert bool(short.result == jd.RESULTS.not_nearest)
    one = Segments(jnp.arange(2.0), jnp.stack([q, q]), jnp.stack([v, v]), jnp.zeros((2, 2)))
    motion, _ = jax.jit(lambda one: simulate_segment(scene, one, None, "linear", {}, observed=(0, 1)))(one)
    assert np.isnan(motion).all()
    monkeypatch.undo()
    fixed, zero = slides(lambda q, t: q[:1]), np.zeros(2)
    with pytest.raises(ValueError, match="do not determine the mechanism's state at sample 1"):
        jd.identify.complete_log(fixed, [0.0, 0.1], {"x": (zero, np.array([0.0, 1.0]))}, np.zeros((2, 2)), zero)


# --- torques of motors ------------------------------------------------------------------------------------------------

FOUR_BAR = """<mujoco model="four-bar"><compiler angle="radian"/><worldbody>
<body name="crank"><joint name="j1" axis="0 1 0"/>
  <inertial pos="0.1 0.01 0.03" mass="1.2" diaginertia="0.02 0.03 0.025"/>
  <body name="coupler" pos="0.25 0 0"><joint name="j2" axis="0 1 0"/>
    <inertial pos="0.3 0 0.02" mass="{a}" diaginertia="0.03 0.05 0.045"/></body></body>
<body name="rocker" pos="0.6 0 -0.1"><joint name="j3" axis="0 1 0" stiffness="1.5"/>
  <inertial pos="0 0 0.25" mass="{b}" diaginertia="0.04 0.04 0.02"/></body>
</worldbody><equality><connect body1="coupler" body2="rocker" anchor="0.45 0 0.3"/></equality></mujoco>"""
FIVE_BAR = """<mujoco model="five-bar"><compiler angle="radian"/><worldbody>
<body name="left"><joint name="m1" axis="0 1 0"/>
  <inertial pos="0.02 0 0.1" mass="1.2" diaginertia="0.02 0.03 0.025"/>
  <body name="forearm" pos="-0.1 0 0.25"><joint name="p1" axis="0 1 0"/>
    <inertial pos="0.1 0 0.1" mass="{a}" diaginertia="0.03 0.05 0.045"/></body></body>
<body name="right" pos="0.3 0 0"><joint name="m2" axis="0 1 0"/>
  <inertial pos="0.02 0.01 0.12" mass="1.1" diaginertia="0.02 0.03 0.025"/>
  <body name="shin" pos="0.1 0 0.25"><joint name="p2" axis="0 1 0"/>
    <inertial pos="-0.1 0 0.1" mass="{b}" diaginertia="0.03 0.05 0.045"/></body></body>
</worldbody><equality><connect body1="forearm" body2="shin" anchor="0.25 0 0.3"/></equality></mujoco>"""
LOOPS = {"four-bar": (FOUR_BAR, ("j1",)), "five-bar": (FIVE_BAR, ("m1", "m2"))}
TERMS = ("viscous", "offset", "armature")


def driven(scene, motors, t, viscous=0.3, offset=0.2, rotor=0.05):
    """Log of a smooth motion, with the torques of the motors that constrained forward dynamics needs for it.

    The accelerations are affine in the torques of the motors: as many linear equations as motors in every sample.
    """
    phase = np.arange(len(motors))[None] * 1.1
    w = np.array([1.7, 3.1])[:, None, None]
    size, at = np.array([0.4, 0.2])[:, None, None], w * t[None, :, None] + phase[None]
    q = np.sum(size * (np.sin(at) - np.sin(phase)), 0)
    v, a = np.sum(size * w * np.cos(at), 0), np.sum(-size * w**2 * np.sin(at), 0)
    measured = {name: (q[:, i], v[:, i], a[:, i]) for i, name in enumerate(motors)}
    start = scene.starts["reference"].q
    log = jd.identify.complete_log(scene, t, measured, np.zeros((len(t), scene.nv)), start)
    own = [scene.system.v_index(name) for name in motors]
    dynamics = jax.jit(jax.vmap(lambda q, v, tau: jd.constrained_dynamics(scene, q, v, tau).acceleration))
    free = np.asarray(dynamics(log.q, log.v, log.tau))
    unit = [np.asarray(dynamics(log.q, log.v, log.tau + np.eye(scene.nv)[i])) - free for i in own]
    tau = np.linalg.solve(np.stack(unit, axis=2)[:, own], (a - free[:, own])[..., None])[..., 0]
    reached = free + np.einsum("nij,nj->ni", np.stack(unit, axis=2), tau)
    np.testing.assert_allclose(log.a, reached, atol=1e-10)  # of the passive joints too
    full = np.zeros((len(t), scene.nv))
    full[:, own] = tau + viscous * v + offset + rotor * a
    return jd.identify.Log(t, log.q, log.v, log.a, full), q, tau + viscous * v + offset + rotor * a


def loaded(tmp_path, name, masses):
    path = tmp_path / f"{name}-{masses[0]}.xml"
    path.write_text(LOOPS[name][0].format(a=masses[0], b=masses[1]))
    return jd.load(path)


@pytest.mark.long
@pytest.mark.parametrize("name", ["four-bar", pytest.param("five-bar", marks=pytest.mark.slow)])
def test_base_parameters_of_a_mechanism_from_its_motors(tmp_path, name):
    """Those of the true mechanism, without noise; the truth is forward dynamics with multipliers, which knows no basis."""
    true, wrong, motors = loaded(tmp_path, name, (0.9, 1.5)), loaded(tmp_path, name, (1.1, 1.2)), LOOPS[name][1]
    log, *_ = driven(true, motors, np.linspace(0, 8, 400))
    result = fit_mechanism(wrong, log, motors, TERMS)
    friction = np.repeat([0.3, 0.2, 0.05], len(motors))
    truth = result.base.values(np.concatenate([np.asarray(true.system.inertias).reshape(-1), friction]))
    # The least noise of a fit is a millionth of the torque; directions are weaker than the strongest by up to 600.
    np.testing.assert_allclose(result.values, truth, rtol=1e-8, atol=1e-9)
    assert np.abs(result.nominal - truth).max() > 1e-2
    assert result.fit.result == jd.RESULTS.successful and len(result.fit.history) < 60
    np.testing.assert_allclose(result.fit.torques(log), log.tau, atol=1e-8)
    # A planar mechanism: of every body the first moments in the plane and one moment of inertia at most.
    assert len(result.base) <= 3 * true.system.nb + 3 * len(motors)


@pytest.mark.slow
def test_intervals_of_a_mechanism_cover_the_truth(tmp_path):
    """Over 40 logs with noise of encoder (1e-5 rad) and torque (0.01 N m), for every combination by itself."""
    true, wrong = loaded(tmp_path, "four-bar", (0.9, 1.5)), loaded(tmp_path, "four-bar", (1.1, 1.2))
    t, rng, errors, stds = np.linspace(0, 10, 1001), np.random.default_rng(0), [], []
    full, q, tau = driven(true, ("j1",), t)
    for _ in range(40):
        noisy = [x + size * rng.normal(size=x.shape) for x, size in ((q, 1e-5), (tau, 0.01))]
        raw = jd.identify.from_raw(t, *noisy, cutoff=8.0, trim=40, every=4)
        torque = np.pad(raw.tau, ((0, 0), (0, 2)))
        motion = {"j1": (raw.q[:, 0], raw.v[:, 0], raw.a[:, 0])}
        log = jd.identify.complete_log(wrong, raw.t, motion, torque, full.q[40])
        fit = fit_mechanism(wrong, log, ("j1",), TERMS)
        truth = np.concatenate([np.asarray(true.system.inertias).reshape(-1), [0.3, 0.2, 0.05]])
        errors.append(fit.values - fit.base.values(truth))
        stds.append(fit.std)
    # Errors of the combinations of one log are correlated, logs are independent: the binomial distribution holds for each
    # combination. Of 40 intervals of 95 %, fewer than 31 cover with a probability below 1e-4, and in any of ten below 1e-3.
    assert np.sum(np.abs(errors) < fit.factor * np.array(stds), axis=0).min() >= 31
    # Nor are they wide without limit. Groups with much of the information make a jackknife err to that side (`uncertainty`):
    # here by up to 1.7.
    assert np.max(np.mean(stds, axis=0) / np.std(errors, axis=0)) < 2


@pytest.mark.long
def test_logs_that_contradict_a_mechanism_are_named(tmp_path):
    """Open loops, velocities that these do not allow, and motors without a torque."""
    scene, motors = loaded(tmp_path, "five-bar", (1.1, 1.2)), LOOPS["five-bar"][1]
    log, *_ = driven(scene, motors, np.linspace(0, 8, 60))
    passive = scene.system.v_index("p1")

    def changed(**signals):
        values = {name: getattr(log, name) for name in ("t", "q", "v", "a", "tau")} | signals
        return jd.identify.Log(**values)

    for name, words in (("q", "loops are open by up to 0.0"), ("v", r"velocities are off by \d\d %")):
        wrong = np.array(getattr(log, name))
        wrong[:, passive] *= 1.3
        with pytest.warns(jd.identify.LogWarning, match=words):
            fit_mechanism(scene, changed(**{name: wrong}), motors, TERMS)
    with pytest.raises(ValueError, match="torques of the motors m1, m2 are all zero"):
        fit_mechanism(scene, changed(tau=0 * log.tau), motors, TERMS)
    alone = np.where(np.arange(scene.nv) == scene.system.v_index("m1"), log.tau, 0)
    assert np.isfinite(fit_mechanism(scene, changed(tau=alone), motors, TERMS).values).all()


def test_motors_must_be_as_many_as_degrees_of_freedom(tmp_path):
    scene = loaded(tmp_path, "five-bar", (0.9, 1.5))
    log, *_ = driven(scene, ("m1", "m2"), np.linspace(0, 1, 11))
    with pytest.raises(ValueError, match="2 degrees of freedom"):
        fit_mechanism(scene, log, ("m1",))
    with pytest.raises(ValueError, match="name the motors"):
        jd.identify.fit_parameters(
            scene, log, jd.identify.Parameters(scene).inertias(), jd.identify.Objective("torque")
        )


@pytest.mark.long
def test_the_command_identifies_a_mechanism_from_a_log_of_its_motor(tmp_path, capsys):
    true, _ = loaded(tmp_path, "four-bar", (0.9, 1.5)), loaded(tmp_path, "four-bar", (1.1, 1.2))
    t = np.linspace(0, 10, 1001)
    _, q, tau = driven(true, ("j1",), t)
    path, report = tmp_path / "motor.csv", tmp_path / "fit.json"
    rows = np.column_stack([t, q[:, 0], tau[:, 0]])
    np.savetxt(path, rows, delimiter=",", header="t,q_j1,tau_j1", comments="", fmt="%.17g")
    command = ["identify", "--urdf", str(tmp_path / "four-bar-1.1.xml"), "--log", str(path), "--terms", *TERMS]
    main([*command, "--cutoff", "20", "--report", str(report)])
    printed = capsys.readouterr().out
    assert "the motors' torques determine 10 combinations" in printed and len(printed.splitlines()) < 60
    found = json.loads(report.read_text())
    # The low-pass of a nonlinear mechanism's motion and torque is not quite that of its model.
    assert max(found["test_percent"].values()) < 0.1 and found["outcome"] == "successful"
    assert main([*command, "--out", str(tmp_path / "fitted.urdf")]) != 0
    assert "--out: not for a mechanism" in capsys.readouterr().err


@pytest.mark.long
def test_an_exciting_motion_of_the_motors_of_a_five_bar(tmp_path):
    """Within all limits, passive joints included; loops close along it, and the rest of the motion is that of `complete_log`."""
    scene, motors = loaded(tmp_path, "five-bar", (0.9, 1.5)), ("m1", "m2")
    start = scene.starts["reference"].q
    options = dict(period=6.0, harmonics=3, starts=2, torque=30.0, velocity=(1.5, 2.0))
    found = jd.identify.exciting_motion(scene, TERMS, motors=motors, guess=start, steps=25, **options)
    assert found.logdet > 1 and found.condition < found.start_condition
    assert max(found.used.values()) <= 1 and set(found.used) == {"position", "velocity", "torque"}
    log, whole = found.log(), found.log(whole=True)
    assert log.joint_names == motors and log.tau.shape == (601, 2) and whole.q.shape == (601, 4)
    assert np.abs(log.v).max(axis=0)[0] <= 0.9 * 1.5 * (1 + 1e-6) and np.abs(log.tau).max() <= 27.0 * (1 + 1e-6)
    assert np.abs(log.v[0]).max() < 1e-10  # starts at rest
    closed = jax.jit(jax.vmap(lambda q: jd.constraints.position_residual(scene, q)))(whole.q)
    np.testing.assert_allclose(closed, 0.0, atol=1e-12)
    measured = {name: (log.q[:, i], log.v[:, i], log.a[:, i]) for i, name in enumerate(motors)}
    completed = jd.identify.complete_log(scene, log.t, measured, whole.tau, whole.q[0])
    for name in ("q", "v", "a"):
        np.testing.assert_allclose(getattr(completed, name), getattr(whole, name), atol=1e-9)
    # The torques of the motors: those for which constrained forward dynamics gives the accelerations.
    dynamics = jax.jit(jax.vmap(lambda q, v, tau: jd.constrained_dynamics(scene, q, v, tau).acceleration))
    np.testing.assert_allclose(dynamics(whole.q, whole.v, whole.tau), whole.a, atol=1e-9)
    refused = {"name as many of its joints in motors": {}, "2 degrees of freedom": {"motors": ("m1",)}}
    for message, arguments in refused.items():
        with pytest.raises(ValueError, match=message):
            jd.identify.exciting_motion(scene, TERMS, guess=start, **options, **arguments)


ROUNDED_FOUR_BAR = """<robot name="four-bar"><link name="base"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><origin rpy="1.5708 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.3 0 0" rpy="-1.5708 0 0"/>
<axis xyz="0 -1 0"/><limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
<joint name="j3" type="revolute"><parent link="base"/><child link="c"/><origin xyz="0.8 0 0"/><axis xyz="0 -1 0"/>
<limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
<gazebo><joint name="pin" type="revolute"><parent>c</parent><child>b</child><pose>0.5 0 0.4 0 0 0</pose>
<axis><xyz>0 1 0</xyz></axis></joint></gazebo>"""


@pytest.mark.long
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_exciting_motions_of_rounded_files_and_in_float32_use_the_limits(tmp_path, dtype):
    """Redundant rows that rounding leaves open, and gaps by the rounding of float32, stop no motion."""
    links = "".join(
        f'<link name="{name}"><inertial><origin xyz="0.1 0.01 0.05"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name, mass in zip("abc", (1.1, 2.2, 1.3), strict=True)
    )
    (tmp_path / "four_bar.urdf").write_text(f"{ROUNDED_FOUR_BAR}{links}</robot>")
    scene = jd.load(tmp_path / "four_bar.urdf", dtype=dtype)
    # The command passes its numbers as lists.
    options = dict(motors=["j1"], velocity=[1.0], torque=[100.0], steps=2, starts=1, harmonics=2)
    found = jd.identify.exciting_motion(scene, ("viscous",), **options)
    assert 0.5 < found.used["velocity"] <= 1
    if dtype == jnp.float64:
        whole = found.log(whole=True)
        # The least squares of all rows, redundant ones too, would miss by the rounding of the file, 4e-6.
        dynamics = jax.jit(jax.vmap(lambda q, v, tau: jd.constrained_dynamics(scene, q, v, tau).acceleration))
        np.testing.assert_allclose(dynamics(whole.q, whole.v, whole.tau), whole.a, atol=1e-10)


def test_the_command_excites_a_mechanism_by_named_motors_alone(tmp_path, capsys):
    loaded(tmp_path, "four-bar", (0.9, 1.5))
    assert main(["excite", str(tmp_path / "four-bar-0.9.xml")]) != 0
    assert "has loops; name the joints that are driven in --motors, of j1, j2, j3" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_writes_what_identify_reads(tmp_path, capsys):
    """An exciting motion of a motor, and the combinations that its own torques determine: those of the file."""
    loaded(tmp_path, "four-bar", (0.9, 1.5))
    file, log = str(tmp_path / "four-bar-0.9.xml"), str(tmp_path / "motion.csv")
    options = ["--period", "6", "--harmonics", "3", "--steps", "20", "--torque", "30", "--terms", *TERMS]
    main(["excite", file, "--motors", "j1", "--out", log, "--plot", str(tmp_path / "motion.png"), *options])
    printed = capsys.readouterr().out
    assert "limits used" in printed and "j1" in printed and "j2" not in printed
    main(["identify", "--urdf", file, "--log", log, "--report", str(tmp_path / "fit.json"), "--terms", *TERMS])
    found = json.loads((tmp_path / "fit.json").read_text())
    assert max(found["test_percent"].values()) < 1e-3
    base = found["base_parameters"]
    # A rotor adds to the crank's moment of inertia, and the start of a fit has one.
    bodies = [k for k, name in enumerate(base["expressions"]) if not name.startswith(("j1", "crank.Iyy"))]
    np.testing.assert_allclose(np.array(base["fitted"])[bodies], np.array(base["nominal"])[bodies], atol=1e-8)
