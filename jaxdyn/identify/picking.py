"""Leaves, rows and priors from a user's arguments: names of bodies and joints, deviations, covariances."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from jaxdyn.identify.blocks import Poses
from jaxdyn.model.tree import Model


def find_models(system) -> list[Model]:
    """All models in a pytree."""
    return [x for x in jax.tree.leaves(system, is_leaf=lambda x: isinstance(x, Model)) if isinstance(x, Model)]


def entries_of_block(block) -> tuple[int, ...] | None:
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
    Rows = Any  # `row_indices` looks at them


def row_indices(system, name: str, count: int, rows: Rows) -> tuple[list[int], list[str]]:
    """Indices of rows given by index or by the names of bodies or joints, and their labels; all for None."""
    models = find_models(system)
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


class _Leaf:
    """Placeholder of a leaf while a user's function selects it."""

    def __init__(self, place: int, name: str):
        self.place, self.name = place, name


def leaves_with_names(system: Any) -> tuple[list[Any], list[str], Any]:
    """Leaves of a pytree, their paths as text, and its structure."""
    paths, structure = jax.tree_util.tree_flatten_with_path(system)
    return (
        [leaf for _, leaf in paths],
        [jax.tree_util.keystr(path).removeprefix(".") for path, _ in paths],
        structure,
    )


def select(system: Any, where: Any, argument: str, twice: bool = False) -> list[tuple[int, np.ndarray, str]]:
    """Leaves that a user's function selects: place, value, name.

    **Raises:** ValueError for a function that fails or returns anything else, for leaves that are no floating-point numbers.
    """
    leaves, names, structure = leaves_with_names(system)
    kind = type(system).__name__
    # Placeholders know their places; the values could not tell two leaves that hold the same array apart.
    marked = jax.tree.unflatten(structure, [_Leaf(i, name) for i, name in enumerate(names)])
    example = f"write e.g. {argument}=lambda system: system.parameters['mass']"
    if not callable(where):
        raise ValueError(f"{argument} is {where!r}; pass a function that picks leaves, {example}")
    try:
        entries = jax.tree.leaves(where(marked))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(
            f"{argument} picks nothing of this {kind} ({type(error).__name__}: {error}); {example}, of whole leaves"
        ) from error
    strange = [leaf for leaf in entries if not isinstance(leaf, _Leaf)]
    if strange or not entries:
        raise ValueError(
            f"{argument} picks {strange[0] if strange else 'nothing'!r}, which is no leaf of this {kind}; {example}"
        )
    selected = []
    for leaf in entries:
        value = leaves[leaf.place]
        if not eqx.is_inexact_array_like(value):
            raise ValueError(f"{argument} picks {leaf.name}, which is {value!r} and no floating-point number")
        if not twice and any(value is model.inertias for model in find_models(system)):
            raise ValueError(
                f"{argument} picks {leaf.name}, the inertias of bodies, few of which are physical; free them by "
                "jd.identify.Parameters(system).inertias(...)"
            )
        selected.append((leaf.place, np.asarray(value, np.float64), leaf.name))
    if len({place for place, *_ in selected}) < len(selected):
        places = [place for place, *_ in selected]
        name = next(name for place, _, name in selected if places.count(place) > 1)
        raise ValueError(f"{argument} picks {name} a second time; pick every number once")
    return selected


def prior_root(std, covariance, size: int, label: str) -> np.ndarray | None:
    """Matrix R (size, size) with R^T R the inverse of the covariance; None without a prior."""
    if std is None and covariance is None:
        return None
    if std is not None and covariance is not None:
        raise ValueError(f"{label}: std and covariance are both given; give one of them")
    if std is not None:
        deviation = np.broadcast_to(np.asarray(std, float), (size,))
        if not (deviation > 0).all():
            raise ValueError(f"{label}: std is {std}; give positive numbers")
        return np.diag(1 / deviation)
    matrix = np.asarray(covariance, float)
    if matrix.shape != (size, size) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] <= 0:
        raise ValueError(
            f"{label}: covariance has shape {matrix.shape}; give a positive definite matrix ({size}, {size})"
        )
    # For the covariance L L^T, R = L^-1 gives R^T R = (L L^T)^-1.
    return np.linalg.inv(np.linalg.cholesky(matrix))


def perpendicular_basis(axis: np.ndarray) -> np.ndarray:
    """Two unit vectors perpendicular to an axis and to each other, as the columns of (3, 2)."""
    # The unit vector least aligned with the axis: their cross product cannot vanish.
    other = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    other = other / np.linalg.norm(other)
    return np.stack([other, np.cross(axis, other) / np.linalg.norm(axis)], axis=1)
