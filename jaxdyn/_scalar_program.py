"""`scalar_program`: a function of small arrays as a program of single numbers.

Its jaxpr is evaluated on arrays of numbers, known or traced. Sums and products with known zeros and ones are not written
down, and what has been written once is used again: derivatives of a Lagrangian repeat themselves, and most entries of their
one-hot tangents are zero. A known zero makes zero of what it is multiplied with, also of what is no number.

While a function is traced for this, `is_written_out()` holds. Code that chooses between ways to compute then takes one without
branches, loops and LAPACK, which are not single numbers.
"""

import contextlib
import contextvars
import functools
import math
from collections.abc import Callable

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jaxdyn._trig import sin_cos

_writing = contextvars.ContextVar("writing", default="")


class TooMuch(Exception):
    """An operation that is not one of single numbers, or too many of them."""


def is_written_out() -> bool:
    """Whether a function is being traced to become a program of single numbers."""
    return bool(_writing.get())


def is_written_in_vectors() -> bool:
    """Whether it is to become one of vectors, in which sequences that repeat themselves are better not written out."""
    return _writing.get() == "vectors"


@contextlib.contextmanager
def _written_out(in_vectors: bool):
    token = _writing.set("vectors" if in_vectors else "numbers")
    try:
        yield
    finally:
        _writing.reset(token)


def scalar_program(function: Callable, *args, most: int, for_batches: bool = False, in_vectors: bool = False):
    """The program of `function` in single numbers: its jaxpr, (shape, dtype) of the outputs and their structure.

    With `for_batches`, or `in_vectors` (see `_vector_program`), sines, cosines and square roots are written as more operations,
    but ones that become vector instructions.

    **Raises:** `TooMuch` for more than `most` operations, and for those that are none of single numbers.
    """
    with _written_out(in_vectors):
        jaxpr, out = jax.make_jaxpr(function, return_shape=True)(*args)
    leaves, structure = jax.tree.flatten(out)
    if _length(jaxpr.jaxpr) > 4 * most:  # not all of them are needed, and some only move numbers
        raise TooMuch

    def run(*numbers):
        given, at = [], 0
        for arg in args:
            size = math.prod(np.shape(arg))
            given.append(_objects(numbers[at : at + size], np.shape(arg)))
            at += size
        found = _Writer(4 * most, for_batches or in_vectors, _in_pairs if in_vectors else functools.reduce).evaluate(
            jaxpr.jaxpr, [np.asarray(const) for const in map(_known, jaxpr.consts)], given
        )
        return [
            jnp.asarray(number, leaf.dtype)
            for array, leaf in zip(found, leaves, strict=True)
            for number in array.ravel().tolist()
        ]

    numbers = [ShapedArray((), arg.dtype) for arg in args for _ in range(math.prod(np.shape(arg)))]
    program = _needed(jax.make_jaxpr(run)(*numbers))
    if program.consts or len(program.eqns) > most:
        raise TooMuch
    return program, tuple((leaf.shape, leaf.dtype) for leaf in leaves), structure


def _length(jaxpr) -> int:
    """Operations of a program and of those inside it; on arrays of several numbers each counts once, so there may be more."""
    inner = (x.params[INNER[x.primitive.name]] for x in jaxpr.eqns if x.primitive.name in INNER)
    inner = (getattr(x, "jaxpr", x) for x in inner)
    return len(jaxpr.eqns) + sum(_length(x) for x in inner if isinstance(x, Jaxpr))


def _needed(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program without what no output depends on."""
    jaxpr = program.jaxpr
    needed = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    eqns = []
    for eqn in reversed(jaxpr.eqns):
        if needed.intersection(eqn.outvars):
            eqns.append(eqn)
            needed.update(x for x in eqn.invars if not isinstance(x, Literal))
    return ClosedJaxpr(jaxpr.replace(eqns=eqns[::-1]), program.consts)


def _known(const):
    if isinstance(const, Tracer):
        raise TooMuch
    return const


def _objects(entries, shape) -> np.ndarray:
    array = np.empty(len(entries), object)
    for i, entry in enumerate(entries):  # in one assignment numpy would look into them
        array[i] = entry
    return array.reshape(shape)


def _in_pairs(fold: Callable, numbers: list):
    """The numbers folded in pairs, and these again: few sequences of the same kind instead of one long one."""
    while len(numbers) > 1:
        half = len(numbers) // 2
        numbers = [fold(*pair) for pair in zip(numbers[:half], numbers[half:], strict=False)] + numbers[2 * half :]
    return numbers[0]


def _entries(array) -> list:
    """The numbers of an array in order: traced ones as they are, known ones of its dtype."""
    if array.dtype.kind == "O":
        return array.ravel().tolist()
    return [array.dtype.type(x) for x in array.ravel().tolist()]


_ELEMENTWISE = frozenset(
    "add add_any sub mul div neg sqrt rsqrt cbrt abs sign floor ceil round max min pow integer_pow square exp exp2 expm1 log "
    "log1p logistic sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh rem clamp nextafter select_n eq ne lt le "
    "gt ge and or not xor is_finite convert_element_type copy stop_gradient".split()
)
_REDUCTIONS = {
    "reduce_sum": lax.add_p,
    "reduce_min": lax.min_p,
    "reduce_max": lax.max_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
}
_SAME = frozenset({"materialize", "optimization_barrier"})
_OF_MANY = frozenset({"banded_factor", "banded_solution"})  # numbers
INNER = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "one_kernel": "program",
}
# Which arguments are moved; the others say where to, and have to be known.
_MOVES = {
    "gather": (0,),
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "pad": (0, 1),
    "scatter": (0, 2),
    "split": (0,),
}


class _Writer:
    """Evaluates jaxprs on arrays of numbers; operations that recur are written once."""

    def __init__(self, most: int, for_batches: bool, reduced: Callable):
        self.left = most  # of which some are not needed in the end
        self.reduced = reduced
        self.for_batches = for_batches
        self.written: dict = {}

    def evaluate(self, jaxpr, consts, args) -> list[np.ndarray]:
        values: dict = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))

        def read(atom):
            return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

        for eqn in jaxpr.eqns:
            if eqn.effects:  # which are to happen when the program runs, as often as it does
                raise TooMuch(eqn.primitive.name)
            found = self._one(eqn.primitive, eqn.params, [read(x) for x in eqn.invars], [x.aval for x in eqn.outvars])
            values.update(zip(eqn.outvars, found, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _one(self, primitive, params, args, outs):
        name = primitive.name
        if name == "one_kernel":
            if not isinstance(params["program"], ClosedJaxpr):
                raise TooMuch("vectors")
            return self._kernel(params["program"], args, outs)
        if name in INNER:
            inner = params[INNER[name]]
            consts, inner = (inner.consts, inner.jaxpr) if isinstance(inner, ClosedJaxpr) else ((), inner)
            return self.evaluate(inner, [np.asarray(_known(const)) for const in consts], args)
        if name in _SAME:
            return args
        if name in _OF_MANY:
            found = primitive.bind(*(entry for arg in args for entry in _entries(arg)), **params)
            return [_objects([x], ()) for x in found]
        if name == "cond" and args[0].dtype.kind != "O":
            branch = params["branches"][int(np.clip(args[0], 0, len(params["branches"]) - 1))]
            return self.evaluate(branch.jaxpr, [np.asarray(_known(const)) for const in branch.consts], args[1:])
        shape = outs[0].shape
        if all(arg.dtype.kind != "O" for arg in args) and name not in _REDUCTIONS and name != "dot_general":
            return _moved(primitive, params, args, shape) if name in _MOVED else _computed(primitive, params, args)
        if name in _ELEMENTWISE:
            columns = [_entries(np.broadcast_to(arg, shape)) for arg in args]
            return [_objects([self._number(primitive, params, each) for each in zip(*columns, strict=True)], shape)]
        if name in _REDUCTIONS:
            axes, fold = params["axes"], functools.partial(self._pair, _REDUCTIONS[name])
            rows = np.moveaxis(args[0], axes, range(len(axes))).reshape(-1, math.prod(shape))
            return [_objects([self.reduced(fold, _entries(column)) for column in rows.T], shape)]
        if name == "dot_general":
            return [self._product(args[0], args[1], params["dimension_numbers"], outs[0])]
        if name == "scatter-add":
            return [self._scattered(primitive, params, args[0], args[1], args[2])]
        return _moved(primitive, params, args, shape)

    def _kernel(self, program: ClosedJaxpr, args, outs):
        numbers = [_objects([entry], ()) for arg in args for entry in _entries(arg)]
        found, at, arrays = self.evaluate(program.jaxpr, [], numbers), 0, []
        for out in outs:
            size = math.prod(out.shape)
            arrays.append(_objects([x.ravel().tolist()[0] for x in found[at : at + size]], out.shape))
            at += size
        return arrays

    def _pair(self, primitive, a, b):
        return self._number(primitive, {}, (a, b))

    def _number(self, primitive, params, args):
        """One operation on numbers."""
        known = [None if isinstance(x, Tracer) else x for x in args]
        if all(x is not None for x in known):
            (found,) = _computed(primitive, params, known)
            return found.dtype.type(found)
        plain = _without(primitive.name, params, args, known)
        if plain is not None:
            return plain
        if self.for_batches and primitive.name in ("sin", "cos") and args[0].dtype in (np.float32, np.float64):
            sine, cosine = self.evaluate(*_sines(np.dtype(args[0].dtype)), [_objects([args[0]], ())])
            return (sine if primitive.name == "sin" else cosine).item()
        found = self._operation(primitive, params, args, known)
        if self.for_batches and primitive is lax.sqrt_p:
            # XLA makes 1/sqrt(x) an instruction of one processor, of which LLVM makes no vector instructions; this hides it.
            return self._operation(lax.max_p, {}, (found, (zero := args[0].dtype.type(0))), (None, zero))
        return found

    def _operation(self, primitive, params, args, known):
        """One that is written down, unless it has been before."""
        names = (id(x) if k is None else (k.dtype, k.tobytes()) for x, k in zip(args, known, strict=True))
        key = primitive, _frozen(params), tuple(names)
        if key not in self.written:
            self.left -= 1
            if self.left < 0:
                raise TooMuch
            self.written[key] = primitive.bind(*args, **params), args  # held, so that no other number gets its id
        return self.written[key][0]

    def _product(self, left, right, dimensions, out):
        """`dot_general`."""
        (left_sum, right_sum), (left_batch, right_batch) = dimensions
        if out.dtype != _dtype(left) or out.dtype != _dtype(right):
            raise TooMuch
        batch = [left.shape[i] for i in left_batch]
        length = math.prod(left.shape[i] for i in left_sum)
        a, b = (
            np.moveaxis(x, (*over, *summed), (*range(len(over)), *range(-len(summed), 0)))
            for x, over, summed in ((left, left_batch, left_sum), (right, right_batch, right_sum))
        )
        count = math.prod(batch)
        a, b = (_objects(_entries(x), x.shape).reshape(count, -1, length) for x in (a, b))
        zero = out.dtype.type(0)
        entries = [
            functools.reduce(
                functools.partial(self._pair, lax.add_p),
                (self._pair(lax.mul_p, *pair) for pair in zip(row, column, strict=True)),
                zero,
            )
            for each in range(count)
            for row in a[each].tolist()
            for column in b[each].tolist()
        ]
        return _objects(entries, out.shape)

    def _scattered(self, primitive, params, operand, places, updates):
        if places.dtype.kind == "O":
            raise TooMuch
        dtype, size = _dtype(operand), updates.size
        one_hot = np.eye(size, dtype=dtype).reshape(size, *updates.shape)
        with jax.ensure_compile_time_eval():
            hit = jax.vmap(lambda u: primitive.bind(jnp.zeros(operand.shape, dtype), places, u, **params))(one_hot)
        numbers = _entries(operand)
        for update, where in zip(_entries(updates), np.asarray(hit).reshape(size, -1), strict=True):
            for i in np.flatnonzero(where):
                numbers[i] = self._pair(lax.add_p, numbers[i], update)
        return _objects(numbers, operand.shape)


@functools.lru_cache
def _sines(dtype):
    """Program of the sine and cosine of a number, and its constants."""
    program = jax.make_jaxpr(sin_cos)(jax.ShapeDtypeStruct((), dtype))
    return program.jaxpr, [np.asarray(const) for const in program.consts]


# What numpy does as well, and without compiling it first.
_PLAIN: dict[str, Callable] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.bitwise_not,
    "sign": np.sign,
    "abs": np.abs,
    "is_finite": np.isfinite,
    "select_n": lambda which, *cases: np.choose(which.astype(np.int32), cases),
}
_PLAIN_FLOATS: dict[str, Callable] = {"div": np.divide, "sqrt": np.sqrt, "square": np.square}
_MOVED = frozenset("reshape squeeze broadcast_in_dim slice unstack rev transpose concatenate stack".split())


def _dtype(array):
    if array.dtype.kind != "O":
        return array.dtype
    return np.dtype(array.ravel()[0].dtype)


def _without(name, params, args, known):
    """What an operation with known zeros or ones is without computing; None if it has to be computed."""
    if name == "select_n" and known[0] is not None:
        return args[1 + int(known[0])]
    if name == "integer_pow" and params["y"] == 1:
        return args[0]
    if name == "convert_element_type" and args[0].dtype == params["new_dtype"]:
        return args[0]
    if name not in ("add", "add_any", "sub", "mul", "div"):
        return None
    for i, x in enumerate(known):
        other = args[1 - i]
        if x is None:
            continue
        if name == "mul" and x == 0:
            return x
        if x == 1 and (name == "mul" or (name == "div" and i == 1)):
            return other
        if x == 0 and (name in ("add", "add_any") or (name == "sub" and i == 1)):
            return other
    return None


def _frozen(params):
    return tuple(sorted((key, str(value)) for key, value in params.items()))


def _computed(primitive, params, args):
    """An operation on known arrays."""
    name = primitive.name
    if name == "convert_element_type":
        return [np.asarray(args[0]).astype(params["new_dtype"])]
    if name == "integer_pow" and params["y"] >= 0:
        return [np.asarray(args[0] ** params["y"])]
    if name == "split":
        return np.split(args[0], np.cumsum(params["sizes"])[:-1], params["axis"])
    if name == "iota":
        return [np.indices(params["shape"])[params["dimension"]].astype(params["dtype"])]
    plain = _PLAIN.get(name) or (_PLAIN_FLOATS.get(name) if args and args[0].dtype.kind == "f" else None)
    if plain is not None:
        with np.errstate(all="ignore"):
            return [np.asarray(plain(*args))]
    with jax.ensure_compile_time_eval():
        found = primitive.bind(*(np.asarray(x) for x in args), **params)
    return [np.asarray(x) for x in (found if primitive.multiple_results else [found])]


def _moved(primitive, params, args, shape):
    """An operation that only moves numbers."""
    name, first = primitive.name, args[0]
    if name in ("reshape", "squeeze"):
        return [first.reshape(shape)]
    if name == "broadcast_in_dim":
        kept = [1] * len(shape)
        for place, size in zip(params["broadcast_dimensions"], first.shape, strict=True):
            kept[place] = size
        return [np.broadcast_to(first.reshape(kept), shape)]
    if name == "slice":
        strides = params["strides"] or (1,) * first.ndim
        places = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
        return [first[tuple(slice(*place) for place in places)]]
    if name == "unstack":
        rows = np.moveaxis(first, params["axis"], 0)
        return [rows[i, ...] for i in range(len(rows))]
    if name == "rev":
        return [np.flip(first, params["dimensions"])]
    if name == "transpose":
        return [first.transpose(params["permutation"])]
    if name in ("concatenate", "stack"):
        if any(arg.dtype.kind == "O" for arg in args):
            args = [_objects(_entries(arg), arg.shape) for arg in args]
        if name == "stack":
            return [np.stack(args, params["axis"])]
        return [np.concatenate(args, params["dimension"])]
    if name not in _MOVES or any(x.dtype.kind == "O" for i, x in enumerate(args) if i not in _MOVES[name]):
        raise TooMuch(name)
    # Done with the places of the numbers instead of the numbers.
    numbers, places, at = [], list(args), 0
    for i in _MOVES[name]:
        numbers += _entries(args[i])
        places[i] = np.arange(at, at := len(numbers), dtype=np.int32).reshape(args[i].shape)
    found = _computed(primitive, params, places)
    if any((x < 0).any() for x in found):  # filled in from outside
        raise TooMuch(name)
    return [_objects([numbers[i] for i in x.ravel()], x.shape) for x in found]
