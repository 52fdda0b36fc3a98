"""`vector_program`: a program of single numbers as one of vectors, for mechanisms with many parts of one kind.

Operations that do the same with numbers that were made in the same way, such as those for each of forty equal trees, become one
operation on vectors: two operations belong together if they are of one kind and their operands belong together, down to the
arguments, whatever known numbers they take. What follows in equal order is put together into groups, each of which
is one loop over its vectors' entries. The program then has as many operations as one of the parts, and a few more for those that
are not like others.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal


class Taken(NamedTuple):
    """Entries of vectors as a new vector: pairs of a vector (None: a known number) and a place in it (or that number's bytes)."""

    entries: tuple[tuple[Any, Any], ...]
    aval: Any

    def vectors(self) -> set[int]:
        """Those that entries are of."""
        return {vector for vector, _ in self.entries if vector is not None}


class Name(NamedTuple):
    """Stands for a vector among the operands of an operation."""

    number: int
    aval: Any


class Operation(NamedTuple):
    """One operation on vectors, entry by entry, in the form of jax's equations."""

    primitive: Any
    params: dict
    invars: list
    outvars: list[Name]


class Group(NamedTuple):
    """Operations on vectors of one length: `takes` are made of other vectors before, `gives` are needed by others."""

    length: int
    eqns: list[Operation]
    takes: dict[Taken, Name]
    gives: list[Name]


class Whole(NamedTuple):
    """An operation that takes many numbers at once, and the vectors that it makes: one for all of its results."""

    primitive: Any
    params: dict
    takes: Taken
    gives: Name


@dataclass(frozen=True, eq=False)
class VectorProgram:
    """`sizes` of the arguments, which are the first vectors; what is done; and what comes out."""

    sizes: tuple[int, ...]
    steps: list[Group | Whole]
    results: list[Taken]

    @property
    def operations(self) -> int:
        """How many it has; those on whole matrices not counted."""
        return sum(len(step.eqns) for step in self.steps if isinstance(step, Group))


class _Class:
    """Numbers that are made in the same way: arguments, results of one operation on many numbers, or operations."""

    def __init__(self, number: int, made: list, whole: Any = None):
        self.number, self.made, self.whole, self.level = number, made, whole, 0


def vector_program(program: ClosedJaxpr, sizes: Sequence[int], results: Sequence[int]) -> VectorProgram:
    """Of a program whose arguments come in vectors of `sizes`, and go out in vectors of the lengths `results`."""
    jaxpr = program.jaxpr
    kinds: dict = {}  # by what they are made of
    of: dict = {}  # the class of each number
    numbers = iter(jaxpr.invars)
    classes = [_Class(i, [next(numbers) for _ in range(size)]) for i, size in enumerate(sizes)]
    of.update((x, each) for each in classes for x in each.made)
    for eqn in jaxpr.eqns:
        if eqn.primitive.multiple_results:
            classes.append(_Class(len(classes), list(eqn.outvars), whole=eqn))
            of.update((x, classes[-1]) for x in eqn.outvars)
            continue
        operands = tuple(("known", str(x.aval)) if isinstance(x, Literal) else of[x].number for x in eqn.invars)
        kind = eqn.primitive, str(eqn.params), operands
        if kind not in kinds:
            kinds[kind] = _Class(len(classes), [])
            classes.append(kinds[kind])
        kinds[kind].made.append(eqn)
        of[eqn.outvars[0]] = kinds[kind]
    return _grouped(jaxpr, sizes, results, classes, of)


def _grouped(jaxpr, sizes, results, classes: list[_Class], of: dict) -> VectorProgram:
    place: dict = {}

    def taken_of(numbers, aval) -> Taken:
        return Taken(tuple(map(entry, numbers)), aval)

    def entry(x):
        return (None, _bytes(x)) if isinstance(x, Literal) else (of[x].number, place[x])

    steps: dict = {}  # by level, and length or number
    for each in classes:
        if each.number < len(sizes) or each.whole is not None:
            place.update((x, i) for i, x in enumerate(each.made))
            if each.whole is not None:
                aval = each.made[0].aval
                taken = taken_of(each.whole.invars, aval)
                each.level = 1 + max(classes[v].level for v, _ in taken.entries if v is not None)
                step = Whole(each.whole.primitive, each.whole.params, taken, Name(each.number, aval))
                steps[each.level, -each.number] = step
            continue
        # In the order of what they take, so that it is taken in order.
        each.made.sort(key=lambda eqn: [place[x] for x in eqn.invars if not isinstance(x, Literal)])
        length, (first, *_) = len(each.made), each.made
        place.update((eqn.outvars[0], i) for i, eqn in enumerate(each.made))
        takes = [taken_of(column, column[0].aval) for column in zip(*(e.invars for e in each.made), strict=True)]
        as_made = [_is_as_made(taken, classes, length, len(sizes)) for taken in takes]
        each.level = max(
            (
                classes[v].level + (not same)
                for taken, same in zip(takes, as_made, strict=True)
                for v in taken.vectors()
            ),
            default=0,
        )
        group = steps.setdefault((each.level, length), Group(length, [], {}, []))
        operands = []
        for x, taken, same in zip(first.invars, takes, as_made, strict=True):
            vector = taken.entries[0][0]
            if isinstance(x, Literal) and len(set(taken.entries)) == 1:
                operands.append(x)
            elif same and classes[vector].level == each.level:
                operands.append(Name(vector, taken.aval))
            else:
                operands.append(group.takes.setdefault(taken, Name(-1 - len(group.takes), taken.aval)))
        made = Name(each.number, first.outvars[0].aval)
        group.eqns.append(Operation(first.primitive, first.params, operands, [made]))
    outs, at = [], 0
    for size in results:
        some = jaxpr.outvars[at : at + size]
        at += size
        outs.append(taken_of(some, some[0].aval if some else ShapedArray((), np.dtype(float))))
    ordered = [steps[key] for key in sorted(steps)]
    needed = {v for taken in (*outs, *(x for step in ordered for x in _takes(step))) for v in taken.vectors()}
    for step in ordered:
        if isinstance(step, Group):
            step.gives.extend(eqn.outvars[0] for eqn in step.eqns if eqn.outvars[0].number in needed)
    return VectorProgram(tuple(sizes), ordered, outs)


def _is_as_made(taken: Taken, classes, length: int, arguments: int) -> bool:
    """Whether it is a whole vector of that length, in order, that operations have made."""
    vector = taken.entries[0][0]
    if vector is None or vector < arguments or classes[vector].whole is not None:
        return False
    return len(classes[vector].made) == length and taken.entries == tuple((vector, place) for place in range(length))


def _takes(step: Group | Whole):
    return step.takes if isinstance(step, Group) else [step.takes]


def _bytes(literal: Any) -> bytes:
    """Of a known number: unlike numbers, those of zeros of two signs differ, and those that are no number are equal."""
    return np.asarray(literal.val, literal.aval.dtype).tobytes()
