"""Systems beside `Model`: given by a Lagrangian, or by their mass matrix and bias force.

Both have as many velocities as coordinates, v = dq/dt. They are taken wherever a `Model` is taken that needs no bodies:
`mass_matrix`, `bias_force`, `forward_dynamics`, energies, constraints, `simulate`.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from jaxdyn.model import Model, configuration_rate, integrate, normalize
from jaxdyn.scene import as_pytree
from jaxdyn.so3 import _product


class System(eqx.Module):
    """What the dynamics need of a system in coordinates with v = dq/dt: M(q, t) and h(q, v, t)."""

    nq: eqx.AbstractVar[int]

    @property
    def nv(self) -> int:
        """Number of velocity coordinates, equal to nq."""
        return self.nq

    @abc.abstractmethod
    def mass_matrix(self, q, t) -> Array:
        """M(q, t), (nv, nv), symmetric."""

    @abc.abstractmethod
    def bias_force(self, q, v, t) -> Array:
        """h(q, v, t) in M a + h = tau, (nv,)."""

    @abc.abstractmethod
    def kinetic_energy(self, q, v, t) -> Array:
        """Kinetic energy, (), J."""

    @abc.abstractmethod
    def potential_energy(self, q, t) -> Array:
        """Potential energy, (), J."""

    def gravity_force(self, q, t):
        """Bias force at rest, (nv,)."""
        return self.bias_force(q, jnp.zeros_like(q), t)

    def coriolis_matrix(self, q, v, t):
        """C_ij = sum_k Gamma_ijk v_k with the Christoffel symbols of M, (nv, nv): dM/dt = C + C^T for constant t."""
        derivative = jax.jacfwd(self.mass_matrix)(q, t)
        rate = jnp.einsum("ijk,k->ij", derivative, v)
        turned = jnp.einsum("ikj,k->ij", derivative, v)
        return 0.5 * (rate + turned - turned.T)

    def inverse_dynamics(self, q, v, a, t):
        """M a + h, (nv,)."""
        return _product(self.mass_matrix(q, t), a) + self.bias_force(q, v, t)

    def forward_dynamics(self, q, v, tau, t):
        """M^-1 (tau - h), (nv,)."""
        factor = jnp.linalg.cholesky(self.mass_matrix(q, t))
        return cho_solve((factor, True), tau - self.bias_force(q, v, t))


class LagrangianSystem(System):
    """A system given by its Lagrangian: d/dt dL/dv - dL/dq = tau.

    M = d2L/dv2 and h = d(dL/dv)/dq v + d(dL/dv)/dt - dL/dq come from automatic differentiation, so L may hold any
    coordinates, gyroscopic terms and time. The potential energy is -L(q, 0); the kinetic energy is what the Jacobi
    integral v . dL/dv - L adds to it, so for L = T - V they are T and V.

    **Arguments:**

    - `lagrangian`: L(q, v) -> () in J, or L(q, v, t, parameters) when parameters are given. A plain function is static:
      define it once.
    - `nq`: number of coordinates.
    - `parameters`: any pytree of numbers; its leaves can be differentiated and batched.

    **Raises:** ValueError for an nq that is no positive integer, a lagrangian that cannot be called, and (when used) a
    Lagrangian that does not return one number.

    ```python
    pendulum = jd.LagrangianSystem(lambda q, v: 0.5 * v[0] ** 2 + 9.81 * jnp.cos(q[0]), 1)
    ```
    """

    lagrangian: Callable
    nq: int = eqx.field(static=True)
    parameters: Any = None

    def __init__(self, lagrangian, nq, *, parameters=None):
        self.lagrangian = as_pytree(lagrangian, "lagrangian")
        self.nq = _checked_size(nq)
        self.parameters = jax.tree.map(_number, parameters)

    def _value(self, q, v, t):
        arguments = (q, v) if self.parameters is None else (q, v, t, self.parameters)
        value = self.lagrangian(*arguments)
        if jnp.shape(value) != ():
            raise ValueError(f"lagrangian returned shape {jnp.shape(value)}; return one number, ()")
        return jnp.asarray(value, q.dtype)

    def _momentum(self, q, v, t):
        return jax.grad(self._value, argnums=1)(q, v, t)

    def mass_matrix(self, q, t):
        """M = d2L/dv2 at v = 0, (nv, nv)."""
        return jax.jacfwd(self._momentum, argnums=1)(q, jnp.zeros_like(q), t)

    def bias_force(self, q, v, t):
        """h = d(dL/dv)/dq v + d(dL/dv)/dt - dL/dq, (nv,)."""
        _, rate = jax.jvp(lambda q, t: self._momentum(q, v, t), (q, t), (v, jnp.ones_like(t)))
        return rate - jax.grad(self._value)(q, v, t)

    def kinetic_energy(self, q, v, t):
        """v . dL/dv - L(q, v) + L(q, 0), (), J."""
        rest = self._value(q, jnp.zeros_like(v), t)
        return jnp.sum(v * self._momentum(q, v, t)) - self._value(q, v, t) + rest

    def potential_energy(self, q, t):
        """-L(q, 0), (), J."""
        return -self._value(q, jnp.zeros_like(q), t)


class ExplicitSystem(System):
    """A system given by its equations of motion: M(q) a + h(q, v) = tau.

    **Arguments:**

    - `mass_matrix`: M(q) -> (nq, nq), symmetric positive definite; or M(q, t, parameters) when parameters are given.
    - `bias_force`: h(q, v) -> (nq,); or h(q, v, t, parameters).
    - `nq`: number of coordinates.
    - `parameters`: any pytree of numbers; its leaves can be differentiated and batched.
    - `potential`: V(q) -> () in J, or V(q, t, parameters), for energies; None when there is none to report.

    **Raises:** ValueError for an nq that is no positive integer, functions that cannot be called, and (when used) for
    results of a wrong shape or a potential energy that was not given.
    """

    _mass_matrix: Callable
    _bias_force: Callable
    nq: int = eqx.field(static=True)
    parameters: Any = None
    _potential: Callable | None = None

    def __init__(self, mass_matrix, bias_force, nq, *, parameters=None, potential=None):
        self._mass_matrix = as_pytree(mass_matrix, "mass_matrix")
        self._bias_force = as_pytree(bias_force, "bias_force")
        self._potential = None if potential is None else as_pytree(potential, "potential")
        self.nq = _checked_size(nq)
        self.parameters = jax.tree.map(_number, parameters)

    def _call(self, function, shape, name, t, *state):
        value = function(*state) if self.parameters is None else function(*state, t, self.parameters)
        if jnp.shape(value) != shape:
            raise ValueError(f"{name} returned shape {jnp.shape(value)}, expected {shape} for nq = {self.nq}")
        return jnp.asarray(value, state[0].dtype)

    def mass_matrix(self, q, t):
        """M as given, (nv, nv)."""
        return self._call(self._mass_matrix, (self.nq, self.nq), "mass_matrix", t, q)

    def bias_force(self, q, v, t):
        """h as given, (nv,)."""
        return self._call(self._bias_force, (self.nq,), "bias_force", t, q, v)

    def kinetic_energy(self, q, v, t):
        """v . M v / 2, (), J."""
        return 0.5 * jnp.sum(v * _product(self.mass_matrix(q, t), v))

    def potential_energy(self, q, t):
        """V as given, (), J. **Raises:** ValueError when it was not."""
        if self._potential is None:
            raise ValueError("this ExplicitSystem has no potential energy; pass potential= when making it")
        return self._call(self._potential, (), "potential", t, q)


def checked_time(system: System, t, external=None, **arguments) -> Array:
    """The time in the dtype of the state, after a check of the shapes of `arguments`, each (nq,) = (nv,).

    **Raises:** ValueError that names the argument; also for `external`, as there are no bodies.
    """
    if external is not None:
        raise ValueError(f"external holds wrenches on bodies, and a {type(system).__name__} has none; add them to tau")
    for name, value in arguments.items():
        if jnp.shape(value) != (system.nq,):
            hint = "; functions take one sample, use jax.vmap for a batch" if jnp.ndim(value) == 2 else ""
            raise ValueError(f"{name} has shape {jnp.shape(value)}, expected {(system.nq,)} of the system{hint}")
    return jnp.asarray(t, arguments["q"].dtype)


def velocity_to_rate(system, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """dq/dt (nq,) for the velocity v of any system: H(q) v for a `Model`, else v."""
    return configuration_rate(system, q, v) if isinstance(system, Model) else v


def displace(system, q: Float[Array, " nq"], step: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Configuration reached from q by the displacement `step` (nv,) of any system, on the manifold of a `Model`."""
    return integrate(system, q, step) if isinstance(system, Model) else q + step


def has_quaternions(system) -> bool:
    """Whether q holds numbers that must stay on a unit sphere."""
    return isinstance(system, Model) and any(kind in ("spherical", "free") for kind in system.topology.kinds)


def retract(system, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """q with unit quaternions, of any system."""
    return normalize(system, q) if has_quaternions(system) else q


def _checked_size(nq) -> int:
    if isinstance(nq, bool) or not isinstance(nq, int) or nq < 1:
        raise ValueError(f"nq is {nq!r}; pass the number of coordinates, a positive integer")
    return nq


def _number(leaf):
    """A Python number as a float array, so that it is a leaf that can be differentiated; anything else as it is."""
    return jnp.asarray(leaf, float) if isinstance(leaf, (int, float)) and not isinstance(leaf, bool) else leaf
