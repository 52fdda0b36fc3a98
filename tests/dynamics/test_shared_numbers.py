"""What all samples of a batch share is computed by a kernel of its own, once a call."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pinocchio_bridge import quick

import jaxdyn as jd
from jaxdyn import compile as backend
from jaxdyn.compile import primitive

pytestmark = pytest.mark.native

iiwa = jd.robots.iiwa()


def numbers(least, a, b):
    """Numbers of a alone, of b alone and of both, of every kind, and results that do not vary; a program for each `least`."""
    size = jnp.sqrt(1 + a @ a)
    flag = a[0] > 0.5
    varying = jnp.where(flag, jnp.sin(size) * b, b - a[:2])
    return varying, jnp.stack([size, a[1] * a[2]]), flag & (b[0] > 0), jnp.where(flag, 3, 4) + jnp.zeros(2, jnp.int32)


def called(function, *args) -> list[str]:
    """Numbers of the kernels that a function calls."""
    return re.findall(r"program = (\d+)", jax.jit(function).lower(*args).as_text())


@pytest.mark.parametrize("least", [1, 10**6], ids=["divided", "whole"])
def test_numbers_that_do_not_vary(monkeypatch, least):
    monkeypatch.setattr(primitive, "MIN_SHARED_OPERATIONS", least)

    def compute(a, b):
        return backend.kernel(numbers, static=1)(least, a, b)

    def batch(a, b):
        return jax.vmap(lambda b: compute(a, b))(b)

    a, b = jnp.array([0.7, -0.3, 2.0]), jnp.asarray(np.random.default_rng(0).normal(size=(11, 2)))
    assert len(called(batch, a, b)) == (2 if least == 1 else 1)
    for x, y in zip(jax.jit(batch)(a, b), quick(jax.vmap(lambda b: numbers(least, a, b)))(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)
    assert len(called(jax.vmap(compute), jnp.stack([a] * 11), b)) == 1  # nothing is shared


@pytest.mark.long
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_dynamics_of_one_model_given_to_a_batch(dtype):
    """As with a model of its own for every sample; 2000 operations are of the model alone."""
    arrays, rest = eqx.partition(jax.tree.map(lambda x: x.astype(dtype), iiwa), eqx.is_array)
    q, v, tau = (jnp.asarray(x, dtype) for x in np.random.default_rng(1).normal(size=(3, 9, 7)))

    def acceleration(arrays, q, v, tau):
        return jd.forward_dynamics(eqx.combine(arrays, rest), q, v, tau)

    of_one, of_each = (jax.vmap(acceleration, (axis, 0, 0, 0)) for axis in (None, 0))
    each = jax.tree.map(lambda x: jnp.stack([x] * 9), arrays)
    assert len(called(of_one, arrays, q, v, tau)) == 2 and len(called(of_each, each, q, v, tau)) == 1
    tolerance = (
        {"rtol": 1e-12, "atol": 1e-11} if dtype == jnp.float64 else {"rtol": 1e-4, "atol": 1e-2}
    )  # of 1e3 rad/s^2
    one, many = quick(of_one)(arrays, q, v, tau), quick(of_each)(each, q, v, tau)
    np.testing.assert_allclose(one, many, **tolerance)

    def change(masses):
        return jnp.sum(jnp.sin(of_one(eqx.tree_at(lambda m: m.inertias, arrays, masses), q, v, tau)))

    if dtype == jnp.float64:
        step = jnp.asarray(np.random.default_rng(2).normal(size=arrays.inertias.shape))
        both = quick(lambda x, dx: (jax.grad(change)(x), jax.jvp(change, (x,), (dx,))[1]))
        gradient, forward = both(arrays.inertias, step)
        np.testing.assert_allclose(np.vdot(gradient, step), forward, rtol=1e-10)
