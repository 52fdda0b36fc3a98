"""How stiff a scene is: the rates of its linearised motion."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.arguments import check_state
from jaxdyn.compile import compiled, is_known
from jaxdyn.constrained import constrained_dynamics
from jaxdyn.dynamics import gravity_force, mass_matrix
from jaxdyn.linear import solve_positive
from jaxdyn.model import Model
from jaxdyn.scene import Scene, as_pytree, as_scene, checked_force
from jaxdyn.so3 import _product
from jaxdyn.systems import displace

# Explicit methods are stable for real decays up to 2.8 (RK4), 3.3 (Dopri5) and 5.2 (Dopri8) over the step.
EXPLICIT_STABILITY = 5.0


class Stiffness(NamedTuple):
    """Rates of a linearised motion: `decay`, 1/s, the fastest at which anything dies out; `frequency`, rad/s, the fastest at
    which anything oscillates.
    """

    decay: Float[Array, "..."]
    frequency: Float[Array, "..."]

    @property
    def explicit_step(self) -> Array:
        """Length (s) above which steps of Dopri8 are unstable, whatever the tolerance; infinite without decay.

        Other explicit methods are so earlier: RK4, Dopri5 and Tsit5 from 0.56, 0.66 and 0.70 of it on.
        """
        decay = jnp.asarray(self.decay)
        slow = decay <= 0
        return jnp.where(slow, jnp.inf, EXPLICIT_STABILITY / jnp.where(slow, jnp.ones_like(decay), decay))


def stiffness(scene: Any, q: Any, v: Any, t: Any = 0.0, control: Any = None) -> Stiffness:
    """Fastest rates of the motion M da + D dv + K dq = 0 near a state, D = -df/dv and K = -df/dq.

    f is the sum of the scene's forces, of `control(q, v, t)` and, for a system that is not a `Model`, of -dV/dq. What
    velocity does through inertia and the gravity of a `Model` are left out, as neither makes a motion stiff. dq is along the
    manifold. On constraints da, dv and dq are projected on their tangent space in the mass metric; the change of the rows
    along dq is left out.

    **Arguments:** `scene`, a `Scene` or a system; `q` (nq,); `v` (nv,); `t`, s.

    **Raises:** ValueError for wrong shapes, and where forces or masses are not finite (NaN where numbers are traced).

    **Returns:** `Stiffness`, from the eigenvalues of [[0, 1], [-M^-1 K, -M^-1 D]]. An explicit method needs steps below
    `explicit_step`; where the motion itself would allow much longer ones, it is stiff.

    Source: Hairer & Wanner 1996, section IV.2.

    ```python
    rates = jd.stiffness(jd.Scene(model, forces=(jd.JointDamping(1e3),)), q, v)
    ```
    """
    scene = as_scene(scene)
    control = None if control is None else as_pytree(control, "control")
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    matrix = _linearised(scene, q, v, t, control)
    if is_known(matrix):
        # LAPACK by numpy, which compiles nothing.
        known = np.asarray(matrix, float)
        if not np.isfinite(known).all():
            raise ValueError(f"forces or masses are not finite at q = {q}, v = {v}, t = {t}; look at another state")
        values = np.linalg.eigvals(known)
    else:
        values = jnp.linalg.eigvals(matrix)
    fastest = (jnp.max(jnp.asarray(x), initial=0.0) for x in (-values.real, values.imag))
    return Stiffness(*(x.astype(q.dtype) for x in fastest))


@compiled
def _linearised(scene: Scene, q, v, t, control) -> Float[Array, "n n"]:
    """The matrix (2 nv, 2 nv) of d(dq, dv)/dt."""
    system, n = scene.system, scene.nv
    if n == 0:
        return jnp.zeros((0, 0), q.dtype)

    def force(dq, dv):
        at, speed = displace(system, q, dq), v + dv
        total = scene.applied_force(at, speed, t)
        total = jnp.zeros_like(v) if total is None else total
        if not isinstance(system, Model):
            total = total - gravity_force(system, at, t)
        return total if control is None else total + checked_force(control(at, speed, t), q, n, "control")

    mass = mass_matrix(system, q, t)
    unit = jnp.eye(n, dtype=mass.dtype)
    if scene.constraints:
        bare = Scene(system, scene.constraints)
        inverse = jax.jacfwd(lambda f: constrained_dynamics(bare, q, v, f, t).acceleration)(jnp.zeros_like(v))
        tangent = _product(inverse, mass)
    else:
        inverse, tangent = solve_positive(mass, unit), unit
    by_place, by_speed = jax.jacfwd(force, (0, 1))(jnp.zeros_like(v), jnp.zeros_like(v))
    pull = _product(inverse, jnp.concatenate([_product(by_place, tangent), _product(by_speed, tangent)], 1))
    return jnp.concatenate([jnp.concatenate([jnp.zeros_like(tangent), tangent], 1), pull])
