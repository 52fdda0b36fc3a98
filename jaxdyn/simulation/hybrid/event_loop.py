"""Event loop of a hybrid system: steps to the next event (`driver`), the reset map, and steps again.

Every trajectory of a batch steps to its own event; then all of them pass theirs. Events also cut steps of fixed length, and the
next step ends where the cut one would have ended.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import while_loop
from jaxdyn.compile.loops import Carry, Given
from jaxdyn.simulation.hybrid.modes import Mode
from jaxdyn.simulation.hybrid.records import Records, chatters, no_records, record_elements, record_switches
from jaxdyn.simulation.hybrid.system import HybridSystem
from jaxdyn.simulation.solvers import driver
from jaxdyn.simulation.solvers.explicit import Plan

FINE, SHORT, PARADOX, NO_MODE, CROWDED = range(5)


class RunState(NamedTuple):
    """State of a run at an event: the steps, the mode, the records of events and their number, and a code."""

    steps: Carry
    mode: Mode
    records: Records
    count: Array  # events
    code: Array


class RunEnd(NamedTuple):
    """End of a run: time, steps tried and accepted, a code, the number of events, and sums about steps of fixed length."""

    t: Array
    tried: Array
    accepted: Array
    code: Array
    count: Array
    sums: tuple[Array, Array]


@kernel(static=1)
def guards_at(plan: Plan, args, t, y):
    """Guards and levels."""
    return plan.guards_of(args, t, y)


@kernel(static=1)
def _begin_mode(system: HybridSystem, args, t, y):
    """State behind an event on the rows that act, its rate of change if steps reuse it, and its guards."""
    plan = system.plan
    if system.elements.each:
        # A gap is closed where it has fallen below zero by its level, which the first step behind would count as its error.
        y = plan.project_end(args, t, y, jnp.zeros_like(y))[0]
    return y, plan.first_rate(args, t, y), plan.guards_of(args, t, y)[0]


def run_events(system: HybridSystem, unknown, ts, y0, mode, rtol, atol, stepsize, max_steps: int, most: int):
    """Rows of the state at ts[1:], the end, the records, and the transition at the start.

    `y0` (m,), flat, and `mode`: a first guess; `stepsize` (s), or None for adaptive steps. `most`: number of events.
    """
    elements, plan = system.elements, system.plan
    hit = jnp.zeros((system.count,), bool)
    # The start may be an impact, or its mode may not hold: it passes a transition before the first step.
    begun = system.reset(unknown, ts[0], y0, mode, system.slip(y0), hit)
    y = system.with_slip(y0, begun.v, begun.slip)
    if stepsize is not None:
        # One grid for the whole run: steps that an event has cut return to it.
        stepsize = (ts[-1] - ts[0]) / driver.number_of_steps(ts[0], ts[-1], stepsize).astype(ts.dtype)
    control = system.control(stepsize)
    limits, state = driver.begin(plan, control, (unknown, begun.mode), ts, y, rtol, atol, stepsize)
    code = jnp.where(begun.paradox, PARADOX, jnp.where(begun.settled, FINE, NO_MODE)).astype(jnp.int32)
    # A mode that has begun holds, whatever the rounding of its guards.
    state = state._replace(search=state.search._replace(hit=hit), stopped=code != FINE)
    none = jnp.zeros((), jnp.int32)

    def go_on(run: RunState) -> RunState:
        args = unknown, run.mode
        return run._replace(steps=driver.run_to_event(plan, control, max_steps, (), args, limits, Given(ts), run.steps))

    def is_at_event(run: RunState):
        return run.steps.state.search.hit.any() & ~run.steps.state.stopped

    def body(run: RunState) -> RunState:
        return go_on(_pass_event(system, unknown, run, most, stepsize is not None))

    steps = Carry(state, none, driver.blank_rows(y, ts))
    run = go_on(RunState(steps, begun.mode, no_records(elements, y0.dtype, most), none, code))
    run = while_loop(is_at_event, body, run)
    state = run.steps.state
    # Friction that leaves no forces grows without bound before.
    pivot = jnp.min(elements.split(state.search.values)[0][:, 2], initial=1.0) < 0.05
    code = jnp.where(state.failed, jnp.where(pivot, PARADOX, SHORT), run.code).astype(jnp.int32)
    end = RunEnd(state.t, state.tried, state.accepted, code, run.count, state.sums)
    return run.steps.rows, end, run.records, begun


def _pass_event(system: HybridSystem, unknown, run: RunState, most: int, is_fixed_length: bool) -> RunState:
    """State in the mode behind an event, and the records with it; unchanged where there is none."""
    elements, before, state, records = system.elements, run.mode, run.steps.state, run.records
    hit, search = state.search.hit, state.search
    happens = hit.any() & ~state.stopped
    change = system.reset(unknown, state.t, state.y, before, system.slip(state.y), hit)
    mode, y = change.mode, system.with_slip(state.y, change.v, change.slip)
    y, rate, guards = _begin_mode(system, (unknown, mode), state.t, y)
    by_element, switched = elements.split(hit)
    lost = by_element[:, 2].any()  # of pivots: no mode follows
    rows, count = records, run.count
    if elements.switches:
        # Steps that go across the roots have no records.
        rows, count = record_switches(
            elements, state.t, count, before, records, switched & happens & ~search.loose, change.slip, most
        )
    if elements.each:
        rows, count = record_elements(elements, state.t, before, change, by_element, happens, rows, count, most)
    crowded = count > most
    code = jnp.where(change.settled, FINE, NO_MODE)
    # With switching functions alone, a motion without room for its events continues: it loses its derivatives.
    code = jnp.where(crowded & bool(elements.each), CROWDED, code)
    # Last, because it is the reason why no mode was found.
    code = jnp.where(change.paradox | lost, PARADOX, code)
    loose = search.loose
    if elements.switches:
        is_chatter = chatters(elements, state.t, search.usual, run.count, records, switched, most) & ~loose
        # Steps of fixed length go across the zero from then on.
        begins = is_chatter & bool(is_fixed_length and not elements.each)
        code = jnp.where(is_chatter & ~begins, CROWDED, code)
        # More events than there is room for: the replay then gives NaN for derivatives, which this motion lacks.
        count = jnp.where(begins, most + 1, count)
        loose = loose | begins
    code = code.astype(jnp.int32)
    search = search._replace(values=guards, hit=jnp.zeros_like(hit), loose=loose)
    state = state._replace(y=y, rate=rate, search=search, stopped=code != FINE)
    after = RunState(run.steps._replace(state=state), mode, rows, count, code)
    return jax.tree.map(lambda a, b: jnp.where(happens, a, b), after, run)
