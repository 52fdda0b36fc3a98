"""A motion with modes from its start to its save points: what `jd.simulate` calls for a scene with such forces."""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile import kernel
from jaxdyn.compile.known import partition_tracers
from jaxdyn.constraints.base import velocity_residual
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import kinetic_energy, potential_energy
from jaxdyn.forces.piecewise import fix_pieces, guards, pieces_of
from jaxdyn.model.tree import Model, neutral
from jaxdyn.simulation.controls import Controller, Sampled
from jaxdyn.simulation.hybrid import machine
from jaxdyn.simulation.hybrid.dynamics import by_element, directions, gaps, motion_at, slides, terms_at
from jaxdyn.simulation.hybrid.events import Events
from jaxdyn.simulation.hybrid.laws import laws_of, put_back
from jaxdyn.simulation.hybrid.modes import KINDS, Mode, elements_of, extended, force_at
from jaxdyn.simulation.hybrid.replay import Hybrid
from jaxdyn.simulation.hybrid.transitions import length
from jaxdyn.simulation.methods import consistent
from jaxdyn.simulation.solution import Solution, faults_of_inputs, first_of, rows_where
from jaxdyn.simulation.solvers.choice import is_fixed, label, unwrapped
from jaxdyn.simulation.solvers.differentiable import ROOM
from jaxdyn.simulation.solvers.fixed_steps import too_coarse
from jaxdyn.simulation.solvers.inputs import has_unit_quaternions
from jaxdyn.systems.scene import Scene, check_callback, check_force
from jaxdyn.systems.system import retract

OUTPUTS = ("energy", "acceleration", "multipliers", "contact_forces", "torque")
_CODES = {
    machine.SHORT: "dt_min_reached",
    machine.PARADOX: "painleve_paradox",
    machine.NO_MODE: "no_contact_mode",
    machine.CROWDED: "too_many_events",
}


def check_options(control, stepsize, solver, adjoint, outputs) -> None:
    """Refuse what motions with modes do not do.

    **Raises:** ValueError.
    """
    what = "the scene has forces with modes (jd.contact.DryFriction, jd.contact.UnilateralContact)"
    if isinstance(control, (Controller, Sampled)):
        raise ValueError(f"control is a {type(control).__name__}, and {what}; give a function control(q, v, t)")
    if stepsize is not None and not is_fixed(stepsize):
        raise ValueError(
            f"stepsize is {stepsize!r}, and {what}; leave it out for steps that keep rtol and atol, or give a length (s)"
        )
    if not isinstance(solver, diffrax.AbstractERK) or isinstance(unwrapped(solver), diffrax.AbstractWrappedSolver):
        raise ValueError(
            f"solver is {label(solver)}, and {what}, looked for within explicit steps; take diffrax.Dopri8() or Tsit5(), "
            "or, where forces are stiff, friction without modes (jd.forces.CoulombFriction)"
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(f"adjoint is 'backsolve', which does not go back through events, and {what}; take 'reverse'")
    for name in outputs:
        if name not in OUTPUTS and not name.startswith("pose:"):
            raise ValueError(f"outputs has {name!r}, and {what}; choose from {', '.join(OUTPUTS)} and 'pose:<frame>'")


def check_count(most: Any) -> None:
    """**Raises:** ValueError for anything but a positive number of events."""
    if isinstance(most, bool) or not isinstance(most, (int, np.integer)) or most < 1:
        raise ValueError(f"max_events is {most!r}; pass a positive integer, such as 64")


def motion(scene: Scene, control, numbers, options) -> Solution:
    """The solution; `numbers` are q0, v0, ts, rtol, atol, and the length of fixed steps or None."""
    q0, v0, ts, rtol, atol, stepsize = numbers
    system, outputs = scene.system, options["outputs"]
    control_of: Any = (
        None if control is None else lambda _, q, v, t: (check_force(control(q, v, t), q, scene.nv, "control"),)
    )
    pieces = pieces_of(scene, (), q0, v0, ts[0], control_of)
    elements = elements_of(scene, pieces)
    eps, dtype = float(jnp.finfo(q0.dtype).eps), q0.dtype
    unknown, known = partition_tracers((scene, control))
    unknown = tuple(unknown)
    bare = extended(scene).forces

    def given(unknown, positive=None):
        scene, control = known(unknown)
        in_piece = scene if positive is None or not pieces.names else fix_pieces(scene, pieces, positive)
        whole = extended(in_piece)

        def effort(q, v, t):
            """Of the control, before limits."""
            return None if control is None else check_force(control(q, v, t), q, scene.nv, "control")

        def generalized_force(q, v, t):
            force, tau = whole.applied_force(q, v, t), effort(q, v, t)
            if tau is None:
                return force
            tau = in_piece.drive_torque(q, v, t, tau)[0]
            return tau if force is None else tau + force

        return in_piece, generalized_force, lambda q, v, t: guards(scene, q, v, t, effort(q, v, t))

    for i, force in enumerate(bare):
        check_callback(force, f"forces[{i}]", "force(system, q, v, t)", q0, v0, ts[0], first=(system,))
    in_order = jnp.isfinite(ts).all() & (ts[1:] > ts[:-1]).all()
    given_times, ts = ts, jnp.where(in_order, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    unit_start = has_unit_quaternions(system, q0)
    q0 = retract(system, q0)
    finite_start = jnp.isfinite(q0).all() & jnp.isfinite(v0).all()
    fine = jnp.isfinite(rtol) & (rtol >= 0) & jnp.isfinite(atol) & (atol >= 0)
    rtol, atol = (jnp.maximum(jnp.where(fine, x, 1e-3), 10 * eps).astype(dtype) for x in (rtol, atol))
    fine_steps = jnp.ones((), bool)
    if stepsize is not None:
        fine_steps = jnp.isfinite(stepsize) & (stepsize > 0)
        stepsize = jnp.where(fine_steps, stepsize, ts[-1] - ts[0])
    good = finite_start & unit_start & in_order & fine & fine_steps
    harmless = neutral(system).astype(dtype) if isinstance(system, Model) else jnp.zeros_like(q0)
    q0, v0 = jnp.where(good, q0, harmless), jnp.where(good, v0, jnp.zeros_like(v0))

    mode, slip, start_ok = _guess(scene, elements, q0, v0, ts[0])
    mode = mode._replace(positive=given(unknown)[2](q0, v0, ts[0]) > 0)
    own = Scene(system, scene.constraints)
    if scene.constraints:
        start_ok = start_ok & consistent(own, q0, v0, ts[0])
    y0 = {"q": q0, "v": v0, "slip": slip}
    laws = laws_of(given, elements, options["solver"], y0)
    most = options["max_events"]
    room = options["max_steps"] if stepsize is not None else min(options["max_steps"], ROOM)
    hybrid = Hybrid(laws, mode, rtol, atol, stepsize, options["max_steps"], most, room)
    is_direct = isinstance(options["adjoint"], (diffrax.ForwardMode, diffrax.DirectAdjoint))
    rows, times, facts = (hybrid.direct if is_direct else hybrid)(y0, unknown, ts)
    lane, records, begun = facts
    # A save point at an event shows what was before.
    passed = jnp.sum(records.time[None, :most] < ts[:, None], 1)
    modes = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:most]])[passed], begun.mode, records.mode)
    first = {"q": q0, "v": v0, "slip": begun.slip}
    y = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rows)
    reached = good & jnp.isfinite(y["q"]).all(1) & jnp.isfinite(y["v"]).all(1)
    y = jax.tree.map(partial(rows_where, reached), y, first)

    def report(unknown, row):
        y, mode, t = row
        scene_, generalized_force, _ = given(unknown)
        system, control = scene_.system, known(unknown)[1]
        q, v, values = y["q"], y["v"], {}
        if "energy" in outputs:
            values["energy"] = kinetic_energy(system, q, v, t) + potential_energy(system, q, t)
        if "torque" in outputs:
            tau = jnp.zeros_like(v) if control is None else check_force(control(q, v, t), q, scene.nv, "control")
            values["torque"] = scene_.drive_torque(q, v, t, tau)[0]
        if {"acceleration", "multipliers", "contact_forces"} & set(outputs):
            terms = terms_at(scene_, elements, q, v, t)
            at_time = motion_at(scene_, elements, mode, terms, y["slip"], generalized_force(q, v, t), q, v, t)
            if "acceleration" in outputs:
                values["acceleration"] = at_time.acceleration
            if "multipliers" in outputs:
                values["multipliers"] = at_time.pushed.multipliers[: elements.own]
            if "contact_forces" in outputs:
                values["contact_forces"] = _forces(scene_, elements, mode, terms, at_time, y["slip"])
        frames = [name.removeprefix("pose:") for name in outputs if name.startswith("pose:")]
        return values | {"poses": {frame: frame_pose(system, q, frame) for frame in frames}}

    def closed(unknown, row):
        y, mode, t = row
        return put_back(given(unknown)[0], elements, mode, t, y, None)[0]

    later = lax.map(partial(kernel(closed), unknown), jax.tree.map(lambda x: x[1:], (y, modes, ts)))
    y = jax.tree.map(lambda a, b: jnp.concatenate([a[:1], b]), y, later)
    values = lax.map(partial(kernel(report), unknown), (y, modes, ts))

    codes: Any = RESULTS
    cases = faults_of_inputs(
        in_order=in_order, fine_steps=fine_steps, fine_tolerances=fine, finite_start=finite_start, unit_start=unit_start
    )
    cases.append((~start_ok, codes.inconsistent_start))
    for code, name in _CODES.items():
        if code == machine.SHORT and stepsize is not None:
            name = "nonfinite_state"
        cases.append((lane.code == code, getattr(codes, name)))
    cases.append((lane.t < ts[-1], codes.max_steps_reached))
    if stepsize is not None:
        cases.append((too_coarse(lane.sums), codes.coarse_steps))
    result = first_of([*cases, (~reached.all(), codes.nonfinite_state)], codes.successful)
    stats = {
        "num_steps": lane.taken,
        "num_accepted_steps": lane.kept,
        "num_rejected_steps": lane.taken - lane.kept,
        "time_reached": jnp.where(good, lane.t, ts[0]),
    }
    struck = _struck(scene, elements, q0, v0, ts[0], mode)
    happened = _events(elements, struck, ts[0], times, records.name[:most], good & start_ok)
    solver = label(options["solver"])
    shown = {"q": y["q"], "v": y["v"], **values}
    shown = jax.tree.map(lambda rows: rows_where(reached, rows, jnp.nan), shown)
    return Solution(ts=given_times, result=result, stats=stats, events=happened, solver=solver, **shown)


def _guess(scene: Scene, elements, q, v, t):
    """The mode of a start as far as its place and velocity tell, directions of sliding, and whether no contact is pressed in."""
    small = float(jnp.finfo(q.dtype).eps) ** 0.6
    gap, reach = gaps(scene, elements, q, t), 1 + jnp.max(jnp.abs(q))
    slip = by_element(elements, velocity_residual(extended(scene), q, v, t))
    speed, unit = length(slip)
    opens = jnp.asarray(elements.opening)
    mode = Mode(
        ~opens | (gap <= small * reach),
        speed <= small * (1 + jnp.max(jnp.abs(v))),
        jnp.zeros(gap.shape, bool),
        jnp.zeros((0,), bool),
    )
    smooth = jnp.asarray(np.array([one.smooth for one in elements.each]))
    limit = float(jnp.finfo(q.dtype).eps) ** 0.4
    start_ok = (~opens | (gap >= -limit * reach)).all()
    return mode._replace(stick=mode.stick & ~smooth), lax.stop_gradient(unit), start_ok


def _struck(scene: Scene, elements, q, v, t, mode: Mode):
    """Which contacts are closed at the start by an impact, (n,)."""
    rates = velocity_residual(extended(scene), q, v, t)
    small = float(jnp.finfo(q.dtype).eps) ** 0.6 * (1 + jnp.max(jnp.abs(v)))
    into = [rates[one.normal] < -small if one.opens else jnp.zeros((), bool) for one in elements.each]
    return mode.closed & jnp.stack(into)


def _events(elements, struck, start, times, index, good) -> Events:
    """The events of a run, with the impacts at its start in front; none of a start that is refused."""
    most = index.shape[0]
    first = jnp.where(struck, jnp.arange(struck.shape[0], dtype=index.dtype) * len(KINDS), -1)
    index = jnp.concatenate([first, index])
    times = jnp.concatenate([jnp.where(struck, start, jnp.nan), times])
    order = jnp.argsort(index < 0, stable=True)[:most]
    index, times = index[order], times[order]
    return Events(jnp.where(good, times, jnp.nan), jnp.where(good, index, -1), elements.names)


def _forces(scene: Scene, elements, mode: Mode, terms, at_time, slip) -> dict:
    """Friction along the rows (2,), what holds or what brakes, and normal force, by the names of the elements: (3,)."""
    along, sliding, forces = directions(scene, elements, terms.slip, slip), slides(elements, mode), {}
    for i, one in enumerate(elements.each):
        level = jnp.where(sliding[i], force_at(scene, one).coefficient.astype(slip.dtype) * at_time.normal[i], 0.0)
        normal = jnp.where(mode.closed[i], at_time.normal[i], 0.0)
        forces[one.name] = jnp.append(at_time.pushed.holding[i] - level * along[i], normal)
    return forces
