"""Jaxprs evaluated by NumPy, operation by operation: a reference for compilers that neither compiles nor contracts.

JAX outside of `jit` compiles each operation for each shape and dispatches it in 100 microseconds. It also compiles the functions
of `jnp` that are under `jit` in whole, where XLA contracts a b - c d to a fused multiply-add: the cross product of a vector with
itself is then rounding noise, whose quotients are arbitrary. Operations without a rule here are left to JAX.
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

_ELEMENTWISE: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "abs": np.abs, "sign": np.sign, "floor": np.floor, "ceil": np.ceil, "square": np.square, "sqrt": np.sqrt, "cbrt": np.cbrt,
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh,
    "exp": np.exp, "exp2": np.exp2, "expm1": np.expm1, "log": np.log, "log1p": np.log1p, "atan2": np.arctan2, "rem": np.fmod,
    "pow": np.power, "max": lambda x, y: _maximum(x, y), "min": lambda x, y: -_maximum(-x, -y),
    "eq": np.equal, "ne": np.not_equal, "lt": np.less,
    "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or,
    "not": np.bitwise_not, "is_finite": np.isfinite, "rsqrt": lambda x: 1 / np.sqrt(x), "copy": np.positive,
    "stop_gradient": np.positive, "clamp": lambda low, x, high: -_maximum(-_maximum(x, low), -high),
}  # fmt: skip
# Words of docs/algorithms.md for rules of kernels that change results.
ZERO_PRODUCT, EQUAL_DIFFERENCE, ZERO_SIGN = "0 x", "x - x", "sign of zero"
# A difference of products that cancels: a fused multiply-add leaves the rounding of one of them, which may decide a tie.
CONTRACTION = "a b - c d"
_REDUCTIONS: dict[str, Callable] = {
    "reduce_sum": np.sum, "reduce_prod": np.prod, "reduce_max": np.max, "reduce_min": np.min, "reduce_and": np.all,
    "reduce_or": np.any,
}  # fmt: skip
_INNER = {"jit": "jaxpr", "closed_call": "call_jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}


def _maximum(x, y):
    # NumPy takes either zero of two; XLA and LLVM take the positive one.
    if x.dtype.kind != "f":
        return np.maximum(x, y) if x.dtype.kind != "b" else x | y
    return np.where((x == 0) & (y == 0), x + y, np.maximum(x, y))


def evaluate(closed: ClosedJaxpr, args, met: set | None = None, sine_error: float = 0.0) -> list[np.ndarray]:
    """The results of a jaxpr for arrays; the rules that a kernel could have applied to its numbers are added to `met`.

    Sines and cosines are changed by `sine_error` units in the last place of one.
    """
    jaxpr = closed.jaxpr
    values = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom):
        return np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]

    with np.errstate(all="ignore"):
        for eqn in jaxpr.eqns:
            operands = [read(x) for x in eqn.invars]
            results = _evaluate_one(eqn, operands, met, sine_error)
            if met is not None:
                met |= _rules_met(eqn.primitive.name, operands, results)
            values.update(zip(eqn.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _rules_met(name: str, args, results) -> set[str]:
    """Rules of the page that could have changed a result, as far as these numbers go."""
    if not args or args[0].dtype.kind != "f":
        return set()
    rules = set()
    if name in ("mul", "dot_general") and any((x == 0).any() for x in args) and not all(map(_is_finite, args)):
        rules.add(ZERO_PRODUCT)
    if name in ("sub", "add", "add_any", "reduce_sum", "dot_general", "cumsum") and not all(map(_is_finite, args)):
        rules.add(EQUAL_DIFFERENCE)
    if name in ("sub", "add", "add_any") and ((results[0] == 0) & (args[0] != 0)).any():
        rules.add(CONTRACTION)
    # Where the sign of a zero decides: a quotient, an angle, and functions with a pole at zero.
    if name in ("div", "atan2", "rsqrt", "pow", "integer_pow", "cbrt") and any((x == 0).any() for x in args):
        if not all(map(_is_finite, results)) or name == "atan2":
            rules.add(ZERO_SIGN)
    return rules


def _is_finite(x) -> bool:
    return x.dtype.kind != "f" or bool(np.isfinite(x).all())


def _evaluate_one(eqn, args, met, sine_error) -> list[np.ndarray]:
    name, params = eqn.primitive.name, eqn.params
    if name in _INNER:
        return evaluate(params[_INNER[name]], args, met, sine_error)
    if name == "scan":
        return _scan(params, args, met, sine_error)
    if name in ("sin", "cos") and sine_error:
        x = _ELEMENTWISE[name](args[0])
        return [(x + sine_error * np.finfo(x.dtype).eps).astype(x.dtype)]
    out = eqn.outvars[0].aval
    if name in _ELEMENTWISE and not (name == "rem" and out.dtype.kind != "f"):
        return [np.asarray(_ELEMENTWISE[name](*args)).astype(out.dtype, copy=False)]
    if name in _REDUCTIONS and args[0].size:
        return [np.asarray(_REDUCTIONS[name](args[0], axis=tuple(params["axes"]))).astype(out.dtype, copy=False)]
    if name == "integer_pow":
        return [_integer_power(args[0], params["y"])]
    if name == "select_n" and len(args) == 3:
        return [np.where(args[0], args[2], args[1])]
    if name == "convert_element_type" and not (args[0].dtype.kind == "f" and out.dtype.kind == "i"):
        return [args[0].astype(out.dtype)]
    if name == "broadcast_in_dim":
        shape = [1] * len(params["shape"])
        for place, size in zip(params["broadcast_dimensions"], args[0].shape, strict=True):
            shape[place] = size
        return [np.broadcast_to(args[0].reshape(shape), params["shape"])]
    if name == "squeeze" or (name == "reshape" and params["dimensions"] is None):
        return [args[0].reshape(out.shape)]
    if name == "transpose":
        return [args[0].transpose(params["permutation"])]
    if name == "rev":
        return [np.flip(args[0], params["dimensions"])]
    if name == "concatenate":
        return [np.concatenate(args, params["dimension"])]
    if name == "slice":
        strides = params["strides"] or (1,) * args[0].ndim
        bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
        return [args[0][tuple(slice(*each) for each in bounds)]]
    if name == "cumsum":
        x = np.flip(args[0], params["axis"]) if params["reverse"] else args[0]
        sums = np.cumsum(x, params["axis"], dtype=x.dtype)
        return [np.flip(sums, params["axis"]) if params["reverse"] else sums]
    results = eqn.primitive.bind(*args, **params)
    return [np.asarray(x) for x in (results if eqn.primitive.multiple_results else [results])]


def _integer_power(x, exponent: int) -> np.ndarray:
    """By repeated products, as XLA does it: at infinity and zero `numpy.power` has other signs."""
    power, base, left = np.ones_like(x), x, abs(exponent)
    while left:
        power = power * base if left & 1 else power
        base, left = base * base, left >> 1
    return power if exponent >= 0 else 1 / power


def _scan(params, args, met, sine_error) -> list[np.ndarray]:
    from jaxdyn.compile.jax_adapter import scan_counts

    constants, carried = scan_counts(params)
    carry, rows, saved = args[constants : constants + carried], args[constants + carried :], []
    order = range(params["length"])
    for i in reversed(order) if params["reverse"] else order:
        results = evaluate(params["jaxpr"], [*args[:constants], *carry, *(x[i] for x in rows)], met, sine_error)
        carry = results[:carried]
        saved.append(results[carried:])
    saved = saved[::-1] if params["reverse"] else saved
    return [*carry, *(np.stack(column) for column in zip(*saved, strict=True))]


def trace_and_evaluate(function: Callable, *args, met: set | None = None, sine_error: float = 0.0) -> list[np.ndarray]:
    """The flat results of a function: JAX traces it, NumPy computes. `met`, `sine_error`: as of `evaluate`."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(args)]
    return evaluate(jax.make_jaxpr(function)(*args), leaves, met, sine_error)
