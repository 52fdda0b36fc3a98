"""Inverse kinematics: configurations at which frames have given poses, on the constraints of a scene and within its limits.

1. `search`: damped least squares from the guess, and from other places where that fails.
2. With a `posture`: along the targets to where the change from it is least, in the mass metric, as in `assemble`.

Derivatives are those of the least change, in the mass metric, that follows the targets: by the implicit function theorem, of any
order (`nearest_configuration`).
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.compile import entry_point, invalidate_derivatives
from jaxdyn.compile.known import is_concrete, stop_gradient
from jaxdyn.constraints.assembly import check_search, closing_tolerance, independent_rows_near
from jaxdyn.constraints.base import Constraint, holonomic_rows, layout, position_residual
from jaxdyn.constraints.closing import nearest_configuration, polish, slide_to_place
from jaxdyn.constraints.codes import RESULTS, Outcome, name_of, require_success
from jaxdyn.constraints.rank import condition_number, rank_of
from jaxdyn.constraints.redundancy import (
    KeptRows,
    add_constraints,
    changes_branch,
    has_selection,
    opening_of_redundant,
    unit_size_rows,
)
from jaxdyn.constraints.selection import independent_rows, max_rounding
from jaxdyn.control.targets import (
    TASKS,
    Aims,
    aims_of,
    as_targets,
    clip_to_limits,
    reaches_targets,
    row_weights,
    screw_joints,
    search,
)
from jaxdyn.model.arguments import Checked, Number, Numbers, check_flag, check_state
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike


class InverseKinematics(Outcome):
    """A configuration that reaches targets.

    - `q` (nq,). `residual` (): the largest error that is left, in m or rad, over all rows of targets whose weight is not zero.
    - `errors` (m,): all rows of the targets, in their order: positions in m, in the axes of the target; orientations as rotation
      vectors, rad. `constraint_residual` (): the largest |phi| of the scene's constraints, m or rad.
    - `result`: one of `RESULTS`; `targets_not_reached`: q is then the best place that was met; `not_assembled`: it is not
      even on the constraints; `not_nearest`: q reaches the targets, but the search for the nearest one to the posture did not
      converge. `guesses` (): how many places the search began at.
    """

    q: Float[Array, " nq"]
    residual: Float[Array, ""]
    errors: Float[Array, " m"]
    constraint_residual: Float[Array, ""]
    result: Any
    guesses: Int[Array, ""]


class _HeldAtLimits(Constraint):
    """Joints of one degree of freedom that are held at a limit: rows q - limit where `active` is not 0, else zero."""

    active: Float[Array, " n"]  # -1 at the lower limit, 1 at the upper one
    limit: Float[Array, " n"]
    joints: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True, default="limits", kw_only=True)

    def sizes(self, system, dtype):
        """A row for each joint."""
        return len(self.joints), 0

    def position(self, system, q, t):
        """Distances from the limits, (n,)."""
        # Rows of inactive joints are zero and not left out: the set changes while shapes stay fixed.
        return jnp.where(self.active != 0, q[np.asarray(self.joints)] - self.limit, jnp.zeros_like(self.limit))


def inverse_kinematics(
    scene: SceneLike,
    targets: Checked[Mapping[str, Any]],
    guess: Float[Array, " nq"],
    *,
    weights: Checked[Mapping[str, Numbers] | None] = None,
    limits: bool = True,
    posture: Numbers | None = None,
    steps: int = 1,
    guesses: int = 16,
    atol: float | None = None,
    t: Numbers = 0.0,
    throw: bool | None = None,
) -> InverseKinematics:
    """Find q at which named frames reach targets, on the constraints and with joints within their limits.

    Loops and other constraints on positions hold exactly. Where targets leave freedom, q is where short steps of damped least
    squares from the guess lead; with a `posture` it is the nearest one to that. Where they cannot be reached q minimises the
    weighted squares of the errors, as far as a local search tells.

    **Arguments:**

    - `scene`: a `Model`, or a scene of one. `guess` (nq,): the configuration from which the search starts.
    - `targets`: by names of frames: a pose (4, 4), an orientation (3, 3) or a position (3,) in the world; or a dictionary with
      some of `pose`, `position`, `orientation`, and `direction` (3,), along which an `axis` (3,) of the frame (by default its z)
      is to point. "center_of_mass": (3,).
    - `weights`: by the same names, a number or one per row of the target, not negative; positions count in units of the
      mechanism's length. 0 leaves a row out. None: 1.
    - `limits`: whether joints of one degree of freedom keep to the model's `lower` and `upper`.
    - `posture` (nq,): of the configurations that reach the targets, the nearest one to it in the mass metric is taken, a local
      minimum. Joints that would pass a limit are held there.
    - `steps`: through how many equal parts of the errors of the guess to go: more of them keep to the branch of the guess.
    - `guesses`: from how many places to search. The first is the guess; the others, tried only where it fails, fill the space
      within the limits evenly. 1 keeps to the guess.
    - `atol`, m or rad: errors of targets and constraints that count as none. None: rounding, 1e-11 in float64.
    - `t`, s, of the constraints. `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `InverseKinematics`. Derivatives of q with respect to targets and all numbers of the scene are those of the least
    change in the mass metric; with a posture, those of the nearest configuration, also with respect to it. They are zero where
    the targets were not reached.

    **Raises:** ValueError for a system without frames, unknown frames, shapes that do not fit, weights that are negative, and, if
    `throw`, where the targets are not reached, with the errors that are left.

    Source: Sugihara (2011), Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method.

    ```python
    arm = jd.robots.iiwa()
    goal = jd.frame_pose(arm, jnp.full(7, 0.5), "iiwa_link_7")
    q = jd.inverse_kinematics(arm, {"iiwa_link_7": goal}, jnp.full(7, 0.1)).q
    ```
    """
    scene = as_scene(scene)
    rows = as_targets(scene.system, targets)
    model: Model = scene.system
    guess, t = check_state(model, q=guess, t=t)
    if is_concrete(guess) and not np.isfinite(np.asarray(guess)).all():
        raise ValueError(f"guess is {np.asarray(guess)}; give finite numbers")
    check_search(steps, guesses, atol)
    if posture is not None:
        (posture,) = check_state(model, q_posture=posture)
    factors = row_weights(rows, weights, guess.dtype)
    # Forces and cones do not affect configurations: they are left out, so that others do not cause a second compilation.
    place = _solve(
        scene.without_forces,
        rows,
        guess,
        factors,
        posture,
        t,
        check_flag(limits, "limits"),
        steps,
        guesses,
        atol,
    )

    def message(place: InverseKinematics) -> str:
        return (
            f"inverse_kinematics: {name_of(place.result)}: errors {np.array2string(np.asarray(place.errors), precision=3)} "
            f"(m, rad) are left, and {float(place.constraint_residual):.3g} of the constraints, from {int(place.guesses)} "
            "places; give a better guess, other targets or weights, more guesses, or throw=False"
        )

    return require_success(place, throw, message)


@entry_point
def _solve(scene: Scene, rows, guess, factors, posture, t, limits: bool, steps: int, guesses: int, atol):
    model, every = scene.system, scene
    scene = independent_rows_near(scene, guess, t)
    whole = add_constraints(scene, rows)
    # The search is not differentiated: `_differentiable` attaches the derivatives of its result.
    fixed, start, factors, time = stop_gradient((whole, guess, factors, t))
    aims = aims_of(fixed, len(scene.constraints), factors, limits, atol)

    if steps > 1:  # equal parts of what the guess leaves open
        first = position_residual(fixed, clip_to_limits(model, start, aims), time)

        def go_on(q, part):
            # One place only: a search from elsewhere would leave the branch of the guess.
            return search(fixed, q, time, aims._replace(shift=part * first), 1)[0], None

        # Parts of the first errors that are left after each step; the last search, below, leaves none.
        parts = jnp.asarray(1 - np.arange(1, steps) / steps, guess.dtype)
        start = lax.scan(go_on, start, parts)[0]
    q, tried = search(fixed, start, time, aims, guesses)
    q = lax.stop_gradient(q)
    is_reached = reaches_targets(fixed, q, time, aims)
    if len(scene.constraints):
        # Out of reach, the last steps trade errors of targets for small openings, which are closed after: any errors of the
        # targets satisfy these aims.
        tolerances = jnp.where(aims.is_exact > 0, aims.tolerances, jnp.full_like(aims.tolerances, jnp.inf))
        closing = aims._replace(weights=aims.weights * aims.is_exact, tolerances=tolerances)
        q = jnp.where(is_reached, q, lax.stop_gradient(search(fixed, q, time, closing, 1)[0]))
    # The implicit function theorem holds at a solution only. Elsewhere q is a constant, and its derivatives are NaN.
    solution, is_nearest = _differentiable(whole, q, posture, t, aims, len(scene.constraints))
    q = jnp.where(is_reached & is_nearest, solution, q)
    q = invalidate_derivatives(q, ~(is_reached & is_nearest), (whole, guess, factors, posture, t))

    values = position_residual(whole, q, t)
    exact = aims.is_exact > 0
    # The rows of targets follow those of the constraints.
    errors = values[holonomic_rows(layout(scene)).size :]
    counted = jnp.where(factors > 0, jnp.abs(errors), jnp.zeros_like(errors))
    opening = jnp.max(jnp.where(exact, jnp.abs(values), jnp.zeros_like(values)), initial=0.0)
    if has_selection(scene):
        opening = jnp.maximum(opening, jnp.max(jnp.abs(position_residual(every, q, t))))
    # Evaluated again, because sliding towards the posture has changed q.
    reached = reaches_targets(fixed, lax.stop_gradient(q), time, aims)
    reached = reached & (opening_of_redundant(scene, q, t) <= max_rounding(q.dtype))
    closed = jnp.all(~exact | (jnp.abs(lax.stop_gradient(values)) <= aims.tolerances))
    result = RESULTS.where(closed, RESULTS.targets_not_reached, RESULTS.not_assembled)
    result = RESULTS.where(reached, RESULTS.where(is_nearest, RESULTS.successful, RESULTS.not_nearest), result)
    return InverseKinematics(q, jnp.max(counted, initial=0.0), errors, opening, result, tried)


def _with_derivatives(scene: Scene, guess, place, is_nearest, t: Number):
    """The place (nq,) that a search has found, and whether it is the nearest to the guess, with the derivatives of that."""
    # As an argument, which `solve` returns: a function with a rule may not close over traced values.
    found = jnp.append(place, is_nearest)
    return nearest_configuration(
        scene, guess, found, t, None, solve=lambda scene, guess, start, t: (start[:-1], start[-1])
    )


def _differentiable(whole: Scene, q, posture, t: Number, aims: Aims, constraints: int):
    """q as the configuration nearest to itself, or to a posture, that reaches the targets, with its derivatives."""
    model: Model = whole.system
    first = layout(whole)[constraints].start
    own = jnp.ones((first,), q.dtype) if whole.kept_rows is None else whole.kept_rows.kept[:first]
    # Rows of weight zero are masked: q does not satisfy them, so that they have no derivative there.
    counted = (aims.tolerances > 0)[holonomic_rows(layout(whole)) >= first].astype(q.dtype)
    none = jnp.zeros((), q.dtype)
    whole = whole.with_kept_rows(KeptRows(jnp.concatenate([own, counted]), none, none, none))
    # Places in q of the joints of one degree of freedom that have limits, or may have some.
    at, _ = screw_joints(model)
    if is_concrete(aims.lower, aims.upper):
        at = at[np.isfinite(np.asarray(aims.lower)[at]) | np.isfinite(np.asarray(aims.upper)[at])]
    joints = tuple(at.tolist())
    lower, upper = aims.lower[at], aims.upper[at]

    def scene_at(active) -> Scene:
        """With the joints that are `active` held at their lower (-1) or upper (1) limits."""
        if not joints:
            return whole
        limit = jnp.where(active < 0, lower, upper)
        at_limit = jnp.where(active != 0, limit, jnp.zeros_like(limit))
        return add_constraints(whole, [_HeldAtLimits(active, at_limit, joints)])

    def sides(below, above):
        return above.astype(q.dtype) - below.astype(q.dtype)

    if posture is None:
        # Joints at a limit are held there, so that derivatives do not lead out of it.
        scene = scene_at(sides(q[at] <= lower, q[at] >= upper))
        # q is the configuration nearest to itself: `solve` returns the start, and only the derivative is computed.
        place, _ = _with_derivatives(scene, q, q, jnp.ones((), q.dtype), t)
        return place, jnp.asarray(True)

    fixed, guess, time = stop_gradient((whole, posture, t))
    bounds = None
    if joints:
        at_v = np.asarray([slot for place, slot in zip(*screw_joints(model), strict=True) if place in joints])
        endless = jnp.full((model.nv,), jnp.inf, q.dtype)
        bounds = (-endless).at[at_v].set(lower - guess[at]), endless.at[at_v].set(upper - guess[at])
    reached, end = slide_to_place(fixed, guess, q, time, None, bounds)
    # The set of joints at a limit is a decision without derivative.
    scene = scene_at(end.held[at_v] if joints else jnp.zeros((0,), q.dtype))
    found = polish(stop_gradient(scene), reached, time, None)
    place, is_nearest = _with_derivatives(scene, posture, found, end.is_nearest, t)
    if not joints:
        return place, is_nearest > 0
    # A joint that is held at a limit satisfies its row up to this tolerance only: those that pass it by rounding are put on it.
    near = closing_tolerance(q.dtype)
    x = place[at]
    x = jnp.where((x < lower) & (x > lower - near), lower, x)
    place = place.at[at].set(jnp.where((x > upper) & (x < upper + near), upper, x))
    is_within = jnp.all((place[at] >= lower) & (place[at] <= upper))
    return place, (is_nearest > 0) & is_within


# --- along a path: each configuration from the one before, with a test that the branch was kept ---
#
# The rows R of constraints and targets, weighted and in coordinates scaled by the sizes of joints, have singular values that
# count the distance from a singular position. Where a combination of rows goes through zero between two configurations, the
# determinant of R' R^+ + (1 - R R^+) changes its sign: the branch is another one after that.


class Following(Outcome):
    """Configurations along a path of targets.

    - `q` (n, nq); `residual` (n,) and `result` (n,) as of `InverseKinematics`.
    - `regularity` (n,): r / (|R| |R^+|) of the rows of constraints and targets, of rank r: 1 where all singular values are equal,
      at most r times the least over the largest one, and 0 where the rank is less than at the first place.
    - `changes_branch` (n,): whether between the configuration before and this one a combination of rows went through zero, or
      a coordinate jumped by more than a radian or a length of the mechanism.
    """

    q: Float[Array, "n nq"]
    residual: Float[Array, " n"]
    result: Any
    regularity: Float[Array, " n"]
    changes_branch: Bool[Array, " n"]


def follow(
    scene: SceneLike,
    targets: Checked[Mapping[str, Any]],
    guess: Float[Array, " nq"],
    *,
    guesses: int = 1,
    t: Numbers = 0.0,
    throw: bool | None = None,
    **options: Any,
) -> Following:
    """Inverse kinematics along a path or over a grid: each configuration by `inverse_kinematics` from the one before.

    The first one is searched for from the guess, all others by the least change, which keeps the branch where the path has steps
    short enough; `changes_branch` says where that was lost.

    **Arguments:** as of `inverse_kinematics`, and

    - `targets`: as there, with one row for each of the n places: poses (n, 4, 4), or dictionaries of positions (n, 3) and
      directions (n, 3). A grid is followed row by row, forth and back.
    - `guesses`: number of starts at the places after the first one; the first is searched for from 16.
    - `options`: further ones of `inverse_kinematics`.

    **Returns:** `Following`. Derivatives are those of each configuration by its own targets.

    **Raises:** ValueError as `inverse_kinematics`, and for targets of different lengths; if `throw`, by default if all inputs are
    concrete, for a place that was not reached, with its index.

    Source: Allgower & Georg (1990), Numerical continuation methods, chapters 2 and 5.

    ```python
    arm = jd.robots.iiwa()
    start = jd.frame_pose(arm, jnp.full(7, 0.5), "iiwa_link_7")
    path = jnp.stack([start.at[2, 3].add(-0.01 * k) for k in range(5)])
    q = jd.follow(arm, {"iiwa_link_7": path}, jnp.full(7, 0.5)).q
    ```
    """
    scene = as_scene(scene)
    (guess,) = check_state(scene.system, q=guess)
    if not isinstance(targets, Mapping) or not targets:
        raise ValueError(f"targets is {targets!r}; give a dictionary of targets by the names of frames")
    # A target that is an array stands under an empty name.
    rows = {name: dict(value) if isinstance(value, Mapping) else {"": value} for name, value in targets.items()}
    # An axis is one vector for the whole path: it must not be scanned over like the rows of the targets.
    axes = {name: value.pop("axis") for name, value in rows.items() if "axis" in value}
    for name, value in rows.items():
        if not value:
            raise ValueError(
                f"targets[{name!r}] is {targets[name]}, which names no target; give some of {', '.join(TASKS)}"
            )
    lengths = {name: np.shape(x)[0] if np.ndim(x) else 0 for name, value in rows.items() for x in value.values()}
    if len(set(lengths.values())) != 1 or 0 in lengths.values():
        raise ValueError(f"targets have the lengths {lengths}; give every target one row for each place of the path")

    def at(row):
        """Targets of one place, as `inverse_kinematics` takes them."""
        named = {name: value | {"axis": axes[name]} if name in axes else value for name, value in row.items()}
        return {name: value[""] if "" in value else value for name, value in named.items()}

    rows = jax.tree.map(jnp.asarray, rows)
    first, rest = (jax.tree.map(lambda x, part=part: x[part], rows) for part in (0, slice(1, None)))
    factors = row_weights(as_targets(scene.system, at(first)), options.get("weights"), guess.dtype)

    def place(row, guess, guesses):
        """A configuration, and its rows."""
        # A scan cannot raise: places that were not reached are reported after it, by their index.
        reached = inverse_kinematics(scene, at(row), guess, guesses=guesses, t=t, throw=False, **options)
        counted = independent_rows(scene, lax.stop_gradient(reached.q), t)
        whole = add_constraints(counted, as_targets(scene.system, at(row)))
        return reached, unit_size_rows(whole, lax.stop_gradient(reached.q), t, factors)

    def go_on(carry, row):
        q, R, inverse = carry
        reached, (R_after, inverse_after) = place(row, q, guesses)
        # Derivatives are those of each place by its own targets: the chain through the places before it is cut.
        after = lax.stop_gradient(reached.q)
        changes = changes_branch(scene.system, q, after, R_after, R, inverse)
        regularity = _regularity(R_after, inverse_after, rank)
        return (after, R_after, inverse_after), (reached, regularity, changes)

    # 16 guesses, the default of `inverse_kinematics`: only the first place has no neighbour to start from.
    begin, (R, inverse) = place(first, guess, 16)
    # The rank at the first place is the reference for all others.
    rank = rank_of(R, inverse)
    states = (lax.stop_gradient(begin.q), R, inverse)
    _, (places, regularity, changes) = lax.scan(go_on, states, rest)
    every = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), begin, places)
    regularity = jnp.concatenate([_regularity(R, inverse, rank)[None], regularity])
    changes = jnp.concatenate([jnp.zeros(1, bool), changes])
    path = Following(every.q, every.residual, every.result, regularity, changes)

    def message(path: Following) -> str:
        lost = np.flatnonzero(~np.asarray(path.success))
        return (
            f"follow: {lost.size} places of {path.q.shape[0]} were not reached, the first one number {lost[0]}, with errors "
            f"up to {float(path.residual[lost[0]]):.3g} (m or rad); give shorter steps, more guesses, or throw=False"
        )

    return require_success(path, throw, message)


def _regularity(R, inverse, rank):
    """r / (|R| |R^+|) in Frobenius' norm, and 0 where the rank r is less than `rank`."""
    size = condition_number(R, inverse)
    # By the inequality of Cauchy and Schwarz |R| |R^+| >= r. The minimum removes rounding above 1.
    regular = jnp.minimum(rank / jnp.where(size > 0, size, jnp.ones_like(size)), 1.0)
    # R^+ omits singular values below the tolerance: a drop of rank does not make |R^+| large and needs a test of its own.
    return jnp.where(rank_of(R, inverse) >= rank, regular, jnp.zeros_like(regular))
