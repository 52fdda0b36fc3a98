"""Integration from a start to the save points: the solver, the loop (our own or diffrax's), and the code at the end."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from jaxdyn.model.arguments import Number
from jaxdyn.simulation import controls
from jaxdyn.simulation.equations import KEPT, WITHIN, Equations
from jaxdyn.simulation.methods import Reduced, is_regular
from jaxdyn.simulation.options import Options, is_step_length
from jaxdyn.simulation.solution import RESULTS, from_diffrax
from jaxdyn.simulation.solvers import LibrarySteps, ProjectedSolver
from jaxdyn.simulation.solvers.base import Adaptive, ErrorMonitoredSteps, Flag, StepOutput, Wrapped, too_coarse
from jaxdyn.simulation.solvers.choice import (
    choose_loop,
    has_own_loop,
    progress_meter,
    solver_and_control,
)
from jaxdyn.simulation.solvers.driver import step_control
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS, delay
from jaxdyn.simulation.solvers.integrator import ROOM, DiffraxRun, LibraryRun, run, run_adaptively
from jaxdyn.simulation.solvers.steps import Plan


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
    quality, guards = (None, None) if continuous else _monitors(eqs, method)
    loop, reason = choose_loop(solver, controller, options, guards, quality, eqs.pieces.names)
    if has_own_loop(solver) and not continuous:
        solver = LibrarySteps(solver, project, step_constants, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, step_constants, method.projects)
    inputs = y0, args, ts
    if eqs.pieces.names and loop != "pieces":
        inputs = undifferentiable(inputs, reason)
    if loop == "diffrax":
        controller = diffrax.ConstantStepSize() if continuous and has_length else controller
        if guards is not None:
            solver = GuardedSolver(solver, guards)
            y0 = y0 | {WITHIN: jnp.ones_like(ts[0])}
            inputs = y0, *inputs[1:]
        event = event_of(quality, guards, ts[0], y0, args)
        meter = progress_meter(options.progress)
        given = DiffraxRun(term, solver, controller, event, adjoint, options.max_steps, meter, dt0)
        outcome = _by_diffrax(given, inputs, steps, options)
        return outcome._replace(rows=_without_mark(outcome.rows), last=_without_mark(outcome.last))
    if loop == "pieces":
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


def _without_mark(y):
    """State without the mark of `GuardedSolver`."""
    return y and {name: y[name] for name in y if name != WITHIN}


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


def _by_diffrax(given: DiffraxRun, inputs, steps, options: Options) -> Outcome:
    """Integrate in diffrax's loop."""
    ts = inputs[2]
    if not is_step_length(steps[-1]):
        rows, (result, *facts) = run_adaptively(inputs, given, options.limit_is_given)
        return Outcome(rows, from_diffrax(result), *facts)
    rows, (result, counts, reached, *last), solution = run(inputs, given)
    sums = solution.controller_state[2:] if isinstance(given.controller, ErrorMonitoredSteps) else None
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


def _by_steps(solver: LibrarySteps, plan: Plan, controller, inputs, steps, options: Options) -> Outcome:
    """Integrate by explicit steps in the library's own loop."""
    # Attempts that locate the end do not count among the user's steps.
    most = options.max_steps + (0 if plan.guards is None else 2 * SEARCH_STEPS)
    if isinstance(controller, Adaptive):
        room, control = (
            most if options.limit_is_given else min(most, ROOM),
            step_control(solver, None, controller.norm),
        )
        run = LibraryRun(plan, control, controller.rtol, controller.atol, None, most, room=room)
    else:
        run = LibraryRun(plan, step_control(solver, steps[-1]), None, None, steps[-1], most, room=most)
    rows, (result, counts, reached) = (run.direct if _is_direct(options.adjoint) else run)(*inputs)
    if plan.guards is None:
        return Outcome(rows, result, counts, reached)
    rows, end = (jax.tree.map(lambda x, at=at: x[at], rows) for at in (slice(-1), -1))
    args, y = inputs[1], ravel_pytree(end)[0]
    late = delay(lambda args, t, y: jnp.min(plan.guards_of(args, t, y)[0]), plan.field_of, args, reached, y)
    return Outcome(rows, result, counts, reached + jnp.where(result == RESULTS.event_occurred, late, 0.0), end)


# --- events of a run in diffrax's loop ---


# Fractions of a step at which diffrax's loop evaluates the allowances.
_FRACTIONS = tuple(i / 8 for i in range(1, 8))


class GuardedSolver(Wrapped):
    """A method whose steps mark in the state if an allowance has been negative within them.

    The condition of an event of diffrax knows the state at the end of a step alone.
    """

    guards: Callable

    @property
    def term_compatible_contr_kwargs(self) -> PyTree:
        """Arguments of the terms of the wrapped method."""
        return self.solver.term_compatible_contr_kwargs

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """Dense output of the wrapped method."""
        return self.solver.interpolation_cls

    def step(
        self, terms: PyTree, t0: Number, t1: Number, y0: PyTree, args: PyTree, solver_state: PyTree, made_jump: Flag
    ) -> StepOutput:
        """Make one step of the wrapped method and look within it."""
        y1, error, dense_info, state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        # The mark has no derivative, and neither have the guards that make it.
        arrays, rest_of_args = eqx.partition(args, eqx.is_array)
        start, end, info, arrays = jax.lax.stop_gradient((t0, t1, dense_info, arrays))
        dense, args = self.interpolation_cls(t0=start, t1=end, **info), eqx.combine(arrays, rest_of_args)

        def least(fraction):
            t = start + fraction * (end - start)
            return jnp.min(self.guards(t, dense.evaluate(t), args)[0])

        passed = (jax.vmap(least)(jnp.asarray(_FRACTIONS, jnp.result_type(t0))) < 0).any()
        mark = jnp.where(passed, -1.0, 1.0).astype(y1[WITHIN].dtype)
        return y1 | {WITHIN: mark}, error, dense_info, state, result


def event_of(quality, guards, t0, y0, args) -> diffrax.Event | None:
    """Event of a run in diffrax's loop, from the quality (t, y, args) of a basis and the guards, each a function or None."""
    if guards is None:
        return None if quality is None else diffrax.Event(quality)
    start = None if quality is None else jax.lax.stop_gradient(quality(t0, y0, args))

    def condition(start, t, y, args, **_):
        # One event for all conditions: the first one that is violated ends the run.
        least = jnp.minimum(jnp.min(guards(t, y, args)[0]), y[WITHIN])
        if quality is not None:
            # A run has one event: a basis that has become singular counts as a violation, whatever the allowances.
            least = jnp.where(quality(t, y, args) * start > 0, least, -jnp.ones_like(least))
        return least.astype(float)  # the dtype of diffrax's own branches

    eps = float(jnp.finfo(t0.dtype).eps)
    # A traced value must be a leaf of the event: reverse mode refuses one that a function captures.
    return diffrax.Event(
        jax.tree_util.Partial(condition, start), Bisection(rtol=8 * eps, atol=8 * eps, flip=True), direction=False
    )


class Bisection(optimistix.Bisection):
    """Bisection of a function that falls through zero, until the interval is at rounding, however steep the function is."""

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Begin with the interval up to the first point at which the function is negative."""
        lower, upper = options["lower"], options["upper"]
        # The function may be positive again at the end. From the last point to the first, so that the first one stays.
        points = [lower + fraction * (upper - lower) for fraction in _FRACTIONS]
        values = jax.vmap(lambda t: fn(t, args)[0])(jnp.stack(points))
        for point, value in zip(reversed(points), reversed(list(values)), strict=True):
            upper = jnp.where(value < 0, point, upper)
        return super().init(fn, y, args, options | {"upper": upper}, f_struct, aux_struct, tags)

    def step(self, fn, y, args, options, state, tags):
        """Halve the interval; the first point, the end of the step, may be behind it."""
        return super().step(fn, jnp.minimum(y, state.upper), args, options, state, tags)

    # optimistix also asks for a small value of the function, which a steep one does not reach.
    def terminate(self, fn, y, args, options, state, tags):
        """Stop when the interval is small."""
        width = jnp.abs(state.upper - state.lower)
        return width <= self.atol + self.rtol * jnp.abs(y), optimistix.RESULTS.successful
