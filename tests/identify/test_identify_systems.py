"""Parameters of Lagrangians, metrics, immersions and forces found from logs, against what made the log and numpy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.tree_util import Partial

import jaxdyn as jd
from jaxdyn import identify, scenes
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.uncertainty import block_groups, effective_sample_size

G = 9.81
TRUE = dict(masses=(1.3, 0.7), length=1.1, reaches=(0.45, 0.4), moments=(0.09, 0.03))


def log_of(scene, q0, v0, t, tau, noise=0.0):
    """A motion under known torques, integrated far more finely than the fits do, with its accelerations."""
    control = identify.SampledTorque(t, tau)
    motion = jd.simulate(
        scene,
        q0,
        v0,
        t,
        control=control,
        stepsize=jd.simulation.Steps(rtol=1e-12, atol=1e-12),
        outputs=("acceleration",),
    )
    q, v, a = (np.asarray(x) for x in (motion.q, motion.v, motion.acceleration))
    off = noise * np.random.default_rng(1).normal(size=(3, *q.shape))
    return identify.Log(t, q + off[0], v + off[1], a + off[2], tau)


@pytest.fixture(scope="module")
def swung():
    """Two seconds of a double pendulum with torques at both hinges, 50 Hz."""
    t = jnp.linspace(0, 2, 101)
    tau = 3 * jnp.sin(jnp.asarray([[3.0, 5.0]]) * t[:, None] + jnp.asarray([[0.0, 1.0]]))
    q0, v0 = scenes.double_pendulum.start()
    return log_of(scenes.double_pendulum(**TRUE), q0, v0, t, tau)


def fit_exactly(system, log, **chosen):
    """Numbers by the error of torques, until no step lowers it."""
    objective, solver = identify.Objective("torque"), identify.Solver(tolerance=0.0)
    return identify.fit_parameters(system, log, None, objective, solver, **chosen)


def nominal(formulation="lagrangian"):
    """The double pendulum with wrong masses and moments."""
    return scenes.double_pendulum(formulation=formulation, **TRUE | dict(masses=(1.0, 1.0), moments=(0.2, 0.1))).system


def masses_and_moments(system):
    return [system.parameters["masses"], system.parameters["moments"]]


WANTED = (*TRUE["masses"], *TRUE["moments"])
NAMES = tuple(f"parameters['{key}'][{i}]" for key in ("masses", "moments") for i in (0, 1))


@pytest.mark.long
@pytest.mark.parametrize(
    ("error", "method"),
    [
        pytest.param("torque", "gauss-newton", marks=pytest.mark.slow),
        pytest.param("torque", "lbfgs", marks=pytest.mark.slow),
        ("trajectory", "gauss-newton"),
    ],
)
def test_parameters_of_a_lagrangian_are_recovered(swung, error, method):
    """Masses and moments of both links, which the motion determines with known lengths; and they stay positive."""
    lowest = []
    options = dict(horizon=20, substeps=4) if error == "trajectory" else {}
    fit = identify.fit_parameters(
        nominal(),
        swung,
        objective=identify.Objective(error, **options),
        solver=identify.Solver(method=method, tolerance=0.0),
        execution=identify.Execution(
            callback=lambda step, loss, system: lowest.append(
                min(map(float, jax.tree.leaves(masses_and_moments(system))))
            )
        ),
        positive=masses_and_moments,
    )
    # Tsit5 with 5 ms steps is that exact here.
    np.testing.assert_allclose(fit.values, WANTED, rtol=1e-8)
    np.testing.assert_allclose(jax.tree.leaves(masses_and_moments(fit.system)), WANTED, rtol=1e-8)
    assert fit.names == NAMES and fit.result == jd.RESULTS.successful
    assert min(lowest) > 0 and len(lowest) == len(fit.history)
    assert fit.deviation is None if method == "lbfgs" else np.all(fit.deviation < 1e-6)
    assert (
        fit.error(swung)
        < 1e-5
        < 1
        < identify.torque_error(
            jax.vmap(lambda q, v, a: jd.inverse_dynamics(nominal(), q, v, a))(swung.q, swung.v, swung.a),
            swung.tau,
        )
    )


def test_parameters_of_joined_bodies_are_recovered(swung):
    """Two separate bodies and the immersion that joins them: masses of the bodies, a length of the immersion."""
    system = scenes.double_pendulum(formulation="immersion", **TRUE).system
    chosen = lambda system: [system.units[0].parameters["mass"], system.units[1].parameters["mass"]]  # noqa: E731
    reach = lambda system: system.immersion.length  # noqa: E731
    wrong = eqx.tree_at(lambda s: [*chosen(s), reach(s)], system, [jnp.asarray(x) for x in (0.9, 1.4, 0.8)])
    fit = fit_exactly(wrong, swung, positive=lambda s: [*chosen(s), reach(s)])
    np.testing.assert_allclose(fit.values, [1.3, 0.7, 1.1], rtol=1e-8)
    assert fit.names == ("units[0].parameters['mass']", "units[1].parameters['mass']", "immersion.length")


def inertia(q, t, p):
    return p["inertia"][None, None]


def driven(q, v, t, p):
    """Spring, offset of either sign, and a drive with the log's own clock."""
    return p["stiffness"] * q - p["offset"] - p["drive"] * jnp.sin(3.0 * t)


LINEAR = {"inertia": 0.8, "stiffness": 5.0, "offset": -0.6, "drive": 0.9}


def oscillator(damping=0.3, **changes):
    system = jd.ExplicitSystem(inertia, driven, 1, parameters=LINEAR | changes)
    return jd.Scene(system, forces=(jd.forces.JointDamping(damping),))


@pytest.fixture(scope="module")
def oscillation():
    """Four seconds of the oscillator, the clock starting at 2 s."""
    t = jnp.linspace(2, 6, 81)
    return log_of(oscillator(), jnp.ones(1), jnp.zeros(1), t, jnp.sin(2 * t)[:, None])


@pytest.mark.long
def test_linear_parameters_and_their_deviations_are_those_of_least_squares(oscillation):
    """Equation error with noise, linear in what is fitted: numpy's solution and its covariance."""
    log, rng = oscillation, np.random.default_rng(3)
    noisy = identify.Log(log.t, log.q, log.v, log.a, np.asarray(log.tau) + 0.05 * rng.normal(size=log.tau.shape))
    start = oscillator(inertia=2.0, stiffness=1.0, offset=0.0, drive=2.0, damping=0.1)
    fit = fit_exactly(start, noisy, free=lambda s: [s.system.parameters, s.forces[0].coefficient])
    t, q, v, a, tau = (np.asarray(x).reshape(-1) for x in (noisy.t, noisy.q, noisy.v, noisy.a, noisy.tau))
    columns = {"drive": -np.sin(3 * t), "inertia": a, "offset": -np.ones_like(t), "stiffness": q, "damping": v}
    A = np.stack(list(columns.values()), axis=1)
    want, (rest,) = np.linalg.lstsq(A, tau)[:2]
    std = np.sqrt(rest / (len(t) - 5) * np.diag(np.linalg.inv(A.T @ A)))
    assert [name.split("'")[1] for name in fit.names[:4]] == list(columns)[:4] and fit.names[
        4
    ] == "forces[0].coefficient"
    np.testing.assert_allclose(fit.values, want, rtol=1e-7)  # the loss is flat to rounding nearer than that
    np.testing.assert_allclose(fit.deviation, std, rtol=1e-6)
    assert np.all(np.abs(fit.values - [0.9, 0.8, -0.6, 5.0, 0.3]) < 4 * std)
    assert (
        "torque fit by gauss-newton, ExplicitSystem" in fit.summary(noisy) and "forces[0].coefficient" in fit.summary()
    )


def test_deviations_count_errors_that_last(oscillation):
    """Linear, so that numpy fits again without each group of samples, whose errors last."""
    log, noise = oscillation, np.random.default_rng(4).normal(size=81)
    for i in range(1, 81):
        noise[i] = 0.97 * noise[i - 1] + 0.24 * noise[i]
    noisy = identify.Log(log.t, log.q, log.v, log.a, np.asarray(log.tau) + 0.05 * noise[:, None])
    start = oscillator(inertia=2.0, stiffness=1.0, offset=0.0, drive=2.0, damping=0.1)
    fit = fit_exactly(start, noisy, free=lambda s: [s.system.parameters, s.forces[0].coefficient])
    t, q, v, a, tau = (np.asarray(x).reshape(-1) for x in (noisy.t, noisy.q, noisy.v, noisy.a, noisy.tau))
    A = np.stack([-np.sin(3 * t), a, -np.ones_like(t), q, v], axis=1)
    best, (rest,) = np.linalg.lstsq(A, tau, rcond=None)[:2]
    edges = np.linspace(0, 81, 21).astype(int)  # twenty blocks, some of which make a group
    parts = block_groups(20, effective_sample_size([(A @ best - tau)[:, None]]))
    groups = [np.arange(edges[part[0]], edges[part[-1] + 1]) for part in parts]
    without = [np.linalg.lstsq(np.delete(A, group, 0), np.delete(tau, group), rcond=None)[0] for group in groups]
    scatter = np.sqrt(
        (len(groups) - 1) / len(groups) * np.sum((np.array(without) - np.mean(without, axis=0)) ** 2, axis=0)
    )
    independent = np.sqrt(rest / 76 * np.diag(np.linalg.inv(A.T @ A)))
    assert np.any(scatter > 1.02 * independent) and np.any(scatter < independent)
    np.testing.assert_allclose(fit.values, best, rtol=1e-7)
    np.testing.assert_allclose(fit.deviation, np.maximum(scatter, independent), rtol=1e-6)
    assert fit.factor == pytest.approx(scipy.stats.t.ppf(0.975, len(groups) - 1), rel=1e-9)


def test_logs_of_their_own_are_left_out_whole():
    """Thirty throws of a mass, each with an error of its own: the deviation of the mean is that of thirty, not of all samples."""
    generator, t = np.random.default_rng(2), np.linspace(0, 1, 11)
    own, logs = generator.normal(size=30), []
    one = np.ones((11, 1))
    for error in own:
        tau = (2.0 + 0.1 * error) * one + 0.001 * generator.normal(size=(11, 1))
        logs.append(identify.Log(t, 0 * one, 0 * one, one, tau))
    mass = oscillator(inertia=1.0, stiffness=0.0, offset=0.0, drive=0.0)
    fit = identify.fit_parameters(
        mass, logs, objective=identify.Objective("torque"), free=lambda s: s.system.parameters["inertia"]
    )
    pairs = own.reshape(15, 2).mean(axis=1)
    np.testing.assert_allclose(fit.deviation, 0.1 * pairs.std(ddof=1) / 15**0.5, rtol=0.02)


@pytest.mark.slow
def test_trajectories_with_noise_and_free_starts(oscillation):
    """The log's clock reaches the drive; starts that are fitted too take their noise out of the parameters."""
    log = oscillation
    exact = identify.fit_parameters(
        oscillator(stiffness=4.0, drive=0.5),
        log,
        objective=identify.Objective(horizon=20, substeps=4),
        solver=identify.Solver(tolerance=0.0),
        positive=everything_but_offset,
    )
    np.testing.assert_allclose(exact.values, [0.9, 0.8, 5.0], rtol=1e-8)
    # A motion that runs away from the start: the loss is not finite, and the scene given comes back.
    broken = identify.Log(log.t, log.q, log.v, None, 1e300 * log.tau)
    failed = identify.fit_parameters(
        oscillator(stiffness=4.0, drive=0.5),
        broken,
        objective=identify.Objective(horizon=20, substeps=4),
        positive=everything_but_offset,
    )
    assert failed.result == jd.RESULTS.nonfinite and np.isnan(failed.deviation).all()
    np.testing.assert_allclose(failed.values, [0.5, 0.8, 4.0])
    # Noise everywhere, and far more of it where the segments start.
    noise = np.random.default_rng(5).normal(size=(2, *log.q.shape)) * np.where(np.arange(81) % 20, 1e-4, 3e-2)[:, None]
    noisy = identify.Log(log.t, np.asarray(log.q) + noise[0], np.asarray(log.v) + noise[1], None, log.tau)
    fits = [
        identify.fit_parameters(
            oscillator(stiffness=4.0, drive=0.5),
            noisy,
            objective=identify.Objective(horizon=20, substeps=4, initial=initial),
            positive=everything_but_offset,
        )
        for initial in ("measured", "free")
    ]
    off = [np.abs(fit.values - [0.9, 0.8, 5.0]) for fit in fits]
    assert np.all(off[1] < 4 * fits[1].deviation) and np.all(fits[1].deviation < 0.1 * fits[1].values)
    assert np.linalg.norm(off[1]) < 0.5 * np.linalg.norm(off[0]) and fits[1].history[-1] < fits[0].history[-1]


def everything_but_offset(scene):
    return [scene.system.parameters[name] for name in ("drive", "inertia", "stiffness")]


def test_what_the_log_does_not_determine_is_said(swung):
    """m, g and l of a pendulum: m l^2 and m g l are found, single numbers are not; a constant force is."""
    t = np.linspace(0, 3, 60)
    q, v, a = np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)
    tau = 1.3 * 0.49 * a + 1.3 * G * 0.7 * np.sin(q) - 0.2
    log = identify.Log(t, *(x[:, None] for x in (q, v, a, tau)))
    scene = jd.Scene(
        scenes.pendulum(mass=1.0, length=1.0).system, (), (Partial(lambda c, system, q, v, t: c, jnp.zeros(1)),)
    )
    fit = fit_exactly(scene, log, positive=lambda s: s.system.parameters, free=lambda s: s.forces[0].args)
    g, l, m, c = fit.values
    np.testing.assert_allclose([m * l * l, m * g * l, c], [1.3 * 0.49, 1.3 * G * 0.7, 0.2], rtol=1e-8)
    assert np.isinf(fit.deviation[:3]).all() and fit.deviation[3] < 1e-6
    short = identify.fit_parameters(
        scene,
        log,
        objective=identify.Objective("torque"),
        solver=identify.Solver(steps=2),
        positive=lambda s: s.system.parameters,
        free=lambda s: s.forces[0].args,
    )
    assert short.result == jd.RESULTS.max_steps_reached and len(short.history) == 3


@jax.custom_jvp
def reversed_slope(x):
    """The identity with a derivative of the wrong sign: along it no step lowers a loss."""
    return x


reversed_slope.defjvp(lambda primals, tangents: (primals[0], -tangents[0]))


METHODS = ["gauss-newton", "levenberg-marquardt", "dogleg", pytest.param("lbfgs", marks=pytest.mark.slow)]


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_steps_that_lower_no_loss_are_no_solution(method):
    """Every trial fails, until the damping or the line search has made steps too short to be seen."""
    t = np.linspace(0, 3, 20)
    q, v, a = np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)
    tau = a + G * np.sin(q) - 0.2 + 0.05 * np.cos(7 * t)
    log = identify.Log(t, *(x[:, None] for x in (q, v, a, tau)))
    for function, code in ((reversed_slope, jd.RESULTS.no_descent), (lambda x: x, jd.RESULTS.successful)):
        force = Partial(lambda c, system, q, v, t, function=function: function(c), jnp.zeros(1))
        fit = identify.fit_parameters(
            jd.Scene(scenes.pendulum(mass=1.0, length=1.0).system, (), (force,)),
            log,
            objective=identify.Objective("torque"),
            solver=identify.Solver(method=method),
            free=lambda s: s.forces[0].args,
        )
        assert fit.result is code, fit.result


@pytest.mark.slow
@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_descent_in_reverse_mode(oscillation, method):
    """For many numbers: a force that is a small network learns what the nominal scene lacks, stiffness and drive."""
    rng = np.random.default_rng(0)
    weights = {name: jnp.asarray(rng.normal(size=size)) for name, size in (("in", (8, 2)), ("bias", (8,)))}
    weights["out"] = jnp.zeros((1, 8))

    def network(w, system, q, v, t):
        x = jnp.stack([q[0], jnp.sin(3.0 * t)])
        return w["out"] @ jnp.tanh(w["in"] @ x + w["bias"])

    lacking = oscillator(stiffness=4.0, drive=0.0)
    scene = jd.Scene(lacking.system, (), (*lacking.forces, Partial(network, weights)))
    options: dict = dict(horizon=20, substeps=4)
    fit = identify.fit_parameters(
        scene,
        oscillation,
        objective=identify.Objective(**options),
        solver=identify.Solver(method=method, steps=60),
        free=lambda s: s.forces[1],
    )
    errors = [max(identify.trajectory_error(x, oscillation, **options)) for x in (scene, fit.system)]
    assert len(fit.names) == 32 and fit.deviation is None
    assert errors[1] < 0.2 * errors[0]


@pytest.mark.slow
def test_trajectories_on_constraints():
    """Gravity and drag of a particle on a rod by its motion."""
    t = jnp.linspace(0, 1, 21)
    rod = scenes.pendulum_in_plane()
    held = jd.Scene(rod.system, rod.constraints, (jd.forces.JointDamping(0.3),))
    motion = jd.simulate(
        held, *scenes.pendulum_in_plane.start(), t, stepsize=jd.simulation.Steps(rtol=1e-12, atol=1e-12)
    )
    log = identify.Log(t, motion.q, motion.v, None, jnp.zeros((21, 2)))
    chosen = lambda scene: [scene.system.parameters["gravity"], scene.forces[0].coefficient]  # noqa: E731
    wrong = eqx.tree_at(chosen, held, [jnp.asarray(7.0), jnp.asarray(0.1)])
    fit = identify.fit_parameters(
        wrong,
        log,
        objective=identify.Objective(horizon=10, substeps=10),
        solver=identify.Solver(tolerance=0.0),
        positive=chosen,
    )
    np.testing.assert_allclose(fit.values, [G, 0.3], rtol=1e-8)


@pytest.mark.long
def test_options_by_their_own_names_are_deprecated(oscillation):
    """One release long they are those of the groups, and the warning names these."""
    start, pick = oscillator(inertia=2.0), lambda s: s.system.parameters["inertia"]
    objective = identify.Objective("torque", noise=0.02)
    want = identify.fit_parameters(start, oscillation, None, objective, identify.Solver(steps=2), free=pick)
    with pytest.warns(DeprecationWarning) as warned:
        fit = identify.fit_parameters(start, oscillation, free=pick, error="torque", noise=0.02, steps=2)
    texts = [str(one.message) for one in warned]
    assert texts == [
        "error, noise: pass jd.identify.Objective(error, noise), a group of options",
        "steps: pass jd.identify.Solver(steps), a group of options",
    ]
    np.testing.assert_array_equal(fit.history, want.history)
    with pytest.warns(DeprecationWarning, match=r"horizon, substeps, simulation: pass jd\.identify\.Objective"):
        error = identify.parameter_error(start, oscillation, horizon=20, substeps=2, max_steps=64)
    objective = identify.Objective(horizon=20, substeps=2, simulation={"max_steps": 64})
    assert error == identify.parameter_error(start, oscillation, objective)


def test_float32(oscillation):
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), oscillator(stiffness=4.0))
    fit = identify.fit_parameters(
        scene, oscillation, objective=identify.Objective("torque"), positive=lambda s: s.system.parameters["stiffness"]
    )
    assert fit.system.system.parameters["stiffness"].dtype == jnp.float32
    np.testing.assert_allclose(fit.values, [5.0], rtol=1e-4)


def test_bad_choices_are_refused(swung, oscillation):
    metric = jd.MetricSystem(lambda q, t, p: p * jnp.eye(1), 1, parameters=jnp.asarray([[1.0, 0.0]])[0, :1])

    def fit(system, log=oscillation, error="trajectory", **options):
        return lambda: identify.fit_parameters(system, log, objective=identify.Objective(error), **options)

    def objective(error, **options):
        return lambda: identify.Objective(error, **options)

    builder = jd.ModelBuilder("slider")
    builder.add_body("mass", None, "prismatic", inertia=(1.0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    model, parameters = builder.build(), lambda s: s.system.parameters
    rod = scenes.pendulum_in_plane()
    refused = {
        "nothing to fit; pick leaves": fit(metric),
        r"positive picks nothing of this Scene \(KeyError: 'mass'\)": fit(
            oscillator(), positive=lambda s: parameters(s)["mass"]
        ),
        r"free picks nothing of this Scene \(AttributeError": fit(oscillator(), free=lambda s: s.parameters),
        "free picks nothing of this MetricSystem .TypeError": fit(metric, free=lambda s: s.parameters[0]),
        "free picks 1, which is no leaf": fit(metric, free=lambda s: s.nq),
        "positive is 'mass'; pass a function": fit(metric, positive="mass"),
        r"free picks system.parameters\['drive'\] a second time": fit(
            oscillator(), positive=lambda s: parameters(s)["drive"], free=parameters
        ),
        r"positive picks system.parameters\['offset'\], which is -0.6; start above zero": fit(
            oscillator(), positive=parameters
        ),
        "positive picks inertias, the inertias of bodies": fit(model, positive=lambda m: m.inertias),
        "error is 'position'": objective("position"),
        "horizon, hold with error='torque', which simulates nothing": objective("torque", hold="previous", horizon=3),
        "the log has 2 columns of q, the MetricSystem has 1; give one column": fit(
            metric, swung, free=lambda s: s.parameters
        ),
        "method is 'bfgs'": lambda: identify.Solver("bfgs"),
        "steps is 0": lambda: identify.Solver(steps=0),
        "starts is 0": lambda: identify.Solver(starts=0),
        "initial is 'guessed'": objective("trajectory", initial="guessed"),
        "hold is 'spline'": objective("trajectory", hold="spline"),
        "substeps is 0": objective("trajectory", substeps=0),
        "substeps and stepsize both": objective("trajectory", substeps=1, simulation={"stepsize": 0.1}),
        "noise is 0": objective("torque", noise=0.0),
        "control is None with error='closed-loop'": objective("closed-loop"),
        "horizon=200 steps; a log of 81 samples allows 1 to 80": lambda: identify.fit_parameters(
            oscillator(), oscillation, objective=identify.Objective(horizon=200), free=parameters
        ),
        "the scene has 1 constraints, whose forces cannot be identified from torques": fit(
            rod, swung, positive=lambda s: s.system.parameters["mass"], error="torque"
        ),
        "the log has no a": fit(
            oscillator(),
            identify.Log(*(getattr(oscillation, x) for x in "tqv"), None, oscillation.tau),
            free=parameters,
            error="torque",
        ),
    }
    for message, call in refused.items():
        with pytest.raises(ValueError, match=message):
            call()
    free = jd.LagrangianSystem(lambda q, v: 0.5 * v[0] ** 2, 1)
    with pytest.raises(ValueError, match=r"model is a LagrangianSystem; .* with jd\.identify\.fit_parameters"):
        check_bodies(free)
