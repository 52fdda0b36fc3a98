"""Integration from the start to the save points, and reverse mode through its events.

Backwards the motion is taken again in pieces, from each save point or event to the next, within the modes that are known by then;
steps of fixed length begin anew with each piece.
Each piece is differentiated as motions without events are. At an event the condition e of the mode falls to zero, so its time
follows what moves e at that moment,

    dt = -de / (de/dt),

the state is taken to that time by its rate before the event, goes through the impact, and begins the next piece there. That is
what saltation matrices say.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import cond
from jaxdyn.simulation.hybrid import machine
from jaxdyn.simulation.hybrid.machine import Laws, Records
from jaxdyn.simulation.hybrid.modes import Mode
from jaxdyn.simulation.solvers import driver
from jaxdyn.simulation.solvers.driver import Drive


class Hybrid(eqx.Module):
    """How a motion is made: hybrid(y0, unknown, ts) -> rows of the state at ts[1:]; times of events; lane, records and start.

    Derivatives reach y0, `unknown` and ts through rows and times of events: of a call in reverse mode, of `direct` in both.
    """

    laws: Laws = eqx.field(static=True)
    mode: Mode
    rtol: Any
    atol: Any
    stepsize: Any  # None for adaptive steps
    max_steps: int = eqx.field(static=True)
    most: int = eqx.field(static=True)
    room: int = eqx.field(static=True)  # steps from one event or save point to the next, at most

    def __call__(self, y0, unknown, ts):
        return _driven((y0, unknown, ts), lax.stop_gradient(self))

    def direct(self, y0, unknown, ts):
        """The same for forward mode too."""
        return _value((y0, unknown, ts), lax.stop_gradient(self))

    def driven(self, moving):
        """What a call returns."""
        y0, unknown, ts = moving
        flat, _ = ravel_pytree(y0)
        rows, lane, records, begun = machine.drive(
            self.laws,
            unknown,
            ts,
            flat,
            self.mode,
            self.laws.slip(flat),
            self.rtol,
            self.atol,
            self.stepsize,
            self.max_steps,
            self.most,
        )
        return jax.vmap(self.laws.plan.structure)(rows), records.time[: self.most], (lane, records, begun)


@eqx.filter_custom_vjp
def _driven(moving, how: Hybrid):
    return _value(moving, how)


@_driven.def_fwd
def _(perturbed, moving, how: Hybrid):
    driven = _value(moving, how)
    return driven, driven[2]


@_driven.def_bwd
def _(facts, gradients, perturbed, moving, how: Hybrid):
    y0, _, ts = moving
    count = ts.shape[0] - 1
    rows, times, _ = gradients
    rows = jax.tree.map(lambda y, g: jnp.zeros((count, *y.shape), y.dtype) if g is None else g, y0, rows)
    times = jnp.zeros((how.most,), ts.dtype) if times is None else times
    times = jnp.where(facts[1].name[: how.most] < 0, jnp.zeros_like(times), times)  # of events that there were not
    return _pulled((moving, (rows, times)), lax.stop_gradient(facts), how, perturbed)


@eqx.filter_custom_jvp
def _value(moving, how: Hybrid):
    return how.driven(moving)


@_value.def_jvp
def _(primals, tangents):
    moving, how = primals
    rows, times, facts = _value(moving, how)
    known = lax.stop_gradient(facts)
    _, changes = eqx.filter_jvp(lambda moving: _replayed(how, moving, *known, direct=True), (moving,), (tangents[0],))
    return (rows, times, facts), (*changes, jax.tree.map(lambda _: None, facts))


def _pull(given, facts, how: Hybrid, perturbed, direct: bool):
    moving, weights = given
    free, fixed = eqx.partition(moving, perturbed)
    _, pull = jax.vjp(lambda free: _replayed(how, eqx.combine(free, fixed), *facts, direct=direct), free)
    return pull(weights)[0]


@eqx.filter_custom_jvp
def _pulled(given, facts, how: Hybrid, perturbed):
    return _pull(given, facts, how, perturbed, False)


@_pulled.def_jvp
def _(primals, tangents):
    given, facts, how, perturbed = primals
    _, change = eqx.filter_jvp(lambda given: _pull(given, facts, how, perturbed, True), (given,), (tangents[0],))
    return _pulled(*primals), change


def _replayed(how: Hybrid, moving, lane, records, begun, direct: bool):
    """Rows at ts[1:] and times of events, taken again in the modes that are known; `direct`: differentiable in both modes."""
    laws, (y0, unknown, ts) = how.laws, moving
    saves, most = ts.shape[0] - 1, how.most
    happened = records.name[:most] >= 0
    known_times = jnp.concatenate([ts[1:], jnp.where(happened, records.time[:most], jnp.inf)])
    is_event = jnp.arange(saves + most) >= saves
    order = jnp.lexsort((is_event, lax.stop_gradient(known_times)))  # a save point at an event is before it
    control: Any = driver.Adaptive(laws.error_order, optimistix.rms_norm)
    if how.stepsize is not None:
        control = driver.Fixed(laws.order, laws.error_order)
    end = lax.stop_gradient(lane.t)

    def taken(carry, at):
        # Most of the events that there is room for did not happen.
        happens = ~is_event[at] | happened[jnp.clip(at - saves, 0, most - 1)]
        return cond(happens, piece, lambda carry, at: (carry, carry[:2]), carry, at)

    def piece(carry, at):
        t, y, mode = carry
        event, place = is_event[at], jnp.clip(at - saves, 0, most - 1)
        record = jax.tree.map(lambda x: x[place], records)
        until = jnp.where(event, lax.stop_gradient(record.time), ts[1:][jnp.clip(at, 0, saves - 1)])
        known = ~event | (record.name >= 0)
        advances = known & (until > t) & (until <= end)
        until = jnp.where(advances, until, t)
        drive = Drive(laws.plan, control, how.rtol, how.atol, how.stepsize, how.max_steps, how.room)
        driven, _, _ = (drive.direct if direct else drive)(
            laws.plan.structure(y), (unknown, mode), jnp.stack([t, until])
        )
        here = jnp.where(advances, ravel_pytree(jax.tree.map(lambda x: x[0], driven))[0], y)
        landed = _crossed(laws, unknown, mode, record, t, until, here)
        crosses = event & known
        t, y = (jnp.where(crosses, a, b) for a, b in zip(landed, (until, here), strict=True))
        mode = jax.tree.map(lambda a, b: jnp.where(crosses, a, b), record.mode, mode)
        return (t, y, mode), (t, here)

    y = _with_slip(laws, laws.land(unknown, begun.impact, begun.impact_slip, ts[0], ravel_pytree(y0)[0]), begun.slip)
    _, (times, rows) = lax.scan(jax.checkpoint(taken), (ts[0], y, begun.mode), order)
    back = jnp.argsort(order)
    # A motion that went on beyond the events that there was room for has no derivative here.
    rows = rows * jnp.where((lane.count > most) & (lane.code == machine.FINE), jnp.nan, 1.0).astype(rows.dtype)
    return jax.vmap(laws.plan.structure)(rows[back[:saves]]), times[back[saves:]]


def _crossed(laws: Laws, unknown, mode: Mode, record: Records, t, known_time, y):
    """Time and state behind an event; y is the state at the time that is known."""
    hit, which = record.trigger >= 0, jnp.maximum(record.trigger, 0)

    def condition(t, y):
        return kernel(machine.judged, static=1)(laws, (unknown, mode), t, y)[0].reshape(-1)[which]

    rate = lax.stop_gradient(laws.plan.field_of((unknown, mode), known_time, y))
    fixed = lax.stop_gradient((known_time, y))
    _, slope = jax.jvp(condition, fixed, (jnp.ones_like(known_time), rate))
    value = condition(known_time, y)
    is_regular = hit & (slope != 0)
    late = (value - lax.stop_gradient(value)) / lax.stop_gradient(jnp.where(is_regular, slope, jnp.ones_like(slope)))
    late = jnp.where(is_regular, late, jnp.zeros_like(late))
    time = jnp.where(hit, known_time - late, t)
    y = laws.land(unknown, record.impact, record.impact_slip, time, y - late * rate)
    return time, _with_slip(laws, y, record.slip)


def _with_slip(laws: Laws, y, slip):
    return laws.placed(y, laws.plan.structure(y)["v"], lax.stop_gradient(slip))
