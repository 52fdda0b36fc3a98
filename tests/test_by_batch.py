"""Two ways to compute the same, chosen by the size of the batch when the program is lowered."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdyn._by_batch import by_batch


def ways(calls):
    """Two functions that tell apart which one was taken: the small one adds 1, the large one 2."""

    def small(x, tree):
        calls.append("small")
        return {"sum": x + tree["a"] * tree["b"], "way": jnp.asarray(1)}

    def large(x, tree):
        calls.append("large")
        return {"sum": x + tree["a"] * tree["b"], "way": jnp.asarray(2)}

    return small, large


def test_the_size_of_all_batches_decides():
    calls = []
    small, large = ways(calls)

    def one(x, a, b):
        return by_batch(small, large, 6, x, {"a": a, "b": b})

    x, a, b = jnp.arange(3.0), jnp.arange(2.0), jnp.arange(4.0)
    pairs = jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, None))
    found = jax.jit(pairs)(x, a, b[0])  # 6 samples, one argument for all of them
    np.testing.assert_array_equal(found["sum"], x[None] + 0 * a[:, None])
    assert (found["way"] == 2).all()
    # Axes elsewhere than in front, in either order of the batches.
    rows = jnp.arange(6.0).reshape(3, 2)
    mixed = jax.vmap(jax.vmap(one, (0, 0, None)), (1, None, 0), out_axes=1)
    found = jax.jit(mixed)(rows, x, b[:2])
    np.testing.assert_array_equal(found["sum"], rows + x[:, None] * b[None, :2])
    assert (found["way"] == 2).all()
    few = jax.jit(jax.vmap(one, (0, None, None)))(x, a[1], b[3])
    np.testing.assert_array_equal(few["sum"], x + 3.0)
    assert (few["way"] == 1).all() and one(1.0, 2.0, 3.0)["sum"] == 7.0


def test_the_way_not_taken_is_not_traced():
    calls = []
    small, large = ways(calls)
    program = jax.jit(jax.vmap(lambda x: by_batch(small, large, 100, x, {"a": x, "b": x})["sum"]))
    program(jnp.arange(4.0))
    assert "large" not in calls


@pytest.mark.parametrize("kind", ["effects", "traced elsewhere"])
def test_what_cannot_be_traced_later_is_taken_as_it_is(kind):
    def run(x, hidden):
        def small(x):
            if kind == "effects":
                jax.debug.callback(lambda _: None, x)
            return x + hidden if kind == "traced elsewhere" else x

        return by_batch(small, lambda x: x * jnp.nan, 1, x)

    found = jax.jit(jax.vmap(run, (0, None)))(jnp.arange(4.0), 1.0)
    np.testing.assert_array_equal(found, jnp.arange(4.0) + float(kind == "traced elsewhere"))
