"""Tasks in this process or a Dask worker: their failures, the settings of threads that compute them, and the worker's plugin."""

import asyncio
import contextlib
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import jax
from distributed import Worker, WorkerPlugin, get_worker
from distributed.core import Status

from jaxdyn.compile import compilation, compilation_mode


class Settings(NamedTuple):
    """Settings of JAX that decide the bits of a result, and the mode of compilation.

    Each can be set for a thread, so that those of a worker's process, which may serve others, do not change.
    """

    enable_x64: bool
    default_prng_impl: str
    default_matmul_precision: Any
    threefry_partitionable: bool
    compilation: str

    @classmethod
    def current(cls) -> "Settings":
        """Settings in force on this thread."""
        config: Any = jax.config
        return cls._make([*(getattr(config, f"jax_{name}") for name in cls._fields[:-1]), compilation_mode()])

    @contextlib.contextmanager
    def active(self) -> Iterator[None]:
        """Put them in force on this thread."""
        with contextlib.ExitStack() as stack:
            for name in self._fields[:-1]:
                stack.enter_context(getattr(jax, name)(getattr(self, name)))
            stack.enter_context(compilation(self.compilation))
            yield


class Failure(NamedTuple):
    """Error of a task's last attempt, and its traceback as text."""

    error: BaseException
    traceback: str

    @classmethod
    def of(cls, error: BaseException, trace: Any = None) -> "Failure":
        """Failure with the traceback `trace`, by default that of the error."""
        trace = error.__traceback__ if trace is None else trace
        return cls(error, "".join(traceback.format_exception(type(error), error, trace)))


def attempt(function: Callable, *arguments: Any, retries: int) -> Any:
    """function(*arguments), called again up to `retries` times if it raises; a `Failure` if all attempts raise."""
    for left in reversed(range(retries + 1)):
        try:
            return function(*arguments)
        except Exception as error:
            if not left:
                return Failure.of(error)
    raise AssertionError


def package_versions() -> dict[str, str]:
    """Versions of the packages that compute; results of other versions may differ."""
    return {name: metadata.version(name) for name in ("jaxdyn", "jax", "jaxlib")}


class Local:
    """Tasks in this process, `at_once` at a time: methods of an object that `send` makes; a context manager, as `Cluster` is."""

    workers = workers_per_host = 1

    def __init__(self, retries: int = 0, at_once: int = 1):
        self.retries, self.at_once = retries, at_once

    def __enter__(self) -> "Local":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def send(self, target: Callable[[], Any]) -> None:
        """Make the object whose methods tasks call."""
        self.target: Any = target()

    def call(self, method: str, item: Any) -> Any:
        """target.method(item). **Raises:** its error."""
        return getattr(self.target, method)(item)

    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Pairs of an item and target.method(item), or the `Failure` of its last attempt, in the order of the items."""
        if self.at_once == 1:
            yield from ((item, attempt(self.call, method, item, retries=self.retries)) for item in items)
            return
        settings = Settings.current()

        def task(item: Any) -> Any:
            with settings.active():
                return attempt(self.call, method, item, retries=self.retries)

        running: deque[tuple[Any, Future]] = deque()
        with ThreadPoolExecutor(self.at_once, thread_name_prefix="jaxdyn task") as pool:
            for item in items:
                running.append((item, pool.submit(task, item)))
                # As many as there are threads: results that wait for an earlier one are in memory.
                if len(running) == self.at_once:
                    first, future = running.popleft()
                    yield first, future.result()
            for item, future in running:
                yield item, future.result()


RESOURCE = "jaxdyn"  # of Dask: each worker has one, each task takes one, and one of the name of its plugin


class TargetPlugin(WorkerPlugin):
    """An object for each worker, also for those that join later, opened before the first task there.

    **Arguments:** `name` of the plugin; `packed`, a function without arguments by cloudpickle, which returns the object; `mark`,
    a file of the client with its text, which the worker has to see too, or None.

    A worker that does not fit (`setup` raises) gets no unit of the resource, hence no task.
    """

    def __init__(self, name: str, packed: bytes, mark: tuple[Path, str] | None):
        self.name, self.packed, self.mark = name, packed, mark
        self.settings, self.versions = Settings.current(), package_versions()
        self._target: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_target": None}

    async def setup(self, worker: Worker) -> None:
        """Check the worker and let it have tasks. **Raises:** ValueError that names the worker and the difference."""
        self.check(worker.address)
        self._address = worker.address
        self._lock = threading.Lock()
        self._start = asyncio.create_task(self._enable(worker))

    async def _enable(self, worker: Worker) -> None:
        # Tasks come when the object is open, which takes seconds of compilation. Without this, a worker that replaces a dead one
        # would be given the last tasks, and hold up a run that the others could have finished. So each object has a resource of
        # its own: that of all tasks is there from the first object on, or from the start.
        with contextlib.suppress(Exception):  # the first task raises it again, for the client
            await asyncio.get_running_loop().run_in_executor(worker.executors["default"], self._open)
        await worker.set_resources(**{RESOURCE: 1} | worker.state.total_resources | {self.name: 1})
        # The scheduler looks for workers of waiting tasks when a worker begins to run, not when it is given resources. Without
        # this, a task that waits because all workers have died would wait for ever.
        if worker.status == Status.running:
            worker.status = Status.paused
            worker.status = Status.running

    def check(self, address: str) -> None:
        """**Raises:** ValueError where versions differ, and where the file of the client does not exist."""
        for name, version in package_versions().items():
            if version != self.versions[name]:
                raise ValueError(
                    f"client: worker {address} has {name} {version}, and this process {self.versions[name]}; install the same "
                    "version on both"
                )
        if self.mark is None:
            return
        path, text = self.mark
        try:
            seen = path.read_text(encoding="utf-8")
        except OSError as error:
            seen = error
        if seen != text:
            raise ValueError(
                f"out is in {str(path.parent)!r}, which worker {address} does not see ({path.name}: "
                f"{seen if isinstance(seen, OSError) else 'another file of that name'}); name a place on a file system that the "
                "client and all workers share"
            )

    def call(self, method: str, item: Any) -> Any:
        """target.method(item) with the settings of the client."""
        with self.settings.active():
            return getattr(self._open(), method)(item)

    def _open(self) -> Any:
        with self._lock, self.settings.active():
            if self._target is None:
                try:
                    target = cloudpickle.loads(self.packed)
                except ModuleNotFoundError as error:
                    raise ModuleNotFoundError(
                        f"{error.name} is a module of the client that worker {self._address} does not have; send it with "
                        f"client.upload_file('{error.name}.py'), or put its functions into the script",
                        name=error.name,
                    ) from error
                self._target = target()
            return self._target


def call_target(name: str, method: str, item: Any) -> Any:
    """A task: target.method(item) of the plugin of this name."""
    plugin: Any = get_worker().plugins[name]
    return plugin.call(method, item)
