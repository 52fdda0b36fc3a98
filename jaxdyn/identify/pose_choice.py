"""Choice of poses whose measurement determines a mechanism's geometry well."""

from collections.abc import Sequence

import numpy as np

from jaxdyn.identify.geometry_errors import (
    PARTS,
    RANK,
    Measurements,
    Mechanism,
    check_markers,
    free_directions,
    linearise,
    make_mechanism,
    solve_loops,
)
from jaxdyn.model.arguments import Checked, Numbers, as_array
from jaxdyn.model.numbers import check_count, check_seed
from jaxdyn.systems.system import SceneLike

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
