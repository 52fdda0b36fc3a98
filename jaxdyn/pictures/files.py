"""Visual solids of URDF, MJCF and SDF files, each on the frame of its link in the models of `jaxdyn.io`.

URDF and SDF: the elements <visual>. MJCF: the geoms of groups 0 to 2, which MuJoCo shows, without planes and height fields.
A file that is missing or cannot be read is named in a warning; the body is then drawn by its inertia.
"""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxdyn.io.loaded import NotTakenWarning
from jaxdyn.io.mjcf_file import assign_names, compile_file, import_mujoco, pose_of
from jaxdyn.io.sdf_frames import SdfFile
from jaxdyn.io.solids import Element, geom_solid, sdf_elements, urdf_elements
from jaxdyn.io.xml_lines import XmlFile
from jaxdyn.model.arguments import warn
from jaxdyn.pictures.solids import Shape, Shapes

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
