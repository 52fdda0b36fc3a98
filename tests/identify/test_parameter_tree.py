"""What a fit may change: feasible bodies, bounds, ties, priors and sensors; objectives, solvers and what stops a fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd
from jaxdyn.identify import chart
from jaxdyn.identify.options import energy_balance, momentum_balance
from jaxdyn.identify.result import segments

BOX = (0.3, 0.08, 0.06)


def arm(mass=(2.0, 1.0, 0.5), length=0.4, damping=(0.3, 0.2, 0.1)):
    """Links that turn about different axes, as many as there are masses."""
    builder = jd.ModelBuilder("arm")
    axes, parent = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.3, 1.0, 0.0)), None
    for i, axis in enumerate(axes[: len(mass)]):
        body = jd.inertia.displaced(jd.inertia.box(mass[i], BOX), (0.15, 0.02, -0.01))
        place = (length, 0.0, 0.0) if i else None
        builder.add_body(
            f"link{i}", parent, "revolute", body, axis=axis, pose=place, damping=damping[i], joint_name=f"j{i}"
        )
        parent = f"link{i}"
    return builder.build()


_torques = jax.jit(jax.vmap(jd.inverse_dynamics, (None, 0, 0, 0)))  # one program for all models of a topology


def driven(model, t, seed=0):
    """A motion of smooth sines, its derivatives, and the torques that it needs with the model's damping."""
    rng = np.random.default_rng(seed)
    size, rate, phase = (rng.uniform(low, high, (model.nv, 3)) for low, high in ((0.2, 0.5), (1.0, 4.0), (0.0, 6.0)))
    at = rate[None] * t[:, None, None] + phase[None]
    q, v, a = (np.sum(x, 2) for x in (size * np.sin(at), size * rate * np.cos(at), -size * rate**2 * np.sin(at)))
    return q, v, a, np.asarray(_torques(model, q, v, a)) + np.asarray(model.damping) * v


def scene_of(model):
    return jd.Scene(model, forces=[jd.forces.JointDamping(model.damping)])


T = np.linspace(0.0, 3.0, 91)


@pytest.fixture(scope="module")
def log():
    q, v, a, tau = driven(arm(), T)
    return jd.identify.Log(T, q, v, a, tau)


def tree(scene):
    model = scene.system
    whole = jd.identify.Parameters(scene)
    whole = whole.inertias(
        ["link1", "link2"], metric="affine", total=5.0, ellipsoids={"link2": ((0.15, 0, 0), (0.4, 0.3, 0.3))}
    )
    whole = whole.positive(lambda s: s.forces[0], rows=None)
    whole = whole.bound(lambda s: s.system.lower, -2.0, 2.0) if np.isfinite(model.lower).all() else whole
    whole = whole.poses(lambda s: s.system.home, rows=["link1"], std=0.01)
    whole = whole.tie(lambda s: s.system.frame_poses, lambda s: s.system.home, rows=["link2"], to_rows=["link1"])
    return whole.directions(lambda s: s.system.gravity, std=0.1).directions(lambda s: s.system.screws, rows=["link2"])


@pytest.mark.long
def test_every_point_is_a_system_that_can_exist():
    model = arm().replace(lower=-jnp.ones(3), upper=jnp.ones(3))
    scene, points = scene_of(model), tree(scene_of(model))
    whole = points.system(points.start)
    for got, want in zip(jax.tree.leaves(whole), jax.tree.leaves(scene), strict=True):
        if got.shape not in ((3, 10), (3, 4, 4)):  # the mass total, and the tied frame, differ from the start
            np.testing.assert_allclose(got, want, atol=1e-15)
    for seed in range(5):
        y = jax.random.normal(jax.random.key(seed), (points.size,))
        computed = points.system(y).system
        assert all(jd.inertia.is_feasible(ten) for ten in computed.inertias)
        np.testing.assert_allclose(computed.inertias[:, 0].sum(), 5.0, rtol=1e-14)
        np.testing.assert_array_equal(computed.inertias[0], model.inertias[0])
        R = np.asarray(computed.home[1, :3, :3])
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
        np.testing.assert_array_equal(computed.home[0], model.home[0])
        np.testing.assert_allclose(computed.frame_poses[2], computed.home[1])
        np.testing.assert_allclose(np.linalg.norm(computed.gravity), 9.81, rtol=1e-14)
        np.testing.assert_allclose(np.linalg.norm(computed.screws[:, 3:], axis=1), 1, rtol=1e-14)
        assert (np.abs(computed.lower) < 2).all()
        assert min(float(x) for x in jax.tree.leaves(points.system(y).forces[0])[0]) > 0
    assert len(points.names) == points.values(points.start).size
    assert points.names[0] == "system.inertias[link1] m"


@pytest.mark.long
def test_distances_of_bodies_are_those_of_their_eigenvalues():
    """Against eigenvalues of P0^-1 P in numpy, near and far, and at the nominal body itself."""
    model, pseudo = arm(), jax.jit(jax.vmap(jd.inertia.pseudo_inertia))
    for metric, form in (
        ("entropic", lambda w: np.sum(w - np.log(w) - 1)),
        ("affine", lambda w: np.sum(np.log(w) ** 2)),
    ):
        points = jd.identify.Parameters(model).inertias(metric=metric, weight=2.0)
        total = lambda y, points=points: jnp.sum(points.residual(y) ** 2)  # noqa: E731
        both = jax.jit(lambda y, step, total=total: (*jax.value_and_grad(total)(y), jax.jvp(total, (y,), (step,))[1]))
        moved = jax.jit(lambda y, points=points: points.system(y).inertias)
        slopes = jax.jit(jax.jacfwd(points.residual))(points.start)
        assert np.isfinite(slopes).all() and np.linalg.matrix_rank(slopes) == 30
        # Near the nominal body the entropic divergence is half of the affine distance, squared.
        for size in (0.0, 1e-9, 1e-3, 0.05, 0.7):
            y = size * jax.random.normal(jax.random.key(3), (points.size,))
            step = jax.random.normal(jax.random.key(4), y.shape)
            P0, P = (np.asarray(pseudo(x)) for x in (model.inertias, moved(y)))
            values = np.linalg.eigvals(np.linalg.solve(P0, P)).real
            got, gradient, forward = both(y, step)
            np.testing.assert_allclose(got, 2.0 * form(values.reshape(-1)), rtol=1e-7, atol=1e-14)
            np.testing.assert_allclose(gradient @ step, forward, rtol=1e-10, atol=1e-18)


def test_logarithm_of_a_matrix_with_equal_eigenvalues():
    turn, h = np.linalg.qr(np.random.default_rng(0).normal(size=(4, 4)))[0], 1e-4

    @jax.jit
    def compute(matrix, step):
        here, slope = jax.jvp(chart.symmetric_log, (matrix,), (step,))
        ahead, behind = (chart.symmetric_log(matrix + s * h * step) for s in (1, -1))
        return (ahead - behind) / (2 * h), slope, jax.scipy.linalg.expm(here)

    for values in ([1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0 + 1e-9, 5.0], [0.1, 0.1, 3.0, 3.1]):
        matrix = turn * np.array(values) @ turn.T
        step = np.random.default_rng(1).normal(size=(4, 4))
        difference, slope, back = compute(matrix, step + step.T)
        np.testing.assert_allclose(slope, difference, atol=1e-4)  # differences of second order, 1/0.1^3 h^2
        np.testing.assert_allclose(back, matrix, atol=1e-13)


def test_symmetric_eigenvectors():
    """Against LAPACK on the host, in a batch, with equal eigenvalues and entries of all sizes."""
    generator = np.random.default_rng(0)
    matrices = generator.normal(size=(50, 4, 4)) * 10.0 ** generator.uniform(-6, 6, (50, 1, 1))
    matrices = np.concatenate([matrices @ np.swapaxes(matrices, 1, 2), np.eye(4)[None], np.zeros((1, 4, 4))])
    values, vectors = map(np.asarray, jax.jit(jax.vmap(chart.symmetric_eigenvectors))(matrices))
    size = np.maximum(np.linalg.norm(matrices, axis=(1, 2)), 1e-300)
    np.testing.assert_allclose(
        np.sort(values) / size[:, None], np.linalg.eigvalsh(matrices) / size[:, None], atol=1e-14
    )
    back = np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    np.testing.assert_allclose(back / size[:, None, None], matrices / size[:, None, None], atol=1e-14)
    lowered = jax.jit(jax.vmap(chart.symmetric_log)).lower(matrices[:50]).as_text()
    assert "lapack" not in lowered


def test_barrier_residual_has_one_branch():
    x = jnp.array([-30.0, -2.0, -0.1 - 1e-9, -0.1 + 1e-9, -1e-8, 0.0, 1e-8, 0.1 - 1e-9, 0.1 + 1e-9, 2.0, 20.0])
    got, slope = map(np.asarray, jax.jit(jax.vmap(jax.value_and_grad(chart.barrier_residual)))(x))
    want = np.expm1(np.asarray(x)) - np.asarray(x)
    np.testing.assert_allclose(got**2, want, rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(2 * got * slope, np.expm1(np.asarray(x)), rtol=1e-11, atol=1e-15)


@pytest.mark.long
def test_balances_vanish_along_a_motion(log):
    """Momentum and energy of a motion of the model, by an integral of fourth order less on finer samples."""
    scene, left = scene_of(arm()), []
    for count in (31, 61):
        q, v, a, tau = driven(arm(), np.linspace(0, 1, count))
        piece = jax.tree.map(
            lambda x: x[0], segments(jd.identify.Log(np.linspace(0, 1, count), q, v, a, tau), None, float)
        )
        left.append(np.append(np.abs(momentum_balance(scene, piece)), np.abs(energy_balance(scene, piece))))
    # The trapezoidal rule is of second order.
    assert (left[1] < 0.3 * left[0]).all() and left[1].max() < 2e-2


def random_models(branching, count, nb=4):
    """Random trees of one topology, with damping."""
    for seed in range(count):
        model = jd.robots.random_tree(seed, nb, branching=branching, kinds=("revolute",))
        yield model.replace(damping=jnp.asarray(np.random.default_rng(seed).uniform(0.2, 1.0, nb)))


def covered(branching, count):
    """How many of the true numbers lie in their 95 % intervals, and how many numbers there are: 1 % noise of torques."""
    inside = total = 0
    t = np.linspace(0.0, 4.0, 81)
    for seed, true in enumerate(random_models(branching, count)):
        q, v, a, tau = driven(true, t, seed)
        noise = np.random.default_rng(100 + seed).normal(size=tau.shape)
        log = jd.identify.Log(t, q, v, a, tau + 0.01 * np.sqrt(np.mean(tau**2, 0)) * noise)
        scene = scene_of(true)
        tree = jd.identify.Parameters(scene).positive(lambda s: s.forces[0]).inertias(shape="mass", metric=None)
        fit = jd.identify.fit_parameters(scene, log, tree, objective=jd.identify.Objective("torque"))
        rows = [i for i, name in enumerate(fit.names) if name.startswith("forces") or name.endswith(" m")]
        far = np.abs(fit.values - fit.nominal_values)[rows] / fit.deviation[rows]
        inside, total = inside + int(np.sum(far < 1.96)), total + len(rows)
    return inside, total


@pytest.mark.long
def test_intervals_cover_the_truth_on_a_few_trees():
    inside, total = covered(2.0, 4)
    assert total == 32 and inside >= 27  # fewer than 27 of 32 at 95 % has a probability of 1 %


@pytest.mark.slow
@pytest.mark.parametrize("branching", [1.0, 2.0])
def test_intervals_cover_the_truth_on_arms_and_trees(branching):
    inside, total = covered(branching, 20)
    assert 0.90 <= inside / total <= 0.99


@pytest.mark.long
def test_geometry_gravity_and_sensors_are_found_together(log):
    """Length, direction of gravity, an encoder's bias, gains and a delay, all at once, with the inertias known."""
    true = scene_of(arm())
    t, delay, gain, bias = T, 0.013, np.array([1.1, 0.8, 1.3]), np.array([0.02, -0.03, 0.05])
    q, v, a, _ = driven(arm(), t)
    tau = driven(arm(), t + delay)[3]  # the log says so early what acts
    recorded = jd.identify.Log(t, q + bias, v, a, tau / gain)
    tilt = jd.so3.exp(jnp.array([0.02, -0.03, 0.0]))
    wrong = eqx.tree_at(
        lambda s: (s.system.home, s.system.gravity),
        true,
        (true.system.home.at[1, 0, 3].set(0.45), tilt @ true.system.gravity),
    )
    measured = jd.identify.Measured(wrong)
    points = (
        jd.identify.Parameters(measured)
        .positive(lambda m: m.torque_gain)
        .bound(lambda m: m.delay, -0.05, 0.05)
        .free(lambda m: m.position_bias, rows=[1, 2])
        .poses(lambda m: m.scene.system.home, rows=["link1"], std=1.0)
        .directions(lambda m: m.scene.system.gravity)
    )
    fit = jd.identify.fit_parameters(
        measured,
        recorded,
        points,
        objective=jd.identify.Objective("torque", noise=1e-6),
        solver=jd.identify.Solver(tolerance=1e-12),
    )
    computed = dict(zip(fit.names, fit.values, strict=True))
    np.testing.assert_allclose([computed[f"torque_gain[{i}]"] for i in range(3)], gain, rtol=2e-2)
    # Torques between samples are taken as linear, which is what is left.
    np.testing.assert_allclose(computed["delay"], delay, atol=1e-3)
    assert fit.history[-1] < 1e-4 * fit.history[0] and fit.result == jd.RESULTS.successful
    assert fit.error(recorded) < 5


@pytest.mark.long
def test_a_length_that_enters_everywhere_is_found(log):
    """The length of the links moves joints and, with a mass per length, bodies: one number of a construction."""

    def build(numbers):
        length = numbers["length"]
        builder = jd.ModelBuilder("arm")
        for i, axis in enumerate(((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.3, 1.0, 0.0))):
            body = jd.inertia.displaced(
                jd.inertia.box(numbers["density"] * length, (length, 0.1, 0.1)), (0.5 * length, 0, 0)
            )
            place = (length, 0.0, 0.0) if i else None
            builder.add_body(f"link{i}", f"link{i - 1}" if i else None, "revolute", body, axis=axis, pose=place)
        return builder.build()

    true = build({"length": 0.4, "density": 3.0})
    t = np.linspace(0.0, 2.0, 41)
    q, v, a, tau = driven(true.replace(damping=jnp.zeros(3)), t)
    recorded = jd.identify.Log(t, q, v, a, tau / 1.2)
    links = jd.identify.Construction(build, {"length": 0.5, "density": 2.0})
    # The gain of the torques is known to a part in a thousand: with it alone no mass would be told apart.
    measured = jd.identify.Measured(links, torque_gain=[1.2] * 3)
    tree = jd.identify.Parameters(measured).positive(lambda m: list(m.scene.numbers.values()))
    fit = jd.identify.fit_parameters(
        measured, recorded, tree, objective=jd.identify.Objective("torque"), solver=jd.identify.Solver(tolerance=1e-14)
    )
    assert fit.names == ("scene.numbers['density']", "scene.numbers['length']")
    np.testing.assert_allclose(fit.values, [3.0, 0.4], rtol=1e-9)
    assert fit.error(recorded) < 1e-6
    np.testing.assert_allclose(fit.scene.system.inertias, true.inertias, rtol=1e-8, atol=1e-12)
    alone = jd.identify.fit_parameters(
        links,
        jd.identify.Log(t, q, v, a, tau),
        objective=jd.identify.Objective("torque"),
        solver=jd.identify.Solver(steps=3),
        positive=lambda links: links.numbers["length"],
    )
    assert alone.values.shape == (1,)
    with pytest.raises(ValueError, match="build is 3; give a function"):
        jd.identify.Construction(3, {})
    with pytest.raises(ValueError, match="numbers has 'long'"):
        jd.identify.Construction(build, {"length": "long"})


class Tracking(eqx.Module):
    """Proportional and derivative gains about a moving reference, as logged."""

    gain: float = 15.0

    def __call__(self, q, v, t):
        phase = jnp.array([0.0, 1.0])
        return self.gain * (0.4 * jnp.sin(3 * t + phase) - q) + 1.0 * (1.2 * jnp.cos(3 * t + phase) - v)


@pytest.mark.long
def test_numbers_of_a_controlled_arm_by_its_motion_in_closed_loop():
    """Damping and a mass from a log under a controller; its torques are part of what is compared."""
    true, law, t = scene_of(arm(mass=(2.0, 0.5))), Tracking(), np.linspace(0.0, 1.0, 26)
    motion = jd.simulate(
        true,
        jnp.zeros(2),
        jnp.zeros(2),
        jnp.asarray(t),
        control=law,
        outputs=("torque",),
        stepsize=jd.simulation.Steps(rtol=1e-10, atol=1e-10),
    )
    log = jd.identify.Log(t, *(np.asarray(x) for x in (motion.q, motion.v, np.zeros((26, 2)), motion.torque)))
    wrong = scene_of(arm(mass=(2.0, 0.8), damping=(0.5, 0.5)))
    tree = jd.identify.Parameters(wrong).positive(lambda s: s.forces[0]).inertias(["link1"], shape="mass", metric=None)
    objective = jd.identify.Objective("closed-loop", horizon=25, substeps=8, control=law)
    fit = jd.identify.fit_parameters(wrong, log, tree, objective, jd.identify.Solver(tolerance=1e-10))
    computed = dict(zip(fit.names, fit.values, strict=True))
    damping = [value for name, value in computed.items() if name.startswith("forces")]
    np.testing.assert_allclose(damping, [0.3, 0.2], rtol=2e-3)
    np.testing.assert_allclose(fit.scene.system.inertias[1, 0], 0.5, rtol=1e-4)
    # Per cent; what steps of 5 ms leave.
    assert fit.result == jd.RESULTS.successful and jd.identify.parameter_error(fit.system, log, objective) < 1e-2
