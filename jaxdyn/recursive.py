"""The recursions over the tree, body by body, in single numbers: RNEA, CRBA, ABA and the square root of M.

Link frames as in EQUATIONS sections 4 and 5, for trees and joints of any kind. Two choices make them fast in batches:

- The recursion runs in *canonical* frames, turned so that a screw joint's axis is z. Transforms between bodies then are full
  of zeros and ones, which are left out (see `_scalar`). Zeros are read off leaves whose values are known while tracing; leaves
  that are traced (differentiated, batched or passed through `jit`) count as general numbers, so nothing can go stale.
- Values with several consumers are computed once (see `_materialize`).

Under `jax.vmap` every number is a vector over the batch. This module and `matrix_form` check each other: neither imports the
other.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn._materialize import materialize
from jaxdyn._scalar import (
    EYE3, UPPER, ZERO3, add, apply, cross, dot, is_identity, is_zero, matmul, mul, scale, sub, symmetric_rows, transpose, vadd, vanishes, vsub,
)
from jaxdyn._trig import sin_cos
from jaxdyn.joints import SCREW_KINDS
from jaxdyn.model import Model, geometry

Scalar = Any  # an array of shape () or a structural Python number


class _Body(NamedTuple):
    """Numbers of one body in canonical frames."""

    rotation: tuple  # home rotation, 3x3: child axes in parent axes
    shift: tuple  # home position in the parent frame
    rate: Scalar  # length of the screw's direction (1 for a unit screw)
    slide: tuple  # linear part of a screw joint's subspace in the child frame
    mass: Scalar
    first: tuple  # first moment of mass
    inertia: tuple  # six numbers about the origin, in the order of `_scalar.UPPER`


class _Moved(NamedTuple):
    """A joint at one configuration."""

    rotation: tuple  # E, child axes in parent axes
    shift: tuple  # child origin in the parent frame
    columns: tuple  # motion subspace: ((v, omega), ...) in the child frame


def _aligning(axes, xp):
    """Rotations (n, 3, 3) whose third column is the given unit axis (n, 3); smooth except where the axis turns down.

    The orthonormal basis of Duff et al. 2017 (J. Computer Graphics Techniques 6(1), listing 3): no root, no division by zero.
    """
    x, y, z = axes[:, 0], axes[:, 1], axes[:, 2]
    sign = xp.where(z < 0, xp.full_like(z, -1.0), xp.full_like(z, 1.0))
    a = -1.0 / (sign + z)
    b = x * y * a
    first = xp.stack([1.0 + sign * x * x * a, sign * b, -sign * x], 1)
    second = xp.stack([b, sign + y * y * a, -y], 1)
    return xp.stack([first, second, axes], 2)


def _is_concrete(*leaves) -> bool:
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


def _canonical(model: Model):
    """Home poses, screws and inertias in canonical frames, as arrays; by numpy where the values are known."""
    topology = model.topology
    if _is_concrete(model.home, model.screws):
        xp, home, screws = np, np.asarray(model.home), np.asarray(model.screws) * topology.screw_mask
    else:
        xp, (home, screws) = jnp, geometry(model)
    angular = np.array([kind in SCREW_KINDS and kind != "prismatic" for kind in topology.kinds])
    linear = np.array([kind == "prismatic" for kind in topology.kinds])
    up = xp.asarray(np.eye(3)[2:], home.dtype)
    direction = xp.where(angular[:, None], screws[:, 3:], xp.where(linear[:, None], screws[:, :3], up))
    rate = xp.sqrt(xp.sum(direction**2, 1))
    turn = _aligning(direction / rate[:, None], xp)
    turn_t = xp.swapaxes(turn, 1, 2)
    outer = xp.concatenate([turn_t, xp.eye(3, dtype=home.dtype)[None]])[np.array(topology.parents, int)]
    rotation = outer @ home[:, :3, :3] @ turn
    shift = (outer @ home[:, :3, 3:])[..., 0]
    slide = (turn_t @ screws[:, :3, None])[..., 0]
    known = xp is np and _is_concrete(model.inertias)
    inertias = np.asarray(model.inertias) if known else model.inertias
    first = (turn_t @ inertias[:, 1:4, None])[..., 0]
    full = inertias[:, 4:][:, np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])]
    inertia = (turn_t @ full @ turn)[:, np.array(UPPER)[:, 0], np.array(UPPER)[:, 1]]
    return (xp is np, rotation, shift, rate, slide), (known, inertias[:, 0], first, inertia)


def _numbers(array, concrete: bool, rounding: float = 0.0):
    """Nested tuples of the entries; known ones become Python numbers, those within `rounding` of 0, 1, -1 integers."""
    if array.ndim:
        return tuple(_numbers(array[i], concrete, rounding) for i in range(array.shape[0]))
    if not concrete:
        return array
    value = float(array)
    near = round(value) if abs(value) < 2 else 2
    return near if abs(near) < 2 and abs(value - near) <= rounding else value


def _bodies(model: Model) -> list[_Body]:
    (placed, rotation, shift, rate, slide), (weighed, mass, first, inertia) = _canonical(model)
    eps = 4 * float(np.finfo(model.home.dtype).eps)
    return [
        _Body(
            _numbers(rotation[i], placed, eps),
            _numbers(shift[i], placed),
            _numbers(rate[i], placed, eps),
            _numbers(slide[i], placed) if kind == "helical" else ZERO3,
            _numbers(mass[i], weighed),
            _numbers(first[i], weighed),
            _numbers(inertia[i], weighed),
        )
        for i, kind in enumerate(model.topology.kinds)
    ]


def _quaternion_rotation(quat):
    """Rotation matrix of a quaternion (w, x, y, z), divided by its squared norm."""
    w, x, y, z = quat
    s = 2 / (w * w + x * x + y * y + z * z)
    wx, wy, wz, xx, xy, xz, yy, yz, zz = (
        s * w * x, s * w * y, s * w * z, s * x * x, s * x * y, s * x * z, s * y * y, s * y * z, s * z * z,
    )  # fmt: skip
    return ((1 - (yy + zz), xy - wz, xz + wy), (xy + wz, 1 - (xx + zz), yz - wx), (xz - wy, yz + wx, 1 - (xx + yy)))


def _unit(i):
    """Column i of the identity as a twist ((v), (omega))."""
    return tuple(int(k == i) for k in range(3)), tuple(int(k == i) for k in range(3, 6))


def _move(body: _Body, kind: str, q) -> _Moved:
    """Place a joint at q (a list of numbers): transform to the parent and motion subspace."""
    relative, step, columns = EYE3, ZERO3, ()
    if kind in SCREW_KINDS:
        angle = mul(body.rate, q[0])
        if kind == "prismatic":
            columns, step = ((scale(body.rate, (0, 0, 1)), ZERO3),), (0, 0, angle)
        else:
            s, c = materialize(*sin_cos(angle))
            relative = ((c, -s, 0), (s, c, 0), (0, 0, 1))
            columns = ((body.slide, scale(body.rate, (0, 0, 1))),)
            if kind == "helical":
                # exp of the screw: (1 - R)(w x v)/|w|^2 + w (w.v) q/|w|^2, with w = rate e_z.
                lever = cross((0, 0, 1), body.slide)
                turned = vsub(lever, apply(relative, lever))
                inverse = body.rate if type(body.rate) is int else 1 / body.rate
                step = vadd(scale(inverse, turned), (0, 0, mul(body.slide[2], q[0])))
    elif kind == "planar":
        s, c = materialize(*sin_cos(q[2]))
        relative, step = ((c, -s, 0), (s, c, 0), (0, 0, 1)), (q[0], q[1], 0)
        columns = (_unit(0), _unit(1), _unit(5))
    elif kind == "spherical":
        relative, columns = _quaternion_rotation(q), tuple(_unit(k) for k in (3, 4, 5))
    else:
        relative, step, columns = _quaternion_rotation(q[3:]), tuple(q[:3]), tuple(_unit(k) for k in range(6))
    rotation = _keep_matrix(matmul(body.rotation, relative))
    shift = vadd(body.shift, apply(body.rotation, step))
    return _Moved(rotation, shift if vanishes(step) else _keep(shift), columns)


def _keep(vector):
    return tuple(materialize(*vector))


def _keep_matrix(rows):
    flat = materialize(*(entry for row in rows for entry in row))
    width = len(rows[0])
    return tuple(tuple(flat[i : i + width]) for i in range(0, len(flat), width))


def _split(array, slices):
    """Entries of a vector, grouped by joint."""
    return [[array[k] for k in range(part.start, part.stop)] for part in slices]


def _moves(model: Model, bodies, q):
    groups = _split(q, model.topology.q_slices)
    return [_move(body, kind, qj) for body, kind, qj in zip(bodies, model.topology.kinds, groups, strict=True)]


def _combine(columns, coefficients):
    """Twist sum of columns times coefficients, as ((v), (omega))."""
    v, w = ZERO3, ZERO3
    for (lin, ang), x in zip(columns, coefficients, strict=True):
        v, w = vadd(v, scale(x, lin)), vadd(w, scale(x, ang))
    return v, w


def _dot6(column, wrench):
    """Power of a wrench ((f), (n)) on a twist ((v), (omega))."""
    return add(dot(column[0], wrench[0]), dot(column[1], wrench[1]))


def _to_parent(moved: _Moved, wrench):
    """A wrench on the child, given at the child's origin in its axes, in the parent's: (E f, E n + r x E f)."""
    force = apply(moved.rotation, wrench[0])
    return force, vadd(apply(moved.rotation, wrench[1]), cross(moved.shift, force))


def _to_child(moved: _Moved, twist):
    """A twist of the parent, in the parent's frame, in the child's: (E^T (v + w x r), E^T w)."""
    down = transpose(moved.rotation)
    return apply(down, vadd(twist[0], cross(twist[1], moved.shift))), apply(down, twist[1])


def _body_wrenches(model: Model, bodies, moves, v, a=None):
    """Wrench that each body's motion needs, gravity included: the outward pass of Newton-Euler (EQUATIONS section 4).

    Linear accelerations are those of the frame's origin as a point (not of the spatial velocity), so that the velocity of
    the origin is never needed. `a=None` stands for zero joint accelerations and costs nothing.
    """
    topology = model.topology
    gravity = ZERO3 if model.gravity is None else _numbers(
        np.asarray(model.gravity) if _is_concrete(model.gravity) else model.gravity, _is_concrete(model.gravity)
    )  # fmt: skip
    speeds = _split(v, topology.v_slices) if v is not None else None
    rates = _split(a, topology.v_slices) if a is not None else None
    spin, swirl, lift, wrenches = [], [], [], []
    for i, (parent, moved, body) in enumerate(zip(topology.parents, moves, bodies, strict=True)):
        down = transpose(moved.rotation)
        w_parent, dw_parent, acc_parent = (
            (spin[parent], swirl[parent], lift[parent]) if parent >= 0 else (ZERO3, ZERO3, scale(-1, gravity))
        )
        carried = apply(down, w_parent)
        # Centripetal and Euler terms at the child's origin: w x (w x r) + dw x r.
        r = moved.shift
        inward = cross(w_parent, cross(w_parent, r))
        acc = vadd(acc_parent, cross(dw_parent, r), inward)
        acc = apply(down, acc if vanishes(inward) else _keep(acc))
        dw = apply(down, dw_parent)
        w = carried
        if speeds is not None:
            v_rel, w_rel = _combine(moved.columns, speeds[i])
            w = vadd(w, w_rel)
            dw = vadd(dw, cross(carried, w_rel))
            acc = vadd(acc, scale(2, cross(carried, v_rel)), cross(w_rel, v_rel))
        if rates is not None:
            dv_rel, dw_rel = _combine(moved.columns, rates[i])
            dw, acc = vadd(dw, dw_rel), vadd(acc, dv_rel)
        flat = materialize(*w, *dw, *acc)
        w, dw, acc = tuple(flat[:3]), tuple(flat[3:6]), tuple(flat[6:])
        h = body.first
        force = vadd(scale(body.mass, acc), cross(dw, h), vsub(scale(dot(w, h), w), scale(dot(w, w), h)))
        rows = symmetric_rows(body.inertia)
        moment = vadd(apply(rows, dw), cross(w, apply(rows, w)), cross(h, acc))
        spin.append(w), swirl.append(dw), lift.append(acc)
        wrenches.append((force, moment))
    return wrenches


def _joint_forces(model: Model, moves, wrenches):
    """Inward pass: tau_i = S_i^T (sum of the wrenches of the bodies that joint i carries)."""
    total = list(wrenches)
    tau: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        flat = materialize(*total[i][0], *total[i][1])
        total[i] = (tuple(flat[:3]), tuple(flat[3:]))
        tau[i] = [_dot6(column, total[i]) for column in moves[i].columns]
        parent = model.topology.parents[i]
        if parent >= 0:
            force, moment = _to_parent(moves[i], total[i])
            total[parent] = (vadd(total[parent][0], force), vadd(total[parent][1], moment))
    return tau


def _stack(groups, like):
    """A vector (nv,) from numbers grouped by joint."""
    entries = materialize(*(x for group in groups for x in group))
    if not entries:
        return jnp.zeros((0,), like.dtype)
    return jnp.stack([jnp.asarray(x, like.dtype) if not isinstance(x, jax.Array) else x for x in entries])


# --- articulated bodies ------------------------------------------------------------------------------------------------


class _Factor(NamedTuple):
    """M = L D L^T found body by body: per body, one pivot per degree of freedom in the order of elimination."""

    gains: list  # U/D per pivot, ((lin), (ang)), in the child's frame
    inverses: list  # 1/D per pivot


def _rigid(body: _Body):
    """Blocks of a body's spatial inertia: linear-linear (six), linear-angular (3x3) = -hat(h), angular-angular (six)."""
    m, (hx, hy, hz) = body.mass, body.first
    return (m, 0, 0, m, 0, m), ((0, hz, sub(0, hy)), (sub(0, hz), 0, hx), (hy, sub(0, hx), 0)), body.inertia


def _times(inertia, column):
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
    u = _times(inertia, column)
    inverse = materialize(1 / add(_dot6(column, u), armature))[0]
    gain = tuple(_keep(scale(inverse, part)) for part in u)
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


def _keep_inertia(inertia):
    lin, mixed, ang = inertia
    flat = materialize(*lin, *(x for row in mixed for x in row), *ang)
    return tuple(flat[:6]), tuple(tuple(flat[6 + 3 * r : 9 + 3 * r]) for r in range(3)), tuple(flat[15:])


def _turn_symmetric(rotation, six):
    """E A E^T for a symmetric A."""
    half = matmul(rotation, symmetric_rows(six))
    return tuple(dot(half[r], rotation[c]) for r, c in UPPER)


def _inertia_to_parent(moved: _Moved, inertia):
    """Articulated inertia in the parent's frame: turned by E, then moved by r.

    With twists (v + w x r, w) at the child: H' = H - A hat(r), I' = I + hat(r) H' - H^T hat(r).
    """
    e = moved.rotation
    lin = _turn_symmetric(e, inertia[0])
    mixed = matmul(matmul(e, inertia[1]), transpose(e))
    ang = _turn_symmetric(e, inertia[2])
    if not is_identity(e):
        lin, mixed, ang = _keep_inertia((lin, mixed, ang))
    r = moved.shift
    if vanishes(r):
        return lin, mixed, ang
    rows = symmetric_rows(lin)
    # Row by row, A hat(r) = -(r x A)^T: (A hat(r)) w = A (r x w).
    shifted = tuple(vadd(h, cross(r, a)) for h, a in zip(mixed, rows, strict=True))
    shifted = _keep_matrix(shifted)
    columns = transpose(shifted)
    outer = transpose(tuple(cross(r, column) for column in columns))  # hat(r) H'
    inner = tuple(cross(r, row) for row in transpose(mixed))  # -H^T hat(r), row by row
    return lin, shifted, tuple(add(x, outer[i][j], inner[i][j]) for x, (i, j) in zip(ang, UPPER, strict=True))


def _armatures(model: Model):
    if model.armature is None:
        return [[0] * (part.stop - part.start) for part in model.topology.v_slices]
    concrete = _is_concrete(model.armature)
    numbers = _numbers(np.asarray(model.armature) if concrete else model.armature, concrete)
    return _split(numbers, model.topology.v_slices)


def _factor(model: Model, bodies, moves) -> _Factor:
    """Articulated inertias from the leaves to the root, and the pivots met on the way."""
    total: list = [_rigid(body) for body in bodies]
    gains: list = [None] * model.nb
    inverses: list = [None] * model.nb
    armatures = _armatures(model)
    for i in reversed(range(model.nb)):
        inertia = total[i]
        gains[i], inverses[i] = [], []
        for column, armature in zip(moves[i].columns, armatures[i], strict=True):
            inertia, gain, inverse = _eliminate(inertia, column, armature)
            gains[i].append(gain), inverses[i].append(inverse)
        parent = model.topology.parents[i]
        if parent >= 0:
            lin, mixed, ang = _inertia_to_parent(moves[i], inertia)
            old = total[parent]
            total[parent] = _keep_inertia(
                (vadd(old[0], lin), tuple(vadd(a, b) for a, b in zip(old[1], mixed, strict=True)), vadd(old[2], ang))
            )
    return _Factor(gains, inverses)


def _solve(model: Model, moves, factor: _Factor, tau, wrenches=None):
    """M^-1 (tau - forces that `wrenches` on the bodies ask for): inward for the residual forces, outward for accelerations."""
    topology = model.topology
    bias: list = list(wrenches) if wrenches is not None else [(ZERO3, ZERO3)] * model.nb
    residual: list = [None] * model.nb
    for i in reversed(range(model.nb)):
        flat = materialize(*bias[i][0], *bias[i][1])
        force = (tuple(flat[:3]), tuple(flat[3:]))
        residual[i] = []
        for j, column in enumerate(moves[i].columns):
            u = materialize(sub(tau[i][j], _dot6(column, force)))[0]
            residual[i].append(u)
            gain = factor.gains[i][j]
            force = (vadd(force[0], scale(u, gain[0])), vadd(force[1], scale(u, gain[1])))
        parent = topology.parents[i]
        if parent >= 0:
            if len(moves[i].columns) > 1:
                force = tuple(_keep(part) for part in force)
            up = _to_parent(moves[i], force)
            bias[parent] = (vadd(bias[parent][0], up[0]), vadd(bias[parent][1], up[1]))
    twists: list = [None] * model.nb
    out: list = [None] * model.nb
    carries = {parent for parent in topology.parents}
    for i, parent in enumerate(topology.parents):
        twist = _to_child(moves[i], twists[parent]) if parent >= 0 else (ZERO3, ZERO3)
        if parent >= 0:
            twist = tuple(_keep(part) for part in twist)
        out[i] = [0] * len(moves[i].columns)
        for j in reversed(range(len(moves[i].columns))):
            gain, column = factor.gains[i][j], moves[i].columns[j]
            x = materialize(sub(mul(residual[i][j], factor.inverses[i][j]), _dot6(gain, twist)))[0]
            out[i][j] = x
            if i in carries or j:
                twist = (vadd(twist[0], scale(x, column[0])), vadd(twist[1], scale(x, column[1])))
        if i in carries:
            flat = materialize(*twist[0], *twist[1])
            twists[i] = (tuple(flat[:3]), tuple(flat[3:]))
    return out


def rnea(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Inverse dynamics tau = M a + C v + N by the recursive Newton-Euler algorithm.

    **Arguments:** `q` (nq,); `v`, `a` (nv,) joint velocities and accelerations.

    **Returns:** generalised forces (nv,), N m or N. Armature included.

    Source: EQUATIONS section 4; Luh, Walker & Paul 1980.
    """
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    tau = _joint_forces(model, moves, _body_wrenches(model, bodies, moves, v, a))
    out = _stack(tau, q)
    return out if model.armature is None else out + model.armature * a


def bias_force(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Bias force C v + N (nv,): `rnea` at zero acceleration, whose terms are not computed."""
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    return _stack(_joint_forces(model, moves, _body_wrenches(model, bodies, moves, v)), q)


def aba(model: Model, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """Forward dynamics a = M^-1 (tau - C v - N) by the articulated-body algorithm.

    Velocity terms are gathered outward as the wrenches that zero joint accelerations would need, so that the inward and
    outward sweeps are those of a plain M^-1 (EQUATIONS section 5 with b_i started from the bias wrench; Featherstone 2008,
    section 7.3).

    **Arguments:** `q` (nq,); `v` (nv,); `tau` (nv,) generalised forces.

    **Returns:** joint accelerations (nv,). NaN or infinite where M is singular.
    """
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    wrenches = _body_wrenches(model, bodies, moves, v)
    factor = _factor(model, bodies, moves)
    return _stack(_solve(model, moves, factor, _split(tau, model.topology.v_slices), wrenches), q)


def mass_matrix_inverse_times(model: Model, q: Float[Array, " nq"], forces: Float[Array, " nv"]) -> Float[Array, " nv"]:
    """M(q)^-1 times a vector of generalised forces, without forming M: two sweeps over the articulated bodies."""
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    return _stack(_solve(model, moves, _factor(model, bodies, moves), _split(forces, model.topology.v_slices)), q)


def aba_tangent(model: Model, q, v, tau, force_change):
    """Forward dynamics a and M^-1 times `force_change(a)` (nv,), both from one factorisation of M.

    With ID(q, v, a) = tau, a change of (model, q, v, tau) changes a by M^-1 (dtau - dID at fixed a); `force_change` returns the
    bracket. In reverse this costs one more M^-1 and one reverse pass of RNEA, instead of a reverse pass of ABA.
    """
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    wrenches = _body_wrenches(model, bodies, moves, v)
    factor = _factor(model, bodies, moves)
    slices = model.topology.v_slices
    a = _stack(_solve(model, moves, factor, _split(tau, slices), wrenches), q)
    return a, _stack(_solve(model, moves, factor, _split(force_change(a), slices)), q)


def crba(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Mass matrix M(q) (nv, nv) by the composite-rigid-body algorithm, armature included.

    Entries between joints on different branches are zeros that are never computed.

    Source: Featherstone 2008, table 6.2.
    """
    topology = model.topology
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    total: list = [_rigid(body) for body in bodies]
    entries: dict = {}
    armatures = _armatures(model)
    for i in reversed(range(model.nb)):
        parent = topology.parents[i]
        if parent >= 0:
            up = _inertia_to_parent(moves[i], total[i])
            old = total[parent]
            total[parent] = _keep_inertia(
                (vadd(old[0], up[0]), tuple(vadd(x, y) for x, y in zip(old[1], up[1], strict=True)), vadd(old[2], up[2]))
            )
        start = topology.v_slices[i].start
        for j, column in enumerate(moves[i].columns):
            force = _times(total[i], column)
            for k, other in enumerate(moves[i].columns[: j + 1]):
                extra = armatures[i][j] if k == j else 0
                entries[start + j, start + k] = add(_dot6(other, force), extra)
            at = i
            while topology.parents[at] >= 0:
                flat = materialize(*force[0], *force[1])
                force = _to_parent(moves[at], (tuple(flat[:3]), tuple(flat[3:])))
                at = topology.parents[at]
                for k, other in enumerate(moves[at].columns):
                    entries[start + j, topology.v_slices[at].start + k] = _dot6(other, force)
    return _square(entries, model.nv, q, symmetric=True)


def _square(entries: dict, n: int, like, symmetric: bool):
    """Matrix (n, n) from a dictionary of its nonzero entries."""
    places = list(entries)
    values = _stack([[entries[place]] for place in places], like)
    rows, columns = (np.array([place[k] for place in places], int) for k in (0, 1))
    matrix = jnp.zeros((n, n), like.dtype).at[rows, columns].set(values)
    return matrix.at[columns, rows].set(values) if symmetric else matrix


def mass_matrix_sqrt(model: Model, q: Float[Array, " nq"]) -> Float[Array, "nv nv"]:
    """Square root W (nv, nv) of the mass matrix, M = W W^T, from the articulated bodies; no Cholesky factorisation.

    W = xi^T G^T Mh xi D^(-1/2): column k holds, for joint k and its ancestors, the force that U_k / sqrt(D_k) needs. Upper
    triangular for a chain (within a joint of several degrees of freedom, lower triangular). det M = prod W_kk^2.

    Source: EQUATIONS section 5; Rodriguez, Jain & Kreutz-Delgado 1992.
    """
    topology = model.topology
    bodies = _bodies(model)
    moves = _moves(model, bodies, q)
    factor = _factor(model, bodies, moves)
    entries: dict = {}
    for i in range(model.nb):
        start = topology.v_slices[i].start
        for j in range(len(moves[i].columns)):
            root = materialize(1 / jnp.sqrt(factor.inverses[i][j]))[0]
            gain = factor.gains[i][j]
            force = (scale(root, gain[0]), scale(root, gain[1]))
            entries[start + j, start + j] = root
            for k in range(j + 1, len(moves[i].columns)):
                entries[start + k, start + j] = _dot6(moves[i].columns[k], force)
            at = i
            while topology.parents[at] >= 0:
                flat = materialize(*force[0], *force[1])
                force = _to_parent(moves[at], (tuple(flat[:3]), tuple(flat[3:])))
                at = topology.parents[at]
                for k, other in enumerate(moves[at].columns):
                    entries[topology.v_slices[at].start + k, start + j] = _dot6(other, force)
    return _square(entries, model.nv, q, symmetric=False)
