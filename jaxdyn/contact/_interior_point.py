"""Interior-point method for quadratic programs with second-order cones, and the derivative of the solution.

    minimise x^T Q x / 2 + q^T x    with    h_i - G_i x in K_i

for groups i of cones of one dimension: G_i (k, d, n), h_i (k, d). Numbers are of order one (`jaxdyn.contact.qp` scales them).

Mehrotra's predictor-corrector with Nesterov-Todd scaling; then Newton steps on the equations of the
projection, x, v: Q x + q + G^T z = 0, G x + s = h, s = P(v), z = s - v, which divide by no small numbers.
Each step is one kernel (`jaxdyn.compile`), and so are the start and the derivative; the loops are JAX's.
Source: Vandenberghe, The CVXOPT linear and quadratic cone program solvers (2010).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import any_sample, cond
from jaxdyn.contact import jordan
from jaxdyn.contact.jordan import dot, largest, map_groups, rows_times, transpose_times
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky

# Steps of Newton's method after the interior point; it converges quadratically, in two or three.
REFINEMENTS = 4
# Share of mu below which the square of the least eigenvalue of the scaled point counts as off the central path, and the centring
# then. In 600 programs near the apex all converge, in one or two steps more; in as many others no step changes.
_OFF_CENTRE, _MIN_CENTRING = 1e-2, 0.1
Pattern = tuple[bytes | None, ...]  # for each group, the mask of entries of G that may be nonzero; None for all


class Program(NamedTuple):
    """Data of a quadratic program: Q (n, n), q (n,), and for each group of cones G (k, d, n) and h (k, d)."""

    Q: Array
    q: Array
    G: tuple
    h: tuple


def _sparse(program: Program, pattern: Pattern) -> Program:
    """Insert known zeros, which the kernel then omits."""
    known = [None if y is None else np.frombuffer(y, bool) for y in pattern]
    G = [g if y is None else jnp.where(y.reshape(g.shape), g, 0) for g, y in zip(program.G, known, strict=True)]
    return program._replace(G=tuple(G))


class Point(NamedTuple):
    """Iterate: x (n,), slacks s and multipliers z, each (k, d) for each group."""

    x: Array
    s: tuple
    z: tuple


class End(NamedTuple):
    """Result: the last point, the number of steps, and flags of a solution and of infeasibility."""

    point: Point
    steps: Int[Array, ""]
    solved: Bool[Array, ""]
    infeasible: Bool[Array, ""]


def _residuals(program: Program, point: Point):
    """Residuals Q x + q + G^T z, and G x + s - h."""
    x, s, z = point
    stationary = matmul(program.Q, x) + program.q + transpose_times(program.G, z, x)
    return stationary, map_groups(lambda a, b, c: a + b - c, rows_times(program.G, x), s, program.h)


def _residuals_and_measure(program: Program, point: Point):
    """Residuals, and the larger of their maximum and the duality gap."""
    rx, rz = _residuals(program, point)
    return (rx, rz), jnp.maximum(largest((rx,), rz), _gap(point))


def _gap(point: Point):
    # The mean over the cones, each of degree one, as CVXOPT's mu.
    return dot(point.s, point.z, point.x[0]) / sum(y.shape[0] for y in point.s)


def _is_certificate(program: Program, point: Point, tol: float):
    """Decide whether z is a certificate of infeasibility: h.z < 0 with G^T z = 0, z in the cones.

    Up to rounding, it excludes every x below 1 / tol.
    """
    level = -dot(program.h, point.z, point.x[0])
    return (level > 0) & (jnp.max(jnp.abs(transpose_times(program.G, point.z, point.x))) < tol * level)


def _where(condition, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


@kernel(static=1)
def _start(pattern: Pattern, _, program: Program):
    """Initial point: least-squares slacks, shifted into the cones (as in CVXOPT), with residuals and error measure."""
    program = _sparse(program, pattern)
    Q, q, G, h = program
    rows = jnp.concatenate([g.reshape(-1, q.shape[0]) for g in G])
    level = jnp.concatenate([y.reshape(-1) for y in h])
    # x minimises x^T Q x / 2 + q^T x + |G x - h|^2 / 2.
    factor = cholesky(Q + matmul(rows.T, rows))
    x = solve_cholesky(factor, matmul(rows.T, level) - q)
    slack = map_groups(lambda a, b: b - a, rows_times(G, x), h)

    def inside(groups):
        minimum = jnp.min(jnp.stack([jnp.min(jordan.boundary_distance(v), initial=jnp.inf) for v in groups]))
        size = jnp.maximum(largest(groups), 1)
        # Far enough from the boundary that the first steps are not cut short.
        shift = jnp.where(minimum > 0.1 * size, 0, jnp.maximum(-minimum, 0) + size)
        return map_groups(lambda v: v + shift * jordan.identity(v), groups)

    # In the least-squares problem above the multipliers are z = G x - h, minus the slacks.
    point = Point(x, inside(slack), inside(map_groups(lambda v: -v, slack)))
    return point, *_residuals_and_measure(program, point)


def _newton(program: Program, s, z):
    """Scaled point lam, and a solver (dx, ds, dz) of the Newton equations for right-hand sides."""
    Q, _, G, _ = program
    # W z = W^-1 s: both scaled points coincide, which makes the Newton equations symmetric.
    W = map_groups(jordan.scaling, s, z)
    n = Q.shape[0]
    # W^-1 G once: both right-hand sides of the step use the same factor.
    scaled = map_groups(lambda w, g: jax.vmap(w.inverse_times, 2, 2)(g), W, G)
    rows = jnp.concatenate([g.reshape(-1, n) for g in scaled])
    factor = cholesky(Q + matmul(rows.T, rows))

    def solve(rx, rz, u, is_refined: bool = True):
        """Solve Q dx + G^T dz = -rx, G dx + ds = -rz, W dz + W^-1 ds = u; return also W^-1 ds and W dz."""
        right = map_groups(lambda w, r, y: w.inverse_times(r) + y, W, rz, u)
        dx = solve_cholesky(factor, -rx - transpose_times(scaled, right, rx))
        wdz = map_groups(lambda a, b: a + b, rows_times(scaled, dx), right)
        # The normal matrix squares the condition number; one step of refinement recovers the lost digits.
        if is_refined:
            more = solve_cholesky(factor, -rx - matmul(Q, dx) - transpose_times(scaled, wdz, rx))
            dx, wdz = dx + more, map_groups(lambda a, b: a + b, wdz, rows_times(scaled, more))
        wds = map_groups(lambda a, b: a - b, u, wdz)
        dz, ds = (map_groups(lambda w, y: w.inverse_times(y), W, wdz), map_groups(lambda w, y: w.times(y), W, wds))
        return dx, ds, dz, wds, wdz

    return map_groups(lambda w, y: w.times(y), W, z), solve


def _step(program: Program, point: Point, residuals) -> Point:
    """Take one predictor-corrector step."""
    _, s, z = point
    rx, rz = residuals
    # mu is the target of complementarity: s o z = mu e on the central path.
    mu = _gap(point)
    lam, solve = _newton(program, s, z)

    def inverse_step(wds, wdz):
        # s + t ds leaves its cone where W^-1 s + t W^-1 ds does, and z + t dz where W z + t W dz does: both from lam.
        return jnp.max(
            jnp.stack([jordan.inverse_boundary_step(v, dv) for v, dv in zip((*lam, *lam), (*wds, *wdz), strict=True)])
        )

    # The affine predictor needs no refinement: it only sets the centring parameter and the second-order term.
    *_, wds, wdz = solve(rx, rz, map_groups(lambda v: -v, lam), is_refined=False)
    # Mehrotra's heuristic: centre little where the affine step is long. Near the apex of a cone one eigenvalue of lam may run to
    # zero ahead of the others, a hundredth a step, until rounding ends the iteration: there some centring is kept.
    minimum = jnp.min(jnp.stack([jnp.min(jordan.boundary_distance(v)) for v in lam]))
    floor = jnp.where(minimum * minimum < _OFF_CENTRE * mu, _MIN_CENTRING, 0.0).astype(mu.dtype)
    centring = jnp.maximum((1 - 1 / jnp.maximum(inverse_step(wds, wdz), 1)) ** 3, floor)
    # Linearised complementarity with the second-order term (W^-1 ds) o (W dz) of the predictor.
    u = map_groups(
        lambda v, a, b: jordan.quotient(
            v, centring * mu * jordan.identity(v) - jordan.product(v, v) - jordan.product(a, b)
        ),
        lam,
        wds,
        wdz,
    )
    dx, ds, dz, wds, wdz = solve(rx, rz, u)
    # 0.99 keeps the iterate strictly inside, where the scaling exists.
    length = 1 / jnp.maximum(inverse_step(wds, wdz) / 0.99, 1)
    return jax.tree.map(lambda v, dv: v + length * dv, point, Point(dx, ds, dz))


class _State(NamedTuple):
    """State of the iteration: point, residuals, their measure, and flags.

    `infeasible`: a certificate was found; `alive`: the last step was accepted; `steps`: their number.
    """

    point: Point
    residuals: tuple
    error: Array
    infeasible: Bool[Array, ""]
    alive: Bool[Array, ""]
    steps: Array


def _is_running(state: _State, target: float):
    """Decide whether a sample is still iterating."""
    return (state.error > target) & ~state.infeasible & state.alive


@kernel(static=3)
def _iteration(pattern: Pattern, tol: float, target: float, _, program: Program, state: "_State") -> "_State":
    """Take the next step, and accept or reject it.

    A sample that has ended is kept unchanged, while others of its batch continue.
    """
    program = _sparse(program, pattern)
    point, residuals, error, infeasible, alive, steps = state
    going = _is_running(state, target)
    new = _step(program, point, residuals)
    inside = jnp.stack([jnp.all(jordan.boundary_distance(v) > 0) for v in (*new.s, *new.z)]).all()
    left, measure = _residuals_and_measure(program, new)
    # Close to convergence rounding can move a step out of the cones; its rejection ends the iteration.
    valid = inside & jnp.isfinite(measure)
    # Below the tolerance only improvements are accepted.
    taken = valid & ((error > tol) | (measure < error))
    point, residuals, error = _where(taken & going, (new, left, measure), (point, residuals, error))
    ended = infeasible | (going & valid & _is_certificate(program, new, tol))
    return _State(point, residuals, error, ended, alive & (taken | ~going), steps + going.astype(steps.dtype))


class _Refined(NamedTuple):
    """State of the refinement: current and best point, residual of the best one, and steps that may still fail to lower it."""

    point: Point
    best: Point
    error: Array
    credit: Array


def _is_refining(refined: _Refined):
    return (refined.credit > 0) & (refined.error > 4 * float(jnp.finfo(refined.error.dtype).eps))


@kernel(static=1)
def _refinement(pattern: Pattern, _, program: Program, state: _Refined) -> _Refined:
    """Take a Newton step on the equations of the projection.

    A sample at rounding level, or whose residual has not been lowered twice in a row, is kept unchanged.
    """
    program = _sparse(program, pattern)
    going, eps = _is_refining(state), float(jnp.finfo(state.error.dtype).eps)
    x, s, z = state.point
    # v = s - z determines both, s = P(v) and z = P(v) - v: complementarity holds by construction.
    v = map_groups(lambda a, b: a - b, s, z)

    def at(x, v):
        s = map_groups(jordan.projection, v)
        point = Point(x, s, map_groups(lambda a, b: a - b, s, v))
        rx, rz = _residuals(program, point)
        return point, rx, rz, largest((rx,), rz)

    # Interior points are not complementary; the projection makes them so, at the price of a residual.
    here, rx, rz, residual = at(x, v)
    D = tuple(jordan.projection_derivative(y, eps, 0.5) for y in v)
    dx, dv = _solve_projection_equations(program, D, -rx, map_groups(lambda r: -r, rz), 1)
    # A full step without line search. The equations are linear between kinks: from the wrong side of one the first step raises
    # the residual, and the second one is exact.
    there, *_, less = at(x + dx, map_groups(lambda a, b: a + b, v, dv))
    # A NaN residual compares false, so that it is rejected.
    is_here = ~(less < residual)
    new, minimum = _where(is_here, here, there), jnp.where(is_here, residual, less)
    better = (minimum < state.error) & going
    best, error = _where(better, (new, minimum), (state.best, state.error))
    # At rounding there is nothing to be gained by another attempt.
    spent = jnp.where(error > 1e3 * eps, 1, 2).astype(state.credit.dtype)
    credit = jnp.where(better, jnp.full_like(state.credit, 2), state.credit - spent)
    point = _where(going & jnp.isfinite(less), there, state.point)
    return _Refined(point, best, error, jnp.where(going, credit, state.credit))


def _solve_projection_equations(program: Program, D, right_x, right_s, corrections: int):
    """Solve for (dx, dv) with Q dx + G^T (D - 1) dv = right_x and G dx + D dv = right_s, D the projection's derivative.

    dv is eliminated with D + delta (1 - D) instead of D; corrections remove this change and rounding. Dependent active rows
    leave their multipliers undetermined; the corrections then select some, and dx does not
    depend on them.
    """
    Q, _, G, _ = program
    n = Q.shape[0]
    eps = float(jnp.finfo(Q.dtype).eps)
    # Between 0, where D may be singular, and 1; the square root of rounding leaves half of the digits to each side.
    delta = eps**0.5
    rest = tuple(d.map(lambda x: 1 - x) for d in D)
    inverse = tuple(d.map(lambda x: 1 / (x + delta * (1 - x))) for d in D)

    def times(derivatives, y):
        return map_groups(lambda d, x: d.times(x), derivatives, y)

    weighted = map_groups(lambda r, i, g: jax.vmap(lambda x: r.times(i.times(x)), 2, 2)(g), rest, inverse, G)
    rows, weighted = (jnp.concatenate([g.reshape(-1, n) for g in groups]) for groups in (G, weighted))
    normal = Q + matmul(rows.T, weighted)
    # A shift by rounding keeps the matrix positive definite.
    factor = cholesky(normal + jnp.diag(n * eps * jnp.diagonal(normal)))
    dx, dv = jnp.zeros_like(right_x), map_groups(jnp.zeros_like, right_s)
    # Iterative refinement with residuals of the unmodified equations.
    for _ in range(1 + corrections):
        rx = right_x - matmul(Q, dx) + transpose_times(G, times(rest, dv), dx)
        rs = map_groups(lambda r, a, b: r - a - b, right_s, rows_times(G, dx), times(D, dv))
        more = solve_cholesky(factor, rx + transpose_times(G, times(rest, times(inverse, rs)), dx))
        dv = map_groups(lambda a, b: a + b, dv, times(inverse, map_groups(lambda r, a: r - a, rs, rows_times(G, more))))
        dx = dx + more
    return dx, dv


def _end(pattern: Pattern, tol: float, _, program: Program, last: Point, error, refined: Point, less, infeasible):
    """Select the better point; return it with flags of a solution and of infeasibility."""
    # Multipliers of an infeasible program diverge, and are the certificate: they must not be refined.
    better = (less <= jnp.maximum(error, tol)) & ~infeasible
    point = _where(better, refined, last)
    solved = (jnp.where(better, less, error) <= tol) & ~infeasible
    # Diverging multipliers may stop before they are a certificate to full precision.
    return point, solved, infeasible | (~solved & _is_certificate(_sparse(program, pattern), point, tol**0.5))


def solve(program: Program, pattern: Pattern, tol: float, max_steps: int) -> End:
    """Solve a program: interior-point steps until residuals and gap are below `tol`, then refinement."""
    eps = float(jnp.finfo(program.q.dtype).eps)
    # Further steps are cheap for their gain in accuracy, so iterations continue below `tol` while they help.
    target = max(1e-3 * tol, 8 * eps)

    # The kernel itself keeps samples that have ended, so that the loop has one condition for the batch.
    def going(carry):
        state, count = carry
        return (count < max_steps) & any_sample(_is_running(state, target))

    def advance(carry):
        state, count = carry
        return _iteration(pattern, tol, target, None, program, state), count + 1

    point, residuals, error = _start(pattern, None, program)
    none = jnp.zeros((), bool)
    begin = _State(point, residuals, error, none, ~none, jnp.zeros((), program.q.dtype))
    state, _ = lax.while_loop(going, advance, (begin, 0))
    last, _, error, infeasible, _, steps = state

    # Newton's method reaches rounding in two or three steps, where interior-point scalings lose digits.
    def improving(carry):
        refined, count = carry
        return (count < REFINEMENTS) & any_sample(_is_refining(refined))

    def refine(carry):
        refined, count = carry
        return _refinement(pattern, None, program, refined), count + 1

    # The projection may raise the residual: the first refinement is accepted up to ten times the error, and `_end` selects.
    credit = jnp.where(infeasible, 0, 2).astype(error.dtype)
    begin_refined = _Refined(last, last, 10 * jnp.maximum(error, tol), credit)
    (_, refined, less, _), _ = lax.while_loop(improving, refine, (begin_refined, 0))
    rest = (program, last, error, refined, less, infeasible)
    point, solved, infeasible = kernel(_end, static=2)(pattern, tol, None, *rest)
    return End(point, steps.astype(jnp.int32), solved, infeasible)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def attach_derivative(pattern: Pattern, program: Program, point: Point) -> Point:
    """Attach to the solution `point` its derivative with respect to the program."""
    return point


@attach_derivative.defjvp
def _attach_derivative_jvp(pattern: Pattern, primals, tangents):
    program, point = primals
    # The recursion lets higher-order derivatives account for the motion of the point.
    point = attach_derivative(pattern, program, point)
    _, s, z = jax.lax.stop_gradient(point)
    width = jordan.width_of(point.x.dtype)
    kinks = [jnp.any(jordan.is_near_kink(a - b, width)) for a, b in zip(s, z, strict=True)]

    def tangent(at_kink: float):
        return _tangent(pattern, at_kink, None, program, point, tangents[0])

    def mean():
        # Of solutions, not of derivatives of the projection: in these the solution is not linear.
        return jax.tree.map(lambda a, b: (a + b) / 2, tangent(0.0), tangent(1.0))

    return point, cond(jnp.stack(kinks).any(), mean, lambda: tangent(0.0))


@kernel(static=2)
def _tangent(pattern: Pattern, at_kink: float, _, program: Program, point: Point, change: Program) -> Point:
    """Tangent of the solution for a tangent of the program, with kinks taken from one side."""
    # The pattern is static, so that the tangent of a known zero is zero too.
    program, change = _sparse(program, pattern), _sparse(change, pattern)
    x, s, z = point
    right_x = -matmul(change.Q, x) - change.q - transpose_times(change.G, z, x)
    right_s = map_groups(lambda a, b: b - a, rows_times(change.G, x), change.h)
    v, width = map_groups(lambda a, b: a - b, s, z), jordan.width_of(x.dtype)
    D = tuple(jordan.projection_derivative(y, width, at_kink) for y in v)
    dx, dv = _solve_projection_equations(program, D, right_x, right_s, 2)
    # From s = P(v) and z = s - v.
    ds = map_groups(lambda d, dy: d.times(dy), D, dv)
    return Point(dx, ds, map_groups(lambda a, b: a - b, ds, dv))
