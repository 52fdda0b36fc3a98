"""Control errors e(q, t), and errors of rates w(q, v, t), as constraint rows, with gains and the loop of constraint forces.

An error is a constraint that the motion need not satisfy. Its rows are those of any constraint
(`jaxdyn.constraints.base`): de/dt = A v - b and d2e/dt2 = A a - gamma, on manifold-valued q and moving targets too. A law
commands an acceleration for which the error decays,

    A a = gamma - Kd de/dt - Kp e     of positions,        A a = gamma - Kp w     of rates,

so that  d2e/dt2 + Kd de/dt + Kp e = 0  and  dw/dt + Kp w = 0.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxdyn.constraints.base import Constraint, layout, position_residual, rows
from jaxdyn.constraints.rank import pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.dynamics.centroidal import center_of_mass
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie import so3
from jaxdyn.lie.series import safe_sqrt
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers, as_array, as_float, as_shape, batch_hint, is_concrete
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.simulation.controls import Controller
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, as_pytree
from jaxdyn.systems.system import displacement


def gain(value: Any, name: str) -> Array:
    """Convert a gain to an array leaf: (), (n,) for a diagonal matrix, or (n, n).

    **Raises:** ValueError, for concrete numbers, for a gain that is not positive definite: its symmetric part has
    an eigenvalue that is zero, negative or not finite.
    """
    array = as_array(value, name)
    if array.ndim > 2 or (array.ndim == 2 and array.shape[0] != array.shape[1]):
        raise ValueError(
            f"{name} has shape {array.shape}; give a number, (n,) for a diagonal matrix, or a matrix (n, n)"
        )
    if is_concrete(array):
        # Only the symmetric part enters e . K e, so it alone decides definiteness.
        known = np.asarray(array, float)
        # `initial` admits a gain for no rows, which has no least entry.
        minimum = np.linalg.eigvalsh((known + known.T) / 2).min() if known.ndim == 2 else known.min(initial=np.inf)
        if not (np.isfinite(known).all() and minimum > 0):
            raise ValueError(f"{name} is {known.tolist()}, which is not positive definite; give positive gains")
    # Integer gains become floating-point leaves: `jax.grad` refuses integers.
    return as_float(array, name)


def times(gain: Array, error: Float[Array, " n"], name: str) -> Float[Array, " n"]:
    """Product K e for a gain of any shape. **Raises:** ValueError for one of another size."""
    if gain.ndim and gain.shape[0] != error.shape[0]:
        raise ValueError(
            f"{name} has shape {gain.shape} for an error of {error.shape[0]} rows; give a number, {error.shape} or "
            f"{error.shape * 2}"
        )
    # A float64 gain would promote the law of a float32 state.
    gain = gain.astype(error.dtype)
    return matmul(gain, error) if gain.ndim == 2 else gain * error


def as_matrix(gain: Array, like: Float[Array, " n"], name: str) -> Float[Array, "n n"]:
    """Matrix (n, n) of a gain."""
    # Column by column through `times`, so that numbers, diagonals and matrices follow one rule.
    unit = jnp.eye(like.shape[0], dtype=like.dtype)
    return jnp.stack([times(gain, column, name) for column in unit], 1)


if TYPE_CHECKING:
    Target = Numbers | Callable[[Array], Any]
else:
    Target = Any  # `as_target` checks it

TASKS = {"position": (3,), "orientation": (3, 3), "pose": (4, 4)}


# A Module and not a closure, so that the value is a leaf: another constant does not cause a second compilation.
class Fixed(eqx.Module):
    """Constant target."""

    value: Array

    def __call__(self, t):
        return self.value


def as_target(target: Target, name: str = "target") -> Callable:
    """Convert a target to a function of time; numbers become a constant one.

    **Raises:** ValueError for other types, and for a function of other arguments than t.
    """
    if callable(target):
        return as_pytree(target, name, "t")
    return Fixed(as_float(target, name))


def target_value(target: Callable, t, shape: tuple, like) -> Array:
    """Value of a target at time t, in the dtype of `like`. **Raises:** ValueError for another shape."""
    # A float64 target would promote the law of a float32 state.
    return jnp.asarray(as_shape(target(t), "target", like.dtype, shape))


class ConfigurationError(Constraint):
    """Displacement (nv,) from the target q_d(t) (nq,) to q, along the manifold of the system."""

    target: Callable
    name: str = eqx.field(static=True, default="configuration", kw_only=True)

    def position(self, system, q, t):
        """Displacement q - q_d; twists from the target for planar, spherical and free joints."""
        return displacement(system, target_value(self.target, t, q.shape, q), q)


class FrameError(Constraint):
    """Error of a named frame: p - p_d in world axes, log(R_d^T R) in the target's axes, or both."""

    target: Callable
    frame: str = eqx.field(static=True)
    task: str = eqx.field(static=True)
    name: str = eqx.field(static=True, default="frame", kw_only=True)

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, " m"]:
        """Error of position (3,), m, of orientation (3,), rad, or both."""
        pose, target = frame_pose(system, q, self.frame), target_value(self.target, t, TASKS[self.task], q)
        if self.task == "position":
            return pose[:3, 3] - target
        # The logarithm jumps at half a turn from the target: the laws are valid for smaller errors.
        turned = so3.log(matmul(target[:3, :3].T, pose[:3, :3]))
        return turned if self.task == "orientation" else jnp.concatenate([pose[:3, 3] - target[:3, 3], turned])


class CenterError(Constraint):
    """Error c(q) - c_d(t) of the centre of mass, (3,), m, in world axes."""

    target: Callable
    name: str = eqx.field(static=True, default="center_of_mass", kw_only=True)

    def sizes(self, system, dtype):
        """Three rows."""
        return 3, 0

    def position(self, system: Model, q: Float[Array, " nq"], t: Number) -> Float[Array, "3"]:
        """Error of the position, m."""
        return center_of_mass(system, q) - target_value(self.target, t, (3,), q)


def _task_error(value, target, t, like) -> Float[Array, " m"]:
    value = as_array(value, "task", like.dtype)
    if value.ndim != 1:
        raise ValueError(f"task returned shape {value.shape}; return a vector (m,){batch_hint(value, (1,))}")
    return value - target_value(target, t, value.shape, like)


class TaskError(Constraint):
    """Error task(q) - target(t), (m,)."""

    task: Callable
    target: Callable
    name: str = eqx.field(static=True, default="task", kw_only=True)

    def position(self, system, q, t):
        """Error task(q) - target(t)."""
        return _task_error(self.task(q), self.target, t, q)


class RateError(Constraint):
    """Error task(q, v) - target(t), (m,), of velocities, linear in v."""

    task: Callable
    target: Callable
    name: str = eqx.field(static=True, default="rates", kw_only=True)

    def velocity(self, system, q, v, t):
        """Error task(q, v) - target(t)."""
        return _task_error(self.task(q, v), self.target, t, q)


def frame_error(model: Any, frame: str, target: Any, task: str) -> FrameError:
    """Error of a frame. **Raises:** ValueError for an unknown task or frame, and for anything but a `Model`."""
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"task is {task!r}; choose from {', '.join(TASKS)}")
    if not isinstance(model, Model):
        raise ValueError(f"model is a {type(model).__name__}, which has no named frames; pass a Model")
    frame_index(model, frame)
    return FrameError(as_target(target), frame, task)


def target_rows(system, error: Constraint, kp, kd, q, v, t) -> tuple[Float[Array, "m nv"], Float[Array, " m"]]:
    """Matrix A (m, nv) and right-hand side (m,) of A a = gamma - Kd de/dt - Kp e, or gamma - Kp w without `kd`."""
    scene = Scene(system, (error,))
    row = rows(scene, q, v, t)
    if kd is None:
        # Errors of velocities have no error of position: the gain kp acts on w itself.
        return row.A, row.gamma - times(kp, row.velocity, "kp")
    return row.A, row.gamma - times(kd, row.velocity, "kd") - times(kp, position_residual(scene, q, t), "kp")


def hierarchical_acceleration(system, q, t, orders, start) -> Float[Array, " nv"]:
    """Acceleration closest to `start` (nv,), in the metric M, with A a = wanted for pairs (A, wanted) by priority.

    Each is met, in the least-squares sense, in the null space of all before it, which it does not disturb.
    """
    metric = mass_factor(mass_matrix(system, q, t))
    # In whitened coordinates the null-space projection of the metric M is an orthogonal one.
    free, a = jnp.eye(start.shape[0], dtype=start.dtype), start
    for A, wanted in orders:
        Y = metric.whiten(A.T)
        # Rows spanned by those of higher priority leave rounding errors, which must not count as directions.
        # The second projection removes what rounding of the first leaves along rows of higher priority. Without it a row that
        # nearly depends on these would disturb them.
        left = drop_rounding(matmul(free, matmul(free, Y)), Y)
        inverse = pseudo_inverse(left, tolerance(None, left)).T
        # Rows of lower priority correct what those above them have left, within the null space of these.
        a = a + metric.unwhiten(matmul(inverse, wanted - matmul(A, a)))
        # inverse left^T projects on the range of `left`, so that `free` remains an orthogonal projection.
        free = free - matmul(inverse, left.T)
    return a


def drop_rounding(left: Array, whole: Array) -> Array:
    """Replace the projected rows `left` by zeros where they are no larger than the rounding errors of the rows `whole`."""
    # A decision on rank has no derivative.
    sizes = [jnp.sum(jax.lax.stop_gradient(x) ** 2) for x in (left, whole)]
    return jnp.where(sizes[0] > tolerance(None, whole) ** 2 * sizes[1], left, jnp.zeros_like(left))


def regularity(system, q, t, A, T, passive: Sequence[int] = ()) -> Float[Array, ""]:
    """Distance, 0 to 1, of the rows T (m, nv) of a task from dependence on each other and on constraints A (nc, nv).

    Defined as the least sine of the angle, in the metric M^-1, between a row of T and the span of A and the rows of T
    before it. For each of the `passive` velocities, which no motor drives, also the sine of the angle, in the metric M, between
    a motion of it alone and the span of the motions that A allows and of those of the passive velocities before it: where that
    is zero, the mechanism moves with its motors at rest.
    """
    M = mass_matrix(system, q, t)
    metric = mass_factor(M)
    Y, Z = metric.whiten(A.T), metric.whiten(T.T)
    fixed = matmul(Y, pseudo_inverse(Y, tolerance(None, Y)))
    # What remains of a row without the span of the constraints measures its independence of them.
    minimum = _squared_sines(Z - matmul(fixed, Z), Z)
    if len(passive):
        # U^T v = U^-1 M v has the length of the velocity v in the metric M.
        idle = metric.whiten(M[:, np.array(passive, int)])
        minimum += _squared_sines(matmul(fixed, idle), idle)
    return safe_sqrt(jnp.min(jnp.stack(minimum)))


def _squared_sines(left: Float[Array, "n m"], whole: Float[Array, "n m"]) -> list[Float[Array, ""]]:
    """Squared length of each column of `left` without the span of those before it, over that of the same column of `whole`."""
    sizes = jnp.sum(whole**2, 0)
    free, squares = list(left.T), []
    # Gram-Schmidt by hand: every quotient is safe at zero, so that derivatives are finite at a singularity too.
    for i, row in enumerate(free):
        square = jnp.sum(row * row)
        some = square > 0
        squares.append(square / jnp.where(sizes[i] > 0, sizes[i], jnp.ones_like(square)))
        unit = row / jnp.sqrt(jnp.where(some, square, jnp.ones_like(square)))
        free[i + 1 :] = [other - jnp.sum(unit * other) * unit for other in free[i + 1 :]]
    return squares


def row_rank(matrix: Float[Array, "m n"]) -> Array:
    """Number of independent rows, ()."""
    return rank_of(matrix, pseudo_inverse(matrix, tolerance(None, matrix), True))


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
        of = ", one per row of the constraints"
        return jnp.asarray(as_shape(self.force(t), "force", q.dtype, (count,), of=of))

    def force_command(self, q: Float[Array, " nq"], t: Number, state: PyTree) -> Float[Array, " nc"]:
        """Force command -lam_d + KI z."""
        # The sign follows M a + h = tau + A^T lam: a reference multiplier is cancelled by the opposite torque.
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
