"""Choice among many starts of a fit, improved in one batch here or on workers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.identify.gauss_newton import DAMPING, Unknowns, propose
from jaxdyn.identify.problem import Problem, linearise_batch
from jaxdyn.tasks import DaskClient, count_workers, map_tasks

# Rough: the best start is fitted to the end afterwards, so that only the order of the losses matters here.
_STEPS, _TOLERANCE = 20, 1e-4


def best_start(
    problem: Problem, unknowns: Unknowns, starts: int, spread: float, seed: int, client: DaskClient | None = None
) -> Unknowns:
    """Best of several points after some damped Gauss-Newton steps from each, evaluated in one `jax.vmap` on each worker.

    The first start is the given one; the coordinates of the others are normal with deviation `spread`.

    **Raises:** ValueError for a spread that is not positive, and where no start has finite errors.
    """
    if not spread > 0:
        raise ValueError(f"spread is {spread}; give a positive number, the deviation of the starts' coordinates")
    y = unknowns.y
    far = spread * jax.random.normal(jax.random.key(seed), (starts, y.size), y.dtype)
    # With the given start among them, and steps that only lower losses, the choice is never worse than that start.
    points = y[None] + far.at[0].set(0.0)
    blocks = np.array_split(np.asarray(points), min(starts, count_workers(client)))
    results = map_tasks(_Improvement(problem, unknowns), blocks, client)
    candidates = [estimate for estimates, _ in results for estimate in estimates]
    losses = np.concatenate([np.asarray(losses) for _, losses in results])
    # np.argmin would take a NaN for the smallest.
    losses = np.where(np.isfinite(losses), losses, np.inf)
    if not np.isfinite(losses).any():
        raise ValueError(
            f"none of {starts} starts has finite errors; give a smaller spread (now {spread}), or a shorter horizon"
        )
    return jax.tree.map(jnp.asarray, candidates[int(np.argmin(losses))])


class _Improvement(NamedTuple):
    """Map from points (n, p) to the improved unknowns of each and their losses."""

    problem: Problem
    unknowns: Unknowns

    def __call__(self, points: np.ndarray) -> tuple[list[Unknowns], list[float]]:
        # Normal equations are solved on the host: batches of LAPACK calls within XLA can wait for each other for ever.
        estimates = [Unknowns(jnp.asarray(y), self.unknowns.start) for y in points]
        here = linearise_batch(self.problem, estimates)
        damping = np.full(len(points), DAMPING)
        for _ in range(_STEPS):
            trials, proposed = list(estimates), []
            for k, errors in enumerate(here):
                dy = propose(errors, damping[k], _TOLERANCE) if errors.is_finite else None
                if dy is not None:
                    trials[k] = errors.update(estimates[k], dy)
                    proposed.append(k)
            if not proposed:
                break
            # All points are evaluated, so that one program of one size serves every step.
            there = linearise_batch(self.problem, trials)
            for k in proposed:
                if there[k].is_finite and there[k].loss < here[k].loss:
                    estimates[k], here[k] = trials[k], there[k]
                    damping[k] /= 10
                else:
                    damping[k] *= 10
        return estimates, [errors.loss for errors in here]
