"""Modes of compilation: native kernels, or, under `compilation("plain")`, JAX alone. First calls, and what is done after them.

What tracing depends on is a user context of JAX (`trace_context`). Contexts are part of the keys of JAX's caches, so that a
function under `jax.jit` is traced once for each of its values: results do not depend on how the function was traced before.
"""

import atexit
import contextlib
import heapq
import itertools
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from jaxdyn.compile import jax_adapter
from jaxdyn.trace_context import modes

logger = logging.getLogger("jaxdyn")
MODES = ("auto", "native", "plain")
OPTIONS = ("", "usual", "least")
# Operations of a program: so many, or so many for each entry of its arguments. A mechanism whose cost grows with its size is a
# program, however large it is (see `listing`): events of twelve contacts compile in half a minute, and by XLA in six. Products of
# matrices of hundreds of rows are none.
MAX_OPERATIONS, MAX_OPERATIONS_PER_ENTRY = 200_000, 500

_said: set[str] = set()


def _changed(**change):
    """Context in which some of the modes are others."""
    return modes(modes.value._replace(**change))


def current() -> str:
    """The mode in force. **Raises:** ValueError where the environment asks for one that does not exist."""
    # On a JAX that failed the trial "auto" is "plain" for the whole process.
    asked = modes.value.compilation or _check_mode(
        os.environ.get("JAXDYN_COMPILATION", "auto"), "the environment's JAXDYN_COMPILATION"
    )
    return asked if asked == "plain" or jax_adapter.reason_against_kernels() is None else "plain"


def _check_mode(mode, what: str) -> str:
    if mode not in MODES:
        raise ValueError(f"{what} is {mode!r}; choose from {', '.join(map(repr, MODES))}")
    return mode


@contextlib.contextmanager
def compilation(mode: str) -> Iterator[None]:
    """Choose how functions that are traced inside are compiled.

    **Arguments:**

    - `mode`: "auto", native kernels on a CPU where a function is a program of single numbers, operations of JAX elsewhere;
      "native", native kernels on NVIDIA's GPUs too, which have been tested without a GPU only; or
      "plain", operations of JAX everywhere, which compile and run slower: a reference for tests.

    The mode counts when a function is traced, and `jax.jit` traces a function once in each mode. Without this context the
    environment variable JAXDYN_COMPILATION decides, and without that, "auto".

    **Raises:** ValueError for another mode.

    ```python
    with jd.compilation("plain"):
        a = jd.forward_dynamics(model, q, v, tau)
    ```
    """
    with _changed(compilation=_check_mode(mode, "compilation: mode")):
        yield


def max_operations(arrays) -> int:
    """Operations beyond which a function of these arrays is no program."""
    return max(MAX_OPERATIONS, MAX_OPERATIONS_PER_ENTRY * sum(math.prod(x.shape) for x in arrays))


def is_expanding() -> bool:
    """Decide whether a function is being traced to become a program, so that kernels within it are inlined."""
    return bool(modes.value.expanding)


def has_branches() -> bool:
    """Decide whether a function is being traced to become a program that may take branches (see `expand`)."""
    return modes.value.expanding == "branches"


def expanding(branches: bool = False):
    """Context in which a function is traced to become a program of numbers."""
    return _changed(expanding="branches" if branches else "straight")


def is_standalone() -> bool:
    """Decide whether a function is traced for code that runs without JAX."""
    return modes.value.standalone


def standalone():
    """Context in which a function is traced for code that runs without JAX, where no fallback of JAX computes a sample."""
    return _changed(standalone=True)


def is_careful() -> bool:
    """Decide whether a function is traced for the samples that another program marks as not valid: it marks none itself."""
    return bool(modes.value.careful)


def is_careful_within() -> bool:
    """Decide whether kernels within a careful function are their fallbacks: they have failed for the sample, or may fail."""
    return modes.value.careful == "within"


def careful(which: str = "within"):
    """Context in which a function is traced for the samples that another program marks as not valid.

    `which`: "within"; "own", where kernels within the function compute their own flagged samples; "" for none.
    """
    return _changed(careful=which)


def has_rows() -> bool:
    """Decide whether an axis that `vmap` adds to a kernel is one of rows (see `batch.map_rows`)."""
    return modes.value.in_rows


def in_rows(is_wanted: bool):
    """Context in which an axis that `vmap` adds to a kernel is one of rows."""
    return _changed(in_rows=is_wanted)


def has_values_of_rules() -> bool:
    """Decide whether a function with a rule for its derivative is traced for the rule's own values (see `rules.implicit`)."""
    return modes.value.by_rules


def values_of_rules(is_wanted: bool = True):
    """Context in which functions with rules for their derivatives have the values of these rules."""
    return _changed(by_rules=is_wanted)


def state() -> tuple:
    """All modes that the trace of a function depends on."""
    return current(), *modes.value[1:]


def state_of_programs() -> tuple:
    """The modes that the program of a function depends on, wherever the function is called."""
    return modes.value.careful, modes.value.standalone, modes.value.by_rules


def remember() -> Callable[[], contextlib.AbstractContextManager]:
    """The modes in force, as a context in which another thread, or a later call, finds them again."""
    has_x64 = jax.dtypes.canonicalize_dtype(np.float64) == np.float64
    value = modes.value

    @contextlib.contextmanager
    def enter() -> Iterator[None]:
        with jax.enable_x64(has_x64), modes(value):
            yield

    return enter


def options() -> str:
    """The environment's wish: XLA's "usual" options instead of those that shorten a first call, or code that compiles fast
    and runs slowly ("least"), as in most tests."""
    options = os.environ.get("JAXDYN_COMPILATION_OPTIONS", "")
    if options not in OPTIONS:
        shown = ", ".join(map(repr, OPTIONS[1:]))
        raise ValueError(
            f"the environment's JAXDYN_COMPILATION_OPTIONS is {options!r}; choose from {shown}, or leave it out"
        )
    return options


def say_once(message: str, subject: str = "") -> None:
    """Log a warning that has not been logged before in this process; `subject`: what it is about."""
    _said.add(subject)
    if message not in _said:
        _said.add(message)
        logger.warning("jaxdyn: %s", message)


# --- messages on functions that have no kernel: whose they are, and what to write instead ---

# By the first words of a reason (see `NotNumbers`).
_REMEDIES = {
    "sort": "take jnp.minimum, jnp.maximum or jnp.argmax, or sort outside of the function",
    "svd": "decompose a constant matrix once, outside of the function",
    "eigh": "decompose a constant matrix once, outside of the function",
    "qr": "decompose a constant matrix once, outside of the function",
    "a cond": "choose among two results by jnp.where",
    "an array of key": "draw random numbers outside of the function, and pass them in",
    "division of integers": "divide floating-point numbers and round them down",
    "gather": "interpolate in a table of at most 256 entries",
    "dynamic_slice": "interpolate in a table of at most 256 entries",
    "scatter": "write into arrays of at most 256 entries, or at places that are known while tracing",
}
_USUAL = "write it by arithmetic, products of matrices, jnp.where, and indices that are known while tracing"


def remedy_of(reason: str) -> str:
    """Remedy for a part that has no kernel."""
    return next((text for words, text in _REMEDIES.items() if reason.startswith(words)), _USUAL)


def say_without_kernel(name: str, reason: str) -> None:
    """Log once that a function runs on JAX's operations: the user's function at fault and the remedy, if it is not ours."""
    cause, mark, place = reason.partition(", in ")
    if not mark:
        # A derivative is traced without the places of the function that it belongs to.
        if cause not in _said:
            say_once(f"{name} runs on JAX's own operations: {reason}")
        return
    # By the user's function, and not by ours that call it, of which there are several.
    say_once(
        f"{place}: {cause} has no kernel, so what calls this function runs on JAX's own operations, several times slower; "
        f"{remedy_of(cause)}",
        subject=cause,
    )


# --- first calls, for which somebody waits: the time of each phase, and what is put off until they are over ---
#
# Phases that follow each other within a second belong to one first call. Native code that was compiled quickly is optimised by
# one thread of the process, after the first call. Python's collector of cycles stays on: it belongs to the user.

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
    # The child has no other threads, and may have found the lock taken.
    os.register_at_fork(after_in_child=_first_call.__init__)
jax.monitoring.register_event_duration_secs_listener(_first_call.add_compilation)
phase, optimise_later, wait_for_code = _first_call.phase, _first_call.optimise_later, _first_call.finish


def make_later(make: Callable) -> None:
    """Call `make()` in a thread of its own: LLVM releases Python's lock while it compiles.

    An error here is dropped: the first call of the kernel compiles it once more, and raises the error there.
    """
    alone = ThreadPoolExecutor(1, thread_name_prefix="jaxdyn compiler")
    alone.submit(make)
    alone.shutdown(wait=False)
