"""Wrench cones of surface contacts: the resultant wrenches of admissible forces at the corners.

At each corner |fx|, |fy| <= mu fz. The sums of such forces and of their torques form a cone {w : U w <= 0} in R^6.
Source: Caron, Pham & Nakamura (2015), Stability of surface contacts for humanoid robots; EQUATIONS section 11.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.numbers import as_float, as_number

# Signs of (Y, X) and of mu (tx, ty) in the bounds of the torque about the normal, lower ones first.
_YAW = (
    (-1, -1, 1, 1, -1),
    (-1, 1, 1, -1, -1),
    (1, -1, -1, 1, -1),
    (1, 1, -1, -1, -1),
    (1, 1, 1, 1, 1),
    (1, -1, 1, -1, 1),
    (-1, 1, -1, 1, 1),
    (-1, -1, -1, -1, 1),
)


def wrench_cone(half_x: Numbers, half_y: Numbers, mu: Numbers) -> Float[Array, "16 6"]:
    r"""Wrench cone of a rectangular contact: rows U (16, 6), in closed form.

    $U w \le 0$, with X, Y the half sides and $w = (f, \tau)$ at the centre, in the axes of the surface, z the normal:

    $$\begin{gathered}
    |f_x|, |f_y| \le \mu f_z, \quad |\tau_x| \le Y f_z, \quad |\tau_y| \le X f_z, \quad \tau_{\min} \le \tau_z \le \tau_{\max}, \\
    \tau_{\min} = -\mu (X + Y) f_z + |Y f_x - \mu \tau_x| + |X f_y - \mu \tau_y|, \\
    \tau_{\max} = \mu (X + Y) f_z - |Y f_x + \mu \tau_x| - |X f_y + \mu \tau_y|.
    \end{gathered}$$

    It is exact for the pyramids $|f_x|, |f_y| \le \mu f_z$ at the corners; `mu / sqrt(2)` keeps every corner within the circular
    cone of mu.

    **Arguments:** `half_x`, `half_y` (): half lengths along x and y, m. `mu` (): friction coefficient, zero or positive.

    **Returns:** U (16, 6), differentiable in all arguments. Rows 0-3 are in N, rows 4-15 in N m.

    **Raises:** ValueError for half lengths that are not positive, and negative friction.

    Source: Caron, Pham & Nakamura (2015), eqs. 22-28; EQUATIONS section 11.
    """
    X = as_number(half_x, "half_x", "m")
    Y = as_number(half_y, "half_y", "m", like=X.dtype)
    mu = as_number(mu, "mu", "", zero=True, like=X.dtype)
    o, one, reach = jnp.zeros_like(X), jnp.ones_like(X), mu * (X + Y)
    rows = [jnp.stack([s * one, o, -mu, o, o, o]) for s in (1.0, -1.0)]
    rows += [jnp.stack([o, s * one, -mu, o, o, o]) for s in (1.0, -1.0)]
    rows += [jnp.stack([o, o, -Y, s * one, o, o]) for s in (1.0, -1.0)]
    rows += [jnp.stack([o, o, -X, o, s * one, o]) for s in (1.0, -1.0)]
    rows += [jnp.stack([a * Y, b * X, -reach, c * mu, d * mu, e * one]) for a, b, c, d, e in _YAW]
    return jnp.stack(rows)


def corner_wrenches(vertices: Float[np.ndarray, "n 2"], mu: float) -> Float[np.ndarray, "6 k"]:
    """Generators (6, 4 n) of the wrench cone: the edges of each corner's pyramid with unit normal force, about the origin."""
    # The edges of the pyramid |fx|, |fy| <= mu fz.
    forces = np.array([[a * mu, b * mu, 1.0] for a in (1, -1) for b in (1, -1)])
    places = np.concatenate([vertices, np.zeros((len(vertices), 1))], 1)
    return np.concatenate([np.concatenate([forces, np.cross(place, forces)], 1) for place in places]).T


def wrench_cone_of_polygon(vertices: Numbers, mu: Numbers) -> Float[Array, "k 6"]:
    r"""Wrench cone of a convex polygonal contact: rows U (k, 6).

    $$U w \le 0$$

    It is the cone of the wrenches of forces at the corners, each within $|f_x|, |f_y| \le \mu f_z$; its facets are those of
    the convex hull, in five dimensions, of the corners' extreme wrenches for fz = 1 (qhull). A rectangle's are the rows of
    `wrench_cone`, in another order.

    **Arguments:** `vertices` (n, 2): corners in the plane of the surface, m, in any order, about the point at which w is
    given; those within the hull of others have no effect. `mu`: friction coefficient, positive. Both must be known.

    **Returns:** U (k, 6), scaled so that a row's largest coefficient of torques is 1, or of fx and fy where it has none.

    **Raises:** ValueError for traced arguments, for fewer than three corners, corners on a line, and mu not positive.

    Source: Caron, Pham & Nakamura (2015), section III (double description; here by a convex hull).
    """
    # Imported here because scipy takes a tenth of a second.
    from scipy.spatial import ConvexHull, QhullError

    if not is_concrete(vertices, mu):
        raise ValueError("vertices and mu are traced; facets need concrete numbers, call this outside of jit")
    corners = np.asarray(as_float(vertices, "vertices", (None, 2)), float)
    friction = float(as_number(mu, "mu", ""))
    size = np.ptp(corners, axis=0).max() if len(corners) else 0.0
    flat = corners - corners.mean(0) if len(corners) else corners
    if len(corners) < 3 or not np.isfinite(corners).all() or np.linalg.svd(flat)[1][-1] < 1e-9 * size:
        raise ValueError(f"vertices is {corners.tolist()}; give at least three corners (m) that are not on a line")
    # Scaling by the polygon's size and mu makes all coordinates of order one.
    scale = np.array([friction, friction, 1.0, size, size, size * friction])
    # At unit normal force the cone is a polytope in the other five coordinates.
    points = (corner_wrenches(corners, friction) / scale[:, None])[[0, 1, 3, 4, 5]].T
    try:
        facets = ConvexHull(points).equations
    except QhullError as error:
        raise ValueError(
            f"vertices is {corners.tolist()} with mu {friction}: no cone with an interior ({error})"
        ) from error
    # Homogenised, the offset of a facet is the coefficient of the normal force.
    rows = np.concatenate([facets[:, :2], facets[:, 5:], facets[:, 2:5]], 1)
    # qhull splits facets with more than five corners into simplices; duplicates are merged.
    rows = rows[np.unique(np.round(rows, 9), axis=0, return_index=True)[1]] / scale
    torques, forces = np.abs(rows[:, 3:]).max(1), np.abs(rows[:, :2]).max(1)
    turns = torques * size > 1e-9 * (np.abs(rows[:, 2]) + forces)
    # Entries that are zero in exact arithmetic are rounding of the hull here.
    rows = np.where(np.abs(rows * scale) > 1e-12 * np.abs(rows * scale).max(1, keepdims=True), rows, 0.0)
    return jnp.asarray(rows / np.where(turns, torques, forces)[:, None], float)
