"""Kernels whose batch is shared among devices: what the partitioner of XLA and the types of JAX have to be told.

Samples do not know of each other, so a call is divided along the axes of its batch and nothing is exchanged. Without the two
attributes below XLA would gather the batch on every device around a call of machine code.

- `num_batch_dims`: how many leading axes a target that is registered as batch-partitionable (`jax.ffi`) is divided along.
- `sdy.sharding_rule`: which axes of arguments and results are the same ones, for Shardy, which spreads shardings over a program.

Axes of meshes are of three kinds in JAX. Along automatic ones XLA divides, by these attributes. Along explicit ones, which
`jax.make_mesh` makes, shardings are a part of types: results have the batch axes of the arguments. Along manual ones, within
`jax.shard_map`, a result varies as the arguments do.
"""

from collections.abc import Sequence

import jax
from jax import lax
from jax.core import ShapedArray
from jax.extend.mlir.dialects import sdy
from jax.interpreters import mlir
from jax.sharding import AxisType, NamedSharding, PartitionSpec


def results_of(avals: Sequence, arrays: Sequence) -> list:
    """Types of the results, one sample each of `arrays`, with the batch axes and the shardings of the arguments."""
    longest = max(avals, key=lambda x: x.ndim, default=None)
    lead = () if longest is None else longest.shape[:-1]
    if longest is None or longest.sharding.mesh.empty:
        return [ShapedArray((*lead, array.size), array.dtype) for array in arrays]
    specs = [x.sharding.spec for x in avals if x.ndim == longest.ndim]
    along = [next((spec[k] for spec in specs if spec[k] is not None), None) for k in range(len(lead))]
    sharding = NamedSharding(longest.sharding.mesh, PartitionSpec(*along, None))
    return [
        longest.update(shape=(*lead, array.size), dtype=array.dtype, weak_type=False, sharding=sharding)
        for array in arrays
    ]


def varying_alike(leaves: list) -> list:
    """The same arrays, each varying along all manual axes of meshes along which one of them does."""
    types = [getattr(jax.typeof(x), "manual_axis_type", None) for x in leaves]
    axes = frozenset().union(*(x.varying for x in types if x is not None))
    if not axes:
        return leaves
    return [
        x if kind is None or axes <= kind.varying else lax.pcast(x, tuple(axes - kind.varying), to="varying")
        for x, kind in zip(leaves, types, strict=True)
    ]


def may_be_divided(avals: Sequence, lead: Sequence) -> bool:
    """Whether XLA may divide this call; False too where its batch has a last axis of length one.

    Such an axis is put there, as the partitioner counts batch axes from the front: the only axis of an argument that all samples
    share would be divided as if it were that of the batch; with fewer axes than the batch has, the argument is left alone. And an
    argument that is on every device becomes one that can be divided, by its reshape.
    """
    if not lead or lead[-1] == 1 or jax.device_count() == 1:
        return False
    mesh = avals[0].sharding.mesh if avals else None
    return mesh is None or not mesh.axis_types or any(kind != AxisType.Manual for kind in mesh.axis_types)


def attributes(avals: Sequence, results: Sequence) -> dict | None:
    """Attributes of the call; None where nothing can be divided."""
    lead = results[0].shape[:-1] if results else ()
    if not lead or not all(isinstance(n, int) for n in lead):  # `jax.export` has sizes without a number
        return None
    batch = [sdy.DimMappingAttr.get(factor_indices=[k]) for k in range(len(lead))]
    sizes = list(lead)

    def axes(x):
        sizes.append(x.shape[-1])  # a factor of its own, which is in no other array
        last = sdy.DimMappingAttr.get(factor_indices=[len(sizes) - 1])
        return sdy.TensorMappingAttr.get(dim_mappings=[*batch, last] if x.ndim > 1 else [last])

    given, results_axes = [axes(x) for x in avals], [axes(x) for x in results]
    rule = sdy.OpShardingRuleAttr.get(
        factor_sizes=sizes, operand_mappings=given, result_mappings=results_axes, is_custom=True
    )
    return {
        "mhlo.frontend_attributes": mlir.ir_attribute({"num_batch_dims": str(len(lead))}),
        "sdy.sharding_rule": rule,
    }
