"""`kernel_of`: a function of some hundred numbers as one piece of machine code, in which every value is computed once.

XLA:CPU makes a loop of every fusion and starts it anew in each call, which for one sample takes far longer than the arithmetic
in it. But inside the function that a `reduce` folds with it does not fuse: that function is one basic block for LLVM, which
computes each value once and keeps it in a register. So the recursion is traced into single numbers (`_scalar_program`) and
put there, folding an axis that holds the arguments twice. A batch is a loop around the block.

The fold is legal in any order and grouping that XLA may choose. An entry is nothing (the initial value), a set of arguments
or a result; folding makes a result of arguments, and keeps a result. A floating-point answer that has not become a
result is NaN. LLVM sees that the last fold alone counts and drops the others. An axis of length one would not do: XLA
takes folding with the initial value for the identity.

For each operation of the fold the runtime sets up a buffer, which nothing uses, whenever the program that holds it is called,
however often the kernel then runs. In a loop that is soon made up for. One call of one sample takes longer for it than by other
ways, so outside of a loop a kernel of numbers is what it stands for, unless the batch is large.

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
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal, Primitive
from jax.extend.mlir import ir
from jax.interpreters import batching, mlir

from jaxdyn._fold import fold
from jaxdyn._in_vectors import as_vectors
from jaxdyn._scalar_program import TooMuch, scalar_program
from jaxdyn._tracing import Known, split
from jaxdyn._vector_program import VectorProgram, vector_program
from jaxdyn._ways import way

MOST_AT_ONCE = 4400  # operations in one block; from about 4500 on XLA cuts it in pieces that compute values again
MOST = 9000  # operations in all; longer ones compile for minutes
MOST_TAKEN = 220  # numbers that a block takes from those before it; with more it compiles for minutes too
MOST_IN_VECTORS = 60000  # operations that may become those of vectors
MOST_VECTORS = 2000  # and how many of these there may be
LEAST_EQUAL = 4  # of them in one operation, on average
AT_ONE_CALL = 4096  # samples from which on a kernel pays that is not in a loop

_one_kernel_p = Primitive("one_kernel")
_one_kernel_p.multiple_results = True


class Kernel(NamedTuple):
    """A function of arrays in single numbers, or in vectors of them; see `kernel_of`.

    `often`: whether a program may run it so often that setting it up does not count; of no effect on numbers.
    """

    program: ClosedJaxpr | VectorProgram
    shapes: tuple
    structure: Any
    often: bool = True

    def __call__(self, otherwise: Callable, *args):
        """What the function is of `args`; on other platforms than CPU otherwise(*args)."""
        program, _, structure, often = self
        found = _one_kernel_p.bind(
            *args, program=program, otherwise=otherwise, shapes=self.shapes, depth=0, often=often
        )
        return jax.tree.unflatten(structure, found)


def kernel_of(
    function: Callable, tree, *args, most: int | None = None, for_batches: bool = False, in_vectors: bool = False
) -> Kernel | None:
    """function(tree, *args) for arrays of the shapes of `args`, one sample, as a kernel of at most `most` operations (`MOST`).

    None where `without_kernels` is in force, if the tree holds numbers that are traced, if the function computes with more than
    single numbers, such as a factorisation by LAPACK, or if it is too long. It is traced once for a tree and shapes. With
    `for_batches` it is made for many samples: see `scalar_program`. With `in_vectors` it is a program of vectors, of several
    kernels (see `_vector_program`), if that is much shorter: for functions that have no kernel otherwise.
    """
    traced, known = split(tree)
    if way() == "without kernels" or traced or len(jax.tree.leaves(args)) != len(args):
        return None
    shapes = tuple((np.shape(x), np.dtype(x.dtype)) for x in args)
    return _kernel(function, known, shapes, MOST if most is None else most, for_batches, in_vectors)


def kernel_or_vectors(function: Callable, tree, *args, long: bool) -> Kernel | None:
    """`kernel_of` in single numbers, or else in vectors; the other way round for what is likely to be too `long` for numbers."""
    for in_vectors in (long, not long):
        kernel = kernel_of(function, tree, *args, in_vectors=in_vectors)
        if kernel is not None:
            return kernel
    return None


@functools.lru_cache(maxsize=256)  # kernels hold their trees
def _kernel(function: Callable, known: Known, shapes, most: int, for_batches: bool, in_vectors: bool) -> Kernel | None:
    args = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes]

    def whole(*args):
        return function(known(()), *args)

    most = MOST_IN_VECTORS if in_vectors else most
    try:
        # jax keeps traces of functions, and in vectors another one is wanted: the function is new each time.
        program, shapes, structure = scalar_program(
            whole, *args, most=most, for_batches=for_batches, in_vectors=in_vectors
        )
    except TooMuch:
        return None
    if in_vectors:
        sizes, results = [math.prod(x.shape) for x in args], [math.prod(shape) for shape, _ in shapes]
        short = vector_program(program, sizes, results)
        longest = min(MOST_VECTORS, len(program.eqns) // LEAST_EQUAL)
        return Kernel(short, shapes, structure) if short.operations <= longest else None
    many = any(len(takes) > MOST_TAKEN for _, takes, _ in _blocks(program)[1:])
    return None if many else Kernel(program, shapes, structure)


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


def as_folds(*arrays, program: ClosedJaxpr | VectorProgram, shapes, depth: int, often: bool = True, **_) -> list:
    """What a kernel's program gives for arrays with `depth` leading axes, as it is put down on CPU."""
    if isinstance(program, VectorProgram):
        return as_vectors(*arrays, program=program, shapes=shapes, depth=depth, often=often)
    lead = arrays[0].shape[:depth]
    jaxpr = program.jaxpr
    sizes = [math.prod(x.shape[depth:]) for x in arrays]  # reshape cannot find them where there are no samples
    numbers = [x.reshape(*lead, size)[..., i] for x, size in zip(arrays, sizes, strict=True) for i in range(size)]
    values = dict(zip(jaxpr.invars, numbers, strict=True))
    sound = jnp.ones(lead, bool)
    for eqns, takes, gives in _blocks(program):
        done, given = fold(eqns, takes, gives, values, lead)
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


# --- the primitive -----------------------------------------------------------------------------------


def _elsewhere(*arrays, depth: int, otherwise: Callable, **_):
    for _ in range(depth):
        otherwise = jax.vmap(otherwise)
    return jax.tree.leaves(otherwise(*arrays))


def _on_cpu(ctx, *arrays, **params):
    samples = math.prod(ctx.avals_in[0].shape[: params["depth"]])
    # What has a program of vectors is long, and would compile for longer in other ways than a kernel is set up.
    numbers = isinstance(params["program"], ClosedJaxpr)
    way = _elsewhere if numbers and samples < AT_ONE_CALL and _is_done_once() else as_folds
    return mlir.lower_fun(way, multiple_results=True)(ctx, *arrays, **params)


def _is_done_once() -> bool:
    """Whether what is being lowered is known to be no part of a loop: in the program's main function, outside of all loops in it.

    Functions of their own, as jax makes of a nested `jit` and of branches, may be called in one.
    """
    place: Any = ir.InsertionPoint.current  # pyright: ignore[reportAttributeAccessIssue]
    place = place.block.owner.operation
    while place.name != "func.func":
        if place.name == "stablehlo.while":
            return False
        place = place.parent.operation
    return ir.StringAttr(place.attributes["sym_name"]).value == "main"


def _abstract(*avals, shapes, depth: int, **_):
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
mlir.register_lowering(_one_kernel_p, _on_cpu, platform="cpu", cacheable=False)
batching.primitive_batchers[_one_kernel_p] = _batch
