"""Reverse mode through adaptive steps: the forward run writes down when its steps end, and backwards the same ones are taken.

diffrax takes steps anew from checkpoints. Their lengths follow from error estimates, of which the last digits depend on the
program, and the program is another one there: a step that is refused in one and kept in the other, and the pieces that
are put together are those of two different runs. With the ends written down nothing is left to decide. Backwards there are no
error estimates and no refused steps either.
"""

import dataclasses
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

ROOM = 8192  # steps that are written down where the user gives no limit: 64 kB a trajectory


def run(moving, *, term, solver, controller, event, adjoint, max_steps, progress, dt0=None):
    """diffrax's solution from one end of the save points to the other.

    **Arguments:** `moving`, what may be differentiated: the initial state, `args`, and the save points (nt,), of which the first
    is the start; the rest as diffrax's.

    **Returns:** rows of the state at ts[1:]; the result, the counts and the time reached; the state of the controller.
    """
    y0, args, ts = moving
    saves = diffrax.SubSaveAt(ts=ts[1:])
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)  # which takes save points and nothing else
    last = diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: None)
    solved: Any = diffrax.diffeqsolve(
        term,
        solver,
        t0=ts[0],
        t1=ts[-1],
        dt0=dt0,
        y0=y0,
        args=args,
        saveat=diffrax.SaveAt(subs=saves) if continuous else diffrax.SaveAt(subs=(saves, last), controller_state=True),
        stepsize_controller=controller,
        adjoint=adjoint,
        event=event,
        max_steps=max_steps,
        throw=False,
        progress_meter=progress,
    )
    if continuous:
        reached = jnp.max(jnp.where(jnp.isfinite(solved.ts), solved.ts, ts[0]))
        return solved.ys, (solved.result, solved.stats, reached), None
    return solved.ys[0], (solved.result, solved.stats, solved.ts[1][0]), solved.controller_state


def run_adaptively(moving, options, limit_is_given: bool):
    """`run` with adaptive steps whose ends are constants to reverse mode; without the state of the controller."""
    if not isinstance(options["controller"], diffrax.AbstractAdaptiveStepSizeController):
        return run(moving, **options)[:2]  # whose steps are given, as those of `diffrax.StepTo`
    numbers, rest = eqx.partition(options, eqx.is_array)
    options = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    room = options["max_steps"] if limit_is_given else min(options["max_steps"], ROOM)
    if isinstance(options["adjoint"], diffrax.RecursiveCheckpointAdjoint):
        return _run(moving, options, room)
    if isinstance(options["adjoint"], diffrax.DirectAdjoint):
        numbers, rest = eqx.partition(moving, eqx.is_array)
        facts, taken = _recorded(eqx.combine(jax.lax.stop_gradient(numbers), rest), options, options["max_steps"])[1:]
        return run(moving, **_again(options, taken))[0], facts
    return run(moving, **options)[:2]


@eqx.filter_custom_vjp
def _run(moving, options, room):
    return run(moving, **options)[:2]


@_run.def_fwd
def _(perturbed, moving, options, room):
    rows, facts, taken = _recorded(moving, options, room)
    return (rows, facts), taken


@_run.def_bwd
def _(taken, gradients, perturbed, moving, options, room):
    free, fixed = eqx.partition(moving, perturbed)
    rows, pull = eqx.filter_vjp(lambda free: run(eqx.combine(free, fixed), **_again(options, taken))[0], free)
    weights = jax.tree.map(lambda y, g: jnp.zeros_like(y) if g is None else g, rows, gradients[0])
    return pull(weights)[0]


def _recorded(moving, options, room):
    """As `run`, with the steps taken in place of the state of the controller."""
    controller = _Recording(options["controller"], room)  # pyright: ignore[reportCallIssue]
    rows, facts, state = run(moving, **options | {"controller": controller, "adjoint": diffrax.ForwardMode()})
    _, *taken = cast(tuple, state)
    return rows, facts, taken


def _again(options, taken):
    """What repeats these steps."""
    controller = _Repeating(*taken)
    changed = {"controller": controller, "max_steps": controller.ends.shape[0], "progress": diffrax.NoProgressMeter()}
    return options | changed | {"event": None}


class _Recording(diffrax.AbstractAdaptiveStepSizeController):
    """A step-size control that writes down the steps that are kept, and stops where there is no more room.

    Only a control that knows of jumps in time may begin a step elsewhere than where the last one ended.
    """

    controller: Any
    room: int = eqx.field(static=True)

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm

    def wrap(self, direction):
        return dataclasses.replace(self, controller=self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        end, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        times = jnp.zeros(self.room, jnp.result_type(t1))
        return end, (inner, times, times if _jumps(self.controller) else None, jnp.asarray(0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        inner, ends, starts, count = controller_state
        kept, start, end, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        row = jnp.where(kept, count, self.room)
        ends = ends.at[row].set(jax.lax.stop_gradient(t1), mode="drop")
        starts = None if starts is None else starts.at[row].set(jax.lax.stop_gradient(t0), mode="drop")
        count = count + jnp.where(kept, 1, 0)
        codes: Any = diffrax.RESULTS
        full = (result == codes.successful) & (count > self.room)
        return (
            kept,
            start,
            end,
            jumped,
            (inner, ends, starts, count),
            codes.where(full, codes.max_steps_reached, result),
        )


class _Repeating(diffrax.AbstractStepSizeController):
    """The steps that were written down, and no other ones."""

    ends: jax.Array
    starts: jax.Array | None
    count: jax.Array

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # Where no step was kept, one of no length.
        return jnp.where(self.count > 0, _along(self.ends[0], t0), t0), jnp.asarray(1)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        row = jnp.minimum(controller_state, self.ends.shape[0] - 1)
        over = controller_state >= self.count
        start = t1 if self.starts is None else jnp.where(over, t1, _along(self.starts[row], t1))
        end = jnp.where(over, t1, _along(self.ends[row], t1))
        codes: Any = diffrax.RESULTS
        result = codes.where(over, codes.max_steps_reached, codes.successful)
        # After a jump nothing of the step before serves.
        return True, start, end, self.starts is not None, controller_state + 1, result


def _jumps(controller) -> bool:
    """Whether a step-size control may know of times at which the derivative jumps."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return controller.jump_ts is not None or _jumps(controller.controller)
    return not isinstance(controller, diffrax.PIDController)


def _along(t, base):
    """The time `t`, which moves with `base` where that is differentiated."""
    return t + (base - jax.lax.stop_gradient(base))
