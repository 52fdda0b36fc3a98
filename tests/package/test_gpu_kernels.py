"""Kernels for GPUs without one: their text on the CPU, thread by thread, against the CPU's kernels; their PTX; its registers."""

import functools
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpu_stand_in import recorded_calls, run_threads, uniform_of

import jaxdyn as jd
from jaxdyn import compile as backend
from jaxdyn.compile.gpu import ptx, text

pytestmark = pytest.mark.native

SAMPLES = 5
RNG = np.random.default_rng(0)
TS = np.linspace(0.0, 0.05, 3)


def random(*sizes, dtype=jnp.float64):
    return [jnp.asarray(RNG.normal(size=(SAMPLES, n)), dtype) for n in sizes]


@functools.cache
def arm(dtype=jnp.float64):
    return jd.robots.iiwa(dtype=dtype)


def dynamics(dtype=jnp.float64):
    model = arm(dtype)
    return lambda *x: jd.forward_dynamics(model, *x), random(model.nq, model.nv, model.nv, dtype=dtype)


def gradient(dtype=jnp.float64):
    function, args = dynamics(dtype)
    return jax.grad(lambda *x: jnp.sum(function(*x)), (0, 1, 2)), args


def starts(named):
    q, v = named.start()
    return [jnp.repeat(jnp.asarray(q)[None], SAMPLES, 0), jnp.linspace(0.9, 1.1, SAMPLES)[:, None] * jnp.asarray(v)[None]]


def motion(named, **options):
    scene = named()

    def end(q, v):
        solution = jd.simulate(scene, q, v, TS, throw=False, **options)
        return solution.q, solution.v

    return end, starts(named)


def constrained(named):
    scene = named()
    return lambda q, v: jd.constrained_dynamics(scene, q, v).acceleration, starts(named)


def projection():
    scene = jd.scenes.four_bar()
    q, v = starts(jd.scenes.four_bar)
    return lambda q, v: jd.assemble(scene, q, throw=False).q, [q + 0.01, v]


def adaptive():
    """A few of the samples end early, so that threads iterate unequally often."""
    function, (q, v) = motion(jd.scenes.four_bar)
    return function, [q, v * jnp.linspace(0.1, 3.0, SAMPLES)[:, None]]


def one_function(function, dtype=jnp.float64, scale=1.0):
    def call(x):
        return backend.kernel(lambda _, x: function(x), derivative=False)((), x)

    return call, [scale * x for x in random(3, dtype=dtype)]


def powers(x):
    return jnp.abs(x) ** 0.3 + jnp.exp(x) + jnp.log1p(x**2) + jnp.arctan2(x, x[::-1]) + jnp.tanh(x)


# A function of one sample with a batch of arguments, as a pair that is made when it is wanted.
CASES = {
    "forward dynamics of an arm": dynamics,
    "forward dynamics of an arm, float32": lambda: dynamics(jnp.float32),
    "gradient of forward dynamics": gradient,
    "constrained dynamics of a four-bar": lambda: constrained(jd.scenes.four_bar),
    "redundant rows, which are near no regular position": lambda: constrained(jd.scenes.bennett),
    "projection": projection,
    "fixed steps of an arm": lambda: (
        lambda q, v: jd.simulate(arm(), q, v, TS, stepsize=1e-2, throw=False).q, random(7, 7)
    ),
    "fixed steps of a four-bar": lambda: motion(jd.scenes.four_bar, stepsize=1e-2),
    "adaptive steps of a four-bar": adaptive,
    "sines of large angles": lambda: one_function(lambda x: jnp.sin(x) + jnp.cos(2 * x), scale=1e12),
    "sines of large angles, float32": lambda: one_function(jnp.sin, jnp.float32, 1e7),
    "powers and logarithms": lambda: one_function(powers),
    "pseudo-inverse": lambda: (
        lambda x: backend.pseudo_inverse_by_rotations(x.reshape(4, 3), 1e-9), random(12)
    ),
    "mass matrix": lambda: (lambda q: jd.mass_matrix(arm(), q), random(7)),
}  # fmt: skip


@functools.cache
def calls_of(name):
    function, args = CASES[name]()
    calls = recorded_calls(jax.vmap(function), *args)
    assert calls, "no kernel is called"
    return calls


@pytest.mark.parametrize("name", CASES)
def test_threads_compute_what_the_cpu_computes(name):
    for program, args, wanted in calls_of(name):
        for computed, want in zip(run_threads(program, args), wanted, strict=True):
            want = np.asarray(want)
            assert computed.shape == want.shape and computed.dtype == want.dtype
            if want.dtype.kind != "f":
                np.testing.assert_array_equal(computed, want)
                continue
            # The order of operations is the same; functions of the C library are others, and vectors have no pow.
            bound = (1e-12 if want.dtype == np.float64 else 2e-6) * max(1.0, np.abs(want).max(initial=0.0))
            np.testing.assert_allclose(computed, want, rtol=0, atol=bound)
