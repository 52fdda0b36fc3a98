"""Putting a scene on its constraints: `assemble` from a rough guess."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn._dispatch import LEAST_BATCH
from jaxdyn._materialize import at_least
from jaxdyn._tracing import compiled, is_concrete, is_staged
from jaxdyn.closed_projection import Kernels, Residuals, ResidualsInKernels, kernels
from jaxdyn.constrained import RESULTS, _right_inverse, by_the_batch, correction, has_long_recursion
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.dynamics import mass_matrix
from jaxdyn.model import Model, difference
from jaxdyn.scene import Scene
from jaxdyn.so3 import _product
from jaxdyn.systems import displace, retract

_NEAREST_STEPS = 30
_NEWTON_STEPS = 40
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01)


class Assembly(eqx.Module):
    """State on the constraints: `q` (nq,), `v` (nv,), largest `residual` (2,) left in |phi| and |A v - b|, `result`."""

    q: Float[Array, " nq"]
    v: Float[Array, " nv"]
    residual: Float[Array, "2"]
    result: Any


def assemble(
    scene: Scene,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"] | None = None,
    t=0.0,
    *,
    rank_tol: float | None = None,
    throw: bool | None = None,
) -> Assembly:
    """Find q with phi(q, t) = 0 and v with A v = b from a rough guess, with the least change in the mass metric.

    q minimises |q - guess| in the metric M(guess) among the configurations on the constraints (a local minimum, by
    repeated linearisation, then Newton steps to rounding); v is the guess plus the least change in the metric M(q).

    **Arguments:** `q` (nq,), `v` (nv,) (None: at rest), guesses; `t`, s; `rank_tol` as in `constrained_dynamics`;
    `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `Assembly`. Derivatives, of any order, with respect to the guess and the scene's numbers are those of the
    minimum, by the implicit function theorem.

    **Raises:** ValueError that names the constraints that stay open and by how much, if it fails and `throw`.
    """
    concrete = is_concrete(scene, q, v, t)
    v = jnp.zeros((scene.nv,), q.dtype) if v is None else v
    found = _assemble(scene, q, v, jnp.asarray(t, q.dtype), rank_tol)
    if concrete and (throw is None or throw) and not bool(found.result == RESULTS.successful):
        raise ValueError(f"not assembled: {open_constraints(scene, found.q, found.v, t)}; give a better guess")
    if throw and not concrete:
        found = found.result.error_if(found, found.result != RESULTS.successful)
    return found


@compiled
def _assemble(scene, q, v, t, rank_tol):
    held = holonomic_rows(layout(scene))
    if held.size:
        fixed, frozen, guess = (lax.stop_gradient(x) for x in (scene, t, q))
        place = _nearest(fixed, guess, frozen, held, rank_tol)
        place = lax.stop_gradient(_newton(fixed, place, frozen, held, rank_tol))
        e = difference(scene.system, guess, place) if isinstance(scene.system, Model) else place - guess
        moved = displace(scene.system, q, _stationary(scene, q, t, e, rank_tol))
        # The way from guess to place and back again costs digits, which the place itself has not lost.
        q = retract(scene.system, place + (moved - lax.stop_gradient(moved)))
    B = correction(scene, q, t, rank_tol, holonomic=False)
    for _ in range(2):
        v = v - _product(B, velocity_residual(scene, q, v, t))
    residual = residuals(scene, q, v, t)
    good = jnp.all(residual <= float(jnp.finfo(q.dtype).eps) ** 0.7 * (1.0 + jnp.max(jnp.abs(v))))
    return Assembly(q, v, residual, RESULTS.where(good, RESULTS.successful, RESULTS.not_assembled))  # pyright: ignore[reportArgumentType]


def _nearest(scene, guess, t, held, rank_tol):
    """Displacement e from the guess of least |e| in the metric M(guess) with phi = 0, by repeated linearisation."""
    factor = jnp.linalg.cholesky(mass_matrix(scene.system, guess, t))

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    def improve(state):
        e, _, count = state
        differentiate = jax.jacrev if held.size < scene.nv else jax.jacfwd
        A = differentiate(residual)(e)
        new = _product(_right_inverse(factor, A, rank_tol), _product(A, e) - residual(e))
        return new, jnp.max(jnp.abs(new - e)), count + 1

    def unfinished(state):
        e, change, count = state
        return (count < _NEAREST_STEPS) & (change > 1e-7) & jnp.isfinite(e).all()

    start = jnp.zeros((scene.nv,), guess.dtype)
    e, _, _ = lax.while_loop(unfinished, improve, (start, jnp.asarray(jnp.inf, guess.dtype), 0))
    better = jnp.max(jnp.abs(residual(e))) < jnp.max(jnp.abs(residual(start)))
    return displace(scene.system, guess, jnp.where(better, e, start))


def _stationary(scene, guess, t, e, rank_tol):
    """The displacement e from the guess, known in value, as a differentiable solution of M(guess) e + A^T lam = 0, phi = 0."""
    factor = jnp.linalg.cholesky(mass_matrix(scene.system, guess, t))

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    def conditions(z):
        e, lam = z[: scene.nv], z[scene.nv :]
        phi, back = jax.vjp(residual, e)
        return jnp.concatenate([_product(factor, _product(factor.T, e)) + back(lam)[0], phi])

    def solve(linear, right):
        """By the null space of A, on which the Hessian of the Lagrangian is definite; A may have dependent rows."""
        matrix = jax.jacfwd(linear)(jnp.zeros_like(right))
        H, A = matrix[: scene.nv, : scene.nv], matrix[scene.nv :, : scene.nv]
        B = _right_inverse(factor, A, rank_tol)
        keep = jnp.eye(scene.nv, dtype=A.dtype) - _product(B, A)
        along = _product(B, right[scene.nv :])
        left = right[: scene.nv] - _product(H, along)
        # Across the null space M stands in for H, so that the matrix is regular.
        away = _product(factor.T, jnp.eye(scene.nv, dtype=A.dtype) - keep)
        whole = _product(keep.T, _product(H, keep)) + _product(away.T, away)
        step = along + _product(keep, jnp.linalg.solve(whole, _product(keep.T, left)))
        return jnp.concatenate([step, _product(B.T, right[: scene.nv] - _product(H, step))])

    A = jax.jacrev(residual)(e)
    lam = -_product(_right_inverse(factor, A, rank_tol).T, _product(factor, _product(factor.T, e)))
    known = lax.stop_gradient(jnp.concatenate([e, lam]))
    return lax.custom_root(conditions, known, lambda conditions, known: known, solve)[: scene.nv]


def _newton(scene, q, t, held, rank_tol):
    """Gauss-Newton steps with a choice of lengths, until the residual is at rounding or no longer falls."""
    lengths = jnp.asarray(_STEP_LENGTHS, q.dtype)

    def size(q):
        return jnp.max(jnp.abs(position_residual(scene, q, t)))

    def improve(state):
        q, error, _, count = state
        step = -_product(correction(scene, q, t, rank_tol, holonomic=True), position_residual(scene, q, t))
        tried = jax.vmap(lambda s: retract(scene.system, displace(scene.system, q, s * step)))(lengths)
        errors = jax.vmap(size)(tried)
        best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.full_like(errors, jnp.inf)))
        falls = errors[best] < error
        return jnp.where(falls, tried[best], q), jnp.where(falls, errors[best], error), falls, count + 1

    def unfinished(state):
        _, error, falls, count = state
        return falls & (error > 0) & (count < _NEWTON_STEPS)

    return lax.while_loop(unfinished, improve, (q, size(q), jnp.asarray(True), 0))[0]


def residuals(scene: Scene, q, v, t=0.0) -> Float[Array, "2"]:
    """Largest |phi| (m or rad) and |A v - b| (m/s or rad/s) of the state q (nq,), v (nv,) at t (s): (2,)."""
    return _residuals(scene, q, v, t, None)


def still_residuals(scene: Scene, q, v, t):
    """The same without derivatives: of long mechanisms on CPU by kernels (see `_one_kernel`)."""
    in_kernels = None
    if is_staged() and has_long_recursion(scene):
        in_kernels = kernels(scene.system, scene.constraints, q, v, long=True, often=False)
    return _residuals(scene, q, v, t, in_kernels)


def _residuals(scene: Scene, q, v, t, in_kernels: Kernels | None):
    def largest(*parts):
        zero = jnp.zeros((1,), q.dtype)
        return jnp.stack([jnp.max(jnp.abs(jnp.concatenate([zero, part]))) for part in parts]).astype(q.dtype)

    def short(q, v):
        tree = scene.system, scene.constraints
        with at_least(LEAST_BATCH):
            found = Residuals(*tree) if in_kernels is None else ResidualsInKernels(*tree, in_kernels)
            return largest(found.apart(q), found.slip(q, v))

    def long(q, v):
        return largest(position_residual(scene, q, t), velocity_residual(scene, q, v, t))

    return by_the_batch(scene, short, long, q, v, on_cpu=in_kernels is not None)


def open_constraints(scene: Scene, q, v, t=0.0, limit: float = 0.0) -> str:
    """In words, which constraints are violated by more than `limit`, the worst first; for concrete states."""
    t = jnp.asarray(t, q.dtype)
    phi, psi = (np.asarray(x) for x in _both_residuals(scene, q, v, t))
    found, first = [], 0
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        count = place.slip - place.start
        apart = float(np.max(np.abs(phi[first : first + count]), initial=0.0))
        fast = float(np.max(np.abs(psi[place.start : place.end]), initial=0.0))
        first += count
        kind = type(constraint).__name__.lower()
        if apart > limit:
            found.append((apart, f"{kind} {place.name!r} open by {apart:.3g}"))
        if fast > limit:
            found.append((fast, f"{kind} {place.name!r} slips at {fast:.3g}"))
    # Those that print alike stay in the scene's order, whatever their rounding errors.
    return ", ".join(text for _, text in sorted(found, key=lambda entry: -float(f"{entry[0]:.3g}"))[:6])


@eqx.filter_jit
def _both_residuals(scene, q, v, t):
    return position_residual(scene, q, t), velocity_residual(scene, q, v, t)


@eqx.filter_jit
def start_evidence(scene: Scene, q, v, t):
    """Largest residuals (2,) and the rank of the rows at a state."""
    factor = jnp.linalg.cholesky(mass_matrix(scene.system, q, t))
    A = constraint_jacobian(scene, q, t)
    rank = jnp.round(jnp.trace(_product(A, _right_inverse(factor, A, None)))).astype(jnp.int32)
    return residuals(scene, q, v, t), rank
