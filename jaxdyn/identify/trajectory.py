"""Physically feasible inertias and friction by trajectory error: simulate the log and compare the motion."""

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
from jaxdyn.identify.divided import shared_out, summed
from jaxdyn.identify.friction import Terms, check_terms
from jaxdyn.identify.logs import Log, as_logs, root_mean_square
from jaxdyn.identify.minimise import METHODS, Optimizer, minimise
from jaxdyn.identify.progress import Watch
from jaxdyn.identify.regression import regressor
from jaxdyn.identify.replay import (
    Segments,
    check_replay,
    check_spacing,
    motion_errors,
    motion_scale,
    segments,
    simulate_segment,
    simulation_options,
    spaced,
)
from jaxdyn.identify.result import Fit
from jaxdyn.model.arguments import Checked
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


class _Unknowns(eqx.Module):
    """What is searched: coordinates of the model, and corrections of the initial states (segments, 2, nv), or None."""

    point: Coordinates
    start: Float[Array, "segments 2 nv"] | None


class _Problem(eqx.Module):
    model: Model
    chart: Chart
    data: Segments
    scale: Float[Array, "2 nv"]
    prior: Float[Array, ""]
    hold: str = eqx.field(static=True)
    options: Any
    mesh: Any = eqx.field(static=True)


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
    """Physically feasible inertias and friction by the error of simulated motion, differentiated through `jd.simulate`.

    Minimises mean(((q_sim - q) / q_rms)^2 + ((v_sim - v) / v_rms)^2) + prior * D, over all samples and joints, where
    each segment of the log is simulated with the measured torques from its own start (multiple shooting), q_rms and
    v_rms are the root mean squares of each joint's motion in the log, and D is the divergence from the nominal bodies, as
    in `fit_torques`. Needs no accelerations. Short segments keep the problem close to convex and chaotic or unstable
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
    - `devices`: some of `jax.devices()`, among which the segments are shared, by as many of them as can have equally many; an
      iteration exchanges one all-reduce. None: one device.
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
        raise ValueError(f"method is {method!r}; take one of {METHODS} or an optax.GradientTransformation")
    if not prior >= 0:
        raise ValueError(f"prior is {prior}; it must not be negative")
    options = simulation_options(substeps, simulation)
    dtype = np.dtype(model.home.dtype)
    data = segments(logs, horizon, dtype)
    options = spaced(options, data)
    check_spacing(options, devices)
    data, mesh = shared_out(data, devices)
    q, v, tau, a = (np.concatenate(parts) for parts in zip(*map(_signals, logs), strict=True))
    rms = [root_mean_square(x) for x in (tau, v, a)]
    chart, point = make_chart(model, terms, v_s, inertia, *rms)
    start = jnp.zeros((data.q.shape[0], 2, model.nv), dtype) if initial == "free" else None
    problem = _Problem(model, chart, data, motion_scale(model, data), jnp.asarray(prior, dtype), hold, options, mesh)
    unknowns = _Unknowns(point, start)
    y0, unflatten = ravel_pytree(unknowns)

    def report(step, value, y):
        if callback is not None:
            callback(step, value, chart.fitted(model, unflatten(y).point)[0])

    y, history, result = minimise(
        _flat_loss,
        y0,
        (problem, unknowns),
        method=method,
        learning_rate=learning_rate,
        tolerance=tolerance,
        scaling=lambda y: _scaling(problem, unflatten(y).point, (q, v, a), y.size),
        watch=Watch(steps, report),
    )
    fitted, friction = chart.fitted(model, chart.settled(unflatten(y).point))
    name = method if isinstance(method, str) else type(method).__name__
    return Fit(
        model=fitted,
        friction=friction,
        nominal=model,
        history=history,
        result=result,
        method=f"trajectory fit by {name}",
        terms=terms,
    )


def _signals(log: Log):
    """q, v, tau and a of a log."""
    v, t = np.asarray(log.v, np.float64), np.asarray(log.t, np.float64)
    return log.q, log.v, log.tau, np.gradient(v, t, axis=0) if log.a is None else log.a


def _flat_loss(y, args):
    problem, unknowns = args
    _, unflatten = ravel_pytree(unknowns)
    estimate = unflatten(y)
    chart, data = problem.chart, problem.data
    whole = data.v.size
    # Everything but the segments is known to all devices.
    rest = eqx.tree_at(lambda problem: problem.data, problem, None)

    def squares(searched, known):
        (point, start), (problem, data) = searched, known
        model, friction = chart.fitted(problem.model, point)
        has_friction = chart.terms or model.damping is not None or model.friction is not None
        scene = Scene(model, forces=(friction,) if has_friction else ())

        def errors(one, change):
            change = None if change is None else change * problem.scale
            q, v = simulate_segment(scene, one, change, problem.hold, problem.options)
            return motion_errors(model, one, q, v, problem.scale)

        return sum(jnp.sum(error**2) for error in jax.vmap(errors)(data, start)) / whole

    error = summed(squares, problem.mesh)((estimate.point, estimate.start), (rest, data))
    return error + problem.prior * chart.divergence(estimate.point.theta)


def _scaling(problem: _Problem, point: Coordinates, signals, size: int) -> Float[Array, "n n"]:
    """S with S S^T about the inverse of the Hessian of the motion error.

    A change dx of the parameters changes the acceleration by -M^-1 Y dx at first, and the velocity by that times the time
    since the segment began. Directions without effect are stretched at most a thousand times.
    """
    chart, span = problem.chart, float(problem.data.t[0, -1])
    model, _ = chart.fitted(problem.model, point)
    count = len(signals[0])
    few = np.linspace(0, count - 1, min(count, 200)).astype(int)
    q, v, a = (np.asarray(x, model.home.dtype)[few] for x in signals)
    effect = regressor(model, q, v, a, v_s=float(chart.v_s)) @ np.asarray(_parameter_jacobian(chart, point), np.float64)
    rows = np.linalg.solve(np.asarray(_mass_matrices(model, jnp.asarray(q)), np.float64), effect)
    rows *= span / np.sqrt(3) / np.asarray(problem.scale, np.float64)[1][:, None]
    rows = rows.reshape(-1, rows.shape[-1])
    values, vectors = np.linalg.eigh(2 * rows.T @ rows / len(rows))
    values = np.maximum(values, 1e-6 * values.max(initial=1e-300))
    result = np.eye(size)
    result[: values.size, : values.size] = vectors / np.sqrt(values)
    return jnp.asarray(result, problem.prior.dtype)


@eqx.filter_jit
def _mass_matrices(model: Model, q):
    return jax.vmap(mass_matrix, (None, 0))(model, q)


@eqx.filter_jit
def _parameter_jacobian(chart: Chart, point: Coordinates):
    y, unflatten = ravel_pytree(point)
    return jax.jacfwd(lambda y: chart.parameters(unflatten(y)))(y)
