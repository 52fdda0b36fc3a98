"""Method and start of a run: the default method, the check of a concrete start, and safe inputs of a traced one."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.assembly import largest_residuals, open_constraints, start_openness
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.redundancy import keep_rows
from jaxdyn.constraints.selection import most_rounding, select_concrete_rows
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.model import host_math
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model
from jaxdyn.simulation.checks import has_unit_quaternions
from jaxdyn.simulation.methods import Baumgarte, Free, Method, Multipliers, Projected, Reduced, is_regular, start_limit
from jaxdyn.simulation.solution import RESULTS
from jaxdyn.simulation.solvers.choice import is_step_length
from jaxdyn.simulation.variational import Variational
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import retract

METHODS: dict[str, type[Method]] = {
    kind.name: kind for kind in (Multipliers, Projected, Reduced, Baumgarte, Variational)
}


def choose_method(scene: Scene, method: str | Method) -> Method:
    """Method of integration: "auto" is "projected" for a scene with constraints and "free" for one without.

    "projected" is the default because it works where the others fail, with dependent rows and where rows lose rank on the way,
    and because it needs no choice of velocities.

    **Raises:** ValueError for a method that does not fit the scene.
    """
    if not scene.constraints:
        if method in ("auto", "free") or isinstance(method, Free):
            return Free()
        if method == "variational" or isinstance(method, Variational):
            return Variational() if isinstance(method, str) else method
        raise ValueError(f"method is {method!r}; a scene without constraints takes 'auto' or 'free', or 'variational'")
    if method == "auto":
        return Projected()
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
    limit, t = start_limit(q.dtype), np.asarray(t, q.dtype)
    selection, here = select_concrete_rows(scene, q, t, method.rank_tol)
    rank = int(np.sum(selection.kept))
    selected = scene if rank == len(selection.kept) else keep_rows(scene, selection)
    ratio = start_openness(selected, q, v, t, limit)
    if ratio <= 1 and selection.rounding > most_rounding(q.dtype):
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
    if rank == scene.nv:
        names = ", ".join(repr(place.name) for place in layout(scene))
        raise ValueError(
            f"the constraints {names} remove all degrees of freedom: {rank} independent rows for nv = {scene.nv}; "
            "leave one out, or free a joint"
        )
    if not isinstance(method, Reduced):
        return selected, method
    # Inside a jit, jax would trace operations on known numbers too.
    with jax.ensure_compile_time_eval():
        q, t = jnp.asarray(q), jnp.asarray(t, q.dtype)
        method = method.for_scene(scene, scene.nv - (here if selected is scene else rank))
        if method.basis is not None and not bool(_is_regular_at(selected, method.basis, q, t)):
            raise ValueError(f"the basis is not regular at q0: {method.basis.advice(selected, q, t)}")
    return selected, method


def may_have_singular_mass(system) -> bool:
    """True if the mass matrix of a tree can be singular: an inertia is not known to be positive definite."""
    if not isinstance(system, Model):
        return False  # other systems are checked by their own rules
    if not is_concrete(system.inertias):
        return True
    # Positive definite pseudo-inertias make the mass matrix positive definite, whatever the configuration.
    sizes = [np.linalg.eigvalsh(host_math.pseudo_inertia(x)) for x in np.asarray(system.inertias, float)]
    return not all(least > 1e-12 * largest for least, *_, largest in sizes)


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
    q0, v0, ts, rtol, atol, stepsize = numbers
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
