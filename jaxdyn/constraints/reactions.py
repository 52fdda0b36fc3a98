"""Generalised force and wrench of each constraint, from the multipliers."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.base import constraint_jacobian, layout
from jaxdyn.constraints.frames import Pair, places_on, relative_poses
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, batch_hint, check_shapes, check_state
from jaxdyn.systems.scene import Scene, as_scene


def constraint_forces(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"], t: Numbers = 0.0
) -> dict[str, Float[Array, " nv"]]:
    r"""Generalised force of each constraint on the system, by name.

    $$\tau_i = A_i^T \lambda_i$$

    **Arguments:** `q` (nq,); `multipliers` (nc,), those of `constrained_dynamics` or of the output "multipliers" of `simulate`.

    **Returns:** a dictionary of arrays (nv,), N m or N.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS section 7.

    ```python
    dynamics = jd.constrained_dynamics(scene, q, v)
    pushes = jd.constraint_forces(scene, q, dynamics.multipliers)
    ```
    """
    scene = as_scene(scene)
    A = constraint_jacobian(scene, q, t)
    multipliers = _check_multipliers(multipliers, A.shape[0], A.dtype)
    return {p.name: matmul(A[p.start : p.end].T, multipliers[p.start : p.end]) for p in layout(scene)}


def constraint_wrenches(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"]
) -> dict[str, Float[Array, "6"]]:
    """Wrench (f, tau) of each constraint between two frames on its body B, at the origin and in the axes of its frame A.

    The wrench on body A is the negative of it. A loop has its frames A and B as given; for a rolling
    contact A is on the surface and B on the body that rolls, for a contact of a grasp A is on the object and B on the finger.
    Constraints that are not between two frames have no entry.

    **Arguments:** `q` (nq,); `multipliers` (nc,), as in `constraint_forces`.

    **Returns:** a dictionary of arrays (6,), N and N m, by the constraints' names.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS sections 3 (wrenches) and 7.
    """
    scene, wrenches = as_scene(scene), {}
    (q,) = check_state(scene.system, q=q)
    places = layout(scene)
    multipliers = _check_multipliers(multipliers, places[-1].end if places else 0, q.dtype)
    for constraint, place in zip(scene.constraints, places, strict=True):
        if isinstance(constraint, Pair):
            constraint = constraint.at(scene.system, q)
            rotation, position = relative_poses([constraint], scene.system, q)
            wrenches[place.name] = constraint.wrench(rotation[0], position[0], multipliers[place.start : place.end])
    return wrenches


def body_wrenches(scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"]) -> Float[Array, "nb 6"]:
    r"""Wrench (f, tau) of all constraints between two frames ON each body, at its frame's origin and in its axes.

    They are the `external` of `joint_wrench`, `inverse_dynamics` and `generalized_force`, whose result for them is
    $A^T \lambda$ of these constraints. Gears and locked joints act through the joints, and functions of the user on
    coordinates: they have no wrench here.

    **Arguments:** `scene` of a `Model`; `q` (nq,); `multipliers` (nc,), as in `constraint_forces`.

    **Returns:** (nb, 6), N and N m, in the order of `model.body_names`.

    **Raises:** ValueError for shapes that do not fit, and for a system without bodies.

    Source: EQUATIONS sections 3 (wrenches) and 7.

    ```python
    dynamics = jd.constrained_dynamics(scene, q, v)
    pull = jd.constraints.body_wrenches(scene, q, dynamics.multipliers)
    bearings = jd.dynamics.joint_wrench(scene.system, q, v, dynamics.acceleration, external=pull)
    ```
    """
    scene = as_scene(scene)
    (q,) = check_shapes(scene.system, q=q)
    return body_wrenches_where(scene, q, multipliers, lambda frame: True)


def body_wrenches_where(scene: Scene, q, multipliers, counts: Callable[[str], bool]) -> Float[Array, "nb 6"]:
    """`body_wrenches` on those frames alone whose name counts."""
    wrenches = constraint_wrenches(scene, q, multipliers)
    total = jnp.zeros((scene.system.nb, 6), q.dtype)
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        if not isinstance(constraint, Pair):
            continue
        constraint, wrench = constraint.at(scene.system, q), wrenches[place.name]
        rotation, position = relative_poses([constraint], scene.system, q)
        # Action and reaction act at one point of the world: the wrench is moved from the origin of A to that of B.
        at_b = se3.AdT_apply(se3.from_parts(rotation[0], position[0]), wrench)
        ends = constraint.ends()
        bodies, poses = places_on(scene.system, [body for body, _ in ends], [pose for _, pose in ends], q.dtype)
        for (frame, _), body, pose, pull in zip(ends, bodies, poses, (-wrench, at_b), strict=True):
            if body >= 0 and counts(str(frame)):
                total = total.at[body].add(se3.Ad_inv_T_apply(pose, pull))
    return total


def _check_multipliers(multipliers, count: int, dtype) -> Array:
    multipliers = as_array(multipliers, "multipliers", dtype)
    if multipliers.shape != (count,):
        hint = batch_hint(multipliers, (1,))
        raise ValueError(f"multipliers has shape {multipliers.shape}, expected {(count,)}, one per row{hint}")
    return multipliers
