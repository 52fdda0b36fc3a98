"""Inertial parameters of a body: ten numbers, the spatial inertia, the pseudo-inertia and its log-Cholesky factor.

The ten numbers are (m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) about the body frame's origin and in its axes
(the order of Pinocchio's regressors): dynamics is linear in them.

All functions raise ValueError for an argument of another shape, with the expected shapes.
"""

import jax.numpy as jnp
import numpy as np
from jax import dtypes as _dtypes
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.compile.known import array_namespace
from jaxdyn.lie import so3
from jaxdyn.model import host_math
from jaxdyn.model.arguments import Checked, Number, Numbers, Row, as_static
from jaxdyn.model.host_math import SYMMETRIC, TRIANGLE


def _check_shapes(**given) -> None:
    """Refuse arguments whose shapes differ from the expected ones, given with them by name."""
    for name, (value, want) in given.items():
        # Rows may be tuples of traced numbers, whose shape numpy cannot ask for.
        shape = np.shape(array_namespace(value).asarray(value))
        if shape != want:
            shapes = ", ".join(f"{other} {size}" for other, (_, size) in given.items())
            raise ValueError(f"{name} has shape {shape}, expected {shapes}")


def rotational_inertia(parameters: Checked[Float[Array, "10"]]) -> Float[Array, "3 3"]:
    """Rotational inertia (3, 3) about the frame's origin (kg m^2) from the ten inertial parameters."""
    _check_shapes(parameters=(parameters, (10,)))
    return parameters[4:][SYMMETRIC]


def spatial_inertia(parameters: Checked[Float[Array, "10"]]) -> Float[Array, "6 6"]:
    r"""Spatial inertia (6, 6), linear part first (EQUATIONS section 0).

    $$M = \begin{bmatrix} m 1 & -m \hat c \\ m \hat c & I \end{bmatrix}$$
    """
    _check_shapes(parameters=(parameters, (10,)))
    first = so3.hat(parameters[1:4])
    mass = parameters[0] * jnp.eye(3, dtype=parameters.dtype)
    return jnp.block([[mass, -first], [first, rotational_inertia(parameters)]])


def parameters_from_spatial(matrix: Checked[Float[Array, "6 6"]]) -> Float[Array, "10"]:
    """Ten inertial parameters of a spatial inertia (6, 6); inverse of `spatial_inertia`."""
    _check_shapes(matrix=(matrix, (6, 6)))
    return jnp.concatenate([matrix[:1, 0], so3.vee(matrix[3:, :3]), matrix[3:, 3:][TRIANGLE]])


def inertial_parameters(mass: Number, com: Numbers, inertia_com: Numbers) -> Float[Array, "10"]:
    r"""Ten inertial parameters from mass (kg), centre of mass (3,) (m) and rotational inertia (3, 3) about it (kg m^2).

    Steiner's theorem: $I_\mathrm{origin} = I_\mathrm{com} - m \hat c^2$.
    """
    _check_shapes(mass=(mass, ()), com=(com, (3,)), inertia_com=(inertia_com, (3, 3)))
    com, inertia_com = jnp.asarray(com), jnp.asarray(inertia_com)
    # One dtype for all ten numbers: that of the centre of mass.
    mass = jnp.asarray(mass, com.dtype)
    outer = com[:, None] * com[None, :]
    about_origin = inertia_com + mass * (jnp.sum(com**2) * jnp.eye(3, dtype=com.dtype) - outer)
    return jnp.concatenate([mass[None], mass * com, about_origin[TRIANGLE]])


def mass_com_inertia(
    parameters: Checked[Float[Array, "10"]],
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Mass (), centre of mass (3,) and rotational inertia about it (3, 3). A massless body has its centre at the origin."""
    _check_shapes(parameters=(parameters, (10,)))
    mass, first = parameters[0], parameters[1:4]
    # Double where: the unselected quotient must be finite, or its derivative is NaN.
    massless = mass == 0
    com = jnp.where(massless, jnp.zeros_like(first), first / jnp.where(massless, jnp.ones_like(mass), mass))
    outer = com[:, None] * first[None, :]
    shift = jnp.sum(com * first) * jnp.eye(3, dtype=parameters.dtype) - outer
    return mass, com, rotational_inertia(parameters) - shift


def transform_inertia(
    pose: Checked[Float[Array, "4 4"]], parameters: Checked[Float[Array, "10"]]
) -> Float[Array, "10"]:
    """Ten inertial parameters (10,) in frame a of a body given in frame b; `pose` T_ab (4, 4) maps b coordinates to a.

    No mass is divided by, so massless bodies are allowed and gradients stay finite.

    **Raises:** ValueError for other shapes, such as those of swapped arguments.
    """
    _check_shapes(pose=(pose, (4, 4)), parameters=(parameters, (10,)))
    rotation, shift = pose[:3, :3], pose[:3, 3]
    mass = parameters[0]
    first = rotation @ parameters[1:4]
    inertia = rotation @ rotational_inertia(parameters) @ rotation.T
    # About a point displaced by p: I + (2 p.h + m p.p) 1 - (p h^T + h p^T + m p p^T), h = rotated first moment.
    ph = shift[:, None] * first[None, :]
    scale = 2 * jnp.sum(shift * first) + mass * jnp.sum(shift * shift)
    inertia = inertia + scale * jnp.eye(3, dtype=pose.dtype) - ph - ph.T - mass * shift[:, None] * shift[None, :]
    return jnp.concatenate([mass[None], first + mass * shift, inertia[TRIANGLE]])


def pseudo_inertia(parameters: Checked[Float[Array, "10"]]) -> Float[Array, "4 4"]:
    r"""Pseudo-inertia (4, 4) of ten inertial parameters.

    $$\begin{bmatrix} \Sigma & m c \\ m c^T & m \end{bmatrix}, \quad \Sigma = \tfrac12 \operatorname{tr}(I) 1 - I$$

    The parameters belong to a physical body if and only if this matrix is positive definite (Wensing, Kim & Slotine 2018,
    eq. 7; a positive semidefinite one is the limit of point, line and plane bodies).
    """
    _check_shapes(parameters=(parameters, (10,)))
    inertia = rotational_inertia(parameters)
    sigma = 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=parameters.dtype) - inertia
    first = parameters[1:4]
    return jnp.block([[sigma, first[:, None]], [first[None, :], parameters[:1, None]]])


def parameters_from_pseudo(matrix: Checked[Float[Array, "4 4"]]) -> Float[Array, "10"]:
    r"""Ten inertial parameters of a pseudo-inertia (4, 4); inverse of `pseudo_inertia`.

    $$I = \operatorname{tr}(\Sigma) 1 - \Sigma$$
    """
    _check_shapes(matrix=(matrix, (4, 4)))
    sigma = matrix[:3, :3]
    inertia = jnp.trace(sigma) * jnp.eye(3, dtype=matrix.dtype) - sigma
    return jnp.concatenate([matrix[3:, 3], matrix[:3, 3], inertia[TRIANGLE]])


def log_cholesky_factor(theta: Checked[Float[Array, "10"]]) -> Float[Array, "4 4"]:
    r"""Upper-triangular factor U (4, 4) of the pseudo-inertia, from ten unconstrained numbers.

    $$U = e^\alpha \begin{bmatrix} e^{d_1} & s_{12} & s_{13} & t_1 \\ 0 & e^{d_2} & s_{23} & t_2 \\
    0 & 0 & e^{d_3} & t_3 \\ 0 & 0 & 0 & 1 \end{bmatrix}, \quad \text{pseudo-inertia} = U U^T$$

    theta = (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3) (Rucker & Wensing 2022, eq. 16). U is the affine map (stretch, shear,
    shift; the mass is $e^{2 \alpha}$) of a reference body of unit pseudo-inertia to the body, the identity at theta = 0.
    """
    _check_shapes(theta=(theta, (10,)))
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = theta
    zero, one = jnp.zeros_like(alpha), jnp.ones_like(alpha)
    rows = [jnp.exp(d1), s12, s13, t1, zero, jnp.exp(d2), s23, t2, zero, zero, jnp.exp(d3), t3, zero, zero, zero, one]
    return jnp.exp(alpha) * jnp.stack(rows).reshape(4, 4)


def from_log_cholesky(theta: Checked[Float[Array, "10"]]) -> Float[Array, "10"]:
    """Physically feasible parameters from ten unconstrained numbers (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3).

    The pseudo-inertia is $U U^T$ with U of `log_cholesky_factor` (Rucker & Wensing 2022, eq. 16). Every theta gives a feasible
    body and every strictly feasible body has exactly one theta, so nothing infeasible can be represented.
    """
    upper = log_cholesky_factor(theta)
    return parameters_from_pseudo(upper @ upper.T)


def to_log_cholesky(parameters: Checked[Float[Array, "10"]]) -> Float[Array, "10"]:
    """Log-Cholesky coordinates (10,) of ten inertial parameters (10,): the inverse of `from_log_cholesky`.

    NaN when the parameters are not strictly feasible (see `is_feasible`).
    """
    _check_shapes(parameters=(parameters, (10,)))
    return _to_log_cholesky(None, parameters)


# A kernel: LAPACK under XLA may wait for ever in a batch of bodies (`jaxdyn.systems.mass_factor`).
@kernel
def _to_log_cholesky(_, parameters):
    matrix = pseudo_inertia(parameters)
    # U U^T with U upper triangular is the Cholesky factorisation of the matrix with rows and columns reversed.
    upper = jnp.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]
    # U = exp(alpha) * unit triangular factor with last entry 1; dividing by it separates mass from shape.
    alpha = jnp.log(upper[3, 3])
    unit = upper / upper[3, 3]
    diagonal = jnp.log(jnp.stack([unit[0, 0], unit[1, 1], unit[2, 2]]))
    off = jnp.stack([unit[0, 1], unit[1, 2], unit[0, 2]])
    return jnp.concatenate([alpha[None], diagonal, off, unit[:3, 3]])


def is_feasible(parameters: Numbers, *, tolerance: float = 0.0) -> bool:
    """Decide whether concrete parameters (10,) belong to a physical body: pseudo-inertia positive semidefinite.

    `tolerance` is relative to its largest eigenvalue.

    **Raises:** ValueError for a tolerance that is negative or no number.
    """
    tolerance = as_static(tolerance, "tolerance", 0, np.inf, "zero or a positive number")
    parameters = np.asarray(parameters, np.float64)
    if not np.isfinite(parameters).all():
        return False
    values = np.linalg.eigvalsh(host_math.pseudo_inertia(parameters))
    # A matrix without a positive eigenvalue gives no scale for the tolerance.
    return bool(values[0] >= -tolerance * max(values[-1], 0.0))


def nearest_feasible(parameters: Numbers, *, floor: float = 1e-6) -> np.ndarray:
    """Feasible parameters close to infeasible ones: pseudo-inertia eigenvalues raised to `floor` times the largest.

    **Raises:** ValueError when the mass is not positive, because then there is no body to repair, for NaN or infinity, and
    for a floor outside [0, 1).
    """
    parameters = np.asarray(parameters, np.float64)
    if not np.isfinite(parameters).all():
        raise ValueError(f"parameters is {parameters.tolist()}, cannot be repaired; give finite numbers")
    if not parameters[0] > 0:
        raise ValueError(f"mass is {parameters[0]}, cannot be repaired; give the body a positive mass")
    values, vectors = np.linalg.eigh(host_math.pseudo_inertia(parameters))
    # Raising eigenvalues changes the trace, and with it the mass; the scaling below restores the given mass.
    values = np.maximum(values, as_static(floor, "floor", 0, 1, "a number from 0 to 1") * values[-1])
    repaired = (vectors * values) @ vectors.T
    repaired *= parameters[0] / repaired[3, 3]
    return host_math.parameters_from_pseudo(repaired).astype(_dtypes.canonicalize_dtype(float))


# Bodies of simple shapes. Traced numbers give arrays of jax, known ones arrays of numpy in float64.


def box(mass: Number, size: Row) -> Array | np.ndarray:
    """Inertial parameters (10,) of a uniform box with edges `size` (3,) (m) about its centre (EQUATIONS section 1)."""
    x, y, z = (mass / 12 * edge**2 for edge in size)
    return _from_moments(mass, (y + z, x + z, x + y))


def sphere(mass: Number, radius: Number) -> Array | np.ndarray:
    """Inertial parameters (10,) of a uniform solid ball about its centre; kg, m."""
    return _from_moments(mass, (0.4 * mass * radius**2,) * 3)


def ellipsoid(mass: Number, semi_axes: Row) -> Array | np.ndarray:
    """Inertial parameters (10,) of a solid ellipsoid about its centre; `semi_axes` (3,) along x, y, z in m."""
    x, y, z = (0.2 * mass * axis**2 for axis in semi_axes)
    return _from_moments(mass, (y + z, x + z, x + y))


def cylinder(mass: Number, radius: Number, length: Number) -> Array | np.ndarray:
    """Inertial parameters (10,) of a uniform solid cylinder along z about its centre, a disk for length 0; kg, m."""
    across = mass * (3 * radius**2 + length**2) / 12
    return _from_moments(mass, (across, across, 0.5 * mass * radius**2))


def rod(mass: Number, length: Number, axis: str = "x") -> Array | np.ndarray:
    """Inertial parameters (10,) of a uniform thin rod along an axis, "x", "y" or "z", about its centre; kg, m."""
    if not isinstance(axis, str) or axis not in tuple("xyz"):
        raise ValueError(f"axis is {axis!r}; give 'x', 'y' or 'z'")
    along = "xyz".index(axis)
    return _from_moments(mass, [0.0 if i == along else mass * length**2 / 12 for i in range(3)])


def point_mass(mass: Number, position: Numbers = (0.0, 0.0, 0.0)) -> Array | np.ndarray:
    """Inertial parameters (10,) of a point mass (kg) at a position (3,) in the body frame (m)."""
    return displaced(_from_moments(mass, (0.0, 0.0, 0.0)), position)


def displaced(parameters: Numbers, position: Numbers, rotation: Numbers | None = None) -> Array | np.ndarray:
    """Parameters (10,) of the same body placed at `position` (3,), rotated by `rotation` (3, 3), in a new frame."""
    rotation = np.eye(3) if rotation is None else rotation
    _check_shapes(parameters=(parameters, (10,)), position=(position, (3,)), rotation=(rotation, (3, 3)))
    pose = host_math.pose_of(rotation, position)
    return host_math.move_inertia(pose, array_namespace(parameters).asarray(parameters, float))


def _from_moments(mass, moments) -> Array | np.ndarray:
    xp = array_namespace(mass, moments)
    return xp.asarray([mass, 0.0, 0.0, 0.0, moments[0], 0.0, moments[1], 0.0, 0.0, moments[2]], float)


__all__ = [
    "box",
    "cylinder",
    "displaced",
    "ellipsoid",
    "from_log_cholesky",
    "inertial_parameters",
    "is_feasible",
    "log_cholesky_factor",
    "mass_com_inertia",
    "nearest_feasible",
    "parameters_from_pseudo",
    "parameters_from_spatial",
    "point_mass",
    "pseudo_inertia",
    "rod",
    "rotational_inertia",
    "spatial_inertia",
    "sphere",
    "to_log_cholesky",
    "transform_inertia",
]


def __dir__() -> list[str]:
    return __all__
