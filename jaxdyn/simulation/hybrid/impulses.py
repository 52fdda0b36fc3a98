"""Modes of an impact from its impulses by Newton's method on Coulomb's law (`jaxdyn.contact.coulomb`).

Changes of one element at a time may cycle, since directions of sliding change with the modes. The cone complementarity problem
has a solution for all impacts on the ground, and its impulses tell which contacts close, stick, and slide.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.contact import coulomb
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, Mode
from jaxdyn.simulation.hybrid.transitions import Problem, length


def impulsive_mode(elements: Elements, problem: Problem, wanted, mode: Mode, slip) -> tuple[Mode, Array]:
    """Mode of an impact and directions of sliding (n, 2), if `wanted` (); those of other elements than contacts are kept."""
    if not elements.opening.any():
        return mode, slip
    return kernel(_impulsive_mode, static=1, derivative=False)(elements, problem, wanted, mode, slip)


def _impulsive_mode(elements: Elements, problem: Problem, wanted, mode: Mode, slip):
    contacts = [i for i, one in enumerate(elements.each) if one.opens]
    contacts.sort(key=lambda i: -len(elements.each[i].tangent))
    sizes = [1 + len(elements.each[i].tangent) for i in contacts]
    groups = tuple((sizes.count(size), size) for size in (3, 2, 1) if size in sizes)
    rows = np.array([k for i in contacts for k in (elements.each[i].normal, *elements.each[i].tangent)])
    gram, free, dtype = problem.gram, problem.free, problem.free.dtype
    Y = gram.Y[:, rows]
    W, q = matmul(Y.T, Y), free[rows]
    if len(rows) < elements.count:
        # Other rows that act are eliminated: what is left are the velocities of the contacts when these rows hold.
        others = np.setdiff1d(np.arange(elements.count), rows)
        act = elements.active(mode).astype(dtype) * jnp.zeros((elements.count,), dtype).at[others].set(1.0)
        right = jnp.concatenate([matmul(gram.Y.T, Y), free[:, None]], 1)
        change = matmul(Y.T, matmul(gram.Y, gram.factor(act).solve(right * act[:, None])))
        W, q = W - change[:, :-1], q - change[:, -1]
    # Coordinates in which the friction coefficient is one; contacts that do not touch are far away.
    one, scales, parts, start = jnp.ones((), dtype), [], [], 0
    for i, size in zip(contacts, sizes, strict=True):
        mean = sum(W[k, k] for k in range(start, start + size)) / size
        unit = jnp.where(mean > 0, 1 / jnp.sqrt(jnp.where(mean > 0, mean, one)), one)
        touches = problem.may_close[i]
        scales += [jnp.where(touches, unit, 0.0), *[jnp.where(touches, unit * problem.static[i], 0.0)] * (size - 1)]
        parts += [jnp.where(touches, unit * q[start], one), *[scales[-1] * q[start + k] for k in range(1, size)]]
        start += size
    scale, q = jnp.stack(scales), jnp.stack(parts)
    normals = np.cumsum([0, *sizes])[:-1]
    largest = jnp.max(jnp.where(scale > 0, jnp.abs(q), 0.0))
    largest = jnp.where(largest > 0, largest, one)
    q = jnp.where(scale > 0, q / largest, q)
    W = W * scale[:, None] * scale[None]
    x = coulomb.solve(groups, True, W, q, scale, jnp.zeros((), dtype), wanted).x
    y = matmul(W, x) + q
    tiny = float(jnp.finfo(dtype).eps) ** 0.5
    closed, stick, along = list(mode.closed), list(mode.stick), list(slip)
    for i, k, size in zip(contacts, normals, sizes, strict=True):
        closed[i] = problem.may_close[i] & ((x[k] > tiny) | (y[k] < tiny))
        if size > 1:
            speed, unit = length(jnp.concatenate([y[k + 1 : k + size], jnp.zeros((3 - size,), dtype)])[None])
            stick[i] = closed[i] & (speed[0] <= tiny)
            along[i] = jnp.where(stick[i], slip[i], unit[0])
    found = mode._replace(closed=jnp.stack(closed), stick=jnp.stack(stick)), jnp.stack(along)
    return jax.tree.map(lambda a, b: jnp.where(wanted, a, b), found, (mode, slip))
