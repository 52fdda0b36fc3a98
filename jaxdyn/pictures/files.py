"""Visual solids of URDF, MJCF and SDF files, each on the frame of its link in the models of `jaxdyn.io`.

URDF and SDF: the elements <visual>. MJCF: the geoms of groups 0 to 2, which MuJoCo shows, without planes and height fields.
A file that is missing or cannot be read is named in a warning; the body is then drawn by its inertia.
"""

import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxdyn.io.loaded import NotTakenWarning
from jaxdyn.io.mjcf_file import assign_names, compile_file, import_mujoco, pose_of
from jaxdyn.io.sdf_frames import SdfFile
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model import host_math
from jaxdyn.model.arguments import warn
from jaxdyn.pictures.meshes import MeshError, find_mesh, read_mesh
from jaxdyn.pictures.solids import Shape, Shapes

_MJCF_KINDS = {2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}  # mjtGeom
_SHOWN_GROUPS = 3
_DEFAULT_GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom


def shapes(
    path: str | os.PathLike,
    *,
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | os.PathLike] | None = None,
) -> Shapes:
    """Read the visual solids of a URDF, MJCF or SDF file, for `jd.view`, `jd.pictures.save_html` and `jd.draw`.

    A model holds no geometry, so the file is read again. Meshes are STL, DAE, OBJ, PLY or
    GLB files, searched at the path given in the file, `package://` and `model://` in the folders above the file and
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


class _Visuals:
    """Solids of the visuals of one file, with a list of the missing ones. Each mesh is read once."""

    def __init__(self, path: pathlib.Path):
        self.folder = path.resolve().parent
        self.missing: list[str] = []
        self.solids: list[Shape] = []
        self._read: dict[str, list[tuple]] = {}

    def add(self, frame: str, visual, numbers: Callable, uri: Callable, pose, color, opacity: float) -> None:
        """Add the solids of a <visual>; `numbers(part, key, count, default)` and `uri(part)` read an element of its geometry."""
        geometry, options = visual.find("geometry"), (pose, color, opacity)
        for part in () if geometry is None else geometry:
            if part.tag == "box":
                self.solids.append(Shape(frame, "box", tuple(numbers(part, "size", 3, np.ones(3))), *options))
            elif part.tag == "sphere":
                radius = float(numbers(part, "radius", 1, 1.0))
                self.solids.append(Shape(frame, "ellipsoid", (radius,) * 3, *options))
            elif part.tag in ("cylinder", "capsule"):
                size = float(numbers(part, "radius", 1, 0.5)), float(numbers(part, "length", 1, 1.0))
                self.solids.append(Shape(frame, part.tag, size, *options))
            elif part.tag == "ellipsoid":
                self.solids.append(Shape(frame, "ellipsoid", tuple(numbers(part, "radii", 3, np.ones(3))), *options))
            elif part.tag == "mesh":
                self._add_mesh(frame, uri(part), numbers(part, "scale", 3, np.ones(3)), *options)
            elif part.tag not in ("empty", "plane"):
                self.missing.append(f"<{part.tag}> of link {frame!r}")

    def _add_mesh(self, frame: str, uri: str, scale, pose, color, opacity: float) -> None:
        if uri not in self._read:
            try:
                self._read[uri] = read_mesh(find_mesh(uri, self.folder))
            except MeshError as error:
                self._read[uri] = []
                self.missing.append(f"mesh {uri!r} ({error})")
        size = tuple(float(x) for x in scale)
        for vertices, faces, own in self._read[uri]:
            # The mesh file's own colour has the lowest priority.
            self.solids.append(Shape(frame, "mesh", size, pose, color or own, opacity, vertices, faces))


def _urdf(file: XmlFile) -> Shapes:
    visuals = _Visuals(file.source)

    def rgba_of(material) -> tuple[float, ...] | None:
        color = material.find("color")
        return None if color is None else tuple(file.numbers(color, 4, "a material", "rgba").tolist())

    # Materials may be defined once, at the robot or in any link, and named elsewhere.
    materials = {element.get("name"): rgba for element in file.root.iter("material") if (rgba := rgba_of(element))}
    for link in file.root.findall("link"):
        frame = file.name(link, "the robot")
        what = f"<visual> of link {frame!r}"
        for visual in link.findall("visual"):
            origin, material = visual.find("origin"), visual.find("material")
            pose = np.eye(4)
            if origin is not None:
                place = tuple(file.numbers(origin, 3, what, key, np.zeros(3)) for key in ("xyz", "rpy"))
                pose = np.asarray(host_math.pose_matrix(place, what))
            # A colour in the element itself wins over the named one.
            rgba = None if material is None else rgba_of(material) or materials.get(material.get("name"))
            color, opacity = (None, 1.0) if rgba is None else (rgba[:3], rgba[3])

            def numbers(part, key, count, default, what=what):
                # Of the attributes of a geometry, URDF has a default for the scale alone.
                values = file.numbers(part, count, what, key, default if key == "scale" else None)
                return values if count > 1 else values[0]

            visuals.add(frame, visual, numbers, lambda part: part.get("filename") or "", pose, color, opacity)
    return Shapes(visuals.solids, visuals.missing)


def _sdf(file: XmlFile) -> Shapes:
    scene, visuals = SdfFile(file.source), _Visuals(file.source)
    for frame, (link, _) in scene.links.items():
        what = f"<visual> of link {frame!r}"
        for visual in link.findall("visual"):
            pose = scene.raw_pose(visual, what)
            diffuse = visual.find("material/diffuse")
            color = None if diffuse is None else tuple(scene.numbers(diffuse, (3, 4), what).tolist()[:3])
            opacity = 1.0 - scene.number(visual, "transparency", 0.0, what)

            def numbers(part, key, count, default, what=what):
                if count == 1:
                    return scene.number(part, key, default, what)
                child = part.find(key)
                return default if child is None else scene.numbers(child, count, what)

            visuals.add(frame, visual, numbers, lambda part: scene.word(part, "uri"), pose, color, opacity)
    return Shapes(visuals.solids, visuals.missing)


def _mjcf(file: XmlFile) -> Shapes:
    mujoco = import_mujoco()
    m, gone = compile_file(mujoco, file.path)
    bodies = assign_names(mujoco, m, file.path).bodies
    shapes = []
    for g in range(m.ngeom):
        kind = _MJCF_KINDS.get(int(m.geom_type[g]))
        if kind is None or m.geom_group[g] >= _SHOWN_GROUPS:
            continue
        size = tuple(float(x) for x in m.geom_size[g])
        # `compile_file` replaces missing meshes by points of this size.
        if gone and kind == "sphere" and size[0] == 1e-3:
            continue
        material = int(m.geom_matid[g])
        rgba = tuple(float(x) for x in (m.mat_rgba[material] if material >= 0 else m.geom_rgba[g]))
        # Geoms for contact alone are often made invisible this way.
        if rgba[3] == 0:
            continue
        # A colour that the file does not state leaves the body's own colour of the picture.
        color = None if material < 0 and np.allclose(rgba, _DEFAULT_GREY) else rgba[:3]
        pose = pose_of(m.geom_pos[g], m.geom_quat[g])
        vertices = faces = None
        if kind == "sphere":
            # MuJoCo stores three sizes for every geom; a sphere uses the first.
            kind, size = "ellipsoid", (size[0],) * 3
        elif kind in ("capsule", "cylinder"):
            # MuJoCo has half lengths.
            size = size[0], 2 * size[1]
        elif kind == "box":
            size = tuple(2 * x for x in size)
        elif kind == "mesh":
            # The compiler has scaled the vertices, and moved them to the mesh's own frame.
            mesh, size = int(m.geom_dataid[g]), (1.0, 1.0, 1.0)
            start, count = m.mesh_vertadr[mesh], m.mesh_vertnum[mesh]
            vertices = np.asarray(m.mesh_vert[start : start + count], float)
            start, count = m.mesh_faceadr[mesh], m.mesh_facenum[mesh]
            faces = np.asarray(m.mesh_face[start : start + count], int)
        shapes.append(Shape(bodies[m.geom_bodyid[g]], kind, size, pose, color, rgba[3], vertices, faces))
    return Shapes(shapes, gone)
