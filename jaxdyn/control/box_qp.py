"""Small quadratic programs between bounds, by projected Newton steps, with the coordinates that end up at a bound.

Source: Bertsekas (1982), Projected Newton methods for optimization problems with simple constraints; Tassa, Mansard & Todorov
(2014), Control-limited differential dynamic programming, section III.B.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.constraints.rank import eps_of
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky

_STEPS = 40
# Armijo's constant and the factor between lengths are those of the program boxQP of Tassa, Mansard & Todorov (2014).
_ARMIJO = 0.1
_LENGTHS = tuple(0.6**i for i in range(12))


class BoxMinimum(NamedTuple):
    """The minimum x (n,), which entries are free (n,), and a Cholesky factor of H with ones in place of those at a bound."""

    x: Float[Array, " n"]
    free: Bool[Array, " n"]
    factor: Float[Array, "n n"]


def minimize_in_box(H: Float[Array, "n n"], g: Float[Array, " n"], lower: Array, upper: Array) -> BoxMinimum:
    """Minimise x.H x / 2 + g.x with lower <= x <= upper, for a positive definite H; NaN where it is not."""
    lengths = jnp.asarray(_LENGTHS, g.dtype)
    # Relative to the terms that cancel in an entry of the gradient, so that convergence does not depend on units.
    rounding = 16 * eps_of(g)

    def value(x):
        return 0.5 * jnp.sum(x * matmul(H, x)) + jnp.sum(g * x)

    def free_at(x):
        # By the conditions of Karush, Kuhn and Tucker an entry stays at its bound while the gradient pushes it outwards.
        slope = g + matmul(H, x)
        return slope, ~(((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0)))

    def factor_of(free):
        # Ones in place of entries at a bound keep the shape fixed while the set changes, and decouple them from the others.
        both = free[:, None] & free[None]
        return cholesky(jnp.where(both, H, jnp.eye(g.shape[0], dtype=H.dtype)))

    def improve(state):
        x, _, count = state
        slope, free = free_at(x)
        # With the decoupled factor a zero on the right-hand side gives entries at a bound a zero step.
        slope = jnp.where(free, slope, jnp.zeros_like(slope))
        step = -solve_cholesky(factor_of(free), slope)
        tried = jax.vmap(lambda length: jnp.clip(x + length * step, lower, upper))(lengths)
        # Armijo's condition for the clipped displacement y - x: the unclipped step may leave the box (Bertsekas 1982).
        enough = jax.vmap(lambda y: value(x) - value(y) >= -_ARMIJO * jnp.sum((y - x) * slope))(tried)
        best = jnp.argmax(enough)  # the longest step of those that do
        # `argmax` is 0, the longest step, where no entry is true: that case has to be refused explicitly.
        y = jnp.where(jnp.any(enough), tried[best], x)
        # The remaining gradient is rounding of the sums in it, or no step reduces the value any more.
        size = jnp.abs(g) + matmul(jnp.abs(H), jnp.abs(y))
        slope, free = free_at(y)
        ends = jnp.all(~free | (jnp.abs(slope) <= rounding * size)) | ~jnp.any(enough)
        # The Cholesky factor of an indefinite H is NaN: the loop then ends, and the caller sees NaN.
        return y, ~ends & jnp.isfinite(y).all(), count + 1

    def goes_on(state):
        return state[1] & (state[2] < _STEPS)

    start = jnp.clip(jnp.zeros_like(g), lower, upper)
    x = lax.while_loop(goes_on, improve, (start, jnp.asarray(True), 0))[0]
    # The factor in the loop belongs to the point before the last step, so it is computed again.
    free = free_at(x)[1]
    return BoxMinimum(x, free, factor_of(free))
