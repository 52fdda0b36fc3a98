"""Where two smooth surfaces touch, as a function of how their bodies lie to each other.

Body B is at (R, p) in the axes of body A. The points x_a, x_b next to each other, d = R x_b + p - x_a, are those with

    r_d = T_a^T d = 0,   r_n = T_a^T R n_b = 0,

T = (f_u, f_v) the tangents and n the outward normals: four equations for a step (s_a, s_b) on both surfaces. By Newton's
method from places nearby, with H = f_uu .. the second derivatives of A's point,

    (T_a^T R T_b) s_b + (H . d - T_a^T T_a) s_a = -r_d,   (T_a^T R n_b') s_b + (H . R n_b) s_a = -r_n.

Without s_b there remain two equations whose matrix is the relative curvature K_a + K_b of Montana's equations, in the chart of
A. It is positive definite where the surfaces touch in one point from outside. One step from the right places leaves them as
they are and has their derivatives in R and p, by the implicit function theorem: those of Montana's forward form.

Source: Montana (1988); Murray, Li & Sastry (1994), section 5.6.2; EQUATIONS section 8.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdyn.contact.montana import inverse_2x2, is_positive
from jaxdyn.contact.surfaces import Surface
from jaxdyn.lie.so3 import _product, cross


class Patch(NamedTuple):
    """A surface about a place, for steps s (2,) in the chart there: x + T s + s H s / 2 and n + dn s.

    `point` x (3,), `along` T (3, 2), `bend` H (3, 2, 2), `normal` n (3,) outward, `turn` dn (3, 2).
    """

    point: Float[Array, "3"]
    along: Float[Array, "3 2"]
    bend: Float[Array, "3 2 2"]
    normal: Float[Array, "3"]
    turn: Float[Array, "3 2"]

    def at(self, step) -> Array:
        """The point (3,) at a step, up to second order, which is as far as it is differentiated."""
        return self.point + _product(self.along, step) + 0.5 * _product(_product(self.bend, step), step)

    def normal_at(self, step) -> Array:
        """The normal (3,) at a step, up to first order."""
        return self.normal + _product(self.turn, step)


class Steps(NamedTuple):
    """Steps (2,) on the surfaces of A and B, in their charts about the given places; whether they have one point of contact.

    Where `is_strict` () is false the steps are zero. `left` () is by how much the conditions fail: the distance along the tangent
    plane, m, or the angle between the normals, rad, whichever is larger.
    """

    on_a: Float[Array, "2"]
    on_b: Float[Array, "2"]
    is_strict: Bool[Array, ""]
    left: Float[Array, ""]


def patch_at(surface: Surface, place) -> Patch:
    """The surface about a place."""

    def point(step):
        return surface.point_at(surface.moved(place, step))

    zero = jnp.zeros((2,), place.dtype)
    along, bend = jax.jacfwd(point)(zero), jax.jacfwd(jax.jacfwd(point))(zero)
    (u, v), (bend_u, bend_v) = along.T, (bend[:, 0], bend[:, 1])
    across = cross(u, v)
    square = jnp.sum(across * across)
    length = jnp.sqrt(jnp.where(square > 0, square, jnp.ones_like(square)))
    normal = across / length
    turns = [cross(bend_u[:, i], v) + cross(u, bend_v[:, i]) for i in range(2)]
    turn = jnp.stack([(turn - jnp.sum(normal * turn) * normal) / length for turn in turns], 1)
    return Patch(surface.point_at(place), along, bend, normal, turn)


def newton_steps(a: Patch, b: Patch, R, p) -> Steps:
    """One step of Newton's method toward the points next to each other."""
    d, n = _product(R, b.point) + p - a.point, _product(R, b.normal)
    bend = jnp.moveaxis(a.bend, 0, -1)
    r_d, r_n = _product(d, a.along), _product(n, a.along)
    seen = _product(a.along.T, R)
    d_b, d_a = _product(seen, b.along), _product(bend, d) - _product(a.along.T, a.along)
    size = jnp.sum(d_b * d_b)
    determinant = d_b[0, 0] * d_b[1, 1] - d_b[0, 1] * d_b[1, 0]
    # Normals that face each other, and two charts that have not ended.
    is_regular = (jnp.sum(a.normal * n) < 0) & (jnp.abs(determinant) > 1e-6 * size)
    back = inverse_2x2(d_b, is_regular)
    n_over_d = _product(_product(seen, b.turn), back)
    relative = _product(bend, n) - _product(n_over_d, d_a)
    is_strict = is_regular & is_positive(0.5 * (relative + relative.T))
    on_a = _product(inverse_2x2(relative, is_strict), _product(n_over_d, r_d) - r_n)
    on_b = _product(back, -r_d - _product(d_a, on_a))
    on_a, on_b = (jnp.where(is_strict, x, jnp.zeros_like(x)) for x in (on_a, on_b))
    unit = jnp.max(jnp.sum(a.along * a.along, 0))
    left = jnp.maximum(jnp.max(jnp.abs(r_d)), jnp.max(jnp.abs(r_n))) / jnp.sqrt(
        jnp.where(unit > 0, unit, jnp.ones_like(unit))
    )
    return Steps(on_a, on_b, is_strict, left)
