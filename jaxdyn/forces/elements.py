"""Forces that a scene can list: joint damping and friction, springs, drives, wrenches on a body.

Each is a frozen equinox Module called as `force(system, q, v, t) -> (nv,)`; its numbers are array leaves, so
`jax.grad` and `jax.vmap` reach them. A scalar holds for every velocity coordinate it applies to. `joints` names the
joints it applies to (all of them when None); per-coordinate values are then listed in the order of these names.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.kinematics import body_jacobian, frame_pose, take
from jaxdyn.model.arguments import Number, SystemLike, batch_hint, is_concrete
from jaxdyn.model.names import frame_index
from jaxdyn.model.tree import Model, difference, neutral


class _Places(NamedTuple):
    """Where the coordinates of the chosen joints stand in q and v."""

    q: np.ndarray
    v: np.ndarray


def _places(system, joints: tuple[str, ...] | None, force: str) -> _Places:
    if joints is None:
        return _Places(np.arange(system.nq), np.arange(system.nv))
    if not isinstance(system, Model):
        raise ValueError(f"{force}: joints={joints!r} needs a Model; a {type(system).__name__} has no named joints")
    missing = [name for name in joints if name not in system.joint_names]
    if missing:
        raise ValueError(
            f"{force}: joints {missing} are not in model {system.name!r}; it has {list(system.joint_names)}"
        )
    chosen = [system.joint_names.index(name) for name in joints]
    index = np.arange(system.nq), np.arange(system.nv)
    slices = system.topology.q_slices, system.topology.v_slices
    q, v = (np.concatenate([np.zeros(0, int), *(i[s[j]] for j in chosen)]) for i, s in zip(index, slices, strict=True))
    return _Places(q, v)


def _sized(value, like: Array, size: int, name: str) -> Array:
    """A leaf as (size,) in the dtype of the state; a scalar is repeated."""
    if jnp.shape(value) not in ((), (size,)):
        raise ValueError(
            f"{name} has shape {jnp.shape(value)}, expected a scalar or {(size,)}, one per coordinate{batch_hint(value, (1,))}"
        )
    return jnp.broadcast_to(jnp.asarray(value, like.dtype), (size,))


def _spread(values: Array, places: np.ndarray, size: int) -> Array:
    """Values at their places in a vector of zeros; the values themselves when they fill it in order."""
    if len(places) == size and (places == np.arange(size)).all():
        return values
    return jnp.zeros((size,), values.dtype).at[places].set(values)


def _leaf(value) -> Any:
    """A number given by the user as an array leaf, of floating and not of weak type: a new value never recompiles."""
    if value is None:
        return None
    value = jnp.asarray(value)
    return jnp.asarray(value, value.dtype if jnp.issubdtype(value.dtype, jnp.inexact) else float)


def _names(joints) -> tuple[str, ...] | None:
    return joints if joints is None else (joints,) if isinstance(joints, str) else tuple(joints)


def _own_or_model(value, system, places: _Places, field: str, force: str):
    if value is not None:
        return value
    leaf = getattr(system, field, None)
    if leaf is None:
        raise ValueError(f"{force}: no value given and the system has no {field}; pass one, or set the model's {field}")
    return take(leaf, places.v)


def _displacement(system, rest, q, places: _Places, name: str) -> Array:
    """Difference (per velocity coordinate of the chosen joints) from `rest` to q, on the joints' manifold."""
    if not isinstance(system, Model):
        return take(q, places.q) - _sized(rest, q, len(places.q), name)
    if jnp.shape(rest) == () and len(places.q) != len(places.v):
        raise ValueError(
            f"{name} is a scalar, but a joint with a quaternion needs all its coordinates, {len(places.q)} here"
        )
    # Joints not chosen are compared with themselves: exactly zero, whatever their place.
    start = q.at[places.q].set(_sized(rest, q, len(places.q), name))
    return take(difference(system, start, q), places.v)


class JointDamping(eqx.Module):
    """Viscous friction: tau = -coefficient * v.

    **Arguments:** `coefficient` (N m s or N s), scalar or one per coordinate; None takes the model's `damping` leaf.
    `joints`, names of the joints, or None for all.

    **Raises:** (when called) ValueError for unknown joints, a wrong shape, or no coefficient anywhere.
    """

    coefficient: Float[Array, "..."] | None = eqx.field(converter=_leaf, default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        places = _places(system, self.joints, "JointDamping")
        value = _own_or_model(self.coefficient, system, places, "damping", "JointDamping")
        rate = take(v, places.v)
        return _spread(-_sized(value, v, rate.size, "JointDamping: coefficient") * rate, places.v, system.nv)


class CoulombFriction(eqx.Module):
    """Dry friction, smoothed: tau = -level * tanh(v / v_s).

    The jump at v = 0 is replaced by a slope level / v_s, so that solutions are unique and gradients exist. There is no
    sticking: under a load below `level` a joint creeps at v = v_s artanh(load / level). Within 1 % of `level` above
    2.65 v_s. A small v_s makes the equations stiff (rate level / (v_s * inertia)): take an implicit solver or a
    larger v_s.

    **Arguments:** `level` (N m or N), scalar or one per coordinate; None takes the model's `friction` leaf. `v_s`,
    smoothing velocity (rad/s or m/s), positive. `joints`, names of the joints, or None for all.

    **Raises:** ValueError for a `v_s` that is not positive; (when called) for unknown joints, a wrong shape, or no
    level.
    """

    level: Float[Array, "..."] | None = eqx.field(converter=_leaf, default=None)
    v_s: Float[Array, "..."] = eqx.field(converter=_leaf, default=1e-2)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __check_init__(self):
        if not _all_positive(self.v_s):
            raise ValueError(f"CoulombFriction: v_s is {self.v_s}; give a positive smoothing velocity, e.g. 0.01 rad/s")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        places = _places(system, self.joints, "CoulombFriction")
        level = _own_or_model(self.level, system, places, "friction", "CoulombFriction")
        rate = take(v, places.v)
        ratio = rate / _sized(self.v_s, v, rate.size, "CoulombFriction: v_s")
        return _spread(-_sized(level, v, rate.size, "CoulombFriction: level") * jnp.tanh(ratio), places.v, system.nv)


class JointSpring(eqx.Module):
    """Spring in the joints: tau = -stiffness * difference(rest, q), along the joints' manifold.

    Conservative, with the energy stiffness |difference|^2 / 2, for joints of one coordinate and for spherical joints
    of equal stiffness about the three axes. In planar and free joints the force is along the twist that leads back to
    rest.

    **Arguments:** `stiffness` (N m/rad or N/m), scalar or one per velocity coordinate. `rest`, configuration (nq of the
    chosen joints,) at which it is relaxed (rad, m, unit quaternions), a scalar for joints of one coordinate, None for
    neutral. `joints`, names of the joints, or None for all.

    **Raises:** (when called) ValueError for unknown joints or a wrong shape.
    """

    stiffness: Float[Array, "..."] = eqx.field(converter=_leaf)
    rest: Float[Array, "..."] | None = eqx.field(converter=_leaf, default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        places = _places(system, self.joints, "JointSpring")
        rest = self.rest
        if rest is None:
            rest = take(neutral(system), places.q) if isinstance(system, Model) else jnp.zeros(places.q.size, q.dtype)
        stretch = _displacement(system, rest, q, places, "JointSpring: rest")
        return _spread(
            -_sized(self.stiffness, q, stretch.size, "JointSpring: stiffness") * stretch, places.v, system.nv
        )


class Drive(eqx.Module):
    """Position and velocity drive: tau = kp * difference(q, target) + kd * (target_velocity - v).

    The difference is taken along the joints' manifold. With `effort_limit` L the command u is passed through L tanh(u
    / L): smooth, never above L, within 1 % of u below 0.17 L. For a target that moves with time write a `control`.

    **Arguments:** `kp` (N m/rad or N/m), `kd` (N m s/rad or N s/m), `target_velocity` (rad/s or m/s), `effort_limit`
    (N m or N; None or infinite for no limit): scalar or one per velocity coordinate. `target` (nq of the chosen
    joints,), or a scalar for joints of one coordinate. `joints`, names of the joints, or None for all.

    **Raises:** ValueError for an `effort_limit` that is not positive; (when called) for unknown joints or a wrong
    shape.
    """

    kp: Float[Array, "..."] = eqx.field(converter=_leaf)
    kd: Float[Array, "..."] = eqx.field(converter=_leaf)
    target: Float[Array, "..."] = eqx.field(converter=_leaf)
    target_velocity: Float[Array, "..."] = eqx.field(converter=_leaf, default=0.0)
    effort_limit: Float[Array, "..."] | None = eqx.field(converter=_leaf, default=None)
    joints: tuple[str, ...] | None = eqx.field(static=True, converter=_names, default=None)

    def __check_init__(self):
        if self.effort_limit is not None and not _all_positive(self.effort_limit):
            raise ValueError(f"Drive: effort_limit is {self.effort_limit}; give positive limits, or None for no limit")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        places = _places(system, self.joints, "Drive")
        size = places.v.size
        kp, kd, rate = (
            _sized(value, v, size, f"Drive: {name}")
            for name, value in (("kp", self.kp), ("kd", self.kd), ("target_velocity", self.target_velocity))
        )
        error = -_displacement(system, self.target, q, places, "Drive: target")
        command = kp * error + kd * (rate - take(v, places.v))
        if self.effort_limit is not None:
            limit = _sized(self.effort_limit, v, size, "Drive: effort_limit")
            bounded = jnp.isfinite(limit)
            safe = jnp.where(bounded, limit, jnp.ones_like(limit))  # keeps inf * 0 out of the gradient
            command = jnp.where(bounded, safe * jnp.tanh(command / safe), command)
        return _spread(command, places.v, system.nv)


class ExternalWrench(eqx.Module):
    """Constant wrench on a body: tau = J^T F, with J the body Jacobian of the frame it is given in.

    **Arguments:** `frame`, name of a body or frame; the wrench acts at its origin. `wrench` (6,), (f, tau) in N and N
    m, acting on the body. `axes`: "world", the wrench keeps its direction in the world; "body", it turns with the
    frame.

    **Raises:** ValueError for a wrench that is not (6,) or unknown axes; (when called) for an unknown frame.
    """

    frame: str = eqx.field(static=True)
    wrench: Float[Array, "..."] = eqx.field(converter=_leaf)
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
        if not isinstance(system, Model):
            raise ValueError(f"ExternalWrench: needs a Model with named frames, not a {type(system).__name__}")
        frame_index(system, self.frame)
        wrench = jnp.asarray(self.wrench, q.dtype)
        if self.axes == "world":
            to_body = frame_pose(system, q, self.frame)[:3, :3].T
            wrench = jnp.concatenate([to_body @ wrench[:3], to_body @ wrench[3:]])
        return body_jacobian(system, q, self.frame).T @ wrench


def _all_positive(value) -> bool:
    """False when a value is known and not positive; a traced one is taken on trust."""

    return not is_concrete(value) or bool((np.asarray(value) > 0).all())
