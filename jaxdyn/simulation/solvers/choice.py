"""What to integrate with: the user's options checked and turned into diffrax's objects."""

import importlib.util
from typing import TYPE_CHECKING, Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix
from jax.typing import ArrayLike

from jaxdyn.compile.known import is_concrete, is_known
from jaxdyn.model.arguments import batch_hint
from jaxdyn.simulation.solvers.first_step import Adaptive
from jaxdyn.simulation.solvers.fixed_steps import ErrorMonitoredSteps
from jaxdyn.simulation.solvers.lie import LieGroup
from jaxdyn.simulation.solvers.rk4 import RK4
from jaxdyn.simulation.solvers.rosenbrock import Rodas5P
from jaxdyn.simulation.solvers.stepper import Stepper
from jaxdyn.simulation.time_scales import Stiffness, stiffness
from jaxdyn.systems.scene import Scene

if TYPE_CHECKING:
    Solver = diffrax.AbstractSolver | Stepper | None
    Stepsize = ArrayLike | diffrax.AbstractStepSizeController | None
else:
    Solver = Stepsize = Any  # `checked_method` looks at them

ADJOINTS = ("reverse", "direct", "forward", "backsolve")
# Degree of the dense output of methods that do not bring their own.
_INTERPOLATION_DEGREE = {
    diffrax.LocalLinearInterpolation: 1,
    diffrax.ThirdOrderHermitePolynomialInterpolation: 3,
    diffrax.FourthOrderPolynomialInterpolation: 4,
}


def is_fixed(stepsize) -> bool:
    """Whether `stepsize` is a number."""
    return not (stepsize is None or isinstance(stepsize, diffrax.AbstractStepSizeController))


def checked_method(solver, stepsize):
    """Method (default: `Dopri8`, or `RK4` for fixed steps), refused when it does not suit the step size.

    **Raises:** ValueError that names `solver` or `stepsize` and the fix.
    """
    if solver is not None and not isinstance(solver, diffrax.AbstractSolver):
        raise ValueError(f"solver is {solver!r}; pass an instance of a diffrax solver, e.g. diffrax.Tsit5()")
    if is_fixed(stepsize):
        if np.shape(stepsize) != ():
            raise ValueError(f"stepsize has shape {np.shape(stepsize)}; pass one number (s){batch_hint(stepsize, ())}")
        if is_concrete(stepsize) and not (np.isfinite(stepsize) and stepsize > 0):
            raise ValueError(f"stepsize is {stepsize}; pass a positive number (s), or None for adaptive steps")
        solver = RK4() if solver is None else solver
    else:
        if isinstance(stepsize, diffrax.ConstantStepSize):
            raise ValueError("stepsize is a ConstantStepSize, which holds no length; pass the step as a number (s)")
        solver = diffrax.Dopri8() if solver is None else solver
        adaptive = stepsize is None or isinstance(stepsize, diffrax.AbstractAdaptiveStepSizeController)
        # The estimate of RK4 tells steps that are too long, and is too coarse to choose them by.
        if adaptive and (isinstance(solver, RK4) or not isinstance(solver, diffrax.AbstractAdaptiveSolver)):
            name = type(solver).__name__
            raise ValueError(f"solver {name} has no error estimate for adaptive steps; pass stepsize=, a number (s)")
    structure = solver.term_structure
    single = isinstance(structure, type) and issubclass(diffrax.ODETerm, structure)
    if not (single or is_split(solver)):
        name = type(solver).__name__
        raise ValueError(f"solver {name} does not take a single ODETerm; choose another, e.g. diffrax.Tsit5()")
    return solver


def for_stiff(rates: Stiffness, span: float) -> bool:
    """Whether explicit steps would be held short by stability alone.

    Dopri8, stable up to a decay of 5 over a step, would take 1000 steps and more for one that is over at once. Oscillations
    do not count: any method has to follow them. Of the springs and dampers in docs/stiff.md, that is
    where Rodas5P takes 7 to 20 times fewer steps, more than one of its steps costs for a dozen velocities.
    """
    return bool(span * rates.decay > 5000)


def for_start(scene: Scene, control, q0, v0, ts) -> diffrax.AbstractSolver | None:
    """The method for stiff equations where the start is one, as far as is known; else None."""
    if not is_known(scene, control, q0, v0, ts):
        return None
    rates = known_stiffness(scene, q0, v0, ts[0], control)
    return Rodas5P() if rates is not None and for_stiff(rates, float(ts[-1] - ts[0])) else None


def known_stiffness(scene: Scene, q, v, t, control) -> Stiffness | None:
    """Rates at a state; None where they are not finite, or the forces have no forward derivative (as callbacks have none)."""
    try:
        rates = stiffness(scene, q, v, t, control)
    except (TypeError, ValueError, NotImplementedError, np.linalg.LinAlgError):
        return None  # what is wrong with the forces themselves, the integration says
    return rates if np.isfinite(rates.decay) else None


def label(solver: diffrax.AbstractSolver) -> str:
    """Name of a method, with that of the one in it."""
    name, inner = type(solver).__name__, getattr(solver, "solver", None)
    return f"{name}({label(inner)})" if isinstance(inner, diffrax.AbstractSolver) else name


def is_split(solver: diffrax.AbstractSolver) -> bool:
    """Whether the method takes an explicit and an implicit part, as `diffrax.KenCarp4` does."""
    return isinstance(getattr(unwrapped(solver), "tableau", None), diffrax.MultiButcherTableau)


def unwrapped(solver: diffrax.AbstractSolver) -> Any:
    """The method inside of wrappers."""
    while isinstance(inner := getattr(solver, "solver", None), diffrax.AbstractSolver):
        solver = inner
    return solver


def checked_adjoint(adjoint, solver) -> diffrax.AbstractAdjoint:
    """Way of differentiation by name; None is reverse mode with checkpoints.

    **Raises:** ValueError for an unknown name, and for the continuous adjoint of a method that has none.
    """
    backsolve = adjoint == "backsolve" or isinstance(adjoint, diffrax.BacksolveAdjoint)
    if backsolve and (is_split(solver) or isinstance(solver, LieGroup)):
        raise ValueError(f"adjoint is 'backsolve', which {type(solver).__name__} cannot serve; take 'reverse'")
    if isinstance(adjoint, diffrax.AbstractAdjoint):
        return adjoint
    if adjoint is None or adjoint == "reverse":
        return diffrax.RecursiveCheckpointAdjoint()
    if adjoint == "direct":
        return diffrax.DirectAdjoint()
    if adjoint == "forward":
        return diffrax.ForwardMode()
    if adjoint == "backsolve":
        # Backwards the state is (y, dL/dy, ...), which no projection of y fits.
        return diffrax.BacksolveAdjoint(solver=solver)
    raise ValueError(f"adjoint is {adjoint!r}; choose one of {', '.join(ADJOINTS)}, or pass a diffrax adjoint")


def checked_step_limit(max_steps, ts, stepsize, adjoint: diffrax.AbstractAdjoint) -> int:
    """Most steps to take: as given, else what fixed steps need, else 65536 (4096 where each allowed step costs).

    **Raises:** ValueError for anything but a positive integer or None.
    """
    if max_steps is not None:
        if isinstance(max_steps, bool) or not isinstance(max_steps, (int, np.integer)) or max_steps < 1:
            raise ValueError(f"max_steps is {max_steps!r}; pass a positive integer, or None for the default")
        return int(max_steps)
    if is_fixed(stepsize) and is_concrete((ts, stepsize)):
        # Rounded up to a power of two, so that other times seldom mean another program.
        first, last = np.asarray(ts)[
            [0, -1]
        ]  # in numpy: inside a jit, jax would trace the difference of known times too
        needed = 1.001 * float(last - first) / float(stepsize) + 2
        return 2 ** int(np.ceil(np.log2(max(needed, 16))))
    return 4096 if isinstance(adjoint, diffrax.DirectAdjoint) else 65536


def stepping(solver, term, ts, rtol, atol, stepsize):
    """Method, controller and first step for diffrax, with tolerances that the dtype can hold."""
    eps = float(jnp.finfo(ts.dtype).eps)
    rtol, atol = jnp.maximum(rtol, 10 * eps), jnp.maximum(atol, 10 * eps)
    # The default of diffrax keeps the Jacobian of the step's start, gives up after two iterations and relies on a shorter step:
    # fixed ones cannot have it, and adaptive ones lose more by it than by new Jacobians (the car axis takes 9 times the steps).
    if isinstance(solver, diffrax.AbstractImplicitSolver) and not eqx.is_array_like(solver.root_finder.rtol):
        newton = optimistix.Newton(rtol, atol)  # pyright: ignore[reportArgumentType]
        solver = eqx.tree_at(lambda s: s.root_finder, solver, newton)
    if is_fixed(stepsize):
        return solver, ErrorMonitoredSteps(solver.order(term)), stepsize
    controller = stepsize
    if controller is None:
        smallest = 16 * eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
        controller = Adaptive(rtol, atol, norm=_error_size, dtmin=smallest, force_dtmin=False)
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController) and _has_coarse_dense_output(solver, term):
        controller = diffrax.ClipStepSizeController(controller, step_ts=ts)
    return solver, controller, None


def _error_size(error):
    """Root mean square of the scaled errors, without what is constant during a step."""
    return optimistix.rms_norm({k: e for k, e in error.items() if k != "frame"} if isinstance(error, dict) else error)


def progress_meter(progress: bool) -> diffrax.AbstractProgressMeter:
    """A bar by tqdm where it is installed, lines of text where not, nothing when not asked for."""
    if not progress:
        return diffrax.NoProgressMeter()
    return diffrax.TextProgressMeter() if importlib.util.find_spec("tqdm") is None else diffrax.TqdmProgressMeter()


def _has_coarse_dense_output(solver, term) -> bool:
    """Whether save points between steps would be less accurate than the steps."""
    interpolation, order = unwrapped(solver).interpolation_cls, solver.order(term)
    interpolation = getattr(interpolation, "__self__", interpolation)  # Kvaerno's name a constructor of the class
    if not isinstance(interpolation, type) or order is None:
        return False
    degrees = [degree for cls, degree in _INTERPOLATION_DEGREE.items() if issubclass(interpolation, cls)]
    if is_split(solver) and hasattr(interpolation, "coeffs"):
        degrees.append(interpolation.coeffs.shape[1])  # of the methods of Kennedy and Carpenter
    return bool(degrees) and max(degrees) + 1 < order
