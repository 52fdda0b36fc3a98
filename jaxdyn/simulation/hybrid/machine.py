"""The steps of a motion with modes: one attempt in every turn of a loop, by which each lane of a batch goes its own way.

A step that ends where a condition of the mode is violated is taken again, shorter, until its end is the event: the root is
bracketed by the steps before and behind it, and approached by the secant rule of Illinois. So the state at the event is that of
a step of full order, and not of an interpolation. Steps of fixed length are cut by events too, and go on to the points that they
would have met. Conditions are looked at in the middle and at the end of every step: what
is violated and satisfied again between them is not seen.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import cond, while_loop
from jaxdyn.simulation.hybrid.modes import CHANNELS, KINDS, Elements, Mode
from jaxdyn.simulation.hybrid.transitions import Change
from jaxdyn.simulation.solvers.driver import number_of_steps, save
from jaxdyn.simulation.solvers.explicit import Plan, projected_output, step_in_turn, whole_step
from jaxdyn.simulation.solvers.fixed_steps import accumulated, no_sums

_SAFETY, _LEAST, _MOST, _AFTER_EVENT = 0.9, 0.2, 10.0, 0.3
_SIMULTANEOUS, _REAL = 0.575, 0.383  # powers of eps, of the size of a condition in the step: 1e-9 and 1e-6 in float64
SEARCHED = 40  # attempts at most to end a step at an event
FINE, SHORT, PARADOX, NO_MODE, CROWDED = range(5)


class Records(NamedTuple):
    """What happened: a row for each event, of which the last one is for what is not kept. `name`: an index among
    `Elements.names`; `trigger`: the condition that fell to zero, -1 for what came with another event. Modes and directions of the
    impact and of what follows."""

    time: Array
    name: Array
    trigger: Array
    impact: Mode
    impact_slip: Array
    mode: Mode
    slip: Array


class Lane(NamedTuple):
    """Where a motion is, what it tries next, and the bracket of an event, in lengths of the step."""

    t: Array
    y: Array
    length: Array
    usual: Array
    mode: Mode
    conditions: Array
    locating: Array
    low: Array
    high: Array
    value_low: Array
    value_high: Array
    side: Array
    tries: Array
    scale: Array
    taken: Array
    kept: Array
    code: Array
    count: Array
    sums: tuple[Array, Array]  # about steps of fixed length (`accumulated`)
    loose: Array  # whether steps go across the zeros of switching functions, and pieces change where they end


class Steps(NamedTuple):
    """Steps of fixed length: from `start`, `length` apart."""

    start: Array
    length: Array

    def to_next(self, t):
        """The length of a step from t to the next of the points."""
        passed = jnp.floor((t - self.start) / self.length + 1e-3)
        return self.start + (passed + 1) * self.length - t


class Laws(NamedTuple):
    """The functions of a motion.

    `plan` of its steps; `judge(args, t, y)` -> conditions and their levels, of flat states: those of the elements by CHANNELS,
    then those of the switching functions (see `Elements.split`); `transit(unknown, t, y, mode, slip, hit)` -> `Change`;
    `land(unknown, mode, slip, t, y)`, the state after an impact; `order` of the method and `error_order` of its estimate;
    `slip(y)` (n, 2) of a flat state, and `placed(y, v, slip)`, the flat state with these.
    """

    plan: Plan
    elements: Elements
    judge: Any
    transit: Any
    land: Any
    order: Any
    error_order: Any
    slip: Any
    placed: Any


def attempt(laws: Laws, args, t0, t1, y, rtol, atol):
    """A step, the size of its error, and the conditions and levels at its end and in its middle."""
    rate = laws.plan.field_of(args, t0, y) if laws.plan.passes_rate_on else jnp.zeros_like(y)
    return _looked_at(laws, args, t0, t1, y, whole_step(laws.plan, args, t0, t1, y, rate), rtol, atol)


def attempt_in_turn(laws: Laws, args, t0, t1, y, rtol, atol):
    """The same, one stage after the other."""
    rate = laws.plan.field_of(args, t0, y) if laws.plan.passes_rate_on else jnp.zeros_like(y)
    return _looked_at(laws, args, t0, t1, y, step_in_turn(laws.plan, args, t0, t1, y, rate), rtol, atol)


def _looked_at(laws: Laws, args, t0, t1, y, step, rtol, atol):
    scaled = step.error / (atol + rtol * jnp.maximum(jnp.abs(y), jnp.abs(step.projected)))
    size = jnp.sqrt(jnp.mean(scaled * scaled))
    middle = (t0 + t1) / 2
    between = projected_output(laws.plan, None, middle, t0, t1, y, step.raw, step.stages, step.shift)
    return step, size, laws.judge(args, t1, step.projected), laws.judge(args, middle, between)


def _attempted(laws: Laws, *given):
    return kernel(attempt, static=1, fallback=attempt_in_turn, derivative=False)(laws, *given)


def blank(elements: Elements, dtype, most: int) -> Records:
    """Before anything happened."""
    n, none = len(elements.each), jnp.zeros((most + 1,), jnp.int32)
    flags = jnp.zeros((most + 1, n), bool)
    mode = Mode(flags, flags, flags, jnp.zeros((most + 1, elements.switches), bool))
    slip = jnp.zeros((most + 1, n, 2), dtype)
    return Records(jnp.full((most + 1,), jnp.nan, dtype), none - 1, none - 1, mode, slip, mode, slip)


def drive(laws: Laws, unknown, ts, y0, mode, slip, rtol, atol, stepsize, max_steps: int, most: int):
    """Rows of the state at ts[1:], the lane at its end, the records, and the change by which it began.

    `y0` (m,), flat; `mode`, `slip` (n, 2): a first guess; `stepsize` (s), or None for adaptive steps. `most`: events.
    """
    start, end, count = ts[0], ts[-1], ts.shape[0] - 1
    eps, dtype, n = float(jnp.finfo(ts.dtype).eps), y0.dtype, len(laws.elements.each)
    none, no = jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    hit = jnp.zeros((n * CHANNELS + laws.elements.switches,), bool)
    begun: Change = laws.transit(unknown, start, y0, mode, slip, hit)
    y = laws.placed(y0, begun.v, begun.slip)
    conditions, _ = kernel(judged, static=1)(laws, (unknown, begun.mode), start, y)
    code = jnp.where(begun.paradox, PARADOX, jnp.where(begun.settled, FINE, NO_MODE)).astype(jnp.int32)
    zero = jnp.zeros((), ts.dtype)
    first, steps = 1e-4 * (end - start), None
    if stepsize is not None:
        first = (end - start) / number_of_steps(start, end, stepsize).astype(ts.dtype)
        steps = Steps(start, first)
    lane = Lane(
        start, y, first, first, begun.mode, conditions, no, zero, zero, zero, zero, none, none,
        jnp.ones_like(conditions), none, none, code, none, no_sums(_moving(laws, y)), no,
    )  # fmt: skip
    origin = y
    rows = jnp.broadcast_to(jnp.full_like(y, jnp.inf), (count, y.size))

    def is_active(lane: Lane):
        return (lane.t < end) & (lane.code == FINE) & (lane.taken < max_steps)

    def body(carry):
        lane, saved, rows, records = carry
        active = is_active(lane)
        t1 = jnp.where(active, jnp.minimum(lane.t + lane.length, end), lane.t)
        args = unknown, lane.mode
        attempt = _attempted(laws, args, lane.t, t1, lane.y, rtol, atol)
        after, kept, hit = _decided(laws, lane, t1, end, attempt, eps, steps)
        if steps is not None:
            after = _monitored(laws, origin, lane, after, kept, attempt[0])
        if laws.elements.switches:
            after = _across(laws.elements, after)
        after = jax.tree.map(lambda a, b: jnp.where(active, a, b), after, lane)
        kept, hit = kept & active, hit & active & kept
        saved, rows = save(laws.plan, ts, lane, after, kept, attempt[0], saved, rows)
        happens = hit.any()
        after, records = cond(
            happens,
            lambda after, records: _crossed(laws, unknown, after, records, hit, happens, most, steps),
            lambda after, records: (after, records),
            after,
            records,
        )
        return after, saved, rows, records

    carry = lane, none, rows, blank(laws.elements, dtype, most)
    lane, _, rows, records = while_loop(lambda carry: is_active(carry[0]), body, carry)
    return rows, lane, records, begun


def _moving(laws: Laws, y) -> dict[str, Array]:
    """What moves of a flat state: not the directions of sliding."""
    return {name: part for name, part in laws.plan.structure(y).items() if name != "slip"}


def _monitored(laws: Laws, origin, lane: Lane, after: Lane, kept, step) -> Lane:
    """With what the error of a kept step adds to the sum."""
    start, before, y, error = (_moving(laws, x) for x in (origin, lane.y, step.projected, step.error))
    sums = accumulated(laws.order, laws.error_order, start, before, y, error, *lane.sums)
    return after._replace(sums=jax.tree.map(lambda new, old: jnp.where(kept, new, old), sums, lane.sums))


def _across(elements: Elements, lane: Lane) -> Lane:
    """The lane in the pieces where its last step has ended, where steps go across the zeros of switching functions."""
    first, switching = elements.split(lane.conditions)
    crossed = lane.loose & (switching < 0)
    conditions = jnp.concatenate([first.reshape(-1), jnp.where(crossed, -switching, switching)])
    return lane._replace(mode=lane.mode._replace(positive=lane.mode.positive ^ crossed), conditions=conditions)


@kernel(static=1)
def _put_back(laws: Laws, args, t, y):
    """A state on the rows that act."""
    return laws.plan.ended(args, t, y, jnp.zeros_like(y))[0]


def judged(laws: Laws, args, t, y):
    """Conditions and levels."""
    return laws.judge(args, t, y)


def _decided(laws: Laws, lane: Lane, t1, end, attempt, eps: float, steps: Steps | None) -> tuple[Lane, Array, Array]:
    """The lane after an attempt, whether the step is kept, and which conditions ended it."""
    step, size, (values, levels), (between, levels_between) = attempt
    length = t1 - lane.t
    good = size < 1 if steps is None else jnp.isfinite(step.projected).all()
    factor = _SAFETY * (1 / size) ** (1 / laws.error_order)
    factor = jnp.where(jnp.isnan(factor), _LEAST, factor)
    factor = jnp.clip(factor, jnp.where(good, 1.0, _LEAST), jnp.where(good, _MOST, _SAFETY)).astype(length.dtype)

    violated = (values < -levels).any() & ~lane.loose
    # In the middle alone: the step is halved first.
    inside = good & ~lane.locating & ~lane.loose & (between < -levels_between).any()
    violated = violated | inside
    at = jnp.where(inside, between, values)
    high = jnp.where(inside, length / 2, length)
    level = jnp.maximum(levels, float(jnp.finfo(values.dtype).tiny))
    scale = jnp.where(lane.locating, lane.scale, jnp.maximum(jnp.maximum(jnp.abs(lane.conditions), jnp.abs(at)), level))
    value = jnp.min(at / scale)
    first_value = jnp.min(lane.conditions / scale)

    begins = good & violated & ~lane.locating
    low = jnp.where(begins, 0.0, lane.low)
    value_low = jnp.where(begins, first_value, lane.value_low)
    # What was a root is near zero and does not guide the secant.
    behind, before = good & violated, good & ~violated & lane.locating
    low = jnp.where(before, high, low)
    value_low = jnp.where(before, value, value_low)
    high_ = jnp.where(behind, high, lane.high)
    value_high = jnp.where(behind, value, lane.value_high)
    side = jnp.where(behind, 1, jnp.where(before, -1, lane.side)).astype(jnp.int32)
    again = lane.locating & (side == lane.side)
    value_low = jnp.where(again & behind, value_low / 2, value_low)
    value_high = jnp.where(again & before, value_high / 2, value_high)

    locating = (lane.locating & good) | begins
    near = jnp.abs(value) <= 64 * eps
    narrow = (high_ - low) <= 4 * eps * jnp.maximum(jnp.abs(t1), lane.usual)
    located = locating & (near | narrow) & ~inside
    kept = good & ((~violated & ~lane.locating) | located)
    # What the middle of a step showed may have been an error of the dense output.
    real = located & (value <= eps**_REAL)
    hit = real & ((values <= eps**_SIMULTANEOUS * scale) & (scale > 4 * level) | (values / scale <= value))

    guided = (value_low > 64 * eps) & (value_high < 0) & (lane.tries < 30)
    slope = jnp.where(guided, value_high - value_low, 1.0)
    secant = jnp.where(guided, high_ - value_high * (high_ - low) / slope, (low + high_) / 2)
    secant = jnp.clip(secant, low, high_)
    usual = jnp.where(lane.locating, lane.usual, jnp.where(good & ~violated, length * factor, length))
    usual = jnp.where(good, usual, length * factor)
    next_length = jnp.where(locating, secant, usual)
    next_length = jnp.where(located, _AFTER_EVENT * usual, next_length)
    least = 4 * eps * jnp.maximum(jnp.abs(lane.t), eps)
    short = ~good & (next_length < least)
    if steps is not None:
        short, usual = ~good, lane.usual
        to_next = steps.to_next(jnp.where(kept, t1, lane.t))
        next_length = jnp.where(locating & ~located, secant, to_next)
    pivots = laws.elements.split(lane.conditions)[0][:, 2]
    pivot = jnp.min(pivots, initial=1.0) < 0.05  # friction that leaves no forces grows without bound before
    code = jnp.where(short, jnp.where(pivot, PARADOX, SHORT), lane.code).astype(jnp.int32)
    # Steps end on the run's end, or well before it.
    t = jnp.where(kept, t1, lane.t)
    ends = ~locating & (t + next_length > end - 1e-3 * next_length)
    next_length = jnp.where(ends & (t < end), end - t, next_length)
    one = jnp.ones((), jnp.int32)
    return (
        Lane(
            t, jnp.where(kept, step.projected, lane.y), next_length, usual, lane.mode,
            jnp.where(kept, values, lane.conditions), locating & ~located, low, high_, value_low, value_high, side,
            jnp.where(locating & ~located, lane.tries + one, 0), scale, lane.taken + one, lane.kept + kept.astype(jnp.int32),
            code, lane.count, lane.sums, lane.loose,
        ),
        kept,
        hit,
    )  # fmt: skip


def _crossed(laws: Laws, unknown, lane: Lane, records: Records, hit, happens, most: int, steps: Steps | None):
    """The lane in the mode behind an event, and the records with it."""
    elements = laws.elements
    change: Change = laws.transit(unknown, lane.t, lane.y, lane.mode, laws.slip(lane.y), hit)
    before, mode = lane.mode, change.mode
    y = laws.placed(lane.y, change.v, change.slip)
    if elements.each:
        # A gap is closed where it has fallen below zero by its level, which the first step behind would count as its error.
        y = _put_back(laws, (unknown, mode), lane.t, y)
    conditions, _ = kernel(judged, static=1)(laws, (unknown, mode), lane.t, y)
    hit, switched = elements.split(hit)
    opened = hit.any(1)
    kind = jnp.where(mode.stick & ~before.stick, 2, jnp.where(before.stick & ~mode.stick, 3, 4))
    # A contact that is hit may let go at once.
    hits = (mode.closed | hit[:, 0]) & ~before.closed
    kind = jnp.where(hits, 0, jnp.where(before.closed & ~mode.closed, 1, kind))
    differs = (mode.closed != before.closed) | (mode.stick != before.stick) | (mode.negative != before.negative)
    told = happens & (opened | differs)
    lost = hit[:, 2].any()  # of pivots: no mode follows
    leading = jnp.argmax(hit.reshape(-1)).astype(jnp.int32) if elements.each else jnp.zeros((), jnp.int32)
    rows, count = records, lane.count
    if elements.switches:
        rows, count = _switched(elements, lane, records, switched & happens, change.slip, most)
    order = [(i, True) for i in range(len(elements.each))] + [(i, False) for i in range(len(elements.each))]
    for i, by_trigger in order:
        # First the one whose condition it was, which carries the impact; then what came with it.
        mine = told[i] & ((hit.any() & (leading // CHANNELS == i)) == by_trigger)
        place = jnp.where(mine & (count < most), count, most)
        row = Records(
            lane.t,
            (i * len(KINDS) + kind[i]).astype(jnp.int32),
            jnp.where(by_trigger, leading, -1).astype(jnp.int32),
            jax.tree.map(lambda a, b, by=by_trigger: a if by else b, change.impact, mode),
            change.impact_slip if by_trigger else change.slip,
            mode,
            change.slip,
        )
        rows = jax.tree.map(lambda all_, one, at=place: all_.at[at].set(one), rows, row)
        count = count + mine.astype(jnp.int32)
    crowded = count > most
    code = jnp.where(change.settled, FINE, NO_MODE)
    # Of switching functions alone, a motion without room for its events goes on: it loses its derivatives.
    code = jnp.where(crowded & bool(elements.each), CROWDED, code)
    code = jnp.where(change.paradox | lost, PARADOX, code)
    loose = jnp.zeros((), bool)
    if elements.switches:
        is_held = _changes_back(elements, lane, records, switched, most)
        # Steps of fixed length go on about it.
        loose = is_held & bool(steps is not None and not elements.each)
        code = jnp.where(is_held & ~loose, CROWDED, code)
        count = jnp.where(loose, most + 1, count)
    code = code.astype(jnp.int32)
    after = lane._replace(y=y, mode=mode, conditions=conditions, count=count, code=code, loose=lane.loose | loose)
    return jax.tree.map(lambda a, b: jnp.where(happens, a, b), (after, rows), (lane, records))


def _switched(elements: Elements, lane: Lane, records: Records, switched, slip, most: int):
    """The records with a row for each switching function that changed its sign, one after the other, and their number."""
    index = jnp.cumsum(switched, dtype=jnp.int32) - 1
    places = jnp.where(switched, jnp.minimum(lane.count + index, most), most)
    # Each row has changed what stands in the rows before it and its own.
    earlier = switched[None] & (index[None] <= index[:, None])
    k, first = elements.switches, len(elements.each)
    number = jnp.arange(k, dtype=jnp.int32)
    modes, slip = jax.tree.map(lambda x: jnp.broadcast_to(x, (k, *x.shape)), (lane.mode, slip))
    modes = modes._replace(positive=modes.positive ^ earlier)
    rows = Records(
        jnp.broadcast_to(lane.t, (k,)), first * len(KINDS) + number, first * CHANNELS + number, modes, slip, modes, slip
    )  # fmt: skip
    rows = jax.tree.map(lambda all_, new: all_.at[places].set(new.astype(all_.dtype)), records, rows)
    return rows, lane.count + jnp.sum(switched, dtype=jnp.int32)


def _changes_back(elements: Elements, lane: Lane, records: Records, switched, most: int):
    """Whether a switching function changes back at once: on both sides of its zero the force drives the motion onto it."""
    last = jnp.maximum(jnp.minimum(lane.count, most) - 1, 0)
    names = jnp.arange(elements.switches, dtype=jnp.int32) + len(elements.each) * len(KINDS)
    least = 64 * float(jnp.finfo(lane.t.dtype).eps) * jnp.maximum(jnp.abs(lane.t), lane.usual)
    return ((names == records.name[last]) & switched).any() & (lane.t - records.time[last] <= least)
