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
from jaxtyping import Array, Bool, Float

from jaxdyn.contact.contact_equations import inverse_2x2, is_positive
from jaxdyn.contact.surfaces import Surface
from jaxdyn.lie.so3 import cross, matmul


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
