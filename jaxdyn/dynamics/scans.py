"""Recursions as loops over the bodies: run time proportional to their number, program size independent of it.

For mechanisms of hundreds of bodies: matrices cost O(nb^3), and unrolled recursions take minutes to compile. In kernels these are
native loops (`jaxdyn.compile.sweep`), for joints of any kinds; those of one degree of freedom have faster ones, with canonical
frames, in `recursions.sweeps`. Link frames as in EQUATIONS sections 4 and 5, so that long chains lose no digits by distance.
Joints of several degrees of freedom are eliminated at once; all joints are padded to the largest of them.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import sweep
from jaxdyn.dynamics.tree_frames import body_subspace, map_rows, relative_poses
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.inertia import spatial_inertia
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive


class _Links(NamedTuple):
    """Data of each body: Ad from the parent's frame, subspace (d, 6), spatial inertia."""

    down: Float[Array, "nb 6 6"]
    subspace: Float[Array, "nb d 6"]
    inertia: Float[Array, "nb 6 6"]


class Factor(NamedTuple):
    """Factorisation of M: per body its articulated inertia, D^-1 (d, d) and D^-1 U^T (d, 6)."""

    links: _Links
    inertia: Float[Array, "nb 6 6"]
    inverse: Float[Array, "nb d d"]
    gain: Float[Array, "nb d 6"]


def _padding(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Indices (nb, d) of each body's velocities in v, and the mask of those that its joint has."""
    slices = model.topology.v_slices
    maximum = max(part.stop - part.start for part in slices)
    places = np.array([part.start for part in slices])[:, None] + np.arange(maximum)
    own = places < np.array([part.stop for part in slices])[:, None]
    # Any valid index does for padding: the mask removes what it reads.
    return np.where(own, places, 0), own


def _per_body(model: Model, rows: Array) -> Array:
    """Gather rows (nv, ...) as (nb, d, ...), with zeros where a joint has fewer than d."""
    places, own = _padding(model)
    return jnp.where(own.reshape(own.shape + (1,) * (rows.ndim - 1)), rows[places], jnp.zeros((), rows.dtype))


def _links(model: Model, q) -> _Links:
    down = map_rows(lambda pose: se3.Ad(se3.inverse(pose)), relative_poses(model, q))
    inertias = map_rows(spatial_inertia, jnp.asarray(model.inertias))
    return _Links(down, _per_body(model, body_subspace(model)), inertias)


def _wrenches(model: Model, links: _Links, v, a) -> tuple[Float[Array, "nb 6"], Float[Array, "nb 6"]]:
    """Inertial wrench and twist rate of each body in its own frame, gravity included: the outward pass of Newton-Euler."""
    zero = jnp.zeros((6,), v.dtype)
    # The world is accelerated against gravity.
    rest = zero if model.gravity is None else zero.at[:3].set(-model.gravity)
    own_v = jnp.einsum("bd,bdk->bk", _per_body(model, v), links.subspace)
    own_a = jnp.zeros_like(own_v) if a is None else jnp.einsum("bd,bdk->bk", _per_body(model, a), links.subspace)

    def outward(outer, link):
        down, turn, push, inertia = link
        twist = matmul(down, outer[0]) + turn
        # ad_V of the joint's own twist is the Coriolis part of the rate in the body's frame.
        rate = matmul(down, outer[1]) + push + se3.ad_apply(twist, turn)
        wrench = matmul(inertia, rate) - se3.adT_apply(twist, matmul(inertia, twist))
        return (twist, rate), (wrench, rate)

    return sweep(outward, model.topology.parents, (zero, rest), (links.down, own_v, own_a, links.inertia))[1]


def inverse_dynamics(model: Model, q, v, a) -> Float[Array, " nv"]:
    """Inverse dynamics tau = M a + C v + N (nv,) by the recursive Newton-Euler algorithm; `a` None means zero."""
    links = _links(model, q)
    wrenches, _ = _wrenches(model, links, v, a)

    def inward(carried, link):
        down, subspace, wrench = link
        total = carried + wrench
        return matmul(down.T, total), matmul(subspace, total)

    rows = links.down, links.subspace, wrenches
    tau = _flat(model, sweep(inward, model.topology.parents, jnp.zeros((6,), v.dtype), rows, inward=True)[1])
    return tau if a is None or model.armature is None else tau + model.armature * a


def _flat(model: Model, values: Float[Array, "nb d"]) -> Float[Array, " nv"]:
    # Row-major order of the mask is the order of v.
    return values[np.nonzero(_padding(model)[1])]


def _factorize(model: Model, links: _Links) -> Factor:
    """Factorise the articulated inertias from the leaves to the root."""
    dtype, own = links.down.dtype, jnp.asarray(_padding(model)[1])
    armature = jnp.zeros((model.nv,), dtype) if model.armature is None else model.armature
    # Padding coordinates get a pivot of one and no coupling: their accelerations are zero and change nothing.
    extra = jnp.where(own, _per_body(model, armature), jnp.ones((), dtype))

    def inward(carried, link):
        down, S, own, extra = link
        inertia = carried + own
        # Rows of S are the directions of the joint, so U is the transpose of that in the literature.
        U = matmul(S, inertia)
        inverse = solve_positive(matmul(U, S.T) + jnp.diag(extra), jnp.eye(S.shape[0], dtype=dtype))
        gain = matmul(inverse, U)
        left = inertia - matmul(U.T, gain)
        return matmul(down.T, matmul(left, down)), (inertia, inverse, gain)

    rows = links.down, links.subspace, links.inertia, extra
    return Factor(links, *sweep(inward, model.topology.parents, jnp.zeros((6, 6), dtype), rows, inward=True)[1])


def _residuals(model: Model, factor: Factor, tau, wrenches) -> tuple[Float[Array, "nb d"], Float[Array, "nb 6"]]:
    """Residual joint forces tau - S^T p, and the wrench p on each body of the bodies that it carries: the inward sweep."""
    links = factor.links

    def inward(carried, link):
        down, S, gain, force, own = link
        total = carried if own is None else carried + own
        left = force - matmul(S, total)
        # The wrench on the parent includes the reaction to the residual joint force, left gain.
        return matmul(down.T, total + matmul(left, gain)), (left, total)

    rows = links.down, links.subspace, factor.gain, _per_body(model, tau), wrenches
    return sweep(inward, model.topology.parents, jnp.zeros((6,), tau.dtype), rows, inward=True)[1]


def _solve(model: Model, factor: Factor, tau, wrenches) -> Float[Array, " nv"]:
    """Solve M a = tau - (generalised forces of the wrenches) by two sweeps."""
    links = factor.links
    residual, _ = _residuals(model, factor, tau, wrenches)

    def outward(outer, link):
        down, S, gain, inverse, left = link
        twist = matmul(down, outer)
        a = matmul(inverse, left) - matmul(gain, twist)
        return twist + matmul(a, S), a

    rows = links.down, links.subspace, factor.gain, factor.inverse, residual
    return _flat(model, sweep(outward, model.topology.parents, jnp.zeros((6,), tau.dtype), rows)[1])


def acceleration_and_inverse(model: Model, q, v, tau):
    """Forward dynamics a (nv,), and the function f -> M^-1 f, from one factorisation by articulated bodies."""
    links = _links(model, q)
    factor = _factorize(model, links)
    # Wrenches at zero joint acceleration carry C v + N, so the sweeps are those of M^-1 alone.
    a = _solve(model, factor, tau, _wrenches(model, links, v, None)[0])
    return a, lambda force: _solve(model, factor, force, None)


def forward_dynamics(model: Model, q, v, tau) -> Float[Array, " nv"]:
    """Forward dynamics a = M^-1 (tau - C v - N) (nv,) by the articulated-body algorithm."""
    return acceleration_and_inverse(model, q, v, tau)[0]


def articulated_bodies(model: Model, q, v, tau, external) -> tuple[Float[Array, "nb 6 6"], Float[Array, "nb 6"]]:
    """Articulated inertias A_i and biases b_i: the joint of body i transmits A_i Vdot_i + b_i."""
    links = _links(model, q)
    factor = _factorize(model, links)
    wrenches, rates = _wrenches(model, links, v, None)
    _, wrenches = _residuals(model, factor, tau, wrenches if external is None else wrenches - external)
    # The sweeps count accelerations from those of zero joint accelerations; b_i counts from rest.
    return factor.inertia, wrenches - jnp.einsum("bij,bj->bi", factor.inertia, rates, precision=lax.Precision.HIGHEST)
