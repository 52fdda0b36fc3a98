"""The part of a Dask worker: a plugin that brings what tasks call, and the function of a task."""

import threading
from pathlib import Path
from typing import Any

import cloudpickle
from distributed import Worker, WorkerPlugin, get_worker
from distributed.core import Status

from jaxdyn.tasks.local import package_versions
from jaxdyn.tasks.settings import Settings

RESOURCE = "jaxdyn"  # of Dask: each worker has one, each task takes one


class TargetPlugin(WorkerPlugin):
    """Sends an object to each worker, also to those that join later, and opens it at the first task there.

    **Arguments:** `packed`, a function without arguments by cloudpickle, which returns the object; `mark`, a file of the client
    with its text, which the worker has to see too, or None.

    A worker that does not fit (`setup` raises) gets no unit of the resource, hence no task.
    """

    def __init__(self, packed: bytes, mark: tuple[Path, str] | None):
        self.packed, self.mark = packed, mark
        self.settings, self.versions = Settings.current(), package_versions()
        self._target: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_target": None}

    async def setup(self, worker: Worker) -> None:
        """Check the worker and let it have tasks. **Raises:** ValueError that names the worker and what differs."""
        self.check(worker.address)
        self._address = worker.address
        self._lock = threading.Lock()
        if RESOURCE in worker.state.total_resources:
            return
        await worker.set_resources(**{RESOURCE: 1})
        # The scheduler looks for workers of waiting tasks when a worker begins to run, not when it is given resources. Without
        # this a task that waits because all workers have died would wait for ever.
        if worker.status == Status.running:
            worker.status = Status.paused
            worker.status = Status.running

    def check(self, address: str) -> None:
        """**Raises:** ValueError where versions differ, and where the file of the client is not there."""
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
            with self._lock:
                if self._target is None:
                    self._target = self._open()
            return getattr(self._target, method)(item)

    def _open(self) -> Any:
        try:
            target = cloudpickle.loads(self.packed)
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"{error.name} is a module of the client that worker {self._address} does not have; send it with "
                f"client.upload_file('{error.name}.py'), or put its functions into the script",
                name=error.name,
            ) from error
        return target()


def call_target(name: str, method: str, item: Any) -> Any:
    """A task: target.method(item) of the plugin of this name."""
    plugin: Any = get_worker().plugins[name]
    return plugin.call(method, item)
