"""Programs written out once more in the graph of another one, where equal numbers and known ones are folded again."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.compile.graph import Graph
from jaxdyn.compile.program import (
    Array,
    Constant,
    Program,
    kind_of,
    objects,
)


def replay(
    graph: Graph, program: Program, inputs: Sequence[np.ndarray], branches: bool = True
) -> tuple[list, list[np.ndarray]]:
    """The numbers of all operations of a program for the given entries of its inputs, and its outputs.

    Without `branches` both results of a branch are computed for all samples, and selected.
    """
    numbers: list = []
    flat = [x.ravel().tolist() for x in inputs]
    for op, kind, args in program.operations:
        if op == "input":
            place, entry = args
            numbers.append(flat[place][entry])
        else:
            operands = [x.value if type(x) is Constant else numbers[x] for x in args]
            numbers.append(repeat(graph, program, op, kind, operands, branches))
    outputs = [
        objects([x.value if type(x) is Constant else numbers[x] for x in row], array.shape)
        for row, array in zip(program.results, program.outputs, strict=True)
    ]
    return numbers, outputs


def repeat(graph: Graph, program: Program, op: str, kind: str, args: list, branches: bool = True) -> Any:
    """The number of an operation of a program for these operands; of a call the list of all entries of its outputs."""
    if op in ("call", "call_where"):  # operands: the number of the subprogram, then entries one after the other
        which, *given = args
        write = _call if op == "call" else _call_where
        return [x for row in write(graph, program.subprograms[which], given, branches) for x in row.ravel().tolist()]
    if op == "part":
        call, entry = args
        return call[entry]
    return graph.apply(op, kind, args)


def _call(graph: Graph, program: Program, given: list, branches: bool) -> list[np.ndarray]:
    inputs = arrays_of(program.inputs, given)
    return graph.call(program, inputs) if program.is_called else replay(graph, program, inputs, branches)[1]


def _call_where(graph: Graph, program: Program, given: list, branches: bool) -> list[np.ndarray]:
    flag, *entries = given
    arrays, count = arrays_of((*program.inputs, *program.outputs), entries), len(program.inputs)
    inputs, otherwise = arrays[:count], arrays[count:]
    if branches or program.is_called:
        return graph.call_where(flag, program, inputs, otherwise)
    return [
        objects(
            [graph.select(flag, x, y, kind_of(array.dtype)) for x, y in zip(old.flat, new.flat, strict=True)],
            array.shape,
        )
        for old, new, array in zip(otherwise, replay(graph, program, inputs, branches)[1], program.outputs, strict=True)
    ]


def arrays_of(types: Sequence[Array], entries: list) -> list[np.ndarray]:
    """Arrays of entries that are given one after the other."""
    ends = np.cumsum([array.size for array in types]).tolist()
    return [objects(entries[end - array.size : end], array.shape) for end, array in zip(ends, types, strict=True)]


def inline(program: Program) -> Program:
    """The same without subprograms and branches, except subprograms that have loops."""
    if all(x.is_called for x in program.subprograms):
        return program
    graph = Graph()
    with np.errstate(all="ignore"):  # known numbers may overflow, as they do in XLA
        _, outputs = replay(graph, program, [graph.inputs(i, array) for i, array in enumerate(program.inputs)], False)
    written = graph.finish(program.inputs, program.outputs, outputs, name=program.name)
    written.reports_validity = program.reports_validity
    return written
