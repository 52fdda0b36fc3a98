"""Sine and cosine together, in plain arithmetic that XLA:CPU vectorises (its float64 library calls are not vectorised)."""

import jax
import jax.numpy as jnp
import numpy as np

# pi/2 in three parts: k times each of the first two is exact for the integers k up to 2^23 (2^13 in float32), so that the
# reduced argument is right to rounding for |x| up to 1.3e7 (1.2e4). Beyond, the error stays within one unit in the last
# place of x itself.
_PARTS = {
    np.dtype("float64"): (1.570796325802803, 9.920935791635221e-10, 5.170182981794105e-19),
    np.dtype("float32"): (1.5703125, 4.837512969970703e-04, 7.549789954891882e-08),
}
# (sin x - x)/x^3 and (cos x - 1 + x^2/2)/x^4 as polynomials in x^2 on |x| <= pi/4: Chebyshev fits made with 200 bits (mpmath
# chebyfit), off by 2e-17 and 1e-18 in float64, 2e-8 and 2e-9 in float32.
_SINE = {
    np.dtype("float64"): (
        -0.16666666666666666,
        0.008333333333330936,
        -0.00019841269836740527,
        2.7557316093196066e-06,
        -2.5051129895962807e-08,
        1.5917988944318716e-10,
    ),
    np.dtype("float32"): (-0.16666664656310706, 0.008332747104372895, -0.000195876390357926),
}
_COSINE = {
    np.dtype("float64"): (
        0.041666666666666664,
        -0.0013888888888887389,
        2.48015872987544e-05,
        -2.7557317265876615e-07,
        2.087614504910828e-09,
        -1.1382544623404291e-11,
    ),
    np.dtype("float32"): (0.04166666465348729, -0.0013888301867270142, 2.4547689709382208e-05),
}


def _polynomial(coefficients, z):
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = coefficient + z * value
    return value


@jax.custom_jvp
def sin_cos(x):
    """(sin x, cos x) to about one unit in the last place, x in rad, any shape, float32 or float64.

    Range reduction by multiples of pi/2 split in three parts (Cody & Waite 1980, ch. 8) and minimax polynomials.
    """
    dtype = np.dtype(x.dtype)
    if dtype not in _PARTS:
        return jnp.sin(x), jnp.cos(x)
    turns = jnp.round(x * (2 / np.pi))
    high, middle, low = _PARTS[dtype]
    r = ((x - turns * high) - turns * middle) - turns * low
    z = r * r
    sine = r + r * z * _polynomial(_SINE[dtype], z)
    cosine = 1 - 0.5 * z + z * z * _polynomial(_COSINE[dtype], z)
    quadrant = turns - 4 * jnp.floor(turns * 0.25)
    odd = (quadrant == 1) | (quadrant == 3)
    s, c = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(quadrant >= 2, -s, s), jnp.where((quadrant == 1) | (quadrant == 2), -c, c)


@sin_cos.defjvp
def _sin_cos_jvp(primals, tangents):
    s, c = sin_cos(*primals)
    return (s, c), (c * tangents[0], -s * tangents[0])
