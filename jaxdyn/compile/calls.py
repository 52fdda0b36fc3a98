"""Functions that are called with known numbers, compiled once."""

import functools
from collections.abc import Callable

import equinox as eqx

from jaxdyn.compile import mode
from jaxdyn.compile.known import is_staged


def compiled(function: Callable) -> Callable:
    """`function`, compiled once per shape and mode; within a trace as it is, where a nested `jit` would hide what is known."""
    programs: dict = {}

    @functools.wraps(function)
    def call(*args):
        if is_staged():
            return function(*args)
        name = mode.current()
        if name not in programs:
            programs[name] = eqx.filter_jit(function)
        return programs[name](*args)

    return call
