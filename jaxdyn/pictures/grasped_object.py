"""Solid of a grasped object: from its inertia, or from its contacts where the inertia is ambiguous.

It is translucent, so that contact forces and friction cones inside are visible.
"""

import dataclasses

import numpy as np

from jaxdyn.grasp.contacts import Contact
from jaxdyn.grasp.hand import Grasp
from jaxdyn.model import host_math
from jaxdyn.pictures.solids import Shape, rod
from jaxdyn.systems.scene import Scene

OPACITY = 0.35


def object_name(scene: Scene) -> str | None:
    """Name of the object of a grasp, None for other scenes."""
    return scene.object if isinstance(scene, Grasp) else None


def see_through(shape: Shape) -> Shape:
    """Make a solid translucent."""
    return dataclasses.replace(shape, opacity=min(shape.opacity, OPACITY))


def object_solids(scene: Grasp, solids: list[Shape], thin: float) -> list[Shape]:
    """Solids of a grasped object from its inertia and contacts.

    In a plane it is a bar between its contacts. For three equal moments of inertia, which a ball and a cube have, it is the one
    of these whose surface is closer to the contacts.
    """
    model, name = scene.system, scene.object
    places = [np.asarray(one.pose, float)[:3, 3] for one in scene.constraints if isinstance(one, Contact)]
    body = model.body_names.index(name)
    mass, com, moment = host_math.about_com(np.asarray(model.inertias, float)[body])
    if places and model.topology.kinds[body] == "planar":
        return [rod(name, com, place, 1.5 * thin, source="inertia") for place in places]
    ball = solids[0] if len(solids) == 1 and solids[0].kind == "ellipsoid" and len(set(solids[0].size)) == 1 else None
    if places and ball is not None:
        # A cube of edge 2 h has the moments 2/3 m h^2.
        half = float(np.sqrt(1.5 * np.trace(moment) / 3 / mass))
        points = np.abs(np.array(places) - com)
        # The largest coordinate of a point on a cube's surface is half its edge.
        off_cube = np.abs(points.max(1) - half).max()
        if off_cube < np.abs(np.linalg.norm(points, axis=1) - ball.size[0]).max():
            pose = np.eye(4)
            pose[:3, 3] = com
            solids = [Shape(name, "box", (2 * half,) * 3, pose, source="inertia")]
    return [see_through(solid) for solid in solids]
