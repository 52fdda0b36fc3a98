"""Functions of one sample as kernels: the decorator `kernel`, and `evaluate` for numbers that are known.

A call traces the function once, and calls its program through the primitive (see `trace` and `primitive`). This module decides
what a call means: the kernel, its fallback, or, inside another kernel, the function itself.
"""

import contextlib
import functools
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import disk, jax_adapter, mode, stored
from jaxdyn.compile.derive import without_unread
from jaxdyn.compile.first_calls import phase
from jaxdyn.compile.jax_adapter import function_of as function_of
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.compile.known import is_concrete, is_known, is_tracing, partition, partition_tracers
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
    results = _bind(function, static, tree, args, fallback, **how)
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
    results = (_call_under_jit if changes_shapes and is_known(leaves) else call_program)(program, leaves)
    return jax.tree.unflatten(out_structure, results)


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
                with contextlib.suppress(target.Unsupported):
                    return jax.tree.unflatten(results, call([leaves[i] for i in places]))
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


# --- entry points as executables that are kept on disk: in a second process nothing of them is traced, lowered or compiled ---
#
# An executable belongs to a function, the structure and the types of its arguments, everything static in them, and JAX's options.
# In this process it is found by these, on disk by the hash of their contents (`stored.key_of`). Where they have none, as code of
# users, the function is traced in each process, and the executable is found by the text of its program.


# What a stored executable may call: kernels, which are restored with it, and functions that every jaxlib has. A call of
# anything else may hold an address of the process that made it.
_CALLS = re.compile(r"custom_call @(?:\"([^\"]*)\"|([\w.$]+))")
_SAFE = re.compile(
    r"jaxdyn_kernel|lapack_\w+|Sharding|annotate_device_placement|TopK|Qr|ProductOfElementaryHouseholderReflectors"
)
_NUMBERS = re.compile(r"program = (\d+) : i64")


class Static(NamedTuple):
    """An argument that is no array: a constant of the executable."""

    value: Any


class Executable(NamedTuple):
    """A compiled function of flat arrays, and how to make the results' tree of its flat results.

    `static`: in the place of each leaf of the results its value, or None where it is an array.
    """

    run: Callable
    static: tuple[Static | None, ...]
    structure: Any

    def __call__(self, arrays: Sequence) -> Any:
        results = iter(self.run(*arrays))
        leaves = [next(results) if x is None else x.value for x in self.static]
        return jax.tree.unflatten(self.structure, leaves)


def call_executable(function: Callable, args: tuple, kwargs: dict, options: Callable) -> Any:
    """function(*args, **kwargs) by its executable, for arrays on the default device; None where it has to be called otherwise.

    `options()`: XLA's options, which take time to find out.
    """
    if not jax_adapter.is_version_known():
        return None
    leaves, structure = jax.tree.flatten((args, kwargs))
    device, kinds, arrays = _default_sharding(), [], []
    for x in leaves:
        if isinstance(x, jax.Array):
            # Random keys have a dtype of their own.
            if isinstance(x, jax_adapter.Tracer) or x.sharding != device or not isinstance(x.dtype, np.dtype):
                return None
            kinds.append((x.shape, x.dtype, x.weak_type))
            arrays.append(x)
        elif isinstance(x, (np.ndarray, np.generic)):
            kinds.append((x.shape, jax.dtypes.canonicalize_dtype(x.dtype), False))
            arrays.append(x)
        else:
            # With its type: 1 and 1.0 and True are equal, and are other constants.
            kinds.append((type(x), Static(x), repr(x) if isinstance(x, float) else None))  # 0.0 and -0.0 are equal too
    context = jax_adapter.configuration(), mode.state()
    try:
        found = _executable(function, structure, tuple(kinds), options, context)
    except _Unhashable:
        return None
    return found(arrays)


class _Unhashable(Exception):
    pass


@functools.cache
def _default_sharding() -> Any:
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


def _executable(*key) -> Executable:
    try:
        hash(key)
    except TypeError:
        raise _Unhashable from None
    return _find(*key)


@functools.lru_cache(maxsize=1024)
def _find(function, structure, kinds, options, context) -> Executable:
    del context  # part of the key alone
    key = stored.key_of("entry", function, structure, kinds)

    def trace() -> tuple[Any, list]:
        """The function, lowered, and its results' static leaves and structure."""
        results = []

        def flat(*arrays):
            given = iter(arrays)
            leaves = [x[1].value if isinstance(x[1], Static) else next(given) for x in kinds]
            found, out = jax.tree.flatten(_apply(function, structure, leaves))
            is_array = [isinstance(x, (jax.Array, np.ndarray, np.generic)) for x in found]
            results[:] = [tuple(None if y else Static(x) for x, y in zip(found, is_array, strict=True)), out]
            return [x for x, y in zip(found, is_array, strict=True) if y]

        flat.__name__ = getattr(function, "__name__", "flat")  # for profiles
        types = [jax.ShapeDtypeStruct(x[0], x[1], weak_type=x[2]) for x in kinds if not isinstance(x[1], Static)]
        jitted = jax.jit(flat, compiler_options=options(), keep_unused=True)
        return jitted.lower(*types), results

    recover = functools.partial(stored.in_modes, mode.remember(), trace)
    if key is not None and (found := _load_executable(key, recover)) is not None:
        return found
    with phase("tracing"):
        lowered, (static, out) = trace()
    text = lowered.as_text()
    is_kept = _may_be_kept(text, key is None)
    if key is None and is_kept and (key := stored.key_of("text", text, options())) is not None:
        found = _load_executable(key, recover)
        if found is not None:
            return Executable(found.run, static, out)
    made = Executable(lowered.compile(), static, out)
    if key is not None and is_kept:
        _save_executable(key, text, made)
    return made


def _apply(function: Callable, structure: Any, leaves: list) -> Any:
    args, kwargs = jax.tree.unflatten(structure, leaves)
    return function(*args, **kwargs)


def _load_executable(key: str, recover: Callable) -> Executable | None:
    found = stored.load(f"{key}.executable")
    if found is None:
        return None
    # Whatever is wrong with a file, the function is compiled again.
    try:
        payload, rows, static, results = found
        for number, row in rows:
            target.restore(number, target.Row(*row), recover)
        return Executable(jax_adapter.load_executable(payload), static, jax.tree.structure(results))
    except Exception as reason:
        disk.logger.debug("jaxdyn: an executable on disk is made again: %s", reason)
        return None


def _may_be_kept(text: str, is_traced: bool) -> bool:
    """Decide whether a program calls nothing but what another process has too.

    `is_traced`: whether that process traces it first, so that it has the kernels which only one process knows by their numbers.
    """
    unsafe = {a or b for a, b in _CALLS.findall(text) if not _SAFE.fullmatch(a or b)}
    if not is_traced and not unsafe:
        rows = (target.row_of(int(x)) for x in set(_NUMBERS.findall(text)))
        unsafe |= {row.name for row in rows if not row.is_kept}
    if unsafe:
        disk.logger.debug("jaxdyn: a program is not kept on disk, as it calls %s", ", ".join(sorted(unsafe)))
    return not unsafe


def _save_executable(key: str, text: str, made: Executable) -> None:
    numbers = sorted({int(x) for x in _NUMBERS.findall(text)})
    rows = [(number, tuple(target.row_of(number))) for number in numbers]
    try:
        payload = jax_adapter.dump_executable(made.run)
        # An instance, not its structure: pickled ones do not know the marks of equinox for fields that are missing.
        results = jax.tree.unflatten(made.structure, [0] * len(made.static))
    except Exception as reason:
        disk.logger.debug("jaxdyn: an entry point is not kept on disk: %r", reason)
        return
    stored.save(f"{key}.executable", (payload, rows, made.static, results))


# --- entry points: functions that users call outside of any trace, compiled once per shape ---


def jit(function: Callable) -> Callable:
    """Compile a function, and keep what is compiled on disk: a second process traces it and compiles nothing.

    As `equinox.filter_jit`: arrays in the arguments are operands, everything else is a constant of the program. The program on
    disk is found by what tracing gives, all numbers within included: no change of the function, or of what it reads, gives
    another one's results. Under a transformation or another `jit`, and on devices other than CPUs, nothing is kept. Programs
    that call Python (`jax.pure_callback`) are not kept either.

    ```python
    @jd.jit
    def loss_gradient(model, q, v):
        return jax.grad(lambda v: jd.simulate(model, q, v, ts).q[-1].sum())(v)
    ```
    """
    return _compile(function, _usual_options)


def entry_point(function: Callable) -> Callable:
    """Compile a function that users call once per shape, its arrays being operands; a decorator.

    Within a trace it is the function as it stands: a nested `jit` would hide the values of known arrays.
    """
    return _compile(function, quick_options)


def _compile(function: Callable, options: Callable) -> Callable:
    usual = eqx.filter_jit(function)
    compiled = functools.cache(lambda: _jit(function, compiler_options=options()))

    @functools.wraps(function)
    def call(*args, **kwargs):
        if is_tracing():
            return function(*args, **kwargs)
        is_glue = _is_glue(jax.default_backend())
        if is_glue and _is_plain_call():
            found = call_executable(function, args, kwargs, options)
            if found is not None:
                return found
        # JAX refuses compiler options under a transformation such as `grad`, whose arguments are traced.
        if not (is_glue and is_concrete((args, kwargs))):
            return usual(*args, **kwargs)
        return compiled()(*args, **kwargs)

    return call


def _usual_options() -> None:
    """XLA's own options, for functions that are more than calls of kernels."""


def _is_plain_call() -> bool:
    """Decide whether JAX is to run what it has compiled, without checks within the call."""
    options = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks", "jax_default_device")
    return not any(getattr(jax.config, name) for name in options)


_jit: Any = eqx.filter_jit

# What XLA compiles is the glue between kernels. Its emitters of fusions, each a module of its own, take most of the time to
# compile it and bring nothing at run time: `python -m benchmarks.first_calls`, and again with
# JAXDYN_COMPILATION_OPTIONS=usual in the environment.
_QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_LEAST = _QUICK | {"xla_backend_optimization_level": 0}


@functools.cache
def quick_options() -> dict[str, Any] | None:
    """Options with which XLA compiles glue quickly.

    None where the environment asks for the usual ones.
    """
    if mode.wants_usual_options():
        return None
    return select_options(_LEAST if mode.wants_least_optimisation() else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"


# --- a kernel through all rules of its primitive, against JAX: what an unknown version of JAX has to pass before the first on---
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
