"""A study, which determines the rows of a batch and names their arrays, and its computation in one process.

Chunks are pure functions of their number.
"""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.constraints.codes import CODES, code_of
from jaxdyn.scale.program import MEMORY_FRACTION, Members, Program, Traced, available_memory, default_size
from jaxdyn.scale.reductions import QUANTITY, Reducer, Reduction, Results, quantities
from jaxdyn.scale.store import Store, Variable, zarr_package
from jaxdyn.simulation.options import pack_steps
from jaxdyn.simulation.run import simulate
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


@dataclass(frozen=True, eq=False)
class Rollout:
    """A rollout of `run`, as a function of its parameters (or None) and of its row of the arrays."""

    # A class, not a function within `run`: cloudpickle sends it by name, so that workers use the code of their own jaxdyn.
    scene: Any
    builds: bool
    states: Callable | None
    fixed: dict[str, np.ndarray]
    control: Any
    ts: np.ndarray
    options: dict[str, Any]

    def __call__(self, parameters: Any, row: Any) -> tuple[Any, Any]:
        """Solution and scene."""
        scene, control = self.scene(parameters) if self.builds else self.scene, self.control
        # A control with parameters of the rollout has to be built with the scene.
        if isinstance(scene, tuple):
            scene, control = scene
        q0, v0 = self.states(parameters) if self.states else ((row | self.fixed)[name] for name in ("q0", "v0"))
        return simulate(scene, q0, v0, self.ts, control=control, throw=False, **pack_steps(self.options)), scene


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


LISTED = 1000  # failures that a result lists
PROGRAM = "program of a rollout (scene, control, solver, functions)"  # name of its hash in a store
LOWERED = "lowered program"


class Facts(NamedTuple):
    """The compiled program of a worker: its platform, batch size, memory (bytes), hashes, and the seconds of a batch."""

    platform: str
    size: int
    bytes: int
    programs: dict[str, str]
    seconds: float


class Summary(NamedTuple):
    """Result of the task of a chunk, whose rows are in the store.

    `codes`: number of rollouts that ended with each code; `failed`, numbers of the first that failed; `partials` of reductions;
    `is_repaired`: it was in the store, and damaged.
    """

    codes: np.ndarray
    failed: np.ndarray
    partials: Results
    is_repaired: bool


@dataclass(frozen=True)
class Study:
    """All that determines the rows of a batch; it is sent to workers and compiled there.

    - `outputs`: the function of a member; `kept`: names of the arrays that are stored.
    - `size` or None: members of a batch, by default at most `maximum`. `sharing`: processes that share the free memory of a host.
      `devices`: None for all of a process.
    """

    outputs: Description
    members: Members
    reducer: Reducer
    kept: tuple[str, ...]
    path: Path
    devices: Sequence[Any] | None
    size: int | None
    maximum: int
    sharing: int

    def open(self) -> "Study":
        """This study, compiled in this process."""
        # With all that takes long, so that a worker has it before its first task: zarr's import is a third of a second.
        zarr_package()
        _ = self.program, self.computing
        return self

    @cached_property
    def computing(self) -> Any:  # a Lock, which is no type before Python 3.13
        """The lock of the program: two tasks at once would compete for the threads of kernels."""
        return threading.Lock()

    @cached_property
    def program(self) -> Program:
        """The program of a batch."""
        devices = local_devices(self.devices)
        size = self.size or max(1, min(default_size(devices), self.maximum))
        memory = MEMORY_FRACTION * available_memory(devices) / self.sharing
        return Program(self.outputs.traced, devices, size, memory, self.outputs.is_motion)

    def facts(self, measure: bool) -> Facts:
        """Facts of the program; with `measure` a batch is timed and hashed for a new store, else an existing one is checked.

        **Raises:** ValueError for a store of another study.
        """
        seconds, programs = 0.0, {LOWERED: self.program.lowered}
        if measure:
            first = np.arange(min(self.program.size, self.members.count))
            seconds = self.program.time(first, time.perf_counter)
            programs[PROGRAM] = self.outputs.traced.fingerprint()
        else:
            # Reading the property opens the store and checks it.
            _ = self.store
        return Facts(self.program.devices[0].platform, self.program.size, self.program.bytes, programs, seconds)

    @cached_property
    def store(self) -> Store:
        """The store of the study. **Raises:** ValueError where this process would compute something else."""
        store = Store(self.path)
        if store.description[LOWERED] != self.program.lowered:
            # Another batch size, other devices or another processor: the computation for one member has to be the same. Its hash
            # needs a second trace, which a run that resumes with the same program saves.
            store.check({PROGRAM: self.outputs.traced.fingerprint()})
        return store

    def chunks(self, chunks: Sequence[int]) -> list[Summary]:
        """Compute and store chunks, or read those that the store has; damaged ones are computed again."""
        summaries = []
        for chunk in chunks:
            numbers = self.store.numbers(chunk)
            # Also a task that was lost with its worker may have been finished: Dask computes it again, this reads it.
            is_there = self.store.is_done(chunk)
            is_whole = is_there and self.store.is_whole(chunk)
            if not is_whole:
                # Missing until it is whole. Only of a damaged one: the codes of another task may come at any time.
                if is_there:
                    self.store.forget(chunk)
                with self.computing:
                    rows = compute(self.program, numbers)
                partials = self.reducer.partials(rows, numbers)
                self.store.write(chunk, {name: rows[name] for name in self.kept} | self.reducer.to_store(partials))
                codes = rows["result"]
            else:
                codes = self.store.read(chunk, ["result"])["result"]
                partials = self.reducer.from_store(partial(self.store.read, chunk))
            failed = numbers[np.flatnonzero(codes)[:LISTED]]
            counts = np.bincount(codes, minlength=len(self.outputs.codes))
            summaries.append(Summary(counts, failed, partials, is_there and not is_whole))
        return summaries


def compute(program: Program, numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Rows of these rollouts."""
    rows: dict[str, np.ndarray] = {}
    running: list[tuple[int, Any]] = []
    # Two batches at a time: one is computed while the results of the other are copied.
    for begin in [*range(0, len(numbers), program.size), None]:
        if begin is not None:
            running.append((begin, program.start(numbers[begin : begin + program.size])))
        while running and (begin is None or len(running) == 2):
            place, results = running.pop(0)
            for name, values in results.items():
                values = np.asarray(values)
                if name not in rows:
                    rows[name] = np.empty((len(numbers), *values.shape[1:]), values.dtype)
                part = rows[name][place : place + program.size]
                part[...] = values[: len(part)]
    return rows


def local_devices(devices: Sequence[Any] | None) -> list[Any]:
    """Devices of this process.

    **Raises:** ValueError for devices of others, and for none.
    """
    own = jax.local_devices()
    given = own if devices is None else list(devices)
    if not given or any(device not in own for device in given):
        raise ValueError(f"devices is {devices}; give some of this process' own, jax.local_devices() = {own}")
    return given
