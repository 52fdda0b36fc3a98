"""Targets of named frames and of the centre of mass, as constraint rows: what inverse kinematics drives to zero.

Rows of positions are in m, in the axes of the target; those of orientations are the rotation vector from the target to the frame,
rad, and those of directions the two components of the rotation that takes the target's direction to the frame's.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_concrete, is_known
from jaxdyn.constraints.base import Constraint
from jaxdyn.constraints.frames import Pair
from jaxdyn.constraints.rolling import tangents
from jaxdyn.control.errors import CenterError, Fixed
from jaxdyn.lie import so3
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import as_operand, batch_hint
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model

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
        if np.abs(R.T @ R - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
            raise ValueError(f"{name}: its rotation is no rotation matrix, R^T R differs from 1; normalise it")
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
