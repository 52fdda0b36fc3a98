"""Native code compiled in advance: by a thread, while Python traces on and XLA compiles.

LLVM releases Python's lock while it compiles. The thread belongs to one call from outside, which waits for it before it returns,
so that no thread outlives the call. Under the user's own `jax.jit` there is no such call: a thread ends with its task there, for
which Python waits at the end of the process.
"""

import contextlib
import contextvars
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

# A context variable, not a global: two threads of the user may trace at the same time.
_worker: contextvars.ContextVar["_Worker | None"] = contextvars.ContextVar("jaxdyn_worker", default=None)


class _Worker:
    """A thread that starts when there is something to do."""

    def __init__(self):
        self.executor: ThreadPoolExecutor | None = None

    def submit(self, make: Callable) -> None:
        if self.executor is None:
            self.executor = ThreadPoolExecutor(1, thread_name_prefix="jaxdyn compiler")
        self.executor.submit(make)

    def end(self) -> None:
        if self.executor is not None:
            # Tasks that have not begun are dropped: a kernel without code is compiled by its first call.
            self.executor.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def worker(is_wanted: bool = True) -> Iterator[None]:
    """Context in which kernels are called as soon as they are compiled: a thread makes their code, and ends with the context.

    Not `is_wanted`: what is traced is hardly ever called, as what singular samples need.
    """
    mine = _Worker() if is_wanted else None
    token = _worker.set(mine)
    try:
        yield
    finally:
        _worker.reset(token)
        if mine is not None:
            mine.end()


def is_active() -> bool:
    """Decide whether kernels that are traced now are called as soon as XLA has compiled the program."""
    return _worker.get() is not None


def make_later(make: Callable) -> None:
    """Call `make()` in the thread of the context, or in one of its own.

    An error here is dropped: the first call of the kernel compiles it once more, and raises the error there.
    """
    current = _worker.get()
    if current is not None:
        current.submit(make)
        return
    alone = ThreadPoolExecutor(1, thread_name_prefix="jaxdyn compiler")
    alone.submit(make)
    alone.shutdown(wait=False)
