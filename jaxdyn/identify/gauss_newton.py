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

from jaxdyn.identify.progress import Watch
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
    priors: int = 0  # how many of the errors, the last ones, are those of the prior
    prior_weight: float = 1.0
    start_rank: int = 0  # how many directions of the starts have an effect

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

    def moved(self, estimate: Unknowns, dy: np.ndarray) -> Unknowns:
        """The unknowns after a step."""
        dtype, start = estimate.y.dtype, estimate.start
        if start is not None:
            change = jnp.asarray(self.offset + self.gain @ dy, dtype)
            start = start - change.reshape(start.shape)
        return Unknowns(estimate.y + jnp.asarray(dy, dtype), start)


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
    # Starts of mechanisms are put on the constraints: not all of their directions have an effect.
    U, s, Vt = np.linalg.svd(np.asarray(by_start, np.float64), full_matrices=False)
    kept = s > _RANK_TOLERANCE * s.max(axis=1, keepdims=True, initial=0.0)
    basis, inverse = U * kept[:, None], np.swapaxes(Vt, 1, 2) / np.where(kept, s, np.inf)[:, None]
    turned = np.swapaxes(basis, 1, 2)
    shares, own = turned @ by_y, turned @ errors[..., None]
    rest, rows = errors - (basis @ own)[..., 0], by_y - basis @ shares
    offset, gain = (inverse @ own)[..., 0], inverse @ shares
    return Linear(
        loss, rest.reshape(-1), rows.reshape(-1, p), offset, gain, float(np.sum(own**2)), start_rank=int(kept.sum())
    )


def gauss_newton(
    linearise: Callable[[Unknowns], Linear], estimate: Unknowns, *, tolerance: float, watch: Watch
) -> tuple[Unknowns, Linear, np.ndarray, str]:
    """Minimise the sum of squared errors from `estimate`, or from where the watch's checkpoint says.

    A step is damped the more, the more often steps in a row failed to lower the loss; where it is not finite, too.

    **Arguments:** `tolerance`: it has converged when the next step promises to lower the loss by less than this share of it;
    `watch` is told of every point, the start included.

    **Returns:** the unknowns; the errors near them; the loss at every point (steps + 1,); "converged", "max_steps",
    "stopped", or "not_finite" where the start is.

    **Raises:** ValueError for numbers that are not positive.
    """
    if not (watch.steps > 0 and tolerance >= 0):
        raise ValueError(
            f"steps={watch.steps}, tolerance={tolerance}; steps must be positive and tolerance not negative"
        )
    rounding = float(jnp.finfo(estimate.y.dtype).eps)
    history, damping, kept = [], _DAMPING, watch.load()
    if kept is not None:
        estimate = Unknowns(jnp.asarray(kept["y"]), None if estimate.start is None else jnp.asarray(kept["start"]))
        # The point's own loss comes again, with the same bits.
        history, damping = kept["history"][:-1].tolist(), float(kept["damping"])
    here = linearise(estimate)

    def state():
        kept = {"y": estimate.y, "damping": np.float64(damping), "history": np.array(history)}
        return kept if estimate.start is None else kept | {"start": estimate.start}

    while True:
        history.append(here.loss)
        goes_on = watch.goes_on(len(history) - 1, here.loss, estimate, state)
        if not here.finite:
            return estimate, here, np.array(history), "not_finite"
        if here.loss <= (10 * rounding) ** 2:
            return estimate, here, np.array(history), "converged"
        if not goes_on:
            return estimate, here, np.array(history), "stopped"
        if len(history) > watch.steps:
            return estimate, here, np.array(history), "max_steps"
        while True:
            dy, fall = here.step(damping)
            if damping > _MOST_DAMPING or fall <= max(tolerance, 1e3 * rounding) * here.loss:
                return estimate, here, np.array(history), "converged"
            trial = here.moved(estimate, dy)
            there = linearise(trial)
            if there.finite and there.loss < here.loss:
                break
            damping *= 10
        estimate, here, damping = trial, there, max(damping / 10, _LEAST_DAMPING)


def with_prior(data: Linear, residual, rows, weight: float) -> Linear:
    """The errors of the data and, behind them, those of the prior, whose squares count `weight` times."""
    residual, rows = (weight**0.5 * np.asarray(x, np.float64) for x in (residual, rows))
    return data._replace(
        loss=data.loss + float(residual @ residual),
        errors=np.concatenate([data.errors, residual]),
        rows=np.concatenate([data.rows, rows]),
        priors=len(residual),
        prior_weight=weight,
    )


class Determined(NamedTuple):
    """The errors near a minimum in coordinates in which data and prior together have the curvature 1.

    `data` (n, r), `errors` (n,): rows and errors of the data over their deviation; `prior` (k, r): rows of the prior; `numbers`
    (m, r): slopes of numbers; `idle` (m,): which of these neither data nor prior determine.
    """

    data: np.ndarray
    errors: np.ndarray
    prior: np.ndarray
    numbers: np.ndarray
    idle: np.ndarray


def determined(end: Linear, slopes: np.ndarray) -> Determined | None:
    """What numbers with the slopes (m, p) by y are told by; None when the errors are not finite, or no more than the unknowns.

    Errors of the data have one size, which is theirs; those of the prior the size it says.
    """
    if not end.finite:
        return None
    count = len(end.errors) - end.priors
    data = end.rows[:count]
    fit = truncated(data, end.errors[:count], _RANK_TOLERANCE)
    spare = count - end.start_rank - (fit.rank if end.priors == 0 else 0)
    if spare <= 0:
        return None
    noise = (max(float(np.sum(end.errors[:count] ** 2)), 1e-300) / spare) ** 0.5
    # The prior's rows were weighed by a noise that was assumed: here by the one that is seen.
    rows = np.concatenate([data / noise, end.rows[count:] / end.prior_weight**0.5])
    size = np.linalg.norm(rows, axis=0)
    size[size <= 1e-12 * size.max(initial=0.0)] = np.inf
    _, s, Vt = np.linalg.svd(np.linalg.qr(rows / size)[1], full_matrices=True)
    rank = int(np.sum(s > _RANK_TOLERANCE * s.max(initial=0.0)))
    unseen = np.isinf(size)
    scaled = slopes / np.where(unseen, 1.0, size)
    seen = np.where(unseen[None], 0.0, scaled)
    idle = np.linalg.norm(seen @ Vt[rank:].T, axis=1) > 1e-6 * np.linalg.norm(seen, axis=1)
    idle |= np.abs(scaled[:, unseen]).sum(axis=1) > 0
    turned = Vt[:rank].T / s[:rank]
    rows = (rows / size) @ turned
    return Determined(rows[:count], end.errors[:count] / noise, rows[count:], seen @ turned, idle)
