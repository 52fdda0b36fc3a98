"""Integration from a start to the save points: the solver, the loop (our own or diffrax's), and the code at the end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxdyn.simulation import controls, terminal_events
from jaxdyn.simulation.equations import KEPT, Equations
from jaxdyn.simulation.hybrid.piecewise import MIN_EVENTS, PiecewiseSystem, piecewise_motion
from jaxdyn.simulation.methods import Reduced, is_regular
from jaxdyn.simulation.solution import RESULTS, from_diffrax
from jaxdyn.simulation.solvers import ExplicitSteps, ProjectedSolver, driver
from jaxdyn.simulation.solvers.choice import is_explicit, is_step_length, label, progress_meter, solver_and_control
from jaxdyn.simulation.solvers.differentiable import ROOM, run, run_adaptively
from jaxdyn.simulation.solvers.driver import ExplicitRun
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS, delay
from jaxdyn.simulation.solvers.step_control import Adaptive, ErrorMonitoredSteps, too_coarse


class Outcome(NamedTuple):
    """Rows of the state at ts[1:], a code, counts, the time reached, and the state there if an event may end the run."""

    rows: Any
    result: Any
    counts: dict[str, Any]
    time_reached: Any
    last: Any = None


def integrate(term, project, eqs: Equations, args, method, y0, ts, steps, options) -> Outcome:
    """Integrate from the start to the save points."""
    adjoint, has_length = options["adjoint"], is_step_length(steps[-1])
    solver: Any
    solver, controller, dt0 = solver_and_control(options["solver"], term, ts, *steps)
    # The continuous adjoint integrates another vector field backwards: projections and events of y do not apply to it.
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)
    step_constants = (*method.step_constants, *({controls.HELD, KEPT} & set(y0)))
    reason = _reason_for_diffrax(solver, controller, adjoint, options)
    if is_explicit(solver) and not continuous:
        solver = ExplicitSteps(solver, project, step_constants, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, step_constants, method.projects)
    monitors = Monitors() if continuous else _monitors(eqs, method)
    of_kinks = reason or _reason_for_crossing(monitors)
    inputs = y0, args, ts
    if eqs.pieces.names and of_kinks:
        inputs = undifferentiable(inputs, of_kinks)
    if reason:
        controller = diffrax.ConstantStepSize() if continuous and has_length else controller
        return _by_diffrax(term, solver, controller, monitors, dt0, inputs, steps, options)
    explicit: Any = solver
    if eqs.pieces.names and not of_kinks:
        system = PiecewiseSystem(explicit.plan(y0), eqs.pieces, eqs.switching)
        return _by_pieces(system, inputs, controller, steps, options)
    plan = explicit.plan(y0)._replace(quality=monitors.quality, guards=monitors.guards)
    run = _explicit_run(plan, explicit, controller, steps, options)
    return _by_steps(run, inputs, _is_direct(adjoint))


class Monitors(NamedTuple):
    """Functions (t, y, args) that end a run: the quality of a basis where it changes its sign, guards where one is negative."""

    quality: Callable | None = None
    guards: Callable | None = None


def _monitors(eqs: Equations, method) -> Monitors:
    def quality(t, y, args, **_):  # diffrax passes more to the condition of an event
        # Near a singular basis steps become short; a long one may pass it, which the sign shows.
        value = eqs.quality(t, y, args)
        return jnp.where(is_regular(value), value, jnp.zeros_like(value))

    return Monitors(quality if isinstance(method, Reduced) else None, eqs.guards if any(eqs.conditions) else None)


def _reason_for_diffrax(solver, controller, adjoint, options) -> str | None:
    """Reason why diffrax makes the steps, or None: the library's own loop makes them."""
    if not is_explicit(solver):
        return f"solver is {label(options['solver'])}; take an explicit one, such as diffrax.Dopri8()"
    # Subclasses and wrappers, such as a clip to samples, have rules that our loops do not know.
    if type(controller) not in (Adaptive, ErrorMonitoredSteps):
        return "stepsize is a controller; leave it out"
    if not isinstance(adjoint, (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode, diffrax.DirectAdjoint)):
        return f"adjoint is {options['adjoint']!r}; take 'reverse'"
    return "progress is shown; leave it out" if options["progress"] else None


def _reason_for_crossing(monitors: Monitors) -> str | None:
    """Reason why explicit steps go across the kinks of forces instead of ending there, or None."""
    if monitors.guards is not None:
        return "contacts, limits or the control may end the run; pass contacts='report' and limits=None"
    return None if monitors.quality is None else "method is 'reduced'; take 'projected'"


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


def _by_diffrax(term, solver, controller, monitors: Monitors, dt0, inputs, steps, options) -> Outcome:
    """Integrate in diffrax's loop."""
    y0, args, ts = inputs
    diffrax_options = {
        "term": term,
        "solver": solver,
        "controller": controller,
        "event": terminal_events.event(monitors, ts[0], y0, args),
        "adjoint": options["adjoint"],
        "max_steps": options["max_steps"],
        "progress": progress_meter(options["progress"]),
        "dt0": dt0,
    }
    if not is_step_length(steps[-1]):
        rows, (result, *facts) = run_adaptively(inputs, diffrax_options, options["limit_is_given"])
        return Outcome(rows, from_diffrax(result), *facts)
    rows, (result, counts, reached, *last), solution = run(inputs, **diffrax_options)
    sums = solution.controller_state[2:] if isinstance(controller, ErrorMonitoredSteps) else None
    # diffrax is at the end of the step that could not be solved; what is known ends at its beginning.
    before = ts[0] + (counts["num_steps"].astype(ts.dtype) - 1) * steps[-1]
    result = from_diffrax(result)
    reached = jnp.where(result == RESULTS.nonlinear_divergence, before, reached)
    return Outcome(rows, _of_fixed_steps(result, sums), counts, reached, *last)


def _of_fixed_steps(result, sums):
    """Code of a run, with those of fixed steps if there are their `sums`: too long, or short of what is not finite."""
    if sums is None:
        return result
    result = RESULTS.where(result == RESULTS.dt_min_reached, RESULTS.nonfinite_state, result)
    return RESULTS.where((result == RESULTS.successful) & too_coarse(sums), RESULTS.coarse_steps, result)


def _by_pieces(system, inputs, controller, steps, options) -> Outcome:
    """Integrate by steps that end at the kinks of forces."""
    rtol, atol, stepsize = steps
    room, most, has_length = options["max_steps"], max(MIN_EVENTS, options["max_events"]), is_step_length(stepsize)
    if not has_length:
        rtol, atol, stepsize = controller.rtol, controller.atol, None
        room = room if options["limit_is_given"] else min(room, ROOM)
    rows, (result, counts, reached), sums = piecewise_motion(
        system, *inputs, rtol, atol, stepsize, options["max_steps"], room, most, _is_direct(options["adjoint"])
    )
    # Forces that drive the motion onto their jump from both sides.
    result = from_diffrax(result)
    result = RESULTS.where(result == RESULTS.event_occurred, RESULTS.too_many_events, result)
    return Outcome(rows, _of_fixed_steps(result, sums), counts, reached)


def _by_steps(run: ExplicitRun, inputs, is_direct: bool) -> Outcome:
    """Integrate by explicit steps in the library's own loop."""
    rows, end, (result, counts, reached), sums = (run.direct if is_direct else run)(*inputs)
    plan, result = run.plan, _of_fixed_steps(from_diffrax(result), sums)
    if plan.guards is None:
        return Outcome(rows, result, counts, reached)
    args, y = inputs[1], ravel_pytree(end)[0]
    late = delay(lambda t, y: jnp.min(plan.guards_of(args, t, y)[0]), plan.field_of(args, reached, y), reached, y)
    return Outcome(rows, result, counts, reached + jnp.where(result == RESULTS.event_occurred, late, 0.0), end)


def _explicit_run(plan, solver: ExplicitSteps, controller, steps, options) -> ExplicitRun:
    """Integrator of the library's own loop."""
    # Attempts that locate the end do not count among the user's steps.
    order, most = solver.error_order(None), options["max_steps"] + (0 if plan.guards is None else 2 * SEARCH_STEPS)
    if isinstance(controller, Adaptive):
        room = most if options["limit_is_given"] else min(most, ROOM)
        control = driver.AdaptiveSteps(order, controller.norm)
        return ExplicitRun(plan, control, controller.rtol, controller.atol, None, most, room=room)
    return ExplicitRun(plan, driver.FixedSteps(solver.order(None), order), None, None, steps[-1], most, room=most)
