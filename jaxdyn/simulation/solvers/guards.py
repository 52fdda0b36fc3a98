"""Guards, which fall below zero at an event: the search for their roots by steps, and the derivatives of the roots.

A step that ends where a guard is negative is repeated with a shorter length, until its end is the event: the root is bracketed by
the steps before and behind it. So the state at the event is that of a step of full order, and not of an interpolation. Guards are
evaluated at the end of every step, in its middle, and twice where a parabola through the points so far has its least value
(`look_within`). What is violated and satisfied again between these points is not seen.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import batch_alike

_MAX_SECANTS = 30  # points after which a root is bisected
# Powers of eps, of the size of a guard in the step: 1e-9 and 1e-6 in float64. Guards below the first are zero at the same event;
# a root below the second is one, and not an error of the dense output.
_SIMULTANEOUS, _REAL = 0.575, 0.383
SEARCH_STEPS = 40  # attempts to end a step at an event, of which a limit on steps leaves room for


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
    def begin(cls, high, value_low) -> "Bracket":
        """Bracket from zero."""
        none, zero = jnp.zeros((), jnp.int32), jnp.zeros_like(high)
        return cls(zero, high, value_low, zero, none, none)

    def narrow(self, x, value, before, behind) -> "Bracket":
        """Bracket after the value at x, which is `before` the root, `behind` it, or neither: then x is ignored."""
        side = jnp.where(behind, 1, jnp.where(before, -1, self.side)).astype(jnp.int32)
        again = side == self.side
        low, value_low = jnp.where(before, x, self.low), jnp.where(before, value, self.value_low)
        high, value_high = jnp.where(behind, x, self.high), jnp.where(behind, value, self.value_high)
        value_low = jnp.where(again & behind, value_low / 2, value_low)
        value_high = jnp.where(again & before, value_high / 2, value_high)
        return Bracket(low, high, value_low, value_high, side, self.tries + jnp.ones((), jnp.int32))

    def next(self, is_narrow):
        """Next point: by a secant where both ends are known by their values, else the middle; the end of a narrow bracket."""
        eps = float(jnp.finfo(self.low.dtype).eps)
        # A value that was a root is near zero and does not guide the secant.
        guided = (self.value_low > 64 * eps) & (self.value_high < 0) & (self.tries < _MAX_SECANTS)
        difference = jnp.where(guided, self.value_high - self.value_low, 1.0)
        secant = self.high - self.value_high * (self.high - self.low) / difference
        # Rounding can carry the secant out of the bracket.
        point = jnp.clip(jnp.where(guided, secant, (self.low + self.high) / 2), self.low, self.high)
        return jnp.where(is_narrow, self.high, point)


class Search(NamedTuple):
    """State of the guards (k,) of a run, and of the search for an event; lengths are those of steps."""

    values: Array  # of the state (k,)
    hit: Array  # guards (k,) at whose root the last step has ended
    locating: Array  # true while an event is bracketed
    bracket: Bracket
    scale: Array  # of the guards (k,), while an event is bracketed
    usual: Array  # length of steps that end at no event
    cuts: Array  # attempts that have not come to the next point of a fixed grid
    loose: Array  # true if steps go across the roots, and end behind them

    @classmethod
    def begin(cls, values, hit, length) -> "Search":
        """Search before the first step, with guards that end the run at its start."""
        no, zero = jnp.zeros((), bool), jnp.zeros_like(length)
        return cls(
            values, hit, no, Bracket.begin(zero, zero), jnp.ones_like(values), length, zero.astype(jnp.int32), no
        )


class Point(NamedTuple):
    """Guards and their levels (k,) at a fraction (), of a step."""

    fraction: Array
    values: Array
    levels: Array


def _minimum_of_parabola(left: Point, middle: Point, right: Point) -> Array:
    """Fraction of a step at which a guard is predicted to be least, of the guard that is then the lowest in its own size.

    By parabolas through three points; between the last two points where no guard has its least value within.
    """
    tiny = float(jnp.finfo(middle.values.dtype).tiny)
    before, after = middle.fraction - left.fraction, right.fraction - middle.fraction
    first, second = (middle.values - left.values) / before, (right.values - middle.values) / after
    curvature = (second - first) / (before + after)
    is_convex = curvature > tiny
    safe = jnp.where(is_convex, curvature, 1.0)
    # The vertex, from the middle of the first interval, where the slope is `first`.
    fraction = (left.fraction + middle.fraction) / 2 - first / (2 * safe)
    within = is_convex & (fraction > left.fraction) & (fraction < right.fraction)
    minimum = middle.values + (fraction - middle.fraction) * (first + (fraction - left.fraction) * safe)
    size = jnp.maximum(jnp.maximum(jnp.abs(left.values), jnp.abs(right.values)), tiny)
    minimum = jnp.where(within, minimum / size, jnp.ones_like(minimum) * 2)
    at = jnp.where(within & (minimum <= jnp.min(minimum)), fraction, right.fraction)
    return jnp.where(within.any(), jnp.min(at), (middle.fraction + right.fraction) / 2)


def look_within(guards: Callable, start: Point, end: Point) -> list[Point]:
    """Guards in the middle of a step, and twice near the least value that parabolas predict.

    guards(fraction) gives values and levels within the step. The depth of a passage that is not seen is of the order of 1e-3 of
    the range of the guard over the step.
    """

    def look(fraction):
        return Point(fraction, *guards(fraction))

    middle = look(jnp.asarray(0.5, start.fraction.dtype))
    one = look(_minimum_of_parabola(start, middle, end))
    is_left = one.fraction < middle.fraction

    def choose(a, b):
        return jax.tree.map(lambda a, b: jnp.where(is_left, a, b), a, b)

    # A point at the middle itself has no parabola of its own.
    apart = jnp.abs(one.fraction - middle.fraction) > 1e-3
    fraction = _minimum_of_parabola(choose(start, middle), one, choose(middle, end))
    return [middle, one, look(jnp.where(apart, fraction, 0.75))]


def search_root(
    search: Search, t0, t1, at_end, within, good, usual, rounding: float = 1.0
) -> tuple[Search, Array, Array, Array]:
    """Narrow the bracket of an event by an attempt whose error is `good`, or begin one.

    **Returns:** the search; whether the step is kept, and whether it ends at an event; the length of the next attempt.

    **Arguments:** `at_end`: guards and their levels (k,); `within`: points of the step between its ends; `usual`: length of the
    next step without event; `rounding`: share of its level that is the rounding of a guard. A guard that was within its level
    where the step begins, as of a contact that rests beside others, is violated below the level; others are below rounding.
    """
    values, levels = at_end[0], _strict(search, at_end[1], rounding)
    length, eps, strict = t1 - t0, float(jnp.finfo(values.dtype).eps), ~search.loose
    # Within its rounding level the sign of a guard is not known.
    violated = (values < -levels).any()
    # Within the step: it is cut at the first of the points first.
    first, at = jnp.ones_like(length), values
    for point in within:
        is_first = (point.values < -_strict(search, point.levels, rounding)).any() & (point.fraction < first)
        first, at = jnp.where(is_first, point.fraction, first), jnp.where(is_first, point.values, at)
    inside = good & ~search.locating & strict & (first < 1)
    crosses, violated = good & search.loose & violated, (violated & strict) | inside
    at = jnp.where(inside, at, values)
    level = jnp.maximum(levels, float(jnp.finfo(values.dtype).tiny))
    # Guards have units of their own: each is measured by its size at the ends of the step where the search begins.
    sizes = jnp.maximum(jnp.maximum(jnp.abs(search.values), jnp.abs(at)), level)
    scale = jnp.where(search.locating, search.scale, sizes)
    value = jnp.min(at / scale)
    # A step whose error is too large proves nothing about the guards at its end.
    begins = good & violated & ~search.locating
    fresh = Bracket.begin(length, jnp.min(search.values / scale).astype(length.dtype))
    bracket = jax.tree.map(lambda a, b: jnp.where(begins, a, b), fresh, search.bracket)
    before, point = good & ~violated & search.locating, jnp.where(inside, first * length, length)
    bracket = bracket.narrow(point, value.astype(length.dtype), before, good & violated)
    locating, width = (search.locating & good) | begins, bracket.high - bracket.low
    is_narrow = width <= 4 * eps * jnp.maximum(jnp.abs(t1), search.usual)
    # The root is known when a guard is zero, or when its time is, up to rounding. A zero within the step may have been an error
    # of the dense output: then the bracket closes on its end, before which no guard is negative. Attempts end at numbers of the
    # time, between which an end that was a fraction of a step may lie.
    is_closed = (width <= 0) | (t0 + bracket.high <= t1)
    is_known = (jnp.abs(value) <= 64 * eps) | (is_narrow & (violated | is_closed))
    # A zero within the step is not at the end of it, which is where a step can be cut.
    located = locating & is_known & ~inside
    kept = good & ((~violated & ~search.locating) | located)
    real = located & (value <= eps**_REAL)
    hit = real & ((values <= eps**_SIMULTANEOUS * scale) & (scale > 4 * level) | (values / scale <= value))
    # Attempts that locate an event are short for its sake: they say nothing about the usual length.
    usual = jnp.where(good & violated, length, usual)
    after = search._replace(
        values=jnp.where(kept, values, search.values),
        hit=hit | (crosses & (values < -levels)),
        locating=locating & ~located,
        bracket=bracket,
        scale=scale,
        usual=jnp.where(search.locating & good, search.usual, usual),
    )
    return after, kept, located, bracket.next(is_narrow)


def _strict(search: Search, levels, rounding: float):
    return jnp.where(search.values > levels, rounding * levels, levels)


def delay(guard: Callable, field: Callable, args, t, y) -> Any:
    """Delay of an event, (), s: zero, with its first and second derivatives.

    Where guard(args, t, y) is zero, a change of the guard by z moves the root by s with z + g' s + g'' s^2 / 2 = 0. The rates g'
    and g'' are those along the motion, whose rate is field(args, t, y) before the event.
    """
    return _delay((args, t, y), guard, field)


# The value needs no rates: runs that are not differentiated do not pay for them.
@eqx.filter_custom_jvp
def _delay(inputs, guard, field):
    return batch_alike(jnp.zeros_like(inputs[1]), inputs)


@_delay.def_jvp
def _(primals, tangents):
    inputs, guard, field = primals
    # The time of the event is that of the values: derivatives are those of the guard there.
    changes = tangents[0][0], None, tangents[0][2]
    _, change = eqx.filter_jvp(partial(_expand_delay, guard, field), (inputs,), (changes,))
    return _delay(*primals), change


def _expand_delay(guard: Callable, field: Callable, inputs) -> Array:
    """Expansion of the delay to second order at an event."""
    args, t, y = inputs

    def along(function, t, y):
        return jax.jvp(function, (t, y), (jnp.ones_like(t), field(args, t, y)))

    def rate(t, y):
        return along(partial(guard, args), t, y)[1]

    # In the second derivative of the delay the value of g'' is all that counts.
    first, second = rate(t, y), lax.stop_gradient(along(rate, t, y)[1])
    value = guard(args, t, y)
    change, is_regular = value - lax.stop_gradient(value), first != 0
    first = jnp.where(is_regular, first, jnp.ones_like(first))
    late = -change / first - second / (2 * first**3) * change**2
    return jnp.where(is_regular, late, jnp.zeros_like(late)).astype(t.dtype)
