"""Changes of frame of twists, wrenches and inertias: a shift of the origin, then a rotation.

A pose is a chain of factors (r, R): translate the origin by r, then rotate the axes by R. The factors are kept
apart, because each is mostly zeros and ones, which cost nothing after expansion. With X = [[1, -hat(r)], [0, 1]]:

    twist to the child      V -> R^T X V          R here stands for diag(R, R)
    wrench to the parent    F -> X^T R F
    inertia to the parent   A -> X^T R A R^T X

A rotation in a coordinate plane transforms a symmetric matrix cheaply: in the 2 x 2 block of that plane only the traceless
symmetric part changes, and it rotates by twice the angle.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxdyn.dynamics.recursions._arrays import (
    constants,
    contract,
    dot,
    dot_transpose,
    entry,
    join,
    select,
    symmetric,
    transpose,
)

X, Z = 0, 2


def _extend(matrix: np.ndarray, size: int, last: float) -> np.ndarray:
    """Extend a 3 x 3 matrix to homogeneous points (4, `last` at the end) or twists (6, block diagonal)."""
    if size == 3:
        return matrix
    if size == 4:
        out = np.zeros((4, 4))
        out[:3, :3], out[3, 3] = matrix, last
        return out
    return np.kron(np.eye(2), matrix)


def _generator(axis: int) -> np.ndarray:
    """Generator hat(e) of rotations about a coordinate axis."""
    return constants(float).hat[:, :, axis]


class PlaneRotations:
    """Rotations about one coordinate axis by several angles, given by cosines and sines (n,)."""

    def __init__(self, axis: int, cos, sin):
        self.axis, self.cos, self.sin = axis, cos, sin
        self._cache: dict = {}

    def matrices(self, size: int):
        """Matrices (n, size, size): cos Pi + sin J + (1 - Pi), with J = hat(e) and the projector Pi = -J^2 on the plane."""
        if size not in self._cache:
            J = _generator(self.axis)
            one = np.ones(self.cos.shape, self.cos.dtype)
            basis = [_extend(-J @ J, size, 0.0), _extend(J, size, 0.0), _extend(np.eye(3) + J @ J, size, 1.0)]
            self._cache[size] = self._combine([self.cos, self.sin, one], basis)
        return self._cache[size]

    def double_angle(self, size: int):
        """Matrices (n, size, size) sin J R = sin cos J - sin^2 Pi, half the change of a rotation by twice the angle."""
        if -size not in self._cache:
            J = _generator(self.axis)
            basis = [_extend(J, size, 0.0), _extend(J @ J, size, 0.0)]
            self._cache[-size] = self._combine([self.sin * self.cos, self.sin * self.sin], basis)
        return self._cache[-size]

    def one(self, size: int, index: int, double_angle: bool = False):
        """Matrix (size, size) with one index of `matrices` or `double_angle`."""
        key = size, index, double_angle
        if key not in self._cache:
            self._cache[key] = entry(self.double_angle(size) if double_angle else self.matrices(size), index)
        return self._cache[key]

    def _combine(self, coefficients, basis):
        rows = join([x.reshape(1, -1) for x in coefficients], 0)
        return dot_transpose(rows, np.stack(basis).astype(self.cos.dtype))


class PlaneRotation(NamedTuple):
    """One of several rotations about a common coordinate axis."""

    all: PlaneRotations
    index: int

    def matrix(self, size: int):
        return self.all.one(size, self.index)

    def congruence(self, A):
        """Congruence R A R^T of a symmetric matrix."""
        size = A.shape[0]
        dtype = self.all.cos.dtype
        fixed = np.diag(_extend(np.eye(3) + _generator(self.all.axis) @ _generator(self.all.axis), size, 1.0)) > 0
        J = _extend(_generator(self.all.axis), size, 0.0).astype(dtype)
        # Only the plane's own block needs two products; rows and columns outside of it need one, and the corner none.
        plane = A + dot(self.all.one(size, self.index, double_angle=True), A + dot(dot(J, A), J))
        half = dot(self.matrix(size), A)
        columns, rows = (np.broadcast_to(x, (size, size)) for x in (fixed, fixed[:, None]))
        return symmetric(select(columns, half, select(rows, transpose(half), plane)))


class GeneralRotation:
    """General rotation, as a matrix (3, 3)."""

    def __init__(self, rotation):
        self.rotation = rotation
        self._cache = {3: rotation}

    def matrix(self, size: int):
        """Rotation of points (3), homogeneous points (4) or twists (6)."""
        if size not in self._cache:
            self._cache[size] = self._extend(size)
        return self._cache[size]

    def _extend(self, size: int):
        places = np.zeros((size, size, 3, 3))
        for i, j in np.ndindex(3, 3):
            places[:, :, i, j] = _extend(np.outer(np.eye(3)[i], np.eye(3)[j]), size, 0.0)
        spread = contract(places.astype(self.rotation.dtype), self.rotation, (2, 3), (0, 1))
        return spread + np.diag([0, 0, 0, 1]).astype(spread.dtype) if size == 4 else spread

    def congruence(self, A):
        """Congruence R A R^T of a symmetric matrix."""
        R = self.matrix(A.shape[0])
        return symmetric(contract(dot(R, A), R, (1,), (1,)))


class Transform(NamedTuple):
    """Pose of a child frame in its parent: the origin shifted by `shift` (3,), then the axes rotated; None for identity."""

    shift: object
    rotation: PlaneRotation | GeneralRotation | None


Chain = tuple[Transform, ...]  # from the parent to the child


def shift_matrix(r):
    """Matrix X (6, 6) from the twist at the origin to that at the point r, (v + w x r, w)."""
    table = constants(r.dtype)
    return table.eye6 + dot(table.shift, r)


def rotate_to_child(chain: Chain, vector):
    """Rotate a direction (3,) from the parent's to the child's axes."""
    for step in chain:
        if step.rotation is not None:
            vector = dot_transpose(step.rotation.matrix(3), vector)
    return vector


def origin_in_parent(chain: Chain):
    """Position (3,) of the child's origin in the parent's frame (m), or None where they coincide."""
    place: Any = None
    for step in reversed(chain):
        if place is not None and step.rotation is not None:
            place = dot(step.rotation.matrix(3), place)
        if step.shift is not None:
            place = step.shift if place is None else place + step.shift
    return place


def twist_to_child(chain: Chain, V):
    """Transform a twist (6,), or columns (6, k), from the parent's frame to the child's."""
    for step in chain:
        if step.shift is not None:
            V = dot(shift_matrix(step.shift), V)
        if step.rotation is not None:
            V = dot_transpose(step.rotation.matrix(6), V)
    return V


def wrench_to_parent(chain: Chain, F):
    """Transform a wrench (6,), or columns (6, k), from the child's frame to the parent's."""
    for step in reversed(chain):
        if step.rotation is not None:
            F = dot(step.rotation.matrix(6), F)
        if step.shift is not None:
            F = dot_transpose(shift_matrix(step.shift), F)
    return F


def inertia_to_parent(chain: Chain, A):
    """Transform a spatial inertia (6, 6) from the child's frame to the parent's."""
    for step in reversed(chain):
        if step.rotation is not None:
            A = step.rotation.congruence(A)
        if step.shift is not None:
            shift = shift_matrix(step.shift)
            A = symmetric(dot_transpose(shift, dot(A, shift)))
    return A


def moments_to_parent(chain: Chain, J):
    """Transform a pseudo-inertia (4, 4) from the child's frame to the parent's."""
    for step in reversed(chain):
        if step.rotation is not None:
            J = step.rotation.congruence(J)
        if step.shift is not None:
            shift = np.eye(4, dtype=J.dtype) + contract(_PLACE.astype(J.dtype), step.shift, (2,), (0,))
            J = symmetric(contract(dot(shift, J), shift, (1,), (1,)))
    return J


_PLACE = np.zeros((4, 4, 3))
_PLACE[:3, 3] = np.eye(3)
