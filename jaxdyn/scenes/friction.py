"""Mechanisms with friction and unilateral contacts: stick, slip, opening and closing."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints import rolling_sphere
from jaxdyn.contact.unilateral import UnilateralContact, gap_contact, ground_contact
from jaxdyn.model.arguments import Number, Row
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.scenes._named import as_leaf, as_state, flat_moments, register_scene
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import MetricSystem

_UP, _DOWN = ((0, 0, 0), (-jnp.pi / 2, 0, 0)), ((0, 0, 0), (jnp.pi / 2, 0, 0))  # z of a plane along y, and against it


def _rough_start(
    speed: Number = 3.0, place: Number = 0.1, link_place: Number = 0.0, tilt: Number = 0.0
) -> tuple[Array, Array]:
    # The link touches the disk of radius 1 from above, tilted clockwise.
    height = 1 + (1 + jnp.sin(tilt) * (place - link_place)) / jnp.cos(tilt)
    # The tilt is clockwise and the model's angle counter-clockwise.
    q = as_leaf([place, 1.0, 0.0, link_place, height, -tilt])
    # Along itself, so that the contact remains closed; velocities are in the link's axes.
    return q, as_leaf([0.0, 0.0, 0.0, speed, 0.0, 0.0])


@register_scene(_rough_start)
def rough_disk_and_link(
    *, masses: Row = (1.0, 0.6), moments: Row = (0.5, 0.2), friction: Row = (0.3, 0.2), gravity: Number = 9.81
) -> Scene:
    """Disk of radius 1 m on the ground under a thin link that lies on it, both contacts with stick-slip friction.

    The bodies of `disk_and_link`, free in their plane: q = (x, y, angle) of the disk and of the link's centre of mass, angles
    counter-clockwise. `masses` (kg), `moments` (kg m^2) of the disk and the link; `friction`: coefficients of the contacts
    "link" (link on disk) and "ground" (disk on ground). The link's centre of mass is not above the contact point, so without
    support it tips: a torque m2 g (x_disk - x_link) about it, clockwise, keeps it level.

    Start: disk at rest at `place`, the link above it with its centre at `link_place` (m), clockwise `tilt` (rad), thrown along
    itself with `speed` (m/s). Level, the link slides on the disk with the deceleration mu1 g.

    Source: EQUATIONS section 12 with erratum E57, with the normal forces of the free equations.
    """
    builder = ModelBuilder("disk and link", gravity=(0.0, -gravity, 0.0))
    for name, mass, moment in zip(("disk", "link"), masses, moments, strict=True):
        # The moments about x and y have no effect in the plane; half of z each is a plate's.
        builder.add_body(name, None, "planar", (mass, (0.0, 0.0, 0.0), flat_moments(moment)))
    on_link = rolling_sphere("disk", None, 1.0, surface=_DOWN, surface_body="link", name="link")
    ground = ground_contact("disk", None, friction[1], radius=1.0, plane=_UP, name="ground")
    return Scene(builder.build(), forces=(UnilateralContact(on_link, friction[0]), ground))


class _Toy(eqx.Module):
    """Affine functions of the coordinates: gaps of the woodpecker, and rows of its sliding velocities."""

    row: Float[Array, "3"]
    constant: Float[Array, ""]

    def __call__(self, q, t):
        return jnp.sum(self.row.astype(q.dtype) * q) + self.constant.astype(q.dtype)


class _Row(eqx.Module):
    row: Float[Array, "3"]

    def __call__(self, q, t):
        return self.row.astype(q.dtype)


def _toy_metric(q, t, p):
    # The mass matrix is constant, as the equations are linear in the angles.
    return p["mass"]


def _toy_potential(q, t, p):
    # The spring acts between the sleeve and the bird, hence the difference of their angles.
    return jnp.sum(p["weight"] * q) + 0.5 * p["stiffness"] * (q[1] - q[2]) ** 2


def _woodpecker_start(
    gap: Number = 0.0006, half_height: Number = 0.0058, bird: Number = -0.2788, velocity: Row = (-0.3411, 0.0, -7.4583)
) -> tuple[Array, Array]:
    # The lower edge touches the pole where the angle uses up the play.
    return as_state([0.0, -gap / half_height, bird]), as_state(velocity)


@register_scene(_woodpecker_start)
def woodpecker(
    *,
    masses: Row = (0.0003, 0.0045),
    moments: Row = (5.0e-9, 7.0e-7),
    stiffness: Number = 0.0056,
    pole_radius: Number = 0.0025,
    sleeve_radius: Number = 0.0031,
    half_height: Number = 0.0058,
    to_spring: Number = 0.010,
    to_bird: Number = 0.015,
    beak: Row = (0.020, 0.0201),
    friction: Number = 0.3,
    restitution: Number = 0.5,
    gravity: Number = 9.81,
) -> Scene:
    """Woodpecker toy: a sleeve with play on a pole, with a bird on a spring, that descends by stick-slip and impacts.

    q = (height of the sleeve, m, its angle and the bird's, rad); equations linear in the angles. Contacts: "beak" on the
    pole, with `restitution`; "lower" and "upper" edge of the sleeve on the pole, without. All have the same `friction`. Where
    an edge sticks, the toy is jammed and the bird swings; it falls while the sleeve is free.

    `masses`, `moments` of sleeve and bird (kg, kg m^2), the latter about the bird's centre of mass; `stiffness` (N m/rad);
    `half_height` of the sleeve, distances `to_spring` from the sleeve's centre and from there `to_bird`; `beak`: its
    height above and its distance from the bird's centre of mass (m).

    Start: on the periodic motion, by its published numbers of four digits: the lower edge touches the pole, the bird's angle
    and the velocities are given. With the parameters above, which have one to three digits, the periodic motion passes
    this angle with -0.33948 m/s and -7.46210 rad/s, 0.5 and 0.05 % from the published ones, after a period of 0.145976 s.
    Perturbed starts return with the opposite sign, smaller by a factor of 0.84. All impacts are of one contact, so that
    Newton's and Poisson's laws of impact give the same; 0.3 % more friction moves these velocities by 1.2 %.

    Source: Glocker (1995), pp. 162; Leine, Glocker & van Campen (2001).
    """
    sleeve, bird = masses
    arms = as_leaf([1.0, to_spring, to_bird])
    # The bird's height depends on all three coordinates, with the lever arms as weights.
    mass = bird * jnp.outer(arms, arms) + jnp.diag(as_leaf([sleeve, moments[0], moments[1]]))
    weight = gravity * (bird * arms + as_leaf([sleeve, 0.0, 0.0]))
    numbers = {"mass": mass, "weight": weight, "stiffness": as_leaf(stiffness)}
    system = MetricSystem(_toy_metric, 3, potential=_toy_potential, parameters=numbers)
    play, reach = sleeve_radius - pole_radius, to_spring + to_bird - beak[1]

    def contact(name, rate, constant, along, e):
        gap = _Toy(as_leaf(rate), as_leaf(constant))
        return gap_contact(gap, _Row(as_leaf(along)), friction, restitution=e, name=name)

    # Sliding velocity of an edge: that of the sleeve's centre and of its turn at the radius.
    edge = (1.0, sleeve_radius, 0.0)
    contacts = (
        contact("beak", (0.0, 0.0, -beak[0]), reach - pole_radius, (1.0, to_spring, to_bird - beak[1]), restitution),
        # The edges touch opposite sides of the pole, hence the opposite signs and one play.
        contact("lower", (0.0, half_height, 0.0), play, edge, 0.0),
        contact("upper", (0.0, -half_height, 0.0), play, edge, 0.0),
    )
    return Scene(system, forces=contacts)
