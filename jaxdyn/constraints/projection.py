"""Putting a state that has drifted from its constraints by little back onto them, by the least change."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile import implicit, is_standalone, kernel, mark_invalid, value_and_jvp, variant
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.dynamics import whitened_rows
from jaxdyn.constraints.projection_derivative import LOST, Corrections, projected
from jaxdyn.constraints.rank import least_pivot, least_pivot_of, pseudo_inverse, quality_of, regular_gram, tolerance
from jaxdyn.constraints.selection import is_selected, rows_of
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, retract

_STEPS_A_ROUND, _MOST_ROUNDS = 2, 3


def project_state(scene: Scene, q, v, t, rank_tol: float | None = None):
    """q and v moved by the least change, in the metric M(q), onto the constraints, from a small distance.

    One factorisation serves all steps: with B fixed, each step multiplies the residual by the size of the correction
    times the curvature of the constraint, 1e-8 -> 1e-16 after one. The steps end when the next one would be lost in rounding.
    Derivatives are those of the equations that the result satisfies (`projection_derivative`). A projection that does not
    reduce the residual is not applied.
    """
    return project_step(scene, q, v, t, (), rank_tol)[:2]


def project_step(scene: Scene, q, v, t, errors: tuple = (), rank_tol: float | None = None) -> Any:
    """`project_state` for the end of a step with estimated errors of q, and of v, each (nv,): (q, v, errors).

    Errors come back without their parts normal to the constraints: as far as small ones go, those are what is removed from
    q and v. Near a singular position they are large, and shorter steps make them no smaller. What the projection leaves open
    is added.
    """

    def project(scene, q, v, t, *errors):
        return _project(scene, rank_tol, q, v, t, errors)

    def tangent(scene, q, v, t, *rest):
        *errors, steps = rest

        def again(scene, q, v, t, *errors):
            return kernel(_with_derivatives, static=1)(rank_tol, scene, q, v, t, errors)

        projected, moved = value_and_jvp(again, (scene, q, v, t, *errors), steps)
        return projected, jax.tree.map(jnp.zeros_like, projected) if moved is None else moved

    errors = lax.stop_gradient(tuple(errors))
    return implicit(Scene(scene.system, scene.constraints), (q, v, t, *errors), project, tangent)


def _project(scene: Scene, rank_tol, q, v, t, errors):
    """A few steps from one factorisation of the rows; where these were not enough, the next round factors them anew."""
    q = retract(scene.system, q)
    is_wide = layout(scene)[-1].end > scene.nv and not is_selected(scene)
    return (_by_rank if is_wide else _rounds)(rank_tol, scene, q, v, t, errors)


def _one_round(rank_tol, scene: Scene, q, v, t, errors):
    *projected, more = _by_pivots(rank_tol, scene, q, v, t, errors)
    # A kernel has no loop that ends by its numbers: samples that need another round are computed again outside of it.
    return jax.tree.map(lambda x: mark_invalid(more, x), tuple(projected))


@variant(_one_round, marks=True)
def _rounds(rank_tol, scene: Scene, q, v, t, errors):
    by_kernel = kernel(_by_pivots, static=1, fallback=_by_rank_alone, derivative=False)

    def again(q, v, _):
        return *by_kernel(rank_tol, scene, q, v, t, errors), ()

    return _in_rounds(again, again(q, v, ()))[:3]


def _in_rounds(again: Callable, first):
    """`first` = (q, v, errors, whether to go on, anything), and again(q, v, anything) until that is not, `_MOST_ROUNDS` in
    all."""

    if is_standalone():
        # A program of numbers has no loop of unknown length: all rounds are written out, and those that are needed count.
        projected = tuple(first)
        for _ in range(_MOST_ROUNDS - 1):
            q, v, _, more, anything = projected
            following = again(q, v, anything)
            projected = jax.tree.map(lambda new, old, more=more: jnp.where(more, new, old), tuple(following), projected)
        q, v, errors, _, anything = projected
        return q, v, errors, anything

    def step(state):
        count, (q, v, _, _, more) = state
        return count + 1, again(q, v, more)

    def unfinished(state):
        count, projected = state
        return projected[3] & (count < _MOST_ROUNDS)

    q, v, errors, _, anything = lax.while_loop(unfinished, step, (1, tuple(first)))[1]
    return q, v, errors, anything


def _by_rank(rank_tol, scene: Scene, q, v, t, errors):
    """(q, v, errors) for rows that may depend on each other."""
    holonomic = holonomic_rows(layout(scene))

    def again(q, v, _):
        metric, Y = kernel(whitened_rows)(scene, q, t)
        every = pseudo_inverse(Y, tolerance(rank_tol, Y))
        some = every if holonomic.size in (0, Y.shape[1]) else pseudo_inverse(Y[:, holonomic], tolerance(rank_tol, Y))
        return *_moved_by_matrices(scene, q, v, t, errors, metric, every, some), ()

    return _in_rounds(again, again(q, v, ()))[:3]


def _by_rank_alone(rank_tol, scene: Scene, q, v, t, errors):
    """`_by_rank`, after which no round is left."""
    return *_by_rank(rank_tol, scene, q, v, t, errors), jnp.zeros((), bool)


@kernel
def _moved_by_matrices(scene: Scene, q, v, t, errors, metric, every, some):
    """`_moved` with the pseudo-inverses of U^-1 A^T for all rows, and for those on positions."""

    def steps(inverse):
        return lambda residual: metric.unwhiten(matmul(inverse.T, residual))

    return _moved(scene, q, v, t, errors, steps(every), steps(some))


def _by_pivots(rank_tol, scene: Scene, q, v, t, errors):
    """q, v and errors after a few steps, and whether a step more would help; not valid where rows may depend on each other."""
    holonomic = holonomic_rows(layout(scene))
    metric, Y = whitened_rows(scene, q, t)

    def steps(Y):
        gram = regular_gram(Y) if is_selected(scene) else matmul(Y.T, Y)
        factor = cholesky(gram)
        quality = quality_of(factor)
        if is_selected(scene):
            # Other rows may be independent where these hardly are: `renew_rows`.
            *kept, least = rows_of(scene, Y.dtype)
            is_poor = jnp.any(jnp.stack(kept) == 0) & ~(least_pivot_of(Y) > least)
            quality = jnp.where(is_poor, jnp.nan, quality)
        return (lambda residual: metric.unwhiten(matmul(Y, solve_cholesky(factor, residual)))), quality

    every, quality = steps(Y)
    some = every
    if holonomic.size not in (0, Y.shape[1]):
        some, of_holonomic = steps(Y[:, holonomic])
        quality = jnp.minimum(quality, of_holonomic)
    quality = jnp.where(metric.is_definite(), quality, jnp.nan)
    *projected, more = _moved(scene, q, v, t, errors, every, some)
    is_poor = ~(quality > least_pivot(q, rank_tol))
    return *jax.tree.map(lambda x: mark_invalid(is_poor, x), tuple(projected)), more


def _moved(scene: Scene, q, v, t, errors, every: Callable, some: Callable):
    """q, v and errors on the constraints, and whether another step would help.

    `every(r)` is the shortest step, in the metric M, that removes the residual r of all rows, `some(r)` of those on positions.
    """
    holonomic = holonomic_rows(layout(scene))
    position_left, is_open = jnp.zeros((), q.dtype), jnp.asarray(False)
    if holonomic.size:
        q, position_left, is_open = _closed(scene, q, some, lambda place: position_residual(scene, place, t))

    none, size = jnp.zeros_like(v), jnp.max(jnp.abs(v))
    y, velocity_left, is_slipping = _descend(none, size, every, lambda y: velocity_residual(scene, q, v - y, t))
    v = v - y
    if errors:
        A = constraint_jacobian(scene, q, t)
        of_place = some if holonomic.size else None
        errors = _allowed(
            errors,
            (of_place, partial(matmul, A[holonomic]), position_left),
            (every, partial(matmul, A), velocity_left),
        )
    return q, v, errors, is_open | is_slipping


def _allowed(errors: tuple, *corrections) -> tuple:
    """Errors less the least change that removes what they add to the rows, and with what is left open.

    A correction is (step, rate of the rows along an error, distance left); its step is None for no rows.
    """

    def allowed(error, step, rate, left):
        return error if step is None else enlarged(error - step(rate(error)), left)

    return tuple(allowed(error, *correction) for error, correction in zip(errors, corrections, strict=False))


def enlarged(error, by):
    """An error of either sign, larger by the size of another one."""
    return error + jnp.where(error < 0, -jnp.abs(by), jnp.abs(by))


def _closed(scene: Scene, q, step, residual):
    """q on the holonomic constraints, an estimate of its distance from them, and whether another step would reduce it."""

    def moved(x):
        return retract(scene.system, displace(scene.system, q, -x))

    none, size = jnp.zeros((scene.nv,), q.dtype), jnp.max(jnp.abs(q))
    x, away, more = _descend(none, size, step, lambda x: residual(moved(x)))
    return moved(x), away, more


def _descend(x, size, step, residual):
    """x made longer by step(residual(x)) until that would change what it is taken from, of entries up to `size`, by rounding
    alone, `_STEPS_A_ROUND` times at most.

    Also the largest entry of the next step, which is about how far it is still away, and whether to take it.
    """
    rounding = float(jnp.finfo(x.dtype).eps) * size

    def improve(state):
        x, r, _, _ = state
        change = step(r)
        tried = x + change
        left = residual(tried)
        before, after, length = (jnp.max(jnp.abs(y)) for y in (r, left, change))
        falls = after < before
        # The next step is about this one times what it has left of the residual.
        more = falls & (length * after > rounding * before)
        away = jnp.where(falls, length * after / before, jnp.where(before > 0, length, jnp.zeros_like(length)))
        return jnp.where(falls, tried, x), jnp.where(falls, left, r), more, away

    first = residual(x)
    state = x, first, jnp.max(jnp.abs(first)) > 0, jnp.zeros((), x.dtype)
    for _ in range(_STEPS_A_ROUND):
        state = jax.tree.map(partial(jnp.where, state[2]), improve(state), state)
    x, _, more, away = state
    return x, away, more & (away > LOST * rounding)


def _with_derivatives(rank_tol, scene: Scene, q, v, t, errors):
    """The same as equations that the result satisfies."""
    state, errors = projected(scene, q, v, t, rank_tol), lax.stop_gradient(errors)
    if errors:
        q = lax.stop_gradient(retract(scene.system, q))
        on, A = Corrections.at(scene, q, t, rank_tol), constraint_jacobian(scene, q, t)
        of_place = partial(on.shortest, on.of_held) if on.held.size else None
        errors = _allowed(
            errors,
            (of_place, partial(matmul, A[on.held]), state.q_left),
            (partial(on.shortest, on.every), partial(matmul, A), state.v_left),
        )
    return state.q, state.v, lax.stop_gradient(errors)
