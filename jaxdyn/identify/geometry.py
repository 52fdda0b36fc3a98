"""Calibration of a mechanism's geometry by poses or marker positions measured at its tip, and the choice of such poses."""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import entry_point
from jaxdyn.constraints.codes import RESULTS, Outcome, name_of
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.identify.geometry_errors import (
    PARTS,
    RANK,
    Measurements,
    Mechanism,
    change_scene,
    check_configurations,
    check_markers,
    check_measurements,
    close_loops,
    free_directions,
    linearise,
    make_mechanism,
    nearest_motion,
    null_coordinates,
    redundant_directions,
    solve_loops,
)
from jaxdyn.lie import se3, so3
from jaxdyn.model.arguments import Checked, Numbers, as_array, check_count, check_known, check_seed
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import SceneLike

# Most Gauss-Newton steps, halvings of a step, and rounds of weights of positions against rotations.
_STEPS, _HALVINGS, _ROUNDS = 60, 30, 5
# A step that changes no number by more than this (rad, shares of the arm's size) ends a fit; least deviation of errors.
_SETTLED, _FLOOR = 1e-11, 1e-14
# Largest ratio of the weights of positions and rotations, on the lever of the arm's size. Derivatives are exact to about 1e-13,
# so that directions which the heavier kind does not see keep five digits; the lost efficiency, the inverse square, is 1e-10.
_RATIO = 1e5
# Largest noise of positions over the arm's size, and of rotations (rad), that is not doubted.
_DOUBTFUL = 0.05


class GeometryFit(Outcome):
    """Result of `fit_geometry`.

    - `model`: calibrated, with new home poses; `scene`: the same with its loops. `base` (4, 4): pose of the model's world in the
      frame of the measuring device; `tool` (4, 4): pose of the measured frame in `frame`. `predict(q)` combines them.
    - `names`, `values`, `std` (w,): changes of the free numbers (rad, m), the smallest that explain the measurements, and their
      standard deviations; `covariance` (w, w). What may be attributed to the base or to other parts is the base's, whose values
      are its position and rotation vector in the device's frame. The prediction at the tip has no such choice: `tip_std`.
    - `rank`: number of directions that these poses determine to better than 1 rad or the arm's size; `expected`: that any poses
      can, by theory, None with loops.
      `redundant` (w, d): combinations of the numbers that these poses do not determine, orthonormal in units of the arm's size,
      and with twists of the base in its own axes.
    - `condition`: of the errors in the directions that are determined, rotations times the arm's size.
    - `noise`: standard deviations of a measured position (m) and rotation (rad; NaN for markers). `tip_std` (m): root mean
      square deviation of the calibrated tip, over the measured poses.
    - `q` (n, nq): configurations, with the joints that the loops determine. `errors` (n, k): m and rad.
    - `history`: losses. `result`: one of `jd.RESULTS`: `successful`, `max_steps_reached`, or `nonfinite`.
    """

    model: Model
    scene: Scene
    frame: str = eqx.field(static=True)
    measured: tuple[str, ...] | None = eqx.field(static=True)
    base: np.ndarray
    tool: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    values: np.ndarray
    std: np.ndarray
    covariance: np.ndarray
    rank: int
    expected: int | None
    redundant: np.ndarray
    condition: float
    noise: tuple[float, float]
    tip_std: float
    q: np.ndarray
    errors: np.ndarray
    history: np.ndarray
    result: Any

    def predict(self, q: Numbers) -> np.ndarray:
        """Poses (n, 4, 4) of the measured frame in the device's frame at configurations (n, nq).

        Joints of loops that were not measured are computed from the others, next to their columns.

        **Raises:** ValueError for other shapes, numbers that are not finite, and loops that cannot be closed.
        """
        mechanism = make_mechanism(self.scene, self.frame, self.measured)
        q = close_loops(mechanism, check_configurations(mechanism, q))
        return self.base @ _frame_poses(self.model, q, self.frame) @ self.tool

    def summary(self) -> str:
        """Text of the result."""
        known = "" if self.expected is None else f" of {self.expected} identifiable"
        rotation = "" if np.isnan(self.noise[1]) else f" and {1e3 * self.noise[1]:.4g} mrad"
        lines = [
            f"geometry of {self.model.name!r}: {name_of(self.result)} after {len(self.history) - 1} steps",
            f"{len(self.q)} poses determine {self.rank}{known} directions of {len(self.names)} numbers, condition "
            f"{self.condition:.4g}",
            f"noise {1e3 * self.noise[0]:.4g} mm{rotation}; standard deviation of the calibrated tip "
            f"{1e3 * self.tip_std:.4g} mm",
        ]
        width = max(map(len, self.names))
        lines.append(f"{'change':{width}}  {'value':>12}  {'std':>12}")
        rows = zip(self.names, self.values, self.std, strict=True)
        return "\n".join([*lines, *(f"{name:{width}}  {value:12.5g}  {std:12.3g}" for name, value, std in rows)])


def fit_geometry(
    system: SceneLike,
    q: Numbers,
    poses: Checked[Numbers | None] = None,
    *,
    frame: str,
    positions: Checked[Numbers | None] = None,
    markers: Checked[Numbers | None] = None,
    free: Sequence[str] = PARTS,
    measured: Checked[Sequence[str] | None] = None,
) -> GeometryFit:
    """Fit joint offsets, axes, link lengths, base and tool to poses or marker positions measured at the tip.

    Least squares by Gauss-Newton steps, which leave out the directions that no pose determines. Positions are weighted against
    rotations by their residuals, iterated.

    **Arguments:**

    - `system`: model, or scene with loops (`jd.loop`), where the fit starts. Its joints have one degree of freedom each.
    - `q` (n, nq): positions of the joints (rad, m) in each pose, as the encoders read them.
    - `poses` (n, 4, 4): of the frame, in the frame of the measuring device. `positions` (n, 3) or (n, k, 3): of markers, m, in
      place of poses. `markers` (k, 3): their places in the frame, m; one at its origin by default.
    - `frame`: name of the frame that is measured.
    - `free`: some of "base", pose of the model's world in the device's frame; "offsets", the zeros of the encoders; "axes", the
      directions of axes; "lengths", the places of axes, and of the frames of loops; "tool", pose of the measured frame.
    - `measured`: names of the joints whose columns of q were measured; the loops determine the others, next to their columns.

    **Returns:** `GeometryFit`.

    **Raises:** ValueError for unknown names, wrong shapes, matrices that are no poses, joints with several degrees of freedom,
    no more measurements than directions to find, and loops that q leaves open at the start.

    **Warns:** UserWarning where the remaining errors are no noise of a device: wrong data, or a local minimum.

    Source: Mooring, Roth & Driels (1991), "Fundamentals of manipulator calibration"; Park & Okamura (1994).

    ```python
    fit = jd.identify.fit_geometry(arm, q, poses, frame="flange")
    ```
    """
    check_known("fit_geometry", system=system, q=q, poses=poses, positions=positions, markers=markers)
    mechanism = make_mechanism(system, frame, measured)
    q = check_configurations(mechanism, q)
    data = check_measurements(len(q), poses, positions, markers)
    names, directions, units = free_directions(mechanism, free)
    expected = None
    if not mechanism.loops:
        unseen = null_coordinates(directions, redundant_directions(mechanism, data.markers if poses is None else None))
        expected = directions.shape[1] - unseen.shape[1]
    rows = data.positions.size if data.poses is None else 6 * len(q)
    if rows <= (wanted := directions.shape[1] if expected is None else expected):
        raise ValueError(
            f"{len(q)} poses give {rows} numbers; {wanted} directions to find and the noise need at least {wanted + 1}: measure "
            "more poses, or free fewer parts"
        )
    q = close_loops(mechanism, q)
    if "base" in free:
        tips = _frame_poses(mechanism.model, q, frame)
        points = np.einsum("nij,kj->nki", tips[:, :3, :3], data.markers) + tips[:, None, :3, 3]
        # The device may stand anywhere: the steps start from the rigid motion that brings the points nearest to each other.
        data = data._replace(base=nearest_motion(points.reshape(-1, 3), data.positions.reshape(-1, 3)))
    minimum = _minimise(mechanism, data, directions, q, names, expected)
    here, noise = minimum.here, minimum.noise
    inverse, _ = here.invert(minimum.weights)
    # Not the inverse of the information: the weights may be bounded, and then are not those of the noise.
    root = inverse * here.rows(noise)
    tip = here.jacobian[:, ~here.turns].reshape(-1, len(units)) @ root
    twists = (directions @ minimum.y).reshape(-1, 6)
    scene, *motions = _apply_twists(mechanism, twists, data.base)
    tool, base, place, place_by_twist = map(np.asarray, motions)
    values = minimum.y * units
    root *= units[:, None]
    if "base" in free:
        # Position and rotation vector instead of the twist from a start that follows the noise; the base's numbers come first.
        values[:6] = place
        root[:6] = place_by_twist @ root[:6]
    if max(noise[0] / mechanism.size, noise[1] * here.turns.any()) > _DOUBTFUL:
        warnings.warn(
            f"the errors that remain, {noise[0]:.3g} m and {noise[1]:.3g} rad, are no noise of a device on an arm of "
            f"{mechanism.size:.3g} m; check units, signs and rows of the measurements, or start nearer to the true geometry",
            stacklevel=2,
        )
    return GeometryFit(
        model=scene.system,
        scene=scene,
        frame=frame,
        measured=None if measured is None else tuple(measured),
        base=base,
        tool=tool,
        names=names,
        values=values,
        std=np.linalg.norm(root, axis=1),
        covariance=root @ root.T,
        rank=here.seen.shape[1],
        expected=expected,
        redundant=here.unseen,
        condition=here.condition,
        noise=(float(noise[0]), float(noise[1]) if here.turns.any() else np.nan),
        # Three coordinates of a point: the sum of their variances, in the mean over all points.
        tip_std=float(np.sqrt(3 * np.mean(np.sum(tip**2, axis=1)))),
        q=here.q,
        errors=here.errors,
        history=np.array(minimum.history),
        result=minimum.result,
    )


@entry_point
def _apply_twists(mechanism: Mechanism, twists, base):
    """Scene, tool and base after the changes; the base's position and rotation vector (6,), and their derivative (6, 6)."""
    moved = base @ se3.exp(twists[0])

    def position_and_turn(twist):
        pose = moved @ se3.exp(twist)
        return jnp.concatenate([pose[:3, 3], so3.log(pose[:3, :3])])

    zero = jnp.zeros_like(twists[0])
    scene = change_scene(mechanism, twists.astype(mechanism.model.home.dtype))
    place, place_by_twist = position_and_turn(zero), jax.jacfwd(position_and_turn)(zero)
    return scene, se3.exp(twists[mechanism.tool]), moved, place, place_by_twist


class _Linear(NamedTuple):
    """Errors (n, k) at configurations `q`, their Jacobian (n, k, w), and which of the k are rotations.

    `seen` (w, r) and `unseen` (w, d): orthonormal directions that the errors determine, and that they do not.
    """

    q: np.ndarray
    errors: np.ndarray
    jacobian: np.ndarray
    turns: np.ndarray
    seen: np.ndarray
    unseen: np.ndarray
    condition: float

    def rows(self, kinds: np.ndarray) -> np.ndarray:
        """Numbers (n k,) of all errors, from those (2,) of positions and of rotations."""
        return np.tile(np.where(self.turns, kinds[1], kinds[0]), len(self.errors))

    def loss(self, weights: np.ndarray) -> float:
        """Sum of the squares of the weighted errors."""
        return float(np.sum((self.rows(weights) * self.errors.reshape(-1)) ** 2))

    def invert(self, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Generalised inverse (w, n k) of the Jacobian, of the least weighted errors, and their leverages (n, k)."""
        weigh = self.rows(weights)
        # In the determined directions alone, so that no ratio of the weights changes the rank.
        U, s, Vt = np.linalg.svd(
            weigh[:, None] * (self.jacobian.reshape(self.errors.size, -1) @ self.seen), full_matrices=False
        )
        return self.seen @ (Vt.T / s) @ (U.T * weigh), np.sum(U**2, axis=1).reshape(self.errors.shape)

    def deviations(self, weights: np.ndarray) -> np.ndarray:
        """Standard deviations (2,) of positions and rotations."""
        weighted = self.errors**2 * self.rows(weights).reshape(self.errors.shape) ** 2
        # Each error has used up its leverage of the degrees of freedom.
        spare = 1 - self.invert(weights)[1]
        sums, spares = (np.array([x[:, kind].sum() for kind in (~self.turns, self.turns)]) for x in (weighted, spare))
        # A kind of error without degrees of freedom says nothing about its noise: both then have one ratio to the weights.
        pooled = sums.sum() / max(spares.sum(), 1e-9)
        return np.sqrt(np.where(spares < 1, pooled, sums / np.maximum(spares, 1))) / weights


class _Minimum(NamedTuple):
    """End of `_minimise`: the free numbers, the errors there, weights and noise (2,), all losses, and the result."""

    y: np.ndarray
    here: _Linear
    weights: np.ndarray
    noise: np.ndarray
    history: list[float]
    result: Any


def _minimise(
    mechanism: Mechanism, data: Measurements, directions: np.ndarray, q: np.ndarray, names, expected
) -> _Minimum:
    """Minimise the squared errors by Gauss-Newton steps, and weigh positions against rotations by what remains of them."""
    turns = np.arange(6) >= 3 if data.poses is not None else np.zeros(data.positions[0].size, bool)
    others = np.array([not name.startswith("base ") for name in names])
    # A lever of the arm's size makes both kinds comparable before their errors are known.
    lever = np.array([1.0, mechanism.size])

    def evaluate(y, q):
        q, errors, jacobian = linearise(mechanism, data, directions, y, q)
        scaled = (jacobian * np.where(turns, lever[1], lever[0])[:, None]).reshape(errors.size, -1)
        _, s, Vt = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
        # Directions whose deviation would be above one (rad, the arm's size) are not determined: nothing is linear so far away.
        noise = min(np.sqrt(np.mean(x**2)) for x in (errors[:, ~turns], lever[1] * errors[:, turns]) if x.size)
        rank = int(np.sum(s > max(RANK * s.max(initial=0.0), noise)))
        # Away from the nominal geometry theory's rank is the same: what is beyond it is rounding.
        rank = rank if expected is None else min(rank, expected)
        seen, unseen = Vt[:rank].T, Vt[rank:].T
        # The device may stand anywhere: of all equal changes the one with the least numbers of other parts than the base.
        seen = seen - unseen @ (np.linalg.pinv(unseen[others], rcond=1e-9) @ seen[others])
        return _Linear(q, errors, jacobian, turns, seen, unseen, float(s[0] / s[rank - 1]) if rank else np.nan)

    y, weights = np.zeros(directions.shape[1]), lever
    here, history = evaluate(y, q), []
    for left in reversed(range(_ROUNDS)):
        history.append(here.loss(weights))
        result = RESULTS.max_steps_reached
        for _ in range(_STEPS):
            if not np.isfinite(history[-1]):
                return _Minimum(y, here, weights, 1 / weights, history, RESULTS.nonfinite)
            step = -here.invert(weights)[0] @ here.errors.reshape(-1)
            trials = (evaluate(y + 0.5**k * step, here.q) for k in range(_HALVINGS))
            k, following = next(((k, x) for k, x in enumerate(trials) if x.loss(weights) < history[-1]), (0, None))
            if following is None:
                # Near a minimum rounding hides the decrease.
                result = RESULTS.successful if np.abs(step).max() < _SETTLED**0.5 else RESULTS.no_descent
                break
            y, here = y + 0.5**k * step, following
            history.append(here.loss(weights))
            if np.abs(step).max() < _SETTLED:
                result = RESULTS.successful
                break
        noise = np.maximum(here.deviations(weights), _FLOOR * mechanism.size / lever)
        if not left or not turns.any():
            break
        shares = noise * lever
        weights = lever / np.maximum(shares, shares.max() / _RATIO)
    return _Minimum(y, here, weights, noise, history, result)


@eqx.filter_jit
def _poses_of(model: Model, q, frame: str):
    return jax.vmap(lambda q: frame_pose(model, q, frame))(q)


def _frame_poses(model: Model, q: np.ndarray, frame: str) -> np.ndarray:
    return np.asarray(_poses_of(model, jnp.asarray(q, model.home.dtype), frame), np.float64)


# Share of the information of all candidates with which a choice of poses starts.
_FAINT = 1e-6
# Random configurations for each pose that is to be chosen, and their span about zero where a joint has no limits (rad, m).
_CANDIDATES, _SPAN = 12, np.pi


def choose_poses(
    system: SceneLike,
    count: int,
    *,
    frame: str,
    markers: Checked[Numbers | None] = None,
    free: Sequence[str] = PARTS,
    measured: Checked[Sequence[str] | None] = None,
    guess: Checked[Numbers | None] = None,
    seed: int = 0,
) -> np.ndarray:
    """Choose configurations (count, nq) whose measured poses determine the geometry well: the determinant of the information.

    Of random configurations within the limits of the joints, each in turn is the one that adds most to the logarithm of the
    determinant (D-optimality); chosen ones are then exchanged for better ones.

    **Arguments:** as of `fit_geometry`, and

    - `count`: number of poses to choose.
    - `markers` (k, 3): their places in the frame, m, if those are measured; None for poses.
    - `guess` (nq,): a configuration with closed loops. `seed`: of the random configurations.

    **Raises:** ValueError as `fit_geometry`, and for fewer poses than determine the directions.

    Source: Borm & Menq (1991), observability; Mitchell (1974), exchange of designs.
    """
    check_known("choose_poses", system=system, guess=guess)
    mechanism = make_mechanism(system, frame, measured)
    count, rng = check_count(count, "count"), np.random.default_rng(check_seed(seed))
    _, directions, _ = free_directions(mechanism, free)
    points = np.zeros((1, 3)) if markers is None else check_markers(markers)
    q = _random_configurations(mechanism, _CANDIDATES * count, guess, rng)
    data = Measurements(
        np.broadcast_to(np.eye(4), (len(q), 4, 4)), np.zeros((len(q), 1, 3)), points, np.eye(4), np.eye(4)
    )
    if markers is not None:
        data = data._replace(poses=None, positions=np.zeros((len(q), len(points), 3)))
    q, errors, jacobian = linearise(mechanism, data, directions, np.zeros(directions.shape[1]), q)
    if markers is None:
        jacobian = jacobian * np.where(np.arange(6) < 3, 1.0, mechanism.size)[:, None]
    # What no candidate determines has no information in any choice.
    _, singular, Vt = np.linalg.svd(jacobian.reshape(-1, jacobian.shape[2]), full_matrices=False)
    rows = jacobian @ Vt[: int(np.sum(singular > RANK * singular[0]))].T
    if count * errors.shape[1] < rows.shape[2]:
        raise ValueError(
            f"count is {count}; {rows.shape[2]} directions need at least {-(-rows.shape[2] // errors.shape[1])}"
        )
    # A little information of all candidates makes the determinant positive before there are enough poses.
    whole = np.einsum("nki,nkj->ij", rows, rows) / len(rows)
    chosen = list(range(count))
    for place in range(2 * count):
        # Two rounds: in each every pose in turn is taken out, and the best one for its place put in.
        place %= count
        rest = [k for i, k in enumerate(chosen) if i != place]
        information = _FAINT * whole + np.einsum("nki,nkj->ij", rows[rest], rows[rest])
        # det(A + J^T J) = det(A) det(1 + J A^-1 J^T).
        half = rows @ np.linalg.inv(np.linalg.cholesky(information)).T
        gains = np.linalg.slogdet(np.eye(rows.shape[1]) + half @ np.swapaxes(half, 1, 2))[1]
        gains[rest] = -np.inf
        chosen[place] = int(np.argmax(gains))
    return q[chosen]


def _random_configurations(mechanism: Mechanism, count: int, guess, rng) -> np.ndarray:
    """Random configurations within limits (count, nq), on the loops where there are any."""
    model = mechanism.model
    start = np.zeros(model.nq) if guess is None else np.asarray(as_array(guess, "guess"), np.float64)
    if start.shape != (model.nq,):
        raise ValueError(f"guess has shape {start.shape}, expected ({model.nq},)")
    lower, upper = (np.asarray(x, np.float64) for x in (model.lower, model.upper))
    lower, upper = (
        np.where(np.isfinite(lower), lower, start - _SPAN),
        np.where(np.isfinite(upper), upper, start + _SPAN),
    )
    if not mechanism.loops:
        return rng.uniform(lower, upper, (count, model.nq))
    found: list[np.ndarray] = []
    # Measured joints walk away from the guess in small steps, so that the loops stay on their branch.
    q = start
    for _ in range(20 * count):
        change = 0.2 * rng.normal(size=model.nq)
        change[list(mechanism.passive)] = 0
        trials, is_closed, _ = solve_loops(
            mechanism, np.zeros((len(mechanism.places), 6)), np.clip(q + change, lower, upper)[None]
        )
        trial = trials[0]
        is_within = np.all((trial >= model.lower) & (trial <= model.upper))
        if is_closed[0] and is_within and np.abs(trial - q).max() < 1.0:
            q = trial
            found.append(q)
        if len(found) == count:
            return np.stack(found)
    raise ValueError(
        f"only {len(found)} configurations with closed loops and within the limits were found near guess; give another one"
    )
