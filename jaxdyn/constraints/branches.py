"""Degrees of freedom, and branches: whether a path without a singular position joins two neighbours on the same constraints."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.compile import entry_point, kernel, pseudo_inverse_by_rotations
from jaxdyn.compile.known import is_concrete, stop_gradient
from jaxdyn.constraints import selection
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout
from jaxdyn.constraints.rank import LEAST_GAP, check_tolerance, has_clear_rank, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.redundancy import coordinate_sizes, has_selection
from jaxdyn.constraints.selection import UNCLEAR_RANK, independent_rows
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, displacement

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


def degrees_of_freedom(
    scene: SceneLike, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> int | Int[Array, ""]:
    r"""Degrees of freedom at a configuration: nv minus the rank of the constraints' rows A(q, t).

    Dependent rows count once, so that the count is right for overconstrained linkages. It counts independent velocities at
    this q: it is larger in singular positions, and rolling reduces it though all configurations remain reachable. Loops whose
    rows are dependent only where the loops are closed need a q of `jd.assemble`. Distances are compared in
    units of the mechanism's length, each row scaled to length 1; rows at rounding level count as zero.

    **Arguments:** `scene`, a `Scene` or a system; `q` (nq,); `t`, s; `rank_tol`: singular values below `rank_tol` times the
    largest count as zero, by default $\epsilon^{4/7}$, 1e-9 in float64.

    **Returns:** an int for concrete arguments, an integer array () for traced ones, which is -1 where rounding of the numbers
    hides the rank.

    **Raises:** ValueError for shapes that do not fit, a `rank_tol` outside (0, 1), and for a rank that is not clear.

    Source: EQUATIONS section 7; the rank is the trace of $A A^+$.

    ```python
    count = jd.degrees_of_freedom(jd.scenes.four_bar(), jd.scenes.four_bar.start()[0])  # 1
    ```
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    rank_tol = check_tolerance(rank_tol)
    if not layout(scene):
        return scene.nv
    free = count_free(independent_rows(scene, q, t, rank_tol), q, t, rank_tol)
    if not is_concrete(free):
        return free
    if free < 0:
        raise ValueError(f"{UNCLEAR_RANK}; give numbers with more digits, or a rank_tol between them")
    return int(free)


@entry_point
def count_free(scene: Scene, q, t, rank_tol: float | None) -> Int[Array, ""]:
    """`degrees_of_freedom` by rows that are taken as they are; -1 where the rank is not clear."""
    # Scaled rows: the singular values of metres next to radians depend on the unit. The rank is by the
    # pseudo-inverse that all other rank decisions use, so that they agree.
    A = selection.unit_rows(scene, q, t)
    inverse = pseudo_inverse(A, tolerance(rank_tol, A), True)
    is_clear = has_clear_rank(A, inverse, rank_tol)
    if has_selection(scene):
        is_clear = is_clear & (scene.kept_rows.gap >= LEAST_GAP)
    return jnp.where(is_clear, scene.nv - rank_of(A, inverse), -1).astype(jnp.int32)
