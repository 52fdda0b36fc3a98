"""Public functions of the dynamics of a model: M(q) a + C(q, v) v + N(q) = tau + sum of J_i^T f_i.

All functions take one sample, are pure, and can be batched, compiled and differentiated in every argument and in every
leaf of the model. Velocities and accelerations are the model's v and a (body-fixed, not dq/dt). Joint damping and
friction are forces of a scene and do not enter here; rotor inertia (armature) does.

Every function raises a ValueError that names the argument when a shape does not fit the model. Those with a time `t`
(s) accept any `System` instead of a model; a Model's dynamics do not depend on it.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import implicit, kernel, value_and_jvp
from jaxdyn.dynamics import recursions, scans, tree_frames, world_frame
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.dynamics.recursions import sweeps
from jaxdyn.model.arguments import Numbers, check_shapes, check_state
from jaxdyn.model.tree import Model
from jaxdyn.systems.system import System


def mass_matrix(model: Model | System, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "nv nv"]:
    r"""Mass matrix, symmetric, with the armature of the joints on its diagonal.

    $$M(q) = \sum_i J_i^T M_i J_i + \operatorname{diag}(\mathrm{armature})$$

    **Arguments:** `q` (nq,).

    **Returns:** (nv, nv), kg m^2 for pairs of rotations, kg m and kg where translations take part. Positive definite
    when every joint moves some inertia.

    Source: Murray, Li & Sastry (1994), eq. 4.19; EQUATIONS sections 2 and 4.
    """
    if isinstance(model, System):
        return system_quantity("mass_matrix", model, *check_state(model, q=q, t=t))
    (q,) = check_shapes(model, q=q)
    pairs = int(model.topology.ancestors.sum())
    if pairs > max(tree_frames.MAX_PAIRS, model.nb**2 // 3):
        return world_frame.mass_matrix_by_loops(model, q)
    # Within a kernel the loops' products of all pairs, related or not, are written out: a sparse matrix has its own there.
    is_small = model.nb <= tree_frames.MAX_BODIES_IN_MATRIX and pairs <= tree_frames.MAX_PAIRS
    by_arrays = world_frame.mass_matrix if is_small else world_frame.mass_matrix_by_loops
    return kernel(recursions.crba, fallback=by_arrays, alone=is_small)(model, q)


def coriolis_matrix(
    model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, "nv nv"]:
    r"""Coriolis matrix with the skew property: C v are the Coriolis and centrifugal forces.

    $$C(q, v) = \sum_i J_i^T (M_i \dot J_i + (M_i \mathrm{ad}_{V_i} - \mathrm{ad}_{V_i}^T M_i) J_i), \quad
    \dot M = C + C^T$$

    in link frames. The matrix is not unique: other choices (Christoffel symbols, Pinocchio's) have the same $C v$ and the same
    $C + C^T$.

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (nv, nv). Linear in v.

    Source: EQUATIONS section 4, Cs and erratum E11.
    """
    if isinstance(model, System):
        return system_quantity("coriolis_matrix", model, *check_state(model, q=q, v=v, t=t))
    q, v = check_shapes(model, q=q, v=v)
    return _by_matrices(world_frame.coriolis_matrix, model, q, v)


def gravity_force(model: Model | System, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, " nv"]:
    r"""Generalised gravity force; it is on the left-hand side, with M a.

    $$N(q) = +\frac{\partial V}{\partial q}$$

    along the velocity coordinates.

    **Arguments:** `q` (nq,).

    **Returns:** (nv,), N m or N: the torques that keep the mechanism at rest. Zero when `model.gravity` is None.
    """
    if isinstance(model, System):
        return system_quantity("gravity_force", model, *check_state(model, q=q, t=t))
    (q,) = check_shapes(model, q=q)
    if model.gravity is None:
        # Zero is known without a compiled program.
        return jnp.zeros((model.nv,), model.home.dtype)
    return by_recursion(recursions.gravity_force, world_frame.gravity_force, model, q)


def bias_force(
    model: Model | System, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, " nv"]:
    """Bias force: the forces tau of zero acceleration.

    $$h = C(q, v) v + N(q)$$

    **Arguments:** `q` (nq,); `v` (nv,).

    **Returns:** (nv,), N m or N.
    """
    if isinstance(model, System):
        return system_quantity("bias_force", model, *check_state(model, q=q, v=v, t=t))
    q, v = check_shapes(model, q=q, v=v)
    return by_recursion(recursions.bias_force, _bias_force, model, q, v)


def inverse_dynamics(
    model: Model | System,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"],
    t: Numbers = 0.0,
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    r"""Generalised forces of a motion.

    $$\tau = M(q) a + C(q, v) v + N(q) - \sum_i J_i^T F_i$$

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,), rate of v; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** (nv,), N m or N.

    Source: EQUATIONS section 4.
    """
    if isinstance(model, System):
        q, v, a, t, _ = check_state(model, q=q, v=v, a=a, t=t, external=external)
        return system_quantity("inverse_dynamics", model, q, v, a, t)
    q, v, a, external = check_shapes(model, q=q, v=v, a=a, external=external)
    # The recursion does not take wrenches: a kernel without them is smaller, and their forces are one linear term.
    tau = by_recursion(recursions.rnea, _inverse_dynamics, model, q, v, a)
    return tau if external is None else tau - generalized_force(model, q, external)


def forward_dynamics(
    model: Model | System,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    t: Numbers = 0.0,
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    r"""Acceleration under given forces.

    $$a = M(q)^{-1} \left(\tau - C(q, v) v - N(q) + \sum_i J_i^T F_i\right)$$

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,), N m or N; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** (nv,), the rate of v: of a free or spherical joint that of its body twist, in axes that turn with the body
    (`frame_acceleration` gives accelerations in world axes). NaN when M is not positive definite, which a joint that moves
    no inertia causes; the error grows with the condition number of M.

    **Raises:** ValueError, on concrete numbers, for a `System` without a motion here: M singular (its rank is named), a
    Lagrangian that is not finite, an immersion of too low a rank.
    """
    if isinstance(model, System):
        q, v, tau, time, _ = check_state(model, q=q, v=v, tau=tau, t=t, external=external)
        model.check_start(q, v, time)
        return system_quantity("forward_dynamics", model, q, v, tau, time)
    q, v, tau, external = check_shapes(model, q=q, v=v, tau=tau, external=external)
    if external is not None:
        tau = tau + generalized_force(model, q, external)
    return _by_recursions(model, _FORWARD_DYNAMICS, _solve_for_acceleration)(model, q, v, tau)


def rnea(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    a: Float[Array, " nv"] | None,
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> Float[Array, " nv"]:
    r"""Inverse dynamics by the recursive Newton-Euler algorithm.

    $$\tau = M a + C v + N - \sum_i J_i^T F_i$$

    **Arguments:** `q` (nq,); `v`, `a` (nv,) joint velocities and accelerations (rad/s or m/s, rad/s^2 or m/s^2); `a` None is
    zero acceleration, whose terms are left out. `external` (nb, 6): wrenches $F_i$ that act on the bodies, at their origins
    in their axes (N, N m), or None.

    **Returns:** generalised forces (nv,), N m or N. Armature included.

    Source: EQUATIONS section 4; Luh, Walker & Paul (1980); Featherstone (2008) table 5.1.
    """
    check_shapes(model)  # a recursion is one over bodies
    tau = bias_force(model, q, v) if a is None else inverse_dynamics(model, q, v, a)
    return tau if external is None else tau - generalized_force(model, q, external)


def _by_name(recursion: Callable, quantity: Callable) -> Callable:
    """A recursion by its own name: the quantity that it computes, of a tree of bodies alone."""

    @functools.wraps(recursion)
    def call(model, *args, **named):
        check_shapes(model)
        return quantity(model, *args, **named)

    return call


crba = _by_name(recursions.crba, mass_matrix)
aba = _by_name(recursions.aba, forward_dynamics)
mass_matrix_sqrt = _by_name(
    recursions.mass_matrix_sqrt,
    lambda model, q: kernel(recursions.mass_matrix_sqrt)(model, *check_shapes(model, q=q)),
)

# In small batches the mask form of the matrices is as fast as the loops.
_MAX_BODIES_IN_MATRICES = 16


def by_recursion(recursion, matrices, model: Model, *args):
    """Evaluate recursion(model, *args) as a kernel, or the equal `matrices`, as loops over the bodies where these are many."""
    forms = {recursions: recursion, sweeps: getattr(sweeps, recursion.__name__, recursion), scans: matrices}
    return _by_recursions(model, {form: (function, None) for form, function in forms.items()}, matrices)(model, *args)


def _by_recursions(model: Model, forms: Mapping, fallback: Callable) -> Callable:
    """The kernel of a function that `forms` has for each module of recursions, with its derivative."""

    def by(form, fallback=fallback, alone=True):
        function, tangent = forms[form]
        return kernel(function, fallback=fallback, derivative=tangent, alone=alone)

    is_written_out = model.nb <= tree_frames.MAX_BODIES
    # Robots with floating bases have most axes at right angles.
    minimum = tree_frames.MAX_BODIES + 1 if sweeps.has_base(model) else tree_frames.MIN_BODIES_IN_SWEEPS
    if model.nb < minimum or not sweeps.has_sweeps(model):
        return by(recursions if is_written_out else scans)
    # Inside of kernels, what is written out shares its numbers with the rest, such as the rows of loops.
    return by(recursions, by(sweeps), alone=False) if is_written_out else by(sweeps)


def _by_matrices(matrices, model: Model, *args):
    """Evaluate products of matrices, whose operations grow with the square of the bodies: as a kernel of few of them."""
    return matrices(model, *args) if model.nb > tree_frames.MAX_BODIES else kernel(matrices)(model, *args)


def _inverse_dynamics(model: Model, q, v, a):
    return (scans if model.nb > tree_frames.MAX_BODIES else world_frame).inverse_dynamics(model, q, v, a)


def _bias_force(model: Model, q, v):
    return _inverse_dynamics(model, q, v, None)


def _solve_for_acceleration(model: Model, q, v, tau):
    """Forward dynamics without a kernel, differentiated by the implicit function theorem."""
    form = scans if model.nb > _MAX_BODIES_IN_MATRICES else world_frame

    def tangent(*args):
        return _value_and_tangent(_inverse_dynamics, form.acceleration_and_inverse, *args)

    return implicit(model, (q, v, tau), form.forward_dynamics, tangent)


def _value_and_tangent(inverse_dynamics, solve, model: Model, q, v, tau, steps):
    """The acceleration a, and its tangent M^-1 (dtau - dID at fixed a) for tangents of the leaves of (model, q, v, tau).

    With ID(q, v, a) = tau. In reverse this costs one more M^-1 and one reverse pass of inverse dynamics.
    """
    a, times_inverse = solve(model, q, v, tau)
    # The tangent of tau enters linearly and needs no derivative; None marks a zero tangent, for which nothing is computed.
    *steps, change = steps
    change = jnp.zeros_like(tau) if change is None else change
    _, rate = value_and_jvp(lambda model, q, v: inverse_dynamics(model, q, v, a), (model, q, v), steps)
    return a, times_inverse(change if rate is None else change - rate)


def _tangent(*args):
    return _value_and_tangent(*args)[1]


# For each module of recursions its forward dynamics and their derivative. The derivative of the solve is M^-1 times that of
# inverse dynamics, so that ABA itself is never differentiated.
_FORWARD_DYNAMICS: dict[Any, tuple[Callable, Callable]] = {
    form: (value, functools.partial(_tangent, inverse, form.acceleration_and_inverse))
    for form, value, inverse in (
        (recursions, recursions.aba, recursions.rnea),
        (sweeps, sweeps.aba, sweeps.rnea),
        (scans, scans.forward_dynamics, scans.inverse_dynamics),
    )
}


def generalized_force(
    model: Model, q: Float[Array, " nq"], external: Float[Array, "nb 6"], *, axes: str = "body"
) -> Float[Array, " nv"]:
    r"""Generalised forces of wrenches on the bodies.

    $$\tau = \sum_i J_i^T F_i$$

    **Arguments:** `q` (nq,); `external` (nb, 6), wrench (f, tau) ON each body (N, N m). `axes`: "body", at the origin of the
    body's frame and in its axes, or "inertial", at the body's centre of mass and in the axes of the world.

    **Returns:** (nv,), N m or N; it is on the right-hand side, with tau.

    **Raises:** ValueError for other axes.

    Source: EQUATIONS sections 1 and 12 (external wrenches).
    """
    q, external = check_shapes(model, q=q, external=external)
    if axes not in ("body", "inertial"):
        raise ValueError(f"axes is {axes!r}; give 'body' or 'inertial'")
    if axes == "inertial":
        rotations = forward_kinematics(model, q)[:, :3, :3]
        force, torque = (jnp.einsum("bji,bj->bi", rotations, part) for part in (external[:, :3], external[:, 3:]))
        # A massless body has no centre of mass; its wrench is at its frame's origin.
        mass = model.inertias[:, :1]
        com = jnp.where(mass > 0, model.inertias[:, 1:4] / jnp.where(mass > 0, mass, 1.0), 0.0)
        external = jnp.concatenate([force, torque + jnp.cross(com, force)], axis=1)
    return by_recursion(world_frame.generalized_force, world_frame.generalized_force, model, q, external)


def torque_regressor(
    model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]
) -> Float[Array, "nv nb10"]:
    r"""Regressor of inverse dynamics, which is linear in the inertial parameters.

    $$\tau = Y(q, v, a) \pi + \operatorname{diag}(\mathrm{armature}) a$$

    $\pi$ is `model.inertias.reshape(-1)`, the numbers (m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) of one body after
    the other. Rotor inertia is not among them.

    **Arguments:** `q` (nq,); `v` (nv,); `a` (nv,).

    **Returns:** (nv, 10 nb).

    Source: Atkeson, An & Hollerbach (1986).
    """
    q, v, a = check_shapes(model, q=q, v=v, a=a)
    return _by_matrices(world_frame.torque_regressor, model, q, v, a)


def mass_matrix_derivative(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv nv"]:
    r"""Derivative of the mass matrix, in closed form.

    $$D_{ijk} = \frac{\partial M_{ij}}{\partial q_k}$$

    **Arguments:** `q` (nq,).

    **Returns:** (nv, nv, nv).

    **Raises:** ValueError when the model has a joint whose v is not dq/dt (planar, spherical, free).

    Source: Li & Wu, Property 2, corrected (EQUATIONS section 2, E8).
    """
    (q,) = check_shapes(model, q=q)
    joints = zip(model.topology.kinds, model.joint_names, strict=True)
    other = [f"{joint!r} ({kind})" for kind, joint in joints if kind in ("planar", "spherical", "free")]
    if other:
        raise ValueError(
            f"mass_matrix_derivative needs coordinates with v = dq/dt (nq = nv), but model {model.name!r} has joints"
            f" {', '.join(other)} (nq = {model.nq}, nv = {model.nv}); use coriolis_matrix, which needs none"
        )
    return _by_matrices(world_frame.mass_matrix_derivative, model, q)


@kernel(static=1)
def system_quantity(name: str, system: System, *args):
    """Quantity of a system by the name of its method."""
    # The method is chosen by a static name, so that each quantity is one cached program.
    return getattr(system, name)(*args)
