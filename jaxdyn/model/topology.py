"""Kinds of joints as data, and the static part of a mechanism: its tree of bodies, names and derived tables, `Topology`.

A joint places its body frame in the parent body frame at `home @ joint_transform(q)`. Every one-degree-of-freedom joint
is the exponential of a constant screw (Murray, Li & Sastry 1994, eq. 2.40 and 3.4), so revolute, prismatic and helical
joints share one code path; the other kinds have a constant motion subspace in the body frame.

| kind       | nq | nv | q                        | v (in the body frame)           |
|------------|----|----|--------------------------|---------------------------------|
| revolute   | 1  | 1  | angle                    | rate about the screw axis       |
| continuous | 1  | 1  | angle, no limits         | rate about the screw axis       |
| prismatic  | 1  | 1  | displacement             | rate along the screw direction  |
| helical    | 1  | 1  | angle                    | rate of the screw, any pitch    |
| planar     | 3  | 3  | x, y, theta              | vx, vy, thetadot                |
| spherical  | 4  | 3  | quaternion w, x, y, z    | angular velocity                |
| free       | 7  | 6  | x, y, z, qw, qx, qy, qz  | twist (linear, angular)         |
"""

import dataclasses
import difflib
import itertools
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.lie import se2, se3, so3
from jaxdyn.model.arguments import check_name


class JointKind(NamedTuple):
    """Sizes of a joint kind; `columns` are the body-frame coordinates (v, omega) that the joint moves, if fixed."""

    nq: int
    nv: int
    columns: tuple[int, ...]


# Columns are empty where a screw, a leaf of the model, gives the subspace.
KINDS: dict[str, JointKind] = {
    "revolute": JointKind(1, 1, ()),
    "continuous": JointKind(1, 1, ()),
    "prismatic": JointKind(1, 1, ()),
    "helical": JointKind(1, 1, ()),
    "planar": JointKind(3, 3, (0, 1, 5)),
    "spherical": JointKind(4, 3, (3, 4, 5)),
    "free": JointKind(7, 6, (0, 1, 2, 3, 4, 5)),
}
SCREW_KINDS = ("revolute", "continuous", "prismatic", "helical")


def screw_mask(kind: str) -> np.ndarray:
    """Mask (6,) of the entries of a joint's screw that its kind uses.

    A revolute axis passes through the body's origin and a prismatic joint does not rotate, by declaration; other screws are
    helical joints.
    """
    # By kind and not by value: a mask from numbers would recompile, or go stale when a leaf changes.
    turns, slides = kind in ("revolute", "continuous", "helical"), kind in ("prismatic", "helical")
    return np.repeat([slides, turns], 3)


def joint_transform(kind: str, screw: Float[Array, "6"], q: Float[Array, " nqj"]) -> Float[Array, "4 4"]:
    """Pose of the body frame relative to its home pose, exp(hat(screw) q) for the screw kinds.

    Quaternions are divided by their norm, so that a slightly drifted one still gives a rotation.
    """
    if kind in SCREW_KINDS:
        return screw_transform(kind, screw, q[0])
    # The rows are written out: a product of exponentials would cost three times as many operations.
    zero = jnp.zeros_like(q[0])
    if kind == "planar":
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        one = jnp.ones_like(c)
        return jnp.stack([c, -s, zero, q[0], s, c, zero, q[1], zero, zero, one, zero, zero, zero, zero, one]).reshape(
            4, 4
        )
    if kind == "spherical":
        return se3.from_parts(so3.quat_to_matrix(q), jnp.stack([zero, zero, zero]))
    return se3.from_parts(so3.quat_to_matrix(q[3:]), q[:3])


def screw_transform(kind: str, screw: Float[Array, "6"], q: Float[Array, ""]) -> Float[Array, "4 4"]:
    """Screw motion exp(hat(screw) q) of a joint with one degree of freedom; its kind, not its numbers, selects the formula.

    With the axis u = omega/|omega|: R = u u^T + cos (1 - u u^T) + sin hat(u), and p = (1 - R)(u x v)/|omega| + u (u . v) q.
    """
    v, omega = screw[:3], screw[3:]
    if kind == "prismatic":
        return se3.from_parts(jnp.eye(3, dtype=screw.dtype), v * q)
    rate = jnp.sqrt(jnp.sum(omega * omega))
    # The screw need not be of unit length here: derivatives with respect to the leaf go through the normalisation.
    axis = omega / rate
    along = axis[:, None] * axis[None]
    across = jnp.eye(3, dtype=screw.dtype) - along
    rotation = along + jnp.cos(rate * q) * across + jnp.sin(rate * q) * so3.hat(axis)
    # p = (1 - R) (u x v)/|omega| vanishes on an axis through the origin, as declared for revolute joints.
    if kind != "helical":
        return se3.from_parts(rotation, jnp.zeros_like(v))
    lever = so3.cross(axis, v) / rate
    return se3.from_parts(rotation, lever - so3.matmul(rotation, lever) + axis * (jnp.sum(axis * v) * q))


def joint_neutral(kind: str) -> np.ndarray:
    """Configuration at which the joint transform is the identity, (nq of the joint,)."""
    q = np.zeros(KINDS[kind].nq)
    if kind == "spherical":
        q[0] = 1.0
    elif kind == "free":
        q[3] = 1.0
    return q


@entry_point
def joint_integrate(kind: str, q: Float[Array, " nqj"], v: Float[Array, " nvj"]) -> Float[Array, " nqj"]:
    """Integrate the constant body velocity v for unit time: q exp(v), on the joint's group."""
    if kind in SCREW_KINDS:
        return q + v
    if kind == "planar":
        # SE(2), not three separate coordinates: vx and vy are in the body frame, which turns during the step.
        step = se2.exp(v)
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        x, y = step[0, 2], step[1, 2]
        return jnp.stack([q[0] + c * x - s * y, q[1] + s * x + c * y, q[2] + v[2]])
    if kind == "spherical":
        # A product of unit quaternions drifts by eps per step; normalising here keeps long integrations on the sphere.
        return so3.quat_normalize(so3.quat_multiply(q, so3.quat_exp(v)))
    step = se3.exp(v)
    position = q[:3] + so3.quat_to_matrix(q[3:]) @ step[:3, 3]
    return jnp.concatenate([position, so3.quat_normalize(so3.quat_multiply(q[3:], so3.quat_exp(v[3:])))])


@entry_point
def joint_difference(kind: str, q0: Float[Array, " nqj"], q1: Float[Array, " nqj"]) -> Float[Array, " nvj"]:
    """Body velocity that moves q0 to q1 in one unit of time; the inverse of `joint_integrate`."""
    if kind in SCREW_KINDS:
        return q1 - q0
    if kind == "planar":
        c, s = jnp.cos(q0[2]), jnp.sin(q0[2])
        d = q1 - q0
        x, y = c * d[0] + s * d[1], -s * d[0] + c * d[1]
        # The angle is kept as it is, not wrapped: planar joints may turn many times.
        # The left Jacobian inverse of SE(2) undoes the rotation of the body axes during the step.
        inverse = se2.left_jacobian_inverse(jnp.stack([jnp.zeros_like(x), jnp.zeros_like(x), d[2]]))[:2, :2]
        return jnp.concatenate([inverse @ jnp.stack([x, y]), d[2:]])
    # q and -q are one rotation; quat_log takes the shorter one, so the difference never exceeds half a turn.
    relative = so3.quat_multiply(so3.quat_conjugate(q0[-4:]), q1[-4:])
    omega = so3.quat_log(relative)
    if kind == "spherical":
        return omega
    shift = so3.quat_to_matrix(q0[3:]).T @ (q1[:3] - q0[:3])
    return jnp.concatenate([so3.left_jacobian_inverse(omega) @ shift, omega])


@entry_point
def joint_rate(kind: str, q: Float[Array, " nqj"], v: Float[Array, " nvj"]) -> Float[Array, " nqj"]:
    """Time derivative of q for the body velocity v, the kinematic map qdot = H(q) v."""
    if kind in SCREW_KINDS:
        return v
    if kind == "planar":
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.stack([c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]])
    omega = v[-3:]
    # Body-frame angular velocity multiplies from the right: qdot = q (0, omega) / 2.
    quat_rate = 0.5 * so3.quat_multiply(q[-4:], jnp.concatenate([jnp.zeros_like(omega[:1]), omega]))
    if kind == "spherical":
        return quat_rate
    return jnp.concatenate([so3.quat_to_matrix(q[3:]) @ v[:3], quat_rate])


@entry_point
def joint_random(
    kind: str, key: Array, lower: Array | np.ndarray, upper: Array | np.ndarray, dtype
) -> Float[Array, " nqj"]:
    """Random configuration: uniform between the limits for coordinates, uniform over rotations for quaternions."""
    # A normal vector in four dimensions has a uniform direction, and so gives uniform rotations.
    if kind in ("spherical", "free"):
        ends, quat_key = jax.random.split(key)
        quat = so3.quat_normalize(jax.random.normal(quat_key, (4,), dtype))
        if kind == "spherical":
            return quat
        place = jax.random.uniform(
            ends, (3,), dtype, minval=jnp.asarray(lower[:3], dtype), maxval=jnp.asarray(upper[:3], dtype)
        )
        return jnp.concatenate([place, quat])
    return jax.random.uniform(
        key, (KINDS[kind].nq,), dtype, minval=jnp.asarray(lower, dtype), maxval=jnp.asarray(upper, dtype)
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Topology:
    """Structure of a mechanism that decides which program is compiled: parents and kinds of joints.

    Bodies are listed so that a parent comes before its children (`parents[i] < i`; -1 is the world). Body i is moved by
    joint i. Two topologies with the same tree, kinds and names are equal, so models that differ only in their parameters share
    compiled code.
    """

    name: str
    parents: tuple[int, ...]
    kinds: tuple[str, ...]
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    frame_names: tuple[str, ...]
    frame_bodies: tuple[int, ...]
    couplings: tuple[tuple[int, int], ...] = ()  # (joint, source): the joint's coordinate is a function of the source's

    # Cached: JAX hashes and compares static fields at every call of a jitted function.
    @cached_property
    def _key(self):
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    @cached_property
    def _hash(self):
        return hash(self._key)

    def __hash__(self):
        return self._hash

    # Identity first: comparing long tuples of names at every call would cost more than small programs.
    def __eq__(self, other):
        return self is other or (isinstance(other, Topology) and self._key == other._key)

    @property
    def nb(self) -> int:
        """Number of bodies."""
        return len(self.parents)

    @cached_property
    def nq(self) -> int:
        """Number of configuration coordinates."""
        return sum(KINDS[kind].nq for kind in self.kinds)

    @cached_property
    def nv(self) -> int:
        """Number of velocity coordinates (degrees of freedom)."""
        return sum(KINDS[kind].nv for kind in self.kinds)

    @cached_property
    def q_slices(self) -> tuple[slice, ...]:
        """Slice of each joint's coordinates in q."""
        ends = np.cumsum([0] + [KINDS[kind].nq for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def v_slices(self) -> tuple[slice, ...]:
        """Slice of each joint's coordinates in v."""
        ends = np.cumsum([0] + [KINDS[kind].nv for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def screw_mask(self) -> np.ndarray:
        """Mask (nb, 6) of the screw entries that each joint's kind uses."""
        # The shape (0, 6) of a model without bodies needs the reshape.
        return np.array([screw_mask(kind) for kind in self.kinds], bool).reshape(-1, 6)

    @cached_property
    def dof_body(self) -> np.ndarray:
        """Body (nv,) that carries each velocity coordinate's joint."""
        return np.repeat(np.arange(self.nb), [KINDS[kind].nv for kind in self.kinds])

    @cached_property
    def ancestors(self) -> np.ndarray:
        r"""Mask (nb, nb), true at [i, j] when body j is body i or its ancestor.

        It is $G = (1 - \Gamma)^{-1}$ of `newton_euler_matrices` with all twists in the world frame.
        """
        mask = np.eye(self.nb, dtype=bool)
        # parents[i] < i, so the row of the parent is complete.
        for i, parent in enumerate(self.parents):
            if parent >= 0:
                mask[i] |= mask[parent]
        return mask

    @cached_property
    def dof_ancestors(self) -> np.ndarray:
        """Mask (nb, nv), true at [i, j] when velocity coordinate j moves body i."""
        return self.ancestors[:, self.dof_body]

    @cached_property
    def depths(self) -> np.ndarray:
        """Number of joints between the world and each body, (nb,), at least 1."""
        return self.ancestors.sum(1)

    @cached_property
    def roots(self) -> np.ndarray:
        """Root body of the tree of each body, (nb,)."""
        # argmax of a mask is the first true entry, and an ancestor has a smaller index than its descendants.
        return np.argmax(self.ancestors, axis=1) if self.nb else np.zeros(0, int)

    @cached_property
    def jumps(self) -> tuple[np.ndarray, ...]:
        """Pointer-jumping tables: the 2^k-th ancestor of each body (nb means the world), k = 0 .. ceil(log2(depth)) - 1."""
        # One row more than bodies: the world is its own ancestor, so that jumps beyond the root stay there.
        jump = np.array([p if p >= 0 else self.nb for p in self.parents] + [self.nb])
        tables = []
        while self.nb and (jump[:-1] != self.nb).any():
            tables.append(jump[:-1])
            # Each table composed with itself doubles the distance of the jump.
            jump = jump[jump]
        return tuple(tables)


def body_index(model: Any, name: str | None) -> int:
    """Index of a body by name; None means the world, -1.

    **Raises:** ValueError for a name that is neither a body nor a frame merged into one; similar names are listed.
    """
    if name is None:
        return -1
    check_name(name, "body")
    if name in model.topology.body_names:
        return model.topology.body_names.index(name)
    # A link merged into a body is still named by users and files.
    return model.topology.frame_bodies[frame_index(model, name)]


def frame_index(model: Any, name: str) -> int:
    """Index of a frame by name; the name of a joint means the frame of its child link unless a frame has that name.

    **Raises:** ValueError when there is no frame of that name; names that look alike are listed.
    """
    check_name(name, "frame")
    # Files often name the joint where they mean its link, fixed joints included.
    carried = dict(model.fixed_joints) | dict(zip(model.topology.joint_names, model.topology.body_names, strict=True))
    names = model.topology.frame_names
    try:
        return names.index(name if name in names else carried.get(name, name))
    except ValueError:
        near = difflib.get_close_matches(str(name), (*names, *carried), n=5, cutoff=0.4)
        hint = f"did you mean {', '.join(near)}?" if near else f"frames are {', '.join(names[:10])} ..."
        raise ValueError(f"frame {name!r} is not in model {model.name!r}; {hint}") from None


def joint_index(model: Any, name: str) -> int:
    """Index of a moving joint by name.

    **Raises:** ValueError for a name of no joint, or of a fixed one; names that look alike are listed.
    """
    check_name(name, "joint")
    if name in model.topology.joint_names:
        return model.topology.joint_names.index(name)
    if name in dict(model.fixed_joints):
        raise ValueError(f"joint {name!r} of model {model.name!r} is fixed: it has no coordinates")
    near = difflib.get_close_matches(str(name), model.topology.joint_names, n=5, cutoff=0.4)
    hint = f"did you mean {', '.join(near)}?" if near else f"joints are {', '.join(model.topology.joint_names[:10])}"
    raise ValueError(f"joint {name!r} is not in model {model.name!r}; {hint}")


def coordinate_index(slices: Sequence[slice], model: Any, joint: str) -> int | slice:
    """Index of a joint's coordinate, or the slice of several."""
    place = slices[joint_index(model, joint)]
    # A number and not a slice of one, so that q[index] is a scalar.
    return place.start if place.stop == place.start + 1 else place


def velocity_indices(model: Any, joints: Iterable[str]) -> np.ndarray:
    """Indices in v of the coordinates of some joints, in their order.

    **Raises:** ValueError for one string instead of a list, unknown joints and joints named twice.
    """
    if isinstance(joints, str):
        raise ValueError(f"joints is {joints!r}; give a list of names, [{joints!r}]")
    joints = list(joints)
    # A repeated joint would give a selection matrix without full column rank.
    if len(set(joints)) < len(joints):
        raise ValueError(f"joints is {joints}; name each joint once")
    places = [model.topology.v_slices[joint_index(model, joint)] for joint in joints]
    # The empty array keeps the integer type when no joint is named.
    return np.concatenate([np.zeros(0, int), *(np.arange(place.start, place.stop) for place in places)])
