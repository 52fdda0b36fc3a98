"""Montana's equations of contact: kinematics of a contact point on two surfaces in contact.

Contact coordinates eta = (u_o, v_o, u_f, v_f, psi): the position of the contact on the object's and on the finger's surface, and
the angle from one Gauss frame to the other. Frames C_o, C_f are the Gauss frames there, with normals opposite to each other:

    R_{co,cf} = [R_psi 0; 0 -1],   R_psi = [cos psi, -sin psi; -sin psi, -cos psi],
    g_of = g_oCo(alpha_o) g_psi g_fCf(alpha_f)^-1.

L_o and L_f are fixed in the bodies and coincide with C_o and C_f now. V_c = (vx, vy, vz, wx, wy, wz) is the body twist of L_f
relative to L_o; contact is vz = 0, and then, with R_o = [0 -1; 1 0],

    V_c = J_c eta_dot,   J_c = [ R_psi M_o,       -M_f,         0;
                                 0,                0,           0;
                                 R_psi R_o K_o M_o, -R_o K_f M_f, 0;
                                 -T_o M_o,        -T_f M_f,     1 ].

Source: Montana (1988); Murray, Li & Sastry (1994), eqs 5.28-5.32; EQUATIONS section 8.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete
from jaxdyn.contact.surfaces import (
    Surface,
    SurfaceGeometry,
    check_regular,
    check_surface,
    geometry_at,
    surface_geometry,
)
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.numbers import as_float


class ContactKinematics(eqx.Module):
    r"""Kinematics of one contact at eta (see `montana`).

    - `J_c` (6, 5): $V_c = J_c \dot\eta$, twists of the finger relative to the object in the axes of C_f, at the contact.
    - `forward` (5, 6): $\dot\eta = \mathrm{forward}\, V_c$ where $v_z = 0$; its column of $v_z$ is zero, and it is a left
      inverse of $J_c$.
    - `J_F` (6, 5): $V_{of} = J_F \dot\eta$, body twist of the finger's frame relative to the object's, in the finger's axes.
    - `relative_curvature` (2, 2): $K_f + R_\psi K_o R_\psi$, 1/m. `strict` (): true where it is invertible and the surfaces are
      outside each other (both eigenvalues positive); where not, `forward` is finite without meaning.
    - `g_of` (4, 4): pose of the finger's frame in the object's. `object`, `finger`: `SurfaceGeometry` of the surfaces.
    """

    J_c: Float[Array, "6 5"]
    forward: Float[Array, "5 6"]
    J_F: Float[Array, "6 5"]
    relative_curvature: Float[Array, "2 2"]
    strict: Bool[Array, ""]
    g_of: Float[Array, "4 4"]
    object: SurfaceGeometry
    finger: SurfaceGeometry

    @property
    def rolling(self) -> Float[Array, "5 2"]:
        """Matrix that maps (wx, wy) to the rates of contact coordinates without slip and spin."""
        return self.forward[:, 3:5]


def _turn(psi):
    # Symmetric and its own inverse, with determinant -1: with the normal reversed it is a rotation in space.
    c, s = jnp.cos(psi), jnp.sin(psi)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([-s, -c])])


def _as_eta(eta) -> Float[Array, "5"]:
    return as_float(eta, "eta", (5,))


def relative_pose(surface_o: Surface, surface_f: Surface, eta: Numbers) -> Float[Array, "4 4"]:
    """Pose g_of (4, 4) of the finger's body frame in the object's when the surfaces touch at eta.

    **Arguments:** as of `montana`. **Raises:** as `montana`. Source: EQUATIONS section 8.
    """
    eta = _as_eta(eta)
    geometry_o, geometry_f = surface_geometry(surface_o, eta[:2]), surface_geometry(surface_f, eta[2:4])
    return _pose(geometry_o, geometry_f, eta[4])


def _pose(geometry_o, geometry_f, psi):
    turn = jnp.zeros((4, 4), psi.dtype).at[:2, :2].set(_turn(psi)).at[2, 2].set(-1).at[3, 3].set(1)
    return matmul(matmul(geometry_o.pose, turn), se3.inverse(geometry_f.pose))


def montana(surface_o: Surface, surface_f: Surface, eta: Numbers) -> ContactKinematics:
    r"""Montana's equations of contact at eta: J_c, its inverse on vz = 0, and related quantities.

    The forward form is, with $\tilde K = R_\psi K_o R_\psi$,

    $$\begin{aligned}
    \dot\alpha_f &= M_f^{-1} (K_f + \tilde K)^{-1} ((-\omega_y, \omega_x) - \tilde K (v_x, v_y)), \\
    \dot\alpha_o &= M_o^{-1} R_\psi (K_f + \tilde K)^{-1} ((-\omega_y, \omega_x) + K_f (v_x, v_y)), \\
    \dot\psi &= \omega_z + T_f M_f \dot\alpha_f + T_o M_o \dot\alpha_o.
    \end{aligned}$$

    **Arguments:**

    - `surface_o`, `surface_f`: of the object and of the finger, each in its body's frame, with outward normals.
    - `eta` (5,): (u_o, v_o, u_f, v_f, psi), in the units of the charts, and rad.

    **Returns:** `ContactKinematics`, differentiable in eta and in the surfaces.

    **Raises:** ValueError for an invalid surface, eta of another shape, coordinates at which a chart ends, and surfaces that
    penetrate each other or whose relative curvature is singular (two planes), when this is known.

    ```python
    ball, tip = jd.contact.Sphere(0.1), jd.contact.Sphere(0.02)
    jd.contact.montana(ball, tip, jnp.array([0.1, 0.2, 0.3, 0.4, 0.5])).J_c
    ```

    Source: Montana (1988); Murray, Li & Sastry (1994), eqs 5.28-5.32; EQUATIONS section 8.
    """
    eta = _as_eta(eta)
    for surface in (surface_o, surface_f):
        check_surface(surface)
    kinematics = _montana(surface_o, surface_f, eta)
    check_regular(surface_o, eta[:2], kinematics.object)
    check_regular(surface_f, eta[2:4], kinematics.finger)
    if is_concrete(kinematics.strict) and not bool(kinematics.strict):
        raise ValueError(
            f"eta is {np.asarray(eta).tolist()}, where the relative curvature "
            f"{np.asarray(kinematics.relative_curvature).tolist()} is not positive definite; the surfaces do not touch in "
            "one point from outside, choose more convex ones or another point"
        )
    return kinematics


@entry_point
def _montana(surface_o, surface_f, eta) -> ContactKinematics:
    o, f = geometry_at(surface_o, eta[:2]), geometry_at(surface_f, eta[2:4])
    turn = _turn(eta[4])
    # R_o of the equations, a constant, so that the kernel drops its zeros.
    quarter = jnp.asarray(np.array([[0.0, -1.0], [1.0, 0.0]]), eta.dtype)
    none = jnp.zeros((2, 1), eta.dtype)
    moved_o, moved_f = o.metric, f.metric
    top = jnp.concatenate([matmul(turn, moved_o), -moved_f, none], 1)
    turning_o = matmul(turn, matmul(quarter, matmul(o.curvature, moved_o)))
    turning_f = matmul(quarter, matmul(f.curvature, moved_f))
    spin = jnp.concatenate([-matmul(o.torsion, moved_o), -matmul(f.torsion, moved_f), jnp.ones((1,), eta.dtype)])
    middle = jnp.concatenate([turning_o, -turning_f, none], 1)
    J_c = jnp.concatenate([top, jnp.zeros((1, 5), eta.dtype), middle, spin[None]])

    # The curvature of the object in the axes of the finger; R_psi is symmetric, so that no transpose is needed.
    seen = matmul(turn, matmul(o.curvature, turn))
    relative = f.curvature + seen
    strict = is_positive(relative)
    flexibility = inverse_2x2(relative, strict)
    # Constant 0/1 matrices, so that the kernel drops the zero products.
    # Columns (vx, vy, vz, wx, wy, wz) of (-wy, wx) and of (vx, vy).
    rolled = jnp.asarray(np.array([[0, 0, 0, 0, -1, 0], [0, 0, 0, 1, 0, 0]]), eta.dtype)
    slid = jnp.asarray(np.array([[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0]]), eta.dtype)
    along_f = matmul(flexibility, rolled - matmul(seen, slid))
    along_o = matmul(turn, matmul(flexibility, rolled + matmul(f.curvature, slid)))
    spun = (
        jnp.asarray(np.array([0, 0, 0, 0, 0, 1]), eta.dtype) + matmul(f.torsion, along_f) + matmul(o.torsion, along_o)
    )
    forward = jnp.concatenate(
        [
            matmul(inverse_2x2(o.metric, o.regular), along_o),
            matmul(inverse_2x2(f.metric, f.regular), along_f),
            spun[None],
        ]
    )
    return ContactKinematics(
        J_c=J_c,
        forward=forward,
        J_F=matmul(se3.Ad(f.pose), J_c),
        relative_curvature=relative,
        strict=strict & o.regular & f.regular,
        g_of=_pose(o, f, eta[4]),
        object=o,
        finger=f,
    )


def is_positive(matrix) -> Any:
    """Decide whether a symmetric (2, 2) matrix is positive definite beyond rounding."""
    trace, size = matrix[0, 0] + matrix[1, 1], jnp.sum(matrix * matrix)
    # Compared with the squares of the entries, the size of the products that cancel in it.
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    return (trace > 0) & (determinant > 1e2 * float(jnp.finfo(matrix.dtype).eps) * size)


def inverse_2x2(matrix, fine):
    """Inverse (2, 2) in closed form, finite where it is not `fine`."""
    a, b, c, d = matrix[0, 0], matrix[0, 1], matrix[1, 0], matrix[1, 1]
    determinant = a * d - b * c
    # 1 in place of a singular determinant keeps the branch that `where` does not select free of NaN, in derivatives too.
    determinant = jnp.where(fine & (determinant != 0), determinant, jnp.ones_like(determinant))
    return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / determinant
