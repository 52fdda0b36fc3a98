"""Functions that are called with known numbers, compiled once."""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from jaxdyn.compile import mode
from jaxdyn.compile.known import Known, is_concrete, is_staged, partition_traced

_MOST_NUMBERS = 10_000  # beyond which a tree is no input of mechanics, but data that no program should contain


def compiled(function: Callable) -> Callable:
    """`function`, compiled once per shape and mode; within a trace as it is, where a nested `jit` would hide what is known."""

    @eqx.filter_jit
    def program(mode, *args):
        del mode  # of which there is one program each
        return function(*args)

    @functools.wraps(function)
    def call(*args):
        return function(*args) if is_staged() else program(mode.current(), *args)

    return call


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
