"""Integration from a start to the save points: the solver, the loop (our own or diffrax's), and the code at the end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.simulation import controls, terminal_events
from jaxdyn.simulation.equations import KEPT, Equations
from jaxdyn.simulation.methods import Reduced, is_regular
from jaxdyn.simulation.options import Options, is_step_length
from jaxdyn.simulation.solution import RESULTS, from_diffrax
from jaxdyn.simulation.solvers import ExplicitSteps, ProjectedSolver
from jaxdyn.simulation.solvers.base import Adaptive, ErrorMonitoredSteps, too_coarse
from jaxdyn.simulation.solvers.choice import (
    has_name,
    is_explicit,
    label,
    progress_meter,
    solver_and_control,
)
from jaxdyn.simulation.solvers.driver import step_control
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS, delay
from jaxdyn.simulation.solvers.integrator import ROOM, ExplicitRun, run, run_adaptively


class Outcome(NamedTuple):
    """Rows of the state at ts[1:], a code, counts, the time reached, and the state there if an event may end the run."""

    rows: Any
    result: Any
    counts: dict[str, Any]
    time_reached: Any
    last: Any = None


def integrate(term, project, eqs: Equations, args, method, y0, ts, steps, options: Options) -> Outcome:
    """Integrate from the start to the save points."""
    adjoint, has_length = options.adjoint, is_step_length(steps[-1])
    solver: Any
    solver, controller, dt0 = solver_and_control(options.solver, term, ts, *steps)
    # The continuous adjoint integrates another vector field backwards: projections and events of y do not apply to it.
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)
    step_constants = (*method.step_constants, *({controls.HELD, KEPT} & set(y0)))
    reason = _reason_for_diffrax(solver, controller, adjoint, options)
    if is_explicit(solver) and not continuous:
        solver = ExplicitSteps(solver, project, step_constants, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, step_constants, method.projects)
    quality, guards = (None, None) if continuous else _monitors(eqs, method)
    of_kinks = reason or _reason_for_crossing(quality, guards)
    inputs = y0, args, ts
    if eqs.pieces.names and of_kinks:
        inputs = undifferentiable(inputs, of_kinks)
    if reason:
        controller = diffrax.ConstantStepSize() if continuous and has_length else controller
        if guards is not None:
            solver = terminal_events.GuardedSolver(solver, guards)
            y0 = y0 | {terminal_events.WITHIN: jnp.ones_like(ts[0])}
            inputs = y0, *inputs[1:]
        event = terminal_events.event(quality, guards, ts[0], y0, args)
        outcome = _by_diffrax(term, solver, controller, event, dt0, inputs, steps, options)
        return outcome._replace(rows=_without_mark(outcome.rows), last=_without_mark(outcome.last))
    if eqs.pieces.names and not of_kinks:
        return _by_pieces(solver.plan(y0), eqs, inputs, controller, steps, options)
    plan = solver.plan(y0)._replace(quality=quality, guards=guards)
    return _by_steps(solver, plan, controller, inputs, steps, options)


def _monitors(eqs: Equations, method) -> tuple[Callable | None, Callable | None]:
    """Functions (t, y, args) that end a run: the quality of a basis where it changes its sign, guards where one is negative."""

    def quality(t, y, args, **_):  # diffrax passes more to the condition of an event
        # Near a singular basis steps become short; a long one may pass it, which the sign shows.
        value = eqs.quality(t, y, args)
        return jnp.where(is_regular(value), value, jnp.zeros_like(value))

    return quality if isinstance(method, Reduced) else None, eqs.guards if any(eqs.conditions) else None


def _reason_for_diffrax(solver, controller, adjoint, options) -> str | None:
    """Reason why diffrax makes the steps, or None: the library's own loop makes them."""
    if not is_explicit(solver):
        return f"solver is {label(options.solver)}; take an explicit one, such as diffrax.Dopri8()"
    # Subclasses and wrappers, such as a clip to samples, have rules that our loops do not know.
    if type(controller) not in (Adaptive, ErrorMonitoredSteps):
        return "stepsize is a controller; leave it out"
    if isinstance(adjoint, diffrax.BacksolveAdjoint) or not has_name(adjoint):
        return f"adjoint is {type(adjoint).__name__}; take 'reverse'"
    return "progress is shown; leave it out" if options.progress else None


def _reason_for_crossing(quality, guards) -> str | None:
    """Reason why explicit steps go across the kinks of forces instead of ending there, or None."""
    if guards is not None:
        return (
            "contacts, limits, a terminal event or the control may end the run; pass jd.events.ContactLost(stop=False) "
            "and no other events"
        )
    return None if quality is None else "method is 'reduced'; take 'projected'"


def _without_mark(y):
    """State without the mark of `GuardedSolver`."""
    return y and {name: y[name] for name in y if name != terminal_events.WITHIN}


def undifferentiable(tree, reason: str):
    """Arrays of a tree, with derivatives refused."""

    @jax.custom_jvp
    def same(leaves):
        return leaves

    @same.defjvp
    def _(primals, tangents):
        raise ValueError(
            "simulate: a force of the scene has a kink or a jump (jd.forces.JointStops, jd.forces.EffortLimits, "
            "jd.forces.SlidingFriction, another "
            f"jd.forces.PiecewiseForce). Steps that go across it have wrong derivatives, and here they cannot end there: {reason}"
        )

    return same(tree)


def _is_direct(adjoint) -> bool:
    """True for derivatives in forward mode too."""
    return isinstance(adjoint, (diffrax.ForwardMode, diffrax.DirectAdjoint))


def _by_diffrax(term, solver, controller, event, dt0, inputs, steps, options: Options) -> Outcome:
    """Integrate in diffrax's loop."""
    ts = inputs[2]
    diffrax_options = {
        "term": term,
        "solver": solver,
        "controller": controller,
        "event": event,
        "adjoint": options.adjoint,
        "max_steps": options.max_steps,
        "progress": progress_meter(options.progress),
        "dt0": dt0,
    }
    if not is_step_length(steps[-1]):
        solved: Any = run_adaptively(inputs, diffrax_options, options.limit_is_given)
        rows, (result, *facts) = solved
        return Outcome(rows, from_diffrax(result), *facts)
    rows, (result, counts, reached, *last), solution = run(inputs, **diffrax_options)
    sums = solution.controller_state[2:] if isinstance(controller, ErrorMonitoredSteps) else None
    # diffrax is at the end of the step that could not be solved; what is known ends at its beginning.
    before = ts[0] + (counts["num_steps"].astype(ts.dtype) - 1) * steps[-1]
    result = from_diffrax(result)
    reached = jnp.where(result == RESULTS.nonlinear_divergence, before, reached)
    if sums is not None:
        result = RESULTS.where((result == RESULTS.successful) & too_coarse(sums), RESULTS.coarse_steps, result)
    return Outcome(rows, result, counts, reached, *last)


def _by_pieces(plan: Plan, eqs: Equations, inputs, controller, steps, options: Options) -> Outcome:
    """Integrate by steps that end at the kinks of forces."""
    # Imported here, because most scenes have no pieces and a first call should not wait for these modules.
    from jaxdyn.simulation.hybrid.motion import MIN_EVENTS, PiecewiseSystem, piecewise_motion

    system = PiecewiseSystem(plan, eqs.pieces, eqs.switching)
    rtol, atol, stepsize = steps
    (y0, args, ts), has_length = inputs, is_step_length(stepsize)
    room, most = options.max_steps, max(MIN_EVENTS, options.max_events)
    if not has_length:
        rtol, atol, stepsize = controller.rtol, controller.atol, None
        room = room if options.limit_is_given else min(room, ROOM)
    rows, end = piecewise_motion(
        system, y0, args, ts, rtol, atol, stepsize, options.max_steps, room, most, _is_direct(options.adjoint)
    )
    return Outcome(rows, end.result, end.counts, end.t)


def _by_steps(solver: ExplicitSteps, plan: Plan, controller, inputs, steps, options: Options) -> Outcome:
    """Integrate by explicit steps in the library's own loop."""
    # Attempts that locate the end do not count among the user's steps.
    most = options.max_steps + (0 if plan.guards is None else 2 * SEARCH_STEPS)
    if isinstance(controller, Adaptive):
        room, control = (
            most if options.limit_is_given else min(most, ROOM),
            step_control(solver, None, controller.norm),
        )
        run = ExplicitRun(plan, control, controller.rtol, controller.atol, None, most, room=room)
    else:
        run = ExplicitRun(plan, step_control(solver, steps[-1]), None, None, steps[-1], most, room=most)
    rows, (result, counts, reached) = (run.direct if _is_direct(options.adjoint) else run)(*inputs)
    if plan.guards is None:
        return Outcome(rows, result, counts, reached)
    rows, end = (jax.tree.map(lambda x, at=at: x[at], rows) for at in (slice(-1), -1))
    args, y = inputs[1], ravel_pytree(end)[0]
    late = delay(lambda args, t, y: jnp.min(plan.guards_of(args, t, y)[0]), plan.field_of, args, reached, y)
    return Outcome(rows, result, counts, reached + jnp.where(result == RESULTS.event_occurred, late, 0.0), end)
