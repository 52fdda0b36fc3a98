"""Operations on arrays whose numbers are all known, while a program of numbers is written."""

from collections.abc import Callable

import jax
import numpy as np

from jaxdyn.compile import program as numbers
from jaxdyn.compile.program import NotNumbers

_NUMPY: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "square": np.square,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "is_finite": np.isfinite,
    "rsqrt": lambda x: 1 / np.sqrt(x),
} | {name: f for name, f in numbers.COMPARISONS.items()} | numbers.FUNCTIONS | numbers.FUNCTIONS_OF_TWO  # fmt: skip
# Remainders by zero and negative powers of integers, which numpy computes otherwise than XLA or refuses.
_OTHER_OF_INTEGERS = ("rem", "pow")
_NUMPY_REDUCTIONS: dict[str, Callable] = {
    "reduce_sum": np.sum, "reduce_prod": np.prod, "reduce_max": np.max, "reduce_min": np.min, "reduce_and": np.all,
    "reduce_or": np.any,
}  # fmt: skip


def empty_reduction(name: str, dtype):
    """A reduction of no entries."""
    if name in ("reduce_max", "reduce_min"):
        if dtype.kind == "b":
            return name == "reduce_min"
        ends = (-np.inf, np.inf) if dtype.kind == "f" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
        return ends[name == "reduce_min"]
    return name in ("reduce_prod", "reduce_and")


def convert_known(x: np.ndarray, dtype) -> np.ndarray:
    """An array as one of a dtype, by XLA's rules: floats that no integer is near become its ends, or zero if they are none."""
    dtype = np.dtype(dtype)
    if x.dtype.kind != "f" or dtype.kind not in "iu":
        return x.astype(dtype)
    # NumPy's own conversion of a float that is out of range is undefined and differs between processors.
    ends = np.iinfo(dtype)
    is_low, is_high = x <= ends.min, x >= ends.max
    inside = np.where(is_low | is_high | np.isnan(x), 0, x).astype(dtype)
    return np.where(is_high, dtype.type(ends.max), np.where(is_low, dtype.type(ends.min), inside))


def evaluate_known(eqn, args) -> np.ndarray:
    """An operation on known arrays; by NumPy where that does the same, as JAX would compile it for each new shape."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    with np.errstate(all="ignore"):
        if name in _NUMPY and not (name in _OTHER_OF_INTEGERS and out.dtype.kind in "iu"):
            return np.asarray(_NUMPY[name](*args)).astype(out.dtype, copy=False)
        if name == "div" and out.dtype.kind == "f":
            return np.asarray(args[0] / args[1], out.dtype)
        if name in _NUMPY_REDUCTIONS and not args[0].size:
            return np.full(out.shape, empty_reduction(name, out.dtype), out.dtype)
        if name in _NUMPY_REDUCTIONS:
            return np.asarray(_NUMPY_REDUCTIONS[name](args[0], axis=tuple(eqn.params["axes"]))).astype(out.dtype)
        if name == "iota":
            return np.indices(out.shape)[eqn.params["dimension"]].astype(out.dtype)
    return bind_known(eqn, args)


def bind_known(eqn, args) -> np.ndarray:
    """The same by JAX itself."""
    # The expansion may run within a user's trace, which must not see this operation.
    with jax.ensure_compile_time_eval():
        value = eqn.primitive.bind(*args, **eqn.params)
    if eqn.primitive.multiple_results:
        raise NotNumbers(eqn.primitive.name)
    if jax.numpy.issubdtype(value.dtype, jax.dtypes.extended):
        raise NotNumbers(f"an array of {value.dtype}")
    return np.asarray(value)
