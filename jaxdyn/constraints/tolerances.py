"""Tolerances of residuals, relative to the length of the mechanism.

Let s_j be the size of coordinate j: 1 for an angle, the length L of the mechanism for a distance. A row of A has the size
a_i = max_j |A_ij| s_j in the units of its residual, m or rad. So phi_i / a_i is the part of L, or the angle, by which
the coordinates would have to move to close it. The ratio does not depend on the scale of the mechanism.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

# Rows vanish at singular positions. A row below this part of a usual one is compared with the usual one, else any residual of
# rounding would count as open there.
_LEAST_ROW = 1e-3
# Rounding errors, of eps times the length, that a residual may hold: it is a difference of sums along two chains of bodies.
_ROUNDING = 32


def own_length(model: Model) -> Float[Array, ""]:
    """Length of a mechanism, m: the largest of the distances between its joints and of the radii of gyration of its bodies.

    Its place in the world does not count. 1 for a mechanism without any length.
    """
    # Roots are measured from the first of them: a robot 1 km from the origin is not 1 km long.
    roots = np.array([parent < 0 for parent in model.topology.parents], bool)
    places, inertias = model.home[:, :3, 3], model.inertias
    mass = inertias[:, 0]
    # About the origin of a joint's frame, which the centre of mass may be far from.
    moments = jnp.abs(inertias[:, 4] + inertias[:, 6] + inertias[:, 9]) / jnp.where(
        mass > 0, 2 * mass, jnp.ones_like(mass)
    )
    squares = [jnp.where(mass > 0, moments, jnp.zeros_like(mass)), jnp.sum(places[~roots] ** 2, 1)]
    squares.append(jnp.sum((places[roots] - places[roots][:1]) ** 2, 1))
    length = jnp.sqrt(jnp.max(jnp.concatenate(squares), initial=0.0))
    return jnp.where(length > 0, length, jnp.ones_like(length))


def coordinate_sizes(system, dtype) -> tuple[Float[Array, " nv"], Float[Array, ""]]:
    """s (nv,), the size of a change of each coordinate that is of the order of the mechanism, and its length L ().

    Coordinates of systems other than a `Model` have sizes of 1, in whatever units they are.
    """
    if not isinstance(system, Model):
        return jnp.ones((system.nv,), dtype), jnp.ones((), dtype)
    # A tolerance is a constant: derivatives of lengths through it would be derivatives of decisions.
    length = lax.stop_gradient(own_length(system)).astype(dtype)
    is_distance = np.zeros(system.nv, bool)
    for kind, place in zip(system.topology.kinds, system.topology.v_slices, strict=True):
        columns = KINDS[kind].columns
        is_distance[place] = [column < 3 for column in columns] if columns else kind == "prismatic"
    return jnp.where(is_distance, length, jnp.ones_like(length)), length


def row_limits(scene: Scene, q, v, t, relative: float) -> tuple[Float[Array, " nh"], Float[Array, " nc"]]:
    """Residuals phi (nh,) and A v - b (nc,) that count as closed, for a `relative` tolerance; rounding is allowed for.

    Velocities count in units of 1 + max_j |v_j| / s_j, 1/s.
    """
    sizes, length = coordinate_sizes(scene.system, q.dtype)
    A = constraint_jacobian(scene, q, t)
    rows = jnp.max(jnp.abs(A) * sizes[None], axis=1)
    rows = jnp.maximum(rows, _LEAST_ROW * jnp.minimum(length, jnp.ones_like(length)))
    rounding = _ROUNDING * float(jnp.finfo(q.dtype).eps) * jnp.maximum(length, jnp.ones_like(length))
    limits = relative * rows + rounding
    # The rate of a residual carries the rounding of the velocities, however fast they are.
    return limits[holonomic_rows(layout(scene))], limits * (1.0 + jnp.max(jnp.abs(v) / sizes))


def openness(scene: Scene, q, v, t, relative: float) -> Float[Array, ""]:
    """Largest residual over what counts as closed (see `row_limits`): at most 1 for a state on the constraints. A constant."""
    state = stop_gradient((scene.without_forces, q, v, jnp.asarray(t, q.dtype)))
    return kernel(largest_ratio, static=1)(relative, *state)


def largest_ratio(relative: float, scene: Scene, q, v, t):
    """`openness` as a function of one sample."""
    limits = row_limits(scene, q, v, t, relative)
    residuals = position_residual(scene, q, t), velocity_residual(scene, q, v, t)
    ratios = jax.tree.map(lambda x, limit: jnp.abs(x) / limit, residuals, limits)
    return jnp.max(jnp.concatenate(ratios), initial=0.0)
