"""Plots of motions: `jd.plot.states`, `energy`, `residuals`, `forces`, `work_precision`.

Each takes a scene or model and its result of `jd.simulate`, draws into given axes or into a new
figure, and returns the axes; `ax.figure.savefig("motion.png")` writes the picture. One motion is drawn by lines, a batch by its
median with bands of 25 to 75 and 5 to 95 %. All raise ImportError without matplotlib.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.constraints.base import layout
from jaxdyn.model.arguments import Checked
from jaxdyn.model.configuration import columns_of
from jaxdyn.reports.plotting import BLUE, RED, SERIES, Axes, Record, bands, new_figure, panel, style
from jaxdyn.simulation.solution import Solution, times
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike

_SMALLEST = 1e-17  # logarithmic axes have no zero
_LABELS = 16  # lines beyond these have no entry in the legend


def states(
    scene: SceneLike, solution: Checked[Solution], axes: Checked[Sequence[Axes] | np.ndarray | None] = None
) -> np.ndarray:
    """Positions and velocities over time, each with its joint's name and unit.

    **Arguments:** `scene`; `solution`: of `jd.simulate`, one motion; `axes`: two matplotlib axes, or None.

    **Returns:** array (2,) of axes: of q and of v.

    **Raises:** ValueError for a scene that does not fit the solution, and for other than two axes.
    """
    scene = as_scene(scene)
    names = columns_of(scene.system)
    q, v = _rows(solution.q, scene.nq, "q"), _rows(solution.v, scene.nv, "v")
    if axes is None:
        _, made = new_figure(7.0, 5.0, 2, 1, sharex=True)
        axes = made[:, 0]
    # Axes of matplotlib are objects, which numpy must not take for sequences.
    axes = np.atleast_1d(np.asarray(axes, object))
    if axes.shape != (2,):
        raise ValueError(f"axes has shape {axes.shape}; give two, of q and of v, e.g. figure.subplots(2)")
    drawn = (axes[0], q, names.q, names.q_units, "position"), (axes[1], v, names.v, names.v_units, "velocity")
    for ax, values, labels, units, what in drawn:
        _lines(ax, times(solution), values, labels)
        ax.set_ylabel(_with_units(what, units))
    axes[1].set_xlabel("time (s)")
    _legend(axes[0])
    axes[0].set_title(_title(scene, q))
    return axes


def energy(scene: SceneLike, solution: Checked[Solution], ax: Checked[Axes | None] = None) -> Axes:
    """Change of the energy over time; where the solution has `work`, also its difference from the work: the error.

    **Arguments:** `scene`, `solution` with `outputs=("energy",)` or `("energy", "work")`; `ax`, matplotlib axes or None.

    **Returns:** the axes, J over s.

    **Raises:** ValueError for a solution without `energy`.
    """
    rows = _rows(_require_output(solution, "energy")[..., None], 1, "energy")[:, :, 0]
    ax = _axes(ax)
    change = rows - rows[:, :1]
    _lines(ax, times(solution), change[..., None], ("E - E(0)",))
    if solution.work is not None:
        # Energy that forces and drives brought in is no error of the integration.
        rest = change - np.asarray(solution.work).reshape(change.shape)
        _lines(ax, times(solution), rest[..., None], ("E - E(0) - work",), (RED,))
    return _finish(ax, as_scene(scene), rows, "energy (J)")


def residuals(scene: SceneLike, solution: Checked[Solution], ax: Checked[Axes | None] = None) -> Axes:
    """Largest residual of the constraints over time: |phi| and |A v - b|, on a logarithmic axis.

    **Arguments:** `scene`, `solution` with `outputs=("constraint_residual",)`; `ax`, matplotlib axes or None.

    **Returns:** the axes; phi in m or rad, A v - b in m/s or rad/s.

    **Raises:** ValueError for a solution without `constraint_residual`.
    """
    rows = _rows(_require_output(solution, "constraint_residual"), 2, "constraint_residual")
    ax = _axes(ax)
    # A residual of exactly zero would leave a gap in a logarithmic plot.
    _lines(ax, times(solution), np.maximum(np.abs(rows), _SMALLEST), ("|phi| (m, rad)", "|A v - b| (m/s, rad/s)"))
    ax.set_yscale("log")
    return _finish(ax, as_scene(scene), rows, "largest residual (m, rad; m/s, rad/s)")


def forces(scene: SceneLike, solution: Checked[Solution], ax: Checked[Axes | None] = None) -> Axes:
    """Multipliers of the constraints over time, and torques of the control, with the names of constraints and joints.

    Multipliers are the forces of the constraints' rows: N along a distance, N m about an axis.

    **Arguments:** `scene`, `solution` with `outputs=("multipliers",)`, `("torque",)` or both; `ax`, matplotlib axes or None.

    **Returns:** the axes, N or N m over s.

    **Raises:** ValueError for a solution with neither of them, and for a scene that does not fit the solution.
    """
    scene = as_scene(scene)
    if solution.multipliers is None and solution.torque is None:
        raise ValueError('solution has no forces; simulate with outputs=("multipliers",) or outputs=("torque",)')
    parts, labels, units = [], [], ["N", "N m"]
    if solution.multipliers is not None:
        places = layout(scene)
        labels += [
            f"{p.name}.{k - p.start + 1}" if p.end - p.start > 1 else p.name
            for p in places
            for k in range(p.start, p.end)
        ]
        parts.append(_rows(solution.multipliers, len(labels), "multipliers"))
    if solution.torque is not None:
        names = columns_of(scene.system)
        # Rows of constraints may be forces or torques, so the label has both units.
        units = units if parts else list(names.force_units)
        labels += list(names.v)
        parts.append(_rows(solution.torque, scene.nv, "torque"))
    values = np.concatenate(parts, axis=2)
    ax = _axes(ax)
    _lines(ax, times(solution), values, labels)
    return _finish(ax, scene, values, _with_units("force", units))


def work_precision(
    records: Checked[Sequence[Record]],
    ax: Checked[Axes | None] = None,
    *,
    error: str = "error_path",
    cost: str = "seconds_best",
) -> Axes:
    """Cost against error of several integrators on one scene: left is more exact, down is cheaper.

    **Arguments:**

    - `records`: those of one scene, dtype and batch: `report.of("four_bar")` of a `jd.report(...)`.
    - `ax`: matplotlib axes or None.
    - `error`: "error_path" (largest along the motion), "error_end" or "energy_error" (J); `cost`: "seconds_best",
      "seconds_median" (s a trajectory), "steps" or "evaluations".

    **Returns:** the axes, both logarithmic.

    **Raises:** ValueError for names that no record has, for records of several plots, and where no run has both quantities.
    """
    records = list(records)
    costs = {"seconds_best": "time per trajectory (s)", "seconds_median": "time per trajectory (s)", "steps": "steps"}
    costs["evaluations"] = "evaluations of the vector field"
    errors = {"error_path": "error", "error_end": "error at the end", "energy_error": "energy error (J)"}
    for name, value, known in (("error", error, errors), ("cost", cost, costs)):
        if value not in known:
            raise ValueError(f"{name} is {value!r}; choose from {', '.join(known)}")
    plots = {(r.scene, r.dtype, r.batch) for r in records}
    if len(plots) > 1:
        raise ValueError(f"records has runs of {len(plots)} plots; give those of one scene, dtype and batch")
    if not any(None not in (getattr(r, error), getattr(r, cost)) for r in records):
        raise ValueError(f"no record has both {error} and {cost}; did every run fail?")
    ax = _axes(ax)
    panel(ax, records, error, cost)
    ax.set(xscale="log", yscale="log", xlabel=errors[error], ylabel=costs[cost])
    scene, dtype, batch = plots.pop()
    ax.set_title(f"{scene}, {dtype}, {batch} at once")
    ax.legend(fontsize=7, frameon=False)
    return ax


def _require_output(solution, output: str) -> np.ndarray:
    value = getattr(solution, output)
    if value is None:
        raise ValueError(f'solution has no {output}; simulate with outputs=("{output}",)')
    return np.asarray(value)


def _rows(values, count: int, name: str) -> np.ndarray:
    """Reshape an output to (n, nt, count) for n motions."""
    values = np.asarray(values, float)
    if values.ndim < 2 or values.shape[-1] != count:
        raise ValueError(f"solution.{name} has shape {values.shape}, expected (..., nt, {count}); pass its own scene")
    return values.reshape(-1, *values.shape[-2:])


def _axes(ax: Axes | None) -> Axes:
    if ax is None:
        return new_figure(7.0, 3.6)[1][0, 0]
    style(ax)
    return ax


def _lines(ax, ts, values: np.ndarray, labels: Sequence[str], colours: Sequence[str] = (BLUE, *SERIES[1:])) -> None:
    for k, label in enumerate(labels):
        colour, shown = colours[k % len(colours)], label if k < _LABELS else None
        if len(values) > 1:
            bands(ax, ts, values[:, :, k], colour, shown)
        else:
            dashed = "--" if k // len(colours) % 2 else "-"
            ax.plot(ts, values[0, :, k], dashed, color=colour, linewidth=1.3, label=shown)


def _finish(ax, scene, values, label: str) -> Any:
    ax.set(xlabel="time (s)", ylabel=label, title=_title(scene, values))
    _legend(ax)
    return ax


def _legend(ax) -> None:
    if ax.get_legend_handles_labels()[0]:
        # Beside the axes, where it hides no lines.
        ax.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _title(scene, values) -> str:
    name = getattr(scene.system, "name", "")
    many = f"{len(values)} motions: median, 25 to 75 % and 5 to 95 %" if len(values) > 1 else ""
    return ", ".join(part for part in (name, many) if part)


def _with_units(what: str, units: Sequence[str]) -> str:
    known = list(dict.fromkeys(unit for unit in units if unit))
    return f"{what} ({', '.join(known)})" if known else what


__all__ = [
    "energy",
    "forces",
    "residuals",
    "states",
    "work_precision",
]


def __dir__() -> list[str]:
    return __all__
