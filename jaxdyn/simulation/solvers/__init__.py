"""Time-stepping methods in diffrax's interface."""

from jaxdyn.simulation.solvers.base import ProjectedSolver as ProjectedSolver
from jaxdyn.simulation.solvers.diffrax_methods import RK4 as RK4
from jaxdyn.simulation.solvers.diffrax_methods import LieGroup as LieGroup
from jaxdyn.simulation.solvers.diffrax_methods import Rodas5P as Rodas5P
from jaxdyn.simulation.solvers.diffrax_methods import Stepper as Stepper
from jaxdyn.simulation.solvers.steps import LibrarySteps as LibrarySteps

__all__ = ["RK4", "LibrarySteps", "LieGroup", "ProjectedSolver", "Rodas5P", "Stepper"]


def __dir__() -> list[str]:
    """Names of the namespace; its modules are internal."""
    return __all__
