"""The common part of `run` and `evaluate`: from the description of a function of one sample to the result of a batch."""

import errno
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxdyn.model.arguments import as_path
from jaxdyn.scale.program import Members
from jaxdyn.scale.reductions import Arrays, Reducer, Totals, check_reductions, describe_reductions
from jaxdyn.scale.store import Store, check_place, zarr_package
from jaxdyn.scale.study import LISTED, Description, Facts, Study, local_devices
from jaxdyn.tasks import Cluster, Engine, Failure, Local, package_versions

if TYPE_CHECKING:
    import xarray
import contextlib
import getpass
import socket
import uuid

SECONDS = 2.0  # of computing per chunk, if it may be so large
BYTES = 2**25  # of rows in a chunk
SHARES = 8  # chunks per worker at least, so that all end at about the same time
CHECKED = 64  # chunks that one task checks
MOST_FAILURES = 100  # chunks that fail before no others are tried
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


class Options(NamedTuple):
    """Options that `run` and `evaluate` share, see `run`."""

    out: Any
    reductions: Any
    rows: bool | Sequence[str]
    client: Any
    retries: int
    devices: Sequence[Any] | None
    batch_size: int | None
    chunk: int | None
    progress: bool

    def check(self) -> None:
        """**Raises:** ValueError for a number that is not one, and for `devices` of this process next to a client."""
        for name, least in (("batch_size", 1), ("chunk", 1), ("retries", 0)):
            value = getattr(self, name)
            is_default = value is None and least
            # bool is a subclass of int: True would pass as 1.
            if not is_default and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ValueError(
                    f"{name} is {value!r}; give a whole number of at least {least}{', or None' if least else ''}"
                )
        if self.client is None:
            local_devices(self.devices)
        elif self.devices is not None:
            raise ValueError("devices is given with client; leave it out: each worker uses all of its own")


def run_batch(
    describe: Callable[[Any], Description],
    identity: dict[str, Any],
    batch: Members,
    options: Options,
) -> Run:
    """Compute a batch that `describe(reductions)` describes; `identity` distinguishes it from others, by argument."""
    # A missing package and a wrong path are reported before anything is compiled.
    options.check()
    zarr_package()
    path = as_path(options.out, "out")
    check_place(path)
    reductions = check_reductions(options.reductions)
    outputs = describe(reductions)
    kept = _select_arrays(outputs, options.rows)
    reducer = Reducer(reductions, outputs.traced.shapes, outputs.variables)
    # Everything that decides the bytes of the store, and nothing else: a resumed run may have other devices, batches or workers.
    description = (
        {f"version of {name}": version for name, version in package_versions().items()}
        | {"float64": bool(jax.config.read("jax_enable_x64"))}
        | batch.description()
        | identity
        | {"rows stored": list(kept), "reductions": describe_reductions(reductions)}
    )
    row_bytes = sum(_bytes(outputs.variables[name]) for name in kept)
    with lock_store(path) as mark:
        store = Store(path) if path.exists() else None
        if store is not None:
            store.check(description)
        # Two tasks at once: one computes while the other stores.
        client, retries = options.client, options.retries
        engine = Local(retries, 2) if client is None else Cluster(client, retries, mark, 2)
        with engine:
            # Not larger than a chunk has to be, so that a batch is never filled up for nothing.
            most = min(BYTES // max(row_bytes, 1), -(-batch.count // (SHARES * engine.workers)))
            fixed = outputs, batch, reducer, kept, path.absolute(), options.devices, options.batch_size
            engine.send(Study(*fixed, most, engine.workers_per_host).open)
            # On one worker, for all: they have the same program, and the store is created once.
            facts: Facts = engine.call("facts", store is None)
            # Platforms round differently, so that a store keeps to one; it is known when a worker has its devices.
            description["platform"] = facts.platform
            if store is None:
                variables = [outputs.variables[name] for name in kept] + reducer.variables
                chunk = options.chunk or _chunk_size(facts, row_bytes, batch.count, engine.workers)
                sizes = batch.count, min(chunk, batch.count)
                store = Store.create(path, variables, outputs.coordinates, description | facts.programs, *sizes)
            store.check(description)
            totals = Totals(reducer, len(outputs.codes), LISTED)
            begin = time.monotonic()
            computed, repaired = _compute_chunks(engine, store, totals, options)
            seconds = time.monotonic() - begin
            results = totals.results()
            store.write_results({f"{name}_{part}": x for name, parts in results.items() for part, x in parts.items()})
    codes = {name: int(n) for name, n in zip(outputs.codes, totals.codes, strict=True) if n}
    given = path, batch.count, store.chunk, codes, totals.failed, results, computed, seconds, tuple(repaired)
    return Run(*given, facts.size, facts.bytes)


def _compute_chunks(engine: Engine, store: Store, totals: Totals, options: Options) -> tuple[int, list[int]]:
    """Compute the missing chunks, check those of earlier calls; returns rollouts computed, and the chunks that were damaged."""
    failures: list[tuple[int, Failure]] = []
    computed, repaired = 0, []
    before = store.done_mask()
    link = options.client is not None and options.client.dashboard_link
    if options.progress and link:
        print(f"dashboard: {link}", file=sys.stderr)
    # The last chunk may have fewer rollouts than the others.
    stored = int(np.minimum(store.count - store.chunk * np.flatnonzero(before), store.chunk).sum())
    with _progress_meter(store.count, stored, options.progress) as meter:
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
                if len(failures) == MOST_FAILURES:
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
                if options.progress:
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
    kept = "no others were tried" if len(failures) == MOST_FAILURES else "the others are finished"
    error = RuntimeError(
        f"out is {str(store.path)!r}: of {store.chunks} chunks {len(failures)} failed in every attempt ({chunks}), {kept} and "
        f"kept; run again to try those alone. Chunk {failures[0][0]}:\n{first.traceback}"
    )
    error.__cause__ = first.error
    return error


def _chunk_size(facts: Facts, row_bytes: int, count: int, workers: int) -> int:
    """Rollouts of a chunk: some seconds of work, not too many bytes, and enough chunks for each worker; whole batches."""
    most = BYTES / max(row_bytes * facts.size, 1), count / (SHARES * workers * facts.size)
    batches = min(SECONDS / max(facts.seconds, 1e-6), *most)
    return min(facts.size * max(1, int(batches)), count)


def _select_arrays(outputs: Description, rows: bool | Sequence[str]) -> tuple[str, ...]:
    if isinstance(rows, bool):
        return tuple(outputs.variables) if rows else ("result",)
    unknown = [name for name in rows if name not in outputs.variables]
    if unknown or isinstance(rows, str):
        raise ValueError(f"rows is {rows!r}; name some of {', '.join(outputs.variables)}")
    # A dictionary removes repetitions and keeps the order that the user gave.
    return tuple(dict.fromkeys([*rows, "result"]))


def _bytes(variable: Any) -> int:
    return int(np.prod(variable.shape, dtype=np.int64)) * np.dtype(variable.dtype).itemsize


# --- one writer for each store: a lock by filelock, and a file that names its owner ---


@contextlib.contextmanager
def lock_store(path: Path) -> Iterator[tuple[Path, str]]:
    """Hold the lock of a store; gives the file that names its owner, and its text. The lock of a dead process is free.

    **Raises:** ValueError that names the owner where another process holds it.
    """
    from filelock import FileLock, Timeout

    # The owner stands in a file of its own: filelock truncates the lock's file when it tries to acquire it.
    lock, owner = FileLock(f"{path}.lock"), path.with_name(f"{path.name}.owner")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        # The file is written just after the lock is taken.
        name = owner.read_text(encoding="utf-8").splitlines()[0] if owner.exists() else "another process"
        raise ValueError(
            f"out is {str(path)!r}, to which {name} is writing; wait for it, end it, or name another store"
        ) from error
    try:
        user = str(os.getuid())
        with contextlib.suppress(KeyError, OSError):  # in a container without an entry for the user
            user = getpass.getuser()
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        # The random line lets workers tell this file from one of the same name on a disk of their own.
        text = f"process {os.getpid()} of {user} on {socket.gethostname()}, since {since},\n{uuid.uuid4().hex}\n"
        owner.write_text(text, encoding="utf-8")
        yield owner, text
    finally:
        owner.unlink(missing_ok=True)
        lock.release()
