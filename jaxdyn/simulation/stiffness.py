"""Stiffness of a scene: the rates of its linearised motion."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import array_namespace, is_known
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.dynamics.quantities import gravity_force, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, as_array, check_state, store_leaf
from jaxdyn.model.tree import Model
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_pytree, as_scene, check_force
from jaxdyn.systems.system import SceneLike, displace

# A step of an undamped oscillation may grow it by this much: explicit methods of order 8 do so at any length, if by little.
_GROWTH = 1e-3


class Stiffness(NamedTuple):
    """Rates of a linearised motion, and what they demand of explicit steps.

    - `decay`, 1/s: the fastest rate of decay; `frequency`, rad/s: the fastest oscillation.
    - `explicit_step`, s: length above which steps of Dopri8 are unstable, whatever the tolerance: an eigenvalue times the step is
      outside the region where a step amplifies a decaying mode by less than 1e-3. Infinite where all rates are zero. Other
      explicit methods are unstable earlier: RK4 from 0.54 of it on, Dopri5 and Tsit5 from 0.64 (decay) and 0.34 (oscillation).
    """

    decay: Float[Array, "..."]
    frequency: Float[Array, "..."]
    explicit_step: Float[Array, "..."]


@functools.cache
def _stable_radii() -> tuple[np.ndarray, np.ndarray]:
    """Angles from the negative real axis to the imaginary one, and how far Dopri8 is stable along each.

    Source: Hairer & Wanner 1996, section IV.2.
    """
    tableau: Any = diffrax.Dopri8.tableau
    A = np.zeros((tableau.num_stages,) * 2)
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    # R(z) = 1 + z b^T (1 - z A)^-1 1, a polynomial as A is nilpotent.
    coefficients, power = [1.0], np.ones(len(A))
    for _ in range(len(A)):
        coefficients.append(float(np.asarray(tableau.b_sol) @ power))
        power = A @ power
    angles, radii = np.linspace(0.0, np.pi / 2, 91), np.linspace(1e-3, 6.0, 6000)
    growth = np.abs(np.polyval(coefficients[::-1], -radii * np.exp(1j * angles[:, None])))
    return angles, radii[np.argmax(growth > 1 + _GROWTH, axis=1)]


def _rates(values) -> tuple:
    """Fastest decay and oscillation among the eigenvalues of a motion, and the longest step of Dopri8.

    A growing mode counts as an oscillation for the longest step.
    """
    xp = array_namespace(values)
    size = xp.abs(values)
    angles = xp.arctan2(xp.abs(values.imag), xp.maximum(-values.real, 0.0))
    stable = xp.interp(angles, *(xp.asarray(x, size.dtype) for x in _stable_radii()))
    rest = size <= 0
    step = xp.min(xp.where(rest, xp.inf, stable / xp.where(rest, xp.ones_like(size), size)), initial=xp.inf)
    decay, frequency = (xp.max(x, initial=0.0) + 0.0 for x in (-values.real, values.imag))  # and no -0.0
    return decay, frequency, step


def stiffness(
    scene: SceneLike,
    q: Numbers,
    v: Numbers,
    t: Numbers = 0.0,
    control: Checked[Callable[[Array, Array, Array], Array] | None] = None,
    drive_state: Numbers | None = None,
) -> Stiffness:
    r"""Fastest rates of the motion near a state.

    $$M \delta a + D \delta v + K \delta q = B \delta z, \quad \delta\dot z = R \delta q + S \delta v + Z \delta z$$

    $D = -\partial f / \partial v$, $K = -\partial f / \partial q$ and $B = \partial f / \partial z$, where f is the sum of
    the scene's forces, of `control(q, v, t)` behind the scene's drives and limits, and, for a system that is not a `Model`,
    of $-\partial V / \partial q$. z are the states of the drives, and R, S and Z the derivatives of their rates.
    Velocity-dependent inertial forces and the gravity of a `Model` are left out, as neither makes a motion stiff.
    $\delta q$ is along the manifold. On constraints $\delta a$, $\delta v$ and $\delta q$ are projected on their tangent
    space in the mass metric; the change of the rows along $\delta q$ is left out.

    **Arguments:** `scene`: a `Scene` or a system; `q` (nq,); `v` (nv,); `t`, s; `control`: forces control(q, v, t) -> (nv,), a
    function of the state; `drive_state`: z (n,), by default
    `scene.drive_state(q, v, t)`.

    **Raises:** ValueError for wrong shapes, and where forces or masses are not finite (NaN where numbers are traced).

    **Returns:** `Stiffness`, from the eigenvalues of
    $\begin{bmatrix} 0 & 1 & 0 \\ -M^{-1} K & -M^{-1} D & M^{-1} B \\ R & S & Z \end{bmatrix}$. An explicit method needs
    steps below `explicit_step`; where the motion itself would allow much longer ones, it is stiff.

    Source: Hairer & Wanner 1996, section IV.2.

    ```python
    rates = jd.stiffness(jd.Scene(model, forces=(jd.forces.JointDamping(1e3),)), q, v)
    ```
    """
    scene = as_scene(scene)
    control = None if control is None else as_pytree(control, "control")
    at: Any = check_state(scene.system, q=q, v=v, t=t)
    state = scene.drive_state(*at)
    if drive_state is not None:
        given = as_array(drive_state, "drive_state", at[0].dtype)
        if state is None or given.shape != state.shape:
            want = "None: the scene has no drives" if state is None else f"{state.shape} as of scene.drive_state(q, v)"
            raise ValueError(f"drive_state has shape {given.shape}, expected {want}")
        state = given
    matrix = _linearize(scene, *at, control, state)
    if is_known(matrix):
        # All by numpy, which compiles nothing.
        known = np.asarray(matrix, float)
        if not np.isfinite(known).all():
            raise ValueError(f"forces or masses are not finite at q = {q}, v = {v}, t = {t}; look at another state")
        values = np.linalg.eigvals(known)
    else:
        values = _eigenvalues(matrix)
    return Stiffness(*(store_leaf(x, matrix.dtype) for x in _rates(values)))


# One matrix after the other: batched calls of LAPACK within one program of XLA can wait for each other for ever.
@sequential_vmap
def _decompose(matrix):
    """Eigenvalues, eigenvectors in columns, and the inverse of these."""
    values, vectors = jnp.linalg.eig(matrix)
    return values, vectors, jnp.linalg.inv(vectors)


_eigenvalues = jax.custom_jvp(sequential_vmap(jnp.linalg.eigvals))


@_eigenvalues.defjvp
def _eigenvalues_jvp(primals, tangents):
    values, vectors, inverse = _decompose(*primals)
    return values, jnp.sum(inverse.T * matmul(tangents[0].astype(vectors.dtype), vectors), 0)


@entry_point
def _linearize(scene: Scene, q, v, t, control, state) -> Float[Array, "n n"]:
    """The matrix (2 nv + nz, 2 nv + nz) of d(dq, dv, dz)/dt."""
    system, n = scene.system, scene.nv
    if n == 0:
        return jnp.zeros((0, 0), q.dtype)

    rest = jnp.zeros((0,), v.dtype) if state is None else state

    def force_and_rates(dq, dv, dz):
        at, speed = displace(system, q, dq), v + dv
        command = jnp.zeros_like(v) if control is None else check_force(control(at, speed, t), q, n, "control")
        torque, rates = scene.drive_torque(at, speed, t, command, None if state is None else state + dz)
        force = scene.applied_force(at, speed, t)
        total = torque if force is None else torque + force
        if not isinstance(system, Model):
            total = total - gravity_force(system, at, t)
        return total, jnp.zeros_like(rest) if rates is None else rates

    # The rate of v is linear in the force: its derivative by the force is M^-1, or its projection on the constraints.
    mass = mass_matrix(system, q, t)
    unit = jnp.eye(n, dtype=mass.dtype)
    if scene.constraints:
        bare = scene.without_forces
        inverse = jax.jacfwd(lambda f: constrained_dynamics(bare, q, v, f, t).acceleration)(jnp.zeros_like(v))
        tangent = matmul(inverse, mass)
    else:
        inverse, tangent = solve_positive(mass, unit), unit
    force, rates = jax.jacfwd(force_and_rates, (0, 1, 2))(jnp.zeros_like(v), jnp.zeros_like(v), jnp.zeros_like(rest))

    def along(by_place, by_speed, by_state):
        return jnp.concatenate([matmul(by_place, tangent), matmul(by_speed, tangent), by_state], 1)

    none = jnp.zeros((n, rest.size), v.dtype)
    above = jnp.concatenate([jnp.zeros_like(tangent), tangent, none], 1)
    return jnp.concatenate([above, matmul(inverse, along(*force)), along(*rates)])
