"""A run of forces that are smooth in pieces: its steps end where a switching function changes its sign."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.simulation.hybrid import machine
from jaxdyn.simulation.hybrid.machine import Laws
from jaxdyn.simulation.hybrid.modes import Mode
from jaxdyn.simulation.hybrid.replay import Hybrid

EVENTS = 256  # of which derivatives know, at least


def motion_in_pieces(
    laws: Laws, y0, args, ts, tolerances, stepsize, max_steps: int, room: int, most: int, is_direct: bool
):
    """Rows of the state at ts[1:]; diffrax's result, counts and the time reached; sums about fixed steps, or None.

    **Arguments:** `args` of the equations; `tolerances`, relative and absolute; `stepsize` (s), or None for adaptive steps;
    `max_steps`, without those that look for events; `room` for steps between two events or save points in reverse mode; `most`,
    the events of which derivatives know; `is_direct`: whether for forward mode too.
    """
    unknown = tuple(args or ())
    flat = ravel_pytree(y0)[0]
    none = jnp.zeros((0,), bool)
    k = laws.elements.switches
    first = Mode(none, none, none, jnp.ones((k,), bool))
    values, _ = laws.judge((unknown, first), ts[0], flat)
    rtol, atol = (jnp.asarray(x, flat.dtype) for x in tolerances)
    mode = lax.stop_gradient(first._replace(positive=values > 0))
    hybrid = Hybrid(laws, mode, rtol, atol, stepsize, max_steps + machine.SEARCHED * most, most, room)
    rows, _, (lane, _, _) = (hybrid.direct if is_direct else hybrid)(y0, unknown, ts)
    codes: Any = diffrax.RESULTS
    result = codes.where(lane.t < ts[-1], codes.max_steps_reached, codes.successful)
    result = codes.where(lane.code == machine.SHORT, codes.dt_min_reached, result)
    result = codes.where(lane.code == machine.CROWDED, codes.event_occurred, result)
    counts = {"num_steps": lane.taken, "num_accepted_steps": lane.kept, "num_rejected_steps": lane.taken - lane.kept}
    return rows, (result, counts, lane.t), None if stepsize is None else lane.sums
