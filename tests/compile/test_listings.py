"""Programs as data of a loop against the same programs as code: the same bits."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxdyn as jd
from jaxdyn.compile import rolled, stored, target
from jaxdyn.compile.code import has_table, kernel_ir, varying_first
from jaxdyn.compile.derive import tangent, transpose
from jaxdyn.compile.program import Program
from jaxdyn.compile.trace import program_of
from jaxdyn.constraints.dynamics import _by_pivots

pytestmark = pytest.mark.native
SAMPLES = 5


def program(function, *args, **how) -> Program:
    """The program of a function of arrays."""
    made = program_of(lambda tree, *args: function(*args), (), (), args, **how)[1]
    assert not isinstance(made, str), made
    return made[0]


def compute(of: Program, width: int, uniform, arrays, is_listed: bool) -> list[np.ndarray]:
    """Results of a kernel whose operations are code, or data."""
    called = target._calls(of.subprograms, width)[0]
    for symbol in called:
        assert target._publish(symbol, width, called)
    code = stored.Code(stored.compile_text(kernel_ir(of, width, uniform, is_listed)))
    results = [np.zeros((SAMPLES, x.size), x.dtype) for x in of.outputs]
    order = varying_first(uniform)
    rows = [*(arrays[i] for i in order), *results]
    data = (ctypes.c_void_p * len(rows))(*(x.ctypes.data for x in rows))
    function = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)(
        code.address("kernel")
    )
    function(ctypes.addressof(data), SAMPLES, 0, SAMPLES)
    return results


def assert_same(of: Program, monkeypatch, scale: float = 1.0):
    """The same results as code and as data, for one sample and for vectors."""
    monkeypatch.setattr("jaxdyn.compile.code.MIN_QUICK_OPERATIONS", -1)
    rng = np.random.default_rng(0)
    for width in (1, target.width_of(of, None)):
        for one in (False, True):
            uniform = [one and i == 0 for i in range(len(of.inputs))]
            arrays = [
                (scale * rng.normal(size=(x.size,) if same else (SAMPLES, x.size))).astype(x.dtype)
                for x, same in zip(of.inputs, uniform, strict=True)
            ]
            code, data = (compute(of, width, uniform, arrays, is_listed) for is_listed in (False, True))
            for x, y in zip(code, data, strict=True):
                np.testing.assert_array_equal(x, y)
            assert any(np.isfinite(x).all() and (x != 0).any() for x in code)


def mixed(x, A, n):
    """Operations of all kinds and types, constants, results of zeros, and inputs that are results."""
    b = A @ x
    both = jnp.where(b > 0.1, jnp.maximum(b, 0.3 * x), lax.clamp(-0.2, x, 0.4))
    turned = jnp.sin(b) * jnp.cos(b) + lax.round(5 * x, lax.RoundingMethod.TO_NEAREST_EVEN) - 2.5 * b * x
    counts = n + (b[:3] > 0).astype(n.dtype)
    wide = jnp.zeros((40, 2)).at[3, 1].set(b[0]).at[20, 0].set(x[1])
    small = (b * x - A[0]).astype(jnp.float32) ** 2
    return both, turned, counts, wide, jnp.max(jnp.abs(A)), (b > x) & ~(x < 0), small, x, jnp.arctan2(b, x), jnp.min(x)


def test_operations_of_all_kinds(monkeypatch):
    """Each kind of operation, and each type."""
    made = program(mixed, jnp.zeros(4), jnp.zeros((4, 4)), jnp.zeros(3, jnp.int32))
    assert {"select", "reduce_max", "convert", "atan2", "and", "clamp"} <= {op for op, _, _ in made.operations}
    assert_same(made, monkeypatch)


def test_constrained_dynamics_and_its_derivatives(monkeypatch):
    """A whole mechanism, its tangent and the transpose of that."""
    scene = jd.scenes.four_bar()
    q, v = jd.scenes.four_bar.start()
    made = program_of(_by_pivots.__wrapped__, (None,), scene, (q, v, v, jnp.zeros(())), flags="report")[1][0]
    assert_same(made, monkeypatch)
    moving = tangent(made, (True, True, True, False))
    assert_same(moving, monkeypatch)
    linear = tuple(i >= len(made.inputs) for i in range(len(moving.inputs)))
    assert_same(transpose(moving, linear, tuple(x.dtype.kind == "f" for x in moving.outputs)), monkeypatch)


def test_calls_and_loops(monkeypatch):
    """Subprograms, whose arrays are copied or passed on, and loops, whose arrays stay in memory."""
    monkeypatch.setattr(rolled, "MAX_WRITTEN_OUT", 0)
    long = jax.jit(lambda A, x: jnp.tanh(A @ A @ A @ A @ A) @ x)

    def function(A, x):
        y = long(A, x)
        z = long(A, jnp.flip(y) + 0.5)
        (w, _), rows = lax.scan(
            lambda c, r: ((0.5 * c[0] + jnp.sin(r) * x, c[1] + r), c[0]), (z, 0.0), jnp.cumsum(jnp.tile(y, 3))
        )
        return w, rows, y

    made = program(function, jnp.zeros((5, 5)), jnp.zeros(5), calls=True)
    assert len(made.subprograms) == 2 and sum(op == "call" for op, _, _ in made.operations) == 3
    assert_same(made, monkeypatch, 0.3)


def test_branches(monkeypatch):
    """A branch that some samples take."""
    hard = jax.jit(lambda A, x: jnp.linalg.inv(A @ A.T + 3 * jnp.eye(5)) @ jnp.sin(A @ x))

    def function(A, x):
        y = lax.cond(x[0] > 0, lambda: hard(A, x), lambda: 2 * x)
        return y, jnp.sum(y * x)

    made = program(function, jnp.zeros((5, 5)), jnp.zeros(5), calls=True)
    assert any(op == "call_where" for op, _, _ in made.operations)
    assert_same(made, monkeypatch)


def test_large_programs_are_kernels(monkeypatch):
    """A program beyond the bound is a kernel, for one sample and in batches, and its gradient agrees with that of the code."""
    monkeypatch.setattr("jaxdyn.compile.code.MIN_LISTED_OPERATIONS", 500)
    scene = jd.scenes.windows(count=3, length=1.1)  # numbers that no other test compiles
    q, v = jd.scenes.windows.start(count=3)
    tau = jnp.cos(jnp.arange(scene.nv))

    def acceleration(q, v):
        return jd.constrained_dynamics(scene, q, v, tau).acceleration

    assert has_table(program_of(_by_pivots.__wrapped__, (None,), scene, (q, v, tau, 0.0), flags="report")[1][0])
    one = jax.jit(acceleration)(q, v)
    several = jax.jit(jax.vmap(acceleration))(jnp.stack([q] * 19), jnp.stack([v] * 19))
    gradient = jax.jit(jax.grad(lambda q, v: acceleration(q, v) @ tau, 1))(q, v)
    with jd.compilation("plain"):
        want = jax.jit(acceleration)(q, v)
        of_want = jax.jit(jax.grad(lambda q, v: acceleration(q, v) @ tau, 1))(q, v)
    np.testing.assert_allclose(one, want, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(several, jnp.stack([one] * 19))
    np.testing.assert_allclose(gradient, of_want, rtol=0, atol=1e-10)
