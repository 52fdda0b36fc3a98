"""What a law controls: errors e(q, t), and errors of rates w(q, v, t), that are to vanish.

An error is written as a constraint that the motion need not satisfy yet. Its rows are those of any constraint
(`jaxdyn.constraints.base`): de/dt = A v - b and d2e/dt2 = A a - gamma, on manifold-valued q and moving targets too. A law
asks for the acceleration that makes an error decay,

    A a = gamma - Kd de/dt - Kp e     of positions,        A a = gamma - Kp w     of rates,

so that  d2e/dt2 + Kd de/dt + Kp e = 0  and  dw/dt + Kp w = 0.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.base import Constraint, position_residual, rows
from jaxdyn.constraints.rank import pseudo_inverse, tolerance
from jaxdyn.control.gains import times
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie import so3
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Number, Numbers, as_array, batch_hint
from jaxdyn.model.names import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, as_pytree
from jaxdyn.systems.system import displacement

if TYPE_CHECKING:
    Target = Numbers | Callable[[Array], Any]
else:
    Target = Any  # `as_target` looks at it

TASKS = {"position": (3,), "orientation": (3, 3), "pose": (4, 4)}


class Fixed(eqx.Module):
    """A target that does not move."""

    value: Array

    def __call__(self, t):
        return self.value


def as_target(target: Target, name: str = "target") -> Callable:
    """A target as a function of time: a function as it is, numbers as one that is constant.

    **Raises:** ValueError for what is neither, and for a function of anything but t.
    """
    if callable(target):
        return as_pytree(target, name, "t")
    array = as_array(target, name)
    return Fixed(jnp.asarray(array, array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else float))


def placed(target: Callable, t, shape: tuple, like) -> Array:
    """A target at a time, in the dtype of `like`. **Raises:** ValueError for another shape."""
    values = target(t)
    if jnp.shape(values) != shape:
        raise ValueError(f"target has shape {jnp.shape(values)}, expected {shape}{batch_hint(values, shape)}")
    return jnp.asarray(values, like.dtype)


class ConfigurationError(Constraint):
    """The displacement (nv,) from the target q_d(t) (nq,) to q, along the manifold of the system."""

    target: Callable
    name: str = eqx.field(static=True, default="configuration")

    def position(self, system, q, t):
        """q - q_d, and the twists from the target in joints that turn in space."""
        return displacement(system, placed(self.target, t, q.shape, q), q)


class FrameError(Constraint):
    """How far a named frame is from its target: p - p_d in world axes, log(R_d^T R) in the target's axes, or both."""

    target: Callable
    frame: str = eqx.field(static=True)
    task: str = eqx.field(static=True)
    name: str = eqx.field(static=True, default="frame")

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, " m"]:
        """(3,) m, (3,) rad, or both."""
        pose, target = frame_pose(system, q, self.frame), placed(self.target, t, TASKS[self.task], q)
        if self.task == "position":
            return pose[:3, 3] - target
        turned = so3.log(_product(target[:3, :3].T, pose[:3, :3]))
        return turned if self.task == "orientation" else jnp.concatenate([pose[:3, 3] - target[:3, 3], turned])


class TaskError(Constraint):
    """task(q) - target(t), (m,)."""

    task: Callable
    target: Callable
    name: str = eqx.field(static=True, default="task")

    def position(self, system, q, t):
        """task(q) - target(t)."""
        value = jnp.asarray(self.task(q), q.dtype)
        if value.ndim != 1:
            raise ValueError(f"task returned shape {value.shape}; return a vector (m,){batch_hint(value, (1,))}")
        return value - placed(self.target, t, value.shape, q)


class RateError(Constraint):
    """task(q, v) - target(t), (m,), of velocities: the task is linear in v."""

    task: Callable
    target: Callable
    name: str = eqx.field(static=True, default="rates")

    def velocity(self, system, q, v, t):
        """task(q, v) - target(t)."""
        value = jnp.asarray(self.task(q, v), q.dtype)
        if value.ndim != 1:
            raise ValueError(f"task returned shape {value.shape}; return a vector (m,){batch_hint(value, (1,))}")
        return value - placed(self.target, t, value.shape, q)


def frame_error(model: Any, frame: str, target: Any, task: str) -> FrameError:
    """The error of a frame. **Raises:** ValueError for an unknown task or frame, and for what is no `Model`."""
    if task not in TASKS:
        raise ValueError(f"task is {task!r}; choose from {', '.join(TASKS)}")
    if not isinstance(model, Model):
        raise ValueError(f"model is a {type(model).__name__}, which has no named frames; pass a Model")
    frame_index(model, frame)
    return FrameError(as_target(target), frame, task)  # pyright: ignore[reportCallIssue]


def wanted_rows(system, error: Constraint, kp, kd, q, v, t) -> tuple[Float[Array, "m nv"], Float[Array, " m"]]:
    """A (m, nv) and the right side (m,) of A a = gamma - Kd de/dt - Kp e, or gamma - Kp w without `kd`."""
    scene = Scene(system, (error,))
    row = rows(scene, q, v, t)
    if kd is None:
        return row.A, row.gamma - times(kp, row.velocity, "kp")
    return row.A, row.gamma - times(kd, row.velocity, "kd") - times(kp, position_residual(scene, q, t), "kp")


def least_acceleration(system, q, t, A, wanted, start) -> Float[Array, " nv"]:
    """The acceleration nearest to `start` (nv,), in the metric M, with A a = wanted; where rows of A depend, as near as
    can be."""
    metric = mass_factor(mass_matrix(system, q, t))
    Y = metric.whiten(A.T)
    missing = wanted - _product(A, start)
    return start + metric.unwhiten(_product(pseudo_inverse(Y, tolerance(None, Y)).T, missing))


def ordered_acceleration(system, q, t, orders, start) -> Float[Array, " nv"]:
    """The acceleration nearest to `start` (nv,), in the metric M, that meets pairs (A, wanted) in their order.

    Each is met, as near as can be, by what all before it leave free; where it cannot be, those before are not disturbed.
    """
    metric = mass_factor(mass_matrix(system, q, t))
    free, a = jnp.eye(start.shape[0], dtype=start.dtype), start
    for A, wanted in orders:
        Y = metric.whiten(A.T)
        left = _product(free, Y)
        # Where those before have taken all of the rows, rounding is left of them, which is no direction.
        sizes = [jnp.sum(jax.lax.stop_gradient(x) ** 2) for x in (left, Y)]
        left = jnp.where(sizes[0] > tolerance(None, Y) ** 2 * sizes[1], left, jnp.zeros_like(left))
        inverse = pseudo_inverse(left, tolerance(None, left)).T
        a = a + metric.unwhiten(_product(inverse, wanted - _product(A, a)))
        free = free - _product(inverse, left.T)
    return a


def regularity(system, q, t, A, T) -> Float[Array, ""]:
    """How far the rows T (m, nv) of a task are from depending on each other and on the rows A (nc, nv) of constraints, 0 to 1.

    The least sine of the angle, in the metric M^-1, between a row of T and the span of A and the rows of T before it.
    """
    metric = mass_factor(mass_matrix(system, q, t))
    Y, Z = metric.whiten(A.T), metric.whiten(T.T)
    Z = Z - _product(Y, _product(pseudo_inverse(Y, tolerance(None, Y)), Z))
    sizes = jnp.sum(metric.whiten(T.T) ** 2, 0)
    free, least = list(Z.T), []
    for i, row in enumerate(free):
        square = jnp.sum(row * row)
        some = square > 0
        least.append(square / jnp.where(sizes[i] > 0, sizes[i], jnp.ones_like(square)))
        unit = row / jnp.sqrt(jnp.where(some, square, jnp.ones_like(square)))
        free[i + 1 :] = [other - jnp.sum(unit * other) * unit for other in free[i + 1 :]]
    smallest = jnp.min(jnp.stack(least))
    some = smallest > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, smallest, jnp.ones_like(smallest))), jnp.zeros_like(smallest))


def row_rank(matrix: Float[Array, "m n"]) -> Array:
    """Number of independent rows, ()."""
    return jnp.round(jnp.sum(pseudo_inverse(matrix, tolerance(None, matrix), True) * matrix.T))
