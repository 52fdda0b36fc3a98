"""Entry points: functions that users call outside of any trace, compiled once per shape."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from jaxdyn.compile import ahead, executables, mode
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.compile.known import is_concrete, is_tracing


def jit(function: Callable) -> Callable:
    """Compile a function, and keep what is compiled on disk: a second process traces it and compiles nothing.

    As `equinox.filter_jit`: arrays in the arguments are operands, everything else is a constant of the program. The program on
    disk is found by what tracing gives, all numbers within included: no change of the function, or of what it reads, gives
    another one's results. Under a transformation or another `jit`, and on devices other than CPUs, nothing is kept. Programs
    that call Python (`jax.pure_callback`) are not kept either.

    ```python
    @jd.jit
    def loss_gradient(model, q, v):
        return jax.grad(lambda v: jd.simulate(model, q, v, ts).q[-1].sum())(v)
    ```
    """
    return _compile(function, _usual_options)


def entry_point(function: Callable) -> Callable:
    """Compile a function that users call once per shape, its arrays being operands; a decorator.

    Within a trace it is the function as it stands: a nested `jit` would hide the values of known arrays.
    """
    return _compile(function, quick_options)


def _compile(function: Callable, options: Callable) -> Callable:
    usual = eqx.filter_jit(function)
    compiled = functools.cache(lambda: _jit(function, compiler_options=options()))

    @functools.wraps(function)
    def call(*args, **kwargs):
        if is_tracing():
            return function(*args, **kwargs)
        is_glue = _is_glue(jax.default_backend())
        if is_glue and _is_plain_call():
            found = executables.call(function, args, kwargs, options)
            if found is not None:
                return found
        # JAX refuses compiler options under a transformation such as `grad`, whose arguments are traced.
        if not (is_glue and is_concrete((args, kwargs))):
            return usual(*args, **kwargs)
        with ahead.worker(not mode.wants_usual_options()):
            return compiled()(*args, **kwargs)

    return call


def _usual_options() -> None:
    """XLA's own options, for functions that are more than calls of kernels."""


def _is_plain_call() -> bool:
    """Decide whether JAX is to run what it has compiled, without checks within the call."""
    options = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks", "jax_default_device")
    return not any(getattr(jax.config, name) for name in options)


_jit: Any = eqx.filter_jit

# What XLA compiles is the glue between kernels. Its emitters of fusions, each a module of its own, take most of the time to
# compile it and bring nothing at run time: `python -m benchmarks.first_calls`, and again with
# JAXDYN_COMPILATION_OPTIONS=usual in the environment.
_QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_LEAST = _QUICK | {"xla_backend_optimization_level": 0}


@functools.cache
def quick_options() -> dict[str, Any] | None:
    """Options with which XLA compiles glue quickly.

    None where the environment asks for the usual ones.
    """
    if mode.wants_usual_options():
        return None
    return select_options(_LEAST if mode.wants_least_optimisation() else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"
