"""Physically feasible inertias and friction by trajectory error: simulate the log and compare the motion."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.identify.chart import Chart, Coordinates, check_bodies, make_chart
from jaxdyn.identify.checkpoint import Watch
from jaxdyn.identify.descent import descend
from jaxdyn.identify.distances import entropic_residual
from jaxdyn.identify.gauss_newton import Unknowns
from jaxdyn.identify.logs import Log, as_logs, root_mean_square
from jaxdyn.identify.objectives import Objective
from jaxdyn.identify.optax_steps import METHODS, GradientSteps, Optimizer
from jaxdyn.identify.problem import Problem, loss_of, pose_problem
from jaxdyn.identify.regression import regressor
from jaxdyn.identify.replay import check_replay, simulation_options
from jaxdyn.identify.result import Fit
from jaxdyn.identify.torque_terms import Terms, check_terms
from jaxdyn.model.arguments import Checked
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


class _ChartTree(eqx.Module):
    """Parameter tree of a model's chart: its inertias and terms, with the divergence of the bodies as the prior.

    It has the methods of `jd.identify.Parameters` that a problem needs.
    """

    given: Model
    chart: Chart
    start_point: Coordinates

    @property
    def dtype(self) -> np.dtype:
        """Floating-point type of the coordinates."""
        return np.dtype(self.given.home.dtype)

    def point(self, y: Float[Array, " p"]) -> Coordinates:
        """Point in the chart of flat coordinates."""
        return ravel_pytree(self.start_point)[1](y)

    def system(self, y: Float[Array, " p"]) -> Scene:
        """Scene of the model and its friction at y."""
        model, friction = self.chart.model_at(self.given, self.point(y))
        has_friction = self.chart.terms or model.damping is not None or model.friction is not None
        return Scene(model, forces=(friction,) if has_friction else ())

    def residual(self, y: Float[Array, " p"]) -> Float[Array, " k"]:
        """Residuals of the prior, whose squares add up to the divergence of the bodies."""
        U = self.chart.relative_factors(self.point(y).theta)
        return jax.vmap(entropic_residual)(U).reshape(-1) if self.chart.bodies else jnp.zeros((0,), y.dtype)


def fit_trajectory(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = (),
    *,
    v_s: float = 0.01,
    inertia: str = "full",
    horizon: int | None = None,
    initial: str = "measured",
    hold: str = "linear",
    substeps: int | None = None,
    prior: float = 1e-6,
    method: Checked[str | Optimizer] = "lbfgs",
    steps: int = 200,
    learning_rate: float = 0.1,
    tolerance: float = 1e-9,
    devices: Sequence[Any] | None = None,
    callback: Callable[[int, float, Model], None] | None = None,
    **simulation: Any,
) -> Fit:
    r"""Physically feasible inertias and friction by the error of simulated motion, differentiated through `jd.simulate`.

    $$\min \operatorname{mean}\left( \frac{(q_\mathrm{sim} - q)^2}{q_\mathrm{rms}^2}
    + \frac{(v_\mathrm{sim} - v)^2}{v_\mathrm{rms}^2} \right) + \mathrm{prior} \cdot D$$

    over all samples and joints, where each segment of the log is simulated with the measured torques from its own start (multiple
    shooting), the denominators are the mean squares of each joint's motion in the log, and D is the divergence from the nominal
    bodies, as in `fit_torques`. Needs no accelerations. Short segments keep the problem close to convex and chaotic or unstable
    motion from diverging; long ones see small errors that add up.

    **Arguments:**

    - `model`: nominal model, where the fit starts; `log` with q, v and tau, or several such logs, all cut by `horizon`.
    - `terms`, `v_s`, `inertia`: as in `fit_torques`. A small v_s makes the simulation stiff.
    - `horizon`: steps of the log in a segment; None: the whole log is one.
    - `initial`: "measured" states start the segments; "free" ones are fitted too, for noisy measurements.
    - `hold`: torques between samples, "linear" or "previous" (a controller that holds its output).
    - `method`: "lbfgs", "adam" or an optax.GradientTransformation; `steps`, `learning_rate`, `tolerance`, `callback`
      as in `fit_torques`.
    - `substeps`: fixed steps between two samples (Tsit5 unless `solver` says otherwise); None: adaptive steps. Fixed
      steps end on every sample, where the torques have their kinks, and cost the same in every segment.
    - `devices`: some of `jax.devices()`, over which the segments are sharded, as many as divide their number; an iteration
      exchanges one all-reduce. None: one device.
    - `simulation`: options of `jd.simulate` (solver, stepsize, rtol, atol, adjoint, max_steps).

    **Returns:** `Fit`. Its `result` is "not_finite" when a simulation failed; the model is then the best before.

    **Raises:** ValueError when log and model do not fit together, and for arguments out of range.

    Source: Bock (1983), multiple shooting; output error methods, Ljung (1999), section 7.
    """
    check_bodies(model)
    logs = as_logs(log, model, needs=("v",))
    terms = check_terms(terms, v_s)
    check_replay(initial, hold)
    if isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; give one of {METHODS} or an optax.GradientTransformation")
    if not prior >= 0:
        raise ValueError(f"prior is {prior}; it must not be negative")
    q, v, tau, a = (np.concatenate(parts) for parts in zip(*map(_signals, logs), strict=True))
    rms = [root_mean_square(x) for x in (tau, v, a)]
    chart, point = make_chart(model, terms, v_s, inertia, *rms)
    tree = _ChartTree(model, chart, point)
    objective: Any = Objective("trajectory", hold, simulation_options(substeps, simulation))
    problem = pose_problem(tree, objective, logs, horizon, 0.0, devices)
    # The prior's weight in a problem is noise^2 / N.
    problem = dataclasses.replace(problem, noise=float(np.sqrt(prior * problem.divisor)))
    start = jnp.zeros((problem.count, 2, model.nv), tree.dtype) if initial == "free" else None
    unknowns = Unknowns(ravel_pytree(point)[0], start)
    z0, unflatten = ravel_pytree(unknowns)

    def report(step, value, z):
        if callback is not None:
            callback(step, value, chart.model_at(model, tree.point(unflatten(z).y))[0])

    method_steps = GradientSteps(
        loss_of,
        (problem, unknowns),
        method=method,
        steps=steps,
        learning_rate=learning_rate,
        tolerance=tolerance,
        scaling=lambda z: _scaling(problem, tree.point(unflatten(z).y), (q, v, a), z.size),
    )
    end = descend(method_steps, z0, Watch(steps, report))
    fitted, friction = chart.model_at(model, chart.clip_terms(tree.point(unflatten(end.best.point).y)))
    name = method if isinstance(method, str) else type(method).__name__
    return Fit(
        model=fitted,
        friction=friction,
        nominal=model,
        history=end.history,
        result=end.result,
        method=f"trajectory fit by {name}",
        terms=terms,
    )


def _signals(log: Log):
    """Signals q, v, tau and a of a log."""
    v, t = np.asarray(log.v, np.float64), np.asarray(log.t, np.float64)
    # Accelerations only set units and scaling here, for which differences of a noisy velocity are good enough.
    return log.q, log.v, log.tau, np.gradient(v, t, axis=0) if log.a is None else log.a


def _scaling(problem: Problem, point: Coordinates, signals, size: int) -> Float[Array, "n n"]:
    """Scaling S with S S^T about the inverse of the Hessian of the motion error.

    A change dx of the parameters changes the acceleration by -M^-1 Y dx at first, and the velocity by that times the time
    since the start of the segment. Directions without effect are scaled at most a thousand times.
    """
    tree: Any = problem.tree
    chart, span = tree.chart, float(problem.batches[0].t[0, -1])
    model, _ = chart.model_at(tree.given, point)
    count = len(signals[0])
    # The scaling is an estimate: some samples, evenly over all logs, bound its cost.
    few = np.linspace(0, count - 1, min(count, 200)).astype(int)
    q, v, a = (np.asarray(x, model.home.dtype)[few] for x in signals)
    effect = regressor(model, q, v, a, v_s=float(chart.v_s)) @ np.asarray(_parameter_jacobian(chart, point), np.float64)
    rows = np.linalg.solve(np.asarray(_mass_matrices(model, jnp.asarray(q)), np.float64), effect)
    # The root mean square of the time since the start, over a segment from 0 to span, is span / sqrt(3).
    rows *= span / np.sqrt(3) / np.asarray(problem.scale, np.float64)[1][:, None]
    rows = rows.reshape(-1, rows.shape[-1])
    values, vectors = np.linalg.eigh(2 * rows.T @ rows / len(rows))
    # 1e-6 in curvature is 1e-3 in length: a thousand times at most.
    values = np.maximum(values, 1e-6 * values.max(initial=1e-300))
    # Free initial states follow y in the flat vector and have units already.
    result = np.eye(size)
    result[: values.size, : values.size] = vectors / np.sqrt(values)
    return jnp.asarray(result, model.home.dtype)


@eqx.filter_jit
def _mass_matrices(model: Model, q):
    return jax.vmap(mass_matrix, (None, 0))(model, q)


@eqx.filter_jit
def _parameter_jacobian(chart: Chart, point: Coordinates):
    y, unflatten = ravel_pytree(point)
    return jax.jacfwd(lambda y: chart.parameters(unflatten(y)))(y)
