"""Stiff motion: the first step, methods for stiff equations, detection of stiffness, and what each solver makes of the cases."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from mechanisms import slider
from motion_helpers import central_difference, within
from pinocchio_bridge import quick

import jaxdyn as jd
from benchmarks.extremes import name_of
from benchmarks.stiff import SOLVERS, cases, reference, runner
from jaxdyn.compile import inverse, kernel
from jaxdyn.model.configuration import map_joints
from jaxdyn.simulation.solvers.diffrax_methods import _A, _C, _GAMMA, _RATE, _TIME, _local_rate

# ---------------------------------------------------------------------------------------------------------------------
# The first step


def test_first_step_is_the_same_in_any_unit_of_time():
    """Ten radians of an oscillation of rate w: the same steps for every w, none of them rejected.

    A first step of a fixed length would be rejected at w = 1e6 until it is short enough, and be lost at w = 1e-6.
    """
    model = slider()

    @quick
    @jax.vmap
    def run(w):
        scene = jd.Scene(model, forces=(jd.forces.JointSpring(w * w),))
        start = jnp.ones(1), 0.5 * w[None]
        # Without atol, which is not the same for m/s in all units of time; powers of two make the numbers the same.
        return jd.simulate(
            scene, *start, jnp.stack([0 * w, 10 / w]), stepsize=jd.simulation.Steps(atol=1e-30), throw=False
        )

    computed = run(2.0 ** np.array([0, 20, -20]))
    assert computed.success.all()
    assert len({int(n) for n in computed.stats["num_steps"]}) == 1
    np.testing.assert_array_equal(computed.stats["num_rejected_steps"], 0)
    np.testing.assert_allclose(computed.q[:, -1, 0], np.cos(10) + 0.5 * np.sin(10), rtol=1e-7)


# ---------------------------------------------------------------------------------------------------------------------
# The Rosenbrock method


def test_coefficients_of_the_rosenbrock_method():
    """Order conditions, in the form k_i = f(y0 + h sum alpha k) + h J sum beta' k: U = Gamma k h."""
    gamma = np.linalg.inv(np.eye(8) / _GAMMA - _C)
    alpha, b = _A @ gamma, (_A[-1] + np.eye(8)[-1]) @ gamma
    embedded = _A[-1] @ gamma
    beta, one = alpha + gamma, np.ones(8)
    np.testing.assert_allclose(alpha @ one, _TIME, atol=2e-13)
    np.testing.assert_allclose(gamma @ one, _RATE, atol=2e-13)
    np.testing.assert_allclose(np.diag(gamma), _GAMMA, rtol=1e-14)
    # Stiffly accurate: the last row of beta is b.
    np.testing.assert_allclose(beta[-1], b, atol=1e-12)
    c, bb = alpha @ one, beta @ one
    trees = {
        1: [(one, 1)],
        2: [(bb, 1 / 2)],
        3: [(c**2, 1 / 3), (beta @ bb, 1 / 6)],
        4: [(c**3, 1 / 4), (c * (alpha @ bb), 1 / 8), (beta @ c**2, 1 / 12), (beta @ beta @ bb, 1 / 24)],
        5: [
            (c**4, 1 / 5),
            (c**2 * (alpha @ bb), 1 / 10),
            ((alpha @ bb) ** 2, 1 / 20),
            (c * (alpha @ c**2), 1 / 15),
            (c * (alpha @ beta @ bb), 1 / 30),
            (beta @ c**3, 1 / 20),
            (beta @ (c * (alpha @ bb)), 1 / 40),
            (beta @ beta @ c**2, 1 / 60),
            (beta @ beta @ beta @ bb, 1 / 120),
        ],
    }
    for order, conditions in trees.items():
        for vector, value in conditions:
            assert abs(b @ vector - value) < 1e-11, (order, b @ vector, value)
            if order < 5:
                assert abs(embedded @ vector - value) < 1e-11, (order, embedded @ vector, value)
    assert max(abs(embedded @ vector - value) for vector, value in trees[5]) > 1e-4  # the estimate is of order 4
    # L-stable: R(z) = 1 + z b (1 - z beta)^-1 1 is at most 1 on the imaginary axis, and goes to 0.
    z = 1j * np.logspace(-2, 6, 200)
    size = [abs(1 + x * b @ np.linalg.solve(np.eye(8) - x * beta, one)) for x in z]
    assert max(size) < 1 + 1e-9 and size[-1] < 1e-4


# ---------------------------------------------------------------------------------------------------------------------
# Steps in local coordinates


@pytest.fixture(scope="module")
def bodies():
    """A joint of every group."""
    builder = jd.ModelBuilder("bodies", gravity=None)
    for kind in ("revolute", "planar", "spherical", "free"):
        axis = {"axis": (0, 0, 1)} if kind == "revolute" else {}
        builder.add_body(kind, joint=kind, inertia=(1.0, (0, 0, 0), (1.0, 2.0, 2.5)), **axis)
    return builder.build()


@pytest.mark.long
def test_local_coordinates_move_as_the_velocity_says(bodies):
    """The derivative of q0 exp(e) along de/dt is the dq/dt that it was made from."""
    rng = np.random.default_rng(0)
    q0, (e, v) = jd.random_configuration(bodies, jax.random.key(0)), rng.normal(size=(2, bodies.nv))

    @quick
    def both(e, v):
        q = jd.integrate(bodies, q0, e)
        rate = jd.configuration_rate(bodies, q, v)
        local = map_joints(bodies.topology, _local_rate, q, (rate, True), (e, False))
        return rate, jax.jvp(lambda e: jd.integrate(bodies, q0, e), (e,), (local,))[1]

    np.testing.assert_allclose(*both(e, v), rtol=1e-13, atol=1e-14)


@pytest.fixture(scope="module")
def ball():
    """A body on a ball joint."""
    builder = jd.ModelBuilder("ball", gravity=None)
    builder.add_body("ball", joint="spherical", inertia=(1.0, (0, 0, 0), (1.0, 2.0, 2.5)))
    return builder.build()


def turning(ball):
    """A made-up motion on the manifold of a model that ends with a quaternion."""

    def rates(t, y, args):
        q, v = y["q"], y["v"]
        push = jnp.sin(3 * t) + jnp.sum(q[-4:] * jnp.asarray([0.3, -0.2, 0.5, 0.1])) + jnp.cos(q[0])
        return {"q": jd.configuration_rate(ball, q, v), "v": args * jnp.roll(v, 1) * v[0] + push}

    return diffrax.ODETerm(rates)


def turned(ball, h, solver):
    """The state at two times from a fixed start, by steps of length h."""
    y0 = {"q": jnp.asarray([0.5, 0.5, -0.5, 0.5]), "v": jnp.asarray([1.0, 1.5, 2.0])}
    saveat = diffrax.SaveAt(ts=jnp.asarray([0.33, 1.0]))
    solution = diffrax.diffeqsolve(turning(ball), solver, 0.0, 1.0, h, y0, 0.2, saveat=saveat, max_steps=64)
    return jnp.concatenate([solution.ys["q"], solution.ys["v"]], 1)


@pytest.fixture(scope="module")
def turned_exactly(ball):
    return np.asarray(quick(lambda h: turned(ball, h, diffrax.Dopri8()))(1 / 60))


IMPLICIT = diffrax.Kvaerno3(root_finder=optimistix.Newton(1e-13, 1e-13))


@pytest.mark.long
@pytest.mark.parametrize(
    ("solver", "order"),
    [
        pytest.param(diffrax.Dopri5(), 5, marks=pytest.mark.slow),
        (jd.solvers.Rodas5P(), 5),
        pytest.param(IMPLICIT, 3, marks=pytest.mark.slow),
    ],
    ids=["Dopri5", "Rodas5P", "Kvaerno3"],
)
def test_order_in_local_coordinates(ball, turned_exactly, solver, order):
    """The order is kept, at steps and between them, and quaternions are of unit length without a projection."""
    run = quick(jax.vmap(lambda h: turned(ball, h, jd.solvers.LieGroup(solver).for_system(ball))))
    computed = np.asarray(run(jnp.asarray([1 / 10, 1 / 20, 1 / 40])))
    np.testing.assert_allclose(np.linalg.norm(computed[..., :4], axis=-1), 1, rtol=1e-14)
    error = np.abs(computed - turned_exactly).max(2)
    assert np.log2(error[:-1, 1] / error[1:, 1]).min() > order - 0.35, error
    # Between steps the error depends on where the point is in its step, so over both halvings.
    assert np.log2(error[0, 0] / error[2, 0]) / 2 > order - 0.8, error


@pytest.mark.slow
def test_gradient_of_an_implicit_step_in_local_coordinates(ball):
    """Both modes through one step of Rodas5P against differences, and finite at rest."""
    solver, term = jd.solvers.LieGroup(jd.solvers.Rodas5P()).for_system(ball), turning(ball)

    def end(z):
        y0, h = {"q": z[:4] / jnp.sqrt(jnp.sum(z[:4] ** 2)), "v": z[4:]}, jnp.asarray(0.2)
        y1 = solver.step(term, jnp.zeros(()), h, y0, jnp.asarray(0.2), None, False)[0]
        return jnp.sum(jnp.concatenate([y1["q"], y1["v"]]) * jnp.arange(1.0, 8.0))

    point = jnp.asarray([0.9, 0.3, -0.1, 0.3, 1.0, -2.0, 3.0])
    slope = central_difference(quick(jax.vmap(end)), np.asarray(point), 1e-3)
    rest = jnp.asarray([1.0, 0, 0, 0, 0, 0, 0])
    reverse, forward = quick(jax.vmap(lambda z: (jax.grad(end)(z), jax.jacfwd(end)(z))))(jnp.stack([point, rest]))
    np.testing.assert_allclose(reverse[0], slope, rtol=0, atol=1e-9 * np.abs(slope).max())
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12)
    assert np.isfinite(reverse).all() and np.any(reverse[1])


# ---------------------------------------------------------------------------------------------------------------------
# Stiffness, and what is made of it


def roots(mass, damping, spring):
    """Rates of m a + d v + k q = 0."""
    values = np.roots([mass, damping, spring])
    return max(0.0, -values.real.min()), np.abs(values.imag).max()


@pytest.mark.parametrize("damping", [0.0, 3.0, 4e3])
def test_stiffness_is_that_of_the_linear_system(damping):
    scene = jd.Scene(slider(2.0), forces=(jd.forces.JointSpring(200.0), jd.forces.JointDamping(damping)))
    np.testing.assert_allclose(
        jd.stiffness(scene, [0.3], [1.0])[:2], roots(2.0, damping, 200.0), rtol=1e-10, atol=1e-12
    )
    estimate = jd.stiffness(jd.Scene(slider(2.0)), [0.0], [0.0], 0.0, lambda q, v, t: -200.0 * q - damping * v)
    np.testing.assert_allclose(estimate[:2], roots(2.0, damping, 200.0), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("damping", [0.0, 20.0, 400.0, 2e4])
def test_steps_above_the_explicit_one_are_unstable(damping):
    """An oscillator of 1000 rad/s, undamped to overdamped, 1000 fixed steps of Dopri8 on both sides of the bound."""
    scene = jd.Scene(slider(1.0), forces=(jd.forces.JointSpring(1e6), jd.forces.JointDamping(damping)))
    longest = float(jd.stiffness(scene, [0.1], [0.0]).explicit_step)
    assert 3.5 < longest * max(1e3, damping) < 5.5

    def end(factor):
        h = factor * longest
        ts = jnp.asarray([0.0, 1000 * h])
        return jd.simulate(scene, [0.1], [0.0], ts, solver=diffrax.Dopri8(), stepsize=h, throw=False)

    within, beyond = end(0.97), end(1.15)
    assert abs(float(within.q[-1, 0])) < 0.1 * np.exp(1000 * 1e-3)
    assert not abs(float(beyond.q[-1, 0])) < 1e3 and not bool(beyond.success)


def test_stiffness_on_constraints():
    """Two masses that a gear holds together move as one; with a ratio the damper of the second counts by its square."""
    builder = jd.ModelBuilder("pair", gravity=None)
    for name, mass in (("a", 1.0), ("b", 3.0)):
        builder.add_body(name, joint="prismatic", axis=(1, 0, 0), inertia=(mass, (0, 0, 0), (0, 0, 0)))
    forces = (jd.forces.JointSpring(1e4), jd.forces.JointDamping(jnp.asarray([0.0, 5e3])))
    scene = jd.Scene(builder.build(), (jd.Pfaffian(two_to_one),), forces)
    estimate = jd.stiffness(scene, [0.0, 0.0], [0.0, 0.0])
    # The constraint leaves two eigenvalues zero, which LAPACK gives to rounding of the largest: 1.5e3 times 2e-16.
    np.testing.assert_allclose(estimate[:2], roots(1 + 4 * 3, 4 * 5e3, 5 * 1e4), rtol=1e-10, atol=1e-11)
    with pytest.raises(ValueError, match="q has shape"):
        jd.stiffness(scene, [0.0], [0.0, 0.0])


def test_stiffness_counts_the_poles_of_drives():
    """A law behind a lag: T m s^3 + m s^2 + d s + k; behind two states m s^2 (s^2 + 2 zeta w s + w^2) + w^2 (d s + k)."""
    mass, spring, damping, T, w, zeta = 2.0, 800.0, 30.0, 1e-3, 300.0, 0.4

    def law(q, v, t):
        return -spring * q - damping * v

    def rates(polynomial):
        values = np.roots(polynomial)
        return -values.real.min(), np.abs(values.imag).max()

    lag = jd.Scene(slider(mass), forces=(jd.forces.FirstOrderDrive(T),))
    one = rates([T * mass, mass, damping, spring])
    np.testing.assert_allclose(jd.stiffness(lag, [0.1], [0.2], 0.0, law)[:2], one, rtol=1e-10)
    np.testing.assert_allclose(jd.stiffness(lag, [0.1], [0.2])[:2], (1 / T, 0), rtol=1e-10)
    second = jd.Scene(slider(mass), forces=(jd.forces.SecondOrderDrive(w, zeta),))
    two = rates([mass, 2 * zeta * w * mass, w * w * mass, w * w * damping, w * w * spring])
    np.testing.assert_allclose(jd.stiffness(second, [0.1], [0.2], 0.0, law)[:2], two, rtol=1e-10)
    # At a torque beyond the limit behind the drive, the law does not act.
    limited = jd.Scene(slider(mass), forces=(jd.forces.FirstOrderDrive(T), jd.forces.EffortLimits(5.0)))
    free, cut = (jd.stiffness(limited, [0.1], [0.2], 0.0, law, drive_state=[z]).frequency for z in (1.0, 9.0))
    np.testing.assert_allclose([free, cut], [one[1], 0.0], rtol=1e-10, atol=1e-7)
    batch = jax.jit(
        jax.vmap(lambda T: jd.stiffness(jd.Scene(slider(mass), forces=(jd.forces.FirstOrderDrive(T),)), [0.1], [0.2]))
    )
    np.testing.assert_allclose(batch(jnp.asarray([1e-3, 1e-2])).decay, [1e3, 1e2], rtol=1e-10)
    with pytest.raises(ValueError, match="drive_state has shape"):
        jd.stiffness(lag, [0.1], [0.2], drive_state=[0.0, 0.0])
    with pytest.raises(ValueError, match="has no drives"):
        jd.stiffness(slider(mass), [0.1], [0.2], drive_state=[0.0])


@pytest.mark.long
def test_stiffness_has_derivatives():
    """Of the decay d/m of a damper alone."""
    decay = lambda d: jd.stiffness(jd.Scene(slider(2.0), forces=(jd.forces.JointDamping(d),)), [0.0], [0.0]).decay  # noqa: E731
    np.testing.assert_allclose(jax.vmap(jax.value_and_grad(decay))(jnp.asarray([3.0, 5.0])), [[1.5, 2.5], [0.5, 0.5]])


def test_steps_below_the_bound_of_a_drive_are_stable():
    """RK4 of a drive of 1 ms is stable up to 2.785 ms, 0.54 of Dopri8's bound, whatever the mass."""
    scene = jd.Scene(slider(2.0), forces=(jd.forces.FirstOrderDrive(1e-3),))
    longest = float(jd.stiffness(scene, [0.1], [0.2]).explicit_step)

    def end(h):
        step = jd.stepper(scene, h)
        state = (jnp.asarray([0.1]), jnp.asarray([0.2]), jnp.asarray([1.0]))
        return jax.lax.fori_loop(0, 300, lambda _, y: step(y, jnp.zeros(1)), state)[2]

    assert abs(float(end(0.5 * longest)[0])) < 1e-3 < 1.0 < abs(float(end(0.58 * longest)[0]))


def test_stiffness_of_odd_states():
    """Nothing that moves, and forces that are not finite."""
    fixed = jd.ModelBuilder("fixed").add_body("base", joint="fixed").build()
    estimate = jd.stiffness(fixed, jnp.zeros(0), jnp.zeros(0))
    assert estimate.decay == 0 and estimate.frequency == 0 and estimate.explicit_step == np.inf
    with pytest.raises(ValueError, match="not finite at"):
        jd.stiffness(jd.Scene(slider(), forces=(lambda system, q, v, t: jnp.nan * q,)), [np.nan], [0.0])


def two_to_one(q, t):
    """Velocities with v1 = 2 v0."""
    return jnp.asarray([[2.0, -1.0]], q.dtype)


@pytest.mark.long
def test_default_solver_and_advice_follow_stiffness():
    """A spring with twice the critical damping: Dopri8 as long as it is slow, Rodas5P where it is not, and the numbers said."""
    case = cases()["spring"]

    def run(stiffness, **options):
        scene, control, q0, v0 = case.build(jnp.asarray(stiffness))
        return jd.simulate(
            scene, q0, v0, case.ts, control=control, stepsize=jd.simulation.Steps(max_steps=400), **options
        )

    for stiffness, solver in ((1e3, "Dopri8"), (1e9, "Rodas5P")):
        computed = run(stiffness)
        assert computed.solver == solver
        np.testing.assert_allclose(computed.q, case.exact(stiffness), rtol=0, atol=1e-10)
    with pytest.raises(RuntimeError, match=r"1.18e\+05 1/s.*4.38e-05"):
        run(1e9, solver=diffrax.Dopri8())


def test_advice_for_fixed_steps_names_the_decay():
    """Friction of a URDF on a link of 1e-4 kg m² decays at 0.3 / (0.01 * 1e-4) per second: steps of 1 ms are unstable."""
    builder = jd.ModelBuilder("wrist", gravity=(0.0, 0.0, 0.0))
    builder.add_body("flange", None, "revolute", (0.1, (0.0, 0.0, 0.0), (1e-4, 1e-4, 1e-4)), axis=(0, 0, 1))
    scene = jd.Scene(builder.build(), forces=(jd.forces.CoulombFriction(0.3, 0.01),))
    hold = jd.Sampled(lambda q, v, t: 0.5 - q, None, 0.002)
    start, ts = (jnp.zeros(1), jnp.zeros(1)), jnp.linspace(0.0, 0.1, 3)
    with pytest.raises(RuntimeError, match=r"stiff: the fastest decay is 3e\+05 1/s.*Rodas5P"):
        jd.simulate(scene, *start, ts, control=hold, stepsize=0.001)
    # Implicit steps need no such advice, and have none.
    jd.simulate(scene, *start, ts, control=hold, stepsize=0.001, solver=jd.solvers.Rodas5P(), throw=False)


@pytest.mark.long
def test_implicit_explicit_split():
    """A released spring with twice the critical damping, decays of 3e2 to 4e3 1/s: springs and dampers are implicit."""
    k = 1e6
    scene = jd.Scene(slider(), forces=(jd.forces.JointSpring(k), jd.forces.JointDamping(4 * k**0.5)))
    times = np.array([0.0, 1e-3, 1e-2, 1.0])
    solution = quick(lambda q: jd.simulate(scene, q, jnp.zeros(1), times, solver=diffrax.KenCarp4()))(jnp.ones(1))
    rate = k**0.5 * (-2 + np.sqrt(3) * np.array([1, -1]))
    weights = np.linalg.solve([[1, 1], rate], [1, 0])
    np.testing.assert_allclose(solution.q[:, 0], np.exp(np.outer(times, rate)) @ weights, rtol=0, atol=1e-6)
    assert solution.success and solution.solver == "KenCarp4" and solution.stats["num_steps"] < 400
    with pytest.raises(ValueError, match="adjoint is 'backsolve'"):
        jd.simulate(scene, [1.0], [0.0], times, solver=diffrax.KenCarp4(), adjoint="backsolve")


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", [diffrax.Dopri8(), pytest.param(jd.solvers.Rodas5P(), marks=pytest.mark.slow)], ids=["Dopri8", "Rodas5P"]
)
def test_gradient_of_a_whole_motion_of_adaptive_steps(solver):
    """Reverse mode over 200 to 900 steps from 45 checkpoints, forward mode, and differences, by a spring's stiffness.

    Reverse and forward mode are two programs, whose steps differ by the rounding of error estimates, and so their derivatives
    by the tolerance of 1e-8 (over the same steps: `test_differentiable.py`). Were the steps computed from a checkpoint others
    than the first time, reverse mode would be wrong by up to 3 % here.
    """
    builder = jd.ModelBuilder("pendulum")
    builder.add_body("rod", joint="revolute", axis=(0, 1, 0), inertia=(1.0, (0, 0, -0.5), (0.1, 0.1, 0.01)))
    model, ts = builder.build(), np.linspace(0.0, 10.0, 11)

    def end(log, adjoint=None):
        scene = jd.Scene(model, forces=(jd.forces.JointSpring(jnp.exp(log)), jd.forces.JointDamping(0.01)))
        options = {
            "solver": solver,
            "adjoint": adjoint,
            "stepsize": jd.simulation.Steps(max_steps=1024),
            "throw": False,
        }
        solution = jd.simulate(scene, jnp.asarray([2.5]), jnp.asarray([0.1]), ts, **options)
        return jnp.sum(solution.q * solution.v), solution.stats["num_steps"]

    def forward(log):
        return jax.jvp(lambda x: end(x, "forward"), (log,), (jnp.ones_like(log),), has_aux=True)

    logs, step = np.log([1.0, 10.0]), 1e-3
    reverse, steps = quick(jax.vmap(jax.grad(end, has_aux=True)))(logs)
    places = (logs + step * np.array([0.0, 1, -1, 2, -2])[:, None]).reshape(-1)
    values, slopes, counts = (np.asarray(x).reshape(5, 2) for x in quick(jax.vmap(forward))(places))
    np.testing.assert_allclose(steps, counts[0], rtol=0.01)
    assert steps.max() > 4 * 45 and steps.max() < 1024
    np.testing.assert_allclose(reverse, slopes[0], rtol=1e-7)
    # Errors of the motion at tolerances of 1e-8, which differ between neighbours.
    differences = (8 * (values[1] - values[2]) - (values[3] - values[4])) / (12 * step)
    np.testing.assert_allclose(reverse, differences, rtol=1e-4)


# ---------------------------------------------------------------------------------------------------------------------
# Gradients of many adaptive steps


@pytest.mark.long
def test_transient_at_the_start_in_single_precision():
    """A start that is over within a microsecond: steps there may be shorter than the end of the run could tell apart."""
    scene = jd.Scene(slider(), forces=(jd.forces.JointDamping(4e6), jd.forces.JointSpring(4e6)))
    single, start, ts = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), (scene, (1.0, 50.0), np.linspace(0, 2.0, 3))
    )
    solution = jd.simulate(single, start[0][None], start[1][None], ts, solver=jd.solvers.Rodas5P())
    assert solution.q.dtype == jnp.float32
    np.testing.assert_allclose(solution.q[:, 0], np.exp([0.0, -1.0, -2.0]), rtol=0, atol=3e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Verdicts


# How RK4 with steps of a millisecond ends at each stiffness of the table.
BY_RK4 = {
    "spring": ["successful"] * 2 + ["nonfinite_state"] * 3,
    "drive": ["successful"] * 2 + ["nonfinite_state"] * 2,
    "flexible_joint": ["successful"] * 2 + ["nonfinite_state"] * 3,
    "press": ["successful"] * 2 + ["coarse_steps"] * 2,
    "car_axis": ["successful"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_RK4)
def test_what_succeeds_is_right(name):
    """The table of docs/stiff.md: what is advised serves everywhere, and a run is right or ends with a code."""
    case = cases()[name]
    runs = {solver: runner(case, SOLVERS[solver]) for solver in ("Dopri8", "Kvaerno5", "Rodas5P", "RK4, 1 ms")}
    q, _, _ = reference(case, runs["Rodas5P"], runs["Kvaerno5"])
    codes = {}
    for solver, run in runs.items():
        computed, _, _, success, code = run(1e-8)
        codes[solver] = [name_of(x) for x in code]
        assert np.abs(computed - q).max((1, 2))[success].max() < 1e-6 * case.size
    assert codes["Dopri8" if name == "car_axis" else "Rodas5P"] == ["successful"] * len(case.values)
    assert codes["RK4, 1 ms"] == BY_RK4[name]


@pytest.mark.long
def test_stiff_scenes_with_dry_friction():
    """A block dragged over the ground by a stiff spring, until it stops: events, ends and gradients are those of Dopri8."""
    builder = jd.ModelBuilder("dragged", gravity=None)
    for name, mass in (("block", 1.0), ("hook", 0.1)):
        builder.add_body(name, joint="prismatic", axis=(1, 0, 0), inertia=(mass, (0, 0, 0), (0.1, 0.1, 0.1)))
    model, ts = builder.build(), jnp.linspace(0.0, 0.6, 4)

    def end(speed, solver, stiffness):
        def spring(system, q, v, t):
            pull = stiffness * (q[1] - q[0]) + 0.02 * stiffness * (v[1] - v[0])
            return jnp.stack([pull, -pull])

        scene = jd.Scene(model, forces=[spring, jd.contact.DryFriction(0.4, 9.81, 0)])
        motion = jd.simulate(scene, jnp.zeros(2), jnp.stack([speed, speed]), ts, solver=solver, stepsize=within(1e-9))
        return motion.q[-1, 0], (motion.stats["num_steps"], motion.v[-1])

    by_rodas = jax.jit(jax.value_and_grad(lambda v, k: end(v, jd.solvers.Rodas5P(), k), has_aux=True))
    (last, (_, v)), slope = by_rodas(1.0, 3e3)
    run = jax.jit(lambda v: end(v, diffrax.Dopri8(), 3e3)[0])
    by_dopri8 = [run(1.0 + d) for d in (-1e-3, 0.0, 1e-3)]
    np.testing.assert_allclose(v, 0, atol=1e-6)
    np.testing.assert_allclose(last, by_dopri8[1], rtol=1e-7)
    np.testing.assert_allclose(slope, (by_dopri8[2] - by_dopri8[0]) / 2e-3, rtol=1e-4)
    # A body with the mass of both would stop at m v^2 / (2 mu N), which the spring's stretch hardly changes.
    np.testing.assert_allclose(by_dopri8[1], 1.1 / (2 * 0.4 * 9.81), rtol=2e-2)
    assert by_rodas(1.0, 1e7)[0][1][0] < 300


@pytest.mark.native
def test_inverses_within_kernels():
    """By elimination without exchange of rows; samples whose pivots cancel are computed with exchanges."""
    rng = np.random.default_rng(3)
    matrices = rng.normal(size=(6, 5, 5)) + 4 * np.eye(5)
    matrices[1, 0, 0] = 0.0
    matrices[3, :2, :2] = 1.0
    computed = jax.jit(jax.vmap(lambda x: kernel(lambda _, x: inverse(x), fallback=lambda _, x: inverse(x))(None, x)))
    np.testing.assert_allclose(computed(matrices), np.linalg.inv(matrices), rtol=0, atol=1e-13)
