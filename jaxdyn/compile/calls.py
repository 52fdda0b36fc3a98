"""Functions that are called with known numbers, compiled once."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.garbage import uncollected
from jaxdyn.compile.jax_adapter import known_options
from jaxdyn.compile.known import Known, is_concrete, is_staged, partition_traced

_MOST_NUMBERS = 10_000  # beyond which a tree is no input of mechanics, but data that no program should contain


def compiled(function: Callable) -> Callable:
    """`function`, compiled once per shape and mode; within a trace as it is, where a nested `jit` would hide what is known."""

    @uncollected
    def program(mode, *args):
        del mode  # of which there is one program each
        return function(*args)

    @functools.wraps(program)
    def program_for_now(*args):
        with mode.called_at_once(not mode.wants_usual_options()):
            return program(*args)

    usual = eqx.filter_jit(program)
    quick = functools.cache(lambda: _jit(program_for_now, compiler_options=quick_options()))

    @functools.wraps(function)
    def call(*args):
        if is_staged():
            return function(*args)
        # JAX takes options for a program that stands in no transformation.
        is_glue = _is_glue(jax.default_backend()) and is_concrete(args)
        return (quick() if is_glue else usual)(mode.current(), *args)

    return call


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
    return known_options(_LEAST if mode.wants_least_optimisation() else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"


def specialized(function: Callable) -> Callable:
    """`function(tree, *args)`, compiled for the numbers of the first tree of a shape, and once more for all others.

    Most runs are of one mechanism, whose zeros and ones leave a third of the operations of a program that takes any numbers. Who
    varies the numbers waits for that program too, once. Which one serves a call is decided by `first_numbers`.
    """
    general = compiled(function)
    special = compiled(lambda known, *args: function(known(()), *args))

    @functools.wraps(function)
    def call(tree, *args):
        if is_staged():
            return function(tree, *args)
        known = first_numbers(tree)
        return general(tree, *args) if known is None else special(known, *args)

    return call


_first: dict = {}


def first_numbers(tree) -> Known | None:
    """The tree with its numbers known, if those are the first ones of trees like it; None for other numbers and traced ones.

    Trees are alike if they have the same structure and arrays of the same shapes and types.
    """
    leaves, structure = jax.tree.flatten(tree)
    if mode.current() != "auto" or not is_concrete(leaves):
        return None
    shapes = tuple((x.shape, x.dtype) if hasattr(x, "shape") else type(x) for x in leaves)
    if sum(np.size(x) for x in leaves) > _MOST_NUMBERS:
        return None
    first = _first.setdefault((structure, shapes), partition_traced(tree)[1])
    return first if all(map(_is_equal, first.leaves.leaves, leaves)) else None


def _is_equal(mine, theirs) -> bool:
    # By bytes: -0.0 is another number than 0.0, and NaN is itself.
    return mine is theirs or np.asarray(mine).tobytes() == np.asarray(theirs).tobytes()
