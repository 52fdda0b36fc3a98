"""Integration by explicit steps, as one loop around kernels: diffrax's rules in a program that compiles in a second.

A step at whose end a guard is negative is repeated with a shorter length, until its end is the root (`guards`). There the loop
ends: with the run, or until a reset map has set the state behind the event (`hybrid.event_loop`).
Trajectories of a batch that have ended take steps of no length until the last one has ended.

Reverse mode goes back through the same steps (see `reverse`): the forward run records their ends, so that nothing is left to
decide on the way back, which has no error estimates and no refused steps either.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxdyn.compile import kernel, reverse_only
from jaxdyn.compile.kernels import Carry, Given, Iteration, Passed, Task, run_loop
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.simulation.solvers import reverse
from jaxdyn.simulation.solvers.base import (
    NextStep,
    add_error,
    error_size,
    first_step,
    min_step,
    next_step,
    no_sums,
    too_coarse,
)
from jaxdyn.simulation.solvers.guards import Point, Search, look_within, search_root
from jaxdyn.simulation.solvers.steps import Plan, Step, dense_output, take_step

# Counts of steps, by diffrax's names.
COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")
ROOM = 4096  # steps that are recorded where the user gives no limit: 32 kB a trajectory
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


def step_control(solver: Any, stepsize, norm: Callable = optimistix.rms_norm) -> AdaptiveSteps | FixedSteps:
    """Control of the steps of a method: of this length, or adaptive ones for None."""
    order, error_order = solver.order(None), solver.error_order(None)
    return AdaptiveSteps(error_order, norm) if stepsize is None else FixedSteps(order, error_order)


class Limits(NamedTuple):
    """Constants of a run: its ends, the time from which a step goes to the end, and what sets the length of steps.

    Fixed steps of a length h end at min(start + k h, end): the last one may be shorter.
    """

    start: Array
    end: Array
    floor: Array
    min_at_end: Array
    length: Array  # of fixed steps
    rtol: Array
    atol: Array
    y0: Array


class State(NamedTuple):
    """State of a run: the next step goes from t to t_next, from the state y with the rate of change `rate`."""

    t: Array
    t_next: Array
    y: Array
    rate: Array
    is_shortest: Array  # true for a step of the least length, which is kept whatever its error
    tried: Array  # steps
    accepted: Array  # steps
    failed: Array
    quality: Array  # of the state if the method may fail on the way (`Plan.quality`), else one
    stopped: Array  # true where that has changed its sign
    sums: tuple[Array, Array]
    search: Search | None  # for the events of a plan that has guards

    @property
    def counts(self) -> dict[str, Array]:
        """Counts of steps, by their names."""
        counts = self.tried, self.accepted, self.tried - self.accepted
        return dict(zip(COUNTS, counts, strict=True))


def begin(plan: Plan, control, args, ts, y0, rtol, atol, stepsize, records=()) -> tuple[Limits, Carry]:
    """Constants of a run, and the carry of its loop at the start, with the rows of the history that it writes."""
    start, end = ts[0], ts[-1]
    eps, none, no = float(jnp.finfo(ts.dtype).eps), jnp.zeros((), jnp.int32), jnp.asarray(False)
    floor = end - _ROUNDED * eps / 2 * jnp.abs(end)
    # Fixed steps have no tolerances: zeros keep one structure of the loop's constants.
    rtol, atol = (jnp.zeros_like(start) if x is None else x for x in (rtol, atol))
    rate, length, quality, (values, levels) = _begin(plan, control, args, start, end, y0, rtol, atol)
    if not isinstance(control, AdaptiveSteps):
        length = jnp.asarray(stepsize, ts.dtype)
    min_at_end = 16 * eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    limits = Limits(start, end, floor, min_at_end, length, rtol, atol, y0)
    search = None if plan.guards is None else Search.begin(values, values < -levels, length)
    sums = no_sums(plan.structure(y0))
    if isinstance(control, AdaptiveSteps):
        # A replay of a motion with events may be as short as the rounding of their times.
        length = jnp.maximum(length, min_step(start, min_at_end))
    t_next = start + length
    t_next = jnp.where(t_next > floor, end, t_next)
    # What is not reached stays infinite, which tells it from rows that are computed.
    rows = jnp.broadcast_to(jnp.full_like(y0, jnp.inf), (ts.shape[0] - 1, y0.size))
    state = State(start, t_next, y0, rate, no, none, none, no, quality, quality == 0, sums, search)
    return limits, Carry(state, none, rows, records)


def run_to_event(
    plan: Plan, control, max_steps: int, strides, args, limits: Limits, given: Given, carry: Carry
) -> Carry:
    """Make steps to the end of the run, or to an event."""
    task = Task(_iterate, (plan, control, max_steps, strides), dense_output, (plan,), strides)
    return run_loop(task, args, limits, given, carry)


def cases_of(limits: Limits, control, state: State) -> list[tuple[Array, Any]]:
    """Cases of the result of a run, for `first_of`."""
    cases: list[tuple[Any, Any]] = [(state.t < limits.end, RESULTS.max_steps_reached)]
    if isinstance(control, AdaptiveSteps):
        return [(state.failed, RESULTS.dt_min_reached), *cases]
    # Fixed steps end short of what is not finite, or at the end of a run in which they may have been too long.
    return [(state.failed, RESULTS.nonfinite_state), *cases, (too_coarse(state.sums), RESULTS.coarse_steps)]


def is_active(max_steps: int, limits: Limits, state: State):
    """True until the end of a run, or an event."""
    active = (state.t < limits.end) & ~state.failed & ~state.stopped & (state.tried < max_steps)
    return active if state.search is None else active & ~state.search.hit.any()


def _iterate(plan: Plan, control, max_steps: int, strides, args, limits: Limits, state: State, _) -> Iteration:
    """Make a step."""
    active = is_active(max_steps, limits, state)
    step = take_step(plan, args, state.t, jnp.where(active, state.t_next, state.t), state.y, state.rate)
    after, kept = _accept(plan, control, args, limits, state, active, step)
    dense = state.t, after.t, state.y, step.raw, step.stages, step.shift
    row = reverse.row(state.y, state.t, state.t_next, kept) if strides else ()
    more = is_active(max_steps, limits, after)
    return Iteration(after, active, more, Passed(kept, after.t, dense), state.tried, row)


def _accept(plan: Plan, control, args, limits: Limits, state: State, active, step: Step) -> tuple[State, Array]:
    """State after a step that is kept or refused, and whether it is kept."""
    t_next, sums, search = jnp.where(active, state.t_next, state.t), state.sums, state.search
    is_adaptive = isinstance(control, AdaptiveSteps)
    decided = _control_step(plan, control, limits, state, t_next, step)
    if search is not None:
        decided, search = _search(plan, args, state, search, t_next, step, decided, is_adaptive)
    kept = decided.kept
    t = jnp.where(kept, jnp.minimum(t_next, limits.end), state.t)
    after = t + decided.length
    if is_adaptive:
        # A step that would end within rounding of the end goes there; a refused one tries half of the way, or less.
        clipped = jnp.where(kept, limits.end, jnp.minimum(after, t + 0.5 * (limits.end - t)))
        point = jnp.where(after > limits.floor, clipped, after)
    else:
        start, before, y, error = (plan.structure(x) for x in (limits.y0, state.y, step.projected, step.error))
        sums = add_error(control.order, control.error_order, start, before, y, error, *state.sums)
        sums = jax.tree.map(lambda new, old: jnp.where(kept, new, old), sums, state.sums)
        number = state.tried + 1
        if search is not None:
            # A step that an event has cut less than a thousandth before a point of the grid has reached it.
            is_cut = ~kept | (t_next <= _grid_point(limits, number - search.cuts) - 1e-3 * search.usual)
            search = search._replace(cuts=search.cuts + is_cut.astype(jnp.int32))
            number = number - search.cuts
        point = _grid_point(limits, number + 1)
    # The search for an event sets the length itself.
    after = point if search is None else jnp.where(search.locating, after, point)
    # What follows is masked by `active`: a trajectory that has ended keeps its state while others of the batch continue.
    kept, one = kept & active, active.astype(jnp.int32)
    quality = jnp.where(kept, plan.quality_of(args, t_next, step.projected), state.quality)

    def if_active(new, old):
        return jax.tree.map(lambda new, old: jnp.where(active, new, old), new, old)

    state = State(
        if_active(t, state.t),
        if_active(jnp.minimum(after, limits.end), state.t_next),
        jnp.where(kept, step.projected, state.y),
        jnp.where(kept, step.rate, state.rate),
        decided.is_shortest,
        state.tried + one,
        state.accepted + kept.astype(jnp.int32),
        state.failed | (decided.failed & active),
        quality,
        state.stopped | (quality * state.quality <= 0),
        if_active(sums, state.sums),
        if_active(search, state.search),
    )
    return state, kept


def _search(
    plan: Plan, args, state: State, search: Search, t_next, step: Step, decided: NextStep, is_adaptive: bool
) -> tuple[NextStep, Search]:
    """Decision about a step by its guards, after that by its error, and the search for an event."""
    length = t_next - state.t

    def guards(fraction):
        # The dense output only finds that a guard was negative: the event is located by steps of its own.
        t = state.t + fraction * length
        y = dense_output(plan, None, t, state.t, t_next, state.y, step.raw, step.stages, step.shift)
        return plan.guards_of(args, t, y)

    at_end = plan.guards_of(args, t_next, step.projected)
    ends = (jnp.zeros_like(length), search.values), (jnp.ones_like(length), at_end[0])
    within = look_within(guards, *(Point(*end, jnp.zeros_like(search.values)) for end in ends))
    # Fixed steps fail where the state is not finite.
    good = decided.kept if is_adaptive else jnp.isfinite(step.projected).all()
    after, kept, located, length = search_root(
        search, state.t, t_next, at_end, within, good, decided.length, plan.rounding
    )
    after = after if is_adaptive else after._replace(usual=search.usual)
    # Steps that an event has cut may be shorter than the least one of the control.
    is_shortest, failed = decided.is_shortest & ~after.locating & ~located, decided.failed | (not is_adaptive)
    usual = jnp.where(located, _AFTER_EVENT * after.usual, decided.length)
    return NextStep(kept, jnp.where(after.locating, length, usual), is_shortest, failed & ~good), after


def _grid_point(limits: Limits, number):
    """End of the fixed step of this number, from one."""
    # From the start of the run, as sums of lengths would carry their rounding on.
    t = limits.start + number.astype(limits.end.dtype) * limits.length
    return jnp.where(t > limits.floor, limits.end, t)


@kernel(static=2, derivative=False)
def _begin(plan: Plan, control, args, t0, t1, y, rtol, atol):
    """Rate of change at the start, if steps reuse it, the length of the first adaptive step, the quality, and the guards."""
    rate, monitors = plan.first_rate(args, t0, y), (plan.quality_of(args, t0, y), plan.guards_of(args, t0, y))
    if not isinstance(control, AdaptiveSteps):
        return rate, t1 - t0, *monitors
    term = diffrax.ODETerm(plan.field)
    length = first_step(term, t0, t1, plan.structure(y), args, control.order, rtol, atol, control.size)
    return rate, jnp.where(jnp.isfinite(length), length, t1 - t0), *monitors


def _control_step(plan: Plan, control, limits: Limits, state: State, t1, step: Step) -> NextStep:
    """Decide whether a step is kept, and the length of the next one."""
    if not isinstance(control, AdaptiveSteps):
        return NextStep(jnp.asarray(True), limits.end - limits.start, state.is_shortest, jnp.asarray(False))
    before, after, error = (plan.structure(x) for x in (state.y, step.projected, step.error))
    size = error_size(control.size, before, after, error, limits.rtol, limits.atol)
    minimum = min_step(state.t, limits.min_at_end)
    decided = next_step(size, control.order, t1 - state.t, state.is_shortest, minimum)
    # Behind the end there is no step that could be too short.
    return decided._replace(failed=decided.failed & ~(decided.kept & (t1 >= limits.end)))


# --- runs with derivatives ---


FORWARD = (
    'forward mode (jax.jvp, jax.jacfwd) through a run or a step needs adjoint="forward", of jd.simulate or jd.stepper'
)


class Integrator(eqx.Module):
    """Integrator whose derivatives are those of its own steps: call(y0, args, ts) -> results, rows of the state at ts[1:] first.

    To derivatives the ends of steps are constants, except that they follow the start and the end of the run. A loop in native
    code has values and no derivatives: reverse mode is `pull`, along the history of the run; forward mode and derivatives of
    `pull` are those of `replay`.
    """

    room: int = eqx.field(static=True, kw_only=True)  # steps that a history holds

    def __call__(self, y0, args, ts):
        return _integrate(reverse_only((y0, args, ts), FORWARD), lax.stop_gradient(self))

    def direct(self, y0, args, ts):
        """Integrate with derivatives of any order in both modes."""
        return _with_history((y0, args, ts), lax.stop_gradient(self), self.room)[0]

    @abstractmethod
    def values(self, inputs, room: int | None) -> tuple[tuple, Any]:
        """Results without derivatives, and a history of at most `room` steps (None: without one)."""

    @abstractmethod
    def replay(self, history, inputs, direct: bool) -> tuple:
        """The first results, by the steps of a history; differentiable, and if `direct` to any order in both modes."""

    @abstractmethod
    def weights(self, inputs, gradients, history) -> tuple:
        """Cotangents of the results of `replay`, from those of all results, which may be None."""

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs from those of the results of `replay`."""
        return self.pull_replay(inputs, weights, history, perturbed, direct=False)

    def pull_replay(self, inputs, weights, history, perturbed, direct: bool):
        """Cotangents of the inputs through `replay`."""
        free, fixed = eqx.partition(inputs, perturbed)
        _, pull = jax.vjp(lambda free: self.replay(history, eqx.combine(free, fixed), direct), free)
        return pull(weights)[0]


def zeros_or(gradients, like, count: int):
    """Cotangents of rows (count, ...) of states `like`, with zeros for those that are None."""
    return jax.tree.map(lambda y, g: jnp.zeros((count, *y.shape), y.dtype) if g is None else g, like, gradients)


@eqx.filter_custom_vjp
def _integrate(inputs, run: Integrator):
    return _with_history(inputs, run, None)[0]


@_integrate.def_fwd
def _(perturbed, inputs, run: Integrator):
    return _with_history(inputs, run, run.room)


@_integrate.def_bwd
def _(history, gradients, perturbed, inputs, run: Integrator):
    history = lax.stop_gradient(history)
    return _pull((inputs, run.weights(inputs, gradients, history)), history, run, perturbed)


@eqx.filter_custom_jvp
def _with_history(inputs, run: Integrator, room: int | None):
    return run.values(inputs, room)


@_with_history.def_jvp
def _(primals, tangents):
    inputs, run, room = primals
    results, history = _with_history(inputs, run, run.room if room is None else room)
    known = lax.stop_gradient(history)
    _, changes = eqx.filter_jvp(lambda inputs: run.replay(known, inputs, True), (inputs,), (tangents[0],))
    values = results, None if room is None else history
    still = jax.tree.map(lambda _: None, values)
    return values, ((*changes, *still[0][len(changes) :]), still[1])


@eqx.filter_custom_jvp
def _pull(given, history, run: Integrator, perturbed):
    inputs, weights = given
    return run.pull(inputs, weights, history, perturbed)


@_pull.def_jvp
def _(primals, tangents):
    given, history, run, perturbed = primals

    def pull(given):
        inputs, weights = given
        return run.pull_replay(inputs, weights, history, perturbed, True)

    _, change = eqx.filter_jvp(pull, (given,), (tangents[0],))
    return _pull(*primals), change


class LibraryRun(Integrator):
    """Integrator by explicit steps: call(y0, args, ts) -> rows of the state at ts[1:]; result, counts, the time reached, and the
    guards (k,) that are zero there.

    A plan with guards has a further row, that of the state at the time reached.

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
        plan, control, start = self.plan, self.control, ravel_pytree(y0)[0]
        maximum = self.max_steps if room is None else room
        # The history of one step that is kept in any case follows from the inputs: where reverse mode computes a run again for
        # its history alone, this one is left out.
        is_one_step = room == 1 and plan.quality is plan.guards is None and isinstance(control, FixedSteps)
        history = None if room is None or is_one_step else reverse.blank(start, ts[0], maximum)
        records, strides = ((), ()) if history is None else (history.rows, history.strides)
        limits, carry = begin(plan, control, args, ts, start, self.rtol, self.atol, self.stepsize, records)
        state, _, rows, records = run_to_event(plan, control, maximum, strides, args, limits, Given(ts), carry)
        if history is not None:
            states, times, kept = records
            history = reverse.History(states, times, kept, state.tried)
        elif is_one_step:
            history = reverse.of_one_step(start, ts[0], jnp.minimum(ts[0] + self.stepsize, ts[-1]))
        hit = jnp.zeros((0,), bool) if state.search is None else state.search.hit
        cases = [(state.stopped | hit.any(), RESULTS.event_occurred), *cases_of(limits, control, state)]
        rows = rows if plan.guards is None else jnp.concatenate([rows, state.y[None]])
        facts = first_of(cases, RESULTS.successful), state.counts, state.t, hit
        return (jax.vmap(plan.structure)(rows), facts), history

    def replay(self, history, inputs, direct):
        y0, args, ts = inputs
        ts, places = self._in_order(history, ts)
        rows = reverse.replay_rows(self.plan, history, ravel_pytree(y0)[0], args, ts)
        return (jax.vmap(self.plan.structure)(rows[places]),)

    def _in_order(self, history, ts):
        """Save points, the time reached among them if there are guards, and the places of the rows, of which its is the last."""
        if self.plan.guards is None:
            return ts, slice(None)
        last = jnp.maximum(history.count - 1, 0)
        times = jnp.append(ts[1:], jnp.where(history.count > 0, history.times[last, 1], ts[0]))
        order = jnp.argsort(lax.stop_gradient(times), stable=True)
        return jnp.concatenate([ts[:1], times[order]]), jnp.argsort(order)

    def weights(self, inputs, gradients, history):
        y0, _, ts = inputs
        return (zeros_or(gradients[0], y0, ts.shape[0] - (self.plan.guards is None)),)

    def pull(self, inputs, weights, history, perturbed):
        """Cotangents of the inputs by kernels."""
        y0, args, ts = inputs
        ts, places = self._in_order(history, ts)
        flat = jax.vmap(lambda y: ravel_pytree(y)[0])(weights[0])
        flat = flat.at[places].set(flat)
        start, structure = ravel_pytree(y0)
        of_y, of_args, of_ts = reverse.pull(self.plan, history, start, args, ts, flat, perturbed[1:])
        # The end of a run that has guards is a constant time.
        of_ts = jnp.concatenate([of_ts[:1], of_ts[1:][places][: inputs[2].shape[0] - 1]])

        def or_none(x, varies):
            return x if varies else None

        return jax.tree.map(or_none, structure(of_y), perturbed[0]), of_args, or_none(of_ts, perturbed[2])
