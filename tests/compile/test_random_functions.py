"""Random functions as kernels and by JAX alone: equal but for what docs/algorithms.md lists, and each listed rule as it says.

`python -m benchmarks.random_functions` compares ten thousand of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax
from kernel_helpers import by_kernel, native

from benchmarks.numpy_jaxprs import CONTRACTION, EQUAL_DIFFERENCE, ZERO_PRODUCT, ZERO_SIGN, trace_and_evaluate
from benchmarks.random_functions import BINARY, NAMES, SPECIAL, UNARY, Function, differentiated, judge
from jaxdyn.compile import target
from jaxdyn.compile.expansion import expand

pytestmark = pytest.mark.native
NUMBERS = st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 3.25, -0.75, np.nan, np.inf, -np.inf, 1e30])


@st.composite
def functions(draw) -> Function:
    """Of up to five steps, each of which takes the value before it, and perhaps another one."""
    steps = []
    for k in range(draw(st.integers(1, 5))):
        if draw(st.booleans()):
            steps.append((draw(st.sampled_from(sorted(UNARY))), (k,)))
        else:
            steps.append((draw(st.sampled_from(sorted(BINARY))), draw(st.permutations((k, draw(st.integers(0, k)))))))
    return Function(tuple((name, tuple(args)) for name, args in steps))


@pytest.mark.long
@settings(max_examples=14, deadline=None, derandomize=True)
@given(
    functions(),
    st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=3),
    st.sampled_from(["float64", "float32"]),
)
def test_values_and_derivatives_are_those_of_jax(function, points, dtype):
    """Values, jvp, vjp and Hessians at points with NaN, infinities, zeros and ties."""
    x = jnp.asarray([(0.3, -1.2, 0.7), *points], dtype)
    x = jnp.concatenate([x, jnp.asarray(SPECIAL, dtype)])  # which `judge` takes to be the last ones
    step, cotangent = np.random.default_rng(0).normal(size=(2, *x.shape))
    args = x, jnp.asarray(step, dtype), jnp.asarray(cotangent, dtype)
    wanted = trace_and_evaluate(jax.vmap(differentiated(function)), *args)
    program = expand(jax.make_jaxpr(differentiated(native(function)))(*(y[0] for y in args)), 10**6)[0]
    samples = [target.call(program, [np.asarray(y[i]) for y in args]) for i in range(len(x))]
    verdicts = judge(function, args, [np.stack(column) for column in zip(*samples, strict=True)], wanted)
    different = [verdict for verdict in verdicts if isinstance(verdict, tuple)]
    assert not different, (function.steps, [(name, np.asarray(x[i])) for _, name, i in different])
    assert sum(verdicts.values()) == len(NAMES) * len(x)


@pytest.mark.parametrize(
    ("function", "x", "by_rule", "by_jax"),
    [
        (lambda x: jnp.zeros(2) * x, [np.nan, np.inf], [0.0, 0.0], [np.nan, np.nan]),
        (lambda x: x - x, [np.inf, np.nan], [0.0, 0.0], [np.nan, np.nan]),
        (lambda x: x[0] * x[1] - x[1] * x[0], [np.inf, 1.0], 0.0, np.nan),
        (lambda x: 1 / (x + 0.0), [-0.0, 0.0], [-np.inf, np.inf], [np.inf, np.inf]),
        (lambda x: 1 / (0.0 - x), [0.0, 1.0], [-np.inf, -1.0], [np.inf, -1.0]),
        (lambda x: 1 / ((-x) - x[::-1]), [0.0, -0.0], [-np.inf, -np.inf], [np.inf, np.inf]),
        (lambda x: 1 / jnp.sin(x), [-0.0, 0.0], [np.inf, np.inf], [-np.inf, np.inf]),
    ],
    ids=["0 x", "x - x", "x y - y x", "x + 0", "0 - x", "-x - y", "sine of -0"],
)
def test_rules_that_change_results(function, x, by_rule, by_jax):
    """Every line of the page's table."""
    x = jnp.asarray(x)
    np.testing.assert_array_equal(by_kernel(function, x)[0], by_rule)
    np.testing.assert_array_equal(trace_and_evaluate(function, x)[0], by_jax)


def test_rules_that_are_not_taken():
    """What could be folded and is not: an overflow, 0/x, x/x, and a maximum of a number and itself."""

    def function(x):
        return x * 1e200 * 1e200 * 1e-300, 0.0 / x, x / x, jnp.maximum(x, x), jnp.where(x > 0, x, x), lax.rem(x, x)

    x = jnp.array([1.0, 0.0, np.nan, np.inf])
    for mine, theirs in zip(by_kernel(function, x), trace_and_evaluate(function, x), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    slope = jax.grad(lambda x: jnp.maximum(x, x))
    np.testing.assert_array_equal(by_kernel(jax.vmap(slope), x)[0], jax.vmap(slope)(x))


def test_known_entries_among_unknown_ones():
    """Every function of arrays some of whose entries are known: the derivative of tanh once had no rule for those."""

    def compute(x):
        mixed = x.at[1].set(0.3)
        pair = [f(mixed) for f in UNARY.values()] + [f(mixed, mixed[::-1] + 0.25) for f in BINARY.values()]
        return jnp.stack(pair)

    def both(x, step):
        return jax.jvp(compute, (x,), (step,))

    x = jnp.array([0.7, 0.4, 1.2]), jnp.array([0.3, -0.8, 0.6])
    for mine, theirs in zip(by_kernel(both, *x), trace_and_evaluate(both, *x), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


def test_the_reference_finds_the_rules_that_it_meets():
    """The verdict of a random function rests on it."""
    cases = {
        ZERO_PRODUCT: (lambda x: 0 * x, np.nan),
        EQUAL_DIFFERENCE: (lambda x: x - x, np.inf),
        ZERO_SIGN: (lambda x: jnp.arctan2(0 * x, x), -0.0),
    }
    for rule, (function, x) in cases.items():
        met: set[str] = set()
        trace_and_evaluate(function, jnp.asarray(x), met=met)
        assert rule in met
        met.clear()
        trace_and_evaluate(function, jnp.asarray(1.5), met=met)
        assert met <= {CONTRACTION, ZERO_SIGN}
