"""Immersions q = xi(s, t): tensors on q pulled back to s, and the dynamics of systems constrained to their image.

For a system with M a + h = F + R and velocity v = J(s, t) sdot + v0(s, t) on q = xi, c = Jdot sdot + v0dot, the reaction
forces R do no virtual work, J^T R = 0, and drop out of

    J^T M J sddot + J^T (M c + h) = J^T F,   a = J sddot + c,   R = M a + h - F.

Several systems, called units, add their contributions: rho = sum of J_i^T M_i J_i, force = sum of J_i^T F_i, and no
matrix of all units is formed. Source: EQUATIONS section 12; Loparo & Vakalis on interacting bodies, after Kron.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile.known import is_known
from jaxdyn.dynamics import centroidal
from jaxdyn.dynamics import quantities as dynamics
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Function, Numbers, as_array, as_float, check_count, check_flag, check_state
from jaxdyn.systems.scene import Scene, as_pytree, as_scene, check_force
from jaxdyn.systems.system import SceneLike, System, describe_state, rate_to_velocity


class PullBack(eqx.Module):
    """A covariant tensor field on q, pulled back to s; call it at s (m,)."""

    field: Callable
    immersion: Callable

    def __call__(self, s: Float[Array, " m"]) -> Array:
        """The tensor at s: every index of the field's contracted with J = dxi/ds."""
        q = as_array(self.immersion(s), "immersion", s.dtype)
        value = as_array(self.field(q), "field", s.dtype)
        if q.ndim != 1 or any(size != q.size for size in value.shape):
            raise ValueError(f"field returned shape {value.shape}, expected ({q.size}, ...) with q = xi(s) {q.shape}")
        # Forward mode: an immersion has fewer inputs than outputs, m < n.
        J = jax.jacfwd(self.immersion)(s)
        # Under tracing the rank is unknown; concrete calls refuse singular points.
        if is_known(J):
            _check_rank(J, s, None)
        # One index at a time: m n^k products instead of a contraction over all indices at once.
        for axis in range(value.ndim):
            value = jnp.moveaxis(matmul(jnp.moveaxis(value, axis, -1), J), -1, axis)
        return value


def pull_back(field: Function, immersion: Function) -> PullBack:
    r"""Pull-back of a covariant tensor by an immersion.

    It is $J^T g J$ of a metric g, $J^T F$ of a one-form F, and $V(\xi(s))$ of a function V, for $q = \xi(s)$.

    **Arguments:**

    - `field`: function of q (n,) -> (), (n,), (n, n), ...; one index per argument of the tensor.
    - `immersion`: xi(s) -> (n,), of s (m,), with $J = d\xi/ds$ of rank m.

    **Returns:** a function of s that gives (), (m,), (m, m), ...; `jd.MetricSystem` takes it for a metric.

    **Raises:** ValueError for what cannot be called, and (when called) for shapes that do not fit and, on concrete
    numbers, for an immersion whose rank is below m, with the rank and the point.

    Source: EQUATIONS section 12.
    """
    return PullBack(as_pytree(field, "field"), as_pytree(immersion, "immersion"))


class _Motion(NamedTuple):
    """Motion of one unit on the immersion: its q, v, the matrix J of v = J sdot + ..., and c, the rate of v at sddot = 0."""

    q: Array
    v: Array
    J: Array
    drift: Array


class ImmersedSystem(System):
    """Systems constrained to q = xi(s, t), in coordinates s, as built by `constrain_by_immersion`."""

    units: tuple
    immersion: Callable
    nq: int = eqx.field(static=True)
    moving: bool = eqx.field(static=True)
    joined: bool = eqx.field(static=True)

    def configurations(self, s, t) -> tuple[Array, ...]:
        """Configuration of each unit at s, each (nq,) of its system."""
        positions = self.immersion(s, t) if self.moving else self.immersion(s)
        positions = tuple(positions) if self.joined else (positions,)
        positions = tuple(as_array(q, "xi", s.dtype) for q in positions)
        sizes = [q.shape for q in positions]
        wanted = [(unit.nq,) for unit in self.units]
        if sizes != wanted:
            raise ValueError(
                f"xi returned shapes {sizes}, expected {wanted}: "
                + ("one configuration for each of the systems" if self.joined else "the system's configuration")
            )
        return positions

    def velocities(self, s, v, t) -> tuple[Array, ...]:
        """Velocity of each unit at s and sdot = v, each (nv,) of its system."""
        q, rates = self._push_forward(self.configurations, s, t, v)
        return tuple(rate_to_velocity(*of) for of in zip(self.units, q, rates, strict=True))

    def _push_forward(self, function, s, t, v):
        """Value of `function(s, t)` and its rate along the motion; t is held fixed where xi does not depend on it."""
        if self.moving:
            return jax.jvp(function, (s, t), (v, jnp.ones_like(t)))
        return jax.jvp(lambda s: function(s, t), (s,), (v,))

    def _unit_jacobians(self, s, t):
        """Configuration of each unit, and its Jacobian J (nv, m)."""
        q, push = jax.linearize(lambda s: self.configurations(s, t), s)
        # One linearisation of xi, pushed along each coordinate of s.
        rates = jax.vmap(push)(jnp.eye(self.nq, dtype=s.dtype))
        # From dq/dt to v of each unit: J has nv rows, which differ from its nq for quaternions.
        columns = jax.vmap(lambda *rates: [rate_to_velocity(*of) for of in zip(self.units, q, rates, strict=True)])
        return q, [J.T for J in columns(*rates)]

    def motions(self, s, v, t) -> list[_Motion]:
        """Position, velocity, Jacobian and drift of each unit."""
        q, J = self._unit_jacobians(s, t)
        # A derivative along the motion with sddot = 0 gives c = Jdot sdot + v0dot; Jdot itself is never formed.
        w, drift = self._push_forward(lambda s, t: self.velocities(s, v, t), s, t, v)
        return [_Motion(*of) for of in zip(q, w, J, drift, strict=True)]

    def mass_matrix(self, s, t):
        """rho = sum of J^T M J, (m, m)."""
        jacobians = zip(self.units, *self._unit_jacobians(s, t), strict=True)
        return _sum(matmul(J.T, matmul(dynamics.mass_matrix(unit, q, t), J)) for unit, q, J in jacobians)

    def bias_force(self, s, v, t):
        """Sum of J^T (M c + h), (m,)."""
        return self._inverse(s, v, t, None)

    def inverse_dynamics(self, s, v, a, t):
        """Sum of J^T (M (J a + c) + h), (m,)."""
        return self._inverse(s, v, t, a)

    def _inverse(self, s, v, t, a):
        forces = self._unit_forces(self.motions(s, v, t), a, t)
        return _sum(matmul(motion.J.T, force) for motion, force in forces)

    def _unit_forces(self, motions, a, t):
        """Yield each unit's motion and the generalised force M (J a + c) + h that it requires."""
        for unit, motion in zip(self.units, motions, strict=True):
            # The bias force is the inverse dynamics at sddot = 0, where a unit's acceleration is its drift.
            acceleration = motion.drift if a is None else motion.drift + matmul(motion.J, a)
            yield motion, dynamics.inverse_dynamics(unit, motion.q, motion.v, acceleration, t)

    def gravity_force(self, s, t):
        """Bias force at rest, (m,); sum of J^T N where xi does not move."""
        # With xi(s, t) the bias force at rest also has J^T M c, of the motion that time imposes.
        if self.moving:
            return super().gravity_force(s, t)
        jacobians = zip(self.units, *self._unit_jacobians(s, t), strict=True)
        return _sum(matmul(J.T, dynamics.gravity_force(unit, q, t)) for unit, q, J in jacobians)

    def kinetic_energy(self, s, v, t):
        """Sum of the units' kinetic energies, (), J."""
        # From the velocities and not from rho: with xi(s, t) the energy has terms linear in sdot, and constant ones.
        states = zip(self.units, self.configurations(s, t), self.velocities(s, v, t), strict=True)
        return _sum(centroidal.kinetic_energy(unit, q, w, t) for unit, q, w in states)

    def potential_energy(self, s, t):
        """Sum of the units' potential energies, (), J."""
        states = zip(self.units, self.configurations(s, t), strict=True)
        return _sum(centroidal.potential_energy(unit, q, t) for unit, q in states)

    def check_start(self, q, v, t) -> None:
        """Check the start as for any system, and that the immersion has full rank."""
        if is_known(self, q, v, t):
            # All units in one matrix: the Jacobian of each may have a lower rank.
            _check_rank(np.concatenate([np.asarray(J) for J in _compiled_unit_jacobians(self, q, t)]), q, t)
        super().check_start(q, v, t)


class PulledForce(eqx.Module):
    """Forces on the units of an `ImmersedSystem`, pulled back: xi*F = sum of J_i^T F_i."""

    forces: tuple[tuple, ...]
    common: Callable | None

    def on_units(self, system: ImmersedSystem, q, v, t) -> list[Array]:
        """Sum of each unit's forces, (nv,) of its system, at their q and v."""
        total = [
            _sum(
                [jnp.zeros_like(w)]
                + [check_force(f(unit, q_unit, w, t), q_unit, unit.nv, f"forces[{i}]") for i, f in enumerate(forces)]
            )
            for unit, forces, q_unit, w in zip(system.units, self.forces, q, v, strict=True)
        ]
        if self.common is None:
            return total
        # Evaluated once, because an interaction depends on all units.
        common_forces = self.common(tuple(q), tuple(v), t) if system.joined else (self.common(q[0], v[0], t),)
        return _add_forces(total, common_forces)

    def __call__(self, system, s, v, t):
        if not isinstance(system, ImmersedSystem):
            raise ValueError(f"a pulled-back force needs its immersed system, not a {type(system).__name__}")
        # J^T F as a vector-Jacobian product of the velocities, which are affine in sdot: J is not formed.
        _, pull = jax.vjp(lambda v: system.velocities(s, v, t), v)
        return pull(tuple(self.on_units(system, system.configurations(s, t), system.velocities(s, v, t), t)))[0]


def constrain_by_immersion(
    system: Checked[SceneLike | Sequence[SceneLike]],
    xi: Callable,
    nq: int,
    *,
    moving: bool = False,
    force: Function | None = None,
) -> ImmersedSystem | Scene:
    r"""System in s of one system constrained to q = xi(s), or of several independent ones that xi joins.

    The mass matrix becomes $\rho = J^T M J$ with $J = d\xi/ds$, forces become $J^T F$, and the reaction forces drop out;
    `reaction_force` gives them. The motion is that of the same constraint with multipliers, without drift from it.

    **Arguments:**

    - `system`: a `Model` or another system; a `Scene` without constraints, whose forces are pulled back with it; or a
      tuple of these, each an independent unit. The mass of a unit may be zero as long as that of the whole is not.
    - `xi`: xi(s) -> configuration (nq,) of the system, for a tuple of systems a tuple of configurations; unit
      quaternions where they have some. With `moving=True` xi(s, t). Twice differentiable. A plain function is static; a
      Module or `jax.tree_util.Partial` carries numbers as leaves.
    - `nq`: number of coordinates s; sdot is their velocity.
    - `moving`: whether xi takes the time.
    - `force`: force(q, v, t) -> (nv,), N m or N, on the system, or a tuple of them for a tuple of systems, then of the
      tuples of their q and v: the interaction between them. None for none.

    **Returns:** a system in s; a `Scene` with the pulled-back forces when a `Scene` or `force` was given.

    **Raises:** ValueError for an argument that is no system, a scene with constraints, an nq that is no positive integer;
    (when used) for configurations of a wrong shape; before a motion from concrete numbers is computed, for an immersion of a rank
    below nq, with the rank and the point.

    Source: EQUATIONS section 12.

    ```python
    rod = jd.geometry.constrain_by_immersion(particle, lambda s: jnp.concatenate([jnp.sin(s), -jnp.cos(s)]), 1)
    ```
    """
    joined = isinstance(system, (tuple, list))
    given = tuple(system) if joined else (system,)
    if not given:
        raise ValueError("system is an empty tuple; give at least one system")
    scenes = [as_scene(unit) for unit in given]
    for scene in scenes:
        if scene.constraints:
            raise ValueError(
                f"a scene has {len(scene.constraints)} constraints; an immersion takes their place, so leave them out, or "
                "list them on the scene of the result"
            )
    units = tuple(scene.system for scene in scenes)
    immersed = ImmersedSystem(
        units=units,
        immersion=as_pytree(xi, "xi"),
        nq=check_count(nq, "nq"),
        moving=check_flag(moving, "moving"),
        joined=joined,
    )
    if force is None and not any(isinstance(unit, Scene) for unit in given):
        return immersed
    forces = tuple(scene.forces for scene in scenes)
    # Forces on q remain functions of q and v, and are pulled back at each evaluation.
    pulled = PulledForce(forces, None if force is None else as_pytree(force, "force"))
    return Scene(immersed, forces=(pulled,) if force is not None or any(forces) else ())


def reaction_force(
    system: SceneLike,
    q: Float[Array, " nq"],
    v: Float[Array, " nq"],
    force: Numbers | None = None,
    t: Numbers = 0.0,
) -> Array | tuple[Array, ...]:
    r"""Reaction force of an immersion, in the coordinates of its system.

    $$R = M a + h - F, \qquad J^T R = 0$$

    **Arguments:**

    - `system`: a result of `constrain_by_immersion`.
    - `q`, `v` (nq,): s and sdot. `t`, s.
    - `force`: force on the system (nv,), N m or N, one for each unit when it is a tuple, besides the forces of its scene.
      None for zero.

    **Returns:** (nv,) of the system, or a tuple, one for each unit.

    **Raises:** ValueError for a system that is not immersed, forces that were not pulled back, and shapes that do not fit.
    """
    scene = as_scene(system)
    immersed = scene.system
    if not isinstance(immersed, ImmersedSystem):
        raise ValueError(f"system is a {type(immersed).__name__}; pass the result of constrain_by_immersion")
    if any(not isinstance(f, PulledForce) for f in scene.forces) or scene.constraints:
        raise ValueError(
            "the scene has forces or constraints in s, whose share in q is not known; list forces on the systems that go "
            "into constrain_by_immersion"
        )
    q, v, t = check_state(immersed, q=q, v=v, t=t)
    motions = immersed.motions(q, v, t)
    places, speeds = [m.q for m in motions], [m.v for m in motions]
    # The generalised force comes from the same per-unit forces that are subtracted below, so that J^T R = 0 to rounding.
    applied = [jnp.zeros_like(w) for w in speeds]
    if force is not None:
        given = force if immersed.joined and isinstance(force, Sequence) else (force,)
        applied = _add_forces(applied, [as_float(part, "force", (None,), q.dtype) for part in given])
    for pulled in scene.forces:
        applied = [a + f for a, f in zip(applied, pulled.on_units(immersed, places, speeds, t), strict=True)]
    tau = _sum(matmul(m.J.T, f) for m, f in zip(motions, applied, strict=True))
    a = dynamics.forward_dynamics(immersed, q, v, tau, t)
    reactions = tuple(
        required - f for (_, required), f in zip(immersed._unit_forces(motions, a, t), applied, strict=True)
    )
    return reactions if immersed.joined else reactions[0]


def _add_forces(total, forces) -> list[Array]:
    """Add the forces that a user gave, one for each unit, to the total of each unit."""
    if len(forces) != len(total):
        raise ValueError(f"force has {len(forces)} entries; give one for each of the {len(total)} systems")
    return [f + check_force(g, f, f.shape[0], "force") for f, g in zip(total, forces, strict=True)]


def _sum(terms):
    return reduce(add, terms)


_compiled_unit_jacobians = eqx.filter_jit(lambda system, q, t: system._unit_jacobians(q, t)[1])


def _check_rank(J, s, t) -> None:
    """Refuse a matrix (n, m) of a rank below m."""
    J = np.asarray(J, float)
    # The usual threshold of a numerical rank, max(n, m) eps, with a margin of 10 for the rounding of xi's derivative.
    minimum = 10 * max(J.shape) * float(np.finfo(np.asarray(s).dtype).eps)
    # NaN compares false: a Jacobian that is not finite has rank 0 here and is refused. The SVD itself would raise.
    sizes = np.linalg.svd(J, compute_uv=False) if np.isfinite(J).all() else np.full(1, np.nan)
    rank = int(np.sum(sizes > minimum * sizes.max(initial=0.0)))
    if rank < J.shape[1]:
        where = f"s = {np.asarray(s).tolist()}" if t is None else describe_state(s, t).replace("q =", "s =")
        raise ValueError(
            f"the immersion has rank {rank} at {where}, expected {J.shape[1]}, one for each coordinate; start elsewhere, "
            "or take coordinates that are regular there"
        )
