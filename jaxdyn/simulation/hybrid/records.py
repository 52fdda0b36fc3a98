"""Records of the events of a motion, which its derivatives replay."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxdyn.simulation.hybrid.impacts import Collision
from jaxdyn.simulation.hybrid.modes import CHANNELS, KINDS, Elements, Mode
from jaxdyn.simulation.hybrid.transitions import Transition


class Records(NamedTuple):
    """Records of events, a row each; the last row is for what is not kept."""

    time: Array
    tail: Array  # time from it to rest, of impacts that accumulate there, s
    name: Array  # index among `Elements.names`
    trigger: Array  # the guard that fell to zero, -1 for an event that came with another one
    impact: Collision
    mode: Mode  # after the event
    slip: Array


def no_records(elements: Elements, dtype, most: int) -> Records:
    """Records before the first event."""
    n, none = len(elements.each), jnp.zeros((most + 1,), jnp.int32)
    flags, slip = jnp.zeros((most + 1, n), bool), jnp.zeros((most + 1, n, 2), dtype)
    mode = Mode(flags, flags, flags, jnp.zeros((most + 1, elements.switches), bool), slip[..., 0], slip[..., 0])
    impact = Collision(mode, slip, slip[..., 0], flags, flags)
    times = jnp.full((most + 1,), jnp.nan, dtype)
    return Records(times, jnp.zeros_like(times), none - 1, none - 1, impact, mode, slip)


def record_elements(
    elements: Elements, t, before: Mode, change: Transition, hit, happens, rows: Records, count, most: int
):
    """Records with a row for each element that an event has changed, and their number."""
    mode, number = change.mode, jnp.arange(len(elements.each), dtype=jnp.int32)
    kind = jnp.where((mode.stick & before.stick) | (mode.creep != before.creep), 5, 4)
    kind = jnp.where(mode.stick & ~before.stick, 2, jnp.where(before.stick & ~mode.stick, 3, kind))
    # A contact that is hit may let go at once.
    hits = (mode.closed | hit[:, 0]) & ~before.closed
    kind = jnp.where(hits, 0, jnp.where(before.closed & ~mode.closed, 1, kind))
    # What stands still beyond its cone is given room: the guard of a mode has changed, and its derivative.
    differs = (mode.closed != before.closed) | (mode.stick != before.stick) | (mode.negative != before.negative)
    differs = differs | (mode.excess != before.excess) | (mode.creep != before.creep)
    changed = happens & (hit.any(1) | differs)
    leading = jnp.argmax(hit.reshape(-1)).astype(jnp.int32)
    # First the element whose guard it was, which carries the impact; then those that came with it.
    leads = hit.any() & (number == leading // CHANNELS) & changed
    rank = jnp.cumsum(changed & ~leads, dtype=jnp.int32) + leads.any().astype(jnp.int32) - 1
    rank = jnp.where(leads, jnp.zeros_like(rank), rank)
    # A scatter needs a place for what is not kept too: the spare last row.
    places = jnp.where(changed & (count + rank < most), count + rank, most)

    def by_row(first, others):
        """For the leading element the one, for the others the other."""
        return jax.tree.map(lambda a, b: jnp.where(leads.reshape(-1, *[1] * a.ndim), a, b), first, others)

    none = jnp.zeros_like(change.impact.rebound)
    still = Collision(mode, change.slip, none, none > 0, none > 0)
    new = Records(
        jnp.broadcast_to(t, number.shape),
        jnp.where(kind == 0, change.tail, 0.0),
        number * len(KINDS) + kind.astype(jnp.int32),
        jnp.where(leads, leading, -1),
        by_row(change.impact, still),
        *by_row((mode, change.slip), (mode, change.slip)),
    )
    rows = jax.tree.map(lambda all_, new: all_.at[places].set(new.astype(all_.dtype)), rows, new)
    return rows, count + jnp.sum(changed, dtype=jnp.int32)


def record_switches(elements: Elements, t, count, mode: Mode, records: Records, switched, slip, most: int):
    """Records with a row for each switching function that changed its sign, and their number."""
    # Functions that switch together take consecutive rows.
    index = jnp.cumsum(switched, dtype=jnp.int32) - 1
    places = jnp.where(switched, jnp.minimum(count + index, most), most)
    # They change one after the other: the mode of a row has the changes of the rows before it and its own.
    earlier = switched[None] & (index[None] <= index[:, None])
    k, first = elements.switches, len(elements.each)
    number = jnp.arange(k, dtype=jnp.int32)
    modes, slip = jax.tree.map(lambda x: jnp.broadcast_to(x, (k, *x.shape)), (mode, slip))
    modes = modes._replace(positive=modes.positive ^ earlier)
    rows = Records(
        jnp.broadcast_to(t, (k,)),
        jnp.zeros((k,), t.dtype),
        first * len(KINDS) + number,
        first * CHANNELS + number,
        Collision(modes, slip, slip[..., 0], slip[..., 0] > 0, slip[..., 0] > 0),
        modes,
        slip,
    )
    rows = jax.tree.map(lambda all_, new: all_.at[places].set(new.astype(all_.dtype)), records, rows)
    return rows, count + jnp.sum(switched, dtype=jnp.int32)


def chatters(elements: Elements, t, usual, count, records: Records, switched, most: int):
    """True if a switching function changes back at once: on both sides of its zero the force drives the motion onto it."""
    last = jnp.maximum(jnp.minimum(count, most) - 1, 0)
    names = jnp.arange(elements.switches, dtype=jnp.int32) + len(elements.each) * len(KINDS)
    # Two events of one function within the rounding of the time: the motion cannot leave the zero between them.
    least = 64 * float(jnp.finfo(t.dtype).eps) * jnp.maximum(jnp.abs(t), usual)
    return ((names == records.name[last]) & switched).any() & (t - records.time[last] <= least)
