"""Whole-body control of legged robots: centre of mass, attitude of the base and posture.

The acceleration satisfies tasks of three priorities, each in the null space of those before:

    J a = -Jdot v                                   the feet are at rest,
    c: edd + Kd ed + Kp e = 0,  base: the same      centre of mass and attitude follow their targets,
    a near -damping v - stiffness (q - posture)     the rest, in the metric M.

Torques and ground forces follow from it (`jaxdyn.control.legs`), inside their cones.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import rows
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.control.errors import (
    CenterError,
    FrameError,
    as_target,
    frame_error,
    gain,
    hierarchical_acceleration,
    target_rows,
)
from jaxdyn.control.legs import (
    Foot,
    LeggedDynamics,
    check_feet,
    missing_wrench,
    passive_velocities,
    underactuated_inverse_dynamics,
)
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Number, Numbers
from jaxdyn.model.numbers import as_number
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Force, Scene
from jaxdyn.systems.system import displacement


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
    - `orientation`: target R_d (3, 3) of the frame `base`, or a function of t; None: its attitude follows from the posture.
      `base`: name of a frame or body, by default the model's first body. `turn_kp`, `turn_kd`: its gains, of the error
      $\log(R_d^T R)$; by default `kp` and `kd`.
    - `posture` (nq,): equilibrium of the remaining motion. `stiffness` (1/s^2), `damping` (1/s): of it, zero or positive.
    - `preload` (), N; `torque_weight`, `force_weight`, `effort_limit`, `passive`: of `jd.control.underactuated_inverse_dynamics`.

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
    turn: FrameError | None
    kp: Array
    kd: Array
    turn_kp: Array
    turn_kd: Array
    posture: Array | None
    stiffness: Array
    damping: Array
    preload: Array
    torque_weight: Array
    force_weight: Array
    effort_limit: Array | None
    passive: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        model: Checked[Model],
        contacts: Checked[Sequence[Foot]],
        com: Numbers,
        kp: Numbers,
        kd: Numbers,
        *,
        orientation: Numbers | None = None,
        base: str | None = None,
        turn_kp: Numbers | None = None,
        turn_kd: Numbers | None = None,
        posture: Numbers | None = None,
        stiffness: Numbers = 0.0,
        damping: Numbers = 1.0,
        preload: Numbers = 0.0,
        torque_weight: Numbers = 1.0,
        force_weight: Numbers = 1e-3,
        effort_limit: Numbers | None = None,
        passive: Checked[Sequence[int] | None] = None,
    ):
        self.feet, self.model = check_feet(model, contacts), model
        if not self.feet:
            raise ValueError("contacts is empty; without a foot on the ground nothing moves the centre of mass")
        self.center = CenterError(as_target(com, "com"))  # pyright: ignore[reportCallIssue]
        frame = model.body_names[0] if base is None else base
        self.turn = None if orientation is None else frame_error(model, frame, orientation, "orientation")
        self.kp, self.kd = gain(kp, "kp"), gain(kd, "kd")
        self.turn_kp = self.kp if turn_kp is None else gain(turn_kp, "turn_kp")
        self.turn_kd = self.kd if turn_kd is None else gain(turn_kd, "turn_kd")
        dtype = model.inertias.dtype
        self.posture = None if posture is None else jnp.asarray(posture, dtype)
        self.stiffness = as_number(stiffness, "stiffness", zero=True)
        self.damping = as_number(damping, "damping", zero=True)
        self.preload = as_number(preload, "preload", zero=True)
        self.torque_weight = as_number(torque_weight, "torque_weight", zero=True)
        self.force_weight = as_number(force_weight, "force_weight", zero=True)
        self.effort_limit = None if effort_limit is None else jnp.asarray(effort_limit, dtype)
        self.passive = tuple(passive_velocities(model, passive).tolist())
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
            preload=self.preload,
            torque_weight=self.torque_weight,
            force_weight=self.force_weight,
            effort_limit=self.effort_limit,
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
            tasks.append(target_rows(self.model, self.turn, self.turn_kp, self.turn_kd, q, v, t))
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
