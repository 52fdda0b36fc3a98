"""Friction cones: the forces that a contact can transmit without pulling, slipping or spinning.

Contact forces f (m,) are along the columns of the contact's wrench basis (`wrench_basis`), with z the normal into the
object, so that f_n >= 0 presses. With friction coefficient mu and, for soft fingers, gamma (m):

    frictionless    f_n >= 0
    hard-finger     |(fx, fy)| <= mu f_n
    soft-finger     |(fx, fy)| <= mu f_n   and   |tz| <= gamma f_n
    rigid           all wrenches
    surface         U w <= 0, see `wrench_cone`

Source: Murray, Li & Sastry (1994), section 5.2; EQUATIONS sections 10 and 11.

The wrench cones of surface contacts hold the resultant wrenches of admissible forces at the corners. At each corner
|fx|, |fy| <= mu fz. The sums of such forces and of their torques form a cone {w : U w <= 0} in R^6.
Source: Caron, Pham & Nakamura (2015), Stability of surface contacts for humanoid robots; EQUATIONS section 11.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.nn import logsumexp
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.lie.series import safe_sqrt
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_float, as_number, check_flag

# Components (fx, fy, fz, tx, ty, tz) of a wrench that each contact transmits.
_SPATIAL = {
    "frictionless": (2,),
    "hard-finger": (0, 1, 2),
    "soft-finger": (0, 1, 2, 5),
    "rigid": (0, 1, 2, 3, 4, 5),
}
# In the x-z plane: forces along x and z, and the torque about y.
_IN_PLANE = {"frictionless": (2,), "hard-finger": (0, 2), "rigid": (0, 2, 4)}


def components(kind: str, in_plane: bool, what: str) -> tuple[int, ...]:
    """Indices of the transmitted components. **Raises:** ValueError for an unknown kind, naming `what`."""
    kinds = _IN_PLANE if check_flag(in_plane, f"{what}: in_plane") else _SPATIAL
    if not isinstance(kind, str) or kind not in kinds:
        hint = "; in a plane a soft finger is a hard one" if isinstance(kind, str) and kind in _SPATIAL else ""
        raise ValueError(f"{what}: kind {kind!r} is unknown; choose from {', '.join(kinds)}{hint}")
    return kinds[kind]


def wrench_basis(kind: str, *, in_plane: bool = False) -> Float[np.ndarray, "6 m"]:
    """Wrench basis B (6, m) of a contact: its columns are the wrenches (f, tau) that it transmits.

    | kind         | m | B in the contact frame                   | m and rows in a plane |
    |--------------|---|------------------------------------------|-----------------------|
    | frictionless | 1 | force along z                            | 1: fz                 |
    | hard-finger  | 3 | all forces: a point with friction        | 2: fx, fz             |
    | soft-finger  | 4 | all forces, torque about z               |                       |
    | rigid        | 6 | all                                      | 3: fx, fz, ty         |

    The contact frame's z is the normal into the object, and its x-z plane is the plane of a planar mechanism.

    **Raises:** ValueError for an unknown kind.

    Source: Murray, Li & Sastry (1994), table 5.2; EQUATIONS section 10.
    """
    return np.eye(6)[:, list(components(kind, in_plane, "contact"))]


SIDES = ("inscribed", "circumscribed")


class FrictionCone(eqx.Module):
    r"""Cone of forces that one contact can transmit, built by `friction_cone` and `surface_cone`.

    - `kind`, `in_plane`: of the contact. `mu` (): friction coefficient. `gamma` (): m, radius of a soft finger's torque.
    - `rows` (k, 6): U of a surface, $U w \le 0$.

    It has `linear_rows` and `second_order_rows`, which together describe the cone exactly, `pyramid`, a linear cone
    inside or around it, and `margins` and `margin`, by how much a force satisfies the inequalities: $\mu f_n - |f_t|$. The
    distance of the force from the boundary of the cone is that over $\sqrt{1 + \mu^2}$.
    """

    kind: str = eqx.field(static=True)
    in_plane: bool = eqx.field(static=True)
    mu: Float[Array, ""] | None
    gamma: Float[Array, ""] | None
    rows: Float[Array, "k 6"] | None

    @property
    def size(self) -> int:
        """Number m of components of the contact's force."""
        return 6 if self.kind == "surface" else len(components(self.kind, self.in_plane, "cone"))

    def linear_rows(self) -> Float[Array, "k m"]:
        r"""Rows L (k, m) of the linear inequalities; (0, m) if there are none.

        $$L f \le 0$$
        """
        if self.rows is not None:
            return self.rows
        if self.kind == "frictionless":
            return -jnp.ones((1, 1))
        if self.mu is None:
            return jnp.zeros((0, self.size))
        one, zero = jnp.ones_like(self.mu), jnp.zeros_like(self.mu)
        if self.in_plane:
            # In a plane the force is (fx, fz) and the cone a wedge, |fx| <= mu fz: it is linear.
            return jnp.stack([jnp.stack([one, -self.mu]), jnp.stack([-one, -self.mu])])
        if self.gamma is None:
            return jnp.zeros((0, 3), self.mu.dtype)
        return jnp.stack([jnp.stack([zero, zero, -self.gamma, sign * one]) for sign in (1.0, -1.0)])

    def second_order_rows(self) -> Float[Array, "j 3 m"]:
        r"""Rows S (j, 3, m) of the second-order inequalities, j = 0 or 1.

        $$|((S f)_1, (S f)_2)| \le (S f)_0$$

        $S f$ is $(\mu f_n, f_x, f_y)$ for a spatial contact with friction.
        """
        if self.mu is None or self.in_plane:
            dtype = jnp.zeros(()).dtype if self.mu is None else self.mu.dtype
            return jnp.zeros((0, 3, self.size), dtype)
        unit = jnp.eye(self.size, dtype=self.mu.dtype)
        # Both kinds with friction begin with (fx, fy, fz).
        return jnp.stack([self.mu * unit[2], unit[0], unit[1]])[None]

    def pyramid(self, faces: int = 8, side: str = "inscribed") -> Float[Array, "k m"]:
        r"""Rows P (k, m) of a pyramid that approximates the cone.

        $$P f \le 0$$

        The faces' normals are at the angles 2 pi i / faces from x. An "inscribed" pyramid lies within the cone: each
        of its forces is one without slip, and mu is reduced by at most the factor cos(pi / faces), $1/\sqrt2$ for four.
        A "circumscribed" one contains the cone; with four faces it is $|f_x|, |f_y| \le \mu f_n$. Cones that are linear are
        returned unchanged.

        **Arguments:** `faces`: at least 3. `side`: "inscribed" or "circumscribed".

        **Raises:** ValueError for fewer faces and for an unknown side.

        Source: Caron, Pham & Nakamura (2015), section II; EQUATIONS section 11.
        """
        if isinstance(faces, bool) or not isinstance(faces, (int, np.integer)) or faces < 3:
            raise ValueError(f"faces is {faces!r}; a pyramid has at least 3, give an integer")
        if side not in SIDES:
            raise ValueError(f"side is {side!r}; choose from {', '.join(SIDES)}")
        linear = self.linear_rows()
        if self.mu is None or self.in_plane or self.rows is not None:
            return linear
        angles = 2 * np.pi / faces * np.arange(faces)
        shrink = float(np.cos(np.pi / faces)) if side == "inscribed" else 1.0
        # The directions of the faces are constants: only mu has derivatives.
        normals = np.zeros((faces, self.size))
        normals[:, 0], normals[:, 1] = np.cos(angles), np.sin(angles)
        along = jnp.zeros((faces, self.size), self.mu.dtype).at[:, 2].set(-shrink * self.mu)
        return jnp.concatenate([jnp.asarray(normals, self.mu.dtype) + along, linear])

    def margins(self, force: Numbers, smoothing: Numbers = 0.0) -> Float[Array, " k"]:
        r"""Margins (j + k,) of a force in each inequality, those of the second order first.

        $$\mu f_n - |(f_x, f_y)|, \quad -L f$$

        Inside the cone all are positive, on its boundary the least is zero. Units are those of the rows: N for forces,
        N m for a soft finger's gamma f_n -+ tz, and those of its rows for a surface.

        **Arguments:** `force` (m,), N and N m. `smoothing` (), N: the norm is replaced by
        $\sqrt{f_x^2 + f_y^2 + \mathrm{smoothing}^2}$.
        That is smooth at a force along the normal too, and the margin is then too small by at most `smoothing`, on the
        safe side. With zero the margin has a kink there, at which its derivative is that along the normal.

        **Raises:** ValueError for a force of another size.
        """
        force = as_float(force, "force", (self.size,))
        cone_margins = []
        second = self.second_order_rows()
        if second.shape[0]:
            first, *rest = jnp.unstack(matmul(second[0].astype(force.dtype), force))
            square = jnp.sum(jnp.stack(rest) ** 2)
            if not _is_zero(smoothing):
                square = square + jnp.asarray(smoothing, square.dtype) ** 2
            # The derivative of the root is zero where it vanishes.
            cone_margins.append((first - safe_sqrt(square))[None])
        return jnp.concatenate([*cone_margins, -matmul(self.linear_rows().astype(force.dtype), force)])

    def margin(self, force: Numbers, smoothing: Numbers = 0.0) -> Float[Array, ""]:
        r"""Least of `margins`, () : positive inside the cone, zero on its boundary, infinite for a rigid contact.

        With `smoothing` s > 0 it is $-s \log \sum_i \exp(-\mathrm{margin}_i / s)$, smooth and at most the least margin,
        by no more than s (1 + log(number of margins)); it may be traced if it is positive.
        """
        every = self.margins(force, smoothing)
        if every.shape[0] == 0:
            return jnp.full((), jnp.inf, every.dtype)
        # The soft minimum of one margin is that margin.
        if every.shape[0] == 1 or _is_zero(smoothing):
            return jnp.min(every)
        scale = jnp.asarray(smoothing, every.dtype)
        return -scale * logsumexp(-every / scale)

    def normal_force(self, force: Numbers) -> Float[Array, ""]:
        """f_n (), N: force along the contact's normal; positive where it presses."""
        force = as_float(force, "force", (self.size,))
        z = 2 if self.kind == "surface" else components(self.kind, self.in_plane, "cone").index(2)
        return force[z]


def _is_zero(smoothing) -> bool:
    return is_concrete(smoothing) and np.ndim(smoothing) == 0 and float(smoothing) == 0


def friction_cone(
    kind: str, mu: Numbers | None = None, gamma: Numbers | None = None, *, in_plane: bool = False
) -> FrictionCone:
    """Friction cone of a contact of a given kind (see `FrictionCone`).

    **Arguments:**

    - `kind`: "frictionless", "hard-finger" (a point with friction), "soft-finger" or "rigid".
    - `mu`: friction coefficient, zero or positive; for fingers, and for them alone.
    - `gamma`: m, ratio of the largest torque about the normal to the normal force; for a soft finger alone.
    - `in_plane`: of a contact with `in_plane=True`, whose force is (fx, fz).

    **Raises:** ValueError for an unknown kind, coefficients that are negative, missing, or given where there are none.

    ```python
    cone = jd.contact.friction_cone("hard-finger", mu=0.5)
    cone.margin(jnp.array([0.3, 0.0, 1.0]))  # 0.2 N
    ```

    Source: Murray, Li & Sastry (1994), table 5.2; EQUATIONS section 10.
    """
    components(kind, in_plane, "cone")
    for name, value, kinds in (("mu", mu, ("hard-finger", "soft-finger")), ("gamma", gamma, ("soft-finger",))):
        if kind in kinds and value is None:
            raise ValueError(f"{name} is None for a {kind}; give its friction coefficient, zero or positive")
        if kind not in kinds and value is not None:
            raise ValueError(f"{name} is {value} for a {kind} contact, which has none; leave it out")
    mu = None if mu is None else as_number(mu, "mu", "", zero=True)
    gamma = None if gamma is None or mu is None else as_number(gamma, "gamma", "m", zero=True, like=mu.dtype)
    return FrictionCone(kind, in_plane, mu, gamma, None)


def surface_cone(rows: Numbers) -> FrictionCone:
    r"""Cone of wrenches that a surface contact can transmit.

    $$U w \le 0$$

    **Arguments:** `rows` U (k, 6), from `wrench_cone` or `wrench_cone_of_polygon`. Rows that bound a torque (their
    coefficients of torques are not zero) should be divided by a length to have margins in N throughout.

    **Raises:** ValueError for another shape.
    """
    rows = as_float(rows, "rows", (None, 6))
    if rows.shape[0] == 0:
        raise ValueError("rows has shape (0, 6); give at least one row, or take friction_cone('rigid')")
    return FrictionCone("surface", False, None, None, rows)


if TYPE_CHECKING:
    # One cone for all contacts, one for each, or a dictionary by their names.
    Cones = FrictionCone | Sequence[FrictionCone] | Mapping[str, FrictionCone] | None
else:
    Cones = Any  # `contacts_with_cones` checks them


# --- wrench cones of surface contacts: the resultant wrenches of admissible forces at the corners ---


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
