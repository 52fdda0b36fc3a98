"""Parts of the programs of scans (see `scan`): inputs and outputs by groups, programs of some of them, what they depend on."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxdyn.compile import derive
from jaxdyn.compile.graph import Graph
from jaxdyn.compile.inlining import replay
from jaxdyn.compile.program import Array, Constant, Program, as_objects, objects


def is_chain(parents) -> bool:
    """Decide whether the parent of each node is the one before it."""
    return all(parent == i - 1 for i, parent in enumerate(parents))


def rows_of_array(array: Array, length: int) -> Array:
    """The array of all rows."""
    return Array((length, *array.shape), array.dtype)


def split_by_counts(values: Sequence, counts: Sequence[int]) -> tuple:
    """Consecutive parts of these lengths."""
    at, parts = 0, []
    for count in counts:
        parts.append(tuple(values[at : at + count]))
        at += count
    return tuple(parts)


def where_flag(values: Sequence, flags: Sequence[bool], which: bool = True) -> list:
    """Values whose flag is `which`."""
    return [x for x, flag in zip(values, flags, strict=True) if flag == which]


def index_of_flag(flags: Sequence[bool], which: bool) -> list[int]:
    """Places of the flags that are `which`."""
    return [i for i, flag in enumerate(flags) if flag == which]


def with_changes(values: Sequence, changes: Sequence, flags: Sequence[bool]) -> list:
    """Values, and the changes of those with a flag."""
    return [*values, *where_flag(changes, flags)]


def entries_of(arrays: Sequence[np.ndarray]) -> list:
    """Entries of arrays, one after the other."""
    return [x for array in arrays for x in array.ravel().tolist()]


def arrays_of(types: Sequence[Array], entries: list) -> list[np.ndarray]:
    """Arrays of entries that are given one after the other."""
    ends = np.cumsum([array.size for array in types]).tolist()
    return [objects(entries[end - array.size : end], array.shape) for end, array in zip(ends, types, strict=True)]


def tangent_of(body: Program, moving: tuple[bool, ...]) -> tuple[Program, list[bool]]:
    """The tangent of a program, and which of its outputs change."""
    change = derive.tangent(body, (*moving, *[False] * (len(body.inputs) - len(moving))))
    rows = iter(change.results)
    found = [next(rows) if x.dtype.kind == "f" else () for x in body.outputs]
    return change, [any(type(x) is not Constant or x.value != 0 for x in row) for row in found]


def parts_of_program(program: Program | None) -> tuple | None:
    """Data of a program that a file keeps."""
    if program is None:
        return None
    return program.inputs, program.outputs, program.operations, program.results, program.subprograms


def program_of_parts(parts: tuple | None) -> Program | None:
    """The inverse of `parts_of_program`."""
    if parts is None:
        return None
    inputs, outputs, operations, results, inner = parts
    return Program(inputs, outputs, operations, results, inner)


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
            if op == "call" and any(found) and hasattr(called := body.subprograms[args[0].value], "depending_entries"):
                varies.append(called.depending_entries(found[1:]))
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
