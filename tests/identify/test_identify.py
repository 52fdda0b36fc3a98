"""Identification: base parameters, least squares, feasible fits by torque and by trajectory error."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
from motion_helpers import within
from pinocchio_bridge import to_pinocchio
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt
from two_links import planar_arm, sines

import jaxdyn as jd
from benchmarks.identify_paths import arm as arm_of_joints
from benchmarks.identify_paths import fits, recorded
from jaxdyn import identify, inertia, robots
from jaxdyn.identify.chart import make_chart
from jaxdyn.identify.condensed_fit import Setting
from jaxdyn.identify.interior import LOG_CHOLESKY_BASIS, InteriorPoint, TorqueProblem, robot_chart
from jaxdyn.identify.methods import Unknowns
from jaxdyn.identify.problem import errors_of, pose_problem
from jaxdyn.identify.regression import condense_model
from jaxdyn.identify.robot_logs import RobotLogs, scene_with_parameters

pseudo_inertias = jax.jit(jax.vmap(inertia.pseudo_inertia))


@pytest.fixture(scope="module")
def iiwa():
    """The iiwa with friction and rotors."""
    model = robots.iiwa()
    return model.replace(damping=jnp.full(7, 0.5), friction=0.2 + 0.1 * jnp.arange(7.0), armature=jnp.full(7, 0.05))


@pytest.fixture(scope="module")
def arm():
    return planar_arm()


def friction_torque(v, viscous, coulomb, offset, v_s=0.01):
    return viscous * v + coulomb * np.tanh(v / v_s) + offset


def pinocchio_log(model, seed=3, noise=0.0, offset=0.0):
    """A log whose torques Pinocchio computed; friction by its formula."""
    t, q, v, a = sines(model.nv, seed=seed)
    reference, bridge = to_pinocchio(model)
    data = reference.createData()
    # Rotor inertia is added here and not taken from Pinocchio's armature.
    reference.armature[:] = 0
    tau = np.array([pin.rnea(reference, data, bridge.q_to_pinocchio(q[i]), v[i], a[i]) for i in range(len(t))])
    if model.damping is not None:
        tau += friction_torque(v, np.asarray(model.damping), np.asarray(model.friction), offset)
        tau += a * np.asarray(model.armature)
    return identify.Log(t, q, v, a, tau + noise * np.random.default_rng(7).normal(size=tau.shape))


@pytest.fixture(scope="module")
def iiwa_log(iiwa):
    return pinocchio_log(iiwa, offset=0.3)


@pytest.fixture(scope="module")
def wrong_iiwa(iiwa):
    """A nominal model that is feasible and wrong everywhere, without friction."""
    generator = np.random.default_rng(5)
    wrong = jax.jit(jax.vmap(lambda x, step: inertia.from_log_cholesky(inertia.to_log_cholesky(x) + step)))
    inertias = wrong(iiwa.inertias, generator.normal(scale=0.15, size=(7, 10)))
    return iiwa.replace(inertias=inertias, damping=None, friction=None, armature=None)


# --- base parameters --------------------------------------------------------------------------------------------------


def test_base_parameters_of_the_iiwa(iiwa):
    base = identify.base_parameters(iiwa)
    # Khalil & Dombre: a chain of revolute joints, none parallel, first axis along gravity: 7 n - 6.
    assert len(base) == 43
    assert base.names[0] == "iiwa_link_1.Izz"
    kept = ("mcx", "mcy", "Ixx", "Ixy", "Ixz", "Iyz", "Izz")
    assert base.names[1:] == tuple(f"iiwa_link_{i}.{k}" for i in range(2, 8) for k in kept)
    hidden = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyz")
    assert set(base.unidentifiable) >= {f"iiwa_link_1.{k}" for k in hidden}
    assert base.expressions[0] == "iiwa_link_1.Izz + 1 iiwa_link_2.Iyy"
    # The second witness: Pinocchio's regressor has this rank, and does not see a change that keeps the combinations.
    reference, _ = to_pinocchio(iiwa)
    data = reference.createData()
    generator = np.random.default_rng(1)
    states = generator.normal(size=(60, 3, 7))
    rows = np.vstack([pin.computeJointTorqueRegressor(reference, data, *x).copy() for x in states])
    assert np.linalg.matrix_rank(rows, tol=1e-9) == 43
    null = np.linalg.svd(base.matrix)[2][43:]
    assert np.abs(rows @ null.T).max() < 1e-10 * np.abs(rows).max() * np.sqrt(70)
    np.testing.assert_allclose(rows[:, base.independent] @ base.matrix, rows, atol=1e-10 * np.abs(rows).max())


def test_base_parameters_of_two_links_in_closed_form(arm):
    """Moving the second link's mass into the first: Iyy1 + m2 l^2, mcz1 - m2 l; the plane hides the rest."""
    base = identify.base_parameters(arm)
    assert base.names == ("a.mcx", "a.mcz", "a.Iyy", "b.mcx", "b.mcz", "b.Iyy")
    x = np.asarray(arm.inertias)
    expected = [x[0, 1], x[0, 3] - x[1, 0], x[0, 6] + x[1, 0], x[1, 1], x[1, 3], x[1, 6]]
    for given in (arm.inertias, x, x.reshape(-1)):  # takes (nb, 10) as well as (10 nb,)
        np.testing.assert_allclose(base.values(given), expected, rtol=1e-12)
    with_rotors = identify.base_parameters(arm, ("armature", "viscous"))
    # The first rotor turns with the first link, the second only relative to it.
    assert len(with_rotors) == 6 + 1 + 2
    assert "b_joint.armature" in with_rotors.names and "a_joint.armature" not in with_rotors.names


def test_free_body_shows_all_ten():
    builder = jd.ModelBuilder("free")
    builder.add_body("body", joint="free", inertia=(2.0, (0.1, 0.2, 0.3), (0.3, 0.4, 0.5)))
    base = identify.base_parameters(builder.build())
    assert len(base) == 10 and not base.unidentifiable
    np.testing.assert_allclose(base.matrix, np.eye(10), atol=1e-12)


# --- linear least squares ---------------------------------------------------------------------------------------------


def with_offsets(iiwa):
    """Parameters of the iiwa's log."""
    true = identify.nominal_parameters(iiwa)
    true[identify.parameter_names(iiwa).index("iiwa_joint_1.offset") :][:7] = 0.3
    return true


def test_least_squares_recovers_base_parameters_without_noise(iiwa, wrong_iiwa, iiwa_log):
    fit, true = identify.least_squares(wrong_iiwa, iiwa_log), with_offsets(iiwa)
    np.testing.assert_allclose(fit.values, fit.base.values(true), rtol=1e-8, atol=1e-8)
    assert fit.rank == len(fit.base) == 43 + 21 + 5  # two rotors turn with link inertias that are free themselves
    assert fit.error(iiwa_log) < 1e-8
    np.testing.assert_allclose(fit.base.values(fit.parameters), fit.values, rtol=1e-10, atol=1e-10)
    assert "rank 69" in fit.summary() and "iiwa_link_7.Izz" in fit.summary()


def test_terms_left_out_keep_the_models_values(iiwa, wrong_iiwa):
    """Torques made with known friction: fitting the links alone finds them only if that friction is accounted for."""
    log = pinocchio_log(iiwa)
    known = wrong_iiwa.replace(damping=iiwa.damping, friction=iiwa.friction, armature=iiwa.armature)
    fit = identify.least_squares(known, log, terms=())
    np.testing.assert_allclose(fit.values, fit.base.values(iiwa.inertias), rtol=1e-8, atol=1e-8)


def test_least_squares_noise_is_within_its_statistics(iiwa, wrong_iiwa):
    noise = 0.2
    log = pinocchio_log(iiwa, noise=noise)
    fit = identify.least_squares(wrong_iiwa, log)
    n, p = log.tau.size, len(fit.base)
    assert abs(fit.sigma / noise - 1) < 4 / np.sqrt(2 * (n - p))
    off = fit.values - fit.base.values(identify.nominal_parameters(iiwa))
    chi2 = off @ np.linalg.solve(fit.covariance, off)
    assert abs(chi2 - p) < 4 * np.sqrt(2 * p)  # chi-square: mean p, variance 2 p
    white = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(off) < 4.5 * white)
    # Ten groups of blocks know a standard deviation to a quarter, and leaving out blocks that tell much errs to the safe side.
    assert -0.1 < np.mean(np.log(fit.std / white)) < 0.4


def test_least_squares_counts_errors_that_last(iiwa, wrong_iiwa):
    """Noise that stays the same for 20 samples: intervals grow with it, those for independent errors do not."""
    log = pinocchio_log(iiwa)
    kernel = np.exp(-(np.linspace(-2, 2, 41) ** 2))
    white = np.random.default_rng(3).normal(size=log.tau.shape)
    noise = np.stack([np.convolve(x, kernel / np.linalg.norm(kernel), "same") for x in white.T], axis=1)
    fit = identify.least_squares(wrong_iiwa, identify.Log(log.t, log.q, log.v, log.a, log.tau + 0.2 * noise))
    off = fit.values - fit.base.values(identify.nominal_parameters(iiwa))
    rms = [np.sqrt(np.mean((off / std) ** 2)) for std in (fit.std, np.sqrt(np.diag(fit.covariance)))]
    assert rms[0] < 1.5 < 2 < rms[1]


def test_least_squares_says_what_the_log_does_not_show(arm):
    """A robot that is held at rest in many poses shows its first moments and no moment of inertia."""
    t, q, v, _ = sines(2)
    log = identify.Log(t, q, 0 * v, 0 * v, pinocchio_log(arm).tau)
    fit = identify.least_squares(arm, log, terms=())
    assert fit.rank == 4
    assert [name for name, std in zip(fit.base.names, fit.std, strict=True) if np.isinf(std)] == ["a.Iyy", "b.Iyy"]
    np.testing.assert_array_equal(fit.values[[2, 5]], fit.nominal[[2, 5]])
    assert "does not excite" in fit.summary()


def test_bad_arguments_raise(arm, iiwa_log):
    t, q, v, a = sines(2, n=20)
    log = identify.Log(t, q, v, a, q)
    rod = arm.replace(inertias=arm.inertias.at[1, 4:].set(0.0))
    by_torque = identify.fit_torques
    for words, call in (
        (r"terms is \('stiction',\)", lambda: identify.least_squares(arm, log, "stiction")),
        (r"v_s is 0\.0", lambda: by_torque(arm, log, v_s=0.0)),
        ("7 columns of q, model 'arm' has 2", lambda: identify.least_squares(arm, iiwa_log)),
        ("2 samples of 2 torques, too few for 6", lambda: identify.least_squares(arm, log[:2], terms=())),
        ("leave no error to estimate", lambda: by_torque(arm, log[:2])),
        (r"weights is \[1.0, 0.0\]; give 2", lambda: by_torque(arm, log, weights=[1, 0])),
        ("inertia is 'some", lambda: by_torque(arm, log, inertia="some")),
        ("prior is 0.0", lambda: by_torque(arm, log, prior=0.0)),
        ("are all zero", lambda: by_torque(arm, identify.Log(t, q, v, a, 0 * q))),
        ("inertia of b is not .*jd.model.repair_inertias", lambda: by_torque(rod, log)),
        ("viscous of coordinate 1 is -0.5", lambda: by_torque(arm.replace(damping=jnp.array([0.0, -0.5])), log)),
        ("the log has 1 sample", lambda: fit_motion(arm, log[:1])),
        ("horizon=20 .* allows 1 to 19", lambda: fit_motion(arm, log, horizon=20)),
        ("the log has no v", lambda: fit_motion(arm, identify.Log(t, q, tau=q))),
    ):
        with pytest.raises(ValueError, match=words):
            call()


# --- the chart of feasible models -------------------------------------------------------------------------------------


UNITS = [np.ones(7)] * 3


def test_every_point_of_the_chart_is_feasible(wrong_iiwa):
    chart, generator = make_chart(wrong_iiwa, "full"), np.random.default_rng(0)
    np.testing.assert_allclose(chart.inertias(np.zeros((7, 10))), wrong_iiwa.inertias, rtol=1e-12, atol=1e-14)
    far = generator.normal(size=(200, 7, 10))
    bodies = jax.jit(jax.vmap(chart.inertias))(far).reshape(-1, 10)
    assert np.linalg.eigvalsh(pseudo_inertias(bodies)).min() > 0


def divergence(model, inertias):
    """By its definition."""
    P0, P = np.asarray(pseudo_inertias(model.inertias)), np.asarray(pseudo_inertias(inertias))
    ratio = np.linalg.solve(P0, P)
    return np.sum(np.trace(ratio, axis1=1, axis2=2) - np.linalg.slogdet(ratio)[1] - 4)


def stretched(seed):
    return np.eye(4) + 0.1 * np.triu(np.random.default_rng(seed).normal(size=(7, 4, 4)))


def test_torque_loss_is_the_sum_over_samples(wrong_iiwa, iiwa_log):
    """The condensed loss against all samples and the divergence's definition, at random points of the chart."""
    chart = robot_chart(wrong_iiwa, identify.TERMS, "full", UNITS)
    problem = TorqueProblem.of(chart, condense_model(wrong_iiwa, [iiwa_log]).rows(np.ones(7)), 0.5, 0.7)
    W = identify.regressor(wrong_iiwa, iiwa_log.q, iiwa_log.v, iiwa_log.a)
    for seed in range(3):
        x = chart.x(stretched(seed), chart.start)
        expected = 0.5 * np.sum((W @ x - iiwa_log.tau) ** 2) / 0.25
        expected += 0.7 * divergence(wrong_iiwa, x[:70].reshape(7, 10))
        np.testing.assert_allclose(problem.loss(stretched(seed), chart.start), expected, rtol=1e-10)


@pytest.mark.long
def test_the_linear_map_on_the_host_is_the_chart(wrong_iiwa):
    """x, its Jacobian and the basis of the interior-point method against the chart, by automatic differentiation."""
    model = wrong_iiwa.replace(damping=jnp.full(7, 0.5))
    for kind, size in (("full", 10), ("mass", 1), ("fixed", 0)):
        chart, linear = make_chart(model, kind), robot_chart(model, ("viscous", "offset"), kind, UNITS)
        origin, terms = stretched(1)[: 7 * (size > 0)], np.random.default_rng(3).uniform(size=14)

        def parameters(y, chart=chart, origin=origin, size=size):
            """x near a point, with the bodies' steps after those to the origin."""
            theta, terms = jnp.split(y, [len(origin) * size])
            theta, terms = theta.reshape(len(origin), size), 0.1 * terms.reshape(2, 7)
            inertias = chart.inertias(theta)
            if size:
                upper = jnp.asarray(chart.factors @ origin) @ chart.relative_factors(theta)
                inertias = jax.vmap(inertia.parameters_from_pseudo)(upper @ jnp.swapaxes(upper, 1, 2))
            return jnp.concatenate([inertias.reshape(-1), terms[0], jnp.zeros(7), terms[1], jnp.zeros(7)])

        y = jnp.concatenate([jnp.zeros(len(origin) * size), terms])
        x, slopes = jax.jit(lambda y, f=parameters: (f(y), jax.jacfwd(f)(y)))(y)
        np.testing.assert_allclose(linear.x(origin, terms), x, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(linear.jacobian(origin), slopes, rtol=1e-11, atol=1e-13)
        assert linear.body_jacobians(origin).shape == (7 * (size > 0), 10, size)
        np.testing.assert_array_equal(linear.start, [*[5.0] * 7, *[0.0] * 7])
        np.testing.assert_array_equal(linear.clip_terms(np.full(14, 1e-7)), [*[0.0] * 7, *[1e-7] * 7])
    factor = np.asarray(jax.jit(jax.jacfwd(inertia.log_cholesky_factor))(np.zeros(10))).transpose(2, 0, 1)
    np.testing.assert_allclose(LOG_CHOLESKY_BASIS, factor + factor.transpose(0, 2, 1), atol=1e-15)


# --- feasible fits by torque error ------------------------------------------------------------------------------------


def lowest_eigenvalue(model):
    return float(np.linalg.eigvalsh(pseudo_inertias(model.inertias)).min())


def test_interior_points_end_with_a_code_where_numbers_are_not_finite(iiwa, iiwa_log):
    """Torques whose squares overflow, and multipliers that rounding has made indefinite."""
    huge = identify.Log(iiwa_log.t, iiwa_log.q, iiwa_log.v, iiwa_log.a, 1e154 * iiwa_log.tau)
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="squares overflow"):
        identify.fit_torques(iiwa, huge)
    chart = robot_chart(iiwa, identify.TERMS, "full", UNITS)
    method = InteriorPoint(TorqueProblem.of(chart, condense_model(iiwa, [iiwa_log]).rows(np.ones(7)), 0.5, 0.7), 1e-9)
    iterate = method.init(chart.start, None)
    assert method.step(iterate, [iterate.loss], iterate)[1] is None
    state, targets = iterate.state
    broken = iterate._replace(state=(state._replace(dual=-1e6 * state.dual), targets))
    following, result = method.step(broken, [broken.loss], broken)
    assert result is jd.RESULTS.nonfinite and following is broken


def test_feasible_fit_recovers_base_parameters_without_noise(iiwa, wrong_iiwa, iiwa_log):
    """sigma is then its floor, 1e-6 of the torque, and the prior's pull is that small."""
    fit = identify.fit_torques(wrong_iiwa, iiwa_log)
    assert fit.result == jd.RESULTS.successful
    base = identify.base_parameters(iiwa, identify.TERMS)
    np.testing.assert_allclose(base.values(fit.vector), base.values(with_offsets(iiwa)), atol=2e-6)
    assert fit.error(iiwa_log) < 1e-5
    np.testing.assert_allclose(fit.friction.offset, 0.3, atol=1e-6)
    np.testing.assert_allclose(fit.model.damping, 0.5, atol=1e-6)
    name, nominal, fitted, deviation = fit.parameters[0]
    assert np.isnan(deviation)  # those of a robot are of `fit_robot`
    assert name == "iiwa_link_1.m" and nominal == float(wrong_iiwa.inertias[0, 0])
    assert fitted == float(fit.model.inertias[0, 0])


@pytest.fixture(scope="module")
def noisy(iiwa, wrong_iiwa):
    """A noisy log and the minimum that Newton's method finds in it."""
    log = pinocchio_log(iiwa, noise=0.5)
    return log, identify.fit_torques(wrong_iiwa, log)


def test_every_iterate_is_feasible(wrong_iiwa, noisy):
    log, fit = noisy
    problem, lowest, losses = RobotLogs(wrong_iiwa, (log,), identify.TERMS, (), "full", 1), [], []

    def watch(step, loss, point):
        losses.append(loss)
        scene = scene_with_parameters(wrong_iiwa, problem.chart.x(*point), identify.TERMS, 0.01)
        (friction,), model = scene.forces, scene.system
        lowest.append(lowest_eigenvalue(model))
        assert min(float(x.min()) for x in (friction.viscous, friction.coulomb, model.armature)) >= 0

    estimate = problem.fit(Setting(0.01, (), 1.0), callback=watch)
    assert min(lowest) > 0
    np.testing.assert_array_equal(estimate.history, losses)
    # Its linear algebra runs on one thread, with other rounding.
    np.testing.assert_allclose(fit.history, losses, rtol=1e-10)
    assert fit.result == jd.RESULTS.successful and len(losses) < 60


@pytest.mark.parametrize("prior", [1.0, 10.0])
def test_the_optimum_of_the_convex_loss_is_one(arm, prior):
    """`fit_parameters` takes the same steps; SciPy in other coordinates, on samples instead of a triangle, agrees."""
    log = pinocchio_log(planar_arm(1.4, 0.5), noise=0.1)
    log = identify.Log(log.t, log.q, log.v, log.a, log.tau + 0.3 * log.v + 0.2)
    size = np.sqrt(np.mean(log.tau**2, axis=0))
    fit = identify.fit_torques(arm, log, ("viscous", "offset"), weights=1 / size, prior=prior)
    scene = jd.Scene(arm, forces=[identify.Friction(jnp.full(2, 0.1), *jnp.zeros((2, 2)), jnp.asarray(0.01))])
    tree = identify.Parameters(scene).inertias(weight=prior).positive(lambda s: s.forces[0].viscous)
    tree = tree.free(lambda s: s.forces[0].offset)
    # |w e|^2 / (2 sigma^2) + prior D is N / (2 sigma^2) times the mean of (w e)^2 plus 2 sigma^2 / N times prior D.
    objective = identify.Objective("torque", noise=2**0.5 * fit.sigma)
    other = identify.fit_parameters(scene, log, tree, objective, identify.Solver(tolerance=1e-12))
    np.testing.assert_allclose(other.history[-1] * log.tau.size / (2 * fit.sigma**2), fit.history[-1], rtol=1e-9)
    base, friction = identify.base_parameters(arm), other.system.forces[0]
    # A loss within 1e-6 of its minimum leaves the numbers within a thousandth of a standard deviation, some 1e-6.
    np.testing.assert_allclose(base.values(other.system.system.inertias), base.values(fit.model.inertias), atol=1e-6)
    np.testing.assert_allclose(friction.viscous, fit.friction.viscous, atol=1e-6)
    np.testing.assert_allclose(friction.offset, fit.friction.offset, atol=1e-6)
    assert len(other.history) < 40 and np.isfinite(other.deviation).all()
    problem, _ = pose_problem(tree, objective, log)
    errors = jax.jit(lambda y: errors_of(Unknowns(y, None), problem))
    found = scipy.optimize.least_squares(errors, problem.start.y, jax.jit(jax.jacfwd(errors)), xtol=1e-15, ftol=1e-15)
    np.testing.assert_allclose(2 * found.cost, other.history[-1], rtol=1e-9)
    scene = tree.system(jnp.asarray(found.x))
    np.testing.assert_allclose(base.values(scene.system.inertias), base.values(fit.model.inertias), atol=1e-6)
    np.testing.assert_allclose(scene.forces[0].viscous, fit.friction.viscous, atol=1e-6)


@pytest.mark.parametrize("is_raw", [False, True])
def test_both_fits_of_a_robot_are_one(is_raw):
    """A robot by all of its parameters, and by a tree of the same numbers with the same prior: by the same steps."""
    model = arm_of_joints(4)
    log = recorded(model, 1500 if is_raw else 400)
    # Friction goes through the low-pass of a raw log in both.
    log = identify.from_raw(log.t, log.q, log.tau, cutoff=8.0, every=3) if is_raw else log
    robot, tree = (fit() for fit in fits(model, log))
    assert type(robot) is type(tree) is identify.Fit and robot.result == tree.result == jd.RESULTS.successful
    base = identify.base_parameters(model, identify.TERMS)
    # The last step of the interior point predicts a decrease of the loss of 1e-6, a thousandth of a standard deviation, at most;
    # it converges quadratically, and Gauss-Newton steps of the tree follow.
    np.testing.assert_allclose(base.values(robot.vector), base.values(tree.vector), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(robot.torques(log), tree.torques(log), atol=1e-8)
    # Both start at 10 % more mass, and at terms of their own.
    assert robot.history[-1] * 4 * robot.sigma**2 / log.tau.size == pytest.approx(2 * tree.history[-1], rel=1e-9)


def test_prior_decides_between_data_and_nominal(arm):
    """A strong prior keeps the nominal bodies; the weaker it is, the better the fit and the larger the divergence."""
    log = pinocchio_log(planar_arm(1.4, 0.5), noise=0.1)
    priors = (1e13, 1e12, 1e2, 1.0)
    fits = [identify.fit_torques(arm, log, prior=prior) for prior in priors]
    assert fits[0].error(log) > fits[2].error(log) > fits[3].error(log)
    # Close to the nominal bodies the way from them is the slope of the data over the prior: to first order, priors share it
    # in inverse proportion, and the second order is the relative size of the way.
    ways = [np.asarray(fit.model.inertias - arm.inertias) for fit in fits]
    size = np.abs(ways[1]).max() / np.abs(np.asarray(arm.inertias)).max()
    assert 0 < size < 1e-3
    np.testing.assert_allclose(10 * ways[0], ways[1], rtol=0, atol=10 * size * np.abs(ways[1]).max())
    assert all(fit.result == jd.RESULTS.successful for fit in fits)


def test_subsets_of_what_is_fitted(arm):
    true = planar_arm(1.4, 0.5)
    log = pinocchio_log(true)
    mass = identify.fit_torques(arm, log, (), inertia="mass")
    np.testing.assert_allclose(mass.model.inertias, true.inertias, rtol=1e-7, atol=1e-9)
    assert mass.model.damping is None and mass.model.armature is None  # what was absent stays absent
    fixed = identify.fit_torques(true, log, inertia="fixed")
    np.testing.assert_array_equal(fixed.model.inertias, true.inertias)
    assert np.abs(fixed.vector[20:]).max() < 1e-6


def test_float32_models(iiwa):
    arm, true = planar_arm(dtype=jnp.float32), planar_arm(1.4, 0.5)
    log = pinocchio_log(true, noise=0.01)
    single = identify.fit_torques(arm, log)
    double = identify.fit_torques(planar_arm(), log)
    assert single.model.inertias.dtype == jnp.float32
    # The regressor is computed in float32: 1e-6 of the torque beside 1e-3 of noise.
    assert abs(single.error(log) - double.error(log)) < 1e-2 * double.error(log)
    assert len(identify.base_parameters(arm)) == 6


# --- the recorded Franka log ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def franka(data_dir, robots_dir):
    folder = data_dir / "franka_panda"
    if not folder.is_dir():
        pytest.skip(f"no Franka log at {folder}")
    spec = importlib.util.spec_from_file_location("prepare", folder / "prepare.py")
    prepare = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(prepare)
    t, q, _, tau = prepare.raw()
    log = identify.from_raw(t, q, tau)
    path = robots_dir / "panda_description/urdf/panda.urdf"
    model = jd.load_model(path, lock=("panda_finger_joint1", "panda_finger_joint2"))
    # The file's damping is the same placeholder in every joint; the protocol's nominal model has no friction.
    return model.replace(damping=None, friction=None), *identify.split(log, 0.7), path


@pytest.mark.data
def test_franka_least_squares_against_pinocchio_and_numpy(franka):
    model, train, test, path = franka
    fit = identify.least_squares(model, train)
    full = pin.buildModelFromUrdf(str(path))
    fingers = [full.getJointId(name) for name in full.names if "finger" in name]
    reference = pin.buildReducedModel(full, fingers, pin.neutral(full))
    data = reference.createData()

    def rows(log):
        blocks = []
        for q, v, a in zip(log.q, log.v, log.a, strict=True):
            bodies = pin.computeJointTorqueRegressor(reference, data, q, v, a).copy()
            blocks.append(np.hstack([bodies, *map(np.diag, (v, np.tanh(v / 0.01), np.ones(7), a))]))
        return np.array(blocks)

    A = rows(train).reshape(-1, 98)
    scale = np.linalg.norm(A, axis=0)
    scale[scale < 1e-9] = np.inf  # columns of rounding errors
    x = np.linalg.lstsq(A / scale, train.tau.reshape(-1), rcond=1e-6)[0] / scale
    for log, per_cent, oracle in ((train, 1.11, (A @ x).reshape(-1, 7)), (test, 1.36, rows(test) @ x)):
        np.testing.assert_allclose(fit.torques(log), oracle, atol=1e-9 * np.abs(oracle).max())
        assert round(fit.error(log), 2) == per_cent
    nominal = np.array([pin.rnea(reference, data, *z) for z in zip(test.q, test.v, test.a, strict=True)])
    assert 16 < identify.torque_error(nominal, test.tau) < 20
    assert fit.rank == len(fit.base) == 69 and fit.condition < 50


@pytest.mark.data
def test_franka_feasible_fit_on_held_out_data(franka):
    model, train, test, _ = franka
    fit = identify.fit_torques(model, train)
    assert fit.error(test) <= 1.45
    assert fit.error(train) <= 1.21
    assert lowest_eigenvalue(fit.model) > 0
    for values in (fit.friction.viscous, fit.friction.coulomb, fit.model.armature):
        assert np.asarray(values).min() >= 0
    # The prediction is inverse dynamics and the friction law, low-passed as the log is; the regressor gives the same.
    columns = np.array(identify.regressor(model, test.q, test.v, test.a))
    coulomb = slice(10 * model.nb + model.nv, 10 * model.nb + 2 * model.nv)
    # Friction jumps: it is evaluated on eight times the samples before the low-pass, with three of its periods beyond the ends.
    fine = np.arange(8 * (len(test) - 1) + 1) / 8
    v = CubicSpline(np.arange(len(test)), test.v)(fine)
    rate = 8 * (len(test) - 1) / (test.t[-1] - test.t[0])
    ends = int(3 * rate / test.cutoff)
    friction = filtfilt(*butter(4, 2 * test.cutoff / rate), np.tanh(v / fit.friction.v_s), axis=0, padlen=ends)[::8]
    columns[:, np.arange(model.nv), np.arange(coulomb.start, coulomb.stop)] = friction
    by_regressor = columns @ fit.vector
    np.testing.assert_allclose(fit.torques(test), by_regressor, atol=1e-10 * np.abs(by_regressor).max())
    assert fit.summary(train, test).count("torque error") == 2


# --- feasible fits by trajectory error --------------------------------------------------------------------------------


def test_sampled_torque_between_samples():
    t, tau = jnp.array([0.0, 1.0, 3.0]), jnp.array([[0.0], [2.0], [-2.0]])
    for hold, expected in (("linear", [0, 1, 2, 0, -2, -2]), ("previous", [0, 0, 2, 2, 2, 2])):
        control = identify.SampledTorque(t, tau, hold)
        times = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0)
        np.testing.assert_allclose([float(control(tau[0], tau[0], jnp.asarray(x))[0]) for x in times], expected)


def simulated_log(model, seed=0, noise=0.0):
    """Two seconds of the model under known torques, sampled at 50 Hz, integrated far more finely than the fits do."""
    t = jnp.linspace(0, 2, 101)
    phase = jnp.arange(model.nv, dtype=float)[None]
    tau = 2 * jnp.sin((3 + 2 * phase) * t[:, None] + phase)
    start = 0.3 * jnp.ones(model.nv), jnp.zeros(model.nv)
    motion = jd.simulate(model, *start, t, control=identify.SampledTorque(t, tau), stepsize=within(1e-12))
    measured = np.random.default_rng(seed).normal(scale=noise, size=(2, 101, model.nv))
    return identify.Log(t, motion.q + measured[0], motion.v + measured[1], None, tau)


def fit_motion(model, log, shape="full", callback=None, solver=None, **options):
    """Inertias of a model by its motion."""
    tree = identify.Parameters(model).inertias(shape=shape, metric=None)
    objective = identify.Objective("trajectory", **options)
    solver = identify.Solver(tolerance=0.0) if solver is None else solver
    return identify.fit_parameters(model, log, tree, objective, solver, identify.Execution(callback=callback))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["gauss-newton", "lbfgs"])
def test_motion_recovers_a_mass_without_noise(method):
    """A pendulum of unknown mass; its bob is a point, no solid body, so its density alone is fitted."""
    builder = jd.ModelBuilder("pendulum")
    builder.add_body("bob", axis=(0, 1, 0), inertia=inertia.point_mass(1.0, (0, 0, -0.7)))
    nominal = builder.build()
    true = nominal.replace(inertias=1.8 * nominal.inertias)
    log, options, masses = simulated_log(true), dict(horizon=20, substeps=4), []

    def watch(step, loss, model):
        masses.append(float(model.inertias[0, 0]))

    solver = identify.Solver(method, tolerance=0.0)
    fit = fit_motion(nominal, log, "mass", callback=watch, solver=solver, **options)
    # Tsit5 with 5 ms steps is that exact here.
    np.testing.assert_allclose(fit.system.inertias, true.inertias, rtol=1e-8, atol=1e-12)
    assert min(masses) > 0 and len(masses) == len(fit.history) and fit.result == jd.RESULTS.successful
    errors = [max(identify.trajectory_error(model, log, **options)) for model in (nominal, fit.system)]
    assert errors[0] > 1 and errors[1] < 1e-6
    # A motion that runs away from the start: the loss is not finite, and the model given comes back.
    broken = identify.Log(log.t, log.q, log.v, None, 1e200 * log.tau)
    fit = fit_motion(nominal, broken, "mass", solver=solver, **options)
    assert fit.result == jd.RESULTS.nonfinite
    np.testing.assert_allclose(fit.system.inertias, nominal.inertias, rtol=1e-12)
    with pytest.raises(ValueError, match="substeps is 0"):
        identify.rollout(nominal, log, substeps=0)
    with pytest.raises(ValueError, match="substeps and stepsize both"):
        identify.rollout(nominal, log, substeps=1, stepsize=0.1)


@pytest.mark.slow
def test_motion_recovers_two_links_without_noise(arm):
    """All ten numbers of both links are free: the six combinations that move the arm are found, within feasible bodies."""
    lowest = []

    def watch(step, loss, model):
        lowest.append(lowest_eigenvalue(model))

    fit = fit_motion(planar_arm(1.5, 0.5), simulated_log(arm), callback=watch, horizon=20, substeps=4)
    base = identify.base_parameters(arm)
    np.testing.assert_allclose(base.values(fit.system.inertias), base.values(arm.inertias), atol=1e-6)
    assert min(lowest) > 0


@pytest.mark.slow
def test_motion_with_noisy_states(arm):
    """Free initial states, friction, noisy positions and velocities: within three per cent of the way from the nominal."""
    log = simulated_log(arm, noise=1e-3)
    nominal = planar_arm(1.5, 0.5)
    scene = jd.Scene(nominal, forces=[identify.Friction(jnp.full(2, 0.1), *jnp.zeros((2, 2)), jnp.asarray(0.01))])
    tree = identify.Parameters(scene).inertias().positive(lambda s: s.forces[0].viscous)
    fit = identify.fit_parameters(scene, log, tree, identify.Objective(horizon=25, initial="free", substeps=2))
    base = identify.base_parameters(arm)
    true, computed, old = (base.values(model.inertias) for model in (arm, fit.system.system, nominal))
    assert np.linalg.norm(computed - true) < 0.03 * np.linalg.norm(old - true)
    assert np.abs(fit.system.forces[0].viscous).max() < 0.01
    assert max(identify.trajectory_error(fit.system, simulated_log(arm), substeps=2)) < 2


def test_regressor_refuses_traced_arrays():
    arm = robots.chain(2)
    x = jnp.zeros((3, 2))
    with pytest.raises(ValueError, match=r"traced.*torque_regressor"):
        jax.jit(lambda x: identify.regressor(arm, x, x, x))(x)
