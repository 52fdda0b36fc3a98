"""Page of a report: one HTML file with embedded plots, readable offline."""

import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from jaxdyn.reports.plotting import GREY, SERIES, new_figure
from jaxdyn.reports.records import Record, Report, SceneReference, pareto_front

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.5rem; }
pre { font-size: 12px; overflow-x: auto; } svg { max-width: 100%; height: auto; } .note { color: #555; }
"""
_READING = """
Each line is one integrator, each point a tolerance or a step: left is more accurate, down is
cheaper. Points with a grey disc are on the Pareto front. The error is the largest |y - r|/(1 + |r|)
over the entries y of position and velocity and over the save points, r the reference; quaternions are compared as rotation
matrices. In the grey band on the left the error of the reference dominates. Times are the best of the rounds, per
trajectory, without compilation. All runs of a plot were timed interleaved, so its lines compare; plots of different
machines do not. Evaluations of implicit methods are not counted.
"""


def write(report: Report, directory: str | Path) -> None:
    """Write report.json, report.txt and report.html."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    # The page comes last: only it needs matplotlib.
    for kind, text in (
        ("json", report.to_json),
        ("txt", lambda: report.table() + "\n"),
        ("html", lambda: html_page(report)),
    ):
        (directory / f"report.{kind}").write_text(text(), encoding="utf-8")


def document(title: str, parts: Iterable[str]) -> str:
    """Page of HTML elements that works offline."""
    head = f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{html.escape(title)}</title>"
    start = f"{head}<style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>"
    return "\n".join([start, *parts, "</body></html>\n"])


def text_block(text: str) -> str:
    """Element of a page that shows a text with its lines and columns."""
    return f"<pre>{html.escape(text)}</pre>"


def html_page(report: Report) -> str:
    """Build the report as one self-contained HTML page: plots as SVG, tables, the machine."""
    parts = [f"<p>{html.escape(_machine(report.head))}</p><p class='note'>{_READING}</p>"]
    for name, known in report.scenes.items():
        parts.append(f"<h2 id='{html.escape(name)}'>{html.escape(known.text)}</h2>")
        records = report.of(name)
        for dtype, batch in dict.fromkeys((r.dtype, r.batch) for r in records):
            group = [r for r in records if (r.dtype, r.batch) == (dtype, batch)]
            parts.append(svg(figure(f"{dtype}, {batch} at once", known, group), f"{name}{dtype}{batch}"))
        parts.append(f"<details><summary>{len(records)} runs</summary>{text_block(report.table(name))}</details>")
    return document("Error against run time", parts)


def _machine(head) -> str:
    machine = head["machine"]
    versions = ", ".join(f"{name} {x}" for name, x in machine["versions"].items() if x)
    return (
        f"{machine['processor']}, {machine['cores']} cores, device {machine['device']}, load {machine['load']} at the start; "
        f"{versions}; {head['date']}"
    )


def figure(title: str, known: SceneReference, records: Sequence[Record]) -> Any:
    """Log-log plots of one scene: error against time, against evaluations, and the energy error against time.

    **Returns:** a matplotlib figure, or None when no run succeeded.
    """
    panels = [("error_path", "seconds_best", "time per trajectory (s)")]
    panels += [("error_path", "evaluations", "evaluations of the vector field")]
    panels += [("energy_error", "seconds_best", "time per trajectory (s)")]
    # A panel without points would be an empty plot.
    panels = [p for p in panels if any(getattr(r, p[0]) is not None and getattr(r, p[1]) is not None for r in records)]
    if not panels:
        return None
    # As wide as a page of text, so that labels keep their size there.
    drawn, axes = new_figure(3.0 * len(panels), 4.0, 1, len(panels))
    for ax, (error, cost, label) in zip(axes[0], panels, strict=True):
        panel(ax, records, error, cost)
        ax.set(xscale="log", yscale="log", ylabel=label)
        ax.set_xlabel("energy error (J)" if error == "energy_error" else "error")
        if error == "error_path":
            # After the lines are drawn, whose limits the band extends to.
            ax.axvspan(ax.get_xlim()[0], max(known.error, ax.get_xlim()[0]), color="0.93", zorder=0)
    # Panels have the same lines; a dictionary shows each label once.
    shown = {label: handle for ax in axes[0] for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    drawn.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    drawn.suptitle(title, fontsize=10)
    return drawn


def svg(drawn, salt: str) -> str:
    """Convert a figure to an element of a page; `salt` keeps its ids distinct from those of other figures."""
    import matplotlib

    if drawn is None:
        return "<p>No run succeeded; see the results below.</p>"
    text = io.StringIO()
    # Text stays text, which is smaller and can be searched; a fixed salt makes pages reproducible.
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        # Without a date, equal results give equal files.
        drawn.savefig(text, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    # An HTML page must not contain the XML declaration in front.
    return text.getvalue()[text.getvalue().index("<svg") :]


def panel(ax, records, error: str, cost: str) -> None:
    """Plot `cost` against `error` of records, a line per ladder, with halos on the front."""
    smallest = 1e-16  # logarithmic axes have no zero
    for i, label in enumerate(dict.fromkeys(r.label for r in records)):
        ladder = [r for r in records if r.label == label and None not in (getattr(r, error), getattr(r, cost))]
        points = [(max(getattr(r, error), smallest), getattr(r, cost)) for r in ladder]
        ours = all(r.source == "jaxdyn" for r in records if r.label == label)
        # Peers differ by line and marker too, so that the plot is readable in print.
        line, marker = ("-", "o") if ours else ("--", "s")
        colour = SERIES[i % len(SERIES)]
        filled = colour if ours else "white"
        style = {"color": colour, "markersize": 4, "linewidth": 1.2, "markerfacecolor": filled}
        # A ladder whose runs all failed still has its entry in the legend.
        ax.plot(*(zip(*points, strict=True) if points else ((), ())), line, marker=marker, label=label, **style)
    front = [
        (max(getattr(r, error), smallest), getattr(r, cost)) for r in pareto_front(records, error=error, cost=cost)
    ]
    halo = {"markersize": 10, "alpha": 0.35, "markeredgewidth": 0, "zorder": 1}
    ax.plot(*zip(*front, strict=True), "o", color=GREY, label="on the front", **halo)
