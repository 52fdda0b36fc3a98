"""Drives whose torque follows the command with dynamics, elastic joints between a motor and a link, and dissipative forces.

These are Rayleigh's dissipation function, and Coulomb friction for sliding in a given direction.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.dynamics.tree_frames import take
from jaxdyn.forces.elements import as_leaf, as_names, broadcast_leaf, is_positive, joint_indices, scatter
from jaxdyn.forces.piecewise import PiecewiseForce
from jaxdyn.model.arguments import (
    Checked,
    Function,
    Number,
    Numbers,
    SystemLike,
    as_array,
    as_float,
    check_name,
    check_names,
    is_concrete,
)
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.joining import join
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import DriveDynamics, Scene, as_pytree


class _Lag(DriveDynamics):
    """Drives whose torque follows the command of some joints, all others being without delay."""

    initial: eqx.AbstractVar[Array]
    joints: eqx.AbstractVar[tuple[str, ...] | None]

    def start(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """Torques `initial` at rest."""
        size = joint_indices(system, self.joints, type(self).__name__).v.size
        return broadcast_leaf(self.initial, v, size, f"{type(self).__name__}: initial")

    def torque(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " nv"]:
        """The torques among the states, and the commands of other joints."""
        index = joint_indices(system, self.joints, type(self).__name__).v
        # Torques come first in the state; a drive of second order has their rates after them.
        return scatter(state[: index.size], index, command)

    def _error(self, system, state, command):
        """Commands less torques of the drives (n,), and a function that broadcasts a leaf to (n,)."""
        index, name = joint_indices(system, self.joints, type(self).__name__).v, type(self).__name__
        error = take(command, index) - state[: index.size]
        return error, lambda leaf: broadcast_leaf(getattr(self, leaf), state, index.size, f"{name}: {leaf}")


class FirstOrderDrive(_Lag):
    r"""First-order drive, with u the command and tau the torque at the joint.

    $$T \dot\tau = u - \tau$$

    The step response is $\tau = u (1 - e^{-t/T})$. It models a current loop of bandwidth $1/(2 \pi T)$ Hz, and MuJoCo's
    activation `filter` of a motor.

    **Arguments:** `time_constant` T (s), positive, and `initial` torque (N m or N): numbers or one per coordinate. `joints`,
    their names, or None for all; commands of the others pass at once.

    **Raises:** ValueError for a T that is not positive; (when called) for unknown joints or a wrong shape.

    ```python
    scene = jd.Scene(model, forces=[jd.forces.FirstOrderDrive(0.01), jd.forces.EffortLimits()])
    step = jd.stepper(scene, dt=0.002)
    state = step((q, v, scene.drive_state(q, v)), jnp.full(7, 5.0))
    ```
    """

    time_constant: Float[Array, "..."] = eqx.field(converter=as_leaf("time_constant"))
    initial: Float[Array, "..."] = eqx.field(converter=as_leaf("initial"), default=0.0)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __check_init__(self):
        # The rate divides by T: for no delay leave the drive out of the scene.
        if not is_positive(self.time_constant):
            raise ValueError(f"FirstOrderDrive: time_constant is {self.time_constant}; give positive seconds")

    def rate(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " n"]:
        r"""Rate of the torque.

        $$\dot\tau = (u - \tau) / T$$
        """
        error, leaf = self._error(system, state, command)
        return error / leaf("time_constant")


class SecondOrderDrive(_Lag):
    r"""Second-order drive, with u the command and tau the torque at the joint.

    $$\ddot\tau + 2 \zeta \omega \dot\tau + \omega^2 \tau = \omega^2 u$$

    The states are $\tau$, then $\dot\tau$. With $\zeta < 1$ the step response overshoots by
    $\exp(-\pi \zeta / \sqrt{1 - \zeta^2})$.

    **Arguments:** `frequency` $\omega$ (rad/s) and `damping_ratio` $\zeta$, positive, and `initial` torque (N m or N, at rest):
    numbers or one per coordinate. `joints` as of `FirstOrderDrive`.

    **Raises:** ValueError for numbers that are not positive; (when called) for unknown joints or a wrong shape.

    ```python
    scene = jd.Scene(model, forces=[jd.forces.SecondOrderDrive(200.0, 0.7)])
    motion = jd.simulate(scene, q, v, jnp.linspace(0.0, 0.1, 11), outputs=("torque", "drive_state"))
    ```
    """

    frequency: Float[Array, "..."] = eqx.field(converter=as_leaf("frequency"))
    damping_ratio: Float[Array, "..."] = eqx.field(converter=as_leaf("damping_ratio"), default=1.0)
    initial: Float[Array, "..."] = eqx.field(converter=as_leaf("initial"), default=0.0)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __check_init__(self):
        for name in ("frequency", "damping_ratio"):
            if not is_positive(getattr(self, name)):
                raise ValueError(f"SecondOrderDrive: {name} is {getattr(self, name)}; give positive numbers")

    def start(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """Torques `initial`, then their rates, zero."""
        torque = super().start(system, q, v, t)
        return jnp.concatenate([torque, jnp.zeros_like(torque)])

    def rate(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " n"]:
        r"""Rates of the torque and of its rate.

        $$(\dot\tau, \omega^2 (u - \tau) - 2 \zeta \omega \dot\tau)$$
        """
        # The state is (tau, tau'), both of the selected joints.
        error, leaf = self._error(system, state, command)
        frequency, speed = leaf("frequency"), state[error.shape[0] :]
        return jnp.concatenate([speed, frequency * (frequency * error - 2 * leaf("damping_ratio") * speed)])


class ElasticTransmission(eqx.Module):
    r"""Spring and damper between motors and joints.

    $$s = \theta/n - q, \quad \tau = K s + D \dot s$$

    $\tau$ acts on the joint and $-\tau/n$ on the motor; $\theta$ is the motor's own angle and n the gear ratio, whose
    sign is that of the direction of rotation. It conserves the energy $K s^2/2$ and dissipates $D \dot s^2$. Steps must
    resolve the frequency $\sqrt{K (1/I + 1/(n^2 B))}$, with B and I the inertias of motor and link; `jd.solvers.Rodas5P`
    has longer ones where the elastic motion has died out.

    **Arguments:** `motors`, `joints`, names of joints of one coordinate, in pairs; `stiffness` K (N m/rad or N/m), `damping` D
    (N m s/rad or N s/m), `gear` n (1, or rad/m for a spindle): numbers or one per pair.

    **Raises:** ValueError for names that are no pairs, a gear ratio of zero; (when called) for unknown joints, joints of several
    coordinates, a wrong shape.

    Source: Spong (1987), ASME J. Dyn. Sys. Meas. Control 109, eq. 13; De Luca & Book, Springer Handbook of Robotics, ch. 11.
    """

    motors: tuple[str, ...] = eqx.field(static=True, converter=partial(check_names, what="motors"))
    joints: tuple[str, ...] = eqx.field(static=True, converter=partial(check_names, what="joints"))
    stiffness: Float[Array, "..."] = eqx.field(converter=as_leaf("stiffness"))
    damping: Float[Array, "..."] = eqx.field(converter=as_leaf("damping"), default=0.0)
    gear: Float[Array, "..."] = eqx.field(converter=as_leaf("gear"), default=1.0)

    def __check_init__(self):
        if len(self.motors) != len(self.joints):
            raise ValueError(
                f"ElasticTransmission: {len(self.motors)} motors for {len(self.joints)} joints; give pairs"
            )
        # The sign of n is a direction of rotation; only zero is refused.
        if not is_positive(self.gear**2):
            raise ValueError(f"ElasticTransmission: gear is {self.gear}; give ratios that are not zero")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        n = len(self.joints)
        motor, joint = (joint_indices(system, names, "ElasticTransmission") for names in (self.motors, self.joints))
        if any(len(index) != n for index in (*motor, *joint)):
            raise ValueError("ElasticTransmission: motors and joints have one coordinate each")
        stiffness, damping, gear = (
            broadcast_leaf(value, q, n, f"ElasticTransmission: {name}")
            for name, value in (("stiffness", self.stiffness), ("damping", self.damping), ("gear", self.gear))
        )
        # Both are at the joint: the motor's angle is divided by the gear ratio.
        stretch, rate = (x[a] / gear - x[b] for x, a, b in ((q, motor.q, joint.q), (v, motor.v, joint.v)))
        tau = stiffness * stretch + damping * rate
        # tau/n on the motor, so that the transmission conserves power. `add` sums over pairs that share a motor or a joint.
        return jnp.zeros_like(v).at[joint.v].add(tau).at[motor.v].add(-tau / gear)


def elastic_joints(
    model: Checked[Model],
    stiffness: Numbers,
    rotor_inertia: Numbers,
    *,
    damping: Numbers = 0.0,
    gear: Numbers = 1.0,
    joints: Checked[str | Sequence[str] | None] = None,
    suffix: str = "_motor",
) -> Scene:
    r"""Robot with elastic joints: a scene with a rotor for each of them behind the model's coordinates, and the springs.

    $$M(q) \ddot q + h(q, \dot q) = K (\theta/n - q) + D (\dot\theta/n - \dot q) = \tau_s, \quad
        B \ddot\theta + \tau_s/n = \tau$$

    The scene's q is (model's q, theta) and v is (model's v, rate of theta); torques of the motors are the last
    entries of tau. The kinetic energy of a rotor is that of its own rotation, $B \dot\theta^2/2$; its mass belongs to
    the link that carries it. Spong's model neglects the coupling with that link's rotation, which is of the order of
    1/n: where it matters, add rotors as bodies on their links by a `ModelBuilder`, and `ElasticTransmission` to the
    scene.

    **Arguments:**

    - `model`: the robot with rigid joints. Its `armature` is that of the link side: leave the rotors' out.
    - `stiffness` K, `damping` D, `gear` n: as of `ElasticTransmission`.
    - `rotor_inertia` B, kg m^2, about the rotor's own axis, before the gear: a number or one per joint.
    - `joints`: names of joints of one coordinate; None for all.
    - `suffix`: of the rotors' names behind those of the joints.

    **Returns:** `Scene` of the joined model, without effort limits and joint limits of the rotors. Add forces by
    `jd.Scene(scene.system, forces=(*scene.forces, ...))`. K, D, n are leaves of `scene.forces[0]`, B of `system.armature`.

    **Raises:** ValueError for unknown joints and those of several coordinates, and for rotors without inertia.

    ```python
    scene = jd.forces.elastic_joints(jd.robots.iiwa(), 1e4, 3e-5, damping=5.0, gear=100.0)
    ```
    """
    chosen = as_names(joints) or model.joint_names
    # Called for its message on unknown joints.
    joint_indices(model, chosen, "elastic_joints")
    kinds = dict(zip(model.joint_names, model.topology.kinds, strict=True))
    if several := [name for name in chosen if KINDS[kinds[name]].nv != 1]:
        raise ValueError(f"elastic_joints: {several} have several coordinates; name joints of one")
    if not is_positive(rotor_inertia):
        raise ValueError(f"elastic_joints: rotor_inertia is {rotor_inertia}; give positive inertias (kg m^2)")
    check_name(suffix, "elastic_joints: suffix")
    motors = tuple(f"{name}{suffix}" for name in chosen)
    inertias = jnp.broadcast_to(jnp.asarray(rotor_inertia, float), (len(chosen),))
    whole = model
    for motor, inertia in zip(motors, inertias, strict=True):
        rotor = ModelBuilder(motor, gravity=model.gravity, dtype=model.home.dtype)
        # No mass and an armature alone: the rotor's mass belongs to the link that carries it.
        rotor.add_body(motor, None, "continuous", joint_name=motor, armature=inertia)
        whole = join(whole, rotor.build(), name=model.name)
    return Scene(whole, forces=(ElasticTransmission(motors, chosen, stiffness, damping, gear),))


# --- dissipative forces: Rayleigh's dissipation function, and Coulomb friction for sliding in a given direction ---


class RayleighDissipation(eqx.Module):
    r"""Dissipative force of a dissipation function R.

    $$\tau = -\frac{\partial R}{\partial v}$$

    The dissipated power is $v^T \partial R / \partial v$: 2R where R is quadratic in v, (n + 1) R where it is of degree n + 1.

    **Arguments:** `function`, R(q, v, t) -> () in W, differentiable; a plain function is static, a Module or
    `jax.tree_util.Partial` carries numbers as leaves.

    **Raises:** ValueError for a function that cannot be called; (when called) one that does not return one number.

    Source: Goldstein, Classical Mechanics, section 1.5.
    """

    function: Callable

    def __init__(self, function: Function):
        self.function = as_pytree(function, "RayleighDissipation: function", "q, v, t")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        def value(v):
            # The function may return a Python integer, which `jax.grad` refuses.
            R = as_array(self.function(q, v, t), "RayleighDissipation: function", v.dtype)
            if R.shape != ():
                raise ValueError(f"RayleighDissipation: function returned shape {R.shape}; return one number, ()")
            return R

        return -jax.grad(value)(v)


# Rounding of a velocity of about 100 m/s (rad/s), times eps: a sliding velocity that ends at zero within it is no reversal.
_ROUNDING = 100.0


class SlidingFriction(PiecewiseForce):
    r"""Coulomb friction of a sliding contact.

    $$\tau = -\operatorname{sign}(A v) \mu N A^T$$

    A v is the sliding velocity. At A v = 0 the sign is that of `direction`, so that the force is smooth while the contact
    slides that way and where it comes to rest. After a reversal the force opposes the new direction. Sticking is not
    modelled: fixed steps change the sign of the force from step to step, so that velocities stay as small as a step's
    change; adaptive ones end the run with the code `too_many_events`.

    **Arguments:**

    - `coefficient`: mu.
    - `normal`: N, in N, a number or a function normal(system, q, v, t) -> (); where it is negative there is no friction.
    - `direction`: 1 or -1, the sign of A v at the start and where it is zero.
    - `along`: index of the sliding coordinate, or a function A(q, t) -> (nv,).

    **Raises:** ValueError for another direction, a negative coefficient or normal force, an invalid index; (when called)
    for one beyond the system's velocities, and for shapes that do not fit.

    Source: EQUATIONS section 11 and erratum E42.
    """

    coefficient: Float[Array, ""]
    normal: Any
    direction: int = eqx.field(static=True)
    along: Any

    def __init__(
        self,
        coefficient: Numbers,
        normal: Checked[Number | Function],
        direction: int,
        along: Checked[int | Function] = 0,
    ):
        if direction not in (1, -1):
            raise ValueError(
                f"SlidingFriction: direction is {direction!r}; give the sign of the sliding velocity, 1 or -1"
            )
        if is_concrete(coefficient) and not (np.asarray(coefficient) >= 0).all():
            raise ValueError(f"SlidingFriction: coefficient is {coefficient}; give mu >= 0 and reverse direction")
        if not callable(normal) and is_concrete(normal) and not (np.asarray(normal) >= 0).all():
            raise ValueError(
                f"SlidingFriction: normal is {normal}; give the size of the normal force (N), zero or more"
            )
        if not callable(along) and (isinstance(along, bool) or not isinstance(along, int) or along < 0):
            raise ValueError(f"SlidingFriction: along is {along!r}; give an index of v or a function A(q, t) -> (nv,)")
        self.coefficient = as_float(coefficient, "SlidingFriction: coefficient")
        takes = "system, q, v, t"
        self.normal = as_pytree(normal, "SlidingFriction: normal", takes) if callable(normal) else jnp.asarray(normal)
        self.direction = direction
        self.along = as_pytree(along, "SlidingFriction: along", "q, t") if callable(along) else _Coordinate(along)

    def guards(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " 1"]:
        """Sliding velocity along `direction`, (1,), offset by rounding so that coming to rest is no reversal."""
        # Positive while the contact slides along `direction`, and, by the offset, where it is at rest.
        along = self.direction * jnp.sum(self._row(q, v, t) * v)
        return (along + _ROUNDING * float(jnp.finfo(v.dtype).eps))[None]

    def force(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        positive: Bool[Array, " 1"],
    ) -> Float[Array, " nv"]:
        """Friction force (nv,) opposite to `direction` where `positive` is true, else along it."""
        row = self._row(q, v, t)
        normal: Any = self.normal(system, q, v, t) if callable(self.normal) else self.normal
        if jnp.shape(row) != v.shape or jnp.shape(normal) != ():
            raise ValueError(
                f"SlidingFriction: along gives shape {jnp.shape(row)}, normal {jnp.shape(normal)}; expected {v.shape} = "
                "(nv,) and ()"
            )
        # A contact cannot pull: a negative normal force gives no friction instead of friction of the wrong sign.
        limit = self.coefficient.astype(v.dtype) * jnp.maximum(jnp.asarray(normal, v.dtype), 0.0)
        # By the piece and not by sign(A v): within a step the force is then smooth.
        return jnp.where(positive[0], -self.direction, self.direction) * limit * row

    def _row(self, q, v, t):
        row: Any = self.along.row(v) if isinstance(self.along, _Coordinate) else self.along(q, t)
        return as_array(row, "SlidingFriction: along", v.dtype)


# A Module and not an array: the number of velocities is known only with the system.
class _Coordinate(eqx.Module):
    """Row A that selects one velocity coordinate."""

    index: int = eqx.field(static=True)

    def row(self, v):
        """Unit row (nv,) of the coordinate."""
        if self.index >= v.shape[0]:
            raise ValueError(f"SlidingFriction: along is {self.index}, but the system has nv = {v.shape[0]}")
        return jnp.zeros_like(v).at[self.index].set(1)
