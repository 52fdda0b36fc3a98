"""Tasks on the workers of a Dask client: checks, a sliding window of tasks, and recovery when a machine dies."""

import contextlib
import itertools
import logging
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxdyn.tasks.local import Failure, Local, package_versions

if TYPE_CHECKING:
    from distributed import Client as DaskClient
else:
    DaskClient = Any  # Dask need not be installed; `Cluster` checks the object

logger = logging.getLogger("jaxdyn")
WINDOW = 4  # tasks per worker, running or waiting: enough that it never idles, few enough that memory stays flat
MIN_WINDOW = 16
AHEAD = 8  # windows that tasks may run ahead of an unfinished one, whose place in the order their results wait for


class Cluster:
    """Tasks on the workers of a Dask client: methods of an object that `send` sends to them; a context manager.

    **Arguments:** `retries`, of a task that raises. `mark`: a file and its text, which every worker has to see, or None.
    `at_once`: tasks of a worker with as many threads.

    A worker has one task at a time by default, so that tasks do not compete for the threads of kernels. Tasks of a worker that
    dies go to the others. If the scheduler dies, the client reconnects within its own `timeout`, and unfinished tasks are
    submitted again.

    **Raises:** ValueError for anything but a connected client, and for a scheduler or workers with other versions of Python,
    Dask, JAX or jaxdyn, before any task. ConnectionError where the scheduler does not come back.
    """

    def __init__(self, client: DaskClient, retries: int = 0, mark: tuple[Path, str] | None = None, at_once: int = 1):
        self.client: Any = client
        self.retries, self.mark, self.at_once = retries, mark, at_once
        self._name = f"jaxdyn-{uuid.uuid4().hex[:12]}"
        self._plugin: Any = None
        self._generation = itertools.count()

    def __enter__(self) -> "Cluster":
        try:
            import cloudpickle  # noqa: F401 (reported here if it is missing)
            from distributed import Client
        except ImportError as error:
            raise ImportError(f"client= needs {error.name}: pip install 'jaxdyn[scale]'") from error
        if not isinstance(self.client, Client) or self.client.asynchronous or self.client.status != "running":
            raise ValueError(
                f"client is {self.client!r}; give a dask.distributed.Client that is connected and not asynchronous"
            )
        self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        if self._plugin is not None:
            with contextlib.suppress(Exception):  # of a scheduler that is gone
                self.client.unregister_worker_plugin(self._name)

    def send(self, target: Callable[[], Any]) -> None:
        """Send `target` by cloudpickle, with the settings of JAX of this thread, to each worker, also to those that join later.

        A worker calls it before its first task.

        **Raises:** ValueError for a worker that does not see the file `mark`.
        """
        import cloudpickle

        from jaxdyn.tasks.worker import TargetPlugin

        self._plugin = TargetPlugin(self._name, cloudpickle.dumps(target), self.mark)
        self.client.register_plugin(self._plugin, name=self._name)

    def _begin(self) -> None:
        # A cluster that scales by need has no worker yet.
        self.client.wait_for_workers(1)
        _check_versions(self.client)
        if self._plugin is not None:
            self.client.register_plugin(self._plugin, name=self._name)

    @property
    def workers(self) -> int:
        """Number of workers now, at least 1."""
        return count_workers(self.client)

    @property
    def workers_per_host(self) -> int:
        """Number of workers that share the fullest host."""
        return max(Counter(address.rpartition(":")[0] for address in self.client.nthreads()).values(), default=1)

    def call(self, method: str, item: Any) -> Any:
        """target.method(item) on a worker. **Raises:** its error."""
        [(_, result)] = self.map(method, [item])
        if isinstance(result, Failure):
            raise result.error
        return result

    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Pairs of an item and target.method(item), or the `Failure` of its last attempt, in the order of the items.

        Tasks are submitted as results arrive: memory does not grow with their number.
        """
        window = _Window(self, method, items)
        while True:
            try:
                window.submit()
                yield from window.take_ready()
                if not window.waiting:
                    if window.is_exhausted:
                        return
                    continue
                window.collect()
            except _outages():
                self._recover()
                window.submit_again()

    def submit(self, group: str, method: str, places: list[int], items: list[Any]) -> list[Any]:
        """Futures of tasks, with keys (group, place)."""
        from jaxdyn.tasks.worker import RESOURCE, call_target

        return self.client.map(
            call_target,
            [self._name] * len(items),
            [method] * len(items),
            items,
            key=[(group, place) for place in places],
            resources={name: 1 / self.at_once for name in (RESOURCE, self._name)},
            retries=self.retries,
            pure=False,  # keys are given, not hashes of the arguments
        )

    def new_group(self, method: str) -> str:
        """A new name for the keys of tasks."""
        return f"{self._name}-{method}-{next(self._generation)}"

    def _recover(self) -> None:
        """Wait for a scheduler, which may be another one at the same address, and for a worker."""
        logger.warning("tasks are lost on the way to the scheduler; they are submitted again when it answers")
        while True:
            while self.client.status == "connecting":
                time.sleep(0.1)
            if self.client.status != "running":
                raise ConnectionError(
                    "client: the scheduler is gone and did not come back within the client's timeout; what was finished is kept: "
                    "start a cluster and run again"
                )
            try:
                return self._begin()
            except _outages():  # the client has not noticed yet, or the next scheduler is gone too
                time.sleep(0.1)


class _Window:
    """Tasks that were submitted, and results that wait for an earlier one."""

    def __init__(self, cluster: Cluster, method: str, items: Iterable[Any]):
        from distributed import as_completed

        self._cluster, self._method, self._items = cluster, method, enumerate(items)
        self._completed = as_completed()
        # One name for all tasks: the scheduler keeps an entry for each name.
        self._group = cluster.new_group(method)
        self.waiting: dict[int, tuple[Any, Any]] = {}  # item and future by place
        self._ready: dict[int, tuple[Any, Any]] = {}  # item and result by place
        self._next = self._taken = 0
        self.is_exhausted = False
        self._workers, self._counted = 1, 0.0

    def take_ready(self) -> Iterator[tuple[Any, Any]]:
        """Results that are next in the order of the items."""
        while self._next in self._ready:
            self._next += 1
            yield self._ready.pop(self._next - 1)

    def submit(self) -> None:
        """Fill the window when half of it is empty: a call of the scheduler costs more than a task."""
        if time.monotonic() - self._counted > 1.0:
            self._workers, self._counted = self._cluster.workers, time.monotonic()
        size = max(MIN_WINDOW, WINDOW * self._workers)
        if len(self.waiting) > size // 2:
            return
        room = min(size - len(self.waiting), self._next + AHEAD * size - self._taken)
        new = list(itertools.islice(self._items, max(0, room)))
        self.is_exhausted |= len(new) < room
        if new:
            self._taken = new[-1][0] + 1
            self._add(dict(new))

    def submit_again(self) -> None:
        """Submit all unfinished tasks again, whose futures are lost."""
        self._completed.clear()
        self._group = self._cluster.new_group(self._method)
        lost = {place: item for place, (item, _) in self.waiting.items()}
        self.waiting.clear()
        self._add(lost)

    def _add(self, new: dict[int, Any]) -> None:
        # Recorded first: if submitting fails, they are submitted again.
        self.waiting |= {place: (item, None) for place, item in new.items()}
        futures = self._cluster.submit(self._group, self._method, list(new), list(new.values()))
        self.waiting |= {place: (new[place], future) for place, future in zip(new, futures, strict=True)}
        self._completed.update(futures)

    def collect(self) -> None:
        """Wait for results and fetch them."""
        batch = [future for future in self._completed.next_batch() if self._place(future) is not None]
        good = [future for future in batch if future.status == "finished"]
        results: dict[Any, Any] = dict(zip(good, self._cluster.client.gather(good), strict=True))
        for future in batch:
            if future.status == "error":
                results[future] = Failure.of(future.exception(), future.traceback())
            elif future not in results:
                raise ConnectionError(f"{future} is {future.status}")
        for future, result in results.items():
            place = self._place(future)
            item, _ = self.waiting.pop(place)
            self._ready[place] = item, result

    def _place(self, future: Any) -> Any:
        place = future.key[1]
        return place if self.waiting.get(place, (None, None))[1] is future else None


def _outages() -> tuple[type[BaseException], ...]:
    """Errors of the client if the scheduler is gone, or if results are lost with all workers that had them."""
    from concurrent.futures import CancelledError

    from distributed.comm.core import CommClosedError

    return OSError, CommClosedError, CancelledError


def _check_versions(client: Any) -> None:
    """**Raises:** ValueError that names the first worker, or the scheduler, with another version than this process."""
    names = ["dask", "distributed", *package_versions()]
    found = client.get_versions(packages=names)
    own = found["client"]["packages"] | package_versions()
    places = [("the scheduler", found["scheduler"], names[:2])]
    places += [(f"worker {address}", report, names) for address, report in found["workers"].items()]
    for place, report, compared in places:
        theirs = report["packages"]
        for name in ["python", *compared]:
            # The byte code of a function sent by value differs between minor versions of Python.
            here, there = (
                (x.split(".")[:2] if name == "python" and x else x) for x in (own.get(name), theirs.get(name))
            )
            if here != there:
                raise ValueError(
                    f"client: {place} has {name} {theirs.get(name) or 'not at all'}, and this process {own.get(name)}; install "
                    "the same version on both"
                )


def count_workers(client: DaskClient | None) -> int:
    """Workers of a client now, at least 1; 1 without a client."""
    if client is None:
        return 1
    threads: Any = client.nthreads()
    return max(1, len(threads))


def map_tasks(
    function: Callable[[Any], Any], items: Iterable[Any], client: DaskClient | None = None, *, retries: int = 2
) -> list[Any]:
    """[function(item) for each item], on the workers of a Dask client if one is given; arrays are returned as NumPy arrays.

    **Raises:** errors of the function, and those of `Cluster`.
    """
    with open_engine(client, retries) as engine:
        engine.send(lambda: _Function(function))
        return list(results(engine, "call", items))


class _Function:
    def __init__(self, function: Callable[[Any], Any]):
        self._function = function

    def call(self, item: Any) -> Any:
        # A client whose process is in 32 bits, outside of its settings in 64, would truncate arrays of JAX as it unpickles them.
        return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, self._function(item))


Engine = Local | Cluster


def open_engine(client: DaskClient | None, retries: int = 2) -> Engine:
    """The engine of a client, or that of this process, which does not try again."""
    return Local() if client is None else Cluster(client, retries)


def results(engine: Engine, method: str, items: Iterable[Any]) -> Iterator[Any]:
    """target.method(item) of each item, in order. **Raises:** the first error."""
    for _, result in engine.map(method, items):
        if isinstance(result, Failure):
            raise result.error
        yield result
