"""Solutions as files and tables: CSV and NPZ that `jd.identify` reads as logs, and xarray datasets."""

import csv
import json
import os
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.constraints.base import layout
from jaxdyn.model.arguments import as_path
from jaxdyn.model.configuration import columns_of
from jaxdyn.systems.scene import Scene, as_scene


class Signal(NamedTuple):
    """One array of a solution: values (..., nt, columns) or (..., nt), the names of its columns (none of a single one), units."""

    key: str
    values: Any
    names: tuple[str, ...]
    units: tuple[str, ...]


def signals(solution: Any, scene: Any) -> list[Signal]:
    """Arrays of a solution that have one row for each save point, with names and units.

    **Raises:** ValueError when the scene is not that of the solution.
    """
    return [one._replace(values=np.asarray(one.values)) for one in signals_as_given(solution, scene)]


def signals_as_given(solution: Any, scene: Any) -> list[Signal]:
    """Signals with the values of the solution unconverted, so that it may be traced (see `signals`)."""
    scene = as_scene(scene)
    if np.shape(solution.q)[-1:] != (scene.nq,) or np.shape(solution.v)[-1:] != (scene.nv,):
        raise ValueError(
            f"solution has q {np.shape(solution.q)} and v {np.shape(solution.v)}, the scene nq = {scene.nq} and nv = "
            f"{scene.nv}; pass the scene that was simulated"
        )
    names = columns_of(scene.system)
    rows = _row_names(scene)
    both = ("position", "velocity")
    columns = [
        ("q", solution.q, names.q, names.q_units),
        ("v", solution.v, names.v, names.v_units),
        ("a", solution.acceleration, names.v, names.a_units),
        ("tau", solution.torque, names.v, names.force_units),
        ("multipliers", solution.multipliers, rows, ("",) * len(rows)),
        ("constraint_residual", solution.constraint_residual, both, ("", "")),
        ("energy", solution.energy, (), ("J",)),
        ("power", solution.power, (), ("W",)),
        ("work", solution.work, (), ("J",)),
    ]
    for name, values in solution.contact_forces.items():
        parts = tuple(str(k + 1) for k in range(np.shape(values)[-1]))
        columns.append((f"contact_force_{name}", values, parts, ("",) * len(parts)))
    columns += [(f"contact_margin_{name}", values, (), ("",)) for name, values in solution.contact_margins.items()]
    return [Signal(key, x, tuple(n), tuple(u)) for key, x, n, u in columns if x is not None]


def _row_names(scene: Scene) -> tuple[str, ...]:
    return tuple(
        f"{place.name}.{k - place.start + 1}" for place in layout(scene) for k in range(place.start, place.end)
    )


def times(solution: Any) -> np.ndarray:
    """Save points (nt,). **Raises:** ValueError where those of a batch differ."""
    ts = np.asarray(solution.ts)
    ts = ts.reshape(-1, ts.shape[-1])
    if (ts != ts[0]).any():
        raise ValueError("solution.ts differs between the motions of the batch; write each of them separately")
    return ts[0]


def write_csv(solution: Any, path: str | os.PathLike, scene: Any) -> None:
    """Write a solution as CSV; see `Solution.to_csv`."""
    path = _check_path(path, ".csv")
    columns, ts = signals(solution, scene), times(solution)
    # Readers of logs expect joint names where each joint has one number, else the number of the column.
    named = columns[0].names == columns[1].names
    header, arrays = ["t [s]"], []
    for signal in columns:
        parts = signal.names or ("",)
        arrays.append(signal.values.reshape(-1, len(ts), len(parts)))
        for k, (name, unit) in enumerate(zip(parts, signal.units, strict=True)):
            if signal.key in ("q", "v", "a", "tau"):
                label, note = (f"{signal.key}_{name}", unit) if named else (f"{signal.key}{k + 1}", f"{name}; {unit}")
            else:
                label, note = f"{signal.key}_{name}" if name else signal.key, unit
            header.append(f"{label} [{note}]" if note else label)
    table = np.concatenate(arrays, axis=2)
    batched = np.ndim(solution.q) > 2
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow((["rollout"] if batched else []) + header)
        # `repr` gives the shortest text that reads back to the same number.
        for n, motion in enumerate(table):
            first = [str(n + 1)] if batched else []
            writer.writerows(first + [repr(float(x)) for x in (t, *row)] for t, row in zip(ts, motion, strict=True))


def write_npz(solution: Any, path: str | os.PathLike, scene: Any) -> None:
    """Write a solution as an archive of NumPy; see `Solution.to_npz`."""
    path = _check_path(path, ".npz")
    arrays: dict[str, np.ndarray] = {"t": times(solution)}
    units: dict[str, Any] = {"t": "s"}
    names: dict[str, list] = {}
    for signal in signals(solution, scene):
        arrays[signal.key] = signal.values
        units[signal.key] = list(signal.units) if signal.names else signal.units[0]
        names[signal.key] = list(signal.names)
    arrays |= {f"pose_{name}": np.asarray(pose) for name, pose in solution.poses.items()}
    texts = {"names": np.array(json.dumps(names)), "units": np.array(json.dumps(units))}
    np.savez_compressed(path, **arrays, **texts)  # pyright: ignore[reportArgumentType]


def dimensions(signal: Signal) -> tuple[str, ...]:
    """Names of the axes of a signal behind those of a batch: time, and the kind of its columns."""
    axes = {"q": "coordinate", "v": "velocity", "a": "velocity", "tau": "velocity", "multipliers": "row"}
    return ("t", axes.get(signal.key, f"{signal.key}_part")) if signal.names else ("t",)


def as_xarray(solution: Any, scene: Any) -> Any:
    """Convert a solution to a dataset of xarray; see `Solution.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError("Solution.to_xarray needs xarray: pip install xarray") from error
    batch = tuple(f"batch{k}" for k in range(np.ndim(solution.q) - 2)) if np.ndim(solution.q) > 3 else ("rollout",)
    batch = batch if np.ndim(solution.q) > 2 else ()
    variables: dict[str, tuple] = {}
    coordinates: dict[str, tuple] = {"t": ("t", times(solution), {"units": "s"})}
    for signal in signals(solution, scene):
        if not signal.names:
            variables[signal.key] = ((*batch, "t"), signal.values, {"units": signal.units[0]})
            continue
        axes = dimensions(signal)
        coordinates[axes[-1]] = (axes[-1], list(signal.names))
        variables[signal.key] = ((*batch, *axes), signal.values, {"units": list(signal.units)})
    for name, pose in solution.poses.items():
        variables[f"pose_{name}"] = ((*batch, "t", "pose_row", "pose_column"), np.asarray(pose), {"units": "m"})
    return xarray.Dataset(variables, coordinates)


def _check_path(path, suffix: str):
    path = as_path(path)
    if path.suffix.lower() != suffix:
        raise ValueError(f"path is {str(path)!r}; write to a file {suffix}")
    if not path.parent.is_dir():
        raise ValueError(f"path is {str(path)!r}: there is no directory {path.parent}")
    return path
