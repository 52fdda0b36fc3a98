"""Tendons linear in the joints' coordinates, and polynomial couplings of joints.

The length of such a tendon is l = sum_i c_i q_i over joints of one degree of freedom, so l and its rate are one row of
coefficients times q and v.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class TendonForce(eqx.Module):
    """Springs and dampers along tendons: tau = -rows^T (stiffness s + damping ldot), s the excess of l over `rest`.

    Within the interval `rest` (lower, upper) the spring is slack; a spring without slack has both equal.

    **Fields:** `q_index`, `v_index` (n,), indices of the joints' coordinates in q and v; `rows` (nt, n), the
    coefficients c (1 or m/rad); `stiffness` (N/m), `damping` (N s/m), (nt,); `rest` (nt, 2), m.
    """

    q_index: tuple[int, ...] = eqx.field(static=True)
    v_index: tuple[int, ...] = eqx.field(static=True)
    rows: Float[Array, "nt n"]
    stiffness: Float[Array, " nt"]
    damping: Float[Array, " nt"]
    rest: Float[Array, "nt 2"]

    def __call__(self, system: Any, q: Float[Array, " nq"], v: Float[Array, " nv"], t) -> Float[Array, " nv"]:
        rows, stiffness, damping, rest = (
            x.astype(q.dtype) for x in (self.rows, self.stiffness, self.damping, self.rest)
        )
        length = rows @ q[np.array(self.q_index)]
        place = np.array(self.v_index)
        # Zero inside the rest interval, signed distance to it outside.
        stretch = length - jnp.clip(length, rest[:, 0], rest[:, 1])
        force = -(stiffness * stretch + damping * (rows @ v[place]))
        # Each joint is listed once, so that `set` on zeros loses nothing.
        return jnp.zeros((system.nv,), q.dtype).at[place].set(force @ rows)


class PolynomialCoupling(eqx.Module):
    """Residual of l_1 - r_1 = sum_k c_k (l_2 - r_2)^k, (1,); l_1 and l_2 are linear in q.

    **Fields:** `index` (n,), indices in q; `first`, `second` (n,), the rows of l_1 and l_2; `references` (2,), r;
    `coefficients` (5,), c_0 to c_4.
    """

    index: tuple[int, ...] = eqx.field(static=True)
    first: Float[Array, " n"]
    second: Float[Array, " n"]
    references: Float[Array, "2"]
    coefficients: Float[Array, "5"]

    def __call__(self, q: Float[Array, " nq"], t) -> Float[Array, "1"]:
        chosen = q[np.array(self.index)]
        first, second, references, coefficients = (
            x.astype(q.dtype) for x in (self.first, self.second, self.references, self.coefficients)
        )
        x = jnp.sum(second * chosen) - references[1]
        value = coefficients[4]
        for k in (3, 2, 1, 0):  # Horner's rule: no powers, so no derivative of 0^0
            value = value * x + coefficients[k]
        return (jnp.sum(first * chosen) - references[0] - value)[None]
