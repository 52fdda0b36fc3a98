"""Interior-point method for the feasible torque fit, on the host.

A fit is some tens of steps with matrices of a few hundred rows, and a search for terms is some thousand steps: in numpy each
takes about a millisecond, and nothing is compiled.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxdyn.identify.chart import Chart, positive_terms
from jaxdyn.identify.regression import free_columns

_EPS = float(np.finfo(np.float64).eps)


class TorqueProblem(NamedTuple):
    """1/2 (|R x - d|^2 + rest) + prior D(x), squares over the variance, in the coordinates of a chart, in float64."""

    chart: Chart
    R: np.ndarray
    d: np.ndarray
    rest: float
    prior: float


class Minimum(NamedTuple):
    """Where `newton` ended: `origin` (bodies, 4, 4) and `s` (terms, nv) of the chart, losses, "converged" or why not."""

    origin: np.ndarray
    s: np.ndarray
    history: np.ndarray
    result: str


class _State(NamedTuple):
    """Bodies P = A A^T relative to the nominal ones with A the `origin`, terms, and the multipliers of both.

    `dual` (bodies, 4, 4): of P being positive definite, in the frame where P is 1; `slack` (n,): of terms >= 0.
    """

    origin: np.ndarray
    terms: np.ndarray
    dual: np.ndarray
    slack: np.ndarray


def _stretches() -> np.ndarray:
    """U + U^T (10, 4, 4) for the derivatives U of `inertia.log_cholesky_factor` at zero."""
    places = [(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    basis = np.zeros((10, 4, 4))
    basis[0] = np.eye(4)
    for k, place in enumerate(places, 1):
        basis[(k, *place)] = 1
    return basis + np.swapaxes(basis, 1, 2)


def _from_pseudo() -> np.ndarray:
    """The linear map (10, 4, 4) of `inertia.parameters_from_pseudo`: m, m c and tr(Sigma) 1 - Sigma of a pseudo-inertia."""
    rows = np.zeros((10, 4, 4))
    rows[0, 3, 3] = 1
    for k in range(3):
        rows[1 + k, k, 3] = 1
    for row, (i, j) in zip(rows[4:], ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)), strict=True):
        if i == j:
            row[np.arange(3), np.arange(3)] = 1
        row[i, j] -= 1
    return rows


# Traces of products of stretches are the curvature of the divergence along straight lines in x: tr(P^-1 dP P^-1 dP).
STRETCHES, _FROM_PSEUDO = _stretches(), _from_pseudo()


class Linear:
    """A chart's map from relative pseudo-inertias A A^T and terms to x, which is linear in both."""

    def __init__(self, chart: Chart):
        self.factors = np.asarray(chart.factors, np.float64)
        self.scale = np.asarray(chart.scale, np.float64)
        self.bodies, self.count = np.array(chart.bodies, int), {"full": 10, "mass": 1, "fixed": 0}[chart.inertia]
        nominal = np.asarray(chart.nominal_inertias, np.float64), np.asarray(chart.nominal_terms, np.float64)
        self.given, (nb, nv) = np.concatenate([x.reshape(-1) for x in nominal]), (len(nominal[0]), nominal[1].shape[1])
        self.places = (10 * self.bodies[:, None] + np.arange(10)).astype(int)
        self.term_places = free_columns(nb, nv, chart.terms)[10 * nb :]
        self.positive = np.broadcast_to(positive_terms(chart.terms), self.scale.shape).reshape(-1)

    def x(self, origin: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """All parameters (p,)."""
        result = self.given.copy()
        upper = self.factors @ origin
        result[self.places] = np.einsum("kij,bij->bk", _FROM_PSEUDO, upper @ np.swapaxes(upper, 1, 2))
        result[self.term_places] = self.scale.reshape(-1) * terms
        return result

    def slopes(self, origin: np.ndarray) -> np.ndarray:
        """Derivatives (bodies, 10, coordinates) of the ten numbers of each body by its own coordinates."""
        upper = (self.factors @ origin)[:, None]
        moved = upper @ STRETCHES[None, : self.count] @ np.swapaxes(upper, 2, 3)
        return np.einsum("cij,bkij->bck", _FROM_PSEUDO, moved)

    def settled(self, s: np.ndarray) -> np.ndarray:
        """s with terms below a millionth of their unit at zero, which fits approach without end."""
        return np.where(self.positive.reshape(s.shape) & (s**2 < 1e-6), 0.0, s)

    def at(self, origin: np.ndarray, s: np.ndarray) -> np.ndarray:
        """All parameters (p,) at s (terms, nv), whose squares the positive terms are."""
        flat = s.reshape(-1)
        return self.x(origin, np.where(self.positive, flat**2, flat))

    def slopes_at(self, origin: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Derivatives (p, n) of all parameters by the coordinates of the bodies, then by s."""
        slopes = self.slopes(origin)
        count = len(slopes) * self.count
        result = np.zeros((len(self.given), count + s.size))
        for i, (places, slope) in enumerate(zip(self.places, slopes, strict=True)):
            result[places, i * self.count : (i + 1) * self.count] = slope
        flat = s.reshape(-1)
        result[self.term_places, count:] = np.diag(self.scale.reshape(-1) * np.where(self.positive, 2 * flat, 1.0))
        return result

    def rows(self, R: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """Derivatives (m, n) of R x by the coordinates of the bodies, then by the terms."""
        inertial = np.matmul(np.swapaxes(R[:, self.places], 0, 1), slopes)
        inertial = np.swapaxes(inertial, 0, 1).reshape(len(R), -1)
        return np.concatenate([inertial, R[:, self.term_places] * self.scale.reshape(-1)], axis=1)


def newton(
    problem: TorqueProblem,
    s: np.ndarray,
    steps: int,
    tolerance: float,
    callback: Callable[[int, float, np.ndarray, np.ndarray], None] | None = None,
    resolution: float = _EPS,
) -> Minimum:
    """Primal-dual interior-point method from the chart's origin and terms s (terms, nv).

    The loss is min |R x - d|^2 / 2 + prior tr(P0^-1 P) with -prior log det P as the barrier that stays. The barrier starts as
    strong as the data, so that bodies are not pushed against the edge of what is feasible, and is released as fast as the
    complementarity of bodies and multipliers allows: down to the prior for the bodies, to nothing for the terms.

    **Arguments:** `tolerance`: how far above the minimum the loss may end; `callback(step, loss, origin, s)` before each step;
    `resolution`: relative size of the smallest change of the loss that means anything.
    """
    linear = Linear(problem.chart)
    history, result, prior = [], "max_steps", problem.prior
    inequalities = int(linear.positive.sum())
    least = 0.1 * tolerance / max(inequalities, 1)
    origin = np.asarray(problem.chart.origin, np.float64)
    flat = np.asarray(s, np.float64).reshape(-1)
    terms = np.where(linear.positive, flat**2, flat)
    gap = max(prior, _loss(problem, linear, origin, terms) / (4 * len(origin) + max(inequalities, 1)))
    slack = np.where(linear.positive, gap / np.maximum(flat**2, 1e-3), 0.0)
    state = _State(origin, terms, gap * np.broadcast_to(np.eye(4), origin.shape), slack)
    targets = gap, gap
    for step in range(steps + 1):
        history.append(_loss(problem, linear, state.origin, state.terms))
        if callback is not None:
            callback(step, history[-1], state.origin, _roots(state.terms, linear.positive).reshape(s.shape))
        try:
            following, decrement, gaps, length = _step(problem, linear, state, *targets)
        except np.linalg.LinAlgError:
            decrement = np.nan
        if not np.isfinite(history[-1] + decrement):
            result = "not_finite"
            break
        # Rounding of the loss limits how small a decrease can be seen.
        if targets == (prior, least) and decrement / 2 <= max(tolerance, 10 * resolution * abs(history[-1])):
            result = "converged"
            break
        if step < steps:
            state = following
            # The longer the step was, the more of the barrier goes next; short steps are for getting back to the middle.
            share = min(max(0.02, (1 - length) ** 2), 0.9)
            targets = max(prior, share * gaps[0]), max(least, share * gaps[1])
    s = _roots(state.terms, linear.positive).reshape(s.shape)
    return Minimum(state.origin, s, np.array(history), result)


def _roots(terms: np.ndarray, positive: np.ndarray) -> np.ndarray:
    return np.where(positive, np.sqrt(np.where(positive, terms, 1)), terms)


def _loss(problem: TorqueProblem, linear: Linear, origin: np.ndarray, terms: np.ndarray) -> float:
    residual = problem.R @ linear.x(origin, terms) - problem.d
    diagonal = np.diagonal(origin, axis1=1, axis2=2)
    divergence = np.sum(origin**2) - 2 * np.sum(np.log(diagonal)) - 4.0 * len(origin)
    return float(0.5 * (residual @ residual + problem.rest) + problem.prior * divergence)


def _step(problem: TorqueProblem, linear: Linear, state: _State, weight: float, barrier: float):
    """One step towards P Z = weight, terms * multipliers = barrier.

    Steps go straight in x and stop short of the edge, P = A (1 + h S) A^T with A the factor now: a curved step would leave
    the narrow valley that a precise log makes. The equations are those of Newton's method on the loss with barriers, but the
    barrier's curvature is that of the multipliers, Z S + S Z, which already know where the edge is (Helmberg, Rendl,
    Vanderbei & Wolkowicz 1996; Nesterov & Nemirovskii 1994).

    **Returns:** the state after it, the decrement, mean products with the multipliers, and the length of the step.

    **Raises:** numpy.linalg.LinAlgError where numbers are not finite or rounding makes the equations indefinite.
    """
    from scipy.linalg import cho_factor, cho_solve  # not when jaxdyn is imported

    positive, terms = linear.positive, state.terms
    count, size = len(state.origin), linear.count
    bodies = count * size
    inverse = np.where(positive, 1 / np.where(positive, terms, 1), 0)
    basis = STRETCHES[:size]
    traces = np.trace(basis, axis1=1, axis2=2)

    rows = linear.rows(problem.R, linear.slopes(state.origin))
    gradient = rows.T @ (problem.R @ linear.x(state.origin, terms) - problem.d)
    # prior tr(P0^-1 P) is what remains of the divergence without its log det.
    grams = np.swapaxes(state.origin, 1, 2) @ state.origin
    gradient[:bodies] += (problem.prior * np.einsum("bij,kij->bk", grams, basis) - weight * traces).reshape(-1)
    gradient[bodies:] -= barrier * inverse
    hessian = rows.T @ rows
    products = np.einsum("kij,bjm->bkim", basis, state.dual)
    blocks = np.einsum("bkim,lmi->bkl", products, basis)
    for i in range(count):
        own = slice(i * size, (i + 1) * size)
        hessian[own, own] += blocks[i]
    hessian[np.arange(bodies, len(hessian)), np.arange(bodies, len(hessian))] += state.slack * inverse
    diagonal = np.diagonal(hessian)
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = hessian / unit[:, None] / unit
    scaled[np.arange(len(unit)), np.arange(len(unit))] += 4 * _EPS
    factor = cho_factor(scaled, check_finite=False)
    direction = -cho_solve(factor, gradient / unit, check_finite=False) / unit

    stretch = np.einsum("bk,kij->bij", direction[:bodies].reshape(count, size), basis)
    change = direction[bodies:]
    product = state.dual @ stretch
    dual_stretch = weight * np.eye(4) - state.dual - (product + np.swapaxes(product, 1, 2)) / 2
    dual_change = np.where(positive, (barrier - state.slack * change) * inverse - state.slack, 0)

    length = _length(np.linalg.eigvalsh(stretch), change * inverse)
    roots = _upper_root(state.dual)
    relative = np.linalg.solve(roots, np.swapaxes(np.linalg.solve(roots, dual_stretch), 1, 2))
    dual_length = _length(
        np.linalg.eigvalsh((relative + np.swapaxes(relative, 1, 2)) / 2),
        dual_change / np.where(state.slack > 0, state.slack, 1),
    )
    roots = _upper_root(np.eye(4) + length * stretch)
    dual = np.swapaxes(roots, 1, 2) @ (state.dual + dual_length * dual_stretch) @ roots
    moved = _State(state.origin @ roots, terms + length * change, dual, state.slack + dual_length * dual_change)
    # Mean products of what must stay positive and its multipliers.
    gaps = (
        float(np.trace(dual, axis1=1, axis2=2).sum()) / max(4 * count, 1),
        float(np.sum(np.where(positive, moved.slack * moved.terms, 0))) / max(int(positive.sum()), 1),
    )
    return moved, float(-(gradient @ direction)), gaps, min(length, dual_length)


def _length(*rates: np.ndarray) -> float:
    """Longest step up to 1 that leaves a twentieth of everything that shrinks at these rates."""
    fastest = min((float(rate.min(initial=0)) for rate in rates), default=0.0)
    return min(1.0, -0.95 / min(fastest, -0.95))


def _upper_root(matrices: np.ndarray) -> np.ndarray:
    """Upper-triangular U (n, 4, 4) with U U^T the matrices."""
    return np.linalg.cholesky(matrices[:, ::-1, ::-1])[:, ::-1, ::-1]
