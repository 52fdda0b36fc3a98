"""Reverse mode through the steps of `driver`: the forward run keeps states, and one kernel a step takes cotangents back.

The derivatives are those of the steps that were taken: when steps end is a constant but for the ends of the run, and a rate
that a step takes over from the one before is that of the field where it begins, as it is but for the digits to which the
coefficients of the method are known (Dopri8: 1e-10 of a derivative). Of long
runs every second state is kept, or every third and so on, and those between are computed again, so that memory is bounded.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import any_sample
from jaxdyn.compile.loops import Carry, Given, Iteration, Task, run_loop
from jaxdyn.simulation.solvers.explicit import Plan, projected_output, step_in_turn, whole_step

KEPT = 512  # states that are kept of a run


class History(NamedTuple):
    """What a run writes down: a row for each step that was tried, and the states from which every so many of them began."""

    states: Array  # (rows, n)
    times: Array  # (room, 2), from where to where
    kept: Array  # (room,), whether the step was kept
    count: Array  # (), steps tried

    @property
    def stride(self) -> int:
        """Steps from a state that is kept to the next one."""
        return _stride(self.kept.shape[0])

    @property
    def rows(self) -> tuple:
        """What steps are written down in."""
        return self.states, self.times, self.kept

    @property
    def strides(self) -> tuple[int, ...]:
        """For each of these, of how many steps one is written down."""
        return self.stride, 1, 1


def _stride(room: int) -> int:
    return -(-room // KEPT)


def blank(y0, t, room: int) -> History:
    """Of a run of at most `room` steps before it begins."""
    stride = _stride(room)
    rows = -(-room // stride)
    times, kept = jnp.zeros((room, 2), t.dtype), jnp.zeros(room, bool)
    return History(jnp.zeros((rows, y0.size), y0.dtype), times, kept, jnp.zeros((), jnp.int32))


def row(y, t0, t1, kept) -> tuple:
    """What is written of a step."""
    return y, jnp.stack([t0, t1]), kept


def written(rows: tuple, strides: tuple[int, ...], new: tuple, index, active) -> tuple:
    """The rows of a history with those of the step of a number, if it was taken."""

    def one(array, value, stride):
        asked = active if stride == 1 else active & (index % stride == 0)
        return array.at[jnp.where(asked, index // stride, array.shape[0])].set(value, mode="drop")

    return tuple(map(one, rows, new, strides))


class _Ends(NamedTuple):
    """What does not change on the way back: the first step, the ends of the run, and the number of fixed steps or None."""

    first: Array
    start: Array
    end: Array
    steps: Any


class _Cotangents(NamedTuple):
    """Cotangents on the way back.

    Of the state after a step, and what rows within the step gave to that of the state before it; sums of those of what does not
    change on the way; and of the save points.
    """

    after: Array
    before: Array
    args: list
    start: Array
    end: Array
    ts: Array
    saved: Array  # rows of the solution whose cotangents have not been taken yet
    places: Array  # (6,) of what is read next: state, times, flag, row, time of that row and of the one before it


class _Replay(NamedTuple):
    """The way from a state that was kept, by steps that are taken again."""

    y: Array
    places: Array  # (2,) of the times and the flag of the next step


def pulled(plan: Plan, history: History, y0, args, ts, steps, rows, varies) -> tuple[Array, Any, Array]:
    """Cotangents of y0, of the leaves of `args` that are to have one (None elsewhere), and of ts.

    **Arguments:** `rows` (nt - 1, n), cotangents of the solution at ts[1:]; `steps`, the number of fixed ones, or None; `varies`:
    which leaves of `args`, and whether the times, are to have cotangents.
    """
    moving, times_move = varies
    free, fixed = eqx.partition(args, moving)
    free_leaves, structure = jax.tree.flatten(free)
    stride, static = history.stride, (plan, times_move, structure)
    none, least = jnp.zeros((), ts.dtype), jnp.zeros((), jnp.int32)
    saved = jnp.asarray(ts.shape[0] - 1, jnp.int32)

    def back(first, last, states, cotangents: _Cotangents) -> _Cotangents:
        """Through the steps first .. last - 1, which begin from the rows of `states`."""
        ends = _Ends(first, ts[0], ts[-1], steps)
        cotangents = cotangents._replace(places=_places(last - 1, first, cotangents.saved))
        given = Given(None, (states, history.times, history.kept, rows, ts, ts))
        task = Task(_turn_back, _back_by_turns, static)

        def run_on(carry):
            after = run_loop(task, (fixed, free_leaves), ends, given, carry)
            return (carry, False) if after is None else after

        carry, always_ends = run_on(Carry(cotangents))
        if not always_ends:
            turn = partial(_back_by_turn, *static, (fixed, free_leaves), ends, given)
            carry = lax.while_loop(partial(_is_unfinished, ends), lambda carry: run_on(turn(carry))[0], carry)
        return carry.state

    def replayed(first, last, y):
        """States from which the steps first .. last - 1 begin, (stride, n), the first of them y."""
        state = _Replay(y, jnp.stack([first, first]))
        given = Given(None, (history.times, history.kept))
        task = Task(_turn_of_replay, _replay_by_turns, (plan,), strides=(1,))
        carry = Carry(state, records=(jnp.zeros((stride, y.size), y.dtype),))
        after = run_loop(task, args, (first, last), given, carry)
        carry, always_ends = (carry, False) if after is None else after
        return (carry if always_ends else _replay_by_turns(plan, args, (first, last), given, carry)).records[0]

    zeros = [jnp.zeros_like(x) for x in free_leaves]
    cotangents = _Cotangents(
        jnp.zeros_like(y0),
        jnp.zeros_like(y0),
        zeros,
        none,
        none,
        jnp.zeros_like(ts),
        saved,
        _places(least, least, saved),
    )
    if stride == 1:
        cotangents = back(least, history.count, history.states, cotangents)
    else:
        segments = (history.count + stride - 1) // stride

        def segment(k, cotangents):
            s = segments - 1 - k
            first = s * stride
            last = jnp.minimum(first + stride, history.count)
            return back(first, last, replayed(first, last, history.states[s]), cotangents)

        cotangents = lax.fori_loop(0, segments, segment, cotangents)
    of_ts = cotangents.ts.at[0].add(cotangents.start).at[-1].add(cotangents.end)
    return cotangents.after, jax.tree.unflatten(structure, cotangents.args), of_ts


def _places(step, first, saved):
    """What is read on the way back at a step whose state stands at `step - first`."""
    row = jnp.maximum(saved - 1, 0)
    return jnp.stack([step - first, step, step, row, saved, row])


def _is_unfinished(ends: _Ends, carry: Carry):
    return any_sample(carry.state.places[1] >= ends.first)


def _read(given: Given, places):
    return tuple(table[places[i]] for i, table in enumerate(given.tables))


def _turn_back(plan: Plan, times_move, structure, args, ends: _Ends, cotangents: _Cotangents, read) -> Iteration:
    """Through a step, or to the next one of the rows within it."""
    pull = partial(_pulled_step, plan, times_move, structure, *args)
    return _back_through_step(pull, times_move, ends, cotangents, read)


def _back_by_turn(plan: Plan, times_move, structure, args, ends: _Ends, given: Given, carry: Carry) -> Carry:
    """The same as operations of JAX around kernels."""
    cotangents, pull = carry.state, partial(_pull, plan, times_move, structure, *args)
    turn = _back_through_step(pull, times_move, ends, cotangents, _read(given, cotangents.places))
    return Carry(jax.tree.map(lambda new, old: jnp.where(turn.active, new, old), turn.state, cotangents))


def _back_by_turns(plan: Plan, times_move, structure, args, ends: _Ends, given: Given, carry: Carry) -> Carry:
    turn = partial(_back_by_turn, plan, times_move, structure, args, ends, given)
    return lax.while_loop(partial(_is_unfinished, ends), turn, carry)


def _back_through_step(pull, times_move: bool, ends: _Ends, cotangents: _Cotangents, read) -> Iteration:
    """A turn; pull(t0, t1, y, at, after, row) gives the cotangents of a step."""
    y, (t0, t1), kept, row, at_row, at_next = read
    step, active = cotangents.places[1], cotangents.places[1] >= ends.first
    kept = kept & active

    def when(flag, x):
        return jnp.where(flag, x, jnp.zeros_like(x))

    here = kept & (cotangents.saved > 0) & (at_row > t0)
    row, after = when(here, row), when(kept, cotangents.after)
    at = jnp.where(here, at_row, t1)
    # What nothing depends on gets nothing, even where a step has no derivative.
    asked = kept & ((after != 0).any() | (row != 0).any())
    back = jax.tree.map(lambda x: when(asked, x), pull(t0, t1, y, at, after, row))
    of_args, of_y, of_t0, of_t1, of_at = back
    from_start, to_end = (step_share(i, t, ends.end, ends.steps) for i, t in ((step, t0), (step + 1, t1)))
    saved = cotangents.saved - here.astype(jnp.int32)
    again = here & (saved > 0) & (at_next > t0)
    before = cotangents.before + of_y
    following = jnp.where(again, step, step - 1)
    state = _Cotangents(
        jnp.where(again, jnp.zeros_like(before), jnp.where(kept, before, cotangents.after)),
        when(again, before),
        [total + x for total, x in zip(cotangents.args, of_args, strict=True)],
        cotangents.start + of_t0 * (1 - from_start) + of_t1 * (1 - to_end),
        cotangents.end + of_t0 * from_start + of_t1 * to_end,
        cotangents.ts.at[cotangents.saved].add(when(here, of_at)) if times_move else cotangents.ts,
        saved,
        _places(following, step - cotangents.places[0], saved),
    )
    return Iteration(state, active, following >= ends.first)


def _turn_of_replay(plan: Plan, args, ends, replay: _Replay, read) -> Iteration:
    """A step that is taken again."""
    (t0, t1), kept = read
    return _replayed_step(_result(plan, args, t0, t1, replay.y), ends, replay, kept)


def _replayed_step(after, ends, replay: _Replay, kept) -> Iteration:
    first, last = ends
    step = replay.places[0]
    state = _Replay(jnp.where(kept, after, replay.y), replay.places + 1)
    return Iteration(state, step < last, step + 1 < last, None, step - first, (replay.y,))


def _replay_by_turns(plan: Plan, args, ends, given: Given, carry: Carry) -> Carry:
    """The same as operations of JAX around kernels."""

    def turn(_, carry):
        replay, (between,) = carry.state, carry.records
        (t0, t1), kept = _read(given, replay.places)
        turn = _replayed_step(_repeated(plan, args, t0, t1, replay.y), ends, replay, kept)
        place = jnp.where(turn.active, turn.index, between.shape[0])
        return Carry(turn.state, records=(between.at[place].set(replay.y, mode="drop"),))

    return lax.fori_loop(carry.state.places[0], ends[1], turn, carry)


def step_share(i, t, end, steps):
    """How much of a change of the run's end the end t of step i, counted from one, follows; it follows the start by the rest."""
    one = jnp.ones_like(t)
    share = jnp.zeros_like(t) if steps is None else jnp.where(i < 2, 0.0, i.astype(t.dtype) / steps.astype(t.dtype))
    return jnp.where(t >= end, one, share)


def _pull(plan: Plan, times_move: bool, structure, fixed, free, t0, t1, y, at, after, row):
    pull = kernel(_pulled_step, static=3, fallback=_pulled_in_turn, derivative=False)
    return pull(plan, times_move, structure, fixed, free, t0, t1, y, at, after, row)


def _pulled_step(plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    """Cotangents of the leaves `free`, of y, t0, t1 and at, from those of the step's result and of its row at the time `at`."""
    programs = plan._replace(field=OwnProgram(plan.field), project=plan.project and OwnProgram(plan.project))
    return _pulled_by(
        partial(whole_step, programs),
        programs,
        times_move,
        structure,
        fixed,
        free,
        t0,
        t1,
        y,
        at,
        after,
        row,
    )


def _pulled_in_turn(plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    """The same by JAX, as a loop over the stages."""
    return _pulled_by(partial(step_in_turn, plan), plan, times_move, structure, fixed, free, t0, t1, y, at, after, row)


def _pulled_by(step, plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    def forward(free, y, *times):
        t0_, t1_, at_ = times or (t0, t1, at)
        args = eqx.combine(jax.tree.unflatten(structure, free), fixed)
        rate = plan.field_of(args, t0_, y) if plan.passes_rate_on else jnp.zeros_like(y)
        made = step(args, t0_, t1_, y, rate)
        return made.projected, projected_output(plan, None, at_, t0_, t1_, y, made.raw, made.stages, made.shift)

    times = (t0, t1, at) if times_move else ()
    _, pull = jax.vjp(forward, free, y, *times)
    of_free, of_y, *of_times = pull((after, row))
    return of_free, of_y, *(of_times or (jnp.zeros_like(t0),) * 3)


def _repeated(plan: Plan, args, t0, t1, y):
    """The result of a step."""
    return kernel(_result, static=1, fallback=_result_in_turn, derivative=False)(plan, args, t0, t1, y)


def _result(plan: Plan, args, t0, t1, y):
    rate = plan.field_of(args, t0, y) if plan.passes_rate_on else jnp.zeros_like(y)
    return whole_step(plan, args, t0, t1, y, rate).projected


def _result_in_turn(plan: Plan, args, t0, t1, y):
    rate = plan.field_of(args, t0, y) if plan.passes_rate_on else jnp.zeros_like(y)
    return step_in_turn(plan, args, t0, t1, y, rate).projected


class OwnProgram(NamedTuple):
    """A function of a plan whose derivatives are those of its own program of numbers. Equal ones share it."""

    function: Any

    def __call__(self, *args):
        """What the function does; its arrays where it returns something beside them."""
        arrays, rest = eqx.partition(args[-1], eqx.is_array)
        del rest
        return _apply(self.function, arrays, args[:-1])


@kernel(static=1, derivative="program")
def _apply(function, args, given):
    return function(*given, args)
