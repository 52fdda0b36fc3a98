"""Systems given by a Lagrangian or by their equations, against bodies, closed forms and each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import assert_close, quick

from jaxdyn import dynamics
from jaxdyn.building import ModelBuilder
from jaxdyn.systems import ExplicitSystem, LagrangianSystem

# Planar 2R arm of EQUATIONS section 1: m, l1, r, I.
MASS, LENGTH, REACH, MOMENT = (1.0, 0.8), 1.0, (0.5, 0.4), (0.1, 0.05)
GRAVITY = 9.81


def lagrangian(q, v, t, p):
    a, b = q[0], q[0] + q[1]
    wa, wb = v[0], v[0] + v[1]
    tip = p["length"] * jnp.stack([jnp.cos(a), jnp.sin(a)])
    tip_rate = p["length"] * wa * jnp.stack([-jnp.sin(a), jnp.cos(a)])
    rates = (
        p["reach"][0] * wa * jnp.stack([-jnp.sin(a), jnp.cos(a)]),
        tip_rate + p["reach"][1] * wb * jnp.stack([-jnp.sin(b), jnp.cos(b)]),
    )
    heights = p["reach"][0] * jnp.sin(a), tip[1] + p["reach"][1] * jnp.sin(b)
    kinetic = 0.5 * sum(p["mass"][i] * jnp.sum(rates[i] ** 2) for i in range(2))
    kinetic = kinetic + 0.5 * (p["moment"][0] * wa**2 + p["moment"][1] * wb**2)
    return kinetic - GRAVITY * sum(p["mass"][i] * heights[i] for i in range(2))


PARAMETERS = {"mass": MASS, "length": LENGTH, "reach": REACH, "moment": MOMENT}
PARAMETERS = {name: jnp.asarray(value) for name, value in PARAMETERS.items()}


def printed_mass(q):
    m1, m2 = MASS
    alpha = sum(MOMENT) + m1 * REACH[0] ** 2 + m2 * (LENGTH**2 + REACH[1] ** 2)
    beta, delta = m2 * LENGTH * REACH[1], MOMENT[1] + m2 * REACH[1] ** 2
    c = jnp.cos(q[1])
    return jnp.stack(
        [jnp.stack([alpha + 2 * beta * c, delta + beta * c]), jnp.stack([delta + beta * c, delta + 0 * c])]
    )


def printed_coriolis(q, v):
    s = MASS[1] * LENGTH * REACH[1] * jnp.sin(q[1])
    return jnp.stack([jnp.stack([-s * v[1], -s * (v[0] + v[1])]), jnp.stack([s * v[0], 0 * s])])


def printed_gravity(q):
    c1, c12 = jnp.cos(q[0]), jnp.cos(q[0] + q[1])
    second = MASS[1] * REACH[1] * c12
    return GRAVITY * jnp.stack([MASS[0] * REACH[0] * c1 + MASS[1] * LENGTH * c1 + second, second])


def bodies():
    builder = ModelBuilder("2R", gravity=(0.0, -GRAVITY, 0.0))
    for i, parent in enumerate((None, "link0")):
        inertia = (MASS[i], (REACH[i], 0.0, 0.0), (0.0, 0.0, MOMENT[i]))
        builder.add_body(f"link{i}", parent, inertia=inertia, pose=(i * LENGTH, 0.0, 0.0))
    return builder.build()


@quick
def everything(system, q, v, a):
    return {
        "mass_matrix": dynamics.mass_matrix(system, q),
        "bias_force": dynamics.bias_force(system, q, v),
        "gravity_force": dynamics.gravity_force(system, q),
        "coriolis": dynamics.coriolis_matrix(system, q, v) @ v,
        "inverse_dynamics": dynamics.inverse_dynamics(system, q, v, a),
        "forward_dynamics": dynamics.forward_dynamics(system, q, v, a),
        "kinetic": dynamics.kinetic_energy(system, q, v),
        "potential": dynamics.potential_energy(system, q),
    }


def test_three_ways_to_give_one_arm_agree():
    """Lagrangian by automatic differentiation, printed equations, and bodies on joints."""
    rng = np.random.default_rng(0)
    q, v, a = (jnp.asarray(x) for x in rng.normal(size=(3, 2)))
    explicit = ExplicitSystem(
        printed_mass,
        lambda q, v: printed_coriolis(q, v) @ v + printed_gravity(q),
        2,
        potential=lambda q: -lagrangian(q, jnp.zeros(2), 0.0, PARAMETERS),
    )
    found = [
        everything(s, q, v, a) for s in (LagrangianSystem(lagrangian, 2, parameters=PARAMETERS), explicit, bodies())
    ]
    for other in found[1:]:
        for name, value in found[0].items():
            assert_close(other[name], value, 1e-13, name)
    assert_close(found[0]["inverse_dynamics"], printed_mass(q) @ a + printed_coriolis(q, v) @ v + printed_gravity(q))


def test_coriolis_matrix_has_the_skew_property():
    system = LagrangianSystem(lagrangian, 2, parameters=PARAMETERS)
    q, v = jnp.array([0.3, 1.1]), jnp.array([0.7, -0.4])
    C = quick(lambda q, v: dynamics.coriolis_matrix(system, q, v))(q, v)
    rate = quick(lambda q, v: jax.jvp(lambda q: dynamics.mass_matrix(system, q), (q,), (v,))[1])(q, v)
    assert_close(rate, C + C.T, 1e-13)
    assert_close(C, printed_coriolis(q, v), 1e-13)


def test_gyroscopic_and_moving_systems():
    """A charge in a magnetic field, seen from a frame that moves with speed u(t): known force, known Jacobi integral."""
    field, pull = 1.7, 0.6

    def moving(q, v, t, p):
        absolute = v + jnp.stack([pull * t, jnp.zeros_like(t)])  # frame accelerates at `pull` along x
        return 0.5 * p["m"] * jnp.sum(absolute**2) + 0.5 * p["b"] * (q[0] * v[1] - q[1] * v[0])

    system = LagrangianSystem(moving, 2, parameters={"m": 2.0, "b": field})
    q, v = jnp.array([0.4, -1.2]), jnp.array([0.8, 0.3])
    bias = quick(lambda q, v: dynamics.bias_force(system, q, v, 0.9))
    want = np.array([2.0 * pull - field * v[1], field * v[0]])  # m xdd + m pull - b ydot = 0, m ydd + b xdot = 0
    assert_close(bias(q, v), want, 1e-14)
    assert_close(dynamics.kinetic_energy(system, q, v, 0.9), 1.0 * jnp.sum(v * v), 1e-14)


def test_parameters_are_differentiated_and_batched():
    q, v, tau = jnp.array([0.3, 1.1]), jnp.array([0.7, -0.4]), jnp.array([0.2, 0.1])

    def acceleration(scale):
        system = LagrangianSystem(lagrangian, 2, parameters=PARAMETERS | {"mass": PARAMETERS["mass"] * scale})
        return dynamics.forward_dynamics(system, q, v, tau)

    step = 1e-5
    one, scales = quick(acceleration), jnp.array([0.5, 1.0, 2.0])
    slope = (one(1.0 + step) - one(1.0 - step)) / (2 * step)
    assert_close(quick(jax.jacfwd(acceleration))(1.0), slope, 1e-8)  # central differences
    assert_close(quick(jax.vmap(acceleration))(scales), np.stack([one(s) for s in scales]), 1e-13)


def test_bad_systems_are_refused():
    with pytest.raises(ValueError, match="nq is 0"):
        LagrangianSystem(lagrangian, 0)
    with pytest.raises(ValueError, match="lagrangian is 3, which cannot be called"):
        LagrangianSystem(3, 2)
    system = ExplicitSystem(lambda q: jnp.eye(3), lambda q, v: v, 2)
    q = jnp.zeros(2)
    with pytest.raises(ValueError, match=r"mass_matrix returned shape \(3, 3\), expected \(2, 2\)"):
        dynamics.mass_matrix(system, q)
    with pytest.raises(ValueError, match="no potential energy; pass potential="):
        dynamics.potential_energy(system, q)
    with pytest.raises(ValueError, match=r"q has shape \(3,\), expected \(2,\)"):
        dynamics.mass_matrix(system, jnp.zeros(3))
    with pytest.raises(ValueError, match="external holds wrenches on bodies"):
        dynamics.forward_dynamics(system, q, q, q, external=jnp.zeros((1, 6)))
    with pytest.raises(ValueError, match=r"lagrangian returned shape \(2,\)"):
        dynamics.mass_matrix(LagrangianSystem(lambda q, v: v * v, 2), q)
