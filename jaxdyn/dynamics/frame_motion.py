"""Motion of frames, dynamics at one of them (the workspace form), and wrenches through joints."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point, gram_eigenvectors, kernel
from jaxdyn.compile.known import is_concrete
from jaxdyn.dynamics import scans, tree_frames
from jaxdyn.dynamics.kinematics import all_coordinates, body_frames, body_jacobian, of_frame, twists_in_frame
from jaxdyn.dynamics.quantities import coriolis_matrix, gravity_force, mass_matrix
from jaxdyn.dynamics.tree_frames import take, tree_frame
from jaxdyn.dynamics.world_frame import joint_wrenches
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import as_static, check_shapes
from jaxdyn.model.configuration import configuration_rate
from jaxdyn.model.topology import joint_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import mass_factor, solve_positive


def frame_jacobian(
    model: Model, q: Float[Array, " nq"], frame: str | None, *, axes: str = "world"
) -> Float[Array, "6 nv"]:
    """Jacobian of a named frame at its own origin, in the axes of the world or in its own.

    **Arguments:** `q` (nq,); `frame`, one of `model.frame_names` or of `model.joint_names` (None: the world, J = 0);
    `axes`: "world", so that J v is `frame_velocity`, or "body", which is `body_jacobian`.

    **Returns:** (6, nv): linear then angular velocity, m/s and rad/s per unit of v. Its transpose maps a wrench (f, tau) at
    the frame's origin, in those axes, to generalised forces.

    **Raises:** ValueError for an unknown frame, other axes, or a q that does not fit.

    Source: EQUATIONS section 2; the body Jacobian with both parts rotated into the world.
    """
    if axes == "body":
        return body_jacobian(model, q, frame)
    if axes != "world":
        raise ValueError(f"axes is {axes!r}; choose from world, body")
    (q,) = check_shapes(model, q=q)
    return of_frame(_jacobian, (6, model.nv), model, frame, q)


@kernel(static=1)
def _jacobian(body: int, tree, q):
    model, offset = tree
    frames = body_frames(model, q, [body])
    columns = all_coordinates(model, frames, twists_in_frame(frames, offset, frames.subspace))
    # The body Jacobian holds both parts in the frame's axes at its origin; rotating them changes axes, not the point.
    turn = matmul(frames.pose[0], jnp.asarray(offset))[:3, :3]
    return jnp.concatenate([matmul(turn, columns[:, :3].T), matmul(turn, columns[:, 3:].T)])


def frame_velocity(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], frame: str | None
) -> Float[Array, "6"]:
    """Velocity of a frame's origin and angular velocity of the frame, in world axes.

    **Arguments:** `q` (nq,); `v` (nv,); `frame`, one of `model.frame_names` or of `model.joint_names` (None: the world).

    **Returns:** (6,), linear (m/s) then angular (rad/s).

    **Raises:** ValueError for an unknown frame or shapes that do not fit.

    Source: Murray, Li & Sastry (1994), section 2.4.2; EQUATIONS section 1.
    """
    q, v = check_shapes(model, q=q, v=v)
    return of_frame(_velocity, (6,), model, frame, q, v)


@kernel(static=1)
def _velocity(body: int, tree, q, v):
    model, offset = tree
    frames = body_frames(model, q, [body], v)
    # The tree frame has the world's axes, so only the point of reference moves: v_p = v + omega x r.
    twist, lever = frames.twist[0], matmul(frames.pose[0], jnp.asarray(offset))[:3, 3]
    return jnp.concatenate([twist[:3] + cross(twist[3:], lever), twist[3:]])


def frame_acceleration(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"], frame: str | None
) -> Float[Array, "6"]:
    r"""Acceleration of a frame's origin and angular acceleration of the frame, in world axes: the rate of `frame_velocity`.

    $$R (\dot v_b + \omega_b \times v_b), \quad R \dot\omega_b$$

    with the body twist $(v_b, \omega_b)$ and the frame's rotation R. Gravity does not enter: a body in free fall has the linear
    part g, an accelerometer measures the linear part minus g, in the axes of the frame.

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,), the rate of v, as `forward_dynamics` or the output "acceleration" of
    `simulate` gives it; `frame`, one of `model.frame_names` or of `model.joint_names` (None: the world).

    **Returns:** (6,), linear (m/s^2) then angular (rad/s^2).

    **Raises:** ValueError for an unknown frame or shapes that do not fit.

    Source: EQUATIONS section 2, the rate of $R v_b$.

    ```python
    hand = jd.dynamics.frame_acceleration(model, q, v, jd.forward_dynamics(model, q, v, tau), "hand")
    ```
    """
    q, v, a = check_shapes(model, q=q, v=v, a=a)
    return of_frame(_acceleration, (6,), model, frame, q, v, a)


@kernel(static=1)
def _acceleration(body: int, tree, q, v, a):
    model, offset = tree
    frames = body_frames(model, q, [body], v)
    v, a = (take(x, frames.coordinates)[:, None] for x in (v, a))
    # A = sum of S_k a_k + dS_k/dt v_k, row by row, before the sum over the frame's own coordinates.
    rows = frames.subspace * a + frames.subspace_rate * v
    # The tree frame is inertial, with the world's axes: rates of twists are componentwise.
    rate = jnp.sum(twists_in_frame(frames, offset, rows), axis=0)
    twist = jnp.sum(twists_in_frame(frames, offset, frames.subspace * v), axis=0)
    turn = matmul(frames.pose[0], jnp.asarray(offset))[:3, :3]
    # From the rate of the body twist to the acceleration of the origin: dv/dt + omega x v.
    linear = rate[:3] + cross(twist[3:], twist[:3])
    return jnp.concatenate([matmul(turn, linear[:, None])[:, 0], matmul(turn, rate[3:, None])[:, 0]])


def jacobian_dot_v(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], frame: str | None
) -> Float[Array, "6"]:
    r"""Velocity-dependent part of a frame's body acceleration, with the body Jacobian J.

    $$\dot V_b = J a + \dot J v$$

    In a fixed frame the second part is the sum of $\mathrm{ad}_V S_k v_k$ over the coordinates that move the frame; its adjoint
    maps the sum into the frame.

    **Arguments:** `q` (nq,); `v` (nv,); `frame`, one of `model.frame_names` (None: the world, zero).

    **Returns:** (6,), linear then angular, in the frame's axes (m/s^2, rad/s^2). It is the rate of the body twist, not
    the acceleration of the origin: that is its linear part plus omega x v.

    **Raises:** ValueError for an unknown name or shapes that do not fit.
    """
    q, v = check_shapes(model, q=q, v=v)
    return of_frame(_jacobian_dot_v, (6,), model, frame, q, v)


@kernel(static=1)
def _jacobian_dot_v(body: int, tree, q, v):
    model, offset = tree
    frames = body_frames(model, q, [body], v)
    rate = frames.subspace_rate * take(v, frames.coordinates)[:, None]
    return jnp.sum(twists_in_frame(frames, offset, rate), axis=0)


# Workspace (operational space) dynamics of an arm: mass matrix, Coriolis forces and gravity at one of its frames.
#
# With V = J v the velocity of the frame, in the metric of M, and Jbar = M^-1 J^T Lambda:
#
#     Lambda = (J M^-1 J^T)^-1,   mu = Jbar^T C v - Lambda Jdot v,   p = Jbar^T N,   F = Jbar^T tau,
#     Lambda Vdot + mu + p = F.
#
# J Jbar = 1, and for a square J it is the inverse: Lambda = M_x = J^-T M J^-1, mu = C_x V with
# C_x = J^-T (C - M J^-1 Jdot) J^-1, p = N_x = J^-T N. Where J loses rank Lambda is unbounded and is damped: scaled to a
# unit diagonal, S = D J M^-1 J^T D, with the least eigenvalue s of S,
#
#     Lambda = D (S + max(0, least - s) 1)^-1 D.


class WorkspaceDynamics(eqx.Module):
    r"""Terms of the equation of motion in the velocity (m,) of a frame (see `workspace_dynamics`).

    $$M_x \dot V + \mu + p = F, \quad V = J v, \quad M_x = (J M^{-1} J^T)^{-1}$$

    - `mass_matrix` (m, m): $M_x$, also called Lambda. `coriolis_matrix` (m, m): $C_x$, with $\dot M_x - 2 C_x$ skew.
    - `coriolis_force` (m,): $\mu$; $C_x V$ where J is square, for a redundant arm with a term of its internal motion.
    - `gravity_force` (m,): p.
    - `jacobian` (m, nv): J. `jacobian_rate` (m, nv): $\dot J$ along v, so that $\dot V = J a + \dot J v$.
    - `inverse` (nv, m): $\bar J$, the dynamically consistent inverse; joint velocities $\bar J V$ have the least kinetic energy
      of those that move the frame with V. $\bar J^T \tau$ is the force on the frame equivalent to tau, $J^T F$ the torques of F.
    - `condition` (): least eigenvalue of $J M^{-1} J^T$ scaled to a unit diagonal, 0 where J has lost rank, at most 1.
    - `damped` (): true where that is below `least`, so that $M_x$ is damped: finite and smaller than the exact one.
    """

    mass_matrix: Float[Array, "m m"]
    coriolis_matrix: Float[Array, "m m"]
    coriolis_force: Float[Array, " m"]
    gravity_force: Float[Array, " m"]
    jacobian: Float[Array, "m nv"]
    jacobian_rate: Float[Array, "m nv"]
    inverse: Float[Array, "nv m"]
    condition: Float[Array, ""]
    damped: Bool[Array, ""]


def workspace_dynamics(
    model: Model,
    frame: str,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    *,
    axes: str = "body",
    rows: Sequence[int] = (0, 1, 2, 3, 4, 5),
    least: float | None = None,
) -> WorkspaceDynamics:
    r"""Mass matrix, Coriolis forces and gravity of an arm in the velocity of one of its frames.

    **Arguments:**

    - `frame`: one of `model.frame_names`. `q` (nq,), `v` (nv,).
    - `axes`: "body" for the frame's body twist, in its own axes; "world" for the velocity of its origin and the angular
      velocity in world axes.
    - `rows`: components of (vx, vy, vz, wx, wy, wz) to use, at most nv of them: for an arm
      in the x-y plane e.g. (0, 1, 5).
    - `least`: value of `condition` below which $M_x$ is damped; $\epsilon^{0.4}$ by default, 5e-7 in float64. Components
      that no joint moves are damped everywhere and have no meaning: leave them out of `rows`.

    **Returns:** `WorkspaceDynamics`; m, m/s and N for linear components, rad, rad/s and N m for angular ones. Damped, $M_x$
    is positive definite and finite with a finite gradient, and $J \bar J$ and $\dot M_x - 2 C_x$ are no longer 1 and skew.

    **Raises:** ValueError for shapes that do not fit, an unknown frame, axes, components other than these or more than nv, and
    a `least` outside of (0, 1).

    ```python
    task = jd.dynamics.workspace_dynamics(arm, "tip", q, v)
    tau = task.jacobian.T @ (task.mass_matrix @ wanted + task.coriolis_force + task.gravity_force)
    ```

    Source: Khatib (1987), eqs 19-22 and 50; Murray, Li & Sastry (1994), eq. 4.33; EQUATIONS section 10.
    """
    q, v = check_shapes(model, q=q, v=v)
    # Static, hence hashable: `rows` selects the program.
    given, rows = rows, tuple(np.asarray(rows).tolist()) if is_concrete(rows) and np.ndim(rows) == 1 else ()
    if not rows or len(set(rows)) < len(rows) or not set(rows) <= set(range(6)) or len(rows) > model.nv:
        raise ValueError(
            f"rows is {given}; give different components 0 to 5 of the twist, at most nv = {model.nv} of them"
        )
    limit = float(jnp.finfo(q.dtype).eps) ** 0.4
    if least is not None:
        limit = as_static(least, "least", np.finfo(float).tiny, 1, "a number between 0 and 1, or None")
    frame_jacobian(model, q, frame, axes=axes)  # refuses unknown names
    return _workspace(model, q, v, frame, axes, rows, limit)


@entry_point
def _workspace(model: Model, q, v, frame: str, axes: str, rows: tuple[int, ...], least: float) -> WorkspaceDynamics:
    def velocity_map(q):
        return frame_jacobian(model, q, frame, axes=axes)[np.array(rows)]

    J, J_rate = jax.jvp(velocity_map, (q,), (configuration_rate(model, q, v),))
    factor = mass_factor(mass_matrix(model, q))
    # J M^-1 J^T as a Gram matrix stays symmetric and semidefinite in rounding.
    whitened = factor.whiten(J.T)
    gram = matmul(whitened.T, whitened)
    diagonal = jnp.diagonal(gram)
    # Scaled to a unit diagonal, but for rows of zeros. The root of a safe number: 1/sqrt(0) in an unselected branch would make
    # the gradient NaN.
    scale = 1.0 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
    scaled = scale[:, None] * gram * scale[None]
    condition = gram_eigenvectors(whitened * scale[None])[0][-1]
    # Damping starts at the threshold and grows linearly, so that Lambda is continuous in q; its slope jumps there.
    damping = jnp.maximum(least - condition, jnp.zeros_like(condition))
    unit = jnp.eye(J.shape[0], dtype=q.dtype)
    mass = scale[:, None] * solve_positive(scaled + damping * unit, unit) * scale[None]
    # The two-sided scaling leaves rounding in the skew part; callers factor this matrix.
    mass = 0.5 * (mass + mass.T)
    inverse = matmul(factor.unwhiten(whitened), mass)
    C = coriolis_matrix(model, q, v)
    return WorkspaceDynamics(
        mass_matrix=mass,
        coriolis_matrix=matmul(inverse.T, matmul(C, inverse)) - matmul(mass, matmul(J_rate, inverse)),
        coriolis_force=matmul(inverse.T, matmul(C, v)) - matmul(mass, matmul(J_rate, v)),
        gravity_force=matmul(inverse.T, gravity_force(model, q)),
        jacobian=J,
        jacobian_rate=J_rate,
        inverse=inverse,
        condition=condition,
        damped=damping > 0,
    )


# Wrenches through the joints of a tree in motion, and its articulated bodies, which give them as functions of accelerations.


def joint_wrench(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"],
    joint: str | None = None,
    *,
    external: Float[Array, "nb 6"] | None = None,
    axes: str = "body",
) -> Float[Array, "*nb 6"]:
    r"""Wrench transmitted by a joint in a motion: (f, tau) of the parent ON the body, drive included.

    $F_i$ is the sum, over the bodies that joint i carries, of rate of momentum - weight - external wrench. Its component along
    the joint's motion subspace is the joint's force: $S_i^T F_i = \tau_i - \mathrm{armature}_i a_i$, with tau of
    `inverse_dynamics`; the rest is the bearing's reaction. Rotors are not included.

    **Arguments:**

    - `q` (nq,), `v` (nv,), `a` (nv,): the motion; a from `forward_dynamics` or `constrained_dynamics`.
    - `joint`: name of a moving joint; None: all of them.
    - `external` (nb, 6): other wrenches (f, tau) ON each body, at its frame's origin and in its axes (N, N m). Those of closed
      loops are `jd.constraints.body_wrenches(scene, q, multipliers)`.
    - `axes`: "body", of the frame of the body that the joint moves, or "world"; at that frame's origin in either case.

    **Returns:** (6,), or (nb, 6) for all joints in the order of `model.joint_names`; N, N m.

    **Raises:** ValueError for an unknown joint, other axes, shapes that do not fit.

    Source: EQUATIONS section 4, the backward recursion of Newton and Euler; `data.f` of Pinocchio after `rnea` for body axes.

    ```python
    weight = jd.dynamics.joint_wrench(model, q, zero, zero, model.joint_names[0])  # what the base bears at rest
    ```
    """
    if axes not in ("body", "world"):
        raise ValueError(f"axes is {axes!r}; choose from body, world")
    q, v, a, external = check_shapes(model, q=q, v=v, a=a, external=external)
    index = None if joint is None else joint_index(model, joint)
    if model.nb == 0:
        return jnp.zeros((0, 6), q.dtype)
    # A program without external wrenches is smaller, so None is not replaced by zeros.
    given = (q, v, a) if external is None else (q, v, a, external)
    # Beyond these a scalar program would compile for too long.
    is_large = model.nb > tree_frames.MAX_BODIES
    form = _wrenches_through_joints if is_large else kernel(_wrenches_through_joints, static=1)
    wrenches = form(axes, model, *given)
    # All joints share one program; one for each joint's name would be compiled again.
    return wrenches if index is None else wrenches[index]


def _wrenches_through_joints(axes: str, model: Model, q, v, a, external=None):
    frame = tree_frame(model, q)
    wrenches = jax.vmap(se3.AdT_apply)(frame.pose, joint_wrenches(model, frame, v, a, external))
    if axes == "body":
        return wrenches
    # Tree frames have the world's axes, so the rotation of the pose is that in the world.
    turn = frame.pose[:, :3, :3]
    return jnp.concatenate([matmul(turn, wrenches[:, :3, None]), matmul(turn, wrenches[:, 3:, None])], 1)[..., 0]


class ArticulatedBodies(eqx.Module):
    r"""Articulated inertia and bias of each body (see `articulated_bodies`), in the body's frame.

    - `inertias` (nb, 6, 6): $\hat M_i$, symmetric; kg, kg m, kg m^2.
    - `biases` (nb, 6): $b_i$; N, N m.
    """

    inertias: Float[Array, "nb 6 6"]
    biases: Float[Array, "nb 6"]


def articulated_bodies(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> ArticulatedBodies:
    r"""Articulated inertias and biases of all bodies.

    $$F_i = \hat M_i \dot V_i + b_i$$

    $F_i$ is the wrench that joint i transmits to its body (`joint_wrench`), with the joints beyond it free to move under
    tau. $\dot V_i$ is the body's twist rate less gravity: it starts from $\dot V_0 = (-g, 0)$, as in `newton_euler_matrices`.

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,), N m or N; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** `ArticulatedBodies`. The inertias depend on q alone, and
    $\det M = \prod_i \det(S_i^T \hat M_i S_i + \mathrm{armature}_i)$. NaN where M is not positive definite.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS section 5 with erratum E12; Featherstone (2008), section 7.2.

    ```python
    bodies = jd.dynamics.articulated_bodies(model, q, v, tau)
    pivot = bodies.inertias[-1][5, 5]  # of a last joint that turns about z, without armature
    ```
    """
    q, v, tau, external = check_shapes(model, q=q, v=v, tau=tau, external=external)
    # The scans need at least one body: the largest size of a joint is a maximum over them.
    if model.nb == 0:
        return ArticulatedBodies(jnp.zeros((0, 6, 6), q.dtype), jnp.zeros((0, 6), q.dtype))
    return ArticulatedBodies(*_articulated_bodies(model, q, v, tau, external))


_articulated_bodies = entry_point(scans.articulated_bodies)
