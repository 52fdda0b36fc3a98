"""Numbers that a user picks out of a system or a scene, and the coordinates in which they are searched."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene


class Chosen(eqx.Module):
    """Map from coordinates y (p,), zero at the start, to a system, or a scene, with the chosen leaves at x(y).

    x = x0 exp(y) for numbers that are positive, so that no y has one of another sign; x = x0 + unit y for the others.
    """

    given: Any
    origin: Float[Array, " p"]
    unit: Float[Array, " p"]
    positive: Float[Array, " p"]
    places: tuple[int, ...] = eqx.field(static=True)

    def values(self, y: Float[Array, " p"]) -> Float[Array, " p"]:
        """x (p,): x0 exp(y) where positive, x0 + unit y elsewhere."""
        factor = jnp.exp(jnp.where(self.positive > 0, y, jnp.zeros_like(y)))
        return jnp.where(self.positive > 0, self.origin * factor, self.origin + self.unit * y)

    def slopes(self, y: Float[Array, " p"]) -> Float[Array, " p"]:
        """dx_i/dy_i (p,)."""
        return jnp.where(self.positive > 0, self.values(y), self.unit)

    def system(self, y: Float[Array, " p"]) -> Any:
        """What was given, with the numbers of y."""
        leaves, structure = jax.tree.flatten(self.given)
        x, begin = self.values(y), 0
        for place in self.places:
            leaf = leaves[place]
            leaves[place] = x[begin : begin + leaf.size].reshape(leaf.shape).astype(leaf.dtype)
            begin += leaf.size
        return jax.tree.unflatten(structure, leaves)

    def scene(self, y: Float[Array, " p"]) -> Scene:
        """The scene with the numbers of y."""
        system = self.system(y)
        return as_scene(system)


class _Leaf:
    """Stands for a leaf while a user's function picks it."""

    def __init__(self, place: int, name: str):
        self.place, self.name = place, name


def choose(system, positive, free, dtype) -> tuple[Chosen, tuple[str, ...]]:
    """The leaves that `positive` and `free` pick, and the name of every number in them.

    **Raises:** ValueError as `fit_parameters` says.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(system)
    leaves = [leaf for _, leaf in paths]
    names = [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths]
    marked = jax.tree.unflatten(structure, [_Leaf(i, name) for i, name in enumerate(names)])
    bodies = [x for x in jax.tree.leaves(system, is_leaf=lambda x: isinstance(x, Model)) if isinstance(x, Model)]
    picked: list[tuple[int, bool]] = []
    for argument, where in (("positive", positive), ("free", free)):
        for leaf in [] if where is None else _picked(where, marked, argument, type(system).__name__):
            value = leaves[leaf.place]
            if not eqx.is_inexact_array_like(value):
                raise ValueError(f"{argument} picks {leaf.name}, which is {value!r} and no floating-point number")
            if any(value is model.inertias for model in bodies):
                raise ValueError(
                    f"{argument} picks {leaf.name}, the inertias of bodies, of which few choices are physical; fit them "
                    "with jd.identify.fit_torques or fit_trajectory"
                )
            if any(leaf.place == other for other, _ in picked):
                raise ValueError(f"{argument} picks {leaf.name} a second time; pick every leaf once")
            if argument == "positive" and not (np.asarray(value) > 0).all():
                raise ValueError(
                    f"positive picks {leaf.name}, which is {np.asarray(value).tolist()}; start above zero, or pick it in free"
                )
            picked.append((leaf.place, argument == "positive"))
    if not picked:
        raise ValueError("nothing to fit; pick leaves, e.g. positive=lambda system: system.parameters['mass']")
    values = [np.asarray(leaves[place], np.float64) for place, _ in picked]
    origin = np.concatenate([value.reshape(-1) for value in values])
    signs = np.concatenate([np.full(value.size, float(sign)) for value, (_, sign) in zip(values, picked, strict=True)])
    numbered = [
        names[place] + "".join(f"[{i}]" for i in index)
        for value, (place, _) in zip(values, picked, strict=True)
        for index in np.ndindex(value.shape)
    ]
    unit = np.where(origin == 0, 1, np.abs(origin))
    places = tuple(place for place, _ in picked)
    arrays = [jnp.asarray(leaf) if place in places else leaf for place, leaf in enumerate(leaves)]
    chosen = Chosen(
        given=jax.tree.unflatten(structure, arrays),
        origin=jnp.asarray(origin, dtype),
        unit=jnp.asarray(unit, dtype),
        positive=jnp.asarray(signs, dtype),
        places=places,
    )
    return chosen, tuple(numbered)


def _picked(where, marked, argument: str, kind: str) -> list[_Leaf]:
    """The leaves that a user's function picks.

    **Raises:** ValueError for a function that fails, or gives anything else.
    """
    example = f"write e.g. {argument}=lambda system: system.parameters['mass']"
    if not callable(where):
        raise ValueError(f"{argument} is {where!r}; pass a function that picks leaves, {example}")
    try:
        leaves = jax.tree.leaves(where(marked))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{argument} picks nothing of this {kind} ({type(error).__name__}: {error}); {example}, of whole leaves"
        ) from error
    strange = [leaf for leaf in leaves if not isinstance(leaf, _Leaf)]
    if strange or not leaves:
        raise ValueError(
            f"{argument} picks {strange[0] if strange else 'nothing'!r}, which is no leaf of this {kind}; {example}"
        )
    return leaves
