"""Physically feasible inertias and friction by trajectory error: simulate the log and compare the motion."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxdyn.dynamics import mass_matrix
from jaxdyn.identify.chart import Chart, Coordinates, make_chart
from jaxdyn.identify.friction import Friction, check_terms
from jaxdyn.identify.logs import Log, check_log, root_mean_square
from jaxdyn.identify.minimise import METHODS, minimise
from jaxdyn.identify.regression import regressor
from jaxdyn.identify.result import Fit
from jaxdyn.model import Model, difference, integrate
from jaxdyn.scene import Scene
from jaxdyn.simulate import simulate

HOLDS = ("linear", "previous")
INITIAL = ("measured", "free")


class SampledTorque(eqx.Module):
    """A control that replays torques: linear between the samples, or held from each sample to the next ("previous").

    `t` (n,) s; `tau` (n, nv) N m.
    """

    t: Float[Array, " n"]
    tau: Float[Array, "n nv"]
    hold: str = eqx.field(static=True, default="linear")

    def __call__(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t) -> Float[Array, " nv"]:
        last = self.t.shape[0] - 2
        i = jnp.clip(jnp.searchsorted(self.t, t, side="right") - 1, 0, last)
        if self.hold == "previous":
            return self.tau[i]
        share = jnp.clip((t - self.t[i]) / (self.t[i + 1] - self.t[i]), 0, 1)
        return self.tau[i] + share * (self.tau[i + 1] - self.tau[i])


class Segments(eqx.Module):
    """A log cut into segments that are simulated side by side; each starts on the last sample of the one before."""

    t: Float[Array, "segments n"]
    q: Float[Array, "segments n nq"]
    v: Float[Array, "segments n nv"]
    tau: Float[Array, "segments n nv"]


def segments(log: Log, horizon: int | None, dtype) -> Segments:
    """Cut a log into segments of `horizon` steps (None: one segment); samples left over at the end are not used.

    Time starts at zero in each.

    **Raises:** ValueError for a log without velocities or a horizon that does not fit.
    """
    if log.v is None:
        raise ValueError(
            "the log has no v; a simulation starts from velocities: measure them or use jd.identify.from_raw"
        )
    horizon = len(log) - 1 if horizon is None else int(horizon)
    if not 1 <= horizon <= len(log) - 1:
        raise ValueError(f"horizon={horizon} steps; a log of {len(log)} samples allows 1 to {len(log) - 1}")
    count = (len(log) - 1) // horizon
    rows = np.arange(count)[:, None] * horizon + np.arange(horizon + 1)
    t = np.asarray(log.t, np.float64)[rows]
    parts = (t - t[:, :1], *(np.asarray(x)[rows] for x in (log.q, log.v, log.tau)))
    return Segments(*(jnp.asarray(part, dtype) for part in parts))


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


def fit_trajectory(
    model: Model,
    log: Log,
    terms=(),
    *,
    v_s: float = 0.01,
    inertia: str = "full",
    horizon: int | None = None,
    initial: str = "measured",
    hold: str = "linear",
    substeps: int | None = None,
    prior: float = 1e-6,
    method: Any = "lbfgs",
    steps: int = 200,
    learning_rate: float = 0.1,
    tolerance: float = 1e-9,
    callback: Callable[[int, float, Model], None] | None = None,
    **simulation,
) -> Fit:
    """Physically feasible inertias and friction by the error of simulated motion, differentiated through `jd.simulate`.

    Minimises mean(((q_sim - q) / q_rms)^2 + ((v_sim - v) / v_rms)^2) + prior * D, over all samples and joints, where
    each segment of the log is simulated with the measured torques from its own start (multiple shooting), q_rms and
    v_rms are the root mean squares of each joint's motion in the log, and D is the divergence from the nominal bodies, as
    in `fit_torques`. Needs no accelerations. Short segments keep the problem close to convex and chaotic or unstable
    motion from diverging; long ones see small errors that add up.

    **Arguments:**

    - `model`: nominal model, where the fit starts; `log` with q, v and tau.
    - `terms`, `v_s`, `inertia`: as in `fit_torques`. A small v_s makes the simulation stiff.
    - `horizon`: steps of the log in a segment; None: the whole log is one.
    - `initial`: "measured" states start the segments; "free" ones are fitted too, for noisy measurements.
    - `hold`: torques between samples, "linear" or "previous" (a controller that holds its output).
    - `method`: "lbfgs", "adam" or an optax.GradientTransformation; `steps`, `learning_rate`, `tolerance`, `callback`
      as in `fit_torques`.
    - `substeps`: fixed steps between two samples (Tsit5 unless `solver` says otherwise); None: adaptive steps. Fixed
      steps end on every sample, where the torques have their kinks, and cost the same in every segment.
    - `simulation`: options of `jd.simulate` (solver, stepsize, rtol, atol, adjoint, max_steps).

    **Returns:** `Fit`. Its `result` is "not_finite" when a simulation failed; the model is then the best before.

    **Raises:** ValueError when log and model do not fit together, and for arguments out of range.

    Source: Bock (1983), multiple shooting; output error methods, Ljung (1999), section 7.
    """
    check_log(log, model, needs=("v",))
    terms = check_terms(terms, v_s)
    for name, value, allowed in (("initial", initial, INITIAL), ("hold", hold, HOLDS)):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}; take one of {allowed}")
    if isinstance(method, str) and method not in METHODS:
        raise ValueError(f"method is {method!r}; take one of {METHODS} or an optax.GradientTransformation")
    if not prior >= 0:
        raise ValueError(f"prior is {prior}; it must not be negative")
    options = _options(substeps, simulation)
    dtype = np.dtype(model.home.dtype)
    data = segments(log, horizon, dtype)
    a = np.gradient(np.asarray(log.v, np.float64), np.asarray(log.t, np.float64), axis=0) if log.a is None else log.a
    rms = [root_mean_square(x) for x in (log.tau, log.v, a)]
    chart, point = make_chart(model, terms, v_s, inertia, *rms)
    start = jnp.zeros((data.q.shape[0], 2, model.nv), dtype) if initial == "free" else None
    problem = _Problem(model, chart, data, _motion_scale(model, data), jnp.asarray(prior, dtype), hold, options)
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
        steps=steps,
        learning_rate=learning_rate,
        tolerance=tolerance,
        scaling=lambda y: _scaling(problem, unflatten(y).point, log, a, y.size),
        callback=report,
    )
    fitted, friction = chart.fitted(model, chart.settled(unflatten(y).point))
    name = method if isinstance(method, str) else type(method).__name__
    return Fit(fitted, friction, model, history, result, f"trajectory fit by {name}", terms)


def rollout(
    model: Model,
    log: Log,
    friction: Friction | None = None,
    *,
    horizon=None,
    hold="linear",
    substeps=None,
    **simulation,
):
    """Simulate a log's segments with its torques from its measured states: q (segments, n, nq) and v (segments, n, nv).

    Arguments as in `fit_trajectory`.
    """
    data = segments(log, horizon, np.dtype(model.home.dtype))
    return _rollout(model, friction, data, None, hold, _options(substeps, simulation))


def trajectory_error(
    model: Model,
    log: Log,
    friction: Friction | None = None,
    *,
    horizon=None,
    hold="linear",
    substeps=None,
    **simulation,
):
    """Error of the simulated motion along a log, of positions and of velocities, each in per cent of the motion.

    100 sqrt(mean(((q_sim - q) / q_rms)^2)), and the same of v. Arguments as in `fit_trajectory`.
    """
    data = segments(log, horizon, np.dtype(model.home.dtype))
    q, v = _rollout(model, friction, data, None, hold, _options(substeps, simulation))
    errors = _scaled_errors(model, data, q, v, _motion_scale(model, data))
    return tuple(100 * float(jnp.sqrt(jnp.mean(error**2))) for error in errors)


def _options(substeps, simulation: dict) -> dict:
    if substeps is None:
        return dict(simulation)
    if isinstance(substeps, bool) or not isinstance(substeps, int) or substeps < 1:
        raise ValueError(f"substeps is {substeps!r}; give a positive integer, or None for adaptive steps")
    if "stepsize" in simulation:
        raise ValueError("substeps and stepsize both say how to step; give one of them")
    return {"solver": diffrax.Tsit5(), "substeps": substeps} | simulation


@eqx.filter_jit
def _rollout(model, friction, data: Segments, start, hold: str, options):
    scene = Scene(model, forces=() if friction is None else (friction,))

    def one(t, q, v, tau, change):
        given = dict(options)
        substeps = given.pop("substeps", None)
        if substeps is not None:
            shares = jnp.arange(substeps, dtype=t.dtype) / substeps
            steps = t[:-1, None] + (t[1:] - t[:-1])[:, None] * shares[None, :]
            given.setdefault("max_steps", steps.size + 1)
            given["stepsize"] = diffrax.StepTo(ts=jnp.append(steps.reshape(-1), t[-1]))
        q0, v0 = (q[0], v[0]) if change is None else (integrate(model, q[0], change[0]), v[0] + change[1])
        motion = simulate(scene, q0, v0, t, control=SampledTorque(t, tau, hold), throw=False, **given)
        return motion.q, motion.v

    return jax.vmap(one)(data.t, data.q, data.v, data.tau, start)


def _flat_loss(y, args):
    problem, unknowns = args
    _, unflatten = ravel_pytree(unknowns)
    found = unflatten(y)
    chart, data = problem.chart, problem.data
    model, friction = chart.fitted(problem.model, found.point)
    has_friction = chart.terms or model.damping is not None or model.friction is not None
    change = None if found.start is None else found.start * problem.scale
    q, v = _rollout(model, friction if has_friction else None, data, change, problem.hold, problem.options)
    errors = _scaled_errors(model, data, q, v, problem.scale)
    return sum(jnp.mean(error**2) for error in errors) + problem.prior * chart.divergence(found.point.theta)


def _scaled_errors(model, data: Segments, q, v, scale):
    far = jax.vmap(jax.vmap(lambda a, b: difference(model, a, b)))(data.q, q)
    return far / scale[0][None, None], (v - data.v) / scale[1][None, None]


def _motion_scale(model, data: Segments) -> Float[Array, "2 nv"]:
    """Root mean square of each coordinate's way from the first sample, and of its velocity; the largest at rest."""
    way = jax.vmap(jax.vmap(lambda q: difference(model, data.q[0, 0], q)))(data.q)
    scale = jnp.stack([jnp.sqrt(jnp.mean(x**2, axis=(0, 1))) for x in (way, data.v)])
    largest = jnp.max(scale, axis=1, keepdims=True)
    return jnp.where(scale > 1e-3 * largest, scale, jnp.where(largest > 0, largest, jnp.ones_like(largest)))


def _scaling(problem: _Problem, point: Coordinates, log: Log, a, size: int) -> Float[Array, "n n"]:
    """S with S S^T about the inverse of the Hessian of the motion error.

    A change dx of the parameters changes the acceleration by -M^-1 Y dx at first, and the velocity by that times the time
    since the segment began. Directions without effect are stretched at most a thousand times.
    """
    chart, span = problem.chart, float(problem.data.t[0, -1])
    model, _ = chart.fitted(problem.model, point)
    few = np.linspace(0, len(log) - 1, min(len(log), 200)).astype(int)
    q, v, a = (np.asarray(x, model.home.dtype)[few] for x in (log.q, log.v, a))
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
