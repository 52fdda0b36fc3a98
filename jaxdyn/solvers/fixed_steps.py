"""Steps of fixed length that say when they are too long, or too many, to be believed."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

ALLOWED = 0.1  # of how far positions, or velocities, come from where they started
_PASSED_OVER = ("frame", "work")  # constants of a step, and what nothing depends on


class Watched(diffrax.ConstantStepSize):
    """diffrax's fixed steps, with a sum of what each of them may be wrong by. A method that estimates no error is not watched.

    A method of order p estimates its error in a step by some e of h^k. The estimates of embedded methods, k = p, overrate it and
    are taken as they are. That of `RK4`, k = 3, overrates it too much; but if all moves at one rate and the step is d,
    of h, e^2/d goes with h^5 as the error does: for y' = i y it is 3.3 times that. The rounding of a step adds eps times the
    way from the start.

    **Arguments:** `order`, p.
    """

    order: int | None = eqx.field(static=True)

    def init(self, terms, t0, t1, y0: Any, dt0, args, func, error_order):
        """End of the first step; besides diffrax's state the start, sums of errors, and how far the motion came."""
        end, inner = super().init(terms, t0, t1, y0, dt0, args, func, error_order)
        start = jax.lax.stop_gradient({name: y for name, y in y0.items() if name not in _PASSED_OVER})
        none = {name: jnp.zeros((), y.dtype) for name, y in start.items()}
        return end, (inner, start, none, none)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order: Any, controller_state: Any):
        """The next step, and its error added to the sum."""
        inner, start, errors, ways = controller_state
        *step, inner, result = super().adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, inner)
        if y_error is not None:
            before, after, error = jax.lax.stop_gradient((y0, y1_candidate, y_error))
            order: Any = self.order
            power = (order + 1 - error_order) / (error_order - 1) if error_order < order else 0.0
            way = {name: _largest(after[name] - start[name]) for name in start}
            errors = {
                name: errors[name]
                + _lost(_largest(error[name]), _largest(after[name] - before[name]), way[name], power)
                for name in start
            }
            ways = {name: jnp.maximum(ways[name], way[name]) for name in start}
        return *step, (inner, start, errors, ways), result


def too_coarse(controller_state):
    """Whether a motion by `Watched` steps may be wrong by more than a tenth, ()."""
    _, _, errors, ways = controller_state
    # Below the root of eps, of what rests, all is rounding.
    least = {name: jnp.sqrt(jnp.finfo(way.dtype).eps) for name, way in ways.items()}
    return jnp.stack([errors[name] > ALLOWED * jnp.maximum(ways[name], least[name]) for name in ways]).any()


def _lost(error, step, way, power: float):
    """What a step may be wrong by."""
    if power:
        error = error * jnp.minimum(error / jnp.maximum(step, jnp.finfo(step.dtype).tiny), 1.0) ** power
    return error + jnp.where(step > 0, jnp.finfo(step.dtype).eps * way, jnp.zeros_like(way))


def _largest(x):
    return jnp.max(jnp.abs(x), initial=0.0)
