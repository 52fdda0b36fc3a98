"""Systems other than `Model`: their interface, and those given by a metric or by their equations of motion.

All have as many velocities as coordinates, v = dq/dt. They are accepted wherever a `Model` is that needs no bodies:
`mass_matrix`, `bias_force`, `forward_dynamics`, energies, constraints, `simulate`. Generalised forces are the components
of one-forms in these coordinates, with virtual work tau . dq; a scene adds its forces to them.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxdyn.compile import entry_point, kernel
from jaxdyn.compile.known import is_known
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Number, as_array, batch_hint, check_count
from jaxdyn.model.configuration import configuration_rate, difference, integrate, joint_rates, normalize
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_pytree


class System(eqx.Module):
    """Interface of a system in coordinates with v = dq/dt: M(q, t) and h(q, v, t)."""

    nq: eqx.AbstractVar[int]

    @property
    def nv(self) -> int:
        """Number of velocity coordinates, equal to nq."""
        return self.nq

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " nq"], t: Number) -> Array:
        """Mass matrix M(q, t), (nv, nv), symmetric."""

    @abc.abstractmethod
    def bias_force(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array:
        """Bias force h(q, v, t) in M a + h = tau, (nv,)."""

    def kinetic_energy(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, ""]:
        r"""Kinetic energy, (), J.

        $$T = \tfrac12 v^T M v$$
        """
        return 0.5 * jnp.sum(v * matmul(self.mass_matrix(q, t), v))

    @abc.abstractmethod
    def potential_energy(self, q: Float[Array, " nq"], t: Number) -> Array:
        """Potential energy, (), J."""

    def gravity_force(self, q: Float[Array, " nq"], t: Number) -> Float[Array, " nv"]:
        """Bias force at rest, (nv,)."""
        return self.bias_force(q, jnp.zeros_like(q), t)

    def christoffel_symbols(self, q: Float[Array, " nq"], t: Number) -> Float[Array, "nv nv nv"]:
        """Christoffel symbols Gamma_ijk = 1/2 (dM_ij/dq_k + dM_ik/dq_j - dM_kj/dq_i), of the first kind, (nv, nv, nv)."""
        return symbols(jax.jacfwd(self.mass_matrix)(q, t))

    def coriolis_matrix(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, "nv nv"]:
        """Coriolis matrix C_ij = sum_k Gamma_ijk v_k with the Christoffel symbols of M, (nv, nv).

        dM/dt = C + C^T for constant t.
        """
        derivative = jax.jacfwd(self.mass_matrix)(q, t)
        rate = jnp.einsum("ijk,k->ij", derivative, v)
        transposed = jnp.einsum("ikj,k->ij", derivative, v)
        # The skew part of the transposed term completes dM/dt = C + C^T, so that dM/dt - 2 C is skew.
        return 0.5 * (rate + transposed - transposed.T)

    def inverse_dynamics(
        self, q: Float[Array, " nq"], v: Float[Array, " nv"], a: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        """Generalised force M a + h, (nv,)."""
        return matmul(self.mass_matrix(q, t), a) + self.bias_force(q, v, t)

    def forward_dynamics(
        self, q: Float[Array, " nq"], v: Float[Array, " nv"], tau: Float[Array, " nv"], t: Number
    ) -> Float[Array, " nv"]:
        """Acceleration M^-1 (tau - h), (nv,)."""
        # The fallback is the same function by XLA, for what a kernel cannot express.
        return kernel(_acceleration, fallback=_acceleration)(self, q, v, tau, t)

    def check_start(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> None:
        """Refuse a state from which no motion can be computed; traced states are not checked.

        **Raises:** ValueError for a mass matrix that is not finite or not positive definite, with its rank.
        """
        if is_known(self, q, v, t):
            check_mass_matrix(_mass_matrix_compiled(self, q, t), type(self).__name__, q, t)


def _acceleration(system: System, q, v, tau, t):
    return solve_positive(system.mass_matrix(q, t), tau - system.bias_force(q, v, t))


class MetricSystem(System):
    r"""System given by a metric and a potential. Without a potential it moves along geodesics.

    $$L = \tfrac12 v^T M(q) v - V(q), \quad
    h = \dot M v - \tfrac12 \frac{\partial (v^T M v)}{\partial q} + \frac{\partial V}{\partial q}$$

    h takes one derivative along the motion and one gradient: neither the Christoffel symbols nor second derivatives are formed.

    **Arguments:**

    - `metric`: M(q) -> (nq, nq), symmetric positive definite; or M(q, t, parameters) when parameters are given.
    - `nq`: number of coordinates.
    - `potential`: V(q) -> () in J, or V(q, t, parameters); None for none.
    - `parameters`: any pytree of numbers; its leaves can be differentiated and batched.

    **Raises:** ValueError for an nq that is no positive integer, functions that cannot be called, and (when used) for
    results of a wrong shape.

    Source: EQUATIONS section 12.

    ```python
    sphere = jd.MetricSystem(lambda q: jnp.diag(jnp.stack([jnp.ones(()), jnp.sin(q[0]) ** 2])), 2)
    ```
    """

    metric: Callable
    nq: int = eqx.field(static=True)
    potential: Callable | None = None
    parameters: Any = None

    def __init__(
        self, metric: Function, nq: Checked[int], *, potential: Function | None = None, parameters: PyTree = None
    ):
        more = "" if parameters is None else ", t, parameters"
        self.metric = as_pytree(metric, "metric", "q" + more)
        self.potential = None if potential is None else as_pytree(potential, "potential", "q" + more)
        self.nq = check_count(nq, "nq")
        self.parameters = jax.tree.map(as_parameter, parameters)

    def mass_matrix(self, q: Float[Array, " nq"], t: Number) -> Float[Array, "nv nv"]:
        """Mass matrix M as given, (nv, nv)."""
        return evaluate_callback(self.metric, (self.nq, self.nq), "metric", (q,), t, self.parameters)

    def bias_force(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " nv"]:
        """Bias force h, (nv,)."""

        def momentum(q, t):
            return matmul(self.mass_matrix(q, t), v)

        # The derivative along the motion is M_dot v; with v held fixed, the pull-back of v is the gradient of v . M v.
        _, rate = jax.jvp(momentum, (q, t), (v, jnp.ones_like(t)))
        _, pull = jax.vjp(lambda q: momentum(q, t), q)
        force = rate - 0.5 * pull(v)[0]
        return force if self.potential is None else force + self.gravity_force(q, t)

    def gravity_force(self, q: Float[Array, " nq"], t: Number) -> Float[Array, " nv"]:
        """Gravity force dV/dq, (nv,)."""
        return jnp.zeros_like(q) if self.potential is None else jax.grad(self.potential_energy)(q, t)

    def potential_energy(self, q: Float[Array, " nq"], t: Number) -> Float[Array, ""]:
        """Potential energy V as given, (), J; zero when there is none."""
        if self.potential is None:
            return jnp.zeros((), q.dtype)
        return evaluate_callback(self.potential, (), "potential", (q,), t, self.parameters)


class ExplicitSystem(System):
    r"""System given by its equations of motion.

    $$M(q) a + h(q, v) = \tau$$

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

    def __init__(
        self,
        mass_matrix: Function,
        bias_force: Function,
        nq: Checked[int],
        *,
        parameters: PyTree = None,
        potential: Function | None = None,
    ):
        more = "" if parameters is None else ", t, parameters"
        self._mass_matrix = as_pytree(mass_matrix, "mass_matrix", "q" + more)
        self._bias_force = as_pytree(bias_force, "bias_force", "q, v" + more)
        self._potential = None if potential is None else as_pytree(potential, "potential", "q" + more)
        self.nq = check_count(nq, "nq")
        self.parameters = jax.tree.map(as_parameter, parameters)

    def mass_matrix(self, q: Float[Array, " nq"], t: Number) -> Float[Array, "nv nv"]:
        """Mass matrix M as given, (nv, nv)."""
        return evaluate_callback(self._mass_matrix, (self.nq, self.nq), "mass_matrix", (q,), t, self.parameters)

    def bias_force(self, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Float[Array, " nv"]:
        """Bias force h as given, (nv,)."""
        return evaluate_callback(self._bias_force, (self.nq,), "bias_force", (q, v), t, self.parameters)

    def potential_energy(self, q: Float[Array, " nq"], t: Number) -> Float[Array, ""]:
        """Potential energy V as given, (), J. **Raises:** ValueError when it was not given."""
        if self._potential is None:
            raise ValueError("this ExplicitSystem has no potential energy; pass potential= to its constructor")
        return evaluate_callback(self._potential, (), "potential", (q,), t, self.parameters)


def velocity_to_rate(system, q: Float[Array, " nq"], v: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Rate dq/dt (nq,) for the velocity v of any system: H(q) v for a `Model`, else v."""
    return configuration_rate(system, q, v) if isinstance(system, Model) else v


def rate_to_velocity(system, q: Float[Array, " nq"], rate: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Velocity v (nv,) of any system whose dq/dt is `rate` (nq,), tangent to its manifold."""
    if not isinstance(system, Model):
        return rate
    # Dependent coordinates carry no information beyond the joints'.
    rate = rate[: system.topology.nq]
    (v,) = jax.linear_transpose(lambda v: joint_rates(system, q, v), jnp.zeros(system.nv, rate.dtype))(rate)
    if not has_quaternions(system):
        return v
    # H^T H is 1 but for angular velocities, where unit quaternions move at half the rate: 1/4.
    weight = np.ones(system.nv)
    for kind, place in zip(system.topology.kinds, system.topology.v_slices, strict=True):
        if kind in ("spherical", "free"):
            weight[place][-3:] = 4.0
    return jnp.asarray(weight, rate.dtype) * v


def displace(system, q: Float[Array, " nq"], step: Float[Array, " nv"]) -> Float[Array, " nq"]:
    """Configuration reached from q by the displacement `step` (nv,) of any system, on the manifold of a `Model`."""
    if not isinstance(system, Model):
        return q + step
    # A kernel, as joint by joint it is hundreds of operations of JAX; dependent coordinates solve equations of their own.
    return (integrate if has_dependent_coordinates(system) else kernel(integrate))(system, q, step)


def displacement(system, q0: Float[Array, " nq"], q1: Float[Array, " nq"]) -> Float[Array, " nv"]:
    """Displacement (nv,) from q0 to q1 of any system, the inverse of `displace`."""
    if not isinstance(system, Model):
        return q1 - q0
    return (difference if has_dependent_coordinates(system) else kernel(difference))(system, q0, q1)


def has_quaternions(system) -> bool:
    """Decide whether q holds quaternions, which must stay on the unit sphere."""
    return isinstance(system, Model) and any(kind in ("spherical", "free") for kind in system.topology.kinds)


def has_dependent_coordinates(system) -> bool:
    """Decide whether q has dependent coordinates, functions of the joints' (see `Model.complete_configuration`)."""
    return isinstance(system, Model) and system.nq > system.topology.nq


def search_from(system, q: Float[Array, " nq"], other: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """q with the dependent coordinates of `other`, from which those of configurations displaced from q are searched.

    A search finds them to rounding from close by only: where displacements lead far away, `other` is to be at their end.
    """
    if not has_dependent_coordinates(system):
        return q
    size = system.topology.nq
    return jnp.concatenate([q[:size], other[size : system.nq]])


def has_coordinate_rates(system) -> bool:
    """Decide whether v = dq/dt: velocities of planar, spherical and free joints are twists, or in axes that move."""
    return not (isinstance(system, Model) and {"planar", "spherical", "free"} & set(system.topology.kinds))


def needs_retraction(system) -> bool:
    """Decide whether `retract` changes anything."""
    return has_quaternions(system) or has_dependent_coordinates(system)


def retract(system, q: Float[Array, " nq"]) -> Float[Array, " nq"]:
    """Project q of any system to its manifold: unit quaternions, and dependent coordinates that solve their equations."""
    return normalize(system, q) if needs_retraction(system) else q


@entry_point
def symbols(derivative: Float[Array, "n n n"]) -> Float[Array, "n n n"]:
    """Christoffel symbols of the first kind from dM_ij/dq_k: 1/2 (dM_ij/dq_k + dM_ik/dq_j - dM_kj/dq_i)."""
    return 0.5 * (derivative + derivative.transpose(0, 2, 1) - derivative.transpose(2, 1, 0))


def evaluate_callback(function, shape, name, state, t, parameters):
    """Evaluate a user's function of the state, or of (state, t, parameters) when there are parameters."""
    value = function(*state) if parameters is None else function(*state, t, parameters)
    value = as_array(value, name, state[0].dtype)
    if value.shape != shape:
        size = state[0].shape[0]
        wanted = "return one number, ()" if shape == () else f"expected {shape} for nq = {size}"
        raise ValueError(
            f"{name} returned shape {value.shape}{';' if shape == () else ','} {wanted}{batch_hint(value, shape)}"
        )
    return value


_mass_matrix_compiled = eqx.filter_jit(lambda system, q, t: system.mass_matrix(q, t))


def as_parameter(leaf):
    """Convert a Python number to a float array, a leaf that can be differentiated; other leaves are returned unchanged."""
    # A bool stays static: it selects code and has no derivative.
    return jnp.asarray(leaf, float) if isinstance(leaf, (int, float)) and not isinstance(leaf, bool) else leaf


if TYPE_CHECKING:
    SceneLike = Scene | Model | System
else:
    SceneLike = Any  # `as_scene` checks them


def describe_state(q, t, v=None) -> str:
    """Text description of a state for messages."""
    moving = "" if v is None else f"v = {np.asarray(v).tolist()}, "
    return f"q = {np.asarray(q).tolist()}, {moving}t = {float(t):.6g}"


def check_mass_matrix(mass, name: str, q, t) -> None:
    """Refuse a mass matrix that is not finite or not positive definite, in a measure independent of units."""
    mass = np.asarray(mass, float)
    place = describe_state(q, t)
    if not np.isfinite(mass).all():
        raise ValueError(f"the mass matrix of this {name} is not finite at {place}: {mass.tolist()}; start elsewhere")
    # Scaling by the diagonal makes the eigenvalues dimensionless: kg and kg m^2 are not comparable.
    scale = np.sqrt(np.abs(np.diag(mass)))
    # A coordinate without inertia keeps its zero row, which then shows as a zero eigenvalue.
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(mass / np.outer(scale, scale))
    # Eigenvalues of a matrix with unit diagonal have rounding errors of about n eps.
    minimum = 10 * len(mass) * float(np.finfo(np.asarray(q).dtype).eps)
    if values[0] > minimum:
        return
    rank = int(np.sum(np.abs(values) > minimum))
    if rank == len(mass):
        raise ValueError(
            f"the mass matrix of this {name} is not positive definite at {place}: eigenvalues "
            f"{np.linalg.eigvalsh(mass).tolist()}; check the signs of the kinetic energy"
        )
    # The eigenvector of the smallest eigenvalue, scaled back, is the velocity without kinetic energy.
    idle = vectors[:, np.argmin(np.abs(values))] / scale
    raise ValueError(
        f"the mass matrix of this {name} has rank {rank} of {len(mass)} at {place}: the velocity "
        f"{(idle / np.abs(idle).max()).round(6).tolist()} moves no mass; start elsewhere, leave coordinates out, or give "
        "them inertia"
    )
