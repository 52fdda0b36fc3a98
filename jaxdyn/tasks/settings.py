"""Settings of JAX that decide which bits a function returns, to be in force on another thread or process."""

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax

from jaxdyn.compile import compilation, compilation_mode


class Settings(NamedTuple):
    """Settings of JAX and the mode of compilation; each belongs to a thread, so that none of the process is changed."""

    enable_x64: bool
    default_prng_impl: str
    default_matmul_precision: Any
    threefry_partitionable: bool
    compilation: str

    @classmethod
    def current(cls) -> "Settings":
        """Those in force on this thread."""
        config: Any = jax.config
        return cls._make([*(getattr(config, f"jax_{name}") for name in cls._fields[:-1]), compilation_mode()])

    @contextlib.contextmanager
    def active(self) -> Iterator[None]:
        """Put them in force on this thread."""
        with contextlib.ExitStack() as stack:
            for name in self._fields[:-1]:
                stack.enter_context(getattr(jax, name)(getattr(self, name)))
            stack.enter_context(compilation(self.compilation))
            yield
