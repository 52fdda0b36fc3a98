"""How a scene becomes an ordinary differential equation: the methods of `simulate`.

A method says what the state y of the equation is, how it changes, and what is done to it after a step:

    free         y = (q, v), no constraints
    multipliers  y = (q, v), accelerations with multipliers
    projected    the same, and q and v put back on the constraints after every step
    baumgarte    the same as multipliers, with A a = gamma - 2 alpha psi - beta^2 phi
    reduced      y = (q, nu), v = N(q, t) nu + v0(q, t)
    variational  no differential equation: steps of its own, for y = (q, v)
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.constraints.base import Rows, holonomic_rows, layout, position_residual, rows
from jaxdyn.constraints.codes import RESULTS
from jaxdyn.constraints.dynamics import constrained_dynamics, solve_rows
from jaxdyn.constraints.projection import project_state, project_step
from jaxdyn.constraints.rank import checked_tolerance
from jaxdyn.constraints.selection import (
    is_selected,
    missed_by_dropped,
    most_opening,
    most_rounding,
    opening_of_dropped,
    spread_multipliers,
)
from jaxdyn.constraints.tolerances import openness
from jaxdyn.dynamics.quantities import forward_dynamics
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Number, Numbers
from jaxdyn.reduction.bases import (
    Basis,
    BasisLike,
    Orthonormal,
    UserBasis,
    as_basis,
    least_quality,
    minimal_velocity,
    tangent_basis,
    velocity_and_drift,
)
from jaxdyn.reduction.minimal import solve_in_basis
from jaxdyn.simulation import variational
from jaxdyn.simulation.solvers import Stepper
from jaxdyn.simulation.solvers.choice import Solver, Stepsize, is_fixed
from jaxdyn.systems.scene import Scene, as_pytree
from jaxdyn.systems.system import needs_retraction, rate_to_velocity, retract, velocity_to_rate

State = dict[str, Any]  # arrays, and pytrees of them, by name


class Method(eqx.Module):
    """How a scene is integrated. The state is a dictionary of arrays with the entry "q"."""

    name: ClassVar[str] = "free"
    projects: ClassVar[bool] = False
    rank_tol: ClassVar[float | None] = None

    def stepper(self, solver: Solver, stepsize: Stepsize) -> Solver:
        """The solver to take: the one given, or the method's own."""
        return solver

    def start(self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> State:
        """State of the equation at (q, v)."""
        return {"q": q, "v": v}

    def to_qv(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array]:
        """q, with unit quaternions, and v of a state."""
        return retract(scene.system, y["q"]), y["v"]

    def rates(
        self,
        scene: Scene,
        y: State,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        force: Float[Array, " nv"] | None,
    ) -> State:
        """dy/dt; q and v are those of `to_qv`, `force` (nv,) is tau plus the scene's forces, or None."""
        return {"q": velocity_to_rate(scene.system, q, v), "v": self.acceleration(scene, q, v, t, force)}

    def evaluated(
        self, scene: Scene, y: State, t: Number, generalized_force: Callable[[Array, Array, Number], Array | None]
    ) -> tuple[State, Array | None, Array]:
        """dy/dt with generalized_force(q, v, t) for the force; the force (nv,) or None; and v (nv,)."""
        q, v = self.to_qv(scene, y, t)
        force = generalized_force(q, v, t)
        return self.rates(scene, y, q, v, t, force), force, v

    def acceleration(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Rate of v, (nv,)."""
        return forward_dynamics(scene.system, q, v, jnp.zeros_like(v) if force is None else force, t)

    def multipliers(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Constraint forces along the rows, (nc,)."""
        return dynamics(scene, q, v, t, force).multipliers

    def satisfies(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Whether some acceleration meets all rows, ()."""
        return jnp.asarray(True)

    def corrects(self, scene: Scene) -> bool:
        """Whether `stepped` and `corrected` change a state."""
        return self.projects or needs_retraction(scene.system)

    def corrected(self, scene: Scene, y: State, t: Number) -> State:
        """The state put back between steps, where it is saved."""
        return self.stepped(scene, y, t, None)[0]

    def onto_constraints(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> tuple[Array, Array]:
        """q and v by the least change on the constraints, where the motion starts."""
        return project_state(scene, q, v, t)

    def stepped(self, scene: Scene, y: State, t: Number, error: State | None) -> tuple[State, State | None]:
        """The state put back after a step, and its estimated error (a state, or None) less what constraints remove."""
        return y | {"q": retract(scene.system, y["q"])}, error

    def continued(self, scene: Scene, y: State, t: Number) -> State:
        """The state as the next step starts from it: entries in `step_constants` may have changed."""
        return y

    @property
    def step_constants(self) -> tuple[str, ...]:
        """Entries of the state that are constant during a step."""
        return ()

    def quality(self, scene: Scene, y: State, t: Number) -> Array | None:
        """How far the state is from where the method fails (`Parametrization.quality`), None when it never does."""
        return None


class Free(Method):
    """No constraints."""


class Multipliers(Method):
    """Accelerations with multipliers; nothing keeps the constraints from opening as the local errors add up.

    **Arguments:** `rank_tol`, as in `constrained_dynamics`. Rows that depend on each other only on the constraints, as those
    of an overconstrained loop do, need one above what the stages of a step open: 1e-4 to 1e-6.
    """

    rank_tol: float | None = eqx.field(static=True, default=None, kw_only=True)
    name: ClassVar[str] = "multipliers"

    def __check_init__(self):
        checked_tolerance(self.rank_tol)

    def acceleration(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """From `constrained_dynamics`."""
        return dynamics(scene, q, v, t, force, self.rank_tol).acceleration

    def multipliers(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """From `constrained_dynamics`."""
        return dynamics(scene, q, v, t, force, self.rank_tol).multipliers

    def satisfies(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """From `constrained_dynamics`; rows that were dropped at the start may ask for something else now."""
        found = dynamics(scene, q, v, t, force, self.rank_tol)
        met = found.result != RESULTS.contradictory_rows
        return met & (missed_by_dropped(scene, q, v, t, found.acceleration) <= most_rounding(q.dtype))


class Projected(Multipliers):
    """Accelerations with multipliers, and the least change, in the mass metric, back onto the constraints.

    **Arguments:** `rank_tol`, as in `Multipliers`.
    """

    name: ClassVar[str] = "projected"
    projects: ClassVar[bool] = True

    def stepped(self, scene: Scene, y: State, t: Number, error: State | None) -> tuple[State, State | None]:
        """q and v on the constraints, quaternions of unit length; the error without its part normal to the constraints."""
        errors = () if error is None else (_error_of_place(scene, y["q"], error), error["v"])
        q, v, errors = project_step(scene, y["q"], y["v"], t, errors, self.rank_tol)
        if error is not None:
            error = error | {"q": velocity_to_rate(scene.system, q, errors[0]), "v": errors[1]}
        return y | {"q": q, "v": v}, error

    def corrected(self, scene: Scene, y: State, t: Number) -> State:
        """q and v on the constraints."""
        q, v = self.onto_constraints(scene, y["q"], y["v"], t)
        return y | {"q": q, "v": v}

    def onto_constraints(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number
    ) -> tuple[Array, Array]:
        """By the programs that correct a step."""
        none = jnp.zeros_like(v)
        return project_step(scene, q, v, t, (none, none), self.rank_tol)[:2]


class Baumgarte(Multipliers):
    """Accelerations that pull violated rows back, for comparison: the pull is an error where it is not zero.

    Holonomic rows: d2 phi/dt2 + 2 alpha dphi/dt + beta^2 phi = 0. Nonholonomic rows: d psi/dt + 2 alpha psi = 0.

    **Arguments:** `alpha`, `beta`, 1/s, positive.

    Source: Baumgarte (1972).
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]
    name: ClassVar[str] = "baumgarte"

    def __init__(self, alpha: Numbers = 10.0, beta: Numbers = 10.0):
        self.alpha, self.beta = jnp.asarray(alpha, float), jnp.asarray(beta, float)

    def acceleration(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Under the rows A a = gamma - 2 alpha psi - beta^2 phi."""
        row, holonomic = rows(scene, q, v, t), holonomic_rows(layout(scene))
        alpha, beta = self.alpha.astype(q.dtype), self.beta.astype(q.dtype)
        wanted = row.gamma - 2 * alpha * row.velocity
        wanted = wanted.at[holonomic].add(-(beta**2) * position_residual(scene, q, t))
        force = jnp.zeros_like(v) if force is None else force
        return solve_rows(scene, q, v, force, t, Rows(row.A, wanted, row.velocity)).acceleration


class Reduced(Method):
    """Minimal velocities nu are integrated, and q with the velocity v = N nu + v0 that they determine.

    Velocities satisfy the constraints by construction. For holonomic rows q is put back on them after every step.

    **Arguments:**

    - `basis`: what nu is, as in `reduced_dynamics`: a tuple of indices of independent velocities, or a function N(q, t).
      Where N becomes singular the run ends with the code `singular_basis`. By default an orthonormal basis
      that is continued from step to step, which serves as long as the rank of the rows is constant.
    - `dof`: number of minimal velocities of the default basis. By default nv less the rank of the rows on concrete
      numbers, and less their number on traced ones.
    """

    basis: Any
    dof: int | None = eqx.field(static=True)
    name: ClassVar[str] = "reduced"
    projects: ClassVar[bool] = True

    def __init__(self, basis: BasisLike | None = None, *, dof: int | None = None):
        given = callable(basis) and not isinstance(basis, Basis)
        self.basis = UserBasis(as_pytree(basis, "basis")) if given else basis
        self.dof = dof

    def fitted(self, scene: Scene, dof: int | None) -> "Reduced":
        """The method with its basis made for the scene; `dof` where it is known."""
        basis = None if self.basis is None else as_basis(self.basis, scene)
        return Reduced(basis, dof=dof if self.dof is None else self.dof)

    @property
    def step_constants(self) -> tuple[str, ...]:
        """The reference of an orthonormal basis."""
        return ("frame",) if self.basis is None or isinstance(self.basis, Orthonormal) else ()

    def _basis(self, y):
        return Orthonormal(y["frame"]) if self.step_constants else self.basis

    def _at(self, scene, y, q, t):
        return self._basis(y).at(scene, q, t)

    def start(self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number) -> State:
        """q, nu and, for an orthonormal basis, its reference."""
        y = {"q": q}
        if self.step_constants:
            reference = tangent_basis(scene, q, t, dof=self.dof) if self.basis is None else self.basis.reference
            y["frame"] = reference.astype(q.dtype)
        return y | {"nu": minimal_velocity(self._at(scene, y, q, t), v)}

    def to_qv(self, scene: Scene, y: State, t: Number) -> tuple[Array, Array]:
        """q, with unit quaternions, and v = N nu + v0."""
        q = retract(scene.system, y["q"])
        basis = self._at(scene, y, q, t)
        return q, matmul(basis.N, y["nu"]) + basis.v0

    def evaluated(
        self, scene: Scene, y: State, t: Number, generalized_force: Callable[[Array, Array, Number], Array | None]
    ) -> tuple[State, Array | None, Array]:
        """From the reduced equations, which share one factorisation of the rows with v."""
        q = retract(scene.system, y["q"])
        motion = velocity_and_drift(scene, self._basis(y), q, y["nu"], t)
        force = generalized_force(q, motion.v, t)
        return self._rates(scene, y, motion, q, t, force), force, motion.v

    def rates(
        self,
        scene: Scene,
        y: State,
        q: Float[Array, " nq"],
        v: Float[Array, " nv"],
        t: Number,
        force: Float[Array, " nv"] | None,
    ) -> State:
        """From the reduced equations; v is found anew."""
        return self._rates(scene, y, velocity_and_drift(scene, self._basis(y), q, y["nu"], t), q, t, force)

    def _rates(self, scene, y, motion, q, t, force):
        reduced = solve_in_basis(Scene(scene.system, scene.constraints), motion, q, force, t)
        fixed = {name: jnp.zeros_like(y[name]) for name in self.step_constants}
        return {"q": velocity_to_rate(scene.system, q, motion.v), "nu": reduced.nu_rate} | fixed

    def acceleration(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Rate of v."""
        return dynamics(scene, q, v, t, force).acceleration

    def corrects(self, scene: Scene) -> bool:
        """Where there are holonomic rows, quaternions, or a reference to be renewed."""
        return bool(holonomic_rows(layout(scene)).size or self.step_constants or needs_retraction(scene.system))

    def stepped(self, scene: Scene, y: State, t: Number, error: State | None) -> tuple[State, State | None]:
        """q on the holonomic constraints, its error without the part normal to them; nu stays."""
        if not holonomic_rows(layout(scene)).size:
            return super().stepped(scene, y, t, error)
        errors = () if error is None else (_error_of_place(scene, y["q"], error),)
        q, _, errors = project_step(scene, y["q"], jnp.zeros((scene.nv,), y["q"].dtype), t, errors)
        if error is not None:
            error = error | {"q": velocity_to_rate(scene.system, q, errors[0])}
        return y | {"q": q}, error

    def continued(self, scene: Scene, y: State, t: Number) -> State:
        """N(q) as the new reference, which leaves N(q) and nu as they are."""
        return y | {"frame": self._at(scene, y, y["q"], t).N} if self.step_constants else y

    def quality(self, scene: Scene, y: State, t: Number) -> Array | None:
        """Of N at the state."""
        return self._at(scene, y, retract(scene.system, y["q"]), t).quality


class Variational(Multipliers):
    """Steps of a fixed length that follow a discrete principle of d'Alembert for long motions
    (see `jaxdyn.simulation.variational`).

    Order 2. Without forces and rows on velocities the steps are symplectic: the error of the energy stays as it is after
    a few oscillations, of the order h^2, however many steps follow, and momenta that symmetries conserve are conserved
    to rounding. Rows on positions are closed at the end of every step, and velocities projected. For rows on velocities
    (rolling, knife edges) the steps are those of the discrete Lagrange-d'Alembert principle, equal to their inverse with
    -h; energy is then kept well in reversible motions and not in general.

    Each step solves for its mean velocity by Newton's method, with the exact Jacobian; where that fails the run ends with
    the code `nonlinear_divergence`. Derivatives are those of the solved equations.

    **Arguments:** `rank_tol`, as in `Multipliers`.

    Sources: Marsden & West (2001); Hairer, Lubich & Wanner (2006), chapters VI and VII; Cortes & Martinez (2001).

    ```python
    motion = jd.simulate(scene, q0, v0, ts, method="variational", stepsize=0.01)
    ```
    """

    name: ClassVar[str] = "variational"
    projects: ClassVar[bool] = True

    def stepper(self, solver: Solver, stepsize: Stepsize) -> Solver:
        """Its own. **Raises:** ValueError for another one, and for steps that are not fixed."""
        if solver is not None:
            raise ValueError(
                f"solver is {type(solver).__name__}; method 'variational' makes its steps itself: leave solver out"
            )
        if not is_fixed(stepsize):
            raise ValueError(
                f"stepsize is {stepsize!r}; method 'variational' takes fixed steps, as changing ones lose what it "
                "conserves: pass a number (s), e.g. stepsize=0.01"
            )
        return Stepper()

    def begin(self, scene: Scene, y: State, t: Number) -> variational.Carried:
        """What the first step takes beside y."""
        return variational.begin(scene, *self.to_qv(scene, y, t), t, self.rank_tol)

    def advance(
        self, scene: Scene, y: State, t0: Number, t1: Number, carried: variational.Carried, generalized_force: Callable
    ) -> tuple[State, Array, variational.Carried, Array]:
        """y at t1, the mean velocity of the step, the state of the method, and whether the step succeeded."""
        stepped = variational.step(scene, y["q"], y["v"], carried, t0, t1, generalized_force, self.rank_tol)
        mean, y1 = stepped.carried.mean, {"q": stepped.q, "v": stepped.v}
        if "work" in y:
            done = 0.0 if stepped.force is None else (t1 - t0) * jnp.sum(stepped.force * mean)
            y1 = y1 | {"work": y["work"] + done}
        return y1, mean, stepped.carried, stepped.solved

    def acceleration(
        self, scene: Scene, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Number, force: Float[Array, " nv"] | None
    ) -> Array:
        """Of the continuous motion."""
        return (super() if scene.constraints else Free()).acceleration(scene, q, v, t, force)

    def corrects(self, scene: Scene) -> bool:
        """No: steps end on the constraints."""
        return False

    def corrected(self, scene: Scene, y: State, t: Number) -> State:
        """Between steps: q and v on the constraints."""
        if not scene.constraints:
            return y
        q, v = project_state(scene, y["q"], y["v"], t, self.rank_tol)
        return y | {"q": q, "v": v}


def _error_of_place(scene: Scene, q, error) -> Array:
    """Estimated error of q as a displacement (nv,)."""
    return rate_to_velocity(scene.system, retract(scene.system, q), error["q"])


def dynamics(scene: Scene, q, v, t, force, rank_tol: float | None = None):
    """Acceleration and multipliers at a state; `force` (nv,) is tau plus the scene's forces, or None."""
    found = constrained_dynamics(Scene(scene.system, scene.constraints), q, v, force, t, rank_tol=rank_tol)
    if not is_selected(scene):
        return found
    shared = spread_multipliers(scene, q, t, found.multipliers)
    return eqx.tree_at(lambda found: found.multipliers, found, shared)


def is_regular(quality) -> Array:
    """Whether a quality (see `Method.quality`) is far enough from zero, also for NaN."""
    return jnp.abs(quality) > least_quality(quality.dtype)


def start_limit(dtype) -> float:
    """Part of the mechanism's length by which a start may be open: rounding of the numbers that were given."""
    return float(jnp.finfo(dtype).eps) ** 0.4


def consistent(scene: Scene, q, v, t):
    """Whether a state is on the constraints but for rounding; rows that `keep_rows` has dropped are not looked at."""
    return openness(scene, q, v, t, start_limit(q.dtype)) <= 1.0


def meets_dropped_rows(scene: Scene, q, v, t):
    """Whether the rows that were dropped at the start of a motion are met still."""
    return opening_of_dropped(scene, q, t, v) <= most_opening(scene, q.dtype)
