"""Contacts with friction: stick, slip, opening and closing; a disk under a link, a cube in a hand, a box on a table."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints import rolling_sphere
from jaxdyn.contact.cones import friction_cone, surface_cone, wrench_cone
from jaxdyn.contact.unilateral import UnilateralContact, gap_contact, ground_contact
from jaxdyn.geometry.immersion import constrain_by_immersion
from jaxdyn.grasp import Grasp, contact, point_contacts
from jaxdyn.model import host_math, inertia, robots
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.topology import frame_index
from jaxdyn.scenes._named import as_leaf, as_state, flat_moments, register_scene, solve_gram
from jaxdyn.scenes.hands import point_velocity, quaternion_and_matrix
from jaxdyn.scenes.linkages import planar_body
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import MetricSystem

_UP, _DOWN = ((0, 0, 0), (-jnp.pi / 2, 0, 0)), ((0, 0, 0), (jnp.pi / 2, 0, 0))  # z of a plane along y, and against it


def _rough_start(
    speed: Number = 3.0, place: Number = 0.1, link_place: Number = 0.0, tilt: Number = 0.0
) -> tuple[Array, Array]:
    # The link touches the disk of radius 1 from above, tilted clockwise.
    height = 1 + (1 + jnp.sin(tilt) * (place - link_place)) / jnp.cos(tilt)
    # The tilt is clockwise and the model's angle counter-clockwise.
    q = as_leaf([place, 1.0, 0.0, link_place, height, -tilt])
    # Along itself, so that the contact remains closed; velocities are in the link's axes.
    return q, as_leaf([0.0, 0.0, 0.0, speed, 0.0, 0.0])


@register_scene(_rough_start)
def rough_disk_and_link(
    *, masses: Row = (1.0, 0.6), moments: Row = (0.5, 0.2), friction: Row = (0.3, 0.2), gravity: Number = 9.81
) -> Scene:
    """Disk of radius 1 m on the ground under a thin link that lies on it, both contacts with stick-slip friction.

    The bodies of `disk_and_link`, free in their plane: q = (x, y, angle) of the disk and of the link's centre of mass, angles
    counter-clockwise. `masses` (kg), `moments` (kg m^2) of the disk and the link; `friction`: coefficients of the contacts
    "link" (link on disk) and "ground" (disk on ground). The link's centre of mass is not above the contact point, so without
    support it tips: a torque m2 g (x_disk - x_link) about it, clockwise, keeps it level.

    Start: disk at rest at `place`, the link above it with its centre at `link_place` (m), clockwise `tilt` (rad), thrown along
    itself with `speed` (m/s). Level, the link slides on the disk with the deceleration mu1 g.

    Source: EQUATIONS section 12 with erratum E57, with the normal forces of the free equations.
    """
    builder = ModelBuilder("disk and link", gravity=(0.0, -gravity, 0.0))
    for name, mass, moment in zip(("disk", "link"), masses, moments, strict=True):
        # The moments about x and y have no effect in the plane; half of z each is a plate's.
        builder.add_body(name, None, "planar", (mass, (0.0, 0.0, 0.0), flat_moments(moment)))
    on_link = rolling_sphere("disk", None, 1.0, surface=_DOWN, surface_body="link", name="link")
    ground = ground_contact("disk", None, friction[1], radius=1.0, plane=_UP, name="ground")
    return Scene(builder.build(), forces=(UnilateralContact(on_link, friction[0]), ground))


def _tangent(s):
    """Immersion q = (z1, theta, y1, theta2) -> configurations of a disk of radius 1 and a link tangent to it from above."""
    z, turn, y, tilt = s
    # The link touches the disk from above: its line has the distance 1 from the disk's centre (z, 1).
    height = 1 + (1 + jnp.sin(tilt) * (z - y)) / jnp.cos(tilt)
    return jnp.stack([z, jnp.ones_like(z), turn]), jnp.stack([y, height, tilt])


class _Applied(eqx.Module):
    """Forces: torque on the link, friction of the link on the disk along the link, and of the ground on the disk along -x."""

    torque: Float[Array, ""] = eqx.field(converter=as_leaf)
    friction: Float[Array, "2"] = eqx.field(converter=as_leaf)

    def __call__(self, q, v, t):
        s, c = jnp.sin(q[1][2]), jnp.cos(q[1][2])
        f1, f2 = self.friction.astype(s.dtype)
        # Both friction forces act at radius 1, which gives the torque -f1 - f2.
        disk = jnp.stack([f1 * c - f2, -f1 * s, -f1 - f2])
        # The contact force on the link is opposite to that on the disk; it passes along the link, without torque.
        return disk, jnp.stack([-f1 * c, f1 * s, self.torque.astype(s.dtype)])


def _disk_start(
    place: Number = 0.1,
    turn: Number = 0.0,
    link_place: Number = -0.2,
    tilt: Number = 0.3,
    rates: Row = (0.4, 0.2, -0.1, 0.3),
) -> tuple[Array, Array]:
    return as_state([place, turn, link_place, tilt]), as_state(rates)


@register_scene(_disk_start)
def disk_and_link(
    *,
    masses: Row = (1.0, 0.6),
    moments: Row = (0.5, 0.2),
    torque: Number = 0.0,
    friction: Row = (0.0, 0.0),
    gravity: Number = 9.81,
) -> Scene:
    """Disk of radius 1 m on the ground under a thin tangent link: two bodies coupled by an immersion.

    q = (z1, theta, y1, th2): abscissa of the disk, its angle counter-clockwise, abscissa of the link's centre of mass, the
    link's angle CLOCKWISE from horizontal. `torque` on the link (N m, clockwise); `friction` (f1, f2), N: of the link on
    the disk along t = (cos th2, -sin th2) and of the ground on the disk along -x. The normal forces are gone.

    Source: EQUATIONS section 12 with erratum E57.
    """
    units = tuple(planar_body(m, moment, gravity) for m, moment in zip(masses, moments, strict=True))
    return as_scene(constrain_by_immersion(units, _tangent, 4, force=_Applied(torque, friction)))


def _toy_gap(row, constant, q, t):
    return jnp.sum(row.astype(q.dtype) * q) + constant.astype(q.dtype)


def _toy_row(row, q, t):
    return row.astype(q.dtype)


def _toy_metric(q, t, p):
    # The mass matrix is constant, as the equations are linear in the angles.
    return p["mass"]


def _toy_potential(q, t, p):
    # The spring acts between the sleeve and the bird, hence the difference of their angles.
    return jnp.sum(p["weight"] * q) + 0.5 * p["stiffness"] * (q[1] - q[2]) ** 2


def _woodpecker_start(
    gap: Number = 0.0006, half_height: Number = 0.0058, bird: Number = -0.2788, velocity: Row = (-0.3411, 0.0, -7.4583)
) -> tuple[Array, Array]:
    # The lower edge touches the pole where the angle uses up the play.
    return as_state([0.0, -gap / half_height, bird]), as_state(velocity)


@register_scene(_woodpecker_start)
def woodpecker(
    *,
    masses: Row = (0.0003, 0.0045),
    moments: Row = (5.0e-9, 7.0e-7),
    stiffness: Number = 0.0056,
    pole_radius: Number = 0.0025,
    sleeve_radius: Number = 0.0031,
    half_height: Number = 0.0058,
    to_spring: Number = 0.010,
    to_bird: Number = 0.015,
    beak: Row = (0.020, 0.0201),
    friction: Number = 0.3,
    restitution: Number = 0.5,
    gravity: Number = 9.81,
) -> Scene:
    """Woodpecker toy: a sleeve with play on a pole, with a bird on a spring, that descends by stick-slip and impacts.

    q = (height of the sleeve, m, its angle and the bird's, rad); equations linear in the angles. Contacts: "beak" on the
    pole, with `restitution`; "lower" and "upper" edge of the sleeve on the pole, without. All have the same `friction`. Where
    an edge sticks, the toy is jammed and the bird swings; it falls while the sleeve is free.

    `masses`, `moments` of sleeve and bird (kg, kg m^2), the latter about the bird's centre of mass; `stiffness` (N m/rad);
    `half_height` of the sleeve, distances `to_spring` from the sleeve's centre and from there `to_bird`; `beak`: its
    height above and its distance from the bird's centre of mass (m).

    Start: on the periodic motion, by its published numbers of four digits: the lower edge touches the pole, the bird's angle
    and the velocities are given. With the parameters above, which have one to three digits, the periodic motion passes
    this angle with -0.33948 m/s and -7.46210 rad/s, 0.5 and 0.05 % from the published ones, after a period of 0.145976 s.
    Perturbed starts return with the opposite sign, smaller by a factor of 0.84. All impacts are of one contact, so that
    Newton's and Poisson's laws of impact give the same; 0.3 % more friction moves these velocities by 1.2 %.

    Source: Glocker (1995), pp. 162; Leine, Glocker & van Campen (2001).
    """
    sleeve, bird = masses
    arms = as_leaf([1.0, to_spring, to_bird])
    # The bird's height depends on all three coordinates, with the lever arms as weights.
    mass = bird * jnp.outer(arms, arms) + jnp.diag(as_leaf([sleeve, moments[0], moments[1]]))
    weight = gravity * (bird * arms + as_leaf([sleeve, 0.0, 0.0]))
    numbers = {"mass": mass, "weight": weight, "stiffness": as_leaf(stiffness)}
    system = MetricSystem(_toy_metric, 3, potential=_toy_potential, parameters=numbers)
    play, reach = sleeve_radius - pole_radius, to_spring + to_bird - beak[1]

    def contact(name, rate, constant, along, e):
        # Affine functions of the coordinates: the gap, and the row of the sliding velocity.
        gap, row = Partial(_toy_gap, as_leaf(rate), as_leaf(constant)), Partial(_toy_row, as_leaf(along))
        return gap_contact(gap, row, friction, restitution=e, name=name)

    # Sliding velocity of an edge: that of the sleeve's centre and of its turn at the radius.
    edge = (1.0, sleeve_radius, 0.0)
    contacts = (
        contact("beak", (0.0, 0.0, -beak[0]), reach - pole_radius, (1.0, to_spring, to_bird - beak[1]), restitution),
        # The edges touch opposite sides of the pole, hence the opposite signs and one play.
        contact("lower", (0.0, half_height, 0.0), play, edge, 0.0),
        contact("upper", (0.0, -half_height, 0.0), play, edge, 0.0),
    )
    return Scene(system, forces=contacts)


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


def _minimum(jacobian, motion):
    """Change of a finger's angles of least norm for a motion of its tip."""
    # Four joints for three components: the normal equations J J^T are regular away from singularities.
    return jacobian.T @ solve_gram(jacobian, motion)


def _reach(model, joints, offset, guess, target):
    """Inverse kinematics of a fingertip by Newton's method, from a guess."""

    def nearer(angles, _):
        place, jacobian = _tip(model, joints, offset, angles)
        return angles + _minimum(jacobian, target - place), None

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
        moving = _minimum(jacobian, velocity)
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
