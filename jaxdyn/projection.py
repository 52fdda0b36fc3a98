"""Putting a state that has drifted from its constraints by little back onto them, by the least change."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn._anywhere import anywhere, mended
from jaxdyn._dispatch import LEAST_BATCH
from jaxdyn._implicit import along, implicit
from jaxdyn._materialize import at_least
from jaxdyn._one_kernel import MOST_AT_ONCE, Kernel, kernel_of
from jaxdyn._rank import least_pivot, normal_factor, pseudo_inverse, quality_of, tolerance
from jaxdyn._scalar_program import is_written_out
from jaxdyn._small import cholesky, definite, solve_factored, solve_lower
from jaxdyn._tracing import is_staged, split, traced_once
from jaxdyn._ways import is_careful, is_straight
from jaxdyn.closed_projection import Closing, ClosingInKernels, Kernels, kernels
from jaxdyn.constrained import (
    by_the_batch,
    correction,
    has_long_recursion,
    has_short_recursion,
    in_one_batch,
)
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.dynamics import mass_matrix
from jaxdyn.scene import Scene
from jaxdyn.so3 import _product
from jaxdyn.systems import displace, retract

_MOST_STEPS = 4
_STEPS_WRITTEN, _MOST_ROUNDS = 2, 3  # in a kernel


def project_state(scene: Scene, q, v, t, rank_tol: float | None = None):
    """q and v moved by the least change, in the metric M(q), onto the constraints, from a small distance.

    One factorisation serves all steps: with B fixed, each step multiplies the residual by the size of the correction
    times the curvature of the constraint, 1e-8 -> 1e-16 after one. The steps end when the next one would be lost in rounding.
    Those that are differentiated are a fixed number, so that derivatives converge as far. A projection that does not
    reduce the residual is not applied.
    """
    return project_step(scene, q, v, t, (), rank_tol, once=True)[:2]


def project_step(scene: Scene, q, v, t, errors: tuple = (), rank_tol: float | None = None, *, once: bool = False):
    """`project_state` for the end of a step with estimated errors of q, and of v, each (nv,): (q, v, errors).

    Errors come back without their parts normal to the constraints: as far as small ones go, those are what is removed from
    q and v. Near a singular position they are large, and shorter steps make them no smaller. What the projection leaves open
    is added. What is done `once`, and not in every step, is not worth a kernel (see `_one_kernel`), except where it has to be
    `straight`, and of many bodies, whose other programs compile for longer.
    """

    def project(scene, q, v, t, *errors):
        def whole(scene, *state):
            return traced_once(_by_the_batch, scene, *state, static=(rank_tol, once))

        return in_one_batch(whole, scene, q, v, t, errors)

    def tangent(scene, q, v, t, *rest):
        *errors, steps = rest

        def careful(scene, q, v, t, *errors):
            return traced_once(_in_fixed_steps, scene, q, v, t, errors, static=(rank_tol,))

        found, moved = along(careful, (scene, q, v, t, *errors), steps)
        return found, jax.tree.map(jnp.zeros_like, found) if moved is None else moved

    errors = lax.stop_gradient(tuple(errors))
    return implicit(Scene(scene.system, scene.constraints), (q, v, t, *errors), project, tangent)


def _by_the_batch(scene: Scene, q, v, t, errors, rank_tol, once: bool):
    q = retract(scene.system, q)
    is_long, in_kernels = has_long_recursion(scene), None
    staged = is_staged() and layout(scene)[-1].end <= scene.nv and (not once or is_long or is_straight())
    if staged and not is_long:
        whole = kernel_of(_in_numbers, scene, q, v, t, *errors, most=MOST_AT_ONCE)
        if whole is not None:
            return _by_kernel(scene, rank_tol, whole, q, v, t, errors)
    if staged and has_short_recursion(scene):
        in_kernels = kernels(scene.system, scene.constraints, q, v, long=is_long, often=not once)
    short, long = partial(_by_recursion, scene, rank_tol, in_kernels), partial(_by_matrices, scene, rank_tol)
    return by_the_batch(scene, short, long, q, v, t, errors, on_cpu=in_kernels is not None)


class _Correction(NamedTuple):
    """B r = L^-T Z (C C^T)^-1 r, the shortest step in the metric M = L L^T that removes the residual r."""

    L: Array
    Z: Array
    C: Array

    @property
    def quality(self):
        """Least over largest pivot of the rows."""
        return quality_of(self.C)

    def step(self, residual):
        """B r."""
        along_rows = _product(self.Z, solve_factored(self.C, residual))
        return solve_lower(self.L, along_rows, transposed=True)


def _correction(L, Y, rank_tol) -> _Correction:
    """From Y = L^-1 A^T: by its normal equations, or by its pseudo-inverse where the rows are close to dependent."""
    if Y.shape[1] > Y.shape[0] or is_careful():
        return _Correction(L, pseudo_inverse(Y, tolerance(rank_tol, Y), True).T, jnp.eye(Y.shape[1], dtype=Y.dtype))
    C, independent = normal_factor(Y, rank_tol)

    def by_rank():
        return pseudo_inverse(Y, tolerance(rank_tol, Y), True).T, jnp.eye(Y.shape[1], dtype=Y.dtype)

    return _Correction(L, *lax.cond(anywhere(~independent), by_rank, lambda: (Y, C)))


def _by_matrices(scene: Scene, rank_tol, q, v, t, errors):
    held = holonomic_rows(layout(scene))
    L = cholesky(mass_matrix(scene.system, q, t))
    Y = solve_lower(L, constraint_jacobian(scene, q, t).T)
    every = _correction(L, Y, rank_tol)
    some = every if held.size in (0, Y.shape[1]) else _correction(L, Y[:, held], rank_tol)
    apart = jnp.zeros((), q.dtype)
    if held.size:
        q, apart, _ = _closed(scene, q, some.step, lambda place: position_residual(scene, place, t))
    v, slip, _ = _descend(v, every.step, lambda v: velocity_residual(scene, q, v, t), lambda v, step: v - step)
    if errors:
        A = constraint_jacobian(scene, q, t)
        of_place = some.step if held.size else None
        errors = _allowed(
            errors, (of_place, partial(_product, A[held]), apart), (every.step, partial(_product, A), slip)
        )
    return q, v, errors


def _by_recursion(scene: Scene, rank_tol, in_kernels: Kernels | None, q, v, t, errors):
    """Loops of a tree in a large batch, or in any by kernels; by matrices the samples with rows that are close to dependent."""
    tree = scene.system, scene.constraints
    with at_least(LEAST_BATCH):
        closing = Closing(*tree, q) if in_kernels is None else ClosingInKernels(*tree, q, in_kernels)
        *found, quality, _ = _loops_closed(scene, closing, q, v, errors)
    return _mended(scene, rank_tol, tuple(found), quality, q, v, t, errors)


def _by_kernel(scene: Scene, rank_tol, kernel: Kernel, q, v, t, errors):
    """The same in one kernel: a round takes few steps, the next one factors the rows anew where these were not enough."""

    def more(state):
        return state[-1]

    def again(state):
        count, (place, speed, _), quality, _ = state
        *found, pivots, more = kernel(partial(_elsewhere, scene), place, speed, t, *errors)
        return count + 1, tuple(found), jnp.minimum(quality, pivots), more & (count + 1 < _MOST_ROUNDS)

    best = jnp.asarray(jnp.inf, q.dtype)
    _, found, quality, _ = lax.while_loop(more, again, (0, (q, v, errors), best, jnp.asarray(True)))
    return _mended(scene, rank_tol, found, quality, q, v, t, errors)


def _mended(scene: Scene, rank_tol, found, quality, q, v, t, errors):
    unknown, known = split(scene)

    def careful(unknown, q, v, t, errors):
        return _by_matrices(known(unknown), rank_tol, q, v, t, errors), ()

    doubtful = ~(quality > least_pivot(q, rank_tol))
    return mended(doubtful, careful, (found, ()), (unknown, q, v, t, errors))[0]


def _in_numbers(scene: Scene, q, v, t, *errors):
    """q, v and errors after a few steps without branches, the ratio of the rows' pivots, and whether a step more would help."""
    if has_short_recursion(scene):
        return _loops_closed(scene, Closing(scene.system, scene.constraints, q), q, v, errors)
    return _by_pivots(scene, q, v, t, *errors)


def _elsewhere(scene: Scene, q, v, t, *errors):
    """The same where it is not written out in numbers: see `_dispatch`."""

    def recursion(*state):
        with at_least(LEAST_BATCH):
            return traced_once(_in_numbers, scene, *state)

    return by_the_batch(scene, recursion, partial(_by_pivots, scene), q, v, t, *errors)


def _by_pivots(scene: Scene, q, v, t, *errors):
    held = holonomic_rows(layout(scene))
    mass = mass_matrix(scene.system, q, t)
    L, A = cholesky(mass), constraint_jacobian(scene, q, t)
    Y = solve_lower(L, A.T)
    every = _Correction(L, Y, cholesky(_product(Y.T, Y)))
    some = every
    if held.size not in (0, Y.shape[1]):
        some = _Correction(L, Y[:, held], cholesky(_product(Y[:, held].T, Y[:, held])))
    quality = jnp.minimum(every.quality, some.quality)
    quality = jnp.where(definite(mass, L), quality, jnp.nan)
    place, apart, open_ = q, jnp.zeros((), q.dtype), False
    if held.size:
        place, apart, open_ = _closed(scene, q, some.step, lambda place: position_residual(scene, place, t))
    residual = partial(_slip, scene, place, t)
    speed, slip, slips = _descend(v, every.step, residual, lambda v, step: v - step)
    of_place = some.step if held.size else None
    ways = (of_place, partial(_product, A[held]), apart), (every.step, partial(_product, A), slip)
    return place, speed, _allowed(errors, *ways), quality, open_ | slips


def _slip(scene: Scene, q, t, v):
    return velocity_residual(scene, q, v, t)


def _loops_closed(scene: Scene, closing: Closing | ClosingInKernels, q, v, errors):
    """`_in_numbers` for loops of a tree, body by body."""
    place, apart, open_ = _closed(scene, q, closing.step, closing.apart)
    slip = partial(closing.slip, place)
    speed, slipping, slips = _descend(v, closing.step, slip, lambda v, step: v - step)
    errors = _allowed(errors, (closing.step, slip, apart), (closing.step, slip, slipping))
    return place, speed, errors, closing.quality, open_ | slips


def _allowed(errors: tuple, *ways) -> tuple:
    """Errors less the least change that removes what they add to the rows, and with what is left open.

    A way is (step, rate of the rows along an error, distance left); its step is None for no rows.
    """

    def allowed(error, step, rate, left):
        return error if step is None else enlarged(error - step(rate(error)), left)

    return tuple(allowed(error, *way) for error, way in zip(errors, ways, strict=False))


def enlarged(error, by):
    """An error of either sign, larger by the size of another one."""
    return error + jnp.where(error < 0, -jnp.abs(by), jnp.abs(by))


def _closed(scene: Scene, q, step, residual):
    """q on the holonomic constraints, about how far it still is from them, and whether another step would bring it closer."""

    def move(place, change):
        return retract(scene.system, displace(scene.system, place, -change))

    return _descend(q, step, residual, move)


def _descend(x, step, residual, move):
    """x moved by x -> move(x, step(residual(x))) until that would change it by rounding alone, `_MOST_STEPS` times at most.

    Also the largest entry of the next step, which is about how far x is still away, and whether to take it. Written out, it is
    `_STEPS_WRITTEN` steps.
    """
    rounding = float(jnp.finfo(x.dtype).eps) * jnp.max(jnp.abs(x))

    def improve(state):
        x, r, _, _ = state
        change = step(r)
        tried = move(x, change)
        left = residual(tried)
        before, after, way = (jnp.max(jnp.abs(y)) for y in (r, left, change))
        falls = after < before
        # The next step is about this one times what it has left of the residual.
        more = falls & (way * after > rounding * before)
        away = jnp.where(falls, way * after / before, jnp.where(before > 0, way, jnp.zeros_like(way)))
        return jnp.where(falls, tried, x), jnp.where(falls, left, r), more, away

    def maybe(state, _):
        return lax.cond(anywhere(state[2]), improve, lambda state: state, state), None

    first = residual(x)
    state = x, first, jnp.max(jnp.abs(first)) > 0, jnp.zeros((), x.dtype)
    if is_written_out():
        for _ in range(_STEPS_WRITTEN):
            state = jax.tree.map(partial(jnp.where, state[2]), improve(state), state)
    else:
        state, _ = lax.scan(maybe, state, None, length=_MOST_STEPS)
    x, _, more, away = state
    return x, away, more


def _in_fixed_steps(scene: Scene, q, v, t, errors, rank_tol):
    """The same for derivatives, which are those of the steps as they are."""
    q = retract(scene.system, q)
    held = holonomic_rows(layout(scene))
    B = correction(scene, q, t, rank_tol, holonomic=False)
    B_held = B if held.size in (0, B.shape[1]) else correction(scene, q, t, rank_tol, holonomic=True)
    apart = jnp.zeros((), q.dtype)
    if held.size:

        def move(place, _):
            step = _product(B_held, position_residual(scene, place, t))
            return displace(scene.system, place, -step), None

        moved, _ = lax.scan(move, q, None, length=_MOST_STEPS)
        before, after = (position_residual(scene, x, t) for x in (q, moved))
        better = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
        q = jnp.where(better, retract(scene.system, moved), q)
        apart = jnp.max(jnp.abs(_product(B_held, jnp.where(better, after, before))))

    def slow(v, _):
        return v - _product(B, velocity_residual(scene, q, v, t)), None

    projected, _ = lax.scan(slow, v, None, length=_MOST_STEPS)
    before, after = (velocity_residual(scene, q, x, t) for x in (v, projected))
    better = jnp.max(jnp.abs(after)) <= jnp.max(jnp.abs(before))
    if errors:
        A, slip = constraint_jacobian(scene, q, t), jnp.max(jnp.abs(_product(B, jnp.where(better, after, before))))
        of_place = partial(_product, B_held) if held.size else None
        ways = (of_place, partial(_product, A[held]), apart), (partial(_product, B), partial(_product, A), slip)
        errors = lax.stop_gradient(_allowed(errors, *ways))
    return q, jnp.where(better, projected, v), errors
