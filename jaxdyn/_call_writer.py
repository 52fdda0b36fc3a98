"""`written`: a program in those operations alone that XLA:CPU can put into one piece of machine code (see `_one_call`).

There it calls no library, runs no callback and has neither sort nor scatter. So factorisations become loops, products of matrices
sums, scattered entries slices that are replaced; jax's functions of functions are taken apart, and the choices that primitives of
this library stand for are made. An error check of equinox becomes a flag. Everything else that is not on the list of operations
that were tried is refused.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from jaxdyn import _factor_loops
from jaxdyn._by_batch import of_samples
from jaxdyn._factor_loops import entry
from jaxdyn._one_kernel import as_folds
from jaxdyn._scalar_program import INNER
from jaxdyn._vector_program import VectorProgram

MOST_PRODUCTS = 10000  # of a product of two matrices; libraries are better at larger ones
MOST_TERMS = 4  # of a sum that is written out; longer ones are loops
MOST_OPERATIONS = 9000  # of a program before it is written; the time that LLVM takes grows faster than the function
MOST_NUMBERS = (
    2500  # operations of a kernel that are written as they are; XLA's passes take longer over more than over a fold
)
MOST_WINDOWS = 4  # windows of a scatter that are written out

# Tried in tests/test_one_call.py.
_AS_THEY_ARE = frozenset(
    "add add_any sub mul div neg sqrt rsqrt cbrt abs sign floor ceil round max min pow integer_pow square exp exp2 expm1 log "
    "log1p logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh erf rem clamp nextafter select_n eq ne "
    "lt le gt ge and or xor not is_finite convert_element_type copy copy_p broadcast_in_dim reshape squeeze expand_dims slice "
    "concatenate pad rev transpose iota dynamic_slice dynamic_update_slice gather split stack unstack "
    "cumsum cumprod cummax cummin "
    "shift_left shift_right_logical shift_right_arithmetic".split()
)
_OF_LIBRARIES = frozenset(
    "dot_general cholesky lu triangular_solve qr custom_linear_solve lu_pivots_to_permutation sort eigh svd".split()
)
_SAME = frozenset("anywhere materialize optimization_barrier stop_gradient".split())
_INNER = {name: inner for name, inner in INNER.items() if name != "one_kernel"}
_INNER |= {"custom_vmap_call": "call", "remat2": "jaxpr"}
# Of equinox; functions of arrays that jax can trace.
_TRACEABLE = frozenset(
    "unvmap_any unvmap_all unvmap_max nonbatchable nontraceable nondifferentiable nondifferentiable_backward select_if_vmap "
    "maybe_set vprim".split()
)
# Written out, as XLA's runtime sets up buffers for the function of each reduction, in each call.
_FOLDS: dict[str, Callable] = {
    "reduce_sum": lax.add,
    "reduce_prod": lax.mul,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_and": lax.bitwise_and,
    "reduce_or": lax.bitwise_or,
}
_SCATTERED: dict[str, Callable] = {
    "scatter": lambda old, new: new,
    "scatter-add": jnp.add,
    "scatter-mul": jnp.multiply,
    "scatter-min": jnp.minimum,
    "scatter-max": jnp.maximum,
}
_CHECK = "branched_error_if_impl"  # what equinox calls its error checks


class NotWritten(Exception):
    """A program that has something else."""


def written(program: ClosedJaxpr, args: Sequence, by_libraries: bool = False) -> tuple[list, Array | None]:
    """What the program is of `args`, computed by such operations; whether an error check fails, None if there is none.

    With `by_libraries`, factorisations and the like stay as they are: for a program beside a call.

    **Raises:** NotWritten.
    """
    writer = _Writer(by_libraries)
    found = writer.closed(program, list(args), True)
    return found, reduce(jnp.logical_or, writer.failed) if writer.failed else None


class _Writer:
    """Evaluates jaxprs. `outermost` says that what is evaluated is in no loop or branch."""

    def __init__(self, by_libraries: bool = False):
        self.by_libraries = by_libraries
        self.failed: list[Array] = []
        self.checking = False

    def closed(self, program: ClosedJaxpr, args: Sequence, outermost: bool = False) -> list:
        return self.evaluate(program.jaxpr, program.consts, args, outermost)

    def evaluate(self, jaxpr, consts, args, outermost: bool = False) -> list:
        values: dict = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))

        def read(atom):
            return _known(atom) if isinstance(atom, Literal) else values[atom]

        for eqn in jaxpr.eqns:
            if eqn.effects:
                raise NotWritten(f"effects of {eqn.primitive.name}")
            found = self._one(eqn.primitive, eqn.params, [read(x) for x in eqn.invars], outermost)
            values.update(zip(eqn.outvars, found, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _one(self, primitive, params, args, outermost: bool) -> list:
        name = primitive.name
        if name in _AS_THEY_ARE or (self.by_libraries and name in _OF_LIBRARIES):
            found = primitive.bind(*args, **params)
            return list(found) if primitive.multiple_results else [found]
        if name in _SAME:
            return args
        if name in _INNER:
            inner = params[_INNER[name]]
            before, self.checking = self.checking, self.checking or (outermost and params.get("name") == _CHECK)
            consts, inner = (inner.consts, inner.jaxpr) if isinstance(inner, ClosedJaxpr) else ((), inner)
            found = self.evaluate(inner, consts, args, outermost)
            self.checking = before
            return found
        if name in _TRACEABLE:
            return self._traced(partial(primitive.impl, **params), args)
        rule = getattr(self, "_" + name.replace("-", "_"), None)
        if rule is not None:
            return rule(args, outermost, **params)
        if name in _FOLDS:
            return [_folded(_FOLDS[name], args[0], params["axes"], primitive, params)]
        if name in ("argmax", "argmin"):
            return [_place_of_most(lax.gt if name == "argmax" else lax.lt, args[0], **params)]
        if name in _SCATTERED:
            return [_scattered(_SCATTERED[name], *args, **params)]
        if name in _FACTORS:
            return _over_batch(_FACTORS[name](params), args, primitive.name)
        raise NotWritten(name)

    def _traced(self, function: Callable, args, outermost: bool = False) -> list:
        return self.closed(jax.make_jaxpr(function)(*args), args, outermost)

    # --- choices of this library ---

    def _large_batch(self, args, outermost, *, count, on_cpu):
        return [np.bool_(on_cpu)]

    def _by_batch(self, args, outermost, *, small, axes, **_):
        return self._traced(of_samples(jaxpr_as_fun(small), axes), args, outermost)

    def _one_call(self, args, outermost, *, ways, axes, **_):
        return self._traced(of_samples(ways[0], axes), args, outermost)

    def _one_kernel(self, args, outermost, *, program, shapes, depth, **_):
        if isinstance(program, VectorProgram):
            raise NotWritten("vectors")  # of which LLVM makes loops, and takes minutes to take them apart
        if len(program.eqns) > MOST_NUMBERS:
            return as_folds(*args, program=program, shapes=shapes, depth=depth)
        lead = args[0].shape[:depth]
        sizes = [math.prod(x.shape[depth:]) for x in args]
        numbers = [x.reshape(*lead, size)[..., i] for x, size in zip(args, sizes, strict=True) for i in range(size)]
        values: dict = dict(zip(program.jaxpr.invars, numbers, strict=True))

        def read(atom):
            return np.broadcast_to(_known(atom), lead) if isinstance(atom, Literal) else values[atom]

        for eqn in program.jaxpr.eqns:
            values[eqn.outvars[0]] = eqn.primitive.bind(*map(read, eqn.invars), **eqn.params)
        found, at = [], 0
        for shape, dtype in shapes:
            size = math.prod(shape)
            some = [read(x) for x in program.jaxpr.outvars[at : at + size]]
            at += size
            array = jnp.stack(some, -1) if some else jnp.zeros((*lead, 0), dtype)
            found.append(array.reshape(*lead, *shape).astype(dtype))
        return found

    def _platform_index(self, args, outermost, *, platforms, **_):
        for i, names in enumerate(platforms):
            if names is None or "cpu" in names:
                return [np.int32(i)]
        raise NotWritten("platform_index")

    # --- control flow ---

    def _cond(self, args, outermost, *, branches, **_):
        index, *args = args
        if not isinstance(index, Tracer):
            return self.closed(branches[int(np.clip(index, 0, len(branches) - 1))], args, outermost)
        if self.checking:
            quiet = [i for i, branch in enumerate(branches) if not _calls_back(branch.jaxpr)]
            if len(quiet) == 1 and len(branches) == 2:
                self.failed.append(jnp.asarray(index) != quiet[0])
                return self.closed(branches[quiet[0]], args, outermost)
        return list(lax.switch(index.astype(jnp.int32), [partial(self._branch, branch) for branch in branches], *args))

    def _branch(self, branch, *args):
        return self.closed(branch, args)

    def _while(self, args, outermost, *, cond_jaxpr, body_jaxpr, cond_nconsts, body_nconsts, **params):
        states = body_jaxpr.in_avals[body_nconsts:]
        # A body that returns one array alone XLA would divide between threads, so there is always a second one.
        last = jnp.zeros(cond_jaxpr.out_avals[0].shape, jnp.int32)

        def ask(*args):
            return self.closed(cond_jaxpr, args[:-1])

        def step(*args):
            *args, count = args
            return *self.closed(body_jaxpr, args), count + 1

        conds, bodies = (
            jax.make_jaxpr(function)(*jaxpr.in_avals, last)
            for function, jaxpr in ((ask, cond_jaxpr), (step, body_jaxpr))
        )
        # Bound as it is, since what it asks may differ between samples.
        counts = {"cond_nconsts": cond_nconsts, "body_nconsts": body_nconsts}
        found = lax.while_p.bind(*args, last, cond_jaxpr=conds, body_jaxpr=bodies, **counts, **params)
        return found[: len(states)]

    def _scan(self, args, outermost, *, jaxpr, length, reverse, unroll, num_consts, num_carry, **_):
        consts, carry, rows = (
            args[:num_consts],
            args[num_consts : num_consts + num_carry],
            args[num_consts + num_carry :],
        )

        def step(carry, row):
            found = self.closed(jaxpr, [*consts, *carry, *row])
            return found[:num_carry], found[num_carry:]

        last, rows = lax.scan(step, carry, rows, length=length, reverse=reverse, unroll=unroll)
        return [*last, *rows]

    # --- linear algebra ---

    def _custom_linear_solve(self, args, outermost, *, const_lengths, jaxprs):
        counts = list(const_lengths)
        start = sum(counts[:2])  # after what the products with the matrix hold
        held = args[start : start + counts[2]]
        return self.closed(jaxprs.solve, [*held, *args[sum(counts) :]])

    def _dot_general(self, args, outermost, *, dimension_numbers, preferred_element_type=None, **_):
        left, right = args
        (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers
        dtype = jnp.result_type(left, right) if preferred_element_type is None else preferred_element_type
        a, b = (
            jnp.transpose(
                x, (*batch, *[i for i in range(x.ndim) if i not in batch and i not in summed], *summed)
            ).astype(dtype)
            for x, batch, summed in ((left, left_batch, left_sum), (right, right_batch, right_sum))
        )
        lead, length = a.shape[: len(left_batch)], math.prod(left.shape[i] for i in left_sum)
        free = [x.shape[len(lead) : x.ndim - len(left_sum)] for x in (a, b)]
        a, b = (x.reshape(*lead, math.prod(some), length) for x, some in zip((a, b), free, strict=True))

        if a.shape[-2] * b.shape[-2] * length > MOST_PRODUCTS:
            raise NotWritten("a large product")
        a, b = jnp.moveaxis(a, -1, 0)[..., :, None], jnp.moveaxis(b, -1, 0)[..., None, :]

        def term(i):
            return entry(a, i) * entry(b, i)

        if not length:
            found = jnp.zeros((*lead, a.shape[-2], b.shape[-1]), dtype)
        elif length <= MOST_TERMS:
            found = reduce(lax.add, map(term, range(length)))
        else:
            found = lax.fori_loop(1, length, lambda i, total: total + term(i), term(0))
        return [found.reshape(*lead, *free[0], *free[1])]

    def _lu_pivots_to_permutation(self, args, outermost, *, permutation_size):
        return _over_batch(partial(_factor_loops.order_of, size=permutation_size), args, "pivots")


_FACTORS: dict[str, Callable] = {
    "cholesky": lambda params: _factor_loops.cholesky,
    "lu": lambda params: _factor_loops.lu,
    "triangular_solve": lambda params: partial(
        _factor_loops.triangular_solve,
        **{name: params[name] for name in ("left_side", "lower", "transpose_a", "unit_diagonal")},
    ),
    "qr": lambda params: partial(_factor_loops.qr, full_matrices=params["full_matrices"], pivoting=params["pivoting"]),
}


def _over_batch(function: Callable, args, name: str) -> list:
    """A function of single matrices, or of rows of pivots, of arrays with any leading axes."""
    if any(jnp.issubdtype(x.dtype, jnp.complexfloating) for x in args):
        raise NotWritten(f"{name} of complex numbers")
    for _ in range(args[0].ndim - (1 if name == "pivots" else 2)):
        function = jax.vmap(function)
    # The loops are written like anything else.
    return _Writer().closed(jax.make_jaxpr(function)(*args), args)


def _known(literal: Any) -> np.ndarray:
    return np.asarray(literal.val, literal.aval.dtype)


def _folded(fold: Callable, x, axes, primitive, params):
    """The entries along some axes folded in pairs, or one after the other where there are many."""
    x = jnp.asarray(x)
    kept = [i for i in range(x.ndim) if i not in axes]
    rows = jnp.transpose(x, (*axes, *kept)).reshape(-1, *[x.shape[i] for i in kept])
    if not len(rows):
        return primitive.bind(x, **params)
    if len(rows) > MOST_TERMS:
        return lax.fori_loop(1, len(rows), lambda i, total: fold(total, entry(rows, i)), entry(rows, 0))
    terms = [entry(rows, i) for i in range(len(rows))]
    while len(terms) > 1:
        terms = [fold(*pair) for pair in zip(terms[::2], terms[1::2], strict=False)] + terms[len(terms) // 2 * 2 :]
    return terms[0]


def _place_of_most(exceeds: Callable, x, *, axes, index_dtype, **_):
    """The first place of the largest entry along an axis, or of the first NaN."""
    rows = jnp.moveaxis(x, axes[0], 0)

    def look(i, state):
        most, place = state
        row = entry(rows, i)
        better = exceeds(row, most) | ((row != row) & (most == most))
        return jnp.where(better, row, most), jnp.where(better, jnp.asarray(i, index_dtype), place)

    return lax.fori_loop(1, len(rows), look, (entry(rows, 0), jnp.zeros(rows.shape[1:], index_dtype)))[1]


def _scattered(combine: Callable, operand, indices, updates, *, dimension_numbers, mode, **_):
    """Windows of `operand` combined with those of `updates`, one after the other."""
    numbers = dimension_numbers
    mode = lax.GatherScatterMode.from_any(mode)
    windows = numbers.update_window_dims
    apart = numbers.inserted_window_dims + tuple(numbers.operand_batching_dims)
    over = [i for i in range(updates.ndim) if i not in windows]
    sizes = [1] * operand.ndim
    for dim, window in zip([i for i in range(operand.ndim) if i not in apart], windows, strict=True):
        sizes[dim] = updates.shape[window]
    counts = tuple(updates.shape[i] for i in over)
    if not math.prod(counts) or not math.prod(sizes):
        return operand
    updates = jnp.transpose(updates, (*over, *windows)).reshape(-1, *sizes)
    rows = indices.reshape(-1, indices.shape[-1])

    def put(i, operand):
        starts = [jnp.zeros((), indices.dtype)] * operand.ndim
        for j, dim in enumerate(numbers.scatter_dims_to_operand_dims):
            starts[dim] = entry(entry(rows, i), j)
        for dim, axis in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
            stride = math.prod(counts[axis + 1 :])
            starts[dim] = jnp.asarray(i // stride % counts[axis], indices.dtype)
        old = lax.dynamic_slice(operand, starts, sizes)
        new = combine(old, entry(updates, i))
        if mode == lax.GatherScatterMode.FILL_OR_DROP:
            inside = [(x >= 0) & (x <= size - some) for x, size, some in zip(starts, operand.shape, sizes, strict=True)]
            new = jnp.where(reduce(jnp.logical_and, inside), new, old)
        return lax.dynamic_update_slice(operand, new, starts)

    if len(rows) <= MOST_WINDOWS:
        return reduce(lambda operand, i: put(i, operand), range(len(rows)), operand)
    return lax.fori_loop(0, len(rows), put, operand)


def has_kernels(jaxpr) -> bool:
    """Whether a program has a kernel of `_one_kernel` in it."""
    return any(name == "one_kernel" for name in _names(jaxpr))


def _calls_back(jaxpr) -> bool:
    return any("callback" in name for name in _names(jaxpr))


def is_short(jaxpr) -> bool:
    """Whether a program has no more than `MOST_OPERATIONS`."""
    return sum(1 for _ in itertools.islice(_names(jaxpr), MOST_OPERATIONS + 1)) <= MOST_OPERATIONS


def _names(jaxpr):
    """Names of all operations of a program, those in loops and branches included."""
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for value in eqn.params.values():
            if isinstance(value, VectorProgram):  # which is too long for a call, whatever else there is
                yield from itertools.repeat("vectors", MOST_OPERATIONS)
            for inner in value if isinstance(value, (tuple, list)) else (value,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _names(inner)
