"""Linearisation of constrained motions by automatic differentiation: shared by the tests of steady motions."""

import jax
import jax.numpy as jnp

import jaxdyn as jd
from jaxdyn.systems.system import velocity_to_rate


def admissible(scene, q, chosen, values):
    """The velocity with A v = 0 whose entries `chosen` are `values`: as many as the rows leave free."""
    A = jax.jacfwd(lambda v: jd.constraints.velocity_residual(scene, q, v))(jnp.zeros(scene.nv))
    matrix = jnp.concatenate([A, jnp.eye(scene.nv)[chosen]])
    return jnp.linalg.solve(matrix, jnp.concatenate([jnp.zeros(A.shape[0]), values]))


def motion_jacobian(scene, state, coordinates):
    """J(x, *args) = d/dx of d/dt coordinates(q, v) along the constrained motion through state(x, *args) = (q, v).

    With coordinates(state(x)) = x and a steady motion at x this is the matrix of the linearised motion. To first order
    only, so `state` may leave the constraints by terms of second order.
    """

    def rate(x, *args):
        q, v = state(x, *args)
        a = jd.constrained_dynamics(scene, q, v, method="schur").acceleration
        return jax.jvp(coordinates, (q, v), (velocity_to_rate(scene.system, q, v), a))[1]

    return jax.jacfwd(rate)
