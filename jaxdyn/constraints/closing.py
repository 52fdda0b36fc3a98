"""Path from a guess to the nearest configuration on the constraints, and the derivative of its end.

1. `follow_path`: Newton's steps of limited length. Short steps follow the curve along which all residuals shrink in proportion.
   It stays on the branch of the guess as long as it meets no singular position.
2. `slide_to_nearest`: along the constraints, to the minimum of |q - guess| in the metric M(guess).
3. `polish`: Newton's steps down to rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import implicit, kernel, pseudo_inverse_by_rotations, value_and_jvp
from jaxdyn.compile.known import stop_gradient
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual
from jaxdyn.constraints.dynamics import correction, right_inverse, whiten_rows
from jaxdyn.constraints.rank import eps_of, passes_singular, solve_square
from jaxdyn.constraints.tolerances import coordinate_sizes
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.configuration import difference
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace, displacement, retract

# Longest step of the path, rad or lengths of the mechanism: within it, rows turn by less than a right angle.
_LONGEST = 0.2
# After so many steps, and after each further half of them, a path at an obstacle is pushed aside once. Paths without an obstacle
# are at most pi long, 16 steps, and converge in a few more.
_PATIENCE = 40
_NEAREST_STEPS = 30
_NEWTON_STEPS = 40
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
    done = eps_of(guess) ** 0.6

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


def slide_to_nearest(scene: Scene, guess, start, t, rank_tol):
    """The displacement of least length in the metric M(guess) with phi = 0, by sequential linearisation from a start near it.

    Steps are limited. The start is kept if the iteration does not converge, or if it ends farther from the guess. The second does
    not apply to a start that is off the constraints, before an obstacle such as the end of the reach.
    """
    metric, _ = kernel(whiten_rows)(scene, guess, t)
    sizes, _ = coordinate_sizes(scene.system, guess.dtype)
    first = displacement(scene.system, guess, start)

    def improve(state):
        e, _, count = state
        phi, A = _linearize_rows(scene, guess, t, e)
        # The shortest displacement that satisfies the linearised rows, all of it and not its change: Gauss-Newton on the minimum.
        step = matmul(right_inverse(metric, A, rank_tol), matmul(A, e) - phi) - e
        step, size = _limit_step(step, sizes)
        return e + step, size, count + 1

    def is_far(state):
        e, size, count = state
        return (count < _NEAREST_STEPS) & (size > 1e-7) & jnp.isfinite(e).all()

    # 1e-7 leaves a distance that is minimal to 1e-14; `polish` closes the rows, which have no such slack.
    e, size, _ = lax.while_loop(is_far, improve, (first, jnp.asarray(jnp.inf, guess.dtype), 0))
    whitened = metric.momentum(jnp.stack([e, first], axis=1))
    is_nearer = jnp.sum(whitened[:, 0] ** 2) <= jnp.sum(whitened[:, 1] ** 2) * (1 + 1e-6)
    phi = position_residual(scene, displace(scene.system, guess, first), t)
    _, length = coordinate_sizes(scene.system, guess.dtype)
    is_stuck = jnp.max(jnp.abs(phi)) > eps_of(guess) ** 0.4 * jnp.minimum(length, 1.0)
    better = (size <= 1e-6) & (is_nearer | is_stuck) & jnp.isfinite(e).all()
    return displace(scene.system, guess, jnp.where(better, e, first))


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


def nearest_configuration(scene: Scene, guess, start, t, rank_tol, solve: Callable | None = None):
    """The configuration on the constraints nearest to a guess, from a start close to it, with the derivatives of a minimum.

    `solve(scene, guess, start, t)` finds it in place of `slide_to_nearest`.
    """

    def slide(scene, guess, start, t):
        return polish(scene, slide_to_nearest(scene, guess, start, t, rank_tol), t, rank_tol)

    solve = solve or slide

    def differentiable(scene, q, start, t):
        fixed, guess, *others = stop_gradient((scene, q, start, t))
        place = lax.stop_gradient(solve(fixed, guess, *others))
        end = displace(scene.system, q, _stationary(scene, q, t, displacement(scene.system, guess, place), rank_tol))
        # Only the derivative of `end` is used: from the guess to the solution and back, its value has lost digits.
        return retract(scene.system, place + (end - lax.stop_gradient(end)))

    def tangent(scene, q, start, t, steps):
        place, change = value_and_jvp(differentiable, (scene, q, start, t), steps)
        return place, jnp.zeros_like(place) if change is None else change

    return implicit(scene, (guess, lax.stop_gradient(start), t), solve, tangent)


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
