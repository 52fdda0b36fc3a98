"""Sums over bodies: energies, centre of mass, and momentum about it (EQUATIONS section 11)."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.quantities import by_recursion, system_quantity
from jaxdyn.dynamics.tree_frames import TreeFrame, body_twists, sum_to_coordinates, take, tree_frame
from jaxdyn.dynamics.world_frame import momentum, tree_inertias
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Numbers, check_shapes, check_state
from jaxdyn.model.tree import Model
from jaxdyn.systems.system import System


def kinetic_energy(
    model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, ""]:
    r"""Kinetic energy of the bodies and the rotors.

    $$T = \tfrac12 \sum_i V_i^T M_i V_i + \tfrac12 \sum_j \mathrm{armature}_j v_j^2 = \tfrac12 v^T M(q) v$$

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (), J.
    """
    if isinstance(model, System):
        return system_quantity("kinetic_energy", model, *check_state(model, q=q, v=v, t=t))
    q, v = check_shapes(model, q=q, v=v)
    return by_recursion(_kinetic_energy, _kinetic_energy, model, q, v)


def _kinetic_energy(model: Model, q, v):
    frame = tree_frame(model, q)
    twists = body_twists(model, frame, v)
    energy = 0.5 * jnp.sum(twists * jax.vmap(momentum)(tree_inertias(model, frame), twists))
    return energy if model.armature is None else energy + 0.5 * jnp.sum(model.armature * v * v)


def potential_energy(model: Model | System, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, ""]:
    r"""Potential energy of gravity.

    $$V = -\sum_i m_i g^T c_i$$

    with the world position $c_i$ of each centre of mass. Zero height is the plane through the world's origin. Far from it
    the value is large, and small differences of it are lost to rounding.

    **Arguments:** `q` (nq,).

    **Returns:** (), J. Zero when `model.gravity` is None.
    """
    if isinstance(model, System):
        return system_quantity("potential_energy", model, *check_state(model, q=q, t=t))
    (q,) = check_shapes(model, q=q)
    if model.gravity is None:
        return jnp.zeros((), model.home.dtype)
    return by_recursion(_potential_energy, _potential_energy, model, q)


def _potential_energy(model: Model, q):
    # Centres relative to the tree's root first; only their sum meets the large world position.
    mass, first, origin, shift = first_moments(model, tree_frame(model, q))
    gravity: Any = model.gravity
    return -jnp.sum(gravity * (jnp.sum(mass) * origin + jnp.sum(first + mass[:, None] * shift, axis=0)))


def first_moments(model: Model, frame: TreeFrame):
    """Masses (nb,), first moments (nb, 3) in the tree frames, world position (3,) of the first tree's origin, and shifts.

    A shift (3,) is the position of a body's tree frame relative to the first one: exactly zero, not a difference of distant
    positions, for one tree.
    """
    mass = model.inertias[:, 0]
    # First moments m c rather than centres c: massless bodies need no division.
    rotated = matmul(frame.pose[:, :3, :3], model.inertias[:, 1:4, None])[..., 0]
    origin = frame.origin[0] if model.nb else jnp.zeros((3,), mass.dtype)
    return mass, rotated + mass[:, None] * frame.pose[:, :3, 3], origin, frame.origin - origin[None]


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
