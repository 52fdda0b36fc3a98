"""`simulate`: order with retraction, balances, derivatives, batches, failures, refusals, an independent trajectory."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from pinocchio_bridge import ROBOTS, quick, to_jaxdyn
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaxdyn.building import ModelBuilder
from jaxdyn.dynamics import forward_dynamics, kinetic_energy, potential_energy
from jaxdyn.forces import CoulombFriction, JointDamping, JointSpring
from jaxdyn.kinematics import frame_pose
from jaxdyn.model import integrate, neutral
from jaxdyn.scene import Scene
from jaxdyn.simulate import RESULTS, simulate
from jaxdyn.solvers import RK4, ProjectedSolver

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
    builder = ModelBuilder("pendulum")
    builder.add_body("bob", joint="revolute", axis=(0, 1, 0), inertia=(1.0, (0, 0, -1.0), (0, 0, 0)))
    return builder.build()


@pytest.fixture(scope="module")
def leg():
    """A spherical and a revolute joint, so that q is no vector space."""
    builder = ModelBuilder("leg")
    moments = (0.02, 0.03, 0.04)
    builder.add_body("hip", joint="spherical", inertia=(1.0, (0, 0.1, -0.1), moments))
    builder.add_body("knee", "hip", "revolute", axis=(0, 1, 0), inertia=(0.5, (0, 0, -0.2), moments), pose=(0, 0, -0.4))
    builder.add_frame("foot", "knee", ((0.1, 0.0, -0.3), (0.2, 0.3, 0.4)))
    return builder.build()


Q0 = np.array([0.8, 0.4, -0.4, 0.2, 0.3])
V0 = np.array([0.5, -1.0, 0.7, 0.4])


# ---------------------------------------------------------------------------------------------------------------------
# Projection


def circle(t, y, args):
    return y / jnp.sqrt(jnp.sum(y * y)), diffrax.RESULTS.successful


def turning(t, y, args):
    return jnp.stack([-y[1], y[0]]) * (1 + 0.5 * y[0])


def test_projected_solver_steps_on_the_manifold_and_evaluates_the_first_stage_anew():
    """The carried stage of a first-same-as-last method belongs to the point before projection and must not be used."""
    term, solver = diffrax.ODETerm(turning), ProjectedSolver(diffrax.Tsit5(), circle)
    y0, h = jnp.asarray([0.6, 0.8]), 0.7

    @quick
    def two_steps(y0):
        state = solver.init(term, 0.0, h, y0, None)
        out = []
        for k in range(2):
            y1, _, dense, state, _ = solver.step(term, k * h, (k + 1) * h, y0, None, state, False)
            interpolation = solver.interpolation_cls(t0=jnp.asarray(k * h), t1=jnp.asarray((k + 1) * h), **dense)
            ends = [interpolation.evaluate(jnp.asarray(x)) for x in (k * h, (k + 1) * h)]
            out.append((y0, y1, dense["dense_info"]["k"][0] / h, dense["shift"], *ends))
            y0 = y1
        return out

    for before, y1, first_stage, shift, start, end in two_steps(y0):
        np.testing.assert_allclose(np.linalg.norm(y1), 1, rtol=1e-15)
        assert np.abs(shift).max() > 1e-6  # the projection does something
        np.testing.assert_allclose(first_stage, turning(0.0, before, None), rtol=1e-14)
        np.testing.assert_allclose(start, before, rtol=1e-14)
        np.testing.assert_allclose(end, y1, rtol=1e-14)


def test_projection_belongs_to_models_with_quaternions(pendulum, leg):
    """Nothing to retract, nothing compiled: a pendulum's program holds no square root but those of the step control."""

    def roots(model, q0, v0):
        program = jax.make_jaxpr(lambda q, v: simulate(model, q, v, [0.0, 1.0], stepsize=0.1).q)(q0, v0)
        return str(program).count(" sqrt ")

    assert roots(pendulum, np.zeros(1), np.zeros(1)) == 0
    assert roots(leg, Q0, V0) > 0


# Steps whose errors lie between rounding and the first terms of the expansion.
ORDERS = [
    (diffrax.Heun(), 2, [0.02, 0.01, 0.005]),
    (RK4(), 4, [0.1, 0.05, 0.025]),
    (diffrax.Tsit5(), 5, [0.1, 0.05, 0.025]),
    (diffrax.Dopri8(), 8, [0.4, 0.2, 0.1]),
    (diffrax.Kvaerno5(), 5, [0.1, 0.05, 0.025]),
]


@pytest.mark.parametrize(("solver", "order", "steps"), ORDERS, ids=lambda x: type(x).__name__)
def test_order_of_convergence_with_retraction(solver, order, steps):
    """A spinning top on a ball joint and an axisymmetric body in flight: all errors fall with h^order."""
    builder = ModelBuilder("bodies", gravity=None)
    builder.add_body("ball", joint="spherical", joint_name="a", inertia=(1.0, (0, 0, 0), MOMENTS))
    builder.add_body("flyer", joint="free", joint_name="b", inertia=(1.3, (0, 0, 0), SYMMETRIC))
    bodies = builder.build()
    start = np.array([0.9, 0.8, -0.5])
    q0 = np.concatenate([Q0[:4], [1.0, 2.0, 3.0], Q0[:4]])
    v0 = np.concatenate([start, [0.1, -0.4, 0.2], start])

    @quick
    @jax.vmap
    def run(h):
        tolerances = {"rtol": 1e-13, "atol": 1e-13}  # of the implicit method's inner iteration
        out = simulate(bodies, q0, v0, [0.0, 2.0], solver=solver, stepsize=h, max_steps=1024, **tolerances)
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
        slope = np.log2(error[:-1] / error[1:])
        assert slope.min() > order - 0.35, f"{name}: errors {error}, orders {slope}"


# ---------------------------------------------------------------------------------------------------------------------
# Against an independent trajectory, and against balances


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
    scene = Scene(model, forces=(JointDamping(2.0),))
    control = Feedback(jnp.asarray(0.4), jnp.asarray(push))
    found = simulate(scene, q0, v0, ts, control=control, rtol=1e-12, atol=1e-12)
    scale = np.abs(reference[:, robot.nq :]).max()
    np.testing.assert_allclose(found.q, reference[:, : robot.nq], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.v, reference[:, robot.nq :], rtol=0, atol=1e-9 * scale)


@pytest.fixture(scope="module")
def driven(leg):
    """The leg with damping, friction, a spring and a control, with every output."""
    forces = (JointDamping(0.1), CoulombFriction(0.2, v_s=0.3), JointSpring(1.5))
    control = Feedback(jnp.asarray(0.05), jnp.asarray([0.3, -0.2, 0.1, 0.4]))
    outputs = ("energy", "work", "power", "acceleration", "pose:foot")
    scene = Scene(leg, forces=forces)
    return (
        scene,
        control,
        simulate(scene, Q0, V0, np.linspace(0, 2, 401), control=control, rtol=1e-12, atol=1e-12, outputs=outputs),
    )


def test_energy_is_work(driven):
    solution = driven[2]
    energy, work, power = (np.asarray(x) for x in (solution.energy, solution.work, solution.power))
    assert np.ptp(energy) > 0.5 and work[0] == 0
    np.testing.assert_allclose(energy - energy[0], work, rtol=0, atol=1e-10 * np.abs(energy).max())
    # Simpson's rule over 200 pairs of steps of 5 ms: h^4 / 180 of a fourth derivative of order 1e3.
    simpson = np.concatenate([[0], np.cumsum(power[:-2:2] + 4 * power[1:-1:2] + power[2::2])]) * 0.005 / 3
    np.testing.assert_allclose(simpson, work[::2], rtol=0, atol=1e-7)


def test_outputs_are_those_of_the_saved_states(driven, leg):
    scene, control, solution = driven

    @quick
    @jax.vmap
    def direct(q, v, t):
        tau = control(q, v, t) + scene.applied_force(q, v, t)
        energy = kinetic_energy(leg, q, v) + potential_energy(leg, q)
        return energy, jnp.sum(tau * v), forward_dynamics(leg, q, v, tau), frame_pose(leg, q, "foot")

    expected = direct(solution.q, solution.v, solution.ts)
    found = solution.energy, solution.power, solution.acceleration, solution.poses["foot"]
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12)
    # dv/dt by central differences of step 5 ms, good to h^2 / 6 of the third derivative.
    rate = (solution.v[2:] - solution.v[:-2]) / 0.01
    np.testing.assert_allclose(rate, solution.acceleration[1:-1], rtol=0, atol=2e-2)
    np.testing.assert_allclose(np.linalg.norm(solution.q[:, :4], axis=1), 1, rtol=4e-16)
    np.testing.assert_array_equal(solution.q[0, 4:], Q0[4:])
    assert float(solution.stats["time_reached"]) == 2.0


def test_stiff_friction_with_an_implicit_method():
    """Dry friction smoothed over 1e-5 m/s: sinh(v / v_s) decays at level / (m v_s) = 5e4 1/s."""
    builder = ModelBuilder("slider", gravity=None)
    builder.add_body("box", joint="prismatic", axis=(1, 0, 0), inertia=(2.0, (0, 0, 0), (0, 0, 0)))
    scene = Scene(builder.build(), forces=(CoulombFriction(1.0, v_s=1e-5),))
    # It slides from 1 m/s at -0.5 m/s^2 and is at rest, all but v_s, at 2 s.
    ts = np.array([0.0, 0.5, 1.0, 1.9, 2.5, 4.0])
    solution = simulate(scene, [0.0], [1.0], ts, solver=diffrax.Kvaerno5(), rtol=1e-8, atol=1e-10)
    at_rest = ts > 2
    np.testing.assert_allclose(solution.v[~at_rest, 0], 1 - 0.5 * ts[~at_rest], rtol=0, atol=1e-7)
    np.testing.assert_allclose(solution.v[at_rest, 0], 0, atol=1e-8)
    np.testing.assert_allclose(solution.q[~at_rest, 0], (ts - ts**2 / 4)[~at_rest], rtol=0, atol=1e-7)
    np.testing.assert_allclose(solution.q[at_rest, 0], 1.0, rtol=0, atol=1e-6)
    # An explicit method would be held to steps of 3 / 5e4 s while at rest.
    assert solution.stats["num_steps"] < 2000


# ---------------------------------------------------------------------------------------------------------------------
# Derivatives and batches


def final(leg, masses, dq, v0, gain, push, **options):
    """A number that depends on everything: masses, start, and a control."""
    model = eqx.tree_at(lambda m: m.inertias, leg, leg.inertias * masses[:, None])
    scene = Scene(model, forces=(JointDamping(gain[0]), JointSpring(gain[1])))
    start = integrate(leg, jnp.asarray(Q0), dq)
    solution = simulate(scene, start, v0, [0.0, 0.3, 0.5], control=Feedback(gain[2], push), **options)
    return jnp.sum(solution.q[-1] * jnp.arange(1.0, 6.0)) + jnp.sum(solution.v[1:] * jnp.arange(1.0, 5.0)[None])


SIZES = (2, 4, 4, 3, 4)
POINT = np.concatenate([[1.0, 1.2], np.zeros(4), V0, [0.1, 1.5, 0.05], [0.3, -0.2, 0.1, 0.4]])
ADAPTIVE = {"rtol": 1e-11, "atol": 1e-11}
FIXED = {"stepsize": 0.05, "max_steps": 16}


def of_vector(leg, **options):
    ends = np.cumsum(SIZES)[:-1]
    return lambda z: final(leg, *jnp.split(z, ends), **options)


def central_difference(function, step=1e-4):
    """Fourth-order differences of a batched function about POINT, every coordinate in one call."""
    offsets = step * np.array([1, -1, 2, -2])[:, None, None] * np.eye(POINT.size)
    values = np.asarray(function(jnp.asarray((POINT + offsets).reshape(-1, POINT.size))))
    one, minus, two, minus_two = values.reshape(4, POINT.size, *values.shape[1:])
    return (8 * (one - minus) - (two - minus_two)) / (12 * step)


def test_reverse_mode_against_finite_differences(leg):
    """Masses, start, force coefficients and control, with adaptive steps; differences and batch from one program."""
    function = of_vector(leg, **ADAPTIVE)
    slope = central_difference(quick(jax.vmap(function)))
    gradient = np.asarray(quick(jax.grad(function))(jnp.asarray(POINT)))
    assert np.abs(slope).min() > 1e-3  # every input matters
    # The steps are chosen anew at every shifted point, so the tolerance 1e-11 is seen through the step 1e-4.
    np.testing.assert_allclose(gradient, slope, rtol=1e-6, atol=1e-6)


def test_all_modes_agree(leg):
    """jvp = vjp, the Hessian is symmetric and the derivative of the gradient; finite at rest, where steps are exact."""
    direct, forward, reverse = (of_vector(leg, adjoint=name, **FIXED) for name in ("direct", "forward", "reverse"))

    @quick
    def modes(z):
        return jax.jacfwd(forward)(z), jax.grad(reverse)(z), jax.jacrev(direct)(z)

    @quick
    @jax.vmap
    def second(z):
        return jax.grad(direct)(z), jax.hessian(direct)(z)

    jacfwd, gradient, jacrev = modes(jnp.asarray(POINT))
    np.testing.assert_allclose(jacfwd, gradient, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(jacrev, gradient, rtol=1e-11, atol=1e-12)
    curvature = central_difference(lambda z: second(z)[0])
    hessian = np.asarray(second(jnp.asarray(np.tile(POINT, (4 * POINT.size, 1))))[1][0])
    np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-10 * np.abs(hessian).max())
    np.testing.assert_allclose(hessian, curvature, rtol=0, atol=1e-7 * np.abs(hessian).max())


def test_forward_mode_with_adaptive_steps_at_rest(leg):
    """Hanging at rest every error estimate is zero; derivatives stay finite, in forward mode and in reverse."""
    model = leg

    def end(mode):
        def function(v0):
            out = simulate(model, neutral(model), v0, [0.0, 0.2], adjoint=mode, max_steps=256)
            return jnp.concatenate([out.q[-1], out.v[-1]])

        return function

    rest = jnp.zeros(4)
    jacfwd, jacrev = quick(lambda v: (jax.jacfwd(end("forward"))(v), jax.jacrev(end("reverse"))(v)))(rest)
    assert np.isfinite(jacfwd).all() and np.any(jacfwd != 0)
    np.testing.assert_allclose(jacfwd, jacrev, rtol=1e-10, atol=1e-12)


def test_continuous_adjoint(pendulum):
    """Its gradients are those of the exact motion, to the tolerance of the solution."""

    def swing(z, adjoint):
        scene = Scene(pendulum, forces=(JointDamping(z[2]),))
        out = simulate(scene, z[:1], z[1:2], [0.0, 0.4, 0.8], adjoint=adjoint, rtol=1e-10, atol=1e-10)
        return jnp.sum(out.q) + jnp.sum(out.v)

    z = jnp.asarray([0.5, 0.3, 0.2])
    gradients = quick(lambda z: (jax.grad(swing)(z, "backsolve"), jax.grad(swing)(z, "reverse")))(z)
    np.testing.assert_allclose(*gradients, rtol=1e-7)


def lane(leg, q0, v0, mass, control):
    model = eqx.tree_at(lambda m: m.inertias, leg, leg.inertias * mass)
    scene = Scene(model, forces=(JointDamping(0.1),))
    return simulate(scene, q0, v0, np.linspace(0, 1, 5), control=control, outputs=("energy", "work"))


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
            # The same steps, but sums are vectorised differently.
            np.testing.assert_allclose(getattr(batch, name)[i], getattr(single, name), rtol=1e-10, atol=1e-11)
    np.testing.assert_array_equal(batch.success, [True, True, True, False, False])
    np.testing.assert_array_equal(batch.result == RESULTS.nonfinite_start, [False, False, False, True, True])
    assert np.isnan(batch.q[3:]).all() and np.isnan(batch.energy[3:]).all()


def test_float32(pendulum):
    single = jax.tree.map(lambda x: x.astype(jnp.float32), pendulum)
    solution = simulate(single, [1.0], [0.0], [0.0, 1.0, 2.0], outputs=("energy",))
    assert {x.dtype for x in (solution.q, solution.v, solution.ts, solution.energy)} == {jnp.dtype(jnp.float32)}
    # Tolerances of 1e-8 are raised to 1.2e-6, ten times the rounding error.
    np.testing.assert_allclose(solution.energy, -9.81 * np.cos(1.0), rtol=0, atol=2e-4)


# ---------------------------------------------------------------------------------------------------------------------
# Compilation, failures, refusals


def test_other_numbers_do_not_compile_anew(pendulum):
    """The control is traced once for all states, times, steps, tolerances, masses and coefficients."""
    traces = []

    def control(q, v, t):
        traces.append(1)
        return -0.1 * v

    def run(mass, coefficient, q0, end, step, rtol):
        model = pendulum.replace(inertias=pendulum.inertias * mass)
        scene = Scene(model, forces=(JointDamping(coefficient),))
        return simulate(scene, q0, [0.1], [0.0, 0.5, end], control=control, stepsize=step, rtol=rtol).q[-1, 0]

    first = run(1.0, 0.1, [0.2], 1.0, 0.02, 1e-8)
    count = len(traces)
    assert count > 0
    others = [
        run(2.0, 0.1, [0.2], 1.0, 0.02, 1e-8),
        run(1.0, jnp.asarray(0.3), np.asarray([0.2]), 1.1, 0.0203, 1e-7),
        run(1.0, np.float64(0.3), first[None], 1, jnp.asarray(0.02), 1),
    ]
    assert len(traces) == count
    assert len({float(x) for x in (first, *others)}) == 4


def test_known_numbers_stay_known_in_a_trace(pendulum):
    """Inside `jit` the leaves of a closed-over model reach the dynamics as numbers, which may be built into it."""
    seen = []

    def control(q, v, t):
        return jnp.zeros_like(v)

    def force(system, q, v, t):
        seen.append(isinstance(system.inertias, jax.core.Tracer))
        return jnp.zeros_like(v)

    scene = Scene(pendulum, forces=(force,))
    jax.jit(lambda q: simulate(scene, q, [0.0], [0.0, 0.1], control=control, stepsize=0.05).q).lower(jnp.zeros(1))
    assert seen and not any(seen)


def test_failures_are_codes_or_errors(pendulum):
    """Too few steps and a control that turns NaN, alone and in a batch; rows not reached are NaN."""
    ts = [0.0, 0.1, 0.5, 4.0]

    def control(q, v, t):
        return jnp.where(t > 0.3, jnp.nan, 0.0) + 0 * v

    with pytest.raises(
        RuntimeError, match=r"stopped at t = .* of 4 s.*maximum number of solver steps.*max_steps \(now 9\)"
    ):
        simulate(pendulum, [1.0], [0.0], ts, max_steps=9)
    short = simulate(pendulum, [1.0], [0.0], ts, max_steps=9, throw=False)
    assert short.result == RESULTS.max_steps_reached and not short.success
    reached = float(short.stats["time_reached"])
    np.testing.assert_array_equal(np.isnan(short.q[:, 0]), np.asarray(ts) > reached)
    assert 0.1 < reached < 4 and int(short.stats["num_steps"]) == 9
    with pytest.raises(RuntimeError, match=r"stopped at t = 0.(29|30)\d* s.*minimum step size.*singular mass matrix"):
        simulate(pendulum, [1.0], [0.0], ts, control=control)
    found = simulate(pendulum, [1.0], [0.0], ts, control=control, throw=False)
    assert found.result == RESULTS.dt_min_reached
    np.testing.assert_array_equal(np.isnan(found.v[:, 0]), [False, False, True, True])
    with pytest.raises(RuntimeError, match=r"became NaN or infinite.*smaller stepsize"):
        simulate(pendulum, [1.0], [0.0], ts, control=control, stepsize=0.05)


def test_a_derivative_that_is_nan_from_the_start_ends_soon(pendulum):
    """Without care the first step would be NaN and would be tried again until max_steps, with all other lanes waiting."""
    massless = jnp.asarray([1.0, 0.0])

    @quick
    @jax.vmap
    def run(mass):
        model = eqx.tree_at(lambda m: m.inertias, pendulum, pendulum.inertias * mass)
        return simulate(model, [1.0], [0.0], [0.0, 1.0])

    solution = run(massless)
    np.testing.assert_array_equal(solution.success, [True, False])
    assert solution.stats["num_steps"][1] < 100
    assert np.isnan(solution.q[1, 1]).all() and np.isfinite(solution.q[0]).all()


def test_throw_inside_jit(pendulum):
    run = jax.jit(lambda q: simulate(pendulum, q, [0.0], [0.0, 4.0], max_steps=5, throw=True).q)
    with pytest.raises(Exception, match="maximum number of solver steps"):
        jax.block_until_ready(run(jnp.ones(1)))


def test_progress_meter(pendulum, capfd):
    simulate(pendulum, [1.0], [0.0], [0.0, 0.5], stepsize=0.01, progress=True)
    jax.effects_barrier()
    shown = capfd.readouterr()
    assert "100.00%" in shown.out + shown.err


def nothing(q, v, t):
    return jnp.zeros(3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q0": [0.0, 0.0]}, r"q0 has shape \(2,\), expected \(5,\) = \(nq,\)"),
        ({"q0": np.zeros((3, 5))}, r"q0 has shape \(3, 5\).*one sample, use jax.vmap"),
        ({"v0": 0.0}, r"v0 has shape \(\), expected \(4,\) = \(nv,\)"),
        ({"q0": [1.0, 0, 0, 0, np.nan]}, "q0 is nan at index 4; give finite numbers"),
        ({"v0": [1.0, np.inf, 0, 0]}, "v0 is inf at index 1"),
        ({"q0": [1.0, 0.1, 0, 0, 0]}, "quaternion of length 1.00499 at joint 'hip_joint', expected 1; divide it"),
        ({"ts": []}, r"ts has shape \(0,\); pass the start and at least one later time"),
        ({"ts": [0.0]}, r"ts has shape \(1,\)"),
        ({"ts": [[0.0, 1.0]]}, r"ts has shape \(1, 2\)"),
        ({"ts": [0.0, np.nan, 1.0]}, "ts is nan at index 1; give finite times"),
        ({"ts": [0.0, 2.0, 1.0]}, "ts does not increase at index 2: 2.0 then 1.0; sort it"),
        ({"ts": [0.0, 1.0, 1.0]}, "ts does not increase at index 2"),
        ({"control": 3.0}, "control is 3.0, which cannot be called"),
        ({"control": nothing}, r"control returned shape \(3,\), expected \(4,\)"),
        ({"method": "schur"}, "method is 'schur'; a scene without constraints takes 'auto' or 'free'"),
        ({"solver": diffrax.Tsit5}, "solver is .*; pass an instance of a diffrax solver"),
        ({"solver": RK4()}, "solver RK4 has no error estimate for adaptive steps; pass stepsize="),
        ({"solver": diffrax.SemiImplicitEuler(), "stepsize": 0.1}, "SemiImplicitEuler does not take a single ODETerm"),
        ({"stepsize": -0.1}, "stepsize is -0.1; pass a positive number"),
        ({"stepsize": np.nan}, "stepsize is nan; pass a positive number"),
        ({"stepsize": [0.1, 0.2]}, r"stepsize has shape \(2,\); pass one number"),
        (
            {"stepsize": diffrax.ConstantStepSize()},
            "ConstantStepSize, which holds no length; pass the step as a number",
        ),
        ({"adjoint": "adjoint"}, "adjoint is 'adjoint'; choose one of reverse, direct, forward, backsolve"),
        ({"outputs": ("energy", "heat")}, "outputs has 'heat'; choose from energy, power"),
        ({"outputs": "energy"}, "outputs is the string 'energy'; pass a tuple"),
        ({"outputs": ("pose:fot",)}, "frame 'fot' is not in model 'leg'; did you mean foot"),
        ({"max_steps": 0}, "max_steps is 0; pass a positive integer"),
        ({"scene": 3}, "system is a int, which has no nq and nv"),
    ],
)
def test_refused(leg, arguments, message):
    given = {"scene": leg, "q0": Q0, "v0": V0, "ts": [0.0, 0.1]} | arguments
    with pytest.raises(ValueError, match=message):
        simulate(given.pop("scene"), given.pop("q0"), given.pop("v0"), given.pop("ts"), **given)


def test_constraints_are_refused(leg):
    scene = Scene(leg, constraints=(lambda q, t: q[:1],))
    with pytest.raises(ValueError, match="scene lists 1 constraints, and simulate has no constrained dynamics"):
        simulate(scene, Q0, V0, [0.0, 0.1])


def test_quaternions_near_unit_length_are_normalised(leg):
    """0.05 % off is taken for rounding in a file; the motion is that of the unit quaternion."""
    run = eqx.filter_jit(lambda q: simulate(leg, q, V0, [0.0, 0.1], stepsize=0.05).q)
    scaled = jnp.asarray(Q0 * np.array([1.0005] * 4 + [1.0]))
    np.testing.assert_allclose(run(scaled), run(jnp.asarray(Q0)), rtol=1e-14, atol=1e-15)
