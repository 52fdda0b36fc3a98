"""Joint limits: elastic stops at position limits, and actuator effort limits."""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.forces.elements import as_names, broadcast_leaf, joint_indices
from jaxdyn.forces.piecewise import PiecewiseForce
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike, as_array, is_concrete
from jaxdyn.model.joints import KINDS
from jaxdyn.model.numbers import as_number
from jaxdyn.model.tree import Model


class JointStops(PiecewiseForce):
    r"""Unilateral spring-damper stops at the position limits of a model's joints.

    $$\tau = -\max(k x + d \dot x, 0)$$

    beyond a limit by x, with the velocity $\dot x$ outwards; else zero. `jd.simulate` ends a step where a joint reaches a stop or
    leaves it (see `PiecewiseForce`). A joint pressed against its stop with $\tau$ comes to rest $\tau/k$ beyond it. Steps must
    resolve the frequency $\sqrt{k/M}$; with $d = 2 \sqrt{k M}$ the joint does not rebound.

    **Arguments:** `stiffness` k (N m/rad or N/m) and `damping` d (N m s/rad or N s/m), numbers; `joints`, names of
    joints of one coordinate, or None for all that have a finite limit.

    **Raises:** ValueError for numbers that are not positive; (when called) for a system without joints, unknown joints, and
    named ones with several coordinates.

    ```python
    scene = jd.Scene(robot, forces=[jd.forces.JointStops(1e4, 50.0)])
    ```
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    joints: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self, stiffness: Numbers = 1e4, damping: Numbers = 0.0, joints: Checked[str | Sequence[str] | None] = None
    ):
        self.stiffness = as_number(stiffness, "JointStops: stiffness", like=float)
        self.damping = as_number(damping, "JointStops: damping", zero=True, like=float)
        self.joints = as_names(joints)

    def guards(
        self, system: Checked[Model], q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        r"""Switching functions of the lower limits, then of the upper ones.

        $$k x + \min(d \dot x, 0)$$
        """
        # At contact (x = 0, x' > 0) this is k x; at separation (x' < 0) it is the force, which must not become a pull.
        # An infinite limit has a constant negative guard, so that it is never an event.
        return jnp.concatenate([jnp.where(bounded, k * x + jnp.minimum(d * rate, 0.0), -1.0)
                                for bounded, k, x, d, rate in self._beyond(system, q, v)])  # fmt: skip

    def force(
        self,
        system: Checked[Model],
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        positive: Bool[Array, " n"],
    ) -> Float[Array, " nv"]:
        """Force of the active stops, (nv,)."""
        total, at_v = jnp.zeros_like(v), self._indices(system)[1]
        # The guards are those of all lower limits, then of all upper ones.
        is_active = positive.reshape(2, -1)
        for side, (bounded, k, x, d, rate) in enumerate(self._beyond(system, q, v)):
            # Without a maximum: the guards decide on the piece, and within it the force is smooth.
            push = jnp.where(is_active[side] & bounded, k * x + d * rate, 0.0)
            # A lower stop pushes in the positive direction.
            total = total.at[at_v].add(push if side == 0 else -push)
        return total

    def _indices(self, system) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the joints in q and v."""
        if not isinstance(system, Model):
            raise ValueError(f"JointStops: a {type(system).__name__} has no joints with limits; pass a Model")
        kinds = dict(zip(system.joint_names, system.topology.kinds, strict=True))
        # The names that are given include unknown ones, which `joint_indices` refuses.
        names = system.joint_names if self.joints is None else self.joints
        joint_indices(system, names, "JointStops")
        several = [name for name in names if not KINDS[kinds[name]].nq == KINDS[kinds[name]].nv == 1]
        # Without names, joints of several coordinates are left out; a joint that was named must have a stop.
        if several and self.joints is not None:
            raise ValueError(
                f"JointStops: joint {several[0]!r} is {kinds[several[0]]!r}; stops are for joints of one coordinate"
            )
        return joint_indices(system, tuple(name for name in names if name not in several), "JointStops")

    def _beyond(self, system, q, v):
        """Data of the lower and of the upper limits: mask of the finite ones, and k, x, d and x' outwards."""
        at_q, at_v = self._indices(system)
        k, d = self.stiffness.astype(q.dtype), self.damping.astype(q.dtype)
        sides = []
        for limit, sign in ((system.lower, -1.0), (system.upper, 1.0)):
            edge = jnp.asarray(limit, q.dtype)[at_q]
            bounded = jnp.isfinite(edge)
            # The zero keeps inf out of the gradient.
            sides.append((bounded, k, sign * (q[at_q] - jnp.where(bounded, edge, 0.0)), d, sign * v[at_v]))
        return sides


class EffortLimits(eqx.Module):
    r"""Saturation of the efforts of a control, or of `jd.stepper`, at actuator limits.

    $$-\mathrm{limit} \le \tau \le \mathrm{limit}$$

    It acts on tau, not on the scene's other forces; its own generalised force is zero.

    **Arguments:** `limit` (N m or N), a number or one per velocity coordinate; None means the model's `effort_limit`. Infinite
    limits have no effect.

    **Raises:** ValueError for limits that are negative; (when used) for a wrong shape, or a system without limits.
    """

    limit: Float[Array, "..."] | None
    of_speed: ClassVar[bool] = False  # whether they depend on the velocity

    def __init__(self, limit: Numbers | None = None):
        self.limit = None if limit is None else jnp.asarray(as_array(limit, "EffortLimits: limit"), float)
        if self.limit is not None and is_concrete(self.limit) and not (np.asarray(self.limit) >= 0).all():
            raise ValueError(
                f"EffortLimits: limit is {limit}; give limits that are not negative, or None for the model's"
            )

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        # It is one of the forces that a scene sums; its effect is `clip_effort` of the control.
        return jnp.zeros_like(v)

    def effort_guards(
        self, system: SystemLike, tau: Float[Array, " nv"], v: Float[Array, " nv"] | None = None
    ) -> Float[Array, " n"]:
        """Switching functions tau - upper, then lower - tau, (2 nv,): negative where tau is within its limits."""
        # inf - inf would be NaN in a gradient; infinite limits get a constant negative guard instead.
        guards = []
        for side, limit in zip((-1.0, 1.0), self._range(system, tau, v), strict=True):
            bounded = jnp.isfinite(limit)
            # Inserted in front, so that upper limits come first, as `clip_effort` reads them.
            guards.insert(0, jnp.where(bounded, side * (tau - jnp.where(bounded, limit, 0.0)), -1.0))
        return jnp.concatenate(guards)

    def clip_effort(
        self,
        system: SystemLike,
        tau: Float[Array, " nv"],
        positive: Bool[Array, " n"] | None = None,
        v: Float[Array, " nv"] | None = None,
    ) -> Float[Array, " nv"]:
        """Clip tau (nv,) to the limits; `positive` (2 nv,), the signs of `effort_guards`, fixes which entries are clipped."""
        lower, upper = self._range(system, tau, v)
        if positive is None:
            return jnp.clip(tau, lower, upper)
        # With given signs each entry keeps its piece within a step, and the torque is smooth.
        above, below = positive.reshape(2, -1)
        return jnp.where(above, upper, jnp.where(below, lower, tau))

    def _range(self, system, tau, v) -> tuple[Array, Array]:
        """Least and largest torques, (nv,) each."""
        limit: Any = getattr(system, "effort_limit", None) if self.limit is None else self.limit
        if limit is None:
            raise ValueError(f"EffortLimits: a {type(system).__name__} has no effort_limit; give the limit")
        limit = broadcast_leaf(limit, tau, tau.size, "EffortLimits: limit")
        return -limit, limit


class TorqueSpeedLimits(EffortLimits):
    r"""Torque-speed curve of a motor at its largest voltage.

    $$|\tau + \tau_\mathrm{stall} v / v_\mathrm{no\ load}| \le \tau_\mathrm{stall}$$

    A motor of resistance R and constant k at the voltage U gives $\tau = k (U - k v) / R$: at most $k U_{\max} / R$ at
    rest, the `stall` torque, and nothing at the speed `no_load`, $U_{\max} / k$. Beyond that speed it brakes. Against the
    motion it may give more than `stall`, which the current limits: list `jd.forces.EffortLimits` behind it. Like these it
    acts on tau, not on the scene's other forces, and `jd.simulate` and `jd.stepper` end a step where a torque reaches the
    curve or leaves it.

    **Arguments:** `stall` (N m or N) and `no_load` (rad/s or m/s), at the joint (behind the gear), positive: numbers or one per
    velocity coordinate. Joints without a curve have an infinite `stall`.

    **Raises:** ValueError for numbers that are not positive; (when used) for a wrong shape.

    Source: Hughes & Drury (2019), Electric Motors and Drives, section 3.5.

    ```python
    scene = jd.Scene(model, forces=[jd.forces.TorqueSpeedLimits(120.0, 6.0), jd.forces.EffortLimits(80.0)])
    ```
    """

    stall: Float[Array, "..."]
    no_load: Float[Array, "..."]
    of_speed: ClassVar[bool] = True

    def __init__(self, stall: Numbers, no_load: Numbers):
        # Without a limit of its own: `_range` gives the curve.
        super().__init__()
        for name, value in (("stall", stall), ("no_load", no_load)):
            numbers = jnp.asarray(as_array(value, f"TorqueSpeedLimits: {name}"), float)
            if is_concrete(numbers) and not (np.asarray(numbers) > 0).all():
                raise ValueError(f"TorqueSpeedLimits: {name} is {value}; give positive numbers")
            setattr(self, name, numbers)

    def _range(self, system, tau, v) -> tuple[Array, Array]:
        if v is None:
            raise ValueError("TorqueSpeedLimits: limits depend on the speed; pass v, or call Scene.drive_torque")
        stall = broadcast_leaf(self.stall, tau, tau.size, "TorqueSpeedLimits: stall")
        bounded = jnp.isfinite(stall)
        # 1 in place of an infinite stall torque: inf * 0 would be NaN at rest and in the gradient.
        stall = jnp.where(bounded, stall, 1.0)
        back = stall * v / broadcast_leaf(self.no_load, tau, tau.size, "TorqueSpeedLimits: no_load")
        return jnp.where(bounded, -stall - back, -jnp.inf), jnp.where(bounded, stall - back, jnp.inf)
