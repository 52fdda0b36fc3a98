"""Tasks in this process, and failures of tasks."""

import traceback
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from typing import Any, NamedTuple


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
    """Tasks one after another in this process: methods of an object that `send` makes; a context manager, as `Cluster` is."""

    workers = workers_per_host = 1

    def __init__(self, retries: int = 0):
        self.retries = retries

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

    # One after another: kernels use all cores of the process by themselves.
    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Pairs of an item and target.method(item), or the `Failure` of its last attempt, in the order of the items."""
        for item in items:
            yield item, attempt(self.call, method, item, retries=self.retries)
