"""Every primitive of JAX: which ones become numbers, which ones leave a function to JAX, and which ones cannot occur."""

import importlib
import pkgutil
from types import SimpleNamespace

import jax
import jax._src.lax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import Primitive, primitives

from jaxdyn.compile import expansion, jax_adapter
from jaxdyn.compile.derive import replay
from jaxdyn.compile.graph import Graph

X, Y = np.array([0.3, -0.7, 0.9]), np.array([1.2, 0.4, -0.6])
POSITIVE, SQUARE = np.array([0.3, 1.7, 2.9]), np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]])
TRUTHS, OTHERS = np.array([True, False, True]), np.array([True, True, False])


def unary(*names, x=X):
    return {name: (getattr(lax, name), x) for name in names if hasattr(lax, name)}


def binary(**functions):
    return {name: (function, X, Y) for name, function in functions.items()}


@jax.custom_jvp
def _with_a_rule(x):
    return jnp.sin(x)


_with_a_rule.defjvp(lambda primals, steps: (jnp.sin(primals[0]), jnp.cos(primals[0]) * steps[0]))


@jax.custom_vjp
def _with_a_reverse_rule():
    return jnp.ones(3)


_with_a_reverse_rule.defvjp(lambda: (jnp.ones(3), None), lambda _, __: ())


def _solve(x):
    return lax.custom_linear_solve(lambda y: 2.0 * y, x, lambda _, b: b / 2.0, symmetric=True)


def _sum_of_squares(x):
    return lax.scan(lambda total, y: (total + y * y, total), 0.0, x)


# Each with a function that has it and arguments.
EXPANDED = {
    **unary("abs", "asin", "acos", "atan", "cbrt", "ceil", "cos", "cosh", "exp", "exp2", "expm1", "floor", "is_finite"),
    **unary("neg", "one_minus_square", "sign", "sin", "sinh", "square", "tan", "tanh"),
    **unary("log", "log1p", "log2", "rsqrt", "sqrt", x=POSITIVE),
    **binary(
        add=lax.add, sub=lax.sub, mul=lax.mul, div=lax.div, max=lax.max, min=lax.min, rem=lax.rem, atan2=lax.atan2
    ),
    **binary(eq=lax.eq, ne=lax.ne, lt=lax.lt, le=lax.le, gt=lax.gt, ge=lax.ge, stack=lambda x, y: jnp.stack([x, y])),
    **binary(concatenate=lambda x, y: lax.concatenate([x, y], 0), dot_general=lambda x, y: x @ y),
    **binary(select_n=lambda x, y: lax.select_n(x > y, x, y), add_any=lambda x, y: primitives.add_jaxvals_p.bind(x, y)),
    "and": (lax.bitwise_and, TRUTHS, OTHERS),
    "or": (lax.bitwise_or, TRUTHS, OTHERS),
    "not": (lax.bitwise_not, TRUTHS),
    "pow": (lax.pow, POSITIVE, Y),
    "integer_pow": (lambda x: lax.integer_pow(x, -3), X),
    "round": (lambda x: lax.round(3 * x, lax.RoundingMethod.TO_NEAREST_EVEN), X),
    "clamp": (lambda x: lax.clamp(-0.5, x, 0.5), X),
    "stop_gradient": (lax.stop_gradient, X),
    "copy": (lambda x: lax.copy_p.bind(x), X),
    "optimization_barrier": (lambda x: lax.optimization_barrier(x), X),
    "convert_element_type": (lambda x: lax.convert_element_type(x, jnp.float32), X),
    "broadcast_in_dim": (lambda x: lax.broadcast_in_dim(x, (2, 3), (1,)), X),
    "reshape": (lambda x: lax.reshape(x, (9,)), SQUARE),
    "squeeze": (lambda x: lax.squeeze(x, (0,)), X[None]),
    "transpose": (lambda x: lax.transpose(x, (1, 0)), np.arange(6.0).reshape(2, 3)),
    "rev": (lambda x: lax.rev(x, (0,)), X),
    "slice": (lambda x: lax.slice(x, (1,), (3,)), X),
    "split": (lambda x: lax.split(x, (1, 2)), X),
    "unstack": (
        lambda x: primitives.unstack_p.bind(x, axis=0) if hasattr(primitives, "unstack_p") else jnp.unstack(x),
        X,
    ),
    "tile": (lambda x: lax.tile(x, (2,)), X),
    "pad": (lambda x: lax.pad(x, 0.5, [(1, 2, 1)]), X),
    "gather": (lambda x: x[np.array([2, 0])], X),
    "dynamic_slice": (lambda x: lax.dynamic_slice(x, (1,), (2,)), X),
    "dynamic_update_slice": (lambda x, y: lax.dynamic_update_slice(x, y[:1], (1,)), X, Y),
    "scatter": (lambda x: x.at[np.array([2, 0])].set(1.5), X),
    "scatter-add": (lambda x: x.at[np.array([2, 0])].add(1.5), X),
    "reduce_sum": (lambda x: jnp.sum(x, 0), SQUARE),
    "reduce_prod": (lambda x: jnp.prod(x, 0), SQUARE),
    "reduce_max": (lambda x: jnp.max(x, 0), SQUARE),
    "reduce_min": (lambda x: jnp.min(x, 0), SQUARE),
    "reduce_and": (jnp.all, TRUTHS),
    "reduce_or": (jnp.any, TRUTHS),
    **unary("cumprod", "cummax", "cummin"),
    "argmax": (lambda x: lax.argmax(x, 0, jnp.int32), X),
    "argmin": (lambda x: lax.argmin(x, 0, jnp.int32), X),
    "lt_to": (lambda x, y: INSTALLED["lt_to"].bind(x, y), X, Y),
    "le_to": (lambda x, y: INSTALLED["le_to"].bind(x, y), X, Y),
    "lu": (lambda x: jax.lax.linalg.lu(x)[0], SQUARE),
    "cumsum": (lambda x: lax.cumsum(x, 0, True), SQUARE),
    "cholesky": (lambda x: lax.linalg.cholesky(x, symmetrize_input=False), SQUARE),
    "triangular_solve": (
        lambda A, b: lax.linalg.triangular_solve(A, b[:, None], left_side=True, lower=True),
        SQUARE,
        X,
    ),
    "polynomial": (lambda x, y: lax.polynomial(x, [1.0, y, -2.0, 0.5]), X, Y),
    "scan": (_sum_of_squares, X),
    "while": (lambda x: lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * x), (0, x))[1], X),
    "cond": (lambda x: lax.cond(x.ndim == lax.rem(7, 3), jnp.sin, jnp.cos, x), X),
    "jit": (jax.jit(lambda x: jnp.sin(x)), X),
    "remat2": (jax.checkpoint(lambda x: jnp.sin(x) * x), X),
    "custom_jvp_call": (_with_a_rule, X),
    "custom_vjp_call": (lambda x: x + _with_a_reverse_rule(), X),
    "custom_linear_solve": (_solve, X),
}

# Functions that JAX calls by itself within derivatives: up to 0.10, and since 0.11.
CALLS = {"closed_call", "eval_jaxpr"}

# With these a function is left to JAX (`NotNumbers`): functions and algorithms that mechanics do not need, or whose course
# depends on numbers.
REFUSED = set(
    """acosh asinh atanh erf erf_inv erfc logistic lgamma digamma polygamma zeta igamma igammac igamma_grad_a
    bessel_i0e bessel_i1e regularized_incomplete_beta nextafter reduce_precision cumlogsumexp
    sort top_k approx_top_k reduce reduce_xor reduce_window reduce_window_max reduce_window_min reduce_window_sum
    select_and_gather_add select_and_scatter select_and_scatter_add scatter-max scatter-min scatter-mul scatter-sub
    xor shift_left shift_right_arithmetic shift_right_logical clz population_count mulhi bitcast_convert_type
    real imag complex conj fft conv_general_dilated ragged_dot_general scaled_dot composite name
    eig eigh svd qr schur hessenberg householder_product tridiagonal tridiagonal_solve cholesky_update symmetric_product
    geqp3 geqrf ormqr lu_pivots_to_permutation empty empty2 call""".split()
)
# These are in no function of one sample of mechanics: devices, random keys, memory that is written, what JAX itself works with.
# Where one occurs all the same, it is refused as well.
NOT_APPLICABLE = set(
    """after_all create_token custom_lin dce_sink device_put eq_to from_edtype to_edtype get swap stage
    program_order tie platform_index iota random_bits random_fold_in random_gamma random_seed random_split random_wrap
    random_unwrap random_clone rng_bit_generator rng_uniform threefry2x32 sharding_constraint axis_index all_gather
    all_gather_done all_gather_invariant all_gather_reduced all_gather_reduced_start all_gather_start all_to_all all_to_all_done
    all_to_all_start pbroadcast pbroadcast_done pbroadcast_dynamic pbroadcast_start pmax pmin ppermute ppermute_done
    ppermute_start precv preduced psend psum psum_done psum_invariant psum_invariant_start psum_start pvary
    ragged_all_to_all reduce_scatter reduce_scatter_done reduce_scatter_start unreduced_pmax unreduced_pmin
    unreduced_psum unreduced_psum_start unreduced_reduce_scatter unreduced_reduce_scatter_start vary_unreduced_cast
    vary_unreduced_cast_p""".split()
)


def installed() -> dict[str, Primitive]:
    """All primitives that `jax.lax` defines and those that `jax.extend` names, by name."""
    modules = [lax, primitives]
    for module in pkgutil.walk_packages(jax._src.lax.__path__, "jax._src.lax."):
        modules.append(importlib.import_module(module.name))
    values = [getattr(module, name, None) for module in modules for name in dir(module)]
    return {x.name: x for x in values if isinstance(x, Primitive)}


INSTALLED = installed()


def with_rules() -> set[str]:
    """Primitives for which there is a rule."""
    of_numbers = expansion._Expansion(Graph(), calls=False, branches=False)
    tables = (
        of_numbers.elementwise,
        of_numbers.reductions,
        expansion._OTHER,
        expansion._INNER,
        expansion.AT_PLACES,
        expansion.REARRANGEMENTS,
    )
    return {"div", *(name for table in tables for name in table)}


def test_every_primitive_is_placed():
    """A primitive that a tested version of JAX has and no list names: write a rule for it, or say why there is none."""
    assert jax_adapter.is_version_known()
    listed = EXPANDED.keys() | CALLS | REFUSED | NOT_APPLICABLE
    unknown = INSTALLED.keys() - listed
    assert not unknown, (
        f"primitives of jax {jax.__version__} that tests/compile/test_primitives.py does not place: {sorted(unknown)}"
    )
    assert not EXPANDED.keys() & REFUSED and not EXPANDED.keys() & NOT_APPLICABLE and not REFUSED & NOT_APPLICABLE


def test_expanded_are_those_with_rules():
    assert with_rules() & INSTALLED.keys() == (EXPANDED.keys() | CALLS) & INSTALLED.keys()


def names_in(jaxpr) -> set[str]:
    names = set()
    for eqn in jaxpr.eqns:
        names.add(eqn.primitive.name)
        for value in jax.tree.leaves(
            list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "jaxpr") or hasattr(x, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                names |= names_in(inner)
    return names


@pytest.mark.parametrize("name", sorted(EXPANDED.keys() & INSTALLED.keys()))
def test_numbers_are_those_of_jax(name):
    """The program of numbers, worked out in Python, against JAX's own evaluation of the function."""
    function, *args = EXPANDED[name]
    closed = jax.make_jaxpr(function)(*args)
    assert name in names_in(closed.jaxpr)
    program, _ = expansion.expand(closed, 10_000)
    entries = [np.array(x.ravel().tolist(), object).reshape(x.shape) for x in args]
    _, outputs = replay(Graph(), program, entries)
    wanted = jax.tree.leaves(function(*map(jnp.asarray, args)))
    for computed, y in zip(outputs, wanted, strict=True):
        tolerance = 1e-6 if y.dtype == jnp.float32 else 1e-14
        np.testing.assert_allclose(np.asarray(computed, y.dtype), np.asarray(y), rtol=tolerance, atol=tolerance)


def test_calls_of_jaxprs():
    closed = jax.make_jaxpr(jnp.sin)(X)
    for name in CALLS:
        equation = SimpleNamespace(primitive=SimpleNamespace(name=name), params={"call_jaxpr": closed})
        (computed,) = expansion._Expansion(Graph(), calls=False, branches=False).one(equation, [X])
        np.testing.assert_allclose(computed, np.sin(X), rtol=1e-15)


@pytest.mark.skipif("one_minus_square" not in INSTALLED, reason="jax 0.12 is the first with it")
def test_one_less_a_square_is_exact_near_one_and_its_slope_near_zero():
    def slope(x):
        return jax.jvp(lax.one_minus_square, (x,), (jnp.ones_like(x),))[1]

    near_one, near_zero = np.array([1 - 1e-12, -1 + 1e-13]), np.array([1e-9, -1e-17])
    for function, x in ((lax.one_minus_square, near_one), (slope, near_zero)):
        program, _ = expansion.expand(jax.make_jaxpr(function)(x), 100)
        computed = replay(Graph(), program, [x.astype(object)])[1][0].astype(float)
        exact = (1 - x) * (1 + x) if function is lax.one_minus_square else -2 * x
        np.testing.assert_allclose(computed, exact, rtol=1e-15)
