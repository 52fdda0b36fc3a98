"""Interior-point method for the feasible torque fit, on the host.

A fit takes some tens of steps with matrices of a few hundred rows, and a search for terms some thousand steps: in NumPy each
takes about a millisecond, and nothing is compiled.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxdyn.constraints.codes import RESULTS
from jaxdyn.identify.blocks import Block, Inertias, Numbers, Tied
from jaxdyn.identify.chart import (
    FROM_PSEUDO,
    LOG_CHOLESKY_BASIS,
    LOG_CHOLESKY_PLACES,
    make_chart,
    pseudo_factor,
    upper_root,
)
from jaxdyn.identify.descent import Descent, Iterate, Method, Watch, descend
from jaxdyn.identify.regression import free_columns, nominal_parameters
from jaxdyn.identify.torque_terms import POSITIVE
from jaxdyn.model import host_math
from jaxdyn.model.tree import Model

_EPS = float(np.finfo(np.float64).eps)
# Most steps.
_STEPS = 200


class TorqueProblem(NamedTuple):
    """Convex problem 1/2 |R x - d|^2 + prior D(x) in float64, squares over the variance, in a chart's coordinates.

    All fits by torques that are linear in the numbers pose it: of robots, of payloads, and of parameters.
    """

    chart: "LinearChart"
    R: np.ndarray
    d: np.ndarray
    prior: float

    @classmethod
    def of(cls, chart: "LinearChart", rows: np.ndarray, sigma: float, prior: float) -> "TorqueProblem":
        """Problem of rows [W, w] of condensed logs with the torque noise sigma (N m).

        **Raises:** ValueError for zero or infinite noise.
        """
        # An infinite deviation would weigh all errors by zero, and any point would be a minimum.
        if not sigma < np.inf:
            raise ValueError(
                f"the torques of the logs have the deviation {sigma}: their squares overflow; give them in N m"
            )
        if not sigma > 0:
            raise ValueError(
                "the torques of the logs are all zero; a fit by torques needs logs of a robot that is driven"
            )
        return cls(chart, rows[:, :-1] / sigma, rows[:, -1] / sigma, prior)

    def minimize(self, tolerance: float, callback: Callable | None = None) -> Descent:
        """Minimise by `InteriorPoint` from the start of the chart; `callback(step, loss, (origin, terms))` before each step."""
        return descend(InteriorPoint(self, tolerance), self.chart.start, Watch(_STEPS, callback))

    def loss(self, origin: np.ndarray, terms: np.ndarray) -> float:
        """Loss at relative pseudo-inertias A A^T, A the `origin`, and terms."""
        residual = self.R @ self.chart.x(origin, terms) - self.d
        # The origins are triangular: log det is a sum of logarithms, where a determinant could underflow.
        diagonal = np.diagonal(origin, axis1=1, axis2=2)
        divergence = np.sum(origin**2) - 2 * np.sum(np.log(diagonal)) - 4.0 * len(origin)
        return float(0.5 * residual @ residual + self.prior * divergence)


class _State(NamedTuple):
    """Bodies P = A A^T relative to the nominal ones with A the `origin`, terms, and the multipliers of both.

    `dual` (bodies, 4, 4): of the constraint P > 0, in the frame where P is 1; `slack` (n,): of the constraints terms >= 0.
    """

    origin: np.ndarray
    terms: np.ndarray
    dual: np.ndarray
    slack: np.ndarray


class LinearChart(NamedTuple):
    """Map from relative pseudo-inertias A A^T of some bodies, and terms, to parameters x (p,), linear in both.

    x is `given`, plus `read` of each body's F A A^T F^T at its `places`, plus `scale` times the terms at `term_places`.

    `factors` F (bodies, 4, 4); `read` (k, 4, 4); `places` (bodies, k); `count`: coordinates of a body, its density alone or all
    ten; `positive` (n,): which of the terms must not be negative; `start` (n,): terms where a fit starts.
    """

    given: np.ndarray
    factors: np.ndarray
    read: np.ndarray
    places: np.ndarray
    count: int
    term_places: np.ndarray
    scale: np.ndarray
    positive: np.ndarray
    start: np.ndarray

    def x(self, origin: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """All parameters (p,)."""
        result = self.given.copy()
        # A body is a product of its factors, so that rounding cannot make it infeasible; a sum P + dP could be.
        upper = self.factors @ origin
        result[self.places] += np.einsum("kij,bij->bk", self.read, upper @ np.swapaxes(upper, 1, 2))
        result[self.term_places] += self.scale * terms
        return result

    def body_jacobians(self, origin: np.ndarray) -> np.ndarray:
        """Jacobians (bodies, k, coordinates) of the numbers of each body by its own coordinates."""
        upper = (self.factors @ origin)[:, None]
        moved = upper @ LOG_CHOLESKY_BASIS[None, : self.count] @ np.swapaxes(upper, 2, 3)
        return np.einsum("cij,bkij->bck", self.read, moved)

    def clip_terms(self, terms: np.ndarray) -> np.ndarray:
        """Terms, with those below a millionth of their unit set to zero, which fits approach but never reach."""
        return np.where(self.positive & (terms < 1e-6), 0.0, terms)

    def jacobian(self, origin: np.ndarray) -> np.ndarray:
        """Jacobian (p, n) of all parameters by the coordinates of the bodies, then by the terms."""
        return self.rows(np.eye(len(self.given)), self.body_jacobians(origin))

    def coordinate_jacobian(self, origin: np.ndarray, terms: np.ndarray) -> np.ndarray:
        """Jacobian (p, p) of all numbers by log-Cholesky coordinates and logarithms of positive terms, of a `block_chart`."""
        half = log_cholesky_jacobian(origin, self.count) @ np.swapaxes(origin, 1, 2)[:, None]
        blocks = np.einsum("cij,bkij->bck", self.read, half + np.swapaxes(half, 2, 3))
        result = np.zeros((len(self.given),) * 2)
        for places, block in zip(self.places, blocks, strict=True):
            result[np.ix_(places, places)] = block
        result[self.term_places, self.term_places] = np.where(self.positive, terms, 1.0)
        return result

    def rows(self, R: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
        """Jacobian (m, n) of R x by the coordinates of the bodies, then by the terms."""
        inertial = np.matmul(np.swapaxes(R[:, self.places], 0, 1), jacobians)
        inertial = np.swapaxes(inertial, 0, 1).reshape(len(R), -1)
        return np.concatenate([inertial, R[:, self.term_places] * self.scale], axis=1)


def term_units(sizes) -> dict[str, np.ndarray]:
    """Units (nv,) of `TERMS`: a tenth of a joint's torque, over velocity or acceleration; `sizes` as of `signal_sizes`."""
    torque, velocity, acceleration = (np.asarray(x, np.float64) for x in sizes)
    unit, one = 0.1 * torque, np.ones_like(torque)
    # A torque that is always zero borrows the largest unit: a term in units of zero could not be changed.
    unit = np.where(unit > 0, unit, unit.max(initial=0.0) or 1.0)
    per = {"viscous": velocity, "coulomb": one, "offset": one, "armature": acceleration}
    return {term: unit / np.where(size > 0, size, 1.0) for term, size in per.items()}


def robot_chart(model: Model, terms: tuple[str, ...], inertia: str, sizes) -> LinearChart:
    """Chart of all parameters x (10 nb + 4 nv,) of a robot, by its bodies with mass and some of `TERMS`.

    Terms are in `term_units`, and start at the model's own, a tenth of a unit where it has none.

    **Arguments:** `inertia`, "full", "mass" or "fixed"; `sizes`, as of `signal_sizes`.

    **Raises:** ValueError for unknown `inertia`, and for nominal bodies and terms that are not feasible.
    """
    chart, given = make_chart(model, inertia), nominal_parameters(model)
    places = 10 * np.array(chart.bodies, int)[:, None] + np.arange(10)
    term_places = free_columns(model.nb, model.nv, terms)[10 * model.nb :]
    own, positive = given[term_places], np.repeat([term in POSITIVE for term in terms], model.nv).astype(bool)
    if np.any(own < 0):
        row, column = divmod(int(np.flatnonzero(own < 0)[0]), model.nv)
        raise ValueError(
            f"{terms[row]} of coordinate {column} is {own[row * model.nv + column]} in the model; it must not be negative"
        )
    units = term_units(sizes)
    scale = np.concatenate([np.zeros(0), *(units[term] for term in terms)])
    given[places] = given[term_places] = 0.0
    # At a bound a barrier is infinite: start inside.
    start = np.where(positive, np.where(own > 0, own / scale, 0.1), 0.0)
    factors = np.asarray(chart.factors, np.float64)
    return LinearChart(given, factors, FROM_PSEUDO, places, chart.count, term_places, scale, positive, start)


def body_chart(numbers: np.ndarray) -> LinearChart:
    """Chart of the ten numbers of one body, with no terms, around nominal ones (10,)."""
    factors, none = pseudo_factor(host_math.pseudo_inertia(numbers), "full")[None], np.zeros(0)
    places = np.arange(10)[None]
    return LinearChart(np.zeros(10), factors, FROM_PSEUDO, places, 10, none.astype(int), none, none.astype(bool), none)


def block_chart(blocks: Sequence[Block]) -> LinearChart | None:
    """Chart of the ways z (p,) from the start to the numbers of blocks, along which their derivatives by y are constant.

    Positive numbers are terms in units of their start, and z is their change. None unless inertias with the entropic distance
    from the nominal ones are among the blocks, or where others are neither free nor positive numbers, nor tied to them.
    """
    bodies, places, scale, positive = None, np.zeros((0, 0), int), np.zeros(0), np.zeros(0, bool)
    begin, term_places = 0, []
    for block in blocks:
        own = begin + np.arange(block.size)
        begin += block.size
        if (
            isinstance(block, Inertias)
            and block.metric == "entropic"
            and block.ellipsoids is None
            and block.total is None
        ):
            bodies, places = block.chart, own.reshape(len(block.chart.bodies), -1)
        elif isinstance(block, Numbers) and block.kind != "bound":
            term_places += own.tolist()
            positive = np.append(positive, np.full(block.size, block.kind == "positive"))
        elif not isinstance(block, Tied):
            return None
    if bodies is None:
        return None
    basis, scale = LOG_CHOLESKY_BASIS[: bodies.count], np.ones(len(term_places))
    # The dual basis: coordinates of A A^T - 1 in the directions of the log-Cholesky coordinates at the start.
    read = np.einsum("kl,lij->kij", np.linalg.inv(np.einsum("kij,lij->kl", basis, basis)), basis)
    given = np.zeros(begin)
    given[places] = -np.trace(read, axis1=1, axis2=2)
    given[np.array(term_places, int)[positive]] = -1.0
    factors = np.broadcast_to(np.eye(4), (len(places), 4, 4))
    return LinearChart(
        given, factors, read, places, bodies.count, np.array(term_places, int), scale, positive, positive.astype(float)
    )


def log_cholesky_coordinates(origin: np.ndarray, count: int) -> np.ndarray:
    """Coordinates (bodies, count) with the factors `origin` (bodies, 4, 4): the inverse of `inertia.log_cholesky_factor`."""
    last = origin[:, 3, 3]
    relative = origin / last[:, None, None]
    logarithms = np.log(np.stack([last, *(relative[:, i, i] for i in range(3))], axis=1))
    others = np.stack([relative[(slice(None), *place)] for place in LOG_CHOLESKY_PLACES[3:]], axis=1)
    return np.concatenate([logarithms, others], axis=1)[:, :count]


def log_cholesky_jacobian(origin: np.ndarray, count: int) -> np.ndarray:
    """Derivatives (bodies, count, 4, 4) of the factors `origin` (bodies, 4, 4) by their `log_cholesky_coordinates`."""
    result = np.zeros((len(origin), 10, 4, 4))
    result[:, 0] = origin
    for k, place in enumerate(LOG_CHOLESKY_PLACES, 1):
        # Entries on the diagonal are exponentials, the others multiples of the last one.
        result[(slice(None), k, *place)] = origin[(slice(None), *place)] if k < 4 else origin[:, 3, 3]
    return result[:, :count]


class InteriorPoint(Method):
    """Primal-dual interior-point steps from the nominal bodies and some terms (n,).

    The loss is min |R x - d|^2 / 2 + prior tr(P0^-1 P) with -prior log det P as a permanent barrier. The barrier starts as
    strong as the data, so that bodies are not driven to the boundary of the feasible set, and decreases as fast as the
    complementarity of bodies and multipliers allows: to the prior for the bodies, to zero for the terms.

    **Arguments:** `tolerance`: largest excess of the final loss over the minimum.

    A point is (origin, terms); the state of an iterate are bodies, terms and multipliers, and the two targets of the barrier.
    """

    def __init__(self, problem: TorqueProblem, tolerance: float):
        self.problem, self.linear = problem, problem.chart
        self.tolerance = tolerance
        self.inequalities = int(self.linear.positive.sum())
        # A barrier mu leaves the loss about mu above the minimum for each inequality: together a tenth of the tolerance.
        self.minimum = 0.1 * tolerance / max(self.inequalities, 1)

    def init(self, start, kept):
        """Evaluate the start, with multipliers that make the barrier as strong as the data."""
        problem, positive = self.problem, self.linear.positive
        terms, origin = np.asarray(start, np.float64), np.broadcast_to(np.eye(4), (len(self.linear.factors), 4, 4))
        # Degree of the barrier: log det of a 4 x 4 matrix counts four, an inequality one.
        count = 4 * len(origin) + max(self.inequalities, 1)
        # Not below the prior, which is the final strength of the bodies' barrier.
        gap = max(problem.prior, problem.loss(origin, terms) / count)
        # On the central path terms * multipliers = gap; the floor keeps the multiplier of a term close to zero bounded.
        slack = np.where(positive, gap / np.maximum(terms, 1e-3), 0.0)
        # P is 1 in its own frame, where the central path P Z = gap 1 makes Z a multiple of the identity.
        state = _State(origin, terms, gap * np.broadcast_to(np.eye(4), origin.shape), slack)
        return self._iterate(state, (gap, gap))

    def step(self, iterate, history, best):
        """Make one step, and lower the targets of the barrier."""
        problem, (state, targets) = self.problem, iterate.state
        try:
            following, decrement, gaps, length = _step(problem, self.linear, state, *targets)
        except np.linalg.LinAlgError:
            return iterate, RESULTS.nonfinite
        if not np.isfinite(iterate.loss + decrement):
            return iterate, RESULTS.nonfinite
        # Rounding of the loss limits the smallest decrease that is visible.
        smallest = max(self.tolerance, 10 * _EPS * abs(iterate.loss))
        # Half of the decrement is the decrease that Newton's model predicts. It bounds the excess at the final targets alone.
        if targets == (problem.prior, self.minimum) and decrement / 2 <= smallest:
            return iterate, RESULTS.successful
        # Mehrotra's idea: after a long step the barrier decreases much; after a short one the iterate returns to the central path
        # first. Below 0.02 a good step would leave the path, above 0.9 the method would stall.
        share = min(max(0.02, (1 - length) ** 2), 0.9)
        return self._iterate(following, (max(problem.prior, share * gaps[0]), max(self.minimum, share * gaps[1]))), None

    def _iterate(self, state: _State, targets: tuple[float, float]) -> Iterate:
        loss = self.problem.loss(state.origin, state.terms)
        return Iterate((state.origin, state.terms), loss, (state, targets))


def _step(problem: TorqueProblem, linear: LinearChart, state: _State, weight: float, barrier: float):
    """One step towards P Z = weight, terms * multipliers = barrier.

    Steps are straight lines in x and stop before the boundary, P = A (1 + h S) A^T with A the present factor: a curved step would
    leave the narrow valley of a precise log. The equations are those of Newton's method on the loss with barriers, but the
    barrier's curvature is that of the multipliers, Z S + S Z, which have the distance to the boundary in them (Helmberg, Rendl,
    Vanderbei & Wolkowicz 1996; Nesterov & Nemirovskii 1994).

    **Returns:** the state after it, the decrement, mean products with the multipliers, and the length of the step.

    **Raises:** numpy.linalg.LinAlgError where numbers are not finite or rounding makes the equations indefinite.
    """
    from scipy.linalg import cho_factor, cho_solve  # not when jaxdyn is imported

    positive, terms = linear.positive, state.terms
    count, size = len(state.origin), linear.count
    bodies = count * size
    inverse = np.where(positive, 1 / np.where(positive, terms, 1), 0)
    basis = LOG_CHOLESKY_BASIS[:size]
    # The derivative of log det P along S is tr(P^-1 S), the trace of S in the frame where P is 1.
    traces = np.trace(basis, axis1=1, axis2=2)

    rows = linear.rows(problem.R, linear.body_jacobians(state.origin))
    gradient = rows.T @ (problem.R @ linear.x(state.origin, terms) - problem.d)
    # The divergence without its log det, which is the barrier, is prior tr(P0^-1 P).
    grams = np.swapaxes(state.origin, 1, 2) @ state.origin
    gradient[:bodies] += (problem.prior * np.einsum("bij,kij->bk", grams, basis) - weight * traces).reshape(-1)
    gradient[bodies:] -= barrier * inverse
    # Gauss-Newton is exact here: R x - d is linear in the step, whose curvature the straight lines in x do not add to.
    hessian = rows.T @ rows
    # Entries tr(S_k Z S_l): symmetric, positive for Z > 0, and the Hessian of -weight log det P where Z = weight 1.
    products = np.einsum("kij,bjm->bkim", basis, state.dual)
    blocks = np.einsum("bkim,lmi->bkl", products, basis)
    for i in range(count):
        own = slice(i * size, (i + 1) * size)
        hessian[own, own] += blocks[i]
    hessian[np.arange(bodies, len(hessian)), np.arange(bodies, len(hessian))] += state.slack * inverse
    # Masses and friction coefficients differ by orders of magnitude: factored with a unit diagonal.
    diagonal = np.diagonal(hessian)
    unit = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = hessian / unit[:, None] / unit
    # Directions that neither log nor prior determine, such as terms at a joint that never moves, would make it singular.
    scaled[np.arange(len(unit)), np.arange(len(unit))] += 4 * _EPS
    # Cholesky also tests the curvature: it fails, and ends the fit, where rounding has made the matrix indefinite.
    factor = cho_factor(scaled, check_finite=False)
    direction = -cho_solve(factor, gradient / unit, check_finite=False) / unit

    stretch = np.einsum("bk,kij->bij", direction[:bodies].reshape(count, size), basis)
    change = direction[bodies:]
    product = state.dual @ stretch
    # P Z = weight 1 at P = 1, linearised: Z + dZ + (S Z + Z S) / 2 = weight 1. The symmetric part keeps dZ symmetric.
    dual_stretch = weight * np.eye(4) - state.dual - (product + np.swapaxes(product, 1, 2)) / 2
    # terms * multipliers = barrier, linearised and divided by the terms.
    dual_change = np.where(positive, (barrier - state.slack * change) * inverse - state.slack, 0)

    # 1 + h S is definite for h below -1 over the smallest eigenvalue; the relative change of terms has the same rule.
    length = _step_to_boundary(np.linalg.eigvalsh(stretch), change * inverse)
    # The multipliers have a step to their boundary of their own, by the eigenvalues of their change relative to them.
    roots = upper_root(state.dual)
    relative = np.linalg.solve(roots, np.swapaxes(np.linalg.solve(roots, dual_stretch), 1, 2))
    dual_length = _step_to_boundary(
        np.linalg.eigvalsh((relative + np.swapaxes(relative, 1, 2)) / 2),
        dual_change / np.where(state.slack > 0, state.slack, 1),
    )
    # P = A (1 + h S) A^T is refactored; the multipliers are congruent to the new frame, in which P is 1 again.
    roots = upper_root(np.eye(4) + length * stretch)
    dual = np.swapaxes(roots, 1, 2) @ (state.dual + dual_length * dual_stretch) @ roots
    following = _State(state.origin @ roots, terms + length * change, dual, state.slack + dual_length * dual_change)
    # Mean products of the positive quantities and their multipliers: zero at the solution.
    gaps = (
        float(np.trace(dual, axis1=1, axis2=2).sum()) / max(4 * count, 1),
        float(np.sum(np.where(positive, following.slack * following.terms, 0))) / max(int(positive.sum()), 1),
    )
    # The shorter step: the barrier may decrease much only after both were long.
    return following, float(-(gradient @ direction)), gaps, min(length, dual_length)


def _step_to_boundary(*rates: np.ndarray) -> float:
    """Step to the boundary, at most 1: it leaves a twentieth of every quantity that decreases at these rates."""
    fastest = min((float(rate.min(initial=0)) for rate in rates), default=0.0)
    # Rates above -0.95 allow the full step; the inner minimum also avoids a division by zero.
    return min(1.0, -0.95 / min(fastest, -0.95))
