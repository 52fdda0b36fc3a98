"""Equations of motion of a grasped object: the hand's inertia and torques as they act through the contacts.

With J_h square and regular, X = J_h^-1 G^T gives the joint velocities thetadot = X V, and with N = [X; 1]

    M~ = N^T M N = M_o + X^T M_f X,        C~ = N^T (C N + M Ndot) = C_o + X^T (C_f X + M_f Xdot),
    N~ = N^T g = N_o + X^T N_f,            F = N^T tau = tau_o + G J_h^-T tau_f,
    M~ Vdot + C~ V + N~ = F,               lam = J_h^-T (tau_f - M_f thetadd - C_f thetadot - N_f).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxdyn.compile import compiled
from jaxdyn.constraints.base import Layout, constraint_jacobian, layout
from jaxdyn.constraints.dynamics import RESULTS, Outcome, applied
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.dynamics.quantities import coriolis_matrix, gravity_force, mass_matrix
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import as_array, batch_hint, check_state, or_zeros
from jaxdyn.reduction.minimal import least_quality
from jaxdyn.systems.system import velocity_to_rate


class ObjectDynamics(Outcome):
    """M~ Vdot + C~ V + N~ = F of a grasped object, its solution and the contact forces.

    - `mass_matrix`, `coriolis_matrix` (no, no); `gravity_force`, `force` (no,): M~, C~, N~, F, wrenches in the object's
      frame for a free body. M~ is symmetric, dM~/dt - 2 C~ skew.
    - `rate` (no,): Vdot. `velocity`, `acceleration` (nv,): of all joints, thetadot = X V among them.
    - `contact_forces` (nc,): on the object, along the contacts' components, N and N m.
    - `result`: one of `jd.RESULTS`; `singular_basis` where the hand Jacobian is singular.
    - `layout`: name and place of each contact's rows.
    """

    mass_matrix: Float[Array, "no no"]
    coriolis_matrix: Float[Array, "no no"]
    gravity_force: Float[Array, " no"]
    force: Float[Array, " no"]
    rate: Float[Array, " no"]
    velocity: Float[Array, " nv"]
    acceleration: Float[Array, " nv"]
    contact_forces: Float[Array, " nc"]
    result: Any
    layout: tuple[Layout, ...] = eqx.field(static=True)

    def by_contact(self) -> dict[str, Array]:
        """Forces of each contact on the object, by its name."""
        return {place.name: self.contact_forces[..., place.start : place.end] for place in self.layout}


def object_dynamics(
    grasp: Grasp, q: Float[Array, " nq"], V: Float[Array, " no"], tau: Float[Array, " nv"] | None = None, t=0.0
) -> ObjectDynamics:
    """Equations of motion in the velocity of the object alone (see `ObjectDynamics`), and the contact forces.

    **Arguments:**

    - `q` (nq,), on the contacts; `V` (no,), velocity of the object: its body twist when it is free.
    - `tau` (nv,), of the fingers' joints and on the object, N m or N (None: zero); `t`, s. The grasp's forces are added.

    **Returns:** `ObjectDynamics`.

    **Raises:** ValueError for shapes that do not fit, and for contacts with another number of rows than the hand has
    joints, so that J_h is not square: use `constrained_dynamics` then.

    Source: Murray, Li & Sastry (1994), eqs 6.21-6.25; EQUATIONS section 10 and errata E35-E37.
    """
    check_grasp(grasp)
    tau = or_zeros(tau, grasp.nv)
    q, tau, t = check_state(grasp.system, q=q, tau=tau, t=t)
    V = as_array(V, "V", q.dtype)
    count, joints = layout(grasp)[-1].end, len(grasp.hand_velocities)
    if count != joints:
        raise ValueError(
            f"the contacts have {count} rows and the hand {joints} joints, so the hand Jacobian is not square; use "
            "jd.constrained_dynamics(grasp, q, v, tau), or choose other contacts"
        )
    if V.shape != (len(grasp.object_velocities),):
        raise ValueError(
            f"V has shape {V.shape}, expected {(len(grasp.object_velocities),)}, the velocity of {grasp.object!r}"
            f"{batch_hint(V, (1,))}"
        )
    return _solve(grasp, q, V, tau, t)


@compiled
def _solve(grasp: Grasp, q, V, tau, t) -> ObjectDynamics:
    hands, objects = (np.array(x, int) for x in (grasp.hand_velocities, grasp.object_velocities))
    system = grasp.system
    A, push = jax.linearize(lambda q, t: constraint_jacobian(grasp, q, t), q, t)
    Jh = -A[:, hands]
    inverse = pseudo_inverse(Jh, tolerance(None, Jh))
    X = _product(inverse, A[:, objects])
    N = jnp.zeros((grasp.nv, objects.size), q.dtype).at[objects].set(jnp.eye(objects.size, dtype=q.dtype))
    N = N.at[hands].set(X)
    v = _product(N, V)
    # From J_h X = G^T: J_h Xdot = Gdot^T - J_hdot X, which is Adot N.
    Xdot = _product(inverse, _product(push(velocity_to_rate(system, q, v), jnp.ones_like(t)), N))
    Ndot = jnp.zeros_like(N).at[hands].set(Xdot)

    M, C = mass_matrix(system, q, t), coriolis_matrix(system, q, v, t)
    gravity, force = gravity_force(system, q, t), applied(grasp, q, v, tau, t)
    mass = _product(N.T, _product(M, N))
    coriolis = _product(N.T, _product(C, N) + _product(M, Ndot))
    held, driven = _product(N.T, gravity), _product(N.T, force)
    factor = jnp.linalg.cholesky(mass)
    rate = cho_solve((factor, True), driven - _product(coriolis, V) - held)
    a = _product(N, rate) + _product(Ndot, V)
    lam = _product(inverse.T, (force - _product(M, a) - _product(C, v) - gravity)[hands])

    result = RESULTS.where(jnp.isfinite(factor).all(), RESULTS.successful, RESULTS.singular_mass_matrix)  # pyright: ignore[reportArgumentType]
    whole = jnp.round(jnp.sum(inverse * Jh.T)) == hands.size
    condition = jnp.sqrt(jnp.sum(inverse * inverse) * jnp.sum(A * A))
    result = RESULTS.where(whole & (condition * least_quality(q.dtype) < 1), result, RESULTS.singular_basis)
    return ObjectDynamics(mass, coriolis, held, driven, rate, v, a, lam, result, layout(grasp))
