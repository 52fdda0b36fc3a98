"""Inverse dynamics under constraints: the torques of the motors that move a mechanism as its drives are to move.

The rates E a of the independent velocities are rows beside those of the constraints, whose forces the motors exert. In whitened
coordinates x = U^T a, M = U U^T, with Y = U^-1 A^T, Z = U^-1 E^T, the projection K = 1 - Y Y^+ and the free acceleration
x_f = U^-1 (forces - h), Gauss's principle gives

    a      x = x_f + the least change with Y^T x = gamma, Z^T x = E a, by (K Z)^+ in the null space of Y
    tau    N^T S tau = N^T (M a + h - forces) = N^T U (x - x_f), the columns of N = U^-T (K Z)^+T spanning the driven motions
    lam    the rest, x - x_f - U^-1 S tau = Y lam

With more motors than degrees of freedom N^T S is wide, and tau is the shortest solution in the given weights.
Sources: Nakamura & Ghodoussi (1989), Dynamics computation of closed-link robot mechanisms with nonredundant and redundant
actuators, eqs. 12 to 20; EQUATIONS sections 6 to 8.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point, kernel
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout, rows, velocity_residual
from jaxdyn.constraints.codes import RESULTS, Outcome, name_of, require_success
from jaxdyn.constraints.dynamics import total_force, whiten_rows
from jaxdyn.constraints.rank import RESIDUAL, check_tolerance, eps_of, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.redundancy import distribute_multipliers
from jaxdyn.constraints.selection import independent_rows, rank_code
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, as_shape, check_state
from jaxdyn.model.topology import velocity_indices
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, velocity_to_rate

if TYPE_CHECKING:
    Velocities = Sequence[str] | Sequence[int] | np.ndarray | Array
else:
    Velocities = Any  # `velocity_choice` checks them


class ConstrainedInverseDynamics(Outcome):
    """Motion and torques of a mechanism that its motors move.

    - `torques` (nm,), N m or N, in the order of the motors; `tau` (nv,), the generalised force that they are.
    - `velocity` (nv,) and its rate `acceleration` (nv,); `q_dot` (nq,), the rate of q.
    - `multipliers` (nc,), as of `constrained_dynamics`; of least norm where rows are dependent.
    - `result`: one of `RESULTS`. `contradictory_rows`: no motion has all the values given, to the root of the rounding error of
      their size or `rank_tol`. `underactuated`: the motors cannot
      produce the motion; the torques are then those of least squares. `singular_basis`: v was given by the independent
      velocities, which do not determine the others here.
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
    r"""Torques of the motors for a motion of a mechanism.

    $$M a + h = S \tau + \tau_\mathrm{forces} + A^T \lambda, \quad A a = \gamma, \quad E a = a_\mathrm{independent}$$

    The inverse of `constrained_dynamics`, whose acceleration under `tau` and multipliers are those returned here. Velocities that
    neither the constraints nor the independent ones determine, as of a rod that spins between two balls, move as the forces
    make them.

    **Arguments:**

    - `q` (nq,), on the constraints (`assemble`).
    - `v`: (nv,), admissible, in the model's order, or (ni,), the independent velocities, from which the others follow.
    - `a_independent` (ni,): rates of the independent velocities, in the order in which these are named. `t`, s.
    - `motors`: names of joints, indices of velocities, or a matrix S (nv, nm) whose columns are the generalised forces of
      motors of 1 N m or 1 N. None: one on each velocity.
    - `independent`: names of joints or indices of velocities. None: those of the motors. More than the degrees of freedom are
      allowed if their values agree.
    - `weights` (nm,), positive: where there are more motors than degrees of freedom, the sum of weights tau^2 is least. None: 1.
    - `rank_tol` as in `constrained_dynamics`. `throw`: raise when it fails, by default if all inputs are concrete.

    **Returns:** `ConstrainedInverseDynamics`. Differentiable where the ranks are constant.

    **Raises:** ValueError for inconsistent shapes, unknown joints, all velocities in another order than the model's, weights
    that are not positive, and, if `throw`, for values that no motion has and a motion that the motors cannot produce.

    Source: Nakamura & Ghodoussi (1989), eqs. 12 to 20; EQUATIONS sections 7 and 8.

    ```python
    scene = jd.scenes.four_bar()
    q, v = jd.scenes.four_bar.start()
    drive = jd.constrained_inverse_dynamics(scene, q, [1.0], [0.5], motors=["1"])  # the crank's torque
    ```
    """
    scene, rank_tol = as_scene(scene), check_tolerance(rank_tol)
    q, t = check_state(scene.system, q=q, t=t)
    S, where = _motors(scene, motors, q.dtype)
    chosen = where if independent is None else velocity_choice(scene, independent, "independent")
    if chosen is None:
        raise ValueError("motors is a matrix, which names no velocities; give independent as well")
    count = (len(chosen),)
    a_independent = as_shape(a_independent, "a_independent", q.dtype, count, of=", one per independent velocity")
    v = as_shape(v, "v", q.dtype, (scene.nv,), count, of=", all velocities or the independent ones")
    if len(chosen) == scene.nv and chosen != tuple(range(scene.nv)):
        # v would have two meanings: the velocities in the model's order, and the independent ones in the order named.
        names = "independent" if independent is not None else "motors"
        raise ValueError(
            f"{names} has all velocities, in the order {list(chosen)}; name them in the order of the model, in which v is given"
        )
    scene = independent_rows(scene, q, t, rank_tol)
    shares: Any = np.ones(S.shape[1], q.dtype)
    if weights is not None:
        shares = as_shape(weights, "weights", q.dtype, (S.shape[1],), of=", one per motor")
        if is_concrete(shares) and not (np.isfinite(shares).all() and (np.asarray(shares) > 0).all()):
            raise ValueError(f"weights is {np.asarray(shares)}; give positive numbers")
    dynamics = _solve_by_program(scene, q, v, a_independent, S, shares, t, tuple(chosen), rank_tol)
    return require_success(dynamics, throw, lambda dynamics: _reason(dynamics, chosen))


def _reason(dynamics, chosen) -> str:
    name = name_of(dynamics.result)
    reasons = {
        "singular_basis": f"independent: the velocities {list(chosen)} do not determine the others at this q; choose others",
        "contradictory_rows": f"a_independent or v: no motion has the values given for the velocities {list(chosen)}; give as "
        "many as there are degrees of freedom (jd.degrees_of_freedom), and none that a dead centre holds",
        "underactuated": "motors: they cannot produce this motion; name more motors, or give accelerations that they can",
        "unclear_rank": "scene: rounding of its numbers hides which rows repeat others; give more digits, or a rank_tol",
        "singular_mass_matrix": "scene: its mass matrix is not positive definite at this q; give every joint some inertia",
    }
    return f"constrained_inverse_dynamics: {reasons.get(name, name)}. throw=False returns the least-squares solution"


def _motors(scene: Scene, motors, dtype) -> tuple[Any, tuple[int, ...] | None]:
    """S (nv, nm), and the velocities that have the motors, None for a matrix."""
    if motors is not None and np.ndim(motors) == 2:
        S = as_array(motors, "motors", dtype)
        if S.shape[0] != scene.nv or not S.shape[1]:
            raise ValueError(f"motors has shape {S.shape}, expected ({scene.nv}, nm) = (nv, nm)")
        return S, None
    where = tuple(range(scene.nv)) if motors is None else velocity_choice(scene, motors, "motors")
    return np.eye(scene.nv, dtype=dtype)[:, list(where)], where


def velocity_choice(scene: Scene, velocities: Any, argument: str) -> tuple[int, ...]:
    """Different indices of velocities, named by joints or given. **Raises:** ValueError for others."""
    given = (
        [velocities] if isinstance(velocities, str) else list(velocities) if isinstance(velocities, Iterable) else []
    )
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


@entry_point
def _solve_by_program(scene: Scene, q, v, a_independent, S, weights, t, chosen: tuple[int, ...], rank_tol):
    v, a, torques, lam, is_determined, agrees, is_actuated, definite = kernel(_solve, static=2)(
        chosen, rank_tol, scene, q, v, a_independent, S, weights, t
    )
    # Later codes override earlier ones: torques have no meaning where the motion is not determined.
    result = RESULTS.where(is_actuated, RESULTS.successful, RESULTS.underactuated)
    result = RESULTS.where(agrees, result, RESULTS.contradictory_rows)
    result = RESULTS.where(is_determined, result, RESULTS.singular_basis)
    result = RESULTS.where(definite, result, RESULTS.singular_mass_matrix)
    result = rank_code(scene, result)
    lam, q_dot = distribute_multipliers(scene, q, t, lam), velocity_to_rate(scene.system, q, v)
    return ConstrainedInverseDynamics(torques, matmul(jnp.asarray(S), torques), v, a, q_dot, lam, result)


def _solve(chosen: tuple[int, ...], rank_tol, scene: Scene, q, v, a_independent, S, weights, t):
    """v, a, torques and lam; whether v is determined, whether a motion has the given values, whether the motors can produce it,
    and whether M is definite.
    """
    nv, tol, has_rows = scene.nv, tolerance(rank_tol, q), bool(layout(scene))
    # Residuals are not tested more strictly than the dependence of rows is decided.
    limit = max(eps_of(q) ** RESIDUAL, tol)
    E = np.eye(nv, dtype=q.dtype)[list(chosen)]
    if has_rows:
        metric, Y = whiten_rows(scene, q, t)
        inverse = pseudo_inverse(Y, tol)
    else:
        metric, Y = mass_factor(mass_matrix(scene.system, q, t)), jnp.zeros((nv, 0), q.dtype)
        inverse = Y.T

    def across(x):
        """K x, the part that is no constraint force."""
        return x - matmul(Y, matmul(inverse, x))

    Z = metric.whiten(jnp.asarray(E.T))
    # A velocity that the rows hold, as at a dead centre, leaves rounding here, which is large beside nothing else.
    # The second K removes the constraint forces that rounding of the first leaves. Near a dead centre, where little is driven,
    # torques would lose twice as many digits as the motion.
    squares, driven = jnp.sum(Z * Z, 0), across(across(Z))
    driven = jnp.where((jnp.sum(driven * driven, 0) > tol**2 * squares)[None], driven, jnp.zeros_like(driven))
    free = pseudo_inverse(driven, tol)

    def complete(start, right, independent):
        """The solution x of Y^T x = right, Z^T x = independent nearest to the start, and whether there is one."""
        x = start + matmul(inverse.T, right - matmul(Y.T, start))
        # In the null space of Y, so that the constraints remain satisfied.
        x = x + matmul(free.T, independent - matmul(Z.T, x))
        size = jnp.sqrt(jnp.sum(x * x)) + jnp.sqrt(jnp.sum(start * start))
        # Rounding of what is quadratic in the velocities may be all that a right-hand side has.
        minimum = 100 * eps_of(q) * (eps_of(q) + jnp.sum(v * v))
        # By Cauchy-Schwarz a residual is compared with the sizes that cancel in it.
        fits = [
            jnp.all(
                jnp.abs(matmul(B.T, x) - wanted)
                <= limit * (jnp.abs(wanted) + jnp.sqrt(jnp.sum(B * B, 0)) * size) + minimum
            )
            for B, wanted in ((Y, right), (Z, independent))
            if B.shape[1]
        ]
        return x, jnp.all(jnp.stack(fits))

    is_determined, agrees = jnp.asarray(True), jnp.asarray(True)
    if v.shape[0] != nv:
        still = jnp.zeros((nv,), q.dtype)
        # Y[0] is an empty vector where there are no rows, and A v - b is -b at rest.
        rest = -velocity_residual(scene, q, still, t) if has_rows else Y[0]
        x, agrees = complete(still, rest, v)
        v = metric.unwhiten(x)
        rank = rank_of(Y, inverse) + jnp.round(jnp.trace(matmul(free, driven)))
        # The rows of constraints and of independent velocities must span all velocities.
        is_determined = rank == nv
    gamma = rows(scene, q, v, t).gamma if has_rows else Y[0]
    unforced = metric.whiten(total_force(scene, q, v, None, t) - bias_force(scene.system, q, v, t))
    x, fits = complete(unforced, gamma, a_independent)
    # What motors and constraint forces have to add to the free acceleration.
    needed, by_motors = x - unforced, metric.whiten(jnp.asarray(S))
    # The columns of free^T span the driven motions, so that free takes out the constraint forces.
    root = 1 / jnp.sqrt(weights)
    # The least sum of weights tau^2 is the least norm of sqrt(weights) tau.
    along = matmul(free, by_motors) * root[None]
    torques = root * matmul(pseudo_inverse(along, tol), matmul(free, needed))
    rest = needed - matmul(by_motors, torques)
    sizes = jnp.sqrt(jnp.sum(needed * needed)) + jnp.sqrt(jnp.sum(unforced * unforced))
    # What motors do not supply must be a constraint force, on which K is zero.
    is_actuated = jnp.all(jnp.abs(across(rest)) <= limit * sizes + eps_of(q))
    a, lam = metric.unwhiten(x), matmul(inverse, rest)
    return v, a, torques, lam, is_determined, agrees & fits, is_actuated, metric.is_definite()
