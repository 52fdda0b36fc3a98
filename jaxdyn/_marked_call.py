"""`in_call`: operations on few numbers as one function of machine code.

XLA:CPU compiles loops over very few numbers as one function, in which all that they do is plain code. It finds such loops by
their size, moves them into a call and marks this call with an attribute. Here a call is marked the same way whatever its size.

Such a function runs on one core and may contain only some operations (see `_call_writer`). The body is the branch of an `if` that
always runs: XLA divides operations on larger arrays between threads, which fails here, and does not look into branches for them.

The attributes are no promise of XLA's. Where they mean nothing, the call is an ordinary one with the same results; a test
counts the marked calls of compiled simulations.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.extend.mlir import ir
from jax.interpreters import mlir

from jaxdyn._materialize import never

_ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}


def in_call(body: ClosedJaxpr) -> Callable:
    """The function of arrays, which gives a list of arrays, in a marked call: for CPU, neither batched nor differentiated."""
    return lambda *arrays: _call_p.bind(_always_p.bind(), *arrays, body=body)


_call_p = Primitive("marked_call")
_call_p.multiple_results = True
_call_p.def_impl(lambda runs, *arrays, body: jaxpr_as_fun(body)(*arrays))
_call_p.def_abstract_eval(lambda runs, *avals, body: body.out_avals)


def _marked(ctx, *arrays, body: ClosedJaxpr):
    given = [aval.size > 0 for aval in body.in_avals]

    def branches(runs, *some):
        rest = iter(some)
        arrays = [
            next(rest) if here else jnp.zeros(x.shape, x.dtype) for x, here in zip(body.in_avals, given, strict=True)
        ]

        def never_taken(*arrays):
            # XLA stops at calls that do not use all of their arguments, so here all are used.
            entries = [x.reshape(-1)[0].astype(float) for x in arrays if x.size]
            total = sum(entries, start=jnp.zeros(()))
            return [jnp.full(aval.shape, total.astype(aval.dtype)) for aval in body.out_avals]

        return lax.cond(runs, jaxpr_as_fun(body), never_taken, *arrays)

    arrays = [arrays[0], *(x for x, here in zip(arrays[1:], given, strict=True) if here)]
    ctx = ctx.replace(avals_in=[ctx.avals_in[0], *(x for x, here in zip(ctx.avals_in[1:], given, strict=True) if here)])

    def hidden(*arrays):
        # XLA writes known arguments into the function, which then does not use them: see above.
        return jax.jit(branches)(*lax.optimization_barrier(arrays))

    # A function of its own, of which one call is written here.
    block = ir.InsertionPoint.current.block  # pyright: ignore[reportAttributeAccessIssue]
    before = len(block.operations)
    found = mlir.lower_fun(hidden, multiple_results=True)(ctx, *arrays)
    for operation in list(block.operations)[before:]:
        if operation.operation.name == "func.call":
            marks: dict[str, ir.Attribute] = {name: ir.StringAttr.get(value) for name, value in _ATTRIBUTES.items()}
            operation.operation.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(marks)
    return found


mlir.register_lowering(_call_p, _marked, cacheable=False)

_always_p = Primitive("always")
_always_p.def_impl(lambda: np.asarray(True))
_always_p.def_abstract_eval(lambda: ShapedArray((), np.dtype(bool)))
mlir.register_lowering(_always_p, lambda ctx: [never("NE")])
