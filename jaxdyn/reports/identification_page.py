"""Identification results as one HTML page with embedded plots, readable offline."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.identify import RobotFit
from jaxdyn.model.description import short
from jaxdyn.reports.identification import Evaluation, Findings, model_joint, total_percent
from jaxdyn.reports.page import STYLE, escape, html_table, svg
from jaxdyn.reports.plotting import BLUE, GREY, RED, new_figure, torque_figure

_MOST_SAMPLES = 1500


def page(findings: Findings, labels: Sequence[str], units: Sequence[str], title: str, notes: Sequence[str] = ()) -> str:
    """Build the page; `labels` and `units` of each torque, `notes` to follow the error.

    **Raises:** ImportError without matplotlib.
    """
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>",
        f"<style>{STYLE} .warn {{ background: #fff3e0; padding: .4rem .8rem; }}</style></head><body><h1>{escape(title)}</h1>",
        f"<p><b>Torque error {total_percent(findings.tests):.2f} %</b> on test data, "
        f"{total_percent(findings.train):.2f} % on training data; "
        f"{total_percent(findings.tests, 'nominal'):.1f} % with the file's parameters. {escape(findings.outcome)}.</p>",
        *(f"<p>{escape(line)}.</p>" for line in notes),
        *(f"<p class='warn'>{escape(line)}</p>" for line in findings.warnings),
        "<h2>Errors, in per cent of the measured torque</h2>",
        _errors(findings, labels),
    ]
    if findings.is_refit:
        parts.append(
            f"<p class='note'>The written robot is fitted to all samples, with {total_percent(findings.final):.2f} % "
            "on them; parameters below are of that fit.</p>"
        )
    for number, one in enumerate(findings.tests):
        # Each sample is a point of an SVG path: whole logs would make pages of many megabytes.
        thin = _subsample(one)
        figure = torque_figure(thin.log, thin.predicted, labels, units, title=one.name)
        parts += [
            f"<h2>{escape(one.name)}</h2>",
            svg(figure, f"torque{number}"),
            svg(_spectrum(one, labels), f"spectrum{number}"),
        ]
    parts += [
        "<h2>Identifiability</h2>",
        *(f"<p>{escape(line)}.</p>" for line in findings.identifiability.summary().split("\n")),
    ]
    parts += [_autocorrelation(findings, labels)]
    parts += _robot(findings, labels) if isinstance(findings.result, RobotFit) else []
    parts += ["<h2>Friction and rotors</h2>", _friction(findings, labels, units)]
    return "\n".join([*parts, "</body></html>\n"])


def _errors(findings: Findings, labels: Sequence[str]) -> str:
    rows = [
        (one.name, kind, str(len(one.log)), f"{one.percent:.2f}", *(short(float(x), 3) for x in one.percent_by_joint))
        for kind, group in (("test", findings.tests), ("fitted", findings.train))
        for one in group
    ]
    return html_table(("log", "", "samples", "all", *labels), rows)


def _autocorrelation(findings: Findings, labels: Sequence[str]) -> str:
    """Autocorrelation times of the errors of each log and joint."""
    rows = [
        (one.name, str(len(one.log)), *(f"{x:.2g} s ({n:.0f})" for x, n in zip(*one.whiteness, strict=True)))
        for one in (*findings.tests, *findings.train)
    ]
    note = "Autocorrelation time of the errors, and the effective sample size in brackets"
    return f"<p class='note'>{note}.</p>" + html_table(("log", "samples", *labels), rows)


def _subsample(one: Evaluation) -> Evaluation:
    """Subsample to the resolution of a plot."""
    rows = slice(0, len(one.log), max(1, len(one.log) // _MOST_SAMPLES))
    return Evaluation(one.name, one.log[rows], one.predicted[rows], one.nominal[rows])


def _spectrum(one: Evaluation, labels: Sequence[str]) -> Any:
    """Amplitude spectra of the measured torques and of the residuals."""
    count = len(labels)
    columns = min(count, 4)
    figure, axes = new_figure(
        2.9 * columns, 1.8 * -(-count // columns) + 0.6, -(-count // columns), columns, sharex=True
    )
    t, measured = np.asarray(one.log.t), np.asarray(one.log.tau, np.float64)
    # Frequency zero is left out: a logarithmic axis has no place for it.
    frequency = np.fft.rfftfreq(len(t), (t[-1] - t[0]) / max(len(t) - 1, 1))[1:]
    # A window without jumps at the ends, whose leakage would hide the decay of the spectrum.
    window = np.hanning(len(t))[:, None]
    for j, ax in enumerate(axes.flat):
        if j >= count:
            ax.set_visible(False)
            continue
        for x, colour, label in ((measured, GREY, "measured"), (one.predicted - measured, RED, "residual")):
            size = np.abs(np.fft.rfft(window * (x - x.mean(axis=0)), axis=0))[1:, j]
            ax.loglog(frequency, size / len(t), color=colour, linewidth=0.9, label=label)
        ax.minorticks_off()  # drawing hundreds of them takes most of the page's time
        ax.set_title(labels[j], fontsize=9)
        # Panels share their x axis, and only the lowest of a column shows its numbers.
        if j + columns >= count:
            ax.set_xlabel("frequency (Hz)")
            ax.tick_params(labelbottom=True)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    return figure


def _robot(findings: Findings, labels: Sequence[str]) -> list[str]:
    result = findings.result
    assert isinstance(result, RobotFit)
    choice = findings.choice or result.choice
    setting, trials, base = choice.setting, choice.trials, result.intervals.base
    loss = "squares" if setting.robust is None else f"Huber's loss beyond {setting.robust:g} standard deviations"
    extra = "; ".join(f"{name} at {', '.join(labels[j] for j in joints)}" for name, joints in setting.extra) or "none"
    parts = [
        "<h2>Chosen settings</h2>",
        f"<p>v_s {setting.v_s:g}, prior {setting.prior:g}, {loss}; terms beyond viscous and Coulomb friction: "
        f"{escape(extra)}.</p>",
    ]
    if result.delays is not None:
        half = result.delays.factor * result.delays.std
        cells = [
            (label, f"{1e3 * d:.1f}", f"{1e3 * h:.1f}" if np.isfinite(h) and d else "-")
            for label, d, h in zip(labels, result.delays.seconds, half, strict=True)
        ]
        note = "Delays of the torques relative to the positions, removed from the logs; zero where no delay lowers the error"
        parts += [f"<p class='note'>{note}.</p>", html_table(("joint", "delay (ms)", "+-"), cells)]
    if trials:
        cells = [
            (
                f"{t.percent:.3f}",
                f"{t.setting.v_s:g}",
                f"{t.setting.prior:g}",
                "squares" if t.setting.robust is None else f"{t.setting.robust:g}",
                "; ".join(f"{name} {','.join(map(str, joints))}" for name, joints in t.setting.extra) or "none",
            )
            for t in sorted(trials, key=lambda t: t.score)
        ]
        parts += [
            f"<p class='note'>{len(trials)} settings, by cross-validation over {escape(choice.by)}.</p>",
            "<details><summary>all of them, best first</summary>",
            html_table(("error (%)", "v_s", "prior", "loss", "extra terms"), cells) + "</details>",
        ]
    cells = [
        (name, short(float(x)), short(float(result.intervals.factor * s), 2), source)
        for name, x, s, source in zip(base.names, base.values, base.std, base.sources, strict=True)
    ]
    counts = {source: base.sources.count(source) for source in dict.fromkeys(base.sources)}
    counted = ", ".join(
        f"{count} from {source}" if source != "bound" else f"{count} at zero" for source, count in counts.items()
    )
    parts += [
        "<h2>Base parameters</h2>",
        f"<p class='note'>The identifiable combinations, each named after its first parameter, with the half-width of its 95 % "
        f"interval: {counted}. The JSON report states them in full.</p>",
        svg(_interval_figure(result), "intervals"),
        f"<details><summary>{len(cells)} combinations</summary>",
        html_table(("combination", "value", "+-", "from"), cells) + "</details>",
    ]
    return parts


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


def _friction(findings: Findings, labels: Sequence[str], units: Sequence[str]) -> str:
    named: dict[str, Any] = {term: values.tolist() for term, values in findings.friction.items()}
    result = findings.result
    if isinstance(result, RobotFit) and result.fit.extra is not None:
        for name, values in result.fit.extra.by_term.items():
            group = np.array(values).reshape(-1, findings.model.nv)
            named |= {name if len(group) == 1 else f"{name} {k + 1}": row.tolist() for k, row in enumerate(group)}
    sources = {}
    if isinstance(result, RobotFit):
        spread, factor = result.intervals.parameters, result.intervals.factor
        sources = {
            n: (factor * s, source) for n, s, source in zip(spread.names, spread.std, spread.sources, strict=True)
        }
    rows = []
    for j, (label, unit) in enumerate(zip(labels, units, strict=True)):
        cells = []
        for name, values in named.items():
            # Parameters are named JOINT.termK without a space, columns of the table with one.
            half, source = sources.get(f"{model_joint(findings.model, j)}.{name.replace(' ', '')}", (np.nan, ""))
            text = short(float(values[j]), 3)
            cells.append(f"{text} ± {half:.2g}{' (prior)' if source == 'prior' else ''}" if np.isfinite(half) else text)
        rows.append((label, unit, *cells))
    return html_table(("joint", "unit of torque", *named), rows)
