"""Centre of mass, and momentum about it (EQUATIONS section 11)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.kinematics import TreeFrame, body_twists, sum_to_coordinates, take, tree_frame
from jaxdyn.dynamics.quantities import by_recursion, first_moments
from jaxdyn.dynamics.world_frame import momentum, tree_inertias
from jaxdyn.lie.so3 import cross
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


def center_of_mass(model: Model, q: Float[Array, " nq"]) -> Float[Array, "3"]:
    r"""Centre of mass of all bodies.

    $$c = \sum_i m_i c_i \Big/ \sum_i m_i$$

    **Arguments:** `q` (nq,).

    **Returns:** (3,), world position, m. NaN when no moving body has mass.
    """
    (q,) = check_shapes(model, q=q)
    return by_recursion(_center_of_mass, _center_of_mass, model, q)


def _center_of_mass(model: Model, q):
    mass, first, origin, shift = first_moments(model, tree_frame(model, q))
    # Positions relative to the tree's root: far from the world's origin, absolute positions would lose digits.
    return origin + jnp.sum(first + mass[:, None] * shift, axis=0) / jnp.sum(mass)


def centroidal_momentum(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "6"]:
    r"""Momentum of the whole mechanism about its centre of mass, in world axes.

    $$l = \sum_i m_i \dot c_i, \quad k = \sum_i (c_i - c) \times m_i \dot c_i + I_i \omega_i$$

    with the common centre of mass c. Without contact and joint torques on the world, k is constant and $\dot l = m g$.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (6,), linear (kg m/s) then angular (kg m^2/s). Rotors (armature) are left out. NaN when no body has
    mass.

    Source: Orin, Goswami & Lee (2013), eq. 21.
    """
    q, v = check_shapes(model, q=q, v=v)
    return by_recursion(_centroidal_momentum, _centroidal_momentum, model, q, v)


def _centroidal_momentum(model: Model, q, v):
    frame = tree_frame(model, q)
    momenta = jax.vmap(momentum)(tree_inertias(model, frame), body_twists(model, frame, v))
    return jnp.sum(_about_center(model, frame, momenta), axis=0)


def centroidal_momentum_matrix(model: Model, q: Float[Array, " nq"]) -> Float[Array, "6 nv"]:
    """Centroidal momentum matrix A(q), whose product A v is `centroidal_momentum`.

    **Arguments:** `q` (nq,).

    **Returns:** (6, nv), rows linear then angular, about the centre of mass in world axes.

    Source: Orin, Goswami & Lee (2013), eq. 22.
    """
    (q,) = check_shapes(model, q=q)
    return by_recursion(_centroidal_momentum_matrix, _centroidal_momentum_matrix, model, q)


def _centroidal_momentum_matrix(model: Model, q):
    frame = tree_frame(model, q)
    # Column k is the momentum of the composite body moved by coordinate k alone, which is Orin's formula A = X^T I J.
    composite = sum_to_coordinates(model, tree_inertias(model, frame))
    momenta = jax.vmap(momentum)(composite, frame.subspace)
    return _about_center(model, frame, momenta, model.topology.dof_body).T


def com_jacobian(model: Model, q: Float[Array, " nq"]) -> Float[Array, "3 nv"]:
    """Jacobian of the centre of mass: J v is the velocity of `center_of_mass`, in world axes.

    J is the linear part of the centroidal momentum matrix over the total mass, so the generalised force of gravity is
    $N = -m J^T g$.

    **Arguments:** `q` (nq,).

    **Returns:** (3, nv), m/s per unit of v. NaN when no body has mass.

    **Raises:** ValueError for a q that does not fit.

    Source: Orin, Goswami & Lee (2013), eq. 30.
    """
    (q,) = check_shapes(model, q=q)
    # The linear part of the momentum is m cdot, whatever the point of reference.
    return centroidal_momentum_matrix(model, q)[:3] / jnp.sum(model.inertias[:, 0])


def _about_center(model: Model, frame: TreeFrame, momenta: Array, bodies=None) -> Array:
    """Shift momenta (n, 6) of the given bodies from their tree frames to the centre of mass."""
    mass, first, _, shift = first_moments(model, frame)
    center = jnp.sum(first + mass[:, None] * shift, axis=0) / jnp.sum(mass)
    # The moment of momentum about another point changes by lever x l; the linear part stays.
    lever = shift - center[None]
    lever = lever if bodies is None else take(lever, bodies)
    angular = momenta[:, 3:] + jax.vmap(cross)(lever, momenta[:, :3])
    return jnp.concatenate([momenta[:, :3], angular], axis=1)
