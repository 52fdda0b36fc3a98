"""Parameter blocks: maps from coordinates y, zero at the start, to some numbers of a system.

A block writes its numbers into the list of the system's leaves. Coordinates are unconstrained: every y gives numbers that are
allowed (positive, within bounds, feasible inertias), so that no step of a fit can leave the allowed set. A user selects leaves by
functions, and rows of them by the names of bodies and joints.
"""

import abc
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.chart import Chart, affine_residual, barrier_residual, entropic_residual
from jaxdyn.lie import se3, so3
from jaxdyn.model.tree import Model


class Block(eqx.Module):
    """Some numbers of a system as functions of coordinates y (size,)."""

    names: eqx.AbstractVar[tuple[str, ...]]
    place: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Number of coordinates."""

    @abc.abstractmethod
    def values(self, y: Float[Array, " size"], leaves: list) -> Float[Array, " m"]:
        """Numbers (m,) in the order of `names`."""

    @abc.abstractmethod
    def write(self, y: Float[Array, " size"], leaves: list) -> None:
        """Write the numbers into the list of the system's leaves."""

    def residual(self, y: Float[Array, " size"], leaves: list) -> Float[Array, " k"]:
        """Residuals of the prior (k,), of unit standard deviation: of a Gaussian one with a `root`, those of y by default."""
        root = getattr(self, "root", None)
        return jnp.zeros((0,), y.dtype) if root is None else root @ self._deviation(y, leaves)

    def _deviation(self, y, leaves):
        return y


class Numbers(Block):
    """Entries of a leaf: x0 + unit y ("free"), x0 exp(y) ("positive"), or between bounds by a logistic function ("bound").

    A Gaussian prior is |root (x - mean)|^2, root^T root the inverse of its covariance.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    place: int = eqx.field(static=True)
    index: tuple[int, ...] = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    origin: Float[Array, " m"]
    unit: Float[Array, " m"]
    lower: Float[Array, " m"] | None = None
    upper: Float[Array, " m"] | None = None
    mean: Float[Array, " m"] | None = None
    root: Float[Array, "m m"] | None = None

    @property
    def size(self):
        return len(self.index)

    def values(self, y, leaves):
        if self.kind == "positive":
            return self.origin * jnp.exp(y)
        if self.kind == "bound":
            low: Any = self.lower
            span = self.upper - low
            share = (self.origin - low) / span
            # The logit of the start is added, so that y = 0 is the start.
            return low + span * jax.nn.sigmoid(jnp.log(share) - jnp.log1p(-share) + y)
        return self.origin + self.unit * y

    def write(self, y, leaves):
        _write_entries(leaves, self.place, self.index, self.values(y, leaves))

    def _deviation(self, y, leaves):
        mean: Any = self.mean
        return self.values(y, leaves) - mean


class Poses(Block):
    """Poses T0 exp(unit y) of a leaf (..., 4, 4); the numbers are the twists (v, omega), m and rad, from the start."""

    names: tuple[str, ...] = eqx.field(static=True)
    place: int = eqx.field(static=True)
    rows: tuple[int, ...] = eqx.field(static=True)
    origin: Float[Array, "m 4 4"]
    root: Float[Array, "m6 m6"] | None = None

    @property
    def size(self):
        return 6 * len(self.rows)

    def values(self, y, leaves):
        return y

    def write(self, y, leaves):
        poses = jax.vmap(lambda T, twist: T @ se3.exp(twist))(self.origin, y.reshape(-1, 6))
        index = (np.array(self.rows)[:, None] * 16 + np.arange(16)).reshape(-1)
        _write_entries(leaves, self.place, index, poses.reshape(-1))


class Directions(Block):
    """Vectors (3,), or screws (6,), of constant length, rotated by exp(hat(B y)), B (3, 2) perpendicular to the vector."""

    names: tuple[str, ...] = eqx.field(static=True)
    place: int = eqx.field(static=True)
    index: tuple[int, ...] = eqx.field(static=True)
    origin: Float[Array, "m k 3"]
    normals: Float[Array, "m 3 2"]
    root: Float[Array, "m2 m2"] | None = None

    @property
    def size(self):
        return 2 * self.origin.shape[0]

    def values(self, y, leaves):
        # A rotation about the vector itself has no effect: a third coordinate would lose rank.
        rotated = jax.vmap(lambda parts, B, y: parts @ so3.exp(B @ y).T)(self.origin, self.normals, y.reshape(-1, 2))
        return rotated.reshape(-1)

    def write(self, y, leaves):
        _write_entries(leaves, self.place, self.index, self.values(y, leaves))


class Inertias(Block):
    """Inertias of bodies by log-Cholesky coordinates relative to the nominal ones: every y gives a feasible body.

    - `total`: the mass of all bodies of the model together, kept exactly: all free bodies are scaled by one factor.
    - `ellipsoids` (bodies, 4, 4): Q of ellipsoids that contain the bodies, tr(P Q) > 0, or zero for a body without one.
    - `weight`: of the distance to the nominal bodies, by `metric`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    place: int = eqx.field(static=True)
    metric: str | None = eqx.field(static=True)
    chart: Chart
    weight: Float[Array, ""]
    ellipsoids: Float[Array, "bodies 4 4"] | None = None
    total: Float[Array, ""] | None = None

    @property
    def size(self):
        return len(self.chart.bodies) * self.chart.count

    def _theta(self, y):
        return y.reshape(len(self.chart.bodies), -1)

    def _inertias(self, y):
        inertias = self.chart.inertias(self._theta(y))
        if self.total is None:
            return inertias
        free = np.array(self.chart.bodies)
        own = jnp.sum(inertias[free, 0])
        # One factor for all ten numbers of a body keeps it feasible.
        ratio = (self.total - (jnp.sum(inertias[:, 0]) - own)) / own
        return jnp.where(np.isin(np.arange(len(inertias)), free)[:, None], ratio * inertias, inertias)

    def values(self, y, leaves):
        free = self._inertias(y)[np.array(self.chart.bodies)]
        return free.reshape(-1)

    def write(self, y, leaves):
        leaves[self.place] = self._inertias(y).astype(leaves[self.place].dtype)

    def residual(self, y, leaves):
        U = self.chart.relative_factors(self._theta(y))
        parts = [jnp.zeros((0,), y.dtype)]
        if self.metric is not None:
            distance = affine_residual if self.metric == "affine" else entropic_residual
            parts.append(jnp.sqrt(self.weight) * jax.vmap(distance)(U).reshape(-1))
        if self.ellipsoids is not None:
            # tr(P Q) over its nominal value: one at the start, zero for a mass on the ellipsoid's surface.
            factors = self.chart.factors
            P = jnp.einsum("bij,bjk,blk,bml->bim", factors, U, U, factors)
            P0 = jnp.einsum("bij,bkj->bik", factors, factors)
            now, nominal = (jnp.einsum("bij,bji->b", x, self.ellipsoids) for x in (P, P0))
            has_mass = nominal > 0
            # Both operands are replaced: the logarithm of 0/0 would put NaN into the gradient although its value is not used.
            share = jnp.where(has_mass, now, 1.0) / jnp.where(has_mass, nominal, 1.0)
            parts.append(jnp.sqrt(self.weight) * barrier_residual(jnp.log(share)))
        return jnp.concatenate(parts)


class Tied(Block):
    """Entries that are functions of others: x = scale x_other + offset. They have no coordinates of their own."""

    names: tuple[str, ...] = eqx.field(static=True)
    place: int = eqx.field(static=True)
    index: tuple[int, ...] = eqx.field(static=True)
    other: int = eqx.field(static=True)
    other_index: tuple[int, ...] = eqx.field(static=True)
    scale: Float[Array, ""]
    offset: Float[Array, ""]

    @property
    def size(self):
        return 0

    def values(self, y, leaves):
        return self.scale * leaves[self.other].reshape(-1)[np.array(self.other_index)] + self.offset

    def write(self, y, leaves):
        _write_entries(leaves, self.place, self.index, self.values(y, leaves))


def _write_entries(leaves: list, place: int, index: Any, values: Array) -> None:
    leaf = leaves[place]
    if len(index) == leaf.size and np.array_equal(index, np.arange(leaf.size)):
        leaves[place] = values.astype(leaf.dtype).reshape(leaf.shape)
        return
    flat = leaf.reshape(-1).at[np.array(index)].set(values.astype(leaf.dtype))
    leaves[place] = flat.reshape(leaf.shape)


@eqx.filter_jit
def apply_blocks(parameters: Any, y, method: str | None):
    """Leaves of `parameters.given` with the numbers of y, by their places, and a method's results of `parameters.blocks`."""
    leaves = jax.tree.leaves(parameters.given)
    begin, parts = 0, [jnp.zeros((0,), y.dtype)]
    # In order: a tied block reads what the blocks before it have written.
    for block in parameters.blocks:
        part = y[begin : begin + block.size]
        begin += block.size
        leaves[block.place] = jnp.asarray(leaves[block.place])
        if method is not None:
            parts.append(getattr(block, method)(part, leaves).astype(y.dtype))
        block.write(part, leaves)
    places = {block.place for block in parameters.blocks}
    return {place: leaves[place] for place in sorted(places)}, jnp.concatenate(parts)


def find_models(system) -> list[Model]:
    """All models in a pytree."""
    return [x for x in jax.tree.leaves(system, is_leaf=lambda x: isinstance(x, Model)) if isinstance(x, Model)]


def entries_of_block(block) -> tuple[int, ...] | None:
    """Entries of its leaf that a block writes; None for all."""
    if isinstance(block, Poses):
        return tuple(16 * row + i for row in block.rows for i in range(16))
    return getattr(block, "index", None)


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
