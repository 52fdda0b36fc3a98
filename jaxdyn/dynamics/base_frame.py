"""Products of exponentials in base-frame twists, as Murray, Li & Sastry and Li & Wu write them (EQUATIONS section 2).

With xi_j the twist of joint j in the world frame at q = 0, the pose of body i is
exp(hat(xi_1) q_1) ... exp(hat(xi_i) q_i) g_i(0), and the adjoints A_ij of the exponentials
between bodies j and i map twists from one to the other:

    J_i = Ad^-1_{g_i(0)} [A_i1 xi_1 ... A_ii xi_i],
    M_ij = sum_l xi_i^T A_li^T M'_l A_lj xi_j,    M'_l = Ad^T_{g_l(0)^-1} M_l Ad_{g_l(0)^-1}.

This form serves reading and checking; `mass_matrix` and `mass_matrix_derivative` use recursions instead.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.dynamics.tree_frames import body_subspace, take
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import check_shapes
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model


def base_twists(model: Model) -> Float[Array, "nv 6"]:
    r"""Twist of every joint in the world frame at the neutral configuration.

    $$\xi_j = \mathrm{Ad}_{g_j(0)} S_j$$

    **Returns:** (nv, 6), one row (v, omega) for each velocity coordinate: m/rad and rad/rad for a joint that rotates,
    m/m for one that translates.

    Source: Murray, Li & Sastry (1994), section 3.2; EQUATIONS section 2.
    """
    check_shapes(model)
    return _base_twists(model)


@kernel
def _base_twists(model: Model):
    home = forward_kinematics(model, neutral(model))
    # A joint of several coordinates repeats its body's pose for each of them.
    return jax.vmap(se3.Ad_apply)(take(home, model.topology.dof_body), body_subspace(model))


def link_adjoints(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nb nb 6 6"]:
    r"""Adjoints from each body to each of its descendants, by products of exponentials.

    $$A_{ij} = \mathrm{Ad}^{-1}_{\exp(\hat\xi_{j+1} q_{j+1}) \cdots \exp(\hat\xi_i q_i)}
    = \mathrm{Ad}_{g_i(0)} \mathrm{Ad}^{-1}_{g_j(q)^{-1} g_i(q)} \mathrm{Ad}^{-1}_{g_j(0)}$$

    $A_{ii} = 1$, and $A_{ij} = 0$ unless body j is an ancestor of body i; $g_i(q)$ are the poses of the bodies in the world.
    Along a path to the root $A_{ij} A_{jk} = A_{ik}$, and
    $\partial (A_{lj} \xi_j) / \partial q_k = A_{lk} [A_{kj} \xi_j, \xi_k]$, from which `mass_matrix_derivative` follows.

    **Arguments:** `q` (nq,).

    **Returns:** (nb, nb, 6, 6) in the order of `model.body_names`; they act on twists (v, omega).

    **Raises:** ValueError when the shape of q does not fit the model.

    Source: Li & Wu, Property 2; Murray, Li & Sastry (1994), eq. 4.27; EQUATIONS section 2.
    """
    (q,) = check_shapes(model, q=q)
    return _link_adjoints(model, q)


@kernel
def _link_adjoints(model: Model, q):
    poses, home = forward_kinematics(model, q), forward_kinematics(model, neutral(model))
    # poses home^-1 is the product of the exponentials down to each body: g_i(q) = product g_i(0).
    products = matmul(poses, jax.vmap(se3.inverse)(home))
    # All pairs at once, although half of them are masked: one batched product is a shorter program than a loop over
    # paths.
    between = jax.vmap(jax.vmap(lambda a, b: se3.Ad(matmul(se3.inverse(a), b)), (None, 0)), (0, None))(
        products, products
    )
    return jnp.where(model.topology.ancestors[:, :, None, None], between, jnp.zeros_like(between))
