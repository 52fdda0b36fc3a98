"""Systems given by their Lagrangian, whose equations of motion follow from L by automatic differentiation."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxdyn.compile.known import is_known
from jaxdyn.model.arguments import Checked, Function, Number, check_count
from jaxdyn.systems.scene import as_pytree
from jaxdyn.systems.system import System, as_parameter, check_mass_matrix, describe_state, evaluate_callback


class LagrangianSystem(System):
    r"""System given by its Lagrangian.

    $$\frac{d}{dt} \frac{\partial L}{\partial v} - \frac{\partial L}{\partial q} = M a + h = \tau, \quad
    M = \frac{\partial^2 L}{\partial v^2}$$

    $$h = \frac{\partial^2 L}{\partial v \partial q} v + \frac{\partial^2 L}{\partial v \partial t}
    - \frac{\partial L}{\partial q}$$

    M and h come from automatic differentiation, the first two terms of h as one derivative along the motion, so L may hold any
    coordinates, gyroscopic terms and time. L is quadratic in v. The potential energy is $-L(q, 0)$; the kinetic energy is the
    Jacobi integral $v^T \partial L / \partial v - L$ less that, so for $L = T - V$ they are T and V.

    **Arguments:**

    - `lagrangian`: L(q, v) -> () in J, or L(q, v, t, parameters) when parameters are given. A plain function is static:
      define it once.
    - `nq`: number of coordinates.
    - `parameters`: any pytree of numbers; its leaves can be differentiated and batched.
    - `potential`: V(q) -> () in J, or V(q, t, parameters), when it is given separately: the Lagrangian of the system is then
      lagrangian - V, `lagrangian` has to vanish at v = 0, and V is differentiated once instead of with the rest.

    **Raises:** ValueError for an nq that is no positive integer, a lagrangian that cannot be called, and (when used) a
    Lagrangian that does not return one number. Before a motion from concrete numbers is computed (`forward_dynamics`,
    `simulate`): for a Lagrangian that is not finite there, reads coordinates beyond nq, is not quadratic in v, or is
    degenerate (M not positive definite; its rank is named).

    Source: EQUATIONS sections 0 and 1.

    ```python
    pendulum = jd.LagrangianSystem(lambda q, v: 0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0]), 1)
    ```
    """

    lagrangian: Callable
    nq: int = eqx.field(static=True)
    parameters: Any = None
    potential: Callable | None = None

    def __init__(
        self, lagrangian: Function, nq: Checked[int], *, parameters: PyTree = None, potential: Function | None = None
    ):
        self.nq = check_count(nq, "nq")
        more = "" if parameters is None else ", t, parameters"
        self.lagrangian = as_pytree(lagrangian, "lagrangian", "q, v" + more)
        self.potential = None if potential is None else as_pytree(potential, "potential", "q" + more)
        # Python numbers become arrays: a leaf must be differentiable, and its value must not be compiled in.
        self.parameters = jax.tree.map(as_parameter, parameters)

    def value(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""]:
        """Lagrangian L(q, v, t), (), J, less a separate potential."""
        value = self._lagrangian_value(q, v, t)
        return value if self.potential is None else value - self._potential_value(q, t)

    def _lagrangian_value(self, q, v, t):
        return evaluate_callback(self.lagrangian, (), "lagrangian", (q, v), t, self.parameters)

    def _potential_value(self, q, t):
        return evaluate_callback(self.potential, (), "potential", (q,), t, self.parameters)

    def _momentum(self, q, v, t):
        # Differentiating the momentum once more gives M and h with one reverse and one forward pass, without a Hessian
        # of (q, v).
        return jax.grad(self._lagrangian_value, argnums=1)(q, v, t)

    def mass_matrix(self, q: Float[Array, " nq"], t: Number) -> Float[Array, "nv nv"]:
        """Mass matrix (nv, nv) at v = 0."""
        # L is quadratic in v (checked at the start), so that M does not depend on v; v = 0 needs the fewest operations.
        return jax.jacfwd(self._momentum, argnums=1)(q, jnp.zeros_like(q), t)

    def bias_force(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " nv"]:
        """Bias force (nv,), the left-hand side of the Lagrange equations at zero acceleration."""
        if self.parameters is None:  # then L does not depend on t
            _, rate = jax.jvp(lambda q: self._momentum(q, v, t), (q,), (v,))
        else:
            _, rate = jax.jvp(lambda q, t: self._momentum(q, v, t), (q, t), (v, jnp.ones_like(t)))
        force = rate - jax.grad(self._lagrangian_value)(q, v, t)
        return force if self.potential is None else force + jax.grad(self._potential_value)(q, t)

    def gravity_force(self, q: Float[Array, " nq"], t: Number) -> Float[Array, " nv"]:
        """Gravity force dV/dq of a separate potential, else the bias force at rest, (nv,)."""
        return super().gravity_force(q, t) if self.potential is None else jax.grad(self._potential_value)(q, t)

    def coriolis_matrix(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, "nv nv"]:
        """Coriolis matrix (nv, nv): that of the Christoffel symbols, plus that of terms linear in v.

        $C v = h(v) - h(0)$. The latter matrix is skew where M does not depend on t: gyroscopic forces of terms of L linear in v.
        """
        # h is quadratic in v: half of its derivative is the symbols' matrix plus half of the linear terms' matrix.
        derivative = jax.jacfwd(self.bias_force, argnums=1)
        return 0.5 * (derivative(q, v, t) + derivative(q, jnp.zeros_like(v), t))

    def kinetic_energy(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""]:
        r"""Kinetic energy (), J.

        $$v^T \frac{\partial L}{\partial v} - L(q, v) + L(q, 0)$$
        """
        # Terms of L linear in v cancel in the Jacobi integral: gyroscopic terms hold no energy.
        energy = jnp.sum(v * self._momentum(q, v, t)) - self._lagrangian_value(q, v, t)
        return energy if self.potential is not None else energy + self._lagrangian_value(q, jnp.zeros_like(v), t)

    def potential_energy(self, q: Float[Array, " nq"], t: Number) -> Float[Array, ""]:
        """Potential energy -L(q, 0), or the separate V, (), J."""
        return (
            -self._lagrangian_value(q, jnp.zeros_like(q), t) if self.potential is None else self._potential_value(q, t)
        )

    def check_start(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> None:
        """Check the start as for any system, and that L is finite, fits nq, and is quadratic in v."""
        if not is_known(self, q, v, t):
            return
        place = describe_state(q, t, v)
        # First, since an index beyond nq is clamped by JAX and would give a finite L of wrong coordinates.
        self._check_coordinates(q, v, t)
        value, rest, mass, shifted = (np.asarray(x, float) for x in _probe(self, q, v, t))
        if not np.isfinite(value):
            raise ValueError(f"lagrangian is {value} at {place}; start where it is finite, or write it without a pole")
        # Relative to the largest term: rounding of L at rest is not a kinetic term.
        if self.potential is not None and abs(rest) > 1e-6 * (abs(value) + np.abs(mass).max()):
            raise ValueError(
                f"lagrangian is {rest:.6g} at rest at {place}, but with potential= it must vanish there; move the "
                "terms without v into potential"
            )
        check_mass_matrix(mass, "LagrangianSystem", q, t)
        # A loose bound: it is to find terms such as sqrt(1 - v^2), not rounding of a second derivative.
        if not np.abs(shifted - mass).max() <= 1e-3 * np.abs(mass).max():
            raise ValueError(
                f"lagrangian is not quadratic in v at {place}: d2L/dv2 is {mass.tolist()} at v = 0 and "
                f"{shifted.tolist()} at v + 1; give the equations of motion as a jd.ExplicitSystem"
            )

    def _check_coordinates(self, q, v, t):
        # jax clamps an index that is too large; numpy refuses it.
        state = [np.asarray(x) for x in (q, v)]
        given = state if self.parameters is None else [*state, t, self.parameters]
        try:
            # A pole at this state is reported by the check of L itself.
            with np.errstate(all="ignore"):
                # Inside of `eval_shape` jax operations compute nothing, and indexing of numpy arrays is still checked.
                jax.eval_shape(lambda: self.lagrangian(*given))
        except (IndexError, ValueError) as error:
            raise ValueError(f"lagrangian does not fit nq = {self.nq}: {error}; pass the number it reads") from error
        except (TypeError, AttributeError):
            return  # it needs arrays of jax (`.at`, or their dtypes), so that its coordinates cannot be checked


@eqx.filter_jit
def _probe(system: LagrangianSystem, q, v, t):
    """Values for the checks of a start: L, L without the potential at rest, and d2L/dv2 at v = 0 and at v + 1."""
    hessian = jax.jacfwd(system._momentum, argnums=1)
    zero = jnp.zeros_like(v)
    return system.value(q, v, t), system._lagrangian_value(q, zero, t), hessian(q, zero, t), hessian(q, v + 1, t)
