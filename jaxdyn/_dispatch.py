"""Which implementation a call runs on: the matrix form, the recursion or its loops, for the same answer.

The rule, measured by benchmarks/dynamics.py on CPU:

- forward dynamics of a known model of at most `MOST_BODIES` bodies, if it is none of the tiny ones below, and closed loops of
  one run in one kernel on CPU, whatever the batch, if there is one (see `_one_kernel`); what follows is for all the rest;
- batches of at least `LEAST_BATCH` samples of a mechanism with at most `MOST_BODIES` bodies run on the recursion, whose
  numbers become vectors over the batch;
- single samples and small batches run on the world-frame matrix form, whose program is short, unless there are many bodies;
- single bodies and mechanisms of at most `FEW_FREEDOMS` degrees of freedom run on the recursion in any batch: below `LEAST_BATCH`
  samples it is written into a few calls that compute some values again and again (see `_materialize`), which for them is
  little: 0.1 to 0.3 us a sample instead of 3 to 5;
- forward dynamics of more than `MOST_BODIES` bodies, in small batches of more than `MOST_IN_MATRICES`, and inverse dynamics of
  more than `MOST_IN_MASK`, run as loops over the bodies, whose program is as short and whose time grows with the number of
  bodies instead of its third power or its square; for few samples such a loop is one piece of machine code (see `_one_call`).

How large the batch is, is known only after every enclosing `jax.vmap` has been applied, which may be long after this code
has been traced (a `vmap` around a `jit` or around a loop). A primitive therefore stands for the question "is the batch this
large?"; its batching rule counts the samples, and what is left unbatched answers no when it is compiled. XLA removes the
branch that is not taken.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import Array

from jaxdyn import closed_recursion, looped, matrix_form, recursive
from jaxdyn._implicit import along, implicit
from jaxdyn._materialize import at_least
from jaxdyn._one_call import one_call
from jaxdyn._one_kernel import Kernel, kernel_of, kernel_or_vectors
from jaxdyn._scalar_program import is_written_out
from jaxdyn._tracing import is_one_sample, is_staged, still, traced_once
from jaxdyn._ways import way
from jaxdyn.model import Model

LEAST_BATCH = 256
FEW_FREEDOMS = 3
MOST_BODIES = 64
MOST_IN_MASK = 128
MOST_IN_MATRICES = 16

_large_batch_p = Primitive("large_batch")
_large_batch_p.def_impl(lambda *arrays, count, on_cpu: np.bool_(count >= LEAST_BATCH))
_large_batch_p.def_abstract_eval(lambda *avals, count, on_cpu: ShapedArray((), np.dtype(bool)))


def _answer(ctx, *arrays, count, on_cpu):
    return [mlir.ir_constant(np.bool_(count >= LEAST_BATCH))]


def _answer_on_cpu(ctx, *arrays, count, on_cpu):
    return [mlir.ir_constant(np.bool_(on_cpu or count >= LEAST_BATCH))]


mlir.register_lowering(_large_batch_p, _answer)
mlir.register_lowering(_large_batch_p, _answer_on_cpu, platform="cpu")


def _count_samples(arrays, axes, *, count, on_cpu):
    size = next(array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not batching.not_mapped)
    count *= size
    # Once the batch is large enough the answer is final and needs no further tracing.
    large = np.bool_(True) if count >= LEAST_BATCH else _large_batch_p.bind(*arrays, count=count, on_cpu=on_cpu)
    return large, batching.not_mapped


batching.primitive_batchers[_large_batch_p] = _count_samples


def is_large_batch(*trees, on_cpu: bool = False):
    """Whether the batch over which the trees vary has at least `LEAST_BATCH` samples: a bool, or a traced one that is known
    when the program is compiled. With `on_cpu`, also whether that is for CPU."""
    traced = [x for x in jax.tree.leaves(trees) if isinstance(x, jax.core.Tracer)]
    if not traced or is_written_out():
        return False
    if way() != "usual":  # those are for few samples on CPU
        return on_cpu
    large = _large_batch_p.bind(*[lax.stop_gradient(x) for x in traced], count=1, on_cpu=on_cpu)
    if is_one_sample() and isinstance(large, jax.core.Tracer):
        # What no batch encloses is not made large any more.
        return on_cpu and jax.default_backend() == "cpu"
    return large


def _is_tiny(model: Model) -> bool:
    return model.nb == 1 or model.nv <= FEW_FREEDOMS


def _choose(model: Model, recursion: Callable, matrices: Callable, *args):
    """`recursion(model, *args)` for large batches of mechanisms of moderate size, else `matrices(model, *args)`."""
    if model.nb > MOST_BODIES or model.nb == 0:
        return matrices(model, *args)
    large = True if _is_tiny(model) or is_written_out() else is_large_batch(model, *args[:3])

    def by_recursion():
        with at_least(LEAST_BATCH):
            return traced_once(recursion, model, *args)

    if isinstance(large, jax.core.Tracer):
        return lax.cond(large, by_recursion, lambda: traced_once(matrices, model, *args))
    return by_recursion() if large else matrices(model, *args)


def inverse_dynamics(model: Model, q: Array, v: Array, a: Array) -> Array:
    """tau = M a + C v + N, (nv,)."""
    if model.nb > MOST_IN_MASK:
        return _by_loops(looped.inverse_dynamics, model, q, v, a)
    return _choose(model, recursive.rnea, matrix_form.inverse_dynamics, q, v, a)


def bias_force(model: Model, q: Array, v: Array) -> Array:
    """h = C v + N, (nv,)."""
    if model.nb > MOST_IN_MASK:
        return _by_loops(_bias_by_loops, model, q, v)
    return _choose(model, recursive.bias_force, _bias_by_matrices, q, v)


def gravity_force(model: Model, q: Array) -> Array:
    """N, (nv,)."""
    if model.gravity is None:
        return jnp.zeros((model.nv,), model.home.dtype)
    return _choose(model, recursive.gravity_force, matrix_form.gravity_force, q)


def _by_loops(function: Callable, model: Model, *args):
    """function(model, *args), a loop over the bodies, in one call (see `_one_call`): each turn is a few small operations."""
    return one_call(partial(function, model), *args) if is_staged() else function(model, *args)


def _bias_by_loops(model, q, v):
    return looped.inverse_dynamics(model, q, v, None)


def _bias_by_matrices(model, q, v):
    return matrix_form.inverse_dynamics(model, q, v, None)


def mass_matrix(model: Model, q: Array) -> Array:
    """M(q), (nv, nv)."""
    return _choose(model, recursive.crba, matrix_form.mass_matrix, q)


def forward_dynamics(model: Model, q: Array, v: Array, tau: Array) -> Array:
    """a = M^-1 (tau - C v - N), (nv,), differentiated by the implicit function theorem and not through the algorithm."""

    def by_other_ways(model, *args):
        by_loops = partial(_by_loops, looped.forward_dynamics)
        if model.nb > MOST_BODIES:
            return by_loops(model, *args)
        return _choose(
            model, recursive.aba, by_loops if model.nb > MOST_IN_MATRICES else matrix_form.forward_dynamics, *args
        )

    def solve(model, *args):
        if not 0 < model.nb <= MOST_BODIES or _is_tiny(model) or not is_staged():
            return by_other_ways(model, *args)
        kernel = kernel_of(recursive.aba, model, *args)
        return by_other_ways(model, *args) if kernel is None else kernel(partial(by_other_ways, model), *args)

    def tangent(model, *args):
        if model.nb > MOST_BODIES:
            return _tangent_by_loops(model, *args)
        return _choose(model, _tangent_by_recursion, _tangent_by_matrices, *args)

    return implicit(model, (q, v, tau), solve, tangent)


def _tangent_by_recursion(model, q, v, tau, steps):
    change = _force_change(recursive.rnea, model, q, v, tau, steps)
    return recursive.aba_tangent(model, q, v, tau, change)


def _tangent_by_matrices(model, q, v, tau, steps):
    change = _force_change(matrix_form.inverse_dynamics, model, q, v, tau, steps)
    return matrix_form.forward_dynamics_tangent(model, q, v, tau, change)


def _tangent_by_loops(model, q, v, tau, steps):
    change = _force_change(looped.inverse_dynamics, model, q, v, tau, steps)
    return looped.forward_dynamics_tangent(model, q, v, tau, change)


def _force_change(inverse: Callable, model, q, v, tau, steps) -> Callable:
    """a -> dtau - dID(q, v, a) at fixed a."""
    *steps, tau_step = steps

    def change(a):
        total = jnp.zeros_like(tau) if tau_step is None else tau_step
        _, moved = along(lambda model, q, v: inverse(model, q, v, a), (model, q, v), steps)
        return total if moved is None else total - moved

    return change


def closed_dynamics(model: Model, loops, q: Array, v: Array, tau: Array) -> tuple[Array, Array, Array]:
    """`closed_recursion.closed_dynamics`, without derivatives; for large batches, or for any on CPU if there is a kernel."""
    tree, *state = still(((model, loops), q, v, tau))

    def by_recursion(*state):
        with at_least(LEAST_BATCH):
            return traced_once(_closed, tree, *state)

    kernel = closed_kernel(tree, *state)
    return by_recursion(*state) if kernel is None else kernel(by_recursion, *state)


def closed_kernel(tree, q: Array, v: Array, tau: Array) -> Kernel | None:
    """`closed_dynamics` of a pair (model, loops), in one kernel."""
    return kernel_or_vectors(_closed, tree, q, v, tau, long=tree[0].nb > MOST_BODIES)


def _closed(tree, q, v, tau):
    model, loops = tree
    return closed_recursion.closed_dynamics(model, loops, q, v, tau)


def with_derivatives(model: Model, loops, q: Array, v: Array, tau: Array, a: Array, lam: Array) -> tuple[Array, Array]:
    """(a, lam) that `closed_dynamics` has found, differentiated by the implicit function theorem."""

    def found(tree, q, v, tau, a, lam):
        return a, lam

    def tangent(tree, q, v, tau, a, lam, steps):
        model, loops = tree
        *steps, tau_step, _, _ = steps

        def change(a, lam):
            def needed(tree, q, v):
                model, loops = tree
                return closed_recursion.closed_inverse(model, loops, q, v, a, lam)

            _, moved = along(needed, (tree, q, v), steps)
            force, rate = (jnp.zeros_like(v), jnp.zeros_like(lam)) if moved is None else moved
            return (-force if tau_step is None else tau_step - force), -rate

        with at_least(LEAST_BATCH):
            return closed_recursion.closed_tangent(model, loops, q, v, tau, change)

    return implicit((model, loops), (q, v, tau, a, lam), found, tangent)
