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
    """Entries of vectors as a new vector: pairs of a vector (None: a known number) and a place in it (or that number)."""

    entries: tuple[tuple[Any, Any], ...]
    aval: Any

    def is_all_of(self, vector: int, length: int) -> bool:
        """Whether it is a vector of that length as it is."""
        return self.entries == tuple((vector, place) for place in range(length))


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
    takes: dict[Name, Taken]
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
    """Numbers that are made in the same way."""

    def __init__(self, number: int, level: int = 0):
        self.number, self.level, self.made = number, level, []


def vector_program(program: ClosedJaxpr, sizes: Sequence[int], results: Sequence[int]) -> VectorProgram:
    """Of a program whose arguments come in vectors of `sizes`, and go out in vectors of the lengths `results`."""
    jaxpr = program.jaxpr
    kinds: dict = {}  # by what they are made of
    of: dict = {}  # the class of each number
    numbers = iter(jaxpr.invars)
    classes = [_Class(i) for i in range(len(sizes))]
    for each, size in zip(classes, sizes, strict=True):
        each.made = [next(numbers) for _ in range(size)]
        of.update((x, each) for x in each.made)
    wholes: list[tuple[_Class, Any]] = []
    for eqn in jaxpr.eqns:
        if eqn.primitive.multiple_results:
            found = _Class(len(classes), 1 + max(of[x].level for x in eqn.invars if not isinstance(x, Literal)))
            classes.append(found)
            found.made = list(eqn.outvars)
            wholes.append((found, eqn))
            of.update((x, found) for x in eqn.outvars)
            continue
        operands = tuple(("known", str(x.aval)) if isinstance(x, Literal) else of[x].number for x in eqn.invars)
        kind = eqn.primitive, str(eqn.params), operands
        if kind not in kinds:
            kinds[kind] = _Class(len(classes))
            classes.append(kinds[kind])
        found = kinds[kind]
        found.made.append(eqn)
        of[eqn.outvars[0]] = found
    return _grouped(jaxpr, sizes, results, classes, of, {found.number: eqn for found, eqn in wholes})


def _grouped(jaxpr, sizes, results, classes, of, wholes) -> VectorProgram:
    place: dict = {}

    def entry(x):
        return (None, x.val) if isinstance(x, Literal) else (of[x].number, place[x])

    steps: dict = {}  # by level and length
    for each in classes:
        if each.number < len(sizes) or each.number in wholes:
            place.update((x, i) for i, x in enumerate(each.made))
            if each.number in wholes:
                eqn = wholes[each.number]
                taken = Taken(tuple(map(entry, eqn.invars)), eqn.outvars[0].aval)
                each.level = 1 + max(classes[v].level for v, _ in taken.entries if v is not None)
                name = Name(each.number, eqn.outvars[0].aval)
                steps[each.level, -each.number] = Whole(eqn.primitive, eqn.params, taken, name)
            continue
        # In the order of what they take, so that it is taken in order.
        each.made.sort(key=lambda eqn: [entry(x)[1] for x in eqn.invars if not isinstance(x, Literal)])
        length = len(each.made)
        place.update((eqn.outvars[0], i) for i, eqn in enumerate(each.made))
        takes = [
            Taken(tuple(map(entry, column)), column[0].aval)
            for column in zip(*(e.invars for e in each.made), strict=True)
        ]
        straight = [_as_it_is(taken, classes, length, len(sizes), wholes) for taken in takes]
        each.level = 0
        for taken, is_straight in zip(takes, straight, strict=True):
            for v in {v for v, _ in taken.entries} - {None}:
                each.level = max(each.level, classes[v].level + (not is_straight))
        group = steps.setdefault((each.level, length), Group(length, [], {}, []))
        operands = []
        for taken, is_straight in zip(takes, straight, strict=True):
            vector, first = taken.entries[0]
            if vector is None and len({np.asarray(x).tobytes() for _, x in taken.entries}) == 1:
                operands.append(Literal(first, taken.aval))
            elif vector is not None and is_straight and classes[vector].level == each.level:
                operands.append(Name(vector, taken.aval))
            else:
                same = [name for name, there in group.takes.items() if there.entries == taken.entries]
                operands.append(same[0] if same else Name(-1 - len(group.takes), taken.aval))
                group.takes[operands[-1]] = taken
        made = Name(each.number, each.made[0].outvars[0].aval)
        group.eqns.append(Operation(each.made[0].primitive, each.made[0].params, operands, [made]))
    outs, at = [], 0
    for size in results:
        some = jaxpr.outvars[at : at + size]
        at += size
        outs.append(Taken(tuple(map(entry, some)), some[0].aval if some else ShapedArray((), np.dtype(float))))
    ordered = [steps[key] for key in sorted(steps)]
    needed = {v for step in ordered for taken in _takes(step) for v, _ in taken.entries}
    needed |= {v for taken in outs for v, _ in taken.entries}
    for step in ordered:
        if isinstance(step, Group):
            step.gives.extend(eqn.outvars[0] for eqn in step.eqns if eqn.outvars[0].number in needed)
    return VectorProgram(tuple(sizes), ordered, outs)


def _as_it_is(taken: Taken, classes, length, arguments, wholes) -> bool:
    """Whether a vector that operations have made is taken as it is."""
    vector = taken.entries[0][0]
    if vector is None or vector < arguments or vector in wholes:
        return False
    return len(classes[vector].made) == length and taken.is_all_of(vector, length)


def _takes(step):
    return step.takes.values() if isinstance(step, Group) else [step.takes]
