"""Constraints between two frames on bodies, from one pass of the kinematics; forces and wrenches from multipliers.

Only the residual of each constraint, a function of one pose, is differentiated: there is no pass of the kinematics for each row,
and none for its rates.

Let V_A and V_B be the twists of the frames in the axes of A at its origin, and a dot their rates at a = 0. Seen from A, frame
B moves along the twist t U + t^2/2 U' with U = V_B - V_A and U' = Vdot_B - Vdot_A - [V_A, V_B], up to third order in t (Baker,
Campbell, Hausdorff). With D and H the first and second derivative of a residual along a twist:

    velocity = D U,  gamma = -(D U' + H(U, U)),  A_k = D Ad(T_A)^-1 (S_k if k moves B, less S_k if it moves A).

Coordinates that move both frames drop out of A exactly. A velocity residual w(R, p, U), linear in U, has D = dw/dU and
gamma = -dw/dt.
"""

from collections.abc import Callable, Hashable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import Constraint, constraint_jacobian, layout
from jaxdyn.dynamics.kinematics import BodyFrames, body_frames
from jaxdyn.dynamics.tree_frames import take
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers, SystemLike, as_shape, check_shapes, check_state
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene


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


def _poses_in_a(frames: BodyFrames):
    """Rotations (n, 3, 3) and positions (n, 3) of frames B seen from frames A, and the displacement between their trees (n, 3).

    Positions are subtracted tree by tree: a robot far from the world's origin loses nothing.
    """
    n = len(frames.velocity_mask) // 2
    transpose = jnp.swapaxes(frames.pose[:n, :3, :3], 1, 2)
    across = frames.origin[n:] - frames.origin[:n]
    between = frames.pose[n:, :3, 3] - frames.pose[:n, :3, 3] + across
    return matmul(transpose, frames.pose[n:, :3, :3]), matmul(transpose, between[..., None])[..., 0], across


def _adjoints_to_a(frames: BodyFrames, across):
    """Ad(T_A)^-1 (n, 6, 6), which brings twists into frames A: from the trees of frames A, and from those of frames B."""
    inverse = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))
    n = len(across)
    return inverse(frames.pose[:n]), inverse(frames.pose[:n].at[:, :3, 3].add(-across))


class Pair(Constraint):
    """A constraint on the pose (R, p) and on the twist U of frame B seen from frame A.

    Subclasses say where the frames are, and give one or both residuals.
    """

    def ends(self) -> tuple[tuple[str | None, Array], tuple[str | None, Array]]:
        """Frames A and B, each a body or frame (None: the world) and a pose (4, 4) in it."""
        raise NotImplementedError

    def resolve(self, system: SystemLike) -> "Pair":
        """The constraint with all of its data, for one that is an index into those of the system."""
        return self

    def pose_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Array | None:
        """Residual (nh,) of the holonomic part, or None without one."""
        return None

    def twist_residual(self, R: Float[Array, "3 3"], p: Float[Array, "3"], U: Float[Array, "6"]) -> Array | None:
        """Residual (np,) of the nonholonomic part, linear in U, or None without one."""
        return None

    def at(self, system: SystemLike, q: Float[Array, " nq"]) -> "Pair":
        """The constraint at q, for one that depends on q by more than the poses of its frames."""
        return self

    def structure_key(self) -> tuple:
        """Static part of the constraint: members of one class with equal keys are evaluated as one batch."""
        raise NotImplementedError

    def group(self) -> Hashable:
        """One key for all: they share one pass of the kinematics."""
        return "pairs"

    def position(self, system: SystemLike, q: Float[Array, " nq"], t: Number) -> Array | None:
        """Residual of the holonomic part, (nh,)."""
        return self.group_positions([self], system, q, t)[0]

    def velocity(self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array | None:
        """Residual of the nonholonomic part, (np,)."""
        holonomic, nonholonomic = self.sizes(system, q.dtype)
        return self.group_rows([self], system, q, v, t)[0][2][holonomic:] if nonholonomic else None

    def wrench(self, R: Float[Array, "3 3"], p: Float[Array, "3"], lam: Float[Array, " r"]) -> Float[Array, "6"]:
        """Wrench (f, tau) (6,) on body B for the multipliers lam, at the origin and in the axes of frame A.

        `R` (3, 3), `p` (3,): pose of frame B seen from frame A. The wrench on body A is the negative of it.
        """
        return matmul(lam, _directions(self, R, p))

    @classmethod
    def group_positions(cls, members: Sequence["Pair"], system: SystemLike, q: Float[Array, " nq"], t: Number) -> list:
        """Residuals (nh,) of each constraint, None without one."""
        return _group_positions(tuple(members), system, q)

    @classmethod
    def group_rows(
        cls, members: Sequence["Pair"], system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> list:
        """A (r, nv), gamma (r,) and velocity (r,) of each constraint."""
        return _group_rows(tuple(members), system, q, v)


def _group_positions(members: tuple[Pair, ...], system, q) -> list:
    members = tuple(member.at(system, q) for member in members)
    return each(members, lambda one, R, p: one.pose_residual(R, p), *relative_poses(members, system, q))


def _group_rows(members: tuple[Pair, ...], system, q, v) -> list:
    members = tuple(member.at(system, q) for member in members)
    frames, n = _both_frames(members, system, q, v), len(members)
    rotation, position, across = _poses_in_a(frames)
    by_a, by_b = _adjoints_to_a(frames, across)
    assert frames.twist is not None and frames.bias is not None
    twists = jnp.stack([frames.twist, frames.bias], axis=-1)
    of_a, of_b = matmul(by_a, twists[:n]), matmul(by_b, twists[n:])
    relative = of_b - of_a
    # U' of the module's text: the bracket is the second order of the logarithm of the relative motion.
    rate = relative[:, :, 1] - jax.vmap(se3.ad_apply)(of_a[:, :, 0], of_b[:, :, 0])
    # Masks of coordinates, known while tracing. Those that move both frames cancel in A v to rounding only; here they are absent,
    # so that the entries are exact zeros, and a robot's fast base leaves no noise in the rows of its gripper.
    moves_a, moves_b = frames.velocity_mask[:n], frames.velocity_mask[n:]
    sides = ((1, moves_b & ~moves_a, by_b), (-1, moves_a & ~moves_b, by_a))
    motions: list = [None] * n
    for index, build, leaves in _batches(members):
        at = [take(x, index) for x in (rotation, position, relative[:, :, 0], rate)]
        rates = jax.vmap(lambda leaves, *at, build=build: _rates(build(leaves), *at))
        D, gamma, velocity = rates(leaves, *at)
        columns = jnp.zeros((*D.shape[:2], len(frames.coordinates)), q.dtype)
        for sign, mask, adjoint in sides:
            if mask[index].any():
                left = matmul(D, take(adjoint, index))
                columns = columns + sign * _masked_columns(left, frames.subspace, mask[index])
        if len(frames.coordinates) < system.nv:
            # The pass went through the bodies between the frames alone; other coordinates have columns of zeros.
            wide = jnp.zeros((*D.shape[:2], system.nv), q.dtype)
            columns = wide.at[:, :, frames.coordinates].set(columns)
        for k, i in enumerate(index):
            motions[i] = columns[k], gamma[k], velocity[k]
    return motions


def _masked_columns(left, subspace, mask: np.ndarray):
    """Products (n, r, nv) of left (n, r, 6) with the screws (nv, 6) of the coordinates, zero where not mask (n, nv)."""
    # By those columns alone that the mask leaves: of a large mechanism they are few.
    count = mask.sum(1).max()
    index = np.argsort(~mask, axis=1, kind="stable")[:, :count]
    product = matmul(left, jnp.swapaxes(subspace[index], 1, 2))
    product = product * jnp.asarray(np.take_along_axis(mask, index, 1)[:, None, :], left.dtype)
    rows, zero = np.ogrid[: left.shape[0], : left.shape[1], :1], jnp.zeros((*left.shape[:2], len(subspace)), left.dtype)
    return zero.at[rows[0], rows[1], index[:, None, :]].set(product)


def relative_poses(members, system, q):
    """Rotations (n, 3, 3) and positions (n, 3) of frame B seen from frame A, for constraints with bodies and poses."""
    return _poses_in_a(_both_frames(members, system, q))[:2]


def relative_motions(members, system, q, v):
    """`relative_poses`, and the twists (n, 6) of frame B against frame A, at the origin and in the axes of A."""
    frames, n = _both_frames(members, system, q, v), len(members)
    rotation, position, across = _poses_in_a(frames)
    assert frames.twist is not None
    by_a, by_b = _adjoints_to_a(frames, across)
    twist_a, twist_b = frames.twist[:n, :, None], frames.twist[n:, :, None]
    return rotation, position, (matmul(by_b, twist_b) - matmul(by_a, twist_a))[..., 0]


def each(members: Sequence[Pair], function, *rows) -> list:
    """function(member, row of each of `rows`) for every constraint, those of equal structure as one batch."""
    results: list = [None] * len(members)
    for index, build, leaves in _batches(members):
        values = jax.vmap(lambda leaves, *at, build=build: function(build(leaves), *at))(
            leaves, *(take(x, index) for x in rows)
        )
        for k, i in enumerate(index):
            results[i] = jax.tree.map(lambda x, k=k: x[k], values)
    return results


def _batches(members: Sequence[Pair]):
    """Batches of members of equal structure: their indices, a function from array leaves to a member, stacked leaves."""
    # Eight loops of one kind are one batch of eight: the program does not grow with their number.
    sets: dict = {}
    for i, member in enumerate(members):
        sets.setdefault((type(member), member.structure_key()), []).append(i)
    for places in sets.values():
        structure = jax.tree.structure(members[places[0]])
        leaves = [jnp.stack(x) for x in zip(*(jax.tree.leaves(members[i]) for i in places), strict=True)]
        yield np.array(places), lambda leaves, structure=structure: jax.tree.unflatten(structure, leaves), leaves


def displace_pose(R, p, twist):
    """Pose of frame B after it has moved along a small twist, seen from frame A: exp(twist) up to second order.

    Only first and second derivatives at twist = 0 are taken, and these are exact.
    """
    # Not `se3.exp`, whose series and branches near zero would be differentiated twice for each row.
    hat = so3.hat(twist[3:])
    dp, dR = twist[:3] + matmul(hat, p), matmul(hat, R)
    return R + dR + 0.5 * matmul(hat, dR), p + dp + 0.5 * matmul(hat, dp)


def _directions(pair: Pair, R, p) -> Float[Array, "r 6"]:
    """Rows D (r, 6): the rates of the residuals are D U."""
    zero = jnp.zeros((6,), p.dtype)
    residual = jax.eval_shape(pair.pose_residual, R, p)
    parts = (
        [] if residual is None else [jax.jacfwd(lambda twist: pair.pose_residual(*displace_pose(R, p, twist)))(zero)]
    )
    if jax.eval_shape(pair.twist_residual, R, p, zero) is not None:
        parts.append(jax.jacfwd(lambda U: pair.twist_residual(R, p, U))(zero))
    return jnp.concatenate(parts)


def _rates(pair: Pair, R, p, U, rate):
    """D (r, 6), gamma (r,) and velocity (r,) for the twist U and its rate U'."""
    zero = jnp.zeros((6,), U.dtype)
    D = _directions(pair, R, p)
    parts = []
    if jax.eval_shape(pair.pose_residual, R, p) is not None:

        def residual(twist):
            return pair.pose_residual(*displace_pose(R, p, twist))

        # H(U, U): the second derivative along U alone, without the Hessian.
        parts.append(jax.jvp(lambda twist: jax.jvp(residual, (twist,), (U,))[1], (zero,), (U,))[1])
    if jax.eval_shape(pair.twist_residual, R, p, U) is not None:
        parts.append(jax.jvp(lambda twist: pair.twist_residual(*displace_pose(R, p, twist), U), (zero,), (U,))[1])
    return D, -(matmul(D, rate) + jnp.concatenate(parts)), matmul(D, U)


# Generalised force and wrench of each constraint, from the multipliers.


def constraint_forces(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"], t: Numbers = 0.0
) -> dict[str, Float[Array, " nv"]]:
    r"""Generalised force of each constraint on the system, by name.

    $$\tau_i = A_i^T \lambda_i$$

    **Arguments:** `q` (nq,); `multipliers` (nc,), those of `constrained_dynamics` or of the output "multipliers" of `simulate`.

    **Returns:** a dictionary of arrays (nv,), N m or N.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS section 7.

    ```python
    dynamics = jd.constrained_dynamics(scene, q, v)
    pushes = jd.constraint_forces(scene, q, dynamics.multipliers)
    ```
    """
    scene = as_scene(scene)
    A = constraint_jacobian(scene, q, t)
    multipliers = as_shape(multipliers, "multipliers", A.dtype, A.shape[:1], of=", one per row")
    return {p.name: matmul(A[p.start : p.end].T, multipliers[p.start : p.end]) for p in layout(scene)}


def constraint_wrenches(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"]
) -> dict[str, Float[Array, "6"]]:
    """Wrench (f, tau) of each constraint between two frames on its body B, at the origin and in the axes of its frame A.

    The wrench on body A is the negative of it. A loop has its frames A and B as given; for a rolling
    contact A is on the surface and B on the body that rolls, for a contact of a grasp A is on the object and B on the finger.
    Constraints that are not between two frames have no entry.

    **Arguments:** `q` (nq,); `multipliers` (nc,), as in `constraint_forces`.

    **Returns:** a dictionary of arrays (6,), N and N m, by the constraints' names.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS sections 3 (wrenches) and 7.
    """
    scene, wrenches = as_scene(scene), {}
    (q,) = check_state(scene.system, q=q)
    places = layout(scene)
    count = places[-1].end if places else 0
    multipliers = as_shape(multipliers, "multipliers", q.dtype, (count,), of=", one per row")
    for constraint, place in zip(scene.constraints, places, strict=True):
        if isinstance(constraint, Pair):
            constraint = constraint.at(scene.system, q)
            rotation, position = relative_poses([constraint], scene.system, q)
            wrenches[place.name] = constraint.wrench(rotation[0], position[0], multipliers[place.start : place.end])
    return wrenches


def body_wrenches(scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"]) -> Float[Array, "nb 6"]:
    r"""Wrench (f, tau) of all constraints between two frames ON each body, at its frame's origin and in its axes.

    They are the `external` of `joint_wrench`, `inverse_dynamics` and `generalized_force`, whose result for them is
    $A^T \lambda$ of these constraints. Gears and locked joints act through the joints, and functions of the user on
    coordinates: they have no wrench here.

    **Arguments:** `scene` of a `Model`; `q` (nq,); `multipliers` (nc,), as in `constraint_forces`.

    **Returns:** (nb, 6), N and N m, in the order of `model.body_names`.

    **Raises:** ValueError for shapes that do not fit, and for a system without bodies.

    Source: EQUATIONS sections 3 (wrenches) and 7.

    ```python
    dynamics = jd.constrained_dynamics(scene, q, v)
    pull = jd.constraints.body_wrenches(scene, q, dynamics.multipliers)
    bearings = jd.dynamics.joint_wrench(scene.system, q, v, dynamics.acceleration, external=pull)
    ```
    """
    scene = as_scene(scene)
    (q,) = check_shapes(scene.system, q=q)
    return body_wrenches_where(scene, q, multipliers, lambda frame: True)


def body_wrenches_where(scene: Scene, q, multipliers, counts: Callable[[str], bool]) -> Float[Array, "nb 6"]:
    """`body_wrenches` on those frames alone whose name counts."""
    wrenches = constraint_wrenches(scene, q, multipliers)
    total = jnp.zeros((scene.system.nb, 6), q.dtype)
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        if not isinstance(constraint, Pair):
            continue
        constraint, wrench = constraint.at(scene.system, q), wrenches[place.name]
        rotation, position = relative_poses([constraint], scene.system, q)
        # Action and reaction act at one point of the world: the wrench is moved from the origin of A to that of B.
        at_b = se3.AdT_apply(se3.from_parts(rotation[0], position[0]), wrench)
        ends = constraint.ends()
        bodies, poses = places_on(scene.system, [body for body, _ in ends], [pose for _, pose in ends], q.dtype)
        for (frame, _), body, pose, pull in zip(ends, bodies, poses, (-wrench, at_b), strict=True):
            if body >= 0 and counts(str(frame)):
                total = total.at[body].add(se3.Ad_inv_T_apply(pose, pull))
    return total
