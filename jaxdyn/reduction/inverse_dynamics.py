"""Inverse dynamics under constraints: the torques of the motors that move a mechanism as its drives are to move.

With M = U U^T, Y = U^-1 A^T and the projection K = 1 - Y Y^+, all in whitened coordinates U^T v:

    v, a      from those of the independent velocities, E v and E a, in the null space of the rows: (K U^-1 E^T)^+
    tau       from N^T S tau = N^T (M a + h - forces), the columns of N spanning the admissible velocities
    lam       the rest, U^-1 (M a + h - forces - S tau) = Y lam

With more motors than degrees of freedom N^T S is wide, and tau is the shortest solution in the given weights.
Sources: Nakamura & Ghodoussi (1989), Dynamics computation of closed-link robot mechanisms with nonredundant and redundant
actuators, eqs. 12 to 20; EQUATIONS sections 6 to 8.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import compiled, is_concrete, run_repaired
from jaxdyn.constraints.base import layout, rows, velocity_residual
from jaxdyn.constraints.codes import RESULTS, Outcome, name_of
from jaxdyn.constraints.dynamics import applied, whitened_rows
from jaxdyn.constraints.rank import checked_tolerance, eps_of, pseudo_inverse, tolerance
from jaxdyn.dynamics.quantities import inverse_dynamics, mass_matrix
from jaxdyn.lie.so3 import _product
from jaxdyn.model.arguments import Numbers, as_array, batch_hint, check_state
from jaxdyn.model.names import velocity_indices
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, velocity_to_rate

if TYPE_CHECKING:
    Velocities = Sequence[str] | Sequence[int] | np.ndarray | Array
else:
    Velocities = Any  # `_indices` checks them


class ConstrainedInverseDynamics(Outcome):
    """Motion and torques of a mechanism that its motors move.

    - `torques` (nm,), N m or N, in the order of the motors; `tau` (nv,), the generalised force that they are.
    - `velocity` (nv,) and its rate `acceleration` (nv,); `q_dot` (nq,), the rate of q.
    - `multipliers` (nc,), as of `constrained_dynamics`; of least norm where rows are dependent.
    - `result`: one of `RESULTS`. `singular_basis`: the independent velocities do not determine the others here.
      `contradictory_rows`: there are more of them than degrees of freedom, and no motion has all their values. `underactuated`:
      the motors cannot produce the motion. The torques are then those of least squares.
    """

    torques: Float[Array, " nm"]
    tau: Float[Array, " nv"]
    velocity: Float[Array, " nv"]
    acceleration: Float[Array, " nv"]
    q_dot: Float[Array, " nq"]
    multipliers: Float[Array, " nc"]
    result: Any


def constrained_inverse_dynamics(
    scene: SceneLike,
    q: Float[Array, " nq"],
    v: Numbers,
    a_independent: Numbers,
    t: Numbers = 0.0,
    *,
    motors: Velocities | None = None,
    independent: Velocities | None = None,
    weights: Numbers | None = None,
    rank_tol: float | None = None,
    throw: bool | None = None,
) -> ConstrainedInverseDynamics:
    """Torques of the motors for a motion of a mechanism: M a + h = S tau + forces + A^T lam, A a = gamma, E a = a_independent.

    The inverse of `constrained_dynamics`, whose acceleration under `tau` and multipliers are those returned here.

    **Arguments:**

    - `q` (nq,), on the constraints (`assemble`).
    - `v`: (nv,), admissible, or (ni,), the independent velocities, from which the others follow.
    - `a_independent` (ni,): rates of the independent velocities. `t`, s.
    - `motors`: names of joints, indices of velocities, or a matrix S (nv, nm) whose columns are the generalised forces of
      motors of 1 N m or 1 N. None: one on each velocity.
    - `independent`: names of joints or indices of velocities, as many as there are degrees of freedom. None: those of the
      motors. More than the degrees of freedom are allowed if their values agree.
    - `weights` (nm,), positive: where there are more motors than degrees of freedom, the sum of weights tau^2 is least. None: 1.
    - `rank_tol` as in `constrained_dynamics`. `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `ConstrainedInverseDynamics`. Differentiable where the ranks are constant.

    **Raises:** ValueError for inconsistent shapes, unknown joints, weights that are not positive, and, if `throw`, for a
    motion that is not determined or that the motors cannot produce.

    Source: Nakamura & Ghodoussi (1989), eqs. 12 to 20; EQUATIONS sections 7 and 8.

    ```python
    scene = jd.scenes.four_bar()
    q, v = jd.scenes.four_bar.start()
    drive = jd.constrained_inverse_dynamics(scene, q, [1.0], [0.5], motors=["1"])  # the crank's torque
    ```
    """
    scene, rank_tol = as_scene(scene), checked_tolerance(rank_tol)
    q, t = check_state(scene.system, q=q, t=t)
    S, where = _motors(scene, motors, q.dtype)
    chosen = where if independent is None else _indices(scene, independent, "independent")
    if chosen is None:
        raise ValueError("motors is a matrix, which names no velocities; give independent as well")
    a_independent = as_array(a_independent, "a_independent", q.dtype)
    if a_independent.shape != (len(chosen),):
        named = f"{(len(chosen),)}, one per independent velocity{batch_hint(a_independent, (1,))}"
        raise ValueError(f"a_independent has shape {a_independent.shape}, expected {named}")
    v = as_array(v, "v", q.dtype)
    if v.shape not in ((scene.nv,), (len(chosen),)):
        raise ValueError(
            f"v has shape {v.shape}, expected {(scene.nv,)} = (nv,) or {(len(chosen),)}, the independent velocities"
            f"{batch_hint(v, (1,))}"
        )
    dynamics = _solve_compiled(
        scene, q, v, a_independent, S, _weights(weights, S.shape[1], q.dtype), t, tuple(chosen), rank_tol
    )
    concrete = is_concrete(dynamics.result)
    if throw and not concrete:
        return dynamics.result.error_if(dynamics, dynamics.result != RESULTS.successful)
    if concrete and (throw is None or throw) and not bool(dynamics.success):
        raise ValueError(_reason(dynamics, chosen))
    return dynamics


def _reason(dynamics, chosen) -> str:
    name = name_of(dynamics.result)
    reasons = {
        "singular_basis": f"independent: the velocities {list(chosen)} do not determine the others at this q; choose others",
        "contradictory_rows": f"a_independent or v: no motion has the values given for the velocities {list(chosen)}; give as "
        "many as there are degrees of freedom (jd.degrees_of_freedom)",
        "underactuated": "motors: they cannot produce this motion; name more motors, or give accelerations that they can",
        "singular_mass_matrix": "scene: its mass matrix is not positive definite at this q; give every joint some inertia",
    }
    return f"constrained_inverse_dynamics: {reasons.get(name, name)}. throw=False returns the least-squares solution"


def _motors(scene: Scene, motors, dtype) -> tuple[Any, tuple[int, ...] | None]:
    """S (nv, nm), and the velocities that have the motors, None for a matrix."""
    if motors is not None and np.ndim(motors) == 2:  # pyright: ignore[reportArgumentType]
        S = as_array(motors, "motors", dtype)
        if S.shape[0] != scene.nv or not S.shape[1]:
            raise ValueError(f"motors has shape {S.shape}, expected ({scene.nv}, nm) = (nv, nm)")
        return S, None
    where = tuple(range(scene.nv)) if motors is None else _indices(scene, motors, "motors")
    return np.eye(scene.nv, dtype=dtype)[:, list(where)], where


def _indices(scene: Scene, velocities, argument: str) -> tuple[int, ...]:
    """Indices of velocities, named by joints or given."""
    given = [velocities] if isinstance(velocities, str) else list(velocities)
    if given and all(isinstance(name, str) for name in given):
        if not isinstance(scene.system, Model):
            raise ValueError(f"{argument} names joints, and a {type(scene.system).__name__} has none; give indices")
        return tuple(int(i) for i in velocity_indices(scene.system, given))
    fine = all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) and 0 <= i < scene.nv for i in given)
    if not given or not fine or len(set(given)) < len(given):
        raise ValueError(
            f"{argument} is {velocities!r}; give names of joints or different indices of velocities, 0 to {scene.nv - 1}"
        )
    return tuple(int(i) for i in given)


def _weights(weights, count: int, dtype):
    if weights is None:
        return np.ones(count, dtype)
    weights = as_array(weights, "weights", dtype)
    if weights.shape != (count,):
        raise ValueError(f"weights has shape {weights.shape}, expected {(count,)}, one per motor")
    if is_concrete(weights) and not (np.isfinite(weights).all() and (np.asarray(weights) > 0).all()):
        raise ValueError(f"weights is {np.asarray(weights)}; give positive numbers")
    return weights


@compiled
def _solve_compiled(scene: Scene, q, v, a_independent, S, weights, t, chosen: tuple[int, ...], rank_tol):
    v, a, torques, lam, ranks_fit, agrees, is_actuated, definite = run_repaired(
        _solve, scene, q, v, a_independent, S, weights, t, static=(chosen, rank_tol)
    )
    result = RESULTS.where(is_actuated, RESULTS.successful, RESULTS.underactuated)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(agrees, result, RESULTS.contradictory_rows)
    result = RESULTS.where(ranks_fit, result, RESULTS.singular_basis)
    result = RESULTS.where(definite, result, RESULTS.singular_mass_matrix)
    q_dot = velocity_to_rate(scene.system, q, v)
    return ConstrainedInverseDynamics(torques, _product(jnp.asarray(S), torques), v, a, q_dot, lam, result)


def _solve(chosen: tuple[int, ...], rank_tol, scene: Scene, q, v, a_independent, S, weights, t):
    """v, a, torques and lam; whether E determines the motion, whether a motion has the given values, whether the motors can
    produce it, and whether M is definite."""
    nv, tol = scene.nv, tolerance(rank_tol, q)
    E = np.eye(nv, dtype=q.dtype)[list(chosen)]
    if layout(scene):
        metric, Y = whitened_rows(scene, q, t)
        inverse = pseudo_inverse(Y, tol)
    else:
        metric, Y = mass_factor(mass_matrix(scene.system, q, t)), jnp.zeros((nv, 0), q.dtype)
        inverse = Y.T
    across = metric.whiten(jnp.asarray(E.T))
    free = pseudo_inverse(across - _product(Y, _product(inverse, across)), tol)

    def complete(right, independent):
        """The whitened solution of A x = right, E x = independent, and whether it is one."""
        start = _product(inverse.T, right)
        x = start + _product(free.T, independent - _product(across.T, start))
        sizes = jnp.sqrt(jnp.sum(x * x))
        missed = (_product(Y.T, x) - right, Y), (_product(across.T, x) - independent, across)
        limit = max(eps_of(q) ** 0.5, tol)
        # By Cauchy-Schwarz the residual is compared with the sizes that cancel in it.
        fits = [
            jnp.all(jnp.abs(r) <= limit * (1 + jnp.sqrt(jnp.sum(B * B, 0)) * sizes)) if r.shape[0] else True
            for r, B in missed
        ]
        return x, jnp.logical_and(*fits)

    agrees = True
    if v.shape[0] != nv:
        rest = -velocity_residual(scene, q, jnp.zeros((nv,), q.dtype), t) if layout(scene) else Y[0]
        x, agrees = complete(rest, v)
        v = metric.unwhiten(x)
    gamma = rows(scene, q, v, t).gamma if layout(scene) else Y[0]
    x, fits = complete(gamma, a_independent)
    a = metric.unwhiten(x)
    needed = inverse_dynamics(scene.system, q, v, a, t) - applied(scene, q, v, None, t)
    pushed, by_motors = metric.whiten(needed), metric.whiten(jnp.asarray(S))
    # The columns of free^T span the admissible velocities, so that free projects out the constraint forces.
    root = 1 / jnp.sqrt(weights)
    along = _product(free, by_motors) * root[None]
    wanted = _product(free, pushed)
    scaled = _product(pseudo_inverse(along, tol), wanted)
    torques = root * scaled
    missed = _product(along, scaled) - wanted
    sizes = jnp.sqrt(jnp.sum(free * free, 1) * jnp.sum(pushed * pushed))
    is_actuated = jnp.all(jnp.abs(missed) <= max(eps_of(q) ** 0.5, tol) * sizes + eps_of(q))
    lam = _product(inverse, pushed - _product(by_motors, torques))
    rank = jnp.round(jnp.sum(inverse * Y.T)) + jnp.round(jnp.trace(_product(free, across)))
    return v, a, torques, lam, rank == nv, fits & agrees, is_actuated, metric.is_definite()
