"""Hybrid laws: motion along constraints follows a target, and constraint forces follow a reference.

    tau = M a + h - forces + A^T (-lam_d + KI z),    dz/dt = lam - lam_d,

with the acceleration a that satisfies the constraints, A a = gamma, and the task. As the plant then accelerates by a,
A^T (lam - lam_d + KI z) = 0: the loops of motion and of force are separate, whatever the rows are, holonomic or not.
With q = psi(x), qdot = J xdot, a is  J (xdd_d - Kv ed - Kp e) + Jdot xdot,  in the notation of the documents.

The force loop goes through the integral z alone, so tau does not depend on the current lam.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxdyn.constraints.base import Constraint, constraint_jacobian
from jaxdyn.constraints.dynamics import projections
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.control.errors import (
    ForceLoop,
    RateError,
    Target,
    TaskError,
    as_target,
    constrained,
    gain,
    regularity,
)
from jaxdyn.control.motion import torque_for
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Number, Numbers, as_array
from jaxdyn.model.numbers import as_number
from jaxdyn.reduction.inverse_dynamics import velocity_choice
from jaxdyn.systems.scene import Scene, as_pytree
from jaxdyn.systems.system import SceneLike


class HybridForce(ForceLoop):
    r"""Motion along constraints and force against them.

    $$\ddot e + K_d \dot e + K_p e = 0, \quad (\lambda - \lambda_d) + K_I z = 0$$

    For constraints of every kind. A task of positions x(q), `of="position"`, follows x_d(t) by the gains `kp` and `kd`; a task
    of velocities u(q, v), linear in v, `of="velocity"`, follows u_d(t) by $\dot u - \dot u_d = -K_p (u - u_d)$: for nonholonomic
    constraints, whose velocities $v = J u$ are free and whose positions are not. Where task and constraints together leave
    some motion undetermined, it has the least acceleration in the metric M. Constraints come first: where the task depends
    on them, it is followed in the least-squares sense by the motions that they leave, and the force is that of the reference.

    Errors decay as set by the gains for an exact model. With model errors, M' and h' in the law, the force is
    off by $-(A M^{-1} A^T)^{-1} A M^{-1} ((M' - M) a + h' - h)$, which integral action removes: $\lambda - \lambda_d$ decays
    with $K_I$.

    **Arguments:**

    - `scene`: with constraints; its forces are compensated.
    - `task`: x(q) -> (m,), or u(q, v) -> (m,); `target`: (m,), or a function of t, differentiable twice (once for velocities).
    - `kp`, `kd`: positive definite, numbers, (m,) or (m, m); 1/s^2 and 1/s, or 1/s for `kp` of velocities, without `kd`.
    - `force`: $\lambda_d$ (nc,), or a function of t; None for zero. `ki` (1/s): positive definite, or None for no
      integral action.
    - `actuated`: indices of the actuated velocities; None: all. The torques of least norm are used that
      give the motion, plus the part of `internal` (na,), N m, along directions that change only forces: with as many motors as
      degrees of freedom there are none. Forces are then not controlled, and `force` and `ki` must be omitted.
    - `least_regularity`: a number from 0 to 1. Where `regularity(q, v, t)` falls to it, a simulation ends with the code
      `control_singular` and the time. None: it continues, with the task followed in the least-squares sense.

    **Raises:** ValueError for a scene without constraints, gains that are not positive definite, gains or a task
    inconsistent with `of`; (when called) for inconsistent shapes.

    Source: EQUATIONS section 8 (the documents' law for holonomic and for nonholonomic constraints, and for fewer motors
    than joints); Murray, Li & Sastry (1994), section 6.4.
    """

    scene: Scene
    error: Constraint
    kp: Array
    kd: Array | None
    force: Callable | None
    ki: Array | None
    actuated: tuple[int, ...] | None = eqx.field(static=True)
    internal: Array | None
    least_regularity: Array | None

    def __init__(
        self,
        scene: SceneLike,
        task: Function,
        target: Target,
        kp: Numbers,
        kd: Numbers | None = None,
        *,
        of: str = "position",
        force: Target | None = None,
        ki: Numbers | None = None,
        actuated: Checked[Sequence[int] | None] = None,
        internal: Numbers | None = None,
        least_regularity: Numbers | None = None,
    ):
        self.scene = constrained(scene)
        # kd is None for velocities, whose error equation is of first order.
        self.kp, self.kd = gain(kp, "kp"), None if kd is None else gain(kd, "kd")
        self.error = _error(task, target, of, self.kd)
        self.force = None if force is None else as_target(force, "force")
        self.ki = None if ki is None else gain(ki, "ki")
        self.actuated = None if actuated is None else velocity_choice(self.scene, actuated, "actuated")
        self.internal = None if internal is None else jnp.asarray(as_array(internal, "internal"), float)
        self.least_regularity = (
            None if least_regularity is None else as_number(least_regularity, "least_regularity", zero=True)
        )
        if self.actuated is None and self.internal is not None:
            raise ValueError("internal is given without actuated; name the actuated velocities")
        if self.actuated is not None and not (self.force is None and self.ki is None):
            raise ValueError("force or ki is given with actuated, where forces follow from the motion; omit them")
        if self.internal is not None and self.internal.shape != (len(self.actuated or ()),):
            raise ValueError(f"internal has shape {self.internal.shape}; give one torque per motor of {self.actuated}")

    def acceleration(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Commanded acceleration (nv,), consistent with the constraints."""
        return self._acceleration(q, v, jnp.asarray(t, q.dtype), jnp.zeros_like(v))

    def regularity(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, ""]:
        """Distance of the law from a singularity of task and constraints, 1 to 0.

        The least sine of the angle, in the metric $M^{-1}$, between a row of the task and the span of the constraints' and
        the rows of the task before it. Close to a singularity the law's accelerations grow as its inverse.
        """
        t = jnp.asarray(t, q.dtype)
        (A, _), (T, _) = self._orders(q, v, t)
        return regularity(self.scene.system, q, t, A, T)

    def allowance(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""] | None:
        """Margin of `regularity` above the least one."""
        if self.least_regularity is None:
            return None
        return self.regularity(q, v, t) - self.least_regularity.astype(q.dtype)

    def __call__(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number = 0.0,
        state: PyTree = None,
        multipliers: Float[Array, " nc"] | None = None,
    ) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N."""
        t = jnp.asarray(t, q.dtype)
        # As the plant accelerates by this a, A^T (lam + force command) = 0 remains: this sets the multipliers.
        tau = torque_for(self.scene, q, v, self.acceleration(q, v, t), t)
        if self.actuated is None:
            return tau + matmul(constraint_jacobian(self.scene, q, t).T, self.force_command(q, t, state))
        # Projected by P_omega the constraint forces vanish, so that the motors' torques need only match along the
        # motion.
        P_omega, motors = projections(self.scene, q, t).P_omega, np.array(self.actuated, int)  # pyright: ignore[reportArgumentType]
        by_motors = P_omega[:, motors]
        # P_omega has the rank of the degrees of freedom: with more motors than these its columns are dependent.
        inverse = pseudo_inverse(by_motors, tolerance(None, P_omega), True)
        pushed = matmul(inverse, matmul(P_omega, tau))
        if self.internal is not None:
            # Only the part in the kernel of P_omega S is added: it changes forces and no motion.
            internal = self.internal.astype(q.dtype)
            pushed = pushed + internal - matmul(inverse, matmul(by_motors, internal))
        return jnp.zeros_like(tau).at[motors].set(pushed)


def _error(task: Any, target: Any, of: str, kd) -> Constraint:
    if of not in ("position", "velocity"):
        raise ValueError(f"of is {of!r}; choose 'position' for a task x(q), or 'velocity' for a task u(q, v)")
    if (kd is None) == (of == "position"):
        raise ValueError(
            f"kd is {'None' if kd is None else 'given'} for a task of {of}; positions take kp and kd, velocities kp"
        )
    function = as_pytree(task, f"task (of {of})", "q" if of == "position" else "q, v")
    return TaskError(function, as_target(target)) if of == "position" else RateError(function, as_target(target))  # pyright: ignore[reportCallIssue]
