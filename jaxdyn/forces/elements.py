"""Smooth forces of a scene: joint damping and friction, springs, drives, wrenches on a body.

Each is a frozen equinox Module called as `force(system, q, v, t) -> (nv,)`; its numbers are array leaves, so
`jax.grad` and `jax.vmap` reach them. A scalar applies to every selected velocity coordinate. `joints` names the
selected joints (all of them when None); per-coordinate values are then listed in the order of these names.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.kinematics import body_jacobian, frame_pose, named_frame
from jaxdyn.dynamics.tree_frames import take
from jaxdyn.lie import se3
from jaxdyn.model.arguments import (
    Number,
    Numbers,
    SystemLike,
    as_array,
    as_float,
    batch_hint,
    check_names,
    check_state,
    is_concrete,
)
from jaxdyn.model.configuration import difference, neutral
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene


class _Indices(NamedTuple):
    """Indices of the selected joints' coordinates in q and v."""

    q: np.ndarray
    v: np.ndarray


def joint_indices(system, joints: tuple[str, ...] | None, force: str) -> _Indices:
    """Indices of the joints' coordinates in q and v; `force` is its name in errors."""
    if joints is None:
        return _Indices(np.arange(system.nq), np.arange(system.nv))
    if not isinstance(system, Model):
        raise ValueError(f"{force}: joints={joints!r} needs a Model; a {type(system).__name__} has no named joints")
    missing = [name for name in joints if name not in system.joint_names]
    if missing:
        raise ValueError(
            f"{force}: joints {missing} are not in model {system.name!r}; it has {list(system.joint_names)}"
        )
    # In the order of the names given, which is that of the values per coordinate.
    chosen = [system.joint_names.index(name) for name in joints]
    index = np.arange(system.nq), np.arange(system.nv)
    slices = system.topology.q_slices, system.topology.v_slices
    # The empty array keeps the result valid, and an array of integers, where no joint is selected.
    q, v = (np.concatenate([np.zeros(0, int), *(i[s[j]] for j in chosen)]) for i, s in zip(index, slices, strict=True))
    return _Indices(q, v)


def broadcast_leaf(value, like: Array, size: int, name: str) -> Array:
    """Broadcast a leaf to (size,) in the dtype of the state."""
    if jnp.shape(value) not in ((), (size,)):
        raise ValueError(
            f"{name} has shape {jnp.shape(value)}, expected a scalar or {(size,)}, one per coordinate{batch_hint(value, (1,))}"
        )
    # A float64 leaf would promote the motion of a float32 state.
    return jnp.broadcast_to(jnp.asarray(value, like.dtype), (size,))


def scatter(values: Array, indices: np.ndarray, others: Array) -> Array:
    """Replace entries of `others` (nv,) by values; the values themselves when they fill it in order."""
    # The usual case, all joints: no scatter is compiled.
    return values if np.array_equal(indices, np.arange(others.size)) else others.at[indices].set(values)


def as_leaf(what: str, *, optional: bool = False) -> Callable[[Any], Any]:
    """Converter of a field of numbers to a floating array leaf, None where that is `optional`.

    The leaf is of strong type, so that a new value never recompiles. The converter **raises** ValueError, as `as_float` does.
    """
    return lambda value: None if value is None and optional else as_float(value, what)


def as_names(joints) -> tuple[str, ...] | None:
    """Tuple of joint names, of one name or several; None for all joints. **Raises:** ValueError for anything else."""
    return None if joints is None else check_names(joints, "joints")


def _value_or_leaf(value, system, indices: _Indices, field: str, force: str):
    if value is not None:
        # Values of the force itself win over the model's, which describe the file.
        return value
    leaf = getattr(system, field, None)
    if leaf is None:
        raise ValueError(f"{force}: no value given and the system has no {field}; pass one, or set the model's {field}")
    return take(leaf, indices.v)


def _displacement(system, rest, q, indices: _Indices, name: str) -> Array:
    """Difference (per velocity coordinate of the chosen joints) from `rest` to q, on the joints' manifold."""
    if not isinstance(system, Model):
        # Other systems have v = dq/dt, so that a displacement is a difference.
        return take(q, indices.q) - broadcast_leaf(rest, q, len(indices.q), name)
    if jnp.shape(rest) == () and len(indices.q) != len(indices.v):
        raise ValueError(
            f"{name} is a scalar, but a joint with a quaternion needs all its coordinates, {len(indices.q)} here"
        )
    # Other joints are compared with themselves: exactly zero at any configuration.
    start = q.at[indices.q].set(broadcast_leaf(rest, q, len(indices.q), name))
    return take(difference(system, start, q), indices.v)


class JointDamping(eqx.Module):
    r"""Viscous joint friction.

    $$\tau = -\mathrm{coefficient} \cdot v$$

    **Arguments:** `coefficient` (N m s or N s), scalar or one per coordinate; None means the model's `damping` leaf.
    `joints`, names of the joints, or None for all.

    **Raises:** (when called) ValueError for unknown joints, a wrong shape, or no coefficient in force and model.
    """

    coefficient: Float[Array, "..."] | None = eqx.field(converter=as_leaf("coefficient", optional=True), default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        indices = joint_indices(system, self.joints, "JointDamping")
        value = _value_or_leaf(self.coefficient, system, indices, "damping", "JointDamping")
        rate = take(v, indices.v)
        return scatter(
            -broadcast_leaf(value, v, rate.size, "JointDamping: coefficient") * rate, indices.v, jnp.zeros_like(v)
        )


class CoulombFriction(eqx.Module):
    r"""Smoothed Coulomb friction of joints.

    $$\tau = -\mathrm{level} \tanh(v / v_s)$$

    The jump at v = 0 is replaced by a linear range with derivative level / v_s, so that solutions are unique and
    gradients exist. There is no sticking: under a load F below `level` a joint creeps at
    $v_s \operatorname{artanh}(F / \mathrm{level})$. The torque is within 1 % of `level` above 2.65 v_s. A small v_s makes
    the equations stiff (rate level / (v_s * inertia)): use an implicit solver or a larger v_s.

    **Arguments:** `level` (N m or N), scalar or one per coordinate; None means the model's `friction` leaf. `v_s`,
    smoothing velocity (rad/s or m/s), positive. `joints`, names of the joints, or None for all.

    **Raises:** ValueError for a `v_s` that is not positive; (when called) for unknown joints, a wrong shape, or no
    level.
    """

    level: Float[Array, "..."] | None = eqx.field(converter=as_leaf("level", optional=True), default=None)
    v_s: Float[Array, "..."] = eqx.field(converter=as_leaf("v_s"), default=1e-2)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __check_init__(self):
        if not is_positive(self.v_s):
            raise ValueError(f"CoulombFriction: v_s is {self.v_s}; give a positive smoothing velocity, e.g. 0.01 rad/s")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        # tanh and no sign: the force has a derivative at rest, and solutions are unique.
        indices = joint_indices(system, self.joints, "CoulombFriction")
        level = _value_or_leaf(self.level, system, indices, "friction", "CoulombFriction")
        rate = take(v, indices.v)
        ratio = rate / broadcast_leaf(self.v_s, v, rate.size, "CoulombFriction: v_s")
        return scatter(
            -broadcast_leaf(level, v, rate.size, "CoulombFriction: level") * jnp.tanh(ratio),
            indices.v,
            jnp.zeros_like(v),
        )


class JointSpring(eqx.Module):
    r"""Joint spring along the joints' manifold.

    $$\tau = -\mathrm{stiffness} \cdot \Delta, \quad \Delta = \mathrm{difference}(\mathrm{rest}, q)$$

    Conservative, with the energy stiffness $|\Delta|^2 / 2$, for joints of one coordinate and for spherical joints
    of equal stiffness about the three axes. In planar and free joints the force is along the twist that leads back to
    rest.

    **Arguments:** `stiffness` (N m/rad or N/m), scalar or one per velocity coordinate. `rest`, configuration (nq of the
    chosen joints,) of zero force (rad, m, unit quaternions), a scalar for joints of one coordinate, None for
    neutral. `joints`, names of the joints, or None for all.

    **Raises:** (when called) ValueError for unknown joints or a wrong shape.
    """

    stiffness: Float[Array, "..."] = eqx.field(converter=as_leaf("stiffness"))
    rest: Float[Array, "..."] | None = eqx.field(converter=as_leaf("rest", optional=True), default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        indices = joint_indices(system, self.joints, "JointSpring")
        rest = self.rest
        if rest is None:
            # Zeros are no unit quaternion; the neutral configuration has those of no rotation.
            rest = take(neutral(system), indices.q) if isinstance(system, Model) else jnp.zeros(indices.q.size, q.dtype)
        stretch = _displacement(system, rest, q, indices, "JointSpring: rest")
        return scatter(
            -broadcast_leaf(self.stiffness, q, stretch.size, "JointSpring: stiffness") * stretch,
            indices.v,
            jnp.zeros_like(v),
        )


class Drive(eqx.Module):
    r"""Position and velocity drive.

    $$\tau = k_p \mathrm{difference}(q, \mathrm{target}) + k_d (v_\mathrm{target} - v)$$

    The difference is taken along the joints' manifold. With `effort_limit` L the command u is passed through
    $L \tanh(u / L)$: smooth, never above L, within 1 % of u below 0.17 L. For a time-dependent target pass a `control` to
    `simulate`.

    **Arguments:** `kp` (N m/rad or N/m), `kd` (N m s/rad or N s/m), `target_velocity` (rad/s or m/s), `effort_limit`
    (N m or N; None or infinite for no limit): scalar or one per velocity coordinate. `target` (nq of the chosen
    joints,), or a scalar for joints of one coordinate. `joints`, names of the joints, or None for all.

    **Raises:** ValueError for an `effort_limit` that is not positive; (when called) for unknown joints or a wrong
    shape.
    """

    kp: Float[Array, "..."] = eqx.field(converter=as_leaf("kp"))
    kd: Float[Array, "..."] = eqx.field(converter=as_leaf("kd"))
    target: Float[Array, "..."] = eqx.field(converter=as_leaf("target"))
    target_velocity: Float[Array, "..."] = eqx.field(converter=as_leaf("target_velocity"), default=0.0)
    effort_limit: Float[Array, "..."] | None = eqx.field(converter=as_leaf("effort_limit", optional=True), default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=as_names, default=None)

    def __check_init__(self):
        if self.effort_limit is not None and not is_positive(self.effort_limit):
            raise ValueError(f"Drive: effort_limit is {self.effort_limit}; give positive limits, or None for no limit")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        indices = joint_indices(system, self.joints, "Drive")
        size = indices.v.size
        kp, kd, rate = (
            broadcast_leaf(value, v, size, f"Drive: {name}")
            for name, value in (("kp", self.kp), ("kd", self.kd), ("target_velocity", self.target_velocity))
        )
        # The displacement leads from the target to q, and the drive acts against it.
        error = -_displacement(system, self.target, q, indices, "Drive: target")
        command = kp * error + kd * (rate - take(v, indices.v))
        if self.effort_limit is not None:
            limit = broadcast_leaf(self.effort_limit, v, size, "Drive: effort_limit")
            is_finite = jnp.isfinite(limit)
            safe = jnp.where(is_finite, limit, jnp.ones_like(limit))  # keeps inf * 0 out of the gradient
            # tanh and no clip: a kink would cost the solver its order, and saturated drives their gradient.
            command = jnp.where(is_finite, safe * jnp.tanh(command / safe), command)
        return scatter(command, indices.v, jnp.zeros_like(v))


class ExternalWrench(eqx.Module):
    r"""Constant wrench on a body.

    $$\tau = J^T F$$

    with J the Jacobian of its frame.

    **Arguments:** `frame`, name of a body or frame; the wrench acts at its origin. `wrench` (6,), (f, tau) in N and N
    m, acting on the body. `axes`: "world", the wrench keeps its direction in the world; "body", it turns with the
    frame.

    **Raises:** ValueError for a wrench that is not (6,) or unknown axes; (when called) for an unknown frame.
    """

    frame: str = eqx.field(static=True)
    wrench: Float[Array, "..."] = eqx.field(converter=as_leaf("wrench"))
    axes: str = eqx.field(static=True, default="world")

    def __check_init__(self):
        if jnp.shape(self.wrench) != (6,):
            raise ValueError(
                f"ExternalWrench: wrench has shape {jnp.shape(self.wrench)}, expected (6,) = (force, torque)"
            )
        if self.axes not in ("world", "body"):
            raise ValueError(f"ExternalWrench: axes is {self.axes!r}; choose 'world' or 'body'")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        # Wrench and Jacobian are both in the frame's axes, at its origin.
        wrench, model = self._in_frame(system, q), cast(Model, system)
        return body_jacobian(model, q, self.frame).T @ wrench

    def frame_wrenches(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> dict[str, Float[Array, "6"]]:
        """The wrench (f, tau) by the name of its frame, at the frame's origin and in its axes, N and N m."""
        return {self.frame: self._in_frame(system, q)}

    def _in_frame(self, system, q) -> Float[Array, "6"]:
        """The wrench at the frame's origin, in its axes."""
        if not isinstance(system, Model):
            raise ValueError(f"ExternalWrench: needs a Model with named frames, not a {type(system).__name__}")
        # Checked first, for its message with similar names.
        frame_index(system, self.frame)
        wrench = jnp.asarray(self.wrench, q.dtype)
        if self.axes == "body":
            return wrench
        # A constant direction in the world: only the rotation of the frame enters, the point of attack stays its
        # origin.
        to_body = frame_pose(system, q, self.frame)[:3, :3].T
        return jnp.concatenate([to_body @ wrench[:3], to_body @ wrench[3:]])


def is_positive(value) -> bool:
    """Decide whether a value is positive; a traced one counts as positive."""

    return not is_concrete(value) or bool((np.asarray(value) > 0).all())


def external_wrenches(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, "nb 6"]:
    """Sum of the wrenches (f, tau) of a scene's forces ON each body, at its frame's origin and in its axes.

    With `jd.constraints.body_wrenches` they are the `external` of `jd.dynamics.joint_wrench`, and `jd.sensors.ForceTorque`
    reads them. Forces that act on bodies from outside have a method `frame_wrenches(system, q, v, t)`, which gives a
    dictionary of wrenches (6,) by the names of frames, each at the frame's origin and in its axes;
    `jd.forces.ExternalWrench` has it. All other forces act in the joints, between a body and its parent, as springs,
    stops, friction and drives do: they have no wrench here.

    **Arguments:** `scene` of a `Model`; `q` (nq,); `v` (nv,); `t`, s.

    **Returns:** (nb, 6), N and N m, in the order of `model.body_names`.

    **Raises:** ValueError for shapes that do not fit, and for unknown frames.

    ```python
    pull = jd.forces.ExternalWrench(model.body_names[-1], [0.0, 0.0, -50.0, 0.0, 0.0, 0.0])
    scene = jd.Scene(model, forces=[pull])
    outer = jd.forces.external_wrenches(scene, q, v)
    bearings = jd.dynamics.joint_wrench(model, q, v, a, external=outer)
    ```
    """
    scene = as_scene(scene)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    return wrenches_where(scene, q, v, t, lambda frame: True)


def wrenches_where(scene: Scene, q, v, t, counts: Callable[[str], bool]) -> Float[Array, "nb 6"]:
    """`external_wrenches` on those frames alone whose name counts."""
    model: Any = scene.system
    total = jnp.zeros((model.nb, 6), q.dtype)
    for i, force in enumerate(scene.forces):
        of_frames = getattr(force, "frame_wrenches", None)
        if of_frames is None:
            continue
        total = total + sum_wrenches(model, q, of_frames(model, q, v, t), counts, f"forces[{i}].frame_wrenches")
    return total


def sum_wrenches(
    model: Model, q, wrenches: Mapping[str, Any], counts: Callable[[str], bool], what: str
) -> Float[Array, "nb 6"]:
    """Sum on each body of wrenches (6,) by the names of frames, at their origins and in their axes, of frames that count.

    **Raises:** ValueError, with `what` gives them, for other shapes and unknown frames.
    """
    total = jnp.zeros((model.nb, 6), q.dtype)
    for frame, wrench in wrenches.items():
        body, offset = named_frame(model, frame)
        wrench = as_array(wrench, what, q.dtype)
        if wrench.shape != (6,):
            raise ValueError(f"{what} gives shape {wrench.shape} for frame {frame!r}, expected (6,)")
        # A frame on the ground moves no body.
        if body >= 0 and counts(frame):
            at_body = se3.Ad_inv_T_apply(jnp.asarray(offset, q.dtype), wrench)
            total = total.at[body].add(at_body)
    return total
