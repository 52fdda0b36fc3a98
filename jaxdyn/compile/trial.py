"""A kernel through all rules of its primitive, against JAX: what an unknown version of JAX has to pass before the first one.

Rules are called by JAX in the midst of its transformations, where an error could no longer be made good.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import jax_adapter
from jaxdyn.compile.kernels import call_program
from jaxdyn.compile.primitive import target
from jaxdyn.compile.trace import program_of


def _sample(known, x, y):
    del known
    return x * jnp.sin(y), jnp.sum(x / (2 + y * y))


def _kernel(x, y):
    leaves, expanded = program_of(_sample, (), None, (x, y))
    program, structure = expanded
    return jax.tree.unflatten(structure, call_program(program, leaves))


def _transforms(function, x, y) -> list:
    def slope(x, y):
        return jax.grad(lambda x, y: jnp.sum(function(x, y)[0]) + function(x, y)[1], (0, 1))(x, y)

    # Values, a jvp, a batch with a shared argument and a batched gradient: every rule of the primitive is called once.
    batches = [jax.jit(jax.vmap(f, (0, None)))(x, y) for f in (function, slope)]
    return [jax.jit(function)(x[0], y), jax.jvp(function, (x[0], y), (y, y)), *batches]


def run_trial() -> None:
    """**Raises:** whatever goes wrong, and ArithmeticError where numbers differ."""
    if target is None:
        return
    # Before anything is traced: XLA may refuse the handler.
    target.register()
    x, y = jnp.arange(12.0).reshape(4, 3), jnp.arange(3.0)
    computed, wanted = (_transforms(f, x, y) for f in (_kernel, functools.partial(_sample, None)))
    for mine, theirs in zip(jax.tree.leaves(computed), jax.tree.leaves(wanted), strict=True):
        # Loose, as the trial looks for other rules, not for rounding, and may run in float32.
        if mine.shape != theirs.shape or not np.allclose(mine, theirs, 1e-4, 1e-4):
            raise ArithmeticError("a kernel gives other numbers than JAX")


jax_adapter.try_first(run_trial)
