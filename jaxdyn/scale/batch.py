"""What `run` and `evaluate` share: from a function of one sample, described, to the result of a whole batch."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxdyn.model.arguments import Numbers, as_array, as_path
from jaxdyn.scale import driver, program
from jaxdyn.scale.described import Described, version
from jaxdyn.scale.locks import Lock
from jaxdyn.scale.members import Members, digest
from jaxdyn.scale.processes import process_of
from jaxdyn.scale.progress import Progress
from jaxdyn.scale.reducer import Reducer
from jaxdyn.scale.reductions import Arrays, checked_reductions, described
from jaxdyn.scale.store import Store, check_place, full_disk, zarr_package

LISTED = 1000  # failures that a result lists
PROGRAM = "program of a rollout (scene, control, solver, functions)"  # how a store names its hash
if TYPE_CHECKING:
    import xarray

    Cost = Callable[[Any], Any] | Numbers | str | None
else:
    Cost = Any  # `whole` and `_order` look at it

MEASURED = "measured"  # of a cost that nobody has to know
BATCHES = 16  # of a chunk at least, where rollouts are put in order within chunks
LEAST_LANES = 64  # of a device then
LEFTOVER = 600.0  # s, after which a file that was not finished is nobody's, where there are several processes


@dataclass(frozen=True)
class Run:
    """What a run gives back; the rows are in the store.

    - `out`, its path; `samples`, rollouts in it; `chunk`, how many of them a chunk has.
    - `codes`: how many rollouts ended with each result code, by its name. `failed`: the numbers of those that did not
      succeed, the first 1000 in the order of the store.
    - `reductions`: the arrays of each reduction, by its name and theirs.
    - `computed`: rollouts computed by this process in this call; `seconds`, of the loop, without compilation. `repaired`: chunks
      of before that were not whole and were computed again. `lanes`: rollouts at once; `program_bytes`: memory of their program
      and its results, by XLA's account. `waiting`: steps that lanes waited for, until the slowest of a batch was done, over
      those that rollouts needed, in this call; 1 where nobody waits, NaN where no steps are counted.
    """

    out: Path
    samples: int
    chunk: int
    codes: dict[str, int]
    failed: np.ndarray
    reductions: dict[str, Arrays]
    computed: int
    seconds: float
    repaired: tuple[int, ...]
    lanes: int
    program_bytes: int
    waiting: float

    @property
    def success(self) -> bool:
        """Whether every rollout succeeded."""
        return set(self.codes) <= {"successful"}

    def dataset(self) -> "xarray.Dataset":
        """The store as an `xarray.Dataset`, read as it is used."""
        import xarray

        return xarray.open_zarr(self.out, chunks=None)

    def __str__(self) -> str:
        lines = [f"{self.out}: {self.samples} rollouts, {self.computed} of them computed in {self.seconds:.3g} s"]
        lines += [f"{count:>10} {name}" for name, count in self.codes.items()]
        if len(self.failed):
            shown = ", ".join(map(str, self.failed[:10]))
            lines.append(f"failed: {shown}{', ...' if len(self.failed) > 10 else ''}")
        return "\n".join(lines)


@dataclass(frozen=True)
class Options:
    """Options that `run` and `evaluate` share, see `run`."""

    out: Any
    reductions: Any
    rows: bool | Sequence[str]
    cost: Cost
    process: Any
    devices: Sequence[Any] | None
    lanes: int | None
    chunk: int | None
    memory: int | None
    compress: bool
    verify: bool
    progress: bool
    units: Mapping[str, str]


def whole(
    describe: Callable[[Any], Described],
    words: dict[str, Any],
    batch: Members,
    options: Options,
    pilot: Callable | None = None,
) -> Run:
    """Compute a batch that `describe(reductions)` describes; `words` tell it from others, by argument.

    `pilot(drawn, row)` counts the steps of a short part of a rollout, for a cost that is measured.
    """
    zarr_package()
    path = as_path(options.out, "out")
    check_place(path)
    for name in ("lanes", "chunk", "memory"):
        value = getattr(options, name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
            raise ValueError(f"{name} is {value!r}; give a whole number of at least 1, or None")
    process = process_of(options.process)
    devices = driver.local_devices(options.devices)
    reductions = checked_reductions(options.reductions)
    outputs = describe(reductions)
    kept = _kept(outputs, options.rows)
    if isinstance(options.cost, str):
        if options.cost != MEASURED or pilot is None:
            raise ValueError(
                f"cost is {options.cost!r}; give a function of the parameters, an array of one number for each rollout, or, "
                f"to jd.scale.run with adaptive steps, {MEASURED!r}"
            )
    else:
        pilot = None
    order = None if pilot else _order(options.cost, batch)
    reducer = Reducer(reductions, outputs.traced.shapes, outputs.variables)
    job = driver.Job(order, reducer, kept, outputs.codes, process)
    description = (
        version()
        | {"platform": devices[0].platform, "float64": bool(jax.config.read("jax_enable_x64"))}
        | batch.described()
        | words
        | {"order": None if order is None else digest(order), "rows stored": list(kept)}
        | {"reductions": described(reductions), "compression": options.compress}
    )
    row_bytes = sum(_bytes(outputs.variables[name]) for name in kept)
    with full_disk(path), Lock(path, process) as lock:
        store = Store(path) if path.exists() else None
        if store is not None:
            store.check(description)
            store.remove_leftovers(0.0 if process.count == 1 else LEFTOVER)
        lanes = options.lanes or _lanes(devices, batch.count, process.count, row_bytes)
        if pilot and not options.lanes:
            lanes = max(len(devices) * LEAST_LANES, lanes // BATCHES)
        memory = options.memory
        if memory is None and process.count > 1:  # which of them share this host is not known
            memory = int(program.SHARE * program.available_memory(devices) / process.count)
        compiled = program.Program(outputs.traced, batch, devices, lanes, memory, outputs.is_motion)
        if pilot:
            job.pilot = program.Program(program.Traced(pilot, batch), batch, devices, compiled.lanes, memory, True)
        if store is None:
            variables = [outputs.variables[name] for name in kept] + reducer.variables
            variables = [replace(one, compressed=one.compressed or options.compress) for one in variables]
            chunk = options.chunk or max(_chunk(job, compiled, row_bytes), BATCHES * compiled.lanes if pilot else 0)
            programs = {PROGRAM: program.fingerprint(outputs.one, batch), "lowered program": compiled.lowered}
            store = Store.create(
                path,
                variables,
                outputs.coordinates(order),
                description | programs,
                batch.count,
                min(chunk, batch.count),
            )
            store.check(description)  # another process may have been first
        if store.description["lowered program"] != compiled.lowered:
            # Of other lanes, devices or processors; what is computed for one member has to be the same.
            store.check({PROGRAM: program.fingerprint(outputs.one, batch)})
        meter = Progress(batch.count, store.finished, shown=options.progress)
        repaired = driver.drive(job, compiled, store, lock, meter, options.verify)
        meter.end()
        results = driver.merge(job, store)
        codes, failed = driver.codes_of(job, store, LISTED)
    sizes = batch.count, store.chunk
    return Run(
        path,
        *sizes,
        codes,
        failed,
        results,
        meter.computed,
        meter.seconds,
        tuple(repaired),
        compiled.lanes,
        compiled.bytes,
        job.tally.ratio,
    )


def _chunk(job: driver.Job, compiled: program.Program, row_bytes: int) -> int:
    count = compiled.members.count
    first = job.numbers(slice(0, min(compiled.lanes, count)))
    seconds = compiled.time(first, time.perf_counter)
    return driver.chunk_size(seconds, compiled.lanes, row_bytes, count, job.process.count)


def _kept(described: Described, rows: bool | Sequence[str]) -> tuple[str, ...]:
    if isinstance(rows, bool):
        return tuple(described.variables) if rows else ("result",)
    unknown = [name for name in rows if name not in described.variables]
    if unknown or isinstance(rows, str):
        raise ValueError(f"rows is {rows!r}; name some of {', '.join(described.variables)}")
    return tuple(dict.fromkeys([*rows, "result"]))


def _order(cost: Cost, batch: Members) -> np.ndarray | None:
    """Numbers of the rollouts by falling cost."""
    if cost is None:
        return None
    if callable(cost):

        def of(given: Any) -> Any:
            drawn, row = batch.one(given)
            return cost(drawn if batch.draw is not None else row.get("parameters"))

        many, step = jax.jit(jax.vmap(of)), 2**16
        parts = [np.arange(k, min(k + step, batch.count)) for k in range(0, batch.count, step)]
        costs = np.concatenate([np.asarray(many(batch.inputs(part))) for part in parts])
    else:
        costs = np.asarray(as_array(cost, "cost"))
    if costs.shape != (batch.count,):
        raise ValueError(f"cost has shape {costs.shape}; give one number for each of the {batch.count} rollouts")
    return np.argsort(-costs, kind="stable")


def _lanes(devices: Sequence[Any], count: int, processes: int, row_bytes: int) -> int:
    """Rollouts at once: what devices like, but no more than a chunk may have of bytes, and enough chunks for each process."""
    fair = -(-count // (driver.SHARES * processes))
    return max(1, min(program.default_lanes(devices), driver.BYTES // max(row_bytes, 1), fair))


def _bytes(variable: Any) -> int:
    return int(np.prod(variable.shape, dtype=np.int64)) * np.dtype(variable.dtype).itemsize
