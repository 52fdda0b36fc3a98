"""Which rows of a mechanism are independent: decided at the start of a motion and of a step, and kept in all stages of the step.

In an overconstrained mechanism some rows depend on others, but only on the constraints. The stages of a step lie off them by
O(h^p), where the same rows are independent: a rank that is counted there removes all freedom. Rows that a file rounds to a few
digits are never dependent to rounding of the dtype. So rank is a property of the mechanism and not of a point:

- rows that are well apart from the others are independent;
- the others are looked at a finite distance away, on the constraints of the independent rows. Near a singular position they
  become independent there, and are kept. Rows that stay dependent repeat what others say, and are dropped.

How many rows are independent is decided once. Which ones is decided again where the kept ones come near to depending on each
other, before a step begins (`renew_rows`).

A dropped row stays in its place as a row of zeros (`KeptRows`), so that shapes, names and multipliers are those of the scene.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point, evaluate, kernel, mark_invalid, pseudo_inverse_by_rotations, variant
from jaxdyn.compile.batch import cond
from jaxdyn.compile.known import is_concrete, is_tracing, stop_gradient
from jaxdyn.constraints.base import (
    Constraint,
    constraint_jacobian,
    holonomic_rows,
    layout,
    position_residual,
    rows,
    velocity_residual,
)
from jaxdyn.constraints.rank import eps_of, least_pivot_of, tolerance
from jaxdyn.constraints.tolerances import coordinate_sizes, row_limits
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, SystemLike, state_dtype
from jaxdyn.model.tree import Model, neutral
from jaxdyn.systems.mass_factor import cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

# Rows whose distance from the span of the others is below this part of their length may repeat what others say. Numbers written
# with four digits leave 1e-4.
_DOUBTFUL = 1e-3
# How far away doubtful rows are looked at, rad or lengths of the mechanism, and steps of Newton's method that go there.
_FAR, _NEWTON_STEPS = 0.2, 12
# The part of the rows' least pivot at their choice at which they are chosen anew: half of the sine of an angle between rows.
_EXCHANGED_AT = 0.25
# A row below this part of the largest one of its constraint has no direction of its own: it is what rounding has left.
_TINY_ROW = 1e-3


class KeptRows(Constraint):
    """A constraint whose dropped rows are zero. `kept` (n,) is 1 for rows that stay, 0 for dropped ones; `rounding` () and
    `least` () as in `Selection`."""

    inner: Constraint
    kept: Float[Array, " n"]
    rounding: Float[Array, ""]
    least: Float[Array, ""]
    name: str = eqx.field(static=True)

    def position(self, system: SystemLike, q: Float[Array, " nq"], t: Number) -> Array | None:
        """Of the inner constraint."""
        return self._of_position(self.inner.position(system, q, t))

    def velocity(self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array | None:
        """Of the inner constraint."""
        residual = self.inner.velocity(system, q, v, t)
        return None if residual is None else residual * self.kept[-residual.shape[0] :].astype(q.dtype)

    def sizes(self, system, dtype) -> tuple[int, int]:
        """Of the inner constraint."""
        return self.inner.sizes(system, dtype)

    def wrench_components(self) -> tuple[int, ...] | None:
        """Of the inner constraint."""
        return self.inner.wrench_components()

    def group(self):
        """That of the inner constraint, apart from constraints with all rows."""
        group = self.inner.group()
        return None if group is None else ("kept rows", group)

    def _of_position(self, residual):
        return None if residual is None else residual * self.kept[: residual.shape[0]].astype(residual.dtype)

    @classmethod
    def grouped_position(cls, members: Sequence[Any], system, q, t) -> list:
        """By the inner constraints, together."""
        inner = [member.inner for member in members]
        residuals = inner[0].grouped_position(inner, system, q, t)
        return [member._of_position(residual) for member, residual in zip(members, residuals, strict=True)]

    @classmethod
    def grouped_motion(cls, members: Sequence[Any], system, q, v, t) -> list:
        """By the inner constraints, together."""
        inner = [member.inner for member in members]
        motions = []
        for member, (A, gamma, velocity) in zip(members, inner[0].grouped_motion(inner, system, q, v, t), strict=True):
            kept = member.kept.astype(q.dtype)
            motions.append((kept[:, None] * A, kept * gamma, kept * velocity))
        return motions


class Selection(NamedTuple):
    """The rows of a mechanism that count: `kept` (nc,), 1 or 0.

    `rounding` (): by which part of their size the dropped rows are open, or differ from combinations of the kept ones. `least`
    (): the least pivot of the kept rows, in the metric of the mass matrix, at which they are chosen anew.
    """

    kept: Float[Array, " nc"]
    rounding: Float[Array, ""]
    least: Float[Array, ""]


def keep_rows(scene: Scene, selection: Selection) -> Scene:
    """The scene with the rows that are not kept set to zero."""
    kept, rounding, least = map(jnp.asarray, selection)
    constraints = tuple(
        KeptRows(constraint, kept[place.start : place.end], rounding, least, constraint.name)  # pyright: ignore[reportArgumentType]
        for constraint, place in zip(scene.constraints, layout(scene), strict=True)
    )
    return eqx.tree_at(lambda scene: scene.constraints, scene, constraints, is_leaf=lambda x: isinstance(x, tuple))


def is_selected(scene: Scene) -> bool:
    """Whether rows of the scene were chosen by `keep_rows`."""
    return any(isinstance(constraint, KeptRows) for constraint in scene.constraints)


def exchange_rows(scene: Scene, rows: Float[Array, " n"]) -> Scene:
    """A scene of `keep_rows` with other rows, as of `rows_of`."""
    return keep_rows(all_rows(scene), Selection(rows[:-1], rounding_of(scene), rows[-1]))


def all_rows(scene: Scene) -> Scene:
    """The scene with the rows that `keep_rows` has dropped."""
    if not is_selected(scene):
        return scene
    constraints = tuple(c.inner if isinstance(c, KeptRows) else c for c in scene.constraints)
    return eqx.tree_at(lambda scene: scene.constraints, scene, constraints, is_leaf=lambda x: isinstance(x, tuple))


def kept_of(scene: Scene) -> Array:
    """1 for rows that stay and 0 for dropped ones, (nc,), of a scene of `keep_rows`."""
    return jnp.concatenate([c.kept for c in scene.constraints])


def rounding_of(scene: Scene) -> Array:
    """`Selection.rounding` of a scene of `keep_rows`."""
    return scene.constraints[0].rounding


def scaled_rows(scene: Scene, q, t) -> Float[Array, "nc nv"]:
    """A for distances in units of the mechanism's length, each row scaled to length 1; rows of rounding alone stay small."""
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    A = constraint_jacobian(scene, q, t) * sizes[None]
    squares = jnp.sum(A * A, 1)
    largest = _largest_of_each(scene, squares)
    squares = jnp.where(squares > _TINY_ROW**2 * largest, squares, largest)
    some = squares > 0
    return A * jnp.where(some, 1 / jnp.sqrt(jnp.where(some, squares, jnp.ones_like(squares))), squares)[:, None]


def _largest_of_each(scene: Scene, sizes) -> Array:
    """For each row (nc,) the largest size among the rows of its constraint, on positions or on velocities."""
    parts = []
    for place in layout(scene):
        for start, end in ((place.start, place.nonholonomic), (place.nonholonomic, place.end)):
            if end > start:
                parts.append(jnp.broadcast_to(jnp.max(sizes[start:end])[None], (end - start,)))
    return jnp.concatenate(parts)


def eliminate(B: Float[Array, "nc nv"], least: float, first: Float[Array, " nc"], most=None) -> tuple[Array, Array]:
    """Independent rows of B by elimination with pivots: which are kept, (nc,) of 1 and 0, and the largest part () of the others
    that is no combination of these.

    The pivot of a row is its distance from the span of those that were kept before it. Rows with `first` = 1 come before all
    others; a row is kept where its pivot is above `least`, and `most` rows at most.
    """

    def keep_next(_, state):
        rest, kept = state
        lengths = jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept)
        row = jnp.argmax(jnp.where((first > 0) & (lengths > least), lengths + jnp.max(lengths), lengths))
        pivot = lengths[row]
        along = rest[row] / jnp.where(pivot > 0, pivot, jnp.ones_like(pivot))
        taken = pivot > least if most is None else (pivot > least) & (jnp.sum(kept) < most)
        rest = jnp.where(taken, rest - matmul(rest, along)[:, None] * along[None], rest)
        return rest, kept.at[row].add(taken.astype(B.dtype))

    rest, kept = lax.fori_loop(0, min(B.shape), keep_next, (B, jnp.zeros_like(B[:, 0])))
    return kept, jnp.max(jnp.sqrt(jnp.sum(rest * rest, 1)) * (1 - kept))


def select_rows(
    scene: Scene, q: Float[Array, " nq"], t: Number, rank_tol: float | None, is_rounded: bool | None = None
) -> Selection:
    """The independent rows of a mechanism at a configuration on its constraints; a constant.

    With `rank_tol` rows count whose pivots are above it, at this configuration. Without, see above. `is_rounded`: as of a scene.
    """
    is_rounded = scene.is_rounded if is_rounded is None else is_rounded
    bare = stop_gradient(Scene(scene.system, scene.constraints))
    q, t = stop_gradient((q, jnp.asarray(t, q.dtype)))
    count = layout(bare)[-1].end if scene.constraints else 0
    none = jnp.zeros((), q.dtype)
    every = jnp.ones((count,), q.dtype), none, none
    apart = rank_tol if rank_tol is not None else surely_apart(q)

    def select():
        kept, rest = eliminate(kernel(scaled_rows)(bare, q, t), apart, jnp.zeros_like(every[0]))
        if rank_tol is None:
            kept, rest = _select_far_away(bare, q, t, kept, apart, is_rounded)
        least = _EXCHANGED_AT * kernel(_pivot_of)(bare, q, t, kept)
        return kept, jnp.maximum(rest, kernel(_opening)(bare, q, t, kept)), least

    if count == 0:
        return Selection(*every)
    if count > scene.nv:
        return Selection(*select())
    doubtful = ~(_least_distance(bare, q, t) > apart)
    return Selection(*cond(doubtful, select, lambda: every))


def renew_rows(scene: Scene, q, t, is_projected: bool) -> Float[Array, " n"]:
    """`rows_of` a scene for the next step; a constant.

    There are as many rows, chosen anew where the kept ones have come near to depending on each other.

    At some positions of a mechanism any choice of rows loses rank, though all rows together do not. In a program of numbers,
    which has no branches, the sample is flagged there, by `project_step` if the state `is_projected`, and the step is made again
    by the operations of JAX.
    """
    old = rows_of(scene, q.dtype)
    whole = all_rows(scene)
    bare, q, t = stop_gradient((Scene(whole.system, whole.constraints), q, jnp.asarray(t, q.dtype)))
    return _renew(bare, q, t, old, is_projected)


def _check_kept_rows(bare: Scene, q, t, old, is_projected: bool):
    if is_projected:
        return old
    kept, least = old[:-1], old[-1]
    return mark_invalid(jnp.any(kept == 0) & ~(_pivot_of(bare, q, t, kept) > least), old)


@variant(_check_kept_rows, marks=True)
def _renew(bare: Scene, q, t, old, is_projected: bool):
    del is_projected
    kept, least = old[:-1], old[-1]
    dropped = jnp.any(kept == 0)
    pivot = kernel(_pivot_of)(bare, q, t, kept)
    poor = dropped & ~(pivot > least)

    def choose():
        new = eliminate(kernel(scaled_rows)(bare, q, t), 0.0, jnp.zeros_like(kept), jnp.sum(kept))[0]
        pivot_of_new = kernel(_pivot_of)(bare, q, t, new)
        better = poor & ~(pivot_of_new < pivot)
        kept_next, next_pivot = jnp.where(better, new, kept), jnp.where(better, pivot_of_new, pivot)
        return jnp.where(poor, jnp.append(kept_next, _EXCHANGED_AT * next_pivot), old)

    return cond(poor, choose, lambda: old)


def _pivot_of(scene: Scene, q, t, kept):
    """`least_pivot_of` the kept rows in the metric of the mass matrix."""
    A = kept[:, None] * constraint_jacobian(scene, q, t)
    return least_pivot_of(mass_factor(mass_matrix(scene.system, q, t)).whiten(A.T))


def rows_of(scene: Scene, dtype) -> Float[Array, " n"]:
    """What a step keeps of a scene of `keep_rows`: 1 or 0 for each row, and `Selection.least`; a constant."""
    return lax.stop_gradient(jnp.append(kept_of(scene), scene.constraints[0].least)).astype(dtype)


def may_have_redundant_rows(scene: Scene) -> bool:
    """Whether coordinates that constraints couple have as many rows as there are of them, so that a motion needs redundant rows.

    Looked at where numbers are known; True where they are not. A motion with redundant rows among fewer than that is right too,
    by the rank at every evaluation, in short steps.
    """
    bare = Scene(scene.system, scene.constraints)
    if not is_concrete(bare):
        return True
    step = np.random.default_rng(0).uniform(0.1, 0.9, scene.nv).astype(state_dtype(scene.system))
    try:
        is_coupled = np.abs(evaluate(_generic_rows, bare, step, is_input=not is_tracing())) > 0
    except jax.errors.JAXTypeError:  # a constraint is a function that holds a traced number
        return True
    groups = np.arange(scene.nv)  # of coordinates
    for row in is_coupled:
        groups[np.isin(groups, groups[row])] = groups[row].min(initial=scene.nv)
    counts = np.bincount([groups[row][0] for row in is_coupled if row.any()], minlength=scene.nv + 1)
    return bool(any(not row.any() for row in is_coupled) or any(counts[g] >= np.sum(groups == g) for g in set(groups)))


def _generic_rows(scene: Scene, step):
    system = scene.system
    start = neutral(system).astype(step.dtype) if isinstance(system, Model) else jnp.zeros((scene.nq,), step.dtype)
    return constraint_jacobian(scene, displace(system, start, step), jnp.zeros((), step.dtype))


@kernel
def _least_distance(scene: Scene, q, t):
    """Least distance of a row from the span of those before it; NaN where there is none."""
    B = scaled_rows(scene, q, t)
    return jnp.min(jnp.diagonal(cholesky(matmul(B, B.T))))


def surely_apart(like) -> float:
    """Pivot above which rows are independent without a doubt."""
    return max(_DOUBTFUL, 10 * tolerance(None, like))


def _select_far_away(scene: Scene, q, t, sure, apart: float, is_rounded: bool):
    """`eliminate` a finite distance away, where the rows in `sure` are among the independent ones.

    Rows that differ from combinations of the others by little, there too, count in a scene of exact numbers, where they are
    met at q and leave some freedom.
    """
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    least = tolerance(None, q)
    held = holonomic_rows(layout(scene))

    def inverse_of(A):
        return pseudo_inverse_by_rotations(A * sizes[None], least)  # of coordinates in units of their sizes

    # Any direction that the sure rows leave serves, as long as it moves all of the mechanism.
    A = sure[:, None] * constraint_jacobian(scene, q, t)
    direction = jnp.asarray(1 + np.modf(np.arange(scene.nv) * 0.618)[0], q.dtype)
    direction = direction - matmul(inverse_of(A), matmul(A * sizes[None], direction))
    length = jnp.max(jnp.abs(direction))
    moves = length > 1e-6
    direction = jnp.where(moves, direction / jnp.where(moves, length, jnp.ones_like(length)), direction)
    place = displace(scene.system, q, _FAR * direction * sizes)

    def close(_, place):
        place = retract(scene.system, place)
        A = (sure[:, None] * constraint_jacobian(scene, place, t))[held]
        step = matmul(inverse_of(A), sure[held] * position_residual(scene, place, t)) * sizes
        # A step that is longer than the way itself leaves the branch.
        size = jnp.max(jnp.abs(step / sizes))
        return displace(scene.system, place, -step * jnp.minimum(1.0, _FAR / jnp.where(size > 0, size, 1.0)))

    if held.size:
        place = retract(scene.system, lax.fori_loop(0, _NEWTON_STEPS, close, place))
    B = kernel(scaled_rows)(scene, place, t)
    kept, rest = eliminate(B, 2 * apart, sure)
    kept = jnp.maximum(sure, kept)  # sure rows may be less so there; they stay
    if is_rounded:
        return kept, rest
    every, least_rest = eliminate(B, least, kept)
    met = _opening(scene, q, t, 1 - every * (1 - kept)) <= eps_of(q) ** 0.4
    counts = met & (jnp.sum(every) < scene.nv)
    return jnp.where(counts, every, kept), jnp.where(counts, least_rest, rest)


def _opening(scene: Scene, q, t, kept):
    """Largest phi of the dropped rows over their sizes."""
    held = holonomic_rows(layout(scene))
    # Velocities of zero: the limits of all rows are those of positions. A dropped row may itself be next to nothing.
    sizes = _largest_of_each(scene, row_limits(scene, q, jnp.zeros((scene.nv,), q.dtype), t, 1.0)[1])[held]
    return jnp.max(jnp.abs(position_residual(scene, q, t)) / sizes * (1 - kept)[held], initial=0.0)


@kernel
def _opening_rate(scene: Scene, q, v, t, kept):
    """Largest A v - b of the dropped rows over their sizes."""
    sizes = _largest_of_each(scene, row_limits(scene, q, v, t, 1.0)[1])
    return jnp.max(jnp.abs(velocity_residual(scene, q, v, t)) / sizes * (1 - kept), initial=0.0)


def opening_of_dropped(scene: Scene, q, t, v=None) -> Float[Array, ""]:
    """By which part of their size the dropped rows of a scene are open in positions, and in velocities v; a constant."""
    if not is_selected(scene):
        return jnp.zeros((), q.dtype)
    bare, kept = stop_gradient((Scene(scene.system, all_rows(scene).constraints), kept_of(scene)))
    kept, q, t = stop_gradient((kept.astype(q.dtype), q, jnp.asarray(t, q.dtype)))
    opening = kernel(_opening)(bare, q, t, kept)
    return opening if v is None else jnp.maximum(opening, _opening_rate(bare, q, stop_gradient(v), t, kept))


def missed_by_dropped(scene: Scene, q, v, t, a) -> Float[Array, ""]:
    """Largest |A a - gamma| of the dropped rows of a scene, if any, over the sizes of what cancels in it; a constant."""
    if not is_selected(scene):
        return jnp.zeros((), q.dtype)
    whole, kept = stop_gradient((Scene(scene.system, all_rows(scene).constraints), kept_of(scene)))
    q, v, t, a = stop_gradient((q, v, jnp.asarray(t, q.dtype), a))
    A, gamma, _ = rows(whole, q, v, t)
    sizes = jnp.abs(gamma) + matmul(jnp.abs(A), jnp.abs(a))
    sizes = sizes + jnp.max(sizes)
    some = sizes > 0
    ratio = jnp.abs(matmul(A, a) - gamma) / jnp.where(some, sizes, jnp.ones_like(sizes))
    return jnp.max(jnp.where(some, ratio, jnp.zeros_like(ratio)) * (1 - kept.astype(q.dtype)))


def gap_of_dropped(scene: Scene, q, t) -> Float[Array, ""]:
    """Largest |phi| of the dropped rows of a scene, m or rad; a constant."""
    bare, kept = stop_gradient((Scene(scene.system, all_rows(scene).constraints), kept_of(scene)))
    q, t = stop_gradient((q, jnp.asarray(t, q.dtype)))
    dropped = 1 - kept.astype(q.dtype)[holonomic_rows(layout(bare))]
    return jnp.max(jnp.abs(position_residual(bare, q, t)) * dropped, initial=0.0)


def most_opening(scene: Scene, dtype):
    """How far dropped rows may be open along a motion: a hundred times as much as they are or differ at its start, and rounding.

    What a file rounds can cancel at the start, as at the configuration in which it was written.
    """
    return 100 * rounding_of(scene) + eps_of(jnp.zeros((), dtype)) ** 0.4


def most_rounding(dtype) -> float:
    """Rounding above which rows do not repeat what others say but contradict them."""
    return 10 * surely_apart(jnp.zeros((), dtype))


def known_selection(
    scene: Scene, q, t, rank_tol: float | None, is_rounded: bool | None = None
) -> tuple[Selection, int]:
    """`select_rows` for concrete numbers, and the number of rows that are independent there."""
    is_rounded = scene.is_rounded if is_rounded is None else is_rounded
    bare = Scene(scene.system, scene.constraints)
    B = evaluate(scaled_rows, bare, q, t, is_input=not is_tracing())
    apart = surely_apart(B) if rank_tol is None else rank_tol
    none = np.zeros((), B.dtype)
    every = Selection(np.ones(B.shape[0], B.dtype), none, none)  # pyright: ignore[reportArgumentType]
    # No pivot is below the least singular value.
    if 0 < B.shape[0] <= B.shape[1] and np.linalg.svd(B, compute_uv=False)[-1] > apart:
        return every, B.shape[0]
    # Pivots of a QR factorisation with column exchanges are those of `eliminate`.
    pivots = _pivots(B)
    if np.sum(pivots > apart) == B.shape[0]:
        return every, B.shape[0]
    with jax.ensure_compile_time_eval():
        selection = _select_compiled(bare, jnp.asarray(q), jnp.asarray(t, q.dtype), rank_tol, is_rounded)
    return Selection(*map(np.asarray, selection)), int(np.sum(pivots > tolerance(rank_tol, B)))  # pyright: ignore[reportArgumentType]


@entry_point
def _select_compiled(scene: Scene, q, t, rank_tol, is_rounded):
    return select_rows(scene, q, t, rank_tol, is_rounded)


def _pivots(B: np.ndarray) -> np.ndarray:
    rest, pivots = np.array(B), []
    for _ in range(min(B.shape)):
        lengths = np.linalg.norm(rest, axis=1)
        row = int(np.argmax(lengths))
        pivots.append(lengths[row])
        if lengths[row] == 0:
            break
        along = rest[row] / lengths[row]
        rest = rest - np.outer(rest @ along, along)
    return np.asarray(pivots)


def spread_multipliers(scene: Scene, q, t, lam: Float[Array, " nc"]) -> Float[Array, " nc"]:
    """The multipliers of least norm of all rows that give the same force as `lam` of the kept ones.

    With the dropped rows as combinations A_d = C A_k of the kept ones, lam_k + C^T lam_d = lam, whose shortest solution is
    [1; C] (1 + C^T C)^-1 lam.
    """
    kept, whole = kept_of(scene), all_rows(scene)
    return _spread(Scene(whole.system, whole.constraints), q, jnp.asarray(t, q.dtype), lam, kept)


@kernel
def _spread(scene: Scene, q, t, lam, kept):
    A, kept = constraint_jacobian(scene, q, t), kept.astype(q.dtype)
    own = kept[:, None] * A
    gram = matmul(own, own.T) + jnp.diag(1 - kept)
    C = solve_cholesky(cholesky(gram), matmul(own, ((1 - kept)[:, None] * A).T)).T
    shared = solve_cholesky(cholesky(jnp.eye(A.shape[0], dtype=A.dtype) + matmul(C.T, C)), kept * lam)
    return kept * shared + matmul(C, shared)
