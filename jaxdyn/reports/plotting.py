"""Figures of motions, torques and fits, by matplotlib, imported on use (`pip install jaxdyn[plot]`).

Every function returns a `matplotlib.figure.Figure`, to be saved with `figure.savefig(path)`; no window is opened and no
global setting is touched.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

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
