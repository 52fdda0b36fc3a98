"""Velocity and acceleration of frames: of their origins in world axes, as instruments measure them, and of body twists."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.dynamics.kinematics import (
    all_coordinates,
    body_frames,
    body_jacobian,
    of_frame,
    twists_in_frame,
)
from jaxdyn.dynamics.tree_frames import take
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


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
