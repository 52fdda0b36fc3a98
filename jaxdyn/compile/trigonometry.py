"""Sines and cosines as polynomials: the numbers of `llvm`, and the same for arrays of JAX.

XLA for GPUs computes the cosines of joints in kernels of their own, as it holds them too dear to be part of another one: nothing
of that is left of a polynomial, and forward dynamics is one kernel and one that puts its columns together.
"""

import functools
import math

import jax.numpy as jnp
import numpy as np
from jax import lax

# pi/2 in three parts: k times each of the first two is exact for the integers k up to 2^23 (2^13 in float32), so that the
# reduced argument is right to rounding for |x| up to MAX_ANGLE (Cody & Waite 1980, ch. 8). Beyond, k x has more digits than
# the parts leave room for; from 1e17 on what is left of x is no angle any more, and polynomials of it have no bound.
HALF_PI = {
    "f8": (1.570796325802803, 9.920935791635221e-10, 5.170182981794105e-19),
    "f4": (1.5703125, 4.837512969970703e-04, 7.549789954891882e-08),
}
MAX_ANGLE = {"f8": 1.3e7, "f4": 1.2e4}
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
    r, quadrant = _reduce_angle(x)
    return _select_by_quadrant(x, *_pair(r), quadrant)


def cosine(x):
    """cos x for floats of 32 or 64 bits."""
    r, quadrant = _reduce_angle(x)
    return _select_by_quadrant(x, *_pair(r), quadrant + 1)


def _kind(x) -> str:
    return f"f{x.dtype.itemsize}"


def _reduce_angle(x):
    """x less whole quarters of a turn, within pi/4 of zero, and their number modulo 4 as an int32."""
    number = x.dtype.type
    quarters = lax.round(x * number(2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = functools.reduce(lambda r, part: r - quarters * number(part), HALF_PI[_kind(x)], x)
    quadrant = (quarters - number(4) * jnp.floor(quarters * number(0.25))).astype(jnp.int32)
    far_r, far_quadrant = _reduce_far_angle(x)
    is_far = jnp.abs(x) > number(MAX_ANGLE[_kind(x)])
    return jnp.where(is_far, far_r, r), jnp.where(is_far, far_quadrant, quadrant)


def _reduce_far_angle(x):
    """`_reduce_angle` for |x| beyond MAX_ANGLE, without branches.

    x is n 2^e with an integer n, so that its quarters are n c with c = 2^e 2/pi. Multiples of 4 do not count, so that a table
    has c modulo 4 for each e, in parts of so few bits that their products with each half of n are exact (Payne & Hanek 1983).
    """
    kind, number = _kind(x), x.dtype.type
    bits, half, first, table = _quarters_table(kind)
    mantissa, exponent = jnp.frexp(x)
    n, e = mantissa * number(2.0**bits), exponent - bits
    high = jnp.floor(n * number(2.0**-half))
    low = n - high * number(2.0**half)
    row = jnp.clip(e - first, 0, table.shape[0] - 1 - half)
    parts = [jnp.asarray(column) for column in table.T]
    total, quadrant, rest = number(0) * n, jnp.zeros(n.shape, jnp.int32), number(0) * n
    for factor, place in ((high, row + half), (low, row)):
        large, middle, small = (part[place] for part in parts)
        for product in (factor * large, factor * middle):
            whole = lax.round(product, lax.RoundingMethod.TO_NEAREST_EVEN)
            total = total + (product - whole)  # exact, and so is the sum
            quadrant = quadrant + (whole - number(4) * jnp.floor(whole * number(0.25))).astype(jnp.int32)
        rest = rest + factor * small
    whole = lax.round(total, lax.RoundingMethod.TO_NEAREST_EVEN)
    return ((total - whole) + rest) * number(np.pi / 2), quadrant + whole.astype(jnp.int32)


@functools.cache
def _quarters_table(kind: str):
    """Bits of a mantissa and of its lower half, the first exponent e, and rows (e, 3) of 2^e 2/pi modulo 4 in three parts."""
    bits, last = (53, 1024) if kind == "f8" else (24, 128)
    half, first = bits // 2, math.frexp(MAX_ANGLE[kind])[1] - bits - 1
    size = last + 3 * bits  # of 2/pi, in bits behind the point
    inverse = (2 << 2 * size) // pi_with_bits(size)
    rows = []
    for e in range(first, last - bits + half + 1):
        value = (inverse << max(e, 0)) >> max(-e, 0)
        value = (value + (2 << size)) % (4 << size) - (2 << size)  # between -2 and 2
        parts = []
        for grain in (half - 2, 2 * half - 2):  # rounded to so many bits behind the point
            unit = 1 << size - grain
            part = (value + unit // 2) // unit * unit
            parts.append(part)
            value -= part
        rows.append([math.ldexp(part >> max(size - 200, 0), -min(size, 200)) for part in (*parts, value)])
    return bits, half, first, np.asarray(rows, np.float64 if kind == "f8" else np.float32)


def pi_with_bits(bits: int) -> int:
    """Pi with so many bits behind the point, as an integer (Machin 1706)."""

    def arctangent_of_inverse(n):
        term = total = (1 << bits + 32) // n
        k, sign = 1, -1
        while term:
            term //= n * n
            k += 2
            total += sign * (term // k)
            sign = -sign
        return total

    return (16 * arctangent_of_inverse(5) - 4 * arctangent_of_inverse(239)) >> 32


def _pair(r):
    """sin r and cos r."""
    number, z = r.dtype.type, r * r

    def polynomial(coefficients):
        return functools.reduce(lambda value, c: value * z + number(c), coefficients[-2::-1], number(coefficients[-1]))

    rest = z * z * polynomial(COSINE[_kind(r)])
    return r + r * z * polynomial(SINE[_kind(r)]), rest + (number(1) - number(0.5) * z)


def _select_by_quadrant(x, sine, cosine, quadrant):
    value = jnp.where(quadrant & 1 == 0, sine, cosine)
    # What is not finite has no quadrant.
    return jnp.where(jnp.isfinite(x), jnp.where(quadrant & 2 == 0, value, -value), x - x)
