"""The primitive of JAX that stands for a kernel, with its rules for batches, derivatives and lowering.

Its operands and results are flat, (..., size): batches become leading axes of the operands, and an operand that all samples
share stays without them. The derivative is the kernel of the program's tangent, which is linear in the steps, and the
transpose of that is the kernel of the transposed program. So derivatives of any order, forward and reverse, under any nesting
of `vmap`, are kernels. On a CPU the primitive is lowered to a call of native code, elsewhere to operations of JAX.
"""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import lax

from jaxdyn.compile import derive, jax_adapter, mode
from jaxdyn.compile.careful import guard
from jaxdyn.compile.jax_adapter import ShapedArray, define_primitive, is_linear, is_zero, lowering_of, zero_tangent
from jaxdyn.compile.operations import as_operations, by_jax
from jaxdyn.compile.program import Array, Constant, NotNumbers, Operation, Program, TooLong, derived, dtype_of
from jaxdyn.compile.rules import change_along, mark_invalid
from jaxdyn.compile.stored import key_within, load_or_make
from jaxdyn.compile.trace import tangent_program

# Fewer operations are not worth a second call: they are carried out for each block of samples.
MIN_SHARED_OPERATIONS = 2000

try:
    from jaxdyn.compile import target
except ImportError:  # no llvmlite for this platform
    target = None


# --- evaluation, types, batches ---


@functools.lru_cache(maxsize=1024)
def _jit_kernel(program, rows: int):
    return jax.jit(lambda *args: kernel_p.bind(*args, program=program, rows=rows))


def _implement(*args, program, rows):
    # Evaluation outside of a trace goes through `jit`. Under `jax.disable_jit()` that would evaluate the primitive again, and
    # so on for ever.
    with jax.disable_jit(False):
        return _jit_kernel(program, rows)(*args)


def _batch(args, axes, *, program, rows):
    """A new leading axis for operands that vary; an operand that all samples share stays one row."""
    size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
    batch_first = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(args, axes, strict=True)]
    varies = [axis is not None for axis in axes]
    inner = max((x.shape[v:-1] for x, v in zip(batch_first, varies, strict=True)), key=len)
    full = []
    for x, v in zip(batch_first, varies, strict=True):
        # Operands have all batch axes or none. One that varies along some of them alone is repeated along the others, as
        # the handler knows two strides only: a row for each sample, or zero.
        lead = x.shape[v:-1]
        if not v and lead:
            x = jnp.broadcast_to(x[None], (size, *x.shape))
        elif v and lead != inner:
            x = jnp.broadcast_to(x.reshape(size, *[1] * len(inner), x.shape[-1]), (size, *inner, x.shape[-1]))
        full.append(x)
    rows += mode.has_rows() and not mode.is_expanding()
    if program.turns > 1 and not mode.is_expanding() and target is not None and jax.default_backend() == "cpu":
        # A loop is the main part of a program: LLVM works on it while Python traces on.
        target.publish_ahead(program, target.width_of(program, size))
    results = kernel_p.bind(*full, program=program, rows=rows)
    return results, [0] * len(results)


# --- derivatives ---


def _jvp(primals, tangents, *, program, rows):
    results = kernel_p.bind(*primals, program=program, rows=rows)
    moving, steps = tuple(not is_zero(x) for x in tangents), [x for x in tangents if not is_zero(x)]
    tangent = None  # where there is none JAX differentiates the function itself
    try:
        tangent = derive.tangent(program, moving)
    except (NotNumbers, TooLong) as reason:
        if program.fallback is None:
            raise
        mode.say_without_kernel(f"the derivative of {program.name}", str(reason))
    except Exception as error:
        if program.fallback is None or not jax_adapter.forgive(error):
            raise
    if tangent is None:
        every = change_along(functools.partial(by_jax, program=program), primals, moving, steps)
        changes = (x for x, array in zip(every, program.outputs, strict=True) if array.dtype.kind == "f")
    else:
        changes = iter(kernel_p.bind(*primals, *steps, program=tangent, rows=rows))
    out = []
    for x, array in zip(results, program.outputs, strict=True):
        out.append(next(changes) if array.dtype.kind == "f" else zero_tangent(x))
    return results, out


@derived
def _transpose_program(program: Program, linear: tuple[bool, ...], given: tuple[bool, ...]) -> Program:
    """The transpose of a program (see `derive`), which honours the rules of the program when it is differentiated."""
    if program.fast is not None:
        fast, careful = _transpose_program(program.fast, linear, (*given, False)), program.careful
        return guard(fast, lambda: careful.transpose(linear, given, _transpose_program))
    backwards = derive.transpose(program, linear, given)
    # Differentiating the numbers of the transpose would ignore a rule inside the program: the second derivative of a root
    # by bisection was zero.
    if program.derivative is not None and backwards.derivative is None:
        avals = [jax.ShapeDtypeStruct((array.size,), array.dtype) for array in backwards.inputs]
        backwards.derivative = functools.partial(_tangent_of_transpose, program, linear, given, backwards, avals)
    return backwards


def _tangent_of_transpose(program, linear, given, backwards, avals, moving) -> Program:
    """The tangent of x, c -> L(x)^T c for a program L(x) s, linear in s, whose derivative in x is known by a rule.

    It is (dL/dx dx)^T c + L(x)^T dc: the transpose of the program's tangent where x moves and s does not, plus the transpose
    of the program itself.
    """
    count = linear.count(False)  # operands that are fixed, which come before the cotangents

    def change(*leaves):
        fixed, cotangents = list(leaves[:count]), list(leaves[count : len(avals)])
        remaining = iter(leaves[len(avals) :])
        steps = [next(remaining) if varies else None for varies in moving]
        total = None
        if any(moving[:count]):
            each = iter(moving[:count])
            first = derive.tangent(program, tuple([not is_linear and next(each) for is_linear in linear]))
            floats = [x.dtype.kind == "f" for x in program.outputs]
            given_floats = [is_given for is_given, is_float in zip(given, floats, strict=True) if is_float]
            given_floats += [False] * first.reports_validity
            linear_in_first = [*linear, *[False] * sum(moving[:count])]
            by_fixed = _transpose_program(first, tuple(linear_in_first), tuple(given_floats))
            total = _bind_and_mark(by_fixed, *fixed, *(x for x in steps[:count] if x is not None), *cotangents)
        if any(moving[count:]):
            cotangent_steps = [
                jnp.zeros_like(c) if d is None else d for c, d in zip(cotangents, steps[count:], strict=True)
            ]
            by_cotangents = _bind_and_mark(backwards, *fixed, *cotangent_steps)
            total = by_cotangents if total is None else [a + b for a, b in zip(total, by_cotangents, strict=True)]
        return total

    return tangent_program(change, avals, moving, flags="report" if program.reports_validity else "refuse")


def _bind_and_mark(program: Program, *args) -> list:
    """The results of a program within another one, marked where it reports them as not valid."""
    results = kernel_p.bind(*args, program=program, rows=0)
    if not program.reports_validity:
        return results
    *results, valid = results
    return [mark_invalid(jnp.logical_not(valid), x) for x in results]


def _transpose(cotangents, *operands, program, rows):
    linear = [is_linear(x) for x in operands]
    given = [not is_zero(x) for x in cotangents]
    backwards = _transpose_program(program, tuple(linear), tuple(given))
    fixed = [x for x, varies in zip(operands, linear, strict=True) if not varies]
    nonzero = [x for x in cotangents if not is_zero(x)]
    results = iter(kernel_p.bind(*fixed, *nonzero, program=backwards, rows=rows))
    out = []
    for x, varies in zip(operands, linear, strict=True):
        if not varies:
            out.append(None)
            continue
        # There is a cotangent for each sample, also of an operand that all of them share: that one is their sum.
        cotangent = next(results)
        shared = cotangent.ndim - len(x.aval.shape)
        out.append(jnp.sum(cotangent, axis=tuple(range(shared))) if shared else cotangent)
    return out


# --- batches that are sharded over devices ---
#
# Samples do not know of each other, so a call is divided along the axes of its batch and nothing is exchanged. Without the two
# attributes below XLA would gather the batch on every device around a call of machine code.
#
# - `num_batch_dims`: how many leading axes a target that is registered as batch-partitionable (`jax.ffi`) is divided along.
# - `sdy.sharding_rule`: which axes of arguments and results are the same ones, for Shardy, which spreads shardings over programs.
#
# Axes of meshes are of three kinds in JAX. Along automatic ones XLA divides, by these attributes. Along explicit ones, which
# `jax.make_mesh` makes, shardings are a part of types: results have the batch axes of the arguments. Along manual ones, within
# `jax.shard_map`, a result varies as the arguments do.


def _result_types(*avals, program, rows) -> list:
    """Types of the results, with the batch axes and the shardings of the arguments."""
    longest = max(avals, key=lambda x: x.ndim, default=None)
    lead = () if longest is None else longest.shape[:-1]
    if longest is None or jax_adapter.mesh_of(longest) is None:
        return [ShapedArray((*lead, array.size), array.dtype) for array in program.outputs]
    # Operands with the batch's axes agree along them, or leave an axis open: the first that says something decides.
    specs = [jax_adapter.spec_of(x) for x in avals if x.ndim == longest.ndim]
    along = [next((spec[k] for spec in specs if spec[k] is not None), None) for k in range(len(lead))]
    return [
        jax_adapter.type_like(longest, (*lead, array.size), array.dtype, (*along, None)) for array in program.outputs
    ]


def _is_divisible(avals: Sequence, lead: Sequence) -> bool:
    """Decide whether XLA may partition this call; False too where its batch has a last axis of length one.

    Such an axis is put there, as the partitioner counts batch axes from the front: the only axis of an argument that all samples
    share would be divided as if it were that of the batch; with fewer axes than the batch has, the argument is left alone. And an
    argument that is on every device becomes one that can be divided, by its reshape.
    """
    if not lead or lead[-1] == 1 or jax.device_count() == 1:
        return False
    mesh = jax_adapter.mesh_of(avals[0]) if avals else None
    return mesh is None or not jax_adapter.is_all_manual(mesh)


def _partition_attributes(avals: Sequence, results: Sequence) -> dict | None:
    """Attributes of the call; None where nothing can be divided."""
    lead = results[0].shape[:-1] if results else ()
    if not lead or not all(isinstance(n, int) for n in lead):  # `jax.export` has sizes without a number
        return None
    sizes = list(lead)

    # The entries of each array are an axis of its own in the rule, so that nothing is ever divided along them.
    def axes(x):
        sizes.append(x.shape[-1])  # an axis of its own, which is in no other array
        return [*range(len(lead)), len(sizes) - 1] if x.ndim > 1 else [len(sizes) - 1]

    operands, outputs = [axes(x) for x in avals], [axes(x) for x in results]
    return jax_adapter.sharding_attributes(len(lead), sizes, operands, outputs)


# --- lowering ---


def _lower_on_gpu(ctx, *operands, program, rows):
    if mode.current() != "native":  # until it has run on a device
        return lowering_of(as_operations)(ctx, *operands, program=program, rows=rows)
    return _lower_to_kernel(ctx, *operands, program=program, rows=rows, on_gpu=True)


def _lower_to_kernel(ctx, *operands, program, rows, **place):
    try:
        return _lower_to_call(ctx, *operands, program=program, rows=rows, **place)
    except Exception as error:
        if not jax_adapter.forgive(error):
            raise
        return lowering_of(by_jax)(ctx, *operands, program=program, rows=rows)


def _lower_elsewhere(*args, program, rows):
    if mode.current() == "native":
        mode.say_once("functions run on JAX's own operations: native kernels are for CPUs and for NVIDIA's GPUs")
    return as_operations(*args, program=program, rows=rows)


def _lower_to_call(ctx, *operands, program, rows, on_gpu=False):
    # Each rewriting below lowers a function that binds the primitive again, nearer to a call that the handler knows.
    lead = ctx.avals_out[0].shape[:-1] if ctx.avals_out else ()
    uniform = tuple([bool(lead) and len(x.shape) == 1 for x in ctx.avals_in])
    if any(uniform) and not all(uniform) and len(lead) == rows:
        # Rows go through the kernel of one sample, which is compiled already and has no notion of shared operands.
        return lowering_of(_broadcast_rows)(ctx, *operands, program=program, rows=rows)
    batch = lead[: len(lead) - rows]
    samples = math.prod(batch) if all(isinstance(n, int) for n in batch) else None  # `jax.export` has symbolic sizes
    if samples != 1 and target is not None and target.is_available() and split_program(program, uniform) is not None:
        return lowering_of(_call_in_two)(ctx, *operands, program=program, rows=rows)
    if on_gpu:
        return _lower_to_launch(ctx, *operands, program=program, rows=rows, uniform=uniform)
    try:
        assert target is not None
        width = target.width_of(program, samples)
        # A loop is the main part of a program and certain to be called: LLVM works on it while XLA compiles the rest. Another
        # kernel of the same width continues a run whose step has needed the fallback.
        is_certain = program.turns > 1 and all(key[:2] != ("kernel", width) for key in program.derived)
        number = target.kernel(program, width, uniform)
    except target.Unsupported as reason:  # pyright: ignore[reportOptionalMemberAccess]
        mode.say_once(f"functions run on JAX's own operations: {reason}")
        return lowering_of(as_operations)(ctx, *operands, program=program, rows=rows)
    if is_certain:
        target.make_ahead(number)
    if _is_divisible(ctx.avals_in, lead):
        return lowering_of(_with_last_axis)(ctx, *operands, program=program, rows=rows and rows + 1)
    order = target.varying_first(uniform)
    attributes = _partition_attributes([ctx.avals_in[i] for i in order], ctx.avals_out)
    return jax_adapter.lower_call(target.TARGET, ctx, operands, order, attributes, program=number)


def _lower_to_launch(ctx, *operands, program, rows, uniform):
    """The call of a kernel on a GPU."""
    assert target is not None, "kernels need llvmlite"
    from jaxdyn.compile import gpu  # here, as hardly anybody needs it

    try:
        number = gpu.kernel(program, uniform)
    except jax_adapter.Unsupported as reason:
        mode.say_once(f"functions run on JAX's own operations on GPUs: {reason}")
        return lowering_of(as_operations)(ctx, *operands, program=program, rows=rows)
    except gpu.TooLarge as reason:
        # Its entries are too many operations for XLA: the function itself has fewer.
        mode.say_once(f"{program.name} runs on JAX's own operations on GPUs: {reason}")
        return lowering_of(by_jax)(ctx, *operands, program=program, rows=rows)
    if _is_divisible(ctx.avals_in, ctx.avals_out[0].shape[:-1]):
        return lowering_of(_with_last_axis)(ctx, *operands, program=program, rows=rows and rows + 1)
    order = target.varying_first(uniform)
    attributes = _partition_attributes([ctx.avals_in[i] for i in order], ctx.avals_out)
    layouts = gpu.layouts(program, uniform, [x.shape for x in (*ctx.avals_in, *ctx.avals_out)])
    return jax_adapter.lower_call(gpu.TARGET, ctx, operands, order, attributes, layouts, program=number)


def _with_last_axis(*args, program, rows):
    """The call with one more batch axis, of length one (see `_is_divisible`)."""
    results = kernel_p.bind(
        *(x if x.ndim == 1 else lax.expand_dims(x, [x.ndim - 1]) for x in args), program=program, rows=rows
    )
    return [lax.squeeze(x, [x.ndim - 2]) for x in results]


def _broadcast_rows(*args, program, rows):
    """The call with operands of its own for every row."""
    lead = max((x.shape[:-1] for x in args), key=len)
    return kernel_p.bind(*(jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in args), program=program, rows=rows)


def _call_in_two(*args, program, rows):
    """The call as two, the first of the numbers that all samples share."""
    parts = split_program(program, tuple([x.ndim == 1 for x in args]))
    assert parts is not None
    once, each = parts
    shared = kernel_p.bind(*(x for x in args if x.ndim == 1), program=once, rows=0)
    return kernel_p.bind(*args, *shared, program=each, rows=rows)


kernel_p = define_primitive(
    "jaxdyn_kernel",
    _result_types,
    multiple_results=True,
    implement=_implement,
    lower=_lower_elsewhere,
    lower_on_cpu=_lower_to_kernel,
    lower_on_gpu=_lower_on_gpu,
    batch=_batch,
    jvp=_jvp,
    transpose=_transpose,
)


# --- operations whose results all samples of a batch share, such as those on the model alone: they run once per call ---
#
# A program is split in two. The first runs once and computes the shared numbers; the second runs for each sample and reads those
# that it needs. For forward dynamics of a given robot the first program has a third of the operations.


@derived
def split_program(program, uniform: tuple[bool, ...]) -> tuple[Program, Program] | None:
    """Split a program into one of the uniform inputs and one of all inputs and the results of the first.

    `uniform` marks the inputs that are equal for all samples. None where so few operations are shared that a second call
    would cost more.
    """
    if not isinstance(program, Program) or not any(uniform):
        return None
    # Two programs, or none.
    both, _ = load_or_make(key_within(program, "split", uniform), lambda: (_split(program, uniform) or (), None))
    return (both[0], both[1]) if both else None


def _split(program: Program, uniform: Sequence[bool]) -> tuple[Program, Program] | None:
    is_shared: list[bool] = []
    for op, _, args in program.operations:
        if op == "input":
            is_shared.append(uniform[args[0]])
        else:
            # Subprograms are not split: their calls stay in the program of the batch.
            is_shared.append(
                op not in ("call", "call_where", "part") and all(is_shared[x] for x in args if type(x) is not Constant)
            )
    saved = sum(
        shared and op not in ("input", "neg") for shared, (op, _, _) in zip(is_shared, program.operations, strict=True)
    )
    # Below this a second call costs more than the batch saves; for one sample nothing is saved at all.
    if saved < MIN_SHARED_OPERATIONS:
        return None
    # Shared operations that the second program reads or returns, in the order in which it reads them.
    read = [args for i, (op, _, args) in enumerate(program.operations) if not is_shared[i] and op != "input"]
    passed: dict[int, None] = {}
    for args in (*read, *program.results):
        passed |= {x: None for x in args if type(x) is not Constant and is_shared[x]}
    # One array for each kind of number, not one per number: the runtime handler checks every argument of a kernel.
    kinds = sorted({program.operations[i][1] for i in passed})
    by_kind = [[i for i in passed if program.operations[i][1] == kind] for kind in kinds]
    arrays = [Array((len(entries),), dtype_of(kind)) for kind, entries in zip(kinds, by_kind, strict=True)]

    places = [i for i, same in enumerate(uniform) if same]
    # Operations keep their order in both programs and get new indices.
    first = _Renumbering()
    for i, (op, kind, args) in enumerate(program.operations):
        if is_shared[i]:
            args = (places.index(args[0]), args[1]) if op == "input" else first.args(args)
            first.add(i, (op, kind, args))
    once = Program(
        [program.inputs[i] for i in places],
        arrays,
        first.operations,
        [tuple(first.index[i] for i in entries) for entries in by_kind],
        name=f"{program.name}, shared by all samples",
    )

    # The second program takes all inputs, also those that only the first one reads, so that argument positions do not change.
    count, rest = len(program.inputs), _Renumbering()
    for place, (kind, entries) in enumerate(zip(kinds, by_kind, strict=True), count):
        for k, i in enumerate(entries):
            rest.add(i, ("input", kind, (place, k)))
    for i, (op, kind, args) in enumerate(program.operations):
        if is_shared[i]:
            continue
        rest.add(i, (op, kind, args if op == "input" else rest.args(args)))
    each = Program(
        [*program.inputs, *arrays],
        program.outputs,
        rest.operations,
        [rest.args(row) for row in program.results],
        program.subprograms,
        name=program.name,
    )
    return once, each


class _Renumbering:
    """Operations of a part of a program, with indices of their own."""

    def __init__(self):
        self.operations: list[Operation] = []
        self.index: dict[int, int] = {}

    def add(self, i: int, operation: Operation) -> None:
        """Take operation i of the program, whose operands have the new indices."""
        self.index[i] = len(self.operations)
        self.operations.append(operation)

    def args(self, args) -> tuple:
        """Operands with their new indices."""
        return tuple(x if type(x) is Constant else self.index[x] for x in args)
