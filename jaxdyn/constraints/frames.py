"""Frames on bodies, one seen from another, and how fast each coordinate moves them against each other."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jaxdyn import se3
from jaxdyn.kinematics import Carried, carried, take
from jaxdyn.model import Model, frame_index
from jaxdyn.so3 import _product


def frames_on(model: Model, q, bodies: Sequence[str | None], poses, v=None) -> Carried:
    """Frames at the given poses (4, 4) in bodies or named frames (None: the world); with v, their twists too."""
    offsets = jnp.stack([pose.astype(q.dtype) for pose in poses])
    places = []
    for k, body in enumerate(bodies):
        index = None if body is None else frame_index(model, body)
        places.append(-1 if index is None else model.topology.frame_bodies[index])
        if index is not None and body not in model.body_names:
            offsets = offsets.at[k].set(_product(model.frame_poses[index].astype(q.dtype), offsets[k]))
    found = carried(model, q, places, v)
    return found._replace(pose=_product(found.pose, offsets))


def _both_frames(members, system, q, v=None) -> Carried:
    """Frames A of all the constraints, then frames B."""
    bodies = [m.body_a for m in members] + [m.body_b for m in members]
    return frames_on(system, q, bodies, [m.pose_a for m in members] + [m.pose_b for m in members], v)


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


def motion_by_twists(members, sets, displaced: Callable, system, q, v) -> list:
    """A (r, nv), gamma (r,) and velocity (r,) of constraints on the relative pose of two frames.

    Nothing is differentiated but the residual: no pass of the kinematics for each row, none for its rates. `sets` are index
    arrays of constraints that are computed together, and `displaced(i)` the function (twist, rotation, position) -> (r,): the
    residual of constraint i after frame B has moved along a twist, seen from frame A.

    Let V_A and V_B be the twists of the frames in the axes of A at its origin, and a dot their rates at a = 0. Seen from A,
    frame B moves along the twist t U + t^2/2 U' with U = V_B - V_A and U' = Vdot_B - Vdot_A - [V_A, V_B], up to third order
    in t (Baker, Campbell, Hausdorff). With D and H the first and second derivative of the residual along a twist:

        velocity = D U,  gamma = -(D U' + H(U, U)),  A_k = D Ad(T_A)^-1 (S_k if k moves B, less S_k if it moves A).

    Coordinates that move both frames drop out of A exactly.
    """
    frames, n = _both_frames(members, system, q, v), len(members)
    rotation, position, across = _seen_from_a(frames)
    inverse = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))
    by_a = inverse(frames.pose[:n])
    # The same frames A, seen from the trees of frames B.
    by_b = inverse(frames.pose[:n].at[:, :3, 3].add(-across))
    assert frames.twist is not None and frames.bias is not None
    twists = jnp.stack([frames.twist, frames.bias], axis=-1)
    moved_a, moved_b = _product(by_a, twists[:n]), _product(by_b, twists[n:])
    apart = moved_b - moved_a
    turning = apart[:, :, 1] - jax.vmap(se3.ad_apply)(moved_a[:, :, 0], moved_b[:, :, 0])
    moves_a, moves_b = frames.moves[:n], frames.moves[n:]
    sides = ((1, moves_b & ~moves_a, by_b), (-1, moves_a & ~moves_b, by_a))
    found: list = [None] * n
    for index in sets:
        residual = displaced(index[0])

        def rates(rotation, position, U, bend, residual=residual):
            def moved(twist):
                return residual(twist, rotation, position)

            zero = jnp.zeros((6,), U.dtype)
            D = jax.jacfwd(moved)(zero)
            bent = jax.jvp(lambda twist: jax.jvp(moved, (twist,), (U,))[1], (zero,), (U,))[1]
            return D, -(_product(D, bend) + bent), _product(D, U)

        at = [take(x, index) for x in (rotation, position, apart[:, :, 0], turning)]
        D, gamma, velocity = jax.vmap(rates)(*at)
        columns = jnp.zeros((*D.shape[:2], len(frames.coordinates)), q.dtype)
        for sign, mask, adjoint in sides:
            if mask[index].any():
                part = _product(_product(D, take(adjoint, index)), frames.subspace.T)
                columns = columns + part * jnp.asarray(sign * mask[index][:, None, :], q.dtype)
        if len(frames.coordinates) < system.nv:
            wide = jnp.zeros((*D.shape[:2], system.nv), q.dtype)
            columns = wide.at[:, :, frames.coordinates].set(columns)
        for k, i in enumerate(index):
            found[i] = columns[k], gamma[k], velocity[k]
    return found
