"""Rows of tens of windows, large programs, against the closed form of their one degree of freedom.

While all uprights have the same angle q to the vertical, couplers translate. N windows of bars of mass m and length L then have
the kinetic energy ((N + 1) / 3 + N) m L^2 q'^2 / 2 and the potential energy ((N + 1) / 2 + N) m g L cos q.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxdyn as jd
from jaxdyn.constraints.base import rows as constraint_rows

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
    rate = lambda t, x: [x[1], rate_of_rate(count, x[0])]  # noqa: E731
    state = solve_ivp(rate, (0.0, times[1]), [0.7, 1.3], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    # RK4 with steps of a millisecond has an error of 1e-13 here.
    np.testing.assert_allclose(solution.q[-1], signs * state[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(solution.v[-1], signs * state[1], rtol=0, atol=1e-11)
    np.testing.assert_array_equal(jax.jit(run)(q, v).q, solution.q)


def test_as_in_extended_precision():
    """Accelerations under joint torques: no further from the exact solution than a dense solve in float64.

    Rounding of M and A moves the solution by 1e-16 times a condition number that grows with the square of the windows.
    """
    scene, _, q, v = windows(10, 0.7, 1.3)
    tau = jnp.asarray(np.cos(3.0 * np.arange(scene.nv)))

    @jax.jit
    def solve(q, v):
        row = constraint_rows(scene, q, v, 0.0)
        solution = jd.constrained_dynamics(scene, q, v, tau)
        return (
            jd.mass_matrix(scene.system, q),
            jd.bias_force(scene.system, q, v),
            row.A,
            row.gamma,
            solution.acceleration,
        )

    M, h, A, gamma, computed = map(np.asarray, solve(q, v))
    K = np.block([[M, A.T], [A, np.zeros((len(A), len(A)))]])
    right = np.concatenate([np.asarray(tau) - h, gamma])
    with mpmath.workdps(40):
        exact = np.array(mpmath.lu_solve(mpmath.matrix(K.tolist()), mpmath.matrix(right.tolist()))[: scene.nv], float)
    size = np.abs(exact).max()
    dense = np.abs(np.linalg.solve(K, right)[: scene.nv] - exact).max() / size
    assert np.abs(computed - exact).max() / size < max(20 * dense, 1e-12)
