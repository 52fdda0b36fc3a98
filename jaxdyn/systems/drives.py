"""Drives between a control and the joints: torque laws with a state, and the chain of a scene's drives and limits."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.model.arguments import Number, SystemLike


class DriveDynamics(eqx.Module):
    r"""Base class of drives with a state z, between the command of a control and the torque at the joints.

    $$\tau = \mathrm{torque}(q, v, t, z, u), \quad \dot z = \mathrm{rate}(q, v, t, z, u)$$

    List one among the forces of a `Scene`. Drives and `jd.forces.EffortLimits` act in the order of the list, each on what the one
    before gives. `jd.simulate` integrates z with the motion; `jd.stepper` takes and returns it as a third entry of the
    state. Functions of one instant (`jd.constrained_dynamics`, `jd.inverse_dynamics`, ...) know torques at the joints alone.

    ```python
    class VoltageDrive(jd.forces.DriveDynamics):  # L di/dt = u - R i - k v, tau = k i
        inductance: jax.Array
        resistance: jax.Array
        constant: jax.Array

        def start(self, system, q, v, t):
            return jnp.zeros_like(v)

        def torque(self, system, q, v, t, state, command):
            return self.constant * state

        def rate(self, system, q, v, t, state, command):
            return (command - self.resistance * state - self.constant * v) / self.inductance
    ```
    """

    @abc.abstractmethod
    def start(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """The state (n,) at the start of a motion."""

    @abc.abstractmethod
    def torque(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " nv"]:
        """Torque (nv,) behind the drive, N m or N."""

    @abc.abstractmethod
    def rate(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: Float[Array, " n"],
        command: Float[Array, " nv"],
    ) -> Float[Array, " n"]:
        """Rate of the state, (n,)."""

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        """Zeros (nv,): a drive acts on the command, not beside it."""
        return jnp.zeros_like(v)


def pass_command(force: Any, system: Any, q, v, t, command, state):
    """Torque (nv,) behind one force of a scene's list, the rate of its state or None, and the states of the forces after it."""
    if isinstance(force, DriveDynamics):
        # Shapes alone: the size of a drive's state needs no computation of its start.
        count = eqx.filter_eval_shape(force.start, system, q, v, t).shape[0]
        # The states of all drives form one vector, in the order of the scene's forces.
        own = state[:count]
        return (
            force.torque(system, q, v, t, own, command),
            force.rate(system, q, v, t, own, command),
            state[count:],
        )
    if hasattr(force, "clip_effort"):
        command = force.clip_effort(system, command, v=v)
    return command, None, state
