"""Scenes whose redundant rows are dropped: mask of rows, openings, multipliers; sizes of rows and residuals; branches."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import eliminate_rows, kernel, pseudo_inverse_by_rotations
from jaxdyn.compile.known import is_concrete, stop_gradient
from jaxdyn.constraints.base import (
    Constraint,
    constraint_jacobian,
    holonomic_rows,
    layout,
    position_residual,
    rows,
    velocity_residual,
)
from jaxdyn.constraints.rank import REGULAR, eps_of, share, tolerance
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.topology import KINDS
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displacement


class KeptRows(eqx.Module):
    """The rows of a scene's constraints that count; the others are zero (`Scene.kept_rows`).

    `kept` (nc,) is 1 for rows that stay, 0 for dropped ones; `rounding`, `minimum` and `gap` () as in `Selection`. `is_held`:
    whether the choice is the user's (`choose_rows`), which every function checks and renews.
    """

    # Arrays, not static: another choice of rows in the course of a motion runs the same program.
    kept: Float[Array | np.ndarray, " nc"]
    rounding: Float[Array | np.ndarray, ""]
    minimum: Float[Array | np.ndarray, ""]
    gap: Float[Array | np.ndarray, ""]
    is_held: bool = eqx.field(static=True, default=False)


class Selection(NamedTuple):
    """The independent rows of a mechanism: `kept` (nc,), 1 or 0.

    `rounding` (): the part of their size by which the dropped rows are open, or differ from combinations of the kept ones.
    `minimum` (): the least pivot of the kept rows, in the metric of the mass matrix, below which they are chosen anew.
    `gap` (): least distance of a kept row from the others over the largest of a dropped one, where they were told apart, and
    `gap_here` () at the configuration.
    """

    kept: Float[Array, " nc"]
    rounding: Float[Array, ""]
    minimum: Float[Array, ""]
    gap: Float[Array, ""]
    gap_here: Float[Array, ""]


def keep_rows(scene: Scene, selection: Selection, *, is_held: bool = False) -> Scene:
    """The scene with the rows that are not kept set to zero."""
    kept, rounding, minimum, gap, _ = map(jnp.asarray, selection)
    return scene.with_kept_rows(KeptRows(kept, rounding, minimum, gap, is_held))


def add_constraints(scene: Scene, more: Sequence[Constraint], forces: Sequence[Any] = ()) -> Scene:
    """The system with the scene's constraints and, behind them, more, all of whose rows stay; with these forces alone."""
    whole, rows = Scene(scene.system, (*scene.constraints, *more), forces), scene.kept_rows
    if rows is None or not more:
        return whole.with_kept_rows(rows)
    # Known rows stay known within a trace.
    xp = np if is_concrete(rows.kept) else jnp
    stay = np.ones(layout(whole)[-1].end - rows.kept.size, rows.kept.dtype)
    return whole.with_kept_rows(eqx.tree_at(lambda rows: rows.kept, rows, xp.concatenate([rows.kept, stay])))


def has_selection(scene: Scene) -> bool:
    """True for a scene of `keep_rows`."""
    return scene.kept_rows is not None


def holds_rows(scene: Scene) -> bool:
    """True for a scene of `choose_rows`."""
    return scene.kept_rows is not None and scene.kept_rows.is_held


def exchange_rows(scene: Scene, rows: Float[Array, " n"]) -> Scene:
    """A scene of `keep_rows` with another choice of rows, in the form of `rows_of`."""
    old = scene.kept_rows
    return scene.with_kept_rows(KeptRows(rows[:-1], old.rounding, rows[-1], old.gap))


def all_rows(scene: Scene) -> Scene:
    """The scene with all of its rows, before `keep_rows`."""
    return scene.with_kept_rows(None)


def rows_of(scene: Scene, dtype) -> Float[Array, " n"]:
    """The choice of rows as the vector that a step carries: 1 or 0 for each row, then `Selection.minimum`; a constant."""
    return lax.stop_gradient(jnp.append(scene.kept_rows.kept, scene.kept_rows.minimum)).astype(dtype)


# A row below this part of the largest one of its constraint has no direction of its own: rounding is all that it holds.
_TINY_ROW = 1e-3


def unit_rows(scene: Scene, q, t) -> Float[Array, "nc nv"]:
    """A for distances in units of the mechanism's length, each row scaled to length 1; rows of rounding alone stay small."""
    # A row that vanishes at this configuration would become a unit row of noise, and count as independent.
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    A = constraint_jacobian(scene, q, t) * sizes[None]
    squares = jnp.sum(A * A, 1)
    largest = largest_of_each(scene, squares)
    squares = jnp.where(squares > _TINY_ROW**2 * largest, squares, largest)
    # A constraint may have rows of zeros alone. By the reciprocal: products of known zeros are known, quotients are not.
    return A * (1.0 / jnp.sqrt(jnp.maximum(squares, float(jnp.finfo(A.dtype).tiny))))[:, None]


def eliminate(B: Float[Array, "nc nv"], minimum: float, first: Float[Array, " nc"], maximum=None) -> tuple[Array, ...]:
    """Independent rows of B by Gram-Schmidt with pivots.

    The pivot of a row is its distance from the span of those that were kept before it. Rows with `first` = 1 come before all
    others; a row is kept where its pivot is above `minimum`, and `maximum` rows at most.

    **Returns:** a mask (nc,) of 1 and 0, the largest distance () of a row that is not kept, and the least pivot () of the others.
    """
    # Not an SVD: it counts independent rows but does not name them, and LAPACK in a batch can deadlock (see `solve_square`).
    kept, rest, pivots = eliminate_rows(B, first, minimum, min(B.shape) if maximum is None else maximum)
    return kept, jnp.max(rest), jnp.min(jnp.where(kept > 0, pivots, jnp.inf))


def largest_opening(scene: Scene, q, t, kept, v=None):
    """Largest phi of the dropped rows over their sizes, or with v the largest A v - b."""
    # With zero velocities the limits of all rows are those of positions. Relative to the largest row of the constraint, because a
    # dropped row may itself be almost zero.
    limits = row_limits(scene, q, jnp.zeros((scene.nv,), q.dtype) if v is None else v, t, 1.0)[1]
    ratios = (1 - kept) / largest_of_each(scene, limits)
    if v is None:
        return jnp.max(jnp.abs(position_residual(scene, q, t)) * ratios[holonomic_rows(layout(scene))], initial=0.0)
    return jnp.max(jnp.abs(velocity_residual(scene, q, v, t)) * ratios, initial=0.0)


def opening_of_redundant(scene: Scene, q, t, v=None) -> Float[Array, ""]:
    """Part of their size by which the dropped rows of a scene are open, in positions and in velocities v; a constant."""
    if not has_selection(scene):
        return jnp.zeros((), q.dtype)
    whole, kept, q, t = _constants(scene, q, t)
    opening = kernel(largest_opening)(whole, q, t, kept)
    return opening if v is None else jnp.maximum(opening, kernel(largest_opening)(whole, q, t, kept, stop_gradient(v)))


def residual_of_redundant(scene: Scene, q, v, t, a) -> Float[Array, ""]:
    """Largest |A a - gamma| of the dropped rows of a scene, if any, over the sizes of what cancels in it; a constant."""
    if not has_selection(scene):
        return jnp.zeros((), q.dtype)
    whole, kept, q, t = _constants(scene, q, t)
    v, a = stop_gradient((v, a))
    A, gamma, _ = rows(whole, q, v, t)
    sizes = jnp.abs(gamma) + matmul(jnp.abs(A), jnp.abs(a))
    # Where all terms are zero, so is the residual.
    sizes = sizes + jnp.maximum(jnp.max(sizes), float(jnp.finfo(q.dtype).tiny))
    return jnp.max(jnp.abs(matmul(A, a) - gamma) / sizes * (1 - kept))


def _constants(scene: Scene, q, t):
    """The scene with all of its rows and without forces, the mask of kept rows, q and t: without derivatives."""
    whole = Scene(scene.system, scene.constraints)
    return stop_gradient((whole, scene.kept_rows.kept.astype(q.dtype), q, jnp.asarray(t, q.dtype)))


def gap_of_redundant(scene: Scene, q, t) -> Float[Array, ""]:
    """Largest |phi| of the dropped rows of a scene, m or rad; a constant."""
    whole, kept, q, t = _constants(scene, q, t)
    return jnp.max(jnp.abs(position_residual(whole, q, t)) * (1 - kept)[holonomic_rows(layout(whole))], initial=0.0)


def distribute_multipliers(scene: Scene, q, t, lam: Float[Array, " nc"]) -> Float[Array, " nc"]:
    """Multipliers of least norm of all rows, with the same force as `lam` of the kept ones, if some were dropped.

    With the dropped rows as combinations A_d = C A_k of the kept ones, lam_k + C^T lam_d = lam, of which `share` is the shortest
    solution.
    """
    # Without this the loads of redundant bearings would depend on the choice of rows, and jump where it changes.
    if not has_selection(scene):
        return lam
    kept, whole = scene.kept_rows.kept, all_rows(scene)
    return _distribute(whole.without_forces, q, jnp.asarray(t, q.dtype), lam, kept)


@kernel
def _distribute(scene: Scene, q, t, lam, kept):
    A, kept = constraint_jacobian(scene, q, t), kept.astype(q.dtype)
    own = kept[:, None] * A
    # Ones on the diagonal of dropped rows make the matrix regular; their right-hand sides are zero.
    gram = matmul(own, own.T) + jnp.diag(1 - kept)
    C = solve_cholesky(cholesky(gram), matmul(own, ((1 - kept)[:, None] * A).T)).T
    return share(kept, C, kept * lam)


def largest_of_each(scene: Scene, sizes) -> Array:
    """For each row (nc,) the largest size among the rows of its constraint, on positions or on velocities."""
    # Apart, because their units differ: m or rad for positions, whatever the user wrote for velocities.
    ends = [(one.start, one.nonholonomic, one.end) for one in layout(scene)]
    parts = [sizes[a:b] for start, middle, end in ends for a, b in ((start, middle), (middle, end)) if a < b]
    return jnp.concatenate([jnp.full_like(part, jnp.max(part)) for part in parts])


def max_opening(scene: Scene, dtype):
    """Largest opening of dropped rows along a motion: a hundred times their opening or difference at its start, plus rounding."""
    # A hundred times, because the rounding of a file can cancel at the start: at the configuration in which it was written.
    return 100 * scene.kept_rows.rounding + eps_of(jnp.zeros((), dtype)) ** REGULAR


# Tolerances of residuals, relative to the length of the mechanism.
#
# Let s_j be the size of coordinate j: 1 for an angle, the length L of the mechanism for a distance. A row of A has the size
# a_i = max_j |A_ij| s_j in the units of its residual, m or rad. So phi_i / a_i is the part of L, or the angle, by which
# the coordinates would have to move to close it. The ratio does not depend on the scale of the mechanism.


# Rows vanish at singular positions. A row below this part of a usual one is compared with the usual one, else any residual of
# rounding would count as open there.
_MIN_ROW = 1e-3
# Rounding errors, of eps times the length, that a residual may hold: it is a difference of sums along two chains of bodies.
_ROUNDING = 32


def own_length(model: Model) -> Float[Array, ""]:
    """Length of a mechanism, m: the largest of the distances between its joints and of the radii of gyration of its bodies.

    Its place in the world does not count. 1 for a mechanism without any length.
    """
    # Roots are measured from the first of them: a robot 1 km from the origin is not 1 km long.
    roots = np.array([parent < 0 for parent in model.topology.parents], bool)
    places, inertias = model.home[:, :3, 3], model.inertias
    mass = inertias[:, 0]
    # About the origin of a joint's frame, which the centre of mass may be far from.
    moments = jnp.abs(inertias[:, 4] + inertias[:, 6] + inertias[:, 9]) / jnp.where(
        mass > 0, 2 * mass, jnp.ones_like(mass)
    )
    squares = [jnp.where(mass > 0, moments, jnp.zeros_like(mass)), jnp.sum(places[~roots] ** 2, 1)]
    squares.append(jnp.sum((places[roots] - places[roots][:1]) ** 2, 1))
    length = jnp.sqrt(jnp.max(jnp.concatenate(squares), initial=0.0))
    return jnp.where(length > 0, length, jnp.ones_like(length))


def coordinate_sizes(system, dtype) -> tuple[Float[Array, " nv"], Float[Array, ""]]:
    """s (nv,), the size of a change of each coordinate that is of the order of the mechanism, and its length L ().

    Coordinates of systems other than a `Model` have sizes of 1, in whatever units they are.
    """
    if not isinstance(system, Model):
        return jnp.ones((system.nv,), dtype), jnp.ones((), dtype)
    # A tolerance is a constant: derivatives of lengths through it would be derivatives of decisions.
    length = lax.stop_gradient(own_length(system)).astype(dtype)
    is_distance = np.zeros(system.nv, bool)
    for kind, place in zip(system.topology.kinds, system.topology.v_slices, strict=True):
        columns = KINDS[kind].columns
        is_distance[place] = [column < 3 for column in columns] if columns else kind == "prismatic"
    return jnp.where(is_distance, length, jnp.ones_like(length)), length


def row_limits(scene: Scene, q, v, t, relative: float) -> tuple[Float[Array, " nh"], Float[Array, " nc"]]:
    """Residuals phi (nh,) and A v - b (nc,) that count as closed, for a `relative` tolerance; rounding is allowed for.

    Velocities count in units of 1 + max_j |v_j| / s_j, 1/s.
    """
    sizes, length = coordinate_sizes(scene.system, q.dtype)
    A = constraint_jacobian(scene, q, t)
    rows = jnp.max(jnp.abs(A) * sizes[None], axis=1)
    rows = jnp.maximum(rows, _MIN_ROW * jnp.minimum(length, jnp.ones_like(length)))
    rounding = _ROUNDING * float(jnp.finfo(q.dtype).eps) * jnp.maximum(length, jnp.ones_like(length))
    limits = relative * rows + rounding
    # The rate of a residual carries the rounding of the velocities, however fast they are.
    return limits[holonomic_rows(layout(scene))], limits * (1.0 + jnp.max(jnp.abs(v) / sizes))


def openness(scene: Scene, q, v, t, relative: float) -> Float[Array, ""]:
    """Largest residual over what counts as closed (see `row_limits`): at most 1 for a state on the constraints. A constant."""
    state = stop_gradient((scene.without_forces, q, v, jnp.asarray(t, q.dtype)))
    return kernel(largest_ratio, static=1)(relative, *state)


def largest_ratio(relative: float, scene: Scene, q, v, t):
    """`openness` as a function of one sample."""
    limits = row_limits(scene, q, v, t, relative)
    residuals = position_residual(scene, q, t), velocity_residual(scene, q, v, t)
    ratios = jax.tree.map(lambda x, limit: jnp.abs(x) / limit, residuals, limits)
    return jnp.max(jnp.concatenate(ratios), initial=0.0)


JUMP = 1.0  # rad or lengths of the mechanism: a longer way between two configurations is no small step


def unit_size_rows(scene: Scene, q, t, factors=None):
    """Rows of positions in coordinates scaled by their sizes, and their pseudo-inverse; constants.

    `factors` (m,) are those of the last rows.
    """
    # Only decisions follow from these rows, so they are constants under differentiation.
    scene, q = stop_gradient((scene, q))
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    R = constraint_jacobian(scene, q, t)[holonomic_rows(layout(scene))] * sizes[None]
    if factors is not None:
        count = R.shape[0] - factors.size
        R = R * jnp.concatenate([jnp.ones((count,), q.dtype), lax.stop_gradient(factors)])[:, None]
    return R, pseudo_inverse_by_rotations(R, tolerance(None, R))


def changes_branch(system, before, after, R_after, R, inverse):
    """Decide whether a combination of rows went through zero between two configurations, or a coordinate jumped.

    `R` and `inverse` are those of `unit_size_rows` at the first one, `R_after` those at the second.
    """
    sizes, _ = coordinate_sizes(system, before.dtype)
    jump = jnp.max(jnp.abs(displacement(system, before, after)) / sizes, initial=0.0)
    return passes_singular(R, inverse, R_after) | (jump > JUMP)


def sign_of_determinant(A: Float[Array, "n n"]) -> Float[Array, ""]:
    """-1 where the determinant is negative, else 1; a constant."""
    return kernel(_sign, fallback=_sign_by_lapack)(None, lax.stop_gradient(A))


def passes_singular(
    A: Float[Array, "m n"], inverse: Float[Array, "n m"], after: Float[Array, "m n"]
) -> Bool[Array, ""]:
    """Decide whether a combination of rows goes through zero between A, with its pseudo-inverse, and the rows `after`.

    det(A' A^+ + (1 - A A^+)) then changes its sign. The second term fills the null space of dependent rows, where the
    determinant of the first one is zero.
    """
    own = jnp.eye(A.shape[0], dtype=A.dtype) - matmul(A, inverse)
    return sign_of_determinant(matmul(after, inverse) + own) < 0


def _sign(_, A):
    """Sign by Gaussian elimination with row exchanges until the largest entry of a column is its pivot."""
    # Kernels have no index that depends on data: the exchanges are selections between neighbours, as in a bubble sort.
    sign = jnp.ones((), A.dtype)
    rows = list(A)
    for k in range(len(rows)):
        for i in range(k + 1, len(rows)):
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(swap, rows[i], rows[k]), jnp.where(swap, rows[k], rows[i])
            sign = jnp.where(swap, -sign, sign)
        sign = jnp.where(rows[k][k] < 0, -sign, sign)
        scale = 1 / jnp.where(rows[k][k] == 0, 1.0, rows[k][k])
        for i in range(k + 1, len(rows)):
            rows[i] = rows[i] - rows[i][k] * scale * rows[k]
    return sign


def _sign_by_lapack(_, A):
    return jnp.where(jnp.linalg.slogdet(A)[0] < 0, -1.0, 1.0).astype(A.dtype)
