"""Control of the whole body of a robot with legs: its centre of mass, the attitude of its base and its posture.

The acceleration is asked for in three orders, each as far as those before leave it free:

    J a = -Jdot v                                   the feet stay where they are,
    c: edd + Kd ed + Kp e = 0,  base: the same      centre of mass and attitude follow their targets,
    a near -damping v - stiffness (q - posture)     the rest, in the metric M.

Torques and forces of the feet follow from it (`jaxdyn.control.legs`), the forces inside their cones.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import is_concrete
from jaxdyn.constraints.base import Constraint, rows
from jaxdyn.control.errors import FrameError, as_target, frame_error, ordered_acceleration, placed, wanted_rows
from jaxdyn.control.feet import Foot, check_feet
from jaxdyn.control.gains import gain, non_negative
from jaxdyn.control.legs import LeggedDynamics, missing_wrench, passive_velocities, underactuated_inverse_dynamics
from jaxdyn.dynamics.centroidal import center_of_mass
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Checked, Number, Numbers
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Force, Scene
from jaxdyn.systems.system import displacement


class CenterError(Constraint):
    """The centre of mass less its target, (3,), m, in world axes."""

    target: Callable
    name: str = eqx.field(static=True, default="centre of mass")

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, "3"]:
        """c(q) - c_d(t)."""
        return center_of_mass(system, q) - placed(self.target, t, (3,), q)


class WholeBody(eqx.Module):
    """Centre of mass and attitude of the base by  edd + Kd ed + Kp e = 0, the forces of the feet inside their cones.

    tau comes from `jd.underactuated_inverse_dynamics` for the acceleration of `acceleration(q, v, t)`. Errors decay exactly as
    the gains say where the model is that of the plant, the feet stay, and their forces can give the acceleration. Whether they
    can is told by `dynamics(q, v, t).result`; where they cannot, forces leave a cone, a simulation of `jd.control.standing`
    ends with `contact_lost`, and `missing_wrench(q, v, t)` says what is missing. Forces of feet that are held are those of
    the program where their rows are independent: with points, up to three of them or legs of three joints and more.

    **Arguments:**

    - `model`: a `Model`; `contacts`: list of `jd.control.foot(frame, cone)`.
    - `com`: target c_d of the centre of mass, (3,) in world axes, m, or a function of t, differentiable twice.
    - `kp` (1/s^2), `kd` (1/s): of the centre of mass, positive definite: numbers, (3,) or (3, 3).
    - `orientation`: target R_d (3, 3) of the frame `base`, or a function of t; None: its attitude is left to the posture.
      `base`: name of a frame or body, by default the model's first body. `turn_kp`, `turn_kd`: its gains, of the error
      log(R_d^T R); by default `kp` and `kd`.
    - `posture` (nq,): where the rest of the motion rests, with `stiffness` (1/s^2) and `damping` (1/s), zero or positive.
    - `preload` (), N; `torque_weight`, `force_weight`, `effort_limit`, `passive`: of `jd.underactuated_inverse_dynamics`.

    **Raises:** ValueError for gains that are not positive definite, frames that the model does not have, what is no list of
    feet or an empty one, a `stiffness` without a posture; (when called) for shapes that do not fit.

    Source: Righetti, Buchli, Mistry, Kalakrishnan & Schaal (2013), section 3; Sentis & Khatib (2005), for the orders;
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
        self.stiffness, self.damping = non_negative(stiffness, "stiffness"), non_negative(damping, "damping")
        self.preload = non_negative(preload, "preload")
        self.torque_weight = non_negative(torque_weight, "torque_weight")
        self.force_weight = non_negative(force_weight, "force_weight")
        self.effort_limit = None if effort_limit is None else jnp.asarray(effort_limit, dtype)
        self.passive = tuple(passive_velocities(model, passive).tolist())
        if self.posture is None and not (is_concrete(self.stiffness) and float(self.stiffness) == 0):
            raise ValueError(f"stiffness is {self.stiffness} and posture is None; give the posture (nq,)")
        if self.posture is not None and self.posture.shape != (model.nq,):
            raise ValueError(f"posture has shape {self.posture.shape}, expected {(model.nq,)} = (nq,)")

    def acceleration(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """The acceleration that the law asks for, (nv,)."""
        t = jnp.asarray(t, q.dtype)
        rest = -self.damping.astype(v.dtype) * v
        if self.posture is not None:
            rest = rest - self.stiffness.astype(v.dtype) * displacement(self.model, self.posture, q)
        return ordered_acceleration(self.model, q, t, self._orders(q, v, t), rest)

    def shortfall(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " m"]:
        """What the acceleration leaves of the tasks, (m,): rows of the centre of mass (m/s^2), then of the attitude (rad/s^2).

        Zero where the feet and the joints leave the tasks free, so that the law can do what it promises.
        """
        t = jnp.asarray(t, q.dtype)
        A, wanted = self._orders(q, v, t)[1]
        return wanted - _product(A, self.acceleration(q, v, t))

    def dynamics(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> LeggedDynamics:
        """Torques, forces of the feet and their margins, and whether the feet can carry what is asked (`result`)."""
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
        """What feet in their cones leave of the generalised force at the base, (np,): `jd.control.missing_wrench`."""
        return missing_wrench(self.model, q, v, self.acceleration(q, v, t), list(self.feet), passive=self.passive)

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Float[Array, " nv"]:
        """Torques (nv,), N m or N: zero where there is no motor."""
        return self.dynamics(q, v, t).tau

    def _orders(self, q, v, t):
        """Rows and right sides of the feet, then of the tasks."""
        feet = rows(Scene(self.model, [one.hold(self.model, q) for one in self.feet]), q, v, t)
        tasks = [wanted_rows(self.model, self.center, self.kp, self.kd, q, v, t)]
        if self.turn is not None:
            tasks.append(wanted_rows(self.model, self.turn, self.turn_kp, self.turn_kd, q, v, t))
        A, wanted = (jnp.concatenate(x) for x in zip(*tasks, strict=True))
        return (feet.A, feet.gamma), (A, wanted)


def standing(
    model: Checked[Model],
    q: Float[Array, " nq"],
    contacts: Checked[Sequence[Foot]],
    *,
    forces: Checked[Sequence[Force]] = (),
) -> Scene:
    """A scene in which feet are held where they are at q (nq,), with their friction cones.

    A simulation ends with `contact_lost` where one of them pulls or slips; outputs "contact_forces" and "contact_margins" are
    by the names of the feet's frames. `forces`: of the scene.

    **Raises:** ValueError for what is no list of feet, or an empty one, and frames that the model does not have.
    """
    feet = check_feet(model, contacts)
    if not feet:
        raise ValueError("contacts is empty; take the model itself, or name the feet that stand on the ground")
    return Scene(model, [one.hold(model, q) for one in feet], forces=forces, cones=[one.cone for one in feet])
