"""Calls outside of traces: entry points, numbers of known arguments, and the trial of an unknown version of JAX.

Entry points are executables that are kept on disk: in a second process nothing of them is traced, lowered or compiled.

An executable belongs to a function, the structure and the types of its arguments, everything static in them, and JAX's options.
In this process it is found by these, on disk by the hash of their contents (`stored.key_of`). Where they have none, as code of
users, the function is traced in each process, and the executable is found by the text of its program.
"""

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
from jaxdyn.compile.jax_adapter import select_options
from jaxdyn.compile.kernels import call_program
from jaxdyn.compile.known import is_concrete, is_tracing, keep_known, partition
from jaxdyn.compile.mode import phase
from jaxdyn.compile.primitive import target
from jaxdyn.compile.trace import program_of, trace_program

# What a stored executable may call: kernels, which are restored with it, and functions that every jaxlib has. A call of
# anything else may hold an address of the process that made it.
_CALLS = re.compile(r"custom_call @(?:\"([^\"]*)\"|([\w.$]+))")
_SAFE = re.compile(
    r"jaxdyn_kernel|lapack_\w+|Sharding|annotate_device_placement|TopK|Qr|ProductOfElementaryHouseholderReflectors"
)
# Options with which JAX checks what it runs, or runs it elsewhere.
_CHECKS = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks", "jax_default_device")
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
        elif isinstance(x, (np.ndarray, np.generic)) and not isinstance(x, str):
            kinds.append((x.shape, jax.dtypes.canonicalize_dtype(x.dtype), False))
            arrays.append(x)
        else:
            # With its type: 1 and 1.0 and True are equal, and are other constants.
            kinds.append((type(x), Static(x), repr(x) if isinstance(x, float) else None))  # 0.0 and -0.0 are equal too
    key = function, structure, tuple(kinds), options, (jax_adapter.configuration(), mode.state())
    try:
        hash(key)
    except TypeError:
        return None
    return _find(*key)(arrays)


@functools.cache
def _default_sharding() -> Any:
    return jax.sharding.SingleDeviceSharding(jax.devices()[0])


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
            args, kwargs = jax.tree.unflatten(structure, leaves)
            found, out = jax.tree.flatten(function(*args, **kwargs))
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
        if is_glue and not any(getattr(jax.config, name) for name in _CHECKS):
            found = call_executable(function, args, kwargs, options)
            if found is not None:
                return found
        # To equinox, strings of NumPy are arrays.
        args, kwargs = jax.tree.map(lambda x: str(x) if isinstance(x, str) else x, (args, kwargs))
        # JAX refuses compiler options under a transformation such as `grad`, whose arguments are traced.
        if not (is_glue and is_concrete((args, kwargs))):
            return usual(*args, **kwargs)
        return compiled()(*args, **kwargs)

    return call


def _usual_options() -> None:
    """XLA's own options, for functions that are more than calls of kernels."""


_jit: Any = eqx.filter_jit

# What XLA compiles is the glue between kernels. Its emitters of fusions, each a module of its own, take most of the time to
# compile it and bring nothing at run time: `python -m benchmarks.first_calls`, and again with
# JAXDYN_COMPILATION_OPTIONS=usual in the environment.
_QUICK: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_MINIMUM = _QUICK | {"xla_backend_optimization_level": 0}


@functools.cache
def quick_options() -> dict[str, Any] | None:
    """Options with which XLA compiles glue quickly.

    None where the environment asks for the usual ones.
    """
    if mode.options() == "usual":
        return None
    return select_options(_MINIMUM if mode.options() == "least" else _QUICK)


def glue_options(platform: str) -> dict[str, Any] | None:
    """Options to compile a program of kernels and what stands between them for this platform, in the mode in force."""
    return quick_options() if _is_glue(platform) else None


def _is_glue(platform: str) -> bool:
    return mode.current() != "plain" and platform == "cpu"


# --- numbers that are known ---


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
        with keep_known():
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
