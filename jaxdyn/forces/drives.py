"""Drives whose torque follows the command with first- or second-order dynamics."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.dynamics.tree_frames import take
from jaxdyn.forces.elements import as_leaf, as_names, broadcast_leaf, is_positive, joint_indices, scatter
from jaxdyn.model.arguments import Number, SystemLike
from jaxdyn.systems.drives import DriveDynamics


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
