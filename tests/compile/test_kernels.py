"""Native kernels: what their programs hold, each operation against JAX, derivatives, batches, modes, threads and files."""

import concurrent.futures
import contextlib
import ctypes
import hashlib
import logging
import math
import os
import re
import threading
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax._src.lax import lax as of_jax
from kernel_helpers import by_kernel, native, quick, refuse

from jaxdyn import compile as backend
from jaxdyn.compile import derive, disk, evaluate, kernels, known, mode, operations, stored, target, trace
from jaxdyn.compile.code import kernel_ir
from jaxdyn.compile.expansion import NotNumbers, expand
from jaxdyn.compile.operations import as_operations
from jaxdyn.compile.trace import program_of

pytestmark = pytest.mark.native

RNG = np.random.default_rng(0)
FLOATS = (jnp.float64, jnp.float32)


def numbers_of(function, *args, most=100_000):
    """The program of a function."""
    return expand(jax.make_jaxpr(function)(*args), most)[0]


def cost(function, *args):
    return numbers_of(function, *args).cost


def assert_same(computed, wanted, tolerance=1e-13):
    assert jax.tree.structure(computed) == jax.tree.structure(wanted)
    for x, (path, y) in zip(jax.tree.leaves(computed), jax.tree.leaves_with_path(wanted), strict=True):
        assert x.dtype == y.dtype and x.shape == y.shape, (path, x.dtype, x.shape, y.dtype, y.shape)
        x, y = np.asarray(x, float), np.asarray(y, float)
        atol = tolerance * (1 + np.max(np.abs(np.nan_to_num(y, posinf=0, neginf=0)), initial=0.0))
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=atol, err_msg=str(path))


def check(function, *args, tolerance=1e-13):
    """The kernel of a function of one sample, for a batch of such samples and for the first one, against the function itself."""
    wanted = quick(jax.vmap(function))(*args)
    assert_same(jax.jit(jax.vmap(native(function)))(*args), wanted, tolerance)
    computed = by_kernel(function, *(x[0] for x in args))
    first = jax.tree.map(lambda x: x[0], wanted)
    assert_same(jax.tree.unflatten(jax.tree.structure(first), computed), first, tolerance)


def normal(*shape, dtype=jnp.float64):
    return jnp.asarray(RNG.normal(size=shape), dtype)


# --- programs ---


def test_known_zeros_and_ones_cost_nothing():
    x = normal(3)
    eye = np.eye(3)
    assert cost(lambda x: eye @ x + 0.0, x) == 0
    assert cost(lambda x: 1.0 * x - 0.0, x) == 0
    assert cost(lambda x: jnp.stack([x[0] * 0.0, x[1] - x[1], x[2] / 1.0]), x) == 0
    assert cost(lambda x: (jnp.cos(x), x[0])[1], x) == 0  # what no output needs
    assert cost(lambda x: jax.hessian(lambda z: z[0] * z[1])(x), x) == 0
    assert cost(lambda x: np.diag([2.0, 0.0, 1.0]) @ x, x) == 1
    factor = partial(lax.linalg.cholesky, symmetrize_input=False)
    assert cost(lambda x: factor(jnp.diag(x)), x) == 3 and cost(factor, jnp.eye(3)) > 10


def test_equal_numbers_are_made_once():
    x = normal(3)
    assert cost(lambda x: jnp.stack([jnp.sin(x[0]), jnp.sin(x[0]) * jnp.sin(x[0])]), x) == 2
    assert cost(lambda x: jnp.stack([x[0] * x[1], x[1] * x[0], -(x[0] * -x[1])]), x) == 1
    assert cost(lambda x: jnp.stack([x[0] - x[1], x[1] - x[0]]), x) == 1
    assert cost(lambda x: jnp.stack([jnp.cos(x[0]), jnp.cos(-x[0]), jnp.sin(-x[0]), -jnp.sin(x[0])]), x) == 2
    # Products with known numbers are not reassociated: (x 1e200) 1e200 overflows where x 1e400 would not be a number at all.
    assert cost(lambda x: jnp.stack([2.0 * (3.0 * x[0]), 6.0 * x[0]]), x) == 3


def test_known_numbers_that_compare_equal_are_kept_apart():
    """Zeros of both signs, and numbers of several dtypes, in the same places of equal operations."""

    def function(x):
        whole = jnp.where(x > 0, np.int64(1), np.int64(3)), jnp.where(x > 0, np.float32(1), np.float32(3))
        signed = jnp.where(x > 5, 1.0, 0.0), jnp.where(x > 5, 1.0, -0.0)
        turns = jnp.arctan2(0.0, x), jnp.arctan2(-0.0, x)
        return whole, signed, turns, (1.0 / jnp.where(x > 5, x, 0.0), 1.0 / jnp.where(x > 5, x, -0.0))

    x = jnp.array([-1.0, 2.0])
    computed, wanted = jax.jit(native(function))(x), jax.jit(function)(x)
    assert_same(computed, wanted)
    np.testing.assert_array_equal(*(np.signbit(y[1]) for y in (computed, wanted)))


# --- each operation ---

UNARY = {
    "neg": jnp.negative, "abs": jnp.abs, "sign": jnp.sign, "floor": jnp.floor, "ceil": jnp.ceil, "round": jnp.round,
    "square": jnp.square, "sin": jnp.sin, "cos": jnp.cos, "tan": jnp.tan, "atan": jnp.arctan, "sinh": jnp.sinh,
    "cosh": jnp.cosh, "tanh": jnp.tanh, "exp": jnp.exp, "exp2": jnp.exp2, "expm1": jnp.expm1, "cbrt": jnp.cbrt,
    "integer_pow": lambda x: x**5, "inverse": lambda x: x**-3, "copy": partial(jnp.array, copy=True),
}  # fmt: skip
POSITIVE = {  # of numbers between 0 and 1
    "sqrt": jnp.sqrt, "rsqrt": lax.rsqrt, "log": jnp.log, "log1p": jnp.log1p, "log2": jnp.log2, "asin": jnp.arcsin,
    "acos": jnp.arccos,
}  # fmt: skip
BINARY = {
    "add": jnp.add, "sub": jnp.subtract, "mul": jnp.multiply, "div": jnp.divide, "max": jnp.maximum, "min": jnp.minimum,
    "atan2": jnp.arctan2, "rem": lax.rem, "pow": lambda x, y: jnp.abs(x) ** y, "dot": jnp.dot,
}  # fmt: skip
TOLERANCE = {jnp.float64: 1e-14, jnp.float32: 1e-6}


@pytest.mark.parametrize("dtype", FLOATS, ids=["float64", "float32"])
def test_elementwise_functions(dtype):
    """Twenty random numbers, infinities, zeros and not a number, of each function at once."""
    special = [0.0, -0.0, np.inf, -np.inf, np.nan, 1.0, -1.0, 0.5, 1.5, 2.5, -2.5]
    x = jnp.asarray(np.concatenate([RNG.normal(size=20) * 2, special]), dtype)
    y = jnp.asarray(np.concatenate([RNG.normal(size=20) * 2, special[3:], special[:3]]), dtype)
    # asin and acos beyond 1 are not numbers.
    check(lambda x: {name: f(x) for name, f in (UNARY | POSITIVE).items()}, x, tolerance=4 * TOLERANCE[dtype])
    binary = {name: f for name, f in BINARY.items() if name != "dot"}
    check(lambda x, y: {name: f(x, y) for name, f in binary.items()}, x, y, tolerance=4 * TOLERANCE[dtype])


@pytest.mark.parametrize("dtype,most", [(jnp.float64, 1e7), (jnp.float32, 1e4)], ids=["float64", "float32"])
def test_sine_and_cosine(dtype, most):
    """One unit in the last place of 1 of all finite angles, on both sides of `most`; not a number at infinity."""
    mpmath = pytest.importorskip("mpmath")
    rng = np.random.default_rng(0)
    exact = np.array([0.0, -0.0, 1e-30, np.pi / 4, np.pi / 2, np.pi, -np.pi, 1e-7])
    x = np.concatenate([exact, rng.uniform(-4, 4, 300), rng.uniform(-1, 1, 300) * np.geomspace(4, most, 300)])
    x = np.asarray(x, dtype)
    both = jax.jit(jax.vmap(native(lambda x: (jnp.sin(x), jnp.cos(x)))))
    eps = float(jnp.finfo(dtype).eps)
    with mpmath.workprec(200):
        for got, exact in zip(both(jnp.asarray(x)), (mpmath.sin, mpmath.cos), strict=True):
            want = np.array([float(exact(mpmath.mpf(float(xi)))) for xi in x])
            assert np.abs(np.asarray(got, float) - want).max() < 1.1 * eps
    # The number of 53 bits that is nearest to a multiple of pi/2, and the largest number; the others keep theirs beside them.
    far = np.asarray([most * 1e3, -most * 1.7e4, 1e17, 3e30, jnp.finfo(dtype).max, 0.5], dtype)
    far[0] = far[0] if dtype == jnp.float32 else 6381956970095103 * 2.0**797
    with mpmath.workprec(2500):
        want = [[float(f(mpmath.mpf(float(x)))) for x in far] for f in (mpmath.sin, mpmath.cos)]
    for got in (both(jnp.asarray(far)), (operations.sine(jnp.asarray(far)), operations.cosine(jnp.asarray(far)))):
        assert np.abs(np.asarray(got, float) - want).max() < 1.1 * eps
    one = jax.jit(native(lambda x: (jnp.sin(x), jnp.cos(x))))
    assert np.abs(np.asarray([one(x) for x in jnp.asarray(far)], float).T - want).max() < 1.1 * eps
    assert np.isnan(both(jnp.asarray([jnp.inf, -jnp.inf, jnp.nan], dtype))[1]).all()


@jax.custom_jvp
def _own_jvp(x):
    return 2 * x


_own_jvp.defjvp(lambda primals, tangents: (2 * primals[0], 5 * tangents[0]))


@jax.custom_vjp
def _own_vjp(x):
    return 3 * x


_own_vjp.defvjp(lambda x: (3 * x, None), lambda _, g: (7 * g,))


@jax.custom_vjp
def _constant_with_a_rule():
    return jnp.ones(())


_constant_with_a_rule.defvjp(lambda: (jnp.ones(()), None), lambda _, __: ())

# Comparisons of the total order, which jax has since 0.12.
ORDERS = [getattr(of_jax, name) for name in ("lt_to_p", "le_to_p") if hasattr(of_jax, name)]
PLACES = np.array([2, 0, 2])
PAIRS = np.array([[1, 2], [0, 3], [1, 2]])
MASK = np.array([True, False, True, True])


def _definite(x):
    return x @ x.T + 3 * jnp.eye(x.shape[0], dtype=x.dtype)


def _scanned(x, reverse=False):
    return lax.scan(lambda c, row: (c * 0.5 + row, (c[0], row.sum())), x[0], x, reverse=reverse)


OPERATIONS = {
    "comparisons": lambda x: (x > 0, x >= x[:, :1], x < 0.1, x <= 0.1, x == x[:1, :1], x != x[:1, :1], jnp.isfinite(x)),
    "total order": lambda x: (x, *(order.bind(x, x[::-1]) for order in ORDERS)),
    "logic": lambda x: ((x > 0) & (x < 1), (x > 0) | (x < -1), ~(x > 0)),
    "compared flags": lambda x: ((x > 0) == (x < 1), (x > 0) < (x < 1), (x > 0) >= (x < 1)),
    "flags": lambda x: (jnp.maximum(x > 0, x > 1), jnp.minimum(x > 0, x > 1), (x > 0).max(), (x > 0).sum()),
    "known numbers": lambda x: (
        jnp.maximum(k := jnp.arange(3.0), 1.0), jnp.stack([k, x[0, :3]]).max(1), jnp.clip(k, 0.5, 1.5), jnp.arctan2(k, 2.0)
    ),
    "select": lambda x: (jnp.where(x > 0, x, -x), jnp.where(MASK, x, 1.0), jnp.where(x > 0, 2.0, 3.0)),
    "several": lambda x: lax.select_n(jnp.asarray(PLACES), x[0, :3], x[1, :3], x[2, :3]),
    "clamp": lambda x: (jnp.clip(x, -0.3, 0.4), lax.clamp(x[0, 0], x, x[0, 1])),
    "reduce": lambda x: (x.sum(), x.sum(0), x.max(1), x.min(), x.prod(1), (x > 0).all(0), (x > 0).any(1)),
    "nothing": lambda x: (x[:0].sum(0), x[:, :0].sum(1), x[:0], x[:, :0] @ x[:0], x[:0] @ x.T, x[:0].sum()),
    "cumsum": lambda x: (jnp.cumsum(x, 0), lax.cumsum(x, 1, reverse=True)),
    "mean": lambda x: (x.mean(), x.var(1), jnp.linalg.norm(x, axis=1)),
    "product": lambda x: (x @ x.T, x.T @ x, jnp.einsum("ij,ik->ijk", x, x), jnp.einsum("ij,ij->i", x, x), jnp.outer(x[0], x[1])),
    "known product": lambda x: (np.arange(9.0).reshape(3, 3) @ x, x @ np.eye(4)),
    "moves": lambda x: (x.T, x.reshape(2, 6), lax.reshape(x, (2, 6), (1, 0)), x[::-1], x[None], x[::2], jnp.tile(x, (2, 1))),
    "joins": lambda x: (jnp.concatenate([x, x + 1]), jnp.stack([x, 2 * x], 1), jnp.split(x, 2, 1), jnp.unstack(x)),
    "pad": lambda x: (lax.pad(x, 0.5, [(1, 2, 0), (0, 0, 1)]), jnp.pad(x, 1)),
    "broadcast": lambda x: (jnp.broadcast_to(x, (2, 3, 4)), x[:, None] + x[None], jnp.full((2, 2), x[0, 0])),
    "polynomial": lambda x: lax.polynomial(x[0], [1.0, x[1], -2.0]) if hasattr(lax, "polynomial") else x,  # since 0.12
    "iota": lambda x: jnp.arange(12.0).reshape(3, 4) + x,
    "gather": lambda x: (x[PAIRS[:, 0], PAIRS[:, 1]], x[PLACES], x[:, PLACES], x[-1], x[PLACES[:, None], PLACES[None]]),
    "take": lambda x: (jnp.take(x, PLACES, 1), jnp.take_along_axis(x, PAIRS, 1), x.at[PLACES, 9].get(mode="clip")),
    "scatter": lambda x: (x.at[PLACES, 1].add(x[:, 0]), x.at[1].set(x[2]), x.at[np.array([0, 2]), np.array([1, 3])].set(7.0)),
    "scatter outside": lambda x: (x.at[np.array([1, 99, -1]), 0].set(7.0, mode="drop"), x.at[9].add(1.0, mode="clip")),
    "dynamic": lambda x: (lax.dynamic_slice(x, (1, 1), (2, 2)), lax.dynamic_slice(x, (9, -3), (2, 2))),
    "dynamic update": lambda x: (lax.dynamic_update_slice(x, 2 * x[:2, :2], (1, 1)), lax.dynamic_update_slice(x, x[:1], (9, 0))),
    "convert": lambda x: (x.astype(int), x.astype(jnp.int32), x > 0, (x > 0).astype(float), x.astype(jnp.float32)),
    "integers": lambda x: (x.astype(int) * 3 + 1, -x.astype(int), x.astype(int) ** 2, jnp.maximum(x.astype(int), 0)),
    "wide integers": lambda x: (x.astype(jnp.int32).astype(int), x.astype(int).astype(jnp.int32), x.astype(int).astype(float)),
    "cholesky": lambda x: jnp.linalg.cholesky(_definite(x)),
    "cholesky of several": lambda x: jnp.linalg.cholesky(jnp.stack([_definite(x), 2 * _definite(x)])),
    "solve": lambda x: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(_definite(x)), True), x),
    "scan": _scanned,
    "scan backwards": partial(_scanned, reverse=True),
    "largest of nothing": lambda x: (jnp.max(jnp.abs(x[:0]), initial=0.0) + x[0], jnp.max(np.zeros(0), initial=2.0) * x[1]),
    "scan of nothing": lambda x: lax.scan(lambda c, row: (c + row, c), x[0], x[:0]),
    "for": lambda x: lax.fori_loop(0, 3, lambda i, y: y + i * x, x),
    "while": lambda x: lax.while_loop(lambda s: s[0] < 4, lambda s: (s[0] + 1, s[1] * 0.9), (0, x)),
    "cond": lambda x: (lax.cond(np.asarray(True), jnp.sin, jnp.cos, x), lax.switch(np.asarray(1), [jnp.sin, jnp.tan], x)),
    "inner": lambda x: (jax.checkpoint(jnp.sin)(x), jax.jit(jnp.cos)(x), _own_jvp(x), lax.stop_gradient(x)),
    "reverse rule": lambda x: x + _constant_with_a_rule(),
    "barrier": lambda x: lax.optimization_barrier((x, 2 * x)),
    "derivatives": lambda x: (jax.grad(lambda x: jnp.sum(jnp.sin(x) * x**2))(x), jax.hessian(lambda z: (z**3).sum())(x[0])),
    "linear solve": lambda x: lax.custom_linear_solve(
        lambda y: 2 * y, x[0], lambda _, b: b / 2, symmetric=True
    ),
    "cross": lambda x: jnp.cross(x[0, :3], x[1, :3]),
    "outputs that are inputs": lambda x: (x, x[0], jnp.zeros(2), jnp.arange(3), True),
}  # fmt: skip


def test_operations():
    every = {name: lambda x, f=f: jax.tree.map(jnp.asarray, f(x)) for name, f in OPERATIONS.items()}
    check(lambda x: {name: f(x) for name, f in every.items()}, 1.5 * normal(3, 3, 4), tolerance=1e-12)


@pytest.mark.parametrize("dtype", FLOATS, ids=["float64", "float32"])
def test_triangular_solves(dtype):
    """Both sides, both triangles, transposed and with a unit diagonal."""
    T = normal(3, 3, 3, dtype=dtype) / 4 + 2 * jnp.eye(3, dtype=dtype)[None]

    def function(T, b):
        rows = []
        for k in range(16):
            left, lower, turned, unit = (bool(k >> i & 1) for i in range(4))
            rows.append(
                lax.linalg.triangular_solve(
                    T, b if left else b.T, left_side=left, lower=lower, transpose_a=turned, unit_diagonal=unit
                )
            )
        return rows

    check(function, T, normal(3, 3, 2, dtype=dtype), tolerance=1e-13 if dtype == jnp.float64 else 1e-5)


def test_a_matrix_that_is_not_definite_has_no_factor():
    computed = jax.jit(native(lambda a: jnp.linalg.cholesky(a)))(jnp.diag(jnp.array([1.0, -1.0, 2.0])))
    assert np.isnan(np.diag(computed)).any()


def test_rounding_of_halves():
    """Each way of rounding, of numbers that are known and that are not."""
    halves = jnp.array([0.5, 1.5, -0.5, -2.5, 2.5, 0.3])

    def function(_, x):
        ways = lax.RoundingMethod.TO_NEAREST_EVEN, lax.RoundingMethod.AWAY_FROM_ZERO
        return [(lax.round(x, method), lax.round(halves, method) * jnp.sin(x)) for method in ways]

    assert_same(jax.jit(lambda x: backend.kernel(function)((), x))(halves), jax.jit(partial(function, ()))(halves))


def test_integers():
    """Arithmetic of integers, and conversions of numbers that are too large for them."""
    n, x = jnp.array([7, -7, 0, 3]), jnp.array([1e30, -1e30, jnp.nan, 2.9])

    def function(_, n, x):
        division = n // 2, n % 3, lax.rem(n, jnp.asarray(3)), jnp.abs(n), jnp.sign(n), n.sum(), n.prod(), jnp.cumsum(n)
        bits = n & 5, n | 5, n ^ 5, ~n, n << 1
        powers = lax.pow(jnp.full(4, x[3]), n), 2.0 ** n.astype(float)
        return division, bits, powers, x.astype(int), x.astype(jnp.int32), n.astype(jnp.float32), n == 7

    wanted = quick(partial(function, ()))(n, x)
    assert_same(jax.jit(lambda *a: backend.kernel(function)((), *a))(n, x), wanted)
    # Each of them alone, so that one without a kernel does not take the others with it.
    parts = [lambda _, n, x, part=part: function((), n, x)[part] for part in range(7)]
    assert_same(tuple(quick(lambda *a: [backend.kernel(f)((), *a) for f in parts])(n, x)), wanted)


# --- what is no program of numbers ---


def _asked(x):
    return jax.pure_callback(lambda y: np.asarray(y) * 2, jax.ShapeDtypeStruct(x.shape, x.dtype), x)


WITHOUT = {
    "callback": (_asked, "callback"),
    "cond": (lambda x: lax.cond(x[0, 0] > 0, jnp.sin, jnp.cos, x), "branch is not known"),
    "svd": (lambda x: jnp.linalg.svd(x, compute_uv=False), "svd"),
    "sort": (jnp.sort, "sort"),
    "qr": (lambda x: jnp.linalg.qr(x)[1], "qr"),
    "place": (lambda x: jnp.tile(x, (99, 1))[(x[0, 0] > 0).astype(int)], "at one of 297 places that is not known"),
    "complex": (lambda x: jnp.abs(x.astype(complex) * (1 + 1j)), "complex"),
    "custom_vjp": (lambda x: _own_vjp(x) * x, "reverse alone"),
    "half": (lambda x: x.astype(jnp.float16), "float16"),
    "random": (lambda x: x + jax.random.normal(jax.random.key(0), x.shape) * x.sum(), ""),
}


@pytest.mark.parametrize("name", WITHOUT)
def test_what_is_not_numbers_runs_as_it_is(name, caplog, monkeypatch):
    function, reason = WITHOUT[name]
    monkeypatch.setattr(mode, "_said", set())
    x = normal(3, 4) + 2

    def named(_, x):
        return function(x)

    with caplog.at_level(logging.WARNING, "jaxdyn"):
        computed = jax.jit(lambda x: backend.kernel(named)((), x))(x)
        jax.jit(lambda x: backend.kernel(named)((), 2 * x)).lower(x)
    assert_same(computed, quick(function)(x), 1e-12)
    if name == "random":
        return  # jax may compute it with numbers
    assert reason in caplog.text and caplog.text.count("runs on JAX's own operations") == 1
    with pytest.raises(NotNumbers, match=reason):
        numbers_of(function, x)


def test_what_happens_elsewhere_happens_in_every_call():
    heard = []

    def loud(_, x):
        jax.debug.callback(lambda y: heard.append(float(y)), x.sum())
        return 2 * x

    step = jax.jit(lambda x: backend.kernel(loud)((), x))
    for k in range(3):
        step(jnp.full(2, float(k)))
    jax.effects_barrier()
    assert heard == [0.0, 2.0, 4.0]


def test_another_way_is_taken_without_a_word(caplog):
    with caplog.at_level(logging.WARNING, "jaxdyn"):
        computed = backend.kernel(lambda _, x: jnp.sort(x), fallback=lambda _, x: jnp.zeros(3))((), normal(3))
    assert not computed.any() and not caplog.records
    # Three sines and three products.
    assert "more than 5 operations" in str(program_of(lambda _, x: jnp.sin(x) * x, (), (), (normal(3),), maximum=5)[1])
    assert not isinstance(program_of(lambda _, x: jnp.sin(x) * x, (), (), (normal(3),), maximum=9)[1], str)


# --- derivatives ---


def _smooth(x):
    """Every function with a derivative; x between 0.1 and 0.9."""
    one = {name: f(x) for name, f in (UNARY | POSITIVE).items() if name not in ("floor", "ceil", "round")}
    two = {name: f(x, x[::-1] + 0.05) for name, f in BINARY.items()}
    chosen = jnp.where(x > 0.4, x * x, jnp.sin(x)), jnp.clip(x, 0.3, 0.7), x.max(), x.min(), x.prod(), jnp.cumsum(x)
    factor = jnp.linalg.cholesky(_definite(jnp.outer(x, x)))
    casts = x.astype(jnp.float32).astype(x.dtype), jnp.where(x > 0.4, x, 0.0) % 0.13, x**0.7, 1.3**x
    return one, two, chosen, factor, jax.scipy.linalg.solve_triangular(factor, x, lower=True), casts


def _all_of(function):
    """A vector that holds every output."""
    return lambda *args: jnp.concatenate([jnp.ravel(y) for y in jax.tree.leaves(function(*args))])


@pytest.mark.long
def test_derivatives_of_every_function():
    """First and second, in both modes and mixed, against JAX's own Jacobian and Hessian."""
    x, step, plain = jnp.asarray(RNG.uniform(0.1, 0.9, 2)), jnp.array([0.5, -1.25]), _all_of(_smooth)
    # Numbers that a cast to float32 and back leaves alone.
    weights, f = jnp.cos(jnp.arange(jax.eval_shape(plain, x).size)).astype(jnp.float32).astype(float), native(plain)

    def weighed(f):
        return lambda x: jnp.vdot(weights, f(x))

    @quick
    def transforms(x, step):
        first = jax.jvp(f, (x,), (step,)), jax.grad(weighed(f))(x), jax.jacfwd(f)(x), jax.jacrev(f)(x)
        return *first, jax.hessian(weighed(f))(x), jax.jacrev(jax.jacfwd(weighed(f)))(x)

    y, J, H = quick(lambda x: (plain(x), jax.jacfwd(plain)(x), jax.hessian(weighed(plain))(x)))(x)
    # Second derivatives of the solution with a factor: some hundred roundings.
    assert_same(transforms(x, step), ((y, J @ step), weights @ J, J, J, H, H), 1e-11)


@pytest.mark.long
def test_derivatives_of_operations():
    """Reverse mode of what moves entries, and of loops."""
    x = 1.5 * normal(3, 4)
    names = "reduce nothing cumsum product moves joins pad gather take scatter dynamic scan cond for solve barrier inner".split()
    names += ["dynamic update", "linear solve"]

    def plain(x):
        computed = []
        for name in names:
            leaves = [y for y in jax.tree.leaves(OPERATIONS[name](x)) if jnp.issubdtype(y.dtype, jnp.floating)]
            computed.append(sum(jnp.sum(jnp.sin(y + 0.1)) for y in leaves))
        return jnp.stack(computed)

    computed, wanted = quick(jax.jacrev(native(plain)))(x), quick(jax.jacrev(plain))(x)
    for name, one, other in zip(names, computed, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-11, err_msg=name)


def test_functions_with_rules_of_their_own_keep_them():
    x = normal(3)
    f = native(lambda x: (_own_jvp(x), jnp.sin(x)))
    _, (step, _) = jax.jit(lambda x: jax.jvp(f, (x,), (jnp.ones(3),)))(x)
    np.testing.assert_allclose(step, 5 * np.ones(3))
    np.testing.assert_allclose(jax.jit(jax.jacrev(lambda x: f(x)[0]))(x), 5 * np.eye(3))
    run = jax.jit(jax.grad(lambda x: backend.kernel(lambda _, x: _own_vjp(x).sum())((), x)))
    np.testing.assert_allclose(run(x), 7 * np.ones(3))


def test_only_what_moves_is_differentiated():
    made = numbers_of(lambda x, y: jnp.sin(x) * jnp.cos(y), jnp.ones(()), jnp.ones(()))
    assert derive.tangent(made, (True, False)).cost < derive.tangent(made, (True, True)).cost
    assert derive.tangent(made, (True, False)) is derive.tangent(made, (True, False))
    with_whole = native(lambda x, n: (x * n.astype(x.dtype), n + 1))
    x, n = normal(3), jnp.arange(3)
    (value, whole), (step, none) = jax.jvp(with_whole, (x, n), (jnp.ones(3), np.zeros(3, jax.dtypes.float0)))
    np.testing.assert_allclose(step, n)
    assert none.dtype == jax.dtypes.float0 and whole.tolist() == [1, 2, 3] and value.shape == (3,)
    assert jax.grad(lambda x: with_whole(x, n)[0].sum())(x).tolist() == [0, 1, 2]


def test_derivatives_at_zeros_of_a_product_with_not_a_number():
    """What is chosen away with `where` reaches gradients as it does in JAX: the safe argument is chosen first."""

    def root(x):
        safe = jnp.where(x > 0, x, 1.0)
        return jnp.where(x > 0, jnp.sqrt(safe), 0.0)

    assert jax.jit(jax.vmap(jax.grad(native(root))))(jnp.array([-1.0, 0.0, 4.0])).tolist() == [0, 0, 0.25]


# --- batches ---


def _mixed(factors, x, n, flag):
    """Arrays of several dtypes and shapes, known numbers, reductions, and outputs that are arguments or constants."""
    rows = jnp.stack([x, factors * x[::-1], jnp.where(flag, x, -x)])
    total = jnp.sum(rows, axis=0) + jnp.min(rows) * n.astype(x.dtype)
    whole = {"larger": n + 1, "same": x, "known": jnp.asarray(factors), "which": x > 0}
    return {"total": total, "corner": rows[1:, :2]} | whole


FACTORS = np.array([1.0, 0.0, -2.0])
MIXED = native(partial(_mixed, FACTORS))


def mixed_args(dtype=jnp.float64):
    return jnp.array([0.3, -1.2, 2.5], dtype), jnp.asarray(4, jnp.int32), jnp.asarray(True)


def test_batches():
    """Arguments with and without a batch, along other axes than the first."""
    x, n, flag = normal(3, 300), jnp.asarray(4, jnp.int32), jnp.arange(300) % 3 == 0
    axes = (1, None, 0)
    wanted = quick(jax.vmap(partial(_mixed, FACTORS), axes))(x, n, flag)
    run = jax.jit(jax.vmap(MIXED, axes))
    for samples in (0, 1, 3, 13, 300):
        computed = run(x[:, :samples], n, flag[:samples])
        assert_same(computed, jax.tree.map(lambda y, end=samples: y[:end], wanted))


def test_nested_batches():
    """Of two and three levels, of which arguments have all, some or none."""
    x, n, flag = normal(4, 2, 3, 3), jnp.arange(2, dtype=jnp.int32), jnp.array([True, False, True, True])

    def over(function):
        inner = jax.vmap(function, (0, None, None))
        return jax.vmap(jax.vmap(inner, (0, 0, None)), (0, None, 0))

    assert_same(jax.jit(over(MIXED))(x, n, flag), quick(over(partial(_mixed, FACTORS)))(x, n, flag))
    crossed = jax.vmap(jax.vmap(MIXED, (None, 0, None)), (0, None, None))
    wanted = quick(jax.vmap(jax.vmap(partial(_mixed, FACTORS), (None, 0, None)), (0, None, None)))
    assert_same(jax.jit(crossed)(x[:, 0, 0], n, flag[0]), wanted(x[:, 0, 0], n, flag[0]))
    none = jnp.zeros((0, 2, 3, 3))
    assert jax.jit(over(MIXED))(none, n, flag[:0])["corner"].shape == (0, 2, 3, 2, 2)


def test_gradients_of_batches_sum_over_what_samples_share():
    x, y = normal(5, 3), normal(3)

    def total(function):
        return lambda x, y: jnp.sum(jax.vmap(function, (0, None))(x, y) ** 2)

    def plain(x, y):
        return jnp.sin(x) * y + y**2

    def gradients(function):
        per_sample = jax.vmap(jax.grad(lambda x, y: jnp.sum(function(x, y)), (0, 1)), (0, None))
        return quick(lambda x, y: (jax.grad(total(function), (0, 1))(x, y), per_sample(x, y)))(x, y)

    assert_same(gradients(native(plain)), gradients(plain))


@pytest.mark.parametrize("dtype", FLOATS, ids=["float64", "float32"])
def test_every_dtype_in_and_out(dtype):
    args = mixed_args(dtype)
    factors = FACTORS.astype(dtype)
    kernel = native(partial(_mixed, factors))
    tolerance = 1e-14 if dtype == jnp.float64 else 1e-6
    wanted = quick(partial(_mixed, factors))(*args)
    assert_same(jax.jit(kernel)(*args), wanted, tolerance)
    assert_same(kernel(*args), wanted, tolerance)  # without a program around it
    many = [jnp.stack([x] * 9) for x in args]
    assert_same(jax.jit(jax.vmap(kernel))(*many), quick(jax.vmap(partial(_mixed, factors)))(*many), tolerance)


def test_kernels_in_loops_and_branches():
    x = jnp.array([0.3, 0.2, 1.1])
    f, plain = native(lambda x: jnp.cos(x) * 0.9 + 0.1 * x[::-1]), lambda x: jnp.cos(x) * 0.9 + 0.1 * x[::-1]

    def everything(f, x):
        scanned = lax.scan(lambda y, _: (f(y), y.sum()), x, length=4)
        looped = lax.fori_loop(0, 5, lambda _, y: f(y), x)
        chosen = lax.cond(x[0] > 0, f, lambda x: x, x)
        until = lax.while_loop(lambda y: y[0] > 0.2, lambda y: 0.7 * y * f(y), x)
        each = jax.vmap(lambda y: lax.while_loop(lambda y: y[0] > 0.2, lambda y: 0.7 * y * f(y), y))
        return scanned, looped, chosen, until, each(jnp.stack([x, 2 * x, 0.1 * x])), jax.lax.map(f, jnp.stack([x, x]))

    def slope(f, x):
        return jax.grad(lambda x: lax.scan(lambda y, _: (f(y), None), x, length=4)[0].sum())(x)

    wanted, slope_wanted = quick(lambda x: (everything(plain, x), slope(plain, x)))(x)
    computed, slope_computed = quick(lambda x: (everything(f, x), slope(f, x)))(x)
    assert_same(computed, wanted)
    assert_same(everything(f, x), wanted)
    assert_same(slope_computed, slope_wanted)


def test_kernels_within_kernels_are_one():
    inner = native(lambda x: jnp.sin(x))
    outer = native(lambda x: inner(x) * x)
    text = str(jax.make_jaxpr(outer)(normal(3)))
    assert text.count("jaxdyn_kernel") == 1
    assert_same(jax.jit(outer)(jnp.ones(3)), jnp.sin(jnp.ones(3)))


# --- known and given models ---


def _affine(tree, x):
    return tree["a"] * x + tree["b"]


def test_known_leaves_are_compiled_in_and_traced_ones_are_arguments():
    tree, x = {"a": jnp.asarray(2.0), "b": jnp.asarray(0.0)}, normal(3)

    def run(tree, x):
        return backend.kernel(_affine, fallback=refuse)(tree, x)

    known = jax.make_jaxpr(lambda x: run(tree, x))(x).eqns[-1].params["program"]
    given = jax.make_jaxpr(run)(tree, x).eqns
    given = next(eqn for eqn in given if eqn.primitive.name == "jaxdyn_kernel").params["program"]
    assert (len(known.inputs), known.cost) == (1, 3) and (len(given.inputs), given.cost) == (3, 6)
    for computed in (jax.jit(run)(tree, x), jax.jit(lambda x: run(tree, x))(x), run(tree, x)):
        np.testing.assert_allclose(computed, 2 * x, rtol=1e-15)
    half = jax.jit(lambda b, x: run({"a": 2.0, "b": b}, x))(3.0, x)
    np.testing.assert_allclose(half, 2 * x + 3, rtol=1e-15)
    many = {"a": jnp.arange(4.0), "b": jnp.ones(4)}
    np.testing.assert_allclose(
        jax.jit(jax.vmap(run, (0, None)))(many, x), jnp.arange(4.0)[:, None] * x[None] + 1, rtol=1e-15
    )
    slope = jax.jit(jax.grad(lambda tree, x: run(tree, x).sum(), (0, 1)))(tree, x)
    assert_same(slope, ({"a": x.sum(), "b": jnp.asarray(3.0)}, jnp.full(3, 2.0)))


def test_a_function_is_traced_once():
    seen = []

    def times(power, tree, x):
        seen.append([known.is_concrete(leaf) for leaf in tree])
        return tree[0] * x**power + tree[1]

    two, x, y = (jnp.asarray(number, float) for number in (2.0, 3.0, 1.0))

    def program(x, y):
        first = backend.kernel(times, static=1)(3, (two, y), x)
        return first + backend.kernel(times, static=1)(3, (two, y), 2 * x)

    assert float(jax.jit(program)(x, y)) == 2 * 27 + 1 + 2 * 216 + 1
    assert float(jax.jit(jax.grad(program))(x, y)) == 6 * 9 + 12 * 36
    assert float(jax.jit(jax.grad(program, 1))(x, y)) == 2
    assert jax.jit(jax.vmap(program, (0, None)))(jnp.arange(3.0), y).tolist() == [2.0, 20.0, 146.0]
    assert seen == [[True, False]]
    # Another static argument, or another leaf though of the same value, is another program.
    assert float(jax.jit(lambda x: backend.kernel(times, static=1)(2, (two, x), x))(3.0)) == 21
    assert float(jax.jit(lambda x: backend.kernel(times, static=1)(2, (two + 0, x), x))(3.0)) == 21
    assert len(seen) == 3


def test_entries_that_are_set_later_are_seen():
    numbers = np.array([1.0, 2.0])

    def total(tree, x):
        return jnp.sum(tree[0]) * x

    def run():
        return float(jax.jit(lambda x: backend.kernel(total)((numbers,), x))(1.0))

    assert run() == 3 and run() == 3
    numbers[0] = 5.0
    assert run() == 7


@pytest.mark.parametrize("width", [1, 4])
def test_results_do_not_depend_on_the_level_of_the_compiler(width, monkeypatch):
    rng = np.random.default_rng(5)

    def function(A, x):
        y = A @ (jnp.sin(x) * x) - jnp.cos(A @ x)
        z = jnp.exp(-jnp.abs(y)) + jnp.log1p(y * y) / (1 + y * y) + jnp.cbrt(y) * jnp.tanh(y)
        z = z + jnp.abs(y) ** 2.0 + jnp.abs(y) ** 0.5 + jnp.exp2(z) + jnp.arctan2(y, z) + jnp.tan(y) * jnp.floor(z)
        return jnp.linalg.solve(A @ A.T + jnp.eye(4), z), jnp.where(z > y, z * y - x, x - z * y)

    A, x = rng.normal(size=(9, 4, 4)), rng.normal(size=(9, 4)) * 10
    text = kernel_ir(numbers_of(function, A[0], x[0]), width, [False, False])
    assert "fmuladd" in text
    results = []
    for level in (0, 1):
        monkeypatch.setattr(stored, "_level", lambda level=level: level)
        monkeypatch.setattr(stored, "wanted_options", lambda level=level: "" if level else "least")
        code, rows = stored.Code(stored.compile_text(text)), [np.empty((9, 4)), np.empty((9, 4))]
        data = (ctypes.c_void_p * 4)(*(y.ctypes.data for y in (A, x, *rows)))
        ctypes.CFUNCTYPE(None, ctypes.c_void_p, *[ctypes.c_int64] * 3)(code.address("kernel"))(data, 9, 0, 9)
        results.append(rows)
    np.testing.assert_array_equal(*results)
    np.testing.assert_allclose(results[0], jax.vmap(function)(A, x), rtol=1e-11)


# --- calls without XLA ---


def test_compute_gives_known_numbers_while_a_program_is_traced():
    tree, x = (jnp.asarray(2.0), np.array([1.0, 3.0])), np.array([0.5, 0.25])

    def scaled(tree, x):
        return {"y": tree[0] * tree[1] + jnp.sin(x), "n": jnp.arange(2), "large": x.sum() > 0.5}

    wanted = {"y": 2 * tree[1] + np.sin(x), "n": np.arange(2), "large": np.asarray(True)}
    rows = []

    def traced(z):
        rows.append(evaluate(scaled, tree, x))
        return z

    jax.jit(traced)(1.0)
    rows += [evaluate(scaled, tree, x), evaluate(scaled, tree, jnp.asarray(x), is_input=True)]
    with backend.compilation("plain"):
        rows.append(evaluate(scaled, tree, x))
    rows.append(evaluate(lambda tree, x: scaled(tree, jnp.sort(x)[::-1]), tree, x))  # no program of numbers
    for numbers in rows:
        assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(numbers))
        assert_same(numbers, wanted)


def test_functions_are_compiled_once_for_known_numbers():
    seen = []

    @backend.entry_point
    def look(x):
        seen.append(known.is_concrete(x))
        return 2 * x

    assert float(look(1.0)) == float(look(2.0)) / 2 == 2.0
    assert seen == [True] * len(seen) or seen == [False]  # traced once, or with its number known
    count = len(seen)
    with backend.compilation("plain"):
        assert float(look(jnp.asarray(1.0))) == 2.0
    assert len(seen) > count  # another mode is another program
    assert jax.vmap(look)(jnp.ones(2)).tolist() == [2.0, 2.0]
    assert float(jax.grad(look)(1.0)) == 2.0 and float(jax.jit(look)(1.0)) == 2.0


def test_what_is_known():
    assert known.is_known(1.0, np.ones(2), jnp.ones(2)) and not known.is_tracing()
    seen = []

    def look(x):
        inside = known.is_known(1.0), known.is_concrete(1.0), known.is_concrete(x), known.is_tracing()
        seen.append((*inside, mode.is_expanding()))
        return x

    jax.jit(look)(1.0)
    backend.kernel(lambda _, x: look(x))((), jnp.ones(()))
    assert seen == [(False, True, False, True, False), (False, True, False, True, True)]


# --- modes ---


def test_modes(monkeypatch):
    def has_kernel():
        return "jaxdyn_kernel" in str(jax.make_jaxpr(lambda x: backend.kernel(lambda _, x: jnp.sin(x))((), x))(1.0))

    monkeypatch.delenv("JAXDYN_COMPILATION", raising=False)
    assert has_kernel()
    with backend.compilation("plain"):
        assert not has_kernel()
        with backend.compilation("auto"):
            assert has_kernel()
        assert not has_kernel()
    assert has_kernel()
    with pytest.raises(ZeroDivisionError), backend.compilation("plain"):
        raise ZeroDivisionError
    assert has_kernel()
    monkeypatch.setenv("JAXDYN_COMPILATION", "plain")
    assert not has_kernel()
    with backend.compilation("auto"):
        assert has_kernel()
    monkeypatch.setenv("JAXDYN_COMPILATION", "fast")
    with pytest.raises(ValueError, match="JAXDYN_COMPILATION is 'fast'"):
        has_kernel()
    for wrong in ("machine", ""):
        with pytest.raises(ValueError, match="mode is"), backend.compilation(wrong):
            pass


def test_without_llvmlite_functions_run_on_jax(monkeypatch, caplog):
    monkeypatch.setattr(kernels, "target", None)
    monkeypatch.setattr(mode, "_said", set())
    with caplog.at_level(logging.WARNING, "jaxdyn"):
        for _ in range(2):
            assert float(backend.kernel(lambda _, x: 2 * x)((), jnp.ones(()))) == 2
            assert evaluate(lambda _, x: 2 * x, (), 1.0) == 2
    assert caplog.text.count("pip install llvmlite") == 1


def test_where_kernels_cannot_be_called_their_numbers_are_operations(monkeypatch, caplog):
    def fails(*_):
        raise target.Unsupported("no such processor")

    monkeypatch.setattr(target, "kernel", fails)
    monkeypatch.setattr(mode, "_said", set())
    args = mixed_args()
    with caplog.at_level(logging.WARNING, "jaxdyn"):
        fresh = native(partial(_mixed, FACTORS))
        wanted = quick(partial(_mixed, FACTORS))(*args)
        assert_same(quick(fresh)(*args), wanted)
        many = [np.stack([x] * 4) for x in args]
        assert_same(quick(jax.vmap(fresh))(*many), jax.tree.map(lambda y: np.stack([y] * 4), wanted))
        assert evaluate(lambda _, x: 2 * x, (), 1.0) == 2
    assert caplog.text.count("no such processor") == 1


@pytest.mark.long
def test_operations_of_jax_are_the_same_numbers():
    """What is lowered on other devices than a CPU, with operations of every kind."""
    batch = jnp.asarray(RNG.uniform(0.1, 0.9, (2, 2)))
    made = numbers_of(_all_of(_smooth), batch[0])
    computed = quick(partial(as_operations, program=made))(batch)[0]
    assert_same(computed, quick(jax.vmap(_all_of(_smooth)))(batch), 1e-12)
    args = mixed_args()
    made = numbers_of(partial(_mixed, FACTORS), *args)
    parts = quick(partial(as_operations, program=made))(*(np.reshape(x, -1) for x in args))
    wanted = jax.tree.leaves(quick(partial(_mixed, FACTORS))(*args))
    assert_same(parts, [np.reshape(y, -1) for y in wanted], 1e-14)


# --- threads, devices, processes ---


def test_threads_give_the_same_bits():
    """Four threads of Python that trace, compile and call at once, and chunks of a batch on XLA's threads and on one."""
    q = normal(2000, 3)
    computed, failed = [None] * 4, []
    start = threading.Barrier(4)

    def work(k):
        try:
            start.wait()
            for _ in range(3):
                run = jax.jit(jax.vmap(native(lambda x: jnp.sin(x) @ jnp.cos(x[::-1]) + x**3)))
                computed[k] = np.asarray(run(q))
        except BaseException as error:
            failed.append(error)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed, failed
    target.set_threads(1)
    try:
        work_alone = jax.jit(jax.vmap(native(lambda x: jnp.sin(x) @ jnp.cos(x[::-1]) + x**3)))(q)
    finally:
        target.set_threads(None)
    for numbers in computed:
        np.testing.assert_array_equal(numbers, work_alone)


def test_what_a_user_holds_fixed_stays_fixed():
    """lax.stop_gradient in a kernel, in a kernel called by it, and to second order."""

    def inner(x):
        return jnp.sin(x) * jax.lax.stop_gradient(x * x)

    def outer(x):
        return native(inner)(x) * jax.lax.stop_gradient(x) + x

    x = jnp.asarray(0.7)
    known = 0.7**3 * np.cos(0.7) + 1

    def derivatives(function):
        step = jax.jvp(function, (x,), (jnp.ones(()),))[1]
        return jax.grad(function)(x), step, jax.grad(jax.grad(function))(x)

    computed = quick(
        lambda: [derivatives(f) for f in (outer, native(outer), lambda x: native(outer)(jnp.stack([x, x])[0]))]
    )()
    for first, step, second in computed[1:]:
        np.testing.assert_allclose([first, step], known, rtol=1e-14)
        np.testing.assert_allclose(second, computed[0][2], rtol=1e-14)
    # No native inside: the derivative by hand.
    second = quick(jax.grad(jax.grad(native(inner))))(x)
    np.testing.assert_allclose(second, -(0.7**2) * np.sin(0.7), rtol=1e-14)


def test_exported_programs_run_in_their_process():
    allowed = [jax.export.DisabledSafetyCheck.custom_call(target.TARGET)]
    function = jax.jit(native(lambda x: jnp.sin(x) * 1.234567))
    exported = jax.export.export(function, disabled_checks=allowed)(jnp.ones(3))
    assert_same(exported.call(jnp.arange(3.0)), jnp.sin(jnp.arange(3.0)) * 1.234567)


def test_kernels_that_are_not_called_are_not_compiled():
    """The two branches of a condition, of which one is taken: one has code, and the other gets it at its first call."""
    double, triple = native(lambda x: 2.0 * x + jnp.sin(x)), native(lambda x: 3.0 * x + jnp.sin(x))
    run = jax.jit(lambda flag, x: jax.lax.cond(flag, double, triple, x))
    x, before = jnp.arange(3.0), set(target._kernels)
    assert_same(run(True, x), 2 * x + jnp.sin(x))
    new = [target._kernels[number] for number in target._kernels if number not in before]
    assert sorted(not made.is_made for made in new) == [False, True]
    assert_same(run(False, x), 3 * x + jnp.sin(x))
    assert all(made.is_made and made.program is None for made in new)


def test_threads_that_call_a_kernel_for_the_first_time_share_its_code(monkeypatch):
    """All wait for the one that compiles it, while other threads of Python go on."""
    made, code = [], target.Code
    monkeypatch.setattr(target, "Code", lambda *args, **options: made.append(args) or code(*args, **options))
    run = jax.jit(native(lambda x: jnp.cos(x) * 5.4321)).lower(jnp.ones(3)).compile()
    assert not made
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        computed = list(pool.map(lambda k: run(jnp.full(3, float(k))), range(8)))
    assert len(made) == 1
    for k, x in enumerate(computed):
        assert_same(x, jnp.cos(jnp.full(3, float(k))) * 5.4321)


def test_a_kernel_that_is_missing_is_said():
    """A program whose kernels this process does not have, as after it was stored by another one."""
    x = jnp.ones(3)
    run = jax.jit(native(lambda x: jnp.sin(x) * 2.345678)).lower(x).compile()
    number = next(reversed(target._kernels))
    slot = next(entry for entry in target._table if entry.hash == number)
    slot.hash = 1  # nobody's
    try:
        with pytest.raises(jax.errors.JaxRuntimeError, match="by another process"):
            jax.block_until_ready(run(x))
    finally:
        slot.hash = number
    assert_same(run(x), jnp.sin(x) * 2.345678)


def test_kernels_of_one_slot_take_the_next_free_one():
    """Numbers that are equal but for multiples of the size of the table, also at its end."""
    table, size = (target.Entry * target.SLOTS)(), target.SLOTS
    for number, slot in ((7, 7), (7 + size, 8), (2 * size - 1, size - 1), (size - 1, 0)):
        target.free_entry(table, number).hash = number
        assert table[slot].hash == number


# --- files of machine code ---

IR = "define double @f(double %x) {\n  %y = fmul double %x, CONSTANT\n  ret double %y\n}"


def code_of(number: float):
    text = IR.replace("CONSTANT", f"{number:.6e}")
    made = stored.code_of(text)
    function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(made.address("f"))
    return stored.name_of_file(hashlib.sha256(text.encode()).hexdigest()), made, function


def built(monkeypatch):
    """A list that grows when LLVM compiles."""
    seen = []
    compiled = stored.compile_text
    monkeypatch.setattr(stored, "compile_text", lambda *args: seen.append(args) or compiled(*args))
    return seen


def test_files_are_written_found_and_checked(folder, monkeypatch, caplog):
    seen = built(monkeypatch)
    name, _first, f = code_of(3.5)
    assert f(2.0) == 7.0 and len(seen) == 1
    (path,) = folder.glob("*.o")
    assert path.name == name and not list(folder.glob("*.part"))
    _, _held, again = code_of(3.5)
    assert again(2.0) == 7.0 and len(seen) == 1  # from the file
    good = path.read_bytes()
    for damaged in (good[:-1], good[:40] + b"x" + good[41:], b"", b"short"):
        path.write_bytes(damaged)
        caplog.clear()
        _, _held, rebuilt = code_of(3.5)
        assert rebuilt(2.0) == 7.0 and "damaged" in caplog.text
        assert path.read_bytes() == good
    assert len(seen) == 5


def test_another_processor_or_version_has_other_files(monkeypatch):
    before = stored.name_of_file("a program")
    assert stored.name_of_file("another program") != before
    monkeypatch.setattr(stored, "features", lambda: "+other")
    monkeypatch.setattr(stored, "_environment_of_code", stored._environment_of_code.__wrapped__)
    assert stored.name_of_file("a program") != before


def test_old_files_are_removed(folder, monkeypatch):
    for age, number in enumerate((1.5, 2.5, 3.5)):
        name, _, _ = code_of(number)
        os.utime(folder / name, (1000 - age, 1000 - age))
    size = (folder / name).stat().st_size
    monkeypatch.setattr(disk, "MAX_CACHE_BYTES", int(2.5 * size))
    disk._prune.__wrapped__(folder)
    assert len(list(folder.glob("*.o"))) == 2
    assert not (folder / name).exists()  # the one used longest ago


def test_an_interruption_leaves_nothing_half_made(monkeypatch, folder):
    """Ctrl-C while a kernel is built, or its file written: the next call builds it, and no file is left behind.

    A kernel is built when XLA calls it, which cannot pass an interruption on: it ends with an error.
    """

    def interrupted(*_):
        raise KeyboardInterrupt

    def function(x):
        return jnp.sin(x) * 7.654321

    for place, name in ((stored, "compile_text"), (target, "kernel_ir"), (trace, "expand")):
        with monkeypatch.context() as patched, contextlib.suppress(KeyboardInterrupt, jax.errors.JaxRuntimeError):
            patched.setattr(place, name, interrupted)
            jax.jit(native(lambda x: function(x)))(jnp.ones(3))
        with target._lock:
            assert not mode.is_expanding()
    assert_same(jax.jit(native(lambda x: function(x)))(jnp.ones(3)), function(jnp.ones(3)))
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(os, "replace", interrupted)
        disk.write("key", b"code")
    assert not list(folder.glob("*.part"))


# --- who may import what ---


def test_inputs_that_are_not_read_are_not_passed():
    """They have derivatives of zero, and a rule that reads them gives way to JAX."""

    def function(tree, x):
        return tree["read"] * x

    def rule(tree, x, steps):
        # One, but not for a compiler that keeps roundings.
        one = tree["unread"][0] + 1.0 - tree["unread"][0]
        by_tree = 0.0 if steps[0] is None else steps[0] * x
        return one * (by_tree + (0.0 if steps[2] is None else tree["read"] * steps[2]))

    tree, x = {"read": jnp.asarray([2.0, 3.0]), "unread": jnp.ones(4)}, jnp.asarray([5.0, 7.0])
    for derivative in (None, rule):
        run = jax.jit(backend.kernel(function, derivative=derivative))
        (call,) = [line for line in run.lower(tree, x).as_text().splitlines() if "@jaxdyn_kernel" in line]
        assert len(re.search(r"@jaxdyn_kernel\(([^)]*)\)", call).group(1).split(",")) == 2
        assert run(tree, x).tolist() == [10.0, 21.0]
        many = jax.vmap(run, ({"read": None, "unread": 0}, None))({**tree, "unread": jnp.ones((3, 4))}, x)
        assert many.tolist() == [[10.0, 21.0]] * 3
        by_tree, by_x = jax.grad(lambda tree, x: run(tree, x).sum(), (0, 1))(tree, x)  # noqa: B023
        assert by_x.tolist() == [2.0, 3.0] and by_tree["read"].tolist() == [5.0, 7.0]
        assert by_tree["unread"].tolist() == [0.0] * 4


def test_what_all_samples_share_is_read_once():
    made = numbers_of(lambda x, y: x + jnp.sin(y), jnp.ones(()), jnp.ones(()))
    one, each = (kernel_ir(made, 4, [False, same]) for same in (True, False))
    assert one.count("load double") == 4 + 1 and "shufflevector" in one
    assert each.count("load double") == 4 + 4 and "shufflevector" not in each
    lowered = jax.jit(jax.vmap(native(lambda x, y: x + jnp.sin(y)), (0, None))).lower(jnp.ones(64), jnp.ones(()))
    # Axes of length one may be added; nothing is copied for each sample.
    copied = [line for line in lowered.as_text().splitlines() if "broadcast_in_dim" in line]
    sizes = [
        [math.prod(map(int, re.findall(r"(\d+)x", kind))) for kind in re.findall(r"tensor<([^>]*)>", x)] for x in copied
    ]
    assert all(before == after for before, after in sizes), copied


def test_lanes_follow_the_batch_and_the_dtype():
    made, short = (numbers_of(lambda x: x + 1, jnp.ones(2, dtype)) for dtype in FLOATS)
    wide = target.vector_bytes() // 8
    assert (target.width_of(made, 1), target.width_of(made, 9), target.width_of(short, 9)) == (1, wide, 2 * wide)


def test_along_gives_the_value_and_its_change():
    def function(a, b):
        return a * b[0], b[1]

    value, change = backend.value_and_jvp(function, (2.0, (3.0, 4.0)), [1.0, None, 5.0])
    assert value == (6.0, 4.0) and change == (3.0, 5.0)
    assert backend.value_and_jvp(function, (2.0, (3.0, 4.0)), [None, None, None]) == ((6.0, 4.0), None)


def test_cleared_caches_of_jax_change_nothing():
    run = jax.jit(native(jnp.sin))
    before = run(jnp.ones(3))
    jax.clear_caches()
    np.testing.assert_array_equal(run(jnp.ones(3)), before)
    np.testing.assert_array_equal(jax.jit(native(jnp.sin))(jnp.ones(3)), before)


def test_the_folder_is_the_users_unless_set(monkeypatch, folder, tmp_path):
    disk.set_cache_folder(None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert disk.cache_folder() == tmp_path / "jaxdyn" / "kernels"
