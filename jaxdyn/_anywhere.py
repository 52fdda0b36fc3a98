"""`anywhere`: a question to the whole batch, so that what few samples need is computed only when one of them does.

Under `jax.vmap` a `lax.cond` whose predicate differs between samples computes both branches. A predicate that has gone
through `anywhere` is one for all samples, however many `vmap`s enclose it, and the branch stays a branch.
"""

import jax.core
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

_anywhere_p = Primitive("anywhere")
_anywhere_p.def_impl(lambda flag: flag)
_anywhere_p.def_abstract_eval(lambda flag: ShapedArray((), flag.dtype))
mlir.register_lowering(_anywhere_p, lambda ctx, flag: [flag])


def _over_samples(arrays, axes):
    return _anywhere_p.bind(jnp.any(arrays[0], axis=axes[0])), batching.not_mapped


batching.primitive_batchers[_anywhere_p] = _over_samples


def anywhere(flag):
    """Whether a flag () is set for this sample or for any other one of the batch."""
    return _anywhere_p.bind(flag) if isinstance(flag, jax.core.Tracer) else flag
