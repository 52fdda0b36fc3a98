"""Overconstrained spatial linkages, mobile against Gruebler's count."""

from jaxtyping import Array

from jaxdyn.compile import is_concrete, numpy_for
from jaxdyn.constraints import loop
from jaxdyn.model import float64 as f64
from jaxdyn.model.arguments import Number, Numbers, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_state, register_scene
from jaxdyn.scenes.linkages import thin_bar
from jaxdyn.systems.scene import Scene


def _link(length, twist):
    """Pose of a link's end relative to its start: translation by the length along x, rotation by the twist about x."""
    return f64.pose_of(f64.rotation_matrix((1.0, 0.0, 0.0), twist), (length, 0.0, 0.0))


def _second(length, twist, other):
    """Twist of the links of length `other` for a mobile linkage: a/sin(alpha) = b/sin(beta)."""
    xp = numpy_for(length, twist, other)
    sine = other * xp.sin(twist) / length
    if is_concrete(sine) and abs(sine) >= 1:
        raise ValueError(
            f"lengths {length} and {other} with twist {twist} make no Bennett linkage; sin(beta) is {sine:.4g}"
        )
    return xp.arcsin(sine)


def _bennett_start(
    lengths: Row = (1.0, 0.7), twist: Number = 1.1, angle: Number = 0.8, rate: Number = 1.0
) -> tuple[Array, Array]:
    first, second = twist, _second(lengths[0], twist, lengths[1])
    xp = numpy_for(lengths, twist, angle, rate)
    # tan(q1/2) tan(q2/2) = k, and q3 = -q1 up to a turn.
    k = xp.sin((second + first) / 2) / xp.sin((second - first) / 2)
    follower = 2 * xp.arctan2(k, xp.tan(angle / 2))
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
    return Scene(builder.build(), (loop("link3", poses[0], None, f64.inverse(poses[1]), name="fourth joint"),))
