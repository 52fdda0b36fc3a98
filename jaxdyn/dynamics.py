"""The dynamics of a model as users call it: M(q) a + C(q, v) v + N(q) = tau + sum of J_i^T f_i.

All functions take one sample, are pure, and can be batched, compiled and differentiated in every argument and in every
leaf of the model. Velocities and accelerations are the model's v and a (body-fixed, not dq/dt). Joint damping and
friction are forces of a scene and do not enter here; rotor inertia (armature) does.

Every function raises a ValueError that names the argument when a shape does not fit the model. Those with a time `t`
(s) take any `System` in the model's place; a Model's dynamics do not depend on it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn import _dispatch, matrix_form
from jaxdyn.kinematics import TreeFrame, body_twists, sum_to_coordinates, take, tree_frame
from jaxdyn.matrix_form import momentum, tree_inertias
from jaxdyn.model import Model, check_shapes
from jaxdyn.so3 import _product, cross
from jaxdyn.systems import System, checked_time, symbols


def mass_matrix(model: Model | System, q: Float[Array, " nq"], t=0.0) -> Float[Array, "nv nv"]:
    """Mass matrix M(q) = sum of J_i^T M_i J_i over the bodies + diag(armature), symmetric.

    **Arguments:** `q` (nq,).

    **Returns:** (nv, nv), kg m^2 for pairs of rotations, kg m and kg where translations take part. Positive definite
    when every joint moves some inertia.

    Source: Murray, Li & Sastry (1994), eq. 4.19; EQUATIONS sections 2 and 4.
    """
    if isinstance(model, System):
        return model.mass_matrix(q, checked_time(model, t, q=q))
    check_shapes(model, q=q)
    return _dispatch.mass_matrix(model, q)


def coriolis_matrix(
    model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t=0.0
) -> Float[Array, "nv nv"]:
    """Coriolis matrix C(q, v) with the skew property: C v are the Coriolis and centrifugal forces, dM/dt = C + C^T.

    C = sum of J_i^T (M_i Jdot_i + (M_i ad_{V_i} - ad_{V_i}^T M_i) J_i) in link frames. The matrix is not unique: other
    choices (Christoffel symbols, Pinocchio's) have the same C v and the same C + C^T.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (nv, nv). Linear in v.

    Source: EQUATIONS section 4, Cs and erratum E11.
    """
    if isinstance(model, System):
        return model.coriolis_matrix(q, v, checked_time(model, t, q=q, v=v))
    check_shapes(model, q=q, v=v)
    return matrix_form.coriolis_matrix(model, q, v)


def gravity_force(model: Model | System, q: Float[Array, " nq"], t=0.0) -> Float[Array, " nv"]:
    """Generalised gravity force N(q) = +dV/dq along the velocity coordinates; it stands on the left, with M a.

    **Arguments:** `q` (nq,).

    **Returns:** (nv,), N m or N: the torques that hold the mechanism at rest. Zero when `model.gravity` is None.
    """
    if isinstance(model, System):
        return model.gravity_force(q, checked_time(model, t, q=q))
    check_shapes(model, q=q)
    return _dispatch.gravity_force(model, q)


def bias_force(model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t=0.0) -> Float[Array, " nv"]:
    """Bias force h = C(q, v) v + N(q): what tau must be for zero acceleration a.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (nv,), N m or N.
    """
    if isinstance(model, System):
        return model.bias_force(q, v, checked_time(model, t, q=q, v=v))
    check_shapes(model, q=q, v=v)
    return _dispatch.bias_force(model, q, v)


def inverse_dynamics(
    model: Model | System,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"],
    t=0.0,
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    """Generalised forces of a motion: tau = M(q) a + C(q, v) v + N(q) - sum of J_i^T f_i.

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,), rate of v; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** (nv,), N m or N.

    Source: EQUATIONS section 4.
    """
    if isinstance(model, System):
        t = checked_time(model, t, external, q=q, v=v, a=a)
        return model.inverse_dynamics(q, v, a, t)
    check_shapes(model, q=q, v=v, a=a, external=external)
    tau = _dispatch.inverse_dynamics(model, q, v, a)
    return tau if external is None else tau - matrix_form.generalized_force(model, q, external)


def forward_dynamics(
    model: Model | System,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    t=0.0,
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    """Acceleration under given forces: a = M(q)^-1 (tau - C(q, v) v - N(q) + sum of J_i^T f_i).

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,), N m or N; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** (nv,), the rate of v. NaN when M is not positive definite, which a joint that moves no inertia causes;
    the error grows with the condition number of M.

    **Raises:** ValueError, on concrete numbers, for a `System` without a motion here: M singular (its rank is named), a
    Lagrangian that is not finite, an immersion of too low a rank.
    """
    if isinstance(model, System):
        t = checked_time(model, t, external, q=q, v=v, tau=tau)
        model.check_start(q, v, t)
        return model.forward_dynamics(q, v, tau, t)
    check_shapes(model, q=q, v=v, tau=tau, external=external)
    if external is not None:
        tau = tau + matrix_form.generalized_force(model, q, external)
    return _dispatch.forward_dynamics(model, q, v, tau)


def generalized_force(model: Model, q: Float[Array, " nq"], external: Float[Array, "nb 6"]) -> Float[Array, " nv"]:
    """Generalised forces of wrenches on the bodies: sum of J_i^T f_i.

    **Arguments:** `q` (nq,); `external` (nb, 6), wrench (f, tau) ON each body, at its frame's origin and in its axes
    (N, N m).

    **Returns:** (nv,), N m or N; it stands on the right, with tau.
    """
    check_shapes(model, q=q, external=external)
    return matrix_form.generalized_force(model, q, external)


def kinetic_energy(model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t=0.0) -> Float[Array, ""]:
    """Kinetic energy T = 1/2 sum of V_i . M_i V_i + 1/2 sum of armature v^2 = 1/2 v . M(q) v.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (), J.
    """
    if isinstance(model, System):
        return model.kinetic_energy(q, v, checked_time(model, t, q=q, v=v))
    check_shapes(model, q=q, v=v)
    frame = tree_frame(model, q)
    twists = body_twists(model, frame, v)
    energy = 0.5 * jnp.sum(twists * jax.vmap(momentum)(tree_inertias(model, frame), twists))
    return energy if model.armature is None else energy + 0.5 * jnp.sum(model.armature * v * v)


def potential_energy(model: Model | System, q: Float[Array, " nq"], t=0.0) -> Float[Array, ""]:
    """Potential energy of gravity, V = -sum of m_i g . c_i with c_i the world position of each centre of mass.

    Zero height is the plane through the world's origin. Far from it the value is large, and small differences of it are
    lost to rounding.

    **Arguments:** `q` (nq,).

    **Returns:** (), J. Zero when `model.gravity` is None.
    """
    if isinstance(model, System):
        return model.potential_energy(q, checked_time(model, t, q=q))
    check_shapes(model, q=q)
    if model.gravity is None:
        return jnp.zeros((), model.home.dtype)
    mass, first, origin, shift = _first_moments(model, tree_frame(model, q))
    return -jnp.sum(model.gravity * (jnp.sum(mass) * origin + jnp.sum(first + mass[:, None] * shift, axis=0)))


def center_of_mass(model: Model, q: Float[Array, " nq"]) -> Float[Array, "3"]:
    """Centre of mass of all bodies, c = sum of m_i c_i / sum of m_i.

    **Arguments:** `q` (nq,).

    **Returns:** (3,), world position, m. NaN when no body has mass.
    """
    check_shapes(model, q=q)
    mass, first, origin, shift = _first_moments(model, tree_frame(model, q))
    return origin + jnp.sum(first + mass[:, None] * shift, axis=0) / jnp.sum(mass)


def centroidal_momentum(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "6"]:
    """Momentum of the whole mechanism about its centre of mass, in world axes.

    (l, k) = (sum of m_i cdot_i, sum of (c_i - c) x m_i cdot_i + I_i omega_i), c the common centre of mass. Without
    contact and joint torques on the world, k is constant and dl/dt = m g.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (6,), linear (kg m/s) then angular (kg m^2/s). Rotors (armature) are left out. NaN when no body has
    mass.

    Source: Orin, Goswami & Lee (2013), eq. 21.
    """
    check_shapes(model, q=q, v=v)
    frame = tree_frame(model, q)
    momenta = jax.vmap(momentum)(tree_inertias(model, frame), body_twists(model, frame, v))
    return jnp.sum(_about_center(model, frame, momenta), axis=0)


def centroidal_momentum_matrix(model: Model, q: Float[Array, " nq"]) -> Float[Array, "6 nv"]:
    """Centroidal momentum matrix A(q): `centroidal_momentum(model, q, v)` = A v.

    **Arguments:** `q` (nq,).

    **Returns:** (6, nv), rows linear then angular, about the centre of mass in world axes.

    Source: Orin, Goswami & Lee (2013), eq. 22.
    """
    check_shapes(model, q=q)
    frame = tree_frame(model, q)
    composite = sum_to_coordinates(model, tree_inertias(model, frame))
    momenta = jax.vmap(momentum)(composite, frame.subspace)
    return _about_center(model, frame, momenta, model.topology.dof_body).T


def torque_regressor(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]
) -> Float[Array, "nv nb10"]:
    """Regressor Y(q, v, a) of inverse dynamics: tau = Y pi, linear in the inertial parameters.

    pi = `model.inertias.reshape(-1)`, the numbers (m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) of one body after
    the other. Rotor inertia is not among them: `inverse_dynamics` = Y pi + armature a.

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,).

    **Returns:** (nv, 10 nb).

    Source: Atkeson, An & Hollerbach (1986).
    """
    check_shapes(model, q=q, v=v, a=a)
    return matrix_form.torque_regressor(model, q, v, a)


def mass_matrix_derivative(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv nv"]:
    """Derivative of the mass matrix, D_ijk = dM_ij/dq_k, in closed form.

    **Arguments:** `q` (nq,).

    **Returns:** (nv, nv, nv).

    **Raises:** ValueError when the model has a joint whose v is not dq/dt (planar, spherical, free).

    Source: Li & Wu, Property 2, corrected (EQUATIONS section 2, E8).
    """
    _check_coordinates(model, "mass_matrix_derivative")
    check_shapes(model, q=q)
    return matrix_form.mass_matrix_derivative(model, q)


def christoffel_symbols(model: Model | System, q: Float[Array, " nq"], t=0.0) -> Float[Array, "nv nv nv"]:
    """Christoffel symbols of the first kind, Gamma_ijk = 1/2 (dM_ij/dq_k + dM_ik/dq_j - dM_kj/dq_i).

    The matrix C_ij = sum_k Gamma_ijk v_k has the same C v and C + C^T as `coriolis_matrix`.

    **Arguments:** `q` (nq,).

    **Returns:** (nv, nv, nv), symmetric in j and k.

    **Raises:** ValueError when the model has a joint whose v is not dq/dt (planar, spherical, free).

    Source: Murray, Li & Sastry (1994), eq. 4.23; EQUATIONS section 0.
    """
    if isinstance(model, System):
        return model.christoffel_symbols(q, checked_time(model, t, q=q))
    _check_coordinates(model, "christoffel_symbols")
    check_shapes(model, q=q)
    return symbols(matrix_form.mass_matrix_derivative(model, q))


def _check_coordinates(model: Model, name: str) -> None:
    joints = zip(model.topology.kinds, model.joint_names, strict=True)
    other = [f"{joint!r} ({kind})" for kind, joint in joints if kind in ("planar", "spherical", "free")]
    if other:
        raise ValueError(
            f"{name}: symbols need coordinates with v = dq/dt (nq = nv), but model {model.name!r} has joints"
            f" {', '.join(other)} (nq = {model.nq}, nv = {model.nv}); use coriolis_matrix, which needs none"
        )


def _first_moments(model: Model, frame: TreeFrame):
    """Masses (nb,), first moments (nb, 3) in the tree frames, world position (3,) of the first tree's origin, and shifts.

    A shift (3,) is the place of a body's tree frame relative to the first one: zero, not a difference of far
    positions, for one tree.
    """
    mass = model.inertias[:, 0]
    rotated = _product(frame.pose[:, :3, :3], model.inertias[:, 1:4, None])[..., 0]
    origin = frame.origin[0]
    return mass, rotated + mass[:, None] * frame.pose[:, :3, 3], origin, frame.origin - origin[None]


def _about_center(model: Model, frame: TreeFrame, momenta: Array, bodies=None) -> Array:
    """Momenta (n, 6) taken in tree frames, of the given bodies, moved to the centre of mass."""
    mass, first, _, shift = _first_moments(model, frame)
    center = jnp.sum(first + mass[:, None] * shift, axis=0) / jnp.sum(mass)
    lever = shift - center[None]
    lever = lever if bodies is None else take(lever, bodies)
    return momenta.at[:, 3:].add(jax.vmap(cross)(lever, momenta[:, :3]))
