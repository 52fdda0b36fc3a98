"""Overconstrained spatial linkages, mobile against Gruebler's count, and platforms on legs of hinges with redundant rows."""

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


def _link(length, twist):
    """Pose of a link's end relative to its start: translation by the length along x, rotation by the twist about x."""
    # Denavit and Hartenberg's length and twist; offsets along the axes are zero in these linkages.
    return host_math.pose_of(host_math.rotation_matrix((1.0, 0.0, 0.0), twist), (length, 0.0, 0.0))


def _second(length, twist, other):
    """Twist of the links of length `other` for a mobile linkage: a/sin(alpha) = b/sin(beta)."""
    xp = array_namespace(length, twist, other)
    sine = other * xp.sin(twist) / length
    if is_concrete(sine) and abs(sine) >= 1:
        raise ValueError(
            f"lengths {length} and {other} with twist {twist} make no Bennett linkage; sin(beta) is {sine:.4g}"
        )
    return xp.arcsin(sine)


def _half_angle_product(first, second):
    """tan(q1/2) tan(q2/2) of a Bennett linkage with links of twists `first` and `second`, where q2 follows `first`."""
    xp = array_namespace(first, second)
    return xp.sin((second + first) / 2) / xp.sin((second - first) / 2)


def _bennett_start(
    lengths: Row = (1.0, 0.7), twist: Number = 1.1, angle: Number = 0.8, rate: Number = 1.0
) -> tuple[Array, Array]:
    xp = array_namespace(lengths, twist, angle, rate)
    # q3 = -q1 up to a turn.
    k = _half_angle_product(twist, _second(lengths[0], twist, lengths[1]))
    # arctan2 and not a quotient: the angle 0 gives pi without a division by zero.
    follower = 2 * xp.arctan2(k, xp.tan(angle / 2))
    # The product of the tangents of the half angles is constant, so q'/sin q are opposite.
    following = -rate * xp.sin(follower) / xp.sin(angle)
    return as_state([angle, follower, -angle]), as_state([rate, following, -rate])


@register_scene(_bennett_start)
def bennett(
    *, lengths: Row = (1.0, 0.7), twist: Number = 1.1, mass: Number = 1.0, gravity: Numbers | None = (0.0, 0.0, -9.81)
) -> Scene:
    """Bennett's linkage: four links, opposite ones equal, with four revolute joints whose axes never meet.

    Links of `lengths` (a, b) (m) and twists (alpha, beta) (rad) with a/sin(alpha) = b/sin(beta); `twist` is alpha.
    q = angles of the three moving links, uniform bars of `mass` (kg); the fourth joint closes the loop. Its five rows
    for three joints leave one degree of freedom, because only two of them are independent:

        tan(q1/2) tan(q2/2) = sin((beta + alpha)/2)/sin((beta - alpha)/2),  q3 = -q1.

    Start: the first `angle` (rad, not 0) and its `rate` (rad/s).

    Source: Bennett (1903), A new mechanism; Hunt (1978), Kinematic Geometry of Mechanisms.
    """
    poses = [_link(lengths[0], twist), _link(lengths[1], _second(lengths[0], twist, lengths[1]))]
    bars = [thin_bar(mass, length) for length in lengths]
    builder = ModelBuilder("Bennett linkage", gravity=gravity)
    builder.add_body("link1", None, "continuous", bars[0])
    builder.add_body("link2", "link1", "continuous", bars[1], pose=poses[0])
    builder.add_body("link3", "link2", "continuous", bars[0], pose=poses[1])
    return Scene(builder.build(), (loop("link3", poses[0], None, host_math.inverse(poses[1]), name="fourth joint"),))


def _goldberg_twists(lengths, twist):
    """Twists of the links of lengths (a, b, c), of which those of a have the given `twist`."""
    a, b, c = lengths
    if is_concrete(lengths) and b in (a, c):
        raise ValueError(f"lengths are {tuple(map(float, lengths))}; the shared length b must differ from a and from c")
    return twist, _second(a, twist, b), _second(a, twist, c)


def _goldberg_start(
    lengths: Row = (1.0, 0.7, 0.5), twist: Number = 1.1, angle: Number = 1.2, rate: Number = 1.0
) -> tuple[Array, Array]:
    first, shared, other = _goldberg_twists(lengths, twist)
    xp = array_namespace(lengths, twist, angle, rate)
    one, two = _half_angle_product(first, shared), _half_angle_product(other, shared)
    second, third = 2 * xp.arctan2(one * two, xp.tan(angle / 2)), -2 * xp.arctan(xp.tan(angle / 2) / two)
    # Products and ratios of tangents of half angles are constant: q' / sin q is the same but for its sign.
    pace = rate / xp.sin(angle)
    second_rate, third_rate = -pace * xp.sin(second), pace * xp.sin(third)
    q = [angle, second, third, -angle - second - xp.pi]
    return as_state(q), as_state([rate, second_rate, third_rate, -rate - second_rate])


@register_scene(_goldberg_start)
def goldberg(
    *,
    lengths: Row = (1.0, 0.7, 0.5),
    twist: Number = 1.1,
    density: Number = 1.0,
    gravity: Numbers | None = (0.0, 0.0, -9.81),
) -> Scene:
    """Goldberg's five-bar linkage: two Bennett linkages joined along a link that both have, which is then left out.

    `lengths` (a, b, c) (m) with twists a/sin(alpha) = b/sin(beta) = c/sin(gamma); `twist` is alpha (rad). The first
    linkage has the links a, b, a, b, the second one c, b, c, b. A link c stands in line with a link a, and the two are one
    rigid link of length a + c and twist alpha + gamma. Around the loop, links of lengths a + c, b, a, c, and b, which is
    the ground. q = angles of the four moving links, uniform bars of `density` (kg/m); the fifth joint closes the loop.
    Its five rows for four joints leave one freedom, because only three of them are independent:

        tan(q1/2) tan(q2/2) = k1 k2,  tan(q3/2) = -tan(q1/2)/k2,  q4 = pi - q1 - q2 up to a turn,
        k1 = sin((beta + alpha)/2)/sin((beta - alpha)/2),  k2 = sin((beta + gamma)/2)/sin((beta - gamma)/2).

    Start: the first `angle` (rad, not 0) and its `rate` (rad/s).

    **Raises:** ValueError for known lengths that make no Bennett linkages.

    Source: Goldberg (1943), New five-bar and six-bar linkages in three dimensions.
    """
    a, b, c = lengths
    first, shared, other = _goldberg_twists(lengths, twist)
    # Links in line have parallel common normals, so that lengths and twists add.
    long, middle = _link(a + c, first + other), _link(b, shared)
    builder = ModelBuilder("Goldberg linkage", gravity=gravity)
    builder.add_body("link1", None, "continuous", thin_bar(density * (a + c), a + c))
    builder.add_body("link2", "link1", "continuous", thin_bar(density * b, b), pose=long)
    builder.add_body("link3", "link2", "continuous", thin_bar(density * a, a), pose=middle)
    builder.add_body("link4", "link3", "continuous", thin_bar(density * c, c), pose=_link(a, first))
    closing = loop("link4", _link(c, other), None, host_math.inverse(middle), name="fifth joint")
    return Scene(builder.build(), (closing,))


def _bricard_start(
    twist: Number = 1.2, angle: Number = 0.8, rate: Number = 1.0, branch: Checked[int] = 1
) -> tuple[Array, Array]:
    xp = array_namespace(twist, angle, rate)
    c, s = xp.cos(twist), xp.sin(twist)
    # The closure is x cos(other) + y sin(other) + z = 0.
    x, y = s**2 + (1 + c**2) * xp.cos(angle), -2 * c * xp.sin(angle)
    z = c**2 + s**2 * xp.cos(angle)
    cosine = -z / xp.sqrt(x**2 + y**2)
    if is_concrete(cosine) and abs(cosine) >= 1:
        raise ValueError(f"angle is {float(angle):.6g}; the linkage of twist {float(twist):.6g} does not close there")
    other = xp.arctan2(y, x) - branch * xp.arccos(cosine)
    # Implicit differentiation of the closure; both partial derivatives are written out.
    by_angle = (
        -(1 + c**2) * xp.sin(angle) * xp.cos(other) - 2 * c * xp.cos(angle) * xp.sin(other) - s**2 * xp.sin(angle)
    )
    by_other = -x * xp.sin(other) + y * xp.cos(other)
    other_rate = -by_angle / by_other * rate
    return as_state([angle, other, angle, other, angle]), as_state([rate, other_rate, rate, other_rate, rate])


@register_scene(_bricard_start)
def bricard(
    *,
    length: Number = 1.0,
    twist: Number = 1.2,
    mass: Number = 1.0,
    gravity: Numbers | None = (0.0, 0.0, -9.81),
) -> Scene:
    """Bricard's linkage with threefold symmetry: six equal links whose twists alternate, joined by six revolute joints.

    Links of one `length` (m) and of twists `twist` and -`twist` (rad) in turn, the last one on the ground; the five
    moving ones are uniform bars of `mass` (kg), and q holds their angles. The sixth joint closes the loop. Its five rows
    for five joints leave one freedom, because only four of them are independent. All odd angles are equal to q1, all even
    ones to q2, and with c, s of the twist

        c^2 + s^2 (cos q1 + cos q2) + (1 + c^2) cos q1 cos q2 - 2 c sin q1 sin q2 = 0.

    Start: the first `angle` (rad) and its `rate` (rad/s), and which of the two solutions q2 is, `branch` +1 or -1.

    **Raises:** ValueError for a known angle at which the linkage does not close.

    Source: Bricard (1897), Mémoire sur la théorie de l'octaèdre articulé; Chen, You and Tarnai (2005),
    Threefold-symmetric Bricard linkages for deployable structures.
    """
    poses = [_link(length, twist), _link(length, -twist)]
    builder, parent = ModelBuilder("Bricard linkage", gravity=gravity), None
    for k in range(5):
        # Twists alternate around the loop, the last link on the ground included.
        before = None if parent is None else poses[(k - 1) % 2]
        builder.add_body(f"link{k + 1}", parent, "continuous", thin_bar(mass, length), pose=before)
        parent = f"link{k + 1}"
    return Scene(builder.build(), (loop("link5", poses[0], None, host_math.inverse(poses[1]), name="sixth joint"),))


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
