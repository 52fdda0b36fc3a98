"""Derivatives of the projection onto the constraints, by the implicit function theorem.

The closest state to (q, v), in the metric M(q), is

    q' = q - M^-1 A^T mu,   phi(q', t) = 0;        v' = v - M^-1 A^T nu,   A(q') v' = b(q', t),

with M and A taken at q, and A of the holonomic rows for q'. For fixed mu and x = M^-1 A^T mu the change of M^-1 A^T mu is
M^-1 (dA^T mu - dM x): no factorisation is differentiated. The changes of mu and nu follow from the condition that q' and v'
stay on the constraints.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import implicit, kernel, value_and_jvp
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.dynamics import whiten_rows
from jaxdyn.constraints.rank import LeastSquares, least_squares, tolerance
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import MassFactor
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

# Rounding errors of the largest entry below which a residual says nothing: it is a sum of many terms that cancel.
LOST = 64
# Each step multiplies the residual by the size of the correction times the curvature of the constraints. A fixed number, because
# a scan of fixed length has derivatives of both modes and of any order.
_STEPS = 4


class ClosestState(NamedTuple):
    """State (q, v) on the constraints.

    - `of_q`, `of_v`: the multipliers mu, of the holonomic rows, and nu, of all rows.
    - `q_left`, `v_left`: remaining distances of q and v from the constraints.
    - `q_moved`, `v_moved`: one where the correction was applied, else zero.
    """

    q: Array
    v: Array
    of_q: Array
    of_v: Array
    q_left: Array
    v_left: Array
    q_moved: Array
    v_moved: Array


class Corrections(NamedTuple):
    """Steps that remove residuals: by Y = U^-1 A^T in the metric M = U U^T, for all rows and for the holonomic ones."""

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
    on, none = Corrections.at(scene, q, t, rank_tol), jnp.zeros_like(v)

    def remove(residual, of, size):
        """The whitened correction that removes a residual, the distance left, and whether the correction is applied."""

        def step(whitened, _):
            return whitened + of.shortest(residual(on.metric.unwhiten(whitened))), None

        whitened, _ = lax.scan(step, none, None, length=_STEPS)
        before, after = (residual(on.metric.unwhiten(x)) for x in (none, whitened))
        away = jnp.max(jnp.abs(on.shortest(of, after)))
        applied = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
        applied = applied | (away <= LOST * float(jnp.finfo(v.dtype).eps) * size)
        left = jnp.where(applied, away, jnp.max(jnp.abs(on.shortest(of, before))))
        return jnp.where(applied, whitened, none), left, applied.astype(v.dtype)

    place, of_q, q_left, q_moved = q, jnp.zeros((0,), q.dtype), jnp.zeros((), q.dtype), jnp.ones((), q.dtype)
    if on.holonomic.size:
        size = jnp.max(jnp.abs(q))
        whitened, q_left, q_moved = remove(lambda x: kernel(_position)(scene, q, t, x), on.of_holonomic, size)
        place = kernel(_place)(scene, q, on.metric.unwhiten(whitened))
        of_q = on.of_holonomic.multipliers(whitened)
    size = jnp.max(jnp.abs(v))
    whitened, v_left, v_moved = remove(lambda y: kernel(_velocity)(scene, place, v, t, y), on.every, size)
    speed, of_v = v - on.metric.unwhiten(whitened), on.every.multipliers(whitened)
    return ClosestState(place, speed, of_q, of_v, q_left, v_left, q_moved, v_moved)


def _place(scene: Scene, q, x):
    return retract(scene.system, displace(scene.system, q, -x))


def _position(scene: Scene, q, t, x):
    """Residual of positions after a correction x."""
    return position_residual(scene, displace(scene.system, q, -x), t)


def _velocity(scene: Scene, q, v, t, y):
    return velocity_residual(scene, q, v - y, t)


def _forces(scene: Scene, q, t, of_q, of_v, x, y):
    """Imbalance A^T mu - M x and A^T nu - M y of the corrections: zero in value, its derivative gives dA^T mu - dM x."""
    A, M = constraint_jacobian(scene, q, t), mass_matrix(scene.system, q, t)
    return matmul(A[holonomic_rows(layout(scene))].T, of_q) - matmul(M, x), matmul(A.T, of_v) - matmul(M, y)


def _tangent(rank_tol, scene: Scene, q, v, t, steps) -> tuple[ClosestState, ClosestState]:
    """The projection, and its tangent for `steps` in the leaves of the scene, q, v and t."""
    state, on = _closest(scene, q, v, t, rank_tol), Corrections.at(scene, q, t, rank_tol)
    *of_scene, dq, dv, dt = steps
    x = on.by_forces(on.of_holonomic, state.of_q) if on.holonomic.size else jnp.zeros_like(v)
    y = on.by_forces(on.every, state.of_v)

    # First for fixed multipliers, then (`tangent_of`) what the multipliers change by.
    args = scene, q, t, state.of_q, state.of_v, x, y
    change = value_and_jvp(kernel(_forces), args, [*of_scene, dq, dt, None, None, None, None])[1]
    dx, dy = (jnp.zeros_like(v),) * 2 if change is None else map(on.metric.solve, change)

    def tangent_of(residual, args, given, correction, of, moved):
        """Tangents of a correction and of its multipliers, so that the residual stays zero; none if it was not applied."""

        def step(whitened, _):
            # As in the solution, steps with the factor at q: the derivative of the residual is taken at q'.
            change = value_and_jvp(residual, args, [*given, correction + on.metric.unwhiten(whitened)])[1]
            return whitened + moved * of.shortest(change), None

        whitened, _ = lax.scan(step, jnp.zeros_like(v), None, length=_STEPS)
        return correction + on.metric.unwhiten(whitened), of.multipliers(whitened)

    of_q, dplace = jnp.zeros_like(state.of_q), dq
    if on.holonomic.size:
        args = scene, q, t, x
        dx, of_q = tangent_of(kernel(_position), args, [*of_scene, dq, dt], dx, on.of_holonomic, state.q_moved)
        dplace = value_and_jvp(partial(kernel(_place), scene), (q, x), [dq, dx])[1]

    args = scene, state.q, v, t, y
    dy, of_v = tangent_of(kernel(_velocity), args, [*of_scene, dplace, dv, dt], dy, on.every, state.v_moved)
    none = jnp.zeros((), v.dtype)
    dq, dv = (jnp.zeros_like(z) if d is None else d for z, d in ((q, dplace), (v, dv)))
    return state, ClosestState(dq, dv - dy, of_q, of_v, none, none, none, none)
