"""Mesh files: search and triangles, read by trimesh."""

import os
import pathlib
from urllib.parse import unquote

import numpy as np

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
