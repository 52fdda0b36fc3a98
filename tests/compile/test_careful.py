"""Samples that a kernel marks as not valid: native code computes them by a program that is made when the first one appears."""

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernel_helpers import assert_close, quick

from jaxdyn import compile as backend
from jaxdyn.compile import careful as pairs
from jaxdyn.compile import kernel, mark_invalid, rolled, target
from jaxdyn.compile.batch import any_sample, rarely
from jaxdyn.compile.kernels import Carry, Given, Iteration, Task, run_loop
from jaxdyn.compile.operations import as_operations
from jaxdyn.compile.primitive import kernel_p
from jaxdyn.compile.trace import program_of

pytestmark = pytest.mark.native


def test_a_flag_of_any_sample_is_one_of_the_batch():
    def pick(x):
        return jax.lax.cond(any_sample(x > 2.5), lambda: x + 10, lambda: x)

    grid = jnp.arange(4.0).reshape(2, 2)
    assert jax.vmap(jax.vmap(pick))(grid).tolist() == [[10, 11], [12, 13]]
    assert jax.jit(jax.vmap(pick))(grid[0]).tolist() == [0, 1]
    assert jax.vmap(jax.grad(pick))(grid[1]).tolist() == [1, 1]
    assert pick(jnp.asarray(3.0)) == 13 and pick(jnp.asarray(1.0)) == 1
    assert "select" not in str(jax.make_jaxpr(jax.vmap(pick))(grid[0]))


def _root(_, x, scale):
    """sqrt(scale x), and which way it was computed; marked where x is below 1."""
    return backend.mark_invalid(x < 1, jnp.sqrt(scale * x)), jnp.asarray(0, jnp.int32)


def _careful_root(_, x, scale):
    return jnp.exp(0.5 * jnp.log(scale * x)), jnp.asarray(1, jnp.int32)


def root(x, scale):
    return backend.kernel(_root, fallback=_careful_root)((), x, scale)


@functools.cache
def _roots(nested):
    """A program of the roots of a batch, which way each was computed, and derivatives in both directions and of second order."""
    run = jax.vmap(root, (0, None))
    if nested:
        run = jax.vmap(run, (0, 0))

    @quick
    def computed(x, scales):
        y, way = run(x, scales)
        slope = jax.grad(lambda x: jnp.sum(run(x, scales)[0]))
        moved = jax.jvp(lambda s: run(x, s)[0], (scales,), (jnp.ones_like(scales),))[1]
        return y, way, slope(x), moved, jax.jvp(slope, (x,), (jnp.ones_like(x),))[1]

    return computed


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("few", [0, 1, 50, 96])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_samples_that_need_it_are_computed_by_the_fallback(nested, few, dtype):
    """None, one, some and all; values, which way, and derivatives, each sample by its own way, against the formula."""
    order = np.random.default_rng(few).permutation(96)  # flagged ones among the others
    x = (np.where(np.arange(96) < few, 0.5, 2.0) + np.arange(96) / 1000)[order]
    shape, eps = (8, 12) if nested else (96,), float(np.finfo(dtype).eps)
    scales = np.arange(1.0, 9.0) if nested else np.asarray(3.0)
    y, way, slope, moved, second = _roots(nested)(x.reshape(shape).astype(dtype), scales.astype(dtype))
    x, scale = x.reshape(shape), scales[:, None] if nested else 3.0
    want = np.sqrt(x * scale)
    assert y.dtype == dtype
    assert way.reshape(-1).tolist() == (order < few).tolist()
    for computed, exact in (
        (y, want),
        (slope, want / (2 * x)),
        (moved, want / (2 * scale)),
        (second, -want / (4 * x * x)),
    ):
        np.testing.assert_allclose(computed, exact, rtol=64 * eps)


def test_xla_sees_one_call():
    """No branch, loop, sort or gather, for values and for derivatives; a shared argument stays one row."""
    x, scale = jnp.arange(5.0), jnp.asarray(2.0)
    many = jax.vmap(root, (0, None))
    for run in (many, jax.grad(lambda x, s: jnp.sum(many(x, s)[0]))):
        text = jax.jit(run).lower(x, scale).as_text()
        assert text.count("custom_call @jaxdyn_kernel") == 1
        assert not [name for name in ("case", "while", "sort", "gather", "if(") if f"stablehlo.{name}" in text]


def test_one_sample():
    for run in (root, jax.jit(root)):
        for x, way in ((0.25, 1), (4.0, 0)):
            y, computed = run(jnp.asarray(x), jnp.asarray(1.0))
            assert computed == way
            assert_close(y, np.sqrt(x), 1e-15)
    assert [float(backend.evaluate(_root, (), x, jnp.ones(()))[0]) for x in (jnp.asarray(4.0),)] == [2.0]


def _new(factor):
    """A kernel that no other test has, how often its fallback was traced, and the same by NumPy."""
    traced = []

    def fast(_, x):
        return backend.mark_invalid(x < 0, factor * jnp.sin(x))

    def careful(_, x):
        traced.append(1)
        return factor * jnp.cos(x)

    run = backend.kernel(fast, fallback=careful)
    return (lambda x: run((), x)), traced, lambda x: factor * np.where(x < 0, np.cos(x), np.sin(x))


def test_a_fallback_is_traced_when_the_first_sample_needs_it():
    function, traced, wanted = _new(1.0625)
    many, x = jax.jit(jax.vmap(function)), np.linspace(0.0, 2.0, 21)
    assert_close(many(x), wanted(x), 1e-15)
    assert traced == []
    for _ in range(2):
        assert_close(many(x - 1), wanted(x - 1), 1e-15)
        assert traced == [1]


def test_several_threads_need_it_first():
    """Each thread with programs of its own, all at once."""
    function, traced, wanted = _new(1.1875)
    x = np.linspace(-3.0, 3.0, 301)
    many = [jax.jit(jax.vmap(lambda x, k=k: function(x) + k)).lower(x).compile() for k in range(6)]
    with ThreadPoolExecutor(len(many)) as pool:
        results = list(pool.map(lambda run: np.asarray(run(x)), many))
    for k, computed in enumerate(results):
        assert_close(computed, wanted(x) + k, 1e-14)
    assert traced == [1]


def test_a_batch_that_is_shared_between_threads_of_xla():
    """Samples that are not valid in all of its parts, so that several threads ask for the program at once."""
    function, traced, wanted = _new(1.3125)
    x = np.random.default_rng(0).normal(size=200_000)
    assert_close(jax.jit(jax.vmap(function))(x), wanted(x), 1e-14)
    assert traced == [1]


def test_a_first_call_within_a_trace_and_within_a_scan():
    """Native code that runs while another function is traced, and a kernel under `jit` in a `scan`."""
    function, _, wanted = _new(1.4375)

    @jax.jit
    def around(x):
        return x + backend.evaluate(lambda _, x: function(x), (), np.asarray(-0.5))

    assert_close(around(1.0), 1 + wanted(np.asarray(-0.5)), 1e-15)
    scanned = jax.jit(lambda x: jax.lax.scan(lambda c, x: (c, jax.jit(function)(x)), 0.0, x)[1])
    x = np.linspace(-1.0, 1.0, 7)
    assert_close(scanned(x), wanted(x), 1e-15)


def test_a_fallback_that_is_no_program_is_an_error():
    """It is told to who calls, and logged."""

    def fast(_, x):
        return backend.mark_invalid(x < 0, 1.5625 * jnp.sin(x))

    run = jax.jit(jax.vmap(lambda x: backend.kernel(fast, fallback=lambda _, x: jnp.sort(x[None])[0])((), x)))
    np.testing.assert_allclose(run(jnp.ones(3)), 1.5625 * np.sin(np.ones(3)), rtol=1e-15)
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError), match="could not be compiled"):
        jax.block_until_ready(run(-jnp.ones(3)))


def test_the_same_by_operations_of_jax():
    """As on devices without native code: values, tangent and transpose, some samples flagged and all."""
    x, scale = np.array([0.5, 2.0, 0.25, 3.0])[:, None], np.full((4, 1), 3.0)

    def program(run):
        found = jax.make_jaxpr(run)(x, scale)
        return [eqn.params["program"] for eqn in found.eqns if eqn.primitive is kernel_p][-1]

    many = jax.vmap(lambda x, scale: root(x[0], scale[0])[0])
    for run in (many, lambda x, s: jax.jvp(many, (x, s), (x, s))[1], jax.grad(lambda x, s: jnp.sum(many(x, s)))):
        made = program(run)
        given = [np.random.default_rng(i).uniform(0.5, 2.0, (4, array.size)) for i, array in enumerate(made.inputs)]
        for other in (
            as_operations(*given, program=made),
            jax.jit(lambda *a, p=made: as_operations(*a, program=p))(*given),
        ):
            for mine, theirs in zip(
                jax.jit(lambda *a, p=made: kernel_p.bind(*a, program=p, rows=0))(*given), other, strict=True
            ):
                np.testing.assert_allclose(mine, theirs, rtol=1e-13, atol=1e-13)


def test_arguments_of_both_batches_of_one_and_of_none():
    rng = np.random.default_rng(3)
    x, y, z, w = (jnp.asarray(rng.normal(size=shape)) for shape in ((3, 4, 2), (3,), (4, 2), (2,)))

    def plain(_, x, rest):
        y, z, w = rest
        return {"a": y * jnp.sin(x) @ w, "b": z + w}

    def wrong(_, x, rest):
        return jax.tree.map(lambda x: backend.mark_invalid(rest[0] < 10, 0 * x), plain(_, x, rest))

    def nested(function):
        return jax.vmap(jax.vmap(function, (0, (None, 0, None))), (0, (0, None, None)))

    repaired = functools.partial(backend.kernel(wrong, fallback=plain), ())
    computed, want = quick(lambda *a: (nested(repaired)(*a), nested(functools.partial(plain, ()))(*a)))(x, (y, z, w))
    for one, other in zip(jax.tree.leaves(computed), jax.tree.leaves(want), strict=True):
        assert_close(one, other, 1e-15)


def test_what_marks_and_what_is_made():
    """A pair has no flag among its results, the fast program has, and what marks nothing is no pair."""
    x = jnp.ones(())
    pair, _ = program_of(_root, (), (), (x, x), flags="repair", fallback=_careful_root)[1]
    assert len(pair.outputs) == 2 and pair.fast.reports_validity and len(pair.fast.outputs) == 3
    assert program_of(lambda _, x: x, (), (), (x,), flags="repair")[1][0].careful is None
    assert isinstance(program_of(_root, (), (), (x, x))[1], str)
    assert pair.digest == pairs.guard(pair.fast, lambda: pair.careful).digest
    results = target.call(pair.fast, [np.asarray(0.25), np.asarray(1.0)])
    np.testing.assert_array_equal([x.item() for x in results], [np.nan, 0, False])


@pytest.mark.parametrize("count", [1, 3, 40])
def test_iterations_of_a_loop(count):
    """Flags within a kernel of the turn, of a long one, and of the turn itself: the loop goes on."""

    @functools.partial(backend.kernel, fallback=lambda _, x: (x + 1, jnp.ones((), jnp.int32)), derivative=False)
    def long(_, x):
        y = x
        for _ in range(200):
            y = 0.5 * (y + jnp.sin(y))
        return backend.mark_invalid(x < 0, y), jnp.zeros((), jnp.int32)

    short = backend.kernel(lambda _, x: backend.mark_invalid(x > 3, 2 * x), fallback=lambda _, x: x - 4)

    def turn(_, constants, state, __):
        x, ways, k = state
        x, way = long((), x)
        x = short((), x) + constants
        x = rarely(x > 1, lambda x: 0.5 * x, x)
        return Iteration((x, ways + way, k + 1), k < 9, k + 1 < 9)

    def run(x):
        none = jnp.zeros((), jnp.int32)
        return run_loop(Task(turn, ()), (), jnp.asarray(0.25), Given(), Carry((x, none, none))).state

    def by_hand(x):
        ways = 0
        for _ in range(9):
            y = x
            for _ in range(200):
                y = 0.5 * (y + np.sin(y))
            y, ways = (x + 1, ways + 1) if x < 0 else (y, ways)
            x = (y - 4 if y > 3 else 2 * y) + 0.25
            x = 0.5 * x if x > 1 else x
        return x, ways

    x = np.linspace(-6.0, 6.0, count) if count > 1 else np.array([-6.0])
    (values, ways, _), wanted = jax.jit(jax.vmap(run))(x), np.array([by_hand(y) for y in x])
    np.testing.assert_allclose(values, wanted[:, 0], rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(ways, wanted[:, 1])
    text = jax.jit(jax.vmap(run)).lower(x).as_text()
    assert text.count("custom_call @jaxdyn_kernel") == 1 and "while" not in text


class Scale(eqx.Module):
    """A tree with a function of the user, which is static."""

    rule: Callable = eqx.field(static=True)


def test_careful_programs_of_functions_in_a_tree_are_not_taken_for_each_other():
    def by_rule(tree, x):
        return tree.rule(x)

    @kernel(fallback=by_rule)
    def flagged(tree, x):
        return mark_invalid(x > 0, x)

    for factor in range(2, 6):
        scale = Scale(lambda x, factor=factor: factor * x)
        values = jax.jit(jax.vmap(lambda x, scale=scale: flagged(scale, x)))(jnp.array([-1.0, 1.0]))
        assert values.tolist() == [-1.0, factor]


def test_loops_that_flag_samples_are_written_out(monkeypatch):
    """A flag of one iteration of ten: this sample is computed by the fallback, others by the kernel, at any limit."""
    monkeypatch.setattr(rolled, "MAX_WRITTEN_OUT", 0)

    def iterate(root, x):
        return jax.lax.scan(lambda x, _: (root(x - 0.1), x), x, None, 10)[0]

    def flagged(_, x):
        return iterate(lambda x: mark_invalid(x < 0, jnp.sqrt(x)), x)

    careful = backend.kernel(flagged, fallback=lambda _, x: iterate(lambda x: jnp.abs(x) ** 0.5, x))
    x = jnp.array([0.05, 0.3, 2.0, 5.0])
    want = jax.vmap(lambda x: iterate(lambda x: jnp.sqrt(jnp.abs(x)), x))(x)
    assert "while" not in str(jax.make_jaxpr(lambda x: careful(None, x))(x[0]))
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda x: careful(None, x)))(x), want, rtol=1e-14)
