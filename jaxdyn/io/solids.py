"""Solids of <visual>, <collision> and of geoms, meshes, and the contacts of collision shapes with the ground of a file."""

import os
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np

from jaxdyn.contact.shape_contacts import HeightField, shape_contacts
from jaxdyn.contact.shapes import Box, Capsule, ConvexHull, hull_vertices
from jaxdyn.contact.surfaces import Cylinder, Ellipsoid, Plane, Sphere
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.dynamics.kinematics import named_frame
from jaxdyn.io.loaded import Names, NotTaken
from jaxdyn.io.sdf_file import SdfFile
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.arguments import check_count
from jaxdyn.model.builder import unknown
from jaxdyn.model.tree import Model

_FOLDERS = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH")


class MeshError(Exception):
    """Error of a mesh that is missing or cannot be read."""


def find_mesh(uri: str, folder: pathlib.Path) -> pathlib.Path:
    """Find the file of a mesh URI in a robot description in `folder`.

    `package://NAME/REST` and `model://NAME/REST` are searched in all folders above, as NAME/REST and, in a folder called
    NAME, as REST; then in the folders of the environment. Other names are paths, relative to `folder`.

    **Raises:** MeshError when there is no such file.
    """
    scheme, mark, rest = uri.partition("://")
    # URIs write a space as %20.
    rest = unquote(rest if mark else uri)
    if not mark or scheme == "file":
        places = [folder / rest]
    else:
        name, _, inner = rest.partition("/")
        places = []
        # The file's own package is found without any variable of the environment.
        for above in (folder, *folder.parents):
            places += [above / rest, *([above / inner] if above.name == name else [])]
        for variable in _FOLDERS:
            for place in filter(None, os.environ.get(variable, "").split(os.pathsep)):
                # A ROS 2 prefix has the packages below share/.
                places += [pathlib.Path(place) / rest, pathlib.Path(place) / "share" / rest]
                places += [pathlib.Path(place) / inner] if pathlib.Path(place).name == name else []
    for place in places:
        if place.is_file():
            return place
    raise MeshError("no such file")


def read_mesh(path: pathlib.Path) -> list[tuple[np.ndarray, np.ndarray, tuple[float, ...] | None]]:
    """Vertices (n, 3), faces (m, 3) and colour of each part of a mesh file, with the units and axes that it states.

    **Raises:** MeshError when it cannot be read.
    """
    try:
        import trimesh
    except ImportError:
        raise MeshError("reading meshes needs trimesh: pip install jaxdyn[plot]") from None
    try:
        # Without processing, vertices and faces stay as in the file.
        loaded = trimesh.load_scene(str(path), process=False)
    except Exception as error:  # readers of many formats raise anything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"cannot be read: {reason[:120]}") from error
    parts = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        faces = getattr(mesh, "faces", None)
        # Scenes may hold points and lines, which are no solids.
        if faces is None or not len(faces):
            continue
        # Nodes of DAE and GLB files have poses of their own.
        vertices = np.asarray(mesh.vertices, float) @ transform[:3, :3].T + transform[:3, 3]
        parts.append((vertices, np.asarray(faces, int), _color(mesh)))
    if not parts:
        raise MeshError("holds no triangles")
    return parts


def _color(mesh) -> tuple[float, ...] | None:
    """Mean colour of a mesh, None where it has none."""
    visual = getattr(mesh, "visual", None)
    material = getattr(visual, "material", None)
    if material is not None:
        rgba = getattr(material, "main_color", None)
    elif visual is not None and visual.defined:
        rgba = np.asarray(visual.vertex_colors).reshape(-1, 4).mean(0)
    else:
        return None
    # Alpha is dropped: the opacity of a solid comes from the robot's file.
    return None if rgba is None else tuple(float(x) / 255 for x in np.asarray(rgba)[:3])


class Solid(NamedTuple):
    """Solid of an element in its own axes.

    `kind` and `size` (m) as of `jaxdyn.pictures.Shape`, or "plane", with its normal as size. Of a mesh: `vertices` (n, 3) before
    they are scaled by `size`, `faces` (m, 3), and its own `color` (3,) or None.
    """

    kind: str
    size: tuple[float, ...]
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    color: tuple[float, ...] | None = None


class Element(NamedTuple):
    """A <visual> or <collision>: the frame of its link, its `pose` (4, 4) in it (m), the XML element, and its solids."""

    frame: str
    pose: np.ndarray
    xml: Any
    solids: list[Solid]


_MJCF_KINDS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}  # mjtGeom


def geom_solid(m, g: int) -> Solid | None:
    """Solid of a geom of MuJoCo's model; None of height fields and signed distance fields."""
    kind, size = _MJCF_KINDS.get(int(m.geom_type[g])), tuple(float(x) for x in m.geom_size[g])
    if kind is None:
        return None
    if kind == "plane":
        return Solid(kind, (0.0, 0.0, 1.0))
    if kind == "sphere":
        # MuJoCo stores three sizes for every geom; a sphere uses the first.
        return Solid("ellipsoid", (size[0],) * 3)
    if kind in ("capsule", "cylinder"):
        # MuJoCo has half lengths.
        return Solid(kind, (size[0], 2 * size[1]))
    if kind == "box":
        return Solid(kind, tuple(2 * x for x in size))
    if kind == "ellipsoid":
        return Solid(kind, size)
    # The compiler has scaled the vertices, and moved them to the mesh's own frame.
    mesh = int(m.geom_dataid[g])
    start, count = m.mesh_vertadr[mesh], m.mesh_vertnum[mesh]
    vertices = np.asarray(m.mesh_vert[start : start + count], float)
    start, count = m.mesh_faceadr[mesh], m.mesh_facenum[mesh]
    return Solid(kind, (1.0, 1.0, 1.0), vertices, np.asarray(m.mesh_face[start : start + count], int))


class _Reader:
    """Reader of geometries, with descriptions of what is missing. Each mesh is read once."""

    def __init__(self, path: pathlib.Path):
        self.folder = path.resolve().parent
        self.missing: list[str] = []
        self._read: dict[str, list[tuple]] = {}

    def solids(self, frame: str, geometry, numbers: Callable, uri: Callable) -> list[Solid]:
        """Solids of a <geometry>; `numbers(part, key, count, default)` and `uri(part)` read its elements."""
        solids = []
        for part in () if geometry is None else geometry:
            if part.tag == "box":
                solids.append(Solid("box", tuple(numbers(part, "size", 3, np.ones(3)))))
            elif part.tag == "sphere":
                radius = float(numbers(part, "radius", 1, 1.0))
                solids.append(Solid("ellipsoid", (radius,) * 3))
            elif part.tag in ("cylinder", "capsule"):
                size = float(numbers(part, "radius", 1, 0.5)), float(numbers(part, "length", 1, 1.0))
                solids.append(Solid(part.tag, size))
            elif part.tag == "ellipsoid":
                solids.append(Solid("ellipsoid", tuple(numbers(part, "radii", 3, np.ones(3)))))
            elif part.tag == "plane":
                solids.append(Solid("plane", tuple(numbers(part, "normal", 3, np.array([0.0, 0.0, 1.0])))))
            elif part.tag == "mesh":
                size = tuple(float(x) for x in numbers(part, "scale", 3, np.ones(3)))
                if (name := uri(part)) not in self._read:
                    try:
                        self._read[name] = read_mesh(find_mesh(name, self.folder))
                    except MeshError as error:
                        self._read[name] = []
                        self.missing.append(f"mesh {name!r} ({error})")
                solids += [Solid("mesh", size, *mesh) for mesh in self._read[name]]
            elif part.tag != "empty":
                self.missing.append(f"<{part.tag}> of link {frame!r}")
        return solids


def urdf_elements(file: XmlFile, tag: str, missing: list[str]) -> Iterator[Element]:
    """Elements <visual> or <collision> of a URDF file; what cannot be read is appended to `missing`.

    **Raises:** ValueError with file and line for numbers that are none.
    """
    reader = _Reader(file.source)
    reader.missing = missing
    for link in file.root.findall("link"):
        frame = file.name(link, "the robot")
        what = f"<{tag}> of link {frame!r}"
        for element in link.findall(tag):
            origin, pose = element.find("origin"), np.eye(4)
            if origin is not None:
                place = tuple(file.numbers(origin, 3, what, key, np.zeros(3)) for key in ("xyz", "rpy"))
                pose = np.asarray(host_math.pose_matrix(place, what))

            def numbers(part, key, count, default, what=what):
                # Of the attributes of a geometry, URDF has a default for the scale alone; it has no planes.
                values = file.numbers(part, count, what, key, default if key in ("scale", "normal") else None)
                return values if count > 1 else values[0]

            solids = reader.solids(frame, element.find("geometry"), numbers, lambda part: part.get("filename") or "")
            yield Element(frame, pose, element, solids)


def sdf_elements(file: SdfFile, tag: str, missing: list[str]) -> Iterator[Element]:
    """Elements <visual> or <collision> of an SDF file; what cannot be read is appended to `missing`.

    **Raises:** ValueError with file and line for numbers that are none.
    """
    reader = _Reader(file.source)
    reader.missing = missing
    for frame, (link, _) in file.links.items():
        what = f"<{tag}> of link {frame!r}"
        for element in link.findall(tag):

            def numbers(part, key, count, default, what=what):
                if count == 1:
                    return file.number(part, key, default, what)
                child = part.find(key)
                return default if child is None else file.numbers(child, count, what)

            solids = reader.solids(frame, element.find("geometry"), numbers, lambda part: file.word(part, "uri"))
            yield Element(frame, file.raw_pose(element, what), element, solids)


FRICTION = 1.0  # where a format or a file has none: the default of Gazebo and of MuJoCo
# Contacts of a mesh. The equations of a step grow with the square of the number of contacts.
_MAX_VERTICES = 12
# Contacts that "ground" gives: of more, the first call of a step takes minutes, and each step a second or so.
_MAX_CONTACTS = 64


class Collision(NamedTuple):
    """Collision shape of a link: its frame (None: the world), its pose (4, 4) in it, its friction coefficient.

    `key`: of the file's rules, which say what touches what.
    """

    frame: str | None
    pose: np.ndarray
    solid: Solid | HeightField
    friction: float
    key: Any = None


def check_choice(contacts: object) -> str | tuple[str, ...] | dict[str, int] | None:
    """Check the option `contacts` of a reader. **Raises:** ValueError."""
    if contacts is None or (isinstance(contacts, str) and contacts == "ground"):
        return contacts
    if isinstance(contacts, Mapping):
        for name, lowest in contacts.items():
            check_count(lowest, f"contacts[{name!r}]")
        return dict(contacts)
    names = tuple(contacts) if isinstance(contacts, Iterable) and not isinstance(contacts, str) else (None,)
    known = tuple(name for name in names if isinstance(name, str))
    if known != names:
        raise ValueError(f"contacts is {contacts!r}; give 'ground', a list of names of links that touch it, or None")
    return known


def contacts_with_ground(
    model: Model,
    collisions: Sequence[Collision],
    contacts: str | Iterable[str],
    left: NotTaken,
    friction_of: Any = None,
) -> tuple[list[UnilateralContact], set[str]]:
    """Contacts of the chosen links with planes and height fields that are fixed to the world, else with its plane z = 0.

    `contacts`: "ground", links, or links with the number of their lowest corners that touch. `friction_of(a, b)`: the
    coefficient of two collisions, None for a pair that does not touch; by default the smaller one.

    **Returns:** contacts; the links that have contacts.

    **Raises:** ValueError for chosen links without a shape, and for more than 64 contacts of "ground".
    """
    grounds = [one for one in collisions if _is_ground(one) and _is_static(model, one)]
    known = list(dict.fromkeys(str(one.frame) for one in collisions if one.frame is not None))
    chosen = known if isinstance(contacts, str) else list(contacts)
    for name in chosen:
        if name not in known:
            raise ValueError(f"contacts: {unknown('link', name, known)}; it has no collision shape")
    friction_of = friction_of or (lambda a, b: min(a.friction, b.friction))
    floor = Collision(None, np.eye(4), Solid("plane", (0.0, 0.0, 1.0)), np.inf)
    names, made, taken, apart = Names(), [], set(), "collision shapes without contacts"
    counts = {name: sum(one.frame == name for one in collisions) for name in chosen}
    places = dict.fromkeys(chosen, 0)
    for one in collisions:
        if _is_static(model, one):
            if not _is_ground(one):
                left.add(apart, [f"{one.frame or 'world'} (fixed)"])
            continue
        if one.frame not in counts:
            continue
        if _is_ground(one):
            left.add(apart, [f"{one.frame} (a plane or height field that moves)"])
            continue
        place, places[one.frame] = places[one.frame], places[one.frame] + 1
        assert isinstance(one.solid, Solid)
        shape, note = _shape(one.solid, str(one.frame))
        left.add("hulls of meshes", note)
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
    if isinstance(contacts, str) and len(made) > _MAX_CONTACTS:
        raise ValueError(
            f"contacts='ground' gives {len(made)} contacts, of the links {', '.join(sorted(taken))}; a step takes time with the "
            f"cube of their number, and {_MAX_CONTACTS} are the most of 'ground'. List the links that touch, as "
            "contacts=['left_foot', 'right_foot'], or with the number of their lowest corners, {'left_foot': 4}"
        )
    return made, taken


def collision_of(element: Element, friction: float) -> list[Collision]:
    """Collisions of a <collision> of a URDF or SDF file."""
    return [Collision(element.frame, element.pose, solid, friction) for solid in element.solids]


def _is_ground(one: Collision) -> bool:
    return isinstance(one.solid, HeightField) or one.solid.kind == "plane"


def _is_static(model: Model, one: Collision) -> bool:
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
        hull, count, error = hull_vertices(solid.vertices * size, _MAX_VERTICES)
        # A small part of a mesh is exact.
        note = [f"{owner} ({len(hull)} of {count} vertices, within {error:.2g} m)"] if len(hull) < count else []
        return ConvexHull(hull), note
    if solid.kind == "ellipsoid":
        return (Sphere(size[0]) if (size == size[0]).all() else Ellipsoid(size)), []
    return {"box": lambda: Box(size), "capsule": lambda: Capsule(*size), "cylinder": lambda: Cylinder(*size)}[
        solid.kind
    ](), []
