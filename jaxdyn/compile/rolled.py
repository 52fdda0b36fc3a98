"""Loops of jaxprs as `scan.Scan`s: the program of one iteration, from the arrays that go into all of them.

What is known is folded into it: entries of carries that never change, and columns of rows that are the same in all iterations,
such as the zeros of joints of one kind. Other known columns are tables. Entries that are always equal, such as those of a
symmetric matrix, are one entry.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import Array, as_objects, dtype_of, is_number, kind_or_refuse, objects
from jaxdyn.compile.scan import Counts, Scan


# Of a loop whose end is not known, for estimates of its cost.
GUESSED_ITERATIONS = 10


def roll(
    graph: Graph, body: Callable, arrays: Sequence[Sequence], dtypes: Sequence[Sequence], length: int, inward: bool, parents, most: int
) -> list | None:
    """Results of a loop as a call of a subprogram; None where it is short enough to be written out.

    **Arguments:**

    - `body(graph, consts, carries, rows)`: results of one iteration, carries and then rows, in a graph of its own.
    - `most`: operations of a loop that is written out.
    - `arrays`, `dtypes`: of constants, carries, and rows (length, ...); `dtypes` also of the rows that are results.

    **Returns:** carries, and rows (length, ...), as those of `lax.scan`.
    """
    consts, carries, rows = ([as_objects(x) if x.dtype.kind == "O" else x for x in group] for group in arrays)
    of_consts, of_carries, of_rows, of_results = dtypes
    consts = [_group([[y] for y in x.ravel().tolist()], x, d) for x, d in zip(consts, of_consts, strict=True)]
    rows = [_group(_columns(x), x[0, ...], d) for x, d in zip(rows, of_rows, strict=True)]
    classes = _Classes([as_objects(x) for x in carries], of_carries)
    while True:
        inner, types = Graph(graph.most), []

        def make(arrays, inner=inner, types=types):
            first = len(types)
            types.extend(arrays)
            return [inner.inputs(first + i, x) for i, x in enumerate(arrays)]

        own_consts = make([Array((len(x.passed),), x.dtype) for x in consts if x.passed])
        own_carries = make(classes.types)
        own_rows = make([Array((len(x.passed),), x.dtype) for x in rows if x.passed])
        own_tables = make([Array((len(x.known),), x.dtype) for x in rows if x.known])
        given = (
            [x.entries(iter(y), None) for x, y in _pairs(consts, own_consts)],
            classes.entries(own_carries),
            _row_entries(rows, own_rows, own_tables),
        )
        results = [as_objects(x) for x in body(inner, *given)]
        ends, outs = results[: len(carries)], results[len(carries) :]
        if not classes.refine(ends):
            break
    distinct = [_distinct(x.ravel().tolist()) for x in outs]
    carried = classes.outputs(ends)
    kept = [i for i, (first, _) in enumerate(distinct) if first]
    made = [objects([outs[i].ravel()[k] for k in distinct[i][0]], (len(distinct[i][0]),)) for i in kept]
    outputs = [*classes.types, *(Array(x.shape, np.dtype(of_results[i])) for i, x in zip(kept, made, strict=True))]
    program = inner.finish(types, outputs, [*carried, *made])
    if program.cost * length <= most:
        return None
    tables = [np.stack([np.array(y, x.dtype) for y in x.known], 1) for x in rows if x.known]
    counts = Counts(len(own_consts), len(carried), len(own_rows), len(tables), 0, len(kept))
    scan = Scan(program, counts, length, tables, inward, parents)
    passed = [np.stack([objects(y, (len(y),)) for y in x.passed], 1) for x in rows if x.passed]
    consts = [objects([y[0] for y in x.passed], (len(x.passed),)) for x in consts if x.passed]
    found = scan.call(graph, [*consts, *classes.starts(), *passed])
    by_place = dict(zip(kept, found[len(carried) :], strict=True))
    stacked = []
    for i, (out, (_, places)) in enumerate(zip(outs, distinct, strict=True)):
        full = np.empty((length, out.size), object)
        for k, (x, place) in enumerate(zip(out.ravel().tolist(), places, strict=True)):
            full[:, k] = x if place is None else by_place[i][:, place]
        stacked.append(full.reshape(length, *out.shape))
    return [*classes.entries(found[: len(carried)]), *stacked]


def roll_while(graph: Graph, condition: Callable, body: Callable, arrays: Sequence[Sequence], dtypes: Sequence[Sequence]) -> list:
    """Carries at the end of a `lax.while_loop`, as a call of a subprogram.

    **Arguments:** `condition(graph, consts, carries)` and `body(graph, consts, carries)`: results of one iteration. `arrays`,
    `dtypes`: of constants and carries.
    """
    consts, carries = ([as_objects(x) if x.dtype.kind == "O" else x for x in group] for group in arrays)
    consts = [_group([[y] for y in x.ravel().tolist()], x, d) for x, d in zip(consts, dtypes[0], strict=True)]
    classes = _Classes([as_objects(x) for x in carries], dtypes[1])

    def inputs():
        inner = Graph(graph.most)
        types = [*(Array((len(x.passed),), x.dtype) for x in consts if x.passed), *classes.types]
        made = [inner.inputs(i, x) for i, x in enumerate(types)]
        count = len(types) - len(classes.types)
        own = [x.entries(iter(y), None) for x, y in _pairs(consts, made[:count])]
        return inner, types, own, classes.entries(made[count:])

    while True:
        inner, types, *given = inputs()
        ends = [as_objects(x) for x in body(inner, *given)]
        if not classes.refine(ends):
            break
    program = inner.finish(types, classes.types, classes.outputs(ends))
    inner, types, *given = inputs()
    until = inner.finish(types, [Array((), np.dtype(bool))], [as_objects(condition(inner, *given)[0])])
    passed = [objects([y[0] for y in x.passed], (len(x.passed),)) for x in consts if x.passed]
    counts = Counts(len(passed), len(classes.types), 0, 0, 0, 0)
    scan = Scan(program, counts, GUESSED_ITERATIONS, condition=until)
    return classes.entries(scan.call(graph, [*passed, *classes.starts()]))


def _distinct(entries: list) -> tuple[list[int], list[int | None]]:
    """Places of the first of equal entries that are not known; for each entry its place among these, None where known."""
    found: dict[int, int] = {}
    first, places = [], []
    for k, x in enumerate(entries):
        if not is_number(x):
            places.append(None)
            continue
        if id(x) not in found:
            found[id(x)] = len(first)
            first.append(k)
        places.append(found[id(x)])
    return first, places


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
        own = {"passed": next(passed) if self.passed else None, "known": next(known) if self.known else None}
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


def _pairs(groups: Sequence[_Group], inputs: list):
    """Groups with the array that each takes, if it takes one."""
    at = iter(inputs)
    return [(x, [next(at)] if x.passed else []) for x in groups]


def _row_entries(groups: Sequence[_Group], passed: list, known: list) -> list[np.ndarray]:
    of_passed, of_known = iter(passed), iter(known)
    return [x.entries(of_passed, of_known) for x in groups]


# --- carries ---


class _Classes:
    """Entries of carries in classes of equal ones, found by refinement: entries that start equal and are computed alike.

    A class whose start is known and which keeps it is no carry at all.
    """

    def __init__(self, carries: Sequence[np.ndarray], dtypes: Sequence):
        self.shapes = [x.shape for x in carries]
        # Each array of carries is one of the loop: derivatives decide by arrays what they depend on.
        self.owners = [i for i, x in enumerate(carries) for _ in range(x.size)]
        self.kinds = [kind_or_refuse(d) for d, x in zip(dtypes, carries, strict=True) for _ in range(x.size)]
        self.start = [x for array in carries for x in array.ravel().tolist()]
        self.known = [not is_number(x) for x in self.start]
        self.keys: list[Any] = [(kind, _key(x)) for kind, x in zip(self.kinds, self.start, strict=True)]

    def _members(self) -> dict[int, list[int]]:
        """First entries of the classes that are carried, by array."""
        seen, members = set(), {}
        for i, (key, known, owner) in enumerate(zip(self.keys, self.known, self.owners, strict=True)):
            if not known and key not in seen:
                seen.add(key)
                members.setdefault(owner, []).append(i)
        return members

    @property
    def types(self) -> list[Array]:
        """Arrays of the carried entries."""
        return [Array((len(x),), dtype_of(self.kinds[x[0]])) for x in self._members().values()]

    def entries(self, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Arrays of the carries from their classes' values."""
        value = {
            self.keys[i]: x
            for members, array in zip(self._members().values(), inputs, strict=True)
            for i, x in zip(members, array.ravel().tolist(), strict=True)
        }
        flat = iter([s if k else value[key] for s, k, key in zip(self.start, self.known, self.keys, strict=True)])
        return [objects([next(flat) for _ in range(int(np.prod(shape)))], shape) for shape in self.shapes]

    def refine(self, ends: Sequence[np.ndarray]) -> bool:
        """Divide classes whose entries were computed differently; False where none were."""
        made = [_key(x) for array in ends for x in array.ravel().tolist()]
        known = [k and _key(s) == m for k, s, m in zip(self.known, self.start, made, strict=True)]
        keys = [key if k else (key, m) for key, k, m in zip(self.keys, known, made, strict=True)]
        before = len(set(zip(self.keys, self.known, strict=True)))
        changed = known != self.known or len(set(zip(keys, known, strict=True))) != before
        if changed:
            names: dict[Any, int] = {}
            self.known = known
            self.keys = [names.setdefault((key, k), len(names)) for key, k in zip(keys, known, strict=True)]
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
