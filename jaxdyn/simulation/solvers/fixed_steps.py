"""Steps of fixed length that say when they are too long, or too many, to be believed."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

ALLOWED = 0.1  # of how far positions, or velocities, come from where they started
_PASSED_OVER = ("frame", "held", "work")  # constants of a step, and what nothing depends on


class ErrorMonitoredSteps(diffrax.ConstantStepSize):
    """diffrax's fixed steps, with the sum of their error estimates. A method without an error estimate leaves the sum at zero.

    A method of order p estimates its error in a step by some e of h^k. The estimates of embedded methods, k = p, overrate it and
    are taken as they are. That of `RK4`, k = 3, overrates it too much; but if all moves at one rate and the step is d,
    of h, e^2/d goes with h^5 as the error does: for y' = i y it is 3.3 times that. The rounding of a step adds eps times the
    greatest distance of the state from its start.

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
        inner, start, errors, distances = controller_state
        *step, inner, result = super().adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, inner)
        if y_error is not None:
            order: Any = self.order
            errors, distances = accumulated(order, error_order, start, y0, y1_candidate, y_error, errors, distances)
        return *step, (inner, start, errors, distances), result


def no_sums(y):
    """The error sum and the distance of `accumulated` before the first step."""
    rows = _rows(y)
    none = jnp.zeros(rows.shape[0], rows.dtype)
    return none, none


def accumulated(order, error_order, start, y0, y1, error, errors, distances):
    """The sum of error estimates and the largest distance from the start after one more step (see `ErrorMonitoredSteps`)."""
    start, before, after, error = (jax.lax.stop_gradient(_rows(y)) for y in (start, y0, y1, error))
    # One reduction: for a pendulum it is as dear as its dynamics.
    sizes = jnp.max(jnp.abs(jnp.stack([error, after - before, after - start])), -1)
    error, moved, distance = sizes[0], sizes[1], sizes[2]
    if error_order < order:
        share = jnp.minimum(error / jnp.maximum(moved, jnp.finfo(moved.dtype).tiny), 1.0)
        power = (order + 1 - error_order) / (error_order - 1)
        error = error * (share if power == 1 else share**power)
    distances = jnp.maximum(distances, distance)
    return errors + error + jnp.where(
        moved > 0, jnp.finfo(distance.dtype).eps * distances, jnp.zeros_like(distances)
    ), distances


def too_coarse(sums):
    """Whether a motion by `ErrorMonitoredSteps` steps may be wrong by more than a tenth, (); `sums` as of `accumulated`."""
    errors, distances = sums
    # Below the root of eps, of what rests, all is rounding.
    return (errors > ALLOWED * jnp.maximum(distances, jnp.sqrt(jnp.finfo(distances.dtype).eps))).any()


def _rows(y):
    """Entries of a state, a row for each name, filled up with zeros."""
    rows = [value.reshape(-1) for name, value in y.items() if name not in _PASSED_OVER]
    longest = max(row.size for row in rows)
    return jnp.stack([jnp.pad(row, (0, longest - row.size)) if row.size < longest else row for row in rows])
