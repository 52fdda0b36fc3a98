"""Motion with modes: contacts that open and close, friction that sticks and slips, forces that are smooth in pieces.

Within a mode the motion is constrained dynamics with rows that are active or not (`modes`, `reactions`). `system` is the hybrid
system: flow, guards and reset maps, with the mode transitions of `transitions`. `event_loop` makes the steps, locates the events
and differentiates through them. Here are the runs, from the start to the save points: `hybrid_motion`, and `piecewise_motion`
under forces with kinks, whose steps end where a switching function changes its sign.

The rows of all elements are always there, and the mode says by masks which ones act: all modes have one program, and each
trajectory of a batch has its own.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import kernel
from jaxdyn.compile.known import partition_tracers
from jaxdyn.constraints.base import velocity_residual
from jaxdyn.constraints.codes import RESULTS, first_of
from jaxdyn.constraints.redundancy import distribute_multipliers, has_selection
from jaxdyn.constraints.selection import independent_rows, rank_code
from jaxdyn.forces.piecewise import Pieces, fix_pieces, guards, pieces_of
from jaxdyn.simulation.checks import safe_inputs
from jaxdyn.simulation.equations import state_outputs
from jaxdyn.simulation.hybrid.event_loop import HybridRun
from jaxdyn.simulation.hybrid.modes import (
    KINDS,
    Elements,
    Events,
    Mode,
    by_element,
    elements_of,
    extend,
    gaps,
    terms_at,
    tolerance,
)
from jaxdyn.simulation.hybrid.reactions import Collision, coefficients, directions, motion_at, slides
from jaxdyn.simulation.hybrid.system import HybridSystem, ModalSystem
from jaxdyn.simulation.hybrid.transitions import Transition, length, project
from jaxdyn.simulation.methods import consistent, satisfies_redundant_rows
from jaxdyn.simulation.solution import Solution, invalidate_failures, rows_where
from jaxdyn.simulation.solvers.choice import label
from jaxdyn.simulation.solvers.driver import ROOM
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS
from jaxdyn.simulation.solvers.steps import Plan
from jaxdyn.systems.scene import Scene, check_callback, check_force


class _Binder:
    """Scene and control of a run; their traced leaves, `unknown`, are arguments of its functions.

    **Raises:** ValueError for a control whose torque does not fit.
    """

    pieces: Pieces

    def __init__(self, known, nv: int):
        self._known, self._nv = known, nv

    def effort(self, unknown, q, v, t):
        """Torque of the control before the limits of effort, (nv,) or None without a control."""
        control = self._known(unknown)[1]
        return None if control is None else check_force(control(q, v, t), q, self._nv, "control")

    def __call__(self, unknown, positive=None):
        """Scene, generalized_force(q, v, t) without modes, and its switching functions; see `ModalSystem`."""
        scene, _ = self._known(unknown)
        in_piece = scene
        if positive is not None and self.pieces.names:
            in_piece = fix_pieces(scene, self.pieces, positive)
        whole = extend(in_piece)

        def generalized_force(q, v, t):
            force, tau = whole.applied_force(q, v, t), self.effort(unknown, q, v, t)
            if tau is None:
                return force
            tau = in_piece.drive_torque(q, v, t, tau)[0]
            return tau if force is None else tau + force

        return in_piece, generalized_force, lambda q, v, t: guards(scene, q, v, t, self.effort(unknown, q, v, t))


def hybrid_motion(scene: Scene, control, numbers, options) -> Solution:
    """Solution of a run with modes; `numbers` are q0, v0, ts, rtol, atol, and the length of fixed steps or None."""
    for i, force in enumerate(extend(scene).forces):
        first = numbers[0], numbers[1], numbers[2][0]
        check_callback(force, f"forces[{i}]", "force(system, q, v, t)", *first, first=(scene.system,))
    if options.selects_rows:
        scene = independent_rows(scene, numbers[0], numbers[2][0])
    unknown, known = partition_tracers((scene, control))
    unknown, bind = tuple(unknown), _Binder(known, scene.nv)
    effort = None if control is None else lambda _, q, v, t: (bind.effort(unknown, q, v, t),)
    bind.pieces = pieces_of(scene, (), numbers[0], numbers[1], numbers[2][0], effort)
    elements = elements_of(scene, bind.pieces)
    inputs = safe_inputs(scene.system, numbers)
    q0, v0, ts, good = inputs.q0, inputs.v0, inputs.ts, inputs.good
    eps, (rtol, atol, stepsize) = float(jnp.finfo(q0.dtype).eps), inputs.steps
    # Error estimates have rounding of this size: smaller tolerances would refuse every step.
    rtol, atol = (jnp.maximum(x, 10 * eps).astype(q0.dtype) for x in (rtol, atol))

    # The transition at the start of the event loop settles this guess, as after an event.
    mode, slip, start_ok = _guess(scene, elements, q0, v0, ts[0])
    mode = mode._replace(positive=bind(unknown)[2](q0, v0, ts[0]) > 0)
    if scene.constraints:
        start_ok = start_ok & consistent(scene.without_forces, q0, v0, ts[0])
    y0, maximum, max_steps = {"q": q0, "v": v0, "slip": slip}, options.max_events, options.max_steps
    if stepsize is not None and not options.limit_is_given:
        max_steps += SEARCH_STEPS * maximum
    system = ModalSystem(bind, elements, options.solver, y0)
    room = max_steps if stepsize is not None else min(max_steps, ROOM)
    run: Any = HybridRun(system, mode, rtol, atol, stepsize, max_steps, maximum, room=room)
    # A custom rule for reverse mode admits no forward mode: these adjoints need the run without it.
    if isinstance(options.adjoint, (diffrax.ForwardMode, diffrax.DirectAdjoint)):
        run = run.direct
    rows, times, (end, records, begun) = run(y0, unknown, ts)
    # A save point at an event shows the state before it.
    passed = jnp.sum(records.time[None, :maximum] < ts[:, None], 1)
    modes = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:maximum]])[passed], begun.mode, records.mode)
    first = {"q": q0, "v": v0, "slip": begun.slip}
    y = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rows)
    reached = good & jnp.isfinite(y["q"]).all(1) & jnp.isfinite(y["v"]).all(1)
    y = jax.tree.map(partial(rows_where, reached), y, first)

    def correct(unknown, row):
        y, mode, t = row
        return project(bind(unknown)[0], elements, mode, t, y, None)[0]

    def outputs_of(unknown, row):
        return _outputs(bind, elements, options.outputs, unknown, *row)

    later = lax.map(partial(kernel(correct), unknown), jax.tree.map(lambda x: x[1:], (y, modes, ts)))
    y = jax.tree.map(lambda a, b: jnp.concatenate([a[:1], b]), y, later)
    values = lax.map(partial(kernel(outputs_of), unknown), (y, modes, ts))
    ended = (end.result == RESULTS.successful) & ~reached.all()
    cases = [*inputs.faults, (~start_ok, RESULTS.inconsistent_start), (ended, RESULTS.nonfinite_state)]
    if has_selection(scene):
        # Rows are not exchanged between events. Where the kept ones no longer imply the dropped ones, these open.
        agree = lax.map(lambda row: satisfies_redundant_rows(scene, *row), (y["q"], y["v"], ts)).all()
        cases.append(((end.result == RESULTS.successful) & ~agree, RESULTS.open_constraints))
    result = rank_code(scene, first_of(cases, end.result))
    # The end of a run is an input, which has derivatives; the time in the loop has none.
    time_reached = jnp.where(end.t >= ts[-1], ts[-1], end.t)
    times = _times_of_rest(times, lax.stop_gradient(records.tail[:maximum]), ts[-1])
    touched = _impacts_at_start(scene, elements, q0, v0, ts[0], mode)
    events = _events(elements, touched, ts[0], times, records.name[:maximum], good & start_ok)
    rows, times = {"q": y["q"], "v": y["v"], **values}, (jnp.where(good, time_reached, ts[0]), events)
    rows, (time_reached, events) = invalidate_failures(rows, times, result, reached, (scene, control, numbers))
    stats = end.counts | {"time_reached": time_reached}
    return Solution(ts=inputs.given, result=result, stats=stats, events=events, solver=label(options.solver), **rows)


def _outputs(bind: _Binder, elements: Elements, outputs, unknown, y, mode: Mode, t) -> dict[str, Any]:
    """Outputs at one state."""
    scene, generalized_force, _ = bind(unknown)
    q, v = y["q"], y["v"]
    values = state_outputs(scene.system, outputs, q, v, t)
    if "torque" in outputs:
        tau = bind.effort(unknown, q, v, t)
        values["torque"] = scene.drive_torque(q, v, t, jnp.zeros_like(v) if tau is None else tau)[0]
    if {"acceleration", "multipliers", "contact_forces"} & set(outputs):
        terms = terms_at(scene, elements, q, v, t)
        motion = motion_at(scene, elements, mode, terms, y["slip"], generalized_force(q, v, t), q, v, t)
        if "acceleration" in outputs:
            values["acceleration"] = motion.acceleration
        if "multipliers" in outputs:
            values["multipliers"] = distribute_multipliers(scene, q, t, motion.reaction.multipliers[: elements.own])
        if "contact_forces" in outputs:
            values["contact_forces"] = _forces(scene, elements, mode, terms, motion, y["slip"])
    return values


def _guess(scene: Scene, elements, q, v, t):
    """Mode of a start by its position and velocity, directions of sliding, and whether no contact penetrates, ()."""
    small = tolerance(q.dtype)
    # Lengths are compared with one metre and with the configuration, whichever is larger.
    gap, reach = gaps(scene, elements, q, t), 1 + jnp.max(jnp.abs(q))
    slip = by_element(elements, velocity_residual(extend(scene), q, v, t))
    speed, unit = length(slip)
    opens = jnp.asarray(elements.opening)
    mode = Mode(
        ~opens | (gap <= small * reach),
        speed <= small * (1 + jnp.max(jnp.abs(v))),
        jnp.zeros(gap.shape, bool),
        jnp.zeros((0,), bool),
        jnp.zeros_like(gap),
        jnp.zeros_like(gap),
    )
    limit = float(jnp.finfo(q.dtype).eps) ** 0.4
    start_ok = (~opens | (gap >= -limit * reach)).all()
    # Smooth friction is a function of the state, which has no mode that sticks.
    return mode._replace(stick=mode.stick & ~jnp.asarray(elements.smooth)), lax.stop_gradient(unit), start_ok


def _times_of_rest(times, tails, end):
    """Times of events (ne,) with those of impacts that accumulate moved to the limit, up to the next event and the end."""
    known = jnp.where(jnp.isfinite(times), lax.stop_gradient(times), jnp.inf)
    following = jnp.append(known, jnp.inf)[jnp.searchsorted(known, known, side="right")]
    room = jnp.maximum(jnp.minimum(following, lax.stop_gradient(end)) - known, 0.0)
    return times + jnp.where((tails > 0) & jnp.isfinite(known), jnp.minimum(tails, room), 0.0)


def _impacts_at_start(scene: Scene, elements, q, v, t, mode: Mode):
    """Mask of the contacts that are closed by an impact at the start, (n,)."""
    rates = velocity_residual(extend(scene), q, v, t)
    small = tolerance(q.dtype) * (1 + jnp.max(jnp.abs(v)))
    into = [rates[one.normal] < -small if one.opens else jnp.zeros((), bool) for one in elements.each]
    return mode.closed & jnp.stack(into)


def _events(elements, touched, start, times, index, good) -> Events:
    """Events of a run, with the impacts at its start in front; none of a start that is refused."""
    maximum = index.shape[0]
    first = jnp.where(touched, jnp.arange(touched.shape[0], dtype=index.dtype) * len(KINDS), -1)
    index = jnp.concatenate([first, index])
    times = jnp.concatenate([jnp.where(touched, start, jnp.nan), times])
    # Stable: events keep their order in time, and empty places go behind them.
    order = jnp.argsort(index < 0, stable=True)[:maximum]
    index, times = index[order], times[order]
    return Events(jnp.where(good, times, jnp.nan), jnp.where(good, index, -1), elements.names)


def _forces(scene: Scene, elements, mode: Mode, terms, motion, slip) -> dict:
    """Static or sliding friction along the rows (2,) and normal force, (3,), by the names of the elements."""
    along, sliding, forces = directions(scene, elements, mode, terms.slip, slip), slides(elements, mode), {}
    friction, normals = coefficients(scene, elements, slip.dtype).sliding, motion.reaction.normal
    for i, one in enumerate(elements.each):
        level = jnp.where(sliding[i], friction[i] * normals[i], 0.0)
        normal = jnp.where(mode.closed[i], normals[i], 0.0)
        forces[one.name] = jnp.append(motion.reaction.holding[i] - level * along[i], normal)
    return forces


# --- motion under forces that are smooth in pieces: its steps end where a switching function changes its sign ---


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
    system: PiecewiseSystem,
    y0,
    args,
    ts,
    rtol,
    atol,
    stepsize,
    max_steps: int,
    room: int,
    maximum: int,
    is_direct: bool,
):
    """Rows of the state at ts[1:], and the end of the run.

    **Arguments:** `args` of the equations; `stepsize` (s), or None for adaptive steps; `max_steps`, without those that locate
    events; `room` for steps between two events or save points in reverse mode; `maximum`, the number of events that derivatives
    go through; `is_direct`: True for derivatives in forward mode too.
    """
    unknown, flat = tuple(args or ()), ravel_pytree(y0)[0]
    none = jnp.zeros((0,), bool)
    mode = Mode(none, none, none, jnp.ones((system.elements.switches,), bool), *jnp.zeros((2, 0), flat.dtype))
    values, _ = system.guards(ts[0], y0, (unknown, mode))
    rtol, atol = (jnp.asarray(x, flat.dtype) for x in (rtol, atol))
    mode = lax.stop_gradient(mode._replace(positive=values > 0))
    # Attempts that locate events do not count among the user's steps, so that there is room for both.
    run = HybridRun(system, mode, rtol, atol, stepsize, max_steps + SEARCH_STEPS * maximum, maximum, room=room)
    rows, _, (end, _, _) = (run.direct if is_direct else run)(y0, unknown, ts)
    return rows, end
