"""Reverse mode through the steps of `driver`: the forward run keeps states, and one kernel a step propagates the cotangents.

The derivatives are those of the steps that were taken: the ends of steps are constants, except that they follow the ends of the
run. The rate that a step reuses from the one before is taken for the vector field where it begins; the two differ by the digits
to which the coefficients of the method are published (Dopri8: 1e-10 of a derivative). Of long runs every second state is kept,
or every third and so on, and those between are computed again, so that memory is bounded.

`replay_rows` takes the same steps as operations of JAX, which have derivatives of any order in both modes.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxdyn.compile import kernel, values_of_rules
from jaxdyn.compile.batch import cond
from jaxdyn.compile.kernels import Carry, Given, Iteration, Task, run_loop
from jaxdyn.simulation.solvers.steps import Plan, dense_output, differentiable_step, take_step

# States that are kept of a run: 4 kB a number of the state in float64, which a cache holds for small mechanisms.
KEPT = 512


class History(NamedTuple):
    """Record of a run: a row for each step that was tried, and the state at the start of each or of every so many of them."""

    states: Array  # (rows, n)
    times: Array  # (room, 2), from where to where
    kept: Array  # (room,), true for steps that were kept
    count: Array  # (), steps tried

    @property
    def stride(self) -> int:
        """Number of steps from a state that is kept to the next one."""
        return _stride(self.kept.shape[0])

    @property
    def rows(self) -> tuple:
        """Arrays to which steps are written."""
        return self.states, self.times, self.kept

    @property
    def strides(self) -> tuple[int, ...]:
        """Number of steps from one row to the next, for each of these."""
        return self.stride, 1, 1


def _stride(room: int) -> int:
    return -(-room // KEPT)


def blank(y0, t, room: int) -> History:
    """History of a run of at most `room` steps before it begins."""
    stride = _stride(room)
    rows = -(-room // stride)
    times, kept = jnp.zeros((room, 2), t.dtype), jnp.zeros(room, bool)
    return History(jnp.zeros((rows, y0.size), y0.dtype), times, kept, jnp.zeros((), jnp.int32))


def of_one_step(y0, t0, t1) -> History:
    """History of a run of one step, which was kept."""
    return History(y0[None], jnp.stack([t0, t1])[None], jnp.ones(1, bool), jnp.ones((), jnp.int32))


def row(y, t0, t1, kept) -> tuple:
    """Row of a step."""
    return y, jnp.stack([t0, t1]), kept


class _Ends(NamedTuple):
    """Constants of the way back: the first step, and the end of the run."""

    first: Array
    end: Array


class _Cotangents(NamedTuple):
    """Cotangents on the way back."""

    after: Array  # of the state after a step
    before: Array  # of the state before it, the share of the rows within the step so far
    args: list  # sums of the arguments', of the start's and of the end's
    start: Array
    end: Array
    ts: Array  # of the save points
    saved: Array  # number of rows of the solution whose cotangents have not been added yet
    places: Array  # (6,), where to read next: state, times, flag, row, time of that row and of the one before it


class _Replay(NamedTuple):
    """State of a replay from a state that was kept."""

    y: Array
    places: Array  # (2,), where to read the times and the flag of the next step


def pull(plan: Plan, history: History, y0, args, ts, rows, varies) -> tuple[Array, Any, Array]:
    """Cotangents of y0, of the leaves of `args` that are to have one (None elsewhere), and of ts.

    **Arguments:** `rows` (nt - 1, n), cotangents of the solution at ts[1:]; `varies`: flags of the leaves of `args`, and of the
    times, that are to have cotangents.
    """
    moving, times_move = varies
    free, fixed = eqx.partition(args, moving)
    free_leaves, structure = jax.tree.flatten(free)
    stride, static = history.stride, (plan, times_move, structure)
    none, minimum = jnp.zeros((), ts.dtype), jnp.zeros((), jnp.int32)
    saved = jnp.asarray(ts.shape[0] - 1, jnp.int32)

    def back(first, last, states, cotangents: _Cotangents) -> _Cotangents:
        """Go back through the steps first .. last - 1, which begin from the rows of `states`."""
        ends = _Ends(first, ts[-1])
        cotangents = cotangents._replace(places=_places(last - 1, first, cotangents.saved))
        given = Given(None, (states, history.times, history.kept, rows, ts, ts))
        task = Task(_iterate_back, static)
        return run_loop(task, (fixed, free_leaves), ends, given, Carry(cotangents)).state

    def replay(first, last, y):
        """States from which the steps first .. last - 1 begin, (stride, n), the first of them y."""
        given = Given(None, (history.times, history.kept))
        carry = Carry(_Replay(y, jnp.stack([first, first])), records=(jnp.zeros((stride, y.size), y.dtype),))
        task = Task(_iterate_replay, (plan,), strides=(1,))
        return run_loop(task, args, (first, last), given, carry).records[0]

    zeros, nothing = [jnp.zeros_like(x) for x in free_leaves], jnp.zeros_like(y0)
    places = _places(minimum, minimum, saved)
    cotangents = _Cotangents(nothing, nothing, zeros, none, none, jnp.zeros_like(ts), saved, places)
    if stride == 1:
        cotangents = back(minimum, history.count, history.states, cotangents)
    else:
        segments = (history.count + stride - 1) // stride

        # From the last segment between two kept states to the first: its steps are replayed, and then taken back.
        def segment(k, cotangents):
            s = segments - 1 - k
            first = s * stride
            last = jnp.minimum(first + stride, history.count)
            return back(first, last, replay(first, last, history.states[s]), cotangents)

        cotangents = lax.fori_loop(0, segments, segment, cotangents)
    # Ends of steps follow the ends of the run, whose cotangents have been summed apart.
    of_ts = cotangents.ts.at[0].add(cotangents.start).at[-1].add(cotangents.end)
    return cotangents.after, jax.tree.unflatten(structure, cotangents.args), of_ts


def _places(step, first, saved):
    """Places to read on the way back at a step whose state is at `step - first`."""
    row = jnp.maximum(saved - 1, 0)
    return jnp.stack([step - first, step, step, row, saved, row])


def _iterate_back(plan: Plan, times_move, structure, args, ends: _Ends, cotangents: _Cotangents, read) -> Iteration:
    """Go back through a step, or to the next row within it."""
    back = partial(_pull_without_loop, plan, times_move, structure, *args)(*_step_arguments((), ends, cotangents, read))
    return _accumulate(times_move, (), ends, cotangents, read, back)


def _step_arguments(_, ends: _Ends, cotangents: _Cotangents, read):
    """The last arguments of `_pull_step`."""
    y, (t0, t1), _, row, at_row, _ = read
    kept, here = _flags(ends, cotangents, read)
    return t0, t1, y, jnp.where(here, at_row, t1), jnp.where(kept, cotangents.after, 0.0), jnp.where(here, row, 0.0)


def _flags(ends: _Ends, cotangents: _Cotangents, read):
    """Two flags, (): the step was kept; there is a row within it."""
    _, (t0, _), kept, _, at_row, _ = read
    kept = kept & (cotangents.places[1] >= ends.first)
    # A step with several rows is visited once for each: the last visit adds the cotangent of its end.
    return kept, kept & (cotangents.saved > 0) & (at_row > t0)


def _accumulate(times_move: bool, _, ends: _Ends, cotangents: _Cotangents, read, back) -> Iteration:
    """Add the cotangents `back` of a step, and choose what follows."""
    step, active = cotangents.places[1], cotangents.places[1] >= ends.first
    t0, t1, _, _, after, row = _step_arguments((), ends, cotangents, read)
    (kept, here), at_next = _flags(ends, cotangents, read), read[-1]
    # What nothing depends on gets nothing, even where a step has no derivative.
    asked = kept & ((after != 0).any() | (row != 0).any())
    of_args, of_y, of_t0, of_t1, of_at = jax.tree.map(lambda x: jnp.where(asked, x, 0.0), back)
    to_end = jnp.where(t1 >= ends.end, 1.0, jnp.zeros_like(t1))
    saved = cotangents.saved - here.astype(jnp.int32)
    again = here & (saved > 0) & (at_next > t0)
    before = cotangents.before + of_y
    following = jnp.where(again, step, step - 1)
    state = _Cotangents(
        jnp.where(again, jnp.zeros_like(before), jnp.where(kept, before, cotangents.after)),
        jnp.where(again, before, 0.0),
        [total + x for total, x in zip(cotangents.args, of_args, strict=True)],
        cotangents.start + of_t0 + of_t1 * (1 - to_end),
        cotangents.end + of_t1 * to_end,
        cotangents.ts.at[cotangents.saved].add(jnp.where(here, of_at, 0.0)) if times_move else cotangents.ts,
        saved,
        _places(following, step - cotangents.places[0], saved),
    )
    return Iteration(state, active, following >= ends.first)


def _pull_without_loop(plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    # The vector field and the projection occur in every stage: as programs of their own they are differentiated once.
    project = plan.project and OwnProgram(plan.project, by_rules=True)
    plan = plan._replace(field=OwnProgram(plan.field), project=project)
    return _pull_step(plan, times_move, structure, fixed, free, t0, t1, y, at, after, row)


def _pull_step(plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    """Cotangents of the leaves `free`, of y, t0, t1 and at, from those of the step's end and of its row at the time `at`."""

    def forward(free, y, *times):
        t0_, t1_, at_ = times or (t0, t1, at)
        args = eqx.combine(jax.tree.unflatten(structure, free), fixed)
        step = take_step(plan, args, t0_, t1_, y, plan.first_rate(args, t0_, y))
        return step.projected, dense_output(plan, None, at_, t0_, t1_, y, step.raw, step.stages, step.shift)

    times = (t0, t1, at) if times_move else ()
    _, pull = jax.vjp(forward, free, y, *times)
    of_free, of_y, *of_times = pull((after, row))
    return of_free, of_y, *(of_times or (jnp.zeros_like(t0),) * 3)


def _iterate_replay(plan: Plan, args, ends, replay: _Replay, read) -> Iteration:
    """Take a step again."""
    (t0, t1), kept = read
    after = take_step(plan, args, t0, t1, replay.y, plan.first_rate(args, t0, replay.y)).projected
    first, last = ends
    step = replay.places[0]
    state = _Replay(jnp.where(kept, after, replay.y), replay.places + 1)
    return Iteration(state, step < last, step + 1 < last, None, step - first, (replay.y,))


def replay_rows(plan: Plan, history: History, y0, args, ts):
    """Rows of the state (nt - 1, n) at ts[1:] by the steps of a history; zero where the run did not come to.

    **Arguments:** `y0` (n,), flat.
    """
    times, kept, count = lax.stop_gradient((history.times, history.kept, history.count))
    room = kept.shape[0]

    def move(t):
        """Time at which a step ends or begins, which follows the start of the run, or its end."""
        start, end = ts[0] - lax.stop_gradient(ts[0]), ts[-1] - lax.stop_gradient(ts[-1])
        return t + jnp.where(t >= lax.stop_gradient(ts[-1]), end, start)

    @jax.checkpoint
    def end_of(args, y, t0, t1):
        return differentiable_step(plan, args, move(t0), move(t1), y)[0]

    def advance(y, row):
        i, (t0, t1), is_kept = row
        active = is_kept & (i < count)
        # There is room for many more steps than were taken: the rest is skipped, together for a batch.
        after = cond(active, end_of, lambda args, y, *_: y, args, y, t0, t1)
        return jnp.where(active, after, y), y

    number = jnp.arange(room, dtype=count.dtype)
    _, states = lax.scan(advance, y0, (number, times, kept))
    taken = kept & (number < count)

    @jax.checkpoint
    def row(args, states, t):
        known = lax.stop_gradient(t)
        holds = taken & (times[:, 0] < known) & (known <= times[:, 1])
        i = jnp.argmax(holds)
        t0, t1 = move(times[i, 0]), move(times[i, 1])
        _, shift, _, raw, stages = differentiable_step(plan, args, t0, t1, states[i])
        at = dense_output(plan, None, t, t0, t1, states[i], raw, stages, shift)
        return jnp.where(holds.any(), at, jnp.zeros_like(at))

    return lax.map(partial(row, args, states), ts[1:])


class OwnProgram(NamedTuple):
    """A function of a plan whose derivatives are those of its own scalar program. Equal ones share it.

    `by_rules`: its value is that of the rule for its derivative, of which little is needed: a projection leaves out its rounds.
    """

    function: Any
    by_rules: bool = False

    def __call__(self, *args):
        """Value of the function, of whose last argument the arrays are passed."""
        return equations_of_motion(*self, eqx.filter(args[-1], eqx.is_array), args[:-1])


@kernel(static=2, derivative="program")
def equations_of_motion(function, by_rules, args, given):
    """Value of an `OwnProgram`. The message that a control or a force has no kernel shows this name."""
    with values_of_rules(by_rules):
        return function(*given, args)
