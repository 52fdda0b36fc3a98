"""Loop of the constraint forces, and requirements of a scene, for laws that control forces beside motions."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.constraints.base import Constraint, layout, rows
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.control.errors import hierarchical_acceleration, row_rank, target_rows
from jaxdyn.control.gains import times
from jaxdyn.model.arguments import Number, batch_hint
from jaxdyn.simulation.controls import Controller
from jaxdyn.systems.scene import Scene


class ForceIntegral(Controller):
    """Base class of laws whose state is the integral of a force error, (nc,), with integral action."""

    scene: eqx.AbstractVar[Scene]
    error: eqx.AbstractVar[Constraint]
    kp: eqx.AbstractVar[Array]
    kd: eqx.AbstractVar[Array | None]
    ki: eqx.AbstractVar[Array | None]

    def start(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " nc"] | None:
        """Zero integral at the start; None without integral action."""
        return None if self.ki is None else jnp.zeros((row_count(self.scene),), q.dtype)

    def is_regular(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number = 0.0) -> Bool[Array, ""]:
        """Decide whether task and constraints are independent, as the error equations require."""
        t = jnp.asarray(t, q.dtype)
        (A, _), (T, _) = self._orders(q, v, t)
        # Ranks add exactly where no direction of the task is fixed by the constraints.
        return row_rank(jnp.concatenate([A, T])) == row_rank(A) + T.shape[0]

    def _orders(self, q, v, t):
        """Rows A and right-hand sides of A a = ..., those of the constraints before those of the task."""
        row = rows(independent_rows(self.scene, q, t), q, v, t)
        return (row.A, row.gamma), target_rows(self.scene.system, self.error, self.kp, self.kd, q, v, t)

    def _acceleration(self, q, v, t, start) -> Array:
        """Acceleration closest to `start` (nv,) that satisfies the constraints, and the task in what these leave free."""
        # A task that depends on the constraints is met in the least-squares sense; the constraints hold in any case.
        return hierarchical_acceleration(self.scene.system, q, t, self._orders(q, v, t), start)


class ForceLoop(ForceIntegral):
    """Base class of laws whose state is the integral of lam - lam_d, (nc,), with integral action."""

    force: eqx.AbstractVar[Callable | None]

    def rate(
        self,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        state: PyTree,
        multipliers: Float[Array, " nc"],
    ) -> Float[Array, " nc"]:
        """Rate lam - lam_d of the integral."""
        return multipliers - self.reference_force(q, t)

    def reference_force(self, q: Float[Array, " nq"], t: Number) -> Float[Array, " nc"]:
        """Reference lam_d (nc,) of the multipliers."""
        count = row_count(self.scene)
        if self.force is None:
            return jnp.zeros((count,), q.dtype)
        force = self.force(t)
        if jnp.shape(force) != (count,):
            raise ValueError(
                f"force has shape {jnp.shape(force)}, expected {(count,)}, one per row of the constraints"
                f"{batch_hint(force, (count,))}"
            )
        return jnp.asarray(force, q.dtype)

    def force_command(self, q: Float[Array, " nq"], t: Number, state: PyTree) -> Float[Array, " nc"]:
        # The sign follows M a + h = tau + A^T lam: a reference multiplier is cancelled by the opposite torque.
        """Force command -lam_d + KI z."""
        wanted = -self.reference_force(q, t)
        # A law that is called outside of a simulation has no state; its integral then counts as zero.
        return wanted if state is None or self.ki is None else wanted + times(self.ki, state, "ki")


def constrained(scene: Any) -> Scene:
    """Require a scene with constraints. **Raises:** ValueError for anything else."""
    if not isinstance(scene, Scene) or not scene.constraints:
        raise ValueError(
            "scene has no constraints, so there is no force to control; use jd.control.ComputedTorque or "
            "jd.control.OperationalSpace"
        )
    # Refuses constraints on unknown bodies here, and not at the first call of the law.
    layout(scene)
    return scene


def row_count(scene: Scene) -> int:
    """Number of rows of the constraints of a scene."""
    return layout(scene)[-1].end
