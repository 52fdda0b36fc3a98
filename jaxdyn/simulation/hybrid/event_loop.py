"""Event loop of a hybrid system: one attempt to make a step an iteration, independently for every trajectory of a batch.

A step that ends where a guard is negative is repeated with a shorter length, until its end is the event: the root is bracketed by
the steps before and behind it, and approached by the secant rule of Illinois. So the state at the event is that of a step of full
order, and not of an interpolation. Events also cut steps of fixed length, and the next step ends where the cut one would have
ended. Guards are evaluated in the middle and at the end of every step: what is violated and satisfied again between them is not
seen.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import cond, while_loop
from jaxdyn.simulation.hybrid.modes import CHANNELS, Elements, Mode
from jaxdyn.simulation.hybrid.records import Records, chatters, no_records, record_elements, record_switches
from jaxdyn.simulation.hybrid.system import HybridSystem
from jaxdyn.simulation.hybrid.transitions import Transition
from jaxdyn.simulation.solvers.driver import number_of_steps, save
from jaxdyn.simulation.solvers.explicit import Plan, Step, dense_output, take_step
from jaxdyn.simulation.solvers.roots import Bracket
from jaxdyn.simulation.solvers.step_control import add_error, error_size, no_sums, step_factor

# Length of the first step after an event, in steps before it: the motion may be another one.
_AFTER_EVENT = 0.3
# Powers of eps, of the size of a guard in the step: 1e-9 and 1e-6 in float64. Guards below the first are zero at the same event;
# a root below the second is one, and not an error of the dense output.
_SIMULTANEOUS, _REAL = 0.575, 0.383
SEARCH_STEPS = 40  # attempts at most to end a step at an event
FINE, SHORT, PARADOX, NO_MODE, CROWDED = range(5)


class RunState(NamedTuple):
    """State of a run: the motion, the next attempt, and the bracket of an event."""

    t: Array
    y: Array
    length: Array  # of the next attempt
    usual: Array  # length of steps that end at no event
    mode: Mode
    guards: Array
    locating: Array  # true while an event is bracketed
    bracket: Bracket  # in lengths of the step
    scale: Array  # of the guards, while an event is bracketed
    tried: Array  # steps
    accepted: Array  # steps
    code: Array
    count: Array  # events
    sums: tuple[Array, Array]  # about steps of fixed length (`add_error`)
    loose: Array  # true if steps go across the zeros of switching functions, and pieces change where the steps end


class FixedGrid(NamedTuple):
    """Grid of steps of fixed length: from `start`, `length` apart."""

    start: Array
    length: Array

    def to_next(self, t):
        """Length of a step from t to the next point of the grid."""
        # A point of the grid nearer than a thousandth of a step has been reached up to rounding.
        passed = jnp.floor((t - self.start) / self.length + 1e-3)
        return self.start + (passed + 1) * self.length - t


class Attempt(NamedTuple):
    """A step, the size of its error, and guards with their rounding levels at its end and in its middle."""

    step: Step
    size: Array
    values: Array
    levels: Array
    middle: Array
    middle_levels: Array


def _attempt(plan: Plan, system: HybridSystem, args, t0, t1, y, rtol, atol) -> Attempt:
    step = take_step(plan, args, t0, t1, y, plan.first_rate(args, t0, y))
    size = error_size(optimistix.rms_norm, y, step.projected, step.error, rtol, atol)
    middle = (t0 + t1) / 2
    # The dense output only finds that a guard was negative: the event is located by steps of its own.
    between = dense_output(plan, None, middle, t0, t1, y, step.raw, step.stages, step.shift)
    return Attempt(step, size, *system.guards(args, t1, step.projected), *system.guards(args, middle, between))


_attempt_by_kernel: Any = kernel(_attempt, static=2, fallback=_attempt, derivative=False)


@kernel(static=1)
def guard_values(system: HybridSystem, args, t, y):
    """Guards and levels."""
    return system.guards(args, t, y)


@kernel(static=1)
def _project(system: HybridSystem, args, t, y):
    """State projected onto the rows that act."""
    return system.plan.project_end(args, t, y, jnp.zeros_like(y))[0]


def run_events(system: HybridSystem, unknown, ts, y0, mode, rtol, atol, stepsize, max_steps: int, most: int):
    """Rows of the state at ts[1:], the state at the end, the records, and the transition at the start.

    `y0` (m,), flat, and `mode`: a first guess; `stepsize` (s), or None for adaptive steps. `most`: number of events.
    """
    end, count, elements = ts[-1], ts.shape[0] - 1, system.elements
    eps, n = float(jnp.finfo(ts.dtype).eps), len(elements.each)
    hit = jnp.zeros((n * CHANNELS + elements.switches,), bool)
    # The start may be an impact, or its mode may not hold: it passes a transition before the first step.
    begun = system.reset(unknown, ts[0], y0, mode, system.slip(y0), hit)
    # A short first step: the control may enlarge it tenfold with each one that is kept.
    first, grid = 1e-4 * (end - ts[0]), None
    if stepsize is not None:
        first = (end - ts[0]) / number_of_steps(ts[0], end, stepsize).astype(ts.dtype)
        # One grid for the whole run: steps that an event has cut return to it.
        grid = FixedGrid(ts[0], first)
    run = _start(system, unknown, ts[0], y0, begun, first)
    origin = run.y
    # What is not reached stays infinite, which tells it from rows that are computed.
    rows = jnp.broadcast_to(jnp.full_like(origin, jnp.inf), (count, origin.size))

    def is_active(run: RunState):
        return (run.t < end) & (run.code == FINE) & (run.tried < max_steps)

    def body(carry):
        run, saved, rows, records = carry
        active = is_active(run)
        # Trajectories that have ended make steps of no length until the last one of the batch has ended.
        t1 = jnp.where(active, jnp.minimum(run.t + run.length, end), run.t)
        attempt = _attempt_by_kernel(system.plan, system, (unknown, run.mode), run.t, t1, run.y, rtol, atol)
        after, kept, hit = _decide(system, run, t1, end, attempt, eps, grid)
        if grid is not None:
            after = _add_errors(system, origin, run, after, kept, attempt.step)
        if elements.switches:
            after = _cross_loosely(elements, after)
        after = jax.tree.map(lambda a, b: jnp.where(active, a, b), after, run)
        # A trajectory that has ended still iterates with its batch: it must write no rows and no events.
        kept, hit = kept & active, hit & active & kept
        saved, rows = save(system.plan, ts, run, after, kept, attempt.step, saved, rows)
        happens = hit.any()
        # Most steps end at no event, and skip the transition.
        after, records = cond(
            happens,
            lambda after, records: _pass_event(system, unknown, after, records, hit, happens, most, grid),
            lambda after, records: (after, records),
            after,
            records,
        )
        return after, saved, rows, records

    carry = run, jnp.zeros((), jnp.int32), rows, no_records(elements, y0.dtype, most)
    run, _, rows, records = while_loop(lambda carry: is_active(carry[0]), body, carry)
    return rows, run, records, begun


def _start(system: HybridSystem, unknown, t0, y0, begun: Transition, length) -> RunState:
    """State of a run at its start, behind the transition `begun`."""
    y = system.with_slip(y0, begun.v, begun.slip)
    guards, _ = guard_values(system, (unknown, begun.mode), t0, y)
    code = jnp.where(begun.paradox, PARADOX, jnp.where(begun.settled, FINE, NO_MODE)).astype(jnp.int32)
    none, no, zero = jnp.zeros((), jnp.int32), jnp.zeros((), bool), jnp.zeros((), t0.dtype)
    return RunState(
        t0, y, length, length, begun.mode, guards, no, Bracket.begin(zero, zero, zero, zero),
        jnp.ones_like(guards), none, none, code, none, no_sums(_positions_and_velocities(system, y)), no,
    )  # fmt: skip


def _positions_and_velocities(system: HybridSystem, y) -> dict[str, Array]:
    """Entries of a flat state without the directions of sliding."""
    return {name: part for name, part in system.plan.structure(y).items() if name != "slip"}


def _add_errors(system: HybridSystem, origin, run: RunState, after: RunState, kept, step: Step) -> RunState:
    """Add the error of a kept step to the sum."""
    start, before, y, error = (
        _positions_and_velocities(system, x) for x in (origin, run.y, step.projected, step.error)
    )
    sums = add_error(system.order, system.error_order, start, before, y, error, *run.sums)
    return after._replace(sums=jax.tree.map(lambda new, old: jnp.where(kept, new, old), sums, run.sums))


def _cross_loosely(elements: Elements, run: RunState) -> RunState:
    """Take the pieces at the end of the last step, if steps go across the zeros of switching functions."""
    first, switching = elements.split(run.guards)
    crossed = run.loose & (switching < 0)
    # Guards have the sign of their piece: with the piece the sign changes, and the guard is positive again.
    guards = jnp.concatenate([first.reshape(-1), jnp.where(crossed, -switching, switching)])
    return run._replace(mode=run.mode._replace(positive=run.mode.positive ^ crossed), guards=guards)


class _Search(NamedTuple):
    """Search for an event after an attempt, and what it says of the attempt."""

    bracket: Bracket
    scale: Array
    violated: Array  # true if a guard is negative
    locating: Array  # true while the event is bracketed
    located: Array  # true if the attempt ends at the event
    kept: Array
    hit: Array  # guards that ended the step


def _search(run: RunState, t1, attempt: Attempt, good, eps: float) -> _Search:
    """Narrow the bracket of an event by an attempt whose error is `good`, or begin one."""
    length, (values, levels) = t1 - run.t, (attempt.values, attempt.levels)
    # Within its rounding level the sign of a guard is not known.
    violated = (values < -levels).any() & ~run.loose
    # In the middle alone: the step is halved first.
    inside = good & ~run.locating & ~run.loose & (attempt.middle < -attempt.middle_levels).any()
    violated = violated | inside
    at = jnp.where(inside, attempt.middle, values)
    level = jnp.maximum(levels, float(jnp.finfo(values.dtype).tiny))
    # Guards have units of their own: each is measured by its size at the ends of the step where the search begins.
    scale = jnp.where(run.locating, run.scale, jnp.maximum(jnp.maximum(jnp.abs(run.guards), jnp.abs(at)), level))
    value = jnp.min(at / scale)
    # A step whose error is too large proves nothing about the guards at its end.
    begins = good & violated & ~run.locating
    fresh = Bracket.begin(jnp.zeros_like(length), run.bracket.high, jnp.min(run.guards / scale), run.bracket.value_high)
    bracket = jax.tree.map(lambda a, b: jnp.where(begins, a, b), fresh, run.bracket)
    point = jnp.where(inside, length / 2, length)
    bracket = bracket.narrow(point, value, good & ~violated & run.locating, good & violated)
    locating = (run.locating & good) | begins
    # The root is known when a guard is zero, or when its time is, up to rounding.
    is_known = (jnp.abs(value) <= 64 * eps) | bracket.is_narrow(jnp.maximum(jnp.abs(t1), run.usual))
    # A zero in the middle is not at the end of this step, which is where a step can be cut.
    located = locating & is_known & ~inside
    kept = good & ((~violated & ~run.locating) | located)
    # A zero in the middle of a step may have been an error of the dense output.
    real = located & (value <= eps**_REAL)
    hit = real & ((values <= eps**_SIMULTANEOUS * scale) & (scale > 4 * level) | (values / scale <= value))
    return _Search(bracket, scale, violated, locating, located, kept, hit)


def _decide(system: HybridSystem, run: RunState, t1, end, attempt: Attempt, eps: float, grid: FixedGrid | None):
    """State after an attempt, whether the step is kept, and the guards that ended it."""
    length = t1 - run.t
    # False for an error of NaN, so that a step to a state that is not finite is refused.
    good = attempt.size < 1 if grid is None else jnp.isfinite(attempt.step.projected).all()
    factor = step_factor(attempt.size, system.error_order, good).astype(length.dtype)
    found = _search(run, t1, attempt, good, eps)
    # Attempts that locate an event are short for its sake: they say nothing about the usual length.
    usual = jnp.where(run.locating, run.usual, jnp.where(good & ~found.violated, length * factor, length))
    usual = jnp.where(good, usual, length * factor)
    next_length = jnp.where(found.locating, found.bracket.next(), usual)
    next_length = jnp.where(found.located, _AFTER_EVENT * usual, next_length)
    # The spacing of floating-point numbers at t: shorter steps would not advance.
    least = 4 * eps * jnp.maximum(jnp.abs(run.t), eps)
    short = ~good & (next_length < least)
    searches, t = found.locating & ~found.located, jnp.where(found.kept, t1, run.t)
    # Steps of fixed length have no error to keep: they fail where the state is not finite.
    if grid is not None:
        short, usual = ~good, run.usual
        next_length = jnp.where(searches, found.bracket.next(), grid.to_next(t))
    pivots = system.elements.split(run.guards)[0][:, 2]
    pivot = jnp.min(pivots, initial=1.0) < 0.05  # friction that leaves no forces grows without bound before
    code = jnp.where(short, jnp.where(pivot, PARADOX, SHORT), run.code).astype(jnp.int32)
    # Steps end on the run's end, or well before it.
    ends = ~found.locating & (t + next_length > end - 1e-3 * next_length)
    next_length = jnp.where(ends & (t < end), end - t, next_length)
    after = run._replace(
        t=t,
        y=jnp.where(found.kept, attempt.step.projected, run.y),
        length=next_length,
        usual=usual,
        guards=jnp.where(found.kept, attempt.values, run.guards),
        locating=searches,
        bracket=found.bracket,
        scale=found.scale,
        tried=run.tried + jnp.ones((), jnp.int32),
        accepted=run.accepted + found.kept.astype(jnp.int32),
        code=code,
    )
    return after, found.kept, found.hit


def _pass_event(
    system: HybridSystem, unknown, run: RunState, records: Records, hit, happens, most: int, grid: FixedGrid | None
):
    """State in the mode behind an event, and the records with it."""
    elements, before = system.elements, run.mode
    change = system.reset(unknown, run.t, run.y, before, system.slip(run.y), hit)
    mode, y = change.mode, system.with_slip(run.y, change.v, change.slip)
    if elements.each:
        # A gap is closed where it has fallen below zero by its level, which the first step behind would count as its error.
        y = _project(system, (unknown, mode), run.t, y)
    guards, _ = guard_values(system, (unknown, mode), run.t, y)
    by_element, switched = elements.split(hit)
    lost = by_element[:, 2].any()  # of pivots: no mode follows
    rows, count = records, run.count
    if elements.switches:
        rows, count = record_switches(
            elements, run.t, run.count, before, records, switched & happens, change.slip, most
        )
    if elements.each:
        rows, count = record_elements(elements, run.t, before, change, by_element, happens, rows, count, most)
    crowded = count > most
    code = jnp.where(change.settled, FINE, NO_MODE)
    # With switching functions alone, a motion without room for its events continues: it loses its derivatives.
    code = jnp.where(crowded & bool(elements.each), CROWDED, code)
    # Last, because it is the reason why no mode was found.
    code = jnp.where(change.paradox | lost, PARADOX, code)
    loose = jnp.zeros((), bool)
    if elements.switches:
        is_chatter = chatters(elements, run.t, run.usual, run.count, records, switched, most)
        # Steps of fixed length go across the zero from then on.
        loose = is_chatter & bool(grid is not None and not elements.each)
        code = jnp.where(is_chatter & ~loose, CROWDED, code)
        # More events than there is room for: the replay then gives NaN for derivatives, which this motion lacks.
        count = jnp.where(loose, most + 1, count)
    code = code.astype(jnp.int32)
    after = run._replace(y=y, mode=mode, guards=guards, count=count, code=code, loose=run.loose | loose)
    return jax.tree.map(lambda a, b: jnp.where(happens, a, b), (after, rows), (run, records))
