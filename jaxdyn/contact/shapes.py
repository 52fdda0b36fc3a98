"""Shapes of bodies in contact, and the features by which they touch: corners, round ends, rims and ellipsoids.

A feature is a convex set with a support function: its extreme point in a direction. A shape on smooth ground touches by its
features alone: a box by its corners, a capsule by the balls at its ends, a cylinder by its rims. Poses (R, p) are those of the
shape seen from the ground.
"""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import as_numpy_if_known, is_concrete
from jaxdyn.constraints.rolling import unit_or
from jaxdyn.contact.surfaces import Cylinder, Ellipsoid, Sphere
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_float, as_number

# Below this sine of its tilt, the lowest point of a cylinder moves from the rim to the axis, and inwards by this share of it.
UPRIGHT, RECESS = 1e-3, 0.1


class Box(eqx.Module):
    """Box about the body's origin, for `jd.contact.shape_contacts`.

    **Arguments:** `size` (3,): edges along x, y and z, m.

    **Raises:** ValueError for edges that are not positive.
    """

    size: Float[Array, "3"]

    def __init__(self, size: Numbers):
        self.size = as_float(size, "Box: size", (3,))
        if is_concrete(self.size) and not bool(jnp.all((self.size > 0) & jnp.isfinite(self.size))):
            raise ValueError(f"Box: size is {np.asarray(self.size).tolist()}; give three positive lengths (m)")


class Capsule(eqx.Module):
    """Capsule along the body's z axis: a cylinder with half balls at its ends, for `jd.contact.shape_contacts`.

    **Arguments:** `radius`, m; `length`: between the centres of its ends, m, with the origin in the middle.

    **Raises:** ValueError for a radius or a length that is not positive.
    """

    radius: Float[Array, ""]
    length: Float[Array, ""]

    def __init__(self, radius: Numbers, length: Numbers):
        self.radius, self.length = as_number(radius, "Capsule: radius", "m"), as_number(length, "Capsule: length", "m")


class ConvexHull(eqx.Module):
    """Convex hull of points, for `jd.contact.shape_contacts`. Each vertex is a contact.

    **Arguments:** `vertices` (n, 3): in the body's axes, m. Points inside the hull are allowed, and are contacts too: leave them
    out with `scipy.spatial.ConvexHull`.

    **Raises:** ValueError for another shape.
    """

    vertices: Float[Array, "n 3"]

    def __init__(self, vertices: Numbers):
        self.vertices = as_float(vertices, "ConvexHull: vertices", (None, 3))
        if not len(self.vertices):
            raise ValueError("ConvexHull: vertices has no points; give (n, 3) of them, m")
        if is_concrete(self.vertices) and not bool(jnp.all(jnp.isfinite(self.vertices))):
            raise ValueError("ConvexHull: vertices has infinite numbers; give places in m")


class Feature(eqx.Module):
    """Base of features; `is_smooth` where the extreme point is a smooth function of the direction."""

    is_smooth = True

    def centre(self, R: Float[Array, "3 3"], p: Float[Array, "3"]) -> Float[Array, "3"]:
        """Point (3,) in the middle, m."""
        raise NotImplementedError

    def support(self, R: Float[Array, "3 3"], p: Float[Array, "3"], along: Float[Array, "3"]) -> Float[Array, "3"]:
        """Extreme point (3,) in the direction of a unit vector, m."""
        raise NotImplementedError


class Ball(Feature):
    """Ball about a point of the shape; without a radius the point itself."""

    place: Float[Array, "3"]
    radius: Float[Array, ""] | None = None

    def centre(self, R, p):
        return p + matmul(R, self.place.astype(p.dtype))

    def support(self, R, p, along):
        point = self.centre(R, p)
        return point if self.radius is None else point + self.radius.astype(p.dtype) * along


class LowestCorner(Feature):
    """Point of a shape that comes after `before` others in a direction: another one as the shape turns."""

    places: Float[Array, "n 3"]
    before: int = eqx.field(static=True)
    is_smooth = False

    def centre(self, R, p):
        return p + matmul(R, jnp.mean(self.places.astype(p.dtype), 0))

    def support(self, R, p, along):
        places = self.places.astype(p.dtype)
        reach = jax.lax.stop_gradient(matmul(places, matmul(R.T, along)))
        for _ in range(self.before):
            reach = jnp.where(jnp.arange(len(places)) == jnp.argmax(reach), -jnp.inf, reach)
        return p + matmul(R, places[jnp.argmax(reach)])


class Rim(Feature):
    """Circle about the z axis at a height."""

    radius: Float[Array, ""]
    height: Float[Array, ""]
    is_smooth = False

    def centre(self, R, p):
        return p + self.height.astype(p.dtype) * R[:, 2]

    def support(self, R, p, along):
        axis = R[:, 2]
        across = along - jnp.sum(along * axis) * axis
        square = jnp.sum(across * across)
        # Of an upright cylinder all points of the rim are extreme. The length by which `across` is divided stays above
        # 3/8 of `UPRIGHT`, with two continuous derivatives at `UPRIGHT`: below, the point moves towards the axis. There it
        # would be a fourth point of an end that stands on three, which makes forces redundant: it moves into the cylinder too.
        is_tilted = square >= UPRIGHT**2
        ratio = jnp.where(is_tilted, jnp.ones_like(square), square / UPRIGHT**2)
        near = UPRIGHT / 8 * (3.0 + 6.0 * ratio - ratio * ratio)
        length = jnp.where(is_tilted, jnp.sqrt(jnp.where(is_tilted, square, jnp.ones_like(square))), near)
        inward = jnp.where(self.height.astype(p.dtype) > 0, -axis, axis)
        recess = RECESS * UPRIGHT * (1.0 - ratio) ** 3
        return self.centre(R, p) + self.radius.astype(p.dtype) * (across / length + recess * inward)


class Egg(Feature):
    """Ellipsoid about the origin of the shape."""

    semi_axes: Float[Array, "3"]

    def centre(self, R, p):
        return p

    def support(self, R, p, along):
        axes = self.semi_axes.astype(p.dtype)
        # The extreme point of the unit ball, in scaled space.
        scaled = axes * matmul(R.T, along)
        return p + matmul(R, axes * scaled / jnp.sqrt(jnp.sum(scaled * scaled)))


def features_of(shape: Any) -> tuple[Feature, ...]:
    """Features by which a shape touches ground. **Raises:** ValueError for anything that is no shape."""
    if isinstance(shape, Sphere):
        return (Ball(_leaf(np.zeros(3), shape.radius), shape.radius),)
    if isinstance(shape, Ellipsoid):
        return (Egg(shape.semi_axes),)
    if isinstance(shape, Capsule):
        return tuple(Ball(_leaf(end, shape.radius), shape.radius) for end in _ends(shape.length))
    if isinstance(shape, Cylinder) and shape.length is not None:
        # A rim touches in its lowest point, and where the cylinder is upright all around: three points of it are fixed.
        angles = 2 * np.pi / 3 * np.arange(3)
        circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], 1)
        features: list[Feature] = []
        for end in _ends(shape.length):
            points = end + as_numpy_if_known(shape.radius) * circle
            features += [
                Rim(shape.radius, _leaf(end[2], shape.radius)),
                *(Ball(_leaf(x, shape.radius)) for x in points),
            ]
        return tuple(features)
    if isinstance(shape, Box):
        corners = 0.5 * np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * as_numpy_if_known(shape.size)
        return tuple(Ball(_leaf(corner, shape.size)) for corner in corners)
    if isinstance(shape, ConvexHull):
        return tuple(Ball(_leaf(vertex, shape.vertices)) for vertex in as_numpy_if_known(shape.vertices))
    hint = "; a Cylinder needs its length" if isinstance(shape, Cylinder) else ""
    raise ValueError(
        f"shape is a {type(shape).__name__}; give a Sphere, Capsule, Box, Cylinder, Ellipsoid or ConvexHull{hint}"
    )


def outward(shape: Any, point: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Unit normal (3,) of the point of a Sphere, Capsule or Box that is closest to a point, and the signed distance (), m.

    Negative inside. Where there is no single closest point, as at the centre, one of them.
    """
    if isinstance(shape, Box):
        half = 0.5 * shape.size.astype(point.dtype)
        depths = jnp.abs(point) - half
        # Inside: the nearest face, the first of equally near ones.
        deepest = jnp.max(depths)
        sides = jnp.where(point < 0, -jnp.ones_like(point), jnp.ones_like(point))
        first = [depths[0] >= deepest, depths[1] >= deepest]
        chosen = jnp.stack([first[0], ~first[0] & first[1], ~first[0] & ~first[1]])
        inside = jnp.where(chosen, sides, jnp.zeros_like(sides))
        away = point - jnp.clip(point, -half, half)
        is_outside = deepest > 0
        # Where the point is a rounding above a face, the direction to it is rounding: it has the normal of the face.
        normal = jnp.where(is_outside, unit_or(away, inside), inside)
        return normal, jnp.where(is_outside, jnp.sum(normal * away), deepest)
    away = point
    if isinstance(shape, Capsule):
        half = 0.5 * shape.length.astype(point.dtype)
        away = point.at[2].add(-jnp.clip(point[2], -half, half))
    normal = unit_or(away, jnp.asarray([1.0, 0.0, 0.0], point.dtype))
    return normal, jnp.sum(normal * away) - shape.radius.astype(point.dtype)


def _ends(length) -> list:
    """Points on the z axis at half of a length below and above the origin."""
    return [0.5 * as_numpy_if_known(length) * np.array([0.0, 0.0, sign]) for sign in (-1.0, 1.0)]


def _leaf(value, like: Array) -> Array:
    return as_float(value, "shape", like=like.dtype)


_DIRECTIONS = 400  # in which the error of a hull is measured


def hull_vertices(points: np.ndarray, maximum: int) -> tuple[np.ndarray, int, float]:
    """At most `maximum` vertices (n, 3) of the convex hull of points, the number of all, and the largest distance left out, m.

    Vertices are added where the hull so far falls most short, in directions that are spread over the sphere.
    """
    # Imported on use, because scipy's geometry takes long to import.
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    points = np.unique(points, axis=0)
    try:
        points = points[np.sort(Hull(points).vertices)]
    except (QhullError, ValueError):
        pass  # flat, or less than four points: all of them
    if len(points) <= maximum:
        return points, len(points), 0.0
    k = np.arange(_DIRECTIONS) + 0.5
    polar, around = np.arccos(1 - 2 * k / _DIRECTIONS), np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1)
    reach = points @ directions.T
    wanted, chosen = reach.max(0), [int(np.argmax(reach[:, 0]))]
    while len(chosen) < maximum:
        short = wanted - reach[chosen].max(0)
        if short.max() <= 0:
            break
        chosen.append(int(np.argmax(reach[:, np.argmax(short)])))
    return points[np.sort(chosen)], len(points), float((wanted - reach[chosen].max(0)).max())
