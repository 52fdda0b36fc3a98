r"""Uneven ground, a surface z = f(x, y) by heights on a grid or by a function, and the contacts of shapes with it.

Contacts of shapes with ground and with each other, as functions of the relative pose of their bodies.

On a plane with normal n, the feature of a shape with the extreme point s(-n) has the gap n . s(-n). On uneven ground
z = f(x, y) a feature faces the ground at a point u = (x, y), with the normal n(u), if its extreme point s(-n(u)) is above u.
The gap is then

    gap = n_z (s_z - f(s_x, s_y)),   s = s(-n(u)),   u = (s_x, s_y).

It is zero where the feature touches, has the rate of the distance there, and differs from the distance by the square of the
gap times the curvature. Of a corner s does not depend on n, and the gap is a closed form. Otherwise u is found by Newton's
method on Taylor polynomials of third order. The last two steps are differentiated: they have the derivatives of the solution up
to third order, of which a step through contacts and its derivatives take two, and events three.

Balls touch spheres, capsules and boxes in the direction of the closest point (`shapes.outward`).
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.constraints.rolling import Touching, TouchingPoint, tangents
from jaxdyn.contact.contact_equations import inverse_2x2
from jaxdyn.contact.shapes import Ball, Box, Capsule, ConvexHull, Feature, LowestCorner, features_of, outward
from jaxdyn.contact.surfaces import Plane, Sphere, Surface
from jaxdyn.contact.unilateral import UnilateralContact
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Numbers, as_array, as_float, check_body, check_count
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.systems.scene import as_pytree


class HeightField(Surface):
    r"""Ground z = f(x, y) in the axes of the body that carries it, with its outside above.

    Heights on a grid are interpolated by cubic splines with two continuous derivatives (with `smooth=False` linearly in x and
    in y). In matrices, with $B_x$ the values at x of the splines of all columns,

    $$f(x, y) = B_x(x)^T C B_y(y).$$

    Beyond the grid the heights of its edge continue.

    **Arguments:**

    - `heights`: (nx, ny), m, the height at x = origin[0] + i spacing[0] and y = origin[1] + j spacing[1]; or a function
      f(xy) -> (), with xy (2,) in m, twice differentiable. A plain function is static: define it once; a Module or
      `jax.tree_util.Partial` carries numbers as leaves.
    - `spacing`: m, one number or (2,); only of a grid. `origin` (2,): place of the first height, m; by default the grid is
      centred at x = y = 0.
    - `smooth`: False for heights that are linear between those of the grid, with edges on which the normal jumps.

    **Raises:** ValueError for less than two heights along an axis, heights that are not finite, and a spacing that is not
    positive; when used, for a function that does not return one number.

    ```python
    bumps = jd.contact.HeightField(0.02 * np.random.default_rng(0).random((12, 12)), spacing=0.1)
    ```

    Source: de Boor, A practical guide to splines (1978), chapter 9; the end conditions are the natural ones.
    """

    f: Any
    coefficients: Float[Array, "n m"] | None
    spacing: Float[Array, "2"] | None
    origin: Float[Array, "2"] | None
    smooth: bool = eqx.field(static=True)

    def __init__(
        self,
        heights: Checked[Numbers | Function],
        spacing: Numbers | None = None,
        *,
        origin: Numbers | None = None,
        smooth: bool = True,
    ):
        self.smooth = bool(smooth)
        self.f = self.coefficients = self.spacing = self.origin = None
        if callable(heights):
            if spacing is not None or origin is not None or not smooth:
                raise ValueError(
                    "HeightField: spacing, origin and smooth are of a grid of heights; omit them for a function"
                )
            self.f = as_pytree(heights, "HeightField: heights")
            return
        grid = as_float(heights, "HeightField: heights", (None, None))
        if min(grid.shape) < 2 or (is_concrete(grid) and not np.isfinite(np.asarray(grid)).all()):
            raise ValueError(
                f"HeightField: heights has shape {grid.shape}; give two finite heights or more along x and y"
            )
        sizes = as_array(1.0 if spacing is None else spacing, "HeightField: spacing")
        if spacing is None or (is_concrete(sizes) and not (np.isfinite(sizes) & (np.asarray(sizes) > 0)).all()):
            raise ValueError(f"HeightField: spacing is {spacing}; give the distance of the heights (m), above zero")
        # Known numbers are computed by NumPy, so that they stay known inside a trace.
        xp = array_namespace(sizes)
        sizes = xp.broadcast_to(sizes, (2,)) if sizes.ndim == 0 else sizes
        self.spacing = as_float(sizes, "HeightField: spacing", (2,))
        start = -0.5 * xp.asarray(sizes, float) * (np.array(grid.shape) - 1) if origin is None else origin
        self.origin = as_float(start, "HeightField: origin", (2,))
        xp = array_namespace(grid)
        if smooth:
            along_x, along_y = (xp.asarray(_spline_coefficients(n), grid.dtype) for n in grid.shape)
            grid = along_x @ xp.asarray(grid) @ along_y.T
        self.coefficients = as_float(grid, "HeightField: heights")

    def height(self, xy: Float[Array, "2"]) -> Float[Array, ""]:
        """Height f(x, y), m."""
        if self.coefficients is None:
            value = as_array(self.f(xy), "HeightField: heights", xy.dtype)
            if value.shape != ():
                raise ValueError(f"HeightField: heights returned shape {value.shape}; return one number (m), ()")
            return value
        return self._on_grid(xy, 0)[0, 0]

    def expand(self, xy: Float[Array, "2"]) -> "Expansion":
        """Taylor polynomial of third order about a point, for derivatives up to third order there."""
        if self.coefficients is None:
            slope = jax.jacfwd(self.height)
            curvature = jax.jacfwd(slope)
            return Expansion(xy, self.height(xy), slope(xy), curvature(xy), jax.jacfwd(curvature)(xy))
        d = self._on_grid(xy, 3)

        def entry(*axes):
            return d[axes.count(0), axes.count(1)]

        tensors = [jnp.stack([entry(*i) for i in itertools.product((0, 1), repeat=n)]) for n in (1, 2, 3)]
        return Expansion(xy, d[0, 0], tensors[0], tensors[1].reshape(2, 2), tensors[2].reshape(2, 2, 2))

    def _on_grid(self, xy, order: int):
        """Derivatives (order + 1, order + 1), of i-th order along x and of j-th along y, by the products of splines."""
        assert self.spacing is not None and self.origin is not None and self.coefficients is not None
        spacing, origin, c = (x.astype(xy.dtype) for x in (self.spacing, self.origin, self.coefficients))
        ends = jnp.asarray(np.array(c.shape) - 1 - 2 * self.smooth, xy.dtype)
        # In units of the grid. Beyond it the height of the edge continues.
        place = (xy - origin) / spacing
        is_inside = (place >= 0) & (place <= ends)
        place = jnp.clip(place, 0.0, ends)
        along = []
        for k in range(2):
            # All splines, and not those of one cell: a cell would be an index that is not known.
            rows = _splines(place[k], c.shape[k], self.smooth, order)
            for i in range(1, order + 1):
                rows[i] = jnp.where(is_inside[k], rows[i] / spacing[k] ** i, jnp.zeros_like(rows[i]))
            along.append(jnp.stack(rows))
        return matmul(matmul(along[0], c), along[1].T)

    def point(self, alpha: Float[Array, "2"]) -> Float[Array, "3"]:
        """Point (u, v, f(u, v)), m."""
        return jnp.concatenate([alpha, self.height(alpha)[None]])

    def toward(self, point: Float[Array, "3"]) -> Float[Array, " n"]:
        """Place below the point."""
        return point[:2]


class Expansion(NamedTuple):
    """Taylor polynomial of a height field: height (), its derivatives (2,), (2, 2) and (2, 2, 2) at `place` (2,)."""

    place: Array
    value: Array
    first: Array
    second: Array
    third: Array

    def height(self, xy: Float[Array, "2"]) -> Float[Array, ""]:
        """Height (), m."""
        d = xy - self.place
        curved = matmul(self.second + matmul(self.third, d) / 3.0, d)
        return self.value + jnp.sum((self.first + 0.5 * curved) * d)

    def normal(self, xy: Float[Array, "2"]) -> Float[Array, "3"]:
        """Unit normal (3,), upwards."""
        d = xy - self.place
        slope = self.first + matmul(self.second + 0.5 * matmul(self.third, d), d)
        return jnp.concatenate([-slope, jnp.ones_like(slope[:1])]) / jnp.sqrt(1.0 + jnp.sum(slope * slope))


def _splines(place, count: int, smooth: bool, order: int) -> list:
    """Values (count,) of the splines at a place in units of the grid, and their derivatives up to an order."""
    numbers = jnp.arange(count, dtype=place.dtype)
    if not smooth:
        t = place - numbers
        rising, falling = (t >= -1) & (t < 0), (t >= 0) & (t < 1)
        slope = jnp.where(rising, 1.0, jnp.where(falling, -1.0, 0.0)).astype(place.dtype)
        return [jnp.maximum(1.0 - jnp.abs(t), 0.0), slope, *[jnp.zeros_like(slope)] * (order - 1)][: order + 1]
    # The first spline is centred one unit before the grid.
    t = jnp.clip(place + 1.0 - numbers, -2.0, 2.0)
    # Truncated powers (x)^3 / 6, whose derivatives are powers again.
    values = [jnp.zeros_like(t)] * (order + 1)
    for weight, shift in ((1, 2.0), (-4, 1.0), (6, 0.0), (-4, -1.0)):
        x = jnp.maximum(t + shift, 0.0)
        powers = (x * x * x / 6.0, 0.5 * x * x, x, jnp.where((x > 0) & (t < 2.0), 1.0, 0.0).astype(x.dtype))
        values = [value + weight * power for value, power in zip(values, powers, strict=False)]
    return values


def _spline_coefficients(count: int) -> np.ndarray:
    """Matrix (count + 2, count) from heights to the coefficients of their natural cubic spline."""
    rows, right = np.zeros((count + 2, count + 2)), np.zeros((count + 2, count))
    for i in range(count):
        rows[i + 1, i : i + 3], right[i + 1, i] = (1 / 6, 2 / 3, 1 / 6), 1.0
    # No curvature at both ends.
    rows[0, :3] = rows[-1, -3:] = (1.0, -2.0, 1.0)
    return np.linalg.solve(rows, right)


# --- contacts of shapes with ground and with each other, as functions of the relative pose of their bodies ---


_EXPANSIONS = 3  # Taylor polynomials of uneven ground, each about the point of the one before


class ShapeContact(Touching):
    """Contact of a feature of a shape with ground or another shape; built by `jd.contact.shape_contacts`."""

    feature: Feature
    on: eqx.Module

    def structure_key(self) -> tuple:
        """Kinds of the feature and the ground, and the shapes of their numbers."""
        leaves, structure = jax.tree.flatten((self.feature, self.on))
        return structure, tuple(x.shape for x in leaves)

    def touching(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> TouchingPoint:
        """The contact for the pose of the shape seen from the ground."""
        up = jnp.asarray([0.0, 0.0, 1.0], p.dtype)
        if isinstance(self.on, Plane):
            point = self.feature.support(R, p, -up)
            # Constant directions, which saves their derivatives.
            return TouchingPoint(point, up, point[2], jnp.eye(2, 3, dtype=p.dtype))
        if isinstance(self.on, HeightField):
            point = self._extreme_point(R, p)
            # The polynomial is about a constant place: derivatives up to third order are those of the field.
            field = self.on.expand(jax.lax.stop_gradient(point[:2]))
            normal = field.normal(point[:2])
            return TouchingPoint(point, normal, normal[2] * (point[2] - field.height(point[:2])), tangents(normal))
        assert isinstance(self.feature, Ball)
        normal, distance = outward(self.on, self.feature.centre(R, p))
        point = self.feature.support(R, p, -normal)
        gap = distance if self.feature.radius is None else distance - self.feature.radius.astype(p.dtype)
        return TouchingPoint(point, normal, gap, tangents(normal))

    def _extreme_point(self, R, p) -> Array:
        """Point (3,) of the feature that faces the ground."""
        on, feature, centre = self.on, self.feature, self.feature.centre(R, p)
        assert isinstance(on, HeightField)
        if isinstance(feature, Ball) and feature.radius is None:
            return centre
        start = centre[:2]
        if not feature.is_smooth:
            # The extreme point of a rim jumps around it: the normal below its centre decides.
            return feature.support(R, p, -on.expand(jax.lax.stop_gradient(start)).normal(start))
        u = jax.lax.stop_gradient(start)
        for i in range(_EXPANSIONS):
            field = on.expand(u)

            def facing(u, field=field):
                return feature.support(R, p, -field.normal(u))

            # Two steps, whose error is that of the expansion: of fourth order in its distance.
            u = _newton_step(facing, _newton_step(facing, u))
            if i < _EXPANSIONS - 1:
                u = jax.lax.stop_gradient(u)
        return facing(u)


def _newton_step(facing, u):
    """Step of Newton's method towards u = (x, y) of facing(u)."""

    def residual(u):
        return u - facing(u)[:2]

    J, value = jax.jacfwd(residual)(u), residual(u)
    # In a valley narrower than the feature there are two such points, and in between the matrix is singular.
    is_regular = jnp.abs(J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]) > 1e-3
    return u - jnp.where(is_regular, matmul(inverse_2x2(J, is_regular), value), value)


def shape_contacts(
    body: str,
    shape: Checked[eqx.Module],
    pose: Numbers | None = None,
    *,
    on: Checked[eqx.Module] | None = None,
    surface: Numbers | None = None,
    surface_body: str | None = None,
    friction: Numbers = 0.0,
    static: Numbers | None = None,
    restitution: Numbers = 0.0,
    lowest: int | None = None,
    name: str | None = None,
) -> tuple[UnilateralContact, ...]:
    r"""Unilateral contacts of a shape on a body with ground, or of a sphere with a shape.

    | shape                                  | contacts on a plane or uneven ground                                       |
    |----------------------------------------|----------------------------------------------------------------------------|
    | `Sphere(radius)`                       | 1                                                                          |
    | `Ellipsoid(semi_axes)`                 | 1                                                                          |
    | `Capsule(radius, length)`              | 2: the balls at its ends                                                   |
    | `Box(size)`                            | 8: its corners                                                             |
    | `ConvexHull(vertices)`                 | its vertices                                                               |
    | `Cylinder(radius, length)`             | 8: on each rim the lowest point, and three that are fixed at 0 and 120 degrees |

    On a plane the least gap is the exact distance. Of a cylinder it is exact where its axis is more than 1e-3 rad from the
    normal, and upright; between, the lowest point moves from the rim to the axis, by up to 2e-4 of the radius above the rim.
    On uneven ground (`HeightField`) gaps have the sign and the rates of the distance, and differ from it by their square times
    the curvature. Spheres, capsules and ellipsoids must be smaller there than the radius of curvature of valleys, and edges and
    faces between corners are not looked at. The lowest point of a rim is that of the plane below its centre.

    A sphere also touches a `Sphere`, a `Capsule` or a `Box` in its closest point. There the gap has kinks where that
    point is not unique (inside a box between faces; at the centre of a sphere and on the axis of a capsule, where the normal is
    x), with the derivatives of one side.

    **Arguments:**

    - `body`: name of the body or frame that carries the shape; `pose`: of the shape in it: None, (4, 4), (3,) or (xyz, rpy).
    - `shape`: see the table; `on`: `Plane()` (default), a `HeightField`, or for a sphere a `Sphere`, `Capsule` or `Box`.
    - `surface`: pose of `on` in `surface_body` (None: the world), with the z axis of a plane and of uneven ground as their
      normal; by default the identity.
    - `friction`, `static`, `restitution`: see `UnilateralContact`.
    - `lowest`: of a `Box` or a `ConvexHull` on a `Plane`, so many contacts at the most, in the corners that are lowest: others as
      the shape turns. For `jd.stepper`, whose cost grows with the number of contacts; `simulate` refuses them. Four are all
      that touch of a box, one is a pointed foot. Of more corners that are equally low four carry in a step, and others in the
      next one. None: a contact for each corner.
    - `name`: of the contact, or of several with a number behind it; by default "BODY SHAPE".

    **Returns:** the contacts, to be listed among the forces of a scene. Their forces are the normal force and the friction along
    two tangents: x and y of a plane; elsewhere those of Duff et al. (2017).

    **Raises:** ValueError for pairs that are not listed here, `lowest` of others than corners on a plane, a Cylinder
    without a length, a `HeightField` that is not smooth with anything but corners and rims, a bad pose or coefficient; when
    used, for unknown bodies.

    ```python
    ground = jd.contact.shape_contacts("body", jd.contact.Box((0.3, 0.2, 0.1)), friction=0.6, name="box")
    ```
    """
    on = Plane() if on is None else on
    kind = type(shape).__name__
    name = f"{body} {kind.lower()}" if name is None else name
    features = _check_pair(shape, on, name)
    if lowest is not None:
        features = _lowest_corners(shape, on, features, lowest, name)
    place, ground = pose_leaf(pose, f"{name!r}: pose"), pose_leaf(surface, f"{name!r}: surface")
    contacts = []
    for i, feature in enumerate(features):
        own = name if len(features) == 1 else f"{name} {i}"
        touching = ShapeContact(
            name=own,
            body=body,
            surface_body=check_body(surface_body, "shape_contacts: surface_body"),
            pose=place,
            surface=ground,
            feature=feature,
            on=on,
            contact=True,
        )
        contacts.append(UnilateralContact(touching, friction, static=static, restitution=restitution, name=own))
    return tuple(contacts)


def _check_pair(shape, on, name: str) -> tuple[Feature, ...]:
    """Features of a shape in contact. **Raises:** ValueError for a pair without contacts."""
    try:
        features = features_of(shape)
    except ValueError as error:
        raise ValueError(f"shape_contacts {name!r}: {error}") from None
    pair = f"shape_contacts {name!r}: a {type(shape).__name__} on a {type(on).__name__}"
    if isinstance(on, (Sphere, Capsule, Box)):
        if not isinstance(shape, Sphere):
            swap = "; exchange them" if isinstance(on, Sphere) and isinstance(shape, (Capsule, Box)) else ""
            raise ValueError(f"{pair} has no contacts here; only a Sphere touches a Sphere, Capsule or Box{swap}")
    elif isinstance(on, HeightField):
        is_round = any(f.is_smooth and not (isinstance(f, Ball) and f.radius is None) for f in features)
        if is_round and not on.smooth:
            raise ValueError(
                f"{pair} with smooth=False has edges, on which a round shape has two contacts; set smooth=True"
            )
    elif not isinstance(on, Plane):
        raise ValueError(f"{pair} has no contacts here; on is a Plane, HeightField, Sphere, Capsule or Box")
    return features


def _lowest_corners(shape, on, features: tuple[Feature, ...], lowest: int, name: str) -> tuple[Feature, ...]:
    """Features of the lowest corners, or all features where they are not more. **Raises:** ValueError."""
    check_count(lowest, f"shape_contacts {name!r}: lowest")
    if not (isinstance(shape, (Box, ConvexHull)) and isinstance(on, Plane)):
        raise ValueError(
            f"shape_contacts {name!r}: lowest is {lowest}, for a {type(shape).__name__} on a {type(on).__name__}; it is for a "
            "Box or a ConvexHull on a Plane"
        )
    corners = jnp.stack([feature.place for feature in features if isinstance(feature, Ball)])
    return tuple(LowestCorner(corners, k) for k in range(lowest)) if lowest < len(features) else features
