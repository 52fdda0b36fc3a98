"""Fits of a payload from logs without it and with it, and of a mechanism with loops by the torques of its motors."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import RESULTS, Outcome, name_of
from jaxdyn.forces.elements import CoulombFriction, JointDamping
from jaxdyn.identify.chart import check_bodies
from jaxdyn.identify.condensed_fit import MOST_ROUNDS, eliminate, gather, is_negligible
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.interior import LOG_CHOLESKY_BASIS, TorqueProblem, robot_chart
from jaxdyn.identify.linear_fit import Direction, scatter, weakest_directions
from jaxdyn.identify.logs import Log, as_logs, signal_sizes
from jaxdyn.identify.mechanisms import check_motors, motor_regressor
from jaxdyn.identify.options import Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.parameters import fit_parameters
from jaxdyn.identify.regression import (
    BaseParameters,
    Blocks,
    condense_rows,
    group_columns,
    least_squares_by_svd,
    log_regressor,
    noise_level,
    parameter_names,
)
from jaxdyn.identify.result import Fit, torques_along
from jaxdyn.identify.robot import RobotFit, fit_robot
from jaxdyn.identify.torque_terms import LEAVES, TERMS, Friction, RobotTerms, Terms, check_terms, split_terms
from jaxdyn.identify.uncertainty import effective_sample_size, jackknife
from jaxdyn.model import host_math
from jaxdyn.model import inertia as _inertia
from jaxdyn.model.builder import ModelBuilder
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene

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
    check_bodies(model)
    unloaded, loaded = as_logs(unloaded, model), as_logs(loaded, model)
    body = model.body_names[-1] if body is None else body
    if body not in model.body_names:
        raise ValueError(f"body is {body!r}; the bodies are {', '.join(model.body_names)}")
    number = model.body_names.index(body)
    robot = fit_robot(model, unloaded, terms, **options) if robot is None else robot
    unloaded, loaded = (tuple(robot.align(log) for log in logs) for logs in (unloaded, loaded))
    setting, x = robot.choice.setting, robot.fit.vector.copy()
    _, extra, _ = split_terms(robot.terms, model.nv)
    x[10 * model.nb : -model.nv] = 0  # the bodies and the rotors, whose torque is the gears' load
    own = slice(10 * number, 10 * number + 10)
    logs, payload = (*unloaded, *loaded), np.zeros(10)
    is_loaded = np.arange(len(logs)) >= len(unloaded)
    # Errors without the payload do not depend on it: computed once.
    residuals = [robot.fit.torques(log) - np.asarray(log.tau, np.float64) for log in unloaded]

    def size(payload) -> float:
        return effective_sample_size([*residuals, *_residuals(robot, loaded, own, payload)[0]])

    # The load of the gears depends on the payload, which is still zero in the first round.
    has_loads, result = any(term.needs_load for term in extra), RESULTS.max_steps_reached
    for _ in range(MOST_ROUNDS):
        loads = []
        for log, holds in zip(logs, is_loaded, strict=True):
            carried = x.copy()
            carried[own] += holds * payload
            loads.append(log_regressor(model, log) @ carried)
        data = gather(model, logs, setting.v_s, extra, loads, _BLOCKS)
        kept = np.concatenate([np.arange(data.basic), data.places(setting.extra)]).astype(int)
        rows = _rows(data.blocks, is_loaded, own, kept, robot.weights)
        before = payload
        sigma = noise_level(condense_rows(rows, data.blocks.count()))
        payload, std, factor = _solve(data.blocks, is_loaded, own, kept, robot.weights, rows, sigma, size)
        if not has_loads or is_negligible(rows[:, len(kept) : -1], payload - before, sigma):
            result = robot.fit.result
            break
    error, without = _errors(robot, loaded, own, payload)
    return Payload(payload, std, factor, body, robot, error, without, result)


def _rows(blocks: Blocks, is_loaded, own: slice, kept, weights) -> np.ndarray:
    """Rows [robot, payload, torque] of all logs: the payload's columns are those of its body, in loaded logs alone."""
    parts = []
    for holds in (False, True):
        part = blocks.rows(weights, is_loaded[blocks.logs] == holds)
        parts.append(np.concatenate([part[:, kept], holds * part[:, own], part[:, -1:]], axis=1))
    return np.concatenate(parts)


def _solve(blocks: Blocks, is_loaded, own: slice, kept, weights, rows, sigma: float, size):
    """Feasible payload, standard deviations (10,) and the factor of an interval.

    `sigma`: noise of the rows. `size(payload)`: effective sample size of the errors with it.
    """
    count = len(kept)
    hold = _HOLD * np.maximum(np.linalg.norm(rows[:, :count], axis=0), 1e-12)
    R, robot = eliminate(rows, count, hold)
    start = _ball(least_squares_by_svd(R[:, :-1], R[:, -1], 1e-6).change)
    builder = ModelBuilder("payload").add_body("payload", joint="free", inertia=start)
    alone = builder.build()
    # The payload alone is a model of one body: columns of its terms stay zero.
    table = np.zeros((len(R), 10 + 4 * alone.nv + 1))
    table[:, :10], table[:, -1] = R[:, :-1], R[:, -1]
    # No terms are fitted, so that their units do not matter.
    sizes = [np.ones(alone.nv)] * 3
    chart = robot_chart(alone, (), "full", sizes)
    problem = TorqueProblem.of(chart, condense_rows(table, blocks.count()), sigma, 1.0)
    end = problem.minimize(1e-6)
    if end.result is not RESULTS.successful:
        raise ValueError(f"the payload's fit ended {name_of(end.result)!r}; do the loaded logs move the robot?")
    origin, terms = end.last.point
    payload = chart.x(origin, terms)[:10]

    estimate = robot(payload)
    # In the coordinates of the chart, where the prior's curvature is known; it also determines what no log does.
    (stretch,) = chart.body_jacobians(origin)
    basis = LOG_CHOLESKY_BASIS
    curvature = np.zeros((count + 10, count + 10))
    # The weak rows that held the robot's parameters in the fit are a prior of theirs here.
    curvature[np.arange(count), np.arange(count)] = hold**2 / sigma**2
    curvature[count:, count:] = np.einsum("kij,lji->kl", basis, basis)
    # Jacobians of x for logs without the payload (0) and with it (1): the first have no columns of the payload.
    spreads = np.zeros((2, blocks.size, count + 10))
    spreads[:, kept, np.arange(count)] = 1
    spreads[1, own, count:] += stretch
    bare = np.zeros(blocks.size)
    bare[kept] = estimate
    holding = bare.copy()
    holding[own] += payload
    scores = np.stack([blocks.scores(x, weights) for x in (bare, holding)])
    grams, gradients = [], []
    for i, gram in enumerate(blocks.grams(weights)):
        holds = int(is_loaded[blocks.logs[i]])
        grams.append(spreads[holds].T @ gram @ spreads[holds] / sigma**2)
        gradients.append(scores[holds, i] @ spreads[holds] / sigma**2)
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


def _residuals(robot: RobotFit, loaded: Sequence[Log], own: slice, payload) -> tuple[list, list]:
    """Errors (n, nv) along each loaded log, of robot and payload, and of the robot alone."""
    inertias = robot.fit.model.inertias
    with_payload = eqx.tree_at(
        lambda fit: fit.system.system.inertias,
        robot.fit,
        inertias.at[own.start // 10].add(jnp.asarray(payload, inertias.dtype)),
    )

    def errors(fit):
        return [fit.torques(log) - np.asarray(log.tau, np.float64) for log in loaded]

    return errors(with_payload), errors(robot.fit)


def _errors(robot: RobotFit, loaded: Sequence[Log], own: slice, payload) -> tuple[float, float]:
    size = np.linalg.norm(np.concatenate([np.asarray(log.tau, np.float64) for log in loaded]))
    both, alone = (np.concatenate(parts) for parts in _residuals(robot, loaded, own, payload))
    return 100 * float(np.linalg.norm(both) / size), 100 * float(np.linalg.norm(alone) / size)


class MechanismFit(NamedTuple):
    """Result of `fit_mechanism`.

    - `fit`: the feasible bodies and the motors' friction, `fit.torques(log)` their torques.
    - `base`: combinations of the parameters that the logs determine; `nominal`, `values`, `std` (nbase,): of the scene given,
      fitted, and the jackknife standard deviation; `factor`: a 95 % interval is plus and minus this many, for each by itself.
    - `condition`: of the regressor in these combinations, columns of unit length; `weakest`: the least identifiable directions.
    """

    fit: Fit
    base: BaseParameters
    nominal: np.ndarray
    values: np.ndarray
    std: np.ndarray
    factor: float
    condition: float
    weakest: list[Direction]


@on_one_thread
def fit_mechanism(
    scene: Scene,
    log: Log | Sequence[Log],
    motors: Sequence[str],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    prior: float = 1.0,
) -> MechanismFit:
    """Fit the bodies of a mechanism with loops, and the friction and rotors of its motors, by the torques of these alone.

    Joints without a motor have no friction but that of the file. The feasible fit is that of `fit_parameters` with the error
    "torque"; the combinations are those of the regressor of the motors' torques along the logs, N^T Y (`motor_basis`).

    **Arguments:** `scene`: the mechanism, with the geometry and the nominal parameters; `log`: one or several, with q, v and a of
    all joints (`complete_log`); `motors`: names of joints, as many as degrees of freedom; `terms`, `v_s`, `prior` as of
    `fit_torques`.

    **Raises:** ValueError for another number of motors, and as `fit_parameters`.

    Source: Khalil & Dombre (2002), chapters 9 and 10, base parameters of closed chains.
    """
    terms = check_terms(terms, v_s)
    logs = as_logs(log, scene.system)
    columns = np.array(check_motors(scene, np.asarray(logs[0].q)[0], motors))
    start = _with_friction(scene, columns, terms, v_s, signal_sizes(logs))
    model: Model = start.system
    every = parameter_names(model, terms)
    names = every[: 10 * model.nb] + tuple(f"{motor}.{term}" for term in terms for motor in motors)
    regressors = [motor_regressor(start, one, motors, terms, v_s) for one in logs]
    W, tau = np.concatenate(regressors), np.concatenate([np.asarray(one.tau)[:, columns] for one in logs])
    weights = 1 / np.sqrt(np.mean(tau**2, axis=0))
    base, _ = group_columns((W * weights[:, None]).reshape(-1, len(names)), names, model.nb, np.dtype(model.home.dtype))
    x0 = _numbers(start, columns, terms)
    # Springs and the friction of passive joints stay those of the file.
    places = tuple(columns.tolist())
    rest = tau - np.concatenate([torques_along(start, one, places)[:, columns] for one in logs])
    rows, errors = (W[:, :, base.independent] * weights[:, None]), rest * weights
    flat = rows.reshape(-1, len(base))
    if len(flat) <= len(base):
        raise ValueError(f"the logs have {len(flat)} torques of motors for {len(base)} combinations; log more")
    linear = least_squares_by_svd(flat, errors.reshape(-1), 1e-9)
    residual = errors - rows @ linear.change
    # Relative to the torque, as `Objective.noise`; noise-free logs stay well posed.
    noise = max(float(np.sqrt(linear.rest / (len(flat) - linear.rank))), 1e-6)
    tree = Parameters(start).inertias(weight=prior)
    for term in terms:
        where = LEAVES[term]
        tree = (tree.free if term == "offset" else tree.positive)(where, rows=columns.tolist())
    fit = fit_parameters(start, logs, tree, Objective("torque", observed=tuple(motors), noise=2**0.5 * noise))
    edges = np.cumsum([len(one) for one in logs])[:-1]
    size = effective_sample_size(np.split(residual, edges))
    half = linear.half
    whitened = [np.einsum("ijp,pk->ijk", part, half) for part in np.array_split(rows, _BLOCKS)]
    scores = [np.einsum("ijk,ij->k", X, e) for X, e in zip(whitened, np.array_split(residual, _BLOCKS), strict=True)]
    std, factor = scatter([np.einsum("ijk,ijl->kl", X, X) for X in whitened], scores, half, size)
    return MechanismFit(
        fit,
        base,
        base.values(x0),
        base.values(_numbers(fit.system, columns, terms)),
        std,
        factor,
        linear.condition,
        weakest_directions(flat, base.names),
    )


def _with_friction(scene: Scene, motors: np.ndarray, terms, v_s: float, sizes) -> Scene:
    """Scene with one force for the friction of all joints, of which that of the motors is positive, as a fit's start must be."""
    model, zero = scene.system, np.zeros(scene.nv)
    torque, velocity, acceleration = sizes
    # A hundredth of the torque where the file has none: a logarithm needs a start above zero.
    unit = 0.01 * torque
    start = {"viscous": model.damping, "coulomb": model.friction, "armature": model.armature}
    per = {"viscous": velocity, "coulomb": np.ones(scene.nv), "armature": acceleration}
    for term, own in start.items():
        own = zero.copy() if own is None else np.array(own, np.float64)
        if term in terms:
            least = unit / np.where(per[term] > 0, per[term], 1.0)
            own[motors] = np.where(own[motors] > 0, own[motors], least[motors])
        start[term] = own
    dtype = model.home.dtype
    viscous, coulomb, armature = (jnp.asarray(start[term], dtype) for term in ("viscous", "coulomb", "armature"))
    friction = Friction(viscous, coulomb, jnp.asarray(zero, dtype), jnp.asarray(v_s, dtype))
    others = [force for force in scene.forces if not isinstance(force, (JointDamping, CoulombFriction))]
    rotors = armature if model.armature is not None or "armature" in terms else None
    moved = Scene(model.replace(armature=rotors), scene.constraints, [friction, *others])
    return moved.with_kept_rows(scene.kept_rows)


def _numbers(scene: Scene, motors: np.ndarray, terms) -> np.ndarray:
    """Parameters x (10 nb + terms m,) in the order of the regressor's columns."""
    friction = [np.asarray(LEAVES[term](scene), np.float64)[motors] for term in terms]
    return np.concatenate([np.asarray(scene.system.inertias, np.float64).reshape(-1), *friction])
