"""Runs in diffrax's loop, whose reverse mode takes the steps of the forward run.

diffrax recomputes steps from checkpoints. Their lengths follow from error estimates, whose last digits depend on the program,
and the program is another one there: one may refuse a step that the other keeps, and the parts that are put together belong to
two different runs. Here the forward run records the ends of its steps, so that nothing is left to decide on the way back, which
has no error estimates and no refused steps either.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.simulation.solvers.choice import innermost
from jaxdyn.simulation.solvers.guards import delay

COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")
ROOM = 4096  # steps that are recorded where the user gives no limit: 32 kB a trajectory


def run(inputs, *, term, solver, controller, event, adjoint, max_steps, progress, dt0=None, record=False, end=None):
    """diffrax's solution from one end of the save points to the other.

    **Arguments:** `inputs`, what may be differentiated: the initial state, `args`, and the save points (nt,) with the start in
    front; `record`: True to save the times at which steps ended too; `end`, (), s: a time whose state is returned as that of the
    event; the rest as in diffrax.

    **Returns:** rows of the state at ts[1:]; the result, the counts, the time reached and, if the time of an event is located,
    the state there; all that diffrax returned.
    """
    y0, args, ts = inputs
    located = _is_located(event)
    saves = diffrax.SubSaveAt(ts=ts[1:])
    last = diffrax.SubSaveAt(t1=True, fn=_state if located else _nothing)
    last = last if end is None else diffrax.SubSaveAt(ts=end[None])
    ends = (diffrax.SubSaveAt(steps=True, fn=_nothing),) if record else ()
    saveat = diffrax.SaveAt(subs=(saves, last, *ends), controller_state=True)
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)  # supports save points and nothing else
    solved: Any = diffrax.diffeqsolve(
        term,
        _with_scan(solver, adjoint),
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
    end = (jax.tree.map(lambda rows: rows[0], solved.ys[1]),) if located or end is not None else ()
    return solved.ys[0], (solved.result, counts, solved.ts[1][0], *end), solved


def _with_scan(solver, adjoint):
    """The method with loops over its stages that forward mode can differentiate, where an adjoint needs these.

    diffrax sets them on a method, or on one in a wrapper; in two wrappers it does not see the method.
    """
    kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
    inner = innermost(solver)
    if kind is None or not isinstance(inner, diffrax.AbstractRungeKutta) or inner.scan_kind is not None:
        return solver
    return eqx.tree_at(lambda solver: innermost(solver).scan_kind, solver, kind, is_leaf=lambda x: x is None)


def run_adaptively(inputs, options, limit_is_given: bool) -> tuple[Any, tuple]:
    """Rows and facts of `run` with adaptive steps whose ends are constants to reverse mode.

    The time of an event then follows from the state at its end.
    """
    if not isinstance(options["controller"], diffrax.AbstractAdaptiveStepSizeController):
        return run(inputs, **options)[:2]  # with steps that are given, as those of `diffrax.StepTo`
    numbers, rest = eqx.partition(options, eqx.is_array)
    # Tolerances and limits decide which steps are made, and the steps are constants here.
    options = eqx.combine(jax.lax.stop_gradient(numbers), rest)
    room = options["max_steps"] if limit_is_given else min(options["max_steps"], ROOM)
    if isinstance(options["adjoint"], diffrax.RecursiveCheckpointAdjoint):
        return _with_end(_run(inputs, options, room), inputs[1], options)
    if isinstance(options["adjoint"], diffrax.DirectAdjoint):
        numbers, rest = eqx.partition(inputs, eqx.is_array)
        facts, steps = _record(eqx.combine(jax.lax.stop_gradient(numbers), rest), options, options["max_steps"])[1:]
        rows, repeated, _ = run(inputs, **_repeat(options, steps, facts[2]))
        return _with_end((rows, (*facts[:3], *repeated[3:])), inputs[1], options)
    return run(inputs, **options)[:2]


@eqx.filter_custom_vjp
def _run(inputs, options, room):
    return run(inputs, **options)[:2]


@_run.def_fwd
def _(perturbed, inputs, options, room):
    rows, facts, steps = _record(inputs, options, room)
    return (rows, facts), (steps, facts[2])


@_run.def_bwd
def _(residuals, gradients, perturbed, inputs, options, room):
    free, fixed = eqx.partition(inputs, perturbed)
    options = _repeat(options, *residuals)

    def states(free):
        rows, facts, _ = run(eqx.combine(free, fixed), **options)
        return rows, facts[3:]

    values, pull = eqx.filter_vjp(states, free)
    of_states = gradients[0], gradients[1][3:]
    return pull(jax.tree.map(lambda y, g: jnp.zeros_like(y) if g is None else g, values, of_states))[0]


def _is_located(event) -> bool:
    """True for an event whose time within a step is found."""
    return event is not None and event.root_finder is not None


def _with_end(solved, args, options):
    """Rows and facts, whose time of an event has its derivative."""
    rows, (result, counts, reached, *last) = solved
    if not last:
        return solved
    codes: Any = diffrax.RESULTS
    event, term, (end,) = options["event"], options["term"], last
    y, unravel = ravel_pytree(end)

    def guard(given, t, y):
        args, condition = given
        return condition(t, unravel(y), args)

    def field(given, t, y):
        return ravel_pytree(term.vf_prod(t, unravel(y), given[0], term.contr(t, t + 1)))[0]

    late = delay(guard, field, (args, event.cond_fn), reached, y)
    return rows, (result, counts, reached + jnp.where(result == codes.event_occurred, late, 0.0), end)


def _record(inputs, options, room):
    """Rows and facts of `run`, and the controller that repeats its steps."""
    changes = {"adjoint": diffrax.ForwardMode(), "max_steps": room, "record": True}
    rows, facts, solution = run(inputs, **options | changes)
    starts, jumps = solution.ts[2], _jumps(options["controller"])
    ends = starts
    if jumps is not None:
        # A step ends at the number before a jump, and the next one starts at the second one after it.
        before, after = _beside(jumps, -1), _beside(_beside(jumps, 1), 1)
        is_jump = (starts[:, None] > before[None]) & (starts[:, None] <= after[None])
        ends = jnp.where(is_jump.any(1), before[is_jump.argmax(1)], starts)
    controller = _GivenSteps(ends, None if jumps is None else starts, solution.stats["num_accepted_steps"])
    return rows, facts, jax.lax.stop_gradient(controller)


def _repeat(options, controller, end):
    """Options of a run that repeats steps, with the state at the time `end` if that is the time of an event."""
    end = jax.lax.stop_gradient(end) if _is_located(options["event"]) else None
    changes = {"controller": controller, "max_steps": controller.ends.shape[0], "progress": diffrax.NoProgressMeter()}
    return options | changes | {"event": None, "end": end}


class _GivenSteps(diffrax.AbstractStepSizeController):
    """Step-size control by steps that were recorded."""

    ends: jax.Array
    starts: jax.Array | None
    count: jax.Array

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        # Where no step was kept, one of no length.
        return jnp.where(self.count > 0, _along(self.ends[0], t0), t0), jnp.asarray(1)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        # Behind the last record the index is held within the array: the code reports that steps are missing.
        row = jnp.minimum(controller_state, self.ends.shape[0] - 1)
        over = controller_state >= self.count
        start = t1 if self.starts is None else jnp.where(over, t1, _along(self.starts[controller_state - 1], t1))
        end = jnp.where(over, t1, _along(self.ends[row], t1))
        codes: Any = diffrax.RESULTS
        result = codes.where(over, codes.max_steps_reached, codes.successful)
        # With jumps the state of the previous step is not valid any more.
        return True, start, end, self.starts is not None, controller_state + 1, result


def _jumps(controller):
    """Times of jumps at which a step-size control ends and begins a step, if any."""
    if isinstance(controller, diffrax.ClipStepSizeController):
        return _jumps(controller.controller) if controller.jump_ts is None else controller.jump_ts
    return None


def _beside(t, side: int):
    """Next floating-point number on a side, as diffrax computes it: none is denormal."""
    tiny = jnp.full_like(t, side * jnp.finfo(t.dtype).tiny)
    return jnp.where(t == 0, tiny, jnp.nextafter(t, jnp.full_like(t, side * jnp.inf)))


def _along(t, base):
    """Time `t`, with the derivatives of `base`."""
    return t + (base - jax.lax.stop_gradient(base))


def _nothing(t, y, args):
    return None


def _state(t, y, args):
    return y
