"""Exciting motions: periodic, within limits, with information about the parameters maximised by gradient descent."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.dynamics.quantities import inverse_dynamics, torque_regressor
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.descent import Watch, descend
from jaxdyn.identify.logs import Log
from jaxdyn.identify.methods import GradientSteps
from jaxdyn.identify.regression import base_parameters, free_columns
from jaxdyn.identify.torque_terms import TERMS, Terms, check_terms, friction_regressor
from jaxdyn.identify.workflows.excitation import FourierMotion, random_motion
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model

OBJECTIVES = ("logdet", "condition")
# Range and speed of a joint without limits of its own (rad, rad/s).
_TURN, _SPEED = np.pi, 2.0
# 100 samples are 20 in a period of the fifth harmonic, the default; peaks are checked on a finer grid.
_SAMPLES, _CHECKED = 100, 1000


class Excitation(NamedTuple):
    """Result of `exciting_motion`.

    - `motion`: a `FourierMotion`, called as motion(t) -> (q, v, a), (nq,) each, at a time t, s: position, velocity and
      acceleration (rad or m, per s, per s^2). It starts and ends at rest at its centre every `motion.period` (s), within all
      limits. `log` samples it with the torques.
    - `condition`: of the regressor in base parameters, columns of unit length, along it; `start_condition`: along the random
      motion at the start of the search, within the same limits.
    - `logdet`: natural logarithm of the determinant of the information matrix, over that of the start.
    - `history`: of the loss.
    - `used`: largest share of position, velocity and torque limits that any joint uses (at most 1).
    - `result`: one of `jd.RESULTS`, `max_steps_reached` where all steps of the search were made, `stopped` where the callback
      ended it, `nonfinite` where a derivative was not finite. No code says that the motion is the best one.
    """

    motion: FourierMotion
    model: Model
    condition: float
    start_condition: float
    logdet: float
    history: np.ndarray
    used: dict[str, float]
    result: Any

    def log(self, rate: float = 100.0, periods: int = 1) -> Log:
        """Log of the motion at so many samples a second with the torques of the nominal model, for a controller or a file."""
        period = float(self.motion.period)
        count = round(period * rate * periods) + 1
        t = np.linspace(0, period * periods, count)
        signals = _signals(self.motion, self.model, jnp.asarray(t, self.model.home.dtype))
        q, v, a, tau = (np.asarray(x, np.float64) for x in signals)
        return Log(t, q, v, a, tau, joint_names=self.model.joint_names)


class _Limits(eqx.Module):
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    speed: Float[Array, " n"]
    torque_limit: Float[Array, " n"]


class _Task(eqx.Module):
    """Arguments of the loss other than the motion."""

    model: Model
    limits: _Limits
    times: Float[Array, " samples"]
    scale: Float[Array, " p"]
    weights: Float[Array, " nv"]
    v_s: Float[Array, ""]


def exciting_motion(
    model: Model,
    terms: Terms = TERMS,
    *,
    period: float = 10.0,
    harmonics: int = 5,
    objective: str = "logdet",
    margin: float = 0.9,
    velocity: Numbers | None = None,
    torque: Numbers | None = None,
    v_s: float = 0.1,
    seed: int = 0,
    starts: int = 8,
    steps: int = 300,
    learning_rate: float = 0.02,
    callback: Callable[[int, float], Any] | None = None,
) -> Excitation:
    """Optimise a finite Fourier series of every joint for the identification of the base parameters, within the robot's limits.

    The best of some random motions is improved by Adam with exact gradients of the information matrix $W^T W$, where W is the
    regressor in base parameters, rows over the torque limits and columns over their lengths along the start. Excess over a limit
    of position, velocity or torque has a quadratic penalty during the search; at the end the amplitudes shrink until there is
    none.

    **Arguments:**

    - `model`: with one coordinate a joint; its own limits hold where it has them. `terms`: to be identified with the bodies.
    - `period` (s), `harmonics` (at least 2): of the series.
    - `objective`: "logdet", the volume of all uncertainty (D-optimal), or "condition", the worst against the best direction.
    - `margin`: usable share of all limits. `velocity`, `torque` (nv,): limits instead of the model's, rad/s and N m.
    - `v_s`: smoothing velocity of Coulomb friction while searching; larger than the fit's, so that the gradient is not zero
      almost everywhere.
    - `seed`, `starts`: of the random motions. `steps`, `learning_rate`: of Adam.
    - `callback(step, loss)`: before every step and at the end; True stops the search.

    **Returns:** `Excitation`. Collisions with the ground, or of the robot with itself, are not checked: view the motion first
    (`jd.animate`).

    **Raises:** ValueError for joints of several coordinates, arguments out of range, and where the torque limits cannot
    hold the robot at its centre.

    Source: Swevers et al. (1997), "Optimal robot excitation and identification"; Park (2006), "Fourier-based optimal excitation
    trajectories for the dynamic identification of robots".
    """
    check_bodies(model)
    terms = check_terms(terms, v_s)
    if model.nq != model.nv:
        raise ValueError(
            f"model has nq={model.nq}, nv={model.nv}; exciting motions are for joints with one coordinate each"
        )
    if objective not in OBJECTIVES:
        raise ValueError(f"objective is {objective!r}; give one of {OBJECTIVES}")
    for name, value, good in (
        ("period", period, period > 0),
        ("harmonics", harmonics, harmonics >= 2),
        ("margin", margin, 0 < margin <= 1),
        ("starts", starts, starts >= 1),
        ("steps", steps, steps >= 1),
    ):
        if not good:
            raise ValueError(f"{name} is {value!r}; give " + {"margin": "a share in (0, 1]", "harmonics": "at least 2"}.get(
                name, "a positive number"))  # fmt: skip
    dtype = model.home.dtype
    limits = _limits(model, margin, velocity, torque)
    center = (limits.lower + limits.upper) / 2
    # Two standard deviations reach from the middle to the limits.
    size = np.asarray(limits.upper - limits.lower) / 4
    columns = free_columns(model.nb, model.nv, terms)[base_parameters(model, terms).independent]
    # Without the end of the period, which repeats its first sample.
    times = jnp.asarray(np.arange(_SAMPLES) * period / _SAMPLES, dtype)
    weights = 1 / limits.torque_limit
    task = _Task(model, limits, times, jnp.ones(len(columns), dtype), weights, jnp.asarray(v_s, dtype))

    keys = jax.random.split(jax.random.key(seed), starts)
    speed = 2 * np.pi / period * np.asarray(size)
    share = np.minimum(1.0, 0.5 * np.asarray(limits.speed) / np.where(speed > 0, speed, 1))
    motions = [random_motion(key, center, size * share, period=period, harmonics=harmonics) for key in keys]
    motions = [_shrink(motion, task) for motion in motions]
    lengths = [np.linalg.norm(_rows(motion, task, tuple(columns.tolist())), axis=0) for motion in motions]
    # One scale for all starts makes their losses comparable.
    task = eqx.tree_at(lambda t: t.scale, task, jnp.asarray(np.where(lengths[0] > 0, lengths[0], 1), dtype))
    places = tuple(columns.tolist())
    first = [float(_loss(_amplitudes(motion), motion, task, places, objective)) for motion in motions]
    motion = motions[int(np.argmin(np.where(np.isfinite(first), first, np.inf)))]

    excitation, history, result = _descend(motion, task, places, objective, steps, learning_rate, callback)
    excitation = _shrink(excitation, task)
    before, after = (np.asarray(_rows(m, task, places), np.float64) for m in (motion, excitation))
    scale = np.asarray(task.scale, np.float64)
    ratio = [np.linalg.slogdet((W / scale).T @ (W / scale))[1] for W in (before, after)]
    return Excitation(
        excitation,
        model,
        _condition(after),
        _condition(before),
        float(ratio[1] - ratio[0]),
        history,
        _limit_shares(excitation, task),
        result,
    )


def _limits(model: Model, margin: float, velocity, torque) -> _Limits:
    n, dtype = model.nv, model.home.dtype

    def of(value, otherwise):
        numbers = (
            np.full(n, otherwise) if value is None else np.broadcast_to(np.asarray(value, np.float64), (n,)).copy()
        )
        return np.where(np.isfinite(numbers), numbers, otherwise)

    start = np.asarray(neutral(model), np.float64)
    lower, upper = of(model.lower, -np.inf), of(model.upper, np.inf)
    lower = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper, start) - _TURN)
    upper = np.where(np.isfinite(upper), upper, lower + 2 * _TURN)
    middle, half = (lower + upper) / 2, margin * (upper - lower) / 2
    speed = margin * of(model.velocity_limit if velocity is None else velocity, _SPEED)
    torque_limit = margin * of(model.effort_limit if torque is None else torque, np.inf)
    for name, value in (("velocity", speed), ("torque", torque_limit), ("the range of positions", half)):
        if not np.all(value > 0):
            raise ValueError(f"{name} has limits {value.tolist()}; they must be positive")
    # Without torque limits the weight sets the scale of the torques.
    if not np.isfinite(torque_limit).all():
        mass = float(np.asarray(model.inertias)[:, 0].sum())
        torque_limit = np.where(np.isfinite(torque_limit), torque_limit, 1e3 * max(mass, 1e-3))
    arrays = (middle - half, middle + half, speed, torque_limit)
    return _Limits(*(jnp.asarray(x, dtype) for x in arrays))


def _amplitudes(motion: FourierMotion):
    return motion.center, motion.cosine, motion.sine


def _with_amplitudes(amplitudes, motion: FourierMotion) -> FourierMotion:
    """Motion with other amplitudes, at rest at t = 0: both conditions are distributed over all harmonics."""
    center, cosine, sine = amplitudes
    k = jnp.arange(1, cosine.shape[0] + 1, dtype=cosine.dtype)[:, None]
    cosine = cosine - jnp.mean(cosine, axis=0, keepdims=True)
    sine = sine - jnp.mean(k * sine, axis=0, keepdims=True) / k
    return FourierMotion(center, cosine, sine, motion.period)


@eqx.filter_jit
def _signals(motion: FourierMotion, model: Model, times):
    q, v, a = jax.vmap(motion)(times)
    return q, v, a, jax.vmap(lambda q, v, a: inverse_dynamics(model, q, v, a))(q, v, a)


@eqx.filter_jit
def _rows(motion: FourierMotion, task: _Task, places: tuple[int, ...]):
    """Weighted regressor in base parameters (samples * nv, p)."""

    def one(t):
        q, v, a = motion(t)
        W = jnp.concatenate([torque_regressor(task.model, q, v, a), friction_regressor(v, a, TERMS, task.v_s)], axis=1)
        return task.weights[:, None] * W[:, np.array(places)]

    return jax.vmap(one)(task.times).reshape(-1, len(places))


@eqx.filter_jit
def _loss(amplitudes, motion: FourierMotion, task: _Task, places: tuple[int, ...], objective: str):
    changed = _with_amplitudes(amplitudes, motion)
    W = _rows(changed, task, places) / task.scale[None]
    size = W.shape[1]
    # The floor keeps the logarithm finite where a motion does not excite a direction at all.
    floor = 1e-12 * jnp.eye(size, dtype=W.dtype)
    if objective == "logdet":
        root = jnp.linalg.cholesky(W.T @ W + floor)
        # The mean: its weight against the penalty does not depend on the number of parameters.
        value = -2 * jnp.mean(jnp.log(jnp.diagonal(root)))
    else:
        # The square root of a column of zeros has no finite derivative: the small number is inside of it.
        unit = W / jnp.sqrt(jnp.sum(W**2, axis=0, keepdims=True) + 1e-12)
        values = jnp.linalg.eigvalsh(unit.T @ unit + floor)
        value = 0.5 * jnp.log(values[-1] / values[0])
    q, v, _, tau = _signals(changed, task.model, task.times)
    limits = task.limits
    span = (limits.upper - limits.lower)[None]
    over = [
        (q - limits.upper[None]) / span,
        (limits.lower[None] - q) / span,
        jnp.abs(v) / limits.speed[None] - 1,
        jnp.abs(tau) / limits.torque_limit[None] - 1,
    ]
    return value + 100 * sum(jnp.mean(jnp.maximum(x, 0) ** 2) for x in over)


def _unit_loss(scaled, args):
    span, motion, *rest = args
    return _loss(_scale_amplitudes(scaled, span), motion, *rest)


def _descend(motion, task, places, objective, steps, learning_rate, callback):
    import optax  # not when jaxdyn is imported

    span = (task.limits.upper - task.limits.lower) / 2
    method = GradientSteps(
        _unit_loss,
        (span, motion, task, places, objective),
        method=optax.adam(optax.cosine_decay_schedule(learning_rate, steps, alpha=0.05)),
    )
    report = None if callback is None else lambda step, loss, _: callback(step, loss)
    end = descend(method, _scale_amplitudes(_amplitudes(motion), 1 / span), Watch(steps, report))
    return _with_amplitudes(_scale_amplitudes(end.best.point, span), motion), end.history, end.result


def _scale_amplitudes(amplitudes, span):
    """Centre (nq,), cosines and sines (harmonics, nq) times a number for each joint."""
    return jax.tree.map(lambda x: x * (span if x.ndim == 1 else span[None]), amplitudes)


def _limit_shares(motion: FourierMotion, task: _Task) -> dict[str, float]:
    """Largest share of each kind of limit along a fine grid."""
    times = jnp.asarray(np.arange(_CHECKED) * float(motion.period) / _CHECKED, task.times.dtype)
    q, v, _, tau = (np.asarray(x, np.float64) for x in _signals(motion, task.model, times))
    limits = [
        np.asarray(x, np.float64)
        for x in (task.limits.lower, task.limits.upper, task.limits.speed, task.limits.torque_limit)
    ]
    middle, half = (limits[0] + limits[1]) / 2, (limits[1] - limits[0]) / 2
    sizes = {
        "position": np.abs(q - middle) / half,
        "velocity": np.abs(v) / limits[2],
        "torque": np.abs(tau) / limits[3],
    }
    return {name: float(values.max()) for name, values in sizes.items()}


def _shrink(motion: FourierMotion, task: _Task) -> FourierMotion:
    """Scale the amplitudes, and the distance from the middle, by the largest factor up to 1 that exceeds no limit."""
    middle = (task.limits.lower + task.limits.upper) / 2

    def at(share):
        center = middle + share * (motion.center - middle)
        return FourierMotion(center, share * motion.cosine, share * motion.sine, motion.period)

    if max(_limit_shares(motion, task).values()) <= 1:
        return motion
    low, high = 0.0, 1.0
    if (used := _limit_shares(at(0.0), task))["torque"] > 1:
        raise ValueError(
            f"torque: holding the robot at the middle of its ranges needs {used['torque']:.3g} times the limits; give larger ones"
        )
    # 20 bisections determine the factor to 1e-6.
    for _ in range(20):
        share = (low + high) / 2
        low, high = (share, high) if max(_limit_shares(at(share), task).values()) <= 1 else (low, share)
    # The lower end exceeds no limit; the upper one may.
    return at(low)


def _condition(W) -> float:
    W = np.asarray(W, np.float64)
    length = np.linalg.norm(W, axis=0)
    s = np.linalg.svd(W / np.where(length > 0, length, 1), compute_uv=False)
    return float(s[0] / s[-1]) if s[-1] > 0 else np.inf
