"""Recursions over a tree of rigid bodies, in link frames, written with 3-vectors, 6-vectors and small matrices.

| module             | equations                                                                                    |
|--------------------|----------------------------------------------------------------------------------------------|
| `frames`           | canonical link frames (joint axis on z, Denavit-Hartenberg) and masses transferred between bodies    |
| `transforms`       | changes of frame of twists, wrenches and inertias; products by numpy or by the traced program |
| `links`            | joint transforms and motion subspaces of every joint kind                                    |
| `newton_euler`     | recursive Newton-Euler, composite bodies, articulated-body inertias: M = W W^T, and M^-1 times a vector |
| `sweeps`           | the same for many bodies, as loops whose code does not grow with their number                 |

EQUATIONS sections 4 and 5; Featherstone (2008), chapters 5 to 7. Twists are (v, omega) and wrenches (f, n), linear part first.

The functions are written to be expanded to scalar programs by `jaxdyn.compile`, where a known 0 or 1 costs nothing. They also
run unexpanded, slowly. Leaves of the model whose values are known while tracing become numpy arrays, so that their
zeros are known; of traced leaves only the zeros declared by the topology are used (joint kinds, gravity or armature None).

This package imports `jaxdyn.compile`, the Lie groups and `jaxdyn.model.tree`. It checks, and is checked by,
`jaxdyn.dynamics.world_frame` and `jaxdyn.dynamics.scans`, and imports neither.
"""

from jaxdyn.dynamics.recursions.newton_euler import aba as aba
from jaxdyn.dynamics.recursions.newton_euler import acceleration_and_inverse as acceleration_and_inverse
from jaxdyn.dynamics.recursions.newton_euler import bias_force as bias_force
from jaxdyn.dynamics.recursions.newton_euler import crba as crba
from jaxdyn.dynamics.recursions.newton_euler import gravity_force as gravity_force
from jaxdyn.dynamics.recursions.newton_euler import mass_matrix_sqrt as mass_matrix_sqrt
from jaxdyn.dynamics.recursions.newton_euler import rnea as rnea
