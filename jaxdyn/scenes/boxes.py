"""Boxes in contact: a cube in a hand of four fingers, and a box on a table with friction over its base."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.contact.cones import friction_cone, surface_cone
from jaxdyn.contact.wrench_cones import wrench_cone
from jaxdyn.grasp import Grasp, contact, point_contacts
from jaxdyn.model import host_math, inertia, robots
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.topology import frame_index
from jaxdyn.scenes._named import as_state, register_scene, solve_gram
from jaxdyn.scenes.hands import point_velocity, quaternion_and_matrix

# Contact points of the fingertips on the cube, in half edges, and inward normals: index and ring finger on one face,
# the thumb on the opposite one.
_PLACES = {
    "link_3.0_tip": ((1.0, 2 / 3, 0.0), (-1.0, 0.0, 0.0)),
    "link_11.0_tip": ((1.0, -2 / 3, 1 / 3), (-1.0, 0.0, 0.0)),
    "link_15.0_tip": ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
}
# Initial guesses for the angles of the fingers around a cube of 60 mm at `position`, by the joints' numbers.
_GUESS = {
    **dict(zip(range(4), (-0.248, 0.833, 0.756, 0.583), strict=True)),
    **dict(zip(range(4, 8), (0.0, 0.9, 0.8, 0.6), strict=True)),
    **dict(zip(range(8, 12), (0.288, 0.946, 0.792, 0.585), strict=True)),
    **dict(zip(range(12, 16), (1.288, 0.56, 0.477, 0.493), strict=True)),
}

_ROUNDS = 30  # of Newton's method, for the angles of a finger


def _chain(model, tip: str) -> tuple[list[int], np.ndarray]:
    """Chain of joints from the palm to a fingertip, and the pose of the tip in the last body."""
    frame = frame_index(model, tip)
    joints, offset = [model.topology.frame_bodies[frame]], np.asarray(model.frame_poses, float)[frame]
    while (parent := model.topology.parents[joints[0]]) >= 0:
        # From the palm outwards, in the order of the product of transforms.
        joints.insert(0, parent)
    return joints, offset


def _tip(model, joints, offset, angles):
    """Position (3,) of a fingertip, and its Jacobian (3, n)."""
    xp = array_namespace(angles)
    pose, axes, origins = xp.eye(4), [], []
    home, screws = np.asarray(model.home, float), np.asarray(model.screws, float)
    for k, joint in enumerate(joints):
        axis = screws[joint, 3:]
        # Joint axes pass through the origins of their frames.
        pose = pose @ home[joint] @ host_math.pose_of(host_math.rotation_matrix(axis, angles[k]), np.zeros(3))
        axes.append(pose[:3, :3] @ axis)
        origins.append(pose[:3, 3])
    place = (pose @ offset)[:3, 3]
    return place, xp.cross(xp.stack(axes), place[None] - xp.stack(origins)).T


def _least(jacobian, motion):
    """Change of a finger's angles of least norm for a motion of its tip."""
    # Four joints for three components: the normal equations J J^T are regular away from singularities.
    return jacobian.T @ solve_gram(jacobian, motion)


def _reach(model, joints, offset, guess, target):
    """Inverse kinematics of a fingertip by Newton's method, from a guess."""

    def nearer(angles, _):
        place, jacobian = _tip(model, joints, offset, angles)
        return angles + _least(jacobian, target - place), None

    if is_concrete(target):
        for _ in range(_ROUNDS):
            guess, _ = nearer(guess, None)
        return guess
    # A redundant finger ends at a point that depends on all steps, so the loop itself is differentiated.
    return jax.lax.scan(nearer, as_state(guess), None, length=_ROUNDS)[0]


def _cube_start(
    size: Number = 0.06,
    position: Row = (0.108, 0.013, 0.004),
    turned: Row = (0.404, -1.79, -0.078),
    twist: Row = (0.02, 0.0, -0.01, 0.1, 0.2, -0.1),
) -> tuple[Array, Array]:
    model = robots.allegro()
    quaternion, rotation = quaternion_and_matrix(turned)
    xp = array_namespace(size, position, turned, twist)
    rotation, position, twist = xp.asarray(rotation), xp.asarray(position, float), xp.asarray(twist, float)
    # Fingers are in the text order of their first joints, joint_N.0 with N = 0, 12, 4, 8.
    angles: list[Any] = [_GUESS[int(name[6:-2])] for name in model.joint_names]
    rates: list[Any] = [0.0] * model.nv
    for name, (point, _) in _PLACES.items():
        joints, offset = _chain(model, name)
        target = position + size / 2 * rotation @ np.asarray(point)
        reached = _reach(model, joints, offset, np.array([angles[i] for i in joints]), target)
        place, jacobian = _tip(model, joints, offset, reached)
        # A traced target cannot be refused: a start that does not reach it is not a number.
        gap = xp.linalg.norm(target - place)
        if not is_concrete(target):
            reached = jnp.where(gap < 4e4 * jnp.finfo(place.dtype).eps * size, reached, jnp.nan)
        elif not gap < 1e-12:
            raise ValueError(
                f"size is {size}, position {np.asarray(position).tolist()}, turned {list(turned)}: {name} cannot reach its "
                "contact point on the cube; give a pose closer to the default one"
            )
        # The twist is in the cube's axes, and the fingers are computed in those of the world.
        velocity = point_velocity(position, rotation @ twist[:3], rotation @ twist[3:], target)
        moving = _least(jacobian, velocity)
        for k, i in enumerate(joints):
            angles[i], rates[i] = reached[k], moving[k]
    # The cube's joint is last in the order of names.
    return as_state([*angles, *position, *quaternion]), as_state([*rates, *twist])


@register_scene(_cube_start)
def allegro_with_cube(*, size: Number = 0.06, mass: Number = 0.1, mu: Number = 0.8, gravity: Number = 9.81) -> Grasp:
    """Allegro hand, palm upright, with a cube between index finger, ring finger and thumb; the middle finger is free.

    q = (joints of the index finger, of the thumb, of the middle and of the ring finger, four each, the cube's free joint): 22
    velocities and 9 rows, of three hard fingers. The hand is redundant: seven of its motions leave the fingertips at
    rest (`jd.grasp.hand_motions`). `size` (m), `mass` (kg) of the cube; `mu` as of `hand_with_bar`. Fingertips
    are points, the centres of the balls of the real ones.

    Start: the cube's `position` (m), rotation vector `turned` (rad) and body `twist`, with the angles of the fingers that reach
    it and the smallest joint velocities that follow it. ValueError for a cube out of their reach.

    Source: the hand, `jd.robots.allegro`; contacts and cones, EQUATIONS section 10.
    """
    fall = (0.0, 0.0, -gravity)
    cube = ModelBuilder("cube", gravity=fall).add_body(
        "cube", None, "free", inertia.box(mass, (size,) * 3), joint_name="object"
    )
    places = {name: (tuple(size / 2 * x for x in point), normal) for name, (point, normal) in _PLACES.items()}
    cones = friction_cone("hard-finger", mu) if mu is not None else None
    return Grasp(robots.allegro(gravity=fall), cube.build(), point_contacts(places), cones=cones)


def _table_start(
    tilt: Number = 0.02, rate: Number = 0.0, height: Number = 0.025, size: Row = (0.2, 0.16, 0.24)
) -> tuple[Array, Array]:
    xp = array_namespace(tilt)
    s, c = xp.sin(tilt), xp.cos(tilt)
    center = height + size[2] / 2
    # The box turns with the table about the y axis through the origin.
    place = [center * s, 0.0, center * c, xp.cos(tilt / 2), 0.0, xp.sin(tilt / 2), 0.0]
    # In the box's axes: its centre moves along x at the height of the centre times the rate.
    moving = [center * rate, 0.0, 0.0, 0.0, rate, 0.0]
    return as_state([*place, tilt]), as_state([*moving, rate])


@register_scene(_table_start)
def box_on_table(
    *,
    size: Row = (0.2, 0.16, 0.24),
    mass: Number = 1.0,
    table: Row = (1.0, 0.6, 0.05),
    table_mass: Number = 20.0,
    height: Number = 0.025,
    mu: Number = 0.4,
    gravity: Number = 9.81,
) -> Grasp:
    """Box on a table in surface contact: six rows, and the wrench cone of a rectangle instead of a friction cone.

    The table turns freely about the y axis through its centre of mass at the origin, so that it falls over with the box, slowly
    at first: with I the moment of both about the axis and r = height + size[2]/2 the height of the box's centre above it,

        I thetadd = m g r sin(theta),    fx = m (r thetadd - g sin(theta)),    fz = m (g cos(theta) - r thetad^2).

    The box slips where -fx = mu fz, or tips over its edge where the torque |ty| about the middle of the base is size[0]/2 fz,
    whichever comes first; `jd.simulate` ends there, as `contact_lost`.

    q = (the box's free joint, the table's angle). `size` of the box, `table` of the table (m, along x, y, z); `height` of the
    table's top above its axis (m); `mass`, `table_mass` (kg); `mu`: friction coefficient of the base, whose 16 rows are
    those of `jd.contact.wrench_cone`, those of torques divided by half the longer side, so that margins are in N.
    Start: `tilt` (rad) and its `rate` (rad/s).

    Source: Caron, Pham & Nakamura (2015); EQUATIONS section 11.
    """
    builder = ModelBuilder("box on a table", gravity=(0.0, 0.0, -gravity))
    builder.add_body("table", None, "continuous", inertia.box(table_mass, table), joint_name="table", axis=(0, 1, 0))
    builder.add_body("box", None, "free", inertia.box(mass, size), joint_name="object")
    base = contact("rigid", "table", (0.0, 0.0, -size[2] / 2), finger_pose=(0.0, 0.0, height), name="base")
    half_x, half_y = size[0] / 2, size[1] / 2
    rows = wrench_cone(half_x, half_y, mu)
    # Rows of torques become forces, so that margins of all rows have one unit.
    rows = rows.at[4:].divide(array_namespace(size).maximum(half_x, half_y))
    return Grasp(builder.build(), "box", [base], cones=surface_cone(rows))
