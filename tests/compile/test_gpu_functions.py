"""The functions of the C library that kernels for GPUs bring with them, against NumPy's, on the CPU."""

import ctypes

import numpy as np
import pytest

from jaxdyn.compile import objects
from jaxdyn.compile.gpu.functions import FUNCTIONS, library_text

pytestmark = pytest.mark.native

RNG = np.random.default_rng(0)
NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "pow": "power"}
OF_TWO = ("pow", "atan2", "fmod")
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -0.5, np.inf, -np.inf, np.nan, 1e-310, 1e308, -1e308, 5e-324])
ATTRIBUTES = 'attributes #0 = { nounwind "no-builtins" }'


def compiled(name):
    kind = ctypes.c_float if name not in FUNCTIONS and name != "fmod" else ctypes.c_double
    text = library_text(name)
    # Functions are internal: the one that is called has another name.
    code = objects.Code(objects.compile_text(f"{text.replace('define internal', 'define')}\n{ATTRIBUTES}"))
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
