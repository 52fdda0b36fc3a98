"""One run: checks of the start, integration, checks of the end, and the outputs."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from jaxdyn.compile import kernel
from jaxdyn.compile.batch import map_rows
from jaxdyn.constraints.redundancy import exchange_rows, gap_of_redundant, has_selection, keep_rows, row_mask, rows_of
from jaxdyn.constraints.selection import most_rounding, select_rows
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.model.tree import Model, neutral
from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation.equations import DRIVES, KEPT, equations
from jaxdyn.simulation.integration import integrate
from jaxdyn.simulation.methods import Method, consistent, is_regular, meets_dropped_rows, start_limit
from jaxdyn.simulation.outputs import at_save_point
from jaxdyn.simulation.solution import RESULTS, Solution, faults_of_inputs, first_of, rows_where
from jaxdyn.simulation.solvers import LieGroup, Stepper
from jaxdyn.simulation.solvers.choice import (
    is_fixed,
    is_split,
    label,
)
from jaxdyn.simulation.solvers.differentiable import COUNTS
from jaxdyn.simulation.solvers.inputs import (
    has_unit_quaternions,
    most_turned,
    turning,
    usable_steps,
)
from jaxdyn.simulation.start import has_definite_mass
from jaxdyn.systems.scene import Scene, check_callback
from jaxdyn.systems.system import displace, has_dependent_coordinates, retract


def motion(scene: Scene, control, method: Method, numbers, options) -> Solution:
    """The run of `simulate`; `numbers`: q0, v0, ts, rtol, atol and the length of steps or a controller of them."""
    q0, v0, ts, *steps = numbers
    system, outputs = scene.system, options["outputs"]
    unit_start = has_unit_quaternions(system, q0)
    q0 = retract(system, q0)
    in_order = jnp.isfinite(ts).all() & (ts[1:] > ts[:-1]).all()
    given_times, ts = ts, jnp.where(in_order, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    finite_start = jnp.isfinite(q0).all() & jnp.isfinite(v0).all()
    steps, fine_steps, fine_tolerances = usable_steps(steps, ts)
    good = finite_start & unit_start & in_order & fine_steps & fine_tolerances
    # A bad lane of a batch takes a harmless start, so that it does not make the others wait.
    harmless = jnp.zeros_like(q0)
    if isinstance(system, Model):
        harmless = (
            harmless.at[system.topology.nq :].set(1.0).at[: system.topology.nq].set(neutral(system).astype(q0.dtype))
        )
    q0, v0 = jnp.where(good, q0, harmless), jnp.where(good, v0, jnp.zeros_like(v0))
    start_ok, is_free = jnp.asarray(True), None
    if options["selects_rows"]:
        selection = select_rows(scene, q0, ts[0], method.rank_tol)
        scene = keep_rows(scene, selection)
        start_ok = selection.rounding <= most_rounding(q0.dtype)
        is_free = jnp.sum(selection.kept) < scene.nv
    if scene.constraints:
        start_ok = start_ok & consistent(scene, q0, v0, ts[0])
        if method.projects:
            given_start = q0, v0
            q0, v0 = method.onto_constraints(scene, q0, v0, ts[0])
            # Residuals of a small mechanism are small numbers of metres: how far it moves onto the constraints tells more.
            corrections = [
                jnp.max(jnp.abs(x - y)) / (1 + jnp.max(jnp.abs(x))) for x, y in zip(given_start, (q0, v0), strict=True)
            ]
            start_ok = start_ok & (jnp.maximum(*corrections) <= 10 * start_limit(q0.dtype))
    # Refuses callbacks that do not fit before diffrax meets them.
    for i, force in enumerate(scene.forces):
        check_callback(force, f"forces[{i}]", "force(system, q, v, t)", q0, v0, ts[0], first=(system,))
    controls.check_control(scene, control, q0, v0, ts[0])
    states = controls.started(control, q0, v0, ts[0])
    if (of_drives := scene.drive_state(q0, v0, ts[0])) is not None:
        states = states | {DRIVES: of_drives}
    added = tuple(states)  # names alone, as functions of a run hold no arrays
    options = options | {"control_ends": controls.can_end(control, q0, v0, ts[0])}
    eqs = equations(scene, control, method, states, q0, v0, ts[0], options)
    eqx.filter_eval_shape(eqs.generalized_force, eqs.args, states, q0, v0, ts[0])
    y0 = method.start(scene, q0, v0, ts[0]) | states
    first = method.quality(scene, y0, ts[0])
    if has_selection(scene) and not isinstance(options["solver"], Stepper):
        y0 = y0 | {KEPT: rows_of(scene, q0.dtype)}
    y0 = y0 | {"work": jnp.zeros((), q0.dtype)} if "work" in outputs else y0
    solver = options["solver"]
    if isinstance(solver, Stepper):
        solver = Stepper(eqs.begin, eqs.advance, functools.partial(displace, system))
    elif isinstance(solver, LieGroup):
        solver = solver.fitted(system)
    # Of what a projection does, local coordinates leave nothing to be done about quaternions.
    corrects = (
        method.projects or bool(method.step_constants) if isinstance(solver, LieGroup) else method.corrects(scene)
    )
    corrects = corrects or controls.HELD in added or KEPT in y0
    term = diffrax.ODETerm(eqs.derivative)
    if is_split(solver):
        term = diffrax.MultiTerm(diffrax.ODETerm(eqs.explicit_part), diffrax.ODETerm(eqs.implicit_part))
    options = options | {"solver": solver}
    corrector = eqs.project if corrects else None
    rows, result, counts, time_reached, last = integrate(term, corrector, eqs, method, y0, ts, steps, options)

    y = jax.tree.map(lambda start, later: jnp.concatenate([start[None], later]), y0, rows)
    finite = [jnp.isfinite(rows).reshape(ts.shape[0], -1).all(1) for rows in y.values()]
    reached = good & jnp.stack(finite).all(0)
    y = jax.tree.map(functools.partial(rows_where, reached), y, y0)
    work = y.pop("work", None)

    def scene_at(y):
        """The scene with the rows that are kept at a save point."""
        return exchange_rows(scene, y[KEPT]) if KEPT in y else scene

    def to_qv(row):
        y, t = row
        own = scene_at(y)
        return method.to_qv(own, method.corrected(own, y, t), t)

    # By the kernels that have put the start on the constraints.
    q, v = map_rows(to_qv, (y, ts))
    lost, ends = None, []
    if eqs.least_allowance is not None:
        margins, within = map_rows(lambda row: eqs.allowances(eqs.args, *row), (y, q, v, ts)), None
        if last is not None:
            there = eqs.allowances(eqs.args, last, *method.to_qv(scene, last, time_reached), time_reached)
            within = (result == RESULTS.event_occurred, time_reached, there)
        lost = unilateral.first_loss(margins, reached, ts, within)
        reached = reached & ~(lost.happened & (ts > lost.time))
        time_reached = jnp.where(lost.happened, lost.time, time_reached)
        by_contacts = unilateral.can_end(scene, options["contacts"])
        count = len(contacts_with_cones(scene)) if by_contacts else 0
        limits = 2 * q.shape[1] if options["limits"] == "stop" else 0
        at_limit = lost.happened & (lost.entry >= count) & (lost.entry < count + limits)
        by_control = lost.happened & (lost.entry >= count + limits)
        by_contact = lost.happened & (lost.entry < count)
        ends += [
            (by_control, RESULTS.control_singular),
            (at_limit, RESULTS.joint_limit_passed),
            (by_contact, RESULTS.contact_lost),
        ]
    if has_dependent_coordinates(system):
        follows = jnp.cumsum(~map_rows(system.is_consistent, q)) == 0
        ends.insert(0, (~follows.all(), RESULTS.no_single_contact))
        reached = reached & follows
        time_reached = jnp.where(follows.all(), time_reached, jnp.max(jnp.where(reached, ts, ts[0])))
    result = first_of([*ends, (result == RESULTS.event_occurred, RESULTS.singular_basis)], result)
    ended = (result == RESULTS.successful) | (result == RESULTS.coarse_steps)
    nonfinite = ended & ~reached.all()
    # Fixed steps go on from what is not finite: all that is known is the last state before it that was kept.
    kept = jnp.max(jnp.where(reached, ts, ts[0]))
    time_reached = jnp.where(nonfinite | (result == RESULTS.nonfinite_state), kept, time_reached)
    failures = faults_of_inputs(
        in_order=in_order,
        fine_steps=fine_steps,
        fine_tolerances=fine_tolerances,
        finite_start=finite_start,
        unit_start=unit_start,
    )
    angles = turning(system)
    if angles.size and not is_fixed(steps[-1]):
        coarse = jnp.max(jnp.abs(q0[angles])) > most_turned(q0.dtype)
        failures.append((coarse, RESULTS.coarse_start))
    failures.append((~start_ok, RESULTS.inconsistent_start))
    if is_free is not None:
        failures.append((~is_free, RESULTS.no_freedom))
    if options["checks_mass"]:
        failures.append((~kernel(has_definite_mass)(system, q0, ts[0]), RESULTS.singular_mass_matrix))
    if first is not None:
        failures.append((~is_regular(first), RESULTS.singular_basis))
    failures.append((nonfinite, RESULTS.nonfinite_state))
    if method.projects and scene.constraints:

        def is_closed(row):
            y, *state = row
            own = scene_at(y)  # rows that were exchanged on the way are as open as rounding leaves them
            met = consistent(own, *state)
            return met & meets_dropped_rows(own, *state) if has_selection(own) else met

        closed = map_rows(is_closed, (y, q, v, ts))
        failures.append(((result == RESULTS.successful) & ~closed.all(), RESULTS.open_constraints))
    elif scene.constraints:

        def is_met(row):
            force = eqs.generalized_force(eqs.args, *row)
            return method.satisfies(scene_at(row[0]), *row[1:], force)  # pyright: ignore[reportCallIssue]

        met = map_rows(is_met, (y, q, v, ts))
        failures.append(((result == RESULTS.successful) & ~met.all(), RESULTS.contradictory_rows))

    of_control = {name: y[name] for name in added}

    def of_row(row):
        y, *state = row
        return at_save_point(scene_at(y), control, method, eqs, outputs, *state)

    computed = map_rows(of_row, (y, q, v, ts, of_control))
    rows = {"q": q, "v": v} | computed | ({} if work is None else {"work": work})
    whole = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(rows)]).all()
    result = first_of([*failures, ((result == RESULTS.successful) & ~whole, RESULTS.nonfinite_state)], result)
    rows = jax.tree.map(lambda x: rows_where(reached, x, jnp.nan), rows)
    stats = {name: jnp.asarray(counts[name], jnp.int32) for name in COUNTS}
    stats["time_reached"] = jnp.where(good, time_reached, ts[0])
    if has_selection(scene):
        gaps = map_rows(lambda row: gap_of_redundant(scene_at(row[0]), *row[1:]), (y, q, ts))
        stats["redundant_rows"] = jnp.sum(1 - row_mask(scene)).astype(jnp.int32)
        stats["redundant_gap"] = jnp.max(jnp.where(reached, gaps, jnp.zeros_like(gaps)))
    if lost is not None and unilateral.can_end(scene, options["contacts"]):
        stats["lost_contact"] = jnp.where(lost.entry < count, lost.entry, -1)
    if lost is not None and options["limits"] == "stop":
        stats["passed_limit"] = jnp.where(at_limit, (lost.entry - count) % q.shape[1], -1).astype(jnp.int32)
    return Solution(ts=given_times, result=result, stats=stats, solver=label(solver), **rows)
