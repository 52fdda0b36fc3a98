"""Rules for operations that do not act entry by entry, such as products, selections and scatters, and for known arrays.

Each rule takes the expansion, the parameters of the primitive, its operands and the equation, and returns the results (see
`expand`). Operands are NumPy arrays: of numbers where they are known while tracing, else of dtype object, whose entries are
scalars of the program.
"""

import functools
import math
from collections.abc import Callable

import jax
import numpy as np

from jaxdyn.compile import program as numbers
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import NotNumbers, Number, as_kind, as_objects, kind_or_refuse, objects
from jaxdyn.compile.rearrange import scatter_at, scatter_places, select_among


def polynomial(expansion, params, args, eqn):
    """Horner's rule; the coefficients follow x, that of the highest power last."""
    shape = eqn.outvars[0].aval.shape
    x, *coefficients = (np.broadcast_to(as_objects(y), shape) for y in args)
    add, mul = expansion.elementwise["add"], expansion.elementwise["mul"]
    return [as_objects(functools.reduce(lambda value, c: add(mul(value, x), c), reversed(coefficients)))]


def integer_pow(expansion, params, args, eqn):
    """Powers with a known integer exponent, by repeated squares."""
    # Known operands: integers wrap in NumPy's power as in XLA, and negative exponents occur with floats alone.
    if args[0].dtype.kind != "O":
        return [np.asarray(args[0] ** params["y"] if params["y"] >= 0 else 1 / args[0] ** -params["y"], args[0].dtype)]
    one = as_kind(1, kind_or_refuse(eqn.outvars[0].aval.dtype))
    return [objects([expansion.graph.power(x, params["y"], one) for x in args[0].ravel().tolist()], args[0].shape)]


def convert(expansion, params, args, eqn):
    """Conversion to another dtype."""
    return [_as_dtype(expansion, args[0], params["new_dtype"])]


def _as_dtype(expansion, x: np.ndarray, dtype) -> np.ndarray:
    dtype = np.dtype(dtype)
    if x.dtype.kind != "O" and (x.dtype.kind != "f" or dtype.kind not in "iu"):
        return x.astype(dtype)
    if x.dtype.kind != "O":
        # As XLA: floats that no integer is near become its ends, or zero if they are none. NumPy's own conversion of a float
        # that is out of range is undefined and differs between processors.
        ends = np.iinfo(dtype)
        is_low, is_high = x <= ends.min, x >= ends.max
        inside = np.where(is_low | is_high | np.isnan(x), 0, x).astype(dtype)
        return np.where(is_high, dtype.type(ends.max), np.where(is_low, dtype.type(ends.min), inside))
    kind = kind_or_refuse(dtype)
    if all([type(y) is Number and y.kind == kind for y in x.ravel().tolist()]):
        return x
    return objects([expansion.graph.convert(y, kind) for y in x.ravel().tolist()], x.shape)


def select(expansion, params, args, eqn):
    """Select between two cases, or among any number where the selector is known."""
    which, *cases = args
    out = eqn.outvars[0].aval
    if which.dtype.kind != "O":
        which = np.broadcast_to(which.astype(np.int32), out.shape)
        if all(x.dtype.kind != "O" for x in cases):
            return [np.choose(which, cases)]
        cases = [as_objects(x) for x in cases]
        # The selector is known and the cases are not, as for masks of a topology: no operation is emitted.
        chosen = np.where(which == 0, cases[0], cases[1])
        for i in range(2, len(cases)):
            chosen = np.where(which == i, cases[i], chosen)
        return [as_objects(chosen)]
    if len(cases) != 2 or eqn.invars[0].aval.dtype != bool:
        return select_among(expansion, which, cases, out)
    kind = kind_or_refuse(out.dtype)
    columns = (np.broadcast_to(as_objects(x), out.shape).ravel().tolist() for x in args)
    return [objects([expansion.graph.select(a, b, c, kind) for a, b, c in zip(*columns, strict=True)], out.shape)]


def clamp(expansion, params, args, eqn):
    """Clip entries to a range."""
    low, x, high = (np.broadcast_to(as_objects(x), eqn.outvars[0].aval.shape).ravel().tolist() for x in args)
    clamped = [expansion.graph.clamp(a, b, c) for a, b, c in zip(low, x, high, strict=True)]
    return [objects(clamped, eqn.outvars[0].aval.shape)]


def dot_general(expansion, params, args, eqn):
    """Products of matrices, in which known zeros cost nothing."""
    a, b = args
    (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
    out = eqn.outvars[0].aval
    length, count = math.prod(a.shape[i] for i in sum_a), math.prod(a.shape[i] for i in batch_a)
    rows = math.prod(n for i, n in enumerate(a.shape) if i not in (*batch_a, *sum_a))
    columns = math.prod(n for i, n in enumerate(b.shape) if i not in (*batch_b, *sum_b))
    # Both operands as (batch, rows, summed): one loop for all products, whatever axes they sum.
    a = np.moveaxis(a, (*batch_a, *sum_a), (*range(len(batch_a)), *range(-len(sum_a), 0))).reshape(count, rows, length)
    b = np.moveaxis(b, (*batch_b, *sum_b), (*range(len(batch_b)), *range(-len(sum_b), 0))).reshape(
        count, columns, length
    )
    # The result may have a wider type than the operands (`preferred_element_type`); then the sums are in that type.
    a, b = (
        x if y.aval.dtype == out.dtype else _as_dtype(expansion, x, out.dtype)
        for x, y in zip((a, b), eqn.invars, strict=True)
    )
    if out.dtype == bool:
        raise NotNumbers("a product of bools")
    if a.dtype.kind != "O" and b.dtype.kind != "O":
        return [np.asarray(a @ b.transpose(0, 2, 1), out.dtype).reshape(out.shape)]
    zero = as_kind(0, kind_or_refuse(out.dtype))
    return [objects(_products(expansion.graph, as_objects(a), as_objects(b), zero), out.shape)]


def scatter(expansion, params, args, eqn):
    """Write or add updates at indices; updates out of bounds are dropped, as in JAX."""
    operand, indices, updates = args
    if indices.dtype.kind == "O":
        return scatter_at(expansion, params, args, eqn)
    # In the order of the updates: where two of them have the same index, JAX leaves open which one stays; here the last one does.
    entries, adds = as_objects(operand).ravel().tolist(), eqn.primitive.name != "scatter"
    places = scatter_places(eqn, operand, indices, updates)
    for value, i in zip(as_objects(updates).ravel().tolist(), places, strict=True):
        if i is not None:
            entries[i] = expansion.graph.add(entries[i], value) if adds else value
    return [objects(entries, operand.shape)]


def cholesky(expansion, params, args, eqn):
    """Lower Cholesky factors of symmetric matrices."""
    given = as_objects(args[0]).reshape(-1, *args[0].shape[-2:])
    return [np.stack([_cholesky_factor(expansion.graph, x) for x in given]).reshape(args[0].shape)]


def triangular_solve(expansion, params, args, eqn):
    """Solutions of a x = b or x a = b, always by rows of a lower or an upper matrix a."""
    a, b = (as_objects(x) for x in args)
    if params["transpose_a"]:
        a = np.swapaxes(a, -1, -2)
    # The transpose of a lower matrix is an upper one.
    lower = params["lower"] != params["transpose_a"]
    if not params["left_side"]:  # x a = b is a^T x^T = b^T
        a, b, lower = np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2), not lower
    g, is_unit, solutions = expansion.graph, params["unit_diagonal"], []
    for x, y in zip(a.reshape(-1, *a.shape[-2:]), b.reshape(-1, *b.shape[-2:]), strict=True):
        inverses = [1.0 if is_unit else g.div(1.0, z) for z in np.diagonal(x).tolist()]
        solutions.append(_solve_triangle(g, x, y, lower, inverses))
    solutions = np.stack(solutions).reshape(b.shape)
    return [solutions if params["left_side"] else np.swapaxes(solutions, -1, -2)]


# --- matrices whose entries are single numbers ---


def _is_nonzero(x) -> bool:
    return type(x) is Number or x != 0


def _products(graph: Graph, a: np.ndarray, b: np.ndarray, zero) -> list:
    """Entries of a_k b_k^T, one matrix after the other, for a (count, rows, n) and b (count, columns, n).

    `zero` is an empty sum.
    """
    # Known zeros are most of it: they are looked for once.
    entries, add, mul, size = [], graph.add, graph.mul, b.shape[1]
    for rows, columns in zip(a.tolist(), b.swapaxes(1, 2).tolist(), strict=True):
        nonzero = [[(j, y) for j, y in enumerate(column) if type(y) is Number or y != 0] for column in columns]
        for row in rows:
            totals = [zero] * size
            for x, column in zip(row, nonzero, strict=True):
                if column and (type(x) is Number or x != 0):
                    for j, y in column:
                        totals[j] = add(totals[j], mul(x, y))
            entries += totals
    return entries


def _cholesky_factor(graph: Graph, matrix: np.ndarray) -> np.ndarray:
    """The lower factor L of a symmetric matrix L L^T; reads the lower triangle."""
    n = matrix.shape[0]
    lower = np.full((n, n), 0.0, object)
    # By rows and by columns what is not a known zero: of a large mechanism that is a small part.
    below = [
        {i for i, x in enumerate(column) if i > j and _is_nonzero(x)} for j, column in enumerate(matrix.T.tolist())
    ]
    rows: list[dict] = [{} for _ in range(n)]
    # Reciprocals of the diagonal are kept: n divisions, not n^2/2, and `_solve_triangle` finds the same numbers again.
    for j, row in enumerate(rows):
        for k in row:
            below[j].update(i for i in below[k] if i > j)
        pivot = matrix[j, j]
        for x in row.values():
            pivot = graph.sub(pivot, graph.mul(x, x))
        lower[j, j] = graph.function("sqrt", pivot)
        inverse = graph.div(1.0, lower[j, j])
        for i in sorted(below[j]):
            entry = matrix[i, j]
            for k, x in row.items():
                if k in rows[i]:
                    entry = graph.sub(entry, graph.mul(rows[i][k], x))
            if _is_nonzero(entry := graph.mul(entry, inverse)):
                lower[i, j] = rows[i][j] = entry
            else:
                below[j].discard(i)
    return lower


def _solve_triangle(graph: Graph, a: np.ndarray, b: np.ndarray, lower: bool, inverses: list) -> np.ndarray:
    """x with a x = b, for a triangular matrix (n, n), the inverses of its diagonal, and b (n, columns)."""
    n, matrix, solution = a.shape[0], a.tolist(), b.copy()
    rows: list[dict] = [
        {} for _ in range(n)
    ]  # of the solution, without known zeros: most of it for the branches of a tree
    for i in range(n) if lower else reversed(range(n)):
        row = {j: x for j, x in enumerate(b[i].tolist()) if _is_nonzero(x)}
        # The row that was solved last comes last: sums of several rows are on the way at a time.
        for k in range(i) if lower else reversed(range(i + 1, n)):
            x = matrix[i][k]
            if type(x) is Number or x != 0:
                for j, y in rows[k].items():
                    row[j] = graph.sub(row.get(j, 0.0), graph.mul(x, y))
        for j, x in row.items():
            solution[i, j] = rows[i][j] = graph.mul(x, inverses[i])
    return solution


# --- arrays whose numbers are all known ---

_NUMPY: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "square": np.square,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "is_finite": np.isfinite,
    "rsqrt": lambda x: 1 / np.sqrt(x),
} | {name: f for name, f in numbers.COMPARISONS.items()} | numbers.FUNCTIONS | numbers.FUNCTIONS_OF_TWO  # fmt: skip
# Remainders by zero and negative powers of integers, which numpy computes otherwise than XLA or refuses.
_OTHER_OF_INTEGERS = ("rem", "pow")
_NUMPY_REDUCTIONS: dict[str, Callable] = {
    "reduce_sum": np.sum, "reduce_prod": np.prod, "reduce_max": np.max, "reduce_min": np.min, "reduce_and": np.all,
    "reduce_or": np.any,
}  # fmt: skip


def empty_reduction(name: str, dtype):
    """A reduction of no entries."""
    if name in ("reduce_max", "reduce_min"):
        if dtype.kind == "b":
            return name == "reduce_min"
        ends = (-np.inf, np.inf) if dtype.kind == "f" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        return ends[name == "reduce_min"]
    return name in ("reduce_prod", "reduce_and")


def evaluate_known(eqn, args) -> np.ndarray:
    """An operation on known arrays; by NumPy where that does the same, as JAX would compile it for each new shape."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    with np.errstate(all="ignore"):
        if name in _NUMPY and not (name in _OTHER_OF_INTEGERS and out.dtype.kind in "iu"):
            return np.asarray(_NUMPY[name](*args)).astype(out.dtype, copy=False)
        if name == "div" and out.dtype.kind == "f":
            return np.asarray(args[0] / args[1], out.dtype)
        if name in _NUMPY_REDUCTIONS and not args[0].size:
            return np.full(out.shape, empty_reduction(name, out.dtype), out.dtype)
        if name in _NUMPY_REDUCTIONS:
            return np.asarray(_NUMPY_REDUCTIONS[name](args[0], axis=tuple(eqn.params["axes"]))).astype(out.dtype)
        if name == "iota":
            return np.indices(out.shape)[eqn.params["dimension"]].astype(out.dtype)
        if name == "platform_index" and jax.default_backend() == "cpu" and jax.config.jax_default_device is None:
            # The first branch for this platform, or for any: None.
            places = [i for i, names in enumerate(eqn.params["platforms"]) if names is None or "cpu" in names]
            return np.asarray(places[0], out.dtype)
    return bind_known(eqn, args)


def bind_known(eqn, args) -> np.ndarray:
    """The same by JAX itself."""
    # The expansion may run within a user's trace, which must not see this operation.
    with jax.ensure_compile_time_eval():
        value = eqn.primitive.bind(*args, **eqn.params)
    if eqn.primitive.multiple_results:
        raise NotNumbers(eqn.primitive.name)
    if jax.numpy.issubdtype(value.dtype, jax.dtypes.extended):
        raise NotNumbers(f"an array of {value.dtype}")
    return np.asarray(value)
