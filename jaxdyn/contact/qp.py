"""Small quadratic programs: with linear rows and second-order cones, batched and differentiable; between bounds.

See `solve_qp`. The interior point (`jaxdyn.contact._interior_point`) is preceded by a change of variables that gives Q a unit
diagonal, rows of unit length, one scale for lengths of x, and the removal of equality rows: with A^+ the pseudo-inverse of
their matrix and P = 1 - A^+ A, x = A^+ b + P y satisfies them however many of them are dependent, and the objective is
the same in y, with the added term y^T (1 - P) y / 2, zero at y = P y.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxdyn.compile import entry_point, invalidate_derivatives
from jaxdyn.compile.known import is_concrete, is_tracing
from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.rank import eps_of, pseudo_inverse, tolerance
from jaxdyn.contact._interior_point import Point, Program, attach_derivative, solve
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_float, as_static, check_count
from jaxdyn.systems.mass_factor import cholesky, is_definite, solve_cholesky


class QPSolution(Outcome):
    r"""Solution of a quadratic program, with the multipliers of its stationary point.

    $$Q x + q + G^T z + A^T y - \sum_i S_i^T w_i = 0$$

    - `x` (n,): the minimiser. `result`: one of `jd.RESULTS`; where it is not `successful`, all other fields are the
      last iterate's.
    - `multipliers` z (m,): of the rows G x <= h, zero or positive. `slack` (m,): h - G x.
    - `equality_multipliers` y (p,): of A x = b; of least norm where rows are dependent.
    - `cone_multipliers` w, `cone_slack`, for each group of cones (k, d): both in their cones, the slack is c - S x.
    - `steps` (): of the interior point.
    """

    x: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    slack: Float[Array, " m"]
    equality_multipliers: Float[Array, " p"]
    cone_multipliers: tuple[Float[Array, "k d"], ...]
    cone_slack: tuple[Float[Array, "k d"], ...]
    steps: Int[Array, ""]
    result: Any


if TYPE_CHECKING:
    ConeRows = tuple[Numbers, Numbers]  # S (k, d, n) and c (k, d)
else:
    ConeRows = Any  # `solve_qp` checks them


def solve_qp(
    Q: Numbers,
    q: Numbers,
    G: Numbers | None = None,
    h: Numbers | None = None,
    A: Numbers | None = None,
    b: Numbers | None = None,
    *,
    cones: ConeRows | Sequence[ConeRows] = (),
    tol: float | None = None,
    max_steps: int = 50,
) -> QPSolution:
    r"""Minimise a quadratic function with linear rows and second-order cones.

    $$\min_x \tfrac12 x^T Q x + q^T x \quad \text{with} \quad G x \le h, \quad A x = b, \quad c_i - S_i x \in \mathrm{cone}_i$$

    An interior-point method whose steps are kernels (see `compilation`): it compiles, batches (`jax.vmap`) and is
    differentiated in all arrays, forward and reverse, by the equations of the solution, also where forces are on the
    boundary of their cone or at its apex. Where rows are active with a multiplier of zero, the solution has only one-sided
    derivatives, and the mean of those with and without these rows is returned. Derivatives are NaN where `result` is not
    `successful`. Zeros of G and S that are known while tracing cost nothing,
    if there are no equality rows.

    **Arguments:**

    - `Q` (n, n): positive definite; only its symmetric part counts. `q` (n,).
    - `G` (m, n), `h` (m,): inequality rows. An infinite h is no bound.
    - `A` (p, n), `b` (p,): equality rows; they may be dependent.
    - `cones`: a pair (S, c) or a list of pairs, S (k, d, n) and c (k, d): $y = c - S x$, of each of the k cones, satisfies
      $|(y_1, \ldots, y_{d-1})| \le y_0$. Rows of zeros fill up a smaller cone.
    - `tol`: residuals and gap, with Q's diagonal, the rows and the largest of q scaled to one; by default 1e-9 in float64 and
      1e-4 in float32.
    - `max_steps`: of the interior point; about 10 are usual.

    **Returns:** `QPSolution`.

    **Raises:** ValueError for shapes that do not fit, G without h, A without b, a known Q that is not positive definite, and
    a tolerance or number of steps that is not positive.

    Source: Vandenberghe, The CVXOPT linear and quadratic cone program solvers (2010); the derivative is that of the
    projection on the cones, as in Agrawal et al., Differentiating through a cone program (2019).

    ```python
    jd.contact.solve_qp(jnp.eye(2), jnp.array([-2.0, 0.0]), jnp.array([[1.0, 0.0]]), jnp.array([1.0])).x  # (1, 0)
    ```
    """
    Q = as_float(Q, "Q", (None, None))
    n = Q.shape[0]
    if Q.shape != (n, n) or n == 0:
        raise ValueError(f"Q has shape {Q.shape}, expected (n, n) with n > 0")
    q = as_float(q, "q", (n,), Q.dtype)
    _check_definite(Q)
    given = G  # the original: conversion to an array under tracing would make it unknown
    G, h = _pair(G, h, "G", "h", n, Q.dtype)
    A, b = _pair(A, b, "A", "b", n, Q.dtype)
    # Two arrays are one pair (S, c); two pairs are tuples, without `ndim`.
    if not isinstance(cones, Sequence):
        raise ValueError(f"cones is {cones!r}; give a pair (S, c), or a list of pairs")
    pairs: list[Any] = [cones] if len(cones) == 2 and hasattr(cones[0], "ndim") else list(cones)
    checked = []
    for i, pair in enumerate(pairs):
        if not isinstance(pair, (tuple, list)) or len(pair) != 2:
            raise ValueError(f"cones[{i}] is {pair!r}; give a pair (S, c) of arrays (k, d, n) and (k, d)")
        S = as_float(pair[0], f"cones[{i}]: S", (None, None, n), Q.dtype)
        checked.append((S, as_float(pair[1], f"cones[{i}]: c", S.shape[:2], Q.dtype)))
        if S.shape[1] == 0:
            raise ValueError(f"cones[{i}]: S has shape {S.shape}; a cone has at least one row")
    groups = [G if given is None else given, *(pair[0] for pair in pairs)]
    pattern = tuple(_pattern(g, A) for g in groups)
    if tol is None:
        # Convergence is superlinear near the end, so the exponent is that which float32 and float64 both reach.
        tol = max(1e-9, float(jnp.finfo(Q.dtype).eps) ** 0.575)
    tol = as_static(tol, "tol", np.finfo(float).tiny, 1, "a number between 0 and 1")
    return _solve(Q, q, G, h, A, b, tuple(checked), pattern, tol, check_count(max_steps, "max_steps"))


def _pair(matrix, level, name: str, right: str, n: int, dtype):
    if (matrix is None) != (level is None):
        missing, there = (right, name) if level is None else (name, right)
        raise ValueError(f"{missing} is None, but {there} is given; give both or none")
    if matrix is None:
        return jnp.zeros((0, n), dtype), jnp.zeros((0,), dtype)
    matrix = as_float(matrix, name, (None, n), dtype)
    return matrix, as_float(level, right, (matrix.shape[0],), dtype)


def _pattern(rows, A) -> bytes | None:
    """Mask of the entries of a group's rows that may be nonzero; None for all."""
    # Outside of a trace all calls share one program, without regard to zeros; equality rows mix columns.
    known = is_tracing() and is_concrete(rows) and not A.shape[0]
    return (np.asarray(rows) != 0).tobytes() if known else None


def _check_definite(Q):
    if is_concrete(Q):
        known = np.asarray(Q, float)
        minimum = np.linalg.eigvalsh((known + known.T) / 2)[0]
        if not minimum > 0:
            raise ValueError(
                f"Q is not positive definite, its smallest eigenvalue is {minimum}; add a small multiple of the identity"
            )


def _unit(sizes):
    return jnp.where(sizes > 0, 1 / jnp.where(sizes > 0, sizes, 1), 1)


class _Scaled(NamedTuple):
    """A program with Q of unit diagonal, rows of unit length and data of size one; its scales; x0, which satisfies A x = b.

    `blocks` (k, d, n) and `levels` (k, d) are those of the linear rows, d = 1, then those of each group of cones; `inverse` is
    A^+, None without equality rows.
    """

    Q: Array
    q: Array
    A: Array
    b: Array
    blocks: list[Array]
    levels: list[Array]
    inverse: Array | None
    x0: Array
    across: Array
    equality_scale: Array
    row_scales: list[Array]
    size: Array


def _scale(Q, q, A, b, blocks, levels) -> _Scaled:
    # Scales are constants for differentiation, because the solution does not depend on them.
    # Q gets a unit diagonal and rows unit length, so that `tol` does not depend on units.
    diagonal = jax.lax.stop_gradient(jnp.diagonal(Q))
    # An indefinite Q may have a negative diagonal; `result` reports it.
    across = _unit(jnp.sqrt(jnp.maximum(diagonal, 0)))
    blocks = [block * across[None, None] for block in blocks]
    # One scale for all rows of a cone: different ones would make it another cone.
    row_scales = [_unit(jnp.sqrt(jnp.sum(jax.lax.stop_gradient(x) ** 2, (1, 2)))) for x in blocks]
    blocks = [x * r[:, None, None] for x, r in zip(blocks, row_scales, strict=True)]
    levels = [x * r[:, None] for x, r in zip(levels, row_scales, strict=True)]
    A = A * across[None]
    equality_scale = _unit(jnp.sqrt(jnp.sum(jax.lax.stop_gradient(A) ** 2, 1)))
    A, b = A * equality_scale[:, None], b * equality_scale
    Q, q = Q * across[:, None] * across[None], q * across
    inverse, x0 = None, jnp.zeros_like(q)
    if A.shape[0]:
        inverse = pseudo_inverse(A.T, tolerance(None, A)).T
        x0 = matmul(inverse, b)
    shortest = [jnp.max(jnp.abs(x0)), jnp.max(jnp.abs(q))]
    shortest += [jnp.max(jnp.sqrt(jnp.sum(x[:, 1:] ** 2, 1)) - x[:, 0], initial=0) for x in levels]
    # The solution is homogeneous in (q, b, h), whose size is scaled to one.
    size = 1 / _unit(jax.lax.stop_gradient(jnp.max(jnp.stack(shortest))))
    q, b, x0, levels = q / size, b / size, x0 / size, [x / size for x in levels]
    return _Scaled(Q, q, A, b, blocks, levels, inverse, x0, across, equality_scale, row_scales, size)


def _without_equalities(scaled: _Scaled, kept: list[int]) -> Program:
    """The program in y with x = x0 + P y, for the groups of rows that have some."""
    Q, q, x0 = scaled.Q, scaled.q, scaled.x0
    program = Program(Q, q, tuple(scaled.blocks[i] for i in kept), tuple(scaled.levels[i] for i in kept))
    if scaled.inverse is None:
        return program
    unit = jnp.eye(q.shape[0], dtype=q.dtype)
    P = unit - matmul(scaled.inverse, scaled.A)
    return Program(
        # The term 1 - P keeps the matrix definite on the range of A^T.
        matmul(P, matmul(Q, P)) + unit - P,
        matmul(P, q + matmul(Q, x0)),
        tuple(matmul(block, P) for block in program.G),
        tuple(y - matmul(block, x0) for block, y in zip(program.G, program.h, strict=True)),
    )


@entry_point
def _solve(Q, q, G, h, A, b, cones, pattern: tuple[bytes | None, ...], tol: float, max_steps: int) -> QPSolution:
    data = [Q, q, G, A, b, *(x for pair in cones for x in pair)]
    finite = jnp.stack([jnp.isfinite(x).all() for x in data]).all() & ~jnp.isnan(h).any()
    bounded = jnp.isfinite(h)
    # A row without a bound becomes 0 <= 1; an infeasible one, h = -inf, becomes 0 <= -1.
    G_used, h_used = jnp.where(bounded[:, None], G, 0), jnp.where(bounded, h, jnp.where(h > 0, 1, -1).astype(h.dtype))
    blocks, levels = [G_used[:, None, :], *(S for S, _ in cones)], [h_used[:, None], *(c for _, c in cones)]
    kept = [i for i, block in enumerate(blocks) if block.shape[0]]
    # Only the symmetric part enters x^T Q x.
    scaled = _scale((Q + Q.T) / 2, q, A, b, blocks, levels)
    program = _without_equalities(scaled, kept)

    result, steps = RESULTS.successful, jnp.zeros((), jnp.int32)
    if scaled.inverse is not None:
        # Contradictory equality rows: the least-squares solution x0 misses them.
        met = jnp.max(jnp.abs(matmul(scaled.A, scaled.x0) - scaled.b)) <= 10 * tol
        result = RESULTS.where(met, result, RESULTS.infeasible)
    if kept:
        pattern = tuple(pattern[i] for i in kept)
        # The loop is not differentiated: `attach_derivative` differentiates the equations of its solution.
        end = solve(jax.lax.stop_gradient(program), pattern, tol, max_steps)
        point = attach_derivative(pattern, program, jax.lax.stop_gradient(end.point))
        steps = end.steps
        result = RESULTS.where(end.solved, result, RESULTS.stalled)
        result = RESULTS.where(end.infeasible, RESULTS.infeasible, result)
    else:
        point = Point(-solve_cholesky(cholesky(program.Q), program.q), (), ())
    result = RESULTS.where(is_definite(scaled.Q, cholesky(scaled.Q)), result, RESULTS.indefinite)
    # Comparisons with NaN are false, and zeroed rows without a bound hide nonfinite entries, so finiteness is checked
    # separately.
    finite = finite & (jnp.isfinite(point.x).all() | (result != RESULTS.successful))
    result = RESULTS.where(finite, result, RESULTS.nonfinite)
    x, y, z, s = _unscale(scaled, point, kept)
    solution = x, jnp.where(bounded, z[0][:, 0], 0), jnp.where(bounded, s[0][:, 0], h), y, tuple(z[1:]), tuple(s[1:])
    failed = result != RESULTS.successful
    x, *rest = invalidate_derivatives(solution, failed, (Q, q, G, h, A, b, cones))
    return QPSolution(x, *rest, steps=steps, result=result)


def _unscale(scaled: _Scaled, point: Point, kept: list[int]):
    """x, the multipliers y of the equality rows, and those, z, and the slack of each group of rows, in the units given."""
    inverse, size = scaled.inverse, scaled.size
    # Projected again, because the iteration gives y = P y up to its tolerance only.
    x = point.x if inverse is None else scaled.x0 + point.x - matmul(inverse, matmul(scaled.A, point.x))
    z, s = [jnp.zeros_like(y) for y in scaled.levels], [jnp.ones_like(y) for y in scaled.levels]
    for i, slack, multiplier in zip(kept, point.s, point.z, strict=True):
        s[i], z[i] = slack, multiplier
    y = jnp.zeros_like(scaled.b)
    if inverse is not None:
        gradient = matmul(scaled.Q, x) + scaled.q
        for block, multiplier in zip(scaled.blocks, z, strict=True):
            gradient = gradient + jnp.einsum("kdn,kd->n", block, multiplier)
        # The multipliers of least norm, of all that satisfy stationarity with dependent rows.
        y = -matmul(inverse.T, gradient) * scaled.equality_scale * size
    z = [x * r[:, None] * size for x, r in zip(z, scaled.row_scales, strict=True)]
    s = [x / r[:, None] * size for x, r in zip(s, scaled.row_scales, strict=True)]
    return x * scaled.across * size, y, z, s


# --- quadratic programs between bounds, by an active-set method ---
#
# A minimum over the free coordinates, within the bounds, is followed by the release of one coordinate that its gradient pulls
# off its bound. A released coordinate moves inwards at once, because all others that are free are off their bounds: every
# minimum is strictly below the one before. No set of free coordinates occurs twice, so that the method ends, whatever the
# condition number.
#
# Source: Nocedal & Wright (2006), Numerical optimization, sections 16.5 and 16.7; Tassa, Mansard & Todorov (2014),
# Control-limited differential dynamic programming, section III.B, for the use of the free coordinates.


# Rounding errors, in the terms of a gradient, up to which it counts as zero. 16 are the most at condition numbers up to 1e10.
_ROUNDING = 1e3


class BoxMinimum(NamedTuple):
    """The minimum x (n,), which entries are free (n,), and a Cholesky factor of H with ones in place of those at a bound.

    `converged` (): whether x satisfies the optimality conditions to rounding.
    """

    x: Float[Array, " n"]
    free: Bool[Array, " n"]
    factor: Float[Array, "n n"]
    converged: Bool[Array, ""]


class _State(NamedTuple):
    x: Array
    free: Array
    at_minimum: Array  # whether x is the minimum over the free coordinates
    minimum: Array  # the value at the last such minimum
    futile: Array  # coordinates whose release did not reduce the value
    released: Array  # the coordinate released last
    goes_on: Array
    count: Array


def minimize_in_box(H: Float[Array, "n n"], g: Float[Array, " n"], lower: Array, upper: Array) -> BoxMinimum:
    """Minimise x.H x / 2 + g.x with lower <= x <= upper, for a positive definite H; not converged where it is not."""
    n = g.shape[0]
    diagonal = jnp.diagonal(H)
    # In practice 2 n steps or less. The bound only ends programs without a minimum.
    maximum = 100 + 20 * n

    def gradient(x):
        """The gradient, and the size of the terms that cancel in it, so that tolerances do not depend on units."""
        return g + matmul(H, x), jnp.abs(g) + matmul(jnp.abs(H), jnp.abs(x))

    def value(x):
        return jnp.sum(x * (0.5 * matmul(H, x) + g))

    def factor_of(free):
        # Ones in place of entries at a bound keep the shape fixed while the set changes, and decouple them from the others.
        both = free[:, None] & free[None]
        return cholesky(jnp.where(both, H, jnp.eye(n, dtype=H.dtype)))

    def pull(x, free, slope):
        """The gradient that pulls entries off their bounds, and zero where there is none (Karush, Kuhn & Tucker)."""
        wrong = ((slope < 0) & (x < upper)) | ((slope > 0) & (x > lower))
        return jnp.where(~free & wrong, jnp.abs(slope), jnp.zeros_like(slope))

    def free_step(x, free, slope):
        """The step to the minimum over the free coordinates, with one refinement."""
        factor = factor_of(free)
        # With the decoupled factor a zero on the right-hand side gives entries at a bound a zero step.
        step = -solve_cholesky(factor, jnp.where(free, slope, jnp.zeros_like(slope)))
        rest = g + matmul(H, x + step)
        return step - solve_cholesky(factor, jnp.where(free, rest, jnp.zeros_like(rest)))

    def improve(state: _State):
        x, free, at_minimum, minimum, futile, released, _, count = state
        slope, size = gradient(x)
        here = value(x)
        # Pulls close to rounding may be wrong: a release that does not reduce the value is not repeated until another one does.
        falls = here < minimum
        futile = jnp.where(at_minimum, (futile | released) & ~falls, futile)
        minimum = jnp.where(at_minimum, jnp.minimum(here, minimum), minimum)
        pulls = pull(x, free, slope)
        pulls = jnp.where(futile | (pulls <= 4 * eps_of(x) * size), jnp.zeros_like(pulls), pulls)
        # The largest reduction that a coordinate alone would bring.
        worst = jnp.argmax(pulls * pulls / jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
        release = at_minimum & (jnp.arange(n) == worst) & (pulls > 0)
        ends = at_minimum & ~jnp.any(release)
        free = free | release

        step = free_step(x, free, slope)
        bound = jnp.where(step < 0, lower, upper)
        moves = free & (step != 0)
        lengths = jnp.where(moves, (bound - x) / jnp.where(moves, step, jnp.ones_like(step)), jnp.inf)
        length = jnp.maximum(jnp.min(lengths), 0)
        is_whole = length >= 1
        # Where the step leaves the box it ends at the first bound, or with several bounds at once if that is lower still.
        first = jnp.where(lengths <= length, bound, jnp.clip(x + length * step, lower, upper))
        clipped = jnp.clip(x + step, lower, upper)
        y = jnp.where(is_whole | (value(clipped) < value(first)), clipped, first)
        bounded = free & ((y <= lower) | (y >= upper))
        after = _State(
            y,
            free & ~bounded,
            is_whole,
            minimum,
            futile,
            jnp.where(at_minimum, release, released),
            # The Cholesky factor of an indefinite H is NaN.
            jnp.isfinite(y).all(),
            count + 1,
        )
        return _State(
            *(jnp.where(ends, old, new) for old, new in zip(state[:6], after[:6], strict=True)),
            goes_on=~ends & after.goes_on,
            count=after.count,
        )

    start = jnp.clip(jnp.zeros_like(g), lower, upper)
    slope, _ = gradient(start)
    free = ~(((start <= lower) & (slope > 0)) | ((start >= upper) & (slope < 0)))
    none = jnp.zeros(n, bool)
    begin = _State(
        start, free, jnp.asarray(False), jnp.full((), jnp.inf, g.dtype), none, none, jnp.asarray(True), jnp.asarray(0)
    )
    x, free, *_ = lax.while_loop(lambda state: state.goes_on & (state.count < maximum), improve, begin)
    slope, size = gradient(x)
    left = jnp.where(free, jnp.abs(slope), pull(x, free, slope))
    is_optimal = jnp.all(left <= _ROUNDING * eps_of(x) * size) & jnp.all((x >= lower) & (x <= upper))
    # The factor in the loop belongs to the point before the last step, so it is computed again.
    factor = factor_of(free)
    return BoxMinimum(x, free, factor, is_optimal & jnp.isfinite(factor).all())
