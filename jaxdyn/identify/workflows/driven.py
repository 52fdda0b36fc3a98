"""Robots whose driven joints follow a motion: all joints of a tree, or the motors of a mechanism, whose loops give the others."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.assembly import assemble
from jaxdyn.constraints.branches import degrees_of_freedom
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.mechanisms import check_motors, follow_motors, motor_basis
from jaxdyn.identify.result import inverse_torque
from jaxdyn.identify.workflows.excitation import FourierMotion
from jaxdyn.model.arguments import as_array
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

# Samples on the way from the start of a mechanism to the first sample of a motion.
_APPROACH = 20


class DrivenRobot(eqx.Module):
    """Robot whose motors follow a motion: all joints of a tree, or `motors`, indices in v, of a mechanism with loops.

    `start` (nq,): a closed configuration of a mechanism.
    """

    scene: Scene
    start: Float[Array, " nq"]
    motors: tuple[int, ...] | None = eqx.field(static=True)

    @property
    def model(self) -> Model:
        return self.scene.system  # pyright: ignore[reportReturnType]

    @property
    def joints(self) -> np.ndarray:
        """Indices in v of the joints that follow the motion."""
        return np.arange(self.model.nv) if self.motors is None else np.array(self.motors)

    def states(self, motion: FourierMotion, times):
        """q, v, a (n, nv) of all joints, tangent bases N (n, nv, m), and the gaps of the loops (n,)."""
        q, v, a = jax.vmap(motion)(times)
        if self.motors is None:
            N = jnp.broadcast_to(jnp.eye(q.shape[1], dtype=q.dtype), (*q.shape, q.shape[1]))
            return q, v, a, N, jnp.zeros(len(q), q.dtype)
        # From the start to the first sample, so that the loops stay on their branch.
        shares = jnp.arange(_APPROACH, dtype=q.dtype)[:, None] / _APPROACH
        begin = self.start[self.joints][None]
        approach = begin + shares * (q[:1] - begin)
        whole, gaps = follow_motors(self.scene, self.motors, self.start, jnp.concatenate([approach, q]))
        basis = partial(motor_basis, self.scene, columns=self.motors)
        q, gap = whole[_APPROACH:], jnp.maximum(gaps[_APPROACH:], jnp.max(gaps[:_APPROACH]))
        N, _ = jax.vmap(lambda q, v: basis(q, v, 0.0))(q, jnp.zeros_like(q))
        v = jnp.einsum("nij,nj->ni", N, v)
        drift = jax.vmap(lambda q, v: basis(q, v, 0.0)[1])(q, v)
        return q, v, jnp.einsum("nij,nj->ni", N, a) + drift, N, gap


@eqx.filter_jit
def joint_signals(motion: FourierMotion, robot: DrivenRobot, times):
    """q, v, a (n, nv) of all joints, torques (n, m) of the driven ones, tangent bases (n, nv, m), and the loops' gaps (n,)."""
    q, v, a, N, gap = robot.states(motion, times)
    tau = jax.vmap(partial(inverse_torque, robot.scene))(q, v, a, times)
    return q, v, a, jnp.einsum("nij,ni->nj", N, tau), N, gap


def make_robot(scene: Scene, motors: Sequence[str] | None, guess) -> DrivenRobot:
    model: Any = scene.system
    check_bodies(model)
    if model.nq != model.nv:
        raise ValueError(
            f"model has nq={model.nq}, nv={model.nv}; exciting motions are for joints with one coordinate each"
        )
    if not scene.constraints:
        if motors is not None:
            raise ValueError(f"motors is {list(motors)}; a robot without loops moves all joints, so omit it")
        return DrivenRobot(scene, neutral(model), None)
    start = neutral(model) if guess is None else jnp.asarray(as_array(guess, "guess"), model.home.dtype)
    if start.shape != (model.nq,):
        raise ValueError(f"guess has shape {start.shape}, expected ({model.nq},)")
    start = assemble(scene, start).q
    if motors is None:
        count = degrees_of_freedom(scene, start)
        raise ValueError(
            f"{model.name!r} has loops and {count} degrees of freedom; name as many of its joints in motors "
            f"({', '.join(model.joint_names)})"
        )
    return DrivenRobot(scene, start, check_motors(scene, start, motors))
