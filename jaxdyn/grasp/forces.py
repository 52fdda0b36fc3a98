"""The force of each contact of a grasp, and its margin from slipping, from the multipliers of the grasp's rows."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.constraints.base import layout
from jaxdyn.constraints.rolling import RollingSphere, RollingWheel
from jaxdyn.contact.cones import FrictionCone
from jaxdyn.grasp.contacts import Contact
from jaxdyn.grasp.hand import Grasp, check_grasp
from jaxdyn.model.arguments import as_array, batch_hint, state_dtype


class ContactForces(eqx.Module):
    """Forces of all contacts on the object and how far they are from leaving their cones.

    - `forces`: by the contact's name, (m,), along the columns of its wrench basis, the normal into the object; N and N m.
    - `margins`: by name, (), the cone's margin: positive while the contact neither pulls nor slips.
    - `margin` (): the least of them.
    """

    forces: dict[str, Float[Array, "..."]]
    margins: dict[str, Float[Array, "..."]]
    margin: Float[Array, "..."]


def contact_forces(grasp: Grasp, multipliers: Float[Array, " nc"], cones, smoothing: Any = 0.0) -> ContactForces:
    """The force of each contact, and its margin in its friction cone.

    **Arguments:**

    - `multipliers` (nc,): of the grasp's rows: `.multipliers` of `jd.constrained_dynamics`, `.contact_forces` of
      `object_dynamics`, or one sample of a solution's.
    - `cones`: a `FrictionCone` for all contacts, a list with one per contact, or a dictionary by name.
    - `smoothing`: N, of `FrictionCone.margin`.

    **Returns:** `ContactForces`.

    **Raises:** ValueError for another number of multipliers, contacts without a cone, cones of another kind than their
    contact, and constraints that are no contacts with an object.

    Source: Murray, Li & Sastry (1994), section 5.2; the cone is to be tested on all of lam (EQUATIONS section 10).
    """
    check_grasp(grasp)
    multipliers = as_array(multipliers, "multipliers", state_dtype(grasp.system))
    places = layout(grasp)
    if multipliers.shape != (places[-1].end,):
        raise ValueError(
            f"multipliers has shape {multipliers.shape}, expected ({places[-1].end},), one per row of the grasp"
            f"{batch_hint(multipliers, (1,))}"
        )
    names = [place.name for place in places]
    chosen = _by_name(cones, names)
    forces, margins = {}, {}
    for constraint, place in zip(grasp.constraints, places, strict=True):
        cone, order = chosen[place.name], np.array(_order(constraint, place.name))
        if cone.size != len(order):
            raise ValueError(
                f"cone of contact {place.name!r} is of kind {cone.kind!r} with {cone.size} components, the contact has "
                f"{len(order)}; give the cone of the contact's kind"
            )
        forces[place.name] = multipliers[place.start : place.end][order]
        margins[place.name] = cone.margin(forces[place.name], smoothing)
    return ContactForces(forces, margins, jnp.min(jnp.stack(list(margins.values()))))


def _by_name(cones, names) -> dict[str, FrictionCone]:
    if isinstance(cones, FrictionCone):
        return dict.fromkeys(names, cones)
    if isinstance(cones, (tuple, list)):
        if len(cones) != len(names):
            raise ValueError(f"cones has {len(cones)} entries for the {len(names)} contacts {names}; give one for each")
        cones = dict(zip(names, cones, strict=True))
    if not isinstance(cones, dict) or set(cones) != set(names):
        shown = list(cones) if isinstance(cones, dict) else cones
        raise ValueError(f"cones is {shown!r}; give a FrictionCone, one per contact, or a dictionary with {names}")
    for name, cone in cones.items():
        if not isinstance(cone, FrictionCone):
            raise ValueError(f"cone of contact {name!r} is {cone!r}; take jd.contact.friction_cone(...)")
    return cones


def _order(constraint, name: str) -> tuple[int, ...]:
    """Where the components of the wrench basis stand in the constraint's rows."""
    if isinstance(constraint, Contact):
        return tuple(range(len(constraint.components)))
    # Rolling contacts have the normal row first, then those that do not slip, then the one that does not spin.
    if isinstance(constraint, (RollingSphere, RollingWheel)) and constraint.contact:
        slips = constraint.count
        return (*range(1, 1 + slips), 0, *((1 + slips,) if constraint.spin else ()))
    raise ValueError(
        f"constraint {name!r} is a {type(constraint).__name__} without a normal force; it has no friction cone"
    )
