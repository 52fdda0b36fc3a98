"""Putting a scene on its constraints: `assemble` from a rough guess."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxdyn.compile import along, compiled, compute, constant, implicit, is_concrete, is_staged, run
from jaxdyn.constraints.base import constraint_jacobian, holonomic_rows, layout, position_residual, velocity_residual
from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.dynamics import correction, right_inverse, whitened_rows
from jaxdyn.constraints.loops import lock_joint
from jaxdyn.constraints.rank import tolerance
from jaxdyn.constraints.tolerances import coordinate_sizes, largest_ratio, openness, row_limits
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Numbers, check_state, zeros_if_none
from jaxdyn.model.tree import Model, difference
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import displace, retract

_NEAREST_STEPS = 30
_NEWTON_STEPS = 40
_STEP_LENGTHS = (1.0, 0.5, 0.2, 0.05, 0.01)


class Assembly(Outcome):
    """State on the constraints: `q` (nq,), `v` (nv,), largest `residual` (2,) left in |phi| and |A v - b|, `result`.

    `guesses`: how many starts were tried; 1 says that the given one led there.
    """

    q: Float[Array, " nq"]
    v: Float[Array, " nv"]
    residual: Float[Array, "2"]
    result: Any
    guesses: int = eqx.field(static=True, default=1)


def assemble(
    scene: Scene,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    hold: Mapping[str, Any] | None = None,
    guesses: int = 16,
    rank_tol: float | None = None,
    throw: bool | None = None,
) -> Assembly:
    """Find q with phi(q, t) = 0 and v with A v = b from a rough guess, with the least change in the mass metric.

    q minimises |q - guess| in the metric M(guess) among the configurations on the constraints (a local minimum, by
    repeated linearisation, then Newton steps to rounding); v is the guess plus the least change in the metric M(q).

    **Arguments:**

    - `q` (nq,), `v` (nv,) (None: at rest): the guess. `t`, s.
    - `hold`: values of joints by name, as in `lock_joint`, that the configuration is to have; velocities are not held.
    - `guesses`: how many configurations to start from, where all inputs are concrete. The first is the given one; the others,
      tried only where it fails, lie around it at random (the same ones in every call), farther and farther away, by up to pi
      (rad, or lengths of the mechanism).
    - `rank_tol` as in `constrained_dynamics`.
    - `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `Assembly`. Derivatives, of any order, with respect to the guess and the scene's numbers are those of the
    minimum, by the implicit function theorem.

    **Raises:** ValueError that names the constraints that stay open and by how much, if it fails and `throw`; for joints in
    `hold` that do not exist, and for less than one guess.

    ```python
    state = jd.assemble(jd.scenes.four_bar(), jnp.zeros(3), hold={"1": 0.5})
    ```
    """
    scene = as_scene(scene)
    if isinstance(guesses, bool) or not isinstance(guesses, int) or guesses < 1:
        raise ValueError(f"guesses is {guesses!r}; give how many configurations to start from, at least 1")
    v = zeros_if_none(v, scene.nv)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    locked = Scene(scene.system, (*scene.constraints, *(lock_joint(*joint) for joint in (hold or {}).items())))
    layout(locked)  # refuses joints that do not exist
    concrete = is_concrete(locked, q, v, t)
    assembly = _assemble(locked, q, v, t, rank_tol, scene if hold else None)
    if concrete and not bool(assembly.success):
        assembly = _from_elsewhere(
            assembly, guesses, lambda q: _assemble(locked, q, v, t, rank_tol, scene if hold else None), locked, q
        )
    if concrete and (throw is None or throw) and not bool(assembly.success):
        left = open_constraints(locked, assembly.q, assembly.v, t, _closed_to(q.dtype))
        tried = f" (nor are they from {guesses - 1} configurations around it)" if guesses > 1 else ""
        raise ValueError(f"not assembled: {left}{tried}; give a better guess")
    if throw and not concrete:
        assembly = assembly.result.error_if(assembly, assembly.result != RESULTS.successful)
    return assembly


def _closed_to(dtype) -> float:
    """Part of the mechanism's length that counts as rounding of what has converged."""
    return float(jnp.finfo(dtype).eps) ** 0.7


def _from_elsewhere(assembly: Assembly, guesses: int, assembled: Callable, scene: Scene, q) -> Assembly:
    """The first assembly that succeeds from configurations around q, or else the first one."""
    sizes, _ = coordinate_sizes(scene.system, q.dtype)
    chance = np.random.default_rng(0)
    for tried in range(1, guesses):
        far = np.pi * tried / (guesses - 1)
        step = jnp.asarray(chance.uniform(-far, far, scene.nv), q.dtype) * sizes
        other = assembled(displace(scene.system, q, step))
        if bool(other.success):
            return Assembly(other.q, other.v, other.residual, other.result, tried + 1)
    return assembly


@compiled
def _assemble(locked, q, v, t, rank_tol, scene):
    """The scene `locked` closed; velocities are put on the constraints of `scene`, which is the same one if it is None."""
    if holonomic_rows(layout(locked)).size:
        q = _closed(Scene(locked.system, locked.constraints), q, t, rank_tol)
    limit, good = _closed_to(q.dtype), jnp.asarray(True)
    if scene is not None:
        good = openness(locked, q, _with_velocity(locked, q, v, t, rank_tol), t, limit) <= 1.0
    scene = locked if scene is None else scene
    v = _with_velocity(scene, q, v, t, rank_tol)
    residual = _sizes(position_residual(scene, q, t), velocity_residual(scene, q, v, t))
    good = good & (openness(scene, q, v, t, limit) <= 1.0)
    return Assembly(q, v, residual, RESULTS.where(good, RESULTS.successful, RESULTS.not_assembled))  # pyright: ignore[reportArgumentType]


def _with_velocity(scene, q, v, t, rank_tol):
    """v with A v = b by the least change."""
    B = correction(scene, q, t, rank_tol, holonomic=False)
    for _ in range(2):
        v = v - _product(B, velocity_residual(scene, q, v, t))
    return v


def _closed(scene, q, t, rank_tol):
    """The configuration on the constraints next to a guess, with the derivatives of a minimum."""

    def solve(scene, q, t):
        return _newton(scene, _nearest(scene, q, t, rank_tol), t, rank_tol)

    def differentiable(scene, q, t):
        fixed, guess, frozen = constant((scene, q, t))
        place = lax.stop_gradient(solve(fixed, guess, frozen))
        e = difference(scene.system, guess, place) if isinstance(scene.system, Model) else place - guess
        moved = displace(scene.system, q, _stationary(scene, q, t, e, rank_tol))
        # Going from the guess to the solution and back again costs digits that the solution itself has.
        return retract(scene.system, place + (moved - lax.stop_gradient(moved)))

    def tangent(scene, q, t, steps):
        place, change = along(differentiable, (scene, q, t), steps)
        return place, jnp.zeros_like(place) if change is None else change

    return implicit(scene, (q, t), solve, tangent)


def _linearized(scene, guess, t, e):
    """phi at a displacement e from the guess, and its derivative in e: rows times the velocity for a rate of e."""
    place = displace(scene.system, guess, e)
    A = constraint_jacobian(scene, place, t)[holonomic_rows(layout(scene))]
    if isinstance(scene.system, Model):
        A = _product(A, jax.jacfwd(lambda e: difference(scene.system, place, displace(scene.system, guess, e)))(e))
    return position_residual(scene, place, t), A


def _nearest(scene, guess, t, rank_tol):
    """Displacement e from the guess of least |e| in the metric M(guess) with phi = 0, by repeated linearisation."""
    metric, _ = run(whitened_rows, scene, guess, t)

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    sizes, _ = coordinate_sizes(scene.system, guess.dtype)

    def improve(state):
        e, _, count = state
        phi, A = run(_linearized, scene, guess, t, e)
        new = _product(right_inverse(metric, A, rank_tol), _product(A, e) - phi)
        return new, jnp.max(jnp.abs(new - e) / sizes), count + 1

    def unfinished(state):
        e, change, count = state
        return (count < _NEAREST_STEPS) & (change > 1e-7) & jnp.isfinite(e).all()

    start = jnp.zeros((scene.nv,), guess.dtype)
    e, _, _ = lax.while_loop(unfinished, improve, (start, jnp.asarray(jnp.inf, guess.dtype), 0))
    better = jnp.max(jnp.abs(residual(e))) < jnp.max(jnp.abs(residual(start)))
    return displace(scene.system, guess, jnp.where(better, e, start))


def _stationary(scene, guess, t, e, rank_tol):
    """The displacement e from the guess, known in value, as a differentiable solution of M(guess) e + A^T lam = 0, phi = 0."""
    mass = mass_matrix(scene.system, guess, t)
    metric = mass_factor(mass)

    def residual(e):
        return position_residual(scene, displace(scene.system, guess, e), t)

    def conditions(z):
        e, lam = z[: scene.nv], z[scene.nv :]
        phi, back = jax.vjp(residual, e)
        return jnp.concatenate([_product(mass, e) + back(lam)[0], phi])

    def solve(linear, right):
        """By the null space of A, on which the Hessian of the Lagrangian is definite; A may have dependent rows."""
        matrix = jax.jacfwd(linear)(jnp.zeros_like(right))
        H, A = matrix[: scene.nv, : scene.nv], matrix[scene.nv :, : scene.nv]
        B = right_inverse(metric, A, rank_tol)
        null_projector = jnp.eye(scene.nv, dtype=A.dtype) - _product(B, A)
        along = _product(B, right[scene.nv :])
        left = right[: scene.nv] - _product(H, along)
        # Across the null space M stands in for H, so that the matrix is regular.
        across = jnp.eye(scene.nv, dtype=A.dtype) - null_projector
        whole = _product(null_projector.T, _product(H, null_projector)) + _product(across.T, _product(mass, across))
        step = along + _product(null_projector, jnp.linalg.solve(whole, _product(null_projector.T, left)))
        return jnp.concatenate([step, _product(B.T, right[: scene.nv] - _product(H, step))])

    A = jax.jacrev(residual)(e)
    lam = -_product(right_inverse(metric, A, rank_tol).T, _product(mass, e))
    known = lax.stop_gradient(jnp.concatenate([e, lam]))
    return lax.custom_root(conditions, known, lambda conditions, known: known, solve)[: scene.nv]


def _newton(scene, q, t, rank_tol):
    """Gauss-Newton steps with a choice of lengths, until the residual is at rounding or no longer falls."""
    lengths = jnp.asarray(_STEP_LENGTHS, q.dtype)

    def size(q):
        return jnp.max(jnp.abs(position_residual(scene, q, t)))

    def improve(state):
        q, error, _, count = state
        step = -_product(correction(scene, q, t, rank_tol, holonomic=True), position_residual(scene, q, t))
        tried = jax.vmap(lambda s: retract(scene.system, displace(scene.system, q, s * step)))(lengths)
        errors = lax.map(size, tried)  # by the kernel of one sample
        best = jnp.argmin(jnp.where(jnp.isfinite(errors), errors, jnp.full_like(errors, jnp.inf)))
        falls = errors[best] < error
        return jnp.where(falls, tried[best], q), jnp.where(falls, errors[best], error), falls, count + 1

    def unfinished(state):
        _, error, falls, count = state
        return falls & (error > 0) & (count < _NEWTON_STEPS)

    return lax.while_loop(unfinished, improve, (q, size(q), jnp.asarray(True), 0))[0]


def residuals(scene: Scene, q, v, t=0.0) -> Float[Array, "2"]:
    """Largest |phi| (m or rad) and |A v - b| (m/s or rad/s) of the state q (nq,), v (nv,) at t (s): (2,)."""
    return run(_largest_residuals, Scene(scene.system, scene.constraints), q, v, jnp.asarray(t, q.dtype))


def _largest_residuals(scene: Scene, q, v, t):
    return _sizes(position_residual(scene, q, t), velocity_residual(scene, q, v, t))


def _sizes(*parts):
    """Largest entry of each array, zero of empty ones."""
    return jnp.stack([jnp.max(jnp.abs(part), initial=0.0) for part in parts])


def open_constraints(scene: Scene, q, v, t: Any = 0.0, relative: float = 0.0) -> str:
    """In words, which constraints are violated by more than `row_limits`, the worst first; for concrete states."""
    t = jnp.asarray(t, q.dtype)
    phi, psi, *limits = (np.asarray(x) for x in _residuals_and_limits(scene, q, v, t, relative))
    residuals, first = [], 0
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        count = place.nonholonomic - place.start
        kind = type(constraint).__name__.lower()
        for values, most, rows, words in (
            (phi, limits[0], slice(first, first + count), "open by"),
            (psi, limits[1], slice(place.start, place.end), "slips at"),
        ):
            if np.any(np.abs(values[rows]) > most[rows]):
                size = float(np.max(np.abs(values[rows])))
                residuals.append((size, f"{kind} {place.name!r} {words} {size:.3g}"))
        first += count
    # Those that print alike stay in the scene's order, whatever their rounding errors.
    return ", ".join(text for _, text in sorted(residuals, key=lambda entry: -float(f"{entry[0]:.3g}"))[:6])


@eqx.filter_jit
def _residuals_and_limits(scene, q, v, t, relative):
    limits = row_limits(scene, q, v, t, relative)
    return position_residual(scene, q, t), velocity_residual(scene, q, v, t), *limits


def start_evidence(scene: Scene, q, v, t, relative: float) -> tuple[np.ndarray, float, int]:
    """Largest residuals (2,), `openness`, and the rank of the rows at a concrete state."""
    bare = Scene(scene.system, scene.constraints)
    given = not is_staged()  # as in the program of a run that begins here
    _, Y = compute(whitened_rows, bare, q, t, given=given)
    sizes = np.linalg.svd(Y, compute_uv=False)
    rank = int(np.sum(sizes > tolerance(None, Y) * sizes[0])) if sizes.size else 0
    ratio = compute(largest_ratio, bare, q, v, t, static=(relative,), given=given)
    return compute(_largest_residuals, bare, q, v, t, given=given), float(ratio), rank
