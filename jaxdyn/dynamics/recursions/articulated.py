"""Articulated-body inertias: the factorisation M = W W^T over the tree, and forward dynamics M^-1 f by two sweeps.

Body i and its descendants, with free joints, respond to an acceleration of its frame like one body of the
articulated inertia A. To pass a joint with the motion subspace s, one degree of freedom is eliminated,

    U = A s,   D = s^T U + armature,   A <- A - U U^T / D,

those of a joint with several one after the other. The gains U/D and pivots D are all that the sweeps need.

Source: EQUATIONS section 5; Featherstone (2008) section 7.3; Rodriguez, Jain & Kreutz-Delgado (1992).
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
    from_unit_velocity,
    joint_transforms,
    links_of,
    unit_force,
    unit_velocity,
)
from jaxdyn.dynamics.recursions.newton_euler import ancestor_rows, body_wrenches, place_rows
from jaxdyn.dynamics.recursions.transforms import (
    Chain,
    constants,
    contract,
    dot,
    entry,
    inertia_to_parent,
    join,
    outer,
    select,
    symmetric,
    twist_to_child,
    wrench_to_parent,
)
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


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


def factorize(model: Model, q: Float[Array, " nq"]) -> ArticulatedFactors:
    """Articulated-body factors of M(q): gains and pivots of every degree of freedom, from the leaves to the root."""
    check_shapes(model, q=q)
    links = links_of(model)
    return factorize_at(links, joint_transforms(links, q))


def factorize_at(links: Links, chains: list[Chain]) -> ArticulatedFactors:
    """Factorise M with given links and joint transforms."""
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
    return from_unit_velocity(links, as_vector(flat, force))


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
    return _free_and_inverse(model, q, v, tau)[0]


def _free_and_inverse(model: Model, q, v, tau) -> tuple[Array, Callable]:
    """Forward dynamics a (nv,), and the function f -> M^-1 f, from one factorisation of M."""
    links = links_of(model)
    chains = joint_transforms(links, q)
    wrenches = body_wrenches(links, chains, unit_velocity(links, v))
    factors = factorize_at(links, chains)
    return solve(factors, tau, wrenches), lambda force: solve(factors, force)


def aba_tangent(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"], force_change: Callable
) -> tuple[Float[Array, " nv"], Float[Array, " nv"]]:
    """Forward dynamics a and M^-1 times `force_change(a)` (nv,), both from one factorisation of M.

    With ID(q, v, a) = tau, a change of (model, q, v, tau) changes a by M^-1 (dtau - dID at fixed a); `force_change` returns the
    bracket. In reverse this costs one more M^-1 and one reverse pass of RNEA, instead of a reverse pass of ABA.
    """
    check_shapes(model, q=q, v=v, tau=tau)
    a, times = _free_and_inverse(model, q, v, tau)
    return a, times(force_change(a))


def mass_matrix_sqrt(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    r"""Square root W (nv, nv) of the mass matrix from the articulated bodies; no Cholesky factorisation.

    $$M = W W^T, \quad W = \xi^T G^T \hat M \xi D^{-1/2}, \quad \det M = \prod_k W_{kk}^2$$

    Column k holds, for joint k and its ancestors, the force that $U_k / \sqrt{D_k}$ needs. Upper triangular for a chain
    (within a joint of several degrees of freedom, lower triangular).

    Source: EQUATIONS section 5; Rodriguez, Jain & Kreutz-Delgado (1992).
    """
    factors = factorize(model, q)
    links, columns = factors.links, []
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
