"""Equations of motion of a grasped object, with the hand's inertia and torques acting through the contacts.

With J_h square and regular, X = J_h^-1 G^T gives the joint velocities thetadot = X V, and with N = [X; 1]

    M~ = N^T M N = M_o + X^T M_f X,        C~ = N^T (C N + M Ndot) = C_o + X^T (C_f X + M_f Xdot),
    N~ = N^T g = N_o + X^T N_f,            F = N^T tau = tau_o + G J_h^-T tau_f,
    M~ Vdot + C~ V + N~ = F,               lam = J_h^-T (tau_f - M_f thetadd - C_f thetadot - N_f).

With any J_h the same holds for nu = (w, u) and N = [[J_h^+ G^T H, K], [H, 0]] (`jaxdyn.grasp.motions`), and the multipliers
of the full equations M a + C v + g = tau + A^T lam are  lam = (A^T)^+ (M a + C v + g - tau).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.constraints.base import Layout, constraint_jacobian, layout
from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.dynamics import total_force
from jaxdyn.constraints.rank import condition_number, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.redundancy import distribute_multipliers
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.dynamics.quantities import coriolis_matrix, gravity_force, mass_matrix
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.grasp.motions import HandMotions, check_motions, hand_motions, velocity_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_shape, check_state, zeros_if_none
from jaxdyn.reduction.bases import min_quality
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky
from jaxdyn.systems.system import velocity_to_rate


class ObjectDynamics(Outcome):
    r"""Equations of motion of a grasped object, their solution and the contact forces.

    $$\tilde M \dot\nu + \tilde C \nu + \tilde N = F$$

    nu (nr,) is the object's velocity V with `object_dynamics`, and (w, u) with `hand_dynamics`.

    - `mass_matrix`, `coriolis_matrix` (nr, nr); `gravity_force`, `force` (nr,): $\tilde M$, $\tilde C$, $\tilde N$, F;
      wrenches in the object's frame for the velocity of a free body. $\tilde M$ is symmetric,
      $\dot{\tilde M} - 2 \tilde C$ skew.
    - `input_map` (nr, nh): maps the joints' torques to their part of F, the rest is the forces on the object; $G J_h^{-T}$
      with V.
    - `rate` (nr,): $\dot\nu$. `velocity`, `acceleration` (nv,): of all joints, $v = N \nu$ and its rate.
    - `contact_forces` (nc,): on the object, along the contacts' components, N and N m.
    - `basis` (nv, nr): N.
    - `result`: one of `jd.RESULTS`; `singular_basis` where the hand Jacobian is singular, or its rank differs from that
      of `motions`.
    - `layout`: name and row range of each contact.
    """

    mass_matrix: Float[Array, "nr nr"]
    coriolis_matrix: Float[Array, "nr nr"]
    gravity_force: Float[Array, " nr"]
    force: Float[Array, " nr"]
    input_map: Float[Array, "nr nh"]
    rate: Float[Array, " nr"]
    velocity: Float[Array, " nv"]
    acceleration: Float[Array, " nv"]
    contact_forces: Float[Array, " nc"]
    basis: Float[Array, "nv nr"]
    result: Any
    layout: tuple[Layout, ...] = eqx.field(static=True)

    def by_contact(self) -> dict[str, Array]:
        """Forces of each contact on the object, by its name."""
        return {place.name: self.contact_forces[..., place.start : place.end] for place in self.layout}


def object_dynamics(
    grasp: Grasp,
    q: Float[Array, " nq"],
    V: Float[Array, " no"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
) -> ObjectDynamics:
    """Equations of motion in the velocity of the object alone (see `ObjectDynamics`), and the contact forces.

    **Arguments:**

    - `q` (nq,), on the contacts; `V` (no,), velocity of the object: its body twist when it is free.
    - `tau` (nv,), of the fingers' joints and on the object, N m or N (None: zero); `t`, s. The grasp's forces are added.

    **Returns:** `ObjectDynamics`.

    **Raises:** ValueError for inconsistent shapes, and where the number of contact rows differs from that of the hand's
    joints, so that $J_h$ is not square: use `hand_dynamics` then.

    Source: Murray, Li & Sastry (1994), eqs 6.21-6.25; EQUATIONS section 10 and errata E35-E37.
    """
    check_grasp(grasp)
    tau = zeros_if_none(tau, grasp.nv)
    q, tau, t = check_state(grasp.system, q=q, tau=tau, t=t)
    count, joints = layout(grasp)[-1].end, len(grasp.hand_velocities)
    if count != joints:
        raise ValueError(
            f"the contacts have {count} rows and the hand {joints} joints, so the hand Jacobian is not square; use "
            "jd.grasp.hand_dynamics(grasp, q, nu, tau), or choose other contacts"
        )
    V = as_shape(V, "V", q.dtype, (len(grasp.object_velocities),), of=f", the velocity of {grasp.object!r}")
    return _solve(grasp, q, V, tau, t)


def hand_dynamics(
    grasp: Grasp,
    q: Float[Array, " nq"],
    nu: Float[Array, " nr"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    motions: HandMotions | None = None,
) -> ObjectDynamics:
    r"""Equations of motion of any hand, also redundant or nonmanipulable ones.

    Formulation: minimal velocities $\nu = (w, u)$, w of the object velocities that the fingers can follow, u of the internal
    motions of the hand:

    $$V = H w, \quad \dot\theta = J_h^+ G^T H w + K u$$

    with the pseudo-inverse $J_h^+$ and K a basis of $\ker J_h$. No chart is laid on the object's configuration, nor any quantity
    damped. Where $J_h$ is square and regular it is `object_dynamics`, and $\nu = V$.

    Structural contact forces, which no torque changes, follow from the object's equation
    too; for dependent rows, the forces of least norm, as in `jd.constrained_dynamics`.

    **Arguments:**

    - `q` (nq,), on the contacts; `nu` (nw + nk,): (w, u).
    - `tau` (nv,), of the fingers' joints and on the object, N m or N (None: zero); `t`, s. The grasp's forces are added.
    - `motions`: references of H and K, `hand_motions` of a configuration nearby; by default of q itself. Along a motion
      keep them, so that nu keeps its meaning: $\dot{\tilde M} - 2 \tilde C$ is skew for H and K continued from fixed references.

    **Returns:** `ObjectDynamics`, in nu.

    **Raises:** ValueError for inconsistent shapes, and as `hand_motions` does.

    ```python
    motions = jd.grasp.hand_motions(grasp, q)
    dynamics = jd.grasp.hand_dynamics(grasp, q, nu, tau, motions=motions)
    dynamics.acceleration, dynamics.contact_forces
    ```

    Source: Murray, Li & Sastry (1994), eqs 6.21-6.25 and the paragraphs on redundant and nonmanipulable grasps of section
    6.3; EQUATIONS section 10.
    """
    check_grasp(grasp)
    tau = zeros_if_none(tau, grasp.nv)
    q, tau, t = check_state(grasp.system, q=q, tau=tau, t=t)
    motions = hand_motions(grasp, q, t) if motions is None else check_motions(motions)
    nh, no = len(grasp.hand_velocities), len(grasp.object_velocities)
    if motions.object.shape[0] != no or motions.internal.shape[0] != nh:
        raise ValueError(
            f"motions has rows for {motions.object.shape[0]} velocities of an object and {motions.internal.shape[0]} joints, "
            f"the grasp has {no} and {nh}; use jd.grasp.hand_motions(grasp, q)"
        )
    of = f": {motions.object.shape[1]} velocities of the object and {motions.internal.shape[1]} of the hand"
    nu = as_shape(nu, "nu", q.dtype, (motions.size(grasp),), of=of)
    return _solve_motions(independent_rows(grasp, q, t), motions, q, nu, tau, t)


@entry_point
def _solve(grasp: Grasp, q, V, tau, t) -> ObjectDynamics:
    hands, objects = velocity_rows(grasp)
    # One linearisation gives A, and Adot along the motion that A itself determines.
    A, push = jax.linearize(lambda q, t: constraint_jacobian(grasp, q, t), q, t)
    Jh = -A[:, hands]
    inverse = pseudo_inverse(Jh, tolerance(None, Jh))
    # The columns of the object in A = [-J_h  G^T] are G^T.
    X = matmul(inverse, A[:, objects])
    N = jnp.zeros((grasp.nv, objects.size), q.dtype).at[objects].set(jnp.eye(objects.size, dtype=q.dtype))
    N = N.at[hands].set(X)
    v = matmul(N, V)
    # From J_h X = G^T: J_h Xdot = Gdot^T - J_hdot X, which is Adot N.
    Xdot = matmul(inverse, matmul(push(velocity_to_rate(grasp.system, q, v), jnp.ones_like(t)), N))
    Ndot = jnp.zeros_like(N).at[hands].set(Xdot)
    whole = rank_of(Jh, inverse) == hands.size
    condition = condition_number(A, inverse)
    # The condition number that the dtype resolves: beyond it the basis N has no correct digits.
    is_regular = whole & (condition * min_quality(q.dtype) < 1)
    # From the rows of the fingers alone, where A^T is -J_h^T.
    return _solve_dynamics(grasp, q, V, tau, t, N, Ndot, is_regular, lambda left: -matmul(inverse.T, left[hands]))


@entry_point
def _solve_motions(grasp: Grasp, motions: HandMotions, q, nu, tau, t) -> ObjectDynamics:
    place, push = jax.linearize(lambda q, t: motions.at(grasp, q, t), q, t)
    # N is linearised with its configuration, so that Ndot is exact for any basis.
    v = matmul(place.N, nu)
    Ndot = push(velocity_to_rate(grasp.system, q, v), jnp.ones_like(t)).N
    is_regular = place.quality > min_quality(q.dtype)
    A = constraint_jacobian(grasp, q, t)
    inverse = pseudo_inverse(A, tolerance(None, A))

    def multipliers(left):
        return distribute_multipliers(grasp, q, t, matmul(inverse.T, left))

    return _solve_dynamics(grasp, q, nu, tau, t, place.N, Ndot, is_regular, multipliers)


def _solve_dynamics(grasp: Grasp, q, nu, tau, t, N, Ndot, is_regular, multipliers) -> ObjectDynamics:
    """Solve the equations in nu, v = N nu; `multipliers` solves A^T lam = M a + C v + g - tau (nv,)."""
    system, v = grasp.system, matmul(N, nu)
    M, C = mass_matrix(system, q, t), coriolis_matrix(system, q, v, t)
    gravity, force = gravity_force(system, q, t), total_force(grasp, q, v, tau, t)
    mass = matmul(N.T, matmul(M, N))
    # The matrix C and not C v: dM~/dt - 2 C~ is skew only if dM/dt - 2 C is.
    coriolis = matmul(N.T, matmul(C, N) + matmul(M, Ndot))
    gravity_part, force_part = matmul(N.T, gravity), matmul(N.T, force)
    factor = cholesky(mass)
    rate = solve_cholesky(factor, force_part - matmul(coriolis, nu) - gravity_part)
    a = matmul(N, rate) + matmul(Ndot, nu)
    lam = multipliers(matmul(M, a) + matmul(C, v) + gravity - force)

    # The Cholesky factor of an indefinite matrix is NaN.
    result = RESULTS.where(jnp.isfinite(factor).all(), RESULTS.successful, RESULTS.singular_mass_matrix)
    result = RESULTS.where(is_regular, result, RESULTS.singular_basis)
    push = N[velocity_rows(grasp)[0]].T
    return ObjectDynamics(mass, coriolis, gravity_part, force_part, push, rate, v, a, lam, N, result, layout(grasp))
