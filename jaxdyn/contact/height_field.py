"""Uneven ground: a surface z = f(x, y) by heights on a grid or by a function."""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace, is_concrete
from jaxdyn.contact.surfaces import Surface
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Numbers, as_array
from jaxdyn.model.numbers import as_float
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
            value = jnp.asarray(self.f(xy), xy.dtype)
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
        spacing, origin, c = (x.astype(xy.dtype) for x in (self.spacing, self.origin, self.coefficients))  # pyright: ignore
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
