"""Dynamics under constraints: M a + h = tau + A^T lam, A a = gamma.

In the metric of M everything is one least-squares problem. With M = L L^T, Y = L^-1 A^T and the free acceleration
a0 = M^-1 (tau - h), the constraint force L^-1 A^T lam is the shortest w with Y^T w = gamma - A a0: Gauss's principle of
least constraint. The pseudo-inverse of Y gives accelerations, multipliers and projections, for dependent rows too:

    w = (Y^+)^T c,   lam = Y^+ w,   a = a0 + L^-T w,   P_T = L^-T (1 - Y Y^+) L^T,   c = gamma - A a0.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdyn.compile import is_standalone, kernel, mark_invalid
from jaxdyn.constraints.base import Layout, Rows, constraint_jacobian, holonomic_rows, layout, rows
from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.rank import (
    check_tolerance,
    eps_of,
    least_pivot,
    pseudo_inverse,
    quality_of,
    regular_gram,
    tolerance,
)
from jaxdyn.constraints.redundancy import has_selection
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.dynamics.recursions import aba_with_columns
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state, zeros_if_none
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene, as_scene, check_force

METHODS = ("rank_aware", "schur", "range_space")


class ConstrainedDynamics(Outcome):
    """Accelerations and constraint forces of a scene.

    - `acceleration` (nv,), the rate of v: of a free or spherical joint that of its body twist, in axes that turn with the body
      (`jd.dynamics.frame_acceleration` gives accelerations in world axes).
    - `multipliers` (nc,), the forces of the constraints on the system along their rows, in N for rows in m and N m for rows
      in rad.
    - `rank` (): number of independent rows. `result`: one of `RESULTS`; `success`: true where it is `successful`.
    - `layout`: name and place of each constraint's rows.
    """

    acceleration: Float[Array, " nv"]
    multipliers: Float[Array, " nc"]
    rank: Int[Array, ""]
    result: Any
    layout: tuple[Layout, ...] = eqx.field(static=True)

    def by_name(self) -> dict[str, Array]:
        """Multipliers of each constraint, by its name."""
        return {place.name: self.multipliers[..., place.start : place.end] for place in self.layout}


class Projections(NamedTuple):
    """P_T (nv, nv) maps velocities to admissible ones; P_omega = P_T^T removes constraint forces from forces."""

    P_T: Float[Array, "nv nv"]
    P_omega: Float[Array, "nv nv"]


def constrained_dynamics(
    scene: Scene,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    method: str = "rank_aware",
    rank_tol: float | None = None,
) -> ConstrainedDynamics:
    """Acceleration and multipliers: M a + h = tau + forces + A^T lam, A a = gamma = -(Adot v) + bdot.

    The state has to satisfy the constraints (`assemble`); violations are not corrected here.

    **Arguments:**

    - `q` (nq,), `v` (nv,), `tau` (nv,) in N m or N (None: zero), `t` in s. The scene's forces are added to tau.
    - `method`: "rank_aware" for any rows: where they are dependent the acceleration is still right and the multipliers
      are those of least norm. "schur" forms A M^-1 A^T and its Cholesky factor: faster, for independent rows.
      "range_space" is the same without ever forming M: M^-1 is applied to the k rows by the articulated bodies of a
      `Model`, in O(nb k) operations; for few rows on a large tree, in batches. Other systems take their dense M.
    - `rank_tol`: singular values of L^-1 A^T below `rank_tol` times the largest count as zero. Default eps^(4/7),
      1.1e-9 in float64 and 1.1e-4 in float32: above the 1e-12 to 1e-10 by which dependent rows differ when loops are open
      by rounding and projection errors, below the least singular values of mechanisms that move.

    **Returns:** `ConstrainedDynamics`. Under "schur" and "range_space", dependent rows give the code `dependent_rows`.

    Differentiable any number of times where the rank is constant, by the derivative of the pseudo-inverse: no factorisation is
    differentiated.

    **Raises:** ValueError for shapes that do not fit, unknown methods, and constraints of the scene that are none.

    Source: EQUATIONS section 7; Udwadia & Kalaba (1992).
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose from {', '.join(METHODS)}")
    rank_tol = check_tolerance(rank_tol)
    scene = as_scene(scene)
    tau = zeros_if_none(tau, scene.nv)
    q, v, tau, t = check_state(scene.system, q=q, v=v, tau=tau, t=t)
    places = layout(scene)
    if not places:
        return _free(scene, q, v, total_force(scene, q, v, tau, t), t)
    state = q, v, tau, t
    if method != "rank_aware":
        return _by_schur(scene, *state, method=method)
    # More rows than velocities are dependent wherever the mechanism moves: by rank at once. Else Cholesky first, and by rank the
    # samples that it marks. Selected rows are independent by construction, and their zero rows do not count.
    is_wide = places[-1].end > scene.nv and not has_selection(scene)
    a, lam, rank, result = (_by_rank if is_wide else _by_pivots)(rank_tol, scene, *state)
    return ConstrainedDynamics(a, lam, rank, result, places)


def _by_rank(rank_tol, scene: Scene, q, v, tau, t):
    """(a, lam, rank, result) for rows that may be dependent."""
    metric, Y, free, wanted, gamma = kernel(_gauss_problem)(scene, q, v, tau, t)
    solution = _constrain_acceleration(scene, metric, Y, free, wanted, gamma, rank_tol)
    return solution.acceleration, solution.multipliers, solution.rank, solution.result


def _without_forces(rank_tol, scene: Scene, q, v, tau, t):
    """Fallback of `_by_pivots`, where it cannot be a kernel or is not valid."""
    if not scene.forces:
        return _by_rank(rank_tol, scene, q, v, tau, t)
    # A user's force may use operations that kernels do not have. Without the forces the rest may be a kernel; they enter as tau.
    bare = Scene(scene.system, scene.constraints)
    return _by_pivots(rank_tol, bare, q, v, total_force(scene, q, v, tau, t), t)


@kernel(static=1, fallback=_without_forces)
def _by_pivots(rank_tol, scene: Scene, q, v, tau, t):
    """(a, lam, rank, result) without branches; invalid where the pivots of A M^-1 A^T are too small for their errors."""
    metric, Y, free, wanted, _ = _gauss_problem(scene, q, v, tau, t)
    normal = cholesky(regular_gram(Y) if has_selection(scene) else matmul(Y.T, Y))
    lam = _solve_with_refinement(normal, Y, wanted)
    quality = jnp.where(metric.is_definite(), quality_of(normal), jnp.nan)
    is_poor = ~(quality > least_pivot(q, rank_tol))
    a, lam = (mark_invalid(is_poor, x) for x in (metric.unwhiten(free + matmul(Y, lam)), lam))
    return a, lam, *_rank_and_result(scene, q, quality)


def _gauss_problem(scene: Scene, q, v, tau, t):
    """Gauss's least-squares problem: the factor of M, Y = U^-1 A^T, U^-1 (tau + forces - h), gamma - A a0, and gamma."""
    row = rows(scene, q, v, t)
    metric, Y, free = _whiten_columns(scene, q, v, total_force(scene, q, v, tau, t), t, row.A)
    return metric, Y, free, row.gamma - matmul(Y.T, free), row.gamma


def _rank_and_result(scene: Scene, q, quality):
    """Rank and code of rows that are treated as independent, from the ratio of their pivots."""
    # The factor of a singular matrix is wrong by about nv eps in its pivots; NaN comes from a mass matrix that is not definite.
    rank = jnp.asarray(layout(scene)[-1].end, jnp.int32)
    result = RESULTS.where(quality > 10 * scene.nv * eps_of(q), RESULTS.successful, RESULTS.dependent_rows)  # pyright: ignore[reportArgumentType]
    return rank, RESULTS.where(jnp.isfinite(quality), result, RESULTS.singular_mass_matrix)


def total_force(scene: Scene, q, v, tau, t) -> Array:
    """tau plus the scene's forces, (nv,)."""
    tau = jnp.zeros_like(v) if tau is None else check_force(tau, q, scene.nv, "tau")
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau + force


def _free(scene, q, v, force, t) -> ConstrainedDynamics:
    metric = mass_factor(mass_matrix(scene.system, q, t))
    a = metric.solve(force - bias_force(scene.system, q, v, t))
    result = RESULTS.where(metric.is_definite(), RESULTS.successful, RESULTS.singular_mass_matrix)  # pyright: ignore[reportArgumentType]
    return ConstrainedDynamics(a, jnp.zeros((0,), v.dtype), jnp.zeros((), jnp.int32), result, ())


def solve_rows(scene: Scene, q, v, force, t, row: Rows, rank_tol: float | None = None) -> ConstrainedDynamics:
    """Acceleration and multipliers for rows A a = gamma that may differ from the scene's in gamma."""
    bare = Scene(scene.system)
    metric, Y, free = kernel(_whiten_columns)(bare, q, v, force, t, row.A)
    return _constrain_acceleration(scene, metric, Y, free, row.gamma - matmul(Y.T, free), row.gamma, rank_tol)


def _constrain_acceleration(scene: Scene, metric: MassFactor, Y, free, wanted, gamma, rank_tol) -> ConstrainedDynamics:
    """Acceleration by Gauss's principle: the shortest addition to the free one, in the metric M, that satisfies the rows."""
    lam, pushed, rank = _min_norm_solution(Y, wanted, rank_tol)
    # The pseudo-inverse gives the least-squares compromise of contradictory rows without saying so: the residual tells them.
    # By Cauchy-Schwarz the residual is compared with the sizes that cancel in it.
    missed = jnp.abs(wanted - matmul(Y.T, pushed))
    sizes = jnp.abs(gamma) + jnp.sqrt(jnp.sum(Y * Y, 0) * (jnp.sum(free * free) + jnp.sum(pushed * pushed)))
    # Rows that count as dependent differ by as much as the rank tolerance.
    limit = max(eps_of(Y) ** 0.5, tolerance(rank_tol, Y))
    met = jnp.all(missed <= limit * (sizes + jnp.max(sizes)))
    result = RESULTS.where(met, RESULTS.successful, RESULTS.contradictory_rows)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(metric.is_definite(), result, RESULTS.singular_mass_matrix)
    a = metric.unwhiten(free + pushed)
    if is_standalone():  # code without JAX returns a status in addition to its values
        a = mark_invalid(~(met & metric.is_definite()), a)
    return ConstrainedDynamics(a, lam, rank, result, layout(scene))


def _whiten_columns(scene: Scene, q, v, force, t, A):
    """M = U U^T, Y = U^-1 A^T and U^-1 (force - h)."""
    metric = mass_factor(mass_matrix(scene.system, q, t))
    # One triangular solve for all right-hand sides.
    columns = jnp.concatenate([A, (force - bias_force(scene.system, q, v, t))[None]]).T
    whitened = metric.whiten(columns)
    return metric, whitened[:, :-1], whitened[:, -1]


def _solve_with_refinement(factor, Y, right):
    """(Y^T Y)^-1 right from the Cholesky factor, with one step of iterative refinement against Y."""
    # Y^T Y squares the condition number. The residual formed with Y itself recovers those digits.
    x = solve_cholesky(factor, right)
    return x + solve_cholesky(factor, right - matmul(Y.T, matmul(Y, x)))


def _min_norm_solution(Y, wanted, rank_tol):
    """lam and w = Y lam, the shortest w with Y^T w = wanted, and the rank of Y."""
    # More rows than velocities are dependent wherever the mechanism moves: the normal equations would fail for all samples.
    inverse = pseudo_inverse(Y, tolerance(rank_tol, Y), Y.shape[1] > Y.shape[0])
    pushed = matmul(inverse.T, wanted)
    return matmul(inverse, pushed), pushed, jnp.round(jnp.sum(inverse * Y.T)).astype(jnp.int32)


def _by_schur(scene: Scene, q, v, tau, t, *, method: str) -> ConstrainedDynamics:
    """Dynamics with independent rows, by the Cholesky factor of A M^-1 A^T."""
    by_bodies = method == "range_space" and isinstance(scene.system, Model)
    a, lam, fine, definite = kernel(_by_bodies if by_bodies else _by_delassus)(scene, q, v, tau, t)
    result = RESULTS.where(fine, RESULTS.successful, RESULTS.dependent_rows)  # pyright: ignore[reportArgumentType]
    result = RESULTS.where(definite, result, RESULTS.singular_mass_matrix)
    rank = jnp.asarray(lam.shape[0], jnp.int32)
    return ConstrainedDynamics(a, lam, rank, result, layout(scene))


def _by_delassus(scene: Scene, q, v, tau, t):
    metric, Y, free, wanted, _ = _gauss_problem(scene, q, v, tau, t)
    lam, fine = _solve_delassus(matmul(Y.T, Y), wanted, scene.nv)
    return metric.unwhiten(free + matmul(Y, lam)), lam, fine, metric.is_definite()


def _by_bodies(scene: Scene, q, v, tau, t):
    """`_by_delassus` without M: a0 and X = M^-1 A^T from one articulated-body factorisation, a = a0 + X lam."""
    row, force = rows(scene, q, v, t), total_force(scene, q, v, tau, t)
    free, X = aba_with_columns(scene.system, q, v, force, row.A.T)
    lam, fine = _solve_delassus(matmul(row.A, X), row.gamma - matmul(row.A, free), scene.nv)
    return free + matmul(X, lam), lam, fine, jnp.isfinite(free).all()


def _solve_delassus(delassus, wanted, nv: int):
    """lam with A M^-1 A^T lam = wanted by Cholesky, and whether the rows were independent."""
    # A X is symmetric but for rounding, which would make the solution depend on the triangle that is read.
    factor = cholesky(0.5 * (delassus + delassus.T))
    pivots = jnp.diagonal(factor)
    # The rounding error of the factor is eps times the largest entry; pivots (here their roots) at that level are noise.
    fine = jnp.min(pivots) > (10 * nv * eps_of(delassus)) ** 0.5 * jnp.max(pivots)
    return solve_cholesky(factor, wanted), fine


def projections(
    scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> Projections:
    """Projections P_T = 1 - M^-1 A^T (A M^-1 A^T)^+ A of velocities and P_omega = P_T^T of forces.

    P_T is orthogonal in the metric M and keeps what satisfies A v = 0; P_omega removes every constraint force A^T lam.

    **Arguments:** `q` (nq,); `t`, s; `rank_tol` as in `constrained_dynamics`.

    **Returns:** (P_T, P_omega), each (nv, nv).

    Source: EQUATIONS section 7.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    metric, Y = kernel(whiten_rows)(scene, q, t)
    inverse = pseudo_inverse(Y, tolerance(rank_tol, Y))
    kept = jnp.eye(Y.shape[0], dtype=Y.dtype) - matmul(Y, inverse)
    # U^-T (1 - Y Y^+) U^T; `momentum` of the unit velocities gives the columns of U^T.
    P_T = metric.unwhiten(matmul(kept, metric.momentum(jnp.eye(scene.nv, dtype=Y.dtype))))
    return Projections(P_T, P_T.T)


def whiten_rows(scene: Scene, q, t):
    """M = U U^T and Y = U^-1 A^T."""
    metric = mass_factor(mass_matrix(scene.system, q, t))
    return metric, metric.whiten(constraint_jacobian(scene, q, t).T)


def second_fundamental_form(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> Float[Array, " nv"]:
    """Covariant acceleration that the constraints prescribe, S(v, v) = (1 - P_T)(a + M^-1 C v).

    S = M^-1 A^T (A M^-1 A^T)^+ (gamma + A M^-1 C v) needs q and v alone. M S is the force, normal to the constraints,
    that keeps the motion on them.

    **Arguments:** `q` (nq,); `v` (nv,), admissible. **Returns:** (nv,), an acceleration.

    Source: EQUATIONS section 7 and erratum E20.
    """
    scene = as_scene(scene)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    # C v without C: the bias force less its value at rest.
    coriolis = bias_force(scene.system, q, v, t) - bias_force(scene.system, q, jnp.zeros_like(v), t)
    metric, Y = kernel(whiten_rows)(scene, q, t)
    wanted = rows(scene, q, v, t).gamma + matmul(Y.T, metric.whiten(coriolis))
    return metric.unwhiten(matmul(pseudo_inverse(Y, tolerance(rank_tol, Y)).T, wanted))


def correction(scene: Scene, q, t, rank_tol, *, holonomic: bool) -> Array:
    """B (nv, n) such that -B r is the shortest step, in the metric M(q), that removes the residual r of the rows.

    The rows are the holonomic ones, or all.
    """
    metric, Y = kernel(whiten_rows)(scene, q, t)
    return _inverse_in_metric(metric, Y[:, holonomic_rows(layout(scene))] if holonomic else Y, rank_tol)


def right_inverse(metric: MassFactor, A, rank_tol) -> Array:
    """Right inverse B (nv, n) of rows A (n, nv), with the shortest columns in the metric."""
    return _inverse_in_metric(metric, metric.whiten(A.T), rank_tol)


def _inverse_in_metric(metric, Y, rank_tol):
    return metric.unwhiten(pseudo_inverse(Y, tolerance(rank_tol, Y)).T)
