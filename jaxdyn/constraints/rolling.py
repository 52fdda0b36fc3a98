"""Wheels, spheres and blades that roll or slide on surfaces.

The point of contact is a function of the configuration, and the velocity of the material points in contact is linear in v.

A contact at the point x with normal n (from the surface to the body) has up to three kinds of rows:

    height   gap(q) = 0                      holonomic; left out by contact=False
    no slip  e . (v_body(x) - v_surface(x))  for the tangential directions e without slip
    no spin  n . (w_body - w_surface)        only where the contact resists spinning

The multipliers are then the normal force, the friction forces along e (N), and the friction torque about n (N m), on
the body. Source: Murray, Li & Sastry (1994), chapters 5.6 and 6.1.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.loops import check_bodies
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import (
    DType,
    Numbers,
    SystemLike,
    as_number,
    check_body,
    check_flag,
    check_name,
    check_new_name,
)
from jaxdyn.model.host_math import pose_leaf


class TouchingPoint(NamedTuple):
    """A contact in the surface's frame: point (3,), normal (3,), gap (), tangential directions without slip (n, 3)."""

    point: Array
    normal: Array
    gap: Array
    directions: Array


class Touching(Pair):
    """A body in contact with a surface. Subclasses give the contact point and the directions without slip."""

    name: str = eqx.field(static=True)
    body: str | None = eqx.field(static=True)
    surface_body: str | None = eqx.field(static=True)
    pose: Float[Array, "4 4"]
    surface: Float[Array, "4 4"]
    contact: bool = eqx.field(static=True, kw_only=True)
    spin: bool = eqx.field(static=True, default=False, kw_only=True)
    # Directions without slip, of those that `touching` gives.
    count: int = eqx.field(static=True, default=2, kw_only=True)

    def ends(self) -> tuple[tuple[str | None, Array], tuple[str | None, Array]]:
        """Frame A on the surface, frame B on the body."""
        return (self.surface_body, self.surface), (self.body, self.pose)

    def touching(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> TouchingPoint:
        """The contact for the pose of the body's frame seen from the surface's."""
        raise NotImplementedError

    def contact_point(
        self, R: Float[Array, "3 3"], p: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Point of contact (m) and normal from the surface to the body, (3,) each, in frame A; `R`, `p` as in `wrench`."""
        touch = self.touching(R, p)
        return touch.point, touch.normal

    def sizes(self, system: SystemLike, dtype: DType) -> tuple[int, int]:
        """One row for the height, and the rows of slip and spin."""
        check_bodies(self.name, system, (self.body, self.surface_body))
        return int(self.contact), self.count + int(self.spin)

    def wrench_components(self) -> tuple[int, ...] | None:
        """Indices of the friction forces, the normal force, and the torque of spin."""
        if not self.contact:
            return None
        # Multipliers have the normal force first (holonomic rows come first), the wrench basis has it after the friction forces.
        return (*range(1, 1 + self.count), 0, *((1 + self.count,) if self.spin else ()))

    def structure_key(self) -> tuple:
        """Kinds and number of the rows."""
        return self.contact, self.spin, self.count

    def pose_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Float[Array, " nh"] | None:
        """Gap between body and surface, (1,), m; None when the height is not constrained."""
        return self.touching(R, p).gap[None] if self.contact else None

    def twist_residual(
        self, R: Float[Array, "3 3"], p: Float[Array, "3"], U: Float[Array, "6"]
    ) -> Float[Array, " np"] | None:
        """Velocities of slipping (m/s), and of spinning (rad/s) where it is resisted."""
        touch = self.touching(R, p)
        if not self.count:
            return jnp.sum(touch.normal * U[3:])[None] if self.spin else None
        # U is the twist at the origin of A: the material point of the body at the contact moves with v + w x point.
        slip = matmul(touch.directions, U[:3] + cross(U[3:], touch.point))
        return jnp.concatenate([slip, jnp.sum(touch.normal * U[3:])[None]]) if self.spin else slip


def _unit(i, like):
    return jnp.asarray([float(i == k) for k in range(3)], like.dtype)


def unit_or(vector, fallback):
    """The unit vector along `vector`, or `fallback` (a constant) where it vanishes; no NaN in derivatives."""
    square = jnp.sum(vector * vector)
    # The input of the root is made safe, not only its output: the derivative of the branch that is not taken is evaluated too.
    safe = square > float(jnp.finfo(vector.dtype).eps) ** 2
    length = jnp.sqrt(jnp.where(safe, square, jnp.ones_like(square)))
    return jnp.where(safe, vector / length, fallback)


def tangents(normal):
    """Two unit vectors (2, 3) that make a right-handed frame with the normal; smooth except for a jump at normal z = 0.

    At the jump the two rows turn within the plane that they span, so that accelerations are continuous.

    Source: Duff et al. (2017), listing 3.
    """
    x, y, z = jnp.unstack(normal)
    sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
    a = -1.0 / (sign + z)
    b = x * y * a
    one = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    return jnp.stack([one, jnp.stack([b, sign + y * y * a, -y])])


class RollingWheel(Touching):
    """A wheel or disk that rolls on a plane; made by `jd.rolling_wheel`."""

    radius: Float[Array, ""]

    def touching(self, R, p):
        axis, normal = R[:, 2], _unit(2, p)
        # Down in the wheel's plane. A wheel that lies flat has no lowest point, and any direction is right.
        down = unit_or(axis[2] * axis - normal, -R[:, 0])
        point = p + self.radius.astype(p.dtype) * down
        # Along the track, whatever the lean: perpendicular to the axle, and horizontal.
        forward = unit_or(cross(axis, normal), R[:, 1])
        directions = jnp.stack([forward, cross(normal, forward)])[: self.count]
        return TouchingPoint(point, normal, point[2], directions)


def rolling_wheel(
    body: str,
    pose: Numbers | None,
    radius: Numbers,
    *,
    plane: Numbers | None = None,
    plane_body: str | None = None,
    contact: bool = True,
    lateral: bool = True,
    name: str | None = None,
) -> RollingWheel:
    """A wheel or thin disk that rolls on a plane without slipping, upright or leaning.

    Rows: the height of the rim's lowest point (unless `contact=False`, for models whose joints keep the height), its
    velocity along the wheel's track, and its velocity across.

    **Arguments:**

    - `body`: body or frame that carries the wheel; `pose`: of the wheel's centre in it, z along the axle: None, (4, 4),
      (3,) or (xyz, rpy).
    - `radius`: m, to the sharp rim.
    - `plane`: pose of the ground in `plane_body` (None: the world), its z the normal; by default the world's x-y plane.
    - `contact`: whether the height is constrained. `lateral`: whether sliding across is; on an axle with two wheels one
      of the two lateral rows is enough.

    **Raises:** ValueError for a radius that is not positive or a bad pose; when used, for unknown bodies.
    """
    name = check_new_name(name, f"wheel {body}")
    return RollingWheel(
        name=name,
        body=check_name(body, f"{name!r}: body"),
        surface_body=check_body(plane_body, f"{name!r}: plane_body"),
        pose=pose_leaf(pose, f"{name!r}: pose"),
        surface=pose_leaf(plane, f"{name!r}: plane"),
        radius=as_number(radius, f"{name!r}: radius", "m"),
        contact=check_flag(contact, f"{name!r}: contact"),
        count=2 if check_flag(lateral, f"{name!r}: lateral") else 1,
    )


class KnifeEdge(Touching):
    """A blade that slides along its own axis on a plane; made by `jd.constraints.knife_edge`."""

    def touching(self, R, p):
        normal = _unit(2, p)
        return TouchingPoint(p, normal, p[2], unit_or(cross(normal, R[:, 0]), R[:, 1])[None])


def knife_edge(
    body: str,
    pose: Numbers | None = None,
    *,
    plane: Numbers | None = None,
    plane_body: str | None = None,
    contact: bool = True,
    name: str | None = None,
) -> KnifeEdge:
    """A blade (skate, sharp wheel without inertia) that slides along its x axis and not across.

    **Arguments:** `body`: body or frame; `pose`: of the contact point in it, x along the blade; `plane`, `plane_body`,
    `contact` as in `rolling_wheel`.

    **Raises:** ValueError for a bad pose; when used, for unknown bodies.
    """
    name = check_new_name(name, f"knife edge {body}")
    return KnifeEdge(
        name=name,
        body=check_name(body, f"{name!r}: body"),
        surface_body=check_body(plane_body, f"{name!r}: plane_body"),
        pose=pose_leaf(pose, f"{name!r}: pose"),
        surface=pose_leaf(plane, f"{name!r}: plane"),
        contact=check_flag(contact, f"{name!r}: contact"),
        count=1,
    )


class RollingSphere(Touching):
    """A sphere that rolls on a plane, a sphere or a cylinder; made by `jd.rolling_sphere`."""

    radius: Float[Array, ""]
    surface_radius: Float[Array, ""] | None = None
    on: str = eqx.field(static=True, default="plane")
    inside: bool = eqx.field(static=True, default=False)

    def structure_key(self):
        """Kinds of the rows and of the surface."""
        return self.on, self.inside, self.contact, self.spin

    def touching(self, R, p):
        radius = self.radius.astype(p.dtype)
        if self.on == "plane":
            normal, gap = _unit(2, p), p[2] - radius
            directions = jnp.eye(2, 3, dtype=p.dtype)
        else:
            assert self.surface_radius is not None
            reach = self.surface_radius.astype(p.dtype)
            # From the centre of a sphere, from the axis of a cylinder.
            away = p if self.on == "sphere" else p * jnp.asarray([1.0, 1.0, 0.0], p.dtype)
            outward = unit_or(away, _unit(0, p))
            distance = jnp.sum(outward * away)
            gap = reach - distance - radius if self.inside else distance - reach - radius
            normal = -outward if self.inside else outward
            # Any two tangents: neither slips. On a plane they are constant, which saves their derivatives.
            directions = tangents(normal)
        return TouchingPoint(p - radius * normal, normal, gap, directions[: self.count])


def rolling_sphere(
    body: str,
    center: Numbers | None,
    radius: Numbers,
    *,
    on: str = "plane",
    surface: Numbers | None = None,
    surface_body: str | None = None,
    surface_radius: Numbers | None = None,
    inside: bool = False,
    slip: bool = False,
    spin: bool = False,
    contact: bool = True,
    name: str | None = None,
) -> RollingSphere:
    """A sphere that rolls without slipping on a plane, or on the outside or inside of a sphere or a cylinder.

    With `slip=True` it slides without friction instead.

    **Arguments:**

    - `body`: body or frame that carries the sphere; `center` (3,) in it (None: its origin), m; `radius`, m.
    - `on`: "plane", "sphere" or "cylinder". `surface`: pose of the surface in `surface_body` (None: the world): a
      plane's z is its normal, a sphere's origin its centre, a cylinder's z its axis. `surface_radius`: m, of these two.
    - `inside`: whether the sphere rolls on the inner side.
    - `slip`: whether the sphere may slide; the height is then the only row, or the height and the spin.
    - `spin`: whether the contact also resists spinning about the normal (a soft contact).
    - `contact`: whether the height is constrained.

    **Raises:** ValueError for an unknown surface, radii that are missing, not positive or too small for one
    inside, a bad pose, or no rows at all; when used, for unknown bodies.
    """
    name = check_new_name(name, f"sphere {body}")
    if on not in ("plane", "sphere", "cylinder"):
        raise ValueError(f"{name!r}: on is {on!r}; choose from plane, sphere, cylinder")
    if (on == "plane") != (surface_radius is None):
        fix = "leave it out" if on == "plane" else "give the radius of the surface (m)"
        raise ValueError(f"{name!r}: surface_radius is {surface_radius} on a {on}; {fix}")
    if check_flag(inside, f"{name!r}: inside") and on == "plane":
        raise ValueError(f"{name!r}: a plane has no inside; turn the plane over")
    check_has_rows(name, slip, spin, contact)
    radius = as_number(radius, f"{name!r}: radius", "m")
    reach = None if surface_radius is None else as_number(surface_radius, f"{name!r}: surface_radius", "m")
    concrete = reach is not None and is_concrete(radius - reach)
    if inside and concrete and reach is not None and not radius < reach:
        raise ValueError(f"{name!r}: radius {radius} is not below surface_radius {reach}; it does not fit inside")
    return RollingSphere(
        name=name,
        body=check_name(body, f"{name!r}: body"),
        surface_body=check_body(surface_body, f"{name!r}: surface_body"),
        pose=pose_leaf(center, f"{name!r}: center"),
        surface=pose_leaf(surface, f"{name!r}: surface"),
        radius=radius,
        surface_radius=reach,
        on=on,
        inside=inside,
        contact=contact,
        spin=spin,
        count=0 if slip else 2,
    )


def check_has_rows(name: str, slip: bool, spin: bool, contact: bool) -> None:
    """Refuse a contact that constrains nothing. **Raises:** ValueError, for values that are not True or False too."""
    for what, value in {"slip": slip, "spin": spin, "contact": contact}.items():
        check_flag(value, f"{name!r}: {what}")
    if slip and not (spin or contact):
        raise ValueError(
            f"{name!r}: slip is True and contact and spin are False, which leaves no rows; set contact=True"
        )
