"""Two ways to trace a program other than the usual one: by kernels alone, or without them (see `_one_call`)."""

import contextlib
import contextvars

_way = contextvars.ContextVar("way", default="usual")


@contextlib.contextmanager
def _going(way: str):
    token = _way.set(way)
    try:
        yield
    finally:
        _way.reset(token)


def straight():
    """While tracing inside: where kernels do not serve, and something else would have to be computed, numbers are NaN."""
    return _going("straight")


def without_kernels():
    """While tracing inside: there are no kernels, and rows are taken for dependent, as they may be where kernels do not serve."""
    return _going("without kernels")


def way() -> str:
    """Which way is traced: "usual", "straight" or "without kernels"."""
    return _way.get()


def is_straight() -> bool:
    """Whether `straight` is in force."""
    return way() == "straight"


def is_careful() -> bool:
    """Whether `without_kernels` is in force."""
    return way() == "without kernels"
