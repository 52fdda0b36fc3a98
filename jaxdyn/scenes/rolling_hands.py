"""Hands whose fingertips roll on the object as surfaces do, whatever their shapes."""

import jax.numpy as jnp
import numpy as np

from jaxdyn.contact import Ellipsoid, RollingModel, rolling_contact
from jaxdyn.grasp import Grasp
from jaxdyn.model import inertia
from jaxdyn.scenes._named import named
from jaxdyn.scenes.hands import (
    _CIRCLE,
    _SPATIAL_LINKS,
    _base,
    _carried,
    _cones,
    _directions,
    _quaternion,
    _spatial_finger,
    _spatial_hand,
)

_EGG = (0.1, 0.09, 0.11)
_TIP = (0.03, 0.02, 0.025)
_ROUNDS = 60


def _support(semi_axes, normal):
    """Point of an ellipsoid where the outward normal is the given one."""
    scaled = np.asarray(semi_axes) * normal
    return np.asarray(semi_axes) * scaled / np.linalg.norm(scaled)


def _held(base, links, tip_axes, point, normal, velocity):
    """Angles and rates of a finger whose tip, an ellipsoid, touches a point with an outward normal and moves with it."""
    center = point + np.max(tip_axes) * normal
    for _ in range(_ROUNDS):
        (yaw, low, bend), rates = _spatial_finger(base, links, center, point, velocity)
        up = low + bend
        about = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        pitch = np.array([[np.cos(up), 0.0, -np.sin(up)], [0.0, 1.0, 0.0], [np.sin(up), 0.0, np.cos(up)]])
        turned = base[:3, :3] @ about @ pitch
        center = point - turned @ _support(tip_axes, -turned.T @ normal)
    return [yaw, low, bend], rates


def _egg_start(
    position=(0.01, -0.02, 0.28),
    turned=(0.1, -0.15, 0.2),
    twist=(0.02, -0.01, 0.02, 0.2, -0.1, 0.15),
    links=_SPATIAL_LINKS,
    circle=_CIRCLE,
    semi_axes=_EGG,
    tip_semi_axes=_TIP,
):
    quaternion, rotation = _quaternion(turned)
    position, twist = np.asarray(position, float), np.asarray(twist, float)
    moving = position, rotation @ twist[:3], rotation @ twist[3:]
    q, v = [], []
    for direction in _directions():
        normal = direction
        point = position + rotation @ _support(semi_axes, rotation.T @ normal)
        velocity = _carried(*moving, point)
        angles, rates = _held(_base(direction, circle), links, tip_semi_axes, point, normal, velocity)
        q, v = [*q, *angles], [*v, *rates]
    scene = hand_rolling_egg(links=links, circle=circle, semi_axes=semi_axes, tip_semi_axes=tip_semi_axes)
    return scene.system.place(jnp.asarray([*q, *position, *quaternion])), jnp.asarray([*v, *twist])


@named(_egg_start)
def hand_rolling_egg(
    *,
    links=_SPATIAL_LINKS,
    masses=(0.1, 0.2, 0.15),
    circle=_CIRCLE,
    mass=0.4,
    semi_axes=_EGG,
    tip_semi_axes=_TIP,
    gravity=9.81,
    mu=0.8,
) -> Grasp:
    """Three fingers of three joints each, whose tips, ellipsoids, roll on an ellipsoid that they hold: truly nonholonomic.

    q = (yaw, pitch and pitch of each finger, the object's free joint, the places of the three contacts: unit vectors of the
    fingertip and of the object). Each contact has a holonomic row, the gap, and two Pfaffian ones, no slip; forces are (normal,
    two tangential). `semi_axes`, `tip_semi_axes` of the object and of a fingertip (m), in the axes of their frames; other
    parameters as of `hand_with_ball`. Start: the object's `position`, rotation vector and body twist; the fingers touch
    it where its normals are horizontal.

    Source: Montana (1988); Murray, Li & Sastry (1994), sections 5.6 and 6.3; EQUATIONS sections 8 and 10.
    """
    builder = _spatial_hand("hand rolling an egg", links, masses, circle, gravity)
    builder.add_body("egg", None, "free", inertia.ellipsoid(mass, np.asarray(semi_axes, float)), joint_name="object")
    egg, tip = Ellipsoid(semi_axes), Ellipsoid(tip_semi_axes)
    contacts = [rolling_contact(f"tip{i}", tip, "egg", egg, name=f"finger{i}") for i in (1, 2, 3)]
    system = RollingModel(builder.build(), contacts)
    return Grasp(system, "egg", list(system.rows), cones=_cones(mu))
