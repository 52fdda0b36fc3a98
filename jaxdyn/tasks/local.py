"""Tasks in this process: their failures, and the settings of threads that compute them."""

import contextlib
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import metadata
from typing import Any, NamedTuple

import jax

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
