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

from jaxdyn.compile import ahead, derive, jax_adapter, mode, sharding
from jaxdyn.compile.expand import expand
from jaxdyn.compile.graph import inlined
from jaxdyn.compile.jax_adapter import define_primitive, is_linear, is_zero, lower_function, zero_tangent
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
    try:
        results = _by_kernel(function, static, tree, args, tangent=tangent, most=most, calls=calls, served=served)
    except Exception as error:
        if jax_adapter.is_tested():
            raise
        results = by_jax()  # an error of the function itself is raised here once more
        jax_adapter.forgive(error)
        return results
    if isinstance(results, str):
        if otherwise is None:
            mode.say_once(f"{_name_of(function)} runs on JAX's own operations: {results}")
        return by_jax()
    return results


def _by_kernel(function, static, tree, args, *, served: bool, **how):
    """What `run` returns, or why there is no kernel."""
    leaves, expanded = program_of(function, static, tree, args, served=served, **how)
    if isinstance(expanded, str):
        return expanded
    program, out_structure = expanded
    changes_shapes = any(x.ndim != 1 for x in leaves) or any(len(x.shape) != 1 for x in program.outputs)
    shaped = _at_once(program, leaves) if changes_shapes and is_known(leaves) else shaped_results(program, leaves)
    if not served:
        return jax.tree.unflatten(out_structure, shaped)
    entry = program.results[-1][0]
    return jax.tree.unflatten(out_structure, shaped[:-1]), shaped[-1] if type(entry) is not Constant else entry.value


def shaped_results(program, leaves) -> list:
    """Results of the program in their shapes, of inputs in any shape."""
    results = kernel_p.bind(*(x.reshape(-1) if x.ndim != 1 else x for x in leaves), program=program, rows=0)
    return [
        x if len(array.shape) == 1 else x.reshape(array.shape)
        for x, array in zip(results, program.outputs, strict=True)
    ]


def _at_once(program, leaves) -> list:
    """The same of known numbers as one program: outside of a trace the kernel and each change of a shape would be one each."""
    with jax.disable_jit(False):
        return _jitted_shaped(program)(*leaves)


@functools.lru_cache(maxsize=1024)
def _jitted_shaped(program):
    return jax.jit(lambda *leaves: shaped_results(program, leaves))


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
            except Exception as error:
                if not isinstance(error, target.Unsupported) and not jax_adapter.forgive(error):
                    raise
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
    leaves = jax_adapter.vary_alike([*map(jnp.asarray, (*traced, *leaves))])
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
    except Exception as error:
        if not jax_adapter.forgive(error):
            raise
        return str(error)
    if tangent is not None:
        rule = functools.partial(tangent, *static)
        program.derivative = _by_rule(rule, known, count, structure, avals, served, is_safe)
    elif has_rules:
        program.derivative = _by_jax(flat, avals, served, is_safe)
    program.fallback = _fallback(function, static, known, count, structure, avals, served)
    return program, jax.tree.structure(out)


def _fallback(function, static, known: Known, count: int, structure, avals, served: bool) -> Callable:
    """The function itself, from flat arrays to flat arrays, as `Program.fallback` wants it."""

    def one(*flat):
        leaves = [x.reshape(aval.shape) for x, aval in zip(flat, avals, strict=True)]
        with mode.compilation("plain"):
            results = function(*static, known(leaves[:count]), *jax.tree.unflatten(structure, leaves[count:]))
        # It needs no other way for any sample.
        return [*(jnp.reshape(x, -1) for x in jax.tree.leaves(results)), *([jnp.ones(1, bool)] if served else [])]

    return one


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

        return _change_program(change, avals, moving, served, is_safe)

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

        return _change_program(change, avals, moving, served, is_safe)

    return derivative


def _change_program(change: Callable, avals, moving, served: bool, is_safe: bool) -> Program:
    """The change as a program; NaN at samples that are flagged, where whoever runs the function is told of them.

    A rule may call functions with rules of their own, itself included, and then the change is differentiated by JAX again:
    its numbers would give the derivative of how a value is computed, where the rule says another one.
    """
    avals = [*avals, *(aval for aval, varies in zip(avals, moving, strict=True) if varies)]
    with mode.expanding(), mode.rank_safe(is_safe):
        closed = jax.make_jaxpr(change)(*avals)
    program, has_rules = expand(closed, 10 * mode.MAX_OPERATIONS, "change", flags=served)
    if has_rules:
        program.derivative = _by_jax(change, avals, served, is_safe)
    return program


# --- the primitive ---


@functools.lru_cache(maxsize=1024)
def _jitted(program, rows: int):
    return jax.jit(lambda *args: kernel_p.bind(*args, program=program, rows=rows))


def _implement(*args, program, rows):
    # A kernel is always compiled: under `jax.disable_jit()` it would be called by itself for ever.
    with jax.disable_jit(False):
        return _jitted(program, rows)(*args)


def _types(*avals, program, rows):
    is_one = not any(len(x.shape) > 1 for x in avals)
    if is_one and ahead.is_active() and not mode.is_expanding():
        assert target is not None
        with contextlib.suppress(target.Unsupported):  # which is said where the kernel is lowered
            target.make_ahead(target.kernel(program, target.width_of(program, 1), [False] * len(avals)))
    return sharding.results_of(avals, program.outputs)


def _batched(args, axes, *, program, rows):
    """A new leading axis for what varies; what all samples share stays a row."""
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    moved = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    varies = [axis is not None for axis in axes]
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


def _jvp(primals, tangents, *, program, rows):
    results = kernel_p.bind(*primals, program=program, rows=rows)
    moving, steps = tuple(not is_zero(x) for x in tangents), [x for x in tangents if not is_zero(x)]
    change = _change_of(program, moving)
    if change is None:
        changes = iter(_changes_by_jax(program, moving, primals, steps))
    else:
        changes = iter(kernel_p.bind(*primals, *steps, program=change, rows=rows))
    out = []
    for x, array in zip(results, program.outputs, strict=True):
        out.append(next(changes) if array.dtype.kind == "f" else zero_tangent(x))
    return results, out


def _change_of(program, moving: tuple[bool, ...]) -> Program | None:
    """The program of the change; None where it cannot be one of numbers, and JAX differentiates the function itself."""
    try:
        return derive.tangent(program, moving)
    except (NotNumbers, TooLong) as reason:
        if program.fallback is None:
            raise
        mode.say_once(f"the derivative of {program.name} runs on JAX's own operations: {reason}")
    except Exception as error:
        if program.fallback is None or not jax_adapter.forgive(error):
            raise
    return None


def _changes_by_jax(program, moving, primals, steps) -> list:
    places = [i for i, varies in enumerate(moving) if varies]

    def moved(*values):
        here = list(primals)
        for i, value in zip(places, values, strict=True):
            here[i] = value
        results = by_jax(*here, program=program)
        return [x for x, array in zip(results, program.outputs, strict=True) if array.dtype.kind == "f"]

    return jax.jvp(moved, [primals[i] for i in places], steps)[1]


def _transposed(program: Program, linear: tuple[bool, ...], given: tuple[bool, ...]) -> Program:
    """The transpose of a program (see `derive`), which honours the rules of the program when it is differentiated."""
    backwards = derive.transposed(program, linear, given)
    if program.derivative is not None and backwards.derivative is None:
        avals = [jax.ShapeDtypeStruct((array.size,), array.dtype) for array in backwards.inputs]
        backwards.derivative = functools.partial(_change_of_transposed, program, linear, given, backwards, avals)
    return backwards


def _change_of_transposed(program, linear, given, backwards, avals, moving) -> Program:
    """The change of x, c -> L(x)^T c for a program L(x) s, linear in s, whose change with x is known by a rule.

    It is (dL/dx dx)^T c + L(x)^T dc: the transpose of the change of the program where x moves and s does not, and the
    transpose of the program itself.
    """
    count = linear.count(False)  # inputs that are fixed, which come before the cotangents

    def change(*leaves):
        fixed, cotangents = list(leaves[:count]), list(leaves[count : len(avals)])
        following = iter(leaves[len(avals) :])
        steps = [next(following) if varies else None for varies in moving]
        total = None
        if any(moving[:count]):
            each = iter(moving[:count])
            first = derive.tangent(program, [False if is_linear else next(each) for is_linear in linear])
            floats = [x.dtype.kind == "f" for x in program.outputs]
            handed = [is_given for is_given, is_float in zip(given, floats, strict=True) if is_float]
            of_change = [*linear, *[False] * sum(moving[:count])]
            by_fixed = _transposed(first, tuple(of_change), tuple(handed))
            total = kernel_p.bind(
                *fixed, *(x for x in steps[:count] if x is not None), *cotangents, program=by_fixed, rows=0
            )
        if any(moving[count:]):
            of_cotangents = [
                jnp.zeros_like(c) if d is None else d for c, d in zip(cotangents, steps[count:], strict=True)
            ]
            by_cotangents = kernel_p.bind(*fixed, *of_cotangents, program=backwards, rows=0)
            total = by_cotangents if total is None else [a + b for a, b in zip(total, by_cotangents, strict=True)]
        return total

    return _change_program(change, avals, moving, served=False, is_safe=False)


def _transpose(cotangents, *operands, program, rows):
    linear = [is_linear(x) for x in operands]
    given = [not is_zero(x) for x in cotangents]
    backwards = _transposed(program, tuple(linear), tuple(given))
    fixed = [x for x, varies in zip(operands, linear, strict=True) if not varies]
    moved = [x for x in cotangents if not is_zero(x)]
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


# --- lowering ---

_OPERATIONS: dict[str, Callable] = {
    "add": lax.add, "sub": lax.sub, "mul": lax.mul, "div": lax.div, "neg": lax.neg, "max": lax.max, "min": lax.min,
    "pow": lax.pow, "atan2": lax.atan2, "rem": lax.rem, "and": lax.bitwise_and, "or": lax.bitwise_or, "not": lax.bitwise_not,
    "is_finite": lax.is_finite, "select": lambda which, no, yes: lax.select(which, yes, no), "sqrt": lax.sqrt, "sin": sine,
    "cos": cosine, "tan": lax.tan, "asin": lax.asin, "acos": lax.acos, "atan": lax.atan, "sinh": lax.sinh, "cosh": lax.cosh,
    "tanh": lax.tanh, "exp": lax.exp, "exp2": lax.exp2, "expm1": lax.expm1, "log": lax.log, "log1p": lax.log1p, "abs": lax.abs,
    "floor": lax.floor, "ceil": lax.ceil, "sign": lax.sign, "cbrt": lax.cbrt, "stop_gradient": lax.stop_gradient,
    "round": lambda x: lax.round(x, lax.RoundingMethod.TO_NEAREST_EVEN), "reduce_max": lambda *x: functools.reduce(lax.max, x),
    "reduce_min": lambda *x: functools.reduce(lax.min, x), "clamp": lambda low, x, high: lax.min(lax.max(x, low), high),
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


def by_jax(*args, program, rows: int = 0):
    """The function of which the program was made, by operations of JAX on arrays over the batch."""
    return as_operations(*args, program=program) if program.fallback is None else over_batch(program.fallback, args)


def over_batch(one: Callable, arrays) -> Any:
    """one(*arrays) of one sample, for arrays with the axes of a batch or without them."""
    axes = [0 if x.ndim > 1 else None for x in arrays]
    for _ in max((x.shape[:-1] for x in arrays), key=len, default=()):
        one = jax.vmap(one, axes)
    return one(*arrays)


def _lower_on_cpu(ctx, *operands, program, rows):
    try:
        return _lower_to_call(ctx, *operands, program=program, rows=rows)
    except Exception as error:
        if not jax_adapter.forgive(error):
            raise
        return lower_function(by_jax, ctx, *operands, program=program, rows=rows)


def _lower_to_call(ctx, *operands, program, rows):
    lead = ctx.avals_out[0].shape[:-1] if ctx.avals_out else ()
    uniform = [bool(lead) and len(x.shape) == 1 for x in ctx.avals_in]
    if any(uniform) and not all(uniform) and len(lead) == rows:  # the kernel of one sample shares nothing
        return lower_function(_repeated, ctx, *operands, program=program, rows=rows)
    apart = lead[: len(lead) - rows]  # rows of one sample go through the kernel of one sample
    samples = math.prod(apart) if all(isinstance(n, int) for n in apart) else None
    if samples != 1 and target is not None and target.is_supported() and divided(program, uniform) is not None:
        return lower_function(_divided, ctx, *operands, program=program, rows=rows)
    try:
        assert target is not None
        number = target.kernel(program, target.width_of(program, samples), uniform)
    except target.Unsupported as reason:  # pyright: ignore[reportOptionalMemberAccess]
        mode.say_once(f"functions run on JAX's own operations: {reason}")
        return lower_function(as_operations, ctx, *operands, program=program, rows=rows)
    if sharding.may_be_divided(ctx.avals_in, lead):
        return lower_function(_with_last_axis, ctx, *operands, program=program, rows=rows and rows + 1)
    order = target.varying_first(uniform)
    attributes = functools.partial(sharding.attributes, [ctx.avals_in[i] for i in order], ctx.avals_out)
    return jax_adapter.lower_call(target.TARGET, ctx, operands, order, attributes(), program=number)


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


kernel_p = define_primitive(
    "jaxdyn_kernel",
    _types,
    multiple_results=True,
    implement=_implement,
    lower=as_operations,
    lower_on_cpu=_lower_on_cpu,
    batch=_batched,
    jvp=_jvp,
    transpose=_transpose,
)
