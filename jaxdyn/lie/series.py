"""Smooth scalar functions of the squared angle that the groups share.

Each function is analytic in s = theta^2 around s = 0, yet its closed form is 0/0 there and loses digits near it, more
with every derivative; so a power series takes over well before that hurts. Both branches get a safe input (double
where), because an overflowing or undefined branch that is not selected still has the derivative 0 * inf = NaN.
"""

import functools
import inspect
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


def _is_double(x: Scalar) -> bool:
    return jnp.finfo(x.dtype).bits > 32


def _polynomial(x: Scalar, coefficients: list[float]) -> Scalar:
    """Horner's rule, lowest power first; plain Python floats take the dtype of x."""
    total = x * coefficients[-1] + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total = total * x + coefficient
    return total


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def stumpff(s: Scalar, order: int = 3) -> tuple[Scalar, ...]:
    """Stumpff functions c_0 ... c_order of the squared angle.

    c_k(s) = sum_j (-s)^j / (2 j + k)! = 1/k! - s c_(k+2). With theta = sqrt(s): c0 = cos theta,
    c1 = sin(theta) / theta, c2 = (1 - cos theta) / theta^2, c3 = (theta - sin theta) / theta^3.

    The derivative is dc_k/ds = (k c_(k+2) - c_(k+1)) / 2, again Stumpff functions, so derivatives of every order are
    as accurate as values and a program grows by a few operations per order, not by a factor.

    **Arguments:** `s`: squared angle, (), rad^2, not negative; `order`: highest index, static, at least 3.

    **Returns:** c_0 ... c_order, each (). For many turns the error is that of sin and cos at an angle rounded to
    eps theta.

    Source: Stumpff, Himmelsmechanik I (1959).
    """
    # Left out of a series: switch^n_terms / (2 n_terms + 2)! of c2 at worst, under a tenth of eps. Lost by a closed
    # form: one or two digits in c7, which the second derivative of c3 needs; little, as s >= 4 there.
    switch, n_terms = (4.0, 11) if _is_double(s) else (4.0, 7)
    small = s < switch
    s_small = jnp.where(small, s, 0.0)
    s_large = jnp.where(small, switch, s)
    theta = jnp.sqrt(s_large)
    near = [s_small] * (order + 1)
    far = [jnp.cos(theta), jnp.sin(theta) / theta] + [s_large] * (order - 1)
    # Downwards: only the two highest functions are summed as series, each lower one costs one product.
    for k in range(order, -1, -1):
        if k > order - 2:
            near[k] = _polynomial(s_small, [(-1.0) ** j / math.factorial(2 * j + k) for j in range(n_terms)])
        else:
            near[k] = 1.0 / math.factorial(k) - s_small * near[k + 2]
    # Upwards from cosine and sine: division by s >= 4 damps rounding errors.
    for k in range(2, order + 1):
        far[k] = (1.0 / math.factorial(k - 2) - far[k - 2]) / s_large
    return tuple(jnp.where(small, a, b) for a, b in zip(near, far, strict=True))


@stumpff.defjvp
def _stumpff_jvp(order, primals, tangents):
    c = stumpff(primals[0], order + 2)
    rate = 0.5 * tangents[0]
    return c[: order + 1], tuple((k * c[k + 2] - c[k + 1]) * rate for k in range(order + 1))


def inverse_coefficient(s: Scalar) -> Scalar:
    """Coefficient of hat(phi)^2 in the inverse left Jacobian, from the squared angle.

    d(s) = (1 - (theta/2) cot(theta/2)) / theta^2 = (c3/2 - c4) / c2; d(0) = 1/12, d(pi^2) = 1/pi^2.

    **Arguments:** `s`: squared angle, (), rad^2, in [0, (2 pi)^2).

    **Returns:** d, (). Grows without bound towards theta = 2 pi, where the Jacobian itself is singular, and loses
    digits there: the relative error is about eps / (2 pi - theta)^2.

    Source: Bullo and Murray, Proportional derivative (PD) control on the Euclidean group (1995).
    """
    # c2 is positive up to the first zero at 2 pi, so the quotient needs no guard inside the domain.
    _, _, c2, c3, c4 = stumpff(s, 4)
    return (0.5 * c3 - c4) / c2


def angle_ratio(n2: Scalar, w: Scalar) -> Scalar:
    r"""Angle over sine of the half angle, from the parts of a quaternion.

    $$2 \operatorname{atan2}(\sqrt{n_2}, w) / \sqrt{n_2}$$

    **Arguments:** `n2`: squared norm of the vector part, (); `w`: scalar part, (), not negative. The two need not
    be normalised; both zero gives NaN.

    **Returns:** the factor, (), that turns the vector part into the rotation vector: $2 / w$ at n2 = 0, $\pi / \sqrt{n_2}$
    at w = 0.
    """
    # With t = tan(theta/2) the series of atan(t)/t leaves out t^(2 n_terms); second derivatives of the rotation
    # vector by the closed form lose eps / t, not more, because the factors v that go with them are small as well.
    switch, n_terms = (0.01, 8) if _is_double(n2) else (0.04, 5)
    small = n2 < switch * w * w
    w_small = jnp.where(small, w, 1.0)
    t2 = jnp.where(small, n2, 0.0) / (w_small * w_small)
    near = 2.0 * _polynomial(t2, [(-1.0) ** j / (2 * j + 1) for j in range(n_terms)]) / w_small
    n_large = jnp.sqrt(jnp.where(small, 1.0, n2))
    far = 2.0 * jnp.arctan2(n_large, jnp.where(small, 1.0, w)) / n_large
    return jnp.where(small, near, far)


def safe_sqrt(square: Array) -> Array:
    """Square root of numbers that are not negative, with a derivative of zero, in place of an infinite one, at zero."""
    # The inner `where` matters for derivatives: 0 times the infinite derivative of the root would be NaN.
    some = square > 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, jnp.ones_like(square))), jnp.zeros_like(square))


def compile_each(module: dict[str, Any]) -> None:
    """Make each public function in the namespace of a module one program outside of traces, and let it take lists of numbers.

    Within traces it is traced once for all calls of a shape, and written out where it is called.
    """

    def accepting(function):
        # Text is no argument of a program.
        takes_text = "sequence" in inspect.signature(function).parameters
        program = function if takes_text else jax.jit(function, inline=True)

        @functools.wraps(function)
        def call(*args, **options):
            return program(*map(_as_array, args), **{name: _as_array(x) for name, x in options.items()})

        return call

    module.update({name: accepting(module[name]) for name in module["__all__"]})


def _as_array(value):
    return jnp.asarray(value, float) if isinstance(value, (list, tuple)) else value
