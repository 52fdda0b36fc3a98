"""Second-order cones {v : v0 >= |v1|} of R^d, many at once: arrays (k, d). Half-lines have d = 1.

Products, Nesterov-Todd scaling, steps to the boundary, the projection and its derivative.

Source: Vandenberghe, The CVXOPT linear and quadratic cone program solvers (2010), sections 3-5; for the projection
Fukushima, Luo & Tseng, SIAM J. Optim. 12 (2002), 436-460.
"""

from typing import NamedTuple

import jax.numpy as jnp

from jaxdyn.lie.series import safe_sqrt
from jaxdyn.lie.so3 import matmul


def identity(like):
    """Identity e = (1, 0, ...) of the Jordan algebra of each cone, (k, d)."""
    return jnp.zeros_like(like).at[..., 0].set(1)


def _norm(rest):
    """Norm |rest| along the last axis, with zero derivative where it vanishes."""
    if rest.shape[-1] == 0:
        return jnp.zeros(rest.shape[:-1], rest.dtype)
    return safe_sqrt(jnp.sum(rest * rest, -1))


def boundary_distance(v):
    """Distance to the boundary v0 - |v1|, (k,): the smaller eigenvalue, positive inside the cone."""
    return v[..., 0] - _norm(v[..., 1:])


def determinant(v):
    """Determinant v0^2 - |v1|^2, (k,), without cancellation near the boundary."""
    norm = _norm(v[..., 1:])
    return (v[..., 0] - norm) * (v[..., 0] + norm)


def product(a, b):
    """Jordan product (a.b, a0 b1 + b0 a1)."""
    first = jnp.sum(a * b, -1, keepdims=True)
    return jnp.concatenate([first, a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:]], -1)


def quotient(a, b):
    """Jordan quotient: x with product(a, x) = b."""
    inverse = 1 / a[..., :1]
    if a.shape[-1] == 1:
        return b * inverse
    along = jnp.sum(a[..., 1:] * b[..., 1:], -1, keepdims=True)
    # The determinant in product form: near the boundary v0^2 - |v1|^2 would cancel.
    x0 = (a[..., :1] * b[..., :1] - along) * (1 / determinant(a))[..., None]
    return jnp.concatenate([x0, (b[..., 1:] - x0 * a[..., 1:]) * inverse], -1)


class Scaling(NamedTuple):
    """Nesterov-Todd scaling W of each cone, W z = W^-1 s: W = beta (2 v v^T - J), J = diag(1, -1, ...); `inverse` is 1 / beta.

    On a half-line v = 1.
    """

    v: jnp.ndarray
    beta: jnp.ndarray
    inverse: jnp.ndarray

    def times(self, x):
        """Product W x."""
        return self.beta * _reflect_about(self.v, x)

    def inverse_times(self, x):
        """Product W^-1 x."""
        return self.inverse * _reflect_about(_reflect(self.v), x)


def _reflect_about(v, x):
    """Product (2 v v^T - J) x."""
    return x if x.shape[-1] == 1 else 2 * v * jnp.sum(v * x, -1, keepdims=True) - _reflect(x)


def _reflect(x):
    return jnp.concatenate([x[..., :1], -x[..., 1:]], -1)


def scaling(s, z) -> Scaling:
    """Nesterov-Todd scaling of points s and z inside the cones."""
    if s.shape[-1] == 1:
        # W = sqrt(s / z) and its inverse from one root.
        shared = 1 / jnp.sqrt(s * z)
        return Scaling(jnp.ones_like(s), s * shared, z * shared)
    norm_s, norm_z = jnp.sqrt(determinant(s))[..., None], jnp.sqrt(determinant(z))[..., None]
    beta = jnp.sqrt(norm_s / norm_z)
    s, z = s * (1 / norm_s), z * (1 / norm_z)
    # s . z >= 1 for points of unit determinant inside the cone, so that gamma >= 1 and no quotient is large.
    gamma = jnp.sqrt((1 + jnp.sum(s * z, -1, keepdims=True)) / 2)
    # w is the scaling point of unit determinant, v its square root in the Jordan algebra.
    w = (s + _reflect(z)) / (2 * gamma)
    return Scaling((w + identity(w)) * (1 / jnp.sqrt(2 * (w[..., :1] + 1))), beta, 1 / beta)


def inverse_boundary_step(v, dv):
    """Inverse 1/t of the largest step t at which v + t dv reaches the boundary of a cone, for v inside; 0 where it never does.

    Only entries of v are inverted: a program computes each inverse once, for all dv and for `quotient`.
    """
    # v0 must stay positive too: the quadratic alone is also positive in the opposite cone.
    second = -dv[..., 0] * (1 / v[..., 0])
    if v.shape[-1] == 1:
        return jnp.max(second, initial=0)
    a = dv[..., 0] ** 2 - jnp.sum(dv[..., 1:] ** 2, -1)
    b = v[..., 0] * dv[..., 0] - jnp.sum(v[..., 1:] * dv[..., 1:], -1)
    c = determinant(v)
    # Inverses of the least positive root of a t^2 + 2 b t + c, in the form that does not cancel, and of the root of v0 + t dv0.
    # Rounding can make a discriminant of zero negative.
    first = (jnp.sqrt(jnp.maximum(b * b - a * c, 0)) - b) * (1 / c)
    return jnp.max(jnp.maximum(first, second), initial=0)


def projection(v):
    """Nearest point of the cone, (k, d)."""
    norm = _norm(v[..., 1:])
    # Eigenvalues are projected on the nonnegative numbers; eigenvectors remain.
    high, low = jnp.maximum(v[..., 0] + norm, 0), jnp.maximum(v[..., 0] - norm, 0)
    if v.shape[-1] == 1:
        return high[..., None]
    mean, half = (high + low) / 2, (high - low) / 2
    safe = norm > 0
    # On the axis both eigenvalues agree, and no direction v1 / |v1| is needed.
    rest = jnp.where(safe, half / jnp.where(safe, norm, 1), 0)[..., None] * v[..., 1:]
    return jnp.concatenate([mean[..., None], rest], -1)


class ProjectionDerivative(NamedTuple):
    """Derivatives D (k, d, d) of the projection, by their eigenvalues (k,), all between 0 and 1.

    `high` belongs to (1, u), `low` to (1, -u), `across` to (0, x) with x orthogonal to u (k, d - 1), which is a
    unit vector, or zero where the three eigenvalues are equal.
    """

    high: jnp.ndarray
    low: jnp.ndarray
    across: jnp.ndarray
    u: jnp.ndarray

    def map(self, function):
        """Matrices with the same eigenvectors and a function of the eigenvalues."""
        return ProjectionDerivative(function(self.high), function(self.low), function(self.across), self.u)

    def times(self, x):
        """Product D x, x (k, d)."""
        if x.shape[-1] == 1:
            return self.high[..., None] * x
        along = jnp.sum(self.u * x[..., 1:], -1)
        up, down = self.high * ((x[..., 0] + along) / 2), self.low * ((x[..., 0] - along) / 2)
        rest = (up - down - self.across * along)[..., None] * self.u + self.across[..., None] * x[..., 1:]
        return jnp.concatenate([(up + down)[..., None], rest], -1)


def projection_derivative(v, width, at_kink) -> ProjectionDerivative:
    """Derivative of the projection; at its kinks, eigenvalues v0 -+ |v1| of at most `width`, that of one side or between.

    Along (1, -+u) it is the derivative of max(x, 0), across its divided difference. `at_kink`: 1 for the derivative of the
    side where the eigenvalue is positive, 0 for that of the other one, 1/2 for their mean.
    """
    norm = _norm(v[..., 1:])
    high, low = v[..., 0] + norm, v[..., 0] - norm

    def one_sided(x):
        return jnp.where(jnp.abs(x) <= width, at_kink, (x > 0).astype(x.dtype))

    # (max(high, 0) - max(low, 0)) / (high - low), without the difference. At the apex both are kinks.
    sizes = jnp.abs(high) + jnp.abs(low)
    is_apex = (jnp.abs(high) <= width) & (jnp.abs(low) <= width)
    quotient = (1 + (high + low) / jnp.where(sizes > 0, sizes, 1)) / 2
    across = jnp.where(is_apex, at_kink, quotient)
    # On the axis u is zero: the three eigenvalues agree there, and D is a multiple of the unit matrix.
    u = v[..., 1:] / jnp.where(norm > 0, norm, 1)[..., None]
    return ProjectionDerivative(one_sided(high), one_sided(low), across, u)


def smooth_projection(v, width) -> tuple:
    """Projection with eigenvalues (x + sqrt(x^2 + 4 width^2)) / 2 in place of max(x, 0), (k, d), and its derivative.

    A width of zero is the projection, whose derivative at a kink is the mean of both sides. The smooth ones are the points of
    the central path: P - v is in the cone too, and their Jordan product is width^2.

    Source: Fukushima, Luo & Tseng, SIAM J. Optim. 12 (2002), section 4.
    """
    norm = _norm(v[..., 1:])
    high, low = v[..., 0] + norm, v[..., 0] - norm

    def smooth(x):
        root = safe_sqrt(x * x + 4 * width * width)
        return (x + root) / 2, jnp.where(root > 0, (1 + x / jnp.where(root > 0, root, 1)) / 2, 0.5), root

    if v.shape[-1] == 1:
        value, rate, _ = smooth(v[..., 0])
        return value[..., None], ProjectionDerivative(rate, rate, rate, v[..., 1:])
    (top, up, root), (bottom, down, other) = smooth(high), smooth(low)
    # (top - bottom) / (high - low), without the difference.
    sizes = root + other
    across = jnp.where(sizes > 0, (1 + (high + low) / jnp.where(sizes > 0, sizes, 1)) / 2, 0.5)
    u = v[..., 1:] / jnp.where(norm > 0, norm, 1)[..., None]
    value = jnp.concatenate([((top + bottom) / 2)[..., None], across[..., None] * v[..., 1:]], -1)
    return value, ProjectionDerivative(up, down, across, u)


def is_near_kink(v, width):
    """Decide whether an eigenvalue v0 -+ |v1| is at most `width`, (k,)."""
    norm = _norm(v[..., 1:])
    return (jnp.abs(v[..., 0] - norm) <= width) | (jnp.abs(v[..., 0] + norm) <= width)


def width_of(dtype):
    """Distance from a kink of the projection, in scaled numbers, up to which the solution counts as at it."""
    return float(jnp.finfo(dtype).eps) ** 0.5


# Arrays by groups of cones of one dimension, (k, d) each.


def rows_times(G, x):
    """Product G x of each group, (k, d)."""
    return tuple(matmul(g.reshape(-1, x.shape[0]), x).reshape(g.shape[:2]) for g in G)


def transpose_times(G, z, like):
    """Sum of G^T z over the groups, (n,)."""
    parts = [matmul(g.reshape(-1, g.shape[-1]).T, y.reshape(-1)) for g, y in zip(G, z, strict=True)]
    # The start value gives the sum its shape where there are no groups.
    return sum(parts, jnp.zeros_like(like))


def map_groups(function, *groups):
    """Values of a function of the arrays of each group."""
    return tuple(function(*each) for each in zip(*groups, strict=True))


def largest(*groups):
    """Largest absolute value () of all arrays, zero of none."""
    parts = [jnp.max(jnp.abs(x), initial=0) for group in groups for x in group]
    return jnp.max(jnp.stack(parts))


def dot(a, b, like):
    """Sum of the products a b over all groups, ()."""
    return sum((jnp.sum(x * y) for x, y in zip(a, b, strict=True)), jnp.zeros_like(like))
