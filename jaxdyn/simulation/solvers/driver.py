"""Integration by explicit steps, as one loop around kernels: diffrax's rules in a program that compiles in a second.

A step at whose end a guard is negative is repeated with a shorter length, until its end is the root: there the motion ends.
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
from jaxdyn.simulation.solvers.integrator import Integrator, zeros_or
from jaxdyn.simulation.solvers.roots import Bracket
from jaxdyn.simulation.solvers.step_control import (
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
        end = () if self.plan.guard is None else self.plan.structure(end)
        return (jax.vmap(self.plan.structure)(rows), end, facts, sums), history

    def number_of_steps(self, ts):
        """Number of fixed steps, None where their ends do not follow the end of the run."""
        is_free = isinstance(self.control, AdaptiveSteps) or self.plan.guard is not None
        return None if is_free else number_of_steps(ts[0], ts[-1], self.stepsize)

    def replay(self, history, inputs, direct):
        y0, args, ts = inputs
        ts, places = self._with_end(history, ts)
        rows = reverse.replay_rows(self.plan, history, ravel_pytree(y0)[0], args, ts, self.number_of_steps(ts))
        return self._without_end(jax.vmap(self.plan.structure)(rows), places)

    def _with_end(self, history, ts):
        """Save points, with the end of a run with a guard among them, and the places of the rows, the end's the last, or None."""
        if self.plan.guard is None:
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
        if self.plan.guard is None:
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


class _Limits(NamedTuple):
    """Constants of a run: its ends, the time from which a step goes to the end, and what sets the length of steps."""

    start: Array
    end: Array
    floor: Array
    least_at_end: Array
    steps: Array
    rtol: Array
    atol: Array
    y0: Array


class _State(NamedTuple):
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
    guard: "_Guard | None"  # of a plan that has one


class _Guard(NamedTuple):
    """Value of the guard of a state, and whether it is negative where the next step ends."""

    value: Array
    crossed: Array


def _run_steps(run: ExplicitRun, y0, args, ts, max_steps: int, record: bool):
    """Rows (nt - 1, n) at ts[1:]; the last state; diffrax's result, counts and time; sums (`add_error`); a `History` or None.

    **Arguments:** `y0` (n,), flat; `record`: True to write the history that reverse mode needs.
    """
    plan, control, is_adaptive = run.plan, run.control, isinstance(run.control, AdaptiveSteps)
    start, end, count = ts[0], ts[-1], ts.shape[0] - 1
    eps, none, no = float(jnp.finfo(ts.dtype).eps), jnp.zeros((), jnp.int32), jnp.asarray(False)
    floor = end - _ROUNDED * eps / 2 * jnp.abs(end)
    # Fixed steps have no tolerances: zeros keep one structure of the loop's constants.
    rtol, atol = (jnp.zeros_like(start) if x is None else x for x in (run.rtol, run.atol))
    rate, length, quality, guard = _begin(plan, control, args, start, end, y0, rtol, atol)
    steps = none
    if not is_adaptive:
        length, steps = run.stepsize, number_of_steps(start, end, run.stepsize)
    least_at_end = 16 * eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    limits = _Limits(start, end, floor, least_at_end, steps, rtol, atol, y0)
    sums = no_sums(plan.structure(y0))
    guard = None if plan.guard is None else _Guard(guard, guard < 0)
    state = _State(
        start, jnp.minimum(start + length, end), y0, rate, no, none, none, no, quality, quality == 0, sums, guard
    )
    # What is not reached stays infinite, which tells it from rows that are computed.
    rows = jnp.broadcast_to(jnp.full_like(y0, jnp.inf), (count, y0.size))
    history = reverse.blank(y0, start, max_steps) if record else None
    records, strides = ((), ()) if history is None else (history.rows, history.strides)
    static, given = (plan, control, max_steps, strides), Given(ts)
    task = Task(_iterate, _iterate_in_jax, static, dense_output, (plan,), strides)
    state, saved, rows, records = reverse.run_to_end(
        lambda carry: run_loop(task, args, limits, given, carry),
        partial(_iterate_once, *static, args, limits, given),
        # A step that the kernel cannot compute is computed by JAX, and the native loop continues behind it.
        partial(_iterate_once, *static, args, limits, given, advance=_advance_by_fallback),
        partial(_is_running, max_steps, limits),
        Carry(state, none, rows, records),
    )
    if plan.guard is not None:
        state, rows, records = _end_at_root(plan, args, ts, strides, Carry(state, saved, rows, records))
    if history is not None:
        states, times, kept = records
        history = reverse.History(states, times, kept, state.tried)
    codes: Any = diffrax.RESULTS
    result = codes.where(state.t < end, codes.max_steps_reached, codes.successful)
    result = codes.where(state.failed, codes.dt_min_reached, result)
    stopped = state.stopped if state.guard is None else state.stopped | state.guard.crossed
    result = codes.where(stopped, codes.event_occurred, result)
    facts = result, step_counts(state.tried, state.accepted), state.t
    return rows, state.y, facts, None if is_adaptive else state.sums, history


def step_counts(tried, accepted) -> dict[str, Array]:
    """Counts of steps, by diffrax's names."""
    return {"num_steps": tried, "num_accepted_steps": accepted, "num_rejected_steps": tried - accepted}


def _is_active(max_steps: int, limits: _Limits, state: _State):
    active = (state.t < limits.end) & ~state.failed & ~state.stopped & (state.tried < max_steps)
    return active if state.guard is None else active & ~state.guard.crossed


def _is_running(max_steps: int, limits: _Limits, carry: Carry):
    return any_sample(_is_active(max_steps, limits, carry.state))


def _iterate(plan: Plan, control, max_steps: int, strides, args, limits: _Limits, state: _State, _) -> Iteration:
    """Make a step, in a native loop."""
    active = _is_active(max_steps, limits, state)
    after, kept, step = _advance(plan, control, args, limits, state, active)
    dense = state.t, after.t, state.y, step.raw, step.stages, step.shift
    row = reverse.row(state.y, state.t, state.t_next, kept) if strides else ()
    more = _is_active(max_steps, limits, after)
    return Iteration(after, active, more, Passed(kept, after.t, dense), state.tried, row)


def _iterate_once(
    plan: Plan, control, max_steps: int, strides, args, limits: _Limits, given: Given, carry: Carry, advance=None
) -> Carry:
    """Make a step, as operations of JAX around kernels; by `advance` (default: `_advance_by_kernel`)."""
    state, records = carry.state, carry.records
    active = _is_active(max_steps, limits, state)
    after, kept, step = (advance or _advance_by_kernel)(plan, control, args, limits, state, active)
    if records:
        row = reverse.row(state.y, state.t, state.t_next, kept)
        records = reverse.write(records, strides, row, state.tried, active)
    return Carry(after, *save(plan, given.times, state, after, kept, step, carry.saved, carry.rows), records)


def _iterate_in_jax(plan: Plan, control, max_steps: int, strides, args, limits: _Limits, given: Given, carry: Carry):
    """All steps, as operations of JAX around kernels."""
    step_on = partial(_iterate_once, plan, control, max_steps, strides, args, limits, given)
    return lax.while_loop(partial(_is_running, max_steps, limits), step_on, carry)


def number_of_steps(start, end, stepsize):
    """Number of fixed steps, as counted by diffrax's `ConstantStepSize`."""
    return jnp.ceil((end - start) / jnp.nextafter(stepsize, jnp.inf)).astype(jnp.int32)


def _advance(plan: Plan, control, args, limits: _Limits, state: _State, active):
    """State after a step, whether the step is kept, and the step."""
    step = take_step(plan, args, state.t, jnp.where(active, state.t_next, state.t), state.y, state.rate)
    return *_accept(plan, control, args, limits, state, active, step), step


def _advance_by_kernel(plan: Plan, control, args, limits: _Limits, state: _State, active):
    advance: Any = kernel(_advance, static=2, fallback=_advance, derivative=False)
    return advance(plan, control, args, limits, state, active, where=active)


def _advance_by_fallback(plan: Plan, control, args, limits: _Limits, state: _State, active):
    """State after a step that the native loop has refused, for every trajectory that is active."""
    none, stages = jnp.zeros_like(state.y), jnp.zeros((plan.count, state.y.size), state.y.dtype)
    unchanged = state, jnp.zeros_like(active), Step(none, none, none, none, stages, none)
    return compute_where(active, partial(_advance, plan, control), unchanged, (args, limits, state, active))


def _accept(plan: Plan, control, args, limits: _Limits, state: _State, active, step: Step) -> tuple[_State, Array]:
    """State after a step that is kept or refused, and whether it is kept."""
    t_next, end = jnp.where(active, state.t_next, state.t), limits.end
    if isinstance(control, AdaptiveSteps):
        kept, t, after, at_least, failed = _control_step(plan, control, limits, state, t_next, step)
        sums = state.sums
    else:
        kept, t, at_least, failed = jnp.asarray(True), t_next, state.at_least, jnp.asarray(False)
        start, before, y, error = (plan.structure(x) for x in (limits.y0, state.y, step.projected, step.error))
        sums = add_error(control.order, control.error_order, start, before, y, error, *state.sums)
        # From the start of the run, as sums of lengths would carry their rounding on.
        done = (state.tried + 2).astype(end.dtype) / limits.steps.astype(end.dtype)
        after = limits.start + (end - limits.start) * done
        after = jnp.where((state.tried + 2 >= limits.steps) | (after > limits.floor), end, after)
    guard = state.guard
    if guard is not None:
        value = plan.guard_of(args, t_next, step.projected)
        crossed = active & kept & (value < 0)
        # The state stays where the last step ended, and the length of the next one is found behind the loop.
        kept, active = kept & ~crossed, active & ~crossed
        guard = _Guard(jnp.where(kept & active, value, guard.value), guard.crossed | crossed)
    # What follows is masked by `active`: a trajectory that has ended keeps its state while others of the batch continue.
    kept, one = kept & active, active.astype(jnp.int32)
    quality = jnp.where(kept, plan.quality_of(args, t_next, step.projected), state.quality)
    state = _State(
        jnp.where(active, t, state.t),
        jnp.where(active, jnp.minimum(after, end), state.t_next),
        jnp.where(kept, step.projected, state.y),
        jnp.where(kept, step.rate, state.rate),
        at_least,
        state.tried + one,
        state.accepted + kept.astype(jnp.int32),
        state.failed | (failed & active),
        quality,
        state.stopped | (quality * state.quality <= 0),
        jax.tree.map(lambda new, old: jnp.where(active, new, old), sums, state.sums),
        guard,
    )
    return state, kept


def _probe(plan: Plan, args, t0, t1, y, rate):
    """A step, and the guard at its end."""
    step = take_step(plan, args, t0, t1, y, rate)
    return step, plan.guard_of(args, t1, step.projected)


def _end_at_root(plan: Plan, args, ts, strides, carry: Carry):
    """State, rows and records of a run whose guard has become negative: its last step ends at the root."""
    state, guard, eps = carry.state, carry.state.guard, float(jnp.finfo(ts.dtype).eps)
    # A start behind the root is the end.
    ends = guard.crossed & (guard.value >= 0)

    def probe(t1):
        step: Any = kernel(_probe, static=1, fallback=_probe, derivative=False)
        return step(plan, args, state.t, jnp.where(ends, t1, state.t), state.y, state.rate)

    step, value = probe(state.t_next)
    scale = jnp.maximum(jnp.maximum(jnp.abs(guard.value), jnp.abs(value)), float(jnp.finfo(ts.dtype).tiny))
    size = jnp.maximum(jnp.abs(state.t_next), state.t_next - state.t)

    def is_open(carry):
        return ends & ~carry[0].is_narrow(size)

    def narrow(carry):
        bracket, step = carry
        is_searching, t1 = is_open(carry), bracket.next()
        new, value = probe(t1)
        value = (value / scale).astype(ts.dtype)
        behind = is_searching & (value < 64 * eps)
        bracket = bracket.narrow(t1, value, is_searching & ~behind, behind)
        # Zero up to rounding is the root.
        bracket = bracket._replace(low=jnp.where(behind & (value > -64 * eps), t1, bracket.low))
        return bracket, jax.tree.map(lambda a, b: jnp.where(behind, a, b), new, step)

    values = ((x / scale).astype(ts.dtype) for x in (guard.value, value))
    bracket, step = while_loop(is_open, narrow, (Bracket.begin(state.t, state.t_next, *values), step))
    one = ends.astype(jnp.int32)
    after = state._replace(
        t=jnp.where(ends, bracket.high, state.t),
        y=jnp.where(ends, step.projected, state.y),
        tried=state.tried + one,
        accepted=state.accepted + one,
    )
    _, rows = save(plan, ts, state, after, ends, step, carry.saved, carry.rows)
    row = reverse.row(state.y, state.t, after.t, ends)
    return after, rows, reverse.write(carry.records, strides, row, state.tried, ends) if strides else ()


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
    """Rate of change at the start, if steps reuse it, the length of the first adaptive step, the quality, and the guard."""
    rate, monitors = plan.first_rate(args, t0, y), (plan.quality_of(args, t0, y), plan.guard_of(args, t0, y))
    if not isinstance(control, AdaptiveSteps):
        return rate, t1 - t0, *monitors
    term = diffrax.ODETerm(plan.field)
    length = first_step(term, t0, t1, plan.structure(y), args, control.order, rtol, atol, control.size)
    return rate, jnp.where(jnp.isfinite(length), length, t1 - t0), *monitors


def _control_step(plan: Plan, control: AdaptiveSteps, limits: _Limits, state: _State, t1, step: Step):
    """Decide whether a step is kept, where the next one begins and ends, and whether that has the least length or failed."""
    t0, end = state.t, limits.end
    ends = (plan.structure(x) for x in (state.y, step.projected, step.error))
    size = error_size(control.size, *ends, limits.rtol, limits.atol)
    kept, length, at_least, failed = next_step(
        size, control.order, t1 - t0, state.at_least, least_step(t0, limits.least_at_end)
    )
    t = jnp.where(kept, t1, t0)
    following = t + length
    # A step that would end within rounding of the end goes there; a refused one tries half of the way.
    clipped = jnp.where(kept, end, t + 0.5 * (end - t))
    following = jnp.where(following > limits.floor, clipped, following)
    return kept, jnp.minimum(t, end), following, at_least, failed
