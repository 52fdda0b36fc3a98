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

from collections.abc import Callable

import jax
import jax.core
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jaxdyn import matrix_form, recursive
from jaxdyn._materialize import at_least
from jaxdyn.model import Model

LEAST_BATCH = 32
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


def _choose(model: Model, arrays, recursion: Callable, matrices: Callable):
    """`recursion()` for large batches of mechanisms of moderate size, else `matrices()`."""
    if model.nb > MOST_BODIES or model.nb == 0:
        return matrices()
    traced = [x for x in (*jax.tree.leaves(model), *arrays) if isinstance(x, jax.core.Tracer)]
    large = _large_batch_p.bind(*[lax.stop_gradient(x) for x in traced], count=1) if traced else False
    if not isinstance(large, jax.core.Tracer):
        return recursion() if large else matrices()

    def recursion_if_large():
        with at_least(LEAST_BATCH):
            return recursion()

    return lax.cond(large, recursion_if_large, matrices)


def inverse_dynamics(model: Model, q: Array, v: Array, a: Array) -> Array:
    """tau = M a + C v + N, (nv,)."""
    return _choose(
        model,
        (q, v, a),
        lambda: recursive.rnea(model, q, v, a),
        lambda: matrix_form.inverse_dynamics(model, q, v, a),
    )


def bias_force(model: Model, q: Array, v: Array) -> Array:
    """h = C v + N, (nv,)."""
    return _choose(
        model,
        (q, v),
        lambda: recursive.bias_force(model, q, v),
        lambda: matrix_form.inverse_dynamics(model, q, v, None),
    )


def mass_matrix(model: Model, q: Array) -> Array:
    """M(q), (nv, nv)."""
    return _choose(model, (q,), lambda: recursive.crba(model, q), lambda: matrix_form.mass_matrix(model, q))


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
        here = rebuild(traced)
        return _choose(
            here,
            (q, v, tau),
            lambda: recursive.aba(here, q, v, tau),
            lambda: matrix_form.forward_dynamics(here, q, v, tau),
        )

    def rule(primals, tangents):
        traced, q, v, tau = primals
        here = rebuild(traced)

        def force_change(inverse):
            """dtau - dID(q, v, a) at fixed a, along the tangents that are not structurally zero."""

            def change(a):
                live = [not isinstance(x, jax.custom_derivatives.SymbolicZero) for x in (*tangents[0], *tangents[1:3])]
                base = [*traced, q, v]
                total = tangents[3]
                if isinstance(total, jax.custom_derivatives.SymbolicZero):
                    total = np.zeros(tau.shape, tau.dtype)
                if any(live):

                    def along(*moving):
                        numbers = iter(moving)
                        full = [next(numbers) if alive else x for alive, x in zip(live, base, strict=True)]
                        return inverse(rebuild(full[:-2]), full[-2], full[-1], a)

                    start = [x for alive, x in zip(live, base, strict=True) if alive]
                    step = [x for alive, x in zip(live, (*tangents[0], *tangents[1:3]), strict=True) if alive]
                    total = total - jax.jvp(along, start, step)[1]
                return total

            return change

        return _choose(
            here,
            (q, v, tau),
            lambda: recursive.aba_tangent(here, q, v, tau, force_change(recursive.rnea)),
            lambda: matrix_form.forward_dynamics_tangent(here, q, v, tau, force_change(matrix_form.inverse_dynamics)),
        )

    solve.defjvp(rule, symbolic_zeros=True)
    return solve([leaves[i] for i in places], q, v, tau)
