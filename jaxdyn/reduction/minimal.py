"""Reduction to minimal velocities: v = N(q, t) nu + v0(q, t) with A N = 0 and A v0 = b, without multipliers.

With s = Ndot nu + v0dot, the rate of v at constant nu, the motion along the columns of N is

    N^T M N nudot + N^T (M s + h) = N^T tau,   a = N nudot + s.

The columns of N are the partial velocities of Kane's equations, whose generalised active and inertia forces these are.
N is one of `bases`.
Source: Murray, Li & Sastry (1994), section 6.1; EQUATIONS section 6.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point, kernel
from jaxdyn.compile.known import is_concrete
from jaxdyn.constraints.base import layout
from jaxdyn.constraints.codes import RESULTS, Outcome, require_finite
from jaxdyn.constraints.dynamics import total_force
from jaxdyn.constraints.selection import independent_rows, rank_code
from jaxdyn.dynamics.quantities import inverse_dynamics, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Numbers, as_array, batch_hint, check_state, zeros_if_none
from jaxdyn.reduction.bases import (
    Basis,
    BasisLike,
    FullBasis,
    Parametrization,
    VelocityAndDrift,
    as_basis,
    least_quality,
)
from jaxdyn.systems.mass_factor import cholesky, is_definite, solve_cholesky
from jaxdyn.systems.scene import Scene, as_scene


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
    nu = as_array(nu, "nu", q.dtype)
    if layout(scene):
        scene, choice = independent_rows(scene, q, time), as_basis(basis, scene)
    elif basis is None:
        choice = FullBasis()
    else:
        raise ValueError(f"the scene has no constraints, so that nu = v; basis is {basis!r}, omit it")
    size = choice.size(scene)
    if size is not None and nu.shape != (size,):
        raise ValueError(f"nu has shape {nu.shape}, expected {(size,)} as the basis has columns{batch_hint(nu, (1,))}")
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
    is_regular = jnp.abs(quality) > least_quality(q.dtype)
    result = require_finite(RESULTS.where(is_regular, result, RESULTS.singular_basis), rate)
    return ReducedDynamics(rate, v, matmul(N, rate) + drift, mass, bias, force, N, result)


_reduce_compiled = entry_point(reduce)


def minimal_velocity(parametrization: Parametrization, v: Float[Array, " nv"]) -> Float[Array, " nr"]:
    """Minimal velocities nu (nr,) with N nu + v0 = v for an admissible v."""
    # Exact for an admissible v; the least-squares fit for any other.
    factor = cholesky(matmul(parametrization.N.T, parametrization.N))
    return solve_cholesky(factor, matmul(parametrization.N.T, v - parametrization.v0))
