"""Contact forces of a scene and their margins from pulling and slipping, from the multipliers of its rows."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import layout
from jaxdyn.contact.cones import Cones, FrictionCone
from jaxdyn.contact.qp import QPSolution, solve_qp
from jaxdyn.model.arguments import Checked, Numbers, as_array, batch_hint, state_dtype
from jaxdyn.model.numbers import as_float, as_number
from jaxdyn.systems.scene import Scene


class ContactForces(eqx.Module):
    """Contact forces and their margins in the friction cones.

    - `forces`: by the contact's name, (m,), along the columns of its wrench basis, the normal into the object; N and N m.
    - `margins`: by name, (), the cone's margin: positive while the contact neither pulls nor slips.
    - `margin` (): the least of them.
    """

    forces: dict[str, Float[Array, "..."]]
    margins: dict[str, Float[Array, "..."]]
    margin: Float[Array, "..."]


class ContactWithCone(NamedTuple):
    """Contact with a friction cone: its name, its multipliers in the order of its wrench basis, and the cone."""

    name: str
    rows: np.ndarray
    cone: FrictionCone


def contact_forces(
    scene: Scene, multipliers: Float[Array, " nc"], cones: Cones = None, smoothing: Numbers = 0.0
) -> ContactForces:
    """Force of each contact, and its margin in its friction cone.

    **Arguments:**

    - `scene`: a `Grasp`, or any `Scene` with contacts.
    - `multipliers` (nc,): of the scene's rows: `.multipliers` of `jd.constrained_dynamics`, `.contact_forces` of
      `object_dynamics`, or one sample of a solution's.
    - `cones`: a `FrictionCone` for all contacts, a list with one per constraint, or a dictionary by name; by default those
      of the scene. Constraints missing in a dictionary are skipped.
    - `smoothing`: N, of `FrictionCone.margin`.

    **Returns:** `ContactForces`.

    **Raises:** ValueError for another number of multipliers, no cones, unknown names, cones of another kind than their
    contact, and constraints with a cone that are no contacts.

    Source: Murray, Li & Sastry (1994), section 5.2; the cone is to be tested on all of lam (EQUATIONS section 10).
    """
    multipliers = as_array(multipliers, "multipliers", state_dtype(scene.system))
    places = layout(scene)
    count = places[-1].end if places else 0
    if multipliers.shape != (count,):
        raise ValueError(
            f"multipliers has shape {multipliers.shape}, expected ({count},), one per row of the scene"
            f"{batch_hint(multipliers, (1,))}"
        )
    smoothing = as_number(smoothing, "smoothing", "N", zero=True, like=multipliers.dtype)
    forces, margins = {}, {}
    for contact in contacts_with_cones(scene, cones):
        forces[contact.name] = multipliers[contact.rows]
        margins[contact.name] = contact.cone.margin(forces[contact.name], smoothing)
    return ContactForces(forces, margins, jnp.min(jnp.stack(list(margins.values()))))


def contacts_with_cones(scene: Scene, cones=None) -> tuple[ContactWithCone, ...]:
    """Contacts of the scene with a cone, in the order of its constraints.

    **Raises:** ValueError as `contact_forces` does.
    """
    places = layout(scene)
    chosen = _by_name(scene.cones if cones is None else cones, [place.name for place in places])
    coned = []
    for constraint, place in zip(scene.constraints, places, strict=True):
        if place.name not in chosen:
            continue
        cone, order = chosen[place.name], constraint.wrench_components()
        if order is None:
            raise ValueError(
                f"constraint {place.name!r} is a {type(constraint).__name__} without a normal force; it has no friction "
                "cone: give cones as a dictionary by the names of contacts"
            )
        # Cones name components by their places: a cone of another kind would read friction as normal force.
        if cone.size != len(order):
            raise ValueError(
                f"cone of contact {place.name!r} is of kind {cone.kind!r} with {cone.size} components, the contact has "
                f"{len(order)}; give the cone of the contact's kind"
            )
        # `order` counts within the rows of the constraint, `rows` within those of the scene.
        coned.append(ContactWithCone(place.name, place.start + np.array(order, int), cone))
    return tuple(coned)


def _by_name(cones, names: list[str]) -> dict[str, FrictionCone]:
    if isinstance(cones, FrictionCone):
        return dict.fromkeys(names, cones)
    if isinstance(cones, (tuple, list)):
        if len(cones) != len(names):
            raise ValueError(f"cones has {len(cones)} entries for the {len(names)} contacts {names}; give one for each")
        cones = dict(zip(names, cones, strict=True))
    if not isinstance(cones, dict) or not cones or not set(cones) <= set(names):
        shown = list(cones) if isinstance(cones, dict) else cones
        raise ValueError(
            f"cones is {shown!r}; give a FrictionCone, one per contact, or a dictionary by names of {names}"
        )
    for name, cone in cones.items():
        if not isinstance(cone, FrictionCone):
            raise ValueError(f"cone of contact {name!r} is {cone!r}; use jd.contact.friction_cone(...)")
    return cones


def optimal_forces(
    G: Numbers,
    wrench: Numbers,
    cones: Checked[Sequence[FrictionCone]],
    *,
    preload: Numbers = 0.0,
    target: Numbers | None = None,
    weights: Numbers | None = None,
    tol: float | None = None,
) -> QPSolution:
    r"""Contact forces closest to `target` that exert a wrench, with all margins at least `preload`.

    $$\min_f \tfrac12 (f - f_0)^T \operatorname{diag}(\mathrm{weights}) (f - f_0)
    \quad \text{with} \quad G f = \mathrm{wrench}, \quad \mathrm{margins}(f) \ge \mathrm{preload}$$

    A second-order cone program, by `solve_qp`: batched, and differentiable in G, the wrench, the friction coefficients and
    all other arguments. Rows of G may be dependent, as for a grasp that cannot resist every wrench.

    **Arguments:**

    - `G` (p, m): grasp map. `wrench` (p,): the resultant of the contact forces on the object; to hold it against gravity,
      minus its weight; N and N m.
    - `cones`: one per contact, in the order of G's columns.
    - `preload` (): N, least margin of each contact (`FrictionCone.margins`).
    - `target` $f_0$ (m,), N and N m: zero by default. `weights` (m,): positive, one by default.
    - `tol`: of `solve_qp`.

    **Returns:** `QPSolution`, with the forces in `x`; `result` is infeasible where no forces in the cones balance the wrench.

    **Raises:** ValueError for shapes that do not fit together.

    Source: Murray, Li & Sastry (1994), section 5.3; Boyd & Wegbreit, IEEE Trans. Robotics 23 (2007), 1117-1132.
    """
    G = as_float(G, "G", (None, None))
    wrench = as_float(wrench, "wrench", (G.shape[0],), G.dtype)
    if not isinstance(cones, (tuple, list)) or not all(isinstance(cone, FrictionCone) for cone in cones):
        raise ValueError(f"cones is {cones!r}; pass a list with one FrictionCone per contact, from friction_cone(...)")
    sizes = [cone.size for cone in cones]
    m = sum(sizes)
    if m != G.shape[1]:
        raise ValueError(f"cones have {sizes} components, {m} in all, and G has {G.shape[1]} columns; they must agree")
    preload = as_float(preload, "preload", (), G.dtype)
    target = jnp.zeros((m,), G.dtype) if target is None else as_float(target, "target", (m,), G.dtype)
    weights = jnp.ones((m,), G.dtype) if weights is None else as_float(weights, "weights", (m,), G.dtype)
    bounds = cone_bounds(cones, preload, G.dtype)
    # The square is expanded, without its constant.
    return solve_qp(jnp.diag(weights), -weights * target, A=G, b=wrench, tol=tol, **bounds)


def cone_bounds(cones, preload, dtype) -> dict:
    """Rows and cones of `solve_qp`, by their names there, for margins of at least `preload` in every cone.

    Forces are concatenated in the order of the cones.
    """
    sizes = [cone.size for cone in cones]
    linear, second, place = [], [], 0
    for cone, size in zip(cones, sizes, strict=True):
        sides = (place, sum(sizes) - place - size)
        linear.append(_pad_rows(cone.linear_rows().astype(dtype), sides))
        second.append(_pad_rows(cone.second_order_rows().astype(dtype), sides))
        place += size
    rows, round_rows = jnp.concatenate(linear), jnp.concatenate(second)
    # c - S x = (mu f_n - preload, fx, fy) with S = -rows: the margin enters the first component alone.
    lifted = jnp.zeros(round_rows.shape[:2], dtype).at[:, 0].set(-preload)
    bounds: dict = {"G": rows, "h": jnp.full((rows.shape[0],), -1, dtype) * preload} if rows.shape[0] else {}
    return bounds | ({"cones": [(-round_rows, lifted)]} if round_rows.shape[0] else {})


def _pad_rows(rows: Float[Array, "..."], sides) -> Float[Array, "..."]:
    """Pad rows of one contact's force to rows of all forces."""
    return jnp.pad(rows, [(0, 0)] * (rows.ndim - 1) + [sides])
