"""How functions are compiled: by native kernels where they serve, or, under `compilation("plain")`, by JAX alone."""

import contextlib
import contextvars
import logging
import os
from collections.abc import Iterator

from jaxdyn.compile import jax_adapter

logger = logging.getLogger("jaxdyn")
MODES = ("auto", "general", "plain")
OPTIONS = ("", "usual", "least")
# LLVM takes some 50 microseconds an operation: three seconds.
MAX_OPERATIONS = 60_000

_mode: contextvars.ContextVar[str | None] = contextvars.ContextVar("jaxdyn_compilation", default=None)
_expanding: contextvars.ContextVar[bool] = contextvars.ContextVar("jaxdyn_expanding", default=False)
_called_at_once: contextvars.ContextVar[bool] = contextvars.ContextVar("jaxdyn_called_at_once", default=False)
_said: set[str] = set()


def current() -> str:
    """The mode in force. **Raises:** ValueError where the environment asks for one that does not exist."""
    mode = _mode.get() or _checked(os.environ.get("JAXDYN_COMPILATION", "auto"), "the environment's JAXDYN_COMPILATION")
    return mode if mode == "plain" or jax_adapter.reason_against_kernels() is None else "plain"


def _checked(mode, what: str) -> str:
    if mode not in MODES:
        raise ValueError(f"{what} is {mode!r}; choose from {', '.join(map(repr, MODES))}")
    return mode


@contextlib.contextmanager
def compilation(mode: str) -> Iterator[None]:
    """While functions are traced inside: how they become machine code.

    **Arguments:** `mode`:

    - "auto": native kernels on a CPU where a function is a program of single numbers, operations of JAX elsewhere. `simulate` and
      `assemble`, called outside of `jax.jit`, compile the numbers of the first scene of its shape in, whose zeros and ones
      then cost nothing; all other scenes of that shape share a second program that takes their numbers as inputs.
    - "general": the same with that second program for all of them.
    - "plain": operations of JAX everywhere, which compile and run slower and serve as a witness.

    The mode counts when a function is traced: what `jax.jit` has compiled stays as it is. Without this context the environment
    variable JAXDYN_COMPILATION decides, and without that, "auto".

    **Raises:** ValueError for another mode.

    ```python
    with jd.compilation("plain"):
        a = jd.forward_dynamics(model, q, v, tau)
    ```
    """
    token = _mode.set(_checked(mode, "compilation: mode"))
    try:
        yield
    finally:
        _mode.reset(token)


def is_expanding() -> bool:
    """Whether a function is traced to become a program of numbers: what it calls is traced with it."""
    return _expanding.get()


@contextlib.contextmanager
def expanding():
    """While a function is traced to become a program of numbers."""
    token = _expanding.set(True)
    try:
        yield
    finally:
        _expanding.reset(token)


def is_called_at_once() -> bool:
    """Whether what is traced is called as soon as it is compiled."""
    return _called_at_once.get()


@contextlib.contextmanager
def called_at_once(whether: bool):
    """While something is traced that is called as soon as it is compiled; or hardly ever, as what singular samples need."""
    token = _called_at_once.set(whether)
    try:
        yield
    finally:
        _called_at_once.reset(token)


def wants_usual_options() -> bool:
    """Whether the environment asks for compilation without what shortens a first call."""
    return _options() == "usual"


def wants_least_optimisation() -> bool:
    """Whether the environment asks for code that compiles fast and runs slowly, as most tests do."""
    return _options() == "least"


def _options() -> str:
    options = os.environ.get("JAXDYN_COMPILATION_OPTIONS", "")
    if options not in OPTIONS:
        shown = ", ".join(map(repr, OPTIONS[1:]))
        raise ValueError(
            f"the environment's JAXDYN_COMPILATION_OPTIONS is {options!r}; choose from {shown}, or leave it out"
        )
    return options


def say_once(message: str) -> None:
    """Log a warning that has not been logged before in this process."""
    if message not in _said:
        _said.add(message)
        logger.warning("jaxdyn: %s", message)
