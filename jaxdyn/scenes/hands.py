"""Hands with an object: planar ones with two fingers, and three fingers around a ball. Each scene is a `Grasp`."""

import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import rolling_sphere, rolling_wheel
from jaxdyn.contact.cones import friction_cone
from jaxdyn.grasp import Grasp, contact
from jaxdyn.model import host_math, inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_state, register_scene, solve_gram
from jaxdyn.scenes.linkages import intersect_circles, thin_bar

_LINKS = (0.3, 0.25)
_PALM = 0.5  # m, between the bases of two fingers
FINGER_LINKS = (0.2, 0.2)
BASE_CIRCLE = 0.25  # m, radius of the circle on which the bases of three fingers stand
_UP = np.array([0.0, 0.0, 1.0])


def _rates(axes, origins, point, velocity):
    """Rates of revolute joints for a velocity of the material point of the last link at `point`."""
    xp = array_namespace(axes, origins, point, velocity)
    columns = xp.cross(xp.asarray(axes, float), xp.asarray(point, float)[None] - xp.asarray(origins, float))
    # Columns are independent and the velocity is feasible, so that the normal equations are exact.
    return solve_gram(columns, columns @ xp.asarray(velocity, float))


def point_velocity(position, velocity, omega, point):
    """Velocity of the material point of a body at `point`."""
    xp = array_namespace(position, velocity, omega, point)
    position, velocity, omega, point = (xp.asarray(x, float) for x in (position, velocity, omega, point))
    return velocity + xp.cross(omega, point - position)


def rotation_about_z(angle):
    """Rotation matrix (3, 3) about z."""
    return host_math.rotation_matrix((0.0, 0.0, 1.0), angle)


def cones_of(mu, kind="hard-finger", in_plane=False):
    """Friction cone of all contacts, None without `mu`."""
    return None if mu is None else friction_cone(kind, mu if kind == "hard-finger" else None, in_plane=in_plane)


# Two fingers in the x-y plane, their bases on the x axis.


def _planar_hand(name, links, masses, palm, gravity):
    builder = ModelBuilder(name, gravity=(0.0, -gravity, 0.0))
    first, second = links
    for i, side in ((1, -1.0), (2, 1.0)):
        base = (side * palm / 2, 0.0, 0.0)
        builder.add_body(f"finger{i}_1", None, "continuous", thin_bar(masses[0], first), pose=base)
        distal = thin_bar(masses[1], second)
        builder.add_body(f"finger{i}_2", f"finger{i}_1", "continuous", distal, pose=(first, 0.0, 0.0))
        builder.add_frame(f"tip{i}", f"finger{i}_2", (second, 0.0, 0.0))
    return builder


def _planar_object(center, angle, velocity):
    """Position of an object, and its velocity in the plane's axes from the body velocity (vx, vy, w)."""
    xp = array_namespace(center, angle, velocity)
    # Planar joints have their velocity in the body's axes.
    linear = rotation_about_z(angle) @ xp.asarray([velocity[0], velocity[1], 0.0])
    return xp.asarray([*center, 0.0]), linear, xp.asarray([0.0, 0.0, velocity[2]])


def _planar_state(fingers, center, angle, velocity):
    """State q and v: `fingers` has base, knee, fingertip and contact point of each, `velocity` is the object's."""
    xp = array_namespace(fingers, center, angle, velocity)
    moving = _planar_object(center, angle, velocity)
    q, v = [], []
    for base, knee, tip, point in fingers:
        # arctan2 takes y first, hence the reversed slice of (x, y).
        low, high = (xp.arctan2(*(b - a)[1::-1]) for a, b in ((base, knee), (knee, tip)))
        # The second angle is relative to the first link.
        q += [low, high - low]
        axes, origins = np.stack([_UP, _UP]), xp.stack([base, knee])
        v += [*_rates(axes, origins, point, point_velocity(*moving, point))]
    return as_state([*q, *center, angle]), as_state([*v, *velocity])


def _bar_start(
    center: Row = (0.02, 0.38),
    angle: Number = 0.1,
    velocity: Row = (0.2, -0.1, 0.5),
    links: Row = _LINKS,
    palm: Number = _PALM,
    length: Number = 0.3,
) -> tuple[Array, Array]:
    xp = array_namespace(center, angle, links, palm, length)
    along = xp.asarray(rotation_about_z(angle))[:, 0]
    fingers = []
    for side in (-1.0, 1.0):
        base, tip = xp.asarray([side * palm / 2, 0.0, 0.0]), xp.asarray([*center, 0.0]) + side * length / 2 * along
        ends = (base[:2], links[0], tip[:2], links[1])
        # The order of the circles selects the solution outside of the hand on either side.
        knee = xp.asarray([*(intersect_circles(*ends) if side < 0 else intersect_circles(*ends[2:], *ends[:2])), 0.0])
        fingers.append((base, knee, tip, tip))
    return _planar_state(fingers, center, angle, velocity)


@register_scene(_bar_start)
def hand_with_bar(
    *,
    links: Row = _LINKS,
    masses: Row = (0.4, 0.3),
    palm: Number = _PALM,
    mass: Number = 0.5,
    length: Number = 0.3,
    gravity: Number = 9.81,
    kind: str = "hard-finger",
    mu: Number = 0.8,
) -> Grasp:
    """Planar hand of two fingers with two joints each, whose tips grasp the ends of a bar.

    q = (joints of finger 1, of finger 2, x, y and angle of the bar). `links`, `masses`: of a finger's two uniform bars
    (m, kg); `palm`: distance of the bases (m); `mass`, `length` of the bar. Contact frames have x along the bar's y.
    Start: the bar's centre, angle and body velocity (vx, vy, w), the knees outside. Hands have friction cones of coefficient
    `mu`, so that `jd.simulate` ends where a finger pulls or slips, as they do without torques that grip; None: two-sided
    contacts.

    Source: Murray, Li & Sastry (1994), example 5.3 and section 6.3.
    """
    builder = _planar_hand("hand with a bar", links, masses, palm, gravity)
    builder.add_body("bar", None, "planar", inertia.rod(mass, length), joint_name="object")
    contacts = []
    for i, side in ((1, -1.0), (2, 1.0)):
        # Columns of the transpose: z into the bar along its axis, x along its y.
        turned = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -side], [-side, 0.0, 0.0]]).T
        pose = host_math.pose_of(turned, (side * length / 2, 0.0, 0.0))
        contacts.append(contact(kind, f"tip{i}", pose, in_plane=True))
    return Grasp(builder.build(), "bar", contacts, cones=cones_of(mu, kind, in_plane=True))


def _disk_start(
    center: Row = (0.01, 0.45),
    tilts: Row = (0.12, -0.05),
    velocity: Row = (0.1, -0.15, 1.0),
    links: Row = _LINKS,
    palm: Number = _PALM,
    radius: Number = 0.1,
) -> tuple[Array, Array]:
    xp = array_namespace(center, tilts, links, palm, radius)
    fingers = []
    for side, tilt in zip((-1.0, 1.0), tilts, strict=True):
        base, turned = xp.asarray([side * palm / 2, 0.0, 0.0]), xp.asarray(rotation_about_z(tilt))
        along = turned[:, 1]
        point = xp.asarray([*center, 0.0]) + side * radius * turned[:, 0]
        # The knee is on the line of the face, at the length of the first link from the base.
        to_point = point - base
        reach = to_point @ along
        knee = point - (reach - xp.sqrt(reach**2 - to_point @ to_point + links[0] ** 2)) * along
        fingers.append((base, knee, knee + links[1] * along, point))
    return _planar_state(fingers, center, 0.0, velocity)


@register_scene(_disk_start)
def hand_with_disk(
    *,
    links: Row = _LINKS,
    masses: Row = (0.4, 0.3),
    palm: Number = _PALM,
    mass: Number = 0.5,
    radius: Number = 0.1,
    gravity: Number = 9.81,
    mu: Number = 0.8,
) -> Grasp:
    """Hand of `hand_with_bar` with a disk that rolls between the flat inner faces of the outer links.

    q = (joints of finger 1, of finger 2, x, y and angle of the disk). Each contact has a holonomic row, the gap, and a
    Pfaffian one, no slip; forces are (normal, tangential). In a plane rolling is integrable: `involutive` finds
    (3, 3). Start: the disk's centre and body velocity, `tilts` (rad) of the outer links from the vertical.
    """
    builder = _planar_hand("hand with a disk", links, masses, palm, gravity)
    builder.add_body("disk", None, "planar", inertia.cylinder(mass, radius, 0.02), joint_name="object")
    contacts = []
    for i, side in ((1, -1.0), (2, 1.0)):
        face = ((0.0, 0.0, 0.0), (-side * np.pi / 2, 0.0, 0.0))  # z towards the disk
        finger = f"finger{i}_2"
        rolling = rolling_wheel("disk", None, radius, plane=face, plane_body=finger, lateral=False, name=f"finger{i}")
        contacts.append(rolling)
    return Grasp(builder.build(), "disk", contacts, cones=cones_of(mu, in_plane=True))


# Three fingers in space: their bases on a circle in the x-y plane, a yaw joint and two pitch joints each.


def finger_directions():
    """Horizontal directions, away from the axis, of the fingers (3, 3)."""
    angles = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)
    return np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)


def finger_base(direction, circle):
    """Pose of a finger's base: z up, x to the axis."""
    return host_math.pose_of(np.stack([-direction, -np.cross(_UP, direction), _UP], 1), circle * direction)


def hand_builder(name, links, masses, circle, gravity):
    """Builder of a hand of three fingers in space, with bases on a circle."""
    builder = ModelBuilder(name, gravity=(0.0, 0.0, -gravity))
    first, second = links
    for i, direction in enumerate(finger_directions(), 1):
        # A yaw joint needs an inertia about its axis when the finger is stretched upwards.
        knuckle = inertia.sphere(masses[0], 0.03)
        builder.add_body(f"finger{i}_1", None, "continuous", knuckle, pose=finger_base(direction, circle))
        # About -y, so that a positive pitch lifts the link.
        pitch = (0.0, -1.0, 0.0)
        builder.add_body(f"finger{i}_2", f"finger{i}_1", "continuous", thin_bar(masses[1], first), axis=pitch)
        distal = thin_bar(masses[2], second)
        builder.add_body(f"finger{i}_3", f"finger{i}_2", "continuous", distal, axis=pitch, pose=(first, 0.0, 0.0))
        builder.add_frame(f"tip{i}", f"finger{i}_3", (second, 0.0, 0.0))
    return builder


def finger_angles(base, links, tip, point, velocity):
    """Angles of a finger with its tip at `tip`, and rates for a velocity of its material point at `point`."""
    xp = array_namespace(base, links, tip, point, velocity)
    base, tip = xp.asarray(base, float), xp.asarray(tip, float)
    local = base[:3, :3].T @ (tip - base[:3, 3])
    # After the yaw the finger is a planar arm of two links in its vertical plane.
    yaw, reach = xp.arctan2(local[1], local[0]), xp.hypot(local[0], local[1])
    ahead = base[:3, :3] @ xp.asarray(rotation_about_z(yaw))
    # In the finger's vertical plane: the left of the line to the tip is the knee up.
    knee = xp.asarray(intersect_circles((0.0, 0.0), links[0], (reach, local[2]), links[1]))
    low, high = xp.arctan2(knee[1], knee[0]), xp.arctan2(local[2] - knee[1], reach - knee[0])
    elbow = base[:3, 3] + knee[0] * ahead[:, 0] + knee[1] * xp.asarray(_UP)
    axes = xp.stack([xp.asarray(_UP), -ahead[:, 1], -ahead[:, 1]])
    origins = xp.stack([base[:3, 3], base[:3, 3], elbow])
    return [yaw, low, high - low], _rates(axes, origins, point, velocity)


def quaternion_and_matrix(turned):
    """Unit quaternion and matrix of a rotation vector."""
    xp = array_namespace(turned)
    turned = xp.asarray(turned, float)
    square = turned @ turned
    # sin(a/2)/a by its series about a = 0, where the quotient has no derivative.
    small = square < 1e-6
    angle = xp.sqrt(xp.where(small, 1.0, square))
    factor = xp.where(small, 0.5 - square / 48 + square**2 / 3840, xp.sin(angle / 2) / angle)
    w = xp.where(small, 1 - square / 8 + square**2 / 384, xp.cos(angle / 2))
    x, y, z = factor * turned
    cross = host_math.hat(xp.stack([x, y, z]))
    return [w, x, y, z], xp.eye(3) + 2 * w * cross + 2 * cross @ cross


def _ball_state(position, turned, twist, links, circle, radius, reach, fixed):
    """State q and v: fingertips at `reach` (m) from the ball's centre, in directions fixed in the ball or in the world."""
    quaternion, rotation = quaternion_and_matrix(turned)
    xp = array_namespace(position, turned, twist, circle, reach, radius)
    rotation, position, twist = xp.asarray(rotation), xp.asarray(position, float), xp.asarray(twist, float)
    moving = position, rotation @ twist[:3], rotation @ twist[3:]
    q, v = [], []
    for direction in finger_directions():
        # Fingers of a grasp hold fixed points of the ball; rolling ones touch it at a fixed height.
        outward = rotation @ direction if fixed else direction
        tip, point = position + reach * outward, position + radius * outward
        velocity = point_velocity(*moving, point)
        angles, rates = finger_angles(finger_base(direction, circle), links, tip, point, velocity)
        q, v = [*q, *angles], [*v, *rates]
    return as_state([*q, *position, *quaternion]), as_state([*v, *twist])


def _ball_start(
    position: Row = (0.01, -0.02, 0.28),
    turned: Row = (0.1, -0.15, 0.2),
    twist: Row = (0.1, -0.05, 0.08, 0.4, -0.3, 0.6),
    links: Row = FINGER_LINKS,
    circle: Number = BASE_CIRCLE,
    radius: Number = 0.1,
) -> tuple[Array, Array]:
    return _ball_state(position, turned, twist, links, circle, radius, radius, True)


@register_scene(_ball_start)
def hand_with_ball(
    *,
    links: Row = FINGER_LINKS,
    masses: Row = (0.1, 0.2, 0.15),
    circle: Number = BASE_CIRCLE,
    mass: Number = 0.4,
    radius: Number = 0.1,
    gravity: Number = 9.81,
    mu: Number = 0.8,
) -> Grasp:
    """Hand of three fingers with three joints each, whose tips grasp a ball at three points of its equator, with friction.

    q = (yaw, pitch and pitch of each finger, the ball's free joint). `links`: lengths of a finger's two bars (m);
    `masses`: of its knuckle and its bars (kg); `circle`: radius of the circle of the bases (m). Start: the ball's
    `position`, rotation vector and body twist.
    """
    builder = hand_builder("hand with a ball", links, masses, circle, gravity)
    builder.add_body("ball", None, "free", inertia.sphere(mass, radius), joint_name="object")
    contacts = []
    for i, direction in enumerate(finger_directions(), 1):
        turned = np.stack([np.cross(_UP, -direction), _UP, -direction], 1)
        # z of a contact frame is the inward normal.
        pose = host_math.pose_of(turned, radius * direction)
        contacts.append(contact("hard-finger", f"tip{i}", pose))
    return Grasp(builder.build(), "ball", contacts, cones=cones_of(mu))


def _rolling_start(
    position: Row = (0.01, -0.02, 0.28),
    turned: Row = (0.1, -0.15, 0.2),
    twist: Row = (0.1, -0.05, 0.08, 0.4, -0.3, 0.6),
    links: Row = FINGER_LINKS,
    circle: Number = BASE_CIRCLE,
    radius: Number = 0.1,
    tip_radius: Number = 0.02,
) -> tuple[Array, Array]:
    # The tip's frame is at its centre, one tip radius outside of the ball.
    return _ball_state(position, turned, twist, links, circle, radius, radius + tip_radius, False)


@register_scene(_rolling_start)
def hand_rolling_ball(
    *,
    links: Row = FINGER_LINKS,
    masses: Row = (0.1, 0.2, 0.15),
    circle: Number = BASE_CIRCLE,
    mass: Number = 0.4,
    radius: Number = 0.1,
    tip_radius: Number = 0.02,
    gravity: Number = 9.81,
    mu: Number = 0.8,
) -> Grasp:
    """Hand of `hand_with_ball` with spherical fingertips, between which the ball rolls: nonholonomic.

    Each contact has a holonomic row, the gap, and two Pfaffian ones, no slip; forces are (normal, two tangential).
    Start: as `hand_with_ball`, the contacts at the height of the ball's centre.
    """
    builder = hand_builder("hand rolling a ball", links, masses, circle, gravity)
    builder.add_body("ball", None, "free", inertia.sphere(mass, radius), joint_name="object")
    contacts = [
        rolling_sphere(
            "ball", None, radius, on="sphere", surface_body=f"tip{i}", surface_radius=tip_radius, name=f"finger{i}"
        )
        for i in (1, 2, 3)
    ]
    return Grasp(builder.build(), "ball", contacts, cones=cones_of(mu))
