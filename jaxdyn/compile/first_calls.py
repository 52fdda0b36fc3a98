"""First calls, for which somebody waits: the time of each phase, what is made meanwhile, and what is put off until they are over.

Phases that follow each other within a second belong to one first call. Native code that was compiled quickly is optimised by one
thread of the process, after the first call. Python's collector of cycles stays on: it belongs to the user.
"""

import atexit
import contextlib
import heapq
import itertools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax

logger = logging.getLogger("jaxdyn")
PHASES = "tracing", "expansion", "XLA", "LLVM"
REPORTED_SECONDS = 2.0  # of a first call
_QUIET_SECONDS, _SHORT_SECONDS = 1.0, 0.2


class _FirstCall:
    """The first call at hand, or the last one."""

    def __init__(self):
        self.changed = threading.Condition(threading.RLock())
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self.begin = self.end = self.added = 0.0  # of the phases, and when the last task came
        self.active = 0  # phases in all threads
        self.inner = threading.local()  # seconds of phases within the phase at hand, in this thread
        self.tasks: list[tuple[bool, int, int, Callable, Callable]] = []  # a heap
        self.thread: threading.Thread | None = None
        self.order = itertools.count()
        self.is_hurried = self.is_ending = False

    @contextlib.contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Context of one of `PHASES`; phases may contain others."""
        start, within = time.perf_counter(), getattr(self.inner, "seconds", None)
        # A thread that works beside the one for which somebody waits counts for nothing.
        is_beside = threading.current_thread().name.startswith("jaxdyn compiler")
        with self.changed:
            if not self.active and start - self.end > _QUIET_SECONDS:
                self.report()
                self.begin = start
            self.active += 1
        self.inner.seconds = 0.0
        try:
            yield
        finally:
            now = time.perf_counter()
            with self.changed:
                self.active -= 1
                self.end = now
                if not is_beside:
                    self.seconds[name] += now - start - self.inner.seconds
                if now - self.begin > REPORTED_SECONDS:
                    self._start()
            self.inner.seconds = None if within is None else within + now - start

    def add_compilation(self, event: str, duration_secs: float, **_) -> None:
        """Count the time that XLA has compiled, as JAX reports it."""
        if event != "/jax/core/compile/backend_compile_duration":
            return
        now = time.perf_counter()
        with self.changed:
            if not self.active and now - duration_secs - self.end > _QUIET_SECONDS:
                return  # a program without kernels
            self.end = now
            self.seconds["XLA"] += duration_secs
        if getattr(self.inner, "seconds", None) is not None:
            self.inner.seconds += duration_secs

    def report(self) -> None:
        """Log how long the phases of a long first call took, once."""
        with self.changed:
            total, seconds = self.end - self.begin, self.seconds
            self.seconds = dict.fromkeys(PHASES, 0.0)
        if total > REPORTED_SECONDS and any(seconds.values()):
            parts = {**seconds, "other": max(0.0, total - sum(seconds.values()))}
            shares = ", ".join(f"{name} {100 * x / total:.0f} %" for name, x in parts.items())
            logger.info("jaxdyn: a first call took %.1f s before it ran: %s", total, shares)

    # --- after the first call ---

    def optimise_later(self, improve: Callable, keep: Callable, size: int, is_new: bool) -> None:
        """Call improve() in the thread that optimises code, the short ones first, or keep() where the process ends before.

        Not `is_new`: code that an earlier process has left quick, as it ended soon. It is optimised before all other, so that
        scripts which end soon do not run it for ever.
        """
        with self.changed:
            heapq.heappush(self.tasks, (is_new, size, next(self.order), improve, keep))
            self.added = time.perf_counter()
            self._start()
            self.changed.notify_all()

    def _start(self) -> None:
        if self.thread is None:
            self.thread = threading.Thread(target=self._run, name="jaxdyn optimiser", daemon=True)
            self.thread.start()

    def _wait(self) -> float:
        """Seconds until the first call is over, as far as that is known."""
        if self.is_hurried or self.is_ending:
            return 0.0
        # What an earlier process left quick has waited long enough.
        quiet = _SHORT_SECONDS if self.tasks and not self.tasks[0][0] else _QUIET_SECONDS
        return quiet if self.active else max(self.end, self.added) + quiet - time.perf_counter()

    def _run(self) -> None:
        while True:
            with self.changed:
                while (left := self._wait()) > 0:
                    self.changed.wait(left)
                self.report()
                if self.is_ending or not self.tasks:
                    self.thread = None
                    self.changed.notify_all()
                    return
                *_, improve, _ = heapq.heappop(self.tasks)
            # What cannot be optimised keeps its quick code.
            with contextlib.suppress(Exception):
                improve()

    def finish(self) -> None:
        """Wait until all code is optimised."""
        with self.changed:
            self.is_hurried = True
            self.changed.notify_all()
            self.changed.wait_for(lambda: self.thread is None)
            self.is_hurried = False

    def stop(self) -> None:
        """Stop after the code at hand, and keep the rest: LLVM must not be at work while the process takes itself apart."""
        self.is_ending = True
        self.finish()
        for *_, keep in self.tasks:
            keep()


_first_call = _FirstCall()
atexit.register(_first_call.stop)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        after_in_child=_first_call.__init__
    )  # which has no other threads, and may have found the lock taken
jax.monitoring.register_event_duration_secs_listener(_first_call.add_compilation)
phase, optimise_later, wait_for_code = _first_call.phase, _first_call.optimise_later, _first_call.finish


def make_later(make: Callable) -> None:
    """Call `make()` in a thread of its own: LLVM releases Python's lock while it compiles.

    An error here is dropped: the first call of the kernel compiles it once more, and raises the error there.
    """
    alone = ThreadPoolExecutor(1, thread_name_prefix="jaxdyn compiler")
    alone.submit(make)
    alone.shutdown(wait=False)
