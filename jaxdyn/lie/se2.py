"""Motions of the plane: SE(2) as 3x3 matrices [[R, p], [0, 1]].

Twists V = (vx, vy, omega) and wrenches F = (fx, fy, tau) are (3,), linear part first; positive omega turns x towards
y. T_ab (3, 3) maps coordinates in frame b to coordinates in frame a. Units, names and conventions are those of `se3`.
Each function is the part of its namesake there with z = 0. Every function takes one sample; batch with `jax.vmap`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.lie.series import compile_each, inverse_coefficient, stumpff

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
    r"""Motion from its rotation and its position.

    $$T = \begin{bmatrix} R & p \\ 0 & 1 \end{bmatrix}$$

    **Arguments:** `rotation`: R_ab, (2, 2); `position`: origin of b in a, (2,), m. **Returns:** T_ab, (3, 3).
    """
    top = jnp.concatenate([rotation, position[:, None]], axis=1)
    return jnp.concatenate([top, jnp.asarray([[0.0, 0.0, 1.0]], dtype=top.dtype)])


def apply(transform: Matrix, point: Point) -> Point:
    """Coordinates of a point in the other frame.

    $$x_a = R x_b + p$$

    **Arguments:** `transform`: T_ab, (3, 3); `point`: (2,), m, in b. **Returns:** (2,), m, in a.
    """
    return matmul(transform[:2, :2], point) + transform[:2, 2]


def hat(twist: Twist) -> Matrix:
    r"""Matrix of a twist.

    $$\hat V = \begin{bmatrix} 0 & -\omega & v_x \\ \omega & 0 & v_y \\ 0 & 0 & 0 \end{bmatrix}$$

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
    r"""Motion along a constant twist for unit time.

    R is the rotation by $\theta$; for the exponent $(\rho, \theta)$ the position is

    $$p = \frac{\sin\theta}{\theta} \rho + \frac{1 - \cos\theta}{\theta} z \times \rho.$$

    **Arguments:** `twist`: (rho, theta), (3,), m and rad. **Returns:** (3, 3). The error grows as $\epsilon |\theta|$.

    Source: Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), eq. 2.36 in the plane.
    """
    x, y, theta = jnp.unstack(twist)
    # c1 and c2 are series near theta = 0, where sin(theta)/theta and (1 - cos(theta))/theta^2 are 0/0.
    _, c1, c2, _ = stumpff(theta * theta)
    cos, sin, h = jnp.cos(theta), jnp.sin(theta), c2 * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([cos, -sin, c1 * x - h * y, sin, cos, h * x + c1 * y, o, o, one]).reshape(3, 3)


def log(transform: Matrix) -> Twist:
    r"""Exponent of a motion, with rotation angle in [-pi, pi].

    $$\theta = \operatorname{atan2}(R_{10}, R_{00}), \quad
    \rho = \frac{\theta}{2} \cot\frac{\theta}{2} p - \frac{\theta}{2} z \times p$$

    Branch at angle pi: the sign of $R_{10}$ decides, and +0 gives +pi, -0 gives -pi. Derivatives there are those of the
    branch returned.

    **Arguments:** `transform`: (3, 3). **Returns:** (rho, theta), (3,), m and rad.
    """
    # atan2 needs no clipping and keeps full precision at theta = 0 and pi, unlike arccos of half the trace.
    theta = jnp.arctan2(transform[1, 0], transform[0, 0])
    p = transform[:2, 2]
    s = theta * theta
    rho = (1.0 - s * inverse_coefficient(s)) * p - (0.5 * theta) * _quarter_turn(p)
    return jnp.concatenate([rho, theta[None]])


def inverse(transform: Matrix) -> Matrix:
    r"""Inverse motion.

    $$T^{-1} = \begin{bmatrix} R^T & -R^T p \\ 0 & 1 \end{bmatrix}$$

    **Arguments:** `transform`: T_ab, (3, 3). **Returns:** T_ba, (3, 3).
    """
    rotation = transform[:2, :2].T
    return from_parts(rotation, -matmul(rotation, transform[:2, 2]))


def Ad(transform: Matrix) -> Matrix:
    r"""Adjoint of a motion, which maps twists to the other frame.

    $$V_a = \mathrm{Ad}_T V_b, \quad T = T_{ab}, \quad
    \mathrm{Ad}_T = \begin{bmatrix} R & (p_y, -p_x) \\ 0 & 1 \end{bmatrix}$$

    **Arguments:** `transform`: T_ab, (3, 3). **Returns:** (3, 3). To act on one vector use `Ad_apply`.
    """
    return from_parts(transform[:2, :2], -_quarter_turn(transform[:2, 2]))


def ad(twist: Twist) -> Matrix:
    r"""Adjoint of the algebra; its product with a twist is the commutator.

    $$\mathrm{ad}_V = \begin{bmatrix} 0 & -\omega & v_y \\ \omega & 0 & -v_x \\ 0 & 0 & 0 \end{bmatrix}, \quad
    \mathrm{ad}_V W = [V, W]$$

    **Arguments:** `twist`: (vx, vy, omega), (3,). **Returns:** (3, 3). To act on one vector use `ad_apply`.
    """
    vx, vy, omega = jnp.unstack(twist)
    o = jnp.zeros_like(omega)
    return jnp.stack([o, -omega, vy, omega, o, -vx, o, o, o]).reshape(3, 3)


def left_jacobian(twist: Twist) -> Matrix:
    r"""Left Jacobian of exp.

    $$\dot T T^{-1} = \widehat{J \dot\xi}, \quad T = \exp \hat\xi, \quad
    J = \sum_k \frac{\mathrm{ad}_\xi^k}{(k+1)!} = 1 + c_2 \mathrm{ad}_\xi + c_3 \mathrm{ad}_\xi^2$$

    The coefficients are Stumpff functions of $\theta^2$, since $\mathrm{ad}^3 = -\theta^2 \mathrm{ad}$. The right Jacobian is
    `left_jacobian(-xi)`.

    **Arguments:** `twist`: (rho, theta), (3,), m and rad. **Returns:** (3, 3). Singular at $|\theta| = 2 \pi n$, n > 0.
    """
    x, y, theta = jnp.unstack(twist)
    _, c1, c2, c3 = stumpff(theta * theta)
    # ad^2 = [[-theta^2 1, theta rho], [0, 0]], and 1 - theta^2 c3 = c1.
    h, k = c2 * theta, c3 * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([c1, -h, c2 * y + k * x, h, c1, k * y - c2 * x, o, o, one]).reshape(3, 3)


def left_jacobian_inverse(twist: Twist) -> Matrix:
    r"""Inverse of the left Jacobian.

    $$\dot\xi = J^{-1} V, \quad J^{-1} = 1 - \frac{\mathrm{ad}_\xi}{2} + d\, \mathrm{ad}_\xi^2, \quad
    d = \frac{1 - (\theta/2) \cot(\theta/2)}{\theta^2}$$

    V is the spatial twist of $\exp \hat\xi$.

    **Arguments:** `twist`: (rho, theta), (3,), m and rad, $|\theta| < 2 \pi$. **Returns:** (3, 3). Unbounded towards
    $|\theta| = 2 \pi$.
    """
    x, y, theta = jnp.unstack(twist)
    # 1 - s d = (theta/2) cot(theta/2), by the coefficient that stays finite at theta = 0.
    s = theta * theta
    d = inverse_coefficient(s)
    e, h, k = 1.0 - s * d, 0.5 * theta, d * theta
    o, one = jnp.zeros_like(theta), jnp.ones_like(theta)
    return jnp.stack([e, h, k * x - 0.5 * y, -h, e, k * y + 0.5 * x, o, o, one]).reshape(3, 3)


def Ad_apply(transform: Matrix, twist: Twist) -> Twist:
    r"""Twist in the other frame, without the matrix of `Ad`.

    $$\mathrm{Ad}_T V = (R v + \omega (p_y, -p_x), \omega)$$

    **Arguments:** `transform`: T_ab, (3, 3); `twist`: in b, (3,). **Returns:** in a, (3,).
    """
    v = matmul(transform[:2, :2], twist[:2]) - twist[2] * _quarter_turn(transform[:2, 2])
    return jnp.concatenate([v, twist[2:]])


def Ad_inv_apply(transform: Matrix, twist: Twist) -> Twist:
    r"""Twist in the other frame, the inverse of `Ad_apply`.

    $$\mathrm{Ad}_T^{-1} V = (R^T (v - \omega (p_y, -p_x)), \omega)$$

    **Arguments:** `transform`: T_ab, (3, 3); `twist`: in a, (3,). **Returns:** in b, (3,).
    """
    # Vector times matrix is R^T v without a transposed copy.
    v = matmul(twist[:2] + twist[2] * _quarter_turn(transform[:2, 2]), transform[:2, :2])
    return jnp.concatenate([v, twist[2:]])


def AdT_apply(transform: Matrix, wrench: Twist) -> Twist:
    r"""Wrench in the other frame, from a to b.

    $$F_b = \mathrm{Ad}_T^T F_a = (R^T f, \tau - p \times f)$$

    **Arguments:** `transform`: T_ab, (3, 3); `wrench`: in a, (3,). **Returns:** in b, (3,).
    """
    tau = wrench[2] - _area(transform[:2, 2], wrench[:2])
    return jnp.concatenate([matmul(wrench[:2], transform[:2, :2]), tau[None]])


def Ad_inv_T_apply(transform: Matrix, wrench: Twist) -> Twist:
    r"""Wrench in the other frame, from b to a.

    $$F_a = \mathrm{Ad}_T^{-T} F_b = (R f, \tau + p \times R f)$$

    **Arguments:** `transform`: T_ab, (3, 3); `wrench`: in b, (3,). **Returns:** in a, (3,).
    """
    f = matmul(transform[:2, :2], wrench[:2])
    tau = wrench[2] + _area(transform[:2, 2], f)
    return jnp.concatenate([f, tau[None]])


def ad_apply(twist: Twist, other: Twist) -> Twist:
    r"""Bracket of twists.

    $$\mathrm{ad}_{V_1} V_2 = (\omega_1 z \times v_2 - \omega_2 z \times v_1, 0)$$

    **Arguments:** `twist`, `other`: V1, V2, (3,), in the same frame. **Returns:** (3,).
    """
    v = _quarter_turn(twist[2] * other[:2] - other[2] * twist[:2])
    return jnp.concatenate([v, jnp.zeros_like(twist[2:])])


def adT_apply(twist: Twist, wrench: Twist) -> Twist:
    r"""Transposed bracket on a wrench.

    $$\mathrm{ad}_V^T F = (-\omega z \times f, f \times v)$$

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

compile_each(globals())


def __dir__() -> list[str]:
    return __all__
