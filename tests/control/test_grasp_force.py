"""The law of an object in a hand: its error decays as the gains say, the internal force follows, contacts stay in cones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick
from test_control import KD, KP, decayed

import jaxdyn as jd
from jaxdyn import scenes

TS = jnp.linspace(0.0, 2.0, 21)


@pytest.fixture(scope="module")
def ball():
    """The hand with a ball at rest, the ball's target a little away, and the law."""
    grasp, (q, v) = scenes.hand_with_ball(mass=0.2), scenes.hand_with_ball.start(twist=(0.0,) * 6)
    target = jnp.asarray(scenes.hand_with_ball.start(position=(0.0, 0.0, 0.3), turned=(0.0, 0.0, 0.0))[0][9:])
    return grasp, q, v, target, jd.control.GraspForce(grasp, target, KP, KD, preload=4.0)


@pytest.mark.slow
def test_ball_follows_and_forces_stay_in_their_cones(ball):
    """Every error by the closed form; the internal force is the preload; margins are positive all the way."""
    grasp, q, v, _, law = ball
    outputs = ("contact_forces", "contact_margins", "multipliers", "torque")
    solution = jd.simulate(grasp, q, v, TS, control=law, stepsize=0.02, outputs=outputs)
    assert bool(solution.result == jd.RESULTS.successful)
    errors = np.asarray(jax.vmap(lambda q: law.error.position(grasp.system, q, 0.0))(solution.q))
    assert np.abs(errors[0]).max() > 0.1
    # RK4's steps of 20 ms.
    assert_close(errors, decayed(np.asarray(TS), errors[0], np.zeros(6), KP, KD), 1e-5)
    # The late rate of all of them, to 1 %.
    exact = decayed(np.asarray(TS), errors[0], np.zeros(6), KP, KD)
    slopes = [np.polyfit(TS[-6:], np.log(np.linalg.norm(e[-6:], axis=1)), 1)[0] for e in (errors, exact)]
    np.testing.assert_allclose(*slopes, rtol=0.01)
    squeeze = 4.0 * jd.grasp.normal_forces(grasp)
    internal = jax.jit(jax.vmap(lambda q, lam: jd.grasp.internal_forces(grasp, q, lam)))(
        solution.q, solution.multipliers
    )
    assert_close(internal, np.tile(squeeze, (TS.size, 1)), 1e-9)
    assert min(float(margin.min()) for margin in solution.contact_margins.values()) > 1.0
    assert all(force.shape == (TS.size, 3) for force in solution.contact_forces.values())
    assert_close(solution.torque[:, 9:], np.zeros((TS.size, 6)), 0)


@pytest.mark.slow
def test_wanted_acceleration_and_forces_are_those_that_follow(ball):
    """One state in motion: a and lam of the full equations under the law are those it asks for; a weak grip loses contact."""
    grasp, q, _, target, law = ball
    v = scenes.hand_with_ball.start()[1]

    @quick
    def compute(law, q, v):
        full = jd.constrained_dynamics(grasp, q, v, law(q, v, 0.0))
        return full, law.acceleration(q, v), law.reference_forces(q, v), law.is_regular(q, v)

    full, a, lam, regular = compute(law, q, v)
    assert bool(regular)
    assert_close(full.acceleration, a, 1e-10)
    assert_close(full.multipliers, lam, 1e-9)
    slope = jax.jit(jax.grad(lambda law: jnp.sum(law(q, v, 0.0) ** 2), allow_int=True))(law)
    assert all(np.isfinite(x).all() and np.abs(x).max() > 0 for x in (slope.kp, slope.kd, slope.preload.value))
    weak = jd.control.GraspForce(grasp, target, KP, KD, preload=0.2)
    lost = jd.simulate(grasp, q, 0 * v, TS, control=weak, stepsize=0.02, throw=False)
    assert bool(lost.result == jd.RESULTS.contact_lost)


@pytest.mark.slow
def test_integral_action_takes_the_error_of_the_internal_force_away():
    """Fingers that are heavier than in the law: at rest the internal force is off, and decays with ki."""
    plant, (q, v) = scenes.hand_with_bar(), scenes.hand_with_bar.start(velocity=(0.0, 0.0, 0.0))
    model = scenes.hand_with_bar(masses=(0.5, 0.4))
    ends = []
    for ki in (None, 4.0):
        law = jd.control.GraspForce(model, q[4:], 400.0, 40.0, preload=10.0, ki=ki)
        solution = jd.simulate(plant, q, v, TS, control=law, stepsize=0.01, outputs=("multipliers",))
        internal = jd.grasp.internal_forces(plant, solution.q[-1], solution.multipliers[-1])
        ends.append(np.abs(np.asarray(internal) - 10.0 * jd.grasp.normal_forces(plant)).max())
    assert ends[0] > 0.1
    assert ends[1] < 0.02 * ends[0]


@pytest.mark.long
def test_contacts_hold_where_a_stretched_finger_cannot_follow(ball):
    """The least-squares error is all in the object's motion, and none in the rows of the contacts."""
    grasp, q, v, _, law = ball
    q = q.at[:3].set(0.0)
    v = 0.1 * jnp.ones_like(v)
    assert not bool(law.is_regular(q, v))
    free = jd.constrained_dynamics(grasp, q, v).acceleration
    A = jd.constraint_jacobian(grasp, q)
    np.testing.assert_allclose(A @ law.acceleration(q, v), A @ free, atol=1e-10)


def test_refusals(ball):
    """What does not fit is refused by name."""
    grasp, q, v, target, _ = ball
    with pytest.raises(ValueError, match="grasp is a"):
        jd.control.GraspForce(scenes.four_bar(), target, KP, KD)
    with pytest.raises(ValueError, match="kp is"):
        jd.control.GraspForce(grasp, target, -1.0, KD)
    with pytest.raises(ValueError, match="target has shape"):
        jd.control.GraspForce(grasp, target[:3], KP, KD)(q, v)
