"""Methods of `simulate`: ordinary differential equations of a scene.

A method defines the state y of the equation, its rate, and its correction after a step:

    free         y = (q, v), no constraints
    multipliers  y = (q, v), accelerations with multipliers
    projected    the same, with q and v projected onto the constraints after every step
    baumgarte    the same as multipliers, with A a = gamma - 2 alpha psi - beta^2 phi
    reduced      y = (q, nu), v = N(q, t) nu + v0(q, t)
    variational  no differential equation: steps of its own, for y = (q, v)
"""

from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxdyn.compile import evaluate
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import Rows, constraint_jacobian, holonomic_rows, layout, position_residual, rows
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.constraints.dynamics import constrained_dynamics, solve_rows
from jaxdyn.constraints.projection import project_state, project_step
from jaxdyn.constraints.rank import check_tolerance
from jaxdyn.constraints.redundancy import max_opening, opening_of_redundant, openness, residual_of_redundant
from jaxdyn.constraints.selection import max_rounding
from jaxdyn.dynamics.quantities import forward_dynamics
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers, as_float, check_count, state_dtype
from jaxdyn.model.configuration import neutral
from jaxdyn.model.tree import Model
from jaxdyn.reduction.bases import (
    Basis,
    BasisLike,
    Orthonormal,
    UserBasis,
    VelocityAndDrift,
    as_basis,
    min_quality,
    tangent_basis,
)
from jaxdyn.reduction.minimal import minimal_velocity, solve_in_basis
from jaxdyn.simulation.options import Solver, Stepsize
from jaxdyn.systems.scene import Scene, as_pytree, is_given
from jaxdyn.systems.system import (
    displace,
    has_dependent_coordinates,
    needs_retraction,
    rate_to_velocity,
    retract,
    velocity_to_rate,
)

State: TypeAlias = dict[str, Any]  # arrays, and pytrees of them, by name
StepEnd: TypeAlias = tuple[State, State | None, Array | None]  # of `Method.end_step`
Q: TypeAlias = Float[Array, " nq"]
V: TypeAlias = Float[Array, " nv"]
Force: TypeAlias = Float[Array, " nv"] | None


class Method(eqx.Module):
    """Method of integration. The state is a dictionary of arrays with the entry "q"."""

    name: ClassVar[str] = "free"
    projects: ClassVar[bool] = False
    rank_tol: ClassVar[float | None] = None

    def stepper(self, solver: Solver, stepsize: Stepsize) -> Solver:
        """Solver of the run: the given one, or the method's own."""
        return solver

    def start(self, scene: Scene, q: Q, v: V, t: Number) -> State:
        """State of the equation at (q, v)."""
        return {"q": q, "v": v}

    def to_qv(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array]:
        """Configuration q, with unit quaternions, and velocity v of a state."""
        return retract(scene.system, y["q"]), y["v"]

    def to_qv_and_basis(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array, VelocityAndDrift | None]:
        """Configuration and velocity of `to_qv`, and the velocity in the basis of minimal velocities, None without one."""
        return *self.to_qv(scene, y, t), None

    def rates(
        self, scene: Scene, y: State, q: Q, v: V, t: Number, force: Force, in_basis: VelocityAndDrift | None = None
    ) -> State:
        """Rate dy/dt; q, v are those of `to_qv`, and `in_basis` of `to_qv_and_basis`; `force` (nv,) as of `acceleration`."""
        return {"q": velocity_to_rate(scene.system, q, v), "v": self.acceleration(scene, q, v, t, force)}

    def acceleration(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """Rate of v, (nv,); `force` (nv,) is tau plus the scene's forces, or None."""
        return forward_dynamics(scene.system, q, v, jnp.zeros_like(v) if force is None else force, t)

    def multipliers(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """Constraint forces along the rows, (nc,)."""
        return dynamics(scene, q, v, t, force, self.rank_tol).multipliers

    def satisfies(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """True if some acceleration satisfies all rows, ()."""
        return jnp.asarray(True)

    def corrects(self, scene: Scene) -> bool:
        """True if `end_step` and `correct` change a state."""
        return self.projects or needs_retraction(scene.system)

    def correct(self, scene: Scene, y: State, t: Number) -> State:
        """Correct a state between steps, where it is saved."""
        return self.end_step(scene, y, t, None)[0]

    def project(self, scene: Scene, q: Q, v: V, t: Number) -> tuple[Array, Array]:
        """Project the start (q, v) onto the constraints by the least change."""
        return project_state(scene, q, v, t)

    def end_step(self, scene: Scene, y: State, t: Number, error: State | None) -> StepEnd:
        """Correct the state after a step, and take from its estimated error (a state, or None) what constraints remove.

        Also whether the kept rows are nearly dependent, None where that is not known (`are_rows_poor`).
        """
        return y | {"q": retract(scene.system, y["q"])}, error, None

    def renew(self, scene: Scene, y: State, t: Number) -> State:
        """Renew the entries of `step_constants` for the next step."""
        return y

    @property
    def step_constants(self) -> tuple[str, ...]:
        """Entries of the state that are constant during a step."""
        return ()

    def quality(self, scene: Scene, y: State, t: Number) -> Array | None:
        """Distance of the state from where the method fails (`Parametrization.quality`), None if it never does."""
        return None


class Free(Method):
    """No constraints."""


class Multipliers(Method):
    """Accelerations with multipliers; the constraints open as the local errors add up.

    **Arguments:** `rank_tol`, as in `constrained_dynamics`. The rows of an overconstrained loop depend on each other only on
    the constraints. They need a tolerance above the residuals at the stages of a step: 1e-4 to 1e-6.
    """

    rank_tol: float | None = eqx.field(static=True, default=None, kw_only=True)
    name: ClassVar[str] = "multipliers"

    def __check_init__(self):
        check_tolerance(self.rank_tol)

    def acceleration(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """Acceleration of `constrained_dynamics`."""
        return dynamics(scene, q, v, t, force, self.rank_tol).acceleration

    def satisfies(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """True if `constrained_dynamics` finds no contradiction, and the rows that were dropped at the start agree."""
        motion = dynamics(scene, q, v, t, force, self.rank_tol)
        is_solved = motion.result != RESULTS.contradictory_rows
        return is_solved & (residual_of_redundant(scene, q, v, t, motion.acceleration) <= max_rounding(q.dtype))


class Projected(Multipliers):
    """Accelerations with multipliers, and projection onto the constraints by the least change in the mass metric.

    **Arguments:** `rank_tol`, as in `Multipliers`.
    """

    name: ClassVar[str] = "projected"
    projects: ClassVar[bool] = True

    def end_step(self, scene: Scene, y: State, t: Number, error: State | None) -> StepEnd:
        """Project q and v onto the constraints, and the error onto their tangent space."""
        # An error of q is the rate of a displacement: as such it is tangent or normal to the constraints, with or without
        # quaternions.
        errors = () if error is None else (_position_error(scene, y["q"], error), error["v"])
        q, v, errors, is_poor = project_step(scene, y["q"], y["v"], t, errors, self.rank_tol)
        if error is not None:
            error = error | {"q": velocity_to_rate(scene.system, q, errors[0]), "v": errors[1]}
        return y | {"q": q, "v": v}, error, is_poor > 0

    def correct(self, scene: Scene, y: State, t: Number) -> State:
        """Project q and v onto the constraints."""
        q, v = self.project(scene, y["q"], y["v"], t)
        return y | {"q": q, "v": v}

    def project(self, scene: Scene, q: Q, v: V, t: Number) -> tuple[Array, Array]:
        """Project by the programs that correct a step."""
        # With errors of zero, so that it is the kernel of `end_step`, which is compiled anyway.
        none = jnp.zeros_like(v)
        return project_step(scene, q, v, t, (none, none), self.rank_tol)[:2]


class Baumgarte(Multipliers):
    r"""Accelerations with feedback of violated rows, for comparison: where the feedback is not zero it is an error.

    $$\ddot\phi + 2 \alpha \dot\phi + \beta^2 \phi = 0, \quad \dot\psi + 2 \alpha \psi = 0$$

    for holonomic rows $\phi$ and nonholonomic rows $\psi$.

    **Arguments:** `alpha`, `beta`, 1/s, positive.

    Source: Baumgarte (1972).
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]
    name: ClassVar[str] = "baumgarte"

    def __init__(self, alpha: Numbers = 10.0, beta: Numbers = 10.0):
        self.alpha, self.beta = (
            as_float(value, f"Baumgarte: {name}", (), float) for name, value in (("alpha", alpha), ("beta", beta))
        )

    def acceleration(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        r"""Acceleration under the rows with feedback of their violation.

        $$A a = \gamma - 2 \alpha \psi - \beta^2 \phi$$
        """
        row, holonomic = rows(scene, q, v, t), holonomic_rows(layout(scene))
        alpha, beta = self.alpha.astype(q.dtype), self.beta.astype(q.dtype)
        gamma = row.gamma - 2 * alpha * row.velocity
        # Only rows on positions have a residual phi.
        gamma = gamma.at[holonomic].add(-(beta**2) * position_residual(scene, q, t))
        force = jnp.zeros_like(v) if force is None else force
        return solve_rows(scene, q, v, force, t, Rows(row.A, gamma, row.velocity)).acceleration


class Reduced(Method):
    r"""Integration of minimal velocities, and of q with the velocity that they give.

    $$v = N \nu + v_0$$

    Velocities satisfy the constraints by construction. For holonomic rows q is projected onto them after every step.

    **Arguments:**

    - `basis`: definition of nu, as in `reduced_dynamics`: a tuple of indices of independent velocities, or a function N(q, t).
      Where N becomes singular the run ends with the code `singular_basis`. By default an orthonormal basis
      that is continued from step to step, which is valid as long as the rank of the rows is constant.
    - `dof`: number of minimal velocities of the default basis. By default nv less the rank of the rows on concrete
      numbers, and less their number on traced ones.
    """

    basis: Any
    dof: int | None = eqx.field(static=True)
    name: ClassVar[str] = "reduced"
    projects: ClassVar[bool] = True

    def __init__(self, basis: BasisLike | None = None, *, dof: int | None = None):
        # A function becomes a pytree, so that arrays which it holds are inputs of the compiled run and not constants.
        is_function = callable(basis) and not isinstance(basis, Basis)
        if basis is not None and not (is_function or isinstance(basis, (Basis, tuple, list, np.ndarray, jax.Array))):
            raise ValueError(
                f"basis is {basis!r}; give indices of independent velocities, a function N(q, t), a reference matrix, or None"
            )
        self.basis = UserBasis(as_pytree(basis, "basis", "q, t")) if is_function else basis
        self.dof = dof if dof is None else check_count(dof, "dof")

    def for_scene(self, scene: Scene, dof: int | None) -> "Reduced":
        """Method with the basis of a scene; `dof` where it is known."""
        basis = None if self.basis is None else as_basis(self.basis, scene)
        return Reduced(basis, dof=dof if self.dof is None else self.dof)

    @property
    def step_constants(self) -> tuple[str, ...]:
        """Name of the reference of an orthonormal basis."""
        return ("frame",) if self.basis is None or isinstance(self.basis, Orthonormal) else ()

    def _basis(self, y):
        # The reference is in the state: it is renewed after each step, and follows gradients and batches.
        return Orthonormal(y["frame"]) if self.step_constants else self.basis

    def _at(self, scene, y, q, t):
        return self._basis(y).at(scene, q, t)

    def start(self, scene: Scene, q: Q, v: V, t: Number) -> State:
        """State with q, nu and, for an orthonormal basis, its reference."""
        y = {"q": q}
        if self.step_constants:
            reference = tangent_basis(scene, q, t, dof=self.dof) if self.basis is None else self.basis.reference
            y["frame"] = reference.astype(q.dtype)
        return y | {"nu": minimal_velocity(self._at(scene, y, q, t), v)}

    def to_qv(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array]:
        """Configuration q, with unit quaternions, and velocity v."""
        q = retract(scene.system, y["q"])
        basis = self._at(scene, y, q, t)
        return q, matmul(basis.N, y["nu"]) + basis.v0

    def to_qv_and_basis(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array, VelocityAndDrift | None]:
        """Configuration, and v = N nu + v0 with dv/dt = N dnu/dt + drift from one decomposition of the rows."""
        q = retract(scene.system, y["q"])
        in_basis = self._basis(y).along(scene, q, y["nu"], t)
        return q, in_basis.v, in_basis

    def rates(
        self, scene: Scene, y: State, q: Q, v: V, t: Number, force: Force, in_basis: VelocityAndDrift | None = None
    ) -> State:
        """Rate of the reduced equations."""
        motion = self._basis(y).along(scene, q, y["nu"], t) if in_basis is None else in_basis
        # Without the scene's forces, which `force` includes.
        reduced = solve_in_basis(scene.without_forces, motion, q, force, t)
        fixed = {name: jnp.zeros_like(y[name]) for name in self.step_constants}
        return {"q": velocity_to_rate(scene.system, q, motion.v), "nu": reduced.nu_rate} | fixed

    def acceleration(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """Acceleration of `constrained_dynamics`."""
        return dynamics(scene, q, v, t, force).acceleration

    def corrects(self, scene: Scene) -> bool:
        """True if there are holonomic rows, quaternions, or a reference to be renewed."""
        return bool(holonomic_rows(layout(scene)).size or self.step_constants or needs_retraction(scene.system))

    def end_step(self, scene: Scene, y: State, t: Number, error: State | None) -> StepEnd:
        """Project q onto the holonomic constraints, and its error onto their tangent space; nu stays."""
        if not holonomic_rows(layout(scene)).size:
            return super().end_step(scene, y, t, error)
        errors = () if error is None else (_position_error(scene, y["q"], error),)
        q, _, errors, _ = project_step(scene, y["q"], jnp.zeros((scene.nv,), y["q"].dtype), t, errors)
        if error is not None:
            error = error | {"q": velocity_to_rate(scene.system, q, errors[0])}
        return y | {"q": q}, error, None

    def renew(self, scene: Scene, y: State, t: Number) -> State:
        """Take N(q) as the new reference, which changes neither N(q) nor nu."""
        return y | {"frame": self._at(scene, y, y["q"], t).N} if self.step_constants else y

    def quality(self, scene: Scene, y: State, t: Number) -> Array | None:
        """Quality of N at the state."""
        return self._at(scene, y, retract(scene.system, y["q"]), t).quality


def _position_error(scene: Scene, q, error) -> Array:
    """Estimated error of q as a displacement (nv,)."""
    return rate_to_velocity(scene.system, retract(scene.system, q), error["q"])


def dynamics(scene: Scene, q, v, t, force, rank_tol: float | None = None):
    """Acceleration and multipliers at a state; `force` (nv,) is tau plus the scene's forces, or None."""
    # `force` includes the scene's forces, so that the scene is passed without them: they would act twice.
    return constrained_dynamics(scene.without_forces, q, v, force, t, rank_tol=rank_tol)


def is_regular(quality) -> Array:
    """True if a quality (see `Method.quality`) is far enough from zero; false for NaN."""
    return jnp.abs(quality) > min_quality(quality.dtype)


def start_limit(dtype) -> float:
    """Largest residual of a start, relative to the mechanism's length: rounding of the numbers that were given."""
    # 5e-7 in float64 and 2e-3 in float32: far above eps, as a start may have been printed with few digits.
    return float(jnp.finfo(dtype).eps) ** 0.4


def consistent(scene: Scene, q, v, t):
    """True if a state is on the constraints up to rounding; rows that `keep_rows` has dropped are not checked."""
    return openness(scene, q, v, t, start_limit(q.dtype)) <= 1.0


def satisfies_redundant_rows(scene: Scene, q, v, t):
    """True if the rows that were dropped at the start of a motion are still satisfied."""
    return opening_of_redundant(scene, q, t, v) <= max_opening(scene, q.dtype)


def may_have_redundant_rows(scene: Scene) -> bool:
    """True where some set of coupled coordinates has at least as many rows as coordinates: it moves only if rows are redundant.

    True for a scene of rounded numbers, for one that is traced, and for one with dependent coordinates, too. A motion of exact
    numbers with redundant rows among fewer than that is right without a selection, by the rank at every evaluation, in short
    steps.
    """
    bare = scene.without_forces
    # Dependent coordinates at a generic configuration would have to be searched, from places that nobody has given.
    if scene.rounding or not is_concrete(bare) or has_dependent_coordinates(scene.system):
        return True
    # Away from the neutral configuration, at which entries of A may vanish that do not vanish elsewhere.
    step = np.random.default_rng(0).uniform(0.1, 0.9, scene.nv).astype(state_dtype(scene.system))
    try:
        is_coupled = np.abs(evaluate(_generic_rows, bare, step, is_input=is_given(bare))) > 0
    except jax.errors.JAXTypeError:  # a constraint is a function that holds a traced number
        return True
    # Connected components of the graph whose edges are the rows: a scene of two four-bars is two sets of coordinates.
    groups = np.arange(scene.nv)
    for row in is_coupled:
        groups[np.isin(groups, groups[row])] = groups[row].min(initial=scene.nv)
    counts = np.bincount([groups[row][0] for row in is_coupled if row.any()], minlength=scene.nv + 1)
    return bool(any(not row.any() for row in is_coupled) or any(counts[g] >= np.sum(groups == g) for g in set(groups)))


def _generic_rows(scene: Scene, step):
    system = scene.system
    start = neutral(system).astype(step.dtype) if isinstance(system, Model) else jnp.zeros((scene.nq,), step.dtype)
    return constraint_jacobian(scene, displace(system, start, step), jnp.zeros((), step.dtype))
