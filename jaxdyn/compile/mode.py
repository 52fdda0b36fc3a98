"""How functions are compiled: by native kernels where they serve, or, under `compilation("plain")`, by JAX alone.

What tracing depends on are user contexts of JAX. They are part of the keys of its caches, so that a function under `jax.jit`
is traced once in each of them: what a call gives does not depend on how the function was traced before.
"""

import contextlib
import logging
import os
from collections.abc import Iterator

import jax

from jaxdyn.compile import jax_adapter

logger = logging.getLogger("jaxdyn")
MODES = ("auto", "plain")
OPTIONS = ("", "usual", "least")
# LLVM takes some 50 microseconds an operation: three seconds.
MAX_OPERATIONS = 60_000

_mode = jax.make_user_context(None)
_expanding = jax.make_user_context(False)
_rank_safe = jax.make_user_context(False)
_in_rows = jax.make_user_context(False)
_standalone = jax.make_user_context(False)
_said: set[str] = set()


def current() -> str:
    """The mode in force. **Raises:** ValueError where the environment asks for one that does not exist."""
    asked = _mode.value or _checked(
        os.environ.get("JAXDYN_COMPILATION", "auto"), "the environment's JAXDYN_COMPILATION"
    )
    return asked if asked == "plain" or jax_adapter.reason_against_kernels() is None else "plain"


def _checked(mode, what: str) -> str:
    if mode not in MODES:
        raise ValueError(f"{what} is {mode!r}; choose from {', '.join(map(repr, MODES))}")
    return mode


@contextlib.contextmanager
def compilation(mode: str) -> Iterator[None]:
    """While functions are traced inside: how they become machine code.

    **Arguments:** `mode`:

    - "auto": native kernels on a CPU where a function is a program of single numbers, operations of JAX elsewhere.
    - "plain": operations of JAX everywhere, which compile and run slower and serve as a witness.

    The mode counts when a function is traced, and `jax.jit` traces a function once in each mode. Without this context the
    environment variable JAXDYN_COMPILATION decides, and without that, "auto".

    **Raises:** ValueError for another mode.

    ```python
    with jd.compilation("plain"):
        a = jd.forward_dynamics(model, q, v, tau)
    ```
    """
    with _mode(_checked(mode, "compilation: mode")):
        yield


def is_expanding() -> bool:
    """Whether a function is traced to become a program of numbers: what it calls is traced with it."""
    return _expanding.value


def expanding():
    """Context in which a function is traced to become a program of numbers."""
    return _expanding(True)


def is_rank_safe() -> bool:
    """Whether what is traced is computed again for samples that need care: the fast way has failed them already."""
    return _rank_safe.value


def rank_safe(is_safe: bool = True):
    """Context in which a function is traced for samples that need care."""
    return _rank_safe(is_safe)


def is_standalone() -> bool:
    """Whether a function is traced for code that runs without JAX."""
    return _standalone.value


def standalone():
    """Context in which a function is traced for code that runs without JAX, which has no other path for a sample."""
    return _standalone(True)


def is_row() -> bool:
    """Whether an axis that is added to a kernel now is one of rows (see `rows`)."""
    return _in_rows.value


def in_rows():
    """Context in which an axis that is added to a kernel is one of rows."""
    return _in_rows(True)


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
