"""Branches of configurations: whether two neighbours on the same constraints are joined by a path without a singular position."""

import jax.numpy as jnp
from jax import lax

from jaxdyn.compile import pseudo_inverse_by_rotations
from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout
from jaxdyn.constraints.rank import passes_singular, tolerance
from jaxdyn.constraints.tolerances import coordinate_sizes
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displacement

JUMP = 1.0  # rad or lengths of the mechanism: a longer way between two configurations is no small step


def unit_rows(scene: Scene, q, t, factors=None):
    """Rows of positions in coordinates scaled by their sizes, and their pseudo-inverse; constants.

    `factors` (m,) are those of the last rows.
    """
    # Only decisions follow from these rows, so they are constants under differentiation.
    scene, q = stop_gradient((scene, q))
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    R = constraint_jacobian(scene, q, t)[holonomic_rows(layout(scene))] * sizes[None]
    if factors is not None:
        count = R.shape[0] - factors.size
        R = R * jnp.concatenate([jnp.ones((count,), q.dtype), lax.stop_gradient(factors)])[:, None]
    return R, pseudo_inverse_by_rotations(R, tolerance(None, R))


def changes_branch(system, before, after, R_after, R, inverse):
    """Decide whether a combination of rows went through zero between two configurations, or a coordinate jumped.

    `R` and `inverse` are those of `unit_rows` at the first one, `R_after` those at the second.
    """
    sizes, _ = coordinate_sizes(system, before.dtype)
    jump = jnp.max(jnp.abs(displacement(system, before, after)) / sizes, initial=0.0)
    return passes_singular(R, inverse, R_after) | (jump > JUMP)
