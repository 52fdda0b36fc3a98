"""Figures of motions, torques and fits, by matplotlib, imported on use (`pip install jaxdyn[plot]`).

Every function returns a `matplotlib.figure.Figure`, to be saved with `figure.savefig(path)`; no window is opened and no
global setting is touched.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxdyn.model.joints import KINDS
from jaxdyn.model.tree import Model

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


def motion_figure(model: Model, ts, q, v, tau) -> Any:
    """Position, velocity and torque of every one-coordinate joint over time.

    **Arguments:** `ts` (nt,) s; `q` (n, nt, nq); `v`, `tau` (n, nt, nv), of n motions. One motion is drawn as a line, many as
    their median with bands of 25 to 75 and 5 to 95 %. Joints with more coordinates are not drawn; all coordinates
    are listed by `jaxdyn info`.

    **Raises:** ImportError without matplotlib.
    """
    q, v, tau = (np.asarray(x) for x in (q, v, tau))
    topology = model.topology
    joints = [i for i, kind in enumerate(topology.kinds) if KINDS[kind].nv == 1]
    linear = {topology.kinds[i] == "prismatic" for i in joints}
    units = ("m", "m/s", "N") if linear == {True} else ("rad", "rad/s", "N m")
    units = units if len(linear) < 2 else ("rad, m", "rad/s, m/s", "N m, N")
    many = len(q) > 1
    # Bands of several joints would cover each other, so each joint has its own column.
    columns = min(len(joints), 8) if many else 1
    figure, axes = new_figure(2.1 * columns + 0.7 if many else 8.5, 6.2, 3, columns, sharex=True)
    for k, i in enumerate(joints[:columns] if many else joints):
        at_q, at_v = topology.q_slices[i].start, topology.v_slices[i].start
        for row, values in enumerate((q[:, :, at_q], v[:, :, at_v], tau[:, :, at_v])):
            if many:
                bands(axes[row, k], ts, values, BLUE)
            else:
                colour, dashed = SERIES[k % len(SERIES)], "--" if k // len(SERIES) % 2 else "-"
                axes[row, 0].plot(ts, values[0], dashed, color=colour, linewidth=1.2, label=model.joint_names[i])
        if many:
            axes[0, k].set_title(model.joint_names[i], fontsize=9)
    for row, (name, unit) in enumerate(zip(("position", "velocity", "torque"), units, strict=True)):
        axes[row, 0].set_ylabel(f"{name} ({unit})", fontsize=9)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)", fontsize=9)
    if many:
        figure.suptitle(f"{model.name}: median, 25 to 75 % and 5 to 95 % of {len(q)} motions", fontsize=10)
    else:
        figure.suptitle(model.name, fontsize=10)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        # A longer legend would not fit on the page.
        figure.legend(handles[:24], labels[:24], loc="outside right upper", fontsize=8, frameon=False)
    return figure


def torque_figure(log, predicted, labels, units, *, title: str = "held-out samples") -> Any:
    """Measured and predicted torque of every joint along a log, one panel each, with the error beneath in the same scale.

    **Arguments:** `log`, a `jd.identify.Log`; `predicted` (n, nv); `labels`, `units`: of each coordinate.

    **Raises:** ImportError without matplotlib.
    """
    t, measured, predicted = np.asarray(log.t), np.asarray(log.tau), np.asarray(predicted)
    count = measured.shape[1]
    columns = min(count, 4)
    # Rounded up.
    rows = -(-count // columns)
    figure, axes = new_figure(2.9 * columns, 2.1 * rows + 0.6, rows, columns, sharex=True)
    for j, ax in enumerate(axes.flat):
        if j >= count:
            ax.set_visible(False)
            continue
        ax.plot(t, measured[:, j], color="0.6", linewidth=2.4, label="measured")
        ax.plot(t, predicted[:, j], color=BLUE, linewidth=1.0, label="predicted")
        ax.plot(t, predicted[:, j] - measured[:, j], color=RED, linewidth=0.8, label="difference")
        share = 100 * np.linalg.norm(predicted[:, j] - measured[:, j]) / np.linalg.norm(measured[:, j])
        ax.set_title(f"{labels[j]}: error {share:.1f} %", fontsize=9)
        ax.set_ylabel(f"torque ({units[j]})" if units[j] == "N m" else f"force ({units[j]})", fontsize=9)
        # The lowest panel of each column has the time labels.
        if j + columns >= count:
            ax.set_xlabel("time (s)", fontsize=9)
            ax.tick_params(labelbottom=True)
    total = 100 * np.linalg.norm(predicted - measured) / np.linalg.norm(measured)
    figure.suptitle(f"{title}: torque error {total:.2f} %", fontsize=10)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure
