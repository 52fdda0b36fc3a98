"""Laws of free motion: errors decay as the gains say, forces yield as the stiffness says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick, random_tree
from refusals import refusals

import jaxdyn as jd
from jaxdyn.control.errors import FrameError, as_target

KP, KD = 6.0, 5.0  # roots -2 and -3
TS = jnp.linspace(0.0, 2.0, 21)


def decayed(ts, e, rate, kp=KP, kd=KD):
    """Closed form of edd + kd ed + kp e = 0 with two real roots, (nt, n)."""
    slow, fast = np.sort(np.roots([1.0, kd, kp]).real)[::-1]
    first = (rate - fast * e) / (slow - fast)
    return np.exp(slow * ts)[:, None] * first + np.exp(fast * ts)[:, None] * (e - first)


def assert_decays(ts, errors, kp=KP, kd=KD, start_rate=None):
    """The errors (nt, n) follow the closed form, and their late rate is that of the slow root to 1 %."""
    want = decayed(np.asarray(ts), np.asarray(errors[0]), np.asarray(start_rate), kp, kd)
    # Error of RK4's steps of 5 ms for rates of 3 1/s and the motion of the arm.
    np.testing.assert_allclose(errors, want, atol=1e-7 * np.abs(want).max())


def wave(t):
    """A moving target for three joints."""
    return jnp.stack([jnp.sin(t), 0.3 * t, jnp.cos(2 * t)])


@pytest.fixture(scope="module")
def arm():
    return random_tree(1, ("revolute",) * 3, parents=[-1, 0, 1])


@pytest.fixture(scope="module")
def long_arm():
    return random_tree(4, ("revolute",) * 4, parents=[-1, 0, 1, 2])


Q0, V0 = jnp.asarray([0.4, -0.2, 0.5]), jnp.asarray([0.3, 0.1, -0.6])


def test_computed_torque_decays_as_the_gains_say(arm):
    """Against the closed form, with forces of the scene compensated; the slow rate fitted to 1 %."""
    scene = jd.Scene(arm, forces=(jd.forces.JointDamping(0.4),))
    law = jd.control.ComputedTorque(scene, wave, KP, KD)
    solution = jd.simulate(scene, Q0, V0, TS, control=law, stepsize=0.005)
    errors = np.asarray(solution.q - jax.vmap(wave)(TS))
    rate = V0 - jax.jvp(wave, (0.0,), (1.0,))[1]
    assert_decays(TS, errors, start_rate=rate)
    # What is left of the fast root after a second is taken out by fitting both.
    basis = np.exp(-np.outer(TS, [2.0, 3.0]))
    assert np.linalg.norm(errors - basis @ np.linalg.lstsq(basis, errors)[0]) < 1e-6


def test_computed_torque_takes_matrices_of_gains(arm):
    """The acceleration of the error is -Kd ed - Kp e, by forward dynamics of the same model."""
    rng = np.random.default_rng(0)
    kp, kd = (x @ x.T + np.eye(3) for x in rng.normal(size=(2, 3, 3)))
    tau = jd.control.ComputedTorque(arm, wave, kp, kd)(Q0, V0, 0.3)
    target, rate = jax.jvp(wave, (0.3,), (1.0,))
    bend = jax.jvp(lambda t: jax.jvp(wave, (t,), (1.0,))[1], (0.3,), (1.0,))[1]
    want = bend - kd @ (V0 - rate) - kp @ (Q0 - target)
    np.testing.assert_allclose(jd.forward_dynamics(arm, Q0, V0, tau), want, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
def test_computed_torque_of_a_free_body_turns_it_to_its_target():
    """Twists from the target to q decay as the gains say, for large turns too."""
    body = random_tree(2, ("free",))
    target = jd.integrate(body, jd.neutral(body), jnp.asarray([0.1, 0.2, 0.3, 0.5, -0.4, 1.2]))
    q0, v0 = jd.neutral(body), jnp.asarray([0.1, 0.0, -0.2, 0.4, 0.3, -0.1])
    law = jd.control.ComputedTorque(body, target, KP, KD)
    solution = jd.simulate(body, q0, v0, TS, control=law, stepsize=0.005)
    errors = jax.vmap(lambda q: jd.difference(body, target, q))(solution.q)
    moved = jax.jvp(lambda q: jd.difference(body, target, q), (q0,), (jd.configuration_rate(body, q0, v0),))[1]
    assert_decays(TS, errors, start_rate=moved)


@pytest.mark.long
@pytest.mark.parametrize("task", ["position", pytest.param("orientation", marks=pytest.mark.slow)])
def test_operational_space_decays_as_the_gains_say(long_arm, task):
    """Three rows on four joints; the null motion is damped."""
    frame = "f3"
    q0, v0 = jnp.asarray([0.3, -0.5, 0.8, 0.4]), jnp.asarray([0.2, 0.5, -0.3, 0.1])
    near = jd.frame_pose(long_arm, q0 + 0.1, frame)

    def target(t):
        if task == "position":
            return near[:3, 3] + 0.03 * jnp.stack([jnp.sin(t), t, jnp.cos(t)])
        return near[:3, :3] @ jd.so3.exp(0.2 * jnp.stack([jnp.sin(t), t, jnp.cos(t)]))

    law = jd.control.OperationalSpace(long_arm, frame, target, KP, KD, task=task, damping=2.0)
    solution = jd.simulate(long_arm, q0, v0, TS, control=law, stepsize=0.005)
    error = FrameError(as_target(target), frame, task)
    errors = jax.vmap(lambda q, t: error.position(long_arm, q, t))(solution.q, TS)
    moving = jd.configuration_rate(long_arm, q0, v0), 1.0
    rate = jax.jvp(lambda q, t: error.position(long_arm, q, t), (q0, 0.0), moving)[1]
    assert_decays(TS, errors, start_rate=rate)


def test_operational_space_is_khatibs_formula(long_arm):
    """tau = J^T (Lam (x* - Jdot v)) + h + (1 - J^T J^T-bar) M a0 by numpy from the frame's Jacobian."""
    q, v = jnp.asarray([0.3, -0.5, 0.8, 0.4]), jnp.asarray([0.2, 0.5, -0.3, 0.1])
    goal, posture = np.array([0.4, 0.1, -0.3]), jnp.asarray([0.1, 0.2, 0.3, 0.4])
    given = {"task": "position", "damping": 1.5, "stiffness": 0.7, "posture": posture}
    tau = jd.control.OperationalSpace(long_arm, "f2", goal, KP, KD, **given)(q, v)

    def place(q):
        return jd.frame_pose(long_arm, q, "f2")[:3, 3]

    J = np.asarray(jax.jacfwd(place)(q))
    bend = np.asarray(jax.jvp(lambda q: jax.jvp(place, (q,), (v,))[1], (q,), (v,))[1])
    M, h = (np.asarray(x) for x in (jd.mass_matrix(long_arm, q), jd.bias_force(long_arm, q, v)))
    lam = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    wanted = -KD * J @ v - KP * (np.asarray(place(q)) - goal) - bend
    back = np.linalg.solve(M, J.T) @ lam
    rest = M @ np.asarray(-1.5 * v - 0.7 * (q - posture))
    np.testing.assert_allclose(tau, J.T @ (lam @ wanted) + h + (np.eye(4) - J.T @ back.T) @ rest, rtol=1e-10)


def test_stiffness_yields_and_dissipates(arm):
    """At rest K e = F under a force at the frame, and the energy falls by what the dampers take."""
    frame, K = "f2", np.array([300.0, 200.0, 400.0])
    q0 = jnp.asarray([0.4, -0.6, 0.9])
    target = jd.frame_pose(arm, q0, frame)[:3, 3]
    given = {"task": "position", "joint_damping": 3.0}
    law = jd.control.CartesianStiffness(arm, frame, target, K, 40.0, **given)
    q, rest = q0 + 0.1, jnp.zeros(3)
    error = jd.frame_pose(arm, q, frame)[:3, 3] - target
    push = jd.forces.ExternalWrench(frame, jnp.concatenate([K * error, rest]))
    at_rest = jd.forward_dynamics(arm, q, rest, law(q, rest) + push(arm, q, rest, 0.0))
    np.testing.assert_allclose(at_rest, rest, atol=1e-9)  # forces of 50 N on links of 0.1 kg m^2

    v = jnp.asarray([0.3, -0.2, 0.5])
    J = jax.jacfwd(lambda q: jd.frame_pose(arm, q, frame)[:3, 3])(q)
    a = jd.forward_dynamics(arm, q, v, law(q, v))
    # d/dt (T + e.Ke/2): the power of M a + C v on v, which the skew C leaves at v . (tau - N), and of the spring.
    power = v @ (jd.inverse_dynamics(arm, q, v, a) - jd.gravity_force(arm, q)) + (K * error) @ (J @ v)
    np.testing.assert_allclose(power, -40.0 * (J @ v) @ (J @ v) - 3.0 * v @ v, rtol=1e-10)


@pytest.mark.parametrize("differentiate", [jax.jacfwd, jax.jacrev])
def test_rest_at_the_target_has_finite_gradients(differentiate):
    """Zero error, zero velocity and a rank of two for three rows: no NaN."""
    arm = random_tree(4, ("revolute",) * 2, parents=[-1, 0])
    q = jnp.asarray([0.3, -0.5])
    law = jd.control.OperationalSpace(arm, "f1", jd.frame_pose(arm, q, "f1")[:3, :3], KP, KD, task="orientation")
    slopes = quick(differentiate(lambda x: law(x[:2], x[2:])))(jnp.concatenate([q, jnp.zeros(2)]))
    assert np.isfinite(slopes).all()
    assert np.abs(slopes).max() > 0.1


test_bad_input_is_refused = refusals(
    (lambda m: jd.control.ComputedTorque(m, wave, -1.0, 5.0), "kp is -1.0"),
    (lambda m: jd.control.ComputedTorque(m, wave, [1.0, 0.0, 1.0], 5.0), "kp is"),
    (lambda m: jd.control.ComputedTorque(m, wave, 1.0, [[1.0, 3.0], [3.0, 1.0]]), "kd is"),
    (lambda m: jd.control.ComputedTorque(m, wave, jnp.nan, 5.0), "not positive definite"),
    (lambda m: jd.control.ComputedTorque(m, wave, np.ones((2, 3)), 5.0), "kp has shape"),
    (lambda m: jd.control.ComputedTorque(m, wave, [1.0, 1.0], 5.0)(Q0, V0), "error of 3"),
    (lambda m: jd.control.ComputedTorque(m, jnp.zeros(2), 1.0, 5.0)(Q0, V0), "target has shape"),
    (lambda m: jd.control.OperationalSpace(m, "f9", jnp.zeros(3), 1.0, 1.0), "frame 'f9' is"),
    (lambda m: jd.control.OperationalSpace(m, "f2", jnp.zeros(3), 1.0, 1.0, task="place"), "choose from position"),
    (lambda m: jd.control.OperationalSpace(m, "f2", jnp.eye(4), 1.0, 1.0, damping=-1.0), "damping is -1.0"),
    (lambda m: jd.control.OperationalSpace(m, "f2", jnp.eye(4), 1.0, 1.0, posture=[0.0]), "posture has shape"),
    (lambda m: jd.control.CartesianStiffness(m, "f2", jnp.eye(4), 0.0, 1.0), "stiffness is 0.0"),
    (lambda m: jd.control.ComputedTorque(jd.scenes.four_bar(), jnp.zeros(3), 1.0, 1.0), "HybridForce"),
    given=("arm",),
)


def test_numbers_of_numpy_make_no_float64_in_a_float32_process():
    """Gains, targets, first plans and inertias as Python and NumPy write them; warnings are errors."""
    with jax.enable_x64(False):
        model = jd.robots.quadruped(floating_base=True)
        feet = [
            jd.control.foot(name, jd.contact.friction_cone("hard-finger", mu=0.6)) for name in ("FL_foot", "RR_foot")
        ]
        law = jd.control.WholeBody(model, feet, np.zeros(3), kp=6.0, kd=np.array([3.0, 3.0, 3.0]))
        assert law.kp.dtype == law.kd.dtype == np.float32
        torque = jd.control.ComputedTorque(jd.robots.chain(2), np.zeros(2), 6.0, 3.0)
        assert torque(jnp.ones(2), jnp.zeros(2)).dtype == np.float32
        assert jd.geometry.arnold_form(jnp.asarray(np.eye(3)), jnp.ones(3), jnp.ones(3)).dtype == np.float32
        plan = jd.control.ilqr(
            lambda x, u: x + u, lambda x, u, k: u @ u, lambda x: x @ x, np.ones(1), np.zeros((2, 1)), iterations=2
        )
        assert plan.us.dtype == np.float32
