"""Figures by matplotlib, imported on use (`pip install jaxdyn[plot]`), and the records and pages of reports.

Functions that draw return a `matplotlib.figure.Figure`, to be saved with `figure.savefig(path)`; no window is opened and no
global setting is touched.
"""

import dataclasses
import html
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxdyn.model.description import short, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
else:
    Axes = Any  # matplotlib is imported when a figure is drawn

# Colours distinguishable in print and for colour-blind readers (Okabe & Ito 2008).
BLUE, ORANGE, GREEN, RED, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#7f7f7f"
SERIES = (BLUE, ORANGE, GREEN, RED, "#cc79a7", "#56b4e9", "#000000", "#f0e442")


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options) -> tuple[Any, np.ndarray]:
    """Create a figure (inches) and its axes (rows, columns) in the common style."""
    # Figure instead of pyplot: no global state, no window, no backend chosen.
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("figures need matplotlib: pip install jaxdyn[plot]") from error
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for ax in axes.flat:
        style(ax)
    return figure, axes


def style(ax) -> None:
    """Apply the common style: thin grid, no box, small labels."""
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="0.9", linewidth=0.6)
    # The grid would otherwise cross thin lines.
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=8)
    ax.xaxis.label.set_size(9)
    ax.yaxis.label.set_size(9)
    ax.title.set_size(9.5)


def bands(ax, t, values, colour: str, label: str | None = None) -> None:
    """Plot the spread of many motions (n, nt): 5 to 95 %, 25 to 75 %, and the median."""
    # Motions that stopped early are NaN and are left out of the percentiles.
    low, quarter, middle, three, high = np.nanpercentile(np.asarray(values), [5, 25, 50, 75, 95], axis=0)
    ax.fill_between(t, low, high, color=colour, alpha=0.15, linewidth=0)
    ax.fill_between(t, quarter, three, color=colour, alpha=0.3, linewidth=0)
    ax.plot(t, middle, color=colour, linewidth=1.3, label=label)


def joint_panels(count: int, height: float, xlabel: str) -> tuple[Any, list[Any]]:
    """Figure with a panel of a given height (inches) for each of `count` joints, four in a row, and their axes."""
    columns = min(count, 4)
    rows = -(-count // columns)  # rounded up
    figure, axes = new_figure(2.9 * columns, height * rows + 0.6, rows, columns, sharex=True)
    for j, ax in enumerate(axes.flat):
        ax.set_visible(j < count)
        # The lowest panel of each column has the labels of the shared axis.
        if j + columns >= count:
            ax.set_xlabel(xlabel)
            ax.tick_params(labelbottom=True)
    return figure, list(axes.flat)[:count]


def add_legend(figure, ax) -> None:
    """Add the legend of one panel below all."""
    handles, names = ax.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=9, frameon=False)


def torque_figure(log, predicted, labels, units, *, title: str = "held-out samples") -> Any:
    """Measured and predicted torque of every joint along a log, one panel each, with the error beneath in the same scale.

    **Arguments:** `log`, a `jd.identify.Log`; `predicted` (n, nv); `labels`, `units`: of each coordinate.

    **Raises:** ImportError without matplotlib.
    """
    t, measured, predicted = np.asarray(log.t), np.asarray(log.tau), np.asarray(predicted)
    figure, axes = joint_panels(measured.shape[1], 2.1, "time (s)")
    for j, ax in enumerate(axes):
        ax.plot(t, measured[:, j], color="0.6", linewidth=2.4, label="measured")
        ax.plot(t, predicted[:, j], color=BLUE, linewidth=1.0, label="predicted")
        ax.plot(t, predicted[:, j] - measured[:, j], color=RED, linewidth=0.8, label="difference")
        share = 100 * np.linalg.norm(predicted[:, j] - measured[:, j]) / np.linalg.norm(measured[:, j])
        ax.set_title(f"{labels[j]}: error {share:.1f} %", fontsize=9)
        ax.set_ylabel(f"torque ({units[j]})" if units[j] == "N m" else f"force ({units[j]})", fontsize=9)
    total = 100 * np.linalg.norm(predicted - measured) / np.linalg.norm(measured)
    figure.suptitle(f"{title}: torque error {total:.2f} %", fontsize=10)
    add_legend(figure, axes[0])
    return figure


# --- records of a report, one per run, as JSON, as text and as one HTML page with embedded plots, readable offline ---


@dataclasses.dataclass(frozen=True)
class Record:
    """Record of one run of a ladder: scene, integrator, errors and times. None means unknown.

    - `source`: "jaxdyn", or the name of a peer; `method`, `solver`, `dtype`; `batch`: trajectories at once.
    - `setting`: rtol = atol, or the step (s) when `fixed`.
    - `result`: "successful", or the name of the result code; then there are no errors.
    - `error_end`, `error_path`: error at the last save point and the largest of all (`cases.errors`).
    - `residual_position`, `residual_velocity`: largest |phi| and |A v - b|; `energy_error`: largest |E - E(0)|, J.
    - `seconds_best`, `seconds_median`: wall time per trajectory, of `rounds`; `compile_seconds`, separate, of the ladder.
    - `steps`, rejected ones included, and `rejected`; `evaluations` of the vector field.
      Of the first trajectory of a batch, whose start is the reference's.
    """

    scene: str
    source: str
    method: str
    solver: str
    dtype: str
    batch: int
    setting: float
    fixed: bool
    result: str
    error_end: float | None
    error_path: float | None
    residual_position: float | None
    residual_velocity: float | None
    energy_error: float | None
    seconds_best: float
    seconds_median: float
    rounds: int
    compile_seconds: float | None
    steps: int | None
    rejected: int | None
    evaluations: int | None

    @property
    def label(self) -> str:
        """Label of the record's ladder within its scene."""
        ours = self.source == "jaxdyn"
        return f"{self.method}, {self.solver}" if ours else f"{self.source}, {self.solver}"


@dataclasses.dataclass(frozen=True)
class SceneReference:
    """Reference of a scene."""

    text: str
    kind: str
    source: str
    error: float


@dataclasses.dataclass(frozen=True)
class Report:
    """Records of a report with their context: `head` (machine, versions, date) and each scene's reference."""

    head: dict[str, Any]
    scenes: dict[str, SceneReference]
    records: tuple[Record, ...]

    def of(self, scene: str) -> tuple[Record, ...]:
        """Records of one scene."""
        return tuple(record for record in self.records if record.scene == scene)

    def to_json(self) -> str:
        """Convert the report to JSON; `from_json` reads it."""
        return json.dumps(dataclasses.asdict(self), indent=1)

    @staticmethod
    def from_json(text: str) -> "Report":
        """Read a report that `to_json` wrote."""
        data = json.loads(text)
        scenes = {name: SceneReference(**known) for name, known in data["scenes"].items()}
        return Report(data["head"], scenes, tuple(Record(**record) for record in data["records"]))

    def table(self, scene: str | None = None) -> str:
        """Table of records as text, of one scene or of all."""
        sections = []
        for name in [scene] if scene else self.scenes:
            known, records = self.scenes[name], self.of(name)
            head = f"{known.text}\nReference: {known.kind}, {known.source}; its own error about {short(known.error, 1)}"
            sections.append(f"{head}\n{table(COLUMNS, rows(records))}" if records else head)
        return "\n\n".join(sections)


def pareto_front(records: Iterable[Record], *, error: str = "error_path", cost: str = "seconds_best") -> list[Record]:
    """Pareto-optimal records in `error` and `cost`, from cheap to accurate, without failed runs."""
    # After sorting by cost, a record is on the front if its error is below that of all cheaper ones.
    # Failed runs have no error.
    usable = [r for r in records if getattr(r, error) is not None and getattr(r, cost) is not None]
    # At equal cost the more accurate record comes first and hides the other.
    usable.sort(key=lambda r: (getattr(r, cost), getattr(r, error)))
    front: list[Record] = []
    for record in usable:
        # Strictly: of two equally accurate runs only the cheaper one is on the front.
        if not front or getattr(record, error) < getattr(front[-1], error):
            front.append(record)
    return front


COLUMNS = (
    "method", "dtype", "batch", "setting", "error", "at end", "residual", "energy", "us", "median", "rounds", "steps", "evals",
    "compile s", "result",
)  # fmt: skip


def rows(records: Iterable[Record]) -> list[list[str]]:
    """Cells of a table with COLUMNS, one row per record."""
    table = []
    for r in records:
        # Scenes without constraints have neither.
        residuals = [x for x in (r.residual_position, r.residual_velocity) if x is not None]
        table.append(
            [
                r.label,
                r.dtype,
                str(r.batch),
                f"{'h ' if r.fixed else ''}{r.setting:.1e}",
                *(short(x, 2) for x in (r.error_path, r.error_end, max(residuals, default=None), r.energy_error)),
                # Microseconds: most runs of one trajectory take less than a millisecond.
                *(f"{1e6 * x:.4g}" for x in (r.seconds_best, r.seconds_median)),
                *("-" if x is None else str(x) for x in (r.rounds, r.steps, r.evaluations)),
                short(r.compile_seconds, 2),
                # An empty cell, so that failures stand out.
                "" if r.result == "successful" else r.result,
            ]
        )
    return table


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
    machine = report.head["machine"]
    versions = ", ".join(f"{name} {x}" for name, x in machine["versions"].items() if x)
    about = f"{machine['processor']}, {machine['cores']} cores, device {machine['device']}, load {machine['load']} at the start"
    about += f"; {versions}; {report.head['date']}"
    parts = [f"<p>{html.escape(about)}</p><p class='note'>{_READING}</p>"]
    for name, known in report.scenes.items():
        parts.append(f"<h2 id='{html.escape(name)}'>{html.escape(known.text)}</h2>")
        records = report.of(name)
        for dtype, batch in dict.fromkeys((r.dtype, r.batch) for r in records):
            group = [r for r in records if (r.dtype, r.batch) == (dtype, batch)]
            parts.append(svg(figure(f"{dtype}, {batch} at once", known, group), f"{name}{dtype}{batch}"))
        parts.append(f"<details><summary>{len(records)} runs</summary>{text_block(report.table(name))}</details>")
    return document("Error against run time", parts)


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
