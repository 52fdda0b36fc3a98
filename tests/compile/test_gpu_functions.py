"""The functions of the C library that kernels for GPUs bring with them, against NumPy's, and all operations, on the CPU."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gpu_stand_in import run_threads
from jax import lax

from jaxdyn.compile import stored, target
from jaxdyn.compile.expansion import expand
from jaxdyn.compile.gpu import ptx
from jaxdyn.compile.gpu.functions import FUNCTIONS, library_text

pytestmark = pytest.mark.native

RNG = np.random.default_rng(0)
NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "pow": "power"}
OF_TWO = ("pow", "atan2", "fmod")
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -0.5, np.inf, -np.inf, np.nan, 1e-310, 1e308, -1e308, 5e-324])
ATTRIBUTES = 'attributes #0 = { nounwind "no-builtins" }'


def compiled(name):
    kind = ctypes.c_float if name not in FUNCTIONS and name != "fmod" else ctypes.c_double
    written = library_text(name).replace("define internal", "define")  # so that this test can call it
    code = stored.Code(stored.compile_text(f"{written}\n{ATTRIBUTES}"))
    arguments = 2 if name.removesuffix("f") in OF_TWO or name in OF_TWO else 1
    call = ctypes.CFUNCTYPE(kind, *[kind] * arguments)(code.address(name))
    call.code = code
    return call


def arguments_of(name):
    """Arguments of every size that have a result, and special ones."""
    wide = np.concatenate([RNG.normal(size=2000), RNG.normal(size=2000) * 10.0 ** RNG.uniform(-12, 12, size=2000)])
    if name == "fmod":
        x, y = wide, np.roll(wide, 1) + 0.1
    elif name in OF_TWO:
        x, y = wide, np.roll(wide, 7)
        if name == "pow":
            x = np.concatenate([np.abs(x), -np.arange(1.0, 20.0), 1 + 1e-9 * RNG.normal(size=500)])
            y = np.concatenate([np.clip(y, -300, 300), np.arange(-9.0, 10.0), RNG.normal(size=500) * 1e9])
    elif name in ("exp", "exp2", "expm1", "sinh", "cosh", "tanh"):
        x = np.concatenate([RNG.uniform(-745, 711, 3000), RNG.normal(size=1000), wide[2000:][np.abs(wide[2000:]) < 1]])
    elif name in ("asin", "acos"):
        x = np.concatenate([RNG.uniform(-1, 1, 3000), 1 - 10.0 ** RNG.uniform(-16, 0, 500), [1.5]])
    elif name in ("sin", "cos"):  # far angles alone: near ones have polynomials of their own
        x = np.concatenate([10.0 ** RNG.uniform(4.1, 308, 3000), -(10.0 ** RNG.uniform(4.1, 20, 1000))])
        x = np.concatenate([x, np.arange(3e7, 3e7 + 500) * np.pi / 2])  # near whole quarters of a turn
    elif name == "tan":
        x = np.concatenate([wide, 10.0 ** RNG.uniform(6, 300, 1000)])
    else:
        x = np.concatenate([wide, np.abs(wide), 1 + 1e-6 * RNG.normal(size=1000), 10.0 ** RNG.uniform(-300, 300, 500)])
    if name in OF_TWO:
        a, b = np.meshgrid(SPECIAL, SPECIAL)
        return np.concatenate([x, a.ravel()]), np.concatenate([y, b.ravel()])
    return (x if name in ("sin", "cos") else np.concatenate([x, SPECIAL]),)


@pytest.mark.parametrize("name", [*FUNCTIONS, "fmod"])
def test_functions_are_those_of_the_c_library(name):
    """To four units in the last place, and the same numbers at zero, at infinity and where there is no result."""
    function, args = compiled(name), arguments_of(name)
    computed = np.array([function(*x) for x in zip(*map(np.ndarray.tolist, args), strict=True)])
    # A hundred digits would show the error of NumPy's functions, half a unit, which the bound contains.
    with np.errstate(all="ignore"):
        wanted = getattr(np, NUMPY.get(name, name))(*args)
    same = (computed == wanted) | (np.isnan(computed) & np.isnan(wanted))
    signs = (np.signbit(computed) == np.signbit(wanted)) | np.isnan(wanted) | ~same
    assert signs.all(), [x[~signs][:5] for x in args]
    assert np.isfinite(computed[~same]).all(), [x[~same & ~np.isfinite(computed)][:5] for x in args]
    with np.errstate(all="ignore"):
        units = np.abs(computed - wanted)[~same] / np.spacing(np.abs(wanted[~same]))
    bound = 0 if name == "fmod" else 4
    worst = np.argmax(units) if units.size else 0
    assert units.max(initial=0.0) <= bound, (units.max(), [x[~same][worst] for x in args])


@pytest.mark.parametrize("name", ["expf", "powf", "sinf", "fmodf"])
def test_functions_of_float32_are_rounded_ones_of_float64(name):
    function = compiled(name)
    with np.errstate(over="ignore"):
        args = [x.astype(np.float32) for x in arguments_of(name.removesuffix("f"))]
    computed = np.array([function(*x) for x in zip(*map(np.ndarray.tolist, args), strict=True)], np.float32)
    base = name.removesuffix("f")
    with np.errstate(all="ignore"):
        wanted = getattr(np, NUMPY.get(base, base))(*(x.astype(np.float64) for x in args)).astype(np.float32)
    same = (computed == wanted) | (np.isnan(computed) & np.isnan(wanted))
    assert same.mean() > 0.999
    with np.errstate(all="ignore"):
        assert (np.abs(computed - wanted)[~same] <= np.spacing(np.abs(wanted[~same]))).all()


def operations(x, n):
    """Every operation that programs have, of floats x (k,), integers n (k,) and flags."""
    y, flag = x[::-1], x > 0.3
    floats = [
        x + y, x - y, x * y, x / y, -x, jnp.maximum(x, y), jnp.minimum(x, y), jnp.abs(x), jnp.sign(x), jnp.floor(x), jnp.ceil(x),
        jnp.round(x), jnp.sqrt(jnp.abs(x)), lax.clamp(x.dtype.type(-0.5), x, x.dtype.type(0.5)), jnp.where(flag, x, y),
        lax.rem(x, y), jnp.max(x)[None], jnp.min(x)[None], jnp.sin(x), jnp.cos(x), jnp.tan(x), jnp.cbrt(x), n.astype(x.dtype),
        flag.astype(x.dtype), lax.pow(jnp.abs(x), y), jnp.exp2(x), jnp.expm1(x), jnp.sinh(x), jnp.cosh(x), jnp.arcsin(x / 10),
        jnp.arccos(x / 10), jnp.arctan(x), x @ y[:, None],
    ]  # fmt: skip
    whole = [n + 3, -n, n * n, jnp.maximum(n, 2), n & 5, n | 8, (100 * x).astype(n.dtype), (1e30 * x).astype(n.dtype)]
    flags = [
        x < y,
        x <= y,
        x == y,
        x != y,
        x >= y,
        flag & (n > 0),
        flag | (n == 1),
        ~flag,
        jnp.isfinite(x / (n - 1).astype(x.dtype)),
    ]
    return floats, [*whole, flag.astype(n.dtype)], flags


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("integer", [np.int32, np.int64])
def test_every_operation(dtype, integer):
    samples = 4
    x = np.concatenate([RNG.normal(size=(samples - 1, 3)), [[np.inf, np.nan, 0.0]]]).astype(dtype)
    n = RNG.integers(-3, 4, size=(samples, 3)).astype(integer)
    program = expand(jax.make_jaxpr(operations)(x[0], n[0]), 10**6)[0]
    computed = run_threads(program, [x, n])
    wanted = [target.call(program, [x[s], n[s]]) for s in range(samples)]
    bound = 2e-15 if dtype == np.float64 else 1e-6
    for k, result in enumerate(computed):
        want = np.stack([row[k] for row in wanted]).reshape(samples, -1)
        assert result.dtype == want.dtype
        np.testing.assert_allclose(result, want, rtol=bound, atol=0)
    assert ".entry" in ptx.ptx_of(ptx.module_ir(program, [False, False]), 70)
