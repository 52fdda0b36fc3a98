"""The loop over chunks: what is missing is computed, stored and recorded; then what was there before is looked through.

Each process starts at its own share of the chunks and goes round; what another living process has claimed is left to it, and
what a dead one had claimed is taken. So processes need not be told of each other, and the survivors do the work of one that
is killed. While a chunk is computed a thread writes the one before.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from jaxdyn.scale.locks import Lock
from jaxdyn.scale.processes import Process
from jaxdyn.scale.program import Program
from jaxdyn.scale.progress import Progress
from jaxdyn.scale.reducer import Reducer, named
from jaxdyn.scale.reductions import Arrays
from jaxdyn.scale.store import Store

SECONDS = 2.0  # of computing to a chunk, if it may be so large
BYTES = 2**25  # of rows in a chunk
SHARES = 8  # chunks to a process at least, so that all end at about the same time
STEPS = "num_steps"  # of a rollout, by this name among its arrays
POLL = 0.2  # s between looks at what other processes still do


@dataclass
class Tally:
    """Steps that rollouts needed, and steps that the lanes of their batches waited for; of one process."""

    needed: int = 0
    waited: int = 0

    def add(self, steps: np.ndarray, devices: int) -> None:
        """A batch: each device's lanes go on until its slowest one is done."""
        self.needed += int(steps.sum())
        self.waited += int(steps.reshape(devices, -1).max(1).sum()) * (len(steps) // devices)

    @property
    def ratio(self) -> float:
        """Steps waited for to those needed; NaN where none were counted."""
        return self.waited / self.needed if self.needed else float("nan")


@dataclass
class Job:
    """All that the loop needs.

    `order` (count,): numbers of the rollouts in the order in which they are computed and stored, None for that of their
    numbers. `kept`: names of the arrays of a rollout that are stored. `codes`: names of result codes. `pilot`: a program that
    counts the steps of a short part of rollouts, or None.
    """

    order: np.ndarray | None
    reducer: Reducer
    kept: tuple[str, ...]
    codes: tuple[str, ...]
    process: Process
    pilot: Program | None = None
    tally: Tally = field(default_factory=Tally)

    def numbers(self, places: slice) -> np.ndarray:
        """Numbers of the rollouts at these places of the store."""
        if self.order is not None:
            return self.order[places]
        return np.arange(places.start, places.stop)

    def arrays_of(self, rows: Mapping[str, np.ndarray], numbers: np.ndarray) -> Arrays:
        """What a chunk has in the store."""
        return {name: rows[name] for name in self.kept} | self.reducer.partials(rows, numbers)


def chunk_size(seconds: float, lanes: int, row_bytes: int, count: int, processes: int) -> int:
    """Rollouts of a chunk: some seconds of work, not too many bytes, and enough chunks for each process; whole batches."""
    batches = min(SECONDS / max(seconds, 1e-6), BYTES / max(row_bytes * lanes, 1), count / (SHARES * processes * lanes))
    return min(lanes * max(1, int(batches)), count)


def by_cost(program: Program, pilot: Program, numbers: np.ndarray, tally: Tally) -> dict[str, np.ndarray]:
    """Rows of these rollouts, computed by falling steps of a short part of each, so that those of a batch take about equally
    many; in the order of `numbers`."""
    order = np.argsort(-compute(pilot, numbers)[STEPS].astype(np.int64), kind="stable")
    rows = compute(program, numbers[order], tally)
    place = np.argsort(order)
    return {name: values[place] for name, values in rows.items()}


def compute(program: Program, numbers: np.ndarray, tally: Tally | None = None) -> dict[str, np.ndarray]:
    """Rows of these rollouts; two batches are under way at a time."""
    rows: dict[str, np.ndarray] = {}
    starts = range(0, len(numbers), program.lanes)
    under_way: list[tuple[int, Any]] = []

    def fetch() -> None:
        begin, results = under_way.pop(0)
        for name, values in results.items():
            values = np.asarray(values)
            if name not in rows:
                rows[name] = np.empty((len(numbers), *values.shape[1:]), values.dtype)
            part = rows[name][begin : begin + program.lanes]
            part[...] = values[: len(part)]
            if name == STEPS and tally is not None:
                tally.add(values, len(program.devices))

    for begin in starts:
        under_way.append((begin, program.start(numbers[begin : begin + program.lanes])))
        if len(under_way) == 2:
            fetch()
    while under_way:
        fetch()
    return rows


def fill(job: Job, program: Program, store: Store, lock: Lock, meter: Progress, chunks: Iterable[int]) -> list[int]:
    """Compute, write and record the chunks that no other process has; returns those that others claim."""
    others = []
    with ThreadPoolExecutor(1, thread_name_prefix="jaxdyn store") as writer:
        written: Future | None = None

        def write(chunk: int, numbers: np.ndarray, rows: dict[str, np.ndarray]) -> None:
            store.write(chunk, job.arrays_of(rows, numbers))
            lock.release(chunk)
            meter.add(len(numbers), int((rows["result"] != 0).sum()))

        for chunk in chunks:
            if store.is_done(chunk):
                continue
            if not lock.claim(chunk):
                others.append(chunk)
                continue
            if store.is_done(chunk):  # recorded between the two looks
                lock.release(chunk)
                continue
            numbers = job.numbers(store.rows(chunk))
            if job.pilot is None:
                rows = compute(program, numbers, job.tally)
            else:
                rows = by_cost(program, job.pilot, numbers, job.tally)
            if written is not None:
                written.result()
            written = writer.submit(write, chunk, numbers, rows)
        if written is not None:
            written.result()
    return others


def drive(job: Job, program: Program, store: Store, lock: Lock, meter: Progress, verify: bool) -> list[int]:
    """Until all chunks are recorded; returns those of before that were not whole and were computed again."""
    index, count = job.process
    before = store.done()
    first = index * store.chunks // count
    others = fill(job, program, store, lock, meter, [*range(first, store.chunks), *range(first)])
    bad = []
    if verify and before:
        bad = [chunk for chunk in before if chunk % count == index and not store.is_whole(chunk)]
        for chunk in bad:
            store.forget(chunk)
            meter.note(f"chunk {chunk} of the store was not whole: its rollouts are computed again")
        others += fill(job, program, store, lock, meter, bad)
    while others := fill(job, program, store, lock, meter, others):
        time.sleep(POLL)
    return bad


def codes_of(job: Job, store: Store, most: int) -> tuple[dict[str, int], np.ndarray]:
    """How many rollouts ended with which code, and the numbers of the first `most` that failed, in the order of the store."""
    counts = np.zeros(len(job.codes), np.int64)
    failed: list[np.ndarray] = []
    left = most
    for start, codes in store.parts("result"):
        counts += np.bincount(codes, minlength=len(counts))
        places = np.flatnonzero(codes)[:left]
        failed.append(job.numbers(slice(start, start + len(codes)))[places])
        left -= len(places)
    named = {name: int(n) for name, n in zip(job.codes, counts, strict=True) if n}
    return named, np.concatenate(failed)


def merge(job: Job, store: Store) -> dict[str, Arrays]:
    """The results of all reductions, stored too."""
    names = [name for name in store.names if name.startswith("partial/")]
    partials = {name: np.concatenate([part for _, part in store.parts(name)]) for name in names}
    merged = job.reducer.merged(partials)
    store.put(named(merged))
    return merged


def local_devices(devices: Sequence[Any] | None) -> list[Any]:
    """Devices of this process.

    **Raises:** ValueError for devices of others, and for none.
    """
    own = jax.local_devices()
    given = own if devices is None else list(devices)
    if not given or any(device not in own for device in given):
        raise ValueError(f"devices is {devices}; give some of this process' own, jax.local_devices() = {own}")
    return given
