"""Hands whose fingertips, smooth surfaces of any shape, roll on the object."""

import jax
import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.contact import Ellipsoid, RollingModel, rolling_contact
from jaxdyn.grasp import Grasp
from jaxdyn.model import float64 as f64
from jaxdyn.model import inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.scenes._named import as_state, register_scene
from jaxdyn.scenes.hands import (
    _CIRCLE,
    _SPATIAL_LINKS,
    _base,
    _cones,
    _directions,
    _point_velocity,
    _quaternion,
    _spatial_finger,
    _spatial_hand,
    _turn,
)

_EGG = (0.1, 0.09, 0.11)
_TIP = (0.03, 0.02, 0.025)
_ROUNDS = 60


def _support(semi_axes, normal):
    """Support point of an ellipsoid in the direction of an outward normal."""
    xp = array_namespace(semi_axes, normal)
    semi_axes, normal = xp.asarray(semi_axes, float), xp.asarray(normal, float)
    scaled = semi_axes * normal
    return semi_axes * scaled / xp.sqrt(scaled @ scaled)


def _finger_state(base, links, tip_axes, point, normal, velocity):
    """Angles and rates of a finger whose ellipsoidal tip touches a moving point with a given outward normal."""
    xp = array_namespace(base, links, tip_axes, point, normal, velocity)
    base, tip_axes, point, normal, velocity = (xp.asarray(x, float) for x in (base, tip_axes, point, normal, velocity))

    def around(center):
        (yaw, low, bend), rates = _spatial_finger(base, links, center, point, velocity)
        pitch = f64.rotation_matrix((0.0, -1.0, 0.0), low + bend)
        turned = base[:3, :3] @ xp.asarray(_turn(yaw)) @ xp.asarray(pitch)
        return point - turned @ _support(tip_axes, -turned.T @ normal), ([yaw, low, bend], rates)

    center = point + xp.max(tip_axes) * normal
    if xp is np:
        for _ in range(_ROUNDS):
            center, turn = around(center)
        return turn
    # Each iteration is a contraction in the derivatives too, so the loop itself is differentiated.
    center = jax.lax.scan(lambda at, _: (around(at)[0], None), center, None, length=_ROUNDS - 1)[0]
    return around(center)[1]


def _egg_start(
    position: Row = (0.01, -0.02, 0.28),
    turned: Row = (0.1, -0.15, 0.2),
    twist: Row = (0.02, -0.01, 0.02, 0.2, -0.1, 0.15),
    links: Row = _SPATIAL_LINKS,
    circle: Number = _CIRCLE,
    semi_axes: Row = _EGG,
    tip_semi_axes: Row = _TIP,
) -> tuple[Array, Array]:
    quaternion, rotation = _quaternion(turned)
    xp = array_namespace(position, turned, twist, links, circle, semi_axes, tip_semi_axes)
    rotation, position, twist = xp.asarray(rotation), xp.asarray(position, float), xp.asarray(twist, float)
    moving = position, rotation @ twist[:3], rotation @ twist[3:]
    q, v = [], []
    for direction in _directions():
        normal = xp.asarray(direction)
        point = position + rotation @ _support(semi_axes, rotation.T @ normal)
        velocity = _point_velocity(*moving, point)
        angles, rates = _finger_state(_base(direction, circle), links, tip_semi_axes, point, normal, velocity)
        q, v = [*q, *angles], [*v, *rates]
    scene = hand_rolling_egg(links=links, circle=circle, semi_axes=semi_axes, tip_semi_axes=tip_semi_axes)
    return scene.system.place(as_state([*q, *position, *quaternion])), as_state([*v, *twist])


@register_scene(_egg_start)
def hand_rolling_egg(
    *,
    links: Row = _SPATIAL_LINKS,
    masses: Row = (0.1, 0.2, 0.15),
    circle: Number = _CIRCLE,
    mass: Number = 0.4,
    semi_axes: Row = _EGG,
    tip_semi_axes: Row = _TIP,
    gravity: Number = 9.81,
    mu: Number = 0.8,
) -> Grasp:
    """Hand of three fingers with three joints each, whose ellipsoidal tips roll on an ellipsoid: nonholonomic.

    q = (yaw, pitch and pitch of each finger, the object's free joint, the places of the three contacts: unit vectors of the
    fingertip and of the object). Each contact has a holonomic row, the gap, and two Pfaffian ones, no slip; forces are (normal,
    two tangential). `semi_axes`, `tip_semi_axes` of the object and of a fingertip (m), in the axes of their frames; other
    parameters as of `hand_with_ball`. Start: the object's `position`, rotation vector and body twist; the fingers touch
    it where its normals are horizontal.

    Source: Montana (1988); Murray, Li & Sastry (1994), sections 5.6 and 6.3; EQUATIONS sections 8 and 10.
    """
    builder = _spatial_hand("hand rolling an egg", links, masses, circle, gravity)
    builder.add_body("egg", None, "free", inertia.ellipsoid(mass, semi_axes), joint_name="object")
    egg, tip = Ellipsoid(semi_axes), Ellipsoid(tip_semi_axes)
    contacts = [rolling_contact(f"tip{i}", tip, "egg", egg, name=f"finger{i}") for i in (1, 2, 3)]
    system = RollingModel(builder.build(), contacts)
    return Grasp(system, "egg", list(system.rows), cones=_cones(mu))
