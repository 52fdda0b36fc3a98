"""Hands whose fingertips roll on the object, both of them smooth surfaces."""

import jax
import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.contact import Ellipsoid, RollingModel, rolling_contact
from jaxdyn.grasp import Grasp
from jaxdyn.model import host_math, inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.scenes._named import as_state, register_scene
from jaxdyn.scenes.hands import (
    BASE_CIRCLE,
    FINGER_LINKS,
    cones_of,
    finger_angles,
    finger_base,
    finger_directions,
    hand_builder,
    point_velocity,
    quaternion_and_matrix,
    rotation_about_z,
)

_EGG_SEMI_AXES = (0.1, 0.09, 0.11)  # m
_TIP_SEMI_AXES = (0.03, 0.02, 0.025)  # m
_ITERATIONS = 60  # of the fixed point in `_finger_state`


def _support(semi_axes, normal):
    """Point (3,) of an ellipsoid at which its outward unit normal is `normal`, from its centre and in its axes."""
    xp = array_namespace(semi_axes, normal)
    semi_axes, normal = xp.asarray(semi_axes, float), xp.asarray(normal, float)
    scaled = semi_axes * normal
    # On x^T A^-2 x = 1, A the semi-axes, the normal n belongs to x = A^2 n / |A n|.
    return semi_axes * scaled / xp.sqrt(scaled @ scaled)


def _finger_state(base, links, tip_axes, point, normal, velocity):
    """Angles (yaw, pitch, pitch) and their rates, of a finger whose ellipsoidal tip touches a moving point of the object.

    `base` is the pose of the finger's base. `point`, `normal` and `velocity` (3,) are the contact point, the outward normal of
    the object and the velocity of its material point there, in world axes.
    """
    xp = array_namespace(base, links, tip_axes, point, normal, velocity)
    base, tip_axes, point, normal, velocity = (xp.asarray(x, float) for x in (base, tip_axes, point, normal, velocity))

    # The angles determine the orientation of the tip, and this the position of its centre, from which the angles follow: a fixed
    # point. The tip is small against the links, so that each iteration reduces the error.
    def iterate(center):
        (yaw, low, bend), rates = finger_angles(base, links, center, point, velocity)
        pitch = host_math.rotation_matrix((0.0, -1.0, 0.0), low + bend)
        rotation = base[:3, :3] @ xp.asarray(rotation_about_z(yaw)) @ xp.asarray(pitch)
        # The outward normal of the tip at the contact is opposite to the object's.
        return point - rotation @ _support(tip_axes, -rotation.T @ normal), ([yaw, low, bend], rates)

    center = point + xp.max(tip_axes) * normal  # outside of the object
    if xp is np:
        for _ in range(_ITERATIONS):
            before = center
            center, angles_and_rates = iterate(center)
        # A traced point cannot be refused; the residuals of the contacts then show the gap.
        if not xp.linalg.norm(center - before) <= 1e-12:
            raise ValueError(
                f"a fingertip of semi-axes {tip_axes.tolist()} m does not reach its contact point {np.round(point, 4).tolist()} "
                "on the object; give a position closer to the default one, longer links or smaller tips"
            )
        return angles_and_rates
    # Each iteration is a contraction in the derivatives too, so the loop itself is differentiated.
    center = jax.lax.scan(lambda at, _: (iterate(at)[0], None), center, None, length=_ITERATIONS - 1)[0]
    return iterate(center)[1]


def _egg_start(
    position: Row = (0.01, -0.02, 0.28),
    turned: Row = (0.1, -0.15, 0.2),
    twist: Row = (0.02, -0.01, 0.02, 0.2, -0.1, 0.15),
    links: Row = FINGER_LINKS,
    circle: Number = BASE_CIRCLE,
    semi_axes: Row = _EGG_SEMI_AXES,
    tip_semi_axes: Row = _TIP_SEMI_AXES,
) -> tuple[Array, Array]:
    """State (q, v) of `hand_rolling_egg` from the object's position, rotation vector and body twist."""
    quaternion, rotation = quaternion_and_matrix(turned)
    xp = array_namespace(position, turned, twist, links, circle, semi_axes, tip_semi_axes)
    rotation, position, twist = xp.asarray(rotation), xp.asarray(position, float), xp.asarray(twist, float)
    world_motion = position, rotation @ twist[:3], rotation @ twist[3:]
    q, v = [], []
    for direction in finger_directions():
        normal = xp.asarray(direction)
        point = position + rotation @ _support(semi_axes, rotation.T @ normal)
        velocity = point_velocity(*world_motion, point)
        angles, rates = _finger_state(finger_base(direction, circle), links, tip_semi_axes, point, normal, velocity)
        q, v = [*q, *angles], [*v, *rates]
    # The contact coordinates follow from the bodies' poses, which a scene with these surfaces places.
    scene = hand_rolling_egg(links=links, circle=circle, semi_axes=semi_axes, tip_semi_axes=tip_semi_axes)
    return scene.system.place(as_state([*q, *position, *quaternion])), as_state([*v, *twist])


@register_scene(_egg_start)
def hand_rolling_egg(
    *,
    links: Row = FINGER_LINKS,
    masses: Row = (0.1, 0.2, 0.15),
    circle: Number = BASE_CIRCLE,
    mass: Number = 0.4,
    semi_axes: Row = _EGG_SEMI_AXES,
    tip_semi_axes: Row = _TIP_SEMI_AXES,
    gravity: Number = 9.81,
    mu: Number = 0.8,
) -> Grasp:
    """Hand of three fingers with three joints each, whose ellipsoidal tips roll without slip on an ellipsoid.

    The constraints are nonholonomic. q = (yaw, pitch and pitch of each finger, the object's free joint, the coordinates of the
    three contacts: a unit vector on the fingertip and one on the object). Each contact has one holonomic row for the gap and
    two Pfaffian rows for slip; its forces are one normal and two tangential ones. `semi_axes` and `tip_semi_axes` (m) of the
    object and of a fingertip are along the axes of their frames; the other parameters are those of `hand_with_ball`.

    Start: the object's `position` (m), rotation vector `turned` (rad) and body twist `twist`, linear part first (m/s, rad/s). The
    fingers touch the object where its normals are horizontal.

    Source: Montana (1988); Murray, Li & Sastry (1994), sections 5.6 and 6.3; EQUATIONS sections 8 and 10.
    """
    builder = hand_builder("hand rolling an egg", links, masses, circle, gravity)
    builder.add_body("egg", None, "free", inertia.ellipsoid(mass, semi_axes), joint_name="object")
    egg, tip = Ellipsoid(semi_axes), Ellipsoid(tip_semi_axes)
    contacts = [rolling_contact(f"tip{i}", tip, "egg", egg, name=f"finger{i}") for i in (1, 2, 3)]
    system = RollingModel(builder.build(), contacts)
    return Grasp(system, "egg", list(system.rows), cones=cones_of(mu))
