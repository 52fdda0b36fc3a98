"""Inverse kinematics along a path: each configuration from the one before, with a test that the branch was kept.

The rows R of constraints and targets, weighted and in coordinates scaled by the sizes of joints, have singular values that
count the distance from a singular position. Where a combination of rows goes through zero between two configurations, the
determinant of R' R^+ + (1 - R R^+) changes its sign: the branch is another one after that.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.constraints.branches import changes_branch, unit_rows
from jaxdyn.constraints.codes import Outcome, require_success
from jaxdyn.constraints.rank import condition_number, rank_of
from jaxdyn.constraints.selection import independent_rows
from jaxdyn.control.inverse_kinematics import inverse_kinematics, row_weights
from jaxdyn.control.targets import TASKS, as_targets
from jaxdyn.model.arguments import Checked, Numbers, check_state
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike


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
    rows = _rows(targets)
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
        whole = Scene(scene.system, (*counted.constraints, *as_targets(scene.system, at(row))))
        return reached, unit_rows(whole, lax.stop_gradient(reached.q), t, factors)

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


def _rows(targets: Mapping[str, Any]) -> dict[str, dict]:
    """Targets as dictionaries; a target that is an array stands under an empty name."""
    return {name: dict(value) if isinstance(value, Mapping) else {"": value} for name, value in targets.items()}


def _regularity(R, inverse, rank):
    """r / (|R| |R^+|) in Frobenius' norm, and 0 where the rank r is less than `rank`."""
    size = condition_number(R, inverse)
    # By the inequality of Cauchy and Schwarz |R| |R^+| >= r. The minimum removes rounding above 1.
    regular = jnp.minimum(rank / jnp.where(size > 0, size, jnp.ones_like(size)), 1.0)
    # R^+ omits singular values below the tolerance: a drop of rank does not make |R^+| large and needs a test of its own.
    return jnp.where(rank_of(R, inverse) >= rank, regular, jnp.zeros_like(regular))
