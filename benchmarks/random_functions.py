"""Random functions as kernels and by JAX alone: values, products with the Jacobian and its transpose, and with the Hessian.

    python -m benchmarks.random_functions [--count 10000] [--seed 0] [--through-xla 50]

A function is a short random program of what users write: elementary functions, functions with rules of their own, choices,
reductions, products, loops, integers. It is compared at random points and at points with zeros, ties, infinities and what
is not a number. What docs/algorithms.md lists as different is counted apart; everything else that differs is printed with
the seed that makes it again, and the exit code is 1. Ten thousand functions take half an hour of one core.

JAX traces and differentiates the reference, and NumPy evaluates it (`numpy_jaxprs`): XLA takes a second to compile each one.
"""

import argparse
import collections
import ctypes
import sys
import tempfile
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.numpy_jaxprs import CONTRACTION, trace_and_evaluate

SIZE = 3
MATRIX = np.array([[0.5, -1.25, 2.0], [1.0, 0.75, -0.5], [-2.0, 0.3, 1.5]])
# One unit in the last place of a result of some tens of operations, times the condition that such functions have at most.
TOLERANCE = {"float64": 1e-10, "float32": 2e-3}
SPECIAL = (
    (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-0.0, 2.0, 2.0), (np.nan, 1.0, 0.5), (np.inf, 1.0, -1.0), (-np.inf, 0.0, 2.0),
)  # fmt: skip


@jax.custom_jvp
def _own_rule(x):
    """A function whose rule calls the function itself."""
    return jnp.tanh(x)


_own_rule.defjvp(lambda primals, tangents: (_own_rule(primals[0]), tangents[0] * (1 - _own_rule(primals[0]) ** 2)))


def _halve_and_add(_, pair):
    y, x = pair
    return 0.5 * y + x, x


def _running(carry, row):
    return carry * row, carry + row


def _all(x):
    return jnp.broadcast_to(x, (SIZE,))


UNARY: dict[str, Callable] = {
    "neg": lambda x: -x, "abs": jnp.abs, "sign": jnp.sign, "floor": jnp.floor, "square": jnp.square, "cube": lambda x: x**3,
    "inverse": lambda x: 1 / x, "inverse square": lambda x: x**-2, "sin": jnp.sin, "cos": jnp.cos, "tanh": jnp.tanh,
    "exp": lambda x: jnp.exp(jnp.minimum(x, 5.0)), "sqrt": lambda x: jnp.sqrt(jnp.abs(x)), "atan": jnp.arctan,
    "log": lambda x: jnp.log(1 + x * x), "rsqrt": lambda x: lax.rsqrt(1 + x * x), "cbrt": jnp.cbrt, "root": jnp.sqrt,
    "sinc": jnp.sinc, "relu": jax.nn.relu, "own rule": _own_rule, "clip": lambda x: jnp.clip(x, -0.5, 1.0),
    "clamp": lambda x: lax.clamp(jnp.asarray(-1.0, x.dtype), x, jnp.asarray(1.0, x.dtype)), "scaled": lambda x: 2.5 * x,
    "shifted": lambda x: x + 0.75, "sum": lambda x: _all(x.sum()), "prod": lambda x: _all(x.prod()),
    "max": lambda x: _all(x.max()), "min": lambda x: _all(x.min()), "cumsum": jnp.cumsum, "reversed": lambda x: x[::-1],
    "matrix": lambda x: jnp.asarray(MATRIX, x.dtype) @ x, "norm": lambda x: _all(jnp.sqrt(x @ x)),
    "taken": lambda x: x[np.array([2, 0, 0])], "added": lambda x: x.at[np.array([0, 0, 2])].add(x),
    "loop": lambda x: lax.fori_loop(0, 3, _halve_and_add, (x, x))[0],
    "scan": lambda x: lax.scan(_running, x[0], x)[1],
    "stopped": lambda x: x * lax.stop_gradient(x),
    "whole": lambda x: (jnp.clip(x, -9.0, 9.0).astype(jnp.int32) * 3 + 1).astype(x.dtype),
    "safe root": lambda x: jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.5),
}  # fmt: skip
BINARY: dict[str, Callable] = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": jnp.divide, "maximum": jnp.maximum, "minimum": jnp.minimum,
    "atan2": jnp.arctan2, "where": lambda x, y: jnp.where(x > y, x, y * y),
    "pow": lambda x, y: jnp.abs(x) ** jnp.clip(y, -2.0, 2.0),
    "rem": lambda x, y: lax.rem(x, 1 + y * y), "dot": lambda x, y: _all(jnp.dot(x, y)), "cross": jnp.cross,
    "logaddexp": jnp.logaddexp, "hypot": lambda x, y: jnp.sqrt(x * x + y * y), "chosen": lambda x, y: jnp.where(x == y, x, -y),
}  # fmt: skip


class Function(NamedTuple):
    """A random function (3,) -> (3,) as a list of steps: a name, and which of the values before it it takes."""

    steps: tuple[tuple[str, tuple[int, ...]], ...]

    def __call__(self, x):
        values = [x]
        for name, args in self.steps:
            operands = [values[i] for i in args]
            values.append((UNARY[name] if name in UNARY else BINARY[name])(*operands))
        return values[-1] + values[len(values) // 2]


def random_function(rng: np.random.Generator) -> Function:
    """A function of two to seven steps, each of which takes the value before it and perhaps one other."""
    steps = []
    for k in range(rng.integers(2, 8)):
        if rng.random() < 0.55:
            steps.append((str(rng.choice(list(UNARY))), (k,)))
        else:
            other = int(rng.integers(0, k + 1))
            args = (k, other) if rng.random() < 0.5 else (other, k)
            steps.append((str(rng.choice(list(BINARY))), args))
    return Function(tuple(steps))


def differentiated(function: Callable) -> Callable:
    """x, step, cotangent -> the value, J step, J^T cotangent, and the Hessian of cotangent . f times step in three orders."""

    def all_of(x, step, cotangent):
        def weighed(y):
            return jnp.vdot(cotangent, function(y))

        value, along = jax.jvp(function, (x,), (step,))
        (across,) = jax.vjp(function, x)[1](cotangent)
        gradient = jax.grad(weighed)
        _, forward_reverse = jax.jvp(gradient, (x,), (step,))
        (reverse_reverse,) = jax.vjp(gradient, x)[1](step)
        reverse_forward = jax.grad(lambda y: jax.jvp(weighed, (y,), (step,))[1])(x)
        return value, along, across, forward_reverse, reverse_reverse, reverse_forward

    return all_of


NAMES = ("value", "jvp", "vjp", "forward over reverse", "reverse over reverse", "reverse over forward")


def points(rng: np.random.Generator, dtype) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Points (n, 3), of which the last len(SPECIAL) are the special ones; steps and cotangents (n, 3)."""
    x = np.concatenate([rng.normal(size=(3, SIZE)) * rng.choice([0.5, 1.0, 3.0], (3, 1)), np.array(SPECIAL)])
    step, cotangent = rng.normal(size=(2, len(x), SIZE))
    return jnp.asarray(x, dtype), jnp.asarray(step, dtype), jnp.asarray(cotangent, dtype)


def _refused(*_):
    raise AssertionError("there is no kernel")


def by_kernel(function: Callable, args, lanes: int) -> list[np.ndarray]:
    """All derivatives for the samples (n, 3) of args, by machine code that is called without XLA."""
    from jaxdyn import compile as backend
    from jaxdyn.compile import target
    from jaxdyn.compile.expansion import expand

    def native(x):
        return backend.kernel(lambda _, x: function(x), fallback=_refused)((), x)

    program, _ = expand(jax.make_jaxpr(differentiated(native))(*(x[0] for x in args)), 10**6)
    number = target.kernel(program, lanes, [False] * len(program.inputs))
    given = [np.ascontiguousarray(x) for x in args]
    count = len(given[0])
    results = [np.empty((count, *array.shape), array.dtype) for array in program.outputs]
    data = (ctypes.c_void_p * (len(given) + len(results)))(*(x.ctypes.data for x in (*given, *results)))
    target._KERNEL(target._kernels[number].address())(data, count, 0, count)
    return results


def through_xla(function: Callable, args) -> list[np.ndarray]:
    """The same as users compute it: kernels of a batch within a program of XLA."""
    from jaxdyn import compile as backend

    def native(x):
        return backend.kernel(lambda _, x: function(x), fallback=_refused)((), x)

    return [np.asarray(y) for y in jax.jit(jax.vmap(differentiated(native)))(*args)]


def by_jax(function: Callable, args) -> list[np.ndarray]:
    """The same by JAX's own derivatives, evaluated by NumPy one operation after the other."""
    return trace_and_evaluate(jax.vmap(differentiated(function)), *args)


def judge(function: Callable, args, computed, wanted) -> collections.Counter:
    """How many results agree, differ by rounding, or as the page lists; ("different", name, sample) for all others."""
    dtype = args[0].dtype
    verdicts: collections.Counter = collections.Counter()
    spread = coarse = None
    rules: dict[int, set[str]] = {}
    for k, (name, mine, theirs) in enumerate(zip(NAMES, computed, wanted, strict=True)):
        for i in range(len(mine)):
            is_special = i >= len(mine) - len(SPECIAL)
            if _agree(mine[i], theirs[i], TOLERANCE[dtype.name]):
                verdicts["equal"] += 1
                continue
            if _is_listed(mine[i], theirs[i], TOLERANCE[dtype.name]):
                verdicts["listed"] += 1
                continue
            if spread is None and not is_special:
                spread = _spread(function, args, wanted)
            if not is_special and spread is not None and np.all(np.abs(mine[i] - theirs[i]) <= 1e3 * spread[k][i]):
                verdicts["rounding"] += 1
                continue
            # A sine of pi is rounding alone, which a quotient by a norm makes large.
            if _is_rounding_of_sines(function, args, k, i, wanted):
                verdicts["rounding"] += 1
                continue
            # Rounding may decide a comparison, such as that of two arctangents, and terms of a sum may cancel. Both are seen in
            # another precision, which keeps ties as they are.
            if np.isfinite(args[0][i]).all():
                if coarse is None:
                    other = jnp.float64 if dtype == jnp.float32 else jnp.float32
                    coarse = by_jax(function, [x.astype(other) for x in args])
                error = np.max(np.abs(coarse[k][i].astype(dtype) - theirs[i]))
                decided = is_special and not _agree(coarse[k][i].astype(dtype), theirs[i], TOLERANCE["float32"])
                ratio = np.finfo(np.float64).eps / np.finfo(np.float32).eps if dtype == jnp.float64 else 1.0
                if decided or np.all(np.abs(mine[i] - theirs[i]) <= 100 * ratio * error):
                    verdicts["rounding"] += 1
                    continue
            # A listed rule may decide a comparison or an angle, so that finite numbers differ.
            if i not in rules:
                rules[i] = set()
                trace_and_evaluate(differentiated(function), *(x[i] for x in args), met=rules[i])
            if not rules[i]:
                verdicts["different", name, i] += 1
            else:
                verdicts["rounding" if rules[i] == {CONTRACTION} else "follows from a listed rule"] += 1
    return verdicts


def _agree(mine, theirs, tolerance: float) -> bool:
    finite = np.isfinite(theirs)
    scale = 1 + np.max(np.abs(theirs[finite]), initial=0.0)
    with np.errstate(invalid="ignore"):
        return bool(
            np.array_equal(mine[~finite], theirs[~finite], equal_nan=True)
            and np.all(np.abs(mine[finite] - theirs[finite]) <= tolerance * scale)
        )


def _is_listed(mine, theirs, tolerance: float) -> bool:
    """Whether all that differs is a number in place of not a number (0 times it, or it less itself), or the sign of 1/0."""
    others = np.isnan(theirs) | (np.isinf(theirs) & np.isinf(mine))
    return _agree(np.where(others, 0.0, mine), np.where(others, 0.0, theirs), tolerance)


def _spread(function: Callable, args, wanted) -> list[np.ndarray]:
    """How much the results change where the point changes by its rounding."""
    x, *more = args
    eps = jnp.asarray(np.finfo(x.dtype).eps, x.dtype)
    pattern = jnp.asarray([1, -1, 1], x.dtype)
    changes = [by_jax(function, (x * (1 + sign * eps * pattern), *more)) for sign in (4, -4)]
    with np.errstate(invalid="ignore"):
        return [
            np.nan_to_num(np.maximum(*(np.abs(c[k] - wanted[k]).max(-1, keepdims=True) for c in changes)))
            for k in range(len(wanted))
        ]


def _is_rounding_of_sines(function: Callable, args, k: int, i: int, wanted) -> bool:
    """Decide whether the result k of sample i changes where sines change by what docs/algorithms.md admits."""
    sample = [x[i] for x in args]
    results = [trace_and_evaluate(differentiated(function), *sample, sine_error=error)[k] for error in (-1.5, 1.5)]
    dtype = args[0].dtype.name
    return not all(_agree(x, wanted[k][i], TOLERANCE[dtype]) for x in results)


def compare(seed: int, is_through_xla: bool) -> collections.Counter:
    """Verdicts about the function of a seed."""
    rng = np.random.default_rng(seed)
    function = random_function(rng)
    dtype = jnp.float32 if seed % 5 == 4 else jnp.float64
    args = points(rng, dtype)
    wanted = by_jax(function, args)
    computed = through_xla(function, args) if is_through_xla else by_kernel(function, args, lanes=(1, 4, 8)[seed % 3])
    verdicts = judge(function, args, computed, wanted)
    for verdict in verdicts:
        if isinstance(verdict, tuple):
            k = NAMES.index(verdict[1])
            print(
                f"seed {seed}: {function.steps}, {dtype.__name__}, {verdict[1:]} at {np.asarray(args[0][verdict[2]])}:"
            )
            print(f"    kernel {computed[k][verdict[2]]}\n    JAX    {wanted[k][verdict[2]]}", flush=True)
    return verdicts


def main(argv: list[str] | None = None) -> int:
    """Compare and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="functions (default: 10000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first function (default: 0)")
    parser.add_argument(
        "--through-xla", type=int, default=50, metavar="N", help="each Nth function within XLA (default: 50)"
    )
    options = parser.parse_args(argv)
    from jaxdyn.compile import disk

    jax.config.update("jax_enable_x64", True)
    total: collections.Counter = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        disk.set_cache_folder(folder)
        try:
            for seed in range(options.seed, options.seed + options.count):
                for verdict, count in compare(seed, seed % options.through_xla == 0).items():
                    total[verdict if isinstance(verdict, str) else "different"] += count
                if (seed + 1) % 500 == 0:
                    jax.clear_caches()  # the traces of 10 000 functions fill the memory
                    print(f"{seed + 1 - options.seed} functions: {dict(total)}", flush=True)
        finally:
            disk.set_cache_folder(None)
    print(f"{options.count} functions, {sum(total.values())} results of three numbers: {dict(total)}")
    return int(total["different"] > 0)


if __name__ == "__main__":
    sys.exit(main())
