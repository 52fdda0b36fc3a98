"""What is known while Python runs: leaves of pytrees that are not traced."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile.jax_adapter import ShapedArray, Tracer, define_primitive


def is_concrete(*trees) -> bool:
    """Whether every leaf is known, so that its value can be looked at."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def numpy_for(*trees) -> Any:
    """numpy where every leaf is known, so that results stay known inside of traces too; jax.numpy where one is traced."""
    return np if is_concrete(*trees) else jnp


# Nothing but False, without an operand. Every call outside of a trace asks, which must not cost an operation of XLA.
_asked_p = define_primitive(
    "jaxdyn_asked",
    lambda: ShapedArray((), np.dtype(bool)),
    implement=lambda: np.False_,
    lower=lambda: jnp.zeros((), bool),
)


def is_staged() -> bool:
    """Whether a program is being traced, so that operations on known numbers are traced too."""
    return isinstance(lax.neg(1) if _asked_p is None else _asked_p.bind(), Tracer)


def is_known(*trees) -> bool:
    """Whether no number is traced, nor would be when computed with."""
    return is_concrete(*trees) and not is_staged()


def constant(tree):
    """The tree without derivatives. Leaves that are known stay known, which an operation on them would hide within a trace."""
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if isinstance(leaf, Tracer) else leaf, tree)


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


def partition_traced(tree) -> tuple[list, Known]:
    """The traced leaves of a tree, and all the rest of it.

    What jax traces as an argument it does not know. Known leaves that go around its functions in a `Known` stay known.
    """
    return partition(tree, lambda leaf: isinstance(leaf, Tracer))


def partition(tree, is_apart: Callable) -> tuple[list, Known]:
    """The leaves of a tree for which that is said, and all the rest of it."""
    leaves, structure = jax.tree.flatten(tree)
    places = tuple(i for i, leaf in enumerate(leaves) if is_apart(leaf))
    known = _Leaves([None if i in places else leaf for i, leaf in enumerate(leaves)])
    return [leaves[i] for i in places], Known(structure, places, known)
