"""Balls in rolling or sliding contact with planes, a free rigid body, and particles on a rod."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import Holonomic, rolling_sphere
from jaxdyn.contact.unilateral import ground_contact
from jaxdyn.model import inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene


def _free_start(rates: Row = (0.3, 0.8, -0.5)) -> tuple[Array, Array]:
    return as_state([1.0, 0.0, 0.0, 0.0]), as_leaf(rates)


@register_scene(_free_start)
def free_body(*, moments: Row = (1.0, 2.0, 3.0)) -> Scene:
    """Rigid body that turns freely about its centre of mass: I w' = (I w) x w, by Jacobi's elliptic functions.

    q = (w, x, y, z), a unit quaternion, v = angular velocity in the body's axes, principal ones; `moments`, kg m^2.
    Start: turned by nothing, with body `rates` (rad/s).

    Source: Celledoni, Fasso, Safstrom & Zanna (2008), The exact computation of the free rigid body motion.
    """
    builder = ModelBuilder("free body", gravity=None)
    # The mass at the fixed point has no effect without gravity.
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), tuple(moments)))
    return Scene(builder.build())


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


class _Rod(eqx.Module):
    """Constraint (|q|^2 - length^2) / 2, so that A = q^T and the tension is -lam length."""

    length: Float[Array, ""] = eqx.field(converter=as_leaf)

    def __call__(self, q, t):
        # Squares instead of |q| - l: the rows stay defined at q = 0, where |q| has no derivative.
        return 0.5 * (jnp.sum(q * q) - self.length.astype(q.dtype) ** 2)


def _particle(q, v, t, p):
    return 0.5 * p["mass"] * jnp.sum(v * v) - p["mass"] * p["gravity"] * q[-1]


def _scene(dimension: int, mass, length, gravity) -> Scene:
    system = LagrangianSystem(_particle, dimension, parameters={"mass": mass, "gravity": gravity})
    return Scene(system, (Holonomic(_Rod(length), name="rod"),))


def _plane_start(length: Number = 1.0, angle: Number = -np.pi / 2, rate: Number = 0.0) -> tuple[Array, Array]:
    s, c = array_namespace(angle).sin(angle), array_namespace(angle).cos(angle)
    # The length multiplies arrays, so that it may be traced.
    return length * as_state([s, -c]), length * rate * as_state([c, s])


@register_scene(_plane_start)
def pendulum_in_plane(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Plane pendulum in x and y (up): L = m |v|^2/2 - m g y, phi = (x^2 + y^2 - l^2)/2.

    lam = -(m/l^2)(|v|^2 - g y); the tension of the rod is -l lam. Start: `angle` from the downward vertical and `rate`;
    by default problem A01 of the IFToMM benchmark library, x = -1, at rest.

    Source: EQUATIONS section 6, with the sign of the multiplier on the right.
    """
    return _scene(2, mass, length, gravity)


def _sphere_start(
    length: Number = 1.0, theta: Number = 1.0, phi: Number = 0.0, theta_rate: Number = 0.0, phi_rate: Number = 1.0
) -> tuple[Array, Array]:
    xp = array_namespace(theta, phi)
    s, c, sp, cp = xp.sin(theta), xp.cos(theta), xp.sin(phi), xp.cos(phi)
    q = length * jnp.asarray([s * cp, s * sp, -c])
    # The derivative of the position with respect to the angles, so the velocity is on the constraint.
    along = theta_rate * jnp.asarray([c * cp, c * sp, s]) + phi_rate * s * jnp.asarray([-sp, cp, 0.0])
    return q, length * along


@register_scene(_sphere_start)
def spherical_pendulum(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Spherical pendulum in x, y and z (up): L = m |v|^2/2 - m g z, phi = (|q|^2 - l^2)/2.

    lam = (m/l^2)(g z - |v|^2). Start by angles: theta from the downward vertical, phi about it.

    Source: EQUATIONS sections 1 and 7.
    """
    return _scene(3, mass, length, gravity)
