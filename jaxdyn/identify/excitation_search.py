"""Exciting motions: periodic, within limits, with information about the parameters maximised by gradient descent."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.rank import eps_of
from jaxdyn.dynamics.quantities import torque_regressor
from jaxdyn.identify.descent import Watch, descend
from jaxdyn.identify.excitation import (
    DrivenRobot,
    FourierMotion,
    joint_signals,
    make_robot,
    motion_from_rest,
    random_motion,
)
from jaxdyn.identify.logs import Log
from jaxdyn.identify.methods import GradientSteps, RandomSteps
from jaxdyn.identify.regression import base_parameters, free_columns, group_columns
from jaxdyn.identify.torque_terms import TERMS, Terms, check_terms, friction_regressor
from jaxdyn.model.arguments import Checked, Numbers, check_known
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike

OBJECTIVES = ("logdet", "condition")
# Range and speed of a joint without limits of its own (rad, rad/s).
_TURN, _SPEED = np.pi, 2.0
# 100 samples are 20 in a period of the fifth harmonic, the default; peaks are checked on a finer grid.
_SAMPLES, _CHECKED = 100, 1000
# Speed of a passive joint without a limit of its own over that of a motor; largest residual of closed loops (m, rad), as a power
# of eps: 1.5e-8 in float64.
_PASSIVE, _CLOSED = 5.0, 0.5


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
    robot: DrivenRobot
    condition: float
    start_condition: float
    logdet: float
    history: np.ndarray
    used: dict[str, float]
    result: Any

    @property
    def model(self) -> Model:
        """Nominal model."""
        return self.robot.model

    def log(self, rate: float = 100.0, periods: int = 1, *, whole: bool = False) -> Log:
        """Log of the motion at so many samples a second with the torques of the nominal model, for a controller or a file.

        Of a mechanism with loops it has the columns of the motors, or those of all joints (`whole`).
        """
        period, robot = float(self.motion.period), self.robot
        count = round(period * rate * periods) + 1
        t = np.linspace(0, period * periods, count)
        signals = joint_signals(self.motion, robot, jnp.asarray(t, self.model.home.dtype))
        q, v, a, own, *_ = (np.asarray(x, np.float64) for x in signals)
        tau = np.zeros_like(v)
        tau[:, robot.joints] = own
        columns = np.arange(self.model.nv) if whole else robot.joints
        names = tuple(self.model.joint_names[i] for i in columns)
        return Log(t, *(x[:, columns] for x in (q, v, a, tau)), joint_names=names)


class _Limits(eqx.Module):
    """Limits of positions and speeds of all joints (nv,), and of the torques of the driven ones (m,)."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    speed: Float[Array, " n"]
    torque_limit: Float[Array, " m"]
    middle: Float[Array, " m"]


class _Task(eqx.Module):
    """Arguments of the loss other than the motion."""

    robot: DrivenRobot
    limits: _Limits
    times: Float[Array, " samples"]
    scale: Float[Array, " p"]
    v_s: Float[Array, ""]

    @property
    def span(self):
        """Half of the range (m,) of each driven joint."""
        return ((self.limits.upper - self.limits.lower) / 2)[self.robot.joints]


def exciting_motion(
    system: SceneLike,
    terms: Terms = TERMS,
    *,
    motors: Checked[Sequence[str] | None] = None,
    guess: Checked[Numbers | None] = None,
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
    none. Motions of loops are improved by random changes that exceed no limit, as near a dead point speeds have no bound.

    **Arguments:**

    - `system`: a model with one coordinate a joint, or a scene with loops; the model's limits hold where it has them.
      `terms`: to be identified with the bodies.
    - `motors`: names of the driven joints of a scene with loops, as many as degrees of freedom; the loops determine the others,
      whose limits hold too. `guess` (nq,): a configuration near closed loops, about which the motors move; zeros by default.
    - `period` (s), `harmonics` (at least 2): of the series.
    - `objective`: "logdet", the volume of all uncertainty (D-optimal), or "condition", the worst against the best direction.
    - `margin`: usable share of all limits. `velocity`, `torque` (nv,): limits instead of the model's, rad/s and N m.
    - `v_s`: smoothing velocity of Coulomb friction while searching; larger than the fit's, so that the gradient is not zero
      almost everywhere.
    - `seed`, `starts`: of the random motions. `steps`, `learning_rate`: of Adam; with loops sixteen changes
      are a step, and the first ones are five times as large.
    - `callback(step, loss)`: before every step and at the end; True stops the search.

    **Returns:** `Excitation`. Collisions with the ground, or of the robot with itself, are not checked: view the motion first
    (`jd.animate`).

    **Raises:** ValueError for joints of several coordinates, arguments out of range, where the torque limits cannot hold the
    robot at its centre, and for loops without `motors`, with another number of them than degrees of
    freedom, or that cannot be closed.

    Source: Swevers et al. (1997), "Optimal robot excitation and identification"; Park (2006), "Fourier-based optimal excitation
    trajectories for the dynamic identification of robots".
    """
    check_known("exciting_motion", system=system, guess=guess)
    terms, robot = check_terms(terms, v_s), make_robot(as_scene(system), motors, guess)
    model, driven = robot.model, robot.joints
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
    limits = _limits(robot, margin, velocity, torque)
    # Two standard deviations reach from the middle to the limits.
    size = np.asarray(limits.upper - limits.lower)[driven] / 4
    # Without the end of the period, which repeats its first sample.
    times = jnp.asarray(np.arange(_SAMPLES) * period / _SAMPLES, dtype)
    task = _Task(robot, limits, times, jnp.ones(1, dtype), jnp.asarray(v_s, dtype))

    keys = jax.random.split(jax.random.key(seed), starts)
    speed = 2 * np.pi / period * np.asarray(size)
    share = np.minimum(1.0, 0.5 * np.asarray(limits.speed)[driven] / np.where(speed > 0, speed, 1))
    motions = [random_motion(key, limits.middle, size * share, period=period, harmonics=harmonics) for key in keys]
    motions = [_shrink(motion, task) for motion in motions]
    places = _base_places(robot, terms, motions, task)
    lengths = np.linalg.norm(_rows(motions[0], task, places), axis=0)
    # One scale for all starts makes their losses comparable.
    task = eqx.tree_at(lambda t: t.scale, task, jnp.asarray(np.where(lengths > 0, lengths, 1), dtype))
    args = motions[0].period, task, places, objective
    scaled = [_scale_amplitudes(_amplitudes(motion), 1 / task.span) for motion in motions]
    first = np.asarray(_losses(jax.tree.map(lambda *x: jnp.stack(x), *scaled), args))
    motion = motions[int(np.argmin(np.where(np.isfinite(first), first, np.inf)))]

    excitation, history, result = _descend(motion, args, steps, learning_rate, seed, callback)
    excitation = _shrink(excitation, task)
    before, after = (np.asarray(_rows(m, task, places), np.float64) for m in (motion, excitation))
    scale = np.asarray(task.scale, np.float64)
    ratio = [np.linalg.slogdet((W / scale).T @ (W / scale))[1] for W in (before, after)]
    # Smaller amplitudes within all limits may undo what a short search has gained beyond them.
    if ratio[1] < ratio[0] if objective == "logdet" else _condition(after) > _condition(before):
        excitation, after, ratio[1] = motion, before, ratio[0]
    used = {name: share for name, share in _limit_shares(excitation, task).items() if name != "closure"}
    change = float(ratio[1] - ratio[0])
    return Excitation(excitation, robot, _condition(after), _condition(before), change, history, used, result)


def _base_places(robot: DrivenRobot, terms, motions: Sequence[FourierMotion], task: _Task) -> tuple[int, ...]:
    """Columns of `_rows` that are independent on general motions, for some terms."""
    model, count = robot.model, len(robot.joints)
    columns = free_columns(model.nb, count, terms)
    if robot.motors is None:
        return tuple(columns[base_parameters(model, terms).independent].tolist())
    W = np.concatenate([np.asarray(_rows(motion, task, tuple(columns.tolist())), np.float64) for motion in motions])
    base, _ = group_columns(W, tuple(map(str, columns)), model.nb, np.dtype(model.home.dtype))
    return tuple(columns[base.independent].tolist())


def _limits(robot: DrivenRobot, margin: float, velocity, torque) -> _Limits:
    model, driven = robot.model, robot.joints
    n, dtype = model.nv, model.home.dtype

    def of(value, otherwise, n=n):
        numbers = np.full(n, otherwise) if value is None else np.asarray(value, np.float64)
        if numbers.shape not in ((), (1,), (n,)):
            raise ValueError(f"limits {numbers.tolist()} are of {numbers.size} joints; give one number, or {n}")
        numbers = np.broadcast_to(numbers, (n,)).copy()
        return np.where(np.isfinite(numbers), numbers, otherwise)

    start = np.asarray(robot.start, np.float64)
    lower, upper = of(model.lower, -np.inf), of(model.upper, np.inf)
    lower = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper, start) - _TURN)
    upper = np.where(np.isfinite(upper), upper, lower + 2 * _TURN)
    middle, half = (lower + upper) / 2, margin * (upper - lower) / 2
    # Passive joints may be faster than the motors.
    usual = np.where(np.isin(np.arange(n), driven), _SPEED, _PASSIVE * _SPEED)
    speed = margin * of(model.velocity_limit, usual)
    if velocity is not None:
        speed[driven] = margin * of(velocity, _SPEED, len(driven))
    own = np.asarray(model.effort_limit)[driven] if torque is None else torque
    torque_limit = margin * of(own, np.inf, len(driven))
    for name, value in (("velocity", speed), ("torque", torque_limit), ("the range of positions", half)):
        if not np.all(value > 0):
            raise ValueError(f"{name} has limits {value.tolist()}; they must be positive")
    # Without torque limits the weight sets the scale of the torques.
    if not np.isfinite(torque_limit).all():
        mass = float(np.asarray(model.inertias)[:, 0].sum())
        torque_limit = np.where(np.isfinite(torque_limit), torque_limit, 1e3 * max(mass, 1e-3))
    centre = middle if robot.motors is None else start[driven]
    arrays = (middle - half, middle + half, speed, torque_limit, centre)
    return _Limits(*(jnp.asarray(x, dtype) for x in arrays))


def _amplitudes(motion: FourierMotion):
    return motion.center, motion.cosine, motion.sine


@eqx.filter_jit
def _rows(motion: FourierMotion, task: _Task, places: tuple[int, ...]):
    """Regressor in base parameters (samples * m, p), rows over the torque limits."""
    return _regressor(task, places, *task.robot.states(motion, task.times)[:4])


def _regressor(task: _Task, places: tuple[int, ...], q, v, a, N):
    driven, limit = task.robot.joints, task.limits.torque_limit

    def one(q, v, a, N):
        friction = friction_regressor(v[driven], a[driven], TERMS, task.v_s)
        W = jnp.concatenate([N.T @ torque_regressor(task.robot.model, q, v, a), friction], axis=1)
        return W[:, np.array(places)] / limit[:, None]

    return jax.vmap(one)(q, v, a, N).reshape(-1, len(places))


@eqx.filter_jit
def _loss(scaled, args):
    """Loss of a motion by its centre and amplitudes in units of half of the ranges."""
    period, task, places, objective = args
    motion = motion_from_rest(*_scale_amplitudes(scaled, task.span), period=period)
    q, v, a, tau, N, gap = joint_signals(motion, task.robot, task.times)
    W = _regressor(task, places, q, v, a, N) / task.scale[None]
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
    limits = task.limits
    span = (limits.upper - limits.lower)[None]
    over = [
        (q - limits.upper[None]) / span,
        (limits.lower[None] - q) / span,
        jnp.abs(v) / limits.speed[None] - 1,
        jnp.abs(tau) / limits.torque_limit[None] - 1,
    ]
    if task.robot.motors is not None:
        # Near a dead point speeds have no bound, beyond it the loops stay open: such motions are left out.
        excess = [*(jnp.max(x) for x in over), jnp.max(gap) - eps_of(gap) ** _CLOSED]
        return jnp.where(jnp.max(jnp.stack(excess)) <= 0, value, jnp.inf)
    return value + 100 * sum(jnp.mean(jnp.maximum(x, 0) ** 2) for x in over)


@eqx.filter_jit
def _losses(scaled, args):
    """Losses (k,) of several motions."""
    return jax.vmap(lambda one: _loss(one, args))(scaled)


def _descend(motion, args, steps, learning_rate, seed, callback):
    import optax  # not when jaxdyn is imported

    task = args[1]
    if task.robot.motors is None:
        adam = optax.adam(optax.cosine_decay_schedule(learning_rate, steps, alpha=0.05))
        method = GradientSteps(_loss, args, method=adam)
    else:
        # Higher harmonics have smaller amplitudes at the same speed.
        shares = 1 / np.arange(1.0, 1 + len(motion.sine))[:, None]
        sizes = tuple(5 * learning_rate * x for x in (1.0, shares, shares))
        method = RandomSteps(lambda points: _losses(points, args), sizes, seed)
    report = None if callback is None else lambda step, loss, _: callback(step, loss)
    end = descend(method, _scale_amplitudes(_amplitudes(motion), 1 / task.span), Watch(steps, report))
    found = _scale_amplitudes(end.best.point, task.span)
    return motion_from_rest(*found, period=motion.period), end.history, end.result


def _scale_amplitudes(amplitudes, span):
    """Centre (nq,), cosines and sines (harmonics, nq) times a number for each joint."""
    return jax.tree.map(lambda x: x * span.reshape(*[1] * (x.ndim - 1), -1), amplitudes)


def _limit_shares(motion: FourierMotion, task: _Task) -> dict[str, float]:
    """Largest share of each kind of limit along a fine grid."""
    times = jnp.asarray(np.arange(_CHECKED) * float(motion.period) / _CHECKED, task.times.dtype)
    q, v, _, tau, _, gap = (np.asarray(x, np.float64) for x in joint_signals(motion, task.robot, times))
    lower, upper, speed, torque, _ = (np.asarray(x, np.float64) for x in jax.tree.leaves(task.limits))
    sizes = {
        "position": np.abs(q - (lower + upper) / 2) / ((upper - lower) / 2),
        "velocity": np.abs(v) / speed,
        "torque": np.abs(tau) / torque,
        "closure": gap / eps_of(times) ** _CLOSED,
    }
    # Newton's method on loops that cannot be closed may leave the numbers.
    return {name: float(np.nan_to_num(values, nan=np.inf).max()) for name, values in sizes.items()}


def _shrink(motion: FourierMotion, task: _Task) -> FourierMotion:
    """Scale the amplitudes, and the distance from the middle, by the largest factor up to 1 that exceeds no limit."""
    middle = task.limits.middle

    def at(share):
        center = middle + share * (motion.center - middle)
        return FourierMotion(center, share * motion.cosine, share * motion.sine, motion.period)

    if max(_limit_shares(motion, task).values()) <= 1:
        return motion
    low, high = 0.0, 1.0
    if (used := _limit_shares(at(0.0), task))["torque"] > 1:
        where = "the middle of its ranges" if task.robot.motors is None else "guess"
        raise ValueError(
            f"torque: holding the robot at {where} needs {used['torque']:.3g} times the limits; give larger ones"
        )
    if used["position"] > 1:
        raise ValueError(
            f"position: guess uses {used['position']:.3g} times the ranges of the joints; give another one"
        )
    # 20 bisections determine the factor to 1e-6.
    for _ in range(20):
        share = (low + high) / 2
        low, high = (share, high) if max(_limit_shares(at(share), task).values()) <= 1 else (low, share)
    # The lower end exceeds no limit; the upper one may.
    return at(low)


def _condition(W) -> float:
    length = np.linalg.norm(W, axis=0)
    return float(np.linalg.cond(W / np.where(length > 0, length, 1)))
