"""Hybrid laws: motion along constraints follows a target, and constraint forces follow a reference.

    tau = M a + h - forces + A^T (-lam_d + KI z),    dz/dt = lam - lam_d,

with the acceleration a that satisfies the constraints, A a = gamma, and the task. As the plant then accelerates by a,
A^T (lam - lam_d + KI z) = 0: the loops of motion and of force are separate, whatever the rows are, holonomic or not.
With q = psi(x), qdot = J xdot, a is  J (xdd_d - Kv ed - Kp e) + Jdot xdot,  in the notation of the documents.

The force loop goes through the integral z alone, so tau does not depend on the current lam. The gauge-invariant law has decoupled
errors of motion and of force in any basis of the velocities.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.constraints.base import Constraint, constraint_jacobian, rows
from jaxdyn.constraints.dynamics import projections
from jaxdyn.constraints.rank import pseudo_inverse, solve_square, tolerance
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.control.errors import (
    ForceLoop,
    RateError,
    Target,
    TaskError,
    as_matrix,
    as_target,
    constrained,
    drop_rounding,
    gain,
    regularity,
    row_count,
    row_rank,
    times,
)
from jaxdyn.control.motion import torque_for
from jaxdyn.dynamics.quantities import bias_force, coriolis_matrix, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Number, Numbers, as_array, as_number, check_state
from jaxdyn.reduction.inverse_dynamics import velocity_choice
from jaxdyn.reduction.minimal import gauge_invariant
from jaxdyn.systems.scene import Scene, as_pytree
from jaxdyn.systems.system import SceneLike, velocity_to_rate


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
    - `of`: what the task is, "position" or "velocity".
    - `kp`, `kd`: positive definite, numbers, (m,) or (m, m); 1/s^2 and 1/s, or 1/s for `kp` of velocities, without `kd`.
    - `force`: $\lambda_d$ (nc,), or a function of t; None for zero. `ki` (1/s): positive definite, or None for no
      integral action.
    - `actuated`: names of the driven joints, or indices of velocities; None: all. The torques of least norm are used that
      give the motion, and where none do, because the mechanism moves with its motors at rest, those of least squares.
    - `internal` (na,), N m: torques that are added along directions that change only forces: with as many motors as
      degrees of freedom there are none. Forces are then not controlled, and `force` and `ki` must be omitted.
    - `least_regularity`: a number from 0 to 1. Where `regularity(q, v, t)` falls to it, a simulation ends with the code
      `control_singular` and the time. None: it continues, with the task followed in the least-squares sense.

    **Raises:** ValueError for a scene without constraints, gains that are not positive definite, gains or a task
    inconsistent with `of`, fewer motors than degrees of freedom; (when called) for inconsistent shapes.

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
        if len(self._passive()) > row_count(self.scene):
            # More velocities without motors than rows: some motion has all motors at rest.
            raise ValueError(
                f"actuated has {len(self.actuated or ())} of {self.scene.nv} velocities, and the constraints have "
                f"{row_count(self.scene)} rows; name a motor for each degree of freedom"
            )
        if self.internal is not None and self.internal.shape != (len(self.actuated or ()),):
            raise ValueError(f"internal has shape {self.internal.shape}; give one torque per motor of {self.actuated}")

    def acceleration(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Commanded acceleration (nv,), consistent with the constraints."""
        return self._acceleration(q, v, jnp.asarray(t, q.dtype), jnp.zeros_like(v))

    def regularity(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, ""]:
        """Distance of the law from a singularity of task, constraints and motors, 1 to 0.

        The least sine of the angle, in the metric $M^{-1}$, between a row of the task and the span of the constraints' and
        the rows of the task before it. Close to a singularity the law's accelerations grow as its inverse. With `actuated`
        also the least sine of the angle, in the metric M, between a motion of one joint without motor and the span of the
        motions that the constraints allow and of those of such joints before it. Where it is zero, motors at rest do not hold
        the mechanism, and close to that the torques grow as its inverse.
        """
        t = jnp.asarray(t, q.dtype)
        (A, _), (T, _) = self._orders(q, v, t)
        return regularity(self.scene.system, q, t, A, T, self._passive())

    def is_regular(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Bool[Array, ""]:
        """Decide whether task and constraints are independent, and motors at rest hold the mechanism, as the law requires."""
        is_regular, passive = super().is_regular(q, v, t), np.array(self._passive(), int)
        if not passive.size:
            return is_regular
        return is_regular & (row_rank(constraint_jacobian(self.scene, q, t)[:, passive].T) == passive.size)

    def _passive(self) -> tuple[int, ...]:
        """Indices of the velocities without motors."""
        return () if self.actuated is None else tuple(i for i in range(self.scene.nv) if i not in self.actuated)

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
        P_omega, motors = projections(self.scene, q, t).P_omega, np.array(self.actuated, int)
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
    return TaskError(function, as_target(target)) if of == "position" else RateError(function, as_target(target))


class GaugeInvariant(ForceLoop):
    r"""Hybrid law of motion and force in quasi velocities.

    With $\varepsilon = B (\dot e + K_p e)$, $B = V_2^T W^T J$, $s = B (\dot x_d - K_p e)$,

    $$\begin{aligned}
    u_r &= \dot s + \Gamma_r s - K_d \varepsilon: & \dot\varepsilon &= -(\Gamma_r + K_d) \varepsilon, \\
    u_o &= \Gamma_o w_r - \Lambda_r^T \lambda_d + \Lambda_r^T K_I z: & 0 &= (\lambda - \lambda_d) + K_I z.
    \end{aligned}$$

    $\Gamma_r$ is skew, so $|\varepsilon|$ decays for every $K_d > 0$, for $K_d = k 1$ exactly as $e^{-k t}$, independently of the
    choice of W and V: $|\varepsilon|^2 / 2$ is the kinetic energy of the velocity error $\dot e + K_p e$. Unlike `HybridForce` it
    cancels no Coriolis force of the error. With $V_2^T \dot V_2 = 0$,

    $$\dot s + \Gamma_r s = V_2^T W^{-1} (M J (\ddot x_d - K_p \dot e) + (M \dot J + C J) (\dot x_d - K_p e)).$$

    **Arguments:**

    - `scene`: with constraints A v = 0; its forces are compensated.
    - `task`: x(q) -> (nr,), as many coordinates as degrees of freedom; `target`: (nr,), or a function of t,
      differentiable twice.
    - `kp` (1/s), of $\dot e + K_p e$; `kd` (1/s), of $\varepsilon$: positive definite, numbers, (nr,) or (nr, nr). A `kd` other
      than a number acts in the basis $V_2$, which is parallel-transported.
    - `force`, `ki` as in `HybridForce`.

    **Raises:** ValueError for a scene without constraints, gains that are not positive definite; (when called) for shapes that
    are inconsistent and a task of another size than the number of degrees of freedom.

    Source: EQUATIONS section 9 and errata E23 to E26.
    """

    scene: Scene
    error: Constraint
    kp: Array
    kd: Array
    force: Callable | None
    ki: Array | None

    def __init__(
        self,
        scene: SceneLike,
        task: Function,
        target: Target,
        kp: Numbers,
        kd: Numbers,
        *,
        force: Target | None = None,
        ki: Numbers | None = None,
    ):
        self.scene = constrained(scene)
        self.error = TaskError(as_pytree(task, "task", "q"), as_target(target))
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")
        self.force = None if force is None else as_target(force, "force")
        self.ki = None if ki is None else gain(ki, "ki")

    def __call__(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number = 0.0,
        state: PyTree = None,
        multipliers: Float[Array, " nc"] | None = None,
    ) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N."""
        scene, system, t = self.scene, self.scene.system, jnp.asarray(t, q.dtype)
        J, along, change = self._reference_motion(q, v, t)
        # The Coriolis matrix and not h: it multiplies the reference velocity J s and not v.
        M, C = mass_matrix(system, q, t), coriolis_matrix(system, q, v, t)
        # The count is given: under tracing it would be nv minus the number of rows, wrong for dependent ones.
        gauge = gauge_invariant(scene, q, v, None, t, dof=J.shape[1])
        # W^T J (ed + Kp e), which lies along V2.
        eps = matmul(gauge.V2.T, matmul(gauge.W.T, v - along))
        push = matmul(M, change) + matmul(C, along)
        push = push - matmul(gauge.W, matmul(gauge.V2, times(self.kd, eps, "kd")))
        normal = matmul(gauge.Gamma_o, gauge.reduced_velocity) + matmul(
            gauge.Lambda_r.T, self.force_command(q, t, state)
        )
        # W V2 V2^T W^-1 takes the part of `push` along the motion; `normal` replaces the rest.
        free = matmul(gauge.V2, matmul(gauge.V2.T, solve_square(gauge.W, push)))
        tau = matmul(gauge.W, free + matmul(gauge.V1, normal))
        # C v is taken out of h, because `push` has C J s in its place.
        potential, force = bias_force(system, q, v, t) - matmul(C, v), scene.applied_force(q, v, t)
        return tau + potential if force is None else tau + potential - force

    def composite_error(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nr"]:
        r"""Composite error of position and velocity, (nr,), in sqrt(J).

        $$\varepsilon = B (\dot e + K_p e) = V_2^T W^T (v - J (\dot x_d - K_p e))$$

        $|\varepsilon|^2 / 2$ is the kinetic energy of the velocity error $\dot e + K_p e$. The components depend on the
        gauge, the norm not.

        **Arguments:** `q` (nq,), `v` (nv,), on the constraints; `t`, s. **Raises:** as calls of the law.

        Source: EQUATIONS section 9.
        """
        system = self.scene.system
        q, v, t = check_state(system, q=q, v=v, t=t)
        J, along, _ = self._reference_motion(q, v, t)
        return matmul(self._to_quasi_velocities(q, t, J.shape[1]), v - along)

    def equivalent_gains(
        self, q: Float[Array, " nq"], t: Number = 0.0
    ) -> tuple[Float[Array, "nr nr"], Float[Array, "nr nr"]]:
        r"""Gains of the equivalent `HybridForce` law in task coordinates.

        $$K_p' = B^{-1} K_d B K_p, \quad K_d' = K_p + B^{-1} K_d B, \quad B = V_2^T W^T J$$

        Its commanded acceleration is $\ddot x_d - K_d' \dot e - K_p' e$. The two laws then differ only by
        $(\dot B + \Gamma_r B) (\dot e + K_p e)$, a Coriolis force of the composite error. For a number $K_d = k$ these
        are $k K_p$ and $K_p + k$, whatever q.

        **Arguments:** `q` (nq,), on the constraints; `t`, s.

        **Returns:** $K_p'$ (nr, nr) 1/s^2, and $K_d'$ (nr, nr) 1/s. **Raises:** as calls of the law.

        Source: EQUATIONS section 9.
        """
        q, t = check_state(self.scene.system, q=q, t=t)
        # J depends on q and t alone, so that any velocity gives the same.
        J, _, _ = self._reference_motion(q, jnp.zeros((self.scene.nv,), q.dtype), t)
        B = matmul(self._to_quasi_velocities(q, t, J.shape[1]), J)
        kp, kd = as_matrix(self.kp, B[0], "kp"), as_matrix(self.kd, B[0], "kd")
        turned = solve_square(B, matmul(kd, B))
        return matmul(turned, kp), kp + turned

    def _to_quasi_velocities(self, q, t, m: int) -> Float[Array, "nr nv"]:
        """Matrix V2^T W^T from velocities to the m quasi velocities along the constraints."""
        gauge = gauge_invariant(self.scene, q, jnp.zeros((self.scene.nv,), q.dtype), None, t, dof=m)
        return matmul(gauge.V2.T, gauge.W.T)

    def _reference_motion(self, q, v, t):
        """Jacobian J (nv, nr), velocity J s for the reference rates s = xd_d - Kp e, and its rate, (nv,) each."""
        scene, system = independent_rows(self.scene, q, t), self.scene.system
        errors = Scene(system, (self.error,))
        m = self.error.sizes(system, q.dtype)[0]
        # Stacked rows of task and constraints must determine v. More of them than nv are allowed: constraints may be dependent.
        if m + row_count(scene) < scene.nv:
            raise ValueError(
                f"task returned {m} coordinates, and the constraints have {row_count(scene)} rows of nv = {scene.nv}; give as "
                "many coordinates as degrees of freedom"
            )
        # The tangent of t is 1, because constraints and targets may depend on time.
        motion = velocity_to_rate(system, q, v), jnp.ones_like(t)

        def reference(q, t):
            """Reference rates xd_d - Kp e."""
            # At v = 0 the rate of e = x - x_d is -xd_d.
            speed = -rows(errors, q, jnp.zeros_like(v), t).velocity
            return speed - times(self.kp, self.error.position(system, q, t), "kp")  # pyright: ignore[reportArgumentType]

        A, turning = jax.jvp(lambda q, t: constraint_jacobian(scene, q, t), (q, t), motion)
        T, turning_of_task = jax.jvp(lambda q, t: constraint_jacobian(errors, q, t), (q, t), motion)
        # Constraints first: J = d v / d xd is the inverse of the task's rows in the motions that these leave. It is the last
        # columns of the inverse of the stacked rows where that exists; elsewhere J s still satisfies the constraints.
        inverse = pseudo_inverse(A, tolerance(None, A))
        # Rounding errors of rows that depend on the constraints are no directions.
        left = drop_rounding(T - matmul(matmul(T, inverse), A), T)
        J = pseudo_inverse(left, tolerance(None, left))
        s, sdot = jax.jvp(reference, (q, t), motion)
        along = matmul(J, s)
        # The rate of A v = 0, T v = s for v = J s.
        change = -matmul(inverse, matmul(turning, along))
        return J, along, change + matmul(J, sdot - matmul(turning_of_task, along) - matmul(T, change))
