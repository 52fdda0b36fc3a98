"""Models with rolling contacts: contact points are dependent coordinates of the configuration.

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
from jaxdyn.constraints.frames import each, relative_motions, relative_poses
from jaxdyn.constraints.loops import check_bodies
from jaxdyn.contact.rolling import Rolling, RollingContact
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Number, Numbers, as_array, check_shapes
from jaxdyn.model.tree import Model

# Newton steps after a step of the integration; the second one makes the first derivatives exact.
_STEPS_MOVED = 2
# Newton steps of the initial search, and alternating projections between the surfaces for its start.
_STEPS_SEARCHED, _TURNS = 30, 8


class RollingModel(Model):
    """Model with rolling contacts: q = (joints' coordinates, places of the contacts), v of the model.

    **Arguments:** `model`: a `Model`; `contacts`: a list of `jd.contact.rolling_contact(...)`; `fields`: for
    `dataclasses.replace` alone.

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

    def __init__(self, model: Checked[Model | None] = None, contacts: Sequence = (), **fields: Any):
        if fields:  # from `dataclasses.replace`, with checked fields
            for name, value in fields.items():
                setattr(self, name, value)
            self.contacts = tuple(contacts)
            return
        if not isinstance(model, Model) or isinstance(model, RollingModel):
            raise ValueError(f"model is a {type(model).__name__}; pass a Model, the bodies that carry the surfaces")
        if not isinstance(contacts, (tuple, list)) or not all(isinstance(one, RollingContact) for one in contacts):
            raise ValueError(f"contacts is {contacts!r}; pass a list of jd.contact.rolling_contact(...)")
        for field in dataclasses.fields(Model):
            setattr(self, field.name, getattr(model, field.name))
        names = [one.name for one in contacts]
        if len(set(names)) < len(names):
            raise ValueError(f"contacts have the names {names}; give each its own (name=)")
        for one in contacts:
            check_bodies(one.name, model, (one.body, one.surface_body))
        self.contacts = tuple(contacts)

    def replace(self, **leaves: PyTree) -> "RollingModel":
        """Copy with some leaves of the model replaced, and the same contacts."""
        model = Model(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Model)})
        return RollingModel(model.replace(**leaves), self.contacts)

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
    # Within a trace the result would be traced even for concrete numbers, and could not be tested.
    with jax.ensure_compile_time_eval():
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
        start = _between(contact, R, p) if near is None else _place_of_coordinates(contact, near[i])

        def improve(_, place, contact=contact, R=R, p=p):
            return contact.with_place(place).track(R, p, 1)

        coordinates.append(lax.fori_loop(0, _STEPS_SEARCHED, improve, start))
    return jnp.concatenate([joints, *coordinates])


def _place_of_coordinates(contact: RollingContact, alpha):
    return jnp.concatenate([contact.shape_a.place_of(alpha[:2]), contact.shape_b.place_of(alpha[2:4])])


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
