"""Mechanisms assembled from separate bodies: a double pendulum in four formulations, a disk under a link."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints import loop
from jaxdyn.geometry.immersion import constrain_by_immersion
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import MetricSystem


def _planar_metric(q, t, p):
    return jnp.diag(jnp.stack([p["mass"], p["mass"], p["moment"]])).astype(q.dtype)


def _planar_potential(q, t, p):
    return p["mass"] * p["gravity"] * q[1]


def planar_body(mass, moment, gravity) -> MetricSystem:
    """Planar body by its centre of mass and its angle, (x, y, angle), with gravity along -y."""
    parameters = {"mass": mass, "moment": moment, "gravity": gravity}
    return MetricSystem(_planar_metric, 3, potential=_planar_potential, parameters=parameters)


def _hanging(angle, length):
    return length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])


class _TwoLinks(eqx.Module):
    """Immersion (theta, phi) -> configurations of two links, the second suspended from the end of the first."""

    length: Float[Array, ""] = eqx.field(converter=as_leaf)
    reaches: Float[Array, "2"] = eqx.field(converter=as_leaf)

    def __call__(self, s):
        length, reaches = self.length.astype(s.dtype), self.reaches.astype(s.dtype)
        centre = _hanging(s[0], length) + _hanging(s[1], reaches[1])
        return jnp.append(_hanging(s[0], reaches[0]), s[0]), jnp.append(centre, s[1])


def _double(q, v, t, p):
    # The energy depends on the velocities of points of both links only through the cosine of a - b.
    (m1, m2), (r1, r2), l1 = p["masses"], p["reaches"], p["length"]
    first = (p["moments"][0] + m1 * r1**2 + m2 * l1**2) * v[0] ** 2
    second = (p["moments"][1] + m2 * r2**2) * v[1] ** 2
    return 0.5 * (first + second) + m2 * l1 * r2 * jnp.cos(q[0] - q[1]) * v[0] * v[1]


def _double_potential(q, t, p):
    (m1, m2), (r1, r2) = p["masses"], p["reaches"]
    return -p["gravity"] * ((m1 * r1 + m2 * p["length"]) * jnp.cos(q[0]) + m2 * r2 * jnp.cos(q[1]))


def _by_lagrangian(masses, length, reaches, moments, gravity):
    parameters = dict(masses=masses, length=length, reaches=reaches, moments=moments, gravity=gravity)
    return Scene(LagrangianSystem(_double, 2, parameters=parameters, potential=_double_potential))


def _by_immersion(masses, length, reaches, moments, gravity):
    bodies = tuple(planar_body(m, moment, gravity) for m, moment in zip(masses, moments, strict=True))
    return Scene(constrain_by_immersion(bodies, _TwoLinks(length, reaches), 2))


def _bodies(masses, reaches, moments, gravity, joint, parent, pose):
    builder = ModelBuilder("double pendulum", gravity=(0.0, -gravity, 0.0))
    # A bar along y has no moment about its own axis.
    inertias = [
        (m, (0.0, -r, 0.0), (moment, 0.0, moment)) for m, r, moment in zip(masses, reaches, moments, strict=True)
    ]
    builder.add_body("first", None, "continuous", inertias[0], joint_name="1")
    builder.add_body("second", parent, joint, inertias[1], joint_name="2", pose=pose)
    return builder.build()


def _by_model(masses, length, reaches, moments, gravity):
    hung = (0.0, -length, 0.0)
    return Scene(_bodies(masses, reaches, moments, gravity, "continuous", "first", hung))


def _by_loop(masses, length, reaches, moments, gravity):
    # The second body is free in the plane here, and a point mass would leave its angle without inertia.
    if is_concrete(moments) and not moments[1] > 0:
        raise ValueError(
            f"moments is {moments}; a free body needs a moment of inertia, so that formulation='loop' takes moments[1] > 0"
        )
    bodies = _bodies(masses, reaches, moments, gravity, "planar", None, None)
    # In the plane two rows of a revolute joint are left; the others hold identically.
    hinge = loop("first", (0.0, -length, 0.0), "second", (0.0, 0.0, 0.0), in_plane=True, name="hinge")
    return Scene(bodies, (hinge,))


_FORMULATIONS: dict[str, Callable[..., Any]] = {
    "lagrangian": _by_lagrangian,
    "model": _by_model,
    "immersion": _by_immersion,
    "loop": _by_loop,
}


def _builder(formulation):
    if formulation not in _FORMULATIONS:
        raise ValueError(f"formulation is {formulation!r}; choose from {', '.join(_FORMULATIONS)}")
    return _FORMULATIONS[formulation]


def _double_start(
    formulation: str = "lagrangian", angles: Row = (0.6, -0.2), rates: Row = (1.1, -0.7), length: Number = 1.0
) -> tuple[Array, Array]:
    _builder(formulation)
    (theta, phi), (theta_rate, phi_rate) = as_leaf(angles), as_leaf(rates)
    if formulation == "model":
        # Angles of a chain are relative, those of the Lagrangian absolute.
        return jnp.stack([theta, phi - theta]), jnp.stack([theta_rate, phi_rate - theta_rate])
    if formulation == "loop":
        end, turned = _hanging(theta, length), theta - phi
        speed = length * theta_rate * jnp.stack([jnp.cos(turned), jnp.sin(turned)])  # in the second body's axes
        q = jnp.concatenate([theta[None], end, phi[None]])
        return q, jnp.concatenate([theta_rate[None], speed, phi_rate[None]])
    return jnp.stack([theta, phi]), jnp.stack([theta_rate, phi_rate])


@register_scene(_double_start)
def double_pendulum(
    *,
    formulation: str = "lagrangian",
    masses: Row = (1.0, 0.5),
    length: Number = 1.0,
    reaches: Row = (0.5, 0.35),
    moments: Row | None = None,
    gravity: Number = 9.81,
) -> Scene:
    """Double pendulum in the x-y plane, y up, by absolute angles theta and phi from the downward vertical.

    `length` of the first link, `reaches` from each hinge to the centre of mass, m; `moments` about the centres of mass,
    None for uniform bars of twice these reaches, (0, 0) for point masses. The same mechanism as

    - "lagrangian": L(q, v), q = (theta, phi);
    - "model": two bodies in a chain, q = (theta, phi - theta);
    - "immersion": two separate bodies in the plane, joined by q = (theta, phi);
    - "loop": a pendulum and a separate body, closed by a revolute joint; q = (theta, x, y, phi), with x and y of the
      second body's hinge, and the velocity (vx, vy) in its axes.

    Start: `angles` and `rates` (theta, phi), and the `length`, in the coordinates of the `formulation`.

    Source: EQUATIONS section 12 with errata E53 to E55.
    """
    if moments is None:
        moments = tuple(m * (2 * r) ** 2 / 12 for m, r in zip(masses, reaches, strict=True))
    return _builder(formulation)(masses, length, reaches, moments, gravity)


def _tangent(s):
    """Immersion q = (z1, theta, y1, theta2) -> configurations of a disk of radius 1 and a link tangent to it from above."""
    z, turn, y, tilt = s
    # The link touches the disk from above: its line has the distance 1 from the disk's centre (z, 1).
    height = 1 + (1 + jnp.sin(tilt) * (z - y)) / jnp.cos(tilt)
    return jnp.stack([z, jnp.ones_like(z), turn]), jnp.stack([y, height, tilt])


class _Applied(eqx.Module):
    """Forces: torque on the link, friction of the link on the disk along the link, and of the ground on the disk along -x."""

    torque: Float[Array, ""] = eqx.field(converter=as_leaf)
    friction: Float[Array, "2"] = eqx.field(converter=as_leaf)

    def __call__(self, q, v, t):
        s, c = jnp.sin(q[1][2]), jnp.cos(q[1][2])
        f1, f2 = self.friction.astype(s.dtype)
        # Both friction forces act at radius 1, which gives the torque -f1 - f2.
        disk = jnp.stack([f1 * c - f2, -f1 * s, -f1 - f2])
        # The contact force on the link is opposite to that on the disk; it passes along the link, without torque.
        return disk, jnp.stack([-f1 * c, f1 * s, self.torque.astype(s.dtype)])


def _disk_start(
    place: Number = 0.1,
    turn: Number = 0.0,
    link_place: Number = -0.2,
    tilt: Number = 0.3,
    rates: Row = (0.4, 0.2, -0.1, 0.3),
) -> tuple[Array, Array]:
    return as_state([place, turn, link_place, tilt]), as_state(rates)


@register_scene(_disk_start)
def disk_and_link(
    *,
    masses: Row = (1.0, 0.6),
    moments: Row = (0.5, 0.2),
    torque: Number = 0.0,
    friction: Row = (0.0, 0.0),
    gravity: Number = 9.81,
) -> Scene:
    """Disk of radius 1 m on the ground under a thin tangent link: two bodies coupled by an immersion.

    q = (z1, theta, y1, th2): abscissa of the disk, its angle counter-clockwise, abscissa of the link's centre of mass, the
    link's angle CLOCKWISE from horizontal. `torque` on the link (N m, clockwise); `friction` (f1, f2), N: of the link on
    the disk along t = (cos th2, -sin th2) and of the ground on the disk along -x. The normal forces are gone.

    Source: EQUATIONS section 12 with erratum E57.
    """
    units = tuple(planar_body(m, moment, gravity) for m, moment in zip(masses, moments, strict=True))
    return as_scene(constrain_by_immersion(units, _tangent, 4, force=_Applied(torque, friction)))
