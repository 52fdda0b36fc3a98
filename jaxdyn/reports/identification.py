"""What an identification found, on which logs, and all of it as JSON."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.identify import (
    TERMS,
    DriveGains,
    Fit,
    LeastSquares,
    Log,
    Payload,
    RobotFit,
    base_parameters,
    nominal_parameters,
    parameter_names,
    torque_error,
)
from jaxdyn.identify.identifiability import Identifiability
from jaxdyn.identify.regression import free_columns
from jaxdyn.identify.selection import Choice
from jaxdyn.identify.whiteness import Whiteness, whiteness
from jaxdyn.model.tree import Model


class Judged(NamedTuple):
    """A log and the torques (n, nv) that a fit and the nominal model predict along it (N m, N)."""

    name: str
    log: Log
    predicted: np.ndarray
    nominal: np.ndarray

    @property
    def percent(self) -> float:
        """100 |predicted - measured| / |measured| over all samples and joints."""
        return torque_error(self.predicted, self.log.tau)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square error of each torque (nv,)."""
        return np.sqrt(np.mean((self.predicted - np.asarray(self.log.tau)) ** 2, axis=0))

    @property
    def whiteness(self) -> Whiteness:
        """How far the error is from independent noise."""
        return whiteness(self.log, self.predicted - np.asarray(self.log.tau, np.float64))

    @property
    def percent_by_joint(self) -> np.ndarray:
        """Error of each torque in per cent of its own root mean square (nv,); NaN where none was measured."""
        measured = np.sqrt(np.mean(np.asarray(self.log.tau) ** 2, axis=0))
        return 100 * np.where(measured > 0, self.rms / np.where(measured > 0, measured, 1), np.nan)


class Findings(NamedTuple):
    """Everything that is reported.

    `result`: what is written, fitted to all training logs. `tests`: logs, or parts of logs, that were not fitted, under the fit
    that is to be judged; `train`: what that fit was made from; `final`: all training logs under `result`. `is_refit`: whether
    `result` is another fit than the one judged. `told`: what the training logs can tell.
    `choice`: how its setting was chosen, on `train`; None for other fits.
    """

    model: Model
    result: RobotFit | Fit | LeastSquares
    tests: list[Judged]
    train: list[Judged]
    final: list[Judged]
    outcome: str
    is_refit: bool
    warnings: list[str]
    told: Identifiability
    choice: Choice | None = None

    @property
    def fit(self) -> Fit | LeastSquares:
        """The fit that is written, without its choice and intervals."""
        return self.result.fit if isinstance(self.result, RobotFit) else self.result

    @property
    def parameters(self) -> np.ndarray:
        """x (10 nb + 4 nv,) of it."""
        return self.fit.parameters if isinstance(self.fit, LeastSquares) else self.fit.vector

    @property
    def friction(self) -> dict[str, np.ndarray]:
        """Terms of friction and rotors, (nv,) each."""
        blocks = self.parameters[10 * self.model.nb :].reshape(len(TERMS), self.model.nv)
        return dict(zip(TERMS, blocks, strict=True))


def total_percent(judged: Sequence[Judged], which: str = "predicted") -> float:
    """Torque error over several logs, in per cent."""
    rows = [np.asarray(getattr(one, which)).reshape(-1) for one in judged]
    return torque_error(np.concatenate(rows), np.concatenate([np.asarray(one.log.tau).reshape(-1) for one in judged]))


def content(findings: Findings, settings: dict[str, Any]) -> dict[str, Any]:
    """What goes into the JSON file; `settings` are what the user asked for, and come first."""
    model, result, fit = findings.model, findings.result, findings.fit
    names = parameter_names(model)
    base = base_parameters(model, tuple(term for term in fit.terms if term in TERMS))
    columns = free_columns(model.nb, model.nv, tuple(term for term in fit.terms if term in TERMS))
    nominal, fitted = nominal_parameters(model), findings.parameters
    report = {
        **settings,
        "outcome": findings.outcome,
        "joint_names": list(model.joint_names),
        "test_logs": {one.name: _errors(one) for one in findings.tests},
        "torque_error": {
            "test_percent": total_percent(findings.tests),
            "train_percent": total_percent(findings.train),
            "nominal_test_percent": total_percent(findings.tests, "nominal"),
            "final_percent": total_percent(findings.final),
        },
        "train_logs": {one.name: _errors(one) for one in findings.final},
        "samples": {
            "train": sum(len(one.log) for one in findings.train),
            "test": sum(len(one.log) for one in findings.tests),
            "final": sum(len(one.log) for one in findings.final),
        },
        "test_rms": findings.tests[0].rms.tolist(),
        "warnings": findings.warnings,
        "identifiability": _told(findings.told),
        "terms": list(fit.terms),
        "friction": {term: values.tolist() for term, values in findings.friction.items()},
        "base_parameters": {
            "expressions": list(base.expressions),
            "nominal": base.values(nominal[columns]).tolist(),
            "fitted": base.values(fitted[columns]).tolist(),
        },
    }
    if isinstance(result, LeastSquares):
        report["base_parameters"]["std"] = _numbers(result.std)
    else:
        rows = zip(names, nominal.tolist(), fitted.tolist(), strict=True)
        report["parameters"] = {name: {"nominal": x0, "fitted": x} for name, x0, x in rows}
    if isinstance(result, RobotFit):
        _add_robot(report, result, findings.choice or result.choice, model)
    return report


def _add_robot(report: dict[str, Any], result: RobotFit, choice: Choice, model: Model) -> None:
    setting, extra = choice.setting, result.fit.extra
    spreads = result.intervals
    report["chosen"] = {
        "v_s": setting.v_s,
        "prior": setting.prior,
        "robust": setting.robust,
        "extra_terms": {name: [model_joint(model, j) for j in joints] for name, joints in setting.extra},
        "by": choice.by,
        "trials": [
            {**t.setting._asdict(), "extra": dict(t.setting.extra), "percent": t.percent} for t in choice.trials
        ],
    }
    report["extra_terms"] = {} if extra is None else extra.named
    report["weights"] = result.weights.tolist()
    report["interval_factor"] = spreads.factor
    if result.delays is not None:
        report["delays"] = {
            "seconds": result.delays.seconds.tolist(),
            "std": _numbers(result.delays.std),
            "interval_factor": result.delays.factor if np.isfinite(result.delays.factor) else None,
            "by": "given" if result.delays.squares is None else "auto",
        }
    rows = zip(spreads.parameters.names, _numbers(spreads.parameters.std), spreads.parameters.sources, strict=True)
    for name, std, source in rows:
        report["parameters"].setdefault(name, {})
        report["parameters"][name] |= {"std": std, "from": source}
    for name, value in zip(spreads.parameters.names, spreads.parameters.values, strict=True):
        report["parameters"][name].setdefault("fitted", float(value))
    report["base_parameters"] |= {"std": _numbers(spreads.base.std), "from": spreads.base.sources}


def gains_content(gains: DriveGains) -> dict[str, Any]:
    """Gains of drives for the JSON file."""
    return {
        "gains": gains.gains.tolist(),
        "std": gains.std.tolist(),
        "interval_factor": gains.factor,
        "told": list(gains.told),
        "percent": gains.error,
        "v_s": gains.v_s,
    }


def payload_content(payload: Payload) -> dict[str, Any]:
    """A payload for the JSON file."""
    return {
        "body": payload.body,
        "mass": payload.mass,
        "centre": payload.centre.tolist(),
        "inertia_about_centre": payload.rotational.tolist(),
        "ten_numbers": payload.inertia.tolist(),
        "std": payload.std.tolist(),
        "interval_factor": payload.factor,
        "percent": payload.error,
        "percent_without": payload.without,
    }


def model_joint(model: Model, coordinate: int) -> str:
    """Name of a number of v: the joint's, with an index where it has several."""
    start = 10 * model.nb
    return parameter_names(model)[start + coordinate].rpartition(".")[0]


def _errors(one: Judged) -> dict[str, Any]:
    return {
        "percent": one.percent,
        "percent_by_joint": _numbers(one.percent_by_joint),
        "rms_by_joint": one.rms.tolist(),
        "nominal_percent": torque_error(one.nominal, one.log.tau),
        "samples": len(one.log),
        "error_lasts_seconds": one.whiteness.correlation_time.tolist(),
        "worth_independent_samples": one.whiteness.effective_samples.tolist(),
    }


def _told(told: Identifiability) -> dict[str, Any]:
    return {
        "rank": told.rank,
        "combinations": len(told.base),
        "condition": told.condition if np.isfinite(told.condition) else None,
        "weakest": [direction._asdict() for direction in told.weakest],
        "not_excited": list(told.silent),
        "told_by_no_motion": list(told.unidentifiable),
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which has no infinity."""
    return [float(x) if np.isfinite(x) else None for x in values]
