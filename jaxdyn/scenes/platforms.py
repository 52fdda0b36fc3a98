"""Platforms on legs of hinges, whose loops have more rows than are independent."""

import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints import loop
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, Number, Numbers, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_state, register_scene
from jaxdyn.scenes.linkages import thin_bar, two_link_leg
from jaxdyn.systems.scene import Scene


def _disk(mass, radius, centre):
    """A uniform thin disk about z: mass, centre and moments about it."""
    moment = mass * radius**2 / 4
    return mass, (*centre, 0.0), (moment, moment, 2 * moment)


def _sarrus_start(lengths: Row = (1.0, 0.8), height: Number = 0.9, rate: Number = 2.5) -> tuple[Array, Array]:
    xp = array_namespace(lengths, height, rate)
    q, v = [], []
    for k, length in enumerate(lengths):
        sine = height / (2 * length)
        # At 1 the bars are stretched, where the rate of the angle is infinite.
        if is_concrete(sine) and abs(sine) >= 1:
            raise ValueError(
                f"height is {float(height):.6g}; bars of length {float(length):.6g} reach up to twice that"
            )
        angle, turn = xp.arcsin(sine), rate / (2 * length * xp.sqrt(1 - sine**2))
        # The second chain ends at its elbow: the joint on the platform is the one that closes the loop.
        q += [angle, xp.pi - 2 * angle, angle - xp.pi][: 3 - k]
        v += [turn, -2 * turn, turn][: 3 - k]
    return as_state(q), as_state(v)


@register_scene(_sarrus_start)
def sarrus(
    *,
    lengths: Row = (1.0, 0.8),
    masses: Row = (1.0, 2.0),
    radius: Number = 0.5,
    turn: Number = 1.2,
    gravity: Numbers | None = (0.0, 0.0, -9.81),
) -> Scene:
    """Sarrus's linkage: hinges alone guide a platform along a straight line.

    Two chains of two bars each stand between the ground and the platform, with three parallel horizontal hinges in each.
    Those of the second chain are turned about the vertical by `turn` (rad, not a multiple of pi). `lengths` (m) of the
    bars of each chain; `masses` (kg) of one bar and of the platform, a disk of `radius` (m), at which the hinges stand.
    q = (elevation of the first chain's lower bar, its elbow, the platform, elevation of the second lower bar, its
    elbow). The hinge between the second chain and the platform closes the loop: five rows for five joints, of which four
    are independent. The platform does not turn, and its height z moves by

        I z'' + I_z z'^2 / 2 + (M + 2 m) g = 0,  I = M + sum_i m (1/2 + 1/(6 c_i^2)),  c_i^2 = 1 - z^2/(4 l_i^2),

    with m, M the `masses`, and the sum over the two chains.

    Start: the platform's `height` (m) over the hinges on the ground, and its `rate` (m/s).

    **Raises:** ValueError for a known height that the bars do not reach.

    Source: Sarrus (1853), Note sur la transformation des mouvements rectilignes alternatifs; the equation is Lagrange's
    for uniform bars.
    """
    bar, platform = masses
    xp = array_namespace(turn, radius)
    places, turns = [], []
    for angle in (0.0, turn):
        c, s, zero = xp.cos(angle), xp.sin(angle), 0.0 * xp.cos(angle)
        # x outwards, y up, hinges along z.
        turns.append(xp.stack([xp.stack([c, zero, s]), xp.stack([s, zero, -c]), xp.stack([zero, zero + 1, zero])]))
        places.append(host_math.pose_of(turns[-1], radius * xp.stack([c, s, zero])))
    builder = ModelBuilder("Sarrus linkage", gravity=gravity)
    for name, place, length in zip("ab", places, lengths, strict=True):
        builder.add_body(f"{name}1", None, "continuous", thin_bar(bar, length), joint_name=f"{name}1", pose=place)
        builder.add_body(f"{name}2", f"{name}1", "continuous", thin_bar(bar, length), pose=(length, 0.0, 0.0))
    # The axes of the platform are those of the first chain, its centre lies inwards of the hinge.
    # The hinges along z lie in the plane of the disk, so that y is the axis of the disk here.
    across = platform * radius**2 / 4
    disk = platform, (-radius, 0.0, 0.0), (across, 2 * across, across)
    builder.add_body("platform", "a2", "continuous", disk, pose=(lengths[0], 0.0, 0.0))
    # The second hinge in the platform's frame: both places are at the same height.
    other = host_math.inverse(places[0]) @ places[1]
    closing = loop("b2", (lengths[1], 0.0, 0.0), "platform", other, name="second chain")
    return Scene(builder.build(), (closing,))


def _around(count, radius):
    """`count` points at equal angles about the origin, (count, 2)."""
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], 1)


def _hinge_platform_start(
    count: Checked[int] = 3,
    length: Number = 0.8,
    radii: Row = (1.2, 0.4),
    point: Row = (0.1, 0.2),
    angle: Number = 0.3,
    velocity: Row = (0.3, 0.4),
    rate: Number = 0.5,
) -> tuple[Array, Array]:
    xp = array_namespace(length, radii, point, angle, velocity, rate)
    c, s = xp.cos(angle), xp.sin(angle)
    point, velocity = xp.asarray(point, float), xp.asarray(velocity, float)
    q, v = [], []
    for base, (x, y) in zip(_around(count, radii[0]), _around(count, radii[1]), strict=True):
        arm = xp.stack([c * x - s * y, s * x + c * y])
        # Velocity of a point of the platform: v + w x arm.
        angles, rates = two_link_leg(base, length, point + arm, velocity + rate * xp.stack([-arm[1], arm[0]]))
        q, v = q + angles, v + rates
        # The platform follows the first leg in depth-first order; its angle is relative to the upper link.
        if len(q) == 2:
            q, v = [*q, angle - sum(angles)], [*v, rate - sum(rates)]
    return as_state(q), as_state(v)


@register_scene(_hinge_platform_start)
def hinge_platform(
    *,
    count: Checked[int] = 3,
    length: Number = 0.8,
    radii: Row = (1.2, 0.4),
    masses: Row = (0.5, 2.0),
    tilt: Number = 0.5,
    gravity: Numbers | None = (0.0, 0.0, -9.81),
) -> Scene:
    """A platform on `count` legs, each with three hinges, all hinges parallel: it moves in an inclined plane.

    The plane is turned about the world's x axis by `tilt` (rad). Hinges stand on the ground and on the platform at equal
    angles on circles of `radii` (m); each leg has two bars of one `length` (m). `masses` (kg) of one bar and of the
    platform, a disk. q = (first leg's two angles, the platform's angle, two angles of each other leg), each relative to
    the body before. The first leg carries the platform, and a hinge with all five rows of a joint in space closes the loop
    of each other leg: 5 (count - 1) rows, of which 2 (count - 1) are independent, leave the three freedoms of a plane.

    Start: the `point` of the platform's centre (m) in the plane and its `velocity` (m/s), the platform's `angle` (rad)
    and its `rate` (rad/s); elbows to the left of the way from the ground to the platform.

    **Raises:** ValueError for known numbers with which a leg does not reach the platform.

    Source: Gosselin and Angeles (1988), The optimum kinematic design of a planar three-degree-of-freedom parallel
    manipulator, for three legs.
    """
    bar, mass = masses
    plane = host_math.pose_of(host_math.rotation_matrix((1.0, 0.0, 0.0), tilt), (0.0, 0.0, 0.0))
    hinges = _around(count, radii[1])
    legs = [f"leg{k + 1:0{len(str(count))}d}" for k in range(count)]
    builder = ModelBuilder(f"platform on {count} legs of hinges", gravity=gravity)
    for name, (x, y) in zip(legs, _around(count, radii[0]), strict=True):
        place = plane @ host_math.pose_of(np.eye(3), (x, y, 0.0))
        builder.add_body(f"{name}_lower", None, "continuous", thin_bar(bar, length), joint_name=name, pose=place)
        builder.add_body(f"{name}_upper", f"{name}_lower", "continuous", thin_bar(bar, length), pose=(length, 0.0, 0.0))
    # The platform's origin is its hinge on the first leg, from which its centre lies at minus that hinge.
    disk = _disk(mass, radii[1], (-hinges[0][0], -hinges[0][1]))
    builder.add_body("platform", f"{legs[0]}_upper", "continuous", disk, pose=(length, 0.0, 0.0))
    closing = [
        loop(f"{name}_upper", (length, 0.0, 0.0), "platform", (*(hinge - hinges[0]), 0.0), name=f"{name} hinge")
        for name, hinge in zip(legs[1:], hinges[1:], strict=True)
    ]
    return Scene(builder.build(), closing)
