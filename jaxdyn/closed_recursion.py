"""Accelerations and multipliers of trees with closed loops, body by body, in single numbers.

A row of A is a pair of opposite wrenches on the two bodies of a loop. The articulated bodies give M = W W^T, and y = W^-1 a for
a row a is what the joints meet when its wrenches are carried inward: it has entries for the joints between the two bodies
and the root alone. The rows' matrix A M^-1 A^T = Y^T Y is therefore sparse, and so is its Cholesky factor; where their
entries are is known while tracing, and nothing else is computed. Neither M nor A is ever formed.

Positions, velocities and accelerations of a loop are those relative to the last body that its two sides have in common, so
that they depend on the joints between them alone, and a mechanism far from the world's origin loses nothing.

Source: the factorisation of Rodriguez, Jain & Kreutz-Delgado (1992), EQUATIONS sections 5 and 7.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn._articulated import Factor, factorize, inward, outward
from jaxdyn._banded import banded_factor, banded_solution
from jaxdyn._links import (
    canonical_bodies,
    canonical_poses,
    combine,
    place_joints,
    power,
    split,
    stack,
    wrench_to_parent,
)
from jaxdyn._materialize import materialize
from jaxdyn._row_pattern import path, pattern
from jaxdyn._scalar import (
    EYE3,
    ZERO3,
    add,
    apply,
    cross,
    is_zero,
    matmul,
    mul,
    scale,
    sub,
    transpose,
    vadd,
    vanishes,
    vsub,
)
from jaxdyn._scalar_program import is_written_in_vectors
from jaxdyn._tracing import is_concrete
from jaxdyn.model import Model, body_index, frame_index
from jaxdyn.recursive import body_wrenches, joint_forces

LEAST_ROWS = 8  # that a band is taken for in a program of vectors
MOST_WIDTH = 9  # of it, with the diagonal


class Side(NamedTuple):
    """One frame of a loop: its body (-1: the world), and its pose (rotation, position) in the body's canonical frame."""

    body: int
    rotation: tuple
    position: tuple


class Closed(NamedTuple):
    """A loop: its two frames, the last body they have in common (-1: the world), and what its joint holds."""

    a: Side
    b: Side
    common: int
    slides: tuple[int, ...]
    turn: Any


class Factored(NamedTuple):
    """M and the rows' matrix, factored."""

    moves: list
    factor: Factor
    parts: list  # per row, entries of D^(1/2) y by (body, joint coordinate)
    lower: list  # per column of L, its entries by row
    pivots: list  # of L D L^T
    band: list | None = None  # rows of L and D, in a program of vectors; see `_banded`


def close(model: Model, loops: Sequence) -> list[Closed]:
    """The loops in canonical frames."""
    names = [body for loop in loops for body in (loop.body_a, loop.body_b)]
    poses = [pose for loop in loops for pose in (loop.pose_a, loop.pose_b)]
    # On known numbers numpy; within a trace jax would hide them.
    known = is_concrete(poses, model.frame_poses)
    dtype, offsets = model.home.dtype, np.asarray(model.frame_poses) if known else model.frame_poses
    poses = [np.asarray(pose, dtype) if known else pose.astype(dtype) for pose in poses]
    bodies = [body_index(model, name) for name in names]
    for n, name in enumerate(names):
        if name is not None and name not in model.body_names:
            poses[n] = offsets[frame_index(model, name)] @ poses[n]
    sides = [Side(body, *numbers) for body, numbers in zip(bodies, canonical_poses(model, bodies, poses), strict=True)]
    found = []
    for loop, a, b in zip(loops, sides[::2], sides[1::2], strict=True):
        shared = set(path(model, a.body)) & set(path(model, b.body))
        found.append(Closed(a, b, max(shared, default=-1), loop.kind.slides, loop.kind.turn))
    return found


class _Motion(NamedTuple):
    """A frame seen from the common body: axes, position in two parts, and in the frame's own axes its velocity, angular velocity,
    acceleration and angular acceleration."""

    rotation: tuple
    origin: tuple
    position: tuple
    v: tuple
    w: tuple
    dv: tuple
    dw: tuple


_AT_REST = _Motion(EYE3, ZERO3, ZERO3, ZERO3, ZERO3, ZERO3, ZERO3)


class Walk:
    """Motions of bodies seen from the last common body of a loop; what loops share is computed once. v None: at rest."""

    def __init__(self, model: Model, moves, v=None, a=None):
        slices = model.topology.v_slices
        self.model, self.moves = model, moves
        self.speeds = split([0] * model.nv if v is None else v, slices)
        self.rates = None if a is None else split(a, slices)
        self.found: dict = {}

    def body(self, body: int, common: int) -> _Motion:
        if body == common:
            return _AT_REST
        if (body, common) not in self.found:
            self.found[body, common] = self._next(body, self.body(self.model.topology.parents[body], common), common)
        return self.found[body, common]

    def _next(self, body: int, parent: _Motion, common: int) -> _Motion:
        moved = self.moves[body]
        down, r = transpose(moved.rotation), moved.shift
        first = self.model.topology.parents[body] == common
        rotation = matmul(parent.rotation, moved.rotation)
        step = apply(parent.rotation, r)
        # The way to the first body is kept apart: it may be long, and is the same for both sides.
        origin, position = (step, ZERO3) if first else (parent.origin, vadd(parent.position, step))
        v_rel, w_rel = combine(moved.columns, self.speeds[body])
        carried = apply(down, parent.w)
        lever = cross(parent.w, r)
        v = vadd(apply(down, vadd(parent.v, lever)), v_rel)
        dv = apply(down, vadd(parent.dv, cross(parent.dw, r), cross(parent.w, lever)))
        dv = vadd(dv, scale(2, cross(carried, v_rel)), cross(w_rel, v_rel))
        dw = vadd(apply(down, parent.dw), cross(carried, w_rel))
        if self.rates is not None:
            dv_rel, dw_rel = combine(moved.columns, self.rates[body])
            dv, dw = vadd(dv, dv_rel), vadd(dw, dw_rel)
        w = vadd(carried, w_rel)
        return keep_all(_Motion(rotation, origin, position, v, w, dv, dw))

    def frame(self, side: Side, common: int) -> _Motion:
        at = self.body(side.body, common)
        down, r = transpose(side.rotation), side.position
        lever = cross(at.w, r)
        return _Motion(
            matmul(at.rotation, side.rotation),
            at.origin if side.body >= 0 else ZERO3,
            vadd(at.position, apply(at.rotation, r)),
            apply(down, vadd(at.v, lever)),
            apply(down, at.w),
            apply(down, vadd(at.dv, cross(at.dw, r), cross(at.w, lever))),
            apply(down, at.dw),
        )


class Across(NamedTuple):
    """Frame B seen from frame A: pose, and in the axes of A how its origin moves and how it turns; and the two frames."""

    R: tuple
    p: tuple
    slide: tuple
    turning: tuple
    a: _Motion
    b: _Motion


def across(loop: Closed, walk: Walk) -> Across:
    """The two frames of a loop against each other."""
    a, b = walk.frame(loop.a, loop.common), walk.frame(loop.b, loop.common)
    down = transpose(a.rotation)
    R = matmul(down, b.rotation)
    p = apply(down, vadd(vsub(b.position, a.position), vsub(b.origin, a.origin)))
    R, p = keep_all((R, p))
    slide = vsub(vsub(apply(R, b.v), a.v), cross(a.w, p))
    return Across(R, p, slide, vsub(apply(R, b.w), a.w), a, b)


def rows_of(loop: Closed, walk: Walk, dtype):
    """Wrenches on the two bodies, and the acceleration along each row of a loop.

    Per row ((wrench on A's body, wrench on B's body), d2 phi/dt2).
    """
    R, p, slide, turning, a, b = across(loop, walk)
    lever = cross(a.w, p)
    bend = vsub(vsub(apply(R, b.dv), a.dv), vadd(cross(a.dw, p), cross(a.w, lever), scale(2, cross(a.w, slide))))
    found = []
    for i in loop.slides:
        force = tuple(int(k == i) for k in range(3))
        found.append((_pair(loop, R, p, force, ZERO3), bend[i]))
    if loop.turn is not None:
        swirl = vsub(vsub(apply(R, b.dw), a.dw), cross(a.w, vadd(turning, a.w)))
        moments, rates = _turned(loop.turn, R, turning, swirl, dtype)
        found += [(_pair(loop, R, p, ZERO3, n), rate) for n, rate in zip(moments, rates, strict=True)]
    return found


def as_arrays(numbers, dtype):
    """Nested tuples of numbers as arrays ()."""
    return jax.tree.map(lambda entry: jnp.asarray(entry, dtype), numbers)


def _turned(turn, R, turning, swirl, dtype):
    """For rows on the rotation R of frame B in A that turns at `turning`: moments about the axes of A, and d2/dt2."""

    R, turning, swirl = as_arrays((R, turning, swirl), dtype)
    columns = transpose(R)
    rate = transpose([cross(turning, c) for c in columns])
    bend = transpose([vadd(cross(swirl, c), cross(turning, cross(turning, c))) for c in columns])

    def along(R, rate):
        return jax.jvp(turn, (R,), (rate,))[1]

    values, back = jax.vjp(turn, R)
    moments = []
    for k in range(len(values)):
        (gradient,) = back(tuple(jnp.full_like(x, float(i == k)) for i, x in enumerate(values)))
        moments.append(vadd(*(cross(c, g) for c, g in zip(columns, transpose(gradient), strict=True))))
    return moments, jax.jvp(along, (R, rate), (rate, bend))[1]


def _pair(loop: Closed, R, p, force, moment):
    """The wrench (force, moment), in the axes of frame A at the origin of frame B, on B's body, and its reaction on A's."""
    on_a = None
    if loop.a.body >= 0:
        f = apply(loop.a.rotation, force)
        reach = vadd(loop.a.position, apply(loop.a.rotation, p))
        n = vadd(apply(loop.a.rotation, moment), ZERO3 if vanishes(force) else cross(reach, f))
        on_a = scale(-1, f), scale(-1, n)
    on_b = None
    if loop.b.body >= 0:
        back = transpose(R)
        f = apply(loop.b.rotation, apply(back, force))
        n = vadd(apply(loop.b.rotation, apply(back, moment)), cross(loop.b.position, f))
        on_b = f, n
    return on_a, on_b


def pending_of(loop: Closed, pair) -> dict:
    wrenches: dict = {}
    for body, wrench in ((loop.a.body, pair[0]), (loop.b.body, pair[1])):
        if wrench is not None:
            before = wrenches.get(body, (ZERO3, ZERO3))
            wrenches[body] = vadd(before[0], wrench[0]), vadd(before[1], wrench[1])
    return wrenches


def keep_all(numbers):
    """The same nested tuples, each number computed once."""
    leaves, structure = jax.tree.flatten(numbers)
    return jax.tree.unflatten(structure, materialize(*leaves))


def _carry(model: Model, moves, factor: Factor, pending: list[dict]) -> list[dict]:
    """What the joints meet when each row's wrenches on some bodies are carried inward over the articulated bodies."""
    left = [dict(wrenches) for wrenches in pending]
    parts: list[dict] = [{} for _ in pending]
    for i in reversed(range(model.nb)):
        here = [r for r, wrenches in enumerate(left) if i in wrenches]
        forces = dict(zip(here, keep_all([left[r].pop(i) for r in here]), strict=True))
        for j, column in enumerate(moves[i].columns):
            met = materialize(*(power(column, forces[r]) for r in here))
            gain = factor.gains[i][j]
            for r, u in zip(here, met, strict=True):
                if not is_zero(u):
                    parts[r][i, j] = u
                    forces[r] = tuple(vsub(f, scale(u, g)) for f, g in zip(forces[r], gain, strict=True))
        parent = model.topology.parents[i]
        for r in here:
            if parent >= 0 and not vanishes(forces[r][0] + forces[r][1]):
                up = wrench_to_parent(moves[i], forces[r])
                before = left[r].get(parent, (ZERO3, ZERO3))
                left[r][parent] = vadd(before[0], up[0]), vadd(before[1], up[1])
    return parts


def factored(model: Model, moves, factor: Factor, pending) -> Factored:
    """L D L^T of the rows' matrix, column by column, where it has entries."""
    parts = _carry(model, moves, factor, pending)
    weighted = keep_all([{key: mul(u, factor.inverses[key[0]][key[1]]) for key, u in part.items()} for part in parts])
    columns = pattern([frozenset(part) for part in parts])
    width = 1 + max((r - min(some) for r, some in enumerate(columns) if some), default=0)
    if is_written_in_vectors() and len(parts) > LEAST_ROWS and width <= MOST_WIDTH:
        return _factored_in_band(model, moves, factor, parts, weighted, width)
    scaled: list[dict] = []  # L D
    lower: list[dict] = []
    pivots: list = []
    for k in range(len(parts)):
        below = [r for r in range(k + 1, len(parts)) if k in columns[r]]
        entries = []
        for r in (k, *below):
            shared = sorted(parts[r].keys() & weighted[k].keys())
            entry = add(*(mul(parts[r][key], weighted[k][key]) for key in shared))
            for s in columns[k]:
                if r in lower[s]:
                    entry = sub(entry, mul(scaled[s][r], lower[s][k]))
            entries.append(entry)
        pivot, *rest = materialize(*entries)
        if not isinstance(pivot, jax.Array):  # nothing along this row can move, whatever the configuration
            pivot = jnp.full((), pivot, model.home.dtype)
        scaled.append(dict(zip(below, rest, strict=True)))
        lower.append(dict(zip(below, materialize(*(mul(x, 1 / pivot) for x in rest)), strict=True)))
        pivots.append(pivot)
    return Factored(moves, factor, parts, lower, pivots)


def _factored_in_band(model: Model, moves, factor: Factor, parts, weighted, width: int) -> Factored:
    """The same from the entries of the rows' matrix, all of which are no further than that from its diagonal."""

    def entry(r, k):
        shared = sorted(parts[r].keys() & weighted[k].keys()) if k >= 0 else ()
        return jnp.asarray(add(*(mul(parts[r][key], weighted[k][key]) for key in shared)), model.home.dtype)

    band = banded_factor([[entry(r, k) for k in range(r - width + 1, r + 1)] for r in range(len(parts))])
    return Factored(moves, factor, parts, [], [row[-1] for row in band], band)


def solve(model: Model, f: Factored, tau, wrenches, wanted, like):
    """a and lam with M a = tau - (forces that the wrenches ask for) + A^T lam, A a = wanted."""
    residual = inward(model, f.moves, f.factor, split(tau, model.topology.v_slices), wrenches)
    free = keep_all(
        [[mul(x, d) for x, d in zip(*pair, strict=True)] for pair in zip(residual, f.factor.inverses, strict=True)]
    )
    x = [
        sub(w, add(*(mul(u, free[i][j]) for (i, j), u in part.items())))
        for w, part in zip(wanted, f.parts, strict=True)
    ]
    x = _multipliers(f, x) if f.band is None else banded_solution(f.band, [jnp.asarray(y, like.dtype) for y in x])
    for part, multiplier in zip(f.parts, x, strict=True):
        for (i, j), u in part.items():
            residual[i][j] = add(residual[i][j], mul(u, multiplier))
    return stack(outward(model, f.moves, f.factor, keep_all(residual)), like), stack([x], like)


def _multipliers(f: Factored, x: list) -> list:
    """The solution of L D L^T y = x."""
    for k in range(len(x)):
        x[k] = materialize(x[k])[0]
        for r, entry in f.lower[k].items():
            x[r] = sub(x[r], mul(entry, x[k]))
    for k in reversed(range(len(x))):
        x[k] = materialize(sub(x[k] / f.pivots[k], add(*(mul(entry, x[r]) for r, entry in f.lower[k].items()))))[0]
    return x


def _prepared(model: Model, loops, q, v):
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    closed = close(model, loops)
    walk = Walk(model, moves, v)
    rows = [(loop, *row) for loop in closed for row in rows_of(loop, walk, q.dtype)]
    pending = [pending_of(loop, pair) for loop, pair, _ in rows]
    found = factored(model, moves, factorize(model, bodies, moves), pending)
    return bodies, moves, found, [sub(0, rate) for _, _, rate in rows]


def closed_dynamics(model: Model, loops, q, v, tau) -> tuple[Array, Array, Array]:
    """Acceleration (nv,), multipliers (nc,) and the least pivot of the rows' matrix over its largest one, ()."""
    bodies, moves, known, wanted = _prepared(model, loops, q, v)
    a, lam = solve(model, known, tau, body_wrenches(model, bodies, moves, v), wanted, q)
    pivots = jnp.stack(known.pivots)
    return a, lam, jnp.min(pivots) / jnp.max(pivots)


def closed_tangent(model: Model, loops, q, v, tau, change):
    """(a, lam) of `closed_dynamics`, and the change of them that `change(a, lam)` of the forces and along the rows makes."""
    bodies, moves, known, wanted = _prepared(model, loops, q, v)
    a, lam = solve(model, known, tau, body_wrenches(model, bodies, moves, v), wanted, q)
    force, along = change(a, lam)
    return (a, lam), solve(model, known, force, None, list(along), q)


def closed_inverse(model: Model, loops, q, v, a, lam) -> tuple[Array, Array]:
    """Forces tau (nv,) that the motion needs beside the multipliers, and the accelerations along the rows (nc,)."""
    bodies = canonical_bodies(model)
    moves = place_joints(model, bodies, q)
    walk = Walk(model, moves, v, a)
    total = list(body_wrenches(model, bodies, moves, v, a))
    rates, k = [], 0
    for loop in close(model, loops):
        for pair, rate in rows_of(loop, walk, q.dtype):
            for body, wrench in pending_of(loop, pair).items():
                total[body] = tuple(vsub(x, scale(lam[k], y)) for x, y in zip(total[body], wrench, strict=True))
            rates.append(rate)
            k += 1
    tau = stack(joint_forces(model, moves, total), q)
    return tau if model.armature is None else tau + model.armature * a, stack([rates], q)
