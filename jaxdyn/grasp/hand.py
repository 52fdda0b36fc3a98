"""Grasps: one model of the fingers and the object, with the contacts between them as constraints; kinds of contacts."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints.base import Constraint, Pfaffian, constraint_jacobian, layout
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.loops import attitude, check_bodies
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.constraints.rolling import RollingSphere, RollingWheel
from jaxdyn.contact.cones import Cones, components
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.lie.so3 import matmul
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, DType, Numbers, SystemLike, as_shape, check_body, check_new_name
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.model.joining import join_all
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Force, Scene


class Grasp(Scene):
    r"""Grasp of an object by fingers: a scene whose multipliers are contact forces on the object.

    $$A = \begin{bmatrix} -J_h & G^T \end{bmatrix}, \quad J_h \dot\theta = G^T V$$

    It is a `Scene`, so `constrained_dynamics`, `assemble`, `projections` and `simulate` act on it as on any other one.
    For motion in the velocity of the object alone, with the joints of the fingers recovered from these rows:

        jd.simulate(grasp, q0, v0, ts, method=jd.Reduced(grasp.object_velocities))

    **Arguments:**

    - `fingers`: a `Model` of the hand, or a list of models that stand in the same world, one per finger.
    - `object`: a `Model` of one body, on a joint (free, planar, or whatever holds it) to the world; or the name of such
      a body that `fingers` has already. Models are joined into one, `grasp.system`; the order of its trees is that of
      the names of their first joints.
    - `contacts`: `contact(...)` for contacts fixed on the object; `jd.rolling_sphere` and `jd.rolling_wheel` between a
      finger and the object, either of which may be the one that rolls: compression is a positive normal force; other
      constraints of the library.
    - `forces`, `cones`: as of a `Scene`. Without cones contacts are bilateral.

    **Raises:** ValueError for incompatible models, an object that is no single body of its own, or whose inertia
    is not positive definite, an empty list of contacts, contacts with bodies or frames that the models do not have, contacts
    that prescribe a slip, and cones of other sizes than their contacts.

    Source: Murray, Li & Sastry (1994), sections 5.5 and 6.3; EQUATIONS section 10.
    """

    object: str = eqx.field(static=True, kw_only=True)

    def __init__(
        self,
        fingers: Model | Sequence[Model],
        object: Model | str,
        contacts: Sequence,
        forces: Checked[Sequence[Force]] = (),
        cones: Cones = None,
    ):
        # One model of all bodies: only then object and fingers have common rows A and one mass matrix.
        models = [fingers] if isinstance(fingers, Model) else list(fingers)
        if not models or not all(isinstance(model, Model) for model in models):
            raise ValueError("fingers is no Model and no list of Models; pass what carries the fingertips")
        if isinstance(object, Model):
            if object.nb != 1:
                raise ValueError(f"object has {object.nb} bodies, {list(object.body_names)}; pass a Model of one body")
            models, object = [*models, object], object.body_names[0]
        model = models[0] if len(models) == 1 else join_all(models, f"grasp of {object}")
        _check_object(model, object)
        if not isinstance(contacts, (tuple, list)) or not contacts:
            raise ValueError(f"contacts is {contacts!r}; pass a list with at least one contact")
        for one in contacts:
            # J_h thetadot = G^T V has no right-hand side: a prescribed slip would need one in all equations of the grasp.
            if isinstance(one, Pfaffian) and one.b is not None:
                raise ValueError(f"contact {one.name!r} prescribes a slip b; contacts of a grasp have none")
        super().__init__(model, tuple(on_object(one, object) for one in contacts), forces, cones)
        self.object = object
        layout(self)  # refuses unknown bodies
        if cones is not None:
            contacts_with_cones(self)  # refuses cones that do not fit

    @property
    def object_velocities(self) -> tuple[int, ...]:
        """Indices of the object's velocity in v; for a free body its body twist."""
        top = self.system.topology
        place = top.v_slices[top.body_names.index(self.object)]
        return tuple(range(place.start, place.stop))

    @property
    def hand_velocities(self) -> tuple[int, ...]:
        """Indices of the joint velocities thetadot of all fingers in v."""
        return tuple(i for i in range(self.nv) if i not in self.object_velocities)


def hand_jacobian(grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "nc nh"]:
    """Hand Jacobian (nc, nh), which maps joint velocities to fingertip velocities along the contacts' components.

    Source: Murray, Li & Sastry (1994), eq. 5.28; EQUATIONS section 10.
    """
    check_grasp(grasp)
    return -_columns(grasp, q, t, grasp.hand_velocities)


def grasp_map(grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "no nc"]:
    r"""Grasp map (no, nc), which maps contact forces to their generalised force on the object.

    $$G = \begin{bmatrix} \mathrm{Ad}_{g_{oc_1}}^{-T} B_1 & \mathrm{Ad}_{g_{oc_2}}^{-T} B_2 & \cdots \end{bmatrix}$$

    for a free body, where $G \lambda$ is the wrench (f, tau) at the origin and in the axes of the body frame. $G^T V$ are the
    velocities of the object at the contacts.

    Source: Murray, Li & Sastry (1994), eq. 5.11; EQUATIONS section 10.
    """
    check_grasp(grasp)
    return _columns(grasp, q, t, grasp.object_velocities).T


@entry_point
def _columns(grasp: Grasp, q, t, columns: tuple[int, ...]) -> Float[Array, "nc k"]:
    return constraint_jacobian(grasp, q, t)[:, np.array(columns, int)]


def internal_forces(
    grasp: Grasp, q: Float[Array, " nq"], lam: Float[Array, " nc"], t: Numbers = 0.0
) -> Float[Array, " nc"]:
    r"""Internal part of contact forces, which does not move the object.

    $$\lambda_N = (1 - G^+ G) \lambda, \quad G \lambda_N = 0$$

    The split depends on the units of forces and torques where contacts transmit both, as any orthogonal one.

    **Arguments:** `lam` (nc,), contact forces, N and N m.

    Source: Murray, Li & Sastry (1994), sections 5.3 and 6.3; EQUATIONS section 10.
    """
    G = grasp_map(grasp, q, t)
    lam = as_shape(lam, "lam", G.dtype, G.shape[1:], of=", one per row of the grasp")
    # G lam first: the projection matrix (nc, nc) is never formed.
    return lam - matmul(pseudo_inverse(G, tolerance(None, G)), matmul(G, lam))


def check_grasp(grasp) -> None:
    """Refuse anything but a `Grasp`."""
    if not isinstance(grasp, Grasp):
        raise ValueError(f"grasp is a {type(grasp).__name__}; pass a jd.grasp.Grasp")


def _check_object(model: Model, name: str) -> None:
    top = model.topology
    if name not in top.body_names:
        raise ValueError(f"object {name!r} is no body of model {model.name!r}; bodies are {list(top.body_names)}")
    body = top.body_names.index(name)
    # G and J_h are columns of A: they separate object and fingers only if no joint carries both.
    if top.parents[body] >= 0 or body in top.parents:
        raise ValueError(f"object {name!r} is part of a tree of bodies; give it a joint to the world and no children")
    if top.nb == 1:
        raise ValueError(f"there are no fingers beside the object {name!r}; pass their models")
    if is_concrete(model.inertias):
        # Coordinates of the spatial inertia that the joint's velocities see; other joints get no inertia check.
        moved = {"free": range(6), "planar": (0, 1, 5)}.get(top.kinds[body], ())
        matrix = host_math.spatial_inertia(np.asarray(model.inertias, float)[body])[np.ix_(moved, moved)]
        if len(moved) and not (minimum := np.linalg.eigvalsh(matrix)[0]) > 0:
            raise ValueError(
                f"inertia of the object {name!r} is not positive definite: the least eigenvalue of its spatial inertia is "
                f"{minimum:.3g}; give it a mass and an inertia about every axis, as from jd.inertia.box(mass, size)"
            )


# Contacts between a finger and an object as constraints on components of the relative twist.
#
# A contact frame on the object has its z along the normal, into the object. With the wrench basis B of the contact, whose
# columns are the wrenches that it can transmit, in that frame,
#
#     B^T (twist of the object - twist of the finger) = G^T V_o - J_h thetadot = 0,
#
# so that the multipliers of these rows are the forces of the finger on the object along the columns of B.


class Contact(Pair):
    """Contact at a point fixed on the object, built by `contact`."""

    name: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    finger: str | None = eqx.field(static=True)
    object: str | None = eqx.field(static=True)
    in_plane: bool = eqx.field(static=True)
    pose: Float[Array, "4 4"]
    finger_pose: Float[Array, "4 4"]

    def ends(self) -> tuple[tuple[str | None, Array], tuple[str | None, Array]]:
        """Frame A on the object, frame B on the finger."""
        return (self.object, self.pose), (self.finger, self.finger_pose)

    @property
    def components(self) -> tuple[int, ...]:
        """Components of the relative twist, in the contact frame, that are zero."""
        return components(self.kind, self.in_plane, self.name)

    @property
    def _spins(self) -> bool:
        # Rotation about the normal alone is not the rate of a function of the configuration.
        return self.kind == "soft-finger"

    def sizes(self, system: SystemLike, dtype: DType) -> tuple[int, int]:
        """Numbers of holonomic rows and of others: only a soft finger's torque row is nonholonomic."""
        check_bodies(self.name, system, (self.object, self.finger))
        return len(self.components) - int(self._spins), int(self._spins)

    def wrench_components(self) -> tuple[int, ...] | None:
        """Order of the rows in the wrench: they are its components."""
        return tuple(range(len(self.components)))

    def structure_key(self) -> tuple:
        """Key of the kind of contact."""
        return self.kind, self.in_plane

    def pose_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Float[Array, " nh"] | None:
        """Position, and where the contact constrains it orientation, of the contact frame in the fingertip's, (n,), m and rad."""
        # Frame A is on the object, so p is the fingertip's position relative to it; rows are object minus fingertip.
        residual = p if self.kind != "rigid" else jnp.concatenate([p, jnp.stack(attitude(R))])
        # Components beyond the residual are rates alone: that of a soft finger is in `twist_residual`.
        return -residual[np.array([i for i in self.components if i < residual.shape[0]])]

    def twist_residual(
        self, R: Float[Array, "3 3"], p: Float[Array, "3"], U: Float[Array, "6"]
    ) -> Float[Array, " np"] | None:
        """Angular velocity of the object relative to the finger about the normal, (1,), rad/s, for a soft finger."""
        # U is the twist of the finger relative to the object, and rows are object minus finger.
        return -U[5:] if self._spins else None


def contact(
    kind: str,
    finger: str | None,
    pose: Numbers | None,
    *,
    finger_pose: Numbers | None = None,
    object: str | None = None,
    in_plane: bool = False,
    name: str | None = None,
) -> Contact:
    """Contact of a fingertip at a point fixed on the object.

    Rows: the components of the object's twist relative to the finger, in the contact frame, along the columns of
    `wrench_basis(kind)`. Their multipliers are the components of the wrench on the object (N, N m). A frictionless
    contact holds the fingertip on the x-y plane of the contact frame, on which it slides.

    **Arguments:**

    - `kind`: "frictionless", "hard-finger" (a point with friction), "soft-finger" or "rigid".
    - `finger`: body or frame in contact, or None for the world, as a table; `finger_pose`: of the fingertip in it, by
      default its own frame. The origin is the contact point; the axes matter only in a rigid contact, where they are
      those of the contact frame.
    - `pose`: of the contact frame in the object: z is the normal into the object. Poses are None (identity), (4, 4), (3,)
      or (xyz, rpy); m and rad.
    - `object`: body in contact; None: the object of the `Grasp`, the world in a `Scene`.
    - `in_plane`: only rows within the x-z plane of the contact frame, for mechanisms that move in that plane.
    - `name`: for errors and reports; by default that of the finger, or "world".

    **Raises:** ValueError for an unknown kind or a bad pose; when used, for unknown bodies.

    Source: Murray, Li & Sastry (1994), eq. 5.14; EQUATIONS section 10.
    """
    name = check_new_name(name, finger or "world")
    components(kind, in_plane, f"contact {name!r}")
    return Contact(
        name=name,
        kind=kind,
        finger=check_body(finger, f"contact {name!r}: finger"),
        object=check_body(object, f"contact {name!r}: object"),
        in_plane=in_plane,
        pose=pose_leaf(pose, f"contact {name!r}: pose"),
        finger_pose=pose_leaf(finger_pose, f"contact {name!r}: finger_pose"),
    )


def point_contacts(places: dict, *, kind: str = "hard-finger") -> list[Contact]:
    """Contacts of named fingertips at points of the object, from its points and inward normals.

    **Arguments:** `places`: by the name of a finger's body or frame, whose origin is the contact point, (point (3,),
    normal (3,)) on the object, in its frame: m, and the direction into the object. `kind`: as of `contact`.

    **Returns:** one `Contact` each; z of its frame is the normal, x and y any orthogonal directions.

    **Raises:** ValueError for no places, points and normals that are not (3,), and normals of length zero.

    ```python
    jd.grasp.point_contacts({"tip1": ((0.03, 0, 0), (-1, 0, 0)), "tip2": ((-0.03, 0, 0), (1, 0, 0))})
    ```
    """
    if not isinstance(places, dict) or not places:
        raise ValueError(f"places is {places!r}; give {{finger: (point, normal)}}")
    contacts = []
    for finger, place in places.items():
        parts = [array_namespace(x).asarray(x, float) for x in place] if isinstance(place, (tuple, list)) else []
        if [x.shape for x in parts] != [(3,), (3,)]:
            raise ValueError(f"places[{finger!r}] is {place!r}; give (point (3,), normal (3,))")
        point, normal = parts
        if is_concrete(normal) and not (np.isfinite(normal).all() and normal.any()):
            raise ValueError(f"places[{finger!r}]: normal is {normal.tolist()}; give a direction into the object")
        xp, normal = array_namespace(normal), host_math.unit(normal, f"places[{finger!r}]: normal")
        # The axis of the frame farthest from the normal, so that the cross product is never small.
        across = host_math.unit(xp.cross(normal, xp.eye(3)[xp.argmin(xp.abs(normal))]), "across")
        # Right-handed: across x (normal x across) = normal.
        pose = host_math.pose_of(xp.stack([across, xp.cross(normal, across), normal], 1), point)
        contacts.append(contact(kind, finger, pose))
    return contacts


def on_object(constraint: Constraint, name: str) -> Constraint:
    """Convert a constraint to a contact of the object `name`.

    **Raises:** ValueError for a contact on another body, and for rolling between other bodies.
    """
    if isinstance(constraint, Contact):
        if constraint.object not in (None, name):
            raise ValueError(
                f"contact {constraint.name!r} is on {constraint.object!r}, the object of the grasp is {name!r}; leave "
                "object out"
            )
        # Modules are frozen: the contact gets its object in a copy.
        return dataclasses.replace(constraint, object=name)
    if isinstance(constraint, (RollingSphere, RollingWheel)):
        if name not in (constraint.body, constraint.surface_body):
            raise ValueError(
                f"rolling contact {constraint.name!r} is between {constraint.body!r} and {constraint.surface_body!r}; "
                f"one of them must be the object, {name!r}"
            )
    return constraint
