"""Selection of the independent rows of a mechanism, at the start of a motion and of each step; all stages of a step share it.

In an overconstrained mechanism some rows depend on others, but only on the constraint manifold. The stages of a step lie off it
by O(h^p), where the same rows are independent: a rank counted there would remove all degrees of freedom. Rows that a file rounds
to a few digits are never dependent to rounding of the dtype. So rank is a property of the mechanism and not of a point:

- Rows with a large distance from the span of the others are independent.
- The others are tested a finite distance away, where the independent rows hold. A row that is independent there was dependent
  because of a singular position, and is kept. A row that is dependent there too is redundant, and is dropped.

The number of independent rows is decided once. Their choice is renewed before a step, where the kept rows have become nearly
dependent (`renew_rows`).

A dropped row stays in its place as a row of zeros (`Scene.kept_rows`): shapes, names and multipliers are those of the scene.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.compile import Evaluation, entry_point, kernel, mark_invalid
from jaxdyn.compile.known import is_concrete, keep_known, once, stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.constraints.rank import (
    MIN_GAP,
    REGULAR,
    RESIDUAL,
    check_tolerance,
    clear_pivot,
    eps_of,
    has_clear_rank,
    min_pivot_of,
    pseudo_inverse,
    rank_of,
    solve_with_damping,
    tolerance,
)
from jaxdyn.constraints.redundancy import (
    Selection,
    all_rows,
    coordinate_sizes,
    eliminate,
    has_selection,
    holds_rows,
    keep_rows,
    largest_opening,
    rows_of,
    unit_rows,
)
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.systems.mass_factor import cholesky, mass_factor
from jaxdyn.systems.scene import Scene, as_scene, is_given
from jaxdyn.systems.system import SceneLike, displace, retract

# Distance at which doubtful rows are tested, rad or lengths of the mechanism, and Newton's steps that go there. Far enough for
# the rows of a singular position to separate, near enough for Newton's method to stay on the branch.
_FAR, _NEWTON_STEPS = 0.2, 12
# The rows are chosen anew when their least pivot has fallen to this part of its value at their choice. A pivot is the square of a
# sine, so that the sine of the angle between rows has halved.
_EXCHANGED_AT = 0.25
UNCLEAR_RANK = (
    "the rank of the constraints is not clear at this q: singular values that count differ by less than a factor of "
    f"{MIN_GAP:g} from those that do not"
)


def independent_rows(scene: Scene, q, t, rank_tol: float | None = None) -> Scene:
    """The scene with the rows that count at a configuration: what every function with constraints computes with.

    Numbers of a file are rounded, so that rows repeat others but for the rounding: no tolerance of the dtype tells them from
    independent ones. They are set to zero here (`keep_rows`); all rows are NaN where rounding hides which ones these are.
    Scenes of exact numbers, and those that have a choice of rows or a `rank_tol`, are returned as they are: there singular
    values below the tolerance count as zero.
    """
    if holds_rows(scene):
        return all_rows(scene) if rank_tol is not None else keep_rows(scene, _held_selection(scene, q, t))
    if not (scene.rounding and scene.constraints) or rank_tol is not None or has_selection(scene):
        return scene
    selection = select_rows(scene, q, t)
    if is_concrete(selection) and np.all(selection.kept == 1):
        return scene
    return keep_rows(scene, hide_unclear(selection)._replace(gap=jnp.minimum(selection.gap, selection.gap_here)))


def choose_rows(scene: SceneLike, q: Float[Array, " nq"], t: Numbers = 0.0) -> Scene:
    """The scene with the choice of its independent rows at an assembled configuration, for many calls with redundant rows.

    A scene whose rows depend on each other but for the rounding of a file finds its rows anew in every call, by a search some
    tens of microseconds long. Which rows count is a property of the mechanism; a choice that the scene holds costs a comparison
    of pivots in each call, and is made again, with as many rows, where they have become nearly dependent. Forces of constraints
    remain those of least norm.

    **Arguments:** `scene`; `q` (nq,), on the constraints (`jd.assemble`), not in a singular position; `t`, s.

    **Returns:** a scene for every function that takes one; another `Scene` made of its parts has no choice. It is the one given
    where no rows are redundant.

    **Raises:** ValueError where rounding hides which rows are independent.

    Source: docs/constraints.md, redundant rows.
    """
    scene = all_rows(as_scene(scene))
    q, t = check_state(scene.system, q=q, t=t)
    selection = select_rows(scene, q, t)
    if is_concrete(selection):
        if np.all(np.asarray(selection.kept) == 1):
            return scene
        if not min(selection.gap, selection.gap_here) >= MIN_GAP:
            raise ValueError(
                f"q: {UNCLEAR_RANK}; give numbers with more digits, or an assembled q away from singular positions"
            )
    selection = hide_unclear(selection)._replace(gap=jnp.minimum(selection.gap, selection.gap_here))
    return keep_rows(scene, selection, is_held=True)


def _held_selection(scene: Scene, q, t) -> Selection:
    """The choice that a scene of `choose_rows` holds, made again where it is poor."""
    held, rows = scene.kept_rows, renew_rows(scene, q, t)
    gap = held.gap
    if scene.rounding:
        # In a singular position no choice is good, and rounding hides which rows are independent there.
        here = jnp.sqrt(rows[-1] / _EXCHANGED_AT) / jnp.maximum(held.rounding, eps_of(q))
        gap = jnp.minimum(gap, here)
    return Selection(rows[:-1], held.rounding, rows[-1], gap, gap)


def hide_unclear(selection: Selection) -> Selection:
    """The selection with NaN for all rows where it is not clear which ones are independent, so that no result is a guess."""
    return selection._replace(kept=jnp.where(selection.gap >= MIN_GAP, selection.kept, jnp.nan))


def rank_code(scene: Scene, result: Any) -> Any:
    """The result, or `unclear_rank` where kept and dropped rows of a scene of `independent_rows` differ too little."""
    if not has_selection(scene):
        return result
    is_clear = scene.kept_rows.gap >= MIN_GAP
    return RESULTS.where(is_clear, result, RESULTS.unclear_rank)


def select_rows(scene: Scene, q, t: Numbers, rank_tol: float | None = None) -> Selection:
    """The independent rows of a mechanism at a configuration on its constraints; a constant.

    With `rank_tol` rows count whose pivots are above it, at this configuration; without it as the module says. Concrete and
    traced arguments give the same rows. Infinite or NaN rows are all kept; `assemble` and `simulate` report such states.
    """
    if holds_rows(scene):
        return _held_selection(scene, q, t)
    # A choice has no derivative: forces do not select rows, and the scene, q and t enter without tangents.
    if is_concrete(scene, q, t):
        place = np.asarray(q), np.asarray(t, q.dtype)
        every, has_doubtful_rows = rows_and_doubts(scene, rank_tol=rank_tol, dtype=q.dtype)
        # Most scenes have independent rows: one Cholesky factorisation says so, and the search is skipped.
        if not every.kept.size or not has_doubtful_rows(*place):
            return every
        with keep_known():
            chosen = _select(scene.without_forces, *map(jnp.asarray, place), rank_tol)
        return Selection(*map(np.asarray, chosen))  # pyright: ignore[reportArgumentType]
    bare = stop_gradient(scene.without_forces)
    q, t = stop_gradient((q, t))
    every = _every_row(bare, q.dtype)
    if not every.kept.size:
        return every
    return _select_in_kernel(rank_tol, bare, q, jnp.asarray(t, q.dtype))


@once
def rows_and_doubts(scene: Scene, *, rank_tol: float | None, dtype) -> tuple[Selection, Evaluation]:
    """All rows of a known scene, and whether some are doubtful at (q, t)."""
    bare, every = scene.without_forces, _every_row(scene, dtype)
    return every, Evaluation(_has_doubtful_rows, bare, (_min_doubtless(every.kept, rank_tol),), is_input=is_given(bare))


@kernel(static=1, fallback=lambda rank_tol, scene, q, t: _select(scene, q, t, rank_tol))
def _select_in_kernel(rank_tol: float | None, scene: Scene, q, t) -> Selection:
    """All rows; invalid where some may repeat others, whose choice takes more than a kernel should hold."""
    kept, *rest = map(jnp.asarray, _every_row(scene, q.dtype))
    is_doubtful = _has_doubtful_rows(_min_doubtless(q, rank_tol), scene, q, t)
    return Selection(mark_invalid(is_doubtful, kept), *rest)


def _every_row(scene: Scene, dtype) -> Selection:
    none, far = np.zeros((), dtype), np.full((), np.inf, dtype)
    count = layout(scene)[-1].end if scene.constraints else 0
    return Selection(np.ones(count, dtype), none, none, far, far)  # pyright: ignore[reportArgumentType]


@entry_point
def _select(scene: Scene, q, t, rank_tol) -> Selection:
    """Rows that are independent beyond doubt at q, and of the others those that are independent a finite distance away."""
    B = kernel(unit_rows)(scene, q, t)
    apart = rank_tol if rank_tol is not None else clear_pivot(q)
    kept, rest, pivot = sure, _, pivot_here = eliminate(B, apart, jnp.zeros_like(B[:, 0]))
    if rank_tol is None:
        kept, rest, far = _select_far_away(scene, q, t, sure, apart)
        has_more = jnp.any(kept > sure)
        pivot = jnp.where(has_more, far, jnp.maximum(far, pivot))
        here, _, min_here = eliminate(kept[:, None] * B, 0.0, sure)
        # A row that vanishes here, as in a singular position, has a pivot of zero.
        min_here = jnp.where(jnp.sum(here) < jnp.sum(kept), jnp.zeros_like(min_here), min_here)
        pivot_here = jnp.where(has_more, min_here, pivot_here)
    rounding = jnp.maximum(rest, kernel(largest_opening)(scene, q, t, kept))
    # A gap to nothing is one to the rounding of the numbers: where no row is dropped, those in doubt may be dependent here.
    below = jnp.maximum(rest, eps_of(q))
    below_here = jnp.where(jnp.all(kept == 1), jnp.maximum(below, scene.rounding), jnp.maximum(below, rounding))
    minimum = _EXCHANGED_AT * kernel(_pivot_of)(scene, q, t, kept)
    chosen = Selection(kept, rounding, minimum, pivot / below, pivot_here / below_here)
    every, is_finite = _every_row(scene, q.dtype), jnp.isfinite(B).all()
    return jax.tree.map(lambda x, y: jnp.where(is_finite, x, y), chosen, every)


def renew_rows(scene: Scene, q, t) -> Float[Array, " n"]:
    """`rows_of` a scene for the next step, with the same number of rows; a constant.

    Rows are chosen anew where the kept ones have become nearly dependent. There are positions at which every fixed choice of rows
    loses rank, though all rows together do not.
    """
    bare, q, t = stop_gradient((all_rows(scene).without_forces, q, jnp.asarray(t, q.dtype)))
    return _renew(bare, q, t, rows_of(scene, q.dtype))


def are_rows_poor(scene: Scene, q, t) -> Bool[Array, ""]:
    """Decide whether `renew_rows` chooses other rows; a constant."""
    bare, q, t = stop_gradient((all_rows(scene).without_forces, q, jnp.asarray(t, q.dtype)))
    return kernel(_are_poor)(bare, q, t, rows_of(scene, q.dtype))


def _are_poor(bare: Scene, q, t, rows):
    kept, minimum = rows[:-1], rows[-1]
    return jnp.any(kept == 0) & ~(_pivot_of(bare, q, t, kept) > minimum)


def _choose_again(bare: Scene, q, t, old):
    """Another choice of rows where the old one is poor."""
    kept, minimum = old[:-1], old[-1]
    pivot = kernel(_pivot_of)(bare, q, t, kept)
    is_poor = jnp.any(kept == 0) & ~(pivot > minimum)
    # The number of rows is kept: only the count at the start distinguishes redundant rows from a singular position.
    new = eliminate(kernel(unit_rows)(bare, q, t), 0.0, jnp.zeros_like(kept), jnp.sum(kept))[0]
    pivot_of_new = kernel(_pivot_of)(bare, q, t, new)
    # At a singular position no choice is good. The old rows are kept then, unless the new ones are better, and the limit is
    # lowered with the pivot, so that the search is not repeated in every step on the way through.
    is_better = is_poor & (jnp.sum(new) == jnp.sum(kept)) & ~(pivot_of_new < pivot)
    kept_next, next_pivot = jnp.where(is_better, new, kept), jnp.where(is_better, pivot_of_new, pivot)
    return jnp.where(is_poor, jnp.append(kept_next, _EXCHANGED_AT * next_pivot), old)


@kernel(fallback=_choose_again)
def _renew(bare: Scene, q, t, old):
    return mark_invalid(_are_poor(bare, q, t, old), old)


def _pivot_of(scene: Scene, q, t, kept):
    """`min_pivot_of` the kept rows in the metric of the mass matrix; zero where one of them vanishes."""
    A = kept[:, None] * constraint_jacobian(scene, q, t)
    Y = mass_factor(mass_matrix(scene.system, q, t)).whiten(A.T)
    vanishes = jnp.any((kept > 0) & (jnp.sum(Y * Y, 0) == 0))
    return jnp.where(vanishes, 0.0, min_pivot_of(Y))


def _min_doubtless(like, rank_tol: float | None) -> float:
    """Distance from the others above which a row counts, whatever the tolerance."""
    return max(clear_pivot(like), rank_tol or 0.0)


def _has_doubtful_rows(minimum: float, scene: Scene, q, t):
    """Decide whether the distance of some row from the span of those before it is not above `minimum`; True for NaN."""
    # The diagonal of the Cholesky factor of B B^T holds these distances, NaN where a row is dependent.
    B = unit_rows(scene, q, t)
    return ~(jnp.min(jnp.diagonal(cholesky(matmul(B, B.T)))) > minimum)


def _select_far_away(scene: Scene, q, t, sure, apart: float):
    """`eliminate` at a configuration a finite distance away; the rows in `sure` are independent already.

    A row that differs little from a combination of the others, there too, counts as independent only in a scene of exact numbers,
    where it holds at q and at least one degree of freedom is left.
    """
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    minimum = tolerance(None, q)
    held = holonomic_rows(layout(scene))

    # Any admissible direction will do that moves all of the mechanism. The golden ratio's multiples are equally spread, and the
    # same in every call: a random direction would make the choice of rows, and so the bits of a motion, random.
    A = sure[:, None] * constraint_jacobian(scene, q, t)
    direction = jnp.asarray(1 + np.modf(np.arange(scene.nv) * 0.618)[0], q.dtype)
    direction = direction - solve_with_damping(A * sizes[None], matmul(A * sizes[None], direction))
    length = jnp.max(jnp.abs(direction))
    # A structure (no admissible direction) is tested where it is.
    moves = length > 1e-6
    direction = jnp.where(moves, direction / jnp.where(moves, length, jnp.ones_like(length)), direction)
    place = displace(scene.system, q, _FAR * direction * sizes)

    def close(state):
        count, place, _ = state
        place = retract(scene.system, place)
        A = (sure[:, None] * constraint_jacobian(scene, place, t))[held]
        step = solve_with_damping(A * sizes[None], sure[held] * position_residual(scene, place, t)) * sizes
        # A step longer than the distance itself would leave the branch.
        size = jnp.max(jnp.abs(step / sizes))
        place = displace(scene.system, place, -step * jnp.minimum(1.0, _FAR / jnp.where(size > 0, size, 1.0)))
        return count + 1, place, size

    def goes_on(state):
        # Newton's steps square the distance: behind one of this size the next is lost in rounding. Also where it is not a number.
        return (state[0] < _NEWTON_STEPS) & ~(state[2] < eps_of(q) ** RESIDUAL)

    if held.size:
        place = retract(scene.system, lax.while_loop(goes_on, close, (0, place, jnp.ones((), q.dtype)))[1])
        # Off the constraints rows that repeat others look independent: where the search did not close them, q itself decides.
        is_closed = largest_opening(scene, place, t, 1 - sure) <= eps_of(q) ** REGULAR
        place = jnp.where(is_closed, place, q)
    B = kernel(unit_rows)(scene, place, t)
    # Twice the threshold at q: a row at the threshold has to have separated, not to have changed by rounding.
    kept, rest, pivot = eliminate(B, 2 * apart, sure)
    kept = jnp.maximum(sure, kept)  # pivots of sure rows may be smaller there; they stay
    if scene.rounding:
        return kept, rest, pivot
    # Exact numbers: what is left of a row is its true direction, unless the row contradicts the others, or would leave no motion
    # at all. In both cases the difference is rounding in the numbers of the scene after all.
    every, min_rest, min_pivot = eliminate(B, minimum, kept)
    met = largest_opening(scene, q, t, 1 - every * (1 - kept)) <= eps_of(q) ** REGULAR
    counts = met & (jnp.sum(every) < scene.nv)
    return tuple(jnp.where(counts, x, y) for x, y in ((every, kept), (min_rest, rest), (min_pivot, pivot)))


def max_rounding(dtype) -> float:
    """Opening of dropped rows above which they are not redundant but contradict the others."""
    return 10 * clear_pivot(np.zeros((), dtype))


def degrees_of_freedom(
    scene: SceneLike, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> int | Int[Array, ""]:
    r"""Degrees of freedom at a configuration: nv minus the rank of the constraints' rows A(q, t).

    Dependent rows count once, so that the count is right for overconstrained linkages. It counts independent velocities at
    this q: it is larger in singular positions, and rolling reduces it though all configurations remain reachable. Loops whose
    rows are dependent only where the loops are closed need a q of `jd.assemble`. Distances are compared in
    units of the mechanism's length, each row scaled to length 1; rows at rounding level count as zero.

    **Arguments:** `scene`, a `Scene` or a system; `q` (nq,); `t`, s; `rank_tol`: singular values below `rank_tol` times the
    largest count as zero, by default $\epsilon^{4/7}$, 1e-9 in float64.

    **Returns:** an int for concrete arguments, an integer array () for traced ones, which is -1 where rounding of the numbers
    hides the rank.

    **Raises:** ValueError for shapes that do not fit, a `rank_tol` outside (0, 1), and for a rank that is not clear.

    Source: EQUATIONS section 7; the rank is the trace of $A A^+$.

    ```python
    count = jd.degrees_of_freedom(jd.scenes.four_bar(), jd.scenes.four_bar.start()[0])  # 1
    ```
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    rank_tol = check_tolerance(rank_tol)
    if not layout(scene):
        return scene.nv
    free = count_free(independent_rows(scene, q, t, rank_tol), q, t, rank_tol)
    if not is_concrete(free):
        return free
    if free < 0:
        raise ValueError(f"{UNCLEAR_RANK}; give numbers with more digits, or a rank_tol between them")
    return int(free)


@entry_point
def count_free(scene: Scene, q, t, rank_tol: float | None) -> Int[Array, ""]:
    """`degrees_of_freedom` by rows that are taken as they are; -1 where the rank is not clear."""
    # Scaled rows: the singular values of metres next to radians depend on the unit. The rank is by the
    # pseudo-inverse that all other rank decisions use, so that they agree.
    A = unit_rows(scene, q, t)
    inverse = pseudo_inverse(A, tolerance(rank_tol, A), True)
    is_clear = has_clear_rank(A, inverse, rank_tol)
    if has_selection(scene):
        is_clear = is_clear & (scene.kept_rows.gap >= MIN_GAP)
    return jnp.where(is_clear, scene.nv - rank_of(A, inverse), -1).astype(jnp.int32)
