"""Articulated bodies of a tree in motion: inertias and biases, as the articulated-body algorithm computes them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.dynamics import scans
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.tree import Model


class ArticulatedBodies(eqx.Module):
    r"""Articulated inertia and bias of each body (see `articulated_bodies`), in the body's frame.

    - `inertias` (nb, 6, 6): $\hat M_i$, symmetric; kg, kg m, kg m^2.
    - `biases` (nb, 6): $b_i$; N, N m.
    """

    inertias: Float[Array, "nb 6 6"]
    biases: Float[Array, "nb 6"]


def articulated_bodies(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"],
    *,
    external: Float[Array, "nb 6"] | None = None,
) -> ArticulatedBodies:
    r"""Articulated inertias and biases of all bodies.

    $$F_i = \hat M_i \dot V_i + b_i$$

    $F_i$ is the wrench that joint i transmits to its body (`joint_wrench`), with the joints beyond it free to move under
    tau. $\dot V_i$ is the body's twist rate less gravity: it starts from $\dot V_0 = (-g, 0)$, as in `newton_euler_matrices`.

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,), N m or N; `external` (nb, 6), wrench (f, tau) ON each body, at its
    frame's origin and in its axes (N, N m), or None.

    **Returns:** `ArticulatedBodies`. The inertias depend on q alone, and
    $\det M = \prod_i \det(S_i^T \hat M_i S_i + \mathrm{armature}_i)$. NaN where M is not positive definite.

    **Raises:** ValueError for shapes that do not fit.

    Source: EQUATIONS section 5 with erratum E12; Featherstone (2008), section 7.2.

    ```python
    bodies = jd.dynamics.articulated_bodies(model, q, v, tau)
    pivot = bodies.inertias[-1][5, 5]  # of a last joint that turns about z, without armature
    ```
    """
    q, v, tau, external = check_shapes(model, q=q, v=v, tau=tau, external=external)
    # The scans need at least one body: the largest size of a joint is a maximum over them.
    if model.nb == 0:
        return ArticulatedBodies(jnp.zeros((0, 6, 6), q.dtype), jnp.zeros((0, 6), q.dtype))
    return _articulated_bodies(model, q, v, tau, external)


@entry_point
def _articulated_bodies(model: Model, q, v, tau, external) -> ArticulatedBodies:
    return ArticulatedBodies(*scans.articulated_bodies(model, q, v, tau, external))
