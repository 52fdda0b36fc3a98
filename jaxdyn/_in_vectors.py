"""A kernel's program on vectors: see `_vector_program`. Vectors come first, so that a batch is the inner loop."""

import functools
import itertools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Literal

from jaxdyn import _banded
from jaxdyn._fold import fold
from jaxdyn._vector_program import Group, Taken, VectorProgram

_LEAST_FOLDED = 10  # operations of a group of one sample that become a kernel; a fold needs more besides than a few
_AT_ONCE = 128  # samples of a batch, whose vectors stay in a core's cache
_MOST_RUNS = 4  # of consecutive entries, that are put together from slices


def as_vectors(*arrays, program: VectorProgram, shapes, depth: int, often: bool = True) -> list:
    """What a kernel's program gives for arrays with `depth` leading axes.

    Of one sample folds are for what runs `often`: the runtime sets up a buffer for each of their operations, once a program.
    """
    lead = arrays[0].shape[:depth]
    if math.prod(lead) > _AT_ONCE:
        return _in_portions(arrays, program, shapes, depth)
    values = {i: jnp.moveaxis(x.reshape(*lead, program.sizes[i]), -1, 0) for i, x in enumerate(arrays)}
    sound = []
    for step in program.steps:
        if isinstance(step, Group):
            given = {name: _taken(taken, values, lead) for taken, name in step.takes.items()}
            if not lead and (not often or len(step.eqns) < _LEAST_FOLDED):
                found = _one_by_one(step, given, lead)
            else:
                done, found = fold(step.eqns, list(step.takes.values()), step.gives, given, (step.length, *lead))
                sound.append(done)
            values.update((name.number, x) for name, x in found.items())
        else:
            numbers = _taken(step.takes, values, lead)
            values[step.gives.number] = _banded.in_vectors(step.primitive, numbers, **step.params)
    all_sound, found = _all(sound, lead), []
    for (shape, dtype), taken in zip(shapes, program.results, strict=True):
        array = jnp.moveaxis(_taken(taken, values, lead), 0, -1).astype(dtype)
        if jnp.issubdtype(dtype, jnp.floating):
            array = jnp.where(all_sound[..., None], array, np.asarray(np.nan, dtype))
        found.append(array.reshape(*lead, *shape))
    return found


def _in_portions(arrays, program: VectorProgram, shapes, depth: int) -> list:
    """The same for `_AT_ONCE` samples after another."""
    lead = arrays[0].shape[:depth]
    count = math.prod(lead)
    portions = -(-count // _AT_ONCE)

    def cut(x):
        x = x.reshape(count, *x.shape[depth:])
        x = jnp.pad(x, [(0, portions * _AT_ONCE - count), *[(0, 0)] * (x.ndim - 1)], mode="edge")
        return x.reshape(portions, _AT_ONCE, *x.shape[1:])

    def portion(arrays):
        return as_vectors(*arrays, program=program, shapes=shapes, depth=1)

    found = lax.map(portion, [cut(x) for x in arrays])
    return [x.reshape(-1, *x.shape[2:])[:count].reshape(*lead, *x.shape[2:]) for x in found]


def _all(flags: list, lead):
    """Whether all flags (n, *lead) of all arrays are set."""
    if lead:
        return functools.reduce(jnp.logical_and, [jnp.all(x, 0) for x in flags], jnp.ones(lead, bool))
    # First together, as to reduce each array takes three operations, which here take longer than what they do.
    longest = max(map(len, flags), default=0)
    padded = [jnp.pad(x, (0, longest - len(x)), constant_values=True) for x in flags]
    return jnp.all(functools.reduce(jnp.logical_and, padded, jnp.ones(longest, bool)))


def _one_by_one(group: Group, values: dict, lead) -> dict:
    """What a group gives, as operations on arrays."""
    values = dict(values)
    for eqn in group.eqns:
        args = [
            jnp.broadcast_to(_known(x), (group.length, *lead)) if isinstance(x, Literal) else values[x]
            for x in eqn.invars
        ]
        values[eqn.outvars[0]] = eqn.primitive.bind(*args, **eqn.params)
    return {name: values[name] for name in group.gives}


def _known(literal: Any) -> np.ndarray:
    return np.asarray(literal.val, literal.aval.dtype)


def _taken(taken: Taken, values: dict, lead):
    """The entries as an array (n, *lead)."""
    dtype = taken.aval.dtype
    if not taken.entries:
        return jnp.zeros((0, *lead), dtype)
    parts, first, at = [], {}, 0  # where each vector begins, and each known number is
    for v in sorted(taken.vectors()):
        parts.append(values[v])
        first[v] = at
        at += len(values[v])
    known = [*dict.fromkeys(number for v, number in taken.entries if v is None)]
    if known:
        column = np.frombuffer(b"".join(known), dtype).reshape(-1, *[1] * len(lead))
        parts.append(jnp.broadcast_to(column, (len(known), *lead)))
    where = {number: at + i for i, number in enumerate(known)}
    places = [where[x] if v is None else first[v] + x for v, x in taken.entries]
    return _entries(jnp.concatenate(parts) if len(parts) > 1 else parts[0], np.asarray(places))


def _entries(x, places: np.ndarray):
    """x[places]."""
    if len(places) == x.shape[0] and (np.diff(places) == 1).all():
        return x
    steps = np.unique(np.diff(places))
    if len(places) > 1 and len(steps) == 1 and steps[0] != 0:
        step, low = abs(int(steps[0])), int(places.min())
        run = lax.slice_in_dim(x, low, int(places.max()) + 1, step)
        return run if steps[0] > 0 else lax.rev(run, (0,))
    starts = [0, *(np.flatnonzero(np.diff(places) != 1) + 1), len(places)]
    if len(starts) - 1 <= _MOST_RUNS:
        runs = [x[int(places[a]) : int(places[b - 1]) + 1] for a, b in itertools.pairwise(starts)]
        return jnp.concatenate(runs) if len(runs) > 1 else runs[0]
    return x.at[places].get(mode="promise_in_bounds")
