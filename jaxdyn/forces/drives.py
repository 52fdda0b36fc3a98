"""Drives of joints: elastic transmissions, first- and second-order torque dynamics, torque-speed limits."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.kinematics import take
from jaxdyn.forces.elements import _broadcast, _is_positive, _joint_indices, _leaf, _names
from jaxdyn.forces.limits import TorqueSpeedLimits as TorqueSpeedLimits
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.joining import join
from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.systems.drives import DriveDynamics as DriveDynamics
from jaxdyn.systems.scene import Scene


class ElasticTransmission(eqx.Module):
    """Spring and damper between motors and joints: s = theta/n - q, tau = K s + D ds/dt on the joint, -tau/n on the motor.

    theta is the motor's own angle and n the gear ratio, of one sign with the direction of rotation. It conserves the energy
    K s^2/2 and dissipates D (ds/dt)^2. Steps must resolve sqrt(K (1/I + 1/(n^2 B))), with B and I the inertias of motor and
    link; `jd.Rodas5P` has longer ones where the elastic motion has died out.

    **Arguments:** `motors`, `joints`, names of joints of one coordinate, in pairs; `stiffness` K (N m/rad or N/m), `damping` D
    (N m s/rad or N s/m), `gear` n (1, or rad/m for a spindle): numbers or one per pair.

    **Raises:** ValueError for names that are no pairs, a gear ratio of zero; (when called) for unknown joints, joints of several
    coordinates, a wrong shape.

    Source: Spong (1987), ASME J. Dyn. Sys. Meas. Control 109, eq. 13; De Luca & Book, Springer Handbook of Robotics, ch. 11.
    """

    motors: tuple[str, ...] = eqx.field(static=True, converter=_names)
    joints: tuple[str, ...] = eqx.field(static=True, converter=_names)
    stiffness: Float[Array, "..."] = eqx.field(converter=_leaf)
    damping: Float[Array, "..."] = eqx.field(converter=_leaf, default=0.0)
    gear: Float[Array, "..."] = eqx.field(converter=_leaf, default=1.0)

    def __check_init__(self):
        if len(self.motors) != len(self.joints):
            raise ValueError(
                f"ElasticTransmission: {len(self.motors)} motors for {len(self.joints)} joints; give pairs"
            )
        if not _is_positive(self.gear**2):
            raise ValueError(f"ElasticTransmission: gear is {self.gear}; give ratios that are not zero")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        n = len(self.joints)
        motor, joint = (_joint_indices(system, names, "ElasticTransmission") for names in (self.motors, self.joints))
        if any(len(index) != n for index in (*motor, *joint)):
            raise ValueError("ElasticTransmission: motors and joints have one coordinate each")
        stiffness, damping, gear = (
            _broadcast(value, q, n, f"ElasticTransmission: {name}")
            for name, value in (("stiffness", self.stiffness), ("damping", self.damping), ("gear", self.gear))
        )
        stretch, rate = (x[a] / gear - x[b] for x, a, b in ((q, motor.q, joint.q), (v, motor.v, joint.v)))
        tau = stiffness * stretch + damping * rate
        return jnp.zeros_like(v).at[joint.v].set(tau).at[motor.v].set(-tau / gear)


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
    """Robot with elastic joints: a scene with a rotor for each of them behind the model's coordinates, and the springs.

        M(q) q'' + h(q, q') = K (theta/n - q) + D (theta'/n - q')
        B theta'' + (K (theta/n - q) + D (theta'/n - q'))/n = tau

    q = (model's q, theta), v = (model's v, theta'); torques of the motors are the last entries of tau. The kinetic energy of a
    rotor is that of its own rotation, B theta'^2/2 (Spong's model, exact to 1/n). For the coupling with the motion of the
    link that carries it, add rotors as bodies of a `ModelBuilder`, and `ElasticTransmission` to the scene.

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
    scene = jd.drives.elastic_joints(jd.robots.iiwa(), 1e4, 3e-5, damping=5.0, gear=100.0)
    ```
    """
    chosen = model.joint_names if joints is None else _names(joints)
    _joint_indices(model, chosen, "elastic_joints")
    kinds = dict(zip(model.joint_names, model.topology.kinds, strict=True))
    if several := [name for name in chosen if KINDS[kinds[name]].nv != 1]:
        raise ValueError(f"elastic_joints: {several} have several coordinates; name joints of one")
    if not _is_positive(rotor_inertia):
        raise ValueError(f"elastic_joints: rotor_inertia is {rotor_inertia}; give positive inertias (kg m^2)")
    motors = tuple(f"{name}{suffix}" for name in chosen)
    inertias = jnp.broadcast_to(jnp.asarray(rotor_inertia, float), (len(chosen),))
    whole = model
    for motor, inertia in zip(motors, inertias, strict=True):
        rotor = ModelBuilder(motor, gravity=model.gravity, dtype=model.home.dtype)
        rotor.add_body(motor, None, "continuous", joint_name=motor, armature=inertia)
        whole = join(whole, rotor.build(), name=model.name)
    return Scene(whole, forces=(ElasticTransmission(motors, chosen, stiffness, damping, gear),))


class _Lag(DriveDynamics):
    """Drives whose torque follows the command of some joints, all others being without delay."""

    initial: eqx.AbstractVar[Array]
    joints: eqx.AbstractVar[tuple[str, ...] | None]

    def start(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """Torques `initial` at rest."""
        size = _joint_indices(system, self.joints, type(self).__name__).v.size
        return _broadcast(self.initial, v, size, f"{type(self).__name__}: initial")

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
        index = _joint_indices(system, self.joints, type(self).__name__).v
        return state[: index.size] if index.size == system.nv else command.at[index].set(state[: index.size])

    def _error(self, system, state, command):
        """Commands less torques of the drives (n,), and a function that broadcasts a leaf to (n,)."""
        index, name = _joint_indices(system, self.joints, type(self).__name__).v, type(self).__name__
        error = take(command, index) - state[: index.size]
        return error, lambda leaf: _broadcast(getattr(self, leaf), state, index.size, f"{name}: {leaf}")


class FirstOrder(_Lag):
    """First-order drive: T dtau/dt = u - tau, with u the command and tau the torque at the joint.

    The step response is tau = u (1 - exp(-t/T)). It models a current loop of bandwidth 1/(2 pi T) Hz, and MuJoCo's
    activation `filter` of a motor.

    **Arguments:** `time_constant` T (s), positive, and `initial` torque (N m or N): numbers or one per coordinate. `joints`,
    their names, or None for all; commands of the others pass at once.

    **Raises:** ValueError for a T that is not positive; (when called) for unknown joints or a wrong shape.

    ```python
    scene = jd.Scene(robot, forces=[jd.drives.FirstOrder(0.01), jd.EffortLimits()])
    step = jd.stepper(scene, dt=0.002)
    q, v, z = step((q0, v0, scene.drive_state(q0, v0)), tau)
    ```
    """

    time_constant: Float[Array, "..."] = eqx.field(converter=_leaf)
    initial: Float[Array, "..."] = eqx.field(converter=_leaf, default=0.0)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __check_init__(self):
        if not _is_positive(self.time_constant):
            raise ValueError(f"FirstOrder: time_constant is {self.time_constant}; give positive seconds")

    def rate(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " n"]:
        """(u - tau)/T."""
        error, leaf = self._error(system, state, command)
        return error / leaf("time_constant")


class SecondOrder(_Lag):
    """Second-order drive: tau'' + 2 zeta w tau' + w^2 tau = w^2 u, with u the command and tau the torque at the joint.

    The states are tau, then tau'. With zeta < 1 the step response overshoots by exp(-pi zeta/sqrt(1 - zeta^2)).

    **Arguments:** `frequency` w (rad/s) and `damping_ratio` zeta, positive, and `initial` torque (N m or N, with tau' = 0):
    numbers or one per coordinate. `joints` as of `FirstOrder`.

    **Raises:** ValueError for numbers that are not positive; (when called) for unknown joints or a wrong shape.

    ```python
    scene = jd.Scene(robot, forces=[jd.drives.SecondOrder(200.0, 0.7)])
    motion = jd.simulate(scene, q0, v0, ts, control=lambda q, v, t: tau, outputs=("torque", "drive_state"))
    ```
    """

    frequency: Float[Array, "..."] = eqx.field(converter=_leaf)
    damping_ratio: Float[Array, "..."] = eqx.field(converter=_leaf, default=1.0)
    initial: Float[Array, "..."] = eqx.field(converter=_leaf, default=0.0)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __check_init__(self):
        for name in ("frequency", "damping_ratio"):
            if not _is_positive(getattr(self, name)):
                raise ValueError(f"SecondOrder: {name} is {getattr(self, name)}; give positive numbers")

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
        """tau', then w^2 (u - tau) - 2 zeta w tau'."""
        error, leaf = self._error(system, state, command)
        frequency, speed = leaf("frequency"), state[error.shape[0] :]
        return jnp.concatenate([speed, frequency * (frequency * error - 2 * leaf("damping_ratio") * speed)])
