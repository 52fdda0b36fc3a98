"""Joint friction and rotor inertia: the part of the joint torque that is not the links', and its regressor.

tau_f = viscous v + coulomb tanh(v / v_s) + offset, and armature a for the rotors.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.model.arguments import Number, SystemLike

TERMS = ("viscous", "coulomb", "offset", "armature")
# Terms that are physical only when they are not negative.
POSITIVE = ("viscous", "coulomb", "armature")


if TYPE_CHECKING:
    Terms = str | Sequence[str]  # names of `TERMS`
else:
    Terms = Any  # `check_terms` looks at them


class Friction(eqx.Module):
    """Torque that a joint's friction takes from the motor: tau_f = viscous v + coulomb tanh(v / v_s) + offset.

    Called as a force of a scene, `friction(system, q, v, t)`, it gives -tau_f. The offset (N m) is a constant of the
    measurement (sensor bias, cable) or of asymmetric dry friction.

    - `viscous` (nv,) N m s/rad, `coulomb` (nv,) N m, `offset` (nv,) N m; for prismatic joints N s/m, N, N.
    - `v_s`: velocity at which the smoothed Coulomb friction has 76 % of its level (rad/s or m/s).
    """

    viscous: Float[Array, " nv"]
    coulomb: Float[Array, " nv"]
    offset: Float[Array, " nv"]
    v_s: Float[Array, ""]

    def torque(self, v: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """tau_f (nv,) at the velocity v (nv,)."""
        return self.viscous * v + self.coulomb * jnp.tanh(v / self.v_s) + self.offset

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        return -self.torque(v)


def friction_regressor(v: Float[Array, " nv"], a: Float[Array, " nv"], terms, v_s) -> Float[Array, "nv terms_nv"]:
    """Regressor of friction and rotors, (nv, nv * len(terms)): one diagonal block per term, in the order of `terms`."""
    columns = {"viscous": v, "coulomb": jnp.tanh(v / v_s), "offset": jnp.ones_like(v), "armature": a}
    blocks = [jnp.diag(columns[term]) for term in terms]
    return jnp.concatenate(blocks, axis=1) if blocks else jnp.zeros((v.shape[0], 0), v.dtype)


def check_terms(terms: Terms, v_s: Number) -> tuple[str, ...]:
    """The terms as a tuple. **Raises:** ValueError for an unknown or repeated term, or a v_s that is not positive."""
    terms = (terms,) if isinstance(terms, str) else tuple(terms)
    unknown = [term for term in terms if term not in TERMS]
    if unknown or len(set(terms)) < len(terms):
        raise ValueError(f"terms is {terms}; take some of {TERMS}, each once")
    if not v_s > 0:
        raise ValueError(f"v_s is {v_s}; give a positive smoothing velocity, e.g. 0.01 rad/s")
    return terms
