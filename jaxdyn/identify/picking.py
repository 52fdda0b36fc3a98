"""Which leaves, rows and priors the words of a user stand for: names of bodies and joints, deviations, covariances."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxdyn.identify.blocks import Poses
from jaxdyn.model.tree import Model


def models_of(system) -> list[Model]:
    """All models in a pytree."""
    return [x for x in jax.tree.leaves(system, is_leaf=lambda x: isinstance(x, Model)) if isinstance(x, Model)]


def entries_taken(block) -> tuple[int, ...] | None:
    """Entries of its leaf that a block writes; None for all."""
    if isinstance(block, Poses):
        return tuple(16 * row + i for row in block.rows for i in range(16))
    return getattr(block, "index", None)


def free_bodies(model: Model, chart) -> list[str]:
    """Names of the bodies whose inertias a chart changes."""
    return [model.body_names[i] for i in chart.bodies]


if TYPE_CHECKING:
    Rows = str | int | Sequence[str | int] | None  # by index, or by the names of bodies or joints; None for all
else:
    Rows = Any  # `rows_of` looks at them


def rows_of(system, name: str, count: int, rows: Rows) -> tuple[list[int], list[str]]:
    """Indices of rows given by index or by the names of bodies or joints, and what to call them; all for None."""
    models = models_of(system)
    sets: list[tuple[str, ...]] = []
    if len(models) == 1:
        model = models[0]
        sets = [names for names in (model.body_names, model.joint_names) if len(names) == count]
        if count == len(model.frame_names):
            sets.append(model.frame_names)
    if rows is None:
        labels = sets[0] if sets else [str(i) for i in range(count)]
        return list(range(count)), [f"{name}[{label}]" for label in labels]
    rows = [rows] if isinstance(rows, (str, int)) else list(rows)
    indices = []
    for row in rows:
        place = next((names.index(row) for names in sets if row in names), None) if isinstance(row, str) else row
        if not isinstance(place, (int, np.integer)) or not 0 <= place < count:
            known = sorted({n for names in sets for n in names}) or f"0 to {count - 1}"
            raise ValueError(f"rows names {row!r} of {name}, which has {count} rows: {known}")
        indices.append(int(place))
    if len(set(indices)) < len(indices):
        raise ValueError(f"rows of {name} is {rows}; name every row once")
    return indices, [f"{name}[{row}]" for row in rows]


def root_of(std, covariance, size: int, what: str) -> np.ndarray | None:
    """A matrix R (size, size) with R^T R the inverse of the covariance; None without a prior."""
    if std is None and covariance is None:
        return None
    if std is not None and covariance is not None:
        raise ValueError(f"{what}: std and covariance are both given; give one of them")
    if std is not None:
        deviation = np.broadcast_to(np.asarray(std, float), (size,))
        if not (deviation > 0).all():
            raise ValueError(f"{what}: std is {std}; give positive numbers")
        return np.diag(1 / deviation)
    matrix = np.asarray(covariance, float)
    if matrix.shape != (size, size) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0:
        raise ValueError(
            f"{what}: covariance has shape {matrix.shape}; give a positive definite matrix ({size}, {size})"
        )
    return np.linalg.inv(np.linalg.cholesky(matrix))


def across(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors across an axis, as the columns of (3, 2)."""
    other = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    other = other / np.linalg.norm(other)
    return np.stack([other, np.cross(axis, other) / np.linalg.norm(axis)], axis=1)
