"""Arms with a tip in contact with a sphere, and arms that carry a plate together."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints import rolling_sphere
from jaxdyn.constraints.rank import pseudo_inverse, solve_square, tolerance
from jaxdyn.contact import Sphere, montana
from jaxdyn.dynamics.kinematics import body_jacobian, frame_pose
from jaxdyn.grasp import Grasp, contact, grasp_map, hand_jacobian
from jaxdyn.lie import se3
from jaxdyn.model import host_math, inertia, robots
from jaxdyn.model.arguments import Checked, Number, Row, check_count, store_leaf
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.joining import join
from jaxdyn.model.tree import Model
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.scenes.hands import finger_angles, rotation_about_z
from jaxdyn.scenes.linkages import thin_bar
from jaxdyn.systems.scene import Scene

_LINKS = (0.4, 0.4, 0.1)
_MASSES = (1.0, 1.5, 1.0, 0.3, 0.3, 0.2)
_HEIGHT = 0.3
_CENTER = (0.5, 0.0, 0.0)
_RADIUS, _TIP_RADIUS = 0.15, 0.03
_ETA = (0.2, -0.1, 0.15, 0.1, 0.3)


def _six_joints(links, masses, height, tip_radius, gravity) -> Model:
    """Arm of yaw, two pitches, and a wrist of roll, pitch and roll; the last body is a ball with frame `tip` at its centre."""
    upper, lower, hand = links
    # About -y, so that a positive pitch lifts the link.
    pitch, roll = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
    wrist = [inertia.sphere(mass, 0.03) for mass in masses[3:5]]
    # 2/5 m r^2, a solid ball.
    ball = masses[5], (hand, 0.0, 0.0), (0.4 * masses[5] * tip_radius**2,) * 3
    builder = ModelBuilder("arm of six joints", gravity=(0.0, 0.0, -gravity))
    builder.add_body("link_1", None, "continuous", inertia.sphere(masses[0], 0.1), pose=(0.0, 0.0, height))
    builder.add_body("link_2", "link_1", "continuous", thin_bar(masses[1], upper), axis=pitch)
    builder.add_body("link_3", "link_2", "continuous", thin_bar(masses[2], lower), axis=pitch, pose=(upper, 0.0, 0.0))
    builder.add_body("link_4", "link_3", "continuous", wrist[0], axis=roll, pose=(lower, 0.0, 0.0))
    builder.add_body("link_5", "link_4", "continuous", wrist[1], axis=pitch)
    builder.add_body("link_6", "link_5", "continuous", ball, axis=roll)
    return builder.add_frame("tip", "link_6", (hand, 0.0, 0.0)).build()


def _joint_angles(pose, links, height):
    """Inverse kinematics: angles (6,) for a pose (4, 4) of the frame `tip`, with the elbow up."""
    xp = array_namespace(pose, links, height)
    pose = xp.asarray(pose, float)
    # The three wrist axes meet in this point, so position and orientation are solved one after the other.
    wrist = pose[:3, 3] - links[2] * pose[:3, 0]
    base = host_math.pose_of(np.eye(3), (0.0, 0.0, height))
    # The velocity is zero, and the rates are not used.
    angles, _ = finger_angles(base, links[:2], wrist, wrist + xp.asarray([0.0, 0.0, 0.1]), np.zeros(3))
    yaw, elevation = angles[0], angles[1] + angles[2]
    up = xp.asarray([0.0, 0.0, 1.0])
    ahead = xp.stack([xp.cos(yaw), xp.sin(yaw), 0 * yaw])
    forearm = xp.cos(elevation) * ahead + xp.sin(elevation) * up
    left = xp.cross(up, ahead)
    # Rotation of the hand in the axes of the forearm, which the wrist alone has to make.
    turn = xp.stack([forearm, left, xp.cross(forearm, left)]) @ pose[:3, :3]
    # Of a roll a, a pitch b about -y and a roll c: the first row and column have b and one of the rolls each.
    roll, pitch = xp.arctan2(-turn[1, 0], turn[2, 0]), xp.arctan2(xp.hypot(*turn[0, 1:]), turn[0, 0])
    return xp.stack([*angles, roll, pitch, xp.arctan2(-turn[0, 1], -turn[0, 2])])


def _sphere_arm_start(
    contact: str = "frictionless",
    eta: Row = _ETA,
    rolling: Row = (0.5, -0.3),
    slide: Row = (0.0, 0.0),
    spin: Number = 0.0,
    links: Row = _LINKS,
    height: Number = _HEIGHT,
    center: Row = _CENTER,
    radius: Number = _RADIUS,
    tip_radius: Number = _TIP_RADIUS,
) -> tuple[Array, Array]:
    _check_contact(contact)
    if contact == "rolling" and is_concrete(slide, spin) and (np.any(slide) or spin):
        raise ValueError(f"slide is {slide}, spin is {spin}; a rolling contact has neither, leave them out")
    kinematics = montana(*_surfaces(radius, tip_radius), as_leaf(eta))
    g_of = array_namespace(kinematics.g_of).asarray(kinematics.g_of)
    # The contact kinematics are relative to the sphere, which is only shifted in the world.
    pose = host_math.pose_of(g_of[:3, :3], g_of[:3, 3] + array_namespace(center).asarray(center, float))
    q = as_state(_joint_angles(pose, links, height))
    twist = as_leaf([*slide, 0.0, *rolling, spin])
    # Masses and gravity do not enter the kinematics of the start.
    arm = _six_joints(links, _MASSES, height, tip_radius, 0.0)
    return q, _rates_of_tip(arm, q, kinematics, twist)


@entry_point
def _rates_of_tip(arm: Model, q, kinematics, twist):
    # Six joints for six components of the twist: the rates are unique away from singularities.
    return solve_square(body_jacobian(arm, q, "tip"), se3.Ad_apply(kinematics.finger.pose, twist))


def _surfaces(radius, tip_radius):
    # Poles are chosen so that the contact, about the top of the sphere and the x axis of the tip, is far from both.
    return Sphere(radius, poles="y"), Sphere(tip_radius)


def _check_contact(contact):
    if contact not in ("frictionless", "rolling"):
        raise ValueError(f"contact is {contact!r}; choose from frictionless, rolling")


@register_scene(_sphere_arm_start)
def sphere_arm(
    *,
    contact: str = "frictionless",
    links: Row = _LINKS,
    masses: Row = _MASSES,
    height: Number = _HEIGHT,
    center: Row = _CENTER,
    radius: Number = _RADIUS,
    tip_radius: Number = _TIP_RADIUS,
    gravity: Number = 9.81,
) -> Scene:
    """Arm of six joints with a ball as tip in contact with a fixed sphere.

    - `contact="frictionless"`: the tip slides. One row, the gap; five coordinates of contact.
    - `contact="rolling"`: it neither slips nor spins. Four rows, the gap, two slips and the spin; two minimal velocities,
      the rates of the contact's place on the tip. From these motions one reaches all five coordinates of contact
      (`involutive` finds (2, 3, 5)) unless both radii are equal, where it is (2,).

    q = (yaw, shoulder, elbow, and the wrist's roll, pitch, roll), rad. `links`: upper arm, forearm, and from the wrist to
    the middle of the ball (m); `masses` of the six bodies (kg), the last one the ball; `height` of the shoulder (m);
    `center`, `radius` of the sphere, `tip_radius` of the ball (m). The frame "tip" is in the middle of the ball. A positive
    normal force presses the tip off the sphere; nothing keeps it positive.

    Start: contact coordinates `eta` of `jd.contact.montana(Sphere(radius, poles="y"), Sphere(tip_radius), eta)`, and the
    twist of the tip against the sphere, in the axes of its contact frame C_f: `rolling` (wx, wy) and `spin` wz (rad/s),
    `slide` (vx, vy) (m/s).

    Source: EQUATIONS section 8 and errata E21, E22; Murray, Li & Sastry (1994), section 5.6.
    """
    _check_contact(contact)
    arm = _six_joints(links, masses, height, tip_radius, gravity)
    free = contact == "frictionless"
    touch = rolling_sphere(
        "tip",
        None,
        tip_radius,
        on="sphere",
        surface=as_leaf(center),
        surface_radius=radius,
        slip=free,
        spin=not free,
        name=contact,
    )
    return Scene(arm, (touch,))


# Angles at which an arm's flange points forward and level.
_HOLDING = (0.0, 0.6, 0.0, -1.2, 0.0, np.pi / 2 - 1.8, 0.0)
_FLANGE = "iiwa_link_7"


def _lifting_start(
    count: Checked[int] = 2, radius: Number = 0.3, twist: Row = (0.05, 0.0, 0.1, 0.0, 0.2, 0.3)
) -> tuple[Array, Array]:
    # Mass, thickness and gravity do not enter the velocities, so the defaults are used.
    scene: Any = coordinated_lifting(count=count, radius=radius)
    flange = frame_pose(robots.iiwa(), as_leaf(_HOLDING), _FLANGE)
    # The plate is level with the flanges, whose height follows from the joint angles.
    height = array_namespace(flange).asarray(flange)[2, 3]
    q = as_state([*(_HOLDING * count), 0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0])
    twist = as_leaf(twist)
    # Joint velocities of least norm that move the flanges with the plate.
    return q, _min_rates(scene, q, twist)


@entry_point
def _min_rates(scene, q, twist):
    J = hand_jacobian(scene, q)
    rates = pseudo_inverse(J, tolerance(None, J)) @ (grasp_map(scene, q).T @ twist)
    return jnp.concatenate([rates, twist])


@register_scene(_lifting_start)
def coordinated_lifting(
    *,
    count: Checked[int] = 2,
    radius: Number = 0.3,
    mass: Number = 4.0,
    thickness: Number = 0.04,
    gravity: Number = 9.81,
) -> Grasp:
    """Plate carried by `count` arms (KUKA iiwa, seven joints each) that grasp its rim rigidly.

    q = (joints of arm 1, of arm 2, ..., the plate's free joint), 7 count + 7 numbers. Each grip has six rows (B = 1): the
    flange moves as the plate does, so that 6 count rows leave 6 + count degrees of freedom, and 6 count - 6 internal
    forces. Names of arm i start with "arm<i>_". The arms stand evenly around the z axis, the first one at -x.
    `radius`, `thickness` (m) and `mass` (kg) of the plate. Start: the plate level with the flanges, with a body `twist`.

    Source: EQUATIONS section 10, coordinated lifting; Murray, Li & Sastry (1994), section 6.4.
    """
    check_count(count, "count")
    fall = (0.0, 0.0, -gravity)
    arm = robots.iiwa(gravity=fall)
    flange = frame_pose(robots.iiwa(gravity=None), store_leaf(_HOLDING, arm.home.dtype), _FLANGE)
    xp = array_namespace(flange, radius)
    flange = xp.asarray(flange)
    # Joining starts from a model without bodies, so that one arm is no special case.
    whole, grips = ModelBuilder("no arm", gravity=fall).build(), []
    for i in range(count):
        # The arms are copies of the first one, rotated about the z axis through the plate's centre.
        turn = xp.asarray(host_math.pose_of(rotation_about_z(2 * np.pi / count * i), np.zeros(3)))
        # The flange of each arm reaches the rim when the plate's centre is on the z axis.
        base = xp.asarray(host_math.pose_of(np.eye(3), (-radius - flange[0, 3], 0.0, 0.0)))
        grip = xp.asarray(host_math.pose_of(flange[:3, :3], (-radius, 0.0, 0.0)))
        whole = join(whole, arm, prefix=f"arm{i + 1}_", pose=turn @ base)
        grips.append(contact("rigid", f"arm{i + 1}_{_FLANGE}", turn @ grip, name=f"arm{i + 1}"))
    plate = ModelBuilder("plate", gravity=fall)
    plate.add_body("plate", None, "free", inertia.cylinder(mass, radius, thickness), joint_name="object")
    return Grasp(join(whole, plate.build(), name=f"{count} arms and a plate"), "plate", grips)
