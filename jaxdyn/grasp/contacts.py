"""Contacts between a finger and an object as constraints on components of the relative twist.

A contact frame on the object has its z along the normal, into the object. With the wrench basis B of the contact, whose
columns are the wrenches that it can transmit, in that frame,

    B^T (twist of the object - twist of the finger) = G^T V_o - J_h thetadot = 0,

so that the multipliers of these rows are the forces of the finger on the object along the columns of B.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints.base import Constraint
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.loops import attitude, check_bodies
from jaxdyn.constraints.rolling import RollingSphere, RollingWheel
from jaxdyn.contact.cones import components
from jaxdyn.model import host_math
from jaxdyn.model.arguments import DType, Numbers, SystemLike, check_body, check_new_name, pose_leaf


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
        fields = ("name", "kind", "finger", "in_plane", "pose", "finger_pose")
        return Contact(object=name, **{field: getattr(constraint, field) for field in fields})
    if isinstance(constraint, (RollingSphere, RollingWheel)):
        if name not in (constraint.body, constraint.surface_body):
            raise ValueError(
                f"rolling contact {constraint.name!r} is between {constraint.body!r} and {constraint.surface_body!r}; "
                f"one of them must be the object, {name!r}"
            )
    return constraint
