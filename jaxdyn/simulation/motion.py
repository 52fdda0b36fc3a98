"""Motion without modes: projection of the start, integration, terminal events, the result code, and the outputs."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import map_rows
from jaxdyn.compile.known import Known
from jaxdyn.constraints.codes import first_of
from jaxdyn.constraints.rank import MIN_GAP
from jaxdyn.constraints.redundancy import exchange_rows, gap_of_redundant, has_selection, keep_rows, rows_of
from jaxdyn.constraints.selection import max_rounding, select_rows
from jaxdyn.simulation import controls
from jaxdyn.simulation.checks import Inputs, angle_coordinates, has_definite_mass, largest_angle, safe_inputs
from jaxdyn.simulation.equations import DRIVES, KEPT, WITHIN, Equations, at_save_point, equations
from jaxdyn.simulation.events import Conditions, Violation, first_violation
from jaxdyn.simulation.methods import Method, Reduced, consistent, is_regular, satisfies_redundant_rows, start_limit
from jaxdyn.simulation.options import Options, is_backsolve, is_step_length
from jaxdyn.simulation.solution import RESULTS, Solution, from_diffrax, invalidate_failures, rows_where
from jaxdyn.simulation.solvers import LibrarySteps, LieGroup, ProjectedSolver, Stepper
from jaxdyn.simulation.solvers.base import Adaptive, ErrorMonitoredSteps, too_coarse
from jaxdyn.simulation.solvers.choice import (
    choose_adjoint,
    choose_loop,
    choose_solver,
    has_own_loop,
    is_split,
    label,
    progress_meter,
    solver_and_control,
)
from jaxdyn.simulation.solvers.diffrax_loop import DiffraxRun, GuardedSolver, event_of, run, run_adaptively, sizes_of
from jaxdyn.simulation.solvers.driver import COUNTS, ROOM, LibraryRun, step_control
from jaxdyn.simulation.solvers.guards import SEARCH_STEPS, delay
from jaxdyn.simulation.solvers.steps import Plan
from jaxdyn.systems.scene import Scene, check_callback
from jaxdyn.systems.system import displace, has_dependent_coordinates


class _Run(NamedTuple):
    """Scene, control and method of a run, with its equations and their arguments."""

    scene: Scene
    control: Any
    method: Method
    eqs: Equations
    args: Any

    def scene_at(self, y) -> Scene:
        """Scene with the rows that are kept at a save point."""
        return exchange_rows(self.scene, y[KEPT]) if KEPT in y else self.scene

    def to_qv(self, y, t):
        """Configuration and velocity of a state, corrected as at the end of a step."""
        scene = self.scene_at(y)
        return self.method.to_qv(scene, self.method.correct(scene, y, t), t)


def _as_arrays(known: Known) -> Any:
    """A known tree whose leaves are arrays of JAX, also within a trace."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(jnp.asarray, known(()))


def smooth_motion(given_scene: Scene | Known, control, method: Method, numbers, options: Options) -> Solution:
    """Run of `simulate`; `numbers`: q0, v0, ts, rtol, atol and the length of steps or a controller of them."""
    scene: Scene = _as_arrays(given_scene) if isinstance(given_scene, Known) else given_scene
    solver = choose_solver(options.solver, numbers[-1])
    options = options._replace(solver=solver, adjoint=choose_adjoint(options.adjoint, solver))
    given, inputs = (scene, control, numbers, options.terminals), safe_inputs(scene.system, numbers)
    scene, inputs, faults = _project_start(scene, method, inputs, options.selects_rows)
    run, y0 = _set_up(scene, control, method, inputs, options)
    ts, good = inputs.ts, inputs.good
    solver, term, corrector = _solver(run, y0, options.solver)
    rows, result, counts, time_reached, guard = integrate(
        term, corrector, run.eqs, run.args, method, y0, ts, inputs.steps, options._replace(solver=solver)
    )
    y = jax.tree.map(lambda start, later: jnp.concatenate([start[None], later]), y0, rows)
    # Loops fill rows that they did not reach with infinity.
    finite = [jnp.isfinite(rows).reshape(ts.shape[0], -1).all(1) for rows in y.values()]
    reached = good & jnp.stack(finite).all(0)
    # The start stands in the rows that were not reached: outputs and their derivatives are finite there.
    y = jax.tree.map(functools.partial(rows_where, reached), y, y0)
    work = y.pop("work", None)
    # By the kernels that have put the start on the constraints.
    q, v = map_rows(lambda row: run.to_qv(*row), (y, ts))
    violation, ends = _violation(run, (y, q, v, ts), reached, time_reached, guard), []
    if violation is not None:
        # A save point at the time of the violation still belongs to the motion.
        reached = reached & ~(violation.happened & (ts > violation.time))
        time_reached = jnp.where(violation.happened, violation.time, time_reached)
        ends += violation.codes(run.eqs.conditions.counts(scene))
    # Behind a state whose contact is not unique the rows are those of another motion.
    if has_dependent_coordinates(scene.system):
        # A running sum: rows behind the first inconsistent one are lost, even where they are consistent again.
        follows = jnp.cumsum(~map_rows(scene.system.is_consistent, q)) == 0
        ends.insert(0, (~follows.all(), RESULTS.no_single_contact))
        reached = reached & follows
        time_reached = jnp.where(follows.all(), time_reached, jnp.max(jnp.where(reached, ts, ts[0])))
    # The end of a run is an input, which has derivatives; the time in the loop has none.
    time_reached = jnp.where(reached.all() & (time_reached >= ts[-1]), ts[-1], time_reached)
    result = first_of([*ends, (result == RESULTS.event_occurred, RESULTS.singular_basis)], result)
    has_ended = (result == RESULTS.successful) | (result == RESULTS.coarse_steps)
    nonfinite = has_ended & ~reached.all()
    # Fixed steps continue from what is not finite: all that is known is the last state before it that was kept.
    kept = jnp.max(jnp.where(reached, ts, ts[0]))
    time_reached = jnp.where(nonfinite | (result == RESULTS.nonfinite_state), kept, time_reached)
    faults = [
        *faults,
        *_faults_of_start(run, y0, inputs, options),
        (nonfinite, RESULTS.nonfinite_state),
        *_faults_of_constraints(run, (y, q, v, ts), result),
    ]
    of_control = {name: y[name] for name in (controls.STATE, controls.HELD, DRIVES) if name in y}

    def outputs_of(row):
        y, *state = row
        return at_save_point(run.scene_at(y), control, method, run.eqs, run.args, options.outputs, *state)

    values = map_rows(outputs_of, (y, q, v, ts, of_control))
    rows = {"q": q, "v": v} | values | ({} if work is None else {"work": work})
    all_finite = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(rows)]).all()
    result = first_of([*faults, ((result == RESULTS.successful) & ~all_finite, RESULTS.nonfinite_state)], result)
    # NaN only now, behind all checks and outputs, to which it would spread.
    rows, time_reached = invalidate_failures(rows, time_reached, result, reached, given)
    stats = {name: jnp.asarray(counts[name], jnp.int32) for name in COUNTS}
    stats["time_reached"] = jnp.where(good, time_reached, ts[0])
    stats |= _redundancy(run, y, q, ts, reached)
    if violation is not None:
        stats |= violation.stats(run.eqs.conditions, run.eqs.conditions.counts(scene))
    return Solution(ts=inputs.given, result=result, stats=stats, solver=label(solver), **rows)


def _project_start(scene: Scene, method: Method, inputs: Inputs, selects_rows: bool):
    """Scene with its independent rows, inputs with the start on the constraints, and cases of the result."""
    q0, v0, t0 = inputs.q0, inputs.v0, inputs.ts[0]
    start_ok, faults = jnp.asarray(True), []
    if selects_rows:
        selection = select_rows(scene, q0, t0, method.rank_tol)
        scene = keep_rows(scene, selection)
        start_ok = selection.rounding <= max_rounding(q0.dtype)
        faults.append((selection.gap < MIN_GAP, RESULTS.unclear_rank))
        faults.append((~(jnp.sum(selection.kept) < scene.nv), RESULTS.no_freedom))
    if scene.constraints:
        start_ok = start_ok & consistent(scene, q0, v0, t0)
        if method.projects:
            given_start = q0, v0
            q0, v0 = method.project(scene, q0, v0, t0)
            # Residuals of a small mechanism are small numbers of metres: how far it moves onto the constraints tells more.
            corrections = [
                jnp.max(jnp.abs(x - y)) / (1 + jnp.max(jnp.abs(x))) for x, y in zip(given_start, (q0, v0), strict=True)
            ]
            start_ok = start_ok & (jnp.maximum(*corrections) <= 10 * start_limit(q0.dtype))
    # In front, because the first case is reported: the others may follow from a bad start.
    faults.insert(0, (~start_ok, RESULTS.inconsistent_start))
    angles = angle_coordinates(scene.system)
    if angles.size and not is_step_length(inputs.steps[-1]):
        faults.insert(0, (jnp.max(jnp.abs(q0[angles])) > largest_angle(q0.dtype), RESULTS.coarse_start))
    return scene, inputs._replace(q0=q0, v0=v0), [*inputs.faults, *faults]


def _set_up(scene: Scene, control, method: Method, inputs: Inputs, options) -> tuple[_Run, dict]:
    """Run with its equations, and their initial state."""
    start = inputs.q0, inputs.v0, inputs.ts[0]
    # Refuses callbacks that do not fit before diffrax meets them.
    for i, force in enumerate(scene.forces):
        check_callback(force, f"forces[{i}]", "force(system, q, v, t)", *start, first=(scene.system,))
    controls.check_control(scene, control, *start)
    entries = controls.initial_entries(control, *start)
    if (of_drives := scene.drive_state(*start)) is not None:
        entries = entries | {DRIVES: of_drives}
    at_contacts, at_limits = options.stops
    conditions = Conditions(at_contacts, at_limits, controls.can_end(control, *start), len(options.terminals))
    for one in options.terminals:
        check_callback(one.function, "Terminal: function", "function(q, v, t)", *start)
    if any(conditions) and is_backsolve(options.adjoint):
        raise ValueError(
            "adjoint is 'backsolve', which does not go back through events, and contacts, limits, a terminal event or the "
            "control may end the run; take 'reverse', or jd.events.ContactLost(stop=False), no other events and a control "
            "without `allowance`"
        )
    eqs, args = equations(scene, control, method, entries, *start, conditions, options.terminals)
    # Shapes that do not fit are reported here, with the user's function at the end of the traceback.
    eqx.filter_eval_shape(eqs.generalized_force, args, entries, *start)
    y0 = method.start(scene, *start) | entries
    if has_selection(scene) and not isinstance(options.solver, Stepper):
        y0 = y0 | {KEPT: rows_of(scene, start[0].dtype)}
    y0 = y0 | {"work": jnp.zeros((), start[0].dtype)} if "work" in options.outputs else y0
    return _Run(scene, control, method, eqs, args), y0


def _solver(run: _Run, y0, solver):
    """Solver for the scene, its term, and the projection after each step or None."""
    method, eqs = run.method, run.eqs
    corrects = method.corrects(run.scene)
    if isinstance(solver, Stepper):
        solver = Stepper(eqs.begin, eqs.advance, functools.partial(displace, run.scene.system))
    elif isinstance(solver, LieGroup):
        solver = solver.for_system(run.scene.system)
        if isinstance(solver, LieGroup):
            # In local coordinates a projection has nothing to do for quaternions.
            corrects = method.projects or bool(method.step_constants)
    term = diffrax.ODETerm(eqs.derivative)
    if is_split(solver):
        term = diffrax.MultiTerm(diffrax.ODETerm(eqs.explicit_part), diffrax.ODETerm(eqs.implicit_part))
    return solver, term, eqs.project if corrects or controls.HELD in y0 or KEPT in y0 else None


def _violation(run: _Run, rows, reached, time_reached, guard) -> Violation | None:
    """First violation of a condition that ends the run; `guard`, the one at whose root a step has ended, as of `Outcome`."""
    if not any(run.eqs.conditions):
        return None
    margins = map_rows(lambda row: run.eqs.allowances(run.args, *row), rows)
    return first_violation(margins, reached, rows[-1], time_reached, guard)


def _faults_of_start(run: _Run, y0, inputs: Inputs, options) -> list[tuple[Array, Any]]:
    """Cases of the result: a singular mass matrix, a singular basis, and a terminal event that has no sign at the start."""
    faults = []
    if run.eqs.conditions.terminals:
        values = run.eqs.terminal_values(run.args, inputs.q0, inputs.v0, inputs.ts[0])
        faults.append((~(values > 0).all(), RESULTS.bad_event))
    if options.checks_mass:
        definite = kernel(has_definite_mass)(run.scene.system, inputs.q0, inputs.ts[0])
        faults.append((~definite, RESULTS.singular_mass_matrix))
    quality = run.method.quality(run.scene, y0, inputs.ts[0])
    if quality is not None:
        faults.append((~is_regular(quality), RESULTS.singular_basis))
    return faults


def _faults_of_constraints(run: _Run, rows, result) -> list[tuple[Array, Any]]:
    """Cases of the result at the save points: constraints that are open or contradict each other."""
    if not run.scene.constraints:
        return []

    def is_consistent(row):
        y, *state = row
        scene = run.scene_at(y)  # rows that were exchanged on the way are open by rounding
        ok = consistent(scene, *state)
        return ok & satisfies_redundant_rows(scene, *state) if has_selection(scene) else ok

    def satisfies(row):
        force = run.eqs.generalized_force(run.args, *row)
        return run.method.satisfies(run.scene_at(row[0]), *row[1:], force)  # pyright: ignore[reportCallIssue]

    projects = run.method.projects
    ok = map_rows(is_consistent if projects else satisfies, rows).all()
    return [
        ((result == RESULTS.successful) & ~ok, RESULTS.open_constraints if projects else RESULTS.contradictory_rows)
    ]


def _redundancy(run: _Run, y, q, ts, reached) -> dict[str, Array]:
    """Number of rows that were dropped as redundant, and the largest of their residuals."""
    if not has_selection(run.scene):
        return {}
    gaps = map_rows(lambda row: gap_of_redundant(run.scene_at(row[0]), *row[1:]), (y, q, ts))
    return {
        "redundant_rows": jnp.sum(1 - run.scene.kept_rows.kept).astype(jnp.int32),
        # Rows that were not reached hold the start, and are none of the motion's.
        "redundant_gap": jnp.max(jnp.where(reached, gaps, jnp.zeros_like(gaps))),
    }


# --- integration from the start to the save points: the solver, the loop (our own or diffrax's), and the code at the end ---


class Outcome(NamedTuple):
    """Rows of the state at ts[1:], a code, counts, the time reached, and the guard that is zero there, -1 for none."""

    rows: Any
    result: Any
    counts: dict[str, Any]
    time_reached: Any
    guard: Any = None


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
        outcome = _by_diffrax(given, inputs, steps, options, guards)
        return outcome if guards is None else outcome._replace(rows={x: outcome.rows[x] for x in y0 if x != WITHIN})
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


def _by_diffrax(given: DiffraxRun, inputs, steps, options: Options, guards) -> Outcome:
    """Integrate in diffrax's loop."""
    y0, args, ts = inputs

    def guard_at(result, time, last):
        relative = guards(time, last, args)[0] / sizes_of(guards, ts[0], y0, args)
        # A singular basis may have ended the step too: then no guard is near zero.
        happened = (result == RESULTS.event_occurred) & (jnp.min(relative) <= jnp.finfo(ts.dtype).eps ** 0.25)
        return jnp.where(happened, jnp.argmin(relative), -1)

    def outcome(rows, result, counts, reached, *last):
        return Outcome(
            rows, result, counts, reached, *(guard_at(result, reached, y) for y in last if guards is not None)
        )

    if not is_step_length(steps[-1]):
        rows, (result, *facts) = run_adaptively(inputs, given, options.limit_is_given)
        return outcome(rows, from_diffrax(result), *facts)
    rows, (result, counts, reached, *last), solution = run(inputs, given)
    sums = solution.controller_state[3:] if isinstance(given.controller, ErrorMonitoredSteps) else None
    # diffrax is at the end of the step that could not be solved; what is known ends at its beginning.
    before = ts[0] + (counts["num_steps"].astype(ts.dtype) - 1) * steps[-1]
    result = from_diffrax(result)
    reached = jnp.where(result == RESULTS.nonlinear_divergence, before, reached)
    if sums is not None:
        result = RESULTS.where((result == RESULTS.successful) & too_coarse(sums), RESULTS.coarse_steps, result)
    return outcome(rows, result, counts, reached, *last)


def _by_pieces(plan: Plan, eqs: Equations, inputs, controller, steps, options: Options) -> Outcome:
    """Integrate by steps that end at the kinks of forces."""
    # Imported here, because most scenes have no pieces and a first call should not wait for these modules.
    from jaxdyn.simulation.hybrid import MIN_EVENTS, PiecewiseSystem, piecewise_motion

    system = PiecewiseSystem(plan, eqs.pieces, eqs.switching)
    rtol, atol, stepsize = steps
    (y0, args, ts), has_length = inputs, is_step_length(stepsize)
    room, maximum = options.max_steps, max(MIN_EVENTS, options.max_events)
    if not has_length:
        rtol, atol, stepsize = controller.rtol, controller.atol, None
        room = room if options.limit_is_given else min(room, ROOM)
    rows, end = piecewise_motion(
        system, y0, args, ts, rtol, atol, stepsize, options.max_steps, room, maximum, _is_direct(options.adjoint)
    )
    return Outcome(rows, end.result, end.counts, end.t)


def _by_steps(solver: LibrarySteps, plan: Plan, controller, inputs, steps, options: Options) -> Outcome:
    """Integrate by explicit steps in the library's own loop."""
    # Attempts that locate the end do not count among the user's steps.
    maximum = options.max_steps + (0 if plan.guards is None else 2 * SEARCH_STEPS)
    if isinstance(controller, Adaptive):
        room, control = (
            maximum if options.limit_is_given else min(maximum, ROOM),
            step_control(solver, None, controller.norm),
        )
        run = LibraryRun(plan, control, controller.rtol, controller.atol, None, maximum, room=room)
    else:
        run = LibraryRun(plan, step_control(solver, steps[-1]), None, None, steps[-1], maximum, room=maximum)
    rows, (result, counts, reached, hit) = (run.direct if _is_direct(options.adjoint) else run)(*inputs)
    if plan.guards is None:
        return Outcome(rows, result, counts, reached)
    rows, end = (jax.tree.map(lambda x, at=at: x[at], rows) for at in (slice(-1), -1))
    y, first = ravel_pytree(end)[0], jnp.argmax(hit)

    def guard(known, t, y):
        return plan.guards_of(known[0], t, y)[0][known[1]]

    late = delay(guard, lambda known, t, y: plan.field_of(known[0], t, y), (inputs[1], first), reached, y)
    return Outcome(rows, result, counts, reached + jnp.where(hit.any(), late, 0.0), jnp.where(hit.any(), first, -1))
