"""Kernels whose batch is sharded over devices: attributes for the partitioner of XLA, and types for JAX.

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

from jaxdyn.compile import jax_adapter
from jaxdyn.compile.jax_adapter import ShapedArray


def results_of(avals: Sequence, arrays: Sequence) -> list:
    """Types of the results, one sample each of `arrays`, with the batch axes and the shardings of the arguments."""
    longest = max(avals, key=lambda x: x.ndim, default=None)
    lead = () if longest is None else longest.shape[:-1]
    if longest is None or jax_adapter.mesh_of(longest) is None:
        return [ShapedArray((*lead, array.size), array.dtype) for array in arrays]
    # Operands with the batch's axes agree along them, or leave an axis open: the first that says something decides.
    specs = [jax_adapter.spec_of(x) for x in avals if x.ndim == longest.ndim]
    along = [next((spec[k] for spec in specs if spec[k] is not None), None) for k in range(len(lead))]
    return [jax_adapter.type_like(longest, (*lead, array.size), array.dtype, (*along, None)) for array in arrays]


def is_divisible(avals: Sequence, lead: Sequence) -> bool:
    """Decide whether XLA may partition this call; False too where its batch has a last axis of length one.

    Such an axis is put there, as the partitioner counts batch axes from the front: the only axis of an argument that all samples
    share would be divided as if it were that of the batch; with fewer axes than the batch has, the argument is left alone. And an
    argument that is on every device becomes one that can be divided, by its reshape.
    """
    if not lead or lead[-1] == 1 or jax.device_count() == 1:
        return False
    mesh = jax_adapter.mesh_of(avals[0]) if avals else None
    return mesh is None or not jax_adapter.is_all_manual(mesh)


def attributes(avals: Sequence, results: Sequence) -> dict | None:
    """Attributes of the call; None where nothing can be divided."""
    lead = results[0].shape[:-1] if results else ()
    if not lead or not all(isinstance(n, int) for n in lead):  # `jax.export` has sizes without a number
        return None
    sizes = list(lead)

    # The entries of each array are an axis of its own in the rule, so that nothing is ever divided along them.
    def axes(x):
        sizes.append(x.shape[-1])  # an axis of its own, which is in no other array
        return [*range(len(lead)), len(sizes) - 1] if x.ndim > 1 else [len(sizes) - 1]

    operands, outputs = [axes(x) for x in avals], [axes(x) for x in results]
    return jax_adapter.sharding_attributes(len(lead), sizes, operands, outputs)
