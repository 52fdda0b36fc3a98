"""Rows of constraints, contacts and frictions at a state, and the metric in which forces along them act.

Forces p along the rows change their rates by G p, with G = A M^-1 A^T = Y^T Y, Y = U^-1 A^T, M = U U^T. Rows that depend on each
other (a box on four corners) leave G singular: solutions of G x = r are near those of least norm.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.constraints.base import Rows, position_residual, rows
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.simulation.hybrid.modes import Elements, extend
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene


class Gram(NamedTuple):
    """Gram matrix G = Y^T Y (count, count) of rows Y (nv, count); `matrix` is None where there are far more rows."""

    Y: Array
    matrix: Array | None

    @classmethod
    def of(cls, Y) -> "Gram":
        """Gram matrix of whitened rows Y (nv, count)."""
        # Operations of kernels grow as the cube of the rows: those of eight contacts of a body would be too many.
        return cls(Y, None if 2 * Y.shape[0] < Y.shape[1] else matmul(Y.T, Y))

    def times(self, x):
        """Product G x, x (count,) or (count, k)."""
        return matmul(self.Y.T, matmul(self.Y, x)) if self.matrix is None else matmul(self.matrix, x)

    def sizes(self, x):
        """Sizes (count,) of the terms that cancel in G x."""
        if self.matrix is None:
            Y = jnp.abs(self.Y)
            return matmul(Y.T, matmul(Y, jnp.abs(x)))
        return matmul(jnp.abs(self.matrix), jnp.abs(x))

    @property
    def squares(self):
        """Diagonal of G, (count,)."""
        return jnp.sum(self.Y * self.Y, 0) if self.matrix is None else jnp.diagonal(self.matrix)

    def factor(self, active) -> "RowFactor":
        """Factor of the rows whose mask `active` (count,) is one."""
        square, eps = self.squares, float(jnp.finfo(self.Y.dtype).eps)
        # A row of the size of rounding is no row, as that of a direction across the plane of a planar model.
        is_row = square > eps**1.5 * jnp.max(square)
        scale = jnp.where(is_row, 1 / jnp.sqrt(jnp.where(is_row, square, jnp.ones_like(square))), 0.0) * active
        if self.matrix is None:
            # Directions of velocities that no row holds have a zero here, which is known to rounding.
            Y = self.Y * scale[None]
            unit = jnp.eye(len(Y), dtype=Y.dtype)
            return RowFactor(cholesky(matmul(Y, Y.T) + eps**_SHIFT_OF_VELOCITIES * unit), Gram(Y, None), scale)
        matrix = self.matrix * scale[:, None] * scale[None]
        # Rows that do not act have a one on the diagonal, so that the factor exists in every mode. The shift is large enough for
        # factors of dependent rows; each step of the proximal method multiplies the error by about it.
        shift = jnp.diag(1.0 - active + eps**_SHIFT * jnp.ones_like(square))
        return RowFactor(cholesky(matrix + shift), Gram(self.Y, matrix), scale)


_SHIFT, _SHIFT_OF_VELOCITIES = 0.5, 0.6  # exponents of rounding, of the square of a row


class RowFactor(NamedTuple):
    """Cholesky factor of G + eps, or of Y Y^T + eps, of rows scaled to unit length; scales are zero of rows that do not act."""

    factor: Array
    gram: Gram
    scale: Array

    def solve(self, right):
        """Solution x of G x = right (count, k) on the rows that act, zero elsewhere, near the least norm.

        Two steps of the proximal method x <- x + (G + eps)^-1 (right - G x). In the space of velocities the inverse is
        Y^T (Y Y^T + eps)^-2 Y.
        """
        right = right * self.scale[:, None]
        x = self._invert(right)
        for _ in range(2):
            x = x + self._invert(right - self.gram.times(x))
        return x * self.scale[:, None]

    def _invert(self, right):
        if self.gram.matrix is not None:
            return solve_cholesky(self.factor, right)
        Y = self.gram.Y
        return matmul(Y.T, solve_cholesky(self.factor, solve_cholesky(self.factor, matmul(Y, right))))

    def nullity(self):
        """Diagonal (count,) of the projection on the forces without effect, G x = 0; zero of rows that do not act."""
        if self.gram.matrix is None:
            Y = self.gram.Y
            ones = (self.scale > 0).astype(Y.dtype)
            return ones - jnp.sum(Y * solve_cholesky(self.factor, Y), 0)
        # It is the limit of eps (G + eps)^-1.
        eps, unit = float(jnp.finfo(self.scale.dtype).eps), jnp.eye(self.scale.size, dtype=self.scale.dtype)
        return jnp.where(self.scale > 0, eps**_SHIFT * jnp.diagonal(solve_cholesky(self.factor, unit)), 0.0)


class StateTerms(NamedTuple):
    """Terms of a state that do not depend on its mode: rows, mass matrix, and sliding velocities (n, 2)."""

    row: Rows
    metric: MassFactor
    gram: Gram
    slip: Array


def terms_at(scene: Scene, elements: Elements, q, v, t) -> StateTerms:
    """Terms of a scene with its elements."""
    row = rows(extend(scene), q, v, t)
    metric = mass_factor(mass_matrix(scene.system, q, t))
    # Whitened rows Y give A M^-1 A^T as Y^T Y: symmetric, and positive semidefinite for dependent rows too.
    Y = metric.whiten(row.A.T)
    return StateTerms(row, metric, Gram.of(Y), by_element(elements, row.velocity))


def by_element(elements: Elements, rowwise) -> Array:
    """Entries of the rows that slip, (n, 2), zero where there are none."""
    # Padded to two directions, so that elements with one row and with two rows share one array.
    zero = jnp.zeros((), rowwise.dtype)
    return jnp.stack(
        [
            jnp.stack([rowwise[one.tangent[k]] if k < len(one.tangent) else zero for k in range(2)])
            for one in elements.each
        ]
    )


def by_normal_row(elements: Elements, values) -> Array:
    """Values (n,) of the contacts at the rows of their gaps, (count,), zero elsewhere."""
    rows = [jnp.zeros((), values.dtype)] * elements.count
    for i, one in enumerate(elements.each):
        if one.opens:
            rows[one.normal] = values[i]
    return jnp.stack(rows)


def gaps(scene: Scene, elements: Elements, q, t) -> Array:
    """Gaps of the elements that open, (n,); zero of others."""
    residuals = position_residual(extend(scene), q, t)
    # Contacts have one row each among the residuals, behind those of the scene's own constraints.
    at, gap_of_each = residuals.shape[0] - sum(one.opens for one in elements.each), []
    for one in elements.each:
        gap_of_each.append(residuals[at] if one.opens else jnp.zeros((), q.dtype))
        at += one.opens
    return jnp.stack(gap_of_each)


def tolerance(dtype) -> float:
    """Size below which velocities (m/s) and gaps (m) count as zero, relative to the terms that cancel in them."""
    # 1e-10 in float64: above the rounding of a projected state, far below the changes at an event.
    return float(jnp.finfo(dtype).eps) ** 0.64


def force_tolerance(dtype) -> float:
    """Size below which forces count as zero, relative to those of all elements."""
    # 1e-7 in float64, above the rounding of the forces of dependent rows, which is eps/eps^0.5 of them.
    return float(jnp.finfo(dtype).eps) ** 0.45
