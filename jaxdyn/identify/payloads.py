"""Fits with logs of a robot without a payload and with one: of the payload, and of the gains of drives by a known payload.

A payload is the difference that it makes: the robot's own parameters are eliminated exactly.

A drive's log holds its current, or a torque under an uncertain gain: i = tau / g. Gains and inertias scale each other, so that
neither is identifiable from a robot's own logs; a payload of known mass and centre adds a known torque p (N m), and both are:

    i_j = (W_j x + [loaded] (p_j + Y_j I)) / g_j,

with x the robot's base parameters and friction, and I the payload's rotational inertia where it is unknown. All joints share
the inertias in x, so that the gain of a joint with little torque from the payload is identified through the others. The logs are
condensed once.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import RESULTS, Outcome, name_of
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.condensed_fit import MAX_ROUNDS, eliminate, gather, is_negligible
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.interior import LOG_CHOLESKY_BASIS, TorqueProblem, body_chart
from jaxdyn.identify.logs import Log, as_logs
from jaxdyn.identify.regression import (
    Blocks,
    base_parameters,
    condense_model,
    coordinate_names,
    free_columns,
    least_squares_by_svd,
    log_regressor,
    noise_level,
    triangle_of,
)
from jaxdyn.identify.result import Fit, residuals
from jaxdyn.identify.robot import RobotFit, fit_robot
from jaxdyn.identify.selection import VELOCITIES
from jaxdyn.identify.torque_terms import TERMS, RobotTerms, Terms, check_terms, coulomb_through_filter, split_terms
from jaxdyn.identify.uncertainty import effective_sample_size, jackknife
from jaxdyn.model import host_math
from jaxdyn.model import inertia as _inertia
from jaxdyn.model.arguments import Numbers, check_known, deprecated, warn
from jaxdyn.model.tree import Model

# Most evaluations of the errors.
_STEPS = 50
# Largest half-width of a 95 % interval, as a share of the gain, of an identifiable gain.
_IDENTIFIABLE = 0.5
# Standard deviation of the prior of the logarithm of a gain, about the median of the others.
_APART = 1.0
# Least error as a share of the signal, so that noise-free logs stay well posed.
_FINEST = 1e-9
# Least share of a column that is independent of the others.
_RANK = 1e-9


class DriveGains(Outcome):
    """Result of `fit_gains`.

    - `gains` (nv,): torque = gain times the logged value. `std` (nv,): standard deviations, by blocks of samples as in
      `Intervals`; `factor`: a 95 % interval is plus and minus this many of them.
    - `identifiable`: names of the joints with a half-width below half of the gain. The other gains are about their median.
    - `error`: of the logged values, in per cent, over all logs. `v_s`: smoothing velocity of Coulomb friction.
    - `result`: one of `jd.RESULTS`, `successful` where the fit and the weights of the joints have converged, else
      `max_steps_reached`.
    """

    gains: np.ndarray
    std: np.ndarray
    factor: float
    identifiable: tuple[str, ...] = eqx.field(static=True)
    error: float
    v_s: float
    result: Any

    def scale(self, log: Log) -> Log:
        """Scale a log of these drives to torques in N m, as all fits expect them."""
        return dataclasses.replace(log, tau=np.asarray(log.tau, np.float64) * self.gains)

    scaled = deprecated("DriveGains.scaled", scale)

    @property
    def told(self) -> tuple[str, ...]:
        """Deprecated name of `identifiable`."""
        warn("DriveGains.told is deprecated; read identifiable", DeprecationWarning)
        return self.identifiable


@on_one_thread
def fit_gains(
    model: Model,
    unloaded: Log | Sequence[Log],
    loaded: Log | Sequence[Log],
    mass: float,
    centre: Numbers,
    *,
    inertia: Numbers | None = None,
    body: str | None = None,
    terms: Terms = TERMS,
    v_s: float | str = "auto",
    blocks: int = 20,
) -> DriveGains:
    """Fit the gain of each drive from logs without and with a known payload.

    Least squares over gains and base parameters together, each joint weighted by one over its error, iterated. Then fit the
    robot to `gains.scale(log)`.

    **Arguments:**

    - `model`: the robot; its inertias do not matter. `unloaded`, `loaded`: logs with v and a, or sequences of them, with currents
      (or torques under uncertain gains) in place of torques.
    - `mass` (kg), `centre` (3,) (m) of the payload, in the frame of the body that holds it. `inertia` (3, 3): about the
      centre, in axes of that frame (kg m^2); None: fitted too, at the cost of wider intervals.
    - `body`: name of the body that holds it, the last one by default. `terms`: of friction and rotors, of `TERMS`; `v_s`:
      smoothing velocity of Coulomb friction (rad/s, m/s), or "auto", that of the smallest error.
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the intervals.

    **Returns:** `DriveGains`.

    **Raises:** ValueError when logs and model do not fit together, for an unknown body, for fewer samples than unknowns of a
    joint, and where the payload identifies no gain.

    Source: Gautier & Briot (2014), "Global identification of joint drive gains and dynamic parameters of robots", ASME Journal of
    Dynamic Systems, Measurement, and Control 136; errors here are those of the currents, which least squares over both allows.
    """
    check_known("fit_gains", model=model, unloaded=unloaded, loaded=loaded)
    unloaded, loaded = as_logs(unloaded, model), as_logs(loaded, model)
    terms = check_terms(terms, 1.0)
    body = _holder(model, body)
    centre = np.asarray(centre, np.float64)
    if not (np.isfinite(mass) and mass > 0) or centre.shape != (3,) or not np.isfinite(centre).all():
        raise ValueError(f"mass is {mass} and centre {centre.tolist()}; give a positive mass (kg) and a point (3,) (m)")
    moments = np.zeros((3, 3)) if inertia is None else np.asarray(inertia, np.float64)
    known = np.asarray(_inertia.inertial_parameters(float(mass), centre, moments), np.float64)
    number, logs = model.body_names.index(body), (*unloaded, *loaded)
    is_loaded = np.arange(len(logs)) >= len(unloaded)
    own = slice(10 * number, 10 * number + 10)
    held = [holds * log_regressor(model, log)[:, :, own] for log, holds in zip(logs, is_loaded, strict=True)]
    torque = [(columns @ known)[:, :, None] for columns in held]
    # Mass and first moments are known; the six numbers of the rotational inertia stay, which all torques share.
    carried = [columns[:, :, 4:] if inertia is None else columns[:, :, :0] for columns in held]
    best = None
    for velocity in VELOCITIES if isinstance(v_s, str) else (float(v_s),):
        coulomb = [coulomb_through_filter(log, velocity) for log in logs]
        data = condense_model(model, logs, v_s=velocity, coulomb=coulomb, extra=torque, carried=carried, blocks=blocks)
        trial = _fit(_Problem(model, data, terms), velocity)
        if best is None or trial[0] < best[0]:
            best = trial
    assert best is not None
    _, error, gains, std, factor, velocity, result = best
    is_identifiable = factor * std < _IDENTIFIABLE * gains
    if not is_identifiable.any():
        raise ValueError(
            f"the payload of {mass:g} kg on {body} identifies the gain of no joint; use a heavier one, move more joints against "
            "gravity, or give its inertia"
        )
    names = tuple(name for name, yes in zip(coordinate_names(model), is_identifiable, strict=True) if yes)
    return DriveGains(gains, std, factor, names, error, velocity, result)


def _holder(model: Model, body: str | None) -> str:
    """Name of the body that holds the payload, the last one for None. **Raises:** ValueError for an unknown one."""
    if body is not None and body not in model.body_names:
        raise ValueError(f"body is {body!r}; the bodies are {', '.join(model.body_names)}")
    return model.body_names[-1] if body is None else body


class _Problem:
    """Condensed logs of nv joints, with the columns of the unknowns: base parameters and the inertia I."""

    def __init__(self, model: Model, data: Blocks, terms):
        self.data, self.nv = data, model.nv
        base, known = base_parameters(model, terms), 10 * model.nb + 4 * model.nv
        independent = free_columns(model.nb, model.nv, terms)[base.independent]
        every = np.append(independent, np.arange(known + model.nv, data.size))
        self.size = len(every)
        # For each joint, the columns of its triangle and the unknowns that these belong to; one is the payload's known torque.
        number = np.full(data.size, -1)
        number[every] = np.arange(self.size)
        self.columns = [np.flatnonzero(number[places] >= 0) for places in data.columns]
        self.unknowns = [number[places[own]] for places, own in zip(data.columns, self.columns, strict=True)]
        self.known = 10 * model.nb + 4

    def rows(self, joint: int, triangle: np.ndarray, z: np.ndarray, u: float):
        """Errors of a joint's condensed currents at the unknowns z and the gain exp(u), and their Jacobian (m, size + 1)."""
        # By logarithms gains stay positive, and a prior on u is one on relative differences.
        h, W = np.exp(-u), triangle[:, self.columns[joint]]
        predicted = h * (W @ z[self.unknowns[joint]] + triangle[:, self.known])
        jacobian = np.zeros((len(triangle), self.size + 1))
        jacobian[:, self.unknowns[joint]] = h * W
        # h = exp(-u): the derivative by u is minus the prediction itself.
        jacobian[:, -1] = -predicted
        return predicted - triangle[:, -1], jacobian

    def linearise(self, triangles, z, u, weights):
        """Weighted errors (m,) and their Jacobian (m, size + nv) of all joints."""
        errors, jacobians = [], []
        for joint, triangle in enumerate(triangles):
            error, part = self.rows(joint, triangle, z, u[joint])
            wide = np.zeros((len(error), self.size + self.nv))
            wide[:, : self.size], wide[:, self.size + joint] = part[:, :-1], part[:, -1]
            errors.append(weights[joint] * error)
            jacobians.append(weights[joint] * wide)
        return np.concatenate(errors), np.concatenate(jacobians)


class _State(NamedTuple):
    """Unknowns other than the gains, logarithms of gains, and the weights of joints."""

    z: np.ndarray
    u: np.ndarray
    weights: np.ndarray


def _fit(problem: _Problem, v_s: float):
    """Score, error in per cent, gains, standard deviations, factor of an interval, v_s, and the result."""
    data, nv = problem.data, problem.nv
    triangles, samples = data.merge(), int(data.samples.sum())
    # A joint whose rows are fitted exactly shows no error, and its weight, one over it, would decide everything.
    if samples <= (unknowns := 1 + max(map(len, problem.unknowns))):
        raise ValueError(
            f"the logs have {samples} samples, too few for the {unknowns} unknowns of a joint and its gain; log more samples"
        )
    sizes = np.array([max(float(np.linalg.norm(R[:, -1])), 1e-300) for R in triangles])
    start = _start(problem, triangles)
    state = _State(np.zeros(problem.size), start, 1 / sizes)
    rms, result = sizes, RESULTS.max_steps_reached
    for _ in range(MAX_ROUNDS):
        # Weights depend on the errors of the fit and the fit on the weights: iterated.
        before = np.concatenate([state.z, state.u])
        state, has_converged = _minimise(problem, triangles, state, start)
        rms = np.array(
            [np.linalg.norm(problem.rows(j, R, state.z, state.u[j])[0]) for j, R in enumerate(triangles)]
        ) / np.sqrt(samples)
        state = state._replace(weights=1 / np.maximum(rms, _FINEST * sizes / np.sqrt(samples)))
        # With these weights errors have deviations of one.
        _, J = problem.linearise(triangles, *state)
        if has_converged and is_negligible(J, np.concatenate([state.z, state.u]) - before, 1.0):
            result = RESULTS.successful
            break
    grams, gradients = [], []
    for block in data.triangles:
        error, J = problem.linearise(block, *state)
        grams.append(J.T @ J)
        gradients.append(J.T @ error)
    total = np.sum(grams, axis=0)
    curvature = np.diag(_weak_prior(total, problem.size))
    # Errors of currents count as independent: groups of two blocks.
    changes, inverse, factor = jackknife(grams, gradients, curvature, np.inf)
    # The jackknife does not see the prior; its covariance is H^-1 P H^-1.
    variance = np.sum(changes**2, axis=1) + np.diag(inverse @ curvature @ inverse)
    gains = np.exp(state.u)
    # Logarithms: the same relative improvement counts alike for currents of any size.
    score = float(np.sum(np.log(np.maximum(rms, _FINEST * sizes))))
    percent = 100 * float(np.sqrt(samples * np.sum(rms**2) / np.sum(sizes**2)))
    # The deviation of a logarithm is relative.
    return score, percent, gains, gains * np.sqrt(variance[-nv:]), factor, v_s, result


def _weak_prior(gram: np.ndarray, size: int) -> np.ndarray:
    """Curvature (n,) of a weak prior: a small share of each number's own, and the prior of the gains."""
    # Relative to each number's own curvature: it regularises directions that no log excites, and hardly changes any other.
    prior = 1e-12 * np.maximum(np.diag(gram), 1e-300)
    prior[size:] = 1 / _APART**2
    return prior


def _start(problem: _Problem, triangles) -> np.ndarray:
    """Logarithms of the gains (nv,) by the linear problem i_j = W_j z_j + h_j p_j of each joint; else the median of the others.

    **Raises:** ValueError where no joint identifies any.
    """
    logarithms = np.full(problem.nv, np.nan)
    for joint, R in enumerate(triangles):
        table = R[:, [*problem.columns[joint], problem.known, R.shape[1] - 1]]
        size = np.linalg.norm(table[:, -2])
        used = np.linalg.norm(table, axis=0) > 0
        used[-2:] = True
        T = triangle_of(table[:, used])
        k = T.shape[1] - 2
        # T[k, k] is the part of the payload's torque that the robot's own parameters do not explain.
        if len(T) > k and abs(T[k, k]) > 1e-6 * size > 0:
            h, noise = T[k, k + 1] / T[k, k], np.linalg.norm(T[k + 1 :, k + 1])
            # The deviation of h is that of the error over T[k, k]: at most half of h.
            if h > 0 and noise / np.sqrt(problem.data.samples.sum()) < 0.5 * h * abs(T[k, k]):
                logarithms[joint] = -np.log(h)
    if np.isnan(logarithms).all():
        raise ValueError(
            "the payload's torque is not identifiable at any joint; are the loaded logs loaded, and do they move joints "
            "against gravity?"
        )
    return np.where(np.isnan(logarithms), np.nanmedian(logarithms), logarithms)


def _minimise(problem: _Problem, triangles, state: _State, start: np.ndarray) -> tuple[_State, bool]:
    """The state of least squares at the weights of a state, by Levenberg and Marquardt's method, and whether it is a minimum."""
    from scipy.optimize import least_squares

    size = problem.size

    def errors(y):
        error, _ = problem.linearise(triangles, y[:size], y[size:], state.weights)
        return np.append(error, (y[size:] - start) / _APART)

    def jacobian(y):
        _, J = problem.linearise(triangles, y[:size], y[size:], state.weights)
        return np.concatenate([J, np.eye(len(y))[size:] / _APART])

    # At fixed gains the errors are linear in the other unknowns.
    zero = np.append(np.zeros(size), state.u)
    z = -np.linalg.lstsq(jacobian(zero)[:, :size], errors(zero), rcond=_RANK)[0]
    # Columns of unit length ("jac"): neither steps nor the test for their end may depend on units.
    options: dict[str, Any] = {"jac": jacobian, "method": "lm", "x_scale": "jac", "max_nfev": _STEPS}
    options |= {"ftol": 1e-12, "xtol": 1e-10, "gtol": 1e-14}
    end: Any = least_squares(errors, np.append(z, state.u), **options)
    return state._replace(z=end.x[:size], u=end.x[size:]), bool(end.success)


_BLOCKS = 20
# Weight that holds robot parameters, relative to the size of their columns: enough where no log determines them.
_HOLD = 1e-7
# Radius (m) of the ball from which the shape of a payload starts.
_RADIUS = 0.1


class Payload(Outcome):
    """Result of `fit_payload`.

    - `inertia` (10,): m, m c, I about the origin of the body that holds it, in its frame; physically feasible.
    - `mass` (kg), `centre` (3,) (m), `rotational` (3, 3) about the centre (kg m^2).
    - `std` (10,): standard deviations of the ten numbers, by blocks of samples as in `Intervals`; numbers that the logs do not
      determine have those of the prior. `factor`: a 95 % interval is plus and minus this many of them.
    - `body`: name of the body that holds it. `robot`: the `RobotFit` of the logs without it.
    - `error` : torque error of robot and payload along the loaded logs, in per cent; `without`: of the robot alone.
    - `result`: one of `jd.RESULTS`, `successful` where the robot's fit has converged and so have the loads of the gears, which
      depend on the payload; else that of the robot's fit, or `max_steps_reached`.
    """

    inertia: np.ndarray
    std: np.ndarray
    factor: float
    body: str = eqx.field(static=True)
    robot: RobotFit
    error: float
    without: float
    result: Any

    @property
    def mass(self) -> float:
        """Mass (kg)."""
        return float(self.inertia[0])

    @property
    def centre(self) -> np.ndarray:
        """Centre of mass (3,) in the frame of the body that holds it (m)."""
        return self.inertia[1:4] / self.inertia[0]

    @property
    def rotational(self) -> np.ndarray:
        """Rotational inertia (3, 3) about the centre of mass, in axes of that frame (kg m^2)."""
        return host_math.about_com(self.inertia)[2]


@on_one_thread
def fit_payload(
    model: Model,
    unloaded: Log | Sequence[Log],
    loaded: Log | Sequence[Log],
    body: str | None = None,
    terms: RobotTerms = "auto",
    *,
    robot: RobotFit | None = None,
    **options: Any,
) -> Payload:
    """Fit the ten inertial numbers of a payload that a robot holds in some logs and not in others.

    The robot's own parameters and its friction are the same in all logs and are eliminated exactly, so that the payload is
    identified from the difference that it makes. To fit the loaded logs with the last body free, and to subtract, would attribute
    the robot's errors to the payload.

    **Arguments:**

    - `model`: nominal robot. `unloaded`, `loaded`: logs with v and a, or sequences of them.
    - `body`: name of the body that holds the payload, the last one by default.
    - `terms`, `options`: of `fit_robot`, for the logs without payload; `robot`: its result, if there is one already.

    **Returns:** `Payload`. The prior of the payload is a ball of 0.1 m about the centre found by least squares, with weight 1.

    **Raises:** ValueError as `fit_robot`, and for an unknown body.

    Source: Khalil & Dombre (2002), section 12.7; Gaz & De Luca (2017), "Payload estimation based on identified coefficients".
    """
    check_known("fit_payload", model=model, unloaded=unloaded, loaded=loaded)
    check_bodies(model)
    unloaded, loaded = as_logs(unloaded, model), as_logs(loaded, model)
    body = _holder(model, body)
    number = model.body_names.index(body)
    robot = fit_robot(model, unloaded, terms, **options) if robot is None else robot
    unloaded, loaded = (tuple(robot.align(log) for log in logs) for logs in (unloaded, loaded))
    setting, x = robot.choice.setting, robot.fit.vector.copy()
    _, extra, _ = split_terms(robot.terms, model.nv)
    x[10 * model.nb : -model.nv] = 0  # the bodies and the rotors, whose torque is the gears' load
    # Columns of the payload: those of its body, zero in logs without it.
    regressors = [log_regressor(model, log) for log in (*unloaded, *loaded)]
    bare = [W @ x for W in regressors]
    is_loaded = np.arange(len(regressors)) >= len(unloaded)
    own = slice(10 * number, 10 * number + 10)
    carried = [holds * W[:, :, own] for W, holds in zip(regressors, is_loaded, strict=True)]
    logs, payload, inertias = (*unloaded, *loaded), np.zeros(10), robot.fit.model.inertias

    def hold(payload) -> Fit:
        heavier = inertias.at[number].add(jnp.asarray(payload, inertias.dtype))
        return eqx.tree_at(lambda fit: fit.system.system.inertias, robot.fit, heavier)

    # Errors without the payload do not depend on it: computed once.
    own_errors = residuals(robot.fit, unloaded)

    def size(payload) -> float:
        return effective_sample_size([*own_errors, *residuals(hold(payload), loaded)])

    # The load of the gears depends on the payload, which is still zero in the first round.
    has_loads, result = any(term.needs_load for term in extra), RESULTS.max_steps_reached
    for _ in range(MAX_ROUNDS):
        loads = [load + Y @ payload for load, Y in zip(bare, carried, strict=True)]
        data = gather(model, logs, setting.v_s, extra, loads, _BLOCKS, carried=carried)
        blocks, kept = data.blocks, np.append(np.arange(data.basic), data.places(setting.extra))
        rows = blocks.rows(robot.weights)[:, [*kept, *range(blocks.size - 10, blocks.size + 1)]]
        before = payload
        sigma = noise_level(rows, blocks.count())
        payload, std, factor = _solve(blocks, kept, robot.weights, rows, sigma, size)
        if not has_loads or is_negligible(rows[:, len(kept) : -1], payload - before, sigma):
            result = robot.fit.result
            break
    percent = 100 / np.linalg.norm(np.concatenate([np.asarray(log.tau, np.float64) for log in loaded]))
    error, without = (
        float(percent * np.linalg.norm(np.concatenate(residuals(fit, loaded)))) for fit in (hold(payload), robot.fit)
    )
    return Payload(payload, std, factor, body, robot, error, without, result)


def _solve(blocks: Blocks, kept: np.ndarray, weights, rows, sigma: float, size):
    """Feasible payload, standard deviations (10,) and the factor of an interval.

    `kept`: indices of the robot's parameters; the payload's are the last ten. `rows` [robot, payload, torque], and their noise
    `sigma`; `size(payload)`: effective sample size of the errors with it.
    """
    count = len(kept)
    hold = _HOLD * np.maximum(np.linalg.norm(rows[:, :count], axis=0), 1e-12)
    R, robot = eliminate(rows, count, hold)
    chart = body_chart(_ball(least_squares_by_svd(R[:, :-1], R[:, -1], 1e-6).change))
    problem = TorqueProblem.of(chart, R, sigma, 1.0)
    end = problem.minimize(1e-6)
    if end.result is not RESULTS.successful:
        raise ValueError(f"the payload's fit ended {name_of(end.result)!r}; do the loaded logs move the robot?")
    origin, terms = end.last.point
    payload = chart.x(origin, terms)
    # In the coordinates of the chart, where the prior's curvature is known; it also determines what no log does.
    (stretch,) = chart.body_jacobians(origin)
    basis = LOG_CHOLESKY_BASIS
    curvature = np.zeros((count + 10, count + 10))
    # The weak rows that held the robot's parameters in the fit are a prior of theirs here.
    curvature[np.arange(count), np.arange(count)] = hold**2 / sigma**2
    curvature[count:, count:] = np.einsum("kij,lji->kl", basis, basis)
    jacobian, x = np.zeros((blocks.size, count + 10)), np.zeros(blocks.size)
    jacobian[kept, np.arange(count)], jacobian[-10:, count:] = 1, stretch
    x[kept], x[-10:] = robot(payload), payload
    grams = np.einsum("pi,bpq,qj->bij", jacobian, blocks.grams(weights), jacobian, optimize=True) / sigma**2
    gradients = blocks.scores(x, weights) @ jacobian / sigma**2
    changes, inverse, factor = jackknife(grams, gradients, curvature, size(payload))
    # The log-Cholesky basis spans all symmetric matrices, so that its Gram matrix is positive definite.
    root = np.linalg.cholesky(curvature[count:, count:])
    from_data, from_prior = stretch @ changes[count:], stretch @ inverse[count:, count:] @ root
    std = np.sqrt(np.sum(from_data**2, axis=1) + np.sum(from_prior**2, axis=1))
    return payload, std, factor


def _ball(numbers: np.ndarray) -> np.ndarray:
    """Ball with the mass and the centre of these numbers; a light one at the origin where they are not physical."""
    mass = float(numbers[0])
    centre = numbers[1:4] / mass if mass > 0 else np.zeros(3)
    if not mass > 0 or np.linalg.norm(centre) > 10:
        mass, centre = max(mass, 0.1), np.zeros(3)
    return np.asarray(_inertia.displaced(jnp.asarray(_inertia.sphere(mass, _RADIUS)), centre))
