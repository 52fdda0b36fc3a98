"""Assembly of a scene: a state on the constraints from a rough guess."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import Evaluation, entry_point, evaluate, invalidate_derivatives, kernel
from jaxdyn.compile.known import is_concrete, once, stop_gradient
from jaxdyn.constraints.base import Layout, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.closing import follow_path, nearest_configuration, polish
from jaxdyn.constraints.codes import RESULTS, Outcome, first_of, name_of, require_success
from jaxdyn.constraints.dynamics import correction
from jaxdyn.constraints.loops import lock_joint
from jaxdyn.constraints.rank import CLOSED, MIN_GAP, check_tolerance, clear_pivot, tolerance
from jaxdyn.constraints.redundancy import (
    add_constraints,
    changes_branch,
    coordinate_sizes,
    keep_rows,
    largest_ratio,
    opening_of_redundant,
    row_limits,
    unit_size_rows,
)
from jaxdyn.constraints.selection import hide_unclear, max_rounding, select_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_static, check_count, check_mapping, check_state, zeros_if_none
from jaxdyn.systems.scene import Scene, as_scene, is_given
from jaxdyn.systems.system import SceneLike, displace, displacement


class Assembly(Outcome):
    """State on the constraints.

    - `q` (nq,), `v` (nv,); largest `residual` (2,) left in |phi| (m or rad) of all rows and |A v - b| of those kept; `result`.
    - `distance` (): largest change of a coordinate from the guess, rad or lengths of the mechanism.
    - `passed_singular` (): whether the path from the guess passed a singular position, so that the branch may have changed.
    - `dropped` (nc,): 1 for redundant rows, dependent but for rounding, and `gaps` (nc,): their residuals, m or rad; `layout`:
      name and place of each constraint's rows.
    - `guesses`: number of starts that were tried; 1 if the given one succeeded.
    """

    q: Float[Array, " nq"]
    v: Float[Array, " nv"]
    residual: Float[Array, "2"]
    result: Any
    distance: Float[Array, ""]
    passed_singular: Bool[Array, ""]
    dropped: Float[Array, " nc"]
    gaps: Float[Array, " nc"]
    layout: tuple[Layout, ...] = eqx.field(static=True)
    guesses: int = eqx.field(static=True, default=1)

    def redundancies(self) -> list[str]:
        """Sentences on the redundant rows of each constraint and their residuals, of a concrete assembly."""
        dropped, gaps = np.asarray(self.dropped), np.asarray(self.gaps)
        lines = []
        for place in self.layout:
            rows = slice(place.start, place.end)
            if count := int(dropped[rows].sum()):
                lines.append(
                    f"dropped {count} redundant row{'s' * (count > 1)} of {place.name!r}, open by up to "
                    f"{float(gaps[rows].max()):.2g} (m or rad)"
                )
        return lines

    def changes_branch(
        self, scene: SceneLike, hold: Mapping[str, Any] | None = None, t: Numbers = 0.0
    ) -> Bool[Array, " n"]:
        """Mask (n,) of the places of a sweep, a batch of assemblies in order, that are on another branch than the one before.

        Between both a combination of the rows then went through zero, or a coordinate jumped by more than a radian or a length
        of the mechanism. The first place is False. `scene`, `t`, and the joints in `hold` are those of the sweep; the values
        of these joints do not matter.

        ```python
        scene, angles = jd.scenes.four_bar(), jnp.linspace(0.0, 1.0, 11)
        sweep = jax.vmap(lambda angle: jd.assemble(scene, jnp.zeros(3), hold={"1": angle}))(angles)
        sweep.changes_branch(scene, {"1": angles})
        ```
        """
        scene = as_scene(scene)
        held = {} if hold is None else {name: _first(value) for name, value in hold.items()}
        whole = add_constraints(scene, [lock_joint(*joint) for joint in held.items()])
        R, inverse = jax.vmap(lambda q: unit_size_rows(whole, q, t))(self.q)
        changes = jax.vmap(partial(changes_branch, scene.system))(self.q[:-1], self.q[1:], R[1:], R[:-1], inverse[:-1])
        return jnp.concatenate([jnp.zeros(1, bool), changes])

    def __str__(self) -> str:
        if not is_concrete(self.q) or np.ndim(self.q) > 1:
            return f"Assembly: q {self.q.shape}, v {self.v.shape}"
        words = [
            f"Assembly: {name_of(self.result)}, residual {float(self.residual[0]):.2g} (m or rad) and "
            f"{float(self.residual[1]):.2g} (1/s), {float(self.distance):.3g} from the guess"
        ]
        if bool(self.passed_singular):
            words.append("the path passed a singular position: the branch may differ from that of the guess")
        return "\n  ".join([*words, *self.redundancies()])


def assemble(
    scene: SceneLike,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    hold: Mapping[str, Any] | None = None,
    guesses: int = 16,
    steps: int = 100,
    atol: float | None = None,
    rank_tol: float | None = None,
    throw: bool | None = None,
) -> Assembly:
    r"""Find a state on the constraints from a rough guess, with the least change in the mass metric.

    $$\phi(q, t) = 0, \quad A v = b$$

    q minimises |q - guess| in the metric M(guess) among the configurations on the constraints: a local minimum, on the branch
    that is reached by short steps which reduce all residuals together. Hinges stay within half a turn of the guess, unless they
    are nearer to it beyond, together with the other joints. v is the guess plus the least change in the
    metric M(q). Rows that are redundant but for the digits of a file stay open by these digits; the others are closed to rounding
    (see `Assembly.dropped`).

    **Arguments:**

    - `q` (nq,), `v` (nv,) (None: at rest): the guess. `t`, s.
    - `hold`: values of joints by name, as in `lock_joint`, for the configuration; velocities are not held.
    - `guesses`: number of configurations to start from, for concrete inputs. The first is the given one. The others are
      tried only if it fails: random ones around it (the same in every call), at distances that increase up to pi
      (rad, or lengths of the mechanism).
    - `steps`: maximum number of steps of the path from the guess, each of at most 0.2 rad or lengths of the mechanism.
    - `atol`: m or rad; residuals of positions up to it count as closed. If the rows cannot all be satisfied, q is then the point
      of least squares. By default independent rows must close to rounding.
    - `rank_tol`: rows are independent whose distance from the span of the others is above this part of their length. By default
      those that are independent, here or a finite distance away.
    - `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `Assembly`; without constraints the guess. Derivatives, of any order, with respect to the guess and the scene's
    parameters are those of the minimum, by the implicit function theorem. `result` is `not_nearest` where q satisfies the
    constraints and the search for the minimum did not converge. Derivatives are NaN where it is not `successful`.

    **Raises:** ValueError that names the open constraints and their residuals, if the assembly fails and `throw`; for joints in
    `hold` that do not exist, and for less than one guess.

    ```python
    state = jd.assemble(jd.scenes.four_bar(), jnp.zeros(3), hold={"1": 0.5})
    ```
    """
    scene, rank_tol = as_scene(scene), check_tolerance(rank_tol)
    check_search(steps, guesses, atol)
    hold = check_mapping(hold, "hold", '{"1": 0.5}')
    v = zeros_if_none(v, scene.nv)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    locked = add_constraints(scene, [lock_joint(*joint) for joint in hold.items()])
    if not layout(locked):  # raises for joints that do not exist
        none, zero = jnp.zeros(0, q.dtype), jnp.zeros((), q.dtype)
        rest = RESULTS.successful, zero, jnp.asarray(False), none, none, ()
        return Assembly(q, jnp.asarray(v), jnp.zeros(2, q.dtype), *rest)
    atol = None if atol is None else float(atol)

    def from_guess(q):
        return _assemble(locked, q, v, t, rank_tol, atol, steps, scene if hold else None)

    assembly = from_guess(q)
    # Only concrete inputs allow more guesses, which need to know whether the first guess has failed.
    # One on the constraints that is not the nearest is closer to the guess than those, and the digits are the same elsewhere.
    if is_concrete(assembly.result) and name_of(assembly.result) == "not_assembled":
        assembly = _from_elsewhere(assembly, guesses, from_guess, locked, q)

    def message(assembly: Assembly) -> str:
        if name_of(assembly.result) == "unclear_rank":
            return (
                f"assembled with residuals {np.asarray(assembly.residual)}, but the rank of the constraints is not clear: rows "
                f"that are independent of the others differ by less than a factor of {MIN_GAP:g} from rows that repeat them; "
                "give numbers with more digits, a rank_tol between them, or throw=False"
            )
        if name_of(assembly.result) == "not_nearest":
            return (
                f"assembled with residuals {np.asarray(assembly.residual)}, but the search for the configuration nearest to the "
                "guess did not converge; give a better guess, or throw=False"
            )
        fixed, time = stop_gradient((locked, t))
        left = open_constraints(fixed, assembly.q, assembly.v, time, closing_tolerance(q.dtype))
        tried = f" (nor are they from {guesses - 1} configurations around it)" if guesses > 1 else ""
        return f"not assembled: {left}{tried}; give a better guess"

    return require_success(assembly, throw, message)


def _first(values) -> Any:
    """The first of several values of a joint, or the only one."""
    return values if np.ndim(values) == 0 else values[0]


def check_search(steps: object, guesses: object, atol: object) -> None:
    """Check the extent of a search for a configuration, and its tolerance. **Raises:** ValueError."""
    check_count(steps, "steps")
    check_count(guesses, "guesses")
    if atol is not None:
        as_static(atol, "atol", 0, np.inf, "a length (m) or an angle (rad) that is not negative, or None")


def closing_tolerance(dtype) -> float:
    """Part of the mechanism's length that counts as rounding of a converged residual."""
    return float(jnp.finfo(dtype).eps) ** CLOSED


def _from_elsewhere(assembly: Assembly, guesses: int, from_guess: Callable, scene: Scene, q) -> Assembly:
    """The first successful assembly from configurations around q, or else the given one."""
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    chance = np.random.default_rng(0)
    for tried in range(1, guesses):
        far = np.pi * tried / (guesses - 1)
        step = jnp.asarray(chance.uniform(-far, far, scene.nv), q.dtype) * sizes
        other = from_guess(displace(scene.system, q, step))
        if bool(other.success):
            return eqx.tree_at(  # its distance is that from the user's guess
                lambda found: found.distance,
                dataclasses.replace(other, guesses=tried + 1),
                jnp.max(jnp.abs(displacement(scene.system, q, other.q)) / sizes),
            )
    return assembly


def _assemble(locked, q, v, t, rank_tol, atol, steps, scene):
    """Assemble the scene `locked`; velocities satisfy the constraints of `scene`, or of `locked` if it is None."""
    bare = locked.without_forces
    start, passed, selection = _select_near(bare, q, t, rank_tol, steps)
    if scene is not None:
        scene = scene.without_forces
        # A tree has no rows: its velocities are free, whatever is held.
        scene = keep_rows(scene, select_rows(scene, start, t, rank_tol)) if scene.constraints else scene
    return _close(bare, q, start, passed, selection, v, t, rank_tol, atol, scene)


def _select_near(bare: Scene, guess, t, rank_tol, steps: int) -> tuple[Any, Any, Any]:
    """End of the path from a guess, whether it passed a singular position, and `select_rows` there; None for all rows."""
    start, passed = _follow_path(bare, guess, t, rank_tol, steps)
    selection: Any = select_rows(bare, start, t, rank_tol)
    if is_concrete(selection) and np.all(selection.kept):
        return start, passed, None
    if bare.rounding and rank_tol is None:
        # The path ends where all rows are least open; the kept ones are closed from there. On them the choice is asked again: off
        # the constraints rows that repeat others are independent.
        start = _close_kept_rows(bare, selection, start, t)
        again = select_rows(bare, start, t)
        is_clear = again.gap >= MIN_GAP
        selection = jax.tree.map(lambda x, y: jnp.where(is_clear, x, y), again, selection)._replace(gap=again.gap)
    return start, passed, selection


def independent_rows_near(scene: Scene, guess, t) -> Scene:
    """`independent_rows` where the path from a guess meets the constraints: off them all rows are independent."""
    if not (scene.rounding and scene.constraints):
        return scene
    selection = _select_near(scene.without_forces, guess, t, None, 100)[2]
    return scene if selection is None else keep_rows(scene, hide_unclear(selection))


@entry_point
def _follow_path(scene, q, t, rank_tol, steps):
    if not holonomic_rows(layout(scene)).size:
        return q, jnp.asarray(False)
    scene, q, t = stop_gradient((scene, q, t))
    return follow_path(scene, q, t, tolerance(rank_tol, q) if rank_tol is not None else clear_pivot(q), steps)


@entry_point
def _close_kept_rows(bare: Scene, selection, start, t):
    """A configuration from which the kept rows have been closed; a constant."""
    bare, selection, start, t = stop_gradient((bare, selection, start, t))
    return polish(_drop_rows(bare, selection, start.dtype), start, t, None)


def _drop_rows(bare: Scene, selection, dtype) -> Scene:
    """`keep_rows`, with all rows where those to drop contradict the others: the result is then the point of least squares."""
    kept = jnp.where(selection.rounding <= max_rounding(dtype), selection.kept, jnp.ones_like(selection.kept))
    return keep_rows(bare, selection._replace(kept=kept))


@entry_point
def _close(bare, guess, start, passed, selection, v, t, rank_tol, atol, scene):
    """The assembly from the end of a path, which starts at the guess; `scene`: see `_assemble`."""
    whole, locked, is_clear = bare, bare, jnp.asarray(True)
    kept = jnp.ones(sum(place.end - place.start for place in layout(bare)), guess.dtype)
    if selection is not None:
        locked, is_clear = _drop_rows(bare, selection, guess.dtype), jnp.asarray(selection.gap >= MIN_GAP)
        kept = locked.kept_rows.kept
    q, is_nearest = guess, jnp.asarray(True)
    if holonomic_rows(layout(locked)).size:
        q, nearest = nearest_configuration(locked, guess, start, t, rank_tol)
        is_nearest = nearest > 0
    if scene is None:
        scene = locked
    v0 = v
    slips = admissible = jnp.zeros(0, q.dtype)
    if scene.constraints:
        v = _with_velocity(scene, q, v, t, rank_tol)
        slips = velocity_residual(scene, q, v, t)
        admissible = row_limits(scene, q, v, t, closing_tolerance(q.dtype))[1]
    limits = row_limits(locked, q, jnp.zeros_like(v), t, closing_tolerance(q.dtype))[0]
    phi = position_residual(locked, q, t)
    is_closed = jnp.all(jnp.abs(phi) <= limits)
    if selection is not None:
        is_closed &= opening_of_redundant(locked, q, t) <= max_rounding(q.dtype)
    is_admissible = jnp.all(jnp.abs(slips) <= admissible)
    residual = _sizes(position_residual(whole, q, t), slips)
    good = (is_closed if atol is None else is_closed | (residual[0] <= atol)) & is_admissible
    sizes, _ = coordinate_sizes(whole.system, q.dtype)
    distances = jnp.abs(displacement(whole.system, lax.stop_gradient(guess), lax.stop_gradient(q))) / sizes
    places = layout(whole)
    # The conditions of the minimum hold on the constraints alone: a point of least squares has no derivatives either.
    q, v = invalidate_derivatives((q, v), ~(good & is_nearest), (bare, guess, v0, t))
    gaps = jnp.abs(position_residual(bare, q, t)) * (1 - kept)[holonomic_rows(places)]
    return Assembly(
        q,
        v,
        residual,
        first_of(
            [
                (~good, RESULTS.not_assembled),
                (~is_clear, RESULTS.unclear_rank),
                (is_closed & ~is_nearest, RESULTS.not_nearest),
            ],
            RESULTS.successful,
        ),
        jnp.max(distances, initial=0.0),
        passed,
        1 - kept,
        lax.stop_gradient(jnp.zeros_like(kept).at[holonomic_rows(places)].set(gaps)),
        places,
    )


def _with_velocity(scene, q, v, t, rank_tol):
    """v with A v = b by the least change."""
    # Twice, so that the rounding of the first correction of a large v is corrected too.
    B = correction(scene, q, t, rank_tol, holonomic=False)
    for _ in range(2):
        v = v - matmul(B, velocity_residual(scene, q, v, t))
    return v


def residuals(scene: Scene, q, v, t=0.0) -> Float[Array, "2"]:
    """Largest |phi| (m or rad) and |A v - b| (m/s or rad/s) of the state q (nq,), v (nv,) at t (s): (2,)."""
    return kernel(_largest_residuals)(scene.without_forces, q, v, jnp.asarray(t, q.dtype))


def _largest_residuals(scene: Scene, q, v, t):
    return _sizes(position_residual(scene, q, t), velocity_residual(scene, q, v, t))


def _sizes(*parts):
    """Largest entry of each array, zero of empty ones."""
    return jnp.stack([jnp.max(jnp.abs(part), initial=0.0) for part in parts])


def open_constraints(scene: Scene, q, v, t: Numbers = 0.0, relative: float = 0.0) -> str:
    """Sentence on the constraints violated by more than `row_limits`, the worst first; for concrete states."""
    t = jnp.asarray(t, q.dtype)
    phi, psi, *limits = (np.asarray(x) for x in _residuals_and_limits(scene, q, v, t, relative))
    residuals, first = [], 0
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        count = place.nonholonomic - place.start
        kind = type(constraint).__name__.lower()
        for values, maximum, rows, words in (
            (phi, limits[0], slice(first, first + count), "open by"),
            (psi, limits[1], slice(place.start, place.end), "slips at"),
        ):
            if not np.all(np.abs(values[rows]) <= maximum[rows]):  # NaN is open
                size = float(np.max(np.abs(values[rows])))
                residuals.append((size, f"{kind} {place.name!r} {words} {size:.3g}"))
        first += count
    # Sorted by the printed digits: equal ones stay in the scene's order on every machine, whatever their rounding errors.
    residuals.sort(key=lambda entry: np.nan_to_num(-float(f"{entry[0]:.3g}"), nan=-np.inf))
    return ", ".join(text for _, text in residuals[:6])


@eqx.filter_jit
def _residuals_and_limits(scene, q, v, t, relative):
    limits = row_limits(scene, q, v, t, relative)
    return position_residual(scene, q, t), velocity_residual(scene, q, v, t), *limits


@once
def start_openness(scene: Scene, *, relative: float) -> Evaluation:
    """`largest_ratio` of a known scene, at (q, v, t)."""
    bare = scene.without_forces
    # By the kernel that the program of a run uses too, so that it is compiled once.
    return Evaluation(largest_ratio, bare, (relative,), is_input=is_given(bare))


def largest_residuals(scene: Scene, q, v, t) -> np.ndarray:
    """Largest residuals (2,), of positions and velocities, at a concrete state."""
    return evaluate(_largest_residuals, scene.without_forces, q, v, t)
