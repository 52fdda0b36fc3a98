"""Contact forces of a hand: those of a given wrench on the object, internal ones, and the joint torques.

The forces lam with G lam = F are  lam = G^+ F + E c:  the columns of E span the internal forces, ker G. At rest the joints
exert them with tau = J_h^T lam, so that tau . thetadot = lam . J_h thetadot = lam . G^T V = F . V for motions on the contacts.

Source: Murray, Li & Sastry (1994), sections 5.3, 5.5 and 6.3; EQUATIONS section 10.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_known
from jaxdyn.constraints.base import Layout, constraint_jacobian, layout
from jaxdyn.constraints.codes import Outcome
from jaxdyn.constraints.dynamics import total_force
from jaxdyn.constraints.rank import pseudo_inverse, rank_of, tolerance
from jaxdyn.contact.cones import Cones, components
from jaxdyn.contact.forces import (
    ContactWithCone,
    ForceClosure,
    contacts_with_cones,
    force_closure_of_map,
    optimal_forces,
)
from jaxdyn.dynamics.quantities import gravity_force
from jaxdyn.grasp.hand import Contact, Grasp, check_grasp, grasp_map, hand_jacobian
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, as_shape, batch_hint, check_flag, check_state
from jaxdyn.reduction.bases import orthonormal, split_directions


class HandForces(Outcome):
    """Contact forces within their cones, and the joint torques that exert them at rest; see `hold`.

    - `contact_forces` (nc,): on the object, in the order of the grasp's rows, N and N m.
    - `torques` (nh,): $J_h^T$ times them, of the joints in the order of `grasp.hand_velocities`, without the weight of the
      fingers; N m or N.
    - `result`: one of `jd.RESULTS`; `infeasible` where no forces in the cones exert the wrench.
    - `layout`: name and row range of each contact.
    """

    contact_forces: Float[Array, " nc"]
    torques: Float[Array, " nh"]
    result: Any
    layout: tuple[Layout, ...] = eqx.field(static=True)

    def by_contact(self) -> dict[str, Array]:
        """Forces of each contact on the object, by its name."""
        return {place.name: self.contact_forces[..., place.start : place.end] for place in self.layout}


def internal_force_basis(
    grasp: Grasp, q: Float[Array, " nq"], t: Numbers = 0.0, *, reference: Float[Array, "nc ni"] | None = None
) -> Float[Array, "nc ni"]:
    """Orthonormal basis E (nc, ni) of the internal forces.

    $$G E = 0$$

    **Arguments:**

    - `q` (nq,); `t`, s.
    - `reference` (nc, ni): a basis at a configuration nearby, R, which is continued smoothly, $E = P R T^{-1}$ with
    $P = 1 - G^+ G$ and T the Cholesky factor of $R^T P R$. By default an arbitrary basis at q, constant under
      differentiation; where q is traced it has as many columns as for a G of full rank.

    **Raises:** ValueError for a reference of another shape.

    Source: Murray, Li & Sastry (1994), definition 5.4; EQUATIONS section 10.
    """
    G = grasp_map(grasp, q, t)
    inverse = pseudo_inverse(G, tolerance(None, G))
    if reference is None:
        known = is_known(grasp, q, t)
        # A traced q has no known rank, and the number of columns is a shape: full rank is assumed.
        rank = int(rank_of(G, inverse)) if known else min(G.shape)
        return split_directions(jnp.eye(G.shape[1], dtype=G.dtype) - matmul(inverse, G))[:, rank:]
    reference = jnp.asarray(as_array(reference, "reference", G.dtype))
    if reference.ndim != 2 or reference.shape[0] != G.shape[1]:
        raise ValueError(
            f"reference has shape {reference.shape}, expected ({G.shape[1]}, ni); use internal_force_basis(grasp, q)"
        )
    return orthonormal(reference - matmul(inverse, matmul(G, reference)))[0] if reference.shape[1] else reference


def normal_forces(grasp: Grasp) -> Float[np.ndarray, " nc"]:
    """Contact forces (nc,) with 1 N along every normal.

    **Raises:** ValueError for a constraint of the grasp that has no normal force.
    """
    check_grasp(grasp)
    forces = np.zeros(layout(grasp)[-1].end)
    for constraint, place in zip(grasp.constraints, layout(grasp), strict=True):
        order = constraint.wrench_components()
        if order is None:
            raise ValueError(f"constraint {place.name!r} is a {type(constraint).__name__} without a normal force")
        if isinstance(constraint, Contact):
            normal = components(constraint.kind, constraint.in_plane, place.name).index(2)
        else:
            # Normal component by the number of wrench components: (normal), (tangent, normal), (tangent, tangent,
            # normal, ...).
            normal = {1: 0, 2: 1}.get(len(order), 2)
        forces[place.start + order[normal]] = 1.0
    return forces


def forces_for_wrench(
    grasp: Grasp, q: Float[Array, " nq"], wrench: Float[Array, " no"], preload: Numbers = 0.0, t: Numbers = 0.0
) -> Float[Array, " nc"]:
    r"""Contact forces with a given resultant wrench and a given internal force.

    $$\lambda = G^+ F + (1 - G^+ G) \lambda_0$$

    **Arguments:**

    - `wrench` F (no,): on the object, in its own axes for a free body; N and N m. A wrench that the contacts cannot
      exert is projected to the closest one.
    - `preload` $\lambda_0$: a number (N), the normal force of every contact, or forces (nc,); only the internal part is used.
      Equal normal forces are internal where the normals balance, as in an antipodal grasp.

    **Raises:** ValueError for inconsistent shapes, and for a number with constraints without normal force.

    Cones are not considered: `hold` computes forces within them.

    Source: Murray, Li & Sastry (1994), section 6.3, eq. 6.25; EQUATIONS section 10.
    """
    G = grasp_map(grasp, q, t)
    wrench = as_shape(wrench, "wrench", G.dtype, G.shape[:1])
    return split_forces(G, wrench, as_preload(grasp, preload, G.dtype))


def split_forces(G: Float[Array, "no nc"], wrench, preload) -> Float[Array, " nc"]:
    """Contact forces G^+ F + (1 - G^+ G) lam_0."""
    # As lam_0 + G^+ (F - G lam_0), which needs no projection matrix.
    return preload + matmul(pseudo_inverse(G, tolerance(None, G)), wrench - matmul(G, preload))


def as_preload(grasp: Grasp, preload: Any, dtype) -> Float[Array, " nc"]:
    """Contact forces (nc,) from a number, the normal force, or from forces. **Raises:** ValueError."""
    preload, count = as_array(preload, "preload", dtype), layout(grasp)[-1].end
    if preload.ndim == 0:
        # Zero is valid also for constraints without a normal force, which `normal_forces` refuses.
        if is_known(preload) and float(preload) == 0:
            return jnp.zeros((count,), dtype)
        return preload * jnp.asarray(normal_forces(grasp), dtype)
    if preload.shape != (count,):
        raise ValueError(
            f"preload has shape {preload.shape}; give a number (N), or ({count},), one per row of the grasp"
            f"{batch_hint(preload, (1,))}"
        )
    return preload


def hold(
    grasp: Grasp,
    q: Float[Array, " nq"],
    wrench: Float[Array, " no"] | None = None,
    *,
    cones: Cones = None,
    preload: Numbers = 0.0,
    t: Numbers = 0.0,
) -> HandForces:
    """Contact forces of least norm within their cones for a wrench on the object, with their torques at rest.

    A second-order cone program (`jd.contact.optimal_forces`): batched by `jax.vmap`, and differentiable in q, the
    grasp's leaves, coefficients of friction and the wrench.

    **Arguments:**

    - `q` (nq,), on the contacts; `t`, s.
    - `wrench` (no,): to be exerted by the contacts, N and N m. By default the wrench of equilibrium: the opposite of its
      weight and of the grasp's forces on it.
    - `cones`: as in `jd.grasp.contact_forces`, by default those of the grasp; every contact needs one.
    - `preload`: N, least margin of every contact from its cone.

    **Returns:** `HandForces`.

    **Raises:** ValueError for inconsistent shapes and for contacts without a cone.

    ```python
    forces = jd.grasp.hold(grasp, q, preload=0.5)
    forces.torques, forces.by_contact()
    ```

    Source: Murray, Li & Sastry (1994), section 5.3; Boyd & Wegbreit (2007).
    """
    check_grasp(grasp)
    q, t = check_state(grasp.system, q=q, t=t)
    contacts = _every_cone(grasp, cones)
    if wrench is not None:
        wrench = as_shape(wrench, "wrench", q.dtype, (len(grasp.object_velocities),))
    A, weight = _static(grasp, q, t)
    order = np.concatenate([contact.rows for contact in contacts])
    # In equilibrium the contacts exert h minus the other forces on the object.
    wrench = weight if wrench is None else wrench
    G = A[:, np.array(grasp.object_velocities, int)].T
    optimum = optimal_forces(G[:, order], wrench, [contact.cone for contact in contacts], preload=preload)
    # `order` maps the forces of the cones, in the order of components, back to the rows of the grasp.
    forces = jnp.zeros((A.shape[0],), A.dtype).at[order].set(optimum.x)
    # The columns of the fingers in A are -J_h, hence the sign.
    torques = -matmul(A[:, np.array(grasp.hand_velocities, int)].T, forces)
    return HandForces(forces, torques, optimum.result, layout(grasp))


@entry_point
def _static(grasp: Grasp, q, t):
    """Constraint rows, and the contact wrench of static equilibrium."""
    # At rest the bias force is gravity alone.
    at_rest = jnp.zeros((grasp.nv,), q.dtype)
    force = gravity_force(grasp.system, q, t) - total_force(grasp, q, at_rest, at_rest, t)
    return constraint_jacobian(grasp, q, t), force[np.array(grasp.object_velocities, int)]


def force_closure(
    grasp: Grasp, q: Float[Array, " nq"], *, cones: Cones = None, t: Numbers = 0.0, required: bool = False
) -> ForceClosure:
    """Force closure of a grasp: the ability to resist every wrench on the object; see `jd.contact.force_closure_of_map`.

    **Arguments:** `q` (nq,), concrete numbers; `cones` as in `hold`. `required`: refuse a grasp without force closure.

    **Returns:** `ForceClosure`, its forces in the order of the grasp's rows.

    **Raises:** ValueError for contacts without a cone and, where it is `required`, for a grasp without force closure, with a
    wrench that it cannot resist.

    Source: Murray, Li & Sastry (1994), proposition 5.3.
    """
    check_grasp(grasp)
    contacts = _every_cone(grasp, cones)
    order = np.concatenate([contact.rows for contact in contacts])
    # The cones expect components in the order of the wrench basis, which may differ from that of the rows.
    closure = force_closure_of_map(grasp_map(grasp, q, t)[:, order], [contact.cone for contact in contacts])
    if check_flag(required, "required") and not closure.closed:
        raise ValueError(
            f"the contacts {[contact.name for contact in contacts]} on {grasp.object!r} have no force closure: the wrench "
            f"{np.round(closure.direction, 6).tolist()} on the object cannot be resisted; add contacts or friction, or place "
            "them elsewhere"
        )
    # Back from the order of the cones to that of the grasp's rows.
    forces = np.zeros(order.size)
    forces[order] = closure.forces
    return ForceClosure(closure.closed, closure.margin, forces, closure.direction, closure.rank)


def joint_torques(
    grasp: Grasp, q: Float[Array, " nq"], lam: Float[Array, " nc"], t: Numbers = 0.0
) -> Float[Array, " nh"]:
    r"""Joint torques (nh,) that exert the contact forces lam (nc,) at rest, without the fingers' weight.

    $$\tau = J_h^T \lambda$$

    Source: Murray, Li & Sastry (1994), eq. 5.31; EQUATIONS section 10.
    """
    Jh = hand_jacobian(grasp, q, t)
    return matmul(Jh.T, as_shape(lam, "lam", Jh.dtype, Jh.shape[:1]))


def _every_cone(grasp: Grasp, cones) -> tuple[ContactWithCone, ...]:
    """Contacts with their cones. **Raises:** ValueError for a contact without one."""
    names = [place.name for place in layout(grasp)]
    if cones is None and grasp.cones is None:
        raise ValueError(
            f"the contacts {names} have no cones; give cones, as in jd.contact.friction_cone('hard-finger', mu=0.8), here "
            "or to the Grasp"
        )
    coned = contacts_with_cones(grasp, cones)
    # A contact without a cone would be bilateral: it could pull, and the answer would be too optimistic.
    missing = [name for name in names if name not in {contact.name for contact in coned}]
    if missing:
        raise ValueError(f"contacts {missing} have no cone; give one for every contact of {names}")
    return coned
