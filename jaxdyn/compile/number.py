"""Entries of the arrays of a program while it is written: unknown `Number`s, and known ones with their type.

Both are entries of NumPy arrays of objects, so that NumPy's own functions move, sum and multiply them. Known numbers carry their
type: a Python float is a float64 and a Python bool a bool, all others are scalars of NumPy. So known integers wrap, and known
float32 numbers round, as they would in XLA.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np


class Number:
    """A number of a graph that is not known before the program runs."""

    # Tens of thousands are made for a robot: slots save a dictionary for each.
    __slots__ = ("args", "graph", "kind", "op")

    def __init__(self, graph: Any, op: str, kind: str, args: tuple):
        self.graph, self.op, self.kind, self.args = graph, op, kind, args

    def __add__(self, other):
        return self.graph.add(self, other)

    def __radd__(self, other):
        return self.graph.add(other, self)

    def __sub__(self, other):
        return self.graph.sub(self, other)

    def __rsub__(self, other):
        return self.graph.sub(other, self)

    def __mul__(self, other):
        return self.graph.mul(self, other)

    def __rmul__(self, other):
        return self.graph.mul(other, self)

    def __truediv__(self, other):
        return self.graph.div(self, other)

    def __rtruediv__(self, other):
        return self.graph.div(other, self)

    def __neg__(self):
        return self.graph.neg(self)


def is_number(x) -> bool:
    """Decide whether x is unknown before the program runs."""
    return type(x) is Number


def with_type(x):
    """A known number that numpy has computed; float64 and bool are Python's own, which are twice as fast."""
    return x.item() if isinstance(x, (np.float64, np.bool_)) else x


def objects(entries: Sequence, shape) -> np.ndarray:
    """An array of objects."""
    # `np.array(entries, object)` would look for sequences among the entries.
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)


def as_objects(x) -> np.ndarray:
    """An array, known or not, as an array of objects."""
    if isinstance(x, np.ndarray) and x.dtype == object:
        return x
    if isinstance(x, Number):
        return objects([x], ())
    x = np.asarray(x)
    # Scalars of numpy keep their type; those that Python has too are made Python's.
    return objects(x.ravel().tolist() if x.dtype in _OF_PYTHON else list(x.ravel()), x.shape)


_OF_PYTHON = (np.dtype(np.float64), np.dtype(bool))
