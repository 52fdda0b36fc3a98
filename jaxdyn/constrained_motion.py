"""What `simulate` needs for scenes with constraints: method, acceleration, projection, and the check of a start."""

import jax.numpy as jnp
import numpy as np

from jaxdyn.assembly import open_constraints, project_state, residuals, start_evidence
from jaxdyn.constrained import constrained_dynamics
from jaxdyn.constraints.base import layout
from jaxdyn.scene import Scene

METHODS = ("multipliers", "projected")


def chosen_method(scene: Scene, method: str) -> str:
    """How to integrate: "auto" is "projected" for a scene with constraints and "free" for one without.

    **Raises:** ValueError for a method that does not fit the scene.
    """
    allowed = METHODS if scene.constraints else ("free",)
    if method == "auto":
        return allowed[-1]
    if method not in allowed:
        kind = "with" if scene.constraints else "without"
        raise ValueError(
            f"method is {method!r}; a scene {kind} constraints takes 'auto' or {', '.join(map(repr, allowed))}"
        )
    return method


def constrained_acceleration(scene: Scene, q, v, t, force):
    """Acceleration (nv,) under the constraints; `force` (nv,) is tau plus the scene's forces, or None."""
    return _dynamics(scene, q, v, t, force).acceleration


def multipliers(scene: Scene, q, v, t, force):
    """Multipliers (nc,) at a state."""
    return _dynamics(scene, q, v, t, force).multipliers


def _dynamics(scene, q, v, t, force):
    return constrained_dynamics(Scene(scene.system, scene.constraints), q, v, force, t)


def onto_constraints(scene: Scene, q, v, t):
    """q and v put back on the constraints (and quaternions to unit length) after a step."""
    return project_state(scene, q, v, t)


def start_limit(dtype) -> float:
    """Largest residual (m, rad, m/s, rad/s) of a start that counts as rounding of the numbers that were given."""
    return float(jnp.finfo(dtype).eps) ** 0.4


def consistent(scene: Scene, q, v, t):
    """Whether a state is on the constraints but for rounding."""
    return jnp.max(residuals(scene, q, v, t)) <= start_limit(q.dtype)


def check_start(scene: Scene, q, v, t) -> None:
    """Refuse a start that is not on the constraints, or that they hold completely; concrete numbers.

    **Raises:** ValueError that names the constraints and by how much they are violated, and the fix.
    """
    found, rank = start_evidence(scene, q, v, jnp.asarray(t, q.dtype))
    limit = start_limit(q.dtype)
    if float(np.max(found)) > limit:
        raise ValueError(
            f"q0, v0 are not on the constraints: {open_constraints(scene, q, v, t, limit)} (position residual "
            f"{float(found[0]):.3g}, velocity residual {float(found[1]):.3g}); start from "
            "state = jd.assemble(scene, q0, v0), with state.q and state.v"
        )
    if int(rank) == scene.nv:
        names = ", ".join(repr(place.name) for place in layout(scene))
        raise ValueError(
            f"the constraints {names} remove all freedom: {int(rank)} independent rows for nv = {scene.nv}; "
            "leave one out, or free a joint"
        )
