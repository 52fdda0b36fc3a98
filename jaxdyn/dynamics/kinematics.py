"""Kinematics of trees: products of exponentials, Jacobians of named frames and their rates.

Poses are those of `tree_frames`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.compile.known import array_namespace
from jaxdyn.dynamics.tree_frames import body_twists, map_rows, subspace_rate, take, tree_frame
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Given, check_shapes
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model, Topology


class BodyFrames(NamedTuple):
    """Frames of selected bodies, and the coordinates that move them.

    - `pose` (n, 4, 4): in the tree frame of its body; `origin` (n, 3): of that tree frame in the world.
    - `coordinates` (k,): velocity coordinates that move at least one of them; `subspace` (k, 6): their rows of
      `TreeFrame.subspace`.
    - `velocity_mask` (n, k) of bool: which frame each of these coordinates moves.
    - `twist`, `bias` (n, 6): twist of each frame, as a twist of the fixed frame that now coincides with the tree frame, and
      its rate at a = 0; `subspace_rate` (k, 6) the rates of `subspace`; None when no velocity was given.
    """

    pose: Float[Array, "n 4 4"]
    origin: Float[Array, "n 3"]
    subspace: Float[Array, "k 6"]
    coordinates: np.ndarray
    velocity_mask: np.ndarray
    twist: Any = None
    bias: Any = None
    subspace_rate: Any = None


def body_frames(
    model: Model, q: Float[Array, " nq"], bodies: Sequence[int], v: Float[Array, " nv"] | None = None
) -> BodyFrames:
    """Frames of selected bodies (-1 is the world), and with v their twists, computed from their ancestors only."""
    topology, n = model.topology, len(bodies)
    named = np.array([body for body in bodies if body >= 0], int)
    kept = np.flatnonzero(topology.ancestors[named].any(0)).tolist()
    if not kept:
        pose = jnp.broadcast_to(jnp.eye(4, dtype=q.dtype), (n, 4, 4))
        none, at_rest = np.zeros(0, int), None if v is None else jnp.zeros((n, 6), q.dtype)
        nowhere = jnp.zeros((0, 6), q.dtype)
        return BodyFrames(pose, jnp.zeros((n, 3), q.dtype), nowhere, none, np.zeros((n, 0), bool), at_rest, at_rest)
    coordinates = _coordinate_indices(topology.v_slices, kept)
    # Constraints touch few bodies of a large tree; the remaining bodies need not be placed at all.
    if len(kept) < model.nb:
        model, q = _prune(model, kept), take(q, _coordinate_indices(topology.q_slices, kept))
    frame = tree_frame(model, q)
    # Place len(kept) is the row of the world that is appended below.
    index = np.array([kept.index(body) if body >= 0 else len(kept) for body in bodies])
    pose = jnp.concatenate([frame.pose, jnp.eye(4, dtype=q.dtype)[None]])
    origin = jnp.concatenate([frame.origin, jnp.zeros((1, 3), q.dtype)])
    moved_by = np.concatenate([model.topology.dof_ancestors, np.zeros((1, model.nv), bool)])[index]
    frames = BodyFrames(take(pose, index), take(origin, index), frame.subspace, coordinates, moved_by)
    if v is None:
        return frames
    v = take(v, coordinates)
    rates = subspace_rate(model, frame, body_twists(model, frame, v))
    # One product gives the twists and their rates.
    sums = matmul(jnp.asarray(moved_by, q.dtype), jnp.concatenate([frame.subspace, rates], axis=1) * v[:, None])
    return frames._replace(twist=sums[:, :6], bias=sums[:, 6:], subspace_rate=rates)


def _prune(model: Model, kept: list[int]) -> Model:
    """Restrict a model to bodies that include each other's parents; leaves that kinematics does not use are dropped."""
    old, index = model.topology, np.array(kept)

    def select(names):
        return tuple(names[i] for i in kept)

    # Parents precede children in `kept` because it is sorted, so the result is a valid topology.
    parents = tuple(kept.index(parent) if parent >= 0 else -1 for parent in select(old.parents))
    names = select(old.body_names)
    topology = Topology(
        old.name, parents, select(old.kinds), names, select(old.joint_names), names, tuple(range(len(kept)))
    )
    at_q, at_v = _coordinate_indices(old.q_slices, kept), _coordinate_indices(old.v_slices, kept)
    return Model(
        home=take(model.home, index),
        screws=take(model.screws, index),
        inertias=take(model.inertias, index),
        frame_poses=jnp.zeros((len(kept), 4, 4), model.home.dtype),
        gravity=None,
        armature=None,
        damping=None,
        friction=None,
        lower=take(model.lower, at_q),
        upper=take(model.upper, at_q),
        velocity_limit=take(model.velocity_limit, at_v),
        effort_limit=take(model.effort_limit, at_v),
        topology=topology,
        rounding=model.rounding,
    )


def _coordinate_indices(slices, kept: list[int]) -> np.ndarray:
    return np.concatenate([np.arange(slices[i].start, slices[i].stop) for i in kept])


def forward_kinematics(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nb 4 4"]:
    r"""Pose of every body frame in the world.

    $$T_i = \prod_j \mathrm{home}_j \exp(\hat S_j q_j)$$

    over the joints j from the world to body i.

    **Arguments:** `q` (nq,).

    **Returns:** (nb, 4, 4) in the order of `model.body_names`; maps body coordinates to world coordinates (m).

    **Raises:** ValueError when the shape of q does not fit the model.

    Source: Murray, Li & Sastry (1994), eq. 3.3; EQUATIONS section 2.
    """
    (q,) = check_shapes(model, q=q)
    return _world_poses(model, q)


@kernel
def _world_poses(model: Model, q):
    frame = tree_frame(model, q)
    return _translate(frame.pose, frame.origin)


def _translate(pose: Float[Array, "*n 4 4"], shift: Float[Array, "*n 3"]) -> Float[Array, "*n 4 4"]:
    """Translate poses by a shift in the axes of their reference frame."""
    step = jnp.concatenate([shift[..., None], jnp.zeros_like(shift[..., :1, None])], -2)
    return jnp.concatenate([pose[..., :3], pose[..., 3:] + step], -1)


def frame_pose(model: Model, q: Float[Array, " nq"], frame: str | None) -> Float[Array, "4 4"]:
    """Pose of a named frame in the world.

    **Arguments:** `q` (nq,); `frame`, one of `model.frame_names` (None: the world itself).

    **Returns:** (4, 4), maps frame coordinates to world coordinates (m).

    **Raises:** ValueError for an unknown name (similar names are listed) or a q that does not fit.
    """
    (q,) = check_shapes(model, q=q)
    body, offset = named_frame(model, frame)
    if body < 0:
        return jnp.asarray(offset, model.home.dtype)
    return _pose_in_body(body, (kinematic_part(model), offset), q)


@kernel(static=1)
def _pose_in_body(body: int, tree, q):
    model, offset = tree
    frames = body_frames(model, q, [body])
    return _translate(matmul(frames.pose[0], jnp.asarray(offset)), frames.origin[0])


def body_jacobian(model: Model, q: Float[Array, " nq"], frame: str | None) -> Float[Array, "6 nv"]:
    r"""Body Jacobian of a named frame: J v is the frame's body twist.

    $$\widehat{J v} = T^{-1} \dot T$$

    **Arguments:** `q` (nq,); `frame`, one of `model.frame_names` (None: the world, J = 0).

    **Returns:** (6, nv): linear then angular velocity of the frame, at its origin and in its own axes (m/s, rad/s per
    unit of v). Its transpose maps a wrench at that origin, in those axes, to generalised forces.

    **Raises:** ValueError for an unknown name or a q that does not fit.

    Source: Murray, Li & Sastry (1994), eq. 3.55; EQUATIONS section 2.
    """
    (q,) = check_shapes(model, q=q)
    return of_frame(_body_jacobian, (6, model.nv), model, frame, q)


@kernel(static=1)
def _body_jacobian(body: int, tree, q):
    model, offset = tree
    frames = body_frames(model, q, [body])
    return all_coordinates(model, frames, twists_in_frame(frames, offset, frames.subspace)).T


def spatial_jacobian(model: Model, q: Float[Array, " nq"], frame: str | None) -> Float[Array, "6 nv"]:
    r"""Spatial Jacobian of a named frame: J v is the frame's spatial twist.

    $$\widehat{J v} = \dot T T^{-1}$$

    **Arguments:** `q` (nq,); `frame`, one of `model.frame_names` (None: the world, J = 0).

    **Returns:** (6, nv): velocity of the point of the body that is now at the world's origin, and angular velocity, in
    world axes. Loses accuracy with the distance from the world's origin; `body_jacobian` does not.

    **Raises:** ValueError for an unknown name or a q that does not fit.

    Source: Murray, Li & Sastry (1994), eq. 3.54.
    """
    (q,) = check_shapes(model, q=q)
    return of_frame(_spatial_jacobian, (6, model.nv), model, frame, q)


@kernel(static=1)
def _spatial_jacobian(body: int, tree, q):
    model, _ = tree
    frames = body_frames(model, q, [body])
    shift = se3.from_parts(jnp.eye(3, dtype=model.home.dtype), frames.origin[0])
    columns = map_rows(functools.partial(se3.Ad_apply, shift), frames.subspace)
    return all_coordinates(model, frames, columns).T


def kinematic_part(model: Model) -> Model:
    """Model without gravity and armature, so that programs of kinematics do not depend on them."""
    # `replace` would check and copy all leaves at every call.
    if all(x is None for x in (model.gravity, model.armature)):
        return model
    return model.replace(gravity=None, armature=None)


def of_frame(function: Callable, shape: tuple[int, ...], model: Model, frame: str | None, *args):
    """Evaluate function(body, (model, pose of the frame in it), *args); zeros of a shape for the world, which has no body."""
    body, offset = named_frame(model, frame)
    if body < 0:
        return jnp.zeros(shape, model.home.dtype)
    return function(body, (kinematic_part(model), offset), *args)


def named_frame(model: Model, name: str | None) -> tuple[int, Any]:
    """Body that carries a frame (-1: the world) and the frame's pose in it, of numpy where it is known."""
    # None means the world everywhere in the package, with the identity as its pose.
    if name is None:
        return -1, np.eye(4, dtype=model.home.dtype)
    index = frame_index(model, name)
    # A known pose stays a numpy array with the same value in every call: compiled programs are cached by it.
    poses = model.frame_poses
    return model.topology.frame_bodies[index], array_namespace(poses).asarray(poses)[index]


def twists_in_frame(frames: BodyFrames, offset: Given, rows: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
    """Twists of the tree frame in the axes and at the origin of a frame at `offset` in the first of the bodies."""
    pose = matmul(frames.pose[0], jnp.asarray(offset))
    return map_rows(functools.partial(se3.Ad_inv_apply, pose), rows)


def all_coordinates(model: Model, frames: BodyFrames, rows: Float[Array, "k 6"]) -> Float[Array, "nv 6"]:
    """Rows of all velocity coordinates, zero for those that move none of the bodies."""
    places = np.full(model.nv, len(frames.coordinates))
    places[frames.coordinates] = np.arange(len(frames.coordinates))
    return take(jnp.concatenate([rows, jnp.zeros((1, 6), rows.dtype)]), places)
