"""Sums over bodies: energies, centre of mass, momentum about it, and equations of motion in its coordinates (EQUATIONS 11)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.dynamics.quantities import by_recursion, coriolis_matrix, mass_matrix, system_quantity
from jaxdyn.dynamics.tree_frames import TreeFrame, body_twists, sum_to_coordinates, take, tree_frame
from jaxdyn.dynamics.world_frame import momentum, tree_inertias
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Numbers, check_shapes, check_state, is_concrete
from jaxdyn.model.configuration import configuration_rate
from jaxdyn.model.inertia import mass_com_inertia
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
    mass, moment, origin, _ = first_moments(model, tree_frame(model, q))
    gravity: Any = model.gravity
    return -jnp.sum(gravity * (mass * origin + moment))


def first_moments(model: Model, frame: TreeFrame):
    """Mass (), first moment (3,) about the first tree's origin, that origin in the world (3,), and shifts (nb, 3).

    A shift is the position of a body's tree frame relative to the first one: exactly zero, not a difference of distant positions,
    for one tree.
    """
    mass = model.inertias[:, 0]
    # First moments m c rather than centres c: massless bodies need no division.
    rotated = matmul(frame.pose[:, :3, :3], model.inertias[:, 1:4, None])[..., 0]
    origin = frame.origin[0] if model.nb else jnp.zeros((3,), mass.dtype)
    shift = frame.origin - origin[None]
    moments = rotated + mass[:, None] * frame.pose[:, :3, 3] + mass[:, None] * shift
    return jnp.sum(mass), jnp.sum(moments, axis=0), origin, shift


def center_of_mass(model: Model, q: Float[Array, " nq"]) -> Float[Array, "3"]:
    r"""Centre of mass of all bodies.

    $$c = \sum_i m_i c_i \Big/ \sum_i m_i$$

    **Arguments:** `q` (nq,).

    **Returns:** (3,), world position, m. NaN when no moving body has mass.
    """
    (q,) = check_shapes(model, q=q)
    return by_recursion(_center_of_mass, _center_of_mass, model, q)


def _center_of_mass(model: Model, q):
    mass, moment, origin, _ = first_moments(model, tree_frame(model, q))
    # Positions relative to the tree's root: far from the world's origin, absolute positions would lose digits.
    return origin + moment / mass


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
    mass, moment, _, shift = first_moments(model, frame)
    # The moment of momentum about another point changes by lever x l; the linear part stays.
    lever = shift - (moment / mass)[None]
    lever = lever if bodies is None else take(lever, bodies)
    angular = momenta[:, 3:] + jax.vmap(cross)(lever, momenta[:, :3])
    return jnp.concatenate([momenta[:, :3], angular], axis=1)


# Equations of motion of a floating-base robot in centre-of-mass coordinates.
#
# The velocity of the base's origin is replaced by that of the centre of mass, in world axes,
#
#     nu = (cdot, omega, v_j) = T v,    T = [[J_com], [0  1]],    X = T^-1.
#
# Then X^T M X = blkdiag(m 1, M'), and X^T N = (-m g, 0): the centre of mass moves like a particle, and
#
#     m cddot = m g + f,    M' nudot' + C' nu' = tau',    nu' = (omega, v_j),    (f, tau') = X^T F,
#
# with F the generalised forces in v other than gravity.


class ComDynamics(eqx.Module):
    r"""Terms of the equations of motion in centre-of-mass coordinates (see `com_dynamics`); k = nv - 3.

    - `mass` (): m, kg.
    - `mass_matrix` (k, k): $M'$. It depends on the joints alone.
    - `coriolis_matrix` (k, k): $C'$, with $\dot M' - 2 C'$ skew. It does not depend on the velocity of the centre of mass.
    - `jacobian` (nv, nv): T. `jacobian_rate` (nv, nv): $\dot T$ along v, so that $\dot\nu = T a + \dot T v$.
    - `inverse` (nv, nv): $X = T^{-1}$.
    """

    mass: Float[Array, ""]
    mass_matrix: Float[Array, "k k"]
    coriolis_matrix: Float[Array, "k k"]
    jacobian: Float[Array, "nv nv"]
    jacobian_rate: Float[Array, "nv nv"]
    inverse: Float[Array, "nv nv"]


class SpatialForm(NamedTuple):
    """Newton's and Euler's equations of all bodies at their centres of mass, in the axes of the world.

    `force` (nb, 3) f = m pdd, N; `torque` (nb, 3) I_s wdot_s + w_s x (I_s w_s), N m; `angular_momentum` (nb, 3) I_s w_s,
    N m s; `inertia` (nb, 3, 3) I_s = R I R^T, kg m^2.
    """

    force: Float[Array, "nb 3"]
    torque: Float[Array, "nb 3"]
    angular_momentum: Float[Array, "nb 3"]
    inertia: Float[Array, "nb 3 3"]


def spatial_form(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]) -> SpatialForm:
    r"""Resultant force and torque that move each body, in the spatial form of Newton's and Euler's equations.

    $$f_s = m \ddot p, \quad \tau_s = \tfrac{d}{dt} (I_s \omega_s) = I_s \dot\omega_s + \omega_s \times I_s \omega_s$$

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,), the rate of v.

    **Returns:** `SpatialForm`, gravity and joint forces included in the resultants. `generalized_force(model, q, wrenches,
    axes="inertial")` of them is the inverse dynamics without gravity and armature.

    Source: EQUATIONS section 3.
    """
    q, v, a = check_shapes(model, q=q, v=v, a=a)
    mass, com, about_com = jax.vmap(mass_com_inertia)(model.inertias)

    def placed(q):
        poses = forward_kinematics(model, q)
        rotations = poses[:, :3, :3]
        return poses[:, :3, 3] + jnp.einsum("bij,bj->bi", rotations, com), rotations

    def moving(q, v):
        (_, rotations), (velocity, rate) = jax.jvp(placed, (q,), (configuration_rate(model, q, v),))
        spin = jnp.einsum("bij,bkj->bik", rate, rotations)
        omega = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        inertia = jnp.einsum("bij,bjk,blk->bil", rotations, about_com, rotations)
        return velocity, jnp.einsum("bij,bj->bi", inertia, omega), inertia

    (_, momentum, inertia), (acceleration, torque, _) = jax.jvp(moving, (q, v), (configuration_rate(model, q, v), a))
    return SpatialForm(mass[:, None] * acceleration, torque, momentum, inertia)


def com_dynamics(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> ComDynamics:
    r"""Mass matrix, Coriolis matrix and velocity map in centre-of-mass coordinates of a floating base.

    $$\nu = T v = (\dot c, \omega, v_j), \quad m \ddot c = m g + f, \quad
    M' \dot\nu' + C' \nu' = \tau', \quad \nu' = (\omega, v_j)$$

    The velocities are that of the centre of mass in world axes, the angular velocity of the base in its own axes, and those of
    the joints. With $(f, \tau') = X^T F$, joint torques enter $\tau'$ unchanged, and not f.

    **Arguments:** `q` (nq,); `v` (nv,). The first body has a free joint and carries all others.

    **Returns:** `ComDynamics`; kg, kg m^2 for pairs of rotations, m/s and rad/s for nu.

    **Raises:** ValueError for shapes that do not fit, and for a model without a free base that carries all bodies, or
    with armature on it.

    ```python
    robot = jd.robots.quadruped()
    terms = jd.dynamics.com_dynamics(robot, jd.neutral(robot), jnp.zeros(robot.nv))
    cdot = (terms.jacobian @ jnp.ones(robot.nv))[:3]
    ```

    Source: Caron, equations of motion; Garofalo, Henze, Englsberger & Ott (2015); EQUATIONS section 11.
    """
    q, v = check_shapes(model, q=q, v=v)
    topology = model.topology
    # Roots have smaller indices than their children, so a single root is body 0.
    if not model.nb or topology.kinds[0] != "free" or min(topology.parents[1:], default=0) < 0:
        roots = [i for i, parent in enumerate(topology.parents) if parent < 0]
        found = ", ".join(f"{model.body_names[i]!r} ({topology.kinds[i]})" for i in roots) or "no body"
        raise ValueError(
            f"com_dynamics: the roots of model {model.name!r} are {found}; give a model with one root, on a free joint"
            " (floating_base=True when it is loaded)"
        )
    # Rotor inertia on the base would couple the centre of mass with the joints.
    if model.armature is not None and is_concrete(model.armature) and np.any(np.asarray(model.armature[:6])):
        raise ValueError(f"com_dynamics: armature of the base is {np.asarray(model.armature[:6])}; it must be zero")
    return _com_dynamics(model, q, v)


@entry_point
def _com_dynamics(model: Model, q, v) -> ComDynamics:
    unit = jnp.eye(model.nv, dtype=q.dtype)[3:]

    def velocity_map(q):
        return jnp.concatenate([com_jacobian(model, q), unit])

    def inverse_map(q):
        jacobian = com_jacobian(model, q)
        # The first block is the rotation of the base, as all mass moves with it: its inverse is its transpose.
        turn = jacobian[:, :3].T
        return jnp.concatenate([jnp.concatenate([turn, -matmul(turn, jacobian[:, 3:])], axis=1), unit])

    # A derivative along the motion: a quaternion's rate is not v, hence `configuration_rate`.
    T, T_rate = jax.jvp(velocity_map, (q,), (configuration_rate(model, q, v),))
    # C' is evaluated with the centre of mass at rest: M' does not depend on its motion, but a Coriolis matrix may.
    internal = matmul(inverse_map(q)[:, 3:], v[3:])
    X, X_rate = jax.jvp(inverse_map, (q,), (configuration_rate(model, q, internal),))
    part, M = X[:, 3:], mass_matrix(model, q)
    # M d/dt(X nu) = M X nudot + M dX/dt nu: the second term belongs to C'.
    forces = matmul(coriolis_matrix(model, q, internal), part) + matmul(M, X_rate[:, 3:])
    return ComDynamics(
        mass=jnp.sum(model.inertias[:, 0]),
        # Columns 3 on: the block of the centre of mass is m 1 and decouples.
        mass_matrix=matmul(part.T, matmul(M, part)),
        coriolis_matrix=matmul(part.T, forces),
        jacobian=T,
        jacobian_rate=T_rate,
        inverse=X,
    )
