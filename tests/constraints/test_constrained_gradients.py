"""Derivatives of the final state under constraints: each method against differences.

The mechanism is a slider-crank given by its Lagrangian, which compiles in a fraction of the time that bodies need.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from pinocchio_bridge import quick

import jaxdyn as jd

TS = jnp.asarray([0.0, 0.3])
METHODS = {"projected": "projected", "multipliers": "multipliers", "reduced": "reduced", "crank": jd.Reduced((0,))}


def lagrangian(q, v, t, p):
    """Crank of inertia J and length a, uniform rod of length b and mass 2, slider of mass m; q = (crank, rod, slider)."""
    c, s = jnp.cos(q[0]), jnp.sin(q[0])
    half = 0.5 * p["b"]
    x = -p["a"] * s * v[0] - half * jnp.sin(q[1]) * v[1]
    y = p["a"] * c * v[0] + half * jnp.cos(q[1]) * v[1]
    kinetic = 0.5 * p["J"] * v[0] ** 2 + x**2 + y**2 + p["b"] ** 2 / 12 * v[1] ** 2 + 0.5 * p["m"] * v[2] ** 2
    return kinetic - 9.81 * (p["a"] * s + 2 * (p["a"] * s + half * jnp.sin(q[1])))


class Pin(eqx.Module):
    """The rod's end at the slider."""

    a: Array
    b: Array

    def __call__(self, q, t):
        """(2,), m."""
        x = self.a * jnp.cos(q[0]) + self.b * jnp.cos(q[1]) - q[2]
        return jnp.stack([x, self.a * jnp.sin(q[0]) + self.b * jnp.sin(q[1])])


def closed(a, b, angle, rate):
    """q and v in closed form."""
    rod = -jnp.arcsin(a * jnp.sin(angle) / b)
    turn = -a * jnp.cos(angle) * rate / (b * jnp.cos(rod))
    slide = -a * jnp.sin(angle) * rate - b * jnp.sin(rod) * turn
    return jnp.stack([angle, rod, a * jnp.cos(angle) + b * jnp.cos(rod)]), jnp.stack([rate, turn, slide])


def mechanism(x):
    """Scene and start for changes x of (J, m, a, b, the start's angle and rate, the crank's torque and its damping)."""
    a, b = 1.0 + x[2], 2.5 + x[3]
    parameters = {"J": 0.4 + x[0], "m": 1.5 + x[1], "a": a, "b": b}
    system = jd.LagrangianSystem(lagrangian, 3, parameters=parameters)
    return jd.Scene(system, (jd.Holonomic(Pin(a, b), name="pin"),)), *closed(a, b, 1.0 + x[4], 3.0 + x[5])


def torque(p, q, v, t):
    """On the crank."""
    return jnp.zeros_like(v).at[0].set(p[0] * jnp.cos(3 * t) - p[1] * v[0])


def final(x, method="projected", adjoint=None):
    """q and v at the end, (6,)."""
    scene, q, v = mechanism(x)
    control = jax.tree_util.Partial(torque, x[6:])
    solution = jd.simulate(scene, q, v, TS, control=control, method=method, stepsize=0.01, adjoint=adjoint)
    return jnp.concatenate([solution.q[-1], solution.v[-1]])


@pytest.fixture(scope="module")
def slopes():
    """Jacobians (6, 8) by method: in reverse mode, which compiles slowly, for one, in forward mode for the others."""
    computed = {}
    for name, method in METHODS.items():
        mode, adjoint = (jax.jacrev, "reverse") if name == "projected" else (jax.jacfwd, "forward")
        computed[name] = quick(mode(lambda x, m=method, a=adjoint: final(x, m, a)))(jnp.zeros(8))
    return computed


def differences(run, count, h=1e-3):
    """Jacobian of a batched function at zero by fourth-order differences."""
    steps = run(jnp.asarray(np.concatenate([s * h * np.eye(count) for s in (-2, -1, 1, 2)]))).reshape(4, count, -1)
    return (8 * (steps[2] - steps[1]) - (steps[3] - steps[0])).T / (12 * h)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_derivatives_against_differences(slopes, name):
    """Inertia, mass, lengths, start, control: each by differences of the method itself, and not zero."""
    want = differences(quick(jax.vmap(lambda x: final(x, METHODS[name]))), 8)
    np.testing.assert_allclose(slopes[name], want, atol=1e-8 * np.abs(want).max())  # h^4 of the differences
    assert (np.abs(slopes[name]).max(0) > 1e-3).all()
