"""Variational steps on the joints' groups: the discrete principle of d'Alembert, solved step by step.

A step of length h goes from q0 along one constant velocity xi through the midpoint q = q0 exp(x), x = h xi/2, to
q1 = q0 exp(h xi). For the discrete Lagrangian h L(q, xi), with forces f at the midpoint and constraint forces at the
ends, the discrete Euler-Lagrange equations in left-trivialised momenta p = dL/dv are

    2 dL/dxi = J^T (p0+ + a + c),   p0+ = p0 + A(q0)^T lam0,   a = Ad^T p0+,   c = h (dL/dq + f)
    p1 = Ad^T (a + c) + A(q1)^T lam1,   J the left Jacobian of exp at x, Ad the adjoint of exp(x).

lam0 is such that phi(q1, t1) = 0 and, for rows on velocities, A xi = b at the midpoint; lam1 such that the velocity v1 of
p1 satisfies A v1 = b. On coordinates J and Ad are 1: this is the implicit midpoint rule, and with lam that of RATTLE.
The map (q0, p0) -> (q1, p1) is its own inverse with -h. Without forces and rows on velocities it is symplectic and keeps
the momenta of symmetries.

Sources: Marsden & West (2001), Discrete mechanics and variational integrators, sections 1.3, 3.2, 3.5; Hairer, Lubich &
Wanner (2006), Geometric Numerical Integration, sections VI.6, VII.1.4; Cortes & Martinez (2001), Non-holonomic
integrators; McLachlan & Perlmutter (2006), Integrators for nonholonomic mechanical systems; Lee, Liu, Park & Srinivasa
(2016), A linear-time variational integrator for multibody systems.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import eliminate
from jaxdyn.constraints.base import (
    constraint_jacobian,
    holonomic_rows,
    layout,
    nonholonomic_rows,
    position_residual,
    velocity_residual,
)
from jaxdyn.constraints.dynamics import correction
from jaxdyn.constraints.projection import project_state
from jaxdyn.constraints.rank import solve_square
from jaxdyn.dynamics.quantities import bias_force, mass_matrix
from jaxdyn.dynamics.tree_frames import body_twists, sum_to_coordinates, take, tree_frame
from jaxdyn.dynamics.world_frame import momentum, tree_inertias
from jaxdyn.lie import se2, se3, so3
from jaxdyn.lie.so3 import cross, matmul
from jaxdyn.model.arguments import Number
from jaxdyn.model.topology import SCREW_KINDS
from jaxdyn.model.tree import Model
from jaxdyn.simulation.methods import Force, Free, Multipliers, Q, State, V
from jaxdyn.simulation.options import Solver, Stepsize, is_step_length
from jaxdyn.systems.lagrangian import LagrangianSystem
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene
from jaxdyn.systems.system import displace

_GROUPS: dict[str, Any] = {"planar": se2, "spherical": so3, "free": se3}
# Newton's method keeps a Jacobian for up to six iterations while each one shrinks the change to less than 0.3 of the last.
_MAX_JACOBIANS = 8
_MAX_REPEATS = 6
_CONTRACTION = 0.3


class Carried(NamedTuple):
    """Data that a step passes to the next one in addition to (q, v).

    - `momentum` (nv,), without the last A^T lam1, which changes nothing; `mean` (nv,), the velocity xi of the last step.
    - `A` (nc, nv) of the rows, and `spare` (nc, nc), the projection on the combinations of them that vanish; or None.
    """

    momentum: Float[Array, " nv"]
    mean: Float[Array, " nv"]
    A: Float[Array, "nc nv"] | None
    spare: Float[Array, "nc nc"] | None


class Step(NamedTuple):
    """State (q, v) at the end of a step, data for the next one, force f at the midpoint, and whether it was solved."""

    q: Float[Array, " nq"]
    v: Float[Array, " nv"]
    carried: Carried
    force: Float[Array, " nv"] | None
    solved: Bool[Array, ""]


def begin(scene: Scene, q, v, t, rank_tol: float | None) -> Carried:
    """Data of the first step, for a state on the constraints."""
    A, _, spare = _rows(scene, q, t, rank_tol)
    return Carried(_lagrangian_derivatives(scene.system, q, v, t)[0], v, A, spare)


def make_step(
    scene: Scene, q, v, carried: Carried, t0, t1, generalized_force: Callable, rank_tol: float | None
) -> Step:
    """Make one step from t0 to t1.

    `generalized_force(q, v, t)` (nv,) is tau plus the scene's forces, or None. `v` only serves to guess the next velocity.
    Derivatives are those of the solved equations, by the implicit function theorem.
    """
    system, n, A = scene.system, scene.nv, carried.A
    h, middle = t1 - t0, 0.5 * (t0 + t1)
    holonomic, nonholonomic = holonomic_rows(layout(scene)), nonholonomic_rows(layout(scene))

    def halfway(xi):
        return displace(system, q, 0.5 * h * xi)

    def balance(z):
        """2 dL/dxi - J^T (p0+ + a + c), and Ad^T (a + c)."""
        xi, x = z[:n], 0.5 * h * z[:n]
        own, push = _lagrangian_derivatives(system, halfway(xi), xi, middle)
        force = generalized_force(halfway(xi), xi, middle)
        push = h * (push if force is None else push + force)
        left = carried.momentum if A is None else carried.momentum + matmul(A.T, z[n:])
        arrived = _transport(system, x, left)
        return 2 * own - _pull_back(system, x, left + arrived + push), _transport(system, x, arrived + push)

    def residual(z):
        xi, momentum = z[:n], balance(z)[0]
        if A is None:
            return momentum
        rows = []
        if holonomic.size:
            # Divided by h, so that all unknowns and all residuals are of the size of velocities.
            rows.append(position_residual(scene, displace(system, q, h * xi), t1) / h)
        if nonholonomic.size:
            rows.append(velocity_residual(scene, halfway(xi), xi, middle)[nonholonomic])
        rows = jnp.concatenate(rows)[np.argsort(np.concatenate([holonomic, nonholonomic]))]
        return jnp.concatenate([momentum, rows])

    def jacobian(function, z):
        """Jacobian of the residual. Unknowns that redundant rows leave undetermined are set to zero by `spare`."""
        matrix = jax.jacfwd(function)(z)
        return matrix if carried.spare is None else matrix.at[n:, n:].add(carried.spare)

    def solve_linear(linear, right):
        return solve_square(jacobian(linear, jnp.zeros_like(right)), right)

    # The mean velocities of two steps in turn have v between them as their mean.
    guess = lax.stop_gradient(2 * v - carried.mean)
    if A is not None:
        guess = jnp.concatenate([guess, jnp.zeros((A.shape[0],), q.dtype)])
    z, change = lax.custom_root(
        residual, guess, lambda f, z: _newton(f, lambda z: jacobian(f, z), z, n), solve_linear, has_aux=True
    )
    xi = z[:n]
    # Rounding of positions, of size q, is one of velocities, of size q/h; residuals of loops round where all angles are zero too.
    size = jnp.max(jnp.abs(xi)) + jnp.max(jnp.abs(q), initial=1.0) / jnp.abs(h)
    solved = change <= float(jnp.finfo(q.dtype).eps) ** 0.75 * size
    end, last = displace(system, q, h * xi), balance(z)[1]
    velocity = _velocity(system, end, last, t1)
    rows, right_inverse, spare = _rows(scene, end, t1, rank_tol)
    if right_inverse is not None:
        # The second projection removes the rounding of the first, which the size of the momentum sets.
        for _ in range(2):
            velocity = velocity - matmul(right_inverse, velocity_residual(scene, end, velocity, t1))
    return Step(end, velocity, Carried(last, xi, rows, spare), generalized_force(halfway(xi), xi, middle), solved)


def _newton(function, jacobian, z, n: int):
    """Root of `function`, and the last change of its first n entries.

    A Jacobian is kept as long as the changes shrink well, to rounding; where they do not, it is computed again.
    """
    eps = float(jnp.finfo(z.dtype).eps)

    def size(z):
        return jnp.max(jnp.abs(z[:n]))

    def repeats(state):
        z, change, before, count = state
        # The next change is estimated by the ratio of the last two.
        far = change * jnp.minimum(change / before, 1.0) > eps * size(z)
        return (count == 0) | (far & (change < _CONTRACTION * before) & (count < _MAX_REPEATS))

    def renew(state):
        z, _, before, count = state
        matrix = jacobian(z)
        inverse = eliminate(matrix, jnp.eye(len(matrix), dtype=matrix.dtype), eps)[0]

        def repeat(state):
            z, change, _, count = state
            move = -matmul(inverse, function(z))
            return z + move, size(move), change, count + 1

        z, change, before, _ = lax.while_loop(repeats, repeat, (z, before, before, 0))
        return z, change, before, count + 1

    def is_running(state):
        z, change, _, count = state
        return (change > eps**0.75 * size(z)) & (count < _MAX_JACOBIANS)

    # A change that is not known yet is infinite, so that both loops begin.
    unknown = jnp.asarray(jnp.inf, z.dtype)
    z, change, _, _ = lax.while_loop(is_running, renew, (z, unknown, unknown, 0))
    return z, change


def _lagrangian_derivatives(system, q, v, t):
    """Momentum dL/dv (nv,), and dL/dq (nv,) along the velocity coordinates."""
    if isinstance(system, Model):
        return _tree_derivatives(system, q, v)
    if isinstance(system, LagrangianSystem):
        pull, momentum = jax.grad(system.value, argnums=(0, 1))(q, v, t)
        return momentum, pull
    # M and h are all there is: dL/dq is what makes M a + h of the Euler-Lagrange equations.
    p, rate = jax.jvp(lambda q, t: matmul(mass_matrix(system, q, t), v), (q, t), (v, jnp.ones_like(t)))
    return p, rate - bias_force(system, q, v, t)


def _tree_derivatives(model: Model, q, v):
    """Derivatives p_k = S_k . H_k and dL/dq_k = ad_V(S_k) . H_k + S_k . W_k, in the tree frame.

    H_k and W_k are momentum and weight of all bodies that coordinate k moves, V the twist of the body that carries its
    joint: a displacement along S_k turns these bodies as one, and leaves V as it is.
    """
    topology = model.topology
    frame = tree_frame(model, q)
    inertias = tree_inertias(model, frame)
    twists = body_twists(model, frame, v)
    wrenches = [jax.vmap(momentum)(inertias, twists)]
    if model.gravity is not None:
        g = jnp.broadcast_to(model.gravity.astype(q.dtype)[None], (topology.nb, 3))
        wrenches += [inertias[:, :1] * g, jax.vmap(cross)(inertias[:, 1:4], g)]
    sums = sum_to_coordinates(model, jnp.concatenate(wrenches, axis=1))
    carrier = np.array(topology.parents)[topology.dof_body]
    # The base, whose index -1 becomes nb, stands behind the bodies as one at rest.
    at_rest = jnp.zeros((1, 6), q.dtype)
    bracket = jax.vmap(se3.ad_apply)(
        take(jnp.concatenate([twists, at_rest]), carrier % (topology.nb + 1)), frame.subspace
    )
    p, pull = (jnp.sum(rows * sums[:, :6], axis=1) for rows in (frame.subspace, bracket))
    if model.gravity is not None:
        pull = pull + jnp.sum(frame.subspace * sums[:, 6:], axis=1)
    return p if model.armature is None else p + model.armature * v, pull


def _velocity(system, q, p, t):
    """Velocity v (nv,) of the momentum dL/dv = p."""
    if isinstance(system, LagrangianSystem):  # L may have terms linear in v
        p = p - _lagrangian_derivatives(system, q, jnp.zeros_like(p), t)[0]
    return solve_positive(mass_matrix(system, q, t), p)


def _transport(system, x, p):
    """Momentum Ad_exp(x)^T p (nv,), joint by joint."""
    return _by_joint(system, x, p, lambda group, x, p: matmul(p, group.Ad(group.exp(x))))


def _pull_back(system, x, p):
    """Pull-back J(x)^T p (nv,), J the left Jacobian of exp, joint by joint."""
    return _by_joint(system, x, p, lambda group, x, p: matmul(p, group.left_jacobian(x)))


def _by_joint(system, x, p, function):
    """Value `function(group, x, p)` of joints that move on a group; p of the others, whose coordinates commute."""
    if not isinstance(system, Model) or set(system.topology.kinds) <= set(SCREW_KINDS):
        return p
    # Blocks of different sizes by joint: groups have no common shape that a vmap could take.
    parts = []
    for kind, place in zip(system.topology.kinds, system.topology.v_slices, strict=True):
        parts.append(p[place] if kind in SCREW_KINDS else function(_GROUPS[kind], x[place], p[place]))
    return jnp.concatenate(parts)


def _rows(scene: Scene, q, t, rank_tol):
    """Rows A, their right inverse in the metric M(q), and 1 - A A^-1, the projection on their dependencies."""
    if not scene.constraints:
        return None, None, None
    A = constraint_jacobian(scene, q, t)
    right_inverse = correction(scene, q, t, rank_tol, holonomic=False)
    spare = jnp.eye(A.shape[0], dtype=A.dtype) - matmul(A, right_inverse)
    # `spare` only determines unknowns without effect, so that its derivative has none either.
    return A, right_inverse, lax.stop_gradient(spare)


class Variational(Multipliers):
    """Variational steps of fixed length for long motions, by a discrete principle of d'Alembert.

    Order 2. Without forces and rows on velocities the steps are symplectic: the
    error of the energy is of the order $h^2$ and does not grow with the number of steps, and momenta that symmetries conserve
    are conserved to rounding. Rows on positions are closed at the end of every step, and velocities projected. For rows on
    velocities (rolling, knife edges) the steps are those of the discrete Lagrange-d'Alembert principle, equal to their inverse
    with -h; energy is then kept well in reversible motions and not in general.

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
        """Solver of the variational steps. **Raises:** ValueError for another one, and for steps that are not fixed."""
        if solver is not None:
            raise ValueError(
                f"solver is {type(solver).__name__}; method 'variational' has steps of its own: leave solver out"
            )
        if not is_step_length(stepsize):
            raise ValueError(
                f"stepsize is {stepsize!r}; method 'variational' takes fixed steps, because adaptive ones lose its "
                "conservation: pass a number (s), e.g. stepsize=0.01"
            )
        from jaxdyn.simulation.solvers.diffrax_methods import Stepper

        return Stepper()

    def begin(self, scene: Scene, y: State, t: Number) -> Carried:
        """Momentum and rows that the first step needs in addition to y."""
        return begin(scene, *self.to_qv(scene, y, t), t, self.rank_tol)

    def advance(
        self, scene: Scene, y: State, t0: Number, t1: Number, carried: Carried, generalized_force: Callable
    ) -> tuple[State, Array, Carried, Array]:
        """State y at t1, mean velocity of the step, what the next step needs, and whether the step succeeded."""
        step = make_step(scene, y["q"], y["v"], carried, t0, t1, generalized_force, self.rank_tol)
        mean, y1 = step.carried.mean, {"q": step.q, "v": step.v}
        if "work" in y:
            done = 0.0 if step.force is None else (t1 - t0) * jnp.sum(step.force * mean)
            y1 = y1 | {"work": y["work"] + done}
        return y1, mean, step.carried, step.solved

    def acceleration(self, scene: Scene, q: Q, v: V, t: Number, force: Force) -> Array:
        """Acceleration of the continuous motion."""
        return (super() if scene.constraints else Free()).acceleration(scene, q, v, t, force)

    def corrects(self, scene: Scene) -> bool:
        """False: steps end on the constraints."""
        return False

    def correct(self, scene: Scene, y: State, t: Number) -> State:
        """Project q and v onto the constraints between steps."""
        if not scene.constraints:
            return y
        q, v = project_state(scene, y["q"], y["v"], t, self.rank_tol)
        return y | {"q": q, "v": v}
