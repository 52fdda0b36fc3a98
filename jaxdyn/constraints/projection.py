"""Projection of a state that has drifted slightly from its constraints back onto them, by the least change; derivatives."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import batch, implicit, kernel, mark_invalid, value_and_jvp
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.dynamics import whiten_rows
from jaxdyn.constraints.rank import (
    NEAR,
    LeastSquares,
    least_squares,
    min_pivot_of,
    min_refinable_pivot,
    pseudo_inverse,
    quality_of,
    regular_gram,
    tolerance,
)
from jaxdyn.constraints.redundancy import has_selection, rows_of
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import MassFactor, cholesky, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

# Steps with one factorisation, and factorisations. Steps of an integrator drift by 1e-8 or less, where two steps with one factor
# reach rounding. More rounds are needed after long steps and near singular positions, where A turns quickly.
_STEPS_A_ROUND, _MAX_ROUNDS = 2, 3
# A residual is a sum of many terms that cancel. Below this many rounding errors of the largest entry it is only rounding.
ROUNDING_FACTOR = 64
# Each step multiplies the residual by the size of the correction times the curvature of the constraints. A fixed number, because
# a scan of fixed length has derivatives of both modes and of any order.
_DERIVATIVE_STEPS = 4


def project_state(scene: Scene, q, v, t, rank_tol: float | None = None):
    """Move q and v by the least change, in the metric M(q), onto the constraints, from a small distance.

    All steps share one factorisation: with B fixed, each step multiplies the residual by the size of the correction
    times the curvature of the constraint, 1e-8 -> 1e-16 after one. The steps end when the next one would be lost in rounding.
    Derivatives are those of the equations that the result satisfies (`closest_state`). A projection that does not
    reduce the residual is not applied.
    """
    return project_step(scene, q, v, t, (), rank_tol)[:2]


def project_step(scene: Scene, q, v, t, errors: tuple = (), rank_tol: float | None = None) -> Any:
    """`project_state` at the end of a step with estimated errors of q, and of v, each (nv,): (q, v, errors, is_poor).

    `is_poor`: one where another choice of rows may be independent, as these are nearly dependent (`renew_rows`), else zero.
    Errors are returned without their components normal to the constraints, which the projection removes from q and v to first
    order. Near a singular position these are large, and shorter steps do not make them smaller: the step size would collapse. The
    residual that the projection leaves is added.
    """

    def project(scene, q, v, t, *errors):
        q = retract(scene.system, q)
        if layout(scene)[-1].end > scene.nv and not has_selection(scene):
            return *_by_rank(rank_tol, scene, q, v, t, errors), jnp.zeros((), q.dtype)
        by_kernel = kernel(_by_pivots, static=1, fallback=_by_rank_in_full, derivative=False)
        *state, is_poor = _in_rounds(lambda q, v: by_kernel(rank_tol, scene, q, v, t, errors), q, v, errors)
        return *state, jnp.asarray(is_poor).astype(q.dtype)

    def tangent(scene, q, v, t, *rest):
        *errors, steps = rest

        def again(scene, q, v, t, *errors):
            return kernel(_with_derivatives, static=1)(rank_tol, scene, q, v, t, errors)

        state, change = value_and_jvp(again, (scene, q, v, t, *errors), steps)
        return state, jax.tree.map(jnp.zeros_like, state) if change is None else change

    # Errors decide step sizes, which have no derivatives. The scene enters without forces, which constraints do not see.
    errors = lax.stop_gradient(tuple(errors))
    return implicit(scene.without_forces, (q, v, t, *errors), project, tangent)


def _in_rounds(again: Callable, q, v, errors):
    """Rounds of a few steps, each with one factorisation of the rows.

    Repeats again(q, v) -> (q, v, errors, are_poor, more) while `more`, once at least and `_MAX_ROUNDS` times at most.
    """
    start = q, v, errors, False, True
    return batch.repeat_while(lambda state: state[4], lambda state: tuple(again(*state[:2])), start, _MAX_ROUNDS)[:4]


def _by_rank(rank_tol, scene: Scene, q, v, t, errors):
    """(q, v, errors) for rows that may be dependent."""
    holonomic = holonomic_rows(layout(scene))

    def again(q, v):
        metric, Y = kernel(whiten_rows)(scene, q, t)
        every = pseudo_inverse(Y, tolerance(rank_tol, Y))
        some = every if holonomic.size in (0, Y.shape[1]) else pseudo_inverse(Y[:, holonomic], tolerance(rank_tol, Y))
        *state, more = _correct_by_matrices(scene, q, v, t, errors, metric, every, some)
        return *state, jnp.zeros((), bool), more

    return _in_rounds(again, q, v, errors)[:3]


def _by_rank_in_full(rank_tol, scene: Scene, q, v, t, errors):
    """`_by_rank` in the form of `_by_pivots`: it has done all rounds, so that none is left."""
    are_poor = jnp.any(scene.kept_rows.kept == 0) if has_selection(scene) else jnp.zeros((), bool)
    return *_by_rank(rank_tol, scene, q, v, t, errors), are_poor, jnp.zeros((), bool)


@kernel
def _correct_by_matrices(scene: Scene, q, v, t, errors, metric, every, some):
    """`_correct` with the pseudo-inverses of U^-1 A^T for all rows, and for those on positions."""

    def steps(inverse):
        return lambda residual: metric.unwhiten(matmul(inverse.T, residual))

    return _correct(scene, q, v, t, errors, steps(every), steps(some))


def _by_pivots(rank_tol, scene: Scene, q, v, t, errors):
    """q, v and errors after a few steps; whether the choice of rows is poor, and whether another step would help.

    Invalid where rows may be dependent.
    """
    holonomic = holonomic_rows(layout(scene))
    metric, Y = whiten_rows(scene, q, t)

    def steps(Y):
        gram = regular_gram(Y) if has_selection(scene) else matmul(Y.T, Y)
        factor = cholesky(gram)
        are_poor = jnp.zeros((), bool)
        if has_selection(scene):
            # Another choice may be independent where this one is nearly dependent (`renew_rows`).
            *kept, minimum = rows_of(scene, Y.dtype)
            are_poor = jnp.any(jnp.stack(kept) == 0) & ~(min_pivot_of(Y) > minimum)
        step = lambda residual: metric.unwhiten(matmul(Y, solve_cholesky(factor, residual)))  # noqa: E731
        return step, quality_of(factor), are_poor

    every, quality, are_poor = steps(Y)
    some = every
    if holonomic.size not in (0, Y.shape[1]):
        some, of_holonomic, some_are_poor = steps(Y[:, holonomic])
        quality, are_poor = jnp.minimum(quality, of_holonomic), are_poor | some_are_poor
    quality = jnp.where(metric.is_definite(), quality, jnp.nan)
    *state, more = _correct(scene, q, v, t, errors, every, some)
    # Not `min_pivot`: the steps correct each other, so that a factor with few digits costs a step, not accuracy.
    is_poor = ~(quality > min_refinable_pivot(q, rank_tol))
    return *jax.tree.map(lambda x: mark_invalid(is_poor, x), tuple(state)), are_poor, more


def _correct(scene: Scene, q, v, t, errors, every: Callable, some: Callable):
    """q, v and errors on the constraints, and whether another step would help.

    `every(r)` is the shortest step, in the metric M, that removes the residual r of all rows, `some(r)` of those on positions.
    """
    holonomic = holonomic_rows(layout(scene))
    position_left, is_open = jnp.zeros((), q.dtype), jnp.asarray(False)
    if holonomic.size:
        opening = lambda x, q=q: position_residual(scene, _place(scene, q, x), t)  # noqa: E731
        x, position_left, is_open = _descend(jnp.zeros_like(v), jnp.max(jnp.abs(q)), some, opening)
        q = _place(scene, q, x)

    # Velocities after positions: A at the corrected q. They are linear, so that a second step removes what the old factor left.
    none, size = jnp.zeros_like(v), jnp.max(jnp.abs(v))
    y, velocity_left, is_slipping = _descend(none, size, every, lambda y: velocity_residual(scene, q, v - y, t))
    v = v - y
    if errors:
        A = constraint_jacobian(scene, q, t)
        of_place = some if holonomic.size else None
        turn = _turn_by_rounding(scene, q, v, t, A[holonomic], some, every) if holonomic.size else 0.0
        errors = _tangential_errors(
            errors,
            (of_place, partial(matmul, A[holonomic]), position_left),
            (every, partial(matmul, A), velocity_left + turn),
        )
    return q, v, errors, is_open | is_slipping


def _tangential_errors(errors: tuple, *corrections) -> tuple:
    """Components of errors tangential to the constraints, enlarged by the distances left.

    A correction is (step, rate of the rows along an error, distance left); its step is None for no rows.
    """

    def tangential(error, step, rate, left):
        return error if step is None else enlarge(error - step(rate(error)), left)

    # Errors of q alone, or of q and v: fewer errors than corrections are allowed.
    return tuple(tangential(error, *correction) for error, correction in zip(errors, corrections, strict=False))


def _turn_by_rounding(scene: Scene, q, v, t, A, some: Callable, every: Callable):
    """Largest change of v, (), where rounding moves q off the constraints, whose rows are A (nh, nv); zero up to `NEAR` of v.

    `some` and `every` as of `_correct`. At a distance d from a position where branches of the constraints meet it is eps/d^2 of
    v: very near, rounding decides on which branch the motion goes on, however short its steps are.
    """
    eps = float(jnp.finfo(v.dtype).eps)
    # Rows lose their size where branches meet, but not the rounding of their terms.
    rounding = jnp.full(A.shape[0], eps * jnp.max(jnp.abs(q), initial=1.0) * jnp.max(jnp.abs(A)))
    turned = every(velocity_residual(scene, _place(scene, q, some(rounding)), v, t))
    turn = jnp.max(jnp.abs(turned))
    return jnp.where(turn > eps**NEAR * jnp.max(jnp.abs(v)), turn, jnp.zeros_like(turn))


def enlarge(error, by):
    """An error of either sign with its size increased by that of another one."""
    return error + jnp.where(error < 0, -jnp.abs(by), jnp.abs(by))


def _descend(x, size, step, residual):
    """Add step(residual(x)) to the correction x, `_STEPS_A_ROUND` times at most, until that changes a state by rounding alone.

    `size` is the largest entry of the state. Also the largest entry of the next step, an estimate of the distance left (zero
    where it is rounding), and whether to make it.
    """
    rounding = float(jnp.finfo(x.dtype).eps) * size

    def improve(state):
        x, r, _, _ = state
        change = step(r)
        tried = x + change
        left = residual(tried)
        before, after, length = (jnp.max(jnp.abs(y)) for y in (r, left, change))
        # A step that does not reduce the residual is not made: the state was at rounding, or too far away for this factor.
        falls = after < before
        # The next step is about this one times the ratio of the residuals.
        more = falls & (length * after > rounding * before)
        away = jnp.where(falls, length * after / before, jnp.where(before > 0, length, jnp.zeros_like(length)))
        return jnp.where(falls, tried, x), jnp.where(falls, left, r), more, away

    first = residual(x)
    # Unrolled: a kernel has no loop, and two steps are fewer than a loop would save.
    state = x, first, jnp.max(jnp.abs(first)) > 0, jnp.zeros((), x.dtype)
    for _ in range(_STEPS_A_ROUND):
        state = jax.tree.map(partial(jnp.where, state[2]), improve(state), state)
    x, _, more, away = state
    # Rounding that counted as an error would not fall with the step: in float32 it is larger than the tolerances.
    is_away = away > ROUNDING_FACTOR * rounding
    return x, jnp.where(is_away, away, jnp.zeros_like(away)), more & is_away


def _with_derivatives(rank_tol, scene: Scene, q, v, t, errors):
    """`project_step` as equations that its result satisfies, for its derivatives."""
    q = retract(scene.system, q)
    state, errors = closest_state(scene, q, v, t, rank_tol), lax.stop_gradient(errors)
    if errors:
        q = lax.stop_gradient(q)
        on, A = Corrections.at(scene, q, t, rank_tol), constraint_jacobian(scene, q, t)
        of_place, every = partial(on.shortest, on.of_holonomic), partial(on.shortest, on.every)
        some = A[on.holonomic]
        turn = _turn_by_rounding(scene, q, state.v, t, some, of_place, every) if on.holonomic.size else 0.0
        errors = _tangential_errors(
            errors,
            (of_place if on.holonomic.size else None, partial(matmul, some), state.q_distance),
            (every, partial(matmul, A), state.v_distance + turn),
        )
    return state.q, state.v, lax.stop_gradient(errors), jnp.zeros((), q.dtype)


# Derivatives of the projection onto the constraints, by the implicit function theorem.
#
# The closest state to (q, v), in the metric M(q), is
#
#     q' = q - M^-1 A^T mu,   phi(q', t) = 0;        v' = v - M^-1 A^T nu,   A(q') v' = b(q', t),
#
# with M and A at q. The first A has the holonomic rows alone, the second has all rows. With x = M^-1 A^T mu and fixed mu, the
# differential of x is M^-1 (dA^T mu - dM x), which needs no derivative of a factorisation. The differentials of mu and nu follow
# from the condition that q' and v' stay on the constraints.


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
    """The state on the constraints closest to a given one nearby, q on its manifold, with derivatives of any order.

    A correction that leaves a larger residual is not applied, unless the residual is rounding.
    """
    # The tangent calls this function again, so that derivatives of derivatives are implicit too.
    return implicit(scene, (q, v, t), partial(_solve, rank_tol), partial(_tangent, rank_tol))


def _solve(rank_tol, scene: Scene, q, v, t) -> ClosestState:
    corrections, none = Corrections.at(scene, q, t, rank_tol), jnp.zeros_like(v)

    def remove(residual, of, size):
        """The whitened correction that removes a residual, the distance left, and whether the correction is applied."""

        def step(whitened, _):
            return whitened + of.shortest(residual(corrections.metric.unwhiten(whitened))), None

        whitened, _ = lax.scan(step, none, None, length=_DERIVATIVE_STEPS)
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
    state, corrections = closest_state(scene, q, v, t, rank_tol), Corrections.at(scene, q, t, rank_tol)
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

        whitened, _ = lax.scan(step, jnp.zeros_like(v), None, length=_DERIVATIVE_STEPS)
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
