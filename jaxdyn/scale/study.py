"""A study, all that decides the rows of a batch, and its computation in one process: pure functions of the number of a chunk."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdyn.scale.described import Described
from jaxdyn.scale.members import Members
from jaxdyn.scale.program import SHARE, Program, Traced, available_memory, default_lanes, fingerprint
from jaxdyn.scale.reducer import Reducer
from jaxdyn.scale.reductions import Arrays
from jaxdyn.scale.store import Store
from jaxdyn.tasks import Failure, Local, attempt

STEPS = "num_steps"  # of a rollout, by this name among its arrays
LISTED = 1000  # failures that a result lists
PILOT_BATCHES = 16  # of a chunk at least, where its rollouts are put in order
LEAST_LANES = 64  # of a device then
PROGRAM = "program of a rollout (scene, control, solver, functions)"  # how a store names its hash
LOWERED = "lowered program"


class Facts(NamedTuple):
    """The compiled program of a worker: its platform, lanes, memory (bytes), hash, and the seconds of a batch."""

    platform: str
    lanes: int
    bytes: int
    programs: dict[str, str]
    seconds: float


class Summary(NamedTuple):
    """The result of a task, of a chunk whose rows are in the store.

    `codes`: how many rollouts ended with each; `failed`, numbers of the first that did not succeed; `partials` of reductions;
    `steps`: those that rollouts needed, and that the lanes of their batches waited for, (0, 0) of a chunk that was read.
    """

    codes: np.ndarray
    failed: np.ndarray
    partials: Arrays
    steps: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Study:
    """All that decides the rows of a batch, to be sent to workers.

    - `outputs`: the function of a member; `pilot`, the steps of a short part of it, or None.
    - `kept`: names of the arrays that are stored.
    - `order` (count,): numbers of the rollouts in the order in which they are stored, None for that of their numbers.
    - `lanes` or None: rollouts at once, else at most `most_lanes`; `memory` (bytes) or None: half of what is free on a host,
      shared by the `sharing` processes there. `devices`: None for all of a process.
    """

    outputs: Described
    members: Members
    pilot: Callable[[Any, Any], dict[str, Any]] | None
    reducer: Reducer
    kept: tuple[str, ...]
    order: np.ndarray | None
    path: Path
    devices: Sequence[Any] | None
    lanes: int | None
    most_lanes: int
    memory: int | None
    sharing: int

    def numbers(self, places: slice) -> np.ndarray:
        """Numbers of the rollouts at these places of the store."""
        return np.arange(places.start, places.stop) if self.order is None else self.order[places]

    def open(self) -> "Computation":
        """Its computation in this process."""
        return Computation(self)


class Computation:
    """A study compiled in this process."""

    def __init__(self, study: Study):
        self.study = study
        devices = local_devices(study.devices)
        lanes = study.lanes or max(1, min(default_lanes(devices), study.most_lanes))
        if study.pilot and not study.lanes:
            lanes = max(len(devices) * LEAST_LANES, lanes // PILOT_BATCHES)
        memory = study.memory
        if memory is None and study.sharing > 1:
            memory = int(SHARE * available_memory(devices) / study.sharing)
        batch, outputs = study.members, study.outputs
        self.program = Program(outputs.traced, batch, devices, lanes, memory, outputs.is_motion)
        if study.pilot:
            self.pilot = Program(Traced(study.pilot, batch), batch, devices, self.program.lanes, memory, True)

    def facts(self, measure: bool) -> Facts:
        """Facts of the program; with `measure` a batch is timed and hashed, as a new store needs, else an old one is checked.

        **Raises:** ValueError for a store of something else.
        """
        if not measure:
            _ = self.store
        seconds, programs = 0.0, {LOWERED: self.program.lowered}
        if measure:
            first = self.study.numbers(slice(0, min(self.program.lanes, self.study.members.count)))
            seconds = self.program.time(first, time.perf_counter)
            programs[PROGRAM] = fingerprint(self.study.outputs.one, self.study.members)
        return Facts(self.program.devices[0].platform, self.program.lanes, self.program.bytes, programs, seconds)

    @cached_property
    def store(self) -> Store:
        """The study's store. **Raises:** ValueError where this process would compute something else."""
        store = Store(self.study.path)
        if store.description[LOWERED] != self.program.lowered:
            # Of other lanes, devices or processors; what is computed for one member has to be the same.
            store.check({PROGRAM: fingerprint(self.study.outputs.one, self.study.members)})
        return store

    def chunk(self, chunk: int) -> Summary:
        """Compute and store a chunk; one that is in the store already is read."""
        if self.store.is_done(chunk):
            return self.read(chunk)
        return self.write(chunk, *self.rows(chunk))

    def rows(self, chunk: int) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
        """Rows of a chunk, and its steps."""
        numbers = self.study.numbers(self.store.rows(chunk))
        if self.study.pilot is None:
            return compute(self.program, numbers)
        # By falling steps of a short part of each, so that those of a batch take about equally many.
        order = np.argsort(-compute(self.pilot, numbers)[0][STEPS].astype(np.int64), kind="stable")
        rows, steps = compute(self.program, numbers[order])
        place = np.argsort(order)
        return {name: values[place] for name, values in rows.items()}, steps

    def write(self, chunk: int, rows: Mapping[str, np.ndarray], steps: tuple[int, int]) -> Summary:
        """Store the rows of a chunk."""
        numbers = self.study.numbers(self.store.rows(chunk))
        partials = self.study.reducer.partials(rows, numbers)
        self.store.write(chunk, {name: rows[name] for name in self.study.kept} | partials)
        return self._summary(chunk, rows["result"], partials, steps)

    def read(self, chunk: int) -> Summary:
        """The summary of a chunk that is in the store."""
        arrays = self.store.read(chunk, ["result", *self.study.reducer.partial_names])
        return self._summary(chunk, arrays.pop("result"), arrays, (0, 0))

    def check(self, chunks: tuple[int, np.ndarray]) -> list[tuple[bool, Summary]]:
        """Look through chunks from the first one on: whether it was not whole and is computed again, and its summary.

        The flags say of which chunks the files are compared with their sums; the others were just written.
        """
        results = []
        for chunk, is_checked in enumerate(chunks[1], chunks[0]):
            bad = bool(is_checked) and not self.store.is_whole(chunk)
            if bad:
                self.store.forget(chunk)
            results.append((bad, self.chunk(chunk)))
        return results

    def _summary(self, chunk: int, codes: np.ndarray, partials: Arrays, steps: tuple[int, int]) -> Summary:
        failed = self.study.numbers(self.store.rows(chunk))[np.flatnonzero(codes)[:LISTED]]
        return Summary(np.bincount(codes, minlength=len(self.study.outputs.codes)), failed, partials, steps)


class Pipeline(Local):
    """The computation in this process: while a chunk is computed a thread writes the one before."""

    target: Computation

    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Results in the order of the items, as in `Local`."""
        if method != "chunk":
            yield from super().map(method, items)
            return
        with ThreadPoolExecutor(1, thread_name_prefix="jaxdyn store") as writer:
            before: tuple[int, Future] | None = None
            for chunk in items:
                rows = attempt(self.target.rows, chunk, retries=self.retries)
                if before is not None:
                    yield before[0], before[1].result()
                before = chunk, writer.submit(self._write, chunk, rows)
            if before is not None:
                yield before[0], before[1].result()

    def _write(self, chunk: int, rows: Any) -> Summary | Failure:
        return rows if isinstance(rows, Failure) else attempt(self.target.write, chunk, *rows, retries=self.retries)


def compute(program: Program, numbers: np.ndarray) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    """Rows of these rollouts, with the steps that they needed and that lanes waited for; two batches are under way at a time."""
    rows: dict[str, np.ndarray] = {}
    under_way: list[tuple[int, Any]] = []
    needed = waited = 0
    for begin in [*range(0, len(numbers), program.lanes), None]:
        if begin is not None:
            under_way.append((begin, program.start(numbers[begin : begin + program.lanes])))
        while under_way and (begin is None or len(under_way) == 2):
            place, results = under_way.pop(0)
            for name, values in results.items():
                values = np.asarray(values)
                if name not in rows:
                    rows[name] = np.empty((len(numbers), *values.shape[1:]), values.dtype)
                part = rows[name][place : place + program.lanes]
                part[...] = values[: len(part)]
                if name == STEPS:  # the lanes of a device go on until its slowest one is done
                    devices = len(program.devices)
                    needed += int(values.sum())
                    waited += int(values.reshape(devices, -1).max(1).sum()) * (len(values) // devices)
    return rows, (needed, waited)


def local_devices(devices: Sequence[Any] | None) -> list[Any]:
    """Devices of this process.

    **Raises:** ValueError for devices of others, and for none.
    """
    own = jax.local_devices()
    given = own if devices is None else list(devices)
    if not given or any(device not in own for device in given):
        raise ValueError(f"devices is {devices}; give some of this process' own, jax.local_devices() = {own}")
    return given
