"""Contact forces of a scene and their margins from pulling and slipping, from the multipliers of its rows."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import layout
from jaxdyn.contact.cones import Cones, FrictionCone
from jaxdyn.model.arguments import Numbers, as_array, batch_hint, state_dtype
from jaxdyn.model.numbers import as_number
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
