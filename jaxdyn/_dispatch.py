"""Which implementation a call runs on: the matrix form or the recursion, for the same answer.

The rule, measured by benchmarks/dynamics.py on CPU:

- batches of at least `LEAST_BATCH` samples of a mechanism with at most `MOST_BODIES` bodies run on the recursion, whose
  numbers become vectors over the batch;
- single samples, small batches and larger mechanisms run on the world-frame matrix form, whose program is short.

How large the batch is, is known only after every enclosing `jax.vmap` has been applied, which may be long after this code
has been traced (a `vmap` around a `jit` or around a loop). A primitive therefore stands for the question "is the batch this
large?"; its batching rule counts the samples, and what is left unbatched answers no when it is compiled. XLA removes the
branch that is not taken.
"""

import functools
from collections.abc import Callable

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jaxdyn import matrix_form, recursive
from jaxdyn._materialize import at_least
from jaxdyn.model import Model

LEAST_BATCH = 256
MOST_BODIES = 64

_large_batch_p = Primitive("large_batch")
_large_batch_p.def_impl(lambda *arrays, count: np.bool_(count >= LEAST_BATCH))
_large_batch_p.def_abstract_eval(lambda *avals, count: ShapedArray((), np.dtype(bool)))
mlir.register_lowering(_large_batch_p, lambda ctx, *arrays, count: [mlir.ir_constant(np.bool_(count >= LEAST_BATCH))])


def _count_samples(arrays, axes, *, count):
    size = next(array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not batching.not_mapped)
    count *= size
    # Once the batch is large enough the answer is final and needs no further tracing.
    large = np.bool_(True) if count >= LEAST_BATCH else _large_batch_p.bind(*arrays, count=count)
    return large, batching.not_mapped


batching.primitive_batchers[_large_batch_p] = _count_samples


@functools.cache
def _traced_once(function: Callable) -> Callable:
    """`function` behind a `jit` of its own, so that a program which calls it many times traces it once per mechanism."""

    def run(least, *args):
        with at_least(least):
            return function(*args)

    return jax.jit(run, static_argnums=0)


def _choose(model: Model, recursion: Callable, matrices: Callable, *args):
    """`recursion(model, *args)` for large batches of mechanisms of moderate size, else `matrices(model, *args)`."""
    if model.nb > MOST_BODIES or model.nb == 0:
        return matrices(model, *args)
    traced = [x for x in jax.tree.leaves((model, *args[:3])) if isinstance(x, jax.core.Tracer)]
    large = _large_batch_p.bind(*[lax.stop_gradient(x) for x in traced], count=1) if traced else False
    # A mechanism whose numbers are known is traced in place: inside a jit of its own its zeros would be hidden.
    given = isinstance(model.home, jax.core.Tracer) and isinstance(model.screws, jax.core.Tracer)

    def recursion_from(least):
        if given:
            return _traced_once(recursion)(least, model, *args)
        with at_least(least):
            return recursion(model, *args)

    if isinstance(large, jax.core.Tracer):
        return lax.cond(large, lambda: recursion_from(LEAST_BATCH), lambda: matrices(model, *args))
    return recursion_from(1) if large else matrices(model, *args)


def inverse_dynamics(model: Model, q: Array, v: Array, a: Array) -> Array:
    """tau = M a + C v + N, (nv,)."""
    return _choose(model, recursive.rnea, matrix_form.inverse_dynamics, q, v, a)


def bias_force(model: Model, q: Array, v: Array) -> Array:
    """h = C v + N, (nv,)."""
    return _choose(model, recursive.bias_force, _bias_by_matrices, q, v)


def gravity_force(model: Model, q: Array) -> Array:
    """N, (nv,)."""
    if model.gravity is None:
        return jnp.zeros((model.nv,), model.home.dtype)
    return _choose(model, recursive.gravity_force, matrix_form.gravity_force, q)


def _bias_by_matrices(model, q, v):
    return matrix_form.inverse_dynamics(model, q, v, None)


def mass_matrix(model: Model, q: Array) -> Array:
    """M(q), (nv, nv)."""
    return _choose(model, recursive.crba, matrix_form.mass_matrix, q)


def forward_dynamics(model: Model, q: Array, v: Array, tau: Array) -> Array:
    """a = M^-1 (tau - C v - N), (nv,), differentiated by the implicit function theorem and not through the algorithm."""
    leaves, structure = jax.tree.flatten(model)
    # Leaves with known values stay outside the differentiated function: inside it they would be traced, and the
    # recursion could not see their zeros any more.
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.core.Tracer)]

    def rebuild(traced):
        full = list(leaves)
        for place, leaf in zip(places, traced, strict=True):
            full[place] = leaf
        return jax.tree.unflatten(structure, full)

    @jax.custom_jvp
    def solve(traced, q, v, tau):
        return _choose(rebuild(traced), recursive.aba, matrix_form.forward_dynamics, q, v, tau)

    def rule(primals, tangents):
        traced, q, v, tau = primals
        zero = jax.custom_derivatives.SymbolicZero
        steps = [None] * len(leaves)
        for place, step in zip(places, tangents[0], strict=True):
            steps[place] = step
        steps = [None if isinstance(step, zero) else step for step in (*steps, *tangents[1:])]
        return _choose(rebuild(traced), _tangent_by_recursion, _tangent_by_matrices, q, v, tau, steps)

    solve.defjvp(rule, symbolic_zeros=True)
    return solve([leaves[i] for i in places], q, v, tau)


def _tangent_by_recursion(model, q, v, tau, steps):
    change = _force_change(recursive.rnea, model, q, v, tau, steps)
    return recursive.aba_tangent(model, q, v, tau, change)


def _tangent_by_matrices(model, q, v, tau, steps):
    change = _force_change(matrix_form.inverse_dynamics, model, q, v, tau, steps)
    return matrix_form.forward_dynamics_tangent(model, q, v, tau, change)


def _force_change(inverse: Callable, model, q, v, tau, steps) -> Callable:
    """a -> dtau - dID(q, v, a) at fixed a, for `steps` in the model's leaves, q, v and tau; None where nothing moves."""
    leaves, structure = jax.tree.flatten(model)
    *steps, tau_step = steps
    base = [*leaves, q, v]
    moving = [i for i, step in enumerate(steps) if step is not None]

    def change(a):
        total = jnp.zeros_like(tau) if tau_step is None else tau_step
        if not moving:
            return total

        def along(*values):
            here = list(base)
            for i, value in zip(moving, values, strict=True):
                here[i] = value
            return inverse(jax.tree.unflatten(structure, here[:-2]), here[-2], here[-1], a)

        return total - jax.jvp(along, [base[i] for i in moving], [steps[i] for i in moving])[1]

    return change
