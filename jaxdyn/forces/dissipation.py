"""Dissipative forces: Rayleigh's dissipation function, and Coulomb friction for sliding in a given direction."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxdyn.forces.piecewise import PiecewiseForce
from jaxdyn.model.arguments import Checked, Function, Number, Numbers, SystemLike, is_concrete
from jaxdyn.model.numbers import as_float
from jaxdyn.systems.scene import as_pytree


class RayleighDissipation(eqx.Module):
    r"""Dissipative force of a dissipation function R.

    $$\tau = -\frac{\partial R}{\partial v}$$

    The dissipated power is $v^T \partial R / \partial v$: 2R where R is quadratic in v, (n + 1) R where it is of degree n + 1.

    **Arguments:** `function`, R(q, v, t) -> () in W, differentiable; a plain function is static, a Module or
    `jax.tree_util.Partial` carries numbers as leaves.

    **Raises:** ValueError for a function that cannot be called; (when called) one that does not return one number.

    Source: Goldstein, Classical Mechanics, section 1.5.
    """

    function: Callable

    def __init__(self, function: Function):
        self.function = as_pytree(function, "RayleighDissipation: function", "q, v, t")

    def __call__(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        def value(v):
            R = self.function(q, v, t)
            if jnp.shape(R) != ():
                raise ValueError(f"RayleighDissipation: function returned shape {jnp.shape(R)}; return one number, ()")
            # The function may return a Python integer, which `jax.grad` refuses.
            return jnp.asarray(R, v.dtype)

        return -jax.grad(value)(v)


# Rounding of a velocity of about 100 m/s (rad/s), times eps: a sliding velocity that ends at zero within it is no reversal.
_ROUNDING = 100.0


class SlidingFriction(PiecewiseForce):
    r"""Coulomb friction of a sliding contact.

    $$\tau = -\operatorname{sign}(A v) \mu N A^T$$

    A v is the sliding velocity. At A v = 0 the sign is that of `direction`, so that the force is smooth while the contact
    slides that way and where it comes to rest. After a reversal the force opposes the new direction. Sticking is not
    modelled: fixed steps change the sign of the force from step to step, so that velocities stay as small as a step's
    change; adaptive ones end the run with the code `too_many_events`.

    **Arguments:**

    - `coefficient`: mu.
    - `normal`: N, in N, a number or a function normal(system, q, v, t) -> (); where it is negative there is no friction.
    - `direction`: 1 or -1, the sign of A v at the start and where it is zero.
    - `along`: index of the sliding coordinate, or a function A(q, t) -> (nv,).

    **Raises:** ValueError for another direction, a negative coefficient or normal force, an invalid index; (when called)
    for one beyond the system's velocities, and for shapes that do not fit.

    Source: EQUATIONS section 11 and erratum E42.
    """

    coefficient: Float[Array, ""]
    normal: Any
    direction: int = eqx.field(static=True)
    along: Any

    def __init__(
        self,
        coefficient: Numbers,
        normal: Checked[Number | Function],
        direction: int,
        along: Checked[int | Function] = 0,
    ):
        if direction not in (1, -1):
            raise ValueError(
                f"SlidingFriction: direction is {direction!r}; give the sign of the sliding velocity, 1 or -1"
            )
        if is_concrete(coefficient) and not (np.asarray(coefficient) >= 0).all():
            raise ValueError(f"SlidingFriction: coefficient is {coefficient}; give mu >= 0 and reverse direction")
        if not callable(normal) and is_concrete(normal) and not (np.asarray(normal) >= 0).all():
            raise ValueError(
                f"SlidingFriction: normal is {normal}; give the size of the normal force (N), zero or more"
            )
        if not callable(along) and (isinstance(along, bool) or not isinstance(along, int) or along < 0):
            raise ValueError(f"SlidingFriction: along is {along!r}; give an index of v or a function A(q, t) -> (nv,)")
        self.coefficient = as_float(coefficient, "SlidingFriction: coefficient")
        takes = "system, q, v, t"
        self.normal = as_pytree(normal, "SlidingFriction: normal", takes) if callable(normal) else jnp.asarray(normal)
        self.direction = direction
        self.along = as_pytree(along, "SlidingFriction: along", "q, t") if callable(along) else _Coordinate(along)

    def guards(
        self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> Float[Array, " 1"]:
        """Sliding velocity along `direction`, (1,), offset by rounding so that coming to rest is no reversal."""
        # Positive while the contact slides along `direction`, and, by the offset, where it is at rest.
        along = self.direction * jnp.sum(self._row(q, v, t) * v)
        return (along + _ROUNDING * float(jnp.finfo(v.dtype).eps))[None]

    def force(
        self,
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        positive: Bool[Array, " 1"],
    ) -> Float[Array, " nv"]:
        """Friction force (nv,) opposite to `direction` where `positive` is true, else along it."""
        row = self._row(q, v, t)
        normal: Any = self.normal(system, q, v, t) if callable(self.normal) else self.normal
        if jnp.shape(row) != v.shape or jnp.shape(normal) != ():
            raise ValueError(
                f"SlidingFriction: along gives shape {jnp.shape(row)}, normal {jnp.shape(normal)}; expected {v.shape} = "
                "(nv,) and ()"
            )
        # A contact cannot pull: a negative normal force gives no friction instead of friction of the wrong sign.
        limit = self.coefficient.astype(v.dtype) * jnp.maximum(jnp.asarray(normal, v.dtype), 0.0)
        # By the piece and not by sign(A v): within a step the force is then smooth.
        return jnp.where(positive[0], -self.direction, self.direction) * limit * row

    def _row(self, q, v, t):
        row: Any = self.along.row(v) if isinstance(self.along, _Coordinate) else self.along(q, t)
        return jnp.asarray(row, v.dtype)


# A Module and not an array: the number of velocities is known only with the system.
class _Coordinate(eqx.Module):
    """Row A that selects one velocity coordinate."""

    index: int = eqx.field(static=True)

    def row(self, v):
        """Unit row (nv,) of the coordinate."""
        if self.index >= v.shape[0]:
            raise ValueError(f"SlidingFriction: along is {self.index}, but the system has nv = {v.shape[0]}")
        return jnp.zeros_like(v).at[self.index].set(1)
