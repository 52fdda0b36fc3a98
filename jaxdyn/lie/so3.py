"""Rotations of space: SO(3) as 3x3 matrices and as unit quaternions.

A rotation vector phi (3,) is axis times angle in radians. A matrix R_ab (3, 3) maps coordinates in frame b to
coordinates in frame a. Quaternions (4,) are (w, x, y, z), scalar first, and act by the Hamilton product. Every
function takes one sample; batch with `jax.vmap`. Values and first and second derivatives are finite at every angle.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.lie.series import angle_ratio, compile_each, inverse_coefficient, stumpff

Vector = Float[Array, "3"]
Matrix = Float[Array, "3 3"]
Quaternion = Float[Array, "4"]


def matmul(a: Array, b: Array) -> Array:
    """Matrix product in the precision of its operands, batched as `jnp.matmul`."""
    # GPUs may round float32 products to TF32 unless asked not to.
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def cross(a: Vector, b: Vector) -> Vector:
    r"""Cross product of two vectors, without the matrix of `hat`.

    **Arguments:** `a`, `b`: (3,), in the same frame. **Returns:** (3,), product of their units.
    """
    # Six products instead of nine for a matrix; XLA fuses the scalar form into its surroundings.
    ax, ay, az = jnp.unstack(a)
    bx, by, bz = jnp.unstack(b)
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def hat(phi: Vector) -> Matrix:
    r"""Skew matrix of a vector.

    $$\hat a b = a \times b$$

    **Arguments:** `phi`: (3,). **Returns:** (3, 3), same unit and frame.

    Source: Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation (1994), eq. 2.4.
    """
    x, y, z = jnp.unstack(phi)
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3)


def vee(matrix: Matrix) -> Vector:
    """Vector of a skew matrix, the inverse of `hat`; of any other matrix, the vector of its skew part.

    **Arguments:** `matrix`: (3, 3). **Returns:** (3,), half the differences of opposite entries.
    """
    _, m01, m02, m10, _, m12, m20, m21, _ = jnp.unstack(matrix.reshape(9))
    return 0.5 * jnp.stack([m21 - m12, m02 - m20, m10 - m01])


def _isotropic_sum(a: Float[Array, ""], b: Float[Array, ""], c: Float[Array, ""], phi: Vector) -> Matrix:
    # a 1 + b hat(phi) + c phi phi^T: since hat(phi)^2 = phi phi^T - s 1, every function of hat(phi) has this form.
    identity = jnp.eye(3, dtype=phi.dtype)
    return a * identity + b * hat(phi) + c * (phi[:, None] * phi[None, :])


def exp(phi: Vector) -> Matrix:
    r"""Rotation matrix of a rotation vector (Rodrigues).

    $$R = \cos\theta\, 1 + \frac{\sin\theta}{\theta} \hat\phi + \frac{1 - \cos\theta}{\theta^2} \phi \phi^T, \quad
    \theta = |\phi|$$

    **Arguments:** `phi`: (3,), rad, of any length. **Returns:** (3, 3). The error grows as $\epsilon \theta$ for many turns.

    Source: Murray, Li, Sastry (1994), eq. 2.14.
    """
    c0, c1, c2, _ = stumpff(jnp.sum(phi * phi))
    return _isotropic_sum(c0, c1, c2, phi)


def log(rotation: Matrix) -> Vector:
    r"""Rotation vector of a rotation matrix, of length at most pi.

    It is `quat_log(matrix_to_quat(R))`. Branch at $\theta = \pi$, where $\pm\phi$ are the same rotation: the sign of
    the quaternion's scalar part decides, and where that is exactly zero, the component of the axis with the largest
    magnitude comes out positive (the first of equals). Derivatives there are one-sided, those of the branch returned;
    at an angle within rounding of pi either sign may come out.

    **Arguments:** `rotation`: (3, 3), orthogonal to rounding. **Returns:** (3,), rad.

    Derivatives are meant along the group: off it, the entries of the matrix may be extended in other ways.
    """
    return quat_log(matrix_to_quat(rotation))


def inverse(rotation: Matrix) -> Matrix:
    """Inverse rotation, the transposed matrix. **Arguments:** `rotation`: (3, 3). **Returns:** (3, 3)."""
    return rotation.T


def Ad(rotation: Matrix) -> Matrix:
    r"""Adjoint of a rotation on angular velocities, which is the rotation itself.

    $$R \hat\omega R^T = \widehat{\mathrm{Ad}_R \omega}, \quad \mathrm{Ad}_R = R$$

    **Arguments:** `rotation`: R_ab, (3, 3). **Returns:** (3, 3), maps angular velocities in b to a.
    """
    return rotation


def ad(phi: Vector) -> Matrix:
    r"""Adjoint of the algebra, which is the skew matrix.

    $$\mathrm{ad}_a b = a \times b, \quad \mathrm{ad}_a = \hat a$$

    **Arguments:** `phi`: (3,). **Returns:** (3, 3).
    """
    return hat(phi)


def left_jacobian(phi: Vector) -> Matrix:
    r"""Left Jacobian of exp.

    $$\dot R R^T = \widehat{J \dot\phi}, \quad R = \exp \hat\phi, \quad
    J = \sum_k \frac{\hat\phi^k}{(k+1)!} = c_1 1 + c_2 \hat\phi + c_3 \phi \phi^T$$

    The coefficients are Stumpff functions of $\theta^2$. The right Jacobian, which gives $R^T \dot R$, is
    `left_jacobian(-phi)`, the transposed matrix.

    **Arguments:** `phi`: (3,), rad. **Returns:** (3, 3). Singular at $\theta = 2 \pi n$, n > 0.

    Source: Barfoot, State Estimation for Robotics (2017), eq. 7.77.
    """
    _, c1, c2, c3 = stumpff(jnp.sum(phi * phi))
    return _isotropic_sum(c1, c2, c3, phi)


def left_jacobian_inverse(phi: Vector) -> Matrix:
    r"""Inverse of the left Jacobian.

    $$\dot\phi = J^{-1} \omega, \quad J^{-1} = 1 - \tfrac12 \hat\phi + d\, \hat\phi^2, \quad
    d = \frac{1 - (\theta/2) \cot(\theta/2)}{\theta^2}$$

    with $\omega$ the angular velocity in the fixed frame.

    **Arguments:** `phi`: (3,), rad, $|\phi| < 2 \pi$. **Returns:** (3, 3). Unbounded towards $|\phi| = 2 \pi$.

    Source: Barfoot (2017), eq. 7.76; Bullo and Murray, PD control on the Euclidean group (1995).
    """
    s = jnp.sum(phi * phi)
    d = inverse_coefficient(s)
    return _isotropic_sum(1.0 - s * d, jnp.full_like(s, -0.5), d, phi)


def quat_exp(phi: Vector) -> Quaternion:
    r"""Unit quaternion of a rotation vector.

    $$q = \left(\cos\frac{\theta}{2}, \frac{\phi}{\theta} \sin\frac{\theta}{2}\right), \quad \theta = |\phi|$$

    **Arguments:** `phi`: (3,), rad, of any length. **Returns:** (4,). Its sign is that of the half angle: adding a
    full turn to phi negates it.

    Source: Murray, Li, Sastry (1994), chapter 2, section 2.3.
    """
    # sin(theta/2)/theta is half of sin(h)/h at the half angle h, which makes the Stumpff functions applicable.
    c0, c1, _, _ = stumpff(0.25 * jnp.sum(phi * phi))
    return jnp.concatenate([c0[None], (0.5 * c1) * phi])


def quat_log(q: Quaternion) -> Vector:
    r"""Rotation vector of a quaternion, of length at most pi.

    $$\phi = 2 \operatorname{atan2}(|v|, w) \frac{v}{|v|}, \quad q = (w, v), \quad w \ge 0$$

    and the same of -q (the same rotation) for w < 0. Branch at angle pi (w = 0): $\phi = \pi v / |v|$, with the sign of v
    as given.

    **Arguments:** `q`: (4,), of any length but zero, which does not matter. **Returns:** (3,), rad.
    """
    # q and -q are the same rotation; w >= 0 selects the shorter angle, at most pi.
    q = jnp.where(q[0] < 0.0, -q, q)
    v = q[1:]
    return angle_ratio(jnp.sum(v * v), q[0]) * v


def quat_multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    r"""Hamilton product, the quaternion of the product of the rotation matrices.

    $$(w_a, v_a) (w_b, v_b) = (w_a w_b - v_a \cdot v_b, w_a v_b + w_b v_a + v_a \times v_b)$$

    **Arguments:** `a`, `b`: (4,). **Returns:** (4,), not normalised.
    """
    aw, ax, ay, az = jnp.unstack(a)
    bw, bx, by, bz = jnp.unstack(b)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quat_conjugate(q: Quaternion) -> Quaternion:
    """Conjugate (w, -v), the inverse of a unit quaternion. **Arguments:** `q`: (4,). **Returns:** (4,)."""
    return jnp.concatenate([q[:1], -q[1:]])


def quat_normalize(q: Quaternion) -> Quaternion:
    """Unit quaternion q / |q|, sign kept. **Arguments:** `q`: (4,), not zero (NaN). **Returns:** (4,)."""
    return q / jnp.sqrt(jnp.sum(q * q))


def quat_to_matrix(q: Quaternion) -> Matrix:
    r"""Rotation matrix of a quaternion of any length.

    $$R = 1 + \frac{2}{|q|^2} (w \hat v + \hat v^2), \quad q = (w, v)$$

    Dividing by $|q|^2$ makes R orthogonal to rounding even where q has drifted from unit length, as it does between the
    steps of an integrator. The derivative along q is zero.

    **Arguments:** `q`: (4,), not zero (NaN). **Returns:** (3, 3).

    Source: Murray, Li, Sastry (1994), chapter 2, section 2.3.
    """
    w, v = q[0], q[1:]
    v2 = jnp.sum(v * v)
    k = 2.0 / (w * w + v2)
    # hat(v)^2 = v v^T - |v|^2 1
    identity = jnp.eye(3, dtype=q.dtype)
    return (1.0 - k * v2) * identity + (k * w) * hat(v) + (k * v)[:, None] * v[None, :]


def quat_rotate(q: Quaternion, x: Vector) -> Vector:
    r"""Rotated vector, without the matrix of `quat_to_matrix`; q of any length, as there.

    $$R x = x + \frac{2}{|q|^2} (w\, v \times x + v \times (v \times x)), \quad q = (w, v)$$

    **Arguments:** `q`: (4,), of R_ab, not zero (NaN); `x`: (3,), in frame b. **Returns:** (3,), in frame a.
    """
    w, v = q[0], q[1:]
    doubled = (2.0 / jnp.sum(q * q)) * cross(v, x)
    return x + w * doubled + cross(v, doubled)


def matrix_to_quat(rotation: Matrix) -> Quaternion:
    r"""Unit quaternion of a rotation matrix, with scalar part w >= 0.

    The rows of $4 q q^T$ are linear in R. The row with the largest diagonal entry $4 q_i^2 \ge 1$ is normalised, so no
    root meets zero, and the four cases differ only by a selection. Branch at angle pi (w = 0): the component with
    the largest magnitude is positive (the first of equals).

    **Arguments:** `rotation`: (3, 3), orthogonal to rounding. **Returns:** (4,). If R is orthogonal to e only, q is
    a unit quaternion off by about e. Derivatives are meant along the group.

    Source: Shepperd, Quaternion from rotation matrix (1978).
    """
    xx, r01, r02, r10, yy, r12, r20, r21, zz = jnp.unstack(rotation.reshape(9))
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    yz, zx, xy = r21 + r12, r02 + r20, r10 + r01
    ww = 1.0 + xx + yy + zz
    x4, y4, z4 = 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz
    # Symmetric, row i = 4 q_i q: the diagonal entries sum to 4, so the largest is at least 1.
    rows = jnp.stack([ww, wx, wy, wz, wx, x4, xy, zx, wy, xy, y4, yz, wz, zx, yz, z4]).reshape(4, 4)
    of_wx = jnp.where(ww >= x4, rows[0], rows[1])
    of_yz = jnp.where(y4 >= z4, rows[2], rows[3])
    row = jnp.where(jnp.maximum(ww, x4) >= jnp.maximum(y4, z4), of_wx, of_yz)
    return quat_normalize(jnp.where(row[0] < 0.0, -row, row))


def euler_to_matrix(angles: Vector, sequence: str = "zyz") -> Matrix:
    r"""Rotation matrix of three Euler angles.

    $$R = R_a(\theta_1) R_b(\theta_2) R_c(\theta_3)$$

    for the sequence "abc". Each rotation is about an axis that the former ones have moved: "zyx" is yaw, pitch and roll.

    **Arguments:** `angles`: (3,), rad; `sequence`: three of x, y, z, neighbours different. **Returns:** (3, 3).

    **Raises:** ValueError for another sequence.

    Source: Murray, Li, Sastry (1994), eq. 2.19; EQUATIONS section 12.
    """
    first, second, third = _axis_rotations(angles, sequence)
    return matmul(matmul(first, second), third)


def euler_body_jacobian(angles: Vector, sequence: str = "zyz") -> Matrix:
    r"""Matrix that maps rates of Euler angles to the angular velocity in body axes.

    $$\widehat{E \dot\theta} = R^T \dot R$$

    Its columns are the three axes in body coordinates. Torques about the axes are $E^T$ times those in body axes.

    **Arguments:** `angles`: (3,), rad; `sequence` as of `euler_to_matrix`. **Returns:** (3, 3). Singular where the first
    and the last axis are parallel: $\det E = -\sin\theta_2$ for "zyz".

    **Raises:** ValueError for another sequence.

    Source: Loparo & Vakalis, section 7.5, with errata E51 and E52; EQUATIONS section 12.
    """
    _, second, third = _axis_rotations(angles, sequence)
    a, b, c = _axes(sequence, angles.dtype)
    return jnp.stack([matmul(third.T, matmul(second.T, a)), matmul(third.T, b), c], axis=1)


def euler_spatial_jacobian(angles: Vector, sequence: str = "zyz") -> Matrix:
    r"""Matrix that maps rates of Euler angles to the angular velocity in fixed axes.

    $$\widehat{E_s \dot\theta} = \dot R R^T, \quad E_s = R E$$

    Its columns are the three axes in fixed coordinates.

    **Arguments:** `angles`: (3,), rad; `sequence` as of `euler_to_matrix`. **Returns:** (3, 3). Singular where E is.

    **Raises:** ValueError for another sequence.

    Source: Loparo & Vakalis, section 7.5; EQUATIONS section 12.
    """
    first, second, _ = _axis_rotations(angles, sequence)
    a, b, c = _axes(sequence, angles.dtype)
    return jnp.stack([a, matmul(first, b), matmul(first, matmul(second, c))], axis=1)


def _axes(sequence: str, dtype) -> list[Vector]:
    unit = jnp.eye(3, dtype=dtype)
    return [unit["xyz".index(letter)] for letter in sequence]


def _axis_rotations(angles: Vector, sequence: str) -> list[Matrix]:
    is_given = isinstance(sequence, str) and len(sequence) == 3 and set(sequence) <= set("xyz")
    if not is_given or sequence[1] in (sequence[0], sequence[2]):
        raise ValueError(
            f"sequence is {sequence!r}; give three of x, y, z with different neighbours, such as 'zyz' or 'zyx'"
        )
    # The exponential of angle times a unit axis keeps all derivatives finite.
    return [exp(angles[i] * axis) for i, axis in enumerate(_axes(sequence, angles.dtype))]


__all__ = [
    "Ad",
    "ad",
    "cross",
    "euler_body_jacobian",
    "euler_spatial_jacobian",
    "euler_to_matrix",
    "exp",
    "hat",
    "inverse",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "matrix_to_quat",
    "quat_conjugate",
    "quat_exp",
    "quat_log",
    "quat_multiply",
    "quat_normalize",
    "quat_rotate",
    "quat_to_matrix",
    "vee",
]

compile_each(globals())


def __dir__() -> list[str]:
    return __all__
