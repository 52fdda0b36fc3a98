"""Nonholonomic systems: rolling disks and balls, blades, Suslov's body, and hands whose fingertips roll on the object."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import Holonomic, Pfaffian, knife_edge, rolling_sphere, rolling_wheel
from jaxdyn.contact import Ellipsoid, RollingModel, rolling_contact
from jaxdyn.contact.unilateral import ground_contact
from jaxdyn.grasp import Grasp
from jaxdyn.model import host_math, inertia
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, flat_moments, register_scene
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
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene


def _disk_rows(radius, q, t):
    """Rolling without slip: xdot = rho cos(theta) phidot, ydot = rho sin(theta) phidot."""
    rho = radius.astype(q.dtype)
    zero, one = jnp.zeros_like(q[0]), jnp.ones_like(q[0])
    along = jnp.stack([one, zero, zero, -rho * jnp.cos(q[2])])
    return jnp.stack([along, jnp.stack([zero, one, zero, -rho * jnp.sin(q[2])])])


def _disk(q, v, t, p):
    return 0.5 * (p["mass"] * (v[0] ** 2 + v[1] ** 2) + p["steer"] * v[2] ** 2 + p["roll"] * v[3] ** 2)


def _disk_start(
    radius: Number = 0.5, heading: Number = 0.0, steering: Number = 1.0, rolling: Number = 2.0
) -> tuple[Array, Array]:
    xp = array_namespace(heading)
    c, s = xp.cos(heading), xp.sin(heading)
    speed = radius * rolling
    # The velocity along the heading is radius times the roll rate: no slip.
    return as_state([0.0, 0.0, heading, 0.0]), as_state([speed * c, speed * s, steering, rolling])


@register_scene(_disk_start)
def rolling_disk(
    *, mass: Number = 2.0, radius: Number = 0.5, steer_inertia: Number = 0.125, roll_inertia: Number = 0.25
) -> Scene:
    """Upright disk rolling on a plane, q = (x, y, heading theta, roll angle phi); tau = (0, 0, tau_theta, tau_phi).

    I1 thetadd = tau_theta, (I2 + m rho^2) phidd = tau_phi; multipliers
    m d/dt (rho phidot cos theta, rho phidot sin theta).
    Without torques it rolls on a circle of radius rho phidot / thetadot.

    Source: Murray, Li & Sastry (1994), section 6.1.1; EQUATIONS section 6 and erratum E30.
    """
    parameters = {"mass": mass, "steer": steer_inertia, "roll": roll_inertia}
    return Scene(
        LagrangianSystem(_disk, 4, parameters=parameters),
        (Pfaffian(Partial(_disk_rows, as_leaf(radius)), name="rolling"),),
    )


def _sleigh_start(speed: Number = 0.2, yaw_rate: Number = 1.5) -> tuple[Array, Array]:
    return as_state(np.zeros(3)), as_state([speed, 0.0, yaw_rate])


@register_scene(_sleigh_start)
def chaplygin_sleigh(*, mass: Number = 1.0, inertia_com: Number = 0.5, offset: Number = 0.3) -> Scene:
    """Chaplygin sleigh on a horizontal plane: a blade at the body's origin, the centre of mass `offset` ahead of it.

    One body on a planar joint, q = (x, y, theta) of the contact point, v = (forward, sideways, yaw rate).
    vdot = a w^2, wdot = -m a v w/(I + m a^2): tanh and sech.

    Source: Bloch, Nonholonomic Mechanics and Control (2003), section 1.7.
    """
    builder = ModelBuilder("sleigh", gravity=None)
    # The origin is at the blade, so that the constraint is zero sideways velocity of the body.
    builder.add_body("sleigh", None, "planar", (mass, (offset, 0.0, 0.0), flat_moments(inertia_com)))
    return Scene(builder.build(), (knife_edge("sleigh", contact=False, name="blade"),))


def _incline_start(yaw_rate: Number = 2.0) -> tuple[Array, Array]:
    return as_state(np.zeros(3)), as_state([0.0, 0.0, yaw_rate])


@register_scene(_incline_start)
def knife_edge_on_incline(
    *, mass: Number = 1.0, moment: Number = 0.2, slope: Number = np.pi / 6, gravity: Number = 9.81
) -> Scene:
    """Skate that turns while it slides on an inclined plane, x down the slope; q = (x, y, theta).

    With theta = w t and from rest: x = (G/2w^2) sin^2(w t), y = (G/2w^2)(w t - sin(2 w t)/2), G = g sin(slope): a
    cycloid that does not go downhill.

    Source: Bloch (2003), section 1.6.
    """
    xp = array_namespace(slope)
    pull = (gravity * xp.sin(slope), 0.0, -gravity * xp.cos(slope))
    builder = ModelBuilder("skate", gravity=pull)
    builder.add_body("skate", None, "planar", (mass, (0.0, 0.0, 0.0), flat_moments(moment)))
    return Scene(builder.build(), (knife_edge("skate", contact=False, name="blade"),))


def _coin_start(
    radius: Number = 0.05, circle: Number = 0.5, lean: Number = np.pi / 36, gravity: Number = 9.81
) -> tuple[Array, Array]:
    xp = array_namespace(radius, circle, lean, gravity)
    rho = radius / circle
    sine, cosine = xp.sin(lean), xp.cos(lean)
    spin = xp.sqrt(4 * gravity / radius * sine / ((6 - 5 * rho * sine) * rho * cosine))
    turn = -rho * spin
    # The circle is about the world's z axis. Body x is horizontal, y the axle, z points up in the disk, to the axis.
    turned = (xp.cos(lean / 2), xp.sin(lean / 2), 0.0, 0.0)
    center = (0.0, circle - radius * sine, radius * cosine)
    omega = (0.0, turn * sine + spin, turn * cosine)
    forward = -turn * (circle - radius * sine)
    return as_state([*center, *turned]), as_state([forward, 0.0, 0.0, *omega])


@register_scene(_coin_start)
def rolling_coin(*, mass: Number = 0.3048, radius: Number = 0.05, gravity: Number = 9.81) -> Scene:
    """Thin disk that rolls on a plane, leaning freely: one free body, its axle the body's y axis.

    Start: steady rolling on a `circle` (m, of the contact point) at a `lean` (rad) from the vertical.

    Source: Le Saux, Leine & Glocker (2005), eqs 5.10-5.12.
    """
    moments = [share * mass * radius**2 for share in (0.25, 0.5, 0.25)]
    builder = ModelBuilder("coin", gravity=(0.0, 0.0, -gravity))
    builder.add_body("coin", None, "free", (mass, (0.0, 0.0, 0.0), moments))
    axle = (np.zeros(3), (-np.pi / 2, 0.0, 0.0))  # z of the wheel along y of the body
    return Scene(builder.build(), (rolling_wheel("coin", axle, radius, name="rim"),))


def _third_velocity(q, t):
    # The velocity of a spherical joint is in the body's axes, so the row is constant.
    return jnp.asarray([0.0, 0.0, 1.0], q.dtype)


def _suslov_start(across: Number = 1.0, along: Number = -0.5) -> tuple[Array, Array]:
    return as_state([1.0, 0.0, 0.0, 0.0]), as_state([across, along, 0.0])


@register_scene(_suslov_start)
def suslov(*, moments: Row = (1.0, 1.5, 2.0), product: Number = 0.4) -> Scene:
    """Suslov's problem: a rigid body about a fixed point without rotation about its own z axis.

    `moments` (I11, I22, I33) and `product` I13, the entry of the inertia matrix, kg m^2. With I12 = I23 = 0
    w1' = -(I13/I11) w1 w2, w2' = (I13/I22) w1^2: from the start w = (across, along, 0) (rad/s) it goes over to a steady
    rotation about the second axis, w2 = c tanh(n (t + t0)), w1 = c sqrt(I22/I11) sech(n (t + t0)), n = I13 c/I11,
    c^2 = w2^2 + (I11/I22) w1^2.

    Source: Garcia-Naranjo & Jimenez (2017), The geometric discretisation of the Suslov problem.
    """
    xx, yy, zz = moments
    tensor = [[xx, 0.0, product], [0.0, yy, 0.0], [product, 0.0, zz]]
    builder = ModelBuilder("Suslov body", gravity=None)
    builder.add_body("body", None, "spherical", (1.0, (0.0, 0.0, 0.0), tensor))
    return Scene(builder.build(), (Pfaffian(_third_velocity, name="no turn about z"),))


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


def _steady(rate, q, t):
    """Rheonomic constraint: first coordinate minus rate times t, a table driven at a constant rate."""
    # The cast keeps a float32 scene in float32, whatever the dtype of the leaf.
    return q[0] - rate.astype(q.dtype) * t


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
    return Scene(builder.build(), (Holonomic(Partial(_steady, as_leaf(rate)), name="drive"), rolling))


def _ball_on_incline_start(radius: Number = 0.1, velocity: Row = (0.0, 0.5)) -> tuple[Array, Array]:
    # Rolling: v + w x (-r e_z) = 0.
    x, y = velocity
    q = [0.0, 0.0, radius, 1.0, 0.0, 0.0, 0.0]
    return as_state(q), as_state([x, y, 0.0, -y / radius, x / radius, 0.0])


@register_scene(_ball_on_incline_start)
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
