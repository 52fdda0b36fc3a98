"""Single steps for learning: the steps of `simulate` with a fixed length, as a function of state and torque."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxdyn.compile import is_standalone
from jaxdyn.compile.known import is_concrete, partition_tracers
from jaxdyn.constraints.redundancy import keep_rows
from jaxdyn.constraints.selection import hide_unclear, select_rows
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.forces.piecewise import fix_pieces, guards, pieces_of, values_and_levels
from jaxdyn.model.arguments import Numbers, as_array, check_flag, check_shape, state_dtype
from jaxdyn.simulation.checks import choose_method
from jaxdyn.simulation.contact_problem import contacts_of
from jaxdyn.simulation.contact_steps import ContactStep, contact_step, mean_of_steps
from jaxdyn.simulation.equations import DRIVES
from jaxdyn.simulation.hybrid import PiecewiseSystem, piecewise_motion
from jaxdyn.simulation.methods import may_have_redundant_rows
from jaxdyn.simulation.solvers import LibrarySteps
from jaxdyn.simulation.solvers.diffrax_methods import RK4
from jaxdyn.simulation.solvers.driver import LibraryRun, step_control
from jaxdyn.simulation.solvers.steps import take_step
from jaxdyn.systems.scene import Scene, as_scene, check_force
from jaxdyn.systems.system import SceneLike

EVENTS = 8  # at most in a step: a force that changes its piece more often leaves the step without derivatives
ADJOINTS = ("reverse", "forward", "direct")


def stepper(
    scene: SceneLike,
    dt: Numbers,
    substeps: int = 1,
    remat: bool = True,
    adjoint: str = "reverse",
    *,
    limits: str | None = None,
    smoothing: Numbers = 0.0,
    report: bool = False,
) -> Callable:
    """Function step(state, tau, t=0.0) -> state that advances a scene by dt under a constant tau, or under a law.

    The state is a pair (q (nq,), v (nv,)), or (q, v, z) of a scene with `jd.forces.DriveDynamics`, whose states z start as
    `scene.drive_state(q, v)`; batch it with `jax.vmap`, and repeat it with `jax.lax.scan`. The
    torques tau (nv,) are numbers, or a law tau(q, v, t) -> (nv,), called once at the start of the step. The
    steps are those of `jd.simulate` with `stepsize=dt/substeps`: RK4, constraints closed at the end of each, the scene's
    forces applied (friction, stops, drives), and tau through its drives and `jd.forces.EffortLimits`. Where a joint meets a stop
    (`jd.forces.JointStops`, any `jd.forces.PiecewiseForce`) a step ends, and the next one ends where it would have ended.

    Scenes with contacts (`jd.contact.UnilateralContact`), and `limits="hold"`, have steps of their own: time stepping, in which
    the velocity after a step satisfies Coulomb's law with the round cone, the constraints and the limits at once. Impacts need no
    events. They are of order two while no contact closes, else of order one; derivatives are those of the solved equations, of
    both modes. See docs/simulation.md.

    **Arguments:**

    - `scene`: a `Scene` or `Model`. `jd.contact.DryFriction` has steps of the same kind.
    - `dt`: length of a step, s; `substeps`: integration steps in it.
    - `remat`: if True, reverse mode keeps no more of a step than its state and tau, and computes the rest again. With several
      substeps that costs a step. A run of n steps then keeps 8 (nq + 2 nv) n bytes a sample in float64; with a law as tau,
      which is computed again too, 8 (nq + nv) n bytes and no intermediates of the law.
    - `adjoint`: "reverse" (default), for `jax.grad`, `jax.jacrev` and, over them, `jax.hessian`; "forward" or "direct", for
      forward mode too (`jax.jvp`, `jax.jacfwd`), in which reverse mode takes longer. Forward mode of "reverse" raises an error.
    - `limits`: "hold" for the model's joint limits as contacts without friction; None to ignore them.
    - `smoothing`: kappa in J, for learning: normal force times gap of a contact at rest is kappa instead of zero, so that
      contacts that are open have derivatives. Zero by default, for Coulomb's law. Positive, it may be differentiated by.
    - `report`: if True, a step returns (state, `ContactStep`), with a result code, and of a scene with contacts with forces in N
      by name and those of limits. The code is `coarse_steps` where the state after the step may be wrong by more than a tenth of
      its change in it; steps through contacts have no such estimate. A step whose contacts were not solved has the code
      `no_contact_impulses`; with and without a report its state and derivatives are NaN.

    **Raises:** ValueError for a dt that is not positive, substeps that are no count, another adjoint, dry friction
    with smoothing, unknown limits, negative smoothing; (when called) for shapes that do not fit.

    ```python
    step = jd.stepper(robot, dt=0.01, substeps=2)
    q, v = step((q, v), tau)
    q, v = step((q, v), lambda q, v, t: -gain @ q)
    ```
    """
    scene = as_scene(scene)
    system, dtype = scene.system, state_dtype(scene.system)
    by_contacts = limits is not None or has_modes(scene)
    seconds = _check_options(dt, substeps, adjoint, smoothing, by_contacts)
    report = check_flag(report, "stepper: report")
    # In numpy a known length stays known inside a jit, where jax would trace it.
    length = np.asarray(seconds, dtype) if is_concrete(seconds) else jnp.asarray(seconds, dtype)
    if by_contacts:
        q, v = (jnp.zeros((n,), dtype) for n in (scene.nq, scene.nv))
        start, advance = scene.drive_state(q, v), _advance_contacts(scene, length, substeps, limits, smoothing, report)
    else:
        start, advance = _advance(scene, length, substeps, adjoint != "reverse", report)
    by_numbers = jax.checkpoint(advance) if check_flag(remat, "stepper: remat") else advance

    def step(state, tau, t: Any = 0.0):
        if report and not by_contacts and is_standalone():
            raise ValueError("stepper: exported steps have no report; leave report out")
        if len(state) != (2 if start is None else 3):
            names = "(q, v)" if start is None else "(q, v, z) with z = scene.drive_state(q, v) at the start"
            raise ValueError(f"stepper: the state has {len(state)} entries, expected {names}")
        q, v, *z = (jnp.asarray(as_array(x, name), dtype) for x, name in zip(state, ("q", "v", "z"), strict=False))
        for name, value in (("q", q), ("v", v)):
            check_shape(system, name, value)
        if start is not None and z[0].shape != start.shape:
            raise ValueError(f"z has shape {z[0].shape}, expected {start.shape} as of scene.drive_state(q, v)")
        t = jnp.asarray(t, dtype)
        if not callable(tau):
            return by_numbers(q, v, check_force(jnp.asarray(as_array(tau, "tau"), dtype), q, scene.nv, "tau"), t, *z)

        def by_law(q, v, t, *z):
            return advance(q, v, check_force(jnp.asarray(tau(q, v, t), dtype), q, scene.nv, "tau"), t, *z)

        return (jax.checkpoint(by_law) if remat else by_law)(q, v, t, *z)

    return step


def _check_options(dt, substeps, adjoint, smoothing, by_contacts: bool):
    """Length of the step, s; ValueError for options that do not fit."""
    seconds = as_array(dt, "stepper: dt")
    if seconds.shape != () or (is_concrete(seconds) and not 0 < float(seconds) < np.inf):
        raise ValueError(f"stepper: dt is {dt!r}; give one positive number (s)")
    if isinstance(substeps, bool) or not isinstance(substeps, (int, np.integer)) or substeps < 1:
        raise ValueError(f"stepper: substeps is {substeps!r}; give a positive integer")
    if adjoint not in ADJOINTS:
        raise ValueError(f"stepper: adjoint is {adjoint!r}; choose one of {', '.join(ADJOINTS)}")
    energy = as_array(smoothing, "stepper: smoothing")
    if energy.shape != () or (is_concrete(energy) and not 0 <= float(energy) < np.inf):
        raise ValueError(f"stepper: smoothing is {smoothing!r}; give one energy (J), zero or more")
    if not by_contacts and is_concrete(energy) and float(energy) > 0:
        raise ValueError("stepper: smoothing is for scenes with contacts, and this one has none; leave it out")
    return seconds


def _advance(scene: Scene, length, substeps: int, is_direct: bool, report: bool) -> tuple[Any, Callable]:
    """States of the scene's drives or None, and a function (q, v, tau, t, *z) of a step under a constant tau.

    It returns (q, v, *z), or ((q, v, *z), ContactStep) with `report`.
    """
    selects_rows = bool(scene.constraints) and may_have_redundant_rows(scene)
    method, dtype = choose_method(scene, "auto"), state_dtype(scene.system)
    unknown, known = partition_tracers(scene)

    # Time of the integration begins at zero in each step: the length of steps and their number are the same at any t, which
    # rounding of t + dt would change.
    def unpack(since, args):
        """Scene with its independent rows, with forces fixed to a piece where flags ask for it, time, and tau."""
        unknown, tau, begin, selection, *positive = args
        scene = known(unknown)
        scene = scene if selection is None else keep_rows(scene, selection)
        return fix_pieces(scene, pieces, *positive) if positive else scene, begin + since, tau

    @jax.jit
    def field(since, y, args):
        scene, t, tau = unpack(since, args)
        q, v, in_basis = method.to_qv_and_basis(scene, y, t)
        force, (torque, of_drives) = scene.applied_force(q, v, t), scene.drive_torque(q, v, t, tau, y.get(DRIVES))
        force = torque if force is None else torque + force
        rates = method.rates(scene, y, q, v, t, force, in_basis)
        return rates if of_drives is None else rates | {DRIVES: of_drives}

    def project(since, y, error, args):
        scene, t, _ = unpack(since, args)
        y, error, _ = method.end_step(scene, y, t, error)
        return y, y, error

    def switching(since, y, args):
        scene, t, tau = unpack(since, args)
        state = (*method.to_qv(scene, y, t), *(y[name] for name in of_drives))
        return values_and_levels(lambda q, v, *own: guards(scene, q, v, t, tau if limits_vary else None, *own), *state)

    corrector = project if method.corrects(scene) else None
    solver = LibrarySteps(RK4(), corrector, method.step_constants, method.projects, field=field)
    q, v = (jnp.zeros((n,), dtype) for n in (scene.nq, scene.nv))
    start = scene.drive_state(q, v)
    of_drives = () if start is None else (DRIVES,)
    # tau is constant in a step, and so is where it is cut off, unless drives or limits of the speed are in between.
    limits_vary = bool(of_drives) or any(getattr(force, "of_speed", False) for force in scene.forces)
    tau_of = (lambda _, q, v, t: (v, scene.drive_state(q, v, t))) if limits_vary else None
    pieces = pieces_of(scene, (), q, v, jnp.zeros((), dtype), tau_of)

    def state_of(y, t):
        return *method.to_qv(scene, y, t), *(y[name] for name in of_drives)

    def advance(q, v, tau, t, *z):
        y = method.start(scene, q, v, t) | dict(zip(of_drives, z, strict=True))
        # Once, at the start on the constraints: between the stages of a step the rank would change.
        selection = hide_unclear(select_rows(known(unknown), q, t, None)) if selects_rows else None
        plan, args, size = solver.plan(y), (unknown, tau, t, selection), length / substeps
        ts = jnp.stack([jnp.zeros_like(t), jnp.asarray(length, t.dtype)])
        if pieces.names:
            if is_standalone():
                raise ValueError(
                    f"stepper: its steps end at the kinks of {', '.join(pieces.names)}, found by loops that exported code does "
                    "not have; leave these forces out of the exported scene, and clip the torques before the step"
                )
            system = PiecewiseSystem(plan, pieces, switching)
            rows, end = piecewise_motion(system, y, args, ts, 0.0, 0.0, size, substeps, substeps + 1, EVENTS, is_direct)
            result = end.result
        elif is_standalone():
            # A scalar program has no loop over steps; they are written one after the other.
            flat = ravel_pytree(y)[0]
            for i in range(substeps):
                start, end = (jnp.asarray(k * size, t.dtype) for k in (i, i + 1))
                flat = take_step(plan, args, start, end, flat, plan.first_rate(args, start, flat)).projected
            return state_of(plan.structure(flat), t + length)
        else:
            run = LibraryRun(plan, step_control(solver, size), None, None, size, substeps, room=substeps)
            rows, (result, *_) = (run.direct if is_direct else run)(y, args, ts)
        state = state_of(jax.tree.map(lambda x: x[0], rows), t + length)
        none: Any = {"forces": {}, "limit_forces": jnp.zeros_like(v), "residual": jnp.zeros((), v.dtype)}
        return (state, ContactStep(result=result, **none)) if report else state

    return start, advance


def _advance_contacts(scene: Scene, length, substeps: int, limits, smoothing, report: bool) -> Callable:
    """Function (q, v, tau, t, *z) -> (q, v, *z), or ((q, v, *z), ContactStep) with `report`, of a step with contacts."""
    contacts = contacts_of(scene, limits)
    selects_rows = bool(scene.constraints) and may_have_redundant_rows(scene)
    bare = scene.without_forces

    def advance(q, v, tau, t, *z):
        whole, size = scene, length / np.asarray(substeps, length.dtype)
        if selects_rows:
            whole = keep_rows(scene, hide_unclear(select_rows(bare, q, t, None)))
        # Known numbers stay numpy's: an array of JAX would be an argument more of the program around the step.
        energy = np.asarray(smoothing, q.dtype) if is_concrete(smoothing) else jnp.asarray(smoothing, q.dtype)

        start: Any = (q, v, *z) if z else (q, v, jnp.zeros((0,), q.dtype))

        def once(state: Any, i):
            q, v, z = state
            return contact_step(contacts, whole, q, v, z, tau, t + i * size, size, energy)

        if substeps == 1:
            state, of_step = once(start, 0)
        else:
            state, of_steps = jax.lax.scan(once, start, jnp.arange(substeps, dtype=q.dtype))
            of_step = mean_of_steps(of_steps)
        state = state if z else state[:2]
        return (state, of_step) if report else state

    return advance
