"""`jd.scale.run` and `jd.scale.evaluate`: resumable batch runs of functions of one sample."""

import errno
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Array, PyTree

from jaxdyn.model.arguments import Checked, FilePath, Numbers, as_array, as_path, warn
from jaxdyn.model.description import scene_lines
from jaxdyn.scale.program import Members, digest, members
from jaxdyn.scale.reductions import Arrays, Reducer, Reduction, Totals, check_reductions, describe_reductions
from jaxdyn.scale.store import Store, check_place, lock_store, zarr_package
from jaxdyn.scale.study import (
    LISTED,
    Description,
    Facts,
    Rollout,
    Study,
    describe,
    function_values,
    local_devices,
    motion_values,
)
from jaxdyn.simulation.checks import check_times
from jaxdyn.simulation.controls import Control
from jaxdyn.systems.scene import as_scene
from jaxdyn.systems.system import SceneLike
from jaxdyn.tasks import Cluster, DaskClient, Engine, Failure, Local, package_versions

if TYPE_CHECKING:
    import xarray

SECONDS = 2.0  # of computing per chunk, if it may be so large
BYTES = 2**25  # of rows in a chunk
SHARES = 8  # chunks per worker at least, so that all end at about the same time
CHECKED = 64  # chunks that one task checks
MAX_FAILURES = 100  # chunks that fail before no others are tried
FULL = (errno.ENOSPC, errno.EDQUOT)  # of a disk


@dataclass(frozen=True)
class Run:
    """Result of a run; the rows are in the store.

    - `out`, its path; `samples`, number of rollouts; `chunk`, rollouts per chunk.
    - `codes`: number of rollouts that ended with each result code, by its name. `failed`: numbers of the first 1000 that failed.
    - `reductions`: the arrays of each reduction, by its name and theirs.
    - `computed`: rollouts computed in this call; `seconds`, of the loop, without compilation. `repaired`: chunks
      of earlier calls that were damaged and were computed again. `batch_size`: rollouts at once; `program_bytes`: memory of their
      program and its results, by XLA's account.
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
    batch_size: int
    program_bytes: int

    @property
    def success(self) -> bool:
        """True if every rollout succeeded."""
        return set(self.codes) <= {"successful"}

    def dataset(self) -> "xarray.Dataset":
        """The store as an `xarray.Dataset`, read as it is used."""
        import xarray

        return xarray.open_zarr(self.out, chunks=None)

    def __str__(self) -> str:
        lines = [f"{self.out}: {self.samples} rollouts, {self.computed} of them computed in {self.seconds:.3g} s"]
        lines += [f"{count:>10} {name}" for name, count in self.codes.items()]
        if len(self.failed):
            lines.append(f"failed: {', '.join(map(str, self.failed[:10]))}{', ...' if len(self.failed) > 10 else ''}")
        return "\n".join(lines)


@dataclass(frozen=True)
class Resources:
    """Workers and devices of a batch, and the sizes of its parts.

    - `client`: a `dask.distributed.Client`, whose workers compute the chunks; without it this process does, and Dask is not
      imported. `retries`: attempts after the first for a chunk that raises; others are finished before its error is reported.
    - `devices`: of this process, all by default; a worker uses all of its own. `batch_size`: rollouts computed at once, by
      default 2048 for each device of a CPU and fewer where there are few rollouts. It is reduced where the compiled program
      with its results, by XLA's account, exceeds half of the free memory, which the workers of a host share. `chunk`: rollouts
      stored at once, and lost at most when killed; by default two seconds of work.
    - `progress`: show rate and time left on standard error.

    **Raises:** ValueError for a number that is not one, and for `devices` of this process next to a client.
    """

    client: DaskClient | None = None
    retries: int = 2
    devices: Checked[Sequence[Any] | None] = None
    batch_size: int | None = None
    chunk: int | None = None
    progress: bool = True

    def __post_init__(self):
        for name, minimum in (("batch_size", 1), ("chunk", 1), ("retries", 0)):
            value = getattr(self, name)
            is_default = value is None and minimum
            # bool is a subclass of int: True would pass as 1.
            if not is_default and (isinstance(value, bool) or not isinstance(value, int) or value < minimum):
                raise ValueError(
                    f"{name} is {value!r}; give a whole number of at least {minimum}{', or None' if minimum else ''}"
                )
        if self.client is None:
            local_devices(self.devices)
        elif self.devices is not None:
            raise ValueError("devices is given with client; leave it out: each worker uses all of its own")


def _resources(given: Resources | None, options: dict[str, Any]) -> Resources:
    """Take the fields of `Resources` that are given by their own names, which is deprecated, out of the options."""
    old = {one.name: options.pop(one.name) for one in fields(Resources) if one.name in options}
    if old:
        warn(f"{', '.join(old)} of jd.scale are now fields: resources=jd.scale.Resources(...)", DeprecationWarning)
    return replace(given or Resources(), **old)


def run(
    scene: Checked[SceneLike | Callable[[Any], Any]],
    states: Checked[tuple[Numbers, Numbers] | Callable[[Any], tuple[Array, Array]]],
    parameters: PyTree,
    ts: Numbers,
    *,
    out: FilePath,
    samples: int | float | None = None,
    seed: int = 0,
    control: Control = None,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    units: Mapping[str, str] | None = None,
    resources: Checked[Resources | None] = None,
    **options: Any,
) -> Run:
    """Simulate a batch of any size, chunk by chunk, into a Zarr store; the same call resumes an interrupted run.

    **Arguments:**

    - `scene`: a `Scene` or `Model` for all rollouts, or a function that builds that of one, `scene(parameters)`; it may return
      a pair (scene, control). The function is traced: parameters go into leaves (`model.replace`, arguments of a
      scene that become leaves).
    - `states`: a pair (q0, v0) of arrays, (nq,) and (nv,) for all rollouts or (samples, nq) and (samples, nv), or a function
      of one rollout, `states(parameters) -> (q0, v0)`.
    - `parameters`: None; a pytree of arrays (samples, ...), one row per rollout; or a function `draw(key)` that draws those of
      one rollout, traced.
    - `samples`: number of rollouts where parameters are drawn, which then are not held in memory. `seed`: rollout i has the key
      `jax.random.fold_in(jax.random.key(seed), i)`, for any chunks, devices and workers (see `jd.scale.member`).
    - `ts` (nt,): save points (s), `control`: as in `jd.simulate`.
    - `out`: directory of the store. Its variables are those of `Solution.to_xarray` over "rollout" and t, with names and
      units; `parameter_NAME`; `result`, a code whose names are its attribute flag_meanings; `num_steps`; `time_reached` (s).
    - `reductions`: a dictionary of `jd.scale.Mean`, `Histogram`, `Quantiles`, `Worst` or your own `Reduction`, of the rollouts
      that succeeded. They are variables NAME_PART of the store.
    - `rows`: True to store all arrays, False for none (codes and reductions alone), or the names of those to store.
    - `units`: of parameters, by name.
    - `resources`: a `jd.scale.Resources`: workers, devices, sizes of batches and chunks, progress.
    - `options`: further ones of `jd.simulate`.

    **Returns:** a `Run`. A rollout that fails is a row with its code and does not raise.

    Results are the same, bit for bit, whether a run was interrupted or not, and for any number of workers and devices and any
    sizes of batches and chunks on CPUs of one kind; other kinds, and GPUs, round differently in the last bit. The last bits of
    means depend on the size of chunks.

    **Raises:** ValueError for arguments that do not fit; for a store of another scene, version, seed, ..., with both values; for
    one that another process writes to, with its owner; for a cluster with other versions, or whose workers do not see `out`;
    what `simulate` raises when it is traced. ImportError without the extra `scale`. MemoryError where not even one rollout fits.
    What was finished is kept by: OSError where `out` cannot be written, or its disk is full; RuntimeError, with number and
    traceback, for a chunk that fails in every attempt; ConnectionError where the scheduler does not come back.

    ```python
    def draw(key):
        mass, radius = jax.random.uniform(key, (2,), minval=0.3, maxval=0.7)
        return {"mass": mass, "radius": radius}


    def start(p):
        return jnp.zeros(4), jnp.stack([2.0 * p["radius"], 0.0, 1.0, 2.0])


    disks = jd.scale.run(
        lambda p: jd.scenes.rolling_disk(**p), start, draw, ts, samples=100_000, out="disks.zarr", outputs=("energy",)
    )
    ```
    """
    resources = _resources(resources, options)
    ts = np.asarray(as_array(ts, "ts"))
    check_times(ts)
    # `Rollout` passes `throw` itself, which given twice would be a TypeError.
    options.pop("throw", None)
    model: Any = scene
    # A function is a leaf; a scene or a model is a pytree, even if it can be called.
    builds = callable(scene) and jax.tree_util.all_leaves([scene])
    draw = parameters if callable(parameters) else None
    named: dict[str, Any] = {} if draw is not None or parameters is None else {"parameters": parameters}
    fixed = {}
    if not callable(states):
        if not isinstance(states, (tuple, list)) or len(states) != 2:
            raise ValueError(f"states is {states!r}; give a pair (q0, v0), or a function of the parameters")
        for name, value in zip(("q0", "v0"), states, strict=True):
            value = np.asarray(as_array(value, name))
            # A state for all rollouts is a constant of the program, and is not repeated for each of them.
            (named if value.ndim > 1 else fixed)[name] = value
    batch = members(named, draw, samples, seed)

    if not builds:
        model = as_scene(model)
    rollout = Rollout(model, builds, states if callable(states) else None, fixed, control, ts, options)
    given = {
        "ts": f"{ts[0]:g} to {ts[-1]:g} s, {len(ts)} points, {digest(ts)}",
        "scene": "built by a function" if builds else scene_lines(model),
        "outputs": [str(name) for name in options.get("outputs", ())],
    }
    outputs = partial(describe, partial(motion_values, rollout), batch, units or {}, ts)
    return _run_batch(outputs, given, batch, out, reductions, rows, resources)


def evaluate(
    function: Callable[[Any], Mapping[str, Any]],
    parameters: PyTree,
    *,
    out: FilePath,
    samples: int | float | None = None,
    seed: int = 0,
    reductions: Checked[Mapping[str, Reduction] | None] = None,
    rows: bool | Sequence[str] = True,
    units: Mapping[str, str] | None = None,
    resources: Checked[Resources | None] = None,
    **old: Any,
) -> Run:
    """Evaluate a function of one sample for a batch of any size, as `run` simulates: fits from many starts, rewards, designs.

    **Arguments:** `function(parameters)`, traced, returns a dictionary of arrays, the variables of the store. One named "success"
    is true for a sample that succeeded; without it, samples with values that are not finite fail. All others are
    as in `jd.scale.run`; `units`: of parameters and of variables.

    **Returns:** a `Run`.

    **Raises:** ValueError for a function that returns no dictionary of arrays, and as `run` does.
    """
    resources = _resources(resources, old)
    if old:
        raise TypeError(f"evaluate has no argument {', '.join(old)}")
    draw = parameters if callable(parameters) else None
    batch = members({} if draw is not None else {"parameters": parameters}, draw, samples, seed)
    outputs = partial(describe, partial(function_values, function), batch, units or {}, None)
    return _run_batch(outputs, {}, batch, out, reductions, rows, resources)


def _run_batch(
    describe: Callable[[Any], Description],
    identity: dict[str, Any],
    batch: Members,
    out: FilePath,
    reductions: Any,
    rows: bool | Sequence[str],
    resources: Resources,
) -> Run:
    """Compute a batch that `describe(reductions)` describes; `identity` distinguishes it from others, by argument."""
    # A missing package and a wrong path are reported before anything is compiled.
    zarr_package()
    path = as_path(out, "out")
    check_place(path)
    reductions = check_reductions(reductions)
    outputs = describe(reductions)
    kept = _select_arrays(outputs, rows)
    reducer = Reducer(reductions, outputs.traced.shapes, outputs.variables)
    # Everything that decides the bytes of the store, and nothing else: a resumed run may have other devices, batches or workers.
    description = (
        {f"version of {name}": version for name, version in package_versions().items()}
        | {"float64": bool(jax.config.read("jax_enable_x64"))}
        | batch.description()
        | identity
        | {"rows stored": list(kept), "reductions": describe_reductions(reductions)}
    )
    sizes = (jax.ShapeDtypeStruct(x.shape, x.dtype) for x in (outputs.variables[name] for name in kept))
    row_bytes = sum(x.size * x.dtype.itemsize for x in sizes)
    with lock_store(path) as mark:
        store = Store(path) if path.exists() else None
        if store is not None:
            store.check(description)
        # Two tasks at once: one computes while the other stores.
        client, retries = resources.client, resources.retries
        engine = Local(retries, 2) if client is None else Cluster(client, retries, mark, 2)
        with engine:
            # Not larger than a chunk has to be, so that a batch is never filled up for nothing.
            maximum = min(BYTES // max(row_bytes, 1), -(-batch.count // (SHARES * engine.workers)))
            fixed = outputs, batch, reducer, kept, path.absolute(), resources.devices, resources.batch_size
            engine.send(Study(*fixed, maximum, engine.workers_per_host).open)
            # On one worker, for all: they have the same program, and the store is created once.
            facts: Facts = engine.call("facts", store is None)
            # Platforms round differently, so that a store keeps to one; it is known when a worker has its devices.
            description["platform"] = facts.platform
            if store is None:
                variables = [outputs.variables[name] for name in kept] + reducer.variables
                chunk = resources.chunk or _chunk_size(facts, row_bytes, batch.count, engine.workers)
                sizes = batch.count, min(chunk, batch.count)
                store = Store.create(path, variables, outputs.coordinates, description | facts.programs, *sizes)
            store.check(description)
            totals = Totals(reducer, len(outputs.codes), LISTED)
            begin = time.monotonic()
            computed, repaired = _compute_chunks(engine, store, totals, resources)
            seconds = time.monotonic() - begin
            results = totals.results()
            store.write_results({f"{name}_{part}": x for name, parts in results.items() for part, x in parts.items()})
    codes = {name: int(n) for name, n in zip(outputs.codes, totals.codes, strict=True) if n}
    given = path, batch.count, store.chunk, codes, totals.failed, results, computed, seconds, tuple(repaired)
    return Run(*given, facts.size, facts.bytes)


def _compute_chunks(engine: Engine, store: Store, totals: Totals, resources: Resources) -> tuple[int, list[int]]:
    """Compute the missing chunks, check those of earlier calls; returns rollouts computed, and the chunks that were damaged."""
    failures: list[tuple[int, Failure]] = []
    computed, repaired = 0, []
    before = store.done_mask()
    link = resources.client is not None and resources.client.dashboard_link
    if resources.progress and link:
        print(f"dashboard: {link}", file=sys.stderr)
    # The last chunk may have fewer rollouts than the others.
    stored = int(np.minimum(store.count - store.chunk * np.flatnonzero(before), store.chunk).sum())
    with _progress_meter(store.count, stored, resources.progress) as meter:
        for chunks, summaries in engine.map("chunks", _tasks(before)):
            if isinstance(summaries, Failure):
                number = getattr(summaries.error, "errno", None)
                # All other chunks would fail in the same way.
                if number in FULL:
                    raise OSError(
                        number,
                        f"out is {str(store.path)!r}, and its file system is full ({os.strerror(number)}); chunks that were "
                        "finished are kept: make room and run again",
                    ) from summaries.error
                failures.append((chunks[0], summaries))
                # So many failures have a common cause, which the other chunks would meet too.
                if len(failures) == MAX_FAILURES:
                    break
                continue
            for chunk, summary in zip(chunks, summaries, strict=True):
                totals.add(summary)
                rollouts = 0 if before[chunk] and not summary.is_repaired else int(summary.codes.sum())
                computed += rollouts
                failed = totals.codes[1:].sum()
                meter.set_postfix_str(f"{failed} failed" if failed else "", refresh=False)
                if not summary.is_repaired:
                    meter.update(rollouts)
                    continue
                repaired.append(chunk)
                if resources.progress:
                    meter.write(f"chunk {chunk} of the store was damaged and was computed again", sys.stderr)
    if failures:
        raise _chunk_error(failures, store)
    return computed, repaired


def _tasks(before: np.ndarray) -> Iterator[range]:
    """Chunks of each task, in order: one, or up to CHECKED that are in the store already, by the mask `before` (chunks,)."""
    first = 0
    while first < len(before):
        mask = before[first : first + CHECKED]
        # Up to the first one that is missing.
        size = max(1, len(mask) if mask.all() else int(np.argmin(mask)))
        yield range(first, first + size)
        first += size


def _progress_meter(total: int, before: int, is_shown: bool) -> Any:
    """Meter of rollouts with rate and time left on standard error: a line that is rewritten, rarely where that is a file."""
    from tqdm import tqdm

    class Meter(tqdm):
        monitor_interval = 0  # else a thread of tqdm outlives the run

    every = 0.2 if sys.stderr.isatty() else 10.0
    return Meter(total=total, initial=before, unit=" rollouts", mininterval=every, disable=not is_shown)


def _chunk_error(failures: list[tuple[int, Failure]], store: Store) -> RuntimeError:
    chunks = ", ".join(str(chunk) for chunk, _ in failures[:10]) + (", ..." if len(failures) > 10 else "")
    first = failures[0][1]
    kept = "no others were tried" if len(failures) == MAX_FAILURES else "the others are finished"
    error = RuntimeError(
        f"out is {str(store.path)!r}: of {store.chunks} chunks {len(failures)} failed in every attempt ({chunks}), {kept} and "
        f"kept; run again to try those alone. Chunk {failures[0][0]}:\n{first.traceback}"
    )
    error.__cause__ = first.error
    return error


def _chunk_size(facts: Facts, row_bytes: int, count: int, workers: int) -> int:
    """Rollouts of a chunk: some seconds of work, not too many bytes, and enough chunks for each worker; whole batches."""
    maximum = BYTES / max(row_bytes * facts.size, 1), count / (SHARES * workers * facts.size)
    batches = min(SECONDS / max(facts.seconds, 1e-6), *maximum)
    return min(facts.size * max(1, int(batches)), count)


def _select_arrays(outputs: Description, rows: bool | Sequence[str]) -> tuple[str, ...]:
    if isinstance(rows, bool):
        return tuple(outputs.variables) if rows else ("result",)
    unknown = [name for name in rows if name not in outputs.variables]
    if unknown or isinstance(rows, str):
        raise ValueError(f"rows is {rows!r}; name some of {', '.join(outputs.variables)}")
    # A dictionary removes repetitions and keeps the order that the user gave.
    return tuple(dict.fromkeys([*rows, "result"]))
