"""One link and one joint of a recursion: canonical frames, the joint's transform, and how twists and wrenches cross it."""

from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jaxdyn._materialize import materialize
from jaxdyn._scalar import (
    EYE3,
    UPPER,
    ZERO3,
    add,
    apply,
    cross,
    dot,
    matmul,
    mul,
    scale,
    transpose,
    vadd,
    vanishes,
    vsub,
)
from jaxdyn._tracing import is_concrete
from jaxdyn._trig import sin_cos
from jaxdyn.joints import SCREW_KINDS
from jaxdyn.model import Model, geometry

Scalar = Any  # an array of shape () or a structural Python number


class Body(NamedTuple):
    """Numbers of one body in canonical frames."""

    rotation: tuple  # home rotation, 3x3: child axes in parent axes
    shift: tuple  # home position in the parent frame
    rate: Scalar  # length of the screw's direction (1 for a unit screw)
    slide: tuple  # linear part of a screw joint's subspace in the child frame
    mass: Scalar
    first: tuple  # first moment of mass
    inertia: tuple  # six numbers about the origin, in the order of `_scalar.UPPER`


class Moved(NamedTuple):
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


def _axes(model: Model):
    """Home poses, screws, their rates, and canonical axes in body axes, as arrays; by numpy where the values are known."""
    topology = model.topology
    if is_concrete(model.home, model.screws):
        xp, home, screws = np, np.asarray(model.home), np.asarray(model.screws) * topology.screw_mask
    else:
        xp, (home, screws) = jnp, geometry(model)
    angular = np.array([kind in SCREW_KINDS and kind != "prismatic" for kind in topology.kinds])
    linear = np.array([kind == "prismatic" for kind in topology.kinds])
    up = xp.asarray(np.eye(3)[2:], home.dtype)
    direction = xp.where(angular[:, None], screws[:, 3:], xp.where(linear[:, None], screws[:, :3], up))
    rate = xp.sqrt(xp.sum(direction**2, 1))
    return xp, home, screws, rate, _aligning(direction / rate[:, None], xp)


def _canonical(model: Model):
    """Home poses, screws and inertias in canonical frames, as arrays; by numpy where the values are known."""
    topology = model.topology
    xp, home, screws, rate, turn = _axes(model)
    turn_t = xp.swapaxes(turn, 1, 2)
    outer = xp.concatenate([turn_t, xp.eye(3, dtype=home.dtype)[None]])[np.array(topology.parents, int)]
    rotation = outer @ home[:, :3, :3] @ turn
    shift = (outer @ home[:, :3, 3:])[..., 0]
    slide = (turn_t @ screws[:, :3, None])[..., 0]
    known = xp is np and is_concrete(model.inertias)
    inertias = np.asarray(model.inertias) if known else model.inertias
    first = (turn_t @ inertias[:, 1:4, None])[..., 0]
    full = inertias[:, 4:][:, np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])]
    inertia = (turn_t @ full @ turn)[:, np.array(UPPER)[:, 0], np.array(UPPER)[:, 1]]
    return (xp is np, rotation, shift, rate, slide), (known, inertias[:, 0], first, inertia)


def canonical_poses(model: Model, bodies, poses) -> list:
    """Rotations and positions of poses (4, 4) given in bodies (-1: the world), in these bodies' canonical frames."""
    xp, *_, turn = _axes(model)
    known = xp is np and is_concrete(poses)
    found = []
    for body, pose in zip(bodies, poses, strict=True):
        pose = np.asarray(pose) if known else pose
        if body >= 0:
            pose = turn[body].T @ pose[:3]
        eps = 4 * float(np.finfo(model.home.dtype).eps)
        found.append((numbers(pose[:3, :3], known, eps), numbers(pose[:3, 3], known)))
    return found


def numbers(array, concrete: bool, rounding: float = 0.0) -> Any:
    """Nested tuples of the entries; known ones become Python numbers, those within `rounding` of 0, 1, -1 integers."""
    if array.ndim:
        return tuple(numbers(array[i], concrete, rounding) for i in range(array.shape[0]))
    if not concrete:
        return array
    value = float(array)
    near = round(value) if abs(value) < 2 else 2
    return near if abs(near) < 2 and abs(value - near) <= rounding else value


def canonical_bodies(model: Model) -> list[Body]:
    (placed, rotation, shift, rate, slide), (weighed, mass, first, inertia) = _canonical(model)
    eps = 4 * float(np.finfo(model.home.dtype).eps)
    return [
        Body(
            numbers(rotation[i], placed, eps),
            numbers(shift[i], placed),
            numbers(rate[i], placed, eps),
            numbers(slide[i], placed) if kind == "helical" else ZERO3,
            numbers(mass[i], weighed),
            numbers(first[i], weighed),
            numbers(inertia[i], weighed),
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


def _move(body: Body, kind: str, q) -> Moved:
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
    rotation = keep_matrix(matmul(body.rotation, relative))
    shift = vadd(body.shift, apply(body.rotation, step))
    return Moved(rotation, shift if vanishes(step) else keep(shift), columns)


def keep(vector):
    return tuple(materialize(*vector))


def keep_matrix(rows):
    flat = materialize(*(entry for row in rows for entry in row))
    width = len(rows[0])
    return tuple(tuple(flat[i : i + width]) for i in range(0, len(flat), width))


def split(array, slices):
    """Entries of a vector, grouped by joint."""
    return [[array[k] for k in range(part.start, part.stop)] for part in slices]


def place_joints(model: Model, bodies, q):
    groups = split(q, model.topology.q_slices)
    return [_move(body, kind, qj) for body, kind, qj in zip(bodies, model.topology.kinds, groups, strict=True)]


def combine(columns, coefficients):
    """Twist sum of columns times coefficients, as ((v), (omega))."""
    v, w = ZERO3, ZERO3
    for (lin, ang), x in zip(columns, coefficients, strict=True):
        v, w = vadd(v, scale(x, lin)), vadd(w, scale(x, ang))
    return v, w


def power(column, wrench):
    """Power of a wrench ((f), (n)) on a twist ((v), (omega))."""
    return add(dot(column[0], wrench[0]), dot(column[1], wrench[1]))


def wrench_to_parent(moved: Moved, wrench):
    """A wrench on the child, given at the child's origin in its axes, in the parent's: (E f, E n + r x E f)."""
    force = apply(moved.rotation, wrench[0])
    return force, vadd(apply(moved.rotation, wrench[1]), cross(moved.shift, force))


def twist_to_child(moved: Moved, twist):
    """A twist of the parent, in the parent's frame, in the child's: (E^T (v + w x r), E^T w)."""
    down = transpose(moved.rotation)
    return apply(down, vadd(twist[0], cross(twist[1], moved.shift))), apply(down, twist[1])


def stack(groups, like):
    """A vector (nv,) from numbers grouped by joint."""
    entries = materialize(*(x for group in groups for x in group))
    if not entries:
        return jnp.zeros((0,), like.dtype)
    return jnp.stack([jnp.asarray(x, like.dtype) if not isinstance(x, jax.Array) else x for x in entries])
