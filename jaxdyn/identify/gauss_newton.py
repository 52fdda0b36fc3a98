"""Damped Gauss-Newton steps for a sum of squared errors of log segments, each with an initial state of its own.

The unknowns are y (p,) and, where initial states are free too, one vector for each segment. The errors of a segment depend on y
and on its own initial state alone. Initial states are therefore eliminated segment by segment, and a step costs what it costs
for y.

Source: Marquardt (1963), damping; Bock (1983), elimination of the initial states.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.descent import Iterate, Method

# Damping of the first step, and its bounds, in shares of the largest curvature.
DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-12, 1e6
# Directions with less than this share of the largest effect count as not determined.
RANK_TOLERANCE = 1e-6


class Unknowns(eqx.Module):
    """Unknowns of a fit: y, and corrections of the initial states of the segments in units of their scale, or None."""

    y: Float[Array, " p"]
    start: Float[Array, "segments 2 nv"] | None


class LinearErrors(NamedTuple):
    """Errors near a point, at the best initial states: errors + rows dy, at dstart = -(offset + gain dy).

    `errors` (n,); `rows` (n, p); `offset` (segments, 2 nv) and `gain` (segments, 2 nv, p) where initial states are free.
    """

    loss: float
    errors: np.ndarray
    rows: np.ndarray
    offset: Any = None
    gain: Any = None
    start_decrease: float = 0.0  # decrease of the loss by the best initial states alone
    priors: int = 0  # number of the errors, the last ones, that are those of the prior
    prior_weight: float = 1.0
    start_rank: int = 0  # number of directions of the initial states that have an effect

    @property
    def is_finite(self) -> bool:
        """True where a step can be computed from here."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.rows).all())

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Step dy (p,) and the decrease of the loss that it predicts; `damping` in shares of the largest curvature."""
        hessian, gradient = self.rows.T @ self.rows, self.rows.T @ self.errors
        # The floor keeps a Hessian of zeros solvable; its step is zero, and the fit ends.
        size = damping * max(float(np.diag(hessian).max()), 1e-300)
        dy = -np.linalg.solve(hessian + size * np.eye(len(hessian)), gradient)
        # With H dy = -g - size dy the predicted decrease -2 g dy - dy H dy becomes dy (size dy - g), without cancellation.
        return dy, self.start_decrease + float(dy @ (size * dy - gradient))

    def update(self, estimate: Unknowns, dy: np.ndarray) -> Unknowns:
        """Unknowns after a step."""
        dtype, start = estimate.y.dtype, estimate.start
        if start is not None:
            change = jnp.asarray(self.offset + self.gain @ dy, dtype)
            start = start - change.reshape(start.shape)
        return Unknowns(estimate.y + jnp.asarray(dy, dtype), start)


def eliminate_starts(errors, by_y, by_start) -> LinearErrors:
    """Linear errors of (segments, n), with Jacobians by y (segments, n, p) and by initial states (segments, n, 2 nv), or None.

    The loss is infinite where squares of the Jacobians are: no step could be computed from there.
    """
    errors, by_y = np.asarray(errors, np.float64), np.asarray(by_y, np.float64)
    p, largest = by_y.shape[-1], max(float(np.abs(x).max(initial=0)) for x in (errors, by_y))
    # Squares of larger numbers overflow float64.
    if not largest < 1e150:
        return LinearErrors(np.inf, errors.reshape(-1), by_y.reshape(-1, p))
    loss = float(np.sum(errors**2))
    if by_start is None:
        return LinearErrors(loss, errors.reshape(-1), by_y.reshape(-1, p))
    # Initial states of mechanisms are projected onto the constraints: not all of their directions have an effect.
    U, s, Vt = np.linalg.svd(np.asarray(by_start, np.float64), full_matrices=False)
    has_effect = s > RANK_TOLERANCE * s.max(axis=1, keepdims=True, initial=0.0)
    basis, inverse = U * has_effect[:, None], np.swapaxes(Vt, 1, 2) / np.where(has_effect, s, np.inf)[:, None]
    # Columns of the basis are orthonormal or zero, so that projecting onto their complement needs no inverse.
    transpose = np.swapaxes(basis, 1, 2)
    shares, own = transpose @ by_y, transpose @ errors[..., None]
    rest, rows = errors - (basis @ own)[..., 0], by_y - basis @ shares
    offset, gain = (inverse @ own)[..., 0], inverse @ shares
    decrease = float(np.sum(own**2))
    return LinearErrors(
        loss, rest.reshape(-1), rows.reshape(-1, p), offset, gain, decrease, start_rank=int(has_effect.sum())
    )


def with_prior(data: LinearErrors, residual, rows, weight: float) -> LinearErrors:
    """Errors of the data followed by those of the prior, whose squares count `weight` times."""
    residual, rows = (weight**0.5 * np.asarray(x, np.float64) for x in (residual, rows))
    return data._replace(
        loss=data.loss + float(residual @ residual),
        errors=np.concatenate([data.errors, residual]),
        rows=np.concatenate([data.rows, rows]),
        priors=len(residual),
        prior_weight=weight,
    )


class GaussNewton(Method):
    """Gauss-Newton steps with Marquardt's damping, which grows tenfold with every trial that fails to lower the loss.

    **Arguments:** `linearise`, from unknowns to `LinearErrors`; `tolerance`: it has converged when the next step predicts a
    decrease of the loss by less than this share of it; `rounding` of the unknowns.

    The state of an iterate is its linear errors and the damping.
    """

    def __init__(self, linearise: Callable[[Unknowns], LinearErrors], tolerance: float, rounding: float):
        if not tolerance >= 0:
            raise ValueError(f"tolerance is {tolerance}; it must not be negative")
        # A predicted decrease below rounding of the loss cannot be observed: every trial would count as failed.
        self.linearise, self.tolerance = linearise, max(tolerance, 1e3 * rounding)
        # Errors are in units of their scale, so that their rounding appears squared in the loss.
        self.floor = (10 * rounding) ** 2

    def init(self, start, kept):
        """Linearise the start."""
        # The damping is the only state besides the point; the rest is evaluated again, to the same bits.
        return self._iterate(start, self.linearise(start), DAMPING if kept is None else float(kept["damping"]))

    def step(self, iterate, history, best):
        """Increase the damping until a step lowers the loss."""
        here, damping = iterate.state
        while True:
            trial = propose(here, damping, self.tolerance)
            if trial is None:
                return iterate, "converged"
            point = here.update(iterate.point, trial)
            there = self.linearise(point)
            # A trial that is not finite is one that failed, not an end: a shorter step may be finite.
            if there.is_finite and there.loss < here.loss:
                return self._iterate(point, there, max(damping / 10, _LEAST_DAMPING)), None
            damping *= 10

    def arrays(self, iterate):
        """Damping."""
        return {"damping": np.float64(iterate.state[1])}

    @staticmethod
    def _iterate(point: Unknowns, here: LinearErrors, damping: float) -> Iterate:
        return Iterate(point, here.loss, (here, damping), here.is_finite)


def propose(here: LinearErrors, damping: float, tolerance: float) -> np.ndarray | None:
    """Step dy (p,) at a damping; None where it predicts no decrease beyond `tolerance`, or the damping has no effect left."""
    dy, decrease = here.step(damping)
    return None if damping > _MOST_DAMPING or decrease <= tolerance * here.loss else dy
