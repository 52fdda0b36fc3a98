"""Rolling contact of two surfaces: constraint rows at the contact point stored in the configuration (see `rolling_model`)."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.frames import Pair, displace_pose
from jaxdyn.constraints.rolling import Touching, TouchingPoint, check_has_rows, tangents
from jaxdyn.contact.surfaces import Surface, check_surface
from jaxdyn.contact.touching import Patch, Steps, newton_steps, patch_at
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Checked, Numbers, check_body, check_new_name, pose_leaf


class RollingContact(Touching):
    """Rolling contact of two surfaces, built by `jd.contact.rolling_contact`. Body A carries `shape_a`, body B `shape_b`."""

    shape_a: Surface
    shape_b: Surface
    places: tuple[Array, Array] | None = None
    about: tuple[Patch, Patch] | None = None

    @property
    def place_size(self) -> int:
        """Number of dependent coordinates of the contact in q."""
        return self.shape_a.place_size + self.shape_b.place_size

    def with_place(self, place: Float[Array, " n"]) -> "RollingContact":
        """Contact at given places, the coordinates for A before those for B."""
        size = self.shape_a.place_size
        # Stored patches belong to the places before.
        return dataclasses.replace(self, places=(place[:size], place[size:]), about=None)

    def structure_key(self) -> tuple:
        """Key of the rows and the kinds of surfaces."""
        return self.contact, self.spin, self.count, jax.tree.structure((self.shape_a, self.shape_b))

    def touching(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> TouchingPoint:
        """Closest points, by one step of Newton's method from the stored places."""
        a, b = self.patches()
        steps = newton_steps(a, b, R, p)
        point = matmul(R, b.at(steps.on_b)) + p
        # For touching surfaces, the gap along the normal of the place has the first and second derivatives of the true gap.
        gap = jnp.sum(a.normal * (point - a.at(steps.on_a)))
        normal = a.normal_at(steps.on_a)
        # A contact that slips has a count of 0, and no tangents.
        return TouchingPoint(point, normal, gap, tangents(normal)[: self.count])

    def patches(self) -> tuple[Patch, Patch]:
        """Second-order patches of both surfaces about their places."""
        if self.about is not None:
            return self.about
        place_a, place_b = self.current_places()
        return patch_at(self.shape_a, place_a), patch_at(self.shape_b, place_b)

    def with_patches(self) -> "RollingContact":
        """Contact with its patches computed and stored."""
        return dataclasses.replace(self, about=self.patches())

    def steps(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Steps:
        """Newton steps on both surfaces towards the closest points."""
        return newton_steps(*self.patches(), R, p)

    def track(self, R: Float[Array, "3 3"], p: Float[Array, "3"], count: int) -> Float[Array, " n"]:
        """Places after `count` steps of Newton's method."""
        contact = self
        for _ in range(count):
            steps = contact.steps(R, p)
            contact = contact.with_place(contact.step_place(steps.on_a, steps.on_b))
        return jnp.concatenate(contact.current_places())

    def step_place(self, on_a: Float[Array, "2"], on_b: Float[Array, "2"]) -> Float[Array, " n"]:
        """Places displaced by steps on both surfaces."""
        place_a, place_b = self.current_places()
        return jnp.concatenate([self.shape_a.displace(place_a, on_a), self.shape_b.displace(place_b, on_b)])

    def place_rate(self, R: Float[Array, "3 3"], p: Float[Array, "3"], U: Float[Array, "6"]) -> Float[Array, " n"]:
        """Rate of the places for a twist U of B relative to A."""
        patches = self.patches()

        def along(twist):
            steps = newton_steps(*patches, *displace_pose(R, p, twist))
            return steps.on_a, steps.on_b

        # The rate of a converged Newton step is that of the implicit function theorem: Montana's forward equations.
        on, rate = jax.jvp(along, (jnp.zeros_like(U),), (U,))
        return jax.jvp(self.step_place, on, rate)[1]

    def coordinates(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Float[Array, "5"]:
        """Contact coordinates (u_a, v_a, u_b, v_b, psi) of the places in the charts of the surfaces."""
        from_charts = []
        for shape, place in zip((self.shape_a, self.shape_b), self.current_places(), strict=True):
            alpha = shape.coordinates_at(place)
            along = jax.jacfwd(shape.point)(alpha)[:, 0]
            from_charts.append((alpha, along / jnp.sqrt(jnp.sum(along * along))))
        (alpha_a, x_a), (alpha_b, x_b) = from_charts
        normal, seen = self.patches()[0].normal, matmul(R, x_b)
        # R_psi = [cos psi, -sin psi; -sin psi, -cos psi], its first column x_b in the axes x, y of A.
        y_a = cross(normal, x_a)
        psi = jnp.arctan2(-jnp.sum(seen * y_a), jnp.sum(seen * x_a))
        return jnp.concatenate([alpha_a, alpha_b, psi[None]])

    def current_places(self) -> tuple[Array, Array]:
        """Places on A and on B. **Raises:** ValueError for a contact without places."""
        if self.places is None:
            raise ValueError(
                f"rolling contact {self.name!r} is not part of a system with its places; pass it to "
                "jd.contact.RollingModel(model, [contact]) and use the constraints of that"
            )
        return self.places


class Rolling(Pair):
    """Constraint rows of one contact of a `RollingModel`; see `RollingModel.rows`."""

    name: str = eqx.field(static=True)
    index: int = eqx.field(static=True)
    body: str | None = eqx.field(static=True)
    surface_body: str | None = eqx.field(static=True)
    contact: bool = eqx.field(static=True)
    spin: bool = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def at(self, system: Any, q: Float[Array, " nq"]) -> "RollingContact":
        """Contact at its places in q."""
        contact = self._of(system)
        return contact.with_place(q[system.place_slices[self.index]]).with_patches()

    def resolve(self, system):
        """Contact of the system."""
        return self._of(system)

    def sizes(self, system, dtype):
        """Numbers of rows of the contact."""
        return self._of(system).sizes(system, dtype)

    def wrench_components(self):
        """Order of the contact's multipliers: friction forces, normal force, torque of spin."""
        return Touching.wrench_components(self)  # pyright: ignore[reportArgumentType]

    def _of(self, system) -> RollingContact:
        # Surfaces are leaves of the system and not of these rows, so that they exist once.
        contacts = getattr(system, "contacts", ())
        if not self.index < len(contacts) or contacts[self.index].name != self.name:
            raise ValueError(
                f"rolling contact {self.name!r} is not in the system; use the rows of the simulated RollingModel"
            )
        return contacts[self.index]


def rolling_contact(
    body_a: str | None,
    surface_a: Checked[Surface],
    body_b: str | None,
    surface_b: Checked[Surface],
    *,
    pose_a: Numbers | None = None,
    pose_b: Numbers | None = None,
    spin: bool = False,
    slip: bool = False,
    contact: bool = True,
    name: str | None = None,
) -> RollingContact:
    """Rolling contact of two smooth surfaces that touch in one point, for a `RollingModel`.

    Rows: the gap (a positive multiplier presses B off A), the two slips, and with `spin` the rotation about the normal.

    **Arguments:**

    - `body_a`, `body_b`: bodies or frames that carry the surfaces; None for the world.
    - `surface_a`, `surface_b`: `jd.contact.Sphere`, `Plane`, `Cylinder`, `Ellipsoid`, or `Parametrised` for any other smooth
      surface, whose chart must cover all contact points; outward normals as defined by the surfaces. One may be concave, as
      long as the relative curvature is positive.
    - `pose_a`, `pose_b`: of the surface's frame in its body: None, (4, 4), (3,) or (xyz, rpy).
    - `spin`: whether the contact resists spinning about the normal too, as a soft finger. `slip`: whether it slides without
      friction. `contact`: whether the gap is a row.
    - `name`: for errors and reports.

    **Raises:** ValueError for an invalid surface, a bad pose, or no rows at all; when used, for unknown bodies.

    Source: Montana (1988); Murray, Li & Sastry (1994), section 5.6; EQUATIONS section 8.
    """
    name = check_new_name(name, f"{body_b or 'world'} on {body_a or 'world'}")
    for surface in (surface_a, surface_b):
        check_surface(surface)
    check_has_rows(name, slip, spin, contact)
    return RollingContact(
        name=name,
        body=check_body(body_b, f"{name!r}: body_b"),
        surface_body=check_body(body_a, f"{name!r}: body_a"),
        pose=pose_leaf(pose_b, f"{name!r}: pose_b"),
        surface=pose_leaf(pose_a, f"{name!r}: pose_a"),
        shape_a=surface_a,
        shape_b=surface_b,
        contact=contact,
        spin=spin,
        count=0 if slip else 2,
    )
