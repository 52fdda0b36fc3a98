"""Constraints, and the rows of all constraints of a scene: A(q, t) v = b(q, t), A a = gamma.

A constraint gives up to two functions: a residual phi(q, t) that is to be zero (holonomic part), and a velocity
residual w(q, v, t), linear in v up to a term without v, that is to be zero (nonholonomic part). Everything else follows by
`jax.jvp` along the motion, on manifold-valued q too:

    psi(q, v, t) = (d/dt phi, w) = A v - b,   A = dpsi/dv,   gamma = -(d/dt psi at a = 0) = -(Adot v) + bdot.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import kernel
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import (
    DType,
    Function,
    Number,
    Numbers,
    SystemLike,
    as_array,
    batch_hint,
    check_flag,
    check_new_name,
    check_state,
    state_dtype,
)
from jaxdyn.systems.scene import Scene, as_pytree, as_scene
from jaxdyn.systems.system import velocity_to_rate


class Constraint(eqx.Module):
    """Base of all constraints. `name` is used by errors and reports."""

    name: eqx.AbstractVar[str]

    def position(self, system: SystemLike, q: Float[Array, " nq"], t: Number) -> Array | None:
        """Residual phi(q, t) (nh,) of the holonomic part, or None when there is none."""
        return None

    def velocity(self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array | None:
        """Residual w(q, v, t) (np,) of the nonholonomic part, linear in v, or None when there is none."""
        return None

    def sizes(self, system: SystemLike, dtype: DType) -> tuple[int, int]:
        """Numbers of holonomic and of nonholonomic rows, from shapes alone."""
        # By abstract evaluation: nothing is computed, and a traced system is no obstacle.
        q, v = (jax.ShapeDtypeStruct((n,), dtype) for n in (system.nq, system.nv))
        t = jax.ShapeDtypeStruct((), dtype)
        holonomic = eqx.filter_eval_shape(self.position, system, q, t)
        nonholonomic = eqx.filter_eval_shape(self.velocity, system, q, v, t)
        return 0 if holonomic is None else holonomic.shape[0], 0 if nonholonomic is None else nonholonomic.shape[0]

    def wrench_components(self) -> tuple[int, ...] | None:
        """Indices of a contact's force components (`jd.contact.wrench_basis`) among its multipliers.

        None for a constraint that is no contact with a normal force.
        """
        return None

    # A class may evaluate all of its constraints at once, because they share work: those between bodies share one pass of the
    # kinematics. It then gives a group and the two class methods below, and its rows are not found by differentiation.

    def group(self) -> Hashable:
        """Key of the constraints that are evaluated together, by the functions below; None for a constraint on its own."""
        return None

    @classmethod
    def group_positions(
        cls, members: Sequence["Constraint"], system: SystemLike, q: Float[Array, " nq"], t: Number
    ) -> list:
        """Residuals (nh,) of each of the constraints of one group, None without a holonomic part."""
        raise NotImplementedError

    @classmethod
    def group_rows(
        cls,
        members: Sequence["Constraint"],
        system: SystemLike,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
    ) -> list:
        """A (n, nv), gamma (n,) and A v - b (n,) of each of the constraints of one group."""
        raise NotImplementedError


class Holonomic(Constraint):
    r"""A constraint on the configuration.

    $$\phi(q, t) = 0$$

    **Arguments:**

    - `with_system`: pass the scene's system as the first argument, phi(system, q, t), so that gradients and batches of its
      leaves pass through.
    - `phi`: phi(q, t) -> (n,) or (), m or rad. It must be differentiable twice. A plain
      function is static: define it once. An equinox Module or `jax.tree_util.Partial` carries numbers as leaves.
    - `name`: for errors and reports; by default that of the function.

    **Raises:** ValueError when phi cannot be called so; (when used) when it returns anything but one row or a vector.

    ```python
    rod = jd.Holonomic(lambda q, t: q @ q - 1.0, name="rod")
    ```
    """

    phi: Callable
    with_system: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(self, phi: Function, with_system: bool = False, name: str | None = None):
        self.name = _own_name(name, phi, "holonomic")
        self.with_system = check_flag(with_system, f"constraint {self.name!r}: with_system")
        self.phi = as_pytree(phi, f"constraint {self.name!r}: phi", "system, q, t" if with_system else "q, t")

    def position(self, system: SystemLike, q: Float[Array, " nq"], t: Number) -> Array | None:
        """phi(q, t), (n,)."""
        value = self.phi(system, q, t) if self.with_system else self.phi(q, t)
        value = as_array(value, f"constraint {self.name!r}: the returned phi", q.dtype)
        # A matrix is most often a batch that was not mapped; its rows would be summed into wrong multipliers.
        if value.ndim > 1:
            raise ValueError(
                f"constraint {self.name!r}: phi returned shape {value.shape}; return a vector (n,){batch_hint(value, (1,))}"
            )
        return jnp.atleast_1d(value)


class Pfaffian(Constraint):
    """A constraint on the velocity.

    $$A(q, t) v = b(q, t)$$

    **Arguments:**

    - `A`: A(q, t) -> (n, nv) or (nv,), acting on the velocity v of the system, which is dq/dt only where nq = nv.
    - `b`: b(q, t) -> (n,) or (), or None for zero.
    - `with_system`: pass the scene's system as the first argument, A(system, q, t) and b(system, q, t).
    - `name`: for errors and reports; by default that of the function.

    **Raises:** ValueError when A or b cannot be called so; (when used) when what they return does not fit.

    Source: Murray, Li & Sastry (1994), chapter 6, eq. 6.4.
    """

    A: Callable
    b: Callable | None
    with_system: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(self, A: Function, b: Function | None = None, with_system: bool = False, name: str | None = None):
        self.name = _own_name(name, A, "pfaffian")
        self.with_system = check_flag(with_system, f"constraint {self.name!r}: with_system")
        takes = "system, q, t" if with_system else "q, t"
        self.A = as_pytree(A, f"constraint {self.name!r}: A", takes)
        self.b = None if b is None else as_pytree(b, f"constraint {self.name!r}: b", takes)

    def velocity(self, system: SystemLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> Array | None:
        """Residual of the rows, (n,).

        $$A v - b$$
        """
        place = (system, q, t) if self.with_system else (q, t)
        rows = as_array(self.A(*place), f"constraint {self.name!r}: the returned A", q.dtype)
        rows = rows[None] if rows.ndim == 1 else rows
        if rows.ndim != 2 or rows.shape[1] != v.shape[0]:
            raise ValueError(
                f"constraint {self.name!r}: A returned shape {rows.shape}, expected (n, {v.shape[0]}) = (n, nv)"
            )
        residual = matmul(rows, v)
        if self.b is None:
            return residual
        b = jnp.atleast_1d(as_array(self.b(*place), f"constraint {self.name!r}: the returned b", q.dtype))
        if b.shape != residual.shape:
            raise ValueError(
                f"constraint {self.name!r}: b returned shape {b.shape}, expected {residual.shape} as A has rows"
            )
        return residual - b


class Rows(NamedTuple):
    """All constraints of a scene at one state, stacked in the scene's order (holonomic rows of each one first).

    - `A` (nc, nv), `gamma` (nc,): A a = gamma.
    - `velocity` (nc,): A v - b, zero for an admissible velocity.
    """

    A: Float[Array, "nc nv"]
    gamma: Float[Array, " nc"]
    velocity: Float[Array, " nc"]


class Layout(NamedTuple):
    """Row range of one constraint: its name, and its first, first nonholonomic and past-the-last row."""

    name: str
    start: int
    nonholonomic: int
    end: int


def layout(scene: Scene) -> tuple[Layout, ...]:
    """Row ranges of the scene's constraints, in order; a name that occurs twice gets a number.

    **Raises:** ValueError for entries that are no constraints, and for constraints without rows.
    """
    dtype = state_dtype(scene.system)
    places, names, start = [], [], 0
    for i, constraint in enumerate(scene.constraints):
        if not isinstance(constraint, Constraint):
            raise ValueError(
                f"constraints[{i}] is a {type(constraint).__name__}; wrap a function in Holonomic or Pfaffian, "
                "or take a constraint of the library"
            )
        sizes = constraint.sizes(scene.system, dtype)
        if sum(sizes) == 0:
            raise ValueError(f"constraint {constraint.name!r} has no rows; remove it from the scene")
        name = constraint.name
        # Results are dictionaries by name (`by_name`, `constraint_forces`): equal names would lose multipliers.
        while name in names:
            name = f"{constraint.name} ({i})" if name == constraint.name else f"{name}'"
        names.append(name)
        places.append(Layout(name, start, start + sizes[0], start + sum(sizes)))
        start = places[-1].end
    return tuple(places)


def holonomic_rows(places: Sequence[Layout]) -> np.ndarray:
    """Indices of the rows that are rates of a residual phi, in order."""
    return np.concatenate([np.arange(place.start, place.nonholonomic) for place in places] or [np.zeros(0, int)])


def nonholonomic_rows(places: Sequence[Layout]) -> np.ndarray:
    """Indices of the rows that are residuals of velocities and no rates of a phi, in order."""
    return np.concatenate([np.arange(place.nonholonomic, place.end) for place in places] or [np.zeros(0, int)])


def position_residual(scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, " nh"]:
    r"""Residuals phi(q, t) of all holonomic parts, in the scene's order: zero where the constraints are closed.

    **Arguments:** `q` (nq,); `t`, s.

    **Returns:** (nh,), m or rad by the constraint; (0,) of a scene without holonomic parts.

    **Raises:** ValueError for constraints that do not fit the system.

    Source: EQUATIONS section 7.
    """
    scene = as_scene(scene)
    return _position_residual(scene, *check_state(scene.system, q=q, t=t))


@kernel
def _position_residual(scene: Scene, q, t):
    layout(scene)  # raises for entries that are no constraints, and for constraints that do not fit the system
    parts = [part for part in _positions(scene, q, t) if part is not None]
    return _drop(scene, jnp.concatenate(parts), holonomic_rows) if parts else jnp.zeros((0,), q.dtype)


def _drop(scene: Scene, values, places: Callable | None = None):
    """Values of the scene's rows, all or those at `places`, zero where a row is dropped (`Scene.kept_rows`)."""
    if scene.kept_rows is None:
        return values
    kept = scene.kept_rows.kept if places is None else scene.kept_rows.kept[places(layout(scene))]
    kept = kept.astype(values.dtype)
    return values * (kept[:, None] if values.ndim > 1 else kept)


def velocity_residual(
    scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, " nc"]:
    r"""Residuals of the velocities by all constraints, in the order of `constraint_jacobian`: zero for admissible ones.

    $$\psi(q, v, t) = A v - b$$

    **Arguments:** `q` (nq,), `v` (nv,); `t`, s.

    **Returns:** (nc,), m/s or rad/s by the constraint; (0,) of a scene without constraints.

    **Raises:** ValueError for constraints that do not fit the system.

    Source: EQUATIONS section 7.
    """
    scene = as_scene(scene)
    q, v, t = check_state(scene.system, q=q, v=v, t=t)
    return _velocity_residual(scene, q, v, t) if scene.constraints else jnp.zeros((0,), q.dtype)


@kernel
def _velocity_residual(scene: Scene, q, v, t):
    parts = _by_constraint(scene, q, v, t, lambda others: (_by_functions(others, q, v, t),))
    return _drop(scene, jnp.concatenate([part[-1] for part in parts]))


def _by_functions(scene: Scene, q, v, t):
    """psi of constraints that are functions of q and v."""
    # Along the motion, not by the Jacobian in q: one pass, and right where q has more entries than v (quaternions).
    motion = velocity_to_rate(scene.system, q, v), jnp.ones_like(t)
    _, rates = jax.jvp(lambda q, t: _positions(scene, q, t), (q, t), motion)
    parts: list[Any] = []
    for constraint, rate in zip(scene.constraints, rates, strict=True):
        parts += [part for part in (rate, constraint.velocity(scene.system, q, v, t)) if part is not None]
    return jnp.concatenate(parts)


def rows(scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0) -> Rows:
    """A, gamma and A v - b of all constraints of the scene (see `Rows`)."""
    return _rows(scene, q, v, jnp.asarray(t, q.dtype))


@kernel
def _rows(scene: Scene, q, v, t) -> Rows:
    def of_functions(others):
        # With a = 0 the rate of psi along the motion is Adot v - bdot, so that gamma is its negative.
        motion = velocity_to_rate(scene.system, q, v), jnp.ones_like(t)
        velocity, rate = jax.jvp(lambda q, t: _by_functions(others, q, v, t), (q, t), motion)
        return _by_differentiation(others, q, t), -rate, velocity

    parts = _by_constraint(scene, q, v, t, of_functions)
    return Rows(*(_drop(scene, jnp.concatenate(part)) for part in zip(*parts, strict=True)))


def constraint_jacobian(scene: Scene, q: Float[Array, " nq"], t: Numbers = 0.0) -> Float[Array, "nc nv"]:
    r"""Rows A(q, t) (nc, nv) of all constraints.

    $$A v = b, \quad \tau_\mathrm{constraint} = A^T \lambda$$

    hold for admissible velocities v and the forces of the constraints.

    **Arguments:** `q` (nq,); `t`, s.

    **Returns:** rows in the scene's order, those of a constraint's residual phi before those of its velocity residual w. A acts
    on the velocity v, which is dq/dt only where nq = nv.

    **Raises:** ValueError for constraints that do not fit the system, and a scene without any.

    Source: EQUATIONS section 7.
    """
    scene = as_scene(scene)
    q, t = check_state(scene.system, q=q, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints; add some to have rows")
    return _jacobian(scene, q, t)


@kernel
def _jacobian(scene: Scene, q, t):
    at_rest = jnp.zeros((scene.nv,), q.dtype)
    parts = _by_constraint(scene, q, at_rest, t, lambda others: (_by_differentiation(others, q, t),))
    return _drop(scene, jnp.concatenate([part[0] for part in parts]))


def _by_constraint(scene: Scene, q, v, t, of_functions: Callable) -> list[Any]:
    """A, gamma and velocity of each constraint of a group; of all others their rows of `of_functions(a scene of these)`."""
    layout(scene)  # raises for entries that are no constraints, and for constraints that do not fit the system
    results: list[Any] = [None] * len(scene.constraints)
    for places in _groups(scene):
        members = [scene.constraints[i] for i in places]
        for i, value in zip(places, members[0].group_rows(members, scene.system, q, v, t), strict=True):
            results[i] = value
    rest = [i for i, value in enumerate(results) if value is None]
    if rest:
        others = Scene(scene.system, tuple(scene.constraints[i] for i in rest))
        values = of_functions(others)
        for i, place in zip(rest, layout(others), strict=True):
            results[i] = tuple(x[place.start : place.end] for x in values)
    return results


def _by_differentiation(scene: Scene, q, t):
    # psi is affine in v, so that A does not depend on where it is taken. Reverse mode costs a pass per row, forward mode one per
    # column.
    differentiate = jax.jacrev if layout(scene)[-1].end < scene.nv else jax.jacfwd
    return differentiate(lambda v: _by_functions(scene, q, v, t))(jnp.zeros((scene.nv,), q.dtype))


def _positions(scene: Scene, q, t) -> list:
    """phi of each constraint (None without a holonomic part), those of one group computed together."""
    residuals: list[Any] = [None] * len(scene.constraints)
    for i, constraint in enumerate(scene.constraints):
        if constraint.group() is None:
            residuals[i] = constraint.position(scene.system, q, t)
    for places in _groups(scene):
        members = [scene.constraints[i] for i in places]
        for i, value in zip(places, members[0].group_positions(members, scene.system, q, t), strict=True):
            residuals[i] = value
    return residuals


def _groups(scene: Scene):
    """Indices of the constraints of each group, in the scene's order."""
    groups: dict[Any, list[int]] = {}
    for i, constraint in enumerate(scene.constraints):
        if constraint.group() is not None:
            groups.setdefault(constraint.group(), []).append(i)
    return groups.values()


def _own_name(name, function, default: str) -> str:
    given = getattr(function, "__name__", default)
    return check_new_name(name, default if given == "<lambda>" else given)
