"""Optimal control of any step by iterated linear-quadratic regulators, and by differential dynamic programming, within limits.

One iteration expands cost and step about a trajectory, V(x) ~ V + Vx dx + dx.Vxx dx / 2 backwards in time,

    Qz = lz + F^T Vx,   Qzz = lzz + F^T Vxx F (+ Vx . d2f/dz2),   z = (x, u),  F = df/dz,
    k = argmin k.(Quu + mu) k / 2 + Qu.k within the limits,   K = -(Quu + mu)^-1 Qux for controls that are at none,

and takes the step u + alpha k + K (x - x_before) with the longest alpha that reduces the cost.

Sources: Li & Todorov (2004); Tassa, Erez & Todorov (2012), Synthesis and stabilization of complex behaviors through online
trajectory optimization, section II (value update, schedule of mu, line search); Tassa, Mansard & Todorov (2014) for limits.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from jaxdyn.compile import batch
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.codes import RESULTS, Outcome
from jaxdyn.constraints.rank import eps_of
from jaxdyn.contact.qp import minimize_in_box
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import (
    Checked,
    Function,
    Numbers,
    as_array,
    as_float,
    as_number,
    as_static,
    batch_hint,
    check_count,
    check_flag,
)
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky
from jaxdyn.systems.scene import as_pytree

# Eleven lengths from 1 to 1e-3. They and the schedule of mu are those of the program iLQG of Tassa, Erez & Todorov (2012).
_LENGTHS = tuple(10.0 ** (-3 * i / 10) for i in range(11))
_MIN_PART = 1e-4  # of the reduction that the expansion predicts
_LARGEST_PART = 1e2  # of `tol`, that a step may predict which brings less than `tol`
_FACTOR, _MIN_DAMPING, _LARGEST_DAMPING = 1.6, 1e-6, 1e10
_RUNNING, _CONVERGED, _NO_DESCENT, _NOT_FINITE = range(4)


class OptimalControl(Outcome):
    """A trajectory, the feedback along it, and how it was found.

    - `us` (n, nu); `xs`: states, each leaf with n + 1 rows; `cost` ().
    - `gains` (n, nu, nx): $u = u_k + K_k (x - x_k)$, of the states as vectors, leaf after leaf.
    - `costs` (iterations + 1,): after each iteration, the last one repeated. `iterations` (): how many were made.
    - `regularization` (): mu at the end, for a warm start. `reduction` (): what a further step is predicted to bring.
    - `result`: one of `RESULTS`. `nonlinear_max_steps_reached`: it had not converged after all iterations; `no_descent`: no
      step reduces the cost, not even in the direction of the gradient; `nonfinite`: cost or step are not finite at the start.
    """

    us: Float[Array, "n nu"]
    xs: Any
    gains: Float[Array, "n nu nx"]
    cost: Float[Array, ""]
    costs: Float[Array, " iterations"]
    iterations: Int[Array, ""]
    regularization: Float[Array, ""]
    reduction: Float[Array, ""]
    result: Any

    def shift(self) -> "OptimalControl":
        """The plan from its second step on, its last control and gain repeated: where the next one begins."""
        us, xs, gains = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), (self.us, self.xs, self.gains))
        return dataclasses.replace(self, us=us, xs=xs, gains=gains)


class _Problem(NamedTuple):
    """Functions of vectors: step(x, u) (nx,), cost(x, u, k) and final(x) (), and limits (n, nu) or None."""

    step: Callable
    cost: Callable
    final: Callable
    lower: Array | None
    upper: Array | None
    second_order: bool


class _State(NamedTuple):
    xs: Array
    us: Array
    gains: Array
    cost: Array
    costs: Array
    damping: Array
    factor: Array
    iterations: Array
    reduction: Array
    code: Array


def ilqr(
    step: Function,
    cost: Function,
    final_cost: Function,
    x0: PyTree,
    us: Checked[Numbers | OptimalControl],
    *,
    limits: Checked[Sequence[Numbers] | None] = None,
    iterations: int = 100,
    tol: float = 1e-9,
    regularization: Numbers = 0.0,
    second_order: bool = False,
) -> OptimalControl:
    r"""Controls that minimise a sum of costs along a trajectory, from a guess.

    $$\min_u \sum_k \mathrm{cost}(x_k, u_k, k) + \mathrm{final\_cost}(x_n), \quad x_{k+1} = \mathrm{step}(x_k, u_k)$$

    One sample; a batch by `jax.vmap` over x0, us, and what the functions hold. Derivatives of the step are those of reverse mode,
    of all steps at once; `jd.stepper` has them as native kernels. It is not differentiable itself.

    **Arguments:**

    - `step(x, u)`: the next state, as of `jd.stepper`; states are arrays or pytrees of them, such as (q, v).
    - `cost(x, u, k)`, `final_cost(x)`: numbers, twice differentiable; k counts the steps.
    - `x0`: the initial state. `us` (n, nu): the guess; or a plan, for a warm start, whose feedback is followed from x0 on:
      `plan.shift()` of the last problem.
    - `limits`: (lower, upper), each a number, (nu,) or (n, nu); None: none.
    - `iterations`: at most. `tol`: converged where an undamped step is predicted to reduce the cost by less than this part, or a
      full one does.
    - `regularization`: mu of the first iteration.
    - `second_order`: whether to keep the second derivatives of the step (DDP): fewer iterations near the solution, each of
      which takes longer.

    **Returns:** `OptimalControl`.

    **Raises:** ValueError for functions that cannot be called so, or whose results do not fit, for us of another shape, limits
    that cross, and counts that are not positive.

    Source: Tassa, Erez & Todorov (2012), section II; Tassa, Mansard & Todorov (2014).

    ```python
    plan = jd.control.ilqr(
        lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]]),
        lambda x, u, k: 0.01 * u @ u,
        lambda x: x @ x,
        jnp.array([1.0, 0.0]),
        jnp.zeros((20, 1)),
        limits=(-1.0, 1.0),
    )
    ```
    """
    plan = us if isinstance(us, OptimalControl) else None
    us = as_float(us if plan is None else plan.us, "us")
    if us.ndim != 2 or 0 in us.shape:
        raise ValueError(f"us has shape {us.shape}; give controls (n, nu), one row per step{batch_hint(us, (1, 1))}")
    check_count(iterations, "iterations")
    as_static(tol, "tol", np.finfo(float).tiny, 1, "a number between 0 and 1")
    mu = as_number(regularization, "regularization", zero=True, like=us.dtype)
    step, cost, final_cost = (
        as_pytree(f, name, takes)
        for f, name, takes in ((step, "step", "x, u"), (cost, "cost", "x, u, k"), (final_cost, "final_cost", "x"))
    )
    x0 = jax.tree.map(lambda x: jnp.asarray(as_array(x, "x0"), us.dtype), x0)
    # States are vectors inside, so that one expansion is valid for every pytree of states.
    flat, structure = ravel_pytree(x0)
    # Before the loop is traced, so that an error names the function.
    _check_functions(step, cost, final_cost, x0, us)
    lower, upper = _limits(limits, us)
    problem = _Problem(
        lambda x, u: ravel_pytree(step(structure(x), u))[0],
        lambda x, u, k: jnp.asarray(cost(structure(x), u, k), us.dtype),
        lambda x: jnp.asarray(final_cost(structure(x)), us.dtype),
        lower,
        upper,
        check_flag(second_order, "second_order"),
    )
    n, nu = us.shape
    # With zero gains the reference states do not count: the first rollout applies the controls alone.
    xs, gains = jnp.broadcast_to(flat, (n, flat.size)), jnp.zeros((n, nu, flat.size), us.dtype)
    if plan is not None:
        if plan.gains.shape != gains.shape:
            raise ValueError(f"us is a plan with gains {plan.gains.shape}, expected {gains.shape} for this x0")
        # The last state is left out, because no control follows it.
        xs, gains = jax.vmap(lambda x: ravel_pytree(x)[0])(plan.xs)[:-1], plan.gains
    state = _solve(problem, flat, xs, us, gains, mu, iterations, float(tol))
    codes: Any = RESULTS
    result = codes.where(state.code == _RUNNING, codes.nonlinear_max_steps_reached, codes.successful)
    result = codes.where(state.code == _NO_DESCENT, codes.no_descent, result)
    result = codes.where(state.code == _NOT_FINITE, codes.nonfinite, result)
    return OptimalControl(
        state.us,
        jax.vmap(structure)(state.xs),
        state.gains,
        state.cost,
        state.costs,
        state.iterations,
        state.damping,
        state.reduction,
        result,
    )


def _check_functions(step, cost, final_cost, x0, us) -> None:
    """Refuse functions whose results are none of a step and of costs."""
    u, k = us[0], jnp.zeros((), jnp.int32)
    # Shapes alone are needed: nothing is computed or compiled.
    after = jax.eval_shape(step, x0, u)
    if jax.tree.structure(after) != jax.tree.structure(x0):
        raise ValueError(f"step returned {jax.tree.structure(after)}, expected {jax.tree.structure(x0)} as of x0")
    shapes = [(a.shape, b.shape) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(x0), strict=True)]
    if any(a != b for a, b in shapes):
        raise ValueError(f"step returned shapes {[a for a, _ in shapes]}, expected {[b for _, b in shapes]} as of x0")
    for name, value in (("cost", jax.eval_shape(cost, x0, u, k)), ("final_cost", jax.eval_shape(final_cost, x0))):
        if getattr(value, "shape", None) != ():
            raise ValueError(f"{name} returned shape {getattr(value, 'shape', value)}; return one number, ()")


def _limits(limits, us):
    if limits is None:
        return None, None
    if not isinstance(limits, (tuple, list)) or len(limits) != 2:
        raise ValueError(f"limits is {limits!r}; give a pair (lower, upper), or None")
    both = [as_array(limit, "limits", us.dtype) for limit in limits]
    for limit in both:
        if limit.shape not in ((), us.shape[1:], us.shape):
            raise ValueError(f"limits has shape {limit.shape}; give numbers, {us.shape[1:]} or {us.shape}")
    if is_concrete(both) and not (np.asarray(both[0]) < np.asarray(both[1])).all():
        raise ValueError(f"limits is {limits!r}; every lower limit has to be below the upper one")
    return jnp.broadcast_to(both[0], us.shape), jnp.broadcast_to(both[1], us.shape)


def _clip(problem: _Problem, us, k: Any = slice(None)):
    if problem.lower is None or problem.upper is None:
        return us
    return jnp.clip(us, problem.lower[k], problem.upper[k])


def _solve(problem: _Problem, x0, xs, us, gains, damping, iterations: int, tol: float) -> _State:
    xs, us, cost = _rollout(problem, x0, xs, us, jnp.zeros_like(us), gains)
    # Filled up with the last cost, so that the shape does not depend on the number of iterations made.
    costs = jnp.broadcast_to(cost, (iterations + 1,))
    one, none = jnp.ones((), us.dtype), jnp.zeros((), jnp.int32)
    # No step reduces a cost of NaN or infinity: the loop does not begin.
    code = jnp.where(jnp.isfinite(cost), _RUNNING, _NOT_FINITE).astype(jnp.int32)
    state = _State(xs, us, gains, cost, costs, damping, one, none, jnp.full_like(cost, jnp.inf), code)

    def is_running(state: _State):
        return (state.code == _RUNNING) & (state.iterations < iterations)

    return lax.while_loop(is_running, lambda state: _iterate(problem, state, tol), state)


def _iterate(problem: _Problem, state: _State, tol: float) -> _State:
    k, K, gradient, curvature, is_definite = _backward(problem, state)
    # The change of the cost for alpha = 1 with its sign reversed: positive where a full step is expected to reduce it.
    predicted = -(gradient + curvature)
    # What is left of a cost that goes to zero is rounding of the first one.
    size = jnp.maximum(jnp.abs(state.cost), eps_of(state.cost) * jnp.abs(state.costs[0]))
    # With large damping a small step is no sign of a minimum; 1e-5 is the bound of iLQG.
    is_damped_little = state.damping <= 1e-5
    is_small = is_definite & (predicted <= tol * size) & is_damped_little

    def try_length(carry):
        _, count = carry
        alpha = jnp.asarray(_LENGTHS, k.dtype)[count]
        xs, us, cost = _rollout(problem, state.xs[0], state.xs[:-1], state.us, alpha * k, K)
        enough = state.cost - cost >= -_MIN_PART * alpha * (gradient + alpha * curvature)
        # A cost of NaN compares false, so that the next length is tried.
        return (xs, us, cost, enough & (cost < state.cost)), count + 1

    def is_running(carry):
        # Without a definite Quu the gains are NaN: there is no rollout, and the damping grows.
        return ~carry[0][3] & (carry[1] < len(_LENGTHS)) & is_definite & ~is_small

    before = state.xs, state.us, state.cost, jnp.asarray(False)
    (xs, us, cost, falls), count = lax.while_loop(is_running, try_length, (before, jnp.zeros((), jnp.int32)))
    xs, us, cost = (jnp.where(falls, x, y) for x, y in zip((xs, us, cost), before[:3], strict=True))

    # Repeated successes or failures change mu ever faster (Tassa, Erez & Todorov 2012, section II).
    ratio = jnp.where(
        falls, jnp.minimum(state.factor / _FACTOR, 1 / _FACTOR), jnp.maximum(state.factor * _FACTOR, _FACTOR)
    )
    # Below its least value mu is exactly zero, so that steps close to the minimum are undamped.
    less = jnp.where(state.damping * ratio > _MIN_DAMPING, state.damping * ratio, jnp.zeros_like(ratio))
    damping = jnp.where(falls, less, jnp.maximum(state.damping * ratio, _MIN_DAMPING))
    # A small reduction is a sign of a minimum only if it is that of a full step, little damped, from which little was expected.
    is_full = (count == 1) & is_damped_little & (predicted <= _LARGEST_PART * tol * size)
    converged = is_small | (falls & is_full & (state.cost - cost <= tol * size))
    code = jnp.where(converged, _CONVERGED, jnp.where(damping > _LARGEST_DAMPING, _NO_DESCENT, _RUNNING))
    # An indefinite pass has gains of NaN: those of the pass before remain.
    kept = is_definite
    return _State(
        xs,
        us,
        jnp.where(kept, K, state.gains),
        cost,
        jnp.where(jnp.arange(state.costs.size, dtype=jnp.int32) > state.iterations, cost, state.costs),
        jnp.where(is_small, state.damping, damping),
        ratio,
        state.iterations + 1,
        jnp.where(kept, predicted, state.reduction),
        code.astype(jnp.int32),
    )


def _rollout(problem: _Problem, x0, xs, us, k, K):
    """States (n + 1, nx), controls (n, nu) and cost of u + k + K (x - xs) within the limits."""
    count = jnp.arange(us.shape[0], dtype=jnp.int32)

    def step_forward(carry, row):
        x, total = carry
        x_before, u, k, K, i = row
        # Clipped after the feedback: k keeps to the limits, and K (x - xs) need not.
        u = _clip(problem, u + k + matmul(K, x - x_before), i)
        return (problem.step(x, u), total + problem.cost(x, u, i)), (x, u)

    start = x0, jnp.zeros((), us.dtype)
    (last, total), (states, controls) = lax.scan(step_forward, start, (xs, us, k, K, count))
    return jnp.concatenate([states, last[None]]), controls, total + problem.final(last)


def _backward(problem: _Problem, state: _State):
    """k (n, nu), K (n, nu, nx), the predicted change of the cost a gradient + a^2 curvature, and whether every Quu
    is positive definite.
    """
    xs, us = state.xs, state.us
    n, nu = us.shape
    nx = xs.shape[1]
    Z, count = jnp.concatenate([xs[:-1], us], 1), jnp.arange(n, dtype=jnp.int32)

    def step(z):
        return problem.step(z[:nx], z[nx:])

    def cost(z, i):
        return problem.cost(z[:nx], z[nx:], i)

    # Derivatives do not depend on V: they are computed for all steps at once, and not within the backward scan.
    F, lz, lzz = batch.each_row(
        lambda z, i: (jax.jacrev(step)(z), jax.grad(cost)(z, i), jax.hessian(cost)(z, i)), Z, count
    )
    none = jnp.zeros((), us.dtype)

    def step_backward(carry, row):
        Vx, Vxx, gradient, curvature, is_definite = carry
        z, F, lz, lzz, i = row
        Qz = lz + matmul(F.T, Vx)
        Qzz = lzz + matmul(F.T, matmul(Vxx, F))
        if problem.second_order:
            # The Hessian of the scalar Vx . f: the tensor of second derivatives of the step is never formed.
            Qzz = Qzz + jax.hessian(lambda z: jnp.sum(Vx * step(z)))(z)
        Qu, Quu, Qux = Qz[nx:], Qzz[nx:, nx:], Qzz[nx:, :nx]
        # Only the gains use the damped matrix.
        damped = 0.5 * (Quu + Quu.T) + state.damping * jnp.eye(nu, dtype=Quu.dtype)
        if problem.lower is None or problem.upper is None:
            factor = cholesky(damped)
            k, K = -solve_cholesky(factor, Qu), -solve_cholesky(factor, Qux)
        else:
            u = z[nx:]
            k, free, factor, found = minimize_in_box(damped, Qu, problem.lower[i] - u, problem.upper[i] - u)
            # A search that gave up is no step: like an indefinite matrix it makes the damping grow.
            is_definite = is_definite & found
            # A control at a limit has no feedback: its row of the gain is zero.
            K = -solve_cholesky(factor, jnp.where(free[:, None], Qux, jnp.zeros_like(Qux)))
        # The Cholesky factor of an indefinite matrix is NaN.
        definite = is_definite & jnp.isfinite(factor).all() & jnp.isfinite(k).all()
        # The undamped Quu: this update of V is exact for any k and K, also damped ones (Tassa, Erez & Todorov 2012, section II).
        Quuk = matmul(Quu, k)
        Vx = Qz[:nx] + matmul(K.T, Quuk + Qu) + matmul(Qux.T, k)
        crossed = matmul(K.T, Qux)
        Vxx = Qzz[:nx, :nx] + matmul(K.T, matmul(Quu, K)) + crossed + crossed.T
        gradient, curvature = gradient + jnp.sum(k * Qu), curvature + 0.5 * jnp.sum(k * Quuk)
        # Symmetrised at each step, so that the unsymmetric part of rounding does not grow.
        return (Vx, 0.5 * (Vxx + Vxx.T), gradient, curvature, definite), (k, K)

    final = jax.grad(problem.final)(xs[-1]), jax.hessian(problem.final)(xs[-1])
    carry, (k, K) = lax.scan(
        step_backward, (*final, none, none, jnp.asarray(True)), (Z, F, lz, lzz, count), reverse=True
    )
    _, _, gradient, curvature, is_definite = carry
    return k, K, gradient, curvature, is_definite
