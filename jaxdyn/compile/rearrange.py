"""Operations that only move entries of arrays, known or not: slices, transposes, gathers and scatters at known places."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxdyn.compile.program import NotNumbers, as_objects


def _slice(params, args, out):
    strides = params["strides"] or (1,) * args[0].ndim
    where = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return args[0][tuple(slice(*each) for each in where)]


def _broadcast(params, args, out):
    shape = [1] * len(params["shape"])
    for place, size in zip(params["broadcast_dimensions"], args[0].shape, strict=True):
        shape[place] = size
    return np.broadcast_to(args[0].reshape(shape), params["shape"])


def _reshape(params, args, out):
    order = params["dimensions"]
    return (args[0] if order is None else args[0].transpose(order)).reshape(out.shape)


def _unstack(params, args, out):
    return list(np.moveaxis(args[0], params["axis"], 0))


def _split(params, args, out):
    return np.split(args[0], np.cumsum(params["sizes"])[:-1], params["axis"])


class _Shaped(NamedTuple):
    shape: tuple[int, ...]


def _pad(params, args, out):
    padded = np.full(out.shape, args[1].item(), args[0].dtype)
    # Gaps between entries occur in transposes of strided slices.
    config = params["padding_config"]
    # A negative width cuts: the array is padded without it and cut after that.
    if any(low < 0 or high < 0 for low, high, _ in config):
        kept = tuple((max(low, 0), max(high, 0), gap) for low, high, gap in config)
        shape = [
            low + high + max(n + (n - 1) * gap, 0) for (low, high, gap), n in zip(kept, args[0].shape, strict=True)
        ]
        whole = _pad({"padding_config": kept}, args, _Shaped(tuple(shape)))
        return whole[
            tuple(slice(max(-low, 0), n - max(-high, 0)) for (low, high, _), n in zip(config, shape, strict=True))
        ]
    where = tuple(
        slice(low, low + (n - 1) * (gap + 1) + 1, gap + 1)
        for (low, _, gap), n in zip(config, args[0].shape, strict=True)
    )
    if args[0].size:
        padded[where] = args[0]
    return padded


def _flat_places(
    shape, indices, window, inserted, batching, index_map, index_batching, sizes, window_dims, result_shape
):
    """Flat places in an array of a shape that a gather reads, or a scatter writes, and which of them are inside.

    `window` lists the dimensions of the array that a window has, `inserted` and `batching` those that it has not, `sizes`
    its size along all; `window_dims` are the dimensions of the result that belong to the window.
    """
    lead = indices.shape[:-1]
    rank, others = len(result_shape), [i for i in range(len(result_shape)) if i not in window_dims]

    def along(values, dims):  # an array with the given dimensions of the result
        order = [1] * rank
        for dim, size in zip(dims, values.shape, strict=True):
            order[dim] = size
        return values.reshape(order)

    # Flat places of all entries at once, as sums of broadcast arrays: windows of a gather have any number of dimensions.
    flat = np.zeros(result_shape, np.int64)
    inside = np.ones(result_shape, bool)
    strides = np.cumprod([1, *reversed(shape)])[:-1][::-1]
    for dim, (size, stride) in enumerate(zip(shape, strides, strict=True)):
        start = np.zeros(lead, np.int64)
        if dim in index_map:
            start = indices[..., index_map.index(dim)].astype(np.int64)
        elif dim in batching:
            axis = index_batching[batching.index(dim)]
            start = np.broadcast_to(np.arange(size).reshape([-1 if i == axis else 1 for i in range(len(lead))]), lead)
        inside &= along((start >= 0) & (start <= size - sizes[dim]), others)
        # XLA moves a window that is partly outside of the array to its edge.
        at = along(np.clip(start, 0, size - sizes[dim]), others)
        if dim in window:
            at = at + along(np.arange(sizes[dim]), [window_dims[window.index(dim)]])
        flat += at * int(stride)
    return flat, inside


def _window_dims(shape, *left_out):
    return [i for i in range(len(shape)) if not any(i in dims for dims in left_out)]


def _require_known(eqn, *arrays):
    if any(x.dtype.kind == "O" for x in arrays):
        raise NotNumbers(f"{eqn.primitive.name} at a place that is not known")


def gather(params, args, eqn):
    """Entries at places that are known."""
    operand, indices = args
    _require_known(eqn, indices)
    d, shape = params["dimension_numbers"], operand.shape
    window = _window_dims(shape, d.collapsed_slice_dims, d.operand_batching_dims)
    flat, inside = _flat_places(
        shape, indices, window, d.collapsed_slice_dims, d.operand_batching_dims, d.start_index_map,
        d.start_indices_batching_dims, params["slice_sizes"], d.offset_dims, eqn.outvars[0].aval.shape,
    )  # fmt: skip
    # Filled entries would be NaN or the least integer: that is left to JAX.
    if not inside.all() and "fill" in str(params["mode"]).lower():
        raise NotNumbers("a gather beyond its argument")
    return [operand.reshape(-1)[flat]]


def dynamic_slice(params, args, eqn):
    """A part that begins at a place that is known."""
    operand, *starts = args
    _require_known(eqn, *starts)
    sizes = params["slice_sizes"]
    at = [min(max(int(x), 0), n - m) for x, n, m in zip(starts, operand.shape, sizes, strict=True)]
    return [operand[tuple(slice(i, i + m) for i, m in zip(at, sizes, strict=True))]]


def dynamic_update_slice(params, args, eqn):
    """An array with a part of it replaced, at a place that is known."""
    operand, update, *starts = args
    _require_known(eqn, *starts)
    at = [min(max(int(x), 0), n - m) for x, n, m in zip(starts, operand.shape, update.shape, strict=True)]
    is_known = operand.dtype.kind != "O" and update.dtype.kind != "O"
    updated = operand.copy() if is_known else as_objects(operand).copy()
    updated[tuple(slice(i, i + m) for i, m in zip(at, update.shape, strict=True))] = (
        update if is_known else as_objects(update)
    )
    return [updated]


REARRANGEMENTS: dict[str, Callable] = {
    "reshape": _reshape,
    "squeeze": lambda params, args, out: args[0].reshape(out.shape),
    "transpose": lambda params, args, out: args[0].transpose(params["permutation"]),
    "rev": lambda params, args, out: np.flip(args[0], params["dimensions"]),
    "concatenate": lambda params, args, out: np.concatenate(args, params["dimension"]),
    "stack": lambda params, args, out: np.stack(args, params["axis"]),
    "tile": lambda params, args, out: np.tile(args[0], params["reps"]),
    "unstack": _unstack,
    "slice": _slice,
    "broadcast_in_dim": _broadcast,
    "split": _split,
    "pad": _pad,
}


def scatter_places(eqn, operand, indices, updates) -> list:
    """For each entry of the updates of a scatter, the place of the operand that it goes to, or None."""
    _require_known(eqn, indices)
    d, shape = eqn.params["dimension_numbers"], operand.shape
    window = _window_dims(shape, d.inserted_window_dims, d.operand_batching_dims)
    sizes = [1] * len(shape)
    for dim, of_update in zip(window, d.update_window_dims, strict=True):
        sizes[dim] = updates.shape[of_update]
    flat, inside = _flat_places(
        shape, indices, window, d.inserted_window_dims, d.operand_batching_dims, d.scatter_dims_to_operand_dims,
        d.scatter_indices_batching_dims, sizes, d.update_window_dims, updates.shape,
    )  # fmt: skip
    # By name: the enumeration itself is internal to JAX.
    if "clip" in str(eqn.params["mode"]).lower():
        inside = np.ones_like(inside)
    return [place if fits else None for place, fits in zip(flat.ravel().tolist(), inside.ravel().tolist(), strict=True)]


# Rules that need the whole equation.
AT_PLACES: dict[str, Callable] = {
    "dynamic_slice": dynamic_slice, "dynamic_update_slice": dynamic_update_slice,
}  # fmt: skip
