"""`simulate`: order with retraction, balances, derivatives, batches, failures, refusals, an independent trajectory."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from motion_helpers import central_difference, within
from pinocchio_bridge import ROBOTS, assert_close, quick, to_jaxdyn
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxdyn as jd
from jaxdyn import events, scenes
from jaxdyn.simulation import motion

MOMENTS = np.array([1.0, 2.0, 3.0])
SYMMETRIC = np.array([0.4, 0.4, 0.2])


class Feedback(eqx.Module):
    """A control with leaves: tau = -gain v + push sin(3 t)."""

    gain: jax.Array
    push: jax.Array

    def __call__(self, q, v, t):
        return -self.gain * v + self.push * jnp.sin(3 * t)


@pytest.fixture(scope="module")
def pendulum():
    builder = jd.ModelBuilder("pendulum")
    builder.add_body("bob", joint="revolute", axis=(0, 1, 0), inertia=(1.0, (0, 0, -1.0), (0, 0, 0)))
    return builder.build()


@pytest.fixture(scope="module")
def leg():
    """A spherical and a revolute joint, so that q is no vector space."""
    builder = jd.ModelBuilder("leg")
    moments = (0.02, 0.03, 0.04)
    builder.add_body("hip", joint="spherical", inertia=(1.0, (0, 0.1, -0.1), moments))
    builder.add_body("knee", "hip", "revolute", axis=(0, 1, 0), inertia=(0.5, (0, 0, -0.2), moments), pose=(0, 0, -0.4))
    builder.add_frame("foot", "knee", ((0.1, 0.0, -0.3), (0.2, 0.3, 0.4)))
    return builder.build()


Q0 = np.array([0.8, 0.4, -0.4, 0.2, 0.3])
V0 = np.array([0.5, -1.0, 0.7, 0.4])


# ---------------------------------------------------------------------------------------------------------------------
# Projection


def circle(t, y, error, args):
    x = y["x"] / jnp.sqrt(jnp.sum(y["x"] ** 2))
    return {"x": x}, {"x": x}, {"x": error["x"] - x * jnp.sum(x * error["x"])}


def turning(t, y, args):
    x = y["x"]
    return {"x": jnp.stack([-x[1], x[0]]) * (1 + 0.5 * x[0])}


def test_projected_solver_steps_on_the_manifold_and_evaluates_the_first_stage_anew():
    """The carried stage of a first-same-as-last method belongs to the point before projection and must not be used."""
    term, solver = diffrax.ODETerm(turning), jd.solvers.ProjectedSolver(diffrax.Tsit5(), circle)
    y0, h = {"x": jnp.asarray([0.6, 0.8])}, 0.7

    @quick
    def two_steps(y0):
        state = solver.init(term, 0.0, h, y0, None)
        out = []
        for k in range(2):
            y1, error, dense, state, _ = solver.step(term, k * h, (k + 1) * h, y0, None, state, False)
            interpolation = solver.interpolation_cls(t0=jnp.asarray(k * h), t1=jnp.asarray((k + 1) * h), **dense)
            ends = [interpolation.evaluate(jnp.asarray(x)) for x in (k * h, (k + 1) * h)]
            first_stage = jax.tree.map(lambda k: k[0] / h, dense["dense_info"]["k"])
            out.append([y["x"] for y in (y0, y1, error, first_stage, dense["shift"], *ends)])
            y0 = y1
        return out

    for before, y1, error, first_stage, shift, start, end in two_steps(y0):
        np.testing.assert_allclose(np.linalg.norm(y1), 1, rtol=1e-15)
        assert np.abs(shift).max() > 1e-6  # the projection does something
        assert np.abs(error).max() > 1e-6
        assert abs(y1 @ error) < 1e-15  # and what it removes is no error
        np.testing.assert_allclose(first_stage, turning(0.0, {"x": before}, None)["x"], rtol=1e-14)
        np.testing.assert_allclose(start, before, rtol=1e-14)
        np.testing.assert_allclose(end, y1, rtol=1e-14)


def test_only_models_with_quaternions_are_retracted(pendulum, leg, monkeypatch):
    """Nothing to retract, nothing compiled."""
    wrapped = []

    def made(solver, project, *more, **fields):
        wrapped.extend([] if project is None else [project])
        return jd.solvers.LibrarySteps(solver, project, *more, **fields)

    monkeypatch.setattr(motion, "LibrarySteps", made)
    for model, size in ((pendulum, 0), (leg, 1)):
        q0, v0 = jd.neutral(model), jnp.zeros(model.nv)
        jax.make_jaxpr(lambda q, v, model=model: jd.simulate(model, q, v, [0.0, 1.0], stepsize=0.1).q)(q0, v0)
        assert len(wrapped) == size


# Steps whose errors lie between rounding and the first terms of the expansion.
ORDERS = [
    (jd.solvers.RK4(), 4, [0.1, 0.05, 0.025]),
    (diffrax.Dopri8(), 8, [1.0, 0.5, 0.25]),
    pytest.param(diffrax.Heun(), 2, [0.02, 0.01, 0.005], marks=pytest.mark.slow),
    pytest.param(diffrax.Tsit5(), 5, [0.1, 0.05, 0.025], marks=pytest.mark.slow),
    pytest.param(diffrax.Kvaerno5(), 5, [0.1, 0.05, 0.025], marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("solver", "order", "steps"), ORDERS, ids=lambda x: type(x).__name__)
def test_order_of_convergence_with_retraction(solver, order, steps):
    """A spinning top on a ball joint and an axisymmetric body in flight: all errors fall with h^order."""
    builder = jd.ModelBuilder("bodies", gravity=None)
    builder.add_body("ball", joint="spherical", joint_name="a", inertia=(1.0, (0, 0, 0), MOMENTS))
    builder.add_body("flyer", joint="free", joint_name="b", inertia=(1.3, (0, 0, 0), SYMMETRIC))
    bodies = builder.build()
    start = np.array([0.9, 0.8, -0.5])
    q0 = np.concatenate([Q0[:4], [1.0, 2.0, 3.0], Q0[:4]])
    v0 = np.concatenate([start, [0.1, -0.4, 0.2], start])

    @quick
    @jax.vmap
    def run(h):
        # Of the implicit method's inner iteration.
        tolerance = 1e-13 if isinstance(solver, diffrax.Kvaerno5) else None
        steps = jd.simulation.Steps(h, rtol=tolerance, atol=tolerance, max_steps=1024)
        out = jd.simulate(bodies, q0, v0, [0.0, 2.0], solver=solver, stepsize=steps)
        return out.q[-1], out.v[-1], out.success, out.stats["num_steps"]

    q, v, success, count = (np.asarray(x) for x in run(jnp.asarray(steps)))
    assert success.all()
    np.testing.assert_array_equal(count, np.round(2.0 / np.asarray(steps)))
    rotation = Rotation.from_quat(np.roll(Q0[:4], -1)).as_matrix()
    ball = Rotation.from_quat(np.roll(q[:, :4], -1, 1)).as_matrix() @ (MOMENTS * v[:, :3])[..., None]
    flyer = Rotation.from_quat(np.roll(q[:, 7:], -1, 1)).as_matrix()
    spin = (1 - SYMMETRIC[2] / SYMMETRIC[0]) * start[2] * np.array([0.0, 0.0, 1.0])
    turn = Rotation.from_rotvec(2 * SYMMETRIC * start / SYMMETRIC[0]) * Rotation.from_rotvec(2 * spin)
    place = q0[4:7] + 2 * rotation @ v0[3:6]
    errors = {
        "momentum": np.abs(ball[..., 0] - rotation @ (MOMENTS * start)).max(1),
        "orientation": np.abs(flyer - rotation @ turn.as_matrix()).max((1, 2)),
        "path": np.abs(q[:, 4:7] - place).max(1),
    }
    for name, error in errors.items():
        slope = np.log2(error[:-1] / error[1:])[error[1:] > 1e-12]  # above rounding
        assert slope.size and slope.min() > order - 0.35, f"{name}: errors {error}, orders {slope}"


# ---------------------------------------------------------------------------------------------------------------------
# Against an independent trajectory, and against balances


@pytest.mark.long
def test_panda_against_pinocchio_and_scipy():
    """One second of a Panda under damping and a torque, integrated by DOP853 on Pinocchio's ABA."""
    robot = pin.buildModelFromUrdf(f"{ROBOTS}/panda_description/urdf/panda.urdf")
    model, bridge = to_jaxdyn(robot)
    data, rng = robot.createData(), np.random.default_rng(2)
    q0, v0 = rng.uniform(-1, 1, robot.nq), rng.uniform(-1, 1, robot.nv)
    push = rng.uniform(-3, 3, robot.nv) * np.array([1] * 7 + [0.1] * 2)
    assert robot.nq == robot.nv == model.nq

    def rate(t, x):
        tau = push * np.sin(3 * t) - 0.4 * x[robot.nv :] - 2.0 * x[robot.nv :]
        return np.concatenate([x[robot.nv :], pin.aba(robot, data, x[: robot.nq], x[robot.nq :], tau)])

    ts = np.linspace(0, 1, 11)
    x0 = np.concatenate([bridge.q_to_pinocchio(q0), v0])
    reference = solve_ivp(rate, (0, 1), x0, "DOP853", ts, rtol=1e-12, atol=1e-12).y.T
    scene = jd.Scene(model, forces=(jd.forces.JointDamping(2.0),))
    control = Feedback(jnp.asarray(0.4), jnp.asarray(push))
    solution = jd.simulate(scene, q0, v0, ts, control=control, stepsize=within(1e-12))
    scale = np.abs(reference[:, robot.nq :]).max()
    np.testing.assert_allclose(solution.q, reference[:, : robot.nq], rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.v, reference[:, robot.nq :], rtol=0, atol=1e-9 * scale)


@pytest.fixture(scope="module")
def driven(leg):
    """The leg with damping, friction, a spring and a control, with every output."""
    forces = (jd.forces.JointDamping(0.1), jd.forces.CoulombFriction(0.05, v_s=0.5), jd.forces.JointSpring(1.5))
    control = Feedback(jnp.asarray(0.05), jnp.asarray([0.3, -0.2, 0.1, 0.4]))
    options = {
        "stepsize": within(1e-12),
        "outputs": ("energy", "work", "power", "acceleration", jd.simulation.Pose("foot")),
    }
    scene = jd.Scene(leg, forces=forces)
    return scene, control, jd.simulate(scene, Q0, V0, np.linspace(0, 2, 401), control=control, **options)


@pytest.mark.long
def test_energy_is_work(driven):
    solution = driven[2]
    energy, work = np.asarray(solution.energy), np.asarray(solution.work)
    assert np.ptp(energy) > 0.5 and work[0] == 0
    np.testing.assert_allclose(energy - energy[0], work, rtol=0, atol=1e-10 * np.abs(energy).max())


def test_outputs_are_those_of_the_saved_states(driven, leg):
    scene, control, solution = driven

    @quick
    @jax.vmap
    def direct(q, v, t):
        tau = control(q, v, t) + scene.applied_force(q, v, t)
        energy = jd.kinetic_energy(leg, q, v) + jd.potential_energy(leg, q)
        return energy, jnp.sum(tau * v), jd.forward_dynamics(leg, q, v, tau), jd.frame_pose(leg, q, "foot")

    expected = direct(solution.q, solution.v, solution.ts)
    computed = solution.energy, solution.power, solution.acceleration, solution.poses["foot"]
    for x, y in zip(computed, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12)
    q = np.asarray(solution.q)
    np.testing.assert_allclose(np.linalg.norm(q[:, :4], axis=1), 1, rtol=4e-16)
    np.testing.assert_array_equal(q[0, 4:], Q0[4:])
    assert float(solution.stats["time_reached"]) == 2.0


# ---------------------------------------------------------------------------------------------------------------------
# Derivatives and batches


SIZES = (2, 4, 4, 3, 4)
POINT = np.concatenate([[1.0, 1.2], np.zeros(4), V0, [0.1, 1.5, 0.05], [0.3, -0.2, 0.1, 0.4]])


def leg_end(leg, z, q0, **options):
    """A number that depends on everything: masses, start, force coefficients, and a control."""
    masses, dq, v0, gain, push = jnp.split(z, np.cumsum(SIZES)[:-1])
    model = eqx.tree_at(lambda m: m.inertias, leg, leg.inertias * masses[:, None])
    scene = jd.Scene(model, forces=(jd.forces.JointDamping(gain[0]), jd.forces.JointSpring(gain[1])))
    control = Feedback(gain[2], push)
    out = jd.simulate(scene, jd.integrate(leg, q0, dq), v0, [0.0, 0.3, 0.5], control=control, **options)
    return jnp.sum(out.q[-1] * jnp.arange(1.0, 6.0)) + jnp.sum(out.v[1:] * jnp.arange(1.0, 5.0)[None])


@pytest.mark.long
def test_reverse_mode_against_finite_differences(leg):
    """Masses, start, coefficients and control, with adaptive steps; and finite at rest, where error estimates vanish."""

    def function(z, q0):
        return leg_end(leg, z, q0, stepsize=within(1e-13))

    q0 = jnp.asarray(Q0)
    slope = central_difference(quick(jax.vmap(lambda z: function(z, q0))), POINT)
    reverse = quick(jax.grad(function))
    gradient = np.asarray(reverse(jnp.asarray(POINT), q0))
    assert np.abs(slope).min() > 1e-3  # every input matters
    # The steps are chosen anew at every shifted point, so the tolerance 1e-13 is seen through the step 1e-4.
    np.testing.assert_allclose(gradient, slope, rtol=1e-6, atol=1e-6)
    hanging = POINT * (np.arange(POINT.size) < 2)
    at_rest = np.asarray(reverse(jnp.asarray(hanging), jd.neutral(leg)))
    assert np.isfinite(at_rest).all() and np.any(at_rest)


def lane(leg, q0, v0, mass, control):
    model = eqx.tree_at(lambda m: m.inertias, leg, leg.inertias * mass)
    scene = jd.Scene(model, forces=(jd.forces.JointDamping(0.1),))
    return jd.simulate(scene, q0, v0, np.linspace(0, 1, 5), control=control, stepsize=0.01, outputs=("energy", "work"))


@pytest.mark.long
def test_batch_is_the_loop_and_one_bad_lane_stops_no_other(leg):
    """States, masses and controls in one batch; starts with NaN and with a null quaternion are reported as such."""
    q0 = np.tile(Q0, (5, 1)) + 0.1 * np.arange(5)[:, None] * [0, 0, 0, 0, 1]
    v0, masses = np.outer([1.0, 0.5, -0.3, 1.0, 1.0], V0), np.array([1.0, 1.3, 0.7, 1.0, 1.0])
    v0[3, 1], q0[4, :4] = np.nan, 0.0
    controls = Feedback(jnp.linspace(0.0, 0.2, 5), jnp.asarray(np.linspace(-1, 1, 20).reshape(5, 4)))
    inputs = jnp.asarray(q0), jnp.asarray(v0), jnp.asarray(masses), controls
    batch = quick(jax.vmap(lambda *x: lane(leg, *x)))(*inputs)
    one = quick(lambda *x: lane(leg, *x))
    for i in range(3):
        single = one(*jax.tree.map(lambda x, i=i: x[i], inputs))
        for name in ("q", "v", "energy", "work"):
            # Sums are vectorised differently.
            np.testing.assert_allclose(getattr(batch, name)[i], getattr(single, name), rtol=1e-10, atol=1e-11)
    np.testing.assert_array_equal(batch.success, [True, True, True, False, False])
    np.testing.assert_array_equal(batch.result == jd.RESULTS.nonfinite_start, [False, False, False, True, True])
    assert np.isnan(batch.q[3:]).all() and np.isnan(batch.energy[3:]).all()


def test_float32(pendulum):
    single = jax.tree.map(lambda x: x.astype(jnp.float32), pendulum)
    solution = jd.simulate(single, [1.0], [0.0], [0.0, 1.0, 2.0], outputs=("energy",))
    assert {x.dtype for x in (solution.q, solution.v, solution.ts, solution.energy)} == {jnp.dtype(jnp.float32)}
    # Tolerances of 1e-8 are raised to 1.2e-6, ten times the rounding error.
    np.testing.assert_allclose(solution.energy, -9.81 * np.cos(1.0), rtol=0, atol=2e-4)


# ---------------------------------------------------------------------------------------------------------------------
# Compilation, failures, refusals


@pytest.mark.parametrize(("name", "usual", "other", "array"), [("size", 0.02, 0.0203, 0.02), ("rtol", 1e-8, 1e-7, 1)])
def test_other_numbers_do_not_compile_anew(pendulum, name, usual, other, array):
    """The control is traced once, whatever the masses, coefficients, states, times, steps and tolerances."""
    traces = []

    def control(q, v, t):
        traces.append(1)
        return -0.1 * v

    def run(mass, coefficient, q0, end, number):
        model = pendulum.replace(inertias=pendulum.inertias * mass)
        scene = jd.Scene(model, forces=(jd.forces.JointDamping(coefficient),))
        return jd.simulate(
            scene, q0, [0.1], [0.0, 0.5, end], control=control, stepsize=jd.simulation.Steps(**{name: number})
        ).q[-1, 0]

    numbers = (1.0, 0.1, [0.2], 1.0, usual)
    first = run(*numbers)
    count = len(traces)
    assert count > 0
    again = run(1.0, 0.1, [0.3], 1.1, other)
    second = run(2.0, 0.1, [0.2], 1.0, usual)
    others = [
        run(1.0, jnp.asarray(0.3), np.asarray([0.2]), 1.1, other),
        run(1.0, np.float64(0.3), first[None], 1, jnp.asarray(array)),
    ]
    assert len(traces) == count
    assert len({float(x) for x in (first, again, second, *others)}) == 5


def test_known_numbers_stay_known_in_a_trace(pendulum):
    """Inside `jit` the leaves of a closed-over model reach the dynamics as numbers, which may be built into it."""
    seen = []

    def force(system, q, v, t):
        seen.append(isinstance(system.inertias, jax.core.Tracer))
        return jnp.zeros_like(v)

    scene = jd.Scene(pendulum, forces=(force,))
    jax.jit(lambda q: jd.simulate(scene, q, [0.0], [0.0, 0.1], stepsize=0.05).q).lower(jnp.zeros(1))
    assert seen and not any(seen)


@pytest.mark.long
def test_failures_are_codes_or_errors(pendulum):
    """Too few steps and a control that turns NaN, alone and in a batch; rows not reached are NaN."""
    ts = [0.0, 0.1, 0.5, 4.0]

    def control(q, v, t):
        return jnp.where(t > 0.3, jnp.nan, 0.0) + 0 * v

    with pytest.raises(RuntimeError, match=r"max_steps \(now 9\)"):
        jd.simulate(pendulum, [1.0], [0.0], ts, stepsize=jd.simulation.Steps(max_steps=9))
    short = jd.simulate(pendulum, [1.0], [0.0], ts, stepsize=jd.simulation.Steps(max_steps=9), throw=False)
    assert short.result == jd.RESULTS.max_steps_reached and not short.success
    reached = float(short.stats["time_reached"])
    np.testing.assert_array_equal(np.isnan(short.q[:, 0]), np.asarray(ts) > reached)
    assert 0.1 < reached < 4 and int(short.stats["num_steps"]) == 9
    with pytest.raises(RuntimeError, match=r"0\.(29\d*|3) s.*singular"):
        jd.simulate(pendulum, [1.0], [0.0], ts, control=control)
    solution = jd.simulate(pendulum, [1.0], [0.0], ts, control=control, throw=False)
    assert solution.result == jd.RESULTS.dt_min_reached
    np.testing.assert_array_equal(np.isnan(solution.v[:, 0]), [False, False, True, True])
    with pytest.raises(RuntimeError, match="NaN or infinite"):
        jd.simulate(pendulum, [1.0], [0.0], ts, control=control, stepsize=0.05)


def test_a_derivative_that_is_nan_from_the_start_ends_soon(pendulum):
    """Without care the first step would be NaN and would be tried again until max_steps, with all other lanes waiting."""
    massless = jnp.asarray([1.0, 0.0])

    @quick
    @jax.vmap
    def run(mass):
        model = eqx.tree_at(lambda m: m.inertias, pendulum, pendulum.inertias * mass)
        return jd.simulate(model, [1.0], [0.0], [0.0, 1.0])

    solution = run(massless)
    np.testing.assert_array_equal(solution.success, [True, False])
    assert solution.stats["num_steps"][1] < 100
    assert np.isnan(solution.q[1, 1]).all() and np.isfinite(solution.q[0]).all()


def test_throw_inside_jit(pendulum):
    run = jax.jit(
        lambda q: jd.simulate(pendulum, q, [0.0], [0.0, 4.0], stepsize=jd.simulation.Steps(max_steps=5), throw=True).q
    )
    with pytest.raises(Exception, match="number of solver"):
        jax.block_until_ready(run(jnp.ones(1)))


def test_progress_meter(pendulum, capfd):
    jd.simulate(pendulum, [1.0], [0.0], [0.0, 0.5], stepsize=0.01, events=[events.Progress()])
    jax.effects_barrier()
    shown = capfd.readouterr()
    assert "100.00%" in shown.out + shown.err


def nothing(q, v, t):
    return jnp.zeros(3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q0": [0.0, 0.0]}, "q0 has shape"),
        ({"q0": np.zeros((3, 5))}, "use jax.vmap"),
        ({"v0": 0.0}, "v0 has shape"),
        ({"q0": [1.0, 0, 0, 0, np.nan]}, "q0 is nan"),
        ({"v0": [1.0, np.inf, 0, 0]}, "v0 is inf"),
        ({"q0": [1.0, 0.1, 0, 0, 0]}, "quaternion of length"),
        ({"ts": []}, "ts has shape"),
        ({"ts": [0.0]}, "ts has shape"),
        ({"ts": [[0.0, 1.0]]}, "ts has shape"),
        ({"ts": [0.0, np.nan, 1.0]}, "ts is nan"),
        ({"ts": [0.0, 2.0, 1.0]}, "ts does not"),
        ({"ts": [0.0, 1.0, 1.0]}, "ts does not"),
        ({"control": 3.0}, "control is 3.0"),
        ({"control": nothing}, "control returned shape"),
        ({"method": "schur"}, "method is 'schur'"),
        ({"solver": diffrax.Tsit5}, "pass an instance"),
        ({"solver": jd.solvers.RK4()}, "no error estimate"),
        ({"solver": diffrax.SemiImplicitEuler(), "stepsize": 0.1}, "single ODETerm"),
        ({"stepsize": -0.1}, "stepsize is -0.1"),
        ({"stepsize": np.nan}, "stepsize is nan"),
        ({"stepsize": [0.1, 0.2]}, "stepsize has shape"),
        ({"stepsize": diffrax.ConstantStepSize()}, "holds no length"),
        ({"adjoint": "adjoint"}, "adjoint is 'adjoint'"),
        ({"outputs": ("energy", "heat")}, "outputs has 'heat'"),
        ({"outputs": "energy"}, "outputs is the"),
        ({"outputs": (jd.simulation.Pose("fot"),)}, "you mean foot"),
        ({"stepsize": jd.simulation.Steps(max_steps=0)}, "max_steps is 0"),
        ({"scene": 3}, "system is a"),
    ],
)
def test_refused(leg, arguments, message):
    given = {"scene": leg, "q0": Q0, "v0": V0, "ts": [0.0, 0.1]} | arguments
    with pytest.raises(ValueError, match=message):
        jd.simulate(given.pop("scene"), given.pop("q0"), given.pop("v0"), given.pop("ts"), **given)


def test_quaternions_near_unit_length_are_normalised(leg):
    """0.05 % off is taken for rounding in a file; the motion is that of the unit quaternion."""
    run = eqx.filter_jit(lambda q: jd.simulate(leg, q, V0, [0.0, 0.1], stepsize=0.05).q)
    scaled = jnp.asarray(Q0 * np.array([1.0005] * 4 + [1.0]))
    np.testing.assert_allclose(run(scaled), run(jnp.asarray(Q0)), rtol=1e-14, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize(
    "wrapped",
    [jd.solvers.LieGroup(diffrax.Tsit5()), pytest.param(diffrax.HalfSolver(diffrax.Tsit5()), marks=pytest.mark.slow)],
    ids=["Lie", "half"],
)
@pytest.mark.parametrize("name", ["free_body", pytest.param("rolling_coin", marks=pytest.mark.slow)])
def test_methods_that_wrap_an_explicit_one(wrapped, name):
    """In local coordinates, and with errors by halved steps: the motion is that of Dopri8, with and without constraints."""
    computed = getattr(scenes, name)
    state, ts = computed.start(), jnp.linspace(0.0, 0.5, 3)
    solutions = [jd.simulate(computed(), *state, ts, solver=solver) for solver in (diffrax.Dopri8(), wrapped)]
    assert_close(solutions[1].q, solutions[0].q, 1e-6)  # local errors of 1e-8 along the way
    assert_close(solutions[1].v, solutions[0].v, 1e-6)


@pytest.mark.long
def test_constraints_may_be_functions_that_hold_numbers_of_a_batch():
    """No leaf of the scene says that they do."""
    builder = jd.ModelBuilder("two slides", gravity=None)
    for name, axis in (("a", (1, 0, 0)), ("b", (0, 1, 0))):
        builder.add_body(name, joint="prismatic", axis=axis, inertia=(1.0, (0, 0, 0), MOMENTS))
    model = builder.build()

    def run(slope):
        scene = jd.Scene(model, (jd.Holonomic(lambda q, t: (q[0] - slope * q[1])[None]),))
        v = jnp.stack([slope, jnp.ones_like(slope)])
        return jd.simulate(scene, jnp.zeros(2), v, [0.0, 0.5], throw=False).q[-1]

    slopes = jnp.asarray([1.0, 2.0])
    np.testing.assert_allclose(jax.jit(jax.vmap(run))(slopes), 0.5 * jnp.stack([slopes, jnp.ones(2)], 1), rtol=1e-12)
