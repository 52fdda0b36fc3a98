"""Derivatives of the projection onto the constraints, by the implicit function theorem.

The closest state to (q, v), in the metric M(q), is

    q' = q - M^-1 A^T mu,   phi(q', t) = 0;        v' = v - M^-1 A^T nu,   A(q') v' = b(q', t),

with M and A at q. The first A has the holonomic rows alone, the second has all rows. With x = M^-1 A^T mu and fixed mu, the
differential of x is M^-1 (dA^T mu - dM x), which needs no derivative of a factorisation. The differentials of mu and nu follow
from the condition that q' and v' stay on the constraints.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import implicit, kernel, mark_invalid, value_and_jvp, variant
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.dynamics import whiten_rows
from jaxdyn.constraints.rank import least_pivot, pseudo_inverse, quality_of, regular_gram, tolerance
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import MassFactor, cholesky, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

# A residual is a sum of many terms that cancel. Below this many rounding errors of the largest entry it is only rounding.
ROUNDING_FACTOR = 64
# Each step multiplies the residual by the size of the correction times the curvature of the constraints. A fixed number, because
# a scan of fixed length has derivatives of both modes and of any order.
_STEPS = 4


class ClosestState(NamedTuple):
    """State (q, v) on the constraints.

    - `mu`, `nu`: the multipliers of the holonomic rows (for q) and of all rows (for v).
    - `q_distance`, `v_distance`: remaining distances of q and v from the constraints.
    - `q_applied`, `v_applied`: one where the correction was applied, else zero.
    """

    q: Array
    v: Array
    mu: Array
    nu: Array
    q_distance: Array
    v_distance: Array
    q_applied: Array
    v_applied: Array


class LeastSquares(NamedTuple):
    """Minimum-norm solutions w of Y^T w = r, and their coefficients in the columns of Y."""

    Y: Array
    factor: Any  # Cholesky factor of Y^T Y, in kernels; else None
    inverse: Any  # pseudo-inverse of Y, elsewhere; else None

    def shortest(self, right):
        """The shortest w with Y^T w = right."""
        if self.factor is None:
            return matmul(self.inverse.T, right)
        return matmul(self.Y, solve_cholesky(self.factor, right))

    def multipliers(self, w):
        """The smallest x with Y x = w, for w that is a sum of columns."""
        if self.factor is None:
            return matmul(self.inverse, w)
        return solve_cholesky(self.factor, matmul(self.Y.T, w))


def _least_squares_in_kernel(Y, rank_tol) -> LeastSquares:
    factor = cholesky(regular_gram(Y))
    return LeastSquares(Y, mark_invalid(~(quality_of(factor) > least_pivot(Y, rank_tol)), factor), None)


@variant(_least_squares_in_kernel, marks=True)
def least_squares(Y: Float[Array, "n m"], rank_tol: float) -> LeastSquares:
    """Factor a matrix: its pseudo-inverse; in a kernel its Cholesky factor, with dependent columns marked as invalid."""
    return LeastSquares(Y, None, pseudo_inverse(Y, rank_tol))


class Corrections(NamedTuple):
    """Least-squares steps that remove residuals, by Y = U^-1 A^T in the metric M = U U^T, for all rows and for holonomic ones."""

    metric: MassFactor
    every: LeastSquares
    holonomic: Any  # indices of the holonomic rows
    of_holonomic: LeastSquares

    @classmethod
    def at(cls, scene: Scene, q, t, rank_tol) -> "Corrections":
        holonomic = holonomic_rows(layout(scene))
        metric, Y = kernel(whiten_rows)(scene, q, t)
        every = least_squares(Y, tolerance(rank_tol, Y))
        # One factorisation suffices where all rows are holonomic, or none is.
        if holonomic.size in (0, Y.shape[1]):
            return cls(metric, every, holonomic, every)
        return cls(metric, every, holonomic, least_squares(Y[:, holonomic], tolerance(rank_tol, Y)))

    def by_forces(self, of: LeastSquares, multipliers):
        """M^-1 A^T times multipliers."""
        return self.metric.unwhiten(matmul(of.Y, multipliers))

    def shortest(self, of: LeastSquares, residual):
        """The shortest step that changes the rows by `residual`."""
        return self.metric.unwhiten(of.shortest(residual))


def closest_state(scene: Scene, q, v, t, rank_tol: float | None) -> ClosestState:
    """The state on the constraints closest to a given one nearby, after `_STEPS` steps, with derivatives of any order.

    A correction that leaves a larger residual is not applied, unless the residual is rounding.
    """
    return _closest(scene, retract(scene.system, q), v, t, rank_tol)


def _closest(scene: Scene, q, v, t, rank_tol) -> ClosestState:
    # The tangent calls this function again, so that derivatives of derivatives are implicit too.
    return implicit(scene, (q, v, t), partial(_solve, rank_tol), partial(_tangent, rank_tol))


def _solve(rank_tol, scene: Scene, q, v, t) -> ClosestState:
    corrections, none = Corrections.at(scene, q, t, rank_tol), jnp.zeros_like(v)

    def remove(residual, of, size):
        """The whitened correction that removes a residual, the distance left, and whether the correction is applied."""

        def step(whitened, _):
            return whitened + of.shortest(residual(corrections.metric.unwhiten(whitened))), None

        whitened, _ = lax.scan(step, none, None, length=_STEPS)
        before, after = (residual(corrections.metric.unwhiten(x)) for x in (none, whitened))
        away = jnp.max(jnp.abs(corrections.shortest(of, after)))
        applied = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
        applied = applied | (away <= ROUNDING_FACTOR * float(jnp.finfo(v.dtype).eps) * size)
        left = jnp.where(applied, away, jnp.max(jnp.abs(corrections.shortest(of, before))))
        return jnp.where(applied, whitened, none), left, applied.astype(v.dtype)

    place, mu, q_distance, q_applied = q, jnp.zeros((0,), q.dtype), jnp.zeros((), q.dtype), jnp.ones((), q.dtype)
    if corrections.holonomic.size:
        size = jnp.max(jnp.abs(q))
        whitened, q_distance, q_applied = remove(
            lambda x: kernel(_position)(scene, q, t, x), corrections.of_holonomic, size
        )
        place = kernel(_place)(scene, q, corrections.metric.unwhiten(whitened))
        mu = corrections.of_holonomic.multipliers(whitened)
    size = jnp.max(jnp.abs(v))
    whitened, v_distance, v_applied = remove(
        lambda y: kernel(_velocity)(scene, place, v, t, y), corrections.every, size
    )
    speed, nu = v - corrections.metric.unwhiten(whitened), corrections.every.multipliers(whitened)
    return ClosestState(place, speed, mu, nu, q_distance, v_distance, q_applied, v_applied)


def _place(scene: Scene, q, x):
    return retract(scene.system, displace(scene.system, q, -x))


def _position(scene: Scene, q, t, x):
    """Residual of positions after a correction x."""
    return position_residual(scene, displace(scene.system, q, -x), t)


def _velocity(scene: Scene, q, v, t, y):
    return velocity_residual(scene, q, v - y, t)


def _forces(scene: Scene, q, t, mu, nu, x, y):
    """Imbalance A^T mu - M x and A^T nu - M y of the corrections: zero in value, its derivative gives dA^T mu - dM x."""
    A, M = constraint_jacobian(scene, q, t), mass_matrix(scene.system, q, t)
    return matmul(A[holonomic_rows(layout(scene))].T, mu) - matmul(M, x), matmul(A.T, nu) - matmul(M, y)


def _tangent(rank_tol, scene: Scene, q, v, t, steps) -> tuple[ClosestState, ClosestState]:
    """The projection, and its tangent for `steps` in the leaves of the scene, q, v and t."""
    state, corrections = _closest(scene, q, v, t, rank_tol), Corrections.at(scene, q, t, rank_tol)
    *of_scene, dq, dv, dt = steps
    x = corrections.by_forces(corrections.of_holonomic, state.mu) if corrections.holonomic.size else jnp.zeros_like(v)
    y = corrections.by_forces(corrections.every, state.nu)

    # First the tangent for fixed multipliers; `tangent_of` adds that of the multipliers.
    args = scene, q, t, state.mu, state.nu, x, y
    change = value_and_jvp(kernel(_forces), args, [*of_scene, dq, dt, None, None, None, None])[1]
    dx, dy = (jnp.zeros_like(v),) * 2 if change is None else map(corrections.metric.solve, change)

    def tangent_of(residual, args, given, correction, of, moved):
        """Tangents of a correction and of its multipliers, so that the residual stays zero; none if it was not applied."""

        def step(whitened, _):
            # The factor is that at q, as in the solution, while the derivative of the residual is taken at q': hence iterations.
            change = value_and_jvp(residual, args, [*given, correction + corrections.metric.unwhiten(whitened)])[1]
            return whitened + moved * of.shortest(change), None

        whitened, _ = lax.scan(step, jnp.zeros_like(v), None, length=_STEPS)
        return correction + corrections.metric.unwhiten(whitened), of.multipliers(whitened)

    mu, dplace = jnp.zeros_like(state.mu), dq
    if corrections.holonomic.size:
        args = scene, q, t, x
        dx, mu = tangent_of(kernel(_position), args, [*of_scene, dq, dt], dx, corrections.of_holonomic, state.q_applied)
        dplace = value_and_jvp(partial(kernel(_place), scene), (q, x), [dq, dx])[1]

    args = scene, state.q, v, t, y
    dy, nu = tangent_of(kernel(_velocity), args, [*of_scene, dplace, dv, dt], dy, corrections.every, state.v_applied)
    none = jnp.zeros((), v.dtype)
    dq, dv = (jnp.zeros_like(z) if d is None else d for z, d in ((q, dplace), (v, dv)))
    return state, ClosestState(dq, dv - dy, mu, nu, none, none, none, none)
