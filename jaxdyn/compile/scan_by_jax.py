"""Scans (see `scan`) by operations of JAX, where there is no native code: on other devices."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jax import lax

from jaxdyn.compile.scan_text import find_slots


def scan_by_jax(scan: Any, arrays: Sequence, compute: Callable) -> list:
    """Flat outputs of a scan of flat inputs (..., size); `compute(*arrays, program=)` computes a program."""
    iteration = functools.partial(compute, program=scan.body)
    lead = max((x.shape[:-1] for x in arrays), key=len)
    counts, n = scan.counts, scan.length
    full = [jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in arrays]
    consts, start = full[: counts.consts], full[counts.consts : counts.consts + counts.carries]
    if scan.condition is not None:
        return _while_by_jax(consts, start, iteration, functools.partial(compute, program=scan.condition))
    given = [jnp.moveaxis(x.reshape(*lead, n, -1), -2, 0) for x in full[counts.consts + counts.carries :]]
    tables = [jnp.broadcast_to(jnp.asarray(x).reshape(n, *[1] * len(lead), -1), (n, *lead, x[0].size)) for x in scan.tables]
    count, slots = find_slots(range(-1, n - 1) if scan.parents is None else scan.parents)
    parents = [slots[i] for i in range(n)] if scan.parents is None else [slots[x + 1] for x in scan.parents]
    first, last = (slots[-1], slots[0]) if scan.inward else (slots[0], slots[-1])
    memory = [jnp.zeros((count, *x.shape), x.dtype).at[first].set(x) for x in start]
    sums = [jnp.zeros((*lead, x.size), x.dtype) for x in scan.split_outputs(scan.body.outputs)[1]]

    def step(carry, row):
        memory, sums = carry
        own, parent, rows, known = row
        read, write = (own, parent) if scan.inward else (parent, own)
        made = iteration(*consts, *(x[read] for x in memory), *rows, *known)
        carries, terms, results = scan.split_outputs(made)
        if scan.inward:
            memory = [x.at[own].set(0).at[write].add(y) for x, y in zip(memory, carries, strict=True)]
        else:
            memory = [x.at[write].set(y) for x, y in zip(memory, carries, strict=True)]
        return (memory, [x + y for x, y in zip(sums, terms, strict=True)]), results

    each = jnp.asarray(slots[1:]), jnp.asarray(parents), given, tables
    (memory, sums), results = lax.scan(step, (memory, sums), each, reverse=scan.inward)
    rows = [jnp.moveaxis(x, 0, -2).reshape(*lead, -1) for x in results]
    return [*(x[last] for x in memory), *sums, *rows]


def _while_by_jax(consts: list, start: list, iteration: Callable, condition: Callable) -> list:
    """A loop that ends with the last sample."""

    def step(carries):
        flag = condition(*consts, *carries)[0]
        return [jnp.where(flag, new, old) for new, old in zip(iteration(*consts, *carries), carries, strict=True)]

    return lax.while_loop(lambda carries: jnp.any(condition(*consts, *carries)[0]), step, start)
