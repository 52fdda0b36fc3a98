"""Overconstrained spatial linkages, mobile against Gruebler's count."""

from jaxtyping import Array

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints import loop
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, Number, Numbers, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_state, register_scene
from jaxdyn.scenes.linkages import thin_bar
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
