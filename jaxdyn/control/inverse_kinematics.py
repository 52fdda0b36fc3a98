"""Inverse kinematics: configurations at which frames have given poses, on the constraints of a scene and within its limits.

1. `search`: damped least squares from the guess, and from other places where that fails.
2. With a `posture`: along the targets to where the change from it is least, in the mass metric, as in `assemble`.

Derivatives are those of the least change, in the mass metric, that follows the targets: by the implicit function theorem, of any
order (`nearest_configuration`).
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxdyn.compile import entry_point, invalidate_derivatives
from jaxdyn.compile.known import is_concrete, is_known, stop_gradient
from jaxdyn.constraints.assembly import check_search, closing_tolerance, independent_rows_near
from jaxdyn.constraints.base import Constraint, holonomic_rows, layout, position_residual
from jaxdyn.constraints.closing import nearest_configuration, polish, slide_to_nearest
from jaxdyn.constraints.codes import RESULTS, Outcome, name_of, require_success
from jaxdyn.constraints.redundancy import KeptRows, has_selection, opening_of_redundant, own_length
from jaxdyn.constraints.selection import most_rounding
from jaxdyn.control.targets import Aims, as_targets, clip_to_limits, screw_joints, search, target_rows
from jaxdyn.model.arguments import Checked, Given, Number, Numbers, as_operand, check_flag, check_mapping, check_state
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, displace


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
    check_search(steps, guesses, atol)
    if posture is not None:
        (posture,) = check_state(model, q_posture=posture)
    factors = row_weights(rows, weights, guess.dtype)
    # Forces and cones do not affect configurations: they are left out, so that others do not cause a second compilation.
    place = _solve(
        Scene(model, scene.constraints),
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


def row_weights(rows: tuple[Constraint, ...], weights, dtype) -> Given:
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


@entry_point
def _solve(scene: Scene, rows, guess, factors, posture, t, limits: bool, steps: int, guesses: int, atol):
    model, every = scene.system, scene
    scene = independent_rows_near(scene, guess, t)
    whole = Scene(model, (*scene.constraints, *rows))
    # The search is not differentiated: `_differentiable` attaches the derivatives of its result.
    fixed, start, factors, time = stop_gradient((whole, guess, factors, t))
    aims = _aims(fixed, len(scene.constraints), factors, limits, atol)

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
    is_reached = _reaches_targets(fixed, q, time, aims)
    if len(scene.constraints):
        # Out of reach, the last steps trade errors of targets for small openings, which are closed after.
        q = jnp.where(is_reached, q, lax.stop_gradient(search(fixed, q, time, _exact_rows_only(aims), 1)[0]))
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
    reached = _reaches_targets(fixed, lax.stop_gradient(q), time, aims)
    reached = reached & (opening_of_redundant(scene, q, t) <= most_rounding(q.dtype))
    closed = jnp.all(~exact | (jnp.abs(lax.stop_gradient(values)) <= aims.tolerances))
    result = RESULTS.where(closed, RESULTS.targets_not_reached, RESULTS.not_assembled)
    result = RESULTS.where(reached, RESULTS.where(is_nearest, RESULTS.successful, RESULTS.not_nearest), result)
    return InverseKinematics(q, jnp.max(counted, initial=0.0), errors, opening, result, tried)


def _reaches_targets(scene: Scene, q, t, aims: Aims):
    r = aims.weights * position_residual(scene, q, t)
    return jnp.all(jnp.abs(r) <= aims.tolerances)


def _aims(whole: Scene, constraints: int, factors, limits: bool, atol) -> Aims:
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
    least = near * (jnp.maximum(length, 1.0) if atol is None else jnp.ones_like(length))
    # Tolerances have the weights of their rows: a weight of zero gives a row and a tolerance of zero, which counts as reached.
    tolerances = jnp.concatenate([jnp.broadcast_to(least, (count,)), least * factors * scale])
    exact = jnp.asarray(np.arange(nh) < count, dtype)
    endless = jnp.full_like(model.lower, jnp.inf)
    lower, upper = (model.lower, model.upper) if limits else (-endless, endless)
    return Aims(weights, jnp.zeros((nh,), dtype), tolerances, exact, *stop_gradient((lower, upper)))


def _exact_rows_only(aims: Aims) -> Aims:
    """Aims that any errors of the targets satisfy."""
    tolerances = jnp.where(aims.is_exact > 0, aims.tolerances, jnp.full_like(aims.tolerances, jnp.inf))
    return aims._replace(weights=aims.weights * aims.is_exact, tolerances=tolerances)


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
    is_counted, first = aims.tolerances > 0, int(aims.is_exact.size)
    rows = list(whole.constraints)
    for i in reversed(range(constraints, len(rows))):
        first -= sum(target_rows(rows[i]))
        # Rows of weight zero are masked: q does not satisfy them, so that they have no derivative there.
        counted = is_counted[first : first + sum(target_rows(rows[i]))].astype(q.dtype)
        none = jnp.zeros((), q.dtype)
        rows[i] = KeptRows(rows[i], counted, none, none, none, rows[i].name)  # pyright: ignore[reportArgumentType]
    joints = _joints_with_limits(model, aims)
    at = np.asarray(joints, int)
    lower, upper = aims.lower[at], aims.upper[at]

    def scene_at(active) -> Scene:
        """With the joints that are `active` held at their lower (-1) or upper (1) limits."""
        if not joints:
            return Scene(model, tuple(rows))
        limit = jnp.where(active < 0, lower, upper)
        at_limit = jnp.where(active != 0, limit, jnp.zeros_like(limit))
        return Scene(model, (*rows, _HeldAtLimits(active, at_limit, joints)))

    def sides(below, above):
        return above.astype(q.dtype) - below.astype(q.dtype)

    if posture is None:
        # Joints at a limit are held there, so that derivatives do not lead out of it.
        scene = scene_at(sides(q[at] <= lower, q[at] >= upper))
        # q is the configuration nearest to itself: `solve` returns the start, and only the derivative is computed.
        place, _ = _with_derivatives(scene, q, q, jnp.ones((), q.dtype), t)
        return place, jnp.asarray(True)

    fixed, guess, time = stop_gradient((Scene(model, tuple(rows)), posture, t))
    bounds = None
    if joints:
        at_v = np.asarray([slot for place, slot in zip(*screw_joints(model), strict=True) if place in joints])
        endless = jnp.full((model.nv,), jnp.inf, q.dtype)
        bounds = (-endless).at[at_v].set(lower - guess[at]), endless.at[at_v].set(upper - guess[at])
    end = slide_to_nearest(fixed, guess, q, time, None, bounds)
    # The set of joints at a limit is a decision without derivative.
    scene = scene_at(end.held[at_v] if joints else jnp.zeros((0,), q.dtype))
    found = polish(stop_gradient(scene), displace(model, guess, end.e), time, None)
    place, is_nearest = _with_derivatives(scene, posture, found, end.is_nearest, t)
    if not joints:
        return place, is_nearest > 0
    place = clip_rounding(place, at, lower, upper)
    is_within = jnp.all((place[at] >= lower) & (place[at] <= upper))
    return place, (is_nearest > 0) & is_within


def clip_rounding(q, at: np.ndarray, lower, upper):
    """q with joints that pass a limit by rounding on it."""
    # A joint that is held at a limit satisfies its row up to this tolerance only.
    near = closing_tolerance(q.dtype)
    x = q[at]
    x = jnp.where((x < lower) & (x > lower - near), lower, x)
    return q.at[at].set(jnp.where((x > upper) & (x < upper + near), upper, x))


def _joints_with_limits(model: Model, aims: Aims) -> tuple[int, ...]:
    """Places in q of the joints of one degree of freedom that have limits, or may have some."""
    at_q, _ = screw_joints(model)
    if is_concrete(aims.lower, aims.upper):
        at_q = at_q[np.isfinite(np.asarray(aims.lower)[at_q]) | np.isfinite(np.asarray(aims.upper)[at_q])]
    return tuple(at_q.tolist())
