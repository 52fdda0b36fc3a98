"""What only some samples of a batch need: flags of the whole batch, samples that are computed again, and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernel_helpers import assert_close, quick

from jaxdyn import compile as backend
from jaxdyn.compile import target
from jaxdyn.compile.batch import any_sample
from jaxdyn.compile.mode import rank_safe
from jaxdyn.compile.repair import compute_where, repair
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


def test_samples_that_are_not_valid_are_computed_again():
    """Only those, traced as rank-safe, with the dtypes of the values."""
    calls, safe, size = [], [], np.arange(1.0, 4.0)

    def again(x):
        safe.append(rank_safe.value)
        jax.debug.callback(lambda: calls.append(1))
        return {"matrix": jnp.full((2, 2), -x), "n": 7}

    def one(x, valid):
        return compute_where(~jnp.asarray(valid), again, {"matrix": jnp.full((2, 2), x), "n": jnp.asarray(3)}, (x,))

    many = jax.jit(jax.vmap(one))
    for flags in ([False] * 3, [False, True, False]):
        calls.clear()
        computed = many(size, ~np.asarray(flags))
        jax.effects_barrier()
        signed = np.where(flags, -size, size)
        np.testing.assert_array_equal(computed["matrix"], np.broadcast_to(signed[:, None, None], (3, 2, 2)))
        assert computed["n"].tolist() == [7 if flag else 3 for flag in flags] and bool(calls) == any(flags)
        assert computed["n"].dtype == jnp.asarray(3).dtype
    assert safe and all(safe) and not rank_safe.value
    alone = jax.jit(one)
    assert alone(2.0, False)["matrix"][0, 0] == -2 and alone(2.0, True)["matrix"][0, 0] == 2


def _root(x, scale):
    """sqrt(scale x) that is computed another way where x is below 1."""
    computed = jnp.sqrt(scale * x), (jnp.asarray(0, jnp.int32),)

    def careful(x, scale):
        return jnp.exp(0.5 * jnp.log(scale * x)), (jnp.asarray(1, jnp.int32),)

    return repair(x < 1, careful, lambda x, scale: jnp.sqrt(scale * x), computed, (x, scale))


@functools.cache
def _roots(nested):
    """A program of the roots of a batch, which way each was computed, and derivatives in both directions."""
    run = jax.vmap(_root, (0, None))
    if nested:
        run = jax.vmap(run, (0, 0))

    @quick
    def computed(x, scales):
        y, (way,) = run(x, scales)
        slope = jax.grad(lambda x: jnp.sum(run(x, scales)[0]))(x)
        moved = jax.jvp(lambda s: run(x, s)[0], (scales,), (jnp.ones_like(scales),))[1]
        return y, way, slope, moved

    return computed


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("few", [0, 1, 50, 96])
def test_samples_that_need_it_are_repaired(nested, few):
    """None, one, more than are computed at once, and all; values, which way, and derivatives in both directions."""
    x = jnp.where(jnp.arange(96) % 96 < few, 0.5, 2.0) + jnp.arange(96) / 1000
    shape = (8, 12) if nested else (96,)
    scales = jnp.arange(1.0, 9.0) if nested else jnp.asarray(3.0)
    y, way, slope, moved = _roots(nested)(x.reshape(shape), scales)
    want = np.sqrt(np.asarray(x).reshape(shape) * (np.asarray(scales)[:, None] if nested else 3.0))
    assert_close(y, want, 1e-14)
    assert way.reshape(-1).tolist() == [1] * few + [0] * (96 - few)
    assert_close(slope, want / (2 * np.asarray(x).reshape(shape)), 1e-13)
    assert_close(moved, want / (2 * (np.asarray(scales)[:, None] if nested else 3.0)), 1e-13)


def test_one_sample_is_repaired():
    for run in (_root, jax.jit(_root)):
        for x, way in ((0.25, 1), (4.0, 0)):
            y, (computed,) = run(jnp.asarray(x), jnp.asarray(1.0))
            assert computed == way
            assert_close(y, np.sqrt(x), 1e-15)


def test_arguments_of_both_batches_of_one_and_of_none():
    rng = np.random.default_rng(3)
    x, y, z, w = (jnp.asarray(rng.normal(size=shape)) for shape in ((3, 4, 2), (3,), (4, 2), (2,)))

    def plain(x, rest):
        y, z, w = rest
        return {"a": y * jnp.sin(x) @ w, "b": z + w}

    def repaired(x, rest):
        wrong = jax.tree.map(jnp.zeros_like, plain(x, rest))
        return repair(jnp.asarray(True), lambda *a: (plain(*a), ()), plain, (wrong, ()), (x, rest))[0]

    def nested(function):
        return jax.vmap(jax.vmap(function, (0, (None, 0, None))), (0, (0, None, None)))

    computed, want = quick(lambda *a: (nested(repaired)(*a), nested(plain)(*a)))(x, (y, z, w))
    for one, other in zip(jax.tree.leaves(computed), jax.tree.leaves(want), strict=True):
        assert_close(one, other, 1e-15)
    single = x[0, 0], (y[0], z[0], w)
    for one, other in zip(jax.tree.leaves(repaired(*single)), (want["a"][0, 0], want["b"][0, 0]), strict=True):
        assert_close(one, other, 1e-15)


def test_invalid_samples_of_a_kernel():
    """They are not numbers in the kernel, which reports them, and are computed by the function itself, or by the fallback."""

    def root(_, x):
        return _root(x, 1.0)

    x = jnp.array([0.25, 4.0])
    program, _ = program_of(root, (), (), (x[0],), flags="report")[1]
    assert (
        program.reports_validity
        and not program_of(lambda _, x: x, (), (), (x[0],), flags="report")[1][0].reports_validity
    )
    for sample, wanted in zip(x, ([np.nan, 0, False], [2.0, 0, True]), strict=True):
        np.testing.assert_array_equal([y.item() for y in target.call(program, [np.asarray(sample)])], wanted)
    assert isinstance(program_of(root, (), (), (x[0],))[1], str)
    computed, (branch,) = jax.jit(jax.vmap(lambda x: backend.kernel(root)((), x)))(x)
    np.testing.assert_array_equal(computed, [0.5, 2.0])
    assert branch.tolist() == [1, 0]

    def fallback(_, x):
        return -x, (jnp.asarray(7, jnp.int32),)

    for derivative in (None, False):
        function = backend.kernel(root, fallback=fallback, derivative=derivative)
        computed, (branch,) = jax.jit(jax.vmap(lambda x, f=function: f((), x)))(x)
        np.testing.assert_array_equal(computed, [-0.25, 2.0])
        assert branch.tolist() == [7, 0]
    slope = jax.jit(jax.vmap(jax.grad(lambda x: backend.kernel(root, fallback=fallback)((), x)[0])))
    np.testing.assert_array_equal(slope(x), [-1.0, -1.0])  # of the fallback for all, as one sample needs it
    np.testing.assert_array_equal(slope(x[1:]), [0.25])
    assert [float(backend.evaluate(root, (), y)[0]) for y in x] == [0.5, 2.0]
    # A sample whose results are not needed is left as it is.
    function = backend.kernel(root, fallback=fallback, derivative=False)
    needed = jax.jit(jax.vmap(lambda x, where: function((), x, where=where)))(x, jnp.array([False, True]))
    np.testing.assert_array_equal(needed[0], [np.nan, 2.0])
