"""Checks of the arguments and the start of `simulate`, the default method, and safe inputs where the start is traced.

All checks raise ValueError with the argument, its value and the fix.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxdyn.compile.known import is_concrete, keep_known, once
from jaxdyn.constraints.assembly import largest_residuals, open_constraints, start_openness
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.rank import MIN_GAP
from jaxdyn.constraints.redundancy import holds_rows, keep_rows
from jaxdyn.constraints.selection import count_free, max_rounding, rows_and_doubts, select_rows
from jaxdyn.contact.forces import contacts_with_cones
from jaxdyn.contact.shapes import LowestCorner
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.model import host_math
from jaxdyn.model.arguments import check_shape
from jaxdyn.model.configuration import neutral
from jaxdyn.model.topology import frame_index
from jaxdyn.model.tree import Model
from jaxdyn.simulation.controls import Controller, Sampled
from jaxdyn.simulation.methods import Baumgarte, Free, Method, Multipliers, Projected, Reduced, is_regular, start_limit
from jaxdyn.simulation.options import Pose, is_backsolve, is_step_length
from jaxdyn.simulation.solution import RESULTS
from jaxdyn.simulation.variational import Variational
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene, has_drives
from jaxdyn.systems.system import has_quaternions, retract

CONTACT_OUTPUTS = ("contact_forces", "contact_margins")
OUTPUTS = (
    *("energy", "power", "work", "acceleration", "multipliers", "constraint_residual", "torque", "control_state"),
    *("drive_state", *CONTACT_OUTPUTS),
)
MODAL_OUTPUTS = ("energy", "acceleration", "multipliers", "contact_forces", "torque")  # of scenes with modes
# Deviation from unit length of quaternions that a file holds to a few digits.
_LENGTH_TOLERANCE = 1e-3


def check_start(scene: Scene, q0, v0) -> None:
    """Refuse systems that cannot move, states of a wrong shape, NaN, and quaternions that are far from unit length."""
    if scene.nv == 0:
        raise ValueError("the system has no coordinates (nq = nv = 0), so nothing moves; add a body with a joint")
    for name, value in (("q0", q0), ("v0", v0)):
        check_shape(scene.system, name, value)
        if is_concrete(value):
            _check_finite(name, value)
    if not is_concrete(q0):
        return
    for joint, places in _quaternions(scene.system):
        length = float(np.linalg.norm(np.asarray(q0, float)[places]))
        if abs(length - 1) > _LENGTH_TOLERANCE:
            raise ValueError(
                f"q0 has a quaternion of length {length:.6g} at joint {joint!r}, expected 1; "
                "divide it by its length (order w, x, y, z)"
            )


def has_unit_quaternions(system, q) -> Bool[Array, ""]:
    """True if every quaternion of q is zero or of unit length, up to the rounding of numbers in files, ()."""
    # A quaternion of zeros is left to the check for finite numbers, which it is not when it has been normalised.
    squares = [jnp.sum(q[places] ** 2) for _, places in _quaternions(system)]
    if not squares:
        return jnp.asarray(True)
    low, high = (1 - _LENGTH_TOLERANCE) ** 2, (1 + _LENGTH_TOLERANCE) ** 2
    return jnp.stack([(x == 0) | ((x >= low) & (x <= high)) for x in squares]).all()


def _quaternions(system) -> list[tuple[str, slice]]:
    """Joints whose coordinates end with a quaternion, and its place in q."""
    if not has_quaternions(system):
        return []
    top = system.topology
    joints = zip(top.joint_names, top.kinds, top.q_slices, strict=True)
    return [(name, slice(at.stop - 4, at.stop)) for name, kind, at in joints if kind in ("spherical", "free")]


def largest_angle(dtype) -> float:
    """Largest angle (rad) that adaptive steps start from: 150 turns in float32, 3.5e6 in float64.

    Beyond it the angle changes by steps of sqrt(eps)/3 and more. Error estimates of the rates take them for errors of the
    method, and shorter steps make them worse.
    """
    return 1 / (3 * float(jnp.finfo(dtype).eps) ** 0.5)


def angle_coordinates(system) -> np.ndarray:
    """Indices in q of the angles of a `Model` that repeat after a turn."""
    if not isinstance(system, Model):
        return np.zeros(0, int)
    top = system.topology
    places = zip(top.kinds, top.q_slices, strict=True)
    return np.array([at.stop - 1 for kind, at in places if kind in ("revolute", "continuous", "planar")], int)


def check_angles(scene: Scene, q0, dtype) -> None:
    """Refuse angles of so many turns that their dtype holds too little of the rest."""
    sizes = np.abs(np.asarray(q0, float))
    if not (sizes > largest_angle(dtype)).any():
        return
    angles = angle_coordinates(scene.system)
    sizes = sizes[angles]
    if sizes.size and sizes.max() > largest_angle(dtype):
        index = int(angles[np.argmax(sizes)])
        value, eps = float(q0[index]), float(jnp.finfo(dtype).eps)
        raise ValueError(
            f"q0 is {value:.6g} rad at index {index}, which {jnp.dtype(dtype).name} holds only to {eps * abs(value):.1g} rad; "
            f"subtract the {round(value / (2 * np.pi))} whole turns, use float64, or fixed steps (stepsize=0.01)"
        )


def check_times(ts) -> None:
    """Refuse times that are fewer than two, not finite, or not increasing."""
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(f"ts has shape {ts.shape}; pass the start and at least one later time, (nt,) with nt >= 2")
    if not is_concrete(ts):
        return
    _check_finite("ts", ts)
    times = np.asarray(ts, float)
    is_later = times[1:] > times[:-1]
    if not is_later.all():
        i = np.flatnonzero(~is_later)[0]
        raise ValueError(
            f"ts does not increase at index {i + 1}: {times[i]} then {times[i + 1]}; sort it, drop doubles"
        )


def _check_finite(name: str, value) -> None:
    is_finite = np.isfinite(np.asarray(value, float))
    if not is_finite.all():
        bad = np.flatnonzero(~is_finite)
        raise ValueError(f"{name} is {np.asarray(value)[bad[0]]} at index {bad[0]}; give finite numbers")


def sort_outputs(scene: Scene, outputs) -> tuple[str | Pose, ...]:
    """Names of outputs in order, each once; refuses names that are no outputs, and frames that do not exist."""
    if isinstance(outputs, str):
        raise ValueError(f"outputs is the string {outputs!r}; pass a tuple, e.g. outputs=({outputs!r},)")
    for name in outputs:
        if isinstance(name, Pose) and isinstance(scene.system, Model):
            frame_index(scene.system, name.frame)
        elif name not in OUTPUTS:
            raise ValueError(f"outputs has {name!r}; choose from {', '.join(OUTPUTS)} and jd.simulation.Pose(frame)")
    # Names are static: in one order, the same outputs share a compiled program.
    return tuple(sorted(set(outputs), key=lambda name: (isinstance(name, Pose), name)))


def check_combination(control, method: Method, adjoint) -> None:
    """Refuse controls and adjoints that a method does not support."""
    if isinstance(method, Variational) and isinstance(control, (Controller, Sampled)):
        raise ValueError(
            f"control is a {type(control).__name__}, whose state the steps of method 'variational' do not integrate; take "
            "another method"
        )
    if isinstance(method, Variational) and is_backsolve(adjoint):
        raise ValueError(
            "adjoint is 'backsolve', which needs a differential equation; take 'reverse' or another method"
        )
    if isinstance(method, Reduced) and is_backsolve(adjoint):
        raise ValueError(
            "adjoint is 'backsolve', which cannot follow the basis of method='reduced' backwards, nor see it become singular; "
            "take 'reverse'"
        )


def check_drives(scene: Scene, control, method: Method, modal: bool) -> None:
    """Refuse drives with a state where nothing integrates it."""
    if not has_drives(scene):
        return
    what = "the scene has drives with a state (jd.forces.DriveDynamics)"
    if modal:
        raise ValueError(
            f"{what} and forces with modes (jd.contact.DryFriction, jd.contact.UnilateralContact); leave one of them out"
        )
    if isinstance(method, Variational):
        raise ValueError(f"{what}, which the steps of method 'variational' do not integrate; take another method")
    if isinstance(control, Controller) and control.takes_multipliers:
        raise ValueError(f"{what}, behind which multipliers do not depend on the command; use a control without them")


def check_contacts(scene: Scene) -> None:
    """Refuse contacts that change their place on a body, which have no events."""
    for force in scene.forces:
        touching: Any = getattr(force, "contact", None)
        if isinstance(getattr(touching, "feature", None), LowestCorner):
            raise ValueError(
                f"contact {touching.name!r} is in a lowest corner, another one as the body turns: take jd.stepper, or contacts "
                "in all corners (lowest=None)"
            )


def check_modal_options(control, stepsize, solver, adjoint, outputs) -> None:
    """Refuse options that motions with modes do not support."""
    what = "the scene has forces with modes (jd.contact.DryFriction, jd.contact.UnilateralContact)"
    if isinstance(control, (Controller, Sampled)):
        raise ValueError(f"control is a {type(control).__name__}, and {what}; give a function control(q, v, t)")
    if stepsize is not None and not is_step_length(stepsize):
        raise ValueError(
            f"stepsize is {stepsize!r}, and {what}; leave it out for steps that keep rtol and atol, or give a length (s)"
        )
    from jaxdyn.simulation.solvers.choice import has_name, has_own_loop, option_of

    if not has_own_loop(solver):
        raise ValueError(
            f"{option_of(solver)}, and {what}, whose events are located within steps of the library; take an explicit "
            "solver, such as diffrax.Tsit5(), or, where forces are stiff, jd.solvers.Rodas5P()"
        )
    if is_backsolve(adjoint):
        raise ValueError(f"adjoint is 'backsolve', which does not go back through events, and {what}; take 'reverse'")
    if not has_name(adjoint):
        raise ValueError(f"adjoint is {adjoint}, which does not go back through events, and {what}; take 'reverse'")
    for name in outputs:
        if name not in MODAL_OUTPUTS and not isinstance(name, Pose):
            raise ValueError(
                f"outputs has {name!r}, and {what}; choose from {', '.join(MODAL_OUTPUTS)} and jd.simulation.Pose(frame)"
            )


def check_cones(scene: Scene, outputs) -> None:
    """Refuse cones that do not fit, and contact forces of a scene without cones."""
    if scene.cones is not None:
        contacts_with_cones(scene)
    elif asked := [name for name in outputs if name in CONTACT_OUTPUTS]:
        raise ValueError(
            f"outputs has {asked[0]!r} and the scene has no cones; give its contacts cones, as in jd.Scene(..., "
            "cones=jd.contact.friction_cone('hard-finger', mu=0.8))"
        )


METHODS: dict[str, type[Method]] = {
    kind.name: kind for kind in (Multipliers, Projected, Reduced, Baumgarte, Variational)
}
_FREE, _PROJECTED = Free(), Projected()


def choose_method(scene: Scene, method: str | Method) -> Method:
    """Method of integration: "auto" is "projected" for a scene with constraints and "free" for one without.

    "projected" is the default because it works where the others fail, with dependent rows and where rows lose rank on the way,
    and because it needs no choice of velocities.

    **Raises:** ValueError for a method that does not fit the scene.
    """
    if not scene.constraints:
        if method in ("auto", "free") or isinstance(method, Free):
            return _FREE
        if method == "variational" or isinstance(method, Variational):
            return Variational() if isinstance(method, str) else method
        raise ValueError(f"method is {method!r}; a scene without constraints takes 'auto' or 'free', or 'variational'")
    if method == "auto":
        return _PROJECTED
    if isinstance(method, Method) and not isinstance(method, Free):
        chosen = method
    elif isinstance(method, str) and method in METHODS:
        chosen = METHODS[method]()
    else:
        names = ", ".join(map(repr, METHODS))
        raise ValueError(
            f"method is {method!r}; a scene with constraints takes 'auto' or {names}, or e.g. jd.Reduced(...)"
        )
    return chosen.for_scene(scene, None) if isinstance(chosen, Reduced) else chosen


def check_constraints(scene: Scene, method: Method, q, v, t) -> tuple[Scene, Method]:
    """Check a concrete start against the constraints; the scene with its independent rows, and the method for them.

    **Raises:** ValueError that names the constraints, the size of their violation and the fix; for a basis that is not regular
    at the start.
    """
    # Most starts are on independent constraints, which is found without the details that messages need.
    if not isinstance(method, Reduced) and _find_soundness(scene, rank_tol=method.rank_tol, dtype=q.dtype)(q, v, t):
        return scene, method
    limit, t = start_limit(q.dtype), np.asarray(t, q.dtype)
    selection = select_rows(scene, q, t, method.rank_tol)
    rank = int(np.sum(selection.kept))
    with keep_known():  # known numbers stay known while a function around is traced
        selected = scene if rank == len(selection.kept) else keep_rows(scene, selection)
    ratio = start_openness(selected, relative=limit)(q, v, t)
    if ratio <= 1 and selection.rounding > max_rounding(q.dtype):
        raise ValueError(
            f"rows of the constraints contradict each other: they depend on others, but are open by "
            f"{float(selection.rounding):.2g} of their size ({open_constraints(scene, q, v, t, limit)}); leave them out"
        )
    if not ratio <= 1:
        residuals = largest_residuals(selected, q, v, t)
        raise ValueError(
            f"q0, v0 are not on the constraints: {open_constraints(selected, q, v, t, limit)} (position residual "
            f"{float(residuals[0]):.3g}, velocity residual {float(residuals[1]):.3g}); start from "
            "state = jd.assemble(scene, q0, v0), with state.q and state.v"
        )
    if selection.gap < MIN_GAP:
        raise ValueError(
            "the rank of the constraints is not clear: rows that are independent of the others differ by less than a factor of "
            f"{MIN_GAP:g} from rows that repeat them; give numbers with more digits, or method=jd.Projected(rank_tol=...)"
        )
    if rank == scene.nv:
        names = ", ".join(repr(place.name) for place in layout(scene))
        raise ValueError(
            f"the constraints {names} remove all degrees of freedom: {rank} independent rows for nv = {scene.nv}; "
            "leave one out, or free a joint"
        )
    if not isinstance(method, Reduced):
        return selected, method
    # Inside a jit, jax would trace operations on known numbers too.
    with keep_known():
        q, t = jnp.asarray(q), jnp.asarray(t, q.dtype)
        # At a singular position the rows that are kept leave more velocities than the mechanism has elsewhere.
        free = count_free(scene, q, t, method.rank_tol) if selected is scene else scene.nv - rank
        method = method.for_scene(scene, int(free))
        if method.basis is not None and not bool(_is_regular_at(selected, method.basis, q, t)):
            raise ValueError(f"the basis is not regular at q0: {method.basis.advice(selected, q, t)}")
    return selected, method


@once
def _find_soundness(scene: Scene, *, rank_tol, dtype) -> Callable[..., bool]:
    """Function (q, v, t) of a known scene: whether all rows are independent beyond doubt, and closed, and leave freedom."""
    rows, has_doubtful_rows = rows_and_doubts(scene, rank_tol=rank_tol, dtype=dtype)
    is_free = rows.kept.size < scene.nv and not holds_rows(scene)
    openness = start_openness(scene, relative=start_limit(dtype))
    return lambda q, v, t: is_free and not has_doubtful_rows(q, t) and bool(openness(q, v, t) <= 1)


def may_have_singular_mass(system) -> bool:
    """True if the mass matrix of a tree can be singular: an inertia is not known to be positive definite."""
    if not isinstance(system, Model):
        return False  # other systems are checked by their own rules
    if not is_concrete(system.inertias):
        return True
    # Positive definite pseudo-inertias make the mass matrix positive definite, whatever the configuration.
    sizes = np.linalg.eigvalsh([host_math.pseudo_inertia(x) for x in np.asarray(system.inertias, float)])
    return not (sizes[:, 0] > 1e-12 * sizes[:, -1]).all()


def has_definite_mass(system, q, t):
    """True if the mass matrix is positive definite to rounding, ()."""
    return mass_factor(mass_matrix(system, q, t)).is_definite()


class Inputs(NamedTuple):
    """Start, times and steps that can be integrated in place of those that were given.

    `given`: the times as they were given; `steps`: rtol, atol, and stepsize or controller; `good` (): true if all were usable;
    `faults`: cases for `first_of`, the one that hides the others first.
    """

    q0: Array
    v0: Array
    ts: Array
    given: Array
    steps: tuple
    good: Array
    faults: list[tuple[Any, Any]]


def safe_inputs(system, numbers) -> Inputs:
    """Replace traced inputs that cannot be used by harmless ones, so that a bad trajectory of a batch ends soon.

    `numbers`: q0, v0, ts, rtol, atol, and the length of steps or their controller.
    """
    # Known numbers are NumPy arrays where nothing is traced, as under `jax.disable_jit`.
    q0, v0, ts, rtol, atol, stepsize = (jnp.asarray(x) if isinstance(x, np.ndarray) else x for x in numbers)
    # Before `retract`, which gives every quaternion the length one.
    unit_start = has_unit_quaternions(system, q0)
    q0 = retract(system, q0)
    in_order = jnp.isfinite(ts).all() & (ts[1:] > ts[:-1]).all()
    given, ts = ts, jnp.where(in_order, ts, jnp.arange(ts.shape[0], dtype=ts.dtype))
    finite_start = jnp.isfinite(q0).all() & jnp.isfinite(v0).all()
    fine_tolerances = jnp.isfinite(rtol) & (rtol >= 0) & jnp.isfinite(atol) & (atol >= 0)
    # Coarse, so that a trajectory that is refused anyway takes few steps.
    rtol, atol = (jnp.where(fine_tolerances, x, jnp.full_like(x, 1e-3)) for x in (rtol, atol))
    fine_steps = jnp.asarray(True)
    if is_step_length(stepsize):
        fine_steps = jnp.isfinite(stepsize) & (stepsize > 0)
        # One step to the end, as the trajectory is refused anyway.
        stepsize = jnp.where(fine_steps, stepsize, ts[-1] - ts[0])
    good = finite_start & unit_start & in_order & fine_steps & fine_tolerances
    harmless = jnp.zeros_like(q0)
    if isinstance(system, Model):
        # Behind the coordinates of the joints a system may have others, such as those of contacts.
        nq = system.topology.nq
        harmless = harmless.at[nq:].set(1.0).at[:nq].set(neutral(system).astype(q0.dtype))
    q0, v0 = jnp.where(good, q0, harmless), jnp.where(good, v0, jnp.zeros_like(v0))
    codes: Any = RESULTS
    faults = [
        (~in_order, codes.unordered_times),
        (~fine_steps, codes.bad_stepsize),
        (~fine_tolerances, codes.bad_tolerance),
        (~finite_start, codes.nonfinite_start),
        (~unit_start, codes.unnormalized_start),
    ]
    return Inputs(q0, v0, ts, given, (rtol, atol, stepsize), good, faults)


@eqx.filter_jit
def _is_regular_at(scene, basis, q, t):
    return is_regular(basis.at(scene, q, t).quality)
