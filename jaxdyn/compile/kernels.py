"""Functions of one sample as kernels: the decorator `kernel`, and `evaluate` for numbers that are known.

A call traces the function once, and calls its program through the primitive (see `trace` and `primitive`). This module decides
what a call means: the kernel, its fallback, or, inside another kernel, the function itself.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import jax_adapter, mode
from jaxdyn.compile.derive import without_unread
from jaxdyn.compile.flags import is_float, mark_invalid
from jaxdyn.compile.known import is_known, partition, partition_tracers
from jaxdyn.compile.messages import say_without_kernel
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.repair import compute_where, rank_safe, repair
from jaxdyn.compile.trace import flat_function, inline_call, name_of, program_of, trace_program


def kernel(
    function: Callable | None = None,
    *,
    static: int = 0,
    fallback: Callable | None = None,
    derivative: Callable | str | bool | None = None,
) -> Any:
    """Compute a function of one sample by a native kernel; a decorator.

    The function is pure, written with arrays, and called as `function(*static, tree, *args)`: first as many hashable arguments
    as `static` says, then a pytree whose known leaves are compiled in (a model that is closed over), then pytrees of arrays.
    Batches come from `jax.vmap`, derivatives from JAX. Inside another kernel the function is inlined, and under
    `compilation("plain")` it is the function itself, or its fallback.

    **Arguments:**

    - `fallback(*static, tree, *args)`: computes the same where there is no kernel, and those samples that the function marks
      by `mark_invalid`. Default: the function itself, by operations of JAX. It depends on nothing traced but its arguments.
    - `derivative`: None for the derivative of the function's numbers; False for functions that are never differentiated, in
      which long functions under `jax.jit` are compiled once and called, and `lax.cond` is a branch; "program" for a function that
      stays a program of its own, with the derivative of its numbers, inside another kernel too; or a rule
      `derivative(*static, tree, *args, steps)` that returns the change of the results for the `steps` of the leaves of tree and
      args (None for a leaf that does not change), where that is cheaper.

    The kernel takes one argument more, `where`: a bool () that says whether the sample's results are needed. A sample that is
    not valid and not needed is not computed again.

    **Raises:** whatever the function raises while it is traced.
    """
    if function is None:
        return functools.partial(kernel, static=static, fallback=fallback, derivative=derivative)
    rule = derivative if callable(derivative) else None

    @functools.wraps(function)
    def call(*args, where=None):
        given = args[:static], args[static], args[static + 1 :]
        if mode.is_expanding() and mode.is_careful() and fallback is not None:
            # The program that is traced is the fallback of another one, so that it has no marks of its own.
            return fallback(*args)
        # Code without JAX is one program: others are kept by keys that do not know what they may call.
        if derivative == "program" and not mode.is_standalone():
            return _call_own_program(function, *given)
        if mode.is_expanding():
            return inline_call(function, *given)
        return _call(function, *given, fallback, rule, derivative is not False, where)

    return call


def _call(function, static, tree, args, fallback, rule, is_differentiated: bool, where):
    # Derivatives of a subprogram's call would be those of its numbers, written out: calls pay where nobody differentiates.
    results = _by_kernel(function, static, tree, args, fallback, tangent=rule, calls=not is_differentiated)
    again = function if fallback is None else fallback
    if results is None:
        return again(*static, tree, *args)
    values, valid = results
    if valid is True:
        return values
    traced, known = partition_tracers(tree)
    leaves, structure = jax.tree.flatten(args)
    given, careful = (*traced, *leaves), flat_function(again, static, known, len(traced), structure)
    if not is_differentiated:
        valid = valid if where is None else valid | ~where
        return compute_where(jnp.logical_not(valid), careful, values, given)

    def fast(*given):
        args = jax.tree.unflatten(structure, given[len(traced) :])
        results = _by_kernel(function, static, known(given[: len(traced)]), args, fallback, tangent=rule)
        assert results is not None, "the function that was a kernel for the values is none for the derivative"
        return _split_floats(results[0])[0]

    # In reverse mode JAX stores the residuals of a branch whether it is taken or not. This one hardly ever is, so that its
    # intermediates are computed again instead.
    safe = jax.checkpoint(lambda *given: _split_floats(rank_safe(careful)(*given)), prevent_cse=False)
    differentiable, rest = _split_floats(values)
    floats, rest = repair(jnp.logical_not(valid), safe, fast, (differentiable, rest), given)
    floats, rest = iter(floats), iter(rest)
    results = [next(floats if is_float else rest) for is_float in map(is_float, jax.tree.leaves(values))]
    return jax.tree.unflatten(jax.tree.structure(values), results)


def _split_floats(tree) -> tuple[list, list]:
    """The leaves that are differentiated, and the others: tangents of integers do not pass through a branch of JAX."""
    leaves = [jnp.asarray(x) for x in jax.tree.leaves(tree)]
    return [x for x in leaves if is_float(x)], [x for x in leaves if not is_float(x)]


def _by_kernel(function, static, tree, args, fallback: Callable | None, **how) -> tuple[Any, Any] | None:
    """The function's results by its kernel, and whether they are valid; None where there is no kernel."""
    if target is None:
        mode.say_once("llvmlite is not installed, so functions run on JAX's own operations (pip install llvmlite)")
        return None
    if mode.current() == "plain":
        return None
    try:
        results = _bind(function, static, tree, args, **how)
    except Exception as error:
        # On a version of JAX that the tests have seen, an error is the function's own or a fault of ours. On another one it
        # may be that JAX has changed. The function's own errors are raised once more, before anything is forgiven.
        if jax_adapter.is_version_known():
            raise
        values = (function if fallback is None else fallback)(*static, tree, *args)
        jax_adapter.forgive(error)
        return values, True
    if isinstance(results, str):
        if fallback is None:
            say_without_kernel(name_of(function), results)
        return None
    return results


def _bind(function, static, tree, args, **how) -> tuple[Any, Any] | str | None:
    """The results of the kernel and whether they are valid, or the reason why there is no kernel, or None."""
    leaves, traced = program_of(function, static, tree, args, flags="report", **how)
    if isinstance(traced, str):
        return traced
    (program, places), out_structure = without_unread(traced[0]), traced[1]
    leaves = [leaves[i] for i in places]
    if program.reports_validity and mode.rank_safe.value:
        # A part of another function's fallback: the fast path has failed for the sample, and may fail it here again.
        return None
    # A kernel takes flat arrays. Under a trace reshapes are free.
    changes_shapes = any(x.ndim != 1 for x in leaves) or any(len(x.shape) != 1 for x in program.outputs)
    results = (_call_under_jit if changes_shapes and is_known(leaves) else call_program)(program, leaves)
    if not program.reports_validity:
        return jax.tree.unflatten(out_structure, results), True
    return jax.tree.unflatten(out_structure, results[:-1]), results[-1]


def _call_own_program(function, static, tree, args):
    """A program that is not merged into the one around it; samples that it cannot compute are marked there."""
    results = _by_kernel(function, static, tree, args, None)
    if results is None:
        return function(*static, tree, *args)
    values, valid = results
    if valid is True:
        return values
    return jax.tree.map(lambda x: mark_invalid(jnp.logical_not(valid), x), values)


def call_program(program, leaves) -> list:
    """Results of a program in their shapes, of operands in any shape."""
    results = kernel_p.bind(*(x.reshape(-1) if x.ndim != 1 else x for x in leaves), program=program, rows=0)
    return [
        x if len(array.shape) == 1 else x.reshape(array.shape)
        for x, array in zip(results, program.outputs, strict=True)
    ]


def _call_under_jit(program, leaves) -> list:
    """`call_program` for known numbers: outside of a trace every reshape would be a program of XLA of its own."""
    with jax.disable_jit(False):
        return _jit_call(program)(*leaves)


@functools.lru_cache(maxsize=1024)
def _jit_call(program):
    return jax.jit(lambda *leaves: call_program(program, leaves))


def evaluate(function: Callable, tree, *args, static: tuple = (), is_input: bool = False):
    """function(*static, tree, *args) for known numbers, as numpy arrays, also while another program is traced.

    **Arguments:** as of `kernel`; `is_input`: whether the tree's arrays are operands of the kernel too, as they are in a program
    that takes the tree as an argument: it is the same kernel then.
    """
    leaves, structure = jax.tree.flatten(args)
    inputs, known = partition(tree, jax.Array if is_input else ())
    leaves = [np.asarray(x) for x in (*inputs, *leaves)]
    leaves = [x.astype(jax.dtypes.canonicalize_dtype(x.dtype)) for x in leaves]
    if mode.current() != "plain" and target is not None:
        shapes = tuple((x.shape, x.dtype) for x in leaves)
        # With the arguments of `_bind`, so that both share one trace.
        traced = trace_program(function, static, known, len(inputs), structure, shapes, flags="report")
        if not isinstance(traced, str):
            program, places = without_unread(traced[0])
            try:
                # The native code is called without XLA, as a call through XLA would be staged into the trace around it.
                results = target.call(program, [leaves[i] for i in places])
                if not program.reports_validity:
                    return jax.tree.unflatten(traced[1], results)
                if results.pop():
                    return jax.tree.unflatten(traced[1], results)
            except Exception as error:
                if not isinstance(error, target.Unsupported) and not jax_adapter.forgive(error):
                    raise
    with jax.ensure_compile_time_eval():
        return jax.tree.map(np.asarray, function(*static, tree, *map(jnp.asarray, args)))


def variant(inside: Callable, *, marks: bool = False) -> Any:
    """Choose between two functions that compute the same; a decorator of the one for JAX.

    **Arguments:** `inside` is traced in its place inside of kernels, as it stands. A program of numbers profits from every known
    zero, and JAX from few operations on large arrays. `marks`: whether `inside` may mark samples as not valid; a
    fallback that is a program itself, as in code without JAX, then takes the decorated function.
    """

    def decorate(outside: Callable) -> Callable:
        @functools.wraps(outside)
        def call(*args):
            is_inside = mode.is_expanding() and not (marks and mode.is_careful())
            return (inside if is_inside else outside)(*args)

        return call

    return decorate
