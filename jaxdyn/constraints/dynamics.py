"""Dynamics under constraints: M a + h = tau + A^T lam, A a = gamma.

By Gauss's principle of least constraint this is a least-squares problem in the metric of M. Let M = U U^T (`MassFactor`),
Y = U^-1 A^T, and a0 = M^-1 (tau - h), the acceleration without constraints. It misses the rows by the deficit c = gamma - A a0.
The whitened constraint force w = U^-1 A^T lam is the shortest vector with Y^T w = c. The pseudo-inverse Y^+ gives
accelerations, multipliers and projections, for dependent rows too:

    w = (Y^+)^T c,   lam = Y^+ w,   a = a0 + U^-T w,   P_T = U^-T (1 - Y Y^+) U^T.

In the code, `Y`, `w` and `deficit` are these, and `free` is the whitened acceleration without constraints, U^-1 (tau - h).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxdyn.compile import batch, is_standalone, kernel, mark_invalid
from jaxdyn.constraints.base import Layout, Rows, constraint_jacobian, holonomic_rows, layout, rows
from jaxdyn.constraints.codes import RESULTS, Outcome, require_finite
from jaxdyn.constraints.rank import (
    REFINED,
    RESIDUAL,
    check_tolerance,
    eps_of,
    has_clear_rank,
    min_pivot,
    min_refinable_pivot,
    pseudo_inverse,
    quality_of,
    rank_of,
    regular_gram,
    tolerance,
)
from jaxdyn.constraints.redundancy import distribute_multipliers, has_selection
from jaxdyn.constraints.selection import independent_rows, rank_code
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, check_state, zeros_if_none
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import MassFactor, cholesky, mass_factor, solve_cholesky
from jaxdyn.systems.scene import Scene, as_scene, check_force

# Steps of refinement near singular positions: the first one is made always, and each gains some four digits.
_MAX_REFINEMENTS = 4

METHODS = ("rank_aware", "schur")


class ConstrainedDynamics(Outcome):
    """Accelerations and constraint forces of a scene.

    - `acceleration` (nv,): the rate of v. For a free or spherical joint it is the rate of the body twist, in axes that turn with
      the body (`jd.dynamics.frame_acceleration` gives accelerations in world axes).
    - `multipliers` (nc,): forces of the constraints on the system along their rows, in N for rows in m and N m for rows in rad.
    - `rank` (): number of independent rows. `result`: one of `RESULTS`; `success`: true where it is `successful`.
    - `layout`: name of each constraint and the range of its rows.
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
    """Projections in the metric of M: P_T (nv, nv) of velocities onto those with A v = 0, and P_omega = P_T^T of forces.

    P_omega removes the constraint forces from a generalised force.
    """

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
    r"""Acceleration and multipliers of a constrained system.

    $$M a + h = \tau + \tau_\mathrm{forces} + A^T \lambda, \quad A a = \gamma = -\dot A v + \dot b$$

    The state has to satisfy the constraints (`assemble`); violations are not corrected here.

    **Arguments:**

    - `q` (nq,), `v` (nv,), `tau` (nv,) in N m or N (None: zero), `t` in s. The scene's forces are added to tau.
    - `method`: "rank_aware" is for any rows: where they are dependent, the acceleration is still right and the multipliers are
      those of least norm. "schur" factors $A M^{-1} A^T$ by Cholesky: faster, for independent rows.
    - `rank_tol`: singular values of $Y = U^{-1} A^T$, with $M = U U^T$, count as zero below `rank_tol` times the largest.
      The default is $\epsilon^{4/7}$, 1.1e-9 in float64 and 1.1e-4 in float32: above the 1e-12 to 1e-10 by which
      dependent rows differ when loops are open by rounding and projection errors, below the least singular values of
      mechanisms that move.

    **Returns:** `ConstrainedDynamics`. Under "schur", dependent rows give the code `dependent_rows`.

    Differentiable any number of times where the rank is constant, by the derivative of the pseudo-inverse: no factorisation is
    differentiated.

    **Raises:** ValueError for shapes that do not fit, unknown methods, and items of the scene's constraints that are no
    constraints.

    Source: EQUATIONS section 7; Udwadia & Kalaba (1992).
    """
    if method not in METHODS:
        removed = ' ("range_space" is "schur" now)' if method == "range_space" else ""
        raise ValueError(f"method is {method!r}; choose from {', '.join(METHODS)}{removed}")
    rank_tol = check_tolerance(rank_tol)
    scene = as_scene(scene)
    tau = zeros_if_none(tau, scene.nv)
    q, v, tau, t = check_state(scene.system, q=q, v=v, tau=tau, t=t)
    places = layout(scene)
    if not places:
        metric = mass_factor(mass_matrix(scene.system, q, t))
        a = metric.solve(total_force(scene, q, v, tau, t) - bias_force(scene.system, q, v, t))
        result = RESULTS.where(metric.is_definite(), RESULTS.successful, RESULTS.singular_mass_matrix)
        return ConstrainedDynamics(a, jnp.zeros((0,), v.dtype), jnp.zeros((), jnp.int32), require_finite(result, a), ())
    state = q, v, tau, t
    scene = independent_rows(scene, q, t, rank_tol)
    if method != "rank_aware":
        return _by_schur(scene, *state)
    a, lam, rank, result = _accelerate(rank_tol, scene, *state)
    # Redundant rows share the constraint force: the one of least norm is unique.
    lam = distribute_multipliers(scene, q, t, lam)
    return ConstrainedDynamics(a, lam, rank, rank_code(scene, result), places)


def _accelerate(rank_tol, scene: Scene, *state):
    """(a, lam, rank, result) by the kernel for rows of this number."""
    # If there are more rows than velocities, they are dependent at every state, and Cholesky would fail for all samples. A
    # selection leaves independent rows and zeros in the place of the dropped ones, so that the count says nothing.
    is_wide = layout(scene)[-1].end > scene.nv and not has_selection(scene)
    return (_by_columns if is_wide else _by_pivots)(rank_tol, scene, *state)


def _by_rank(rank_tol, scene: Scene, q, v, tau, t):
    """(a, lam, rank, result) for rows that may be dependent, by the pseudo-inverse."""
    metric, Y, free, deficit, gamma = kernel(_gauss_problem)(scene, q, v, tau, t)
    solution = _constrain_acceleration(scene, metric, Y, free, deficit, gamma, rank_tol)
    return solution.acceleration, solution.multipliers, solution.rank, solution.result


def _without_kernel(rank_tol, scene: Scene, q, v, tau, t):
    """Fallback of the kernels, for scenes that cannot be one and for samples that the kernel marks as invalid."""
    if not scene.forces:
        return _by_rank(rank_tol, scene, q, v, tau, t)
    # A user's force may use operations that kernels do not have. It is evaluated here and enters as tau, so that the rest can be
    # a kernel.
    bare = scene.without_forces
    return _accelerate(rank_tol, bare, q, v, total_force(scene, q, v, tau, t), t)


@kernel(static=1, fallback=_without_kernel)
def _by_columns(rank_tol, scene: Scene, q, v, tau, t):
    """`_by_rank`; samples are invalid where the pseudo-inverse is, and where rows leave no motion unless they are rounded."""
    a, lam, rank, result = _by_rank(rank_tol, scene, q, v, tau, t)
    a, lam = (mark_invalid(rank >= scene.nv, x) for x in (a, lam))
    return a, lam, rank, require_finite(result, a)


@kernel(static=1, fallback=_without_kernel)
def _by_pivots(rank_tol, scene: Scene, q, v, tau, t):
    """(a, lam, rank, result) by Cholesky; samples whose least pivot of A M^-1 A^T is near its rounding error are invalid."""
    metric, Y, free, deficit, _ = _gauss_problem(scene, q, v, tau, t)
    normal = cholesky(regular_gram(Y) if has_selection(scene) else matmul(Y.T, Y))
    quality = jnp.where(metric.is_definite(), quality_of(normal), jnp.nan)
    lam, is_poor = _solve_with_refinement(normal, Y, deficit, quality, rank_tol)
    if Y.shape[1] == Y.shape[0] and not has_selection(scene):
        # Rows that leave no motion unless some repeat others: the fallback tells whether they do.
        is_poor = is_poor | ~(quality > min_pivot(q, rank_tol))
    a, lam = (mark_invalid(is_poor, x) for x in (metric.unwhiten(free + matmul(Y, lam)), lam))
    # Rounding makes zero pivots of a singular matrix about nv eps times the largest; the limit is ten times that. NaN marks a
    # mass matrix that is not positive definite.
    result = RESULTS.where(quality > 10 * scene.nv * eps_of(q), RESULTS.successful, RESULTS.dependent_rows)
    result = RESULTS.where(jnp.isfinite(quality), result, RESULTS.singular_mass_matrix)
    return a, lam, _count_rows(scene), require_finite(result, a)


def _gauss_problem(scene: Scene, q, v, tau, t):
    """Gauss's least-squares problem: the factor of M, Y, the whitened free acceleration, the deficit, and gamma."""
    row = rows(scene, q, v, t)
    metric, Y, free = _whiten_columns(scene, q, v, total_force(scene, q, v, tau, t), t, row.A)
    return metric, Y, free, row.gamma - matmul(Y.T, free), row.gamma


def _count_rows(scene: Scene) -> Array:
    """Number of rows that count, of independent ones."""
    count = jnp.sum(scene.kept_rows.kept) if has_selection(scene) else layout(scene)[-1].end
    return jnp.asarray(count).astype(jnp.int32)


def total_force(scene: Scene, q, v, tau, t) -> Array:
    """tau plus the scene's forces, (nv,)."""
    tau = jnp.zeros_like(v) if tau is None else check_force(tau, q, scene.nv, "tau")
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau + force


def solve_rows(scene: Scene, q, v, force, t, row: Rows) -> ConstrainedDynamics:
    """Acceleration and multipliers for rows A a = gamma with the scene's A; gamma may differ from the scene's."""
    bare = Scene(scene.system)
    metric, Y, free = kernel(_whiten_columns)(bare, q, v, force, t, row.A)
    return _constrain_acceleration(scene, metric, Y, free, row.gamma - matmul(Y.T, free), row.gamma, None)


def _constrain_acceleration(scene: Scene, metric: MassFactor, Y, free, deficit, gamma, rank_tol) -> ConstrainedDynamics:
    """Dynamics by Gauss's principle: the least change of the free acceleration, in the metric M, that satisfies the rows."""
    # The shortest w = Y lam with Y^T w = deficit, and lam of least norm. More rows than velocities are always dependent: the
    # normal equations would fail for all samples, and are not tried.
    inverse = pseudo_inverse(Y, tolerance(rank_tol, Y), Y.shape[1] > Y.shape[0])
    w = matmul(inverse.T, deficit)
    lam = matmul(inverse, w)
    # For contradictory rows the pseudo-inverse silently returns a least-squares compromise, which leaves a residual. The residual
    # is compared with the terms that cancel in it, whose sizes are bounded by Cauchy-Schwarz: |Y_i . w| <= |Y_i| |w|.
    residual = jnp.abs(deficit - matmul(Y.T, w))
    sizes = jnp.abs(gamma) + jnp.sqrt(jnp.sum(Y * Y, 0) * (jnp.sum(free * free) + jnp.sum(w * w)))
    # Rows that count as dependent may differ by the rank tolerance, and leave a residual of that size.
    limit = max(eps_of(Y) ** RESIDUAL, tolerance(rank_tol, Y))
    are_satisfied = jnp.all(residual <= limit * (sizes + jnp.max(sizes)))
    is_clear = has_clear_rank(Y.T, inverse.T, rank_tol, not isinstance(scene.system, Model))
    result = RESULTS.where(is_clear, RESULTS.successful, RESULTS.unclear_rank)
    result = RESULTS.where(are_satisfied, result, RESULTS.contradictory_rows)
    result = RESULTS.where(metric.is_definite(), result, RESULTS.singular_mass_matrix)
    a = metric.unwhiten(free + w)
    if is_standalone():  # exported code has no `result`; it returns a status, which invalid values set
        a = mark_invalid(~(are_satisfied & metric.is_definite()), a)
    return ConstrainedDynamics(a, lam, rank_of(Y, inverse).astype(jnp.int32), result, layout(scene))


def _whiten_columns(scene: Scene, q, v, force, t, A):
    """Factor of M = U U^T, Y = U^-1 A^T, and U^-1 (force - h)."""
    metric = mass_factor(mass_matrix(scene.system, q, t))
    # One triangular solve for all right-hand sides: the rows of A and the force.
    columns = jnp.concatenate([A, (force - bias_force(scene.system, q, v, t))[None]]).T
    whitened = metric.whiten(columns)
    return metric, whitened[:, :-1], whitened[:, -1]


def _solve_with_refinement(factor, Y, right, quality, rank_tol):
    """(Y^T Y)^-1 right from the Cholesky factor, by iterative refinement against Y, and whether that is not accurate.

    Source: Bjorck, Stability analysis of the method of seminormal equations, 1987.
    """

    # Y^T Y squares the condition number. The residual formed with Y itself recovers those digits.
    def refine(state):
        x, _ = state
        change = solve_cholesky(factor, right - matmul(Y.T, matmul(Y, x)))
        return x + change, jnp.max(jnp.abs(change)) > eps_of(x) ** REFINED * jnp.max(jnp.abs(x))

    # One step is enough for rows that are clearly independent. Near a singular position, where more are needed, a sample would
    # else leave the native loop, which takes as long as some hundred steps.
    is_poor = ~(quality > min_pivot(right, rank_tol))
    first = refine((solve_cholesky(factor, right), is_poor))[0], is_poor
    x, is_open = batch.repeat_while(lambda state: state[1], refine, first, _MAX_REFINEMENTS, marks=True)
    return x, is_poor & (is_open | ~(quality > min_refinable_pivot(right, rank_tol)))


def _by_schur(scene: Scene, q, v, tau, t) -> ConstrainedDynamics:
    """Dynamics with independent rows, by the Cholesky factor of A M^-1 A^T."""
    a, lam, independent, is_definite = kernel(_by_delassus)(scene, q, v, tau, t)
    if has_selection(scene):
        independent = independent & (_count_rows(scene) == lam.shape[0])
    result = RESULTS.where(independent, RESULTS.successful, RESULTS.dependent_rows)
    result = RESULTS.where(is_definite, result, RESULTS.singular_mass_matrix)
    result = rank_code(scene, require_finite(result, a))
    return ConstrainedDynamics(a, lam, _count_rows(scene), result, layout(scene))


def _by_delassus(scene: Scene, q, v, tau, t):
    """Acceleration, multipliers, whether the rows are independent, and whether M is definite."""
    metric, Y, free, deficit, _ = _gauss_problem(scene, q, v, tau, t)
    factor = cholesky(regular_gram(Y) if has_selection(scene) else matmul(Y.T, Y))
    # The same limit for pivots as in `_by_pivots`. The factor's diagonal has their square roots.
    roots = jnp.diagonal(factor)
    independent = jnp.min(roots) > (10 * scene.nv * eps_of(q)) ** 0.5 * jnp.max(roots)
    lam = solve_cholesky(factor, deficit)
    return metric.unwhiten(free + matmul(Y, lam)), lam, independent, metric.is_definite()


def projections(
    scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> Projections:
    r"""Projections of velocities and of forces along the constraints.

    $$P_T = 1 - M^{-1} A^T (A M^{-1} A^T)^+ A, \quad P_\omega = P_T^T$$

    $P_T$ is orthogonal in the metric M and keeps what satisfies $A v = 0$; $P_\omega$ removes every constraint force
    $A^T \lambda$.

    **Arguments:** `q` (nq,); `t`, s; `rank_tol` as in `constrained_dynamics`.

    **Returns:** (P_T, P_omega), each (nv, nv).

    Source: EQUATIONS section 7.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    scene = independent_rows(scene, q, t, rank_tol)
    metric, Y = kernel(whiten_rows)(scene, q, t)
    inverse = pseudo_inverse(Y, tolerance(rank_tol, Y))
    # U^-T (1 - Y Y^+) U^T = 1 - U^-T (Y^+)^T A, by two products as thin as the rows.
    P_T = jnp.eye(scene.nv, dtype=Y.dtype) - matmul(metric.unwhiten(inverse.T), constraint_jacobian(scene, q, t))
    return Projections(P_T, P_T.T)


def whiten_rows(scene: Scene, q, t):
    """Factor of M = U U^T, and Y = U^-1 A^T."""
    metric = mass_factor(mass_matrix(scene.system, q, t))
    return metric, metric.whiten(constraint_jacobian(scene, q, t).T)


def second_fundamental_form(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0, *, rank_tol: float | None = None
) -> Float[Array, " nv"]:
    r"""Second fundamental form of the constraints: the normal part of covariant accelerations.

    $$S(v, v) = (1 - P_T) (a + M^{-1} C v) = M^{-1} A^T (A M^{-1} A^T)^+ (\gamma + A M^{-1} C v)$$

    All motions through (q, v) that satisfy the constraints have it in common, because it is a function of q and v alone.
    $M S$ is the force, normal to the constraints, that keeps the motion on them.

    **Arguments:** `q` (nq,); `v` (nv,) with A v = b; `t`, s; `rank_tol` as in `constrained_dynamics`.

    **Returns:** (nv,), an acceleration in the units of dv/dt.

    Source: EQUATIONS section 7 and erratum E20.
    """
    scene = as_scene(scene)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    scene = independent_rows(scene, q, t, rank_tol)
    # C v without forming C: the bias force h = C v + gravity, less its value at v = 0.
    coriolis = bias_force(scene.system, q, v, t) - bias_force(scene.system, q, jnp.zeros_like(v), t)
    metric, Y = kernel(whiten_rows)(scene, q, t)
    deficit = rows(scene, q, v, t).gamma + matmul(Y.T, metric.whiten(coriolis))
    return metric.unwhiten(matmul(pseudo_inverse(Y, tolerance(rank_tol, Y)).T, deficit))


def correction(scene: Scene, q, t, rank_tol, *, holonomic: bool) -> Array:
    """Matrix B (nv, n) for a residual r (n,) of the rows: the step -B r removes it, and is the shortest in the metric M(q).

    With `holonomic` only the rows on positions are meant, else all rows.
    """
    metric, Y = kernel(whiten_rows)(scene, q, t)
    return _inverse_in_metric(metric, Y[:, holonomic_rows(layout(scene))] if holonomic else Y, rank_tol)


def right_inverse(metric: MassFactor, A, rank_tol) -> Array:
    """Right inverse B (nv, n) of rows A (n, nv), with the shortest columns in the metric."""
    return _inverse_in_metric(metric, metric.whiten(A.T), rank_tol)


def _inverse_in_metric(metric, Y, rank_tol):
    return metric.unwhiten(pseudo_inverse(Y, tolerance(rank_tol, Y)).T)
