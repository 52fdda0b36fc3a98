"""Physically feasible inertias and friction by torque error."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.identify import interior
from jaxdyn.identify.chart import Chart, Coordinates, check_bodies, make_chart
from jaxdyn.identify.checkpoint import Watch
from jaxdyn.identify.condensed import Condensed, condense_rows
from jaxdyn.identify.descent import descend
from jaxdyn.identify.logs import Log, as_logs, root_mean_square
from jaxdyn.identify.optax_steps import METHODS, GradientSteps, Optimizer
from jaxdyn.identify.regression import check_weights, condense_model, noise_level
from jaxdyn.identify.result import Fit
from jaxdyn.identify.threads import on_one_thread
from jaxdyn.identify.torque_terms import TERMS, Terms, check_terms, coulomb_through_filter
from jaxdyn.model.arguments import Checked, Numbers
from jaxdyn.model.tree import Model

# Least torque noise as a share of the torque, so that noise-free logs stay well posed.
_FINEST = 1e-6
_STEPS = {"newton": 200, "lbfgs": 3000, "adam": 10000}


class Problem(eqx.Module):
    """Torque loss of a condensed log, |R x - d|^2 + rest over the variance, plus the prior."""

    chart: Chart
    R: Float[Array, "p p"]
    d: Float[Array, " p"]
    rest: Float[Array, ""]
    prior: Float[Array, ""]


def torque_loss(point: Coordinates, problem: Problem) -> Float[Array, ""]:
    """Loss 1/2 |W x(point) - tau|^2 / sigma^2 + prior * log-det divergence from the nominal bodies."""
    residual = problem.R @ problem.chart.parameters(point) - problem.d
    return 0.5 * (residual @ residual + problem.rest) + problem.prior * problem.chart.divergence(point.theta)


@on_one_thread
def fit_torques(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    inertia: str = "full",
    weights: Numbers | None = None,
    prior: float = 1.0,
    sigma: float | None = None,
    method: Checked[str | Optimizer] = "newton",
    steps: int | None = None,
    learning_rate: float = 0.1,
    tolerance: float = 1e-6,
    callback: Callable[[int, float, Model], None] | None = None,
) -> Fit:
    r"""Physically feasible inertias, friction and rotor inertia by the error of the joint torques along a log.

    $$\min_x \frac{|\mathrm{weights} (W x - \tau)|^2}{2 \sigma^2} + \mathrm{prior} \sum_i D(P_i, P_{0i}), \quad
    D(P, P_0) = \operatorname{tr}(P_0^{-1} P) - \log\det(P_0^{-1} P) - 4$$

    W is the regressor and D the log-det (entropic) divergence of a body's pseudo-inertia from the nominal one. It
    determines the combinations that torques do not, is the same in every frame and unit, and grows without bound towards
    the boundary of the feasible set. x is searched in coordinates in which every point is a feasible body with
    dissipative friction (`Chart`), so no iterate can be infeasible. The log is condensed once: a step costs the same for
    any log. Where `from_raw` low-passed a log, the column of Coulomb friction goes through the same low-pass.

    **Arguments:**

    - `model`: nominal model, where the fit starts; `log` with v and a, or several such logs.
    - `terms`: fitted in addition to the links, friction torques as of `Friction`, and armature a; viscous,
      coulomb and armature stay at or above zero. A term left out keeps the model's value.
    - `inertia`: "full", all ten numbers of each body; "mass", its density alone; "fixed".
    - `weights` (nv,): one over the noise of each joint's torque, relative to the others; ones by default.
    - `prior`: weight of the divergence; 1 counts it like one observation of each body. `sigma`: torque noise (N m);
      by default the residual of the unconstrained least squares.
    - `method`: "newton" (the loss is convex in x, and this finds its one minimum in some tens of steps), "lbfgs" or
      "adam" (optax), or any optax.GradientTransformation. `steps`: the most steps. `learning_rate`: of
      adam, a share of the step that the curvature predicts.
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
    coulomb = [coulomb_through_filter(one, v_s) for one in logs]
    blocks = condense_model(model, logs, v_s=v_s, coulomb=coulomb)
    condensed = condense_rows(blocks.rows(check_weights(weights, model.nv)), blocks.count())
    problem, point, sigma = make_problem(model, condensed, signal_sizes(logs), terms, v_s, inertia, prior, sigma)
    chart = problem.chart
    if method != "newton" and isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; give one of {('newton', *METHODS)} or an optax.GradientTransformation")
    limit = _STEPS.get(method, _STEPS["adam"]) if isinstance(method, str) else _STEPS["adam"]
    steps = limit if steps is None else steps
    if isinstance(method, str) and method == "newton":
        chart, point, history, result = newton(model, problem, point, steps, tolerance, callback)
    else:
        start, unflatten = ravel_pytree(point)

        def report(step, value, y):
            if callback is not None:
                callback(step, value, chart.model_at(model, unflatten(y))[0])

        steps_of_optax = GradientSteps(
            _flat_loss,
            (problem, point),
            method=method,
            steps=steps,
            learning_rate=learning_rate,
            tolerance=tolerance,
            scaling=lambda y: _whitening(problem, unflatten(y)),
        )
        end = descend(steps_of_optax, start, Watch(steps, report))
        history, result = end.history, end.result
        point = unflatten(end.best.point)
    fitted, friction = chart.model_at(model, chart.clip_terms(point))
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
        as_measured=True,
    )


def check_prior(prior) -> None:
    """Check the weight of the prior. **Raises:** ValueError for a prior that is not positive."""
    if not prior > 0:
        raise ValueError(f"prior is {prior}; it must be positive: torques alone do not determine single bodies")


def signal_sizes(logs: Sequence[Log]) -> list[np.ndarray]:
    """Root mean squares (nv,) of torque, velocity and acceleration over all logs."""
    return [
        root_mean_square(np.concatenate([np.asarray(getattr(log, name), np.float64) for log in logs]))
        for name in ("tau", "v", "a")
    ]


def make_problem(model: Model, condensed: Condensed, sizes, terms, v_s, inertia, prior, sigma=None):
    """Problem of condensed logs, the start, and the torque noise sigma (N m).

    `sizes`: of `signal_sizes`; the other arguments as in `fit_torques`.
    """
    sigma = torque_noise(condensed, sizes, sigma)
    chart, point = make_chart(model, terms, v_s, inertia, *sizes)
    dtype = np.dtype(model.home.dtype)
    numbers = (condensed.R / sigma, condensed.d / sigma, condensed.rest / sigma**2, prior)
    return Problem(chart, *(jnp.asarray(x, dtype) for x in numbers)), point, sigma


def torque_noise(condensed: Condensed, sizes, sigma: float | None = None) -> float:
    """Torque noise (N m): sigma where it is given, else the residual of the unconstrained least squares.

    **Raises:** ValueError for a sigma that is not positive, or not identifiable.
    """
    if sigma is None:
        sigma = max(noise_level(condensed), _FINEST * float(np.sqrt(np.mean(sizes[0] ** 2))))
    if not sigma > 0:
        raise ValueError(f"sigma is {sigma}; the torque noise must be positive (all torques of the log may be zero)")
    return float(sigma)


def newton(model: Model, problem: Problem, point: Coordinates, steps: int, tolerance: float, callback=None):
    """Minimise by `interior.newton`: chart moved to the minimum, point, history of the loss, result."""
    chart = problem.chart
    R, d = np.asarray(problem.R, np.float64), np.asarray(problem.d, np.float64)
    host = interior.TorqueProblem(chart, R, d, float(problem.rest), float(problem.prior))

    def watch(step, loss, origin, s):
        if callback is not None:
            there, at = move_origin(chart, origin, s)
            callback(step, loss, there.model_at(model, at)[0])

    # The host computes in float64, but R and d may have been rounded to float32.
    resolution = float(jnp.finfo(problem.R.dtype).eps)
    optimum = interior.newton(host, np.asarray(point.s), steps, tolerance, watch, resolution)
    return *move_origin(chart, optimum.origin, optimum.s), optimum.history, optimum.result


def move_origin(chart: Chart, origin: np.ndarray, s: np.ndarray) -> tuple[Chart, Coordinates]:
    """Move the origin of a chart: the chart and the point there."""
    size = {"full": 10, "mass": 1, "fixed": 0}[chart.inertia]
    dtype = chart.factors.dtype
    # With the origin at the fit theta is zero there; terms keep their coordinates s.
    chart = eqx.tree_at(lambda chart: chart.origin, chart, jnp.asarray(origin, dtype))
    return chart, Coordinates(jnp.zeros((len(chart.bodies), size), dtype), jnp.asarray(s, dtype))


def _whitening(problem: Problem, point: Coordinates):
    """S with S S^T the inverse of the Gauss-Newton Hessian of the loss."""
    values, vectors = np.linalg.eigh(np.asarray(_gauss_newton_hessian(problem, point), np.float64))
    # Terms that the log does not excite have no curvature, and far from the nominal bodies that of the prior can be negative.
    scaled = vectors / np.sqrt(np.maximum(values, float(problem.prior)))
    return jnp.asarray(scaled, problem.R.dtype)


@eqx.filter_jit
def _gauss_newton_hessian(problem: Problem, point: Coordinates):
    y, unflatten = ravel_pytree(point)
    rows = problem.R @ jax.jacfwd(lambda y: problem.chart.parameters(unflatten(y)))(y)
    curvature = jax.hessian(lambda y: problem.chart.divergence(unflatten(y).theta))(y)
    # Symmetrised, as eigh reads one triangle alone.
    return rows.T @ rows + problem.prior * (curvature + curvature.T) / 2


def _flat_loss(y, args):
    problem, point = args
    _, unflatten = ravel_pytree(point)
    return torque_loss(unflatten(y), problem)
