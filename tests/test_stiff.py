"""Stiff motion: the first step, methods for stiff equations, detection of stiffness, and what each solver makes of the cases."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn.solvers.rosenbrock import _A, _C, _GAMMA, _RATE, _TIME, Rodas5P


def slider(mass=1.0):
    """A body on a rail."""
    builder = jd.ModelBuilder("slider", gravity=None)
    builder.add_body("box", joint="prismatic", axis=(1, 0, 0), inertia=(mass, (0, 0, 0), (0, 0, 0)))
    return builder.build()


# ---------------------------------------------------------------------------------------------------------------------
# The first step


def test_first_step_is_the_same_in_any_unit_of_time():
    """Ten radians of an oscillation of rate w: the same steps for every w, none of them rejected.

    A first step of a fixed length would be rejected at w = 1e6 until it is short enough, and be lost at w = 1e-6.
    """
    model = slider()

    @quick
    @jax.vmap
    def run(w):
        scene = jd.Scene(model, forces=(jd.JointSpring(w * w),))
        start = jnp.ones(1), 0.5 * w[None]
        # Without atol, which is not the same for m/s in all units of time; powers of two make the numbers the same.
        return jd.simulate(scene, *start, jnp.stack([0 * w, 10 / w]), atol=1e-30, throw=False)

    found = run(2.0 ** np.array([0, 20, -20]))
    assert found.success.all()
    assert len({int(n) for n in found.stats["num_steps"]}) == 1
    np.testing.assert_array_equal(found.stats["num_rejected_steps"], 0)
    np.testing.assert_allclose(found.q[:, -1, 0], np.cos(10) + 0.5 * np.sin(10), rtol=1e-7)


# ---------------------------------------------------------------------------------------------------------------------
# The Rosenbrock method


def test_coefficients_of_the_rosenbrock_method():
    """Order conditions, in the form k_i = f(y0 + h sum alpha k) + h J sum beta' k: U = Gamma k h."""
    gamma = np.linalg.inv(np.eye(8) / _GAMMA - _C)
    alpha, b = _A @ gamma, (_A[-1] + np.eye(8)[-1]) @ gamma
    embedded = _A[-1] @ gamma
    beta, one = alpha + gamma, np.ones(8)
    np.testing.assert_allclose(alpha @ one, _TIME, atol=2e-13)
    np.testing.assert_allclose(gamma @ one, _RATE, atol=2e-13)
    np.testing.assert_allclose(np.diag(gamma), _GAMMA, rtol=1e-14)
    # Stiffly accurate: the last row of beta is b.
    np.testing.assert_allclose(beta[-1], b, atol=1e-12)
    c, bb = alpha @ one, beta @ one
    trees = {
        1: [(one, 1)],
        2: [(bb, 1 / 2)],
        3: [(c**2, 1 / 3), (beta @ bb, 1 / 6)],
        4: [
            (c**3, 1 / 4),
            (c * (alpha @ bb), 1 / 8),
            (beta @ c**2, 1 / 12),
            (beta @ beta @ bb, 1 / 24),
        ],
        5: [
            (c**4, 1 / 5),
            (c**2 * (alpha @ bb), 1 / 10),
            ((alpha @ bb) ** 2, 1 / 20),
            (c * (alpha @ c**2), 1 / 15),
            (c * (alpha @ beta @ bb), 1 / 30),
            (beta @ c**3, 1 / 20),
            (beta @ (c * (alpha @ bb)), 1 / 40),
            (beta @ beta @ c**2, 1 / 60),
            (beta @ beta @ beta @ bb, 1 / 120),
        ],
    }
    for order, conditions in trees.items():
        for vector, value in conditions:
            assert abs(b @ vector - value) < 1e-11, (order, b @ vector, value)
            if order < 5:
                assert abs(embedded @ vector - value) < 1e-11, (order, embedded @ vector, value)
    assert max(abs(embedded @ vector - value) for vector, value in trees[5]) > 1e-4  # the estimate is of order 4
    # L-stable: R(z) = 1 + z b (1 - z beta)^-1 1 is at most 1 on the imaginary axis, and goes to 0.
    z = 1j * np.logspace(-2, 6, 200)
    size = [abs(1 + x * b @ np.linalg.solve(np.eye(8) - x * beta, one)) for x in z]
    assert max(size) < 1 + 1e-9 and size[-1] < 1e-4


def test_order_of_the_rosenbrock_method():
    """A nonautonomous equation of two arrays: the end and the dense output."""

    def rate(t, y, args):
        a, b = y["a"], y["b"]
        turned = jnp.stack([a[1] * jnp.cos(t) + b[0], -a[0] * a[1] + jnp.sin(3 * t)])
        return {"a": turned, "b": -b * a[:1] * t}

    start, times = {"a": jnp.asarray([1.0, 0.5]), "b": jnp.asarray([0.7])}, jnp.linspace(0.0, 2.0, 34)

    def run(h, solver=Rodas5P()):  # noqa: B008
        saveat, term = diffrax.SaveAt(ts=times), diffrax.ODETerm(rate)
        ys = diffrax.diffeqsolve(term, solver, 0.0, 2.0, h, start, saveat=saveat, max_steps=None).ys
        return jnp.concatenate(jax.tree.leaves(ys), axis=1)

    exact = np.asarray(quick(lambda h: run(h, diffrax.Dopri8()))(1e-3))
    found = np.asarray(quick(jax.vmap(run))(0.1 / 2.0 ** np.arange(4)))
    for error in (np.abs(found[:, -1] - exact[-1]).max(1), np.abs(found - exact).max((1, 2))):
        assert np.log2(error[:-1] / error[1:]).min() > 4.7, error
