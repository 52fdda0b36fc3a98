"""The only module that knows what differs between versions of JAX."""

import logging
from typing import Any

import jax

logger = logging.getLogger("jaxdyn")


def scan_counts(params: dict) -> tuple[int, int]:
    """Number of constants and of carried values among the operands of a `scan`."""
    if "ft_in" in params:  # since 0.11: trees of the constants, the carry and the rows
        constants, carry, _ = params["ft_in"].unpack()
        return len(constants), len(carry)
    return params["num_consts"], params["num_carry"]


def known_options(options: dict[str, Any]) -> dict[str, Any]:
    """Those of the compiler options that the installed XLA accepts; each other one is logged."""
    known = {}
    for name, value in options.items():
        try:
            jax.jit(lambda: 0.0, compiler_options={name: value})()
        except jax.errors.JaxRuntimeError:
            logger.debug("jaxdyn: XLA has no compiler option %s, which is left out", name)
        else:
            known[name] = value
    return known
