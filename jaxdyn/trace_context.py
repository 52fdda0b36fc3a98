"""The context of JAX that holds what tracing depends on (`compile.mode` names it).

JAX traces all functions again when a context is new. This one is made when jaxdyn is imported, not at the first use of a
subpackage, so that functions which a user has compiled in between stay compiled.
"""

from typing import NamedTuple

import jax
import jax.extend  # which makes contexts too, and is imported by equinox


class TraceModes(NamedTuple):
    """What tracing depends on.

    - `compilation`: the mode that the user chose; None where the environment decides, which is read at each use, so that a test
      can set it.
    - `expanding`: whether a function is traced to become a program of numbers: "straight", "branches", or "" if it is not.
    - `careful`: whether it computes the samples that a kernel has marked as not valid (see `compile.careful`).
    - `in_rows`: whether an axis that `vmap` adds to a kernel is one of rows (see `compile.batch.map_rows`).
    - `standalone`: whether it is for code that runs without JAX.
    - `by_rules`: whether functions with rules for their derivatives have the values of these rules.
    """

    compilation: str | None = None
    expanding: str = ""
    careful: str = ""
    in_rows: bool = False
    standalone: bool = False
    by_rules: bool = False


modes = jax.make_user_context(TraceModes())
