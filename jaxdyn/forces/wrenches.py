"""Wrenches of a scene's forces on bodies, as sensors and bearings feel them."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.kinematics import named_frame
from jaxdyn.lie import se3
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene


def external_wrenches(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, "nb 6"]:
    """Sum of the wrenches (f, tau) of a scene's forces ON each body, at its frame's origin and in its axes.

    With `jd.constraints.body_wrenches` they are the `external` of `jd.dynamics.joint_wrench`, and `jd.sensors.ForceTorque`
    reads them. Forces that act on bodies from outside have a method `frame_wrenches(system, q, v, t)`, which gives a
    dictionary of wrenches (6,) by the names of frames, each at the frame's origin and in its axes;
    `jd.forces.ExternalWrench` has it. All other forces act in the joints, between a body and its parent, as springs,
    stops, friction and drives do: they have no wrench here.

    **Arguments:** `scene` of a `Model`; `q` (nq,); `v` (nv,); `t`, s.

    **Returns:** (nb, 6), N and N m, in the order of `model.body_names`.

    **Raises:** ValueError for shapes that do not fit, and for unknown frames.

    ```python
    scene = jd.Scene(model, forces=[jd.forces.ExternalWrench("tool", [0.0, 0.0, -50.0, 0.0, 0.0, 0.0])])
    outer = jd.forces.external_wrenches(scene, q, v)
    bearings = jd.dynamics.joint_wrench(model, q, v, a, external=outer)
    ```
    """
    scene = as_scene(scene)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    return wrenches_where(scene, q, v, t, lambda frame: True)


def wrenches_where(scene: Scene, q, v, t, counts: Callable[[str], bool]) -> Float[Array, "nb 6"]:
    """`external_wrenches` on those frames alone whose name counts."""
    model: Any = scene.system
    total = jnp.zeros((model.nb, 6), q.dtype)
    for i, force in enumerate(scene.forces):
        of_frames = getattr(force, "frame_wrenches", None)
        if of_frames is None:
            continue
        total = total + sum_wrenches(model, q, of_frames(model, q, v, t), counts, f"forces[{i}].frame_wrenches")
    return total


def sum_wrenches(
    model: Model, q, wrenches: Mapping[str, Any], counts: Callable[[str], bool], what: str
) -> Float[Array, "nb 6"]:
    """Sum on each body of wrenches (6,) by the names of frames, at their origins and in their axes, of frames that count.

    **Raises:** ValueError, with `what` gives them, for other shapes and unknown frames.
    """
    total = jnp.zeros((model.nb, 6), q.dtype)
    for frame, wrench in wrenches.items():
        body, offset = named_frame(model, frame)
        if jnp.shape(wrench) != (6,):
            raise ValueError(f"{what} gives shape {jnp.shape(wrench)} for frame {frame!r}, expected (6,)")
        # A frame on the ground moves no body.
        if body >= 0 and counts(frame):
            at_body = se3.Ad_inv_T_apply(jnp.asarray(offset, q.dtype), jnp.asarray(wrench, q.dtype))
            total = total.at[body].add(at_body)
    return total
