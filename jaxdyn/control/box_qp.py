"""Small quadratic programs between bounds, by an active-set method, with the coordinates that end up at a bound.

A minimum over the free coordinates, within the bounds, is followed by the release of one coordinate that its gradient pulls
off its bound. A released coordinate moves inwards at once, because all others that are free are off their bounds: every minimum
is strictly below the one before. No set of free coordinates occurs twice, so that the method ends, whatever the condition number.

Source: Nocedal & Wright (2006), Numerical optimization, sections 16.5 and 16.7; Tassa, Mansard & Todorov (2014), Control-limited
differential dynamic programming, section III.B, for the use of the free coordinates.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.constraints.rank import eps_of
from jaxdyn.lie.so3 import matmul
from jaxdyn.systems.mass_factor import cholesky, solve_cholesky

# Rounding errors, in the terms of a gradient, up to which it counts as zero. 16 are the most at condition numbers up to 1e10.
_ROUNDING = 1e3


class BoxMinimum(NamedTuple):
    """The minimum x (n,), which entries are free (n,), and a Cholesky factor of H with ones in place of those at a bound.

    `converged` (): whether x satisfies the optimality conditions to rounding.
    """

    x: Float[Array, " n"]
    free: Bool[Array, " n"]
    factor: Float[Array, "n n"]
    converged: Bool[Array, ""]


class _State(NamedTuple):
    x: Array
    free: Array
    at_minimum: Array  # whether x is the minimum over the free coordinates
    least: Array  # the value at the last such minimum
    futile: Array  # coordinates whose release did not reduce the value
    released: Array  # the coordinate released last
    goes_on: Array
    count: Array


def minimize_in_box(H: Float[Array, "n n"], g: Float[Array, " n"], lower: Array, upper: Array) -> BoxMinimum:
    """Minimise x.H x / 2 + g.x with lower <= x <= upper, for a positive definite H; not converged where it is not."""
    n = g.shape[0]
    diagonal = jnp.diagonal(H)
    # In practice 2 n steps or less. The bound only ends programs without a minimum.
    most = 100 + 20 * n

    def gradient(x):
        """The gradient, and the size of the terms that cancel in it, so that tolerances do not depend on units."""
        return g + matmul(H, x), jnp.abs(g) + matmul(jnp.abs(H), jnp.abs(x))

    def value(x):
        return jnp.sum(x * (0.5 * matmul(H, x) + g))

    def factor_of(free):
        # Ones in place of entries at a bound keep the shape fixed while the set changes, and decouple them from the others.
        both = free[:, None] & free[None]
        return cholesky(jnp.where(both, H, jnp.eye(n, dtype=H.dtype)))

    def pull(x, free, slope):
        """The gradient that pulls entries off their bounds, and zero where there is none (Karush, Kuhn & Tucker)."""
        wrong = ((slope < 0) & (x < upper)) | ((slope > 0) & (x > lower))
        return jnp.where(~free & wrong, jnp.abs(slope), jnp.zeros_like(slope))

    def free_step(x, free, slope):
        """The step to the minimum over the free coordinates, with one refinement."""
        factor = factor_of(free)
        # With the decoupled factor a zero on the right-hand side gives entries at a bound a zero step.
        step = -solve_cholesky(factor, jnp.where(free, slope, jnp.zeros_like(slope)))
        rest = g + matmul(H, x + step)
        return step - solve_cholesky(factor, jnp.where(free, rest, jnp.zeros_like(rest)))

    def improve(state: _State):
        x, free, at_minimum, least, futile, released, _, count = state
        slope, size = gradient(x)
        here = value(x)
        # Pulls close to rounding may be wrong: a release that does not reduce the value is not repeated until another one does.
        falls = here < least
        futile = jnp.where(at_minimum, (futile | released) & ~falls, futile)
        least = jnp.where(at_minimum, jnp.minimum(here, least), least)
        pulls = pull(x, free, slope)
        pulls = jnp.where(futile | (pulls <= 4 * eps_of(x) * size), jnp.zeros_like(pulls), pulls)
        # The largest reduction that a coordinate alone would bring.
        worst = jnp.argmax(pulls * pulls / jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
        release = at_minimum & (jnp.arange(n) == worst) & (pulls > 0)
        ends = at_minimum & ~jnp.any(release)
        free = free | release

        step = free_step(x, free, slope)
        bound = jnp.where(step < 0, lower, upper)
        moves = free & (step != 0)
        lengths = jnp.where(moves, (bound - x) / jnp.where(moves, step, jnp.ones_like(step)), jnp.inf)
        length = jnp.maximum(jnp.min(lengths), 0)
        is_whole = length >= 1
        # Where the step leaves the box it ends at the first bound, or with several bounds at once if that is lower still.
        first = jnp.where(lengths <= length, bound, jnp.clip(x + length * step, lower, upper))
        clipped = jnp.clip(x + step, lower, upper)
        y = jnp.where(is_whole | (value(clipped) < value(first)), clipped, first)
        bounded = free & ((y <= lower) | (y >= upper))
        after = _State(
            y,
            free & ~bounded,
            is_whole,
            least,
            futile,
            jnp.where(at_minimum, release, released),
            # The Cholesky factor of an indefinite H is NaN.
            jnp.isfinite(y).all(),
            count + 1,
        )
        return _State(
            *(jnp.where(ends, old, new) for old, new in zip(state[:6], after[:6], strict=True)),
            goes_on=~ends & after.goes_on,
            count=after.count,
        )

    start = jnp.clip(jnp.zeros_like(g), lower, upper)
    slope, _ = gradient(start)
    free = ~(((start <= lower) & (slope > 0)) | ((start >= upper) & (slope < 0)))
    none = jnp.zeros(n, bool)
    begin = _State(
        start, free, jnp.asarray(False), jnp.full((), jnp.inf, g.dtype), none, none, jnp.asarray(True), jnp.asarray(0)
    )
    x, free, *_ = lax.while_loop(lambda state: state.goes_on & (state.count < most), improve, begin)
    slope, size = gradient(x)
    left = jnp.where(free, jnp.abs(slope), pull(x, free, slope))
    is_optimal = jnp.all(left <= _ROUNDING * eps_of(x) * size) & jnp.all((x >= lower) & (x <= upper))
    # The factor in the loop belongs to the point before the last step, so it is computed again.
    factor = factor_of(free)
    return BoxMinimum(x, free, factor, is_optimal & jnp.isfinite(factor).all())
