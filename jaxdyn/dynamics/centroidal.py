"""The motion of the centre of mass; its momentum is in `quantities` (`centroidal_momentum`)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.quantities import centroidal_momentum_matrix
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


def com_jacobian(model: Model, q: Float[Array, " nq"]) -> Float[Array, "3 nv"]:
    """Jacobian of the centre of mass: J v is the velocity of `center_of_mass`, in world axes.

    J is the linear part of the centroidal momentum matrix over the total mass, so the generalised force of gravity is
    N = -m J^T g.

    **Arguments:** `q` (nq,).

    **Returns:** (3, nv), m/s per unit of v. NaN when no body has mass.

    **Raises:** ValueError for a q that does not fit.

    Source: Orin, Goswami & Lee (2013), eq. 30.
    """
    (q,) = check_shapes(model, q=q)
    return centroidal_momentum_matrix(model, q)[:3] / jnp.sum(model.inertias[:, 0])
