"""Closest points of two smooth surfaces as a function of the relative pose of their bodies.

Body B is at (R, p) in the axes of body A. The closest points x_a, x_b, with d = R x_b + p - x_a, satisfy

    r_d = T_a^T d = 0,   r_n = T_a^T R n_b = 0,

T = (f_u, f_v) the tangents and n the outward normals: four equations for a step (s_a, s_b) on both surfaces. By Newton's
method from nearby places, with H = f_uu .. the second derivatives of A's point,

    (T_a^T R T_b) s_b + (H . d - T_a^T T_a) s_a = -r_d,   (T_a^T R n_b') s_b + (H . R n_b) s_a = -r_n.

Eliminating s_b leaves two equations whose matrix is the relative curvature K_a + K_b of Montana's equations, in the chart of
A. It is positive definite where the surfaces touch in one point from outside. One step from the exact places leaves them
unchanged and has their derivatives in R and p, by the implicit function theorem: those of Montana's forward form.

Source: Montana (1988); Murray, Li & Sastry (1994), section 5.6.2; EQUATIONS section 8.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import invalidate_derivatives
from jaxdyn.constraints.rank import eps_of
from jaxdyn.contact.contact_equations import inverse_2x2, is_positive
from jaxdyn.contact.surfaces import Plane, Sphere, Surface, check_surface, geometry_at
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.numbers import as_float


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
