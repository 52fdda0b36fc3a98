"""Particles on a rod in Cartesian coordinates, with a holonomic constraint."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import array_namespace
from jaxdyn.constraints import Holonomic
from jaxdyn.model.arguments import Number
from jaxdyn.scenes._named import as_leaf, as_state, register_scene
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.scene import Scene


class _Rod(eqx.Module):
    """Constraint (|q|^2 - length^2) / 2, so that A = q^T and the tension is -lam length."""

    length: Float[Array, ""] = eqx.field(converter=as_leaf)

    def __call__(self, q, t):
        # Squares instead of |q| - l: the rows stay defined at q = 0, where |q| has no derivative.
        return 0.5 * (jnp.sum(q * q) - self.length.astype(q.dtype) ** 2)


def _particle(q, v, t, p):
    return 0.5 * p["mass"] * jnp.sum(v * v) - p["mass"] * p["gravity"] * q[-1]


def _scene(dimension: int, mass, length, gravity) -> Scene:
    system = LagrangianSystem(_particle, dimension, parameters={"mass": mass, "gravity": gravity})
    return Scene(system, (Holonomic(_Rod(length), name="rod"),))


def _plane_start(length: Number = 1.0, angle: Number = -np.pi / 2, rate: Number = 0.0) -> tuple[Array, Array]:
    s, c = array_namespace(angle).sin(angle), array_namespace(angle).cos(angle)
    # The length multiplies arrays, so that it may be traced.
    return length * as_state([s, -c]), length * rate * as_state([c, s])


@register_scene(_plane_start)
def pendulum_in_plane(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Plane pendulum in x and y (up): L = m |v|^2/2 - m g y, phi = (x^2 + y^2 - l^2)/2.

    lam = -(m/l^2)(|v|^2 - g y); the tension of the rod is -l lam. Start: `angle` from the downward vertical and `rate`;
    by default problem A01 of the IFToMM benchmark library, x = -1, at rest.

    Source: EQUATIONS section 6, with the sign of the multiplier on the right.
    """
    return _scene(2, mass, length, gravity)


def _sphere_start(
    length: Number = 1.0, theta: Number = 1.0, phi: Number = 0.0, theta_rate: Number = 0.0, phi_rate: Number = 1.0
) -> tuple[Array, Array]:
    xp = array_namespace(theta, phi)
    s, c, sp, cp = xp.sin(theta), xp.cos(theta), xp.sin(phi), xp.cos(phi)
    q = length * jnp.asarray([s * cp, s * sp, -c])
    # The derivative of the position with respect to the angles, so the velocity is on the constraint.
    along = theta_rate * jnp.asarray([c * cp, c * sp, s]) + phi_rate * s * jnp.asarray([-sp, cp, 0.0])
    return q, length * along


@register_scene(_sphere_start)
def spherical_pendulum(*, mass: Number = 1.0, length: Number = 1.0, gravity: Number = 9.81) -> Scene:
    """Spherical pendulum in x, y and z (up): L = m |v|^2/2 - m g z, phi = (|q|^2 - l^2)/2.

    lam = (m/l^2)(g z - |v|^2). Start by angles: theta from the downward vertical, phi about it.

    Source: EQUATIONS sections 1 and 7.
    """
    return _scene(3, mass, length, gravity)
