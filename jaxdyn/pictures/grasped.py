"""The solid of what a hand holds: of its inertia, or of its contacts where an inertia says too little.

It is seen through, so that contact forces and friction cones inside of it show.
"""

import dataclasses

import numpy as np

from jaxdyn.grasp.contacts import Contact
from jaxdyn.grasp.hand import Grasp
from jaxdyn.model import float64 as f64
from jaxdyn.pictures.solids import Shape, rod
from jaxdyn.systems.scene import Scene

OPACITY = 0.35


def grasped_body(scene: Scene) -> str | None:
    """Name of the body that a hand holds."""
    return scene.object if isinstance(scene, Grasp) else None


def see_through(shape: Shape) -> Shape:
    """The solid, with what is inside of it showing."""
    return dataclasses.replace(shape, opacity=min(shape.opacity, OPACITY))


def grasped_solids(scene: Grasp, solids: list[Shape], thin: float) -> list[Shape]:
    """The solids of a held body: those of its inertia, but a bar between its contacts in a plane, and for three equal moments,
    which a ball and a cube have, the one of them on whose surface its contacts are."""
    model, name = scene.system, scene.object
    places = [np.asarray(one.pose, float)[:3, 3] for one in scene.constraints if isinstance(one, Contact)]
    body = model.body_names.index(name)
    mass, com, moment = f64.about_com(np.asarray(model.inertias, float)[body])
    if places and model.topology.kinds[body] == "planar":
        return [rod(name, com, place, 1.5 * thin, source="inertia") for place in places]
    ball = solids[0] if len(solids) == 1 and solids[0].kind == "ellipsoid" and len(set(solids[0].size)) == 1 else None
    if places and ball is not None:
        half = float(np.sqrt(1.5 * np.trace(moment) / 3 / mass))
        points = np.abs(np.array(places) - com)
        off_cube = np.abs(points.max(1) - half).max()
        if off_cube < np.abs(np.linalg.norm(points, axis=1) - ball.size[0]).max():
            pose = np.eye(4)
            pose[:3, 3] = com
            solids = [Shape(name, "box", (2 * half,) * 3, pose, source="inertia")]
    return [see_through(solid) for solid in solids]
