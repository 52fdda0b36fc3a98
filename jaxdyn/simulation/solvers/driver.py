"""Integration by explicit steps, as one loop around kernels: diffrax's rules in a program that compiles in a second.

The step-size control is that of diffrax's `PIDController` with an integral part alone, and fixed steps are those of its
`ConstantStepSize`. Trajectories of a batch that have ended take steps of no length until the last one has ended.

Reverse mode goes back through the same steps (see `reverse`).
"""

from collections.abc import Callable
from functools import lru_cache, partial
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
from jaxdyn.simulation.solvers.step_control import add_error, first_step, least_step, no_sums, step_factor

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
    """Integrator by explicit steps: call(y0, args, ts) -> rows of the state at ts[1:]; result, counts, time reached; sums.

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
        most, flat = self.max_steps if room is None else room, ravel_pytree(y0)[0]
        # Of one step that is kept in any case the inputs tell the history: where reverse mode computes a run again for its
        # history alone, this one is left out.
        is_told = room == 1 and self.plan.quality is None and isinstance(self.control, FixedSteps)
        rows, facts, sums, history = _run_steps(self, flat, args, ts, most, room is not None and not is_told)
        if is_told:
            history = reverse.of_one_step(flat, ts[0], jnp.minimum(ts[0] + self.stepsize, ts[-1]))
        return (jax.vmap(self.plan.structure)(rows), facts, sums), history

    def number_of_steps(self, ts):
        """Number of fixed steps, or None."""
        return None if isinstance(self.control, AdaptiveSteps) else number_of_steps(ts[0], ts[-1], self.stepsize)

    def replay(self, history, inputs, direct):
        y0, args, ts = inputs
        rows = reverse.replay_rows(self.plan, history, ravel_pytree(y0)[0], args, ts, self.number_of_steps(ts))
        return (jax.vmap(self.plan.structure)(rows),)

    def weights(self, inputs, gradients, history):
        return (zeros_or(gradients[0], inputs[0], inputs[2].shape[0] - 1),)

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs by kernels."""
        y0, args, ts = inputs
        flat = jax.vmap(lambda y: ravel_pytree(y)[0])(weights[0])
        start, structure = ravel_pytree(y0)
        of_y, of_args, of_ts = reverse.pull(
            self.plan, history, start, args, ts, self.number_of_steps(ts), flat, perturbed[1:]
        )

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


def _run_steps(run: ExplicitRun, y0, args, ts, max_steps: int, record: bool):
    """Rows (nt - 1, n) at ts[1:]; diffrax's result, counts and time reached; sums (`add_error`); a `History` or None.

    **Arguments:** `y0` (n,), flat; `record`: True to write the history that reverse mode needs.
    """
    plan, control, is_adaptive = run.plan, run.control, isinstance(run.control, AdaptiveSteps)
    start, end, count = ts[0], ts[-1], ts.shape[0] - 1
    eps, none, no = float(jnp.finfo(ts.dtype).eps), jnp.zeros((), jnp.int32), jnp.asarray(False)
    floor = end - _ROUNDED * eps / 2 * jnp.abs(end)
    # Fixed steps have no tolerances: zeros keep one structure of the loop's constants.
    rtol, atol = (jnp.zeros_like(start) if x is None else x for x in (run.rtol, run.atol))
    rate, length, quality = _begin(plan, control, args, start, end, y0, rtol, atol)
    steps = none
    if not is_adaptive:
        length, steps = run.stepsize, number_of_steps(start, end, run.stepsize)
    least_at_end = 16 * eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    limits = _Limits(start, end, floor, least_at_end, steps, rtol, atol, y0)
    sums = no_sums(plan.structure(y0))
    state = _State(start, jnp.minimum(start + length, end), y0, rate, no, none, none, no, quality, quality == 0, sums)
    # What is not reached stays infinite, which tells it from rows that are computed.
    rows = jnp.broadcast_to(jnp.full_like(y0, jnp.inf), (count, y0.size))
    history = reverse.blank(y0, start, max_steps) if record else None
    records, strides = ((), ()) if history is None else (history.rows, history.strides)
    static, given = (plan, control, max_steps, strides), Given(ts)
    task = Task(_iterate, _iterate_in_jax, static, dense_output, (plan,), strides)
    state, _, rows, records = reverse.run_to_end(
        lambda carry: run_loop(task, args, limits, given, carry),
        partial(_iterate_once, *static, args, limits, given),
        # A step that the kernel cannot compute is computed by JAX, and the native loop continues behind it.
        partial(_iterate_by_fallback(*static), args, limits, given),
        partial(_is_running, max_steps, limits),
        Carry(state, none, rows, records),
    )
    if history is not None:
        states, times, kept = records
        history = reverse.History(states, times, kept, state.tried)
    codes: Any = diffrax.RESULTS
    result = codes.where(state.t < end, codes.max_steps_reached, codes.successful)
    result = codes.where(state.failed, codes.dt_min_reached, result)
    result = codes.where(state.stopped, codes.event_occurred, result)
    facts = result, step_counts(state.tried, state.accepted), state.t
    return rows, facts, None if is_adaptive else state.sums, history


def step_counts(tried, accepted) -> dict[str, Array]:
    """Counts of steps, by diffrax's names."""
    return {"num_steps": tried, "num_accepted_steps": accepted, "num_rejected_steps": tried - accepted}


def _is_active(max_steps: int, limits: _Limits, state: _State):
    return (state.t < limits.end) & ~state.failed & ~state.stopped & (state.tried < max_steps)


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


@lru_cache(maxsize=256)
def _iterate_by_fallback(plan: Plan, control, max_steps: int, strides) -> Callable:
    # Under `jit`, as JAX traces a run several times where it is differentiated: this long part of it once.
    return jax.jit(partial(_iterate_once, plan, control, max_steps, strides, advance=_advance_by_fallback))


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
    )
    return state, kept


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
    """Rate of change at the start, if steps reuse it, the length of the first adaptive step, and the quality."""
    rate, quality = plan.first_rate(args, t0, y), plan.quality_of(args, t0, y)
    if not isinstance(control, AdaptiveSteps):
        return rate, t1 - t0, quality
    term = diffrax.ODETerm(plan.field)
    length = first_step(term, t0, t1, plan.structure(y), args, control.order, rtol, atol, control.size)
    return rate, jnp.where(jnp.isfinite(length), length, t1 - t0), quality


def _control_step(plan: Plan, control: AdaptiveSteps, limits: _Limits, state: _State, t1, step: Step):
    """Decide whether a step is kept, where the next one begins and ends, and whether that has the least length or failed."""
    t0, end = state.t, limits.end
    before, after = plan.structure(state.y), plan.structure(step.projected)

    def scale(y0, y1, error):
        # As in diffrax: a result of NaN is measured by the size of the start.
        y1 = jnp.where(jnp.isnan(y1).any(), y0, y1)
        return error / (limits.atol + limits.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1)))

    size = control.size(jax.tree.map(scale, before, after, plan.structure(step.error)))
    kept = (size < 1) | state.at_least
    factor = step_factor(size, control.order, kept)
    length, least = (t1 - t0) * factor.astype(t0.dtype), least_step(t0, limits.least_at_end)
    failed = length < least
    length = jnp.where(state.at_least & (factor == 1), least, length)
    at_least, length = length <= least, jnp.maximum(length, least)
    t = jnp.where(kept, t1, t0)
    following = t + length
    # A step that would end within rounding of the end goes there; a refused one tries half of the way.
    clipped = jnp.where(kept, end, t + 0.5 * (end - t))
    following = jnp.where(following > limits.floor, clipped, following)
    return kept, jnp.minimum(t, end), following, at_least, failed
