"""Rolling contact of two surfaces: constraint rows at a contact point that is a dependent coordinate of the configuration.

A `RollingModel` is a `Model` whose q appends the places of its contacts on both surfaces to the joints' coordinates.
They have no inertia and no velocities: the closest points are a function of the joints'
coordinates, and the places select its branch. Their rates follow from Montana's equations, for any velocity; steps and
projections update them by Newton's method. So v, M, h and tau are those of the model.

Source: Montana (1988); Murray, Li & Sastry (1994), section 5.6; EQUATIONS section 8.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.compile import kernel
from jaxdyn.compile.known import is_known
from jaxdyn.constraints.frames import Pair, displace_pose, each, relative_motions, relative_poses
from jaxdyn.constraints.loops import check_bodies
from jaxdyn.constraints.rolling import Touching, TouchingPoint, check_has_rows, tangents
from jaxdyn.contact.contact_equations import Patch, Steps, newton_steps, patch_at
from jaxdyn.contact.surfaces import Surface, check_surface
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Checked, Number, Numbers, as_array, check_body, check_new_name, check_shapes
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.model.tree import Model


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


# --- models with rolling contacts: contact points are dependent coordinates of the configuration ---


# Newton steps after a step of the integration; the second one makes the first derivatives exact.
_STEPS_MOVED = 2
# Newton steps of the initial search, and alternating projections between the surfaces for its start.
_STEPS_SEARCHED, _TURNS = 30, 8


class RollingModel(Model):
    """Model with rolling contacts: q = (joints' coordinates, places of the contacts), v of the model.

    **Arguments:** `model`: a `Model`; `contacts`: a list of `jd.contact.rolling_contact(...)`.

    Places are coordinates without chart singularities: a unit vector (3) on a sphere or an ellipsoid, (u, v) on a plane, a
    cylinder and a `Parametrised` surface. `place` computes them, `contact_coordinates` converts them to the surfaces'
    charts. Functions of a `Model` accept it; `jd.neutral` and `jd.random_configuration` give only the joints' coordinates.

    **Raises:** ValueError for an invalid model or list of rolling contacts, equal names and unknown bodies.

    ```python
    tip, ball = jd.contact.Sphere(0.02), jd.contact.Ellipsoid([0.1, 0.1, 0.12])
    system = jd.contact.RollingModel(model, [jd.contact.rolling_contact("tip", tip, "ball", ball)])
    scene = jd.Scene(system, system.rows)
    q0 = system.place(joints)
    ```
    """

    contacts: tuple[RollingContact, ...] = ()

    def __init__(self, model: Checked[Model], contacts: Sequence = ()):
        if not isinstance(model, Model) or isinstance(model, RollingModel):
            raise ValueError(f"model is a {type(model).__name__}; pass a Model, the bodies that carry the surfaces")
        if not isinstance(contacts, (tuple, list)) or not all(isinstance(one, RollingContact) for one in contacts):
            raise ValueError(f"contacts is {contacts!r}; pass a list of jd.contact.rolling_contact(...)")
        names = [one.name for one in contacts]
        if len(set(names)) < len(names):
            raise ValueError(f"contacts have the names {names}; give each its own (name=)")
        for one in contacts:
            check_bodies(one.name, model, (one.body, one.surface_body))
        super().__init__(**{field.name: getattr(model, field.name) for field in dataclasses.fields(Model)})
        self.contacts = tuple(contacts)

    def replace(self, **leaves: PyTree) -> "RollingModel":
        """Copy with some leaves of the model replaced, and the same contacts."""
        return RollingModel(super().replace(**leaves), self.contacts)

    @property
    def nq(self) -> int:
        """Number of configuration coordinates, places included."""
        return self.topology.nq + sum(contact.place_size for contact in self.contacts)

    @property
    def place_slices(self) -> tuple[slice, ...]:
        """Slice of the places of each contact in q."""
        ends = np.cumsum([self.topology.nq] + [contact.place_size for contact in self.contacts]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @property
    def rows(self) -> tuple[Rolling, ...]:
        """Constraints of the contacts, for a `Scene` or a `Grasp` with this model."""
        fields = "name", "body", "surface_body", "contact", "spin", "count"
        return tuple(
            Rolling(index=i, **{field: getattr(one, field) for field in fields}) for i, one in enumerate(self.contacts)
        )

    def contacts_at(self, q: Float[Array, " nq"]) -> tuple[RollingContact, ...]:
        """Contacts at their places in q."""
        return tuple(one.with_place(q[at]) for one, at in zip(self.contacts, self.place_slices, strict=True))

    def place(self, joints: Numbers, near: Numbers | None = None) -> Float[Array, " nq"]:
        """Configuration q (nq,) for the joints' coordinates, with the closest points of the surfaces as places.

        **Arguments:**

        - `joints` (model nq,): as of the model. The surfaces need not touch: `jd.assemble` closes the gaps.
        - `near`: initial contact coordinates of the search, a row (u_a, v_a, u_b, v_b) for each contact, in the charts of its
          surfaces (a fifth number, psi, is not read). By default from the relative positions of the bodies' frames,
          which does not work for a `Parametrised` surface: there it is required.

        **Raises:** ValueError for wrong shapes, and, on concrete numbers, where the search fails, and for surfaces that do
        not touch in one point from outside there (a bowl too deep, two planes).
        """
        joints = as_array(joints, "joints", self.home.dtype)
        if joints.shape != (self.topology.nq,):
            raise ValueError(
                f"joints has shape {joints.shape}, expected {(self.topology.nq,)}, those of model {self.name!r}"
            )
        count = len(self.contacts)
        if near is not None:
            near = as_array(near, "near", joints.dtype)
            if near.ndim != 2 or near.shape[0] != count or near.shape[1] not in (4, 5):
                raise ValueError(
                    f"near has shape {near.shape}, expected {(count, 4)}, (u_a, v_a, u_b, v_b) of each contact"
                )
        q = _search_places(self, joints, near)
        _check_places(self, q, "joints", "give near=, coordinates next to the contact")
        return q

    def contact_coordinates(self, q: Float[Array, " nq"]) -> Float[Array, "n 5"]:
        r"""Contact coordinates eta = (u_a, v_a, u_b, v_b, psi) of each contact, as for `jd.contact.montana`.

        psi is the angle (rad) between the Gauss frames of these charts, in the tangent plane:

        $$R_{AB} = \begin{bmatrix} \cos\psi & -\sin\psi \\ -\sin\psi & -\cos\psi \end{bmatrix}$$
        """
        (q,) = check_shapes(self, q=q)
        contacts = self.contacts_at(q)
        return jnp.stack(each(contacts, RollingContact.coordinates, *relative_poses(contacts, self, q)))

    def check_start(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> None:
        """Refuse invalid initial places.

        **Raises:** ValueError, on concrete numbers, that names the contact, as `place` does.
        """
        _check_places(self, q, "q0", "use system.place(q0[: system.topology.nq])")

    def is_consistent(self, q: Float[Array, " nq"]) -> Bool[Array, ""]:
        """Decide whether all places are closest points, with one point of contact each."""
        strict, residuals = _closeness(self, q)
        return jnp.all(strict & (residuals <= float(jnp.finfo(q.dtype).eps) ** 0.4))

    def complete_configuration(self, q: Float[Array, " nq"], joints: Float[Array, "..."]) -> Float[Array, "..."]:
        """Configuration with the places updated for other coordinates of the joints."""
        if not self.contacts:
            return joints
        return kernel(_complete_configuration, fallback=_complete_configuration)(self, q, joints)

    def complete_rate(
        self, q: Float[Array, " nq"], v: Float[Array, " nv"], rate: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Rate dq/dt, including the places."""
        if not self.contacts:
            return rate
        return jnp.concatenate([rate, kernel(_place_rates, fallback=_place_rates)(self, q, v)])


def _complete_configuration(system: RollingModel, q, joints):
    contacts = system.contacts_at(q)
    poses = relative_poses(contacts, system, joints)
    return jnp.concatenate([joints, *each(contacts, lambda one, R, p: one.track(R, p, _STEPS_MOVED), *poses)])


def _place_rates(system: RollingModel, q, v):
    contacts = system.contacts_at(q)
    return jnp.concatenate(each(contacts, RollingContact.place_rate, *relative_motions(contacts, system, q, v)))


@eqx.filter_jit
def _closeness(system: RollingModel, q):
    """For each contact, the flag of a single contact point, and the residual of its places (m, rad)."""
    contacts = system.contacts_at(q)
    steps = each(contacts, RollingContact.steps, *relative_poses(contacts, system, q))
    return jnp.stack([step.is_strict for step in steps]), jnp.stack([step.residual for step in steps])


def _check_places(system: RollingModel, q, what: str, fix: str) -> None:
    if not is_known(system, q):
        return
    strict, residuals = map(np.asarray, _closeness(system, jnp.asarray(q)))
    for contact, is_strict, off in zip(system.contacts, strict, residuals, strict=True):
        if not is_strict:
            raise ValueError(
                f"{what}: the surfaces of contact {contact.name!r} do not touch in one point from outside (their relative "
                f"curvature is not positive, or their normals do not face each other); choose more convex ones, or {fix}"
            )
        if not off <= float(np.finfo(q.dtype).eps) ** 0.4:
            raise ValueError(
                f"{what}: the place of contact {contact.name!r} is {off:.3g} (m or rad) from the closest points of its surfaces "
                f"; {fix}"
            )


@eqx.filter_jit
def _search_places(system: RollingModel, joints, near):
    rotations, positions = relative_poses(system.contacts, system, joints)
    coordinates = []
    for i, contact in enumerate(system.contacts):
        R, p = rotations[i], positions[i]
        if near is None:
            start = _between(contact, R, p)
        else:
            start = jnp.concatenate([contact.shape_a.place_of(near[i][:2]), contact.shape_b.place_of(near[i][2:4])])

        def improve(_, place, contact=contact, R=R, p=p):
            return contact.with_place(place).track(R, p, 1)

        coordinates.append(lax.fori_loop(0, _STEPS_SEARCHED, improve, start))
    return jnp.concatenate([joints, *coordinates])


def _between(contact: RollingContact, R, p):
    """Initial places by alternating projections between the two surfaces."""
    a, b = contact.shape_a, contact.shape_b
    point = p
    for _ in range(_TURNS):
        place_a = a.toward(point)
        if place_a is None:
            break
        place_b = b.toward(matmul(R.T, a.point_at(place_a) - p))
        if place_b is None:
            break
        point = matmul(R, b.point_at(place_b)) + p
    # Reached when the loop was not left by a break: both surfaces know their closest points.
    else:
        return jnp.concatenate([place_a, place_b])
    raise ValueError(
        f"contact {contact.name!r} has a surface given only by its parametrisation; give near=, coordinates close to the contact"
    )
