"""Known and traced leaves of pytrees, and functions that keep known values known."""

import contextlib
import functools
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, Tracer, define_primitive


def is_concrete(*trees) -> bool:
    """Decide whether no leaf is traced, so that its value can be read."""
    return not any([isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees)])


def as_numpy_if_known(array: object) -> Any:
    """Convert a leaf with known values to numpy; a traced leaf is returned unchanged."""
    # Numpy operations on known numbers run at trace time, so their zeros are dropped before anything is compiled.
    return np.asarray(array) if array is not None and is_concrete(array) else array


def array_namespace(*trees) -> Any:
    """NumPy where no leaf is traced, else `jax.numpy`: results of known numbers then stay known inside of a trace."""
    return np if is_concrete(*trees) else jnp


# A primitive without operands whose value is False: bound under a trace it gives a tracer. Every call outside of a trace asks,
# which must not cost an operation of XLA.
_asked_p = define_primitive(
    "jaxdyn_asked",
    lambda: ShapedArray((), np.dtype(bool)),
    implement=lambda: np.False_,
    lower=lambda: jnp.zeros((), bool),
)


def is_tracing() -> bool:
    """Decide whether a program is being traced, so that operations on known arrays give tracers too."""
    return isinstance(lax.neg(1) if _asked_p is None else _asked_p.bind(), Tracer)


def keep_known() -> contextlib.AbstractContextManager[None]:
    """Context in which operations on known numbers have known results, also while a program is traced.

    Outside of traces they have, and there the context of JAX would make a program of each known operation of a function that is
    compiled within it.
    """
    return jax.ensure_compile_time_eval() if is_tracing() else contextlib.nullcontext()


def is_known(*trees) -> bool:
    """Decide whether no leaf is traced and results of operations on them are known too."""
    return is_concrete(*trees) and not is_tracing()


def stop_gradient(tree):
    """Stop the derivatives of a tree; `lax.stop_gradient` of a known leaf would turn it into a tracer within a trace."""
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if isinstance(leaf, Tracer) else leaf, tree)


_PLAIN = (bool, int, float, str)


class _Leaves:
    """Leaves compared by identity, for keys of caches; held, so that no other object gets the identity of one of them.

    NumPy arrays, whose entries may be set, are copied and compared by value, as numbers and texts of Python are.
    """

    def __init__(self, leaves):
        self.leaves = [leaf.copy() if isinstance(leaf, np.ndarray) else leaf for leaf in leaves]

    def __eq__(self, other):
        return len(self.leaves) == len(other.leaves) and all(map(_is_same, self.leaves, other.leaves))

    def __hash__(self):
        arrays = [leaf.shape if isinstance(leaf, np.ndarray) else None for leaf in self.leaves]
        others = [
            leaf if type(leaf) in _PLAIN else id(leaf) for leaf, x in zip(self.leaves, arrays, strict=True) if x is None
        ]
        return hash((*arrays, *others))


def _is_same(mine, theirs) -> bool:
    if mine is theirs:
        return True
    if not (isinstance(mine, np.ndarray) and isinstance(theirs, np.ndarray)):
        # By their texts: 0.0 and -0.0 are equal, and are other constants.
        return type(mine) is type(theirs) and type(mine) in _PLAIN and repr(mine) == repr(theirs)
    kinds = (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)
    return kinds and mine.tobytes() == theirs.tobytes()


class Known(NamedTuple):
    """A pytree without its traced leaves; called with such leaves, it is the tree with them."""

    structure: Any
    places: tuple[int, ...]
    leaves: _Leaves

    @property
    def digest(self) -> str:
        """Hash of the known leaves by their values."""
        arrays = [None if leaf is None else np.asarray(leaf) for leaf in self.leaves.leaves]
        parts = [b"" if x is None else f"{x.dtype} {x.shape} ".encode() + x.tobytes() for x in arrays]
        return hashlib.sha256(b" ".join(parts)).hexdigest()

    def __call__(self, traced):
        full = list(self.leaves.leaves)
        for place, leaf in zip(self.places, traced, strict=True):
            full[place] = leaf
        return jax.tree.unflatten(self.structure, full)


def partition_tracers(tree) -> tuple[list, Known]:
    """The traced leaves of a tree, and the rest as a `Known`, which makes the tree of such leaves.

    Arguments of functions that JAX traces become tracers. Known leaves that are captured in a `Known` stay known.
    """
    return partition(tree, Tracer)


def partition(tree, types: type | tuple[type, ...]) -> tuple[list, Known]:
    """The leaves of a tree that are of these types, and the rest of it."""
    leaves, structure = jax.tree.flatten(tree)
    places = tuple(i for i, leaf in enumerate(leaves) if isinstance(leaf, types))
    known = _Leaves([None if i in places else leaf for i, leaf in enumerate(leaves)])
    return [leaves[i] for i in places], Known(structure, places, known)


def once(function: Callable) -> Callable:
    """Compute what a function makes of known trees once for the same leaves and modes; a decorator.

    `function(*trees, **static)` has no effects, and its results are never changed; `static` is hashable. Within a trace, or of
    traced leaves, nothing is kept.
    """
    by_identity: dict[tuple, tuple] = {}  # with the trees, so that no other object gets the identity of one of them

    @functools.lru_cache(maxsize=256)
    def by_leaves(known: Known, static: tuple, context):
        del context  # part of the key alone
        return function(*known(()), **dict(static))

    @functools.wraps(function)
    def call(*trees, **static):
        context, items = (jax.config.read("jax_enable_x64"), mode.state()), tuple(static.items())
        key = (*[repr(x) if type(x) in _PLAIN else id(x) for x in trees], items, context)
        try:
            kept = by_identity.get(key)
        except TypeError:  # what is static has no hash, and may be refused by the function
            return function(*trees, **static)
        if is_tracing():
            return function(*trees, **static)
        if kept is not None:
            return kept[1]
        traced, known = partition_tracers(trees)
        if traced or not _is_hashable(known):
            return function(*trees, **static)
        result = by_leaves(known, items, context)
        if _is_fixed(known):
            if len(by_identity) >= 256:
                by_identity.clear()
            by_identity[key] = trees, result
        return result

    return call


def _is_hashable(known: Known) -> bool:
    try:
        hash(known)
    except TypeError:  # users' objects in the structure
        return False
    return True


def _is_fixed(known: Known) -> bool:
    """Decide whether nothing in a tree can be replaced, so that the same object is the same tree."""

    def has_fixed_nodes(structure) -> bool:
        data = structure.node_data()
        is_fixed = data is None or data[0] in (tuple, type(None)) or issubclass(data[0], eqx.Module)
        return is_fixed and all(map(has_fixed_nodes, structure.children()))

    return has_fixed_nodes(known.structure) and not any(isinstance(x, np.ndarray) for x in known.leaves.leaves)


def as_constant(tree) -> Known:
    """A tree of concrete leaves as one static argument of an entry point, which compiles its numbers in.

    Called with () it is the tree.
    """
    return partition(jax.tree.map(as_numpy_if_known, tree), ())[1]
