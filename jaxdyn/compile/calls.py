"""Calls from outside of any trace: functions compiled once per shape, while a thread makes the code of their kernels."""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.compile.known import is_concrete, is_tracing


def entry_point(function: Callable) -> Callable:
    """Compile a function that users call once per shape, its arrays being operands; a decorator.

    Within a trace it is the function as it stands: a nested `jit` would hide the values of known arrays.
    """

    usual = eqx.filter_jit(function)
    quick = functools.cache(lambda: _jit(function, compiler_options=quick_options()))

    @functools.wraps(function)
    def call(*args):
        if is_tracing():
            return function(*args)
        # JAX refuses compiler options under a transformation such as `grad`, whose arguments are traced.
        if not (_is_glue(jax.default_backend()) and is_concrete(args)):
            return usual(*args)
        with worker(not mode.wants_usual_options()):
            return quick()(*args)

    return call


_jit: Any = eqx.filter_jit

# What XLA compiles is the glue between kernels. Its emitters of fusions, each a module of its own, take most of the time to
# compile it and bring nothing at run time: `python -m benchmarks.first_calls`, and again with
# JAXDYN_COMPILATION_OPTIONS=usual in the environment.
_QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_LEAST = _QUICK | {"xla_backend_optimization_level": 0}


@functools.cache
def quick_options() -> dict[str, Any] | None:
    """Options with which XLA compiles glue quickly.

    None where the environment asks for the usual ones.
    """
    if mode.wants_usual_options():
        return None
    return select_options(_LEAST if mode.wants_least_optimisation() else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"


# --- native code in advance, while Python traces on and XLA compiles ---
#
# LLVM releases Python's lock while it compiles. The thread belongs to one call from outside, which waits for it before it
# returns, so that no thread outlives the call. Under the user's own `jax.jit` there is no such call: a thread ends with its task
# there, for which Python waits at the end of the process.

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


def has_worker() -> bool:
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
