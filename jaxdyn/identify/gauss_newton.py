"""Damped Gauss-Newton steps for a sum of squared errors that come in pieces, each with a start of its own.

What is searched are y (p,) and, where the starts are free too, one vector for each piece. A piece's errors depend on y and on
its own start alone, so that the starts are eliminated piece by piece and a step costs what it costs for y.

Source: Marquardt (1963), damping; Bock (1983), elimination of the starts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.identify.regression import truncated

# Damping of the first step, and its bounds, in shares of the largest curvature.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-12, 1e6
# Directions with less than this share of the largest effect count as not determined.
_RANK_TOLERANCE = 1e-6


class Unknowns(eqx.Module):
    """What is searched: y, and corrections of the initial states of the pieces in units of their scale, or None."""

    y: Float[Array, " p"]
    start: Float[Array, "pieces 2 nv"] | None


class Linear(NamedTuple):
    """The errors near a point, at the starts that fit best: errors + rows dy, at dstart = -(offset + gain dy).

    `errors` (n,); `rows` (n, p); `offset` (pieces, 2 nv) and `gain` (pieces, 2 nv, p) where the starts are free.
    """

    loss: float
    errors: np.ndarray
    rows: np.ndarray
    offset: Any = None
    gain: Any = None
    by_starts: float = 0.0  # what the starts alone would take from the loss

    @property
    def finite(self) -> bool:
        """Whether a step can be computed from here."""
        return bool(np.isfinite(self.loss) and np.isfinite(self.rows).all())

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """dy (p,), and by how much the loss should fall; `damping` in shares of the largest curvature."""
        hessian, gradient = self.rows.T @ self.rows, self.rows.T @ self.errors
        size = damping * max(float(np.diag(hessian).max()), 1e-300)
        dy = -np.linalg.solve(hessian + size * np.eye(len(hessian)), gradient)
        return dy, self.by_starts + float(dy @ (size * dy - gradient))

    def moved(self, unknowns: Unknowns, dy: np.ndarray) -> Unknowns:
        """The unknowns after a step."""
        dtype, start = unknowns.y.dtype, unknowns.start
        if start is not None:
            change = jnp.asarray(self.offset + self.gain @ dy, dtype)
            start = start - change.reshape(start.shape)
        return Unknowns(unknowns.y + jnp.asarray(dy, dtype), start)


def linear(errors, by_y, by_start) -> Linear:
    """From the errors (pieces, n), and their slopes by y (pieces, n, p) and by the starts (pieces, n, 2 nv), or None.

    The loss is infinite where squares of the slopes are: no step could be computed from there.
    """
    errors, by_y = np.asarray(errors, np.float64), np.asarray(by_y, np.float64)
    p, largest = by_y.shape[-1], max(float(np.abs(x).max(initial=0)) for x in (errors, by_y))
    if not largest < 1e150:
        return Linear(np.inf, errors.reshape(-1), by_y.reshape(-1, p))
    loss = float(np.sum(errors**2))
    if by_start is None:
        return Linear(loss, errors.reshape(-1), by_y.reshape(-1, p))
    basis, triangular = np.linalg.qr(np.asarray(by_start, np.float64))
    turned = np.swapaxes(basis, 1, 2)
    shares, own = turned @ by_y, turned @ errors[..., None]
    rest, rows = errors - (basis @ own)[..., 0], by_y - basis @ shares
    offset, gain = np.linalg.solve(triangular, own)[..., 0], np.linalg.solve(triangular, shares)
    return Linear(loss, rest.reshape(-1), rows.reshape(-1, p), offset, gain, float(np.sum(own**2)))


def gauss_newton(
    linearise: Callable[[Unknowns], Linear], unknowns: Unknowns, *, steps: int, tolerance: float, callback: Callable
) -> tuple[Unknowns, Linear, np.ndarray, str]:
    """Minimise the sum of squared errors from `unknowns`.

    A step is damped the more, the more often steps in a row failed to lower the loss; where it is not finite, too.

    **Arguments:** `steps`, the most steps; `tolerance`: it has converged when the next step promises to lower the loss by
    less than this share of it; `callback(step, loss, unknowns)` is called at every point, the start included.

    **Returns:** the unknowns; the errors near them; the loss at every point (steps + 1,); "converged", "max_steps", or
    "not_finite" where the start is.

    **Raises:** ValueError for numbers that are not positive.
    """
    if not (steps > 0 and tolerance >= 0):
        raise ValueError(f"steps={steps}, tolerance={tolerance}; steps must be positive and tolerance not negative")
    rounding = float(jnp.finfo(unknowns.y.dtype).eps)
    here, history, damping = linearise(unknowns), [], _DAMPING
    while True:
        history.append(here.loss)
        callback(len(history) - 1, here.loss, unknowns)
        if not here.finite:
            return unknowns, here, np.array(history), "not_finite"
        if here.loss <= (10 * rounding) ** 2:
            return unknowns, here, np.array(history), "converged"
        if len(history) > steps:
            return unknowns, here, np.array(history), "max_steps"
        while True:
            dy, fall = here.step(damping)
            if damping > _MOST_DAMPING or fall <= max(tolerance, 1e3 * rounding) * here.loss:
                return unknowns, here, np.array(history), "converged"
            trial = here.moved(unknowns, dy)
            there = linearise(trial)
            if there.finite and there.loss < here.loss:
                break
            damping *= 10
        unknowns, here, damping = trial, there, max(damping / 10, _LEAST_DAMPING)


def standard_deviation(end: Linear) -> np.ndarray:
    """Standard deviations of y (p,) for independent errors of one size; infinite where they do not determine it.

    NaN when the errors are not finite, or no more than the unknowns.
    """
    if not end.finite:
        return np.full(end.rows.shape[-1], np.nan)
    fit = truncated(end.rows, end.errors, _RANK_TOLERANCE)
    spare = end.errors.size - fit.rank - (0 if end.offset is None else end.offset.size)
    sigma = np.sqrt(end.loss / spare) if spare > 0 else np.nan
    return np.where(fit.unknown, np.inf, sigma * np.sqrt(np.sum(fit.half**2, axis=1)))
