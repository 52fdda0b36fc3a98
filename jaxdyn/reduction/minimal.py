"""Reduction to minimal velocities, v = N(q, t) nu + v0(q, t) with A N = 0 and A v0 = b, and to quasi velocities.

With s = Ndot nu + v0dot, the rate of v at constant nu, the motion along the columns of N is

    N^T M N nudot + N^T (M s + h) = N^T tau,   a = N nudot + s.

The columns of N are the partial velocities of Kane's equations, whose generalised active and inertia forces these are.
N is one of `bases`.
Source: Murray, Li & Sastry (1994), section 6.1; EQUATIONS section 6.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxdyn.compile import entry_point, kernel
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import constraint_jacobian, layout, rows
from jaxdyn.constraints.codes import RESULTS, Outcome, require_finite
from jaxdyn.constraints.dynamics import total_force
from jaxdyn.constraints.rank import RESIDUAL, eps_of, pseudo_inverse, rank_of, tolerance
from jaxdyn.constraints.redundancy import distribute_multipliers
from jaxdyn.constraints.selection import independent_rows, rank_code
from jaxdyn.dynamics.quantities import bias_force, coriolis_matrix, inverse_dynamics, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, as_float, as_shape, check_state, zeros_if_none
from jaxdyn.reduction.bases import (
    COLUMNS,
    Basis,
    BasisLike,
    FullBasis,
    Parametrization,
    VelocityAndDrift,
    as_basis,
    count_dof,
    min_quality,
    orthonormal,
    split_directions,
)
from jaxdyn.systems.mass_factor import cholesky, is_definite, solve_cholesky, solve_lower
from jaxdyn.systems.scene import Scene, as_scene
from jaxdyn.systems.system import SceneLike, has_coordinate_rates, velocity_to_rate


class ReducedDynamics(Outcome):
    """Equations of motion in minimal velocities, M_r nudot + h_r = tau_r, and their solution.

    - `nu_rate` (nr,): nudot. `velocity`, `acceleration` (nv,): v = N nu + v0 and its rate a.
    - `mass_matrix` (nr, nr) = N^T M N; `bias_force` (nr,) = N^T (M s + h) with s = Ndot nu + v0dot; `force` (nr,) =
      N^T (tau + forces). Units: those of N^T times N or N m.
    - `basis` (nv, nr): N. `result`: one of `jd.RESULTS`.
    """

    nu_rate: Float[Array, " nr"]
    velocity: Float[Array, " nv"]
    acceleration: Float[Array, " nv"]
    mass_matrix: Float[Array, "nr nr"]
    bias_force: Float[Array, " nr"]
    force: Float[Array, " nr"]
    basis: Float[Array, "nv nr"]
    result: Any


def reduced_dynamics(
    scene: Scene,
    q: Float[Array, " nq"],
    nu: Float[Array, " nr"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    basis: BasisLike | None = None,
) -> ReducedDynamics:
    r"""Motion in minimal velocities.

    $$N^T M N \dot\nu + N^T (M (\dot N \nu + \dot v_0) + h) = N^T (\tau + \tau_\mathrm{forces})$$

    The rates of N and v0 along the motion come from automatic differentiation, also for b(q, t) != 0.

    **Arguments:**

    - `q` (nq,), on the constraints; `nu` (nr,), minimal velocities; `tau` (nv,), N m or N (None: zero); `t`, s.
    - `basis`, the choice of N and nu. A tuple of indices: nu are these entries of v. A function N(q, t) -> (nv, nr), or
      -> (N, v0), with $A N = 0$ and $A v_0 = b$; a plain function is static, a Module carries leaves. A matrix R (nv, nr),
      such as `tangent_basis`: N is the orthonormal basis of ker A closest to R in the sense of `Orthonormal`. A scene
      without constraints needs none: $\nu = v$, $M_r = M$, $h_r = h$.

    **Returns:** `ReducedDynamics`. Where N is invalid (a singular A2, columns that are dependent or violate
    the rows, a rank other than nv - nr) the result is `singular_basis`.

    **Raises:** ValueError for inconsistent shapes, a missing basis, one for a scene without constraints, and, on
    concrete numbers, an invalid basis, with a valid one.

    Source: EQUATIONS section 6; Kane & Levinson (1985), section 6.1.
    """
    scene = as_scene(scene)
    tau = zeros_if_none(tau, scene.nv)
    q, tau, time = check_state(scene.system, q=q, tau=tau, t=t)
    if layout(scene):
        scene, choice = independent_rows(scene, q, time), as_basis(basis, scene)
    elif basis is None:
        choice = FullBasis()
    else:
        raise ValueError(f"the scene has no constraints, so that nu = v; basis is {basis!r}, omit it")
    size = choice.size(scene)
    # A basis without a size checks the columns that it computes.
    nu = as_array(nu, "nu", q.dtype) if size is None else as_shape(nu, "nu", q.dtype, (size,), of=COLUMNS)
    dynamics = _reduce_compiled(scene, choice, q, nu, tau, time)
    dynamics = eqx.tree_at(lambda x: x.result, dynamics, rank_code(scene, dynamics.result))
    singular = dynamics.result == RESULTS.singular_basis
    # Under tracing only the code `singular_basis` can report it.
    if is_concrete(singular) and bool(singular):
        raise ValueError(f"basis is not valid at this q: {choice.advice(scene, q, time)}")
    return dynamics


def reduce(scene: Scene, choice: Basis, q, nu, tau, t) -> ReducedDynamics:
    """Solve `reduced_dynamics` in traced numbers, for a checked `Basis`."""
    return kernel(_reduce)((scene, choice), q, nu, tau, t)


def _reduce(given: tuple[Scene, Basis], q, nu, tau, t) -> ReducedDynamics:
    scene, choice = given
    return solve_in_basis(scene, choice.along(scene, q, nu, t), q, tau, t)


def solve_in_basis(scene: Scene, motion: VelocityAndDrift, q, tau, t) -> ReducedDynamics:
    """Solve the equations of motion in the minimal velocities of a `VelocityAndDrift`."""
    v, drift, N, quality = motion
    # Only inertia at constant nu enters the bias: inverse dynamics at the drift gives N^T (M s + h) in one pass.
    mass = matmul(N.T, matmul(mass_matrix(scene.system, q, t), N))
    bias = matmul(N.T, inverse_dynamics(scene.system, q, v, drift, t))
    force = matmul(N.T, total_force(scene, q, v, tau, t))
    factor = cholesky(mass)
    rate = solve_cholesky(factor, force - bias)
    result = RESULTS.where(is_definite(mass, factor), RESULTS.successful, RESULTS.singular_mass_matrix)
    # The sign of the quality is that of a determinant, and no measure.
    is_regular = jnp.abs(quality) > min_quality(q.dtype)
    result = require_finite(RESULTS.where(is_regular, result, RESULTS.singular_basis), rate)
    return ReducedDynamics(rate, v, matmul(N, rate) + drift, mass, bias, force, N, result)


_reduce_compiled = entry_point(reduce)


def minimal_velocity(parametrization: Parametrization, v: Float[Array, " nv"]) -> Float[Array, " nr"]:
    """Minimal velocities nu (nr,) with N nu + v0 = v for an admissible v."""
    # Exact for an admissible v; the least-squares fit for any other.
    factor = cholesky(matmul(parametrization.N.T, parametrization.N))
    return solve_cholesky(factor, matmul(parametrization.N.T, v - parametrization.v0))


# Gauge-invariant form of constrained dynamics: quasi velocities in which the mass matrix is 1.
#
# With any W, W W^T = M, the quasi velocity w = W^T v, the force u = W^-1 (tau - N), rows Lam = A W^-T:
#
#     wdot + Gamma w = u + Lam^T lam,   Lam wdot = kappa = gamma + A W^-T Wdot^T v,   Gamma = W^-1 (C - W Wdot^T) W^-T,
#
# Gamma skew. An orthogonal V = [V1 V2] with Lam V = [Lam_r 0] splits this into equations of motion and of constraint force:
#
#     wdot_r + Gamma_r w_r = u_r,               Gamma_r = V2^T Gamma V2 + V2^T V2dot,
#     Gamma_o w_r          = u_o + Lam_r^T lam,   Gamma_o = V1^T Gamma V2 + V1^T V2dot,
#
# for w_r = V2^T w and constraints A v = 0; rows A v = b add terms in V1^T w = Lam_r^+ b. W -> W Q and V2 -> V2 Q with
# orthogonal Q change the form and not the motion: the gauge. Here V is parallel-transported, V2^T V2dot = 0, and
# V1^T V2dot = -Lam_r^+ Lamdot V2. Source: EQUATIONS section 9, with errata E23 to E26.


class GaugeInvariantDynamics(Outcome):
    """Quasi velocities, their equations of motion and of constraint force, and the solution.

    - `W` (nv, nv), M = W W^T. `velocity` (nv,), w = W^T v. `Gamma` (nv, nv), skew. `Lambda` (nc, nv) = A W^-T. `force`
      (nv,), u. Quasi velocities are in sqrt(J), forces and accelerations in sqrt(J)/s.
    - `V1` (nv, nv - nr), `V2` (nv, nr): orthonormal bases of the constraint forces and of the motions.
    - Equation of motion: `reduced_velocity` (nr,) w_r, `Gamma_r` (nr, nr), skew, `reduced_force` (nr,) u_r, and
      `reduced_acceleration` (nr,), the rate of w_r.
    - Equation of constraint force: `Gamma_o` (nv - nr, nr), `normal_force` (nv - nr,) u_o, `Lambda_r` (nc, nv - nr).
    - `acceleration` (nv,), rate of v; `multipliers` (nc,), those of least norm; `result` as in `ConstrainedDynamics`.
    """

    W: Float[Array, "nv nv"]
    velocity: Float[Array, " nv"]
    Gamma: Float[Array, "nv nv"]
    Lambda: Float[Array, "nc nv"]
    force: Float[Array, " nv"]
    V1: Float[Array, "nv no"]
    V2: Float[Array, "nv nr"]
    reduced_velocity: Float[Array, " nr"]
    Gamma_r: Float[Array, "nr nr"]
    reduced_force: Float[Array, " nr"]
    reduced_acceleration: Float[Array, " nr"]
    Gamma_o: Float[Array, "no nr"]
    normal_force: Float[Array, " no"]
    Lambda_r: Float[Array, "nc no"]
    acceleration: Float[Array, " nv"]
    multipliers: Float[Array, " nc"]
    result: Any


def gauge_invariant(
    scene: Scene,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
    *,
    rotation: Float[Array, "n n"] | None = None,
    motion_rotation: Float[Array, "k k"] | None = None,
    dof: int | None = None,
    rank_tol: float | None = None,
) -> GaugeInvariantDynamics:
    r"""Decoupled equations of motion and of constraint force in quasi velocities.

    $$w = W^T v, \quad \dot w_r = u_r - \Gamma_r w_r, \quad \Lambda_r^T \lambda = \Gamma_o w_r - u_o$$

    Both equations have further terms where $b(q, t) \ne 0$.

    **Arguments:**

    - `q` (nq,), `v` (nv,), on the constraints; `tau` (nv,), N m or N (None: zero); `t`, s.
    - `rotation`, orthogonal (nv, nv): W is the Cholesky factor of M times this. `motion_rotation`, orthogonal (nr, nr):
      V2 is rotated by it. Neither changes the motion.
    - `dof`, `rank_tol` as in `tangent_basis`.

    **Returns:** `GaugeInvariantDynamics`. Where the rank of A is not nv - nr, or a rotation is not orthogonal, the result is
    `singular_basis`.

    Derivatives are exact where the rank is constant; V1 and V2 are parallel-transported.

    **Raises:** ValueError for a scene without constraints, inconsistent shapes, known rotations that are not orthogonal, and no
    degree of freedom.

    Source: EQUATIONS section 9.
    """
    scene = as_scene(scene)
    tau = zeros_if_none(tau, scene.nv)
    q, v, tau, t = check_state(scene.system, q=q, v=v, tau=tau, t=t)
    if not layout(scene):
        raise ValueError("the scene has no constraints, so there is nothing to decouple; use jd.forward_dynamics")
    scene = independent_rows(scene, q, t, rank_tol)
    dof = count_dof(scene, q, t, dof, rank_tol)
    rotation, motion_rotation = (
        None if value is None else as_float(value, name, (size, size), q.dtype)
        for name, value, size in (("rotation", rotation, scene.nv), ("motion_rotation", motion_rotation, dof))
    )
    for name, value in (("rotation", rotation), ("motion_rotation", motion_rotation)):
        if value is not None and is_concrete(value) and not bool(_is_orthogonal(value)):
            raise ValueError(
                f"{name} is {value.tolist()}, which is not orthogonal; give Q with Q^T Q = 1, as from jnp.linalg.qr"
            )
    return _decouple(scene, q, v, tau, t, rotation, motion_rotation, dof, rank_tol)


def _is_orthogonal(rotation: Float[Array, "n n"] | None) -> Bool[Array, ""]:
    """Decide whether a matrix is orthogonal to the rounding error of its construction; None is the identity."""
    if rotation is None:
        return jnp.asarray(True)
    off = matmul(rotation.T, rotation) - jnp.eye(rotation.shape[0], dtype=rotation.dtype)
    return jnp.max(jnp.abs(off)) <= eps_of(rotation) ** RESIDUAL


def quasi_connection(
    system: SceneLike, q: Float[Array, " nq"], v: Float[Array, " nv"], t: Numbers = 0.0
) -> Float[Array, "nv nv"]:
    r"""Li and Wu's connection of quasi velocities, which is not skew.

    $$\Gamma = W^{-1} \left(\dot W - \frac{\partial w^T}{\partial q}\right), \quad w = W(q)^T \dot q, \quad M = W W^T$$

    With the force u = W^-1 (tau - N) and without constraints, wdot + Gamma w = u. `gauge_invariant` returns the skew matrix with
    the same product Gamma w.

    **Arguments:** a system with nq = nv whose velocities are the rates of its coordinates; `q`, `v` (n,); `t`, s.

    **Returns:** (n, n), 1/s, with the Cholesky factor W of M.

    **Raises:** ValueError for a system whose velocities are not the rates of its coordinates.

    Source: EQUATIONS section 9, with erratum E25.
    """
    of: Any = as_scene(system).system
    q, v, t = check_state(of, q=q, v=v, t=t)
    if of.nq != of.nv or not has_coordinate_rates(of):
        raise ValueError(
            "the velocities of the system are not the rates of its coordinates (planar, spherical and free joints); "
            "jd.reduction.gauge_invariant has the skew form for these"
        )

    def root(q, t):
        return cholesky(mass_matrix(of, q, t))

    time = jnp.asarray(t, q.dtype)
    W, Wdot = jax.jvp(root, (q, time), (v, jnp.ones_like(time)))
    # Row i of dw^T/dq holds the derivatives by q_i.
    slope = jax.jacfwd(lambda q: matmul(root(q, time).T, v))(q).T
    return solve_lower(W, Wdot - slope)


class KaneEquation(NamedTuple):
    """Stacked equation d/dt (q, w_r) = `matrix` @ `reduced_velocity` + `force`, and its `result`.

    `matrix` (nq + nr, nr), `force` (nq + nr,), `reduced_velocity` (nr,) w_r, in sqrt(J).
    """

    matrix: Float[Array, "n nr"]
    force: Float[Array, " n"]
    reduced_velocity: Float[Array, " nr"]
    result: Any


def kane_equation(
    scene: Scene,
    q: Float[Array, " nq"],
    v: Float[Array, " nv"],
    tau: Float[Array, " nv"] | None = None,
    t: Numbers = 0.0,
) -> KaneEquation:
    r"""Kane's form of constrained dynamics: rates of coordinates and of reduced quasi velocities in one equation.

    $$\frac{d}{dt} \begin{pmatrix} q \\ w_r \end{pmatrix}
    = \begin{pmatrix} W^{-T} V_2 \\ -\Gamma_r \end{pmatrix} w_r + \begin{pmatrix} 0 \\ u_r \end{pmatrix}$$

    Where the rows have $b(q, t) \ne 0$, `force` has their further terms. **Arguments** and errors as in `gauge_invariant`.

    Source: EQUATIONS section 9, Kane form.
    """
    found = gauge_invariant(scene, q, v, tau, t)
    system = as_scene(scene).system
    q, v = check_state(system, q=q, v=v)
    along = jnp.linalg.solve(found.W.T, found.V2)
    rates = jax.vmap(lambda column: velocity_to_rate(system, q, column), in_axes=1, out_axes=1)(along)
    w_r = found.reduced_velocity
    rest = velocity_to_rate(system, q, v) - matmul(rates, w_r)
    force = jnp.concatenate([rest, found.reduced_acceleration + matmul(found.Gamma_r, w_r)])
    return KaneEquation(jnp.concatenate([rates, -found.Gamma_r]), force, w_r, found.result)


@entry_point
def _decouple(scene, q, v, tau, t, rotation, motion_rotation, dof, rank_tol) -> GaugeInvariantDynamics:
    system, unit = scene.system, jnp.eye(scene.nv, dtype=q.dtype)
    motion = velocity_to_rate(system, q, v), jnp.ones_like(t)
    turn = unit if rotation is None else rotation

    def root(q, t):
        return matmul(cholesky(mass_matrix(system, q, t)), turn)

    W, Wdot = jax.jvp(root, (q, t), motion)
    A, Adot = jax.jvp(lambda q, t: constraint_jacobian(scene, q, t), (q, t), motion)
    # W turn^T is triangular: W^-1 by substitution, without a general inverse.
    inverse = matmul(turn.T, solve_lower(matmul(W, turn.T), unit))
    C = coriolis_matrix(system, q, v, t)
    w = matmul(W.T, v)
    # Skew, because M = W W^T gives dM/dt = Wdot W^T + W Wdot^T, and dM/dt - 2 C is skew.
    Gamma = matmul(matmul(inverse, C) - Wdot.T, inverse.T)
    # h - C v leaves N: the Coriolis forces are in Gamma.
    u = matmul(inverse, total_force(scene, q, v, tau, t) - bias_force(system, q, v, t) + matmul(C, v))
    Lambda = matmul(A, inverse.T)
    # Lam = A W^-T: its rate along the motion.
    rate = matmul(Adot - matmul(Lambda, Wdot.T), inverse.T)
    # kappa: the rows A a = gamma in terms of wdot = W^T a + Wdot^T v.
    wanted = rows(scene, q, v, t).gamma + matmul(Lambda, matmul(Wdot.T, v))

    back = pseudo_inverse(Lambda, tolerance(rank_tol, Lambda))
    null_projector = unit - matmul(back, Lambda)
    # Constants: eigenvectors of equal eigenvalues have no derivative.
    reference = split_directions(null_projector)
    # Projecting constant references makes the bases smooth, and gives them the parallel transport V2^T V2dot = 0.
    V1, *_ = orthonormal(matmul(unit - null_projector, reference[:, : scene.nv - dof]))
    V2, *_ = orthonormal(matmul(null_projector, reference[:, scene.nv - dof :]))
    V2 = V2 if motion_rotation is None else matmul(V2, motion_rotation)
    Lambda_r = matmul(Lambda, V1)
    # V1^T V2dot, from d/dt (Lam V2) = 0; Lam_r has independent columns and Lam_r^+ = V1^T Lam^+.
    leaning = -matmul(matmul(V1.T, back), matmul(rate, V2))
    free = u - matmul(Gamma, w)
    change = matmul(null_projector, free) + matmul(back, wanted)
    rank = rank_of(Lambda, back)
    # The bases have a static number of columns, which is valid for this rank alone.
    is_valid = (rank == scene.nv - dof) & _is_orthogonal(rotation) & _is_orthogonal(motion_rotation)
    result = RESULTS.where(is_valid, RESULTS.successful, RESULTS.singular_basis)
    result = rank_code(scene, result)
    a = matmul(inverse.T, change - matmul(Wdot.T, v))
    return GaugeInvariantDynamics(
        W=W,
        velocity=w,
        Gamma=Gamma,
        Lambda=Lambda,
        force=u,
        V1=V1,
        V2=V2,
        reduced_velocity=matmul(V2.T, w),
        Gamma_r=matmul(V2.T, matmul(Gamma, V2)),
        reduced_force=matmul(V2.T, u),
        reduced_acceleration=matmul(V2.T, free) + matmul(leaning.T, matmul(V1.T, w)),
        Gamma_o=matmul(V1.T, matmul(Gamma, V2)) + leaning,
        normal_force=matmul(V1.T, u),
        Lambda_r=Lambda_r,
        acceleration=a,
        # (Lam^T)^+ gives the multipliers of least norm where rows are dependent.
        multipliers=distribute_multipliers(scene, q, t, matmul(back.T, matmul(back, wanted) - free)),
        result=require_finite(result, a),
    )
