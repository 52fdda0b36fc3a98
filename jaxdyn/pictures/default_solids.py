"""Default solids of bodies: rods between joints, and solids of the same inertia.

The inertia of a body about its centre of mass has principal moments I1 <= I2 <= I3, which a uniform solid of the same
mass m reproduces: the box with edges x^2 = 6 (I2 + I3 - I1) / m, the ellipsoid with half axes a^2 = 5 (I2 + I3 - I1) / 2m,
and, where two moments are equal, a cylinder with r^2 = 2 Ia / m, L^2 = 12 It / m - 3 r^2 for the moments Ia about its axis
and It across. A body that moves in a plane is drawn as a disk with its moment about z, the only one that its motion has.
Where such a solid would hide the rods of its body, a small ball marks the centre of mass instead.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.loops import Distance, Loop
from jaxdyn.constraints.rolling import RollingSphere, RollingWheel
from jaxdyn.contact.rolling import RollingContact
from jaxdyn.contact.surfaces import Cylinder, Ellipsoid
from jaxdyn.grasp.hand import Contact, Grasp
from jaxdyn.model import host_math
from jaxdyn.model.topology import frame_index, joint_neutral
from jaxdyn.model.tree import Model
from jaxdyn.pictures.solids import Shape, Shapes, rod
from jaxdyn.systems.scene import Scene

_EQUAL = 1e-3  # relative difference of moments that count as equal
_THIN = 0.012  # radius of rods, as a fraction of the mechanism's size
_BULKY = (1.2, 0.5)  # largest longest and middle edge of a solid, as fractions of the longest rod of its body
_OPACITY = 0.35  # of a grasped object, so that contact forces and friction cones inside are visible
_SHARE = 0.3  # the same for bodies without rods, as a fraction of the mechanism's size


def complete_solids(scene: Scene, shapes: Shapes) -> Shapes:
    """Add default solids for bodies with mass that have none, and for rolling surfaces."""
    model = scene.system
    # A visual on a merged link shows the body that carries the link.
    carried = {model.topology.frame_bodies[frame_index(model, name)] for name in shapes.frames()}
    drawn = list(shapes)
    size = extent(scene)
    thin = _THIN * size
    rolling, wheeled = _rolling(scene, carried)
    grasped = scene.object if isinstance(scene, Grasp) else None
    drawn += [_see_through(shape) if shape.frame == grasped and grasped is not None else shape for shape in rolling]
    bare = [i for i in range(model.nb) if i not in carried]
    points = _joints_on(scene)
    whole = not shapes
    for i in bare:
        # Rods complete a drawing from inertias; between the visuals of a file they would only clutter.
        rods = _rods(model, i, points[i], thin) if whole else []
        solid = _of_inertia(model, i, thin, i in wheeled)
        longest = max((rod.size[1] for rod in rods), default=_SHARE * size if whole and model.nb > 3 else 0.0)
        longest *= model.nb > 1  # a single body is drawn as its solid
        # The object of a grasp has a solid of its own: forces inside it must stay visible.
        if isinstance(scene, Grasp) and model.body_names[i] == grasped:
            drawn += _object_solids(scene, solid, thin)
            continue
        drawn += rods + [_or_mark(shape, longest, thin) for shape in solid]
    if whole:
        drawn += _ground_links(scene, thin)
    return Shapes(drawn, shapes.missing)


def extent(scene: Scene) -> float:
    """Size of the mechanism at its neutral configuration, m: the diagonal of the box around joints, loop ends and masses."""
    model = scene.system
    poses = home_poses(model)
    # Where all bodies are attached to the world, the size includes the world's origin.
    points = [np.zeros(3)] if (np.array(model.topology.parents) == -1).all() and model.nb > 1 else []
    for i in range(model.nb):
        mass, com, moment = host_math.about_com(np.asarray(model.inertias, float)[i])
        points += [poses[i, :3, 3], poses[i, :3, :3] @ com + poses[i, :3, 3]]
        if mass > 0:
            # A radius of gyration, so that a single body has a size too.
            reach = np.sqrt(np.abs(np.trace(moment)) / mass)
            points += [points[-1] + reach * sign for sign in np.array([[1, 1, 1], [-1, -1, -1]]) / np.sqrt(3)]
    for body, pose in _ends(scene):
        points.append((frame_poses(model, poses, body) @ pose)[:3, 3])
    size = float(np.linalg.norm(np.ptp(np.array(points), axis=0))) if points else 0.0
    # Point masses at one place have no extent; all other lengths are fractions of the size.
    return size if size > 0 else 1.0


def home_poses(model: Model) -> np.ndarray:
    """Poses (nb, 4, 4) of all bodies in the world at the neutral configuration."""
    poses = np.zeros((model.nb, 4, 4))
    home, screws = np.asarray(model.home, float), np.asarray(model.screws, float)
    for i, (parent, kind) in enumerate(zip(model.topology.parents, model.topology.kinds, strict=True)):
        here = home[i] @ host_math.joint_pose(kind, screws[i], joint_neutral(kind))
        poses[i] = here if parent < 0 else poses[parent] @ here
    return poses


def frame_poses(model: Model, poses: np.ndarray, frame: str | None) -> np.ndarray:
    """Poses (..., 4, 4) of a frame (None: the world) for body poses (..., nb, 4, 4)."""
    if frame is None:
        return np.broadcast_to(np.eye(4), (*poses.shape[:-3], 4, 4))
    index = frame_index(model, frame)
    body, offset = model.topology.frame_bodies[index], np.asarray(model.frame_poses, float)[index]
    if body < 0:
        return np.broadcast_to(offset, (*poses.shape[:-3], 4, 4))
    return poses[..., body, :, :] @ offset


def pairs(scene: Scene) -> list[Pair]:
    """Constraints between two frames of a scene, as declared."""
    return [one.resolve(scene.system) for one in scene.constraints if isinstance(one, Pair)]


def _ends(scene: Scene) -> list[tuple[str | None, np.ndarray]]:
    return [(body, np.asarray(pose, float)) for pair in pairs(scene) for body, pose in pair.ends()]


def _joints_on(scene: Scene) -> dict[int, list[np.ndarray]]:
    """Attachment points (3,) of each body, in its frame: its own joint, child joints, loops."""
    model = scene.system
    points: dict[int, list[np.ndarray]] = {i: [] for i in range(-1, model.nb)}
    home = np.asarray(model.home, float)
    for i, parent in enumerate(model.topology.parents):
        # A free body is not attached to anything, so no rod leads to its origin.
        if model.topology.kinds[i] != "free":
            # Own joint first: rods start at it, and a child may have added its point before.
            points[i].insert(0, np.zeros(3))
            points[parent].append(home[i, :3, 3])
    for constraint in pairs(scene):
        # Frame A of a contact is on a surface, which gets no rod; a rigid grasp contact has two surfaces.
        if isinstance(constraint, Contact) and constraint.kind == "rigid":
            continue
        round_surface = isinstance(constraint, RollingSphere) and constraint.on == "sphere" and not constraint.inside
        # Both frames are points of bodies, or the first one is on a surface.
        of_bodies = round_surface or isinstance(constraint, Loop | Distance | RollingContact)
        for body, pose in constraint.ends() if of_bodies else constraint.ends()[1:]:
            if body is not None:
                index = frame_index(model, body)
                offset = np.asarray(model.frame_poses, float)[index] @ np.asarray(pose, float)
                points[model.topology.frame_bodies[index]].append(offset[:3, 3])
    return points


def _ground_links(scene: Scene, thin: float) -> list[Shape]:
    """Rods of the world to where loops are closed with it, without which a closed chain would look open."""
    model = scene.system
    home, frames = np.asarray(model.home, float), model.topology.frame_bodies
    carried = zip(model.topology.parents, model.topology.kinds, home, strict=True)
    joints = [pose[:3, 3] for parent, kind, pose in carried if parent < 0 and kind != "free"]
    rods = []
    for body, pose in (end for one in pairs(scene) if isinstance(one, Loop) for end in one.ends()):
        if joints and (body is None or frames[frame_index(model, body)] < 0):
            end = (frame_poses(model, home, body) @ np.asarray(pose, float))[:3, 3]
            start = min(joints, key=lambda joint: float(np.linalg.norm(joint - end)))
            rods += [rod(None, start, end, 0.7 * thin, source="inertia")] if np.linalg.norm(end - start) > thin else []
    return rods


def _rods(model: Model, i: int, points: list[np.ndarray], thin: float) -> list[Shape]:
    """Rods from a body's own joint to its child joints, or to its centre of mass where it has none."""
    name = model.body_names[i]
    mass, com, _ = host_math.about_com(np.asarray(model.inertias, float)[i])
    start = points[0] if points else com
    # A rod ends at the home position of the child joint.
    ends = points[1:] if len(points) > 1 or not mass else [com]
    rods = [rod(name, start, end, thin, source="inertia") for end in ends if np.linalg.norm(end - start) > 2 * thin]
    if mass and rods and min(_distance(com, start, end) for end in ends) > 3 * thin:
        # The centre of mass would float beside its body.
        rods.append(rod(name, start, com, 0.5 * thin, source="inertia"))
    return rods + _plate(name, np.array(points), thin)


def _distance(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Distance (m) of a point from a line segment."""
    along, length = end - start, float((end - start) @ (end - start))
    share = np.clip((point - start) @ along / length, 0.0, 1.0) if length > 0 else 0.0
    return float(np.linalg.norm(point - start - share * along))


def _plate(frame: str, points: np.ndarray, thin: float) -> list[Shape]:
    """Flat plate between three or more joints of a body that are in a plane, as of a ternary link."""
    if len(points) < 3:
        return []
    points = points - (middle := points.mean(0))
    # The plane of least squares; its normal is the last direction.
    _, extents, directions = np.linalg.svd(points, full_matrices=False)
    if extents[1] < 2 * thin or extents[2] > 0.1 * extents[1]:
        return []
    around = np.argsort(np.arctan2(points @ directions[1], points @ directions[0]))
    corners, half = middle + points[around], 0.4 * thin * directions[2]
    count = len(corners)
    vertices = np.concatenate([[middle + half, middle - half], corners + half, corners - half])
    faces = []
    for k in range(count):
        a, b = 2 + k, 2 + (k + 1) % count
        faces += [(0, a, b), (1, b + count, a + count), (a, a + count, b), (b, a + count, b + count)]
    # Counter-clockwise from outside, whichever way the directions are handed.
    faces = np.array(faces) if np.linalg.det(directions) > 0 else np.array(faces)[:, ::-1]
    return [Shape(frame, "mesh", (1.0,) * 3, vertices=vertices, faces=faces, source="inertia")]


def _or_mark(solid: Shape, longest: float, thin: float) -> Shape:
    """Replace a solid that is bulky compared with a rod of the length `longest` by a ball at its centre."""
    # In the solid's own axes, so that its orientation does not change the edges.
    edges = np.sort(np.ptp(solid.triangles()[0] @ solid.pose[:3, :3], axis=0))
    if longest and (edges[2] > _BULKY[0] * longest or edges[1] > _BULKY[1] * longest):
        return dataclasses.replace(solid, kind="ellipsoid", size=(2.5 * thin,) * 3, source="mark")
    return solid


def _of_inertia(model: Model, i: int, thin: float, rolls: bool) -> list[Shape]:
    """Uniform solid with a body's mass, centre of mass and inertia."""
    parameters = np.asarray(model.inertias, float)[i]
    mass, com, moment = host_math.about_com(parameters)
    name = model.body_names[i]
    if mass <= 0 or rolls:
        return []
    pose = np.eye(4)
    pose[:3, 3] = com
    minimum = 1.2 * thin
    if model.topology.kinds[i] == "planar":
        # Inertias of files may be unphysical; a negative moment is drawn as a small solid.
        radius = float(np.sqrt(max(2 * moment[2, 2] / mass, 0.0)))
        return [Shape(name, "cylinder", (max(radius, minimum), 2 * minimum), pose, source="inertia")]
    moments, axes = np.linalg.eigh(moment)
    # eigh may return a reflection; poses need a rotation.
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    pose[:3, :3] = axes
    options: dict = dict(source="inertia")
    # A point mass has no shape; a ball of the rods' thickness shows it, and a block what slides.
    if moments[2] <= mass * minimum**2:
        if model.topology.kinds[i] == "prismatic":
            return [Shape(name, "box", (6 * thin, 6 * thin, 6 * thin), pose, **options)]
        return [Shape(name, "ellipsoid", (2 * thin,) * 3, pose, source="mark")]
    equal = [abs(moments[a] - moments[b]) <= _EQUAL * moments[2] for a, b in ((0, 1), (1, 2))]
    if all(equal):
        radius = float(np.sqrt(2.5 * moments.mean() / mass))
        return [Shape(name, "ellipsoid", (radius,) * 3, pose, **options)]
    if any(equal):
        # eigh sorts the moments, so the single one is the first or the last.
        axis = 2 if equal[0] else 0
        across = moments[0] if axis == 2 else moments[2]
        radius = np.sqrt(max(2 * moments[axis] / mass, 0.0))
        length = np.sqrt(max(12 * across / mass - 3 * radius**2, 0.0))
        if length > 0 or radius > minimum:
            # A cyclic permutation keeps the axes right-handed, with the cylinder's axis as z.
            permuted = np.roll(axes, 2 - axis, axis=1)
            pose[:3, :3] = permuted
            size = (max(float(radius), minimum), max(float(length), minimum))
            return [Shape(name, "cylinder", size, pose, **options)]
    edges = np.sqrt(np.maximum(6 * (moments.sum() - 2 * moments) / mass, 0.0))
    return [Shape(name, "box", tuple(float(x) for x in np.maximum(edges, 2 * minimum)), pose, **options)]


def _rolling(scene: Scene, carried: set[int]) -> tuple[list[Shape], set[int]]:
    """Wheels and balls of rolling constraints, and the bodies with their centre of mass in one of them."""
    model, shapes, bodies = scene.system, [], set()
    for constraint in pairs(scene):
        if isinstance(constraint, RollingContact):
            shapes += _surfaces(model, constraint, carried)
            bodies |= {model.topology.frame_bodies[frame_index(model, shape.frame)] for shape in shapes if shape.frame}
            continue
        if not isinstance(constraint, RollingWheel | RollingSphere):
            continue
        name: Any = constraint.body  # a wheel and a ball have one
        index = frame_index(model, name)
        body = model.topology.frame_bodies[index]
        # The file's own solid shows the wheel already.
        if body in carried:
            continue
        pose, radius = np.asarray(constraint.pose, float), float(constraint.radius)
        if isinstance(constraint, RollingWheel):
            shapes.append(Shape(constraint.body, "cylinder", (radius, 0.12 * radius), pose, source="constraint"))
        else:
            shapes.append(Shape(constraint.body, "ellipsoid", (radius,) * 3, pose, source="constraint"))
        centre = (np.asarray(model.frame_poses, float)[index] @ pose)[:3, 3]
        # A wheel around the centre of mass shows the body; one at a corner does not.
        if (
            body >= 0
            and np.linalg.norm(host_math.about_com(np.asarray(model.inertias, float)[body])[1] - centre) < radius
        ):
            bodies.add(body)
        if isinstance(constraint, RollingSphere) and constraint.surface_radius is not None and not constraint.inside:
            reach = constraint.surface_radius
            surface = np.asarray(constraint.surface, float)
            kind, size = ("ellipsoid", (float(reach),) * 3)
            if constraint.on == "cylinder":
                kind, size = "cylinder", (float(reach), 4 * float(reach))
            shapes.append(Shape(constraint.surface_body, kind, size, surface, source="constraint"))
    return shapes, bodies


def _surfaces(model: Model, contact: RollingContact, carried: set[int]) -> list[Shape]:
    """Balls, ellipsoids and cylinders of two surfaces in rolling contact, one for each body."""
    shapes = []
    for (frame, pose), shape in zip(contact.ends(), (contact.shape_a, contact.shape_b), strict=True):
        if frame is not None and model.topology.frame_bodies[frame_index(model, frame)] in carried:
            continue
        if isinstance(shape, Ellipsoid):
            kind, size = "ellipsoid", tuple(float(x) for x in shape.semi_axes)
        elif isinstance(shape, Cylinder):
            kind, size = "cylinder", (float(shape.radius), 4 * float(shape.radius))
        else:
            continue
        shapes.append(Shape(frame, kind, size, np.asarray(pose, float), source="constraint"))
    return shapes


def _see_through(shape: Shape) -> Shape:
    return dataclasses.replace(shape, opacity=min(shape.opacity, _OPACITY))


def _object_solids(scene: Grasp, solids: list[Shape], thin: float) -> list[Shape]:
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
    return [_see_through(solid) for solid in solids]
