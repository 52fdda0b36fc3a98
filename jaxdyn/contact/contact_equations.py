"""Contact of two smooth surfaces: Montana's equations of its kinematics, and the closest points.

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

The closest points are a function of the relative pose of the bodies. Body B is at (R, p) in the axes of body A. The closest
points x_a, x_b, with d = R x_b + p - x_a, satisfy

    r_d = T_a^T d = 0,   r_n = T_a^T R n_b = 0,

T = (f_u, f_v) the tangents and n the outward normals: four equations for a step (s_a, s_b) on both surfaces. By Newton's
method from nearby places, with H = f_uu .. the second derivatives of A's point,

    (T_a^T R T_b) s_b + (H . d - T_a^T T_a) s_a = -r_d,   (T_a^T R n_b') s_b + (H . R n_b) s_a = -r_n.

Eliminating s_b leaves two equations whose matrix is the relative curvature K_a + K_b of Montana's equations, in the chart of
A. It is positive definite where the surfaces touch in one point from outside. One step from the exact places leaves them
unchanged and has their derivatives in R and p, by the implicit function theorem: those of Montana's forward form.

Source: Montana (1988); Murray, Li & Sastry (1994), eqs 5.28-5.32 and section 5.6.2; EQUATIONS section 8.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point, invalidate_derivatives
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.rank import eps_of
from jaxdyn.contact.surfaces import (
    Plane,
    Sphere,
    Surface,
    SurfaceGeometry,
    check_regular,
    check_surface,
    geometry_at,
    surface_geometry,
)
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Numbers, as_float


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


# --- closest points of two smooth surfaces as a function of the relative pose of their bodies ---


class Patch(NamedTuple):
    """Second-order patch of a surface about a place, for steps s (2,) in its chart: x + T s + s H s / 2 and n + dn s.

    `point` x (3,), `along` T (3, 2), `bend` H (3, 2, 2), `normal` n (3,) outward, `turn` dn (3, 2).
    """

    point: Float[Array, "3"]
    along: Float[Array, "3 2"]
    bend: Float[Array, "3 2 2"]
    normal: Float[Array, "3"]
    turn: Float[Array, "3 2"]

    def at(self, step) -> Array:
        """Point (3,) at a step, up to second order, the highest order of its derivatives in use."""
        return self.point + matmul(self.along, step) + 0.5 * matmul(matmul(self.bend, step), step)

    def normal_at(self, step) -> Array:
        """Normal (3,) at a step, up to first order."""
        return self.normal + matmul(self.turn, step)


class Steps(NamedTuple):
    """Newton steps (2,) on the surfaces of A and B, in charts about the given places, and their validity.

    Where `is_strict` () is false the steps are zero. `residual` () is the distance along the tangent
    plane, m, or the angle between the normals, rad, whichever is larger.
    """

    on_a: Float[Array, "2"]
    on_b: Float[Array, "2"]
    is_strict: Bool[Array, ""]
    residual: Float[Array, ""]


def patch_at(surface: Surface, place) -> Patch:
    """Patch of a surface about a place."""

    def point(step):
        return surface.point_at(surface.displace(place, step))

    zero = jnp.zeros((2,), place.dtype)
    # On a sphere or an ellipsoid this chart is about the place itself, so that no singularity of (u, v) is met.
    along, bend = jax.jacfwd(point)(zero), jax.jacfwd(jax.jacfwd(point))(zero)
    (u, v), (bend_u, bend_v) = along.T, (bend[:, 0], bend[:, 1])
    across = cross(u, v)
    square = jnp.sum(across * across)
    length = jnp.sqrt(jnp.where(square > 0, square, jnp.ones_like(square)))
    normal = across / length
    # Derivative of a unit vector: the part of the cross product's derivative along the normal drops out.
    turns = [cross(bend_u[:, i], v) + cross(u, bend_v[:, i]) for i in range(2)]
    turn = jnp.stack([(turn - jnp.sum(normal * turn) * normal) / length for turn in turns], 1)
    return Patch(surface.point_at(place), along, bend, normal, turn)


def newton_steps(a: Patch, b: Patch, R, p) -> Steps:
    """Take one step of Newton's method towards the closest points."""
    d, n = matmul(R, b.point) + p - a.point, matmul(R, b.normal)
    bend = jnp.moveaxis(a.bend, 0, -1)
    r_d, r_n = matmul(d, a.along), matmul(n, a.along)
    seen = matmul(a.along.T, R)
    d_b, d_a = matmul(seen, b.along), matmul(bend, d) - matmul(a.along.T, a.along)
    size = jnp.sum(d_b * d_b)
    determinant = d_b[0, 0] * d_b[1, 1] - d_b[0, 1] * d_b[1, 0]
    # Opposed normals, and two regular charts.
    is_regular = (jnp.sum(a.normal * n) < 0) & (jnp.abs(determinant) > 1e-6 * size)
    # Eliminating the step on B leaves a 2x2 system for the step on A, whose matrix is the relative curvature.
    back = inverse_2x2(d_b, is_regular)
    n_over_d = matmul(matmul(seen, b.turn), back)
    relative = matmul(bend, n) - matmul(n_over_d, d_a)
    # Away from the closest points the matrix is not symmetric; its symmetric part decides.
    is_strict = is_regular & is_positive(0.5 * (relative + relative.T))
    on_a = matmul(inverse_2x2(relative, is_strict), matmul(n_over_d, r_d) - r_n)
    on_b = matmul(back, -r_d - matmul(d_a, on_a))
    # Where the step is undefined the places remain, and `is_strict` reports it.
    on_a, on_b = (jnp.where(is_strict, x, jnp.zeros_like(x)) for x in (on_a, on_b))
    unit = jnp.max(jnp.sum(a.along * a.along, 0))
    residual = jnp.maximum(jnp.max(jnp.abs(r_d)), jnp.max(jnp.abs(r_n))) / jnp.sqrt(
        jnp.where(unit > 0, unit, jnp.ones_like(unit))
    )
    return Steps(on_a, on_b, is_strict, residual)


# Newton steps without derivatives, and with them: two of these give exact derivatives up to the third order.
_ROUNDS, _DIFFERENTIATED = 12, 2


def contact_coordinates(surface_o: Surface, surface_f: Surface, pose: Numbers) -> Float[Array, "5"]:
    """Contact coordinates eta (5,) of the closest points of two surfaces.

    Touching surfaces are in contact there. For others these are the points with opposite normals on one line, and
    `relative_pose(surface_o, surface_f, eta)` is the given pose translated along that line. Both charts must have a
    frame there, and the surfaces one such pair of points (`ContactKinematics.strict`).

    **Arguments:**

    - `surface_o`, `surface_f`: of the object and of the finger, each in its body's frame, with outward normals.
    - `pose` (4, 4): of the finger's frame in the object's, m.

    **Returns:** eta = (u_o, v_o, u_f, v_f, psi) (5,), in the units of the charts and rad; differentiable three times. NaN where
    the search for the closest points did not converge, or found no such pair.

    **Raises:** ValueError for an invalid surface, a pose of another shape, two planes, and a `Parametrised` surface, whose
    closest points are not known.

    ```python
    ball, tip = jd.contact.Sphere(0.1), jd.contact.Sphere(0.02)
    pose = jd.contact.relative_pose(ball, tip, jnp.array([0.1, 0.2, 0.3, 0.4, 0.5]))
    eta = jd.contact.contact_coordinates(ball, tip, pose)
    ```

    Source: Murray, Li & Sastry (1994), section 5.6.2; EQUATIONS section 8.
    """
    pose = as_float(pose, "pose", (4, 4))
    for surface in (surface_o, surface_f):
        check_surface(surface)
    if isinstance(surface_o, Plane) and isinstance(surface_f, Plane):
        raise ValueError("surface_o and surface_f are both planes, which do not touch in one point")
    R, p = pose[:3, :3], pose[:3, 3]
    # Initial points: opposite to a plane's normal, for others along the line of the frames' origins.
    place_o = surface_o.toward(-R[:, 2] if isinstance(surface_f, Plane) else p)
    # R e_z is the normal of the finger's plane in the object's axes, R^T e_z that of the object's plane in the finger's.
    place_f = surface_f.toward(-R[2] if isinstance(surface_o, Plane) else -matmul(p, R))
    if place_o is None or place_f is None:
        which = surface_o if place_o is None else surface_f
        raise ValueError(
            f"surface {type(which).__name__} does not give its closest point to another point; use a Sphere, Ellipsoid, "
            "Plane or Cylinder"
        )
    is_found = jnp.asarray(True)
    if not all(isinstance(surface, Sphere | Plane) for surface in (surface_o, surface_f)):
        place_o, place_f, is_found = _by_newton(surface_o, surface_f, R, p, (place_o, place_f))
    elif isinstance(surface_o, Sphere) and isinstance(surface_f, Sphere):
        # Every point of concentric spheres is as close as any other.
        is_found = (p != 0).any()
    at_o, at_f = surface_o.coordinates_at(place_o), surface_f.coordinates_at(place_f)
    frame_o, frame_f = geometry_at(surface_o, at_o).frame, geometry_at(surface_f, at_f).frame
    # R_psi = [cos psi, -sin psi; -sin psi, -cos psi]: its first row gives psi.
    turn = matmul(frame_o.T, matmul(R, frame_f))
    eta = jnp.concatenate([at_o, at_f, jnp.arctan2(-turn[0, 1], turn[0, 0])[None]])
    eta = jnp.where(is_found, eta, jnp.full_like(eta, jnp.nan))
    return invalidate_derivatives(eta, ~is_found, (surface_o, surface_f, pose))


def _by_newton(surface_o: Surface, surface_f: Surface, R, p, places):
    """Places of the closest points, and whether they were found."""

    def step(R, p, places):
        steps = newton_steps(patch_at(surface_o, places[0]), patch_at(surface_f, places[1]), R, p)
        return surface_o.displace(places[0], steps.on_a), surface_f.displace(places[1], steps.on_b)

    # Converged points are constants for differentiation; the last steps restore their derivatives (implicit function
    # theorem).
    constants = lax.stop_gradient((R, p))
    places = lax.fori_loop(0, _ROUNDS, lambda _, places: step(*constants, places), lax.stop_gradient(places))
    for _ in range(_DIFFERENTIATED - 1):
        places = step(R, p, places)
    last = newton_steps(patch_at(surface_o, places[0]), patch_at(surface_f, places[1]), R, p)
    # The last step of a search that has converged is rounding. Steps are zero, too, where the normals do not face each other or
    # the relative curvature is not positive.
    size = jnp.max(jnp.abs(jnp.concatenate(lax.stop_gradient((last.on_a, last.on_b)))))
    is_found = last.is_strict & (size <= eps_of(p) ** 0.6 * (1 + jnp.max(jnp.abs(lax.stop_gradient(p)))))
    return surface_o.displace(places[0], last.on_a), surface_f.displace(places[1], last.on_b), is_found
