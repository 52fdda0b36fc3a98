"""Steps of fixed length that say when they are too long, or too many, to be believed."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

ALLOWED = 0.1  # of how far positions, or velocities, come from where they started
_PASSED_OVER = ("frame", "held", "work")  # constants of a step, and what nothing depends on


class Watched(diffrax.ConstantStepSize):
    """diffrax's fixed steps, with a sum of what each of them may be wrong by. A method that estimates no error is not watched.

    A method of order p estimates its error in a step by some e of h^k. The estimates of embedded methods, k = p, overrate it and
    are taken as they are. That of `RK4`, k = 3, overrates it too much; but if all moves at one rate and the step is d,
    of h, e^2/d goes with h^5 as the error does: for y' = i y it is 3.3 times that. The rounding of a step adds eps times the
    longest way from the start.

    **Arguments:** `order`, p.
    """

    order: int | None = eqx.field(static=True)

    def init(self, terms, t0, t1, y0: Any, dt0, args, func, error_order):
        """End of the first step; besides diffrax's state the start, sums of errors, and how far the motion came."""
        end, inner = super().init(terms, t0, t1, y0, dt0, args, func, error_order)
        start = jax.lax.stop_gradient(y0)
        return end, (inner, start, *no_sums(y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order: Any, controller_state: Any):
        """The next step, and its error added to the sum."""
        inner, start, errors, ways = controller_state
        *step, inner, result = super().adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, inner)
        if y_error is not None:
            order: Any = self.order
            errors, ways = watched(order, error_order, start, y0, y1_candidate, y_error, errors, ways)
        return *step, (inner, start, errors, ways), result


def no_sums(y):
    """The sums of `watched` before the first step."""
    rows = _rows(y)
    none = jnp.zeros(rows.shape[0], rows.dtype)
    return none, none


def watched(order, error_order, start, y0, y1, error, errors, ways):
    """The sums of what steps may be wrong by and of the longest way from the start, after one step more (see `Watched`)."""
    start, before, after, error = (jax.lax.stop_gradient(_rows(y)) for y in (start, y0, y1, error))
    # One reduction: for a pendulum it is as dear as its dynamics.
    sizes = jnp.max(jnp.abs(jnp.stack([error, after - before, after - start])), -1)
    error, moved, way = sizes[0], sizes[1], sizes[2]
    if error_order < order:
        share = jnp.minimum(error / jnp.maximum(moved, jnp.finfo(moved.dtype).tiny), 1.0)
        power = (order + 1 - error_order) / (error_order - 1)
        error = error * (share if power == 1 else share**power)
    ways = jnp.maximum(ways, way)
    return errors + error + jnp.where(moved > 0, jnp.finfo(way.dtype).eps * ways, jnp.zeros_like(ways)), ways


def too_coarse(sums):
    """Whether a motion by `Watched` steps may be wrong by more than a tenth, (); `sums` as of `watched`."""
    errors, ways = sums
    # Below the root of eps, of what rests, all is rounding.
    return (errors > ALLOWED * jnp.maximum(ways, jnp.sqrt(jnp.finfo(ways.dtype).eps))).any()


def _rows(y):
    """Entries of a state, a row for each name, filled up with zeros."""
    rows = [value.reshape(-1) for name, value in y.items() if name not in _PASSED_OVER]
    longest = max(row.size for row in rows)
    return jnp.stack([jnp.pad(row, (0, longest - row.size)) if row.size < longest else row for row in rows])
