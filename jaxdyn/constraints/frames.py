"""Constraints between two frames on bodies: one pass of the kinematics gives the rows, rates and residuals of all of them.

Nothing is differentiated but the few numbers of each constraint: no pass of the kinematics for each row, none for its rates.

Let V_A and V_B be the twists of the frames in the axes of A at its origin, and a dot their rates at a = 0. Seen from A, frame
B moves along the twist t U + t^2/2 U' with U = V_B - V_A and U' = Vdot_B - Vdot_A - [V_A, V_B], up to third order in t (Baker,
Campbell, Hausdorff). With D and H the first and second derivative of a residual along a twist:

    velocity = D U,  gamma = -(D U' + H(U, U)),  A_k = D Ad(T_A)^-1 (S_k if k moves B, less S_k if it moves A).

Coordinates that move both frames drop out of A exactly. A velocity residual w(R, p, U), linear in U, has D = dw/dU and
gamma = -dw/dt.
"""

from collections.abc import Hashable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import variant
from jaxdyn.constraints.base import Constraint
from jaxdyn.dynamics.kinematics import BodyFrames, body_frames, take
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, SystemLike
from jaxdyn.model.names import frame_index
from jaxdyn.model.tree import Model


def frames_on(model: Model, q, bodies: Sequence[str | None], poses, v=None) -> BodyFrames:
    """Frames at the given poses (4, 4) in bodies or named frames (None: the world); with v, their twists too."""
    places, offsets = places_on(model, bodies, poses, q.dtype)
    frames = body_frames(model, q, places, v)
    return frames._replace(pose=matmul(frames.pose, offsets))


def places_on(model: Model, bodies: Sequence[str | None], poses, dtype) -> tuple[list[int], Float[Array, "n 4 4"]]:
    """The bodies (-1: the world) that carry frames at given poses (4, 4) in bodies or named frames, and the poses in these."""
    offsets, places = jnp.stack([pose.astype(dtype) for pose in poses]), []
    for k, body in enumerate(bodies):
        index = None if body is None else frame_index(model, body)
        places.append(-1 if index is None else model.topology.frame_bodies[index])
        if index is not None and body not in model.body_names:
            offsets = offsets.at[k].set(matmul(model.frame_poses[index].astype(dtype), offsets[k]))
    return places, offsets


def _both_frames(members, system, q, v=None) -> BodyFrames:
    """Frames A of all the constraints, then frames B."""
    ends = [member.ends()[side] for side in (0, 1) for member in members]
    return frames_on(system, q, [body for body, _ in ends], [pose for _, pose in ends], v)


def _seen_from_a(frames: BodyFrames):
    """Rotations (n, 3, 3) and positions (n, 3) of frames B seen from frames A, and the displacement between their trees (n, 3).

    Positions are subtracted tree by tree: a robot far from the world's origin loses nothing.
    """
    n = len(frames.velocity_mask) // 2
    turned = jnp.swapaxes(frames.pose[:n, :3, :3], 1, 2)
    across = frames.origin[n:] - frames.origin[:n]
    between = frames.pose[n:, :3, 3] - frames.pose[:n, :3, 3] + across
    return matmul(turned, frames.pose[n:, :3, :3]), matmul(turned, between[..., None])[..., 0], across


class Pair(Constraint):
    """A constraint on the pose (R, p) and on the twist U of frame B seen from frame A.

    Subclasses say where the frames are, and give one or both residuals.
    """

    def ends(self) -> tuple[tuple[str | None, Array], tuple[str | None, Array]]:
        """Frames A and B, each a body or frame (None: the world) and a pose (4, 4) in it."""
        raise NotImplementedError

    def declared(self, system: SystemLike) -> "Pair":
        """The constraint as it was given to the system, where its rows are known by a number alone."""
        return self

    def pose_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Array | None:
        """Residual (nh,) of the holonomic part, or None without one."""
        return None

    def twist_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"], U: Float[Array, "6"]) -> Array | None:
        """Residual (np,) of the nonholonomic part, linear in U, or None without one."""
        return None

    def at(self, system: SystemLike, q: Float[Array, " nq"]) -> "Pair":
        """The constraint with what it reads from the system and from q itself, beside the poses of its frames."""
        return self

    def structure_key(self) -> tuple:
        """Members of one class with equal keys differ in numbers alone; they are evaluated as one batch."""
        raise NotImplementedError

    def group(self) -> Hashable:
        """All are evaluated on one pass of the kinematics."""
        return "pairs"

    def position(self, system: SystemLike, q: Float[Array, " nq"], t: Number) -> Array | None:
        """Residual of the holonomic part, (nh,)."""
        return self.grouped_position([self], system, q, t)[0]

    def velocity(self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array | None:
        """Residual of the nonholonomic part, (np,)."""
        holonomic, nonholonomic = self.sizes(system, q.dtype)
        return self.grouped_motion([self], system, q, v, t)[0][2][holonomic:] if nonholonomic else None

    def wrench(self, R: Float[Array, "3 3"], p: Float[Array, "3"], lam: Float[Array, " r"]) -> Float[Array, "6"]:
        """Wrench (f, tau) (6,) on body B for the multipliers lam, at the origin and in the axes of frame A.

        `R` (3, 3), `p` (3,): pose of frame B seen from frame A. The wrench on body A is the negative of it.
        """
        return matmul(lam, _directions(self, R, p))

    @classmethod
    def grouped_position(cls, members: Sequence["Pair"], system: SystemLike, q: Float[Array, " nq"], t: Number) -> list:
        """Residuals (nh,) of each constraint, None without one."""
        return _positions(tuple(members), system, q)

    @classmethod
    def grouped_motion(
        cls, members: Sequence["Pair"], system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> list:
        """A (r, nv), gamma (r,) and velocity (r,) of each constraint."""
        return _motions(tuple(members), system, q, v)


def _positions_of(members: tuple[Pair, ...], system, q) -> list:
    members = tuple(member.at(system, q) for member in members)
    rotation, position = relative_poses(members, system, q)
    residuals: list = [None] * len(members)
    for index, build, leaves in _batches(members):
        if members[index[0]].sizes(system, q.dtype)[0]:
            values = jax.vmap(lambda leaves, R, p, build=build: build(leaves).pose_residual(R, p))(
                leaves, take(rotation, index), take(position, index)
            )
            for k, i in enumerate(index):
                residuals[i] = values[k]
    return residuals


def _motions_of(members: tuple[Pair, ...], system, q, v) -> list:
    members = tuple(member.at(system, q) for member in members)
    frames, n = _both_frames(members, system, q, v), len(members)
    rotation, position, across = _seen_from_a(frames)
    inverse = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))
    by_a = inverse(frames.pose[:n])
    # The same frames A, seen from the trees of frames B.
    by_b = inverse(frames.pose[:n].at[:, :3, 3].add(-across))
    assert frames.twist is not None and frames.bias is not None
    twists = jnp.stack([frames.twist, frames.bias], axis=-1)
    moved_a, moved_b = matmul(by_a, twists[:n]), matmul(by_b, twists[n:])
    relative = moved_b - moved_a
    turning = relative[:, :, 1] - jax.vmap(se3.ad_apply)(moved_a[:, :, 0], moved_b[:, :, 0])
    moved_by_a, moved_by_b = frames.velocity_mask[:n], frames.velocity_mask[n:]
    sides = ((1, moved_by_b & ~moved_by_a, by_b), (-1, moved_by_a & ~moved_by_b, by_a))
    motions: list = [None] * n
    for index, build, leaves in _batches(members):
        at = [take(x, index) for x in (rotation, position, relative[:, :, 0], turning)]
        rates = jax.vmap(lambda leaves, *at, build=build: _rates(build(leaves), *at))
        D, gamma, velocity = rates(leaves, *at)
        columns = jnp.zeros((*D.shape[:2], len(frames.coordinates)), q.dtype)
        for sign, mask, adjoint in sides:
            if mask[index].any():
                part = matmul(matmul(D, take(adjoint, index)), frames.subspace.T)
                columns = columns + part * jnp.asarray(sign * mask[index][:, None, :], q.dtype)
        if len(frames.coordinates) < system.nv:
            wide = jnp.zeros((*D.shape[:2], system.nv), q.dtype)
            columns = wide.at[:, :, frames.coordinates].set(columns)
        for k, i in enumerate(index):
            motions[i] = columns[k], gamma[k], velocity[k]
    return motions


# A program that asks many times, as steps with projections do, traces each of these once. A nested `jit` would hide what is
# known.
# Outside of kernels they are traced once, for all calls of all constraints of a scene.
_positions = variant(_positions_of)(eqx.filter_jit(_positions_of))
_motions = variant(_motions_of)(eqx.filter_jit(_motions_of))


def relative_poses(members, system, q):
    """Rotations (n, 3, 3) and positions (n, 3) of frame B seen from frame A, for constraints with bodies and poses."""
    return _seen_from_a(_both_frames(members, system, q))[:2]


def relative_motions(members, system, q, v):
    """`relative_poses`, and the twists (n, 6) of frame B against frame A, at the origin and in the axes of A."""
    frames, n = _both_frames(members, system, q, v), len(members)
    rotation, position, across = _seen_from_a(frames)
    assert frames.twist is not None
    inverse = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))
    by_a, by_b = inverse(frames.pose[:n]), inverse(frames.pose[:n].at[:, :3, 3].add(-across))
    twist_a, twist_b = frames.twist[:n, :, None], frames.twist[n:, :, None]
    return rotation, position, (matmul(by_b, twist_b) - matmul(by_a, twist_a))[..., 0]


def each(members: Sequence[Pair], function, *rows) -> list:
    """function(member, row of each of `rows`) for every constraint, those that differ in numbers alone as one batch."""
    motions: list = [None] * len(members)
    for index, build, leaves in _batches(members):
        values = jax.vmap(lambda leaves, *at, build=build: function(build(leaves), *at))(
            leaves, *(take(x, index) for x in rows)
        )
        for k, i in enumerate(index):
            motions[i] = jax.tree.map(lambda x, k=k: x[k], values)
    return motions


def _batches(members: Sequence[Pair]):
    """Members that differ in numbers alone: their indices, a function that makes one of them of its numbers, all numbers."""
    sets: dict = {}
    for i, member in enumerate(members):
        sets.setdefault((type(member), member.structure_key()), []).append(i)
    for places in sets.values():
        structure = jax.tree.structure(members[places[0]])
        leaves = [jnp.stack(x) for x in zip(*(jax.tree.leaves(members[i]) for i in places), strict=True)]
        yield np.array(places), lambda leaves, structure=structure: jax.tree.unflatten(structure, leaves), leaves


def displaced(R, p, twist):
    """Pose of frame B after it has moved along a small twist, seen from frame A: exp(twist) up to second order.

    Only first and second derivatives at twist = 0 are taken, and these are exact.
    """
    turn = so3.hat(twist[3:])
    first = twist[:3] + matmul(turn, p)
    turned = matmul(turn, R)
    return R + turned + 0.5 * matmul(turn, turned), p + first + 0.5 * matmul(turn, first)


def _directions(pair: Pair, R, p) -> Float[Array, "r 6"]:
    """Rows D (r, 6): the rates of the residuals are D U."""
    zero = jnp.zeros((6,), p.dtype)
    residual = jax.eval_shape(pair.pose_residual, R, p)
    parts = [] if residual is None else [jax.jacfwd(lambda twist: pair.pose_residual(*displaced(R, p, twist)))(zero)]
    if jax.eval_shape(pair.twist_residual, R, p, zero) is not None:
        parts.append(jax.jacfwd(lambda U: pair.twist_residual(R, p, U))(zero))
    return jnp.concatenate(parts)


def _rates(pair: Pair, R, p, U, bend):
    """D (r, 6), gamma (r,) and velocity (r,) for the twist U and its rate `bend`."""
    zero = jnp.zeros((6,), U.dtype)
    D = _directions(pair, R, p)
    parts = []
    if jax.eval_shape(pair.pose_residual, R, p) is not None:

        def moved(twist):
            return pair.pose_residual(*displaced(R, p, twist))

        parts.append(jax.jvp(lambda twist: jax.jvp(moved, (twist,), (U,))[1], (zero,), (U,))[1])
    if jax.eval_shape(pair.twist_residual, R, p, U) is not None:
        parts.append(jax.jvp(lambda twist: pair.twist_residual(*displaced(R, p, twist), U), (zero,), (U,))[1])
    return D, -(matmul(D, bend) + jnp.concatenate(parts)), matmul(D, U)
