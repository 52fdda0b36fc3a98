"""Which versions of jax the tests have run with."""

import warnings

import jax

TESTED = ((0, 10), (0, 12))  # the first and the last minor version


def warn_of_version(version: tuple[int, ...] | None = None) -> None:
    """Warn where jax is newer than the tests know; older ones the package's requirements refuse."""
    version_parts = jax.__version_info__ if version is None else version
    if tuple(version_parts[:2]) > TESTED[1]:
        have, last = (".".join(map(str, part)) for part in (version_parts, TESTED[1]))
        warnings.warn(
            f"jaxdyn has been tested with jax up to {last}, this is jax {have}: kernels may not compile. If anything fails, "
            f"pip install 'jax<{TESTED[1][0]}.{TESTED[1][1] + 1}', or trace under jaxdyn.compilation('plain')",
            UserWarning,
            stacklevel=3,
        )
