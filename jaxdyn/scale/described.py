"""From a function of one sample to the arrays of a store: names, axes, units, codes."""

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


class Described(NamedTuple):
    """A function of one member, `one(drawn, row) -> dict of arrays`, with all that a store says of them.

    `traced` is the function traced; `is_motion`, whether kernels compute it; `variables` are those that can be stored; `codes`
    the names of result codes; `axes` the coordinates.
    """

    one: Callable[[Any, Any], dict[str, Any]]
    traced: Traced
    is_motion: bool
    variables: dict[str, Variable]
    codes: tuple[str, ...]
    axes: dict[str, tuple[Any, dict[str, Any]]]

    def coordinates(self, order: np.ndarray | None) -> dict[str, tuple[Any, dict[str, Any]]]:
        """Coordinates of the store; the numbers of the rollouts where they are not in their order."""
        return self.axes | ({} if order is None else {"rollout": (order, {})})


class MotionRows(NamedTuple):
    """The arrays of a motion, `one(drawn, row) -> (solution, scene, parameters)`.

    `seen`: names of its signals and poses, which do not change from call to call, of whichever was the last.
    """

    one: Callable
    reductions: Mapping[str, Reduction]
    seen: dict[str, Any]

    def __call__(self, drawn: Any, row: Any) -> dict[str, Any]:
        """By their names in the store, with the quantities of reductions."""
        solution, scene, parameters = self.one(drawn, row)
        signals = signals_as_given(solution, scene)
        values = {signal.key: signal.values for signal in signals}
        poses = {f"pose_{name}": pose for name, pose in solution.poses.items()}
        stats = {name: solution.stats[name] for name in ("num_steps", "time_reached")}
        self.seen.update(signals=[signal._replace(values=None) for signal in signals], poses=tuple(poses))
        values |= poses | _parameters(parameters) | stats
        return _with_quantities(values | {"result": code_of(solution.result)}, self.reductions)


class FunctionRows(NamedTuple):
    """The arrays of a function, `one(drawn, row) -> (dictionary of arrays, parameters)`."""

    one: Callable
    reductions: Mapping[str, Reduction]

    def __call__(self, drawn: Any, row: Any) -> dict[str, Any]:
        """By their names in the store, with the quantities of reductions."""
        values, parameters = self.one(drawn, row)
        if not isinstance(values, Mapping) or not values:
            raise ValueError(f"function returned a {type(values).__name__}; return a dictionary of arrays by name")
        values = {str(name): jnp.asarray(value) for name, value in values.items()}
        if {"result", "record", "partial", "rollout"} & values.keys():
            raise ValueError("function returned an array named result, record, partial or rollout; take another name")
        success = values.pop("success", None)
        if success is None:
            success = jnp.stack([jnp.isfinite(value).all() for value in values.values()]).all()
        code = jnp.where(success, 0, 1).astype(jnp.uint8)
        return _with_quantities(values | _parameters(parameters) | {"result": code}, self.reductions)


def describe_motion(
    one: Callable, batch: Members, reductions: Mapping[str, Reduction], units: Mapping[str, str], ts: np.ndarray
) -> Described:
    """Trace and describe `one(drawn, row) -> (solution, scene, parameters)` with rows at the times ts (nt,)."""
    rows = MotionRows(one, reductions, {})
    seen = rows.seen
    traced = Traced(rows, batch)
    shapes = traced.shapes
    variables, axes = {}, {}
    for signal in seen["signals"]:
        dims = dimensions(signal)
        notes = {"units": list(signal.units) if signal.names else signal.units[0]}
        variables[signal.key] = _variable(signal.key, shapes, dims, notes)
        if signal.names:
            axes[dims[-1]] = (list(signal.names), {})
    for name in seen["poses"]:
        variables[name] = _variable(name, shapes, ("t", "pose_row", "pose_column"), {"units": "m"})
    steps = {"num_steps": "1", "time_reached": "s"}
    for name in shapes:
        if name.startswith("parameter_") or name in steps:
            unit = steps.get(name) or units.get(name.removeprefix("parameter_"))
            variables[name] = _variable(name, shapes, None, {"units": unit} if unit else {})
    variables["result"] = _codes(CODES)
    axes["t"] = (ts, {"units": "s"})
    return Described(rows, traced, True, variables, CODES, axes)


def describe_function(
    one: Callable, batch: Members, reductions: Mapping[str, Reduction], units: Mapping[str, str]
) -> Described:
    """Trace and describe `one(drawn, row) -> (dictionary of arrays, parameters)`."""
    rows = FunctionRows(one, reductions)
    traced = Traced(rows, batch)
    shapes = traced.shapes
    variables = {}
    for name in shapes:
        if name != "result" and not name.startswith(QUANTITY):
            unit = units.get(name.removeprefix("parameter_"))
            variables[name] = _variable(name, shapes, None, {"units": unit} if unit else {})
    variables["result"] = _codes(OUTCOMES)
    return Described(rows, traced, False, variables, OUTCOMES, {})


def _parameters(tree: Any) -> dict[str, Any]:
    """Leaves by the names of their places."""
    values = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="_")
        values[f"parameter_{name}" if name else "parameter"] = jnp.asarray(leaf)
    return values


def _with_quantities(rows: dict[str, Any], reductions: Mapping[str, Reduction]) -> dict[str, Any]:
    values = quantities(reductions, rows)
    return rows | {QUANTITY + name: jnp.asarray(value) for name, value in values.items()}


def _variable(name: str, shapes: Mapping[str, Any], dims: tuple[str, ...] | None, notes: dict[str, Any]) -> Variable:
    like = shapes[name]
    if dims is None:
        dims = tuple(f"{name}_{k}" for k in range(len(like.shape)))
    notes = {key: value for key, value in notes.items() if any(value)}  # no units where none are known
    return Variable(name, like.shape, like.dtype, dims, "rollout", notes)


def _codes(names: tuple[str, ...]) -> Variable:
    """Codes as the CF conventions write flags; they compress to next to nothing."""
    notes = {"flag_values": list(range(len(names))), "flag_meanings": " ".join(names)}
    return Variable("result", (), np.dtype(np.uint8), (), "rollout", notes, compressed=True)
