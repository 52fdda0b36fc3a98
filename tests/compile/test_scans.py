"""Loops in native code against the same functions in JAX: scans, sweeps over trees, `while_loop`, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.scipy.linalg import solve_triangular
from kernel_helpers import assert_close as assert_array_close

from jaxdyn.compile import array_rules, kernel, rolled, sweep
from jaxdyn.compile.code import find_slots
from jaxdyn.compile.operations import as_operations
from jaxdyn.compile.scan import Scan
from jaxdyn.compile.trace import program_of

pytestmark = pytest.mark.native
TABLE = np.random.default_rng(0).normal(size=(40, 3))
PARENTS = (-1, 0, 1, 1, 3, 0, 5, -1, 7, 7)


@pytest.fixture(params=["loop", "written out"])
def native(request, monkeypatch):
    """A kernel of a function of arrays, whose loops are loops, or written out."""
    monkeypatch.setattr(rolled, "MAX_WRITTEN_OUT", 0 if request.param == "loop" else 10**9)

    def make(function):
        # A function of its own, as programs are kept by functions.
        compiled = kernel(lambda tree, *args: function(*args))
        return lambda *args: compiled((), *args)

    return make


def assert_close(computed, want):
    """Arrays of two trees agree to rounding."""
    for x, y in zip(jax.tree.leaves(computed), jax.tree.leaves(want), strict=True):
        assert_array_close(x, y, 1e-12)


def inputs():
    rng = np.random.default_rng(1)
    return tuple(map(jnp.asarray, (rng.normal(size=3), 0.3 * rng.normal(size=(3, 3)), np.array(0.3))))


def scanned(x, A, w):
    """Constants, two carries of which one is symmetric and starts at zero, known and given rows, an index."""

    def step(carry, row):
        x, M, k = carry
        t, u, i = row
        x = jnp.tanh(A @ x + u * t) + jnp.sin(w) * x
        M = 0.01 * M @ M.T + jnp.outer(x, x)
        return (x, M, k + i), (x.sum(), M, jnp.where(i > k, x, 0 * x))

    rows = TABLE, jnp.cumsum(jnp.ones((40, 3)), 0) * w, jnp.arange(40)
    (x, M, k), (s, Ms, y) = lax.scan(step, (x, jnp.zeros((3, 3)), jnp.asarray(3)), rows)
    return x, M, s, Ms, y, k


def reversed_scan(x, A, w):
    carry, rows = lax.scan(lambda c, t: (jnp.cos(A @ c) * t, c * w), x, TABLE, reverse=True)
    return carry, rows


def nested(x, A, w):
    def outer(c, t):
        inner, rows = lax.scan(lambda d, s: (jnp.sin(A @ d) + s * w, d.sum()), c, TABLE[:9])
        return inner * t, rows

    return lax.scan(outer, x, TABLE)


def swept(x, A, w):
    """Both directions over a tree with two roots."""
    out = sweep(lambda c, row: (jnp.tanh(c * row + w), (c.sum(), A @ c)), PARENTS, x, TABLE[:10])
    end, (s, Y) = out
    total, z = sweep(
        lambda t, y: ((u := jnp.sin(t + w * y) * jnp.sum(t * y) + y), u.sum()), PARENTS, jnp.zeros(3), Y, inward=True
    )
    return end, s, total, z


FUNCTIONS = {f.__name__: f for f in (scanned, reversed_scan, nested, swept)}


def loss(function):
    def value(*args):
        parts = [x for x in jax.tree.leaves(function(*args)) if x.dtype.kind == "f"]
        return sum(jnp.sum(jnp.sin(y) * jnp.cos(jnp.arange(y.size)).reshape(y.shape)) for y in parts)

    return value


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives(name, native):
    function, args = FUNCTIONS[name], inputs()
    f = native(function)
    assert_close(jax.jit(f)(*args), function(*args))
    many = jnp.asarray(np.random.default_rng(2).normal(size=(13, 3)))
    axes = 0, None, None
    assert_close(jax.jit(jax.vmap(f, axes))(many, *args[1:]), jax.vmap(function, axes)(many, *args[1:]))
    steps = args[0] + 1, args[1] * 2, args[2]
    assert_close(jax.jvp(loss(f), args, steps), jax.jvp(loss(function), args, steps))
    assert_close(jax.grad(loss(f), (0, 1, 2))(*args), jax.grad(loss(function), (0, 1, 2))(*args))


@pytest.mark.parametrize("name", ["scanned", "swept"])
def test_second_derivatives(name, native):
    function, args = FUNCTIONS[name], inputs()
    f = native(function)
    for twice in (jax.hessian, lambda f, i: jax.jacrev(jax.jacrev(f, i), i)):
        assert_close(twice(loss(f), (0, 2))(*args), twice(loss(function), (0, 2))(*args))


def test_derivatives_within_a_kernel(native):
    """JAX's own rules of a sweep, forward and for batches, and reverse mode of a scan, inside of a kernel."""

    def along(x, A, w):
        return jax.jvp(swept, (x, A, w), (2 * x, A, w))[1], jax.vmap(swept, (0, None, None))(
            jnp.stack([x, 2 * x]), A, w
        )

    assert_close(native(along)(*inputs()), along(*inputs()))

    def slope(x, A, w):
        return jax.grad(loss(reversed_scan), (0, 1, 2))(x, A, w)

    f = native(slope)
    assert_close(f(*inputs()), slope(*inputs()))
    assert_close(jax.grad(loss(f))(*inputs()), jax.grad(loss(slope))(*inputs()))


def test_numbers_that_are_not_finite_stay_in_their_sample(native):
    x, A, w = inputs()
    f = jax.jit(jax.vmap(native(scanned), (0, None, None)))
    many = jnp.stack([x, x * jnp.nan, x])
    assert_close([y[2] for y in f(many, A, w)], scanned(x, A, w))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_loops_until_a_condition(dtype):
    def function(x, a):
        def body(state):
            k, y, z, A = state
            y = y * 0.7 + 0.1 * a[:2].sum() * jnp.sin(y)
            return k + 1, y, z, (A + A.T) * 0.5 + jnp.outer(y, y)

        def goes_on(state):
            return (jnp.abs(state[1]).max() > 1e-2 * jnp.abs(a).max()) & (state[0] < 50)

        k, y, z, A = lax.while_loop(goes_on, body, (0, x, jnp.zeros(2, x.dtype), jnp.zeros((2, 2), x.dtype)))
        return k, y + z, A

    f = kernel(lambda _, *args: function(*args))
    rng = np.random.default_rng(0)
    many, a = jnp.asarray(rng.normal(size=(37, 2)), dtype), jnp.asarray(rng.normal(size=3), dtype)
    bound = 1e-12 if dtype == np.float64 else 1e-5

    def assert_near(computed, want):
        for x, y in zip(jax.tree.leaves(computed), jax.tree.leaves(want), strict=True):
            assert x.dtype == y.dtype
            assert_array_close(x, y, bound)

    assert_near(jax.jit(jax.vmap(lambda x: f((), x, a)))(many), jax.vmap(lambda x: function(x, a))(many))
    at = (many[0], a), (many[1], 2 * a)
    assert_near(jax.jvp(lambda *x: f((), *x)[1:], *at), jax.jvp(lambda *x: function(*x)[1:], *at))
    with pytest.raises(ValueError, match="reverse-mode"):
        jax.grad(lambda x: f((), x, a)[1].sum())(many[0])


def test_code_does_not_grow_with_the_iterations():
    def program(length):
        def function(_, x):
            return lax.scan(lambda c, t: (jnp.sin(c * t), c), x, jnp.linspace(1.0, 2.0, length))

        return program_of(function, (), (), (jnp.ones(2),))[1][0]

    few, many = program(30_000), program(60_000)
    assert all(isinstance(x, Scan) for x in few.subprograms)
    assert sum(op not in ("input", "part") for op, _, _ in few.operations) == 1
    assert len(few.subprograms[0].body.operations) == len(many.subprograms[0].body.operations) < 20
    assert few.cost * 2 == many.cost


def test_a_loop_over_calls_is_written_out():
    """Stages of a Runge-Kutta method: a loop would not see the zeros of their sums, and a call is code of its own."""

    @jax.jit
    def long(x):
        for _ in range(800):
            x = jnp.exp(x) * x
        return x

    def function(_, x):
        return lax.scan(lambda c, weight: (long(c) * weight, None), x, jnp.linspace(1.0, 2.0, 14))[0]

    _, (program, _) = program_of(function, (), (), (jnp.ones(()),), calls=True)
    assert program.cost > rolled.MAX_WRITTEN_OUT > len(program.operations)
    assert not any(isinstance(x, Scan) for x in program.subprograms)


@pytest.mark.parametrize("transposed", [False, True])
def test_columns_of_a_solution_are_a_loop(monkeypatch, transposed):
    """With the bits of the columns that are written out, and the derivatives of JAX."""
    rng = np.random.default_rng(7)
    factor, right = np.tril(rng.normal(size=(5, 5))) + 4 * np.eye(5), rng.normal(size=(5, 9))

    def solve(a, b):
        return solve_triangular(a, b, lower=True, trans=int(transposed))

    found, slopes = [], []
    for most in (0, 10**9):
        monkeypatch.setattr(array_rules, "_MAX_COLUMNS_WRITTEN_OUT", most)
        one = kernel(lambda _, a, b: solve(a, b))
        _, (program, _) = program_of(lambda _, a, b: solve(a, b), (), (), (factor, right))
        assert [type(x) for x in program.subprograms] == ([] if most else [Scan])
        found.append(np.asarray(jax.vmap(lambda a, f=one: f((), a, right))(np.stack([factor] * 3))))
        slopes.append(
            jax.jacrev(lambda a, f=one: jax.jvp(lambda b: f((), a, b), (right,), (right**2,))[1].sum())(factor)
        )
    np.testing.assert_array_equal(*found)
    assert_close(found[0][1], solve(factor, right))
    wanted = jax.jacrev(lambda a: jax.jvp(lambda b: solve(a, b), (right,), (right**2,))[1].sum())(factor)
    assert_close(slopes, [wanted, wanted])


def test_other_devices_compute_the_same(monkeypatch):
    monkeypatch.setattr(rolled, "MAX_WRITTEN_OUT", 0)
    args = inputs()
    for function in (scanned, reversed_scan, swept):
        leaves, (program, _) = program_of(lambda _, *args, f=function: f(*args), (), (), args)
        assert program.subprograms
        flat = [jnp.stack([x.reshape(-1), x.reshape(-1)]) for x in leaves]
        computed = as_operations(*flat, program=program)
        want = [x.reshape(-1) for x in jax.tree.leaves(function(*args))]
        assert_close([x[1] for x in computed], want)


def test_slots_of_a_tree_are_few():
    binary = [(i - 1) // 2 for i in range(1023)]
    order: list[int] = []
    parents: list[int] = []

    def visit(i, parent):
        parents.append(parent)
        place = len(order)
        order.append(i)
        for child in (2 * i + 1, 2 * i + 2):
            if child < len(binary):
                visit(child, place)

    visit(0, -1)
    count, slots = find_slots(parents)
    assert count <= 11
    assert find_slots(range(-1, 99))[0] == 1
    # No slot is written between a node and its last child, which reads it.
    last = {parent: i for i, parent in enumerate(parents)}
    for node, end in last.items():
        assert slots[node + 1] not in slots[node + 2 : end + 1]
