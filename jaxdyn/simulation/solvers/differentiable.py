"""Reverse mode through adaptive steps: the forward run writes down when its steps end, and backwards the same ones are taken.

diffrax takes steps anew from checkpoints. Their lengths follow from error estimates, of which the last digits depend on the
program, and the program is another one there: a step that is refused in one and kept in the other, and the pieces that
are put together are those of two different runs. With the ends written down nothing is left to decide. Backwards there are no
error estimates and no refused steps either.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")
ROOM = 4096  # steps that are written down where the user gives no limit: 32 kB a trajectory


def run(moving, *, term, solver, controller, event, adjoint, max_steps, progress, dt0=None, record=False):
    """diffrax's solution from one end of the save points to the other.

    **Arguments:** `moving`, what may be differentiated: the initial state, `args`, and the save points (nt,), of which the first
    is the start; the rest as diffrax's.

    **Returns:** rows of the state at ts[1:]; the result, the counts, the time reached and, if the time of an event is looked
    for, the state there; all that diffrax returned, where `record` the times at which steps ended among it.
    """
    y0, args, ts = moving
    located = event is not None and event.root_finder is not None
    saves = diffrax.SubSaveAt(ts=ts[1:])
    last = diffrax.SubSaveAt(t1=True, fn=_state if located else _nothing)
    ends = (diffrax.SubSaveAt(steps=True, fn=_nothing),) if record else ()
    saveat = diffrax.SaveAt(subs=(saves, last, *ends), controller_state=True)
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)  # which takes save points and nothing else
    solved: Any = diffrax.diffeqsolve(
        term,
        solver,
        t0=ts[0],
        t1=ts[-1],
        dt0=dt0,
        y0=y0,
        args=args,
        saveat=diffrax.SaveAt(subs=saves) if continuous else saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        event=event,
        max_steps=max_steps,
        throw=False,
        progress_meter=progress,
    )
    counts = {name: solved.stats[name] for name in COUNTS}
    if continuous:
        reached = jnp.max(jnp.where(jnp.isfinite(solved.ts), solved.ts, ts[0]))
        return solved.ys, (solved.result, counts, reached), solved
    end = (jax.tree.map(lambda rows: rows[0], solved.ys[1]),) if located else ()
    return solved.ys[0], (solved.result, counts, solved.ts[1][0], *end), solved


def run_adaptively(moving, options, limit_is_given: bool):
    """`run` with adaptive steps whose ends are constants to reverse mode; without the last of what it returns."""
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
    return _pulled(perturbed, moving, _again(options, taken), gradients[0])


def _pulled(perturbed, moving, options, gradients):
    """Cotangents of what moves, by diffrax's adjoint."""
    free, fixed = eqx.partition(moving, perturbed)
    rows, pull = eqx.filter_vjp(lambda free: run(eqx.combine(free, fixed), **options)[0], free)
    weights = jax.tree.map(lambda y, g: jnp.zeros_like(y) if g is None else g, rows, gradients)
    return pull(weights)[0]


def _recorded(moving, options, room):
    """As `run`, with the controller that repeats the steps in place of diffrax's solution."""
    changed = {"adjoint": diffrax.ForwardMode(), "max_steps": room, "record": True}
    rows, facts, solved = run(moving, **options | changed)
    starts, jumps = solved.ts[2], _jumps(options["controller"])
    ends = starts
    if jumps is not None:
        # A step ends at the number before a jump, and the next one starts at the second one after it.
        before, after = _beside(jumps, -1), _beside(_beside(jumps, 1), 1)
        passed = (starts[:, None] > before[None]) & (starts[:, None] <= after[None])
        ends = jnp.where(passed.any(1), before[passed.argmax(1)], starts)
    controller = _Repeating(ends, None if jumps is None else starts, solved.stats["num_accepted_steps"])
    return rows, facts, jax.lax.stop_gradient(controller)


def _again(options, controller):
    """What repeats these steps."""
    changed = {"controller": controller, "max_steps": controller.ends.shape[0], "progress": diffrax.NoProgressMeter()}
    return options | changed | {"event": None}


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
        start = t1 if self.starts is None else jnp.where(over, t1, _along(self.starts[controller_state - 1], t1))
        end = jnp.where(over, t1, _along(self.ends[row], t1))
        codes: Any = diffrax.RESULTS
        result = codes.where(over, codes.max_steps_reached, codes.successful)
        # After a jump nothing of the step before serves.
        return True, start, end, self.starts is not None, controller_state + 1, result


def _jumps(controller):
    """Times before and after which a step-size control ends and begins a step, if any."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return _jumps(controller.controller) if controller.jump_ts is None else controller.jump_ts
    return None


def _beside(t, side: int):
    """The next number on a side, as diffrax has it: none is denormal."""
    tiny = jnp.full_like(t, side * jnp.finfo(t.dtype).tiny)
    return jnp.where(t == 0, tiny, jnp.nextafter(t, jnp.full_like(t, side * jnp.inf)))


def _along(t, base):
    """The time `t`, which moves with `base` where that is differentiated."""
    return t + (base - jax.lax.stop_gradient(base))


def _nothing(t, y, args):
    return None


def _state(t, y, args):
    return y
