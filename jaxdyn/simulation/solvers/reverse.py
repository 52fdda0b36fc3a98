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

from jaxdyn.compile import any_in_batch, recompute_unless, run, unless
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


def _stride(room: int) -> int:
    return -(-room // KEPT)


def blank(y0, t, room: int) -> History:
    """Of a run of at most `room` steps before it begins."""
    stride = _stride(room)
    rows = -(-room // stride) + (stride > 1)  # one more for what is not kept
    times, kept = jnp.zeros((room, 2), t.dtype), jnp.zeros(room, bool)
    return History(jnp.zeros((rows, y0.size), y0.dtype), times, kept, jnp.zeros((), jnp.int32))


def written(history: History, y, t0, t1, kept) -> History:
    """With a step more."""
    i, stride = history.count, history.stride
    place = i if stride == 1 else jnp.where(i % stride == 0, i // stride, history.states.shape[0] - 1)
    return History(
        lax.dynamic_update_slice(history.states, y[None], (place, jnp.zeros_like(place))),
        lax.dynamic_update_slice(history.times, jnp.stack([t0, t1])[None], (i, jnp.zeros_like(i))),
        lax.dynamic_update_slice(history.kept, kept[None], (i,)),
        i + 1,
    )


class _Lane(NamedTuple):
    """Cotangents on the way back: of the state after the step, and sums of those of what does not change on the way."""

    y: Array
    args: list
    start: Array
    end: Array
    ts: Array
    saved: Array  # rows of the solution whose cotangents have not been taken yet


def pulled(plan: Plan, history: History, y0, args, ts, steps, rows, moves) -> tuple[Array, Any, Array]:
    """Cotangents of y0, of the leaves of `args` that are to have one (None elsewhere), and of ts.

    **Arguments:** `rows` (nt - 1, n), cotangents of the solution at ts[1:]; `steps`, the number of fixed ones, or None; `moves`:
    which leaves of `args`, and whether the times, are to have cotangents.
    """
    moving, times_move = moves
    free, fixed = eqx.partition(args, moving)
    free_leaves, structure = jax.tree.flatten(free)
    stride, count = history.stride, ts.shape[0] - 1

    def step_back(i, y, lane: _Lane) -> _Lane:
        """Through the step i, from the state y."""
        (t0, t1), kept = history.times[i], history.kept[i]

        def has_row(saved):
            return kept & (saved > 0) & (ts[jnp.maximum(saved, 0)] > t0)

        def body(carry):
            lane, after, _ = carry
            here = has_row(lane.saved)
            place = jnp.maximum(lane.saved - 1, 0)
            row = jnp.where(here, rows[place], jnp.zeros_like(y))
            after = jnp.where(kept, after, jnp.zeros_like(after))
            at = jnp.where(here, ts[place + 1], t1)
            back = _pull(plan, times_move, structure, free_leaves, fixed, t0, t1, y, at, after, row)
            # What nothing depends on gets nothing, even where a step has no derivative.
            asked = kept & ((after != 0).any() | (row != 0).any())
            back = jax.tree.map(lambda x: jnp.where(asked, x, jnp.zeros_like(x)), back)
            of_args, of_y, of_t0, of_t1, of_at = back
            from_start, to_end = _shares(i, t0, ts, steps), _shares(i + 1, t1, ts, steps)
            lane = _Lane(
                lane.y + jnp.where(kept, of_y, jnp.zeros_like(of_y)),
                [total + x for total, x in zip(lane.args, of_args, strict=True)],
                lane.start + of_t0 * (1 - from_start) + of_t1 * (1 - to_end),
                lane.end + of_t0 * from_start + of_t1 * to_end,
                lane.ts.at[place + 1].add(jnp.where(here, of_at, jnp.zeros_like(of_at))) if times_move else lane.ts,
                lane.saved - here.astype(jnp.int32),
            )
            return lane, jnp.zeros_like(after), any_in_batch(has_row(lane.saved))

        after = lane.y
        lane = lane._replace(y=jnp.where(kept, jnp.zeros_like(after), after))
        return lax.while_loop(lambda carry: carry[2], body, (lane, after, any_in_batch(kept)))[0]

    def segment(s, lane: _Lane) -> _Lane:
        """Through the steps from a state that was kept to the next one."""
        first = s * stride
        y = history.states[s]
        if stride == 1:
            return step_back(first, y, lane)

        def forth(k, carry):
            y, between = carry
            between = lax.dynamic_update_slice(between, y[None], (k, jnp.zeros_like(k)))
            (t0, t1), kept = history.times[first + k], history.kept[first + k]
            after = _repeated(plan, args, t0, t1, y)
            return jnp.where(kept, after, y), between

        last = jnp.minimum(stride, history.count - first)
        between = jnp.zeros((stride, y.size), y.dtype)
        between = lax.fori_loop(0, last, forth, (y, between))[1]
        return lax.fori_loop(
            0, last, lambda k, lane: step_back(first + last - 1 - k, between[last - 1 - k], lane), lane
        )

    none = jnp.zeros((), ts.dtype)
    lane = _Lane(
        jnp.zeros_like(y0), [jnp.zeros_like(x) for x in free_leaves], none, none, jnp.zeros_like(ts),
        jnp.asarray(count, jnp.int32),
    )  # fmt: skip
    segments = (history.count + stride - 1) // stride
    lane = lax.fori_loop(0, segments, lambda k, lane: segment(segments - 1 - k, lane), lane)
    of_ts = lane.ts.at[0].add(lane.start).at[-1].add(lane.end)
    return lane.y, jax.tree.unflatten(structure, lane.args), of_ts


def _shares(i, t, ts, steps):
    """How much of a change of the run's end the end of step i, counted from one, follows; it follows the start by the rest."""
    one = jnp.ones_like(t)
    share = jnp.zeros_like(t) if steps is None else jnp.where(i < 2, 0.0, i.astype(t.dtype) / steps.astype(t.dtype))
    return jnp.where(t >= ts[-1], one, share)


def _pull(plan: Plan, times_move: bool, structure, free, fixed, t0, t1, y, at, after, row):
    given = fixed, free, t0, t1, y, at, after, row
    static = plan, times_move, structure
    kernel: Any = partial(run, _pulled_step, *given, static=static, calls=True, served=True)
    found, served = kernel(otherwise=lambda *_: None)
    again = partial(_pulled_in_turn, *static)
    return again(*given) if found is None else recompute_unless(served, again, found, given)


def _pulled_step(plan: Plan, times_move, structure, fixed, free, t0, t1, y, at, after, row):
    """Cotangents of the leaves `free`, of y, t0, t1 and at, from those of the step's result and of its row at the time `at`."""
    apart = plan._replace(field=Apart(plan.field), project=plan.project and Apart(plan.project))
    return _pulled_by(partial(whole_step, apart), apart, times_move, structure, fixed, free, t0, t1, y, at, after, row)


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
    kernel: Any = partial(run, _result, args, t0, t1, y, static=(plan,), calls=True, served=True)
    found, served = kernel(otherwise=lambda *_: None)
    again = partial(_result_in_turn, plan)
    return again(args, t0, t1, y) if found is None else recompute_unless(served, again, found, (args, t0, t1, y))


def _result(plan: Plan, args, t0, t1, y):
    rate = plan.field_of(args, t0, y) if plan.passes_rate_on else jnp.zeros_like(y)
    return whole_step(plan, args, t0, t1, y, rate).projected


def _result_in_turn(plan: Plan, args, t0, t1, y):
    rate = plan.field_of(args, t0, y) if plan.passes_rate_on else jnp.zeros_like(y)
    return step_in_turn(plan, args, t0, t1, y, rate).projected


class Apart(NamedTuple):
    """A function of a plan whose derivatives are those of its own program of numbers. Equal ones share it."""

    function: Any

    def __call__(self, *args):
        """What the function does; its arrays where it returns something beside them."""
        arrays, rest = eqx.partition(args[-1], eqx.is_array)
        del rest
        found, served = run(_applied, arrays, args[:-1], static=(self.function,), served=True, apart=True)
        return found if served is True else jax.tree.map(lambda x: unless(~served, x), found)


def _applied(function, args, given):
    return function(*given, args)
