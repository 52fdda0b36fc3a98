"""Bodies that roll or slide on a blade: nonholonomic constraints."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn import inertia
from jaxdyn.building import ModelBuilder
from jaxdyn.constraints import Holonomic, Pfaffian, knife_edge, rolling_sphere, rolling_wheel
from jaxdyn.scene import Scene
from jaxdyn.scenes._named import named
from jaxdyn.systems import LagrangianSystem


def _as_leaf(value):
    return jnp.asarray(value, float)


class _DiskRows(eqx.Module):
    """xdot = rho cos(theta) phidot, ydot = rho sin(theta) phidot."""

    radius: Float[Array, ""] = eqx.field(converter=_as_leaf)

    def __call__(self, q, t):
        rho = self.radius.astype(q.dtype)
        zero, one = jnp.zeros_like(q[0]), jnp.ones_like(q[0])
        return jnp.stack(
            [
                jnp.stack([one, zero, zero, -rho * jnp.cos(q[2])]),
                jnp.stack([zero, one, zero, -rho * jnp.sin(q[2])]),
            ]
        )


def _disk(q, v, t, p):
    return 0.5 * (p["mass"] * (v[0] ** 2 + v[1] ** 2) + p["steer"] * v[2] ** 2 + p["roll"] * v[3] ** 2)


def _disk_start(radius=0.5, heading=0.0, steering=1.0, rolling=2.0):
    c, s = np.cos(heading), np.sin(heading)
    speed = radius * rolling
    return jnp.asarray([0.0, 0.0, heading, 0.0]), jnp.asarray([speed * c, speed * s, steering, rolling])


@named(_disk_start)
def rolling_disk(*, mass=2.0, radius=0.5, steer_inertia=0.125, roll_inertia=0.25) -> Scene:
    """Upright disk rolling on a plane, q = (x, y, heading theta, roll angle phi); tau = (0, 0, tau_theta, tau_phi).

    I1 thetadd = tau_theta, (I2 + m rho^2) phidd = tau_phi; multipliers
    m d/dt (rho phidot cos theta, rho phidot sin theta).
    Without torques it rolls on a circle of radius rho phidot / thetadot.

    Source: Murray, Li & Sastry (1994), section 6.1.1; EQUATIONS section 6 and erratum E30.
    """
    parameters = {"mass": mass, "steer": steer_inertia, "roll": roll_inertia}
    return Scene(LagrangianSystem(_disk, 4, parameters=parameters), (Pfaffian(_DiskRows(radius), name="rolling"),))


def _sleigh_start(speed=0.2, yaw_rate=1.5):
    return jnp.zeros(3), jnp.asarray([speed, 0.0, yaw_rate])


@named(_sleigh_start)
def chaplygin_sleigh(*, mass=1.0, inertia_com=0.5, offset=0.3) -> Scene:
    """Chaplygin sleigh on a horizontal plane: a blade at the body's origin, the centre of mass `offset` ahead of it.

    One body on a planar joint, q = (x, y, theta) of the contact point, v = (forward, sideways, yaw rate).
    vdot = a w^2, wdot = -m a v w/(I + m a^2): tanh and sech.

    Source: Bloch, Nonholonomic Mechanics and Control (2003), section 1.7.
    """
    moments = (0.0, 0.0, inertia_com)
    builder = ModelBuilder("sleigh", gravity=None)
    builder.add_body("sleigh", None, "planar", (mass, (offset, 0.0, 0.0), moments))
    return Scene(builder.build(), (knife_edge("sleigh", contact=False, name="blade"),))


def _incline_start(yaw_rate=2.0):
    return jnp.zeros(3), jnp.asarray([0.0, 0.0, yaw_rate])


@named(_incline_start)
def knife_edge_on_incline(*, mass=1.0, moment=0.2, slope=np.pi / 6, gravity=9.81) -> Scene:
    """A skate that turns while it slides on an inclined plane, x down the slope; q = (x, y, theta).

    With theta = w t and from rest: x = (G/2w^2) sin^2(w t), y = (G/2w^2)(w t - sin(2 w t)/2), G = g sin(slope): a
    cycloid that does not go downhill.

    Source: Bloch (2003), section 1.6.
    """
    pull = (gravity * np.sin(slope), 0.0, -gravity * np.cos(slope))
    builder = ModelBuilder("skate", gravity=pull)
    builder.add_body("skate", None, "planar", (mass, (0.0, 0.0, 0.0), (0.0, 0.0, moment)))
    return Scene(builder.build(), (knife_edge("skate", contact=False, name="blade"),))


class _Steady(eqx.Module):
    """First coordinate minus rate times t: a table driven at a constant rate."""

    rate: Float[Array, ""] = eqx.field(converter=_as_leaf)

    def __call__(self, q, t):
        return q[0] - self.rate.astype(q.dtype) * t


def _turntable_start(radius=0.2, rate=3.0, position=(1.0, 0.0), velocity=(0.0, 0.5)):
    # The contact point of the ball moves with the table: v + w x (-r e_z) = rate e_z x p.
    slip = rate * np.array([-position[1], position[0]]) - velocity
    spin = np.array([slip[1], -slip[0], 0.0]) / radius
    q = [0.0, *position, radius, 1.0, 0.0, 0.0, 0.0]
    return jnp.asarray(q), jnp.asarray([rate, *velocity, 0.0, *spin])


@named(_turntable_start)
def ball_on_turntable(*, mass=1.0, radius=0.2, rate=3.0, gravity=9.81) -> Scene:
    """Solid ball that rolls on a turntable driven at a constant rate: vdot = (2/7) rate e_z x v, a circle.

    q = (table angle, the ball's free joint). The drive is a moving holonomic constraint, the contact rolls on a body.

    Source: Weltner (1979), Am. J. Phys. 47, 984.
    """
    builder = ModelBuilder("turntable", gravity=(0.0, 0.0, -gravity))
    builder.add_body("table", None, "continuous", (1.0, (0.0, 0.0, 0.0), (0.5, 0.5, 1.0)), joint_name="1")
    builder.add_body("ball", None, "free", inertia.sphere(mass, radius), joint_name="2")
    rolling = rolling_sphere("ball", None, radius, surface_body="table", name="contact")
    return Scene(builder.build(), (Holonomic(_Steady(rate), name="drive"), rolling))


def _coin_start(radius=0.05, circle=0.5, lean=np.pi / 36, gravity=9.81):
    rho = radius / circle
    sine, cosine = np.sin(lean), np.cos(lean)
    spin = np.sqrt(4 * gravity / radius * sine / ((6 - 5 * rho * sine) * rho * cosine))
    turn = -rho * spin
    # The circle is about the world's z axis. Body x is horizontal, y the axle, z points up in the disk, to the axis.
    turned = np.array([np.cos(lean / 2), np.sin(lean / 2), 0.0, 0.0])
    center = np.array([0.0, circle - radius * sine, radius * cosine])
    omega = np.array([0.0, turn * sine + spin, turn * cosine])
    forward = -turn * (circle - radius * sine)
    return jnp.asarray([*center, *turned]), jnp.asarray([forward, 0.0, 0.0, *omega])


@named(_coin_start)
def rolling_coin(*, mass=0.3048, radius=0.05, gravity=9.81) -> Scene:
    """Thin disk that rolls on a plane, leaning freely: one free body, its axle the body's y axis.

    Start: steady rolling on a `circle` (m, of the contact point) at a `lean` (rad) from the vertical.

    Source: Le Saux, Leine & Glocker (2005), eqs 5.10-5.12.
    """
    moments = np.array([0.25, 0.5, 0.25]) * mass * radius**2
    builder = ModelBuilder("coin", gravity=(0.0, 0.0, -gravity))
    builder.add_body("coin", None, "free", (mass, (0.0, 0.0, 0.0), tuple(moments)))
    axle = (np.zeros(3), (-np.pi / 2, 0.0, 0.0))  # z of the wheel along y of the body
    return Scene(builder.build(), (rolling_wheel("coin", axle, radius, name="rim"),))
