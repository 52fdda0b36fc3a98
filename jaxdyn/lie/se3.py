"""Motions of space: SE(3) as 4x4 matrices [[R, p], [0, 1]].

Twists V = (v, omega) and wrenches F = (f, tau) are (6,), linear part first; V is in m/s and rad/s (or m and rad where
it is an exponent), F in N and N m. T_ab (4, 4) maps coordinates in frame b to coordinates in frame a. Every function
takes one sample; batch with `jax.vmap`. Values and first and second derivatives are finite at every angle.

The functions ending in `_apply` act on one twist or wrench with the blocks R and p, without building a 6x6 matrix.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.lie.series import compile_each, inverse_coefficient, stumpff

from . import so3
from .so3 import cross, matmul

Vector = Float[Array, "3"]
Twist = Float[Array, "6"]
Matrix = Float[Array, "4 4"]
Adjoint = Float[Array, "6 6"]


def _blocks(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Adjoint:
    # [[a, b], [0, a]], the form of every function of Ad and ad with the linear part first.
    top = jnp.concatenate([a, b], axis=1)
    bottom = jnp.concatenate([jnp.zeros_like(a), a], axis=1)
    return jnp.concatenate([top, bottom])


def from_parts(rotation: Float[Array, "3 3"], position: Vector) -> Matrix:
    r"""Motion from its rotation and its position.

    $$T = \begin{bmatrix} R & p \\ 0 & 1 \end{bmatrix}$$

    **Arguments:** `rotation`: R_ab, (3, 3); `position`: origin of b in a, (3,), m. **Returns:** T_ab, (4, 4).
    """
    top = jnp.concatenate([rotation, position[:, None]], axis=1)
    return jnp.concatenate([top, jnp.asarray([[0.0, 0.0, 0.0, 1.0]], dtype=top.dtype)])


def apply(transform: Matrix, point: Vector) -> Vector:
    """Coordinates of a point in the other frame.

    $$x_a = R x_b + p$$

    **Arguments:** `transform`: T_ab, (4, 4); `point`: (3,), m, in b. **Returns:** (3,), m, in a.
    """
    return matmul(transform[:3, :3], point) + transform[:3, 3]


def hat(twist: Twist) -> Matrix:
    r"""Matrix of a twist.

    $$\hat V = \begin{bmatrix} \hat\omega & v \\ 0 & 0 \end{bmatrix}$$

    **Arguments:** `twist`: (v, omega), (6,). **Returns:** (4, 4).

    Source: Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), chapter 2, section 3.2.
    """
    top = jnp.concatenate([so3.hat(twist[3:]), twist[:3, None]], axis=1)
    return jnp.concatenate([top, jnp.zeros_like(top[:1])])


def vee(matrix: Matrix) -> Twist:
    """Twist of a matrix, the inverse of `hat`; the skew part of the rotational block is taken.

    **Arguments:** `matrix`: (4, 4). **Returns:** (v, omega), (6,).
    """
    return jnp.concatenate([matrix[:3, 3], so3.vee(matrix[:3, :3])])


def exp(twist: Twist) -> Matrix:
    r"""Motion along a constant twist for unit time.

    $$R = \exp \hat\phi, \quad p = J(\phi) \rho = c_1 \rho + c_2\, \phi \times \rho + c_3\, \phi (\phi \cdot \rho)$$

    for the exponent $(\rho, \phi)$, with J the left Jacobian of SO(3) and $c_k$ the Stumpff functions of $|\phi|^2$.

    **Arguments:** `twist`: (rho, phi), (6,), m and rad. **Returns:** (4, 4). The error grows as $\epsilon |\phi|$.

    Source: Murray, Li, Sastry (1994), eq. 2.36; Barfoot, State Estimation for Robotics (2017), eq. 7.85.
    """
    # Expanding J(phi) rho by its three terms costs one cross product and no matrix.
    rho, phi = twist[:3], twist[3:]
    c0, c1, c2, c3 = stumpff(jnp.sum(phi * phi))
    rotation = so3._isotropic_sum(c0, c1, c2, phi)
    return from_parts(rotation, c1 * rho + c2 * cross(phi, rho) + (c3 * jnp.sum(phi * rho)) * phi)


def log(transform: Matrix) -> Twist:
    r"""Exponent of a motion, with rotation angle at most pi.

    $$\phi = \log R, \quad \rho = J(\phi)^{-1} p = e p - \tfrac12 \phi \times p + d\, \phi (\phi \cdot p)$$

    with d the coefficient of `so3.left_jacobian_inverse` and $e = 1 - d |\phi|^2$. At angle pi the branch is that of
    `so3.log`; the two branches are different screws that reach the same motion.

    **Arguments:** `transform`: (4, 4), rotation orthogonal to rounding. **Returns:** (rho, phi), (6,), m and rad.
    """
    # rho must use the same branch of phi as the logarithm of R, or exp(log(T)) would miss T at angle pi.
    p = transform[:3, 3]
    phi = so3.log(transform[:3, :3])
    s = jnp.sum(phi * phi)
    d = inverse_coefficient(s)
    rho = (1.0 - s * d) * p - 0.5 * cross(phi, p) + (d * jnp.sum(phi * p)) * phi
    return jnp.concatenate([rho, phi])


def inverse(transform: Matrix) -> Matrix:
    r"""Inverse motion.

    $$T^{-1} = \begin{bmatrix} R^T & -R^T p \\ 0 & 1 \end{bmatrix}$$

    **Arguments:** `transform`: T_ab, (4, 4). **Returns:** T_ba, (4, 4).
    """
    rotation = transform[:3, :3].T
    return from_parts(rotation, -matmul(rotation, transform[:3, 3]))


def Ad(transform: Matrix) -> Adjoint:
    r"""Adjoint of a motion, which maps twists to the other frame.

    $$V_a = \mathrm{Ad}_T V_b, \quad T = T_{ab}, \quad \mathrm{Ad}_T = \begin{bmatrix} R & \hat p R \\ 0 & R \end{bmatrix}$$

    **Arguments:** `transform`: T_ab, (4, 4). **Returns:** (6, 6). To act on one vector use `Ad_apply`.

    Source: Murray, Li, Sastry (1994), eq. 2.58.
    """
    rotation = transform[:3, :3]
    return _blocks(rotation, matmul(so3.hat(transform[:3, 3]), rotation))


def ad(twist: Twist) -> Adjoint:
    r"""Adjoint of the algebra; its product with a twist is the commutator.

    $$\mathrm{ad}_V = \begin{bmatrix} \hat\omega & \hat v \\ 0 & \hat\omega \end{bmatrix}, \quad \mathrm{ad}_V W = [V, W]$$

    **Arguments:** `twist`: (v, omega), (6,). **Returns:** (6, 6). To act on one vector use `ad_apply`.
    """
    return _blocks(so3.hat(twist[3:]), so3.hat(twist[:3]))


def left_jacobian(twist: Twist) -> Adjoint:
    r"""Left Jacobian of exp.

    $$\dot T T^{-1} = \widehat{J \dot\xi}, \quad T = \exp \hat\xi, \quad
    J = \sum_k \frac{\mathrm{ad}_\xi^k}{(k+1)!} = \begin{bmatrix} J_3 & Q \\ 0 & J_3 \end{bmatrix}$$

    $J_3$ is the left Jacobian of SO(3) at $\phi$, for $\xi = (\rho, \phi)$, and Q its derivative in the direction $\rho$.
    The right Jacobian is `left_jacobian(-xi)`.

    **Arguments:** `twist`: (rho, phi), (6,), m and rad. **Returns:** (6, 6). Singular at $|\phi| = 2 \pi n$, n > 0.

    Source: Barfoot (2017), eq. 7.86, there Q in closed form.
    """
    # Exponents of SE(3) are those of SO(3) over dual numbers, phi + eps rho, and ad_xi is hat(phi + eps rho); so
    # every power series in ad_xi has the directional derivative as its off-diagonal block.
    return _blocks(*jax.jvp(so3.left_jacobian, (twist[3:],), (twist[:3],)))


def left_jacobian_inverse(twist: Twist) -> Adjoint:
    r"""Inverse of the left Jacobian.

    $$\dot\xi = J^{-1} V, \quad J^{-1} = \begin{bmatrix} J_3^{-1} & P \\ 0 & J_3^{-1} \end{bmatrix}$$

    V is the spatial twist of $\exp \hat\xi$ and P the derivative of $J_3^{-1}$ at $\phi$ in the direction $\rho$, since
    $d(J_3^{-1}) = -J_3^{-1} dJ_3 J_3^{-1}$.

    **Arguments:** `twist`: (rho, phi), (6,), m and rad, $|\phi| < 2 \pi$. **Returns:** (6, 6). Unbounded towards
    $|\phi| = 2 \pi$.

    Source: Barfoot (2017), eq. 7.95.
    """
    return _blocks(*jax.jvp(so3.left_jacobian_inverse, (twist[3:],), (twist[:3],)))


def Ad_apply(transform: Matrix, twist: Twist) -> Twist:
    r"""Twist in the other frame, without the matrix of `Ad`.

    $$\mathrm{Ad}_T V = (R v + p \times R \omega, R \omega)$$

    **Arguments:** `transform`: T_ab, (4, 4); `twist`: in b, (6,). **Returns:** in a, (6,).
    """
    rotation, p = transform[:3, :3], transform[:3, 3]
    omega = matmul(rotation, twist[3:])
    return jnp.concatenate([matmul(rotation, twist[:3]) + cross(p, omega), omega])


def Ad_inv_apply(transform: Matrix, twist: Twist) -> Twist:
    r"""Twist in the other frame, the inverse of `Ad_apply`.

    $$\mathrm{Ad}_T^{-1} V = (R^T (v - p \times \omega), R^T \omega)$$

    **Arguments:** `transform`: T_ab, (4, 4); `twist`: in a, (6,). **Returns:** in b, (6,).
    """
    rotation, p = transform[:3, :3], transform[:3, 3]
    v, omega = twist[:3], twist[3:]
    # Row vector times R is R^T times the vector, without a transposed copy.
    return jnp.concatenate([matmul(v - cross(p, omega), rotation), matmul(omega, rotation)])


def AdT_apply(transform: Matrix, wrench: Twist) -> Twist:
    r"""Wrench in the other frame, from a to b.

    $$F_b = \mathrm{Ad}_T^T F_a = (R^T f, R^T (\tau - p \times f))$$

    **Arguments:** `transform`: T_ab, (4, 4); `wrench`: in a, (6,). **Returns:** in b, (6,).
    """
    rotation, p = transform[:3, :3], transform[:3, 3]
    f, tau = wrench[:3], wrench[3:]
    return jnp.concatenate([matmul(f, rotation), matmul(tau - cross(p, f), rotation)])


def Ad_inv_T_apply(transform: Matrix, wrench: Twist) -> Twist:
    r"""Wrench in the other frame, from b to a.

    $$F_a = \mathrm{Ad}_T^{-T} F_b = (R f, R \tau + p \times R f)$$

    **Arguments:** `transform`: T_ab, (4, 4); `wrench`: in b, (6,). **Returns:** in a, (6,).
    """
    rotation, p = transform[:3, :3], transform[:3, 3]
    f = matmul(rotation, wrench[:3])
    return jnp.concatenate([f, matmul(rotation, wrench[3:]) + cross(p, f)])


def ad_apply(twist: Twist, other: Twist) -> Twist:
    r"""Bracket of twists.

    $$\mathrm{ad}_{V_1} V_2 = (\omega_1 \times v_2 - \omega_2 \times v_1, \omega_1 \times \omega_2)$$

    **Arguments:** `twist`, `other`: V1, V2, (6,), in the same frame. **Returns:** (6,).
    """
    # omega1 x v2 - omega2 x v1, written with v1 x omega2 so that both terms add.
    v1, omega1 = twist[:3], twist[3:]
    v2, omega2 = other[:3], other[3:]
    return jnp.concatenate([cross(omega1, v2) + cross(v1, omega2), cross(omega1, omega2)])


def adT_apply(twist: Twist, wrench: Twist) -> Twist:
    r"""Transposed bracket on a wrench.

    $$\mathrm{ad}_V^T F = (f \times \omega, f \times v + \tau \times \omega)$$

    The Newton-Euler equation of a body reads $M \dot V - \mathrm{ad}_V^T M V = F$.

    **Arguments:** `twist`: V, (6,); `wrench`: F, (6,), same frame. **Returns:** (6,).
    """
    v, omega = twist[:3], twist[3:]
    f, tau = wrench[:3], wrench[3:]
    return jnp.concatenate([cross(f, omega), cross(f, v) + cross(tau, omega)])


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
