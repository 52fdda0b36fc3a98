"""Functions that the tests of the compiler share; nothing here knows of mechanics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyn import compile as backend
from jaxdyn.compile import target
from jaxdyn.compile.expansion import expand
from jaxdyn.compile.jax_adapter import select_options

# XLA compiles fast code that runs slowly: tests compile much and run little.
QUICK = select_options({"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})


def quick(function):
    """`jax.jit` that compiles fast and runs slowly."""
    return jax.jit(function, compiler_options=QUICK)


def native(function, *known):
    """The function as a kernel; the test fails where there is none."""
    return lambda *args: backend.kernel(lambda _, *args: function(*args), fallback=refuse)(known, *args)


def refuse(*_):
    """Instead of a fallback."""
    pytest.fail("there is no kernel")


def by_kernel(function, *args) -> list[np.ndarray]:
    """The results of a function by native code that is called without XLA."""
    program = expand(jax.make_jaxpr(function)(*args), 10**6)[0]
    return target.call(program, [np.asarray(x) for x in args])


def assert_close(computed, wanted, tolerance=1e-10, label=""):
    """Largest error at most `tolerance` times the largest number of the expected array (or 1e-3, where it is all zero)."""
    computed, wanted = np.asarray(computed, float), np.asarray(wanted, float)
    assert computed.shape == wanted.shape, (label, computed.shape, wanted.shape)
    assert np.isfinite(computed).all(), label
    error, size = np.abs(computed - wanted).max(initial=0.0), max(np.abs(wanted).max(initial=0.0), 1e-3)
    assert error <= tolerance * size, f"{label}: error {error:.3e}, size {size:.3e}"


@jax.custom_jvp
def root(x):
    """y with y + y^3 = x, by bisection, whose operations have no derivative."""

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        is_high = middle + middle**3 > x
        return jnp.where(is_high, low, middle), jnp.where(is_high, middle, high)

    low, high = jax.lax.fori_loop(0, 60, halve, (jnp.full_like(x, -4.0), jnp.full_like(x, 4.0)))
    return 0.5 * (low + high)


root.defjvp(lambda primals, steps: (root(primals[0]), steps[0] / (1 + 3 * root(primals[0]) ** 2)))


def root_derivatives(x):
    """y and its three derivatives, by hand."""
    y = np.roots([1.0, 0.0, 1.0, -x])
    y = float(y[np.abs(y.imag) < 1e-9][0].real)
    d = 1 + 3 * y**2
    return y, 1 / d, -6 * y / d**3, (108 * y**2 / d - 6) / d**4
