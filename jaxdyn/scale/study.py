"""A study, which determines the rows of a batch, and its computation in one process: pure functions of the number of a chunk."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdyn.scale.description import Description
from jaxdyn.scale.members import Members
from jaxdyn.scale.program import MEMORY_FRACTION, Program, Traced, available_memory, default_size
from jaxdyn.scale.reducer import Reducer, Results
from jaxdyn.scale.store import Store, zarr_package
from jaxdyn.tasks import Failure, Local, attempt

STEPS = "num_steps"  # of a rollout, by this name among its arrays
LISTED = 1000  # failures that a result lists
SORTED_BATCHES = 16  # of a chunk at least, where its rollouts are sorted by cost
LEAST_BATCH = 64  # members of a device then
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
    `steps`: those that the rollouts needed, and those that their batches computed, (0, 0) of a chunk that was read;
    `is_repaired`: it was in the store, and damaged.
    """

    codes: np.ndarray
    failed: np.ndarray
    partials: Results
    steps: tuple[int, int]
    is_repaired: bool


@dataclass(frozen=True)
class Study:
    """All that determines the rows of a batch; it is sent to workers and compiled there.

    - `outputs`: the function of a member; `kept`: names of the arrays that are stored.
    - `cost`: a function of a member like that of `outputs`, with one array "cost"; an array (count,); or None.
    - `size` or None: members of a batch, by default at most `most`. `sharing`: processes that share the free memory of a host.
      `devices`: None for all of a process.
    """

    outputs: Description
    members: Members
    cost: Callable[[Any, Any], dict[str, Any]] | np.ndarray | None
    reducer: Reducer
    kept: tuple[str, ...]
    path: Path
    devices: Sequence[Any] | None
    size: int | None
    most: int
    sharing: int

    def open(self) -> "Study":
        """This study, compiled in this process."""
        # With all that takes long, so that a worker has it before its first task: zarr's import is a third of a second.
        zarr_package()
        _ = self._computing, self.program, callable(self.cost) and self.cost_program
        return self

    @cached_property
    def _computing(self) -> Any:  # a Lock, which is no type before Python 3.13
        # Two threads of a worker have a task each, which would compete for the threads of kernels.
        return threading.Lock()

    @cached_property
    def program(self) -> Program:
        """The program of a batch."""
        devices = local_devices(self.devices)
        size = self.size or max(1, min(default_size(devices), self.most))
        if self.cost is not None and not self.size:
            # Several batches in a chunk of the same bytes, else there is nothing to sort.
            size = max(min(len(devices) * LEAST_BATCH, self.members.count), size // SORTED_BATCHES)
        return self._compile(self.outputs.traced, size)

    @cached_property
    def cost_program(self) -> Program:
        """The program of the costs of a batch."""
        return self._compile(Traced(self.cost, self.members), self.program.size)  # pyright: ignore[reportArgumentType]

    def _compile(self, traced: Traced, size: int) -> Program:
        devices = local_devices(self.devices)
        memory = MEMORY_FRACTION * available_memory(devices) / self.sharing
        return Program(traced, devices, size, memory, self.outputs.is_motion)

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

    def chunks(self, chunks: Sequence[int], rows: Any = None) -> list[Summary]:
        """Compute and store chunks, or read those that the store has; damaged ones are computed again.

        `rows`, of a single chunk, was computed before (see `rows`).
        """
        return [self._chunk(chunk, rows) for chunk in chunks]

    def _chunk(self, chunk: int, rows: Any) -> Summary:
        # Also a task that was lost with its worker may have been finished: Dask computes it again, this reads it.
        is_there = self.store.is_done(chunk)
        is_whole = is_there and self.store.is_whole(chunk)
        if not is_whole:
            # Missing until it is whole. Only of a damaged one: the record of another task may come at any time.
            if is_there:
                self.store.forget(chunk)
            if rows is None:
                with self._computing:
                    rows = self.rows(chunk)
            rows, steps = rows
            partials = self.reducer.partials(rows, self.store.numbers(chunk))
            self.store.write(chunk, {name: rows[name] for name in self.kept} | self.reducer.to_store(partials))
            codes = rows["result"]
        else:
            codes, steps = self.store.read(chunk, ["result"])["result"], (0, 0)
            partials = self.reducer.from_store(partial(self.store.read, chunk))
        failed = self.store.numbers(chunk)[np.flatnonzero(codes)[:LISTED]]
        counts = np.bincount(codes, minlength=len(self.outputs.codes))
        return Summary(counts, failed, partials, steps, is_there and not is_whole)

    def rows(self, chunk: int) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
        """Rows of a chunk, and its steps."""
        numbers, cost = self.store.numbers(chunk), self.cost
        if cost is None:
            return compute(self.program, numbers)
        # By decreasing cost, so that the members of a batch take about equally many steps; back in order in the store.
        costs = cost[numbers] if isinstance(cost, np.ndarray) else compute(self.cost_program, numbers)[0]["cost"]
        # Stable: rollouts of equal cost keep their order.
        order = np.argsort(-costs.astype(np.float64), kind="stable")
        rows, steps = compute(self.program, numbers[order])
        # The inverse permutation.
        place = np.argsort(order)
        return {name: values[place] for name, values in rows.items()}, steps


class Pipeline(Local):
    """The computation in this process: a thread writes a chunk while the next one is computed."""

    target: Study

    # Writing releases the interpreter's lock most of the time, computing nearly always: a thread is enough. One chunk ahead, so
    # that two chunks are in memory, not more.
    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Results in the order of the items, lists of chunks, as in `Local`."""
        with ThreadPoolExecutor(1, thread_name_prefix="jaxdyn store") as writer:
            before: tuple[Any, Future] | None = None
            for chunks in items:
                is_missing = not self.target.store.is_done(chunks[0])
                rows = attempt(self.target.rows, chunks[0], retries=self.retries) if is_missing else None
                if before is not None:
                    yield before[0], before[1].result()
                before = chunks, writer.submit(self._store, method, chunks, rows)
            if before is not None:
                yield before[0], before[1].result()

    def _store(self, method: str, chunks: Any, rows: Any) -> Any:
        if isinstance(rows, Failure):
            return rows
        return attempt(getattr(self.target, method), chunks, rows, retries=self.retries)


def compute(program: Program, numbers: np.ndarray) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    """Rows of these rollouts, with the steps that they needed and those that their batches computed."""
    rows: dict[str, np.ndarray] = {}
    running: list[tuple[int, Any]] = []
    needed = computed = 0
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
                if name == STEPS:  # the members of a device take steps together, until the slowest one is done
                    devices = len(program.devices)
                    needed += int(values.sum())
                    computed += int(values.reshape(devices, -1).max(1).sum()) * (len(values) // devices)
    return rows, (needed, computed)


def local_devices(devices: Sequence[Any] | None) -> list[Any]:
    """Devices of this process.

    **Raises:** ValueError for devices of others, and for none.
    """
    own = jax.local_devices()
    given = own if devices is None else list(devices)
    if not given or any(device not in own for device in given):
        raise ValueError(f"devices is {devices}; give some of this process' own, jax.local_devices() = {own}")
    return given
