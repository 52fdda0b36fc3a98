"""Motions of the plane: SE(2) as 3x3 matrices [[R, p], [0, 1]].

Twists V = (vx, vy, omega) and wrenches F = (fx, fy, tau) are (3,), linear part first; positive omega turns x towards
y. T_ab (3, 3) maps coordinates in frame b to coordinates in frame a. Units, names and conventions are those of `se3`.
Each function is the part of its namesake there with z = 0. Every function takes one sample; batch with `jax.vmap`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.lie.series import inverse_coefficient, stumpff

from .so3 import matmul

Point = Float[Array, "2"]
Twist = Float[Array, "3"]
Matrix = Float[Array, "3 3"]


def _quarter_turn(p: Point) -> Point:
    # z x p, so that a planar cross product is omega * _quarter_turn(p).
    x, y = jnp.unstack(p)
    return jnp.stack([-y, x])


def _area(a: Point, b: Point) -> Float[Array, ""]:
    # z component of a x b.
    return a[0] * b[1] - a[1] * b[0]


def from_parts(rotation: Float[Array, "2 2"], position: Point) -> Matrix:
    """Motion [[R, p], [0, 1]] from its parts.

    **Arguments:** `rotation`: R_ab, (2, 2); `position`: origin of b in a, (2,), m. **Returns:** T_ab, (3, 3).
    """
    top = jnp.concatenate([rotation, position[:, None]], axis=1)
    return jnp.concatenate([top, jnp.asarray([[0.0, 0.0, 1.0]], dtype=top.dtype)])


def apply(transform: Matrix, point: Point) -> Point:
    """Coordinates of a point in the other frame: R x + p.

    **Arguments:** `transform`: T_ab, (3, 3); `point`: (2,), m, in b. **Returns:** (2,), m, in a.
    """
    return matmul(transform[:2, :2], point) + transform[:2, 2]


def hat(twist: Twist) -> Matrix:
    """Matrix of a twist: [[0, -omega, vx], [omega, 0, vy], [0, 0, 0]].

    **Arguments:** `twist`: (vx, vy, omega), (3,). **Returns:** (3, 3).
    """
    vx, vy, omega = jnp.unstack(twist)
    o = jnp.zeros_like(omega)
    return jnp.stack([o, -omega, vx, omega, o, vy, o, o, o]).reshape(3, 3)


def vee(matrix: Matrix) -> Twist:
    """Twist of a matrix, the inverse of `hat`; the skew part of the rotational block is taken.

    **Arguments:** `matrix`: (3, 3). **Returns:** (vx, vy, omega), (3,).
    """
    # Averaging both off-diagonal entries keeps vee(hat(V)) = V and spreads a rounding error over the two.
    return jnp.stack([matrix[0, 2], matrix[1, 2], 0.5 * (matrix[1, 0] - matrix[0, 1])])


def exp(twist: Twist) -> Matrix:
    """Motion along a constant twist for unit time.

    R is the rotation by theta, p = (sin(theta)/theta) rho + ((1 - cos(theta))/theta) z x rho for (rho, theta).

    **Arguments:** `twist`: (rho, theta), (3,), m and rad. **Returns:** (3, 3). The error grows as eps |theta|.

    Source: Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), eq. 2.36 in the plane.
    """
    x, y, theta = jnp.unstack(twist)
    # c1 and c2 are series near theta = 0, where sin(theta)/theta and (1 - cos(theta))/theta^2 are 0/0.
    _, c1, c2, _ = stumpff(theta * theta)
    cos, sin, h = jnp.cos(theta), jnp.sin(theta), c2 * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([cos, -sin, c1 * x - h * y, sin, cos, h * x + c1 * y, o, o, one]).reshape(3, 3)


def log(transform: Matrix) -> Twist:
    """Exponent of a motion, with rotation angle in [-pi, pi].

    theta = atan2(R10, R00), rho = e p - (theta/2) z x p with e = (theta/2) cot(theta/2). Branch at angle pi: the sign
    of R10 decides, and R10 = +0 gives +pi, R10 = -0 gives -pi. Derivatives there are those of the branch returned.

    **Arguments:** `transform`: (3, 3). **Returns:** (rho, theta), (3,), m and rad.
    """
    # atan2 needs no clipping and keeps full precision at theta = 0 and pi, unlike arccos of half the trace.
    theta = jnp.arctan2(transform[1, 0], transform[0, 0])
    p = transform[:2, 2]
    s = theta * theta
    rho = (1.0 - s * inverse_coefficient(s)) * p - (0.5 * theta) * _quarter_turn(p)
    return jnp.concatenate([rho, theta[None]])


def inverse(transform: Matrix) -> Matrix:
    """Inverse motion [[R^T, -R^T p], [0, 1]]. **Arguments:** `transform`: T_ab, (3, 3). **Returns:** T_ba, (3, 3)."""
    rotation = transform[:2, :2].T
    return from_parts(rotation, -matmul(rotation, transform[:2, 2]))


def Ad(transform: Matrix) -> Matrix:
    """Adjoint: V_a = Ad_T V_b for T = T_ab, Ad_T = [[R, (py, -px)], [0, 1]].

    **Arguments:** `transform`: T_ab, (3, 3). **Returns:** (3, 3). To act on one vector use `Ad_apply`.
    """
    return from_parts(transform[:2, :2], -_quarter_turn(transform[:2, 2]))


def ad(twist: Twist) -> Matrix:
    """Adjoint of the algebra, ad_V = [[0, -omega, vy], [omega, 0, -vx], [0, 0, 0]]; ad_V W = vee of the commutator.

    **Arguments:** `twist`: (vx, vy, omega), (3,). **Returns:** (3, 3). To act on one vector use `ad_apply`.
    """
    vx, vy, omega = jnp.unstack(twist)
    o = jnp.zeros_like(omega)
    return jnp.stack([o, -omega, vy, omega, o, -vx, o, o, o]).reshape(3, 3)


def left_jacobian(twist: Twist) -> Matrix:
    """Left Jacobian of exp: (d/dt T) T^-1 = hat(J xidot), T = exp(xi).

    J = sum_k ad^k / (k+1)! = 1 + c2 ad + c3 ad^2 (Stumpff functions of theta^2), since ad^3 = -theta^2 ad. The right
    Jacobian is left_jacobian(-xi).

    **Arguments:** `twist`: (rho, theta), (3,), m and rad. **Returns:** (3, 3). Singular at |theta| = 2 pi n, n > 0.
    """
    x, y, theta = jnp.unstack(twist)
    _, c1, c2, c3 = stumpff(theta * theta)
    # ad^2 = [[-theta^2 1, theta rho], [0, 0]], and 1 - theta^2 c3 = c1.
    h, k = c2 * theta, c3 * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([c1, -h, c2 * y + k * x, h, c1, k * y - c2 * x, o, o, one]).reshape(3, 3)


def left_jacobian_inverse(twist: Twist) -> Matrix:
    """Inverse of the left Jacobian: xidot = J^-1 V, V the spatial twist of exp(xi).

    J^-1 = 1 - ad/2 + d ad^2, d = (1 - (theta/2) cot(theta/2)) / theta^2.

    **Arguments:** `twist`: (rho, theta), (3,), m and rad, |theta| < 2 pi. **Returns:** (3, 3). Unbounded towards
    |theta| = 2 pi.
    """
    x, y, theta = jnp.unstack(twist)
    # 1 - s d = (theta/2) cot(theta/2), by the coefficient that stays finite at theta = 0.
    s = theta * theta
    d = inverse_coefficient(s)
    e, h, k = 1.0 - s * d, 0.5 * theta, d * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([e, h, k * x - 0.5 * y, -h, e, k * y + 0.5 * x, o, o, one]).reshape(3, 3)


def Ad_apply(transform: Matrix, twist: Twist) -> Twist:
    """Twist in the other frame, Ad_T V = (R v + omega (py, -px), omega).

    **Arguments:** `transform`: T_ab, (3, 3); `twist`: in b, (3,). **Returns:** in a, (3,).
    """
    v = matmul(transform[:2, :2], twist[:2]) - twist[2] * _quarter_turn(transform[:2, 2])
    return jnp.concatenate([v, twist[2:]])


def Ad_inv_apply(transform: Matrix, twist: Twist) -> Twist:
    """Twist in the other frame, Ad_T^-1 V = (R^T (v - omega (py, -px)), omega).

    **Arguments:** `transform`: T_ab, (3, 3); `twist`: in a, (3,). **Returns:** in b, (3,).
    """
    # Vector times matrix is R^T v without a transposed copy.
    v = matmul(twist[:2] + twist[2] * _quarter_turn(transform[:2, 2]), transform[:2, :2])
    return jnp.concatenate([v, twist[2:]])


def AdT_apply(transform: Matrix, wrench: Twist) -> Twist:
    """Wrench in the other frame, F_b = Ad_T^T F_a = (R^T f, tau - p x f).

    **Arguments:** `transform`: T_ab, (3, 3); `wrench`: in a, (3,). **Returns:** in b, (3,).
    """
    tau = wrench[2] - _area(transform[:2, 2], wrench[:2])
    return jnp.concatenate([matmul(wrench[:2], transform[:2, :2]), tau[None]])


def Ad_inv_T_apply(transform: Matrix, wrench: Twist) -> Twist:
    """Wrench in the other frame, F_a = Ad_T^-T F_b = (R f, tau + p x R f).

    **Arguments:** `transform`: T_ab, (3, 3); `wrench`: in b, (3,). **Returns:** in a, (3,).
    """
    f = matmul(transform[:2, :2], wrench[:2])
    tau = wrench[2] + _area(transform[:2, 2], f)
    return jnp.concatenate([f, tau[None]])


def ad_apply(twist: Twist, other: Twist) -> Twist:
    """Bracket of twists, ad_V1 V2 = (omega1 z x v2 - omega2 z x v1, 0).

    **Arguments:** `twist`, `other`: V1, V2, (3,), in the same frame. **Returns:** (3,).
    """
    v = _quarter_turn(twist[2] * other[:2] - other[2] * twist[:2])
    return jnp.concatenate([v, jnp.zeros_like(twist[2:])])


def adT_apply(twist: Twist, wrench: Twist) -> Twist:
    """Transposed bracket on a wrench, ad_V^T F = (-omega z x f, f x v).

    **Arguments:** `twist`: V, (3,); `wrench`: F, (3,), same frame. **Returns:** (3,).
    """
    f = wrench[:2]
    return jnp.concatenate([-twist[2] * _quarter_turn(f), _area(f, twist[:2])[None]])


__all__ = [
    "Ad",
    "AdT_apply",
    "Ad_apply",
    "Ad_inv_T_apply",
    "Ad_inv_apply",
    "ad",
    "adT_apply",
    "ad_apply",
    "apply",
    "exp",
    "from_parts",
    "hat",
    "inverse",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "vee",
]
