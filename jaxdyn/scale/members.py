"""Members of a batch: arrays with one row for each, or draws from a seed."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxdyn.model.arguments import as_array
from jaxdyn.model.numbers import check_count, check_seed

MAX_MEMBERS = 2**32  # `fold_in` takes 32 bits


@dataclass(frozen=True)
class Members:
    """`count` members, each a pytree of its own.

    - `rows`: pytrees of arrays of numpy (count, ...), by argument; held by every process.
    - `draw`: a function from the key of a member to its parameters, or None; nothing is held. The key of member i is
      `jax.random.fold_in(jax.random.key(seed), i)`: a member depends neither on chunks nor on devices nor on processes.
    """

    count: int
    rows: dict[str, Any]
    draw: Callable | None
    seed: int

    def inputs(self, numbers: np.ndarray) -> dict[str, Any]:
        """Inputs of a program for these members, with a leading axis."""
        return {"number": numbers.astype(np.uint32), "rows": jax.tree.map(lambda x: x[numbers], self.rows)}

    def one(self, given: dict[str, Any]) -> tuple[Any, Any]:
        """Parameters (None without any) and row of one member, traced."""
        if self.draw is None:
            return given["rows"].get("parameters"), given["rows"]
        return self.draw(jax.random.fold_in(jax.random.key(self.seed), given["number"])), given["rows"]

    def description(self) -> dict[str, Any]:
        """Identity of these members, by argument."""
        seed = None if self.draw is None else self.seed
        return {"samples": self.count, "seed": seed, "values": digest(self.rows)}


def members(named: dict[str, Any], draw: Callable | None, samples: int | float | None, seed: int) -> Members:
    """Members from pytrees with equal leading axes, by the arguments that hold them, and from draws.

    **Raises:** ValueError for axes that differ, naming two arguments; for a draw without `samples`; for no members.
    """
    sizes, rows = {}, {}
    for argument, tree in named.items():
        paths, structure = jax.tree_util.tree_flatten_with_path(tree)
        leaves = {argument + jax.tree_util.keystr(path): leaf for path, leaf in paths}
        arrays = {name: np.asarray(as_array(leaf, name)) for name, leaf in leaves.items()}
        for name, array in arrays.items():
            if array.ndim == 0:
                raise ValueError(f"{name} is one number; give one for each rollout, or put it into the scene")
            sizes[name] = len(array)
        rows[argument] = jax.tree.unflatten(structure, arrays.values())
    if samples is not None:
        sizes["samples"] = check_count(samples, "samples")
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
    return Members(size, rows, draw, check_seed(seed))


def member(parameters: PyTree, number: int, seed: int = 0) -> PyTree:
    """Parameters of rollout `number` of `jd.scale.run` and `jd.scale.evaluate`, to compute it again.

    **Arguments:** `parameters` and `seed` as they were passed there.

    **Raises:** ValueError for a number of a rollout or a seed that is negative or no integer.
    """
    seed = check_seed(seed)
    # As in `Members.one`, which the program of a batch traces.
    if callable(parameters):
        return parameters(jax.random.fold_in(jax.random.key(seed), jnp.uint32(number)))
    return jax.tree.map(lambda x: jnp.asarray(x)[number], parameters)


def digest(tree: Any) -> str:
    """Hash of the values, shapes and paths of a pytree of arrays."""
    # With dtypes and shapes: equal bytes of other types are other inputs.
    hashed = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        # The hash reads a buffer, which an array with strides does not have in one piece.
        array = np.ascontiguousarray(leaf)
        hashed.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        hashed.update(array.data)
    # 64 bits tell inputs apart, and are short enough for an error message.
    return hashed.hexdigest()[:16]
