"""Tasks in this process, and what a task that fails leaves."""

import traceback
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from typing import Any, NamedTuple


class Failure(NamedTuple):
    """A task that raised in its last attempt too: the error, and its traceback as text."""

    error: BaseException
    traceback: str

    @classmethod
    def of(cls, error: BaseException, trace: Any = None) -> "Failure":
        """With the traceback `trace`, by default that of the error."""
        trace = error.__traceback__ if trace is None else trace
        return cls(error, "".join(traceback.format_exception(type(error), error, trace)))


def attempt(function: Callable, *arguments: Any, retries: int) -> Any:
    """function(*arguments), called again up to `retries` times where it raises; a `Failure` where all attempts do."""
    for left in reversed(range(retries + 1)):
        try:
            return function(*arguments)
        except Exception as error:
            if not left:
                return Failure.of(error)
    raise AssertionError


def package_versions() -> dict[str, str]:
    """Versions of what computes; results of others may differ."""
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
        """Have the object whose methods tasks are."""
        self.target: Any = target()

    def call(self, method: str, item: Any) -> Any:
        """target.method(item). **Raises:** what it raises."""
        return getattr(self.target, method)(item)

    def map(self, method: str, items: Iterable[Any]) -> Iterator[tuple[Any, Any]]:
        """Each item with target.method(item), or with the `Failure` of its last attempt, in the order of the items."""
        for item in items:
            yield item, attempt(self.call, method, item, retries=self.retries)
