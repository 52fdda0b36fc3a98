"""Smooth surfaces by parametrisation, with metric, curvature and torsion at a point.

A surface is f(u, v) (3,), in the axes of the body that carries it. With alpha = (u, v) and the Gauss frame
x = f_u / |f_u|, z the outward normal, y = z x x,

    metric      M = [x y]^T f_alpha,               (x, y) velocity of the point = M alphadot,
    curvature   K = [x y]^T z_alpha M^-1,          K > 0 where the body is convex,
    torsion     T = y^T x_alpha M^-1.

For an orthogonal chart (f_u . f_v = 0) M is diagonal and these are Montana's; for any other, M is upper triangular and the
equations of contact hold unchanged, because M enters only by M alphadot.

Source: Montana, Int. J. Robotics Research 7 (1988), 17-32; Murray, Li & Sastry (1994), section 5.6.1.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.rolling import tangents, unit_or
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Checked, Function, Numbers, as_array, as_float, as_number, check_flag
from jaxdyn.systems.scene import as_pytree


class Surface(eqx.Module):
    """Base class of surfaces; `point` is the parametrisation, with f_u x f_v pointing out of the body."""

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point f(u, v) (3,), m, in the body's axes."""
        raise NotImplementedError

    def chart_margin(self, alpha: Float[Array, "2"]) -> Float[Array, ""]:
        """Distance of alpha from the end of the chart, in its own units; infinite for a chart without end."""
        return jnp.full((), jnp.inf, alpha.dtype)

    # Places: coordinates of a rolling contact without singularities. For a surface whose chart
    # covers all of it these are (u, v). On ellipsoids they are a unit vector, with a new chart about each point.

    @property
    def place_size(self) -> int:
        """Number of coordinates of a place."""
        return 2

    def place_of(self, alpha: Float[Array, "2"]) -> Float[Array, " n"]:
        """Place of the point with coordinates alpha."""
        return alpha

    def coordinates_at(self, place: Float[Array, " n"]) -> Float[Array, "2"]:
        """Chart coordinates alpha (2,) of a place."""
        return place

    def displace(self, place: Float[Array, " n"], step: Float[Array, "2"]) -> Float[Array, " n"]:
        """Place at `step` in a chart about `place`, with the orientation of f."""
        return place + step

    def point_at(self, place: Float[Array, " n"]) -> Float[Array, "3"]:
        """Point of the surface, m, in the body's axes."""
        return self.point(place)

    def toward(self, point: Float[Array, "3"]) -> Float[Array, " n"] | None:
        """Place close to a point of the body, m; None where that is not known."""
        return None


class Plane(Surface):
    """Plane z = 0 of the body, f = (u, v, 0); outward is +z."""

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point (u, v, 0), m."""
        return jnp.concatenate([alpha, jnp.zeros_like(alpha[:1])])

    def toward(self, point: Float[Array, "3"]) -> Float[Array, " n"]:
        """Place below the point."""
        return point[:2]


# Permutations from the axes of the chart to those of the body, with the poles on z, x, or y.
_POLES = {"z": (0, 1, 2), "x": (1, 2, 0), "y": (2, 0, 1)}


def _check_poles(poles: str) -> str:
    if not isinstance(poles, str) or poles not in _POLES:
        raise ValueError(f"poles is {poles!r}; choose from {', '.join(_POLES)}, the axis on which the chart ends")
    return poles


class Ellipsoid(Surface):
    r"""Ellipsoid about the body's origin.

    $$f(u, v) = (a \cos u \cos v, -b \cos u \sin v, c \sin u), \quad |u| < \pi / 2$$

    **Arguments:** `semi_axes` (a, b, c): along the body's x, y, z, m. `poles`: "z", "x" or "y", the axis on which the chart
    ends; for another one than z, the axes of the formula are permuted cyclically.

    **Raises:** ValueError for semi-axes that are not positive, and an unknown axis.
    """

    semi_axes: Float[Array, "3"]
    poles: str = eqx.field(static=True)

    def __init__(self, semi_axes: Numbers, poles: str = "z"):
        self.semi_axes = as_float(semi_axes, "semi_axes", (3,))
        if is_concrete(self.semi_axes) and not bool(jnp.all((self.semi_axes > 0) & jnp.isfinite(self.semi_axes))):
            raise ValueError(f"semi_axes is {np.asarray(self.semi_axes).tolist()}; give three positive lengths (m)")
        self.poles = _check_poles(poles)

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point f(u, v), m."""
        return self.point_at(self.place_of(alpha))

    def chart_margin(self, alpha: Float[Array, "2"]) -> Float[Array, ""]:
        """Angle between u and the end of the chart, rad."""
        return jnp.pi / 2 - jnp.abs(alpha[0])

    def coordinates(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Chart coordinates alpha (2,) of a point of the surface; other points are projected along rays of the scaled space."""
        x, y, z = jnp.unstack((point / self.semi_axes.astype(point.dtype))[np.array(_POLES[self.poles])])
        # arctan2 and not arcsin, whose derivative is infinite at the poles and which is NaN beyond 1 by rounding.
        return jnp.stack([jnp.arctan2(z, jnp.sqrt(x * x + y * y)), jnp.arctan2(-y, x)])

    @property
    def place_size(self) -> int:
        """Size 3 of a unit vector."""
        return 3

    def place_of(self, alpha: Float[Array, "2"]) -> Float[Array, " n"]:
        """Unit vector n (3,) with f = (a, b, c) n."""
        u, v = jnp.unstack(alpha)
        unit = jnp.stack([jnp.cos(u) * jnp.cos(v), -jnp.cos(u) * jnp.sin(v), jnp.sin(u)])
        # `argsort` inverts a permutation.
        return unit[np.argsort(_POLES[self.poles])]

    def coordinates_at(self, place: Float[Array, " n"]) -> Float[Array, "2"]:
        """Chart coordinates alpha (2,) of a place."""
        return self.coordinates(self.point_at(place))

    def displace(self, place: Float[Array, " n"], step: Float[Array, "2"]) -> Float[Array, " n"]:
        """Unit vector after `step` in the tangent plane of the unit sphere."""
        return unit_or(place + matmul(step, tangents(place)), place)

    def point_at(self, place: Float[Array, " n"]) -> Float[Array, "3"]:
        """Point (a, b, c) n, m."""
        return self.semi_axes.astype(place.dtype) * place

    def toward(self, point: Float[Array, "3"]) -> Float[Array, " n"]:
        """Unit vector towards the point in the scaled space; (1, 0, 0) for the centre."""
        return unit_or(point / self.semi_axes.astype(point.dtype), jnp.asarray([1.0, 0.0, 0.0], point.dtype))


class Sphere(Ellipsoid):
    r"""Sphere about the body's origin.

    $$f(u, v) = R (\cos u \cos v, -\cos u \sin v, \sin u), \quad |u| < \pi / 2$$

    $$M = \operatorname{diag}(R, R \cos u), \quad K = 1 / R, \quad T = (0, -\tan(u) / R)$$

    **Arguments:** `radius`: m. `poles`: as of `Ellipsoid`.

    **Raises:** ValueError for a radius that is not positive, and an unknown axis.
    """

    def __init__(self, radius: Numbers, poles: str = "z"):
        radius = as_number(radius, "radius", "m")
        self.semi_axes = jnp.stack([radius] * 3)
        self.poles = _check_poles(poles)

    @property
    def radius(self) -> Float[Array, ""]:
        """Radius (), m."""
        return self.semi_axes[0]


class Cylinder(Surface):
    r"""Cylinder about the body's z axis.

    $$f(u, v) = (R \cos u, R \sin u, v), \quad K = \operatorname{diag}(1 / R, 0), \quad T = 0$$

    **Arguments:** `radius`: m. `length`: m, from face to face, with the origin in the middle; None for one without ends.

    **Raises:** ValueError for a radius or a length that is not positive.
    """

    radius: Float[Array, ""]
    length: Float[Array, ""] | None

    def __init__(self, radius: Numbers, length: Numbers | None = None):
        self.radius = as_number(radius, "radius", "m")
        self.length = None if length is None else as_number(length, "length", "m")

    def chart_margin(self, alpha: Float[Array, "2"]) -> Float[Array, ""]:
        """Distance of v from the nearer end, m; infinite without ends."""
        if self.length is None:
            return super().chart_margin(alpha)
        return 0.5 * self.length.astype(alpha.dtype) - jnp.abs(alpha[1])

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point (R cos u, R sin u, v), m."""
        u, v = jnp.unstack(alpha)
        radius = self.radius.astype(alpha.dtype)
        return jnp.stack([radius * jnp.cos(u), radius * jnp.sin(u), v])

    def toward(self, point: Float[Array, "3"]) -> Float[Array, " n"]:
        """Place at the angle and the height of the point."""
        x, y, z = jnp.unstack(point)
        # The derivative of arctan2 is NaN on the axis, where every angle is a closest point.
        on_axis = (x == 0) & (y == 0)
        return jnp.stack([jnp.arctan2(y, jnp.where(on_axis, jnp.ones_like(x), x)), z])


class Parametrised(Surface):
    """Smooth surface given by its parametrisation.

    **Arguments:**

    - `f`: f(alpha) -> (3,), m, with alpha (2,); three times differentiable for the rates of contact coordinates. A plain
      function is static: define it once; a Module or `jax.tree_util.Partial` carries numbers as leaves.
    - `flip`: whether f_u x f_v points into the body, so that the outward normal is its negative.

    **Raises:** ValueError when f cannot be called; when used, for another shape than (3,).

    ```python
    bowl = jd.contact.Parametrised(lambda a: jnp.array([a[0], a[1], 0.5 * a[0] ** 2 + a[1] ** 2]))
    ```
    """

    f: Callable
    flip: bool = eqx.field(static=True)

    def __init__(self, f: Function, flip: bool = False):
        self.f = as_pytree(f, "surface: f")
        self.flip = check_flag(flip, "flip")

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point f(alpha), m, with u and v exchanged for `flip`."""
        # Exchanging the coordinates reverses f_u x f_v.
        value = as_array(self.f(alpha[::-1] if self.flip else alpha), "surface: f", alpha.dtype)
        if value.shape != (3,):
            raise ValueError(f"surface: f returned shape {value.shape}, expected (3,), a point")
        return value


class SurfaceGeometry(eqx.Module):
    """Differential geometry of a surface at one point of its chart.

    - `point` (3,), m; `frame` (3, 3): columns x, y and the outward normal z.
    - `metric` M (2, 2), m per unit of the chart; `curvature` K (2, 2), 1/m; `torsion` T (2,), 1/m.
    - `regular` (): true where f_u and f_v are independent; elsewhere the chart ends.
    """

    point: Float[Array, "3"]
    frame: Float[Array, "3 3"]
    metric: Float[Array, "2 2"]
    curvature: Float[Array, "2 2"]
    torsion: Float[Array, "2"]
    regular: Array

    @property
    def pose(self) -> Float[Array, "4 4"]:
        """Pose (4, 4) of the contact frame in the body."""
        top = jnp.concatenate([self.frame, self.point[:, None]], 1)
        return jnp.concatenate([top, jnp.eye(4, dtype=top.dtype)[3:]])


def surface_geometry(surface: Checked[Surface], alpha: Numbers) -> SurfaceGeometry:
    """Gauss frame, metric, curvature and torsion of a surface at alpha, by differentiating its parametrisation.

    **Arguments:** `surface`: `Plane`, `Sphere` or another of `jd.contact`; `alpha` (2,): (u, v).

    **Returns:** `SurfaceGeometry`; where the chart ends, numbers are finite without meaning and `regular` is False.

    **Raises:** ValueError for an invalid surface, alpha of another shape, and a known alpha where the chart ends.

    Source: Murray, Li & Sastry (1994), eqs 5.23-5.26; EQUATIONS section 8.
    """
    check_surface(surface)
    geometry = _geometry(surface, as_float(alpha, "alpha", (2,)))
    check_regular(surface, alpha, geometry)
    return geometry


def check_surface(surface) -> None:
    """Check the type of a surface. **Raises:** ValueError for another type."""
    if not isinstance(surface, Surface):
        raise ValueError(
            f"surface is a {type(surface).__name__}; use Plane, Sphere, Cylinder, Ellipsoid or Parametrised"
        )


def check_regular(surface: Surface, alpha, geometry: SurfaceGeometry) -> None:
    """Refuse concrete points where the chart ends. **Raises:** ValueError."""
    if is_concrete(geometry.regular) and not bool(geometry.regular):
        raise ValueError(
            f"alpha is {np.asarray(alpha).tolist()}, where the chart of the {type(surface).__name__} is singular; "
            "choose another chart of the same surface (poles=) there"
        )


def geometry_at(surface: Surface, alpha: Float[Array, "2"]) -> SurfaceGeometry:
    """Compute `surface_geometry` without its checks."""
    tangents = jax.jacfwd(surface.point)(alpha)
    # rates (3, 3, 2): of the columns of the frame along u and v.
    frame, fine = _frame_of(surface, alpha)
    rates = jax.jacfwd(lambda a: _frame_of(surface, a)[0])(alpha)
    # y . x_alpha is the rotation of the frame about the normal: the torsion.
    y = frame[:, 1]
    metric = matmul(frame[:, :2].T, tangents)
    # M is upper triangular: its inverse in closed form, with safe denominators.
    a, b, d = metric[0, 0], metric[0, 1], metric[1, 1]
    a, d = (jnp.where(fine, value, jnp.ones_like(value)) for value in (a, d))
    inverse = jnp.stack([jnp.stack([1 / a, -b / (a * d)]), jnp.stack([jnp.zeros_like(a), 1 / d])])
    curvature = matmul(matmul(frame[:, :2].T, rates[:, 2]), inverse)
    torsion = matmul(matmul(y, rates[:, 0]), inverse)
    return SurfaceGeometry(surface.point(alpha), frame, metric, curvature, torsion, fine)


_geometry = entry_point(geometry_at)


def _frame_of(surface, alpha):
    """Columns x, y, z of the Gauss frame, and the flag of a regular chart."""
    fu, fv = jax.jacfwd(surface.point)(alpha).T
    normal = cross(fu, fv)
    uu, nn, vv = jnp.sum(fu * fu), jnp.sum(normal * normal), jnp.sum(fv * fv)
    # Relative to the fourth power of the tangents' length, the size of |f_u x f_v|^2 for a square parametrisation.
    fine = nn > 1e3 * float(jnp.finfo(alpha.dtype).eps) ** 2 * jnp.maximum(uu, vv) ** 2
    x = fu / jnp.sqrt(jnp.where(fine, uu, jnp.ones_like(uu)))
    z = normal / jnp.sqrt(jnp.where(fine, nn, jnp.ones_like(nn)))
    return jnp.stack([x, cross(z, x), z], 1), fine
