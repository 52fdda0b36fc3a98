"""The static part of a mechanism: the tree of bodies, kinds of joints and names (`Topology`), and tables made of them."""

import dataclasses
import itertools
from functools import cached_property

import numpy as np

from jaxdyn.model.joints import KINDS, screw_mask


@dataclasses.dataclass(frozen=True, eq=False)
class Topology:
    """Everything about a mechanism that decides what is compiled: who hangs on whom, and by which kind of joint.

    Bodies are listed so that a parent comes before its children (`parents[i] < i`; -1 is the world). Body i is moved by
    joint i. Two topologies with the same tree, kinds and names are equal, so models that differ in numbers alone share
    compiled code.
    """

    name: str
    parents: tuple[int, ...]
    kinds: tuple[str, ...]
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    frame_names: tuple[str, ...]
    frame_bodies: tuple[int, ...]
    couplings: tuple[tuple[int, int], ...] = ()  # (joint, source): the joint is to follow the source

    @cached_property
    def _key(self):
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    @cached_property
    def _hash(self):
        return hash(self._key)

    def __hash__(self):
        return self._hash

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
        """Where each joint's coordinates stand in q."""
        ends = np.cumsum([0] + [KINDS[kind].nq for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def v_slices(self) -> tuple[slice, ...]:
        """Where each joint's coordinates stand in v."""
        ends = np.cumsum([0] + [KINDS[kind].nv for kind in self.kinds]).tolist()
        return tuple(slice(a, b) for a, b in itertools.pairwise(ends))

    @cached_property
    def screw_mask(self) -> np.ndarray:
        """(nb, 6) of bool: the screw entries that each joint's kind reads."""
        return np.array([screw_mask(kind) for kind in self.kinds], bool).reshape(-1, 6)

    @cached_property
    def dof_body(self) -> np.ndarray:
        """(nv,): the body that each velocity coordinate moves first."""
        return np.repeat(np.arange(self.nb), [KINDS[kind].nv for kind in self.kinds])

    @cached_property
    def ancestors(self) -> np.ndarray:
        """(nb, nb) of bool: [i, j] is true when body j is body i or an ancestor of it. The world-frame G = (I - Gamma)^-1."""
        mask = np.eye(self.nb, dtype=bool)
        for i, parent in enumerate(self.parents):
            if parent >= 0:
                mask[i] |= mask[parent]
        return mask

    @cached_property
    def dof_ancestors(self) -> np.ndarray:
        """(nb, nv) of bool: [i, j] is true when velocity coordinate j moves body i."""
        return self.ancestors[:, self.dof_body]

    @cached_property
    def depths(self) -> np.ndarray:
        """(nb,): number of joints between the world and each body, at least 1."""
        return self.ancestors.sum(1)

    @cached_property
    def roots(self) -> np.ndarray:
        """(nb,): the root body of the tree that each body belongs to."""
        return np.argmax(self.ancestors, axis=1) if self.nb else np.zeros(0, int)

    @cached_property
    def jumps(self) -> tuple[np.ndarray, ...]:
        """Pointer-jumping tables: the 2^k-th ancestor of each body (nb means the world), k = 0 .. ceil(log2(depth)) - 1."""
        jump = np.array([p if p >= 0 else self.nb for p in self.parents] + [self.nb])
        tables = []
        while self.nb and (jump[:-1] != self.nb).any():
            tables.append(jump[:-1])
            jump = jump[jump]
        return tuple(tables)
