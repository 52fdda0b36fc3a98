"""Whether numbers are known while Python runs, and tracing or compiling once what is called many times."""

import contextvars
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxdyn._materialize import at_least, least_size
from jaxdyn._scalar_program import is_written_in_vectors, is_written_out
from jaxdyn._ways import way


def is_concrete(*trees) -> bool:
    """Whether every leaf is known, so that its value can be looked at."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def is_staged() -> bool:
    """Whether a program is being traced, so that operations on known numbers are traced too."""
    return isinstance(jnp.zeros(()), Tracer)


def is_known(*trees) -> bool:
    """Whether no number is traced, nor would be when computed with."""
    return not is_staged() and is_concrete(*trees)


_one_sample = contextvars.ContextVar("one_sample", default=False)


def is_one_sample() -> bool:
    """Whether the program that is traced was called with known numbers, so that no batch encloses it."""
    return _one_sample.get()


def _on_one_sample(function: Callable) -> Callable:
    def run(*args):
        token = _one_sample.set(True)
        try:
            return function(*args)
        finally:
            _one_sample.reset(token)

    return run


def compiled(function: Callable) -> Callable:
    """`function`, compiled once per shape; within a trace as it is, where a nested `jit` would hide what is known."""
    program, for_one = eqx.filter_jit(function), eqx.filter_jit(_on_one_sample(function))

    @functools.wraps(function)
    def call(*args):
        return (function if is_staged() else for_one if is_concrete(args) else program)(*args)

    return call


class _Leaves:
    """Leaves that equal others if they are the same objects; held, so that no other ones come to their places.

    Arrays of numpy, whose entries may be set, are copied and compared by what they hold.
    """

    def __init__(self, leaves):
        self.leaves = [leaf.copy() if isinstance(leaf, np.ndarray) else leaf for leaf in leaves]

    def __eq__(self, other):
        return len(self.leaves) == len(other.leaves) and all(map(_is_same, self.leaves, other.leaves))

    def __hash__(self):
        return hash(tuple(leaf.shape if isinstance(leaf, np.ndarray) else id(leaf) for leaf in self.leaves))


def _is_same(mine, theirs) -> bool:
    if not (isinstance(mine, np.ndarray) and isinstance(theirs, np.ndarray)):
        return mine is theirs
    kinds = (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)
    return kinds and mine.tobytes() == theirs.tobytes()


class Known(NamedTuple):
    """A pytree without its traced leaves; called with such leaves, it is the tree with them."""

    structure: Any
    places: tuple[int, ...]
    leaves: _Leaves

    def __call__(self, traced):
        full = list(self.leaves.leaves)
        for place, leaf in zip(self.places, traced, strict=True):
            full[place] = leaf
        return jax.tree.unflatten(self.structure, full)


def split(tree) -> tuple[list, Known]:
    """The traced leaves of a tree, and all the rest of it.

    What jax traces as an argument it does not know. Known leaves that go around its functions in a `Known` stay known.
    """
    leaves, structure = jax.tree.flatten(tree)
    places = tuple(i for i, leaf in enumerate(leaves) if isinstance(leaf, Tracer))
    known = _Leaves([None if isinstance(leaf, Tracer) else leaf for leaf in leaves])
    return [leaves[i] for i in places], Known(structure, places, known)


def still(tree):
    """The tree without derivatives. Only what is traced has any; what is known stays known."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if isinstance(x, Tracer) else x, tree)


def traced_once(function: Callable, tree, *args, static: tuple = ()):
    """function(tree, *args, *static), traced once in all programs that call it for the same tree and the same shapes.

    Leaves of the tree with known values stay known. Without a program that is traced it is a plain call.
    """
    if not is_staged():
        return function(tree, *args, *static)
    traced, known = split(tree)
    mode = is_one_sample(), is_written_out(), is_written_in_vectors(), way()
    return _program(function, known, static, least_size(), mode)(traced, *args)


@functools.lru_cache(maxsize=256)  # programs hold their trees
def _program(function, known: Known, static, least: int, _mode: tuple):
    def run(traced, *args):
        with at_least(least):
            return function(known(traced), *args, *static)

    return jax.jit(run)
