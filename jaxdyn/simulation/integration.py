"""Integration from a start to the save points: the solver, the loop (our own or diffrax's), and the code at the end."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from jaxdyn.simulation import controls, terminal_events
from jaxdyn.simulation.equations import KEPT, Equations
from jaxdyn.simulation.hybrid.piecewise import MIN_EVENTS, PiecewiseSystem, piecewise_motion
from jaxdyn.simulation.methods import Reduced, is_regular
from jaxdyn.simulation.solution import RESULTS, from_diffrax
from jaxdyn.simulation.solvers import ExplicitSteps, ProjectedSolver, driver
from jaxdyn.simulation.solvers.choice import is_step_length, label, progress_meter, solver_and_control
from jaxdyn.simulation.solvers.differentiable import ROOM, run, run_adaptively
from jaxdyn.simulation.solvers.driver import ExplicitRun
from jaxdyn.simulation.solvers.step_control import Adaptive, ErrorMonitoredSteps, too_coarse


def integrate(term, project, eqs: Equations, args, method, y0, ts, steps, options):
    """Rows of the state at ts[1:], a code, counts, the time reached, and the state there if an event may end the run."""
    adjoint = options["adjoint"]
    solver: Any
    solver, controller, dt0 = solver_and_control(options["solver"], term, ts, *steps)
    # The continuous adjoint integrates another vector field backwards: projections and events of y do not apply to it.
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)
    # diffrax reports a method that wraps an explicit one as explicit.
    is_erk = isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.AbstractWrappedSolver)
    step_constants = (*method.step_constants, *({controls.HELD, KEPT} & set(y0)))
    if is_erk and not continuous:
        solver = ExplicitSteps(solver, project, step_constants, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, step_constants, method.projects)
    if continuous and isinstance(controller, ErrorMonitoredSteps):
        controller = diffrax.ConstantStepSize()
    quality = eqs.quality if isinstance(method, Reduced) and not continuous else None
    event = None if continuous else _event(eqs, args, quality, y0, ts)
    diffrax_options = {
        "term": term,
        "solver": solver,
        "controller": controller,
        "event": event,
        "adjoint": adjoint,
        "max_steps": options["max_steps"],
        "progress": progress_meter(options["progress"]),
        "dt0": dt0,
    }
    explicit: Any = solver  # where `is_erk`
    inputs, sums, is_fixed_length = (y0, args, ts), None, is_step_length(steps[-1])
    reason = _reason_for_crossing(eqs, is_erk, controller, quality is not None, adjoint, options)
    ends_at_kinks = bool(eqs.pieces.names) and reason is None
    if eqs.pieces.names and reason is not None:
        inputs = undifferentiable(inputs, reason)
    if ends_at_kinks:
        system = PiecewiseSystem(explicit.plan(y0), eqs.pieces, eqs.switching)
        rows, facts, sums = _by_pieces(system, inputs, controller, steps, options)
    elif is_erk and not any(eqs.conditions) and _has_own_loop(controller, adjoint, options):
        rows, facts, sums = _integrator(explicit, y0, quality, controller, steps, options)(*inputs)
    elif is_fixed_length:
        rows, facts, solution = run(inputs, **diffrax_options)
        sums = solution.controller_state[2:] if isinstance(controller, ErrorMonitoredSteps) else None
    else:
        rows, facts = run_adaptively(inputs, diffrax_options, options["limit_is_given"])
    result, stats, reached, *last = facts
    result = from_diffrax(result)
    if ends_at_kinks:
        # Forces that drive the motion onto their jump from both sides; fixed steps end short of what is not finite.
        result = RESULTS.where(result == RESULTS.event_occurred, RESULTS.too_many_events, result)
        if is_fixed_length:
            result = RESULTS.where(result == RESULTS.dt_min_reached, RESULTS.nonfinite_state, result)
    if is_fixed_length:
        if sums is not None:
            coarse = (result == RESULTS.successful) & too_coarse(sums)
            result = RESULTS.where(coarse, RESULTS.coarse_steps, result)
        # diffrax is at the end of the step that could not be solved; what is known ends at its beginning.
        before = ts[0] + (stats["num_steps"].astype(ts.dtype) - 1) * steps[-1]
        reached = jnp.where(result == RESULTS.nonlinear_divergence, before, reached)
    return rows, result, stats, reached, last[0] if last else None


def _event(eqs: Equations, args, quality, y0, ts) -> diffrax.Event | None:
    """Event of a run in diffrax's loop; `quality` of a basis that may become singular, or None."""
    # Near a singular basis steps become short; a long one may pass it, which the sign shows.
    basis = None if quality is None else lambda t, y, args, **_: _quality_or_zero(quality(t, y, args))
    if any(eqs.conditions):
        start = None if basis is None else basis(ts[0], y0, args)
        return terminal_events.event(eqs.least_allowance, basis, start, ts.dtype)
    return None if basis is None else diffrax.Event(basis)


def _quality_or_zero(quality):
    """Quality of a basis, whose change of sign ends the run: zero where the basis is singular."""
    return jnp.where(is_regular(quality), quality, jnp.zeros_like(quality))


def _reason_for_crossing(
    eqs: Equations, is_erk: bool, controller, monitors_basis: bool, adjoint, options
) -> str | None:
    """Reason why steps go across the kinks of forces instead of ending there, or None."""
    if not is_erk:
        return f"solver is {label(options['solver'])}; take an explicit one, such as diffrax.Dopri8()"
    # Subclasses and wrappers, such as a clip to samples, have rules that our loops do not know.
    if type(controller) not in (Adaptive, ErrorMonitoredSteps):
        return "stepsize is a controller, or control a jd.Sampled; leave them out"
    if any(eqs.conditions):
        return "contacts, limits or the control may end the run; pass contacts='report' and limits=None"
    if monitors_basis:
        return "method is 'reduced'; take 'projected'"
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        return "adjoint is 'backsolve'; take 'reverse'"
    return "progress is shown; leave it out" if options["progress"] else None


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


def _by_pieces(system, inputs, controller, steps, options):
    """Integrate by steps that end at the kinks of forces; rows, facts, and sums of fixed steps."""
    rtol, atol, stepsize = steps
    room, most = options["max_steps"], max(MIN_EVENTS, options["max_events"])
    if not is_step_length(stepsize):
        rtol, atol, stepsize = controller.rtol, controller.atol, None
        room = room if options["limit_is_given"] else min(room, ROOM)
    is_direct = isinstance(options["adjoint"], (diffrax.ForwardMode, diffrax.DirectAdjoint))
    y0, args, ts = inputs
    return piecewise_motion(system, y0, args, ts, rtol, atol, stepsize, options["max_steps"], room, most, is_direct)


def _has_own_loop(controller, adjoint, options) -> bool:
    """True if the library's own loop makes explicit steps: with a known control, reverse mode and no progress meter."""
    known = type(controller) in (Adaptive, ErrorMonitoredSteps)
    return known and isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) and not options["progress"]


def _integrator(solver: ExplicitSteps, y0, quality, controller, steps, options) -> ExplicitRun:
    """Integrator of the library's own loop."""
    order, most, plan = solver.error_order(None), options["max_steps"], solver.plan(y0)
    if quality is not None:
        plan = plan._replace(quality=lambda t, y, args: _quality_or_zero(quality(t, y, args)))
    if isinstance(controller, Adaptive):
        room = most if options["limit_is_given"] else min(most, ROOM)
        control = driver.AdaptiveSteps(order, controller.norm)
        return ExplicitRun(plan, control, controller.rtol, controller.atol, None, most, room=room)
    return ExplicitRun(plan, driver.FixedSteps(solver.order(None), order), None, None, steps[-1], most, room=most)
