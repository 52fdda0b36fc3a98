"""Equations of motion of a floating-base robot in centre-of-mass coordinates.

The velocity of the base's origin is replaced by that of the centre of mass, in world axes,

    nu = (cdot, omega, v_j) = T v,    T = [[J_com], [0  1]],    X = T^-1.

Then X^T M X = blkdiag(m 1, M'), and X^T N = (-m g, 0): the centre of mass moves like a particle, and

    m cddot = m g + f,    M' nudot' + C' nu' = tau',    nu' = (omega, v_j),    (f, tau') = X^T F,

with F the generalised forces in v other than gravity.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.dynamics.centroidal import com_jacobian
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.dynamics.quantities import coriolis_matrix, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import check_shapes, is_concrete
from jaxdyn.model.configuration import configuration_rate
from jaxdyn.model.inertia import rotational_inertia
from jaxdyn.model.tree import Model


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
    mass, com, about_com = jax.vmap(_at_center)(model.inertias)

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


def _at_center(parameters):
    """Mass, centre of mass (3,), and inertia (3, 3) about it, of a body; of a massless one about its origin."""
    mass = parameters[0]
    com = jnp.where(mass > 0, parameters[1:4] / jnp.where(mass > 0, mass, 1.0), 0.0)
    # I - m (c.c 1 - c c^T).
    moved = jnp.sum(com * com) * jnp.eye(3, dtype=com.dtype) - jnp.outer(com, com)
    return mass, com, rotational_inertia(parameters) - mass * moved


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
