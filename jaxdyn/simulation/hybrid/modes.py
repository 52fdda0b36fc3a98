"""What the elements with modes of a scene are, as rows of an extended scene, and what a mode is."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.constraints.base import layout
from jaxdyn.contact.unilateral import UnilateralContact, WithModes
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.systems.scene import Scene

KINDS = ("touch", "release", "stick", "slip", "turn")
CHANNELS = 3  # conditions of an element: on its normal force or gap, on its friction, on the pivot of its equations


class Element(NamedTuple):
    """Where an element's rows are among those of the extended scene.

    `place`: its index among the scene's forces. `normal`: the row whose multiplier is its normal force, -1 where that is
    given. `tangent`: the rows that slip. `opens`: whether it is unilateral, and `normal` its own. `smooth`: whether its friction
    is a function of the state.
    """

    name: str
    place: int
    normal: int
    tangent: tuple[int, ...]
    opens: bool
    smooth: bool


class Mode(NamedTuple):
    """Of each element (n,): whether it is closed, whether it sticks, and whether its normal multiplier is negative. Of the forces
    that are smooth in pieces: which of their switching functions are positive, (k,)."""

    closed: Array
    stick: Array
    negative: Array
    positive: Array

    def signs(self, dtype) -> Array:
        """Of the normal multipliers, (n,)."""
        return jnp.where(self.negative, -1.0, 1.0).astype(dtype)


class Elements(NamedTuple):
    """The elements of a scene, the number of rows of the scene's own constraints and of all, and its switching functions."""

    each: tuple[Element, ...]
    own: int
    count: int
    pieces: Pieces

    @property
    def names(self) -> tuple[str, ...]:
        """Of the events: every element with every kind, then every switching function."""
        return (*(f"{one.name}: {kind}" for one in self.each for kind in KINDS), *self.pieces.names)

    @property
    def switches(self) -> int:
        """Number of switching functions."""
        return len(self.pieces.names)

    def split(self, flat) -> tuple[Array, Array]:
        """Conditions as (n, CHANNELS) of the elements and (k,) of the switching functions."""
        count = CHANNELS * len(self.each)
        return flat[:count].reshape(-1, CHANNELS), flat[count:]

    @property
    def coupled(self) -> tuple[int, ...]:
        """The elements whose friction is in proportion to a multiplier."""
        return tuple(i for i, one in enumerate(self.each) if one.normal >= 0 and one.tangent)

    @property
    def opening(self) -> np.ndarray:
        """Which elements are unilateral, (n,)."""
        return np.array([one.opens for one in self.each])

    def active(self, mode: Mode) -> Array:
        """Which rows act, (count,)."""
        rows: list[Any] = [jnp.ones((), bool)] * self.count
        for i, one in enumerate(self.each):
            if one.opens:
                rows[one.normal] = mode.closed[i]
            for k in one.tangent:
                rows[k] = jnp.zeros((), bool) if one.smooth else mode.closed[i] & mode.stick[i]
        return jnp.stack(rows)


def force_at(scene: Scene, element: Element) -> Any:
    """The force of the scene that an element is."""
    return scene.forces[element.place]


def extended(scene: Scene) -> Scene:
    """The scene with the rows of its elements behind its own, and without these forces."""
    return Scene(
        scene.system,
        (*scene.constraints, *(_constraint(force) for force in scene.forces if isinstance(force, WithModes))),
        tuple(force for force in scene.forces if not isinstance(force, WithModes)),
    )


def _constraint(force: Any):
    return force.contact if isinstance(force, UnilateralContact) else force.along


def elements_of(scene: Scene, pieces: Pieces) -> Elements:
    """The elements of a scene; `pieces`: its switching functions.

    **Raises:** ValueError for rows that do not fit, and constraints that are not there.
    """
    places, own = layout(extended(scene)), len(scene.constraints)
    names = [place.name for place in places[:own]]
    elements, used = [], []
    chosen: list[Any] = [(i, force) for i, force in enumerate(scene.forces) if isinstance(force, WithModes)]
    for (i, force), place in zip(chosen, places[own:], strict=True):
        gap_rows, friction_rows = place.nonholonomic - place.start, place.end - place.nonholonomic
        tangent = tuple(range(place.nonholonomic, place.end))
        name = force.name
        while name in used:
            name = f"{name} ({i})" if name == force.name else f"{name}'"
        used.append(name)
        if isinstance(force, UnilateralContact):
            if gap_rows != 1 or friction_rows > 2:
                raise ValueError(
                    f"contact {name!r} has {gap_rows} rows on positions and {friction_rows} on velocities; a contact has "
                    "a gap and up to two rows without slip: leave out spin=True"
                )
            elements.append(Element(name, i, place.start, tangent, True, False))
            continue
        if gap_rows or not 1 <= friction_rows <= 2:
            raise ValueError(
                f"friction {name!r}: along has {gap_rows} rows on positions and {friction_rows} on velocities; give "
                "one or two on velocities"
            )
        normal = -1
        if force.constraint is not None:
            if force.constraint not in names:
                raise ValueError(f"friction {name!r}: the scene has no constraint {force.constraint!r}; it has {names}")
            at = names.index(force.constraint)
            normal = places[at].start
            if places[at].end - normal > 1 and scene.constraints[at].wrench_components() is None:
                raise ValueError(
                    f"friction {name!r}: constraint {force.constraint!r} has {places[at].end - normal} rows, of which none is a "
                    "normal force; name one with one row"
                )
        elements.append(Element(name, i, normal, tangent, False, force.smoothing is not None))
    return Elements(tuple(elements), places[own].start, places[-1].end, pieces)
