"""Rows of tens of windows, large programs, against the closed form of their one degree of freedom.

While all uprights have the same angle q to the vertical, couplers translate. N windows of bars of mass m and length L then have
the kinetic energy ((N + 1) / 3 + N) m L^2 q'^2 / 2 and the potential energy ((N + 1) / 2 + N) m g L cos q.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdyn as jd

pytestmark = pytest.mark.native
G = 9.81


def windows(count: int, angle: float, rate: float):
    scene = jd.scenes.windows(count=count)
    # Each upright but the last is followed by its coupler, which turns back.
    signs = np.array([1.0, -1.0] * count + [1.0])
    return scene, signs, jnp.asarray(angle * signs), jnp.asarray(rate * signs)


def rate_of_rate(count: int, angle):
    return G * np.sin(angle) * ((count + 1) / 2 + count) / ((count + 1) / 3 + count)


@pytest.mark.parametrize("count", [40, 150])
def test_acceleration(count):
    """Accelerations of a known scene; 150 windows are a listing."""
    scene, signs, q, v = windows(count, 0.7, 1.3)
    a = jax.jit(lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration)(q, v)
    np.testing.assert_allclose(a, signs * rate_of_rate(count, 0.7), rtol=0, atol=1e-12 * count)


def test_gradient():
    """The derivative of accelerations by velocities and angles, against differences."""
    scene, _, q, v = windows(40, 0.7, 1.3)
    weights = jnp.asarray(np.cos(np.arange(scene.nv)))

    def value(q, v):
        return weights @ jd.constrained_dynamics(scene, q, v, weights).acceleration

    # Any direction: accelerations are defined off the constraints too.
    run, step, along = jax.jit(value), 1e-6, jnp.asarray(np.sin(3.0 * np.arange(scene.nv)))
    for i, gradient in enumerate(jax.jit(jax.grad(value, (0, 1)))(q, v)):
        ends = [run(*(x + side * step * along * float(i == k) for k, x in enumerate((q, v)))) for side in (1, -1)]
        # Central differences have errors of 1e-9 of the largest terms.
        np.testing.assert_allclose(gradient @ along, (ends[0] - ends[1]) / (2 * step), rtol=1e-6, atol=1e-7)


def test_motion():
    """A motion of forty windows, whose scene is a constant of its program, from outside of `jax.jit` and under it."""
    count, steps, length = 40, 20, 1e-3
    scene, signs, q, v = windows(count, 0.7, 1.3)
    times = jnp.asarray([0.0, steps * length])

    def run(q, v):
        return jd.simulate(scene, q, v, times, stepsize=length, throw=False)

    solution = run(q, v)
    assert solution.success
    state = np.array([0.7, 1.3])

    def rate(x):
        return np.array([x[1], rate_of_rate(count, x[0])])

    h = length / 10
    for _ in range(10 * steps):
        k1 = rate(state)
        k2 = rate(state + 0.5 * h * k1)
        k3 = rate(state + 0.5 * h * k2)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(state + h * k3))
    # RK4 with steps of a millisecond has an error of 1e-13 here.
    np.testing.assert_allclose(solution.q[-1], signs * state[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(solution.v[-1], signs * state[1], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(jax.jit(run)(q, v).q, solution.q)
