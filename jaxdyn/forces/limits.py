"""Limits of joints: stops that push back, and the largest effort that actuators give."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.forces.piecewise import PiecewiseForce
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike, as_array, is_concrete
from jaxdyn.model.tree import Model


class JointStops(PiecewiseForce):
    """Stops at the position limits of the model's joints, as springs with dampers that push and never pull.

    Beyond a limit by x, with the velocity x' outwards, tau = -max(k x + d x', 0); else none. `jd.simulate` ends a step where a
    joint meets a stop or leaves it (see `PiecewiseForce`). A joint that is driven against its
    stop with tau comes to rest tau/k beyond it. The rate sqrt(k/M) has to be followed by the steps; with d = 2 sqrt(k M) the
    stop does not throw the joint back.

    **Arguments:** `stiffness` k (N m/rad or N/m) and `damping` d (N m s/rad or N s/m), numbers; `joints`, names of joints of one
    coordinate, or None for all of those that have a finite limit.

    **Raises:** ValueError for numbers that are not positive; (when called) for a system without joints, unknown joints, and
    named ones that have no limit or several coordinates.

    ```python
    scene = jd.Scene(robot, forces=[jd.JointStops(1e4, 50.0)])
    ```
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    joints: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self, stiffness: Numbers = 1e4, damping: Numbers = 0.0, joints: Checked[str | Sequence[str] | None] = None
    ):
        self.stiffness = _number(stiffness, "JointStops: stiffness", least=0.0, strict=True)
        self.damping = _number(damping, "JointStops: damping", least=0.0, strict=False)
        self.joints = (joints,) if isinstance(joints, str) else joints if joints is None else tuple(joints)

    def guards(
        self, system: Checked[Model], q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """k x + min(d x', 0) of the lower limits, then of the upper ones: x where a stop is met, its force where it is left."""
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
        """The force of the stops that are met, (nv,)."""
        total, at_v = jnp.zeros_like(v), self._indices(system)[1]
        met = positive.reshape(2, -1)
        for side, (bounded, k, x, d, rate) in enumerate(self._beyond(system, q, v)):
            push = jnp.where(met[side] & bounded, k * x + d * rate, 0.0)
            total = total.at[at_v].add(push if side == 0 else -push)
        return total

    def _indices(self, system):
        places = self._places(system)
        return tuple(np.array(x, int) for x in zip(*places, strict=True)) if places else (np.zeros(0, int),) * 2

    def _beyond(self, system, q, v):
        """Of the lower limits and of the upper ones: which there are, and k, x, d and x' outwards."""
        at_q, at_v = self._indices(system)
        k, d = self.stiffness.astype(q.dtype), self.damping.astype(q.dtype)
        sides = []
        for limit, sign in ((system.lower, -1.0), (system.upper, 1.0)):
            edge = jnp.asarray(limit, q.dtype)[at_q]
            bounded = jnp.isfinite(edge)
            # The zero keeps inf out of the gradient.
            sides.append((bounded, k, sign * (q[at_q] - jnp.where(bounded, edge, 0.0)), d, sign * v[at_v]))
        return sides

    def _places(self, system) -> list[tuple[int, int]]:
        """Where the joints stand in q and v."""
        if not isinstance(system, Model):
            raise ValueError(f"JointStops: a {type(system).__name__} has no joints with limits; it takes a Model")
        top = system.topology
        names = top.joint_names if self.joints is None else self.joints
        missing = [name for name in names if name not in top.joint_names]
        if missing:
            raise ValueError(
                f"JointStops: joints {missing} are not in model {system.name!r}; it has {list(top.joint_names)}"
            )
        places = []
        for name in names:
            i = top.joint_names.index(name)
            at_q, at_v = top.q_slices[i], top.v_slices[i]
            if at_q.stop - at_q.start == 1 and at_v.stop - at_v.start == 1:
                places.append((at_q.start, at_v.start))
            elif self.joints is not None:
                raise ValueError(
                    f"JointStops: joint {name!r} is {top.kinds[i]!r}; stops are for joints of one coordinate"
                )
        return places


class EffortLimits(eqx.Module):
    """The efforts of a control, or of `jd.stepper`, cut off at the limits of the actuators: -limit <= tau <= limit.

    It acts on tau, not on the scene's other forces; as a force it is zero.

    **Arguments:** `limit` (N m or N), a number or one per velocity coordinate; None takes the model's `effort_limit`. Infinite
    ones do not cut.

    **Raises:** ValueError for limits that are negative; (when used) for a wrong shape, or a system without limits.
    """

    limit: Float[Array, "..."] | None

    def __init__(self, limit: Numbers | None = None):
        self.limit = None if limit is None else jnp.asarray(as_array(limit, "EffortLimits: limit"), float)
        if self.limit is not None and is_concrete(self.limit) and not (np.asarray(self.limit) >= 0).all():
            raise ValueError(
                f"EffortLimits: limit is {limit}; give limits that are not negative, or None for the model's"
            )

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        return jnp.zeros_like(v)

    def effort_guards(self, system: SystemLike, tau: Float[Array, " nv"]) -> Float[Array, " n"]:
        """tau - limit, then -limit - tau, (2 nv,): negative where nothing is cut off."""
        limit = self._limit(system, tau)
        bounded = jnp.isfinite(limit)
        limit = jnp.where(bounded, limit, 0.0)
        return jnp.concatenate([jnp.where(bounded, side * tau - limit, -1.0) for side in (1.0, -1.0)])

    def clip_effort(
        self, system: SystemLike, tau: Float[Array, " nv"], positive: Bool[Array, " n"] | None = None
    ) -> Float[Array, " nv"]:
        """tau cut off; `positive` (2 nv,): where, if that is known from the signs of `effort_guards`."""
        limit = self._limit(system, tau)
        if positive is None:
            return jnp.clip(tau, -limit, limit)
        above, below = positive.reshape(2, -1)
        return jnp.where(above, limit, jnp.where(below, -limit, tau))

    def _limit(self, system, tau):
        limit: Any = getattr(system, "effort_limit", None) if self.limit is None else self.limit
        if limit is None:
            raise ValueError(f"EffortLimits: a {type(system).__name__} has no effort_limit; give the limit")
        if jnp.shape(limit) not in ((), tau.shape):
            raise ValueError(
                f"EffortLimits: limit has shape {jnp.shape(limit)}, expected a number or {tau.shape} = (nv,)"
            )
        return jnp.broadcast_to(jnp.asarray(limit, tau.dtype), tau.shape)


def _number(value: Any, what: str, least: float, strict: bool):
    number = jnp.asarray(as_array(value, what), float)
    fine = not is_concrete(number) or (
        number.shape == () and np.isfinite(number) and (number > least if strict else number >= least)
    )
    if not fine:
        raise ValueError(
            f"{what} is {value}; give one {'positive number' if strict else 'number that is not negative'}"
        )
    return number
