"""Articulated-body inertias: the factorisation of M over the tree, and M^-1 times a vector by two sweeps."""

from typing import NamedTuple

import numpy as np

from jaxdyn._links import (
    Body,
    Moved,
    keep,
    keep_matrix,
    numbers,
    power,
    split,
    twist_to_child,
    wrench_to_parent,
)
from jaxdyn._materialize import materialize
from jaxdyn._scalar import (
    UPPER,
    ZERO3,
    add,
    apply,
    cross,
    dot,
    is_identity,
    is_zero,
    matmul,
    mul,
    scale,
    sub,
    symmetric_rows,
    transpose,
    vadd,
    vanishes,
)
from jaxdyn._tracing import is_concrete
from jaxdyn.model import Model


class Factor(NamedTuple):
    """M = L D L^T found body by body: per body, one pivot per degree of freedom in the order of elimination."""

    gains: list  # U/D per pivot, ((lin), (ang)), in the child's frame
    inverses: list  # 1/D per pivot


def rigid_inertia(body: Body):
    """Blocks of a body's spatial inertia: linear-linear (six), linear-angular (3x3) = -hat(h), angular-angular (six)."""
    m, (hx, hy, hz) = body.mass, body.first
    return (m, 0, 0, m, 0, m), ((0, hz, sub(0, hy)), (sub(0, hz), 0, hx), (hy, sub(0, hx), 0)), body.inertia


def inertia_times(inertia, column):
    """Wrench of a twist under an articulated inertia."""
    lin, mixed, ang = inertia
    v, w = column
    return (
        vadd(apply(symmetric_rows(lin), v), apply(mixed, w)),
        vadd(apply(transpose(mixed), v), apply(symmetric_rows(ang), w)),
    )


def _eliminate(inertia, column, armature):
    """One pivot of an articulated inertia: I - U U^T/D with U = I S, D = S^T U + armature; also U/D and 1/D.

    Along a coordinate that S spans alone, the remainder vanishes identically unless there is armature.
    """
    u = inertia_times(inertia, column)
    inverse = materialize(1 / add(power(column, u), armature))[0]
    gain = tuple(keep(scale(inverse, part)) for part in u)
    spanned = [k for k, x in enumerate(column[0] + column[1]) if not is_zero(x)]
    gone = spanned[0] if len(spanned) == 1 and is_zero(armature) else -1
    flat_u, flat_g = u[0] + u[1], gain[0] + gain[1]

    def left(entry, r, c):
        return 0 if gone in (r, c) else sub(entry, mul(flat_u[r], flat_g[c]))

    lin, mixed, ang = inertia
    rest = (
        tuple(left(x, r, c) for x, (r, c) in zip(lin, UPPER, strict=True)),
        tuple(tuple(left(mixed[r][c], r, 3 + c) for c in range(3)) for r in range(3)),
        tuple(left(x, 3 + r, 3 + c) for x, (r, c) in zip(ang, UPPER, strict=True)),
    )
    return rest, gain, inverse


def keep_inertia(inertia):
    lin, mixed, ang = inertia
    flat = materialize(*lin, *(x for row in mixed for x in row), *ang)
    return tuple(flat[:6]), tuple(tuple(flat[6 + 3 * r : 9 + 3 * r]) for r in range(3)), tuple(flat[15:])


def _turn_symmetric(rotation, six):
    """E A E^T for a symmetric A."""
    half = matmul(rotation, symmetric_rows(six))
    return tuple(dot(half[r], rotation[c]) for r, c in UPPER)


def inertia_to_parent(moved: Moved, inertia):
    """Articulated inertia in the parent's frame: turned by E, then moved by r.

    With twists (v + w x r, w) at the child: H' = H - A hat(r), I' = I + hat(r) H' - H^T hat(r).
    """
    e = moved.rotation
    lin = _turn_symmetric(e, inertia[0])
    mixed = matmul(matmul(e, inertia[1]), transpose(e))
    ang = _turn_symmetric(e, inertia[2])
    if not is_identity(e):
        lin, mixed, ang = keep_inertia((lin, mixed, ang))
    r = moved.shift
    if vanishes(r):
        return lin, mixed, ang
    rows = symmetric_rows(lin)
    # Row by row, A hat(r) = -(r x A)^T: (A hat(r)) w = A (r x w).
    shifted = tuple(vadd(h, cross(r, a)) for h, a in zip(mixed, rows, strict=True))
    shifted = keep_matrix(shifted)
    columns = transpose(shifted)
    outer = transpose(tuple(cross(r, column) for column in columns))  # hat(r) H'
    inner = tuple(cross(r, row) for row in transpose(mixed))  # -H^T hat(r), row by row
    return lin, shifted, tuple(add(x, outer[i][j], inner[i][j]) for x, (i, j) in zip(ang, UPPER, strict=True))


def armatures_of(model: Model):
    if model.armature is None:
        return [[0] * (part.stop - part.start) for part in model.topology.v_slices]
    concrete = is_concrete(model.armature)
    entries = numbers(np.asarray(model.armature) if concrete else model.armature, concrete)
    return split(entries, model.topology.v_slices)


def factorize(model: Model, bodies, moves) -> Factor:
    """Articulated inertias from the leaves to the root, and the pivots met on the way."""
    total: list = [rigid_inertia(body) for body in bodies]
    gains: list = [None] * model.nb
    inverses: list = [None] * model.nb
    armatures = armatures_of(model)
    for i in reversed(range(model.nb)):
        inertia = total[i]
        gains[i], inverses[i] = [], []
        for column, armature in zip(moves[i].columns, armatures[i], strict=True):
            inertia, gain, inverse = _eliminate(inertia, column, armature)
            gains[i].append(gain)
            inverses[i].append(inverse)
        parent = model.topology.parents[i]
        if parent >= 0:
            lin, mixed, ang = inertia_to_parent(moves[i], inertia)
            old = total[parent]
            total[parent] = keep_inertia(
                (vadd(old[0], lin), tuple(vadd(a, b) for a, b in zip(old[1], mixed, strict=True)), vadd(old[2], ang))
            )
    return Factor(gains, inverses)


def solve(model: Model, moves, factor: Factor, tau, wrenches=None):
    """M^-1 (tau - forces that `wrenches` on the bodies ask for): inward for the residual forces, outward for accelerations."""
    return outward(model, moves, factor, inward(model, moves, factor, tau, wrenches))


def inward(model: Model, moves, factor: Factor, tau, wrenches=None):
    """What is left of tau at each joint once the wrenches on the bodies that it carries have been met: D^(1/2) W^-1 tau."""
    topology = model.topology
    bias: list = list(wrenches) if wrenches is not None else [(ZERO3, ZERO3)] * model.nb
    residual: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        flat = materialize(*bias[i][0], *bias[i][1])
        force = (tuple(flat[:3]), tuple(flat[3:]))
        residual[i] = []
        for j, column in enumerate(moves[i].columns):
            u = materialize(sub(tau[i][j], power(column, force)))[0]
            residual[i].append(u)
            gain = factor.gains[i][j]
            force = (vadd(force[0], scale(u, gain[0])), vadd(force[1], scale(u, gain[1])))
        parent = topology.parents[i]
        if parent >= 0:
            if len(moves[i].columns) > 1:
                force = tuple(keep(part) for part in force)
            up = wrench_to_parent(moves[i], force)
            bias[parent] = (vadd(bias[parent][0], up[0]), vadd(bias[parent][1], up[1]))
    return residual


def outward(model: Model, moves, factor: Factor, residual):
    """Accelerations of the joints from what `inward` left at each."""
    topology = model.topology
    twists: list = [None] * model.nb
    out: list = [None] * model.nb
    carries = {parent for parent in topology.parents}
    for i, parent in enumerate(topology.parents):
        twist = twist_to_child(moves[i], twists[parent]) if parent >= 0 else (ZERO3, ZERO3)
        if parent >= 0:
            twist = tuple(keep(part) for part in twist)
        out[i] = [0] * len(moves[i].columns)
        for j in reversed(range(len(moves[i].columns))):
            gain, column = factor.gains[i][j], moves[i].columns[j]
            x = materialize(sub(mul(residual[i][j], factor.inverses[i][j]), power(gain, twist)))[0]
            out[i][j] = x
            if i in carries or j:
                twist = (vadd(twist[0], scale(x, column[0])), vadd(twist[1], scale(x, column[1])))
        if i in carries:
            flat = materialize(*twist[0], *twist[1])
            twists[i] = (tuple(flat[:3]), tuple(flat[3:]))
    return out
