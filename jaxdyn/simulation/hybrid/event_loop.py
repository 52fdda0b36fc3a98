"""Event loop of a hybrid system: steps to the next event (`driver`), the reset map, and steps again; derivatives by replay.

Every trajectory of a batch steps to its own event; then all of them pass theirs. Events also cut steps of fixed length, and the
next step ends where the cut one would have ended.

For derivatives the motion is replayed in parts, from each save point or event to the next, within the modes that are known by
then; steps of fixed length begin anew with each part. Each part is differentiated as motions without events are. At an event the
guard e of the mode falls to zero, so its time follows the change of e at that moment,

    dt = -de / (de/dt)

to first order (`delay` has the second one too). The state is taken to that time by the motion before the event, goes through the
impact, and begins the next part there. To first order these are the saltation matrices of the literature.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import cond, while_loop
from jaxdyn.compile.kernels import Carry, Given
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.simulation.hybrid.modes import CHANNELS, KINDS, Elements, Mode
from jaxdyn.simulation.hybrid.reactions import Collision
from jaxdyn.simulation.hybrid.system import HybridSystem
from jaxdyn.simulation.hybrid.transitions import Transition
from jaxdyn.simulation.solvers import driver
from jaxdyn.simulation.solvers.driver import Integrator, LibraryRun, step_control, zeros_or
from jaxdyn.simulation.solvers.guards import delay
from jaxdyn.simulation.solvers.steps import Plan


class Records(NamedTuple):
    """Records of events, a row each; the last row is for what is not kept."""

    time: Array
    tail: Array  # time from it to rest, of impacts that accumulate there, s
    name: Array  # index among `Elements.names`
    trigger: Array  # the guard that fell to zero, -1 for an event that came with another one
    impact: Collision
    mode: Mode  # after the event
    slip: Array


def no_records(elements: Elements, dtype, maximum: int) -> Records:
    """Records before the first event."""
    n, none = len(elements.each), jnp.zeros((maximum + 1,), jnp.int32)
    flags, slip = jnp.zeros((maximum + 1, n), bool), jnp.zeros((maximum + 1, n, 2), dtype)
    mode = Mode(flags, flags, flags, jnp.zeros((maximum + 1, elements.switches), bool), slip[..., 0], slip[..., 0])
    impact = Collision(mode, slip, slip[..., 0], flags, flags)
    times = jnp.full((maximum + 1,), jnp.nan, dtype)
    return Records(times, jnp.zeros_like(times), none - 1, none - 1, impact, mode, slip)


def record_elements(
    elements: Elements, t, before: Mode, change: Transition, hit, happens, rows: Records, count, maximum: int
):
    """Records with a row for each element that an event has changed, and their number."""
    mode, number = change.mode, jnp.arange(len(elements.each), dtype=jnp.int32)
    kind = jnp.where((mode.stick & before.stick) | (mode.creep != before.creep), 5, 4)
    kind = jnp.where(mode.stick & ~before.stick, 2, jnp.where(before.stick & ~mode.stick, 3, kind))
    # A contact that is hit may let go at once.
    hits = (mode.closed | hit[:, 0]) & ~before.closed
    kind = jnp.where(hits, 0, jnp.where(before.closed & ~mode.closed, 1, kind))
    # What stands still beyond its cone is given room: the guard of a mode has changed, and its derivative.
    differs = (mode.closed != before.closed) | (mode.stick != before.stick) | (mode.negative != before.negative)
    differs = differs | (mode.excess != before.excess) | (mode.creep != before.creep)
    changed = happens & (hit.any(1) | differs)
    leading = jnp.argmax(hit.reshape(-1)).astype(jnp.int32)
    # First the element whose guard it was, which carries the impact; then those that came with it.
    leads = hit.any() & (number == leading // CHANNELS) & changed
    rank = jnp.cumsum(changed & ~leads, dtype=jnp.int32) + leads.any().astype(jnp.int32) - 1
    rank = jnp.where(leads, jnp.zeros_like(rank), rank)
    # A scatter needs a place for what is not kept too: the spare last row.
    places = jnp.where(changed & (count + rank < maximum), count + rank, maximum)

    def by_row(first, others):
        """For the leading element the one, for the others the other."""
        return jax.tree.map(lambda a, b: jnp.where(leads.reshape(-1, *[1] * a.ndim), a, b), first, others)

    none = jnp.zeros_like(change.impact.rebound)
    still = Collision(mode, change.slip, none, none > 0, none > 0)
    new = Records(
        jnp.broadcast_to(t, number.shape),
        jnp.where(kind == 0, change.tail, 0.0),
        number * len(KINDS) + kind.astype(jnp.int32),
        jnp.where(leads, leading, -1),
        by_row(change.impact, still),
        *by_row((mode, change.slip), (mode, change.slip)),
    )
    rows = jax.tree.map(lambda all_, new: all_.at[places].set(new.astype(all_.dtype)), rows, new)
    return rows, count + jnp.sum(changed, dtype=jnp.int32)


def record_switches(elements: Elements, t, count, mode: Mode, records: Records, switched, slip, maximum: int):
    """Records with a row for each switching function that changed its sign, and their number."""
    # Functions that switch together take consecutive rows.
    index = jnp.cumsum(switched, dtype=jnp.int32) - 1
    places = jnp.where(switched, jnp.minimum(count + index, maximum), maximum)
    # They change one after the other: the mode of a row has the changes of the rows before it and its own.
    earlier = switched[None] & (index[None] <= index[:, None])
    k, first = elements.switches, len(elements.each)
    number = jnp.arange(k, dtype=jnp.int32)
    modes, slip = jax.tree.map(lambda x: jnp.broadcast_to(x, (k, *x.shape)), (mode, slip))
    modes = modes._replace(positive=modes.positive ^ earlier)
    rows = Records(
        jnp.broadcast_to(t, (k,)),
        jnp.zeros((k,), t.dtype),
        first * len(KINDS) + number,
        first * CHANNELS + number,
        Collision(modes, slip, slip[..., 0], slip[..., 0] > 0, slip[..., 0] > 0),
        modes,
        slip,
    )
    rows = jax.tree.map(lambda all_, new: all_.at[places].set(new.astype(all_.dtype)), records, rows)
    return rows, count + jnp.sum(switched, dtype=jnp.int32)


def chatters(elements: Elements, t, usual, count, records: Records, switched, maximum: int):
    """True if a switching function changes back at once: on both sides of its zero the force drives the motion onto it."""
    last = jnp.maximum(jnp.minimum(count, maximum) - 1, 0)
    names = jnp.arange(elements.switches, dtype=jnp.int32) + len(elements.each) * len(KINDS)
    # Two events of one function within the rounding of the time: the motion cannot leave the zero between them.
    minimum = 64 * float(jnp.finfo(t.dtype).eps) * jnp.maximum(jnp.abs(t), usual)
    return ((names == records.name[last]) & switched).any() & (t - records.time[last] <= minimum)


class RunState(NamedTuple):
    """State of a run at an event: the steps, the mode, the records of events and their number, and a code."""

    steps: Carry
    mode: Mode
    records: Records
    count: Array  # events
    result: Any  # of the mode


class RunEnd(NamedTuple):
    """End of a run: its result, counts of steps, the time, and the number of events."""

    result: Any
    counts: dict[str, Array]
    t: Array
    count: Array


@kernel(static=1)
def guards_at(plan: Plan, args, t, y):
    """Guards and levels."""
    return plan.guards_of(args, t, y)


@kernel(static=1, derivative=False)
def _begin_mode(system: HybridSystem, args, t, y):
    """State behind an event on the rows that act, its rate of change if steps reuse it, and its guards."""
    plan, y = system.plan, system.begin(args, t, y)
    return y, plan.first_rate(args, t, y), plan.guards_of(args, t, y)[0]


def run_events(system: HybridSystem, unknown, ts, y0, mode, rtol, atol, stepsize, max_steps: int, maximum: int):
    """Rows of the state at ts[1:], the end, the records, and the transition at the start.

    `y0` (m,), flat, and `mode`: a first guess; `stepsize` (s), or None for adaptive steps. `maximum`: number of events.
    """
    elements, plan = system.elements, system.plan
    hit = jnp.zeros((CHANNELS * len(elements.each) + elements.switches,), bool)
    # The start may be an impact, or its mode may not hold: it passes a transition before the first step.
    begun = system.reset(unknown, ts[0], y0, mode, system.slip(y0), hit, True, atol)
    y = system.with_slip(y0, begun.v, begun.slip)
    if elements.each:
        y = _begin_mode(system, (unknown, begun.mode), ts[0], y)[0]
    control = driver.step_control(plan.solver(), stepsize)
    limits, steps = driver.begin(plan, control, (unknown, begun.mode), ts, y, rtol, atol, stepsize)
    result = first_of(_cases(begun), RESULTS.successful)
    # A mode that has begun holds, whatever the rounding of its guards.
    search = steps.state.search._replace(hit=hit)
    steps = steps._replace(state=steps.state._replace(search=search, stopped=result != RESULTS.successful))

    def is_running(run: RunState):
        return driver.is_active(max_steps, limits, run.steps.state._replace(search=None))

    def body(run: RunState) -> RunState:
        happens = run.steps.state.search.hit.any()
        pass_event = partial(_pass_event, system, unknown, maximum, stepsize is not None, atol)
        run = cond(happens, pass_event, lambda run: run, run)
        steps = driver.run_to_event(plan, control, max_steps, (), (unknown, run.mode), limits, Given(ts), run.steps)
        return run._replace(steps=steps)

    run = RunState(steps, begun.mode, no_records(elements, y0.dtype, maximum), jnp.zeros((), jnp.int32), result)
    run = while_loop(is_running, body, run)
    state = run.steps.state
    # Friction that leaves no forces grows without bound before.
    pivot = jnp.min(elements.split(state.search.values)[0][:, 2], initial=1.0) < 0.05
    cases = [(state.failed & pivot, RESULTS.painleve_paradox), *driver.cases_of(limits, control, state)]
    of_mode = run.result != RESULTS.successful
    result = RESULTS.where(of_mode, run.result, first_of(cases, RESULTS.successful))
    return run.steps.rows, RunEnd(result, state.counts, state.t, run.count), run.records, begun


def _cases(change: Transition) -> list[tuple[Array, Any]]:
    return [(change.paradox, RESULTS.painleve_paradox), (~change.settled, RESULTS.no_contact_mode)]


def _pass_event(system: HybridSystem, unknown, maximum: int, is_fixed_length: bool, atol, run: RunState) -> RunState:
    """State in the mode behind an event, and the records with it; unchanged where there is none."""
    elements, before, state, records = system.elements, run.mode, run.steps.state, run.records
    hit, search = state.search.hit, state.search
    happens = hit.any() & ~state.stopped
    change = system.reset(unknown, state.t, state.y, before, system.slip(state.y), hit, happens, atol)
    mode, y = change.mode, system.with_slip(state.y, change.v, change.slip)
    y, rate, guards = _begin_mode(system, (unknown, mode), state.t, y)
    by_element, switched = elements.split(hit)
    lost = by_element[:, 2].any()  # of pivots: no mode follows
    rows, count = records, run.count
    if elements.switches:
        # Steps that go across the roots have no records.
        rows, count = record_switches(
            elements, state.t, count, before, records, switched & happens & ~search.loose, change.slip, maximum
        )
    if elements.each:
        rows, count = record_elements(elements, state.t, before, change, by_element, happens, rows, count, maximum)
    # With switching functions alone, a motion without room for its events continues: it loses its derivatives.
    crowded, loose = (count > maximum) & bool(elements.each), search.loose
    if elements.switches:
        is_chatter = chatters(elements, state.t, search.usual, run.count, records, switched, maximum) & ~loose
        # Steps of fixed length go across the zero from then on.
        begins = is_chatter & bool(is_fixed_length and not elements.each)
        crowded = crowded | (is_chatter & ~begins)
        # More events than there is room for: the replay then gives NaN for derivatives, which this motion lacks.
        count = jnp.where(begins, maximum + 1, count)
        loose = loose | begins
    # First, because it is the reason why no mode was found.
    cases = [
        (lost, RESULTS.painleve_paradox),
        *_cases(change)[:1],
        (crowded, RESULTS.too_many_events),
        *_cases(change)[1:],
    ]
    result = first_of(cases, RESULTS.successful)
    search = search._replace(values=guards, hit=jnp.zeros_like(hit), loose=loose)
    state = state._replace(y=y, rate=rate, search=search, stopped=result != RESULTS.successful)
    after = RunState(run.steps._replace(state=state), mode, rows, count, result)
    return jax.tree.map(lambda a, b: jnp.where(happens, a, b), after, run)


# --- integration with events from the start to the save points, and its derivatives by replay ---


class HybridRun(Integrator):
    """Integrator with events: call(y0, unknown, ts) -> rows of the state at ts[1:]; times of events; end, records and start.

    Derivatives reach y0, `unknown` and ts through rows and times of events. `room`: steps from one of these to the next.
    """

    system: HybridSystem = eqx.field(static=True)
    mode: Mode
    rtol: Any
    atol: Any
    stepsize: Any  # None for adaptive steps
    max_steps: int = eqx.field(static=True)
    maximum: int = eqx.field(static=True)  # events

    def values(self, inputs, room):
        y0, unknown, ts = inputs
        steps = self.rtol, self.atol, self.stepsize, self.max_steps, self.maximum
        rows, end, records, begun = run_events(self.system, unknown, ts, ravel_pytree(y0)[0], self.mode, *steps)
        facts = end, records, begun
        return (jax.vmap(self.system.plan.structure)(rows), records.time[: self.maximum], facts), facts

    def replay(self, history, inputs, direct):
        end, records, begun = history
        return _replay(self, inputs, end, records, begun, direct)

    def weights(self, inputs, gradients, history):
        y0, _, ts = inputs
        rows, times, _ = gradients
        times = jnp.zeros((self.maximum,), ts.dtype) if times is None else times
        # Events that did not happen have no time.
        times = jnp.where(history[1].name[: self.maximum] < 0, jnp.zeros_like(times), times)
        return zeros_or(rows, y0, ts.shape[0] - 1), times


def _replay(run: HybridRun, inputs, end, records, begun, direct: bool):
    """Rows at ts[1:] and times of events by replay in the modes that are known; `direct`: differentiable in both modes."""
    system, (y0, unknown, ts) = run.system, inputs
    plan, saves, maximum = system.plan._replace(guards=None), ts.shape[0] - 1, run.maximum
    happened = records.name[:maximum] >= 0
    known_times = jnp.concatenate([ts[1:], jnp.where(happened, records.time[:maximum], jnp.inf)])
    is_event = jnp.arange(saves + maximum) >= saves
    order = jnp.lexsort((is_event, lax.stop_gradient(known_times)))  # a save point at an event is before it
    part_run = LibraryRun(
        plan, step_control(plan.solver(), run.stepsize), run.rtol, run.atol, run.stepsize, run.max_steps, room=run.room
    )
    last = lax.stop_gradient(end.t)

    def part_or_none(carry, at):
        # There is room for more events than happened: the rest is skipped.
        happens = ~is_event[at] | happened[jnp.clip(at - saves, 0, maximum - 1)]
        return cond(happens, part, lambda carry, at: (carry, carry[:2]), carry, at)

    def part(carry, at):
        t, y, mode = carry
        event, place = is_event[at], jnp.clip(at - saves, 0, maximum - 1)
        record = jax.tree.map(lambda x: x[place], records)
        # The derivative of an event's time enters by `_cross`: here the time is a constant.
        until = jnp.where(event, lax.stop_gradient(record.time), ts[1:][jnp.clip(at, 0, saves - 1)])
        known = ~event | (record.name >= 0)
        # Parts of no length, of events at the same time, make no steps; nothing is known beyond the end of the run.
        advances = known & (until > t) & (until <= last)
        until = jnp.where(advances, until, t)
        integrate: Any = part_run.direct if direct else part_run
        rows, *_ = integrate(plan.structure(y), (unknown, mode), jnp.stack([t, until]))
        here = jnp.where(advances, ravel_pytree(jax.tree.map(lambda x: x[0], rows))[0], y)
        behind = _cross(system, unknown, mode, record, t, until, here)
        crosses = event & known
        t, y = (jnp.where(crosses, a, b) for a, b in zip(behind, (until, here), strict=True))
        mode = jax.tree.map(lambda a, b: jnp.where(crosses, a, b), record.mode, mode)
        return (t, y, mode), (t, here)

    # The start may be an impact, whose velocity follows the start.
    y = system.impact(unknown, begun.impact, ts[0], ravel_pytree(y0)[0])
    y = _begin_on_rows(system, unknown, begun.mode, ts[0], system.with_slip(y, None, lax.stop_gradient(begun.slip)))
    # With a checkpoint, reverse mode keeps one state a part, and the steps of one part at a time.
    _, (times, rows) = lax.scan(jax.checkpoint(part_or_none), (ts[0], y, begun.mode), order)
    # The inverse permutation: save points first, then events.
    back = jnp.argsort(order)
    # A motion that continued beyond the events that there was room for has no derivative here.
    rows = rows * jnp.where((end.count > maximum) & (end.result != RESULTS.too_many_events), jnp.nan, 1.0).astype(
        rows.dtype
    )
    return jax.vmap(plan.structure)(rows[back[:saves]]), times[back[saves:]]


def _cross(system: HybridSystem, unknown, mode: Mode, record: Records, t, known_time, y):
    """Time and state behind an event; y is the state at the time that is known."""
    hit, which = record.trigger >= 0, jnp.maximum(record.trigger, 0)

    def guard(given, t, y):
        *args, which = given
        return guards_at(system.plan, tuple(args), t, y)[0][which]

    def field(given, t, y):
        return system.plan.field_of(given[:2], t, y)

    late = jnp.where(hit, delay(guard, field, (unknown, mode, which), known_time, y), 0.0)
    time = jnp.where(hit, known_time + late, t)
    # To the event by the motion before it: a shift of value zero, with the first and second derivatives of the time.
    y = _shift(system.plan, (unknown, mode), known_time, y, late)
    slip = system.slip_behind(unknown, mode, record.mode, lax.stop_gradient(record.slip), time, y)
    y = system.with_slip(system.impact(unknown, record.impact, time, y), None, slip)
    return time, _begin_on_rows(system, unknown, record.mode, time, y)


def _begin_on_rows(system: HybridSystem, unknown, mode: Mode, t, y):
    """State from which the run has begun a mode: y moved onto the rows that act, by a constant."""
    if not system.elements.each:
        return y
    # What is moved is rounding. Left to the first step it would count as its error, and no step would be short enough.
    args = lax.stop_gradient(((unknown, mode), t, y))
    return y + lax.stop_gradient(_begin_mode(system, *args)[0] - args[2])


def _shift(plan, args, t, y, late):
    """State `late` after t, which is zero in value: y + late y' + late^2 y''/2."""

    def field(t, y):
        return plan.field_of(args, t, y)

    rate, change = jax.jvp(field, (t, y), (jnp.ones_like(t), lax.stop_gradient(plan.field_of(args, t, y))))
    return y + late * rate + late**2 / 2 * lax.stop_gradient(change)
