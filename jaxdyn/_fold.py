"""One basic block of machine code for single numbers: the function that a `reduce` folds with (see `_one_kernel`)."""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Literal

_NOTHING, _ARGUMENTS, _RESULT = (np.int8(i) for i in range(3))


def fold(eqns, takes, gives, values, lead):
    """Operations, in the form of jax's equations, on numbers `takes` with given `values`, for each sample of a batch.

    Whether they are results (the batch's shape `lead`), and the values of `gives`, each of that shape.
    """
    # A result takes the place of an argument of its dtype.
    kinds = [*{x.aval.dtype: None for x in (*takes, *gives)}]
    slots = []  # pairs of an argument and a result, either of which may be missing
    for dtype in kinds:
        ins, outs = ([x for x in side if x.aval.dtype == dtype] for side in (takes, gives))
        slots += [
            (ins[i] if i < len(ins) else None, outs[i] if i < len(outs) else None, dtype)
            for i in range(max(len(ins), len(outs)))
        ]

    def folded(one, other):
        (kind, *one), (other_kind, *other) = one, other
        first, done = kind == _ARGUMENTS, kind == _RESULT
        given = first | (other_kind == _ARGUMENTS)
        inner = {x: lax.select(first, a, b) for (x, _, _), a, b in zip(slots, one, other, strict=True) if x is not None}

        def read(x):
            return x.val if isinstance(x, Literal) else inner[x]

        for eqn in eqns:
            found = eqn.primitive.bind(*map(read, eqn.invars), **eqn.params)
            inner.update(zip(eqn.outvars, found if eqn.primitive.multiple_results else [found], strict=True))
        results = [
            np.zeros((), dtype) if y is None else lax.select(given, inner[y], lax.select(done, a, b))
            for (_, y, dtype), a, b in zip(slots, one, other, strict=True)
        ]
        return lax.select(given | done, _RESULT, other_kind), *results

    def twice(x, dtype):
        return jnp.zeros((*lead, 2), dtype) if x is None else jnp.broadcast_to(values[x][..., None], (*lead, 2))

    operands = [jnp.full((*lead, 2), _ARGUMENTS), *(twice(x, dtype) for x, _, dtype in slots)]
    start = [_NOTHING, *(np.zeros((), dtype) for _, _, dtype in slots)]
    found = lax.reduce(operands, start, folded, (len(lead),))
    # A canonicalisation of StableHLO explores every path through the fold for results that nothing uses. The barrier uses all.
    kind, *found = lax.optimization_barrier(found)
    return kind == _RESULT, {y: x for x, (_, y, _) in zip(found, slots, strict=True) if y is not None}
