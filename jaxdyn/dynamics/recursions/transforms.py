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
from jax import lax

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


# Products and selections by numpy for known operands, by one operation of the traced program otherwise.


def contract(a, b, axes_a: tuple[int, ...], axes_b: tuple[int, ...]):
    """Contract some axes of two tensors; the remaining axes of `a` come first."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.tensordot(a, b, (axes_a, axes_b))
    # The highest precision: GPUs may round float32 products to TF32.
    return lax.dot_general(a, b, ((axes_a, axes_b), ((), ())), precision=lax.Precision.HIGHEST)


def dot(a, b):
    """Product a b for a tensor, matrix or vector `a` and a matrix or vector `b`: over the last axis of `a`, the first of `b`."""
    return contract(a, b, (a.ndim - 1,), (0,))


def dot_transpose(a, b):
    """Product a^T b for a matrix `a` and a matrix or vector `b`."""
    return contract(a, b, (0,), (0,))


def outer(a, b):
    """Outer product a b^T of vectors."""
    return contract(a, b, (), ())


def select(mask: np.ndarray, a, b):
    """Select entries of `a` where the known mask is true, of `b` elsewhere; all of one shape."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        # A mask of numpy is resolved when the program is expanded: unselected entries are never computed.
        return np.where(mask, a, b)
    return lax.select(mask, a, b)


def transpose(a):
    """Transpose of a matrix."""
    return a.T if isinstance(a, np.ndarray) else lax.transpose(a, (1, 0))


def symmetric(a):
    """Symmetric matrix with the upper triangle of `a`, whose lower triangle then need not be computed."""
    return select(UPPER[a.shape[0]], a, transpose(a))


def join(parts, axis: int):
    """Concatenate along an axis."""
    if all(isinstance(x, np.ndarray) for x in parts):
        return np.concatenate(parts, axis)
    return lax.concatenate(parts, axis)


def part(a, start: int, stop: int, axis: int = 0):
    """Entries start to stop along an axis."""
    if isinstance(a, np.ndarray):
        return a[(slice(None),) * axis + (slice(start, stop),)]
    return lax.slice_in_dim(a, start, stop, axis=axis)


def entry(a, i: int, axis: int = 0):
    """Entry i along an axis, which is dropped."""
    if isinstance(a, np.ndarray):
        return np.take(a, i, axis)
    return lax.squeeze(lax.slice_in_dim(a, i, i + 1, axis=axis), (axis,))


UPPER = {n: np.triu(np.ones((n, n), bool)) for n in range(1, 7)}


def _hat_tensor() -> np.ndarray:
    hat = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        # (w x x)_k = w_i x_j - w_j x_i for each cyclic (i, j, k).
        hat[k, j, i], hat[j, k, i] = 1.0, -1.0
    return hat


class Constants(NamedTuple):
    """Constant tensors of the recursions, in one data type."""

    hat: np.ndarray  # (3, 3, 3): hat(w) = hat . w, hat(w) x = w x x
    shift: np.ndarray  # (6, 6, 3): twist at a point r from that at the origin: (1 + shift . r) V
    moment: (
        np.ndarray
    )  # (6, 3, 4): wrench (f, n) from the flux Y = [K a] J of a body, n = vee(Y - Y^T), f = its last column
    eye3: np.ndarray
    eye6: np.ndarray


# By dtype: programs compare known operands by identity, so the same tensors must be used each time.
_cache: dict = {}


def constants(dtype) -> Constants:
    """Constant tensors in a data type, built once."""
    dtype = np.dtype(dtype)
    if dtype not in _cache:
        hat = _hat_tensor()
        shift, moment = np.zeros((6, 6, 3)), np.zeros((6, 3, 4))
        shift[:3, 3:] = -hat
        moment[:3, :, 3] = np.eye(3)
        moment[3:, :, :3] = hat.transpose(2, 0, 1)
        _cache[dtype] = Constants(*(x.astype(dtype) for x in (hat, shift, moment, np.eye(3), np.eye(6))))
    return _cache[dtype]
