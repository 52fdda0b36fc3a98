"""Inverse dynamics by the recursive Newton-Euler algorithm, and the mass matrix by composite rigid bodies.

Every point r of a body (in its frame) has the acceleration a + K r, where a is that of the frame's origin and

    K = hat(dw) + hat(w)^2.

Multiplied by the body's moments J (4 x 4, see `frames`), Y = [K a] J = sum of m (a + K r)(r, 1)^T collects the
inertial forces: its last column is the inertial force, and vee(Y - Y^T) the moment. The velocity of the origin is not needed.

Source: Luh, Walker & Paul (1980); K as in Balafoutis, Patel & Misra (1988); EQUATIONS section 4.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.recursions.links import (
    Links,
    as_vector,
    by_joint,
    from_unit_force,
    joint_transforms,
    links_of,
    unit_velocity,
)
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    constants,
    contract,
    dot,
    dot_transpose,
    join,
    moments_to_parent,
    origin_in_parent,
    part,
    rotate_to_child,
    select,
    transpose,
    wrench_to_parent,
)
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


def wrench_of_acceleration(K, a, moments):
    """Inertial wrench (f, n) (6,) of a body of the given moments (4, 4) with accelerations a + K r of its points r."""
    table = constants(moments.dtype)
    Y = dot(join([K, a.reshape(3, 1)], 1), moments)
    return contract(table.moment, Y, (1, 2), (0, 1))


def _hat(w):
    return dot(constants(w.dtype).hat, w)


def body_wrenches(links: Links, chains: list[Chain], v=None, a=None) -> list:
    """Inertial wrenches (6,) of all bodies, gravity included: the outward pass.

    **Arguments:** `chains` from `joint_transforms`; `v`, `a` (nv,) of unit screws, None for zero.
    """
    dtype = links.frames.home.dtype
    zero = np.zeros(3, dtype)
    weight = zero if links.gravity is None else -links.gravity  # gravity as an upward acceleration of the world
    speeds = None if v is None else by_joint(links, v)
    rates = None if a is None else by_joint(links, a)
    motion: list = []  # w, dw, K, acceleration of the origin
    wrenches = []
    for i, parent in enumerate(links.parents):
        at_rest = zero, zero, np.zeros((3, 3), dtype), weight
        speed, rate = (None if x is None else x[i] for x in (speeds, rates))
        motion.append(
            move_with_joint(motion[parent] if parent >= 0 else at_rest, chains[i], links.subspaces[i], speed, rate)
        )
        _, _, K, acc = motion[-1]
        wrenches.append(wrench_of_acceleration(K, acc, links.moments[i]))
    return wrenches


def move_with_joint(motion: tuple, chain: Chain, S, speed, rate) -> tuple:
    """Motion (w, dw, K, acceleration of the origin) of a body from that of its parent; speed and rate (nj,), or None."""
    w, dw, K, acc = motion
    # The parent's K gives the acceleration of every point fixed in it, the child's origin among them.
    r = origin_in_parent(chain)
    acc = rotate_to_child(chain, acc if r is None else acc + dot(K, r))
    w, dw = rotate_to_child(chain, w), rotate_to_child(chain, dw)
    slides, turns = _is_nonzero(S[:3]), _is_nonzero(S[3:])
    if speed is not None:
        if slides:
            slide = dot(part(S, 0, 3), speed)
            # Coriolis acceleration 2 w x slide, with w of the parent.
            acc = acc + dot(_hat(w + w), slide)
        if turns:
            omega = dot(part(S, 3, 6), speed)
            dw = dw + dot(_hat(w), omega)
            w = w + omega
            if slides:
                # The joint's own rotation carries its translation with it: omega x slide, for helical, planar and
                # free joints.
                acc = acc + dot(_hat(omega), slide)
    if rate is not None:
        acc = acc + dot(part(S, 0, 3), rate) if slides else acc
        dw = dw + dot(part(S, 3, 6), rate) if turns else dw
    # At rest K stays the zero matrix of numpy, so that its products are never compiled.
    if speed is not None or rate is not None:
        square = _hat(w)
        K = _hat(dw) + dot(square, square)
    return w, dw, K, acc


def _is_nonzero(S) -> bool:
    """Decide whether part of a motion subspace may be nonzero; traced values may."""
    return not isinstance(S, np.ndarray) or bool(S.any())


def joint_forces(links: Links, chains: list[Chain], wrenches: list) -> list:
    """Inward pass: generalised forces (nj,) of each joint, S^T times the wrenches of all bodies that the joint carries."""
    total: list = list(wrenches)
    tau: list = [None] * len(wrenches)
    for i in reversed(range(len(wrenches))):
        tau[i] = dot_transpose(links.subspaces[i], total[i])
        if links.parents[i] >= 0:
            total[links.parents[i]] = total[links.parents[i]] + wrench_to_parent(chains[i], total[i])
    return tau


def _inverse(model: Model, q, v=None, a=None):
    links = links_of(model)
    v, a = (None if x is None else unit_velocity(links, x) for x in (v, a))
    chains = joint_transforms(links, q)
    tau = as_vector(joint_forces(links, chains, body_wrenches(links, chains, v, a)), q)
    if a is not None and links.armature is not None:
        # Rotors turn with the joint's own rate and belong to no body, so they bypass the recursion.
        tau = tau + links.armature * a
    return from_unit_force(links, tau)


def rnea(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"] | None
) -> Float[Array, " nv"]:
    """Inverse dynamics M a + C v + N (nv,), N m or N, armature included; `a` None is zero, whose terms are left out.

    Source: EQUATIONS section 4; Luh, Walker & Paul (1980); Featherstone (2008) table 5.1.
    """
    check_shapes(model, q=q, v=v, a=a)
    return _inverse(model, q, v, a)


def bias_force(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Bias force C v + N (nv,), N m or N: `rnea` at zero acceleration."""
    check_shapes(model, q=q, v=v)
    return _inverse(model, q, v)


def gravity_force(model: Model, q: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Gravity force N = +dV/dq (nv,), N m or N: `rnea` at rest."""
    check_shapes(model, q=q)
    return _inverse(model, q)


def momentum_columns(moments, S):
    """Wrenches I S (6, nj) of unit joint accelerations of a composite body with the given moments (4, 4)."""
    table = constants(moments.dtype)
    # Y = [hat(w) v] J for each column (v, w) of S, as in `rnea`.
    rates = join([contract(table.hat, part(S, 3, 6), (2,), (0,)), part(S, 0, 3).reshape(3, 1, -1)], 1)
    Y = contract(rates, moments, (1,), (0,))  # (3, nj, 4)
    return contract(table.moment, Y, (1, 2), (0, 2))


def ancestor_rows(links: Links, chains: list[Chain], i: int, columns) -> list:
    """Blocks (nj of the ancestor, k) of S^T F along the path from the parent of body i to the root, for wrenches F (6, k)."""
    pieces, at = [], i
    while links.parents[at] >= 0:
        columns = wrench_to_parent(chains[at], columns)
        at = links.parents[at]
        pieces.append((at, dot_transpose(links.subspaces[at], columns)))
    return pieces


def place_rows(links: Links, pieces: dict, width: int, dtype):
    """Assemble rows (nv, width) from blocks at their joints, zero for all other joints."""
    # Numpy zeros are known, so the sparsity of branches survives in the scalar program. Those of neighbours are one block: of a
    # wide tree most are.
    rows, at, places = [], 0, links.model.topology.v_slices
    for i in sorted(pieces):
        rows += [np.zeros((places[i].start - at, width), dtype), pieces[i]]
        at = places[i].stop
    return join([x for x in (*rows, np.zeros((links.model.nv - at, width), dtype)) if x.shape[0]], 0)


def crba(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix M(q) (nv, nv), armature included, in kg m^2, kg m or kg by the kinds of the two joints.

    Entries between joints on different branches are zeros that are never computed.

    Source: Featherstone (2008), table 6.2.
    """
    check_shapes(model, q=q)
    links = links_of(model)
    chains = joint_transforms(links, q)
    total = list(links.moments)
    columns: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        force = momentum_columns(total[i], links.subspaces[i])
        own = dot_transpose(links.subspaces[i], force)
        pieces = dict([(i, own), *ancestor_rows(links, chains, i, force)])
        columns[i] = place_rows(links, pieces, own.shape[1], q.dtype)
        if links.parents[i] >= 0:
            total[links.parents[i]] = total[links.parents[i]] + moments_to_parent(chains[i], total[i])
    if not columns:
        return jnp.zeros((0, 0), q.dtype)
    # Each column holds the entries of its joint's ancestors only: the upper triangle.
    above = join(columns, 1)
    M: Any = select(np.triu(np.ones((model.nv, model.nv), bool)), above, transpose(above))
    if links.armature is not None:
        M = M + links.armature[:, None] * np.eye(model.nv, dtype=q.dtype)
    # An M that does not depend on q is a numpy array up to here.
    return jnp.asarray(M if links.scale is None else links.scale[:, None] * M * links.scale[None, :])
