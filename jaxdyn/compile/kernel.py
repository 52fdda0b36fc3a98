"""Functions of one sample as kernels: `run` is what mechanics call.

A kernel is one primitive of JAX with its rules: batches become leading axes of its arguments, which stay without them where all
samples share an argument; its derivative is the kernel of the program's change, linear in the steps, and the transpose of that is
the kernel of the transposed program. So derivatives of any order, forward and reverse, under any nesting of `vmap`, are kernels.
On a CPU it is lowered to a call of machine code, elsewhere to the program's numbers as operations of JAX.
"""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxdyn.compile import ahead, derive, mode, sharding
from jaxdyn.compile.expand import expand
from jaxdyn.compile.graph import inlined
from jaxdyn.compile.known import Known, is_known, partition, partition_traced
from jaxdyn.compile.program import COMPARISONS, Constant, NotNumbers, Program, TooLong, dtype_of
from jaxdyn.compile.shared import divided
from jaxdyn.compile.trigonometry import cosine, sine

try:
    from jaxdyn.compile import target
except ImportError:  # no llvmlite for this platform
    target = None


def run(
    function: Callable,
    tree,
    *args,
    static: tuple = (),
    otherwise: Callable | None = None,
    tangent: Callable | None = None,
    most: int = mode.MAX_OPERATIONS,
    calls: bool = False,
    served: bool = False,
    own_program: bool = False,
) -> Any:
    """function(*static, tree, *args) by a kernel; by `otherwise` (default: the function itself) where there is none.

    **Arguments:**

    - `function(*static, tree, *args)`: pure, of one sample, written with arrays. Defined once: programs are kept by it and by
      `static`, which is hashable.
    - `tree`: pytree whose known leaves are compiled in; its traced leaves, and all of `args`, are inputs of the kernel.
    - `tangent(*static, tree, *args, steps)`: the change of the function's results for `steps` in the leaves of tree, then
      args (None where nothing moves), where that is cheaper than differentiating the numbers.
    - `most`: operations beyond which there is no kernel. `calls`: whether long functions under `jax.jit` within this one
      are written once and called, which does for a function that is not differentiated.
    - `served`: whether to return a pair: what the function does, and whether this sample is one that a program of numbers can
      serve (see `flags`): True where every sample is, else a bool array ().
    - `own_program`: whether the function is a program of its own within another one too: its derivatives are then those of its
      numbers, and a long one is called.

    **Returns:** what the function does.
    """
    if mode.is_expanding() and not own_program:
        results = _inside(function, static, tree, args)
        return (results, True) if served else results

    def by_jax():
        results = (function if otherwise is None else otherwise)(*static, tree, *args)
        return (results, True) if served else results

    if mode.current() == "plain" or target is None:
        if target is None:
            mode.say_once("llvmlite is not installed, so functions run on JAX's own operations (pip install llvmlite)")
        return by_jax()
    leaves, expanded = program_of(function, static, tree, args, tangent=tangent, most=most, calls=calls, served=served)
    if isinstance(expanded, str):
        if otherwise is None:
            mode.say_once(f"{_name_of(function)} runs on JAX's own operations: {expanded}")
        return by_jax()
    program, out_structure = expanded
    changes_shapes = any(x.ndim != 1 for x in leaves) or any(len(x.shape) != 1 for x in program.outputs)
    shaped = _at_once(program, leaves) if changes_shapes and is_known(leaves) else _shaped(program, leaves)
    if not served:
        return jax.tree.unflatten(out_structure, shaped)
    entry = program.results[-1][0]
    return jax.tree.unflatten(out_structure, shaped[:-1]), shaped[-1] if type(entry) is not Constant else entry.value


def _shaped(program, leaves) -> list:
    """Results of the program in their shapes, of inputs in any shape."""
    results = kernel_p.bind(*(x.reshape(-1) if x.ndim != 1 else x for x in leaves), program=program, rows=0)
    return [
        x if len(array.shape) == 1 else x.reshape(array.shape)
        for x, array in zip(results, program.outputs, strict=True)
    ]


def _at_once(program, leaves) -> list:
    """`_shaped` of known numbers as one program: outside of a trace the kernel and each change of a shape would be one each."""
    with jax.disable_jit(False):
        return _jitted_shaped(program)(*leaves)


@functools.lru_cache(maxsize=1024)
def _jitted_shaped(program):
    return jax.jit(lambda *leaves: _shaped(program, leaves))


def compute(function: Callable, tree, *args, static: tuple = (), given: bool = False):
    """function(*static, tree, *args) for known numbers, as numpy arrays, also while a program is traced.

    **Arguments:** as of `run`; `given`: whether the tree's arrays are inputs of the kernel too, as they are in a program
    that takes the tree as an argument: it is the same kernel then.
    """
    leaves, structure = jax.tree.flatten(args)
    inputs, known = partition(tree, lambda leaf: given and isinstance(leaf, jax.Array))
    leaves = [np.asarray(x) for x in (*inputs, *leaves)]
    leaves = [x.astype(jax.dtypes.canonicalize_dtype(x.dtype)) for x in leaves]
    if mode.current() != "plain" and target is not None:
        shapes = tuple((x.shape, x.dtype) for x in leaves)
        of = function, static, known, len(inputs), structure, shapes, None, mode.MAX_OPERATIONS, False, False
        expanded = _program(*of, mode.is_rank_safe(), jax.config.read("jax_enable_x64"))
        if not isinstance(expanded, str):
            try:
                return jax.tree.unflatten(expanded[1], target.call(expanded[0], leaves))
            except target.Unsupported:
                pass
    with jax.ensure_compile_time_eval():
        return jax.tree.map(np.asarray, function(*static, tree, *map(jnp.asarray, args)))


def program_of(
    function: Callable,
    static: tuple,
    tree,
    args: tuple,
    *,
    tangent: Callable | None = None,
    most: int = mode.MAX_OPERATIONS,
    calls: bool = False,
    served: bool = False,
):
    """Inputs of the program of a function, and the program with the structure of its results, or why there is none.

    **Arguments:** as of `run`.
    """
    traced, known = partition_traced(tree)
    leaves, structure = jax.tree.flatten(args)
    leaves = sharding.varying_alike([*map(jnp.asarray, (*traced, *leaves))])
    shapes = tuple((x.shape, x.dtype) for x in leaves)
    of = function, static, known, len(traced), structure, shapes, tangent, most, calls, served
    return leaves, _program(*of, mode.is_rank_safe(), jax.config.read("jax_enable_x64"))


def native(function: Callable) -> Callable:
    """`function(model, *args)` by a kernel."""

    @functools.wraps(function)
    def call(model, *args):
        return run(function, model, *args)

    return call


def _name_of(function) -> str:
    return getattr(function, "__qualname__", type(function).__name__)


@functools.lru_cache(maxsize=1024)
def _program(function, static, known: Known, count, structure, shapes, tangent, most, calls, served, is_safe, has_x64):
    """The program of a function and the structure of its results, or why there is none.

    `is_safe`, `has_x64`: what else its trace depends on, its derivatives too, which are traced when they are asked for.
    """
    del has_x64
    avals = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
    flat = _traced_once(function, static, known, count, structure)
    try:
        with mode.expanding():
            closed, out = jax.make_jaxpr(_plain(flat) if calls else flat, return_shape=True)(*avals)
        program, has_rules = expand(closed, most, _name_of(function), calls, served)
    except (NotNumbers, TooLong) as reason:
        return str(reason)
    if tangent is not None:
        rule = functools.partial(tangent, *static)
        program.derivative = _by_rule(rule, known, count, structure, avals, served, is_safe)
    elif has_rules:
        program.derivative = _by_jax(flat, avals, served, is_safe)
    return program, jax.tree.structure(out)


@functools.lru_cache(maxsize=1024)
def _traced_once(function, static, known: Known, count: int, structure):
    """The function of its traced leaves alone; JAX traces it once for all programs that it is part of."""

    @jax.jit
    def flat(*leaves):
        return function(*static, known(leaves[:count]), *jax.tree.unflatten(structure, leaves[count:]))

    return flat


def _plain(jitted):
    """The function itself that is under `jax.jit`."""
    return jitted.__wrapped__


def _inside(function, static, tree, args):
    """The function within another one that becomes a program."""
    traced, known = partition_traced(tree)
    leaves, structure = jax.tree.flatten(args)
    return _traced_once(function, static, known, len(traced), structure)(*traced, *leaves)


def _by_rule(tangent: Callable, known: Known, count: int, structure, avals, served: bool, is_safe: bool):
    """The program of the change that a rule gives."""

    def derivative(moving):
        def change(*leaves):
            primal, steps = leaves[: len(avals)], iter(leaves[len(avals) :])
            every: list = [None] * known.structure.num_leaves
            given = [next(steps) if varies else None for varies in moving]
            for place, step in zip(known.places, given[:count], strict=True):
                every[place] = step
            args = jax.tree.unflatten(structure, primal[count:])
            return tangent(known(primal[:count]), *args, [*every, *given[count:]])

        return _expanded_change(change, avals, moving, served, is_safe)

    return derivative


def _by_jax(flat: Callable, avals, served: bool, is_safe: bool):
    """The program of the change that JAX finds, which asks functions for their own rules."""

    def derivative(moving):
        def change(*leaves):
            primal, steps = list(leaves[: len(avals)]), leaves[len(avals) :]
            places = [i for i, varies in enumerate(moving) if varies]

            def moved(*values):
                here = list(primal)
                for i, value in zip(places, values, strict=True):
                    here[i] = value
                return [x for x in jax.tree.leaves(flat(*here)) if jnp.issubdtype(x.dtype, jnp.floating)]

            return jax.jvp(moved, [primal[i] for i in places], list(steps))[1]

        return _expanded_change(change, avals, moving, served, is_safe)

    return derivative


def _expanded_change(change: Callable, avals, moving, served: bool, is_safe: bool) -> Program:
    """The change as a program; NaN at samples that are flagged, where whoever runs the function is told of them."""
    steps = [aval for aval, varies in zip(avals, moving, strict=True) if varies]
    with mode.expanding(), mode.rank_safe(is_safe):
        closed = jax.make_jaxpr(change)(*avals, *steps)
    return expand(closed, 10 * mode.MAX_OPERATIONS, "change", flags=served)[0]


# --- the primitive ---

kernel_p = Primitive("jaxdyn_kernel")
kernel_p.multiple_results = True


@functools.lru_cache(maxsize=1024)
def _jitted(program, rows: int):
    return jax.jit(lambda *args: kernel_p.bind(*args, program=program, rows=rows))


@kernel_p.def_impl
def _(*args, program, rows):
    # A kernel is always compiled: under `jax.disable_jit()` it would be called by itself for ever.
    with jax.disable_jit(False):
        return _jitted(program, rows)(*args)


@kernel_p.def_abstract_eval
def _(*avals, program, rows):
    is_one = not any(len(x.shape) > 1 for x in avals)
    if is_one and ahead.is_active() and not mode.is_expanding():
        assert target is not None
        with contextlib.suppress(target.Unsupported):  # which is said where the kernel is lowered
            target.make_ahead(target.kernel(program, target.width_of(program, 1), [False] * len(avals)))
    return sharding.results_of(avals, program.outputs)


def _batched(args, axes, *, program, rows):
    """A new leading axis for what varies; what all samples share stays a row."""
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not batching.not_mapped)
    moved = [x if axis is batching.not_mapped else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    varies = [axis is not batching.not_mapped for axis in axes]
    inner = max((x.shape[v:-1] for x, v in zip(moved, varies, strict=True)), key=len)
    full = []
    for x, v in zip(moved, varies, strict=True):
        lead = x.shape[v:-1]
        if not v and lead:  # varies along inner axes alone
            x = jnp.broadcast_to(x[None], (size, *x.shape))
        elif v and lead != inner:
            x = jnp.broadcast_to(x.reshape(size, *[1] * len(inner), x.shape[-1]), (size, *inner, x.shape[-1]))
        full.append(x)
    rows += mode.is_row() and not mode.is_expanding()
    results = kernel_p.bind(*full, program=program, rows=rows)
    return results, [0] * len(results)


batching.primitive_batchers[kernel_p] = _batched


def _jvp(primals, tangents, *, program, rows):
    results = kernel_p.bind(*primals, program=program, rows=rows)
    moving = tuple(type(step) is not ad.Zero for step in tangents)
    change = derive.tangent(program, moving)
    changes = iter(kernel_p.bind(*primals, *(x for x in tangents if type(x) is not ad.Zero), program=change, rows=rows))
    out = []
    for x, array in zip(results, program.outputs, strict=True):
        out.append(next(changes) if array.dtype.kind == "f" else ad.Zero(ShapedArray(x.shape, jax.dtypes.float0)))
    return results, out


ad.primitive_jvps[kernel_p] = _jvp


def _transpose(cotangents, *operands, program, rows):
    linear = [ad.is_undefined_primal(x) for x in operands]
    given = [type(x) is not ad.Zero for x in cotangents]
    backwards = derive.transposed(program, linear, given)
    fixed = [x for x, varies in zip(operands, linear, strict=True) if not varies]
    moved = [x for x in cotangents if type(x) is not ad.Zero]
    results = iter(kernel_p.bind(*fixed, *moved, program=backwards, rows=rows))
    out = []
    for x, varies in zip(operands, linear, strict=True):
        if not varies:
            out.append(None)
            continue
        cotangent = next(results)  # of each sample, also of what all of them share
        shared = cotangent.ndim - len(x.aval.shape)
        out.append(jnp.sum(cotangent, axis=tuple(range(shared))) if shared else cotangent)
    return out


ad.primitive_transposes[kernel_p] = _transpose


# --- lowering ---

_OPERATIONS: dict[str, Callable] = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg, "max": lax.max, "min": lax.min,
    "pow": lax.pow, "atan2": lax.atan2, "rem": lax.rem, "and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not,
    "is_finite": lax.is_finite, "select": lambda which, no, yes: lax.select(which, yes, no), "sqrt": lax.sqrt, "sin": sine,
    "cos": cosine, "tan": lax.tan, "asin": lax.asin, "acos": lax.acos, "atan": lax.atan, "sinh": lax.sinh, "cosh": lax.cosh,
    "tanh": lax.tanh, "exp": lax.exp, "exp2": lax.exp2, "expm1": lax.expm1, "log": lax.log, "log1p": lax.log1p, "abs": lax.abs,
    "floor": lax.floor, "ceil": lax.ceil, "sign": lax.sign, "cbrt": lax.cbrt, "stop_gradient": lax.stop_gradient,
    "round": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN),
} | {name: getattr(lax, name) for name in COMPARISONS}  # fmt: skip


def as_operations(*args, program: Program, rows: int = 0):
    """The program's numbers as operations of JAX on arrays over the batch."""
    if not isinstance(program, Program):
        return program.as_operations(*args)
    lead = max((x.shape[:-1] for x in args), key=len, default=())
    program = inlined(program)
    columns = [jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in args]
    values: list = []

    def constant(value, kind):
        return jnp.full(lead, value, dtype_of(kind))

    for op, kind, operands in program.operations:
        if op == "input":
            place, entry = operands
            values.append(columns[place][..., entry])
        elif op == "convert":
            values.append(lax.convert_element_type(values[operands[0]], dtype_of(kind)))
        else:
            kinds = [program.operations[x].kind for x in operands if type(x) is not Constant]
            known = kinds[-1] if op in COMPARISONS else kind
            values.append(
                _OPERATIONS[op](*(constant(x.value, known) if type(x) is Constant else values[x] for x in operands))
            )
    results = []
    for row, array in zip(program.results, program.outputs, strict=True):
        entries = [jnp.full(lead, x.value, array.dtype) if type(x) is Constant else values[x] for x in row]
        # Without the barrier every entry of the stack would be a branch in which XLA computes all that it needs.
        entries = lax.optimization_barrier(entries) if entries else entries
        results.append(jnp.stack(entries, -1) if entries else jnp.zeros((*lead, 0), array.dtype))
    return results


_lower_elsewhere = mlir.lower_fun(as_operations, multiple_results=True)


def _lower_on_cpu(ctx, *operands, program, rows):
    lead = ctx.avals_out[0].shape[:-1] if ctx.avals_out else ()
    uniform = [bool(lead) and len(x.shape) == 1 for x in ctx.avals_in]
    if any(uniform) and not all(uniform) and len(lead) == rows:  # the kernel of one sample shares nothing
        return _lower_repeated(ctx, *operands, program=program, rows=rows)
    apart = lead[: len(lead) - rows]  # rows of one sample go through the kernel of one sample
    samples = math.prod(apart) if all(isinstance(n, int) for n in apart) else None
    if samples != 1 and target is not None and target.is_supported() and divided(program, uniform) is not None:
        return _lower_divided(ctx, *operands, program=program, rows=rows)
    try:
        assert target is not None
        number = target.kernel(program, target.width_of(program, samples), uniform)
    except target.Unsupported as reason:  # pyright: ignore[reportOptionalMemberAccess]
        mode.say_once(f"functions run on JAX's own operations: {reason}")
        return _lower_elsewhere(ctx, *operands, program=program, rows=rows)
    if sharding.may_be_divided(ctx.avals_in, lead):
        return _lower_with_last_axis(ctx, *operands, program=program, rows=rows and rows + 1)
    order = target.varying_first(uniform)
    ctx = ctx.replace(avals_in=[ctx.avals_in[i] for i in order])
    lower = jax.ffi.ffi_lowering(target.TARGET, extra_attributes=sharding.attributes(ctx.avals_in, ctx.avals_out))
    return lower(ctx, *(operands[i] for i in order), program=np.int64(number))


def _with_last_axis(*args, program, rows):
    """The call with one more batch axis, of length one (see `sharding.may_be_divided`)."""
    results = kernel_p.bind(
        *(x if x.ndim == 1 else lax.expand_dims(x, [x.ndim - 1]) for x in args), program=program, rows=rows
    )
    return [lax.squeeze(x, [x.ndim - 2]) for x in results]


def _repeated(*args, program, rows):
    """The call with arguments of its own for every row."""
    lead = max((x.shape[:-1] for x in args), key=len)
    return kernel_p.bind(*(jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in args), program=program, rows=rows)


def _divided(*args, program, rows):
    """The call as two, the first of what all samples share."""
    uniform = [x.ndim == 1 for x in args]
    once, each = divided(program, uniform)  # pyright: ignore[reportGeneralTypeIssues]
    shared = kernel_p.bind(*(x for x in args if x.ndim == 1), program=once, rows=0)
    return kernel_p.bind(*args, *shared, program=each, rows=rows)


_lower_divided = mlir.lower_fun(_divided, multiple_results=True)
_lower_repeated = mlir.lower_fun(_repeated, multiple_results=True)
_lower_with_last_axis = mlir.lower_fun(_with_last_axis, multiple_results=True)


mlir.register_lowering(kernel_p, _lower_elsewhere)
mlir.register_lowering(kernel_p, _lower_on_cpu, platform="cpu")
