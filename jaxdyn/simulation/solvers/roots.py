"""Roots of guards, which fall through zero at an event: their location by the rule of Illinois, and their derivative."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

_MAX_SECANTS = 30  # points after which a root is bisected


class Bracket(NamedTuple):
    """Bracket of a root between `low`, where a function is positive, and `high`, where it is negative.

    Points between are chosen by the secant through the values at both ends. An end that is kept twice counts half (the rule of
    Illinois; Dowell & Jarratt 1971), so that the bracket shrinks from both sides. Values are of the size of one or less.
    """

    low: Array
    high: Array
    value_low: Array
    value_high: Array
    side: Array  # of the last point: 1 behind the root, -1 before it, 0 where there is none yet
    tries: Array

    @classmethod
    def begin(cls, low, high, value_low, value_high) -> "Bracket":
        """Bracket of two ends."""
        none = jnp.zeros((), jnp.int32)
        return cls(low, high, value_low, value_high, none, none)

    def narrow(self, x, value, before, behind) -> "Bracket":
        """Bracket after the value at x, which is `before` the root, `behind` it, or neither: then x is ignored."""
        side = jnp.where(behind, 1, jnp.where(before, -1, self.side)).astype(jnp.int32)
        again = side == self.side
        low, value_low = jnp.where(before, x, self.low), jnp.where(before, value, self.value_low)
        high, value_high = jnp.where(behind, x, self.high), jnp.where(behind, value, self.value_high)
        value_low = jnp.where(again & behind, value_low / 2, value_low)
        value_high = jnp.where(again & before, value_high / 2, value_high)
        return Bracket(low, high, value_low, value_high, side, self.tries + 1)

    def next(self):
        """Next point: by a secant where both ends are known by their values, else the middle."""
        eps = float(jnp.finfo(self.low.dtype).eps)
        # A value that was a root is near zero and does not guide the secant.
        guided = (self.value_low > 64 * eps) & (self.value_high < 0) & (self.tries < _MAX_SECANTS)
        difference = jnp.where(guided, self.value_high - self.value_low, 1.0)
        secant = self.high - self.value_high * (self.high - self.low) / difference
        # Rounding can carry the secant out of the bracket.
        return jnp.clip(jnp.where(guided, secant, (self.low + self.high) / 2), self.low, self.high)

    def is_narrow(self, size):
        """True if the root is known to the rounding of times and lengths of this size."""
        return (self.high - self.low) <= 4 * float(jnp.finfo(self.low.dtype).eps) * size


def delay(guard, rate, t, y) -> Any:
    """Delay of an event, (), s: zero, with its derivative.

    Where guard(t, y) is zero, a change of the guard by de moves the root by dt = -de/(de/dt), with de/dt along the motion, whose
    `rate` is dy/dt before the event.
    """
    fixed, value = lax.stop_gradient((t, y)), guard(t, y)
    _, guard_rate = jax.jvp(guard, fixed, (jnp.ones_like(t), lax.stop_gradient(rate)))
    is_regular = guard_rate != 0
    guard_rate = lax.stop_gradient(jnp.where(is_regular, guard_rate, jnp.ones_like(guard_rate)))
    # The value is zero up to rounding: only its derivative is used.
    return jnp.where(is_regular, (lax.stop_gradient(value) - value) / guard_rate, jnp.zeros_like(value))
