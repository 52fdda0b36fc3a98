"""Motion of a scene in time: `simulate` integrates it with any diffrax method and reports what went wrong, if anything.

The state is (q, v) with dq/dt = H(q) v and dv/dt from the dynamics. Quaternions in q are integrated as four numbers and
returned to unit length at the end of every step (`ProjectedSolver`), which keeps the order of the method. A model
without quaternions gets no projection at all.
"""

import functools
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdyn.compile import compiled, is_concrete, is_expanding, is_known, is_rank_safe, partition_traced
from jaxdyn.constraints.assembly import residuals
from jaxdyn.dynamics.kinematics import frame_pose
from jaxdyn.dynamics.quantities import kinetic_energy, potential_energy
from jaxdyn.model.arguments import as_array, state_dtype
from jaxdyn.model.tree import Model, frame_index, neutral
from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation.methods import Method, Reduced, checked_start, chosen_method, consistent, serves, start_limit
from jaxdyn.simulation.solution import RESULTS, Solution, from_diffrax, raise_failure
from jaxdyn.simulation.solvers import ExplicitSteps, LieGroup, ProjectedSolver, Stepper, driver
from jaxdyn.simulation.solvers.choice import (
    checked_adjoint,
    checked_method,
    checked_step_limit,
    for_start,
    is_fixed,
    is_split,
    label,
    progress_meter,
    stepping,
)
from jaxdyn.simulation.solvers.differentiable import COUNTS, ROOM, run, run_adaptively
from jaxdyn.simulation.solvers.driver import Drive
from jaxdyn.simulation.solvers.explicit import Plan
from jaxdyn.simulation.solvers.first_step import Adaptive
from jaxdyn.simulation.solvers.fixed_steps import Watched, too_coarse
from jaxdyn.simulation.solvers.inputs import (
    check_start,
    check_times,
    check_tolerance,
    check_turns,
    most_turned,
    turning,
    usable_steps,
)
from jaxdyn.systems.scene import Scene, as_scene, check_callback
from jaxdyn.systems.system import System, displace, retract, velocity_to_rate

_OUTPUTS = (
    "energy",
    "power",
    "work",
    "acceleration",
    "multipliers",
    "constraint_residual",
    "torque",
    "control_state",
    *unilateral.OUTPUTS,
)
_POSE = "pose:"


def simulate(
    scene: Any,
    q0: Any,
    v0: Any,
    ts: Any,
    *,
    control: Any = None,
    method: str | Method = "auto",
    solver: Any = None,
    stepsize: Any = None,
    rtol: Any = 1e-8,
    atol: Any = 1e-8,
    adjoint: str | diffrax.AbstractAdjoint | None = None,
    outputs: Sequence[str] = (),
    contacts: str = "stop",
    progress: bool = False,
    max_steps: int | None = None,
    throw: bool | None = None,
) -> Solution:
    """Integrate M a + C v + N = tau + forces + A^T lam, dq/dt = H(q) v, from (q0, v0) and save it at the times `ts`.

    One sample; batch states, controls and the scene's leaves with `jax.vmap`. Computed in the dtype of the model.
    Called outside of `jax.jit` it compiles once per shape, whatever the numbers. Inside your own `jax.jit`, a model
    that is closed over is known to the compiler and runs faster; one that is an argument serves for other numbers
    too.

    **Arguments:**

    - `scene`: a `Scene`, or a `Model` to which no forces apply.
    - `q0` (nq,), `v0` (nv,): state at `ts[0]`. Quaternions up to 0.1 % from unit length are normalised.
    - `ts` (nt,): strictly increasing times (s), nt >= 2; the first is the start.
    - `control(q, v, t) -> (nv,)`: tau (N m or N); q comes with unit quaternions. An equinox Module or a
      `jax.tree_util.Partial` carries leaves that can be differentiated and batched; a plain function is static: define
      it once. A `jd.Controller` has a state of its own, integrated with the motion, and is told the multipliers; a
      `jd.Sampled` law is called once a period, and its torque is held.
    - `method`: "free" or "variational" for a scene without constraints. With them
      "projected": accelerations with multipliers, and q and v put back on the constraints after every step and at save
      points, by the least change in the mass metric;
      "multipliers": the same without the projection, so that the constraints open as the local errors add up;
      "reduced": minimal velocities are integrated, and q by v = N nu + v0; `jd.Reduced(basis)` chooses them;
      "variational": steps of fixed length that keep the energy over long times, with a solver of their own;
      "baumgarte": violated rows are pulled back, for comparison; `jd.Baumgarte(alpha, beta)` sets how fast.
      "auto" takes "free", or "projected", which takes dependent rows and rank loss in passing and needs no choice.
    - `solver`: any diffrax method of an `ODETerm`, `jd.Rodas5P()`, `jd.LieGroup(...)` of one of them, or a method that takes an
      implicit and an explicit part (`diffrax.KenCarp4`): implicit are dq/dt = H v and what the scene's forces add to the
      acceleration, explicit all the rest (inertia, gravity, `control`). Default: `RK4` for fixed steps; for adaptive
      ones `Dopri8`, or `Rodas5P` where the scene lists forces, all inputs are concrete and `jd.stiffness` at the start says
      that explicit steps would have to be shorter than a thousandth of the time.
    - `stepsize`: None for adaptive steps, a number (s) for fixed ones, or a diffrax step-size controller.
    - `rtol`, `atol`: local error of a step, relative to and besides the size of each entry of (q, v). Values below ten
      times the rounding error of the dtype are raised to that. With fixed steps, tolerances of an implicit solver.
    - `adjoint`: "reverse" (default) for reverse mode with checkpoints; "forward" for jvp, jacfwd and Hessians by
      forward over forward mode; "direct" for both modes, at a cost that grows with `max_steps`; "backsolve" for the
      continuous adjoint, whose gradients are approximate; or a diffrax adjoint.
    - `outputs`: any of "energy", "power", "work" (one more state, under the same error control), "acceleration",
      "multipliers", "constraint_residual", "contact_forces", "contact_margins", "torque" (of the control), "control_state" (of
      a controller) and
      "pose:<frame>". They are computed only if asked for.
    - `contacts`: of a scene with `cones`. "stop": where a contact pulls or leaves its cone (a margin below zero by more than
      rounding, eps^(1/2) of its force) the run ends, with the code `contact_lost` and the time, which is found within the
      step. "report": it goes on, and contacts hold on both sides.
    - `progress`: show a meter (tqdm if installed, else lines of text).
    - `max_steps`: most steps to take, rejected ones included. Default: what fixed steps need; 65536 for adaptive ones,
      4096 with "direct", and where reverse mode goes through adaptive steps: it remembers where each one ends, at 8 bytes a
      step and trajectory.
    - `throw`: raise when the integration fails. Default: yes if all inputs are concrete, else see `Solution.result`.

    **Returns:** a `Solution`. Save points between steps come from the method's dense output. Where that is less
    accurate than the steps (Kvaerno5), adaptive steps end on every save point.

    **Raises:** ValueError for wrong shapes, NaN, times that do not increase, quaternions far from unit length, angles of
    too many turns for the dtype, a start off the constraints or without a motion (a singular mass matrix of a
    `System`), constraints that remove all freedom, unknown options, with names and values.
    RuntimeError with the time reached, the cause and the fix, if it fails and `throw`.

    ```python
    solution = jd.simulate(model, q0, v0, jnp.linspace(0.0, 1.0, 101), outputs=("energy",))
    ```
    """
    scene = as_scene(scene)
    q0, v0, ts = as_array(q0, "q0"), as_array(v0, "v0"), as_array(ts, "ts")
    check_start(scene, q0, v0)
    check_times(ts)
    rtol, atol = as_array(rtol, "rtol"), as_array(atol, "atol")
    check_tolerance("rtol", rtol)
    check_tolerance("atol", atol)
    stepsize = as_array(stepsize, "stepsize") if is_fixed(stepsize) else stepsize
    method = chosen_method(scene, method)
    if scene.constraints and is_concrete((scene, method, q0, v0, ts)):
        state = [np.asarray(x, state_dtype(scene.system)) for x in (q0, v0, np.asarray(ts)[0])]
        method = checked_start(scene, method, *state)
    if isinstance(scene.system, System) and is_concrete((scene, q0, v0, ts)):
        with jax.ensure_compile_time_eval():
            scene.system.check_start(*(jnp.asarray(x, state_dtype(scene.system)) for x in (q0, v0, ts[0])))
    if not is_fixed(stepsize) and is_concrete(q0):
        check_turns(scene, q0, state_dtype(scene.system))
    control = controls.as_control(control)
    controls.check_steps(control, stepsize)
    backwards = adjoint == "backsolve" or isinstance(adjoint, diffrax.BacksolveAdjoint)
    if solver is None and scene.forces and not (is_fixed(stepsize) or backwards):
        solver = for_start(scene, controls.at_start(control, q0, v0, ts[0]), q0, v0, ts)
    solver = checked_method(method.stepper(solver, stepsize), stepsize)
    adjoint = checked_adjoint(adjoint, solver)
    if isinstance(solver, Stepper) and isinstance(control, (controls.Controller, controls.Sampled)):
        raise ValueError(
            f"control is a {type(control).__name__}, whose state the steps of method 'variational' do not integrate; take "
            "another method"
        )
    if isinstance(solver, Stepper) and isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint is 'backsolve', which needs a differential equation; take 'reverse' or another method"
        )
    if method.jumping and isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint is 'backsolve', which cannot follow the basis of method='reduced' backwards; take 'reverse', or "
            "jd.Reduced with independent velocities or a function"
        )
    outputs = _checked_outputs(scene, outputs)
    unilateral.check_contacts(scene, contacts, outputs)
    options = {
        "solver": solver,
        "adjoint": adjoint,
        "outputs": outputs,
        "contacts": contacts,
        "progress": bool(progress),
        "max_steps": checked_step_limit(max_steps, ts, stepsize, adjoint),
        "limit_is_given": max_steps is not None,
    }
    dtype = state_dtype(scene.system)
    numbers = [jnp.asarray(x, dtype) for x in (q0, v0, ts, rtol, atol)]
    numbers.append(jnp.asarray(stepsize, dtype) if is_fixed(stepsize) else stepsize)
    concrete = is_known(scene, control, method, numbers)
    solution = _run(scene, control, method, numbers, options)
    if throw is None:
        throw = concrete
    if throw and concrete:
        raise_failure(solution, scene, control, options)
    elif throw:
        solution = solution.result.error_if(solution, ~solution.success)
    return solution


@compiled
def _run(scene: Scene, control, method: Method, numbers, options) -> Solution:
    return _motion(scene, control, method, numbers, options)


def _motion(scene: Scene, control, method: Method, numbers, options) -> Solution:
    q0, v0, ts, *steps = numbers
    system, outputs = scene.system, options["outputs"]
    # diffrax compiles its arguments, which hides their values. What is known stays in closures, the rest is `args`:
    # flat, because its continuous adjoint takes no empty tuples.
    unknown, known = partition_traced((scene, control, method))
    args = tuple(unknown) or None

    def given(args):
        """The scene, the control and the method."""
        return known(args or ())

    def torque(args, y, q, v, t):
        """Of the control, or None when there is none."""
        scene, control, method = given(args)

        def multipliers(tau):
            force = scene.applied_force(q, v, t)
            return method.multipliers(scene, q, v, t, tau if force is None else tau + force)

        return controls.torque(control, scene, y, q, v, t, multipliers)

    def effort(args, y, q, v, t):
        """Tau plus the scene's forces, or None when there are none."""
        force, tau = given(args)[0].applied_force(q, v, t), torque(args, y, q, v, t)
        return force if tau is None else tau if force is None else tau + force

    def of_control(args, y, q, v, t, force):
        """Rates of what the control adds to the state."""
        scene, control, method = given(args)
        return controls.rates(control, y, q, v, t, lambda: method.multipliers(scene, q, v, t, force))

    def power(force, v):
        return jnp.zeros((), v.dtype) if force is None else jnp.sum(v * force)

    # Traced once for all the places where diffrax and differentiation call it, and once for each way in which it is traced.
    @functools.partial(jax.jit, static_argnums=0)
    def traced(way, t, y, args):
        scene, _, method = given(args)
        rates, force, v = method.evaluated(scene, y, t, functools.partial(effort, args, y))
        if added:
            rates = rates | of_control(args, y, retract(system, y["q"]), v, t, force)
        return rates | {"work": power(force, v)} if "work" in y else rates

    def derivative(t, y, args):
        return traced((is_expanding(), is_rank_safe()), t, y, args)

    @jax.jit
    def explicit_part(t, y, args):
        """All rates but those of `implicit_part`."""
        scene, _, method = given(args)
        q, v = method.place(scene, y, t)
        rates = method.rates(scene, y, q, v, t, torque(args, y, q, v, t)) | {"q": jnp.zeros_like(y["q"])}
        force = effort(args, y, q, v, t) if added or "work" in y else None
        rates = rates | of_control(args, y, q, v, t, force)
        return rates | {"work": power(force, v)} if "work" in y else rates

    @jax.jit
    def implicit_part(t, y, args):
        """dq/dt = H v, and what the scene's forces add to the rates of velocity, on which they act linearly."""
        scene, _, method = given(args)
        q, v = method.place(scene, y, t)
        rates = jax.tree.map(jnp.zeros_like, y)
        force = scene.applied_force(q, v, t)
        if force is not None:
            by_force = {name: y[name] for name in y if name not in ("work", *added)}
            _, pushed = jax.jvp(lambda f: method.rates(scene, by_force, q, v, t, f), (jnp.zeros_like(v),), (force,))
            rates = rates | pushed
        return rates | {"q": velocity_to_rate(scene.system, q, v)}

    def project(t, y, error, args):
        scene, _, method = given(args)
        y, error = method.stepped(scene, y, t, error)
        # A step that will be rejected may be too long to be projected, so failing here does not end the run.
        y = method.continued(scene, y, t)
        if controls.HELD in y:
            y = y | {controls.HELD: controls.sampled(given(args)[1], y[controls.HELD], *method.place(scene, y, t), t)}
        return y, error, diffrax.RESULTS.successful

    def quality(t, y, args, **_):
        scene, _, method = given(args)
        return method.quality(scene, y, t)

    def begin(t, y, args):
        scene, _, method = given(args)
        return method.begin(scene, y, t)

    def allowances(args, y, q, v, t):
        """How far the contacts are from being lost."""
        scene, _, method = given(args)
        return unilateral.allowances(scene, method.multipliers(scene, q, v, t, effort(args, y, q, v, t)))

    @jax.jit
    def least_allowance(t, y, args):
        scene, _, method = given(args)
        q, v = method.place(scene, y, t)
        return jnp.min(allowances(args, y, q, v, t))

    @jax.jit
    def advance(t0, t1, y, args, carried):
        scene, _, method = given(args)
        return method.advance(scene, y, t0, t1, carried, functools.partial(effort, args, y))

    if isinstance(options["solver"], Stepper):
        options = options | {"solver": Stepper(begin, advance, functools.partial(displace, system))}
    q0 = retract(system, q0)
    in_order = jnp.isfinite(ts).all() & (ts[1:] > ts[:-1]).all()
    given_times, ts = ts, jnp.where(in_order, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    finite_start = jnp.isfinite(q0).all() & jnp.isfinite(v0).all()
    steps, fine_steps, fine_tolerances = usable_steps(steps, ts)
    good = finite_start & in_order & fine_steps & fine_tolerances
    # A bad lane of a batch takes a harmless start, so that it does not make the others wait.
    harmless = neutral(system).astype(q0.dtype) if isinstance(system, Model) else jnp.zeros_like(q0)
    q0, v0 = jnp.where(good, q0, harmless), jnp.where(good, v0, jnp.zeros_like(v0))
    held = jnp.asarray(True)
    if scene.constraints:
        held = consistent(scene, q0, v0, ts[0])
        if method.projects:
            given_start = q0, v0
            q0, v0 = method.onto_constraints(scene, q0, v0, ts[0])
            # Residuals of a small mechanism are small numbers of metres: how far it moves onto the constraints tells more.
            ways = [
                jnp.max(jnp.abs(x - y)) / (1 + jnp.max(jnp.abs(x))) for x, y in zip(given_start, (q0, v0), strict=True)
            ]
            held = held & (jnp.maximum(*ways) <= 10 * start_limit(q0.dtype))
    # Refuses callbacks that do not fit before diffrax meets them.
    for i, force in enumerate(scene.forces):
        check_callback(force, f"forces[{i}]", "force(system, q, v, t)", q0, v0, ts[0], first=(system,))
    controls.check_control(scene, control, q0, v0, ts[0])
    states = controls.started(control, q0, v0, ts[0])
    added = tuple(states)  # names alone, as the functions above hold no arrays
    eqx.filter_eval_shape(effort, args, states, q0, v0, ts[0])
    y0 = method.start(scene, q0, v0, ts[0]) | states
    first = method.quality(scene, y0, ts[0])
    y0 = y0 | {"work": jnp.zeros((), q0.dtype)} if "work" in outputs else y0
    solver = options["solver"]
    if isinstance(solver, LieGroup):
        solver = solver.fitted(system)
    # Of what a projection does, local coordinates leave nothing to be done about quaternions.
    corrects = method.projects or bool(method.jumping) if isinstance(solver, LieGroup) else method.corrects(scene)
    corrects = corrects or controls.HELD in added
    term = diffrax.ODETerm(derivative)
    if is_split(solver):
        term = diffrax.MultiTerm(diffrax.ODETerm(explicit_part), diffrax.ODETerm(implicit_part))
    options = options | {"solver": solver}
    corrector = project if corrects else None
    watched = least_allowance if unilateral.can_end(scene, options["contacts"]) else None
    rows, result, counts, time_reached, last = _integrate(
        term, corrector, quality, watched, method, y0, ts, args, steps, options
    )

    y = jax.tree.map(lambda start, later: jnp.concatenate([start[None], later]), y0, rows)
    finite = [jnp.isfinite(rows).reshape(ts.shape[0], -1).all(1) for rows in y.values()]
    reached = good & jnp.stack(finite).all(0)
    y = jax.tree.map(lambda rows, start: jnp.where(_along(reached, rows), rows, start[None]), y, y0)
    work = y.pop("work", None)

    def place(row):
        y, t = row
        return method.place(scene, method.corrected(scene, y, t), t)

    # One after the other, by the kernels that have put the start on the constraints.
    q, v = lax.map(place, (y, ts))
    lost = None
    if watched:
        margins, within = lax.map(lambda row: allowances(args, *row), (y, q, v, ts)), None
        if last is not None:
            there = allowances(args, last, *method.place(scene, last, time_reached), time_reached)
            within = (result == RESULTS.event_occurred, time_reached, there)
        lost = unilateral.first_loss(margins, reached, ts, within)
        reached = reached & ~(lost.happened & (ts > lost.time))
        time_reached = jnp.where(lost.happened, lost.time, time_reached)
        result = RESULTS.where(lost.happened, RESULTS.contact_lost, result)
    result = RESULTS.where(result == RESULTS.event_occurred, RESULTS.singular_basis, result)
    ended = (result == RESULTS.successful) | (result == RESULTS.coarse_steps)
    result = RESULTS.where(ended & ~reached.all(), RESULTS.nonfinite_state, result)
    # Fixed steps go on from what is not finite: all that is known is the last state before it that was kept.
    kept = jnp.max(jnp.where(reached, ts, ts[0]))
    time_reached = jnp.where(result == RESULTS.nonfinite_state, kept, time_reached)
    if method.projects and scene.constraints:
        closed = lax.map(lambda row: consistent(scene, *row), (q, v, ts))
        result = RESULTS.where((result == RESULTS.successful) & ~closed.all(), RESULTS.open_constraints, result)
    elif scene.constraints:
        met = lax.map(lambda row: method.satisfies(scene, *row[1:], effort(args, *row)), (y, q, v, ts))  # pyright: ignore[reportCallIssue]
        result = RESULTS.where((result == RESULTS.successful) & ~met.all(), RESULTS.contradictory_rows, result)
    if first is not None:
        result = RESULTS.where(serves(first), result, RESULTS.singular_basis)
    result = RESULTS.where(held, result, RESULTS.inconsistent_start)
    angles = turning(system)
    if angles.size and not is_fixed(steps[-1]):
        coarse = jnp.max(jnp.abs(q0[angles])) > most_turned(q0.dtype)
        result = RESULTS.where(coarse, RESULTS.coarse_start, result)
    for fine, code in (
        (finite_start, RESULTS.nonfinite_start),
        (fine_tolerances, RESULTS.bad_tolerance),
        (fine_steps, RESULTS.bad_stepsize),
        (in_order, RESULTS.unordered_times),
    ):
        result = RESULTS.where(fine, result, code)

    def report(q, v, t, of_control):
        values = {}
        pushed = {"power", "acceleration", "multipliers", *unilateral.OUTPUTS} & set(outputs)
        force = effort(args, of_control, q, v, t) if pushed else None
        if "energy" in outputs:
            values["energy"] = kinetic_energy(system, q, v, t) + potential_energy(system, q, t)
        if "power" in outputs:
            values["power"] = power(force, v)
        if "acceleration" in outputs:
            values["acceleration"] = method.acceleration(scene, q, v, t, force)
        if {"multipliers", *unilateral.OUTPUTS} & set(outputs):
            multipliers = method.multipliers(scene, q, v, t, force)
            values |= {"multipliers": multipliers} if "multipliers" in outputs else {}
            values |= unilateral.reported(scene, multipliers, outputs)
        if "constraint_residual" in outputs:
            values["constraint_residual"] = residuals(scene, q, v, t)
        if "torque" in outputs:
            tau = torque(args, of_control, q, v, t)
            values["torque"] = jnp.zeros_like(v) if tau is None else tau
        if "control_state" in outputs:
            values["control_state"] = controls.state_of(control, of_control, q, v, t)
        frames = [name.removeprefix(_POSE) for name in outputs if name.startswith(_POSE)]
        return values | {"poses": {frame: frame_pose(system, q, frame) for frame in frames}}

    def or_nan(rows):
        return jnp.where(_along(reached, rows), rows, jnp.full_like(rows, jnp.nan))

    rows = (
        {"q": q, "v": v}
        | jax.vmap(report)(q, v, ts, {name: y[name] for name in added})
        | ({} if work is None else {"work": work})
    )
    whole = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(rows)]).all()
    result = RESULTS.where((result == RESULTS.successful) & ~whole, RESULTS.nonfinite_state, result)
    stats = {name: jnp.asarray(counts[name], jnp.int32) for name in COUNTS}
    stats["time_reached"] = jnp.where(good, time_reached, ts[0])
    if lost is not None:
        stats["lost_contact"] = lost.contact
    return Solution(ts=given_times, result=result, stats=stats, solver=label(solver), **jax.tree.map(or_nan, rows))


def _integrate(term, project, quality, allowance, method, y0, ts, args, steps, options):
    """Rows of the state at ts[1:], how it ended, counts, the time it came to, and the state there if an event may end it."""
    adjoint = options["adjoint"]
    solver: Any
    solver, controller, dt0 = stepping(options["solver"], term, ts, *steps)
    continuous = isinstance(adjoint, diffrax.BacksolveAdjoint)  # which integrates another vector field
    # Of a method that wraps an explicit one, diffrax says that it is one.
    explicit = isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.AbstractWrappedSolver)
    jumping = (*method.jumping, *({controls.HELD} & set(y0)))
    if explicit and not continuous:
        solver = ExplicitSteps(solver, project, jumping, method.projects, field=term.vector_field)
    elif project:
        solver = ProjectedSolver(solver, project, jumping, method.projects)
    if continuous and isinstance(controller, Watched):
        controller = diffrax.ConstantStepSize()  # backwards the state is another one
    event = None
    # Near a singular basis steps become short; a long one may pass it, which the sign shows.
    watched = isinstance(method, Reduced) and not continuous
    basis = (lambda t, y, args, **_: _signed(quality(t, y, args))) if watched else None
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
    if explicit and not continuous and not allowance and _is_driven(controller, adjoint, options):
        stepper: Any = solver
        plan = stepper.plan(y0)
        if watched:
            plan = plan._replace(quality=lambda t, y, args: _signed(quality(t, y, args)))
        rows, facts, sums = _drive(plan, stepper, controller, steps, options)(y0, args, ts)
    elif is_fixed(steps[-1]):
        rows, facts, solved = run((y0, args, ts), **how)
        sums = solved.controller_state[2:] if isinstance(controller, Watched) else None
    else:
        rows, facts = run_adaptively((y0, args, ts), how, options["limit_is_given"])
    result, stats, reached, *last = facts
    result = from_diffrax(result)
    if is_fixed(steps[-1]):
        if sums is not None:
            coarse = (result == RESULTS.successful) & too_coarse(sums)
            result = RESULTS.where(coarse, RESULTS.coarse_steps, result)
        # diffrax is at the end of the step that could not be solved; what is known ends where it began.
        began = ts[0] + (stats["num_steps"].astype(ts.dtype) - 1) * steps[-1]
        reached = jnp.where(result == RESULTS.nonlinear_divergence, began, reached)
    return rows, result, stats, reached, last[0] if last else None


def _is_driven(controller, adjoint, options) -> bool:
    """Whether steps are made by a loop of our own: explicit ones, of a control that we know, with nothing shown on the way."""
    known = type(controller) in (Adaptive, Watched)
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
    """The quality of a basis, of which a change of sign ends the run: zero where it no longer serves."""
    return jnp.where(serves(quality), quality, jnp.zeros_like(quality))


def _along(mask, rows):
    """The mask (nt,) shaped so that it applies to the rows (nt, ...)."""
    return mask.reshape(-1, *[1] * (rows.ndim - 1))


def _checked_outputs(scene: Scene, outputs) -> tuple[str, ...]:
    if isinstance(outputs, str):
        raise ValueError(f"outputs is the string {outputs!r}; pass a tuple, e.g. outputs=({outputs!r},)")
    for name in outputs:
        if isinstance(name, str) and name.startswith(_POSE) and isinstance(scene.system, Model):
            frame_index(scene.system, name.removeprefix(_POSE))
        elif name not in _OUTPUTS:
            raise ValueError(f"outputs has {name!r}; choose from {', '.join(_OUTPUTS)} and '{_POSE}<frame>'")
    return tuple(sorted(set(outputs)))
