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
    ppermute_start precv preduced psend psum psum_done psum_invariant psum_invariant_start psum_start
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
    """Primitives for which there is a rule; `test_kernels.py` and `test_look_ups.py` compare what they compute with JAX."""
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
    listed = with_rules() | CALLS | REFUSED | NOT_APPLICABLE
    unknown = INSTALLED.keys() - listed
    assert not unknown, (
        f"primitives of jax {jax.__version__} that tests/compile/test_primitives.py does not place: {sorted(unknown)}"
    )
    assert not with_rules() & REFUSED and not with_rules() & NOT_APPLICABLE and not REFUSED & NOT_APPLICABLE


def test_calls_of_jaxprs():
    x = np.array([0.3, -0.7, 0.9])
    closed = jax.make_jaxpr(jnp.sin)(x)
    for name in CALLS:
        equation = SimpleNamespace(primitive=SimpleNamespace(name=name), params={"call_jaxpr": closed})
        (computed,) = expansion._Expansion(Graph(), calls=False, branches=False).one(equation, [x])
        np.testing.assert_allclose(computed, np.sin(x), rtol=1e-15)


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
