"""Products and selections by numpy for known operands, by one operation of the traced program otherwise."""

from typing import NamedTuple

import numpy as np
from jax import lax


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
