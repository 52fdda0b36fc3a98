"""Which method a run takes, and whether its start satisfies the constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.assembly import largest_residuals, open_constraints, start_openness
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.redundancy import keep_rows
from jaxdyn.constraints.selection import most_rounding, select_concrete_rows
from jaxdyn.dynamics.quantities import mass_matrix
from jaxdyn.model import float64 as f64
from jaxdyn.model.tree import Model
from jaxdyn.simulation.methods import (
    Baumgarte,
    Free,
    Method,
    Multipliers,
    Projected,
    Reduced,
    Variational,
    is_regular,
    start_limit,
)
from jaxdyn.systems.mass_factor import mass_factor
from jaxdyn.systems.scene import Scene

METHODS: dict[str, type[Method]] = {
    kind.name: kind for kind in (Multipliers, Projected, Reduced, Baumgarte, Variational)
}


def chosen_method(scene: Scene, method: str | Method) -> Method:
    """How to integrate: "auto" is "projected" for a scene with constraints and "free" for one without.

    "projected" is the rule because it works where the others fail: dependent rows, and places where rows lose rank on
    the way, and needs no choice of velocities.

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
    return chosen.fitted(scene, None) if isinstance(chosen, Reduced) else chosen


def checked_start(scene: Scene, method: Method, q, v, t) -> tuple[Scene, Method]:
    """The scene with its independent rows and the method, for a start with concrete numbers on the constraints.

    **Raises:** ValueError that names the constraints and by how much they are violated, and the fix; for a basis that
    does not serve at the start.
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
            f"the constraints {names} remove all freedom: {rank} independent rows for nv = {scene.nv}; "
            "leave one out, or free a joint"
        )
    if not isinstance(method, Reduced):
        return selected, method
    # Inside a jit, jax would trace operations on known numbers too.
    with jax.ensure_compile_time_eval():
        q, t = jnp.asarray(q), jnp.asarray(t, q.dtype)
        method = method.fitted(scene, scene.nv - (here if selected is scene else rank))
        if method.basis is not None and not bool(_is_regular_at(selected, method.basis, q, t)):
            raise ValueError(f"the basis does not serve at q0: {method.basis.advice(selected, q, t)}")
    return selected, method


def may_have_singular_mass(system) -> bool:
    """Whether the mass matrix of a tree can be singular: where a body's inertia is not known to be positive definite."""
    if not isinstance(system, Model):
        return False  # other systems are checked by their own rules
    if not is_concrete(system.inertias):
        return True
    sizes = [np.linalg.eigvalsh(f64.pseudo_inertia(x)) for x in np.asarray(system.inertias, float)]
    return not all(least > 1e-12 * largest for least, *_, largest in sizes)


def has_definite_mass(system, q, t):
    """Whether the mass matrix is positive definite to rounding, ()."""
    return mass_factor(mass_matrix(system, q, t)).is_definite()


@eqx.filter_jit
def _is_regular_at(scene, basis, q, t):
    return is_regular(basis.at(scene, q, t).quality)
