"""Arrays of a store from a function of one sample: names, axes, units, codes."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import CODES, code_of
from jaxdyn.scale.members import Members
from jaxdyn.scale.program import Traced
from jaxdyn.scale.reducer import QUANTITY
from jaxdyn.scale.reductions import Reduction, quantities
from jaxdyn.scale.store import Variable
from jaxdyn.simulation.solution import dimensions, signals_as_given

OUTCOMES = ("successful", "failed")  # codes of functions that are no motions


class Description(NamedTuple):
    """A function of one member, traced, and the description of its arrays in a store.

    `is_motion`: whether kernels compute it; `variables` are those that can be stored; `codes` the names of result codes;
    `coordinates` those of the axes, with their attributes.
    """

    traced: Traced
    is_motion: bool
    variables: dict[str, Variable]
    codes: tuple[str, ...]
    coordinates: dict[str, tuple[Any, dict[str, Any]]]


class Label(NamedTuple):
    """Axes of an array, its unit or those of the columns, and the names of the columns."""

    dims: tuple[str, ...]
    units: Any
    columns: tuple[str, ...] = ()


class Values(NamedTuple):
    """Arrays of a member by name, its result code, and labels of some of the arrays."""

    arrays: dict[str, Any]
    code: Any
    labels: dict[str, Label]


def describe(
    values: Callable[[Any, Any], Values],
    batch: Members,
    units: Mapping[str, str],
    ts: np.ndarray | None,
    reductions: Mapping[str, Reduction],
) -> Description:
    """Trace and describe `values(parameters, row)`, of motions with rows at the times ts (nt,), of other functions with None."""
    # Tracing is the only way to the names: outputs and joints are those of the scene that the user's function builds.
    labels: dict[str, Label] = {}
    traced = Traced(partial(_rows, values, reductions, labels), batch)
    variables: dict[str, Variable] = {}
    coordinates: dict[str, tuple[Any, dict[str, Any]]] = {} if ts is None else {"t": (ts, {"units": "s"})}
    for name, like in traced.shapes.items():
        if name.startswith(QUANTITY):
            continue
        axes = tuple(f"{name}_{k}" for k in range(len(like.shape)))
        label = labels.get(name, Label(axes, units.get(name.removeprefix("parameter_"))))
        notes = {"units": label.units} if label.units and any(label.units) else {}  # none where no unit is known
        variables[name] = Variable(name, like.shape, like.dtype, label.dims, "rollout", notes)
        if label.columns:
            coordinates[label.dims[-1]] = (list(label.columns), {})
    codes = OUTCOMES if ts is None else CODES
    # The last one, with flags as the CF conventions write them.
    variables["result"] = result = variables.pop("result")
    result.attributes.update(flag_values=list(range(len(codes))), flag_meanings=" ".join(codes))
    return Description(traced, ts is not None, variables, codes, coordinates)


# Functions of a module, not within others: cloudpickle sends them by name, so that workers use the code of their own jaxdyn.


def motion_values(rollout: Callable[[Any, Any], tuple[Any, Any]], parameters: Any, row: Any) -> Values:
    """Arrays of a motion, from `rollout(parameters, row) -> (solution, scene)`."""
    solution, scene = rollout(parameters, row)
    arrays = {f"pose_{name}": pose for name, pose in solution.poses.items()}
    labels = dict.fromkeys(arrays, Label(("t", "pose_row", "pose_column"), "m"))
    for signal in signals_as_given(solution, scene):
        arrays[signal.key] = signal.values
        units = list(signal.units) if signal.names else signal.units[0]
        labels[signal.key] = Label(dimensions(signal), units, signal.names)
    for name, unit in (("num_steps", "1"), ("time_reached", "s")):
        arrays[name], labels[name] = solution.stats[name], Label((), unit)
    return Values(arrays, code_of(solution.result), labels)


def function_values(function: Callable[[Any], Mapping[str, Any]], parameters: Any, row: Any) -> Values:
    """Arrays of a function of the parameters."""
    values = function(parameters)
    if not isinstance(values, Mapping) or not values:
        raise ValueError(f"function returned a {type(values).__name__}; return a dictionary of arrays by name")
    arrays = {str(name): jnp.asarray(value) for name, value in values.items()}
    if {"result", "partial", "rollout"} & arrays.keys():
        raise ValueError("function returned an array named result, partial or rollout; take another name")
    # A function without codes of its own fails where a result is not finite, as a simulation that diverges.
    success = arrays.pop("success", None)
    if success is None:
        success = jnp.stack([jnp.isfinite(value).all() for value in arrays.values()]).all()
    return Values(arrays, jnp.where(success, 0, 1).astype(jnp.uint8), {})


def _rows(
    values: Callable[[Any, Any], Values],
    reductions: Mapping[str, Reduction],
    labels: dict[str, Label],
    parameters: Any,
    row: Any,
) -> dict[str, Any]:
    """Arrays of a member by their names in the store, with the quantities of reductions."""
    rows, code, new = values(parameters, row)
    labels.update(new)
    for path, leaf in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="_")
        rows[f"parameter_{name}" if name else "parameter"] = jnp.asarray(leaf)
    rows["result"] = code
    return rows | {QUANTITY + name: jnp.asarray(value) for name, value in quantities(reductions, rows).items()}
