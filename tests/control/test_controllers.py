"""Controllers with a state, sampled ones, and their outputs."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_helpers import within
from pinocchio_bridge import quick, random_tree
from refusals import refusals

import jaxdyn as jd
from jaxdyn import scenes

Q0, V0, TS = jnp.asarray([0.4, -0.2]), jnp.asarray([0.3, 0.1]), jnp.linspace(0.0, 0.5, 6)


class Integral(jd.Controller):
    """A force that grows with the integral of q."""

    gain: jax.Array

    def start(self, q, v, t):
        return {"sum": jnp.zeros_like(q)}

    def __call__(self, q, v, t, state):
        return -self.gain * state["sum"]

    def rate(self, q, v, t, state, multipliers):
        return {"sum": q}


class Feedback(jd.Controller):
    """A torque along the rows in proportion to the multipliers of the same moment."""

    takes_multipliers = True
    scene: jd.Scene
    gain: jax.Array

    def __call__(self, q, v, t, state, multipliers):
        return jd.constraint_jacobian(self.scene, q).T @ (self.gain * (multipliers - 2.0)) - 0.3 * v

    def rate(self, q, v, t, state, multipliers):
        return None


class Filtered(jd.Controller):
    """The multipliers through a filter of first order."""

    def start(self, q, v, t):
        return jnp.zeros(1)

    def __call__(self, q, v, t, state):
        return jnp.zeros_like(v)

    def rate(self, q, v, t, state, multipliers):
        return 5.0 * (multipliers - state)


@pytest.fixture(scope="module")
def arm():
    return random_tree(1, ("revolute",) * 2, parents=[-1, 0])


def test_a_controllers_state_is_integrated_with_the_motion():
    """A mass with xdd = -g int x: the third-order equation s^3 + g = 0 in closed form; its gradient in the gain too."""
    mass = jd.ExplicitSystem(lambda q: jnp.eye(1), lambda q, v: jnp.zeros(1), 1)

    def end(gain):
        given = {"control": Integral(gain), "stepsize": 0.01, "outputs": ("control_state", "torque")}
        computed = jd.simulate(mass, jnp.ones(1), jnp.zeros(1), TS, **given)
        return computed.q[-1, 0], computed

    (last, computed), slope = jax.jit(jax.value_and_grad(end, has_aux=True))(jnp.asarray(2.0))

    def closed(g):
        """x = sum c_i exp(s_i t) with x, xd, xdd = 1, 0, 0 at the start."""
        roots = np.roots([1.0, 0.0, 0.0, g])
        c = np.linalg.solve(np.vander(roots, increasing=True).T, [1.0, 0.0, 0.0])
        return (np.exp(np.outer(TS, roots)) @ c).real, (np.exp(np.outer(TS, roots)) @ (c / roots)).real - np.sum(
            c / roots
        ).real

    x, integral = closed(2.0)
    np.testing.assert_allclose(computed.q[:, 0], x, atol=1e-9)  # RK4's steps of 10 ms
    np.testing.assert_allclose(computed.control_state["sum"][:, 0], integral, atol=1e-9)
    np.testing.assert_allclose(computed.torque, -2.0 * computed.control_state["sum"], atol=1e-14)
    step = 1e-4
    change = (closed(2.0 + step)[0][-1] - closed(2.0 - step)[0][-1]) / (2 * step)
    np.testing.assert_allclose(slope, change, rtol=1e-6)  # differences, and RK4's steps
    assert last == computed.q[-1, 0]


@pytest.mark.slow
def test_adaptive_steps_integrate_a_state_as_fixed_ones_do():
    """Multipliers reach a filter: z = the solution of dz/dt = 5 (lam - z) with the lam of the output."""
    scene = scenes.spherical_pendulum()
    q0, v0 = scenes.spherical_pendulum.start()
    outputs = ("control_state", "multipliers")
    steps = within(1e-10), 0.002  # the filter sums the errors of multipliers up to 20 N
    ends = [jd.simulate(scene, q0, v0, TS, control=Filtered(), outputs=outputs, stepsize=each) for each in steps]
    np.testing.assert_allclose(ends[0].control_state, ends[1].control_state, atol=1e-7)
    fine = jnp.linspace(0.0, 0.5, 501)
    lam = jd.simulate(scene, q0, v0, fine, outputs=("multipliers",), stepsize=0.001).multipliers[:, 0]
    weights = np.exp(-5.0 * (0.5 - fine))
    want = 5.0 * np.trapezoid(weights * lam, fine)  # of order h^2: 1e-6 here
    np.testing.assert_allclose(ends[0].control_state[-1, 0], want, rtol=1e-5)


@pytest.mark.long
def test_feedback_of_the_multipliers_is_solved():
    """lam of the output is that of the torque of the output, which is the law's at that lam."""
    scene = scenes.spherical_pendulum()
    q0, v0 = scenes.spherical_pendulum.start()
    law = Feedback(scene, jnp.asarray(0.8))
    solution = jd.simulate(scene, q0, v0, TS, control=law, outputs=("multipliers", "torque"), stepsize=0.01)

    @quick
    @jax.vmap
    def compute(q, v, tau, lam):
        return jd.constrained_dynamics(scene, q, v, tau).multipliers, law(q, v, 0.0, None, lam)

    again, told = compute(solution.q, solution.v, solution.torque, solution.multipliers)
    np.testing.assert_allclose(solution.multipliers, again, rtol=1e-10)
    np.testing.assert_allclose(solution.torque, told, rtol=1e-10)


def digital(q, v, t, state):
    """A proportional law with a sum, on samples."""
    state = {"sum": state["sum"] + 0.05 * q}
    return -3.0 * q - 0.5 * v - 2.0 * state["sum"] + 0.1 * t, state


def test_a_sampled_law_equals_a_loop_by_hand(arm):
    """A scan over the periods, four steps of the classical Runge-Kutta method in each, at 1e-10."""
    period, step = 0.05, 0.0125
    start = {"sum": jnp.zeros(2)}
    given = {"stepsize": step, "outputs": ("torque", "control_state")}
    law = jd.Sampled(digital, start, period)
    solution = jd.simulate(arm, Q0, V0, TS, control=law, **given)
    between = jd.simulate(arm, Q0, V0, jnp.concatenate([TS[:1], TS[1:] - period / 2]), control=law, **given)

    def classical(state, tau):
        """One step of the classical Runge-Kutta method."""

        def rate(state):
            return jnp.stack([state[1], jd.forward_dynamics(arm, *state, tau)])

        first = rate(state)
        second = rate(state + step / 2 * first)
        third = rate(state + step / 2 * second)
        return state + step / 6 * (first + 2 * second + 2 * third + rate(state + step * third))

    def one(carry, t):
        state, total = carry
        tau, total = digital(*state, t, total)
        state = jax.lax.fori_loop(0, 4, lambda _, state: classical(state, tau), state)
        return (state, total), (*state, tau, total["sum"])

    _, (q, v, tau, total) = jax.jit(
        lambda: jax.lax.scan(one, (jnp.stack([Q0, V0]), start), period * jnp.arange(10.0))
    )()
    np.testing.assert_allclose(solution.q[1:], q[1::2], atol=1e-10)
    np.testing.assert_allclose(solution.v[1:], v[1::2], atol=1e-10)
    np.testing.assert_allclose(between.torque[1:], tau[1::2], atol=1e-10)
    np.testing.assert_allclose(between.control_state["sum"][1:], total[1::2], atol=1e-10)


@pytest.mark.slow
def test_a_sampled_law_is_differentiated(arm):
    """Reverse mode in a gain, against differences."""

    def end(gain):
        law = jax.tree_util.Partial(lambda gain, q, v, t, state: (-gain * q - state, state + 0.1 * q), gain)
        return jd.simulate(arm, Q0, V0, TS, control=jd.Sampled(law, jnp.zeros(2), 0.05), stepsize=0.025).q[-1, 0]

    value, slope, step = jax.jit(end), jax.jit(jax.grad(end))(2.0), 1e-5
    np.testing.assert_allclose(slope, (value(2.0 + step) - value(2.0 - step)) / (2 * step), rtol=1e-6)


def test_a_law_without_a_state_is_sampled(arm):
    """With a short period it comes to the continuous law, in proportion to the period."""
    law = jd.control.ComputedTorque(arm, jnp.zeros(2), 6.0, 5.0)
    want = jd.simulate(arm, Q0, V0, TS, control=law, stepsize=0.01).q
    difference = [
        np.abs(jd.simulate(arm, Q0, V0, TS, control=jd.Sampled(law, None, p), stepsize=0.005).q - want).max()
        for p in (0.01, 0.005)
    ]
    assert 1e-6 < difference[1] < difference[0] < 0.01
    # First order in the period; the second order makes the ratio 2.008.
    np.testing.assert_allclose(difference[0] / difference[1], 2.0, rtol=0.05)


@pytest.fixture(scope="module")
def slider():
    """A mass of 2 kg."""
    builder = jd.ModelBuilder("slider", gravity=None)
    builder.add_body("mass", joint="prismatic", axis=(1, 0, 0), inertia=(2.0, (0, 0, 0), (1, 1, 1)))
    return builder.build()


COUNT = jd.Sampled(lambda q, v, t, state: (state[None], state + 1.0), 0.0, 1.0)  # torques 0, 1, 2, ... N


def with_period(period):
    return eqx.tree_at(lambda law: law.period, COUNT, jnp.asarray(period))


@pytest.mark.parametrize("t0", [0.0, 0.7, 1000.3])
@pytest.mark.parametrize(
    ("period", "step"), [(1 / 3, 1 / 9), (0.7, 0.1), (0.03, 0.01), (0.01, 0.00333333), (0.05, 0.05)]
)
def test_samples_are_taken_when_they_are_due(slider, period, step, t0):
    """In closed form: the k-th sample accelerates by k / 2 m/s^2, and v = period k (k + 1) / 4 after it."""
    n = 21
    times = t0 + np.array([0.0, 5.5 * period, n * period])
    motion = jd.simulate(slider, [0.0], [0.0], times, control=with_period(period), stepsize=step)
    speeds = [0.0, period * 10 / 2 + 0.5 * period * 5 / 2, period * n * (n - 1) / 4]
    np.testing.assert_allclose(motion.v[:, 0], speeds, rtol=1e-8)


def speed_of(period, t):
    """Speed at the time t under the torques of COUNT, in closed form."""
    n = np.floor(t / period)
    return period * n * (n - 1) / 4 + (t - n * period) * n / 2


@pytest.mark.parametrize("solver", [None, diffrax.Tsit5(), diffrax.Kvaerno3()])
def test_the_last_step_is_shorter(slider, solver):
    """A run of 66 steps of 0.03 s and one of 0.02 s: samples stay at multiples of the period, 3 steps."""
    given = {"control": with_period(0.09), "stepsize": 0.03, "solver": solver}
    times = np.array([0.0, 0.1, 2.0])
    motion = jd.simulate(slider, [0.0], [0.0], times, **given)
    np.testing.assert_allclose(motion.v[1:, 0], speed_of(0.09, times[1:]), rtol=1e-12)
    assert motion.stats["num_steps"] == 67

    @jax.jit
    def run(period, step, end):
        motion = jd.simulate(
            slider, [0.0], [0.0], jnp.stack([0 * end, end]), throw=False,
            **given | {"control": with_period(period), "stepsize": step},
        )  # fmt: skip
        return motion.v[-1, 0], motion.result == jd.RESULTS.bad_stepsize

    for end in (1.0, 2.0):
        speed, refused = run(0.09, 0.03, end)
        assert not refused
        np.testing.assert_allclose(speed, speed_of(0.09, end), rtol=1e-12)
    assert run(0.09, 0.04, 1.8)[1]
    # The end of the last step follows the end of the run: the last of 23 torques, on 2 kg.
    np.testing.assert_allclose(jax.grad(lambda end: run(0.09, 0.03, end)[0])(2.0), 22 / 2, rtol=1e-12)


def test_samples_are_due_at_times_of_float32(slider):
    """1.8 s is rounded to less than twenty periods."""
    motion = jd.simulate(
        slider, [0.0], [0.0], np.array([0.0, 1.8], np.float32), control=with_period(0.09), stepsize=0.03
    )
    np.testing.assert_allclose(motion.v[-1, 0], speed_of(0.09, float(np.float32(1.8))), rtol=1e-12)


def changing(q, v, t, state):
    return -q, jnp.zeros(3)


class Wrong(Integral):
    """Its rate has another structure than its state."""

    def rate(self, q, v, t, state, multipliers):
        return {"sum": jnp.zeros(5)}


def controlled(arm, control, **given):
    return jd.simulate(arm, Q0, V0, TS, control=control, **given)


test_controls_that_do_not_fit_are_refused = refusals(
    (lambda arm: controlled(arm, jd.Sampled(digital, {"sum": np.zeros(2)}, 0.05)), "takes fixed steps"),
    (lambda arm: controlled(arm, jd.Sampled(digital, {"sum": np.zeros(2)}, 0.05), stepsize=0.03), "whole part of"),
    (lambda arm: controlled(arm, jd.Sampled(changing, np.zeros(2), 0.05), stepsize=0.05), "keep its structure"),
    (lambda arm: controlled(arm, Wrong(np.ones(())), stepsize=0.05), "keep its structure"),
    (lambda arm: controlled(arm, Integral(np.ones(())), stepsize=0.05, method="variational"), "variational"),
    (lambda arm: controlled(arm, lambda q, v, t: jnp.zeros(3), stepsize=0.05), "control returned shape"),
    *((lambda arm, x=x: jd.Sampled(digital, None, x), "period is") for x in (0.0, -1.0, np.nan, [0.1, 0.2])),
    given=("arm",),
)


def nowhere(q, v, t):
    return jnp.full_like(v, jnp.nan)


def test_a_control_that_returns_nan_ends_with_a_code(arm):
    solution = jd.simulate(arm, Q0, V0, TS, control=nowhere, stepsize=0.05, throw=False)
    assert solution.result == jd.RESULTS.nonfinite_state
    assert not bool(solution.success)
