"""Forward dynamics by the articulated-body algorithm, its tangent, and the square root of the mass matrix."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.recursions._arrays import dot, entry, join
from jaxdyn.dynamics.recursions.articulated import factorize, factorize_at, solve
from jaxdyn.dynamics.recursions.crba import ancestor_rows, place_rows
from jaxdyn.dynamics.recursions.links import joint_transforms, links_of, unit_velocity
from jaxdyn.dynamics.recursions.rnea import body_wrenches
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


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


def aba_with_columns(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    columns: Float[Array, "nv k"],
) -> tuple[Float[Array, " nv"], Float[Array, "nv k"]]:
    """Forward dynamics a (nv,), and M^-1 times `columns` (nv, k), from one factorisation of M, in O(nb k) operations."""
    check_shapes(model, q=q, v=v, tau=tau)
    a, times = _free_and_inverse(model, q, v, tau)
    # Batching over columns shares the factors, which do not depend on them.
    return a, jax.vmap(times, 1, 1)(columns)


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


def mass_matrix_inverse_times(model: Model, q: Float[Array, " nq"], forces: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Product of M(q)^-1 and generalised forces (nv,), without forming M: two sweeps over the articulated bodies."""
    check_shapes(model, q=q, forces=forces)
    return solve(factorize(model, q), forces)


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
