"""Python's collector of cyclic garbage, which rests while programs are traced and written.

A program has numbers by the ten thousand, of which nearly all stay until it is done: the collector would look at every object of
the process again and again, and free nothing.
"""

import functools
import gc
import threading
from collections.abc import Callable

from jaxdyn.compile.mode import wants_usual_options

_lock = threading.Lock()
_running = 0  # functions, of all threads: the first one stops the collector, the last one starts it again
_was_on = False


def uncollected(function: Callable) -> Callable:
    """The function, while which runs nothing is collected."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        if wants_usual_options():
            return function(*args, **kwargs)
        _stop()
        try:
            return function(*args, **kwargs)
        finally:
            _start()

    return call


def _stop() -> None:
    global _running, _was_on
    with _lock:
        if not _running:
            _was_on = gc.isenabled()
            gc.disable()
        _running += 1


def _start() -> None:
    global _running
    with _lock:
        _running -= 1
        if not _running and _was_on:
            gc.enable()
