"""Logs condensed to triangles by QR: all that a fit needs of the stacked regressor, at a cost independent of the logs' length.

The rows of one torque hold the inertial columns and that torque's own terms. For each block of consecutive samples and each
torque they are replaced by the triangle of their QR factorisation, which keeps all squares and products. Weights of torques,
samples to leave out, and columns to leave out can then be chosen afterwards, and the error of parameters on a block is known
without its samples.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Condensed(NamedTuple):
    """Stacked regressor and torques of a log, W x = w, condensed: |W x - w|^2 = |R x - d|^2 + rest for every x.

    `R` (p, p) upper triangular, `d` (p,), `rest` a number, `rows` the number of rows of W. Taking R instead of the
    normal matrix W^T W = R^T R keeps the condition number from being squared.
    """

    R: np.ndarray
    d: np.ndarray
    rest: float
    rows: int


@dataclasses.dataclass(frozen=True)
class Blocks:
    """Regressor and torques of logs, condensed for each block of samples and each torque.

    - `triangles`: for each block a list of nv upper-trapezoidal matrices (m, s + k + 1): columns shared by all torques, the
      torque's own k terms, and the torque measured (N m).
    - `shared`: number s of columns that all torques share. `terms`: number k of terms of each torque.
    - `samples` (blocks,): samples in each block. `logs` (blocks,): which log each block comes from.

    Parameters x (s + k nv,) are those shared, then one number for each torque of the first term, of the second, ...
    """

    triangles: list[list[np.ndarray]]
    shared: int
    terms: int
    samples: np.ndarray
    logs: np.ndarray

    def __len__(self) -> int:
        return len(self.triangles)

    @property
    def nv(self) -> int:
        """Number of torques."""
        return len(self.triangles[0])

    @property
    def size(self) -> int:
        """Number of parameters, s + k nv."""
        return self.shared + self.terms * self.nv

    def places(self, joint: int) -> np.ndarray:
        """Indices in x of the columns of one torque."""
        return np.concatenate([np.arange(self.shared), self.shared + joint + self.nv * np.arange(self.terms)])

    def merge(self, chosen=None) -> list[np.ndarray]:
        """One triangle for each torque, of some blocks (an array of bool or of indices; None: all)."""
        chosen_blocks = np.arange(len(self)) if chosen is None else np.arange(len(self))[chosen]
        return [
            np.asarray(
                np.linalg.qr(np.concatenate([self.triangles[block][joint] for block in chosen_blocks]), mode="r")
            )
            for joint in range(self.nv)
        ]

    def squares(self, x: np.ndarray, chosen=None) -> np.ndarray:
        """Sums of squared errors (blocks, nv) of the parameters x on some blocks."""
        chosen_blocks = np.arange(len(self)) if chosen is None else np.arange(len(self))[chosen]
        # The triangle's last column is the torque: R [x, -1] has the length of the error W x - w.
        columns = [np.append(x[self.places(joint)], -1.0) for joint in range(self.nv)]
        return np.array(
            [[np.sum((R @ c) ** 2) for R, c in zip(self.triangles[i], columns, strict=True)] for i in chosen_blocks]
        )

    def scores(self, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Half the gradients (blocks, p) of each block's weighted squared error at x."""
        result = np.zeros((len(self), self.size))
        for row, triangles in zip(result, self.triangles, strict=True):
            for joint, R in enumerate(triangles):
                error = R @ np.append(x[self.places(joint)], -1.0)
                row[self.places(joint)] += weights[joint] ** 2 * (R[:, :-1].T @ error)
        return result

    def grams(self, weights: np.ndarray) -> np.ndarray:
        """W^T W of each block (blocks, p, p), rows weighted."""
        result = np.zeros((len(self), self.size, self.size))
        for matrix, triangles in zip(result, self.triangles, strict=True):
            for joint, R in enumerate(triangles):
                places = self.places(joint)
                # Torques share the inertial columns, so that their Gram matrices overlap and add up there.
                matrix[np.ix_(places, places)] += weights[joint] ** 2 * (R[:, :-1].T @ R[:, :-1])
        return result

    def rows(self, weights: np.ndarray, chosen=None) -> np.ndarray:
        """Rows [W, w] (m, p + 1) with the squares and products of some blocks, each torque's times its weight."""
        parts = []
        for joint, R in enumerate(self.merge(chosen)):
            part = np.zeros((len(R), self.size + 1))
            part[:, np.append(self.places(joint), self.size)] = weights[joint] * R
            parts.append(part)
        return np.concatenate(parts)

    def count(self, chosen=None) -> int:
        """Number of torques measured in some blocks."""
        samples = self.samples if chosen is None else self.samples[chosen]
        return int(samples.sum()) * self.nv


def condense_rows(rows: np.ndarray, count: int) -> Condensed:
    """`Condensed` of rows [W, w] (m, p + 1) that stand for `count` torques."""
    return pad_triangle(np.asarray(np.linalg.qr(rows, mode="r")), count)


def pad_triangle(triangle: np.ndarray, count: int) -> Condensed:
    """`Condensed` of rows [W, w] that are a triangle (m, p + 1) already, as of `numpy.linalg.qr`."""
    p = triangle.shape[1] - 1
    # QR of fewer rows than columns gives a trapezoid; rows of zeros change no square.
    triangle = np.concatenate([triangle, np.zeros((max(p + 1 - len(triangle), 0), p + 1))])
    # The last diagonal entry is the length of the error that no x removes.
    return Condensed(triangle[:p, :p], triangle[:p, p], float(triangle[p, p] ** 2), count)


def block_slices(lengths: Sequence[int], total: int) -> list[tuple[int, slice]]:
    """Cut logs of these lengths into about `total` blocks, (log, its samples), each within one log; a log has at least one."""
    result = []
    for which, length in enumerate(lengths):
        count = min(max(1, round(total * length / sum(lengths))), length)
        edges = np.linspace(0, length, count + 1).astype(int)
        result += [(which, slice(a, b)) for a, b in itertools.pairwise(edges)]
    return result
