"""What `run` and `evaluate` share: from a function of one sample, described, to the result of a whole batch."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxdyn.model.arguments import Numbers, as_array, as_path
from jaxdyn.scale.described import Described
from jaxdyn.scale.lock import lock_store
from jaxdyn.scale.members import Members, digest
from jaxdyn.scale.reducer import Merger, Reducer
from jaxdyn.scale.reductions import Arrays, check_reductions, describe_reductions
from jaxdyn.scale.store import FULL, Store, check_place, full_disk, zarr_package
from jaxdyn.scale.study import LISTED, PILOT_BATCHES, Facts, Pipeline, Study, local_devices
from jaxdyn.tasks import Cluster, Engine, Failure, Progress, package_versions

if TYPE_CHECKING:
    import xarray

    Cost = Callable[[Any], Any] | Numbers | str | None
else:
    Cost = Any  # `run_batch` and `_order` look at it

MEASURED = "measured"  # of a cost that nobody has to know
SECONDS = 2.0  # of computing to a chunk, if it may be so large
BYTES = 2**25  # of rows in a chunk
SHARES = 8  # chunks to a worker at least, so that all end at about the same time
CHECKED = 64  # chunks that one task looks through
MOST_FAILURES = 100  # chunks that fail before no others are tried


@dataclass(frozen=True)
class Run:
    """What a run gives back; the rows are in the store.

    - `out`, its path; `samples`, rollouts in it; `chunk`, how many of them a chunk has.
    - `codes`: how many rollouts ended with each result code, by its name. `failed`: the numbers of those that did not
      succeed, the first 1000 in the order of the store.
    - `reductions`: the arrays of each reduction, by its name and theirs.
    - `computed`: rollouts computed in this call; `seconds`, of the loop, without compilation. `repaired`: chunks
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
    client: Any
    retries: int
    devices: Sequence[Any] | None
    lanes: int | None
    chunk: int | None
    memory: int | None
    compress: bool
    verify: bool
    progress: bool
    units: Mapping[str, str]


def run_batch(
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
    _check_options(options)
    reductions = check_reductions(options.reductions)
    outputs = describe(reductions)
    kept = _select_rows(outputs, options.rows)
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
    description = (
        {f"version of {name}": version for name, version in package_versions().items()}
        | {"float64": bool(jax.config.read("jax_enable_x64"))}
        | batch.description()
        | words
        | {"order": None if order is None else digest(order), "rows stored": list(kept)}
        | {"reductions": describe_reductions(reductions), "compression": options.compress}
    )
    row_bytes = sum(_bytes(outputs.variables[name]) for name in kept)
    with full_disk(path), lock_store(path) as mark:
        store = Store(path) if path.exists() else None
        if store is not None:
            store.check(description)
            store.remove_leftovers()
        engine: Engine = (
            Pipeline(options.retries) if options.client is None else Cluster(options.client, options.retries, mark)
        )
        with engine:
            most_lanes = min(BYTES // max(row_bytes, 1), -(-batch.count // (SHARES * engine.workers)))
            fixed = outputs, batch, pilot, reducer, kept, order, path.absolute(), options.devices
            study = Study(*fixed, options.lanes, most_lanes, options.memory, engine.workers_per_host)
            engine.send(study.open)
            facts: Facts = engine.call("facts", store is None)
            description["platform"] = facts.platform
            if store is None:
                variables = [outputs.variables[name] for name in kept] + reducer.variables
                variables = [replace(one, compressed=one.compressed or options.compress) for one in variables]
                chunk = options.chunk or _chunk_size(facts, row_bytes, batch.count, engine.workers, bool(pilot))
                sizes = batch.count, min(chunk, batch.count)
                store = Store.create(path, variables, outputs.coordinates(order), description | facts.programs, *sizes)
            store.check(description)
            before = store.recorded_chunks()
            meter = Progress(batch.count, store.count_rollouts(before), shown=options.progress)
            if options.client is not None and (link := options.client.dashboard_link):
                meter.note(f"dashboard: {link}")
            merger = Merger(reducer, len(outputs.codes), LISTED)
            repaired = _compute_all(engine, store, merger, meter, before, options)
            meter.end()
            results = merger.results()
            store.put({f"{name}_{part}": value for name, parts in results.items() for part, value in parts.items()})
    needed, waited = merger.steps.tolist()
    codes = {name: int(n) for name, n in zip(outputs.codes, merger.codes, strict=True) if n}
    given = (
        path,
        batch.count,
        store.chunk,
        codes,
        merger.failed,
        results,
        meter.computed,
        meter.seconds,
        tuple(repaired),
    )
    return Run(*given, facts.lanes, facts.bytes, waited / needed if needed else float("nan"))


def _check_options(options: Options) -> None:
    for name, least in (("lanes", 1), ("chunk", 1), ("memory", 1), ("retries", 0)):
        value = getattr(options, name)
        is_given = value is not None or name == "retries"
        if is_given and (isinstance(value, bool) or not isinstance(value, int) or value < least):
            raise ValueError(
                f"{name} is {value!r}; give a whole number of at least {least}{', or None' if least else ''}"
            )
    if options.client is None:
        local_devices(options.devices)
    elif options.devices is not None:
        raise ValueError("devices is given with client; leave it out: each worker uses all of its own")


def _compute_all(
    engine: Engine, store: Store, merger: Merger, meter: Progress, before: np.ndarray, options: Options
) -> list[int]:
    """Compute the chunks that are missing, then look through those of before; returns those that were not whole."""
    failures: list[tuple[int, Failure]] = []
    is_new = not before.any()
    missing = range(store.chunks) if is_new else (int(chunk) for chunk in np.flatnonzero(~before))

    def results(method: str, items: Any) -> Iterator[tuple[Any, Any]]:
        for item, result in engine.map(method, items):
            if not isinstance(result, Failure):
                yield item, result
                continue
            if isinstance(result.error, OSError) and result.error.errno in FULL:
                raise result.error
            failures.append((item if method == "chunk" else item[0], result))
            if len(failures) == MOST_FAILURES:
                return

    def count(chunk: int, summary: Any) -> None:
        rows = store.rows(chunk)
        meter.add(rows.stop - rows.start, int(summary.codes[1:].sum()))

    for chunk, summary in results("chunk", missing):
        count(chunk, summary)
        if is_new:
            merger.add(summary)
    repaired: list[int] = []
    if not is_new and not failures:
        ranges = (
            (start, before[start : start + CHECKED] & options.verify) for start in range(0, store.chunks, CHECKED)
        )
        for (start, _), summaries in results("check", ranges):
            for chunk, (is_bad, summary) in enumerate(summaries, start):
                merger.add(summary)
                if is_bad:
                    repaired.append(chunk)
                    meter.note(f"chunk {chunk} of the store was not whole: its rollouts are computed again")
                    count(chunk, summary)
    if failures:
        meter.end()
        raise _chunk_error(failures, store)
    return repaired


def _chunk_error(failures: list[tuple[int, Failure]], store: Store) -> RuntimeError:
    chunks = ", ".join(str(chunk) for chunk, _ in failures[:10]) + (", ..." if len(failures) > 10 else "")
    first = failures[0][1]
    kept = "no others were tried" if len(failures) == MOST_FAILURES else "the others are finished"
    error = RuntimeError(
        f"out is {str(store.path)!r}: of {store.chunks} chunks {len(failures)} failed in every attempt ({chunks}), {kept} and "
        f"kept; run again to try those alone. Chunk {failures[0][0]}:\n{first.traceback}"
    )
    error.__cause__ = first.error
    return error


def _chunk_size(facts: Facts, row_bytes: int, count: int, workers: int, is_measured: bool) -> int:
    """Rollouts of a chunk: some seconds of work, not too many bytes, and enough chunks for each worker; whole batches."""
    lanes = facts.lanes
    most = BYTES / max(row_bytes * lanes, 1), count / (SHARES * workers * lanes)
    batches = min(SECONDS / max(facts.seconds, 1e-6), *most)
    return max(min(lanes * max(1, int(batches)), count), PILOT_BATCHES * lanes if is_measured else 0)


def _select_rows(described: Described, rows: bool | Sequence[str]) -> tuple[str, ...]:
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


def _bytes(variable: Any) -> int:
    return int(np.prod(variable.shape, dtype=np.int64)) * np.dtype(variable.dtype).itemsize
