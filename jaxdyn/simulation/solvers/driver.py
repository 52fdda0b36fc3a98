"""Integration by explicit steps, as one loop around kernels: diffrax's rules in a program that compiles in a second.

A step at whose end a guard is negative is repeated with a shorter length, until its end is the root (`guards`). There the loop
ends: with the run, or until a reset map has set the state behind the event (`hybrid.event_loop`).
Trajectories of a batch that have ended take steps of no length until the last one has ended.

Reverse mode goes back through the same steps (see `reverse`).
"""

from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import any_sample, while_loop
from jaxdyn.compile.loops import Carry, Given, Iteration, Passed, Task, run_loop
from jaxdyn.compile.repair import compute_where
from jaxdyn.simulation.solvers import reverse
from jaxdyn.simulation.solvers.explicit import Plan, Step, dense_output, take_step
from jaxdyn.simulation.solvers.guards import Found, Search, search_root
from jaxdyn.simulation.solvers.integrator import Integrator, zeros_or
from jaxdyn.simulation.solvers.step_control import (
    NextStep,
    add_error,
    error_size,
    first_step,
    least_step,
    next_step,
    no_sums,
)

# Floating-point numbers before the end of a run from which a step goes to the end: what is left is rounding, and a step of its
# own for it would be shorter than the least one.
_ROUNDED = 100
# Length of the first step after an event, in steps before it: the motion may be another one.
_AFTER_EVENT = 0.3


class AdaptiveSteps(NamedTuple):
    """Steps that keep a tolerance: order of the error estimate, and the norm of a scaled error."""

    order: Any
    size: Any


class FixedSteps(NamedTuple):
    """Steps of one length: orders of the method and of its error estimate."""

    order: Any
    error_order: Any


class ExplicitRun(Integrator):
    """Integrator by explicit steps: call(y0, args, ts) -> rows of the state at ts[1:]; its end; result, counts, time; sums.

    The end is the state where a guard has ended the motion, with derivatives at that time, and an empty tuple without a guard.

    - `plan`, `control`: the steps and their control.
    - `rtol`, `atol`, for adaptive steps; `stepsize` (s), for fixed ones.
    - `max_steps`; `room`, the most where reverse mode is asked for.
    """

    plan: Plan = eqx.field(static=True)
    control: AdaptiveSteps | FixedSteps = eqx.field(static=True)
    rtol: Any
    atol: Any
    stepsize: Any
    max_steps: int = eqx.field(static=True)

    def values(self, inputs, room):
        y0, args, ts = inputs
        most = self.max_steps if room is None else room
        rows, end, facts, sums, history = _run_steps(self, ravel_pytree(y0)[0], args, ts, most, room is not None)
        end = () if self.plan.guards is None else self.plan.structure(end)
        return (jax.vmap(self.plan.structure)(rows), end, facts, sums), history

    def number_of_steps(self, ts):
        """Number of fixed steps, None where their ends do not follow the end of the run."""
        is_free = isinstance(self.control, AdaptiveSteps) or self.plan.guards is not None
        return None if is_free else number_of_steps(ts[0], ts[-1], self.stepsize)

    def replay(self, history, inputs, direct):
        y0, args, ts = inputs
        ts, places = self._with_end(history, ts)
        rows = reverse.replay_rows(self.plan, history, ravel_pytree(y0)[0], args, ts, self.number_of_steps(ts))
        return self._without_end(jax.vmap(self.plan.structure)(rows), places)

    def _with_end(self, history, ts):
        """Save points, with the end of a run with a guard among them, and the places of the rows, the end's the last, or None."""
        if self.plan.guards is None:
            return ts, None
        last = jnp.maximum(history.count - 1, 0)
        times = jnp.append(ts[1:], jnp.where(history.count > 0, history.times[last, 1], ts[0]))
        order = jnp.argsort(lax.stop_gradient(times), stable=True)
        return jnp.concatenate([ts[:1], times[order]]), jnp.argsort(order)

    def _without_end(self, rows, places):
        if places is None:
            return rows, ()
        return tuple(jax.tree.map(lambda x, at=at: x[at], rows) for at in (places[:-1], places[-1]))

    def weights(self, inputs, gradients, history):
        y0, _, ts = inputs
        of_rows = zeros_or(gradients[0], y0, ts.shape[0] - 1)
        if self.plan.guards is None:
            return of_rows, ()
        return of_rows, jax.tree.map(lambda x: x[0], zeros_or(jax.tree.map(lambda x: x[None], gradients[1]), y0, 1))

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs by kernels."""
        y0, args, ts = inputs
        ts, places = self._with_end(history, ts)
        of_rows, of_end = weights
        flat = jax.vmap(lambda y: ravel_pytree(y)[0])(of_rows)
        if places is not None:
            flat = jnp.concatenate([flat, ravel_pytree(of_end)[0][None]])[jnp.argsort(places)]
        start, structure = ravel_pytree(y0)
        of_y, of_args, of_ts = reverse.pull(
            self.plan, history, start, args, ts, self.number_of_steps(ts), flat, perturbed[1:]
        )
        if places is not None:
            # The end is a constant time.
            of_ts = jnp.concatenate([of_ts[:1], of_ts[1:][places[:-1]]])

        def or_none(x, varies):
            return x if varies else None

        return jax.tree.map(or_none, structure(of_y), perturbed[0]), of_args, or_none(of_ts, perturbed[2])


class Limits(NamedTuple):
    """Constants of a run: its ends, the time from which a step goes to the end, and what sets the length of steps."""

    start: Array
    end: Array
    floor: Array
    least_at_end: Array
    steps: Array
    rtol: Array
    atol: Array
    y0: Array


class State(NamedTuple):
    """State of a run: the next step goes from t to t_next, from the state y with the rate of change `rate`."""

    t: Array
    t_next: Array
    y: Array
    rate: Array
    at_least: Array  # true for a step of the least length, which is kept whatever its error
    tried: Array  # steps
    accepted: Array  # steps
    failed: Array
    quality: Array  # of the state if the method may fail on the way (`Plan.quality`), else one
    stopped: Array  # true where that has changed its sign
    sums: tuple[Array, Array]
    search: Search | None  # for the events of a plan that has guards


def begin(plan: Plan, control, args, ts, y0, rtol, atol, stepsize) -> tuple[Limits, State]:
    """Constants of a run, and its state at the start."""
    start, end = ts[0], ts[-1]
    eps, none, no = float(jnp.finfo(ts.dtype).eps), jnp.zeros((), jnp.int32), jnp.asarray(False)
    floor = end - _ROUNDED * eps / 2 * jnp.abs(end)
    # Fixed steps have no tolerances: zeros keep one structure of the loop's constants.
    rtol, atol = (jnp.zeros_like(start) if x is None else x for x in (rtol, atol))
    rate, length, quality, (values, levels) = _begin(plan, control, args, start, end, y0, rtol, atol)
    steps = none
    if not isinstance(control, AdaptiveSteps):
        length, steps = stepsize, number_of_steps(start, end, stepsize)
    usual = jnp.asarray(length, ts.dtype)
    least_at_end = 16 * eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    limits = Limits(start, end, floor, least_at_end, steps, rtol, atol, y0)
    search = None if plan.guards is None else Search.begin(values, values < -levels, usual)
    sums = no_sums(plan.structure(y0))
    t_next = jnp.minimum(start + length, end)
    return limits, State(start, t_next, y0, rate, no, none, none, no, quality, quality == 0, sums, search)


def run_to_event(
    plan: Plan, control, max_steps: int, strides, args, limits: Limits, given: Given, carry: Carry
) -> Carry:
    """Make steps to the end of the run, or to an event."""
    static = plan, control, max_steps, strides
    task = Task(_iterate, _iterate_in_jax, static, dense_output, (plan,), strides)
    return reverse.run_to_end(
        lambda carry: run_loop(task, args, limits, given, carry),
        partial(_iterate_once, *static, args, limits, given),
        # A step that the kernel cannot compute is computed by JAX, and the native loop continues behind it.
        partial(_iterate_once, *static, args, limits, given, advance=_advance_by_fallback),
        partial(_is_running, max_steps, limits),
        carry,
    )


def blank_rows(y0, ts):
    """Rows of a run before its start."""
    # What is not reached stays infinite, which tells it from rows that are computed.
    return jnp.broadcast_to(jnp.full_like(y0, jnp.inf), (ts.shape[0] - 1, y0.size))


def _run_steps(run: ExplicitRun, y0, args, ts, max_steps: int, record: bool):
    """Rows (nt - 1, n) at ts[1:]; the last state; diffrax's result, counts and time; sums (`add_error`); a `History` or None.

    **Arguments:** `y0` (n,), flat; `record`: True to write the history that reverse mode needs.
    """
    plan, control = run.plan, run.control
    limits, state = begin(plan, control, args, ts, y0, run.rtol, run.atol, run.stepsize)
    history = reverse.blank(y0, ts[0], max_steps) if record else None
    records, strides = ((), ()) if history is None else (history.rows, history.strides)
    carry = Carry(state, jnp.zeros((), jnp.int32), blank_rows(y0, ts), records)
    state, _, rows, records = run_to_event(plan, control, max_steps, strides, args, limits, Given(ts), carry)
    if history is not None:
        states, times, kept = records
        history = reverse.History(states, times, kept, state.tried)
    codes: Any = diffrax.RESULTS
    result = codes.where(state.t < limits.end, codes.max_steps_reached, codes.successful)
    result = codes.where(state.failed, codes.dt_min_reached, result)
    stopped = state.stopped if state.search is None else state.stopped | state.search.hit.any()
    result = codes.where(stopped, codes.event_occurred, result)
    facts = result, step_counts(state.tried, state.accepted), state.t
    return rows, state.y, facts, None if isinstance(control, AdaptiveSteps) else state.sums, history


def step_counts(tried, accepted) -> dict[str, Array]:
    """Counts of steps, by diffrax's names."""
    return {"num_steps": tried, "num_accepted_steps": accepted, "num_rejected_steps": tried - accepted}


def _is_active(max_steps: int, limits: Limits, state: State):
    active = (state.t < limits.end) & ~state.failed & ~state.stopped & (state.tried < max_steps)
    return active if state.search is None else active & ~state.search.hit.any()


def _is_running(max_steps: int, limits: Limits, carry: Carry):
    return any_sample(_is_active(max_steps, limits, carry.state))


def _iterate(plan: Plan, control, max_steps: int, strides, args, limits: Limits, state: State, _) -> Iteration:
    """Make a step, in a native loop."""
    active = _is_active(max_steps, limits, state)
    after, kept, step = _advance(plan, control, args, limits, state, active)
    dense = state.t, after.t, state.y, step.raw, step.stages, step.shift
    row = reverse.row(state.y, state.t, state.t_next, kept) if strides else ()
    more = _is_active(max_steps, limits, after)
    return Iteration(after, active, more, Passed(kept, after.t, dense), state.tried, row)


def _iterate_once(
    plan: Plan, control, max_steps: int, strides, args, limits: Limits, given: Given, carry: Carry, advance=None
) -> Carry:
    """Make a step, as operations of JAX around kernels; by `advance` (default: `_advance_by_kernel`)."""
    state, records = carry.state, carry.records
    active = _is_active(max_steps, limits, state)
    after, kept, step = (advance or _advance_by_kernel)(plan, control, args, limits, state, active)
    if records:
        row = reverse.row(state.y, state.t, state.t_next, kept)
        records = reverse.write(records, strides, row, state.tried, active)
    return Carry(after, *save(plan, given.times, state, after, kept, step, carry.saved, carry.rows), records)


def _iterate_in_jax(plan: Plan, control, max_steps: int, strides, args, limits: Limits, given: Given, carry: Carry):
    """All steps, as operations of JAX around kernels."""
    step_on = partial(_iterate_once, plan, control, max_steps, strides, args, limits, given)
    return lax.while_loop(partial(_is_running, max_steps, limits), step_on, carry)


def number_of_steps(start, end, stepsize):
    """Number of fixed steps, as counted by diffrax's `ConstantStepSize`."""
    return jnp.ceil((end - start) / jnp.nextafter(stepsize, jnp.inf)).astype(jnp.int32)


def _advance(plan: Plan, control, args, limits: Limits, state: State, active):
    """State after a step, whether the step is kept, and the step."""
    step = take_step(plan, args, state.t, jnp.where(active, state.t_next, state.t), state.y, state.rate)
    return *_accept(plan, control, args, limits, state, active, step), step


def _advance_by_kernel(plan: Plan, control, args, limits: Limits, state: State, active):
    advance: Any = kernel(_advance, static=2, fallback=_advance, derivative=False)
    return advance(plan, control, args, limits, state, active, where=active)


def _advance_by_fallback(plan: Plan, control, args, limits: Limits, state: State, active):
    """State after a step that the native loop has refused, for every trajectory that is active."""
    none, stages = jnp.zeros_like(state.y), jnp.zeros((plan.count, state.y.size), state.y.dtype)
    unchanged = state, jnp.zeros_like(active), Step(none, none, none, none, stages, none)
    return compute_where(active, partial(_advance, plan, control), unchanged, (args, limits, state, active))


def _accept(plan: Plan, control, args, limits: Limits, state: State, active, step: Step) -> tuple[State, Array]:
    """State after a step that is kept or refused, and whether it is kept."""
    t, end, is_adaptive = state.t, limits.end, isinstance(control, AdaptiveSteps)
    t_next, sums = jnp.where(active, state.t_next, t), state.sums
    if is_adaptive:
        kept, length, at_least, failed = _control_step(plan, control, limits, state, t_next, step)
    else:
        kept, length, at_least, failed = (
            jnp.asarray(True),
            limits.end - limits.start,
            state.at_least,
            jnp.asarray(False),
        )
    search, found, usual = state.search, None, length
    if search is not None:
        good = kept if is_adaptive else jnp.isfinite(step.projected).all()
        usual = length if is_adaptive else search.usual
        found = _search(plan, args, state, t_next, step, good, usual)
        kept, search = found.kept, found.search
        # Lengths that events set may be shorter than those of the control. Fixed steps fail where the state is not finite.
        failed, at_least = ~good if not is_adaptive else failed & ~good, at_least & ~found.is_open & ~found.located
        length = jnp.where(found.located, _AFTER_EVENT * search.usual, length)
    t = jnp.where(kept, jnp.minimum(t_next, end), t)
    if is_adaptive:
        after = t + length
        # A step that would end within rounding of the end goes there; a refused one tries half of the way.
        after = jnp.where(after > limits.floor, jnp.where(kept, end, t + 0.5 * (end - t)), after)
    else:
        start, before, y, error = (plan.structure(x) for x in (limits.y0, state.y, step.projected, step.error))
        sums = add_error(control.order, control.error_order, start, before, y, error, *state.sums)
        number = state.tried + 1
        if found is not None and search is not None:
            # A step that an event has cut less than a thousandth before a point of the grid has reached it.
            point = _grid_point(limits, number - search.cuts)
            comes = kept & (t_next > point - 1e-3 * search.usual)
            search = search._replace(cuts=search.cuts + (~comes).astype(jnp.int32), usual=usual)
            number = number - search.cuts
            sums = jax.tree.map(lambda new, old: jnp.where(kept, new, old), sums, state.sums)
        after = _grid_point(limits, number + 1)
    if found is not None:
        after = jnp.where(found.is_open, t + found.following, after)
    # What follows is masked by `active`: a trajectory that has ended keeps its state while others of the batch continue.
    kept, one = kept & active, active.astype(jnp.int32)
    quality = jnp.where(kept, plan.quality_of(args, t_next, step.projected), state.quality)

    def if_active(new, old):
        return jax.tree.map(lambda new, old: jnp.where(active, new, old), new, old)

    state = State(
        if_active(t, state.t),
        if_active(jnp.minimum(after, end), state.t_next),
        jnp.where(kept, step.projected, state.y),
        jnp.where(kept, step.rate, state.rate),
        at_least,
        state.tried + one,
        state.accepted + kept.astype(jnp.int32),
        state.failed | (failed & active),
        quality,
        state.stopped | (quality * state.quality <= 0),
        if_active(sums, state.sums),
        if_active(search, state.search),
    )
    return state, kept


def _search(plan: Plan, args, state: State, t_next, step: Step, good, usual) -> Found:
    """Search for an event of an attempt."""
    middle = (state.t + t_next) / 2
    # The dense output only finds that a guard was negative: the event is located by steps of its own.
    between = dense_output(plan, None, middle, state.t, t_next, state.y, step.raw, step.stages, step.shift)
    at_end, in_middle = plan.guards_of(args, t_next, step.projected), plan.guards_of(args, middle, between)
    search: Any = state.search
    return search_root(search, state.t, t_next, at_end, in_middle, good, usual)


def _grid_point(limits: Limits, number):
    """End of the fixed step of this number, from one."""
    # From the start of the run, as sums of lengths would carry their rounding on.
    done = number.astype(limits.end.dtype) / limits.steps.astype(limits.end.dtype)
    t = limits.start + (limits.end - limits.start) * done
    return jnp.where((number >= limits.steps) | (t > limits.floor), limits.end, t)


def save(plan: Plan, ts, before: Any, after: Any, kept, step: Step, saved, rows):
    """Number of save points up to the end of a step, and their rows."""
    count = ts.shape[0] - 1

    def is_due(saved):
        return kept & (saved < count) & (ts[jnp.minimum(saved + 1, count)] <= after.t)

    def body(carry):
        saved, rows = carry
        here, place = is_due(saved), jnp.minimum(saved, count - 1)
        at = ts[place + 1], before.t, after.t, before.y, step.raw, step.stages, step.shift
        row = kernel(dense_output, static=1)(plan, None, *at)
        rows = rows.at[place].set(jnp.where(here, row, rows[place]))
        return saved + here.astype(jnp.int32), rows

    return while_loop(lambda carry: is_due(carry[0]), body, (saved, rows))


@kernel(static=2, derivative=False)
def _begin(plan: Plan, control, args, t0, t1, y, rtol, atol):
    """Rate of change at the start, if steps reuse it, the length of the first adaptive step, the quality, and the guards."""
    rate, monitors = plan.first_rate(args, t0, y), (plan.quality_of(args, t0, y), plan.guards_of(args, t0, y))
    if not isinstance(control, AdaptiveSteps):
        return rate, t1 - t0, *monitors
    term = diffrax.ODETerm(plan.field)
    length = first_step(term, t0, t1, plan.structure(y), args, control.order, rtol, atol, control.size)
    return rate, jnp.where(jnp.isfinite(length), length, t1 - t0), *monitors


def _control_step(plan: Plan, control: AdaptiveSteps, limits: Limits, state: State, t1, step: Step) -> NextStep:
    """Decide whether a step is kept, and the length of the next one."""
    ends = (plan.structure(x) for x in (state.y, step.projected, step.error))
    size = error_size(control.size, *ends, limits.rtol, limits.atol)
    return next_step(size, control.order, t1 - state.t, state.at_least, least_step(state.t, limits.least_at_end))
