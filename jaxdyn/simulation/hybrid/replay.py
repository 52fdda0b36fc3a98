"""Integration with events from the start to the save points, and its derivatives by replay.

For derivatives the motion is replayed in parts, from each save point or event to the next, within the modes that are known by
then; steps of fixed length begin anew with each part. Each part is differentiated as motions without events are. At an event the
guard e of the mode falls to zero, so its time follows the change of e at that moment,

    dt = -de / (de/dt)

to first order (`delay` has the second one too). The state is taken to that time by the motion before the event, goes through the
impact, and begins the next part there. To first order these are the saltation matrices of the literature.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile.batch import cond
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.simulation.hybrid.event_loop import Records, guards_at, run_events
from jaxdyn.simulation.hybrid.modes import Mode
from jaxdyn.simulation.hybrid.system import HybridSystem
from jaxdyn.simulation.solvers.driver import step_control
from jaxdyn.simulation.solvers.guards import delay
from jaxdyn.simulation.solvers.integrator import ExplicitRun, Integrator, zeros_or


class HybridRun(Integrator):
    """Integrator with events: call(y0, unknown, ts) -> rows of the state at ts[1:]; times of events; end, records and start.

    Derivatives reach y0, `unknown` and ts through rows and times of events. `room`: steps from one of these to the next.
    """

    system: HybridSystem = eqx.field(static=True)
    mode: Mode
    rtol: Any
    atol: Any
    stepsize: Any  # None for adaptive steps
    max_steps: int = eqx.field(static=True)
    most: int = eqx.field(static=True)  # events

    def values(self, inputs, room):
        y0, unknown, ts = inputs
        steps = self.rtol, self.atol, self.stepsize, self.max_steps, self.most
        rows, end, records, begun = run_events(self.system, unknown, ts, ravel_pytree(y0)[0], self.mode, *steps)
        facts = end, records, begun
        return (jax.vmap(self.system.plan.structure)(rows), records.time[: self.most], facts), facts

    def replay(self, history, inputs, direct):
        end, records, begun = history
        return _replay(self, inputs, end, records, begun, direct)

    def weights(self, inputs, gradients, history):
        y0, _, ts = inputs
        rows, times, _ = gradients
        times = jnp.zeros((self.most,), ts.dtype) if times is None else times
        # Events that did not happen have no time.
        times = jnp.where(history[1].name[: self.most] < 0, jnp.zeros_like(times), times)
        return zeros_or(rows, y0, ts.shape[0] - 1), times


def _replay(run: HybridRun, inputs, end, records, begun, direct: bool):
    """Rows at ts[1:] and times of events by replay in the modes that are known; `direct`: differentiable in both modes."""
    system, (y0, unknown, ts) = run.system, inputs
    plan, saves, most = system.plan._replace(guards=None), ts.shape[0] - 1, run.most
    happened = records.name[:most] >= 0
    known_times = jnp.concatenate([ts[1:], jnp.where(happened, records.time[:most], jnp.inf)])
    is_event = jnp.arange(saves + most) >= saves
    order = jnp.lexsort((is_event, lax.stop_gradient(known_times)))  # a save point at an event is before it
    part_run = ExplicitRun(
        plan, step_control(plan.solver(), run.stepsize), run.rtol, run.atol, run.stepsize, run.max_steps, room=run.room
    )
    last = lax.stop_gradient(end.t)

    def part_or_none(carry, at):
        # There is room for more events than happened: the rest is skipped.
        happens = ~is_event[at] | happened[jnp.clip(at - saves, 0, most - 1)]
        return cond(happens, part, lambda carry, at: (carry, carry[:2]), carry, at)

    def part(carry, at):
        t, y, mode = carry
        event, place = is_event[at], jnp.clip(at - saves, 0, most - 1)
        record = jax.tree.map(lambda x: x[place], records)
        # The derivative of an event's time enters by `_cross`: here the time is a constant.
        until = jnp.where(event, lax.stop_gradient(record.time), ts[1:][jnp.clip(at, 0, saves - 1)])
        known = ~event | (record.name >= 0)
        # Parts of no length, of events at the same time, make no steps; nothing is known beyond the end of the run.
        advances = known & (until > t) & (until <= last)
        until = jnp.where(advances, until, t)
        integrate: Any = part_run.direct if direct else part_run
        rows, *_ = integrate(plan.structure(y), (unknown, mode), jnp.stack([t, until]))
        here = jnp.where(advances, ravel_pytree(jax.tree.map(lambda x: x[0], rows))[0], y)
        behind = _cross(system, unknown, mode, record, t, until, here)
        crosses = event & known
        t, y = (jnp.where(crosses, a, b) for a, b in zip(behind, (until, here), strict=True))
        mode = jax.tree.map(lambda a, b: jnp.where(crosses, a, b), record.mode, mode)
        return (t, y, mode), (t, here)

    # The start may be an impact, whose velocity follows the start.
    y = system.impact(unknown, begun.impact, ts[0], ravel_pytree(y0)[0])
    y = system.with_slip(y, None, lax.stop_gradient(begun.slip))
    # With a checkpoint, reverse mode keeps one state a part, and the steps of one part at a time.
    _, (times, rows) = lax.scan(jax.checkpoint(part_or_none), (ts[0], y, begun.mode), order)
    # The inverse permutation: save points first, then events.
    back = jnp.argsort(order)
    # A motion that continued beyond the events that there was room for has no derivative here.
    rows = rows * jnp.where((end.count > most) & (end.result != RESULTS.too_many_events), jnp.nan, 1.0).astype(
        rows.dtype
    )
    return jax.vmap(plan.structure)(rows[back[:saves]]), times[back[saves:]]


def _cross(system: HybridSystem, unknown, mode: Mode, record: Records, t, known_time, y):
    """Time and state behind an event; y is the state at the time that is known."""
    hit, which = record.trigger >= 0, jnp.maximum(record.trigger, 0)

    def guard(given, t, y):
        *args, which = given
        return guards_at(system.plan, tuple(args), t, y)[0][which]

    def field(given, t, y):
        return system.plan.field_of(given[:2], t, y)

    late = jnp.where(hit, delay(guard, field, (unknown, mode, which), known_time, y), 0.0)
    time = jnp.where(hit, known_time + late, t)
    # To the event by the motion before it: a shift of value zero, with the first and second derivatives of the time.
    y = _shift(system.plan, (unknown, mode), known_time, y, late)
    y = system.impact(unknown, record.impact, time, y)
    return time, system.with_slip(y, None, lax.stop_gradient(record.slip))


def _shift(plan, args, t, y, late):
    """State `late` after t, which is zero in value: y + late y' + late^2 y''/2."""

    def field(t, y):
        return plan.field_of(args, t, y)

    rate, change = jax.jvp(field, (t, y), (jnp.ones_like(t), lax.stop_gradient(plan.field_of(args, t, y))))
    return y + late * rate + late**2 / 2 * lax.stop_gradient(change)
