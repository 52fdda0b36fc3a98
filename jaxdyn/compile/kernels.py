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
from jaxdyn.compile.known import is_known, partition, partition_tracers
from jaxdyn.compile.primitive import kernel_p, target
from jaxdyn.compile.rules import has_marks
from jaxdyn.compile.trace import function_of_leaves, inline_call, name_of, program_of, trace_program


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
      by `mark_invalid` (see `careful`). Default: the function itself. It depends on nothing traced but its arguments.
    - `derivative`: None for the derivative of the function's numbers; False for functions that are never differentiated, in
      which long functions under `jax.jit` are compiled once and called, and `lax.cond` is a branch; "program" for a function that
      stays a program of its own, with the derivative of its numbers, inside another kernel too; or a rule
      `derivative(*static, tree, *args, steps)` that returns the change of the results for the `steps` of the leaves of tree and
      args (None for a leaf that does not change), where that is cheaper.

    **Raises:** whatever the function raises while it is traced.
    """
    if function is None:
        return functools.partial(kernel, static=static, fallback=fallback, derivative=derivative)
    rule = derivative if callable(derivative) else None

    @functools.wraps(function)
    def call(*args):
        given = args[:static], args[static], args[static + 1 :]
        if mode.is_careful_within() and fallback is not None and _has_marks(function, *given):
            return fallback(*args)
        # Code without JAX is one program: others are kept by keys that do not know what they may call.
        if derivative == "program" and not mode.is_standalone():
            results = _by_kernel(function, *given, fallback)
            return function(*args) if results is None else results
        if mode.is_expanding():
            return inline_call(function, *given, fallback)
        # Derivatives of a subprogram's call would be those of its numbers, written out: calls pay where nobody differentiates.
        results = _by_kernel(function, *given, fallback, tangent=rule, calls=derivative is False)
        return (function if fallback is None else fallback)(*args) if results is None else results

    return call


def _has_marks(function, static, tree, args) -> bool:
    """Decide whether a function marks samples as not valid, inside of a kernel."""
    traced, known = partition_tracers(tree)
    leaves, structure = jax.tree.flatten(args)
    with mode.careful(""), mode.expanding(mode.has_branches()):
        flat = function_of_leaves(function, static, known, len(traced), structure)
        return has_marks(jax.make_jaxpr(flat)(*traced, *leaves).jaxpr)


def _by_kernel(function, static, tree, args, fallback: Callable | None, **how) -> Any:
    """The function's results by its kernel; None where there is no kernel."""
    if target is None:
        mode.say_once("llvmlite is not installed, so functions run on JAX's own operations (pip install llvmlite)")
        return None
    if mode.current() == "plain":
        return None
    try:
        results = _bind(function, static, tree, args, fallback, **how)
    except Exception as error:
        # On a version of JAX that the tests have seen, an error is the function's own or a fault of ours. On another one it
        # may be that JAX has changed. The function's own errors are raised once more, before anything is forgiven.
        if jax_adapter.is_version_known():
            raise
        values = (function if fallback is None else fallback)(*static, tree, *args)
        jax_adapter.forgive(error)
        return values
    if isinstance(results, str):
        if fallback is None:
            mode.say_without_kernel(name_of(function), results)
        return None
    return results


def _bind(function, static, tree, args, fallback, **how) -> Any:
    """The results of the kernel, or the reason why there is no kernel, or None."""
    leaves, traced = program_of(function, static, tree, args, flags="repair", fallback=fallback, **how)
    if isinstance(traced, str):
        return traced
    (program, places), out_structure = without_unread(traced[0]), traced[1]
    leaves = [leaves[i] for i in places]
    if program.careful is not None and mode.is_careful_within():
        # A part of another function's fallback: the fast path has failed for the sample, and may fail it here again.
        return None
    # A kernel takes flat arrays. Under a trace reshapes are free.
    changes_shapes = any(x.ndim != 1 for x in leaves) or any(len(x.shape) != 1 for x in program.outputs)
    if not (changes_shapes and is_known(leaves)):
        return jax.tree.unflatten(out_structure, call_program(program, leaves))
    # Outside of a trace every reshape would be a program of XLA of its own.
    with jax.disable_jit(False):
        return jax.tree.unflatten(out_structure, _jit_call(program)(*leaves))


def call_program(program, leaves) -> list:
    """Results of a program in their shapes, of operands in any shape."""
    results = kernel_p.bind(*(x.reshape(-1) if x.ndim != 1 else x for x in leaves), program=program, rows=0)
    return [
        x if len(array.shape) == 1 else x.reshape(array.shape)
        for x, array in zip(results, program.outputs, strict=True)
    ]


@functools.lru_cache(maxsize=1024)
def _jit_call(program):
    return jax.jit(lambda *leaves: call_program(program, leaves))


def evaluate(function: Callable, tree, *args, static: tuple = (), is_input: bool = False):
    """function(*static, tree, *args) for known numbers, also while another program is traced; see `Evaluation`."""
    return Evaluation(function, tree, static, is_input)(*args)


class Evaluation:
    """function(*static, tree, *args) of a known tree, for many calls with known numbers; results are numpy arrays.

    **Arguments:** as of `kernel`; `is_input`: whether the tree's arrays are operands of the kernel too, as they are in a program
    that takes the tree as an argument: it is the same kernel then.
    """

    def __init__(self, function: Callable, tree, static: tuple = (), is_input: bool = False):
        self.function, self.tree, self.static = function, tree, static
        inputs, self.known = partition(tree, jax.Array if is_input else ())
        self.inputs = [_as_canonical(x) for x in inputs]
        self.found: dict[Any, tuple | None] = {}

    def __call__(self, *args):
        """The results, by native code without XLA: a call through XLA would be staged into a trace around it."""
        leaves, structure = jax.tree.flatten(args)
        leaves = [_as_canonical(x) for x in leaves]
        if mode.current() != "plain" and target is not None:
            key = structure, tuple([(x.shape, x.dtype) for x in leaves]), mode.state_of_programs()
            if key not in self.found:
                self.found[key] = self._find(structure, leaves)
            if (found := self.found[key]) is not None:
                call, places, results = found
                try:
                    return jax.tree.unflatten(results, call([leaves[i] for i in places]))
                except Exception as error:
                    if not isinstance(error, target.Unsupported) and not jax_adapter.forgive(error):
                        raise
        with jax.ensure_compile_time_eval():
            return jax.tree.map(np.asarray, self.function(*self.static, self.tree, *map(jnp.asarray, args)))

    def _find(self, structure, leaves) -> tuple | None:
        """The native call, the places of its operands among the leaves, and the structure of its results."""
        count, shapes = len(self.inputs), tuple((x.shape, x.dtype) for x in (*self.inputs, *leaves))
        # With the arguments of `_bind`, so that both share one trace.
        traced = trace_program(self.function, self.static, self.known, count, structure, shapes, flags="repair")
        if isinstance(traced, str):
            return None
        program, places = without_unread(traced[0])
        fixed = {k: self.inputs[i] for k, i in enumerate(places) if i < count}
        return target.Call(program, fixed), [i - count for i in places if i >= count], traced[1]


def _as_canonical(x) -> np.ndarray:
    x = np.asarray(x)
    return x.astype(jax.dtypes.canonicalize_dtype(x.dtype), copy=False)


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


# --- a kernel through all rules of its primitive, against JAX: what an unknown version of JAX has to pass before the first ---
#
# Rules are called by JAX in the midst of its transformations, where an error could no longer be made good.


def _sample(known, x, y):
    del known
    return x * jnp.sin(y), jnp.sum(x / (2 + y * y))


def _kernel(x, y):
    leaves, expanded = program_of(_sample, (), None, (x, y))
    program, structure = expanded
    return jax.tree.unflatten(structure, call_program(program, leaves))


def _transforms(function, x, y) -> list:
    def slope(x, y):
        return jax.grad(lambda x, y: jnp.sum(function(x, y)[0]) + function(x, y)[1], (0, 1))(x, y)

    # Values, a jvp, a batch with a shared argument and a batched gradient: every rule of the primitive is called once.
    batches = [jax.jit(jax.vmap(f, (0, None)))(x, y) for f in (function, slope)]
    return [jax.jit(function)(x[0], y), jax.jvp(function, (x[0], y), (y, y)), *batches]


def run_trial() -> None:
    """**Raises:** whatever goes wrong, and ArithmeticError where numbers differ."""
    if target is None:
        return
    # Before anything is traced: XLA may refuse the handler.
    target.register()
    x, y = jnp.arange(12.0).reshape(4, 3), jnp.arange(3.0)
    computed, wanted = (_transforms(f, x, y) for f in (_kernel, functools.partial(_sample, None)))
    for mine, theirs in zip(jax.tree.leaves(computed), jax.tree.leaves(wanted), strict=True):
        # Loose, as the trial looks for other rules, not for rounding, and may run in float32.
        if mine.shape != theirs.shape or not np.allclose(mine, theirs, 1e-4, 1e-4):
            raise ArithmeticError("a kernel gives other numbers than JAX")


jax_adapter.try_first(run_trial)
