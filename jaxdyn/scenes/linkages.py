"""Planar linkages of bodies, with loops closed by revolute joints; a double pendulum in four formulations."""

import itertools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints import loop
from jaxdyn.geometry.immersion import constrain_by_immersion
from jaxdyn.model.arguments import Checked, Number, Numbers, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import MetricSystem

_DOWN = (0.0, -9.81, 0.0)


def thin_bar(mass, length):
    """Inertia of a uniform thin bar along x from its end: mass, centre and moments about it."""
    moment = mass * length**2 / 12
    return mass, (length / 2, 0.0, 0.0), (0.0, moment, moment)


def intersect_circles(center, radius, other, reach):
    """Intersection of two circles to the left of the line from the first centre to the second."""
    xp = array_namespace(center, radius, other, reach)
    center, other = xp.asarray(center, float), xp.asarray(other, float)
    direction = other - center
    distance = xp.sqrt(direction @ direction)
    # Distance from the first centre to the common chord.
    along = (radius**2 - reach**2 + distance**2) / (2 * distance)
    square = radius**2 - along**2
    if is_concrete(square) and square < 0:
        raise ValueError(f"lengths {radius} and {reach} do not close over {distance:.6g}; no such configuration exists")
    direction = direction / distance
    # Traced lengths that cannot close give the closest configuration, with a constraint residual.
    height = xp.sqrt(square) if xp is np else jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return center + along * direction + height * xp.stack([-direction[1], direction[0]])


def end_velocity(length, angle):
    """Velocity (2,) of the end of a link at one radian per second."""
    xp = array_namespace(length, angle)
    return length * xp.stack([-xp.sin(angle), xp.cos(angle)])


def solve_planar(one, other, right):
    """Solve x one + y other = right in the plane by Cramer's rule."""
    # Written out: a solver of 2 x 2 systems under JAX would be a call of LAPACK.
    determinant = one[0] * other[1] - one[1] * other[0]
    return (right[0] * other[1] - right[1] * other[0]) / determinant, (
        one[0] * right[1] - one[1] * right[0]
    ) / determinant


def two_link_leg(base, length, end, velocity, elbow: Number = 1):
    """Angles of a leg of two links of one length, the second relative to the first, and their rates for a velocity of its end.

    The `elbow` is to the left of the line from the base to the end for +1, to the right for -1.
    """
    xp = array_namespace(base, length, end, velocity)
    base, end = xp.asarray(base, float), xp.asarray(end, float)
    # Exchanged circles give the solution on the other side.
    knee = intersect_circles(*(base, length, end, length) if elbow > 0 else (end, length, base, length))
    first, second = (xp.arctan2(*vector[::-1]) for vector in (knee - base, end - knee))
    # Velocities of both links add up to that of the end.
    rates = solve_planar(end_velocity(length, first), end_velocity(length, second), velocity)
    return [first, second - first], [rates[0], rates[1] - rates[0]]


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


def _four_bar_start(
    lengths: Row = (1.0, 3.0, 2.5, 3.5), angle: Number = 1.0, rate: Number = 1.0, in_plane: bool = True
) -> tuple[Array, Array]:
    crank, coupler, rocker, ground = lengths
    xp = array_namespace(lengths, angle, rate)
    a = crank * xp.stack([xp.cos(angle), xp.sin(angle)])
    b = intersect_circles(a, coupler, (ground, 0.0), rocker)
    coupling, rocking = xp.arctan2(*(b - a)[::-1]), xp.arctan2(b[1], b[0] - ground)
    # Velocities of B on the coupler and on the rocker agree.
    first, second = solve_planar(
        end_velocity(coupler, coupling), -end_velocity(rocker, rocking), -rate * end_velocity(crank, angle)
    )
    return as_state([angle, coupling - angle, rocking]), as_state([rate, first - rate, second])


@register_scene(_four_bar_start)
def four_bar(
    *,
    lengths: Row = (1.0, 3.0, 2.5, 3.5),
    masses: Row = (1.0, 3.0, 2.5),
    gravity: Numbers | None = _DOWN,
    in_plane: bool = True,
) -> Scene:
    """Four-bar linkage in the x-y plane: crank and coupler as a chain, rocker on the ground, closed by a joint.

    q = (crank angle, coupler angle relative to the crank, rocker angle). `lengths`: crank, coupler, rocker, ground (m);
    uniform bars with `masses` (kg). With `in_plane=False` the joint has all five rows of a revolute joint in space,
    three of which depend on the others. Start: the crank's `angle` (rad) and `rate` (rad/s), assembled to the left.
    """
    crank, coupler, rocker, ground = lengths
    builder = ModelBuilder("four-bar", gravity=gravity)
    builder.add_body("crank", None, "continuous", thin_bar(masses[0], crank), joint_name="1")
    builder.add_body(
        "coupler", "crank", "continuous", thin_bar(masses[1], coupler), joint_name="2", pose=(crank, 0.0, 0.0)
    )
    builder.add_body("rocker", None, "continuous", thin_bar(masses[2], rocker), joint_name="3", pose=(ground, 0.0, 0.0))
    closing = loop("coupler", (coupler, 0.0, 0.0), "rocker", (rocker, 0.0, 0.0), in_plane=in_plane, name="knee")
    return Scene(builder.build(), (closing,))


def _slider_crank_start(
    crank: Number = 1.0, rod: Number = 2.5, angle: Number = 1.0, rate: Number = 1.0
) -> tuple[Array, Array]:
    xp = array_namespace(crank, rod, angle, rate)
    # The rod's end is on the x axis: its height cancels that of the crank.
    lean = -xp.arcsin(crank * xp.sin(angle) / rod)
    leaning = -crank * xp.cos(angle) * rate / (rod * xp.cos(lean))
    place = crank * xp.cos(angle) + rod * xp.cos(lean)
    sliding = -crank * xp.sin(angle) * rate - rod * xp.sin(lean) * leaning
    return as_state([angle, lean - angle, place]), as_state([rate, leaning - rate, sliding])


@register_scene(_slider_crank_start)
def slider_crank(
    *, crank: Number = 1.0, rod: Number = 2.5, masses: Row = (1.0, 2.0, 1.5), gravity: Numbers | None = _DOWN
) -> Scene:
    """Slider-crank in the x-y plane: crank and rod as a chain, the slider on the x axis, closed by a revolute joint.

    q = (crank angle, rod angle relative to the crank, slider's x). `masses` (kg) of crank, rod and slider.
    """
    builder = ModelBuilder("slider-crank", gravity=gravity)
    builder.add_body("crank", None, "continuous", thin_bar(masses[0], crank), joint_name="1")
    builder.add_body("rod", "crank", "continuous", thin_bar(masses[1], rod), joint_name="2", pose=(crank, 0.0, 0.0))
    # A slider does not turn, so its moments have no effect.
    slider = (masses[2], (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    builder.add_body("slider", None, "prismatic", slider, joint_name="3", axis=(1.0, 0.0, 0.0))
    closing = loop("rod", (rod, 0.0, 0.0), "slider", None, in_plane=True, name="pin")
    return Scene(builder.build(), (closing,))


def _names(count: int) -> tuple[list[str], list[str]]:
    # Leading zeros keep the order of names that of the numbers, as models sort joints by name.
    width = len(str(count))
    uprights = [f"upright{i:0{width}d}" for i in range(count + 1)]
    return uprights, [f"coupler{i:0{width}d}" for i in range(count)]


def _windows_start(count: Checked[int] = 2, rate: Number = 1.0) -> tuple[Array, Array]:
    # Depth-first: each upright but the last is followed by its coupler, which translates.
    v = [sign * rate for _ in range(count) for sign in (-1.0, 1.0)] + [-rate]
    return as_state(np.zeros(2 * count + 1)), as_state(v)


@register_scene(_windows_start)
def windows(
    *, count: Checked[int] = 2, mass: Number = 1.0, length: Number = 1.0, gravity: Numbers | None = _DOWN
) -> Scene:
    """N four-bar windows in a row (problem A02 of the IFToMM benchmark library), N = `count`.

    N + 1 uprights on the ground at x = 0, 1 .. N lengths, N couplers between their tops, all uniform bars of one `mass`
    and `length`, in the x-y plane. All angles are zero at the start, uprights pointing up; top 0 moves at +`rate` m/s
    per m of length. Where the uprights are horizontal the rows lose rank and the mechanism has N more degrees of freedom.
    """
    uprights, couplers = _names(count)
    moment = mass * length**2 / 12
    # Uprights are along y at zero, bars of `thin_bar` along x.
    up = (mass, (0.0, length / 2, 0.0), (moment, 0.0, moment))
    builder = ModelBuilder(f"{count} windows", gravity=gravity)
    for i, name in enumerate(uprights):
        builder.add_body(name, None, "continuous", up, pose=(i * length, 0.0, 0.0))
    for i, name in enumerate(couplers):
        builder.add_body(name, uprights[i], "continuous", thin_bar(mass, length), pose=(0.0, length, 0.0))
    top = (0.0, length, 0.0)
    closing = [
        loop(name, (length, 0.0, 0.0), uprights[i + 1], top, in_plane=True, name=f"window {i + 1}")
        for i, name in enumerate(couplers)
    ]
    return Scene(builder.build(), closing)


_BASES = ((0.0, 1.2), (-1.04, -0.6), (1.04, -0.6))


def _parallel_start(
    point: Row = (0.1, 0.05),
    velocity: Row = (0.3, -0.2),
    length: Number = 1.0,
    bases: Row = _BASES,
    elbows: Row = (1, 1, 1),
) -> tuple[Array, Array]:
    legs = [two_link_leg(base, length, point, velocity, elbow) for base, elbow in zip(bases, elbows, strict=True)]
    q, v = (list(itertools.chain(*numbers)) for numbers in zip(*legs, strict=True))
    return as_state(q), as_state(v)


@register_scene(_parallel_start)
def parallel_manipulator(
    *, length: Number = 1.0, bases: Row = _BASES, mass: Number = 1.0, gravity: Numbers | None = None
) -> Scene:
    """Parallel manipulator: three planar legs of two links with a common end point, q = (a1, a2, b1, b2, c1, c2).

    All links are uniform bars of one `length` (m) and `mass` (kg); the legs turn about the `bases` (3 points, m), the
    second angle of each is relative to the first. With motors on all six joints, or on the three at the bases, it has
    more motors than its two degrees of freedom: torques in the null space of the motors change only internal forces.

    Start: the carried `point` (m) and its `velocity` (m/s); `elbows` +1 to the left of the way from base to point.

    Source: EQUATIONS section 8.
    """
    builder = ModelBuilder("parallel manipulator", gravity=gravity)
    for leg, (x, y) in zip("abc", bases, strict=True):
        builder.add_body(f"{leg}1", None, "continuous", thin_bar(mass, length), joint_name=f"{leg}1", pose=(x, y, 0.0))
        upper = {"joint_name": f"{leg}2", "pose": (length, 0.0, 0.0)}
        builder.add_body(f"{leg}2", f"{leg}1", "continuous", thin_bar(mass, length), **upper)
    tip = (length, 0.0, 0.0)
    # Two loops tie three legs; a third one would repeat their rows.
    return Scene(builder.build(), [loop("a2", tip, leg, tip, "point", in_plane=True) for leg in ("b2", "c2")])


def _ring_start(count: Checked[int] = 6, length: Number = 1.0, rate: Number = 1.0) -> tuple[Array, Array]:
    middle = length / 2, length / 2 / np.tan(np.pi / count)
    # Each bar of a regular polygon turns by the same angle from the one before.
    q = [-middle[0], -middle[1], 0.0, *[2 * np.pi / count] * (count - 1)]
    return as_state(q), as_state([rate * middle[1], -rate * middle[0], rate, *[0.0] * (count - 1)])


@register_scene(_ring_start)
def closed_ring(
    *, count: Checked[int] = 6, mass: Number = 1.0, length: Number = 1.0, gravity: Numbers | None = None
) -> Scene:
    """Ring of `count` equal uniform bars joined end to end, free in the x-y plane: `count` degrees of freedom.

    q = (x, y, angle of the first bar, angles of the others relative to the one before). Bars of one `mass` (kg) and
    `length` (m). Start: a regular polygon about the world's origin that rotates at constant `rate` (rad/s):
    the joints then carry mass (length/4) cot(pi/count)/sin(pi/count) rate^2.
    """
    names = [f"bar{i:0{len(str(count))}d}" for i in range(count)]
    builder = ModelBuilder(f"ring of {count}", gravity=gravity)
    # The first bar floats in the plane; a fixed base would take away three degrees of freedom.
    builder.add_body(names[0], None, "planar", thin_bar(mass, length))
    for before, name in itertools.pairwise(names):
        builder.add_body(name, before, "continuous", thin_bar(mass, length), pose=(length, 0.0, 0.0))
    return Scene(builder.build(), (loop(names[-1], (length, 0.0, 0.0), names[0], None, in_plane=True, name="ring"),))
