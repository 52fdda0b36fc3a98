"""Forces of the contacts of hands: their margins, and optimal ones that hold the object, against Newton's law and scipy."""

import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick
from scipy.optimize import minimize

import jaxdyn as jd

CONE = jd.contact.friction_cone("hard-finger", 0.8)
WEIGHT = np.array([0, 0, -0.4 * 9.81, 0, 0, 0])


def held_ball():
    hand = jd.scenes.hand_with_ball()
    q, _ = jd.scenes.hand_with_ball.start(turned=(0.0, 0.0, 0.0))
    return hand, quick(lambda q: jd.grasp.grasp_map(hand, q))(q)


@pytest.mark.long
def test_optimal_forces_hold_the_ball():
    hand, G = held_ball()
    computed = quick(lambda G, w: jd.contact.optimal_forces(G, w, [CONE] * 3, preload=0.2))(G, -WEIGHT)
    assert bool(computed.result == jd.RESULTS.successful)
    np.testing.assert_allclose(G @ computed.x, -WEIGHT, atol=1e-12)
    told = jd.contact.contact_forces(hand, computed.x, CONE)
    assert list(told.forces) == ["tip1", "tip2", "tip3"]
    # Three equal fingers, each with a third of the weight as friction: mu f_n - w / 3 = 0.2 N at the least force.
    normal = (0.2 + 0.4 * 9.81 / 3) / 0.8
    for name in told.forces:
        np.testing.assert_allclose(told.margins[name], 0.2, atol=1e-11)
        np.testing.assert_allclose(told.forces[name][2], normal, atol=1e-11)
    np.testing.assert_allclose(told.margin, 0.2, atol=1e-11)
    # A general solver, from a start of its own, finds no smaller forces.
    margin = lambda f: (0.8 * f.reshape(3, 3)[:, 2]) ** 2 - (f.reshape(3, 3)[:, :2] ** 2).sum(1)  # noqa: E731
    other = minimize(
        lambda f: f @ f / 2,
        np.tile([0, 0, 3.0], 3),
        jac=lambda f: f,
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
        constraints=[
            {"type": "eq", "fun": lambda f: np.asarray(G) @ f + WEIGHT},
            {"type": "ineq", "fun": lambda f: margin(f - np.tile([0, 0, 0.2 / 0.8], 3))},
            {"type": "ineq", "fun": lambda f: f[2::3]},
        ],
    )
    np.testing.assert_allclose(computed.x, other.x, atol=1e-6)


@pytest.mark.long
def test_a_wrench_that_no_forces_balance_is_told():
    _, G = held_ball()
    G = jnp.where(jnp.arange(9)[None] < 3, G, 0.0)  # one finger alone
    assert jd.contact.optimal_forces(G, -WEIGHT, [CONE] * 3).result == jd.RESULTS.infeasible


def test_rolling_contacts_have_their_normal_force_in_its_place():
    hand = jd.scenes.hand_rolling_ball()
    lam = jnp.array([3.0, 0.1, 0.2, 2.0, 0.3, 0.4, 1.0, 0.8, 0.6])
    told = jd.contact.contact_forces(hand, lam, [CONE] * 3)
    np.testing.assert_allclose(told.forces["finger2"], [0.3, 0.4, 2.0])
    np.testing.assert_allclose(told.margins["finger2"], 0.8 * 2 - 0.5, atol=1e-15)
    np.testing.assert_allclose(told.margin, 0.8 - 1.0, atol=1e-15)


def test_bad_input_is_refused():
    hand = jd.scenes.hand_rolling_ball()
    lam = jnp.ones(9)
    for call, match in (
        (lambda: jd.contact.contact_forces(hand, lam[:8], CONE), "multipliers has shape"),
        (lambda: jd.contact.contact_forces(hand, lam, [CONE] * 2), "cones has 2"),
        (lambda: jd.contact.contact_forces(hand, lam, {"thumb": CONE}), "thumb"),
        (lambda: jd.contact.contact_forces(hand, lam, jd.contact.friction_cone("frictionless")), "components"),
        (lambda: jd.contact.optimal_forces(jnp.eye(6), jnp.ones(6), [CONE]), "G has 6"),
        (lambda: jd.contact.optimal_forces(jnp.eye(3), jnp.ones(6), [CONE]), "wrench has shape"),
        (lambda: jd.contact.optimal_forces(jnp.eye(3), jnp.ones(3), [0.5]), "FrictionCone"),
    ):
        with pytest.raises(ValueError, match=match):
            call()
