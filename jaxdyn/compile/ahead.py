"""Machine code that is made before it is called: by a thread of its own, while Python traces on and XLA compiles.

LLVM lets other threads of Python run, and takes one program at a time. Whoever calls a kernel that has no code yet goes before
all that is made ahead.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator

_state = threading.Condition()
_waiting: deque[Callable] = deque()  # what is to be made ahead
_urgent = 0  # threads that wait for code that they call
_busy = False
_worker: threading.Thread | None = None


@contextlib.contextmanager
def turn() -> Iterator[None]:
    """While code is made, by one thread at a time."""
    global _urgent, _busy
    is_urgent, is_mine = threading.current_thread() is not _worker, False
    try:
        with _state:
            _urgent += is_urgent
            try:
                _state.wait_for(lambda: not _busy and (is_urgent or not _urgent))
                is_mine = _busy = True
            finally:
                _urgent -= is_urgent
        yield
    finally:
        if is_mine:
            with _state:
                _busy = False
                _state.notify_all()


def make_later(make: Callable) -> None:
    """Call `make()` in another thread, soon."""
    global _worker
    with _state:
        _waiting.append(make)
        if _worker is None:
            # Not a daemon: Python ends when LLVM has, and starts nothing more then.
            _worker = threading.Thread(target=_work, name="jaxdyn-compiler", daemon=False)
            _worker.start()


def _work() -> None:
    global _worker
    while True:
        with _state:
            if not _waiting or not threading.main_thread().is_alive():
                _waiting.clear()
                _worker = None
                return
            make = _waiting.popleft()
        with contextlib.suppress(Exception):  # whoever calls the kernel makes its code again, and is told
            make()
