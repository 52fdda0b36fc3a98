"""Functions whose derivatives are given by another computation than their values, and marks of samples without a value."""

import weakref
from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile import mode
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, function_of, is_zero, zero_tangent
from jaxdyn.compile.known import is_concrete, partition_tracers


def _define_flagged(name: str, **lowering) -> Any:
    """A primitive of flags and an array of their shape, which is linear in the array and acts entry by entry."""

    def batch(args, axes):
        size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
        full = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(args, axes, strict=True)
        ]
        return primitive.bind(*full), 0

    def jvp(primals, tangents):
        flag, x = primals
        step = tangents[1]
        return primitive.bind(flag, x), step if is_zero(step) else primitive.bind(flag, step)

    def transpose(cotangent, flag, x):
        return [None, cotangent if is_zero(cotangent) else primitive.bind(flag, cotangent)]

    primitive = define_primitive(
        name, lambda flag, x: ShapedArray(x.shape, x.dtype), batch=batch, jvp=jvp, transpose=transpose, **lowering
    )
    return primitive


def implicit(tree, args: tuple, solve: Callable, tangent: Callable):
    """solve(tree, *args), whose derivative is given by tangent(tree, *args, steps) -> (value, its change).

    Under `mode.values_of_rules` it is the value of the tangent's rule, which is all that a derivative needs.
    `steps` are those of the tree's leaves and of the args, None where nothing moves. Leaves with known values stay outside of
    the differentiated function: inside it they would be traced, and a recursion could not see their zeros any more.
    """
    if mode.has_values_of_rules():
        with mode.values_of_rules(False):  # rules within the rule are no part of the question
            return tangent(tree, *args, [None] * len(jax.tree.leaves((tree, args))))[0]
    unknown, known = partition_tracers(tree)

    # With symbolic zeros the rule sees which leaves do not change: a state's derivative computes none of the model's.
    @jax.custom_jvp
    def run(traced, *args):
        return _batch_first(solve(known(traced), *args))

    def rule(primals, tangents):
        traced, *args = primals
        zero = jax.custom_derivatives.SymbolicZero
        steps: list = [None] * known.structure.num_leaves
        for place, step in zip(known.places, tangents[0], strict=True):
            steps[place] = step
        steps = [None if isinstance(x, zero) else x for x in (*steps, *tangents[1:])]
        return _batch_first(tangent(known(traced), *args, steps))

    run.defjvp(rule, symbolic_zeros=True)
    return run(unknown, *args)


def _batch_first(tree):
    """The same arrays; in a batch, that is their leading axis.

    Where a loop was batched before it is differentiated, JAX takes the value of a rule for one with its batch where that of the
    function has it.
    """

    def first(x):
        shape = jnp.shape(x)
        if not shape or x.dtype == jax.dtypes.float0:
            return x
        # Two reshapes that cancel: their batching rule moves the axis of the batch to the front.
        return jnp.reshape(jnp.reshape(x, (1, *shape) if len(shape) == 1 else -1), shape)

    return jax.tree.map(first, tree)


def batch_alike(value, inputs):
    """The same arrays, with the batch axes of all inputs: results of a rule for derivatives and of its function agree in them.

    Where a function was batched before it is differentiated, JAX takes the axes of the function's results for those of the
    rule's, and a tangent may vary along more of them than the value.
    """
    entries = [jnp.ravel(x)[0] for x in jax.tree.leaves(inputs) if eqx.is_inexact_array(x) and x.size]

    def along(x):
        for entry in entries:
            x = lax.select(False, jnp.broadcast_to(entry.astype(x.dtype), x.shape), x)
        return x

    return jax.tree.map(along, value)


def value_and_jvp(function: Callable, args: tuple, steps):
    """function(*args), and its change for `steps` in the leaves of args, None where one does not move; None if none does."""
    base, structure = jax.tree.flatten(args)
    # Only leaves that change are arguments of `jax.jvp`: the others stay constants, whose zeros are seen.
    moving = [i for i, step in enumerate(steps) if step is not None]
    if not moving:
        return function(*args), None

    def at_values(*values):
        here = list(base)
        for i, value in zip(moving, values, strict=True):
            here[i] = value
        return function(*jax.tree.unflatten(structure, here))

    return jax.jvp(at_values, [base[i] for i in moving], [steps[i] for i in moving])


def change_along(function: Callable, point, moving, steps) -> Any:
    """The change of function(*point) for the `steps` of those of its arguments that are `moving`."""
    given = iter(steps)
    return value_and_jvp(function, tuple(point), [next(given) if varies else None for varies in moving])[1]


def invalidate_derivatives(values: Any, failed: Any, inputs: Any) -> Any:
    """The values, a pytree, with derivatives of NaN by all inputs where `failed`, in forward and reverse mode.

    Without it a failure would be a constant, whose derivative of zero leaves no trace in the gradient of a batch. Cotangents of
    zero remain zero, so that a loss may leave failed elements out. `failed` is one flag, or one for each leading index.
    """
    arrays, rest = eqx.partition(values, eqx.is_inexact_array)
    leaves = [x for x in jax.tree.leaves(eqx.filter(inputs, eqx.is_inexact_array)) if not is_concrete(x)]
    if leaves:
        arrays = _with_invalid_derivatives(arrays, jnp.asarray(failed), leaves)
    return eqx.combine(arrays, rest)


@jax.custom_jvp
def _with_invalid_derivatives(values, failed, leaves):
    return batch_alike(values, (values, failed.astype(float), leaves))


def _invalid_tangents(primals, tangents):
    values, failed, leaves = primals
    of_values, _, of_leaves = tangents
    zero = jax.custom_derivatives.SymbolicZero
    moving = [x for x in of_leaves if not isinstance(x, zero)]
    # One, with derivatives: those of higher order are NaN too, where those of a constant NaN would be zero.
    shifts = [x - jax.lax.stop_gradient(x) for x, dx in zip(leaves, of_leaves, strict=True) if not isinstance(dx, zero)]
    # Inputs of several dtypes, as of a scene in float32 whose coefficients are not, have no sum without a cast.
    one = jnp.exp(sum(jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0)).astype(float) for x in shifts))

    def add(value, tangent):
        tangent = jnp.zeros_like(value) if isinstance(tangent, zero) else tangent
        here = failed.reshape(failed.shape + (1,) * (value.ndim - failed.ndim))
        # At both ends, so that neither tangents nor cotangents that cancel in the sum hide the failure.
        terms = (jnp.sum(_nan_where(failed.any(), x * one.astype(x.dtype))).astype(value.dtype) for x in moving)
        return tangent + _nan_where(here, jnp.broadcast_to(sum(terms, jnp.zeros((), value.dtype)), value.shape))

    return _with_invalid_derivatives(*primals), jax.tree.map(
        add, values, of_values, is_leaf=lambda x: isinstance(x, zero)
    )


_with_invalid_derivatives.defjvp(_invalid_tangents, symbolic_zeros=True)


def _nan_where(failed, x):
    """A linear function of x: NaN where it has failed and x is not zero, else zero."""
    return _nan_where_p.bind(jnp.broadcast_to(failed, x.shape), x)


# No sum of products that JAX could transpose is zero for zeros and NaN for all other numbers.
_nan_where_p = _define_flagged(
    "jaxdyn_nan_where",
    implement=jax.jit(lambda failed, x: jnp.where(failed & (x != 0), jnp.nan, jnp.zeros_like(x))),
    lower=lambda failed, x: jnp.where(failed & (x != 0), jnp.nan, jnp.zeros_like(x)),
)


# --- values whose derivatives exist in one mode alone ---


def reverse_only(tree, message: str, *, first_order: bool = False):
    """The same values; forward mode through them raises ValueError with a message.

    JAX refuses forward mode through a function with a rule for reverse mode without saying what to do instead. A marked value
    passes reverse mode as it is. Its tangent is a primitive that reverse mode transposes away, and that cannot be computed.
    Forward mode over reverse mode is refused only if `first_order`: most rules for reverse mode have derivatives of their own.
    """
    if _mark_p is None:
        return tree
    of = {"message": message, "first_order": first_order}
    return jax.tree.map(lambda x: _mark_p.bind(x, **of) if hasattr(x, "dtype") and is_float(x) else x, tree)


def _refuse(*_, message: str) -> NoReturn:
    raise ValueError(message)


def _mark_jvp(primals, tangents, *, message: str, first_order: bool):
    (x,), (tangent,) = primals, tangents
    moved = tangent if is_zero(tangent) or _tangent_p is None else _tangent_p.bind(tangent, message=message)
    return _mark_p.bind(x, message=message, first_order=True) if first_order else x, moved


def _identity_jvp(bind: Callable, primals, tangents, **of):
    """The JVP rule of a linear primitive whose result is its operand."""
    (x,), (tangent,) = primals, tangents
    return bind(x, **of), tangent if is_zero(tangent) else bind(tangent, **of)


_mark_p = define_primitive(
    "jaxdyn_reverse_only",
    lambda x, **_: x,
    implement=lambda x, **_: x,
    lower=lambda x, **_: x,
    batch=lambda arrays, axes, **of: (_mark_p.bind(*arrays, **of), axes[0]),
    jvp=_mark_jvp,
)
_tangent_p = define_primitive(
    "jaxdyn_reverse_only_tangent",
    lambda x, message: x,
    implement=_refuse,
    lower=_refuse,
    batch=lambda arrays, axes, message: _refuse(message=message),
    jvp=lambda *given, **of: _identity_jvp(_tangent_p.bind, *given, **of),
    transpose=lambda cotangent, x, message: [cotangent],
)


def forward_only(tree, message: str):
    """The same values; reverse mode through them raises ValueError with a message.

    JAX refuses reverse mode through a `lax.while_loop` without saying what to do instead. The values that a loop returns are
    marked, since reverse mode meets its results first.
    """
    if _result_p is None:
        return tree
    return jax.tree.map(
        lambda x: _result_p.bind(x, message=message) if hasattr(x, "dtype") and is_float(x) else x, tree
    )


def _result_transpose(cotangent, x, *, message: str):
    return [cotangent] if is_zero(cotangent) else _refuse(message=message)


_result_p = define_primitive(
    "jaxdyn_forward_only",
    lambda x, **_: x,
    implement=lambda x, **_: x,
    lower=lambda x, **_: x,
    batch=lambda arrays, axes, **of: (_result_p.bind(*arrays, **of), axes[0]),
    jvp=lambda *given, **of: _identity_jvp(_result_p.bind, *given, **of),
    transpose=_result_transpose,
)


# --- samples that a kernel cannot compute: numbers that a function marks as not valid while it is traced ---
#
# A kernel has no branches. Where a fast formula fails for some samples, such as a Cholesky factor of rows that depend on each
# other, the function says so by `mark_invalid(flag, x)`, which is NaN where the flag is set. The program reports which samples
# are valid, and native code computes the others by the fallback (see `careful`). A program without marks reports nothing.


def mark_invalid(flag: jax.Array, x: jax.Array) -> jax.Array:
    """Mark a float array as not valid where the flag () is set; returns it with NaN there.

    Outside of kernels nothing is marked: x is returned as it is.
    """
    if not mode.is_expanding():
        return x
    return invalid_p.bind(jnp.broadcast_to(flag, x.shape), x)


def is_float(x) -> bool:
    """Decide whether an array is of floating-point numbers, which can be marked and differentiated."""
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


_marked: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # jaxprs that were looked through


def has_marks(jaxpr) -> bool:
    """Decide whether a jaxpr marks numbers as not valid, also within functions that it calls."""
    if jaxpr not in _marked:
        _marked[jaxpr] = any(map(_is_marking, jaxpr.eqns))
    return _marked[jaxpr]


def _is_marking(eqn) -> bool:
    if eqn.primitive.name == "jaxdyn_invalid" or getattr(eqn.params.get("program"), "careful", None) is not None:
        return True
    values = (x for value in eqn.params.values() for x in (value if isinstance(value, (tuple, list)) else (value,)))
    inner = (getattr(x, "jaxpr", x) for x in values)
    return any(hasattr(x, "eqns") and has_marks(x) for x in inner)


# A primitive, not a `jnp.where` with NaN: an expansion collects the flags of all marks by its name. It has no lowering, as it is
# bound while a program is traced, and nowhere else. Its tangent is NaN too: a derivative that was computed from the failed
# formula must not look like a number.
invalid_p = _define_flagged("jaxdyn_invalid")


def _batch_guard(args, axes, *, call, again):
    results = jax.vmap(function_of(call), axes)(*args)
    return results, [0] * len(results)


def _jvp_guard(primals, tangents, *, call, again):
    steps = [None if is_zero(x) else x for x in tangents]
    results, changes = value_and_jvp(function_of(call), tuple(primals), steps)
    assert changes is not None
    return results, [d if is_float(x) else zero_tangent(x) for x, d in zip(results, changes, strict=True)]


# A function `call`, whose samples that are marked as not valid are computed by `again` (see `trace.Again`). Its derivatives and
# batches are those of the function, whose marks reach the program around it then. It is bound while a program is traced.
guarded_p = define_primitive(
    "jaxdyn_guarded",
    lambda *types, call, again: list(call.out_avals),
    multiple_results=True,
    batch=_batch_guard,
    jvp=_jvp_guard,
)
