"""Operations that only move entries of arrays, known or not: slices, transposes, gathers and scatters at known places."""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import Array, NotNumbers, as_kind, as_objects, is_number, kind_or_refuse, objects


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
        whole = _pad({"padding_config": kept}, args, Array(tuple(shape), args[0].dtype))
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
    others = [i for i in range(len(result_shape)) if i not in window_dims]
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
        inside &= _along((start >= 0) & (start <= size - sizes[dim]), others, result_shape)
        # XLA moves a window that is partly outside of the array to its edge.
        at = _along(np.clip(start, 0, size - sizes[dim]), others, result_shape)
        if dim in window:
            at = at + _along(np.arange(sizes[dim]), [window_dims[window.index(dim)]], result_shape)
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
    "unstack": lambda params, args, out: list(np.moveaxis(args[0], params["axis"], 0)),
    "slice": _slice,
    "broadcast_in_dim": _broadcast,
    "split": lambda params, args, out: np.split(args[0], np.cumsum(params["sizes"])[:-1], params["axis"]),
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


# --- rules for places that are not known while tracing ---
#
# They are entries of tables, sums into them, indices of extremes, and exchanges of rows.
#
# A scalar program has no addresses. An entry at an unknown place is a chain of selections over all places that it can have, which
# pays for tables of some hundred entries. Operands are as in `array_rules`.


# A look-up among more places is left to JAX: each one costs a comparison and a selection in every call.
MAX_PLACES = 256


def at_place(rule, expansion, params, args, eqn):
    """A slice, or an update of one, at places of which some are not known."""
    count = 1 if rule is dynamic_slice else 2
    arrays, starts = args[:count], [as_objects(x).item() for x in args[count:]]
    sizes = params["slice_sizes"] if rule is dynamic_slice else args[1].shape
    g = expansion.graph
    # Like XLA, which moves a part that is beyond the array to its edge.
    ends = [n - m for n, m in zip(args[0].shape, sizes, strict=True)]
    chosen = [_clip(g, x, end) for x, end in zip(starts, ends, strict=True)]
    results = None
    for place, flag in _rounds(g, objects(chosen, (len(chosen),)), [range(end + 1) for end in ends], eqn):
        (here,) = rule(params, [*arrays, *map(np.asarray, place)], eqn)
        results = here if results is None else _select(expansion, flag, here, results, eqn)
    return [results]


def gather_at(expansion, params, args, eqn):
    """Entries at places of which some are not known."""
    operand, indices = args
    if indices.dtype.kind != "O":
        return gather(params, args, eqn)
    g, d = expansion.graph, params["dimension_numbers"]
    out = eqn.outvars[0].aval
    ends = [operand.shape[i] - params["slice_sizes"][i] for i in d.start_index_map]
    fills = "fill" in str(params["mode"]).lower()
    if fills and out.dtype.kind != "f":
        raise NotNumbers("integers at a place that is not known")
    others = [i for i in range(len(out.shape)) if i not in d.offset_dims]
    starts = indices if fills else _clip_all(g, indices, ends)
    results = objects([math.nan] * math.prod(out.shape), out.shape) if fills else None
    for place, flags in _rounds(g, starts, [range(end + 1) for end in ends], eqn):
        (here,) = gather(params, [operand, place], eqn)
        flags = _along(flags, others, out.shape)
        results = here if results is None else _select(expansion, flags, here, results, eqn)
    return [results]


def scatter_at(expansion, params, args, eqn):
    """Write or add updates at indices of which some are not known; updates out of bounds are dropped, as in JAX."""
    operand, indices, updates = args
    g, d = expansion.graph, params["dimension_numbers"]
    adds, kind = eqn.primitive.name != "scatter", kind_or_refuse(eqn.outvars[0].aval.dtype)
    window = _window_dims(operand.shape, d.inserted_window_dims, d.operand_batching_dims)
    sizes = {i: updates.shape[of_update] for i, of_update in zip(window, d.update_window_dims, strict=True)}
    ends = [operand.shape[i] - sizes.get(i, 1) for i in d.scatter_dims_to_operand_dims]
    others = [i for i in range(updates.ndim) if i not in d.update_window_dims]
    starts = _clip_all(g, indices, ends) if "clip" in str(params["mode"]).lower() else indices
    entries, values = as_objects(operand).ravel().tolist(), as_objects(updates).ravel().tolist()
    for place, flags in _rounds(g, starts, [range(end + 1) for end in ends], eqn):
        flags = np.broadcast_to(_along(flags, others, updates.shape), updates.shape).ravel().tolist()
        places = scatter_places(eqn, operand, place, updates)
        for flag, i, value in zip(flags, places, values, strict=True):
            if i is not None and flag is not False:
                entries[i] = g.select(flag, entries[i], g.add(entries[i], value) if adds else value, kind)
    return [objects(entries, operand.shape)]


def extreme_place(expansion, params, args, eqn):
    """Indices of the largest or smallest entries, the first of equal ones and of NaN, as in JAX."""
    g, (axis,) = expansion.graph, params["axes"]
    out = eqn.outvars[0].aval
    kind, is_largest = kind_or_refuse(out.dtype), eqn.primitive.name == "argmax"
    dtype = eqn.invars[0].aval.dtype
    rows = np.moveaxis(as_objects(args[0]), axis, 0).reshape(args[0].shape[axis], -1)

    def is_better(x, best):
        if dtype.kind == "b":
            return g.both(x, g.invert(best)) if is_largest else g.both(g.invert(x), best)
        better = g.compare("gt" if is_largest else "lt", x, best)
        if dtype.kind != "f":
            return better
        is_first_nan = g.both(g.compare("ne", x, x), g.compare("eq", best, best))
        return g.either(better, is_first_nan)

    found = []
    for column in rows.T.tolist():
        best, place = column[0], as_kind(0, kind)
        for i, x in enumerate(column[1:], 1):
            better = is_better(x, best)
            best = g.select(better, best, x, kind_or_refuse(dtype))
            place = g.select(better, place, as_kind(i, kind), kind)
        found.append(place)
    return [objects(found, out.shape)]


def cumulative(expansion, params, args, eqn):
    """Partial sums, products or extremes, from either end."""
    # Sequential, because every partial result is one. XLA sums in a tree, whose rounding differs.
    x = np.moveaxis(as_objects(args[0]), params["axis"], 0)
    order = range(x.shape[0])
    order = reversed(order) if params["reverse"] else order
    extreme = {"cummax": "reduce_max", "cummin": "reduce_min"}.get(eqn.primitive.name)
    if extreme is None:
        step = expansion.elementwise["add" if eqn.primitive.name == "cumsum" else "mul"]
    else:
        step = np.frompyfunc(lambda a, b: expansion.graph.extreme(extreme, [a, b]), 2, 1)
    results, total = np.empty(x.shape, object), None
    for i in order:
        total = x[i] if total is None else step(total, x[i])
        results[i] = total
    return [np.moveaxis(results, 0, params["axis"])]


def lu(expansion, params, args, eqn):
    """Factors of matrices with their rows exchanged for the largest pivots, the exchanges, and the permutations."""
    matrix, pivot, permutation = (x.aval for x in eqn.outvars)
    kinds = kind_or_refuse(matrix.dtype), kind_or_refuse(pivot.dtype)
    given = as_objects(args[0]).reshape(-1, *args[0].shape[-2:])
    factored = [_lu_of_one(expansion.graph, x.tolist(), *kinds) for x in given]
    return [
        objects([y for one in factored for y in one[i]], aval.shape)
        for i, aval in enumerate((matrix, pivot, permutation))
    ]


def _lu_of_one(g: Graph, rows: list[list], kind: str, index: str) -> tuple[list, list, list]:
    pivots = []
    # The permutation is one more column, which is exchanged with the others.
    order = [as_kind(i, index) for i in range(len(rows))]
    for k in range(min(len(rows), len(rows[0]))):
        largest, place = g.function("abs", rows[k][k]), as_kind(k, index)
        for i in range(k + 1, len(rows)):
            size = g.function("abs", rows[i][k])
            is_larger = g.compare("gt", size, largest)
            largest = g.select(is_larger, largest, size, kind)
            place = g.select(is_larger, place, as_kind(i, index), index)
        pivots.append(place)
        for i in range(k + 1, len(rows)):
            flag = g.compare("eq", place, as_kind(i, index))
            upper, lower = rows[k], rows[i]
            rows[k] = [g.select(flag, x, y, kind) for x, y in zip(upper, lower, strict=True)]
            rows[i] = [g.select(flag, y, x, kind) for x, y in zip(upper, lower, strict=True)]
            order[k], order[i] = g.select(flag, order[k], order[i], index), g.select(flag, order[i], order[k], index)
        inverse = g.div(1.0, rows[k][k])
        for i in range(k + 1, len(rows)):
            factor = g.mul(rows[i][k], inverse)
            changed = [g.sub(x, g.mul(factor, y)) for x, y in zip(rows[i][k + 1 :], rows[k][k + 1 :], strict=True)]
            rows[i] = [*rows[i][:k], factor, *changed]
    return [x for row in rows for x in row], pivots, order


def select_among(expansion, which, cases, out):
    """Entries of several cases, by a number that is not known."""
    g, kind = expansion.graph, kind_or_refuse(out.dtype)
    which = np.broadcast_to(as_objects(which), out.shape).ravel().tolist()
    columns = [np.broadcast_to(as_objects(x), out.shape).ravel().tolist() for x in cases]
    chosen = columns[-1]
    for i in reversed(range(len(cases) - 1)):
        flags = [g.compare("eq", x, as_kind(i, x.kind)) if is_number(x) else x == i for x in which]
        chosen = [g.select(flag, b, a, kind) for flag, a, b in zip(flags, columns[i], chosen, strict=True)]
    return [objects(chosen, out.shape)]


# --- chains of places ---


def _rounds(g: Graph, starts: np.ndarray, ranges: Sequence[range], eqn) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Known indices, the same for all rows of `starts`, and flags of the rows that have them."""
    rows = as_objects(starts).reshape(-1, starts.shape[-1])
    choices = []
    for column, values in zip(rows.T.tolist(), ranges, strict=True):
        known = sorted({int(x) for x in column if not is_number(x)})
        choices.append(known if len(known) and all(not is_number(x) for x in column) else values)
    if (count := math.prod(map(len, choices))) > MAX_PLACES:
        raise NotNumbers(f"{eqn.primitive.name} at one of {count} places that is not known")
    for place in itertools.product(*choices):
        flags = []
        for row in rows.tolist():
            same = (
                g.compare("eq", x, as_kind(i, x.kind)) if is_number(x) else int(x) == i
                for x, i in zip(row, place, strict=True)
            )
            flags.append(functools.reduce(g.both, same, True))
        yield np.broadcast_to(np.asarray(place, np.int64), starts.shape), objects(flags, starts.shape[:-1])


def _clip(g: Graph, x, end: int):
    return g.clamp(as_kind(0, x.kind), x, as_kind(end, x.kind)) if is_number(x) else min(max(int(x), 0), end)


def _clip_all(g: Graph, indices, ends: Sequence[int]) -> np.ndarray:
    rows = as_objects(indices).reshape(-1, len(ends)).tolist()
    return objects([_clip(g, x, end) for row in rows for x, end in zip(row, ends, strict=True)], indices.shape)


def _along(values: np.ndarray, dims: Sequence[int], shape: Sequence[int]) -> np.ndarray:
    """An array with the given dimensions of a shape, to be broadcast to it."""
    order = [1] * len(shape)
    for dim, size in zip(dims, values.shape, strict=True):
        order[dim] = size
    return values.reshape(order)


def _select(expansion, flags, here, otherwise, eqn) -> np.ndarray:
    kind, shape = kind_or_refuse(eqn.outvars[0].aval.dtype), eqn.outvars[0].aval.shape
    columns = (np.broadcast_to(as_objects(x), shape).ravel().tolist() for x in (np.asarray(flags), here, otherwise))
    chosen = [expansion.graph.select(flag, b, a, kind) for flag, a, b in zip(*columns, strict=True)]
    return objects(chosen, shape)
