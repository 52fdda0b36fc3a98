"""Time-stepping methods in diffrax's interface."""

from jaxdyn.simulation.solvers.base import ProjectedSolver as ProjectedSolver
from jaxdyn.simulation.solvers.explicit import ExplicitSteps as ExplicitSteps
from jaxdyn.simulation.solvers.fixed_steps import RK4 as RK4
from jaxdyn.simulation.solvers.fixed_steps import Stepper as Stepper
from jaxdyn.simulation.solvers.lie import LieGroup as LieGroup
from jaxdyn.simulation.solvers.rosenbrock import Rodas5P as Rodas5P

__all__ = [
    "RK4",
    "ExplicitSteps",
    "LieGroup",
    "ProjectedSolver",
    "Rodas5P",
    "Stepper",
]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
