"""Kinds of contacts, and the components of a wrench that each of them transmits."""

import numpy as np
from jaxtyping import Float

from jaxdyn.model.arguments import check_flag

# Components (fx, fy, fz, tx, ty, tz) of a wrench that each contact transmits.
_SPATIAL = {
    "frictionless": (2,),
    "hard-finger": (0, 1, 2),
    "soft-finger": (0, 1, 2, 5),
    "rigid": (0, 1, 2, 3, 4, 5),
}
# In the x-z plane: forces along x and z, and the torque about y.
_IN_PLANE = {"frictionless": (2,), "hard-finger": (0, 2), "rigid": (0, 2, 4)}


def components(kind: str, in_plane: bool, what: str) -> tuple[int, ...]:
    """Indices of the transmitted components. **Raises:** ValueError for an unknown kind, naming `what`."""
    kinds = _IN_PLANE if check_flag(in_plane, f"{what}: in_plane") else _SPATIAL
    if not isinstance(kind, str) or kind not in kinds:
        hint = "; in a plane a soft finger is a hard one" if isinstance(kind, str) and kind in _SPATIAL else ""
        raise ValueError(f"{what}: kind {kind!r} is unknown; choose from {', '.join(kinds)}{hint}")
    return kinds[kind]


def wrench_basis(kind: str, *, in_plane: bool = False) -> Float[np.ndarray, "6 m"]:
    """Wrench basis B (6, m) of a contact: its columns are the wrenches (f, tau) that it transmits.

    | kind         | m | B in the contact frame                   | m and rows in a plane |
    |--------------|---|------------------------------------------|-----------------------|
    | frictionless | 1 | force along z                            | 1: fz                 |
    | hard-finger  | 3 | all forces: a point with friction        | 2: fx, fz             |
    | soft-finger  | 4 | all forces, torque about z               |                       |
    | rigid        | 6 | all                                      | 3: fx, fz, ty         |

    The contact frame's z is the normal into the object, and its x-z plane is the plane of a planar mechanism.

    **Raises:** ValueError for an unknown kind.

    Source: Murray, Li & Sastry (1994), table 5.2; EQUATIONS section 10.
    """
    return np.eye(6)[:, list(components(kind, in_plane, "contact"))]
