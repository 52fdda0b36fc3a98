"""Linear least squares on the torques, with jackknife standard deviations, and identifiability: rank and weak directions."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxdyn.identify.descent import on_one_thread
from jaxdyn.identify.logs import Log, as_logs, check_log
from jaxdyn.identify.regression import (
    BaseParameters,
    base_parameters,
    check_weights,
    condense,
    condense_model,
    condense_rows,
    free_columns,
    least_squares_by_svd,
    model_torques,
    nominal_parameters,
    torque_error,
)
from jaxdyn.identify.torque_terms import TERMS, Terms, check_terms
from jaxdyn.identify.uncertainty import effective_sample_size, jackknife
from jaxdyn.model.arguments import Numbers
from jaxdyn.model.tree import Model


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
    terms = check_terms(terms, v_s)
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    weights = check_weights(weights, model.nv)
    parts = condense_model(model, logs, v_s=v_s, blocks=blocks)
    condensed = condense_rows(parts.rows(weights), parts.count())
    if condensed.rows <= len(base):
        samples = sum(map(len, logs))
        raise ValueError(f"the log has {samples} samples of {model.nv} torques, too few for {len(base)} combinations")
    x0 = nominal_parameters(model)
    columns = free_columns(model.nb, model.nv, terms)
    # Terms that are not fitted keep the model's value and move to the right-hand side.
    residual = condensed.d - condensed.R @ x0
    fit = least_squares_by_svd(condensed.R[:, columns[base.independent]], residual, rcond)
    rest = condensed.rest + fit.rest
    # Directions that stay at the model's values use up no degree of freedom.
    sigma = float(np.sqrt(rest / (condensed.rows - fit.rank)))
    covariance = sigma**2 * fit.half @ fit.half.T
    places = columns[base.independent]
    fitted = x0.copy()
    fitted[places] += fit.change
    size = effective_sample_size(
        [model_torques(model, log, fitted, v_s) - np.asarray(log.tau, np.float64) for log in logs]
    )
    # In coordinates y with x[places] = half y, in which the Hessian of all samples is the identity.
    gradients = parts.scores(fitted, weights)[:, places] @ fit.half
    grams = parts.grams(weights)[:, places][:, :, places]
    grams = np.einsum("pi,bpq,qj->bij", fit.half, grams, fit.half, optimize=True)
    std, factor = scatter(grams, gradients, fit.half, size)
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


def scatter(grams, gradients, half: np.ndarray, size: float) -> tuple[np.ndarray, float]:
    """Jackknife standard deviations of numbers half y, and the factor of a 95 % interval.

    `grams` (blocks, n, n) and `gradients` (blocks, n) of blocks of samples by y; `size`: effective sample size of the errors.
    """
    # There is no prior here: in these coordinates the blocks' curvatures add up to the identity.
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
    logs = as_logs(log, model)
    base = base_parameters(model, terms, v_s=v_s)
    # These columns are independent on a general motion, so that any loss of rank is due to the logs.
    columns = free_columns(model.nb, model.nv, base_terms(terms))[base.independent]
    A = condense(model, logs, v_s=v_s).R[:, columns]
    scale = np.linalg.norm(A, axis=0)
    # Columns that the logs do not excite become zero; scaled to unit length, their rounding errors would count as excited.
    scale[scale <= 1e-12 * scale.max(initial=0.0)] = np.inf
    _, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    rank = int(np.sum(s > rcond * s.max(initial=0.0)))
    # A parameter with any share in the null space is not determined, whatever its other components.
    unknown = np.sum(Vt[rank:] ** 2, axis=0) > 1e-12
    weakest = _weakest(s, Vt, rank, base.names, count)
    silent = tuple(name for name, is_unknown in zip(base.names, unknown, strict=True) if is_unknown)
    condition = float(s[0] / s[rank - 1]) if rank else np.inf
    return Identifiability(base, rank, condition, weakest, silent, base.unidentifiable)


def weakest_directions(A: np.ndarray, names: Sequence[str], count: int = 3) -> list[Direction]:
    """The least identifiable directions of a regressor (rows, p) of full rank, the weakest first."""
    _, s, Vt = np.linalg.svd(np.linalg.qr(A / np.linalg.norm(A, axis=0))[1])
    return _weakest(s, Vt, len(s), names, count)


def _weakest(s: np.ndarray, Vt: np.ndarray, rank: int, names: Sequence[str], count: int) -> list[Direction]:
    # Singular values descend: the last ones are the weakest directions.
    order = range(len(s) - 1, max(len(s) - 1 - count, -1), -1)
    return [Direction(float(s[i] / s[0]) if i < rank else 0.0, _words(Vt[i], names)) for i in order]


def base_terms(terms) -> tuple[str, ...]:
    """Terms that are in `TERMS`."""
    return tuple(term for term in ((terms,) if isinstance(terms, str) else terms) if term in TERMS)


def _words(direction: np.ndarray, names: Sequence[str]) -> str:
    order = [i for i in np.argsort(-np.abs(direction))[:_NAMED] if abs(direction[i]) > _SHARE]
    # The sign of a singular vector is arbitrary: the largest component is written as positive.
    signs = np.sign(direction[order[0]]) if order else 1.0
    parts = [f"{signs * direction[i]:+.2f} {names[i]}" for i in order]
    return " ".join(parts).removeprefix("+") + (" ..." if np.sum(direction[order] ** 2) < 0.9 else "")
