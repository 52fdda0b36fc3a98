"""Linear least squares on torques with jackknife standard deviations, identifiability, and fits of mechanisms with loops."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.base import position_residual, rows
from jaxdyn.forces.elements import CoulombFriction, JointDamping
from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.interior import term_units
from jaxdyn.identify.log_repair import LogWarning
from jaxdyn.identify.logs import Log, as_logs, check_log, root_mean_square, signal_sizes
from jaxdyn.identify.mechanisms import check_motors, motor_regressor
from jaxdyn.identify.options import Objective
from jaxdyn.identify.parameter_tree import Parameters
from jaxdyn.identify.parameters import fit_parameters
from jaxdyn.identify.regression import (
    BaseParameters,
    Blocks,
    SvdSolution,
    base_parameters,
    check_weights,
    condense_model,
    free_columns,
    group_columns,
    least_squares_by_svd,
    model_torques,
    nominal_parameters,
    parameter_names,
    torque_error,
    triangle_of,
)
from jaxdyn.identify.result import Fit, torques_along
from jaxdyn.identify.torque_terms import LEAVES, POSITIVE, TERMS, Friction, Terms, check_terms
from jaxdyn.identify.uncertainty import effective_sample_size, jackknife
from jaxdyn.model.arguments import Numbers, check_known, warn
from jaxdyn.model.tree import Model
from jaxdyn.systems.scene import Scene


class LeastSquares(eqx.Module):
    """Result of `least_squares`: base parameters with standard deviations, which need not be feasible.

    - `base`: the combinations; `values`, `std`, `nominal` (nbase,): fitted, standard deviation, of the model given. Standard
      deviations count blocks of consecutive samples, as in `Intervals`; `factor`: a 95 % interval is plus and minus this many.
    - `parameters` (10 nb + 4 nv,): the x with these values that is nearest to the model's; only its combinations
      are meaningful.
    - `sigma`: root mean square of the (weighted) residual; `condition`: of the regressor with columns of unit length;
      `rank`: combinations that the log excites, at most nbase.
    - `covariance` (nbase, nbase) for independent errors of all samples, which those of a filtered log are not: use its
      correlations, and `std` for the sizes.
    """

    base: BaseParameters
    values: np.ndarray
    std: np.ndarray
    nominal: np.ndarray
    parameters: np.ndarray
    covariance: np.ndarray
    sigma: float
    condition: float
    rank: int
    factor: float
    model: Model
    terms: tuple[str, ...] = eqx.field(static=True)
    v_s: float = eqx.field(static=True)

    def torques(self, log: Log) -> np.ndarray:
        """Torques (n, nv) that the fit predicts along a log."""
        check_log(log, self.model)
        return model_torques(self.model, log, self.parameters, self.v_s)

    def error(self, log: Log) -> float:
        r"""Torque error along a log, in per cent of the measured torque, over all joints.

        $$100 |\tau_\mathrm{fit} - \tau| / |\tau|$$
        """
        return torque_error(self.torques(log), log.tau)

    def table(self) -> list[tuple[str, float, float, float]]:
        """Rows (combination, nominal, fitted, standard deviation)."""
        return list(zip(self.base.names, self.nominal.tolist(), self.values.tolist(), self.std.tolist(), strict=True))

    def summary(self) -> str:
        """Summary of the fit with a table."""
        unknown = len(self.values) - self.rank
        lines = [
            f"linear least squares, {self.model.name}: {len(self.values)} combinations of "
            f"{len(self.base.parameter_names)} parameters, rank {self.rank}, condition {self.condition:.4g}, "
            f"residual {self.sigma:.4g} N m",
        ]
        if unknown:
            lines.append(
                f"the log does not excite {unknown} combinations: where std is infinite they keep the nominal value"
            )
        width = max(map(len, self.base.names), default=0)
        lines.append(f"{'combination':{width}}  {'nominal':>12}  {'fitted':>12}  {'std':>12}")
        lines += [f"{name:{width}}  {x0:12.5g}  {x:12.5g}  {s:12.3g}" for name, x0, x, s in self.table()]
        return "\n".join(lines)


@on_one_thread
def least_squares(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    weights: Numbers | None = None,
    rcond: float = 1e-6,
    blocks: int = 20,
) -> LeastSquares:
    r"""Base parameters, friction and rotor inertia by linear least squares on the torques.

    $$\min_x |\mathrm{weights} (W x - \tau)|^2$$

    **Arguments:**

    - `model`: geometry and nominal parameters; `log` with v and a, or several such logs.
    - `terms`: fitted in addition to the links: friction torques as of `Friction`, and armature a.
    - `weights` (nv,): one over the noise of each joint's torque; ones by default.
    - `rcond`: directions whose singular value is below this times the largest are not excited by the log; along them
      the model's values stay.
    - `blocks`: consecutive samples are cut into about this many blocks, whose scatter gives the standard deviations.

    **Returns:** `LeastSquares`.

    **Raises:** ValueError when log and model do not fit together or the log has fewer rows than combinations.

    Source: Atkeson, An & Hollerbach (1986); Gautier (1991).
    """
    check_known("least_squares", model=model, log=log)
    terms = check_terms(terms, v_s)
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    weights = check_weights(weights, model.nv)
    parts = condense_model(model, logs, v_s=v_s, blocks=blocks)
    triangle, count = triangle_of(parts.rows(weights)), parts.count()
    if count <= len(base):
        samples = sum(map(len, logs))
        raise ValueError(f"the log has {samples} samples of {model.nv} torques, too few for {len(base)} combinations")
    x0 = nominal_parameters(model)
    columns = free_columns(model.nb, model.nv, terms)
    places = columns[base.independent]
    # Terms that are not fitted keep the model's value and move to the right-hand side.
    fit = least_squares_by_svd(triangle[:, places], triangle[:, -1] - triangle[:, :-1] @ x0, rcond)
    # Directions that stay at the model's values use up no degree of freedom.
    sigma = float(np.sqrt(fit.rest / (count - fit.rank)))
    covariance = sigma**2 * fit.half @ fit.half.T
    fitted = x0.copy()
    fitted[places] += fit.change
    size = effective_sample_size(
        [model_torques(model, log, fitted, v_s) - np.asarray(log.tau, np.float64) for log in logs]
    )
    std, factor = scatter(parts, weights, fitted, places, fit.half, size)
    std = np.where(fit.unknown, np.inf, std)
    nominal = base.values(x0[columns])
    parameters = x0.copy()
    # The pseudo-inverse is the smallest change of x that gives these combinations.
    parameters[columns] += np.linalg.pinv(base.matrix) @ fit.change
    return LeastSquares(
        base=base,
        values=nominal + fit.change,
        std=std,
        nominal=nominal,
        parameters=parameters,
        covariance=covariance,
        sigma=sigma,
        condition=fit.condition,
        rank=fit.rank,
        factor=factor,
        model=model,
        terms=terms,
        v_s=float(v_s),
    )


def scatter(
    blocks: Blocks, weights: np.ndarray, x: np.ndarray, places: np.ndarray, half: np.ndarray, size: float
) -> tuple[np.ndarray, float]:
    """Jackknife standard deviations of the numbers x[places] of least squares, and the factor of a 95 % interval.

    `half`: root of their covariance for noise of size 1; `size`: effective sample size of the errors.
    """
    # In coordinates y with x[places] = half y, in which the Hessian of all samples is the identity: there is no prior here.
    gradients = blocks.scores(x, weights)[:, places] @ half
    grams = blocks.grams(weights)[:, places][:, :, places]
    grams = np.einsum("pi,bpq,qj->bij", half, grams, half, optimize=True)
    estimate = jackknife(grams, gradients, np.zeros((half.shape[1],) * 2), size)
    return np.sqrt(np.sum((half @ estimate.root) ** 2, axis=1)), estimate.factor


# Most parameters named of a direction, and the smallest component that is named.
_NAMED, _SHARE = 4, 0.15


class Direction(NamedTuple):
    """Combination of base parameters: its singular value over the largest one, and a text of its largest components."""

    strength: float
    words: str


class Identifiability(NamedTuple):
    """Identifiability of a robot's parameters from logs.

    - `base`: the identifiable combinations on any motion. `rank`: the number of them that these logs excite.
    - `condition`: of the regressor in them, columns of unit length, over the directions that are excited.
    - `weakest`: the least identifiable directions, the weakest first; those not excited at all have strength 0.
    - `silent`: base parameters that the logs do not determine. `unidentifiable`: parameters that no motion determines.
    """

    base: BaseParameters
    rank: int
    condition: float
    weakest: list[Direction]
    silent: tuple[str, ...]
    unidentifiable: tuple[str, ...]

    def summary(self) -> str:
        """Text of the result."""
        lines = [
            f"the logs excite {self.rank} of {len(self.base)} identifiable combinations, condition "
            f"{self.condition:.4g}"
            + (" (well above 100: weak directions follow the prior)" if self.condition > 300 else "")
        ]
        if self.silent:
            lines.append(f"not excited by these logs: {', '.join(self.silent)}")
        for d in self.weakest:
            if d.strength > 0:
                lines.append(f"least identifiable direction, relative singular value {d.strength:.2g}: {d.words}")
        if self.unidentifiable:
            lines.append(f"unidentifiable on any motion, the file's values stay: {', '.join(self.unidentifiable)}")
        return "\n".join(lines)


def identifiability(
    model: Model,
    log: Log | Sequence[Log],
    terms: Terms = TERMS,
    *,
    v_s: float = 0.01,
    rcond: float = 1e-6,
    count: int = 3,
) -> Identifiability:
    """Identifiability of the bodies and the terms of a model from the motions of logs; their torques do not matter.

    **Arguments:** as `least_squares`; `rcond`: singular values below this share of the largest one count as zero; `count`: number
    of the weakest directions to name.

    **Returns:** `Identifiability`.

    **Raises:** ValueError as `least_squares`.

    Source: Gautier & Khalil (1992), "Exciting trajectories for the identification of base inertial parameters of robots".
    """
    check_known("identifiability", model=model, log=log)
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    # These columns are independent on a general motion, so that any loss of rank is due to the logs.
    columns = free_columns(model.nb, model.nv, base_terms(terms))[base.independent]
    A = condense_model(model, logs, v_s=v_s).rows(np.ones(model.nv))[:, columns]
    found = least_squares_by_svd(A, np.zeros(len(A)), rcond)
    silent = tuple(name for name, is_unknown in zip(base.names, found.unknown, strict=True) if is_unknown)
    weakest = weakest_directions(found, base.names, count)
    return Identifiability(base, found.rank, found.condition, weakest, silent, base.unidentifiable)


def weakest_directions(solution: SvdSolution, names: Sequence[str], count: int = 3) -> list[Direction]:
    """The least identifiable directions of a regressor, the weakest first."""
    s = solution.singular
    # Singular values descend: the last ones are the weakest directions.
    order = range(len(s) - 1, max(len(s) - 1 - count, -1), -1)
    strengths = [float(s[i] / s[0]) if i < solution.rank else 0.0 for i in order]
    return [
        Direction(strength, _words(solution.directions[i], names)) for strength, i in zip(strengths, order, strict=True)
    ]


def base_terms(terms) -> tuple[str, ...]:
    """Terms that are in `TERMS`."""
    return tuple(term for term in ((terms,) if isinstance(terms, str) else terms) if term in TERMS)


def _words(direction: np.ndarray, names: Sequence[str]) -> str:
    order = [i for i in np.argsort(-np.abs(direction))[:_NAMED] if abs(direction[i]) > _SHARE]
    # The sign of a singular vector is arbitrary: the largest component is written as positive.
    signs = np.sign(direction[order[0]]) if order else 1.0
    parts = [f"{signs * direction[i]:+.2f} {names[i]}" for i in order]
    return " ".join(parts).removeprefix("+") + (" ..." if np.sum(direction[order] ** 2) < 0.9 else "")


_BLOCKS = 20
# Residual of loops (m, rad), and share of their velocities, beyond which a log contradicts the mechanism.
_OPEN, _SLIP = 0.01, 0.1


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

    **Raises:** ValueError for another number of motors, torques of zero alone, and as `fit_parameters`.

    **Warns:** `LogWarning` for a log whose loops are open, or whose velocities the loops do not allow.

    Source: Khalil & Dombre (2002), chapters 9 and 10, base parameters of closed chains.
    """
    check_known("fit_mechanism", scene=scene, log=log)
    terms = check_terms(terms, v_s)
    logs = as_logs(log, scene.system)
    columns = np.array(check_motors(scene, np.asarray(logs[0].q)[0], motors))
    start = _with_friction(scene, columns, terms, v_s, signal_sizes(logs))
    model: Model = start.system
    every = parameter_names(model, terms)
    names = every[: 10 * model.nb] + tuple(f"{motor}.{term}" for term in terms for motor in motors)
    regressors = [motor_regressor(start, one, motors, terms, v_s) for one in logs]
    W, tau = np.concatenate(regressors), np.concatenate([np.asarray(one.tau)[:, columns] for one in logs])
    if not tau.any():
        raise ValueError(f"the torques of the motors {', '.join(motors)} are all zero; log a mechanism that is driven")
    size = root_mean_square(tau)
    # A torque that is always zero borrows the scale of the largest one.
    weights = 1 / np.where(size > 0, size, size.max())
    for number, one in enumerate(logs, 1):
        gap, slip = map(float, _loop_errors(start, *(jnp.asarray(x, model.home.dtype) for x in (one.q, one.v, one.t))))
        if gap > _OPEN or slip > _SLIP:
            warn(
                f"log {number}: the loops are open by up to {gap:.2g} (m, rad), and velocities are off by {100 * slip:.2g} %: "
                "complete the log by jd.identify.complete_log, or check the geometry",
                LogWarning,
            )
    base, _ = group_columns((W * weights[:, None]).reshape(-1, len(names)), names, model.nb, np.dtype(model.home.dtype))
    x0 = _numbers(start, columns, terms)
    # Springs and the friction of passive joints stay those of the file.
    places = tuple(columns.tolist())
    rest = tau - np.concatenate([torques_along(start, one, places)[:, columns] for one in logs])
    table, errors = (W[:, :, base.independent] * weights[:, None]), rest * weights
    flat = table.reshape(-1, len(base))
    if len(flat) <= len(base):
        raise ValueError(f"the logs have {len(flat)} torques of motors for {len(base)} combinations; log more")
    linear = least_squares_by_svd(flat, errors.reshape(-1), 1e-9)
    residual = errors - table @ linear.change
    # Relative to the torque, as `Objective.noise`; noise-free logs stay well posed.
    noise = max(float(np.sqrt(linear.rest / (len(flat) - linear.rank))), 1e-6)
    tree = Parameters(start).inertias(weight=prior)
    for term in terms:
        where = LEAVES[term]
        tree = (tree.free if term == "offset" else tree.positive)(where, rows=columns.tolist())
    fit = fit_parameters(start, logs, tree, Objective("torque", observed=tuple(motors), noise=2**0.5 * noise))
    edges = np.cumsum([len(one) for one in logs])[:-1]
    size = effective_sample_size(np.split(residual, edges))
    p, tables = len(base), np.array_split(np.concatenate([table, errors[:, :, None]], axis=2), _BLOCKS)
    triangles = [[triangle_of(part.reshape(-1, p + 1))] for part in tables]
    blocks = Blocks(triangles, (np.arange(p),), p, np.array([len(x) for x in tables]), np.zeros(len(tables), int))
    std, factor = scatter(blocks, np.ones(1), linear.change, np.arange(p), linear.half, size)
    return MechanismFit(
        fit,
        base,
        base.values(x0),
        base.values(_numbers(fit.system, columns, terms)),
        std,
        factor,
        linear.condition,
        weakest_directions(linear, base.names),
    )


@eqx.filter_jit
def _loop_errors(scene: Scene, q, v, t):
    """Largest residual of the constraints along a log, m or rad, and of their velocities as a share of the largest part."""

    def one(q, v, t):
        at = rows(scene, q, v, t)
        return tuple(jnp.max(jnp.abs(x)) for x in (position_residual(scene, q, t), at.velocity, at.A * v[None]))

    gap, slip, size = (jnp.max(x) for x in jax.vmap(one)(q, v, t))
    return gap, slip / jnp.where(size > 0, size, 1)


def _with_friction(scene: Scene, motors: np.ndarray, terms, v_s: float, sizes) -> Scene:
    """Scene with one force for the friction of all joints, of which that of the motors is positive, as a fit's start must be."""
    model, units = scene.system, term_units(sizes)
    start = dict(zip(TERMS, nominal_parameters(model)[10 * model.nb :].reshape(-1, model.nv), strict=True))
    for term in set(terms) & set(POSITIVE):
        # A hundredth of the torque where the file has none: a logarithm needs a start above zero.
        start[term][motors] = np.where(start[term] > 0, start[term], 0.1 * units[term])[motors]
    viscous, coulomb, offset, armature = (jnp.asarray(start[term], model.home.dtype) for term in TERMS)
    friction = Friction(viscous, coulomb, offset, jnp.asarray(v_s, model.home.dtype))
    others = [force for force in scene.forces if not isinstance(force, (JointDamping, CoulombFriction))]
    rotors = armature if model.armature is not None or "armature" in terms else None
    moved = Scene(model.replace(armature=rotors), scene.constraints, [friction, *others])
    return moved.with_kept_rows(scene.kept_rows)


def _numbers(scene: Scene, motors: np.ndarray, terms) -> np.ndarray:
    """Parameters x (10 nb + terms m,) in the order of the regressor's columns."""
    friction = [np.asarray(LEAVES[term](scene), np.float64)[motors] for term in terms]
    return np.concatenate([np.asarray(scene.system.inertias, np.float64).reshape(-1), *friction])
