"""Sines and cosines as polynomials: the numbers of `llvm`, and the same for arrays of JAX.

XLA for GPUs computes the cosines of joints in kernels of their own, as it holds them too dear to be part of another one: nothing
of that is left of a polynomial, and forward dynamics is one kernel and one that puts its columns together.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import lax

# pi/2 in three parts: k times each of the first two is exact for the integers k up to 2^23 (2^13 in float32), so that the
# reduced argument is right to rounding for |x| up to 1.3e7 (1.2e4). Beyond, the error stays within one unit in the last
# place of x itself (Cody & Waite 1980, ch. 8).
HALF_PI = {
    "f8": (1.570796325802803, 9.920935791635221e-10, 5.170182981794105e-19),
    "f4": (1.5703125, 4.837512969970703e-04, 7.549789954891882e-08),
}
# (sin x - x)/x^3 and (cos x - 1 + x^2/2)/x^4 as polynomials in x^2 on |x| <= pi/4: Chebyshev fits made with 200 bits (mpmath
# chebyfit), off by 2e-17 and 1e-18 in float64, 2e-8 and 2e-9 in float32.
SINE = {
    "f8": (
        -0.16666666666666666,
        0.008333333333330936,
        -0.00019841269836740527,
        2.7557316093196066e-06,
        -2.5051129895962807e-08,
        1.5917988944318716e-10,
    ),
    "f4": (-0.16666664656310706, 0.008332747104372895, -0.000195876390357926),
}
COSINE = {
    "f8": (
        0.041666666666666664,
        -0.0013888888888887389,
        2.48015872987544e-05,
        -2.7557317265876615e-07,
        2.087614504910828e-09,
        -1.1382544623404291e-11,
    ),
    "f4": (0.04166666465348729, -0.0013888301867270142, 2.4547689709382208e-05),
}


def sine(x):
    """sin x for floats of 32 or 64 bits."""
    r, quadrant = _reduced(x)
    return _turned(x, *_pair(r), quadrant)


def cosine(x):
    """cos x for floats of 32 or 64 bits."""
    r, quadrant = _reduced(x)
    return _turned(x, *_pair(r), quadrant + 1)


def _kind(x) -> str:
    return f"f{x.dtype.itemsize}"


def _reduced(x):
    """x less whole quarters of a turn, within pi/4 of zero, and their number modulo 4 as an int32."""
    number = x.dtype.type
    quarters = lax.round(x * number(2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = functools.reduce(lambda r, part: r - quarters * number(part), HALF_PI[_kind(x)], x)
    return r, (quarters - number(4) * jnp.floor(quarters * number(0.25))).astype(jnp.int32)


def _pair(r):
    """sin r and cos r."""
    number, z = r.dtype.type, r * r

    def polynomial(coefficients):
        return functools.reduce(lambda value, c: value * z + number(c), coefficients[-2::-1], number(coefficients[-1]))

    rest = z * z * polynomial(COSINE[_kind(r)])
    return r + r * z * polynomial(SINE[_kind(r)]), rest + (number(1) - number(0.5) * z)


def _turned(x, sine, cosine, quadrant):
    value = jnp.where(quadrant & 1 == 0, sine, cosine)
    # What is not finite has no quadrant.
    return jnp.where(jnp.isfinite(x), jnp.where(quadrant & 2 == 0, value, -value), x - x)
