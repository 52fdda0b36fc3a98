"""What the members of a batch are made of: arrays with one row for each, or draws from a seed."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxdyn.model.arguments import as_array

MAX_MEMBERS = 2**32  # members that a key counts


@dataclass(frozen=True)
class Members:
    """`count` members, each a pytree of its own.

    - `rows`: a pytree of arrays of numpy (count, ...), or None; held by every process.
    - `draw`: a function from the key of a member to what is drawn for it, or None; nothing is held. The key of member i is
      `jax.random.fold_in(jax.random.key(seed), i)`: what a member is depends on neither blocks nor devices nor processes.
    """

    count: int
    rows: Any = None
    draw: Callable | None = None
    seed: int = 0

    def inputs(self, numbers: np.ndarray) -> dict[str, Any]:
        """What a program takes for these members, with a leading axis."""
        return {"number": numbers.astype(np.uint32), "rows": jax.tree.map(lambda x: x[numbers], self.rows)}

    def one(self, given: dict[str, Any]) -> tuple[Any, Any]:
        """Traced, of one member: what was drawn (None without `draw`) and its row."""
        drawn = None
        if self.draw is not None:
            drawn = self.draw(jax.random.fold_in(jax.random.key(self.seed), given["number"]))
        return drawn, given["rows"]

    def description(self) -> dict[str, Any]:
        """What tells these members from others, by argument."""
        return {
            "samples": self.count,
            "seed": self.seed if self.draw is not None else None,
            "values": digest(self.rows),
        }


def members(named: dict[str, Any], draw: Callable | None, samples: int | None, seed: int) -> Members:
    """Members of arrays, by the argument that they are, each a pytree with equal leading axes, and of draws.

    **Raises:** ValueError for axes that differ, naming two arguments; for a draw without `samples`; for no members.
    """
    sizes: dict[str, int] = {}
    rows = {}
    for argument, tree in named.items():
        places = jax.tree_util.tree_flatten_with_path(tree)[0]
        for path, leaf in places:
            name = argument + jax.tree_util.keystr(path)
            array = np.asarray(as_array(leaf, name))
            if array.ndim == 0:
                raise ValueError(f"{name} is one number; give one for each rollout, or put it into the scene")
            sizes[name] = len(array)
        rows[argument] = jax.tree.map(lambda x: np.asarray(as_array(x, "rows")), tree)
    if samples is not None:
        sizes["samples"] = samples
    if draw is not None and samples is None:
        raise ValueError("parameters is a function that draws, and samples is None; say how many rollouts to draw")
    if not sizes:
        raise ValueError("samples is None, and no array has an axis of rollouts; say how many there are")
    (first, size), *others = sizes.items()
    for name, other in others:
        if other != size:
            raise ValueError(f"{first} is of {size} rollouts and {name} of {other}; give as many of each")
    if not 0 < size < MAX_MEMBERS:
        raise ValueError(f"{first} is of {size} rollouts; give from 1 to 2^32 - 1")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < MAX_MEMBERS:
        raise ValueError(f"seed is {seed!r}; give a whole number from 0 to 2^32 - 1")
    return Members(size, rows, draw, int(seed))


def member(parameters: PyTree, number: int, seed: int = 0) -> PyTree:
    """The parameters of rollout `number`, as `jd.scale.run` and `jd.scale.evaluate` give them: to look at one again.

    **Arguments:** `parameters` and `seed` as they were passed there.
    """
    if callable(parameters):
        return parameters(jax.random.fold_in(jax.random.key(seed), jnp.uint32(number)))
    return jax.tree.map(lambda x: jnp.asarray(x)[number], parameters)


def digest(tree: Any) -> str:
    """A hash of the numbers of a pytree, their shapes and their places."""
    hashed = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        array = np.ascontiguousarray(leaf)
        hashed.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        hashed.update(array.data)
    return hashed.hexdigest()[:16]
