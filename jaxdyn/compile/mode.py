"""Modes of compilation: native kernels, or, under `compilation("plain")`, JAX alone.

What tracing depends on is a user context of JAX (`trace_context`). Contexts are part of the keys of JAX's caches, so that a
function under `jax.jit` is traced once for each of its values: results do not depend on how the function was traced before.
"""

import contextlib
import logging
import math
import os
from collections.abc import Callable, Iterator

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


def most_operations(arrays) -> int:
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
