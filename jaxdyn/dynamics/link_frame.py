"""Equations of trees as written on paper: Newton-Euler block matrices in link frames, and twists in the base frame.

With A_i = Ad^-1 of the pose of link i in its parent, in block (i, parent(i)) of Gamma, and G = (I - Gamma)^-1,

    V = G P0 V_0 + G xi v,    Vdot = G (xi a + P0 Vdot_0 + ad_xi P0 V_0 + ad_xi Gamma V),
    F = G^T (M Vdot + Pt^T F_t + ad_V^T M V),    tau = xi^T F

(EQUATIONS section 4). This form serves reading, teaching and checking: it costs O(nb^3). The public functions use
`world_frame` or `recursions`, which share only the joints' transforms and screws with this module.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point, kernel
from jaxdyn.dynamics.kinematics import forward_kinematics
from jaxdyn.dynamics.tree_frames import body_subspace, relative_poses, take
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import as_shape, check_name, check_shapes
from jaxdyn.model.configuration import neutral
from jaxdyn.model.inertia import spatial_inertia
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model


class NewtonEulerMatrices(eqx.Module):
    r"""Block matrices of the Newton-Euler equations; n = nb bodies, blocks of 6 in the order of `model.body_names`.

    - `G` (6n, 6n): $(1 - \Gamma)^{-1}$; block (i, j) is $\mathrm{Ad}^{-1}$ of the pose of body i in its ancestor j.
    - `Gamma` (6n, 6n): $A_i$ in block (i, parent(i)); nilpotent, its index is the depth of the tree.
    - `xi` (6n, nv): joint screws, a block of 6 x (coordinates of the joint) for each body.
    - `M` (6n, 6n): spatial inertias of the bodies, block diagonal.
    - `P0` (6n, 6): A_i for the bodies attached to the world.
    - `Pt` (6, 6n): body twist of the tip frame from the body twists, or None without a tip.
    - `ad_xi`, `ad_V`, `ad_V_T` (6n, 6n): block diagonal, of $-\mathrm{ad}_{\xi_i v_i}$, $-\mathrm{ad}_{V_i}$ and
      $-\mathrm{ad}_{V_i}^T$. The minus signs are part of the definition.
    - `V0` (6,): twist of the base; zero unless `base_twist` was given.
    - `V0_dot` (6,): rate of `V0` less gravity, (-g, 0) for a base at rest; zero without gravity.
    - `V` (6n,): body twists.

    The products of these matrices are properties. Rotor inertia (armature) belongs to no link and is in none of them.
    """

    G: Float[Array, "n6 n6"]
    Gamma: Float[Array, "n6 n6"]
    xi: Float[Array, "n6 nv"]
    M: Float[Array, "n6 n6"]
    P0: Float[Array, "n6 6"]
    Pt: Float[Array, "6 n6"] | None
    ad_xi: Float[Array, "n6 n6"]
    ad_V: Float[Array, "n6 n6"]
    ad_V_T: Float[Array, "n6 n6"]
    V0: Float[Array, "6"]
    V0_dot: Float[Array, "6"]
    V: Float[Array, " n6"]

    @property
    def mass_matrix(self) -> Float[Array, "nv nv"]:
        r"""Mass matrix (nv, nv), without armature.

        $$M(q) = \xi^T G^T M G \xi$$
        """
        jacobian = self.jacobians
        return matmul(jacobian.T, matmul(self.M, jacobian))

    @property
    def jacobians(self) -> Float[Array, "n6 nv"]:
        r"""Body Jacobians (6n, nv) of all bodies, stacked.

        $$J = G \xi$$
        """
        return matmul(self.G, self.xi)

    @property
    def bias_force(self) -> Float[Array, " nv"]:
        r"""Bias force (nv,): the forces tau of zero acceleration.

        $$\xi^T G^T (M G (P_0 \dot V_0 + \mathrm{ad}_\xi (P_0 V_0 + \Gamma V)) + \mathrm{ad}_V^T M V)$$

        It is $C_0 v + \phi$ when the base does not move.
        """
        carried = matmul(self.P0, self.V0) + matmul(self.Gamma, self.V)
        rates = matmul(self.G, matmul(self.P0, self.V0_dot) + matmul(self.ad_xi, carried))
        wrenches = matmul(self.M, rates) + matmul(self.ad_V_T, matmul(self.M, self.V))
        return matmul(self.jacobians.T, wrenches)

    @property
    def phi(self) -> Float[Array, " nv"]:
        r"""Gravity force (nv,), the gradient of the potential energy when the base does not move.

        $$\phi = \xi^T G^T M G P_0 \dot V_0$$
        """
        return matmul(self.jacobians.T, matmul(self.M, matmul(self.G, matmul(self.P0, self.V0_dot))))

    @property
    def Jt(self) -> Float[Array, "6 nv"]:
        r"""Body Jacobian (6, nv) of the tip frame.

        $$J_t = P_t G \xi$$

        **Raises:** ValueError when the matrices were built without a tip.
        """
        if self.Pt is None:
            raise ValueError("Jt needs a tip frame, tip is None; call newton_euler_matrices(..., tip=<frame name>)")
        return matmul(self.Pt, self.jacobians)

    @property
    def C0(self) -> Float[Array, "nv nv"]:
        r"""Coriolis matrix (nv, nv) as printed by Li & Wu.

        $$C_0 = \xi^T G^T (M G\, \mathrm{ad}_\xi \Gamma + \mathrm{ad}_V^T M) G \xi$$

        $C_0 v$ is the vector of Coriolis and centrifugal forces when the base does not move (`bias_force` otherwise), but
        $\dot M - 2 C_0$ is not skew. Use `Cs` where skew symmetry matters.
        """
        return self._coriolis(matmul(self.ad_V_T, self.M))

    @property
    def Cs(self) -> Float[Array, "nv nv"]:
        r"""Coriolis matrix (nv, nv) with the skew property.

        $$C_s = \xi^T G^T (M G\, \mathrm{ad}_\xi \Gamma + \mathrm{ad}_V^T M - M \mathrm{ad}_V) G \xi$$

        $C_s v = C_0 v$, and $\dot M - 2 C_s$ is skew.
        """
        return self._coriolis(matmul(self.ad_V_T, self.M) - matmul(self.M, self.ad_V))

    # Cs and C0 differ by M ad_V alone, whose product with the twists V vanishes: ad_V V = 0.
    def _coriolis(self, transport):
        jacobian = self.jacobians
        inner = matmul(self.M, matmul(self.G, matmul(self.ad_xi, self.Gamma))) + transport
        return matmul(jacobian.T, matmul(inner, jacobian))


def newton_euler_matrices(
    model: Model,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    *,
    tip: str | None = None,
    base_twist: Float[Array, "6"] | None = None,
    base_twist_rate: Float[Array, "6"] | None = None,
) -> NewtonEulerMatrices:
    r"""Block matrices of the Newton-Euler equations in link frames.

    **Arguments:**

    - `q` (nq,), `v` (nv,).
    - `tip`: name of the frame where the tip wrench $F_t$ acts, or None.
    - `base_twist` $V_0$ (6,): body twist (v, omega) of the frame that the model calls the world, when that frame moves, as
      on a vehicle; m/s and rad/s in its own axes. `base_twist_rate` (6,): its rate. None is zero. `model.gravity` is
      in the axes that the base has at this instant.

    **Returns:** `NewtonEulerMatrices`. The equation of motion is

    $$M(q) a + C_s v + \phi + J_t^T F_t = \tau$$

    for a base at rest (`bias_force` is $C_s v + \phi$ then), with $F_t$ the wrench that the tip applies TO its surroundings, at
    the tip frame's origin in its axes.

    **Raises:** ValueError for shapes that do not fit, an unknown tip, or a tip fixed to the world.

    Source: EQUATIONS section 4; Park, Bobrow & Ploen (1995), Murray, Li & Sastry (1994) section 4.3.
    """
    q, v = check_shapes(model, q=q, v=v)
    if tip is not None:
        check_name(tip, "tip")
    return _matrices(
        model, q, v, _base_vector("base_twist", base_twist, q), _base_vector("base_twist_rate", base_twist_rate, q), tip
    )


def _base_vector(name: str, value: Any, q) -> Array | None:
    if value is None:
        return None
    return jnp.asarray(as_shape(value, name, q.dtype, (6,), of=": (v, omega) of the base, linear part first"))


@entry_point
def _matrices(model: Model, q, v, base_twist, base_twist_rate, tip: str | None) -> NewtonEulerMatrices:
    topology, n = model.topology, model.nb
    tip_selector = None if tip is None else _tip_selector(model, tip)
    to_child = jax.vmap(lambda pose: se3.Ad(se3.inverse(pose)))(relative_poses(model, q))
    parents = np.array(topology.parents, int)
    gamma = _place(to_child, parents[:, None] == np.arange(n))
    # A root has no parent block in Gamma; its A_i is in P0 instead.
    p0 = jnp.where((parents < 0)[:, None, None], to_child, jnp.zeros_like(to_child)).reshape(6 * n, 6)
    columns = body_subspace(model).T[None]
    # Column k of xi is nonzero in the rows of the body that coordinate k moves.
    own = np.arange(n)[:, None, None] == topology.dof_body[None, None]
    xi = jnp.where(own, columns, jnp.zeros_like(columns)).reshape(6 * n, topology.nv)
    # Gamma^depth = 0, because a path from the root has at most `depth` bodies.
    g = _nilpotent_inverse(gamma, int(topology.depths.max(initial=1)))

    rates = matmul(xi, v)
    twists = matmul(g, rates if base_twist is None else rates + matmul(p0, base_twist))
    # The minus signs follow the documents' definition of the blocks, not the usual ad.
    ad_xi = -jax.vmap(se3.ad)(rates.reshape(n, 6))
    ad_v = -jax.vmap(se3.ad)(twists.reshape(n, 6))
    # The fictitious acceleration of the base replaces gravity on every body.
    at_rest = jnp.zeros((3,), model.home.dtype)
    gravity = at_rest if model.gravity is None else model.gravity
    V0_dot = jnp.concatenate([-gravity, at_rest])
    return NewtonEulerMatrices(
        G=g,
        Gamma=gamma,
        xi=xi,
        M=_block_diagonal(jax.vmap(spatial_inertia)(model.inertias)),
        P0=p0,
        Pt=tip_selector,
        ad_xi=_block_diagonal(ad_xi),
        ad_V=_block_diagonal(ad_v),
        ad_V_T=_block_diagonal(ad_v.transpose(0, 2, 1)),
        V0=jnp.zeros_like(V0_dot) if base_twist is None else base_twist,
        # Gravity and the acceleration of the base enter the equations in the same way.
        V0_dot=V0_dot if base_twist_rate is None else V0_dot + base_twist_rate,
        V=twists,
    )


def _nilpotent_inverse(gamma, depth: int):
    """Inverse (I - Gamma)^-1 = I + Gamma + ... + Gamma^(depth-1), as the product of the factors I + Gamma^(2^k)."""
    identity = jnp.eye(gamma.shape[0], dtype=gamma.dtype)
    total, power, terms = identity + gamma, gamma, 2
    while terms < depth:
        power = matmul(power, power)
        total = matmul(total, identity + power)
        terms *= 2
    return total


def _place(blocks: Float[Array, "n 6 6"], where: np.ndarray) -> Float[Array, "n6 n6"]:
    """Block matrix with block i in row i, in the columns that the constant mask (n, n) marks."""
    n = blocks.shape[0]
    spread = jnp.broadcast_to(blocks[:, :, None, :], (n, 6, n, 6))
    return jnp.where(where[:, None, :, None], spread, jnp.zeros_like(spread)).reshape(6 * n, 6 * n)


def _block_diagonal(blocks: Float[Array, "n 6 6"]) -> Float[Array, "n6 n6"]:
    return _place(blocks, np.eye(blocks.shape[0], dtype=bool))


def _tip_selector(model: Model, tip: str) -> Float[Array, "6 n6"]:
    index = frame_index(model, tip)
    body = model.topology.frame_bodies[index]
    if body < 0:
        raise ValueError(f"tip {tip!r} is fixed to the world and cannot move; name a frame that a joint moves")
    selector = jnp.zeros((6, 6 * model.nb), model.home.dtype)
    # Ad^-1 carries the twist of the body to the tip frame that is fixed in it.
    return selector.at[:, 6 * body : 6 * body + 6].set(se3.Ad(se3.inverse(model.frame_poses[index])))


# Products of exponentials in base-frame twists, as Murray, Li & Sastry and Li & Wu write them (EQUATIONS section 2).
#
# With xi_j the twist of joint j in the world frame at q = 0, the pose of body i is
# exp(hat(xi_1) q_1) ... exp(hat(xi_i) q_i) g_i(0), and the adjoints A_ij of the exponentials
# between bodies j and i map twists from one to the other:
#
#     J_i = Ad^-1_{g_i(0)} [A_i1 xi_1 ... A_ii xi_i],
#     M_ij = sum_l xi_i^T A_li^T M'_l A_lj xi_j,    M'_l = Ad^T_{g_l(0)^-1} M_l Ad_{g_l(0)^-1}.
#
# This form serves reading and checking; `mass_matrix` and `mass_matrix_derivative` use recursions instead.


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
