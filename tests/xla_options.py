"""Options with which XLA compiles fast code that runs slowly, for tests that compile much and run little.

LLVM's optimiser and XLA's newer fusion emitters are most of a compile; neither changes what is computed. Options that the
installed XLA does not have are left out: a compiler option would be refused, and an unknown flag ends the process.
"""

from jaxdyn.compile.jax_adapter import select_options

QUICK = select_options({"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False})


def flags(**more) -> str:
    """The same as XLA_FLAGS, for processes that a test starts."""
    return " ".join(f"--{name}={str(value).lower()}" for name, value in (QUICK | select_options(more)).items())
