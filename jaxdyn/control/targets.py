"""Targets of frames and of the centre of mass as constraint rows, and the search for a configuration that meets them.

Rows of positions are in m, in the axes of the target; those of orientations are the rotation vector from the target to the frame,
rad, and those of directions the two components of the rotation that takes the target's direction to the frame's.

The search is by damped least squares: rows of constraints exactly, rows of targets as well as limits allow.
A step d, in coordinates scaled by the sizes of joints, is the shortest one in the sense of

    min |d|^2 + |R d + r|^2 / Lam:   d = -R^T (R R^T + Lam)^-1 r,

with the rows R of the constraints, for which Lam is rounding, and those of the targets, for which it is the damping. The
damping is in proportion to what is left of the errors, so that steps are Newton's in the end and short where a target is out
of reach (Sugihara 2011). Joints at a limit that the step would pass are left out of the rows. Where a search stalls it
begins again somewhere else, as often as allowed, and ends with the best place that it has met.

All of it is one loop in machine code, in which every sample of a batch advances independently.

Sources: Sugihara (2011), Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method, eqs. 8 to 13; Baerlocher
& Boulic (2004) for limits.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile.kernels import Carry, Given, Iteration, Task, run_loop
from jaxdyn.compile.known import is_concrete, is_known, stop_gradient
from jaxdyn.constraints.assembly import closing_tolerance
from jaxdyn.constraints.base import Constraint, constraint_jacobian, holonomic_rows, layout, position_residual
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.rank import eps_of
from jaxdyn.constraints.redundancy import coordinate_sizes, own_length
from jaxdyn.constraints.rolling import tangents
from jaxdyn.control.errors import CenterError, Fixed
from jaxdyn.lie import so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import (
    as_operand,
    batch_hint,
    check_mapping,
)
from jaxdyn.model.host_math import ORTHONORMAL_TARGET, rotation_fault
from jaxdyn.model.topology import SCREW_KINDS, frame_index
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

CENTER = "center_of_mass"
_SHAPES = {"pose": (4, 4), "orientation": (3, 3), "position": (3,), "direction": (3,)}
TASKS = tuple(_SHAPES)
_ROWS = {"pose": (3, 3), "orientation": (0, 3), "position": (3, 0), "direction": (0, 2)}


class FrameTarget(Pair):
    """A pose, position, orientation or direction of the z axis of frame `pose` in a named frame, in the world."""

    name: str = eqx.field(static=True)
    frame: str = eqx.field(static=True)
    task: str = eqx.field(static=True)
    target: Float[Array | np.ndarray, "4 4"]
    pose: Float[Array | np.ndarray, "4 4"]

    def sizes(self, system, dtype):
        """Rows of the position and of the orientation, all holonomic."""
        return sum(_ROWS[self.task]), 0

    def ends(self):
        """The target in the world, and the frame."""
        return (None, self.target), (self.frame, self.pose)

    def structure_key(self):
        """The task."""
        return (self.task,)

    def pose_residual(self, R, p):
        """Errors of position and orientation."""
        if self.task == "position":
            return p
        if self.task == "direction":
            # The rotation of least angle that takes the target's z axis to the frame's, of quaternion (w, -y/2w, x/2w, 0) with
            # w = cos(theta / 2). For opposite directions every axis orthogonal to z is one of half a turn: y is taken. Without
            # a choice the residual of half a turn would be zero there.
            x, y, z = R[0, 2], R[1, 2], R[2, 2]
            near = float(jnp.finfo(R.dtype).eps) ** 0.5
            x = jnp.where((z < 0) & (x * x + y * y < near * near), x + near, x)
            # w^2 = (1 + z) / 2; below the horizon by (1 + z) (1 - z) = x^2 + y^2, which does not cancel.
            square = jnp.where(z < 0, (x * x + y * y) / (2 * (1 - jnp.minimum(z, 0))), 0.5 * (1 + jnp.maximum(z, 0)))
            w = jnp.sqrt(square)
            vector = so3.quat_log(jnp.stack([w, -0.5 * y / w, 0.5 * x / w, jnp.zeros_like(x)]))
            return vector[:2]
        turned = so3.log(R)
        return turned if self.task == "orientation" else jnp.concatenate([p, turned])


def as_targets(model: Any, targets: Any) -> tuple[Constraint, ...]:
    """Targets by the names of frames as constraints (see `inverse_kinematics`).

    **Raises:** ValueError for unknown frames, shapes that are none of a target's, and matrices that are no rotations.
    """
    if not isinstance(model, Model):
        raise ValueError(f"scene: a {type(model).__name__} has no frames; inverse_kinematics needs a Model")
    if not isinstance(targets, Mapping) or not targets:
        raise ValueError(f"targets is {targets!r}; give a dictionary of targets by the names of frames")
    rows: list[Constraint] = []
    for name, value in targets.items():
        # A frame of the model by this name has precedence.
        if name == CENTER and CENTER not in model.frame_names:
            target = Fixed(jnp.asarray(_numbers(value, CENTER, (3,), model.home.dtype)))
            rows.append(CenterError(target=target, name=CENTER))
            continue
        frame_index(model, name)  # refuses unknown names
        tasks = dict(value) if isinstance(value, Mapping) else {_task_of(name, value): value}
        axis = tasks.pop("axis", (0.0, 0.0, 1.0))
        axis = _numbers(axis, f"targets[{name!r}]: axis", (3,), model.home.dtype)
        if not tasks:
            raise ValueError(f"targets[{name!r}] is {value}, which names no target; give some of {', '.join(TASKS)}")
        for task, number in tasks.items():
            if task not in _SHAPES:
                raise ValueError(f"targets[{name!r}] has the key {task!r}; choose from {', '.join(TASKS)}, axis")
            number = _numbers(number, f"targets[{name!r}]", _SHAPES[task], model.home.dtype)
            label = name if len(tasks) == 1 else f"{name} {task}"
            rows.append(_frame_target(label, name, task, number, axis))
    return tuple(rows)


def target_rows(target: Constraint) -> tuple[int, int]:
    """Numbers of rows in m, and of those in rad."""
    return _ROWS[target.task] if isinstance(target, FrameTarget) else (3, 0)


def row_weights(rows: tuple[Constraint, ...], weights, dtype) -> Array | np.ndarray:
    """Weights (m,) of all rows of the targets."""
    weights = check_mapping(weights, "weights", f"{{{rows[0].name!r}: 2.0}}")
    names = {row.name.partition(" ")[0] if row.name not in weights else row.name for row in rows}
    unknown = set(weights) - {row.name for row in rows} - {getattr(row, "frame", row.name) for row in rows}
    if unknown:
        raise ValueError(f"weights names {sorted(unknown)}, which are no targets; targets are {sorted(names)}")
    parts = []
    for row in rows:
        count = sum(target_rows(row))
        value = weights.get(row.name, weights.get(getattr(row, "frame", row.name), 1.0))
        value = as_operand(value, f"weights[{row.name!r}]", dtype)
        if value.shape not in ((), (count,)):
            raise ValueError(
                f"weights[{row.name!r}] has shape {value.shape}; give one number, or {(count,)}, one per row of the target"
            )
        if is_concrete(value) and not (np.isfinite(value).all() and (np.asarray(value) >= 0).all()):
            raise ValueError(f"weights[{row.name!r}] is {np.asarray(value)}; give numbers that are not negative")
        parts.append((value, count))
    join: Any = np if is_known([value for value, _ in parts]) else jnp
    return join.concatenate([join.broadcast_to(value, (count,)) for value, count in parts])


def _task_of(name: str, value) -> str:
    shape = np.shape(value)
    kinds = {(4, 4): "pose", (3, 3): "orientation", (3,): "position"}
    if shape not in kinds:
        hint = batch_hint(value, (4, 4)) or batch_hint(value, (3,))
        raise ValueError(
            f"targets[{name!r}] has shape {shape}; give a pose (4, 4), an orientation (3, 3), a position (3,), or a "
            f"dictionary with some of {', '.join(TASKS)}, axis{hint}"
        )
    return kinds[shape]


def _numbers(value, name: str, shape: tuple, dtype):
    value = as_operand(value, name, dtype)
    if value.shape != shape:
        raise ValueError(f"{name} has shape {value.shape}, expected {shape}{batch_hint(value, shape)}")
    if is_concrete(value):
        known = np.asarray(value)
        if not np.isfinite(known).all():
            raise ValueError(f"{name} is {known}; give finite numbers")
        R = known[:3, :3] if len(shape) == 2 else np.eye(3)
        if fault := rotation_fault(R, ORTHONORMAL_TARGET):
            raise ValueError(f"{name}: its rotation is no rotation matrix: it {fault}; normalise it")
    return value


def _frame_target(label: str, frame: str, task: str, number, axis) -> FrameTarget:
    still, none = np.eye(3, dtype=number.dtype), np.zeros(3, number.dtype)
    target = pose = np.eye(4, dtype=number.dtype)
    if task == "pose":
        target = number
    elif task == "orientation":
        target = _pose(number, none)
    elif task == "position":
        target = _pose(still, number)
    else:
        target = _pose(_frame_along(jnp.asarray(number), f"targets[{frame!r}]: direction"), none)
        pose = _pose(_frame_along(jnp.asarray(axis, number.dtype), f"targets[{frame!r}]: axis"), none)
    if not is_known(number, axis):
        target, pose = jnp.asarray(target), jnp.asarray(pose)
    return FrameTarget(label, frame, task, target, pose)


def _pose(R, p):
    join = np if is_known(R, p) else jnp
    bottom = np.eye(4, dtype=R.dtype)[3:]
    return join.concatenate([join.concatenate([R, p[:, None]], 1), bottom])


def _frame_along(direction, name: str) -> Float[Array, "3 3"]:
    """A rotation whose z axis is along a direction."""
    if is_concrete(direction) and not np.linalg.norm(np.asarray(direction)) > 0:
        raise ValueError(f"{name} is {np.asarray(direction)}; give a vector of some length")
    # Only z enters the residual. x and y are arbitrary: they choose the axes of its two components.
    unit = direction / jnp.sqrt(matmul(direction, direction))
    return jnp.concatenate([tangents(unit), unit[None]]).T


# Steps of one search from one place, and of the last one, which starts at the best place.
_STEPS, _LAST_STEPS = 40, 100
# The damping of the first step, and its factors where a step has reduced the errors, and where it has not.
_DAMPING, _LESS, _MORE = 1e-2, 0.2, 6.0
_LARGEST_STEP = 1.0  # rad or lengths of the mechanism
# A search ends where a step reduces the squared errors by a smaller part than this; the last one continues longer.
_MIN_GAIN, _MIN_LAST_GAIN = 1e-2, 1e-9


class Aims(NamedTuple):
    """Aims of a search.

    - `weights`, `shift`, `tolerances` (nh,): factors of the rows; the residuals to be reached, zero in the end; how near.
    - `is_exact` (nh,): 1 for rows of constraints, 0 for rows of targets.
    - `lower`, `upper` (nq,): limits, infinite where there are none.
    """

    weights: Array
    shift: Array
    tolerances: Array
    is_exact: Array
    lower: Array
    upper: Array


def reaches_targets(scene: Scene, q, t, aims: Aims):
    """Decide whether all rows are within their tolerances."""
    r = aims.weights * position_residual(scene, q, t)
    return jnp.all(jnp.abs(r) <= aims.tolerances)


def aims_of(whole: Scene, constraints: int, factors, limits: bool, atol) -> Aims:
    """Weights and tolerances of all rows; rows of targets in m count in units of the mechanism's length."""
    model, dtype = whole.system, factors.dtype
    length = lax.stop_gradient(own_length(model)).astype(dtype)
    targets = whole.constraints[constraints:]
    nh = holonomic_rows(layout(whole)).size
    is_length = np.concatenate([np.repeat([True, False], target_rows(target)) for target in targets])
    # In units of the mechanism's length, errors in m are comparable with those in rad.
    scale = jnp.where(is_length, 1 / length, jnp.ones_like(length))
    count = nh - is_length.size
    weights = jnp.concatenate([jnp.ones((count,), dtype), factors * scale])
    near = closing_tolerance(dtype) if atol is None else atol
    minimum = near * (jnp.maximum(length, 1.0) if atol is None else jnp.ones_like(length))
    # Tolerances have the weights of their rows: a weight of zero gives a row and a tolerance of zero, which counts as reached.
    tolerances = jnp.concatenate([jnp.broadcast_to(minimum, (count,)), minimum * factors * scale])
    exact = jnp.asarray(np.arange(nh) < count, dtype)
    endless = jnp.full_like(model.lower, jnp.inf)
    lower, upper = (model.lower, model.upper) if limits else (-endless, endless)
    return Aims(weights, jnp.zeros((nh,), dtype), tolerances, exact, *stop_gradient((lower, upper)))


class SearchState(NamedTuple):
    """State of a search.

    The configuration, the damping, the steps from this place and the places tried, and the best configuration with its squared
    errors.

    `guess` is the place from which others are found.
    """

    q: Array
    damping: Array
    steps: Array
    tried: Array
    best: Array
    minimum: Array
    guess: Array
    done: Array


def search(scene: Scene, q, t, aims: Aims, guesses: int) -> tuple[Array, Array]:
    """The best configuration that is met, and how many places were tried; constants.

    `scene` has the targets after the constraints; `guesses` counts the places from which a search may begin.
    """
    q = clip_to_limits(scene.system, q, aims)
    none = jnp.zeros((), jnp.int32)
    large = jnp.full((), jnp.inf, q.dtype)
    state = SearchState(q, jnp.full((), _DAMPING, q.dtype), none, none + 1, q, large, q, jnp.asarray(False))
    state = run_loop(Task(_step, (guesses,)), scene, (t, aims), Given(), Carry(state)).state
    return state.best, state.tried


def _step(guesses: int, scene: Scene, constants, state: SearchState, _) -> Iteration:
    t, aims = constants
    q, damping = state.q, state.damping
    r = residual(scene, q, t, aims)
    errors = jnp.sum(r * r)
    # In proportion to the squared errors (Sugihara 2011), the damping vanishes at a solution.
    step = _levenberg_marquardt_step(scene, q, t, aims, r, damping * errors)
    tried = clip_to_limits(scene.system, retract(scene.system, displace(scene.system, q, step)), aims)
    left = residual(scene, tried, t, aims)
    new = jnp.sum(left * left)
    # A residual of NaN compares false: the step is refused, and `stops` ends the search from this place.
    falls = new < errors
    q, after = jnp.where(falls, tried, q), jnp.where(falls, new, errors)
    damping = jnp.clip(jnp.where(falls, _LESS * damping, _MORE * damping), 1e-8, 1e8)
    is_better = after < state.minimum
    best, minimum = jnp.where(is_better, q, state.best), jnp.where(is_better, after, state.minimum)

    # Rows that are there already count as such, whatever their weights.
    reached = jnp.all(jnp.where(falls, jnp.abs(left) <= aims.tolerances, jnp.abs(r) <= aims.tolerances))
    is_last = state.tried >= guesses
    gain = jnp.where(is_last, _MIN_LAST_GAIN, _MIN_GAIN).astype(q.dtype)
    stops = (falls & (new > (1 - gain) * errors)) | (damping >= 1e6)
    stops = stops | (state.steps >= jnp.where(is_last, _LAST_STEPS, _STEPS)) | ~jnp.isfinite(new)
    elsewhere = stops & ~is_last & ~reached
    tried_next = state.tried + elsewhere.astype(jnp.int32)
    other = _place(scene.system, state.guess, tried_next, aims)
    other = jnp.where(tried_next >= guesses, best, other)
    done = reached | (stops & is_last)
    after = SearchState(
        jnp.where(elsewhere, other, q),
        jnp.where(elsewhere, jnp.full_like(damping, _DAMPING), damping),
        jnp.where(elsewhere, jnp.zeros_like(state.steps), state.steps + 1),
        tried_next,
        best,
        minimum,
        state.guess,
        done,
    )
    return Iteration(after, ~state.done, ~done)


def residual(scene: Scene, q, t, aims: Aims):
    """Residuals of constraints and targets, less what is to be left of them, times their weights."""
    return aims.weights * (position_residual(scene, q, t) - aims.shift)


def _levenberg_marquardt_step(scene: Scene, q, t, aims: Aims, r, damping):
    """The step (nv,) of damped least squares for the residuals r, within the limits."""
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    R = constraint_jacobian(scene, q, t)[holonomic_rows(layout(scene))] * aims.weights[:, None] * sizes[None]

    def shortest(R):
        # In the space of rows, each row has its own damping: exact rows have none.
        gram = matmul(R, R.T)
        diagonal = jnp.diagonal(gram)
        # Rows that depend on others are met with them; rows that are zero are left out.
        rounding = 64 * eps_of(q) * (diagonal + jnp.max(diagonal)) + float(jnp.finfo(q.dtype).tiny) ** 0.5
        gram = gram + jnp.diag(rounding + damping * (1 - aims.is_exact))
        return -matmul(R.T, solve_cholesky(cholesky(gram), r))

    step = shortest(R)
    # Once only: where the new step would pass other limits, the caller clips it, and the next step leaves those joints out.
    at_q, at_v = screw_joints(scene.system)
    if at_q.size:
        low = (q[at_q] <= aims.lower[at_q]) & (step[at_v] < 0)
        high = (q[at_q] >= aims.upper[at_q]) & (step[at_v] > 0)
        inside = jnp.ones_like(step).at[at_v].set(1 - (low | high).astype(q.dtype))
        step = shortest(R * inside[None]) * inside
    # Shortened as a whole, so that its direction remains.
    length = jnp.max(jnp.abs(step))
    return step * sizes * jnp.minimum(1.0, _LARGEST_STEP / jnp.where(length > 0, length, jnp.ones_like(length)))


def screw_joints(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Places in q and in v of the joints of one degree of freedom."""
    top = model.topology
    pairs = [
        (a.start, b.start)
        for kind, a, b in zip(top.kinds, top.q_slices, top.v_slices, strict=True)
        if kind in SCREW_KINDS
    ]
    places = np.asarray(pairs, int).reshape(-1, 2)
    return places[:, 0], places[:, 1]


def clip_to_limits(model: Model, q, aims: Aims):
    """q with its joints of one degree of freedom within the limits."""
    at_q, _ = screw_joints(model)
    return q.at[at_q].set(jnp.clip(q[at_q], aims.lower[at_q], aims.upper[at_q])) if at_q.size else q


def _place(model: Model, guess, count, aims: Aims):
    """The place number `count` from which to search: points of a Kronecker sequence within the limits, or around the guess.

    Joints of several degrees of freedom stay at the guess.
    """
    at_q, at_v = screw_joints(model)
    if not at_q.size:
        return guess
    sizes, _ = coordinate_sizes(model, guess.dtype)
    # A joint without limits is searched half a turn, or pi lengths of the mechanism, to both sides of the guess.
    reach = np.pi * sizes[at_v]
    ends = aims.lower[at_q], guess[at_q] - reach, aims.upper[at_q], guess[at_q] + reach
    low, high = (jnp.where(jnp.isfinite(x), x, y) for x, y in (ends[:2], ends[2:]))
    # Multiples of powers of the root of x^(n+1) = x + 1 fill a cube evenly (Roberts 2018).
    root = 2.0
    # A contraction by less than 1/2: 60 iterations of it leave no more than rounding in float64.
    for _ in range(60):
        root = (1 + root) ** (1 / (at_q.size + 1))
    factors = jnp.asarray(root ** -(1.0 + np.arange(at_q.size)), guess.dtype)
    parts = count.astype(guess.dtype) * factors + 0.5
    return guess.at[at_q].set(low + (high - low) * (parts - jnp.floor(parts)))
