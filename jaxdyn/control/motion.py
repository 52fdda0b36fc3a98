"""Laws of free motion: computed torque, operational space, Cartesian stiffness; tasks in contact coordinates.

Each is an equinox Module called as `law(q, v, t) -> tau (nv,)`, as `jd.simulate(control=...)` takes. Gains and
targets are leaves. Sources: Murray, Li & Sastry (1994), section 4.5; Khatib (1987); Hogan (1985); EQUATIONS section 8.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.base import position_residual, rows
from jaxdyn.contact.contact_equations import contact_coordinates
from jaxdyn.contact.surfaces import Surface, check_surface
from jaxdyn.control.errors import (
    ConfigurationError,
    FrameError,
    Target,
    as_target,
    frame_error,
    gain,
    hierarchical_acceleration,
    target_rows,
    times,
)
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import gravity_force, inverse_dynamics
from jaxdyn.lie import se3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike, as_float, as_number, state_dtype
from jaxdyn.model.host_math import pose_leaf
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, displacement, has_coordinate_rates, velocity_to_rate


class ComputedTorque(eqx.Module):
    r"""Computed torque.

    $$\tau = M(q) a + C(q, v) v + N(q) - \tau_\mathrm{forces}, \quad \ddot e + K_d \dot e + K_p e = 0$$

    e (nv,) is the displacement from the target to q: q - q_d, and for planar, spherical and free joints the twist from
    the target to q. Each error decays exactly as set by the gains for an exact model: for scalar gains
    with the roots of $s^2 + k_d s + k_p$. The twist is discontinuous at an error of half a turn.

    **Arguments:**

    - `scene`: a model or another system, or a scene without constraints, whose forces are then compensated.
    - `target`: q_d (nq,), or a function q_d(t), differentiable twice; unit quaternions.
    - `kp` (1/s^2), `kd` (1/s): numbers, (nv,), or positive definite matrices (nv, nv).

    **Raises:** ValueError for gains that are not positive definite and for a scene with constraints; (when called) for
    inconsistent shapes.

    Source: Murray, Li & Sastry (1994), eq. 4.47; EQUATIONS section 8 without constraints.

    ```python
    law = jd.control.ComputedTorque(model, lambda t: jnp.sin(t) * q1, kp=25.0, kd=10.0)
    jd.simulate(model, q0, v0, ts, control=law)
    ```
    """

    scene: Scene
    target: Callable
    kp: Array
    kd: Array

    def __init__(self, scene: SceneLike, target: Target, kp: Numbers, kd: Numbers):
        self.scene = unconstrained(scene)
        self.target = as_target(target)
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N."""
        t = jnp.asarray(t, q.dtype)
        system = self.scene.system
        error = ConfigurationError(self.target)
        A, a = target_rows(system, error, self.kp, self.kd, q, v, t)
        # For v = dq/dt the rows are the unit matrix, and the right-hand side is the acceleration itself.
        if not has_coordinate_rates(system):
            a = hierarchical_acceleration(system, q, t, [(A, a)], jnp.zeros_like(v))
        return torque_for(self.scene, q, v, a, t)


class OperationalSpace(eqx.Module):
    r"""Operational space: linear error dynamics of a frame, with damped motion of the null space.

    $$\ddot e + K_d \dot e + K_p e = 0, \quad \tau = M a + h - \tau_\mathrm{forces}$$

    $$a = \bar J x^* + (1 - \bar J J) a_0, \quad \bar J = M^{-1} J^T (J M^{-1} J^T)^{-1}$$

    is the acceleration closest, in the metric M, to $a_0$ = -damping v - stiffness (displacement from the posture), where $x^*$
    is the value of $J a$ that the error dynamics require. The null motion does not disturb the task.
    Where J loses rank the task is dropped along the singular direction.

    **Arguments:**

    - `scene`: a `Model`, or a scene of one without constraints, whose forces are then compensated.
    - `frame`: name of the frame; `task`: "position" (error in world axes, m), "orientation" (log(R_d^T R), rad) or "pose".
    - `target`: (3,), (3, 3) or (4, 4) by the task, or a function of t that returns it, differentiable twice.
    - `kp` (1/s^2), `kd` (1/s): numbers, (m,), or positive definite matrices.
    - `damping` (1/s), `stiffness` (1/s^2) of the null motion, zero or positive; `posture` (nq,): its equilibrium.

    **Raises:** ValueError for gains that are not positive definite, unknown frames and tasks, a scene with constraints, a
    `stiffness` without a posture; (when called) for inconsistent shapes.

    Source: Khatib (1987), eqs 20 and 52; EQUATIONS section 10, workspace dynamics.
    """

    scene: Scene
    error: FrameError
    kp: Array
    kd: Array
    damping: Array
    stiffness: Array
    posture: Array | None

    def __init__(
        self,
        scene: SceneLike,
        frame: str,
        target: Target,
        kp: Numbers,
        kd: Numbers,
        *,
        task: str = "pose",
        damping: Numbers = 1.0,
        stiffness: Numbers = 0.0,
        posture: Numbers | None = None,
    ):
        self.scene = unconstrained(scene)
        self.error = frame_error(self.scene.system, frame, target, task)
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")
        self.damping = as_number(damping, "damping", zero=True)
        self.stiffness = as_number(stiffness, "stiffness", zero=True)
        self.posture = None if posture is None else as_float(posture, "posture", like=state_dtype(self.scene.system))

    def __check_init__(self):
        if self.posture is not None and self.posture.shape != (self.scene.nq,):
            raise ValueError(f"posture has shape {self.posture.shape}, expected {(self.scene.nq,)} = (nq,)")

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N."""
        system, t = self.scene.system, jnp.asarray(t, q.dtype)
        task = target_rows(system, self.error, self.kp, self.kd, q, v, t)
        rest = -self.damping.astype(v.dtype) * v
        if self.posture is not None:
            # Along the manifold: a difference of unit quaternions is no displacement.
            rest = rest - self.stiffness.astype(v.dtype) * displacement(system, self.posture, q)
        return torque_for(self.scene, q, v, hierarchical_acceleration(system, q, t, [task], rest), t)


class CartesianStiffness(eqx.Module):
    r"""Cartesian stiffness and damping of a frame.

    $$\tau = N(q) - J^T (K e + D \dot e) - d v$$

    with the `joint_damping` d. No inertia is cancelled, so the arm is passive for a fixed target: the energy
    $T + \tfrac12 e^T K e$ decreases at the rate $\dot e^T D \dot e + d v^T v$. At rest under a force F, along the rows of
    the error, the deflection solves $K e = F$.

    **Arguments:**

    - `model`: a `Model`; `frame`, `task`, `target` as in `OperationalSpace`.
    - `stiffness` K (N/m, N m/rad) and `damping` D (N s/m, N m s/rad): numbers, (m,), or positive definite matrices.
    - `joint_damping` (N m s/rad or N s/m), zero or positive: of the null motion.

    **Raises:** ValueError for gains that are not positive definite, unknown frames and tasks; (when called) for
    inconsistent shapes.

    Source: Hogan (1985), part I; Murray, Li & Sastry (1994), section 4.6.
    """

    model: Any
    error: FrameError
    stiffness: Array
    damping: Array
    joint_damping: Array

    def __init__(
        self,
        model: SystemLike,
        frame: str,
        target: Target,
        stiffness: Numbers,
        damping: Numbers,
        *,
        task: str = "pose",
        joint_damping: Numbers = 0.0,
    ):
        self.model = model
        self.error = frame_error(model, frame, target, task)
        self.stiffness, self.damping = gain(stiffness, "stiffness"), gain(damping, "damping")
        self.joint_damping = as_number(joint_damping, "joint_damping", zero=True)

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N."""
        scene, t = Scene(self.model, (self.error,)), jnp.asarray(t, q.dtype)
        row, error = rows(scene, q, v, t), position_residual(scene, q, t)
        # The rows are the derivative of e, so that A^T K e is the gradient of the potential e . K e / 2.
        push = times(self.stiffness, error, "stiffness") + times(self.damping, row.velocity, "damping")
        # Gravity alone is compensated. Cancelling inertia or Coriolis forces would cost the passivity.
        return gravity_force(self.model, q, t) - matmul(row.A.T, push) - self.joint_damping.astype(v.dtype) * v


def unconstrained(scene: Any) -> Scene:
    """Require a scene without constraints. **Raises:** ValueError for one with some."""
    scene = as_scene(scene)
    if scene.constraints:
        raise ValueError(
            f"scene has {len(scene.constraints)} constraints, whose forces this law does not model; use "
            "jd.control.HybridForce or jd.control.GaugeInvariant"
        )
    return scene


def torque_for(scene: Scene, q, v, a, t) -> Float[Array, " nv"]:
    """Torques M a + h minus the scene's forces, (nv,), for the acceleration a without constraint forces."""
    # The motors supply what the scene's forces do not.
    tau, force = inverse_dynamics(scene.system, q, v, a, t), scene.applied_force(q, v, t)
    return tau if force is None else tau - force


class ContactCoordinates(eqx.Module):
    r"""Contact coordinates of a fingertip on an object at rest, as tasks of `HybridForce`.

    As a function of q it is eta = (u_o, v_o, u_f, v_f, psi) (5,): the task of a tip that slides, five coordinates of the
    motion free in a frictionless contact. `rolling` is $\dot\alpha_f$ (2,), the rates of (u_f, v_f): the task of
    velocities of a tip that rolls without spin. The laws are then, with the rows $J_F$ of Montana's equations
    (`jd.contact.montana`) and M, C, N of the arm in the twist of the tip,

    $$F_m = M J_F (\ddot\eta_d - K_d \dot e - K_p e) + (M \dot J_F + C J_F) \dot\eta + N + A^T (-\lambda_d + K_I z), \quad
    \tau = J^T F_m,$$

    and the same with $J_f \dot\alpha_f$ in place of $J_F \dot\eta$ for a tip that rolls.

    **Arguments:** `model`: a `Model`; `frame`: the tip's, a body or frame; `object`, `finger`: surfaces
    (`jd.contact.Sphere` ...) of the object and of the tip, each in its frame; `pose`: of the
    object's frame in the world, (4, 4), (3,), (xyz, rpy) or None.

    **Raises:** ValueError for an invalid model, surface or pose and an unknown frame; (when called) as
    `jd.contact.contact_coordinates`.

    ```python
    task = jd.control.ContactCoordinates(model, "tip", jd.contact.Sphere(0.15, poles="y"), jd.contact.Sphere(0.03), center)
    law = jd.control.HybridForce(scene, task, goal, kp=6.0, kd=5.0, force=[5.0])
    law = jd.control.HybridForce(scene, task.rolling, rates, kp=4.0, of="velocity", force=[5.0, 0.0, 0.0, 0.0])
    ```

    Source: EQUATIONS section 8, errata E21 and E22.
    """

    model: Model
    frame: str = eqx.field(static=True)
    object: Surface
    finger: Surface
    pose: Float[Array, "4 4"]

    def __init__(
        self,
        model: Checked[Model],
        frame: str,
        object: Checked[Surface],
        finger: Checked[Surface],
        pose: Numbers | None = None,
    ):
        if not isinstance(model, Model):
            raise ValueError(f"model is a {type(model).__name__}, which has no named frames; pass a Model")
        # Refuses an unknown frame at construction, and not when the law is traced.
        frame_index(model, frame)
        for surface in (object, finger):
            check_surface(surface)
        self.model, self.frame, self.object, self.finger = model, frame, object, finger
        self.pose = pose_leaf(pose, "ContactCoordinates: pose")

    def __call__(self, q: Float[Array, " nq"]) -> Float[Array, "5"]:
        """Contact coordinates eta (5,), in the units of the charts and rad."""
        # The object is at rest: the pose of the tip in its axes depends on q through the arm alone.
        seen = matmul(se3.inverse(self.pose.astype(q.dtype)), frame_pose(self.model, q, self.frame))
        return contact_coordinates(self.object, self.finger, seen)

    def rolling(self, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, "2"]:
        """Rates (2,) of the contact point on the tip, in the units of its chart per second."""
        # eta = (u_o, v_o, u_f, v_f, psi). One derivative along the motion replaces the Jacobian of all five coordinates.
        return jax.jvp(self, (q,), (velocity_to_rate(self.model, q, v),))[1][2:4]
