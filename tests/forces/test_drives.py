"""Drives: elastic joints, first- and second-order torque dynamics, torque-speed curves."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from scipy.linalg import expm

import jaxdyn as jd

# Steps of order 8 that end on the save points.
FINE = {"solver": diffrax.Dopri8(), "stepsize": 2.5e-4}
LINK, ROTOR, K, D, GEAR = 0.8, 2e-4, 300.0, 0.4, 50.0


def wheel(**joint):
    """A wheel of inertia LINK about its axis, without gravity."""
    builder = jd.ModelBuilder("wheel", gravity=None)
    builder.add_body("wheel", None, "continuous", (1.0, (0, 0, 0), (LINK, LINK, LINK)), joint_name="joint", **joint)
    return builder.build()


def two_masses():
    """State matrix of (q, theta, v, theta') and its input column, by hand."""
    row = np.array([-1.0, 1 / GEAR])  # of the stretch
    force = np.array([1 / LINK, -1 / GEAR / ROTOR])  # of one newton metre in the spring
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:] = np.outer(force, np.r_[K * row, D * row])
    return A, np.array([0, 0, 0, 1 / ROTOR])


def test_two_masses_on_a_spring_against_the_matrix_exponential():
    """Free oscillation, then a step of the motor's torque; closed form by exp(A t)."""
    scene = jd.forces.elastic_joints(wheel(), K, ROTOR, damping=D, gear=GEAR)
    A, b = two_masses()
    ts, tau = np.linspace(0.0, 0.5, 11), 0.3
    x0 = np.array([0.1, -2.0, 0.2, 4.0])
    motion = jd.simulate(scene, x0[:2], x0[2:], ts, control=lambda q, v, t: jnp.array([0.0, tau]), **FINE)
    whole = np.zeros((5, 5))
    whole[:4, :4], whole[:4, 4] = A, b * tau
    exact = np.array([(expm(whole * t) @ np.r_[x0, 1.0])[:4] for t in ts])
    np.testing.assert_allclose(np.hstack([motion.q, motion.v]), exact, rtol=1e-10, atol=1e-10)
    # The resonance, from the linearised dynamics of the scene.
    x = jnp.zeros(2)
    stiffness = -jax.jacfwd(lambda q: scene.applied_force(q, x))(x)
    w2 = np.linalg.eigvals(np.linalg.solve(jd.mass_matrix(scene.system, x), stiffness)).real
    np.testing.assert_allclose(max(w2), K * (1 / LINK + 1 / (GEAR**2 * ROTOR)), rtol=1e-12)


def test_spongs_equations_of_an_arm():
    """Accelerations of two elastic joints and a rigid one, against the equations written out."""
    arm = jd.robots.chain(3)
    names = arm.joint_names
    scene = jd.forces.elastic_joints(
        arm, [900.0, 400.0], [1e-3, 2e-3], damping=[3.0, 1.0], gear=[-80.0, 30.0], joints=(names[2], names[0])
    )
    assert scene.system.joint_names == (*names, f"{names[2]}_motor", f"{names[0]}_motor")
    q, v, tau = (jnp.asarray(x) for x in np.random.default_rng(0).normal(size=(3, 5)))
    s = np.array([q[3] / -80 - q[2], q[4] / 30 - q[0]])
    rate = np.array([v[3] / -80 - v[2], v[4] / 30 - v[0]])
    spring = np.array([900.0, 400.0]) * s + np.array([3.0, 1.0]) * rate
    own = tau[:3] + np.array([spring[1], 0.0, spring[0]])
    link = np.linalg.solve(jd.mass_matrix(arm, q[:3]), own - jd.bias_force(arm, q[:3], v[:3]))
    rotor = (tau[3:] - spring / np.array([-80.0, 30.0])) / np.array([1e-3, 2e-3])
    computed = jd.forward_dynamics(scene.system, q, v, tau + scene.applied_force(q, v))
    np.testing.assert_allclose(computed, np.r_[link, rotor], rtol=1e-11)


def lag_matrix(kind):
    """State matrix of (torque, its rate or nothing) and the input column."""
    if kind == "first":
        return np.array([[-1 / 0.03]]), np.array([1 / 0.03])
    return np.array([[0.0, 1.0], [-(60.0**2), -2 * 0.4 * 60.0]]), np.array([0.0, 60.0**2])


DRIVES = {
    "first": jd.forces.FirstOrderDrive(0.03, initial=-0.5),
    "second": jd.forces.SecondOrderDrive(60.0, 0.4, initial=-0.5),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", [pytest.param("first", marks=pytest.mark.slow), "second"])
def test_step_response_of_a_drive(kind):
    """Torque, states and motion of a wheel under a constant command, in `simulate` and in `stepper`."""
    scene, command, ts = jd.Scene(wheel(), forces=[DRIVES[kind]]), 2.0, np.linspace(0.0, 0.2, 9)
    A, b = lag_matrix(kind)
    n = len(b)
    whole = np.zeros((n + 3, n + 3))  # drive, q, v, 1
    whole[:n, :n], whole[:n, -1] = A, b * command
    whole[n, n + 1], whole[n + 1, 0] = 1.0, 1 / LINK
    start = np.r_[-0.5, np.zeros(n - 1), 0.3, -0.1, 1.0]
    exact = np.array([(expm(whole * t) @ start)[:-1] for t in ts])
    q0, v0 = jnp.array([0.3]), jnp.array([-0.1])
    given = {"control": lambda q, v, t: jnp.full(1, command), "outputs": ("torque", "drive_state")}
    motion = jd.simulate(scene, q0, v0, ts, **given, **FINE)
    computed = np.hstack([motion.drive_state, motion.q, motion.v])
    np.testing.assert_allclose(computed, exact, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(motion.torque[:, 0], exact[:, 0], rtol=1e-10, atol=1e-11)
    adaptive = jd.simulate(scene, q0, v0, ts, **given, stepsize=within(1e-10))
    np.testing.assert_allclose(adaptive.q[:, 0], exact[:, n], atol=1e-9)
    idle = jd.simulate(scene, q0, v0, ts, outputs=("torque",), **FINE)  # without a control the command is zero
    np.testing.assert_allclose(idle.torque[:, 0], [(expm(A * t) @ start[:n])[0] for t in ts], rtol=1e-10, atol=1e-11)

    step = jd.stepper(scene, ts[1], substeps=50)
    state = (q0, v0, scene.drive_state(q0, v0))
    for row in exact[1:]:
        state = step(state, jnp.full(1, command))
        # RK4: the error of a step of 0.5 ms is (60 h)^5/120.
        np.testing.assert_allclose(np.concatenate([state[2], state[0], state[1]]), row, rtol=1e-5, atol=1e-7)


def test_drives_of_named_joints():
    """One of two joints, whose neighbour is left alone; both in another order than the model's."""
    arm, rest, command = jd.robots.chain(2), jnp.zeros(2), jnp.array([3.0, 4.0])
    first, second = arm.joint_names
    scene = jd.Scene(arm, forces=[jd.forces.FirstOrderDrive(0.1, joints=second)])
    tau, rates = scene.drive_torque(rest, rest, 0.0, command, jnp.array([1.0]))
    np.testing.assert_allclose(tau, [3.0, 1.0])
    np.testing.assert_allclose(rates, [30.0])
    scene = jd.Scene(arm, forces=[jd.forces.FirstOrderDrive([0.1, 0.2], joints=(second, first))])
    tau, rates = scene.drive_torque(rest, rest, 0.0, command, jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(tau, [2.0, 1.0])
    np.testing.assert_allclose(rates, [30.0, 5.0])


@pytest.mark.long
def test_gradients_of_a_drive_in_both_modes_and_batches():
    """dv/dT of v = u (t - T (1 - exp(-t/T)))/I under a first-order drive; its second derivative too."""
    t, u = 0.05, 3.0

    def speed(T, adjoint="reverse", stepped=True):
        scene, zero = jd.Scene(wheel(), forces=[jd.forces.FirstOrderDrive(T)]), jnp.zeros(1)
        if stepped:
            return jd.stepper(scene, t, substeps=40, adjoint=adjoint)((zero, zero, zero), jnp.full(1, u))[1][0]
        given = {"adjoint": adjoint, "solver": diffrax.Dopri8(), "stepsize": t / 20}
        return jd.simulate(scene, zero, zero, jnp.array([0.0, t]), control=lambda q, v, t: jnp.full(1, u), **given).v[
            -1, 0
        ]

    def exact(T):
        return u * (t - T * (1 - jnp.exp(-t / T))) / LINK

    Ts = jnp.array([0.02, 0.05])
    for stepped, tolerance in ((True, 1e-6), (False, 1e-10)):  # RK4 of 40 steps; order 8
        for adjoint, mode in (("reverse", jax.grad), ("forward", jax.jacfwd)):
            slopes = jax.jit(jax.vmap(mode(lambda T, a=adjoint, s=stepped: speed(T, a, s))))(Ts)
            np.testing.assert_allclose(slopes, jax.vmap(jax.grad(exact))(Ts), rtol=tolerance)
    second = jax.jit(jax.hessian(speed))(Ts[0])
    np.testing.assert_allclose(second, jax.hessian(exact)(Ts[0]), rtol=1e-5)


def limited_wheel(stall, no_load, peak, t):
    """Speed of a wheel from rest at full command: constant torque `peak`, then the torque-speed curve."""
    knee = no_load * (1 - peak / stall)
    switch = LINK * knee / peak
    return switch, no_load - (no_load - knee) * jnp.exp(-stall * (t - switch) / (LINK * no_load))


@pytest.mark.long
def test_torque_speed_curve_and_its_kink():
    """Constant torque up to the knee, exponential behind it; the kink ends a step, and gradients have its time."""
    ts, zero = jnp.array([0.0, 0.4, 1.5]), jnp.zeros(1)

    def run(stall):
        limits = [jd.forces.TorqueSpeedLimits(stall, 6.0), jd.forces.EffortLimits(5.0)]
        scene = jd.Scene(wheel(), forces=limits)
        given = {"control": lambda q, v, t: jnp.full(1, 100.0), "outputs": ("torque",)}
        return jd.simulate(scene, zero, zero, ts, stepsize=within(1e-11), **given)

    stall = jnp.asarray(8.0)
    motion = jax.jit(run)(stall)
    switch, last = limited_wheel(8.0, 6.0, 5.0, 1.5)
    assert 0.0 < switch < 0.4
    np.testing.assert_allclose(motion.v[-1, 0], last, rtol=1e-9)
    np.testing.assert_allclose(motion.torque[:, 0], [5.0, *(8.0 * (1 - motion.v[1:, 0] / 6.0))], rtol=1e-9)
    slope = jax.jit(jax.grad(lambda s: run(s).v[-1, 0]))(stall)
    np.testing.assert_allclose(slope, jax.grad(lambda s: limited_wheel(s, 6.0, 5.0, 1.5)[1])(8.0), rtol=1e-8)
    # Beyond the no-load speed the curve brakes, against the motion it gives more than at rest.
    curve = jd.forces.TorqueSpeedLimits([8.0, jnp.inf], 6.0)
    scene = jd.Scene(jd.robots.chain(2), forces=[curve])
    for v, bounds in ((9.0, (-20.0, -4.0)), (-3.0, (-4.0, 12.0))):
        for command, bound in zip((-99.0, 99.0), bounds, strict=True):
            tau, _ = scene.drive_torque(jnp.zeros(2), jnp.full(2, v), 0.0, jnp.full(2, command))
            np.testing.assert_allclose(tau, [bound, command])


def order(error, steps):
    """Order of convergence, from the errors of `steps` and of twice as many."""
    return np.log2(abs(error(steps) / error(2 * steps)))


@pytest.mark.long
def test_stepper_ends_steps_at_kinks_of_drives():
    """Over the knee RK4 keeps its order, which would be the second across it."""
    scene = jd.Scene(wheel(), forces=[jd.forces.TorqueSpeedLimits(8.0, 6.0), jd.forces.EffortLimits(5.0)])

    def error(substeps):
        _, v = jd.stepper(scene, 1.5, substeps)((jnp.zeros(1), jnp.zeros(1)), jnp.full(1, 100.0))
        return float(v[0] - limited_wheel(8.0, 6.0, 5.0, 1.5)[1])

    assert 3.5 < order(error, 8) < 4.5 and abs(error(16)) < 1e-5


@pytest.mark.long
def test_limits_before_and_behind_a_drive():
    """Behind a first-order drive the torque is cut off from T ln(u/(u - L)) on; before it, the drive approaches the limit."""
    T, u, limit, t = 0.1, 3.0, 2.0, 0.4
    lag, cut = jd.forces.FirstOrderDrive(T), jd.forces.EffortLimits(limit)
    given = {"control": lambda q, v, t: jnp.full(1, u), "stepsize": within(1e-11)}

    def speed(forces):
        return jd.simulate(
            jd.Scene(wheel(), forces=forces), jnp.zeros(1), jnp.zeros(1), jnp.array([0.0, t]), **given
        ).v[-1, 0]

    at = T * np.log(u / (u - limit))
    np.testing.assert_allclose(speed([lag, cut]) * LINK, u * at - T * limit + limit * (t - at), rtol=1e-9)
    np.testing.assert_allclose(speed([cut, lag]) * LINK, limit * (t - T * (1 - np.exp(-t / T))), rtol=1e-9)

    def error(substeps):
        step = jd.stepper(jd.Scene(wheel(), forces=[lag, cut]), t, substeps)
        _, v, z = step((jnp.zeros(1), jnp.zeros(1), jnp.zeros(1)), jnp.full(1, u))
        np.testing.assert_allclose(z[0], u * (1 - np.exp(-t / T)), rtol=1e-4)
        return float(v[0] * LINK - (u * at - T * limit + limit * (t - at)))

    assert 3.0 < order(error, 16) < 5.0 and abs(error(32)) < 1e-5


class VoltageDrive(jd.forces.DriveDynamics):
    """L di/dt = u - R i - k v, tau = k i: a drive of a user."""

    inductance: jax.Array
    resistance: jax.Array
    constant: jax.Array

    def start(self, system, q, v, t):
        return jnp.zeros_like(v)

    def torque(self, system, q, v, t, state, command):
        return self.constant * state

    def rate(self, system, q, v, t, state, command):
        return (command - self.resistance * state - self.constant * v) / self.inductance


def test_voltage_drive_of_a_user_with_a_sampled_law():
    """Voltage steps held by a sampled law, with the back electromotive force; closed form by exp(A t)."""
    L, R, k = 0.05, 0.6, 1.3
    motor = VoltageDrive(*(jnp.asarray(x) for x in (L, R, k)))
    A = np.array([[-R / L, -k / L, 1 / L], [k / LINK, 0.0, 0.0], [0.0, 0.0, 0.0]])
    law = jd.Sampled(lambda q, v, t: 24.0 - 10.0 * v, None, 0.05)
    ts = 0.05 * np.arange(7)
    motion = jd.simulate(jd.Scene(wheel(), forces=[motor]), jnp.zeros(1), jnp.zeros(1), ts, control=law,
                         solver=diffrax.Dopri8(), stepsize=0.001, outputs=("drive_state",))  # fmt: skip
    x = np.zeros(2)
    for i in range(len(ts)):
        np.testing.assert_allclose([motion.drive_state[i, 0], motion.v[i, 0]], x, rtol=1e-10, atol=1e-12)
        x = (expm(A * 0.05) @ np.r_[x, 24.0 - 10.0 * x[1]])[:2]


class Integral(jd.Controller):
    """A torque that grows with the integral of q."""

    def start(self, q, v, t):
        return jnp.zeros_like(q)

    def __call__(self, q, v, t, state):
        return -4.0 * state - 3.0 * v - 5.0 * q

    def rate(self, q, v, t, state, multipliers):
        return q


def test_controller_with_a_state_before_a_drive():
    A = np.array([[0, 1, 0, 0], [0, 0, 0, 1 / LINK], [1, 0, 0, 0], [-5 / 0.2, -3 / 0.2, -4 / 0.2, -1 / 0.2]])
    scene, ts = jd.Scene(wheel(), forces=[jd.forces.FirstOrderDrive(0.2)]), np.linspace(0.0, 1.0, 5)
    given = {
        "control": Integral(),
        "solver": diffrax.Dopri8(),
        "stepsize": 0.01,
        "outputs": ("drive_state", "control_state"),
    }
    motion = jd.simulate(scene, jnp.ones(1), jnp.zeros(1), ts, **given)
    computed = np.hstack([motion.q, motion.v, motion.control_state, motion.drive_state])
    np.testing.assert_allclose(computed, [expm(A * t)[:, 0] for t in ts], rtol=1e-10, atol=1e-11)


def simulated_log(scene, taus, dt=0.01):
    """Log of a motion from rest under torques that are linear between the samples, by steps as of the fit."""
    ts, rest = dt * np.arange(len(taus)), jnp.zeros(scene.nv)
    motion = jd.simulate(scene, rest, rest, ts, control=jd.identify.SampledTorque(jnp.asarray(ts), jnp.asarray(taus)),
                         stepsize=dt / 4, solver=diffrax.Tsit5())  # fmt: skip
    return jd.identify.Log(ts, motion.q, v=motion.v, tau=taus)


@pytest.mark.slow
def test_constants_of_drives_are_identified():
    """From a simulated log and starts that are 30 to 60 % wrong: a time constant, and stiffness and damping of a joint."""
    t = 0.01 * np.arange(101)[:, None]
    given = {"objective": jd.identify.Objective("trajectory", substeps=4, noise=1e-6)}

    def lagged(T, d):
        return jd.Scene(wheel(), forces=[jd.forces.FirstOrderDrive(T), jd.forces.JointDamping(d)])

    def constants(scene):
        return [scene.forces[0].time_constant, scene.forces[1].coefficient]

    log = simulated_log(lagged(0.06, 0.3), np.sin(9.0 * t))
    fit = jd.identify.fit_parameters(lagged(0.1, 0.2), log, positive=constants, **given)
    np.testing.assert_allclose(fit.values, [0.06, 0.3], rtol=1e-6)

    def elastic(k, d):
        return jd.forces.elastic_joints(wheel(), k, ROTOR, damping=d, gear=GEAR)

    log = simulated_log(elastic(40.0, 0.5), np.hstack([0 * t, 0.1 * np.sin(5.0 * t)]))
    fit = jd.identify.fit_parameters(
        elastic(60.0, 0.2), log, positive=lambda scene: [scene.forces[0].stiffness, scene.forces[0].damping], **given
    )
    np.testing.assert_allclose(fit.values, [40.0, 0.5], rtol=1e-6)


LAGGED = jd.Scene(wheel(), forces=[jd.forces.FirstOrderDrive(0.1)])
ZERO = jnp.zeros(1)
MODAL = jd.Scene(wheel(), forces=[*LAGGED.forces, jd.contact.DryFriction(0.1, 1.0)])
ENERGY = jd.identify.Objective("energy")
REST = jd.identify.Log([0.0, 0.1, 0.2], *np.zeros((4, 3, 1)))


class WithMultipliers(Integral):
    takes_multipliers = True


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jd.forces.FirstOrderDrive(0.0), "time_constant"),
        (lambda: jd.forces.SecondOrderDrive(10.0, -1.0), "damping_ratio"),
        (lambda: jd.forces.SecondOrderDrive(-10.0), "frequency"),
        (lambda: jd.forces.TorqueSpeedLimits(0.0, 1.0), "stall"),
        (lambda: jd.forces.TorqueSpeedLimits(1.0, -1.0), "no_load"),
        (lambda: jd.Scene(wheel(), forces=[jd.forces.TorqueSpeedLimits(1.0, 1.0)]).clip_effort(ZERO), "drive_torque"),
        (lambda: jd.forces.TorqueSpeedLimits([1.0, 2.0], 1.0).clip_effort(wheel(), ZERO, v=ZERO), "stall has shape"),
        (lambda: jd.forces.FirstOrderDrive(0.1, joints="no").start(wheel(), ZERO, ZERO, 0.0), "'no'"),
        (lambda: jd.forces.ElasticTransmission(("a", "b"), "c", 1.0), "pairs"),
        (lambda: jd.forces.ElasticTransmission("a", "b", 1.0, gear=0.0), "gear"),
        (lambda: jd.forces.elastic_joints(wheel(), 1.0, 0.0), "rotor_inertia"),
        (lambda: jd.forces.elastic_joints(wheel(), 1.0, 1.0, joints="no"), "'no'"),
        (lambda: jd.forces.elastic_joints(jd.robots.quadruped(), 1.0, 1.0), "several coordinates"),
        (lambda: jd.stepper(LAGGED, 0.1)((ZERO, ZERO), ZERO), "drive_state"),
        (lambda: jd.stepper(LAGGED, 0.1)((ZERO, ZERO, jnp.zeros(2)), ZERO), "z has shape"),
        (lambda: jd.stepper(wheel(), 0.1)((ZERO, ZERO, ZERO), ZERO), "3 entries"),
        (lambda: jd.simulate(LAGGED, ZERO, ZERO, [0.0, 1.0], method="variational", stepsize=0.1), "variational"),
        (lambda: jd.simulate(MODAL, ZERO, ZERO, [0.0, 1.0]), "modes"),
        (lambda: jd.simulate(LAGGED, ZERO, ZERO, [0.0, 1.0], control=WithMultipliers()), "multipliers"),
        (lambda: jd.identify.fit_parameters(LAGGED, REST, objective=ENERGY, free=lambda s: s.forces[0].initial), "commands"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
