"""Derivatives of kernels of functions with rules of their own, to third order: against plain mode and closed forms."""

import functools

import jax
import jax.numpy as jnp
import jax.scipy.special
import numpy as np
import pytest
from kernel_helpers import assert_close, native, quick, root, root_derivatives

from jaxdyn import compile as backend
from jaxdyn.compile import target
from jaxdyn.compile.expansion import expand

pytestmark = pytest.mark.native
# Orders of forward and reverse mode, the innermost first.
WORDS = ("", "f", "ff", "fff", "fr", "r", "rf", "rfr", "rr", "rrr")


def _derivatives(function):
    """x, step -> derivatives of a weighted sum of function(x) to third order, in every order of forward and reverse mode."""

    def all_of(x, step):
        weights = jnp.cos(jnp.arange(x.size, dtype=x.dtype))

        def f(x):
            return jnp.vdot(weights, function(x))

        def forward(f):
            return lambda x: jax.jvp(f, (x,), (step,))[1]

        def reverse(f):
            return lambda x: jnp.vdot(jax.grad(f)(x), step)

        modes = {"f": forward, "r": reverse}
        return {word: functools.reduce(lambda g, mode: modes[mode](g), word, f)(x) for word in WORDS}

    return all_of


def _by_kernel(function, x, step):
    program = expand(jax.make_jaxpr(_derivatives(native(function)))(x, step), 10**6)[0]
    return dict(zip(WORDS, target.call(program, [np.asarray(x), np.asarray(step)]), strict=True))


@pytest.mark.long
def test_some_functions_of_jax_with_rules():
    """All orders of modes agree with plain mode: a choice, a removable singularity."""
    x, step = jnp.array([0.3, 0.62, 0.21]), jnp.array([0.7, -1.1, 0.4])
    for function in (jax.nn.relu, jnp.sinc):
        wanted = quick(_derivatives(function))(x, step)
        for word, value in _by_kernel(function, x, step).items():
            # Differences of exponentials of both signs, three times differentiated.
            assert_close(value, wanted[word], 1e-10, f"{function} {word}")


def test_closed_forms():
    """Third derivatives of sinc at its removable singularity and away from it, of softplus, logit and x log x."""
    s = 1 / (1 + np.exp(-0.3))
    cases = (
        (jnp.sinc, 0.0, (1.0, 0.0, -(np.pi**2) / 3, 0.0)),
        (jax.nn.softplus, 0.3, (np.log(1 + np.exp(0.3)), s, s * (1 - s), s * (1 - s) * (1 - 2 * s))),
        (lambda x: jax.scipy.special.xlogy(x, x), 0.3, (0.3 * np.log(0.3), np.log(0.3) + 1, 1 / 0.3, -1 / 0.09)),
        (
            jax.scipy.special.logit,
            0.3,
            (np.log(3 / 7), 1 / 0.21, (2 * 0.3 - 1) / 0.21**2, 2 * (0.3**3 + 0.7**3) / 0.21**3),
        ),
        (lambda x: jnp.logaddexp(x, 0.0), 0.3, (np.log(1 + np.exp(0.3)), s, s * (1 - s), s * (1 - s) * (1 - 2 * s))),
    )
    for function, x, wanted in cases:
        for word, value in _by_kernel(function, jnp.array([x]), jnp.ones(1)).items():
            assert_close(value, wanted[len(word)], 1e-9 if function is jnp.sinc else 1e-11, word)


def test_rules_that_call_their_own_function():
    """A root by the implicit function theorem, alone and within another kernel."""
    wanted = root_derivatives(1.3)
    for word, value in _by_kernel(lambda x: native(root)(x), jnp.array([1.3]), jnp.ones(1)).items():
        assert_close(value, wanted[len(word)], 1e-12, word)


def test_rules_of_kernels_that_call_functions_with_rules():
    """`tangent=` and `implicit`: the derivative of what a rule computes asks the rules of what it calls."""

    def rule(_, x, steps):
        return steps[0] * root(x)

    def f(x):
        return backend.kernel(lambda _, x: jnp.floor(x), derivative=rule)((), x).sum()

    def solve(_, x):
        return root(x)

    def change(_, x, steps):
        y = root(x)
        return y, steps[-1] / (1 + 3 * y**2)

    def g(x):
        return backend.kernel(lambda _, x: backend.implicit((), (x,), solve, change))((), x).sum()

    wanted = root_derivatives(1.3)
    x = jnp.array(1.3)
    for shift, function in ((1, f), (0, g)):
        second = quick(lambda x, h=function: (jax.grad(h)(x), jax.grad(jax.grad(h))(x), jax.jacfwd(jax.grad(h))(x)))(x)
        for value, order in zip(second, (1, 2, 2), strict=True):
            assert_close(value, wanted[order - shift], 1e-12)


def test_samples_that_are_repaired_keep_rules():
    """Second derivatives where a sample is computed by the careful function, and where it is not."""

    def function(_, x):
        return backend.mark_invalid(x < 0.5, jnp.sinc(x))

    x = jnp.array([0.0, 0.7])
    run = backend.kernel(function, fallback=lambda _, x: jnp.sinc(x))
    repaired = quick(jax.vmap(jax.grad(jax.grad(lambda x: run((), x)))))(x)
    assert_close(repaired, jax.vmap(jax.grad(jax.grad(jnp.sinc)))(x), 1e-12)
    assert_close(repaired[0], -(np.pi**2) / 3, 1e-12)
