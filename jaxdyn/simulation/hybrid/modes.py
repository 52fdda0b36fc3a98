"""Contacts and frictions of a scene as rows of an extended scene, their modes, and the events between modes."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.contact.unilateral import UnilateralContact, WithModes
from jaxdyn.forces.piecewise import Pieces
from jaxdyn.systems.scene import Scene

KINDS = ("touch", "release", "stick", "slip", "turn", "inner")
CHANNELS = 3  # guards of an element: its normal force or gap, its friction, the pivot of its equations


class Element(NamedTuple):
    """A contact or friction, and its rows among those of the extended scene."""

    name: str
    place: int  # among the scene's forces
    normal: int  # row whose multiplier is the normal force, -1 if the force is given
    tangent: tuple[int, ...]  # rows that slip
    opens: bool  # true for a unilateral contact, which has a normal row of its own
    smooth: bool  # true if the friction is a function of the state


class Mode(NamedTuple):
    """Mode of a motion: flags of its elements (n,) and of its switching functions (k,)."""

    closed: Array
    stick: Array
    negative: Array  # true where the normal multiplier is negative
    positive: Array  # of the switching functions of piecewise smooth forces
    excess: Array  # friction (n,) beyond the cone, of all normal forces, by which an element that depends on others may stick
    # Speeds (n,). Positive: sliding has a fixed direction up to this speed. Negative: its direction is fixed below its size.
    creep: Array

    def signs(self, dtype) -> Array:
        """Signs of the normal multipliers, (n,)."""
        return jnp.where(self.negative, -1.0, 1.0).astype(dtype)


class Elements(NamedTuple):
    """Elements of a scene, numbers of rows of its own constraints and of all, and its switching functions."""

    each: tuple[Element, ...]
    own: int
    count: int
    pieces: Pieces

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the events: every element with every kind, then every switching function."""
        return (*(f"{one.name}: {kind}" for one in self.each for kind in KINDS), *self.pieces.names)

    @property
    def switches(self) -> int:
        """Number of switching functions."""
        return len(self.pieces.names)

    def split(self, flat) -> tuple[Array, Array]:
        """Split guards into those of the elements, (n, CHANNELS), and the switching functions, (k,)."""
        count = CHANNELS * len(self.each)
        return flat[:count].reshape(-1, CHANNELS), flat[count:]

    @property
    def frictional(self) -> tuple[int, ...]:
        """Indices of the elements whose friction is proportional to a multiplier."""
        return tuple(i for i, one in enumerate(self.each) if one.normal >= 0 and one.tangent)

    @property
    def opening(self) -> np.ndarray:
        """Mask of the unilateral elements, (n,)."""
        return np.array([one.opens for one in self.each])

    @property
    def rough(self) -> np.ndarray:
        """Mask of the elements that can stick, (n,)."""
        return np.array([bool(one.tangent) and not one.smooth for one in self.each])

    @property
    def planar(self) -> np.ndarray:
        """Mask of the elements that slide in two directions and can stick, (n,)."""
        return np.array([len(one.tangent) == 2 and not one.smooth for one in self.each])

    @property
    def smooth(self) -> np.ndarray:
        """Mask of the elements whose friction is a function of the state, (n,)."""
        return np.array([one.smooth for one in self.each])

    def active(self, mode: Mode) -> Array:
        """Mask of the rows that act in a mode, (count,)."""
        # The scene's own constraints act in every mode.
        rows: list[Any] = [jnp.ones((), bool)] * self.count
        for i, one in enumerate(self.each):
            if one.opens:
                rows[one.normal] = mode.closed[i]
            for row in one.tangent:
                rows[row] = jnp.zeros((), bool) if one.smooth else mode.closed[i] & mode.stick[i]
        return jnp.stack(rows)


def force_at(scene: Scene, element: Element) -> Any:
    """Force of the scene that belongs to an element."""
    return scene.forces[element.place]


def extend(scene: Scene) -> Scene:
    """Scene with the rows of its elements behind its own, and without these forces."""
    return Scene(
        scene.system,
        # Behind the scene's own rows, whose indices stay as they are: outputs take the first `own` multipliers.
        (*scene.constraints, *(_constraint(force) for force in scene.forces if isinstance(force, WithModes))),
        tuple(force for force in scene.forces if not isinstance(force, WithModes)),
    )


def _constraint(force: Any):
    return force.contact if isinstance(force, UnilateralContact) else force.along


def elements_of(scene: Scene, pieces: Pieces) -> Elements:
    """Elements of a scene; `pieces`: its switching functions.

    **Raises:** ValueError for rows that do not fit, and constraints that are not there.
    """
    places, own = layout(extend(scene)), len(scene.constraints)
    names = [place.name for place in places[:own]]
    elements, used = [], []
    chosen: list[Any] = [(i, force) for i, force in enumerate(scene.forces) if isinstance(force, WithModes)]
    for (i, force), place in zip(chosen, places[own:], strict=True):
        gap_rows, friction_rows = place.nonholonomic - place.start, place.end - place.nonholonomic
        tangent = tuple(range(place.nonholonomic, place.end))
        name = force.name
        # `Events.times` finds events by their names, so that two elements may not share one.
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
                    f"friction {name!r}: constraint {force.constraint!r} has {places[at].end - normal} rows, and no "
                    "normal force among them; name one with one row"
                )
        elements.append(Element(name, i, normal, tangent, False, force.smoothing is not None))
    return Elements(tuple(elements), places[own].start, places[-1].end, pieces)


class Events(eqx.Module):
    """Events of a motion in their order, as arrays of a fixed length.

    - `time` (ne,), s, NaN behind the last event; differentiable. `index` (ne,) among `names`, -1 behind the last event.
    - `names`: "<element>: <kind>". The kinds of a contact are "touch" and "release"; those of friction "stick" and "slip". A
      "turn" reverses the direction of sliding, or the sign of the normal force of a friction that holds on both sides. An
      "inner" event changes how a mode is computed, and not the motion.
      A touch at which infinitely many bounces accumulate has the time of rest, the limit of their series; its derivative is that
      of the last flight that was followed.
    - `count` (): number of events. Elements that change at the same time have one entry each, that of the guard which was
      crossed first in front.
    """

    time: Float[Array, "*batch ne"]
    index: Int[Array, "*batch ne"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def count(self) -> Int[Array, "*batch"]:
        """Number of events."""
        return (self.index >= 0).sum(-1)

    @property
    def name(self) -> np.ndarray:
        """Names (ne,) of the events, "" behind the last. **Raises:** ValueError inside `jax.jit`, which has no texts."""
        if not is_concrete(self.index):
            raise ValueError(
                "events.name are texts, which a traced program does not have; take events.index and events.names"
            )
        # The index -1 picks the last entry, the empty name.
        return np.array([*self.names, ""], dtype=object)[np.asarray(jax.device_get(self.index))]

    def times(self, name: str) -> np.ndarray:
        """Times of the events of one name, of a single motion.

        **Raises:** ValueError for an unknown name.
        """
        if name not in self.names:
            raise ValueError(f"events: there is no {name!r}; choose from {list(self.names)}")
        return np.asarray(self.time)[self.name == name]
