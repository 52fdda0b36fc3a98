"""Control of bodies without motors of their own: a grasped object by the hand, the base of a robot by its legs.

With the acceleration a that satisfies the contacts and the object's error equation, and contact forces that carry the object,

    lam_d = G^+ F_o + (1 - G^+ G) lam_0,    F_o = (M a + h - forces) in the rows of the object,
    tau_f = (M a + h - forces) in the rows of the fingers + J_h^T lam_d.

The full equations are then satisfied by this a with lam = lam_d, uniquely where the rows are independent. For
square J_h it is  tau = J_h^T (G^+ (M~ a_o + C~ V + N~) + lam_N) + ..., computed torque in the object's velocity on SE(3).

Sources: Murray, Li & Sastry (1994), section 6.4 (eqs 6.39-6.41); Li, Hsu & Sastry (1989); EQUATIONS section 10.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Constraint, constraint_jacobian, rows
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.control.errors import (
    CenterError,
    ForceIntegral,
    FrameError,
    Target,
    as_target,
    frame_error,
    gain,
    hierarchical_acceleration,
    target_rows,
    times,
)
from jaxdyn.control.legs import (
    Foot,
    GroundForces,
    LeggedDynamics,
    check_feet,
    missing_wrench,
    passive_velocities,
    underactuated_inverse_dynamics,
)
from jaxdyn.control.motion import torque_for
from jaxdyn.grasp.forces import as_preload, split_forces
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.grasp.motions import velocity_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Number, Numbers, as_number, as_shape, warn
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Force, Scene
from jaxdyn.systems.system import displacement


class ObjectError(Constraint):
    """Displacement (no,) of a grasped object from its target: coordinate differences, or a twist for a free body."""

    target: Callable
    grasp: Grasp
    name: str = eqx.field(static=True, default="object", kw_only=True)

    def position(self, system, q, t):
        """Displacement from the target to the object's configuration."""
        top = self.grasp.system.topology
        place = top.q_slices[top.body_names.index(self.grasp.object)]
        of = f", the coordinates of {self.grasp.object!r}"
        target = as_shape(self.target(t), "target", q.dtype, (place.stop - place.start,), of=of)
        # Only the object's coordinates differ from q, so that its displacement is the only nonzero part.
        wanted = q.at[place].set(target)
        return displacement(system, wanted, q)[velocity_rows(self.grasp)[1]]


class GraspForce(ForceIntegral):
    r"""Motion of a grasped object and internal force.

    $$\ddot e + K_d \dot e + K_p e = 0, \quad (\lambda - \lambda_d) + K_I z = 0$$

    e (no,) is the displacement from the target to the object: differences of its coordinates, and for a planar or free body
    the twist that leads from the target to it. It decays as set by the gains for an exact model; contact forces are those
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
        self.error = ObjectError(as_target(target), grasp)
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
        error = multipliers - as_preload(self.scene, self.preload(t), q.dtype)
        G = constraint_jacobian(self.scene, q, t)[:, velocity_rows(self.scene)[1]].T
        # With zero wrench `split_forces` is the projection on the internal forces.
        return split_forces(G, jnp.zeros((G.shape[0],), q.dtype), error)

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


# Whole-body control of legged robots: centre of mass, attitude of the base and posture.
#
# The acceleration satisfies tasks of three priorities, each in the null space of those before:
#
#     J a = -Jdot v                                   the feet are at rest,
#     c: edd + Kd ed + Kp e = 0,  base: the same      centre of mass and attitude follow their targets,
#     a near -damping v - stiffness (q - posture)     the rest, in the metric M.
#
# Torques and ground forces follow from it (`jaxdyn.control.legs`), inside their cones.


class Attitude(eqx.Module):
    r"""Target of the attitude of a frame, for `WholeBody`, with the gains of the error $\log(R_d^T R)$.

    **Arguments:** `target` R_d (3, 3), or a function of t, differentiable twice; `frame`: a frame or body, by default the model's
    first body; `kp` (1/s^2), `kd` (1/s): positive definite, by default those of the centre of mass.
    """

    target: Callable
    frame: str | None = eqx.field(static=True)
    kp: Array | None
    kd: Array | None

    def __init__(self, target: Target, frame: str | None = None, kp: Numbers | None = None, kd: Numbers | None = None):
        self.target, self.frame = as_target(target), frame
        self.kp, self.kd = (None if k is None else gain(k, f"Attitude: {x}") for k, x in ((kp, "kp"), (kd, "kd")))


def _group_keywords(orientation, forces, old: dict[str, Any]):
    """`orientation` and `forces` of a `WholeBody` from its keywords up to version 0.2, with a warning."""
    known = {"base": "frame", "turn_kp": "kp", "turn_kd": "kd"}
    turn = {new: old.pop(name) for name, new in known.items() if name in old}
    if turn:
        warn(f"WholeBody: give orientation=jd.control.Attitude(target, {', '.join(turn)})", DeprecationWarning)
        orientation = None if orientation is None else Attitude(orientation, **turn)
    if old:
        warn(f"WholeBody: give forces=jd.control.GroundForces({', '.join(old)})", DeprecationWarning)
        forces = GroundForces(**old)
    return orientation, forces


class WholeBody(eqx.Module):
    r"""Control of the centre of mass and the attitude of the base, with ground forces inside their cones.

    $$\ddot e + K_d \dot e + K_p e = 0$$

    tau comes from `jd.control.underactuated_inverse_dynamics` for the acceleration of `acceleration(q, v, t)`. Errors decay
    exactly as set by the gains for an exact model, while the feet are at rest and their forces can give the acceleration.
    The code `dynamics(q, v, t).result` reports this; otherwise forces leave a cone, a simulation of `jd.control.standing`
    ends with `contact_lost`, and `missing_wrench(q, v, t)` gives the remainder. Forces of constrained feet are those of the
    program where their rows are independent: with points, up to three of them or legs of three joints and more.

    **Arguments:**

    - `model`: a `Model`; `contacts`: list of `jd.control.foot(frame, cone)`.
    - `com`: target c_d of the centre of mass, (3,) in world axes, m, or a function of t, differentiable twice.
    - `kp` (1/s^2), `kd` (1/s): of the centre of mass, positive definite: numbers, (3,) or (3, 3).
    - `orientation`: target R_d (3, 3) of the model's first body, or a function of t, with the gains `kp` and `kd`; or an
      `Attitude`, of another frame or with other gains; None: attitudes follow from the posture.
    - `posture` (nq,): equilibrium of the remaining motion. `stiffness` (1/s^2), `damping` (1/s): of it, zero or positive.
    - `forces`: `GroundForces`, the weights and limits of the program for torques and ground forces.

    **Raises:** ValueError for gains that are not positive definite, unknown frames, no list of
    feet or an empty one, a `stiffness` without a posture; (when called) for inconsistent shapes.

    Source: Righetti, Buchli, Mistry, Kalakrishnan & Schaal (2013), section 3; Sentis & Khatib (2005), for the priorities;
    EQUATIONS section 11.

    ```python
    law = jd.control.WholeBody(model, feet, jd.center_of_mass(model, q0), kp=25.0, kd=10.0, orientation=jnp.eye(3), posture=q0)
    jd.simulate(jd.control.standing(model, q0, feet), q0, v0, ts, control=law, outputs=("contact_margins",))
    ```
    """

    model: Model
    feet: tuple[Foot, ...]
    center: CenterError
    kp: Array
    kd: Array
    turn: FrameError | None
    turn_gains: tuple[Array, Array]
    posture: Array | None
    stiffness: Array
    damping: Array
    forces: GroundForces
    passive: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        model: Checked[Model],
        contacts: Checked[Sequence[Foot]],
        com: Numbers,
        kp: Numbers,
        kd: Numbers,
        *,
        orientation: Checked[Target | Attitude | None] = None,
        posture: Numbers | None = None,
        stiffness: Numbers = 0.0,
        damping: Numbers = 1.0,
        forces: GroundForces | None = None,
        **old: Any,
    ):
        orientation, forces = _group_keywords(orientation, forces, old) if old else (orientation, forces)
        turn = orientation if orientation is None or isinstance(orientation, Attitude) else Attitude(orientation)
        self.feet, self.model = check_feet(model, contacts), model
        if not self.feet:
            raise ValueError("contacts is empty; without a foot on the ground nothing moves the centre of mass")
        self.center = CenterError(as_target(com, "com"))
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")
        self.turn, self.turn_gains = None, (self.kp, self.kd)
        if turn is not None:
            self.turn = frame_error(model, turn.frame or model.body_names[0], turn.target, "orientation")
            self.turn_gains = (self.kp if turn.kp is None else turn.kp, self.kd if turn.kd is None else turn.kd)
        dtype = model.inertias.dtype
        self.posture = None if posture is None else jnp.asarray(posture, dtype)
        self.stiffness = as_number(stiffness, "stiffness", zero=True)
        self.damping = as_number(damping, "damping", zero=True)
        self.forces = GroundForces() if forces is None else forces
        self.passive = tuple(passive_velocities(model, self.forces.passive).tolist())
        # A traced stiffness may be positive, so that it needs a posture as well.
        if self.posture is None and not (is_concrete(self.stiffness) and float(self.stiffness) == 0):
            raise ValueError(f"stiffness is {self.stiffness} and posture is None; give the posture (nq,)")
        if self.posture is not None and self.posture.shape != (model.nq,):
            raise ValueError(f"posture has shape {self.posture.shape}, expected {(model.nq,)} = (nq,)")

    def acceleration(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Commanded acceleration, (nv,)."""
        t = jnp.asarray(t, q.dtype)
        rest = -self.damping.astype(v.dtype) * v
        if self.posture is not None:
            rest = rest - self.stiffness.astype(v.dtype) * displacement(self.model, self.posture, q)
        return hierarchical_acceleration(self.model, q, t, self._orders(q, v, t), rest)

    def shortfall(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " m"]:
        """Residual of the tasks, (m,): rows of the centre of mass (m/s^2), then of the attitude (rad/s^2).

        Zero where feet and joints do not restrict the tasks, so that the error equations hold.
        """
        t = jnp.asarray(t, q.dtype)
        # The rows of the feet come first and are satisfied before the tasks: only tasks can fall short.
        A, wanted = self._orders(q, v, t)[1]
        return wanted - matmul(A, self.acceleration(q, v, t))

    def dynamics(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> LeggedDynamics:
        """Torques, ground forces and their margins, with `result` for their feasibility."""
        return underactuated_inverse_dynamics(
            self.model,
            q,
            v,
            self.acceleration(q, v, t),
            list(self.feet),
            passive=self.passive,
            preload=self.forces.preload,
            torque_weight=self.forces.torque_weight,
            force_weight=self.forces.force_weight,
            effort_limit=self.forces.effort_limit,
        )

    def missing_wrench(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " np"]:
        """Remainder of the generalised force at the base, (np,): `jd.control.missing_wrench`."""
        return missing_wrench(self.model, q, v, self.acceleration(q, v, t), list(self.feet), passive=self.passive)

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Joint torques (nv,), N m or N, zero for unactuated velocities."""
        return self.dynamics(q, v, t).tau

    def _orders(self, q, v, t):
        """Rows and right-hand sides of the feet, then of the tasks."""
        # Held at their present poses: the rows fix accelerations only, and do not correct a drift of the feet.
        holds = Scene(self.model, [one.hold(self.model, q) for one in self.feet])
        feet = rows(independent_rows(holds, q, jnp.asarray(t, q.dtype)), q, v, t)
        tasks = [target_rows(self.model, self.center, self.kp, self.kd, q, v, t)]
        if self.turn is not None:
            tasks.append(target_rows(self.model, self.turn, *self.turn_gains, q, v, t))
        A, wanted = (jnp.concatenate(x) for x in zip(*tasks, strict=True))
        return (feet.A, feet.gamma), (A, wanted)


def standing(
    model: Checked[Model],
    q: Float[Array, " nq"],
    contacts: Checked[Sequence[Foot]],
    *,
    forces: Checked[Sequence[Force]] = (),
) -> Scene:
    """Scene with feet fixed at their poses for q (nq,), with their friction cones.

    A simulation ends with `contact_lost` where one of them lifts or slips; outputs "contact_forces" and "contact_margins" are
    by the names of the feet's frames. `forces`: of the scene.

    **Raises:** ValueError for anything but a nonempty list of feet, and unknown frames.
    """
    feet = check_feet(model, contacts)
    if not feet:
        raise ValueError("contacts is empty; use the model itself, or name the feet on the ground")
    return Scene(model, [one.hold(model, q) for one in feet], forces=forces, cones=[one.cone for one in feet])
