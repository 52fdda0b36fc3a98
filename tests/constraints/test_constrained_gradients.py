"""Derivatives of the final state under constraints: each method against differences and against the others; batches.

The mechanism is a slider-crank given by its Lagrangian, which compiles in a fraction of the time that bodies need.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from pinocchio_bridge import assert_close, quick

import jaxdyn as jd
from jaxdyn import scenes

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


@pytest.mark.slow
def test_methods_agree_on_derivatives(slopes):
    """The motion is one, so its derivatives are, up to the integration's error with steps of 0.01 s."""
    for name in METHODS:
        np.testing.assert_allclose(slopes[name], slopes["projected"], atol=1e-6 * np.abs(slopes["projected"]).max())


@pytest.mark.slow
def test_a_thousand_mechanisms_of_different_lengths():
    """One vmap over crank and rod: every lane stays closed and ends where the crank's angle puts it in closed form."""
    rng = np.random.default_rng(0)
    changes = np.zeros((1000, 8))
    changes[:, 2:4] = rng.uniform(-0.3, 0.3, (1000, 2))

    def run(x):
        scene, q, v = mechanism(x)
        solution = jd.simulate(scene, q, v, TS, stepsize=0.01, outputs=("constraint_residual", "energy"))
        q, v = solution.q[-1], solution.v[-1]
        return q, v, solution.success, solution.constraint_residual.max(), closed(1.0 + x[2], 2.5 + x[3], q[0], v[0])

    q, v, success, residual, (q_closed, v_closed) = quick(jax.vmap(run))(jnp.asarray(changes))
    assert np.asarray(success).all() and float(residual.max()) < 1e-12
    np.testing.assert_allclose(q, q_closed, atol=1e-12)
    np.testing.assert_allclose(v, v_closed, atol=1e-11)
    assert np.ptp(np.asarray(q[:, 0])) > 0.05  # they move differently
    one = quick(run)
    for i in (0, 500, 999):
        assert_close(q[i], one(jnp.asarray(changes[i]))[0], 1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["projected", "reduced"])
def test_derivatives_of_a_mechanism_of_bodies(method):
    """Four-bar: the coupler's mass and the start's speed; reverse mode by differences."""
    base, (q, v) = scenes.four_bar(), scenes.four_bar.start(rate=3.0)

    def final(x):
        model = base.system.replace(inertias=base.system.inertias.at[1].multiply(1.0 + x[0]))
        scene = jd.Scene(model, base.constraints)
        solution = jd.simulate(scene, q, v * (1.0 + x[1]), TS, stepsize=0.02, method=method)
        return jnp.concatenate([solution.q[-1], solution.v[-1]])

    slope = quick(jax.jacrev(final))(jnp.zeros(2))
    want = differences(quick(jax.vmap(final)), 2)
    np.testing.assert_allclose(slope, want, atol=1e-8 * np.abs(want).max())  # h^4 of the differences
    assert (np.abs(slope).max(0) > 1e-3).all()
