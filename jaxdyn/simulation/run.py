"""Motion of a scene in time: `simulate` integrates it with any diffrax method and reports what went wrong, if anything.

The state is (q, v) with dq/dt = H(q) v and dv/dt from the dynamics. Quaternions in q are integrated as four numbers and
returned to unit length at the end of every step (`ProjectedSolver`), which keeps the order of the method. A model
without quaternions gets no projection at all.
"""

from collections.abc import Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import is_concrete, is_known
from jaxdyn.constraints.selection import may_have_redundant_rows
from jaxdyn.contact.unilateral import has_modes
from jaxdyn.model.arguments import Numbers, as_array, state_dtype
from jaxdyn.simulation import contacts as unilateral
from jaxdyn.simulation import controls
from jaxdyn.simulation import limits as joint_limits
from jaxdyn.simulation.controls import Control
from jaxdyn.simulation.hybrid import motion as hybrid
from jaxdyn.simulation.hybrid.machine import SEARCHED
from jaxdyn.simulation.methods import Method
from jaxdyn.simulation.motion import motion
from jaxdyn.simulation.outputs import checked_outputs
from jaxdyn.simulation.solution import Solution, raise_failure
from jaxdyn.simulation.solvers import Stepper
from jaxdyn.simulation.solvers.choice import (
    Solver,
    Stepsize,
    checked_adjoint,
    checked_method,
    checked_step_limit,
    for_start,
    is_fixed,
)
from jaxdyn.simulation.solvers.inputs import (
    check_start,
    check_times,
    check_tolerance,
    check_turns,
)
from jaxdyn.simulation.start import checked_start, chosen_method, may_have_singular_mass
from jaxdyn.systems.scene import Scene, as_scene, has_drives
from jaxdyn.systems.system import SceneLike, System, has_dependent_coordinates


def simulate(
    scene: SceneLike,
    q0: Numbers,
    v0: Numbers,
    ts: Numbers,
    *,
    control: Control = None,
    method: str | Method = "auto",
    solver: Solver = None,
    stepsize: Stepsize = None,
    rtol: Numbers = 1e-8,
    atol: Numbers = 1e-8,
    adjoint: str | diffrax.AbstractAdjoint | None = None,
    outputs: Sequence[str] = (),
    contacts: str = "stop",
    limits: str | None = None,
    max_events: int = 64,
    progress: bool = False,
    max_steps: int | None = None,
    throw: bool | None = None,
) -> Solution:
    """Integrate M a + C v + N = tau + forces + A^T lam, dq/dt = H(q) v, from (q0, v0) and save it at the times `ts`.

    One sample; batch states, controls and the scene's leaves with `jax.vmap`. Computed in the dtype of the model.
    Called outside of `jax.jit` it compiles once for all scenes of a shape, whose numbers are inputs of the program. Inside your
    own `jax.jit`, a model that is closed over is known to the compiler; one that is an argument serves for other numbers too.

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
    - `solver`: any diffrax method of an `ODETerm`, `jd.solvers.Rodas5P()`, `jd.solvers.LieGroup(...)` of one of them, or a
      method that takes an implicit and an explicit part (`diffrax.KenCarp4`): implicit are dq/dt = H v and what the scene's
      forces add to the acceleration, explicit all the rest (inertia, gravity, `control`). Default: `RK4` for fixed steps;
      for adaptive ones `Dopri8`, or `Rodas5P` where the scene lists forces, all inputs are concrete and `jd.stiffness` at
      the start says that explicit steps would have to be shorter than a thousandth of the time.
    - `stepsize`: None for adaptive steps, a number (s) for fixed ones, or a diffrax step-size controller.
    - `rtol`, `atol`: local error of a step, relative to and besides the size of each entry of (q, v). Values below ten
      times the rounding error of the dtype are raised to that. With fixed steps, tolerances of an implicit solver.
    - `adjoint`: "reverse" (default) for reverse mode with checkpoints, and Hessians over it; "forward" for jvp, jacfwd and
      Hessians by forward over forward mode; "direct" for both modes, at a cost that grows with `max_steps`; "backsolve" for the
      continuous adjoint, whose gradients are approximate; or a diffrax adjoint.
    - `outputs`: any of "energy", "power", "work" (one more state, under the same error control), "acceleration" (the rate
      of v: of a free joint that of its body twist; `jd.dynamics.frame_acceleration` gives those of frames in world axes),
      "multipliers", "constraint_residual", "contact_forces", "contact_margins", "torque" (of the control, behind drives
      and limits), "control_state" (of a controller), "drive_state" (of drives) and "pose:<frame>". They are computed only if
      asked for.
    - `contacts`: of a scene with `cones`. "stop": where a contact pulls or leaves its cone (a margin below zero by more than
      rounding, eps^(1/2) of its force) the run ends, with the code `contact_lost` and the time, which is found within the
      step. "report": it goes on, and contacts hold on both sides.
    - `limits`: of the model's joints (`model.lower`, `model.upper`), which nothing enforces. None: they are not looked at.
      "stop": where a joint passes one the run ends, with the code `joint_limit_passed` and the time, found within the step.
      "report": the run goes on; `stats["passed_limit"]` is the entry of q of the first limit that is passed at a save point, or
      -1, and a concrete run warns (`JointLimitWarning`).
    - `max_events`: of a scene with forces that have modes (`jd.contact.DryFriction`, `jd.contact.UnilateralContact`), after
      which the run ends with the code `too_many_events`. Such scenes take explicit methods with adaptive or fixed steps,
      which end at events.
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
    modal = has_modes(scene)
    # Places of contacts are looked at before what depends on them.
    if has_dependent_coordinates(scene.system) and is_concrete((scene, q0, v0, ts)):
        _check_system(scene.system, q0, v0, ts[0])
    if scene.constraints and is_concrete((scene, method, q0, v0, ts)):
        state = [np.asarray(x, state_dtype(scene.system)) for x in (q0, v0, np.asarray(ts)[0])]
        selected, method = checked_start(scene, method, *state)
        scene = scene if modal else selected
    if isinstance(scene.system, System) and is_concrete((scene, q0, v0, ts)):
        _check_system(scene.system, q0, v0, ts[0])
    if not is_fixed(stepsize) and is_concrete(q0):
        check_turns(scene, q0, state_dtype(scene.system))
    control = controls.as_control(control)
    controls.check_steps(control, stepsize)
    backwards = adjoint == "backsolve" or isinstance(adjoint, diffrax.BacksolveAdjoint)
    if solver is None and scene.forces and not (modal or is_fixed(stepsize) or backwards):
        solver = for_start(scene, controls.at_start(control, q0, v0, ts[0]), q0, v0, ts)
    solver = checked_method(method.stepper(solver, stepsize), stepsize)
    adjoint = checked_adjoint(adjoint, solver)
    check_drives(scene, control, solver, modal)
    if isinstance(solver, Stepper) and isinstance(control, (controls.Controller, controls.Sampled)):
        raise ValueError(
            f"control is a {type(control).__name__}, whose state the steps of method 'variational' do not integrate; take "
            "another method"
        )
    if isinstance(solver, Stepper) and isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint is 'backsolve', which needs a differential equation; take 'reverse' or another method"
        )
    if method.step_constants and isinstance(adjoint, diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint is 'backsolve', which cannot follow the basis of method='reduced' backwards; take 'reverse', or "
            "jd.Reduced with independent velocities or a function"
        )
    outputs = checked_outputs(scene, outputs)
    if modal:
        hybrid.check_options(control, stepsize, solver, adjoint, outputs)
        hybrid.check_count(max_events)
        outputs_of_contacts = ()
    else:
        outputs_of_contacts = outputs
    unilateral.check_contacts(scene, contacts, outputs_of_contacts)
    joint_limits.check_limits(scene, limits, modal)
    options = {
        "solver": solver,
        "adjoint": adjoint,
        "outputs": outputs,
        "contacts": contacts,
        "limits": limits,
        "progress": bool(progress),
        "max_steps": checked_step_limit(max_steps, ts, stepsize, adjoint),
        "limit_is_given": max_steps is not None,
        "max_events": max_events,
        "checks_mass": may_have_singular_mass(scene.system),
        "selects_rows": bool(scene.constraints)
        and not is_concrete((scene, method, q0, v0, ts))
        and (method.rank_tol is not None or may_have_redundant_rows(scene)),
    }
    if modal and is_fixed(stepsize) and max_steps is None:
        options["max_steps"] += SEARCHED * max_events
    dtype = state_dtype(scene.system)
    numbers: list[Any] = [jnp.asarray(x, dtype) for x in (q0, v0, ts, rtol, atol)]
    numbers.append(jnp.asarray(stepsize, dtype) if is_fixed(stepsize) else stepsize)
    concrete = is_known(scene, control, method, numbers)
    solution = (_run_with_events if modal else _run)(scene, control, method, numbers, options)
    if limits == "report":
        solution = joint_limits.reported(scene, solution, concrete)
    if throw is None:
        throw = concrete
    if throw and concrete:
        raise_failure(solution, scene, control, options)
    elif throw:
        solution = solution.result.error_if(solution, ~solution.success)
    return solution


@entry_point
def _run(scene: Scene, control, method: Method, numbers, options) -> Solution:
    return motion(scene, control, method, numbers, options)


@entry_point
def _run_with_events(scene: Scene, control, method: Method, numbers, options) -> Solution:
    return hybrid.motion(scene, control, numbers, options)


def check_drives(scene: Scene, control, solver, modal: bool) -> None:
    """Refuse drives with a state where nothing integrates it.

    **Raises:** ValueError.
    """
    if not has_drives(scene):
        return
    what = "the scene has drives with a state (jd.forces.DriveDynamics)"
    if modal:
        raise ValueError(
            f"{what} and forces with modes (jd.contact.DryFriction, jd.contact.UnilateralContact); leave one of them out"
        )
    if isinstance(solver, Stepper):
        raise ValueError(f"{what}, which the steps of method 'variational' do not integrate; take another method")
    if isinstance(control, controls.Controller) and control.takes_multipliers:
        raise ValueError(f"{what}, behind which multipliers do not depend on the command; use a control without them")


def _check_system(system, q0, v0, t0) -> None:
    """Refuse a known state from which the system cannot move, by its own rules."""
    with jax.ensure_compile_time_eval():
        system.check_start(*(jnp.asarray(x, state_dtype(system)) for x in (q0, v0, t0)))
