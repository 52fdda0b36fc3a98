"""Arrays of a store from a function of one sample: names, axes, units, codes."""

from collections.abc import Callable, Mapping
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
from jaxdyn.simulation.export import dimensions, signals_as_given

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


class MotionRows(NamedTuple):
    """Arrays of a motion, from `one(drawn, row) -> (solution, scene, parameters)`.

    `seen`: names of the signals and poses of the latest trace; they are the same in every trace.
    """

    one: Callable
    reductions: Mapping[str, Reduction]
    seen: dict[str, Any]

    def __call__(self, drawn: Any, row: Any) -> dict[str, Any]:
        """Arrays by their names in the store, with the quantities of reductions."""
        solution, scene, parameters = self.one(drawn, row)
        signals = signals_as_given(solution, scene)
        poses = {f"pose_{name}": pose for name, pose in solution.poses.items()}
        # Tracing is the only way to the names: outputs and joints are those of the scene that the user's function builds.
        self.seen.update(signals=[signal._replace(values=None) for signal in signals], poses=tuple(poses))
        values = {signal.key: signal.values for signal in signals} | poses | _parameters(parameters)
        values |= {name: solution.stats[name] for name in ("num_steps", "time_reached")}
        return _with_quantities(values | {"result": code_of(solution.result)}, self.reductions)


class FunctionRows(NamedTuple):
    """Arrays of a function, from `function(parameters) -> dictionary of arrays`."""

    function: Callable
    reductions: Mapping[str, Reduction]

    def __call__(self, drawn: Any, row: Any) -> dict[str, Any]:
        """Arrays by their names in the store, with the quantities of reductions."""
        parameters = row["parameters"] if drawn is None else drawn
        values = self.function(parameters)
        if not isinstance(values, Mapping) or not values:
            raise ValueError(f"function returned a {type(values).__name__}; return a dictionary of arrays by name")
        values = {str(name): jnp.asarray(value) for name, value in values.items()}
        if {"result", "record", "partial", "rollout"} & values.keys():
            raise ValueError("function returned an array named result, record, partial or rollout; take another name")
        # A function without codes of its own fails where a result is not finite, as a simulation that diverges.
        success = values.pop("success", None)
        if success is None:
            success = jnp.stack([jnp.isfinite(value).all() for value in values.values()]).all()
        code = jnp.where(success, 0, 1).astype(jnp.uint8)
        return _with_quantities(values | _parameters(parameters) | {"result": code}, self.reductions)


def describe_motion(
    one: Callable, batch: Members, units: dict[str, str], ts: np.ndarray, reductions: Mapping[str, Reduction]
) -> Description:
    """Trace and describe `one(drawn, row) -> (solution, scene, parameters)` with rows at the times ts (nt,)."""
    rows = MotionRows(one, reductions, {})
    traced = Traced(rows, batch)
    variables: dict[str, Variable] = {}
    coordinates: dict[str, tuple[Any, dict[str, Any]]] = {"t": (ts, {"units": "s"})}
    for signal in rows.seen["signals"]:
        dims = dimensions(signal)
        unit = list(signal.units) if signal.names else signal.units[0]
        variables[signal.key] = _variable(signal.key, traced.shapes, unit, dims)
        if signal.names:
            coordinates[dims[-1]] = (list(signal.names), {})
    for name in rows.seen["poses"]:
        variables[name] = _variable(name, traced.shapes, "m", ("t", "pose_row", "pose_column"))
    steps = {"num_steps": "1", "time_reached": "s"}
    others = [name for name in traced.shapes if name in steps or name.startswith("parameter")]
    variables |= _variables(traced.shapes, others, units | steps) | {"result": _codes(CODES)}
    return Description(traced, True, variables, CODES, coordinates)


def describe_function(
    function: Callable, batch: Members, units: dict[str, str], reductions: Mapping[str, Reduction]
) -> Description:
    """Trace and describe `function(parameters) -> dictionary of arrays`."""
    rows = FunctionRows(function, reductions)
    traced = Traced(rows, batch)
    names = [name for name in traced.shapes if name != "result" and not name.startswith(QUANTITY)]
    variables = _variables(traced.shapes, names, units) | {"result": _codes(OUTCOMES)}
    return Description(traced, False, variables, OUTCOMES, {})


def _parameters(tree: Any) -> dict[str, Any]:
    """Leaves of the parameters by their paths."""
    values = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="_")
        values[f"parameter_{name}" if name else "parameter"] = jnp.asarray(leaf)
    return values


def _with_quantities(rows: dict[str, Any], reductions: Mapping[str, Reduction]) -> dict[str, Any]:
    return rows | {QUANTITY + name: jnp.asarray(value) for name, value in quantities(reductions, rows).items()}


def _variables(shapes: Mapping[str, Any], names: list[str], units: Mapping[str, str]) -> dict[str, Variable]:
    return {name: _variable(name, shapes, units.get(name.removeprefix("parameter_"))) for name in names}


def _variable(name: str, shapes: Mapping[str, Any], units: Any, dims: tuple[str, ...] | None = None) -> Variable:
    like = shapes[name]
    dims = tuple(f"{name}_{k}" for k in range(len(like.shape))) if dims is None else dims
    notes = {"units": units} if units and any(units) else {}  # none where no unit is known
    return Variable(name, like.shape, like.dtype, dims, "rollout", notes)


def _codes(names: tuple[str, ...]) -> Variable:
    """Codes as the CF conventions write flags."""
    notes = {"flag_values": list(range(len(names))), "flag_meanings": " ".join(names)}
    return Variable("result", (), np.dtype(np.uint8), (), "rollout", notes)
