"""Results of an identification: their JSON form, and one HTML page with the printed tables and plots, readable offline."""

import html
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.constraints.codes import name_of
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
from jaxdyn.identify.linear_fit import Identifiability
from jaxdyn.identify.regression import coordinate_names, free_columns
from jaxdyn.identify.selection import Choice
from jaxdyn.identify.uncertainty import Whiteness, whiteness
from jaxdyn.model.tree import Model
from jaxdyn.reports.plotting import (
    BLUE,
    GREY,
    RED,
    add_legend,
    document,
    joint_panels,
    new_figure,
    svg,
    text_block,
    torque_figure,
)


class Evaluation(NamedTuple):
    """Evaluation of a fit on a log: the torques (n, nv) predicted by the fit and by the nominal model (N m, N)."""

    name: str
    log: Log
    predicted: np.ndarray
    nominal: np.ndarray

    @property
    def percent(self) -> float:
        """Torque error 100 |predicted - measured| / |measured| over all samples and joints."""
        return torque_error(self.predicted, self.log.tau)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square error of each torque (nv,)."""
        return np.sqrt(np.mean((self.predicted - np.asarray(self.log.tau)) ** 2, axis=0))

    @property
    def whiteness(self) -> Whiteness:
        """Autocorrelation of the error."""
        # In float64: an autocorrelation is a long sum, in which rounding of float32 would show.
        return whiteness(self.log, self.predicted - np.asarray(self.log.tau, np.float64))

    @property
    def percent_by_joint(self) -> np.ndarray:
        """Error of each torque in per cent of its own root mean square (nv,); NaN where none was measured."""
        measured = np.sqrt(np.mean(np.asarray(self.log.tau) ** 2, axis=0))
        # Double where: a joint without torque must not warn about a division by zero.
        return 100 * np.where(measured > 0, self.rms / np.where(measured > 0, measured, 1), np.nan)


class Findings(NamedTuple):
    """All results of an identification.

    `result`: the written fit, to all training logs. `tests`: test logs, or held-out parts of logs, under the evaluated
    fit; `train`: its training logs; `final`: all training logs under `result`. `is_refit`: whether
    `result` is another fit than the evaluated one. `identifiability`: that of the parameters from the training logs.
    `choice`: the choice of settings on `train`; None for other fits.
    """

    model: Model
    result: RobotFit | Fit | LeastSquares
    tests: list[Evaluation]
    train: list[Evaluation]
    final: list[Evaluation]
    outcome: str
    is_refit: bool
    warnings: list[str]
    identifiability: Identifiability
    choice: Choice | None = None

    @property
    def fit(self) -> Fit | LeastSquares:
        """Written fit, without its choice of settings and intervals."""
        return self.result.fit if isinstance(self.result, RobotFit) else self.result

    @property
    def parameters(self) -> np.ndarray:
        """Parameters x (10 nb + 4 nv,) of the written fit."""
        return self.fit.parameters if isinstance(self.fit, LeastSquares) else self.fit.vector

    @property
    def friction(self) -> dict[str, np.ndarray]:
        """Terms of friction and rotors, (nv,) each."""
        # Order of the parameter vector: ten for each body, then nv of each term.
        blocks = self.parameters[10 * self.model.nb :].reshape(len(TERMS), self.model.nv)
        return dict(zip(TERMS, blocks, strict=True))


def total_percent(evaluations: Sequence[Evaluation], which: str = "predicted") -> float:
    """Torque error over several logs, in per cent."""
    # Logs have different lengths, so their errors add as squares over all samples.
    rows = [np.asarray(getattr(one, which)).reshape(-1) for one in evaluations]
    return torque_error(
        np.concatenate(rows), np.concatenate([np.asarray(one.log.tau).reshape(-1) for one in evaluations])
    )


def content(findings: Findings, settings: dict[str, Any]) -> dict[str, Any]:
    """Content of the JSON file; `settings` are the user's options, and come first."""
    model, result, fit = findings.model, findings.result, findings.fit
    names = parameter_names(model)
    # The regressor of the base parameters has columns for `TERMS` alone.
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
        "identifiability": _identifiability(findings.identifiability),
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
    report["extra_terms"] = {} if extra is None else extra.by_term
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
        # Extra terms have intervals but no place among the standard parameters.
        report["parameters"].setdefault(name, {})
        report["parameters"][name] |= {"std": std, "from": source}
    for name, value in zip(spreads.parameters.names, spreads.parameters.values, strict=True):
        report["parameters"][name].setdefault("fitted", float(value))
    report["base_parameters"] |= {"std": _numbers(spreads.base.std), "from": spreads.base.sources}


def gains_content(gains: DriveGains) -> dict[str, Any]:
    """Drive gains for the JSON file."""
    return {
        "gains": gains.gains.tolist(),
        "std": gains.std.tolist(),
        "interval_factor": gains.factor,
        "identifiable": list(gains.identifiable),
        "percent": gains.error,
        "v_s": gains.v_s,
        "result": name_of(gains.result),
    }


def payload_content(payload: Payload) -> dict[str, Any]:
    """Payload for the JSON file."""
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
        "result": name_of(payload.result),
    }


def model_joint(model: Model, coordinate: int) -> str:
    """Name of a coordinate of v: the joint's, with an index where it has several."""
    return coordinate_names(model)[coordinate]


def _errors(one: Evaluation) -> dict[str, Any]:
    return {
        "percent": one.percent,
        "percent_by_joint": _numbers(one.percent_by_joint),
        "rms_by_joint": one.rms.tolist(),
        "nominal_percent": torque_error(one.nominal, one.log.tau),
        "samples": len(one.log),
        "autocorrelation_time_seconds": one.whiteness.correlation_time.tolist(),
        "effective_sample_size": one.whiteness.effective_samples.tolist(),
    }


def _identifiability(found: Identifiability) -> dict[str, Any]:
    return {
        "rank": found.rank,
        "combinations": len(found.base),
        "condition": found.condition if np.isfinite(found.condition) else None,
        "weakest": [direction._asdict() for direction in found.weakest],
        "not_excited": list(found.silent),
        "unidentifiable": list(found.unidentifiable),
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    """Convert numbers for JSON, which has no infinity."""
    return [float(x) if np.isfinite(x) else None for x in values]


_MAX_SAMPLES = 1500


def page(findings: Findings, labels: Sequence[str], units: Sequence[str], title: str, text: str) -> str:
    """Build the page; `labels` and `units` of each torque, and the `text` of the tables that are printed.

    **Raises:** ImportError without matplotlib.
    """
    parts = [text_block(text)]
    for number, one in enumerate(findings.tests):
        # Each sample is a point of an SVG path: whole logs would make pages of many megabytes.
        rows = slice(0, len(one.log), max(1, len(one.log) // _MAX_SAMPLES))
        figure = torque_figure(one.log[rows], one.predicted[rows], labels, units, title=one.name)
        parts += [
            f"<h2>{html.escape(one.name)}</h2>",
            svg(figure, f"torque{number}"),
            svg(_spectrum(one, labels), f"spectrum{number}"),
        ]
    if isinstance(findings.result, RobotFit):
        parts += ["<h2>Base parameters</h2>", svg(_interval_figure(findings.result), "intervals")]
    return document(title, parts)


def _spectrum(one: Evaluation, labels: Sequence[str]) -> Any:
    """Amplitude spectra of the measured torques and of the residuals."""
    figure, axes = joint_panels(len(labels), 1.8, "frequency (Hz)")
    t, measured = np.asarray(one.log.t), np.asarray(one.log.tau, np.float64)
    # Frequency zero is left out: a logarithmic axis has no place for it.
    frequency = np.fft.rfftfreq(len(t), (t[-1] - t[0]) / max(len(t) - 1, 1))[1:]
    # A window without jumps at the ends, whose leakage would hide the decay of the spectrum.
    window = np.hanning(len(t))[:, None]
    for j, ax in enumerate(axes):
        for x, colour, label in ((measured, GREY, "measured"), (one.predicted - measured, RED, "residual")):
            size = np.abs(np.fft.rfft(window * (x - x.mean(axis=0)), axis=0))[1:, j]
            ax.loglog(frequency, size / len(t), color=colour, linewidth=0.9, label=label)
        ax.minorticks_off()  # drawing hundreds of them takes most of the page's time
        ax.set_title(labels[j], fontsize=9)
    add_legend(figure, axes[0])
    return figure


def _interval_figure(result: RobotFit) -> Any:
    """Half-widths of the 95 % intervals relative to the values, sorted; blue from data, grey from the prior."""
    base = result.intervals.base
    # A logarithmic axis shows no infinite interval, and a value of zero has no relative one.
    shown = np.isfinite(base.std) & (base.values != 0)
    ratio = result.intervals.factor * base.std[shown] / np.abs(base.values[shown])
    order = np.argsort(ratio)
    colours = np.where(np.array(base.sources)[shown][order] == "data", BLUE, GREY)
    figure, axes = new_figure(11.0, 2.8)
    ax = axes[0, 0]
    ax.bar(np.arange(len(order)), ratio[order], color=colours.tolist())
    ax.axhline(1, color=RED, linewidth=0.8)
    ax.set(yscale="log", ylabel="half interval / value", xlim=(-1, len(order)))
    ax.set_xticks(np.arange(len(order)), np.array(base.names)[shown][order].tolist(), rotation=90, fontsize=6)
    ax.set_title(
        "Relative half-widths of base parameters: blue from data, grey from the prior, undetermined above the line"
    )
    return figure
