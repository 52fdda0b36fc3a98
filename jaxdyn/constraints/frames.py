"""Frames on bodies, one seen from another, and how fast each coordinate moves them against each other."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn import se3
from jaxdyn.kinematics import Carried, carried, take
from jaxdyn.model import Model, frame_index
from jaxdyn.so3 import _product


def frames_on(model: Model, q, bodies: Sequence[str | None], poses) -> Carried:
    """Frames at the given poses (4, 4) in bodies or named frames (None: the world)."""
    offsets = jnp.stack([pose.astype(q.dtype) for pose in poses])
    places = []
    for k, body in enumerate(bodies):
        index = None if body is None else frame_index(model, body)
        places.append(-1 if index is None else model.topology.frame_bodies[index])
        if index is not None and body not in model.body_names:
            offsets = offsets.at[k].set(_product(model.frame_poses[index].astype(q.dtype), offsets[k]))
    found = carried(model, q, places)
    return found._replace(pose=_product(found.pose, offsets))


def _both_frames(members, system, q) -> Carried:
    """Frames A of all the constraints, then frames B."""
    bodies = [m.body_a for m in members] + [m.body_b for m in members]
    return frames_on(system, q, bodies, [m.pose_a for m in members] + [m.pose_b for m in members])


def _seen_from_a(frames: Carried):
    """Rotations (n, 3, 3) and positions (n, 3) of frames B seen from frames A, and the way from tree to tree (n, 3).

    Positions are subtracted tree by tree: a robot far from the world's origin loses nothing.
    """
    n = len(frames.moves) // 2
    turned = jnp.swapaxes(frames.pose[:n, :3, :3], 1, 2)
    across = frames.origin[n:] - frames.origin[:n]
    apart = frames.pose[n:, :3, 3] - frames.pose[:n, :3, 3] + across
    return _product(turned, frames.pose[n:, :3, :3]), _product(turned, apart[..., None])[..., 0], across


def relative_poses(members, system, q):
    """Rotations (n, 3, 3) and positions (n, 3) of frame B seen from frame A, for constraints with bodies and poses."""
    return _seen_from_a(_both_frames(members, system, q))[:2]


def rows_by_twists(members, derivatives: Callable, system, q) -> list:
    """Rows (r, nv) of constraints on the relative pose of two frames, without a pass of the kinematics for each row.

    `derivatives(rotation, position)` gives, for sets of constraints with the same number of rows, their indices (m,) and the
    derivatives D (m, r, 6) of their residuals in the twist of frame B against frame A, in A. Along a coordinate k, which
    moves a body with the twist S_k of its tree frame, that makes A_k = D Ad(T_A)^-1 (S_k if it moves B, less S_k if it moves
    A); coordinates that move both drop out.
    """
    frames, n = _both_frames(members, system, q), len(members)
    rotation, position, across = _seen_from_a(frames)
    inverse = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))
    by_a = inverse(frames.pose[:n])
    # The same frames A, seen from the trees of frames B.
    by_b = inverse(frames.pose[:n].at[:, :3, 3].add(-across))
    moves_a, moves_b = frames.moves[:n], frames.moves[n:]
    sides = [
        (sign, mask, adjoint)
        for sign, mask, adjoint in ((1, moves_b & ~moves_a, by_b), (-1, moves_a & ~moves_b, by_a))
        if mask.any()
    ]
    found: list = [None] * n
    for index, derivative in derivatives(rotation, position):
        columns = jnp.zeros((*derivative.shape[:2], len(frames.coordinates)), q.dtype)
        for sign, mask, adjoint in sides:
            part = _product(_product(derivative, take(adjoint, index)), frames.subspace.T)
            columns = columns + part * jnp.asarray(sign * mask[index][:, None, :], q.dtype)
        everywhere = np.array_equal(frames.coordinates, np.arange(system.nv))
        if not everywhere:
            wide = jnp.zeros((*derivative.shape[:2], system.nv), q.dtype)
            columns = wide.at[:, :, frames.coordinates].set(columns)
        for k, i in enumerate(index):
            found[i] = columns[k]
    return found
