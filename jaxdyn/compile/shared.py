"""Operations whose results all samples of a batch share, such as those on the model alone: they run once per call.

A program is split in two. The first runs once and computes the shared numbers; the second runs for each sample and reads those
that it needs. For forward dynamics of a given robot the first program has a third of the operations.
"""

import functools
from collections.abc import Sequence

from jaxdyn.compile.code import MIN_SHARED_OPERATIONS
from jaxdyn.compile.program import Array, Constant, Program, Renumbering, dtype_of
from jaxdyn.compile.stored import key_within, load_or_make


def split_program(program, uniform: Sequence[bool]) -> tuple[Program, Program] | None:
    """Split a program into one of the uniform inputs and one of all inputs and the results of the first.

    `uniform` marks the inputs that are equal for all samples. None where so few operations are shared that a second call
    would cost more.
    """
    if not isinstance(program, Program) or not any(uniform):
        return None
    key = ("split", tuple(uniform))
    if key not in program.derived:
        # A program or two, or none.
        make = functools.partial(_split, program, uniform)
        both, _ = load_or_make(key_within(program, *key), lambda: (make() or (), None))
        program.derived[key] = tuple(both) or None
    return program.derived[key]


def _split(program: Program, uniform: Sequence[bool]) -> tuple[Program, Program] | None:
    is_shared: list[bool] = []
    for op, _, args in program.operations:
        if op == "input":
            is_shared.append(uniform[args[0]])
        else:
            # Subprograms are not split: their calls stay in the program of the batch.
            is_shared.append(
                op not in ("call", "call_where", "part") and all(is_shared[x] for x in args if type(x) is not Constant)
            )
    saved = sum(
        shared and op not in ("input", "neg") for shared, (op, _, _) in zip(is_shared, program.operations, strict=True)
    )
    # Below this a second call costs more than the batch saves; for one sample nothing is saved at all.
    if saved < MIN_SHARED_OPERATIONS:
        return None
    # One array for each kind of number, not one per number: the runtime handler checks every argument of a kernel.
    passed = _interface(program, is_shared)
    kinds = sorted({program.operations[i][1] for i in passed})
    by_kind = [[i for i in passed if program.operations[i][1] == kind] for kind in kinds]
    arrays = [Array((len(entries),), dtype_of(kind)) for kind, entries in zip(kinds, by_kind, strict=True)]

    places = [i for i, same in enumerate(uniform) if same]
    # Operations keep their order in both programs and get new indices.
    first = Renumbering()
    for i, (op, kind, args) in enumerate(program.operations):
        if is_shared[i]:
            args = (places.index(args[0]), args[1]) if op == "input" else first.args(args)
            first.add(i, (op, kind, args))
    once = Program(
        [program.inputs[i] for i in places],
        arrays,
        first.operations,
        [tuple(first.index[i] for i in entries) for entries in by_kind],
        name=f"{program.name}, shared by all samples",
    )

    # The second program takes all inputs, also those that only the first one reads, so that argument positions do not change.
    count, rest = len(program.inputs), Renumbering()
    for place, (kind, entries) in enumerate(zip(kinds, by_kind, strict=True), count):
        for k, i in enumerate(entries):
            rest.add(i, ("input", kind, (place, k)))
    for i, (op, kind, args) in enumerate(program.operations):
        if is_shared[i]:
            continue
        rest.add(i, (op, kind, args if op == "input" else rest.args(args)))
    each = Program(
        [*program.inputs, *arrays],
        program.outputs,
        rest.operations,
        [rest.args(row) for row in program.results],
        program.subprograms,
        name=program.name,
    )
    return once, each


def _interface(program: Program, is_shared: Sequence[bool]) -> list[int]:
    """Shared operations that the second program reads or returns, in the order in which it reads them."""
    read = [args for i, (op, _, args) in enumerate(program.operations) if not is_shared[i] and op != "input"]
    numbers: dict[int, None] = {}
    for args in (*read, *program.results):
        numbers |= {x: None for x in args if type(x) is not Constant and is_shared[x]}
    return list(numbers)
