"""Choice of solver, step-size control, adjoint and loop: the user's options as diffrax's objects, and who makes the steps.

The first row that applies decides.

    solver  given by the user               that one
            method "variational"            its own steps (`Stepper`)
            forces that are stiff           `Rodas5P`, for adaptive steps and concrete inputs
            stepsize a length               `RK4`
            else                            `Dopri8`
    loop    forces with modes               `hybrid/event_loop.py`
            else                            the rows of `_LOOPS`
"""

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix

from jaxdyn.compile.known import is_known
from jaxdyn.simulation.options import ADJOINTS, Options, check_step_length, is_backsolve, is_step_length
from jaxdyn.simulation.solvers.base import Adaptive, ErrorMonitoredSteps
from jaxdyn.simulation.solvers.diffrax_methods import RK4, LieGroup, Rodas5P, Stepper
from jaxdyn.systems.scene import Scene

if TYPE_CHECKING:
    from jaxdyn.simulation.stiffness import Stiffness

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


def is_stiff(rates: "Stiffness", span: float) -> bool:
    """True if stability alone, and not accuracy, would limit explicit steps.

    Dopri8, stable up to a decay of 5 over a step, would take 1000 steps and more for a transient that is over at once.
    Oscillations do not count, because any method has to follow them. For the springs and dampers in docs/stiff.md this is where
    Rodas5P takes 7 to 20 times fewer steps, a larger factor than the cost of one of its steps for a dozen velocities.
    """
    return bool(span * rates.decay > 5000)


def solver_for_start(scene: Scene, control, q0, v0, ts) -> diffrax.AbstractSolver | None:
    """`Rodas5P` if the equations are stiff at the start and all inputs are concrete, else None."""
    if not is_known(scene, control, q0, v0, ts):
        return None
    rates = find_stiffness(scene, q0, v0, ts[0], control)
    return Rodas5P() if rates is not None and is_stiff(rates, float(ts[-1] - ts[0])) else None


def find_stiffness(scene: Scene, q, v, t, control) -> "Stiffness | None":
    """Rates at a state; None where they are not finite, or the forces have no forward derivative, as callbacks."""
    # Imported here, because few runs ask for it and a first call should not wait for it.
    from jaxdyn.simulation.stiffness import stiffness

    try:
        rates = stiffness(scene, q, v, t, control)
    except (TypeError, ValueError, NotImplementedError, np.linalg.LinAlgError):
        return None  # the integration reports errors of the forces themselves
    return rates if np.isfinite(rates.decay) else None


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
