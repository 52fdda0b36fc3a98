"""Physically feasible inertias and friction by torque error."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn import inertia as _inertia
from jaxdyn.identify.chart import Chart, Coordinates, make_chart, positive_terms
from jaxdyn.identify.friction import TERMS, check_terms
from jaxdyn.identify.logs import Log, check_log
from jaxdyn.identify.minimise import METHODS, minimise
from jaxdyn.identify.regression import condense, free_columns, noise_level
from jaxdyn.identify.result import Fit
from jaxdyn.model import Model

# A fit is never trusted beyond this share of the torque: rounding and noise-free logs stay well posed.
_FINEST = 1e-6
_STEPS = {"newton": 200, "lbfgs": 3000, "adam": 10000}


class Problem(eqx.Module):
    """The torque loss of a log, |R x - d|^2 + rest condensed, over the variance, plus the prior."""

    chart: Chart
    R: Float[Array, "p p"]
    d: Float[Array, " p"]
    rest: Float[Array, ""]
    prior: Float[Array, ""]


def torque_loss(point: Coordinates, problem: Problem) -> Float[Array, ""]:
    """1/2 |W x(point) - tau|^2 / sigma^2 + prior * log-det divergence from the nominal bodies."""
    residual = problem.R @ problem.chart.parameters(point) - problem.d
    return 0.5 * (residual @ residual + problem.rest) + problem.prior * problem.chart.divergence(point.theta)


def fit_torques(
    model: Model,
    log: Log,
    terms=TERMS,
    *,
    v_s: float = 0.01,
    inertia: str = "full",
    weights=None,
    prior: float = 1.0,
    sigma: float | None = None,
    method: Any = "newton",
    steps: int | None = None,
    learning_rate: float = 0.01,
    tolerance: float = 1e-6,
    callback: Callable[[int, float, Model], None] | None = None,
) -> Fit:
    """Physically feasible inertias, friction and rotor inertia by the error of the joint torques along a log.

    Minimises 1/2 |weights (W x - tau)|^2 / sigma^2 + prior * sum over bodies of D(P, P0), where W is the regressor and
    D(P, P0) = tr(P0^-1 P) - log det(P0^-1 P) - 4 the log-det (entropic) divergence of a body's pseudo-inertia from the
    nominal one. It settles what the torques leave open, is the same in every frame and unit, and grows without bound
    towards bodies that do not exist. x is searched in coordinates in which every point is a feasible body with friction
    that takes energy (`Chart`), so no iterate can be infeasible. The log is condensed once: a step costs the same for
    any log.

    **Arguments:**

    - `model`: nominal model, where the fit starts; `log` with v and a.
    - `terms`: fitted beside the links, tau_f = viscous v + coulomb tanh(v / v_s) + offset, and armature a; viscous,
      coulomb and armature stay at or above zero. A term left out keeps the model's value.
    - `inertia`: "full", all ten numbers of each body; "mass", its density alone; "fixed".
    - `weights` (nv,): one over the noise of each joint's torque, relative to the others; ones by default.
    - `prior`: weight of the divergence; 1 counts it like one observation of each body. `sigma`: torque noise (N m);
      by default the residual of the unconstrained least squares.
    - `method`: "newton" (the loss is convex in x, and this finds its one minimum in some tens of steps), "lbfgs" or
      "adam" (optax), or any optax.GradientTransformation. `steps`: the most steps. `learning_rate`: of adam.
      `tolerance`: newton stops when the loss is within this of its minimum; lbfgs at this relative change in ten steps.
    - `callback(step, loss, model)`: called before every step with the model at that point.

    **Returns:** `Fit`.

    **Raises:** ValueError when log and model do not fit together, for nominal bodies that are not feasible, and for
    arguments out of range.

    Source: Rucker & Wensing (2022), log-Cholesky coordinates; Lee, Wensing & Park (2020), "Geometric robot dynamic
    identification: a convex programming approach", divergence and convexity.
    """
    check_log(log, model)
    terms = check_terms(terms, v_s)
    if not prior > 0:
        raise ValueError(f"prior is {prior}; it must be positive: torques alone do not determine single bodies")
    problem, point, sigma = _problem(model, log, terms, v_s, inertia, weights, prior, sigma)
    chart = problem.chart
    if method != "newton" and isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; take one of {('newton', *METHODS)} or an optax.GradientTransformation")
    limit = _STEPS.get(method, _STEPS["adam"]) if isinstance(method, str) else _STEPS["adam"]
    steps = limit if steps is None else steps
    if isinstance(method, str) and method == "newton":
        chart, point, history, result = _newton(model, problem, point, steps, tolerance, callback)
    else:
        start, scaling = _whitening(problem, point)
        _, unflatten = ravel_pytree(point)

        def report(step, value, y):
            if callback is not None:
                callback(step, value, chart.fitted(model, unflatten(start + scaling @ y))[0])

        y, history, result = minimise(
            _flat_loss,
            jnp.zeros_like(start),
            (problem, point, start, scaling),
            method=method,
            steps=steps,
            learning_rate=learning_rate,
            tolerance=tolerance,
            callback=report,
        )
        point = unflatten(start + scaling @ y)
    fitted, friction = chart.fitted(model, chart.settled(point))
    name = method if isinstance(method, str) else type(method).__name__
    return Fit(fitted, friction, model, history, result, f"torque fit by {name}", terms, sigma)


def _problem(model, log, terms, v_s, inertia, weights, prior, sigma):
    condensed = condense(model, log, v_s=v_s, weights=weights)
    tau = np.asarray(log.tau, np.float64)
    rms = [np.sqrt(np.mean(np.asarray(x, np.float64) ** 2, axis=0)) for x in (tau, log.v, log.a)]
    if sigma is None:
        sigma = max(noise_level(condensed), _FINEST * float(np.sqrt(np.mean(tau**2))))
    if not sigma > 0:
        raise ValueError(f"sigma is {sigma}; the torque noise must be positive (all torques of the log may be zero)")
    chart, point = make_chart(model, terms, v_s, inertia, *rms)
    dtype = np.dtype(model.home.dtype)
    numbers = (condensed.R / sigma, condensed.d / sigma, condensed.rest / sigma**2, prior)
    return Problem(chart, *(jnp.asarray(x, dtype) for x in numbers)), point, float(sigma)


def _newton(model: Model, problem: Problem, point: Coordinates, steps: int, tolerance: float, callback):
    """Newton's method with barriers (interior point): chart, point, history of the loss itself, result.

    The divergence keeps bodies from the edge of what is feasible, -barrier * log keeps the terms above zero. A log of little
    noise far from the nominal model would still press both against their edges and leave only small steps, so the barriers
    start as strong as the data and are released in stages, the divergence down to the prior, the terms' down to where
    it is worth less than the tolerance.
    """
    history, result = [], "max_steps"
    prior = float(problem.prior)
    count = int(positive_terms(problem.chart.terms).sum()) * point.s.shape[1]
    least = 0.1 * tolerance / max(count, 1)
    barrier = max(prior, 0.01 * float(torque_loss(point, problem)))
    for step in range(steps + 1):
        weights = jnp.asarray(max(prior, barrier), problem.R.dtype), jnp.asarray(barrier, problem.R.dtype)
        value, decrement, origin, s = _newton_step(problem, point, *weights)
        history.append(float(value))
        if callback is not None:
            callback(step, history[-1], problem.chart.fitted(model, point)[0])
        if not np.isfinite(history[-1] + float(decrement)):
            result = "not_finite"
            break
        # Rounding of the loss limits how small a decrease can be seen.
        resolution = 10 * float(jnp.finfo(problem.R.dtype).eps) * abs(history[-1])
        if barrier <= least and float(decrement) / 2 <= max(tolerance, resolution):
            result = "converged"
            break
        if step < steps:
            problem = eqx.tree_at(lambda p: p.chart.origin, problem, origin)
            point = Coordinates(point.theta, s)
            if float(decrement) / 2 <= max(barrier, resolution):
                barrier = max(least, barrier / 30)
    return problem.chart, point, np.array(history), result


@eqx.filter_jit
def _newton_step(problem: Problem, point: Coordinates, weight, barrier):
    """Loss, twice the decrease that the quadratic model promises of the loss with barriers, and the point after a step.

    That loss is convex in x, so the step goes straight in x and stops short of the edge: P = A (1 + h S) A^T, with A the
    factor now. A curved step would leave the narrow valley that a precise log makes.
    """
    chart, dtype = problem.chart, problem.R.dtype
    positive = jnp.broadcast_to(jnp.asarray(positive_terms(chart.terms)), point.s.shape).reshape(-1)
    start = point.s.reshape(-1)
    terms = jnp.where(positive, start**2, start)
    inverse = jnp.where(positive, 1 / jnp.where(positive, terms, 1), 0)
    bodies = point.theta.size
    nb, nv = chart.nominal_inertias.shape[0], chart.nominal_terms.shape[1]

    inertial = jax.jacfwd(lambda theta: chart.inertias(theta).reshape(-1))(point.theta).reshape(-1, bodies)
    places = free_columns(nb, nv, chart.terms)[10 * nb :]
    rows = [problem.R[:, : 10 * nb] @ inertial, problem.R[:, places] * chart.scale.reshape(1, -1)]
    rows = jnp.concatenate(rows, axis=1)
    slope = weight * jax.grad(chart.divergence)(point.theta).reshape(-1)
    gradient = rows.T @ (problem.R @ chart.parameters(point) - problem.d) + jnp.append(slope, -barrier * inverse)
    metric = jnp.kron(jnp.eye(len(chart.bodies), dtype=dtype), weight * _metric(point.theta.shape[1], dtype))
    hessian = rows.T @ rows + jax.scipy.linalg.block_diag(metric, jnp.diag(barrier * inverse**2))
    diagonal = jnp.diagonal(hessian)
    unit = jnp.sqrt(jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
    damping = 4 * jnp.finfo(dtype).eps * jnp.eye(unit.size, dtype=dtype)
    factor = jax.scipy.linalg.cho_factor(hessian / (unit[:, None] * unit[None, :]) + damping)
    direction = -jax.scipy.linalg.cho_solve(factor, gradient / unit) / unit
    decrement = -(gradient @ direction)

    one = jnp.eye(4, dtype=dtype)
    stretch = jax.vmap(_linear_factor)(direction[:bodies].reshape(point.theta.shape))
    stretch = stretch + jnp.swapaxes(stretch, 1, 2)
    fastest = jnp.minimum(
        jnp.min(jnp.linalg.eigvalsh(stretch), initial=0), jnp.min(direction[bodies:] * inverse, initial=0)
    )
    lengths = 0.5 ** jnp.arange(40, dtype=dtype) * jnp.minimum(1, -0.95 / jnp.minimum(fastest, -0.95))

    def moved(length):
        roots = jax.vmap(_upper_root)(one[None] + length * stretch)
        following = terms + length * direction[bodies:]
        s = jnp.where(positive, jnp.sqrt(jnp.where(positive, following, 1)), following).reshape(point.s.shape)
        return jnp.einsum("bij,bjk->bik", chart.origin, roots), s

    def outcome(length):
        origin, s = moved(length)
        there = eqx.tree_at(lambda p: (p.chart.origin, p.prior), problem, (origin, weight))
        logs = jnp.sum(jnp.log(jnp.where(positive, s.reshape(-1), 1)))
        return torque_loss(Coordinates(point.theta, s), there) - 2 * barrier * logs

    losses = jax.vmap(outcome)(lengths)
    accepted = losses <= outcome(jnp.zeros((), dtype)) - 1e-4 * lengths * decrement
    length = jnp.where(jnp.any(accepted), lengths[jnp.argmax(accepted)], 0)
    return torque_loss(point, problem), decrement, *moved(length)


def _linear_factor(step):
    """Derivative of `log_cholesky_factor` at zero along a step (10,), or along its first number (1,)."""
    step = jnp.append(step, jnp.zeros((10 - step.size,), step.dtype))
    return jax.jvp(_inertia.log_cholesky_factor, (jnp.zeros_like(step),), (step,))[1]


def _upper_root(matrix):
    """Upper-triangular U with U U^T = matrix; NaN when it is not positive definite."""
    return jnp.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]


def _metric(size: int, dtype):
    """Second derivative of -log det(A (1 + S) A^T) at S = 0, |S|^2, along the coordinates of a body; for every A."""
    stretch = jax.vmap(_linear_factor)(jnp.eye(size, dtype=dtype))
    stretch = (stretch + jnp.swapaxes(stretch, 1, 2)).reshape(size, 16)
    return stretch @ stretch.T


def _whitening(problem: Problem, point: Coordinates):
    """Flat start and a matrix with which optax sees a loss of about unit curvature and a way to go of about one."""
    y, unflatten = ravel_pytree(point)
    rows = problem.R @ jax.jacfwd(lambda y: problem.chart.parameters(unflatten(y)))(y)
    values, vectors = jnp.linalg.eigh(rows.T @ rows)
    # Nothing is stretched so far that one unit leaves the neighbourhood in which exponentials behave.
    fall = 2 * torque_loss(point, problem)
    values = jnp.maximum(values, fall)
    return y, vectors * jnp.sqrt(fall / values)[None, :]


def _flat_loss(y, args):
    problem, point, start, scaling = args
    _, unflatten = ravel_pytree(point)
    return torque_loss(unflatten(start + scaling @ y), problem)
