"""Motion under forces that are smooth in pieces: its steps end where a switching function changes its sign."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.forces.piecewise import Pieces
from jaxdyn.simulation.hybrid.modes import Elements, Mode
from jaxdyn.simulation.hybrid.reactions import Collision
from jaxdyn.simulation.hybrid.replay import HybridRun
from jaxdyn.simulation.hybrid.system import HybridSystem
from jaxdyn.simulation.hybrid.transitions import Transition
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS

MIN_EVENTS = 256  # events that derivatives go through, at least


class PiecewiseSystem(HybridSystem):
    """System whose only modes are those of piecewise smooth forces.

    **Arguments:** `plan` of its steps and switching(t, y, args) -> values and rounding levels (k,); the arguments of both are
    followed by flags of the values that are positive.
    """

    def __init__(self, plan: Plan, pieces: Pieces, switching: Callable):
        self.elements, self._plan, self._switching = Elements((), 0, 0, pieces), plan, switching
        project = None if plan.project is None else self._project
        self.plan = plan._replace(field=self._field, project=project, guards=self.guards)

    def _field(self, t, y, args):
        return self._plan.field(t, y, (*args[0], args[1].positive))

    def _project(self, t, y, error, args):
        project: Any = self._plan.project
        return project(t, y, error, (*args[0], args[1].positive))

    def guards(self, t, y, args):
        values, levels = self._switching(t, y, (*args[0], args[1].positive))
        return jnp.where(args[1].positive, values, -values), levels

    def reset(self, unknown, t, y, mode, slip, hit, happens, atol):
        # Forces are finite on both sides of a zero: the piece changes, and the velocity does not jump.
        mode, yes = mode._replace(positive=mode.positive ^ hit), jnp.ones((), bool)
        none = jnp.zeros((0,), y.dtype)
        collision = Collision(mode, slip, none, none > 0, none > 0)
        return Transition(collision, mode, slip, none, yes, ~yes, jnp.zeros((), y.dtype))

    def impact(self, unknown, collision, t, y):
        return y

    def begin(self, args, t, y):
        return y

    def slip(self, y):
        return jnp.zeros((0, 2), y.dtype)

    def with_slip(self, y, v, slip):
        return y


def piecewise_motion(
    system: PiecewiseSystem, y0, args, ts, rtol, atol, stepsize, max_steps: int, room: int, most: int, is_direct: bool
):
    """Rows of the state at ts[1:], and the end of the run.

    **Arguments:** `args` of the equations; `stepsize` (s), or None for adaptive steps; `max_steps`, without those that locate
    events; `room` for steps between two events or save points in reverse mode; `most`, the number of events that derivatives go
    through; `is_direct`: True for derivatives in forward mode too.
    """
    unknown, flat = tuple(args or ()), ravel_pytree(y0)[0]
    none = jnp.zeros((0,), bool)
    mode = Mode(none, none, none, jnp.ones((system.elements.switches,), bool), *jnp.zeros((2, 0), flat.dtype))
    values, _ = system.guards(ts[0], y0, (unknown, mode))
    rtol, atol = (jnp.asarray(x, flat.dtype) for x in (rtol, atol))
    mode = lax.stop_gradient(mode._replace(positive=values > 0))
    # Attempts that locate events do not count among the user's steps, so that there is room for both.
    run = HybridRun(system, mode, rtol, atol, stepsize, max_steps + SEARCH_STEPS * most, most, room=room)
    rows, _, (end, _, _) = (run.direct if is_direct else run)(y0, unknown, ts)
    return rows, end
