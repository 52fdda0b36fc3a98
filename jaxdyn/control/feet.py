"""Feet of legged robots: contact frames, admissible ground forces, and the rows that fix a foot to the ground."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.loops import Loop, loop, pose_leaf
from jaxdyn.contact.cones import FrictionCone, wrench_basis
from jaxdyn.dynamics.kinematics import body_jacobian, frame_pose
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, as_array, is_concrete
from jaxdyn.model.host_math import ORTHONORMAL_GROUND, rotation_fault
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model

# A surface fixes the same six components as a rigid contact; it differs by its cone of wrenches.
_FLAT = ("rigid", "surface")


class FootConstraint(Loop):
    """Constraint of a foot fixed to the ground; its multipliers are the components of its force."""

    def wrench_components(self):
        """Order of all rows in the wrench: a point's forces, or a weld's forces and torques."""
        return tuple(range(self.kind.count))


class Foot(eqx.Module):
    """Contact of a body with the ground, built by `foot`.

    Its force f (m,), N and N m, is along the columns of the wrench basis of its cone's kind, in the contact frame: z is the
    normal out of the ground. A point's contact frame has the axes of the `ground`, a flat foot's those of its `pose`.
    """

    frame: str = eqx.field(static=True)
    cone: FrictionCone
    pose: Float[Array, "4 4"]
    ground: Float[Array, "3 3"]

    @property
    def size(self) -> int:
        """Number m of components of the foot's force."""
        return self.cone.size

    @property
    def is_flat(self) -> bool:
        """True where the foot transmits torques about all axes and keeps its attitude."""
        return self.cone.kind in _FLAT

    def contact_pose(self, model: Model, q: Float[Array, " nq"]) -> Float[Array, "4 4"]:
        """Pose of the contact frame in the world."""
        pose = matmul(frame_pose(model, q, self.frame), self.pose.astype(q.dtype))
        # A point's attitude is free: the axes of the ground keep the normal from tilting with the body.
        return pose if self.is_flat else pose.at[:3, :3].set(self.ground.astype(q.dtype))

    def jacobian(self, model: Model, q: Float[Array, " nq"]) -> Float[Array, "m nv"]:
        """Jacobian J (m, nv): the velocities along the components of the force f are J v.

        Its transpose maps the force to generalised forces.
        """
        # Ad of the inverse takes the body twist from the axes and origin of the frame to those of the contact.
        to_contact = matmul(se3.inverse(frame_pose(model, q, self.frame)), self.contact_pose(model, q))
        twist = matmul(se3.Ad(se3.inverse(to_contact)), body_jacobian(model, q, self.frame))
        kind = "rigid" if self.cone.kind == "surface" else self.cone.kind
        return matmul(jnp.asarray(wrench_basis(kind).T, q.dtype), twist)

    def hold(self, model: Model, q: Float[Array, " nq"]) -> FootConstraint:
        """Constraint that fixes the foot at its pose for q (nq,): a point, or a weld for a flat foot.

        Its multipliers are the foot's force in its contact frame, so that the foot's cone applies to it
        (`jd.control.standing`).
        """
        # Only the position of a point counts, so the axes of its pose are dropped.
        local = self.pose if self.is_flat else self.pose.at[:3, :3].set(jnp.eye(3, dtype=self.pose.dtype))
        joint = "weld" if self.is_flat else "point"
        hold_loop = loop(None, self.contact_pose(model, q), self.frame, local, joint, name=self.frame)
        # The rows are those of the loop. The class alone differs, by the order of its multipliers.
        return FootConstraint(**{part.name: getattr(hold_loop, part.name) for part in dataclasses.fields(hold_loop)})


def foot(
    frame: str, cone: Checked[FrictionCone], *, pose: Numbers | None = None, ground: Numbers | None = None
) -> Foot:
    """Contact of a body with the ground, with the cone of admissible ground forces.

    **Arguments:**

    - `frame`: name of a body or frame of the model.
    - `cone`: from `jd.contact.friction_cone`, for a point, or `jd.contact.surface_cone(jd.contact.wrench_cone(...))` for a
      flat foot.
    - `pose`: of the contact point in the frame: None (identity), (4, 4), (3,) or (xyz, rpy); m and rad. For a point
      only the position counts; a flat foot's z is the normal out of the ground.
    - `ground` (3, 3): axes of the ground in the world, z its normal; by default those of the world. Only for points.

    **Raises:** ValueError for an invalid cone or pose, and axes that are no rotation.
    """
    if not isinstance(cone, FrictionCone) or cone.in_plane:
        raise ValueError(f"foot {frame!r}: cone is {cone!r}; give one in space from jd.contact.friction_cone(...)")
    if ground is not None and cone.kind in _FLAT:
        raise ValueError(f"foot {frame!r}: a flat foot stands in the axes of its pose; leave ground out")
    rotation = as_array(np.eye(3) if ground is None else ground, f"foot {frame!r}: ground")
    if rotation.shape != (3, 3):
        raise ValueError(f"foot {frame!r}: ground has shape {rotation.shape}; give a rotation (3, 3)")
    if is_concrete(rotation):
        known = np.asarray(rotation, float)
        if fault := rotation_fault(known, ORTHONORMAL_GROUND):
            raise ValueError(
                f"foot {frame!r}: ground is {known.tolist()}, which is no rotation: it {fault}; give orthogonal axes"
            )
    return Foot(frame, cone, pose_leaf(pose, f"foot {frame!r}: pose"), jnp.asarray(rotation, float))


def check_feet(model: Any, feet: Any) -> tuple[Foot, ...]:
    """Check the feet of a model. **Raises:** ValueError for other types, unknown frames and repeated ones."""
    if not isinstance(model, Model):
        raise ValueError(f"model is a {type(model).__name__}, which has no bodies; pass a Model")
    if not isinstance(feet, (tuple, list)) or not all(isinstance(one, Foot) for one in feet):
        raise ValueError(f"contacts is {feet!r}; pass a list of jd.control.foot(frame, cone)")
    for one in feet:
        frame_index(model, one.frame)
    # `by_foot` and the outputs of a simulation identify feet by their frames.
    names = [one.frame for one in feet]
    if len(set(names)) < len(names):
        raise ValueError(f"contacts name a frame twice: {names}; give every contact a frame of its own")
    return tuple(feet)
