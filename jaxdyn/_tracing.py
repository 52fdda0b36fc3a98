"""Whether numbers are known while Python runs, and compiling what is called with known ones."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer


def is_concrete(*trees) -> bool:
    """Whether every leaf is known, so that its value can be looked at."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_staged() -> bool:
    """Whether a program is being traced, so that operations on known numbers are traced too."""
    return isinstance(jnp.zeros(()), Tracer)


def is_known(*trees) -> bool:
    """Whether no number is traced, nor would be when computed with."""
    return not is_staged() and is_concrete(*trees)


def compiled(function: Callable) -> Callable:
    """`function`, compiled once per shape; within a trace as it is, where a nested `jit` would hide what is known."""
    program = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*args):
        return (function if is_staged() else program)(*args)

    return call
