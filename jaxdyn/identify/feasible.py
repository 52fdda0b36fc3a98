"""Physically feasible inertias and friction by torque error."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.identify.chart import Chart, Coordinates, check_bodies, make_chart, positive_terms
from jaxdyn.identify.condensed import Condensed
from jaxdyn.identify.friction import TERMS, check_terms
from jaxdyn.identify.logs import Log, as_logs, root_mean_square
from jaxdyn.identify.minimise import METHODS, minimise
from jaxdyn.identify.progress import Watch
from jaxdyn.identify.regression import condense, free_columns, noise_level
from jaxdyn.identify.result import Fit
from jaxdyn.model import inertia as _inertia
from jaxdyn.model.tree import Model

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
    log: Log | Sequence[Log],
    terms=TERMS,
    *,
    v_s: float = 0.01,
    inertia: str = "full",
    weights=None,
    prior: float = 1.0,
    sigma: float | None = None,
    method: Any = "newton",
    steps: int | None = None,
    learning_rate: float = 0.1,
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

    - `model`: nominal model, where the fit starts; `log` with v and a, or several such logs.
    - `terms`: fitted beside the links, tau_f = viscous v + coulomb tanh(v / v_s) + offset, and armature a; viscous,
      coulomb and armature stay at or above zero. A term left out keeps the model's value.
    - `inertia`: "full", all ten numbers of each body; "mass", its density alone; "fixed".
    - `weights` (nv,): one over the noise of each joint's torque, relative to the others; ones by default.
    - `prior`: weight of the divergence; 1 counts it like one observation of each body. `sigma`: torque noise (N m);
      by default the residual of the unconstrained least squares.
    - `method`: "newton" (the loss is convex in x, and this finds its one minimum in some tens of steps), "lbfgs" or
      "adam" (optax), or any optax.GradientTransformation. `steps`: the most steps. `learning_rate`: of
      adam, a share of the way that the curvature foresees.
      `tolerance`: newton stops when the loss is within this of its minimum; lbfgs at this relative change in ten steps.
    - `callback(step, loss, model)`: called before every step with the model at that point.

    **Returns:** `Fit`.

    **Raises:** ValueError when log and model do not fit together, for nominal bodies that are not feasible, and for
    arguments out of range.

    Source: Rucker & Wensing (2022), log-Cholesky coordinates; Lee, Wensing & Park (2020), "Geometric robot dynamic
    identification: a convex programming approach", divergence and convexity.
    """
    check_bodies(model)
    logs = as_logs(log, model)
    terms = check_terms(terms, v_s)
    check_prior(prior)
    condensed = condense(model, logs, v_s=v_s, weights=weights)
    problem, point, sigma = make_problem(model, condensed, signal_sizes(logs), terms, v_s, inertia, prior, sigma)
    chart = problem.chart
    if method != "newton" and isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; take one of {('newton', *METHODS)} or an optax.GradientTransformation")
    limit = _STEPS.get(method, _STEPS["adam"]) if isinstance(method, str) else _STEPS["adam"]
    steps = limit if steps is None else steps
    if isinstance(method, str) and method == "newton":
        chart, point, history, result = newton(model, problem, point, steps, tolerance, callback)
    else:
        start, unflatten = ravel_pytree(point)

        def report(step, value, y):
            if callback is not None:
                callback(step, value, chart.fitted(model, unflatten(y))[0])

        y, history, result = minimise(
            _flat_loss,
            start,
            (problem, point),
            method=method,
            learning_rate=learning_rate,
            tolerance=tolerance,
            scaling=lambda y: _whitening(problem, unflatten(y)),
            watch=Watch(steps, report),
        )
        point = unflatten(y)
    fitted, friction = chart.fitted(model, chart.settled(point))
    name = method if isinstance(method, str) else type(method).__name__
    return Fit(
        model=fitted,
        friction=friction,
        nominal=model,
        history=history,
        result=result,
        method=f"torque fit by {name}",
        terms=terms,
        sigma=sigma,
    )


def check_prior(prior) -> None:
    """**Raises:** ValueError for a prior that is not positive."""
    if not prior > 0:
        raise ValueError(f"prior is {prior}; it must be positive: torques alone do not determine single bodies")


def signal_sizes(logs: Sequence[Log]) -> list[np.ndarray]:
    """Root mean squares (nv,) of torque, velocity and acceleration over all logs."""
    return [
        root_mean_square(np.concatenate([np.asarray(getattr(log, name), np.float64) for log in logs]))
        for name in ("tau", "v", "a")
    ]


def make_problem(model: Model, condensed: Condensed, sizes, terms, v_s, inertia, prior, sigma=None):
    """The problem of condensed logs, the point to start from, and the torque noise sigma (N m).

    `sizes` as `signal_sizes` gives them; the other arguments as in `fit_torques`.
    """
    if sigma is None:
        sigma = max(noise_level(condensed), _FINEST * float(np.sqrt(np.mean(sizes[0] ** 2))))
    if not sigma > 0:
        raise ValueError(f"sigma is {sigma}; the torque noise must be positive (all torques of the log may be zero)")
    chart, point = make_chart(model, terms, v_s, inertia, *sizes)
    dtype = np.dtype(model.home.dtype)
    numbers = (condensed.R / sigma, condensed.d / sigma, condensed.rest / sigma**2, prior)
    return Problem(chart, *(jnp.asarray(x, dtype) for x in numbers)), point, float(sigma)


_loss = eqx.filter_jit(torque_loss)


class _Dual(eqx.Module):
    """Multipliers: of a body's pseudo-inertia being positive definite, in the frame where that is 1, and of terms >= 0."""

    bodies: Float[Array, "bodies 4 4"]
    terms: Float[Array, " n"]


def newton(model: Model, problem: Problem, point: Coordinates, steps: int, tolerance: float, callback=None):
    """Primal-dual interior-point method: chart, point, history of the loss, result.

    The loss is min |R x - d|^2 / 2 + prior tr(P0^-1 P) with -prior log det P as the barrier that stays. The barrier starts as
    strong as the data, so that bodies are not pushed against the edge of what is feasible, and is released as fast as the
    complementarity of bodies and multipliers allows: down to the prior for the bodies, to nothing for the terms.
    """
    history, result = [], "max_steps"
    dtype = problem.R.dtype
    prior = float(problem.prior)
    inequalities = point.s.shape[1] * int(positive_terms(problem.chart.terms).sum())
    least = 0.1 * tolerance / max(inequalities, 1)
    gap = max(prior, float(_loss(point, problem)) / (4 * len(problem.chart.bodies) + max(inequalities, 1)))
    one = jnp.broadcast_to(jnp.eye(4, dtype=dtype), problem.chart.origin.shape)
    dual = _Dual(gap * one, jnp.full((point.s.size,), gap, dtype) / jnp.maximum(point.s.reshape(-1) ** 2, 1e-3))
    targets = gap, gap
    for step in range(steps + 1):
        weights = (jnp.asarray(target, dtype) for target in targets)
        value, decrement, gaps, length, origin, s, dual = _newton_step(problem, point, dual, *weights)
        history.append(float(value))
        if callback is not None:
            callback(step, history[-1], problem.chart.fitted(model, point)[0])
        if not np.isfinite(history[-1] + float(decrement)):
            result = "not_finite"
            break
        # Rounding of the loss limits how small a decrease can be seen.
        resolution = 10 * float(jnp.finfo(dtype).eps) * abs(history[-1])
        if targets == (prior, least) and float(decrement) / 2 <= max(tolerance, resolution):
            result = "converged"
            break
        if step < steps:
            problem = eqx.tree_at(lambda p: p.chart.origin, problem, origin)
            point = Coordinates(point.theta, s)
            # The longer the step was, the more of the barrier goes next; short steps are for getting back to the middle.
            share = min(max(0.02, (1 - float(length)) ** 2), 0.9)
            targets = max(prior, share * float(gaps[0])), max(least, share * float(gaps[1]))
    return problem.chart, point, np.array(history), result


@eqx.filter_jit
def _newton_step(problem: Problem, point: Coordinates, dual: _Dual, weight, barrier):
    """One step towards P Z = weight, terms * multipliers = barrier, and what it starts from.

    Steps go straight in x and stop short of the edge, P = A (1 + h S) A^T with A the factor now: a curved step would leave
    the narrow valley that a precise log makes. The equations are those of Newton's method on the loss with barriers, but the
    barrier's curvature is that of the multipliers, Z S + S Z, which already know where the edge is (Helmberg, Rendl,
    Vanderbei & Wolkowicz 1996; Nesterov & Nemirovskii 1994).

    **Returns:** loss, decrement, mean products with the multipliers, length of the step, then the origin, terms and
    multipliers after it.
    """
    chart, dtype = problem.chart, problem.R.dtype
    positive = jnp.broadcast_to(jnp.asarray(positive_terms(chart.terms)), point.s.shape).reshape(-1)
    start = point.s.reshape(-1)
    terms = jnp.where(positive, start**2, start)
    inverse = jnp.where(positive, 1 / jnp.where(positive, terms, 1), 0)
    multiplier = jnp.where(positive, dual.terms, 0)
    count, size = point.theta.shape
    nb, nv = chart.nominal_inertias.shape[0], chart.nominal_terms.shape[1]

    inertial = jax.jacfwd(lambda theta: chart.inertias(theta).reshape(-1))(point.theta).reshape(10 * nb, count * size)
    places = free_columns(nb, nv, chart.terms)[10 * nb :]
    rows = [problem.R[:, : 10 * nb] @ inertial, problem.R[:, places] * chart.scale.reshape(1, -1)]
    rows = jnp.concatenate(rows, axis=1)
    basis = stretches(size, dtype)
    traces = jnp.trace(basis, axis1=1, axis2=2)
    # prior tr(P0^-1 P) is what remains of the divergence without its log det.
    slope = problem.prior * (jax.grad(chart.divergence)(point.theta) + traces[None]) - weight * traces[None]
    gradient = rows.T @ (problem.R @ chart.parameters(point) - problem.d)
    gradient = gradient + jnp.append(slope.reshape(-1), -barrier * inverse)
    curvature = jnp.einsum("kij,bjm,lmi->bkl", basis, dual.bodies, basis)
    blocks = jnp.einsum("bkl,bc->bkcl", curvature, jnp.eye(count, dtype=dtype)).reshape(count * size, count * size)
    hessian = rows.T @ rows + jax.scipy.linalg.block_diag(blocks, jnp.diag(multiplier * inverse))
    diagonal = jnp.diagonal(hessian)
    unit = jnp.sqrt(jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
    damping = 4 * jnp.finfo(dtype).eps * jnp.eye(unit.size, dtype=dtype)
    factor = jax.scipy.linalg.cho_factor(hessian / (unit[:, None] * unit[None, :]) + damping)
    direction = -jax.scipy.linalg.cho_solve(factor, gradient / unit) / unit

    one = jnp.eye(4, dtype=dtype)[None]
    stretch = jnp.einsum("bk,kij->bij", direction[: count * size].reshape(count, size), basis)
    change = direction[count * size :]
    product = dual.bodies @ stretch
    dual_stretch = weight * one - dual.bodies - (product + jnp.swapaxes(product, 1, 2)) / 2
    dual_change = jnp.where(positive, (barrier - multiplier * change) * inverse - multiplier, 0)

    length = _length(jnp.linalg.eigvalsh(stretch), change * inverse)
    roots = jax.vmap(_upper_root)(dual.bodies)
    relative = jax.vmap(lambda root, step: jax.scipy.linalg.solve(root, jax.scipy.linalg.solve(root, step).T))(
        roots, dual_stretch
    )
    dual_length = _length(
        jnp.linalg.eigvalsh((relative + jnp.swapaxes(relative, 1, 2)) / 2),
        dual_change / jnp.where(positive, multiplier, 1),
    )
    roots = jax.vmap(_upper_root)(one + length * stretch)
    bodies = dual.bodies + dual_length * dual_stretch
    moved = _Dual(jnp.swapaxes(roots, 1, 2) @ bodies @ roots, multiplier + dual_length * dual_change)
    following = terms + length * change
    s = jnp.where(positive, jnp.sqrt(jnp.where(positive, following, 1)), following)
    # Mean products of what must stay positive and its multipliers.
    gaps = (
        jnp.sum(jnp.trace(moved.bodies, axis1=1, axis2=2)) / max(4 * count, 1),
        jnp.sum(jnp.where(positive, moved.terms * following, 0)) / max(int(positive_terms(chart.terms).sum()) * nv, 1),
    )
    origin = jnp.einsum("bij,bjk->bik", chart.origin, roots)
    value, decrement = torque_loss(point, problem), -(gradient @ direction)
    return value, decrement, gaps, jnp.minimum(length, dual_length), origin, s.reshape(point.s.shape), moved


def _length(*rates):
    """Longest step up to 1 that leaves a twentieth of everything that shrinks at these rates."""
    fastest = jnp.min(jnp.concatenate([rate.reshape(-1) for rate in rates]), initial=0)
    return jnp.minimum(1, -0.95 / jnp.minimum(fastest, -0.95))


def stretches(size: int, dtype) -> Float[Array, "size 4 4"]:
    """Derivatives of U U^T by the coordinates of a body, at the chart's origin.

    Traces of their products are the curvature of the divergence along straight lines in x: tr(P^-1 dP P^-1 dP).
    """
    basis = jax.vmap(_linear_factor)(jnp.eye(size, dtype=dtype))
    return basis + jnp.swapaxes(basis, 1, 2)


def _linear_factor(step):
    """Derivative of `log_cholesky_factor` at zero along a step (10,), or along its first number (1,)."""
    step = jnp.append(step, jnp.zeros((10 - step.size,), step.dtype))
    return jax.jvp(_inertia.log_cholesky_factor, (jnp.zeros_like(step),), (step,))[1]


def _upper_root(matrix):
    """Upper-triangular U with U U^T = matrix; NaN when it is not positive definite."""
    return jnp.linalg.cholesky(matrix[::-1, ::-1])[::-1, ::-1]


@eqx.filter_jit
def _whitening(problem: Problem, point: Coordinates):
    """S with S S^T the inverse of the Gauss-Newton Hessian of the loss."""
    y, unflatten = ravel_pytree(point)
    rows = problem.R @ jax.jacfwd(lambda y: problem.chart.parameters(unflatten(y)))(y)
    bent = jax.hessian(lambda y: problem.chart.divergence(unflatten(y).theta))(y)
    values, vectors = jnp.linalg.eigh(rows.T @ rows + problem.prior * (bent + bent.T) / 2)
    # Terms that the log does not show have no curvature, and far from the nominal bodies that of the prior can be negative.
    return vectors / jnp.sqrt(jnp.maximum(values, problem.prior))[None, :]


def _flat_loss(y, args):
    problem, point = args
    _, unflatten = ravel_pytree(point)
    return torque_loss(unflatten(y), problem)
