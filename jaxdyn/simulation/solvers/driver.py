"""Explicit steps one after the other, as one loop around kernels: what diffrax does for them, in a program that compiles in
a second.

The rules are diffrax's: the step-size control is that of its `PIDController` with an integral part alone, and fixed steps are
those of its `ConstantStepSize`. Lanes of a batch that have ended take steps of no length until the last one has ended.

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
from jaxdyn.simulation.solvers.explicit import Plan, Step, projected_output, step_in_turn, whole_step
from jaxdyn.simulation.solvers.first_step import first_step
from jaxdyn.simulation.solvers.fixed_steps import accumulated, no_sums
from jaxdyn.simulation.solvers.repeated import repeated_rows

_SAFETY, _LEAST_FACTOR, _MOST_FACTOR = 0.9, 0.2, 10.0  # of diffrax's PIDController
_ROUNDED = 100  # numbers before the end from which on a step goes to the end


class Adaptive(NamedTuple):
    """Steps that keep a tolerance: order of the error estimate, and the size of a scaled error."""

    order: Any
    size: Any


class Fixed(NamedTuple):
    """Steps of one length: orders of the method and of its error estimate."""

    order: Any
    error_order: Any


class Driven(NamedTuple):
    """Rows of the state at ts[1:], diffrax's result, counts, the time reached, sums about fixed steps (`accumulated`), and, where
    asked for, what reverse mode needs."""

    rows: Array
    result: Any
    counts: dict[str, Array]
    reached: Array
    sums: tuple[Array, Array] | None
    history: reverse.History | None


class Drive(eqx.Module):
    """How a run is made: drive(y0, args, ts) -> rows of the state at ts[1:]; result, counts and time reached; sums.

    - `plan`, `how`: the steps and their control; `structure(y)`: the state of a vector.
    - `rtol`, `atol`, for adaptive steps; `stepsize` (s), for fixed ones.
    - `max_steps`; `room`, the most where reverse mode comes through.

    Steps are constants to reverse mode, but that they begin and end with the run; tolerances and `stepsize` too.
    """

    plan: Plan = eqx.field(static=True)
    how: Adaptive | Fixed = eqx.field(static=True)
    rtol: Any
    atol: Any
    stepsize: Any
    max_steps: int = eqx.field(static=True)
    room: int = eqx.field(static=True)

    def __call__(self, y0, args, ts):
        return _driven((y0, args, ts), jax.lax.stop_gradient(self))

    def direct(self, y0, args, ts):
        """The same, with derivatives of any order in both modes, which go through the steps taken again (see `repeated`)."""
        return self.with_history((y0, args, ts), self.room)[0]

    def with_history(self, moving, room: int | None):
        """What a call returns, and the `History` of at most `room` steps, or None."""
        return _with_history(moving, jax.lax.stop_gradient(self), room)

    def driven(self, moving, room: int | None):
        """The same without derivatives."""
        y0, args, ts = moving
        most = self.max_steps if room is None else room
        steps = self.rtol, self.atol, self.stepsize
        driven = drive(self.plan, self.how, ravel_pytree(y0)[0], args, ts, *steps, most, room is not None)
        rows = jax.vmap(self.plan.structure)(driven.rows)
        return (rows, (driven.result, driven.counts, driven.reached), driven.sums), driven.history

    def number_of_steps(self, ts):
        """Of fixed ones, or None."""
        return None if isinstance(self.how, Adaptive) else number_of_steps(ts[0], ts[-1], self.stepsize)

    def pulled(self, moving, rows, history, perturbed):
        """Cotangents of what moves from those of the rows, by kernels."""
        y0, args, ts = moving
        flat = jax.vmap(lambda y: ravel_pytree(y)[0])(rows)
        start, structure = ravel_pytree(y0)
        of_y, of_args, of_ts = reverse.pulled(
            self.plan, history, start, args, ts, self.number_of_steps(ts), flat, perturbed[1:]
        )

        def or_none(x, varies):
            return x if varies else None

        return jax.tree.map(or_none, structure(of_y), perturbed[0]), of_args, or_none(of_ts, perturbed[2])

    def repeated(self, history, moving):
        """Rows of the state at ts[1:] by the steps of a history, differentiable to any order."""
        y0, args, ts = moving
        steps = self.number_of_steps(ts)
        rows = repeated_rows(
            self.plan, history.times, history.kept, history.count, ravel_pytree(y0)[0], args, ts, steps
        )
        return jax.vmap(self.plan.structure)(rows)


@eqx.filter_custom_vjp
def _driven(moving, how: Drive):
    return how.with_history(moving, None)[0]


@_driven.def_fwd
def _(perturbed, moving, how: Drive):
    return how.with_history(moving, how.room)


@_driven.def_bwd
def _(history, gradients, perturbed, moving, how: Drive):
    count = moving[2].shape[0] - 1
    rows = jax.tree.map(lambda y, g: jnp.zeros((count, *y.shape), y.dtype) if g is None else g, moving[0], gradients[0])
    return _pulled((moving, rows), jax.lax.stop_gradient(history), how, perturbed)


@eqx.filter_custom_jvp
def _with_history(moving, how: Drive, room: int | None):
    return how.driven(moving, room)


@_with_history.def_jvp
def _(primals, tangents):
    moving, how, room = primals
    driven, history = _with_history(moving, how, how.room if room is None else room)
    _, rows = eqx.filter_jvp(partial(how.repeated, jax.lax.stop_gradient(history)), (moving,), (tangents[0],))
    values = driven, None if room is None else history
    still = jax.tree.map(lambda _: None, values)
    return values, ((rows, *still[0][1:]), still[1])


@eqx.filter_custom_jvp
def _pulled(given, history, how: Drive, perturbed):
    moving, rows = given
    return how.pulled(moving, rows, history, perturbed)


@_pulled.def_jvp
def _(primals, tangents):
    given, history, how, perturbed = primals

    def pulled(given):
        moving, rows = given
        free, fixed = eqx.partition(moving, perturbed)
        _, pull = jax.vjp(lambda free: how.repeated(history, eqx.combine(free, fixed)), free)
        return pull(rows)[0]

    _, change = eqx.filter_jvp(pulled, (given,), (tangents[0],))
    return _pulled(*primals), change


class _Limits(NamedTuple):
    """Numbers that do not change on the way: the ends of the run, from where on a step goes to the end, and what sets its
    length."""

    start: Array
    end: Array
    floor: Array
    least_at_end: Array
    steps: Array
    rtol: Array
    atol: Array
    y0: Array


class _Lane(NamedTuple):
    """Where a run is: the next step goes from t to t_next, from the state y with the rate of change `rate`."""

    t: Array
    t_next: Array
    y: Array
    rate: Array
    at_least: Array  # whether the step has the least length
    taken: Array
    kept: Array
    failed: Array
    quality: Array  # where the method may fail on the way (`Plan.quality`), else one
    stopped: Array  # whether that has changed its sign
    sums: tuple[Array, Array]


def drive(
    plan: Plan, how: Adaptive | Fixed, y0, args, ts, rtol, atol, stepsize, max_steps: int, record: bool
) -> Driven:
    """The solution from ts[0] to ts[-1].

    **Arguments:** `y0` (n,), flat; `stepsize` (s) for `Fixed`, else None; tolerances for `Adaptive`; `record`: whether to write
    down what reverse mode needs.
    """
    start, end, count = ts[0], ts[-1], ts.shape[0] - 1
    eps, none = float(jnp.finfo(ts.dtype).eps), jnp.zeros((), jnp.int32)
    floor = end - _ROUNDED * eps / 2 * jnp.abs(end)
    rtol, atol = (jnp.zeros_like(start) if x is None else x for x in (rtol, atol))
    rate, length, quality = _begin(plan, how, args, start, end, y0, rtol, atol)
    steps = none
    if not isinstance(how, Adaptive):
        length = stepsize
        steps = number_of_steps(start, end, stepsize)
    least_at_end = 16 * eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    limits = _Limits(start, end, floor, least_at_end, steps, rtol, atol, y0)
    no = jnp.asarray(False)
    sums = no_sums(plan.structure(y0))
    lane = _Lane(start, jnp.minimum(start + length, end), y0, rate, no, none, none, no, quality, quality == 0, sums)
    rows = jnp.broadcast_to(jnp.full_like(y0, jnp.inf), (count, y0.size))
    history = reverse.blank(y0, start, max_steps) if record else None
    records, strides = ((), ()) if history is None else (history.rows, history.strides)
    carry = Carry(lane, none, rows, records)
    how_far = plan, how, max_steps, strides
    task, given = Task(_turn, _by_turns, how_far, projected_output, (plan,), strides), Given(ts)

    unfinished = partial(_is_unfinished, max_steps, limits)
    after = run_loop(task, args, limits, given, carry)
    if after is None:
        carry = _by_turns(*how_far, args, limits, given, carry)
    else:
        carry, always_ends = after
        if not always_ends:  # but where a step wants more care than machine code takes: then that one, and on
            step_on = partial(_by_turn, *how_far, args, limits, given, advance=_advanced_with_care)
            run_on: Any = partial(run_loop, task, args, limits, given)
            carry = lax.while_loop(unfinished, lambda carry: run_on(step_on(carry))[0], carry)
    lane, rows = carry.state, carry.rows
    if history is not None:
        states, times, kept = carry.records
        history = reverse.History(states, times, kept, lane.taken)
    codes: Any = diffrax.RESULTS
    result = codes.where(lane.t < end, codes.max_steps_reached, codes.successful)
    result = codes.where(lane.failed, codes.dt_min_reached, result)
    result = codes.where(lane.stopped, codes.event_occurred, result)
    counts = {"num_steps": lane.taken, "num_accepted_steps": lane.kept, "num_rejected_steps": lane.taken - lane.kept}
    return Driven(rows, result, counts, lane.t, None if isinstance(how, Adaptive) else lane.sums, history)


def _is_active(max_steps: int, limits: _Limits, lane: _Lane):
    return (lane.t < limits.end) & ~lane.failed & ~lane.stopped & (lane.taken < max_steps)


def _is_unfinished(max_steps: int, limits: _Limits, carry: Carry):
    return any_sample(_is_active(max_steps, limits, carry.state))


def _turn(plan: Plan, how, max_steps: int, strides, args, limits: _Limits, lane: _Lane, _) -> Iteration:
    """A step, for a loop in machine code."""
    active = _is_active(max_steps, limits, lane)
    after, kept, step = _advance(plan, how, args, limits, lane, active)
    dense = lane.t, after.t, lane.y, step.raw, step.stages, step.shift
    written = reverse.row(lane.y, lane.t, lane.t_next, kept) if strides else ()
    more = _is_active(max_steps, limits, after)
    return Iteration(after, active, more, Passed(kept, after.t, dense), lane.taken, written)


def _by_turn(
    plan: Plan, how, max_steps: int, strides, args, limits: _Limits, given: Given, carry: Carry, advance=None
) -> Carry:
    """A step, as operations of JAX around kernels; by `advance` (default: `_advanced`)."""
    lane = carry.state
    active = _is_active(max_steps, limits, lane)
    after, kept, step = (advance or _advanced)(plan, how, args, limits, lane, active)
    records = carry.records
    if records:
        new = reverse.row(lane.y, lane.t, lane.t_next, kept)
        records = reverse.written(records, strides, new, lane.taken, active)
    return Carry(after, *save(plan, given.times, lane, after, kept, step, carry.saved, carry.rows), records)


def _by_turns(plan: Plan, how, max_steps: int, strides, args, limits: _Limits, given: Given, carry: Carry) -> Carry:
    """All steps, as operations of JAX around kernels."""
    step_on = partial(_by_turn, plan, how, max_steps, strides, args, limits, given)
    return lax.while_loop(partial(_is_unfinished, max_steps, limits), step_on, carry)


def number_of_steps(start, end, stepsize):
    """Of fixed ones: see diffrax's `ConstantStepSize`."""
    return jnp.ceil((end - start) / jnp.nextafter(stepsize, jnp.inf)).astype(jnp.int32)


def _advanced(plan: Plan, how, args, limits: _Limits, lane: _Lane, active) -> tuple[_Lane, Array, Step]:
    """The lane after a step, whether that is kept, and the step; all of it one kernel where it is numbers."""
    advance: Any = kernel(_advance, static=2, fallback=_advance_in_turn, derivative=False)
    return advance(plan, how, args, limits, lane, active, where=active)


def _advanced_with_care(plan: Plan, how, args, limits: _Limits, lane: _Lane, active) -> tuple[_Lane, Array, Step]:
    """The same where machine code has failed the step of every lane that is active."""
    none, stages = jnp.zeros_like(lane.y), jnp.zeros((plan.count, lane.y.size), lane.y.dtype)
    unchanged = lane, jnp.zeros_like(active), Step(none, none, none, none, stages, none)
    return compute_where(active, partial(_advance_in_turn, plan, how), unchanged, (args, limits, lane, active))


def _advance(plan: Plan, how, args, limits: _Limits, lane: _Lane, active):
    step = whole_step(plan, args, lane.t, jnp.where(active, lane.t_next, lane.t), lane.y, lane.rate)
    return *_accepted(plan, how, args, limits, lane, active, step), step


def _advance_in_turn(plan: Plan, how, args, limits: _Limits, lane: _Lane, active):
    """The same, one stage after the other."""
    step = step_in_turn(plan, args, lane.t, jnp.where(active, lane.t_next, lane.t), lane.y, lane.rate)
    return *_accepted(plan, how, args, limits, lane, active, step), step


def _accepted(plan: Plan, how, args, limits: _Limits, lane: _Lane, active, step: Step) -> tuple[_Lane, Array]:
    """The lane after a step that is kept or refused."""
    t_next, end = jnp.where(active, lane.t_next, lane.t), limits.end
    if isinstance(how, Adaptive):
        kept, t, after, at_least, failed = _controlled(plan, how, limits, lane, t_next, step)
        sums = lane.sums
    else:
        kept, t, at_least, failed = jnp.asarray(True), t_next, lane.at_least, jnp.asarray(False)
        start, before, y, error = (plan.structure(x) for x in (limits.y0, lane.y, step.projected, step.error))
        sums = accumulated(how.order, how.error_order, start, before, y, error, *lane.sums)
        done = (lane.taken + 2).astype(end.dtype) / limits.steps.astype(end.dtype)
        after = limits.start + (end - limits.start) * done
        after = jnp.where((lane.taken + 2 >= limits.steps) | (after > limits.floor), end, after)
    kept, one = kept & active, active.astype(jnp.int32)
    quality = jnp.where(kept, plan.quality_of(args, t_next, step.projected), lane.quality)
    lane = _Lane(
        jnp.where(active, t, lane.t),
        jnp.where(active, jnp.minimum(after, end), lane.t_next),
        jnp.where(kept, step.projected, lane.y),
        jnp.where(kept, step.rate, lane.rate),
        at_least,
        lane.taken + one,
        lane.kept + kept.astype(jnp.int32),
        lane.failed | (failed & active),
        quality,
        lane.stopped | (quality * lane.quality <= 0),
        jax.tree.map(lambda new, old: jnp.where(active, new, old), sums, lane.sums),
    )
    return lane, kept


def save(plan: Plan, ts, before: Any, after: Any, kept, step: Step, saved, rows):
    """How many save points have been passed, and their rows."""
    count = ts.shape[0] - 1

    def is_passed(saved):
        return kept & (saved < count) & (ts[jnp.minimum(saved + 1, count)] <= after.t)

    def body(carry):
        saved, rows = carry
        here, place = is_passed(saved), jnp.minimum(saved, count - 1)
        at = ts[place + 1], before.t, after.t, before.y, step.raw, step.stages, step.shift
        row = kernel(projected_output, static=1)(plan, None, *at)
        rows = rows.at[place].set(jnp.where(here, row, rows[place]))
        return saved + here.astype(jnp.int32), rows

    return while_loop(lambda carry: is_passed(carry[0]), body, (saved, rows))


@kernel(static=2, derivative=False)
def _begin(plan: Plan, how, args, t0, t1, y, rtol, atol):
    """The rate of change at the start, if steps pass it on, the length of the first adaptive step, and the quality."""
    rate = plan.field_of(args, t0, y) if plan.passes_rate_on else jnp.zeros_like(y)
    quality = plan.quality_of(args, t0, y)
    if not isinstance(how, Adaptive):
        return rate, t1 - t0, quality
    term = diffrax.ODETerm(plan.field)
    length = first_step(term, t0, t1, plan.structure(y), args, how.order, rtol, atol, how.size)
    return rate, jnp.where(jnp.isfinite(length), length, t1 - t0), quality


def _controlled(plan: Plan, how: Adaptive, limits: _Limits, lane: _Lane, t1, step: Step):
    """Whether a step is kept, where the next one begins and ends, whether it has the least length, and whether that is too
    long."""
    t0, end = lane.t, limits.end
    before, after = plan.structure(lane.y), plan.structure(step.projected)

    def scaled(y0, y1, error):
        y1 = jnp.where(jnp.isnan(y1).any(), y0, y1)
        return error / (limits.atol + limits.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y1)))

    size = how.size(jax.tree.map(scaled, before, after, plan.structure(step.error)))
    kept = (size < 1) | lane.at_least
    factor = _SAFETY * (1 / size) ** (1 / how.order)
    factor = jnp.where(jnp.isnan(factor), _LEAST_FACTOR, factor)
    factor = jnp.clip(factor, jnp.where(kept, 1.0, _LEAST_FACTOR), jnp.where(kept, _MOST_FACTOR, _SAFETY))
    length = (t1 - t0) * factor.astype(t0.dtype)
    eps = float(jnp.finfo(t0.dtype).eps)
    least = jnp.clip(16 * eps * jnp.abs(t0), eps * limits.least_at_end, limits.least_at_end)
    failed = length < least
    length = jnp.where(lane.at_least & (factor == 1), least, length)
    at_least, length = length <= least, jnp.maximum(length, least)
    t = jnp.where(kept, t1, t0)
    following = t + length
    clipped = jnp.where(kept, end, t + 0.5 * (end - t))
    following = jnp.where(following > limits.floor, clipped, following)
    return kept, jnp.minimum(t, end), following, at_least, failed
