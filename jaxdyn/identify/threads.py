"""One thread for linear algebra on small matrices.

OpenBLAS shares products and factorisations of a hundred rows among all processors, whose threads then wait for each other: on two
busy processors a search for terms took 61 s of their time instead of 4.
"""

import functools
import threading
from collections.abc import Callable
from typing import Any

from threadpoolctl import threadpool_limits

# The limit is one of the process. Of calls that overlap, in several threads, the first one sets it and the last one lifts it:
# each for itself would take the limit of another one for the user's.
_lock = threading.Lock()
_running = 0
_limit: Any = None


def on_one_thread(function: Callable) -> Callable:
    """The function, while which runs numpy's and scipy's linear algebra keeps to one thread."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        _enter()
        try:
            return function(*args, **kwargs)
        finally:
            _leave()

    return call


def _enter() -> None:
    global _running, _limit
    with _lock:
        if not _running:
            _limit = threadpool_limits(limits=1, user_api="blas")
        _running += 1


def _leave() -> None:
    global _running
    with _lock:
        _running -= 1
        if not _running:
            _limit.restore_original_limits()
