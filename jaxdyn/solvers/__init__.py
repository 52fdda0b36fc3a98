"""Time-stepping methods in diffrax's interface."""

from jaxdyn.solvers.explicit import ExplicitSteps as ExplicitSteps
from jaxdyn.solvers.lie import LieGroup as LieGroup
from jaxdyn.solvers.projected import ProjectedSolver as ProjectedSolver
from jaxdyn.solvers.rk4 import RK4 as RK4
from jaxdyn.solvers.rosenbrock import Rodas5P as Rodas5P
from jaxdyn.solvers.stepper import Stepper as Stepper
