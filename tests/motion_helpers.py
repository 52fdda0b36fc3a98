"""What the tests of motions share."""

import jax.numpy as jnp
import numpy as np

import jaxdyn as jd


def within(tolerance) -> jd.simulation.Steps:
    """Adaptive steps that keep a tolerance."""
    return jd.simulation.Steps(rtol=tolerance, atol=tolerance)


def central_difference(function, point, step=1e-4):
    """Fourth-order differences of a batched function, every coordinate in one call."""
    offsets = step * np.array([1, -1, 2, -2])[:, None, None] * np.eye(point.size)
    values = np.asarray(function(jnp.asarray((point + offsets).reshape(-1, point.size))))
    one, minus, two, minus_two = values.reshape(4, point.size, *values.shape[1:])
    return (8 * (one - minus) - (two - minus_two)) / (12 * step)


def largest_residuals(scene, q, v, t=0.0):
    """Largest residuals of the positions and of the velocities by the constraints, (2,)."""
    parts = jd.constraints.position_residual(scene, q, t), jd.constraints.velocity_residual(scene, q, v, t)
    return jnp.stack([jnp.max(jnp.abs(part), initial=0.0) for part in parts])
