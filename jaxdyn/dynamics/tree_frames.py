"""Frames of trees: products of exponentials, and sums over the bodies of a tree.

The pose of body i is T_i = (product over its ancestors j, root first, of home_j exp(hat(S_j) q_j)), the product of
exponentials of Murray, Li & Sastry (1994), eq. 3.3, with body frames instead of base-frame screws. The product along
the tree is one for each body, in native code a loop over them where they are many. Arrays of many bodies are multiplied by
pointer jumping: after step k every body holds the product of its last 2^k joints, so log2(depth) batched 4x4 products give
all poses.

Quantities summed over bodies are expressed in one *tree frame*: axes parallel to the world's, origin at the origin of
the tree's root body. Positions in it are built without ever adding the root's own position, so a robot far from the
world's origin is computed exactly as one at home.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import sweep
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.topology import KINDS, SCREW_KINDS, joint_transform, screw_transform
from jaxdyn.model.tree import Model, Topology, geometry

# Numbers of bodies from which on a quantity is computed by loops in native code, whose size does not grow with the bodies.
#
# What is written out keeps the zeros of each body, and is not slower for small trees; LLVM takes 50 microseconds an operation.
# Each limit is where compiling what is written out takes one to three seconds of a processor, its optimisation included.
# Measured on chains and binary trees in general geometry, on two cores of an AMD EPYC: microseconds a sample alone and in a
# batch of 128, or 32 of shallow trees, and seconds of the processor to compile both kernels.
#
# | quantity, bodies | written out | loops |
# |---|---|---|
# | forward kinematics, 64 | 5.8, 0.45; 2.1 s | 6.1, 0.54; 0.9 s |
# | forward kinematics, 64, axes at right angles | 4.7, 0.18; 0.7 s | 4.9, 0.29; 0.7 s |
# | mass matrix, chain of 24 (300 pairs) | 5.2, 0.25; 1.5 s | 16, 1.5; 0.6 s |
# | mass matrix, chain of 44 (990 pairs) | 8.1, 0.94; 5.8 s | 25, 4.2; 0.7 s |
# | mass matrix, chain of 60 (1830 pairs) | more than 60 000 operations | 43, 6.3; 0.9 s |
# | mass matrix, shallow tree of 140 (509 pairs) | 12, 3.1; 7.3 s | 75, 28; 1.5 s |
# | mass matrix, shallow tree of 300 (878 pairs) | 36, 13; 23 s, of which the first calls 3.5 | 214, 482; 4.2 s |

# Kinematics, and sums over the bodies.
MIN_BODIES_IN_LOOPS = 64
# The recursions of forward and inverse dynamics (see `recursions.sweeps`). In general geometry sweeps are as fast from 15 on;
# where axes are at right angles every body that is written out has zeros of its own.
MIN_BODIES_IN_SWEEPS = 40
# Those of robots with floating bases, most of whose axes are at right angles; within other kernels, where what is written out
# shares its numbers with the rest; and of joints without sweeps, for which loops of all kinds are slower.
MAX_BODIES = 128
# Pairs of a body and one above it, or itself: each is some 60 operations of a mass matrix. Its loops are slower at every size, as
# they compute the products of all pairs of bodies.
MAX_PAIRS = 1000
# Bodies of a shallow tree, whose pairs are few: the first call takes three seconds for 300.
MAX_BODIES_IN_MATRIX = 400


class TreeFrame(NamedTuple):
    """A configuration seen from the tree frames (one per root body).

    - `pose` (nb, 4, 4): body frame in its tree frame (m).
    - `origin` (nb, 3): world position of the tree frame's origin, for each body (m).
    - `subspace` (nv, 6): row k is the twist, in the tree frame, of the motion with v_k = 1 alone. As a twist of the
      fixed frame that coincides with the tree frame at this instant it does not depend on where the root body is.
    """

    pose: Float[Array, "nb 4 4"]
    origin: Float[Array, "nb 3"]
    subspace: Float[Array, "nv 6"]


def relative_poses(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nb 4 4"]:
    """Pose of each body frame in its parent body frame (the world's for roots), home @ exp(hat(S) q)."""
    topology = model.topology
    home, screws = map(jnp.asarray, geometry(model))
    order, transforms = [], []
    # One batched evaluation per joint kind, instead of one per joint: the program does not grow with the number of
    # bodies. Revolute and continuous joints differ in limits only and share one batch.
    labels = np.array(["revolute" if kind == "continuous" else kind for kind in topology.kinds], str)
    for kind in dict.fromkeys(labels.tolist()):
        bodies = np.flatnonzero(labels == kind)
        if kind in SCREW_KINDS:
            coordinates = np.array([topology.q_slices[i].start for i in bodies])
            place = functools.partial(screw_transform, kind)
            transforms.append(map_rows(place, take(screws, bodies), take(q, coordinates)))
        else:
            coordinates = np.array([np.arange(topology.nq)[topology.q_slices[i]] for i in bodies])
            # The screw is not read by these kinds.
            transforms.append(map_rows(lambda qj, kind=kind: joint_transform(kind, screws[0], qj), q[coordinates]))
        order.extend(bodies)
    if not transforms:
        return home
    transforms_by_kind = transforms[0] if len(transforms) == 1 else jnp.concatenate(transforms)
    return map_rows(matmul, home, take(transforms_by_kind, np.argsort(order)))


def body_subspace(model: Model) -> Float[Array, "nv 6"]:
    """Motion subspace of every joint in its own body frame, one row per velocity coordinate."""
    topology = model.topology
    fixed = np.zeros((topology.nv, 6))
    is_screw = np.zeros(topology.nv, bool)
    for kind, place in zip(topology.kinds, topology.v_slices, strict=True):
        if kind in SCREW_KINDS:
            is_screw[place] = True
        else:
            fixed[place] = np.eye(6)[list(KINDS[kind].columns)]
    # The screws of other kinds are zero leaves, whose values are not read.
    constant = jnp.asarray(fixed, model.screws.dtype)
    if not is_screw.any():
        return constant
    screws = take(jnp.asarray(geometry(model)[1]), topology.dof_body)
    return screws if is_screw.all() else jnp.where(is_screw[:, None], screws, constant)


def tree_frame(model: Model, q: Float[Array, " nq"]) -> TreeFrame:
    """Poses and motion subspace in the tree frames (see `TreeFrame`)."""
    topology = model.topology
    local = relative_poses(model, q)
    is_root = np.array([parent < 0 for parent in topology.parents], bool)
    # Shared by all bodies of one tree; different trees have different frames.
    origin = take(local[:, :3, 3], topology.roots)
    # A root's own translation is replaced by zero before the product, not subtracted after it.
    mask = np.ones((topology.nb, 4, 4), bool)
    mask[is_root, :3, 3] = False
    pose = jnp.where(mask, local, jnp.zeros_like(local))
    pose = _tree_products(topology, pose)
    # S is constant in the body's frame; Ad carries it to the tree frame.
    subspace = map_rows(se3.Ad_apply, take(pose, topology.dof_body), body_subspace(model))
    return TreeFrame(pose, origin, subspace)


def map_rows(function: Callable, *rows):
    """Evaluate function(row of each array) for all rows of arrays (n, ...), one for each body or coordinate."""
    count, at_once = len(rows[0]), jax.vmap(function)
    if count < MIN_BODIES_IN_LOOPS:
        return at_once(*rows)

    def step(carry, row):
        return carry, function(*row)

    # A chain without a carry.
    return sweep(step, range(-1, count - 1), (), rows, by_arrays=lambda: ((), at_once(*rows)))[1]


def _accumulate(topology: Topology, combine: Callable, start, rows, by_arrays: Callable, inward: bool = False):
    """For each body combine(that of its parent, or the sum over its children, own row), by a loop where bodies are many."""
    if topology.nb < MIN_BODIES_IN_LOOPS:
        return by_arrays()

    def step(x, own):
        return (combine(x, own),) * 2

    return sweep(step, topology.parents, start, rows, inward=inward, by_arrays=lambda: (None, by_arrays()))[1]


def _tree_products(topology: Topology, pose: Float[Array, "nb 4 4"]) -> Float[Array, "nb 4 4"]:
    """Products of the poses of all bodies above each body, root first."""
    if topology.nb < MIN_BODIES_IN_LOOPS:
        # One for each body: pointer jumping would multiply the operations by log2(depth).
        products: list = []
        for i, parent in enumerate(topology.parents):
            products.append(pose[i] if parent < 0 else matmul(products[parent], pose[i]))
        return jnp.stack(products) if products else pose
    one = jnp.eye(4, dtype=pose.dtype)

    def by_jumps():
        """Products by pointer jumping, log2(depth) of all bodies."""
        made = pose
        # The extra row is the world: a jump beyond the root multiplies by the identity.
        for table in topology.jumps:
            made = matmul(jnp.concatenate([made, one[None]])[table], made)
        return made

    return _accumulate(topology, matmul, one, pose, by_jumps)


def body_twists(model: Model, frame: TreeFrame, v: Float[Array, " nv"]) -> Float[Array, "nb 6"]:
    """Twist of every body in its tree frame: V_i = sum of S_k v_k over the coordinates k that move body i."""
    return sum_to_bodies(model, frame.subspace * v[:, None])


def subspace_rate(model: Model, frame: TreeFrame, twists: Float[Array, "nb 6"]) -> Float[Array, "nv 6"]:
    """Rate of the motion subspace: dS_k/dt = ad_V S_k, V the twist of the body that carries S_k with it."""
    return map_rows(se3.ad_apply, take(twists, model.topology.dof_body), frame.subspace)


def sum_to_bodies(model: Model, rows: Float[Array, "nv n"]) -> Float[Array, "nb n"]:
    """G rows: for each body the sum of the rows of the coordinates that move it."""
    topology, of_coordinates = model.topology, rows
    if topology.nv > topology.nb >= MIN_BODIES_IN_LOOPS:  # of joints with several coordinates the sum over these
        rows = matmul(jnp.asarray(np.arange(topology.nb)[:, None] == topology.dof_body, rows.dtype), rows)

    def by_arrays():
        return matmul(jnp.asarray(topology.dof_ancestors, rows.dtype), of_coordinates)

    return _accumulate(topology, jnp.add, jnp.zeros(rows.shape[1:], rows.dtype), rows, by_arrays)


def sum_to_coordinates(model: Model, rows: Float[Array, "nb n"]) -> Float[Array, "nv n"]:
    """G^T rows: for each velocity coordinate the sum of the rows of the bodies that it moves."""
    topology = model.topology

    def by_arrays():
        return matmul(jnp.asarray(topology.ancestors.T, rows.dtype), rows)

    sums = _accumulate(topology, jnp.add, jnp.zeros(rows.shape[1:], rows.dtype), rows, by_arrays, inward=True)
    return take(sums, topology.dof_body)


def take(rows: Array, index: np.ndarray) -> Array:
    """`rows[index]` for a constant index; no operation when the index lists all rows in order."""
    index = np.asarray(index)
    # A gather stays an operation of the program even where it moves nothing.
    if index.shape == rows.shape[:1] and (index == np.arange(len(index))).all():
        return rows
    return rows[index]
