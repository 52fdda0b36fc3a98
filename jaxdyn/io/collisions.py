"""Contacts of the collision shapes of a file with its ground."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.contact.shape_contacts import HeightField, shape_contacts
from jaxdyn.contact.shapes import Box, Capsule, ConvexHull, hull_vertices
from jaxdyn.contact.surfaces import Cylinder, Ellipsoid, Plane, Sphere
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.dynamics.kinematics import named_frame
from jaxdyn.io.chains import Names
from jaxdyn.io.loaded import summarize
from jaxdyn.io.solids import Element, Solid
from jaxdyn.model import host_math
from jaxdyn.model.builder import unknown
from jaxdyn.model.numbers import check_count
from jaxdyn.model.tree import Model

FRICTION = 1.0  # where a format or a file has none: the default of Gazebo and of MuJoCo
# Contacts of a mesh. The equations of a step grow with the square of the number of contacts.
_MOST_VERTICES = 12
# Contacts that "ground" gives: of more, the first call of a step takes minutes, and each step a second or so.
_MOST_CONTACTS = 64


class Collision(NamedTuple):
    """Collision shape of a link: its frame (None: the world), its pose (4, 4) in it, its friction coefficient.

    `key`: of the file's rules, which say what touches what.
    """

    frame: str | None
    pose: np.ndarray
    solid: Solid | HeightField
    friction: float
    key: Any = None


def check_choice(contacts: Any) -> str | tuple[str, ...] | dict[str, int] | None:
    """Check the option `contacts` of a reader. **Raises:** ValueError."""
    if contacts is None or (isinstance(contacts, str) and contacts == "ground"):
        return contacts
    if isinstance(contacts, Mapping):
        for name, lowest in contacts.items():
            check_count(lowest, f"contacts[{name!r}]")
        return dict(contacts)
    names = tuple(contacts) if isinstance(contacts, Iterable) and not isinstance(contacts, str) else (None,)
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"contacts is {contacts!r}; give 'ground', a list of names of links that touch it, or None")
    return names  # pyright: ignore[reportReturnType]


def contacts_with_ground(
    model: Model,
    collisions: Sequence[Collision],
    contacts: str | Iterable[str],
    friction_of: Any = None,
) -> tuple[list[UnilateralContact], list[str], set[str]]:
    """Contacts of the chosen links with planes and height fields that are fixed to the world, else with its plane z = 0.

    `contacts`: "ground", links, or links with the number of their lowest corners that touch. `friction_of(a, b)`: the
    coefficient of two collisions, None for a pair that does not touch; by default the smaller one.

    **Returns:** contacts; descriptions of what is left out; the links that have contacts.

    **Raises:** ValueError for chosen links without a shape, and for more than 64 contacts of "ground".
    """
    grounds = [one for one in collisions if _is_ground(one) and _is_fixed(model, one)]
    known = list(dict.fromkeys(str(one.frame) for one in collisions if one.frame is not None))
    chosen = known if isinstance(contacts, str) else list(contacts)
    for name in chosen:
        if name not in known:
            raise ValueError(f"contacts: {unknown('link', name, known)}; it has no collision shape")
    friction_of = friction_of or (lambda a, b: min(a.friction, b.friction))
    floor = Collision(None, np.eye(4), Solid("plane", (0.0, 0.0, 1.0)), np.inf)
    names, made, taken, left, hulls = Names(), [], set(), [], []
    counts = {name: sum(one.frame == name for one in collisions) for name in chosen}
    places = dict.fromkeys(chosen, 0)
    for one in collisions:
        if _is_fixed(model, one):
            if not _is_ground(one):
                left.append(f"{one.frame or 'world'} (fixed)")
            continue
        if one.frame not in counts:
            continue
        if _is_ground(one):
            left.append(f"{one.frame} (a plane or height field that moves)")
            continue
        place, places[one.frame] = places[one.frame], places[one.frame] + 1
        assert isinstance(one.solid, Solid)
        shape, note = _shape(one.solid, str(one.frame))
        hulls += note
        for k, ground in enumerate(grounds or [floor]):
            friction = friction_of(one, ground) if grounds else one.friction
            if friction is None:
                continue
            on, turn = _ground(ground)
            name = one.frame + (f" {place}" if counts[one.frame] > 1 else "") + (f" on {k}" if len(grounds) > 1 else "")
            options: dict[str, Any] = {"surface": ground.pose @ turn, "surface_body": ground.frame}
            if isinstance(contacts, Mapping) and isinstance(shape, (Box, ConvexHull)) and isinstance(on, Plane):
                options["lowest"] = contacts[one.frame]
            made += shape_contacts(
                one.frame, shape, one.pose, on=on, friction=friction, name=names.new(name), **options
            )
            taken.add(one.frame)
    if isinstance(contacts, str) and len(made) > _MOST_CONTACTS:
        raise ValueError(
            f"contacts='ground' gives {len(made)} contacts, of the links {', '.join(sorted(taken))}; a step takes time with the "
            f"cube of their number, and {_MOST_CONTACTS} are the most of 'ground'. List the links that touch, as "
            "contacts=['left_foot', 'right_foot'], or with the number of their lowest corners, {'left_foot': 4}"
        )
    return (
        made,
        [
            *summarize("collision shapes without contacts", list(dict.fromkeys(left))),
            *summarize("hulls of meshes", hulls),
        ],
        taken,
    )


def collision_of(element: Element, friction: float) -> list[Collision]:
    """Collisions of a <collision> of a URDF or SDF file."""
    return [Collision(element.frame, element.pose, solid, friction) for solid in element.solids]


def _is_ground(one: Collision) -> bool:
    return isinstance(one.solid, HeightField) or one.solid.kind == "plane"


def _is_fixed(model: Model, one: Collision) -> bool:
    return one.frame is None or named_frame(model, one.frame)[0] < 0


def _ground(one: Collision) -> tuple[Plane | HeightField, np.ndarray]:
    """Ground with the pose (4, 4) of its axes in those of the collision."""
    if isinstance(one.solid, HeightField):
        return one.solid, np.eye(4)
    return Plane(), host_math.rotation_from_z(np.asarray(one.solid.size) / np.linalg.norm(one.solid.size))


def _shape(solid: Solid, owner: str) -> tuple[Any, list[str]]:
    """Shape of a solid, and a description of what it leaves out."""
    size = np.asarray(solid.size)
    if solid.kind == "mesh":
        assert solid.vertices is not None
        hull, count, error = hull_vertices(solid.vertices * size, _MOST_VERTICES)
        # A small part of a mesh is exact.
        note = [f"{owner} ({len(hull)} of {count} vertices, within {error:.2g} m)"] if len(hull) < count else []
        return ConvexHull(hull), note
    if solid.kind == "ellipsoid":
        return (Sphere(size[0]) if (size == size[0]).all() else Ellipsoid(size)), []
    return {"box": lambda: Box(size), "capsule": lambda: Capsule(*size), "cylinder": lambda: Cylinder(*size)}[
        solid.kind
    ](), []
