"""Dynamics as matrix products: M(q) = S^T G^T I G S with G the constant ancestor mask.

In link frames G = (I - Gamma)^-1 holds an adjoint in every block (EQUATIONS section 4; `link_frame`). Written in one
frame for the whole tree those adjoints become identities, and G becomes the constant 0/1 matrix of the joints that
move each body. Velocities, accelerations and forces are then products with a constant matrix instead of recursions:

    V = G (S v),   A = G (S a + Sdot v) + A_0,   F_i = I_i A_i - ad_{V_i}^T I_i V_i,   tau = S . (G^T F).

The frame is the tree frame of `kinematics`. Inertias are sums of ten numbers, so composite inertias are one product
too. No function here checks its arguments: `quantities` does.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import kernel, sweep
from jaxdyn.dynamics.tree_frames import (
    TreeFrame,
    body_subspace,
    body_twists,
    map_rows,
    subspace_rate,
    sum_to_bodies,
    sum_to_coordinates,
    take,
    tree_frame,
)
from jaxdyn.lie import se3, so3
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.inertia import rotational_inertia, spatial_inertia, transform_inertia
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky


def mass_matrix(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix M_kl = S_k . I_c S_l with I_c the composite inertia of all bodies that both coordinates move, plus armature."""
    frame = tree_frame(model, q)
    return _mass_matrix(model, frame, tree_inertias(model, frame))


def mass_matrix_by_loops(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix of many bodies: composite bodies by native loops, and products of all pairs by JAX.

    M_kl = F_k . (v_l + w_l x (p_k - p_l), w_l) for a coordinate l that moves the body of k, with the momentum F_k of the
    composite body at v_k = 1. Each is taken at the origin of its own body, so that long chains lose no digits by distance.
    """
    momenta, subspace, place = kernel(_composite_momenta)(model, q)
    products = matmul(momenta, subspace.T)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        lever_j, lever_k = (place[:, None, x] - place[None, :, x] for x in (j, k))
        moment = lever_j * momenta[:, None, k] - lever_k * momenta[:, None, j]
        products = products + moment * subspace[None, :, 3 + i]
    return _fill_symmetric(model, products)


def _composite_momenta(model: Model, q):
    """Momenta F (nv, 6) of the composite bodies, motions S (nv, 6), and origins p (nv, 3), in world axes (see above)."""
    frame, topology = tree_frame(model, q), model.topology
    turn, place = frame.pose[:, :3, :3], frame.pose[:, :3, 3]
    parents = np.array([parent if parent >= 0 else model.nb for parent in topology.parents])
    lever = place - take(jnp.concatenate([place, jnp.zeros((1, 3), q.dtype)]), parents)

    def step(carried, row):
        turn, lever, own = row
        total = carried + transform_inertia(se3.from_parts(turn, jnp.zeros_like(lever)), own)
        return transform_inertia(se3.from_parts(jnp.eye(3, dtype=lever.dtype), lever), total), total

    rows = turn, lever, jnp.asarray(model.inertias)
    composite = sweep(step, topology.parents, jnp.zeros((10,), q.dtype), rows, inward=True)[1]
    turn, place, composite = (take(x, topology.dof_body) for x in (turn, place, composite))
    rotate = map_rows(lambda R, S: jnp.concatenate([matmul(R, S[:3]), matmul(R, S[3:])]), turn, body_subspace(model))
    return map_rows(momentum, composite, rotate), rotate, place


def gravity_force(model: Model, q: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Gravity force N_k = -S_k . (m g, m c x g) summed over the bodies that coordinate k moves: +dV/dq."""
    if model.gravity is None:
        return jnp.zeros((model.nv,), model.home.dtype)
    frame = tree_frame(model, q)
    # The ten numbers are needed up to the first moment only.
    mass = model.inertias[:, :1]
    first = matmul(frame.pose[:, :3, :3], model.inertias[:, 1:4, None])[..., 0] + mass * frame.pose[:, :3, 3]
    moved = sum_to_coordinates(model, jnp.concatenate([mass, first], axis=1))
    gravity = model.gravity
    torque = jax.vmap(cross, (0, None))(moved[:, 1:], gravity)
    return -(matmul(frame.subspace[:, :3], gravity) * moved[:, 0] + jnp.sum(frame.subspace[:, 3:] * torque, axis=1))


def inverse_dynamics(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"] | None,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    """Inverse dynamics tau = M a + C v + N - sum J_i^T external_i; `a` None means zero and compiles no acceleration terms."""
    frame = tree_frame(model, q)
    return _inverse_dynamics(model, frame, tree_inertias(model, frame), v, a, external)


def acceleration_and_inverse(model: Model, q, v, tau):
    """Forward dynamics a (nv,), and the function f -> M^-1 f, from one Cholesky factor of M."""
    frame = tree_frame(model, q)
    inertias = tree_inertias(model, frame)
    factor = cholesky(_mass_matrix(model, frame, inertias))
    a = solve_cholesky(factor, tau - _inverse_dynamics(model, frame, inertias, v, None, None))
    return a, lambda force: solve_cholesky(factor, force)


def forward_dynamics(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Forward dynamics a = M^-1 (tau - C v - N), by the Cholesky factor of M."""
    return acceleration_and_inverse(model, q, v, tau)[0]


def generalized_force(model: Model, q: Float[Array, " nq"], external: Float[Array, "nb 6"]) -> Float[Array, " nv"]:
    """Generalised force: sum of J_i^T f_i over the bodies, J_i the body Jacobian of body i."""
    frame = tree_frame(model, q)
    # Wrenches move to the tree frame, where those of all bodies add.
    wrenches = map_rows(se3.Ad_inv_T_apply, frame.pose, external)
    return jnp.sum(frame.subspace * sum_to_coordinates(model, wrenches), axis=1)


def coriolis_matrix(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "nv nv"]:
    """Coriolis matrix C = sum of J_i^T (I_i Jdot_i - ad_{V_i}^T I_i J_i) over the bodies.

    This is Cs of EQUATIONS section 4 in the tree frame.

    In a link frame Cs has the blocks J^T M Jdot + J^T (M ad_V - ad_V^T M) J; with J_s = Ad J, Jdot_s = Ad (Jdot + ad_V
    J) the term M ad_V joins the first. C + C^T = Mdot because Idot = -ad_V^T I - I ad_V.
    """
    frame = tree_frame(model, q)
    twists = body_twists(model, frame, v)
    subspace, rate = frame.subspace, subspace_rate(model, frame, twists)
    inertia = jax.vmap(spatial_inertia)(tree_inertias(model, frame))
    transport = -matmul(jax.vmap(se3.ad)(twists).transpose(0, 2, 1), inertia)
    # Both matrices are summed over subtrees by one product instead of two.
    flat = jnp.concatenate([inertia.reshape(-1, 36), transport.reshape(-1, 36)], axis=1)
    moved = sum_to_coordinates(model, flat)
    inertia, transport = moved[:, :36].reshape(-1, 6, 6), moved[:, 36:].reshape(-1, 6, 6)
    # Coordinates k, l share the bodies moved by the deeper of the two: its sums stand on the row below the diagonal
    # (k deeper), on the column above it.
    row_inertia = matmul(subspace[:, None], inertia)[:, 0]
    row_transport = matmul(subspace[:, None], transport)[:, 0]
    below = matmul(row_inertia, rate.T) + matmul(row_transport, subspace.T)
    column = matmul(inertia, rate[..., None])[..., 0] + matmul(transport, subspace[..., None])[..., 0]
    above = matmul(subspace, column.T)
    deeper = _descendant_mask(model)
    zero = jnp.zeros_like(below)
    return jnp.where(deeper, below, zero) + jnp.where(np.tril(deeper, -1).T, above, zero)


def torque_regressor(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]
) -> Float[Array, "nv nb10"]:
    """Regressor Y with Y pi = M a + C v + N without armature, pi the ten numbers of all bodies, one body after the other."""
    frame = tree_frame(model, q)
    twists = body_twists(model, frame, v)
    accelerations = _accelerations(model, frame, twists, v, a)
    to_body = jax.vmap(se3.Ad_inv_apply)
    wrenches = jax.vmap(_wrench_regressor)(to_body(frame.pose, twists), to_body(frame.pose, accelerations))
    # Column k of the body Jacobian of body i, for all i and k.
    columns = jax.vmap(jax.vmap(se3.Ad_inv_apply, (None, 0)), (0, None))(frame.pose, frame.subspace)
    columns = jnp.where(model.topology.dof_ancestors[:, :, None], columns, jnp.zeros_like(columns))
    return matmul(columns, wrenches).transpose(1, 0, 2).reshape(model.nv, 10 * model.nb)


def mass_matrix_derivative(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv nv"]:
    """Derivative D_ijk = dM_ij/dq_k in closed form (Property 2 of EQUATIONS section 2), for joints with v = dq/dt.

    D_ijk = T_ijk + T_jik, T_ijk = [S_i, S_k] . I_c S_j with I_c the inertia moved by all of i, j, k; zero unless they
    lie on one path to the root with joint i strictly above joint k. The bracket is the motion of S_i as seen by the
    bodies that joint k carries.
    """
    frame = tree_frame(model, q)
    subspace = frame.subspace
    composite = sum_to_coordinates(model, tree_inertias(model, frame))
    brackets = jax.vmap(jax.vmap(se3.ad_apply, (None, 0)), (0, None))(subspace, subspace)
    # I_c belongs to the deeper of j and k: two products, chosen by constant masks.
    carried = jax.vmap(jax.vmap(momentum), (None, 0))(composite, brackets)
    by_k = jnp.einsum("ikx,jx->ijk", carried, subspace, precision=jax.lax.Precision.HIGHEST)
    by_j = jnp.einsum(
        "ikx,jx->ijk", brackets, jax.vmap(momentum)(composite, subspace), precision=jax.lax.Precision.HIGHEST
    )
    deeper = _descendant_mask(model)
    above = np.tril(deeper, -1).T  # [i, k]: joint i strictly above joint k
    zero = jnp.zeros_like(by_k)
    term = jnp.where(above[:, None, :] & deeper.T[None], by_k, zero)
    term += jnp.where(above[:, None, :] & np.tril(deeper, -1)[None], by_j, zero)
    return term + term.transpose(1, 0, 2)


def tree_inertias(model: Model, frame: TreeFrame) -> Float[Array, "nb 10"]:
    """Inertial parameters of every body in its tree frame."""
    return map_rows(transform_inertia, frame.pose, model.inertias)


def momentum(parameters: Float[Array, "10"], twist: Float[Array, "6"]) -> Float[Array, "6"]:
    """Spatial momentum I V = (m v + omega x h, h x v + I omega), h = m c, at the frame's origin."""
    mass, first = parameters[0], parameters[1:4]
    v, omega = twist[:3], twist[3:]
    angular = cross(first, v) + matmul(rotational_inertia(parameters), omega)
    return jnp.concatenate([mass * v + cross(omega, first), angular])


def _descendant_mask(model: Model) -> np.ndarray:
    """Mask (nv, nv), true at [k, l] when coordinate l moves the body of coordinate k and is not listed after k."""
    return np.tril(model.topology.dof_ancestors[model.topology.dof_body])


def _mass_matrix(model: Model, frame: TreeFrame, inertias: Float[Array, "nb 10"]) -> Float[Array, "nv nv"]:
    composite = sum_to_coordinates(model, inertias)
    # Only entries of ancestors are valid: elsewhere the composite inertia is that of an unrelated subtree.
    forces = map_rows(momentum, composite, frame.subspace)
    return _fill_symmetric(model, matmul(forces, frame.subspace.T))


def _fill_symmetric(model: Model, products: Float[Array, "nv nv"]) -> Float[Array, "nv nv"]:
    """Mass matrix from products of which those of a coordinate (row) and one above it (column) are valid, and armature."""
    deeper = _descendant_mask(model)
    zero = jnp.zeros_like(products)
    matrix = jnp.where(deeper, products, zero) + jnp.where(np.tril(deeper, -1).T, products.T, zero)
    return matrix if model.armature is None else matrix + jnp.diag(model.armature)


def _accelerations(model, frame, twists, v, a) -> Float[Array, "nb 6"]:
    """Spatial accelerations, with the world accelerated against gravity: A_0 = (-g, 0) [EQUATIONS E10]."""
    rows = subspace_rate(model, frame, twists) * v[:, None]
    if a is not None:
        rows = rows + frame.subspace * a[:, None]
    accelerations = sum_to_bodies(model, rows)
    if model.gravity is None:
        return accelerations
    # Weight is then part of the inertial wrench and needs no term of its own.
    return accelerations - jnp.concatenate([model.gravity, jnp.zeros_like(model.gravity)])[None]


def joint_wrenches(model: Model, frame: TreeFrame, v, a, external) -> Float[Array, "nb 6"]:
    """Wrench through each joint, in the tree frame: the sum of the wrenches on the bodies that it carries."""
    wrenches = _body_wrenches(model, frame, tree_inertias(model, frame), v, a, external)
    # The transposed mask sums over descendants, where `ancestors` lists ancestors.
    return matmul(jnp.asarray(model.topology.ancestors.T, wrenches.dtype), wrenches)


def _body_wrenches(model, frame, inertias, v, a, external) -> Float[Array, "nb 6"]:
    """Resultant of the joint wrenches on each body: its rate of momentum less its weight and the external wrench."""
    twists = body_twists(model, frame, v)
    wrenches = map_rows(_inertial_wrench, inertias, twists, _accelerations(model, frame, twists, v, a))
    return wrenches if external is None else wrenches - map_rows(se3.Ad_inv_T_apply, frame.pose, external)


def _inverse_dynamics(model, frame, inertias, v, a, external) -> Float[Array, " nv"]:
    wrenches = _body_wrenches(model, frame, inertias, v, a, external)
    tau = jnp.sum(frame.subspace * sum_to_coordinates(model, wrenches), axis=1)
    return tau if a is None or model.armature is None else tau + model.armature * a


def _inertial_wrench(parameters, twist, acceleration) -> Float[Array, "6"]:
    """Inertial wrench I A - ad_V^T I V.

    With d = a + omega x v, the acceleration of the point at the frame's origin, it is
    (m d + alpha x h + omega x (omega x h), h x d + I alpha + omega x I omega).
    """
    mass, first, inertia = parameters[0], parameters[1:4], rotational_inertia(parameters)
    omega, alpha = twist[3:], acceleration[3:]
    point = acceleration[:3] + cross(omega, twist[:3])
    force = mass * point + cross(alpha, first) + cross(omega, cross(omega, first))
    torque = cross(first, point) + matmul(inertia, alpha) + cross(omega, matmul(inertia, omega))
    return jnp.concatenate([force, torque])


def _wrench_regressor(twist, acceleration) -> Float[Array, "6 10"]:
    """Matrix of `_inertial_wrench` as a linear function of the ten inertial parameters."""
    omega, alpha = twist[3:], acceleration[3:]
    point = acceleration[:3] + cross(omega, twist[:3])
    turn = so3.hat(omega)
    force = jnp.concatenate([point[:, None], so3.hat(alpha) + matmul(turn, turn), jnp.zeros((3, 6), twist.dtype)], 1)
    torque = [
        jnp.zeros((3, 1), twist.dtype),
        -so3.hat(point),
        _inertia_times(alpha) + matmul(turn, _inertia_times(omega)),
    ]
    return jnp.concatenate([force, jnp.concatenate(torque, 1)])


def _inertia_times(w: Float[Array, "3"]) -> Float[Array, "3 6"]:
    """Matrix L(w) with I w = L(w) (Ixx, Ixy, Iyy, Ixz, Iyz, Izz)."""
    x, y, z, zero = w[0], w[1], w[2], jnp.zeros_like(w[0])
    return jnp.stack([x, y, zero, z, zero, zero, zero, x, y, zero, z, zero, zero, zero, zero, x, y, z]).reshape(3, 6)
