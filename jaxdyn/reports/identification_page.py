"""Identification results as one HTML page: the printed tables and plots, readable offline."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.identify import RobotFit
from jaxdyn.reports.identification import Evaluation, Findings
from jaxdyn.reports.page import document, svg, text_block
from jaxdyn.reports.plotting import BLUE, GREY, RED, add_legend, joint_panels, new_figure, torque_figure

_MOST_SAMPLES = 1500


def page(findings: Findings, labels: Sequence[str], units: Sequence[str], title: str, text: str) -> str:
    """Build the page; `labels` and `units` of each torque, and the `text` of the tables that are printed.

    **Raises:** ImportError without matplotlib.
    """
    parts = [text_block(text)]
    for number, one in enumerate(findings.tests):
        # Each sample is a point of an SVG path: whole logs would make pages of many megabytes.
        thin = _subsample(one)
        figure = torque_figure(thin.log, thin.predicted, labels, units, title=one.name)
        parts += [
            f"<h2>{html.escape(one.name)}</h2>",
            svg(figure, f"torque{number}"),
            svg(_spectrum(one, labels), f"spectrum{number}"),
        ]
    if isinstance(findings.result, RobotFit):
        parts += ["<h2>Base parameters</h2>", svg(_interval_figure(findings.result), "intervals")]
    return document(title, parts)


def _subsample(one: Evaluation) -> Evaluation:
    """Subsample to the resolution of a plot."""
    rows = slice(0, len(one.log), max(1, len(one.log) // _MOST_SAMPLES))
    return Evaluation(one.name, one.log[rows], one.predicted[rows], one.nominal[rows])


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
