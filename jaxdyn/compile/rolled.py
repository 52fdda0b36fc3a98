"""Loops of jaxprs as `scan.Scan`s: the program of one iteration, from the arrays that go into all of them.

What is known is folded into it: entries of carries that never change, and columns of rows that are the same in all iterations,
such as the zeros of joints of one kind. Other known columns are tables.
"""

import contextlib
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.compile.graph import Graph
from jaxdyn.compile.jax_adapter import ClosedJaxpr, scan_counts  # pyright: ignore[reportPrivateImportUsage]
from jaxdyn.compile.program import (
    Array,
    FlaggedIteration,
    Number,
    as_objects,
    dtype_of,
    is_number,
    kind_or_refuse,
    objects,
    split_by_counts,
)
from jaxdyn.compile.scan import MAX_WRITTEN_OUT, Counts, Scan

# Operations of an iteration beyond which there is no loop, but of a sweep.
MAX_LOOP_BODY = 20_000
# Loops of fewer iterations are always written out.
MIN_ITERATIONS = 8
# Of a loop whose end is not known, for estimates of its cost.
GUESSED_ITERATIONS = 10


def scan(expansion, params, args, eqn):
    """`lax.scan`: as a loop, or written out where it is short."""
    count, carried = scan_counts(params)
    length = params["length"]
    consts, carry, rows = args[:count], args[count : count + carried], args[count + carried :]
    outs = [x.aval for x in eqn.outvars[carried:]]
    if not length:
        return [*carry, *(np.zeros(x.shape, x.dtype) for x in outs)]
    if length >= MIN_ITERATIONS and any(x.dtype.kind == "O" for x in args):
        arrays, results = [consts, carry, rows], None
        # Flags of an iteration have no place but in what is written out.
        with contextlib.suppress(FlaggedIteration):
            results = _roll(expansion, params["jaxpr"], arrays, eqn, length, params["reverse"], None, MAX_WRITTEN_OUT)
        if results is not None:
            return results
    saved: list[list] = []
    # Written out: the length is known, and zeros of a first step are seen in the following ones.
    for i in reversed(range(length)) if params["reverse"] else range(length):
        results = expansion.evaluate(params["jaxpr"], [*consts, *carry, *(x[i, ...] for x in rows)])
        carry = results[:carried]
        saved.append(results[carried:])
    if params["reverse"]:
        saved.reverse()
    return [*carry, *(_stack(column) for column in zip(*saved, strict=True))]


def _roll(expansion, body: ClosedJaxpr, arrays, eqn, length: int, inward: bool, parents, maximum: int) -> list | None:
    """Results of a loop as a call of a subprogram; None where it is short enough to be written out.

    **Arguments:**

    - `body`: the jaxpr of one iteration, from constants, carries and a row of each array to carries and rows.
    - `arrays`: constants, carries, and rows (length, ...).
    - `maximum`: operations of a loop that is written out.

    **Returns:** carries, and rows (length, ...), as those of `lax.scan`.
    """
    consts, carries, rows = ([as_objects(x) if x.dtype.kind == "O" else x for x in group] for group in arrays)
    of_consts, of_carries, of_rows = split_by_counts([x.aval.dtype for x in eqn.invars], [len(x) for x in arrays])
    of_results = [x.aval.dtype for x in eqn.outvars[len(carries) :]]
    consts = [_group([[y] for y in x.ravel().tolist()], x, d) for x, d in zip(consts, of_consts, strict=True)]
    rows = [_group(_columns(x), x[0, ...], d) for x, d in zip(rows, of_rows, strict=True)]
    carried = _Carries([as_objects(x) for x in carries], of_carries)
    while True:
        inner, types = Graph(expansion.graph.maximum), []

        def make(arrays, inner=inner, types=types):
            first = len(types)
            types.extend(arrays)
            return [inner.inputs(first + i, x) for i, x in enumerate(arrays)]

        own_consts = make([Array((len(x.passed),), x.dtype) for x in consts if x.passed])
        own_carries = make(carried.types)
        own_rows = make([Array((len(x.passed),), x.dtype) for x in rows if x.passed])
        own_tables = make([Array((len(x.known),), x.dtype) for x in rows if x.known])
        of_constants, of_passed, of_known = iter(own_consts), iter(own_rows), iter(own_tables)
        given = [
            *(x.entries(of_constants, None) for x in consts),
            *carried.entries(own_carries),
            *(x.entries(of_passed, of_known) for x in rows),
        ]
        results = [as_objects(x) for x in expansion.evaluate_in(inner, body, given)]
        ends, outs = results[: len(carries)], results[len(carries) :]
        if not carried.refine(ends):
            break
    # Of each array of rows the columns that are not known.
    columns = [[k for k, x in enumerate(out.ravel().tolist()) if is_number(x)] for out in outs]
    kept = [i for i, column in enumerate(columns) if column]
    made = [outs[i].ravel()[columns[i]] for i in kept]
    outputs = [*carried.types, *(Array(x.shape, np.dtype(of_results[i])) for i, x in zip(kept, made, strict=True))]
    program = inner.finish(types, outputs, [*carried.outputs(ends), *made])
    # A call counts as one operation: its code exists once. A loop of long iterations would compile for as long as what is written
    # out, which then is refused as too long.
    if len(program.operations) * length <= maximum or (maximum and len(program.operations) > MAX_LOOP_BODY):
        return None
    tables = [np.stack([np.array(y, x.dtype) for y in x.known], 1) for x in rows if x.known]
    counts = Counts(len(own_consts), len(own_carries), len(own_rows), len(tables), 0, len(kept))
    scan = Scan(program, counts, length, tables, inward, parents)
    passed = [np.stack([objects(y, (len(y),)) for y in x.passed], 1) for x in rows if x.passed]
    consts = [objects([y[0] for y in x.passed], (len(x.passed),)) for x in consts if x.passed]
    found = expansion.graph.call(scan, [*consts, *carried.starts(), *passed])
    stacked, of_columns = [], iter(found[len(own_carries) :])
    for out, column in zip(outs, columns, strict=True):
        full = np.tile(out.ravel(), (length, 1))
        if column:
            full[:, column] = next(of_columns)
        stacked.append(full.reshape(length, *out.shape))
    return [*carried.entries(found[: len(own_carries)]), *stacked]


def sweep(expansion, params, args, eqn):
    """A sweep over a tree (see `batch.sweep`)."""
    (before, count), parents, inward = params["counts"], params["parents"], params["inward"]
    consts, start, rows, inner = args[:before], args[before : before + count], args[before + count :], params["call"]
    # Whoever asks for a sweep has decided that a loop is faster. Without unknown numbers there is nothing to run.
    results = None
    if any(x.dtype.kind == "O" for x in args):
        results = _roll(expansion, inner, [consts, start, rows], eqn, len(parents), inward, parents, 0)
    if results is not None:
        return results
    # Written out: of each node the carry, or the sum over its children; the root is the last one.
    carries: list = [None] * len(parents) + [None if inward else start]
    if inward:
        carries[len(parents) - 1] = start
    saved: list = [None] * len(parents)
    for i in reversed(range(len(parents))) if inward else range(len(parents)):
        given = carries[i if inward else parents[i]]
        given = (
            [np.zeros(x.aval.shape, x.aval.dtype) for x in eqn.invars[before : before + count]]
            if given is None
            else given
        )
        results = expansion.evaluate(inner, [*consts, *given, *(x[i, ...] for x in rows)])
        own, saved[i] = results[:count], results[count:]
        to, add = (parents[i], carries[parents[i]]) if inward else (i, None)
        carries[to] = own if add is None else [_add(expansion, x, y) for x, y in zip(add, own, strict=True)]
    return [*carries[-1 if inward else len(parents) - 1], *(_stack(column) for column in zip(*saved, strict=True))]


def while_loop(expansion, params, args, eqn):
    """`lax.while_loop`: written out where its end is known."""
    count, more = params["cond_nconsts"], params["body_nconsts"]
    of_cond, of_body, carry = args[:count], args[count : count + more], args[count + more :]
    while True:
        (going,) = expansion.evaluate(params["cond_jaxpr"], [*of_cond, *carry])
        going = as_objects(going).item()
        if type(going) is Number:
            return _roll_while(expansion, params, [of_cond, of_body, carry], eqn)
        if not going:
            return carry
        carry = expansion.evaluate(params["body_jaxpr"], [*of_body, *carry])


def _roll_while(expansion, params, arrays: Sequence[Sequence], eqn) -> list:
    """The carries at the end of a loop whose number of iterations is not known, as a call of a subprogram."""
    of_cond, of_body, carries = ([as_objects(x) if x.dtype.kind == "O" else x for x in group] for group in arrays)
    types = [x.aval.dtype for x in eqn.invars]
    consts = [*of_cond, *of_body]
    consts = [_group([[y] for y in x.ravel().tolist()], x, d) for x, d in zip(consts, types, strict=False)]
    carried = _Carries([as_objects(x) for x in carries], types[len(consts) :])

    def start():
        """A graph, the types of its inputs, constants and carries."""
        inner = Graph(expansion.graph.maximum)
        types = [*(Array((len(x.passed),), x.dtype) for x in consts if x.passed), *carried.types]
        made = [inner.inputs(i, x) for i, x in enumerate(types)]
        count = len(types) - len(carried.types)
        of_constants = iter(made[:count])
        return inner, types, [x.entries(of_constants, None) for x in consts], carried.entries(made[count:])

    while True:
        inner, types, own, own_carries = start()
        given = [*own[len(of_cond) :], *own_carries]
        ends = [as_objects(x) for x in expansion.evaluate_in(inner, params["body_jaxpr"], given)]
        if not carried.refine(ends):
            break
    program = inner.finish(types, carried.types, carried.outputs(ends))
    inner, types, own, own_carries = start()
    (going,) = expansion.evaluate_in(inner, params["cond_jaxpr"], [*own[: len(of_cond)], *own_carries])
    until = inner.finish(types, [Array((), np.dtype(bool))], [as_objects(going)])
    passed = [objects([y[0] for y in x.passed], (len(x.passed),)) for x in consts if x.passed]
    counts = Counts(len(passed), len(carried.types), 0, 0, 0, 0)
    scan = Scan(program, counts, GUESSED_ITERATIONS, condition=until)
    return carried.entries(expansion.graph.call(scan, [*passed, *carried.starts()]))


def _add(expansion, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return as_objects(expansion.elementwise["add"](as_objects(x), as_objects(y)))


# --- constants and rows ---


class _Group(NamedTuple):
    """An array of constants or rows by its entries in one iteration.

    - `places`: for each entry ("fixed", its value), ("passed", column) or ("known", column).
    - `passed`, `known`: columns over the iterations, each once.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    places: list[tuple[str, Any]]
    passed: list[list]
    known: list[list]

    def entries(self, passed, known) -> np.ndarray:
        """Entries of one iteration; `passed` and `known` are iterators over the inputs of the groups."""
        own: dict[str, Any] = {"passed": next(passed) if self.passed else None}
        own["known"] = next(known) if self.known else None
        return objects([at if where == "fixed" else own[where][at] for where, at in self.places], self.shape)


def _columns(x: np.ndarray) -> list[list]:
    flat = x.reshape(len(x), -1)
    return [as_objects(flat[:, k]).tolist() for k in range(flat.shape[1])]


def _group(columns: list[list], one: np.ndarray, dtype) -> _Group:
    kind_or_refuse(dtype)
    places: list = []
    passed: dict[tuple, int] = {}
    known: dict[bytes, int] = {}
    by_key: dict[Any, list] = {}
    for column in columns:
        if any(is_number(x) for x in column):
            key, where = tuple(map(id, column)), "passed"
            places.append((where, passed.setdefault(key, len(passed))))
        else:
            # By bits: zeros of both signs are different, and NaN is equal to itself.
            key = np.array(column, dtype).tobytes()
            if key == key[: np.dtype(dtype).itemsize] * len(column):
                places.append(("fixed", column[0]))
                continue
            places.append(("known", known.setdefault(key, len(known))))
        by_key[key] = column
    return _Group(one.shape, np.dtype(dtype), places, [by_key[x] for x in passed], [by_key[x] for x in known])


# --- carries ---


class _Carries:
    """Entries of carries. One whose start is known and which keeps it is no carry at all."""

    def __init__(self, carries: Sequence[np.ndarray], dtypes: Sequence):
        self.shapes = [x.shape for x in carries]
        # Each array of carries is one of the loop: derivatives decide by arrays what they depend on.
        self.owners = [i for i, x in enumerate(carries) for _ in range(x.size)]
        self.kinds = [kind_or_refuse(d) for d in dtypes]
        self.start = [x for array in carries for x in array.ravel().tolist()]
        self.known = [not is_number(x) for x in self.start]

    def _members(self) -> dict[int, list[int]]:
        """Entries that are carried, by array."""
        members: dict[int, list[int]] = {}
        for i, owner in enumerate(self.owners):
            if not self.known[i]:
                members.setdefault(owner, []).append(i)
        return members

    @property
    def types(self) -> list[Array]:
        """Arrays of the carried entries."""
        return [Array((len(x),), dtype_of(self.kinds[owner])) for owner, x in self._members().items()]

    def entries(self, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Arrays of the carries from those of the carried entries."""
        flat = list(self.start)
        for members, array in zip(self._members().values(), inputs, strict=True):
            for i, x in zip(members, array.ravel().tolist(), strict=True):
                flat[i] = x
        parts = split_by_counts(flat, [math.prod(shape) for shape in self.shapes])
        return [objects(part, shape) for part, shape in zip(parts, self.shapes, strict=True)]

    def refine(self, ends: Sequence[np.ndarray]) -> bool:
        """Carry entries that an iteration has changed; False where none were."""
        made = [x for array in ends for x in array.ravel().tolist()]
        known = [k and _key(x) == _key(y) for k, x, y in zip(self.known, self.start, made, strict=True)]
        changed, self.known = known != self.known, known
        return changed

    def outputs(self, ends: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Arrays of the carried entries at the end of an iteration."""
        return self._of([x for array in ends for x in array.ravel().tolist()])

    def starts(self) -> list[np.ndarray]:
        """The same before the first iteration."""
        return self._of(self.start)

    def _of(self, flat: list) -> list[np.ndarray]:
        return [objects([flat[i] for i in members], (len(members),)) for members in self._members().values()]


def _key(x) -> Any:
    """Equal for entries that are the same number, or known numbers of the same bits."""
    return id(x) if is_number(x) else ("known", type(x), np.asarray(x).tobytes())


def _stack(rows: Sequence) -> np.ndarray:
    if any(x.dtype.kind == "O" for x in rows):
        return np.stack([as_objects(x) for x in rows])
    return np.stack(rows)
