"""Control of a grasped object by the hand: motion of the object and internal force, by the torques of the fingers only.

With the acceleration a that satisfies the contacts and the object's error equation, and contact forces that carry the object,

    lam_d = G^+ F_o + (1 - G^+ G) lam_0,    F_o = (M a + h - forces) in the rows of the object,
    tau_f = (M a + h - forces) in the rows of the fingers + J_h^T lam_d.

The full equations are then satisfied by this a with lam = lam_d, uniquely where the rows are independent. For
square J_h it is  tau = J_h^T (G^+ (M~ a_o + C~ V + N~) + lam_N) + ..., computed torque in the object's velocity on SE(3).

Sources: Murray, Li & Sastry (1994), section 6.4 (eqs 6.39-6.41); Li, Hsu & Sastry (1989); EQUATIONS section 10.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxdyn.constraints.base import Constraint, constraint_jacobian
from jaxdyn.control.errors import ForceIntegral, Target, as_target, gain, times
from jaxdyn.control.motion import torque_for
from jaxdyn.grasp.forces import as_preload, split_forces
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.grasp.motions import velocity_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Number, Numbers, batch_hint
from jaxdyn.model.numbers import as_number
from jaxdyn.systems.system import displacement


class ObjectError(Constraint):
    """Displacement (no,) of a grasped object from its target: coordinate differences, or a twist for a free body."""

    target: Callable
    grasp: Grasp
    name: str = eqx.field(static=True, default="object")

    def position(self, system, q, t):
        """Displacement from the target to the object's configuration."""
        top = self.grasp.system.topology
        place = top.q_slices[top.body_names.index(self.grasp.object)]
        count = place.stop - place.start
        target = self.target(t)
        if jnp.shape(target) != (count,):
            raise ValueError(
                f"target has shape {jnp.shape(target)}, expected {(count,)}, the coordinates of {self.grasp.object!r}"
                f"{batch_hint(target, (count,))}"
            )
        # Only the object's coordinates differ from q, so that its displacement is the only nonzero part.
        wanted = q.at[place].set(jnp.asarray(target, q.dtype))
        return displacement(system, wanted, q)[velocity_rows(self.grasp)[1]]


class GraspForce(ForceIntegral):
    r"""Motion of a grasped object and internal force.

    $$\ddot e + K_d \dot e + K_p e = 0, \quad (\lambda - \lambda_d) + K_I z = 0$$

    e (no,) is the displacement from the target to the object: differences of its coordinates, and for a free body the twist
    that leads from the target to it. It decays as set by the gains for an exact model; contact forces are those
    of least norm that carry the object, plus the internal part of `preload`. With integral action the internal part of
    $\lambda - \lambda_d$, which errors of the fingers' model cause, decays with `ki`. Redundant fingers move with the least
    acceleration from  -damping v, in the metric M; where they cannot follow the object in all directions, it is followed in
    the least-squares sense (`is_regular`).

    The law ignores cones: the `preload` must keep the forces inside; `jd.simulate` ends where a contact with a cone
    is lost, and `outputs=("contact_forces", "contact_margins")` gives the margins.

    **Arguments:**

    - `grasp`: its forces are compensated.
    - `target`: coordinates of the object (position and unit quaternion of a free one), or a function of t that returns them,
      differentiable twice.
    - `kp` (1/s^2), `kd` (1/s): positive definite, numbers, (no,) or (no, no).
    - `preload`: a number (N), the normal force of the contacts, or forces (nc,) in the order of the grasp's rows, or a function
      of t that returns either; its internal part is used.
    - `ki` (1/s): positive definite, of the internal force; None for no integral action.
    - `damping` (1/s): zero or positive, of the internal motions of the fingers.

    **Raises:** ValueError for anything but a grasp and for gains that are not positive definite; (when called) for inconsistent
    shapes.

    ```python
    law = jd.control.GraspForce(grasp, q_object, kp=25.0, kd=10.0, preload=4.0)
    jd.simulate(grasp, q0, v0, ts, control=law, outputs=("contact_forces", "contact_margins"))
    ```

    Source: Murray, Li & Sastry (1994), section 6.4; EQUATIONS section 10.
    """

    scene: Grasp
    error: ObjectError
    kp: Array
    kd: Array
    preload: Callable
    ki: Array | None
    damping: Array

    def __init__(
        self,
        grasp: Checked[Grasp],
        target: Target,
        kp: Numbers,
        kd: Numbers,
        *,
        preload: Numbers = 0.0,
        ki: Numbers | None = None,
        damping: Numbers = 0.0,
    ):
        check_grasp(grasp)
        self.scene = grasp
        self.error = ObjectError(as_target(target), grasp)  # pyright: ignore[reportCallIssue]
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")
        self.preload = as_target(preload, "preload")
        self.ki = None if ki is None else gain(ki, "ki")
        self.damping = as_number(damping, "damping", zero=True)

    def rate(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: PyTree,
        multipliers: Float[Array, " nc"],
    ) -> Float[Array, " nc"]:
        """Internal part of the force error, (nc,)."""
        # Only the internal part is integrated: the other part balances the motion of the object and has no reference.
        return self._internal(q, t, multipliers - as_preload(self.scene, self.preload(t), q.dtype))

    def acceleration(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Commanded acceleration (nv,), consistent with the contacts and the object's error equation."""
        return self._acceleration(q, v, jnp.asarray(t, q.dtype), -self.damping.astype(v.dtype) * v)

    def reference_forces(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nc"]:
        """Reference contact forces (nc,) that carry the object, with the internal part of the preload."""
        t = jnp.asarray(t, q.dtype)
        # None in place of the integral: this is the reference itself, and not the command that corrects it.
        return self._forces(q, t, torque_for(self.scene, q, v, self.acceleration(q, v, t), t), None)

    def __call__(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number = 0.0,
        state: PyTree = None,
        multipliers: Float[Array, " nc"] | None = None,
    ) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N, zero on the object."""
        t = jnp.asarray(t, q.dtype)
        hands, _ = velocity_rows(self.scene)
        push = torque_for(self.scene, q, v, self.acceleration(q, v, t), t)
        lam = self._forces(q, t, push, state)
        # The rows are A = [-J_h  G^T], hence the sign.
        Jh = -constraint_jacobian(self.scene, q, t)[:, hands]
        # The object has no motors: the contact forces alone satisfy its rows.
        return jnp.zeros_like(push).at[hands].set(push[hands] + matmul(Jh.T, lam))

    def _forces(self, q, t, push, state):
        # The columns of the object in A = [-J_h  G^T] are G^T.
        G = constraint_jacobian(self.scene, q, t)[:, velocity_rows(self.scene)[1]].T
        preload = as_preload(self.scene, self.preload(t), q.dtype)
        if state is not None and self.ki is not None:
            # The integral acts on forces, whose sign is that of lam: no torque of the object's motion changes.
            preload = preload - times(self.ki, state, "ki")
        return split_forces(G, push[velocity_rows(self.scene)[1]], preload)

    def _internal(self, q, t, forces):
        G = constraint_jacobian(self.scene, q, t)[:, velocity_rows(self.scene)[1]].T
        # With zero wrench `split_forces` is the projection on the internal forces.
        return split_forces(G, jnp.zeros((G.shape[0],), q.dtype), forces)
