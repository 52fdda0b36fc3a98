"""Solids of a mechanism as triangles: boxes, balls, cylinders and meshes, each on a frame of the model."""

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdyn.io.loaded import NotTakenWarning
from jaxdyn.io.mjcf_file import assign_names, compile_file, import_mujoco, pose_of
from jaxdyn.io.sdf_file import SdfFile
from jaxdyn.io.solids import Element, geom_solid, sdf_elements, urdf_elements
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.arguments import warn

_SIDES = 24  # of a circle

# Meaning of the entries of `size` (m).
SIZES = {
    "box": "edges (x, y, z)",
    "ellipsoid": "half axes (x, y, z)",
    "cylinder": "radius, length along z",
    "capsule": "radius, length along z between the centres of its caps",
    "mesh": "factors (x, y, z) on the vertices",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """Solid fixed to a frame of a model.

    - `frame`: a body or frame by name, None for the world; `pose` (4, 4) of the solid in it (m).
    - `kind`: "box", "ellipsoid" (a ball has three equal half axes), "cylinder", "capsule" or "mesh"; `size` as in
      `jaxdyn.pictures.solids.SIZES` (m).
    - `color` (3,) from 0 to 1, None for the colour of the body; `opacity` from 0 to 1.
    - `vertices` (n, 3) and `faces` (m, 3) of a mesh, before they are scaled by `size`.
    - `source`: origin of the solid: "file", "constraint", "inertia", or "mark" for a ball that marks a centre of mass.
    """

    frame: str | None
    kind: str
    size: tuple[float, ...]
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    color: tuple[float, ...] | None = None
    opacity: float = 1.0
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    source: str = "file"

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, 3) in the frame's axes (m), and faces (m, 3) as indices, counter-clockwise from outside."""
        if self.kind == "mesh":
            assert self.vertices is not None and self.faces is not None
            vertices, faces = self.vertices * np.asarray(self.size), self.faces
            if np.prod(self.size) < 0:  # a reflection reverses the orientation of triangles
                faces = faces[:, ::-1]
        else:
            vertices, faces = _triangles(self.kind, self.size)
        return vertices @ self.pose[:3, :3].T + self.pose[:3, 3], faces


class Shapes(tuple[Shape, ...]):
    """Solids to draw, with descriptions of elements of a file that could not be drawn (`missing`).

    Built by `jd.pictures.shapes`, or from any `Shape`s: `Shapes([Shape("tip", "box", (0.1, 0.1, 0.2))])`.
    """

    missing: tuple[str, ...]

    def __new__(cls, items=(), missing=()):
        """Create a tuple with the attribute `missing`."""
        # A tuple is immutable, so that its items are given in __new__ and not in __init__.
        made = super().__new__(cls, items)
        made.missing = tuple(missing)
        return made

    def frames(self) -> set[str]:
        """Names of the frames that carry a solid."""
        return {shape.frame for shape in self if shape.frame is not None}


def rod(frame: str | None, start, end, radius: float, **options) -> Shape:
    """Capsule between two points (3,) in the frame."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    pose = host_math.rotation_from_z((end - start) / length) if length > 0 else np.eye(4)
    pose[:3, 3] = (start + end) / 2
    return Shape(frame, "capsule", (radius, length), pose, **options)


def _triangles(kind: str, size: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a solid of Trimesh, in its own axes."""
    try:
        # Imported on use: Trimesh is an extra.
        from trimesh import creation
    except ImportError as error:
        raise ImportError("pictures need trimesh: pip install jaxdyn[plot]") from error
    if kind == "box":
        mesh = creation.box(size)
    elif kind == "ellipsoid":
        mesh = creation.icosphere(subdivisions=2)
        mesh.apply_scale(size)
    elif kind == "cylinder":
        mesh = creation.cylinder(size[0], size[1], sections=_SIDES)
    else:
        mesh = creation.capsule(size[1], size[0], count=(_SIDES // 2, _SIDES))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def refine(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Refine a mesh until all sides are at most `longest` (m), by bisecting the longest side of a triangle."""
    while len(faces):
        sides = np.linalg.norm(vertices[np.roll(faces, -1, 1)] - vertices[faces], axis=2)
        long = sides.max(1) > longest
        if not long.any():
            break
        # The longest side first, whose orientation both halves keep.
        rotated = np.stack([np.roll(face, -k) for face, k in zip(faces[long], sides[long].argmax(1), strict=True)])
        middle = len(vertices) + np.arange(len(rotated))
        vertices = np.concatenate([vertices, vertices[rotated[:, :2]].mean(1)])
        a, b, c = rotated.T
        faces = np.concatenate([faces[~long], np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return vertices, faces


def simplify(vertices: np.ndarray, faces: np.ndarray, maximum: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplify a mesh to about `maximum` vertices by merging those within a cell of a grid.

    The grid is made coarser until the mesh is small enough; a mesh that is small enough is returned unchanged.

    Source: Rossignac and Borrel (1993), Multi-resolution 3D approximations for rendering complex scenes.
    """
    low, extent = vertices.min(0), np.ptp(vertices, axis=0).max()
    cells = int(np.sqrt(maximum) * 1.5) + 2  # a surface in a cube of n cells an edge fills some n^2 of them
    while len(vertices) > maximum and cells > 2 and extent > 0:
        place = np.floor((vertices - low) / extent * cells).astype(int) @ (1, cells + 1, (cells + 1) ** 2)
        _, index, count = np.unique(place, return_inverse=True, return_counts=True)
        if len(count) <= maximum:
            centres = np.stack([np.bincount(index, vertices[:, k]) for k in range(3)], axis=1) / count[:, None]
            merged = index[faces]
            # Triangles with two corners in one cell have become lines.
            is_triangle = np.all(merged != np.roll(merged, 1, axis=1), axis=1)
            return centres, merged[is_triangle]
        cells = int(cells * 0.8)
    return vertices, faces


def sharpen(vertices: np.ndarray, faces: np.ndarray, angle: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Duplicate vertices at edges sharper than `angle` (rad), so that averaged normals keep these sharp."""
    import trimesh

    # Trimesh merges vertices of one place: STL files repeat them in each triangle.
    mesh = trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, faces), angle=angle)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def merge_meshes(parts) -> tuple[np.ndarray, np.ndarray]:
    """Merge several meshes."""
    import trimesh

    return trimesh.util.append_faces(*zip(*parts, strict=True))


# --- visual solids of URDF, MJCF and SDF files, each on the frame of its link in the models of `jaxdyn.io` ---


_SHOWN_GROUPS = 3
_DEFAULT_GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom


def shapes(
    path: str | os.PathLike,
    *,
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | os.PathLike] | None = None,
) -> Shapes:
    """Read the visual solids of a URDF, MJCF or SDF file, for `jd.view`, `jd.pictures.save_html` and `jd.draw`.

    They are the elements <visual>, or the geoms of groups 0 to 2, which MuJoCo shows, without planes and height fields. A body
    whose mesh is missing is drawn by its inertia. A model holds no geometry, so the file is read again. Meshes are STL, DAE, OBJ,
    PLY or GLB files, searched at the path given in the file, `package://` and `model://` in the folders above the file and
    in those of ROS_PACKAGE_PATH, AMENT_PREFIX_PATH and GZ_SIM_RESOURCE_PATH.

    **Arguments:** `path`, the file; its root element determines the format. `arguments`, `packages`: of a xacro file, as for
    `jd.load`.

    **Returns:** `Shapes`, a tuple of `Shape`s, with `.missing`, descriptions of elements that could not be drawn.

    **Warns:** `NotTakenWarning` naming meshes that are missing or cannot be read.

    **Raises:** ValueError with file and line for a file that cannot be read and for another format. ImportError without
    mujoco (MJCF); without trimesh meshes are named in the warning.

    ```python
    solids = jd.pictures.shapes("robot.urdf")
    jd.pictures.save_html("robot.html", model, solution, shapes=solids)
    ```
    """
    file = XmlFile(path, "robot", arguments, packages)
    readers = {"robot": _urdf, "mujoco": _mjcf, "sdf": _sdf}
    if file.root.tag not in readers:
        raise file.fault(file.root, f"the root element is <{file.root.tag}>; expected <robot>, <mujoco> or <sdf>")
    drawn = readers[file.root.tag](file)
    if drawn.missing:
        warn(f"{path}: not drawn from the file: {'; '.join(drawn.missing)}", NotTakenWarning)
    return drawn


def _urdf(file: XmlFile) -> Shapes:
    missing: list[str] = []

    def rgba_of(material) -> tuple[float, ...] | None:
        color = material.find("color")
        return None if color is None else tuple(file.numbers(color, 4, "a material", "rgba").tolist())

    # Materials may be defined once, at the robot or in any link, and named elsewhere.
    materials = {element.get("name"): rgba for element in file.root.iter("material") if (rgba := rgba_of(element))}
    drawn: list[Shape] = []
    for visual in urdf_elements(file, "visual", missing):
        material = visual.xml.find("material")
        # A colour in the element itself wins over the named one.
        rgba = None if material is None else rgba_of(material) or materials.get(material.get("name"))
        drawn += _shapes_of(visual, *((None, 1.0) if rgba is None else (rgba[:3], rgba[3])))
    return Shapes(drawn, missing)


def _sdf(file: XmlFile) -> Shapes:
    scene, missing, drawn = SdfFile(file.source), [], []
    for visual in sdf_elements(scene, "visual", missing):
        what = f"<visual> of link {visual.frame!r}"
        diffuse = visual.xml.find("material/diffuse")
        color = None if diffuse is None else tuple(scene.numbers(diffuse, (3, 4), what).tolist()[:3])
        drawn += _shapes_of(visual, color, 1.0 - scene.number(visual.xml, "transparency", 0.0, what))
    return Shapes(drawn, missing)


def _shapes_of(visual: Element, color, opacity: float) -> list[Shape]:
    # The mesh file's own colour has the lowest priority.
    return [
        Shape(visual.frame, one.kind, one.size, visual.pose, color or one.color, opacity, one.vertices, one.faces)
        for one in visual.solids
        if one.kind != "plane"
    ]


def _mjcf(file: XmlFile) -> Shapes:
    mujoco = import_mujoco()
    m, gone = compile_file(mujoco, file.path)
    bodies = assign_names(mujoco, m, file.path).bodies
    shapes = []
    for g in range(m.ngeom):
        solid = geom_solid(m, g)
        if solid is None or solid.kind == "plane" or m.geom_group[g] >= _SHOWN_GROUPS:
            continue
        # `compile_file` replaces missing meshes by points of this size.
        if gone and solid.size == (1e-3,) * 3:
            continue
        material = int(m.geom_matid[g])
        rgba = tuple(float(x) for x in (m.mat_rgba[material] if material >= 0 else m.geom_rgba[g]))
        # Geoms for contact alone are often made invisible this way.
        if rgba[3] == 0:
            continue
        # A colour that the file does not state leaves the body's own colour of the picture.
        color = None if material < 0 and np.allclose(rgba, _DEFAULT_GREY) else rgba[:3]
        pose = pose_of(m.geom_pos[g], m.geom_quat[g])
        body = bodies[m.geom_bodyid[g]]
        shapes.append(Shape(body, solid.kind, solid.size, pose, color, rgba[3], solid.vertices, solid.faces))
    return Shapes(shapes, gone)
