"""Integration from a start to the save points: the solver, the loop (our own or diffrax's), and the code at the end."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation.equations import KEPT, Equations
from jaxdyn.simulation.hybrid.laws import laws_of_pieces
from jaxdyn.simulation.hybrid.pieces import EVENTS, motion_in_pieces
from jaxdyn.simulation.methods import Reduced, is_regular
from jaxdyn.simulation.solution import RESULTS, from_diffrax
from jaxdyn.simulation.solvers import ExplicitSteps, ProjectedSolver, driver
from jaxdyn.simulation.solvers.choice import is_fixed, label, progress_meter, stepping
from jaxdyn.simulation.solvers.differentiable import ROOM, run, run_adaptively
from jaxdyn.simulation.solvers.driver import Drive
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.simulation.solvers.first_step import Adaptive
from jaxdyn.simulation.solvers.fixed_steps import ErrorMonitoredSteps, too_coarse


def integrate(term, project, eqs: Equations, method, y0, ts, steps, options):
    """Rows of the state at ts[1:], how it ended, counts, the time it came to, and the state there if an event may end it."""
    quality, allowance, args = eqs.quality, eqs.least_allowance, eqs.args
    adjoint = options["adjoint"]
    solver: Any
    solver, controller, dt0 = stepping(options["solver"], term, ts, *steps)
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)  # which integrates another vector field
    # Of a method that wraps an explicit one, diffrax says that it is one.
    explicit = isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.AbstractWrappedSolver)
    step_constants = (*method.step_constants, *({controls.HELD, KEPT} & set(y0)))
    if explicit and not continuous:
        solver = ExplicitSteps(solver, project, step_constants, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, step_constants, method.projects)
    if continuous and isinstance(controller, ErrorMonitoredSteps):
        controller = diffrax.ConstantStepSize()  # backwards the state is another one
    event = None
    # Near a singular basis steps become short; a long one may pass it, which the sign shows.
    monitors_basis = isinstance(method, Reduced) and not continuous
    basis = (lambda t, y, args, **_: _signed(quality(t, y, args))) if monitors_basis else None
    if allowance and not continuous:
        event = unilateral.event(allowance, basis, basis and basis(ts[0], y0, args), ts.dtype)
    elif basis:
        event = diffrax.Event(basis)
    how = {
        "term": term,
        "solver": solver,
        "controller": controller,
        "event": event,
        "adjoint": adjoint,
        "max_steps": options["max_steps"],
        "progress": progress_meter(options["progress"]),
        "dt0": dt0,
    }
    sums = None
    reason = _whole_steps(eqs, explicit, controller, monitors_basis, adjoint, options)
    if eqs.pieces.names and reason is not None:
        y0, args, ts = undifferentiable((y0, args, ts), reason)
    if eqs.pieces.names and reason is None:
        stepper: Any = solver
        is_direct = isinstance(adjoint, (diffrax.ForwardMode, diffrax.DirectAdjoint))
        laws = laws_of_pieces(stepper.plan(y0), eqs.pieces, eqs.switching, solver.order(None), solver.error_order(None))
        tolerances, stepsize = (steps[0], steps[1]), steps[2] if is_fixed(steps[2]) else None
        if stepsize is None:
            tolerances = controller.rtol, controller.atol  # pyright: ignore[reportAttributeAccessIssue]
        most = options["max_steps"]
        room = most if stepsize is not None or options["limit_is_given"] else min(most, ROOM)
        events = max(EVENTS, options["max_events"])
        rows, facts, sums = motion_in_pieces(laws, y0, args, ts, tolerances, stepsize, most, room, events, is_direct)
    elif explicit and not continuous and not allowance and _is_driven(controller, adjoint, options):
        stepper: Any = solver
        plan = stepper.plan(y0)
        if monitors_basis:
            plan = plan._replace(quality=lambda t, y, args: _signed(quality(t, y, args)))
        rows, facts, sums = _drive(plan, stepper, controller, steps, options)(y0, args, ts)
    elif is_fixed(steps[-1]):
        rows, facts, solved = run((y0, args, ts), **how)
        sums = solved.controller_state[2:] if isinstance(controller, ErrorMonitoredSteps) else None
    else:
        rows, facts = run_adaptively((y0, args, ts), how, options["limit_is_given"])
    result, stats, reached, *last = facts
    result = from_diffrax(result)
    if eqs.pieces.names and reason is None:
        # Forces that drive the motion onto their jump from both sides; fixed steps end short of what is not finite.
        result = RESULTS.where(result == RESULTS.event_occurred, RESULTS.too_many_events, result)
        if is_fixed(steps[-1]):
            result = RESULTS.where(result == RESULTS.dt_min_reached, RESULTS.nonfinite_state, result)
    if is_fixed(steps[-1]):
        if sums is not None:
            coarse = (result == RESULTS.successful) & too_coarse(sums)
            result = RESULTS.where(coarse, RESULTS.coarse_steps, result)
        # diffrax is at the end of the step that could not be solved; what is known ends where it began.
        began = ts[0] + (stats["num_steps"].astype(ts.dtype) - 1) * steps[-1]
        reached = jnp.where(result == RESULTS.nonlinear_divergence, began, reached)
    return rows, result, stats, reached, last[0] if last else None


def _whole_steps(eqs: Equations, explicit: bool, controller, monitors_basis: bool, adjoint, options) -> str | None:
    """Why steps do not end where forces change their piece, or None."""
    if not explicit:
        return f"solver is {label(options['solver'])}; take an explicit one, such as diffrax.Dopri8()"
    if type(controller) not in (Adaptive, ErrorMonitoredSteps):
        return "stepsize is a controller, or control a jd.Sampled; leave them out"
    if eqs.least_allowance is not None:
        return "contacts, limits or the control may end the run; pass contacts='report' and limits=None"
    if monitors_basis:
        return "method is 'reduced'; take 'projected'"
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        return "adjoint is 'backsolve'; take 'reverse'"
    return "progress is shown; leave it out" if options["progress"] else None


def undifferentiable(tree, reason: str):
    """The arrays of a tree, of which derivatives are refused."""

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


def _is_driven(controller, adjoint, options) -> bool:
    """Whether steps are made by a loop of our own: explicit ones, with a known control and without a progress meter."""
    known = type(controller) in (Adaptive, ErrorMonitoredSteps)
    return known and isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) and not options["progress"]


def _drive(plan: Plan, solver: ExplicitSteps, controller, steps, options) -> Drive:
    """How the run is made by a loop of our own."""
    order, most = solver.error_order(None), options["max_steps"]
    if isinstance(controller, Adaptive):
        room = most if options["limit_is_given"] else min(most, ROOM)
        how = driver.Adaptive(order, controller.norm)
        return Drive(plan, how, controller.rtol, controller.atol, None, most, room)
    return Drive(plan, driver.Fixed(solver.order(None), order), None, None, steps[-1], most, most)


def _signed(quality):
    """The quality of a basis, whose change of sign ends the run: zero where the basis is singular."""
    return jnp.where(is_regular(quality), quality, jnp.zeros_like(quality))
