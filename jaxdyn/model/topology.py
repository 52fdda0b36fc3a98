"""Static part of a mechanism, `Topology`: the tree of bodies, kinds of joints, names and their look-up, and derived tables."""

import dataclasses
import difflib
import itertools
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from jaxdyn.model.arguments import check_name
from jaxdyn.model.joints import KINDS, screw_mask


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
    try:
        return model.topology.frame_names.index(name if name in model.topology.frame_names else carried.get(name, name))
    except ValueError:
        raise ValueError(f"frame {name!r} is not in model {model.name!r}; {_hint(name, model, carried)}") from None


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


def _hint(name: str, model: Any, carried: dict) -> str:
    near = difflib.get_close_matches(str(name), (*model.topology.frame_names, *carried), n=5, cutoff=0.4)
    return (
        f"did you mean {', '.join(near)}?" if near else f"frames are {', '.join(model.topology.frame_names[:10])} ..."
    )
