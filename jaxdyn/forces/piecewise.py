"""Piecewise smooth forces: their switching functions, and scenes with forces fixed to given pieces.

A force with a kink or a jump declares switching functions. `jd.simulate` ends a step where one of them changes its
sign, so that no step crosses a kink, and the derivatives of the motion are those of the pieces, joined by the
derivative of the switching time. Elastic stops at position limits and
actuator effort limits are such forces.
"""

import abc
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.forces.elements import as_names, broadcast_leaf, joint_indices
from jaxdyn.model.arguments import Checked, Number, Numbers, SystemLike, as_array, as_number, is_concrete
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, pass_command


class PiecewiseForce(eqx.Module):
    """Base class of forces that are smooth except where one of their switching functions changes its sign.

    Subclasses define two methods. A call evaluates the piece of the current state.

    - `guards(system, q, v, t) -> (n,)`: the switching functions, each smooth near its own zeros, in any unit.
    - `force(system, q, v, t, positive) -> (nv,)`: the force in the piece whose positive guards are marked by
      `positive` (n,). For a fixed `positive` it is smooth, also across the zeros of the guards.

    ```python
    class Backlash(jd.forces.PiecewiseForce):
        stiffness: jax.Array
        play: jax.Array

        def guards(self, system, q, v, t):
            return jnp.stack([q[0] - self.play, -q[0] - self.play])

        def force(self, system, q, v, t, positive):
            beyond = jnp.where(positive[0], q[0] - self.play, jnp.where(positive[1], q[0] + self.play, 0.0))
            return jnp.zeros_like(v).at[0].set(-self.stiffness * beyond)

    scene = jd.Scene(system, forces=[Backlash(jnp.asarray(300.0), jnp.asarray(0.02))])
    ```
    """

    @abc.abstractmethod
    def guards(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " n"]:
        """Switching functions (n,)."""

    @abc.abstractmethod
    def force(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        positive: Bool[Array, " n"],
    ) -> Float[Array, " nv"]:
        """Force (nv,) in the piece that `positive` marks."""

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        # A guard of exactly zero belongs to the negative side.
        return self.force(system, q, v, t, self.guards(system, q, v, t) > 0)


def has_pieces(force: object) -> bool:
    """Decide whether a force has switching functions."""
    return isinstance(force, PiecewiseForce) or hasattr(force, "effort_guards")


class _FixedPiece(eqx.Module):
    """Force of a scene fixed to one piece."""

    inner: Any
    positive: Any
    of_efforts: Any

    def __call__(self, system, q, v, t):
        if isinstance(self.inner, PiecewiseForce):
            return self.inner.force(system, q, v, t, self.positive)
        return self.inner(system, q, v, t)

    def clip_effort(self, system, tau, v=None):
        cut = getattr(self.inner, "clip_effort", None)
        # A force without effort limits leaves the command as it is.
        return tau if cut is None else cut(system, tau, self.of_efforts, v=v)


def guards_by_force(scene: Scene, q, v, t, tau, state=None) -> list[tuple[Any, Any]]:
    """Switching functions of each force and of its clipping of `tau` (nv,); None where it has none.

    `tau`: effort of the control before drives and limits; None without a control, or where what is clipped does not depend on
    the state of the motion. `state`: of the scene's drives.
    """
    rows = []
    for force in scene.forces:
        # Guards do not depend on the piece, so that a scene with fixed pieces has those of the scene itself.
        force = force.inner if isinstance(force, _FixedPiece) else force
        own = efforts = None
        if isinstance(force, PiecewiseForce):
            own = jnp.asarray(force.guards(scene.system, q, v, t), q.dtype)
            if own.ndim != 1:
                raise ValueError(f"{type(force).__name__}: guards gives shape {own.shape}; expected (n,)")
        if tau is not None and (effort_guards := getattr(force, "effort_guards", None)):
            efforts = effort_guards(scene.system, tau, v)
        # Drives and limits act one after the other: the next one sees the clipped effort.
        if tau is not None:
            tau, _, state = pass_command(force, scene.system, q, v, t, tau, state)
        rows.append((own, efforts))
    return rows


class Pieces(NamedTuple):
    """Layout of a scene's switching functions: for each force the numbers of its own and of its effort limits."""

    counts: tuple[tuple[int, int], ...]
    names: tuple[str, ...]


def pieces_of(scene: Scene, y, q, v, t, tau_of: Callable | None) -> Pieces:
    """Layout of the switching functions of a scene under a control at one state.

    tau_of(y, q, v, t) is the control's effort and the state of the scene's drives; None without a control.
    """

    # Smooth scenes end here: their control need not be traced.
    if not any(map(has_pieces, scene.forces)):
        return Pieces(((0, 0),) * len(scene.forces), ())

    def shapes(y, q, v, t):
        return guards_by_force(scene, q, v, t, *((None,) if tau_of is None else tau_of(y, q, v, t)))

    counts, names = [], []
    # Shapes alone are needed, so nothing is computed or compiled.
    for i, (force, parts) in enumerate(zip(scene.forces, jax.eval_shape(shapes, y, q, v, t), strict=True)):
        counts.append(tuple(0 if part is None else part.shape[0] for part in parts))
        names += [f"{type(force).__name__} ({i}): switch {k}" for k in range(sum(counts[-1]))]
    return Pieces(tuple(counts), tuple(names))


def guards(scene: Scene, q, v, t, tau, state=None) -> Float[Array, " n"]:
    """Values of all switching functions of a scene's forces, (n,)."""
    parts = [part for pair in guards_by_force(scene, q, v, t, tau, state) for part in pair if part is not None]
    return jnp.concatenate(parts) if parts else jnp.zeros((0,), q.dtype)


def fix_pieces(scene: Scene, pieces: Pieces, positive: Bool[Array, " n"]) -> Scene:
    """Copy of a scene with its forces fixed to the pieces that `positive` marks."""
    forces, place = [], 0
    for force, (own, efforts) in zip(scene.forces, pieces.counts, strict=True):
        middle, end = place + own, place + own + efforts
        marks = positive[place:middle], positive[middle:end] if efforts else None
        # The marks are arrays: all pieces share one compiled program.
        forces.append(_FixedPiece(force, *marks) if own + efforts else force)
        place = end
    return eqx.tree_at(lambda scene: scene.forces, scene, tuple(forces))


def values_and_levels(switching: Callable, *state):
    """Values of switching(*state) (k,), and their rounding errors.

    The derivative of a function along its own arguments (q, v) measures the size of the terms that cancel in it.
    """
    # Terms that cancel in the value need not cancel in this derivative, unless all are homogeneous of one degree.
    values, sizes = jax.jvp(switching, state, state)
    return values, jax.lax.stop_gradient(100 * float(jnp.finfo(values.dtype).eps) * (jnp.abs(sizes) + jnp.abs(values)))


# --- joint limits: elastic stops at position limits, and actuator effort limits ---


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
