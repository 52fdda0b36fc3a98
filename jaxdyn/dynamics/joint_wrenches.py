"""Wrenches through the joints of a tree in motion, and its articulated bodies, which give them as functions of accelerations."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point, kernel
from jaxdyn.dynamics import scans, tree_frames
from jaxdyn.dynamics.tree_frames import tree_frame
from jaxdyn.dynamics.world_frame import joint_wrenches
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.topology import joint_index
from jaxdyn.model.tree import Model


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
    function = _in_world if axes == "world" else _in_bodies
    # A program without external wrenches is smaller, so None is not replaced by zeros.
    given = (q, v, a) if external is None else (q, v, a, external)
    # Beyond these a scalar program would compile for too long.
    wrenches = function(model, *given) if model.nb > tree_frames.MAX_BODIES else kernel(function)(model, *given)
    # All joints share one program; one for each joint's name would be compiled again.
    return wrenches if index is None else wrenches[index]


def _in_bodies(model: Model, q, v, a, external=None):
    frame = tree_frame(model, q)
    return jax.vmap(se3.AdT_apply)(frame.pose, joint_wrenches(model, frame, v, a, external))


def _in_world(model: Model, q, v, a, external=None):
    frame = tree_frame(model, q)
    wrenches = jax.vmap(se3.AdT_apply)(frame.pose, joint_wrenches(model, frame, v, a, external))
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
