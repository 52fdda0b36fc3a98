"""`kernel_of`: a function of some hundred numbers as one piece of machine code, in which every value is computed once.

XLA:CPU makes a loop of every fusion and starts it anew in each call, which for one sample takes far longer than the arithmetic
in it. But inside the function that a `reduce` folds with it does not fuse: that function is one basic block for LLVM, which
computes each value once and keeps it in a register. So the recursion is traced into single numbers (`scalar_program`) and
put there, folding an axis that holds the arguments twice. A batch is a loop around the block.

The fold is legal in any order and grouping that XLA may choose. An entry is nothing (the initial value), a set of arguments
or a result; folding makes a result of arguments, and keeps a result. A floating-point answer that has not become a
result is NaN. LLVM sees that the last fold alone counts and drops the others. An axis of length one would not do: XLA
takes folding with the initial value for the identity.

The primitive batches. It has no derivative: put it under one that is given. On other platforms than CPU it is the function
that the caller gives for them.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal, Primitive
from jax.interpreters import batching, mlir

from jaxdyn._tracing import Known, split

MOST_AT_ONCE = 4400  # operations in one block; from about 4500 on XLA cuts it in pieces that compute values again
MOST = 9000  # operations in all; longer ones compile for minutes

_NOTHING, _ARGUMENTS, _RESULT = (np.int8(i) for i in range(3))

_one_kernel_p = Primitive("one_kernel")
_one_kernel_p.multiple_results = True


class _TooMuch(Exception):
    """An operation that is not one of single numbers, or too many of them."""


class Kernel(NamedTuple):
    """A function of arrays in single numbers; see `kernel_of`."""

    program: ClosedJaxpr
    shapes: tuple
    structure: Any

    def __call__(self, otherwise: Callable, *args):
        """What the function is of `args`; on other platforms than CPU otherwise(*args)."""
        found = _one_kernel_p.bind(*args, program=self.program, otherwise=otherwise, shapes=self.shapes, depth=0)
        return jax.tree.unflatten(self.structure, found)


def kernel_of(function: Callable, tree, *args) -> Kernel | None:
    """function(tree, *args) for arrays of the shapes of `args`, one sample, as a kernel.

    None if the tree holds numbers that are traced, if the function computes with more than single numbers, such as a
    factorisation by LAPACK, or if it is too long. It is traced once for a tree and shapes.
    """
    traced, known = split(tree)
    if traced or len(jax.tree.leaves(args)) != len(args):
        return None
    return _kernel(function, known, tuple((np.shape(x), np.dtype(x.dtype)) for x in args))


@functools.lru_cache(maxsize=256)  # kernels hold their trees
def _kernel(function: Callable, known: Known, shapes) -> Kernel | None:
    args = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]
    try:
        return Kernel(*scalar_program(lambda *args: function(known(()), *args), *args))
    except _TooMuch:
        return None


# --- from arrays to single numbers ---------------------------------------------------------------


def scalar_program(function: Callable, *args):
    """The program of `function` in single numbers: its jaxpr, (shape, dtype) of the outputs and their structure."""
    jaxpr, out = jax.make_jaxpr(function, return_shape=True)(*args)
    leaves, structure = jax.tree.flatten(out)
    if _length(jaxpr.jaxpr) > MOST:
        raise _TooMuch

    def run(*numbers):
        given, at = [], 0
        for arg in args:
            size = math.prod(np.shape(arg))
            given.append(_objects(numbers[at : at + size], np.shape(arg)))
            at += size
        found = _evaluate(jaxpr.jaxpr, [np.asarray(const) for const in map(_known, jaxpr.consts)], given)
        return [
            jnp.asarray(number, leaf.dtype)
            for array, leaf in zip(found, leaves, strict=True)
            for number in array.ravel().tolist()
        ]

    numbers = [ShapedArray((), arg.dtype) for arg in args for _ in range(math.prod(np.shape(arg)))]
    program = jax.make_jaxpr(run)(*numbers)
    if program.consts or len(program.eqns) > MOST:
        raise _TooMuch
    return program, tuple((leaf.shape, leaf.dtype) for leaf in leaves), structure


def _length(jaxpr) -> int:
    """Operations of a program and of those inside it; on arrays of several numbers each counts once, so there may be more."""
    inner = (x.params[_INNER[x.primitive.name]] for x in jaxpr.eqns if x.primitive.name in _INNER)
    return len(jaxpr.eqns) + sum(_length(getattr(x, "jaxpr", x)) for x in inner)


def _known(const):
    if isinstance(const, jax.core.Tracer):
        raise _TooMuch
    return const


def _objects(entries, shape) -> np.ndarray:
    array = np.empty(len(entries), object)
    for i, entry in enumerate(entries):  # in one assignment numpy would look into them
        array[i] = entry
    return array.reshape(shape)


_ELEMENTWISE = frozenset(
    "add sub mul div neg sqrt rsqrt abs sign floor ceil round max min pow integer_pow square exp log sin cos tan tanh atan2 "
    "rem clamp select_n eq ne lt le gt ge and or not xor is_finite convert_element_type copy stop_gradient".split()
)
_REDUCTIONS = {"reduce_sum": lax.add, "reduce_min": lax.min, "reduce_max": lax.max}
_INNER = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "checkpoint": "jaxpr",
}


def _evaluate(jaxpr, consts, args) -> list[np.ndarray]:
    values: dict = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))

    def read(atom):
        return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        found = _one(eqn.primitive, eqn.params, [read(x) for x in eqn.invars], [x.aval for x in eqn.outvars])
        values.update(zip(eqn.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _one(primitive, params, args, outs):
    name, shape = primitive.name, outs[0].shape
    if name in _INNER:
        inner = params[_INNER[name]]
        consts, inner = (inner.consts, inner.jaxpr) if isinstance(inner, ClosedJaxpr) else ((), inner)
        return _evaluate(inner, [np.asarray(_known(const)) for const in consts], args)
    if name == "materialize":
        return args
    if name in _ELEMENTWISE:
        size = math.prod(shape)
        columns = [_entries(arg) * (size if arg.size == 1 else 1) for arg in args]
        return [_objects([primitive.bind(*each, **params) for each in zip(*columns, strict=True)], shape)]
    if name in _REDUCTIONS:
        axes, fold = params["axes"], _REDUCTIONS[name]
        rows = np.moveaxis(args[0], axes, range(len(axes))).reshape(-1, math.prod(shape))
        return [_objects([functools.reduce(fold, _entries(column)) for column in rows.T], shape)]
    if name in ("reshape", "squeeze"):
        return [args[0].reshape(shape)]
    if name == "broadcast_in_dim":
        kept = [1] * len(shape)
        for place, size in zip(params["broadcast_dimensions"], args[0].shape, strict=True):
            kept[place] = size
        return [np.broadcast_to(args[0].reshape(kept), shape)]
    if name == "slice":
        strides = params["strides"] or (1,) * args[0].ndim
        places = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
        return [args[0][tuple(slice(*place) for place in places)]]
    if name == "unstack":
        rows = np.moveaxis(args[0], params["axis"], 0)
        return [rows[i, ...] for i in range(len(rows))]
    if name == "rev":
        return [np.flip(args[0], params["dimensions"])]
    if name == "transpose":
        return [args[0].transpose(params["permutation"])]
    if name in ("concatenate", "stack"):
        args = [_objects(_entries(arg), arg.shape) for arg in args]
        if name == "stack":
            return [np.stack(args, params["axis"])]
        return [np.concatenate(args, params["dimension"])]
    raise _TooMuch(name)


def _entries(array) -> list:
    """The numbers of an array in order: traced ones as they are, known ones of its dtype."""
    if array.dtype.kind == "O":
        return array.ravel().tolist()
    return [array.dtype.type(x) for x in array.ravel().tolist()]


# --- the fold --------------------------------------------------------------------------------------


def _blocks(program: ClosedJaxpr):
    """The program cut into blocks: (operations, what they take, what of theirs is needed later)."""
    for count in range(-(-len(program.eqns) // MOST_AT_ONCE) or 1, len(program.eqns) + 2):
        blocks = _cut(program.jaxpr, count)
        if all(len(eqns) + 4 * max(len(takes), len(gives)) <= MOST_AT_ONCE for eqns, takes, gives in blocks):
            return blocks
    raise AssertionError("single operations are small blocks")


def _cut(jaxpr, count: int):
    each = -(-len(jaxpr.eqns) // count)
    pieces = [jaxpr.eqns[i * each : (i + 1) * each] for i in range(count)]
    needed = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    blocks = []
    for piece in reversed(pieces):
        made = [x for eqn in piece for x in eqn.outvars]
        gives = [x for x in made if x in needed]
        takes = dict.fromkeys(x for eqn in piece for x in eqn.invars if not isinstance(x, Literal))
        for x in made:
            takes.pop(x, None)
        needed = (needed - set(made)) | set(takes)
        blocks.append((piece, list(takes), gives))
    return blocks[::-1]


def _as_folds(*arrays, program: ClosedJaxpr, shapes, depth: int, otherwise: Callable):
    del otherwise
    lead = arrays[0].shape[:depth]
    jaxpr = program.jaxpr
    sizes = [math.prod(x.shape[depth:]) for x in arrays]  # reshape cannot find them where there are no samples
    numbers = [x.reshape(*lead, size)[..., i] for x, size in zip(arrays, sizes, strict=True) for i in range(size)]
    values = dict(zip(jaxpr.invars, numbers, strict=True))
    sound = jnp.ones(lead, bool)
    for eqns, takes, gives in _blocks(program):
        done, given = _fold(eqns, takes, gives, values, lead)
        sound = sound & done
        values.update(given)
    found, at = [], 0
    for shape, dtype in shapes:
        some = jaxpr.outvars[at : (at := at + math.prod(shape))]
        entries = [jnp.full(lead, x.val, dtype) if isinstance(x, Literal) else values[x] for x in some]
        array = jnp.stack(entries, -1) if entries else jnp.zeros((*lead, 0), dtype)
        if jnp.issubdtype(dtype, jnp.floating):
            array = jnp.where(sound[..., None], array, np.asarray(np.nan, dtype))
        found.append(array.reshape(*lead, *shape))
    return found


def _fold(eqns, takes, gives, values, lead):
    """Whether they are results (the batch's shape `lead`), and the values of `gives`, each of that shape."""
    # A result takes the place of an argument of its dtype.
    kinds = [*{x.aval.dtype: None for x in (*takes, *gives)}]
    slots = []  # pairs of an argument and a result, either of which may be missing
    for dtype in kinds:
        ins, outs = ([x for x in side if x.aval.dtype == dtype] for side in (takes, gives))
        slots += [
            (ins[i] if i < len(ins) else None, outs[i] if i < len(outs) else None, dtype)
            for i in range(max(len(ins), len(outs)))
        ]

    def fold(one, other):
        (kind, *one), (other_kind, *other) = one, other
        first, done = kind == _ARGUMENTS, kind == _RESULT
        given = first | (other_kind == _ARGUMENTS)
        inner = {x: lax.select(first, a, b) for (x, _, _), a, b in zip(slots, one, other, strict=True) if x is not None}

        def read(x):
            return x.val if isinstance(x, Literal) else inner[x]

        for eqn in eqns:
            found = eqn.primitive.bind(*map(read, eqn.invars), **eqn.params)
            inner.update(zip(eqn.outvars, found if eqn.primitive.multiple_results else [found], strict=True))
        results = [
            lax.select(given, inner[y] if y is not None else np.zeros((), dtype), lax.select(done, a, b))
            for (_, y, dtype), a, b in zip(slots, one, other, strict=True)
        ]
        return lax.select(given | done, _RESULT, other_kind), *results

    def twice(x, dtype):
        return jnp.zeros((*lead, 2), dtype) if x is None else jnp.broadcast_to(values[x][..., None], (*lead, 2))

    operands = [jnp.full((*lead, 2), _ARGUMENTS), *(twice(x, dtype) for x, _, dtype in slots)]
    start = [_NOTHING, *(np.zeros((), dtype) for _, _, dtype in slots)]
    found = lax.reduce(operands, start, fold, (len(lead),))
    # A canonicalisation of StableHLO explores every path through the fold for results that nothing uses. The barrier uses all.
    kind, *found = lax.optimization_barrier(found)
    return kind == _RESULT, {y: x for x, (_, y, _) in zip(found, slots, strict=True) if y is not None}


# --- the primitive -----------------------------------------------------------------------------------


def _elsewhere(*arrays, program, shapes, depth: int, otherwise: Callable):
    for _ in range(depth):
        otherwise = jax.vmap(otherwise)
    return jax.tree.leaves(otherwise(*arrays))


def _abstract(*avals, program, shapes, depth: int, otherwise):
    return [ShapedArray((*avals[0].shape[:depth], *shape), dtype) for shape, dtype in shapes]


def _batch(arrays, axes, *, depth, **params):
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not batching.not_mapped)
    arrays = [
        jnp.broadcast_to(x, (size, *x.shape)) if axis is batching.not_mapped else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(arrays, axes, strict=True)
    ]
    found = _one_kernel_p.bind(*arrays, depth=depth + 1, **params)
    return found, [0] * len(found)


@functools.lru_cache(maxsize=64)
def _program(**params):
    return jax.jit(functools.partial(_one_kernel_p.bind, **params))


_one_kernel_p.def_impl(lambda *arrays, **params: _program(**params)(*arrays))
_one_kernel_p.def_abstract_eval(_abstract)
mlir.register_lowering(_one_kernel_p, mlir.lower_fun(_elsewhere, multiple_results=True))
mlir.register_lowering(_one_kernel_p, mlir.lower_fun(_as_folds, multiple_results=True), platform="cpu")
batching.primitive_batchers[_one_kernel_p] = _batch
