"""Pseudo-inertias of the bodies in canonical frames, with masses on joint axes transferred to the parent.

The pseudo-inertia of a body is the 4 x 4 matrix of its moments up to the second, the sum of m (r, 1)(r, 1)^T: the second
moments, the first moment, the mass. A mass on the axis of a revolute joint moves in the same way whether it belongs to the
body or to its parent, so such masses can be transferred without changing the equations of motion. The remaining ones are
the base parameters of the mechanism (Gautier & Khalil 1990), with up to four zeros out of ten numbers. Neither the mass
matrix nor the pivots of its factorisation change: a transferred inertia annihilates the joint's motion subspace.
"""

import jax.numpy as jnp
import numpy as np

from jaxdyn.dynamics.recursions._arrays import is_known
from jaxdyn.dynamics.recursions.frames import Frames
from jaxdyn.model.tree import Model

# Moments (rows and columns x, y, z, 1 of the pseudo-inertia) that move with the parent as much as with the body.
_Z = np.diag([False, False, True, False])
SHARED = {
    "revolute": np.outer([False, False, True, True], [False, False, True, True]),
    "continuous": np.outer([False, False, True, True], [False, False, True, True]),
    "prismatic": np.outer([True, True, True, False], [True, True, True, False]),
    "helical": _Z,
    "planar": _Z,
    "spherical": np.diag([False, False, False, True]),
    "free": np.zeros((4, 4), bool),
}


def _moments() -> np.ndarray:
    """Tensor (4, 4, 10): pseudo-inertia from (m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz); second moments are tr(I)/2 - I."""
    tensor = np.zeros((4, 4, 10))
    tensor[3, 3, 0] = 1
    for i in range(3):
        tensor[i, 3, 1 + i] = tensor[3, i, 1 + i] = 1
        for place in (4, 6, 9):
            tensor[i, i, place] = 0.5
    for place, (i, j) in {4: (0, 0), 5: (0, 1), 6: (1, 1), 7: (0, 2), 8: (1, 2), 9: (2, 2)}.items():
        # A set, since a diagonal entry has one place and not two.
        for r, c in {(i, j), (j, i)}:
            tensor[r, c, place] -= 1
    return tensor


def pseudo_inertias(model: Model, frames: Frames) -> list:
    """Pseudo-inertias (4, 4) of the bodies in their canonical frames (kg, kg m, kg m^2), numpy arrays where they are known.

    Masses are transferred between bodies only if all values are known, where that costs nothing.
    """
    known = is_known(model.inertias, frames.placement)
    xp = np if known else jnp
    dtype = model.home.dtype
    inertias = xp.asarray(model.inertias)
    total = xp.einsum("ijk,nk->nij", xp.asarray(_moments(), dtype), inertias)
    placement = frames.placement
    turned = xp.swapaxes(placement[:, :3, :3], 1, 2)
    # Pseudo-inertias transform by congruence with the homogeneous matrix: J' = T J T^T.
    to_frame = xp.concatenate([xp.concatenate([turned, -turned @ placement[:, :3, 3:]], 2), placement[:, 3:]], 1)
    total = to_frame @ total @ xp.swapaxes(to_frame, 1, 2)
    if not known:
        return [total[i] for i in range(model.nb)]
    return _transfer_to_parents(model, total.astype(float), frames.home.astype(float), dtype)


def _transfer_to_parents(model: Model, total, home, dtype) -> list:
    # From the leaves to the root, so that a transferred mass can be transferred again.
    for i in reversed(range(model.nb)):
        shared = np.where(SHARED[model.topology.kinds[i]], total[i], 0)
        total[i] = np.where(SHARED[model.topology.kinds[i]], 0, total[i])
        parent = model.topology.parents[i]
        if parent >= 0:
            total[parent] += home[i] @ shared @ home[i].T
    # Congruences are symmetric to rounding only; the recursions read one triangle.
    symmetric = 0.5 * (total + np.swapaxes(total, 1, 2))
    return [x.astype(dtype) for x in symmetric]
