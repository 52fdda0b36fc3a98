"""Recursive Newton-Euler, composite rigid bodies, articulated bodies: inverse dynamics, mass matrix, forward dynamics.

Every point r of a body (in its frame) has the acceleration a + K r, where a is that of the frame's origin and

    K = hat(dw) + hat(w)^2.

Multiplied by the body's moments J (4 x 4, see `frames`), Y = [K a] J = sum of m (a + K r)(r, 1)^T collects the
inertial forces: its last column is the inertial force, and vee(Y - Y^T) the moment. The velocity of the origin is not needed.

Source: Luh, Walker & Paul (1980); K as in Balafoutis, Patel & Misra (1988); EQUATIONS section 4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.recursions.links import (
    Links,
    as_vector,
    by_joint,
    columns_of,
    joint_transforms,
    links_of,
    unit_force,
    unit_velocity,
)
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    constants,
    contract,
    dot,
    dot_transpose,
    entry,
    inertia_to_parent,
    join,
    moments_to_parent,
    origin_in_parent,
    outer,
    part,
    rotate_to_child,
    select,
    symmetric,
    transpose,
    twist_to_child,
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


def _inverse(model: Model, q, v=None, a=None):
    links = links_of(model)
    v, a = (unit_velocity(links, x) for x in (v, a))
    chains = joint_transforms(links, q)
    total: list = body_wrenches(links, chains, v, a)
    forces: list = [None] * model.nb
    # Inward: S^T times the wrenches of all bodies that a joint carries.
    for i in reversed(range(model.nb)):
        forces[i] = dot_transpose(links.subspaces[i], total[i])
        if links.parents[i] >= 0:
            total[links.parents[i]] = total[links.parents[i]] + wrench_to_parent(chains[i], total[i])
    tau = as_vector(forces, q)
    if a is not None and links.armature is not None:
        # Rotors turn with the joint's own rate and belong to no body, so they bypass the recursion.
        tau = tau + links.armature * a
    return unit_velocity(links, tau)


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
        # Wrenches I S (6, nj) of unit accelerations of the composite body: Y = [hat(w) v] J for columns (v, w) of S.
        table, S = constants(total[i].dtype), links.subspaces[i]
        rates = join([contract(table.hat, part(S, 3, 6), (2,), (0,)), part(S, 0, 3).reshape(3, 1, -1)], 1)
        force = contract(table.moment, contract(rates, total[i], (1,), (0,)), (1, 2), (0, 2))
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


# Articulated-body inertias: the factorisation M = W W^T over the tree, and forward dynamics M^-1 f by two sweeps.
#
# Body i and its descendants, with free joints, respond to an acceleration of its frame like one body of the
# articulated inertia A. To pass a joint with the motion subspace s, one degree of freedom is eliminated,
#
#     U = A s,   D = s^T U + armature,   A <- A - U U^T / D,
#
# those of a joint with several one after the other. The gains U/D and pivots D are all that the sweeps need.
#
# Source: EQUATIONS section 5; Featherstone (2008) section 7.3; Rodriguez, Jain & Kreutz-Delgado (1992).


class ArticulatedFactors(NamedTuple):
    """Factorisation of M: per body and degree of freedom, in the order of elimination, the gain U/D (6,) and 1/D."""

    links: Links
    chains: list[Chain]
    gains: list[list]
    inverses: list[list]


def spatial_inertia(moments):
    """Spatial inertia (6, 6) of a pseudo-inertia (4, 4): [[m, -hat(h)], [hat(h), tr(S) 1 - S]] with second moments S."""
    # Twist a gives the point r the velocity E_a (r, 1) with E = `moment`, so I_ab = sum of m E_a (r, 1) . E_b (r, 1).
    field = constants(moments.dtype).moment
    tensor = np.einsum("aik,bil->abkl", field, field)
    return contract(tensor, moments, (2, 3), (0, 1))


def factorize(links: Links, chains: list[Chain]) -> ArticulatedFactors:
    """Articulated-body factors of M: gains and pivots of every degree of freedom, from the leaves to the root."""
    nb = links.model.nb
    total = [spatial_inertia(moments) for moments in links.moments]
    armatures = None if links.armature is None else by_joint(links, links.armature)
    gains: list = [None] * nb
    inverses: list = [None] * nb
    for i in reversed(range(nb)):
        A, gains[i], inverses[i] = total[i], [], []
        for j, k in enumerate(columns_of(links.model.topology.kinds[i])):
            armature = None if armatures is None else entry(armatures[i], j)
            A, gain, inverse = eliminate(A, entry(links.subspaces[i], j, 1), k, armature)
            gains[i].append(gain)
            inverses[i].append(inverse)
        parent = links.parents[i]
        if parent >= 0:
            total[parent] = total[parent] + inertia_to_parent(chains[i], A)
    return ArticulatedFactors(links, chains, gains, inverses)


def eliminate(A, s, k, armature):
    """Eliminate one degree of freedom: A - U U^T/D, U/D and 1/D; `k` is the coordinate that s spans alone, or None."""
    U = dot(A, s)
    D = dot(s, U) if armature is None else dot(s, U) + armature
    # Pivots of a positive definite M are positive; NaN marks any other M.
    inverse = 1 / jnp.where(D > 0, D, jnp.full_like(D, jnp.nan))
    gain = U * inverse
    rest = A - outer(U, gain)
    if armature is None and k is not None:
        # Exact zeros and ones along that coordinate, which rounding would leave as 1e-17 and scalar programs could not drop.
        along = np.eye(6, dtype=A.dtype)[k]
        gain = select(along > 0, along, gain)
        cross = np.maximum.outer(along, along) > 0
        rest = select(cross, np.zeros((6, 6), A.dtype), rest)
    return symmetric(rest), gain, inverse


def inward(factors: ArticulatedFactors, force: list, wrenches: list | None = None) -> list[list]:
    """Residual joint forces D^(1/2) W^-1 tau, less the wrenches on the bodies that each joint carries.

    **Arguments:** `force`, per joint (nj,), on unit screws; `wrenches`, per body (6,), of its inertial motion, or None.

    **Returns:** per joint, a list of numbers, one for each degree of freedom.
    """
    links = factors.links
    bias: list = [None] * links.model.nb if wrenches is None else list(wrenches)
    left: list = [None] * links.model.nb
    for i in reversed(range(links.model.nb)):
        F, left[i] = bias[i], []
        for j, (k, gain) in enumerate(zip(columns_of(links.model.topology.kinds[i]), factors.gains[i], strict=True)):
            tau = entry(force[i], j)
            u = tau if F is None else tau - dot(entry(links.subspaces[i], j, 1), F)
            left[i].append(u)
            given = gain * u if F is None else F + gain * u
            if k is not None and links.armature is None:  # along its axis the joint transmits exactly tau
                along = np.eye(6, dtype=gain.dtype)[k]
                given = select(along > 0, along * tau, given)
            F = given
        # No wrench yet means zero, for which nothing is computed.
        parent = links.parents[i]
        if parent >= 0:
            up = wrench_to_parent(factors.chains[i], F)
            bias[parent] = up if bias[parent] is None else bias[parent] + up
    return left


def outward(factors: ArticulatedFactors, left: list[list]) -> list:
    """Accelerations (nj,) of the joints, on unit screws, from the residuals of `inward`."""
    links = factors.links
    twists: list = [None] * links.model.nb
    out: list = []
    for i, parent in enumerate(links.parents):
        V = twist_to_child(factors.chains[i], twists[parent]) if parent >= 0 else None
        joint_accelerations: list = [None] * len(left[i])
        # In the reverse order of the elimination: back substitution within the joint.
        for j in reversed(range(len(joint_accelerations))):
            s, gain = entry(links.subspaces[i], j, 1), factors.gains[i][j]
            free = left[i][j] * factors.inverses[i][j]
            # The world does not accelerate, so a root has no twist to subtract.
            if V is None:
                joint_accelerations[j] = free
                V = s * free
                continue
            x = joint_accelerations[j] = free - dot(gain, V)
            V = V + s * x
        out.append(joint_accelerations)
        twists[i] = V
    return out


def solve(factors: ArticulatedFactors, force: Float[Array, " nv"], wrenches: list | None = None) -> Float[Array, " nv"]:
    """Solve M a = force - (generalised forces of `wrenches` on the bodies), (nv,); `jax.vmap` for several columns."""
    links = factors.links
    left = inward(factors, by_joint(links, unit_force(links, force)), wrenches)
    flat = [x for joint in outward(factors, left) for x in joint]
    return unit_force(links, as_vector(flat, force))


def aba(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"]) -> Float[Array, " nv"]:
    r"""Forward dynamics by the articulated-body algorithm.

    $$a = M^{-1} (\tau - C v - N)$$

    Velocity terms enter as the body wrenches of zero joint accelerations, computed outward, so that the inward and
    outward sweeps are those of a plain $M^{-1}$.

    **Arguments:** `q` (nq,); `v` (nv,) rad/s or m/s; `tau` (nv,) generalised forces, N m or N.

    **Returns:** joint accelerations (nv,), rad/s^2 or m/s^2. NaN where M is not positive definite.

    Source: EQUATIONS section 5 with $b_i$ started from the bias wrench; Featherstone (2008), section 7.3.
    """
    check_shapes(model, q=q, v=v, tau=tau)
    return acceleration_and_inverse(model, q, v, tau)[0]


def acceleration_and_inverse(model: Model, q, v, tau) -> tuple[Array, Callable]:
    """Forward dynamics a (nv,), and the function f -> M^-1 f, from one factorisation of M."""
    links = links_of(model)
    chains = joint_transforms(links, q)
    wrenches = body_wrenches(links, chains, unit_velocity(links, v))
    factors = factorize(links, chains)
    return solve(factors, tau, wrenches), lambda force: solve(factors, force)


def mass_matrix_sqrt(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    r"""Square root W (nv, nv) of the mass matrix from the articulated bodies; no Cholesky factorisation.

    $$M = W W^T, \quad W = \xi^T G^T \hat M \xi D^{-1/2}, \quad \det M = \prod_k W_{kk}^2$$

    Column k holds, for joint k and its ancestors, the force that $U_k / \sqrt{D_k}$ needs. Upper triangular for a chain
    (within a joint of several degrees of freedom, lower triangular).

    Source: EQUATIONS section 5; Rodriguez, Jain & Kreutz-Delgado (1992).
    """
    check_shapes(model, q=q)
    links, columns = links_of(model), []
    factors = factorize(links, joint_transforms(links, q))
    for i in range(model.nb):
        S = links.subspaces[i]
        for j, (gain, inverse) in enumerate(zip(factors.gains[i], factors.inverses[i], strict=True)):
            # det M is the product of the pivots D, so each diagonal entry of W is sqrt(D).
            root = 1 / jnp.sqrt(inverse)
            force = (gain * root).reshape(6, 1)
            # Within a joint, elimination starts at column 0: later columns are zero in the rows of earlier ones.
            own = [np.zeros((1, 1), q.dtype)] * j + [root.reshape(1, 1)]
            own += [dot(entry(S, k, 1).reshape(1, 6), force) for k in range(j + 1, S.shape[1])]
            pieces = dict([(i, join(own, 0)), *ancestor_rows(links, factors.chains, i, force)])
            columns.append(place_rows(links, pieces, 1, q.dtype))
    W: Any = join(columns, 1) if columns else jnp.zeros((0, 0), q.dtype)
    # Joints are computed with unit screws; the scale restores forces of the screws as given.
    return jnp.asarray(W if links.scale is None else links.scale[:, None] * W)
