"""Simulation: `simulate` integrates a scene with any diffrax method, and reports a failure by a code or an error.

The state is (q, v) with dq/dt = H(q) v and dv/dt from the dynamics. Quaternions in q are integrated as four numbers and
normalised at the end of every step (`ProjectedSolver`), which keeps the order of the method. A model without quaternions has
no such projection.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import as_constant, as_numpy_if_known, is_concrete, is_known, is_tracing, keep_known, once
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.model.arguments import Numbers, as_array, check_flag, state_dtype, warn
from jaxdyn.simulation import checks, controls
from jaxdyn.simulation.checks import check_constraints, choose_method, may_have_singular_mass
from jaxdyn.simulation.controls import Control
from jaxdyn.simulation.events import Event, Watch, check_events, check_terminals, events_of, report_limits, sort_events
from jaxdyn.simulation.methods import Method, may_have_redundant_rows
from jaxdyn.simulation.options import (
    ADJOINTS,
    FORMER_STEPS,
    POSE,
    Adjoint,
    Options,
    Pose,
    Solver,
    Steps,
    Stepsize,
    as_output,
    check_step_length,
    check_tolerance,
    is_backsolve,
    is_step_length,
    pack_steps,
    step_limit,
)
from jaxdyn.simulation.solution import Solution, raise_failure
from jaxdyn.systems.scene import Scene, as_scene, is_given
from jaxdyn.systems.system import SceneLike, System, has_dependent_coordinates

F = TypeVar("F", bound=Callable)
_FORMER_EVENTS = {"contacts", "limits", "max_events", "progress"}


def _accept_former_arguments(function: F) -> F:
    """Decorator of `simulate`: forms of the release before warn, with the new form."""

    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        if not _FORMER_EVENTS.isdisjoint(options):
            given = {name: options.pop(name) for name in sorted(_FORMER_EVENTS & set(options))}
            former = events_of(**given)
            options["events"] = [*options.get("events", ()), *former]
            _warn(given, "events", f"[{', '.join(f'jd.events.{one!r}' for one in former)}]")
        if not FORMER_STEPS.isdisjoint(options):
            given = {name: options[name] for name in sorted(FORMER_STEPS & set(options))}
            size = [] if options.get("stepsize") is None else ["stepsize"]
            options = pack_steps(options)
            _warn(given, "stepsize", f"jd.simulation.Steps({', '.join([*size, *(f'{name}=...' for name in given)])})")
        outputs = options.get("outputs", ())
        if not isinstance(outputs, str) and any(isinstance(x, str) and x.startswith(POSE) for x in outputs):
            options["outputs"] = tuple(map(as_output, outputs))
            given = {"outputs": tuple(x for x in outputs if x not in options["outputs"])}
            _warn(given, "outputs", f"({', '.join(f'jd.simulation.{as_output(x)!r}' for x in given['outputs'])},)")
        return function(*args, **options)

    return cast(F, call)


def _warn(given: dict[str, Any], name: str, new: str) -> None:
    old = ", ".join(f"{name}={value!r}" for name, value in given.items())
    warn(f"simulate({old}) is now simulate({name}={new})", DeprecationWarning)


@_accept_former_arguments
def simulate(
    scene: SceneLike,
    q0: Numbers,
    v0: Numbers,
    ts: Numbers,
    *,
    control: Control = None,
    method: str | Method = "auto",
    solver: Solver = None,
    stepsize: Stepsize | Steps = None,
    adjoint: Adjoint = None,
    outputs: Sequence[str | Pose] = (),
    events: Sequence[Event] = (),
    throw: bool | None = None,
) -> Solution:
    r"""Integrate the equations of motion from (q0, v0) and save the motion at the times `ts`.

    $$M a + C v + N = \tau + \tau_\mathrm{forces} + A^T \lambda, \quad \dot q = H(q) v$$

    One sample; batch states, controls and the scene's leaves with `jax.vmap`. Computed in the dtype of the model.
    Called outside of `jax.jit` it compiles once for all scenes of a shape, whose numbers are inputs of the program. Inside your
    own `jax.jit`, the numbers of a model that is closed over are known to the compiler; those of an argument may change.

    **Arguments:**

    - `scene`: a `Scene`, or a `Model` to which no forces apply.
    - `q0` (nq,), `v0` (nv,): state at `ts[0]`. Quaternions up to 0.1 % from unit length are normalised.
    - `ts` (nt,): strictly increasing times (s), nt >= 2; the first is the start.
    - `control(q, v, t) -> (nv,)`: tau (N m or N); q comes with unit quaternions. An equinox Module or a
      `jax.tree_util.Partial` carries leaves that can be differentiated and batched; a plain function is static: define
      it once. A `jd.Controller` has a state of its own, integrated with the motion, and receives the multipliers; a
      `jd.Sampled` law is called once a period, and its torque is held.
    - `method`: the form of the equations. "auto", the default, is "free" without constraints and "projected" with them.

        - "free": no constraints.
        - "projected": accelerations with multipliers, and q and v projected onto the constraints after every step and at save
          points, by the least change in the mass metric. It handles redundant rows and rank loss.
        - "multipliers": the same without the projection, so that the constraints open as the local errors add up.
        - "reduced": minimal velocities are integrated, and q by v = N nu + v0; `jd.Reduced(basis)` chooses them.
        - "variational": steps of fixed length that keep the energy over long times, with a solver of their own; with or
          without constraints.
        - "baumgarte": feedback of violated constraints, for comparison, with the rates `jd.simulation.Baumgarte(alpha, beta)`.
    - `solver`: any diffrax method of an `ODETerm`, `jd.solvers.Rodas5P()`, `jd.solvers.LieGroup(...)` of one of them, or a
      method that takes an implicit and an explicit part (`diffrax.KenCarp4`): implicit are dq/dt = H v and the share of
      the scene's forces in the acceleration, explicit all the rest (inertia, gravity, `control`). Default: `RK4` for fixed steps;
      for adaptive ones `Dopri8`, or `Rodas5P` where the scene lists forces, all inputs are concrete and `jd.stiffness` at
      the start says that explicit steps would have to be shorter than a thousandth of the time.
    - `stepsize`: None for adaptive steps with tolerances of 1e-8, a number (s) for fixed ones, the last one as short as
      the run asks for, a diffrax step-size controller, or `jd.simulation.Steps(size, rtol, atol, max_steps)`, which sets
      tolerances and limits too.
    - `adjoint`: how derivatives are computed.

        - "reverse" (default): reverse mode with checkpoints, and Hessians over it.
        - "forward": `jax.jvp`, `jax.jacfwd`, and Hessians by forward over forward mode.
        - "direct": both modes, at a cost that grows with `Steps.max_steps`.
        - "backsolve": the continuous adjoint, whose gradients are approximate, of runs that no event can end.
        - a diffrax adjoint: diffrax makes the steps.
    - `outputs`: any of "energy", "power", "work" (one more state, under the same error control), "acceleration" (the rate
      of v: of a free joint that of its body twist; `jd.dynamics.frame_acceleration` gives those of frames in world axes),
      "multipliers", "constraint_residual", "contact_forces" (N, by the names of contacts: two components of friction, then
      the normal force), "contact_margins", "torque" (of the control, behind drives and limits), "control_state" (of a
      controller), "drive_state" (of drives), and `jd.simulation.Pose(frame)`. They are computed only if asked for.
    - `events`: objects of `jd.events`, each kind at most once: `ContactLost` (of a scene with `cones`, whose contacts end the run
      where they are lost unless `ContactLost(stop=False)` is listed), `JointLimit` (without it limits are ignored),
      `ModeSwitches(max_events)` (of forces with modes or pieces), and any number of `Terminal(function)`, which end the run where
      a function of the state falls below zero; `Progress()` shows a meter. Scenes with forces that have modes
      (`jd.contact.DryFriction`, `jd.contact.UnilateralContact`) take explicit methods with adaptive or fixed steps, which end at
      events.
    - `throw`: raise when the integration fails. Default: yes if all inputs are concrete, else see `Solution.result`.

    **Returns:** a `Solution`. Save points between steps come from the method's dense output. Where that is less
    accurate than the steps (Kvaerno5), adaptive steps end on every save point.

    **Raises:** ValueError for wrong shapes, NaN, times that do not increase, quaternions far from unit length, angles of
    too many turns for the dtype, a start off the constraints or without a motion (a singular mass matrix of a
    `System`), constraints that remove all degrees of freedom, unknown options and those without effect, with names and values.
    RuntimeError with the time reached, the cause and the fix, if it fails and `throw`.

    ```python
    solution = jd.simulate(model, q0, v0, jnp.linspace(0.0, 1.0, 101), outputs=("energy",))
    ```
    """
    scene, control = as_scene(scene), controls.as_control(control)
    watch, terminals = sort_events(events)
    rtol = atol = max_steps = None
    if isinstance(stepsize, Steps):
        stepsize, rtol, atol, max_steps = stepsize.size, stepsize.rtol, stepsize.atol, stepsize.max_steps
    arrays, stepsize = _check_numbers(scene, q0, v0, ts, rtol, atol, stepsize)
    method, modal = choose_method(scene, method), has_modes(scene)
    concrete = is_known(scene, control, method, arrays, stepsize, terminals)
    start = tuple([np.asarray(x) if concrete else as_numpy_if_known(x) for x in arrays[:3]])
    scene, method = _prepare_start(scene, method, start, stepsize, modal, concrete)
    dtype, has_length = state_dtype(scene.system), is_step_length(stepsize)
    length = controls.fit_steps(control, stepsize)
    check_terminals(terminals, modal, (start[0], start[1], start[2][0]) if concrete else None)
    solver = _solver_at_start(scene, control, solver, stepsize, adjoint, arrays, modal)
    options = _choose(
        scene, control, method, solver, stepsize, adjoint,
        outputs=checks.sort_outputs(scene, outputs), watch=watch, tolerances=(rtol is not None, atol is not None), modal=modal,
    )  # fmt: skip
    options = options._replace(
        terminals=terminals,
        max_steps=step_limit(max_steps, start[-1], stepsize, options.adjoint),
        limit_is_given=max_steps is not None,
        # Because the start is traced, the independent rows have to be selected during the run.
        selects_rows=not (concrete or not scene.constraints or is_concrete((scene, method, start)))
        and (method.rank_tol is not None or may_have_redundant_rows(scene)),
    )
    # Known numbers go to the compiled program as they are: each array of JAX made before would be a transfer of its own.
    to_array = np.asarray if concrete and not modal else jnp.asarray
    numbers: list[Any] = [x if isinstance(x, jax.Array) and x.dtype == dtype else to_array(x, dtype) for x in arrays]
    numbers.append(to_array(length, dtype) if has_length else stepsize)
    if modal:
        solution = hybrid_motion(scene, control, numbers, options)
    else:
        # A large scene is a constant of the program: its zeros are known, and most of it is zeros.
        whole = as_constant(scene) if not is_tracing() and is_concrete(scene) and not is_given(scene) else scene
        solution = smooth_motion(whole, control, method, numbers, options)
    if watch.limits is not None and not watch.limits.stop:
        solution = report_limits(scene, solution, concrete)
    throw = concrete if throw is None else check_flag(throw, "throw")
    if throw and concrete:
        raise_failure(solution, scene, control, options)
    return solution.result.error_if(solution, ~solution.success) if throw and not concrete else solution


@entry_point
def smooth_motion(*args) -> Solution:
    """A run without modes; what makes its program is imported where it is not on disk."""
    from jaxdyn.simulation.motion import smooth_motion

    return smooth_motion(*args)


@entry_point
def hybrid_motion(*args) -> Solution:
    """A run with modes."""
    from jaxdyn.simulation.hybrid import hybrid_motion

    return hybrid_motion(*args)


def _check_numbers(scene: Scene, q0, v0, ts, rtol, atol, stepsize) -> tuple:
    """Start, times and tolerances as arrays, and the length of steps or its controller, refused if they do not fit."""
    q0, v0, ts = as_array(q0, "q0"), as_array(v0, "v0"), as_array(ts, "ts")
    checks.check_start(scene, as_numpy_if_known(q0), as_numpy_if_known(v0))
    checks.check_times(as_numpy_if_known(ts))
    tolerances = []
    for name, value in (("rtol", rtol), ("atol", atol)):
        tolerances.append(_DEFAULT_TOLERANCE if value is None else as_array(value, name))
        if value is not None:
            check_tolerance(name, tolerances[-1])
    return (q0, v0, ts, *tolerances), as_array(stepsize, "stepsize") if is_step_length(stepsize) else stepsize


_DEFAULT_TOLERANCE = np.asarray(1e-8)


def _prepare_start(scene: Scene, method: Method, start, stepsize, modal: bool, concrete: bool) -> tuple[Scene, Method]:
    """Check a concrete start by the rules of the system and of the constraints, and drop redundant rows."""
    q0, v0, ts = start

    def check_system():
        with keep_known():
            scene.system.check_start(*(jnp.asarray(x, state_dtype(scene.system)) for x in (q0, v0, ts[0])))

    is_readable = concrete or is_concrete((scene, start))
    # Places of contacts come first, because the constraints depend on them.
    if is_readable and has_dependent_coordinates(scene.system):
        check_system()
    if is_readable and scene.constraints and (concrete or is_concrete(method)):
        state = [np.asarray(x, state_dtype(scene.system)) for x in (q0, v0, ts[0])]
        selected, method = check_constraints(scene, method, *state)
        # In a motion with modes the rows that are independent change with the contacts. Rows that repeat others but for the
        # rounding of a file are dropped there too.
        scene = scene if modal and not scene.rounding else selected
    if is_readable and isinstance(scene.system, System):
        check_system()
    if not is_step_length(stepsize) and is_concrete(q0):
        checks.check_angles(scene, q0, state_dtype(scene.system))
    return scene, method


def _solver_at_start(scene: Scene, control, solver, stepsize, adjoint, arrays, modal: bool):
    """The solver that was given, or the one that a stiff start asks for."""
    # Only for adaptive steps without modes: events are located within explicit steps. Backwards the equations are others.
    if solver is not None or not scene.forces or modal or is_step_length(stepsize) or is_backsolve(adjoint):
        return solver
    from jaxdyn.simulation.solvers.choice import Rodas5P, stiff_rates

    q0, v0, ts, *_ = arrays
    law = controls.at_start(control, q0, v0, ts[0])
    if not is_known(scene, law, q0, v0, ts) or stiff_rates(scene, q0, v0, ts[0], law, float(ts[-1] - ts[0])) is None:
        return None
    return Rodas5P()


@once
def _choose(
    scene: Scene, control, method: Method, solver, stepsize, adjoint,
    *, outputs, watch: Watch, tolerances: tuple[bool, bool], modal: bool,
) -> Options:  # fmt: skip
    """Options of a run that the numbers do not decide; defaults and names stay what they are."""
    solver = method.stepper(solver, stepsize)
    is_default = solver is None and (stepsize is None or is_step_length(stepsize)) and not modal
    if is_default and (adjoint is None or (isinstance(adjoint, str) and adjoint in ADJOINTS)):
        adjoint = "reverse" if adjoint is None else adjoint
        if stepsize is not None:
            check_step_length(stepsize)
    else:
        from jaxdyn.simulation.solvers.choice import choose_adjoint, choose_solver

        solver = choose_solver(solver, stepsize)
        adjoint = choose_adjoint(adjoint, solver)
    checks.check_drives(scene, control, method, modal)
    checks.check_combination(control, method, adjoint)
    if modal:
        checks.check_contacts(scene)
        checks.check_modal_options(control, stepsize, solver, adjoint, outputs)
    given = [name for name, is_given in zip(("rtol", "atol"), tolerances, strict=True) if is_given]
    if given and stepsize is not None:
        from jaxdyn.simulation.solvers.choice import check_tolerances

        check_tolerances(solver, stepsize, given)
    check_events(scene, watch, modal)
    checks.check_cones(scene, () if modal else outputs)
    at_contacts = scene.cones is not None and (watch.contacts is None or watch.contacts.stop)
    stops = at_contacts, watch.limits is not None and watch.limits.stop
    checks_mass, shows_progress = may_have_singular_mass(scene.system), watch.progress is not None
    return Options(solver, adjoint, outputs, stops, watch.max_events, shows_progress, checks_mass)
