"""Loops over a known number of iterations within scalar programs: `lax.scan`, and sweeps over the bodies of a tree.

A `Scan` is a subprogram with a loop: its code is that of one iteration, whatever their number. Iteration i reads a carry, row i
of some arrays, and constants; it returns a carry, rows, and terms of sums. Iterations form a tree:

    outward    c_i, y_i = f(c_parent(i), x_i)          from the root, whose carry is given
    inward     u_i, y_i = f(sum of u_j over the children j of i, x_i)      from the leaves; the root's sum is a result

`lax.scan` is the chain, outward, or inward if it runs in reverse. The transpose of a linear outward scan is an inward one, and
that of an inward one is outward; constants and sums change places too. So derivatives of all orders are scans. The code is in
`code`.
"""

import functools
import hashlib
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxdyn.compile import derive
from jaxdyn.compile.body import symbol_of
from jaxdyn.compile.code import ATTRIBUTES, ScanText
from jaxdyn.compile.derive import arrays_of, replay
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import Array, Constant, Loops, Program, as_objects, derived, is_number, split_by_counts

# Operations beyond which a loop is not written out. LLVM takes some 50 microseconds for each: one second.
MAX_WRITTEN_OUT = 20_000


class Counts(NamedTuple):
    """Numbers of arrays: constants, carries, arrays of rows, known tables; sums, arrays of rows that are results."""

    consts: int
    carries: int
    rows: int
    tables: int
    sums: int
    results: int


class Scan(Loops):
    """A loop as a subprogram; it stands where a `Program` does.

    - `body`: the program of an iteration. Its inputs are constants, carries, one row of each array, and one of each table; its
      outputs carries, terms of sums, and rows.
    - `tables`: known arrays (length, columns), which are data of the code.
    - `parents`: of each iteration, -1 for the root; parents precede their children. None for a chain.
    - `condition`: None, or of a `lax.while_loop` the program of constants and carries that says whether there is another
      iteration; there are no rows then, and `length` is a guess.

    Inputs are constants, the root's carries (of a chain that runs inward, those of the last iteration), and arrays of rows.
    Outputs are carries (of the last iteration; inward, of the root), sums, and arrays of rows.
    """

    keeps_arrays = True  # in memory, where the next loop reads them
    name = "scan"

    def __init__(self, body: Program, counts: Counts, length: int, tables=(), inward=False, parents=None,
                 condition: Program | None = None):  # fmt: skip
        self.body, self.counts, self.length, self.inward = body, counts, length, inward
        self.tables = tuple(np.ascontiguousarray(x) for x in tables)
        self.parents = None if parents is None or is_chain(parents) else tuple(parents)
        self.condition = condition
        self.derived: dict = {}
        given, made = self.split_inputs(body.inputs), self.split_outputs(body.outputs)
        self.inputs = (*given[0], *given[1], *(rows_of_array(x, length) for x in given[2]))
        self.outputs = (*made[0], *made[1], *(rows_of_array(x, length) for x in made[2]))
        ends = np.cumsum([0, *(x.size for x in self.outputs)]).tolist()
        self.results = tuple(tuple(range(a, b)) for a, b in itertools.pairwise(ends))
        self.cost = max(1, length * body.cost)

    def split_inputs(self, values: Sequence) -> tuple:
        """Constants, carries, rows and tables among the inputs of the body."""
        return split_by_counts(values, self.counts[:4])

    def split_outputs(self, values: Sequence) -> tuple:
        """Carries, terms of sums and rows among the outputs of the body."""
        return split_by_counts(values, (self.counts.carries, self.counts.sums, self.counts.results))

    @property
    def subprograms(self) -> tuple:
        """Loops within the body."""
        return (
            self.body.subprograms if self.condition is None else (*self.body.subprograms, *self.condition.subprograms)
        )

    @functools.cached_property
    def digest(self) -> str:
        """Identity of the code, as `Program.digest`."""
        tables = [(x.shape, x.dtype.str, hashlib.sha256(x.tobytes()).hexdigest()) for x in self.tables]
        until = "" if self.condition is None else self.condition.digest
        text = f"{until} {self.body.digest} {self.counts} {self.length} {tables} {self.inward} {self.parents}"
        return hashlib.sha256(text.encode()).hexdigest()

    # --- text ---

    def subprogram_ir(self, width: int) -> str:
        """The text of the function `called` (see `code.subprogram_ir`)."""
        text = ScanText(self, width, "called")
        return "\n".join([text.function(), *text.e.declared.values(), *ATTRIBUTES])

    def definition(self, symbol: str) -> dict[str, str]:
        """The function for one sample, and the loops that it calls, by names in a module's text. Programs are declared."""
        text = ScanText(self, 1, symbol)
        parts = {symbol: text.function().replace("define void", "define internal void", 1)}
        for called in self.subprograms:
            if (name := symbol_of(called, 1)) in text.e.declared and hasattr(called, "definition"):
                text.e.declared |= called.definition(name)
        return text.e.declared | parts

    # --- derivatives ---

    def _like(self, body: Program, counts: Counts, inward: bool | None = None) -> "Scan":
        inward = self.inward if inward is None else inward
        return Scan(body, counts, self.length, self.tables, inward, self.parents, self.condition)

    def call_with_changes(self, graph: Graph, values: list, changes: list) -> tuple[list, list]:
        """Entries of the outputs and their changes, for entries of the inputs and their changes (0.0: none)."""
        arrays, steps = arrays_of(self.inputs, values), arrays_of(self.inputs, changes)
        moving = tuple(any(is_number(x) or x != 0 for x in step.flat) for step in steps)
        tangent, moves = self._tangent(moving)
        groups = zip(*(split_by_counts(x, self.counts[:3]) for x in (arrays, steps, moves[: len(arrays)])), strict=True)
        made = iter(graph.call(tangent, [x for group in groups for x in with_changes(*group)]))
        outs, out_steps = [], []
        for flags in split_by_counts(
            moves[len(arrays) :], (self.counts.carries, self.counts.sums, self.counts.results)
        ):
            own = [next(made) for _ in flags]
            outs += own
            out_steps += [
                next(made) if flag else np.zeros(x.shape, object) + 0.0 for x, flag in zip(own, flags, strict=True)
            ]
        return entries_of(outs), entries_of(out_steps)

    @derived
    def _tangent(self, moving: tuple[bool, ...]) -> tuple["Scan", tuple[bool, ...]]:
        """The scan of values and changes, and which of the inputs and then of the outputs change."""
        body, tables = self.body, self.split_inputs(self.body.inputs)[3]
        m_consts, m_carries, m_rows = split_by_counts(moving, self.counts[:3])
        change, moves = self._fixpoint(m_carries, lambda carries: tangent_of(body, (*m_consts, *carries, *m_rows)))
        m_carries, m_sums, m_results = self.split_outputs(moves)
        graph = Graph()
        types, values, steps = [], [], []
        for arrays, flags in zip(self.split_inputs(body.inputs), (m_consts, m_carries, m_rows), strict=False):
            both = with_changes(arrays, arrays, flags)
            entries = [graph.inputs(len(types) + i, x) for i, x in enumerate(both)]
            types, values, steps = types + both, values + entries[: len(arrays)], steps + entries[len(arrays) :]
        values += [graph.inputs(len(types) + i, x) for i, x in enumerate(tables)]
        moved = iter(replay(graph, change, [*values, *steps])[1])
        own = replay(graph, body, values)[1]
        changes = [next(moved) if x.dtype.kind == "f" else None for x in body.outputs]
        groups = [self.split_outputs(x) for x in (own, changes, body.outputs, moves)]
        outs = [x for y, d, _, m in zip(*groups, strict=True) for x in with_changes(y, d, m)]
        outputs = [x for _, _, y, m in zip(*groups, strict=True) for x in with_changes(y, y, m)]
        program = graph.finish([*types, *tables], outputs, outs)
        sizes = [len(x) + sum(x) for x in (m_consts, m_carries, m_rows)]
        of_outputs = [len(x) + sum(x) for x in (m_sums, m_results)]
        counts = Counts(sizes[0], sizes[1], sizes[2], len(tables), of_outputs[0], of_outputs[1])
        scan = self._like(program, counts)
        if self.condition is not None:
            scan.condition = with_more_inputs(self.condition, types, (m_consts, m_carries))
        return scan, (*m_consts, *m_carries, *m_rows, *m_carries, *m_sums, *m_results)

    def _fixpoint(self, carries: tuple[bool, ...], find) -> tuple[Any, tuple[bool, ...]]:
        """The result of `find`, and flags of all outputs, once no further carry has a flag."""
        while True:
            made, flags = find(carries)
            found = tuple(a or b for a, b in zip(carries, flags, strict=False))
            if found == carries:
                return made, (*carries, *flags[len(carries) :])
            carries = found

    def transpose_at(self, graph: Graph, values: list) -> "TransposedCall":
        """A call of the scan within a program that is transposed; `values` are None for what depends on linear inputs.

        **Raises:** ValueError for a `lax.while_loop`, as JAX does.
        """
        if self.condition is not None:
            raise ValueError(
                "reverse-mode differentiation of a lax.while_loop, whose number of iterations is not known; use lax.scan, or a"
                " fori_loop from and to known numbers"
            )
        return TransposedCall(graph, self, values)

    @derived
    def split_linear(self, linear: tuple[bool, ...]) -> "Linear":
        """The scan of what does not depend on the inputs that are `linear`, and the linear scan of the rest."""
        body, tables = self.body, self.counts.tables
        l_consts, l_carries, l_rows = split_by_counts(linear, self.counts[:3])

        def find(carries):
            return None, depending_outputs(body, (*l_consts, *carries, *l_rows, *[False] * tables))

        _, outputs = self._fixpoint(l_carries, find)
        l_carries, l_sums, l_results = self.split_outputs(outputs)
        consts, carries, rows, at_tables = self.split_inputs(range(len(body.inputs)))
        own_carries = where_flag(carries, l_carries, False)
        places = [*where_flag(consts, l_consts, False), *own_carries, *where_flag(rows, l_rows, False), *at_tables]
        first = rewrite(body, places, where_flag(range(len(outputs)), outputs, False), own_carries)
        counts = Counts(
            l_consts.count(False), len(own_carries), l_rows.count(False), tables, l_sums.count(False),
            l_results.count(False) + len(own_carries),
        )  # fmt: skip
        fixed = self._like(first, counts)
        # The carries that the first scan has saved are rows of the second one.
        groups = (
            [*where_flag(consts, l_consts, False), *where_flag(consts, l_consts)],
            where_flag(carries, l_carries),
            [*where_flag(rows, l_rows, False), *own_carries, *where_flag(rows, l_rows)],
            at_tables,
        )
        is_linear = [*l_consts, *l_carries, *l_rows, *[False] * tables]
        places = [i for group in groups for i in group]
        sizes = [len(x) for x in groups]
        counts = Counts(sizes[0], sizes[1], sizes[2], sizes[3], sum(l_sums), sum(l_results))
        rest = self._like(rewrite(body, places, where_flag(range(len(outputs)), outputs, True)), counts)
        return Linear(fixed, rest, tuple(is_linear[i] for i in places), l_carries, outputs)

    @derived
    def transpose(self, linear: tuple[bool, ...]) -> "Scan":
        """The transpose of a scan whose body is linear in these inputs, all carries among them."""
        backwards = derive.transpose(self.body, linear, (True,) * len(self.body.outputs))
        l_consts, _, l_rows, _ = self.split_inputs(linear)
        c, s, y, t = self.counts.carries, self.counts.sums, self.counts.results, self.counts.tables
        fixed = l_consts.count(False), l_rows.count(False)
        # The inputs are fixed constants, fixed rows, tables, then cotangents of carries, sums, rows.
        consts, rows, tables, of_carries, of_sums, of_rows = split_by_counts(
            range(len(backwards.inputs)), (*fixed, t, c, s, y)
        )
        to_consts, to_carries, to_rows = split_by_counts(range(len(backwards.outputs)), (sum(l_consts), c, sum(l_rows)))
        places = [*consts, *of_sums, *of_carries, *rows, *of_rows, *tables]
        body = rewrite(backwards, places, [*to_carries, *to_consts, *to_rows])
        counts = Counts(fixed[0] + s, c, fixed[1] + y, t, len(to_consts), len(to_rows))
        return self._like(body, counts, not self.inward)


class Linear(NamedTuple):
    """A scan as two (see `Scan.split_linear`).

    `linear`: inputs of the body of `rest` that are linear. `carries`, `outputs`: which of the scan's depend on linear inputs.
    """

    fixed: Scan
    rest: Scan
    linear: tuple[bool, ...]
    carries: tuple[bool, ...]
    outputs: tuple[bool, ...]


class TransposedCall:
    """A call of a scan within a program that is transposed: what does not depend on the linear inputs, and the cotangents.

    - `values`: entries of the outputs, None for those that depend on linear inputs.
    """

    def __init__(self, graph: Graph, scan: Scan, values: list):
        arrays = arrays_of(scan.inputs, values)
        self.graph, self.scan = graph, scan
        self.linear = tuple(any(x is None for x in array.flat) for array in arrays)
        self.parts = scan.split_linear(self.linear)
        (l_consts, _, l_rows), (consts, carries, rows) = (
            split_by_counts(x, scan.counts[:3]) for x in (self.linear, arrays)
        )
        self.consts, rows = where_flag(consts, l_consts, False), where_flag(rows, l_rows, False)
        made = graph.call(self.parts.fixed, [*self.consts, *where_flag(carries, self.parts.carries, False), *rows])
        count = self.parts.carries.count(False)
        own, saved = iter(made[: len(made) - count]), made[len(made) - count :]
        self.rows = [*rows, *saved]
        self.values: list = []
        for flag, array in zip(self.parts.outputs, scan.outputs, strict=True):
            self.values += [None] * array.size if flag else entries_of([next(own)])

    def cotangents(self, given: list) -> list:
        """Cotangents of the entries of the inputs, 0.0 for those that are fixed, from those of the outputs."""
        scan, parts = self.scan, self.parts
        c, s, y = parts.rest.counts.carries, parts.rest.counts.sums, parts.rest.counts.results
        carries, sums, rows = split_by_counts(where_flag(arrays_of(scan.outputs, given), parts.outputs), (c, s, y))
        backwards = parts.rest.transpose(parts.linear)
        made = self.graph.call(backwards, [*self.consts, *sums, *carries, *self.rows, *rows])
        of_carries, of_consts, of_rows = map(
            iter, split_by_counts(made, (c, backwards.counts.sums, backwards.counts.results))
        )
        l_consts, l_start, l_rows = split_by_counts(self.linear, scan.counts[:3])
        by_carry = [next(of_carries) if flag else None for flag in parts.carries]
        found = [next(of_consts) if flag else None for flag in l_consts]
        found += [x if flag else None for x, flag in zip(by_carry, l_start, strict=True)]
        found += [next(of_rows) if flag else None for flag in l_rows]
        zeros = [np.zeros(x.shape, object) + 0.0 if y is None else y for x, y in zip(scan.inputs, found, strict=True)]
        return entries_of(zeros)


# --- parts of the programs of scans (see `scan`): inputs and outputs by groups, programs of some of them, what they depend on ---


def is_chain(parents) -> bool:
    """Decide whether the parent of each node is the one before it."""
    return all(parent == i - 1 for i, parent in enumerate(parents))


def rows_of_array(array: Array, length: int) -> Array:
    """The array of all rows."""
    return Array((length, *array.shape), array.dtype)


def where_flag(values: Sequence, flags: Sequence[bool], which: bool = True) -> list:
    """Values whose flag is `which`."""
    return [x for x, flag in zip(values, flags, strict=True) if flag == which]


def with_changes(values: Sequence, changes: Sequence, flags: Sequence[bool]) -> list:
    """Values, and the changes of those with a flag."""
    return [*values, *where_flag(changes, flags)]


def entries_of(arrays: Sequence[np.ndarray]) -> list:
    """Entries of arrays, one after the other."""
    return [x for array in arrays for x in array.ravel().tolist()]


def tangent_of(body: Program, moving: tuple[bool, ...]) -> tuple[Program, list[bool]]:
    """The tangent of a program, and which of its outputs change."""
    change = derive.tangent(body, (*moving, *[False] * (len(body.inputs) - len(moving))))
    rows = iter(change.results)
    found = [next(rows) if x.dtype.kind == "f" else () for x in body.outputs]
    return change, [any(type(x) is not Constant or x.value != 0 for x in row) for row in found]


def with_more_inputs(program: Program, types: Sequence[Array], moves: Sequence[Sequence[bool]]) -> Program:
    """A program of two groups of inputs as one of inputs of these `types`, where changes follow each group."""
    graph, given, at = Graph(), [], 0
    entries = [graph.inputs(i, x) for i, x in enumerate(types)]
    for flags in moves:
        given += entries[at : at + len(flags)]
        at += len(flags) + sum(flags)
    return graph.finish(types, program.outputs, replay(graph, program, given)[1])


def depending_outputs(body: Program, linear: Sequence[bool]) -> list[bool]:
    """Flags of the outputs of a program that depend on the `linear` inputs."""
    varies: list[Any] = []
    for op, _, args in body.operations:
        if op == "input":
            varies.append(linear[args[0]])
        elif op == "part" and type(varies[args[0]]) is list:
            varies.append(varies[args[0]][args[1].value])
        else:
            found: Any = [type(x) is not Constant and varies[x] for x in args]
            if op == "call" and any(found) and isinstance(called := body.subprograms[args[0].value], Scan):
                # Decided by arrays, and then for each entry of the outputs.
                flags = called.split_linear(tuple(bool(x.any()) for x in arrays_of(called.inputs, found[1:]))).outputs
                varies.append([flag for flag, x in zip(flags, called.outputs, strict=True) for _ in range(x.size)])
            else:
                varies.append(any(found))
    return [any(varies[x] for x in row if type(x) is not Constant) for row in body.results]


def rewrite(body: Program, places: Sequence[int], outputs: Sequence[int], more: Sequence[int] = ()) -> Program:
    """The program of the inputs at `places`; its outputs are those at `outputs`, and `more` of its inputs."""
    graph, entries = Graph(), [as_objects(np.zeros(x.shape, x.dtype)) for x in body.inputs]
    # Inputs that are left out are read by no output that is kept.
    for new, old in enumerate(places):
        entries[old] = graph.inputs(new, body.inputs[old])
    _, results = replay(graph, body, entries)
    types = [*(body.outputs[i] for i in outputs), *(body.inputs[i] for i in more)]
    return graph.finish(
        [body.inputs[i] for i in places], types, [*(results[i] for i in outputs), *(entries[i] for i in more)]
    )
