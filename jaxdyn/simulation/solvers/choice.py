"""Choice of solver, step-size control, adjoint and loop: the user's options as diffrax's objects, and who makes the steps.

Below, the stiffness of a scene, by which the solver is chosen.

The first row that applies decides.

    solver  given by the user               that one
            method "variational"            its own steps (`Stepper`)
            forces that are stiff           `Rodas5P`, for adaptive steps and concrete inputs
            stepsize a length               `RK4`
            else                            `Dopri8`
    loop    forces with modes               `hybrid/event_loop.py`
            else                            the rows of `_LOOPS`
"""

import functools
import importlib.util
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float

from jaxdyn.compile import entry_point
from jaxdyn.compile.known import array_namespace, is_known
from jaxdyn.constraints.dynamics import constrained_dynamics
from jaxdyn.dynamics.quantities import gravity_force, mass_matrix
from jaxdyn.lie.so3 import matmul
from jaxdyn.model.arguments import Checked, Numbers, as_array, check_state, store_leaf
from jaxdyn.model.tree import Model
from jaxdyn.simulation.options import ADJOINTS, Options, check_step_length, is_backsolve, is_step_length
from jaxdyn.simulation.solvers.base import Adaptive, ErrorMonitoredSteps
from jaxdyn.simulation.solvers.diffrax_methods import RK4, LieGroup, Rodas5P, Stepper
from jaxdyn.systems.mass_factor import solve_positive
from jaxdyn.systems.scene import Scene, as_pytree, as_scene, check_force
from jaxdyn.systems.system import SceneLike, displace

# Degree of the dense output, by the classes that diffrax's methods use.
_INTERPOLATION_DEGREE = {
    diffrax.LocalLinearInterpolation: 1,
    diffrax.ThirdOrderHermitePolynomialInterpolation: 3,
    diffrax.FourthOrderPolynomialInterpolation: 4,
}


def choose_solver(solver, stepsize):
    """Solver of a run (default: `Dopri8`, or `RK4` for fixed steps), refused if it does not suit the step size.

    **Raises:** ValueError that names `solver` or `stepsize` and the fix.
    """
    if solver is not None and not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver is {solver!r}; pass an instance of a diffrax solver, e.g. diffrax.Tsit5()")
    if is_step_length(stepsize):
        check_step_length(stepsize)
        solver = RK4() if solver is None else solver
    else:
        if isinstance(stepsize, diffrax.ConstantStepSize):
            raise ValueError("stepsize is a ConstantStepSize, which holds no length; pass the step as a number (s)")
        solver = diffrax.Dopri8() if solver is None else solver
        adaptive = stepsize is None or isinstance(stepsize, diffrax.AbstractAdaptiveStepSizeController)
        # The estimate of RK4 detects steps that are too long, and is too coarse to control them.
        if adaptive and (isinstance(solver, RK4) or not isinstance(solver, diffrax.AbstractAdaptiveSolver)):
            name = type(solver).__name__
            raise ValueError(f"solver {name} has no error estimate for adaptive steps; pass stepsize=, a number (s)")
    structure = solver.term_structure
    single = isinstance(structure, type) and issubclass(diffrax.ODETerm, structure)
    if not (single or is_split(solver)):
        name = type(solver).__name__
        raise ValueError(f"solver {name} does not take a single ODETerm; choose another, e.g. diffrax.Tsit5()")
    return solver


def stiff_rates(scene: Scene, q, v, t, control, span: float) -> "Stiffness | None":
    """Rates at a state where stability alone, and not accuracy, would limit explicit steps over a time; else None.

    None too where they are not finite, or the forces have no forward derivative, as callbacks. Dopri8, stable up to a decay of 5
    over a step, would take 1000 steps and more for a transient that is over at once. Oscillations do not count, because any
    method has to follow them. For the springs and dampers in docs/stiff.md this is where Rodas5P takes 7 to 20 times fewer
    steps, a larger factor than the cost of one of its steps for a dozen velocities.
    """
    try:
        rates = stiffness(scene, q, v, t, control)
    except (TypeError, ValueError, NotImplementedError, np.linalg.LinAlgError):
        return None  # the integration reports errors of the forces themselves
    return rates if np.isfinite(rates.decay) and span * rates.decay > 5000 else None


def label(solver: diffrax.AbstractSolver) -> str:
    """Name of a method, with that of the wrapped one in brackets."""
    name, inner = type(solver).__name__, getattr(solver, "solver", None)
    return f"{name}({label(inner)})" if isinstance(inner, diffrax.AbstractSolver) else name


def option_of(solver: diffrax.AbstractSolver) -> str:
    """The user's option by which a run has a method, for messages."""
    return "method is 'variational'" if isinstance(solver, Stepper) else f"solver is {label(solver)}"


def has_own_loop(solver: diffrax.AbstractSolver) -> bool:
    """True for a method whose steps the library makes itself: an explicit Runge-Kutta method, or `Rodas5P`."""
    # diffrax reports a method that wraps an explicit one as explicit.
    is_explicit = isinstance(solver, diffrax.AbstractERK) and not isinstance(solver, diffrax.AbstractWrappedSolver)
    return is_explicit or type(solver) is Rodas5P


def is_split(solver: diffrax.AbstractSolver) -> bool:
    """True if the method integrates an explicit and an implicit part, as `diffrax.KenCarp4` does."""
    return isinstance(getattr(innermost(solver), "tableau", None), diffrax.MultiButcherTableau)


def innermost(solver: diffrax.AbstractSolver) -> Any:
    """Method inside of all wrappers."""
    while isinstance(inner := getattr(solver, "solver", None), diffrax.AbstractSolver):
        solver = inner
    return solver


def choose_adjoint(adjoint, solver) -> diffrax.AbstractAdjoint:
    """Adjoint by its name; None is reverse mode with checkpoints.

    **Raises:** ValueError for an unknown name, and for the continuous adjoint of a method that has none.
    """
    if is_backsolve(adjoint) and (is_split(solver) or isinstance(solver, LieGroup)):
        raise ValueError(f"adjoint is 'backsolve', which {type(solver).__name__} does not support; take 'reverse'")
    if isinstance(adjoint, diffrax.AbstractAdjoint):
        return adjoint
    if adjoint is None or adjoint == "reverse":
        return diffrax.RecursiveCheckpointAdjoint()
    if adjoint == "direct":
        return diffrax.DirectAdjoint()
    if adjoint == "forward":
        return diffrax.ForwardMode()
    if adjoint == "backsolve":
        # Backwards the state is (y, dL/dy, ...), to which no projection of y applies.
        return diffrax.BacksolveAdjoint(solver=solver)
    raise ValueError(f"adjoint is {adjoint!r}; choose one of {', '.join(ADJOINTS)}, or pass a diffrax adjoint")


def has_name(adjoint: diffrax.AbstractAdjoint) -> bool:
    """True for the adjoints that have a name, whose derivatives the library's own loops give too.

    Others, and those with settings of their own, are for diffrax.
    """
    if type(adjoint) is diffrax.RecursiveCheckpointAdjoint:
        return adjoint.checkpoints is None
    return type(adjoint) in (diffrax.ForwardMode, diffrax.DirectAdjoint, diffrax.BacksolveAdjoint)


def uses_tolerances(solver) -> bool:
    """True for an implicit method whose equations are solved to the tolerances of the run."""
    return isinstance(solver, diffrax.AbstractImplicitSolver) and not eqx.is_array_like(solver.root_finder.rtol)


def check_tolerances(solver, stepsize, given: list[str]) -> None:
    """Refuse tolerances that were given and have no effect on this run."""
    solver, steps = choose_solver(solver, stepsize), "fixed" if is_step_length(stepsize) else "their own"
    if not uses_tolerances(solver):
        raise ValueError(
            f"{given[0]} is given, and {label(solver)} has no use for it with {steps} steps (stepsize); omit one of them"
        )


def solver_and_control(solver, term, ts, rtol, atol, stepsize):
    """Solver, step-size control and first step for diffrax, with tolerances above the rounding of the dtype."""
    eps = float(jnp.finfo(ts.dtype).eps)
    rtol, atol = jnp.maximum(rtol, 10 * eps), jnp.maximum(atol, 10 * eps)
    # The default of diffrax keeps the Jacobian of the step's start, gives up after two iterations and relies on a shorter step.
    # Fixed steps cannot be shorter, and adaptive ones lose more by it than by new Jacobians (the car axis: 9 times the steps).
    if uses_tolerances(solver):
        newton = optimistix.Newton(rtol, atol)  # pyright: ignore[reportArgumentType]
        solver = eqx.tree_at(lambda s: s.root_finder, solver, newton)
    if is_step_length(stepsize):
        return solver, ErrorMonitoredSteps(solver.order(term)), stepsize
    controller = stepsize
    if controller is None:
        # A step has to be longer than the rounding of the time.
        smallest = 16 * eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
        controller = Adaptive(rtol, atol, _error_size, smallest)
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) and _has_coarse_dense_output(solver, term):
        controller = diffrax.ClipStepSizeController(controller, step_ts=ts)
    return solver, controller, None


def _error_size(error):
    """Root mean square of the scaled errors, without the basis of reduced motion, which is constant during a step."""
    return optimistix.rms_norm({k: e for k, e in error.items() if k != "frame"} if isinstance(error, dict) else error)


def progress_meter(progress: bool) -> diffrax.AbstractProgressMeter:
    """Progress meter: tqdm where it is installed, else lines of text; none if not asked for."""
    if not progress:
        return diffrax.NoProgressMeter()
    return diffrax.TextProgressMeter() if importlib.util.find_spec("tqdm") is None else diffrax.TqdmProgressMeter()


def _has_coarse_dense_output(solver, term) -> bool:
    """True if save points between steps would be less accurate than the steps."""
    interpolation, order = innermost(solver).interpolation_cls, solver.order(term)
    interpolation = getattr(interpolation, "__self__", interpolation)  # Kvaerno's name a constructor of the class
    if not isinstance(interpolation, type) or order is None:
        return False
    degrees = [degree for cls, degree in _INTERPOLATION_DEGREE.items() if issubclass(interpolation, cls)]
    if is_split(solver) and hasattr(interpolation, "coeffs"):
        degrees.append(interpolation.coeffs.shape[1])  # of the methods of Kennedy and Carpenter
    # A polynomial of degree p has an error of order h^(p+1) between steps.
    return bool(degrees) and max(degrees) + 1 < order


class _Facts(NamedTuple):
    """Facts by which a loop is chosen."""

    solver: diffrax.AbstractSolver
    controller: Any
    options: Options
    guards: Callable | None
    quality: Callable | None
    pieces: tuple[str, ...]

    def is_by_diffrax(self) -> bool:
        """True for an adjoint that diffrax alone has."""
        return isinstance(self.options.adjoint, diffrax.BacksolveAdjoint) or not has_name(self.options.adjoint)


# When a row applies, the loop that makes the steps, and why they cannot end at the kinks of piecewise forces. Subclasses and
# wrappers of controllers, such as a clip to samples, have rules that our loops do not know.
_LOOPS: tuple[tuple[Callable[[_Facts], bool], str, str], ...] = (
    (
        lambda x: not has_own_loop(x.solver),
        "diffrax",
        "{option}; take jd.solvers.Rodas5P(), or an explicit solver, such as diffrax.Dopri8()",
    ),
    (
        lambda x: type(x.controller) not in (Adaptive, ErrorMonitoredSteps),
        "diffrax",
        "stepsize is a controller; leave it out",
    ),
    (_Facts.is_by_diffrax, "diffrax", "adjoint is {adjoint}; take 'reverse'"),
    (lambda x: x.options.progress, "diffrax", "progress is shown; leave it out"),
    (
        lambda x: x.guards is not None,
        "steps",
        "contacts, limits, a terminal event or the control may end the run; pass jd.events.ContactLost(stop=False) and no other "
        "events",
    ),
    (lambda x: x.quality is not None, "steps", "method is 'reduced'; take 'projected'"),
    (lambda x: bool(x.pieces), "pieces", ""),
    (lambda x: True, "steps", ""),
)


def choose_loop(solver, controller, options: Options, guards, quality, pieces: tuple[str, ...]) -> tuple[str, str]:
    """Loop of a run, "diffrax", "pieces" or "steps", and why its steps cannot end at the kinks of forces.

    "steps" and "pieces" are loops of the library, and "pieces" ends steps at kinks.
    """
    facts = _Facts(solver, controller, options, guards, quality, pieces)
    loop, reason = next((loop, reason) for applies, loop, reason in _LOOPS if applies(facts))
    return loop, reason.format(option=option_of(options.solver), adjoint=type(options.adjoint).__name__)


# --- stiffness of a scene: the rates of its linearised motion ---


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
