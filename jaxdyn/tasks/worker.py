"""The plugin of a Dask worker, which holds the object whose methods tasks call. Dask and cloudpickle are imported here."""

import asyncio
import contextlib
import threading
from pathlib import Path
from typing import Any

import cloudpickle
from distributed import Worker, WorkerPlugin, get_worker
from distributed.core import Status

from jaxdyn.tasks.local import Settings, package_versions

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
