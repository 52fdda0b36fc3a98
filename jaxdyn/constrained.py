"""Dynamics under constraints: M a + h = tau + A^T lam, A a = gamma.

In the metric of M everything is one least-squares problem. With M = L L^T, Y = L^-1 A^T and the free acceleration
a0 = M^-1 (tau - h), the constraint force L^-1 A^T lam is the shortest w with Y^T w = gamma - A a0: Gauss's principle of
least constraint. Its pseudo-inverse gives accelerations, multipliers and projections, for dependent rows too:

    w = (Y^+)^T c,   lam = Y^+ w,   a = a0 + L^-T w,   P_T = L^-T (1 - Y Y^+) L^T,   c = gamma - A a0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import lineax as lx
from jax import lax
from jaxtyping import Array, Float, Int

from jaxdyn import closed_recursion
from jaxdyn._anywhere import anywhere, flattened, mended
from jaxdyn._dispatch import LEAST_BATCH, MOST_BODIES, closed_dynamics, is_large_batch, with_derivatives
from jaxdyn._materialize import at_least
from jaxdyn._one_kernel import kernel_of, kernel_or_vectors
from jaxdyn._rank import checked_tolerance, eps_of, least_pivot, normal_factor, pseudo_inverse, quality_of, tolerance
from jaxdyn._row_pattern import MOST_PRODUCTS, products
from jaxdyn._small import cholesky, definite, solve_factored, solve_lower
from jaxdyn._tracing import is_staged, split, still, traced_once
from jaxdyn._ways import is_careful
from jaxdyn.constraints.base import Layout, Rows, constraint_jacobian, holonomic_rows, layout, rows
from jaxdyn.constraints.frames import Pair, relative_poses
from jaxdyn.constraints.loops import Loop
from jaxdyn.dynamics import bias_force, mass_matrix
from jaxdyn.model import Model, body_index
from jaxdyn.recursive import aba_with_columns
from jaxdyn.scene import Scene, checked_force
from jaxdyn.so3 import _product

METHODS = ("rank_aware", "schur", "range_space")


class RESULTS(lx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How a constrained computation ended."""

    singular_mass_matrix = (
        "The mass matrix is not positive definite to rounding: a joint moves no inertia, or next to none."
    )
    dependent_rows = "The constraint rows are dependent; take method='rank_aware'."
    contradictory_rows = "No acceleration satisfies the constraint rows: they contradict each other."
    singular_basis = "The minimal velocities do not determine the others here; choose another basis."
    not_assembled = "No configuration and velocity that satisfy the constraints were found."


class ConstrainedDynamics(eqx.Module):
    """Accelerations and constraint forces of a scene.

    - `acceleration` (nv,); `multipliers` (nc,), the forces of the constraints on the system along their rows, in N for
      rows in m and N m for rows in rad.
    - `rank` (): number of independent rows. `result`: one of `RESULTS`.
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
    t=0.0,
    *,
    method: str = "rank_aware",
    rank_tol: float | None = None,
) -> ConstrainedDynamics:
    """Acceleration and multipliers: M a + h = tau + forces + A^T lam, A a = gamma = -(Adot v) + bdot.

    The state has to satisfy the constraints (`assemble`); what it violates is not corrected here.

    **Arguments:**

    - `q` (nq,), `v` (nv,), `tau` (nv,) in N m or N (None: zero), `t` in s. The scene's forces are added to tau.
    - `method`: "rank_aware" for any rows: where they are dependent the acceleration is still right and the multipliers
      are those of least norm. "schur" forms A M^-1 A^T and its Cholesky factor: faster, for independent rows.
      "range_space" is the same without ever forming M: M^-1 is applied to the k rows by the articulated bodies of a
      `Model`, in O(nb k) operations; for few rows on a large tree, in batches. Other systems take their dense M.
    - `rank_tol`: singular values of L^-1 A^T below `rank_tol` times the largest count as zero. Default eps^(4/7),
      1.1e-9 in float64 and 1.1e-4 in float32: above the 1e-12 to 1e-10 by which rows that depend on each other differ
      when loops are open by rounding and projection errors, below the least singular values of mechanisms that move.

    **Returns:** `ConstrainedDynamics`. Under "schur" and "range_space", dependent rows give the code `dependent_rows`.

    Differentiable any number of times where the rank is constant; the pseudo-inverse has a rule of its own, no
    factorisation is differentiated.

    **Raises:** ValueError for shapes that do not fit, unknown methods, and constraints of the scene that are none.

    Source: EQUATIONS section 7; Udwadia & Kalaba (1992).
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}; choose from {', '.join(METHODS)}")
    rank_tol = checked_tolerance(rank_tol)
    tau = jnp.zeros_like(v) if tau is None else checked_force(tau, q, scene.nv, "tau")
    places = layout(scene)
    if not places:
        return _free(scene, q, v, applied(scene, q, v, tau, t), t)
    state = q, v, tau, jnp.asarray(t, q.dtype)

    def dense(*state):
        return traced_once(_by_matrices, scene, *state, static=(method, rank_tol))

    def short(q, v, tau, t):
        force = applied(scene, q, v, tau, t)
        found = closed_dynamics(scene.system, scene.constraints, q, v, force)
        if method == "rank_aware":
            return _mended(scene, found, q, v, tau, t, rank_tol, _derivatives_of_recursion)
        rank, result = _judged(scene, q, found[-1])
        a, lam = with_derivatives(scene.system, scene.constraints, q, v, force, *found[:2])
        return ConstrainedDynamics(a, lam, rank, result, places)

    if method == "range_space":
        return dense(*state)
    kernel = _kernel(scene, *state) if method == "rank_aware" else None
    if kernel is None and method == "rank_aware" and scene.forces:
        # Forces may be anything. The rest may do without branches.
        bare = Scene(scene.system, scene.constraints)
        return constrained_dynamics(bare, q, v, applied(scene, q, v, tau, t), t, rank_tol=rank_tol)
    if kernel is None:
        return by_the_batch(scene, short, dense, *state)
    found = kernel(partial(_elsewhere, scene), *still(state))
    same = _derivatives_of_recursion if has_short_recursion(scene) else None
    return _mended(scene, found, *state, rank_tol, same)


def _kernel(scene: Scene, q, v, tau, t):
    """Accelerations, multipliers and the quality of the rows in one kernel, if there is one."""
    if not is_staged() or layout(scene)[-1].end > scene.nv:
        return None
    if has_short_recursion(scene):
        return kernel_or_vectors(_in_numbers, scene, q, v, tau, t, long=has_long_recursion(scene))
    return kernel_of(_in_numbers, scene, q, v, tau, t)


def _in_numbers(scene: Scene, q, v, tau, t):
    """(a, lam, least over largest pivot of A M^-1 A^T) without branches; NaN where M is not positive definite."""
    if not has_short_recursion(scene):
        return _by_pivots(scene, q, v, tau, t)
    force = applied(scene, q, v, tau, t)
    return closed_recursion.closed_dynamics(scene.system, scene.constraints, q, v, force)


def _elsewhere(scene: Scene, q, v, tau, t):
    """The same where it is not written out in numbers: see `_dispatch`."""

    def recursion(*state):
        with at_least(LEAST_BATCH):
            return traced_once(_in_numbers, scene, *state)

    return by_the_batch(scene, recursion, partial(_by_pivots, scene), q, v, tau, t)


def _by_pivots(scene: Scene, q, v, tau, t):
    row = rows(scene, q, v, t)
    mass, factor, Y, free = _weighted(scene, q, v, applied(scene, q, v, tau, t), t, row)
    normal = cholesky(_product(Y.T, Y))
    lam = _refined(normal, Y, row.gamma - _product(Y.T, free))
    a = solve_lower(factor, free + _product(Y, lam), transposed=True)
    return a, lam, jnp.where(definite(mass, factor), quality_of(normal), jnp.nan)


def _by_matrices(scene: Scene, q, v, tau, t, method: str, rank_tol) -> ConstrainedDynamics:
    return solve_rows(scene, q, v, applied(scene, q, v, tau, t), t, rows(scene, q, v, t), method, rank_tol)


def has_short_recursion(scene: Scene) -> bool:
    """Whether all constraints are loops of a tree, and few enough to be written out in single numbers."""
    model, loops = scene.system, scene.constraints
    if not (isinstance(model, Model) and model.nb <= 2 * MOST_BODIES and all(isinstance(loop, Loop) for loop in loops)):
        return False
    ends = [(body_index(model, loop.body_a), body_index(model, loop.body_b)) for loop in loops]
    return products(model, ends, [loop.kind.count for loop in loops]) <= MOST_PRODUCTS


def has_long_recursion(scene: Scene) -> bool:
    """Whether the recursion is written out, but likely to be too long for a kernel of single numbers."""
    return has_short_recursion(scene) and scene.system.nb > MOST_BODIES


def by_the_batch(scene: Scene, short: Callable, long: Callable, *args, on_cpu: bool = False):
    """short(*args) in large batches of scenes that have a short recursion, or in all `on_cpu`, else long(*args)."""
    large = has_short_recursion(scene) and is_large_batch(scene, *args, on_cpu=on_cpu)
    if isinstance(large, jax.core.Tracer):
        return lax.cond(large, short, long, *args)
    return (short if large else long)(*args)


def in_one_batch(function: Callable, scene: Scene, *args):
    """function(scene, *args); where a large batch would run on the short recursion, the samples of nested `vmap`s together.

    Other constraints may be functions that hold traced numbers, of which `flattened` would not know.
    """
    if not has_short_recursion(scene):
        return function(scene, *args)
    unknown, known = split(scene)
    return flattened(lambda unknown, *args: function(known(unknown), *args))(unknown, *args)


def _judged(scene: Scene, q, quality):
    """Rank and code of rows that were taken for independent, from the ratio of their pivots."""
    rank = jnp.asarray(layout(scene)[-1].end, jnp.int32)
    result = RESULTS.where(quality > 10 * scene.nv * eps_of(q), RESULTS.successful, RESULTS.dependent_rows)  # pyright: ignore[reportArgumentType]
    return rank, RESULTS.where(jnp.isfinite(quality), result, RESULTS.singular_mass_matrix)


def _mended(scene: Scene, found, q, v, tau, t, rank_tol, same: Callable | None) -> ConstrainedDynamics:
    """`found` = (a, lam, quality of the rows), with the rank-aware solve for the samples whose rows it could not serve."""
    a, lam, quality = found
    unknown, known = split(scene)

    def careful(unknown, state):
        found = traced_once(_by_matrices, known(unknown), *state, static=("rank_aware", rank_tol))
        return (found.acceleration, found.multipliers), (found.rank, found.result)

    # Derivatives keep what a computation needs for them whether it runs or not; this one hardly ever does.
    careful = jax.checkpoint(careful, prevent_cse=False)
    rate = None if same is None else lambda found, unknown, state: same(known(unknown), found, *state)
    doubtful = ~(quality > least_pivot(q, rank_tol))
    # The recursion's derivatives are for large batches.
    dense = ~jnp.asarray(is_large_batch(scene, q, v, tau, t))
    start, state = ((a, lam), _judged(scene, q, quality)), (q, v, tau, t)
    (a, lam), (rank, result) = mended(doubtful, careful, start, (unknown, state), rate, dense)
    return ConstrainedDynamics(a, lam, rank, result, layout(scene))


def _derivatives_of_recursion(scene: Scene, found, q, v, tau, t):
    force = applied(scene, q, v, tau, t)
    return with_derivatives(scene.system, scene.constraints, q, v, force, *found)


def applied(scene: Scene, q, v, tau, t) -> Array:
    """tau plus the scene's forces, (nv,)."""
    tau = jnp.zeros_like(v) if tau is None else checked_force(tau, q, scene.nv, "tau")
    force = scene.applied_force(q, v, t)
    return tau if force is None else tau + force


def _free(scene, q, v, force, t) -> ConstrainedDynamics:
    mass = mass_matrix(scene.system, q, t)
    factor = cholesky(mass)
    a = solve_factored(factor, force - bias_force(scene.system, q, v, t))
    result = RESULTS.where(definite(mass, factor), RESULTS.successful, RESULTS.singular_mass_matrix)  # pyright: ignore[reportArgumentType]
    return ConstrainedDynamics(a, jnp.zeros((0,), v.dtype), jnp.zeros((), jnp.int32), result, ())


def solve_rows(
    scene: Scene, q, v, force, t, row: Rows, method: str = "rank_aware", rank_tol: float | None = None
) -> ConstrainedDynamics:
    """Acceleration and multipliers for rows A a = gamma that may differ from the scene's in gamma."""
    if method == "range_space" and isinstance(scene.system, Model):
        return _by_range_space(scene, q, v, force, row)
    mass, factor, Y, free = _weighted(scene, q, v, force, t, row)
    wanted = row.gamma - _product(Y.T, free)
    if method != "rank_aware":
        lam, result = _by_delassus(_product(Y.T, Y), wanted, scene.nv)
        pushed = _product(Y, lam)
        rank = jnp.asarray(Y.shape[1], jnp.int32)
    else:
        lam, pushed, rank = _shortest(Y, wanted, rank_tol)
        # By Cauchy-Schwarz the residual is compared with the sizes that cancel in it.
        missed = jnp.abs(wanted - _product(Y.T, pushed))
        sizes = jnp.abs(row.gamma) + jnp.sqrt(jnp.sum(Y * Y, 0) * (jnp.sum(free * free) + jnp.sum(pushed * pushed)))
        met = jnp.all(missed <= eps_of(Y) ** 0.5 * (sizes + jnp.max(sizes)))
        result = RESULTS.where(met, RESULTS.successful, RESULTS.contradictory_rows)  # pyright: ignore[reportArgumentType]
    a = solve_lower(factor, free + pushed, transposed=True)
    result = RESULTS.where(definite(mass, factor), result, RESULTS.singular_mass_matrix)
    return ConstrainedDynamics(a, lam, rank, result, layout(scene))


def _weighted(scene: Scene, q, v, force, t, row: Rows):
    """M = L L^T, L, Y = L^-1 A^T and L^-1 (force - h)."""
    mass = mass_matrix(scene.system, q, t)
    factor = cholesky(mass)
    columns = jnp.concatenate([row.A, (force - bias_force(scene.system, q, v, t))[None]]).T
    solved = solve_lower(factor, columns)
    return mass, factor, solved[:, :-1], solved[:, -1]


def _refined(factor, Y, right):
    """(Y^T Y)^-1 right from the Cholesky factor: one correction takes the squared condition number out of the error."""
    x = solve_factored(factor, right)
    return x + solve_factored(factor, right - _product(Y.T, _product(Y, x)))


def _shortest(Y, wanted, rank_tol):
    """lam and w = Y lam, the shortest w with Y^T w = wanted, and the rank of Y."""

    def by_rank(Y, wanted):
        inverse = pseudo_inverse(Y, tolerance(rank_tol, Y), True)
        pushed = _product(inverse.T, wanted)
        return _product(inverse, pushed), pushed, jnp.round(jnp.sum(inverse * Y.T)).astype(jnp.int32)

    if Y.shape[1] > Y.shape[0] or is_careful():
        return by_rank(Y, wanted)
    # The factor is not differentiated: where it is not used it may be NaN, which would reach derivatives even times zero.
    factor, independent = normal_factor(lax.stop_gradient(Y), rank_tol)

    def by_normal_equations(Y, wanted):
        def normal(x):
            return _product(Y.T, _product(Y, x))

        lam = lax.custom_linear_solve(normal, wanted, lambda _, right: _refined(factor, Y, right), symmetric=True)
        return lam, _product(Y, lam), jnp.asarray(Y.shape[1], jnp.int32)

    careful = jax.checkpoint(by_rank, prevent_cse=False)
    return lax.cond(anywhere(~independent), careful, by_normal_equations, Y, wanted)


def _by_range_space(scene, q, v, force, row: Rows) -> ConstrainedDynamics:
    """The Schur complement from a0 and X = M^-1 A^T of one articulated-body factorisation: a = a0 + X lam."""
    free, X = aba_with_columns(scene.system, q, v, force, row.A.T)
    lam, result = _by_delassus(_product(row.A, X), row.gamma - _product(row.A, free), scene.nv)
    a = free + _product(X, lam)
    result = RESULTS.where(jnp.isfinite(free).all(), result, RESULTS.singular_mass_matrix)
    return ConstrainedDynamics(a, lam, jnp.asarray(row.A.shape[0], jnp.int32), result, layout(scene))


def _by_delassus(delassus, wanted, nv: int):
    """lam with A M^-1 A^T lam = wanted by Cholesky, and whether the rows were independent."""
    factor = cholesky(0.5 * (delassus + delassus.T))
    pivots = jnp.diagonal(factor)
    # The factor's rounding error is eps times the largest entry; pivots (roots) at that level mean nothing.
    fine = jnp.min(pivots) > (10 * nv * eps_of(delassus)) ** 0.5 * jnp.max(pivots)
    return solve_factored(factor, wanted), RESULTS.where(fine, RESULTS.successful, RESULTS.dependent_rows)  # pyright: ignore[reportArgumentType]


def constraint_forces(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"], t=0.0
) -> dict[str, Float[Array, " nv"]]:
    """Generalised force A_i^T lam_i (nv,) of each constraint on the system, by name; N m or N."""
    A = constraint_jacobian(scene, q, t)
    return {p.name: _product(A[p.start : p.end].T, multipliers[p.start : p.end]) for p in layout(scene)}


def constraint_wrenches(
    scene: Scene, q: Float[Array, " nq"], multipliers: Float[Array, " nc"]
) -> dict[str, Float[Array, "6"]]:
    """Wrench (f, tau) of each constraint between two frames on its body B, at the origin and in the axes of its frame A.

    N and N m, by name. The wrench on body A is the negative of it. A loop has its frames A and B as given; for a rolling
    contact A is on the surface and B on the body that rolls, for a contact of a grasp A is on the object and B on the finger.
    """
    found = {}
    for constraint, place in zip(scene.constraints, layout(scene), strict=True):
        if isinstance(constraint, Pair):
            rotation, position = relative_poses([constraint], scene.system, q)
            found[place.name] = constraint.wrench(rotation[0], position[0], multipliers[place.start : place.end])
    return found


def projections(scene: Scene, q: Float[Array, " nq"], t=0.0, *, rank_tol: float | None = None) -> Projections:
    """Projections P_T = 1 - M^-1 A^T (A M^-1 A^T)^+ A of velocities and P_omega = P_T^T of forces.

    P_T is orthogonal in the metric M and keeps what satisfies A v = 0; P_omega removes every constraint force A^T lam.

    **Arguments:** `q` (nq,); `t`, s; `rank_tol` as in `constrained_dynamics`.

    **Returns:** (P_T, P_omega), each (nv, nv).

    Source: EQUATIONS section 7.
    """
    factor, Y, inverse = _metric(scene, q, t, rank_tol)
    keep = jnp.eye(Y.shape[0], dtype=Y.dtype) - _product(Y, inverse)
    P_T = solve_lower(factor, _product(keep, factor.T), transposed=True)
    return Projections(P_T, P_T.T)


def second_fundamental_form(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t=0.0, *, rank_tol: float | None = None
) -> Float[Array, " nv"]:
    """S(v, v) = (1 - P_T)(a + M^-1 C v): the covariant acceleration that the constraints prescribe.

    S = M^-1 A^T (A M^-1 A^T)^+ (gamma + A M^-1 C v) needs q and v alone. M S is the force, normal to the constraints,
    that keeps the motion on them.

    **Arguments:** `q` (nq,); `v` (nv,), admissible. **Returns:** (nv,), an acceleration.

    Source: EQUATIONS section 7 and erratum E20.
    """
    coriolis = bias_force(scene.system, q, v, t) - bias_force(scene.system, q, jnp.zeros_like(v), t)
    factor, Y, inverse = _metric(scene, q, t, rank_tol)
    wanted = rows(scene, q, v, t).gamma + _product(Y.T, solve_lower(factor, coriolis))
    return solve_lower(factor, _product(inverse.T, wanted), transposed=True)


def correction(scene: Scene, q, t, rank_tol, *, holonomic: bool) -> Array:
    """B (nv, n) such that -B r is the shortest step, in the metric M(q), that removes the residual r of the rows.

    Rows: the holonomic ones, or all.
    """
    factor = cholesky(mass_matrix(scene.system, q, t))
    A = constraint_jacobian(scene, q, t)
    return _right_inverse(factor, A[holonomic_rows(layout(scene))] if holonomic else A, rank_tol)


def _right_inverse(factor, A, rank_tol):
    Y = solve_lower(factor, A.T)
    return solve_lower(factor, pseudo_inverse(Y, tolerance(rank_tol, Y)).T, transposed=True)


def _metric(scene, q, t, rank_tol):
    factor = cholesky(mass_matrix(scene.system, q, t))
    Y = solve_lower(factor, constraint_jacobian(scene, q, t).T)
    return factor, Y, pseudo_inverse(Y, tolerance(rank_tol, Y))
