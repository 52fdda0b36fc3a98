"""Balls in rolling or sliding contact with planes."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import Holonomic, rolling_sphere
from jaxdyn.contact.unilateral import ground_contact
from jaxdyn.model import inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.scene import Scene


class _Steady(eqx.Module):
    """Rheonomic constraint: first coordinate minus rate times t, a table driven at a constant rate."""

    rate: Float[Array, ""] = eqx.field(converter=as_leaf)

    def __call__(self, q, t):
        # The cast keeps a float32 scene in float32, whatever the dtype of the leaf.
        return q[0] - self.rate.astype(q.dtype) * t


def _turntable_start(
    radius: Number = 0.2, rate: Number = 3.0, position: Row = (1.0, 0.0), velocity: Row = (0.0, 0.5)
) -> tuple[Array, Array]:
    # The contact point of the ball moves with the table: v + w x (-r e_z) = rate e_z x p.
    slip = -rate * position[1] - velocity[0], rate * position[0] - velocity[1]
    spin = slip[1] / radius, -slip[0] / radius, 0.0
    q = [0.0, *position, radius, 1.0, 0.0, 0.0, 0.0]
    return as_state(q), as_state([rate, *velocity, 0.0, *spin])


@register_scene(_turntable_start)
def ball_on_turntable(*, mass: Number = 1.0, radius: Number = 0.2, rate: Number = 3.0, gravity: Number = 9.81) -> Scene:
    """Solid ball that rolls on a turntable driven at a constant rate: vdot = (2/7) rate e_z x v, a circle.

    q = (table angle, the ball's free joint). The drive is a moving holonomic constraint, the contact rolls on a body.

    Source: Weltner (1979), Am. J. Phys. 47, 984.
    """
    builder = ModelBuilder("turntable", gravity=(0.0, 0.0, -gravity))
    # The drive prescribes the table's motion, so its inertia has no effect on the ball.
    builder.add_body("table", None, "continuous", (1.0, (0.0, 0.0, 0.0), (0.5, 0.5, 1.0)), joint_name="1")
    builder.add_body("ball", None, "free", inertia.sphere(mass, radius), joint_name="2")
    rolling = rolling_sphere("ball", None, radius, surface_body="table", name="contact")
    return Scene(builder.build(), (Holonomic(_Steady(rate), name="drive"), rolling))


def _incline_start(radius: Number = 0.1, velocity: Row = (0.0, 0.5)) -> tuple[Array, Array]:
    # Rolling: v + w x (-r e_z) = 0.
    x, y = velocity
    q = [0.0, 0.0, radius, 1.0, 0.0, 0.0, 0.0]
    return as_state(q), as_state([x, y, 0.0, -y / radius, x / radius, 0.0])


@register_scene(_incline_start)
def ball_on_incline(
    *, mass: Number = 1.0, radius: Number = 0.1, slope: Number = np.pi / 6, gravity: Number = 9.81
) -> Scene:
    """Solid ball that rolls on an inclined plane, x down the slope, z along its normal: a parabola.

    vdot = (5/7) g sin(slope) e_x. Start: `velocity` (m/s) of the centre, without spin about the normal.
    """
    xp = array_namespace(slope)
    # Gravity is inclined instead of the plane, which keeps the contact in coordinate directions.
    pull = (gravity * xp.sin(slope), 0.0, -gravity * xp.cos(slope))
    builder = ModelBuilder("ball on an incline", gravity=pull)
    builder.add_body("ball", None, "free", inertia.sphere(mass, radius))
    return Scene(builder.build(), (rolling_sphere("ball", None, radius, name="contact"),))


def _bowling_start(
    radius: Number = 0.10795, velocity: Row = (8.0, 0.0), spin: Row = (-8 * np.pi, 0.0, 0.0)
) -> tuple[Array, Array]:
    return as_state([0.0, 0.0, radius, 1.0, 0.0, 0.0, 0.0]), as_state([*velocity, 0.0, *spin])


@register_scene(_bowling_start)
def bowling_ball(
    *,
    mass: Number = 6.35,
    radius: Number = 0.10795,
    moment: Number = 0.0296,
    friction: Number = 0.12,
    gravity: Number = 9.8,
) -> Scene:
    """Bowling ball that slides with Coulomb friction, then rolls.

    The velocity u of the point that touches the lane keeps its direction, so that the centre moves on a parabola:
    vdot = -mu g u/|u|, with I w + m r e_z x v constant. It rolls after |u0| / (mu g (1 + m r^2/I)), at constant velocity
    (`jd.contact.ground_contact`, whose events say when).

    Start: `velocity` (m/s) of the centre, `spin` (rad/s) in axes of the world.

    Source: test "bowling ball" of Drake (multibody/benchmarks).
    """
    builder = ModelBuilder("bowling ball", gravity=(0.0, 0.0, -gravity))
    builder.add_body("ball", None, "free", (mass, (0.0, 0.0, 0.0), (moment, moment, moment)))
    return Scene(builder.build(), (), (ground_contact("ball", None, friction, radius=radius, name="lane"),))
