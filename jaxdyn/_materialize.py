"""`materialize`: an identity that makes XLA:CPU write its operands to memory once instead of recomputing them.

XLA:CPU fuses elementwise producers into each of their consumers and recomputes them there. In a recursion over bodies
every level has several consumers, so the work grows exponentially with depth. XLA duplicates a producer only if it can be
fused into all of its consumers, so one consumer that cannot be fused keeps it whole. `lax.optimization_barrier` is removed
before fusion and does not serve.

The consumer used here is an `if` whose branch sends the values to the host. The branch never runs: its condition, that
this partition has number 2^32 - 1, is false in every program, whatever the data (NaN and inf included), but the compiler
does not know that, and may not delete a branch with a side effect. Its cost is one test of a flag per call.

The primitive is the identity in every other respect: it batches, differentiates forward and in reverse (tangents and
cotangents are kept as well) and lowers to nothing on other platforms. Were a later XLA to fold the
condition, results would stay right and become slow; a test counts the fusions of a compiled recursion.
"""

import contextlib
import contextvars

import jax
import numpy as np

# The bindings of MLIR have no public address.
from jax._src.lib.mlir import ir  # pyright: ignore[reportPrivateImportUsage]
from jax._src.lib.mlir.dialects import hlo
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

_materialize_p = Primitive("materialize")
_materialize_p.multiple_results = True
_least_size = contextvars.ContextVar("least_size", default=1)


@contextlib.contextmanager
def at_least(size: int):
    """While tracing inside: arrays that turn out smaller than `size` are not kept.

    A branch that is compiled only for large batches would otherwise hold side effects at small ones, and XLA would not
    remove it.
    """
    token = _least_size.set(size)
    try:
        yield
    finally:
        _least_size.reset(token)


def least_size() -> int:
    """The size that `at_least` has set."""
    return _least_size.get()


def materialize(*values):
    """The same values, each computed once (see the module's text). Entries that are plain Python numbers pass through."""
    arrays = [i for i, value in enumerate(values) if isinstance(value, jax.Array)]
    kept = list(values)
    if arrays:
        for i, value in zip(arrays, _materialize_p.bind(*[values[i] for i in arrays], least=least_size()), strict=True):
            kept[i] = value
    return kept


def never(direction: str = "EQ"):
    """While lowering: a flag that is false in every program (true for the direction "NE"), which XLA does not know."""
    return hlo.CompareOp(
        hlo.PartitionIdOp().result,
        mlir.ir_constant(np.uint32(0xFFFFFFFF)),
        hlo.ComparisonDirectionAttr.get(direction),
        compare_type=hlo.ComparisonTypeAttr.get("UNSIGNED"),
    ).result


def _identity_lowering(ctx, *values, least):
    return list(values)


def _cpu_lowering(ctx, *values, least):
    worth = [value for value, aval in zip(values, ctx.avals_in, strict=True) if aval.size >= least]
    # Where a program is divided between devices, XLA takes no side effects that do not say on which one they happen.
    if worth and getattr(ctx.module_context.axis_context, "num_devices", 1) in (None, 1):
        branches = hlo.IfOp([], never())
        with ir.InsertionPoint(branches.regions[0].blocks.append()):
            hlo.OutfeedOp(worth, hlo.CreateTokenOp().result, outfeed_config=ir.StringAttr.get(""))
            hlo.ReturnOp([])
        with ir.InsertionPoint(branches.regions[1].blocks.append()):
            hlo.ReturnOp([])
    return list(values)


def _on_nonzero(values, least):
    """Apply the primitive to the entries that are not symbolic zeros."""
    live = [value for value in values if type(value) is not ad.Zero]
    kept = iter(_materialize_p.bind(*live, least=least) if live else ())
    return [value if type(value) is ad.Zero else next(kept) for value in values]


def _batch(values, axes, *, least):
    return _materialize_p.bind(*values, least=least), axes


def _jvp(values, tangents, *, least):
    return _materialize_p.bind(*values, least=least), _on_nonzero(tangents, least)


def _transpose(cotangents, *values, least):
    return _on_nonzero(cotangents, least)


_materialize_p.def_impl(lambda *values, least: list(values))
_materialize_p.def_abstract_eval(lambda *avals, least: list(avals))
mlir.register_lowering(_materialize_p, _identity_lowering)
mlir.register_lowering(_materialize_p, _cpu_lowering, platform="cpu")
batching.primitive_batchers[_materialize_p] = _batch
ad.primitive_jvps[_materialize_p] = _jvp
ad.primitive_transposes[_materialize_p] = _transpose
