"""Known integers wrap, and every product, sum and conversion has the dtype that JAX gives it: kernels against plain mode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from kernel_helpers import by_kernel, quick

from jaxdyn.compile import kernel

pytestmark = pytest.mark.native


@pytest.mark.parametrize("dtype", [np.int32, np.int64], ids=["int32", "int64"])
def test_known_integers_wrap(dtype):
    """All arithmetic and conversions of the ends of the range, known alone and beside a number that is not."""
    ends = np.iinfo(dtype)
    known = np.array([ends.max, ends.min, 7, -7, 0], dtype)

    def function(x):
        # Known divisors that are zero end XLA's own compilation with a signal.
        n, by = jnp.asarray(known), jnp.asarray(np.array([3, -2, 2, 3, 5], dtype))
        mixed = jnp.stack([x, n[0], n[1]])  # one number that is not known, two that are
        arithmetic = (n + n, n - n[::-1], n * n, -n, jnp.abs(n), n**3, n << 3, n >> 2, lax.div(n, by), lax.rem(n, by))
        sums = [(x.sum(), x.prod(), jnp.cumsum(x), x @ x) for x in (n, mixed)], mixed * 3, mixed**3
        casts = n.astype(jnp.int32), n.astype(jnp.int64), n.astype(jnp.float64), n.astype(jnp.float64) > 2.0**31
        floats = jnp.asarray([1e30, -1e30, np.nan, np.inf, 2.9]).astype(dtype), -mixed, mixed - mixed[::-1]
        return jax.tree.leaves((arithmetic, sums, casts, floats))

    x = jnp.asarray(3, dtype)
    for mine, theirs in zip(by_kernel(function, x), quick(function)(x), strict=True):
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)


DTYPES = st.sampled_from(["float32", "float64", "int32", "int64"])


@pytest.mark.long
@settings(max_examples=12, deadline=None, derandomize=True)
@given(DTYPES, DTYPES, st.booleans())
def test_products_have_the_dtype_that_is_asked_for(given_dtype, wanted, is_known):
    """`preferred_element_type` wider than the operands, of numbers and of known ones, and what follows from the product."""
    is_narrower = (
        np.dtype(wanted).itemsize < np.dtype(given_dtype).itemsize
        or np.dtype(wanted).kind != np.dtype(given_dtype).kind
    )
    wanted = given_dtype if is_narrower else wanted
    matrix = jnp.asarray([[1, 2], [3, 40000]], given_dtype)

    def function(x):
        y = matrix[0] if is_known else x
        product = lax.dot_general(matrix, y, (((1,), (0,)), ((), ())), preferred_element_type=jnp.dtype(wanted))
        return product, product * product, (product > 3).astype(given_dtype), x

    x = jnp.asarray([5, 60000], given_dtype)
    for mine, theirs in zip(by_kernel(function, x), quick(function)(x), strict=True):
        assert mine.dtype == theirs.dtype
        np.testing.assert_allclose(mine, theirs, rtol=1e-6 if mine.dtype == np.float32 else 1e-15)


def test_known_flags_pass_where_derivatives_stop():
    """Also of no entries, as the masks of a scene without some kind of limits."""

    @kernel
    def function(_, x):
        flags = jax.lax.stop_gradient(jnp.asarray([True, False])), jax.lax.stop_gradient(jnp.zeros(0, bool))
        return jnp.where(flags[0], x, -x), flags[1]

    values, none = jax.jit(lambda x: function(None, x))(jnp.arange(1.0, 3.0))
    np.testing.assert_array_equal(values, [1.0, -2.0])
    assert none.shape == (0,) and none.dtype == bool
