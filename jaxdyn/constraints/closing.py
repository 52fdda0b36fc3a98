"""Path from a guess to the nearest configuration on the constraints, and the derivative of its end.

1. `follow_path`: Newton's steps of limited length. Short steps follow the curve along which all residuals shrink in proportion.
   It stays on the branch of the guess as long as it meets no singular position.
2. `slide_to_nearest`: along the constraints, to the minimum of |q - guess| in the metric M(guess), by Newton's method on the
   conditions M e + A^T lam = 0, phi = 0 of that minimum (sequential quadratic programming).
3. `polish`: Newton's steps down to rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import implicit, invalidate_derivatives, kernel, pseudo_inverse_by_rotations, value_and_jvp
from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual
from jaxdyn.constraints.dynamics import correction, right_inverse, whiten_rows
from jaxdyn.constraints.rank import CONVERGED, NEAR, NEGLIGIBLE, REGULAR, RESIDUAL, eps_of, solve_square
from jaxdyn.constraints.redundancy import coordinate_sizes, passes_singular
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.configuration import difference
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import cholesky, is_definite, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, displacement, has_dependent_coordinates, retract, search_from

# Longest step of the path, rad or lengths of the mechanism: within it, rows turn by less than a right angle.
_LONGEST = 0.2
# After so many steps, and after each further half of them, a path at an obstacle is pushed aside once. Paths without an obstacle
# are at most pi long, 16 steps, and converge in a few more.
_PATIENCE = 40
_NEAREST_STEPS = 100
_NEWTON_STEPS = 40
# Shares of the curvature of the constraints in the Hessian: the largest one with a positive definite matrix is taken.
_CURVATURES = (1.0, 0.7, 0.4, 0.2, 0.0)
# Lengths of a step of the slide. A step that is shorter than the second of `_near` is Newton's, and needs no proof of a descent.
_SLIDE_LENGTHS = (1.0, 0.5, 0.2, 0.05)
# A full step for quadratic convergence, the others where a singular position is near and full steps overshoot.
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01)


class Path(NamedTuple):
    """End of a path from a guess, and whether it passed a singular position, where branches meet."""

    q: Array
    passed_singular: Array


def _step_to_rows(scene: Scene, q, t, loose: float):
    """phi, its rows A, and their right inverse B with the shortest columns in the metric M(q).

    Singular values below `loose` count as zero: the difference of redundant rows is rounding, and would give steps of any length.
    """
    held = holonomic_rows(layout(scene))
    metric, Y = kernel(whiten_rows)(scene, q, t)
    B = metric.unwhiten(pseudo_inverse_by_rotations(Y[:, held], loose).T)
    return position_residual(scene, q, t), constraint_jacobian(scene, q, t)[held], B


def _limit_step(step, sizes):
    """The step of at most `_LONGEST`, and the size before."""
    size = jnp.max(jnp.abs(step) / sizes)
    return step * jnp.minimum(1.0, _LONGEST / jnp.where(size > 0, size, jnp.ones_like(size))), size


def follow_path(scene: Scene, guess, t, loose: float, steps: int) -> Path:
    """Newton's steps of limited length towards the constraints.

    Where the curve of shrinking residuals meets an obstacle, such as the end of the reach, the path is pushed aside, and
    counts as having passed a singular position.
    """
    sizes, _ = coordinate_sizes(scene.system, guess.dtype)
    # Any direction that no symmetry of a mechanism shares: along a symmetry the push would keep the path at the obstacle.
    aside = jnp.asarray(np.cos(1.0 + 2.4 * np.arange(scene.nv)), guess.dtype)
    done = eps_of(guess) ** NEGLIGIBLE

    def improve(state):
        q, _, passed, A_before, B_before, count = state
        phi, A, B = _step_to_rows(scene, q, t, loose)
        step, size = _limit_step(-matmul(B, phi), sizes)
        turned = (count > 0) & passes_singular(A_before, B_before, A)
        is_stuck = (count >= _PATIENCE) & ((count - _PATIENCE) % (_PATIENCE // 2) == 0)
        push = 2 * _LONGEST * aside * jnp.where((count // (_PATIENCE // 2)) % 2 == 0, 1.0, -1.0).astype(guess.dtype)
        step = jnp.where(is_stuck, push * sizes, step)
        q = retract(scene.system, displace(scene.system, q, step))
        return q, size, passed | turned | is_stuck, A, B, count + 1

    def is_far(state):
        q, size, *_, count = state
        return (count < steps) & (size > done) & jnp.isfinite(q).all()

    held = holonomic_rows(layout(scene)).size
    none = jnp.zeros((held, scene.nv), guess.dtype)
    state = guess, jnp.asarray(jnp.inf, guess.dtype), jnp.asarray(False), none, none.T, 0
    q, _, passed, *_ = lax.while_loop(is_far, improve, state)
    return Path(q, passed)


@kernel
def _linearize_rows(scene: Scene, guess, t, e):
    """phi at a displacement e from the guess, and its derivative in e: rows times the velocity for a rate of e."""
    place = displace(scene.system, guess, e)
    A = constraint_jacobian(scene, place, t)[holonomic_rows(layout(scene))]
    if isinstance(scene.system, Model):
        # On a manifold (free and ball joints) e and the velocity are different tangent vectors.
        A = matmul(A, jax.jacfwd(lambda e: difference(scene.system, place, displace(scene.system, guess, e)))(e))
    return position_residual(scene, place, t), A


def _near(dtype) -> tuple[float, float]:
    """Step of Newton's method behind which it has converged, and one from which it converges, rad or lengths of the mechanism."""
    # Convergence is quadratic, so that what is left behind the first is rounding.
    eps = float(jnp.finfo(dtype).eps)
    return eps**CONVERGED, eps**NEAR


class Slide(NamedTuple):
    """End of a slide: displacement from the guess, sides of the bounds it is held at, and 1 for a minimum, else 0."""

    e: Array
    held: Array  # (nv,): -1 at a lower bound, 1 at an upper one, else 0
    is_nearest: Array


class _State(NamedTuple):
    e: Array
    held: Array
    fresh: Array  # bounds that were met since the rows were closed
    moves: Array  # whether the last step has reduced the distance, or has released a bound
    done: Array
    count: Array


def slide_to_nearest(scene: Scene, guess, start, t, rank_tol, bounds=None) -> Slide:
    """The displacement of least length in the metric M(guess) with phi = 0, from a start near it.

    Newton's steps, limited, and shortened until they reduce |e|^2 / 2 + nu |phi|. Without the curvature of the constraints, the
    second derivative of lam . phi, the iteration of Gauss and Newton converges to minima close to the guess alone.

    `bounds`: two (nv,) of the displacement, within which the start has to be. A step ends at the first bound that it meets, which
    is held from then on, until a minimum where its multiplier has the sign of a pull inwards (an active-set method).
    """
    mass = mass_matrix(scene.system, guess, t)
    metric = mass_factor(mass)
    sizes, length = coordinate_sizes(scene.system, guess.dtype)
    start = unwind_hinges(scene, guess, start, t) if bounds is None else start
    first = displacement(scene.system, guess, start)
    endless = jnp.full_like(first, jnp.inf)
    lower, upper = (-endless, endless) if bounds is None else bounds
    converged, is_close = _near(guess.dtype)
    lengths = jnp.asarray(_SLIDE_LENGTHS, guess.dtype)
    nh = holonomic_rows(layout(scene)).size
    limit = eps_of(guess) ** REGULAR * jnp.minimum(length, 1.0)

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    def half_square(e):
        return 0.5 * jnp.sum(e * matmul(mass, e))

    def rows(e, held):
        """phi and its derivative, with a row for each coordinate that may be held, zero where it is not."""
        phi, A = _linearize_rows(scene, guess, t, e)
        if bounds is None:
            return phi, A
        return jnp.append(phi, jnp.zeros_like(e)), jnp.concatenate([A, jnp.diag(jnp.abs(held))])

    def improve(state: _State):
        e, held, fresh, _, _, count = state
        phi, A = rows(e, held)
        B = right_inverse(metric, A, rank_tol)
        lam = -matmul(B.T, matmul(mass, e))
        step, is_convex = _newton_step(mass, _curvature(scene, guess, t, e, lam[:nh]), A, B, matmul(mass, e), phi)
        step, size = _limit_step(jnp.where(held != 0, jnp.zeros_like(step), step), sizes)
        weight = 2 * jnp.max(jnp.abs(lam), initial=0.0)
        way = jnp.where(step < 0, lower, upper) - e
        way = jnp.where(step != 0, way / jnp.where(step != 0, step, jnp.ones_like(step)), jnp.inf)
        longest = jnp.clip(jnp.min(way), 0.0, 1.0)
        bound = B[:, :nh]

        def try_length(s):
            tried = e + s * longest * step
            # A correction of second order: along a curved surface the merit of a good step would otherwise increase.
            tried = jnp.clip(tried - matmul(bound, residual(tried)), lower, upper)
            return tried, half_square(tried) + weight * jnp.sum(jnp.abs(residual(tried)))

        tried, merits = lax.map(try_length, lengths)
        best = jnp.argmin(jnp.where(jnp.isfinite(merits), merits, jnp.full_like(merits, jnp.inf)))
        falls = merits[best] < half_square(e) + weight * jnp.sum(jnp.abs(phi))
        # Below rounding of the merit its fall cannot be seen.
        is_newton = is_convex & (size <= is_close) & (longest >= 1)
        after = jnp.where(is_newton, tried[0], jnp.where(falls, tried[best], e))
        is_minimum = is_convex & (size <= converged)
        if bounds is None:
            # A hinge that goes on beyond half a turn is nearer to the guess by a full turn less.
            unwound = unwind_hinges(scene, guess, displace(scene.system, guess, after), t)
            shorter = displacement(scene.system, guess, unwound)
            after = jnp.where(half_square(shorter) < (1 - 1e-6) * half_square(after), shorter, after)
            return _State(after, held, fresh, falls | is_newton, is_minimum, count + 1)
        # A bound that is met while the rows are closed again behind another one was the first of the two.
        fresh = fresh & (jnp.max(jnp.abs(phi)) > limit)
        meets = (way <= longest) & (longest < 1)
        after = jnp.where(meets, jnp.where(step < 0, lower, upper), after)
        pull = held * -lam[nh:]
        pull = jnp.where(pull > eps_of(e) ** RESIDUAL * jnp.max(jnp.abs(lam)), pull, jnp.zeros_like(pull))
        released = is_minimum & (pull > 0) & (jnp.arange(e.size) == jnp.argmax(pull))
        released = released | (fresh & jnp.any(meets))
        fresh = jnp.where(jnp.any(meets), meets, fresh)
        held = jnp.where(released, jnp.zeros_like(held), jnp.where(meets, jnp.sign(step), held))
        moves = falls | is_newton | jnp.any(released) | jnp.any(meets)
        return _State(after, held, fresh, moves, is_minimum & ~jnp.any(released) & ~jnp.any(meets), count + 1)

    def goes_on(state: _State):
        return (state.count < _NEAREST_STEPS) & state.moves & ~state.done & jnp.isfinite(state.e).all()

    none = jnp.zeros(first.shape, bool)
    begin = _State(first, jnp.zeros_like(first), none, jnp.asarray(True), jnp.asarray(False), jnp.zeros((), jnp.int32))
    e, held, _, _, done, _ = lax.while_loop(goes_on, improve, begin)
    has_converged = done & jnp.isfinite(e).all()
    # A start off the constraints, before an obstacle such as the end of the reach, may be nearer than any place on them.
    open_by = [jnp.max(jnp.abs(residual(x)), initial=0.0) for x in (e, first)]
    # A guess on the constraints has a distance of rounding.
    rounding = eps_of(guess) ** 1.5 * half_square(sizes)
    is_nearer = half_square(e) <= half_square(first) * (1 + 1e-6) + rounding
    # What the slide has gained is kept even where it has not converged.
    better = (has_converged | (open_by[0] <= limit)) & (is_nearer | (open_by[1] > limit)) & jnp.isfinite(e).all()
    is_nearest = (better & has_converged).astype(guess.dtype)
    return Slide(jnp.where(better, e, first), jnp.where(better, held, jnp.zeros_like(held)), is_nearest)


def _curvature(scene: Scene, guess, t, e, lam):
    """Second derivative of lam . phi in the displacement e, (nv, nv)."""

    def along(direction):
        return matmul(jax.jvp(lambda e: _linearize_rows(scene, guess, t, e)[1], (e,), (direction,))[1].T, lam)

    curvature = jax.vmap(along)(jnp.eye(e.size, dtype=e.dtype))
    return 0.5 * (curvature + curvature.T)


def _newton_step(mass, curvature, A, B, slope, phi):
    """Step to the stationary point of the quadratic model on A e + phi = 0, and whether its whole Hessian is definite there."""
    null_projector = jnp.eye(slope.size, dtype=A.dtype) - matmul(B, A)
    across = matmul(B, A)
    along = -matmul(B, phi)
    fixed = matmul(across.T, matmul(mass, across)) + matmul(null_projector.T, matmul(mass, null_projector))
    bent = matmul(null_projector.T, matmul(curvature, null_projector))

    def solve(share):
        # Across the null space M replaces the Hessian, so that the matrix is regular; that part of the solution is projected out.
        matrix = fixed + share * bent
        factor = cholesky(matrix)
        right = -matmul(null_projector.T, slope + matmul(mass, along) + share * matmul(curvature, along))
        return matmul(null_projector, solve_cholesky(factor, right)), is_definite(matrix, factor)

    steps, definite = jax.vmap(solve)(jnp.asarray(_CURVATURES, A.dtype))
    chosen = jnp.argmax(definite)
    return along + steps[chosen], definite[0]


def unwind_hinges(scene, guess, q, t):
    """q with its hinges within half a turn of the guess, where full turns make no difference to the constraints."""
    # A gear or a mimic joint counts turns: there the residual increases, and q stays.
    if not isinstance(scene.system, Model):
        return q
    topology = scene.system.topology
    hinges = [s.start for kind, s in zip(topology.kinds, topology.q_slices, strict=True) if kind == "revolute"]
    if not hinges:
        return q
    places = np.asarray(hinges)
    turns = jnp.round(lax.stop_gradient(q - guess)[places] / (2 * np.pi))
    back = q.at[places].add(-2 * np.pi * turns)
    before, after = (jnp.max(jnp.abs(position_residual(scene, x, t))) for x in (q, back))
    _, length = coordinate_sizes(scene.system, q.dtype)
    rounding = 64 * float(jnp.finfo(q.dtype).eps) * jnp.maximum(length, 1.0)
    return jnp.where(lax.stop_gradient(after <= before + rounding), back, q)


def polish(scene: Scene, q, t, rank_tol):
    """Gauss-Newton steps, of several lengths at once, until the residual is at rounding or no longer decreases."""
    lengths = jnp.asarray(_STEP_LENGTHS, q.dtype)

    def size(q):
        return jnp.max(jnp.abs(position_residual(scene, q, t)))

    def improve(state):
        q, error, _, count = state
        step = -matmul(correction(scene, q, t, rank_tol, holonomic=True), position_residual(scene, q, t))
        tried = jax.vmap(lambda s: retract(scene.system, displace(scene.system, q, s * step)))(lengths)
        errors = lax.map(size, tried)  # not `vmap`: the kernel of one sample is compiled already
        best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.full_like(errors, jnp.inf)))
        falls = errors[best] < error
        return jnp.where(falls, tried[best], q), jnp.where(falls, errors[best], error), falls, count + 1

    def improves(state):
        _, error, falls, count = state
        return falls & (error > 0) & (count < _NEWTON_STEPS)

    return lax.while_loop(improves, improve, (q, size(q), jnp.asarray(True), 0))[0]


def slide_to_place(scene: Scene, guess, start, t, rank_tol, bounds=None) -> tuple[Array, Slide]:
    """Configuration at the end of `slide_to_nearest`, and that end."""

    def slide(near, start):
        end = slide_to_nearest(scene, near, start, t, rank_tol, bounds)
        return displace(scene.system, near, end.e), end

    if not has_dependent_coordinates(scene.system):
        return slide(guess, start)

    # Displacements from the guess have the dependent coordinates of the start, and then of a first end far from there.
    def again(_, state):
        place, end = slide(search_from(scene.system, guess, state[0]), state[0])
        return retract(scene.system, place), end

    none = jnp.zeros((scene.nv,), guess.dtype)
    return lax.fori_loop(0, 2, again, (start, Slide(none, none, jnp.zeros((), guess.dtype))))


def nearest_configuration(scene: Scene, guess, start, t, rank_tol, solve: Callable | None = None):
    """The configuration on the constraints nearest to a guess, from a start close to it, with the derivatives of a minimum.

    With it 1 where it satisfies the conditions of a minimum, else 0: its derivatives are then NaN.
    `solve(scene, guess, start, t)` finds both in place of `slide_to_nearest`.
    """

    def slide(scene, guess, start, t):
        place, end = slide_to_place(scene, guess, start, t, rank_tol)
        return polish(scene, place, t, rank_tol), end.is_nearest

    solve = solve or slide

    def differentiable(scene, q, start, t):
        fixed, guess, *others = stop_gradient((scene, q, start, t))
        place, is_nearest = lax.stop_gradient(solve(fixed, guess, *others))
        q = search_from(scene.system, q, place)
        end = displace(scene.system, q, _stationary(scene, q, t, displacement(scene.system, guess, place), rank_tol))
        # Only the derivative of `end` is used: from the guess to the solution and back, its value has lost digits.
        return retract(scene.system, place + (end - lax.stop_gradient(end))), is_nearest

    def tangent(scene, q, start, t, steps):
        places, changes = value_and_jvp(differentiable, (scene, q, start, t), steps)
        return places, jax.tree.map(jnp.zeros_like, places) if changes is None else changes

    q, is_nearest = implicit(scene, (guess, lax.stop_gradient(start), t), solve, tangent)
    return invalidate_derivatives(q, is_nearest < 1, (scene, guess, t)), lax.stop_gradient(is_nearest)


def _stationary(scene: Scene, guess, t, e, rank_tol):
    """The displacement e from the guess, known in value, as a differentiable solution of M(guess) e + A^T lam = 0, phi = 0."""
    # The stationarity conditions of the minimum. `custom_root` differentiates them; `solve` below is its linear solver.
    mass = mass_matrix(scene.system, guess, t)
    metric = mass_factor(mass)

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    def conditions(z):
        e, lam = z[: scene.nv], z[scene.nv :]
        phi, back = jax.vjp(residual, e)
        return jnp.concatenate([matmul(mass, e) + back(lam)[0], phi])

    def solve(linear, right):
        """Solve the KKT system by the null space of A, on which the Hessian of the Lagrangian is definite."""
        # Not the KKT matrix itself: it is singular for dependent rows.
        matrix = jax.jacfwd(linear)(jnp.zeros_like(right))
        H, A = matrix[: scene.nv, : scene.nv], matrix[scene.nv :, : scene.nv]
        B = right_inverse(metric, A, rank_tol)
        null_projector = jnp.eye(scene.nv, dtype=A.dtype) - matmul(B, A)
        along = matmul(B, right[scene.nv :])
        left = right[: scene.nv] - matmul(H, along)
        # Across the null space M replaces H, so that the matrix is regular; that part of the solution is projected out.
        across = jnp.eye(scene.nv, dtype=A.dtype) - null_projector
        whole = matmul(null_projector.T, matmul(H, null_projector)) + matmul(across.T, matmul(mass, across))
        step = along + matmul(null_projector, solve_square(whole, matmul(null_projector.T, left)))
        return jnp.concatenate([step, matmul(B.T, right[: scene.nv] - matmul(H, step))])

    A = jax.jacrev(residual)(e)
    lam = -matmul(right_inverse(metric, A, rank_tol).T, matmul(mass, e))
    known = lax.stop_gradient(jnp.concatenate([e, lam]))
    return lax.custom_root(conditions, known, lambda conditions, known: known, solve)[: scene.nv]
