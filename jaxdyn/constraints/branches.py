"""Branches of configurations: whether two neighbours on the same constraints are joined by a path without a singular position."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import kernel, pseudo_inverse_by_rotations
from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout
from jaxdyn.constraints.rank import tolerance
from jaxdyn.constraints.tolerances import coordinate_sizes
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displacement

JUMP = 1.0  # rad or lengths of the mechanism: a longer way between two configurations is no small step


def unit_rows(scene: Scene, q, t, factors=None):
    """Rows of positions in coordinates scaled by their sizes, and their pseudo-inverse; constants.

    `factors` (m,) are those of the last rows.
    """
    # Only decisions follow from these rows, so they are constants under differentiation.
    scene, q = stop_gradient((scene, q))
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    R = constraint_jacobian(scene, q, t)[holonomic_rows(layout(scene))] * sizes[None]
    if factors is not None:
        count = R.shape[0] - factors.size
        R = R * jnp.concatenate([jnp.ones((count,), q.dtype), lax.stop_gradient(factors)])[:, None]
    return R, pseudo_inverse_by_rotations(R, tolerance(None, R))


def changes_branch(system, before, after, R_after, R, inverse):
    """Decide whether a combination of rows went through zero between two configurations, or a coordinate jumped.

    `R` and `inverse` are those of `unit_rows` at the first one, `R_after` those at the second.
    """
    sizes, _ = coordinate_sizes(system, before.dtype)
    jump = jnp.max(jnp.abs(displacement(system, before, after)) / sizes, initial=0.0)
    return passes_singular(R, inverse, R_after) | (jump > JUMP)


def sign_of_determinant(A: Float[Array, "n n"]) -> Float[Array, ""]:
    """-1 where the determinant is negative, else 1; a constant."""
    return kernel(_sign, fallback=_sign_by_lapack)(None, lax.stop_gradient(A))


def passes_singular(
    A: Float[Array, "m n"], inverse: Float[Array, "n m"], after: Float[Array, "m n"]
) -> Bool[Array, ""]:
    """Decide whether a combination of rows goes through zero between A, with its pseudo-inverse, and the rows `after`.

    det(A' A^+ + (1 - A A^+)) then changes its sign. The second term fills the null space of dependent rows, where the
    determinant of the first one is zero.
    """
    own = jnp.eye(A.shape[0], dtype=A.dtype) - matmul(A, inverse)
    return sign_of_determinant(matmul(after, inverse) + own) < 0


def _sign(_, A):
    """Sign by Gaussian elimination with row exchanges until the largest entry of a column is its pivot."""
    # Kernels have no index that depends on data: the exchanges are selections between neighbours, as in a bubble sort.
    sign = jnp.ones((), A.dtype)
    rows = list(A)
    for k in range(len(rows)):
        for i in range(k + 1, len(rows)):
            swap = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            rows[k], rows[i] = jnp.where(swap, rows[i], rows[k]), jnp.where(swap, rows[k], rows[i])
            sign = jnp.where(swap, -sign, sign)
        sign = jnp.where(rows[k][k] < 0, -sign, sign)
        scale = 1 / jnp.where(rows[k][k] == 0, 1.0, rows[k][k])
        for i in range(k + 1, len(rows)):
            rows[i] = rows[i] - rows[i][k] * scale * rows[k]
    return sign


def _sign_by_lapack(_, A):
    return jnp.where(jnp.linalg.slogdet(A)[0] < 0, -1.0, 1.0).astype(A.dtype)
